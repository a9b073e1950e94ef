"""Every method can be drawn, whichever a user picks."""

from steelnb import plots
from steelnb.settings import METHODS


def test_every_method_has_a_colour_and_a_name():
    assert set(METHODS) <= set(plots.METHODS) & set(plots.LABELS)
