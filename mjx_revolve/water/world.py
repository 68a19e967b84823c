"""The world a robot swims in: water, gravity, surface, bed, current. Knows nothing of robots.

A world is one small frozen value, read from a small YAML file. The two worlds of the thesis are in
`mjx_revolve/water/worlds/`; users write their own and name the file.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from annotated_types import Ge, Le, MinLen, Unit
from pydantic import BeforeValidator, InstanceOf, ValidationInfo

from mjx_revolve.inputs.errors import ConstraintError, InputError, note, reading, show
from mjx_revolve.inputs.files import check_path, path_inside, read_file
from mjx_revolve.inputs.schema import (
    OFF,
    ONE,
    Boolean,
    NonNegative,
    Number,
    OrOff,
    Text,
    TupleOf,
    Vector,
    also,
    as_tuple,
    checked,
    is_off,
    read,
    words,
)
from mjx_revolve.inputs.shipped import list_shipped
from mjx_revolve.inputs.yaml_reader import dump_yaml, load_yaml
from mjx_revolve.water.bed import Bed
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.currents import (
    CurrentField,
    Gust,
    Shear,
    Wave,
    check_wave,
    find_field,
    load_current_field,
)
from mjx_revolve.water.law_names import (
    BuoyancyName,
    Coefficients,
    DragName,
    buoyancy_names,
    drag_names,
)
from mjx_revolve.water.plates import LiftDrag

_DENSITIES = 600, 1500  # of what robots can be meant to swim in [kg/m³]


@checked
class SurfaceTension:
    """Surface tension along the waterline; see `buoyancy.surface_tension`.

    Attributes:
        gamma: γ [N/m]; .0728 is that of clean water at 20 °C.
        contact_angle: between water and module, through the water [rad]; below π/2 it wets.
    """

    gamma: Annotated[Number, Ge(1e-6), Unit("N/m")] = TODAY["surface_tension"].value
    contact_angle: Annotated[Number, Ge(0), Le(math.pi), Unit("rad")] = 0.0


@also({"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3})
def _read_gravity(value: Any) -> Any:
    """MuJoCo's and Gazebo's vector (0, 0, -g) as the plain number g."""
    value = as_tuple(value)
    if not isinstance(value, tuple):
        return value
    plain = all(isinstance(x, int | float) and not isinstance(x, bool) for x in value)
    if not plain or len(value) != 3 or value[:2] != (0, 0) or value[2] > 0:
        down = "a number, or (0, 0, -g), since the surface is level [m/s2]"
        raise ConstraintError("", down, show(value))
    return -value[2]


@also(OFF, {"type": "number"})
def _read_bed(value: Any) -> Any:
    """A height as a flat bed at it."""
    if is_off(value):
        return None
    plain = isinstance(value, int | float | np.number) and not isinstance(value, bool)
    return {"height": value} if plain else value


@also(OFF, ONE)
def _read_waves(value: Any) -> Any:
    """One wave as a list of one."""
    if is_off(value):
        return ()
    return (value,) if isinstance(value, Wave | Mapping) else value


@also(OFF, {"type": "string"})
def _read_field(value: Any, info: ValidationInfo) -> Any:
    """Reads the file of a path, which, if relative, starts from the context's folder."""
    if is_off(value):
        return None
    if isinstance(value, CurrentField):
        return value
    if not isinstance(value, str | Path) or not str(value):
        raise ConstraintError("", "the path of a file", show(value))
    return load_current_field(find_field(value, info.context or Path()))


@also({"const": True})
def _read_tension(value: Any) -> Any:
    """`true` as that of clean water."""
    return {} if value is True else value


