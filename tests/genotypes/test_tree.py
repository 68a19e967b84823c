"""The direct tree: each mutation by itself, and the mirror image of a limb."""

from collections import Counter

import numpy as np
import pytest

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.morphology import load_morphology, make_morphology
from mjx_revolve.genotypes.genotype import Space
from mjx_revolve.genotypes.kinds import find_genotype
from mjx_revolve.inputs.errors import InputError

SPACE = Space(MODULES, ("FixedBrick", "ActiveHinge", "Fin"), "Core", 1, 12, 0, 8)
RATES = ("add", "delete", "prune", "duplicate", "mirror", "swap", "retype", "turn")
# A limb at the right: a hinge that turns about the upright, a brick, and a fin that stands.
ONE = make_morphology(
    {"id": "one", "body": {"id": "core", "type": "Core", "children": {
        1: {"id": "bow", "type": "FixedBrick"},
        2: {"id": "hip", "type": "ActiveHinge", "orientation": 90, "children": {
            1: {"id": "thigh", "type": "FixedBrick", "orientation": 180, "children": {
                2: {"id": "fin", "type": "Fin", "orientation": -90},
                1: {"id": "knee", "type": "ActiveHinge"}}}}}}}}
)  # fmt: skip


def only(name, body=ONE):
    """40 mutants of a body by one kind of mutation."""
    genotype = find_genotype("tree", SPACE, dict.fromkeys(RATES, 0) | {name: 1}, "test.yaml")
    rng = np.random.default_rng(0)
    return [genotype.mutate(rng, body) for _ in range(40)]


def types(body):
    return Counter(module.type for module in body.modules)


def names(body):
    return {module.name for module in body.modules}


def test_added_modules_are_named_after_their_place():
    mutants = only("add")
    for body in mutants:
        (new,) = names(body) - names(ONE)
        assert names(ONE) < names(body) and body.num_modules == 7
        kind, *way = new.split("-")
        module = next(m for m in body.modules if m.name == new)
        assert (kind, int(way[-1])) == (module.type, module.slot)
    found = {name for body in mutants for name in names(body)}
    assert {name for name in found if name.startswith("Fin-")} and len(found) > 15
    # In front of the knee: the core's slot 2, the hip's and thigh's slot 1, the knee's slot 1.
    assert any(name.endswith("-2-1-1-1") for name in found)


def test_leaves_are_deleted_and_subtrees_pruned():
    gone = Counter(frozenset(names(ONE) - names(body)) for body in only("delete"))
    assert {*gone} == {frozenset({"bow"}), frozenset({"fin"}), frozenset({"knee"})}
    gone = {frozenset(names(ONE) - names(body)) for body in only("prune")}
    assert {frozenset({"hip", "thigh", "fin", "knee"}), frozenset({"bow"})} <= gone
    assert len(gone) == 5


def test_subtrees_are_duplicated():
    for body in only("duplicate"):
        new = names(body) - names(ONE)
        assert names(ONE) < names(body)
        assert all(name.endswith("_2") and name[:-2] in names(ONE) for name in new)
    assert max(body.num_modules for body in only("duplicate")) == 10


def test_a_genotype_of_ones_own_may_be_this_one_and_its_copies_know_their_originals(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from mjx_revolve.genotypes.tree import make_tree\n"
        "def wrapped(space, params):\n    return make_tree(space, {}, 'mine')\n"
        "def lost(*args):\n    return wrapped(*args)._replace(settle=lambda body: (body, [1]))\n"
    )
    with pytest.raises(InputError, match="settle: expected"):
        find_genotype(f"{tmp_path}/mine.py:lost", SPACE, {}, "test.yaml")
    settle = find_genotype(f"{tmp_path}/mine.py:wrapped", SPACE, {}, "test.yaml").settle
    assert settle(only("mirror")[0])[1]


