"""The water on a robot: the sum of all laws over the parts of a level of bodies.

The laws are pure functions in files of their own (`buoyancy`, `drag`, `lift_drag`, `added_mass`,
`thrusters`, `water`); this file puts them together for whole levels of a robot's tree. Vectors are
tuples of three arrays (see `spatial`), per-part tables are constants `[npart, nbody, 1]`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.level import Level, Mounts, Parts, is_present
from mjx_revolve.numerics.inertia import (
    Motion,
    SpatialInertia,
    add_inertia,
    apply_inertia,
    shift_inertia,
    sum_parts,
)
from mjx_revolve.numerics.spatial import (
    Scalar,
    Sym,
    Vec,
    add,
    cross,
    dot,
    matTvec,
    matvec,
    mul,
    neg,
    rotate_sym,
    sub,
    total,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.added_mass import come_aboard, slam
from mjx_revolve.water.buoyancy import displaced, submersion, surface_tension
from mjx_revolve.water.drag import ellipsoid, inertia_box, quadratic_drag
from mjx_revolve.water.flow import Water, flow, is_uniform, surface, wave_convection
from mjx_revolve.water.lift_drag import lift_drag_damping, lift_drag_wrench
from mjx_revolve.water.world import World

_ZERO = (0.0, 0.0, 0.0)


class Outer(NamedTuple):
    """What acts on the bodies of a level from outside, about each body's origin, body frame.

    Attributes:
        torque: [N·m].
        force: [N].
        carried: inertia of the water that the bodies carry along, or None.
        momentum: what that water's momentum lacks for where the water flows by itself, (angular,
            linear) [kg·m²/s, kg·m/s], or None: A (ν - u) is A ν and this. That it turns with the
            body asks for a force that the step adds.
        damping: how force and torque fall with the bodies' velocity, as a 6×6 [N·s/m ...], for
            the implicit part of a step; or None.
        wet: submerged shares of each group of parts that carries water, `[npart, nbody, lanes]`
            each [-].
    """

    torque: Vec
    force: Vec
    carried: SpatialInertia | None
    momentum: tuple[Vec, Vec] | None
    damping: SpatialInertia | None
    wet: tuple[Scalar, ...] = ()


class Before(NamedTuple):
    """What a step knows of the one before it, for the water that comes aboard.

    Attributes:
        wet: submerged shares a step ago, as `Outer.wet`, or those of one group.
        dt: of the step [s].
    """

    wet: Any
    dt: float


class _Stream(NamedTuple):
    """The water's velocity and acceleration, body frame; None where there is none."""

    velocity: Any
    acceleration: Any


def _is_array(x: Scalar) -> bool:
    return hasattr(x, "shape")


def _some(vector: Any) -> Any:
    """A vector, or None where it is plainly zero: a traced zero counts as something."""
    if vector is None or all(isinstance(x, int | float) and x == 0 for x in vector):
        return None
    return vector


def _to_body(motion: Motion, vector: Any) -> Any:
    """A vector of the world seen from each body's frame."""
    if vector is None:
        return None
    axes = (motion.x_axis, motion.y_axis, motion.up)
    return tuple(
        total(*[mul(c, axis[i]) for c, axis in zip(vector, axes, strict=True)]) for i in range(3)
    )


def _world_place(motion: Motion, position: Vec) -> Vec:
    """World coordinates of places in the bodies' frames."""
    return (
        add(motion.place[0], dot(motion.x_axis, position)),
        add(motion.place[1], dot(motion.y_axis, position)),
        add(motion.height, dot(motion.up, position)),
    )


def _stream(world: World, water: Water, motion: Motion, position: Vec) -> _Stream:
    """The water's motion at places of the bodies, relative to the uniform current."""
    if is_uniform(world):
        return _Stream(None, None)
    rest = water._replace(current=_ZERO, acceleration=_ZERO)
    place = _world_place(motion, position)
    velocity, acceleration = flow(world, rest, *place)
    if world.waves:
        acceleration = vadd(acceleration, wave_convection(world, rest, *place))
    return _Stream(_to_body(motion, _some(velocity)), _to_body(motion, _some(acceleration)))


def _of_parts(x: Scalar) -> bool:
    """Whether a number differs from part to part, `[npart, nbody, lanes]`."""
    return _is_array(x) and x.ndim == 3


