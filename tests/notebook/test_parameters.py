"""Parameters of notebooks: misspelt names, wrong types and what cannot be flown are refused before anything runs."""

from collections.abc import Iterator
from pathlib import Path

import nbformat
import papermill
import pytest
from IPython.core.interactiveshell import InteractiveShell

from steelnb.core.errors import InputError, SteelnbError
from steelnb.notebook import parameters
from steelnb.notebook.cases import NOTEBOOKS
from steelnb.notebook.parameters import checked_parameters, literals
from steelnb.settings import ExperimentSettings, parse_parameter
from workflow.experiments import make_parts, parse_parameters, read_parameters

FOLDER = Path(__file__).parents[2] / "notebooks"
PATHS = sorted(FOLDER.glob("*.ipynb"))


def check(number: str, given: dict) -> tuple:
    (path,) = (path for path in PATHS if path.name.startswith(number))
    return checked_parameters(path.stem, {**read_parameters(path), **given}, "e")


def test_every_notebook_has_its_function() -> None:
    assert list(NOTEBOOKS) == [path.stem for path in PATHS]


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_every_parameter_of_every_notebook_refuses_what_it_cannot_be(path: Path) -> None:
    nan = float("nan")
    wrong = {str: [5.5, ["x"], None], int: [-1, nan, "x", None], float: [-1.0, nan, "x", None]}
    wrong |= {list: [None, "x", [nan]], dict: [None, "x", {"misspelt": 1}], type(None): [-1, nan]}
    for name, default in read_parameters(path).items():
        twice = [default * 2] if isinstance(default, list) and name != "blind_s" else []
        for value in wrong[type(default)] + twice if name != "slow" else wrong[list]:
            with pytest.raises(InputError, match=r"^e: ") as caught:
                check(path.name, {name: value})
            assert "\n" not in str(caught.value), (name, value)
            assert name in str(caught.value) or isinstance(default, dict), (name, value)


