"""The numbers of every notebook, as `make reproduce` has run it or, if that is not up to date, at its smoke budget."""

import json
import math
import re
from pathlib import Path

import nbformat
import numpy as np
import pandas as pd
import pytest

from steelnb.notebook.claims import read_claims
from workflow.run_notebooks import LATEST, cache_folder, latest_parts, run
from workflow.write_results import merge

ROOT = Path(__file__).parents[1]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
CELL_LINES_MAX = 15


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_checks_its_parameters_first_and_holds_short_cells_and_no_functions(path):
    notebook = nbformat.read(path, as_version=4)
    nbformat.validate(notebook)
    code = [cell for cell in notebook.cells if cell.cell_type == "code"]
    sources = [[line for line in cell.source.splitlines() if line and line[0] != "#"] for cell in code]
    assert notebook.metadata.kernelspec.name == "python3"
    assert ["parameters" in cell.metadata.get("tags", []) for cell in code] == [True] + [False] * (len(code) - 1)
    assert f'parameters.check("{path.stem}")' in next(line for line in sources[1] if "import " not in line)
    assert not any(cell.outputs or cell.execution_count for cell in code)
    assert not any(line.lstrip().startswith(("def ", "class ")) for lines in sources for line in lines)
    assert not any(re.search(r"import .*\b_\w|\w\._\w", cell.source) for cell in code), "something private"
    assert max(map(len, sources)) <= CELL_LINES_MAX


@pytest.fixture(scope="session")
def latest():
    """The parts whose outputs are tested, as `make docs` shows them, and the cache that holds these."""
    parts, cache = latest_parts(ROOT), cache_folder(ROOT, ROOT / LATEST)
    faults = run(parts, cache, ROOT / ".cache")
    assert not any(faults.values()), faults
    return parts, cache


@pytest.fixture(scope="session")
def folder(latest, tmp_path_factory):
    """A folder with the results of each experiment."""
    parts, cache = latest
    made = tmp_path_factory.mktemp("results")
    for part in parts:
        merge([part], cache, made / part.id, "latest")
    return made


@pytest.fixture
def results(folder):
    """A function that reads table.csv and metrics.json of an experiment."""

    def read(id):
        return pd.read_csv(folder / id / "table.csv"), json.loads((folder / id / "metrics.json").read_text())

    return read


def test_the_world_notebook_finds_the_drift_of_the_model(results):
    table, metrics = results("world-and-noise")
    assert set(table["noise"]) == {"random-walk", "constant-drift", "yaw-random-walk"}
    assert (table["rms"] / table["expected_rms"]).between(0.85, 1.15).all()
    assert metrics["vertical.members_seen"] >= 10


def test_the_segmentation_notebook_corrects_the_drift(results, folder):
    table, _ = results("segmentation-odometry")
    made_with = json.loads((folder / "segmentation-odometry" / "provenance.json").read_text())["parts"]
    flown_s = next(iter(made_with.values()))["constant-drift.average"]["flight"]["duration_s"]
    assert set(table["method"]) == {"none", "report-segments", "average", "least_squares"}
    assert (table["report_max_m"] > table["report_mean_m"]).all()
    final = table.pivot(index=["trajectory", "sensor"], columns="method", values="error_final_m")
    assert np.allclose(final["none"], 0.0828e-3 * 125 * flown_s, rtol=0.03), "the report's constant drift"
    # The first scan is off by 0.12 m, as is the map from there on.
    assert (final[["average", "least_squares"]].max(axis=1) < 0.85 * final["none"]).all()
    assert (final["least_squares"] < final["average"]).all()
    timing = pd.read_csv(folder / "segmentation-odometry" / "timing.csv")
    assert {"preprocess", "hough", "match", "map", "frame"} <= set(timing["stage"])


def test_the_icp_notebook_flies_the_report_s_programs_beside_the_methods_as_they_should_be(results):
    table, metrics = results("cloud-odometry")
    assert table.notna().all(axis=None)
    own = {"icp", "icp-3dof", "gicp"}
    assert set(table["trajectory"]) == {"orbit", "vertical"}
    for flight, rows in table.groupby("trajectory"):
        first = rows.set_index("method")
        assert sorted(first.index) == sorted([*own, *(f"report-{name}" for name in own), "best"]), flight
        assert first["scans"]["gicp"] < 0.25 * first["scans"]["icp"], "a busy program misses scans"
        # What has drifted before the first scan stays, 0.2 m here, so steps are compared.
        assert first["rpe_rmse_m"]["best"] < 0.8 * first["rpe_rmse_m"]["report-icp"], flight
        # Dropping the rotation after the solve is not a restricted solve: that is the error of the report's program.
        assert first["error_final_m"]["icp-3dof"] < first["error_final_m"]["report-icp-3dof"], flight
        assert first["bend_deg"]["best"] < min(2, 0.8 * first["bend_deg"]["report-icp"]), flight
        assert first["tilt_max_deg"]["icp-3dof"] < first["tilt_max_deg"]["icp"], flight
        for method, row in first.iterrows():
            for name in ("bend_deg", "tilt_max_deg", "yaw_max_deg", "offset_max_m", "blur_mean_m"):
                assert metrics[f"random-walk-report.cloud.{flight}.{method}.{name}"] == pytest.approx(row[name])


