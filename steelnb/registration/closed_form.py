"""The closed-form rigid motion between paired points, as in the report's section 2.1.2."""

import numpy as np

from steelnb.datatypes import Array
from steelnb.errors import DegenerateCloudError, SettingsError


def closed_form(source: Array, target: Array) -> Array:
    """The ``T_target_source (4, 4)`` with the least sum of squared distances of pairs ``source[i]``, ``target[i]``.

    Both ``(N, 3)`` in metres, N ≥ 3, not all on a line. Equations 2.1–2.6 of the report with two corrections: with the
    H of equation 2.3, target by source, the rotation is U Vᵀ (equation 2.5 prints V Uᵀ, which is the inverse); and
    where U Vᵀ is a reflection, the axis of least spread is flipped (Umeyama, PAMI 1991). Raises `SettingsError`,
    `DegenerateCloudError`.
    """
    Q, P = np.asarray(source, dtype=np.float64), np.asarray(target, dtype=np.float64)
    if Q.shape != P.shape or Q.ndim != 2 or Q.shape[1] != 3 or not (np.isfinite(Q).all() and np.isfinite(P).all()):
        raise SettingsError(f"source {Q.shape} and target {P.shape}: expected paired finite points, both (N, 3)")
    if len(Q) < 3:
        raise DegenerateCloudError(f"source: {len(Q)} pairs, expected at least 3")
    p_mean, q_mean = P.mean(axis=0), Q.mean(axis=0)  # 2.1
    H = (P - p_mean).T @ (Q - q_mean)  # 2.2, 2.3
    U, spread, Vt = np.linalg.svd(H)  # 2.4
    if spread[1] <= 1e-12 * spread[0] or spread[0] == 0:
        raise DegenerateCloudError("source: the pairs lie on one line, which leaves the turn about it open")
    T_target_source = np.eye(4)
    T_target_source[:3, :3] = U @ np.diag([1, 1, np.sign(np.linalg.det(U @ Vt))]) @ Vt  # 2.5
    T_target_source[:3, 3] = p_mean - T_target_source[:3, :3] @ q_mean
    return T_target_source
