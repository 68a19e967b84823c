"""Edits of bodies: each returns a new valid body, or raises an `InputError` that says why not.

No body is changed in place. Modules that move are placed anew and compared with all others. A
module is addressed by its name or its index; its subtree is the module with all its descendants. A
new subtree is inserted among its siblings in the order of slots: in a body with slots in order,
grafting back a removed subtree gives the same body. Modules keep their names; a new module with a
name that is taken gets the first free of the suffixes _2, _3 and so on.

A core is the root of a body: it can be replaced, but neither removed, turned nor grafted. In all
edits `allow_overlap` accepts a body with modules that overlap at rest; `overlaps` then names them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.morphology import (
    MAX_MODULES,
    RESERVED,
    read_module,
    read_orientation,
    read_slot,
)
from mjx_revolve.body.placement import Module, attach, check_overlaps, check_rigid
from mjx_revolve.body.tree import Morphology, free_name
from mjx_revolve.inputs.errors import InputError, show


def free_slots(body: Morphology) -> tuple[tuple[int, int], ...]:
    """Slots without a child.

    Args:
        body: the robot.

    Returns:
        Index of the module and number of the slot, modules in order.
    """
    taken = {(module.parent, module.slot) for module in body.modules}
    return tuple(
        (index, slot)
        for index, module in enumerate(body.modules)
        for slot in module.kind.slots
        if (index, slot) not in taken
    )


def add_module(
    body: Morphology,
    parent: str | int,
    slot: int,
    type: str,
    orientation: float = 0.0,
    params: dict[str, Any] | None = None,
    name: str | None = None,
    modules: Mapping[str, ModuleType] = MODULES,
    allow_overlap: bool = False,
) -> Morphology:
    """Attaches a new module to a free slot.

    Args:
        body: the robot.
        parent: the module that carries the new one.
        slot: the parent's slot.
        type: of the new module, by name or alias.
        orientation: turn about the direction in which it is attached [deg].
        params: as in a morphology file; see `make_morphology`.
        name: by default its type and the number of modules.
        modules: the types of modules by name and alias.
        allow_overlap: accept modules that overlap at rest.

    Returns:
        The new body.

    Raises:
        InputError: there is no such module, slot or type, the slot is taken, a param is wrong, the
            module overlaps with another one, or there would be too many.
    """
    above, at = _find_slot(body, parent, slot)
    item = {"id": name, "type": type, "orientation": orientation, "params": params}
    place = f"{_place(body, above)}.children.{at}"
    new = replace(read_module(item, place, modules, body.modules, above, at), parent=-1)
    return _insert(body, above, at, [new], allow_overlap)


def graft_subtree(
    body: Morphology,
    parent: str | int,
    slot: int,
    donor: Morphology,
    module: str | int,
    orientation: float | None = None,
    allow_overlap: bool = False,
) -> Morphology:
    """Attaches a copy of a subtree, of this body or another one, to a free slot.

    Args:
        body: the robot that receives it.
        parent: the module that carries the copy.
        slot: the parent's slot.
        donor: the robot that the subtree is copied from.
        module: the subtree's first module in it.
        orientation: of that module [deg]; None: unchanged.
        allow_overlap: accept modules that overlap at rest.

    Returns:
        The new body.

    Raises:
        InputError: there is no such module or slot, the slot is taken, the module is a core, the
            grafted subtree overlaps with other modules, or there would be too many.
    """
    above, at = _find_slot(body, parent, slot)
    index = _find(donor, module, core=False)
    graft = _cut(donor.modules, index)
    if orientation is not None:
        angle = read_orientation(orientation, f"{_place(donor, index)}.orientation")
        graft[0] = replace(graft[0], orientation=angle)
    return _insert(body, above, at, graft, allow_overlap)


def remove_module(body: Morphology, module: str | int) -> Morphology:
    """Removes a module with all its descendants.

    Args:
        body: the robot.
        module: the module, not the core.

    Returns:
        The new body.

    Raises:
        InputError: there is no such module, or it is the core.
    """
    index = _find(body, module, core=False)
    return _finish(body, _splice(body.modules, index, []), allow_overlap=True)


def replace_module(
    body: Morphology,
    module: str | int,
    type: str,
    params: dict[str, Any] | None = None,
    drop_children: bool = False,
    modules: Mapping[str, ModuleType] = MODULES,
    allow_overlap: bool = False,
) -> Morphology:
    """Gives a module another type, or other params.

    The module keeps its name, slot and orientation, and its colour unless `params` hold another
    one; its children move to the same slots of the new type.

    Args:
        body: the robot.
        module: the module; a core can become another core.
        type: the new type, by name or alias; it may be the same type.
        params: all of the new params, as in a morphology file; by default none.
        drop_children: remove the children for which the new type has no slot.
        modules: the types of modules by name and alias.
        allow_overlap: accept modules that overlap at rest.

    Returns:
        The new body.

    Raises:
        InputError: there is no such module or type, a param is wrong, the new type lacks the slot
            of a child, or modules would overlap.
    """
    index = _find(body, module)
    old, place = body.modules[index], _place(body, index)
    item = {"id": old.name, "type": type, "orientation": old.orientation, "params": params}
    new = read_module(item, place, modules, body.modules, old.parent, old.slot)
    tree: Sequence[Module] = body.modules
    homeless = [i for i, m in enumerate(tree) if m.parent == index and m.slot not in new.kind.slots]
    if homeless and not drop_children:
        slots = ", ".join(map(str, sorted(new.kind.slots))) or "none"
        raise InputError(
            f"{place}.type",
            f"one with the slot {tree[homeless[0]].slot} of {tree[homeless[0]].name!r}",
            f"{new.type} with the slots {slots} (drop_children removes what does not fit)",
        )
    for child in reversed(homeless):
        tree = _splice(tree, child, [])
    changed = replace(new, parent=-1, rgb=new.rgb or old.rgb)
    return _finish(
        body, _splice(tree, index, [changed, *_cut(tree, index)[1:]]), allow_overlap, place
    )


def turn_module(
    body: Morphology, module: str | int, orientation: float, allow_overlap: bool = False
) -> Morphology:
    """Turns a module, with its descendants, about the direction in which it is attached.

    Args:
        body: the robot.
        module: the module, not the core.
        orientation: the new one [deg].
        allow_overlap: accept modules that overlap at rest.

    Returns:
        The new body.

    Raises:
        InputError: there is no such module, it is the core, the angle is no quarter turn, or
            modules would overlap.
    """
    index = _find(body, module, core=False)
    place = _place(body, index)
    root, *rest = _cut(body.modules, index)
    root = replace(root, orientation=read_orientation(orientation, f"{place}.orientation"))
    return _finish(body, _splice(body.modules, index, [root, *rest]), allow_overlap, place)


def swap_subtrees(
    body: Morphology, module: str | int, other: str | int, allow_overlap: bool = False
) -> Morphology:
    """Exchanges two subtrees of one body; each takes the other's slot and keeps its orientation.

    Args:
        body: the robot.
        module: root of the first subtree, not the core.
        other: root of the second subtree; neither is a descendant of the other.
        allow_overlap: accept modules that overlap at rest.

    Returns:
        The new body.

    Raises:
        InputError: there is no such module, one is the core or a descendant of the other, or
            modules would overlap.
    """
    first, second = sorted(_find(body, which, core=False) for which in (module, other))
    tree: Sequence[Module] = body.modules
    if second < subtree_end(tree, first):
        raise InputError(
            f"{body.path or body.name}: expected two subtrees apart from each other; found "
            f"{tree[second].name!r} in that of {tree[first].name!r}"
        )
    one, two = _cut(tree, first), _cut(tree, second)
    tree = _splice(_splice(tree, second, one), first, two)
    return _finish(body, tree, allow_overlap, _place(body, first))


def exchange_subtrees(
    a: Morphology,
    module_a: str | int,
    b: Morphology,
    module_b: str | int,
    allow_overlap: bool = False,
) -> tuple[Morphology, Morphology]:
    """Exchanges subtrees of two bodies; each takes the other's slot and keeps its orientation.

    Args:
        a: a robot.
        module_a: root of its subtree, not the core.
        b: a robot; it may be `a` itself: then two copies of it exchange their subtrees.
        module_b: root of its subtree, not the core.
        allow_overlap: accept modules that overlap at rest.

    Returns:
        The new bodies; each keeps its name, core and brain.

    Raises:
        InputError: there is no such module, one is a core, modules would overlap, or there would be
            too many.
    """
    i, j = _find(a, module_a, core=False), _find(b, module_b, core=False)

    def receive(body: Morphology, index: int, graft: list[Module]) -> Morphology:
        kept = [*body.modules[:index], *body.modules[subtree_end(body.modules, index) :]]
        tree = _splice(body.modules, index, _name_apart(graft, kept))
        return _finish(body, tree, allow_overlap, _place(body, index))

    return receive(a, i, _cut(b.modules, j)), receive(b, j, _cut(a.modules, i))


# ------------------------------------------------------------------------- pieces of an edit


def _place(body: Morphology, index: int) -> str:
    """The place of an edit, for messages."""
    return f"{body.path or body.name}: {body.modules[index].name}"


def _find(body: Morphology, module: str | int, core: bool = True) -> int:
    """Index of a module; `core` whether it may be the core."""
    names = {m.name: i for i, m in enumerate(body.modules)}
    index = names.get(module, -1) if isinstance(module, str) else module
    whole = isinstance(index, int | np.integer) and not isinstance(index, bool)
    if not whole or not 0 <= index < len(names):
        raise InputError(
            f"{body.path or body.name}: expected the name of a module or an index from 0 to "
            f"{len(names) - 1}; found {show(module)}"
        )
    if index == 0 and not core:
        raise InputError(_place(body, 0), "a module that is attached to another one", "the core")
    return int(index)


def _find_slot(body: Morphology, parent: str | int, slot: int) -> tuple[int, int]:
    """Index of the module and number of its slot, which is free."""
    index = _find(body, parent)
    at = read_slot(slot, body.modules[index].kind, _place(body, index))
    for module in body.modules:
        if (module.parent, module.slot) == (index, at):
            raise InputError(
                _place(body, index), "a free slot", f"slot {at} taken by {module.name!r}"
            )
    return index, at


def subtree_end(modules: Sequence[Module], index: int) -> int:
    """Index behind the last module of a subtree, which is contiguous: modules are depth first."""
    stop = index + 1
    while stop < len(modules) and modules[stop].parent >= index:
        stop += 1
    return stop


def _cut(modules: Sequence[Module], index: int) -> list[Module]:
    """A subtree, with indices of parents relative to its own first module."""
    root, *rest = modules[index : subtree_end(modules, index)]
    return [replace(root, parent=-1), *(replace(m, parent=m.parent - index) for m in rest)]


def _splice(
    modules: Sequence[Module],
    index: int,
    graft: Sequence[Module],
    target: tuple[int, int] | None = None,
) -> list[Module]:
    """A tree with another subtree, laid out at rest.

    Args:
        modules: the tree.
        index: of the subtree that is replaced; with a `target`, of the module before which the new
            subtree is inserted.
        graft: the new subtree, as from `_cut`; empty for none.
        target: parent and slot of the new subtree if it replaces none.

    Returns:
        The modules.
    """
    stop = subtree_end(modules, index) if target is None else index
    parent, slot = target or (modules[index].parent, modules[index].slot)
    found = list(modules[:index])
    for k, module in enumerate(graft):
        carrier, at = (parent, slot) if k == 0 else (index + module.parent, module.slot)
        position, rotation = module.position, module.rotation
        if carrier >= 0:
            above = found[carrier]
            position, rotation = attach(
                above, above.kind.slots[at], module.kind, module.orientation
            )
        found.append(replace(module, parent=carrier, slot=at, position=position, rotation=rotation))
    shift = index + len(graft) - stop
    for module in modules[stop:]:
        after = shift != 0 and module.parent >= stop
        found.append(replace(module, parent=module.parent + shift) if after else module)
    return found


def _insert(
    body: Morphology, parent: int, slot: int, graft: Sequence[Module], allow_overlap: bool
) -> Morphology:
    """The body with a new subtree at a free slot, before those of higher slots."""
    tree = body.modules
    after = [i for i, m in enumerate(tree) if m.parent == parent and m.slot > slot]
    index = after[0] if after else subtree_end(tree, parent)
    tree = tuple(_splice(tree, index, _name_apart(graft, tree), (parent, slot)))
    return _finish(body, tree, allow_overlap, f"{_place(body, parent)}.children.{slot}")


def _name_apart(graft: Sequence[Module], kept: Iterable[Module]) -> list[Module]:
    """A subtree with its origins, renamed so that no name is among those kept."""
    taken = {*RESERVED, *(module.name for module in kept)}
    used = taken | {module.name for module in graft}
    found = []
    for module in graft:
        module = replace(module, origin=module.origin or (0, module.name))
        if module.name in taken:
            name = free_name(re.sub(r"_[0-9]+$", "", module.name), used)
            used.add(name)
            module = replace(module, name=name)
        found.append(module)
    return found


def _finish(
    body: Morphology, modules: Sequence[Module], allow_overlap: bool, place: str = ""
) -> Morphology:
    """The edited body, checked; modules that did not move need no comparison with each other."""
    if len(modules) > MAX_MODULES:
        raise InputError(place, f"at most {MAX_MODULES} modules", len(modules))
    check_rigid(modules, place)
    before = {(id(m.position), id(m.kind)) for m in body.modules}
    moved = [i for i, m in enumerate(modules) if (id(m.position), id(m.kind)) not in before]
    pairs = check_overlaps(modules, allow_overlap, place, moved) if moved else ()
    if body.overlaps:
        number = {m.name: i for i, m in enumerate(modules)}
        still = {m.name for m in modules} - {modules[i].name for i in moved}
        old = (pair for pair in body.overlaps if still.issuperset(pair))
        pairs = tuple(sorted({*pairs, *old}, key=lambda pair: [number[name] for name in pair]))
    edited = replace(body, modules=tuple(modules), overlaps=pairs, path=None)
    return edited.with_sensors(body.sensors)
