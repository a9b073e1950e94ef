"""The closing sentences of the notebooks say what their tables hold, whichever way a run turns out."""

import pandas as pd
import pytest

from steelnb.report import conclusions, segmentation_conclusions
from steelnb.report.segmentation_tuning import CHOSEN, FIXED, REFERENCE


def drift_rows(rms: float, expected: float, share: float = 0.02, time_s: float = 180) -> pd.DataFrame:
    row = {"noise": "random-walk", "time_s": time_s, "unit": "m", "seeds": 200}
    return pd.DataFrame([{**row, "rms": rms, "expected_rms": expected, "share_above_1": share}])


@pytest.mark.parametrize(
    ("rows", "words"),
    [
        (
            drift_rows(0.53, 0.52),
            ["0.53 m off", "0.52 m by its model", "2.0% of the seeds", "does not agree", "as its"],
        ),
        (drift_rows(1.02, 1.0, 0.4), ["its sentence agrees", "40.0%", "at most 2%"]),
        (drift_rows(0.7, 0.5), ["not as its model says", "at most 40%"]),
    ],
)
def test_drift(rows: pd.DataFrame, words: list[str]) -> None:
    said = conclusions.drift(rows)
    assert all(word in said for word in words), said
    assert said.count("\n- ") == 2


def test_drift_that_ends_before_three_minutes_says_nothing_of_them() -> None:
    assert conclusions.drift(drift_rows(0.3, 0.3, time_s=60)) == (
        "- Each noise drifts as its model says: measured and expected differ by at most 0%."
    )


def odometry_rows(
    means: dict[str, float], flight: str = "vertical", noise: str = "random-walk", **more
) -> pd.DataFrame:
    """Rows of `batch.cloud_table` of one flight: method → mean error; the drift has a root mean square of 0.4 m."""
    same = {"trajectory": flight, "noise": noise, "map": "weighted", "sensor": "report", "seed": 1, **more}
    return pd.DataFrame(
        {
            **same,
            "method": method,
            "error_mean_m": mean,
            "error_max_m": 2 * mean,
            "error_final_m": mean,
            "ate_rmse_m": 1.1 * mean,
            "raw_ate_rmse_m": 0.4,
            "unused_share": 0.25,
        }
        for method, mean in means.items()
    )


def test_segment_odometry_counts_what_is_below_the_report_and_what_helps() -> None:
    said = conclusions.segment_odometry(odometry_rows({"none": 0.4, "average": 0.5, "least_squares": 0.02}))
    assert "1 of 2 runs have a mean at or below that, from 0.020 m (random-walk, least_squares) to 0.500 m" in said
    assert "1 of 2 runs are better than no correction" in said
    assert "Up to 25% of the scans" in said
    assert "seed 1" in said


METHODS = ["icp", "icp-3dof", "gicp"]


def frame_ms(flight: str, **ms: float) -> pd.DataFrame:
    rows = [{"trajectory": flight, "method": name, "stage": "frame", "median_ms": value} for name, value in ms.items()]
    return pd.DataFrame(rows, columns=["trajectory", "method", "stage", "median_ms"])


def test_cloud_odometry_as_the_report_says() -> None:
    rows = odometry_rows({"icp": 0.5, "icp-3dof": 0.2, "gicp": 0.1})
    said = conclusions.cloud_odometry(rows, frame_ms("vertical", icp=10.0, gicp=31.0), "random-walk", METHODS)
    assert "gicp < icp-3dof < icp, as the report says; 100% of the pairs" in said
    assert "gicp is the most accurate, 0.100 m; worse than no correction (root mean square): icp." in said
    assert "icp up to 1.00 m, 1.00 m in the report; icp-3dof up to 0.40 m, 0.35 m in the report" in said
    assert "GICP takes 3.1 times as long as ICP" in said
    assert "weighted map takes" not in said


def test_cloud_odometry_otherwise() -> None:
    rows = odometry_rows({"icp": 0.2, "icp-3dof": 0.1, "gicp": 0.3}, noise="yaw-random-walk")
    again = odometry_rows({"icp": 0.15}, noise="yaw-random-walk")
    said = conclusions.cloud_odometry(pd.concat([rows, again]), frame_ms("orbit"), "yaw-random-walk", METHODS)
    assert "not as the report says (gicp < icp-3dof < icp); 33% of the pairs" in said
    assert "root mean square): none." in said
    assert "The weighted map takes icp from 0.200 to 0.150 m." in said
    assert "Largest errors" not in said, "the report shows no figure of this noise"
    assert "GICP takes" not in said
    alone = conclusions.cloud_odometry(rows[:1], frame_ms("orbit"), "yaw-random-walk", ["icp"])
    assert alone.startswith("- **vertical**: icp is the most accurate")


