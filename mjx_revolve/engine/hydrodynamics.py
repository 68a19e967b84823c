"""The water on a robot: the sum of all laws over the parts of a level of bodies.

The laws are pure functions in `mjx_revolve/water/`; this file puts them together for whole levels
of a robot's tree. Vectors are tuples of three arrays (see `spatial`), numbers of parts are
constants `[npart, nbody, 1]`. A part belongs to one buoyancy law and one drag law, which are looked
up in their tables while the step is traced.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level, Parts, ThrusterMounts
from mjx_revolve.numerics.inertia import (
    BodyMotion,
    SpatialInertia,
    add_inertia,
    apply_inertia,
    diagonal_inertia,
    shift_inertia,
    sum_parts,
)
from mjx_revolve.numerics.spatial import (
    NO_MATRIX,
    ZERO,
    Scalar,
    Sym,
    Vec,
    add,
    cast,
    cross,
    diagonal,
    dot,
    is_present,
    matTvec,
    matvec,
    mul,
    neg,
    rotate,
    rotate_sym,
    safe_norm,
    sub,
    symvec,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.added_mass import CarriedWater, slam, wetting_rate
from mjx_revolve.water.buoyancy import displaced_water, find_buoyancy_law, surface_tension
from mjx_revolve.water.drag import find_drag_law
from mjx_revolve.water.face_drag import quadratic_drag
from mjx_revolve.water.flow import Water, flow, is_uniform, surface, wave_convection
from mjx_revolve.water.laws import NO_DRAG, BodyDragLaw, PartDragLaw, PartFlow
from mjx_revolve.water.near_surface import NearSurface, near_surface, turning_share
from mjx_revolve.water.world import World

Sum = Callable[[Scalar], Scalar]


class ExternalForces(NamedTuple):
    """What acts on the bodies of a level from outside, about each body's origin, body frame.

    Attributes:
        torque: [N·m].
        force: [N].
        carried: inertia of the water that the bodies carry along, or None.
        momentum: the part of that water's momentum A (ν - u) that comes from the water's own
            velocity u, -A u, (angular, linear) [kg·m²/s, kg·m/s], or None. The step adds the force
            by which it turns with the body.
        damping: how force and torque fall with the bodies' velocity, as a 6×6 [N·s/m ...], for
            the implicit part of a step; or None.
        submerged: submerged fractions of each group of parts that saves something, `[npart, nbody,
            lanes]` each [-]; near the surface as in `State`.
    """

    torque: Vec
    force: Vec
    carried: SpatialInertia | None
    momentum: tuple[Vec, Vec] | None
    damping: SpatialInertia | None
    submerged: tuple[Scalar, ...] = ()


class PreviousStep(NamedTuple):
    """What a step needs of the one before it, for the slam and for what laws remember.

    Attributes:
        submerged: submerged fractions then, as in `ExternalForces`, or those of one group.
        dt: of the step [s]; 0 for forces by themselves, without a slam.
    """

    submerged: Any
    dt: float


class _Stream(NamedTuple):
    """The water's velocity and acceleration, body frame; None where there is none."""

    velocity: Any
    acceleration: Any


class _Immersion(NamedTuple):
    """How parts lie in the water and move through it, `[npart, nbody, lanes]`, part's axes.

    Attributes:
        flow: velocities relative to the water, and submerged fraction.
        stream: the water's own motion, body frame.
        moment: submerged fraction times centre of the submerged piece, from the box's centre [m].
        up: the surface's normal.
        depth: of the box's centre below the surface [m].
    """

    flow: PartFlow
    stream: _Stream
    moment: Vec
    up: Vec
    depth: Scalar


def _is_array(x: Scalar) -> bool:
    return hasattr(x, "shape")


def _some(vector: Any) -> Any:
    """A vector, or None where it is plainly zero: a traced zero counts as something."""
    if vector is None or all(isinstance(x, int | float) and x == 0 for x in vector):
        return None
    return vector


def _to_body(motion: BodyMotion, vector: Any) -> Any:
    """A vector of the world seen from each body's frame."""
    return None if vector is None else matTvec(motion.axes, vector)


