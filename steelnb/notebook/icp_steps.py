"""What ICP does with one scan, step by step: pairs, centring, rotation, and again."""

from typing import NamedTuple

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array, Flight, IntArray
from steelnb.plots import BLACK, GREY, ORANGE, Figure, gather_legend
from steelnb.points import preprocess_scan
from steelnb.registration.pcl import least_squares_motion
from steelnb.settings import PreprocessSettings
from steelnb.simulation import Truth

LIMIT_M, EXTENT_M, PAIRS_SHOWN = 0.5, 1.6, 150
REACHING = "a longer tof.range_max_m and preprocess.crop_m, a lower preprocess.floor_m"
"""What lets a scan see more, for a message."""
START = np.eye(4)
"""Where the scan starts: turned by 8° about the line of sight and shifted by 30 cm."""
START[:3, :3] = Rotation.from_euler("x", 8, degrees=True).as_matrix()
START[:3, 3] = 0.0, -0.25, 0.17


class IcpStep(NamedTuple):
    """A source ``(N, 3)`` at one step, and the target points ``(K, 3)`` that ``paired (K,)`` rows of it have."""

    source: Array
    paired: IntArray
    matched: Array


def icp_steps(source: Array, target: Array, limit_m: float, rounds: int = 50) -> dict[str, IcpStep]:
    """Register a source ``(N, 3)`` to a target ``(M, 3)`` by point-to-point ICP (Besl, McKay 1992), with pairs up to
    ``limit_m`` apart. Returns the source with its pairs after each step of the first round, and after ``rounds``.
    Raises `InputError` without a pair.
    """
    tree, steps = KDTree(target), {}
    for k in range(rounds):
        distance_m, match = tree.query(source, distance_upper_bound=limit_m)
        paired = np.flatnonzero(np.isfinite(distance_m)).astype(np.int64)
        if not len(paired):
            raise InputError(f"no pair within {limit_m} m of {len(source)} and {len(target)} points")
        matched = target[match[paired]]
        motion = least_squares_motion(source[paired], matched)
        if k == 0:
            centred = source + (matched.mean(axis=0) - source[paired].mean(axis=0))
            steps["nearest points are paired"] = IcpStep(source, paired, matched)
            steps["the centres of the pairs coincide"] = IcpStep(centred, paired, matched)
        source = transform_points(motion, source)
        if k == 0:
            steps["rotated by the SVD"] = IcpStep(source, paired, matched)
    steps[f"after {rounds} rounds"] = IcpStep(source, paired, matched)
    return steps


def figure_icp_steps(flight: Flight, truth: Truth, frame: int, preprocess: PreprocessSettings) -> Figure:
    """Scan ``frame`` of a flight, turned and shifted by `START`, on its way to the scan before it: one panel for each
    of `icp_steps`, in the drone's frame, seen from the drone. Grey lines join pairs."""
    T_world_drone = truth.trajectory.at(flight.prior.stamp_s).T_world_drone[[frame, frame - 1]]
    scan, reference = (
        preprocess_scan(flight.scans[k], T, flight.T_drone_sensor, preprocess)
        for k, T in zip((frame, frame - 1), T_world_drone, strict=True)
    )
    reference = transform_points(np.linalg.inv(T_world_drone[0]) @ T_world_drone[1], reference)
    try:
        steps = icp_steps(transform_points(START, scan), reference, LIMIT_M)
    except InputError as fault:
        raise InputError(f"scans {frame} and {frame - 1}: {fault}; expected more in view: {REACHING}") from None
    figure = Figure(figsize=(13, 4.1), layout="constrained")
    for panel, (title, step) in zip(figure.subplots(1, len(steps), sharey=True), steps.items(), strict=True):
        shown = step.paired[:: max(1, len(step.paired) // PAIRS_SHOWN)]
        joined = np.isin(step.paired, shown)
        panel.plot(
            *np.stack([step.source[shown], step.matched[joined]])[..., 1:].transpose(2, 0, 1), color=GREY, lw=0.7
        )
        panel.scatter(*reference[:, 1:].T, s=3, color=BLACK, lw=0, label="reference cloud P, the scan before")
        panel.scatter(*step.source[:, 1:].T, s=3, color=ORANGE, lw=0, label="scan Q")
        panel.set(aspect="equal", xlabel="to the left (m)", xlim=(EXTENT_M, -EXTENT_M), ylim=(-EXTENT_M, EXTENT_M))
        panel.set_title(title, size=10)
    figure.axes[0].set_ylabel("up (m)")
    gather_legend(figure, ncols=2, markerscale=4)
    return figure
