"""A flight on a timeline in one .rrd file, which ``rerun FILE`` plays."""

import os
import shutil
import threading
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from steelnb.errors import OutputError, needs
from steelnb.types import Array, Estimate, Flight, IntArray, OdometryStep, Scan, Segments, Trajectory

if TYPE_CHECKING:
    from rerun.blueprint import Blueprint

SCAN_POINTS_MAX, MAP_POINTS_MAX = 2000, 20_000
"""Points of a scan and of a map: a flight of 200 s at 5 Hz stays at 25 MB."""
MAP_PERIOD_S = 5.0
FAR_M = 10_000.0
"""Viewers compute in single precision: beyond, coordinates are counted from where the flight begins."""
EPOCH_S = 1e8
"""Stamps beyond it (1973) are shown as dates."""
TRACKS = {"true": ((0, 0, 0), 2.0), "drifting": ((213, 94, 0), 3.0), "corrected": ((0, 114, 178), 5.0)}
"""Colour and width in pixels: the corrected trajectory lies on the true one where all is well, and both are seen."""
BARS, SCAN, CLOUD = (0, 158, 115), (230, 159, 0), (138, 148, 166)
GOLDEN = (5**0.5 - 1) / 2


class Log:
    """An .rrd file written while a flight is corrected; a context manager. Memory does not grow with the flight.

    Entities: ``world/drone`` and ``world/scan`` a scan; ``world/map`` and ``world/bars`` now and then; and at the end
    the trajectories ``world/true``, ``world/drifting`` and ``world/corrected`` and, at each scan, ``error/…``, their
    distance to the truth in metres, and ``matches``. Positions are metres in the world frame, less ``origin (3,)``.

    Raises `OutputError` on entering where nothing can be written, and later where the disk is full.
    """

    def __init__(self, path: Path, flight: Flight) -> None:
        self._path, self._flight = path, flight
        first = flight.prior.position[0]
        self.origin = np.round(first) if np.abs(first).max() > FAR_M else np.zeros(3)
        self._map_stamp_s = -np.inf

    def __enter__(self) -> Self:
        with needs("io"):
            import rerun as rr

        self._out = rr.RecordingStream("steelnb")
        self._out.set_log_time_enabled(False)
        self._out.set_log_tick_enabled(False)
        try:
            self._drain = _Drain(self._path)
            self._out.save(self._drain.entry)
        except OSError as fault:
            raise OutputError(f"{self._path}: cannot be written: {fault.strerror or fault}") from None
        self._out.send_recording_name(self._flight.name)
        self._out.send_blueprint(_blueprint())
        self._out.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._out.log("world/drone", rr.TransformAxes3D(0.6), static=True)
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, tb: TracebackType | None) -> None:
        self._out.disconnect()
        self._drain.close()
        if fault is None:
            self._check()

    def step(self, scan: Scan, step: OdometryStep) -> None:
        """Log a scan and the drone at the corrected pose."""
        import rerun as rr

        self._check()
        self._out.set_time("stamp", **_time(scan.stamp_s))
        points = scan.points.reshape(-1, 3)
        points = thinned(points[np.isfinite(points).all(axis=1)], SCAN_POINTS_MAX)
        T_world_sensor = step.T_world_drone @ self._flight.T_drone_sensor
        world = self._single(points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3])
        self._out.log("world/scan", rr.Points3D(world, colors=[SCAN], radii=[_pixels(3)]))
        place = self._single(step.T_world_drone[:3, 3])
        self._out.log("world/drone", rr.Transform3D(translation=place, mat3x3=step.T_world_drone[:3, :3]))

    def map_due(self, stamp_s: float) -> bool:
        """Whether the last map is older than `MAP_PERIOD_S`."""
        return stamp_s - self._map_stamp_s >= MAP_PERIOD_S

    def map(self, stamp_s: float, points: Array, segments: Segments) -> None:
        """Log a map: at most `MAP_POINTS_MAX` of ``points (N, 3)``, and segments, in the world frame."""
        import rerun as rr

        self._out.set_time("stamp", **_time(stamp_s))
        self._map_stamp_s = stamp_s
        cloud = self._single(thinned(points[np.isfinite(points).all(axis=1)], MAP_POINTS_MAX))
        self._out.log("world/map", rr.Points3D(cloud, colors=[CLOUD], radii=[_pixels(2)]))
        bars = self._single(np.stack([segments.start, segments.end], axis=1))
        self._out.log("world/bars", rr.LineStrips3D(bars, colors=[BARS], radii=[_pixels(3)]))

    def finish(self, estimate: Estimate, truth: Trajectory | None) -> None:
        """Log trajectories, matches, and errors at the poses of ``truth``."""
        import rerun as rr

        tracks = {"true": truth, "drifting": estimate.prior, "corrected": estimate.corrected}
        for name, track in tracks.items():
            if track is None:
                continue
            colour, width = TRACKS[name]
            line = rr.LineStrips3D([self._single(track.position)], colors=[colour], radii=[_pixels(width)])
            self._out.log(f"world/{name}", line, static=True)
            if truth is not None and name != "true":
                error_m = np.linalg.norm(track.at(truth.stamp_s).position - truth.position, axis=1)
                self._series(f"error/{name}", truth.stamp_s, error_m, colour)
        self._series("matches", estimate.prior.stamp_s, estimate.matches, BARS)

    def _series(self, name: str, stamp_s: Array, values: Array | IntArray, colour: tuple[int, int, int]) -> None:
        import rerun as rr

        self._out.log(name, rr.SeriesLines(colors=[colour], names=[name], widths=[2]), static=True)
        times = rr.TimeColumn("stamp", **_time(stamp_s))
        self._out.send_columns(name, indexes=[times], columns=rr.Scalars.columns(scalars=values.astype(float)))

    def _single(self, positions: Array) -> NDArray[np.float32]:
        """Positions ``(..., 3)`` for the viewer."""
        return (positions - self.origin).astype(np.float32)

    def _check(self) -> None:
        if (fault := self._drain.fault) is not None:
            raise OutputError(f"{self._path}: cannot be written: {fault.strerror or fault}")