def _world_position(motion: BodyMotion, position: Vec) -> Vec:
    """World coordinates of points in the bodies' frames."""
    return vadd(motion.position, matvec(motion.axes, position))


def _stream(world: World, water: Water, motion: BodyMotion, position: Vec) -> _Stream:
    """The water's motion at points of the bodies, relative to the uniform current."""
    if is_uniform(world):
        return _Stream(None, None)
    rest = water._replace(current=ZERO, acceleration=ZERO)
    point = _world_position(motion, position)
    velocity, acceleration = flow(world, rest, *point)
    if world.waves:
        acceleration = vadd(acceleration, wave_convection(world, water, *point))
    return _Stream(_to_body(motion, _some(velocity)), _to_body(motion, _some(acceleration)))


def _differs_by_part(x: Scalar) -> bool:
    """Whether a number is `[npart, nbody, lanes]`."""
    return _is_array(x) and x.ndim == 3


def _widener(parts: Parts, n: int, motion: BodyMotion) -> Sum:
    """Broadcasts a number to all parts of n bodies."""
    lanes = jnp.shape(motion.height)[-1]
    return lambda x: jnp.broadcast_to(cast(x, motion.height), (parts.count, n, lanes))


def _immerse(world: World, parts: Parts, motion: BodyMotion, water: Water, wide: Sum) -> _Immersion:
    stream = _stream(world, water, motion, parts.position)
    velocity = vadd(motion.velocity, cross(motion.angular_velocity, parts.position))
    relative = velocity if stream.velocity is None else vsub(velocity, stream.velocity)
    height, gradient = water.surface_height, None
    if world.waves:
        x, y, _ = _world_position(motion, parts.position)
        height, gradient = surface(world, water, x, y)
    below = sub(height, add(motion.height, dot(motion.z_axis, parts.position)))
    normal = motion.z_axis
    if gradient is not None:
        # Distance to the surface's tangent plane, and its normal.
        steep = jax.lax.rsqrt(1 + gradient[0] * gradient[0] + gradient[1] * gradient[1])
        below = below * steep
        normal = _to_body(motion, (-gradient[0] * steep, -gradient[1] * steep, steep))
    up, depth = matTvec(parts.rotation, normal), wide(below)
    law = find_buoyancy_law(parts.laws.buoyancy)
    submerged, moment = law.submersion(up, depth, parts.half_size)
    v, w = (matTvec(parts.rotation, x) for x in (relative, motion.angular_velocity))
    return _Immersion(PartFlow(v, w, submerged), stream, moment, up, depth)


def _flow_at_the_beginning(parts: Parts, motion: BodyMotion, flow: PartFlow) -> PartFlow:
    """The flow past parts with the velocities of the step's beginning, for the slam."""
    if motion.begun is None:
        return flow
    angular, linear = (vsub(x, y) for x, y in zip(motion.begun, motion.twist, strict=True))
    velocity = matTvec(parts.rotation, vadd(linear, cross(angular, parts.position)))
    return flow._replace(
        velocity=vadd(flow.velocity, velocity),
        angular_velocity=vadd(flow.angular_velocity, matTvec(parts.rotation, angular)),
    )


def _angular_drag(parts: Parts, coefficient: Vec, flow: PartFlow, gather: Sum) -> tuple[Vec, Sym]:
    """Torque of the drag against turning on each body, and its damping, body frame."""
    w = flow.angular_velocity
    strength = tuple(mul(c, flow.submerged) for c in coefficient)
    together = not any(map(_differs_by_part, w))
    if together:  # all parts turn alike about their own axes
        strength = tuple(map(gather, strength))
    drag = [quadratic_drag(x, c, 1.0) for x, c in zip(w, strength, strict=True)]
    torque = matvec(parts.rotation, tuple(t for t, _ in drag))
    damping = rotate_sym(parts.rotation, diagonal(tuple(d for _, d in drag)))
    if together:
        return torque, damping
    return tuple(map(gather, torque)), tuple(map(gather, damping))


