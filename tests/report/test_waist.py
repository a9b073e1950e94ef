"""Why the error climbs above the waist: pairs of bars, their sentence, and the sweep over towers."""

import numpy as np
import pandas as pd
import pytest

from steelnb import experiment
from steelnb.report import waist
from steelnb.settings import ExperimentSettings, TowerSettings


@pytest.fixture(scope="module")
def flown():
    # A short tower, so that a short flight passes its waist.
    tower = TowerSettings(height_m=6.0, base_width_m=3.0, waist_height_m=3.0, waist_width_m=1.5, arms_m=())
    fast = {"flight.height_max_m": 5.0, "flight.levels": 6, "flight.speed_m_s": 0.6}
    settings = ExperimentSettings.preset(
        "zigzag", method="average", sensor="report-4cm", seed=21, duration_s=32.0, overrides=fast
    ).replace(tower=tower)
    flight, truth = experiment.simulate(settings)
    return flight, experiment.estimate(settings, flight, truth)


def test_pairs_name_the_member_of_the_segment_and_of_the_bar(flown):
    flight, run = flown
    pairs = waist.pairs_of(run, flight, every=2)
    assert len(pairs) > 30
    assert set(pairs["kind"]) <= set(waist.KINDS)
    assert pairs.groupby("bar")["same"].first().all(), "a bar is its first segment's"
    truth = waist.pairs_of(run, flight, every=10**6)
    assert set(truth["time_s"]) <= {0.0}
    passed = waist.waist_s(run)
    assert np.interp(passed, run.truth.trajectory.stamp_s, run.truth.trajectory.position[:, 2]) == pytest.approx(
        3, abs=0.05
    )
    top, counts = waist.figure_waist(run, pairs, every=2).axes
    drawn = sum(patch.get_height() for patch in counts.patches)
    assert drawn > 0
    assert top.get_ylabel() == "error (m)"


def test_the_sweep_counts_the_combinations_within_the_limit():
    rows = []
    for width, error_m in ((1.7, 0.9), (2.4, 0.2)):
        for away in (0.8, 1.1):
            for seed in (1, 2):
                variant = f"flight.standoff_m={away}, preprocess.crop_m=1.5, tower.waist_width_m={width}"
                more = 0.2 * (away == 0.8 and width == 2.4)
                case = {"variant": variant, "seed": seed, "status": "ok", "error_max_m": error_m + more + 0.012 * seed}
                rows.append(case | {"trajectory": "zigzag", "noise": "constant-drift", "sensor": "report-4cm"})
    rows.append(rows[0] | {"variant": "tower.waist_width_m=1.7", "error_max_m": 0.0})
    runs = pd.DataFrame(rows)
    swept = waist.sweep_rows(runs)
    assert len(swept) == 4
    assert swept["error_max_m"].tolist() == pytest.approx([0.918, 0.918, 0.418, 0.218])
    panel = waist.figure_sweep(swept, runs, 0.28).axes[0]
    assert len(panel.patches) == 1
    assert sorted(text.get_text() for text in panel.texts) == ["0.22", "0.42", "0.92", "0.92"]
