"""The files that a run over a recording writes, and the standard deviations in them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.fusion.structure import Structure
from steelnb.fusion.uncertainty import axis_sigma_m, joint_covariances
from steelnb.io.clouds import write_ply
from steelnb.io.segments import orientation, write_segments
from steelnb.io.structures import write_structure
from steelnb.io.trajectories import write_sigma, write_tum
from steelnb.metrics import position_error_m
from steelnb.metrics.matching import match_members
from steelnb.types import Array, Estimate, Flight, Segments, Trajectory


def write_recording(
    folder: Path, flight: Flight, estimate: Estimate, truth: Trajectory | None, segments: Segments,
    built: Structure | None, about: dict[str, str | None], origin: Array,
) -> None:  # fmt: skip
    """Write poses, map, bars, structure and the table of the frames of a run to an existing folder."""
    write_tum(folder / "prior.tum", estimate.prior)
    write_tum(folder / "corrected.tum", estimate.corrected)
    write_ply(folder / "map.ply", estimate.points, "<f8")  # world coordinates may be those of a country
    sigma_m = None
    if estimate.pose_covariance is not None:
        write_sigma(folder / "corrected_sigma.csv", estimate.corrected.stamp_s, estimate.pose_covariance)
    if estimate.axis_covariance is not None:
        half_m = 0.5 * segments.length
        sigma_m = np.column_stack([axis_sigma_m(estimate.axis_covariance, along_m) for along_m in (-half_m, half_m)])
    write_segments(folder, segments.moved(-origin), origin, orientation(segments), about, sigma_m)
    if built is not None:
        write_structure(built, folder / "structure.json", about=about)
    frames = pd.DataFrame({"stamp_s": estimate.prior.stamp_s, "matches": estimate.matches, "not_used": estimate.reason})
    if len(estimate.unobserved):
        frames["unobserved"] = estimate.unobserved
    frames["ms"] = 1e3 * estimate.update_s
    for name, path in (("prior", estimate.prior), ("corrected", estimate.corrected)):
        error_m = np.full(len(frames), np.nan)
        if truth is not None:
            error_m[_index(flight, truth)] = position_error_m(path.at(truth.stamp_s), truth)
        frames[f"{name}_error_m"] = error_m
    digits = {"stamp_s": 6, "ms": 2, "prior_error_m": 4, "corrected_error_m": 4}
    frames.round(digits).to_csv(folder / "frames.csv", index=False, lineterminator="\n", errors="backslashreplace")


def with_sigma(structure: Structure, estimate: Estimate) -> Structure:
    """The structure with the standard deviations of the smoothed axes that its bars lie on, in the bars' middles, and
    of the joints of these bars.

    A bar on none keeps that of its own fit, to which the median of the poses' is added.
    """
    axes, covariance, own = estimate.segments, estimate.axis_covariance, structure.segments
    if covariance is None or estimate.pose_covariance is None or not len(structure):
        return structure
    on = match_members(own, np.stack([axes.start, axes.end], axis=1)).member
    pose_m2 = np.median(np.trace(estimate.pose_covariance[:, :3, :3], axis1=1, axis2=2)) / 3.0
    fitted_m2 = structure.sigma_m**2 + pose_m2
    tilt = np.column_stack([np.ones((len(own), 2)), np.tile(2.0 / own.length[:, None] ** 2, 2)])
    each = np.where((on >= 0)[:, None, None], covariance[on], fitted_m2[:, None, None] * tilt[:, None] * np.eye(4))
    start, end = (np.where((on >= 0)[:, None], a[on], b) for a, b in ((axes.start, own.start), (axes.end, own.end)))
    lines = Segments(start, end, own.count, own.radius)
    sigma_m = axis_sigma_m(each, ((own.middle - lines.middle) * lines.direction).sum(axis=1))
    joint = joint_covariances(lines, each, structure.joint, structure.tie)
    held = np.isfinite(joint).all(axis=(1, 2))
    joint_sigma_m = np.full(len(joint), np.nan)
    joint_sigma_m[held] = np.sqrt(np.linalg.eigvalsh(joint[held])[:, -1])
    return replace(structure, sigma_m=sigma_m, joint_sigma_m=joint_sigma_m)


def _index(flight: Flight, truth: Trajectory) -> list[int]:
    """Numbers of the scans that ``truth`` has a pose for."""
    return np.searchsorted(flight.prior.stamp_s, truth.stamp_s - 1e-6).tolist()
