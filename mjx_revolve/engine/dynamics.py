"""Articulated bodies in water, the population on the last axis: accelerations.

Featherstone's articulated-body algorithm (2008, Rigid Body Dynamics Algorithms, § 7.3) in
components (`spatial`), with the water's forces (`hydrodynamics`) and the carried water's mass
inside each body's 6×6 inertia. Written once, for one robot and for many different ones: how trees
are traversed is an argument, `bodies`, either `Levels` or `Rows`.

Spatial quantities are (angular, linear), in each body's own frame, about its own origin.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.contact import bed_on_level
from mjx_revolve.engine.hydrodynamics import Before, Outer, water_on_level
from mjx_revolve.engine.level import Hinges, Level
from mjx_revolve.engine.levels import Levels
from mjx_revolve.engine.rows import Rows
from mjx_revolve.engine.servos import end_stop, servo
from mjx_revolve.engine.state import State, felt_gravity, is_pulled
from mjx_revolve.numerics.articulated import lift_off, solve_root, to_parent, upper
from mjx_revolve.numerics.inertia import (
    Block,
    Motion,
    SpatialInertia,
    add_block,
    add_inertia,
    apply_inertia,
    block_of,
    cross_force,
    gyroscope,
    scale_inertia,
)
from mjx_revolve.numerics.spatial import (
    Mat,
    Scalar,
    Vec,
    add,
    cross,
    dot,
    full,
    matTvec,
    mul,
    neg,
    quat_to_rows,
    sincos,
    skew,
    sub,
    transpose,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.flow import Water, needs_place
from mjx_revolve.water.world import World

# How a tree is traversed: that of one robot, or those of many.
Bodies = Levels | Rows


def outer_forces(
    level: Level,
    motion: Motion,
    swirling: tuple[Vec, Vec],
    gravity: Vec,
    water: Water,
    thrusts: Any,
    world: World,
    before: Before | None = None,
) -> Outer:
    """What water, thrusters and bed do to the bodies of a level, their weight apart.

    Args:
        level: the bodies.
        motion: where they are and how they move, relative to the uniform current.
        swirling: as in `hydrodynamics.water_on_level`.
        gravity: as there.
        water: surface, current, time.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].
        world: which laws act.
        before: as in `hydrodynamics.water_on_level`.

    Returns:
        Forces, torques and inertias.
    """
    outer = water_on_level(world, level, motion, swirling, gravity, water, thrusts, before)
    if level.points is None:
        return outer
    torque, force, damping = bed_on_level(world, level, motion, level.points, water)
    if outer.damping is not None:
        damping = add_inertia(damping, outer.damping)
    return outer._replace(
        torque=vadd(outer.torque, torque), force=vadd(outer.force, force), damping=damping
    )


def with_water(
    level: Level, outer: Outer, swirling: tuple[Vec, Vec]
) -> tuple[SpatialInertia, SpatialInertia, tuple[Vec, Vec]]:
    """Inertia of each body alone and with the water that it carries, and the momentum of both.

    Args:
        level: the bodies.
        outer: what the water does to them.
        swirling: their angular and linear velocity, relative to the uniform current.

    Returns:
        The two inertias, and (angular, linear) momentum relative to the uniform current.
    """
    rigid = SpatialInertia(
        level.inertia, skew(level.moment), (level.mass, 0.0, 0.0, level.mass, 0.0, level.mass)
    )
    whole = rigid if outer.carried is None else add_inertia(rigid, outer.carried)
    momentum = apply_inertia(whole, *swirling)
    if outer.momentum is not None:
        momentum = tuple(vadd(a, b) for a, b in zip(momentum, outer.momentum, strict=True))
    return rigid, whole, momentum


def own_inertia(
    world: World,
    carries: bool,
    level: Level,
    motion: Motion,
    swirling: tuple[Vec, Vec],
    water: Water,
    thrusts: Any,
    gravity: Vec,
    dt: float,
    wet: Any,
    push: Any = (),
) -> tuple[Block, tuple[Vec, Vec], Any]:
    """Each body's inertia with its carried water, and the bias force that needs no acceleration.

    Takes the submerged shares of the step before, as `State.wet` has them, and gives those of now.
    `push` is a torque and a force about the body's origin from elsewhere, or nothing.
    Where water is carried, the whole momentum h turns by K(h) ν in the middle of the step (see
    `accelerate`), which makes the inertia's matrix unsymmetric.
    """
    before = Before(wet, dt) if wet and dt else None
    outer = outer_forces(level, motion, swirling, gravity, water, thrusts, world, before)
    weight = tuple(neg(g) for g in gravity)
    force = vadd(outer.force, vscale(level.mass, weight))
    torque = vadd(outer.torque, cross(level.moment, weight))
    if push:
        torque, force = vadd(torque, push[0]), vadd(force, push[1])
    _, inertia, momentum = with_water(level, outer, swirling)
    if outer.damping is not None and dt:
        inertia = add_inertia(inertia, scale_inertia(dt, outer.damping))
    block = block_of(inertia)
    if carries and dt:
        block = add_block(block, 0.5 * dt, gyroscope(*momentum))
    bias = cross_force(motion.spin, motion.velocity, *momentum)
    return block, (vsub(bias[0], torque), vsub(bias[1], force)), outer.wet


def turn_hinges(hinges: Hinges, angle: Scalar) -> Mat:
    """Rotation of each body's frame, parent from child."""
    sine, cosine = sincos(angle)
    c, s = hinges.offset
    cosine, sine = sub(mul(c, cosine), mul(s, sine)), add(mul(s, cosine), mul(c, sine))
    r = hinges.rotation
    return tuple(
        (
            add(mul(r[i][0], cosine), mul(r[i][1], sine)),
            sub(mul(r[i][1], cosine), mul(r[i][0], sine)),
            r[i][2],
        )
        for i in range(3)
    )


