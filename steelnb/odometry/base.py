"""The interface of every odometry, the base class of those of this package, the loop that runs one over a flight, and a
user's own class."""

import copy
import importlib
import inspect
import sys
import time
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import Any, ClassVar, Protocol

import numpy as np

from steelnb.core.checks import SAME_S, checked_cloud, checked_kind, checked_points, checked_pose, guess
from steelnb.core.errors import InputError, SteelnbError
from steelnb.core.estimates import Estimate, OdometryStep
from steelnb.core.geometry import points_along
from steelnb.core.types import Array, Flight, Scan, Segments, Trajectory
from steelnb.settings import OdometrySettings

SPACING_M = 0.05
FoundPose = tuple[Array, str, int, int]
"""Pose ``T_world_drone (4, 4)``, the reason if the scan was not used (else empty), number of matches, and number of
directions in which the scan does not determine the pose."""


class Odometry(Protocol):
    """Corrects a drifting pose, scan by scan. A class needs only the method `update`; it need not inherit."""

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan.

        ``scan``: a `Scan`, or points ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, metres, NaN for no return.
        ``T_world_drone_prior (4, 4)``: the absolute drifting pose. Raises `InputError` for arrays of other shapes,
        and for a prior that is not rigid.
        """


class Stopwatch:
    """``seconds`` of each stage of an update, zero for a stage that was skipped."""

    def __init__(self, stages: tuple[str, ...]) -> None:
        self.seconds = dict.fromkeys(stages, 0.0)
        self._last_s = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage."""
        now_s = time.perf_counter()
        self.seconds[stage] += now_s - self._last_s
        self._last_s = now_s


class BaseOdometry(ABC):
    """An odometry of this package, which may build a map.

    Parameters
    ----------
    settings : an instance of ``kind``, default ``OdometrySettings.preset(method)``.
    T_drone_sensor : (4, 4), the mount of the sensor, default identity.

    Raises `InputError` for settings of another family, and for a mount that is not rigid.
    """

    kind: ClassVar[type[OdometrySettings]]
    method: ClassVar[str]
    stages: ClassVar[tuple[str, ...]]
    """Names of the ``seconds`` of a step."""
    uses: ClassVar[tuple[str, ...]] = ()
    """Names of further parts of a flight that the constructor takes: ``imu``, ``images``."""

    def __init__(self, settings: OdometrySettings | None = None, T_drone_sensor: Array | None = None) -> None:
        self.settings = OdometrySettings.preset(self.method) if settings is None else settings
        checked_kind(self.settings, "settings", OdometrySettings, f"OdometrySettings.preset({self.method!r})")
        if not isinstance(self.settings, self.kind):
            raise InputError(
                f"method {self.settings.method!r} is of the family {self.settings.family!r}; expected one such as"
                f" {self.method!r}"
            )
        self.T_drone_sensor = checked_pose(np.eye(4) if T_drone_sensor is None else T_drone_sensor, "T_drone_sensor")

    def __repr__(self) -> str:
        return f"{type(self).__name__}({self.settings.method!r})"

    def update(self, scan: Scan | Array, T_world_drone_prior: Array) -> OdometryStep:
        """Correct the pose at one scan, and add the scan to the map; see `Odometry.update`."""
        if not isinstance(scan, Scan):
            scan = Scan(0.0, checked_cloud(scan, "scan"))
        prior, watch = checked_pose(T_world_drone_prior, "T_world_drone_prior"), Stopwatch(self.stages)
        T_world_drone, reason, matches, unobserved = self._update(scan, prior, watch)
        if reason:
            reason = nothing_near(scan, self.settings.preprocess.crop_m) or reason
        return OdometryStep(
            scan.stamp_s, T_world_drone, reason == "", reason, matches, watch.seconds, unobserved,
            self._covariance(T_world_drone),
        )  # fmt: skip

    @abstractmethod
    def _update(self, scan: Scan, prior: Array, watch: Stopwatch) -> FoundPose:
        """Correct the pose at one scan, and end each stage with a lap of the ``watch``."""

    def _covariance(self, T_world_drone: Array) -> Array | None:
        """The ``covariance`` of an `OdometryStep` with this pose; unknown by default."""
        return None

    def map_points(self) -> Array:
        """The map as points ``(N, 3)``, world frame: by default, points along its bars, about `SPACING_M` apart."""
        bars = self.map_segments()
        return points_along(bars.start, bars.end, SPACING_M)[0]

    def map_segments(self) -> Segments:
        """The bars of the map; none by default."""
        return Segments.empty()


