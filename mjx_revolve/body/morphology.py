"""Bodies read: from Revolve's YAML, or from a mapping like it, checked and laid out at rest.

A morphology file is Revolve's YAML: `id`, `body` (a tree of modules, each with `id`, `type`,
`orientation`, `params` and `children` by slot) and `brain`. Revolve lacks `sensors` and
`coefficients` (the path of a file of fitted coefficients, relative to the morphology's).
"""

from __future__ import annotations

import copy
import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import MinLen, Unit

from mjx_revolve.body.catalogue import MODULES
from mjx_revolve.body.coefficients import correct_modules, load_coefficients
from mjx_revolve.body.module_types import ModuleType
from mjx_revolve.body.params import apply_overrides, check_overrides, read_number
from mjx_revolve.body.placement import Module, attach, check_overlaps, check_rigid, frozen
from mjx_revolve.body.sensors import SensorRow
from mjx_revolve.body.tree import COLORS, Morphology, free_name, save_morphology
from mjx_revolve.inputs.errors import InputError, note, show
from mjx_revolve.inputs.schema import Positive, Text, read, words
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.inputs.yaml_reader import load_yaml

__all__ = [
    "Module",
    "Morphology",
    "load_morphology",
    "make_morphology",
    "save_morphology",
    "trim_neutral",
]

# Evolved robots have about 30 modules. The limit is a choice: a mistake must not take hours.
MAX_MODULES = 1000

# Names that the MuJoCo model keeps for itself.
RESERVED = ("world", "root")

_File = Annotated[Text, MinLen(1), words("the path of a file of coefficients")]
_Children = Annotated[dict[Any, Any], words("a mapping from slots to modules")]
_MODULE_KEYS = ("id", "type", "slot", "orientation", "params", "children")

_ORIGIN = frozen(np.zeros(3)), frozen(np.eye(3))


def load_morphology(
    path: str | Path, modules: Mapping[str, ModuleType] = MODULES, allow_overlap: bool = False
) -> Morphology:
    """Reads a robot's body from Revolve's YAML, as `make_morphology` does from a mapping.

    Args:
        path: the file, or a shipped morphology's name; without an `id` in it, the robot is named
            after it.
        modules: the types of modules by name and alias.
        allow_overlap: accept modules that overlap at rest; `overlaps` then names them.

    Returns:
        The morphology.

    Raises:
        InputError: the file cannot be read, or something in it is wrong; the message says where,
            what was expected and what was found.
    """
    path = find_shipped(path, "morphologies")
    data = load_yaml(path)
    if data is None:
        raise InputError(path, "a mapping with id, body and brain", "an empty file")
    return replace(_make(data, modules, allow_overlap, path.stem, str(path)), path=str(path))


