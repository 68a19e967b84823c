"""What a law of the water is: a value that owns its numbers, its force, and what is said of it.

A drag law or a buoyancy law is one value in one dictionary (`drag.DRAG_LAWS`,
`buoyancy.BUOYANCY_LAWS`). World and module files, the step's tables, padding, `task.robust`, the
check of the time step, exporters and the tests read that value; nothing else lists laws.

A law's numbers are a `law_numbers` dataclass, one field for each number of a part. Its fields carry
a `PartField`: what the step does with the number is stated where the number is declared, and
nowhere else.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeVar, dataclass_transform

import numpy as np
from jaxtyping import Float

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.inertia import SpatialInertia
from mjx_revolve.numerics.lazy import jax
from mjx_revolve.numerics.spatial import ZERO, Scalar, Vec, mul

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

L = TypeVar("L")
T = TypeVar("T")

# ------------------------------------------------------------------------- numbers of a part


class PartField(NamedTuple):
    """What the tables of a step need to know of one number of a part.

    Attributes:
        unit: of the number.
        blank: its value in the part of no effect that pads tables, or a function of the world that
            gives it.
        axes: how it turns with the axes that describe the part: "vector" (components change their
            sign), "size" (they change places only), "matrix" (rows and columns turn) or "none" (a
            number, or already in the body's frame).
        varied: factors of `Variation` that multiply it.
        fixed: why no factor does; exactly one of `varied` and `fixed` is given.
    """

    unit: str
    blank: Any
    axes: Literal["vector", "size", "matrix", "none"]
    varied: tuple[str, ...]
    fixed: str


def part_field(
    unit: str,
    *,
    blank: Any = 0.0,
    axes: Literal["vector", "size", "matrix", "none"] = "none",
    varied: tuple[str, ...] = (),
    fixed: str = "",
    **field: Any,
) -> Any:
    """Declares a field of a `law_numbers` dataclass; see `PartField`.

    Raises:
        TypeError: neither or both of `varied` and `fixed`.
    """
    if bool(varied) == bool(fixed):
        raise TypeError("part_field: expected either varied=(...) or fixed='why not'")
    about = PartField(unit, blank, axes, varied, fixed)
    return dataclasses.field(metadata={"part": about}, **field)


@dataclass_transform(frozen_default=True, field_specifiers=(part_field, dataclasses.field))
def law_numbers(kind: type[T]) -> type[T]:
    """Makes a class a frozen dataclass and a pytree; fields that are no `part_field` are static.

    The class is registered with JAX by its first value: files that name laws are read without JAX.
    """
    made = dataclass(frozen=True)(kind)
    data = list(part_fields(made))
    static = [field.name for field in dataclasses.fields(made) if field.name not in data]  # type: ignore[arg-type]

    @functools.cache
    def register() -> None:
        jax.tree_util.register_dataclass(made, data_fields=data, meta_fields=static)

    def new(cls: type, *_: Any, **__: Any) -> Any:
        register()
        return object.__new__(cls)

    made.__new__ = new  # type: ignore[method-assign]
    return made


def part_fields(kind: type) -> dict[str, PartField]:
    """The numbers of a `law_numbers` dataclass, by name."""
    fields = dataclasses.fields(kind)
    return {field.name: field.metadata["part"] for field in fields if "part" in field.metadata}


def map_fields(fun: Callable[[PartField, Any], Any], numbers: Any) -> Any:
    """Applies `fun` to every number, with what its field says; into numbers inside numbers.

    Numbers of a law may stand in a dictionary by the law's name. None stays None.
    """
    if isinstance(numbers, dict):
        return {name: map_fields(fun, value) for name, value in numbers.items()}
    changed = {}
    for name, field in part_fields(type(numbers)).items():
        value = getattr(numbers, name)
        if dataclasses.is_dataclass(value) or isinstance(value, dict):
            changed[name] = map_fields(fun, value)
        elif value is not None:
            changed[name] = fun(field, value)
    return dataclasses.replace(numbers, **changed)


def scale_numbers(numbers: T, factors: Mapping[str, Scalar]) -> T:
    """Numbers of parts times the factors that their fields name; plain zeros stay so."""

    def scale(field: PartField, value: Any) -> Any:
        if not field.varied:
            return value
        factor = functools.reduce(operator.mul, (factors[name] for name in field.varied))
        return jax.tree.map(lambda x: mul(x, factor), value)

    return map_fields(scale, numbers)


def as_components(numbers: T) -> T:
    """Numbers `[..., 3]` along axes as tuples of three, as force functions take them."""

    def split(field: PartField, x: Any) -> Any:
        return x if field.axes == "none" else tuple(np.moveaxis(np.asarray(x), -1, 0))

    return map_fields(split, numbers)


@law_numbers
class NoNumbers:
    """The numbers of a law that needs none."""


# ------------------------------------------------------------------------- coefficients of users


@dataclass(frozen=True)
class Coefficient:
    """A number of a law that users give for a module or for a world.

    Attributes:
        name: its key.
        unit: its unit.
        meaning: one line of documentation.
        default: its value where it is not given.
        low: least value.
        high: greatest value.
        own_field: whether modules have a field of this name; others stand under `coefficients`.
        per_axis: whether it may be three numbers, one for each axis of a part.
        spread: by what factor, either way, it is not known (`docs/sensitivity.md`): the standard
            deviation of its logarithm, where it is fitted.
    """

    name: str
    unit: str
    meaning: str
    default: float
    low: float = 0.0
    high: float = math.inf
    own_field: bool = False
    per_axis: bool = False
    spread: float = 1.5

    def __post_init__(self) -> None:
        """Checks that it is documented."""
        if not self.meaning or not self.unit:
            raise TypeError(f"coefficient {self.name}: expected a meaning and a unit")


# ------------------------------------------------------------------------- laws


class Export(NamedTuple):
    """What a file format can say of a law.

    Attributes:
        stand_in: name of the law by which the other program's water comes nearest; "" for none.
        note: what the file's comment says of that.
        missing: what it says is lost.
    """

    stand_in: str
    note: str = ""
    missing: str = ""


@dataclass(frozen=True, eq=False)
class PartShapes:
    """What laws take their numbers from: n parts, each in its own frame; NumPy.

    Attributes:
        half_size: half edges of the boxes [m].
        silhouette: area of the part's boxes together, seen along each axis [m²].
        exposed: share of each pair of faces that the water reaches [-].
        joined: share that neighbours cover of the ends by which the part is in a row of parts [-];
            1 of a part that is a row by itself.
        ends: 1 or -1 along each axis where a row of parts ends with the part, in that direction;
            else 0.
        rows: length of that row [m].
        coefficients: `[n]` each, or `[n, 3]` per axis: every `Coefficient` of the laws, by name.
        parameters: `[n]` each: the parameters of laws that have a class of them, by the law's name.
        factors: `[n]` each: the parts' own factors, by the names that `PartField.varied` has.
    """

    half_size: Float[np.ndarray, "n 3"]
    silhouette: Float[np.ndarray, "n 3"]
    exposed: Float[np.ndarray, "n 3"]
    joined: Float[np.ndarray, "n 3"]
    ends: Float[np.ndarray, "n 3"]
    rows: Float[np.ndarray, "n 3"]
    coefficients: Mapping[str, Float[np.ndarray, "n ..."]]
    parameters: Mapping[str, tuple[Any, ...]]
    factors: Mapping[str, Float[np.ndarray, " n"]]


class PartFlow(NamedTuple):
    """How the water flows past parts, along the part's axes, `[npart, nbody, lanes]` each.

    Attributes:
        velocity: of the box's centre relative to the water (Fossen's ν_r) [m/s].
        angular_velocity: of the part [rad/s].
        submerged: submerged fraction [-].
        memory: what the law keeps of the steps before, `PartDragLaw.memory` numbers; () for none,
            and where what came before is not known: the law then has its force in a steady flow.
    """

    velocity: Vec
    angular_velocity: Vec
    submerged: Scalar
    memory: tuple[Scalar, ...] = ()


class Drag(NamedTuple):
    """What a drag law does to parts, along the part's axes, at the box's centre.

    Attributes:
        force: [N].
        torque: [N·m].
        damping: c |v| of a quadratic force c |v| v, half its gradient, along each axis [N·s/m];
            of a linear force, all of its gradient, of force and torque by both velocities. A step
            takes it implicitly where it must. None for a law that a step takes explicitly.
    """

    force: Vec
    torque: Vec
    damping: Vec | SpatialInertia | None


NO_DRAG = Drag(ZERO, ZERO, None)


@dataclass(frozen=True)
class Law:
    """What all laws have.

    Attributes:
        name: its name in world and module files.
        summary: one line for documents.
        mjcf: what an MJCF file can say of it.
        sdf: what an SDF file can say of it.
    """

    name: str
    summary: str
    mjcf: Export
    sdf: Export


@dataclass(frozen=True)
class DragLaw(Law):
    """What all drag laws have.

    Attributes:
        explicit: whether a step takes it explicitly, which limits the time step.
        varied: whether `task.robust` varies it.
        steepest: bound g of the force's gradient: its derivative by the speed v is at most g ρ A v,
            with A the part's largest face; or a function: numbers → g A [m²]. None where there is
            none (drag that is linear in v), and for explicit laws that act with the velocity at the
            step's beginning.
        by_faces: whether faces have the C_d that modules state, which may exceed that bound.
        coefficients: what users may give for it.
        parameters: checked class of more of them, which modules have under its name, and worlds
            where they have a field of this name.
        mj_fluidcoef: MuJoCo's `fluidcoef`, if MuJoCo's geoms have this law under that attribute.
    """

    explicit: bool = False
    varied: bool = True
    steepest: float | Callable[[Any], np.ndarray] | None = None
    by_faces: bool = False
    coefficients: tuple[Coefficient, ...] = ()
    parameters: type | None = None
    mj_fluidcoef: tuple[float, ...] = ()


@dataclass(frozen=True)
class PartDragLaw(DragLaw):
    """A drag law that acts on each part by itself.

    Attributes:
        numbers: (parts, world) → `law_numbers` of the parts, `[n]` or `[n, 3]` each.
        force: (flow, numbers, world) → drag, element-wise. Numbers are then constants that
            broadcast against the flow, vectors as tuples of three.
        angular: numbers → coefficients c of drag against turning, -c |ω| ω about each axis
            [kg·m²], which a step takes implicitly; None for none.
        memory: how many numbers it keeps of the past for each part; they begin at 0.
        remember: (flow, numbers, world, dt) → `PartFlow.memory` a step later.
    """

    numbers: Callable[[PartShapes, World], Any] = lambda parts, world: NoNumbers()
    force: Callable[[PartFlow, Any, World], Drag] = lambda flow, numbers, world: NO_DRAG
    angular: Callable[[Any], Vec] | None = None
    memory: int = 0
    remember: Callable[[PartFlow, Any, World, float], tuple[Scalar, ...]] = lambda *_: ()


def part_numbers(law: PartDragLaw, parts: PartShapes, world: World) -> Any:
    """The numbers of parts under a law, times the parts' own factors."""

    def scale(field: PartField, x: Any) -> Any:
        for name in field.varied:
            if name in parts.factors and isinstance(x, np.ndarray):
                x = x * parts.factors[name].reshape(-1, *[1] * (x.ndim - 1))
        return x

    return map_fields(scale, law.numbers(parts, world))


