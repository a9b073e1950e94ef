"""The closing sentences of the notebooks say what their tables hold, whichever way a run turns out."""

import numpy as np
import pandas as pd
import pytest

from steelnb.report import conclusions


def odometry_rows(means: dict[str, float], flight: str = "zigzag", **more) -> pd.DataFrame:
    """Rows of `batch.cloud_table` of one flight: method → mean error; the drift has a root mean square of 0.4 m."""
    same = {"trajectory": flight, "noise": "random-walk", "map": "weighted", "sensor": "report-4cm", "seed": 1, **more}
    rows = pd.DataFrame({**same, "method": method, "error_mean_m": mean} for method, mean in means.items())
    rows = rows.assign(ate_rmse_m=1.1 * rows["error_mean_m"], raw_ate_rmse_m=0.4, unused_share=0.25)
    rows = rows.assign(error_max_m=2 * rows["error_mean_m"], error_final_m=rows["error_mean_m"])
    return rows.assign(report_mean_m=0.2, report_max_m=0.28, report_final_m=0.23)


def test_values_are_named_from_the_smallest_up():
    values = pd.Series({"gicp": 0.3, "best": 0.021, "other": np.nan})
    assert conclusions.ascending(values, 100, "cm") == "best 2.1, GICP 30.0 cm"


def test_methods_worse_than_the_drift_are_told():
    rows = pd.concat([odometry_rows({"icp": 0.5, "gicp": 0.1}), odometry_rows({"best": 0.02}, flight="loops")])
    assert conclusions.ranked(rows, column="error_mean_m") == [
        "**zigzag**: GICP 10.0, ICP 50.0 cm; worse than no correction: ICP.", "**loops**: best 2.0 cm."
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("means", "end"),
    [
        ({"icp": 0.5, "icp-3dof": 0.2, "gicp": 0.1}, "gicp < icp-3dof < icp, as the report says."),
        (
            {"icp": 0.2, "icp-3dof": 0.1, "gicp": 0.3},
            "icp-3dof < icp < gicp, not as the report says (gicp < icp-3dof < icp).",
        ),
    ],
)
def test_an_order_is_as_the_report_says_or_not(means, end):
    assert conclusions.orders(odometry_rows(means), list(means)) == [f"**zigzag**: by mean error {end}"]
    assert conclusions.orders(odometry_rows(means), ["icp"]) == []


@pytest.mark.parametrize(
    ("rms", "expected", "time_s", "words"),
    [
        (0.53, 0.52, 180, ["0.53 m off", "0.52 m by its model", "2.0% of the seeds", "drifts as its"]),
        (0.7, 0.5, 180, ["not as its model says", "at most 40%"]),
        (0.3, 0.3, 60, ["- Each noise drifts as its model says: measured and expected differ by at most 0%."]),
    ],
)
def test_drift(rms, expected, time_s, words):
    row = {"noise": "random-walk", "time_s": time_s, "unit": "m", "seeds": 200, "share_above_1": 0.02}
    said = conclusions.drift(pd.DataFrame([{**row, "rms": rms, "expected_rms": expected}]))
    assert all(word in said for word in words), said


def test_odometries_beside_the_report():
    said = conclusions.segment_odometry(odometry_rows({"none": 0.4, "average": 0.5, "least_squares": 0.02}))
    assert "least squares 2.0, average (report's) 50.0 cm" in said
    assert "average (report's): mean / largest / last error 0.500 / 1.000 / 0.500 m" in said
    assert "0.200 / 0.280 / 0.230 m; the mean is 2.5 times it" in said
    assert "Up to 25% of the scans" in said
    assert "within 30%" in conclusions.beside_report(odometry_rows({"report-segments": 0.25}))[0]
    assert conclusions.beside_report(odometry_rows({"average": 0.2}).assign(report_mean_m=np.nan)) == []
    times = pd.DataFrame({"stage": "frame", "method": ["icp", "gicp"], "median_ms": [10.0, 31.0]})
    clouds = odometry_rows({"icp": 0.5, "gicp": 0.1})
    assert "GICP takes 3.1 times as long as ICP" in conclusions.cloud_odometry(clouds, times, ["icp", "gicp"])
    assert "GICP takes" not in conclusions.cloud_odometry(clouds, times[:1], ["icp", "gicp"])
    bends = pd.DataFrame({"bend_deg": {"icp": 0.5, "gicp": 22.0}, "offset_max_m": 2.2, "yaw_max_deg": 3.0})
    assert "Bend of the clouds: ICP 0.5, GICP 22.0 °" in conclusions.bent_clouds(bends)
    said = conclusions.yaw_drift(odometry_rows({"none": 0.36, "icp-3dof": 0.5, "gicp": 0.1}), bends)
    assert "gicp < icp-3dof, as the report says" in said
    assert "Clouds turn by up to ICP 3.0, GICP 3.0 °" in said