def make_morphology(
    mapping: Mapping[str, object],
    modules: Mapping[str, ModuleType] = MODULES,
    allow_overlap: bool = False,
    name: str = "robot",
    source: str = "morphology",
) -> Morphology:
    """Makes a robot's body from a mapping like a morphology file.

    Files of Revolve differ among each other, so these forms are accepted: slots as numbers or text;
    a key `slot` of a module, which is ignored; no `orientation` (0), `params` or `id` (a module
    without id is named after its type and number); numbers in `params` like `0.707;`. The brain is
    kept as it is, and so are keys of `params` that do not resemble ours. Where an id repeats, or is
    reserved by MuJoCo, the later modules get the suffix _2, _3 and so on. Everything else
    unexpected is refused.

    `params` may hold `red`, `green`, `blue` (0 to 1, all or none) and these overrides; numbers are
    >= 0:

    - `mass` [kg] and `volume` [m³] of the whole module, shared among its parts in proportion to the
      catalogue's values (a choice);
    - `electronics_volume` [m³] of the whole module, all of it in the part with the largest volume,
      which in a hinge is the servo (a choice); `center_of_volume` of that part (three numbers, part
      frame [m]);
    - `ballast` [kg] added to the first part: to its mass, or, with `ballast_position` (three
      numbers, part frame [m]) or `ballast_volume` [m³], as a point there that takes the place of
      the part's own;
    - `drag_coefficient`, `added_mass_coefficient` (a number, or three along the part's axes),
      `entrained_water` (share of the box's free volume, 0 to 1) of every part [-];
    - `coefficients`: a mapping of coefficients of laws that have no key of their own;
    - `factors`: a mapping of factors on any coefficient of a law, on `drag` or `added_mass` as a
      whole, and on `mass`, `thrust`, `servo_speed` and `servo_effort`, as fitted to a real robot
      (`docs/fit.md`);
    - `buoyancy`, `drag` (a law's name or `off`) and `added_mass` (true or false): the module's own
      laws in place of the world's;
    - `lift_drag`: a mapping with fields of `LiftDrag`, such as `{cla: 2.0}`; it changes a fin, or
      makes any other module a fin;
    - `fossen`: a mapping with fields of `Fossen`: added mass and damping from another source, of a
      module with one part, in place of those of our laws;
    - `thruster`: a mapping with fields of `Thruster`, such as `{torque_ratio: -0.0035}` for a
      left-handed propeller; `thrust` [N] at its highest command, which scales its curve.

    Args:
        mapping: `id`, `body`, `sensors`, `brain` and `coefficients`, or a body's tree of modules
            alone; copied.
        modules: the types of modules by name and alias.
        allow_overlap: accept modules that overlap at rest; `overlaps` then names them.
        name: of the robot, where the mapping has no `id`.
        source: what to call the mapping in messages.

    Returns:
        The morphology.

    Raises:
        InputError: something in the mapping is wrong; the message says where, what was expected and
            what was found.
    """
    if isinstance(mapping, dict) and "type" in mapping and "body" not in mapping:
        mapping = {"body": mapping}
    return _make(mapping, modules, allow_overlap, name, source)


def _make(
    data: object, modules: Mapping[str, ModuleType], allow_overlap: bool, name: str, source: str
) -> Morphology:
    """The body of a whole mapping; `name` where it has no `id`."""
    if not isinstance(data, dict):
        raise InputError(source, "a mapping with id, body and brain", show(data))
    if "task" in data and "body" not in data:
        raise InputError(source, "a robot", "a configuration")
    _check_known(data, ("id", "body", "sensors", "brain", "coefficients"), source)
    if "body" not in data:
        raise InputError(source, "the key body", show(list(data)))
    tree = _read_tree(data["body"], modules, source)
    if (named := data.get("coefficients")) is not None:
        named = read(_File, named, f"{source}: coefficients")
        place = Path(source).parent / named
        tree = correct_modules(tree, load_coefficients(place), str(place))
    check_rigid(tree, f"{source}: body")
    sensors = data.get("sensors")
    return Morphology(
        name=_read_id(data.get("id"), f"{source}: id") or name,
        modules=tree,
        brain=copy.deepcopy(data.get("brain")),
        overlaps=check_overlaps(tree, allow_overlap, f"{source}: body"),
        sensors=None if sensors is None else read(SensorRow, sensors, f"{source}: sensors"),
    )


def _check_known(item: Mapping[object, object], known: tuple[str, ...], place: str) -> None:
    for key in item:
        if key not in known:
            raise InputError(place, f"only {', '.join(known)}", show(key))


def _read_tree(body: object, modules: Mapping[str, ModuleType], source: str) -> tuple[Module, ...]:
    """All modules, depth first, with unique names."""
    found: list[Module] = []
    stack: list[tuple[Any, str, int, int]] = [(body, "body", -1, -1)]
    while stack:
        item, where, parent, slot = stack.pop()
        place = f"{source}: {where}"
        if len(found) == MAX_MODULES:
            raise InputError(f"{source}: body", f"at most {MAX_MODULES} modules", "more")
        index = len(found)
        module = read_module(item, place, modules, found, parent, slot)
        found.append(module)
        stack.extend(
            (child, f"{where}.children.{number}", index, number)
            for number, child in reversed(_read_children(item, place, module).items())
        )
    return _with_unique_names(found, source)