def _damping(
    parts: Parts, own: Vec | SpatialInertia | None, angular: Sym | None, gather: Sum
) -> SpatialInertia | None:
    """Damping of forces along the parts' axes and of torques, about the bodies' origins."""
    if own is None:
        return None if angular is None else SpatialInertia(angular, NO_MATRIX, (0.0,) * 6)
    if isinstance(own, SpatialInertia):
        about, along = (rotate_sym(parts.rotation, x) for x in (own.angular, own.linear))
        one = shift_inertia(along, about, parts.position, rotate(parts.rotation, own.cross))
    else:
        along = rotate_sym(parts.rotation, diagonal(own))
        one = shift_inertia(along, (0.0,) * 6, parts.position)
    turning = tuple(map(gather, one.angular))
    return SpatialInertia(
        turning if angular is None else vadd(turning, angular),
        tuple(tuple(map(gather, row)) for row in one.cross),
        tuple(map(gather, one.linear)),
    )


def _angular_slam(parts: Parts, carried: CarriedWater, w: Vec, rate: Scalar, gather: Sum) -> Vec:
    """Torque of the slam on what turns, on each body, body frame; `w` in the part's axes."""
    if any(map(_differs_by_part, w)):
        torque = matvec(parts.rotation, slam(rate, carried.angular, w))
        return tuple(map(gather, torque))
    # All parts turn alike about their own axes.
    together = tuple(gather(mul(rate, x)) for x in carried.angular)
    return matvec(parts.rotation, slam(1.0, together, w))


def _near_surface(world: World, parts: Parts, at: _Immersion, wide: Sum) -> NearSurface | None:
    """What the surface makes of parts; None where they carry their submerged fraction.

    That is so of stated water, and where there is no surface that presses.
    """
    law = find_buoyancy_law(parts.laws.buoyancy)
    if not (world.near_surface and law.lifts) or parts.carried is None or parts.laws.stated:
        return None
    up = tuple(map(wide, at.up))
    return near_surface(
        up, at.depth, at.flow.submerged, parts.half_size, parts.carried, world.gravity
    )


def _by_group(level: Level, before: PreviousStep | None) -> list[PreviousStep | None]:
    """The step before, of each group of a level's parts."""
    if before is None:
        return [None] * len(level.parts)
    rows = iter(before.submerged)
    return [before._replace(submerged=next(rows)) if p.saves else None for p in level.parts]


def _past(
    world: World, parts: Parts, before: PreviousStep | None
) -> tuple[PreviousStep | None, tuple[Scalar, ...]]:
    """Of one group: what the slam needs, and what the drag law remembers."""
    if before is None:
        return None, ()
    k = parts.count
    wet = (3 if world.near_surface else 1) * k * parts.carries
    ends = range(wet, wet + k * parts.laws.memory, k)
    memory = tuple(before.submerged[end : end + k] for end in ends)
    if memory:
        before = before._replace(submerged=before.submerged[:wet])
    return before if parts.carries and before.dt else None, memory


def _near_surface_slam(
    parts: Parts, carried: CarriedWater, flow: PartFlow, share: Vec, before: PreviousStep
) -> tuple[Vec, Vec]:
    """Force and torque of the slam on parts, by the growth of wet shares along the part's axes."""
    k = parts.count
    then = tuple(before.submerged[i * k : (i + 1) * k] for i in range(3))
    turning = (turning_share(x, carried.mass, parts.half_size) for x in (share, then))
    rates = (
        [wetting_rate(a, b, before.dt) for a, b in zip(*x, strict=True)]
        for x in ((share, then), turning)
    )
    given = (carried.mass, flow.velocity), (carried.angular, flow.angular_velocity)
    force, torque = (
        tuple(slam(r, (m,), (x,))[0] for r, m, x in zip(rate, *what, strict=True))
        for rate, what in zip(rates, given, strict=True)
    )
    return force, torque


