"""Simulation of a tower, a flight and its sensors; it replaces the report's Webots simulation."""

from steelnb.simulation.camera import FORWARD, Camera, photograph
from steelnb.simulation.flight import Command, Pilot, fly
from steelnb.simulation.imu import filtered_attitude, measured_imu
from steelnb.simulation.onboard import OnboardSensors
from steelnb.simulation.tof import scan_flight
from steelnb.simulation.tower import Member, Tower, build_tower
from steelnb.simulation.truth import Truth, Visibility

__all__ = [
    "FORWARD", "Camera", "Command", "Member", "OnboardSensors", "Pilot", "Tower", "Truth", "Visibility", "build_tower",
    "filtered_attitude", "fly", "measured_imu", "photograph", "scan_flight",
]  # fmt: skip
