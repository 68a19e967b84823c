"""The catalogue of module types, and users' own.

Users add their own types in YAML with `load_modules` and merge them:
`MODULES | load_modules("my_modules.yaml")`.

Frames follow Revolve: core and brick look along +y, hinge and touch sensor along +x. Slots are
0 back (-y, where a brick is attached), 1 front (+y), 2 (+x) and 3 (-x); a hinge has slot 1 only.

Sources: boxes, masses, attachment faces, offsets and the servo's limits are those of Revolve
(github.com/ci-group/revolve, `pyrevolve/revolve_bot/revolve_module.py` and the SDF it writes);
mesh volumes are those of RoboGen's meshes as the thesis tabulates them (Table 1).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.boxes import union_measure
from mjx_revolve.errors import InputError, load_yaml
from mjx_revolve.module_types import Box, Hinge, ModuleType, Mount, Part, Slot, Vector, show

__all__ = [
    "MODULES",
    "THESIS_MODULES",
    "Box",
    "Hinge",
    "ModuleType",
    "Mount",
    "Part",
    "Slot",
    "load_modules",
]


# ------------------------------------------------------------------------- the catalogue


def _with_aliases(*kinds: ModuleType) -> dict[str, ModuleType]:
    return {name: kind for kind in kinds for name in (kind.name, *kind.aliases)}


def _level_slots(reach: float) -> dict[int, Slot]:
    """Revolve's numbers of the four level faces, `reach` m from the centre."""
    directions = {0: (0, -1, 0), 1: (0, 1, 0), 2: (1, 0, 0), 3: (-1, 0, 0)}
    return {
        number: Slot((reach * d[0], reach * d[1], reach * d[2]), d)
        for number, d in directions.items()
    }


_CORE_REACH = 0.0445  # Revolve: half the core's edge
_BRICK_REACH = 0.019  # Revolve: SLOT_COORDINATES; the collision box stands 1.5 mm proud of it

_CORE = ModuleType(
    name="Core",
    aliases=("CoreComponent",),  # the name in Revolve's own code
    parts=(Part("core", (Box((0.089, 0.089, 0.045)),), mass=0.0900, volume=5.054e-5),),
    slots=_level_slots(_CORE_REACH),
)

_BRICK = ModuleType(
    name="FixedBrick",
    parts=(Part("brick", (Box((0.041, 0.041, 0.0355)),), mass=0.0102, volume=1.070e-5),),
    mount=Mount((0.0, -_BRICK_REACH, 0.0), (0.0, 1.0, 0.0)),
    slots={number: slot for number, slot in _level_slots(_BRICK_REACH).items() if number != 0},
)

# Places along the hinge's x, from the centre of its frame box, as in Revolve's SDF of the spider
# (there from the core's centre, .0555 m further).
_HINGE_ANCHOR = 0.00465  # .06015 - .0555
_SERVO = 0.015525  # .071025 - .0555
_PLATE = 0.01175  # from the servo's centre: COLLISION_BOX_SERVO_2 and its translation
_FRAME_BACK = 0.011  # half the frame box
_SERVO_FRONT = _SERVO + 0.01225  # half the servo box

_HINGE = ModuleType(
    name="ActiveHinge",
    parts=(
        Part("frame", (Box((0.022, 0.03575, 0.010)),), mass=0.0017, volume=3.032e-6),
        Part(
            "servo",
            # The plate weighs nothing in Revolve; its mass is the servo holder's.
            (Box((0.0245, 0.02575, 0.015)), Box((0.001, 0.034, 0.034), (_PLATE, 0.001, 0.0))),
            mass=0.0090,
            volume=1.014e-5,
            position=(_SERVO, 0.0, 0.0),
        ),
    ),
    mount=Mount((-_FRAME_BACK, 0.0, 0.0), (1.0, 0.0, 0.0)),
    slots={1: Slot((_SERVO_FRONT, 0.0, 0.0), (1.0, 0.0, 0.0))},
    hinge=Hinge(
        axis=(0.0, 1.0, 0.0),
        anchor=(_HINGE_ANCHOR, 0.0, 0.0),
        range=(-math.pi / 4, math.pi / 4),  # Revolve, SDF/joint.py
        effort=0.17658,  # ditto
        speed=5.235988,  # ditto
    ),
)

