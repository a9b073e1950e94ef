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
    assert names == {f"fig_{figure}_vertical-report.png" for figure in ("3_2", "3_4")}
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
    for figure in ("3_5", "3_7", "bend"):
        assert coloured(smoke / "cloud-odometry" / f"fig_{figure}_random-walk-report.png") > COLOURED_MIN


def test_the_icp_notebook_measures_the_bend_of_each_cloud(smoke):
    metrics = json.loads((smoke / "cloud-odometry" / "metrics.json").read_text())
    table = pd.read_csv(smoke / "cloud-odometry" / "table.csv").set_index(["trajectory", "method"])
    assert len(table) == 2 * 7
    for (flight, method), row in table.iterrows():
        for name in ("bend_deg", "tilt_max_deg", "yaw_max_deg", "offset_max_m", "blur_mean_m"):
            assert metrics[f"random-walk-report.cloud.{flight}.{method}.{name}"] == pytest.approx(row[name])
    for flight, rows in table.groupby("trajectory"):
        assert rows["bend_deg"].xs("best", level="method").item() < 1, flight
        tilt = rows["tilt_max_deg"].droplevel("trajectory")
        assert tilt["icp-3dof"] < tilt["icp"], flight


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


def test_the_yaw_notebook_flies_the_report_s_programs_and_best_takes_the_turn_out(smoke):
    table = pd.read_csv(smoke / "yaw-drift" / "table.csv").set_index("method")
    by_segments, by_clouds = {"none", "report-segments", "average"}, {"icp-3dof", "report-gicp", "gicp"}
    assert set(table.index) == by_segments | by_clouds | {"best", "faces"}
    assert set(table["trajectory"]) == {"vertical"}
    assert table["scans"]["gicp"] < 0.25 * table["scans"]["best"], "a busy program misses scans"
    ate, step, turn = (table[name] for name in ("ate_rmse_m", "rpe_rmse_m", "yaw_max_deg"))
    assert ate["none"] == pytest.approx(table["raw_ate_rmse_m"]["none"])
    # The first scan is off by 0.15 m, as is the map from there on, whatever the method.
    positions = ["none", "average", "icp-3dof"]
    for name in ("best", "faces"):
        assert ate[name] < min(ate["none"], ate["icp-3dof"]), name
        assert step[name] < 0.5 * step[positions].min(), name
        assert turn[name] < 0.6 * turn[positions].min(), name
    for figure in ("5_1", "5_2", "errors"):
        assert coloured(smoke / "yaw-drift" / f"fig_{figure}_vertical-report.png") > COLOURED_MIN


def test_the_accuracy_notebook_measures_seeds_and_gaps(smoke):
    table = pd.read_csv(smoke / "accuracy" / "table.csv")
    assert set(table["part"]) == {"report", "noises", "worlds"}
    usual = table[table["part"] == "noises"]
    assert usual["case"].nunique() == 4
    assert (usual["ate_rmse_m"] < 0.04).all()
    blind = usual["case"].str.endswith(", blind")
    assert usual["ate_outside_gaps_rmse_m"].notna().equals(blind)
    assert (usual.loc[blind, "error_after_gaps_max_m"] < 0.05).all()
    ours = usual[usual["method"].isin(["best", "faces"])]
    assert ours.groupby(["trajectory", "case", "method"])["seed"].nunique().ge(5).all()
    others = table[(table["part"] == "worlds") & (table["case"] != "as preset")]
    assert others["case"].nunique() >= 8
    faces = others[others["method"] == "faces"]
    assert (faces["ate_rmse_m"] < faces["raw_ate_rmse_m"]).all()
    report = table[table["part"] == "report"]
    assert set(report["trajectory"]) == {"vertical", "orbit"}
    assert (report["ate_rmse_m"] < 0.1 + 0.5 * report["raw_ate_rmse_m"]).all()
    for figure in ("report", "accuracy", "bands", "worlds"):
        assert coloured(smoke / "accuracy" / f"fig_{figure}.png") > COLOURED_MIN


def test_the_notebook_of_finding_bars_compares_every_method_on_the_same_frames_and_under_every_condition(smoke):
    folder = smoke / "segmentation-methods"
    table, timing = (pd.read_csv(folder / name) for name in ("table.csv", "timing.csv"))
    assert {"method", "scene", "noise_m", "recall", "precision", "angle_deg", "offset_m"} <= set(table)
    assert not table.duplicated(["scene", "noise_m", "clutter", "kept", "method", "seed"]).any()
    methods = {"hough", "ransac-lines", "ransac-planes", "dbscan", "gmm"}
    for condition, rows in table.groupby(["noise_m", "clutter", "kept"]):
        assert methods <= set(rows["method"]), condition
    usual = table[(table["noise_m"] == 0.02) & (table["clutter"] == 0.1) & (table["kept"] == 1)]
    quick = usual[usual["method"] != "gmm"]  # which sees the first frame of each seed alone
    assert usual.groupby("method")["seed"].apply(list).map(tuple).nunique() == 1
    assert quick.groupby("seed")["points"].nunique().eq(1).all()
    assert timing[["method", "seed"]].equals(usual[["method", "seed"]].reset_index(drop=True))
    means = usual.groupby("method")[["recall", "precision", "angle_deg", "offset_m"]].mean()
    assert means["recall"]["hough"] > 0.85
    assert means["precision"]["hough"] > 0.95
    assert means["recall"]["hough"] > means["recall"][["ransac-planes", "dbscan", "gmm"]].max()
    assert means["recall"]["dbscan"] < 0.8
    assert means["angle_deg"]["hough"] < 0.6
    assert means["offset_m"]["hough"] < 0.012
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["frame.hough.recall"] == pytest.approx(means["recall"]["hough"])
    assert 1 <= metrics["goals_reached"] <= metrics["goals"] == 5
    names = {"fig_frame.png", "fig_seeds.png", "fig_conditions.png", "fig_tuning.png"}
    assert {path.name for path in folder.glob("fig_*.png")} == names
    for name in names:
        assert coloured(folder / name) > COLOURED_MIN


