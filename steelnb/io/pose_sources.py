"""Where the poses of the drone come from: a topic, transforms or a file."""

import os
import re
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from steelnb.core.errors import InputError
from steelnb.core.types import Array, Trajectory
from steelnb.io import messages as ros
from steelnb.io.containers import Container
from steelnb.io.folders import TRAJECTORIES
from steelnb.io.frame_names import is_world_name, namespace, own_name
from steelnb.io.headers import Headers
from steelnb.io.transforms import Tree

POSES_MIN = 3
"""A topic with fewer poses may be a goal or a start."""
GOALS, GOALS_OF_POSES = {"setpoint"}, {"goal", "target", "command", "cmd", "reference", "desired"}
"""Words in the names of topics of where a drone should be; the second only in those of PoseStamped, since an odometry
is measured."""
OF_GOAL = "of a goal by its name"
REACH_MIN_M, STILL, MOVING_SHARE, REACHES = 1.0, 1e-3, 0.5, (0.5, 2.0)
"""Poses on a topic are not the drone's if none of their numbers changes by `STILL`, as of wheels that stand, while
those on tf reach farther than `REACH_MIN_M`, and change in more than `MOVING_SHARE` of their steps: a correction
changes only a few. `REACHES`: bounds of the ratio of the two reaches, beyond which both are noted."""
MOVING_TF, STILL_TF = "tf", "tf_static"
GRID = 200
"""Number of stamps at which two paths are compared."""


class PoseSource(NamedTuple):
    """Where the poses of the drone come from: a trajectory ``file``; or transforms, which ``uses_tf`` says, between
    the ``pair`` of world and drone if it is named; or the only one of ``topics``. ``tf``: topics of transforms;
    ``is_named``: the user chose it; ``is_goal``: its name is that of a goal; ``notes``: which others are left out."""

    tf: tuple[str, ...]
    uses_tf: bool = False
    topics: tuple[str, ...] = ()
    file: str = ""
    pair: tuple[str, str] | None = None
    is_named: bool = False
    is_goal: bool = False
    notes: tuple[str, ...] = ()


def pose_source(bag: Container, name: str | None, scans: str) -> PoseSource:
    """The source of the poses for the topic of the scans. Raises `InputError`.

    By default the only topic of Odometry or PoseStamped, else tf, else the only one of another type with poses. Left
    out are topics of goals by their names, and those with one or two poses for many scans; see also `settled`.
    """
    tf = _transforms(bag, scans)
    first, notes = bag.of_type(ros.ODOMETRY, ros.POSE_STAMPED), list[str]()
    others = bag.of_type(ros.POSE_COVARIANCE, ros.TRANSFORM, ros.PATH)
    if name is None:
        few = [topic for topic in first if bag.count(topic) < POSES_MIN and 2 * bag.count(topic) < bag.count(scans)]
        goals = [topic for topic in first if topic not in few and _is_goal(bag, topic)]
        if few and (tf or len(few) < len(first)):
            notes += [f"poses of {topic} are left out: {bag.count(topic)} of them" for topic in few]
            first = [topic for topic in first if topic not in few]
        if goals and len(goals) < len(first):
            notes += [_left_out(topic, OF_GOAL) for topic in goals]
            first = [topic for topic in first if topic not in goals]
    if name in bag.of_type(*ros.TF):
        still = [topic for topic in _transforms(bag, name) if own_name(topic) == STILL_TF]
        return PoseSource((name, *(topic for topic in still if topic != name)), uses_tf=True)
    if name and name not in bag.types:
        if os.path.isfile(name):  # Path.is_file raises for a name that is too long
            return PoseSource(tf, file=name)
        if pair := re.fullmatch(r"(?:tf )?\s*/?([^>→]+?)\s*(?:-?>|→)\s*/?([^>→]+?)\s*", name):
            objects = tuple(bag.of_type(ros.ODOMETRY, ros.POSE_STAMPED, ros.POSE_COVARIANCE, ros.TRANSFORM))
            return PoseSource(tf, uses_tf=True, topics=objects, pair=(pair[1], pair[2]))
    if name and name not in bag.types and os.path.splitext(name)[1].lower() in TRAJECTORIES:
        raise InputError(f"no topic and no file {name!r}; expected a topic of poses, or a trajectory")
    if name is not None or first:
        topic = bag.choose("poses", name, [*first, *others] if name is not None else first)
        return PoseSource(tf, False, (topic,), "", None, name is not None, _is_goal(bag, topic), tuple(notes))
    if tf:
        return PoseSource(tf, uses_tf=True, topics=tuple(others) if len(others) == 1 else (), notes=tuple(notes))
    return PoseSource(tf, topics=(bag.choose("poses", None, others),), notes=tuple(notes))


def _transforms(bag: Container, near: str) -> tuple[str, ...]:
    """The topics of transforms for a topic: of several namespaces its own, since drones have frames alike; and of other
    names, such as the /tf_old of a program that was run again, none if there is the usual one."""
    found, every = list[str](), bag.of_type(*ros.TF)
    for own in (MOVING_TF, STILL_TF):
        named = [topic for topic in every if own_name(topic) == own]
        found += [topic for topic in named if near.startswith(f"{namespace(topic)}/")] or named
    others = [topic for topic in every if own_name(topic) not in (MOVING_TF, STILL_TF)]
    return tuple(found) if any(own_name(topic) == MOVING_TF for topic in found) else (*found, *others)


