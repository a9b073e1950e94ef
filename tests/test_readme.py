import io
import re
import subprocess
import sys
import tarfile
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
