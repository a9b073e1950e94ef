"""A simulated flight as a recording: sensor data, drifting poses at 125 Hz, and the truth apart."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from steelnb import experiment
from steelnb.config import ExperimentSettings
from steelnb.datatypes import Array, RangeScans, Scan
from steelnb.errors import OutputError, SettingsError
from steelnb.noise import drifting
from steelnb.recordings.formats import form_to_write, save_recording
from steelnb.recordings.recording import Picture, Recording

PICTURE_PERIOD_S = 1.0
DURATION_MIN_S = 1.0


class HeldScans:
    """Scans in memory as the source of a recording; ``stamp_s (K,)`` are theirs."""

    def __init__(self, scans: Sequence[Scan], stamp_s: Array) -> None:
        self._scans, self.stamp_s = scans, stamp_s

    def walk(self, wanted: NDArray[np.bool_] | None = None) -> Iterator[Scan]:
        """All scans, or those of a mask ``(K,)``."""
        index = range(len(self.stamp_s)) if wanted is None else np.flatnonzero(wanted).tolist()
        return (self._scans[k] for k in index)


class RangePictures:
    """Range images as grey pictures, about one a second: no camera, but what the Time-of-Flight sensor saw.

    255 is right before the sensor, 1 at ``range_max_m``, and 0 where nothing returned.
    """

    def __init__(self, scans: RangeScans, range_max_m: float) -> None:
        gap_s = float(np.median(np.diff(scans.stamp_s))) if len(scans) > 1 else PICTURE_PERIOD_S
        self._every = max(1, round(PICTURE_PERIOD_S / gap_s))
        self._scans, self._range_max_m = scans, range_max_m
        self.stamp_s = scans.stamp_s[:: self._every]

    def walk(self) -> Iterator[Picture]:
        """All pictures ``(H, W)`` in the order of their stamps."""
        for stamp, range_m in zip(self.stamp_s.tolist(), self._scans.range_m[:: self._every], strict=True):
            share = np.clip(range_m / self._range_max_m, 0.0, 1.0)
            grey = np.where(np.isfinite(share), 255.0 - 254.0 * np.nan_to_num(share), 0.0)
            yield Picture(stamp, np.round(grey).astype(np.uint8))


def simulated_recording(settings: ExperimentSettings, pictures: bool = False) -> Recording:
    """Fly and record: what `steelnb.experiment.run` would see of the same settings, and the truth apart.

    The poses are the drifting ones at every step of the simulator, so that those at the scans are the experiment's to
    the bit. Raises `CollisionError`.
    """
    flight, truth = experiment.simulate(settings)
    scans = cast(RangeScans, flight.scans)
    rows, columns = scans.range_m.shape[1:]
    facts = {
        "form": "simulated",
        "flight": f"{settings.flight.trajectory}, noise {settings.noise_name}, seed {settings.seed}",
        "sensor": f"{settings.sensor}, {columns} x {rows}",
    }
    return Recording(
        path=Path(f"{settings.flight.trajectory}-{settings.seed}"),
        scans=HeldScans(scans, scans.stamp_s),
        poses=drifting(truth.trajectory, settings.noise, settings.seed),
        T_drone_sensor=flight.T_drone_sensor,
        imu=flight.imu,
        truth=truth.trajectory,
        pictures=RangePictures(scans, settings.tof.range_max_m) if pictures else None,
        facts=facts,
    )


def record(
    path: Path | str,
    settings: ExperimentSettings,
    form: str | None = None,
    pictures: bool = False,
    on_progress: Callable[[float, str], None] | None = None,
) -> Recording:
    """Simulate a flight and save it; the truth goes to ``STEM.truth.tum``. ``on_progress`` gets a share, and of what.

    Where nothing can be written is said before anything is flown. Raises `OutputError`, `UnsupportedFormatError`,
    `SettingsError` for less than a second, and `CollisionError`.
    """
    path, say = Path(path), on_progress or (lambda share, what: None)
    if settings.flight.duration_s < DURATION_MIN_S:
        raise SettingsError(f"duration = {settings.flight.duration_s:g}: expected at least {DURATION_MIN_S:g} s")
    form_to_write(path, form)
    if path.is_file():
        raise OutputError(f"{path}: exists already; expected a new name")
    place = next(folder for folder in path.absolute().parents if folder.exists())
    if not place.is_dir() or not os.access(place, os.W_OK):
        raise OutputError(f"{path}: cannot be written: {place} is no folder that can be written to")
    say(0.0, f"flying {settings.flight.duration_s:g} s")
    recording = simulated_recording(settings, pictures)
    save_recording(path, recording, form, lambda share: say(share, "writing"))
    return recording
