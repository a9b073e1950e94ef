"""A user's own class: found by module or file, given copies, and refused in a line where it cannot be used."""

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.core.estimates import OdometryStep
from steelnb.core.types import Flight, Imu, Scan, Segments, Trajectory
from steelnb.odometry import correct, load_odometry, run
from steelnb.settings import OdometrySettings

STAMP_S = 0.2 * np.arange(3)
MODULE = """
import sys, abc, steelnb
class Held:
    def update(self, scan, T): return steelnb.OdometryStep(scan.stamp_s, T)
class Abstract(abc.ABC):
    @abc.abstractmethod
    def update(self, scan, T): ...
class Positional(Held):
    def __init__(self, T_drone_sensor, /): ...
"""


@pytest.fixture
def flight():
    cloud, T = np.random.default_rng(0).uniform(1, 2, (50, 3)), np.tile(np.eye(4), (3, 1, 1))
    imu = Imu(STAMP_S, np.ones((3, 3)), np.ones((3, 3)))
    return Flight([Scan(s, cloud.copy()) for s in STAMP_S], Trajectory(STAMP_S, T), np.eye(4), imu)


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A working directory with modules of a user's."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "dont_write_bytecode", True)
    for name, text in {"owner": MODULE, "unguarded": MODULE + "sys.exit(0)", "in/numpy": MODULE}.items():
        (tmp_path / f"{name}.py").parent.mkdir(exist_ok=True)
        (tmp_path / f"{name}.py").write_text(text)
    yield tmp_path
    for name in ("owner", "unguarded"):
        sys.modules.pop(name, None)


def test_a_class_is_found_by_its_module_and_by_its_file(here: Path):
    for name in ("owner", "owner.py", "./owner.py", f"{here}/owner.py"):
        assert load_odometry(f"{name}:Held").__name__ == "Held"


@pytest.mark.parametrize(
    ("name", "says"),
    [
        ("unguarded:Held", r"module 'unguarded' cannot be imported: SystemExit\(0\)"),
        ("owner:Abstract", "owner:Abstract: an abstract class; expected one with update"),
        ("owner:Positional", "its constructor needs T_drone_sensor; expected T_drone_sensor, imu, images, by name"),
        ("none.py:Held", "none.py:Held: no file none.py; expected FILE.py:CLASS"),
        ("in/numpy.py:Held", "'numpy' is the name of another module, in .*; rename the file"),
        ("time:Held", "time:Held: no class 'Held' in Python itself"),
    ],
)
def test_what_cannot_be_used_is_refused_in_a_line(here: Path, name: str, says: str):
    with pytest.raises(InputError, match=says):
        load_odometry(name)


class Grasping:
    """Changes whatever it is given."""

    def __init__(self, T_drone_sensor, imu):
        T_drone_sensor[:3, 3] += 9.0
        imu.specific_force[:] = 0.0

    def update(self, scan, T_world_drone_prior):
        scan.points[:] = np.nan
        return OdometryStep(scan.stamp_s, T_world_drone_prior, False, "not\n used")


def test_a_class_changes_neither_mount_nor_readings_nor_scans_of_a_flight(flight):
    found = correct(flight, OdometrySettings.preset("best"), own=Grasping)
    np.testing.assert_array_equal(flight.T_drone_sensor, np.eye(4))
    np.testing.assert_array_equal(flight.imu.specific_force, 1.0)
    assert all(np.isfinite(scan.points).all() for scan in flight.scans)
    assert set(found.reason) == {"not used"}, "on one line"


class Kept:
    def update(self, scan, T_world_drone_prior):
        return OdometryStep(scan.stamp_s, T_world_drone_prior)


@pytest.mark.parametrize("name", ["__init__", "update", "map_points"])
def test_a_class_that_fails_is_refused_with_its_line(flight, name):
    class Failing(Kept):
        pass

    setattr(Failing, name, lambda *_: {}["pose"])
    with pytest.raises(InputError, match=r"Failing.*raises KeyError: 'pose' \(.*test_plugins.py, line \d+\)") as found:
        correct(flight, OdometrySettings.preset("best"), own=Failing)
    assert isinstance(found.value.__cause__, KeyError)


def test_bars_that_are_not_finite_are_refused(flight):
    odometry = Kept()
    odometry.map_segments = lambda: Segments(np.full((1, 3), np.nan), np.ones((1, 3)), np.ones(1), np.ones(1))
    with pytest.raises(InputError, match=r"Segments\.start\[0, 0\] = nan"):
        run(replace(flight), odometry)