class Moving(NamedTuple):
    """What goes down the tree.

    Attributes:
        motion: of the bodies.
        ahead: their (angular, linear) velocity half a step ahead, for momenta that turn; None
            where nothing needs it.
    """

    motion: Motion
    ahead: Any

    @property
    def swirling(self) -> tuple[Vec, Vec]:
        """The velocities with which momenta turn."""
        return self.ahead or (self.motion.spin, self.motion.velocity)


def _child_rate(turn: Mat, position: Vec, rate: tuple[Vec, Vec], speed: Scalar) -> Any:
    """Angular and linear velocity of a child from those of its parent."""
    spin, velocity = rate
    below = matTvec(turn, spin)
    return (below[0], below[1], add(below[2], speed)), matTvec(
        turn, vadd(velocity, cross(spin, position))
    )


def _coriolis(rate: tuple[Vec, Vec], speed: Scalar) -> tuple[Vec, Vec]:
    """Velocity times joint velocity (Featherstone's c_J): ν × (z q̇)."""
    spin, velocity = rate
    return (
        (mul(spin[1], speed), neg(mul(spin[0], speed)), 0.0),
        (mul(velocity[1], speed), neg(mul(velocity[0], speed)), 0.0),
    )


def _row(xs: Any) -> Any:
    """The root as a level of one body."""
    return tuple(x[None] for x in xs)


