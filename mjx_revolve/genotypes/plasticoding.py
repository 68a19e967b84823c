"""Plasticoding: Revolve's L-system of bodies.

A genome is a grammar with one rule for each letter that stands for a module. The sentence begins as
the core's letter, C; in each iteration every such letter is replaced by its rule. Then the sentence
is interpreted as turtle graphics: `addr`, `addf` and `addl` choose the side for the next module, a
module's letter mounts it there and moves to it, `mover`, `movef` and `movel` move to the module
that is mounted at a side, and `moveb` moves back to the parent. On a module with a single slot all
sides mean that slot; if right, front and left of a core are taken, its back is next. Modules that
overlap or exceed a bound are left out.

Letters, rules, mutation and crossover are those of Revolve (github.com/ci-group/revolve,
`pyrevolve/genotype/plasticoding`): random grammars of groups of mounting, module and moving; one
letter added, deleted, or exchanged with another one of its rule; and rules from either parent. A
joint's letter has two orientations: AJ1 bends up and down, AJ2 from side to side. Four things
differ. Brains are evolved separately, so the letters for their edges are missing. Overlaps are
found from the modules' shapes and not on a grid. Sensors count among the modules. And a genome may
begin with a given body, its seed: `#` and a module's name is a letter for that module of the seed,
so that a rule can describe any body.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Annotated, NamedTuple

import numpy as np
from annotated_types import Ge, Unit

from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import make_morphology
from mjx_revolve.body.placement import GROWN_TOLERANCE
from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.genotype import Genotype, Space, make_genotype, pick
from mjx_revolve.genotypes.growth import Growth
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.schema import (
    Boolean,
    ConstraintError,
    Integer,
    NonNegative,
    Text,
    TupleOf,
    checked,
    read,
)

CORE = "C"
# The sides of a module: Revolve's slots of core and brick.
_SIDES = {"r": 2, "f": 1, "l": 3}
MOUNTING = {f"add{side}": slot for side, slot in _SIDES.items()}
MOVING: dict[str, int | None] = {f"move{side}": slot for side, slot in _SIDES.items()} | {
    "moveb": None
}
# Letters of modules in level and in upright orientation. Revolve's are AJ1, AJ2, B, BV and ST.
_LETTERS = {
    "ActiveHinge": ("AJ1", "AJ2"),
    "FixedBrick": ("B", "BV"),
    "TouchSensor": ("ST",),
    "Fin": ("F", "FV"),
    "Thruster": ("T",),
    "LiftThruster": ("LT", "LTV"),
}
# Most letters of a sentence, and read in rules: a choice, a hundred times those of a body.
_MOST_LETTERS = 3000


class Letter(NamedTuple):
    """The module that a letter stands for.

    Attributes:
        kind: its type.
        upright: whether it is turned by 90° out of the core's level plane.
    """

    kind: ModuleType
    upright: bool


class Grammar(NamedTuple):
    """A genome.

    Attributes:
        name: of the body.
        rules: replacement by letter; the core's rule begins with the core.
        seed: the body of the modules that letters with a `#` name; None: there are none.
    """

    name: str
    rules: Mapping[str, tuple[str, ...]]
    seed: Morphology | None = None


_Rate = Annotated[NonNegative, Unit("-")]


@checked
class PlasticodingSettings:
    """Settings of grammars: initialization, development and mutation.

    Attributes:
        iterations: number of times that letters are replaced by their rules.
        groups: most groups of three letters in a rule of a random grammar.
        max_rule: most letters of a rule to which another one may be added.
        upright: whether other modules than joints may be upright, too.
        add: weight of the mutation that adds a letter, relative to the other two.
        delete: weight of the mutation that deletes a letter.
        swap: weight of the mutation that exchanges two letters.

    Raises:
        InputError: a number is out of range, or no mutation can be drawn.
    """

    # Revolve's, but for `max_rule`, a choice.
    iterations: Annotated[Integer, Ge(1)] = 3
    groups: Annotated[Integer, Ge(1)] = 3
    max_rule: Annotated[Integer, Ge(1)] = 40
    upright: Boolean = True
    add: _Rate = 1.0
    delete: _Rate = 1.0
    swap: _Rate = 1.0

    def __post_init__(self) -> None:
        """Checks that a mutation has a positive weight."""
        if not any((self.add, self.delete, self.swap)):
            raise ConstraintError("", "a number > 0 among add, delete and swap", "all of them 0")


def make_plasticoding(space: Space, params: Mapping[str, object], place: str) -> Genotype[Grammar]:
    """Revolve's L-system: genomes are grammars.

    Args:
        space: of the bodies.
        params: fields of `PlasticodingSettings`.
        place: where they were given, for messages.

    Raises:
        InputError: a parameter is wrong.
    """
    settings = read(PlasticodingSettings, dict(params), f"{place}.params")
    letters = make_alphabet(space, settings.upright)
    names = [*letters]

    def develop(grammar: Grammar) -> Morphology:
        sentence = expand(grammar.rules, settings.iterations)
        return draw_sentence(sentence, letters, space, grammar.name, grammar.seed)

    def adopt(body: Morphology) -> Grammar:
        spelled = (CORE, *(f"#{module.name}" for module in body.modules[1:]))
        grammar = Grammar(body.name, {CORE: spelled} | dict.fromkeys(names, ()), body)
        grown, wanted = develop(grammar).modules, {module.name for module in body.modules}
        if lost := sorted(wanted - {module.name for module in grown}):
            apart = f"modules that overlap by at most {2e3 * GROWN_TOLERANCE:g} mm, to grow them"
            raise InputError(body.name, apart, f"more at {', '.join(lost)}")
        return grammar

    return make_genotype(
        space,
        "plasticoding",
        place,
        draw=lambda rng: Grammar("robot", _draw_rules(rng, names, settings.groups)),
        mutate=lambda rng, grammar: _mutate(rng, grammar, names, settings),
        cross=_cross,
        develop=develop,
        adopt=adopt,
        to_plain=_to_plain,
        from_plain=lambda plain: _read(plain, names, space),
    )


def make_alphabet(space: Space, upright: bool = True) -> dict[str, Letter]:
    """The letters that stand for modules, without the core's.

    Args:
        space: gives the types of modules.
        upright: whether other modules than joints have a letter for upright, too.

    Returns:
        Letters by name: Revolve's where it has one, F for a fin, T and LT for the thrusters; for
        users' types their names, with a suffix 1 or 2 for joints.

    Raises:
        InputError: two things have the same letter.
    """
    found = {}
    for kind in space.kinds:
        hinge = kind.hinge is not None
        own = (f"{kind.name}1", f"{kind.name}2") if hinge else (kind.name, f"{kind.name}V")
        names = _LETTERS.get(kind.name, own)
        for k, name in enumerate(names if hinge or upright else names[:1]):
            if name in found or name in (CORE, *MOUNTING, *MOVING):
                taken = f"{name!r} of {kind.name}, which stands for something else"
                raise InputError("bodies.modules", "types with letters of their own", taken)
            found[name] = Letter(kind, upright=k == 1)
    return found


# ------------------------------------------------------------------------- development


def expand(rules: Mapping[str, tuple[str, ...]], iterations: int) -> Iterator[str]:
    """The letters of a sentence, one after the other.

    Args:
        rules: letters by letter; a letter without a rule stays.
        iterations: number of times that letters are replaced by their rules, the core's first.

    Yields:
        Its letters, until `_MOST_LETTERS` were read in rules and sentence.
    """
    stack = [iter((CORE,))]
    for _ in range(_MOST_LETTERS):
        letter = next(stack[-1], None)
        if letter is None:
            stack.pop()
            if not stack:
                return
        elif len(stack) <= iterations and letter in rules:
            stack.append(iter(rules[letter]))
        else:
            yield letter


def draw_sentence(
    sentence: Iterable[str],
    letters: Mapping[str, Letter],
    space: Space,
    name: str = "robot",
    seed: Morphology | None = None,
) -> Morphology:
    """The body that a sentence describes.

    Args:
        sentence: letters.
        letters: modules by letter.
        space: gives the upper bounds.
        name: of the body.
        seed: gives the core, and the modules that letters with a `#` name.
    """
    turtle = _Turtle(Growth(space, seed), seed)
    for letter in sentence:
        if turtle.growth.is_full:
            break
        if letter in MOUNTING:
            turtle.side = MOUNTING[letter]
        elif letter in MOVING:
            turtle.move(MOVING[letter])
        elif letter in letters:
            turtle.mount(letters[letter])
        elif letter.startswith("#"):
            turtle.spell(letter[1:])
    return turtle.growth.finish(name).with_sensors(seed.sensors if seed else None)


class _Turtle:
    """The state of drawing a sentence.

    Attributes:
        growth: the body so far.
        side: the slot at which the next module is mounted; None: it is left out.
    """

    def __init__(self, growth: Growth, seed: Morphology | None) -> None:
        self.growth = growth
        self.side: int | None = None
        self._here = 0
        self._back: list[int] = []
        self._upright = [False]
        # The seed's modules with their parents by name, and the indices of those that were drawn.
        modules = seed.modules if seed else ()
        self._seed = {m.name: (m, modules[m.parent].name) for m in modules[1:]}
        self._drawn = {m.name: 0 for m in modules[:1]}

    def _slot(self, side: int) -> int | None:
        """The slot of a side at the current module."""
        slots = self.growth.modules[self._here].kind.slots
        if len(slots) == 1:
            return next(iter(slots))
        return side if side in slots else None

    def move(self, side: int | None) -> None:
        """Moves to the module at a side; None: back to the parent."""
        if side is None:
            if self._back:
                self._here = self._back.pop()
            return
        slot = self._slot(side)
        index = None if slot is None else self.growth.child(self._here, slot)
        if index is not None:
            self._enter(index)

    def _enter(self, index: int) -> None:
        """Moves to a module, if it has slots."""
        if self.growth.modules[index].kind.slots:
            self._back.append(self._here)
            self._here = index

    def mount(self, letter: Letter) -> None:
        """Mounts a module at the chosen side, or at the back if all sides are taken."""
        if self.side is None:
            return
        slot = self._slot(self.side)
        slots = self.growth.modules[self._here].kind.slots
        free = [number for number in slots if self.growth.child(self._here, number) is None]
        if slot not in free:
            if not free or any(number in _SIDES.values() for number in free):
                return
            slot = free[0]
        upright = self._upright[self._here]
        turn = 0.0 if letter.upright == upright else 90.0 if letter.upright else 270.0
        index = self.growth.attach(self._here, slot, letter.kind, turn)
        if index is not None:
            self.side = None
            self._upright.append(letter.upright)
            self._enter(index)

    def spell(self, name: str) -> None:
        """Adds the seed's module of that name at its slot, if its parent has been added."""
        module, parent = self._seed[name]
        if name not in self._drawn and parent in self._drawn:
            above = self._drawn[parent]
            turn = module.orientation
            index = self.growth.attach(above, module.slot, module.kind, turn, like=module)
            if index is not None:
                self._drawn[name] = index
                self._upright.append(self._upright[above] != (turn % 180.0 == 90.0))
        if name in self._drawn:
            way = [self._drawn[name]]
            while way[-1] > 0:
                way.append(self.growth.modules[way[-1]].parent)
            if not module.kind.slots:
                way.pop(0)
            self._here, *back = way
            self._back = back[::-1]


