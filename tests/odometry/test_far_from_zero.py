"""Poses in UTM give the same results as near zero, moved there: one mechanism, `Flight.origin`."""

import numpy as np
import pytest

from steelnb.fusion import reconstruct, smooth
from steelnb.odometry import correct
from steelnb.settings import OdometrySettings, StructureSettings
from tests.fusion.made import around, small_tower

UTM_M, ALTITUDE_M = np.array([691_000.0, 5_336_000.0, 0.0]), 500.0
FAR = around(small_tower(), 12).moved(np.array([691_000.0, 5_336_000.0, ALTITUDE_M]))
FLIGHT = FAR.moved(-UTM_M)  # rounded alike


@pytest.mark.parametrize("method", ["best", "average"])
def test_a_corrected_flight(method):
    settings, seen = OdometrySettings.preset(method, overrides={"preprocess.floor_m": 0.3 + ALTITUDE_M}), []
    far = correct(FAR, settings, lambda k, scan, step: seen.append(step.T_world_drone), before=FAR)
    near = correct(FLIGHT, settings, before=FLIGHT)
    assert far.prior is FAR.prior
    assert len(near.points) > 100
    np.testing.assert_allclose(far.corrected.position, near.corrected.position + UTM_M, atol=1e-6)
    np.testing.assert_allclose(far.points, near.points + UTM_M, atol=1e-6)
    np.testing.assert_allclose(far.segments.start, near.segments.start + UTM_M, atol=1e-6)
    np.testing.assert_allclose(np.array(seen)[:, :3, 3], far.corrected.position)


def test_a_smoothed_estimate_and_a_structure():
    settings = StructureSettings(floor_m=0.1 + ALTITUDE_M)
    estimate = correct(FLIGHT, OdometrySettings.preset("none"))
    near, far = smooth(FLIGHT, estimate, settings), smooth(FAR, estimate.moved(UTM_M, FAR.prior), settings)
    assert near.unsmoothed == far.unsmoothed
    np.testing.assert_allclose(far.corrected.position, near.corrected.position + UTM_M, atol=1e-6)
    near, far = (reconstruct(each.scans, each.prior.T_world_drone, None, settings) for each in (FLIGHT, FAR))
    assert len(near) == len(far) > 3
    np.testing.assert_allclose(far.segments.start, near.segments.start + UTM_M, atol=1e-6)
    np.testing.assert_allclose(far.joint, near.joint + UTM_M, atol=1e-6)