def move_bodies(bodies: Bodies, state: State, located: bool, dt: float) -> tuple[Moving, Any, Any]:
    """Where all bodies are and how they move.

    Args:
        bodies: the robots.
        state: their velocities relative to the uniform current.
        located: whether anything asks where they are horizontally.
        dt: of the step [s].

    Returns:
        The root's motion, then of the bodies below it: motions with rotations (parent from child),
        and the hinges' speeds half a step ahead.
    """
    turn = tuple(_row(r) for r in quat_to_rows(state.quat))
    spin, velocity = _row(state.spin), matTvec(turn, _row(state.velocity))
    motion = Motion(
        spin=spin,
        velocity=velocity,
        up=turn[2],
        height=state.position[2][None],
        x_axis=turn[0] if located else None,
        y_axis=turn[1] if located else None,
        place=_row(state.position[:2]) if located else None,
    )
    midway, ahead = state.speed, None
    if state.pace and dt:
        half = lambda v, a: add(v, mul(0.5 * dt, a))  # noqa: E731
        linear, angular, hinges = state.pace
        midway = jax.tree.map(half, state.speed, hinges)
        ahead = tuple(
            tuple(map(half, v, _row(a))) for v, a in ((spin, angular), (velocity, linear))
        )

    def move(level: Level, parent: Moving, angle: Scalar, speed: Scalar, midway: Scalar) -> Any:
        assert level.hinges is not None
        turn = turn_hinges(level.hinges, angle)
        position, above = level.hinges.position, parent.motion
        spin, velocity = _child_rate(turn, position, (above.spin, above.velocity), speed)
        x_axis, y_axis, place = None, None, None
        if located:
            x_axis, y_axis = matTvec(turn, above.x_axis), matTvec(turn, above.y_axis)
            place = (
                add(above.place[0], dot(above.x_axis, position)),
                add(above.place[1], dot(above.y_axis, position)),
            )
        height = add(above.height, dot(above.up, position))
        ahead = parent.ahead and _child_rate(turn, position, parent.ahead, midway)
        motion = Motion(spin, velocity, matTvec(turn, above.up), height, x_axis, y_axis, place)
        found = Moving(motion, ahead)
        return found, (found, turn)

    root = Moving(motion, ahead)
    return root, bodies.down(move, root, state.angle, state.speed, midway), midway


def _is_located(bodies: Bodies, water: Water) -> bool:
    return is_pulled(water) or needs_place(bodies.world) or bodies.touches


def _flatten(block: Block, bias: tuple[Vec, Vec], symmetric: bool) -> tuple[Any, ...]:
    """A block and its bias as the numbers that are their own."""
    if symmetric:
        return upper(block.angular), block.across, upper(block.linear), bias
    return tuple(block), bias


def _unflatten(value: tuple[Any, ...], symmetric: bool) -> tuple[Block, tuple[Vec, Vec]]:
    if symmetric:
        angular, across, linear, bias = value
        return Block(full(angular), across, transpose(across), full(linear)), bias
    block, bias = value
    return Block(*block), bias


_NO_MATRIX = ((0.0,) * 3,) * 3
_NO_BLOCK = Block(_NO_MATRIX, _NO_MATRIX, _NO_MATRIX, _NO_MATRIX)
_NO_BIAS = ((0.0,) * 3, (0.0,) * 3)