# ------------------------------------------------------------------------- variation


def _draw_rules(
    rng: np.random.Generator, names: Sequence[str], groups: int
) -> dict[str, tuple[str, ...]]:
    """Random rules: as many groups of (mounting, module, moving) in each."""
    count = int(rng.integers(1, groups + 1))
    kinds = (tuple(MOUNTING), names, tuple(MOVING))
    rules = {}
    for letter in (CORE, *names):
        rule = [pick(rng, kind) for _ in range(count) for kind in kinds]
        rules[letter] = (CORE, *rule) if letter == CORE else tuple(rule)
    return rules


def _mutate(
    rng: np.random.Generator, grammar: Grammar, names: Sequence[str], settings: PlasticodingSettings
) -> Grammar | None:
    """One letter added, deleted or exchanged in a rule within reach; None if impossible."""
    letter = pick(rng, _used(grammar.rules))
    rule = [*grammar.rules[letter]]
    first = int(letter == CORE)  # the core's letter stays at the beginning of its rule
    drawn = rng.random() * (settings.add + settings.delete + settings.swap)
    if drawn < settings.add:
        if len(rule) - first >= settings.max_rule:
            return None
        new = pick(rng, pick(rng, (names, tuple(MOUNTING), tuple(MOVING))))
        rule.insert(int(rng.integers(first, len(rule) + 1)), new)
    elif len(rule) <= first:
        return None
    elif drawn < settings.add + settings.delete:
        del rule[int(rng.integers(first, len(rule)))]
    else:
        i, k = (int(place) for place in rng.integers(first, len(rule), 2))
        if rule[i] == rule[k]:
            return None
        rule[i], rule[k] = rule[k], rule[i]
    return grammar._replace(rules={**grammar.rules, letter: tuple(rule)})