@checked
class World:
    """Water, gravity, surface, bed and current, and which fluid laws act.

    Attributes:
        name: what it is called.
        density: of the water [kg/m³]. 999.1026 at 15 °C is the thesis's value.
        viscosity: dynamic, of the water [Pa·s]; of MuJoCo's two laws, and of friction along
            chains, rods and fins. 1.138e-3 at 15 °C.
        gravity: downwards [m/s²].
        surface_height: z of the water surface, world frame [m].
        current: velocity of the water, world frame [m/s], length 3.
        bed: the ground, or None.
        buoyancy: name of a buoyancy law.
        drag: name of a drag law. `cross_flow` has those of chains, thin plates and fins in it, and
            that of faces for compact parts; `faces` has that for all.
        coefficients: of laws, by name, for modules that give none of their own.
        added_mass: whether the water that a module carries along is part of its inertia.
        near_surface: whether that water follows the draught of what floats, and is less close to
            the surface, and waves that parts radiate damp their heave and roll; false: it is the
            submerged share of what a part carries deep down, and no waves are made.
        lift_drag: parameters of `drag: lift_drag`; fins have their own.
        shear: a current that fades with depth, or None. All moving water adds up: current, shear,
            field, gust and waves.
        current_field: velocities on a grid (in YAML the path of an NPZ or CSV file), or None.
        gust: a current that wanders around the mean, or None.
        waves: regular waves on the surface, added up; each may not break by itself.
        water_depth: of the level bed that the waves feel, below the still surface [m]; None for
            deep water, where a wave is shorter than twice the depth.
        surface_tension: along the waterline, or None.
        self_contact: whether modules of one robot push each other apart, and hinges end where
            their neighbours meet; false: modules pass through each other.
        timestep: of the simulation [s].
    """

    name: Annotated[Text, MinLen(1)] = "water"
    density: Annotated[NonNegative, Unit("kg/m3")] = 999.1026
    viscosity: Annotated[NonNegative, Unit("Pa s")] = 1.138e-3
    gravity: Annotated[NonNegative, BeforeValidator(_read_gravity), Unit("m/s2")] = 9.81
    surface_height: Annotated[Number, Unit("m")] = 0.0
    current: Annotated[Vector, Unit("m/s")] = (0.0, 0.0, 0.0)
    bed: Annotated[
        Bed | None,
        BeforeValidator(_read_bed),
        words("'off', a height in metres or a mapping with kind"),
    ] = None
    buoyancy: Annotated[BuoyancyName, words(buoyancy_names())] = "partial"
    drag: Annotated[DragName, words(drag_names())] = "cross_flow"
    coefficients: Coefficients = ()
    added_mass: Boolean = True
    near_surface: Boolean = False
    lift_drag: LiftDrag = LiftDrag()
    shear: OrOff[Shear] = None
    current_field: Annotated[InstanceOf[CurrentField] | None, BeforeValidator(_read_field)] = None
    gust: OrOff[Gust] = None
    waves: Annotated[TupleOf[Wave], BeforeValidator(_read_waves)] = ()
    water_depth: Annotated[Number, Ge(1e-2), Unit("m")] | None = None
    surface_tension: Annotated[OrOff[SurfaceTension], BeforeValidator(_read_tension)] = None
    self_contact: Boolean = True
    timestep: Annotated[Number, Ge(1e-5), Le(0.1), Unit("s")] = 0.005

    def __repr__(self) -> str:
        """Its fields, which tell runs apart; later ones only where they are not as before."""
        values = ((field.name, getattr(self, field.name)) for field in dataclasses.fields(self))
        later = {"coefficients": (), "near_surface": False, "self_contact": False}
        shown = (f"{k}={v!r}" for k, v in values if k not in later or later[k] != v)
        return f"World({', '.join(shown)})"

    def __post_init__(self) -> None:
        """Checks that the waves fit the water."""
        for i, wave in enumerate(self.waves):
            check_wave(wave, self.gravity, self.water_depth, f"waves.{i}")


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
    return read(World, fields)