def nothing_near(scan: Scan, crop_m: float) -> str:
    """The reason if all returns of a scan are farther than ``crop_m``; empty otherwise, or if there are none."""
    distance = np.linalg.norm(scan.points.reshape(-1, 3), axis=1)
    distance = distance[np.isfinite(distance) & (distance > 0)]
    if not len(distance) or distance.min() <= crop_m:
        return ""
    return f"no point within {crop_m:g} m (nearest {distance.min():.4g} m)"


OnStep = Callable[[int, Scan, OdometryStep], None]


def run(flight: Flight, odometry: Odometry, on_step: OnStep | None = None, before: Flight | None = None) -> Estimate:
    """Correct a flight scan by scan; one scan is in memory at a time.

    Parameters
    ----------
    flight : the scans, the drifting prior at their stamps, and the mount of the sensor. A class that is not of this
        package gets copies of the scans.
    odometry : a new one; afterwards it holds the map.
    on_step : called after every scan with its number, the scan and its `OdometryStep`; its time is not measured.
    before : another flight, which the odometry corrects first; its steps are dropped, and what it has learnt stays.

    Raises `InputError` if other scans are read than the flight has poses for, by number or by stamp, and if an update
    returns no `OdometryStep`, one of another stamp or one that is not valid; the message names the class and the scan.
    """
    if before is not None:
        run(before, odometry)
    steps: list[OdometryStep] = []
    reason, update_s = [], np.zeros(len(flight))
    T_world_drone, is_ours = flight.prior.T_world_drone.copy(), type(odometry).__module__.startswith("steelnb.")
    for k, scan in enumerate(flight.scans):
        if k == len(flight):
            raise InputError(f"{flight.name}: more than {k} scans could be read; expected {k}, one per pose")
        checked_kind(scan, f"{flight.name}, scan {k}", Scan)
        _check_stamp(scan.stamp_s, f"{flight.name}, scan {k}", float(flight.prior.stamp_s[k]), "its pose")
        given = (scan if is_ours else copy.deepcopy(scan)), flight.prior.T_world_drone[k].copy()  # which it may change
        begin = time.perf_counter()
        try:
            with nullcontext() if is_ours else users_code("it"):
                step = odometry.update(*given)
            update_s[k] = time.perf_counter() - begin
            # Checked again, as the odometry may have changed the array since.
            T_world_drone[k] = checked_pose(checked_kind(step, "its result", OdometryStep).T_world_drone, "its pose")
            _check_stamp(step.stamp_s, "its result", scan.stamp_s, "its scan")
        except InputError as fault:
            raise InputError(f"{type(odometry).__name__}.update, scan {k}: {fault}") from fault.__cause__
        steps.append(step)
        # On one line, as it is printed.
        reason.append("" if step.used else " ".join((scan.fault or step.reason).split()) or "not used")
        if on_step:
            on_step(k, scan, step)
    if len(steps) < len(flight):
        raise InputError(f"{flight.name}: {len(steps)} scans could be read; expected {len(flight)}, one per pose")
    stages = dict.fromkeys(stage for step in steps for stage in step.seconds)
    covariances = [step.covariance for step in steps if step.covariance is not None]
    return Estimate(
        prior=flight.prior,
        corrected=Trajectory(flight.prior.stamp_s, T_world_drone),
        points=_map_of(odometry, "map_points", np.zeros((0, 3))),
        segments=_map_of(odometry, "map_segments", Segments.empty()),
        matches=np.array([s.matches for s in steps], dtype=np.int64),
        reason=tuple(reason),
        seconds={stage: np.array([s.seconds.get(stage, 0.0) for s in steps]) for stage in stages},
        update_s=update_s,
        unobserved=np.array([s.unobserved for s in steps], dtype=np.int64),
        pose_covariance=np.array(covariances) if steps and len(covariances) == len(steps) else None,
    )


def _check_stamp(stamp_s: float, name: str, due_s: float, of: str) -> None:
    """Raise `InputError` unless a stamp is that of something else, to within `SAME_S`."""
    if not abs(stamp_s - due_s) <= SAME_S:
        raise InputError(f"{name}: at {stamp_s!r} s, {stamp_s - due_s:.6g} s after {of}; expected the same stamp")


