"""Every notebook through papermill at its smoke budget, with its numbers checked."""

import json
from pathlib import Path

import nbformat
import pandas as pd
import pytest

from steelnb import reproduce
from steelnb.project import find_root

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_is_parameters_calls_and_no_more(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert notebook.metadata.kernelspec.name == "python3"
    assert sum("parameters" in cell.metadata.get("tags", []) for cell in code) == 1
    for cell in code:
        assert not cell.outputs
        assert cell.execution_count is None
        assert not any(line.lstrip().startswith(("def ", "class ")) for line in cell.source.splitlines())


@pytest.fixture(scope="module")
def smoke(tmp_path_factory):
    folder = tmp_path_factory.mktemp("smoke")
    reproduce.run([], "smoke", output=folder, root=find_root(ROOT))
    return folder


def test_the_world_notebook_finds_the_drift_of_the_model(smoke):
    table = pd.read_csv(smoke / "world-and-noise" / "table.csv")
    assert set(table["noise"]) == {"random-walk", "constant-drift", "yaw-random-walk"}
    assert (table["rms"] / table["expected_rms"]).between(0.85, 1.15).all()
    metrics = json.loads((smoke / "world-and-noise" / "metrics.json").read_text())
    assert metrics["vertical.members_seen"] > 20
    for name in ("fig_3_1.png", "fig_drift.png"):
        assert (smoke / "world-and-noise" / name).stat().st_size > 50_000


def test_the_segmentation_notebook_corrects_the_drift(smoke):
    folder = smoke / "segmentation-odometry"
    table = pd.read_csv(folder / "table.csv")
    assert len(table) == 2 * 2 * 2 * 3
    assert set(table["method"]) == {"none", "average", "least_squares"}
    assert set(table["sensor"]) == {"report", "starling2"}
    good = table[(table["sensor"] == "starling2") & (table["method"] == "least_squares")]
    assert (good["error_mean_m"] < 0.03).all()
    assert (good["ate_rmse_m"] < 0.3 * good["raw_ate_rmse_m"]).all()
    names = {path.name for path in folder.glob("fig_*.png")}
    for part, figure in {"vertical": "3_2", "orbit": "3_3"}.items():
        for sensor in ("report", "starling2"):
            assert {f"fig_{figure}_{part}-{sensor}.png", f"fig_3_4_{part}-{sensor}.png"} <= names
    timing = pd.read_csv(folder / "timing.csv")
    assert set(timing["stage"]) == {"preprocess", "hough", "match", "map", "frame"}
