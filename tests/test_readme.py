"""The pages of the repository link to files that are there; numbers of the first page are those of its files."""

import json
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
PAGES = ("README.md", "results/README.md", "benchmarks/README.md", "CONTRIBUTING.md", "docs/index.md")
LINK = re.compile(r"""\]\(([^)#:\s]+)[^):]*\)|src="([^"]+)\"""")


@pytest.mark.parametrize("page", PAGES)
def test_the_files_that_a_page_links_are_there(page):
    links = [one or other for one, other in LINK.findall((ROOT / page).read_text(encoding="utf-8"))]
    assert links
    assert [link for link in links if not (ROOT / page).parent.joinpath(link).exists()] == []


def numbers(experiment: str) -> dict[str, float]:
    return json.loads((ROOT / f"results/{experiment}/metrics.json").read_text(encoding="utf-8"))


def test_the_first_page_is_short_and_its_numbers_are_those_of_the_results():
    page = (ROOT / "README.md").read_text(encoding="utf-8")
    assert len(page.encode()) <= 4096
    segments, clouds, faults = numbers("segmentation-odometry"), numbers("cloud-odometry"), numbers("honest-sensors")
    for flight, other in (("vertical", "zigzag"), ("orbit", "loops")):
        bars = segments[f"{flight}-report.constant-drift.report-segments.error_mean_m"]
        points = [
            clouds[f"random-walk-report.{flight}.random-walk.report-{name}.re-voxelised.error_mean_m"]
            for name in ("icp", "icp-3dof", "gicp")
        ]
        assert f"{bars:.3f}; " + " / ".join(f"{each:.3f}" for each in points) in page
        ideal, real = (1e3 * faults[f"{other}.faces.{case}.ate_mean_m"] for case in ("ideal", "honest"))
        assert f"{ideal:.0f}; {real:.0f} mm" in page
