"""Why the error climbs above the waist: the sweep over towers."""

import pandas as pd
import pytest

from steelnb.report import waist


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
