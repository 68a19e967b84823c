"""The world a robot swims in: water, gravity, surface, bed, current. Knows nothing of robots.

A world is one small frozen value, read from a small YAML file. The two worlds of the thesis are in
`mjx_revolve/worlds/`; users write their own and name the file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mjx_revolve.errors import InputError, load_yaml
from mjx_revolve.terrain import Bed

BUOYANCY = ("partial", "mask", "off")
DRAG = ("faces", "lift_drag", "inertia_box", "ellipsoid", "off")

_FOLDER = Path(__file__).parent / "worlds"


def _or(names: Sequence[str]) -> str:
    return ", ".join(map(repr, names))


def _check_number(
    place: str, value: Any, low: float | None = None, high: float | None = None
) -> None:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise InputError(f"{place}: expected a number; found {value!r}")
    try:
        finite = math.isfinite(value)
    except OverflowError:  # an integer of more than 308 digits
        finite, value = False, "a huge integer"
    if not finite:
        raise InputError(f"{place}: expected a finite number; found {value!r}")
    if low is not None and value < low:
        raise InputError(f"{place}: expected at least {low:g}; found {value!r}")
    if high is not None and value > high:
        raise InputError(f"{place}: expected at most {high:g}; found {value!r}")


@dataclass(frozen=True)
class LiftDrag:
    """Parameters of Gazebo's LiftDrag plugin for one plate (world option `drag: lift_drag`).

    Attributes:
        a0: angle of attack at zero lift [rad].
        cla: lift slope before the stall [1/rad].
        cda: drag slope before the stall [1/rad].
        alpha_stall: stall angle [rad].
        cla_stall: lift slope after the stall [1/rad].
        cda_stall: drag slope after the stall [1/rad].

    The plugin's moment slope (`cma`) and centre of pressure (`cp`, here the box's centre) are not
    modelled.
    """

    a0: float = 0.0
    cla: float = 1.0
    cda: float = 0.01
    alpha_stall: float = math.pi / 2
    cla_stall: float = 0.0
    cda_stall: float = 1.0

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            _check_number(f"lift_drag.{field.name}", getattr(self, field.name))


@dataclass(frozen=True)
class World:
    """Water, gravity, surface, bed and current, and which fluid laws act.

    Attributes:
        name: what it is called.
        density: of the water [kg/m³]. 999.1026 at 15 °C is the thesis's value.
        viscosity: dynamic, of the water [Pa·s]; only MuJoCo's two laws use it. 1.138e-3 at 15 °C.
        gravity: downwards [m/s²].
        surface_height: z of the water surface, world frame [m].
        current: velocity of the water, world frame [m/s], length 3.
        bed: the ground, or None.
        buoyancy: "partial" (submerged share of each module's box), "mask" (the thesis: all or
            nothing by the box's centre) or "off".
        drag: "faces" (quadratic, on the modules' true faces, and angular), "lift_drag" (Gazebo's
            plugin on each module as a plate), "inertia_box" or "ellipsoid" (MuJoCo's laws), "off".
        added_mass: whether the water that a module carries along is part of its inertia.
        lift_drag: parameters of `drag: lift_drag`.
        timestep: of the simulation [s].
    """

    name: str = "water"
    density: float = 999.1026
    viscosity: float = 1.138e-3
    gravity: float = 9.81
    surface_height: float = 0.0
    current: tuple[float, float, float] = (0.0, 0.0, 0.0)
    bed: Bed | None = None
    buoyancy: str = "partial"
    drag: str = "faces"
    added_mass: bool = True
    lift_drag: LiftDrag = LiftDrag()
    timestep: float = 0.005

    def __post_init__(self) -> None:
        _check_number("density", self.density, low=0.0)
        _check_number("viscosity", self.viscosity, low=0.0)
        _check_number("gravity", self.gravity, low=0.0)
        _check_number("surface_height", self.surface_height)
        _check_number("timestep", self.timestep, low=1e-5, high=0.1)
        for axis, value in zip("xyz", self.current, strict=True):
            _check_number(f"current.{axis}", value)
        if self.buoyancy not in BUOYANCY:
            raise InputError(f"buoyancy: expected one of {_or(BUOYANCY)}; found {self.buoyancy!r}")
        if self.drag not in DRAG:
            raise InputError(f"drag: expected one of {_or(DRAG)}; found {self.drag!r}")
        if not isinstance(self.added_mass, bool):
            raise InputError(f"added_mass: expected true or false; found {self.added_mass!r}")
        if not isinstance(self.name, str) or not self.name:
            raise InputError(f"name: expected a text; found {self.name!r}")


def _read_gravity(value: Any) -> Any:
    """Accepts MuJoCo's and Gazebo's vector (0, 0, -g) beside the plain number g."""
    if isinstance(value, str) or not isinstance(value, Sequence):
        return value
    if len(value) != 3 or any(isinstance(v, str | bool) for v in value):
        raise InputError(f"gravity: expected a number or 3 numbers; found {list(value)!r}")
    if value[0] != 0 or value[1] != 0 or value[2] > 0:
        raise InputError(f"gravity: expected (0, 0, -g), the surface is level; found {value!r}")
    return -float(value[2])


def _read_vector(place: str, value: Any) -> tuple[float, ...]:
    try:
        vector = tuple(value) if not isinstance(value, str) else None
    except TypeError:
        vector = None
    if vector is None or len(vector) != 3:
        raise InputError(f"{place}: expected 3 numbers; found {value!r}")
    for axis, v in zip("xyz", vector, strict=True):
        if hasattr(v, "item"):
            v = v.item()
        _check_number(f"{place}.{axis}", v)
    return tuple(float(v) for v in vector)


def _read_part(place: str, value: Any, kind: type) -> Any:
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: expected a mapping; found {value!r}")
    known = [field.name for field in dataclasses.fields(kind)]
    for name in value:
        if name not in known:
            raise InputError(f"{place}: expected one of {', '.join(known)}; found {name!r}")
    return kind(**value)


def _read_bed(value: Any) -> Bed | None:
    if value is None or value == "off" or value is False:
        return None
    if hasattr(value, "item") and not getattr(value, "shape", ()):
        value = value.item()
    if isinstance(value, int | float) and not isinstance(value, bool):
        _check_number("bed", value)
        return Bed(kind="flat", height=float(value))
    if not isinstance(value, Bed | Mapping):
        raise InputError(
            f"bed: expected 'off', a height in metres or a mapping with kind; found {value!r}"
        )
    return _read_part("bed", value, Bed)


def make_world(**fields: Any) -> World:
    """Builds a world from loosely typed fields (lists for vectors, mappings for parts).

    Args:
        **fields: the fields of `World`; `gravity` also as (0, 0, -g); `bed` also as a height [m],
            "off" or a mapping; `current` any sequence of 3.

    Returns:
        The world.

    Raises:
        InputError: an unknown field or a value out of range.
    """
    known = [field.name for field in dataclasses.fields(World)]
    for name in fields:
        if name not in known:
            raise InputError(f"{name}: expected one of {', '.join(known)}; found {name!r}")
    values = dict(fields)
    for name in ("density", "viscosity", "surface_height", "timestep", "gravity"):
        if hasattr(values.get(name), "item") and not hasattr(values[name], "__len__"):
            values[name] = values[name].item()
    if "gravity" in values:
        if hasattr(values["gravity"], "tolist"):
            values["gravity"] = values["gravity"].tolist()
        values["gravity"] = _read_gravity(values["gravity"])
    if "current" in values:
        values["current"] = _read_vector("current", values["current"])
    if "bed" in values:
        values["bed"] = _read_bed(values["bed"])
    # YAML 1.1 reads a bare `off` as False.
    for name in ("buoyancy", "drag"):
        if values.get(name) is False:
            values[name] = "off"
    if "lift_drag" in values:
        values["lift_drag"] = _read_part("lift_drag", values["lift_drag"], LiftDrag)
    return World(**values)


def load_world(name: str | Path, **overrides: Any) -> World:
    """Reads a world by name or from a YAML file.

    Args:
        name: "empty_underwater", "lake", or the path of a YAML file with fields of `World`.
        **overrides: fields that replace those of the file; a mapping (`bed`, `lift_drag`) replaces
            what it names, a bed of another `kind` the whole bed.

    Returns:
        The world.

    Raises:
        InputError: no such world, an unknown field, or a value out of range; the message names
            the file and the field.
    """
    names = sorted(path.stem for path in _FOLDER.glob("*.yaml"))
    if not isinstance(name, str | Path):
        raise InputError(f"world: expected a name or a path; found {name!r}")
    path = _FOLDER / f"{name}.yaml" if str(name) in names else Path(name)
    if not path.exists() and path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"world: expected one of {', '.join(names)} or a YAML file; found {str(name)!r}"
        )
    data = load_yaml(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a mapping of world fields; found {data!r}")
    for key in data:
        if not isinstance(key, str):
            raise InputError(f"{path}: expected names of world fields; found {key!r}")
    fields: dict[str, Any] = {"name": path.stem} | data
    try:
        world = make_world(**fields)
    except InputError as error:
        raise InputError(f"{path}: {error}") from None
    if not overrides:
        return world
    for key, value in overrides.items():
        # A mapping changes what it names and keeps the rest: a bed's friction, not its whole shape.
        below = fields.get(key)
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            alike = value.get("kind", below.get("kind")) == below.get("kind")
            overrides[key] = {**below, **value} if alike else value
    try:
        return make_world(**fields | overrides)
    except InputError as error:
        raise InputError(f"world {world.name}: {error}") from None
