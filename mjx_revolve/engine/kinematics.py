"""Where a robot's bodies are, for many configurations at once."""

from __future__ import annotations

from functools import partial
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.engine.robot import Robot


def body_positions(robot: Robot, qpos: jax.Array) -> jax.Array:
    """Where every body is: MuJoCo's `xpos`, for many configurations at once.

    Args:
        robot: from `build_robot`.
        qpos: `[n, nq]`.

    Returns:
        `[n, nbody, 3]` world frame [m].
    """
    m = robot.mj_model
    place: list[Any] = [jnp.zeros((qpos.shape[0], 3), qpos.dtype)]
    turn: list[Any] = [jnp.broadcast_to(jnp.eye(3, dtype=qpos.dtype), (qpos.shape[0], 3, 3))]
    cast = partial(jnp.asarray, dtype=qpos.dtype)
    for body in range(1, m.nbody):
        joint = int(m.body_jntadr[body])
        adr = int(m.jnt_qposadr[joint])
        if body == 1:
            quat = qpos[:, adr + 3 : adr + 7]
            place.append(qpos[:, adr : adr + 3])
            turn.append(_matrix(quat / jnp.linalg.norm(quat, axis=-1, keepdims=True)))
            continue
        parent = int(m.body_parentid[body])
        half = qpos[:, adr : adr + 1] / 2
        axis = cast(m.jnt_axis[joint])
        hinge = _matrix(jnp.concatenate([jnp.cos(half), jnp.sin(half) * axis], -1))
        fixed = _matrix(cast(m.body_quat[body])[None])
        place.append(place[parent] + turn[parent] @ cast(m.body_pos[body]))
        turn.append(turn[parent] @ fixed @ hinge)
    return jnp.stack(place, 1)


def _matrix(quat: jax.Array) -> jax.Array:
    """`[n, 4]` unit quaternions to `[n, 3, 3]`."""
    w, x, y, z = jnp.moveaxis(quat, -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return jnp.stack([jnp.stack(row, -1) for row in rows], -2)
