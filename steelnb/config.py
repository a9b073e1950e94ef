"""Frozen settings, one class a room. Unknown keys, wrong types and values out of range are refused.

Lengths are metres, angles radians, times seconds; the unit is in the name. The presets ``report`` hold the settings of
the 2024 report as its authors published them; ``starling2`` holds ours for a Starling 2's Time-of-Flight sensor.
"""

import itertools
import math
from typing import Annotated, Any, Literal, Self, cast, get_args

from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from steelnb.errors import SettingsError

Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]
Probability = Annotated[float, Field(ge=0, le=1)]
TrajectoryName = Literal["vertical", "orbit"]
SensorName = Literal["report", "starling2"]
CorrectionName = Literal["none", "average", "least_squares", "least_squares_yaw"]
CloudMethod = Literal[
    "icp", "icp-3dof", "icp-3dof-dropped", "icp-4dof", "gicp", "gicp-4dof", "vgicp", "best", "combined"
]
MethodName = CorrectionName | CloudMethod


class Settings(BaseModel):
    """Base of all settings: frozen, strict, no unknown key; every fault is a one-line `SettingsError`."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as fault:
            raise SettingsError(describe_fault(type(self).__name__, fault)) from None

    def but(self, **changes: Any) -> Self:
        """A copy with some values changed, checked like the original."""
        return type(self)(**{**{name: getattr(self, name) for name in type(self).model_fields}, **changes})


def describe_fault(where: str, fault: ValidationError) -> str:
    """The first fault of a pydantic error as one line: where, what was given, what was expected."""
    first = fault.errors()[0]
    message = first["msg"].removeprefix("Value error, ")
    message = f"{message[:1].lower()}{message[1:]}"
    if not first["loc"]:
        return f"{where}: {message}"
    return f"{where}: {'.'.join(str(part) for part in first['loc'])} = {first['input']!r}: {message}"


class TowerSettings(Settings):
    """A lattice tower of steel angle sections. The defaults are the preset ``report``: 16 m high, arms to x = ±3.8 m.

    The report gives no base width. Its own crop lets the Hough transform see 1.5 m ahead, and its orbit is 3 to 4 m
    from the axis, so the body must have been about 2 m from the axis to be seen at all: hence a base of 4 m.
    """

    height_m: Positive = 16.0
    base_width_m: Positive = 4.0
    waist_height_m: Positive = 9.0
    waist_width_m: Positive = 1.7
    top_width_m: Positive = 1.0
    arm_height_m: tuple[Positive, ...] = (10.2, 12.4, 14.6)
    arm_reach_m: tuple[Positive, ...] = (3.2, 3.8, 2.8)
    arm_depth_m: Positive = 0.7
    leg_section_m: tuple[Positive, Positive] = (0.120, 0.010)
    ring_section_m: tuple[Positive, Positive] = (0.070, 0.006)
    bracing_section_m: tuple[Positive, Positive] = (0.070, 0.006)
    arm_section_m: tuple[Positive, Positive] = (0.060, 0.005)

    @model_validator(mode="after")
    def _fits(self) -> Self:
        if len(self.arm_height_m) != len(self.arm_reach_m):
            raise ValueError("arm_height_m and arm_reach_m must have the same length")
        if not self.waist_height_m < self.height_m:
            raise ValueError("waist_height_m must lie below height_m")
        levels = (self.waist_height_m, *self.arm_height_m)
        if any(low + self.arm_depth_m > high for low, high in itertools.pairwise(levels[1:])):
            raise ValueError("arms must be at least arm_depth_m apart")
        if self.arm_height_m and (
            min(self.arm_height_m) <= self.waist_height_m
            or max(self.arm_height_m) + self.arm_depth_m > self.height_m + 1e-9
        ):
            raise ValueError("arms must lie between waist_height_m and height_m")
        return self


class FlightSettings(Settings):
    """A simulated flight. ``standoff_m`` is the distance of the path to the face of the tower, at every height."""

    trajectory: TrajectoryName = "vertical"
    duration_s: Positive = 200.0
    standoff_m: Annotated[float, Field(ge=-5, le=20)] = 1.1
    height_min_m: Positive = 0.7
    height_max_m: Positive = 15.0
    levels: Annotated[int, Field(ge=2, le=100)] = 12
    speed_m_s: Positive = 0.18
    gust_sigma_m_s: NotNegative = 0.3
    gust_time_s: Positive = 2.0
    imu_rate_hz: Literal[125] = 125

    @classmethod
    def preset(cls, trajectory: TrajectoryName, duration_s: float = 200.0) -> "FlightSettings":
        """The report's two flights (its Figures 3.2a and 3.3a), each about 200 s long."""
        if trajectory == "orbit":
            return cls(
                trajectory="orbit",
                duration_s=duration_s,
                standoff_m=1.4,
                height_max_m=7.0,
                levels=6,
                speed_m_s=0.75,
            )
        return cls(trajectory=trajectory, duration_s=duration_s)


