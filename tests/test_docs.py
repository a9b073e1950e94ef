"""Every page is followed literally: its files are saved, its commands and its Python run, in order. Links point to
existing files, and numbers on the first page agree with its files."""

import contextlib
import doctest
import importlib
import io
import math
import re
import shlex
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

from steelnb import cli
from steelnb.io import read_flight, write_tum
from steelnb.notebook.study import read_runs
from steelnb.settings import TowerSettings
from steelnb.simulation import build_tower
from tests.lattice import lattice, mesh_of, scanned

ROOT = Path(__file__).parents[1]
DOCS = ROOT / "docs"
PAGES = sorted(path.name for path in DOCS.glob("*.md"))
FENCE = re.compile(r"(.*?)^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)
SAVED = re.compile(r"[Ss]ave (?:this|it) as\s+`([^`]+)`")
LINKING = ("README.md", "results/README.md", "benchmarks/README.md", "CONTRIBUTING.md", "docs/index.md")
LINK = re.compile(r"""\]\(([^)#:\s]+)[^):]*\)|src="([^"]+)\"""")
WITH_EXAMPLES = (
    "steelnb.hough.lines", "steelnb.hough.segments", "steelnb.registration.icp", "steelnb.settings.experiment",
    "steelnb.settings.world",
)  # fmt: skip


def follow(page: str) -> tuple[dict, str]:
    """Follow a page in the working directory. Returns the names that its Python defines, and its output."""
    names, python, said, saved = {}, "", io.StringIO(), None
    for text, language, block in FENCE.findall((DOCS / page).read_text(encoding="utf-8")):
        found = SAVED.search(text)
        saved = found[1] if found else saved
        if language == "python":
            python += block
            with contextlib.redirect_stdout(said):
                exec(compile(block, page, "exec"), names)
        if language == "sh":
            for line in block.splitlines():
                run(shlex.split(line))
        elif saved and (Path(saved).suffix in (".toml", ".py") or language == "text"):
            Path(saved).write_text(python if language == "python" else block, encoding="utf-8")
    return names, said.getvalue()


def run(words: list[str]) -> None:
    """Run one command of a page. For `make` it is enough that the target exists."""
    if words[0] == "make":
        assert re.search(rf"^{words[1]}:", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    else:
        assert words[0] == "steelnb"
        if "theirs.tum" in words:  # the other program of the page
            write_tum("theirs.tum", read_flight("flight.mcap").prior)
        sys.modules.pop("mine", None)
        assert cli.main([*words[1:], "--force"]) == 0 if words[1] == "record" else cli.main(words[1:]) == 0


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    trimesh.PointCloud(scanned(lattice(8, 4, 2, 3), 40, 0.06, 0.01)).export("tower.ply")
    return tmp_path


def authors_mesh() -> trimesh.Trimesh:
    """A mesh in units and axes of the authors', of our own pole."""
    mesh = mesh_of(build_tower(TowerSettings.preset("report")))
    mesh.apply_translation((0.04, 0.04, -0.07))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-math.pi / 2, (1, 0, 0)))
    return mesh.apply_scale(1 / 0.003)


def test_the_start_and_the_report(here):
    names, said = follow("index.md")
    assert names["result"].metrics["ate_rmse_m"] < names["result"].metrics["raw_ate_rmse_m"]
    assert said.endswith("m corrected\n")
    authors_mesh().export("tower.stl")
    names, said = follow("report.md")
    assert said == "vertical random-walk report 202 scans\n"
    listed, placed = build_tower(TowerSettings.preset("report")), build_tower(names["settings"].tower)
    assert placed.settings.mesh == "pole.stl"
    for bound in (np.min, np.max):
        np.testing.assert_allclose(bound(placed.vertices, axis=0), bound(listed.vertices, axis=0), atol=1e-3)


def test_a_recording_is_corrected_compared_and_reconstructed(here, capfd):
    _, said = follow("recording.md")
    assert re.fullmatch(r"\d+ poses, [1-9]\d* bars of the flight, [1-9]\d* segments of the cloud\n", said)
    assert "theirs.tum" in capfd.readouterr().out
    assert {path.name for path in here.iterdir()} >= {"flight_run", "named", "beside", "bars", "tower.json"}


def test_settings_and_a_sensor_are_those_of_the_page(here):
    names, said = follow("settings.md")
    assert said.startswith("10.0 5.0\n")
    assert names["odometry"].settings.preprocess.floor_m == -10.0
    assert len(build_tower(names["mast"].tower).members) == 5
    assert names["result"].settings.tof.columns == 120
    assert names["result"].metrics["ate_rmse_m"] < names["result"].metrics["raw_ate_rmse_m"]
    assert names["settings"].inertial.gyro_noise == 1.4e-4


def test_the_new_odometry_takes_drift_out(here):
    names, _ = follow("odometry.md")
    assert names["after"] < 0.5 * names["before"]
    assert (here / "flight_run" / "corrected.tum").exists()
    assert (here / "scan-to-map" / "map.png").exists()


def test_the_study_has_its_runs(here):
    names, _ = follow("study.md")
    assert len(names["table"]) == len(read_runs(here / "my-results")) == 8


def test_a_planned_flight_is_recorded(here):
    follow("method.md")
    assert (here / "around.mcap").exists()


@pytest.mark.parametrize("page", ["../README.md", "../CONTRIBUTING.md", *PAGES])
def test_commands_that_a_page_names_exist(page):
    text = (DOCS / page).read_text(encoding="utf-8")
    targets = re.findall(r"^(\w+):", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)
    assert {target for target in re.findall(r"`make (\w+)", text)} <= set(targets)
    known = {command.callback.__name__ for command in cli.app.registered_commands}
    assert set(re.findall(r"^`?steelnb (\w+)", text, re.MULTILINE)) <= known


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_in_docstrings(module):
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted >= 1
    assert result.failed == 0


@pytest.mark.parametrize("page", LINKING)
def test_the_files_that_a_page_links_are_there(page):
    links = [one or other for one, other in LINK.findall((ROOT / page).read_text(encoding="utf-8"))]
    assert links
    assert [link for link in links if not (ROOT / page).parent.joinpath(link).exists()] == []
