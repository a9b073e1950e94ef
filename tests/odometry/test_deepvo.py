"""Learned odometry: the network in NumPy, its images, its weights, and its accuracy on a flight."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from steelnb import experiment
from steelnb.core.errors import InputError
from steelnb.core.types import Trajectory
from steelnb.metrics import position_error_m
from steelnb.odometry import DeepVoOdometry, make_odometry, run
from steelnb.odometry.deepvo import (
    COLUMNS,
    MIRROR,
    ROWS,
    TAN_HALF_HEIGHT,
    TAN_HALF_WIDTH,
    VERSION,
    WEIGHTS,
    convolved,
    derotated,
    level_pair,
    motions,
    read_network,
    write_network,
)
from steelnb.settings import ExperimentSettings, OdometrySettings
from tests import naive


@pytest.fixture(scope="module")
def world():
    return experiment.simulate(ExperimentSettings.preset("loops", seed=13, duration_s=12.0, method="deepvo"))


def flown(flight, scans=None, prior=None):
    odometry = make_odometry(OdometrySettings.preset("deepvo"), flight.T_drone_sensor)
    assert isinstance(odometry, DeepVoOdometry)
    given = zip(scans or flight.scans, flight.prior.T_world_drone if prior is None else prior, strict=True)
    return odometry, [odometry.update(scan, T) for scan, T in given]


def places(steps):
    return np.array([step.T_world_drone[:3, 3] for step in steps])


@pytest.mark.parametrize(("size", "stride"), [(1, 1), (3, 1), (3, 2), (5, 2)])
def test_a_convolution_equals_its_slow_twin(size, stride):
    draw = np.random.default_rng(size + stride)
    x, kernel = draw.normal(size=(2, 8, 6, 3)), draw.normal(size=(4, 3, size, size))
    np.testing.assert_allclose(convolved(x, kernel, stride), naive.convolution(x, kernel, stride), atol=1e-12)


def test_written_weights_are_read_as_they_were(tmp_path):
    network = read_network()
    write_network(tmp_path / "own.npz", network)
    own = OdometrySettings.preset("deepvo", overrides={"weights": str(tmp_path / "own.npz")})
    images = np.random.default_rng(1).random((3, 4, ROWS, COLUMNS), dtype=np.float32)
    np.testing.assert_array_equal(DeepVoOdometry(own).network(images), network(images))


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"version": "steelnb-deepvo-0"}, f"version 'steelnb-deepvo-0'; expected '{VERSION}'"),
        ({"version": None}, "version 'none'"),
        ({"kernel_4": None}, f"expected weights of version '{VERSION}'"),
        ({"kernel_1": np.zeros((7, 9, 3, 3))}, "kernel_1"),
        ({"matrix_1": np.zeros((6, 5))}, "matrix_1"),
        ({"bias_kernel_0": np.array([np.nan])}, "bias_kernel_0"),
    ],
)
def test_weights_that_do_not_fit_are_refused_by_name_in_one_line(tmp_path, change, says):
    with np.load(WEIGHTS) as file:
        arrays = {**{name: file[name] for name in file.files}, **change}
    path = tmp_path / "other.npz"
    np.savez(path, **{name: array for name, array in arrays.items() if array is not None})
    with pytest.raises(InputError, match=says) as caught:
        DeepVoOdometry(OdometrySettings.preset("deepvo", overrides={"weights": str(path)}))
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_a_file_without_weights_is_refused(tmp_path):
    (tmp_path / "text.npz").write_text("weights")
    with pytest.raises(InputError, match=r"text\.npz: not weights of version"):
        read_network(tmp_path / "text.npz")
    with pytest.raises(InputError, match=r"none\.npz"):
        read_network(tmp_path / "none.npz")


def test_a_point_fills_its_pixel_of_the_levelled_camera():
    """A point at the centre of a pixel fills that pixel; a point between four pixels is distributed over them."""
    y, z = TAN_HALF_WIDTH * (1 - 2 * 10.5 / COLUMNS), TAN_HALF_HEIGHT * (1 - 2 * 20.5 / ROWS)
    turn = Rotation.from_euler("xyz", (0.2, -0.3, 0.1)).as_matrix()
    point = np.array([[2.0, 2 * y, 2 * z], [np.nan] * 3]) @ turn
    image = derotated(point, turn) * (240 * 180) / (ROWS * COLUMNS)
    assert image[0, 20, 10] == pytest.approx(1.0, abs=1e-6)
    assert image[1, 20, 10] == pytest.approx(1 / np.linalg.norm(point[0]), abs=1e-6)
    assert image[0].sum() == pytest.approx(1.0, abs=1e-6)
    # half a pixel to the right and down
    point[0] += turn.T @ [0.0, -2 * TAN_HALF_WIDTH / COLUMNS, -2 * TAN_HALF_HEIGHT / ROWS]
    np.testing.assert_allclose(derotated(point, turn)[0, 20:22, 10:12] * 14.0625, 0.25, atol=1e-6)
    assert not derotated(-point, turn).any(), "what lies behind is not seen"


def test_a_rotation_of_the_drone_does_not_change_the_derotated_images(world):
    flight, _ = world
    points = flight.scans[0].points
    turned = Rotation.from_euler("zyx", (0.15, 0.05, -0.04)).as_matrix()
    same, _ = level_pair((points, points @ turned), (np.eye(3), turned))
    np.testing.assert_allclose(same[:2], same[2:], atol=1e-5)


def test_rest_has_no_motion_and_reversed_or_mirrored_motion_is_consistent(world):
    flight, _ = world
    network, attitude = read_network(), flight.prior.T_world_drone[0, :3, :3]
    pairs = [level_pair((flight.scans[k].points, flight.scans[40].points), (attitude,) * 2)[0] for k in (40, 41)]
    still, moved = motions(network, np.array(pairs))[0]
    np.testing.assert_allclose(still, 0.0, atol=1e-7)
    assert np.linalg.norm(moved) > 0.02
    turned = np.array([pairs[1][[2, 3, 0, 1]], pairs[1][..., ::-1]])
    (back, mirrored), sigma = motions(network, turned)
    assert (sigma > 0).all()
    np.testing.assert_allclose(back, -moved, atol=1e-6)
    np.testing.assert_allclose(mirrored, MIRROR * moved, atol=1e-6)


def test_black_frames_add_no_motion_and_have_a_reason(world):
    flight, _ = world
    scans, black = list(flight.scans[:14]), np.full((240, 180, 3), np.nan)
    assert [step.reason for step in flown(flight.first(2), [black, black])[1]] == ["too few returns"] * 2
    for k in (2, 7, 8, 9, 10):
        scans[k] = type(scans[k])(scans[k].stamp_s, black)
    steps = flown(flight.first(14), scans)[1]
    reasons = [step.reason for step in steps]
    assert reasons[0] == "first scan"
    assert [k for k, reason in enumerate(reasons) if reason == "too few returns"] == [2, 7, 8, 9, 10]
    assert reasons[11] == "1.00 s since the last scan with returns"
    assert [step.used for step in steps] == [reason == "" for reason in reasons]
    lever = flight.prior.T_world_drone[:14, :3, :3] @ flight.T_drone_sensor[:3, 3]
    sensor = places(steps) + lever
    np.testing.assert_allclose(np.diff(sensor, axis=0)[[1, 6, 7, 8, 9, 10]], 0.0, atol=1e-12)
    assert np.linalg.norm(sensor[3] - sensor[2]) > 0.01, "a single gap is bridged by the pair around it"


def test_only_first_pose_and_attitude_of_the_prior_are_used(world):
    flight = world[0].first(12)
    prior = flight.prior.T_world_drone.copy()
    steps = flown(flight)[1]
    np.testing.assert_allclose(steps[0].T_world_drone, prior[0], atol=1e-12)
    np.testing.assert_array_equal([step.T_world_drone[:3, :3] for step in steps], prior[:, :3, :3])
    prior[1:, :3, 3] += 5.0
    np.testing.assert_array_equal(places(flown(flight, prior=prior)[1]), places(steps))


def test_a_flight_is_better_than_constant_velocity(world):
    flight, truth = world
    estimate = run(flight, make_odometry(OdometrySettings.preset("deepvo"), flight.T_drone_sensor))
    assert len(estimate.points) == len(estimate.segments) == 0
    stamp_s, T = flight.prior.stamp_s, flight.prior.T_world_drone
    second = np.searchsorted(stamp_s, 5.0)
    ahead = (T[second, :3, 3] - T[0, :3, 3]) / stamp_s[second]
    for velocity in (np.tile(ahead, (len(T), 1)), np.zeros((len(T), 3))):
        kept = T.copy()
        kept[:, :3, 3] = T[0, :3, 3] + stamp_s[:, None] * velocity
        error = position_error_m(Trajectory(stamp_s, kept), truth.trajectory)
        assert position_error_m(estimate.corrected, truth.trajectory)[-1] < 0.5 * error[-1]
