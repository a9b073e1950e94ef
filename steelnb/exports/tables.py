"""`Structure` → two tables: ``<name>_bars.csv`` and ``<name>_joints.csv``."""

from pathlib import Path

import numpy as np
import pandas as pd

from steelnb.exports.members import FRAME, Extras, orientation
from steelnb.fusion.structure import Structure


def write_csv(structure: Structure, path: Path, extras: Extras) -> None:
    """Write the tables beside ``path``, to a micrometre. Units are in the names of the columns, the frame is a column;
    the bars that a joint ties are one cell, their numbers apart by spaces."""
    s = structure.segments
    ends = {f"{end}_{axis}_m": getattr(s, end)[:, k] for end in ("start", "end") for k, axis in enumerate("xyz")}
    bars = pd.DataFrame({
        "bar": np.arange(len(structure)), **ends, "length_m": s.length, "width_m": structure.width_m,
        "sigma_m": structure.sigma_m, "sightings": structure.sightings, "points": s.count, "radius_m": s.radius,
        "group": orientation(s), "frame": FRAME,
    })  # fmt: skip
    tied = [structure.tie[structure.tie[:, 0] == joint, 1] for joint in range(len(structure.joint))]
    joints = pd.DataFrame({
        "joint": np.arange(len(tied)), **{f"{axis}_m": structure.joint[:, k] for k, axis in enumerate("xyz")},
        "bars": [" ".join(map(str, np.sort(of))) for of in tied], "frame": FRAME,
    })  # fmt: skip
    for name, table in (("bars", bars), ("joints", joints)):
        table.to_csv(path.with_name(f"{path.stem}_{name}.csv"), index=False, float_format="%.6f", lineterminator="\n")
