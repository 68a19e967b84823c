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

import numpy as np

from mjx_revolve.body.plates import LiftDrag
from mjx_revolve.inputs.errors import InputError, load_yaml
from mjx_revolve.water.bed import Bed
from mjx_revolve.water.currents import (
    CurrentField,
    Gust,
    Shear,
    Wave,
    check_number,
    check_wave,
    find_field,
    listed,
    load_current_field,
    read_vector,
)

BUOYANCY = ("partial", "mask", "off")
DRAG = ("faces", "lift_drag", "inertia_box", "ellipsoid", "off")

_FOLDER = Path(__file__).parent / "worlds"


@dataclass(frozen=True)
class SurfaceTension:
    """Surface tension along the waterline; see `buoyancy.surface_tension`.

    Attributes:
        gamma: γ [N/m]; .0728 is that of clean water at 20 °C.
        contact_angle: between water and module, through the water [rad]; below π/2 it wets.
    """

    gamma: float = 0.0728
    contact_angle: float = 0.0

    def __post_init__(self) -> None:
        check_number("surface_tension.gamma", self.gamma, low=1e-6)
        check_number("surface_tension.contact_angle", self.contact_angle, low=0.0, high=math.pi)


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
        lift_drag: parameters of `drag: lift_drag`; fins have their own.
        shear: a current that fades with depth, or None. All moving water adds up: current, shear,
            field, gust and waves.
        current_field: velocities on a grid (in YAML the path of an NPZ or CSV file), or None.
        gust: a current that wanders around the mean, or None.
        waves: regular waves on the surface, added up; each may not break by itself.
        water_depth: of the level bed that the waves feel, below the still surface [m]; None for
            deep water, where a wave is shorter than twice the depth.
        surface_tension: along the waterline, or None.
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
    lift_drag: LiftDrag = dataclasses.field(default_factory=LiftDrag)
    shear: Shear | None = None
    current_field: CurrentField | None = None
    gust: Gust | None = None
    waves: tuple[Wave, ...] = ()
    water_depth: float | None = None
    surface_tension: SurfaceTension | None = None
    timestep: float = 0.005

    def __post_init__(self) -> None:
        check_number("density", self.density, low=0.0)
        check_number("viscosity", self.viscosity, low=0.0)
        check_number("gravity", self.gravity, low=0.0)
        check_number("surface_height", self.surface_height)
        check_number("timestep", self.timestep, low=1e-5, high=0.1)
        for axis, value in zip("xyz", self.current, strict=True):
            check_number(f"current.{axis}", value)
        if self.buoyancy not in BUOYANCY:
            raise InputError(
                f"buoyancy: expected one of {listed(BUOYANCY)}; found {self.buoyancy!r}"
            )
        if self.drag not in DRAG:
            raise InputError(f"drag: expected one of {listed(DRAG)}; found {self.drag!r}")
        if not isinstance(self.added_mass, bool):
            raise InputError(f"added_mass: expected true or false; found {self.added_mass!r}")
        if self.water_depth is not None:
            check_number("water_depth", self.water_depth, low=1e-2)
        for i, wave in enumerate(self.waves):
            try:
                check_wave(wave, self.gravity, self.water_depth)
            except InputError as error:
                raise InputError(_numbered(error, i)) from None
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


def _read_part(place: str, value: Any, kind: type) -> Any:
    if isinstance(value, kind):
        return value
    if not isinstance(value, Mapping):
        raise InputError(f"{place}: expected a mapping; found {value!r}")
    known = [field.name for field in dataclasses.fields(kind)]
    for name in value:
        if name not in known:
            raise InputError(f"{place}: expected one of {', '.join(known)}; found {name!r}")
    for field in dataclasses.fields(kind):
        required = field.default is dataclasses.MISSING
        if required and field.name not in value:
            raise InputError(f"{place}: expected {field.name}; found none")
    return kind(**{k: v.item() if isinstance(v, np.generic) else v for k, v in value.items()})


def _numbered(error: InputError, i: int) -> str:
    return str(error).replace("waves", f"waves.{i}", 1)


def _is_off(value: Any) -> bool:
    """Whether a value says that there is none: YAML 1.1 reads a bare `off` as False."""
    return value is None or value is False or (isinstance(value, str) and value == "off")


