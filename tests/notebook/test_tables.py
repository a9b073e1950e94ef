"""Tables for display: the same values under heads that a reader understands."""

import numpy as np
import pandas as pd
import pytest

from steelnb.notebook.tables import readable, shared_seeds


def test_a_readable_table_shows_chosen_columns_with_their_units_and_counts_as_integers():
    numbers = {"scans_seen": [3.0, np.nan], "recall": [1.0, 1.0], "ate_rmse_m": [0.12345, np.nan], "bend_deg": 0.5}
    table = pd.DataFrame({"method": ["a", "b"], **numbers, "x": 1})
    before = table.copy()
    shown = readable(table.set_index("method"), [*numbers, "of_no_run_m"])
    assert list(shown) == ["scans seen", "recall", "ATE (m)", "bend (°)"]
    assert shown["scans seen"].tolist() == [3, pd.NA]
    assert shown["recall"].dtype == float, "a share"
    np.testing.assert_array_equal(shown["ATE (m)"], [0.123, np.nan])
    pd.testing.assert_frame_equal(table, before)


def runs_of(**seeds):
    return pd.DataFrame([{"world": "w", "method": name, "seed": seed} for name, own in seeds.items() for seed in own])


@pytest.mark.parametrize(
    ("flown", "kept"),
    [
        ({"a": [1, 2, 3], "b": [2, 3]}, {"a": [2, 3], "b": [2, 3]}),
        ({"a": [1, 2]}, {"a": [1, 2]}),
        # No seed has all three: the pair with more seeds is compared.
        ({"a": [1, 2], "b": [1, 2, 3, 4, 5], "c": [3, 4, 5]}, {"b": [3, 4, 5], "c": [3, 4, 5]}),
    ],
    ids=["shared by all", "one method", "shared by none"],
)
def test_methods_are_compared_on_the_seeds_that_all_of_them_flew(flown, kept):
    found = shared_seeds(runs_of(**flown), ["world"])
    assert found.groupby("method")["seed"].agg(list).to_dict() == kept


def test_each_case_has_its_own_seeds():
    one, other = runs_of(a=[1, 2], b=[1]), runs_of(a=[7], b=[7]).assign(world="other")
    found = shared_seeds(pd.concat([one, other]), ["world"])
    assert found.groupby("world")["seed"].agg(set).to_dict() == {"w": {1}, "other": {7}}
