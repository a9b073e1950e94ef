"""Parameters of notebooks: misspelt names, wrong types and values out of range are refused."""

from collections.abc import Iterator
from pathlib import Path

import nbformat
import papermill
import pytest
from IPython.core.interactiveshell import InteractiveShell

from steelnb.core.errors import InputError, SteelnbError
from steelnb.notebook import parameters
from steelnb.notebook.parameters import check_parameters, literals
from steelnb.notebook.study import read_runs, write_runs
from steelnb.settings import parse_parameter
from workflow.experiments import make_parts, parse_parameters, read_parameters

NOTEBOOKS = sorted((Path(__file__).parents[2] / "notebooks").glob("*.ipynb"))
DEFAULTS = {
    "trajectory": "zigzag", "noise": ["random-walk"], "value": 1.0, "count": 1, "deep": False, "overrides": {},
    "any": None, "results_dir": "", "seed": 1, "seeds": [1], "blind_s": [[1.0, 2.0]], "duration_s": 5.0,
}  # fmt: skip


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"trajectry": "loops"}, ["e: trajectry", "did you mean 'trajectory'", "count"]),
        ({"value": 10**400}, ["value = 1"]),
        ({"value": True}, ["value = True"]),
        ({"count": 1.5}, ["count = 1.5", "integer"]),
        ({"deep": 1}, ["deep = 1", "boolean"]),
        ({"noise": ["random-walk", 3]}, ["noise.1 = 3", "string"]),
        ({"blind_s": [[1.0], 2.0]}, ["blind_s.1 = 2.0", "list"]),
        ({"seeds": [1, "two"]}, ["seeds.1 = 'two'", "'report'"]),
        ({"overrides": {3: 1}}, ["overrides.3"]),
        ({"results_dir": "x"}, ["results_dir"]),
        ({"noise": ["random-walk", "random-walk:-1"]}, ["random_walk_m = -1.0"]),
        ({"overrides": {"tof.rate": 1}}, ["rate = 1: unknown setting"]),
    ],
)
def test_names_types_and_settings_out_of_range_are_refused(given: dict, words: list[str]) -> None:
    with pytest.raises(InputError) as caught:
        check_parameters("e", given, DEFAULTS)
    assert all(word in str(caught.value) for word in words), str(caught.value)


def test_values_take_the_type_of_their_defaults() -> None:
    given = {"value": 9, "noise": ["none", "random-walk"], "any": 3, "seed": "report", "blind_s": [[1, 2], [3, 4]]}
    fitted = check_parameters("e", given, DEFAULTS)
    assert fitted == given
    assert type(fitted["value"]) is float


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_parameter_of_every_notebook_refuses_what_it_cannot_be(path: Path) -> None:
    defaults = read_parameters(path)
    nan = float("nan")
    wrong = {str: [5.5, ["x"], None], int: [-1, nan, "x", None], float: [-1.0, nan, "x", None]}
    wrong |= {list: [None, "x", [nan]], dict: [None, "x", {"misspelt": 1}], type(None): ["x", -1, nan]}
    for name, default in defaults.items():
        twice = [default * 2] if isinstance(default, list) else []
        for value in wrong[type(default)] + twice:
            with pytest.raises(InputError) as caught:
                check_parameters("e", {name: value}, defaults)
            assert "\n" not in str(caught.value), (name, value)
            assert name in str(caught.value) or isinstance(default, dict), (name, value)


