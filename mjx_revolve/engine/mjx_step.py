"""MJX's step behind the same call as the population step: the reference, and the fallback.

MJX computes kinematics, the joint-space inertia and bias forces of each individual; the water's
forces, the carried water's inertia and the servos come from the same functions as in the population
step and enter through the bodies' Jacobians. So the two engines share the laws, not the mechanics.
The bed is the population step's penalty law or, where the world says so, MJX's contact solver.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np

from mjx_revolve.engine.dynamics import outer_forces, with_water
from mjx_revolve.engine.hydrodynamics import Before
from mjx_revolve.engine.levels import Levels, make_levels
from mjx_revolve.engine.motions import motions_of
from mjx_revolve.engine.plant import plant_of
from mjx_revolve.engine.pushes import cells_of, push_of, touch_of
from mjx_revolve.engine.robot import Robot, check_timestep, import_mjx
from mjx_revolve.engine.servos import end_stop, servo
from mjx_revolve.engine.state import Engine, Root, turn_quat
from mjx_revolve.engine.step import init as start
from mjx_revolve.engine.step import load as torques
from mjx_revolve.engine.thrusters import run_thrusters
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


class _Plan(NamedTuple):
    """What the stages of a step know of the robot.

    Attributes:
        robot: the robot.
        levels: the population step's constants.
        columns: `[level]` of qvel that are its hinges.
        below: `[nv]` degrees of freedom that hang below each.
        solves: whether MJX solves the contact with the bed.
    """

    robot: Robot
    levels: Levels
    columns: tuple[np.ndarray, ...]
    below: tuple[np.ndarray, ...]
    solves: bool

    @property
    def dt(self) -> float:
        """Of the step [s]."""
        return self.levels.world.timestep


class _Matrices(NamedTuple):
    """M q̈ = f, as the stages build it up.

    Attributes:
        mass: `[nv, nv]`, all that is implicit included.
        force: `[nv]`.
    """

    mass: jax.Array
    force: jax.Array


class _Flow(NamedTuple):
    """How an individual moves, seen from the uniform current.

    Attributes:
        qpos: `[nq]`.
        qvel: `[nv]`.
        ahead: `[nv]` half a step ahead, for momenta that turn.
        acceleration: `[3]` of the current [m/s²].
        drift: spatial acceleration of each level's bodies when no joint accelerates, `[nbody, 6]`.
    """

    qpos: jax.Array
    qvel: jax.Array
    ahead: jax.Array
    acceleration: jax.Array
    drift: list[jax.Array]


def make_mjx_engine(robot: Robot, contact: bool = True) -> Engine:
    """MJX's step of a robot, for a population on the last axis.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed.

    Returns:
        The engine; see `state.Engine`.

    Raises:
        InputError: the world is not one that it can step.
    """
    m, world = robot.mj_model, robot.world
    solves = contact and world.bed is not None and world.bed.contact == "mjx"
    levels = make_levels(robot, contact and not solves)
    check_timestep(robot, "mjx")
    edges = np.cumsum([0] + [level.count for level in levels.below])
    plan = _Plan(
        robot,
        levels,
        tuple(6 + levels.hinge_order[a:b] for a, b in itertools.pairwise(edges)),
        # 32 bits: JAX keeps one typed copy of an array that it meets, in either mode.
        tuple(
            np.array([k for k in range(m.nv) if _descends(m, k, j)], np.int32) for j in range(m.nv)
        ),
        solves,
    )
    plant, thrusters = plant_of(robot), levels.thrusters
    models: dict[Any, Any] = {}

    def model_of(dtype: Any) -> Any:
        # One for each precision: a model keeps the digits of the mode that it was made in.
        if dtype not in models:
            with jax.ensure_compile_time_eval():
                model = mjx.put_model(m)
            models[dtype] = model.replace(opt=_options(model.opt, solves))
        return models[dtype]

    def drive(command: Any, ctrl: jax.Array) -> tuple[Any, Any, Any]:
        if not thrusters.count:
            return command, (), 0.0
        command, thrusts, pumped = run_thrusters(
            thrusters, command, ctrl[plant.num_hinges :], world.density
        )
        return command, thrusts, jnp.sum(pumped, 0)

    def step(state: Any, ctrl: jax.Array, water: Water) -> tuple[Any, jax.Array]:
        qpos, qvel, pace, command, wet = state
        lanes = qpos.shape[-1]
        # Plain numbers stay constants, so that still water costs nothing; arrays are mapped.
        plain = lambda x: isinstance(x, int | float)  # noqa: E731
        fixed = jax.tree.map(lambda x: x if plain(x) else None, water)
        given = jax.tree.map(lambda x: None if plain(x) else x, water)
        command, thrusts, pumped = drive(command, ctrl)

        def single(
            qpos: Any, qvel: Any, pace: Any, wet: Any, ctrl: Any, thrusts: Any, given: Any
        ) -> Any:
            merged = jax.tree.map(
                lambda a, b: b if a is None else a, fixed, given, is_leaf=lambda x: x is None
            )
            return _step(plan, model_of(qpos.dtype), qpos, qvel, pace, wet, ctrl, thrusts, merged)

        given = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes,)), given)
        qpos, qvel, pace, wet, power = jax.vmap(single, in_axes=-1, out_axes=-1)(
            qpos, qvel, pace, wet, ctrl, thrusts, given
        )
        return (qpos, qvel, pace if levels.carries else None, command, wet), power + pumped

    def init(qpos: jax.Array, qvel: jax.Array) -> Any:
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        command = jnp.zeros((thrusters.count, *qpos.shape[1:]), qpos.dtype)
        pace = jnp.zeros_like(qvel) if levels.carries else None
        root, below = levels.all_wet(qpos.shape[1:], qpos.dtype)
        return qpos.at[3:7].divide(length), qvel, pace, command, (root, *below)

    def root(state: Any) -> Root:
        qpos, qvel, *_ = state
        return Root(tuple(qpos[:3]), tuple(qpos[3:7]), tuple(qvel[:3]), tuple(qvel[3:6]))

    def push(state: Any, ctrl: jax.Array, water: Water) -> Any:
        qpos, qvel, _, command, _ = state
        return push_of(levels, start(levels, qpos, qvel), water, drive(command, ctrl)[1])

    def load(state: Any, ctrl: jax.Array) -> jax.Array:
        qpos, qvel, *_ = state
        # The plant's rows are the robot's hinges, and so are those of the levels, spread again.
        rows = ctrl[: plant.num_hinges][levels.hinge_order]
        found = torques(levels, start(levels, qpos, qvel), rows)
        return levels.gather(levels.split(found), qpos[0])

    def touch(state: Any, water: Water) -> jax.Array:
        qpos, qvel, *_ = state
        found = touch_of(levels, start(levels, qpos, qvel), water)
        return own_order(found, qpos[0])

    def own_order(found: jax.Array, like: jax.Array) -> jax.Array:
        # The plant's rows are the robot's own hinges.
        return jnp.concatenate([found[:1], levels.gather(levels.split(found[1:]), like)])

    def motions(state: Any) -> Motion:
        qpos, qvel, *_ = state
        found = motions_of(levels, start(levels, qpos, qvel))
        return jax.tree.map(lambda x: own_order(x, qpos[0]), found)

    def cells(state: Any, water: Water) -> Any:
        qpos, qvel, *_ = state
        return cells_of(levels, start(levels, qpos, qvel), water)

    return Engine(
        init=init,
        step=step,
        observe=lambda state: state[:2],
        root=root,
        joints=lambda state: (state[0][7:], state[1][6:]),
        load=load,
        touch=touch,
        motions=motions,
        cells=cells,
        command=lambda state: state[3],
        push=push,
        plant=plant,
        fuses=False,
    )


# ------------------------------------------------------------------ the stages of a step


def _step(
    plan: _Plan,
    model: Any,
    qpos: Any,
    qvel: Any,
    pace: Any,
    wet: Any,
    ctrl: Any,
    thrusts: Any,
    water: Water,
) -> tuple[Any, Any, Any, Any, Any]:
    """One step of one individual: (qpos, qvel, pace, wet) after it, and the servos' power."""
    zero = jnp.zeros((), qpos.dtype)
    current, acceleration = (
        jnp.stack([zero + x for x in xs]) for xs in (water.current, water.acceleration)
    )
    data, flow = _start(plan, model, qpos, qvel, pace, current, acceleration)
    matrices = _rigid(plan, model, data, flow)
    shares = []
    for level, before in enumerate(wet):
        matrices, share = _add_water(
            plan, model, data, flow, matrices, level, water, thrusts, before
        )
        shares.append(share)
    damping = jnp.asarray(plan.robot.mj_model.dof_damping * plan.dt, qpos.dtype)
    matrices = matrices._replace(mass=matrices.mass + jnp.diag(damping))
    power = zero
    # Tips to root, as in the articulated-body algorithm: a servo must know what it moves.
    for level in reversed(range(1, len(plan.levels.all))):
        matrices, spent = _add_servos(plan, model, data, flow, matrices, level, ctrl)
        power = power + spent
    kind = "gen" if plan.levels.carries else "pos"
    rates = jax.scipy.linalg.solve(matrices.mass, matrices.force, assume_a=kind)
    if plan.solves:
        smooth = rates.at[:3].add(acceleration)
        push = _contact_force(model, data, matrices.mass, smooth)
        rates = rates + jax.scipy.linalg.solve(matrices.mass, push, assume_a=kind)
    return *_advance(plan, flow, rates, current), tuple(shares), power


