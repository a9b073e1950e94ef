"""The pages of the repository link to files that are there."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "results/README.md", "benchmarks/README.md", "CONTRIBUTING.md")
LINK = re.compile(r"""\]\(([^)#:\s]+)[^):]*\)|src="([^"]+)\"""")


@pytest.mark.parametrize("page", PAGES)
def test_the_files_that_a_page_links_are_there(page):
    links = [one or other for one, other in LINK.findall((ROOT / page).read_text(encoding="utf-8"))]
    assert links
    assert [link for link in links if not (ROOT / page).parent.joinpath(link).exists()] == []
