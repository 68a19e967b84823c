"""The default drag: across chains of parts by strips, friction along them, wakes of their ends.

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
a compact one has its faces' drag. In between coefficients are interpolated, and so are the drag of
the whole velocity across the part and of each component by itself; the strips then stand at c of
the part's half length, and what that leaves of the drag against turning, 1 - c³ of it, stays with
the faces: no part is dragged twice. The ends of a row are chain as well, as the C_d of chains,
which is below that of an endless rod, is a mean over them.

Two strips stand for all, at Gauss's points. They are exact for a part that moves and hardly turns;
what they miss of a part that turns about its own middle is drag against turning, so that this is
exact, too. In between force and torque are off by up to a sixth where it moves at most as fast as
its ends turn, and parts of long chains never do.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from mjx_revolve.numerics.inertia import diagonal_inertia
from mjx_revolve.numerics.lazy import jnp
from mjx_revolve.numerics.spatial import (
    ZERO,
    Scalar,
    add,
    cross,
    dot,
    is_present,
    mul,
    neg,
    sub,
    total,
    vadd,
    vscale,
    vsub,
)
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

# Gauss's two points on -1 to 1, ± this, each with half of the drag.
_PLACE = 3**-0.5
_VARIED = ("drag", "density")
_END_VARIED = ("added_mass", "density")
_SHAPE = "the robot's shape, which is known"
# Where the way ahead is less than this share of an end's velocity, its wake stays with it, and no
# momentum is carried away. A choice: it must be small.
_AHEAD = 0.1
# Least Reynolds number at which friction is taken; below it the damping is that at it. A choice.
_LEAST_REYNOLDS = 1e3
# Squared speed that is added where a square root has no derivative at rest [m²/s²].
_STILL = 1e-18


def _fit_friction() -> tuple[float, ...]:
    """1 / (log10 Re)^b as a cubic in Re^(-1/4), the constant first: a step needs two square roots.

    Within 0.35 % from a Reynolds number of 1e3 to 1e7.
    """
    reynolds = np.array([1.3e3, 1e4, 2e5, 6e6])
    powers = np.vander(reynolds**-0.25, increasing=True)
    share = np.log10(reynolds) ** -TODAY["friction_exponent"].value
    return tuple(np.linalg.solve(powers, share).tolist())


_FRICTION = _fit_friction()


@law_numbers
class CrossFlowNumbers:
    """Drag of parts of a chain.

    Attributes:
        head: ρ ½ C_d A of the faces across the chain's axis [kg/m].
        faces: 1 - c of ρ ½ C_d A of the side faces, each of which meets its component [kg/m].
        strips: c of the same, which meet the whole velocity across the chain [kg/m].
        angular: what stays with the faces, against turning about each axis [kg·m²].
        along: unit vector of the chain's axis, outwards where a row ends with the part.
        reach: place along it of the two strips that stand for all [m].
        friction: ½ a c S μ / length, S the side faces [kg/s].
        reynolds: Reynolds number per speed [s/m].
        shed: c_m (π/4) ρ h² across the end of a row, along each axis [kg/m].
        end: place of that end along the axis [m].
    """

    head: Any = part_field("kg/m", varied=_VARIED)
    faces: Any = part_field("kg/m", axes="size", varied=_VARIED)
    strips: Any = part_field("kg/m", axes="size", varied=_VARIED)
    angular: Any = part_field("kg m2", axes="size", varied=_VARIED)
    along: Any = part_field("-", axes="vector", fixed=_SHAPE)
    reach: Any = part_field("m", fixed=_SHAPE)
    friction: Any = part_field("kg/s", varied=_VARIED)
    reynolds: Any = part_field("s/m", blank=1.0, fixed=_SHAPE)
    shed: Any = part_field("kg/m", axes="size", varied=_END_VARIED)
    end: Any = part_field("m", fixed=_SHAPE)


def chain_shares(parts: PartShapes) -> tuple[np.ndarray, np.ndarray]:
    """`[n, 3]` 1 at the axis of each part's row, else 0, and `[n, 1]` c."""
    size = 2 * parts.half_size
    # A row is as high as the larger of the edges across its axis.
    high = np.stack([np.delete(size, axis, 1).max(1) for axis in range(3)], 1)
    slender = np.clip(2 - high / parts.rows / TODAY["end_slenderness"].value, 0, 1)
    chained = slender * parts.joined
    # Of what is no chain, the longest axis, which is not across a plate.
    axis = np.where(chained.any(-1, keepdims=True), chained, size).argmax(-1)
    along = np.eye(3)[axis]
    return along, (along * chained).sum(-1, keepdims=True)


