"""Results are bit-identical on every machine: `workflow.digests`."""

import json

import numpy as np
import pytest

from steelnb.core.errors import InputError
from steelnb.notebook.results import find_root
from workflow import digests
from workflow.digests import SETTINGS, changed, digest, read

FLIGHTS = [("report", "orbit"), ("starling2", "zigzag"), ("starling2-honest", "loops")]
"""A flight of each sensor; ``python -m workflow digests`` has the others, by the same methods."""


@pytest.mark.slow
@pytest.mark.parametrize(("sensor", "trajectory"), FLIGHTS)
def test_flights_estimates_and_structures_have_the_committed_bits(sensor: str, trajectory: str) -> None:
    committed = {name: found for name, found in read(find_root()).items() if name.startswith(f"{sensor}/{trajectory}/")}
    found = dict(digests.digests(SETTINGS, sensor, trajectory))
    differ = [f"{name}: {committed.get(name)}, now {found.get(name)}" for name in changed(committed, found)]
    assert not differ, f"{differ}; if they are meant to change, `{digests.WRITE}` writes them anew"


def test_a_digest_changes_with_the_last_digit_with_the_shape_and_with_the_type() -> None:
    cloud = np.arange(12.0).reshape(4, 3)
    others = [np.nextafter(cloud, 20), cloud.reshape(3, 4), cloud.astype(np.float32), cloud[::-1]]
    assert digest(cloud) == digest(cloud.copy())
    assert len({digest(cloud), digest(cloud, cloud), *map(digest, others)}) == 6


def test_what_was_written_is_read_again_unless_settings_or_versions_are_others(tmp_path):
    with pytest.raises(InputError, match="--write"):
        read(tmp_path)
    (tmp_path / "tests").mkdir()
    digests.write(tmp_path, {"a": "1"})
    assert read(tmp_path) == {"a": "1"}
    written = json.loads((tmp_path / digests.PATH).read_text())
    for part, name in (("settings", "seed"), ("versions", "numpy")):
        (tmp_path / digests.PATH).write_text(json.dumps({**written, part: {**written[part], name: 0}}))
        with pytest.raises(InputError, match=digests.WRITE):
            read(tmp_path)
    assert changed({"a": "1", "b": "2"}, {"a": "3", "c": "4"}) == ["a", "c", "b"]


def test_a_missing_emulator_is_one_line_and_exit_code_2(tmp_path, monkeypatch, capsys):
    from workflow.__main__ import main

    monkeypatch.setenv("PATH", str(tmp_path))
    assert main(["bits"]) == 2
    assert capsys.readouterr().err.count("\n") == 1
