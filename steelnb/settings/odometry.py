"""Settings of the estimators. Lengths in metres, angles in radians."""

from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from steelnb.settings.base import Finite, NotNegative, Positive, Probability, Settings, overridden, quoted, table
from steelnb.settings.presets import method_names, method_preset, sensor_preset
from steelnb.settings.sensors import ImuSettings

SEGMENT_METHODS = ("none", "average", "least_squares", "least_squares_yaw")
"""Odometries by segments alone; all others but ``orb``, ``deepvo`` and those of libraries are by clouds, ``combined``
and those based on it by both."""


class PreprocessSettings(Settings):
    """Pass-through box of ±``crop_m`` in the drone frame, floor in the world frame, voxel grid."""

    crop_m: Positive = 6.0
    floor_m: Finite = 0.3
    voxel_leaf_m: Positive = 0.05


class HoughSettings(Settings):
    """Iterative 3D Hough transform (Dalitz et al. 2017) and the sorting of its lines into segments.

    ``dx_m`` is the cell of the transform and the largest root mean square radius of a segment. ``granularity`` is how
    often the icosahedron of directions is subdivided. ``skip_weak`` passes over a line with too few points where the
    original ends its search.
    """

    dx_m: Positive
    min_votes: Annotated[int, Field(ge=2)]
    max_lines: Annotated[int, Field(ge=1)]
    granularity: Annotated[int, Field(ge=0, le=6)] = 4
    gap_max_m: Positive
    pca_ratio_min: Probability
    density_min_per_m: NotNegative = 0.0
    length_min_m: NotNegative = 0.0
    skip_weak: bool = False


class FusionSettings(Settings):
    """Association of segments with mapped bars: angle, and distance across, on top of both radii if ``add_radii``."""

    angle_max_rad: Positive
    distance_max_m: Positive
    add_radii: bool = False

    @classmethod
    def preset(cls, sensor: str = "starling2") -> "FusionSettings":
        """The settings that belong to a sensor."""
        return cls(**sensor_preset(sensor).get("fusion", {}))


class SegmentSettings(Settings):
    """Correction by segments: the robust scale (Geman-McClure) of all rules but ``average``."""

    robust_scale_m: Positive = 0.05


class CloudSettings(Settings):
    """Registration of each scan to a voxel map.

    ``error`` × ``dof`` are the solver's; ``robust_scale`` is that of Geman-McClure weights, None for none. ``shape`` is
    the source of the covariances of GICP: the nearest neighbours, regularised to planes (``neighbours``), or the points
    that the map has accumulated around each voxel and the sensor's noise along each ray (``measured``), or lines and
    planes of LOAM's ``features``, which then are all that takes part (`steelnb.odometry.loam`). ``accumulate`` keeps
    count-weighted means in the map; without it the map is voxelised anew with every scan, as the original does.
    ``fast`` extrapolates the solver's steps (Besl and McKay 1992) and stops at 0.5 mrad and 0.7 mm instead of 0.1 mrad
    and 0.2 mm. ``drop_rotation`` is the original's fault: it solves for six degrees of freedom, keeps the translation,
    and inserts the rotated cloud.
    ``bars_weight`` is the weight of a pair of bars in ``combined``. A step of more than ``jump_max_m`` is refused. With
    ``sigma_filter_px`` above 0 each range of an organised scan is first averaged with those of its surface that many
    pixels around (`steelnb.points.smooth_ranges`).
    """

    error: Literal["point", "plane", "gicp"] = "gicp"
    dof: Literal["xyz", "xyz_yaw", "se3"] = "se3"
    robust_scale: Positive | None = None
    max_correspondence_m: Positive = 0.3
    iterations_max: Annotated[int, Field(ge=1)] = 150
    map_voxel_m: Positive = 0.1
    accumulate: bool = False
    shape: Literal["neighbours", "measured", "features"] = "neighbours"
    fast: bool = False
    drop_rotation: bool = False
    bars_weight: NotNegative = 0.0
    jump_max_m: Positive = 1.0
    sigma_filter_px: Annotated[int, Field(ge=0, le=10)] = 0


