"""MJX's step behind the same call as the population step: the reference, and the fallback.

MJX computes kinematics, the joint-space inertia and bias forces of each individual; the water's
forces, the carried water's inertia and the servos come from the same functions as in the population
step and enter through the bodies' Jacobians. So the two engines share the laws, not the mechanics.
The bed is the population step's penalty law or, where the world says so, MJX's contact solver.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot, check_timestep, import_mjx
from mjx_revolve.engine.servos import end_stop, servo
from mjx_revolve.engine.step import (
    Engine,
    Sense,
    outer_forces,
    run_thrusters,
    turn_quat,
    with_water,
)
from mjx_revolve.engine.tree import make_tree
from mjx_revolve.numerics.inertia import Motion, SpatialInertia, cross_force, gyroscope
from mjx_revolve.numerics.spatial import full, quat_to_rows
from mjx_revolve.water.flow import Water

mjx = import_mjx()
# Not exported, but the only way to the stages of a step and to a body's Jacobian.
from mujoco.mjx._src import forward, solver, support  # noqa: E402

_OFF = mujoco.mjtDisableBit
# Newton's steps of the contact solver and of its line search. MJX takes all steps of the search for
# every lane; MuJoCo's 50 change nothing. A choice.
_STEPS, _SEARCH = 20, 8


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
    m, world = robot.mj_model, robot.world
    solves = contact and world.bed is not None and world.bed.contact == "mjx"
    tree = make_tree(robot, contact and not solves)
    dt = world.timestep
    check_timestep(robot, "mjx")
    propellers = sorted(
        (p for level in tree.levels for p in level.propellers), key=lambda p: p.index
    )
    models: dict[Any, Any] = {}

    def model_of(dtype: Any) -> Any:
        # One for each precision: a model keeps the digits of the mode that it was made in.
        if dtype not in models:
            with jax.ensure_compile_time_eval():
                model = mjx.put_model(m)
            models[dtype] = model.replace(opt=_options(model.opt, solves))
        return models[dtype]

    def forward_parts(model: Any, qpos: Any, qvel: Any, seen: Any) -> Any:
        """All that follows from place and velocity; contacts see the velocity over the ground."""
        data = mjx.make_data(model).replace(qpos=qpos, qvel=seen)
        data = forward.fwd_position(model, data).replace(qvel=qvel)
        return forward.fwd_velocity(model, data)

    def jacobians(model: Any, data: Any, level: Any) -> tuple[Any, Any]:
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

    def velocities(model: Any, qpos: Any, qvel: Any) -> list[Any]:
        data = mjx.kinematics(model, mjx.make_data(model).replace(qpos=qpos))
        data = mjx.com_pos(model, data)
        return [jnp.einsum("bij,j->bi", jacobians(model, data, x)[0], qvel) for x in tree.levels]

    def one(qpos: Any, qvel: Any, pace: Any, ctrl: Any, thrusts: Any, water: Water) -> Any:
        model, zero = model_of(qpos.dtype), jnp.zeros((), qpos.dtype)
        current, acceleration = (
            jnp.stack([zero + x for x in xs]) for xs in (water.current, water.acceleration)
        )
        seen = qvel
        qvel = qvel.at[:3].add(-current)  # as seen from the current
        # Momenta that turn are taken half a step ahead (see `dynamics._acceleration`).
        ahead = qvel
        if pace is not None:
            turn = _rows(qpos)
            ahead = qvel + 0.5 * dt * pace.at[:3].set(turn @ pace[:3])
        # With carried water the bodies' own momenta turn with it, below; else MuJoCo's terms hold.
        moving = jnp.zeros_like(qvel) if tree.carries else qvel
        data = forward_parts(model, qpos, moving, seen)
        mass = support.full_m(model, data)
        friction = jnp.asarray(m.dof_damping, qpos.dtype)
        force = data.qfrc_passive - data.qfrc_bias - friction * (qvel if tree.carries else 0.0)
        # The current's acceleration is felt as weight is.
        force = force - mass[:, :3] @ acceleration
        # Spatial acceleration of each body when no joint accelerates: d/dt of J at constant q̇.
        drift = lambda t: velocities(model, moved(qpos, ahead, t), ahead)  # noqa: E731
        _, still = jax.jvp(drift, (zero,), (zero + 1,))
        for level, drift_rate in zip(tree.levels, still, strict=True):
            jacobian, axes = jacobians(model, data, level)
            rate = jnp.einsum("bij,j->bi", jacobian, qvel)
            rate_ahead = jnp.einsum("bij,j->bi", jacobian, ahead)
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
            swirling = (column(rate_ahead[:, :3]), column(rate_ahead[:, 3:]))
            upwards = acceleration + jnp.array([0.0, 0.0, world.gravity], qpos.dtype)
            gravity = column(jnp.einsum("bji,j->bi", axes, upwards))
            outer = outer_forces(level, motion, swirling, gravity, water, thrusts, world)
            n = len(level.body)
            wrench = jnp.concatenate([_stack(outer.torque, n), _stack(outer.force, n)], -1)
            matrices = []
            if outer.carried is not None:
                matrices.append(_dense(outer.carried, n))
            if outer.damping is not None:
                matrices.append(dt * _dense(outer.damping, n))
            if tree.carries:
                rigid, _, momentum = with_water(level, outer, swirling)
                turning = cross_force(motion.spin, motion.velocity, *momentum)
                wrench = wrench - jnp.concatenate([_stack(x, n) for x in turning], -1)
                # The mass matrix holds the rigid inertia; only its J̇ q̇ is missing.
                wrench = wrench - jnp.einsum("bij,bj->bi", _dense(rigid, n), drift_rate)
                gyro = gyroscope(*momentum)
                rows = [
                    jnp.concatenate([_matrix(a, n), _matrix(b, n)], -1)
                    for a, b in ((gyro.angular, gyro.across), (gyro.back, gyro.linear))
                ]
                matrices.append(0.5 * dt * jnp.concatenate(rows, -2))
            for spatial in matrices:
                wrench = wrench - jnp.einsum("bij,bj->bi", spatial, drift_rate)
                mass = mass + jnp.einsum("bik,bij,bjl->kl", jacobian, spatial, jacobian)
            force = force + jnp.einsum("bij,bi->j", jacobian, wrench)
        mass = mass + jnp.diag(jnp.asarray(m.dof_damping * dt, qpos.dtype))
        power, stop = zero, len(tree.qpos_index)
        # Tips to root, as in the articulated-body algorithm: a servo must know what it moves.
        for level, drift_rate in zip(reversed(tree.levels[1:]), reversed(still[1:]), strict=True):
            start = stop - len(level.body)
            q, v = tree.qpos_index[start:stop], tree.qvel_index[start:stop]
            angle, speed = qpos[q][:, None], qvel[v][:, None]
            torque, inertia = end_stop(level, angle, speed, dt)
            force = force.at[v].add(torque[:, 0])
            mass = mass.at[v, v].add(inertia[:, 0])
            moved_inertia, load = [], []
            jacobian_of, _ = jacobians(model, data, level)
            for j, jacobian, drifting in zip(v, jacobian_of, drift_rate, strict=True):
                # 32 bits: JAX keeps one typed copy of an array that it meets, in either mode.
                below = np.array([k for k in range(m.nv) if _descends(m, k, j)], np.int32)
                row, load_j = mass[j], force[j]
                if len(below):
                    inner = mass[np.ix_(below, below)]
                    back = jnp.linalg.solve(inner.T, row[below])
                    row, load_j = row - back @ mass[below], load_j - back @ force[below]
                moved_inertia.append(row[j])
                # There the hinge's body is held without acceleration, J̇ q̇ included.
                held = jnp.linalg.solve(jacobian[:, :6], drifting)
                load.append(load_j + row[:6] @ held)
            asked = ctrl[tree.ctrl_index[start:stop]][:, None]
            motor, motor_inertia = servo(
                level,
                angle,
                speed,
                asked,
                dt,
                jnp.stack(moved_inertia)[:, None],
                jnp.stack(load)[:, None],
            )
            force = force.at[v].add(motor[:, 0])
            mass = mass.at[v, v].add(motor_inertia[:, 0])
            power = power + jnp.sum(jnp.abs(motor * speed))
            stop = start
        kind = "gen" if tree.carries else "pos"
        rates = jax.scipy.linalg.solve(mass, force, assume_a=kind)
        if solves:
            smooth = rates.at[:3].add(acceleration)
            push = _contact_force(model, data, mass, smooth)
            rates = rates + jax.scipy.linalg.solve(mass, push, assume_a=kind)
        new = qvel + dt * rates
        turn = _rows(qpos)
        before = turn.T @ qvel[:3]
        pace = rates.at[:3].set(turn.T @ rates[:3] - jnp.cross(ahead[3:6], turn.T @ ahead[:3]))
        if tree.carries:
            quat = turn_quat(tuple(qpos[3:7]), tuple(new[3:6]), dt)
            turned = jnp.stack([jnp.stack(r) for r in quat_to_rows(quat)])
            new = new.at[:3].set(turned @ (before + dt * pace[:3]))
        new = new.at[:3].add(current + dt * acceleration)
        return moved(qpos, new, jnp.asarray(dt, qpos.dtype)), new, pace, power

    def step(state: Any, ctrl: jax.Array, water: Water) -> tuple[Any, jax.Array]:
        qpos, qvel, pace, command = state
        lanes = qpos.shape[-1]
        # Plain numbers stay constants, so that still water costs nothing; arrays are mapped.
        plain = lambda x: isinstance(x, int | float)  # noqa: E731
        fixed = jax.tree.map(lambda x: x if plain(x) else None, water)
        given = jax.tree.map(lambda x: None if plain(x) else x, water)
        asked = tuple(ctrl[k] for k in tree.ctrl_index[len(tree.qpos_index) :])
        command, thrusts, pumped = run_thrusters(propellers, command, asked, world, dt)

        def single(qpos: Any, qvel: Any, pace: Any, ctrl: Any, thrusts: Any, given: Any) -> Any:
            merged = jax.tree.map(
                lambda a, b: b if a is None else a, fixed, given, is_leaf=lambda x: x is None
            )
            return one(qpos, qvel, pace, ctrl, thrusts, merged)

        given = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes,)), given)
        qpos, qvel, pace, power = jax.vmap(single, in_axes=-1, out_axes=-1)(
            qpos, qvel, pace, ctrl, [jnp.broadcast_to(x, (lanes,)) for x in thrusts], given
        )
        pace = pace if tree.carries else None
        return (qpos, qvel, pace, command), power + pumped

    def init(qpos: jax.Array, qvel: jax.Array) -> Any:
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        command = tuple(jnp.zeros_like(qpos[0]) for _ in propellers)
        pace = jnp.zeros_like(qvel) if tree.carries else None
        return qpos.at[3:7].divide(length), qvel, pace, command

    def sense(state: Any) -> Sense:
        qpos, qvel, *_ = state
        up = quat_to_rows(tuple(qpos[3:7]))[2]
        return Sense(qpos[2] - world.surface_height, qvel[2], up, tuple(qvel[3:6]))

    def command(state: Any) -> jax.Array:
        return jnp.stack(state[3]) if propellers else jnp.zeros((0, *state[0].shape[1:]))

    return Engine(
        init,
        step,
        lambda state: state[:2],
        lambda state: tuple(state[0][:3]),
        sense,
        command,
        np.arange(m.nu),
    )


def _options(options: Any, solves: bool) -> Any:
    """MJX's options without what is ours: the end stops, and the bed unless MJX solves it."""
    flags = int(options.disableflags)
    if not solves:
        flags |= _OFF.mjDSBL_CONSTRAINT | _OFF.mjDSBL_CONTACT
        return options.replace(disableflags=flags)
    # Each step starts the solver afresh, so that a state is all that a step depends on.
    flags |= _OFF.mjDSBL_LIMIT | _OFF.mjDSBL_WARMSTART
    return options.replace(
        disableflags=flags,
        iterations=_STEPS,
        ls_iterations=_SEARCH,
        # The mass matrix is put in whole, below.
        jacobian=mujoco.mjtJacobian.mjJAC_DENSE,
    )


