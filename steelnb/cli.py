"""The command line: thin commands, and one line per error. Heavy imports wait until a command runs."""

import functools
import signal
import sys
import tomllib
from pathlib import Path
from typing import Annotated, Any

import typer

import steelnb
from steelnb.core.errors import InputError
from steelnb.core.files import check_folder, display_name
from steelnb.core.terminal import call, prepare_terminal, progress, say, warn

EXIT_CODES = """\b
Exit codes:
  0    done
  1    some runs of a study failed
  2    bad input, reported in one line; nothing was written
  130  interrupted (Ctrl-C)
"""
PRESETS = Path(__file__).parent / "settings" / "presets"
METHODS, TRAJECTORIES = (
    tuple(tomllib.loads((PRESETS / f"{name}.toml").read_text(encoding="utf-8"))) for name in ("methods", "flights")
)
"""The same names as in `steelnb.settings`, which takes too long to import for a help text."""

more = functools.partial(typer.Option, rich_help_panel="More")
"""An option that few users need."""
NO_VALUE = " "
"""Metavar of flags, for which Typer would show <bool>."""
app = typer.Typer(rich_markup_mode="rich", pretty_exceptions_enable=False, epilog=EXIT_CODES)
Set = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="TABLE.NAME=VALUE", help="Change a setting, such as preprocess.voxel_leaf_m=0.1."),
]
Force = Annotated[bool, typer.Option("--force", metavar=NO_VALUE, help="Overwrite the output of an earlier run.")]


def main(arguments: list[str] | None = None) -> int:
    """Run the command line and return the exit code."""
    signal.signal(signal.SIGTERM, lambda number, _: sys.exit(128 + number))  # removes hidden folders
    return call(app, "steelnb", arguments or sys.argv[1:] or ["--help"])


def _version(is_set: bool) -> None:
    if is_set:
        say(f"steelnb {steelnb.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, metavar=NO_VALUE, help="Show the version.")
    ] = False,
) -> None:
    """Drone mapping of steel structures: recorded flights and point clouds."""


