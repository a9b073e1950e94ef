"""Source, target → `RegistrationResult`: the ICP family, with one solver for all errors and degrees of freedom."""

from steelnb.registration.icp import register
from steelnb.registration.pcl import Aligned, gicp_as_pcl, icp_as_pcl
from steelnb.registration.solver import FREE, AlignOptions, RegistrationResult, Term, align, prior_term
from steelnb.registration.target import AnyTarget, Target, VoxelTarget, make_target

__all__ = [
    "FREE", "AlignOptions", "Aligned", "AnyTarget", "RegistrationResult", "Target", "Term",
    "VoxelTarget", "align", "gicp_as_pcl", "icp_as_pcl", "make_target", "prior_term", "register",
]  # fmt: skip