def _map_of(odometry: Odometry, method: str, default: Any) -> Any:
    """What a method of the odometry returns, or the default if it has none of this name. Raises `InputError`."""
    found, name = getattr(odometry, method, None), f"{type(odometry).__name__}.{method}()"
    if not callable(found):
        return default
    with users_code(name):
        value = found()
    if not isinstance(default, Segments):
        return checked_points(value, name)
    return checked_kind(value, name, Segments)


GIVEN = ("T_drone_sensor", "imu", "images")
"""Parts of a flight that the constructor of a user's odometry may take under these names."""
BY_NAME = inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY


def load_odometry(name: str) -> Callable[..., Odometry]:
    """Load the class ``MODULE:CLASS`` from an installed module or from one in the working directory, or
    ``FILE.py:CLASS`` from a file.

    Raises `InputError` if module, class or its method `update` is missing, if the class is abstract, or if its
    constructor requires arguments other than `GIVEN`.
    """
    module_name, _, class_name = name.rpartition(":") if ":" in name else (name, "", "")
    folder, file = Path.cwd(), Path(module_name).resolve() if module_name.endswith(".py") else None
    if file is not None:
        if not file.is_file():
            raise InputError(f"{name}: no file {module_name}; expected FILE.py:CLASS or MODULE:CLASS")
        folder, module_name = file.parent, file.stem
    sys.path.insert(0, str(folder))
    try:
        module = importlib.import_module(module_name)
    except (Exception, SystemExit) as fault:  # the user's module may raise anything, or run a program
        raise InputError(f"{name}: module {module_name!r} cannot be imported: {fault!r}") from None
    finally:
        sys.path.pop(0)
    where = getattr(module, "__file__", None) or "Python itself"
    if file is not None and Path(where).resolve() != file:
        raise InputError(f"{name}: {module_name!r} is the name of another module, in {where}; rename the file")
    classes: dict[str, Any] = dict(inspect.getmembers(module, inspect.isclass))
    if class_name not in classes:
        raise InputError(f"{name}: no class {class_name!r} in {where}{guess(class_name, list(classes))}")
    kind = classes[class_name]
    if not callable(getattr(kind, "update", None)):
        raise InputError(f"{name}: no method 'update'; expected update(scan, T_world_drone_prior) -> OdometryStep")
    _check_constructor(kind, name)
    return kind  # type: ignore[no-any-return]


def make_own(own: Callable[..., Odometry], flight: Flight) -> Odometry:
    """A new odometry of a user's class, given copies of the parts of the flight that its constructor takes by name.
    Raises `InputError` if that requires others."""
    name = getattr(own, "__name__", "own")
    _check_constructor(own, name)
    names = [each.name for each in _parameters(own) if each.kind in BY_NAME]
    shared = {id(flight.images.images): flight.images.images} if flight.images else {}  # made or read on access
    given = {each: copy.deepcopy(getattr(flight, each), shared) for each in GIVEN if each in names}
    with users_code(f"{name}: its constructor"):
        return own(**given)


@contextmanager
def users_code(what: str) -> Iterator[None]:
    """Raise `InputError`, with the line, if a user's code raises anything. ``what``: that code."""
    try:
        yield
    except SteelnbError:
        raise
    except Exception as fault:  # it may raise anything
        last = traceback.extract_tb(fault.__traceback__)[-1]
        said = f"{type(fault).__name__}: {fault}".removesuffix(": ")
        raise InputError(f"{what} raises {said} ({last.filename}, line {last.lineno})") from fault


def _check_constructor(own: Callable[..., Odometry], name: str) -> None:
    """Raise `InputError` if a class is abstract, or if its constructor requires arguments other than `GIVEN`."""
    if missing := getattr(own, "__abstractmethods__", ()) or ["update"] * getattr(own, "_is_protocol", False):
        raise InputError(f"{name}: an abstract class; expected one with {', '.join(sorted(missing))}")
    needed = {each for each in _parameters(own) if each.default is each.empty and "VAR" not in each.kind.name}
    if unknown := sorted(each.name for each in needed if each.name not in GIVEN or each.kind not in BY_NAME):
        raise InputError(f"{name}: its constructor needs {', '.join(unknown)}; expected {', '.join(GIVEN)}, by name")


def _parameters(own: Callable[..., Odometry]) -> Iterable[inspect.Parameter]:
    """The parameters of a constructor that is not ours, so that only Python knows them; none if it does not, as of
    compiled classes."""
    try:
        return inspect.Signature.from_callable(own).parameters.values()
    except ValueError:
        return ()
