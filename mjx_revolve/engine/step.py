"""One step of a whole population: articulated bodies in water, the population on the last axis.

Featherstone's articulated-body algorithm (2008, Rigid Body Dynamics Algorithms, § 7.3) in
components (`spatial`), with the water's forces (`hydrodynamics`) and the carried water's mass
inside each body's 6×6 inertia. Integration is MuJoCo's semi-implicit Euler with implicit joint
damping, so that trajectories can be compared step by step.

Everything here is written once, for one robot and for many different ones: how trees are traversed
is an argument, `bodies`, either `Levels` or `Rows`.

Spatial quantities are (angular, linear), in each body's own frame, about its own origin.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.contact import bed_on_level
from mjx_revolve.engine.hydrodynamics import Outer, forces_on_parts, water_on_level
from mjx_revolve.engine.level import Hinges, Level
from mjx_revolve.engine.levels import Levels, make_levels
from mjx_revolve.engine.plant import Plant, actuators_of, plant_of
from mjx_revolve.engine.robot import Robot, check_timestep
from mjx_revolve.engine.rows import Rows
from mjx_revolve.engine.servos import end_stop, servo
from mjx_revolve.engine.thrusters import run_thrusters
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
    matvec,
    mul,
    neg,
    quat_to_rows,
    sincos,
    skew,
    sub,
    total,
    transpose,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.flow import Water, needs_place
from mjx_revolve.water.world import World

# How a tree is traversed: that of one robot, or those of many.
Bodies = Levels | Rows


class State(NamedTuple):
    """State of a population, component by component.

    Attributes:
        position: of the root, world frame [m], three of `[lanes]`.
        quat: of the root, world from body (w, x, y, z), four of `[lanes]`.
        velocity: of the root's origin, world frame [m/s], three of `[lanes]`.
        spin: angular velocity of the root, body frame [rad/s], three of `[lanes]`.
        angle: of the hinges, as `bodies.spread` has them: `[nbody, lanes]` for each level below
            the root, or `[rows, 1, lanes]` [rad].
        speed: of the hinges, likewise [rad/s].
        pace: accelerations of the step before, (linear, angular, hinges); the root's as rates of
            its body-frame velocities; empty where nothing needs them.
        command: of the thrusters, behind their lag, `[nthruster, lanes]` [-]; empty without.
    """

    position: Vec
    quat: tuple[Scalar, Scalar, Scalar, Scalar]
    velocity: Vec
    spin: Vec
    angle: Any
    speed: Any
    pace: Any = ()
    command: Any = ()


class Root(NamedTuple):
    """Where the core is and how it moves, component by component, `[lanes]` each.

    Attributes:
        position: of its origin, world frame [m].
        quat: world from body (w, x, y, z).
        velocity: of its origin, world frame [m/s].
        spin: angular velocity, body frame [rad/s].
    """

    position: Vec
    quat: tuple[Scalar, Scalar, Scalar, Scalar]
    velocity: Vec
    spin: Vec


class Engine(NamedTuple):
    """What a rollout needs of a simulator; the population step and MJX's give the same.

    Attributes:
        init: (qpos `[nq, lanes]`, qvel `[nv, lanes]`) → state.
        step: (state, ctrl `[n, lanes]` in the plant's order, water) → (state, power `[lanes]` that
            the servos deliver or take up, summed without sign [W]).
        observe: state → (qpos `[nq, lanes]`, qvel `[nv, lanes]`).
        root: state → where the core is and how it moves; cheaper than observe.
        command: state → the thrusters' commands behind their lag, `[nthruster, lanes]` [-].
        push: (state, ctrl, water) → (force of the bed, force of the water) on the whole robot,
            world frame, three of `[lanes]` each [N]; weight and carried water's inertia apart.
        plant: the actuators in the order of `step`'s ctrl.
        fuses: whether a step is element-wise, so that it may be compiled as one function.
    """

    init: Callable[[jax.Array, jax.Array], Any]
    step: Callable[[Any, jax.Array, Water], tuple[Any, jax.Array]]
    observe: Callable[[Any], tuple[jax.Array, jax.Array]]
    root: Callable[[Any], Root]
    command: Callable[[Any], jax.Array]
    push: Callable[[Any, jax.Array, Water], tuple[Vec, Vec]]
    plant: Plant
    fuses: bool


# ------------------------------------------------------------------ bodies by themselves


def outer_forces(
    level: Level,
    motion: Motion,
    swirling: tuple[Vec, Vec],
    gravity: Vec,
    water: Water,
    thrusts: Any,
    world: World,
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

    Returns:
        Forces, torques and inertias.
    """
    outer = water_on_level(world, level, motion, swirling, gravity, water, thrusts)
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
) -> tuple[Block, tuple[Vec, Vec]]:
    """Each body's inertia with its carried water, and the bias force that needs no acceleration.

    Where water is carried, the whole momentum h turns by K(h) ν in the middle of the step (see
    `accelerate`), which makes the inertia's matrix unsymmetric.
    """
    outer = outer_forces(level, motion, swirling, gravity, water, thrusts, world)
    weight = tuple(neg(g) for g in gravity)
    force = vadd(outer.force, vscale(level.mass, weight))
    torque = vadd(outer.torque, cross(level.moment, weight))
    _, inertia, momentum = with_water(level, outer, swirling)
    if outer.damping is not None and dt:
        inertia = add_inertia(inertia, scale_inertia(dt, outer.damping))
    block = block_of(inertia)
    if carries and dt:
        block = add_block(block, 0.5 * dt, gyroscope(*momentum))
    bias = cross_force(motion.spin, motion.velocity, *momentum)
    return block, (vsub(bias[0], torque), vsub(bias[1], force))


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


