"""`python -m workflow`: the calls behind `make reproduce`, `make smoke`, `make check` and `make docs`.

Exit code 0: done; 1: a notebook failed, or a result differs; 2: bad input; 130: interrupted.
"""

import os
import shlex
import shutil
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from steelnb.errors import NotebookError, SteelnbError
from steelnb.keys import find_root
from steelnb.report.results import processor
from steelnb.settings import parse_parameter
from workflow.check import differences, made_elsewhere, read_check_settings, read_committed, read_results, say
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
        # `workflow.check_study.check_sample` compares it again once it is flown with the report's own sensor.
        print(f"{STUDY}: not compared, since it was flown with the sensor report-4cm and is to be flown again")
    if say(found, committed, settings):
        return 0
    other = made_elsewhere(root, FOLDERS[budget], named)
    if other:
        print(f"the committed results were made on {other}, this is {processor()}: differences are shown, not judged")
    return 0 if other else 1


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
    refused = all(isinstance(fault, SteelnbError) and not isinstance(fault, NotebookError) for fault in report.failures)
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
