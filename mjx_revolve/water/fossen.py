"""Damping that a module states itself, after Fossen: linear 6×6 and quadratic, implicit.

Fossen 2011, Handbook of Marine Craft Hydrodynamics and Motion Control, § 6.4: D(ν_r) = D +
diag(d) |ν_r|. The added mass that is stated beside it goes into the 6×6 inertia (`fluid_table`).
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.numerics.inertia import SpatialInertia, apply_inertia, scale_inertia
from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import SYM, Vec, add, mul, neg
from mjx_revolve.water.laws import (
    Drag,
    Export,
    PartDragLaw,
    PartFlow,
    PartShapes,
    law_numbers,
    part_field,
)
from mjx_revolve.water.plates import Fossen

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

_VARIED = ("drag", "density")


@law_numbers
class FossenNumbers:
    """Damping of parts, along and about their axes.

    Attributes:
        linear: 3×3 of force per velocity [N·s/m].
        cross: 3×3 of torque per velocity, and its transpose of force per turning [N·s].
        angular: 3×3 of torque per turning [N·m·s].
        quadratic: of force per squared velocity [N·s²/m²].
        angular_quadratic: of torque per squared turning [N·m·s²].
    """

    linear: Any = part_field("N s/m", axes="matrix", varied=_VARIED)
    cross: Any = part_field("N s", axes="matrix", varied=_VARIED)
    angular: Any = part_field("N m s", axes="matrix", varied=_VARIED)
    quadratic: Any = part_field("N s2/m2", axes="size", varied=_VARIED)
    angular_quadratic: Any = part_field("N m s2", axes="size", varied=_VARIED)


def _numbers(parts: PartShapes, world: World) -> FossenNumbers:
    stated: tuple[Fossen, ...] = parts.parameters["fossen"]
    wet = float(world.density > 0)
    linear = wet * np.array([p.linear_damping for p in stated], float).reshape(-1, 6, 6)
    square = wet * np.array([p.quadratic_damping for p in stated], float).reshape(-1, 6)
    return FossenNumbers(
        linear[:, :3, :3], linear[:, 3:, :3], linear[:, 3:, 3:], square[:, :3], square[:, 3:]
    )


def _damping(matrix: Any, square: Vec, velocity: Vec) -> tuple[Any, ...]:
    """D + diag(d) |v| of three velocities."""
    found = [matrix[i][j] for i, j in SYM]
    for k, index in enumerate((0, 3, 5)):
        found[index] = add(found[index], mul(square[k], jnp.abs(velocity[k])))
    return tuple(found)


def _force(flow: PartFlow, numbers: FossenNumbers, world: World) -> Drag:
    v, w, submerged, _ = flow
    angular = _damping(numbers.angular, numbers.angular_quadratic, w)
    linear = _damping(numbers.linear, numbers.quadratic, v)
    damping = scale_inertia(submerged, SpatialInertia(angular, numbers.cross, linear))
    torque, force = apply_inertia(damping, w, v)
    return Drag(tuple(map(neg, force)), tuple(map(neg, torque)), damping)


FOSSEN = PartDragLaw(
    name="fossen",
    summary="linear and quadratic damping that a module states itself; none where none is stated",
    parameters=Fossen,
    numbers=_numbers,
    force=_force,
    mjcf=Export(
        "inertia_box", missing="stated damping (fossen), replaced by that of MuJoCo's inertia box"
    ),
    sdf=Export("fossen", note="Hydrodynamics damps modules that state it with their own numbers"),
)