class _Moving(NamedTuple):
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


def _move(bodies: Bodies, state: State, located: bool, dt: float) -> tuple[_Moving, Any, Any, Any]:
    """Where all bodies are and how they move.

    Args:
        bodies: the robots.
        state: their velocities relative to the uniform current.
        located: whether anything asks where they are horizontally.
        dt: of the step [s].

    Returns:
        The root's motion, then of the bodies below it: motions, rotations (parent from child), and
        the hinges' speeds half a step ahead.
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
    turns = bodies.map(lambda level, angle: turn_hinges(level.hinges, angle), state.angle)

    def move(level: Level, parent: _Moving, turn: Mat, speed: Scalar, midway: Scalar) -> Any:
        assert level.hinges is not None
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
        found = _Moving(motion, ahead)
        return found, found

    root = _Moving(motion, ahead)
    return root, bodies.down(move, root, turns, state.speed, midway), turns, midway


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
    bodies: Bodies, state: State, targets: Any, water: Water, thrusts: Any, dt: float
) -> tuple[Vec, Vec, Any, Scalar]:
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

    Returns:
        Root: linear and angular, body frame, as rates of the body-frame components [m/s², rad/s²];
        hinges [rad/s²]; servo power, summed over the hinges without sign [W], `[lanes]`.
    """
    symmetric = not (bodies.carries and dt)
    root, moved, turns, midway = _move(bodies, state, _is_located(bodies, water), dt)

    def own_of(level: Level, moving: _Moving) -> Any:
        gravity = felt_gravity(bodies.world, water, moving.motion)
        block, bias = own_inertia(
            bodies.world, bodies.carries, level, moving.motion, moving.swirling, water, thrusts,
            gravity, dt,
        )  # fmt: skip
        return _flatten(block, bias, symmetric)

    def hold(level: Level, angle: Scalar, speed: Scalar) -> tuple[Scalar, Scalar]:
        """Torque on a hinge by itself, and what is implicit of it, with the armature."""
        hinges = level.hinges
        assert hinges is not None
        stop, stop_inertia = end_stop(hinges, angle, speed, dt)
        inertia = add(hinges.armature, add(mul(dt, hinges.damping), stop_inertia))
        return sub(stop, mul(hinges.damping, speed)), inertia

    def lift(level: Level, gathered: Any, *x: Any) -> tuple[Any, Any, Scalar]:
        """Tips to root: articulated inertias."""
        moving, turn, (load, inertia), angle, speed, midway, target = x
        hinges, own = level.hinges, own_of(level, moving)
        assert hinges is not None
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
        return _flatten(block, bias, symmetric), released, jnp.abs(motor * speed)

    held = bodies.map(hold, state.angle, state.speed)
    gathered, released, power = bodies.up(
        lift,
        (_flatten(_NO_BLOCK, _NO_BIAS, symmetric), 0.0),
        moved, turns, held, state.angle, state.speed, midway, targets,
    )  # fmt: skip
    whole = own_of(bodies.root, root)
    if gathered is not None:
        whole = jax.tree.map(add, whole, gathered)
    angular, linear = solve_root(*_unflatten(whole, symmetric), symmetric)

    def release(level: Level, parent: Any, *x: Any) -> tuple[Any, Scalar]:
        """Root to tips: accelerations."""
        moving, turn, midway, released = x
        assert level.hinges is not None
        up_angular, up_linear = parent
        coriolis = _coriolis(moving.swirling, midway)
        a = vadd(matTvec(turn, up_angular), coriolis[0])
        position = level.hinges.position
        b = vadd(matTvec(turn, vadd(up_linear, cross(up_angular, position))), coriolis[1])
        hinge = sub(sub(released.rest, dot(released.row_a, a)), dot(released.row_l, b))
        hinge = mul(released.inverse, hinge)
        return ((a[0], a[1], add(a[2], hinge)), b), hinge

    hinges = bodies.down(release, (angular, linear), moved, turns, midway, released)
    lanes, dtype = state.position[0].shape, state.position[0].dtype
    lane = lambda x: jnp.broadcast_to(jnp.asarray(x, dtype), (1, *lanes))[0]  # noqa: E731
    return (
        tuple(map(lane, linear)),
        tuple(map(lane, angular)),
        hinges,
        jnp.broadcast_to(jnp.asarray(power, dtype), lanes),
    )


