"""What notebook 09 does: a recording, yours or one flown for the occasion, through an odometry to a corrected map."""

import re
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from steelnb.config import ExperimentSettings
from steelnb.datatypes import Segments
from steelnb.errors import EmptyCloudError
from steelnb.experiment import Progress
from steelnb.exports import orientation
from steelnb.figures import (
    figure_recorded_errors,
    figure_recorded_scene,
    figure_recorded_trajectories,
    figure_scan,
    figure_segments,
)
from steelnb.figures.style import Figure
from steelnb.recordings.formats import open_recording
from steelnb.replay import simulated
from steelnb.replay.describe import describe_recording
from steelnb.replay.judge import errors_m
from steelnb.replay.options import Options
from steelnb.replay.play import PlayReport, play_recording
from steelnb.replay.run import RunReport, run_recording
from steelnb.viewer.log import thinned

if TYPE_CHECKING:
    from plotly.graph_objects import Figure as PlotlyFigure

SCENE_POINTS_MAX = 30_000
TIMES = ("frame_median_ms", "frame_p95_ms", "frame_max_ms", "on_time_share")
"""Of the numbers of a run: they differ from run to run, so they are timing and not metrics."""


class Recorded:
    """A recording, and a folder for what comes of it, which goes when the notebook is closed."""

    def __init__(
        self, recording: str, settings: ExperimentSettings, options: Options, on_progress: Progress | None = None
    ) -> None:
        """Open a recording; or where its name is empty, fly by ``settings``, save that as a bag, and open the bag.

        ``options`` are those of `run` and `play`. Raises what `open_recording` and `simulated.record` raise.
        """
        self._folder = tempfile.TemporaryDirectory(prefix="steelnb-recording-")
        self.folder, self.options = Path(self._folder.name), options
        self.settings = None if recording else settings
        path = Path(recording or self.folder / "flight.bag")
        if not recording:
            simulated.record(path, settings, on_progress=lambda share, _: on_progress(share) if on_progress else None)
        self.recording = open_recording(path)

    @property
    def name(self) -> str:
        """Of the recording, without its folder."""
        return self.recording.path.name

    def facts(self) -> pd.DataFrame:
        """What the recording holds, a row a fact, as `steelnb info` says it."""
        lines = [line.replace(f"{self.recording.path.parent}/", "") for line in describe_recording(self.recording)]
        rows = [(line[:9].strip(), line[9:].strip()) for line in lines]
        return pd.DataFrame(rows, columns=["", "this recording"]).set_index("")

    def figure_scan(self, share: float = 0.5) -> Figure:
        """The first scan with a point after a ``share`` of the time, and the poses. Raises `EmptyCloudError`."""
        recording, stamp_s = self.recording, self.recording.scans.stamp_s
        for scan in recording.scans.walk(stamp_s >= stamp_s[0] + share * (stamp_s[-1] - stamp_s[0])):
            if np.isfinite(scan.points).any():
                return figure_scan(scan, recording.poses, recording.truth, self.name)
        raise EmptyCloudError(
            f"{self.name}: no scan with a point after {share:.0%} of the time; expected an earlier one"
        )

    def run(self, on_progress: Progress | None = None) -> "Corrected":
        """Correct the recording, and write all that `steelnb run` writes. Raises as `run_recording`."""
        say = on_progress or (lambda _: None)
        report = run_recording(
            self.recording,
            self.folder / "run",
            self.options,
            on_frame=lambda frame, _: say((frame.index + 1) / frame.total),
        )
        return Corrected(self, report)

    def play(self, rate: float) -> PlayReport:
        """Play it at so many times its own speed. Raises as `play_recording`."""
        return play_recording(self.recording, rate, self.options)


@dataclass(frozen=True)
class Corrected:
    """A recording after its run: pictures and tables of it."""

    source: Recorded
    report: RunReport

    @property
    def bars(self) -> Segments:
        """Those of the odometry's map, or where that is a cloud, of the structure."""
        found, built = self.report.replayed.segments, self.report.structure
        return built.segments if not len(found) and built is not None else found

    @property
    def rrd(self) -> Path:
        """The file for the viewer."""
        return self.report.folder / "recording.rrd"

    def files(self) -> pd.DataFrame:
        """What the run wrote, and how large it is."""
        files = sorted(self.report.folder.iterdir())
        return pd.DataFrame(
            {"file": [file.name for file in files], "kB": [file.stat().st_size / 1e3 for file in files]}
        )

    def figure_paths(self) -> Figure:
        """The path before and after correction, and the true one."""
        done, method = self.report.replayed, self.source.options.settings().odometry.method
        truth = self.report.course.truth
        return figure_recorded_trajectories(done.prior, done.corrected, truth, method, self.source.name)

    def figure_errors(self) -> Figure | None:
        """The distance to the truth over time; None where there is none."""
        done, truth = self.report.replayed, self.report.course.truth
        if truth is None:
            return None
        method = self.source.options.settings().odometry.method
        prior, corrected = (errors_m(path, truth) for path in (done.prior, done.corrected))
        return figure_recorded_errors(truth.stamp_s, prior, corrected, method, self.source.name)

    def figure_map(self) -> Figure:
        """The map's points and the bars."""
        points, bars = self.report.replayed.points, self.bars
        title = f"{self.source.name}: {len(points)} points of the map, {len(bars)} bars"
        return figure_segments(points, bars, orientation(bars), title)

    def scene(self) -> "PlotlyFigure":
        """All of it, to turn around."""
        done = self.report.replayed
        cloud = thinned(done.points, SCENE_POINTS_MAX)
        return figure_recorded_scene(done.prior, done.corrected, self.report.course.truth, cloud, self.bars)

    def figures(self) -> dict[str, Figure]:
        """The pictures to keep, by name."""
        named = {"errors": self.figure_errors(), "map": self.figure_map(), "trajectories": self.figure_paths()}
        return {name: figure for name, figure in named.items() if figure is not None}

    def table(self) -> pd.DataFrame:
        """The numbers of the run that are the same on every run, in one row."""
        options = self.source.options
        case = {"recording": self.source.name, "method": options.method, "added_noise": options.noise or "none"}
        return pd.DataFrame([{**case, **{n: v for n, v in self.report.numbers.items() if n not in TIMES}}])

    def metrics(self) -> dict[str, float]:
        """The same as a flat map of the finite ones."""
        numbers = {re.sub(r"\W+", "_", name): value for name, value in self.report.numbers.items() if name not in TIMES}
        return {n: float(v) for n, v in numbers.items() if not isinstance(v, str) and np.isfinite(v)}

    def timing(self, played: PlayReport) -> pd.DataFrame:
        """Milliseconds from a scan to its pose: of the odometry alone, and by the clock as it was played."""
        latency = 1e3 * played.played.latency_s
        run_ms, play_ms = (
            {"median_ms": np.median(ms), "p95_ms": np.percentile(ms, 95), "max_ms": ms.max()}
            for ms in (1e3 * self.report.replayed.seconds, latency)
        )
        run = {"stage": "run", **run_ms, "missed_share": 1 - float(self.report.numbers["on_time_share"])}
        play = {"stage": f"play at {played.rate:g} x", **play_ms, "missed_share": played.played.missed}
        return pd.DataFrame([run, play])

    def provenance(self) -> dict[str, Any]:
        """What it was run with, and what was flown where nothing was given."""
        flown = self.source.settings
        return {"recording": self.source.name, "options": asdict(self.source.options),
                "simulated": flown.model_dump() if flown else None}  # fmt: skip
