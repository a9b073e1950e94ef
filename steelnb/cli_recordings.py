"""The commands for recordings; `steelnb.cli` takes them in. Nothing heavy is imported before one of them runs."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from steelnb.errors import SettingsError

LINE_PERIOD_S = 10.0
DURATION_MIN_S = 1.0

app = typer.Typer()
Source = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A bag, a ROS 2 folder, or a folder of clouds or of depth images.")
]
Sensor = Annotated[str, typer.Option(help="Whose settings to take: starling2 or report.")]
Seed = Annotated[int, typer.Option(help="Of drift, sensor noise and gusts.")]
Scans = Annotated[str | None, typer.Option(help="Topic or sub-folder of the scans.")]
Poses = Annotated[str | None, typer.Option(help="Topic or trajectory file of the poses.")]
TruthFile = Annotated[str | None, typer.Option(help="Topic or trajectory file of the truth; for judging alone.")]
SettingsFile = Annotated[Path | None, typer.Option(help="TOML file with the tables \\[extrinsics] and \\[intrinsics].")]
Gap = Annotated[float, typer.Option(help="Seconds between two poses beyond which there is none between them.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="MODULE.NAME=VALUE", help="E.g. preprocess.voxel_leaf_m=0.1.")
]


@app.command()
def record(
    file: Annotated[Path, typer.Argument(help="FILE.bag, FILE.mcap, FILE.db3, or a new folder for ROS 2.")],
    trajectory: Annotated[str, typer.Option(help="vertical or orbit.")] = "vertical",
    duration: Annotated[float, typer.Option(help="Seconds.")] = 60.0,
    noise: Annotated[str, typer.Option(help="How the recorded poses drift.")] = "random-walk:0.002",
    sensor: Sensor = "starling2",
    seed: Seed = 1,
    changed: Set = None,
) -> None:
    """Simulate a flight and record it: sensor data, drifting poses, and apart, in FILE.truth.tum, the truth."""
    from steelnb import experiment
    from steelnb.io.bag_files import truth_path
    from steelnb.io.bag_writer import check_target, write_flight
    from steelnb.settings import ExperimentSettings
    from steelnb.settings.base import DURATION_MAX_S

    if not DURATION_MIN_S <= duration <= DURATION_MAX_S:
        raise SettingsError(
            f"duration = {duration:g}: expected at least {DURATION_MIN_S:g} s and at most {DURATION_MAX_S:g} s"
        )
    settings = ExperimentSettings.preset(
        trajectory,  # type: ignore[arg-type]
        noise,
        sensor=sensor,  # type: ignore[arg-type]
        seed=seed,
        duration_s=duration,
        overrides=_overrides(changed),
    )
    check_target(file, True)
    with _progress() as show:
        show(0.0, f"flying {duration:g} s")
        flight, truth = experiment.simulate_anew(settings)
        write_flight(file, flight, truth, lambda share: show(share, "writing"))
    print(f"{file} written: {len(flight)} scans with drifting poses; the truth is {_short(truth_path(file))}")


@app.command()
def run(
    recording: Source,
    odometry: Annotated[
        str, typer.Option(help="best, combined, gicp, icp, icp-3dof, segments, ...: any method of the notebooks.")
    ] = "best",
    noise: Annotated[
        str | None,
        typer.Option(help="Drift to add to the truth, or to poses taken as true, such as random-walk:0.002."),
    ] = None,
    sensor: Sensor = "starling2",
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    settings: SettingsFile = None,
    gap: Gap = 0.5,
    seed: Seed = 1,
    range_max: Annotated[
        float | None, typer.Option(help="Metres that the sensor sees, in place of the preset's crop.")
    ] = None,
    floor: Annotated[float | None, typer.Option(help="Height in metres below which points are the ground.")] = None,
    changed: Set = None,
    smooth: Annotated[bool, typer.Option("--smooth", help="Adjust all poses and bars together at the end.")] = False,
    structure: Annotated[bool, typer.Option(help="Write structure.json: bars tied at joints.")] = True,
    viewer: Annotated[bool, typer.Option(help="Write recording.rrd, for `rerun FILE.rrd`.")] = True,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder; default: NAME_run here.")] = None,
) -> None:
    """Take the drift out of a recorded flight: trajectory, map, bars, structure, figures, and a table."""
    from steelnb.io import read_flight, read_truth
    from steelnb.report.recording import recording_settings, run_recording
    from steelnb.settings import NoiseSettings

    overrides = _overrides(changed) | ({"smooth": True} if smooth else {})
    chosen, structural = recording_settings(
        odometry, sensor, seed=seed, range_max_m=range_max, floor_m=floor, overrides=overrides
    )
    if noise is not None:
        NoiseSettings.parse(noise)
    flight = read_flight(recording, scans=scans, poses=poses, truth=truth, settings=settings, gap_max_s=gap)
    true = read_truth(recording, truth=truth, settings=settings)
    began_s = time.perf_counter()
    with _progress() as show:

        def on_progress(share: float) -> None:
            done, passed_s = round(share * len(flight)), time.perf_counter() - began_s
            show(share, f"{done} of {len(flight)} scans, {done / passed_s:.1f} a second")

        report = run_recording(
            flight, output, chosen, truth=true, added_noise=noise, structure=structural if structure else None,
            rrd=viewer, gap_max_s=gap, on_progress=on_progress,
        )  # fmt: skip
    print("\n".join(report.summary))


@app.command()
def info(
    recording: Source,
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    settings: SettingsFile = None,
    gap: Gap = 0.5,
    quick: Annotated[bool, typer.Option("--quick", help="Read the first scan alone.")] = False,
) -> None:
    """Show the content of a recording, and which parts of it cannot be used."""
    from steelnb.io import read_flight, read_truth
    from steelnb.report.recording_info import describe_flight

    flight = read_flight(recording, scans=scans, poses=poses, truth=truth, settings=settings, gap_max_s=gap)
    true = read_truth(recording, truth=truth, settings=settings)
    print("\n".join(describe_flight(flight, true, path=recording, quick=quick)))


def _overrides(changed: list[str] | None) -> dict[str, Any]:
    from steelnb.settings import parse_parameter

    for text in changed or []:
        if "=" not in text:
            raise SettingsError(f"--set {text}: expected MODULE.NAME=VALUE, such as preprocess.voxel_leaf_m=0.1")
    return dict(map(parse_parameter, changed or []))


def _short(path: Path) -> Path:
    return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else path


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[float, str], None]]:
    """Show a share and a text on stderr: a bar on a terminal, otherwise a line every ten seconds."""
    from tqdm import tqdm

    period_s = 0.25 if sys.stderr.isatty() else LINE_PERIOD_S
    form = "{percentage:3.0f}% |{bar}| {desc}"
    with tqdm(total=1.0, mininterval=period_s, delay=period_s, miniters=0, leave=False, bar_format=form) as bar:

        def show(share: float, text: str) -> None:
            bar.set_description_str(text, refresh=False)
            bar.update(share - bar.n)

        yield show