# Revolve gives no pose to its touch sensor; that the thin side looks outwards is a choice. Revolve
# names a FixedBrickSensor but never implemented it; reading it as a touch sensor is a choice too.
_TOUCH_SENSOR = ModuleType(
    name="TouchSensor",
    aliases=("FixedBrickSensor",),
    parts=(Part("sensor", (Box((0.0041, 0.031, 0.0155)),), mass=0.0030, volume=2.735e-6),),
    mount=Mount((-0.00205, 0.0, 0.0), (1.0, 0.0, 0.0)),
    sensor=True,
)

MODULES: dict[str, ModuleType] = _with_aliases(_CORE, _BRICK, _HINGE, _TOUCH_SENSOR)
"""The catalogue by name and alias: the values of Revolve's code."""

# The thesis's Table 1 prints the two hinge masses the other way round. It also gives the touch
# sensor the brick's box; that is not taken over, since it says nowhere how such a box is attached.
THESIS_MODULES: dict[str, ModuleType] = MODULES | _with_aliases(
    replace(
        _HINGE,
        parts=(replace(_HINGE.parts[0], mass=0.009), replace(_HINGE.parts[1], mass=0.0017)),
    )
)
"""The catalogue with the hinge masses of the thesis's Table 1."""


# ------------------------------------------------------------------------- users' own types


def load_modules(path: str | Path) -> dict[str, ModuleType]:
    """Reads module types from YAML.

    A file looks like this (SI units; three numbers are x, y, z in the module's or part's frame)::

        modules:
          Fin:
            mount: -x                # or {position: [...], outward: [1, 0, 0]}; null: a core
            hinge:                   # leave out for a rigid module
              axis: [0, 1, 0]
              anchor: [0.00465, 0, 0]
              range: [-0.6, 0.6]                  # rad; default ±π/4, as Revolve's servo
              effort: 0.17658                     # N·m; default Revolve's servo
              speed: 5.235988                     # rad/s; default Revolve's servo
            parts:
              - name: holder                      # default: part0, part1, ...
                size: [0.022, 0.036, 0.010]       # a single box; or `boxes`
                mass: 0.002
              - name: blade
                position: [0.04, 0, 0]            # default [0, 0, 0]
                boxes:                            # the first is the main box, at [0, 0, 0]
                  - size: [0.06, 0.04, 0.002]
                  - {size: [0.002, 0.04, 0.01], position: [0.03, 0, 0]}
                mass: 0.006
                volume: 4.0e-6                    # default: that of the boxes, solid
                electronics_volume: 0.0           # default
                center_of_volume: [0, 0, 0]       # default
                drag_coefficient: 1.05            # default
                added_mass_coefficient: 1.0       # default
                contact: true                     # default
            slots:                   # default: none
              1: +x                  # or {position: [...], direction: [...], up: [0, 0, 1]}
            sensor: false            # default
            aliases: [Flipper]       # default: those of the catalogue's type of that name, if any

    `-x`, `+y` and so on name a level face of a main box: of the first part for `mount`, and for
    `slots` of the last part with a hinge, of the first without. Unknown keys are refused.

    Args:
        path: the file.

    Returns:
        The types by name and alias, to be merged: `MODULES | load_modules(path)`.

    Raises:
        InputError: the file cannot be read or something in it is wrong; the message says where.
    """
    data = _check_keys(load_yaml(path), str(path), ("modules",))
    table = data["modules"]
    if not isinstance(table, dict) or not table:
        raise InputError(
            f"{path}: modules: expected a mapping from names to module types; found {show(table)}"
        )
    kinds: dict[str, ModuleType] = {}
    for name, item in table.items():
        if not isinstance(name, str):
            raise InputError(f"{path}: modules: expected names of types; found {show(name)}")
        kind = _read_type(name, item, f"{path}: modules.{name}")
        for key in (kind.name, *kind.aliases):
            if key in kinds:
                raise InputError(
                    f"{path}: modules.{name}: expected each name and alias once; found {key} twice"
                )
            kinds[key] = kind
    return kinds


def _check_keys(
    item: Any, place: str, required: Sequence[str], optional: Sequence[str] = ()
) -> dict[str, Any]:
    """A mapping that has all of `required` and nothing beyond `optional`."""
    known = (*required, *optional)
    if not isinstance(item, dict):
        raise InputError(f"{place}: expected a mapping with {', '.join(known)}; found {show(item)}")
    for key in item:
        if key not in known:
            raise InputError(f"{place}: expected only {', '.join(known)}; found {show(key)}")
    for key in required:
        if key not in item:
            raise InputError(f"{place}: expected the key {key}; found none")
    return item


