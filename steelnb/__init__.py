"""steelnb: drone mapping of steel structures, from simulated or recorded Time-of-Flight scans.

``import steelnb`` loads no library: each public name is loaded when it is first used. It sets the environment variables
of `steelnb.core.determinism`, so that results are bit-identical on every processor. Import it before NumPy.
"""

import os

from steelnb.core.determinism import pin

TYPE_CHECKING = False  # checkers assume true; importing `typing` takes 10 ms, in which Ctrl-C prints a traceback
if TYPE_CHECKING:
    from steelnb.core.errors import InputError, SteelnbError
    from steelnb.core.estimates import Estimate, OdometryStep
    from steelnb.core.types import Flight, Lines, Scan, Segments, Trajectory
    from steelnb.experiment import Result, run
    from steelnb.fusion import SegmentMap
    from steelnb.fusion.adjustment.smooth import smooth
    from steelnb.fusion.reconstruct import reconstruct
    from steelnb.fusion.structure import Structure
    from steelnb.hough import detect_lines, detect_segments
    from steelnb.io import read_cloud, read_flight, read_truth, write_flight, write_structure
    from steelnb.odometry import (
        CloudOdometry,
        DeepVoOdometry,
        FaceOdometry,
        LoamOdometry,
        OrbOdometry,
        PeerOdometry,
        SegmentOdometry,
        make_odometry,
    )
    from steelnb.registration import RegistrationResult, register
    from steelnb.settings import ExperimentSettings, OdometrySettings, StructureSettings

__version__ = "1.0.0"

_MODULES = {
    "core.errors": ("InputError", "SteelnbError"),
    "experiment": ("Result", "run"),
    "fusion": ("SegmentMap",),
    "fusion.reconstruct": ("reconstruct",),
    "fusion.adjustment.smooth": ("smooth",),
    "fusion.structure": ("Structure",),
    "hough": ("detect_lines", "detect_segments"),
    "io": ("read_cloud", "read_flight", "read_truth", "write_flight", "write_structure"),
    "odometry": (
        "CloudOdometry",
        "DeepVoOdometry",
        "FaceOdometry",
        "LoamOdometry",
        "OrbOdometry",
        "PeerOdometry",
        "SegmentOdometry",
        "make_odometry",
    ),
    "registration": ("RegistrationResult", "register"),
    "settings": ("ExperimentSettings", "OdometrySettings", "StructureSettings"),
    "core.estimates": ("Estimate", "OdometryStep"),
    "core.types": ("Flight", "Lines", "Scan", "Segments", "Trajectory"),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "CloudOdometry", "DeepVoOdometry", "Estimate", "ExperimentSettings", "FaceOdometry", "Flight",
    "InputError", "Lines", "LoamOdometry", "OdometrySettings", "OdometryStep", "OrbOdometry", "PeerOdometry",
    "RegistrationResult", "Result", "Scan", "SegmentMap", "SegmentOdometry", "Segments", "SteelnbError", "Structure",
    "StructureSettings", "Trajectory", "__version__", "detect_lines", "detect_segments", "make_odometry", "read_cloud",
    "read_flight", "read_truth", "reconstruct", "register", "run", "smooth", "write_flight", "write_structure",
]  # fmt: skip


pin(os.environ)


def __getattr__(name: str) -> object:
    import importlib

    if name in _MODULES:
        return importlib.import_module(f"steelnb.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'steelnb' has no attribute {name!r}")
    value = getattr(importlib.import_module(f"steelnb.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return __all__