def _used(rules: Mapping[str, tuple[str, ...]]) -> list[str]:
    """The letters with rules that a sentence can reach."""
    found = [CORE]
    for letter in found:
        found += [new for new in dict.fromkeys(rules[letter]) if new in rules and new not in found]
    return found


def _cross(rng: np.random.Generator, a: Grammar, b: Grammar) -> Grammar:
    """The rules of either parent; the seed comes with the core's."""
    givers = {letter: pick(rng, (a, b)) for letter in a.rules}
    rules = {letter: giver.rules[letter] for letter, giver in givers.items()}
    return Grammar(a.name, rules, givers[CORE].seed)


# ------------------------------------------------------------------------- saving


@checked
class _Plain:
    """A grammar as plain values for JSON."""

    name: Text
    rules: dict[Text, TupleOf[Text]]
    seed: dict[Text, object] | None = None


def _to_plain(grammar: Grammar) -> dict[str, object]:
    return {
        "name": grammar.name,
        "rules": {letter: list(rule) for letter, rule in grammar.rules.items()},
        "seed": None if grammar.seed is None else grammar.seed.to_mapping(),
    }


def _read(plain: object, names: Sequence[str], space: Space) -> Grammar:
    """A grammar from plain values, the inverse of `_to_plain`."""
    found = read(_Plain, plain, "genome")
    seed = None
    if found.seed is not None:
        seed = make_morphology(found.seed, space.catalogue, source="genome.seed")
    spelled = {f"#{module.name}" for module in seed.modules[1:]} if seed else set()
    known = {*names, *MOUNTING, *MOVING}
    for letter in (CORE, *names):
        if letter not in found.rules:
            raise InputError("genome.rules", f"one for {letter}", "none")
    for letter, rule in found.rules.items():
        place = f"genome.rules.{letter}"
        if letter not in (CORE, *names):
            raise InputError(f"{place}: expected a letter of {', '.join((CORE, *names))}")
        rest = rule[1:] if letter == CORE else rule
        if letter == CORE and rule[:1] != (CORE,):
            raise InputError(place, f"{CORE} at its beginning", show(rule))
        strange = {*rest} - known - (spelled if letter == CORE else set())
        if strange:
            raise InputError(place, "known letters", show(min(strange)))
    return Grammar(found.name, {letter: found.rules[letter] for letter in (CORE, *names)}, seed)