@app.command(epilog="\b\nExamples:\n  steelnb run flight.mcap\n  steelnb run flight.mcap --odometry mine:Mine -o out")
def run(
    recording: Annotated[
        Path, typer.Argument(metavar="RECORDING", help="ROS bag, ROS 2 folder, or folder of point clouds.")
    ],
    odometry: Annotated[
        str,
        typer.Option(metavar="NAME", help=f"One of {', '.join(METHODS)}, or your own MODULE:CLASS or FILE.py:CLASS."),
    ] = "best",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="Output folder. Default: NAME_run.")
    ] = None,
    estimate: Annotated[
        Path | None, typer.Option(metavar="FILE.tum", help="Poses of another program, scored with ours.")
    ] = None,
    truth: Annotated[str | None, typer.Option(help="Trajectory file of the true poses, for scores only.")] = None,
    range_m: Annotated[
        float | None,
        typer.Option("--range", "--range-max", help="Range of the sensor in metres. Default: from the first scans."),
    ] = None,
    smooth: Annotated[
        bool, typer.Option("--smooth", metavar=NO_VALUE, help="Adjust all poses and bars jointly at the end.")
    ] = False,
    changed: Set = None,
    force: Force = False,
    scans: Annotated[str | None, more(help="Topic or sub-folder of the scans.")] = None,
    poses: Annotated[str | None, more(help="Topic or trajectory file of poses, or frames: 'odom>base_link'.")] = None,
    imu: Annotated[str | None, more(help="Topic of the IMU, or none.")] = None,
    mount: Annotated[
        str | None,
        more(metavar="X,Y,Z,ROLL,PITCH,YAW", help="Pose of the sensor on the drone, in metres and degrees."),
    ] = None,
    mount_sigma: Annotated[
        str | None,
        more(metavar="DEG,M", help="Standard deviations of that pose, which --smooth then estimates, such as 1,0.01."),
    ] = None,
    clock_sigma: Annotated[
        float | None, more(metavar="SECONDS", help="Standard deviation of the delay of stamps, for --smooth.")
    ] = None,
    optical: Annotated[str | None, more(metavar="yes|no", help="Whether z is ahead in the sensor's frame.")] = None,
    world: Annotated[str | None, more(metavar="enu|ned", help="ned: poses have z down.")] = None,
    scans_in: Annotated[
        str | None, more(metavar="sensor|world", help="world: clouds of a folder are placed already.")
    ] = None,
    clock: Annotated[str | None, more(metavar="header|bag", help="bag: times of recording, not header stamps.")] = None,
    time_offset: Annotated[float | None, more(metavar="SECONDS", help="Added to the stamps of the scans.")] = None,
    columns: Annotated[
        str | None, more(metavar="t,x,y,z", help="Names of a text file's columns; _ for one to skip.")
    ] = None,
    unit: Annotated[str | None, more(metavar="mm|0.25mm|ft", help="Unit of points or depth images.")] = None,
    stamps: Annotated[
        str | None, more(metavar="us|ns|FILE|in-order", help="Stamps of a folder: their unit, a file, or by order.")
    ] = None,
    quaternion: Annotated[str | None, more(metavar="wxyz", help="Order in a trajectory without names.")] = None,
    calib: Annotated[Path | None, more(metavar="FILE", help="KITTI's calib.txt, if poses are the camera's.")] = None,
) -> None:
    """Correct the drift of a recorded flight.

    Writes corrected poses, bars, structure, a table and figures to a new or empty folder. Options on the data may stand
    in a recording.toml beside them, too.
    """
    with progress() as (on_stage, on_share):
        from steelnb.io import read_trajectory
        from steelnb.io.recordings import folder_of, open_flight
        from steelnb.odometry import load_odometry
        from steelnb.recording.evaluate import truth_of
        from steelnb.recording.run import run_recording
        from steelnb.recording.settings import Scene, recording_settings, settings_line, voxel_warning
        from steelnb.recording.summary import opened_lines
        from steelnb.settings import read_options

        own = load_odometry(odometry) if ":" in odometry else None
        stated = read_options(
            folder_of(recording), scans=scans, poses=poses, imu=imu, truth=truth,
            mount=_numbers("--mount", mount, "0.06,0,0,0,0,0"),
            optical=_flag("--optical", optical), world=world, scans_in=scans_in, clock=clock, time_offset=time_offset,
            mount_sigma=_numbers("--mount-sigma", mount_sigma, "1,0.01"), clock_sigma=clock_sigma,
            columns=columns and tuple(columns.split(",")), unit=unit, stamps=stamps, quaternion=quaternion,
            calib=calib and str(calib), range=range_m,
        )  # fmt: skip
        also = {"smooth": "--smooth"} if smooth else {}
        also |= {} if range_m is None else {"preprocess.crop_m": "--range"}
        also |= {name: "--clock-sigma" if "time" in name else "--mount-sigma" for name in stated.sigmas}
        options: dict[str, Any] = {
            "overrides": _overrides(changed, also) | ({"smooth": True} if smooth else {}) | stated.sigmas
        }
        options |= {
            "range_max_m": stated.range,
            "method": odometry if own is None else "best",  # preprocessing of `best`
        }
        recording_settings(**options)  # raises for bad options before a file is opened
        target = output or Path(f"{recording.resolve().stem}_run")
        check_folder(target, force, recording)
        other = (display_name(estimate), read_trajectory(estimate)) if estimate else None
        on_stage(f"opening {recording.name}")
        flight = open_flight(recording, stated)
        true, scene = truth_of(flight, recording, stated), Scene.of(flight)
        settings, structure = recording_settings(scene=scene, **options)
        say("\n".join((*opened_lines(flight, scene), settings_line(settings))))
        report = run_recording(flight, target, settings, structure, true, on_share, on_stage, own=own, other=other)
    say("\n".join(report.summary))
    warn(*voxel_warning(settings, scene), *report.warnings)