def _start(
    plan: _Plan, model: Any, qpos: Any, qvel: Any, pace: Any, current: Any, acceleration: Any
) -> tuple[Any, _Flow]:
    """All that follows from place and velocity; contacts see the velocity over the ground."""
    seen, qvel = qvel, qvel.at[:3].add(-current)
    # Momenta that turn are taken half a step ahead (see `dynamics.accelerate`).
    ahead = qvel
    if pace is not None:
        ahead = qvel + 0.5 * plan.dt * pace.at[:3].set(_rows(qpos) @ pace[:3])
    # With carried water the bodies' own momenta turn with it, below; else MuJoCo's terms hold.
    moving = jnp.zeros_like(qvel) if plan.levels.carries else qvel
    data = mjx.make_data(model).replace(qpos=qpos, qvel=seen)
    data = forward.fwd_position(model, data).replace(qvel=moving)
    data = forward.fwd_velocity(model, data)

    def velocities(time: Any) -> list[Any]:
        moved = mjx.make_data(model).replace(qpos=_moved(qpos, ahead, time))
        moved = mjx.com_pos(model, mjx.kinematics(model, moved))
        levels = range(len(plan.levels.all))
        return [
            jnp.einsum("bij,j->bi", _jacobians(plan, model, moved, k)[0], ahead) for k in levels
        ]

    # d/dt of J at constant q̇.
    zero = jnp.zeros((), qpos.dtype)
    _, drift = jax.jvp(velocities, (zero,), (zero + 1,))
    return data, _Flow(qpos, qvel, ahead, acceleration, drift)


