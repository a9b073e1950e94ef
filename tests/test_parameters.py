"""Parameters of notebooks: misspelt, mistyped and out of range ones are refused."""

from pathlib import Path

import nbformat
import pytest

from steelnb.errors import FileMissingError, NotebookError, SettingsError
from steelnb.settings import parse_parameter
from workflow.parameters import check_settings, fit_parameters, read_parameters

DEFAULTS = {
    "trajectory": "vertical", "noise": ["random-walk"], "value": 1.0, "count": 1, "deep": False, "overrides": {},
    "any": None, "results_dir": "",
}  # fmt: skip


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"trajectry": "orbit"}, ["e: unknown parameter 'trajectry'", "did you mean 'trajectory'", "count"]),
        ({"value": "fast"}, ["value = 'fast'", "a finite number", "1.0"]),
        ({"value": float("nan")}, ["value = nan"]),
        ({"value": 10**400}, ["value = 1", "a finite number"]),
        ({"value": True}, ["value = True"]),
        ({"count": 1.5}, ["count = 1.5", "whole number"]),
        ({"count": True}, ["count = True"]),
        ({"deep": 1}, ["deep = 1", "true or false"]),
        ({"trajectory": 5}, ["trajectory = 5", "a text"]),
        ({"noise": "random-walk"}, ["noise = 'random-walk'", "a list"]),
        ({"noise": ["random-walk", 3]}, ["noise[1] = 3", "a text"]),
        ({"overrides": 3}, ["overrides = 3"]),
        ({"overrides": {3: 1}}, ["overrides = {3: 1}"]),
        ({"results_dir": "x"}, ["results_dir", "OUT=folder"]),
    ],
)
def test_names_and_types_are_refused(given: dict, words: list[str]) -> None:
    with pytest.raises(SettingsError) as caught:
        fit_parameters("e", given, DEFAULTS)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_values_take_the_type_of_their_defaults() -> None:
    fitted = fit_parameters("e", {"value": 9, "noise": ("a", "b"), "any": 3, "count": 2}, DEFAULTS)
    assert fitted == {"value": 9.0, "noise": ["a", "b"], "any": 3, "count": 2}
    assert type(fitted["value"]) is float


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"noise": ["random-walk", "random-walk:-1"]}, "random_walk_m = -1.0"),
        ({"trajectory": "spiral"}, "trajectory = 'spiral'"),
        ({"trajectory": ["orbit", "spiral"], "seed": [1, 2]}, "trajectory = 'spiral'"),
        ({"overrides": {"tof.rate_hz": 0}}, "rate_hz = 0"),
        ({"overrides": {"tof.rate": 1}}, "unknown setting 'tof.rate'"),
    ],
)
def test_settings_out_of_range_are_refused(values: dict, words: str) -> None:
    with pytest.raises(SettingsError, match=f"e: .*{words}"):
        check_settings("e", values)
    check_settings("e", {"trajectory": "orbit", "unrelated": -1})


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("a=1", 1),
        ("a = 1.5", 1.5),
        ("a=True", True),
        ("a=true", True),
        ("a=orbit", "orbit"),
        ("a='2'", "2"),
        ("a=x=y", "x=y"),
        ("a=random-walk+yaw-random-walk:0.001", "random-walk+yaw-random-walk:0.001"),
        ("a=['x', 2]", ["x", 2]),
        ("a=[true]", [True]),
        ("a={ b = 1 }", {"b": 1}),
        ("a=2024-01-01", "2024-01-01"),
        ("a={1, 2}", "{1, 2}"),
        ("a=", ""),
    ],
)
def test_parse_parameter(text: str, value: object) -> None:
    name, parsed = parse_parameter(text)
    assert (name, parsed, type(parsed)) == ("a", value, type(value))


@pytest.mark.parametrize("text", ["a", "=1", ""])
def test_parse_parameter_refuses(text: str) -> None:
    with pytest.raises(SettingsError, match="NAME=VALUE"):
        parse_parameter(text)


@pytest.mark.parametrize(
    ("source", "tags", "words"),
    [
        ("x = 1\nresults_dir = ''", [], "0 cells are tagged"),
        ("x = 1.0 * 2\nresults_dir = ''", ["parameters"], "plain literals"),
        ("x = (\nresults_dir = ''", ["parameters"], "plain literals"),
        ("x = 1", ["parameters"], "expected results_dir"),
    ],
)
def test_notebooks_without_plain_parameters_are_refused(
    tmp_path: Path, source: str, tags: list[str], words: str
) -> None:
    cell = nbformat.v4.new_code_cell(source, metadata={"tags": tags})
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), tmp_path / "a.ipynb")
    with pytest.raises(NotebookError, match=words):
        read_parameters(tmp_path / "a.ipynb")
    (tmp_path / "a.ipynb").write_text("{}")
    with pytest.raises(NotebookError, match="not a notebook"):
        read_parameters(tmp_path / "a.ipynb")
    with pytest.raises(FileMissingError, match="none"):
        read_parameters(tmp_path / "none.ipynb")
