"""The direct genotype: the genome is the body itself, and varies by edits.

Modules keep their names while others are added and removed around them, so that the genes of a
joint stay with it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields, replace
from typing import Annotated

import numpy as np
from annotated_types import Unit
from numpy.typing import ArrayLike

from mjx_revolve.body.edits import (
    add_module,
    free_slots,
    graft_subtree,
    remove_module,
    replace_module,
    subtree_end,
    swap_subtrees,
    turn_module,
)
from mjx_revolve.body.module_types import ModuleType, Slot
from mjx_revolve.body.morphology import make_morphology
from mjx_revolve.body.tree import Morphology
from mjx_revolve.genotypes.genotype import Genotype, Origins, Space, make_genotype, pick
from mjx_revolve.genotypes.growth import Growth, name_place
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.schema import ConstraintError, NonNegative, checked, read

_Rate = Annotated[NonNegative, Unit("-")]


@checked
class TreeSettings:
    """Relative weights of the mutations; a mutant has one of them.

    Attributes:
        add: add a module at a free slot.
        delete: remove a module without children.
        prune: remove a subtree.
        duplicate: copy a subtree to a free slot.
        mirror: put the mirror image of a limb at the opposite slot, in place of the subtree there.
        swap: exchange two subtrees.
        retype: give a module another type.
        turn: turn a module with its subtree.

    Raises:
        InputError: a number is negative, or all are 0.
    """

    # Choices: mostly small changes; bodies neither grow nor shrink on average.
    add: _Rate = 3.0
    delete: _Rate = 2.0
    prune: _Rate = 0.5
    duplicate: _Rate = 0.5
    mirror: _Rate = 1.0
    swap: _Rate = 0.5
    retype: _Rate = 1.5
    turn: _Rate = 1.5

    def __post_init__(self) -> None:
        """Checks that a mutation has a positive weight."""
        if not any(getattr(self, field.name) for field in fields(self)):
            raise ConstraintError("", "a number > 0 among the mutations", "all of them 0")


def make_tree(space: Space, params: Mapping[str, object], place: str) -> Genotype[Morphology]:
    """The direct genotype: genomes are bodies.

    Args:
        space: of the bodies.
        params: fields of `TreeSettings`.
        place: where they were given, for messages.

    Raises:
        InputError: a parameter is wrong.
    """
    settings = read(TreeSettings, dict(params), f"{place}.params")
    rates = {name: getattr(settings, name) for name in _MUTATIONS}
    mutations = [_MUTATIONS[name] for name, rate in rates.items() if rate > 0.0]
    bounds = np.cumsum([rate for rate in rates.values() if rate > 0.0])

    def mutate(rng: np.random.Generator, body: Morphology) -> Morphology | None:
        drawn = np.searchsorted(bounds, rng.random() * bounds[-1], side="right")
        return _try(mutations[drawn], space, rng, body)

    return make_genotype(
        space,
        "tree",
        place,
        draw=lambda rng: _grow(space, rng),
        mutate=mutate,
        cross=lambda rng, a, b: _try(_exchange, space, rng, a, b),
        develop=lambda body: body,
        adopt=lambda body: body,
        to_plain=Morphology.to_mapping,
        from_plain=lambda plain: make_morphology(plain, space.catalogue, source="genome"),
        settle=_settle,
    )


def _settle(body: Morphology) -> tuple[Morphology, Origins]:
    """The body without the origins of its modules, and these."""
    origins = {module.name: module.origin for module in body.modules if module.origin}
    if origins:
        modules = tuple(replace(module, origin=None) for module in body.modules)
        body = replace(body, modules=modules)
    return body, origins


def _try(edit: Callable[..., Morphology | None], *arguments: object) -> Morphology | None:
    """The result of an edit; None if it is invalid."""
    try:
        return edit(*arguments)
    except InputError:
        return None


def _turn(rng: np.random.Generator) -> float:
    return 90.0 * int(rng.integers(4))


# ------------------------------------------------------------------------- random bodies


def _grow(space: Space, rng: np.random.Generator) -> Morphology:
    """A body of a random size, grown at random slots."""
    growth = Growth(space)
    size = int(rng.integers(space.min_modules, space.max_modules + 1))
    free = [(0, slot) for slot in growth.modules[0].kind.slots]
    while free and len(growth.modules) < size:
        parent, slot = free.pop(int(rng.integers(len(free))))
        missing = space.min_hinges - growth.num_hinges
        kinds = [
            kind
            for kind in space.kinds
            if growth.has_room(kind)
            and (kind.hinge is not None or missing < size - len(growth.modules))
            and (kind.slots or free)
        ]
        kind = pick(rng, kinds or space.kinds)
        index = growth.attach(parent, slot, kind, _turn(rng))
        if index is not None:
            free += [(index, slot) for slot in kind.slots]
    return growth.finish("robot")


# ------------------------------------------------------------------------- mutations


def _path(body: Morphology, index: int) -> tuple[int, ...]:
    """The slots from the core to a module."""
    path: tuple[int, ...] = ()
    while index > 0:
        module = body.modules[index]
        path, index = (module.slot, *path), module.parent
    return path


def _drawn(rng: np.random.Generator, body: Morphology) -> int:
    """Index of a random module, not the core; raises `InputError` if there is none."""
    return pick(rng, range(1, body.num_modules))


def _add(space: Space, rng: np.random.Generator, body: Morphology) -> Morphology | None:
    if body.num_modules >= space.max_modules:
        return None
    parent, slot = pick(rng, free_slots(body))
    kind = pick(rng, space.kinds)
    name = name_place(kind, (*_path(body, parent), slot))
    turn = _turn(rng)
    return add_module(body, parent, slot, kind.name, turn, None, name, space.catalogue)


def _delete(space: Space, rng: np.random.Generator, body: Morphology) -> Morphology:
    carriers = {module.parent for module in body.modules}
    leaves = [i for i in range(1, body.num_modules) if i not in carriers]
    return remove_module(body, pick(rng, leaves))


def _duplicate(space: Space, rng: np.random.Generator, body: Morphology) -> Morphology | None:
    index = _drawn(rng, body)
    if body.num_modules + _size(body, index) > space.max_modules:
        return None
    return graft_subtree(body, *pick(rng, free_slots(body)), body, index)


def _retype(space: Space, rng: np.random.Generator, body: Morphology) -> Morphology:
    index = _drawn(rng, body)
    others = [name for name in space.modules if name != body.modules[index].type]
    return replace_module(body, index, pick(rng, others), modules=space.catalogue)


def _turn_one(space: Space, rng: np.random.Generator, body: Morphology) -> Morphology:
    index = _drawn(rng, body)
    turned = body.modules[index].orientation + 90.0 * int(rng.integers(1, 4))
    return turn_module(body, index, turned % 360.0)


def _mirror(space: Space, rng: np.random.Generator, body: Morphology) -> Morphology | None:
    index = _drawn(rng, body)
    limb, above = body.modules[index], body.modules[body.modules[index].parent]
    # At a core, the mirror plane is normal to the slot's direction.
    away = above.kind.slots[limb.slot].direction if above.kind.mount is None else _side(above.kind)
    slot = _mirrored_slot(above.kind, limb.slot, away)
    if slot == limb.slot:
        return None
    image = _mirror_limb(body, index)
    there = [m.name for m in body.modules if (m.parent, m.slot) == (limb.parent, slot)]
    for name in there:
        body = remove_module(body, name)
    return graft_subtree(body, above.name, slot, image, limb.name)


_MUTATIONS: dict[str, Callable[[Space, np.random.Generator, Morphology], Morphology | None]] = {
    "add": _add,
    "delete": _delete,
    "prune": lambda _, rng, body: remove_module(body, _drawn(rng, body)),
    "duplicate": _duplicate,
    "mirror": _mirror,
    "swap": lambda _, rng, body: swap_subtrees(body, _drawn(rng, body), _drawn(rng, body)),
    "retype": _retype,
    "turn": _turn_one,
}


def _size(body: Morphology, index: int) -> int:
    """Number of modules of a subtree."""
    return subtree_end(body.modules, index) - index


# ------------------------------------------------------------------------- symmetry


def _mirror_limb(body: Morphology, index: int) -> Morphology:
    """A body with a subtree replaced by its mirror image; only a donor for grafting.

    Left and right are exchanged, as seen from the mount: orientations change sign, and slots are
    those at the opposite side.

    Args:
        body: the robot.
        index: of the subtree's first module, not the core.

    Returns:
        The body, with poses not updated.

    Raises:
        InputError: a slot has no mirror image.
    """
    modules = list(body.modules)
    for i in range(index, subtree_end(body.modules, index)):
        module, above = modules[i], body.modules[modules[i].parent]
        slot = module.slot
        if i > index:
            slot = _mirrored_slot(above.kind, slot, _side(above.kind))
        modules[i] = replace(module, slot=slot, orientation=-module.orientation % 360.0)
    return replace(body, modules=tuple(modules))


def _side(kind: ModuleType) -> tuple[float, float, float]:
    """A module's direction to the right: level, normal to its mount direction."""
    assert kind.mount is not None
    x, y, _ = kind.mount.outward
    return (y, -x, 0.0)


