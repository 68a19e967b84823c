"""Plasticoding: the L-system worked by hand, step by step."""

from dataclasses import replace

import numpy as np
import pytest

from laboratory import tree
from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.body.sensors import Sensor
from mjx_revolve.genotypes.genotype import Space
from mjx_revolve.genotypes.kinds import find_genotype
from mjx_revolve.genotypes.plasticoding import Grammar, draw_sentence, expand, make_alphabet
from mjx_revolve.inputs.errors import InputError

ALL = ("FixedBrick", "ActiveHinge", "TouchSensor", "Fin", "Thruster", "LiftThruster")
SPACE = Space(MODULES, ALL, "Core", 1, 20, 0, 10)
LETTERS = make_alphabet(SPACE)


def draw(sentence, space=SPACE, seed=None):
    return draw_sentence(sentence.split(), make_alphabet(space), space, seed=seed)


RULES = {"C": ("C", "addf", "AJ1", "moveb"), "AJ1": ("AJ1", "addf", "B"), "B": ("addl", "ST", "B")}


def test_each_letter_stands_for_one_thing():
    brick = replace(MODULES["FixedBrick"], name="B")
    with pytest.raises(InputError, match="found 'B' of B, which stands for something else"):
        make_alphabet(replace(SPACE, catalogue=MODULES | {"B": brick}, modules=("FixedBrick", "B")))


def test_a_sentence_grows_by_its_rules():
    """Every letter that has a rule gives way to it, all at a time."""
    sentences = [" ".join(expand(RULES, iterations)) for iterations in range(4)]
    assert sentences == [
        "C",
        "C addf AJ1 moveb",
        "C addf AJ1 moveb addf AJ1 addf B moveb",
        "C addf AJ1 moveb addf AJ1 addf B moveb addf AJ1 addf B addf addl ST B moveb",
    ]


def test_it_is_drawn_step_by_step():
    """The third sentence above.

    A joint in front of the core, and back to it. There is a joint at its front already, so nothing
    is added, and `addf` still waits: it mounts nothing at the core, whose front is taken. Back is
    nowhere. So goes the rest: all that is said is said of the core, until `addl ST` puts a sensor
    at its left and uses the side up, so that B has none.
    """
    expected = [((1,), "ActiveHinge", 0.0), ((3,), "TouchSensor", 0.0)]
    assert tree(draw(" ".join(expand(RULES, 3)))) == expected
    genotype = find_genotype("plasticoding", SPACE, {}, "test.yaml")
    rules = dict.fromkeys(LETTERS, ()) | RULES
    body = genotype.develop(Grammar("hand", rules))
    assert tree(body) == expected and body.name == "hand"
    assert [m.name for m in body.modules] == ["core", "ActiveHinge-1", "TouchSensor-3"]


def test_modules_are_mounted_and_moved_on_to():
    # A letter without a side means nothing, and a side is used up by what is mounted there.
    assert tree(draw("C B AJ1")) == []
    assert tree(draw("C addf B B")) == [((1,), "FixedBrick", 0.0)]
    # After mounting, the turtle is on the new module: right, front and left of it.
    assert [path for path, *_ in tree(draw("C addr B addr B moveb addf B moveb addl B"))] == [
        (2,), (2, 1), (2, 2), (2, 3)
    ]  # fmt: skip
    # A joint has one slot, whatever the side; sensors, fins and thrusters carry nothing.
    assert [path for path, *_ in tree(draw("C addl AJ1 addr B"))] == [(3,), (3, 1)]
    assert [path for path, *_ in tree(draw("C addl ST addr F addf T"))] == [(1,), (2,), (3,)]


def test_what_overlaps_or_exceeds_is_left_out():
    # Three turns to the right lead back into the core.
    body = draw("C addf B addr B addr B addr B")
    assert [path for path, *_ in tree(body)] == [(1,), (1, 2)]
    row = "C" + " addf AJ1" * 30
    for most in (1, 5, 10):
        space = Space(MODULES, ALL, "Core", 1, 20, 0, most)
        assert draw(row, space).num_hinges == most
    assert draw("C" + " addf B" * 30).num_modules == 20
    # The side waits for a module that there is room for.
    space = Space(MODULES, ALL, "Core", 1, 20, 0, 1)
    assert [kind for _, kind, _ in tree(draw("C addf AJ1 addf AJ1 B", space))] == [
        "ActiveHinge", "FixedBrick"
    ]  # fmt: skip