class TofSettings(Settings):
    """A Time-of-Flight camera: pinhole, optical axis along the sensor's x axis, ranges along the ray.

    The standard deviation of a range is ``max(sigma_floor_m, sigma_relative * range)``. A pixel beside a depth edge
    turns into a flying pixel, somewhere between the two depths, with ``flying_pixel_probability``; any pixel is lost
    with ``dropout_probability``; in the intervals ``blind_s`` (from, to) nothing returns at all.
    """

    columns: Annotated[int, Field(ge=1, le=4096)] = 64
    rows: Annotated[int, Field(ge=1, le=4096)] = 64
    fov_horizontal_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 2.04
    fov_vertical_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 2.04
    range_min_m: NotNegative = 0.1
    range_max_m: Positive = 4.0
    sigma_floor_m: NotNegative = 0.04
    sigma_relative: NotNegative = 0.0
    flying_pixel_probability: Probability = 0.0
    dropout_probability: Probability = 0.0
    rate_hz: Annotated[float, Field(gt=0, le=125)] = 5.0
    blind_s: tuple[tuple[float, float], ...] = ()

    @classmethod
    def preset(cls, sensor: SensorName) -> "TofSettings":
        """``report``: the simulated sensor of the report. ``starling2``: an upright Starling 2 sensor."""
        if sensor == "report":
            return cls()
        return cls(
            columns=180,
            rows=240,
            fov_horizontal_rad=math.radians(86),
            fov_vertical_rad=math.radians(106),
            range_max_m=6.0,
            sigma_floor_m=0.01,
            sigma_relative=0.01,
        )


class NoiseSettings(Settings):
    """Drift of the pose prior, added at every simulator step (125 Hz).

    ``random_walk_m``: standard deviation of the step per axis (the report's Algorithm 1); ``constant_drift_m``: length
    of the constant step vector, or the step per axis where ``constant_drift_per_axis`` (√3 more in all);
    ``yaw_random_walk_rad``: standard deviation of the heading step.
    """

    random_walk_m: NotNegative = 0.0
    constant_drift_m: NotNegative = 0.0
    constant_drift_per_axis: bool = False
    yaw_random_walk_rad: NotNegative = 0.0

    @classmethod
    def parse(cls, text: str) -> "NoiseSettings":
        """Read ``random-walk``, ``constant-drift:0.0002`` or sums such as ``random-walk+yaw-random-walk:0.001``.

        A name without a level takes the report's. ``none`` is no noise. Raises `SettingsError`.
        """
        if not isinstance(text, str):
            raise SettingsError(f"noise = {text!r}: expected a text such as 'random-walk:0.002'")
        values: dict[str, Any] = {}
        for part in [] if text == "none" else text.split("+"):
            name, _, level = part.strip().partition(":")
            if name not in REPORT_NOISE:
                raise SettingsError(f"noise = {text!r}: unknown noise {name!r}; expected one of {_names(REPORT_NOISE)}")
            key, default = REPORT_NOISE[name]
            if key in values:
                raise SettingsError(f"noise = {text!r}: {key} is given twice")
            try:
                values[key] = float(level) if level else default
            except ValueError:
                raise SettingsError(f"noise = {text!r}: the level {level!r} is not a number") from None
            if name == "constant-drift-per-axis":
                values["constant_drift_per_axis"] = True
        return cls(**values)