def test_the_convergence_notebook_maps_the_basin_and_searches(results):
    table, metrics = results("false-convergence")
    labels = {name.rpartition(".")[0] for name in metrics if name.endswith(".radius_m")}
    assert len(labels) == 4
    for label in labels:
        shares = [metrics[f"{label}.{kind}_share"] for kind in ("right", "wrong", "refused")]
        assert sum(shares) == pytest.approx(1)
        assert shares[0] > 0, label  # a start at the truth itself comes home
        assert metrics[f"{label}.radius_m"] < 1.2
    wide, narrow = (f"3-DoF ICP, {distance} m" for distance in (0.5, 0.1))
    assert metrics[f"{wide}.right_share"] > metrics[f"{narrow}.right_share"]
    assert 0 < metrics["pairs as in the report.gicp.right_share"] <= metrics["pairs within 0.5 m.gicp.right_share"]
    assert len(table) == metrics["flights"] == 2 * 2 * 3
    assert set(table["method"]) == {"icp-3dof", "report-icp-3dof"}
    assert table["wrong"].sum() == metrics["flights_wrong"]


def test_the_yaw_notebook_flies_the_report_s_programs_and_ours_follow_the_flight(results):
    table = results("yaw-drift")[0].set_index("method")
    by_segments, by_clouds = {"none", "report-segments", "average"}, {"icp-3dof", "report-gicp", "gicp"}
    assert set(table.index) == by_segments | by_clouds | {"best", "faces"}
    assert set(table["trajectory"]) == {"vertical"}
    assert table["scans"]["gicp"] < 0.25 * table["scans"]["best"], "a busy program misses scans"
    ate, step = table["ate_rmse_m"], table["rpe_rmse_m"]
    assert ate["none"] == pytest.approx(table["raw_ate_rmse_m"]["none"])
    # The first scan is off by 0.2 m and 0.9°, as is the map from there on, whatever the method; 14 s drift by less.
    positions = ["none", "report-segments", "average", "icp-3dof"]
    for name in ("best", "faces"):
        assert ate[name] < 0.8 * ate["none"], name
        assert step[name] < 0.7 * step[positions].min(), name


def test_the_accuracy_notebook_measures_seeds_and_gaps(results):
    table, _ = results("accuracy")
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


@pytest.mark.parametrize("id", ["segmentation-methods", "segmentation-seeds"])
def test_every_way_to_find_bars_sees_the_same_frames_under_every_condition(folder, id):
    own = folder / id if id == "segmentation-methods" else ROOT / "results" / id  # the frames of the claims
    table, timing = (pd.read_csv(own / name) for name in ("table.csv", "timing.csv"))
    assert not table.duplicated(["scene", "noise_m", "clutter", "kept", "method", "seed"]).any()
    for condition, rows in table.groupby(["noise_m", "clutter", "kept"]):
        assert {"hough", "ransac-lines", "ransac-planes", "dbscan", "gmm"} <= set(rows["method"]), condition
    usual = table[(table["noise_m"] == 0.02) & (table["clutter"] == 0.1) & (table["kept"] == 1)]
    quick = usual if id == "segmentation-seeds" else usual[usual["method"] != "gmm"]  # which sees fewer frames
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
    metrics = json.loads((own / "metrics.json").read_text())
    assert metrics["frame.hough.recall"] == pytest.approx(means["recall"]["hough"])


def test_the_claims_notebook_judges_every_claim_by_the_committed_study(results):
    table, _ = results("claims")
    claims = read_claims(ROOT / "notebooks" / "claims.toml")
    assert table["claim"].tolist() == [claim.claim for claim in claims.values()]
    judged = table[table["verdict"] != "not run"]
    assert set(judged["verdict"]) <= {"holds", "does not hold", "inconclusive"}
    assert len(judged) >= 20
    assert (judged["n_seeds"] >= 3).all()
    assert not (table["verdict"] == "not run").any()
    # The drift of a random walk is known: its mean length after 180 s, by the Maxwell distribution.
    walk = table[table["name"] == "random-walk"].iloc[0]
    expected_m = 0.002 * (125 * 180) ** 0.5 * (8 / math.pi) ** 0.5
    three_errors_m = 3 * 0.42 * expected_m / walk["n_seeds"] ** 0.5  # the distribution's spread is 0.42 of its mean
    assert abs(walk["lowest"] - expected_m) < three_errors_m
    assert abs(walk["highest"] - expected_m) < three_errors_m