def read_module(
    item: object,
    place: str,
    modules: Mapping[str, ModuleType],
    tree: Sequence[Module],
    parent: int,
    slot: int,
) -> Module:
    """Reads one module without its children and computes its pose at rest.

    Args:
        item: the mapping with its type.
        place: where, for messages.
        modules: the types of modules by name and alias.
        tree: the robot's modules so far.
        parent: index of its parent in `tree`; -1 for the core.
        slot: an existing slot of the parent; -1 for the core.

    Returns:
        The module; without an id, it is named after its type and its number.

    Raises:
        InputError: a value in it is wrong.
    """
    if not isinstance(item, dict):
        found = "nothing" if item is None else show(item)
        raise InputError(place, "a module (a mapping with a type)", found)
    _check_known(item, _MODULE_KEYS, place)
    kind = _read_type(item.get("type"), place, modules, parent < 0)
    orientation = read_orientation(item.get("orientation"), f"{place}.orientation")
    if parent < 0 and orientation != 0.0:
        raise InputError(
            f"{place}.orientation", "0 (the core is attached to nothing)", f"{orientation:g}"
        )
    rgb, params = _read_params(item.get("params"), f"{place}.params")
    try:
        changed = apply_overrides(kind, params) if params else kind
    except InputError as error:
        raise InputError(f"{place}.params: {error}") from None
    pose = _ORIGIN
    if parent >= 0:
        above = tree[parent]
        pose = attach(above, above.kind.slots[slot], changed, orientation)
    name = _read_id(item.get("id"), f"{place}.id") or f"{kind.name}{len(tree)}"
    return Module(name, kind.name, parent, slot, orientation, rgb, *pose, changed, params, kind)


def _read_type(
    name: object, place: str, modules: Mapping[str, ModuleType], is_root: bool
) -> ModuleType:
    """The type of a module; a core must be the root, and any other type must not."""
    kind = modules.get(name) if isinstance(name, str) else None
    if kind is not None and (kind.mount is None) == is_root:
        return kind
    names = sorted(n for n, k in modules.items() if (k.mount is None) == is_root)
    hint = " (the root is a core)" if is_root else " (a core is always the root)"
    raise InputError(
        f"{place}.type: expected one of {', '.join(names)}{'' if kind is None else hint}; "
        f"found {'none' if name is None else show(name)}"
    )


def _read_children(item: dict[str, Any], place: str, module: Module) -> dict[int, Any]:
    """Children by slot number, in the file's order."""
    children = item.get("children")
    if children is None:
        return {}
    place = f"{place}.children"
    found: dict[int, Any] = {}
    if not isinstance(children, dict):
        children = read(_Children, children, place)
    for key, child in children.items():
        number = read_slot(key, module.kind, place)
        if number in found:
            raise InputError(place, "each slot once", f"slot {number} twice")
        found[number] = child
    return found


def read_slot(value: object, kind: ModuleType, place: str) -> int:
    """The number of one of a type's slots.

    Args:
        value: what the user gave: a number, or one written as text.
        kind: the type of module.
        place: where, for the message.

    Returns:
        The number.

    Raises:
        InputError: the type has no such slot.
    """
    number = value
    if isinstance(value, np.integer) or (
        isinstance(value, str) and re.fullmatch(r"[0-9]{1,9}", value)
    ):
        number = int(value)
    if isinstance(number, int) and not isinstance(number, bool) and number in kind.slots:
        return number
    wanted = f"one of the slots {', '.join(map(str, sorted(kind.slots)))} of type {kind.name}"
    if not kind.slots:
        wanted = f"none, since type {kind.name} has no slots"
    elif number == 0 and 0 not in kind.slots:
        wanted += " (slot 0 is where it is attached)"
    raise InputError(place, wanted, show(value))


def _read_id(value: object, place: str) -> str:
    """A name, or "" where there is none."""
    if value is None:
        return ""
    if isinstance(value, bool | dict | list):
        raise InputError(
            f"{place}: expected a name or a number (YAML reads yes, no, on, off as true or false: "
            f"put them in quotes); found {show(value)}"
        )
    try:
        name = str(value)
    except ValueError:
        raise InputError(place, "a name or a number", show(value)) from None
    # Names appear in XML, HTML pages and terminals; line breaks and tabs are safe in all of them.
    if not name.replace("\n", "").replace("\t", "").isprintable():
        raise InputError(place, "printable characters", show(value))
    return name


