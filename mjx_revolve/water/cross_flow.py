"""Drag across a chain of parts, by strips and with the whole transverse velocity, and friction.

The law of EPFL's chains and of FARMS (Taylor 1952 for the form): a strip of a long body that moves
through the water obliquely is dragged by ½ ρ C_d h |v⊥| v⊥, v⊥ its whole velocity across the body,
and along it by friction, ½ ρ C_f S |v∥| v∥. A face by itself (`face_drag`) meets the component of
the velocity across it only, so that a rod at 45° meets half of what it should.

How much of a chain a part is, is the share c of its ends that neighbours cover: 1 inside, ½ at an
end, 0 for a part by itself, for which this is the law of the faces. In between coefficients are
interpolated; the strips then stand at c of the part's half length, and what that leaves of the drag
against turning, 1 - c³ of it, stays with the faces: no part is dragged twice.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import jax.numpy as jnp
import numpy as np

from mjx_revolve.numerics.inertia import SpatialInertia, add_inertia, shift_inertia
from mjx_revolve.numerics.spatial import Vec, add, cross, mul, vadd
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.face_drag import FACES, face_drag_coefficients
from mjx_revolve.water.laws import (
    Drag,
    Export,
    PartDragLaw,
    PartFlow,
    PartShapes,
    law_numbers,
    part_field,
)

if TYPE_CHECKING:
    from mjx_revolve.water.world import World

# Gauss's four points on -1 to 1, and their shares.
_PLACES, _SHARES = (x.tolist() for x in np.polynomial.legendre.leggauss(4))
_VARIED = ("drag", "density")
# Least Reynolds number at which friction is taken; below it, there is next to none.
_LEAST_REYNOLDS = 1e3


@law_numbers
class CrossFlowNumbers:
    """Drag of parts of a chain.

    Attributes:
        linear: ρ ½ C_d A of each pair of faces [kg/m].
        angular: what stays with the faces, against turning about each axis [kg·m²].
        mixing: c, at the place of the chain's axis, else 0 [-].
        reach: c times half of the length along that axis, else 0 [m].
        friction: ρ ½ S of the side faces, at that axis, else 0 [kg/m].
        length: along that axis [m].
    """

    linear: Any = part_field("kg/m", axes="size", varied=_VARIED)
    angular: Any = part_field("kg m2", axes="size", varied=_VARIED)
    mixing: Any = part_field("-", axes="size", fixed="the robot's shape, which is known")
    reach: Any = part_field("m", axes="size", fixed="the robot's shape, which is known")
    friction: Any = part_field("kg/m", axes="size", varied=_VARIED)
    length: Any = part_field("m", blank=1.0, fixed="the robot's shape, which is known")


def _numbers(parts: PartShapes, world: World) -> CrossFlowNumbers:
    size, exposed = 2 * parts.half_size, parts.exposed
    covered = 1 - exposed
    along = np.eye(3)[covered.argmax(-1)]
    share = (along * covered).sum(-1, keepdims=True)
    own = parts.coefficients["drag_coefficient"]
    cube = TODAY["cube_drag"].value
    across, ahead = TODAY["chain_drag"].value / cube, TODAY["chain_head_drag"].value / cube
    drag = own * (1 + share * (np.where(along, ahead, across) - 1))
    linear, _ = face_drag_coefficients(size, parts.silhouette, drag, exposed)
    # What strips do not have: the ends' own turning, turning about the axis, and the rest of 1.
    turning = [
        face_drag_coefficients(size, parts.silhouette, own, exposed * faces)[1]
        for faces in (along, 1 - along)
    ]
    left = np.where(along, 1.0, 1 - share**3)
    length = (along * size).sum(-1)
    # Faces across y and z are side faces of a chain along x: their areas, on two sides each.
    sides = 2 * ((1 - along) * exposed * parts.silhouette).sum(-1, keepdims=True)
    return CrossFlowNumbers(
        linear=world.density * linear,
        angular=world.density * (turning[0] + left * turning[1]),
        mixing=along * share,
        reach=along * share * size / 2,
        friction=world.density / 2 * along * share * sides,
        length=length,
    )


def _force(flow: PartFlow, numbers: CrossFlowNumbers, world: World) -> Drag:
    mixing, force, torque = numbers.mixing, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)
    damping: SpatialInertia | None = None
    for place, weight in zip(_PLACES, _SHARES, strict=True):
        at: Vec = tuple(mul(place, x) for x in numbers.reach)
        v = vadd(flow.velocity, cross(flow.angular_velocity, at))
        share = mul(0.5 * weight, flow.submerged)
        each = []
        for i, j, k in ((0, 1, 2), (1, 2, 0), (2, 0, 1)):
            # Across a chain along k, the velocity across j counts, too.
            square = add(mul(mixing[k], v[j] * v[j]), mul(mixing[j], v[k] * v[k])) + v[i] * v[i]
            speed = jnp.where(square > 0, jnp.sqrt(jnp.where(square > 0, square, 1)), 0)
            each.append(mul(share, mul(numbers.linear[i], speed)))
        push = tuple(-d * x for d, x in zip(each, v, strict=True))
        force, torque = vadd(force, push), vadd(torque, cross(at, push))
        x, y, z = each
        own = shift_inertia((x, 0.0, 0.0, y, 0.0, z), (0.0,) * 6, at)
        damping = own if damping is None else add_inertia(damping, own)
    rubbed = []
    for x, area in zip(flow.velocity, numbers.friction, strict=True):
        reynolds = jnp.maximum(
            mul(jnp.abs(x), mul(numbers.length, world.density / max(world.viscosity, 1e-30))),
            _LEAST_REYNOLDS,
        )
        slope = jnp.log10(reynolds) ** TODAY["friction_exponent"].value
        rubbed.append(
            mul(mul(area, TODAY["friction"].value / slope), mul(jnp.abs(x), flow.submerged))
        )
    force = vadd(force, tuple(-d * x for d, x in zip(rubbed, flow.velocity, strict=True)))
    assert damping is not None
    x, y, z = rubbed
    damping = add_inertia(damping, shift_inertia((x, 0.0, 0.0, y, 0.0, z), (0.0,) * 6, (0.0,) * 3))
    return Drag(force, torque, damping)


CROSS_FLOW = PartDragLaw(
    name="cross_flow",
    summary="drag across chains of parts, by strips, and friction; of a lone part that of faces",
    explicit=False,
    varied=True,
    numbers=_numbers,
    force=_force,
    angular=lambda numbers: numbers.angular,
    mjcf=FACES.mjcf,
    sdf=Export("faces", FACES.sdf.note, missing="cross_flow: oblique flow on chains, and friction"),
)