def split_drag(
    linear: np.ndarray, along: np.ndarray, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """ρ ½ C_d A along each axis as `CrossFlowNumbers` has it: head, faces and strips."""
    side = (1 - along) * linear
    return (along * linear).sum(-1), (1 - share) * side, share * side


def _numbers(parts: PartShapes, world: World) -> CrossFlowNumbers:
    size, (along, share) = 2 * parts.half_size, chain_shares(parts)
    own, exposed = parts.coefficients["drag_coefficient"], parts.exposed
    cube = TODAY["cube_drag"].value
    sides, ahead = TODAY["chain_drag"].value / cube, TODAY["chain_head_drag"].value / cube
    drag = own * (1 + share * (np.where(along, ahead, sides) - 1))
    linear, _ = face_drag_coefficients(size, parts.silhouette, drag, exposed)
    head, faces, strips = split_drag(world.density * linear, along, share)
    # The ends' own turning, and turning about the axis, stay with the faces, and of the sides
    # what strips do not have: the rest of c³, and of that what two points miss of ∫ |s| s² ds.
    turning = [
        face_drag_coefficients(size, parts.silhouette, of, exposed * which)[1]
        for of, which in ((own, along), (own, 1 - along), (drag, 1 - along))
    ]
    missed = share**3 * (1 - 4 * _PLACE**3)
    angular = turning[0] + np.where(along, turning[1], 0)
    angular += np.where(along, 0, (1 - share**3) * turning[1] + missed * turning[2])
    length = (along * size).sum(-1)
    ends = (parts.ends * along).sum(-1)
    # Height across the flow along each axis: the third edge.
    height = np.where(along, 0.0, (size * (1 - along)).sum(-1, keepdims=True) - size)
    shed = TODAY["end_added_mass"].value * np.pi / 4 * world.density * height**2
    # Faces across y and z are side faces of a chain along x: their areas, on two sides each.
    wet = 2 * ((1 - along) * exposed * parts.silhouette).sum(-1)
    rubbing = 0.5 * parts.coefficients["friction"] * share[:, 0] * wet
    rubbing = rubbing if world.density > 0 else 0 * rubbing
    viscous = world.viscosity > 0
    return CrossFlowNumbers(
        head=head,
        faces=faces,
        strips=strips,
        angular=world.density * angular,
        along=along * np.where(ends < 0, -1.0, 1.0)[:, None],
        reach=_PLACE * share[:, 0] * length / 2,
        friction=rubbing * world.viscosity / length,
        reynolds=length * (world.density / world.viscosity if viscous else 1.0),
        shed=share * np.abs(ends)[:, None] * shed,
        end=np.abs(ends) * length / 2,
    )


def friction_times_reynolds(reynolds: Scalar) -> Scalar:
    """Re C_f / a of side faces; C_f is that of `_LEAST_REYNOLDS` or more."""
    root = jnp.sqrt(jnp.sqrt(jnp.maximum(reynolds, _LEAST_REYNOLDS)))
    found: Scalar
    found, *rest = _FRICTION
    for coefficient in rest:
        found = found * root + coefficient
    return found * root


def friction_share(speed: Scalar, length: Scalar, world: World) -> Scalar:
    """C_f / a of side faces of some length [m]: 1 / (log10 Re)^b."""
    if world.viscosity == 0:
        return 0.0
    scale = mul(length, world.density / world.viscosity)
    reynolds = jnp.maximum(mul(speed, scale), _LEAST_REYNOLDS)
    return friction_times_reynolds(reynolds) / reynolds


def _force(flow: PartFlow, numbers: CrossFlowNumbers, world: World) -> Drag:
    along, wet = numbers.along, flow.submerged
    ahead = dot(flow.velocity, along)
    across = vsub(flow.velocity, vscale(ahead, along))
    spin = cross(flow.angular_velocity, along)
    damping, pushes = ZERO, []
    for place in (0.5, -0.5):
        at = vadd(across, vscale(mul(2 * place, numbers.reach), spin))
        speed = jnp.sqrt(add(_STILL, dot(at, at)))
        pairs = zip(numbers.faces, numbers.strips, at, strict=True)
        each = tuple(add(mul(f, jnp.abs(x)), mul(s, speed)) for f, s, x in pairs)
        pushes.append(tuple(mul(d, x) for d, x in zip(each, at, strict=True)))
        damping = vadd(damping, each)
    half = mul(0.5, wet)
    damping = vscale(half, damping)
    force = vscale(neg(half), vadd(*pushes))
    lever = vscale(mul(neg(half), numbers.reach), vsub(*pushes))
    # How force along each axis falls with turning.
    second = vscale(mul(numbers.reach, numbers.reach), damping)
    rubbed = mul(numbers.head, jnp.abs(ahead))
    if is_present(numbers.friction):
        reynolds = mul(numbers.reynolds, jnp.abs(ahead))
        rubbed = add(rubbed, mul(numbers.friction, friction_times_reynolds(reynolds)))
    rubbed = mul(rubbed, wet)
    thrust = neg(mul(rubbed, ahead))
    if any(map(is_present, numbers.shed)):
        tip = vadd(across, vscale(numbers.end, spin))
        left = jnp.maximum(neg(ahead), 0)
        square = left * left
        whole = square + _STILL + _AHEAD**2 * (ahead * ahead + dot(tip, tip))
        share = mul(square / whole, wet)
        lost = tuple(mul(mul(m, left), share) for m in numbers.shed)
        push = tuple(mul(m, x) for m, x in zip(lost, tip, strict=True))
        energy = total(*[mul(m, x * x) for m, x in zip(numbers.shed, tip, strict=True)])
        thrust = sub(thrust, mul(mul(0.5, share), energy))
        force, damping = vsub(force, push), vadd(damping, lost)
        lever = vsub(lever, vscale(numbers.end, push))
        second = vadd(second, vscale(mul(numbers.end, numbers.end), lost))
    axes = tuple(mul(a, a) for a in along)
    force = vadd(force, vscale(thrust, along))
    damping = vadd(damping, vscale(rubbed, axes))
    # First moments are left out: the damping is still at least half of what it stands for.
    turning = tuple(
        add(mul(second[j], axes[k]), mul(second[k], axes[j])) for j, k in ((1, 2), (2, 0), (0, 1))
    )
    return Drag(force, cross(along, lever), diagonal_inertia(turning, damping))


CROSS_FLOW = PartDragLaw(
    name="cross_flow",
    summary="drag across chains and rods, friction, wakes of chains' ends; thin plates as "
    "plate_wake, fins as fin_wake; elsewhere of faces",
    steepest=3.0,  # C_d of 1.75 across
    by_faces=True,
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