def _contact_force(model: Any, data: Any, mass: jax.Array, smooth: jax.Array) -> jax.Array:
    """Generalised force of the bed on the robot, by MJX's constraint solver.

    MuJoCo's contact model (Todorov 2014, Convex and analytically-invertible dynamics with contacts
    and constraints): among accelerations a, the least of ½ (a - a₀)ᵀ M (a - a₀) plus the contacts'
    soft constraints on J a. Here a₀ is the acceleration that our scheme gives without contact, and
    M the symmetric part of the matrix that it solves with: inertia, carried water, and the implicit
    drag, friction and servos of the step. So a contact pushes against what the water adds, and what
    it asks of the velocity holds at the end of the step.

    Approximated: what turns momenta is antisymmetric and of the order of dt, no minimum can hold
    it, and the solver does not see it; the step that takes the force in does, so momentum is kept
    and it is the contact that gives way. How soft a contact is (`invweight`) comes from the dry
    masses. A servo foresees its speed without the contact.

    Args:
        model: MJX's.
        data: with contacts and constraints from the velocity over the ground.
        mass: `[nv, nv]` of the step, not symmetric.
        smooth: `[nv]` acceleration without contact, over the ground.

    Returns:
        `[nv]` force [N, N·m].
    """
    inertia = 0.5 * (mass + mass.T)
    data = data.tree_replace({"_impl.M": inertia})
    data = data.replace(qacc_smooth=smooth, qfrc_smooth=inertia @ smooth)
    return solver.solve(model, data).qfrc_constraint


