"""One step of a whole population: an articulated body in water, the population on the last axis.

Featherstone's articulated-body algorithm (2008, Rigid Body Dynamics Algorithms, § 7.3) over levels
of bodies, in components (`spatial`), with the water's forces (`hydrodynamics`) and the carried
water's mass inside each body's 6×6 inertia. Integration is MuJoCo's semi-implicit Euler with
implicit joint damping, so that trajectories can be compared step by step.

Spatial quantities are (angular, linear), in each body's own frame, about its own origin.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.contact import bed_on_level
from mjx_revolve.engine.hydrodynamics import Outer, water_on_level
from mjx_revolve.engine.robot import Robot, check_timestep
from mjx_revolve.engine.servos import end_stop, servo
from mjx_revolve.engine.tree import Level, Propeller, Tree, make_tree
from mjx_revolve.numerics.articulated import lift_off, plus, solve_root, to_parent, upper
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
    fold,
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
from mjx_revolve.water.thrusters import clamp_command, ideal_power, lag_command, thrust
from mjx_revolve.water.world import World


class State(NamedTuple):
    """State of a population, component by component.

    Attributes:
        position: of the root, world frame [m], three of `[lanes]`.
        quat: of the root, world from body (w, x, y, z), four of `[lanes]`.
        velocity: of the root's origin, world frame [m/s], three of `[lanes]`.
        spin: angular velocity of the root, body frame [rad/s], three of `[lanes]`.
        angle: of the hinges, one `[nbody, lanes]` for each level below the root [rad].
        speed: of the hinges, likewise [rad/s].
        pace: accelerations of the step before, (linear, angular, hinges); the root's as rates of
            its body-frame velocities; empty where nothing needs them.
        command: of the thrusters, behind their lag, one `[lanes]` each [-].
    """

    position: Vec
    quat: tuple[Scalar, Scalar, Scalar, Scalar]
    velocity: Vec
    spin: Vec
    angle: tuple[jax.Array, ...]
    speed: tuple[jax.Array, ...]
    pace: Any = ()
    command: tuple[jax.Array, ...] = ()


class Sense(NamedTuple):
    """What a controller may know of a robot's state, `[lanes]` each.

    Attributes:
        height: z of the core's centre above the still surface, negative under water [m].
        climb: its vertical velocity [m/s].
        up: the world's vertical, core frame, three of `[lanes]` [-].
        spin: angular velocity, core frame, three of `[lanes]` [rad/s].
    """

    height: jax.Array
    climb: jax.Array
    up: Vec
    spin: Vec


class Engine(NamedTuple):
    """What a rollout needs of a simulator; the population step and MJX's give the same.

    Attributes:
        init: (qpos `[nq, lanes]`, qvel `[nv, lanes]`) → state.
        step: (state, ctrl `[nu, lanes]` in `order`, water) → (state, power `[lanes]` that the
            servos deliver or take up, summed without sign [W]).
        observe: state → (qpos `[nq, lanes]`, qvel `[nv, lanes]`).
        root: state → root position, world frame [m], three of `[lanes]`; cheaper than observe.
        sense: state → what a controller may know of it.
        command: state → the thrusters' commands behind their lag, `[nthruster, lanes]` [-].
        order: `[nu]` actuator of each row of `step`'s ctrl.
    """

    init: Callable[[jax.Array, jax.Array], Any]
    step: Callable[[Any, jax.Array, Water], tuple[Any, jax.Array]]
    observe: Callable[[Any], tuple[jax.Array, jax.Array]]
    root: Callable[[Any], Vec]
    sense: Callable[[Any], Sense]
    command: Callable[[Any], jax.Array]
    order: np.ndarray


# ------------------------------------------------------------------ between the levels


def _take(x: Scalar, k: int) -> Scalar:
    return x[k : k + 1] if hasattr(x, "shape") and x.shape[0] > 1 else x


def _down(level: Level, x: Any) -> Any:
    """A quantity of the level above, for each body of this one."""
    if isinstance(x, tuple):
        return tuple(_down(level, y) for y in x)
    if x is None or not hasattr(x, "shape") or x.shape[0] == 1:
        return x
    if level.parent == tuple(range(x.shape[0])):
        return x
    return jnp.concatenate([x[k : k + 1] for k in level.parent])


def _up(level: Level, above: int, x: Any) -> Any:
    """The sum over each parent's children, for each body of the level above."""
    if isinstance(x, tuple):
        return tuple(_up(level, above, y) for y in x)
    if level.parent == tuple(range(above)):
        return x
    n = len(level.parent)
    if not isinstance(x, jax.Array):  # a constant stays one, so that it still folds away
        rows = np.broadcast_to(x, (n, 1))
        children = np.equal.outer(range(above), level.parent)
        return fold(children @ rows)
    if x.shape[0] == 1 and n > 1:
        x = jnp.broadcast_to(x, (n, *x.shape[1:]))
    if above == 1:
        return total(*[x[k : k + 1] for k in range(n)])
    sums = []
    for parent in range(above):
        children = [x[k : k + 1] for k in range(n) if level.parent[k] == parent]
        sums.append(total(*children) if children else jnp.zeros_like(x[:1]))
    return jnp.concatenate(sums)