def _coupled_slam(
    carried: CarriedWater, stream: _Stream, motion: BodyMotion, rate: Scalar
) -> tuple[Vec, Vec]:
    """Torque and force of the slam on parts that carry a whole 6×6, about the bodies' origins."""
    angular_velocity, velocity = motion.begun or motion.twist
    if stream.velocity is not None:
        velocity = vsub(velocity, stream.velocity)
    torque, force = apply_inertia(carried.inertia, angular_velocity, velocity)
    return vscale(neg(rate), torque), vscale(neg(rate), force)


def _pressure(
    world: World, parts: Parts, at: _Immersion, gravity: Vec, gather: Sum
) -> tuple[Vec, Vec]:
    """Torque and force of the water's pressure about each body's origin, body frame."""
    # The gradient of the pressure over the density holds up what is still, and pushes along with
    # moving water [m/s²].
    moving = at.stream.acceleration
    gradient = gravity if moving is None else vadd(gravity, moving)
    moment = matvec(parts.rotation, at.moment)
    box = parts.volume, parts.center_position, world.density
    mass, first = displaced_water(at.flow.submerged, moment, *box)
    if not any(map(_differs_by_part, gradient)):
        mass, first = gather(mass), tuple(map(gather, first))
        return cross(first, gradient), vscale(mass, gradient)
    torque, force = cross(first, gradient), vscale(mass, gradient)
    return tuple(map(gather, torque)), tuple(map(gather, force))


def _surface_tension(world: World, parts: Parts, at: _Immersion, wide: Sum) -> tuple[Vec, Vec]:
    """Force and torque of the surface's tension, part's axes, at the box's centre."""
    tension = world.surface_tension
    if tension is None or not find_buoyancy_law(parts.laws.buoyancy).lifts:
        return ZERO, ZERO
    up, weight = tuple(map(wide, at.up)), world.density * world.gravity
    return surface_tension(
        up, at.depth, parts.half_size, tension.gamma, weight, tension.contact_angle, parts.exposed
    )


def _thrust(mounts: ThrusterMounts, submerged: Scalar, thrusts: jax.Array) -> tuple[Vec, Vec]:
    """Torque and force of the thrusters on each part, about the body's origin, body frame."""
    which = mounts.which
    if isinstance(which, jax.Array):  # robots differ from lane to lane
        push = total(*[jnp.where(which == k, thrusts[k], 0) for k in range(thrusts.shape[0])])
    else:
        none = jnp.zeros_like(thrusts[0])
        rows = [[thrusts[k] if k >= 0 else none for k in row] for row in which[..., 0]]
        push = jnp.stack([jnp.stack(row) for row in rows])
    # Out of the water a propeller pushes nothing.
    force = vscale(mul(push, submerged), mounts.axis)
    return vsub(cross(mounts.position, force), vscale(mounts.torque_ratio, force)), force


