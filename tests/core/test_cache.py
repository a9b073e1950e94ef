"""Cached results are the same bits as computed ones."""

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from pathlib import Path

import numpy as np
import pytest

from steelnb import experiment
from steelnb.core import cache
from steelnb.core.types import RangeScans
from steelnb.settings import ExperimentSettings

GIVEN = {"trajectory": "loops", "noise": "random-walk", "sensor": "report-4cm", "duration_s": 2.0}
SETTINGS = ExperimentSettings.preset(**GIVEN)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    monkeypatch.setenv("STEELNB_CACHE", str(tmp_path))
    yield tmp_path
    cache._memory.cache_clear()


@pytest.fixture
def made(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """The names of the functions of `experiment` that were called, in order."""
    found: list[str] = []
    for name in ("fly", "correct"):
        call = getattr(experiment, name)
        counted = lambda *a, name=name, call=call, **kw: (found.append(name), call(*a, **kw))[1]  # noqa: E731
        monkeypatch.setattr(experiment, name, counted)
    return found


def leaves(value: object) -> list:
    """All arrays and plain values in a nested dataclass, in order, without measured times."""
    if is_dataclass(value):
        names = [each.name for each in fields(value) if each.name not in ("seconds", "update_s")]
        return [leaf for name in names for leaf in leaves(getattr(value, name))]
    if isinstance(value, RangeScans):
        return [value.stamp_s, value.range_m, value.ray]
    if isinstance(value, tuple | list):
        return [leaf for each in value for leaf in leaves(each)]
    return [value] if isinstance(value, np.ndarray | str | int | float) else []


def assert_same(one: object, two: object) -> None:
    assert len(leaves(one)) == len(leaves(two)) > 5
    for a, b in zip(leaves(one), leaves(two), strict=True):
        if isinstance(a, np.ndarray):
            assert a.dtype == b.dtype
            assert a.strides == b.strides or not a.size, "sums go in the same order"
            assert np.array_equal(a, b, equal_nan=a.dtype.kind == "f")
        else:
            assert a == b


@pytest.mark.parametrize("method", ["least_squares_yaw", "icp", "faces", "report-icp"])
def test_cached_flights_and_estimates_are_the_same_bits(folder, made, monkeypatch, method):
    settings = ExperimentSettings.preset(**GIVEN, method=method)
    runs = []
    for _ in range(2):
        flight, truth = experiment.simulate(settings)
        runs.append((flight, truth, experiment.estimate(settings, flight, truth)))
    assert made == ["fly", "correct"]
    for one, two in zip(*runs, strict=True):
        assert_same(one, two)
    assert runs[0][2].metrics == runs[1][2].metrics
    assert np.array_equal(runs[0][2].update_s, runs[1][2].update_s)  # the time when it was computed


def test_a_change_recomputes_only_what_depends_on_it(folder, made):
    experiment.run(SETTINGS)
    for made_anew, changes in {
        ("correct",): (
            {"noise_name": "random-walk:0.5"}, {"imu": {"gyro_noise": 1e-3}}, {"hough.dx_m": 0.05},
            {"tof.sigma_floor_m": 0.02}, {"tof.draw": 3},
        ),
        ("fly", "correct"): (
            {"tof.blind_s": [[0.5, 1.0]]}, {"tof.faults": ["footprint"]}, {"flight.gust_sigma_m_s": 0.01},
            {"tower.profile_m": [[0.0, 4.1], [9.0, 1.7], [16.0, 1.0]]},
        ),
    }.items():  # fmt: skip
        for changed in changes:
            del made[:]
            for _ in range(2):
                experiment.run(SETTINGS.override(changed))
            assert tuple(made) == made_anew, changed


def test_a_list_of_members_is_hashed_by_its_content(folder, made, tmp_path):
    text = (cache.PACKAGE / "settings" / "presets" / "report-tower.csv").read_text()
    (tmp_path / "mine.csv").write_text(text)
    mine = ExperimentSettings.report("3.5", "vertical", "icp").override(
        {"tower.members": str(tmp_path / "mine.csv"), "flight.duration_s": 6.0}
    )
    experiment.simulate(mine)
    experiment.simulate(mine)
    assert made == ["fly"]
    (tmp_path / "mine.csv").write_text("".join(text.splitlines(keepends=True)[:-1]))
    experiment.simulate(mine)
    assert made == ["fly", "fly"]


def test_changed_sources_and_unreadable_entries_are_computed_again(folder, made, monkeypatch):
    first, _ = experiment.simulate(SETTINGS)
    (file,) = folder.rglob("output.pkl")
    whole = file.read_bytes()
    for damaged in (whole[: len(whole) // 2], b""):
        file.write_bytes(damaged)
        assert_same(first, experiment.simulate(SETTINGS)[0])
    assert made == ["fly"] * 3
    monkeypatch.setattr(cache, "SOURCES", "other code")
    experiment.simulate(SETTINGS)
    assert made == ["fly"] * 4


def test_sources_include_code_and_presets_but_not_pictures(tmp_path, monkeypatch):
    files = ("hough/votes.py", "settings/presets/methods.toml", "plots/style.py", "notebook/runs.py")
    for name in files:
        (tmp_path / name).parent.mkdir(exist_ok=True, parents=True)
        (tmp_path / name).write_text("a = 1\n")
    monkeypatch.setattr(cache, "PACKAGE", tmp_path)

    def digests():
        return cache.digest_rooms(*cache.ROOMS), cache.digest_rooms()

    before = digests()
    (tmp_path / "hough" / "__pycache__").mkdir()
    (tmp_path / "hough" / "__pycache__" / "votes.nbi").write_text("of Numba")
    assert digests() == before
    for name, counts in zip(files, (True, True, False, False), strict=True):
        (tmp_path / name).write_text("a = 2\n")
        assert (digests()[0] != before[0]) is counts
        assert digests()[1] != before[1]
        (tmp_path / name).write_text("a = 1\n")
    monkeypatch.setattr(cache, "LIBRARIES", ())
    assert digests()[0] != before[0]


def test_every_room_that_a_result_depends_on_counts():
    """What the page of the method imports, directly or not, is among the rooms."""
    code = "import sys, steelnb.experiment; print(*(name for name in sys.modules if name.startswith('steelnb.')))"
    loaded = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.split()
    assert {name.split(".")[1] for name in loaded} - {room.removesuffix(".py") for room in cache.ROOMS} == set()


def test_the_least_recently_used_entries_are_deleted(folder, monkeypatch):
    for seed in (1, 2, 3):
        experiment.simulate(SETTINGS.replace(seed=seed))
    sizes = [path.stat().st_size for path in folder.rglob("output.pkl")]
    monkeypatch.setattr(cache, "BYTES_MAX", 2.5 * max(sizes))
    cache._memory.cache_clear()
    experiment.simulate(SETTINGS.replace(seed=3))
    assert len(list(folder.rglob("output.pkl"))) == 2
