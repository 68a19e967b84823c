"""Brains for bodies that change: what children get, and how it becomes genes."""

import json

import numpy as np
import pytest

from laboratory import body
from mjx_revolve.body.edits import add_module, remove_module, swap_subtrees
from mjx_revolve.control.cpg import make_cpg
from mjx_revolve.control.joint_network import make_joint_network
from mjx_revolve.control.sine import make_sine
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.robot import build_robot
from mjx_revolve.episodes.bodies_config import BrainsConfig
from mjx_revolve.evolution.brains import gene_layout, make_brain_encoding
from mjx_revolve.water.world import load_world

SNAKE = body("snake")
LAKE = load_world("lake")


def built(morphology):
    return build_robot(morphology, LAKE)


def layout_of(morphology, make=make_sine, common=None):
    plant = plant_of(built(morphology))
    own = make(plant)
    return gene_layout(own, common or own, plant)


def common(make=make_sine):
    """The controller for the largest body of these tests."""
    return make(plant_of(build_robot(SNAKE, LAKE)))


def joints(**settings):
    return make_brain_encoding(BrainsConfig(**settings), common())


def shorter():
    """The snake without its last hinge and what it carries."""
    return remove_module(SNAKE, SNAKE.hinges[-1])


def test_places_of_genes():
    layout = layout_of(SNAKE, make_cpg)
    anchors = []
    for index in SNAKE.hinges:
        module = SNAKE.modules[index]
        anchors.append(module.position + module.rotation @ np.asarray(module.kind.hinge.anchor))
    for gene, place, reach in zip(layout.genes, layout.place, layout.reach, strict=True):
        if gene.place == "hinge":
            np.testing.assert_allclose(place, anchors[gene.number], atol=1e-12)
            assert not reach.any()
        else:
            i, j = SNAKE.hinge_neighbours()[gene.number]
            np.testing.assert_allclose(place, (anchors[i] + anchors[j]) / 2, atol=1e-12)
            np.testing.assert_allclose(reach, anchors[j] - anchors[i], atol=1e-12)


@pytest.mark.parametrize(
    "make", [make_sine, make_joint_network]
)  # of the latter no gene has a place
@pytest.mark.parametrize("kind", ["joints", "cppn"])
def test_vectors_and_files_keep_all_bits(kind, make):
    brains = make_brain_encoding(BrainsConfig(type=kind), common(make))
    layout = layout_of(shorter(), make, common(make))
    brain = brains.draw(np.random.default_rng(3), layout)
    vector = brains.to_vector(brain, layout)
    assert vector.shape == (brains.size,) and vector.dtype == np.float32
    assert brains.from_vector(vector, layout) == brain
    assert brains.check(json.loads(json.dumps(brain))) == brain
    assert brains.express(vector[None], layout).shape == (1, common(make).num_genes)


@pytest.mark.parametrize("kind", ["joints", "cppn"])
def test_genes_of_joints_that_a_body_lacks_are_zero(kind):
    brains = make_brain_encoding(BrainsConfig(type=kind), common())
    layout = layout_of(shorter(), common=common())
    genes = brains.express(np.ones((2, brains.size), np.float32), layout)
    assert genes.shape == (2, common().num_genes)
    missing = np.setdiff1d(np.arange(common().num_genes), layout.columns)
    assert len(missing) == 3  # u, v and offset of one hinge
    assert not genes[:, missing].any()
    assert genes[:, layout.columns].all()


def test_a_child_with_its_parents_body_has_its_genes():
    brains, layout = joints(mutation=0.0), layout_of(SNAKE)
    parent = brains.draw(np.random.default_rng(0), layout)
    assert brains.inherit(np.random.default_rng(1), [parent], layout) == parent
    # Noise of the size asked for, on all of them.
    child = joints(mutation=0.2).inherit(np.random.default_rng(1), [parent], layout)
    noise = np.array([child[name] - parent[name] for name in layout.names])
    assert 0.1 < noise.std() < 0.3 and noise.all()


def test_a_joint_that_has_grown_does_as_the_nearest():
    brains = make_brain_encoding(BrainsConfig(mutation=0.0), common())
    small = layout_of(shorter(), common=common())
    parent = brains.draw(np.random.default_rng(0), small)
    layout = layout_of(SNAKE)
    child = brains.inherit(np.random.default_rng(1), [parent], layout)
    new = SNAKE.modules[SNAKE.hinges[-1]].name
    before = SNAKE.modules[SNAKE.hinges[-2]].name
    for name in layout.names:
        if name.endswith(f" {new}"):
            assert child[name] == parent[name.replace(new, before)]
        else:
            assert child[name] == parent[name]


