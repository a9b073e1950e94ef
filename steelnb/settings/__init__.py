"""Frozen settings, one class per stage or family of methods, and presets in TOML files. Unknown keys are errors.

Start with four of them: the sensor, its range (``preprocess.crop_m``), the floor (``preprocess.floor_m``) and the
method. Lengths are in metres, angles in radians, times in seconds; the unit is in the name.
"""

from typing import get_args

from steelnb.settings.base import Settings, parse_parameter, read_tables
from steelnb.settings.experiment import ExperimentSettings
from steelnb.settings.odometry import (
    CloudSettings,
    DeepVoSettings,
    FaceSettings,
    LibrarySettings,
    LoamSettings,
    OdometrySettings,
    OrbSettings,
    RegistrationSettings,
    ReportCloudSettings,
    ReportSegmentSettings,
    SegmentSettings,
    SensorPreset,
)
from steelnb.settings.presets import METHODS, SENSORS, TOWERS
from steelnb.settings.recording import RecordingOptions, read_options
from steelnb.settings.report_plots import read_report_plots
from steelnb.settings.stages import (
    FusionSettings,
    HoughSettings,
    MountSettings,
    PreprocessSettings,
    StructureSettings,
)
from steelnb.settings.world import (
    REPORT_NOISE,
    CameraSettings,
    FlightSettings,
    ImuSettings,
    Noise,
    TofFault,
    TofSettings,
    TowerSettings,
    TrajectoryName,
)

TRAJECTORIES: tuple[TrajectoryName, ...] = get_args(TrajectoryName)

__all__ = [
    "METHODS", "REPORT_NOISE", "SENSORS", "TOWERS", "TRAJECTORIES", "CameraSettings", "CloudSettings", "DeepVoSettings",
    "ExperimentSettings", "FaceSettings", "FlightSettings", "FusionSettings", "HoughSettings", "ImuSettings",
    "LibrarySettings", "LoamSettings", "MountSettings", "Noise", "OdometrySettings", "OrbSettings",
    "PreprocessSettings", "RecordingOptions", "RegistrationSettings", "ReportCloudSettings", "ReportSegmentSettings",
    "SegmentSettings", "SensorPreset", "Settings", "StructureSettings", "TofFault", "TofSettings", "TowerSettings",
    "TrajectoryName", "parse_parameter", "read_options", "read_report_plots", "read_tables",
]  # fmt: skip
