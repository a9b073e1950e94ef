"""What pages and notebooks say is what the files of results say. `statements.toml` names the value behind each number
of a notebook's conclusions, and of sentences of README and docs that link a file of results. A number without a source
fails, and so does one that its source does not hold."""

import json
import re
import tomllib

import pytest

from steelnb.notebook.results import find_root
from tests.statements import is_value, stated_numbers, value_of

ROOT = find_root()
SOURCES = tomllib.loads((ROOT / "tests" / "statements.toml").read_text(encoding="utf-8"))
PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
NOTEBOOKS = [f"notebooks/{path.name}" for path in sorted((ROOT / "notebooks").glob("*.ipynb"))]
LINKED = re.compile(r"\]\(([^)#]*(?:\.csv|\.json|benchmarks/[\w-]+\.md))\)")
STATEMENT = re.compile(r"\n(?=[-|#]|\s*\n)|(?<=\.)\s")
"""Between two statements: items, rows of a table, paragraphs, sentences."""


def statements_of(name: str) -> list[str]:
    """What a page says beside links to results, or the conclusions of a notebook, with single spaces."""
    text = (ROOT / name).read_text(encoding="utf-8")
    if name.endswith(".md"):
        found = [each for each in STATEMENT.split(text) if LINKED.search(each)]
    else:
        cells = ["".join(cell["source"]) for cell in json.loads(text)["cells"]]
        found = [item for cell in cells if cell.startswith("## Conclusions") for item in re.split(r"\n(?=- )", cell)]
    return [" ".join(each.split()) for each in found]


@pytest.mark.parametrize("name", PAGES + NOTEBOOKS)
def test_each_number_is_the_value_of_its_source(name):
    sources = SOURCES.get(name, {})
    for statement in statements_of(name):
        rest = statement
        for says, values in sources.items():
            if says not in statement:
                continue
            stated = stated_numbers(says)
            assert len(stated) == len(values), f"{says}: {len(stated)} numbers and {len(values)} sources"
            for number, source in zip(stated, values, strict=True):
                value = value_of(source, ROOT)
                assert is_value(number, value), f"{says}: {number.text} {number.unit} is {value:.6g} in {source}"
            rest = rest.replace(says, " _ ")
        assert stated_numbers(rest) == [], f"no source for a number of: {rest}"


@pytest.mark.parametrize("name", SOURCES)
def test_no_source_is_of_a_former_sentence(name):
    assert [says for says in SOURCES[name] if not any(says in each for each in statements_of(name))] == []


def test_the_table_of_the_reports_plots_is_that_of_their_draws():
    report = ["report_mean_m", "report_max_m", "report_final_m"]
    names = [*report, "mean_m", "mean_low_m", "mean_high_m", "max_m", "final_m"]
    metrics, page = {}, (ROOT / "docs" / "report.md").read_text(encoding="utf-8")
    for id in ("segmentation-odometry-draws", "cloud-odometry-draws"):
        metrics |= json.loads((ROOT / "results" / id / "metrics.json").read_text(encoding="utf-8"))
    rows = re.findall(r"\n\| (3\.\d (\S+) .+?) \| (.+?) \| (.+?) \|", page)
    for plot, trajectory, theirs, ours in rows:
        own = f"{trajectory}-report.band.report-segments." if plot.endswith(" average") else f"-report.band.{plot}."
        value = {key.rpartition(".")[2]: value for key, value in metrics.items() if own in key}
        assert re.findall(r"\d\.\d+", f"{theirs} {ours}") == [f"{value[name]:.3f}" for name in names], plot
    assert len(rows) == 15
