"""The commands for recordings; `steelnb.cli` takes them in. Nothing heavy is imported before one of them runs."""

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from steelnb.cli_options import METHODS, Seed, Sensor, examples, noise_option, one_of, output_option, overrides_of
from steelnb.cli_progress import progress

if TYPE_CHECKING:
    from steelnb.settings import ExperimentSettings, StructureSettings

app = typer.Typer()
Source = Annotated[
    Path, typer.Argument(metavar="RECORDING", help="A bag, a ROS 2 folder, or a folder of clouds or of depth images.")
]
Scans = Annotated[str | None, typer.Option(help="Topic or sub-folder of the scans.")]
Poses = Annotated[str | None, typer.Option(help="Topic or trajectory file of the poses.")]
TruthFile = Annotated[str | None, typer.Option(help="Topic or trajectory file of the truth; for judging alone.")]
Images = Annotated[str | None, typer.Option(help="Topic of a camera's images, for odometry by features.")]
SettingsFile = Annotated[
    Path | None, typer.Option(help="TOML file with the tables [extrinsics], [intrinsics] and [errors].")
]
From = Annotated[float, typer.Option("--from", metavar="SECONDS", help="Begin so long after the first scan.")]
To = Annotated[
    float, typer.Option("--to", metavar="SECONDS", help="End so long after it.", show_default="the last scan")
]
Gap = Annotated[
    float | None,
    typer.Option(
        help="Seconds between two poses beyond which there is none between them.",
        show_default="0.5, or two intervals of slower poses",
    ),
]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="MODULE.NAME=VALUE", help="E.g. preprocess.voxel_leaf_m=0.1.")
]


@app.command(
    epilog=examples(
        "steelnb run flight.mcap",
        "steelnb run flight.mcap --odometry best --odometry gicp -o compared",
        "steelnb run flight.mcap --from 10 --to 60 --noise random-walk:0.004",
        "steelnb run flight.mcap --range-max 20 --floor -2 --force",
    )
)
def run(
    recording: Source,
    odometry: Annotated[
        list[str] | None,
        one_of(METHODS, "{names}. Given several times, all are compared.", show_default="best"),
    ] = None,
    noise: Annotated[str | None, noise_option("Drift to add to the truth, or to poses taken as true")] = None,
    from_s: From = 0.0,
    to_s: To = math.inf,
    sensor: Sensor = "starling2",
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    images: Images = None,
    settings: SettingsFile = None,
    gap: Gap = None,
    seed: Seed = 1,
    range_max: Annotated[
        float | None, typer.Option(help="Metres that the sensor sees.", show_default="from the first scans")
    ] = None,
    floor: Annotated[
        float | None,
        typer.Option(
            help="Height in metres below which points are the ground.",
            show_default="the preset's, unless points lie below the world's zero",
        ),
    ] = None,
    changed: Set = None,
    smooth: Annotated[bool, typer.Option("--smooth", help="Adjust all poses and bars together at the end.")] = False,
    structure: Annotated[bool, typer.Option(help="Write structure.json: bars tied at joints.")] = True,
    viewer: Annotated[bool, typer.Option(help="Write recording.rrd, for `rerun FILE.rrd`.")] = True,
    output: Annotated[Path | None, output_option("For all files of the run.", "NAME_run here")] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the files of an earlier run.")] = False,
) -> None:
    """Take the drift out of a recorded flight.

    Trajectory, map, bars, structure, figures and tables go to a new folder; one that holds files is refused. Of several
    odometries each has a folder in it, beside comparison.csv and comparison.png.
    """
    with progress() as shown:
        from steelnb.io import read_flight, read_truth
        from steelnb.report.recording import run_recording
        from steelnb.report.recording_comparison import compare_recording
        from steelnb.report.recording_settings import Scene, recording_settings
        from steelnb.report.recording_truth import part_of
        from steelnb.settings import NoiseSettings

        overrides = overrides_of(changed) | ({"smooth": True} if smooth else {})

        def settings_for(scene: Scene | None = None) -> dict[str, "tuple[ExperimentSettings, StructureSettings]"]:
            given: dict[str, Any] = {"seed": seed, "range_max_m": range_max, "floor_m": floor, "overrides": overrides}
            return {name: recording_settings(name, sensor, scene=scene, **given) for name in odometry or ["best"]}

        settings_for()  # what is given wrongly is refused before a file is opened
        if noise is not None:
            NoiseSettings.parse(noise)
        shown.show(f"opening {recording.name}")
        topics = {"scans": scans, "poses": poses, "truth": truth, "images": images}
        flight = read_flight(recording, settings=settings, gap_max_s=gap, **topics)
        true = read_truth(recording, truth=truth, settings=settings)
        part_s = None if (from_s, to_s) == (0.0, math.inf) else (from_s, to_s)
        used = flight if part_s is None else part_of(flight, true, part_s, gap)[0]
        chosen = {
            name: (for_odometry, for_structure if structure else None)
            for name, (for_odometry, for_structure) in settings_for(Scene.of(used)).items()
        }
        options: dict[str, Any] = {
            "truth": true, "added_noise": noise, "rrd": viewer, "gap_max_s": gap, "overwrite": force,
            "part_s": part_s, "on_stage": shown.show, "on_progress": shown.share,
        }  # fmt: skip
        if len(chosen) > 1:
            lines = compare_recording(flight, output, chosen, **options).summary
        else:
            [(for_odometry, built)] = chosen.values()
            lines = run_recording(flight, output, for_odometry, structure=built, **options).summary
    print("\n".join(lines))


@app.command(epilog=examples("steelnb info flight.mcap", "steelnb info flight.mcap --quick"))
def info(
    recording: Source,
    scans: Scans = None,
    poses: Poses = None,
    truth: TruthFile = None,
    images: Images = None,
    settings: SettingsFile = None,
    gap: Gap = None,
    quick: Annotated[bool, typer.Option("--quick", help="Read the first scan alone.")] = False,
) -> None:
    """Show the content of a recording.

    Which parts of it cannot be used is told, too.
    """
    with progress() as shown:
        from steelnb.io import read_flight, read_truth
        from steelnb.report.recording_info import describe_flight

        shown.show(f"reading {recording.name}")
        topics = {"scans": scans, "poses": poses, "truth": truth, "images": images}
        flight = read_flight(recording, settings=settings, gap_max_s=gap, **topics)
        true = read_truth(recording, truth=truth, settings=settings)
        lines = describe_flight(flight, true, path=recording, quick=quick)
    print("\n".join(lines))