def read_orientation(value: object, place: str) -> float:
    """A module's turn.

    Args:
        value: what the user gave; None is 0.
        place: where, for the message.

    Returns:
        The angle [deg].

    Raises:
        InputError: it is no quarter turn.
    """
    if value is None:  # Revolve itself writes `orientation: null`
        return 0.0
    angle, known = read_number(value), (0, 90, 180, 270, -90, -180, -270)
    number = isinstance(angle, int | float | np.integer) and not isinstance(angle, bool)
    if not number or angle not in known:
        raise InputError(place, "0, 90, 180, 270 or -90 [deg]", show(value))
    return float(angle)


def _read_params(
    params: object, place: str
) -> tuple[tuple[float, float, float] | None, dict[str, Any]]:
    """The colour, and everything else with the overrides checked."""
    if params is None:
        return None, {}
    if not isinstance(params, dict):
        raise InputError(place, "a mapping", show(params))
    rest = check_overrides(copy.deepcopy(params), place)
    levels = {key: rest.pop(key) for key in COLORS if key in rest}
    if not levels:
        return None, rest
    if len(levels) < 3:
        raise InputError(place, "red, green and blue, or none", f"{', '.join(levels)} only")
    return (levels["red"], levels["green"], levels["blue"]), rest


def _with_unique_names(modules: list[Module], source: str) -> tuple[Module, ...]:
    """The modules with unique names: suffixes for repeated names and for those of MuJoCo's own."""
    names = [m.name for m in modules]
    taken, seen = {*names, *RESERVED}, {*RESERVED}
    for i, name in enumerate(names):
        if name in seen:  # a later module's own name is not taken from it
            names[i] = free_name(name, taken)
        taken.add(names[i])
        seen.add(names[i])
    pairs = [(m.name, name) for m, name in zip(modules, names, strict=True) if m.name != name]
    if pairs:
        changed = ", ".join(f"{old} is now {new}" for old, new in pairs[:3])
        more = f", and {len(pairs) - 3} more" if pairs[3:] else ""
        note(f"{source}: ids that repeat, or that MuJoCo needs, are changed: {changed}{more}")
    return tuple(
        m if m.name == name else replace(m, name=name)
        for m, name in zip(modules, names, strict=True)
    )


def trim_neutral(morphology: Morphology, density: float) -> Morphology:
    """Gives the core the electronics volume with which the robot neither sinks nor floats.

    Args:
        morphology: a robot that, without electronics in its core, is heavier than the water that
            it displaces. The core's electronics volume is replaced.
        density: of the water [kg/m³].

    Returns:
        The same robot with `density * volume == mass` (to rounding), parts that the water does not
        lift left out of the volume; saving keeps it.

    Raises:
        InputError: the robot floats, or the water does not lift its core: no added volume can trim
            it.
    """
    density = read(Annotated[Positive, Unit("kg/m3")], density, "density")
    core = morphology.modules[0]
    if max(core.kind.parts, key=lambda part: part.volume).buoyancy == "off":  # has the electronics
        raise InputError(
            f"{morphology.path or morphology.name}: expected a core that the water lifts, to be "
            "trimmed by its volume; found buoyancy off"
        )
    parts = [part for module in morphology.modules for part in module.kind.parts]
    dead = sum(part.total_volume - part.lifted_volume for part in parts)
    inside = sum(p.electronics_volume for p in core.kind.parts if p.buoyancy != "off")
    total = morphology.mass / density - (morphology.volume - dead - inside)
    if total < -1e-9 * morphology.volume:  # neutral to rounding counts as neutral
        raise InputError(
            f"{morphology.path or morphology.name}: expected a robot that sinks in water of "
            f"{density:g} kg/m3 and can be trimmed by adding volume; found one that floats: its "
            f"modules displace {-total:.4g} m3 too much (params: ballast of "
            f"{-total * density:.4g} kg would do)"
        )
    added = {"electronics_volume": max(total, 0.0)}
    core = replace(core, kind=apply_overrides(core.kind, added), params={**core.params, **added})
    return replace(morphology, modules=(core, *morphology.modules[1:]))