@pytest.mark.parametrize(
    ("notebook", "given", "words"),
    [
        ("00", {"sed": 2}, ["sed = 2", "did you mean 'seed'"]),
        ("00", {"seed": "report"}, ["seed = 'report'"]),
        ("00", {"duration_s": 0.4}, ["duration_s = 0.4"]),
        ("00", {"overrides": {"tof.rate": 1}}, ["rate = 1"]),
        ("01", {"seeds": 0}, ["seeds = 0"]),
        ("01", {"noise": ["random-wolk"]}, ["random-wolk"]),
        ("01", {"overrides": {"flight.trajectory": "orbit"}}, ["flight.trajectory = 'orbit'"]),
        ("02", {"overrides": {"seed": 5}}, ["seed = 'report'"]),
        ("02", {"correction": []}, ["correction"]),
        ("02", {"correction": ["none"]}, ["'none' twice"]),
        ("02", {"draws": 1}, ["draws = 1"]),
        ("02", {"sensor": "starling2-honest"}, ["draws of the noise"]),
        ("02", {"trajectory": "zigzag"}, ["'zigzag'", "'average' on 'orbit'"]),
        ("03", {"drawn": ["smoothed"]}, ["drawn = 'smoothed'"]),
        ("03", {"duration_s": 3.0}, ["duration_s = 3"]),
        ("03", {"trajectory": ["orbit", "orbit"]}, ["'orbit' twice"]),
        ("03", {"methods": {"icp": ["best"], "gicp": ["best"]}, "drawn": ["best"]}, ["methods", "'best' twice"]),
        ("04", {"overrides": {"hough.dx_m": 0.05}}, ["hough.dx_m = 0.05"]),
        ("04", {"overrides": {"max_correspondence_m": 0.3}}, ["max_correspondence_m = 0.3", "'3-DoF ICP, 0.1 m'"]),
        ("04", {"overrides": {"tof.blind_s": [[1.0, 2.0]]}}, ["tof.blind_s"]),
        ("04", {"blind_s": [[75.0, 60.0]]}, ["blind_s"]),
        ("05", {"mapped": ["none", "smoothed"]}, ["mapped = 'smoothed'"]),
        ("06", {"slow": ["gms"]}, ["slow = 'gms'", "'gmm'"]),
        ("06", {"options": {"gmm": {"component": [3]}}}, ["options.gmm = 'component'"]),
        ("06", {"cloud_seeds": {"heavi": [1]}}, ["tower = 'heavi'"]),
        ("06", {"cloud_seeds": {"heavy": ["report"]}}, ["cloud_seeds.heavy.0 = 'report'"]),
        ("06", {"cloud_s": 0.1}, ["duration_s = 0.1"]),
        ("06", {"kept": [0.0]}, ["kept.0 = 0.0"]),
        ("07", {"seeds": [1, 2], "overrides": {"seed": 1}}, ["seed = 1"]),
        ("07", {"tower": ["tapered", "hevy"]}, ["tower = 'hevy'"]),
        ("07", {"trajectory": "planned"}, ["trajectory = 'planned'", "'zigzag'"]),
        ("10", {"methods": ["orb", "lam"]}, ["methods = 'lam'", "'loam'"]),
        ("11", {"flights": ["loops", "plannd"]}, ["flights = 'plannd'", "'planned'"]),
        ("11", {"overrides": {"flight.standoff_m": 3.0}}, ["flight.standoff_m = 3.0: 'wide loops' sets it"]),
        ("13", {"recording": "no.bag"}, ["recording = 'no.bag'"]),
        ("13", {"method": "orb"}, ["method = 'orb'"]),
        ("13", {"range_max_m": 0.001}, ["range_max_m = 0.001"]),
    ],
)
def test_what_cannot_be_flown_or_drawn_is_refused(notebook: str, given: dict, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        check(notebook, given)
    assert all(word in str(caught.value) for word in ["e: ", *words]), str(caught.value)


@pytest.mark.parametrize(
    ("notebook", "given"),
    [
        ("01", {"noise": ["random-walk:0.004"]}),  # the report's seed has none: its curve is left out
        ("01", {"overrides": {"tower": "heavy", "tower.section": "round"}}),
        ("02", {"overrides": {"flight.duration_s": 25.0}}),
        ("05", {"methods": {"gicp": ["gicp"]}, "mapped": ["gicp"], "drawn": ["gicp"],
                "overrides": {"max_correspondence_m": 0.2}}),
        ("02", {"duration_s": 900.0,
                "overrides": {"flight.waypoints": [[0.5, 2.5, 0.1, -90.0, 0.0], [0.5, 2.5, 2.0, -90.0, 999.0]]}}),
        ("11", {"flights": ["loops", "planned"], "overrides": {"flight.standoff_m": 3.0}}),
    ],
)  # fmt: skip
def test_what_can_be_flown_is_not_refused(notebook: str, given: dict) -> None:
    values, _ = check(notebook, given)
    assert {name: values[name] for name in given} == given


def test_an_override_reaches_every_run_that_a_notebook_makes() -> None:
    plain, changed = (check("04", {"overrides": some})[1] for some in ({}, {"tof.sigma_floor_m": 0.02}))
    for before, after in zip([*plain[0].values(), *plain[1]], [*changed[0].values(), *changed[1]], strict=True):
        assert isinstance(before, ExperimentSettings)
        assert after == before.override({"tof.sigma_floor_m": 0.02}) != before


@pytest.fixture
def shell() -> Iterator[InteractiveShell]:
    """The shell of a kernel after the cell of parameters of notebook 11."""
    InteractiveShell.clear_instance()
    shell = InteractiveShell.instance()
    run(shell, cell_of("11_planner"))
    yield shell
    InteractiveShell.clear_instance()


def cell_of(stem: str) -> str:
    cells = nbformat.read(FOLDER / f"{stem}.ipynb", 4).cells
    return next(cell.source for cell in cells if cell.metadata.get("tags"))


def run(shell: InteractiveShell, cell: str) -> None:
    shell.run_cell(cell, store_history=True).raise_error()


@pytest.mark.parametrize(
    ("cell", "words"),
    [
        ("# Parameters\nsed = 2", "sed = 2: unknown setting, did you mean 'seed'"),
        ("# Parameters\nduration_s = float('nan')", "duration_s = nan"),
        ('# Parameters\nnoise = "wind"', "wind"),
        ('method = "fases"', "'faces'"),  # a reader's own edit
    ],
)
def test_what_is_injected_or_edited_is_refused_by_the_notebook(shell: InteractiveShell, cell: str, words: str) -> None:
    run(shell, cell)
    with pytest.raises(InputError, match=f"^11_planner: .*{words}"):
        parameters.check("11_planner")


def test_what_is_injected_takes_its_type_and_a_copy_may_have_more_parameters(shell: InteractiveShell) -> None:
    run(shell, cell_of("11_planner") + '\nmine = 1\nflights = ["loops"]')
    run(shell, "# Parameters\nduration_s = 30\nmine = 3")
    run(shell, "sed = 2  # a name of the notebook's own")
    (case,) = parameters.check("11_planner").values()
    assert (case.flight.trajectory, case.flight.duration_s, case.seed) == ("loops", 30.0, 101)
    assert repr(shell.user_ns["duration_s"]) == "30.0"


def test_a_folder_of_results_that_cannot_be_written_is_refused_before_anything_runs(
    shell: InteractiveShell, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    mine, committed = tmp_path / "table.csv", FOLDER.parent / "results" / "explore"
    mine.touch()
    for folder, names in (
        (tmp_path / "file" / "out", "file/out"),
        (tmp_path, "table.csv"),
        (committed, "explore/metrics.json"),
    ):
        run(shell, f"# Parameters\nresults_dir = {str(folder)!r}\n")
        with pytest.raises(SteelnbError, match=names):
            parameters.check("11_planner")
    mine.unlink()
    run(shell, f"# Parameters\nresults_dir = {str(tmp_path / 'new')!r}\n")
    parameters.check("11_planner")
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("path", PATHS[1:], ids=lambda path: path.stem)
def test_the_note_is_shown_for_other_parameters_than_the_committed_ones(
    path: Path, shell: InteractiveShell, capsys: pytest.CaptureFixture
) -> None:
    cells = [cell.source for cell in nbformat.read(path, 4).cells]
    conclusions = next(k for k, cell in enumerate(cells) if cell.startswith("## Conclusions"))
    assert cells[conclusions - 1] == "parameters.note()"
    for part in [part for part in make_parts(FOLDER.parent, [], "full") if part.notebook == path]:
        run(shell, cell_of(path.stem))
        run(shell, "# Parameters\n" + "".join(f"{name} = {value!r}\n" for name, value in part.parameters.items()))
        parameters.check(path.stem)
        parameters.note()
        assert capsys.readouterr().out == "", part.label
        defaults = literals(cell_of(path.stem))
        name = next(name for name in ("seed", "seeds", "study_folder") if name in defaults)
        other: object = [7] if isinstance(defaults[name], list) else 7
        if name == "study_folder":
            other = str(FOLDER.parent / "results" / "study")
        run(shell, f"{name} = {other!r}\n")
        parameters.check(path.stem)
        parameters.note()
        assert f"(results/{part.id}), not this one" in capsys.readouterr().out


def test_papermill_alone_ends_in_one_clear_error(tmp_path: Path) -> None:
    path = FOLDER / "12_claims.ipynb"
    with pytest.raises(papermill.PapermillExecutionError) as caught:
        papermill.execute_notebook(path, tmp_path / "out.ipynb", {"sed": 1}, progress_bar=False, cwd=path.parent)
    assert caught.value.ename == "InputError"
    assert "sed = 1" in caught.value.evalue


READ = {
    "a = 1.5": 1.5, "a=True": True, "a=true": True, "a=loops": "loops", "a='2'": "2", "a=x=y": "x=y",
    "a=random-walk+yaw-random-walk:0.001": "random-walk+yaw-random-walk:0.001", "a=['x', 2]": ["x", 2],
    "a=[true]": [True], "a={ b = 1 }": {"b": 1}, "a=2024-01-01": "2024-01-01", "a=": "",
}  # fmt: skip


@pytest.mark.parametrize("text", [*READ, "a", "=1", ""])
def test_a_parameter_is_read_as_python_as_toml_or_as_text(text: str) -> None:
    if text in READ:
        name, parsed = parse_parameter(text)
        assert (name, parsed, type(parsed)) == ("a", READ[text], type(READ[text]))
    else:
        with pytest.raises(InputError, match="NAME=VALUE"):
            parse_parameter(text)


@pytest.mark.parametrize(
    "text",
    [
        'flights=["loops", "zigzag"]  seed = 3',
        "flights=[loops, 'zigzag'] 'seed=3'",
        """'flights=["loops", "zigzag"]' seed=3""",
        """flights="['loops', 'zigzag']" seed=3""",
    ],
)
def test_lists_are_read_in_every_usual_quoting(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert parse_parameters(f"{text} tof.rate_hz=10") == {"flights": ["loops", "zigzag"], "seed": 3, "tof.rate_hz": 10}
    with pytest.raises(InputError, match="seed is given twice"):
        parse_parameters("seed=3 tof.rate_hz=10 seed=4")
    (tmp_path / "mine.toml").write_text("")
    monkeypatch.chdir(tmp_path)
    assert parse_parameters("sensor=mine.toml") == {"sensor": str(tmp_path / "mine.toml")}
    assert parse_parameters("sensor=other.toml") == {"sensor": "other.toml"}
    with pytest.raises(InputError, match=r"tower.members = 'mast.csv': no such file"):
        parse_parameters("tower.members=mast.csv")
    assert parse_parameters("blind_s=[[16, 18], [20, 21]]") == {"blind_s": [[16, 18], [20, 21]]}


@pytest.mark.parametrize(
    ("source", "tags", "words"),
    [
        ("x = 1\nresults_dir = ''", [], "one cell 'parameters'"),
        ("x = 1.0 * 2\nresults_dir = ''", ["parameters"], "plain literals"),
        ("x = 1", ["parameters"], "results_dir"),
    ],
)
def test_notebooks_without_plain_parameters_are_refused(
    tmp_path: Path, source: str, tags: list[str], words: str
) -> None:
    cell = nbformat.v4.new_code_cell(source, metadata={"tags": tags})
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), tmp_path / "a.ipynb")
    with pytest.raises(InputError, match=words):
        read_parameters(tmp_path / "a.ipynb")