# ------------------------------------------------------------------ articulated bodies


def outer_forces(
    level: Level,
    motion: Motion,
    swirling: tuple[Vec, Vec],
    gravity: Vec,
    water: Water,
    thrusts: Sequence[Scalar],
    world: World,
) -> Outer:
    """What water, thrusters and bed do to the bodies of a level, their weight apart.

    Args:
        level: the bodies.
        motion: where they are and how they move, relative to the uniform current.
        swirling: as in `hydrodynamics.water_on_level`.
        gravity: as there.
        water: surface, current, time.
        thrusts: of the robot's thrusters, `[lanes]` each [N].
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
    thrusts: Sequence[Scalar],
    gravity: Vec,
    dt: float,
) -> tuple[Block, tuple[Vec, Vec]]:
    """Each body's inertia with its carried water, and the bias force that needs no acceleration.

    Where water is carried, the whole momentum h turns by K(h) ν in the middle of the step (see
    `_acceleration`), which makes the inertia's matrix unsymmetric.
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


def turn_hinges(level: Level, angle: Scalar) -> Mat:
    """Rotation of each body's frame, parent from child."""
    sine, cosine = sincos(angle)
    c, s = level.offset
    cosine, sine = sub(mul(c, cosine), mul(s, sine)), add(mul(s, cosine), mul(c, sine))
    r = level.rotation
    return tuple(
        (
            add(mul(r[i][0], cosine), mul(r[i][1], sine)),
            sub(mul(r[i][1], cosine), mul(r[i][0], sine)),
            r[i][2],
        )
        for i in range(3)
    )


def _velocities(
    tree: Tree, turns: Sequence[Mat], spin: Vec, velocity: Vec, speed: tuple[Scalar, ...]
) -> list[tuple[Vec, Vec]]:
    """Angular and linear velocity of each level's bodies, body frame, at its origin."""
    rates = [(spin, velocity)]
    for level, turn, rate in zip(tree.levels[1:], turns[1:], speed, strict=True):
        above_spin, above_velocity = (_down(level, x) for x in rates[-1])
        spin = matTvec(turn, above_spin)
        spin = (spin[0], spin[1], add(spin[2], rate))
        velocity = matTvec(turn, vadd(above_velocity, cross(above_spin, level.position)))
        rates.append((spin, velocity))
    return rates


def _motions(
    tree: Tree, turns: Sequence[Mat], state: State, rates: Sequence[Any], located: bool
) -> list[Motion]:
    """Where the bodies of each level are and how they move."""
    row = lambda xs: tuple(x[None] for x in xs)  # noqa: E731
    spin, velocity = rates[0]
    root = Motion(
        spin=spin,
        velocity=velocity,
        up=turns[0][2],
        height=state.position[2][None],
        x_axis=turns[0][0] if located else None,
        y_axis=turns[0][1] if located else None,
        place=row(state.position[:2]) if located else None,
    )
    motions = [root]
    for level, turn, (spin, velocity) in zip(tree.levels[1:], turns[1:], rates[1:], strict=True):
        parent = motions[-1]
        up, height = _down(level, parent.up), _down(level, parent.height)
        x_axis, y_axis, place = None, None, None
        if located:
            x_axis, y_axis, place = (
                _down(level, x) for x in (parent.x_axis, parent.y_axis, parent.place)
            )
            place = (
                add(place[0], dot(x_axis, level.position)),
                add(place[1], dot(y_axis, level.position)),
            )
            x_axis, y_axis = matTvec(turn, x_axis), matTvec(turn, y_axis)
        height = add(height, dot(up, level.position))
        motions.append(Motion(spin, velocity, matTvec(turn, up), height, x_axis, y_axis, place))
    return motions