def bends(**bend_deg: float) -> pd.DataFrame:
    return pd.DataFrame(
        {
            name: {
                "bend_deg": bend, "offset_max_m": bend / 10, "blur_mean_m": bend / 100, "yaw_max_deg": 3 * bend,
                "tilt_max_deg": 2 * bend,
            }
            for name, bend in bend_deg.items()
        }
    ).T  # fmt: skip


def test_bent_clouds_beside_the_report_s_pictures() -> None:
    said = conclusions.bent_clouds(bends(icp=0.5, **{"icp-3dof": 0.1}, gicp=22.0, best=1.5))
    assert "The cloud of gicp is bent most, by 22.0°, and is off by up to 2.20 m." in said
    assert "Straight to 1°: icp, icp-3dof." in said
    assert said.endswith(": icp-3dof; not so: icp (0.5°), gicp (22.0°).")
    assert "Straight to 1°: none." in conclusions.bent_clouds(bends(best=1.5))


def test_false_convergence_with_and_without_a_wrong_flight() -> None:
    basins = pd.DataFrame({"radius_m": {"narrow": 0.1, "wide": 0.4}, "locked_share": {"narrow": 0.0, "wide": 0.3}})
    case = {"trajectory": "orbit", "noise": "random-walk", "seed": 1, "max_correspondence_m": 0.5}
    flights = pd.DataFrame(
        [
            {**case, "blind_s": 0, "wrong_share": 0.0, "slip_m": 0.1, "slip_s": 3.0, "error_final_m": 0.2},
            {**case, "blind_s": 15, "wrong_share": 0.6, "slip_m": 0.9, "slip_s": 61.0, "error_final_m": 1.5},
        ]
    )
    said = conclusions.false_convergence(basins, flights.assign(wrong=[False, True]), 0.03)
    assert "within 0.40 m converges to the truth with wide, within 0.10 m with narrow; wide locks onto" in said
    assert "from 30% of the starts" in said
    assert "1 of 2 flights converged wrongly: 0 of 1 with the tower always in sight, 1 of 1 with gaps." in said
    assert "The worst (orbit, random-walk, seed 1, 0.5 m) slips by 0.90 m within a second at 61 s" in said
    assert said.endswith("ends 1.50 m off; best, on the same scans, 0.03 m.")
    said = conclusions.false_convergence(basins[:1], flights[:1].assign(wrong=False), 0.03)
    assert "with narrow; none locks onto" in said
    assert "0 of 1 flights" in said
    assert "The one that came nearest to it (" in said


def test_yaw_drift() -> None:
    rows = odometry_rows({"none": 0.36, "icp-3dof": 0.5, "gicp": 0.1})
    said = conclusions.yaw_drift(rows, bends(**{"icp-3dof": 2.0}, gicp=1.0))
    assert "from 0.110 m (gicp) to 0.550 m (icp-3dof); no correction 0.396 m. Better than none: gicp." in said
    assert "The report's order, gicp < icp-3dof, holds: gicp < icp-3dof." in said
    assert "is intact here: it turns by up to 3.0°, tilts by up to 2.0° and is off by up to 0.10 m." in said
    assert "turns by up to 6.0°." in said
    rows = odometry_rows({"none": 0.01, "icp-3dof": 0.05, "gicp": 0.1})
    said = conclusions.yaw_drift(rows, bends(gicp=9.0))
    assert "Better than none: none." in said
    assert "does not hold: icp-3dof < gicp" in said
    assert "is not intact here" in said
    assert "3-DoF ICP, which" not in said
    only = conclusions.yaw_drift(odometry_rows({"none": 0.3, "best": 0.1}), bends(best=0.1))
    assert "order" not in only
    assert "GICP" not in only


def test_a_recording_with_truth_without_it_and_one_that_gets_worse() -> None:
    numbers = {"frames": 60, "used": 58}
    assert conclusions.recording(numbers).startswith("Of 60 scans, 58 corrected the pose. There is no truth")
    judged = {**numbers, "prior_ate_rmse_m": 0.25, "corrected_ate_rmse_m": 0.02, "drift_removed_percent": 92.0}
    assert conclusions.recording(judged).endswith(
        "25.0 cm (ATE), the corrected ones by 2.0 cm: 92 % of the drift is gone."
    )
    worse = {**judged, "drift_removed_percent": -10.0}
    assert conclusions.recording(worse).endswith(": the correction did not help.")


