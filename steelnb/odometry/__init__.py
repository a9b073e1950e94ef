"""Scans and a drifting trajectory → the corrected trajectory and a map."""

from steelnb.odometry.base import BaseOdometry, Odometry
from steelnb.odometry.clouds import CloudOdometry
from steelnb.odometry.deepvo.odometry import DeepVoOdometry
from steelnb.odometry.faces.odometry import FaceOdometry
from steelnb.odometry.libraries import PeerOdometry
from steelnb.odometry.loam.odometry import LoamOdometry
from steelnb.odometry.methods import correct, make_odometry
from steelnb.odometry.orb.odometry import OrbOdometry
from steelnb.odometry.plugins import load_odometry
from steelnb.odometry.report.clouds import ReportCloudOdometry
from steelnb.odometry.report.segments import ReportSegmentOdometry
from steelnb.odometry.run import run
from steelnb.odometry.segments.odometry import SegmentOdometry
from steelnb.odometry.sharing import shared_segments

__all__ = [
    "BaseOdometry", "CloudOdometry", "DeepVoOdometry", "FaceOdometry", "LoamOdometry", "Odometry", "OrbOdometry",
    "PeerOdometry", "ReportCloudOdometry", "ReportSegmentOdometry", "SegmentOdometry", "correct", "load_odometry",
    "make_odometry", "run", "shared_segments",
]  # fmt: skip