def _acceleration(
    tree: Tree,
    state: State,
    targets: tuple[Scalar, ...],
    water: Water,
    thrusts: Sequence[Scalar],
    dt: float,
) -> tuple[Vec, Vec, tuple[Scalar, ...], Scalar]:
    """Accelerations, by the articulated-body algorithm.

    Where water is carried, the momentum h of each body with its water turns as K(h) ν, and the step
    takes ν in its middle: M ν' + K(h) (ν + dt/2 ν') = f. K is antisymmetric, so that turning does
    no work, at any step and for any share of carried water; with ν at the step's beginning it
    would feed a light body that carries many times its mass until it blows up. h itself is
    extrapolated to the middle from the step before, for second order.

    Args:
        tree: the robot.
        state: the population, its velocities relative to the uniform current.
        targets: of the servos, one `[nbody, lanes]` for each level below the root [rad].
        water: surface and current.
        thrusts: of the thrusters, one `[lanes]` each [N].
        dt: for which turning, damping, drag and end stops are implicit [s]; 0 for none.

    Returns:
        Root: linear and angular, body frame, as rates of the body-frame components [m/s², rad/s²];
        hinges [rad/s²]; servo power, summed over the hinges without sign [W], `[lanes]`.
    """
    world = tree.robot.world
    symmetric = not (tree.carries and dt)
    row = lambda xs: tuple(x[None] for x in xs)  # noqa: E731
    turn_root = tuple(row(r) for r in quat_to_rows(state.quat))
    turns: list[Any] = [turn_root]
    turns += [
        turn_hinges(level, angle) for level, angle in zip(tree.levels[1:], state.angle, strict=True)
    ]
    pulled = is_pulled(water)
    located = pulled or needs_place(world) or any(level.points is not None for level in tree.levels)
    velocity, spin = matTvec(turn_root, row(state.velocity)), row(state.spin)
    rates = _velocities(tree, turns, spin, velocity, state.speed)
    motions = _motions(tree, turns, state, rates, located)
    swirling, speeds = rates, state.speed
    if state.pace and dt:
        half = lambda v, a: add(v, mul(0.5 * dt, a))  # noqa: E731
        linear, angular, hinges = state.pace
        speeds = tuple(half(v, a) for v, a in zip(state.speed, hinges, strict=True))
        swirling = _velocities(
            tree,
            turns,
            tuple(half(v, a) for v, a in zip(spin, row(angular), strict=True)),
            tuple(half(v, a) for v, a in zip(velocity, row(linear), strict=True)),
            speeds,
        )
    # Velocity times joint velocity (Featherstone's c_J): ν × (z q̇).
    coriolis: list[Any] = [None]  # the root has no joint
    for (spin, velocity), speed in zip(swirling[1:], speeds, strict=True):
        coriolis.append(
            (
                (mul(spin[1], speed), neg(mul(spin[0], speed)), 0.0),
                (mul(velocity[1], speed), neg(mul(velocity[0], speed)), 0.0),
            )
        )
    owns = []
    for level, motion, rate in zip(tree.levels, motions, swirling, strict=True):
        gravity = felt_gravity(world, water, motion)
        owns.append(
            own_inertia(world, tree.carries, level, motion, rate, water, thrusts, gravity, dt)
        )

    # Tips to root: articulated inertias.
    blocks = [block for block, _ in owns]
    biases = [bias for _, bias in owns]
    power: Scalar = 0.0
    joint: list[Any] = [None] * len(tree.levels)
    for d in range(len(tree.levels) - 1, 0, -1):
        level, angle, speed = tree.levels[d], state.angle[d - 1], state.speed[d - 1]
        stop, stop_inertia = end_stop(level, angle, speed, dt)
        load = sub(stop, mul(level.damping, speed))
        inertia = add(level.armature, add(mul(dt, level.damping), stop_inertia))
        motor, motor_inertia = servo(
            level,
            angle,
            speed,
            targets[d - 1],
            dt,
            add(blocks[d].angular[2][2], inertia),
            sub(load, biases[d][0][2]),
        )
        delivered = jnp.abs(motor * speed)
        power = add(power, total(*[delivered[k] for k in range(delivered.shape[0])]))
        left, bias, joint[d] = lift_off(
            blocks[d],
            biases[d],
            add(inertia, motor_inertia),
            add(motor, load),
            coriolis[d],
            symmetric,
        )
        above = len(tree.levels[d - 1].body)
        moved, bias = to_parent(turns[d], level.position, left, bias, symmetric)
        blocks[d - 1] = _join(blocks[d - 1], _up_block(level, above, moved, symmetric), symmetric)
        bias = _up(level, above, bias)
        biases[d - 1] = tuple(vadd(a, b) for a, b in zip(biases[d - 1], bias, strict=True))

    # Root to tips: accelerations.
    angular, linear = solve_root(blocks[0], biases[0], symmetric)
    accelerations, hinges = [(angular, linear)], []
    for d in range(1, len(tree.levels)):
        level, turn = tree.levels[d], turns[d]
        row_a, row_l, inverse, rest = joint[d]
        up_angular, up_linear = (_down(level, x) for x in accelerations[-1])
        a = vadd(matTvec(turn, up_angular), coriolis[d][0])
        b = vadd(matTvec(turn, vadd(up_linear, cross(up_angular, level.position))), coriolis[d][1])
        hinge = mul(inverse, sub(sub(rest, dot(row_a, a)), dot(row_l, b)))
        hinges.append(hinge)
        accelerations.append(((a[0], a[1], add(a[2], hinge)), b))
    lane = lambda x: jnp.broadcast_to(x, (1, state.position[0].shape[0]))[0]  # noqa: E731
    return (
        tuple(lane(x) for x in linear),
        tuple(lane(x) for x in angular),
        tuple(hinges),
        power if hasattr(power, "shape") else jnp.zeros_like(state.position[0]),
    )