REPORT_NOISE = {
    "random-walk": ("random_walk_m", 0.002),
    "constant-drift": ("constant_drift_m", 0.0001),
    "constant-drift-per-axis": ("constant_drift_m", 0.0001),
    "yaw-random-walk": ("yaw_random_walk_rad", 0.0005),
}


class PreprocessSettings(Settings):
    """Pass-through box in the drone frame, floor in the world frame, voxel grid."""

    x_max_m: Positive = 1.5
    y_max_m: Positive = 1.5
    z_max_m: Positive = 1.5
    floor_m: Annotated[float, Field(allow_inf_nan=False)] = 0.3
    voxel_leaf_m: Positive = 0.033

    @classmethod
    def preset(cls, sensor: SensorName, clouds: bool = False) -> "PreprocessSettings":
        """The report's crops, for segments or for clouds, or the full range of a Starling 2's sensor."""
        if sensor == "starling2":
            return cls(x_max_m=6.0, y_max_m=6.0, z_max_m=6.0, voxel_leaf_m=0.05)
        return cls(x_max_m=4.0, y_max_m=4.0, z_max_m=4.0) if clouds else cls()


class HoughSettings(Settings):
    """Iterative 3D Hough transform (Dalitz et al. 2017) and the sorting of its lines into segments."""

    dx_m: Positive = 0.033 * math.sqrt(3)
    min_votes: Annotated[int, Field(ge=2)] = 12
    max_lines: Annotated[int, Field(ge=1)] = 10
    granularity: Annotated[int, Field(ge=0, le=6)] = 6
    gap_max_m: Positive = 2 * 0.033 * math.sqrt(3)
    pca_ratio_min: Probability = 0.995
    radius_max_m: Positive = 0.033 * math.sqrt(3)
    density_min_per_m: NotNegative = 0.0
    length_min_m: NotNegative = 0.0
    skip_weak: bool = False

    @classmethod
    def preset(cls, sensor: SensorName) -> "HoughSettings":
        """The report's settings, or ours: coarser directions, and shorter bars in the longer range."""
        if sensor == "report":
            return cls()
        return cls(
            dx_m=0.07,
            min_votes=20,
            max_lines=40,
            granularity=4,
            gap_max_m=0.25,
            pca_ratio_min=0.98,
            radius_max_m=0.07,
            density_min_per_m=10.0,
            length_min_m=0.4,
            skip_weak=True,
        )


class SegmentationSettings(Settings):
    """What every method of segmentation takes for a bar, so that they differ in nothing but how they find it.

    Points of one group are cut where they leave a gap, pieces within ``merge_distance_m`` of one axis become one, and
    those with enough points, thin for their length, stay. Chosen for the Hough transform on development seeds 11 to 16.
    """

    points_min: Annotated[int, Field(ge=2)] = 15
    gap_max_m: Positive = 0.25
    merge_distance_m: NotNegative = 0.12
    pca_ratio_min: Probability = 0.9
    radius_max_m: Positive = 0.07
    length_min_m: NotNegative = 0.3


class FusionSettings(Settings):
    """Which two segments are the same bar: angle, distance across (on top of both radii) and gap along the axis."""

    angle_max_rad: Positive = math.radians(10)
    distance_max_m: Positive = 4 * 0.033 * math.sqrt(3)
    gap_max_m: NotNegative = 0.2
    add_radii: bool = True

    @classmethod
    def preset(cls, sensor: SensorName) -> "FusionSettings":
        """The report's distance of r1 + r2 + 4·leaf·√3, or a narrower one that the better sensor allows."""
        if sensor == "report":
            return cls()
        return cls(angle_max_rad=math.radians(8), distance_max_m=0.15, add_radii=False)