CloudTrait = Literal["floor", "thinning", "mount", "gates", "order", "covariances", "solver"]
SegmentTrait = Literal["mount", "logging", "mapping", "weight"]


class ReportCloudSettings(Settings):
    """The report's program for odometry by clouds (`steelnb.odometry.report_clouds`). Each default is the original's.

    ``iterations_max``, ``epsilon`` and ``mse_change_min`` are PCL's criteria (`steelnb.registration.as_pcl`); GICP has
    no ``mse_change_min``. ``drop_rotation`` keeps only the translation of each step, although the scan enters the map
    turned. ``switched`` are the traits of the original that are replaced: ``floor``, points below
    ``preprocess.floor_m`` are left out; ``thinning``, the scan goes through a voxel grid of
    ``preprocess.voxel_leaf_m``; ``mount``, the scan is placed at the sensor instead of at the drone; ``gates``, no step
    is too large; ``order``, a step joins the correction on the left; ``covariances`` of GICP are those of the
    neighbours instead of planes; ``solver``, `steelnb.registration.align` instead of PCL's.
    """

    error: Literal["point", "gicp"] = "gicp"
    max_correspondence_m: Positive = 0.3
    iterations_max: Annotated[int, Field(ge=1)] = 150
    epsilon: Positive = 1e-5
    mse_change_min: NotNegative = 0.0
    drop_rotation: bool = False
    switched: tuple[CloudTrait, ...] = ()


class ReportSegmentSettings(Settings):
    """The report's program for odometry by segments (`steelnb.odometry.report_segments`).

    ``switched`` are the traits of the original that are replaced: ``mount``, points are those of the drone frame;
    ``logging``, the pose put out is that after the scan's own correction; ``mapping``, so is the one at which segments
    enter the map; ``weight``, a segment moves its bar by its share of the points.
    """

    switched: tuple[SegmentTrait, ...] = ()


