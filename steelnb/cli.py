"""The command line: thin commands, one line for each error, and the exit codes of `EXIT_CODES`."""

import io
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

import steelnb
from steelnb import cli_flights, cli_recordings
from steelnb.cli_options import examples, output_option
from steelnb.cli_progress import progress
from steelnb.errors import SteelnbError
from steelnb.report.words import counted

INTERRUPTED = 130
EXIT_CODES = """\b
Exit codes:
  0    done
  1    runs of a study failed
  2    bad input, told in one line; nothing was written
  130  interrupted (Ctrl-C); 128 + N by signal N
"""
STUDY_FILE, STUDY_FOLDER = Path("notebooks", "study.toml"), Path("results", "study")
REMOVED = {
    "reproduce": "notebooks are run by `make reproduce`",
    "list": "notebooks/experiments.toml lists the notebooks",
    "check": "results are compared by `make check`",
    "gallery": "pages are made by `make docs`",
    "play": "`steelnb run` prints the percentiles of the frame times and the share on time",
    "convert": "evo_traj converts trajectories, rosbags-convert bags",
    "view": "`rerun FILE.rrd` shows the recording that `steelnb run` writes",
}
"""Former commands, and where to go instead."""

# Plain help: rich's shows <bool> at every flag, and wraps examples.
app = typer.Typer(rich_markup_mode=None, pretty_exceptions_enable=False, epilog=EXIT_CODES)


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and give the exit code; errors of the user's go to stderr as one line each."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments and arguments[0] in REMOVED:
        return _complain(f"{arguments[0]}: no longer a command; {REMOVED[arguments[0]]}")
    for stream in (sys.stdout, sys.stderr):  # a terminal may not know ° or ×, and names of files may be any bytes
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    exit_on_signals()
    try:
        code = app(arguments or ["--help"], prog_name="steelnb", standalone_mode=False)
    except (SteelnbError, typer.TyperException) as fault:
        return _complain(fault.format_message() if isinstance(fault, typer.TyperException) else str(fault))
    except OSError as fault:
        if fault.filename is None:
            raise
        return _complain(f"{os.fsdecode(fault.filename)}: {fault.strerror}")
    except KeyboardInterrupt:
        code = INTERRUPTED
    if code == INTERRUPTED:  # Typer catches most itself
        return _complain("interrupted; nothing is half-written, and a study resumes where it stopped", code=INTERRUPTED)
    return int(code or 0)


def exit_on_signals() -> None:
    """Let SIGTERM and SIGHUP end the process as `SystemExit` does, so that hidden folders are removed.

    A signal that the caller ignores (nohup) stays ignored. To be called from the main thread of a command.
    """
    for name in ("SIGTERM", "SIGHUP"):  # Windows has no SIGHUP
        number = getattr(signal, name, None)
        if number is not None and signal.getsignal(number) is signal.SIG_DFL:
            signal.signal(number, lambda received, _: sys.exit(128 + received))


def _complain(message: str, code: int = 2) -> int:
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
    """Drone mapping of steel structures: recorded flights, point clouds, and studies over many seeds."""


@app.command(
    epilog=examples(
        "steelnb study my-study.toml --dry-run",
        "steelnb study my-study.toml -o my-results --workers 4",
        codes="0 done; 1 runs failed; 2 bad input; 130 interrupted: the next call goes on.",
    )
)
def study(
    path: Annotated[Path, typer.Argument(metavar="[STUDY.toml]")] = STUDY_FILE,
    workers: Annotated[int | None, typer.Option(help="Processes on this machine; default: one a core.")] = None,
    scheduler: Annotated[
        str | None, typer.Option(metavar="ADDRESS", help="A Dask cluster of yours, such as tls://HOST:8786.")
    ] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what it would take, and run nothing.")] = False,
    output: Annotated[Path, output_option("For the table.")] = STUDY_FOLDER,
) -> None:
    """Run many seeds, sensors and methods.

    Only runs that the output folder does not hold yet are run, and those that failed.

    Whoever reaches a scheduler at tcp://HOST:PORT can run code as its owner, on it and on its workers; Dask's
    documentation says how to set up tls://HOST:PORT.
    """
    with progress() as shown:
        from steelnb.report.results import machine
        from steelnb.study.cluster import forecast, run_study
        from steelnb.study.plan import by_flight, read_plan

        shown.show(f"planning {path}")
        runs = read_plan(path)
        done, core_s = forecast(runs, output)
        left = len(runs) - done
        ended = 0

        def show(row: dict[str, Any]) -> None:
            nonlocal ended
            ended += 1
            shown.show(f"running {counted(left, 'run')}", ended / left)
            if ended == left:
                shown.show("writing the tables")
            if row["status"] == "failed":
                shown.say(f"{row['method']}, seed {row['seed']}: {row['error'].splitlines()[-1]}")

        if not dry_run:
            shown.show(f"starting workers for {counted(left, 'run')}")
            described = machine() if scheduler is None else "a cluster of the user's"
            failed = run_study(runs, output, workers, scheduler, described, show)
    if dry_run:
        print(f"{counted(len(runs), 'run')} on {counted(len(by_flight(runs)), 'flight')}, {done} of them done")
        print(f"{left} to run: {counted(round(core_s / 60), 'core minute')}")
        return
    print(f"{output / 'runs.parquet'} written: {counted(len(runs), 'run')}, {left} of them run now")
    if failed:
        print(f"{counted(len(failed), 'run')} failed; the next call tries again, and tracebacks are in the table")
        raise typer.Exit(1)


@app.command(epilog=examples("steelnb segment tower.ply", "steelnb segment tower.laz --dx 0.08 -o bars"))
def segment(
    cloud: Annotated[Path, typer.Argument(help="PLY, PCD, LAS, LAZ, NPY, XYZ, TXT, CSV, PTS or ASC file.")],
    output: Annotated[Path | None, output_option("For bars, joints and a picture.", "NAME_segments here")] = None,
    voxel: Annotated[float | None, typer.Option(help="Voxel size in metres; default: from the point spacing.")] = None,
    dx: Annotated[
        float | None, typer.Option(help="Radius of a bar's tube of points in metres; default: from the point spacing.")
    ] = None,
    min_votes: Annotated[int | None, typer.Option(help="Fewest points of a line.")] = None,
    structure: Annotated[bool, typer.Option(help="Write structure.json too: bars tied at joints.")] = True,
) -> None:
    """Find the straight bars in a point cloud.

    And the joints that tie them.
    """
    with progress() as shown:
        from steelnb.report.cloud import segment_file

        shown.show(f"finding bars in {cloud.name}")
        result = segment_file(cloud, output, voxel_m=voxel, dx_m=dx, min_votes=min_votes, structure=structure)
    print("\n".join(result.summary))


for part in (cli_flights, cli_recordings):
    app.add_typer(part.app)

if __name__ == "__main__":
    sys.exit(main())
