"""The command line: thin commands, one line for each error, exit codes that a script can use.

0: done; 1: a notebook failed, or `check` or `structure` found a difference; 2: bad input; 130: interrupted.
"""

import contextlib
import math
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated

import typer

import steelnb
from steelnb import cli_recordings
from steelnb import reproduce as notebooks
from steelnb.config import Tolerance
from steelnb.errors import SettingsError, SteelnbError
from steelnb.project import Project, parse_parameter

LINE_PERIOD_S = 30.0
INTERRUPTED = 130

TOLERANCE = Tolerance()

app = typer.Typer(add_completion=False, pretty_exceptions_enable=False, help=steelnb.__doc__)
Ids = Annotated[list[str] | None, typer.Argument(metavar="[ID]...", help="Experiments; default: all. See `list`.")]
Budget = Annotated[str, typer.Option(help="full, or smoke: a short run of every method.")]
Jobs = Annotated[int, typer.Option(help="Notebooks run at once.")]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and give the exit code; errors of the user's go to stderr as one line each."""
    arguments = sys.argv[1:] if arguments is None else arguments
    try:
        code = app(arguments or ["--help"], prog_name="steelnb", standalone_mode=False)
    except notebooks.NotebooksFailedError as fault:
        return _complain(*fault.failures, code=fault.exit_code)
    except (SteelnbError, typer.TyperException) as fault:
        return _complain(fault.format_message() if isinstance(fault, typer.TyperException) else str(fault))
    if code == INTERRUPTED:  # Typer catches KeyboardInterrupt itself
        return _complain(
            "interrupted; nothing is half-written, and notebooks and studies resume where they stopped",
            code=INTERRUPTED,
        )
    return int(code or 0)


def _complain(*messages: str, code: int = 2) -> int:
    for message in messages:
        print("steelnb: error:", " ".join(message.split()), file=sys.stderr)
    return code