def _water_on_parts(
    world: World,
    parts: Parts,
    n: int,
    motion: BodyMotion,
    gravity: Vec,
    water: Water,
    thrusts: Any,
    before: PreviousStep | None,
) -> tuple[Vec, Vec, SpatialInertia | None, SpatialInertia | None, Scalar, Scalar]:
    """Of one group of parts: torque, force, carried water, damping, submerged fraction.

    And what the next step's slam needs of it: that fraction, or shares near the surface.
    """
    k, wide = parts.count, _widener(parts, n, motion)

    def gather(x: Scalar) -> Scalar:
        return sum_parts(wide(x) if _is_array(x) else x, k)

    at = _immerse(world, parts, motion, water, wide)
    v, w, submerged, _ = at.flow
    begun = _flow_at_the_beginning(parts, motion, at.flow)
    dt = 0.0 if before is None else before.dt
    before, memory = _past(world, parts, before)
    law, drag = find_drag_law(parts.laws.drag), NO_DRAG
    if isinstance(law, PartDragLaw):
        passing = at.flow._replace(memory=memory)
        drag = law.force(passing, parts.drag, world)
        if memory and dt:
            memory = law.remember(passing, parts.drag, world, dt)
    force, torque, damping = drag
    pull, turn = _surface_tension(world, parts, at, wide)
    force, torque = vadd(force, pull), vadd(torque, turn)
    rate, saved = None, submerged
    close = _near_surface(world, parts, at, wide)
    if world.near_surface and parts.carried is not None:
        shares = (submerged,) * 3 if close is None else close.share
        saved = jnp.concatenate(list(map(wide, shares)))
        if before is not None and close is None:
            before = before._replace(submerged=before.submerged[:k])
    if memory:
        kept = [saved] if parts.carries else []
        saved = jnp.concatenate([*kept, *map(wide, memory)])
    if close is not None and parts.carried is not None:
        if before is not None:
            blow = _near_surface_slam(parts, parts.carried, begun, close.share, before)
            force, torque = vadd(force, blow[0]), vadd(torque, blow[1])
        waves = close.damping
        force = vsub(force, symvec(waves.linear, v))
        about = waves.angular[0], waves.angular[3], waves.angular[5]
        torque = vsub(torque, tuple(c * t for c, t in zip(about, w, strict=True)))
    elif before is not None and parts.carried is not None:
        rate = wetting_rate(submerged, before.submerged, before.dt)
        if not parts.laws.coupled:
            force = vadd(force, slam(rate, parts.carried.mass, begun.velocity))
    force = matvec(parts.rotation, force)
    torque = vadd(matvec(parts.rotation, torque), cross(parts.position, force))
    if parts.mounts is not None:
        driven = _thrust(parts.mounts, submerged, thrusts)
        torque, force = vadd(torque, driven[0]), vadd(force, driven[1])
    force, torque = tuple(map(gather, force)), tuple(map(gather, torque))
    if find_buoyancy_law(parts.laws.buoyancy).lifts:
        righting, lift = _pressure(world, parts, at, gravity, gather)
        torque, force = vadd(torque, righting), vadd(force, lift)
    if rate is not None and parts.carried is not None:
        if parts.laws.coupled:
            blow = _coupled_slam(parts.carried, at.stream, motion, rate)
            torque = vadd(torque, map(gather, blow[0]))
            force = vadd(force, map(gather, blow[1]))
        else:
            turn = begun.angular_velocity
            torque = vadd(torque, _angular_slam(parts, parts.carried, turn, rate, gather))
    angular = None
    if isinstance(law, PartDragLaw) and law.angular is not None:
        twist, angular = _angular_drag(parts, law.angular(parts.drag), at.flow, gather)
        torque = vadd(torque, twist)
    carried = None
    if close is not None and parts.carried is not None:
        own = parts.carried
        spins = turning_share(close.share, own.mass, parts.half_size)
        mass = tuple(map(mul, own.mass, close.share))
        here = diagonal_inertia(tuple(map(mul, own.angular, spins)), mass)
        carried = _damping(parts, here, None, gather)
    elif parts.carries and parts.carried is not None:

        def weigh(x: Scalar) -> Scalar:
            return sum_parts(mul(x, submerged), k) if is_present(x) else 0.0

        carried = jax.tree.map(weigh, parts.carried.inertia)
    resistance = _damping(parts, damping, angular, gather)
    if close is not None:
        resistance = _plus(resistance, _damping(parts, close.damping, None, gather))
    return torque, force, carried, resistance, submerged, saved


class PartForces(NamedTuple):
    """Forces on parts one by one, body frame, three of `[npart, nbody, lanes]` each [N].

    Attributes:
        buoyancy: of the water's pressure: Archimedes', what accelerating water adds to it, and the
            pull of the surface where the world has one.
        drag: of the water that flows past, and of radiated waves; the lift of fins included.
        thrust: of the thrusters.
    """

    buoyancy: Vec
    drag: Vec
    thrust: Vec