def push_of(bodies: Bodies, state: State, water: Water, thrusts: Any) -> tuple[Vec, Vec]:
    """Force of the bed and of the water on whole robots, world frame, `[lanes]` each [N].

    Weight is no force of the water's, and the inertia of what it carries along is no force at all.

    Args:
        bodies: the robots.
        state: the population.
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].

    Returns:
        (force of the bed, force of the water), three components each.
    """
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    root, moved, *_ = _move(bodies, relative, True, 0.0)
    world = bodies.world

    def pushes(level: Level, gathered: Any, moving: _Moving) -> tuple[Any, Any, Any]:
        motion = moving.motion
        gravity = felt_gravity(world, water, motion)
        outer = water_on_level(world, level, motion, moving.swirling, gravity, water, thrusts)
        bed: Vec = (0.0, 0.0, 0.0)
        if level.points is not None:
            bed = bed_on_level(world, level, motion, level.points, water)[1]
        axes = (motion.x_axis, motion.y_axis, motion.up)
        wide = lambda x: add(x, jnp.zeros_like(motion.height))  # noqa: E731
        turned = tuple(
            tuple(wide(dot(axis, force)) for axis in axes) for force in (bed, outer.force)
        )
        return (), (), turned

    nothing = ((0.0,) * 3, (0.0,) * 3)
    _, _, below = bodies.up(pushes, ((), nothing), moved)
    own = jax.tree.map(lambda x: x[0], pushes(bodies.root, None, root)[2])
    bed, wet = jax.tree.map(add, own, below)
    return bed, wet


