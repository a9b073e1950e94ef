"""The commands for recordings; `steelnb.cli` takes them in. Nothing heavy is imported before one of them runs."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from steelnb.errors import SettingsError

if TYPE_CHECKING:
    from steelnb.odometry import Odometry
    from steelnb.recordings.recording import Recording
    from steelnb.replay.offline import Frame, Observer
    from steelnb.replay.options import Options

LINE_PERIOD_S = 10.0

app = typer.Typer()
Source = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A bag, a ROS 2 folder, or a folder of clouds or of depth images.")
]
Form = Annotated[
    str | None,
    typer.Option(help="ros1, mcap, sqlite, ply, pcd, las, laz, npy, tum-rgbd or 7-scenes; default: by the ending."),
]
Sensor = Annotated[str, typer.Option(help="Whose settings to take: starling2 or report.")]
Method = Annotated[
    str,
    typer.Option(help="best, combined, gicp, icp, icp-3dof, segments, ...: any method of the notebooks."),
]
Noise = Annotated[
    str | None,
    typer.Option(help="Drift to add to the truth, or to poses taken as true, such as random-walk:0.002."),
]
Seed = Annotated[int, typer.Option(help="Of the noise.")]
Scans = Annotated[str | None, typer.Option(help="Topic or sub-folder of the scans.")]
Poses = Annotated[str | None, typer.Option(help="Topic or trajectory file of the poses.")]
TruthFile = Annotated[str | None, typer.Option(help="Topic or trajectory file of the truth; for judging alone.")]
Camera = Annotated[str | None, typer.Option(help="Topic of the camera.")]
SettingsFile = Annotated[Path | None, typer.Option(help="TOML file with the tables \\[extrinsics] and \\[intrinsics].")]
Gap = Annotated[float, typer.Option(help="Seconds between two poses beyond which there is none between them.")]
RangeMax = Annotated[float | None, typer.Option(help="Metres that the sensor sees, in place of the preset's crop.")]
Floor = Annotated[float | None, typer.Option(help="Height in metres below which points are the ground.")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="ROOM.NAME=VALUE", help="E.g. preprocess.voxel_leaf_m=0.1.")
]


@app.command()
def record(
    file: Annotated[Path, typer.Argument(help="FILE.bag, FILE.mcap, FILE.db3, or a new folder.")],
    trajectory: Annotated[str, typer.Option(help="vertical or orbit.")] = "vertical",
    duration: Annotated[float, typer.Option(help="Seconds.")] = 60.0,
    noise: Annotated[str, typer.Option(help="How the recorded poses drift.")] = "random-walk:0.002",
    sensor: Annotated[str, typer.Option(help="starling2 or report.")] = "starling2",
    seed: Annotated[int, typer.Option(help="Of drift, sensor noise and gusts.")] = 1,
    form: Form = None,
    pictures: Annotated[
        bool, typer.Option("--pictures", help="Also one range image a second as a grey picture; there is no camera.")
    ] = False,
    changed: Set = None,
) -> None:
    """Simulate a flight and record it: sensor data, drifting poses, and apart, in FILE.truth.tum, the truth."""
    from steelnb.config import ExperimentSettings
    from steelnb.recordings.formats import truth_path
    from steelnb.replay import simulated

    settings = ExperimentSettings.preset(
        trajectory,  # type: ignore[arg-type]
        noise,
        sensor=sensor,  # type: ignore[arg-type]
        seed=seed,
        duration_s=duration,
        overrides=_overrides(changed),
    )
    with _progress() as show:
        recording = simulated.record(file, settings, form, pictures, show)
    scans = len(recording.scans.stamp_s)
    print(f"{file} written: {scans} scans, {len(recording.poses)} drifting poses; the truth is {truth_path(file)}")


@app.command()
def run(
    recording: Source,
    odometry: Method = "best",
    noise: Noise = None,
    sensor: Sensor = "starling2",
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    pictures: Camera = None,
    settings: SettingsFile = None,
    gap: Gap = 0.5,
    seed: Seed = 1,
    range_max: RangeMax = None,
    floor: Floor = None,
    changed: Set = None,
    structure: Annotated[bool, typer.Option(help="Write structure.json: bars tied at joints.")] = True,
    viewer: Annotated[bool, typer.Option(help="Write recording.rrd, for `steelnb view`.")] = True,
    output: Annotated[Path | None, typer.Option("-o", "--output", help="Folder; default: NAME_run here.")] = None,
) -> None:
    """Take the drift out of a recorded flight: trajectory, map, bars, structure, figures, and a table."""
    from steelnb.replay.run import run_recording

    options = _options(odometry, sensor, noise, seed, gap, range_max, floor, changed)
    opened = _opened(recording, scans, poses, truth, pictures, settings)
    with _frames() as on_frame:
        report = run_recording(opened, output, options, structure=structure, viewer=viewer, on_frame=on_frame)
    print("\n".join(report.summary))


@app.command()
def play(
    recording: Source,
    rate: Annotated[str, typer.Option(help="Times the sensor's speed; max: look for the highest.")] = "1.0",
    alone: Annotated[
        bool, typer.Option("--alone", help="Count processor time, as if nothing else ran here, and wait for nobody.")
    ] = False,
    odometry: Method = "best",
    noise: Noise = None,
    sensor: Sensor = "starling2",
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    settings: SettingsFile = None,
    gap: Gap = 0.5,
    seed: Seed = 1,
    range_max: RangeMax = None,
    floor: Floor = None,
    changed: Set = None,
) -> None:
    """Play a recording at sensor speed, as to a live node: what came late, what was dropped, what that cost."""
    from steelnb.replay.play import fastest_rate, play_recording

    try:
        number = None if rate == "max" else float(rate)
    except ValueError:
        raise SettingsError(f"--rate {rate!r}: expected a positive number, or max") from None
    options = _options(odometry, sensor, noise, seed, gap, range_max, floor, changed)
    opened = _opened(recording, scans, poses, truth, None, settings)
    say = _lines()
    if number is None:
        _, summary = fastest_rate(
            opened, options, lambda trial, played: say(f"{trial:.3g} x: {played.missed:.1%} missed", True), alone
        )
    else:
        report = play_recording(
            opened, number, options, lambda done, total: say(f"scan {done} of {total}", False), alone
        )
        summary = report.summary
    print("\n".join(summary))


@app.command()
def info(
    recording: Source,
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    pictures: Camera = None,
    settings: SettingsFile = None,
    gap: Gap = 0.5,
    quick: Annotated[bool, typer.Option("--quick", help="Read the first scan alone.")] = False,
) -> None:
    """Say what a recording holds, and what of it cannot be used."""
    from steelnb.replay.describe import describe_recording

    opened = _opened(recording, scans, poses, truth, pictures, settings)
    print("\n".join(describe_recording(opened, quick=quick, gap_max_s=gap)))


@app.command()
def view(
    path: Annotated[
        Path, typer.Argument(help="An .rrd file, a folder of `steelnb run`, a recording, a cloud, or bars (.json).")
    ],
    web: Annotated[bool, typer.Option("--web", help="In a browser on this machine; needs no display here.")] = False,
    port: Annotated[int, typer.Option(help="Of --web, on 127.0.0.1; 0: any free one.")] = 0,
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    pictures: Camera = None,
    settings: SettingsFile = None,
    gap: Gap = 0.5,
) -> None:
    """Look at a flight on its timeline, in a window or a browser, with rerun's viewer. Nothing leaves this machine."""
    from steelnb.recordings.choice import Choice
    from steelnb.replay.look import as_rrd
    from steelnb.viewer import native
    from steelnb.viewer.web import WebViewer

    if not web:
        native.need_display()
    with contextlib.ExitStack() as stack:
        with _progress() as show:
            choice = Choice(scans, poses, truth, pictures, settings)
            rrd = stack.enter_context(as_rrd(path, choice, gap, show))
        if not web:
            native.show(rrd)
            return
        server = stack.enter_context(WebViewer(rrd, port))
        print(f"{path.name} is at {server.address} until Ctrl-C", flush=True)
        with contextlib.suppress(KeyboardInterrupt):
            server.serve_forever()