GOALS = pd.DataFrame({"goal": ["recall", "precision"], "reached": [True, False]})


def structure_rows() -> pd.DataFrame:
    numbers = {"recall": 0.9, "precision": 0.99, "offset_median_m": 0.005, "joint_error_median_m": 0.01}
    numbers |= {"bars": 190, "joints": 100, "observed": 210, "joints_observed": 111, "joint_recall": 0.95}
    numbers |= {"ate_rmse_m": 0.012, "toward_sensor_median_m": 0.001}
    cases = [
        ("corrected", "final", 1.0),
        ("corrected", "incremental", 0.8),
        ("raw", "final", 0.1),
        ("true", "final", 1.0),
    ]
    return pd.DataFrame(
        {"poses": poses, "method": method, "tower": "light", **numbers, "recall": share * numbers["recall"]}
        for poses, method, share in cases
    )


def test_structure() -> None:
    axes = {"middle of points": 0.021, "section fitted": -0.002}
    near = pd.DataFrame({"axis": axes.keys(), "kind": "all", "median_m": axes.values()})
    said = conclusions.structure(structure_rows(), near, GOALS)
    assert "190 bars and 100 joints: 90% of the 210 members observed" in said
    assert "give a recall of 9%, the true ones 90%." in said
    assert "Frame by frame, the same corrected poses give a recall of 72%" in said
    assert "lie 2.1 cm nearer to the sensor than the members (median); with the section fitted, -0.2 cm." in said
    assert said.endswith("1 of 2 goals are reached; not reached: precision.")


def test_structure_over_seeds() -> None:
    rows = structure_rows()[:2]
    said = conclusions.structure_over_seeds(rows, GOALS.assign(reached=True))
    assert "final, mean (worst) of 1 flights over 1 towers: recall 0.90 (0.90)" in said
    assert "2 of 2 goals are reached; not reached: none." in said
    assert said.endswith("(cm, median): final light +0.1; incremental light +0.1.")


def test_accuracy_with_and_without_gaps() -> None:
    summary = pd.DataFrame(
        [
            {"case": "random-walk", "method": "best", "ate_mean_m": 0.02, "ate_worst_m": 0.03},
            {"case": "constant-drift", "method": "best", "ate_mean_m": 0.04, "ate_worst_m": 0.05},
            {"case": "random-walk, blind", "method": "best", "ate_mean_m": 0.06, "ate_worst_m": 0.07},
        ]
    )
    runs = pd.DataFrame(
        {"method": ["best"], "frame_median_ms": [8.0], "frame_p95_ms": [12.0], "duration_s": [200.0], "seconds": [14.2]}
    )
    said = conclusions.accuracy(summary, runs, 0.025)
    assert "mean ATE 2.0 to 4.0 cm, worst seed 5.0 cm; the goal of 2.5 cm is reached under 1 of 2 noises." in said
    assert "Through gaps, the worst seed is off by 7.0 cm. A frame takes 8.0 ms, p95 12.0 ms; " in said
    assert said.endswith("a flight of 200 s takes 14 s.")
    assert "gaps" not in conclusions.accuracy(summary[:2], runs, 0.025)


def costs(reference_lost: float) -> pd.DataFrame:
    rows = [
        (0.02, CHOSEN, 0.05, 0.01, 0.02),
        (0.02, REFERENCE, 0.14, reference_lost, 0.0),
        (0.04, CHOSEN, 0.07, 0.03, 0.0),
    ]
    frame = pd.DataFrame(rows, columns=["noise_m", "rule", "dx_m", "recall_lost", "precision_lost"])
    return frame.assign(best_dx_m=0.06, min_votes=15)


