"""Frames of the scans of a recording: each scan by its own frame, all given in one frame of the sensor."""

import re
from collections import Counter
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from steelnb.core.errors import InputError
from steelnb.core.geometry import transform_points
from steelnb.core.types import Array
from steelnb.io.frame_names import are_of_two, is_world_name
from steelnb.io.pose_rows import LEVEL, UPRIGHT, heights_of_z
from steelnb.io.transforms import Placement, Tree

T_OPTICAL_SENSOR = np.array([[0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1.0]])
"""Rotation from x forward, y left, z up to optical axes: z forward, x right, y down (REP 103)."""
T_UP_DOWN = np.diag([1.0, -1.0, -1.0, 1.0])
"""Rotation between axes with z down and y right (NED, FRD) and those with z up and y left (REP 103)."""
ALIGNED = 0.9
"""Minimum cosine between the axes of a frame and those of the drone, if they are meant to be the same."""
Z_MIN = 0.45
"""Minimum height of the z axis by which a pitched frame that is not called a link has x ahead: a camera with optical
axes on its side, which looks up by less, has y level, too."""
MOUNT_MAX_M = 10.0
"""Maximum distance of a sensor from the middle of its drone."""
OPTICAL_ENDS = ("optical", "frame", "link", "center", "centre")
"""Last words of the name of a frame with optical axes; an optical_flow_link or an optical_mount has others."""


class Frames(NamedTuple):
    """``T_drone_sensor (4, 4)``, the mount of all scans; ``stamp_s (N,)`` of the scans, NaN where nothing is known.

    ``T_sensor_scan (N, 4, 4)`` gives a scan in the frame of that mount where ``moved (N,)``, after its optical axes
    have been turned where ``optical (N,)``. ``source``: of the mount; ``chain``: frames from the world to the sensor;
    ``notes`` on what is unusual; all in words.
    """

    T_drone_sensor: Array
    stamp_s: Array
    T_sensor_scan: Array
    moved: NDArray[np.bool_]
    optical: NDArray[np.bool_]
    source: str
    chain: str
    notes: tuple[str, ...]

    def convert(self, points: Array, number: int) -> Array:
        """Points ``(..., 3)`` of a scan in the frame of the mount."""
        if self.optical[number]:
            points = points @ T_OPTICAL_SENSOR[:3, :3]
        if self.moved[number]:
            points = transform_points(self.T_sensor_scan[number], points)
        return points


