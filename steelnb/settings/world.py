"""What the simulated world has: the tower, the flight past it, the drift of the pose, and the drone's sensors.

Estimators know only the IMU's settings, and what was measured of the camera. Lengths in metres, angles in radians,
times in seconds.
"""

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from steelnb.core.checks import checked_array, checked_number, guess, quoted, shown
from steelnb.core.errors import InputError
from steelnb.core.files import reading
from steelnb.core.types import Array, IntArray
from steelnb.settings.base import Duration, Finite, FrozenDict, NotNegative, Positive, Settings
from steelnb.settings.presets import NameOrPath, members_file, preset_table, sensor_tables
from steelnb.settings.report_plots import ReportPlot, checked_steps

TrajectoryName = Literal["vertical", "orbit", "orbit-3.3", "zigzag", "loops", "planned"]
BY_WAYPOINTS: tuple[TrajectoryName, ...] = ("vertical", "orbit", "orbit-3.3")
REST_S = 3.0
"""Seconds at rest before take-off of a drone with an IMU."""
Waypoint = tuple[Finite, Finite, Positive, Finite, NotNegative]
"""x, y, z in metres, heading in degrees (0 along x, anticlockwise), and seconds from the previous waypoint."""


class FlightSettings(Settings):
    """A simulated flight.

    The report's flights ``vertical``, ``orbit`` and ``orbit-3.3`` stop at each of their ``waypoints``; replace these
    for a flight of your own. ``zigzag`` and ``loops`` derive their path from the tower and keep ``standoff_m`` from its
    faces at every height. A ``planned`` flight is steered by `steelnb.planning`: standoff, heights, levels and speed
    are targets, and its path depends on the odometry. Its ``goal`` is to climb the ``face`` in front of its start,
    level by level, or to fly a helix ``around`` the structure.

    ``still_s``: seconds at rest at the first point, without wind, before the flight; they count towards ``duration_s``,
    which is longer. With an IMU, whose readings then tell the bias of the gyroscope,
    `ExperimentSettings.preset` lets ``zigzag`` and ``loops`` begin with `REST_S`. ``gust_sigma_m_s``: standard
    deviation of the gusts along each axis."""

    lists_as = tuple

    trajectory: TrajectoryName = "zigzag"
    duration_s: Duration = 200.0
    still_s: NotNegative = 0.0
    standoff_m: Annotated[float, Field(ge=-5, le=20)] = 1.1
    height_min_m: Positive = 0.7
    height_max_m: Positive = 15.0
    levels: Annotated[int, Field(ge=2, le=100)] = 12
    speed_m_s: Positive = 0.18
    gust_sigma_m_s: NotNegative = 0.3
    goal: Literal["face", "around"] = "around"
    waypoints: tuple[Waypoint, ...] = ()

    @model_validator(mode="after")
    def _within_its_waypoints(self) -> Self:
        if (self.trajectory in BY_WAYPOINTS) != bool(self.waypoints):
            raise ValueError(
                f"trajectory {self.trajectory!r} with {len(self.waypoints)} waypoints: expected waypoints for"
                f" {quoted(BY_WAYPOINTS)} only"
            )
        seconds = [seconds for *_, seconds in self.waypoints]
        if self.waypoints and (len(seconds) < 2 or seconds[0] != 0 or min(seconds[1:]) == 0):
            raise ValueError("waypoints: expected at least two, with 0 seconds to the first and more to all others")
        if self.height_min_m > self.height_max_m:
            raise ValueError(
                f"height_min_m = {self.height_min_m:g} above height_max_m = {self.height_max_m:g}: expected it below"
            )
        if self.still_s and self.trajectory == "planned":
            raise ValueError(f"still_s = {self.still_s:g}: a pilot steers a planned flight from the start; expected 0")
        if self.duration_s <= self.still_s:
            raise ValueError(
                f"duration_s = {self.duration_s:g} with still_s = {self.still_s:g}: expected a flight after the rest"
            )
        end_s = self.still_s + sum(seconds)
        if self.waypoints and self.duration_s > end_s + 1e-9:
            raise ValueError(f"flight of {self.duration_s:g} s: its waypoints end after {end_s:g} s")
        return self

    @classmethod
    def preset(
        cls, trajectory: TrajectoryName, duration_s: float | None = None, changes: Mapping[str, Any] | None = None
    ) -> "FlightSettings":
        """A flight of ``presets/flights.toml``, by name, with some ``changes``. Default duration: the preset's, else
        the time of its last waypoint, else 200 s. Raises `InputError`."""
        values = dict(preset_table("flights", "trajectory", trajectory))
        del values["tower"]
        if duration_s is not None:
            values["duration_s"] = duration_s
        elif "waypoints" in values:
            end_s = values.get("still_s", 0.0) + sum(seconds for *_, seconds in values["waypoints"])
            values.setdefault("duration_s", end_s)
        return cls(**{"trajectory": trajectory, **values, **(changes or {})})