@app.command(epilog="\b\nExample:\n  steelnb record flight.bag --trajectory loops --noise random-walk+yaw-random-walk")
def record(
    file: Annotated[Path, typer.Argument(metavar="FILE", help="Output file, .bag or .mcap.")],
    trajectory: Annotated[
        str | None, typer.Option(metavar="NAME", help=f"One of {', '.join(TRAJECTORIES)}. Default: zigzag.")
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Duration of the flight in seconds. Default: 60.")] = None,
    noise: Annotated[
        str | None, typer.Option(help="Drift of the poses: NAME or NAME:LEVEL, or several. Default: random-walk:0.002.")
    ] = None,
    sensor: Annotated[str, typer.Option(metavar="NAME", help="Sensor preset, or FILE.toml.")] = "starling2",
    seed: Annotated[int | None, typer.Option(help="Seed of drift, sensor noise and gusts. Default: 1.")] = None,
    changed: Set = None,
    force: Force = False,
) -> None:
    """Simulate a flight and record it.

    Writes sensor data and drifting poses to FILE, and the truth to NAME.truth.tum beside it.
    """
    with progress() as (on_stage, on_share):
        from steelnb import experiment
        from steelnb.io import write_flight
        from steelnb.io.bag_writer import check_target
        from steelnb.io.recordings import truth_path
        from steelnb.settings import ExperimentSettings

        overrides = _overrides(changed)
        if duration is None and not {"flight", "flight.duration_s"} & overrides.keys():
            duration = 60.0
        options: dict[str, Any] = {"trajectory": trajectory, "noise": noise, "sensor": sensor, "seed": seed}
        settings = ExperimentSettings.preset(**options, duration_s=duration, overrides=overrides)
        idle = [name for name in overrides if ExperimentSettings.table_of(name) == "odometry"]
        if idle and trajectory != "planned":
            raise InputError(f"{idle[0]}: a setting of the odometry changes nothing in a recording; give it to `run`")
        check_target(file, force)
        on_stage("flying")
        flight, truth = experiment.simulate(settings, on_share)
        on_stage(f"writing {file.name}")
        write_flight(file, flight, truth.trajectory, on_share, overwrite=force)
    say(f"{file} written: {len(flight)} scans with drifting poses; the truth is {truth_path(file).name} beside it")


@app.command(epilog="\b\nExample:\n  steelnb segment tower.laz --dx 0.08 -o bars")
def segment(
    cloud: Annotated[Path, typer.Argument(help="PLY, PCD, LAS, LAZ, NPY, XYZ, TXT or CSV file.")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", metavar="FOLDER", help="Output folder. Default: NAME_segments.")
    ] = None,
    dx: Annotated[
        float | None,
        typer.Option(help="Radius in metres of the tube that holds a bar's points. Default: from the point spacing."),
    ] = None,
    confidence: Annotated[float | None, typer.Option(help="What a bar must gain, nats. Default: 10.")] = None,
    keep_all: Annotated[
        bool, typer.Option("--all", metavar=NO_VALUE, help="Keep lines of no structure, such as in trees, too.")
    ] = False,
    unit: Annotated[
        str | None, typer.Option(help="Unit of the coordinates, such as mm or ft. Default: metres.")
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(metavar="t,x,y,z", help="Names of columns in order, _ to skip one, if the file has none."),
    ] = None,
    scene: Annotated[
        bool, typer.Option("--scene", metavar=NO_VALUE, help="Write an interactive scene, segments.html, too.")
    ] = False,
    force: Force = False,
) -> None:
    """Find the bars of a structure in a point cloud. Ground, walls and other surfaces are left out."""
    with progress() as (on_stage, _):
        from steelnb.recording.segment import segment_file

        check_folder(target := output or Path(f"{cloud.stem}_segments"), force)
        on_stage(f"reading {cloud.name}")
        named = tuple(name.strip() for name in columns.split(",")) if columns else None
        stated: dict[str, Any] = {"unit": unit, "columns": named}
        sizes: dict[str, Any] = {"dx_m": dx, "confidence": confidence, "keep_all": keep_all}
        result = segment_file(cloud, target, **sizes, scene=scene, on_stage=on_stage, **stated)
    say("\n".join(result.summary))
    warn(*result.warnings)


@app.command()
def study(
    settings: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="Combinations of settings, one table a grid.")],
    output: Annotated[Path, typer.Option("-o", "--output", metavar="FOLDER", help="Folder of the tables.")],
    jobs: Annotated[int, typer.Option("-j", "--jobs", help="Flights at once. Default: one per core.")] = -1,
    force: Force = False,
) -> int:
    """Simulate every combination of some settings, and write one table with a row per run.

    Rows are cached in .cache/runs, so a killed study resumes. Exit code 1: some runs failed.
    """
    from joblib import parallel_config

    from steelnb.notebook.cases import read_grids
    from steelnb.notebook.results import RUNS
    from steelnb.notebook.study import check_runs, run_study, write_runs

    check_runs(output, runs := read_grids(settings), force)
    with parallel_config("loky", initializer=prepare_terminal):  # a worker has a terminal of its own
        write_runs(output, table := run_study(runs, jobs))
    failed = table[table["status"] == "failed"]
    for run in failed.itertuples():
        say(f"{run.method}, {run.trajectory}, seed {run.seed}: {run.error.splitlines()[-1]}", sys.stderr)
    say(f"{output / RUNS} written: {len(table)} runs, {len(failed)} of them failed")
    return int(len(failed) > 0)


def _numbers(option: str, text: str | None, example: str) -> tuple[float, ...] | None:
    try:
        return None if text is None else tuple(map(float, text.split(",")))
    except ValueError:
        raise InputError(f"{option} {text}: expected numbers, such as {example}") from None


def _flag(option: str, text: str | None) -> bool | None:
    if text not in (None, "yes", "no"):
        raise InputError(f"{option} {text}: expected yes or no")
    return None if text is None else text == "yes"


def _overrides(changed: list[str] | None, also: dict[str, str] | None = None) -> dict[str, Any]:
    """Settings by name, from the arguments NAME=VALUE of ``--set``. ``also``: setting → another option that sets it."""
    from steelnb.settings import parse_parameter

    found: dict[str, Any] = {}
    set_by = dict(also or {})
    for text in changed or []:
        name, equals, _ = text.partition("=")
        if not name.strip() or not equals:
            raise InputError(f"--set {text}: expected TABLE.NAME=VALUE, such as preprocess.voxel_leaf_m=0.1")
        name, value = parse_parameter(text)
        full = name.removeprefix("odometry.")
        for each in [f"{full}.{inner}" for inner in value] if isinstance(value, dict) else [full]:
            if each in set_by:
                raise InputError(f"--set {text}: {each} is given twice, also by {set_by[each]}; expected one of them")
            set_by[each] = f"--set {text}"
        found[name] = value
    return found