def test_of_two_parents_the_first_ones_joints_come_first():
    brains = make_brain_encoding(BrainsConfig(mutation=0.0), common())
    small, large = layout_of(shorter(), common=common()), layout_of(SNAKE)
    first = dict.fromkeys(small.names, 1.0)
    second = dict.fromkeys(large.names, 2.0)
    child = brains.inherit(np.random.default_rng(0), [first, second], large)
    assert child == second | first


def test_a_pair_keeps_its_gene_when_its_joints_change_their_order():
    """The coupling of i from j is the negative of that of j from i."""
    spider = body("spider")
    legs = [module.name for module in spider.modules if module.parent == 0]
    changed = swap_subtrees(spider, legs[0], legs[2])
    before, after = (layout_of(x, make_cpg) for x in (spider, changed))
    brains = make_brain_encoding(BrainsConfig(mutation=0.0), make_cpg(plant_of(built(spider))))
    parent = {name: 1.0 + k for k, name in enumerate(before.names)}
    child = brains.inherit(np.random.default_rng(0), [parent], after)
    turned = [name for name in after.names if name not in parent]
    assert 0 < len(turned) < sum(name.startswith("c ") for name in after.names)
    for name in after.names:
        one, _, other = name.removeprefix("c ").partition("~")
        assert child[name] == (-parent[f"c {other}~{one}"] if name in turned else parent[name])
    # What the first parent has the other way round comes before what the second has as it stands.
    second = dict.fromkeys(after.names, 99.0)
    assert brains.inherit(np.random.default_rng(0), [parent, second], after) == child


def test_a_copy_does_as_its_original():
    brains = make_brain_encoding(BrainsConfig(mutation=0.0), common(make_cpg))
    bare = body("core")
    for k, name in enumerate(("fin", "knee", "toe")):
        double = bare = add_module(bare, k, min(k, 1), "ActiveHinge", name=name)
    for k, name in ((0, "fin_2"), (4, "knee_2"), (5, "toe_2")):
        double = add_module(double, k, 1 if k else 2, "ActiveHinge", name=name)
    before, layout = (layout_of(x, make_cpg, common(make_cpg)) for x in (bare, double))
    parent = {name: 1.0 + k for k, name in enumerate(before.names)}
    # A joint that had the copy's name before is another one.
    parent["w fin_2"] = 99.0
    origins = {f"{name}_2": (0, name) for name in ("fin", "knee", "toe")}
    child = brains.inherit(np.random.default_rng(0), [parent], layout, origins)
    for old, new in (("w fin", "w fin_2"), ("c knee~toe", "c knee_2~toe_2")):
        assert child[new] == child[old] == parent[old]
    other = dict.fromkeys(parent, -1.0)
    origins = {name: (1, old) for name, (_, old) in origins.items()}
    child = brains.inherit(np.random.default_rng(0), [parent, other], layout, origins)
    assert child["w fin_2"] == child["c knee_2~toe_2"] == -1
    assert child["w fin"] == parent["w fin"] and child["c knee~toe"] == parent["c knee~toe"]
    # Of several joints of a copied module each is a copy.
    two = layout._replace(names=["w two_2/a", "w two_2/b"], genes=layout.genes[:2])
    parent = {"w two/a": 1.0, "w two/b": 2.0}
    child = brains.inherit(np.random.default_rng(0), [parent], two, {"two_2": (0, "two")})
    assert list(child.values()) == [1, 2]


def test_the_network_by_hand():
    brains, layout = make_brain_encoding(BrainsConfig(type="cppn"), common()), layout_of(SNAKE)
    weights = np.zeros(brains.size, np.float32)
    hidden, inputs = 12, 7
    weights[hidden * inputs + hidden + 1] = 2.0  # output 0 ("u"), behind the hidden nodes, input x
    weights[-1] = 0.3  # the frequency
    genes = brains.express(weights, layout)
    for gene, place, value in zip(layout.genes, layout.place, genes[layout.columns], strict=True):
        if gene.what == "frequency":
            assert value == np.float32(0.3)
        elif gene.what == "u":
            np.testing.assert_allclose(value, 20 * place[0], rtol=1e-6, atol=1e-9)
        else:
            assert value == 0
    # A hidden node: the first is a sine, of y here.
    weights[:] = 0
    weights[2] = 3.0
    weights[hidden * inputs] = 1.0
    genes = brains.express(weights, layout)[layout.columns]
    for gene, place, value in zip(layout.genes, layout.place, genes, strict=True):
        expected = np.sin(30 * place[1]) if gene.what == "u" else 0.0
        np.testing.assert_allclose(value, expected, rtol=1e-5, atol=1e-7)
