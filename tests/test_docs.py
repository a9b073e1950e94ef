"""The examples of the documentation are run as they stand; those that want files of a recording were run by hand."""

import contextlib
import doctest
import importlib
import io
import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[1] / "docs"
FENCE = re.compile(r"^```(\w+)\n(.*?)^```", re.DOTALL | re.MULTILINE)
WITH_EXAMPLES = (
    "steelnb.hough.lines", "steelnb.hough.segments", "steelnb.registration.api", "steelnb.settings.experiment",
    "steelnb.settings.world",
)  # fmt: skip


def blocks(page: str, language: str) -> str:
    """The fenced blocks of a page in one language, one after the other."""
    found = FENCE.findall((DOCS / page).read_text(encoding="utf-8"))
    return "\n".join(text for name, text in found if name == language)


def run(page: str) -> tuple[dict, str]:
    """The names that a page's Python leaves, and what it prints."""
    names: dict = {}
    with contextlib.redirect_stdout(io.StringIO()) as said:
        exec(compile(blocks(page, "python"), page, "exec"), names)
    return names, said.getvalue()


@pytest.mark.parametrize("module", WITH_EXAMPLES)
def test_examples_in_docstrings(module):
    result = doctest.testmod(importlib.import_module(module))
    assert result.attempted >= 1
    assert result.failed == 0


def test_the_new_odometry_takes_drift_out():
    names, said = run("howto/odometry.md")
    assert names["after"] < 0.5 * names["before"]
    assert said.endswith("m corrected\n")


def test_the_sensor_of_the_page_is_one(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.toml").write_text(blocks("howto/sensor.md", "toml").partition("based_on")[0], encoding="utf-8")
    names, _ = run("howto/sensor.md")
    assert (names["settings"].tof.columns, names["settings"].odometry.preprocess.crop_m) == (120, 5.0)
    assert names["result"].metrics["ate_rmse_m"] < names["result"].metrics["raw_ate_rmse_m"]


def test_settings_by_name_and_a_first_run():
    names, said = run("howto/settings.md")
    assert said == "10.0 5.0\n"
    assert names["odometry"].settings.preprocess.floor_m == -10.0
    names, _ = run("start.md")
    assert names["result"].metrics["ate_rmse_m"] < names["result"].metrics["raw_ate_rmse_m"]


def test_the_study_of_the_page_has_the_runs_that_it_says(tmp_path, monkeypatch):
    from steelnb.runs import read_grids

    (tmp_path / "my-study.toml").write_text(blocks("howto/study.md", "toml"), encoding="utf-8")
    assert f"{len(read_grids(tmp_path / 'my-study.toml'))} runs" in blocks("howto/study.md", "console")
    monkeypatch.chdir(tmp_path)  # where rows are kept
    assert len(run("howto/study.md")[0]["table"]) == 4
