"""How noise and bias of an IMU show in its readings at rest."""

import numpy as np

from steelnb.types import Array


def allan_deviation(reading: Array, step_s: float, tau_s: Array) -> Array:
    """Overlapping Allan deviation ``(T,)`` of readings ``(N, C)``, of all columns together, for means over ``tau_s``.

    Source: IEEE Std 952-1997, annex C.
    """
    total = np.vstack([np.zeros((1, reading.shape[1])), np.cumsum(reading, axis=0)]) * step_s
    found = []
    for count in np.maximum(1, np.round(np.asarray(tau_s) / step_s).astype(int)):
        step = total[2 * count :] - 2 * total[count:-count] + total[: -2 * count]
        found.append(np.sqrt(0.5 * (step**2).mean()) / (count * step_s))
    return np.array(found)