@dataclass(frozen=True)
class BodyDragLaw(DragLaw):
    """A drag law that acts on a moving body as a whole; only a world can choose it.

    Attributes:
        body_force: (velocity of the centre of mass relative to the water [m/s], angular velocity
            [rad/s], edges of the box of equal inertia [m], density, viscosity) → force [N] and
            torque [N·m], inertial frame, at the centre of mass.
    """

    body_force: Callable[[Vec, Vec, Vec, float, float], tuple[Vec, Vec]] = lambda *_: (ZERO, ZERO)


@dataclass(frozen=True)
class BuoyancyLaw(Law):
    """A rule for how much of a part the surface leaves under water.

    Attributes:
        submersion: (vertical in the part's axes, depth of the box's centre [m], half edges [m]) →
            submerged fraction [-], and fraction times centre of the submerged piece, from the box's
            centre, part's axes [m].
        lifts: whether the water's pressure and surface act; drag needs the submerged fraction
            either way.
    """

    submersion: Callable[[Vec, Scalar, Vec], tuple[Scalar, Vec]]
    lifts: bool = True


def find_law(laws: Mapping[str, L], name: str) -> L:
    """A law by its name.

    Raises:
        InputError: there is none of this name.
    """
    if name not in laws:
        raise InputError("law", f"one of {', '.join(laws)}", repr(name))
    return laws[name]
