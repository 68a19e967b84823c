"""Contact with the bed: a penalty law with Coulomb friction at the corners of the modules.

Under water a robot weighs a sixteenth of its weight in air, so a soft ground is enough, and it
costs a few operations where a contact solver would cost the whole speed of the population step.
"""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level, Points
from mjx_revolve.numerics.inertia import BodyMotion, SpatialInertia, apply_inertia, sum_parts
from mjx_revolve.numerics.spatial import (
    SYM,
    ZERO,
    Mat,
    Scalar,
    Sym,
    Vec,
    add,
    cast,
    cross,
    diagonal,
    dot,
    full,
    madd,
    matmul,
    matTvec,
    mscale,
    mul,
    neg,
    skew,
    sub,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.bed import Bed, bed_height, bed_slope
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

# Ratio of a point's damper to its spring [s]. A choice, a quarter of MuJoCo's default (solref of
# 20 ms): feet hardly bounce, whatever is behind them. A damper that is critical for the point's own
# share of the mass let them bounce at short steps, but not at 5 ms, where crawlers were a tenth
# faster for it.
_DAMPER_TIME = 0.01
# The damper fades in over this depth [m], so that touching down is no jump in force.
DAMPER_DEPTH = 5e-4
# Below this speed [m/s] friction is viscous, as Coulomb's law has no value at rest.
CREEP_SPEED = 0.001


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
    bed: Bed,
    depth: Scalar,
    normal: Vec,
    velocity: Vec,
    point_mass: Scalar,
    timestep: float,
    fall: Scalar = 0.0,
    felt: bool = False,
) -> tuple[Vec, Scalar, Scalar]:
    """Force of the bed on points of the robot, and the damping of its implicit part.

    Normal, with d the depth and ḋ the speed inwards: F_n = k max(0, d + dt ḋ) + c ḋ while the sum
    pushes outwards: a spring at the end of the step, k the bed's stiffness, and a damper, c = k
    times 10 ms. Tangential: Coulomb, F_t = -μ F_n v_t / √(v_t² + v_c²) with v_c = 1 mm/s, so
    that on a slope the point creeps at v_c r / √(1 - r²), r = tan(slope) / μ < 1. Of the
    normal force, friction takes what the spring bears already and what stops the point's own mass
    within the step: F_n itself, foreseen with the velocity before, is many times what a foot that
    lands is really pushed with, and so much grip would make crawlers a third faster at 5 ms.

    Both are linear in the velocity at the end of the step, with the damping that is returned: a
    body of any mass can rest on a bed of any stiffness. Whether a point touches is decided with
    what its weight adds to its speed within the step: without, light parts that lie still lose the
    bed, fall by a step, and rock for ever.

    Args:
        bed: the ground.
        depth: of the points below the bed, along its normal [m], positive inside, `[...]`.
        normal: of the bed, any frame.
        velocity: of the points, same frame [m/s].
        point_mass: m, each point's share of its body's mass [kg]; 0 for padding.
        timestep: dt [s].
        fall: acceleration at which the point would begin to sink [m/s²], `Points.fall`.
        felt: whether the force is that on sensors: of F_n, what friction takes.

    Returns:
        Force on each point, same frame [N], and its damping along the normal and across it [N·s/m].
    """
    stiffness: Scalar
    if isinstance(point_mass, jax.Array):  # bodies differ from lane to lane
        stiffness = jnp.where(point_mass > 0, bed.stiffness, 0)
    else:
        stiffness = mul(bed.stiffness, np.asarray(np.greater(point_mass, 0), np.float64))
    outward = dot(velocity, normal)
    ahead = depth - timestep * outward
    faded = jnp.clip(ahead / DAMPER_DEPTH, 0, 1)
    damping = mul(mul(_DAMPER_TIME, stiffness), faded)
    push = sub(mul(stiffness, ahead), damping * outward)
    resistance = add(mul(timestep, stiffness), damping)
    gain = mul(timestep, fall)
    touching = (ahead + mul(timestep, gain) > 0) & (push + mul(resistance, gain) > 0)
    push = jnp.where(touching, jnp.maximum(push, 0), 0)
    resistance = jnp.where(touching, resistance, 0)
    sliding = tuple(v - outward * n for v, n in zip(velocity, normal, strict=True))
    arrest = mul(point_mass / timestep, jnp.maximum(neg(outward), 0))
    borne = jnp.minimum(push, add(mul(stiffness, jnp.maximum(depth, 0)), arrest))
    grip = bed.friction * borne / jnp.sqrt(dot(sliding, sliding) + CREEP_SPEED**2)
    along = borne if felt else push
    force = tuple(along * n - grip * s for n, s in zip(normal, sliding, strict=True))
    return force, resistance, grip