def _push(world: World, parts: Parts, v: Vec, w: Vec, share: Scalar) -> tuple[Vec, Vec, Vec | None]:
    """Force, torque and the force's damping of the drag law, part frame, at the box's centre.

    All but the drag of faces against turning: `_twist`.
    """
    if parts.laws.drag == "faces":
        push = [quadratic_drag(x, c, share) for x, c in zip(v, parts.drag_linear, strict=True)]
        return tuple(f for f, _ in push), _ZERO, tuple(d for _, d in push)
    if parts.laws.drag == "lift_drag":
        assert parts.plate is not None
        at = vadd(v, cross(w, parts.plate_center))
        plate = (parts.plate_forward, parts.plate_upward, parts.plate_area, world.density)
        force, torque = lift_drag_wrench(at, *plate, parts.plate)
        torque = vadd(torque, cross(parts.plate_center, force))
        slope = mul(lift_drag_damping(at, *plate, parts.plate), share)
        # Half of the slope: the step then takes the force in the middle of its velocities.
        half = mul(0.5, slope)
        return vscale(share, force), vscale(share, torque), (half, half, half)
    if parts.laws.drag == "ellipsoid":
        force, torque = ellipsoid(v, w, parts.ellipsoid, not world.added_mass)
        return vscale(share, force), vscale(share, torque), None
    return _ZERO, _ZERO, None


def _twist(
    parts: Parts, w: Vec, share: Scalar, gather: Callable[[Scalar], Scalar]
) -> tuple[Vec, Sym]:
    """Torque of the faces' drag against turning on each body, and its damping, body frame.

    `w` is the angular velocity, part frame.
    """
    strength = tuple(mul(c, share) for c in parts.drag_angular)
    together = not any(map(_of_parts, w))
    if together:  # all parts turn alike about their own axes
        strength = tuple(map(gather, strength))
    drag = [quadratic_drag(x, c, 1.0) for x, c in zip(w, strength, strict=True)]
    torque = matvec(parts.rotation, tuple(t for t, _ in drag))
    d = tuple(d for _, d in drag)
    damping = rotate_sym(parts.rotation, (d[0], 0.0, 0.0, d[1], 0.0, d[2]))
    if together:
        return torque, damping
    return tuple(map(gather, torque)), tuple(map(gather, damping))


def _whirl(parts: Parts, w: Vec, aboard: Scalar, gather: Callable[[Scalar], Scalar]) -> Vec:
    """Torque of the slam on what turns, on each body, body frame; `w` is in the part frame."""
    if any(map(_of_parts, w)):
        torque = matvec(parts.rotation, slam(aboard, parts.carried_inertia, w))
        return tuple(map(gather, torque))
    # All parts turn alike about their own axes.
    together = tuple(gather(mul(aboard, x)) for x in parts.carried_inertia)
    return matvec(parts.rotation, slam(1.0, together, w))


def _pressure(
    world: World,
    parts: Parts,
    share: Scalar,
    moment: Vec,
    gradient: Vec,
    gather: Callable[[Scalar], Scalar],
) -> tuple[Vec, Vec]:
    """Torque and force of the water's pressure on each body, body frame.

    Args:
        world: whose water.
        parts: of the bodies.
        share: of each part that is submerged.
        moment: as from `submersion`, part frame.
        gradient: of the pressure, over the density, body frame [m/s²].
        gather: the sum over the parts.

    Returns:
        About the bodies' origins.
    """
    mass, first = displaced(
        share,
        matvec(parts.rotation, moment),
        parts.volume,
        parts.center_position,
        world.density,
    )
    if not any(map(_of_parts, gradient)):
        mass, first = gather(mass), tuple(map(gather, first))
        return cross(first, gradient), vscale(mass, gradient)
    torque, force = cross(first, gradient), vscale(mass, gradient)
    return tuple(map(gather, torque)), tuple(map(gather, force))


class _Wet(NamedTuple):
    """How far parts are under water, `[npart, nbody, lanes]`.

    Attributes:
        share: of each part that is submerged [-].
        moment: of the submerged share, as from `submersion`, part's axes.
        up: the surface's normal, part's axes.
        depth: of the box's centre below the surface [m].
    """

    share: Scalar
    moment: Vec
    up: Vec
    depth: Scalar