def _stack(components: Any, n: int) -> jax.Array:
    """Components of `[nbody, 1]` each to `[nbody, number]`."""
    dtype = jnp.result_type(float)
    wide = [jnp.broadcast_to(jnp.asarray(x, dtype), (n, 1))[:, 0] for x in components]
    return jnp.stack(wide, -1)


def _descends(model: Any, dof: int, ancestor: int) -> bool:
    """Whether a degree of freedom hangs below another."""
    while dof >= 0:
        dof = model.dof_parentid[dof]
        if dof == ancestor:
            return True
    return False


def _rows(qpos: jax.Array) -> jax.Array:
    """`[3, 3]` world from root."""
    return jnp.stack([jnp.stack(row) for row in quat_to_rows(tuple(qpos[3:7]))])


def _matrix(m: Any, n: int) -> jax.Array:
    return jnp.stack([_stack(row, n) for row in m], -2)


def _dense(inertia: SpatialInertia, n: int) -> jax.Array:
    """A spatial inertia as `[nbody, 6, 6]`."""
    angular, cross, linear = (
        jnp.stack([_stack(row, n) for row in block], -2)
        for block in (full(inertia.angular), inertia.cross, full(inertia.linear))
    )
    top = jnp.concatenate([angular, cross], -1)
    bottom = jnp.concatenate([jnp.swapaxes(cross, 1, 2), linear], -1)
    return jnp.concatenate([top, bottom], -2)