def settled(source: PoseSource, headers: Headers, tree: Tree, sensor: str) -> PoseSource:
    """The source when the transforms are known.

    If these lead from a world to a drone that carries the sensor, they replace the only topic if this is of a goal by
    its name, if its poses are in a frame between drone and sensor, as of a marker, or if they stay while it moves.
    Raises `InputError` if nothing moves but what has no stamps.
    """
    moves = any(edge.moves for edge in tree.edges.values())
    if source.uses_tf and not source.topics and headers.unstamped and not moves:
        try:
            tree.drone(sensor)
        except InputError:
            text = next(iter(headers.unstamped.values()))
            raise InputError(f"{text}; expected the time of each (--clock bag: of recording)") from None
    topic = "" if source.uses_tf or source.is_named else next(iter(source.topics), "")
    objects = [*headers.objects(topic)] if topic else []
    found = _carried(tree, sensor, tree.resolve(objects[0][0], sensor)) if len(objects) == 1 else None
    if found is None:
        return source
    (world, body, path), (frame, child) = found, objects[0]
    child, frame = tree.resolve(child, sensor), tree.resolve(frame, sensor)
    if child not in ("", body) and tree.fixed().between(child, body) is None:
        return source
    rows = headers.rows_of(topic, objects[0], 7)
    own_m, tf_m, apart_m = _compared(rows[:, [0, 2, 3, 4]], np.column_stack([path.stamp_s, path.position]))
    why = ""
    if source.is_goal:
        why = OF_GOAL
    elif not child and not is_world_name(frame) and frame != body and body in tree.above(frame):
        why = f"they are in {frame}, which moves with {body}"
    elif not child and frame == body and apart_m > REACH_MIN_M:
        why = f"they are in {body} itself, and {apart_m:.2g} m from it on tf"
    elif tf_m > REACH_MIN_M and np.ptp(rows[:, 2:], axis=0).max() < STILL:
        steps_m = np.linalg.norm(np.diff(path.position, axis=0), axis=1)
        moves_on = (steps_m > 0.1 * STILL).mean() > MOVING_SHARE
        why = f"they stay, and {body} moves by {tf_m:.2g} m on tf" if moves_on else ""
    if why:
        return PoseSource(source.tf, uses_tf=True, notes=(*source.notes, _left_out(topic, why)))
    note = ""
    if max(own_m, tf_m) > REACH_MIN_M and not REACHES[0] < own_m / max(tf_m, STILL) < REACHES[1]:
        note = f"poses of {topic} reach {own_m:.2g} m, those of tf {tf_m:.2g} m"
    elif apart_m > REACH_MIN_M and (frame == world or frame not in tree.frames):
        note = f"poses of {topic} are {apart_m:.2g} m from those of tf"
    return source._replace(notes=(*source.notes, f"{note} (--poses '{world}>{body}' takes these)")) if note else source


def drone_on_tf(tree: Tree, sensor: str, note: Callable[[str], None]) -> tuple[str, str]:
    """World and frame of the drone that carries the sensor, with a note if the transform is sent the other way. Raises
    `InputError` with the choices."""
    world, body = tree.drone(sensor)
    if (body, world) in tree.edges:
        note(f"{body} → {world} on tf is an odometry sent inverted: it is read as {body} in {world}")
    return world, body


def _carried(tree: Tree, sensor: str, frame: str) -> tuple[str, str, Trajectory] | None:
    """World, frame and poses of the drone that carries the sensor on tf; None if there is none, or the world has no
    usual name. The world is ``frame`` if it is one: odom may move in a map that is corrected."""
    if sensor not in tree.frames or not any(edge.moves for edge in tree.edges.values()):
        return None
    try:
        world, body = tree.drone(sensor)
        if not is_world_name(world) or is_world_name(body) or body not in tree.above(sensor):
            return None
        world = frame if is_world_name(frame) and frame in tree.above(body) else world
        return world, body, tree.poses(world, body)
    except InputError:
        return None


def _compared(*paths: Array) -> tuple[float, float, float]:
    """How far each of two paths, rows ``(N, 4)`` of stamp and position, reaches in 90 % of the time that both share,
    and their median distance; NaN if that is unknown."""
    whole = [path[np.isfinite(path).all(axis=1)] for path in paths]
    begin_s = max(path[:, 0].min(initial=np.inf) for path in whole)
    end_s = min(path[:, 0].max(initial=-np.inf) for path in whole)
    if min(map(len, whole)) < POSES_MIN or not begin_s < end_s:
        return np.nan, np.nan, np.nan
    stamp_s = np.linspace(begin_s, end_s, GRID)
    sorted_paths = [path[np.argsort(path[:, 0], kind="stable")] for path in whole]
    shared = [[np.interp(stamp_s, path[:, 0], axis) for axis in path[:, 1:].T] for path in sorted_paths]
    own_m, other_m = (float(np.linalg.norm(np.subtract(*np.quantile(each, [0.95, 0.05], axis=1)))) for each in shared)
    return own_m, other_m, float(np.median(np.linalg.norm(np.subtract(shared[0], shared[1]), axis=0)))


def _is_goal(bag: Container, topic: str) -> bool:
    """Whether the words of a topic's name are those of where a drone should be."""
    words = {word.lower().rstrip("s") for word in re.findall("[A-Z]?[a-z]+|[A-Z]+", topic)}
    return bool(words & (GOALS | (GOALS_OF_POSES if bag.types[topic] == ros.POSE_STAMPED else set())))


def _left_out(topic: str, why: str) -> str:
    return f"poses of {topic} are left out: {why} (--poses {topic} takes them)"