def _submerge(
    world: World, parts: Parts, motion: Motion, water: Water, wide: Callable[[Scalar], Scalar]
) -> _Wet:
    height, slope = water.surface_height, None
    if world.waves:
        x, y, _ = _world_place(motion, parts.position)
        height, slope = surface(world, water, x, y)
    below = sub(height, add(motion.height, dot(motion.up, parts.position)))
    normal = motion.up
    if slope is not None:
        # Distance to the surface's tangent plane, and its normal.
        steep = jax.lax.rsqrt(1 + slope[0] * slope[0] + slope[1] * slope[1])
        below = below * steep
        normal = _to_body(motion, (-slope[0] * steep, -slope[1] * steep, steep))
    up, depth = matTvec(parts.rotation, normal), wide(below)
    # Without buoyancy the water still drags what is below its surface.
    mode = "mask" if parts.laws.buoyancy == "off" else parts.laws.buoyancy
    share, moment = submersion(up, depth, parts.half_size, mode)
    return _Wet(share, moment, up, depth)


def _pull(
    world: World, parts: Parts, wet: _Wet, wide: Callable[[Scalar], Scalar]
) -> tuple[Vec, Vec]:
    """Force and torque of the surface's tension, part's axes, at the box's centre."""
    tension = world.surface_tension
    if tension is None or parts.laws.buoyancy == "off":
        return _ZERO, _ZERO
    return surface_tension(
        tuple(map(wide, wet.up)),
        wet.depth,
        parts.half_size,
        tension.gamma,
        world.density * world.gravity,
        tension.contact_angle,
        parts.exposed,
    )


def _thrust(mounts: Mounts, share: Scalar, thrusts: jax.Array) -> tuple[Vec, Vec]:
    """Torque and force of the thrusters on each part, about the body's origin, body frame."""
    which = mounts.which
    if isinstance(which, jax.Array):  # robots differ from lane to lane
        push = total(*[jnp.where(which == k, thrusts[k], 0) for k in range(thrusts.shape[0])])
    else:
        none = jnp.zeros_like(thrusts[0])
        rows = [[thrusts[k] if k >= 0 else none for k in row] for row in which[..., 0]]
        push = jnp.stack([jnp.stack(row) for row in rows])
    # Out of the water a propeller finds nothing to push.
    force = vscale(mul(push, share), mounts.axis)
    return vsub(cross(mounts.position, force), vscale(mounts.torque_ratio, force)), force


def _sizes(parts: Parts, n: int, motion: Motion) -> Callable[[Scalar], Scalar]:
    """What makes a number of the parts as wide as all of them."""
    lanes = jnp.shape(motion.height)[-1]
    return lambda x: jnp.broadcast_to(x, (parts.count, n, lanes))


def _water_on_parts(
    world: World,
    parts: Parts,
    n: int,
    motion: Motion,
    gravity: Vec,
    water: Water,
    thrusts: Any,
    before: Before | None,
) -> tuple[Vec, Vec, SpatialInertia | None, SpatialInertia | None, Scalar]:
    """Torque, force, carried water, damping and submerged share of one group of parts."""
    k, wide = parts.count, _sizes(parts, n, motion)
    gather = lambda x: sum_parts(wide(x) if _is_array(x) else x, k)  # noqa: E731
    stream = _stream(world, water, motion, parts.position)
    v, w = _relative(parts, motion, stream)
    wet = _submerge(world, parts, motion, water, wide)
    force, torque, damping = _push(world, parts, v, w, wet.share)
    pull, turn = _pull(world, parts, wet, wide)
    force, torque = vadd(force, pull), vadd(torque, turn)
    aboard = None
    if before is not None:
        aboard = come_aboard(wet.share, before.wet, before.dt)
        force = vadd(force, slam(aboard, parts.carried_mass, v))
    force = matvec(parts.rotation, force)
    torque = vadd(matvec(parts.rotation, torque), cross(parts.position, force))
    if parts.mounts is not None:
        driven = _thrust(parts.mounts, wet.share, thrusts)
        torque, force = vadd(torque, driven[0]), vadd(force, driven[1])
    force, torque = tuple(map(gather, force)), tuple(map(gather, torque))
    if parts.laws.buoyancy != "off":
        gradient = _gradient(gravity, stream)
        righting, lift = _pressure(world, parts, wet.share, wet.moment, gradient, gather)
        torque, force = vadd(torque, righting), vadd(force, lift)
    if aboard is not None:
        torque = vadd(torque, _whirl(parts, w, aboard, gather))
    resisting = None
    if damping is not None:
        x, y, z = damping
        linear = rotate_sym(parts.rotation, (x, 0.0, 0.0, y, 0.0, z))
        one = shift_inertia(linear, (0.0,) * 6, parts.position)
        # No plate knows drag against turning; without one, a free plate spins up for ever.
        twist, turning = _twist(parts, w, wet.share, gather)
        torque = vadd(torque, twist)
        resisting = SpatialInertia(
            vadd(tuple(map(gather, one.angular)), turning),
            tuple(tuple(map(gather, row)) for row in one.cross),
            tuple(map(gather, one.linear)),
        )
    carried = None
    if parts.carries:
        weigh = lambda x: sum_parts(mul(x, wet.share), k) if is_present(x) else 0.0  # noqa: E731
        carried = jax.tree.map(weigh, parts.carried)
    return torque, force, carried, resisting, wet.share


