"""Source, target → `RegistrationResult`: the ICP family, with one solver for all errors and degrees of freedom."""

from steelnb.registration.api import register
from steelnb.registration.as_pcl import Aligned, gicp_as_pcl, icp_as_pcl
from steelnb.registration.feature_target import FeatureTarget
from steelnb.registration.solve import AnyTarget, RegistrationResult, Term, align, free_directions, prior_term
from steelnb.registration.target import Target, make_target

__all__ = [
    "Aligned", "AnyTarget", "FeatureTarget", "RegistrationResult", "Target", "Term", "align", "free_directions",
    "gicp_as_pcl", "icp_as_pcl", "make_target", "prior_term", "register",
]  # fmt: skip