Level = tuple[NotNegative, Positive]
Kind = Literal["leg", "ring", "bracing", "arm", "secondary"]
"""Kind of a member. ``secondary``: redundant members, webs of the arms, railings."""
SectionSizes = dict[Kind, tuple[Positive, Positive]]
USUAL_SECTIONS: SectionSizes = FrozenDict({
    "leg": (0.120, 0.010), "ring": (0.070, 0.006), "bracing": (0.070, 0.006), "arm": (0.060, 0.005),
    "secondary": (0.040, 0.004),
})  # fmt: skip


def _with_usual(given: Any) -> Any:
    return USUAL_SECTIONS | given if isinstance(given, dict) else given


class TowerSettings(Settings):
    """A steel lattice tower: built from a list of ``members``, or without a list a tapered one of the given dimensions.

    ``members``: name of a CSV file of ``steelnb/settings/presets``, such as ``report-tower``, or ``FILE.csv``
    (`steelnb.simulation.member_list`). ``section``: angles, or round rods with the flange's width as diameter.
    ``mesh``: an STL or PLY file of triangles, metres, world frame, which scans see and the drone touches in place of
    the list's members and plates; the list stays the truth.
    ``profile_m``: height and width of the body on the ground, at its waist and at its top; ``arms_m``: height and reach
    of each arm; ``sections_m``: width and thickness of the flanges for each kind of member; those that are not given
    are `USUAL_SECTIONS`. The ground is a square plate at z = 0.
    """

    lists_as = tuple

    members: NameOrPath | None = None
    mesh: NameOrPath | None = None
    section: Literal["angle", "round"] = "angle"
    profile_m: tuple[Level, Level, Level] = ((0.0, 4.0), (9.0, 1.7), (16.0, 1.0))
    arms_m: tuple[tuple[Positive, Positive], ...] = ((10.2, 3.2), (12.4, 3.8), (14.6, 2.8))
    arm_depth_m: ClassVar[float] = 0.7
    sections_m: Annotated[SectionSizes, BeforeValidator(_with_usual), AfterValidator(FrozenDict)] = USUAL_SECTIONS

    @model_validator(mode="after")
    def _fits(self) -> Self:
        fields = type(self).model_fields
        if self.mesh is not None and self.members is None:
            raise ValueError(f"mesh = {self.mesh!r}: expected members too, the list of the bars in it")
        for name in ("profile_m", "arms_m") if self.members is not None else ():
            if getattr(self, name) != fields[name].default:
                raise ValueError(
                    f"{name} = {getattr(self, name)} with members = {self.members!r}: expected only one of them"
                )
        for kind, (width_m, thickness_m) in self.sections_m.items():
            if self.section == "angle" and not thickness_m <= width_m:
                raise ValueError(
                    f"sections_m.{kind} = {(width_m, thickness_m)}: expected a flange at least as wide as it is thick"
                )
        (ground_m, _), (waist_m, _), (top_m, _) = self.profile_m
        leg_m = self.sections_m["leg"][0]
        if self.members is None and not min(width_m for _, width_m in self.profile_m) > leg_m:
            raise ValueError(f"profile_m = {self.profile_m}: expected widths above that of a leg, {leg_m:g} m")
        if not 0.0 == ground_m < waist_m < top_m:
            raise ValueError(f"profile_m = {self.profile_m}: expected heights that rise from 0")
        height_m = [height for height, _ in self.arms_m]
        if any(low + self.arm_depth_m > high for low, high in itertools.pairwise(height_m)):
            raise ValueError(f"arms_m: expected arms at least {self.arm_depth_m:g} m apart")
        if height_m and not waist_m < min(height_m) <= max(height_m) <= top_m - self.arm_depth_m:
            raise ValueError("arms_m: expected arms between the waist and the top")
        return self

    @property
    def floor_half_m(self) -> float:
        """Half the side of the ground: the report's plate for a list of members, else practically unlimited."""
        return 60.0 if self.members is None else 3.0

    def file_bytes(self) -> bytes:
        """The bytes of the list of members and of the mesh, by which two versions of a file are told apart; none
        without them. Raises `InputError`."""
        files = [(members_file(self.members), "a list of members")] if self.members else []
        files += [(Path(self.mesh), "a mesh")] if self.mesh else []
        data = b""
        for path, form in files:
            with reading(path, form):
                data += path.read_bytes()
        return data

    @classmethod
    def preset(cls, tower: str = "tapered") -> "TowerSettings":
        """A tower of ``presets/towers.toml``, by name. Raises `InputError`."""
        return cls(**preset_table("towers", "tower", tower))

    @classmethod
    def of_flight(cls, trajectory: TrajectoryName) -> "TowerSettings":
        """The tower of a flight of ``presets/flights.toml``. Raises `InputError`."""
        return cls.preset(preset_table("flights", "trajectory", trajectory)["tower"])


