"""MJX's step behind the same call as the population step: the reference, and the fallback.

MJX computes kinematics, the joint-space inertia, bias forces and actuation of each individual; the
water's forces and the carried water's inertia come from the same functions as in the population step
and enter through the bodies' Jacobians. So the two engines share the water and nothing else.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx
from mujoco.mjx._src import forward, support

from mjx_revolve.dynamics import (
    Engine,
    Motion,
    end_stop,
    is_drifting,
    outer_forces,
    turn_quat,
    water_drift,
)
from mjx_revolve.hydrodynamics import Water
from mjx_revolve.robot import Robot
from mjx_revolve.spatial import full
from mjx_revolve.tree import make_tree


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

    def forward_parts(qpos: Any, qvel: Any, ctrl: Any) -> Any:
        data = mjx.make_data(model).replace(qpos=qpos, qvel=qvel, ctrl=ctrl)
        data = forward.fwd_position(model, data)
        data = forward.fwd_velocity(model, data)
        return forward.fwd_actuation(model, data)

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
        data = forward_parts(qpos, qvel, ctrl)
        mass = support.full_m(model, data)
        force = data.qfrc_passive - data.qfrc_bias + data.qfrc_actuator
        zero = jnp.zeros((), qpos.dtype)
        # Spatial acceleration of each body when no joint accelerates: d/dt of J at constant q̇.
        _, still = jax.jvp(
            lambda t: velocities(moved(qpos, qvel, t), qvel), (zero,), (zero + 1,)
        )
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
            stack = lambda xs: jnp.stack(  # noqa: E731
                [jnp.broadcast_to(jnp.asarray(x, qpos.dtype), (n, 1))[:, 0] for x in xs], -1
            )
            wrench = jnp.concatenate([stack(torque), stack(push)], -1)
            if added is not None:
                block = lambda mat: jnp.stack([stack(row) for row in mat], -2)  # noqa: E731
                cross = block(added.cross)
                spatial = jnp.concatenate(
                    [
                        jnp.concatenate([block(full(added.angular)), cross], -1),
                        jnp.concatenate([jnp.swapaxes(cross, 1, 2), block(full(added.linear))], -1),
                    ],
                    -2,
                )
                wrench = wrench - jnp.einsum("bij,bj->bi", spatial, drift_rate)
                mass = mass + jnp.einsum("bik,bij,bjl->kl", jacobian, spatial, jacobian)
            force = force + jnp.einsum("bij,bi->j", jacobian, wrench)
        diagonal = jnp.asarray(m.dof_damping * dt, qpos.dtype)
        start = 0
        for level in tree.levels[1:]:
            stop = start + len(level.body)
            q, v = tree.qpos_index[start:stop], tree.qvel_index[start:stop]
            torque, inertia = end_stop(level, qpos[q][:, None], qvel[v][:, None], dt)
            force = force.at[v].add(torque[:, 0])
            diagonal = diagonal.at[v].add(inertia[:, 0])
            start = stop
        acceleration = jax.scipy.linalg.solve(
            mass + jnp.diag(diagonal), force, assume_a="pos"
        )
        new = qvel + dt * acceleration
        speeds = qvel[np.asarray(m.jnt_dofadr[m.actuator_trnid[:, 0]], int)] if m.nu else zero[None]
        power = jnp.sum(jnp.abs(data.actuator_force * speeds)) if m.nu else zero
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