def part_forces(
    levels: Levels, state: State, water: Water, thrusts: Any
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Forces of the water on a robot's parts one by one, by the terms that the step adds up.

    Args:
        levels: the robot.
        state: of the population.
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].

    Returns:
        Buoyancy, drag and thrust, world frame, `[lanes, npart, 3]` each [N]; parts in the order of
        the fluid table.
    """
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    root, moved, *_ = _move(levels, relative, True, 0.0)
    lanes, count = state.position[0].shape[0], len(levels.robot.fluid.volume)
    found = [jnp.zeros((lanes, count, 3), state.position[0].dtype) for _ in range(3)]
    for level, moving, groups in zip(levels.all, (root, *moved), levels.part_rows, strict=True):
        motion = moving.motion
        gravity = felt_gravity(levels.world, water, motion)
        terms = forces_on_parts(levels.world, level, motion, gravity, water, thrusts)
        axes = (motion.x_axis, motion.y_axis, motion.up)
        for rows, forces in zip(groups, terms, strict=True):
            for k, force in enumerate(forces):
                turned = jnp.stack([dot(axis, force) * jnp.ones(lanes) for axis in axes], -1)
                for slot, body in zip(*np.nonzero(rows >= 0), strict=True):
                    found[k] = found[k].at[:, rows[slot, body]].set(turned[slot, body])
    buoyancy, drag, thrust = found
    return buoyancy, drag, thrust


# ------------------------------------------------------------------ the step


def turn_quat(quat: tuple[Scalar, ...], spin: Vec, dt: float) -> tuple[Scalar, ...]:
    """Turns a quaternion by a body-frame rotation of spin · dt, and normalises it."""
    half = vscale(0.5 * dt, spin)
    square = dot(half, half)
    if square.dtype == jnp.float32:
        # sin(x)/x and cos(x) as series: below half a turn per step they are exact to float32.
        sine = 1 + square * (-1 / 6 + square * (1 / 120 + square * (-1 / 5040)))
        cosine = 1 + square * (-1 / 2 + square * (1 / 24 + square * (-1 / 720)))
    else:
        angle = jnp.sqrt(square + 1e-300)
        sine, cosine = jnp.sin(angle) / angle, jnp.cos(angle)
    a, b, c, d = quat
    e, (f, g, h) = cosine, vscale(sine, half)
    turned = (
        a * e - b * f - c * g - d * h,
        a * f + b * e + c * h - d * g,
        a * g - b * h + c * e + d * f,
        a * h + b * g - c * f + d * e,
    )
    scale = 1 / jnp.sqrt(total(*[x * x for x in turned]))
    return tuple(x * scale for x in turned)


def advance(state: State, water: Water, pace: Any, dt: float, carries: bool) -> State:
    """The state after a step: semi-implicit Euler, velocities before positions.

    Args:
        state: before it.
        water: its uniform current, in which the step is seen.
        pace: accelerations, (linear, angular, hinges); the root's as rates of its body-frame
            velocities [m/s², rad/s²].
        dt: [s].
        carries: whether water is carried along.

    Returns:
        The state; thrusters' commands as they were.
    """
    linear, angular, hinges = pace
    spin = tuple(w + dt * a for w, a in zip(state.spin, angular, strict=True))
    forward = lambda x, rate: x + dt * rate  # noqa: E731
    speed = jax.tree.map(forward, state.speed, hinges)
    turn, quat = quat_to_rows(state.quat), turn_quat(state.quat, spin, dt)
    relative = vsub(state.velocity, water.current)
    seen = matTvec(turn, relative)
    if carries:
        # Momentum is kept in the body's frame, so velocity turns with it.
        ahead = tuple(v + dt * a for v, a in zip(seen, linear, strict=True))
        velocity = vadd(matvec(quat_to_rows(quat), ahead), water.current)
    else:
        # As MuJoCo: the body-frame rate and the frame's turning make the world's acceleration.
        push = matvec(turn, vadd(linear, cross(state.spin, seen)))
        velocity = vadd(state.velocity, vscale(dt, push))
    if is_pulled(water):
        velocity = vadd(velocity, vscale(dt, water.acceleration))
    return State(
        position=tuple(x + dt * v for x, v in zip(state.position, velocity, strict=True)),
        quat=quat,
        velocity=velocity,
        spin=spin,
        angle=jax.tree.map(forward, state.angle, speed),
        speed=speed,
        pace=pace if carries else (),
        command=state.command,
    )


def is_pulled(water: Water) -> bool:
    """Whether the uniform current has an acceleration; a traced one counts."""
    return any(not isinstance(x, int | float) or x != 0 for x in water.acceleration)


def felt_gravity(world: World, water: Water, motion: Motion) -> Vec:
    """Gravity upwards in the bodies' frames, with the acceleration of a gusty current [m/s²].

    In a frame that goes with the current, its acceleration is felt as weight is.
    """
    gravity = vscale(world.gravity, motion.up)
    if is_pulled(water):
        axes = (motion.x_axis, motion.y_axis, motion.up)
        for push, axis in zip(water.acceleration, axes, strict=True):
            gravity = vadd(gravity, vscale(push, axis))
    return gravity


# ------------------------------------------------------------------ the engine


def init(bodies: Bodies, qpos: jax.Array, qvel: jax.Array) -> State:
    """The state of a population.

    Args:
        bodies: the robots.
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.

    Returns:
        The state; thrusters at rest.
    """
    # MuJoCo accepts quaternions of any length and normalises them before use.
    length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
    velocity, spin = tuple(qvel[:3]), tuple(qvel[3:6])
    speed = bodies.spread(qvel[6:])
    pace = jax.tree.map(jnp.zeros_like, (velocity, spin, speed)) if bodies.carries else ()
    count = bodies.thrusters.count
    return State(
        position=tuple(qpos[:3]),
        quat=tuple(qpos[3:7] / length),
        velocity=velocity,
        spin=spin,
        angle=bodies.spread(qpos[7:]),
        speed=speed,
        pace=pace,
        command=jnp.zeros((count, *qpos.shape[1:]), qpos.dtype) if count else (),
    )


def observe(bodies: Bodies, state: State) -> tuple[jax.Array, jax.Array]:
    """Qpos `[nq, lanes]` and qvel `[nv, lanes]` in MuJoCo's order."""
    like = state.position[0]
    qpos = jnp.stack([*state.position, *state.quat])
    qvel = jnp.stack([*state.velocity, *state.spin])
    return (
        jnp.concatenate([qpos, bodies.gather(state.angle, like)]),
        jnp.concatenate([qvel, bodies.gather(state.speed, like)]),
    )