def _relative(parts: Parts, motion: Motion, stream: _Stream) -> tuple[Vec, Vec]:
    """Velocity of the parts' centres relative to the water, and spin, part's axes."""
    velocity = vadd(motion.velocity, cross(motion.spin, parts.position))
    relative = velocity if stream.velocity is None else vsub(velocity, stream.velocity)
    return matTvec(parts.rotation, relative), matTvec(parts.rotation, motion.spin)


def _gradient(gravity: Vec, stream: _Stream) -> Vec:
    """Of the pressure: it holds up what is still, and pushes along with moving water [m/s²]."""
    return gravity if stream.acceleration is None else vadd(gravity, stream.acceleration)


class PartForces(NamedTuple):
    """Forces on parts one by one, body frame, three of `[npart, nbody, lanes]` each [N].

    Attributes:
        buoyancy: of the water's pressure: Archimedes', what accelerating water adds to it, and the
            pull of the surface where the world has one.
        drag: of the water that flows past, the lift of fins included.
        thrust: of the thrusters.
    """

    buoyancy: Vec
    drag: Vec
    thrust: Vec


def forces_on_parts(
    world: World, level: Level, motion: Motion, gravity: Vec, water: Water, thrusts: Any
) -> list[PartForces]:
    """The terms of `water_on_level`, part by part and kind by kind, before they are added up.

    Args:
        world: which laws act.
        level: the bodies.
        motion: where they are and how they move, relative to the uniform current.
        gravity: as in `water_on_level`.
        water: surface, current, time.
        thrusts: of the robot's thrusters, `[nthruster, lanes]` [N].

    Returns:
        For each group of the level's parts. MuJoCo's inertia-box law, which knows only whole
        bodies, is shared out among a body's parts by what of their boxes is submerged.
    """
    found, shares = [], []
    for parts in level.parts:
        wide = _sizes(parts, level.count, motion)
        each = lambda vector, wide=wide: tuple(wide(x) for x in vector)  # noqa: E731
        stream = _stream(world, water, motion, parts.position)
        v, w = _relative(parts, motion, stream)
        wet = _submerge(world, parts, motion, water, wide)
        shares.append(wet.share)
        lift = matvec(parts.rotation, _pull(world, parts, wet, wide)[0])
        if parts.laws.buoyancy != "off":
            gradient = _gradient(gravity, stream)
            held = _pressure(world, parts, wet.share, wet.moment, gradient, wide)[1]
            lift = vadd(lift, held)
        drag = matvec(parts.rotation, _push(world, parts, v, w, wet.share)[0])
        push: Vec = _ZERO
        if parts.mounts is not None:
            push = _thrust(parts.mounts, wet.share, thrusts)[1]
        found.append(PartForces(each(lift), each(drag), each(push)))
    if world.drag == "inertia_box":
        force = _inertia_box(world, level, motion, water, _share_of_body(level, shares))[1]
        total_wet = total(
            *[
                sum_parts(mul(parts.bulk, share), parts.count)
                for parts, share in zip(level.parts, shares, strict=True)
            ]
        )
        for k, (parts, share) in enumerate(zip(level.parts, shares, strict=True)):
            part = mul(parts.bulk, share) / jnp.maximum(total_wet, 1e-30)
            own = tuple(mul(part, x) for x in force)
            found[k] = found[k]._replace(drag=vadd(found[k].drag, own))
    return found


def _plus(a: SpatialInertia | None, b: SpatialInertia | None) -> SpatialInertia | None:
    if a is None or b is None:
        return a if b is None else b
    return add_inertia(a, b)