class OdometrySettings(Settings):
    """Segment odometry. ``gain`` belongs to ``average``, ``damping_pairs`` to ``least_squares``, and the priors,
    ``points_max`` and ``sigma_floor_m`` to ``least_squares_yaw``.

    ``near_side`` and ``drift_gain`` are those of `CloudSettings`. The defaults of ``least_squares`` and the preset of
    ``least_squares_yaw`` were chosen on the development seeds 11 and 12, with both flights and noises.
    """

    correction: CorrectionName = "least_squares"
    gain: Annotated[float, Field(gt=0, le=1)] = 0.5
    robust_scale_m: Positive = 0.05
    damping_pairs: NotNegative = 1.0
    iterations_max: Annotated[int, Field(ge=1)] = 10
    tolerance_m: Positive = 1e-4
    sightings_min: Annotated[int, Field(ge=1)] = 1
    sigma_floor_m: Positive = 0.02
    points_max: Positive = 100.0
    prior_sigma_m: Positive = 0.05
    prior_sigma_rad: Positive = 0.02
    near_side: bool = False
    drift_gain: Probability = 0.0

    @property
    def method(self) -> str:
        """The name of the method in tables."""
        return self.correction

    @classmethod
    def preset(cls, sensor: SensorName, correction: CorrectionName) -> "OdometrySettings":
        """The correction with the robust scale that suits the sensor."""
        if correction == "least_squares_yaw":
            return cls(correction=correction, robust_scale_m=0.07 if sensor == "report" else 0.03, sightings_min=2,
                       near_side=True, drift_gain=0.05)  # fmt: skip
        return cls(correction=correction, robust_scale_m=0.115 if sensor == "report" else 0.05)


class CloudSettings(Settings):
    """Odometry by clouds: how a scan is registered to the voxel map, and how the map remembers.

    ``error`` × ``dof`` × ``robust`` are the solver's. ``shape`` says where the covariances of GICP come from: from the
    nearest neighbours, regularised to planes (``neighbours``), or from what the map has measured around each voxel and
    the sensor's noise along each ray (``measured``; ``voxels`` pairs points with voxels without a search tree).
    ``drop_rotation`` is the original's fault: it solves for six degrees of freedom, keeps the translation of the
    result, and inserts the rotated cloud. ``near_side`` moves points behind the surfaces seen (`odometry.near_side`).
    ``drift_gain`` is how fast the prediction follows the rate of the drift; 0 predicts that the drift stands still.
    ``accelerated`` extrapolates the solver's steps, for the same answer in fewer of them.
    """

    method: CloudMethod = "gicp"
    error: Literal["point", "plane", "gicp"] = "gicp"
    dof: Literal["xyz", "xyz_yaw", "se3"] = "se3"
    robust: Literal["none", "huber", "cauchy", "geman_mcclure"] = "none"
    robust_scale: Positive = 1.0
    max_correspondence_m: Positive = 0.3
    iterations_max: Annotated[int, Field(ge=1)] = 150
    rotation_epsilon_rad: Positive = 1e-4
    translation_epsilon_m: Positive = 2e-4
    map_voxel_m: Positive = 0.1
    remember: bool = False
    shape: Literal["neighbours", "measured", "voxels"] = "neighbours"
    neighbours: Annotated[int, Field(ge=4)] = 20
    sigma_floor_m: Positive = 0.01
    sigma_relative: NotNegative = 0.01
    drop_rotation: bool = False
    near_side: bool = False
    drift_gain: Probability = 0.0
    accelerated: bool = False
    bars_weight: NotNegative = 0.0
    prior_sigma_m: Positive = 1e3
    prior_sigma_rad: Positive = 1e3
    inlier_share_min: Probability = 0.3
    jump_max_m: Positive = 1.0

    @classmethod
    def preset(cls, method: CloudMethod) -> "CloudSettings":
        """The report's settings for its three methods, and ours for the others.

        Those of ``best`` were chosen on the development seeds 11 and 12, on both flights with random walk, yaw walk and
        constant drift.
        """
        report: dict[str, dict[str, Any]] = {
            "icp": {"error": "point", "dof": "se3", "max_correspondence_m": 0.5},
            "icp-3dof": {"error": "point", "dof": "xyz", "max_correspondence_m": 0.1, "iterations_max": 200},
            "gicp": {"error": "gicp", "dof": "se3", "max_correspondence_m": 0.3},
        }
        ours: dict[str, dict[str, Any]] = {
            "icp-3dof-dropped": {**report["icp-3dof"], "dof": "se3", "drop_rotation": True},
            "icp-4dof": {**report["icp"], "dof": "xyz_yaw", "remember": True},
            "gicp-4dof": {**report["gicp"], "dof": "xyz_yaw", "remember": True},
            "vgicp": {**report["gicp"], "shape": "voxels", "remember": True, "map_voxel_m": 0.25},
            "best": {
                "error": "gicp", "dof": "xyz_yaw", "remember": True, "shape": "measured", "robust": "geman_mcclure",
                "robust_scale": 0.7, "max_correspondence_m": 0.2, "iterations_max": 20,
                "rotation_epsilon_rad": 5e-4, "translation_epsilon_m": 7e-4,
                "prior_sigma_m": 0.05, "prior_sigma_rad": 0.02, "near_side": True, "drift_gain": 0.05,
                "accelerated": True,
            },
        }  # fmt: skip
        ours["combined"] = {**ours["best"], "bars_weight": 1.0}
        known = {**report, **ours}
        return cls(method=method, **known[method])