def bed_forces(
    world: World,
    level: Level,
    motion: BodyMotion,
    points: Points,
    water: Water,
    felt: bool = False,
) -> tuple[Vec, Vec, SpatialInertia]:
    """What the bed does to the bodies of a level.

    Args:
        world: with a bed.
        level: the bodies.
        motion: where they are and how they move, relative to the uniform current.
        points: of them that may touch.
        water: its uniform current is how fast the bed passes by.
        felt: as in `bed_contact`.

    Returns:
        Torque [N·m] and force [N] about each body's origin, body frame, and their damping.
    """
    k = points.count
    force, stiff, grip, normal, wide = _at_points(world, level, motion, points, water, felt)
    torque = cross(points.position, force)

    def gather(x: Scalar) -> Scalar:
        return sum_parts(wide(x), k)

    damping = _damping(points.position, normal, stiff - grip, grip, gather)
    # What the damping acts on is the acceleration relative to the bed, not to the water.
    gust = vscale(world.timestep, matTvec(motion.axes, water.acceleration))
    gust_torque, gust_force = apply_inertia(damping, ZERO, gust)
    torque, force = (tuple(map(gather, x)) for x in (torque, force))
    return vsub(torque, gust_torque), vsub(force, gust_force), damping


def bed_normal_force(
    world: World, level: Level, motion: BodyMotion, points: Points, water: Water
) -> Scalar:
    """Force of the bed on each point along its normal: what a touch sensor reads.

    Args:
        world: with a bed.
        level: the bodies.
        motion: as in `bed_forces`.
        points: of them that may touch.
        water: as in `bed_forces`.

    Returns:
        `[npoint, nbody, lanes]` [N]; friction apart.
    """
    force, _, _, normal, wide = _at_points(world, level, motion, points, water, True)
    return dot(force, tuple(wide(x) for x in normal))


def _at_points(
    world: World, level: Level, motion: BodyMotion, points: Points, water: Water, felt: bool
) -> tuple[Vec, Scalar, Scalar, Vec, Callable[[Scalar], jax.Array]]:
    """Force on each point with its damping, the bed's normal, and what widens to all points."""
    k, n, lanes = points.count, level.count, jnp.shape(motion.height)[-1]

    def wide(x: Scalar) -> jax.Array:
        return jnp.broadcast_to(x, (k, n, lanes))

    assert world.bed is not None  # there are points only above a bed
    ground, normal = bed_plane(world.bed, motion.xy)
    normal = matTvec(motion.axes, normal)
    # Depth of the body's origin below the tangent plane, then of each point.
    origin = mul(sub(ground, motion.height), dot(normal, motion.z_axis))
    depth = wide(sub(origin, dot(normal, points.position)))
    velocity = vadd(motion.velocity, cross(motion.angular_velocity, points.position))
    for speed, axis in zip(water.current, motion.axes, strict=True):
        velocity = vadd(velocity, vscale(speed, axis))
    wide_normal, velocity = tuple(wide(x) for x in normal), tuple(wide(x) for x in velocity)
    # Out of the water nothing carries a body.
    dry = motion.height > water.surface_height
    fall = jnp.where(dry, cast(world.gravity, motion.height), cast(points.fall, motion.height))
    force, stiff, grip = bed_contact(
        world.bed, depth, wide_normal, velocity, points.mass, world.timestep, fall, felt
    )
    return force, stiff, grip, normal, wide


def _damping(
    position: Vec, normal: Vec, along: Scalar, alike: Scalar, gather: Callable[[Scalar], Scalar]
) -> SpatialInertia:
    """Σ over points of what resists their motion, b 1 + a n nᵀ at r, about the body's origin.

    The points share n, so only moments of a and b over the points are summed: 20 numbers, and no
    matrix for each point.
    """
    sums = []
    for weight in (alike, along):
        weighted = [mul(weight, x) for x in position]
        first = tuple(gather(x) for x in weighted)
        second = tuple(gather(mul(weighted[i], position[j])) for i, j in SYM)
        sums.append((gather(weight), first, second))
    (b, br, brr), (a, ar, arr) = sums
    outer = tuple(mul(normal[i], normal[j]) for i, j in SYM)
    unit = diagonal((1.0, 1.0, 1.0))
    linear = tuple(add(mul(b, u), mul(a, o)) for u, o in zip(unit, outer, strict=True))
    # Σ [r] (b 1 + a n nᵀ) and -Σ [r] (b 1 + a n nᵀ) [r].
    nn = full(outer)
    across = madd(skew(br), matmul(skew(ar), nn))
    trace = total(brr[0], brr[3], brr[5])
    angular = tuple(
        add(sub(mul(u, trace), s), t)
        for u, s, t in zip(unit, brr, _turned(full(arr), normal), strict=True)
    )
    return SpatialInertia(angular, across, linear)


def _turned(moment: Mat, normal: Vec) -> Sym:
    """Σ a (r × n)(r × n)ᵀ from Σ a r rᵀ: [n] M [n]ᵀ."""
    x = skew(normal)
    turned = matmul(matmul(x, moment), mscale(-1.0, x))
    return tuple(turned[i][j] for i, j in SYM)
