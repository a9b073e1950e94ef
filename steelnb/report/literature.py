"""Notebook 17: matches of ORB features between images (Figure 2.1), and what LOAM takes from a scan."""

from typing import Any

import numpy as np

from steelnb import experiment
from steelnb.errors import InputError
from steelnb.images import CameraImages, GreyImage, project, unproject
from steelnb.odometry import make_odometry, run
from steelnb.odometry.features import Features, features_with_depth, match
from steelnb.points.features import loam_features
from steelnb.report.style import (
    BLUE,
    COLOURS,
    LIGHT_GREY,
    VERMILION,
    Figure,
    draw_bars,
    draw_legend,
    draw_lines,
    frame_perspective,
    project_perspective,
    style,
)
from steelnb.settings import ExperimentSettings, OdometrySettings, TrajectoryName
from steelnb.simulation import Truth
from steelnb.types import Array, Estimate, Flight, Trajectory

FLOOR_M = OdometrySettings.preset("loam").preprocess.floor_m
FEATURES = 400
RATIO, HAMMING_MAX = 0.8, 60
RIGHT_PX = 4.0
"""A match is right if the depth of its first feature and the motion of the camera put it this near."""
GAP_PX = 12


@style()
def figure_matches(
    flight: Flight, first: int, second: int, corrected: Trajectory | None = None, count: int = FEATURES
) -> Figure:
    """Matches of ORB features between the images of two scans of a flight, by their descriptors alone.

    A match is the best of all features of the other image, if it is better than the second best (Lowe's ratio test),
    and if no other feature has a better claim. Where the sensor saw the first feature's depth, ``corrected`` poses of
    the flight, by default its prior, tell right from wrong matches. Raises `InputError` for scans without an image.
    """
    (image_a, a), (image_b, b) = (seen_features(flight, scan, count) for scan in (first, second))
    found = match(
        b.pixel, b.octave, b.descriptor, b.depth, a.pixel, a.octave, np.full(len(a.pixel), np.nan), a.descriptor,
        np.inf, HAMMING_MAX, RATIO,
    )  # fmt: skip
    pairs = np.flatnonzero(found >= 0)
    poses = (corrected or flight.prior).T_world_drone[[first, second]] @ _images(flight).T_drone_camera
    apart = _apart_px(poses, _images(flight).K, a, b.pixel[found])[pairs]
    right = apart <= RIGHT_PX
    figure = Figure(figsize=(11.0, 5.0))
    panel = figure.subplots()
    shift = np.array([image_a.shape[1] + GAP_PX, 0])
    white = np.full((image_a.shape[0], GAP_PX), 255, np.uint8)
    panel.imshow(np.hstack([image_a, white, image_b]), cmap="gray", vmin=0, vmax=255, interpolation="nearest")
    panel.set_axis_off()
    lines = np.stack([a.pixel[pairs], b.pixel[found[pairs]] + shift], axis=1)
    keys = {}
    for name, chosen, colour in (
        ("depth unknown", np.isnan(apart), COLOURS["undecided"]),
        ("right", right, COLOURS["right"]),
        ("wrong", np.isfinite(apart) & ~right, COLOURS["wrong"]),
    ):
        draw_lines(panel, lines[chosen], colors=colour, linewidths=0.9, alpha=0.9)
        ends = lines[chosen].reshape(-1, 2)
        panel.plot(ends[:, 0], ends[:, 1], "o", mfc="none", mec=colour, ms=4.5, mew=1.0)
        keys[f"{name}: {np.count_nonzero(chosen)}"] = {"color": colour, "marker": "o", "mfc": "none", "lw": 1.2}
    draw_legend(figure, keys)
    times = " and ".join(f"{flight.prior.stamp_s[scan]:.1f} s" for scan in (first, second))
    panel.set_title(f"{len(pairs)} matches of {len(a.pixel)} and {len(b.pixel)} ORB features, images at {times}")
    return figure


