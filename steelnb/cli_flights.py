"""The commands that simulate flights; `steelnb.cli` takes them in. Nothing heavy is imported before one runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from steelnb.cli_options import (
    CAMERAS,
    GOALS,
    METHODS,
    TRAJECTORIES,
    Seed,
    Sensor,
    examples,
    noise_option,
    one_of,
    overrides_of,
)
from steelnb.cli_progress import progress
from steelnb.errors import SettingsError
from steelnb.report.words import counted

if TYPE_CHECKING:
    from steelnb.settings import ExperimentSettings

DURATION_MIN_S = 1.0

app = typer.Typer()
Target = Annotated[
    Path, typer.Argument(metavar="FILE", help="FILE.bag, FILE.mcap, FILE.db3, or a new folder for ROS 2.")
]
Duration = Annotated[float, typer.Option(help="Seconds.")]
Noise = Annotated[str, noise_option("How the recorded poses drift")]
Set = Annotated[
    list[str] | None, typer.Option("--set", metavar="MODULE.NAME=VALUE", help="E.g. flight.gust_sigma_m_s=0.5.")
]
Force = Annotated[bool, typer.Option("--force", help="Overwrite FILE and its truth.")]


@app.command(
    epilog=examples(
        "steelnb record flight.mcap --duration 30",
        "steelnb record flight.bag --trajectory loops --noise random-walk+yaw-random-walk --force",
        "steelnb record seen.mcap --camera forward --set camera.rate_hz=5",
    )
)
def record(
    file: Target,
    trajectory: Annotated[str, one_of(TRAJECTORIES, "{names}.")] = "zigzag",
    duration: Duration = 60.0,
    noise: Noise = "random-walk:0.002",
    sensor: Sensor = "starling2",
    seed: Seed = 1,
    camera: Annotated[str | None, one_of(CAMERAS, "Record images, too, as of this camera: {names}.")] = None,
    changed: Set = None,
    force: Force = False,
) -> None:
    """Simulate a flight and record it.

    Sensor data and drifting poses go to FILE, the truth apart to NAME.truth.tum beside it. What exists is refused.
    """
    with progress() as shown:
        from steelnb import experiment
        from steelnb.io.bag_writer import check_target, write_flight
        from steelnb.settings import CameraSettings

        overrides = ({"camera": CameraSettings.preset(camera)} if camera else {}) | overrides_of(changed)
        # What steers a planned flight, and has no part in others.
        settings = _settings(trajectory, noise, "combined", sensor, seed, duration, overrides)
        check_target(file, True, force)
        shown.show(f"flying {duration:g} s")
        flight, truth = experiment.simulate_anew(settings, lambda share: shown.show(f"flying {duration:g} s", share))
        write_flight(file, flight, truth, lambda share: shown.show(f"writing {file.name}", share), overwrite=force)
    print(_written(file, len(flight)))


@app.command(
    epilog=examples(
        "steelnb fly around.mcap",
        "steelnb fly up.mcap --planner face --set flight.speed_m_s=0.2",
        "steelnb run around.mcap --odometry combined",
    )
)
def fly(
    file: Target,
    planner: Annotated[str, one_of(GOALS, "Where to: {names}.")] = "around",
    odometry: Annotated[str, one_of(METHODS[:-1], "Tells the planner where the drone is: {names}.")] = "combined",
    duration: Duration = 60.0,
    noise: Noise = "random-walk:0.002",
    sensor: Sensor = "starling2",
    seed: Seed = 1,
    changed: Set = None,
    force: Force = False,
) -> None:
    """Record a flight that is steered by what the drone sees.

    It is simulated. A planner decides ten times a second from the map so far and the estimated pose. FILE is for
    `steelnb run`; the truth goes apart to NAME.truth.tum beside it.
    """
    with progress() as shown:
        from steelnb import experiment
        from steelnb.closed_loop import OnboardPilot
        from steelnb.io.bag_writer import check_target, write_flight
        from steelnb.report.planned_flights import pilot_summary
        from steelnb.simulation import build_tower

        overrides = {"flight.planner.goal": planner, **overrides_of(changed)}
        settings = _settings("planned", noise, odometry, sensor, seed, duration, overrides)
        check_target(file, True, force)
        goal = f"flying, {planner}"
        shown.show(goal)
        pilot = OnboardPilot(settings, build_tower(settings.tower), lambda share: shown.show(goal, share))
        flight, truth = experiment.simulate_anew(settings, steering=pilot)
        lines = pilot_summary(pilot, flight, truth)
        write_flight(file, flight, truth, lambda share: shown.show(f"writing {file.name}", share), overwrite=force)
    print("\n".join([*lines, _written(file, len(flight))]))


def _settings(
    trajectory: Any, noise: str, method: str, sensor: str, seed: int, duration_s: float, overrides: dict[str, Any]
) -> "ExperimentSettings":
    from steelnb.settings import ExperimentSettings
    from steelnb.settings.base import DURATION_MAX_S

    if not DURATION_MIN_S <= duration_s <= DURATION_MAX_S:
        raise SettingsError(
            f"duration = {duration_s:g}: expected at least {DURATION_MIN_S:g} s and at most {DURATION_MAX_S:g} s"
        )
    return ExperimentSettings.preset(trajectory, noise, method, sensor, seed, duration_s, overrides)


def _written(file: Path, scans: int) -> str:
    from steelnb.io.bag_files import truth_path

    truth = truth_path(file)
    truth = truth.relative_to(Path.cwd()) if truth.is_relative_to(Path.cwd()) else truth
    return f"{file} written: {counted(scans, 'scan')} with drifting poses; the truth is {truth}"
