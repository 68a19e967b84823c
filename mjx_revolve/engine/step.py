"""One step of a whole population, for one robot and for many different ones.

Integration is MuJoCo's semi-implicit Euler with implicit joint damping, so that trajectories can be
compared step by step. `bodies` says how trees are traversed, `dynamics` what accelerates them.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.engine.collisions import Meet
from mjx_revolve.engine.dynamics import Bodies, accelerate
from mjx_revolve.engine.level import Level
from mjx_revolve.engine.levels import Levels, make_levels
from mjx_revolve.engine.motions import motions_of
from mjx_revolve.engine.plant import Plant, actuators_of, plant_of
from mjx_revolve.engine.pushes import cells_of, push_of, touch_of
from mjx_revolve.engine.robot import Robot, check_timestep
from mjx_revolve.engine.servos import motor_torque
from mjx_revolve.engine.state import Engine, State, advance, root_of
from mjx_revolve.engine.thrusters import run_thrusters
from mjx_revolve.engine.variation import Variation
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    add,
    cross,
    matTvec,
    matvec,
    quat_to_rows,
    total,
    vadd,
    vsub,
)
from mjx_revolve.water.flow import Water


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
        # Nothing has come aboard before the first step, which finds the parts as wet as they are.
        wet=bodies.all_wet(qpos.shape[1:], qpos.dtype) if bodies.carries else (),
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


def joints(bodies: Bodies, state: State) -> tuple[jax.Array, jax.Array]:
    """Angles [rad] and speeds [rad/s] of the hinges, `[hinge rows, lanes]`, the plant's order."""
    like = state.position[0]
    return bodies.merge(state.angle, like), bodies.merge(state.speed, like)


def load(bodies: Bodies, state: State, ctrl: jax.Array) -> jax.Array:
    """Torque of the servos under a command, `[hinge rows, lanes]`, the plant's order [N·m]."""

    def push(level: Level, angle: Scalar, speed: Scalar, target: Scalar) -> Scalar:
        assert level.hinges is not None
        return motor_torque(level.hinges, angle, speed, target)

    asked = bodies.split(ctrl[: ctrl.shape[0] - bodies.thrusters.count])
    found = bodies.map(push, state.angle, state.speed, asked)
    return bodies.merge(found, state.position[0])


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


def step(
    bodies: Bodies, state: State, ctrl: jax.Array, water: Water, pushes: Any = ()
) -> tuple[State, jax.Array]:
    """One step.

    Args:
        bodies: the robots.
        state: the population.
        ctrl: `[n, lanes]` targets [rad] and commands [-] in the plant's order.
        water: surface and current.
        pushes: of other robots, as `collisions.Meeting.push`; () for none.

    Returns:
        The state after it, and the power of servos and ideal propellers, `[lanes]` [W].
    """
    dt = bodies.world.timestep
    targets, command, thrusts, pumped = _drive(bodies, state, ctrl)
    # The whole step is seen from the uniform current: there, no current is left.
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    *pace, power, wet = accelerate(bodies, relative, targets, water, thrusts, dt, pushes)
    new = advance(state, water, tuple(pace), dt, bodies.carries, wet)
    return new._replace(command=command), add(power, pumped)


def make_step_engine(
    bodies: Bodies,
    plant: Plant,
    variation: Variation | None = None,
    meet: Meet | None = None,
) -> Engine:
    """The population step as an engine; its functions are pure, and run under jit, vmap and grad.

    Args:
        bodies: the robots.
        plant: their actuators.
        variation: factors on their coefficients; None for none.
        meet: what robots of one world do to each other, from `make_meeting`; None for nothing.

    Returns:
        The engine.
    """

    def own() -> Bodies:
        # Varied where they are used: a loop then holds a few factors, not all constants by lanes.
        return bodies if variation is None else bodies.varied(variation)

    def command(state: State) -> jax.Array:
        lanes = state.position[0]
        return state.command if bodies.thrusters.count else jnp.zeros((0, *lanes.shape))

    def push(state: State, ctrl: jax.Array, water: Water) -> tuple[Vec, Vec]:
        return push_of(own(), state, water, _drive(bodies, state, ctrl)[2])

    def touch(state: State, water: Water) -> jax.Array:
        return touch_of(bodies, state, water)

    def cells(state: State, water: Water) -> tuple[tuple[jax.Array, jax.Array], ...]:
        assert isinstance(bodies, Levels)
        return cells_of(bodies, state, water)

    return Engine(
        init=partial(init, bodies),
        step=lambda state, ctrl, water, pushes=(): step(own(), state, ctrl, water, pushes),
        observe=partial(observe, bodies),
        root=root_of,
        joints=partial(joints, bodies),
        load=lambda state, ctrl: load(own(), state, ctrl),
        touch=touch,
        motions=partial(motions_of, bodies),
        cells=cells if isinstance(bodies, Levels) else None,
        command=command,
        push=push,
        plant=plant,
        fuses=True,
        varied=lambda variation: make_step_engine(bodies, plant, variation, meet),
        meet=meet,
    )


def make_population_engine(robot: Robot, contact: bool = True) -> Engine:
    """The population step of one robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed; leaving it out makes a step much cheaper.

    Returns:
        The engine.

    Raises:
        InputError: the world is not one that it can step.
    """
    levels = make_levels(robot, contact)
    check_timestep(robot)
    return make_step_engine(levels, level_plant(levels))


def level_plant(levels: Levels) -> Plant:
    """The plant of one robot in the order of its levels."""
    robot, order = levels.robot, levels.hinge_order.tolist()
    return plant_of(robot, [*order, *range(len(order), len(order) + robot.num_thrusters)])


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
    state = init(bodies, qpos, qvel)._replace(pace=(), wet=())
    # As in mj_forward, a thruster behind a lag has not heard of its command yet.
    targets, _, thrusts, _ = _drive(bodies, state, ctrl)
    relative = state._replace(velocity=vsub(state.velocity, water.current))
    linear, angular, hinges, *_ = accelerate(bodies, relative, targets, water, thrusts, 0.0)
    turn = quat_to_rows(state.quat)
    seen = matTvec(turn, relative.velocity)
    linear = matvec(turn, vadd(linear, cross(state.spin, seen)))
    root = jnp.stack([*vadd(linear, water.acceleration), *angular])
    return jnp.concatenate([root, bodies.gather(hinges, state.position[0])])