@pytest.mark.parametrize("kind", ["duplicate", "mirror"])
def test_copies_know_their_originals(kind):
    """So do copies of copies, and those in the place of a limb of the same name."""
    settle = find_genotype("tree", SPACE, {}, "test.yaml").settle
    for once in only(kind)[:5]:
        parent, _ = settle(once)
        known = {m.name: m.type for m in parent.modules}
        for body in only(kind, parent):
            kept, origins = settle(body)
            assert kept == body and settle(kept) == (kept, {})
            assert names(body) - known.keys() <= origins.keys()
            for module in body.modules:
                which, name = origins.get(module.name, (0, module.name))
                assert which == 0 and known[name] == module.type


def test_modules_change_places_types_and_turns():
    for body in only("swap"):
        assert names(body) == names(ONE) and types(body) == types(ONE)
        assert body != ONE
    for body in only("retype"):
        assert names(body) == names(ONE)
        changed = [
            (a.name, b.type)
            for a in ONE.modules
            for b in body.modules
            if a.name == b.name and a.type != b.type
        ]
        assert len(changed) == 1
    for body in only("turn"):
        before = {m.name: m.orientation % 360 for m in ONE.modules}
        turned = [m.name for m in body.modules if m.orientation != before[m.name]]
        assert len(turned) == 1 or (len(turned) == 2 and "fin" in turned)
        assert types(body) == types(ONE)


def test_a_limb_is_mirrored():
    """All centres of the copy are those of the limb with x turned round; so are the fin's plane and
    the axes of the hinges, which are lines."""
    mutants = only("mirror")
    both = [body for body in mutants if body.num_modules == 10]
    assert both
    body = both[0]
    copy = {m.name: m for m in body.modules if m.slot == 3 or m.name.endswith("_2")}
    assert {*copy} == {"hip_2", "thigh_2", "fin_2", "knee_2"}
    limb = {m.name: m for m in body.modules}
    mirror = np.diag([-1.0, 1.0, 1.0])
    for name in ("hip", "thigh", "fin", "knee"):
        one, other = limb[name], copy[f"{name}_2"]
        for (a, _), (b, _) in zip(one.boxes(main=True), other.boxes(main=True), strict=True):
            assert mirror @ a == pytest.approx(b, abs=1e-12)
        # Planes and lines are the same when their directions are, up to the sign.
        for axis in range(3):
            turned = mirror @ one.rotation[:, axis] @ other.rotation[:, axis]
            assert abs(turned) == pytest.approx(1.0)
    assert [copy[n].orientation for n in ("hip_2", "thigh_2", "fin_2")] == [270.0, 180.0, 90.0]
    assert copy["fin_2"].slot == 3 and copy["knee_2"].slot == 1


def test_crossover_exchanges_subtrees():
    """The child is the first parent, but for one subtree that comes from the second."""
    genotype = find_genotype("tree", SPACE, {}, "test.yaml")
    other = make_morphology(
        {"id": "two", "body": {"id": "core", "type": "Core", "children": {
            0: {"id": "tail", "type": "ActiveHinge", "children": {
                1: {"id": "fluke", "type": "Fin"}}}}}}
    )  # fmt: skip
    rng = np.random.default_rng(0)
    children = [genotype.cross(rng, ONE, other) for _ in range(60)]
    given = Counter(frozenset(names(body) - names(ONE)) for body in children)
    assert {*given} == {frozenset({"tail", "fluke"}), frozenset({"fluke"})}
    lost = {frozenset(names(ONE) - names(body)) for body in children}
    assert {frozenset({"bow"}), frozenset({"hip", "thigh", "fin", "knee"})} <= lost
    assert {body.name for body in children} == {"one"}
    # Modules of the second parent are known as such, also where the first has had such a name.
    for body in [*children, genotype.cross(rng, ONE, children[0])]:
        origins = genotype.settle(body)[1]
        assert {which for which, _ in origins.values()} == {1}
        assert names(body) - names(ONE) <= origins.keys()
    bare = load_morphology("core")
    assert names(genotype.cross(rng, bare, other)) & {"tail", "fluke"}
    assert genotype.cross(rng, other, bare) is other
