"""Which frames a bag's poses and scans are of, and how the sensor sits on the drone."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from steelnb.datatypes import Array, Trajectory
from steelnb.recordings.pinhole import T_OPTICAL_SENSOR
from steelnb.recordings.transforms import Transforms, plain

WORLDS = ("odom", "world", "map")
BODIES = ("base_link", "base_footprint", "body", "base", "drone")
"""Usual names, the likelier first (REP 105). In odom poses drift but do not jump, which is what a prior should do."""


def is_optical(frame: str) -> bool:
    """Whether a frame's axes are a camera's, z forward, x right, y down, by its name (REP 103)."""
    return plain(frame).endswith(("_optical_frame", "_optical"))


def poses_of_transforms(transforms: Transforms, sensor: str) -> tuple[Trajectory, str, str] | None:
    """Poses from tf: of the first known name of a body, or of the sensor itself, that moves in a known world.

    The poses, the frame that they are of, and both frames in words; None where there are none.
    """
    for body in (*BODIES, plain(sensor)):
        for world in WORLDS:
            poses = transforms.trajectory(world, body)
            if poses is not None and len(poses):
                return poses, body, f"tf {world} → {body}"
    return None


@dataclass(frozen=True)
class Frames:
    """``body`` is the frame of the poses, None where nothing says; ``sensor`` that of the scans, whose points are
    turned from a camera's axes where it is ``optical``."""

    transforms: Transforms
    body: str | None
    sensor: str
    optical: bool

    def extrinsics(self, named: Array | None, settings: Path | None) -> tuple[Array, str]:
        """``T_drone_sensor``, and in words where it is from: settings, since the user named them; tf; or none."""
        if named is not None:
            return named, f"settings {settings}"
        turn = T_OPTICAL_SENSOR if self.optical else np.eye(4)
        if self.body is not None and plain(self.body) == plain(self.sensor):
            return np.linalg.inv(self._T_body_drone()) @ turn, f"the poses are of the sensor's frame {self.sensor}"
        for body in (self.body, *BODIES):
            T = self.transforms.fixed(body, self.sensor) if body else None
            if T is not None and body is not None:
                words = f"tf {plain(body)} → {plain(self.sensor)}"
                if self.body and plain(body) != plain(self.body):
                    words += f", since the poses' frame {self.body} is not in tf"
                drone = self._T_body_drone() if body == self.body else np.eye(4)
                return np.linalg.inv(drone) @ T @ turn, words
        return np.eye(4), f"none from {self.body or 'the body'} to {self.sensor or 'the sensor'}: taken as the same"

    def of_drone(self, poses: Trajectory) -> tuple[Trajectory, str]:
        """Poses of the drone, x forward and z up, from those of the body; and what was done to them, or nothing."""
        if self.body is None or not is_optical(self.body):
            return poses, ""
        turned = poses.T_world_drone @ self._T_body_drone()
        return Trajectory(poses.stamp_s, turned), " turned from a camera's axes"

    def R_drone(self, frame: str) -> Array:
        """Rotation ``(3, 3)`` from a frame's axes to the drone's, by tf; identity where it is not known."""
        T = self.transforms.fixed(self.body, frame) if self.body and frame else None
        return np.eye(3) if T is None else (np.linalg.inv(self._T_body_drone()) @ T)[:3, :3]

    def _T_body_drone(self) -> Array:
        return T_OPTICAL_SENSOR if self.body is not None and is_optical(self.body) else np.eye(4)
