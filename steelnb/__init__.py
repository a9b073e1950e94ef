"""steelnb: drone mapping of steel structures, from simulated or recorded Time-of-Flight scans.

``import steelnb`` loads no library: each public name is loaded when it is first used. It sets the environment variables
of `steelnb.pins`, so that results have the same bits on every processor: import it before NumPy. A library of an extra
that is missing is named with the command that installs it.
"""

import os

from steelnb.pins import pin

TYPE_CHECKING = False  # type checkers take it for true; `typing` takes ten milliseconds, in which Ctrl-C is a traceback
if TYPE_CHECKING:
    from steelnb.errors import MissingExtraError, SteelnbError
    from steelnb.experiment import Result, run
    from steelnb.fusion import SegmentMap
    from steelnb.fusion.reconstruct import reconstruct
    from steelnb.fusion.smooth import smooth
    from steelnb.fusion.structure import Structure
    from steelnb.hough import detect_lines, detect_segments
    from steelnb.io import read_cloud, read_flight, read_structure, read_truth, write_flight, write_structure
    from steelnb.odometry import (
        CloudOdometry,
        CombinedOdometry,
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
    from steelnb.types import Estimate, Flight, Lines, OdometryStep, Scan, Segments, Trajectory

__version__ = "0.2.0"

_MODULES = {
    "errors": ("MissingExtraError", "SteelnbError"),
    "experiment": ("Result", "run"),
    "fusion": ("SegmentMap",),
    "fusion.reconstruct": ("reconstruct",),
    "fusion.smooth": ("smooth",),
    "fusion.structure": ("Structure",),
    "hough": ("detect_lines", "detect_segments"),
    "io": ("read_cloud", "read_flight", "read_structure", "read_truth", "write_flight", "write_structure"),
    "odometry": (
        "CloudOdometry",
        "CombinedOdometry",
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
    "types": ("Estimate", "Flight", "Lines", "OdometryStep", "Scan", "Segments", "Trajectory"),
}
_HOMES = {name: module for module, names in _MODULES.items() for name in names}

__all__ = [
    "CloudOdometry", "CombinedOdometry", "DeepVoOdometry", "Estimate",
    "ExperimentSettings", "FaceOdometry", "Flight", "Lines", "LoamOdometry",
    "MissingExtraError", "OdometrySettings", "OdometryStep", "OrbOdometry", "PeerOdometry", "RegistrationResult",
    "Result", "Scan", "SegmentMap", "SegmentOdometry", "Segments", "SteelnbError", "Structure", "StructureSettings",
    "Trajectory", "__version__", "detect_lines", "detect_segments", "make_odometry", "read_cloud",
    "read_flight", "read_structure", "read_truth", "reconstruct", "register", "run", "smooth",
    "write_flight", "write_structure",
]  # fmt: skip


def _keep_compiled_code() -> None:
    """Give Numba a folder for compiled code where it finds none: a read-only install without a writable home.

    The folder is the user's own and closed to others, since Numba runs what it finds there. Matplotlib, which would
    make one for each process and say so, keeps its list of fonts there too.
    """
    cache = os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache")
    while os.path.isabs(cache) and not os.path.isdir(cache):
        cache = os.path.dirname(cache)
    found = os.path.isabs(cache) and os.access(cache, os.W_OK)
    if found or "NUMBA_CACHE_DIR" in os.environ or os.access(os.path.dirname(__file__), os.W_OK):
        return
    import atexit
    import shutil
    import tempfile

    folder = os.path.join(tempfile.gettempdir(), f"steelnb-numba-{os.getuid()}")
    try:
        os.makedirs(folder, mode=0o700, exist_ok=True)
        state = os.lstat(folder)
        own = not os.path.islink(folder) and state.st_uid == os.getuid() and not state.st_mode & 0o077
    except OSError:
        own = False
    if not own:
        folder = tempfile.mkdtemp(prefix="steelnb-numba-")
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
    os.environ["NUMBA_CACHE_DIR"] = folder
    os.environ.setdefault("MPLCONFIGDIR", folder)


pin(os.environ)
_keep_compiled_code()


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
