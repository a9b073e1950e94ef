"""The drift of the pose prior, by name and level. Lengths in metres, angles in radians."""

import math
from dataclasses import dataclass
from typing import Any

from steelnb.core.checks import checked_number, guess, quoted, shown
from steelnb.core.errors import InputError


@dataclass(frozen=True)
class Noise:
    """Drift of the pose prior, added at every simulator step (125 Hz).

    ``random_walk_m``: standard deviation of the step per axis (the report's Algorithm 1); ``constant_drift_m``: length
    of the constant step vector (0.83 of this with the seed ``report``); ``yaw_random_walk_rad``: standard deviation of
    the heading step; ``tilt_rad``: standard deviation of the slowly varying errors of roll and pitch, not in the
    report. Angles are at most π, lengths 1 km.
    """

    random_walk_m: float = 0.0
    constant_drift_m: float = 0.0
    yaw_random_walk_rad: float = 0.0
    tilt_rad: float = 0.0

    def __post_init__(self) -> None:
        for name, level in vars(self).items():
            try:
                checked_number(level, f"Noise.{name}", 0, math.pi if name.endswith("_rad") else 1000.0)
            except InputError as fault:
                raise InputError(f"{fault} {'rad' if name.endswith('_rad') else 'm'}") from None

    @classmethod
    def parse(cls, text: str) -> "Noise":
        """Parse ``random-walk``, ``constant-drift:0.0002`` or sums such as ``random-walk+yaw-random-walk:0.001``.

        The default levels are the report's, and one degree for ``tilt``. ``none`` is no noise. Raises `InputError`.

        >>> Noise.parse("random-walk+yaw-random-walk:0.001")
        Noise(random_walk_m=0.002, constant_drift_m=0.0, yaw_random_walk_rad=0.001, tilt_rad=0.0)
        """
        if not isinstance(text, str):
            raise InputError(f"noise = {shown(text)}: expected a text such as 'random-walk:0.002'")
        values: dict[str, Any] = {}
        for part in [] if text == "none" else text.split("+"):
            name, _, level = part.strip().partition(":")
            if name not in REPORT_NOISE:
                raise InputError(
                    f"noise = {text!r}: unknown noise {name!r}{guess(name, REPORT_NOISE)}; "
                    f"expected one of {quoted(REPORT_NOISE)}"
                )
            key, default = REPORT_NOISE[name]
            if key in values:
                raise InputError(f"noise = {text!r}: {key} is given twice")
            try:
                values[key] = float(level) if level else default
            except ValueError:
                raise InputError(f"noise = {text!r}: the level {level!r} is not a number") from None
        try:
            return cls(**values)
        except InputError as fault:
            raise InputError(f"noise = {text!r}: {fault}") from None

    def check_report(self) -> None:
        """Raise `InputError` for noises that are not the report's: the seed ``report`` has no draws for them."""
        levels = {"random_walk_m": 0.002, "constant_drift_m": 0.0001, "yaw_random_walk_rad": 0.0005, "tilt_rad": 0.0}
        for name, level in levels.items():
            if getattr(self, name) not in (0.0, level):
                has = f"{level:g} or none" if level else "none"
                raise InputError(f"seed = 'report' with {name} = {getattr(self, name):g}: the report has {has}")
        if self.constant_drift_m and (self.random_walk_m or self.yaw_random_walk_rad):
            raise InputError(
                f"seed = 'report' with constant_drift_m = {self.constant_drift_m:g} and a random walk: the report has"
                " one or the other"
            )


REPORT_NOISE = {
    "random-walk": ("random_walk_m", 0.002),
    "constant-drift": ("constant_drift_m", 0.0001),
    "yaw-random-walk": ("yaw_random_walk_rad", 0.0005),
    "tilt": ("tilt_rad", math.radians(1.0)),
}
"""Name → setting, and default level (the report's, except for ``tilt``)."""


def at_level(noise: str, level: float) -> str:
    """A noise with all its levels multiplied by ``level``. Parts without a level have the report's. Raises `InputError`
    for an unknown noise."""
    Noise.parse(noise)
    if noise == "none" or level == 1:
        return noise
    parts = (part.strip().partition(":") for part in noise.split("+"))
    levels = [f"{name}:{level * float(given or REPORT_NOISE[name][1]):g}" for name, _, given in parts]
    return "+".join(text.replace("e+", "e") for text in levels)


def without(noise: str, part: str) -> str:
    """A noise without one of its parts; ``none`` if no other is left. Raises `InputError` for an unknown noise.

    >>> without("yaw-random-walk+random-walk:0.001", "yaw-random-walk")
    'random-walk:0.001'
    """
    Noise.parse(noise)
    parts = [each.strip() for each in noise.split("+")]
    return "+".join(each for each in parts if each.partition(":")[0] != part) or "none"