def test_the_structure_notebook_rebuilds_towers_and_hands_one_over(results, folder):
    table, metrics = results("structure")
    assert not table.duplicated(["tower", "poses", "method"]).any()
    first, other = (table[table["tower"] == name] for name in ("tapered", "light"))
    assert (len(first), len(other)) == (3 * 2, 2)
    rows = first.set_index(["poses", "method"])
    error_m = rows["ate_rmse_m"].xs("final", level="method")
    assert error_m["raw"] > error_m["corrected"] > error_m["true"] == 0
    exact, fixed = (rows.loc[(poses, "final")] for poses in ("true", "corrected"))
    assert exact["recall"] > 0.5
    assert exact["precision"] > 0.85
    assert fixed["offset_median_m"] < 0.03
    structure = json.loads((folder / "structure" / "structure_corrected_zigzag.json").read_text())
    assert len(structure["bars"]) == fixed["bars"]
    assert len(structure["joints"]) == fixed["joints"]
    # The other tower, of other sections.
    assert set(other["method"]) == {"final", "incremental"}
    final = other[other["method"] == "final"]
    assert (final["precision"] > 0.8).all()
    assert (final["recall"] > 0.4).all()
    assert metrics["zigzag.light.corrected.final.recall_mean"] == pytest.approx(final["recall"].iloc[0])
    assert len(pd.read_csv(folder / "structure" / "timing.csv")) == len(table)
    committed = json.loads((ROOT / "results" / "structure" / "metrics.json").read_text())
    # A short flight sees most bars from one side alone, which tells less of their sections than a whole one.
    for numbers, share, flights in ((metrics, 1.0, ["zigzag"]), (committed, 0.35, ["zigzag", "loops"])):
        for flight in flights:
            axes = ("middle of points", "section fitted")
            middle, fitted = (abs(numbers[f"{flight}.near_side.{axis}.all.median_m"]) for axis in axes)
            assert middle > 0.004, flight
            assert fitted < share * middle, flight


def test_the_notebook_for_your_own_recording_corrects_the_bag_that_it_flies(results, folder):
    table, metrics = results("your-own-recording")
    assert metrics["frames"] == metrics["frames_with_truth"] in (60, 300)  # of 12 or 60 s
    assert metrics["corrected_ate_rmse_m"] < 0.5 * metrics["prior_ate_rmse_m"]
    assert metrics["structure_bars"] >= 10
    assert not any(name.endswith(("_ms", "_share")) for name in metrics)
    assert table["recording"].tolist() == ["flight.bag"]
    assert pd.read_csv(folder / "your-own-recording" / "timing.csv")["stage"].tolist() == ["run"]


def test_the_notebook_of_honest_sensors_has_each_fault_and_both_sensors(results):
    table, metrics = results("honest-sensors")
    assert set(table["case"]) == {"ideal", "honest, ideal's settings", "honest", "honest, calibrated"}
    wide = table.pivot(index=["trajectory", "method"], columns="case", values="ate_mean_m")
    both = wide.dropna(subset=["ideal", "honest"])
    assert len(both) >= 4
    assert (both["honest"] > both["ideal"]).all()
    for flight, seed, better in (("loops", 24, "calibrated"), ("zigzag", 24, "no multipath, no bias")):
        assert metrics[f"ate_mm.{flight}.smoothed.{seed}.{better}"] < 15
        assert metrics[f"ate_mm.{flight}.smoothed.{seed}.as it is"] > 20
    honest = table[table["case"] == "honest"]
    assert (honest["ate_mean_m"] < honest["drift_mean_m"]).all()
    assert metrics["all together.median_mm"] > metrics["range noise of the data sheet.median_mm"]
    assert metrics["range noise of the data sheet.lost_share"] == 0
    assert metrics["noise by amplitude, dropout.lost_share"] > 0.1
    assert metrics["wiggling.p95_mm"] == pytest.approx(5.0, abs=0.1)  # its amplitude
    assert metrics["multipath.mean_mm"] > 1  # ranges come out too long
    assert metrics["footprint: mixed pixels.mean_mm"] < -1  # what is near returns more light


def test_the_notebook_of_the_planner_keeps_sight_where_the_loops_lose_it(results):
    table = results("planner")[0].set_index("flight")
    assert set(table.index) == {"loops", "planned", "up a face"}
    few = table["few_share"]
    assert few["planned"] < few["loops"]
    assert few["up a face"] < few["loops"]
    assert (table["clearance_m"] > 0.5).all()
    assert (table["ate_rmse_m"] < 0.5 * table["raw_ate_rmse_m"]).all()


def test_the_notebook_of_the_literature_has_loam_far_off(results):
    table, _ = results("literature")
    error = table[table["sensor"] == "starling2"].set_index(["trajectory", "method"])["ate_mean_m"]
    for flight, far in (("zigzag", 4), ("loops", 1.2)):
        assert error[flight, "loam"] > far * error[flight, "best"]
        assert error[flight, "orb"] < 0.1