def _read_waves(value: Any) -> tuple[Wave, ...]:
    if _is_off(value):
        return ()
    if isinstance(value, Wave | Mapping):
        value = [value]
    if not isinstance(value, Sequence) or isinstance(value, str):
        raise InputError(f"waves: expected a list of mappings; found {value!r}")
    waves = []
    for i, item in enumerate(value):
        try:
            waves.append(_read_part("waves", item, Wave))
        except InputError as error:
            raise InputError(_numbered(error, i)) from None
    return tuple(waves)


def _read_field(value: Any, folder: Path) -> CurrentField | None:
    if _is_off(value):
        return None
    if isinstance(value, CurrentField):
        return value
    if not isinstance(value, str | Path) or not str(value):
        raise InputError(f"current_field: expected the path of a file; found {value!r}")
    try:
        return load_current_field(find_field(value, folder))
    except InputError as error:
        raise InputError(f"current_field: {error}") from None


def _read_bed(value: Any) -> Bed | None:
    if value is None or value == "off" or value is False:
        return None
    if hasattr(value, "item") and not getattr(value, "shape", ()):
        value = value.item()
    if isinstance(value, int | float) and not isinstance(value, bool):
        check_number("bed", value)
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
            "off" or a mapping; `current` any sequence of 3; `shear`, `gust` and `surface_tension`
            also as mappings, `waves` as a list of mappings or one, each also "off";
            `current_field` as a path, which, if relative, lies inside the current folder.

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
    for name in ("density", "viscosity", "surface_height", "timestep", "gravity", "water_depth"):
        if hasattr(values.get(name), "item") and not hasattr(values[name], "__len__"):
            values[name] = values[name].item()
    if "gravity" in values:
        if hasattr(values["gravity"], "tolist"):
            values["gravity"] = values["gravity"].tolist()
        values["gravity"] = _read_gravity(values["gravity"])
    if "current" in values:
        values["current"] = read_vector("current", values["current"])
    if "bed" in values:
        values["bed"] = _read_bed(values["bed"])
    # YAML 1.1 reads a bare `off` as False.
    for name in ("buoyancy", "drag"):
        if values.get(name) is False:
            values[name] = "off"
    if "lift_drag" in values:
        values["lift_drag"] = _read_part("lift_drag", values["lift_drag"], LiftDrag)
    for name, kind in (("shear", Shear), ("gust", Gust), ("surface_tension", SurfaceTension)):
        if name not in values:
            continue
        if _is_off(values[name]):
            values[name] = None
        elif name == "surface_tension" and values[name] is True:
            values[name] = SurfaceTension()
        else:
            values[name] = _read_part(name, values[name], kind)
    if "waves" in values:
        values["waves"] = _read_waves(values["waves"])
    if "current_field" in values:
        values["current_field"] = _read_field(values["current_field"], Path())
    return World(**values)


def load_world(name: str | Path, **overrides: Any) -> World:
    """Reads a world by name or from a YAML file.

    Args:
        name: "empty_underwater", "lake", or the path of a YAML file with fields of `World`.
        **overrides: fields that replace those of the file; a mapping (`bed`, `lift_drag`, `shear`,
            `gust`, `surface_tension`) replaces what it names, a bed of another `kind` the whole
            bed; see `make_world`.

    Returns:
        The world.

    Raises:
        InputError: no such world, an unknown field, or a value out of range; the message names
            the file and the field.
    """
    shipped = sorted(path.stem for path in _FOLDER.glob("*.yaml"))
    if not isinstance(name, str | Path):
        raise InputError(f"world: expected a name or a path; found {name!r}")
    path = _FOLDER / f"{name}.yaml" if str(name) in shipped else Path(name)
    if not path.exists() and path.suffix not in (".yaml", ".yml"):
        raise InputError(
            f"world: expected one of {', '.join(shipped)} or a YAML file; found {str(name)!r}"
        )
    data = load_yaml(path)
    if not isinstance(data, dict):
        raise InputError(f"{path}: expected a mapping of world fields; found {data!r}")
    for key in data:
        if not isinstance(key, str):
            raise InputError(f"{path}: expected names of world fields; found {key!r}")
    fields: dict[str, Any] = {"name": path.stem} | data
    try:
        if "current_field" in fields:
            # A world file names its field's file from where it stands itself.
            fields["current_field"] = _read_field(fields["current_field"], path.parent)
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