def _share_of_body(level: Level, shares: Sequence[Scalar]) -> Scalar:
    """Submerged share of each body, its parts weighted by their boxes' volume.

    Not by what they displace: a part of no volume of its own is dragged, too.
    """
    n = level.count
    wet, whole = 0.0, 1e-30
    for parts, share in zip(level.parts, shares, strict=True):
        k, volume = parts.count, parts.bulk
        if not isinstance(volume, jax.Array):
            volume = np.broadcast_to(np.asarray(volume), (k, n, 1))
        wet = add(wet, sum_parts(mul(volume, share), k))
        whole = add(whole, sum(volume[i] for i in range(k)))
    return mul(1 / whole, wet)


def _inertia_box(
    world: World, level: Level, motion: Motion, water: Water, share: Scalar
) -> tuple[Vec, Vec]:
    """Torque and force of MuJoCo's inertia-box law on each body."""
    box = level.box
    assert box is not None
    stream = _stream(world, water, motion, box.position)
    at = vadd(motion.velocity, cross(motion.spin, box.position))
    at = at if stream.velocity is None else vsub(at, stream.velocity)
    force, torque = inertia_box(
        matTvec(box.rotation, at),
        matTvec(box.rotation, motion.spin),
        box.size,
        world.density,
        world.viscosity,
    )
    force = vscale(share, matvec(box.rotation, force))
    torque = vscale(share, matvec(box.rotation, torque))
    return vadd(torque, cross(box.position, force)), force


def water_on_level(
    world: World,
    level: Level,
    motion: Motion,
    swirling: tuple[Vec, Vec],
    gravity: Vec,
    water: Water,
    thrusts: Any = (),
    before: Before | None = None,
) -> Outer:
    """What the water does to the bodies of a level.

    All of it is seen from a frame that goes with the uniform current, in which the current's
    acceleration adds to gravity. The carried water enters as an inertia A and as a momentum A ν_r
    that turns with the body (Kirchhoff; Fossen 2011, Handbook of Marine Craft Hydrodynamics,
    § 6.3). Where the water's velocity u differs from place to place (shear, field, waves), drag
    sees it at each part and the carried water at the body's origin, where d(v - u)/dt in the body's
    frame is dv/dt + ω × u - Rᵀ du/dt.

    Args:
        world: which laws act.
        level: the bodies.
        motion: where they are and how they move, relative to the uniform current.
        swirling: their angular and linear velocity [rad/s, m/s] for the carried water's momentum;
            a step takes them in its middle.
        gravity: upwards, body frames, with the uniform current's acceleration [m/s²].
        water: surface, current, time.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].
        before: the step before, for the slam (`added_mass.slam`); None for none.

    Returns:
        Forces, torques and inertias.
    """
    torque, force = _ZERO, _ZERO
    carried, damping, shares = None, None, []
    wet: list[Scalar] = []
    for parts in level.parts:
        earlier = None
        if before is not None and parts.carries:
            earlier = before._replace(wet=before.wet[len(wet)])
        on_torque, on_force, more_carried, more_damping, share = _water_on_parts(
            world, parts, level.count, motion, gravity, water, thrusts, earlier
        )
        if parts.carries:
            wet.append(share)
        torque, force = vadd(torque, on_torque), vadd(force, on_force)
        carried, damping = _plus(carried, more_carried), _plus(damping, more_damping)
        shares.append(share)
    if world.drag == "inertia_box":
        on_torque, on_force = _inertia_box(
            world, level, motion, water, _share_of_body(level, shares)
        )
        torque, force = vadd(torque, on_torque), vadd(force, on_force)
    if carried is None:
        return Outer(torque, force, None, None, damping)
    spin, velocity = swirling
    stream = _stream(world, water, motion, _ZERO)
    if stream.velocity is None:
        return Outer(torque, force, carried, None, damping, tuple(wet))
    momentum = apply_inertia(carried, _ZERO, tuple(map(neg, stream.velocity)))
    # The step turns the momentum with the body's velocity, not with the relative one.
    linear = apply_inertia(carried, spin, vsub(velocity, stream.velocity))[1]
    torque = vadd(torque, cross(stream.velocity, linear))
    change = cross(spin, stream.velocity)
    if stream.acceleration is not None:
        change = vsub(change, stream.acceleration)
    turning = apply_inertia(carried, _ZERO, change)
    torque, force = vsub(torque, turning[0]), vsub(force, turning[1])
    return Outer(torque, force, carried, momentum, damping, tuple(wet))