def _jacobians(plan: _Plan, model: Any, data: Any, level: int) -> tuple[Any, Any]:
    """`[nbody, 6, nv]` of a level's bodies, in their own frames, and `[nbody, 3, 3]` axes."""
    rows, axes = [], []
    for body, frame in zip(plan.levels.bodies[level], plan.levels.frames[level], strict=True):
        linear, angular = support.jac(model, data, data.xpos[body], jnp.int32(body))
        turn = data.xmat[body] @ jnp.asarray(frame, data.qpos.dtype)
        rows.append(jnp.concatenate([turn.T @ angular.T, turn.T @ linear.T]))
        axes.append(turn)
    return jnp.stack(rows), jnp.stack(axes)


def _rigid(plan: _Plan, model: Any, data: Any, flow: _Flow) -> _Matrices:
    """MuJoCo's own mass matrix and forces, the hinges' friction among them."""
    mass = support.full_m(model, data)
    friction = jnp.asarray(plan.robot.mj_model.dof_damping, flow.qpos.dtype)
    resisted = flow.qvel if plan.levels.carries else 0.0
    force = data.qfrc_passive - data.qfrc_bias - friction * resisted
    # The current's acceleration is felt as weight is.
    return _Matrices(mass, force - mass[:, :3] @ flow.acceleration)


def _add_water(
    plan: _Plan,
    model: Any,
    data: Any,
    flow: _Flow,
    matrices: _Matrices,
    level: int,
    water: Water,
    thrusts: Any,
    wet: Any,
) -> tuple[_Matrices, Any]:
    """Water, thrusters and bed on the bodies of a level, by the population step's functions.

    Takes the submerged shares of the step before, `[npart, nbody]` each, and gives those of now.
    """
    levels, dt, world = plan.levels, plan.dt, plan.levels.world
    constants, drift = levels.all[level], flow.drift[level]
    jacobian, axes = _jacobians(plan, model, data, level)
    rate, rate_ahead = (jnp.einsum("bij,j->bi", jacobian, v) for v in (flow.qvel, flow.ahead))
    column = lambda x: tuple(x[:, i, None] for i in range(3))  # noqa: E731
    place = data.xpos[jnp.asarray(levels.bodies[level])]
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
    upwards = flow.acceleration + jnp.array([0.0, 0.0, world.gravity], flow.qpos.dtype)
    gravity = column(jnp.einsum("bji,j->bi", axes, upwards))
    pushes = thrusts[:, None] if levels.thrusters.count else ()
    before = Before(tuple(x[..., None] for x in wet), dt) if wet else None
    outer = outer_forces(constants, motion, swirling, gravity, water, pushes, world, before)
    n = constants.count
    wrench = jnp.concatenate([_stack(outer.torque, n), _stack(outer.force, n)], -1)
    implicit = []
    if outer.carried is not None:
        implicit.append(_dense(outer.carried, n))
    if outer.damping is not None:
        implicit.append(dt * _dense(outer.damping, n))
    if levels.carries:
        rigid, _, momentum = with_water(constants, outer, swirling)
        turning = cross_force(motion.spin, motion.velocity, *momentum)
        wrench = wrench - jnp.concatenate([_stack(x, n) for x in turning], -1)
        # The mass matrix holds the rigid inertia; only its J̇ q̇ is missing.
        wrench = wrench - jnp.einsum("bij,bj->bi", _dense(rigid, n), drift)
        gyro = gyroscope(*momentum)
        rows = [
            jnp.concatenate([_matrix(a, n), _matrix(b, n)], -1)
            for a, b in ((gyro.angular, gyro.across), (gyro.back, gyro.linear))
        ]
        implicit.append(0.5 * dt * jnp.concatenate(rows, -2))
    mass = matrices.mass
    for spatial in implicit:
        wrench = wrench - jnp.einsum("bij,bj->bi", spatial, drift)
        mass = mass + jnp.einsum("bik,bij,bjl->kl", jacobian, spatial, jacobian)
    found = _Matrices(mass, matrices.force + jnp.einsum("bij,bi->j", jacobian, wrench))
    return found, tuple(x[..., 0] for x in outer.wet)