@app.command()
def convert(
    source: Annotated[Path, typer.Argument(metavar="IN", help="A recording, a trajectory, or a cloud.")],
    target: Annotated[Path, typer.Argument(metavar="OUT", help="Its ending says what to write.")],
    form: Form = None,
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    pictures: Camera = None,
    settings: SettingsFile = None,
    rate_hz: Annotated[float | None, typer.Option(help="Of KITTI poses without stamps.")] = None,
) -> None:
    """Write a recording, a trajectory (.tum .kitti .csv) or a cloud (.ply .pcd .las .laz .npy) in another form."""
    from steelnb.recordings.choice import Choice
    from steelnb.replay import convert as conversion

    choice = Choice(scans, poses, truth, pictures, settings)
    with _progress() as show:
        lines = conversion.convert(source, target, form, choice, rate_hz, lambda share: show(share, "writing"))
    print("\n".join(lines))


def _opened(
    path: Path,
    scans: str | None,
    poses: str | None,
    truth: str | None,
    pictures: str | None,
    settings: Path | None,
) -> "Recording":
    from steelnb.recordings.choice import Choice
    from steelnb.recordings.formats import open_recording

    return open_recording(path, Choice(scans, poses, truth, pictures, settings))


def _options(
    method: str,
    sensor: str,
    noise: str | None,
    seed: int,
    gap_s: float,
    range_max_m: float | None,
    floor_m: float | None,
    changed: list[str] | None,
) -> "Options":
    """What the user asks for; wrong values are refused before anything is read."""
    from steelnb.replay.options import Options

    options = Options(method, sensor, noise, seed, gap_s, range_max_m, floor_m, _overrides(changed))
    options.settings(), options.structure(), options.drift
    return options


