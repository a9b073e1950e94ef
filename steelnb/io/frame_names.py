"""Names of frames: namespaces, and the usual names of the drone and of its worlds."""

import re

from steelnb.core.errors import InputError

WORLDS = ("odom", "world", "map", "camera_init")
"""Usual names of the frame of poses, the preferred first (REP 105): poses in odom drift but do not jump."""
BODIES = ("base_link", "body", "base", "fcu", "base_footprint")
"""Usual names of the drone's frame, the preferred first (REP 105)."""


def own_name(frame: str) -> str:
    """Name of a frame without its namespace."""
    return frame.rpartition("/")[2]


def namespace(frame: str) -> str:
    """Namespace of a frame."""
    return frame.rpartition("/")[0]


def are_of_two(one: str, other: str) -> bool:
    """Whether two frames are of two drones by their names, as uav1/base_link and uav2/tof, or uav1_base_link and
    uav2_tof; of cam1_link and cam2_link, no name is a drone's."""
    found = [re.match(r"[^/]+(?=/)|[A-Za-z]+_?\d+(?=_)", each) for each in (one, other)]
    spaces = {each[0] for each in found if each}
    are_alike = len(spaces) == 2 and len({re.sub(r"[\d_]", "", each) for each in spaces}) == 1
    return are_alike and (("/" in one and "/" in other) or one.endswith(BODIES) or other.endswith(BODIES))


def check_order(world: str, body: str) -> tuple[str, str]:
    """Both names, the drone's empty if it is the world's, which tells nothing. Raises `InputError` if the world has the
    usual name of a drone, and the drone that of a world."""
    if is_body_name(world) and is_world_name(body):
        expected = f"those of the drone in the world, as from tf by --poses '{body}>{world}'"
        raise InputError(f"poses of {body!r} in {world!r}: expected {expected}")
    return world, "" if body == world else body


def is_inverted(world: str, body: str) -> bool:
    """Whether, by their names, the world is the drone, or the drone is the world of something else."""
    if is_body_name(body) or is_world_name(world):
        return False
    return is_body_name(world) or is_world_name(body)


def is_body_name(frame: str) -> bool:
    """Whether a frame has a usual name of the drone's."""
    return own_name(frame) in BODIES


def is_world_name(frame: str) -> bool:
    """Whether a frame has the usual name of one in which poses are."""
    return rank(own_name(frame)) < len(WORLDS)


def rank(name: str) -> int:
    """Place of a name in `WORLDS`, of which odom_combined has that of odom; their number if it is none."""
    return next((k for k, each in enumerate(WORLDS) if name == each or name.startswith(f"{each}_")), len(WORLDS))