def _add_servos(
    plan: _Plan, model: Any, data: Any, flow: _Flow, matrices: _Matrices, level: int, ctrl: Any
) -> tuple[_Matrices, Any]:
    """End stops and servos of a level's hinges, and the servos' power."""
    v, hinges = plan.columns[level - 1], plan.levels.all[level].hinges
    assert hinges is not None
    angle, speed = flow.qpos[v + 1][:, None], flow.qvel[v][:, None]
    torque, inertia = end_stop(hinges, angle, speed, plan.dt)
    force = matrices.force.at[v].add(torque[:, 0])
    mass = matrices.mass.at[v, v].add(inertia[:, 0])
    moved_inertia, load = [], []
    jacobian_of, _ = _jacobians(plan, model, data, level)
    for j, jacobian, drifting in zip(v, jacobian_of, flow.drift[level], strict=True):
        below, row, load_j = plan.below[j], mass[j], force[j]
        if len(below):
            inner = mass[np.ix_(below, below)]
            back = jnp.linalg.solve(inner.T, row[below])
            row, load_j = row - back @ mass[below], load_j - back @ force[below]
        moved_inertia.append(row[j])
        # There the hinge's body is held without acceleration, J̇ q̇ included.
        held = jnp.linalg.solve(jacobian[:, :6], drifting)
        load.append(load_j + row[:6] @ held)
    motor, motor_inertia = servo(
        hinges,
        angle,
        speed,
        ctrl[v - 6][:, None],
        plan.dt,
        jnp.stack(moved_inertia)[:, None],
        jnp.stack(load)[:, None],
    )
    found = _Matrices(mass.at[v, v].add(motor_inertia[:, 0]), force.at[v].add(motor[:, 0]))
    return found, jnp.sum(jnp.abs(motor * speed))


def _advance(plan: _Plan, flow: _Flow, rates: Any, current: Any) -> tuple[Any, Any, Any]:
    """The end of a step: semi-implicit Euler, as `state.advance` has it."""
    dt, new, turn = plan.dt, flow.qvel + plan.dt * rates, _rows(flow.qpos)
    ahead, before = flow.ahead, turn.T @ flow.qvel[:3]
    pace = rates.at[:3].set(turn.T @ rates[:3] - jnp.cross(ahead[3:6], turn.T @ ahead[:3]))
    if plan.levels.carries:
        quat = turn_quat(tuple(flow.qpos[3:7]), tuple(new[3:6]), dt)
        turned = jnp.stack([jnp.stack(r) for r in quat_to_rows(quat)])
        new = new.at[:3].set(turned @ (before + dt * pace[:3]))
    new = new.at[:3].add(current + dt * flow.acceleration)
    return _moved(flow.qpos, new, jnp.asarray(dt, flow.qpos.dtype)), new, pace


def _moved(qpos: Any, qvel: Any, time: Any) -> Any:
    """`[nq]` after a time at a velocity."""
    quat = turn_quat(tuple(qpos[3:7]), tuple(time * qvel[3:6]), 1.0)
    return jnp.concatenate(
        [qpos[:3] + time * qvel[:3], jnp.stack(quat), qpos[7:] + time * qvel[6:]]
    )


# ------------------------------------------------------------------ helpers of the stages


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
