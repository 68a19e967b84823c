"""CPPN: bodies that a network describes, worked by hand."""

import numpy as np
import pytest

from laboratory import tree
from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.genotypes.cppn import CPPN, Connection, Node
from mjx_revolve.genotypes.cppn_genotype import grow
from mjx_revolve.genotypes.genotype import Space
from mjx_revolve.genotypes.kinds import find_genotype

SPACE = Space(MODULES, ("FixedBrick", "ActiveHinge"), "Core", 1, 30, 0, 20)
# Inputs by number; outputs: no module, a brick, a hinge, quarter turns.
ONE, X, Y, Z, DEPTH = -1, -2, -3, -4, -5
NONE, BRICK, HINGE, TURN = range(4)


def network(*links, nodes=()):
    return CPPN(5, 4, tuple(nodes), tuple(Connection(*link) for link in links))


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