@pytest.mark.parametrize(
    ("notebook", "given", "words"),
    [
        ("00", {"seed": "report"}, ["seed = 'report'", "number"]),
        ("00", {"duration_s": 0.4}, ["duration_s = 0.4", "expected two scans, so more than 0.4 s"]),
        ("01", {"seeds": 0}, ["seeds = 0", "greater than 0"]),
        ("01", {"drift_s": 59.0}, ["drift_s = 59: expected at least 60"]),
        ("01", {"noise": ["random-wolk"]}, ["random-wolk"]),
        ("01", {"noise": ["random-walk", "tilt"]}, ["noise = 'tilt'", "expected a drift"]),
        ("01", {"overrides": {"flight.trajectory": "orbit"}}, ["'vertical'", "'orbit' in the overrides"]),
        ("02", {"overrides": {"seed": 5}}, ["seed = 'report', and 5"]),
        ("02", {"correction": []}, ["correction = []", "at least 1"]),
        ("02", {"correction": ["none"]}, ["correction = 'none'", "'average'"]),
        ("02", {"draws": 1}, ["draws = 1"]),
        ("02", {"sensor": "starling2-honest"}, ["draws of the noise", "a sensor without faults"]),
        ("02", {"trajectory": "zigzag"}, ["'zigzag'", "'average' on 'orbit'"]),
        ("03", {"drawn": ["smoothed"]}, ["drawn = 'smoothed'", "'report-gicp'"]),
        ("03", {"duration_s": 3.0}, ["duration_s = 3 ", "still_s = 4.5"]),
        ("03", {"duration_s": 3.0, "overrides": {"flight.still_s": 0.0}}, ["duration_s = 3 ", "begins at 3.872 s"]),
        ("03", {"trajectory": ["orbit", "orbit"]}, ["'orbit' twice"]),
        ("03", {"methods": {"icp": ["best"], "gicp": ["best"]}, "drawn": ["best"]}, ["methods = ", "'best' twice"]),
        ("04", {"overrides": {"hough.dx_m": 0.05}}, ["hough.dx_m = 0.05", "the family 'clouds'"]),
        ("04", {"overrides": {"max_correspondence_m": 0.3}}, ["max_correspondence_m = 0.3: '3-DoF ICP, 0.1 m'", "0.1"]),
        ("04", {"overrides": {"tof.blind_s": [[1.0, 2.0]]}}, ["tof.blind_s", "icp-3dof"]),
        (
            "04",
            {"poor_starts": 2, "duration_s": 0.5, "blind_s": [], "overrides": {"flight.still_s": 0.0}},
            ["poor_starts = 2 with duration_s = 0.5", "at most 1"],
        ),
        ("04", {"blind_s": [[75.0, 60.0]]}, ["blind_s: [75.0, 60.0]"]),
        ("04", {"blind_s": [[60.0, 75.0], [230.0, 240.0]]}, ["blind_s: [230.0, 240.0] with duration_s = 240"]),
        ("04", {"step_m": 2.0}, ["step_m = 2 with reach_m = 1.2"]),
        ("05", {"mapped": ["none", "smoothed"]}, ["mapped = 'smoothed'"]),
        ("06", {"slow": ["gms"]}, ["slow = 'gms', did you mean 'gmm'"]),
        ("06", {"options": {"gmm": {"component": [3]}}}, ["options.gmm = 'component', did you mean 'components'"]),
        ("06", {"options": {"hough": {"dx": 0.1}}}, ["options.hough = 'dx': expected none"]),
        ("06", {"options": {"gmm": {"components": [0]}}}, ["options.gmm.components = [0]", "above 0"]),
        ("06", {"cloud_seeds": {"heavi": [1]}}, ["cloud_seeds = 'heavi'"]),
        ("06", {"cloud_seeds": {"heavy": ["report"]}}, ["cloud_seeds.heavy = ['report']", "numbers"]),
        ("06", {"seeds": ["report"]}, ["seeds = ['report']", "numbers"]),
        ("06", {"cloud_s": 0.1}, ["cloud_s = 0.1", "expected two scans"]),
        ("06", {"map_dx_m": [1e-6]}, ["map_dx_m.0 = 1e-06", "0.005"]),
        ("06", {"kept": [1e-9]}, ["kept.0 = 1e-09", "0.05"]),
        ("07", {"overrides": {"flight": {"trajectory": "loops"}}}, ["'zigzag'", "'loops'"]),
        ("07", {"seeds": [1, 2], "overrides": {"seed": 1}}, ["seed = 2, and 1 in the overrides"]),
        ("07", {"tower": ["tapered", "light"], "overrides": {"tower": "light"}}, ["tower = 'tapered', and 'light'"]),
        ("07", {"tower": ["tapered", "hevy"]}, ["tower = 'hevy'"]),
        ("07", {"trajectory": "planned"}, ["trajectory = 'planned'", "'zigzag'"]),
        ("09", {"trajectory": "planned"}, ["trajectory = 'planned'", "'zigzag'"]),
        ("10", {"trajectory": "orbit"}, ["trajectory = 'orbit'", "'zigzag'"]),
        ("08", {"study_folder": "results"}, ["study_folder = 'results'", "runs.parquet"]),
        ("08", {"noise": ["tilt"]}, ["noise = 'tilt'", "'random-walk+tilt'"]),
        ("08", {"method": ["average"]}, ["method = 'average'", "'smoothed'"]),
        ("08", {"method": ["deepvo"], "noise": ["constant-drift"]}, ["noise = 'constant-drift'", "'random-walk'"]),
        ("10", {"methods": ["orb", "lam"]}, ["methods = 'lam', did you mean 'loam'"]),
        ("10", {"methods": ["report-icp"]}, ["methods = 'report-icp'", "'icp'"]),
        (
            "11",
            {"flights": ["loops", "plannd"]},
            ["flights = 'plannd', did you mean 'planned'?: expected one of 'zigzag'"],
        ),
        ("11", {"overrides": {"flight.standoff_m": 3.0}}, ["flight.standoff_m = 3.0: 'wide loops' sets it to 2.4"]),
        ("12", {"starts_folder": "notebooks"}, ["starts_folder = 'notebooks'", "starts.csv"]),
        ("12", {"claims_file": "no.toml"}, ["claims_file = 'no.toml'"]),
        ("12", {"claims_file": "README.md"}, ["claims_file = 'README.md'", "not a file of claims"]),
        ("12", {"frames_folder": "results/claims"}, ["frames_folder = 'results/claims'", "segmentation-seeds"]),
        ("13", {"recording": "no.bag"}, ["recording = 'no.bag'"]),
        ("13", {"method": "orb"}, ["method = 'orb'", "no images"]),
        ("13", {"range_max_m": 0.001}, ["range_max_m = 0.001", "more than a voxel"]),
    ],
)
def test_what_cannot_be_flown_or_drawn_is_refused(notebook: str, given: dict, words: list[str]) -> None:
    (path,) = (path for path in NOTEBOOKS if path.name.startswith(notebook))
    with pytest.raises(InputError) as caught:
        check_parameters("e", given, read_parameters(path))
    assert all(word in str(caught.value) for word in words), str(caught.value)