def _overrides(changed: list[str] | None) -> dict[str, Any]:
    from steelnb.project import parse_parameter

    for text in changed or []:
        if "=" not in text:
            raise SettingsError(f"--set {text}: expected ROOM.NAME=VALUE, such as preprocess.voxel_leaf_m=0.1")
    return dict(map(parse_parameter, changed or []))


@contextlib.contextmanager
def _progress() -> Iterator[Callable[[float, str], None]]:
    """Show a share and what is done on stderr: a bar on a terminal, otherwise a line every ten seconds."""
    if not sys.stderr.isatty():
        say = _lines()
        yield lambda share, what: say(f"{what}: {share:.0%}", False)
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn

    columns = (BarColumn(), TaskProgressColumn(), TextColumn("{task.description}"))
    with Progress(*columns, console=Console(stderr=True), transient=True, refresh_per_second=4) as bar:
        task = bar.add_task("", total=1.0)
        yield lambda share, what: bar.update(task, completed=share, description=what)


@contextlib.contextmanager
def _frames() -> Iterator["Observer"]:
    """Show scans per second, and the share of them on time, while a recording is run."""
    with _progress() as show:

        def on_frame(frame: "Frame", _: "Odometry") -> None:
            done, passed_s = frame.index + 1, time.perf_counter() - frame.began_s
            on_time = f"{frame.on_time / done:.1%} on time"
            show(done / frame.total, f"{done} of {frame.total} scans, {done / passed_s:.1f} a second, {on_time}")

        yield on_frame


def _lines() -> Callable[[str, bool], None]:
    """A function that says things on stderr: at once what matters, the rest every ten seconds."""
    said_s = time.monotonic()

    def say(text: str, matters: bool) -> None:
        nonlocal said_s
        if matters or time.monotonic() - said_s > LINE_PERIOD_S:
            print(text, file=sys.stderr, flush=True)
            said_s = time.monotonic()

    return say
