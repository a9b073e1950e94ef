"""Inputs that every odometry refuses, with the same messages as `register`: both use `steelnb.core.checks`."""

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.core.estimates import OdometryStep
from steelnb.core.types import Flight, Scan, Trajectory
from steelnb.odometry import make_odometry, run
from steelnb.settings import METHODS, OdometrySettings

CLOUD = np.random.default_rng(0).uniform(0.5, 1.4, (400, 3))
MIRRORED = np.diag([-1.0, 1.0, 1.0, 1.0])


@pytest.mark.parametrize(
    "given",
    [{"scan": CLOUD.T}, {"scan": CLOUD.astype(str)}, {"scan": [[1, 2, 3], [4, 5]]}, {"prior": np.eye(3)},
     {"prior": np.full((4, 4), np.nan)}, {"prior": 1.01 * np.eye(4)}, {"prior": MIRRORED}],
)  # fmt: skip
def test_scans_of_another_shape_and_priors_that_are_not_rigid_are_refused(given):
    name = "scan" if "scan" in given else "T_world_drone_prior"
    odometry = make_odometry(OdometrySettings.preset("best"), np.eye(4))
    with pytest.raises(InputError, match=f"^{name}"):
        odometry.update(given.get("scan", CLOUD), given.get("prior", np.eye(4)))


@pytest.mark.parametrize("method", METHODS)
def test_each_method_refuses_settings_of_another_family_and_a_bad_scan(method):
    settings = OdometrySettings.preset(method)
    odometry, other = make_odometry(settings, np.eye(4)), "average" if settings.family == "clouds" else "best"
    with pytest.raises(InputError, match=f"method '{other}' is of the family '.*'; expected one such as"):
        type(odometry)(OdometrySettings.preset(other))
    with pytest.raises(InputError, match=r"^scan: .*\(3, 400\)"):
        odometry.update(CLOUD.T, np.eye(4))


@pytest.mark.parametrize("method", ["average", "best", "faces"])
def test_masked_points_do_not_count_and_a_scan_in_millimetres_is_not_cropped_away_without_a_word(method):
    hidden = np.ma.masked_array(CLOUD, np.ones(CLOUD.shape, dtype=bool))
    odometry = make_odometry(OdometrySettings.preset(method), np.eye(4))
    assert not odometry.update(hidden, np.eye(4)).used
    assert len(odometry.map_points()) == 0
    assert "no point within 6 m (nearest" in odometry.update(1000 * CLOUD, np.eye(4)).reason


class Careless:
    """Changes what it is given."""

    points = np.zeros((5, 3))

    def update(self, scan, T_world_drone_prior):
        T_world_drone_prior[:3, 3] += 1.0
        return OdometryStep(scan.stamp_s, T_world_drone_prior)

    def map_points(self):
        return self.points


def test_an_odometry_cannot_change_the_flight_and_its_map_is_checked():
    scans = [Scan(0.2 * k, CLOUD) for k in range(3)]
    prior = Trajectory(np.array([0.0, 0.2, 0.4]), np.tile(np.eye(4), (3, 1, 1)))
    flight = Flight(scans, prior, np.eye(4))
    found = run(flight, Careless())
    np.testing.assert_array_equal(found.corrected.position, 1.0)
    np.testing.assert_array_equal(flight.prior.position, 0.0)
    for points in (None, np.zeros((5, 2)), [[1.0, 2.0, np.nan]]):
        careless = Careless()
        careless.points = points
        with pytest.raises(InputError, match=r"Careless.map_points\(\)"):
            run(flight, careless)


def test_settings_belong_to_a_family_and_keep_their_method():
    with pytest.raises(InputError, match=r"OdometrySettings: of no family; OdometrySettings.preset\(method\)"):
        OdometrySettings(method="best")
    with pytest.raises(InputError, match="method = 'gicp': this is 'best'"):
        OdometrySettings.preset("best").override({"method": "gicp"})


class Late:
    """Scans that are read one by one, with stamps of their own."""

    def __len__(self):
        return 3

    def __getitem__(self, k):
        if k == 3:
            raise IndexError
        return Scan(0.2 * k + 2e-6 * (k == 1), CLOUD)


def test_scans_that_are_read_at_other_times_than_their_poses_are_refused():
    prior = Trajectory(np.array([0.0, 0.2, 0.4]), np.tile(np.eye(4), (3, 1, 1)))
    with pytest.raises(InputError, match=r"flight, scan 1: at 0.20000\d* s, 2e-06 s after its pose; expected the same"):
        run(Flight(Late(), prior, np.eye(4)), Careless())