def _up_block(level: Level, above: int, block: Block, symmetric: bool) -> Block:
    if not symmetric:
        return Block(*_up(level, above, tuple(block)))
    angular, linear = (full(_up(level, above, upper(x))) for x in (block.angular, block.linear))
    across = _up(level, above, block.across)
    return Block(angular, across, transpose(across), linear)


def _join(a: Block, b: Block, symmetric: bool) -> Block:
    """The sum of two, of symmetric ones from their upper halves alone."""
    if not symmetric:
        return add_block(a, 1.0, b)
    angular, linear = (
        full(vadd(upper(x), upper(y))) for x, y in ((a.angular, b.angular), (a.linear, b.linear))
    )
    across = plus(a.across, b.across)
    return Block(angular, across, transpose(across), linear)


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
    speed = tuple(w + dt * a for w, a in zip(state.speed, hinges, strict=True))
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
        angle=tuple(q + dt * w for q, w in zip(state.angle, speed, strict=True)),
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


def make_population_engine(robot: Robot, contact: bool = True) -> Engine:
    """The population step of a robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; leaving it out makes a step much cheaper.

    Returns:
        The engine; its functions are pure, and run under jit, vmap and grad.

    Raises:
        InputError: the model holds something that the population step cannot do.
    """
    tree = make_tree(robot, contact)
    model, world, dt = robot.mj_model, robot.world, robot.world.timestep
    check_timestep(robot)
    sizes = [len(level.body) for level in tree.levels[1:]]
    edges = np.concatenate([[0], np.cumsum(sizes)]).astype(int)
    spans = list(itertools.pairwise(edges))
    propellers = sorted((p for level in tree.levels for p in level.propellers), key=_index)

    def init(qpos: jax.Array, qvel: jax.Array) -> State:
        angle, speed = qpos[tree.qpos_index], qvel[tree.qvel_index]
        # MuJoCo accepts quaternions of any length and normalises them before use.
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        velocity, spin = tuple(qvel[:3]), tuple(qvel[3:6])
        speeds = tuple(speed[a:b] for a, b in spans)
        pace = jax.tree.map(jnp.zeros_like, (velocity, spin, speeds)) if tree.carries else ()
        return State(
            position=tuple(qpos[:3]),
            quat=tuple(qpos[3:7] / length),
            velocity=velocity,
            spin=spin,
            angle=tuple(angle[a:b] for a, b in spans),
            speed=speeds,
            pace=pace,
            command=tuple(jnp.zeros_like(qpos[0]) for _ in propellers),
        )

    def observe(state: State) -> tuple[jax.Array, jax.Array]:
        qpos = jnp.stack([*state.position, *state.quat])
        qvel = jnp.stack([*state.velocity, *state.spin])
        if spans:
            back = np.argsort(tree.qpos_index)
            qpos = jnp.concatenate([qpos, jnp.concatenate(state.angle)[back]])
            qvel = jnp.concatenate([qvel, jnp.concatenate(state.speed)[back]])
        return qpos, qvel

    def step(state: State, ctrl: jax.Array, water: Water) -> tuple[State, jax.Array]:
        targets = tuple(ctrl[a:b] for a, b in spans)
        command, thrusts, pumped = run_thrusters(
            propellers, state.command, tuple(ctrl[edges[-1] :]), world, dt
        )
        # The whole step is seen from the uniform current: there, no current is left.
        relative = state._replace(velocity=vsub(state.velocity, water.current))
        linear, angular, hinges, power = _acceleration(tree, relative, targets, water, thrusts, dt)
        new = advance(state, water, (linear, angular, hinges), dt, tree.carries)
        return new._replace(command=command), add(power, pumped)

    def sense(state: State) -> Sense:
        return Sense(
            state.position[2] - world.surface_height,
            state.velocity[2],
            quat_to_rows(state.quat)[2],
            state.spin,
        )

    def command(state: State) -> jax.Array:
        return jnp.stack(state.command) if propellers else jnp.zeros((0, *state.spin[0].shape))

    assert model.nq == 7 + len(tree.qpos_index)
    return Engine(
        init, step, observe, lambda state: state.position, sense, command, tree.ctrl_index
    )