def forces_on_parts(
    world: World, level: Level, motion: BodyMotion, gravity: Vec, water: Water, thrusts: Any
) -> list[PartForces]:
    """The terms of `water_forces`, part by part and kind by kind, before they are added up.

    Args:
        world: which laws act.
        level: the bodies.
        motion: where they are and how they move, relative to the uniform current.
        gravity: as in `water_forces`.
        water: surface, current, time.
        thrusts: of the robot's thrusters, `[nthruster, lanes]` [N].

    Returns:
        For each group of the level's parts. The force of a drag law of whole bodies is shared out
        among a body's parts by what of their boxes is submerged. Laws with a memory have none here.
    """
    found, fractions = [], []
    for parts in level.parts:
        wide = _widener(parts, level.count, motion)
        at = _immerse(world, parts, motion, water, wide)
        fractions.append(at.flow.submerged)
        lift = matvec(parts.rotation, _surface_tension(world, parts, at, wide)[0])
        if find_buoyancy_law(parts.laws.buoyancy).lifts:
            lift = vadd(lift, _pressure(world, parts, at, gravity, wide)[1])
        law, drag = find_drag_law(parts.laws.drag), ZERO
        if isinstance(law, PartDragLaw):
            drag = law.force(at.flow, parts.drag, world).force
        close = _near_surface(world, parts, at, wide)
        if close is not None and parts.carried is not None:
            drag = vsub(drag, symvec(close.damping.linear, at.flow.velocity))
        drag = matvec(parts.rotation, drag)
        push: Vec = ZERO
        if parts.mounts is not None:
            push = _thrust(parts.mounts, at.flow.submerged, thrusts)[1]
        found.append(PartForces(*(tuple(map(wide, x)) for x in (lift, drag, push))))
    on_bodies = _body_drag(world, level, motion, water, fractions)
    if on_bodies is not None:
        pairs = list(zip(level.parts, fractions, strict=True))
        whole = total(*[sum_parts(mul(p.bulk, x), p.count) for p, x in pairs])
        for k, (parts, fraction) in enumerate(pairs):
            part = mul(parts.bulk, fraction) / jnp.maximum(whole, 1e-30)
            own = tuple(mul(part, x) for x in on_bodies[1])
            found[k] = found[k]._replace(drag=vadd(found[k].drag, own))
    return found


def _plus(a: SpatialInertia | None, b: SpatialInertia | None) -> SpatialInertia | None:
    if a is None or b is None:
        return a if b is None else b
    return add_inertia(a, b)


def _body_fraction(level: Level, fractions: Sequence[Scalar]) -> Scalar:
    """Submerged fraction of each body, its parts weighted by their boxes' volume.

    Not by what they displace: a part of no volume of its own is dragged, too.
    """
    n = level.count
    wet, whole = 0.0, 1e-30
    for parts, fraction in zip(level.parts, fractions, strict=True):
        k, volume = parts.count, parts.bulk
        if not isinstance(volume, jax.Array):
            volume = np.broadcast_to(np.asarray(volume), (k, n, 1))
        wet = add(wet, sum_parts(mul(volume, fraction), k))
        whole = add(whole, sum(volume[i] for i in range(k)))
    return mul(1 / whole, wet)


def _body_drag(
    world: World, level: Level, motion: BodyMotion, water: Water, fractions: Sequence[Scalar]
) -> tuple[Vec, Vec] | None:
    """Torque and force of a drag law of whole bodies; None where the world's law is another."""
    law, box = find_drag_law(world.drag), level.box
    if not isinstance(law, BodyDragLaw) or box is None:
        return None
    fraction = _body_fraction(level, fractions)
    stream = _stream(world, water, motion, box.position)
    at = vadd(motion.velocity, cross(motion.angular_velocity, box.position))
    at = at if stream.velocity is None else vsub(at, stream.velocity)
    v, w = (matTvec(box.rotation, x) for x in (at, motion.angular_velocity))
    force, torque = law.body_force(v, w, box.size, world.density, world.viscosity)
    force = vscale(fraction, matvec(box.rotation, force))
    torque = vscale(fraction, matvec(box.rotation, torque))
    return vadd(torque, cross(box.position, force)), force


