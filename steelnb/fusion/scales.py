"""Lengths of the reconstruction in proportion to the radius of the bars' tubes."""

from dataclasses import dataclass

TUBE_M = 0.06


@dataclass(frozen=True)
class Scales:
    """Lengths in metres at a tube radius of `TUBE_M`; `at` scales them in proportion.

    Chosen on simulated flights of the preset ``starling2`` with the development seeds 11 and 12, ``zigzag`` and
    ``loops``, over the report's tower and one with wider legs (flanges of 160 mm).

    ``voxel_m``: edge of the voxels that accumulate the scans. Ridges: a voxel stays if its weight is large within
    ``ridge_radius_m``, and contracts to the mean within ``contract_m``. ``length_min_m``: shortest bar. Struts, short
    bars between two others, have a tube, a least length and a contraction of their own, and lie further than
    ``strut_hide_m`` from all bars. ``gap_max_m``: largest gap between pieces of one bar. ``slack_m``, ``reach_m``,
    ``lead_max_m``, ``same_m``, ``bend_m``, ``bend_gap_m``: see `fusion.joints`.
    """

    voxel_m: float = 0.04
    ridge_radius_m: float = 0.15
    contract_m: float = 0.08
    length_min_m: float = 0.3
    strut_tube_m: float = 0.04
    strut_length_min_m: float = 0.18
    strut_hide_m: float = 0.045
    strut_contract_m: float = 0.05
    gap_max_m: float = 0.3
    slack_m: float = 0.02
    reach_m: float = 0.2
    lead_max_m: float = 0.8
    same_m: float = 0.15
    bend_m: float = 1.2
    bend_gap_m: float = 0.1

    @classmethod
    def at(cls, tube_m: float) -> "Scales":
        """The lengths at a tube radius in metres."""
        scale = tube_m / TUBE_M
        return cls(**{name: scale * length for name, length in vars(cls()).items()})