def _version(asked: bool) -> None:
    if asked:
        print(f"steelnb {steelnb.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    """Drone mapping of steel structures: experiments, and segments of point clouds."""


@app.command("list")
def list_experiments() -> None:
    """List the experiments, and whether their results are up to date in this clone."""
    rows = [("id", "title", "figures", "notebook", "parts", "state")]
    for found in notebooks.states():
        experiment = found.experiment
        parts, state = str(found.parts), found.state
        rows.append((experiment.id, experiment.title, experiment.figures, experiment.notebook, parts, state))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip())


@app.command()
def reproduce(
    ids: Ids = None,
    budget: Budget = "full",
    parameter: Annotated[
        list[str] | None,
        typer.Option(
            "-p", "--parameter", metavar="NAME=VALUE", help="E.g. trajectory=orbit or tof.rate_hz=10; needs -o."
        ),
    ] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for <id>/; default: results or results-smoke.")
    ] = None,
    jobs: Jobs = 2,
    force: Annotated[bool, typer.Option("--force", help="Run again what is up to date.")] = False,
) -> None:
    """Run the notebooks, and leave metrics, tables and figures in results/<id>/. Skips what is up to date."""
    given = dict(map(parse_parameter, parameter or []))
    with _shown() as on_progress:
        report = notebooks.run(ids or [], budget, given, output, jobs, force=force, on_progress=on_progress)
    for folder in report.written:
        print(f"{_short(folder)}/ written")
    if not report.written:
        print("everything is up to date")


@app.command()
def check(
    ids: Ids = None,
    budget: Budget = "full",
    jobs: Jobs = 2,
    rerun: Annotated[bool, typer.Option(help="Run again, or compare the results as they lie there.")] = True,
) -> None:
    """Run the notebooks, and a sample of the study, again and compare with what is committed. Exit 1 on a difference.

    The identifier `study` names the study.
    """
    named = [name for name in ids or [] if name != "study"]
    report = sample = None
    with _shown() as on_progress:
        if named or not ids:
            report = notebooks.check(named, budget, jobs, rerun=rerun, on_progress=on_progress)
        if rerun and budget == "full" and ("study" in (ids or []) or _has_study(ids)):
            from steelnb import studies

            sample = studies.check("study" in (ids or []), jobs, on_progress)
    settings = Project().check
    for pattern, reason in settings.exceptions.items():
        print(f"exception: {pattern}: {reason}")
    count = 0
    for each in filter(None, (report, sample)):
        for difference in each.differences:
            kind = f"excused ({difference.reason})" if difference.reason else "DIFFERS"
            where = f" {difference.where}" if difference.where else ""
            print(f"{kind}: {difference.name}{where}: committed {difference.committed}, now {difference.now}")
        fresh = sum(not difference.reason for difference in each.differences)
        if fresh:
            print(f"{fresh} differences; the new results are in {_short(each.folder)}/")
        count += fresh
    if count:
        raise typer.Exit(1)
    if report:
        agreed = f"{report.metrics} metrics of {report.experiments} experiments agree"
        print(f"{agreed}, and their tables, to {settings.relative_tolerance:g} relative")
    if sample:
        print(f"{sample.metrics} values of a sample of the study agree to {settings.relative_tolerance:g} relative")


def _has_study(ids: list[str] | None) -> bool:
    """Whether a call without names finds a study to compare with; told without importing what runs one."""
    return not ids and (Project().root / "results" / "study" / "runs.parquet").is_file()


@app.command()
def study(
    path: Annotated[Path | None, typer.Argument(metavar="[STUDY.toml]", help="Default: notebooks/study.toml.")] = None,
    workers: Annotated[int | None, typer.Option(help="Processes on this machine; default: one a core.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask cluster of yours, such as tcp://HOST:8786.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what it would take, and run nothing.")] = False,
    out: Annotated[Path | None, typer.Option("--out", help="Folder of the table; default: results/study.")] = None,
) -> None:
    """Run many seeds, flights, noises, sensors and methods; only those not run yet. Exit 1 if some failed."""
    from steelnb import studies

    if dry_run:
        forecast = studies.forecast(path, out, workers, scheduler)
        for note in forecast.notes:
            print(f"steelnb: warning: {note}", file=sys.stderr)
        size = forecast.worker_bytes / 1e9
        known = f"measured on {forecast.known} runs" if forecast.known else "by a rule of thumb"
        time_text = f"{_duration(forecast.seconds)} on {forecast.workers} workers, {known}"
        print(f"{forecast.runs} runs on {forecast.flights} flights, {forecast.kept} of them done")
        print(f"{forecast.runs - forecast.kept} to run: {time_text}")
        print(f"{size:.1f} GB a worker, {size * forecast.workers:.1f} GB in all")
        return
    with _shown() as on_progress:
        report = studies.run(path, out, workers, scheduler, on_progress)
    for note in report.notes:
        print(f"steelnb: warning: {note}", file=sys.stderr)
    fresh = report.runs - report.kept
    print(f"{_short(report.folder)}/runs.parquet written: {report.runs} runs, {fresh} of them run now")
    if report.failed:
        print(
            f"{len(report.failed)} runs failed; the next call tries them again, and their tracebacks are in the table"
        )
        raise typer.Exit(1)


def _duration(seconds: float) -> str:
    minutes, rest = divmod(math.ceil(seconds), 60)
    return f"{minutes} min {rest:02d} s"


@app.command()
def gallery(
    ids: Ids = None,
    budget: Budget = "full",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", "--out", help="Folder for the pages; default: gallery.")
    ] = None,
    jobs: Jobs = 2,
) -> None:
    """Run what is not up to date, and make pages of all notebooks that need nothing but a browser."""
    from steelnb.gallery import make

    with _shown() as on_progress:
        report = make(ids or [], budget, output, jobs, on_progress=on_progress)
    for name in report.missing:
        print(f"{name}: no page, since it takes long: `steelnb reproduce {name}` runs it")
    print(f"{_short(report.index)} written, and {len(report.pages)} pages behind it")


@app.command()
def segment(
    cloud: Annotated[Path, typer.Argument(help="PLY, PCD, LAS, LAZ, XYZ, TXT, CSV, PTS or ASC file.")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder for the segments.")] = None,
    voxel: Annotated[float | None, typer.Option(help="Voxel size in metres; default: from the point spacing.")] = None,
    dx: Annotated[
        float | None, typer.Option(help="Radius of a bar's tube of points in metres; default: from the point spacing.")
    ] = None,
    min_votes: Annotated[int | None, typer.Option(help="Fewest points of a line.")] = None,
    structure: Annotated[bool, typer.Option(help="Write structure.json too: bars tied at joints.")] = True,
) -> None:
    """Find the straight bars in a point cloud, and the joints that tie them."""
    from steelnb.segment import segment_file

    result = segment_file(cloud, output, voxel_m=voxel, dx_m=dx, min_votes=min_votes, structure=structure)
    print("\n".join(result.summary))


@app.command()
def structure(
    first: Annotated[Path, typer.Argument(metavar="A.json", help="A structure as steelnb wrote it.")],
    second: Annotated[Path | None, typer.Argument(metavar="[B.json]", help="Another one, in the same frame.")] = None,
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="Folder for differences.csv and differences.png.")
    ] = None,
    to: Annotated[
        Path | None, typer.Option("--to", help="Write A to this file: .json, .csv, .dxf, .glb, .ply, .graphml or .ifc.")
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Let --to overwrite.")] = False,
    offset: Annotated[float, typer.Option(help="Metres up to which an axis has not moved.")] = TOLERANCE.offset_m,
    angle: Annotated[float, typer.Option(help="Degrees up to which it has not turned.")] = TOLERANCE.angle_deg,
    end: Annotated[float, typer.Option(help="Metres up to which its ends have not moved.")] = TOLERANCE.end_m,
    joint: Annotated[float, typer.Option(help="Metres up to which a joint has not moved.")] = TOLERANCE.joint_m,
    match_offset: Annotated[
        float, typer.Option(help="Metres beyond which a bar is another bar.")
    ] = TOLERANCE.match_offset_m,
    match_angle: Annotated[
        float, typer.Option(help="Degrees beyond which it is another bar.")
    ] = TOLERANCE.match_angle_deg,
    match_joint: Annotated[
        float, typer.Option(help="Metres beyond which a joint is another joint.")
    ] = TOLERANCE.match_joint_m,
) -> None:
    """Say what a structure holds; compare it with another (exit 1 if they differ); or convert it with --to."""
    from steelnb import structure as structures

    if second is None and output is not None:
        raise SettingsError("--output: expected two structures to compare; --to FILE converts one")
    if second is not None and to is not None:
        raise SettingsError("--to: expected one structure to convert, not two")
    if second is not None:
        limit = Tolerance(
            offset_m=offset, angle_deg=angle, end_m=end, joint_m=joint, match_offset_m=match_offset,
            match_angle_deg=match_angle, match_joint_m=match_joint,
        )  # fmt: skip
        report = structures.compare_files(first, second, output, limit)
        print("\n".join(report.summary))
        raise typer.Exit(0 if report.comparison.equal else 1)
    if to is not None:
        for file in structures.convert_file(first, to, overwrite=force):
            print(f"{file} written")
        return
    print("\n".join(structures.describe_file(first)))


app.add_typer(cli_recordings.app)


def _short(folder: Path) -> Path:
    return folder.relative_to(Path.cwd()) if folder.is_relative_to(Path.cwd()) else folder


def _left(status: notebooks.Status) -> str:
    if status.remaining_s is None:
        return "time left unknown"
    minutes, seconds = divmod(math.ceil(status.remaining_s), 60)
    return f"{minutes}:{seconds:02d} left"


@contextlib.contextmanager
def _shown() -> Iterator[Callable[[notebooks.Status], None]]:
    """Show the progress on stderr: a bar on a terminal, otherwise a line at every event and every half minute."""
    if not sys.stderr.isatty():
        yield _Lines().show
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (BarColumn(), TaskProgressColumn(), TextColumn("{task.fields[left]}"), TextColumn("{task.description}"))
    bar = Progress(*columns, console=Console(stderr=True), transient=True)
    task = bar.add_task("", total=1.0, left="")

    def show(status: notebooks.Status) -> None:
        if not bar.live.is_started:
            bar.start()
        running = f"{status.done} of {status.total} done; running {', '.join(status.running) or 'none'}"
        bar.update(task, completed=status.fraction, description=running, left=_left(status))
        if status.event and not status.event.endswith("started"):
            bar.console.print(status.event, markup=False, highlight=False)

    try:
        yield show
    finally:
        bar.stop()


class _Lines:
    """Progress as plain lines."""

    def __init__(self) -> None:
        self.shown_s = -math.inf

    def show(self, status: notebooks.Status) -> None:
        now_s = time.monotonic()
        if status.event or now_s - self.shown_s > LINE_PERIOD_S:
            event = status.event or f"running {', '.join(status.running)}"
            line = f"[{status.done}/{status.total} {status.fraction:4.0%}, {_left(status)}] {event}"
            print(line, file=sys.stderr, flush=True)
            self.shown_s = now_s


if __name__ == "__main__":
    sys.exit(main())