class OdometrySettings(Settings):
    """One method and all that it takes from the sensor's and the method's preset.

    ``near_side`` moves points behind the surfaces seen (`steelnb.odometry.near_side`); ``prior_sigma`` are the standard
    deviations of a correction from its prediction, metres and radians, which then follows the rate of the drift; None
    for a drift that is taken to stand still; ``tilt_sigma_rad`` is that of the prior's roll and pitch, which are then
    corrected, too, by clouds; 0 keeps them. ``smooth``: after the last scan, all poses and bars are adjusted together
    (`steelnb.fusion.smooth`); ``refit_s``: seconds between two adjustments of keyframes and bars during the flight
    (`steelnb.odometry.faces`), None for none; ``inertial``: errors of the IMU whose readings predict the pose of a scan
    (`steelnb.odometry.inertial_prediction`) and take part in smoothing, None for none. ``weights``: file with the
    weights of a learned odometry (`steelnb.odometry.deepvo`), of the package's presets or a path, None for all others.
    ``library``: the one that does the odometry of others (`steelnb.odometry.peers`), None for our own. ``orb``: whether
    it is visual odometry by ORB features (`steelnb.odometry.orb`). ``report_clouds``, ``report_segments``: the report's
    own programs. Tables that a method does not use are None.
    """

    method: str
    near_side: bool = False
    prior_sigma: tuple[Positive, Positive] | None = None
    tilt_sigma_rad: NotNegative = 0.0
    smooth: bool = False
    refit_s: Positive | None = None
    preprocess: PreprocessSettings
    hough: HoughSettings | None = None
    fusion: FusionSettings | None = None
    segments: SegmentSettings | None = None
    clouds: CloudSettings | None = None
    orb: bool = False
    weights: str | None = None
    library: Literal["kiss_icp", "small_gicp"] | None = None
    report_clouds: Annotated[ReportCloudSettings | None, table(ReportCloudSettings)] = None
    report_segments: Annotated[ReportSegmentSettings | None, table(ReportSegmentSettings)] = None
    inertial: Annotated[ImuSettings | None, table(ImuSettings)] = None

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.method not in method_names():
            raise ValueError(f"method {self.method!r}: expected one of {quoted(method_names())}")
        others = {"orb": self.orb or None, "weights": self.weights, "a library": self.library,
                  "report_clouds": self.report_clouds, "report_segments": self.report_segments}  # fmt: skip
        other = [name for name, given in others.items() if given is not None]
        if len(other) > 1:
            raise ValueError(f"method {self.method!r}: {' and '.join(other)}: expected one of them")
        alone = "".join(other)
        if alone and (self.clouds is not None or self.segments is not None or self.smooth):
            raise ValueError(f"method {self.method!r}: {alone}: expected no tables clouds and segments, no smooth")
        if (self.clouds is None and not alone) != (self.method in SEGMENT_METHODS):
            raise ValueError(f"method {self.method!r}: has {'no' if self.clouds is None else 'a'} table clouds")
        by_bars = not alone and (self.clouds is None or self.clouds.bars_weight > 0)
        if by_bars and (self.segments is None or self.hough is None or self.fusion is None):
            raise ValueError(f"method {self.method!r}: expected tables segments, hough and fusion")
        if self.orb and self.prior_sigma is None:
            raise ValueError(f"method {self.method!r}: orb: expected prior_sigma")
        if self.report_segments is not None and self.hough is None:
            raise ValueError(f"method {self.method!r}: expected a table hough")
        by_points = self.clouds is not None or self.orb
        if self.tilt_sigma_rad and (not by_points or self.prior_sigma is None):
            given = f"tilt_sigma_rad = {self.tilt_sigma_rad:g}"
            raise ValueError(f"method {self.method!r}: {given}: expected a method by clouds with prior_sigma")
        features = self.clouds is not None and self.clouds.shape == "features"
        if self.clouds and features and (self.clouds.error != "gicp" or by_bars or self.refit_s):
            given = f"clouds.shape = {self.clouds.shape!r}"
            raise ValueError(f"method {self.method!r}: {given}: expected error = 'gicp', no bars_weight and no refit_s")
        if self.refit_s is not None and self.clouds is None:
            raise ValueError(f"method {self.method!r}: refit_s = {self.refit_s:g}: expected a method by clouds")
        if self.inertial is not None and not self.orb and (self.clouds is None or not by_bars):
            raise ValueError(f"method {self.method!r}: a table inertial: expected a method by clouds and bars, or orb")
        if self.inertial is not None and not (self.inertial.gyro_noise and self.inertial.accelerometer_noise):
            raise ValueError(f"method {self.method!r}: inertial without noise: expected that of an IMU's data sheet")
        return self

    @classmethod
    def preset(
        cls, method: str = "best", sensor: str = "starling2", overrides: dict[str, Any] | None = None
    ) -> "OdometrySettings":
        """The settings of a method with a sensor's data; ``overrides`` as in `override`. A method by clouds and
        bars, or by features of images, uses the IMU beside the sensor. Raises `InputError`."""
        of_sensor = sensor_preset(sensor)
        tables = method_preset(method, of_sensor.get("methods", {}))
        others = ("clouds", "orb", "weights", "library", "report_clouds")
        crop = "segments" if tables.keys().isdisjoint(others) else "clouds"
        kinds = {"segments": SegmentSettings, "clouds": CloudSettings}
        built = {name: kind(**tables.pop(name)) for name, kind in kinds.items() if name in tables}
        clouds = built.get("clouds")
        inertial = "orb" in tables or (isinstance(clouds, CloudSettings) and clouds.bars_weight > 0)
        if inertial and "imu" in of_sensor:
            tables["inertial"] = of_sensor["imu"]
        crops = of_sensor.get("preprocess", {}).get(crop, {})
        if "segments" in built or "report_segments" in tables:
            built["hough"] = HoughSettings(**of_sensor.get("hough", {}))
        if "segments" in built:
            built["fusion"] = FusionSettings.preset(sensor)
        preprocess = PreprocessSettings(**{**crops, **tables.pop("preprocess", {})})
        settings = cls(method=method, preprocess=preprocess, **built, **tables)
        return settings.override(overrides or {})

    def override(self, overrides: dict[str, Any]) -> "OdometrySettings":
        """A copy with single settings changed, named as ``prior_sigma`` or ``clouds.map_voxel_m``.

        Raises `InputError` for one that the method does not have.
        """
        return overridden(self, overrides)
