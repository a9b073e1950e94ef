"""Estimates on simulated flights kept on disk, so that a run that several notebooks show is computed once."""

import hashlib

import numpy as np

from steelnb.cache import kept
from steelnb.odometry.base import Odometry
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.report_clouds import ReportCloudOdometry
from steelnb.odometry.report_segments import ReportSegmentOdometry
from steelnb.odometry.run import OnStep, run, run_online, smoothed
from steelnb.odometry.segments import SegmentOdometry
from steelnb.types import Estimate, Flight, RangeScans


def run_kept(flight: Flight, odometry: Odometry, on_step: OnStep | None = None) -> Estimate:
    """`run`, `kept` between notebooks where the scans are simulated and the method is by clouds and segments alone;
    ``on_step`` is not called for a kept estimate.

    An estimate belongs to the content of the flight and the settings of the odometry. Its seconds are those of the time
    when it was computed. It is kept as it was before it was smoothed, which is what several methods share.
    """
    # To tell images apart takes too long, and neither weights nor the version of a library are settings.
    by_settings = CloudOdometry | FaceOdometry | SegmentOdometry | ReportCloudOdometry | ReportSegmentOdometry
    if not isinstance(flight.scans, RangeScans) or not isinstance(odometry, by_settings):
        return run(flight, odometry, on_step)
    scans, prior = flight.scans, flight.prior
    given = [scans.stamp_s, scans.range_m, scans.ray, prior.stamp_s, prior.T_world_drone, flight.T_drone_sensor]
    if getattr(odometry.settings, "inertial", None) and flight.imu:
        given += [flight.imu.stamp_s, flight.imu.specific_force, flight.imu.angular_rate]

    def key() -> object:
        content = [hashlib.sha256(np.ascontiguousarray(array).data).hexdigest() for array in given]
        # The rules of odometry by segments go by their names; methods by clouds differ in their settings alone.
        named = {"smooth"} | (set() if isinstance(odometry, SegmentOdometry) else {"method"})
        settings = odometry.settings.model_dump(mode="json", exclude=named)
        return [type(odometry).__name__, settings, *content]

    online = kept("estimates", key, [__name__], lambda: run_online(flight, odometry, on_step))
    return smoothed(flight, online, odometry)
