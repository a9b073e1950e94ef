"""Settings of the simulated tower. Lengths in metres."""

import itertools
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import AfterValidator, BeforeValidator, model_validator

from steelnb.core.files import reading
from steelnb.settings.base import FrozenDict, NotNegative, Positive, Settings
from steelnb.settings.flight import TrajectoryName
from steelnb.settings.presets import NameOrPath, members_file, preset_table

Level = tuple[NotNegative, Positive]
Kind = Literal["leg", "ring", "bracing", "arm", "secondary"]
"""Kind of a member. ``secondary``: redundant members, webs of the arms, railings."""
SectionSizes = dict[Kind, tuple[Positive, Positive]]
USUAL_SECTIONS: SectionSizes = FrozenDict({
    "leg": (0.120, 0.010), "ring": (0.070, 0.006), "bracing": (0.070, 0.006), "arm": (0.060, 0.005),
    "secondary": (0.040, 0.004),
})  # fmt: skip


def _with_usual(given: Any) -> Any:
    return USUAL_SECTIONS | given if isinstance(given, dict) else given


class TowerSettings(Settings):
    """A steel lattice tower: built from a list of ``members``, or without a list a tapered one of the given dimensions.

    ``members``: name of a CSV file of ``steelnb/settings/presets``, such as ``report-tower``, or ``FILE.csv``
    (`steelnb.simulation.member_list`). ``section``: angles, or round rods with the flange's width as diameter.
    ``mesh``: an STL or PLY file of triangles, metres, world frame, which scans see and the drone touches in place of
    the list's members and plates; the list stays the truth.
    ``profile_m``: height and width of the body on the ground, at its waist and at its top; ``arms_m``: height and reach
    of each arm; ``sections_m``: width and thickness of the flanges for each kind of member; those that are not given
    are `USUAL_SECTIONS`. The ground is a square plate at z = 0.
    """

    lists_as = tuple

    members: NameOrPath | None = None
    mesh: NameOrPath | None = None
    section: Literal["angle", "round"] = "angle"
    profile_m: tuple[Level, Level, Level] = ((0.0, 4.0), (9.0, 1.7), (16.0, 1.0))
    arms_m: tuple[tuple[Positive, Positive], ...] = ((10.2, 3.2), (12.4, 3.8), (14.6, 2.8))
    arm_depth_m: ClassVar[float] = 0.7
    sections_m: Annotated[SectionSizes, BeforeValidator(_with_usual), AfterValidator(FrozenDict)] = USUAL_SECTIONS

    @model_validator(mode="after")
    def _fits(self) -> Self:
        fields = type(self).model_fields
        if self.mesh is not None and self.members is None:
            raise ValueError(f"mesh = {self.mesh!r}: expected members too, the list of the bars in it")
        for name in ("profile_m", "arms_m") if self.members is not None else ():
            if getattr(self, name) != fields[name].default:
                raise ValueError(
                    f"{name} = {getattr(self, name)} with members = {self.members!r}: expected only one of them"
                )
        for kind, (width_m, thickness_m) in self.sections_m.items():
            if self.section == "angle" and not thickness_m <= width_m:
                raise ValueError(
                    f"sections_m.{kind} = {(width_m, thickness_m)}: expected a flange at least as wide as it is thick"
                )
        (ground_m, _), (waist_m, _), (top_m, _) = self.profile_m
        leg_m = self.sections_m["leg"][0]
        if self.members is None and not min(width_m for _, width_m in self.profile_m) > leg_m:
            raise ValueError(f"profile_m = {self.profile_m}: expected widths above that of a leg, {leg_m:g} m")
        if not 0.0 == ground_m < waist_m < top_m:
            raise ValueError(f"profile_m = {self.profile_m}: expected heights that rise from 0")
        height_m = [height for height, _ in self.arms_m]
        if any(low + self.arm_depth_m > high for low, high in itertools.pairwise(height_m)):
            raise ValueError(f"arms_m: expected arms at least {self.arm_depth_m:g} m apart")
        if height_m and not waist_m < min(height_m) <= max(height_m) <= top_m - self.arm_depth_m:
            raise ValueError("arms_m: expected arms between the waist and the top")
        return self

    @property
    def floor_half_m(self) -> float:
        """Half the side of the ground: the report's plate for a list of members, else practically unlimited."""
        return 60.0 if self.members is None else 3.0

    def file_bytes(self) -> bytes:
        """The bytes of the list of members and of the mesh, by which two versions of a file are told apart; none
        without them. Raises `InputError`."""
        files = [(members_file(self.members), "a list of members")] if self.members else []
        files += [(Path(self.mesh), "a mesh")] if self.mesh else []
        data = b""
        for path, form in files:
            with reading(path, form):
                data += path.read_bytes()
        return data

    @classmethod
    def preset(cls, tower: str = "tapered") -> "TowerSettings":
        """A tower of ``presets/towers.toml``, by name. Raises `InputError`."""
        return cls(**preset_table("towers", "tower", tower))

    @classmethod
    def of_flight(cls, trajectory: TrajectoryName) -> "TowerSettings":
        """The tower of a flight of ``presets/flights.toml``. Raises `InputError`."""
        return cls.preset(preset_table("flights", "trajectory", trajectory)["tower"])