def accelerate(
    bodies: Bodies,
    state: State,
    targets: Any,
    water: Water,
    thrusts: Any,
    dt: float,
    pushes: Any = (),
) -> tuple[Vec, Vec, Any, Scalar, Any]:
    """Accelerations, by the articulated-body algorithm.

    Where water is carried, the momentum h of each body with its water turns as K(h) ν, and the step
    takes ν in its middle: M ν' + K(h) (ν + dt/2 ν') = f. K is antisymmetric, so that turning does
    no work, at any step and for any share of carried water; with ν at the step's beginning it
    would feed a light body that carries many times its mass until it blows up. h itself is
    extrapolated to the middle from the step before, for second order.

    Args:
        bodies: the robots.
        state: the population, its velocities relative to the uniform current.
        targets: of the servos, as `bodies.split` has them [rad].
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].
        dt: for which turning, damping, drag and end stops are implicit [s]; 0 for none.
        pushes: what else pushes the bodies, as `collisions.Meeting.push`; () for nothing.

    Returns:
        Root: linear and angular, body frame, as rates of the body-frame components [m/s², rad/s²];
        hinges [rad/s²]; servo power, summed over the hinges without sign [W], `[lanes]`; submerged
        shares, as `State.wet`.
    """
    symmetric = not (bodies.carries and dt)
    root, moved, midway = move_bodies(bodies, state, _is_located(bodies, water), dt)

    def own_of(level: Level, moving: Moving, wet: Any, push: Any = ()) -> Any:
        gravity = felt_gravity(bodies.world, water, moving.motion)
        block, bias, wet = own_inertia(
            bodies.world, bodies.carries, level, moving.motion, moving.swirling, water, thrusts,
            gravity, dt, wet, push,
        )  # fmt: skip
        return _flatten(block, bias, symmetric), wet

    def hold(hinges: Hinges, angle: Scalar, speed: Scalar) -> tuple[Scalar, Scalar]:
        """Torque on a hinge by itself, and what is implicit of it, with the armature."""
        stop, stop_inertia = end_stop(hinges, angle, speed, dt)
        inertia = add(hinges.armature, add(mul(dt, hinges.damping), stop_inertia))
        return sub(stop, mul(hinges.damping, speed)), inertia

    def lift(level: Level, gathered: Any, *x: Any) -> tuple[Any, Any, Scalar]:
        """Tips to root: articulated inertias."""
        (moving, turn), angle, speed, midway, target, *more = x
        hinges = level.hinges
        push = more.pop() if pushes else ()
        own, wet = own_of(level, moving, more[0] if more else (), push)
        assert hinges is not None
        load, inertia = hold(hinges, angle, speed)
        block, bias = _unflatten(
            own if gathered is None else jax.tree.map(add, own, gathered), symmetric
        )
        motor, motor_inertia = servo(
            hinges,
            angle,
            speed,
            target,
            dt,
            add(block.angular[2][2], inertia),
            sub(load, bias[0][2]),
        )
        left, bias, released = lift_off(
            block,
            bias,
            add(inertia, motor_inertia),
            add(motor, load),
            _coriolis(moving.swirling, midway),
            symmetric,
        )
        block, bias = to_parent(turn, hinges.position, left, bias, symmetric)
        return (
            _flatten(block, bias, symmetric),
            (released, bodies.set_apart(wet)),
            jnp.abs(motor * speed),
        )

    gathered, kept, power = bodies.up(
        lift,
        (_flatten(_NO_BLOCK, _NO_BIAS, symmetric), 0.0),
        moved, state.angle, state.speed, midway, targets, *state.wet[1:], *pushes[1:],
    )  # fmt: skip
    own_wet = state.wet[0] if state.wet else ()
    whole, wet = own_of(bodies.root, root, own_wet, pushes[0] if pushes else ())
    if gathered is not None:
        whole = jax.tree.map(add, whole, gathered)
    angular, linear = solve_root(*_unflatten(whole, symmetric), symmetric)

    def release(level: Level, parent: Any, *x: Any) -> tuple[Any, Scalar]:
        """Root to tips: accelerations."""
        (moving, turn), midway, (released, _) = x
        assert level.hinges is not None
        up_angular, up_linear = parent
        coriolis = _coriolis(moving.swirling, midway)
        a = vadd(matTvec(turn, up_angular), coriolis[0])
        position = level.hinges.position
        b = vadd(matTvec(turn, vadd(up_linear, cross(up_angular, position))), coriolis[1])
        hinge = sub(sub(released.rest, dot(released.row_a, a)), dot(released.row_l, b))
        hinge = mul(released.inverse, hinge)
        return ((a[0], a[1], add(a[2], hinge)), b), hinge

    hinges = bodies.down(release, (angular, linear), moved, midway, kept)
    lanes, dtype = state.position[0].shape, state.position[0].dtype
    lane = lambda x: jnp.broadcast_to(jnp.asarray(x, dtype), (1, *lanes))[0]  # noqa: E731
    return (
        tuple(map(lane, linear)),
        tuple(map(lane, angular)),
        hinges,
        jnp.broadcast_to(jnp.asarray(power, dtype), lanes),
        (wet, bodies.put_together(kept, lambda x: x[1])) if state.wet else (),
    )
