"""Networks: worked by hand, how they vary, what JSON gives back; and bodies that they describe."""

import json
import math

import numpy as np
import pytest

from laboratory import check_refused, tree
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.genotypes.cppn import (
    CPPN,
    Connection,
    CPPNSettings,
    Node,
    cross_cppns,
    draw_cppn,
    mutate_cppn,
    read_cppn,
)
from mjx_revolve.genotypes.cppn_genotype import grow
from mjx_revolve.genotypes.genotype import Space
from mjx_revolve.genotypes.kinds import find_genotype

DEFAULT = CPPNSettings()
# Many changes at a time.
LIVELY = CPPNSettings(add_node=0.6, add_link=0.6, drop_link=0.4, function=0.4, weights=0.5)
FOREIGN = CPPNSettings(add_node=0.6, add_link=0.6, innovations=False)


def edges(*ends):
    """Connections from (source, target, weight)."""
    return tuple(Connection(*end) for end in ends)


def test_a_network_worked_by_hand():
    """Outputs 2 sin(3 x - y) - y and gauss(|y|) + 5; inputs are x, y, 1."""
    network = CPPN(
        num_inputs=3,
        num_outputs=2,
        nodes=(Node(7, "abs"), Node(9, "sin"), Node(8, "gauss")),
        links=edges(
            (-1, 9, 3.0), (-2, 9, -1.0), (9, 0, 2.0), (-2, 0, -1.0), (-2, 7, 1.0), (7, 8, 1.0),
            (8, 1, 1.0), (-3, 1, 5.0),
        ),
    )  # fmt: skip
    points = [(0.0, 0.0), (0.3, -0.5), (-1.0, 2.0)]
    found = network.evaluate(np.array([(x, y, 1.0) for x, y in points]))
    assert found.shape == (3, 2)
    for (x, y), (one, two) in zip(points, found, strict=True):
        assert one == pytest.approx(2 * math.sin(3 * x - y) - y, abs=1e-15)
        assert two == pytest.approx(math.exp(-y * y) + 5, abs=1e-15)
    # What nothing leads to is 0.
    assert CPPN(1, 2, (), ()).evaluate(np.ones((4, 1))).tolist() == [[0, 0]] * 4


def family(settings, count=60, seed=4):
    """A line of descent with crossings: all networks that came up."""
    rng = np.random.default_rng(seed)
    found = [draw_cppn(rng, 4, 3, settings) for _ in range(5)]
    while len(found) < count:
        a, b = (found[int(k)] for k in rng.integers(max(0, len(found) - 12), len(found), 2))
        child = cross_cppns(rng, a, b, settings)
        found.append(mutate_cppn(rng, child, settings))
    return found


@pytest.mark.parametrize(
    "settings", [DEFAULT, LIVELY, FOREIGN], ids=["default", "lively", "foreign"]
)
def test_networks_stay_networks(settings):
    """Reading checks that links lead on, ends exist, numbers differ; values come back exactly."""
    grown = 0
    inputs = np.random.default_rng(0).normal(size=(5, 4))
    for network in family(settings):
        again = read_cppn(json.loads(json.dumps(network.to_plain())))
        assert again == network
        assert len(network.nodes) <= settings.max_nodes
        values = network.evaluate(inputs)
        assert np.isfinite(values).all() and values.shape == (5, 3)
        assert again.evaluate(inputs).tobytes() == values.tobytes()
        # Row by row as all together.
        assert [network.evaluate(row[None])[0].tolist() for row in inputs] == values.tolist()
        grown = max(grown, len(network.nodes))
    assert grown > settings.first_nodes


def test_the_same_innovation_has_the_same_number():
    """Strangers who put a node into the same link can be aligned; without numbers they cannot."""

    def split(seed, settings):
        return draw_cppn(np.random.default_rng(seed), 1, 1, settings).nodes[0].number

    assert len({split(seed, CPPNSettings(first_nodes=1)) for seed in range(5)}) == 1
    foreign = CPPNSettings(first_nodes=1, innovations=False)
    assert len({split(seed, foreign) for seed in range(5)}) == 5


A = CPPN(
    2,
    2,
    (Node(5, "sin"), Node(6, "abs")),
    edges((-1, 5, 1.0), (5, 0, 2.0), (-2, 0, 3.0), (-2, 6, 4.0), (6, 1, 5.0)),
)
B = CPPN(2, 2, (Node(5, "tanh"),), edges((-1, 5, 10.0), (5, 0, 20.0), (-1, 1, 30.0), (-2, 1, 40.0)))


def test_crossover_by_innovations():
    """Shared genes come from either parent, all others from the first."""
    rng = np.random.default_rng(0)
    children = [cross_cppns(rng, A, B, DEFAULT) for _ in range(60)]
    for child in children:
        assert [link[:2] for link in child.links] == [link[:2] for link in A.links]
        assert [node.number for node in child.nodes] == [5, 6]
        assert child.links[2:] == A.links[2:] and child.nodes[1] == A.nodes[1]
    assert {child.links[0].weight for child in children} == {1.0, 10.0}
    assert {child.links[1].weight for child in children} == {2.0, 20.0}
    assert {child.nodes[0].function for child in children} == {"sin", "tanh"}
    assert len({(child.links[0].weight, child.links[1].weight) for child in children}) == 4


