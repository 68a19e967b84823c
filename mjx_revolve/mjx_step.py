"""MJX's step behind the same call as the population step: the reference, and the fallback.

MJX computes kinematics, the joint-space inertia and bias forces of each individual; the water's
forces, the carried water's inertia and the servos come from the same functions as in the population
step and enter through the bodies' Jacobians. So the two engines share the laws, not the mechanics.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_revolve.dynamics import (
    Engine,
    Motion,
    SpatialInertia,
    end_stop,
    is_drifting,
    outer_forces,
    servo,
    turn_quat,
    water_drift,
)
from mjx_revolve.hydrodynamics import Water
from mjx_revolve.robot import Robot, import_mjx
from mjx_revolve.spatial import full
from mjx_revolve.tree import make_tree

mjx = import_mjx()
# Not exported, but the only way to the stages of a step and to a body's Jacobian.
from mujoco.mjx._src import forward, support  # noqa: E402


def make_mjx_engine(robot: Robot, contact: bool = True) -> Engine:
    """MJX's step of a robot, for a population on the last axis.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed.

    Returns:
        The engine; see `dynamics.Engine`.

    Raises:
        InputError: the model holds a joint that the water's tables cannot follow.
    """
    tree = make_tree(robot, contact)
    m, world = robot.mj_model, robot.world
    dt = world.timestep
    model = robot.mjx_model
    # End stops and the bed are our own penalty laws, the same as in the population step.
    off = mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    model = model.replace(opt=model.opt.replace(disableflags=int(model.opt.disableflags) | off))

    def forward_parts(qpos: Any, qvel: Any) -> Any:
        data = mjx.make_data(model).replace(qpos=qpos, qvel=qvel)
        data = forward.fwd_position(model, data)
        return forward.fwd_velocity(model, data)

    def jacobians(data: Any, level: Any) -> tuple[Any, Any]:
        """`[nbody, 6, nv]` of the level's bodies, in their own frames, and `[nbody, 3, 3]` axes."""
        rows, axes = [], []
        for body, frame in zip(level.body, level.frame, strict=True):
            linear, angular = support.jac(model, data, data.xpos[body], jnp.int32(body))
            turn = data.xmat[body] @ jnp.asarray(frame, qdtype(data))
            rows.append(jnp.concatenate([turn.T @ angular.T, turn.T @ linear.T]))
            axes.append(turn)
        return jnp.stack(rows), jnp.stack(axes)

    def qdtype(data: Any) -> Any:
        return data.qpos.dtype

    def moved(qpos: Any, qvel: Any, time: Any) -> Any:
        quat = turn_quat(tuple(qpos[3:7]), tuple(time * qvel[3:6]), 1.0)
        return jnp.concatenate(
            [qpos[:3] + time * qvel[:3], jnp.stack(quat), qpos[7:] + time * qvel[6:]]
        )

    def velocities(qpos: Any, qvel: Any) -> list[Any]:
        data = mjx.kinematics(model, mjx.make_data(model).replace(qpos=qpos))
        data = mjx.com_pos(model, data)
        return [jnp.einsum("bij,j->bi", jacobians(data, x)[0], qvel) for x in tree.levels]

    def one(qpos: Any, qvel: Any, ctrl: Any, water: Water) -> tuple[Any, Any, Any]:
        data = forward_parts(qpos, qvel)
        mass = support.full_m(model, data)
        force = data.qfrc_passive - data.qfrc_bias
        zero = jnp.zeros((), qpos.dtype)
        # Spatial acceleration of each body when no joint accelerates: d/dt of J at constant q̇.
        _, still = jax.jvp(lambda t: velocities(moved(qpos, qvel, t), qvel), (zero,), (zero + 1,))
        for level, drift_rate in zip(tree.levels, still, strict=True):
            jacobian, axes = jacobians(data, level)
            rate = jnp.einsum("bij,j->bi", jacobian, qvel)
            column = lambda x: tuple(x[:, i, None] for i in range(3))  # noqa: E731
            place = data.xpos[jnp.asarray(level.body)]
            motion = Motion(
                spin=column(rate[:, :3]),
                velocity=column(rate[:, 3:]),
                up=column(axes[:, 2]),
                height=place[:, 2, None],
                x_axis=column(axes[:, 0]),
                y_axis=column(axes[:, 1]),
                place=(place[:, 0, None], place[:, 1, None]),
            )
            drift = water_drift(motion, water) if is_drifting(water) else None
            torque, push, added = outer_forces(world, level, motion, drift, water)
            n = len(level.body)
            wrench = jnp.concatenate([_stack(torque, n), _stack(push, n)], -1)
            if added is not None:
                spatial = _dense(added, n)
                wrench = wrench - jnp.einsum("bij,bj->bi", spatial, drift_rate)
                mass = mass + jnp.einsum("bik,bij,bjl->kl", jacobian, spatial, jacobian)
            force = force + jnp.einsum("bij,bi->j", jacobian, wrench)
        diagonal = jnp.asarray(m.dof_damping * dt, qpos.dtype)
        power, start = zero, 0
        for level in tree.levels[1:]:
            stop = start + len(level.body)
            q, v = tree.qpos_index[start:stop], tree.qvel_index[start:stop]
            angle, speed = qpos[q][:, None], qvel[v][:, None]
            motor, motor_inertia = servo(
                level, angle, speed, ctrl[tree.ctrl_index[start:stop]][:, None], dt
            )
            torque, inertia = end_stop(level, angle, speed, dt)
            force = force.at[v].add((torque + motor)[:, 0])
            diagonal = diagonal.at[v].add((inertia + motor_inertia)[:, 0])
            power = power + jnp.sum(jnp.abs(motor * speed))
            start = stop
        acceleration = jax.scipy.linalg.solve(mass + jnp.diag(diagonal), force, assume_a="pos")
        new = qvel + dt * acceleration
        return moved(qpos, new, jnp.asarray(dt, qpos.dtype)), new, power

    def step(state: Any, ctrl: jax.Array, water: Water) -> tuple[Any, jax.Array]:
        qpos, qvel = state
        lanes = qpos.shape[-1]
        # Plain numbers stay constants, so that still water costs nothing; arrays are mapped.
        plain = lambda x: isinstance(x, int | float)  # noqa: E731
        fixed = jax.tree.map(lambda x: x if plain(x) else None, water)
        given = jax.tree.map(lambda x: None if plain(x) else x, water)

        def single(qpos: Any, qvel: Any, ctrl: Any, given: Any) -> Any:
            merged = jax.tree.map(
                lambda a, b: b if a is None else a, fixed, given, is_leaf=lambda x: x is None
            )
            return one(qpos, qvel, ctrl, merged)

        given = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes,)), given)
        new_qpos, new_qvel, power = jax.vmap(single, in_axes=-1, out_axes=-1)(
            qpos, qvel, ctrl, given
        )
        return (new_qpos, new_qvel), power

    def init(qpos: jax.Array, qvel: jax.Array) -> Any:
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        return qpos.at[3:7].divide(length), qvel

    return Engine(init, step, lambda s: s, lambda s: tuple(s[0][:3]), np.arange(m.nu))


def _stack(components: Any, n: int) -> jax.Array:
    """Components of `[nbody, 1]` each to `[nbody, number]`."""
    dtype = jnp.result_type(float)
    wide = [jnp.broadcast_to(jnp.asarray(x, dtype), (n, 1))[:, 0] for x in components]
    return jnp.stack(wide, -1)


def _dense(inertia: SpatialInertia, n: int) -> jax.Array:
    """A spatial inertia as `[nbody, 6, 6]`."""
    angular, cross, linear = (
        jnp.stack([_stack(row, n) for row in block], -2)
        for block in (full(inertia.angular), inertia.cross, full(inertia.linear))
    )
    top = jnp.concatenate([angular, cross], -1)
    bottom = jnp.concatenate([jnp.swapaxes(cross, 1, 2), linear], -1)
    return jnp.concatenate([top, bottom], -2)
