"""Edits of bodies: what each one does and refuses, and random sequences of them."""

from dataclasses import replace

import numpy as np
import pytest
import yaml

from laboratory import OURS, check_refused
from mjx_revolve.body.edits import (
    add_module,
    exchange_subtrees,
    free_slots,
    graft_subtree,
    remove_module,
    replace_module,
    swap_subtrees,
    turn_module,
)
from mjx_revolve.body.morphology import Morphology, load_morphology, make_morphology
from mjx_revolve.body.placement import find_overlaps
from mjx_revolve.body.sensors import Sensor
from mjx_revolve.inputs.errors import InputError

SHIPPED = {path.stem: load_morphology(path) for path in OURS}
TYPES = ("ActiveHinge", "FixedBrick", "TouchSensor", "Fin", "Thruster", "LiftThruster")

# A body with all kinds of modules, and room for more; slots in order.
SMALL = make_morphology(
    {
        "id": "small",
        "body": {
            "id": "core",
            "type": "Core",
            "children": {
                0: {"id": "hip", "type": "ActiveHinge", "orientation": 90, "children": {
                    1: {"id": "foot", "type": "FixedBrick", "children": {
                        2: {"id": "toe", "type": "TouchSensor"}}}}},
                1: {"id": "arm", "type": "FixedBrick", "params": {"ballast": 0.01}, "children": {
                    1: {"id": "hand", "type": "Fin"}}},
                3: {"id": "jet", "type": "Thruster"},
            },
        },
        "brain": {"type": "kept"},
    }
)  # fmt: skip


def check_valid(body: Morphology) -> None:
    """What is made of the body's mapping is the body."""
    again = make_morphology(body.to_mapping())
    assert again == body
    assert again.overlaps == body.overlaps == ()
    assert len({module.name for module in body.modules}) == body.num_modules


def names(body: Morphology) -> list[str]:
    return [module.name for module in body.modules]


def test_a_module_is_added_at_its_place_in_the_order():
    body = add_module(SMALL, "core", 2, "FixedBrick", 90, {"mass": 0.02}, "fourth")
    assert names(body) == ["core", "hip", "foot", "toe", "arm", "hand", "fourth", "jet"]
    new = body.modules[6]
    assert (new.parent, new.slot, new.orientation, new.kind.mass) == (0, 2, 90.0, 0.02)
    assert body.modules[7].parent == 0 and body.brain == SMALL.brain and body.path is None
    assert remove_module(body, "fourth") == SMALL
    check_valid(body)
    # By index, numpy's numbers included; named after its type and the number of modules.
    body = add_module(SMALL, np.int64(4), np.int64(3), "ActiveHinge", np.int64(180))
    assert body.modules[6].name == "ActiveHinge7" and body.modules[6].parent == 4
    check_valid(body)


def test_free_slots_are_those_that_carry_nothing():
    assert free_slots(SMALL) == ((0, 2), (2, 1), (2, 3), (4, 2), (4, 3))
    for index, slot in free_slots(SMALL):
        assert add_module(SMALL, index, slot, "TouchSensor").num_modules == 8


def test_a_module_is_removed_with_all_that_it_carries():
    body = remove_module(SMALL, "hip")
    assert names(body) == ["core", "arm", "hand", "jet"]
    assert [m.parent for m in body.modules] == [-1, 0, 1, 0]
    check_valid(body)
    assert graft_subtree(body, "core", 0, SMALL, "hip") == SMALL
    sensed = replace(SMALL, sensors=(Sensor("gyro", at="hip"), Sensor("depth")))
    assert remove_module(sensed, "hip").sensors == sensed.sensors[1:]