def sensor_frames(
    tree: Tree, world: str, body: str, names: Sequence[str], stamp_s: Array, is_depth: bool, mount: Array | None
) -> Frames:
    """Frames of scans in the frames ``names`` at ``stamp_s (N,)``, on the drone's frame ``body``.

    ``is_depth``: depth images, whose axes are optical whatever the name of their frame. ``mount``: `T_drone_sensor` if
    the user gives it. Raises `InputError`.
    """
    frame, used = np.array(names, dtype=object), ~np.isnan(stamp_s)
    optical = np.array([is_depth or is_optical(name) for name in names])
    seen, notes = [name for name, _ in Counter(frame[used].tolist()).most_common()], list[str]()
    T_drone_scan, known = np.tile(np.eye(4), (len(frame), 1, 1)), np.zeros(len(frame), bool)
    placed: dict[str, Placement] = {}
    for name in seen:
        at = np.flatnonzero((frame == name) & used)
        found = tree.place(body, tree.resolve(name, body), stamp_s[at])
        if found is not None and mount is None:
            placed[name] = found
            T_drone_frame = np.linalg.inv(drone_axes(body)) @ found.T_target_source
            ahead, why = _ahead(name, T_drone_frame) if is_depth and not is_optical(name) else ("z", "")
            if why:  # REP 103: axes are optical only if the name says so
                notes.append(
                    f"depth images are in {name}, which {why} and is not optical by its name: {ahead} is ahead"
                )
            turn = np.eye(4) if ahead == "x" or not optical[at[0]] else T_OPTICAL_SENSOR
            T_drone_scan[at], known[at] = T_drone_frame @ turn, found.known
    main = next(iter(placed), seen[0])
    others = [name for name in seen if name not in placed and name != main]
    if mount is not None and len(seen) > 1:
        raise InputError(f"scans in frames {', '.join(seen)}: one mount does not hold for all; expected tf_static")
    way = tree.between(world, body) if world else None
    if way and tree.is_static(way) and not is_world_name(world):
        notes.append(f"poses are in {world}, a frame of the drone itself: they are taken for poses in the world")
        way = [body]
    chain = [*(way or filter(None, (world, body)))]
    if main not in placed:
        known[frame == main] = True
        T_mount, source = np.eye(4) if mount is None else mount, "as given"
        if mount is None:
            _check_unplaced(body, main)
            source = f"no tf_static from {body} to {main or 'the sensor'}: identity assumed"
            if parents := [each for each in tree.above(tree.resolve(main, body)) if each != main]:
                unrelated = f"nothing relates {body} to {parents[0]}: identity assumed"
                notes.append(f"{parents[0]} → {main} is known, but {unrelated}")
        chain, moved = [*chain, f"{main or 'the sensor'} ({source.rpartition(': ')[2]})"], np.zeros(len(frame), bool)
    else:
        is_world = _is_of_world(tree, world, placed[main].frames)
        first = np.flatnonzero((frame == main) & known)[:1]
        T_mount = np.eye(4) if is_world or not len(first) else T_drone_scan[first[0]]
        source = _source(tree, body, main, placed[main], is_world)
        moved = (T_drone_scan != T_mount).any(axis=(1, 2))
        chain += [f"{main}, by the poses"] if is_world else placed[main].frames[1:]
    if (far_m := float(np.linalg.norm(T_mount[:3, 3]))) > MOUNT_MAX_M:
        notes.append(f"{main} is {far_m:.4g} m from {body}; expected the place of a sensor on a drone, in metres")
    for other, T in dict(tree.contradictions(body, tree.resolve(main, body)) if main in placed else ()).items():
        notes.append(
            f"tf_static has two ways from {body} to {main}, {np.linalg.norm(T[:3, 3]):.2g} m and "
            f"{np.degrees(Rotation.from_matrix(T[:3, :3]).magnitude()):.1f}° apart; the shorter is used, not "
            f"{' → '.join(other)}"
        )
    more = [name for name in placed if name != main]
    notes += [f"scans are in frames {', '.join([main, *more])}; all are given in that of {main}"] if more else []
    notes += [f"scans in {', '.join(map(repr, others))} are left out: no transform to {main}"] if others else []
    stamps = np.where(known, stamp_s, np.nan)
    T_sensor_scan = np.linalg.inv(T_mount) @ T_drone_scan
    return Frames(T_mount, stamps, T_sensor_scan, moved, optical, source, " → ".join(chain), tuple(notes))


def _check_unplaced(body: str, name: str) -> None:
    """Raise `InputError` if a frame that nothing relates to the drone cannot be the sensor's by its name."""
    if is_world_name(name):
        why = f"scans are in {name!r}, a frame of the world, which nothing relates to {body!r}"
        raise InputError(f"{why}; expected scans in the frame of the sensor, or --mount if they are")
    if are_of_two(body, name):
        why = f"scans are in {name!r}, poses of {body!r}, and nothing relates them: of two drones by their names"
        raise InputError(f"{why}; expected those of one, or --mount")


