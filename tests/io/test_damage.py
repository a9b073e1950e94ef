"""Damaged files of every reader: one of our errors on one line, or scans that say what is wrong with them."""

from collections import Counter
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from steelnb.errors import SteelnbError
from steelnb.io import read_flight, read_trajectory, write_flight, write_tum
from tests.io.samples import KINDS, made_up, mutated, poses
from tests.io.test_folders import tum

BUDGET = {"a.bag": 80, "a.mcap": 80, "a.db3": 80, "trajectory": 100, "depth.txt": 60, "image": 60, "settings": 200}
"""Mutations; with the 400 of messages and texts and the 600 of clouds, less than 2,000 in all."""


def outcome(path: Path, read: Callable = read_flight) -> str:
    """The type of the error that opening and reading ends in, or of the result."""
    try:
        found = read(path)
        scans = list(getattr(found, "scans", ()))
    except SteelnbError as caught:
        fault = caught
    else:
        assert all(bool(scan.fault) == (not scan.points.size) for scan in scans)
        assert not any("\n" in scan.fault for scan in scans)
        assert np.isfinite(getattr(found, "prior", found).T_world_drone).all()
        return type(found).__name__
    assert path.name in str(fault)
    assert "\n" not in str(fault)
    return type(fault).__name__


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_bags(tmp_path, name):
    write_flight(tmp_path / name, made_up(20, 12, 15))
    data, path = (tmp_path / name).read_bytes(), tmp_path / f"damaged{Path(name).suffix}"
    outcomes: Counter[str] = Counter()
    for noisy in mutated(data, BUDGET[name]):
        path.write_bytes(noisy)
        outcomes[outcome(path)] += 1
    assert outcomes["InputError"] > BUDGET[name] / 10


@pytest.mark.parametrize("name", KINDS)
@pytest.mark.parametrize(
    "data", [b"", b"garbage", b"\0" * 5000, b"#ROSBAG V2.0\n", b"\x89MCAP0\r\n", b"SQLite format 3\0"]
)
def test_garbage(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    assert outcome(tmp_path / name) == "InputError"


def test_trajectories(tmp_path):
    write_tum(tmp_path / "a.tum", poses(20))
    path, outcomes = tmp_path / "b.tum", Counter()
    for noisy in mutated((tmp_path / "a.tum").read_bytes(), BUDGET["trajectory"]):
        path.write_bytes(noisy)
        outcomes[outcome(path, read_trajectory)] += 1
    assert outcomes["InputError"] > BUDGET["trajectory"] / 10


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind"), [("depth.txt", "depth.txt"), ("depth/1.png", "image"), ("s.toml", "settings")]
)
def test_folders_of_depth_images(tmp_path, name, kind):
    folder = tum(tmp_path / "a", size=(12, 16))
    (folder / "settings.toml").write_text(
        "[extrinsics]\ntranslation_m = [1, 2, 3]\nrotation_rpy_deg = [0.0, 10.0, 90.0]\n[intrinsics]\nfx = 20.0\n"
        "fy = 20.0\ncx = 8.0\ncy = 6.0\nwidth = 16\nheight = 12\ndepth_scale = 0.001\n"
    )
    file = folder / ("settings.toml" if kind == "settings" else name)
    outcomes: Counter[str] = Counter()
    for noisy in mutated(file.read_bytes(), BUDGET[kind], seed=1):
        file.write_bytes(noisy)
        outcomes[outcome(folder)] += 1
    assert outcomes["Flight"] > 0
    assert outcomes.total() > outcomes["Flight"] or kind == "image"
