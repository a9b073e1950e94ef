"""Notebooks with a list of methods run with one of each family, in this process and on flights that they share. What
05 does with its methods, 02 and 03 do as well."""

import json
import sys
import types
from pathlib import Path

import matplotlib.pyplot as plt
import pandas as pd
import pytest

from steelnb.core import cache
from steelnb.settings import METHODS, OdometrySettings

NOTEBOOKS = Path(__file__).parents[2] / "notebooks"
ONE_EACH = list({OdometrySettings.preset(name).family: name for name in METHODS}.values())
SHORT = {"noise": "random-walk", "duration_s": 20.0, "overrides": {"tof.start_s": 18.0}}


@pytest.fixture(scope="module")
def flights(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STEELNB_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield
    cache._memory.cache_clear()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("notebook", "given"),
    [
        ("02_segment_odometry", {"correction": ONE_EACH, "draws": 2}),
        (
            "03_icp_odometry",
            {"trajectory": ["vertical"], "methods": {"average": ONE_EACH}, "drawn": ONE_EACH, "draws": 2},
        ),
    ],
)
def test_a_method_of_each_family_works_in(
    notebook: str, given: dict, flights: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "__main__", main := types.ModuleType("__main__"))  # as in a notebook's process
    names = vars(main)
    for cell in json.loads((NOTEBOOKS / f"{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
            if cell["metadata"].get("tags") == ["parameters"]:
                names.update({**SHORT, **given, "results_dir": str(tmp_path)})
    plt.close("all")
    assert {*ONE_EACH} <= {*pd.read_csv(tmp_path / "table.csv")["method"]} <= {*ONE_EACH, "none"}