class _Drain:
    """A named pipe that rerun writes to, and a thread that carries its bytes to a new file.

    rerun reports no full disk, and a process whose disk was full may never end. Behind a pipe its writes always
    succeed, and ``fault`` is the error of the disk. Raises OSError where file or pipe cannot be made.
    """

    def __init__(self, file: Path) -> None:
        self.fault: OSError | None = None
        self._file = file.open("xb")
        self.entry = file.with_name(f"{file.name}.pipe")
        os.mkfifo(self.entry)
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()

    def _carry(self) -> None:
        with self.entry.open("rb", buffering=0) as source:
            try:
                with self._file:
                    shutil.copyfileobj(source, self._file, 1 << 16)
            except OSError as fault:
                self.fault = fault
            while source.read(1 << 16):  # the writer shall not wait
                pass

    def close(self) -> None:
        """Wait until all is on the disk; the writer has closed its end by now."""
        self._thread.join()
        self.entry.unlink()


def thinned(points: Array, points_max: int) -> Array:
    """At most so many of the points ``(N, 3)``, evenly taken, and not in step with the rows of an image."""
    if len(points) <= points_max:
        return points
    order = np.arange(len(points)) * GOLDEN % 1.0
    return points[order < np.partition(order, points_max)[points_max]]


def _blueprint() -> "Blueprint":
    """The flight in space at the left, errors and matches over time at its right."""
    import rerun.blueprint as rrb

    space = rrb.Spatial3DView(origin="world", name="flight", background=(255, 255, 255))
    error = rrb.TimeSeriesView(origin="error", name="distance to the truth (m)")
    matches = rrb.TimeSeriesView(origin="matches", name="pairs that corrected the pose")
    layout = rrb.Horizontal(space, rrb.Vertical(error, matches), column_shares=[2, 1])
    return rrb.Blueprint(layout, rrb.TimePanel(timeline="stamp"), collapse_panels=True, auto_views=False)


def _time(stamp_s: float | Array) -> dict[str, Any]:
    """Stamps as rerun takes them: dates, or seconds from the start of a flight."""
    return {"timestamp" if np.max(stamp_s) > EPOCH_S else "duration": stamp_s}


def _pixels(width: float) -> float:
    """A width on the screen as rerun writes it: radii below zero are pixels, others metres."""
    return -width / 2
