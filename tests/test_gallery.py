"""A gallery of a tiny project, as files; `tests/browser` looks at pages with a browser."""

import json
import re
import subprocess
import sys
from pathlib import Path

import nbformat
import pytest

from steelnb import gallery, reproduce
from steelnb.cli import main
from steelnb.errors import NotebookError, OutputError
from steelnb.gallery.page import read_page

ROOT = Path(__file__).parents[1]
EXPERIMENTS = """
[pair]
notebook = "tiny.ipynb"
title = "Two & a half"
matrix = { trajectory = ["vertical", "orbit"] }
full = {}
smoke = {}

[long]
notebook = "tiny.ipynb"
title = "Takes long"
about = "A sentence of its own."
apart = true
full = {}
smoke = {}
"""
TEXT = """
# A heading

The **first** `sentence` of
all. Another; see [itself](tiny.ipynb), [code](../steelnb/cli.py), [afar](https://example.org/x) and [none](none.ipynb).
"""
PARAMETERS = """
trajectory = "vertical"
results_dir = ""
"""
SHOWN = """
import sys
import ipywidgets, pandas
from IPython.display import display
from steelnb import results
from steelnb.figures.style import Figure
figure = Figure(figsize=(4, 2))
figure.subplots().plot([0, 1])
table = pandas.DataFrame({f"a_rather_long_column_{k}": [1.5] for k in range(12)})
print("careful", file=sys.stderr)
display(ipywidgets.IntSlider(), figure, table)
display({"application/vnd.plotly.v1+json": {"data": [{"y": [1, 2], "name": "</script>"}], "layout": {}}}, raw=True)
results.write_results(results_dir, table=table, metrics={"one": 1}, figures={"one": figure}, provenance={})
"""


def make_project(root: Path, experiments: str = EXPERIMENTS) -> Path:
    """A project with one tiny notebook that shows a picture, a wide table, a control and a figure of Plotly."""
    cells = [nbformat.v4.new_markdown_cell(TEXT.strip())]
    cells += [nbformat.v4.new_code_cell(source.strip()) for source in (PARAMETERS, SHOWN)]
    cells[1].metadata["tags"] = ["parameters"]
    (root / "notebooks").mkdir(parents=True)
    nbformat.write(nbformat.v4.new_notebook(cells=cells), root / "notebooks" / "tiny.ipynb")
    (root / "notebooks" / "experiments.toml").write_text(experiments, encoding="utf-8")
    return root


@pytest.fixture(scope="module")
def project(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = make_project(tmp_path_factory.mktemp("project"))
    report = gallery.make(root=root)
    assert report.index == root / "gallery" / "index.html"
    assert [path.name for path in report.pages] == ["pair-vertical.html", "pair-orbit.html"]
    assert report.missing == ["long"]
    return root


def test_a_gallery_holds_a_page_for_every_part(project: Path) -> None:
    pages = {path.name: path.read_text(encoding="utf-8") for path in (project / "gallery").iterdir()}
    assert set(pages) == {"index.html", "pair-vertical.html", "pair-orbit.html"}
    for name, page in pages.items():
        markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL).replace("https://example.org/x", "")
        assert not re.search(r"""(src|href)=["']?(https?:)?//""", markup), name
        assert str(project) not in page, name
        assert "<title>" in page, name
        assert page.count("Content-Security-Policy") == 1, name
    page = pages["pair-orbit.html"]
    assert "<title>Two &amp; a half: orbit</title>" in page
    assert '<a href="pair-vertical.html">itself</a>' in page
    assert '<a href="https://example.org/x">afar</a>' in page
    assert re.search(r"<a\s*>code</a>", page)
    assert re.search(r"<a\s*>none</a>", page)
    assert page.count("careful") == 1, "in the code that warns, and nowhere else"
    assert "make lab" in page
    assert len(re.findall(r"<img\b[^>]*src=.data:image/png;base64,", page)) == 1
    assert page.count('class="plot"') == 1
    assert len(re.findall(r"<script>", re.sub(r"<script type.*?</script>", "", page, flags=re.DOTALL))) >= 2
    assert "<\\/script>" in page
    assert "aria-current=page>orbit" in page