def _ahead(name: str, T_drone_frame: Array) -> tuple[str, str]:
    """The axis of a depth camera's frame ``(N, 4, 4)`` that is ahead, if its name does not say that it is optical, and
    why, if that is to be noted.

    It is x if the frame stands upright and is called a link or aligned with the drone, or if it is pitched, which
    leaves y level and z above the horizontal. Of optical axes, x is level.
    """
    is_link = bool({"link", "base", "body"} & set(_words(name)))
    if T_drone_frame[0, 2, 2] > UPRIGHT and (is_link or np.diag(T_drone_frame[0])[:3].min() > ALIGNED):
        return "x", "stands upright"
    x, y = np.median(np.abs(T_drone_frame[:, 2, :2]), axis=0)
    z_min = -LEVEL if is_link else Z_MIN
    if y < LEVEL < x and np.median(T_drone_frame[:, 2, 2]) > z_min:
        return "x", "is level along y"
    return "z", "does not stand upright" if is_link and not x < LEVEL < y else ""


def _is_of_world(tree: Tree, world: str, frames: tuple[str, ...]) -> bool:
    """Whether the way from the drone to the scans leads to the world, so that their points are in it; not if the drone
    itself is given as the world, or a frame fixed to it.

    Raises `InputError` if it leads on to something else that moves.
    """
    if world not in frames or (tree.is_static(frames[: frames.index(world) + 1]) and not is_world_name(world)):
        return tree.moves(frames) and frames[-1] in tree.above(frames[0])
    beyond = list(frames[frames.index(world) :])
    if tree.moves(beyond) and beyond[-1] not in tree.above(world):
        other = f"--poses '{world}>{beyond[1]}'"
        raise InputError(f"poses are of {frames[0]}, but {frames[-1]} moves without it; expected its own ({other})")
    return True


def _source(tree: Tree, body: str, name: str, placed: Placement, is_world: bool) -> str:
    """Where the mount comes from, in words."""
    if is_world:
        return f"points are in {name}, brought back to {body} by the poses: identity"
    if len(placed.frames) == 1:
        return f"scans are in the drone's frame {body}"
    if placed.moves:
        return f"tf {body} → {name} moves: points are given where it is at the first scan"
    return f"{'tf_static' if tree.is_static(placed.frames) else 'tf'} {body} → {name}"


def drone_axes(frame: str) -> Array:
    """Rotation ``(4, 4)`` from the drone's axes to a frame's, by its name (REP 103): optical axes, or z down and y
    right (frd, ned); else the identity."""
    return T_OPTICAL_SENSOR if is_optical(frame) else world_axes(frame)


def world_axes(frame: str) -> Array:
    """Rotation ``(4, 4)`` from the axes of a frame of the world to those with z up, by its name (ned, frd)."""
    words = _words(frame)
    return T_UP_DOWN if {"ned", "frd"} & {*words} and "enu" not in words else np.eye(4)


def is_optical(frame: str) -> bool:
    """Whether a frame has optical axes by its name."""
    words = _words(frame)
    return "optical" in words[-2:] and words[-1] in OPTICAL_ENDS


def note_on_rotations(T_world_drone: Array) -> str:
    """Note if a drone with poses ``(N, 4, 4)`` is upright only if quaternions are read as w, x, y, z, or if the poses
    are those of optical axes or of axes with z down."""
    q = Rotation.from_matrix(T_world_drone[:, :3, :3]).as_quat()
    up, up_if_w_first = heights_of_z(q)
    if np.median(up) > UPRIGHT:
        return ""
    if np.quantile(up_if_w_first, 0.1) > UPRIGHT:
        return "the drone hangs upside down, unless quaternions are w, x, y, z; they are read as x, y, z, w"
    if np.quantile((T_world_drone @ T_OPTICAL_SENSOR)[:, 2, 2], 0.1) > UPRIGHT:
        own = "--mount 0,0,0,90,-90,0 if scans are its own"
        return f"the drone lies on its side, unless poses are those of a camera with optical axes ({own})"
    hangs = np.quantile(-up, 0.1) > UPRIGHT
    return "the drone hangs upside down, unless its axes have z down; expected z up" if hangs else ""


def _words(frame: str) -> list[str]:
    """The words of a frame's name without its namespace, in lower case: of camera_optical_link and CameraOpticalLink0,
    camera, optical and link."""
    return [word.lower() for word in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", frame.rpartition("/")[2])]