@pytest.mark.parametrize(
    ("notebook", "given"),
    [
        ("01", {"noise": ["random-walk:0.004"], "drift_s": 60.0}),  # the report's seed has none: its curve is left out
        ("01", {"overrides": {"tower": "heavy", "tower.section": "round"}}),
        ("02", {"overrides": {"flight.duration_s": 25.0, "seed": "report"}}),
        ("05", {"methods": {"gicp": ["gicp"]}, "mapped": ["gicp"], "drawn": ["gicp"],
                "overrides": {"max_correspondence_m": 0.2}}),
        ("02", {"duration_s": 900.0,
                "overrides": {"flight.waypoints": [[0.5, 2.5, 0.1, -90.0, 0.0], [0.5, 2.5, 2.0, -90.0, 999.0]]}}),
        ("07", {"seeds": [5], "overrides": {"seed": 5, "tower": "tapered"}}),
        ("08", {"method": ["report-icp"]}),  # on the report's tower only
        ("10", {"methods": ["icp", "none"]}),
        ("11", {"flights": ["loops", "planned"], "overrides": {"flight.standoff_m": 3.0}}),
    ],
)  # fmt: skip
def test_what_can_be_flown_is_not_refused(notebook: str, given: dict) -> None:
    (path,) = (path for path in NOTEBOOKS if path.name.startswith(notebook))
    assert check_parameters("e", given, read_parameters(path)) == given


@pytest.mark.parametrize("notebook", ["08", "09", "10", "12"])
def test_a_study_without_the_runs_that_a_notebook_needs_is_refused(notebook: str, tmp_path: Path) -> None:
    (path,) = (path for path in NOTEBOOKS if path.name.startswith(notebook))
    runs = read_runs(path.parents[1] / "results" / "study")
    write_runs(tmp_path, runs[(runs["sensor"] == "starling2") & (runs["noise"] == "constant-drift")])
    given = {"study_folder": str(tmp_path)}
    if notebook == "08":  # shows what there is
        assert check_parameters("e", given, read_parameters(path)) == given
    else:
        with pytest.raises(InputError, match=r"study_folder = .*: it has no run with .*sensor"):
            check_parameters("e", given, read_parameters(path))


def cell_of(path: Path) -> str:
    return next(cell.source for cell in nbformat.read(path, 4).cells if cell.metadata.get("tags"))


