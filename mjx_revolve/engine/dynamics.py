"""Articulated bodies in water, the population on the last axis: accelerations.

Featherstone's articulated-body algorithm (2008, Rigid Body Dynamics Algorithms, § 7.3) in
components (`spatial`), with the water's forces (`hydrodynamics`) and the added mass inside each
body's 6×6 inertia. Written once, for every `Tree`.

Spatial quantities are (angular, linear), in each body's own frame, about its own origin.
"""

from __future__ import annotations

from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.contact import bed_forces
from mjx_revolve.engine.hydrodynamics import (
    ExternalForces,
    PreviousStep,
    implicit_share,
    water_forces,
)
from mjx_revolve.engine.kinematics import body_frames, forward_kinematics
from mjx_revolve.engine.level import Hinges, Level
from mjx_revolve.engine.self_contact import (
    Respond,
    Robots,
    contact_acceleration,
)
from mjx_revolve.engine.servos import end_stop, own_torque, servo, spring_damping
from mjx_revolve.engine.state import State, effective_gravity, has_acceleration
from mjx_revolve.engine.tree import Tree
from mjx_revolve.numerics.articulated import (
    JointElimination,
    eliminate_joint,
    release_joint,
    solve_root,
    to_child,
    to_parent,
    upper,
)
from mjx_revolve.numerics.inertia import (
    Block,
    BodyMotion,
    SpatialInertia,
    add_block,
    add_inertia,
    apply_block,
    apply_inertia,
    block_of,
    cross_force,
    gyroscope,
    scale_inertia,
)
from mjx_revolve.numerics.spatial import (
    NO_MATRIX,
    ZERO,
    Scalar,
    Vec,
    add,
    cross,
    full,
    matvec,
    mul,
    neg,
    skew,
    sub,
    total,
    transpose,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.numerics.xla import materialize, take_lanes
from mjx_revolve.water.flow import Water, needs_horizontal_position
from mjx_revolve.water.world import World

_NO_BLOCK = Block(NO_MATRIX, NO_MATRIX, NO_MATRIX, NO_MATRIX)
# The hinge's axis in its body's frame, (angular, linear).
_AXIS = ((0.0, 0.0, 1.0), ZERO)


def accelerate(
    tree: Tree,
    state: State,
    targets: Any,
    water: Water,
    thrusts: Any,
    dt: float,
    wrench: Any = (),
) -> tuple[tuple[Vec, Vec, Any], Scalar, Any, Any, Any]:
    """Accelerations, by the articulated-body algorithm.

    With added mass, the momentum h of each body with its water turns as K(h) ν, and the step takes
    ν in its middle: M ν' + K(h) (ν + dt/2 ν') = f. K is antisymmetric, so that turning does no
    work, at any step and for any added mass; with ν at the step's beginning it would feed a light
    body with many times its mass of water until it blows up. h itself is extrapolated to the
    middle from the step before, for second order.

    The Coriolis acceleration ν × z q̇ of a body by its hinge takes q̇ in the middle, too, with the q̈
    that is sought: the hinge moves its body by (z + dt/2 ν × z) q̈ + ν × z q̇. For a mass that goes
    straight while its hinge turns it, that cancels the turning of its momentum; with the q̈ of the
    step before it would not where servos begin to push or a stop holds them.

    Args:
        tree: the robots.
        state: the population, its velocities relative to the uniform current.
        targets: of the servos, as `Tree.split_rows` returns [rad].
        water: surface and current.
        thrusts: of the thrusters, `[nthruster, lanes]` [N].
        dt: for which turning, damping, drag and end stops are implicit [s]; 0 for none.
        wrench: further forces on the bodies, as `InteractionForces.wrench`; () for none.

    Returns:
        (linear and angular acceleration of the root, body frame, as rates of the body-frame
        components [m/s², rad/s²]; of the hinges [rad/s²]); servo power, summed over the hinges
        without sign, `[lanes]` [W]; submerged fractions, clearance and pressed, as in `State`.
    """
    world, symmetric = tree.world, not (tree.carries and dt)
    meets = tree.meets and dt > 0
    located = has_acceleration(water) or needs_horizontal_position(world) or tree.touches
    root, moved = forward_kinematics(tree, state, located, dt)

    def turning(motion: BodyMotion) -> tuple[Vec, Vec]:
        """The velocity with which momenta turn: as MuJoCo's step has it, the step's first one."""
        return motion.twist if symmetric else motion.midpoint_velocity

    def axis_of(motion: BodyMotion) -> tuple[Vec, Vec]:
        """The hinge's axis, half a step ahead where momenta are."""
        return _AXIS if symmetric else _axis_ahead(turning(motion), dt)

    def articulate(level: Level, children: Any, moved: Any, *xs: Any) -> tuple[Any, Any, Scalar]:
        """Articulated inertia and bias of bodies, seen from their parents; the root's own."""
        (motion, rotation), rest = moved, list(xs)
        push = rest.pop() if wrench else ()
        submerged = rest.pop() if state.submerged else ()
        gravity = effective_gravity(world, water, motion)
        before = PreviousStep(submerged, dt) if submerged and dt else None
        external = midpoint_forces(world, level, motion, gravity, water, thrusts, before, dt)
        external = with_bed(world, level, motion, external, water)
        submerged = external.submerged
        block, bias = _inertia_and_bias(
            level, motion, turning(motion), external, gravity, dt, push, symmetric
        )
        found = _flatten(block, bias, symmetric)
        if children is not None:
            found = jax.tree.map(add, found, children)
        if level.hinges is None:
            return found, submerged, 0.0
        block, bias = _unflatten(found, symmetric)
        angle, speed, target = rest
        axis = axis_of(motion)
        column = apply_block(block, *axis)
        motor, load, inertia = _at_hinges(
            world, level.hinges, angle, speed, target, dt, column[0][2], neg(bias[0][2])
        )
        torque, coriolis = add(motor, load), _coriolis(turning(motion), speed)
        block, bias, joint = eliminate_joint(
            block, bias, column, inertia, torque, coriolis, symmetric
        )
        block, bias = to_parent(rotation, level.hinges.position, block, bias, symmetric)
        # Of a symmetric block it is the row of `joint`.
        saved = joint, tree.unstack_parts(submerged), column if meets and not symmetric else ()
        spent = jnp.abs(own_torque(level.hinges, motor) * speed)
        return _flatten(block, bias, symmetric), saved, spent

    children, saved, power = tree.backward_pass(
        articulate,
        (_flatten(_NO_BLOCK, (ZERO, ZERO), symmetric), 0.0),
        moved, state.angle, state.speed, targets, *state.submerged[1:], *wrench[1:],
    )  # fmt: skip
    whole, submerged, _ = articulate(
        tree.root, children, (root, None), *state.submerged[:1], *wrench[:1]
    )
    angular, linear = solve_root(*_unflatten(whole, symmetric), symmetric)

    def accelerate_joint(level: Level, parent: Any, *x: Any) -> tuple[Any, Scalar]:
        """Accelerations of bodies from those of their parents, and of their hinges."""
        (motion, rotation), speed, (joint, *_) = x
        assert level.hinges is not None
        carried = to_child(rotation, level.hinges.position, parent)
        coriolis = _coriolis(turning(motion), speed)
        held = vadd(carried[0], coriolis[0]), vadd(carried[1], coriolis[1])
        return release_joint(joint, axis_of(motion), held)

    hinges = tree.forward_pass(accelerate_joint, (angular, linear), moved, state.speed, saved)
    lanes, dtype = state.position[0].shape, state.position[0].dtype
    lane = lambda x: jnp.broadcast_to(jnp.asarray(x, dtype), (1, *lanes))[0]  # noqa: E731
    qacc = tuple(map(lane, linear)), tuple(map(lane, angular)), hinges
    clearance: Any = ()
    pressed: Any = state.pressed
    if meets:
        factors = _Factors(moved, saved, _unflatten(whole, symmetric)[0], symmetric)
        qacc, clearance, pressed = _with_contact(tree, state, qacc, factors, dt)
    return (
        qacc,
        jnp.broadcast_to(jnp.asarray(power, dtype), lanes),
        (submerged, tree.stack_parts(saved, lambda x: x[1])) if state.submerged else (),
        clearance,
        pressed,
    )


class _Factors(NamedTuple):
    """What the articulated-body algorithm leaves, by which further torques act at once.

    Attributes:
        moved: motion and rotation of the bodies below the root, parent from child.
        saved: by the backward pass.
        root: articulated inertia of the root.
        symmetric: whether inertias are.
    """

    moved: Any
    saved: Any
    root: Block
    symmetric: bool


def _look_at(
    dt: float,
    values: tuple[Tree, _Factors, tuple[Any, Any, jax.Array]],
    which: jax.Array | None,
) -> Robots:
    """The robots in the lanes `which`, None for all, as contacts look at them.

    `values`: tree and factors; all hinges' speeds, accelerations and levers, see `_with_contact`.
    """
    tree, factors, moving = values
    few, places = tree.at_lanes(which), tree.hinge_positions(which)
    turns = tree.saved_at_lanes(factors.moved, lambda moved: moved[1], which)
    speed, hurry, lever = jax.tree.map(lambda x: take_lanes(x, which), moving)
    like = jnp.zeros(lever.shape[-1], lever.dtype)
    hurry = few.join_rows(hurry, like)
    drift = dt**2 * total(*[lever[k] * jnp.abs(hurry[k]) for k in range(len(lever))])

    def gather(_: Level, children: Any, *own: Any) -> Any:
        found = own if children is None else vadd(own, children)
        return found, found, ()

    def carried(values: list[jax.Array]) -> list[jax.Array]:
        zero, below = (0.0,) * len(values), [few.split_rows(x[1:]) for x in values]
        _, sums, _ = few.backward_pass(gather, (zero, ()), *below)
        return list(few.stack_saved(sums, lambda x: x, like))

    return Robots(
        steps=dt * (few.join_rows(speed, like) + dt * hurry),
        hurry=hurry,
        drift=drift,
        pose=lambda steps: body_frames(few, turns, places, few.split_rows(steps), like),
        carried=carried,
        make_respond=lambda: _make_respond(tree, factors, dt, which, turns, places),
    )


def _make_respond(
    tree: Tree, factors: _Factors, dt: float, which: jax.Array | None, turns: Any, places: Any
) -> Respond:
    """For some of the robots, what further torques of their hinges add to all accelerations."""
    symmetric = factors.symmetric
    own = lambda x: take_lanes(x, which) if jnp.shape(x)[-1:] not in ((), (1,)) else x  # noqa: E731
    block: Block = jax.tree.map(own, factors.root)
    saved = tree.saved_at_lanes(factors.saved, lambda saved: (saved[0][:3], saved[2]), which)
    few = tree.at_lanes(which)
    # With which momenta turn.
    midpoint = lambda moved: moved[0].midpoint_velocity  # noqa: E731
    velocities = () if symmetric else (tree.saved_at_lanes(factors.moved, midpoint, which),)

    def collect(_: Level, children: Any, turn: Any, place: Any, saved: Any, torque: Any) -> Any:
        """Bias forces, as the parents feel them."""
        bias = (0.0,) * 6 if children is None else children
        (row_a, row_l, inverse), column = saved
        rest = sub(torque, bias[2])
        pushed = mul(inverse, rest)
        column = column or (row_a, row_l)
        torque = vadd(bias[:3], vscale(pushed, column[0]))
        force = matvec(turn, vadd(bias[3:], vscale(pushed, column[1])))
        torque = vadd(matvec(turn, torque), cross(place, force))
        return (*torque, *force), rest, ()

    def accelerate_joint(
        _: Level, parent: Any, turn: Any, place: Any, saved: Any, rest: Any, *velocity: Any
    ) -> Any:
        axis = _axis_ahead(velocity[0], dt) if velocity else _AXIS
        (row_a, row_l, inverse), _column = saved
        joint = JointElimination(row_a, row_l, inverse, rest)
        return release_joint(joint, axis, to_child(turn, place, parent))

    def respond(torque: jax.Array) -> jax.Array:
        bias, rests, _ = few.backward_pass(
            collect, ((0.0,) * 6, ()), turns, places, saved, few.split_rows(torque)
        )
        angular, linear = root = solve_root(block, (bias[:3], bias[3:]), symmetric)
        hinges = few.forward_pass(accelerate_joint, root, turns, places, saved, rests, *velocities)
        like = torque[0]
        wide = [jnp.broadcast_to(x, (1, *like.shape)) for x in (*linear, *angular)]
        return jnp.concatenate([*wide, few.join_rows(hinges, like)])

    return respond


def _with_contact(
    tree: Tree, state: State, qacc: tuple[Vec, Vec, Any], factors: _Factors, dt: float
) -> tuple[tuple[Vec, Vec, Any], jax.Array, Any]:
    """Accelerations with those of contacts within the robot, clearance and pressed; see `State`.

    A robot is not looked at while its hinges cannot have turned far enough to close its clearance.
    """
    like = state.position[0]

    def reach(level: Level, speed: Scalar) -> Scalar:
        """How far boxes may near each other for each radian of each hinge [m]."""
        assert level.hinges is not None
        return jnp.broadcast_to(level.hinges.lever, speed.shape)

    levers = tree.join_rows(tree.map(reach, state.speed), like)
    speed, hurry = (materialize(tree.join_rows(x, like)) for x in (state.speed, qacc[2]))
    ways = [levers[k] * jnp.abs(dt * (speed[k] + dt * hurry[k])) for k in range(len(levers))]
    found, clearance, pressed = contact_acceleration(
        tree.meetings(like),
        state.clearance - total(*ways),
        state.clearance < 0,
        (tree, factors, (state.speed, qacc[2], levers)),
        partial(_look_at, dt),
        6 + len(ways),
        dt,
        len(state.pressed),
    )
    robot = tuple(found[:3]), tuple(found[3:6]), tree.split_rows(found[6:])
    sums: tuple[Vec, Vec, Any] = jax.tree.map(jnp.add, qacc, robot)
    return sums, clearance, pressed if len(state.pressed) else ()


def midpoint_forces(
    world: World,
    level: Level,
    motion: BodyMotion,
    gravity: Vec,
    water: Water,
    thrusts: Any,
    before: PreviousStep | None,
    dt: float,
) -> ExternalForces:
    """`water_forces` in the middle of the step, and what damps them as far as a step needs it.

    They are those of the velocity ν + (1 - s) dt/2 ν'₋, with the acceleration ν'₋ of the step
    before, and fall by s dt D ν' with the acceleration ν' that is sought; D is the damping that the
    laws give (see `laws.Drag`), none of explicit ones. Without the share s that is second
    order, but unstable for a body that the water slows down within a step; s = 1 is linearly
    implicit, stable, and of first order in what D leaves out: joints' accelerations jump with their
    commands. See `implicit_share`. The slam takes what the step begins with: momentum is then kept.

    Args:
        world, level, gravity, water, thrusts, before: as in `water_forces`.
        motion: of the bodies, half a step ahead, too; without, all is as at its beginning.
        dt: of the step [s]; 0 for none.

    Returns:
        Forces, torques and inertias; `damping` times dt adds to the inertia.
    """
    if not motion.midpoint or not dt:
        return water_forces(world, level, motion, gravity, water, thrusts, before)
    share = implicit_share(world, level, motion, water, dt)
    angular, linear = (
        vadd(v, vscale(sub(1, share), vsub(middle, v)))
        for v, middle in zip(motion.twist, motion.midpoint, strict=True)
    )
    ahead = motion._replace(angular_velocity=angular, velocity=linear, begun=motion.twist)
    external = water_forces(world, level, ahead, gravity, water, thrusts, before)
    if external.damping is None:
        return external
    return external._replace(damping=scale_inertia(share, external.damping))


def with_bed(
    world: World, level: Level, motion: BodyMotion, external: ExternalForces, water: Water
) -> ExternalForces:
    """External forces with those of the bed."""
    if level.points is None:
        return external
    torque, force, damping = bed_forces(world, level, motion, level.points, water)
    if external.damping is not None:
        damping = add_inertia(damping, external.damping)
    return external._replace(
        torque=vadd(external.torque, torque), force=vadd(external.force, force), damping=damping
    )


def inertia_and_momentum(
    level: Level, external: ExternalForces, velocity: tuple[Vec, Vec]
) -> tuple[SpatialInertia, SpatialInertia, tuple[Vec, Vec]]:
    """Inertia of each body alone and with its added mass, and the momentum of both.

    Args:
        level: the bodies.
        external: the forces on them.
        velocity: angular and linear, relative to the uniform current.

    Returns:
        The two inertias, and (angular, linear) momentum relative to the uniform current.
    """
    rigid = SpatialInertia(
        level.inertia, skew(level.moment), (level.mass, 0.0, 0.0, level.mass, 0.0, level.mass)
    )
    whole = rigid if external.carried is None else add_inertia(rigid, external.carried)
    angular, linear = apply_inertia(whole, *velocity)
    if external.momentum is not None:
        angular, linear = vadd(angular, external.momentum[0]), vadd(linear, external.momentum[1])
    return rigid, whole, (angular, linear)


def _inertia_and_bias(
    level: Level,
    motion: BodyMotion,
    turning: tuple[Vec, Vec],
    external: ExternalForces,
    gravity: Vec,
    dt: float,
    wrench: Any,
    symmetric: bool,
) -> tuple[Block, tuple[Vec, Vec]]:
    """Each body's inertia with its added mass, and the bias force that needs no acceleration.

    With added mass, turning in the middle of the step makes the matrix unsymmetric.
    """
    weight = tuple(neg(g) for g in gravity)
    force = vadd(external.force, vscale(level.mass, weight))
    torque = vadd(external.torque, cross(level.moment, weight))
    if wrench:
        torque, force = vadd(torque, wrench[0]), vadd(force, wrench[1])
    _, inertia, momentum = inertia_and_momentum(level, external, turning)
    if external.damping is not None and dt:
        inertia = add_inertia(inertia, scale_inertia(dt, external.damping))
    block = block_of(inertia)
    if not symmetric:
        block = add_block(block, 0.5 * dt, gyroscope(*momentum))
    bias = cross_force(*motion.twist, *momentum)
    return block, (vsub(bias[0], torque), vsub(bias[1], force))


def _at_hinges(
    world: World,
    hinges: Hinges,
    angle: Scalar,
    speed: Scalar,
    target: Scalar,
    dt: float,
    moved: Scalar,
    push: Scalar,
) -> tuple[Scalar, Scalar, Scalar]:
    """Torque of the motors, of friction with end stops, and what is implicit, with the armature.

    `moved` and `push` are inertia and torque of the bodies that a hinge moves.
    """
    friction = mul(hinges.damping, speed)
    inertia = add(hinges.armature, mul(dt, hinges.damping))
    load = sub(push, friction)
    whole, damped = add(moved, inertia), spring_damping(world)
    motor, more = servo(hinges, angle, speed, target, dt, whole, load, damped)
    inertia = add(inertia, more)
    gain = mul(dt, add(motor, load) / add(moved, inertia))
    stop, more = end_stop(hinges, angle, speed, dt, gain)
    return motor, sub(stop, friction), add(inertia, more)


def _coriolis(velocity: tuple[Vec, Vec], speed: Scalar) -> tuple[Vec, Vec]:
    """Velocity times joint velocity (Featherstone's c_J): ν × (z q̇)."""
    angular, linear = ((mul(v[1], speed), neg(mul(v[0], speed)), 0.0) for v in velocity)
    return angular, linear


def _axis_ahead(velocity: tuple[Vec, Vec], dt: float) -> tuple[Vec, Vec]:
    """A hinge's axis half a step ahead, where momenta are that turn with such velocities."""
    angular, linear = _coriolis(velocity, 0.5 * dt)
    return vadd(_AXIS[0], angular), vadd(_AXIS[1], linear)


def _flatten(block: Block, bias: tuple[Vec, Vec], symmetric: bool) -> tuple[Any, ...]:
    """A block and its bias as their independent numbers."""
    if symmetric:
        return upper(block.angular), block.across, upper(block.linear), bias
    return tuple(block), bias


def _unflatten(value: tuple[Any, ...], symmetric: bool) -> tuple[Block, tuple[Vec, Vec]]:
    if symmetric:
        angular, across, linear, bias = value
        return Block(full(angular), across, transpose(across), full(linear)), bias
    block, bias = value
    return Block(*block), bias
