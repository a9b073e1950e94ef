"""Settings of the simulated flight. Lengths in metres, times in seconds."""

from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

from pydantic import Field, model_validator

from steelnb.core.checks import quoted
from steelnb.settings.base import Duration, Finite, NotNegative, Positive, Settings
from steelnb.settings.presets import preset_table

TrajectoryName = Literal["vertical", "orbit", "orbit-3.3", "zigzag", "loops", "planned"]
BY_WAYPOINTS: tuple[TrajectoryName, ...] = ("vertical", "orbit", "orbit-3.3")
REST_S = 3.0
"""Seconds at rest before take-off of a drone with an IMU."""
Waypoint = tuple[Finite, Finite, Positive, Finite, NotNegative]
"""x, y, z in metres, heading in degrees (0 along x, anticlockwise), and seconds from the previous waypoint."""


class FlightSettings(Settings):
    """A simulated flight.

    The report's flights ``vertical``, ``orbit`` and ``orbit-3.3`` stop at each of their ``waypoints``; replace these
    for a flight of your own. ``zigzag`` and ``loops`` derive their path from the tower and keep ``standoff_m`` from its
    faces at every height. A ``planned`` flight is steered by `steelnb.planning`: standoff, heights, levels and speed
    are targets, and its path depends on the odometry. Its ``goal`` is to climb the ``face`` in front of its start,
    level by level, or to fly a helix ``around`` the structure.

    ``still_s``: seconds at rest at the first point, without wind, before the flight; they count towards ``duration_s``,
    which is longer. With an IMU, whose readings then tell the bias of the gyroscope,
    `ExperimentSettings.preset` lets ``zigzag`` and ``loops`` begin with `REST_S`. ``gust_sigma_m_s``: standard
    deviation of the gusts along each axis."""

    lists_as = tuple

    trajectory: TrajectoryName = "zigzag"
    duration_s: Duration = 200.0
    still_s: NotNegative = 0.0
    standoff_m: Annotated[float, Field(ge=-5, le=20)] = 1.1
    height_min_m: Positive = 0.7
    height_max_m: Positive = 15.0
    levels: Annotated[int, Field(ge=2, le=100)] = 12
    speed_m_s: Positive = 0.18
    gust_sigma_m_s: NotNegative = 0.3
    goal: Literal["face", "around"] = "around"
    waypoints: tuple[Waypoint, ...] = ()

    @model_validator(mode="after")
    def _within_its_waypoints(self) -> Self:
        if (self.trajectory in BY_WAYPOINTS) != bool(self.waypoints):
            raise ValueError(
                f"trajectory {self.trajectory!r} with {len(self.waypoints)} waypoints: expected waypoints for"
                f" {quoted(BY_WAYPOINTS)} only"
            )
        seconds = [seconds for *_, seconds in self.waypoints]
        if self.waypoints and (len(seconds) < 2 or seconds[0] != 0 or min(seconds[1:]) == 0):
            raise ValueError("waypoints: expected at least two, with 0 seconds to the first and more to all others")
        if self.height_min_m > self.height_max_m:
            raise ValueError(
                f"height_min_m = {self.height_min_m:g} above height_max_m = {self.height_max_m:g}: expected it below"
            )
        if self.still_s and self.trajectory == "planned":
            raise ValueError(f"still_s = {self.still_s:g}: a pilot steers a planned flight from the start; expected 0")
        if self.duration_s <= self.still_s:
            raise ValueError(
                f"duration_s = {self.duration_s:g} with still_s = {self.still_s:g}: expected a flight after the rest"
            )
        end_s = self.still_s + sum(seconds)
        if self.waypoints and self.duration_s > end_s + 1e-9:
            raise ValueError(f"flight of {self.duration_s:g} s: its waypoints end after {end_s:g} s")
        return self

    @classmethod
    def preset(
        cls, trajectory: TrajectoryName, duration_s: float | None = None, changes: Mapping[str, Any] | None = None
    ) -> "FlightSettings":
        """A flight of ``presets/flights.toml``, by name, with some ``changes``. Default duration: the preset's, else
        the time of its last waypoint, else 200 s. Raises `InputError`."""
        values = dict(preset_table("flights", "trajectory", trajectory))
        del values["tower"]
        if duration_s is not None:
            values["duration_s"] = duration_s
        elif "waypoints" in values:
            end_s = values.get("still_s", 0.0) + sum(seconds for *_, seconds in values["waypoints"])
            values.setdefault("duration_s", end_s)
        return cls(**{"trajectory": trajectory, **values, **(changes or {})})