def seen_features(flight: Flight, scan: int, count: int = FEATURES) -> tuple[GreyImage, Features]:
    """The image ``(H, W)`` of a scan, and its ORB features with depths from the scan. Raises `InputError` where
    there is none."""
    images, stamp_s = _images(flight), float(flight.prior.stamp_s[scan])
    number = images.at(stamp_s)
    image = None if number is None else images.images[number]
    if image is None:
        raise InputError(f"{flight.name}: no image at scan {scan}, {stamp_s:.2f} s; expected one at its time")
    T_camera_sensor = np.linalg.inv(images.T_drone_camera) @ flight.T_drone_sensor
    return image, features_with_depth(image, flight.scans[scan].points, T_camera_sensor, images.K, count)


def _images(flight: Flight) -> CameraImages:
    if flight.images is None:
        raise InputError(f"{flight.name}: no images; expected a flight with a camera")
    return flight.images


def _apart_px(T_world_camera: Array, K: Array, a: Features, shown: Array) -> Array:
    """Distances ``(N,)`` in pixels of the places ``shown (N, 2)`` in a second image from where the depths of the
    features of the first and both poses ``T_world_camera (2, 4, 4)`` put them; NaN without a depth."""
    T = np.linalg.inv(T_world_camera[1]) @ T_world_camera[0]
    points = (a.depth[:, None] * unproject(a.pixel, K)) @ T[:3, :3].T + T[:3, 3]
    return np.asarray(np.linalg.norm(shown - project(points, K), axis=1))


def fly(
    trajectory: TrajectoryName, noise: str, sensor: str, seed: int, duration_s: float
) -> tuple[Flight, Truth, Estimate]:
    """A flight with a camera, its truth, and what LOAM makes of it."""
    given: dict[str, Any] = {"sensor": sensor, "seed": seed, "duration_s": duration_s}
    flight, truth = experiment.simulate(ExperimentSettings.preset(trajectory, noise, "orb", **given))
    settings = ExperimentSettings.preset(trajectory, noise, "loam", **given).odometry
    return flight, truth, run(flight, make_odometry(settings, flight.T_drone_sensor))


@style()
def figure_features(flight: Flight, truth: Truth, estimate: Estimate, scan: int) -> Figure:
    """On the left what LOAM takes from one scan, over its range image; on the right its map over the tower. What lies
    below `FLOOR_M` is left out, as odometries do."""
    image = flight.scans[scan].points
    T_world_sensor = estimate.corrected.T_world_drone[scan] @ flight.T_drone_sensor
    found = loam_features(image)
    taken = {"edges": (found.point[found.plane == 0], VERMILION), "planes": (found.point[found.plane == 1], BLUE)}
    steel = _above_floor(image.reshape(-1, 3), T_world_sensor)
    figure = Figure(figsize=(8.4, 4.9))
    picture, map_panel = figure.subplots(1, 2)
    distance = np.linalg.norm(steel, axis=1)
    shown = {"c": distance, "s": 3, "cmap": "Greys_r", "vmin": 0, "vmax": 1.4 * distance.max(), "lw": 0}
    picture.scatter(*_picture(steel), rasterized=True, **shown)
    for name, (points, colour) in taken.items():
        points = _above_floor(points, T_world_sensor)
        picture.plot(*_picture(points), ".", ms=3.5, color=colour, label=f"{len(points)} {name}")
    picture.set(title="one scan", aspect="equal")
    picture.set_axis_off()
    picture.legend(loc="upper left", fontsize=9, markerscale=2.5)
    points = estimate.points
    draw_bars(map_panel, truth.tower.axes, points, color=LIGHT_GREY, linewidth=2.2)
    map_panel.plot(*project_perspective(points, points).T, ".", ms=1.6, color=COLOURS["loam"])
    frame_perspective(map_panel, points)
    map_panel.set_title(f"map of {len(points)} points")
    return figure


def _above_floor(points: Array, T_world_sensor: Array) -> Array:
    """The points ``(N, 3)`` of the sensor's frame that are finite and above the floor."""
    return points[points @ T_world_sensor[2, :3] + T_world_sensor[2, 3] >= FLOOR_M]


def _picture(points: Array) -> Array:
    """Where points ``(N, 3)`` of the sensor's frame are seen, ``(2, N)``: to the right and upwards."""
    return np.stack([-points[:, 1] / points[:, 0], points[:, 2] / points[:, 0]])