def _make(kind: Callable[..., Any], place: str, **values: Any) -> Any:
    """Builds a value; its message gets the place in the file in front."""
    try:
        return kind(**values)
    except InputError as error:
        raise InputError(f"{place}: {error}") from None


def _read_type(name: Any, item: Any, place: str) -> ModuleType:
    _check_keys(item, place, ("parts", "mount"), ("slots", "hinge", "sensor", "aliases"))
    listed = item["parts"]
    if not isinstance(listed, list) or not listed:
        raise InputError(f"{place}.parts: expected a list of parts; found {show(listed)}")
    parts = [_read_part(part, i, f"{place}.parts.{i}") for i, part in enumerate(listed)]
    hinge = item.get("hinge")
    if hinge is not None:
        servo = _HINGE.hinge
        assert servo is not None
        usual = {"range": servo.range, "effort": servo.effort, "speed": servo.speed}
        _check_keys(hinge, f"{place}.hinge", ("axis", "anchor"), tuple(usual))
        hinge = _make(Hinge, place, **(usual | hinge))
    slots = item.get("slots") or {}
    if not isinstance(slots, dict):
        raise InputError(
            f"{place}.slots: expected a mapping from numbers to faces; found {show(slots)}"
        )
    holder = parts[-1] if hinge is not None else parts[0]
    usual_aliases = MODULES[name].aliases if name in MODULES else ()
    aliases = item.get("aliases", usual_aliases)
    if not isinstance(aliases, list | tuple):
        raise InputError(f"{place}.aliases: expected a list of names; found {show(aliases)}")
    return _make(
        ModuleType,
        place,
        name=name,
        parts=tuple(parts),
        mount=_read_mount(item["mount"], parts[0], f"{place}.mount"),
        slots={key: _read_slot(s, holder, f"{place}.slots.{key}") for key, s in slots.items()},
        hinge=hinge,
        sensor=item.get("sensor", False),
        aliases=tuple(aliases),
    )


def _read_part(item: Any, index: int, place: str) -> Part:
    sized = ("size", "boxes")
    plain = tuple(f.name for f in fields(Part) if f.name not in ("mass", *sized))
    _check_keys(item, place, ("mass",), (*sized, *plain))
    if ("size" in item) == ("boxes" in item):
        raise InputError(f"{place}: expected one of size and boxes; found both or neither")
    listed = item.get("boxes", [{"size": item.get("size")}])
    if not isinstance(listed, list) or not listed:
        raise InputError(f"{place}.boxes: expected a list of boxes; found {show(listed)}")
    boxes = []
    for i, box in enumerate(listed):
        at = f"{place}.boxes.{i}" if "boxes" in item else place
        boxes.append(_make(Box, at, **_check_keys(box, at, ("size",), ("position",))))
    center = np.array([box.position for box in boxes])
    half = np.array([box.size for box in boxes]) / 2
    values = {"name": f"part{index}", "volume": union_measure(center - half, center + half)}
    values |= {key: item[key] for key in (*plain, "mass") if key in item}
    return _make(Part, place, boxes=tuple(boxes), **values)


def _read_face(text: str, part: Part, place: str) -> tuple[Vector, Vector]:
    """Centre of a level face of a part's main box, module frame [m], and its outward normal."""
    if not re.fullmatch(r"[-+]?[xy]", text):
        raise InputError(
            f"{place}: expected -x, +x, -y, +y or a mapping with position; found {show(text)}"
        )
    normal = [0.0, 0.0, 0.0]
    axis = "xy".index(text[-1])
    normal[axis] = -1.0 if text[0] == "-" else 1.0
    position = list(part.position)
    position[axis] += normal[axis] * part.boxes[0].size[axis] / 2
    return (position[0], position[1], position[2]), (normal[0], normal[1], normal[2])


def _read_mount(item: Any, part: Part, place: str) -> Mount | None:
    if item is None:
        return None
    if isinstance(item, str):
        position, (x, y, z) = _read_face(item, part, place)
        return Mount(position, (-x, -y, -z))
    return _make(Mount, place, **_check_keys(item, place, ("position", "outward")))


def _read_slot(item: Any, part: Part, place: str) -> Slot:
    if isinstance(item, str):
        return Slot(*_read_face(item, part, place))
    return _make(Slot, place, **_check_keys(item, place, ("position", "direction"), ("up",)))