def load_world(name: str | Path, **overrides: Any) -> World:
    """Reads a world by name or from a YAML file.

    Args:
        name: "empty_underwater", "lake", or the path of a YAML file with fields of `World`.
        **overrides: fields that replace those of the file; a mapping (`bed`, `lift_drag`, `shear`,
            `gust`, `surface_tension`, one of `waves`) replaces what it names; a bed of another
            `kind`, or an amplitude with a length or period, the whole; see `make_world`.

    Returns:
        The world.

    Raises:
        InputError: no such world, an unknown field, or a value out of range; the message names
            the file and the field.
    """
    path = _find_world(name)
    data = load_yaml(path)
    with reading(path):
        if not isinstance(data, dict):
            raise InputError(f"expected a mapping of world fields; found {show(data)}")
        fields: dict[Any, Any] = {"name": path.stem} | data
        # A world file names its field's file from where it stands itself.
        world: World = read(World, fields, context=path.parent)
    for key, value in overrides.items():
        # A mapping changes what it names and keeps the rest: a bed's friction, not its whole shape.
        below = fields.get(key)
        if key == "bed" and isinstance(below, int | float) and not is_off(below):
            below = {"height": below}
        if isinstance(below, Mapping) and isinstance(value, Mapping):
            length = {"period", "wavelength"} & set(value)
            if key == "waves" and length:  # one stands for the other; with it, a wave may be whole
                below = {k: x for k, x in below.items() if k not in ("period", "wavelength")}
                below = {} if "amplitude" in value else below
            kind = below.get("kind", "flat")
            alike = value.get("kind", kind) == kind
            overrides[key] = {**below, **value} if alike else value
    if overrides:
        with reading(f"world {world.name}"):
            world = read(World, fields | {"current_field": world.current_field} | overrides)
    return _note_unread(_note_of_density(world))


def _find_world(name: str | Path) -> Path:
    """The file of a world."""
    if not isinstance(name, str | Path):
        raise InputError("world", "a name or a path", show(name))
    check_path(name)
    shipped = list_shipped("worlds")
    path = shipped.get(str(name), Path(name))
    if not path.exists() and path.suffix not in (".yaml", ".yml"):
        raise InputError("world", f"one of {', '.join(shipped)} or a YAML file", repr(str(name)))
    return path


def is_left_out(name: str | Path, field: str) -> bool:
    """Whether the file of a world leaves a field at its default; false where it cannot be read."""
    try:
        data = load_yaml(_find_world(name))
    except InputError:
        return False
    return isinstance(data, dict) and field not in data


def _note_of_density(world: World) -> World:
    """The world; a note where its density is that of no water (brines have up to 1,350 kg/m³)."""
    low, high = _DENSITIES
    if not low <= world.density <= high:
        note(
            f"world {world.name}: density: found {world.density:g} kg/m³, which is no water's "
            f"({low} to {high})"
        )
    return world


def _note_unread(world: World) -> World:
    """The world; notes of fields that change nothing beside the others.

    Where a module has a drag law of its own, that may still read some.
    """
    shear, chains = world.shear, ("cross_flow", "plate_wake", "fin_wake")
    unread = {
        "lift_drag is of drag: lift_drag and fin_wake, and fins have their own": (
            world.lift_drag != LiftDrag() and world.drag not in ("lift_drag", "fin_wake")
        ),
        f"coefficients are of drag: {', '.join(chains)}": (
            world.coefficients != () and world.drag not in chains
        ),
        "water_depth is of waves (the ground is bed)": (
            world.water_depth is not None and not world.waves
        ),
        "shear.exponent is of profile: power": (
            shear is not None and shear.profile != "power" and shear.exponent != Shear.exponent
        ),
        "near_surface is of added_mass": world.near_surface and not world.added_mass,
        "surface_tension acts with buoyancy: partial and mask": (
            world.surface_tension is not None and world.buoyancy == "off"
        ),
    }
    for why in (why for why, found in unread.items() if found):
        note(f"world {world.name}: no effect: {why}")
    return world


def read_world_files(path: str | Path) -> dict[str, bytes]:
    """The files that a world is made of, so that they can be moved together.

    Args:
        path: of the world's YAML.

    Returns:
        Contents by paths relative to a common folder: the YAML, and the file of its current field.
        A field that lies elsewhere is put beside the YAML, which then names it there.

    Raises:
        InputError: one of them cannot be read.
    """
    path = Path(path)
    content, data = read_file(path), load_yaml(path)
    named = data.get("current_field") if isinstance(data, dict) else None
    if not isinstance(named, str) or not named or is_off(named):
        return {path.name: content}
    with reading(path):
        field = read_file(find_field(named, path.parent))
    beside = path_inside(named)
    if beside != Path(named).as_posix():
        data["current_field"] = beside
        content = dump_yaml(data).encode()
    return {path.name: content, beside: field}
