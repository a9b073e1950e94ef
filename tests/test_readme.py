import csv
import shutil
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_the_tables_of_the_readme_are_those_of_the_results():
    done = subprocess.run(
        [sys.executable, ROOT / "scripts/readme-table", "--check"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


def test_the_files_that_the_readme_links_are_there():
    import re

    links = re.findall(r"\]\(([^)#:]+)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    assert len(links) > 10
    assert [link for link in links if not (ROOT / link).exists()] == []


def test_every_claim_stands_in_the_readme_with_its_verdict():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    shown = text.partition("<!-- claims -->")[2].partition("<!-- /claims -->")[0]
    with (ROOT / "results/claims/table.csv").open(encoding="utf-8") as file:
        claims = list(csv.DictReader(file))
    lines = {line.split(" | ")[0].removeprefix("| "): line for line in shown.splitlines() if line.startswith("| ")}
    assert len(claims) >= 25
    for row in claims:
        line = lines[row["claim"]]
        assert line.rstrip(" |").endswith(row["condition"] or row["verdict"])
        assert f" | {row['verdict']}" in line
        assert ("[" in line) == bool(row["estimate"])


def test_a_table_that_is_not_that_of_the_results_is_told(tmp_path):
    for name in ("scripts", "results"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("parts", "*.png", "*.glb"))
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    script = [sys.executable, tmp_path / "scripts/readme-table"]
    (tmp_path / "README.md").write_text(text, encoding="utf-8")
    table = tmp_path / "results/claims/table.csv"
    table.write_text(table.read_text(encoding="utf-8").replace("holds", "stands"), encoding="utf-8")
    told = subprocess.run([*script, "--check"], capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "scripts/readme-table" in told.stderr
    subprocess.run(script, check=True)
    fresh = (tmp_path / "README.md").read_text(encoding="utf-8")
    assert fresh != text
    assert fresh.partition("<!-- claims -->")[0] == text.partition("<!-- claims -->")[0]
    (tmp_path / "README.md").write_text(text.replace("<!-- /claims -->", ""), encoding="utf-8")
    told = subprocess.run(script, capture_output=True, text=True, check=False)
    assert told.returncode == 1
    assert "<!-- claims -->" in told.stderr
