import numpy as np
import pytest

from steelnb.datatypes import Segments
from steelnb.fusion import Structure


def made(start, end, joint, tie):
    n = len(start)
    segments = Segments(np.array(start, float), np.array(end, float), np.full(n, 10), np.full(n, 0.01))
    width, sigma = np.full(n, 0.08), np.full(n, 0.005)
    return Structure(segments, width, np.full(n, 3), sigma, np.array(joint, float), np.array(tie).reshape(-1, 2))


def test_the_graph_has_a_piece_of_bar_between_neighbouring_joints():
    # A post with three joints, given out of order, and a strut that meets its middle one.
    post, strut = ([0, 0, 0], [0, 0, 4]), ([0, 0, 2], [3, 0, 2])
    joint = [[0, 0, 4], [0, 0, 0], [0, 0, 2], [3, 0, 2]]
    tie = [[0, 0], [1, 0], [2, 0], [2, 1], [3, 1]]
    graph = made([post[0], strut[0]], [post[1], strut[1]], joint, tie).graph()
    assert {frozenset(edge) for edge in graph.edges} == {frozenset(e) for e in [(1, 2), (2, 0), (2, 3)]}
    assert graph.edges[2, 3] == {"bar": 1, "length_m": pytest.approx(3.0)}
    assert graph.nodes[3]["position"] == (3.0, 0.0, 2.0)


def test_a_bar_without_two_joints_gives_no_edge():
    graph = made([[0, 0, 0]], [[0, 0, 1]], [[0, 0, 0]], [[0, 0]]).graph()
    assert (graph.number_of_nodes(), graph.number_of_edges()) == (1, 0)
    assert len(Structure.empty()) == Structure.empty().graph().number_of_nodes() == 0