@dataclass(frozen=True)
class Noise:
    """Drift of the pose prior, added at every simulator step (125 Hz).

    ``random_walk_m``: standard deviation of the step per axis (the report's Algorithm 1); ``constant_drift_m``: length
    of the constant step vector (0.83 of this with the seed ``report``); ``yaw_random_walk_rad``: standard deviation of
    the heading step; ``tilt_rad``: standard deviation of the slowly varying errors of roll and pitch, not in the
    report. Angles are at most π, lengths 1 km.
    """

    random_walk_m: float = 0.0
    constant_drift_m: float = 0.0
    yaw_random_walk_rad: float = 0.0
    tilt_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, level in vars(self).items():
            try:
                checked_number(level, f"Noise.{name}", 0, math.pi if name.endswith("_rad") else 1000.0)
            except InputError as fault:
                raise InputError(f"{fault} {'rad' if name.endswith('_rad') else 'm'}") from None

    @classmethod
    def parse(cls, text: str) -> "Noise":
        """Parse ``random-walk``, ``constant-drift:0.0002`` or sums such as ``random-walk+yaw-random-walk:0.001``.

        The default levels are the report's, and one degree for ``tilt``. ``none`` is no noise. Raises `InputError`.

        >>> Noise.parse("random-walk+yaw-random-walk:0.001")
        Noise(random_walk_m=0.002, constant_drift_m=0.0, yaw_random_walk_rad=0.001, tilt_rad=0.0)
        """
        if not isinstance(text, str):
            raise InputError(f"noise = {shown(text)}: expected a text such as 'random-walk:0.002'")
        values: dict[str, Any] = {}
        for part in [] if text == "none" else text.split("+"):
            name, _, level = part.strip().partition(":")
            if name not in REPORT_NOISE:
                raise InputError(
                    f"noise = {text!r}: unknown noise {name!r}{guess(name, REPORT_NOISE)}; "
                    f"expected one of {quoted(REPORT_NOISE)}"
                )
            key, default = REPORT_NOISE[name]
            if key in values:
                raise InputError(f"noise = {text!r}: {key} is given twice")
            try:
                values[key] = float(level) if level else default
            except ValueError:
                raise InputError(f"noise = {text!r}: the level {level!r} is not a number") from None
        try:
            return cls(**values)
        except InputError as fault:
            raise InputError(f"noise = {text!r}: {fault}") from None

    def check_report(self) -> None:
        """Raise `InputError` for noises that are not the report's: the seed ``report`` has no draws for them."""
        levels = {"random_walk_m": 0.002, "constant_drift_m": 0.0001, "yaw_random_walk_rad": 0.0005, "tilt_rad": 0.0}
        for name, level in levels.items():
            if getattr(self, name) not in (0.0, level):
                has = f"{level:g} or none" if level else "none"
                raise InputError(f"seed = 'report' with {name} = {getattr(self, name):g}: the report has {has}")
        if self.constant_drift_m and (self.random_walk_m or self.yaw_random_walk_rad):
            raise InputError(
                f"seed = 'report' with constant_drift_m = {self.constant_drift_m:g} and a random walk: the report has"
                " one or the other"
            )


REPORT_NOISE = {
    "random-walk": ("random_walk_m", 0.002),
    "constant-drift": ("constant_drift_m", 0.0001),
    "yaw-random-walk": ("yaw_random_walk_rad", 0.0005),
    "tilt": ("tilt_rad", math.radians(1.0)),
}
"""Name → setting, and default level (the report's, except for ``tilt``)."""


