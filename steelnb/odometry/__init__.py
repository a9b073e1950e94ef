"""Scans and a drifting trajectory → the corrected trajectory and a map."""

from steelnb.odometry.base import BaseOdometry, Odometry, load_odometry, run
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.deepvo import DeepVoOdometry
from steelnb.odometry.faces import FaceOdometry
from steelnb.odometry.libraries import PeerOdometry
from steelnb.odometry.loam import LoamOdometry
from steelnb.odometry.methods import correct, make_odometry
from steelnb.odometry.orb import OrbOdometry
from steelnb.odometry.report_clouds import ReportCloudOdometry
from steelnb.odometry.report_segments import ReportSegmentOdometry
from steelnb.odometry.segments import SegmentOdometry, shared_segments

__all__ = [
    "BaseOdometry", "CloudOdometry", "DeepVoOdometry", "FaceOdometry", "LoamOdometry", "Odometry", "OrbOdometry",
    "PeerOdometry", "ReportCloudOdometry", "ReportSegmentOdometry", "SegmentOdometry", "correct", "load_odometry",
    "make_odometry", "run", "shared_segments",
]  # fmt: skip