class StructureSettings(Settings):
    """The final reconstruction. Defaults were chosen on the development seeds 11 and 12, on both flights, and one more
    tower, whose legs are wider.

    Voxels of ``voxel_m`` stay with ``ridge_share`` of the largest weight within ``ridge_radius_m``, and contract to
    their mean within ``contract_m``. A bar's points lie within ``tube_m`` of it; it has at least ``min_votes`` of them
    and ``length_min_m``. Struts, short bars between two others, are looked for among the voxels further than
    ``strut_hide_m`` from all bars, with bounds of their own. Pieces in line, at most ``gap_max_m`` apart, are one bar;
    what mostly runs within ``copy_distance_m`` of a stronger bar is a copy of it. ``slack_m``, ``reach_m``, ``same_m``
    and ``bend_m`` are those of `fusion.joints.find_joints`. ``adjust``: poses too. A bar whose direction has a larger
    standard deviation than ``tilt_max_rad`` is left out. So are points below ``floor_m`` or beyond ``range_max_m``.
    """

    voxel_m: Positive = 0.04
    ridge_radius_m: Positive = 0.15
    ridge_share: Annotated[float, Field(gt=0, le=1)] = 0.2
    contract_m: Positive = 0.08
    tube_m: Positive = 0.06
    min_votes: Annotated[int, Field(ge=2)] = 8
    length_min_m: Positive = 0.3
    strut_tube_m: Positive = 0.04
    strut_length_min_m: Positive = 0.18
    strut_hide_m: Positive = 0.045
    strut_contract_m: Positive = 0.05
    floor_m: Annotated[float, Field(allow_inf_nan=False)] = 0.2
    range_max_m: Positive = 6.0
    gap_max_m: NotNegative = 0.3
    copy_distance_m: Positive = 0.2
    slack_m: NotNegative = 0.02
    reach_m: NotNegative = 0.2
    same_m: Positive = 0.15
    bend_m: NotNegative = 1.2
    adjust: bool = True
    tilt_max_rad: Positive = 0.05

    @classmethod
    def for_cloud(cls, tube_m: float) -> "StructureSettings":
        """For a plain cloud whose bars' points lie within ``tube_m``: every length in proportion, and no floor.

        Bars may run as near to each other as two tubes: what a flight sees twice, the flanges of a wide leg, a coarse
        cloud does not tell apart.
        """
        scale = tube_m / cls.model_fields["tube_m"].default
        lengths = [name for name in cls.model_fields if name.endswith("_m") and name not in ("floor_m", "range_max_m")]
        scaled = {name: scale * cls.model_fields[name].default for name in lengths}
        return cls(**{**scaled, "floor_m": -1e6, "copy_distance_m": 2 * tube_m})


