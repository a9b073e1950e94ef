"""What pages and notebooks say is what the files of results say. Each number is looked up in the files that its
sentence links, and a notebook's conclusions also in its own results. A number that no file holds is stale, or belongs
in one."""

import json
import re

import numpy as np
import pytest

from steelnb.notebook.results import find_root
from tests.statements import Stated, file_values, is_in, stated_numbers
from workflow.experiments import read_experiments

ROOT = find_root()
PAGES = ["README.md", *(f"docs/{path.name}" for path in sorted((ROOT / "docs").glob("*.md")))]
NOTEBOOKS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TABLES = "metrics.json", "table.csv", "bands.csv", "clouds.csv"
LINKED = re.compile(r"\]\(([^)#]*(?:\.csv|\.json|benchmarks/[\w-]+\.md))\)")
STATEMENT = re.compile(r"\n(?=[-|#]|\s*\n)|(?<=\.)\s")
"""Between two statements: items, rows of a table, paragraphs, sentences."""


def linked(text: str, folder) -> list[np.ndarray]:
    return [file_values(folder / link) for link in LINKED.findall(text)]


@pytest.mark.parametrize("page", PAGES)
def test_numbers_beside_a_link_are_in_the_file(page):
    for statement in STATEMENT.split((ROOT / page).read_text(encoding="utf-8")):
        files = linked(statement, (ROOT / page).parent)
        stated = stated_numbers(statement) if files else []
        assert [each for each in stated if not is_in(each, np.concatenate(files))] == [], statement


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_conclusions_are_those_of_the_results(path):
    own = [id for id, each in read_experiments(ROOT).items() if each.notebook == path.name]
    files = [ROOT / "results" / id / name for id in own for name in TABLES]
    results = np.concatenate([file_values(file) for file in files if file.is_file()])
    cells = ["".join(cell["source"]) for cell in json.loads(path.read_text(encoding="utf-8"))["cells"]]
    (closing,) = [text for text in cells if text.startswith("## Conclusions")] or [""]
    for item in re.split(r"\n(?=- )", closing):
        values = np.concatenate([results, *linked(item, path.parent)])
        assert [each for each in stated_numbers(item) if not is_in(each, values)] == [], item


def test_numbers_and_their_units_are_read_as_a_reader_does():
    text = "Errors are 30–31 / 25–28 mm and 4 cm (Figures 3.2 and 3.3, seed 21), .85 to .97 of 1,200 scans, −4 to +4 %."
    read = [(each.text, each.unit) for each in stated_numbers(text)]
    assert read[:5] == [("30", "mm"), ("31", "mm"), ("25", "mm"), ("28", "mm"), ("4", "cm")]
    assert read[5:] == [(".85", ""), (".97", ""), ("1,200", ""), ("4", "%"), ("4", "%")]


def test_a_stale_number_is_found():
    values = np.array([0.0307, 0.851, 1200.0])
    assert all(is_in(Stated(*each), values) for each in [("31", "mm"), ("3.1", "cm"), (".85", ""), ("1,200", "")])
    assert not any(is_in(Stated(*each), values) for each in [("32", "mm"), ("3.2", "cm"), (".86", ""), ("1,201", "")])
