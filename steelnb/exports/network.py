"""`Structure` → GraphML: its graph, for programs that analyse networks."""

from pathlib import Path

import networkx as nx

from steelnb.exports.members import FRAME, UNIT, Extras
from steelnb.fusion.structure import Structure


def write_graphml(structure: Structure, path: Path, extras: Extras) -> None:
    """Write `Structure.graph`: joints with ``x_m``, ``y_m``, ``z_m``; pieces of bars with ``bar``, ``length_m`` and
    what is known of the bar. A bar with fewer than two joints is not in it; the graph says how many there are."""
    full = structure.graph()
    shown = {bar for *_, bar in full.edges(data="bar")}
    graph = nx.Graph(unit=UNIT, frame=FRAME, bars=len(structure), bars_without_edge=len(structure) - len(shown))
    for joint, position in full.nodes(data="position"):
        graph.add_node(joint, **dict(zip(("x_m", "y_m", "z_m"), position, strict=True)))
    for a, b, piece in full.edges(data=True):
        bar = piece["bar"]
        sizes = {"width_m": float(structure.width_m[bar]), "sigma_m": float(structure.sigma_m[bar])}
        known = {name: value for name, value in sizes.items() if value == value}  # NaN alone differs from itself
        graph.add_edge(a, b, **piece, **known, sightings=int(structure.sightings[bar]))
    nx.write_graphml_xml(graph, path)
