"""Drag across chains of parts by strips, friction along them, and momentum shed at their ends.

The law of EPFL's chains and of FARMS (Taylor 1952 for the form): a strip of a long body that moves
through the water obliquely is dragged by ½ ρ C_d h |v⊥| v⊥, v⊥ its whole velocity across the body,
and along it by friction, ½ ρ C_f S |v∥| v∥. A face by itself (`face_drag`) meets the component of
the velocity across it only, so that a rod at 45° meets half of what it should.

At an end that trails, the momentum that the body has given to the water across its way, m w for
each unit of length, leaves with the wake (Lighthill 1971, Proc. R. Soc. B 179; Porez, Boyer and
Ijspeert 2014, Int. J. Robotics Research 33): F = ½ m w² t - m w u n, with u > 0 the end's velocity
along t, into the body, w that along n, across it, and m = c_m (π/4) ρ h². Its work, -½ m w² u, is
never positive, and for small waves its mean thrust is Lighthill's, ½ m (ẏ² - U² y_x²).

How much of a chain a part is, is a share c: 1 in a row of parts that is five times as long as high,
falling to 0 where it is 2.5 times as long, times the share of the part's joined ends that its
neighbours cover. A part by itself is a row of its own: a long one is a rod, which has the drag of a
chain and sheds nothing at its ends (the source of that is for swimming bodies with one tail), and
a compact one has its faces' drag. In between coefficients are interpolated; the strips then stand
at c of the part's half length, and what that leaves of the drag against turning, 1 - c³ of it,
stays with the faces: no part is dragged twice. The ends of a row are chain as well, as the C_d of
chains, which is below that of an endless rod, is a mean over them.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.numerics.inertia import SpatialInertia, add_inertia, shift_inertia
from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import Scalar, Vec, add, cross, dot, mul, total, vadd, vscale
from mjx_revolve.water.coefficients import TODAY
from mjx_revolve.water.face_drag import FACES, face_drag_coefficients
from mjx_revolve.water.laws import (
    Coefficient,
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
_END_VARIED = ("added_mass", "density")
# Where the way ahead is less than this share of an end's velocity, its wake stays with it, and no
# momentum is carried away. A choice: it must be small.
_AHEAD = 0.1
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
        friction: ρ ½ a S of the side faces, at that axis, else 0 [kg/m].
        length: along that axis [m].
        shed: c_m (π/4) ρ h² across the end of a row, along each axis [kg/m].
        end: place of that end [m].
        outward: unit vector from the part to that end.
    """

    linear: Any = part_field("kg/m", axes="size", varied=_VARIED)
    angular: Any = part_field("kg m2", axes="size", varied=_VARIED)
    mixing: Any = part_field("-", axes="size", fixed="the robot's shape, which is known")
    reach: Any = part_field("m", axes="size", fixed="the robot's shape, which is known")
    friction: Any = part_field("kg/m", axes="size", varied=_VARIED)
    length: Any = part_field("m", blank=1.0, fixed="the robot's shape, which is known")
    shed: Any = part_field("kg/m", axes="size", varied=_END_VARIED)
    end: Any = part_field("m", axes="vector", fixed="the robot's shape, which is known")
    outward: Any = part_field("-", axes="vector", fixed="the robot's shape, which is known")


