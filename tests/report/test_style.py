"""The colours of figures: one for each name, told apart by the colour-blind too."""

import itertools

import numpy as np
import pytest

from steelnb.report import style
from steelnb.settings import METHODS

# Machado, Oliveira and Fernandes (2009), of linear RGB, for no and complete deficiency.
VISIONS = {
    "usual": np.eye(3),
    "deutan": [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]],
    "protan": [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
}
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
GROUPS = {
    "odometries": {name: style.COLOURS[name] for name in (*style.METHODS, "right", "wrong")},
    "detectors": {name: style.COLOURS[name] for name in (*style.DETECTORS, "right", "wrong")},
    "tower": style.KINDS,
}


def lab(colour: str, vision: str) -> np.ndarray:
    """CIELAB of a colour as someone sees it."""
    rgb = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(XYZ @ np.clip(VISIONS[vision] @ linear, 1e-3, 1) / XYZ.sum(axis=1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


@pytest.mark.parametrize("vision", VISIONS)
@pytest.mark.parametrize("group", GROUPS)
def test_colours_that_share_figures_differ_for_everyone(group, vision):
    seen = {name: lab(colour, vision) for name, colour in GROUPS[group].items()}
    close = {
        (a, b): round(float(np.linalg.norm(seen[a] - seen[b])), 1)
        for a, b in itertools.combinations(seen, 2)
        if np.linalg.norm(seen[a] - seen[b]) < 10
    }
    assert not close


def test_every_method_has_a_colour_and_a_name():
    assert set(METHODS) <= set(style.METHODS) & set(style.LABELS)
    tables = (style.VERDICTS, style.METHODS, style.DETECTORS, style.KINDS)
    assert sum(map(len, tables)) == len(set().union(*tables)), "no name has two colours"
    assert style.COLOURS.keys() >= set().union(*tables)


def test_a_legend_has_each_label_once():
    figure = style.Figure()
    for panel in figure.subplots(1, 2):
        panel.plot([0, 1], label="one")
        panel.axhspan(0, 1, label="two")
    style.gather_legend(figure)
    assert [text.get_text() for text in figure.legends[0].get_texts()] == ["one", "two"]