def test_a_reader_s_own_edits_are_checked_against_the_committed_cell(shell: InteractiveShell) -> None:
    source = cell_of(next(path for path in NOTEBOOKS if path.stem.startswith("02")))
    run(shell, source.replace("draws = 4", "draws = 2 + 2"))
    parameters.validate()
    run(shell, source.replace("draws = 4", 'draws = "four"'))
    with pytest.raises(InputError, match="draws = 'four'"):
        parameters.validate()


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_the_note_is_shown_for_other_parameters_than_the_committed_ones(
    path: Path, shell: InteractiveShell, capsys: pytest.CaptureFixture
) -> None:
    cells = [cell.source for cell in nbformat.read(path, 4).cells]
    conclusions = [k for k, cell in enumerate(cells) if cell.startswith("## Conclusions")]
    assert [cells[k - 1] for k in conclusions] == ["parameters.note()"] * (path.stem != "00_explore")
    parts = [part for part in make_parts(path.parents[1], [], "full") if part.notebook == path]
    for part in parts:
        run(shell, cell_of(path))
        run(shell, "# Parameters\n" + "".join(f"{name} = {value!r}\n" for name, value in part.parameters.items()))
        parameters.note()
        assert capsys.readouterr().out == "", part.label
        run(shell, cell_of(path))
        name, value = next(iter(literals(cell_of(path)).items()))
        run(shell, f"# Parameters\n{name} = {[value]!r}\n")
        parameters.note()
        assert f"(results/{part.id}), not this one" in capsys.readouterr().out


@pytest.fixture
def shell() -> Iterator[InteractiveShell]:
    """The shell of a kernel after the cell of parameters of a notebook."""
    InteractiveShell.clear_instance()
    shell = InteractiveShell.instance()
    run(shell, 'noise = "random-walk"\nseed = 1  # of all\nduration_s = 20.0\nresults_dir = ""')
    yield shell
    InteractiveShell.clear_instance()


def run(shell: InteractiveShell, cell: str) -> None:
    shell.run_cell(cell, store_history=True).raise_error()


@pytest.mark.parametrize(
    ("injected", "words"),
    [
        ("sed = 2", "sed = 2: unknown setting, did you mean 'seed'.* noise, seed, duration_s"),
        ("duration_s = float('nan')", "duration_s = nan: input should be a finite number"),
        ('noise = "wind"', "wind"),
    ],
)
def test_what_papermill_injects_is_refused_by_the_notebook(shell: InteractiveShell, injected: str, words: str) -> None:
    run(shell, f'# Parameters\nresults_dir = "out"\n{injected}\n')
    with pytest.raises(InputError, match=f"parameters: .*{words}"):
        parameters.validate()


def test_a_folder_of_results_that_cannot_be_written_is_refused_before_anything_runs(
    shell: InteractiveShell, tmp_path: Path
) -> None:
    (tmp_path / "file").touch()
    mine, committed = tmp_path / "table.csv", Path(__file__).parents[2] / "results" / "explore"
    mine.touch()
    for folder, says in (
        (tmp_path / "file" / "out", "file/out: cannot be written"),
        (3, "results_dir = 3: expected"),
        (tmp_path, "table.csv: not listed as written by a notebook"),
        (committed, "explore/metrics.json: not listed as written by a notebook"),
    ):
        run(shell, f"# Parameters\nresults_dir = {folder if folder == 3 else str(folder)!r}\n")
        with pytest.raises(SteelnbError, match=says):
            parameters.validate()
    mine.unlink()
    run(shell, f"# Parameters\nresults_dir = {str(tmp_path / 'new')!r}\n")
    parameters.validate()
    assert [each.name for each in tmp_path.iterdir()] == ["file"]


def test_what_papermill_injects_takes_the_type_of_its_default(shell: InteractiveShell) -> None:
    run(shell, "x = 1")
    parameters.validate()  # nothing was injected
    run(shell, "# Parameters\nduration_s = 30\n")
    run(shell, "!true\nsed = 2  # a name of the notebook's own")
    parameters.validate()
    assert (shell.user_ns["seed"], repr(shell.user_ns["duration_s"])) == (1, "30.0")


def test_papermill_alone_ends_in_one_clear_error(tmp_path: Path) -> None:
    path = next(path for path in NOTEBOOKS if path.stem.startswith("12"))
    with pytest.raises(papermill.PapermillExecutionError) as caught:
        papermill.execute_notebook(path, tmp_path / "out.ipynb", {"sed": 1}, progress_bar=False, cwd=path.parent)
    assert caught.value.ename == "InputError"
    assert caught.value.evalue.startswith("parameters: sed = 1")


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
        "flights=[loops,zigzag] seed=3",
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
        ("x = (\nresults_dir = ''", ["parameters"], "plain literals"),
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
    (tmp_path / "a.ipynb").write_text("{}")
    with pytest.raises(InputError, match="not a notebook"):
        read_parameters(tmp_path / "a.ipynb")
    with pytest.raises(InputError, match="none"):
        read_parameters(tmp_path / "none.ipynb")
