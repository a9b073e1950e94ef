"""Names of frames: namespaces, and the usual names of the drone and of its worlds."""

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


def check_order(world: str, body: str) -> tuple[str, str]:
    """Both names; raises `InputError` if the world has the usual name of a drone, and the drone that of a world."""
    if is_body_name(world) and is_world_name(body):
        raise InputError(
            f"poses of {body!r} in {world!r}: expected those of the drone in the world, as from tf by "
            f"--poses '{body}>{world}'"
        )
    return world, body


def is_body_name(frame: str) -> bool:
    """Whether a frame has a usual name of the drone's."""
    return own_name(frame) in BODIES


def is_world_name(frame: str) -> bool:
    """Whether a frame has the usual name of one in which poses are."""
    return world_rank(own_name(frame)) < len(WORLDS)


def world_rank(name: str) -> int:
    """Place of a name in `WORLDS`, of which odom_combined has that of odom; their number if it is none."""
    return next((k for k, each in enumerate(WORLDS) if name == each or name.startswith(f"{each}_")), len(WORLDS))