def at_level(noise: str, level: float) -> str:
    """A noise with all its levels multiplied by ``level``. Parts without a level have the report's. Raises `InputError`
    for an unknown noise."""
    Noise.parse(noise)
    if noise == "none" or level == 1:
        return noise
    parts = (part.strip().partition(":") for part in noise.split("+"))
    levels = [f"{name}:{level * float(given or REPORT_NOISE[name][1]):g}" for name, _, given in parts]
    return "+".join(text.replace("e+", "e") for text in levels)


def without(noise: str, part: str) -> str:
    """A noise without one of its parts; ``none`` if no other is left. Raises `InputError` for an unknown noise.

    >>> without("yaw-random-walk+random-walk:0.001", "yaw-random-walk")
    'random-walk:0.001'
    """
    Noise.parse(noise)
    parts = [each.strip() for each in noise.split("+")]
    return "+".join(each for each in parts if each.partition(":")[0] != part) or "none"


TofFault = Literal["footprint", "exposure", "multipath", "amplitude", "wiggle", "calibration", "mount", "latency"]
"""Faults of a real camera beside range noise: mixed pixels at edges; motion during the exposure; multipath by a second
surface; noise and dropout that depend on the amplitude; an error periodic in the range; errors of offset and scale; a
mount that is not where it is stated; stamps that are late."""
SCALE_MIN, SCALE_MAX = 0.8, 1.25
"""Bounds of the measured scale of ranges: other lengths are not in metres."""


class CameraSettings(Settings):
    """A pinhole camera on the drone. In the camera frame, x is the optical axis, y left, z up.

    ``mount_m`` and ``mount_rpy_deg``: its position, and its roll, pitch and yaw about the drone's axes.
    """

    lists_as = tuple

    columns: Annotated[int, Field(ge=1, le=4096)] = 64
    rows: Annotated[int, Field(ge=1, le=4096)] = 64
    fov_horizontal_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 2.04
    fov_vertical_rad: Annotated[float, Field(gt=0, lt=math.pi)] = 2.04
    mount_m: tuple[Finite, Finite, Finite] = (0.06, 0.0, 0.0)
    mount_rpy_deg: tuple[Finite, Finite, Finite] = (0.0, 0.0, 0.0)

    @property
    def T_drone_sensor(self) -> Array:
        """The mount ``(4, 4)``; roll, pitch and yaw are about fixed axes (REP 103)."""
        from scipy.spatial.transform import Rotation  # half of the time to import the settings

        T = np.eye(4)
        T[:3, :3] = Rotation.from_euler("xyz", self.mount_rpy_deg, degrees=True).as_matrix()
        T[:3, 3] = self.mount_m
        return T


