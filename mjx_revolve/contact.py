"""Contact with the bed: a penalty law with Coulomb friction at the corners of the modules.

Under water a robot weighs a sixteenth of its weight in air, so a soft ground is enough, and it
costs a few operations where a contact solver would cost the whole speed of the population step.
"""

from __future__ import annotations

import jax.numpy as jnp

from mjx_revolve.spatial import Scalar, Vec, dot, mul
from mjx_revolve.terrain import Bed, bed_height, bed_slope

# Share of the point's mass / dt² that the spring may have, and of mass / dt that the damper and the
# friction may have. Below 1 each, the sum over a body's points can stop it but not throw it back;
# 0.5 leaves room for corners, which lie further out than the mass that they stand for.
_SPRING_SHARE = 0.5
_DAMPER_SHARE = 0.5
# The damper fades in over this depth [m], so that touching down is no jump in force.
_FADE = 5e-4
# Below this speed [m/s] friction is viscous, as Coulomb's law has no value at rest.
_CREEP = 0.005


def bed_plane(bed: Bed, place: tuple[Scalar, Scalar]) -> tuple[Scalar, Vec]:
    """The bed's tangent plane below each body.

    A body's points share it, because the beds are smooth at the size of a module: below the lake's
    steepest dune the plane is off by 0.1 mm at 10 cm.

    Args:
        bed: the ground.
        place: world x and y of the bodies' origins [m].

    Returns:
        Height at the origins [m], and the unit normal, world frame.
    """
    x, y = place
    slope_x, slope_y = bed_slope(bed, x, y)
    inverse = 1 / jnp.sqrt(1 + slope_x * slope_x + slope_y * slope_y)
    return bed_height(bed, x, y), (-slope_x * inverse, -slope_y * inverse, inverse)


def bed_contact(
    bed: Bed, depth: Scalar, normal: Vec, velocity: Vec, point_mass: Scalar, timestep: float
) -> Vec:
    """Force of the bed on points of the robot.

    Normal: F_n = k d - c ḋ while the point is a depth d below the bed and the sum pushes outwards,
    with k the bed's stiffness or 0.5 m/dt² where that is less, and c = 0.5 m/dt. Tangential:
    Coulomb, F_t = -μ F_n v_t / max(|v_t|, 5 mm/s), at most 0.5 m/dt |v_t|.

    Args:
        bed: the ground.
        depth: of the points below the bed, along its normal [m], positive inside, `[...]`.
        normal: of the bed, any frame.
        velocity: of the points, same frame [m/s].
        point_mass: m, each point's share of its body's mass [kg].
        timestep: dt [s].

    Returns:
        Force on each point, same frame [N].
    """
    inside = jnp.maximum(depth, 0)
    spring = jnp.minimum(bed.stiffness, mul(_SPRING_SHARE / timestep**2, point_mass))
    damper = mul(_DAMPER_SHARE / timestep, point_mass)
    outward = dot(velocity, normal)
    push = spring * inside - damper * jnp.minimum(inside / _FADE, 1) * outward
    push = jnp.where(depth > 0, jnp.maximum(push, 0), 0)
    sliding = tuple(v - outward * n for v, n in zip(velocity, normal, strict=True))
    speed = jnp.sqrt(dot(sliding, sliding) + _CREEP**2)
    grip = jnp.minimum(bed.friction * push / speed, damper)
    return tuple(push * n - grip * s for n, s in zip(normal, sliding, strict=True))
