"""Every notebook once through papermill at its smoke budget, with its numbers checked."""

import json
import math
import re
from pathlib import Path

import matplotlib.pyplot as plt
import nbformat
import numpy as np
import pandas as pd
import pytest

from steelnb.claims import read_claims
from workflow.__main__ import cache_folder
from workflow.experiments import make_parts
from workflow.task_notebooks import merge, run

ROOT = Path(__file__).parents[1]
COLOURED_MIN = 0.001  # axes and text alone have none
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
AXES = ("middle of points", "section fitted")


def coloured(path: Path) -> float:
    """Share of the pixels of a picture that are neither white nor grey: curves and points, not axes."""
    pixels = plt.imread(path)[..., :3]
    return float((np.ptp(pixels, axis=2) > 0.2).mean())


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_holds_short_cells_and_no_functions(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    assert notebook.metadata.kernelspec.name == "python3"
    assert sum("parameters" in cell.metadata.get("tags", []) for cell in code) == 1
    for cell in code:
        assert not cell.outputs
        assert cell.execution_count is None
        lines = cell.source.splitlines()
        assert not any(line.lstrip().startswith(("def ", "class ")) for line in lines)
        assert not re.search(r"import .*\b_\w|\w\._\w", cell.source), "something private"
        statements = [line for line in lines if line and not line.startswith(("import ", "from "))]
        assert len(statements) <= 20 or "parameters" in cell.metadata.get("tags", [])


@pytest.fixture(scope="session")
def smoke(tmp_path_factory):
    """The results of every notebook at its smoke budget, of those up to date from the cache.

    Of a notebook that several parts or experiments share the first part alone is run: the others run the same cells.
    """
    folder, cache = tmp_path_factory.mktemp("smoke"), cache_folder(ROOT, ROOT / "results-smoke")
    parts = {part.experiment.notebook: part for part in reversed(make_parts(ROOT, [], "smoke"))}.values()
    faults = run([*parts], cache, ROOT / ".cache")
    assert not any(faults.values()), faults
    for part in parts:
        merge([part], cache, folder / part.id, "smoke")
    return folder


def test_the_notebook_to_explore_flies_and_corrects(smoke):
    table = pd.read_csv(smoke / "explore" / "table.csv")
    assert len(table) == 1
    assert (table["ate_rmse_m"] < 0.5 * table["raw_ate_rmse_m"]).all()
    assert coloured(smoke / "explore" / "fig_flight.png") > COLOURED_MIN


def test_the_world_notebook_finds_the_drift_of_the_model(smoke):
    table = pd.read_csv(smoke / "world-and-noise" / "table.csv")
    assert set(table["noise"]) == {"random-walk", "constant-drift", "yaw-random-walk"}
    assert (table["rms"] / table["expected_rms"]).between(0.85, 1.15).all()
    metrics = json.loads((smoke / "world-and-noise" / "metrics.json").read_text())
    assert metrics["vertical.members_seen"] >= 10
    for name in ("fig_3_1.png", "fig_drift.png"):
        assert coloured(smoke / "world-and-noise" / name) > COLOURED_MIN


def test_the_segmentation_notebook_corrects_the_drift(smoke):
    table = pd.read_csv(smoke / "segmentation-odometry" / "table.csv")
    assert set(table["method"]) == {"none", "report-segments", "average", "least_squares"}
    assert (table["report_max_m"] > table["report_mean_m"]).all()
    final = table.pivot(index=["trajectory", "sensor"], columns="method", values="error_final_m")
    assert np.allclose(final["none"], 0.0828e-3 * 125 * 22, rtol=0.03), "the report's constant drift"
    # The first scan is off by 0.12 m, as is the map from there on.
    assert (final[["average", "least_squares"]].max(axis=1) < 0.85 * final["none"]).all()
    assert (final["least_squares"] < final["average"]).all()
    names = {path.name for path in (smoke / "segmentation-odometry").glob("fig_*.png")}
    assert {f"fig_{figure}_vertical-report.png" for figure in ("3_2", "3_4")} <= names
    timing = pd.read_csv(smoke / "segmentation-odometry" / "timing.csv")
    assert {"preprocess", "hough", "match", "map", "frame"} <= set(timing["stage"])


def test_the_icp_notebook_flies_the_report_s_programs_beside_the_methods_as_they_should_be(smoke):
    table = pd.read_csv(smoke / "cloud-odometry" / "table.csv")
    assert not table.duplicated(["trajectory", "noise", "method", "map", "sensor", "seed"]).any()
    assert table.notna().all(axis=None)
    own = {"icp", "icp-3dof", "gicp"}
    for where, rows in table.groupby("trajectory"):
        first = rows.set_index("method")
        assert set(first.index) == own | {f"report-{name}" for name in own} | {"best"}, where
        assert first["scans"]["gicp"] < 0.25 * first["scans"]["icp"], "a busy program misses scans"
        assert first["error_final_m"]["best"] < 0.7 * first["raw_error_final_m"]["best"], where
        # A rotation dropped after the solve is no restricted solve: that is the fault of the report's program.
        assert first["error_final_m"]["icp-3dof"] < first["error_final_m"]["report-icp-3dof"], where
    assert set(table["trajectory"]) == {"orbit", "vertical"}
    assert (smoke / "cloud-odometry" / "fig_3_5_random-walk-report.png").is_file()


def test_the_comparison_notebook_measures_the_bend_of_each_cloud(smoke):
    table = pd.read_csv(smoke / "cloud-comparison" / "table.csv")
    assert table["method"].nunique() == 7
    for _, rows in table.groupby("method"):
        assert len(rows) >= 3
        assert (rows["height_m"].diff().dropna() > 0).all()
        assert rows[["tilt_deg", "offset_m", "blur_m"]].notna().all(axis=None)
    metrics = json.loads((smoke / "cloud-comparison" / "metrics.json").read_text())
    assert metrics["report.best.bend_deg"] < 1
    assert metrics["report.best.offset_max_m"] < 0.16  # the first scan, at 12 s, is off by 0.12 m
    assert metrics["report.icp-3dof.tilt_max_deg"] < metrics["report.icp.tilt_max_deg"]


def test_the_convergence_notebook_maps_the_basin_and_searches(smoke):
    folder = smoke / "false-convergence"
    metrics = json.loads((folder / "metrics.json").read_text())
    labels = {name.rpartition(".")[0] for name in metrics if name.endswith(".radius_m")}
    assert len(labels) == 4
    for label in labels:
        shares = [metrics[f"{label}.{kind}_share"] for kind in ("right", "wrong", "refused")]
        assert sum(shares) == pytest.approx(1)
        assert shares[0] > 0, label  # a start at the truth itself comes home
        assert metrics[f"{label}.radius_m"] < 1.2
    wide, narrow = (f"3-DoF ICP, {distance} m" for distance in (0.5, 0.1))
    assert metrics[f"{wide}.right_share"] > metrics[f"{narrow}.right_share"]
    assert metrics[f"{wide}.wrong_share"] > metrics[f"{narrow}.wrong_share"]
    table = pd.read_csv(folder / "table.csv")
    assert len(table) == metrics["flights"] == 2 * 2 * 3
    assert set(table["method"]) == {"icp-3dof", "report-icp-3dof"}
    assert table["wrong"].sum() == metrics["flights_wrong"]
    assert {path.name for path in folder.glob("fig_*.png")} == {"fig_basin.png", "fig_3_10.png"}


def test_the_yaw_notebook_flies_every_method_and_best_takes_the_turn_out(smoke):
    table = pd.read_csv(smoke / "yaw-drift" / "table.csv")
    assert (table["scans"] == 35).all()
    methods = {"none", "least_squares", "icp-3dof", "gicp", "best", "average", "icp", "icp-4dof", "gicp-4dof"}
    for where, rows in table.groupby("trajectory"):
        ate = rows.set_index("method")["ate_rmse_m"]
        assert methods <= set(ate.index), where
        assert ate["none"] == pytest.approx(rows["raw_ate_rmse_m"].iloc[0])
        assert ate["best"] < min(ate["none"], ate["icp-3dof"], ate["least_squares"]), where
    assert table["trajectory"].nunique() == 2
    for figure in ("5_1", "5_2", "errors"):
        assert coloured(smoke / "yaw-drift" / f"fig_{figure}_report-4cm.png") > COLOURED_MIN


def test_the_accuracy_notebook_measures_seeds_and_gaps(smoke):
    table = pd.read_csv(smoke / "accuracy" / "table.csv")
    usual = table[table["world"] == "as preset"]
    assert usual["case"].nunique() == 4
    assert (usual["ate_rmse_m"] < 0.04).all()
    blind = usual["case"].str.endswith(", blind")
    assert usual["ate_outside_gaps_rmse_m"].notna().equals(blind)
    assert (usual.loc[blind, "error_after_gaps_max_m"] < 0.05).all()
    assert usual.groupby(["trajectory", "case", "method"])["seed"].nunique().ge(5).all()
    others = table[table["world"] != "as preset"]
    assert others["world"].nunique() >= 8
    ours = others[others["method"] == "faces"]
    assert (ours["ate_rmse_m"] < ours["raw_ate_rmse_m"]).all()
    assert {path.name for path in (smoke / "accuracy").glob("*.png")} == {
        f"fig_{name}_zigzag.png" for name in ("accuracy", "bands", "worlds")
    }


def test_the_segmentation_notebook_over_seeds_times_every_method_on_the_same_frames(smoke):
    folder = smoke / "segmentation-seeds"
    table, timing = (pd.read_csv(folder / name) for name in ("table.csv", "timing.csv"))
    assert table.groupby("method")["seed"].apply(list).map(tuple).nunique() == 1
    assert table.groupby("seed")["points"].nunique().eq(1).all()
    assert list(zip(timing["method"], timing["seed"], strict=True)) == list(
        zip(table["method"], table["seed"], strict=True)
    )
    recall = table.groupby("method")["recall"].mean()
    assert recall["hough"] > 0.8 > recall["dbscan"]
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["frame.hough.recall"] == pytest.approx(recall["hough"])
    assert 1 <= metrics["goals_reached"] <= metrics["goals"] == 5
    assert coloured(folder / "fig_seeds.png") > COLOURED_MIN


def test_the_segmentation_methods_notebook_compares_them_under_every_condition(smoke):
    folder = smoke / "segmentation-methods"
    table = pd.read_csv(folder / "table.csv")
    assert {"method", "scene", "noise_m", "recall", "precision", "angle_deg", "offset_m"} <= set(table)
    assert not table.duplicated(["scene", "noise_m", "clutter", "kept", "method", "seed"]).any()
    methods = {"hough", "ransac-lines", "ransac-planes", "dbscan", "gmm"}
    for condition, rows in table.groupby(["noise_m", "clutter", "kept"]):
        assert methods <= set(rows["method"]), condition
    usual = table[(table["noise_m"] == 0.02) & (table["kept"] == 1)].set_index("method")
    assert usual["recall"]["hough"] > 0.85
    assert usual["precision"]["hough"] > 0.95
    assert usual["recall"]["hough"] > usual["recall"][["ransac-planes", "dbscan", "gmm"]].max()
    assert usual["angle_deg"]["hough"] < 0.6
    assert usual["offset_m"]["hough"] < 0.012
    timing = pd.read_csv(folder / "timing.csv")
    assert methods <= set(timing["method"])
    names = {"fig_frame.png", "fig_conditions.png", "fig_tuning.png"}
    assert {path.name for path in folder.glob("fig_*.png")} == names


def test_the_claims_notebook_judges_every_claim_by_the_committed_study(smoke):
    folder = smoke / "claims"
    table = pd.read_csv(folder / "table.csv")
    claims = read_claims(ROOT / "notebooks" / "claims.toml")
    assert table["claim"].tolist() == [claim.claim for claim in claims.values()]
    judged = table[table["verdict"] != "not run"]
    assert set(judged["verdict"]) <= {"holds", "does not hold", "inconclusive"}
    assert len(judged) >= 20
    assert (judged["lowest"] <= judged["highest"]).all()
    assert (judged["n_seeds"] >= 5).all()
    assert (judged["as_claimed"] + judged["not_as_claimed"] <= judged["cells"]).all()
    held, refuted = (judged[judged["verdict"] == verdict] for verdict in ("holds", "does not hold"))
    assert (held["as_claimed"] == held["cells"]).all()
    assert (refuted["not_as_claimed"] > 0).all()
    # The drift of a random walk is known: its mean length after 180 s, by the Maxwell distribution.
    walk = table[table["metric"].str.startswith("raw_at_180_s_m")].iloc[0]
    expected_m = 0.002 * (125 * 180) ** 0.5 * (8 / math.pi) ** 0.5
    three_errors_m = 3 * 0.42 * expected_m / walk["n_seeds"] ** 0.5  # the distribution's spread is 0.42 of its mean
    assert abs(walk["lowest"] - expected_m) < three_errors_m
    assert abs(walk["highest"] - expected_m) < three_errors_m
    sections = {f"fig_claims_{section}.png" for section in ("1_1", "2_1_2", "3_1", "3_2_3", "3_3_3", "4", "5")}
    assert {path.name for path in folder.glob("fig_*.png")} == sections | {
        "fig_bands.png",
        "fig_bands_yaw.png",
        "fig_3_2_sweep.png",
    }


def test_the_structure_notebook_rebuilds_the_tower_and_hands_it_over(smoke):
    folder = smoke / "structure"
    table = pd.read_csv(folder / "table.csv")
    assert not table.duplicated(["poses", "method"]).any()
    assert len(table) == 3 * 2
    rows = table.set_index(["poses", "method"])
    exact, fixed = (rows.loc[(poses, "final")] for poses in ("true", "corrected"))
    assert exact["recall"] > 0.5
    assert exact["precision"] > 0.85
    assert fixed["offset_median_m"] < 0.03
    structure = json.loads((folder / "structure_corrected_zigzag.json").read_text())
    assert len(structure["bars"]) == fixed["bars"]
    assert len(structure["joints"]) == fixed["joints"]
    for figure in ("3_4", "errors", "recall", "near_side"):
        assert coloured(folder / f"fig_{figure}_zigzag.png") > COLOURED_MIN
    committed = ROOT / "results" / "structure"
    # A short flight sees most bars from one side alone, which tells less of their sections than a whole one.
    for where, share, trajectories in ((folder, 0.75, ["zigzag"]), (committed, 0.3, ["zigzag", "loops"])):
        numbers = json.loads((where / "metrics.json").read_text())
        for trajectory in trajectories:
            near = {axis: numbers[f"{trajectory}.near_side.{axis}.all.median_m"] for axis in AXES}
            assert abs(near["section fitted"]) < share * near["middle of points"], trajectory
    assert len(pd.read_csv(folder / "timing.csv")) == len(table)


def test_the_notebook_of_the_structure_over_seeds_flies_towers_of_other_sections(smoke):
    folder = smoke / "structure-accuracy"
    table = pd.read_csv(folder / "table.csv")
    assert set(table["tower"]) == {"light"}
    assert set(table["method"]) == {"final", "incremental"}
    final = table[table["method"] == "final"]
    assert (final["precision"] > 0.8).all()
    assert (final["recall"] > 0.4).all()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["zigzag.light.corrected.final.recall_mean"] == pytest.approx(final["recall"].iloc[0])


def test_the_notebook_for_your_own_recording_corrects_the_bag_that_it_flies(smoke):
    folder = smoke / "your-own-recording"
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["frames"] == metrics["frames_with_truth"] == 60
    assert metrics["corrected_ate_rmse_m"] < 0.5 * metrics["prior_ate_rmse_m"]
    assert metrics["structure_bars"] >= 10
    assert not any(name.endswith(("_ms", "_share")) for name in metrics)
    table = pd.read_csv(folder / "table.csv")
    assert table["recording"].tolist() == ["flight.bag"]
    assert pd.read_csv(folder / "timing.csv")["stage"].tolist() == ["run"]
    for name in ("path", "map"):
        assert coloured(folder / f"fig_{name}.png") > COLOURED_MIN


def test_the_notebook_of_honest_sensors_has_each_fault_and_both_sensors(smoke):
    folder = smoke / "honest-sensors"
    table = pd.read_csv(folder / "table.csv")
    assert set(table["case"]) == {"ideal", "honest, ideal's settings", "honest"}
    wide = table.pivot(index=["trajectory", "method"], columns="case", values="ate_mean_m")
    both = wide.dropna(subset=["ideal", "honest"])
    assert len(both) >= 4
    assert (both["honest"] > both["ideal"]).all()
    honest = table[table["case"] == "honest"]
    assert (honest["ate_mean_m"] < honest["drift_mean_m"]).all()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["all together.median_mm"] > metrics["range noise of the data sheet.median_mm"]
    assert metrics["range noise of the data sheet.lost_share"] == 0
    assert metrics["noise by amplitude, dropout.lost_share"] > 0.1
    assert metrics["wiggling.p95_mm"] == pytest.approx(5.0, abs=0.1)  # its amplitude
    assert metrics["multipath.mean_mm"] > 1  # ranges come out too long
    assert metrics["footprint: mixed pixels.mean_mm"] < -1  # what is near returns more light
    for name in ("frame", "imu", "honest"):
        assert coloured(folder / f"fig_{name}.png") > COLOURED_MIN


def test_the_notebook_of_the_planner_keeps_sight_where_the_loops_lose_it(smoke):
    folder = smoke / "planner"
    table = pd.read_csv(folder / "table.csv").set_index("flight")
    assert set(table.index) == {"loops", "planned", "up a face"}
    few = table["few_share"]
    assert few["planned"] < few["loops"]
    assert few["up a face"] < few["loops"]
    assert (table["clearance_m"] > 0.5).all()
    assert (table["ate_rmse_m"] < 0.5 * table["raw_ate_rmse_m"]).all()
    for name in ("paths", "time", "strip"):
        assert coloured(folder / f"fig_{name}_report-4cm.png") > COLOURED_MIN


def test_the_notebook_of_the_literature_has_loam_far_off(smoke):
    folder = smoke / "literature"
    table = pd.read_csv(folder / "table.csv")
    ideal = table[(table["sensor"] == "starling2") & (table["noise"] == "random-walk")]
    error = ideal.set_index(["trajectory", "method"])["ate_mean_m"]
    for flight, far in (("zigzag", 4), ("loops", 1.2)):
        assert error[flight, "loam"] > far * error[flight, "best"]
        assert error[flight, "orb"] < 0.1
    for name in ("2_1", "features", "error"):
        assert coloured(folder / f"fig_{name}.png") > COLOURED_MIN
