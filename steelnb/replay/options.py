"""What a user asks of a replay, as the settings of its rooms."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, cast

from steelnb.config import METHODS, ExperimentSettings, MethodName, NoiseSettings, SensorName, StructureSettings
from steelnb.errors import SettingsError
from steelnb.recordings.recording import GAP_MAX_S

SHORT = {"segments": "least_squares"}
"""Names that the command line takes for a method besides its own."""


@dataclass(frozen=True)
class Options:
    """How a recording is replayed.

    ``method`` is one of `steelnb.config.METHODS`, or ``segments``; ``sensor`` names the preset of its settings.
    ``noise`` is added to the truth, or where there is none to the poses; None leaves the recorded ones.
    ``range_max_m`` and ``floor_m`` replace the preset's crop, in all directions, and its floor, in the world;
    ``overrides`` change single settings by ``room.name``.
    """

    method: str = "best"
    sensor: str = "starling2"
    noise: str | None = None
    seed: int = 1
    gap_max_s: float = GAP_MAX_S
    range_max_m: float | None = None
    floor_m: float | None = None
    overrides: Mapping[str, Any] = field(default_factory=dict)

    @property
    def drift(self) -> NoiseSettings | None:
        """The noise to add, if any. Raises `SettingsError`."""
        return None if self.noise is None else NoiseSettings.parse(self.noise)

    def settings(self) -> ExperimentSettings:
        """The settings, of which an odometry takes its part. Raises `SettingsError`."""
        if self.method not in (*METHODS, *SHORT):
            raise SettingsError(
                f"odometry = {self.method!r}: expected one of {', '.join(map(repr, (*METHODS, *SHORT)))}"
            )
        preset = ExperimentSettings.preset(
            noise=self.noise or "none",
            sensor=cast(SensorName, self.sensor),
            seed=self.seed,
            method=cast(MethodName, SHORT.get(self.method, self.method)),
        )
        crop: dict[str, Any] = {}
        if self.range_max_m is not None:
            crop = {f"{axis}_max_m": self.range_max_m for axis in "xyz"}
        if self.floor_m is not None:
            crop["floor_m"] = self.floor_m
        return preset.but(preprocess=preset.preprocess.but(**crop)).override(dict(self.overrides))

    def structure(self) -> StructureSettings:
        """The settings of the final reconstruction; drifting poses, which nobody corrected, it leaves as they are."""
        changes: dict[str, Any] = {"adjust": self.method != "none"}
        if self.range_max_m is not None:
            changes["range_max_m"] = self.range_max_m
        if self.floor_m is not None:
            changes["floor_m"] = self.floor_m
        return StructureSettings().but(**changes)
