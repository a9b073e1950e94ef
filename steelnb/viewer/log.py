"""A flight, frame by frame → one .rrd file with a timeline, which rerun's viewers play."""

import contextlib
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

from steelnb.datatypes import Array, OdometryStep, Segments
from steelnb.errors import OutputError
from steelnb.recordings import new_folder
from steelnb.recordings.recording import Picture
from steelnb.viewer.drain import Drain
from steelnb.viewer.layout import BARS, CLOUD, SCAN, TIMELINE, TRACKS, WIDTHS, layout, rgb

if TYPE_CHECKING:
    from rerun import Points3D, RecordingStream

SCAN_POINTS_MAX = 2000
"""Points of one scan: a flight of 200 s at 5 Hz stays at 25 MB, and a bar is still told from another."""
MAP_POINTS_MAX = 20_000
MAP_PERIOD_S = 5.0
FAR_M = 10_000.0
"""Viewers compute in single precision: beyond, coordinates are counted from where the flight begins."""
EPOCH_S = 1e8
"""Stamps beyond it (1973) are of the calendar, as bags have them; others count from the start of a flight."""
JPEG_QUALITY = 80
GOLDEN = (5**0.5 - 1) / 2
AXES_M = 0.6
"""Of the cross that shows how the drone is turned."""