class Tolerance(Settings):
    """How two structures are compared. Up to ``offset_m``, ``angle_deg`` and ``end_m`` a bar has not moved, and up to
    ``joint_m`` a joint; up to ``match_…`` it has, and beyond them it is another one: missing in one and extra in the
    other."""

    offset_m: NotNegative = 0.01
    angle_deg: NotNegative = 0.5
    end_m: NotNegative = 0.03
    joint_m: NotNegative = 0.02
    match_offset_m: Positive = 0.30
    match_angle_deg: Positive = 10.0
    match_joint_m: Positive = 0.30


class ExperimentSettings(Settings):
    """Everything one run depends on. ``seed`` changes drift, sensor noise and gusts, not the tower."""

    sensor: SensorName
    noise_name: str
    seed: Annotated[int, Field(ge=0)]
    tower: TowerSettings = TowerSettings()
    flight: FlightSettings
    tof: TofSettings
    noise: NoiseSettings
    preprocess: PreprocessSettings
    hough: HoughSettings
    fusion: FusionSettings
    odometry: OdometrySettings | CloudSettings

    @classmethod
    def preset(
        cls,
        trajectory: TrajectoryName = "vertical",
        noise: str = "random-walk",
        correction: CorrectionName = "least_squares",
        sensor: SensorName = "starling2",
        seed: int = 1,
        duration_s: float = 200.0,
        overrides: dict[str, Any] | None = None,
        method: MethodName | None = None,
    ) -> "ExperimentSettings":
        """The settings that belong to a sensor, flight, noise and method, named as in the notebooks.

        ``method`` is an odometry by clouds or one of the corrections by segments, and then the same as ``correction``.
        ``overrides`` changes single settings by room and name: ``{"tof.rate_hz": 10.0, "flight.standoff_m": 1.5}``.
        Raises `SettingsError`.
        """
        choices = {"trajectory": TRAJECTORIES, "sensor": SENSORS, "correction": CORRECTIONS, "method": METHODS}
        chosen = method or correction
        given = {"trajectory": trajectory, "sensor": sensor, "correction": correction, "method": chosen}
        for name, value in given.items():
            if value not in choices[name]:
                raise SettingsError(f"{name} = {value!r}: expected one of {_names(choices[name])}")
        clouds = chosen in CLOUD_METHODS
        by_segments = OdometrySettings.preset(sensor, correction if clouds else cast(CorrectionName, chosen))
        settings = cls(
            sensor=sensor,
            noise_name=noise,
            seed=seed,
            flight=FlightSettings.preset(trajectory, duration_s),
            tof=TofSettings.preset(sensor),
            noise=NoiseSettings.parse(noise),
            preprocess=PreprocessSettings.preset(sensor, clouds),
            hough=HoughSettings.preset(sensor),
            fusion=FusionSettings.preset(sensor),
            odometry=CloudSettings.preset(cast(CloudMethod, chosen)) if clouds else by_segments,
        )
        return settings.override(overrides or {})

    def override(self, overrides: dict[str, Any]) -> "ExperimentSettings":
        """A copy with single settings changed, each named ``room.setting``. Raises `SettingsError`."""
        changed = self
        for path, value in overrides.items():
            room, _, name = path.partition(".")
            old = getattr(changed, room, None)
            if not isinstance(old, Settings) or name not in type(old).model_fields:
                raise SettingsError(f"overrides: unknown setting {path!r}; expected room.setting, such as tof.rate_hz")
            changed = changed.but(**{room: old.but(**{name: _tuples(value)})})
        return changed


TRAJECTORIES: tuple[TrajectoryName, ...] = ("vertical", "orbit")
SENSORS: tuple[SensorName, ...] = ("report", "starling2")
CORRECTIONS: tuple[CorrectionName, ...] = get_args(CorrectionName)
CLOUD_METHODS: tuple[CloudMethod, ...] = get_args(CloudMethod)
METHODS: tuple[MethodName, ...] = (*CORRECTIONS, *CLOUD_METHODS)


def _tuples(value: Any) -> Any:
    """Lists, as JSON and TOML have them, as the tuples of settings."""
    return tuple(_tuples(item) for item in value) if isinstance(value, list) else value


def _names(names: Any) -> str:
    return ", ".join(repr(name) for name in names)