def test_false_convergence():
    basins = pd.DataFrame({"radius_m": {"narrow": 0.1, "wide": 0.4}})
    case = {"method": "icp-3dof", "trajectory": "loops", "noise": "random-walk", "seed": 1, "max_correspondence_m": 0.5}
    flights = pd.DataFrame(
        [
            {**case, "blind_s": 0, "wrong_share": 0.0, "slip_m": 0.1, "error_final_m": 0.2, "wrong": False},
            {**case, "blind_s": 15, "wrong_share": 0.6, "slip_m": 0.9, "error_final_m": 1.5, "wrong": True},
        ]
    )
    said = conclusions.false_convergence(basins, flights, 0.03)
    assert "within narrow 0.10, wide 0.40 m" in said
    assert "1 of 2 flights converged wrongly: 0 of 1 with the tower always in sight, 1 of 1 with gaps." in said
    assert said.endswith("slips by 0.90 m within a second and ends 1.50 m off; best, on the same scans, 0.03 m.")


def test_methods_of_segmentation():
    means = pd.DataFrame({"recall": [0.96, 0.5], "precision": [0.97, 0.9]}, index=["hough", "gmm"])
    said = conclusions.segmentation(means, {"hough": 20.0, "gmm": 300.0})
    assert said.endswith("`gmm`: recall 0.500, precision 0.900, 300 ms a frame, 15.0 times the time of Hough.")
    row = {"method": "hough", "noise_m": 0.04, "recall": 0.9, "precision": 0.97, "angle_deg": 0.5, "offset_m": 0.01}
    votes = pd.DataFrame({"recall": [0.9, 0.92, 0.5], "precision": 0.9})
    rules = pd.DataFrame({"rule": ["chosen", "default"], "dx_m": [0.05, 0.14], "recall": [0.91, 0.7]})
    said = conclusions.noise_and_tuning(pd.DataFrame([row]), votes, rules)
    assert "With 4 cm of noise Hough has a recall of 0.90" in said
    assert "at 2 of 3 settings" in said
    assert said.endswith("chosen (5.0 cm) 0.01, default (14.0 cm) 0.22.")


def test_a_recording_with_truth_without_it_and_one_that_gets_worse():
    numbers = {"frames": 60, "used": 58, "prior_ate_rmse_m": 0.25}
    assert conclusions.recording(numbers).startswith("Of 60 scans, 58 corrected the pose. There is no truth")
    assert conclusions.recording(numbers | {"corrected_ate_rmse_m": 0.02}).endswith("by 2.0 cm, less than those.")
    assert conclusions.recording(numbers | {"corrected_ate_rmse_m": 0.3}).endswith("no less than those.")


def test_structures_and_their_goals():
    numbers = {"recall": 0.9, "precision": 0.99, "offset_median_m": 0.005, "joint_recall": 0.95, "ate_rmse_m": 0.012}
    rows = pd.DataFrame([{"poses": "corrected", "method": "final", "tower": "light", **numbers}])
    goals = pd.DataFrame({"goal": ["recall", "precision"], "reached": [True, False]})
    near = pd.DataFrame({"axis": ["middle", "fitted"], "kind": "all", "median_m": [0.021, -0.002]})
    said = conclusions.structure(rows, near, goals)
    assert "corrected poses (ATE 1.2 cm), final: recall 0.90, precision 0.99, axes off by 0.5 cm (median)" in said
    assert "by (median): fitted -0.2, middle 2.1 cm." in said
    assert said.endswith("1 of 2 goals are reached; not reached: precision.")
    said = conclusions.structure_over_seeds(rows, goals.assign(reached=True))
    assert "final, mean of 1 flights over 1 towers: recall 0.90" in said
    assert said.endswith("not reached: none.")


def test_accuracy_over_seeds_and_worlds():
    runs = pd.concat(odometry_rows({"best": ate}, case=case) for case, ate in (("calm", 0.02), ("calm, blind", 0.9)))
    said = conclusions.accuracy(runs, odometry_rows({"best": 0.05}, world="a wide tower"), 0.025)
    assert "1 of 1 means without gaps reach the goal of 2.5 cm." in said
    assert said.endswith("**a wide tower**: best 5.5 cm.")


def test_faults_planned_flights_and_the_literature():
    faults = pd.DataFrame({"fault": ["a", "b"], "median_mm": [2.0, 1.0]})
    cost = pd.DataFrame({"case": ["ideal", "honest"], "method": "best", "ate_mean_m": [0.02, 0.08]})
    said = conclusions.honest(faults, cost)
    for words in ("b 1.0, a 2.0 mm", "Mean ATE, honest: best 8.0 cm"):
        assert words in said
    flown = pd.DataFrame(
        {"flight": ["loops", "up a face"], "few_share": [0.06, 0.0], "ate_rmse_m": 0.1, "seen_share": 1}
    )
    assert "lost sight: up a face 0.0, loops 6.0 %." in conclusions.planned_flights(flown)
    runs = pd.concat(odometry_rows({"combined": 0.1, "loam": 0.2 + seed}, seed=seed) for seed in (1, 2))
    alone = odometry_rows({"combined": 9.0}, seed=3)  # a seed that no other flew
    said = conclusions.literature(pd.concat([runs, alone[alone["method"] == "loam"]]))
    assert said.endswith("(geometric mean): combined 1.0, LOAM 17.0.")
