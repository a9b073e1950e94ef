"""The report's Figures 3.2b, 3.3b, 3.5 and 3.6: its curves behind ours, on its own tower, flights, noise and sensor.

    PYTHONPATH=. .venv/bin/python benchmarks/report.py [--section round] [--figures 3.2 3.3]

Prints the tables of report.md and writes the pictures report-FIGURE-SECTION.png beside it. With STEELNB_CACHE set to a
folder, flights and estimates are kept between calls. The report's curves are those of notebooks/report-curves.csv.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd
import seaborn as sns

from steelnb import experiment
from steelnb.metrics import position_error_m
from steelnb.pins import machine
from steelnb.settings import ExperimentSettings, read_report_plots
from steelnb.settings.report_plots import STEP_S, ReportPlot
from steelnb.simulation import Truth
from steelnb.types import Array, Flight, Trajectory

HERE = Path(__file__).parent
CURVES = HERE.parent / "notebooks" / "report-curves.csv"
PROGRAMS = {"average": "report-segments", "icp": "report-icp", "icp-3dof": "report-icp-3dof", "gicp": "report-gicp"}
"""Method of a plot → the report's program. The method of the same name is the corrected form of that program."""
SHOULD_BE = {"average": "least_squares"}
"""Methods whose corrected form has another name."""
OURS = ("best", "faces", "smoothed")
SENSOR_HZ = 1 / (26 * STEP_S)
CURVE_COLOURS = {
    "drift, the report": "#a9d8a9", "corrected, the report": "#f2b8a0", "drift, ours": "#2a7a2a",
    "its program, ours": "#c03000", "as it should be, ours": "#0072B2",
}  # fmt: skip
"""Colours of the curves, in the order of drawing."""


def summary(error: Array) -> str:
    """Mean, largest and last error, as text."""
    return f"{error.mean():.3f} / {error.max():.3f} / {error[-1]:.3f}"


def as_reported(plot: ReportPlot, curve: str) -> tuple[Array, Array]:
    """Samples and metres of a curve as read off the report."""
    table = pd.read_csv(CURVES, dtype={"figure": str})
    of_plot = (table.figure == plot.figure) & (table.trajectory == plot.trajectory) & (table.method == plot.method)
    own = table[of_plot & (table.curve == curve)]
    return own.step.to_numpy(), own.error_m.to_numpy()


def corrected(method: str, flight: Flight, truth: Truth, plot: ReportPlot) -> Trajectory:
    """The poses of a method on a plot's flight."""
    settings = ExperimentSettings.report(plot.figure, plot.trajectory, plot.method, method)
    return experiment.estimate(settings, flight, truth).corrected


def plot_rows(plot: ReportPlot, section: str) -> Iterator[tuple[str, str, Array, Array]]:
    """For each of our curves of a plot: its kind, its row of the table, the samples and the errors."""
    settings = ExperimentSettings.report(
        plot.figure, plot.trajectory, plot.method, overrides={"tower.section": section}
    )  # fmt: skip
    flight, truth = experiment.simulate(settings)
    sample = plot.earlier_samples + np.arange(len(flight), dtype=np.float64)
    program, method = PROGRAMS[plot.method], SHOULD_BE.get(plot.method, plot.method)
    names = ("drift", program, *((plot.method,) if method != plot.method else ()), method)
    for name in names:
        found = flight.prior if name == "drift" else corrected(name, flight, truth, plot)
        error = position_error_m(found, truth.trajectory)
        at, theirs = as_reported(plot, "drift" if name == "drift" else "corrected")
        at, theirs = at[at >= plot.earlier_samples], theirs[at >= plot.earlier_samples]
        shared = np.corrcoef(np.interp(at, sample, error), theirs)[0, 1]
        kind = {"drift": "drift, ours", program: "its program, ours"}.get(name, "as it should be, ours")
        row = (
            f"| {plot.figure} {plot.trajectory}, {plot.method} | {name} | {summary(theirs)} | {summary(error)} "
            f"| {error.mean() / theirs.mean():.2f} | {error[-1] / theirs[-1]:.2f} | {shared:.3f} |"
        )
        yield kind if name in ("drift", program, method) else "", row, sample, error