def _index(propeller: Propeller) -> int:
    return propeller.index


def run_thrusters(
    propellers: Sequence[Propeller],
    lagged: tuple[Scalar, ...],
    ctrl: tuple[Scalar, ...],
    world: World,
    dt: float,
) -> tuple[tuple[Scalar, ...], list[Scalar], Scalar]:
    """The thrusters' part of a step.

    As in MuJoCo's filtered actuators, a command passes its lag at the end of the step, and thrust
    follows the command that had passed at its beginning; without a lag it follows at once.

    Args:
        propellers: the robot's thrusters.
        lagged: their commands behind the lag, `[lanes]` each [-].
        ctrl: what is asked for, likewise.
        world: whose water they push.
        dt: of the step [s].

    Returns:
        The lagged commands after the step, the thrusts, `[lanes]` each [N], and the power that
        an ideal propeller needs for them, summed [W] (`thrusters.ideal_power`).
    """
    after, thrusts, power = [], [], 0.0
    for propeller, before, asked in zip(propellers, lagged, ctrl, strict=True):
        thruster = propeller.thruster
        asked = clamp_command(thruster, asked)
        after.append(lag_command(thruster, before, asked, dt))
        thrusts.append(thrust(thruster, before if thruster.time_constant > 0 else asked))
        power = add(power, ideal_power(thrusts[-1], propeller.disc, world.density))
    return tuple(after), thrusts, power


def acceleration(
    robot: Robot, qpos: jax.Array, qvel: jax.Array, ctrl: jax.Array, water: Water
) -> jax.Array:
    """Acceleration of a population in MuJoCo's coordinates, as `mj_forward` defines it.

    Args:
        robot: from `build_robot`.
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        ctrl: `[nu, lanes]` servo targets [rad] and thrusters' commands [-], in MuJoCo's order; a
            thruster with a lag is still.
        water: surface and current.

    Returns:
        `[nv, lanes]` qacc: root linear, world frame [m/s²], root angular, body frame [rad/s²],
        hinges [rad/s²].
    """
    tree, engine = make_tree(robot), make_population_engine(robot)
    ctrl = ctrl[tree.ctrl_index]
    edges = np.cumsum([len(level.body) for level in tree.levels[1:]])
    targets = tuple(jnp.split(ctrl[: len(tree.qpos_index)], edges[:-1])) if len(edges) else ()
    propellers = sorted((p for level in tree.levels for p in level.propellers), key=_index)
    state = engine.init(qpos, qvel)._replace(pace=())
    asked = tuple(ctrl[len(tree.qpos_index) :])
    # As in mj_forward, a thruster behind a lag has not heard of its command yet.
    _, thrusts, _ = run_thrusters(propellers, state.command, asked, robot.world, 0.0)
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    linear, angular, hinges, _ = _acceleration(tree, relative, targets, water, thrusts, 0.0)
    turn = quat_to_rows(state.quat)
    seen = matTvec(turn, relative.velocity)
    linear = matvec(turn, vadd(linear, cross(state.spin, seen)))
    root = jnp.stack([*vadd(linear, water.acceleration), *angular])
    if not hinges:
        return root
    return jnp.concatenate([root, jnp.concatenate(hinges)[np.argsort(tree.qvel_index)]])
