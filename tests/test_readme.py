import csv
import io
import re
import shutil
import subprocess
import sys
import tarfile
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TABLES = ("README.md", "results/README.md", "results/claims/README.md")
PAGES = (*TABLES, "benchmarks/README.md", "CONTRIBUTING.md")
LINK = re.compile(r"""\]\(([^)#:\s]+)[^):]*\)|src="([^"]+)\"""")


@pytest.fixture(scope="module")
def committed(tmp_path_factory) -> Path:
    """Tables and results as committed: `make reproduce` on another kind of processor writes results of other digits
    into the tree. The tree itself where there is no git, as for `workflow.check.read_committed`."""
    names = ("README.md", "scripts", "results/*.csv", "results/*.json", "results/*.md")
    kept = subprocess.run(["git", "archive", "HEAD", *names], cwd=ROOT, capture_output=True, check=False)
    if kept.returncode:
        return ROOT
    folder = tmp_path_factory.mktemp("committed")
    with tarfile.open(fileobj=io.BytesIO(kept.stdout)) as archive:
        archive.extractall(folder, filter="data")
    return folder


def test_the_tables_are_those_of_the_results(committed):
    done = subprocess.run(
        [sys.executable, committed / "scripts/readme-table", "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("page", PAGES)
def test_the_files_that_a_page_links_are_there(page):
    links = [one or other for one, other in LINK.findall((ROOT / page).read_text(encoding="utf-8"))]
    assert links
    assert [link for link in links if not (ROOT / page).parent.joinpath(link).exists()] == []


def test_every_benchmark_is_in_the_index():
    text = (ROOT / "benchmarks/README.md").read_text(encoding="utf-8")
    names = {path.name for path in (ROOT / "benchmarks").glob("*.*")} - {"README.md"}
    assert {name for name in names if f"]({name})" not in text} == set()


def test_every_script_without_a_suffix_is_linted_and_type_checked():
    tools = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]
    files = [path for path in (ROOT / "scripts").iterdir() if path.is_file()]
    python = {f"scripts/{path.name}" for path in files if path.read_bytes().startswith(b"#!/usr/bin/env python3\n")}
    assert python
    assert python == set(tools["ruff"]["extend-include"])
    assert python == {name for name in tools["mypy"]["files"] if name.startswith("scripts/")}


def test_the_first_page_is_short():
    assert (ROOT / "README.md").stat().st_size <= 5_000
    assert (ROOT / "docs/_static/tower.webp").stat().st_size <= 2_000_000


def test_every_claim_stands_in_its_table_with_its_verdict(committed):
    shown = (committed / "results/claims/README.md").read_text(encoding="utf-8")
    with (committed / "results/claims/table.csv").open(encoding="utf-8") as file:
        claims = list(csv.DictReader(file))
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in shown.splitlines() if line.startswith("| ")}
    assert len(claims) >= 25
    for row in claims:
        line = lines[row["claim"]]
        verdict = line.split(" | ")[2]
        assert verdict.startswith(f"**{row['verdict']}**")
        assert verdict.endswith(row["where"] or "**")
        if row["cells"] not in ("", "0"):
            assert f" | {row['as_claimed']}, {row['not_as_claimed']}, {row['cells']} | " in line


def test_a_table_that_is_not_that_of_the_results_is_told(committed, tmp_path):
    for name in ("scripts", "results"):
        shutil.copytree(committed / name, tmp_path / name, ignore=shutil.ignore_patterns("parts", "*.png"))
    shutil.copy(committed / "README.md", tmp_path)
    script = [sys.executable, tmp_path / "scripts/readme-table"]
    table = tmp_path / "results/claims/table.csv"
    table.write_text(table.read_text(encoding="utf-8").replace("does not hold", "holds", 1), encoding="utf-8")
    told = subprocess.run([*script, "--check"], capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "scripts/readme-table" in told.stderr
    before = {name: (tmp_path / name).read_text(encoding="utf-8") for name in TABLES}
    subprocess.run(script, check=True)
    changed = {name for name in TABLES if (tmp_path / name).read_text(encoding="utf-8") != before[name]}
    assert changed == {"README.md", "results/claims/README.md"}
    text = (tmp_path / "README.md").read_text(encoding="utf-8")
    (tmp_path / "README.md").write_text(text.replace("<!-- /table -->", ""), encoding="utf-8")
    told = subprocess.run(script, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "README.md: no <!-- table -->" in told.stderr