def test_the_committed_frames_of_the_claims_are_the_same_for_every_method():
    folder = ROOT / "results" / "segmentation-seeds"
    table, timing = (pd.read_csv(folder / name) for name in ("table.csv", "timing.csv"))
    usual = table[(table["noise_m"] == 0.02) & (table["clutter"] == 0.1) & (table["kept"] == 1)]
    assert usual.groupby("method")["seed"].apply(list).map(tuple).nunique() == 1
    assert usual.groupby("seed")["points"].nunique().eq(1).all()
    assert timing[["method", "seed"]].equals(usual[["method", "seed"]].reset_index(drop=True))


def test_the_claims_notebook_judges_every_claim_by_the_committed_study(smoke):
    folder = smoke / "claims"
    table = pd.read_csv(folder / "table.csv")
    claims = read_claims(ROOT / "notebooks" / "claims.toml")
    assert table["claim"].tolist() == [claim.claim for claim in claims.values()]
    judged = table[table["verdict"] != "not run"]
    assert set(judged["verdict"]) <= {"holds", "does not hold", "inconclusive"}
    assert len(judged) >= 20
    assert (judged["lowest"] <= judged["highest"]).all()
    assert (judged["n_seeds"] >= 4).all()
    assert (judged["as_claimed"] + judged["not_as_claimed"] <= judged["cells"]).all()
    held, refuted = (judged[judged["verdict"] == verdict] for verdict in ("holds", "does not hold"))
    assert (held["as_claimed"] == held["cells"]).all()
    assert (refuted["not_as_claimed"] > 0).all()
    # The drift of a random walk is known: its mean length after 180 s, by the Maxwell distribution.
    walk = table[table["measure"].str.startswith("raw_at_180_s_m")].iloc[0]
    expected_m = 0.002 * (125 * 180) ** 0.5 * (8 / math.pi) ** 0.5
    three_errors_m = 3 * 0.42 * expected_m / walk["n_seeds"] ** 0.5  # the distribution's spread is 0.42 of its mean
    assert abs(walk["lowest"] - expected_m) < three_errors_m
    assert abs(walk["highest"] - expected_m) < three_errors_m
    sections = {f"fig_claims_{section}.png" for section in ("1_1", "2_1_2", "3_1", "3_2_3", "3_3_3", "4", "5")}
    assert {path.name for path in folder.glob("fig_*.png")} == sections | {"fig_bands.png"}


def test_the_structure_notebook_rebuilds_towers_and_hands_one_over(smoke):
    folder = smoke / "structure"
    table = pd.read_csv(folder / "table.csv")
    assert not table.duplicated(["tower", "poses", "method"]).any()
    first, other = (table[table["tower"] == name] for name in ("tapered", "light"))
    assert (len(first), len(other)) == (3 * 2, 2)
    rows = first.set_index(["poses", "method"])
    exact, fixed = (rows.loc[(poses, "final")] for poses in ("true", "corrected"))
    assert exact["recall"] > 0.5
    assert exact["precision"] > 0.85
    assert fixed["offset_median_m"] < 0.03
    structure = json.loads((folder / "structure_corrected_zigzag.json").read_text())
    assert len(structure["bars"]) == fixed["bars"]
    assert len(structure["joints"]) == fixed["joints"]
    # The other tower, of other sections.
    assert set(other["method"]) == {"final", "incremental"}
    final = other[other["method"] == "final"]
    assert (final["precision"] > 0.8).all()
    assert (final["recall"] > 0.4).all()
    metrics = json.loads((folder / "metrics.json").read_text())
    assert metrics["zigzag.light.corrected.final.recall_mean"] == pytest.approx(final["recall"].iloc[0])
    for figure in ("3_4", "errors", "recall", "near_side", "structure_goals"):
        assert coloured(folder / f"fig_{figure}_zigzag.png") > COLOURED_MIN
    committed = ROOT / "results" / "structure"
    # A short flight sees most bars from one side alone, which tells less of their sections than a whole one.
    for where, share, trajectories in ((folder, 0.75, ["zigzag"]), (committed, 0.3, ["zigzag", "loops"])):
        numbers = json.loads((where / "metrics.json").read_text())
        for trajectory in trajectories:
            near = {axis: numbers[f"{trajectory}.near_side.{axis}.all.median_m"] for axis in AXES}
            assert abs(near["section fitted"]) < share * near["middle of points"], trajectory
    assert len(pd.read_csv(folder / "timing.csv")) == len(table)


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
    for name in ("paths", "time"):
        assert coloured(folder / f"fig_{name}_report-4cm.png") > COLOURED_MIN


def test_the_notebook_of_the_literature_has_loam_far_off(smoke):
    folder = smoke / "literature"
    table = pd.read_csv(folder / "table.csv")
    ideal = table[table["sensor"] == "starling2"]
    error = ideal.set_index(["trajectory", "method"])["ate_mean_m"]
    for flight, far in (("zigzag", 4), ("loops", 1.2)):
        assert error[flight, "loam"] > far * error[flight, "best"]
        assert error[flight, "orb"] < 0.1
    for name in ("2_1", "features", "error"):
        assert coloured(folder / f"fig_{name}.png") > COLOURED_MIN
