"""Source, target → `RegistrationResult`: the ICP family, with one solver for all errors and degrees of freedom."""

from steelnb.registration.api import register
from steelnb.registration.as_pcl import Aligned, gicp_as_pcl, icp_as_pcl
from steelnb.registration.feature_target import FeatureTarget
from steelnb.registration.solve import FREE, AnyTarget, RegistrationResult, Term, align, prior_term
from steelnb.registration.target import Target, make_target

__all__ = [
    "FREE", "Aligned", "AnyTarget", "FeatureTarget", "RegistrationResult", "Target", "Term", "align", "gicp_as_pcl",
    "icp_as_pcl", "make_target", "prior_term", "register",
]  # fmt: skip
