"""Settings of the odometries, one class per family of methods. Lengths in metres, angles in radians."""

import math
from abc import abstractmethod
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self, get_args

from pydantic import AfterValidator, Field, model_validator

from steelnb.core.errors import InputError
from steelnb.settings.base import NotNegative, OrNone, Positive, Settings, VoxelEdge
from steelnb.settings.presets import method_table, sensor_tables
from steelnb.settings.stages import FusionSettings, HoughSettings, MountSettings, PreprocessSettings
from steelnb.settings.world import ImuSettings, TofSettings

SegmentMethod = Literal["none", "average", "least_squares", "least_squares_yaw"]


def _with_noise(imu: ImuSettings | None) -> ImuSettings | None:
    if imu is not None and not (imu.gyro_noise and imu.accelerometer_noise):
        raise ValueError("an IMU without noise: expected that of its data sheet")
    return imu


InertialNoise = Annotated[ImuSettings | None, AfterValidator(_with_noise), OrNone]
"""Errors of the IMU, None to use no IMU. Its readings predict the pose of each scan
(`steelnb.odometry.inertial`) and take part in smoothing."""


class OdometrySettings(Settings):
    """Settings that all families share; `preset` returns the settings of a method.

    ``smooth``: adjust all poses and bars together after the last scan (`steelnb.fusion.adjustment.smooth`).
    ``mount``: how well the mount of the sensor is known; only smoothing estimates it.
    """

    of_preset = ("method",)
    lists_as = tuple

    method: str
    preprocess: PreprocessSettings = PreprocessSettings()
    smooth: bool = False
    mount: MountSettings = MountSettings()

    family: ClassVar[str]

    def __init__(self, **values: Any) -> None:
        if type(self) is OdometrySettings:
            raise InputError("OdometrySettings: of no family; OdometrySettings.preset(method) gives those of a method")
        super().__init__(**values)

    @model_validator(mode="after")
    def _estimates_its_mount(self) -> Self:
        if self.mount != MountSettings() and not self.smooth:
            raise ValueError("mount: only smoothing estimates it; expected smooth = true, or no standard deviations")
        return self

    @property
    def corrects_twice(self) -> bool:
        """Whether a flight is corrected once to find the mount, and then by this mount, before it is smoothed."""
        return self.smooth and bool(self.mount.sigma[:6].any())

    @staticmethod
    def preset(
        method: str = "best", sensor: str | Path = "starling2", overrides: dict[str, Any] | None = None
    ) -> "Family":
        """The settings of a method with a sensor's data; ``overrides`` as for `override`. The families ``faces`` and
        ``orb`` use the IMU of the sensor's preset. Raises `InputError`.

        >>> settings = OdometrySettings.preset("faces")
        >>> settings.family, settings.map_voxel_m
        ('faces', 0.1)
        """
        own = SensorPreset.read(sensor)
        kind, values = of_method(method, own.methods)
        segments = "hough" in kind.model_fields
        for name in ("hough", "fusion"):
            if name in kind.model_fields:
                values[name] = getattr(own, name).model_dump() | values.get(name, {})
        crop = own.preprocess.segments if segments else own.preprocess.clouds
        values["preprocess"] = crop.model_dump() | values.get("preprocess", {})
        if kind in (FaceSettings, OrbSettings):
            values.setdefault("inertial", own.imu)
        return kind(**values).override({} if overrides is None else overrides)


class SegmentSettings(OdometrySettings):
    """Odometry by segments; the method names the correction rule (`steelnb.odometry.segments`).

    ``robust_scale_m``: scale of the robust weights (Geman-McClure) of both least-squares rules.
    """

    family: ClassVar[str] = "segments"
    method: SegmentMethod
    hough: HoughSettings = HoughSettings()
    fusion: FusionSettings = FusionSettings()
    robust_scale_m: Positive = 0.05


class MapSettings(OdometrySettings):
    """Registration to voxel maps: maximum correspondence distance, and edge of a voxel of the map."""

    max_correspondence_m: Positive = 0.3
    map_voxel_m: VoxelEdge = 0.1

    @property
    @abstractmethod
    def registration(self) -> "RegistrationSettings":
        """All settings of the registration, with those that a family fixes."""


class RegistrationSettings(MapSettings):
    """Registration of each scan to a voxel map.

    ``error`` and ``dof`` select the solver's residual and its degrees of freedom; ``robust_scale`` is the scale of
    Geman-McClure weights, None for none. ``map``: a ``re-voxelised`` map is voxelised again with every scan, as in the
    original; a ``weighted`` one averages all points of a voxel. So does a ``measured`` one; `steelnb.odometry.clouds`
    says what else it changes. ``prior_sigma``: standard deviation of a correction about its prediction, metres and
    radians; the prediction then follows the rate of the drift. With None, it is the last correction. Ranges of one
    surface within ``sigma_filter_px`` pixels are averaged first, unless it is 0 (`steelnb.points.smooth_ranges`).
    ``tilt_sigma_rad``: standard deviation of the prior's roll and pitch. If above 0, they are corrected, too.
    """

    prior_sigma: tuple[Positive, Positive] | None = None
    error: Literal["point", "gicp"] = "gicp"
    dof: Literal["xyz", "xyz_yaw", "se3"] = "se3"
    robust_scale: Positive | None = None
    map: Literal["re-voxelised", "weighted", "measured"] = "re-voxelised"
    sigma_filter_px: Annotated[int, Field(ge=0, le=10)] = 0
    tilt_sigma_rad: Annotated[float, Field(ge=0, le=math.pi)] = 0.0
    inertial: InertialNoise = None

    @property
    def registration(self) -> "RegistrationSettings":
        """These settings: none is fixed."""
        return self