def test_crossover_by_outputs():
    """Each output is that of one of the parents, for all inputs."""
    rng = np.random.default_rng(0)
    inputs = np.random.default_rng(1).normal(size=(6, 2))
    of_a, of_b = A.evaluate(inputs), B.evaluate(inputs)
    seen = set()
    for _ in range(60):
        child = cross_cppns(rng, A, B, FOREIGN)
        read_cppn(child.to_plain())
        found = child.evaluate(inputs)
        giver = ""
        for k in range(2):
            like_a, like_b = (np.array_equal(found[:, k], of[:, k]) for of in (of_a, of_b))
            assert like_a != like_b
            giver += "a" if like_a else "b"
        seen.add(giver)
    assert seen == {"aa", "ab", "ba", "bb"}
    # Where both parts are too many, it is one of the parents.
    tight = CPPNSettings(max_nodes=1, first_nodes=0, innovations=False)
    assert cross_cppns(np.random.default_rng(5), A, A, tight) is A


def test_mutation_changes_something_and_little():
    rng = np.random.default_rng(2)
    parent = draw_cppn(rng, 4, 3, DEFAULT)
    still = CPPNSettings(add_node=0, add_link=0, drop_link=0, function=0, weights=0)
    for _ in range(20):
        child = mutate_cppn(rng, parent, still)
        assert sum(a != b for a, b in zip(parent.links, child.links, strict=True)) == 1
        assert child.nodes == parent.nodes
    children = [mutate_cppn(rng, parent, DEFAULT) for _ in range(200)]
    assert all(child != parent for child in children)
    sizes = [len(child.links) - len(parent.links) for child in children]
    assert {-1, 0, 1} <= {*sizes} and abs(np.mean(sizes)) < 1


def test_a_link_that_goes_takes_dead_ends_with_it():
    chain = CPPN(
        1, 1, (Node(5, "sin"), Node(6, "abs")), edges((-1, 5, 1.0), (5, 6, 1.0), (6, 0, 1.0))
    )
    drop = CPPNSettings(add_node=0, add_link=0, drop_link=1, function=0, weights=0)
    rng = np.random.default_rng(0)
    left = {tuple(n.number for n in mutate_cppn(rng, chain, drop).nodes) for _ in range(40)}
    # Of what hangs before the gap nothing is needed; what comes behind it still leads on.
    assert left == {(5, 6), (6,), ()}


def test_settings_fit_together():
    check_refused("first_nodes: expected at most max_nodes (2); found 3", CPPNSettings, max_nodes=2)


SPACE = Space(MODULES, ("FixedBrick", "ActiveHinge"), "Core", 1, 30, 0, 20)
# Inputs by number; outputs: no module, a brick, a hinge, quarter turns.
ONE, X, Y, Z, DEPTH = -1, -2, -3, -4, -5
NONE, BRICK, HINGE, TURN = range(4)


def network(*links, nodes=()):
    return CPPN(5, 4, tuple(nodes), edges(*links))


def test_a_cross_with_a_tail():
    """Scores: no module 1.5 depth, a brick 3, a hinge 4 y - 10 |x|; turn .6 y quarters.

    At depth 1 a brick leads, but for y = 1, where a hinge does. At depth 2 no module and a brick
    are equal, and the first counts; along +y, where x is 0, a hinge leads at all depths.
    """
    body = grow(
        network(
            (DEPTH, NONE, 1.5), (ONE, BRICK, 3.0), (Y, HINGE, 4.0), (Y, TURN, 0.6),
            (X, 9, 1.0), (9, HINGE, -10.0), nodes=[Node(9, "abs")],
        ),
        SPACE,
    )  # fmt: skip
    # Rounded to whole quarters: 1, 1, 2, 2, 3, 4 = 0, ... until there are as many as there may be.
    quarters = [round(0.6 * y) % 4 for y in range(1, 21)]
    assert quarters[:6] == [1, 1, 2, 2, 3, 0]
    front = [((1,) * y, "ActiveHinge", 90.0 * q) for y, q in enumerate(quarters, 1)]
    # Behind the core, where y is -1, the turn is -1 quarter; at its sides it is 0.
    back, right, left = (((s,), "FixedBrick", turn) for s, turn in ((0, 270.0), (2, 0.0), (3, 0.0)))
    assert tree(body) == [back, *front, right, left]
    assert body.modules[1].name == "FixedBrick-0"
    assert [m.name for m in body.modules if m.slot == 1][:2] == ["ActiveHinge-1", "ActiveHinge-1-1"]


def test_what_overlaps_is_left_out_and_bounds_are_kept():
    """Bricks everywhere: the nearest places first, no two at one place, as many as there may be."""
    everywhere = network((ONE, BRICK, 1.0))
    for most in (5, 12, 30):
        space = Space(MODULES, ("FixedBrick", "ActiveHinge"), "Core", 1, most, 0, 20)
        body = grow(everywhere, space)
        assert body.num_modules == most
        depths = [len(path) for path, *_ in tree(body)]
        # The level around the core has 4 places at distance 1 and 8 at distance 2.
        assert depths.count(1) == 4
        centers = {tuple(np.round(m.position, 3)) for m in body.modules}
        assert len(centers) == most
    short = Space(MODULES, ("FixedBrick", "ActiveHinge"), "Core", 1, 30, 0, 20, max_length=0.18)
    assert grow(everywhere, short).length <= 0.18


@pytest.mark.parametrize("innovations", [True, False])
def test_both_crossovers_stay_in_the_space(innovations):
    genotype = find_genotype("cppn", SPACE, {"innovations": innovations}, "test.yaml")
    rng = np.random.default_rng(3)
    genomes = [genotype.random(rng) for _ in range(10)]
    for _ in range(60):
        a, b = (genomes[int(k)] for k in rng.integers(len(genomes), size=2))
        genomes.append(genotype.mutate(rng, genotype.cross(rng, a, b)))
        assert SPACE.refuses(genotype.develop(genomes[-1])) is None