def _numbers(parts: PartShapes, world: World) -> CrossFlowNumbers:
    size = 2 * parts.half_size
    # A row is as high as the larger of the edges across its axis.
    high = np.stack([np.delete(size, axis, 1).max(1) for axis in range(3)], 1)
    slender = np.clip(2 - high / parts.rows / TODAY["end_slenderness"].value, 0, 1)
    chained = slender * parts.joined
    along = np.eye(3)[chained.argmax(-1)]
    share = (along * chained).sum(-1, keepdims=True)
    own, exposed = parts.coefficients["drag_coefficient"], parts.exposed
    cube = TODAY["cube_drag"].value
    sides, head = TODAY["chain_drag"].value / cube, TODAY["chain_head_drag"].value / cube
    drag = own * (1 + share * (np.where(along, head, sides) - 1))
    linear, _ = face_drag_coefficients(size, parts.silhouette, drag, exposed)
    # What strips do not have: the ends' own turning, turning about the axis, and the rest of 1.
    turning = [
        face_drag_coefficients(size, parts.silhouette, own, exposed * faces)[1]
        for faces in (along, 1 - along)
    ]
    left = np.where(along, 1.0, 1 - share**3)
    length = (along * size).sum(-1)
    ends = parts.ends * along
    # Height across the flow along each axis: the third edge.
    height = np.where(along, 0.0, (size * (1 - along)).sum(-1, keepdims=True) - size)
    shed = TODAY["end_added_mass"].value * np.pi / 4 * world.density * height**2
    # Faces across y and z are side faces of a chain along x: their areas, on two sides each.
    wet = 2 * ((1 - along) * exposed * parts.silhouette).sum(-1, keepdims=True)
    return CrossFlowNumbers(
        linear=world.density * linear,
        angular=world.density * (turning[0] + left * turning[1]),
        mixing=along * share,
        reach=along * share * size / 2,
        friction=world.density / 2 * along * share * wet * parts.coefficients["friction"][:, None],
        length=length,
        shed=share * np.abs(ends).sum(-1, keepdims=True) * shed,
        end=ends * size / 2,
        outward=ends,
    )


def friction_share(speed: Scalar, length: Scalar, world: World) -> Scalar:
    """1 / (log10 Re)^b of side faces of some length [m]: C_f over a."""
    scale = mul(length, world.density / max(world.viscosity, 1e-30))
    reynolds = jnp.maximum(mul(speed, scale), _LEAST_REYNOLDS)
    share: Scalar = 1 / jnp.log10(reynolds) ** TODAY["friction_exponent"].value
    return share


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
        share = friction_share(jnp.abs(x), numbers.length, world)
        rubbed.append(mul(mul(area, share), mul(jnp.abs(x), flow.submerged)))
    force = vadd(force, tuple(-d * x for d, x in zip(rubbed, flow.velocity, strict=True)))
    assert damping is not None
    # What a trailing end sheds.
    v = vadd(flow.velocity, cross(flow.angular_velocity, numbers.end))
    ahead = jnp.maximum(-dot(v, numbers.outward), 0)
    square = ahead * ahead
    whole = square + _AHEAD**2 * dot(v, v)
    share = mul(jnp.where(whole > 0, square / jnp.where(whole > 0, whole, 1), 0), flow.submerged)
    lost = tuple(mul(mul(m, ahead), share) for m in numbers.shed)
    push = tuple(-d * x for d, x in zip(lost, v, strict=True))
    thrust = mul(
        mul(-0.5, share), total(*[mul(m, x * x) for m, x in zip(numbers.shed, v, strict=True)])
    )
    push = vadd(push, vscale(thrust, numbers.outward))
    force, torque = vadd(force, push), vadd(torque, cross(numbers.end, push))
    x, y, z = lost
    damping = add_inertia(damping, shift_inertia((x, 0.0, 0.0, y, 0.0, z), (0.0,) * 6, numbers.end))
    x, y, z = rubbed
    damping = add_inertia(damping, shift_inertia((x, 0.0, 0.0, y, 0.0, z), (0.0,) * 6, (0.0,) * 3))
    return Drag(force, torque, damping)


CROSS_FLOW = PartDragLaw(
    name="cross_flow",
    summary="drag across chains and rods, friction, wakes of chains' ends; elsewhere of faces",
    explicit=False,
    varied=True,
    coefficients=(
        Coefficient(
            "friction",
            "-",
            "a in C_f = a / (log10 Re)^2.58 along chains",
            TODAY["friction"].value,
            spread=2.0,
        ),
    ),
    numbers=_numbers,
    force=_force,
    angular=lambda numbers: numbers.angular,
    mjcf=FACES.mjcf,
    sdf=Export(
        "faces",
        FACES.sdf.note,
        missing="cross_flow: oblique flow on chains, friction, wakes of ends",
    ),
)
