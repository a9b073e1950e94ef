"""Settings → odometry, and flight → estimate."""

import importlib
import inspect
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.images import CameraImages
from steelnb.core.types import Array, Estimate, Flight, Imu
from steelnb.fusion.adjustment.imu_factors import check_imu
from steelnb.fusion.adjustment.smooth import smooth
from steelnb.odometry.base import BaseOdometry, Odometry
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.deepvo.odometry import DeepVoOdometry
from steelnb.odometry.faces.odometry import FaceOdometry
from steelnb.odometry.libraries import PeerOdometry
from steelnb.odometry.loam.odometry import LoamOdometry
from steelnb.odometry.orb.odometry import OrbOdometry
from steelnb.odometry.report.clouds import ReportCloudOdometry
from steelnb.odometry.report.segments import ReportSegmentOdometry
from steelnb.odometry.run import OnStep, run
from steelnb.odometry.segments.odometry import SegmentOdometry
from steelnb.settings import OdometrySettings, StructureSettings
from steelnb.settings.base import guess

ODOMETRIES: dict[str, type[BaseOdometry]] = {
    "segments": SegmentOdometry,
    "clouds": CloudOdometry,
    "faces": FaceOdometry,
    "loam": LoamOdometry,
    "orb": OrbOdometry,
    "deepvo": DeepVoOdometry,
    "library": PeerOdometry,
    "report_clouds": ReportCloudOdometry,
    "report_segments": ReportSegmentOdometry,
}
"""Family of settings → its odometry."""
GIVEN = ("T_drone_sensor", "imu", "images")
"""Parts of a flight that the constructor of an odometry, built-in or the user's, may take under these names."""


def make_odometry(
    settings: OdometrySettings, T_drone_sensor: Array, imu: Imu | None = None, images: CameraImages | None = None
) -> BaseOdometry:
    """A new odometry of the settings' family; ``T_drone_sensor (4, 4)`` is the mount of the sensor. ``imu`` and
    ``images`` are passed to the odometries whose constructors take them."""
    make = partial(ODOMETRIES[settings.family], settings)
    return make(**_wanted(make, {"T_drone_sensor": T_drone_sensor, "imu": imu, "images": images}))


def _wanted(make: Callable[..., Any], given: dict[str, Any]) -> dict[str, Any]:
    """The ``given`` arguments that a constructor takes by name."""
    return {name: given[name] for name in inspect.signature(make).parameters if name in given}


def correct(
    flight: Flight,
    settings: OdometrySettings,
    on_step: OnStep | None = None,
    own: Callable[..., Odometry] | None = None,
    before: Flight | None = None,
) -> Estimate:
    """Correct a flight with the method of the settings, scan by scan.

    With ``smooth``, all poses and bars are then adjusted together (`fusion.adjustment.smooth`). Smoothing time is
    divided evenly over the scans. ``on_step`` and ``before`` as for `run`. ``own`` is a class that replaces the
    odometry of the settings (`load_odometry`). Raises `InputError` as `run` does, and before the first scan if the
    readings of an IMU do not fit the prior (`check_imu`)."""
    noise = getattr(settings, "inertial", None)
    if noise and flight.imu is not None:
        check_imu(flight.imu, flight.prior)
    make = own or partial(make_odometry, settings)
    odometry = make(**_wanted(make, {name: getattr(flight, name) for name in GIVEN}))
    estimate = run(flight, odometry, on_step, before)
    if not settings.smooth:
        return estimate
    begin, preprocess = time.perf_counter(), settings.preprocess
    structure = StructureSettings(floor_m=preprocess.floor_m, range_max_m=preprocess.crop_m)
    estimate = smooth(flight, estimate, structure, getattr(settings, "tilt_sigma_rad", 0.0), noise)
    smooth_s = np.full(len(flight), (time.perf_counter() - begin) / max(len(flight), 1))
    return replace(estimate, seconds={**estimate.seconds, "smooth": smooth_s})


def load_odometry(name: str) -> Callable[..., Odometry]:
    """Load the class ``MODULE:CLASS`` from an installed module, or from one in the working directory.

    Raises `InputError` if module, class or its method `update` is missing, or if its constructor requires arguments
    other than `GIVEN`.
    """
    module_name, _, class_name = name.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        module = importlib.import_module(module_name)
    except Exception as fault:  # the user's module may raise anything
        raise InputError(f"{name}: module {module_name!r} cannot be imported: {fault}") from None
    finally:
        sys.path.pop(0)
    classes: dict[str, Any] = dict(inspect.getmembers(module, inspect.isclass))
    if class_name not in classes:
        raise InputError(f"{name}: no class {class_name!r} in {module.__file__}{guess(class_name, list(classes))}")
    kind = classes[class_name]
    if not callable(getattr(kind, "update", None)):
        raise InputError(f"{name}: no method 'update'; expected update(scan, T_world_drone_prior) -> OdometryStep")
    parameters = inspect.signature(kind).parameters.values()
    needed = {each.name for each in parameters if each.default is each.empty and "VAR" not in each.kind.name}
    if unknown := needed - set(GIVEN):
        raise InputError(f"{name}: its constructor needs {', '.join(sorted(unknown))}; expected {', '.join(GIVEN)}")
    return kind  # type: ignore[no-any-return]