def test_letters_are_revolves_where_it_has_them(tmp_path):
    assert [*LETTERS] == ["B", "BV", "AJ1", "AJ2", "ST", "F", "FV", "T", "LT", "LTV"]
    assert [*make_alphabet(SPACE, upright=False)] == ["B", "AJ1", "AJ2", "ST", "F", "T", "LT"]
    assert {name for name, letter in LETTERS.items() if letter.upright} == {
        "BV", "AJ2", "FV", "LTV"
    }  # fmt: skip
    own = """
modules:
  Knee:
    mount: -x
    hinge: {axis: [0, 1, 0], anchor: [0, 0, 0]}
    parts: [{size: [.02, .02, .02], mass: .01}, {size: [.02, .02, .02], mass: .01}]
    slots: {1: +x}
  Tee:
    mount: -x
    parts: [{size: [.02, .02, .02], mass: .01}]
    slots: {1: +x, 5: +y, 7: -y}
"""
    (tmp_path / "own.yaml").write_text(own)
    catalogue = MODULES | load_modules(tmp_path / "own.yaml")
    space = Space(catalogue, ("Knee", "Tee"), "Core", 1, 20, 0, 10)
    assert [*make_alphabet(space)] == ["Knee1", "Knee2", "Tee", "TeeV"]
    # Sides that it does not have are no slots; the others come when its front is taken.
    body = draw("C addf Tee addl Tee addf Tee moveb addl Tee moveb addr Tee", space)
    assert [path for path, *_ in tree(body)] == [(1,), (1, 1), (1, 5), (1, 7)]


def test_random_rules_are_groups_of_three():
    genotype = find_genotype("plasticoding", SPACE, {"groups": 4}, "test.yaml")
    rng = np.random.default_rng(0)
    counts = set()
    for _ in range(40):
        rules = genotype.random(rng).rules
        assert [*rules] == ["C", *LETTERS] and rules["C"][0] == "C"
        groups = {len(rule) // 3 for rule in rules.values()}
        counts |= groups
        assert len(groups) == 1
        for rule in rules.values():
            rest = rule[len(rule) % 3 :]
            for mounting, module, moving in zip(rest[::3], rest[1::3], rest[2::3], strict=True):
                assert mounting in ("addr", "addf", "addl") and module in LETTERS
                assert moving in ("mover", "movef", "movel", "moveb")
    assert counts == {1, 2, 3, 4}


def test_a_mutation_is_one_letter():
    rng = np.random.default_rng(0)
    lengths = set()
    for name in ("add", "delete", "swap"):
        params = dict.fromkeys(("add", "delete", "swap"), 0) | {name: 1}
        genotype = find_genotype("plasticoding", SPACE, params, "test.yaml")
        for _ in range(30):
            parent = genotype.random(rng)
            child = genotype.mutate(rng, parent)
            changed = [k for k in parent.rules if parent.rules[k] != child.rules[k]]
            assert len(changed) == 1
            before, after = parent.rules[changed[0]], child.rules[changed[0]]
            assert child.rules["C"][0] == "C" and "C" not in child.rules["C"][1:]
            lengths.add((name, len(after) - len(before)))
            if name == "swap":
                assert sorted(before) == sorted(after)
                assert sum(a != b for a, b in zip(before, after, strict=True)) == 2
    assert lengths == {("add", 1), ("delete", -1), ("swap", 0)}


def test_a_child_has_rules_of_both():
    genotype = find_genotype("plasticoding", SPACE, {}, "test.yaml")
    rng = np.random.default_rng(1)
    a, b = genotype.random(rng), genotype.random(rng)
    children = [genotype.cross(rng, a, b) for _ in range(40)]
    for child in children:
        assert all(child.rules[k] in (a.rules[k], b.rules[k]) for k in a.rules)
    assert len({tuple(child.rules[k] == a.rules[k] for k in a.rules) for child in children}) > 20


def test_a_robot_is_spelled_out():
    """In the core's rule, a letter for each module; whatever else comes into the rule is added."""
    sensors = Sensor("depth"), Sensor("gyro", at="left_foot")
    spider = replace(load_morphology("spider"), sensors=sensors)
    genotype = find_genotype("plasticoding", SPACE, {}, "test.yaml")
    genome = genotype.adopt(spider)
    assert genome.rules["C"][:3] == ("C", "#back_hip", "#back_thigh")
    assert len(genome.rules["C"]) == 17 and genome.rules["AJ1"] == ()
    for iterations in (1, 5):
        other = find_genotype("plasticoding", SPACE, {"iterations": iterations}, "test.yaml")
        assert other.develop(other.adopt(spider)) == spider
    # A letter behind a module's is drawn there.
    at = genome.rules["C"].index("#front_foot") + 1
    rule = (*genome.rules["C"][:at], "addl", "F", *genome.rules["C"][at:])
    fin = genotype.develop(genome._replace(rules={**genome.rules, "C": rule}))
    assert fin.num_modules == 18
    (new,) = (m for m in fin.modules if m.type == "Fin")
    assert fin.modules[new.parent].name == "front_foot" and new.slot == 3
    # Without a module there is nothing on it, and all others are where they were.
    rest = tuple(letter for letter in genome.rules["C"] if letter != "#left_thigh")
    less = genotype.develop(genome._replace(rules={**genome.rules, "C": rest}))
    gone = {m.name for m in spider.modules} - {m.name for m in less.modules}
    assert gone == {"left_thigh", "left_knee", "left_foot"} and less.sensors == sensors[:1]
    kept = {m.name: m for m in spider.modules}
    assert all((kept[m.name].position == m.position).all() for m in less.modules)