def test_a_module_is_replaced_and_keeps_its_place():
    body = replace_module(SMALL, "arm", "ActiveHinge")
    assert names(body) == names(SMALL) and body.modules[4].type == "ActiveHinge"
    assert body.modules[5].position != pytest.approx(SMALL.modules[5].position)
    check_valid(body)
    assert replace_module(body, "arm", "FixedBrick", {"ballast": 0.01}) == SMALL
    spider = SHIPPED["spider"]
    red = replace_module(spider, 0, "Core", {"red": 1, "green": 0, "blue": 0, "mass": 0.1})
    assert red.modules[0].rgb == (1.0, 0.0, 0.0) and red.modules[0].kind.mass == 0.1
    assert red.modules[1:] == spider.modules[1:]
    assert replace_module(spider, 1, "ActiveHinge").modules[1].rgb == spider.modules[1].rgb


def test_children_without_a_slot_are_refused_or_dropped():
    with pytest.raises(InputError, match=r"foot.type: expected one with the slot 2 of 'toe'; foun"):
        replace_module(SMALL, "foot", "ActiveHinge")
    body = replace_module(SMALL, "foot", "ActiveHinge", drop_children=True)
    assert names(body) == ["core", "hip", "foot", "arm", "hand", "jet"]
    check_valid(body)
    bare = replace_module(SMALL, "hip", "TouchSensor", drop_children=True)
    assert names(bare) == ["core", "hip", "arm", "hand", "jet"]
    check_valid(bare)


def test_a_module_is_turned_with_all_that_it_carries():
    body = turn_module(SMALL, "hip", 180)
    assert body.modules[1].orientation == 180.0
    assert body.modules[3].rotation != pytest.approx(SMALL.modules[3].rotation)
    assert body.modules[4:] == SMALL.modules[4:]
    check_valid(body)
    assert turn_module(body, "hip", 90) == SMALL


def test_a_subtree_is_doubled_under_new_names():
    body = graft_subtree(SMALL, "core", 2, SMALL, "hip", orientation=0)
    assert names(body) == [
        "core", "hip", "foot", "toe", "arm", "hand", "hip_2", "foot_2", "toe_2", "jet"
    ]  # fmt: skip
    assert body.modules[6].orientation == 0.0
    check_valid(body)
    # Suffixes do not pile up.
    more = graft_subtree(remove_module(body, "jet"), "core", 3, body, "hip_2")
    assert names(more)[-3:] == ["hip_3", "foot_3", "toe_3"]
    check_valid(more)
    # A copy may hang from the subtree that it is a copy of.
    chain = graft_subtree(SMALL, "foot", 1, SMALL, "hip")
    assert names(chain)[:7] == ["core", "hip", "foot", "hip_2", "foot_2", "toe_2", "toe"]
    check_valid(chain)


def test_subtrees_of_one_body_are_swapped():
    body = swap_subtrees(SMALL, "arm", "hip")
    assert names(body) == ["core", "arm", "hand", "hip", "foot", "toe", "jet"]
    assert [m.slot for m in body.modules] == [-1, 0, 1, 1, 1, 2, 3]
    assert [m.parent for m in body.modules] == [-1, 0, 1, 0, 3, 4, 0]
    check_valid(body)
    assert swap_subtrees(body, "arm", "hip") == SMALL
    deep = swap_subtrees(SMALL, "toe", "arm")
    assert names(deep) == ["core", "hip", "foot", "arm", "hand", "toe", "jet"]
    assert swap_subtrees(deep, "toe", "arm") == SMALL


def test_subtrees_of_two_bodies_are_exchanged():
    spider = SHIPPED["spider"]
    a, b = exchange_subtrees(SMALL, "arm", spider, "front_hip")
    assert a.num_modules + b.num_modules == SMALL.num_modules + spider.num_modules
    assert (a.name, b.name, a.brain, b.brain) == ("small", "spider", SMALL.brain, None)
    assert names(a)[4] == "front_hip" and "arm" in names(b)
    check_valid(a), check_valid(b)
    assert exchange_subtrees(a, "front_hip", b, "arm") == (SMALL, spider)
    # A body with itself: two copies, each with the other's subtree in place of its own.
    c, d = exchange_subtrees(SMALL, "arm", SMALL, "jet")
    assert names(c) == ["core", "hip", "foot", "toe", "jet_2", "jet"]
    assert names(d) == ["core", "hip", "foot", "toe", "arm", "hand", "arm_2", "hand_2"]
    check_valid(c), check_valid(d)