def implicit_share(
    world: World, level: Level, motion: BodyMotion, water: Water, dt: float
) -> Scalar:
    """Which share of the drag a step takes implicitly, `[nbody, lanes]` in 0 to 1 [-].

    min(1, z²) with z = dt G / m, where G bounds the gradient of the drag. Of a part it is g ρ A v,
    with the largest face A, the law's `steepest` g and the speed v of its fastest corner through
    the water, at most that of its centre and |ω| half its diagonal. Of all parts together,
    Σ s v ≤ √(Σ s · Σ s v²) with s = g ρ A: so it follows from sums over the body, see `DragBound`.
    An extrapolated force is stable for gradients up to m / (dt (1 - z²)), which is 2.6 G or more.
    1 in motion without such a bound. Of an explicit law, for which nothing is implicit, it is how
    far from the middle of the step its velocity is taken, and 1 with MuJoCo's inertia box.
    """
    bound, w = level.bound, motion.angular_velocity
    if not is_present(bound.steep):
        return 0.0
    stream = _stream(world, water, motion, ZERO).velocity
    v = motion.velocity if stream is None else vsub(motion.velocity, stream)
    # Σ s |v + ω × x|²
    turning = add(mul(2.0, dot(v, cross(w, bound.moment))), dot(w, symvec(bound.inertia, w)))
    square = mul(bound.steep, add(mul(bound.steep, dot(v, v)), turning))
    # Not below 0 by rounding, and with a gradient at rest.
    gradient = add(jnp.sqrt(jnp.maximum(square, 1e-30)), mul(bound.corners, safe_norm(w)))
    ratio = dt * gradient / add(bound.mass, 1e-12)
    return jnp.minimum(ratio * ratio, 1)


def water_forces(
    world: World,
    level: Level,
    motion: BodyMotion,
    gravity: Vec,
    water: Water,
    thrusts: Any = (),
    before: PreviousStep | None = None,
) -> ExternalForces:
    """What the water does to the bodies of a level.

    All of it is seen from a frame that goes with the uniform current, in which the current's
    acceleration adds to gravity. The carried water enters as an inertia A and as a momentum A ν_r
    that turns with the body (Kirchhoff; Fossen 2011, Handbook of Marine Craft Hydrodynamics,
    § 6.3). Where the water's velocity u varies in space (shear, field, waves), drag takes it at
    each part and the carried water at the body's origin, where d(v - u)/dt in the body's frame is
    dv/dt + ω × u - Rᵀ du/dt.

    Args:
        world: which laws act.
        level: the bodies.
        motion: pose and velocity relative to the uniform current; the added mass's momentum turns
            with `midpoint_velocity`.
        gravity: upwards, body frames, with the uniform current's acceleration [m/s²].
        water: surface, current, time.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].
        before: the step before, for the slam (`added_mass.slam`) and for what laws remember; None
            for none.

    Returns:
        Forces, torques and inertias.
    """
    torque, force = ZERO, ZERO
    carried, damping, fractions = None, None, []
    submerged: list[Scalar] = []
    for parts, earlier in zip(level.parts, _by_group(level, before), strict=True):
        on_torque, on_force, more_carried, more_damping, fraction, saved = _water_on_parts(
            world, parts, level.count, motion, gravity, water, thrusts, earlier
        )
        if parts.saves:
            submerged.append(saved)
        torque, force = vadd(torque, on_torque), vadd(force, on_force)
        carried, damping = _plus(carried, more_carried), _plus(damping, more_damping)
        fractions.append(fraction)
    on_bodies = _body_drag(world, level, motion, water, fractions)
    if on_bodies is not None:
        torque, force = vadd(torque, on_bodies[0]), vadd(force, on_bodies[1])
    found = ExternalForces(torque, force, carried, None, damping, tuple(submerged))
    if carried is None:
        return found
    angular, velocity = motion.midpoint_velocity
    stream = _stream(world, water, motion, ZERO)
    if stream.velocity is None:
        return found
    momentum = apply_inertia(carried, ZERO, tuple(map(neg, stream.velocity)))
    # The step turns the momentum with the body's velocity, not with the relative one.
    linear = apply_inertia(carried, angular, vsub(velocity, stream.velocity))[1]
    torque = vadd(torque, cross(stream.velocity, linear))
    change = cross(angular, stream.velocity)
    if stream.acceleration is not None:
        change = vsub(change, stream.acceleration)
    turning = apply_inertia(carried, ZERO, change)
    return found._replace(
        torque=vsub(torque, turning[0]), force=vsub(force, turning[1]), momentum=momentum
    )