class CloudSettings(RegistrationSettings):
    """Odometry by clouds (`steelnb.odometry.clouds`)."""

    family: ClassVar[str] = "clouds"


class FaceSettings(RegistrationSettings):
    """Odometry by the front faces of bars, with odometry by clouds as the fallback (`steelnb.odometry.faces`)."""

    family: ClassVar[str] = "faces"


class LoamSettings(MapSettings):
    """LOAM (`steelnb.odometry.loam`). The other settings of a registration are fixed."""

    family: ClassVar[str] = "loam"

    @property
    def registration(self) -> RegistrationSettings:
        """Features are matched like distributions, as `steelnb.odometry.loam` makes covariances of them."""
        return RegistrationSettings(
            method=self.method, preprocess=self.preprocess, smooth=self.smooth,
            max_correspondence_m=self.max_correspondence_m, map_voxel_m=self.map_voxel_m,
            error="gicp", dof="se3", robust_scale=5.0, map="weighted",
        )  # fmt: skip


class OrbSettings(OdometrySettings):
    """Visual odometry by ORB features (`steelnb.odometry.orb`)."""

    family: ClassVar[str] = "orb"
    inertial: InertialNoise = None


class DeepVoSettings(OdometrySettings):
    """Learned odometry (`steelnb.odometry.deepvo`); ``weights``: a file of the package's presets, or a path."""

    family: ClassVar[str] = "deepvo"
    weights: str = "deepvo.npz"


class LibrarySettings(OdometrySettings):
    """Odometry by the library that the method names (`steelnb.odometry.libraries`)."""

    family: ClassVar[str] = "library"


CloudTrait = Literal["floor", "thinning", "mount", "gates", "order", "covariances", "solver"]


class ReportCloudSettings(OdometrySettings):
    """The report's programs for odometry by clouds, one per method (`steelnb.odometry.report_clouds`).

    ``switched`` names the original's traits to replace. ``floor``: points below ``preprocess.floor_m`` are cut off.
    ``thinning``: the scan is downsampled by a voxel grid of ``preprocess.voxel_leaf_m``. ``mount``: the scan is placed
    at the sensor instead of at the drone. ``gates``: steps of any size are accepted. ``order``: a step multiplies the
    correction from the left. ``covariances``: GICP uses the neighbours' covariances instead of planes. ``solver``:
    `steelnb.registration.align` replaces PCL's solver.

    ``broken_off_s``: first and last second of the program in an earlier run that was broken off while the drone stood
    on the ground; the program kept its map and its correction. Empty for none."""

    family: ClassVar[str] = "report_clouds"
    switched: tuple[CloudTrait, ...] = ()
    broken_off_s: tuple[NotNegative, Positive] | tuple[()] = ()

    @model_validator(mode="after")
    def _breaks_off_after_its_start(self) -> Self:
        if self.broken_off_s and not self.broken_off_s[0] < self.broken_off_s[1]:
            raise ValueError(f"broken_off_s = {self.broken_off_s}: expected a start before its end")
        return self


class ReportSegmentSettings(OdometrySettings):
    """The report's program for odometry by segments (`steelnb.odometry.report_segments`)."""

    family: ClassVar[str] = "report_segments"
    hough: HoughSettings = HoughSettings()


Family = (
    SegmentSettings | CloudSettings | FaceSettings | LoamSettings | OrbSettings | DeepVoSettings | LibrarySettings
    | ReportCloudSettings | ReportSegmentSettings
)  # fmt: skip
FAMILIES: dict[str, type[Family]] = {kind.family: kind for kind in get_args(Family)}
"""Family → its settings."""


def of_method(method: str, of_sensor: dict[str, dict[str, Any]]) -> tuple[type[Family], dict[str, Any]]:
    """The class of a method's settings, and those that its preset and a sensor's (`method_table`) have. Raises
    `InputError`."""
    values = {"method": method, **method_table(method, of_sensor)}
    return FAMILIES[values.pop("family")], values


def of_its_method(value: Any) -> Any:
    """A table of settings as those of its method's family, which tells the classes of `Family` apart."""
    return of_method(value.get("method", ""), {})[0](**value) if isinstance(value, dict) else value


class SensorPreprocess(Settings):
    """The preprocessing that suits a sensor, for methods by clouds and for those by segments."""

    clouds: PreprocessSettings = PreprocessSettings()
    segments: PreprocessSettings = PreprocessSettings()


class SensorPreset(Settings):
    """A sensor with its IMU, if any, and the settings of the stages and methods that suit it: the tables of
    ``presets/sensors/NAME.toml``, or of your own ``FILE.toml``. ``methods``: method → its settings that differ."""

    tof: TofSettings = TofSettings()
    imu: Annotated[ImuSettings | None, OrNone] = None
    preprocess: SensorPreprocess = SensorPreprocess()
    hough: HoughSettings = HoughSettings()
    fusion: FusionSettings = FusionSettings()
    methods: dict[str, dict[str, Any]] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _has_good_methods(self) -> Self:
        for name, changes in self.methods.items():
            if "family" in changes or "based_on" in changes:
                raise ValueError(f"methods.{name}: expected settings of the method, no family or based_on")
            kind, values = of_method(name, self.methods)
            kind(**values)
        return self

    @classmethod
    def read(cls, sensor: str | Path) -> "SensorPreset":
        """A preset, by name, or a file ``FILE.toml``. Raises `InputError`."""
        tables = sensor_tables(sensor)
        try:
            return cls(**tables)
        except InputError as fault:
            raise InputError(f"{sensor}: {fault}") from None
