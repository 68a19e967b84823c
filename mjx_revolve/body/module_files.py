"""Module types as users write them in YAML; `catalogue.load_modules` shows how."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from annotated_types import MaxLen, MinLen

from mjx_revolve.body.boxes import union_measure
from mjx_revolve.body.module_types import (
    Box,
    Hinge,
    ModuleType,
    Mount,
    Name,
    Part,
    Slot,
    Vector,
    box_corners,
)
from mjx_revolve.body.sensors import SensorRow
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.schema import Boolean, TupleOf, checked, read, words

# Boxes of a part: the memory for their union grows with the cube of their number, 70 MB here.
_MAX_BOXES = 100


@checked
class _File:
    """A file of module types, by name."""

    modules: Annotated[dict[Name, Any], MinLen(1), words("a mapping from names to module types")]


@checked
class _Written:
    """A module type. Its parts may be single boxes, its mount and slots names of faces."""

    parts: Annotated[TupleOf[dict[str, Any]], MinLen(1), words("a list of parts")]
    mount: Annotated[Any, words("a face such as -x, a mapping with position, or null for a core")]
    slots: Annotated[dict[Any, Any], words("a mapping from numbers to faces")] | None = None
    hinge: Hinge | None = None
    sensor: Boolean = False
    aliases: Annotated[TupleOf[Name], words("a list of names")] | None = None
    sensors: SensorRow = ()


def read_modules(data: object, usual: Mapping[str, ModuleType]) -> dict[str, ModuleType]:
    """Reads what a file of module types holds.

    Args:
        data: the file's values.
        usual: types with aliases, which a type of the same name inherits unless it gives its own.

    Returns:
        The types by name and alias.

    Raises:
        InputError: something in it is wrong; the message says where.
    """
    kinds: dict[str, ModuleType] = {}
    written = read(_File, data).modules
    for name, item in written.items():
        place = f"modules.{name}"
        # What is a type in this file is no alias of another one, nor of itself.
        aliases = usual[name].aliases if name in usual else ()
        kind = _read_type(name, item, [x for x in aliases if x not in written], place)
        for key in (kind.name, *kind.aliases):
            if key in kinds:
                raise InputError(place, "each name and alias once", f"{key} twice")
            kinds[key] = kind
    return kinds


def _read_type(name: str, item: object, aliases: Sequence[str], place: str) -> ModuleType:
    written = read(_Written, item, place)
    parts = [_read_part(part, i, f"{place}.parts.{i}") for i, part in enumerate(written.parts)]
    holder = parts[0] if written.hinge is None else parts[-1]
    slots = {
        key: _read_slot(slot, holder, f"{place}.slots.{key}")
        for key, slot in (written.slots or {}).items()
    }
    values = {
        "name": name,
        "parts": parts,
        "mount": _read_mount(written.mount, parts[0], f"{place}.mount"),
        "slots": slots,
        "hinge": written.hinge,
        "sensor": written.sensor,
        "aliases": aliases if written.aliases is None else written.aliases,
        "sensors": written.sensors,
    }
    return read(ModuleType, values, place)


def _read_part(item: dict[str, Any], index: int, place: str) -> Part:
    if ("size" in item) == ("boxes" in item):
        raise InputError(place, "one of size and boxes", "both or neither")
    rest = {key: value for key, value in item.items() if key not in ("size", "boxes")}
    if "size" in item:
        boxes = (read(Box, {"size": item["size"]}, place),)
    else:
        several = Annotated[
            TupleOf[Box], MinLen(1), MaxLen(_MAX_BOXES), words(f"a list of 1 to {_MAX_BOXES} boxes")
        ]
        boxes = read(several, item["boxes"], f"{place}.boxes")
    solid = union_measure(*box_corners(boxes))
    return read(Part, {"name": f"part{index}", "volume": solid, "boxes": boxes} | rest, place)


def _read_face(text: str, part: Part, place: str) -> tuple[Vector, Vector]:
    """Centre of a level face of a part's main box, module frame [m], and its outward normal."""
    if not re.fullmatch(r"[-+]?[xy]", text):
        raise InputError(place, "-x, +x, -y, +y or a mapping with position", show(text))
    normal, position = [0.0, 0.0, 0.0], list(part.position)
    axis = "xy".index(text[-1])
    normal[axis] = -1.0 if text[0] == "-" else 1.0
    position[axis] += normal[axis] * part.boxes[0].size[axis] / 2
    return (position[0], position[1], position[2]), (normal[0], normal[1], normal[2])


def _read_mount(item: object, part: Part, place: str) -> Mount | None:
    if not isinstance(item, str):
        return read(Mount | None, item, place)
    position, (x, y, z) = _read_face(item, part, place)
    return Mount(position, (-x, -y, -z))


def _read_slot(item: object, part: Part, place: str) -> Slot:
    if not isinstance(item, str):
        return read(Slot, item, place)
    return Slot(*_read_face(item, part, place))
