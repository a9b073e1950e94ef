"""`python -m workflow`: the calls behind `make reproduce`, `make smoke`, `make check` and `make docs`.

Exit code 0: done; 1: a notebook failed, or a result differs; 2: bad input; 130: interrupted.
"""

import json
import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from steelnb.errors import InputError, OutputError, SteelnbError
from steelnb.results import find_root
from steelnb.settings import parse_parameter
from workflow.check import differences, read_check_settings, read_committed, read_results, say
from workflow.experiments import FOLDERS, make_parts, output_folder, read_experiments, select
from workflow.task_notebooks import Plan, Report, run

STUDY = Path("results", "study")

app = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False, help=__doc__)
Ids = Annotated[list[str] | None, typer.Argument(metavar="[ID]...", help="Default: all that are not apart.")]
Budget = Annotated[str, typer.Option(help="full, or smoke: a short run of every method.")]
Jobs = Annotated[int, typer.Option(min=1, help="Notebooks run at once.")]


def make_plans(
    root: Path, ids: list[str] | None, budget: str, given: dict[str, Any] | None = None, output: Path | None = None
) -> list[Plan]:
    """The experiments named with their parts, every parameter checked. Raises `SteelnbError`."""
    experiments = select(read_experiments(root), ids or [], budget)
    parts = [make_parts(root, experiment, budget, given or {}) for experiment in experiments]
    folder = output_folder(root, budget, given or {}, output)
    return [Plan(each, budget, some, folder / each.id) for each, some in zip(experiments, parts, strict=True)]


@app.command()
def reproduce(
    ids: Ids = None,
    budget: Budget = "full",
    parameters: Annotated[str, typer.Option("-p", metavar="'NAME=VALUE ...'", help="Wants an output folder.")] = "",
    output: Annotated[Path | None, typer.Option(help="Folder for <id>/; default: results or results-smoke.")] = None,
    jobs: Jobs = 2,
    force: Annotated[bool, typer.Option("--force", help="Run again what is up to date.")] = False,
) -> int:
    """Run the notebooks that are not up to date, and leave metrics, tables and figures in <output>/<id>/."""
    root, given = find_root(), dict(map(parse_parameter, shlex.split(parameters)))
    plans = make_plans(root, ids, budget, given, output)
    report = run(plans, root / ".cache" / "workflow" / ("custom" if given else budget), jobs, force)
    for folder in report.written:
        print(f"{os.path.relpath(folder)}/ written")
    if not report.written and not report.failures:
        print("everything is up to date")
    return _failures(report)


@app.command()
def check(
    ids: Ids = None,
    budget: Budget = "full",
    jobs: Jobs = 2,
    rerun: Annotated[bool, typer.Option(help="Run again, or compare the results as they lie there.")] = True,
) -> int:
    """Run the notebooks again, into .cache/workflow/check/results/, and compare with the committed results.

    The study's sample of runs is left out until the study is flown again.
    """
    root = find_root()
    cache = root / ".cache" / "workflow" / "check"
    plans = make_plans(root, ids, budget, output=cache / "results" if rerun else None)
    settings, named = read_check_settings(root), [plan.experiment.id for plan in plans]
    committed = read_committed(root, FOLDERS[budget], named)
    if rerun:
        shutil.rmtree(cache / "results", ignore_errors=True)
        report = run(plans, cache, jobs, force=True)
        if report.failures:
            return _failures(report)
    now = read_results(cache / "results" if rerun else root / FOLDERS[budget], named)
    found = [*differences(committed, now, settings)]
    if rerun and not ids and (root / STUDY / "runs.parquet").is_file():
        print(f"{STUDY}: not compared, since it was flown with the sensor report-4cm and is to be flown again")
    return 0 if say(found, committed, settings) else 1


@app.command()
def digests(
    write: Annotated[bool, typer.Option("--write", help="Write tests/digests.json anew.")] = False,
    short: Annotated[bool, typer.Option("--short", help="The set that `bits` emulates.")] = False,
    result: Annotated[Path | None, typer.Option("--json", help="Write all digests into this file.")] = None,
) -> int:
    """Compute the digests of short flights and say which differ from those of the last commit."""
    from workflow import digests as of

    settings, root = of.SHORT if short else of.SETTINGS, find_root()
    found: dict[str, str] = {}
    for pair in of.pairs(settings):
        found.update(of.digests(settings, *pair))
    if result:
        result.write_text(json.dumps(found), encoding="utf-8")
    if short or result:
        return 0
    old = of.kept(root) if write else of.read(root)
    differ = of.changed(old, found)
    for name in differ:
        print(f"changed: {name}: {old.get(name, 'missing')}, now {found.get(name, 'missing')}")
    print(f"{len(differ)} of {len(found)} digests changed")
    if write:
        of.write(root, found)
    return 0 if write else int(bool(differ))


@app.command()
def bits() -> int:
    """Compute the digests as other processors would, natively and emulated, and print a table."""
    from workflow.bits import compare
    from workflow.digests import read

    root = find_root()
    return 0 if compare(root, read(root)) else 1


@app.command()
def pages(budget: Budget = "smoke") -> int:
    """Write the notebooks as executed, and the script of Plotly, where Sphinx takes them from: docs/notebooks/."""
    from workflow.pages import write_pages

    root = find_root()
    missing = write_pages(make_plans(root, None, budget), root / ".cache" / "workflow" / budget, root / "docs")
    for label in missing:
        print(f"{label}: no page, since it has not been run: make reproduce ONLY={label.partition('/')[0]}")
    return 0


def _failures(report: Report) -> int:
    for fault in report.failures:
        print("error:", " ".join(str(fault).split()), file=sys.stderr)
    refused = all(isinstance(fault, (InputError, OutputError)) for fault in report.failures)
    return (2 if refused else 1) if report.failures else 0


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and give the exit code; errors of the user's go to stderr as one line each."""
    try:
        return int(app(arguments, prog_name="workflow", standalone_mode=False) or 0)
    except (SteelnbError, typer.TyperException) as fault:
        text = fault.format_message() if isinstance(fault, typer.TyperException) else str(fault)
        print("error:", " ".join(text.split()), file=sys.stderr)
        return 2
    except SystemExit as end:
        print("interrupted; nothing is half-written, and the next call goes on from here", file=sys.stderr)
        return int(end.code or 0)


if __name__ == "__main__":
    sys.exit(main())