class Log:
    """One .rrd file, written while a flight goes on; used as a context manager.

    The file is written beside ``path`` and renamed at the end; nothing stays where an error, Ctrl-C included, came in
    between. What is logged goes to the disk at once, so memory does not grow with the flight.

    Entities: ``world/drone``; ``world/scan``, the sensor's points at that pose; ``world/map``; ``world/bars``; the
    trajectories ``world/true``, ``world/drifting`` and ``world/corrected``; ``error/…``, their distance to the truth in
    metres; ``matches``; ``camera``; and ``range``, the scan as a picture, where it is organised. Positions are metres
    in the world frame, single precision, less `origin`.

    Raises `OutputError` on entering where nothing can be written, and on leaving where the disk was full.
    """

    def __init__(self, path: Path | str, name: str, T_drone_sensor: Array) -> None:
        self.path, self.name, self.T_drone_sensor = Path(path).absolute(), name, T_drone_sensor
        self.origin = np.zeros(3)
        """What is taken off all positions ``(3,)``: zero, but for flights far from the origin of the world."""
        self._stack = contextlib.ExitStack()
        self._stream: RecordingStream | None = None
        self._placed = False
        self._last: dict[str, Array] = {}
        self._map_stamp_s = -np.inf
        self._waiting: tuple[float, Array | None, Segments | None] | None = None
        self._views: tuple[str, ...] = ()
        self._range_max_m = 0.0

    def __enter__(self) -> Self:
        import rerun as rr

        if self.path.is_dir():
            raise OutputError(f"{self.path}: is a folder; expected the name of a file")
        folder = self._stack.enter_context(new_folder(self.path.parent))
        stream = rr.RecordingStream("steelnb")
        stream.set_log_time_enabled(False)
        stream.set_log_tick_enabled(False)
        try:
            self._drain = Drain(folder / self.path.name)
            stream.save(self._drain.entry)
        except OSError as fault:
            self._stack.close()
            raise OutputError(f"{self.path}: cannot be written: {fault.strerror or fault}") from None
        self._stream = stream
        stream.send_recording_name(self.name)
        stream.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        for name, colour in TRACKS.items():
            stream.log(
                f"world/{name}",
                rr.LineStrips3D.from_fields(colors=[rgb(colour)], radii=[_pixels(WIDTHS[name])]),
                static=True,
            )
            if name != "true":
                series = rr.SeriesLines(colors=[rgb(colour)], names=[name], widths=[2])
                stream.log(f"error/{name}", series, static=True)
        stream.log("world/drone", rr.TransformAxes3D(AXES_M), static=True)
        stream.log("matches", rr.SeriesLines(colors=[rgb(BARS)], names=["pairs matched"], widths=[2]), static=True)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            if fault is None and self._waiting:
                self.map(*self._waiting)
            self._finish()
        except BaseException as other:
            if not self._stack.__exit__(type(other), other, other.__traceback__):
                raise
        else:
            self._stack.__exit__(kind, fault, trace)

    def map_due(self, stamp_s: float) -> bool:
        """Whether `frame` would log a map now: for callers to whom a map is work."""
        return stamp_s - self._map_stamp_s >= MAP_PERIOD_S

    def frame(
        self,
        stamp_s: float,
        points_sensor: Array,
        step: OdometryStep | None,
        T_world_drone_prior: Array,
        T_world_drone_true: Array | None = None,
        map_points: Array | None = None,
        segments: Segments | None = None,
        picture: Picture | NDArray[np.uint8] | None = None,
    ) -> None:
        """Log one scan ``(N, 3)`` or ``(H, W, 3)`` in the sensor frame, NaN for no return, and what came of it.

        ``step`` is None where nothing corrects; the drone is then shown at its prior pose. Maps ``(N, 3)`` and the
        segments of a map are in the world frame, and logged once in `MAP_PERIOD_S`, and the last given at the end.
        """
        import rerun as rr

        poses = {"true": T_world_drone_true, "drifting": T_world_drone_prior}
        poses["corrected"] = step.T_world_drone if step else None
        self._check()
        self._place(T_world_drone_prior[None, :3, 3])
        views = {"error": T_world_drone_true is not None, "matches": step is not None}
        self._show(*(name for name, given in views.items() if given))
        self._at(stamp_s)
        T_world_drone = T_world_drone_prior if step is None else step.T_world_drone
        self._log_scan(points_sensor, T_world_drone @ self.T_drone_sensor)
        pose = rr.Transform3D(translation=T_world_drone[:3, 3] - self.origin, mat3x3=T_world_drone[:3, :3])
        self._out.log("world/drone", pose)
        self._log_poses(poses, step)
        if picture is not None:
            self.picture(picture)
            self._at(stamp_s)
        if map_points is not None or segments is not None:
            self._waiting = (stamp_s, map_points, segments)
            if self.map_due(stamp_s):
                self.map(*self._waiting)

    def picture(self, picture: Picture | NDArray[np.uint8]) -> None:
        """Log one image of the camera, at its own stamp, or without one at that of the frame."""
        import rerun as rr

        pixels = picture.pixels if isinstance(picture, Picture) else picture
        self._show("camera")
        if isinstance(picture, Picture):
            self._at(picture.stamp_s)
        image = rr.Image(pixels, color_model="L" if pixels.ndim == 2 else "RGB")
        self._out.log("camera", image.compress(jpeg_quality=JPEG_QUALITY))

    def map(
        self,
        stamp_s: float,
        points: Array | None,
        segments: Segments | None = None,
        points_max: int = MAP_POINTS_MAX,
    ) -> None:
        """Log a map at once: at most ``points_max`` of ``points (N, 3)``, and segments, in the world frame."""
        import rerun as rr

        ends = None if segments is None else np.stack([segments.start, segments.end], axis=1)
        self._place(*(each.reshape(-1, 3) for each in (points, ends) if each is not None))
        self._show()
        self._at(stamp_s)
        self._map_stamp_s, self._waiting = stamp_s, None
        if points is not None:
            cloud = thinned(points[np.isfinite(points).all(axis=1)], points_max)
            self._out.log("world/map", self._cloud(cloud, CLOUD, 2))
        if ends is not None:
            bars = self._single(ends)
            self._out.log("world/bars", rr.LineStrips3D(bars, colors=[rgb(BARS)], radii=[_pixels(3)]))

    def _at(self, stamp_s: float) -> None:
        if stamp_s > EPOCH_S:
            self._out.set_time(TIMELINE, timestamp=stamp_s)
        else:
            self._out.set_time(TIMELINE, duration=stamp_s)

    @property
    def _out(self) -> "RecordingStream":
        if self._stream is None:
            raise ValueError("a Log is used within `with`")
        return self._stream

    def _show(self, *names: str) -> None:
        """Lay out what there is; again where something new comes in."""
        wanted = tuple(dict.fromkeys((*self._views, *names)))
        if wanted != self._views or not self._views:
            self._views = wanted
            self._out.send_blueprint(layout(wanted))

    def _log_scan(self, points_sensor: Array, T_world_sensor: Array) -> None:
        import rerun as rr

        points = points_sensor.reshape(-1, 3)
        points = thinned(points[np.isfinite(points).all(axis=1)], SCAN_POINTS_MAX)
        world = points @ T_world_sensor[:3, :3].T + T_world_sensor[:3, 3]
        self._out.log("world/scan", rr.Points3D(self._single(world), colors=[rgb(SCAN)], radii=[_pixels(3)]))
        if points_sensor.ndim == 3 and len(points):
            range_m = np.linalg.norm(points_sensor, axis=2)
            self._range_max_m = max(self._range_max_m, float(np.nanmax(range_m)))
            near = np.nan_to_num(255 * (1 - 0.9 * range_m / self._range_max_m)).astype(np.uint8)
            self._out.log("range", rr.Image(near, color_model="L").compress(jpeg_quality=JPEG_QUALITY))
            self._show("range")

    def _log_poses(self, poses: dict[str, Array | None], step: OdometryStep | None) -> None:
        import rerun as rr

        true = poses["true"]
        for name, T_world_drone in poses.items():
            if T_world_drone is None:
                self._last.pop(name, None)
                continue
            here = T_world_drone[:3, 3]
            way = np.stack([self._last.get(name, here), here])
            self._out.log(f"world/{name}", rr.LineStrips3D.from_fields(strips=[self._single(way)]))
            self._last[name] = here
            if true is not None and name != "true":
                self._out.log(f"error/{name}", rr.Scalars(float(np.linalg.norm(here - true[:3, 3]))))
        if step is not None:
            self._out.log("matches", rr.Scalars(float(step.matches)))

    def _cloud(self, points: Array, colour: str, width: float) -> "Points3D":
        import rerun as rr

        return rr.Points3D(self._single(points), colors=[rgb(colour)], radii=[_pixels(width)])

    def _place(self, *positions: Array) -> None:
        """Choose the origin by what comes first."""
        if self._placed or not any(map(len, positions)):
            return
        middle: Array = np.nanmean(np.concatenate(positions), axis=0)
        self._placed = True
        if np.abs(middle).max() > FAR_M:
            self.origin = np.round(middle)

    def _single(self, positions: Array) -> NDArray[np.float32]:
        return (positions - self.origin).astype(np.float32)

    def _finish(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.disconnect()
            self._drain.close()
            self._check()

    def _check(self) -> None:
        if self._drain.fault is not None:
            fault = self._drain.fault
            raise OutputError(f"{self.path}: cannot be written: {fault.strerror or fault}")


def thinned(points: Array, points_max: int) -> Array:
    """At most so many of the points ``(N, 3)``, evenly taken, and not in step with the rows of an image."""
    if len(points) <= points_max:
        return points
    order = np.arange(len(points)) * GOLDEN % 1.0
    return points[order < np.partition(order, points_max)[points_max]]


def _pixels(width: float) -> float:
    """A width on the screen as rerun writes it: radii below zero are pixels, others metres."""
    return -width / 2