def test_tuning_says_where_settings_are_good() -> None:
    votes = pd.DataFrame(
        {
            "rule": FIXED,
            "dx_m": [0.05, 0.06, 0.1],
            "min_votes": [15, 20, 15],
            "recall": [0.9, 0.92, 0.5],
            "precision": 0.9,
        }
    )
    said = segmentation_conclusions.tuning(votes, costs(0.2))
    assert "at 2 of 3 settings, from dx 5 to 6 cm and from 15 to 20 votes." in said
    assert (
        "The dx from the points (5.0 cm) loses 0.010 of recall and 0.020 of precision to the best fixed one (6 cm)"
        in said
    )
    assert "default (14.0 cm) loses 0.200" in said
    assert "at most 0.030 and 0.020." in said
    apart = votes.assign(recall=[0.9, 0.5, 0.5], precision=[0.5, 0.9, 0.5])
    said = segmentation_conclusions.tuning(apart, costs(0.2)[:1])
    assert "at 0 of 3 settings." in said
    assert "The reference program's default" not in said


def scores(**recall: float) -> pd.DataFrame:
    rows = {name.replace("_", "-"): value for name, value in recall.items()}
    return pd.DataFrame({"recall": rows}).assign(precision=0.98)


def noisy(recall: float) -> pd.DataFrame:
    row = {"method": "hough", "noise_m": 0.04, "recall": recall, "precision": 0.97, "angle_deg": 0.5, "offset_m": 0.01}
    return pd.DataFrame([row])


def test_the_report_s_reasons_as_it_gives_them() -> None:
    found = scores(hough=0.95, ransac_lines=0.94, ransac_lines_uniform=0.6, ransac_planes=0.0, dbscan=0.07, gmm=0.4)
    ms = {"hough": 10.0, "ransac-lines": 30.0, "ransac-planes": 50.0, "dbscan": 40.0, "gmm": 900.0}
    tower = scores(hough=0.3, hough_blocks=0.9)
    said = segmentation_conclusions.reasons(found, ms, tower, noisy(0.9), costs(0.2)).splitlines()
    assert [line.split("**")[1][:8] if "**" in line else line[2:11] for line in said] == [
        "RANSAC i", "For lines", "DBSCAN i", 'GMM "req', "The Houg", '"It requ'
    ]  # fmt: skip
    assert "For planes, yes: recall 0.00 in 50 ms" in said[0]
    assert "does not mention, no: recall 0.940" in said[1]
    assert "drawn anywhere, they give 0.600" in said[1]
    assert "Ineffective, yes: recall 0.07" in said[2]
    assert "Time-consuming, yes: 40 ms, 4.0 times" in said[2]
    assert "** Yes: with the number chosen" in said[3]
    assert "told twice" not in said[3]
    assert "It takes 90 times" in said[3]
    assert "** Yes: with 4 cm of noise recall 0.90" in said[4]
    assert said[4].endswith("0.30, 0.90 in blocks.")
    assert "Of dx, yes: with the reference program's default recall falls by 0.20" in said[5]


def test_the_report_s_reasons_where_a_run_contradicts_them() -> None:
    found = scores(hough=0.9, ransac_lines=0.6, ransac_planes=0.8, dbscan=0.7, gmm=0.9, gmm_told=0.95)
    ms = dict.fromkeys(found.index, 10.0)
    said = segmentation_conclusions.reasons(found, ms, scores(hough=0.3), noisy(0.5), costs(0.01))
    for words in (
        "For planes, no", "does not mention, yes", "Ineffective, no", "Time-consuming, hardly",
        "** No: with the number", "told twice the number of bars, 0.95", "** No: with 4 cm",
        "its recall is 0.30.", "Of dx, no",
    ):  # fmt: skip
        assert words in said, words
    assert "drawn anywhere" not in said
    alone = segmentation_conclusions.reasons(
        scores(hough=0.9), {"hough": 10.0}, scores(hough=0.3), noisy(0.9), costs(0.2)
    )
    assert alone.count("\n") == 1


def test_methods_over_seeds_and_the_goals_of_hough() -> None:
    means = pd.DataFrame(
        {"recall": [0.96, 0.5], "precision": [0.97, 0.9], "duplicates": 0.5, "angle_deg": 0.3, "offset_m": 0.01},
        index=["hough", "gmm"],
    )
    assert segmentation_conclusions.reached_goals(means) == ["recall", "duplicates", "angle_deg", "offset_m"]
    assert segmentation_conclusions.goal_metrics(means) == {"goals_reached": 4, "goals": 5}
    said = segmentation_conclusions.over_seeds(means, {"hough": 20.0, "gmm": 300.0}, 30)
    assert "`gmm`: recall 0.500, precision 0.900, 300 ms a frame, 15.0 times the time of Hough." in said
    assert said.endswith("4 of 5 goals are reached; not reached: precision.")
