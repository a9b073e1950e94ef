"""Source, target → `RegistrationResult`: the ICP family, one solver loop for every error and degree of freedom."""

from steelnb.registration.closed_form import closed_form
from steelnb.registration.clouds import register
from steelnb.registration.result import RegistrationResult
from steelnb.registration.solve import Term, align, free_directions
from steelnb.registration.target import Target, VoxelTarget, make_target, voxel_target

__all__ = [
    "RegistrationResult", "Target", "Term", "VoxelTarget", "align", "closed_form", "free_directions", "make_target",
    "register", "voxel_target",
]  # fmt: skip