def _drive(bodies: Bodies, state: State, ctrl: jax.Array) -> tuple[Any, Any, Any, Scalar]:
    """Targets of the servos, then the thrusters' commands, thrusts and power."""
    count = bodies.thrusters.count
    hinges = ctrl.shape[0] - count
    targets = bodies.split(ctrl[:hinges])
    if not count:
        return targets, (), (), 0.0
    command, thrusts, pumped = run_thrusters(
        bodies.thrusters, state.command, ctrl[hinges:], bodies.world.density
    )
    return targets, command, thrusts, total(*[pumped[k] for k in range(count)])


def step(bodies: Bodies, state: State, ctrl: jax.Array, water: Water) -> tuple[State, jax.Array]:
    """One step.

    Args:
        bodies: the robots.
        state: the population.
        ctrl: `[n, lanes]` targets [rad] and commands [-] in the plant's order.
        water: surface and current.

    Returns:
        The state after it, and the power of servos and ideal propellers, `[lanes]` [W].
    """
    dt = bodies.world.timestep
    targets, command, thrusts, pumped = _drive(bodies, state, ctrl)
    # The whole step is seen from the uniform current: there, no current is left.
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    *pace, power = accelerate(bodies, relative, targets, water, thrusts, dt)
    new = advance(state, water, tuple(pace), dt, bodies.carries)
    return new._replace(command=command), add(power, pumped)


def root_of(state: State) -> Root:
    """Where the core is and how it moves."""
    return Root(state.position, state.quat, state.velocity, state.spin)


def make_step_engine(bodies: Bodies, plant: Plant) -> Engine:
    """The population step as an engine; its functions are pure, and run under jit, vmap and grad.

    Args:
        bodies: the robots.
        plant: their actuators.

    Returns:
        The engine.
    """

    def command(state: State) -> jax.Array:
        lanes = state.position[0]
        return state.command if bodies.thrusters.count else jnp.zeros((0, *lanes.shape))

    def push(state: State, ctrl: jax.Array, water: Water) -> tuple[Vec, Vec]:
        return push_of(bodies, state, water, _drive(bodies, state, ctrl)[2])

    return Engine(
        init=partial(init, bodies),
        step=partial(step, bodies),
        observe=partial(observe, bodies),
        root=root_of,
        command=command,
        push=push,
        plant=plant,
        fuses=True,
    )


def make_population_engine(robot: Robot, contact: bool = True) -> Engine:
    """The population step of one robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; leaving it out makes a step much cheaper.

    Returns:
        The engine.

    Raises:
        InputError: the model holds something that the population step cannot do.
    """
    levels = make_levels(robot, contact)
    check_timestep(robot)
    return make_step_engine(levels, level_plant(levels))


def level_plant(levels: Levels) -> Plant:
    """The plant of one robot in the order of its levels."""
    robot = levels.robot
    hinges = [robot.servos[k] for k in levels.hinge_order]
    return plant_of(robot, [*hinges, *robot.thrusters])


def robot_acceleration(
    robot: Robot, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> jax.Array:
    """The same for one robot, its `[nu, lanes]` ctrl in MuJoCo's order."""
    levels = make_levels(robot)
    asked = level_plant(levels).arrange(ctrl[actuators_of(robot)])
    return acceleration(levels, qpos, qvel, asked, water)


def acceleration(
    bodies: Bodies, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> jax.Array:
    """Acceleration of a population in MuJoCo's coordinates, as `mj_forward` defines it.

    Args:
        bodies: the robots.
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        ctrl: `[n, lanes]` servo targets [rad] and thrusters' commands [-], in the plant's order; a
            thruster with a lag is still.
        water: surface and current.

    Returns:
        `[nv, lanes]` qacc: root linear, world frame [m/s²], root angular, body frame [rad/s²],
        hinges [rad/s²].
    """
    state = init(bodies, qpos, qvel)._replace(pace=())
    # As in mj_forward, a thruster behind a lag has not heard of its command yet.
    targets, _, thrusts, _ = _drive(bodies, state, ctrl)
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    linear, angular, hinges, _ = accelerate(bodies, relative, targets, water, thrusts, 0.0)
    turn = quat_to_rows(state.quat)
    seen = matTvec(turn, relative.velocity)
    linear = matvec(turn, vadd(linear, cross(state.spin, seen)))
    root = jnp.stack([*vadd(linear, water.acceleration), *angular])
    return jnp.concatenate([root, bodies.gather(hinges, state.position[0])])