def _mirrored_slot(kind: ModuleType, slot: int, away: tuple[float, float, float]) -> int:
    """The slot at the mirror image of another one; `away` is the mirror plane's normal.

    Raises:
        InputError: there is none.
    """
    normal = np.array(away)

    def image(vector: ArrayLike) -> np.ndarray:
        return np.array(vector) - 2 * (normal @ np.array(vector)) * normal

    def pose(one: Slot, through: Callable[[ArrayLike], np.ndarray]) -> np.ndarray:
        return np.concatenate([through(one.position), through(one.direction), through(one.up)])

    wanted = pose(kind.slots[slot], image)
    for number, other in kind.slots.items():
        if np.allclose(pose(other, np.array), wanted, atol=1e-9):
            return number
    raise InputError(kind.name, f"a mirror image of slot {slot}", "none")


# ------------------------------------------------------------------------- crossover


def _exchange(
    space: Space, rng: np.random.Generator, a: Morphology, b: Morphology
) -> Morphology | None:
    """The first body with a subtree of the second in place of one of its own."""
    given = _drawn(rng, b)
    b = replace(b, modules=tuple(replace(m, origin=(1, m.name)) for m in b.modules))
    if a.num_modules == 1:
        return graft_subtree(a, *pick(rng, free_slots(a)), b, given)
    taken = _drawn(rng, a)
    if a.num_modules - _size(a, taken) + _size(b, given) > space.max_modules:
        return None
    old = a.modules[taken]
    parent = a.modules[old.parent].name
    return graft_subtree(remove_module(a, taken), parent, old.slot, b, given)