def test_the_index_shows_every_experiment_and_links_what_has_run(project: Path) -> None:
    index = (project / "gallery" / "index.html").read_text(encoding="utf-8")
    assert index.count("<article>") == 2
    assert index.count("data:image/jpeg;base64,") == 1
    assert "<p>The first sentence of all.</p>" in index
    assert "A sentence of its own." in index
    assert "steelnb reproduce long" in index
    assert set(re.findall(r'href="([^"]+html)"', index)) == {"pair-vertical.html", "pair-orbit.html"}
    assert "<script" not in index


def test_what_is_up_to_date_is_only_converted(project: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    seen = [path for _, path in reproduce.executed(["pair"], root=project)]
    assert None not in seen
    monkeypatch.setattr(subprocess, "Popen", None)
    report = gallery.make(["pair"], output=tmp_path / "new" / "pages", root=project)
    assert [path.parent for path in report.pages] == [tmp_path / "new" / "pages"] * 2
    assert report.missing == []
    again = {path.name: path.read_bytes() for path in (tmp_path / "new" / "pages").iterdir()}
    assert again["pair-orbit.html"] == (project / "gallery" / "pair-orbit.html").read_bytes()


def test_a_notebook_that_was_cleared_away_runs_again_and_old_pages_go(project: Path) -> None:
    part, path = reproduce.executed(["pair"], root=project)[0]
    assert path is not None
    path.unlink()
    assert reproduce.executed(["pair"], root=project)[0] == (part, None)
    target = project / "gallery"
    (target / "gone.html").write_text((target / "index.html").read_text(encoding="utf-8"), encoding="utf-8")
    (target / "mine.html").write_text("<p>my own</p>", encoding="utf-8")
    gallery.make(["pair"], root=project)
    assert path.is_file()
    assert sorted(file.name for file in target.iterdir()) == [
        "index.html", "mine.html", "pair-orbit.html", "pair-vertical.html"
    ]  # fmt: skip


def test_a_gallery_that_cannot_be_written_or_run_leaves_the_old_one(project: Path, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="file"):
        gallery.make(["pair"], output=tmp_path / "file", root=project)
    broken = make_project(tmp_path / "broken")
    notebook = broken / "notebooks" / "tiny.ipynb"
    notebook.write_text(notebook.read_text().replace("figure = Figure", "figure = Figura"))
    (broken / "gallery").mkdir()
    (broken / "gallery" / "index.html").write_text("old")
    with pytest.raises(NotebookError, match="NameError"):
        gallery.make(root=broken)
    assert [(path.name, path.read_text()) for path in (broken / "gallery").iterdir()] == [("index.html", "old")]


def test_a_notebook_that_holds_an_error_is_refused(tmp_path: Path) -> None:
    output = nbformat.v4.new_output("error", ename="ValueError", evalue="no", traceback=[])
    cell = nbformat.v4.new_code_cell("1/0", outputs=[output])
    nbformat.write(nbformat.v4.new_notebook(cells=[cell]), tmp_path / "bad.ipynb")
    with pytest.raises(NotebookError, match="ValueError: no"):
        read_page(tmp_path / "bad.ipynb", {})


def test_the_command_names_an_unknown_experiment_in_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["gallery", "explor", "--budget", "smoke"]) == 2
    assert "did you mean 'explore'" in capsys.readouterr().err


def test_formulas_are_written_in_characters() -> None:
    # A page that is read offline has no MathJax: $…$ would stay as it is.
    for path in (ROOT / "notebooks").glob("*.ipynb"):
        for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]:
            if cell["cell_type"] == "markdown":
                assert not re.search(r"\$[^$\n]+\$|\\\(|\\\[|\\begin", "".join(cell["source"])), path.name


def test_the_command_line_does_not_import_what_a_gallery_needs() -> None:
    code = "import sys, steelnb.cli; print({'nbconvert', 'plotly', 'nbformat', 'PIL'} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"