class TofSettings(CameraSettings):
    """A Time-of-Flight camera, with ranges along the ray.

    The standard deviation of a range is ``max(sigma_floor_m, sigma_relative * range)``. With ``noise_on = "depth"``,
    noise and limit ``range_max_m`` apply to the depth along the optical axis; the output is still the range along the
    ray. Scans are taken at ``start_s + k / rate_hz``, k = 0, 1, …, rounded to the simulator's step; with ``samples``,
    instead at these steps of 8 ms from ``start_s`` on, or at those of the report's plot that it names, such as ``"3.5
    orbit gicp"``. In the intervals ``blind_s`` (from, to) there are no returns.

    ``pixel_origin``: where in its pixel the driver places a depth. The report's driver omits the half pixel to the
    ``centre``, so its points lie half a pixel too far left and up, towards the ``corner``. With ``faults``, the sensor
    has the errors of a real one (`steelnb.simulation.tof_faults`); the noise of a range then depends on the amplitude
    of its return. ``draw``: number of the draw of the range noise; draws of one seed differ in nothing else.

    Estimators are told what was measured before the flight: the camera reports ``range_scale`` times the distance plus
    ``range_offset_m``, and ``range_scale_sigma`` and ``range_offset_sigma_m`` are the standard deviations of these two.
    """

    range_max_m: Positive = 4.0
    sigma_floor_m: NotNegative = 0.04
    sigma_relative: NotNegative = 0.0
    noise_on: Literal["range", "depth"] = "range"
    pixel_origin: Literal["centre", "corner"] = "centre"
    rate_hz: Annotated[float, Field(gt=0, le=125)] = 5.0
    start_s: NotNegative = 0.0
    samples: str | tuple[int, ...] = ()
    draw: Annotated[int, Field(ge=0, lt=2**31)] = 0
    blind_s: tuple[tuple[Finite, Finite], ...] = ()
    faults: tuple[TofFault, ...] = ()
    range_scale: Annotated[float, Field(ge=SCALE_MIN, le=SCALE_MAX)] = 1.0
    range_offset_m: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    range_scale_sigma: NotNegative = 0.0
    range_offset_sigma_m: NotNegative = 0.0

    @model_validator(mode="after")
    def _has_pixels_and_steps(self) -> Self:
        if self.pixel_origin == "corner" and min(self.columns, self.rows) < 2:
            raise ValueError(
                f"pixel_origin = 'corner' with {self.columns} x {self.rows} pixels: expected an image, for half a pixel"
            )
        for gap in self.blind_s:
            if not gap[0] < gap[1]:
                raise ValueError(f"blind_s: {gap}: expected the first and last second of a gap, such as (60.0, 75.0)")
        self.sample_steps()  # raises for an unknown plot and for steps that do not increase
        return self

    def uncalibrated(self) -> Self:
        """The same camera without a measured calibration."""
        return self.replace(range_scale=1.0, range_offset_m=0.0, range_scale_sigma=0.0, range_offset_sigma_m=0.0)

    def sample_steps(self) -> IntArray:
        """The steps of ``samples (N,)``; empty if scans are evenly spaced. Raises `InputError`."""
        if isinstance(self.samples, str):
            return ReportPlot.named(self.samples).scans
        return checked_steps(np.array(self.samples, dtype=np.int64))

    @classmethod
    def preset(cls, sensor: str | Path) -> "TofSettings":
        """The sensor of ``presets/sensors/NAME.toml`` or of a file ``FILE.toml``. Raises `InputError`."""
        return cls(**sensor_tables(sensor).get("tof", {}))


class ImuSettings(Settings):
    """Errors of an IMU (`steelnb.simulation.imu`), equal on all three axes, zero by default.
    ``presets/sensors/starling2-honest.toml`` has the values of a real IMU, with their sources.

    ``..._noise``: white noise density, rad/s/√Hz and m/s²/√Hz; ``..._walk``: density of the bias random walk,
    rad/s²/√Hz and m/s³/√Hz; ``..._bias``: standard deviation of the initial bias, rad/s and m/s².
    """

    gyro_noise: NotNegative = 0.0
    gyro_walk: NotNegative = 0.0
    gyro_bias: NotNegative = 0.0
    accelerometer_noise: NotNegative = 0.0
    accelerometer_walk: NotNegative = 0.0
    accelerometer_bias: NotNegative = 0.0

    @classmethod
    def preset(cls, sensor: str | Path) -> "ImuSettings | None":
        """The IMU of a sensor's preset; None without one. Raises `InputError`."""
        table = sensor_tables(sensor).get("imu")
        return None if table is None else cls(**table)


def fitted_calibration(distance_m: Array, range_m: Array) -> dict[str, float]:
    """Scale and offset of ranges ``(N,)`` at known distances ``(N,)``, metres, by least squares, with their standard
    deviations, as overrides of the table ``tof``. Raises `InputError` for fewer than three different distances, for
    values that are not positive, and for a scale that no camera has, as between metres and millimetres."""
    distance_m = checked_array(distance_m, "distance_m", ("N",))
    range_m = checked_array(range_m, "range_m", (len(distance_m),))
    different = len(np.unique(distance_m))
    if different < 3:
        raise InputError(f"distance_m: {different} different values; expected at least 3")
    checked_number(distance_m.min(), "the smallest distance_m", above=0)
    checked_number(range_m.min(), "the smallest range_m", above=0)
    A = np.column_stack([distance_m, np.ones(len(distance_m))])
    (scale, offset_m), *_ = np.linalg.lstsq(A, range_m, rcond=None)
    checked_number(scale, "the scale of range_m against distance_m, both in metres,", SCALE_MIN, SCALE_MAX)
    residual = range_m - A @ [scale, offset_m]
    variance = np.diag(np.linalg.inv(A.T @ A)) * (residual @ residual) / (len(distance_m) - 2)
    names = "range_scale", "range_offset_m", "range_scale_sigma", "range_offset_sigma_m"
    values = scale, offset_m, *np.sqrt(variance)
    return {f"tof.{name}": float(value) for name, value in zip(names, values, strict=True)}