def draw(table: pd.DataFrame, plots: list[ReportPlot], path: Path) -> None:
    """Draw the curves of some plots, the report's behind ours."""
    grid = sns.relplot(
        table, x="sample", y="error (m)", hue="curve", size="curve", kind="line", row="method", col="trajectory",
        hue_order=list(CURVE_COLOURS), palette=CURVE_COLOURS, size_order=list(CURVE_COLOURS), errorbar=None,
        sizes={name: 3.5 if "the report" in name else 1.0 for name in CURVE_COLOURS}, height=3, aspect=1.9,
        facet_kws={"sharex": False, "sharey": False},
    )  # fmt: skip
    for plot in plots:
        if plot.earlier_samples:
            axes = grid.axes_dict[plot.method, plot.trajectory]
            axes.axvspan(0, plot.earlier_samples, color="0.9", zorder=0)
            axes.text(5, 0.97, "an earlier run", va="top", fontsize=8, transform=axes.get_xaxis_transform())
    grid.savefig(path, dpi=90, metadata={"Software": None})


def figure(name: str, section: str) -> None:
    """Print the rows of a figure's plots and draw them."""
    plots, parts = [plot for plot in read_report_plots() if plot.figure == name], []
    for plot in plots:
        place = {"method": plot.method, "trajectory": plot.trajectory}
        for curve in ("drift", "corrected"):
            at, metres = as_reported(plot, curve)
            parts.append(pd.DataFrame({"sample": at, "error (m)": metres, "curve": f"{curve}, the report"} | place))
        for kind, row, sample, error in plot_rows(plot, section):
            print(row, flush=True)
            parts += [pd.DataFrame({"sample": sample, "error (m)": error, "curve": kind} | place)] if kind else []
    draw(pd.concat(parts, ignore_index=True), plots, HERE / f"report-{name}-{section}.png")


def ours(name: str, section: str) -> None:
    """Print the errors of our methods on the flights of a figure, with every scan of the sensor from the start."""
    for plot in (plot for plot in read_report_plots() if plot.figure == name and plot.method in ("average", "icp")):
        every = {"tof.rate_hz": SENSOR_HZ, "tof.start_s": 0.0, "tower.section": section}
        given = (plot.figure, plot.trajectory, plot.method)
        flight, truth = experiment.simulate(ExperimentSettings.report(*given, overrides=every))
        found = [corrected(method, flight, truth, plot) for method in OURS]
        errors = [position_error_m(each, truth.trajectory) for each in (flight.prior, *found)]
        told = (f"{1e3 * np.sqrt((e**2).mean()):.1f} / {1e3 * e.max():.0f}" for e in errors)
        flown = f"{plot.figure} {plot.trajectory}, {plot.noise} | {len(flight)}"
        print(f"| {flown} | {' | '.join(told)} |", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--section", choices=["angle", "round"], default="angle")
    parser.add_argument("--figures", nargs="+", default=["3.2", "3.3", "3.5", "3.6"])
    parser.add_argument("--parts", nargs="+", choices=["plots", "ours"], default=["plots", "ours"])
    asked = parser.parse_args()
    print(f"{machine()}; section {asked.section}\n")
    if "plots" in asked.parts:
        print("| plot | curve | the report | ours | mean, ours / report | end | correlation |")
        print(f"{'|---' * 7}|")
        for name in asked.figures:
            figure(name, asked.section)
    if "ours" in asked.parts:
        print(f"\n| flight | scans | drift | {' | '.join(OURS)} |\n{'|---' * (3 + len(OURS))}|")
        for name in asked.figures:
            ours(name, asked.section)


if __name__ == "__main__":
    main()