# A brick on the core's side, from which a chain turns back into the core.
HOOK = make_morphology(
    {"type": "Core", "id": "core", "children": {
        1: {"type": "FixedBrick", "id": "a", "children": {
            2: {"type": "FixedBrick", "id": "b", "children": {
                3: {"type": "FixedBrick", "id": "c"}}}}}}}
)  # fmt: skip

REFUSED = {
    "taken": (
        lambda: add_module(SMALL, "core", 1, "FixedBrick"),
        "small: core: expected a free slot; found slot 1 taken by 'arm'",
    ),
    "no slots": (
        lambda: add_module(SMALL, "toe", 1, "FixedBrick"),
        "small: toe: expected none, since type TouchSensor has no slots; found 1",
    ),
    "core": (
        lambda: remove_module(SMALL, 0),
        "small: core: expected a module that is attached to another one; found the core",
    ),
    "nested": (
        lambda: swap_subtrees(SMALL, "toe", "hip"),
        "small: expected two subtrees apart from each other; found 'toe' in that of 'hip'",
    ),
    "overlap": (
        lambda: graft_subtree(HOOK, "b", 2, HOOK, "b"),
        "robot: b.children.2: expected modules that do not overlap at rest; found overlapping: "
        "core and b_2",
    ),
}


@pytest.mark.parametrize("case", REFUSED)
def test_edits_that_make_no_body_are_refused(case):
    edit, message = REFUSED[case]
    check_refused(message, edit)


def random_edit(body: Morphology, draw: np.random.Generator) -> list[Morphology]:
    """One random edit with random arguments, some of them wrong."""
    index = int(draw.integers(0, body.num_modules))
    other = int(draw.integers(0, body.num_modules))
    slots = free_slots(body)
    parent, slot = slots[draw.integers(len(slots))] if slots else (0, 0)
    kind, turn = str(draw.choice(TYPES)), int(draw.choice([0, 90, 180, 270]))
    donor = SHIPPED[str(draw.choice(sorted(SHIPPED)))]
    theirs = int(draw.integers(0, donor.num_modules))
    choices = {
        "add": lambda: add_module(body, parent, slot, kind, turn),
        "taken": lambda: add_module(body, parent, int(draw.integers(4)), kind, turn),
        "graft": lambda: graft_subtree(body, parent, slot, donor, theirs, turn),
        "double": lambda: graft_subtree(body, parent, slot, body, index),
        "remove": lambda: remove_module(body, index),
        "replace": lambda: replace_module(body, index, kind),
        "drop": lambda: replace_module(body, index, kind, drop_children=True),
        "turn": lambda: turn_module(body, index, turn),
        "swap": lambda: swap_subtrees(body, index, other),
        "exchange": lambda: exchange_subtrees(body, index, donor, theirs),
    }
    found = choices[str(draw.choice(sorted(choices)))]()
    return list(found) if isinstance(found, tuple) else [found]


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SHIPPED))
@pytest.mark.parametrize("seed", range(2))
def test_random_edits_make_valid_bodies_or_say_why_not(seed, name):
    draw = np.random.default_rng(seed)
    done = 0
    for _ in range(8):
        body = SHIPPED[name]
        for _ in range(8):
            text = repr(body.to_mapping())
            try:
                found = random_edit(body, draw)
            except InputError as error:
                assert "expected" in str(error) and "\n" not in str(error)
                continue
            finally:
                assert repr(body.to_mapping()) == text
            done += 1
            for new in found:
                check_valid(new)
                assert find_overlaps(new.modules) == ()
            body = found[0] if found[0].num_modules < 60 else body
    assert done > 15
    saved = yaml.safe_load(yaml.safe_dump(body.to_mapping(), sort_keys=False))
    assert make_morphology(saved) == body
