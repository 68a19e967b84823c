"""MJX's step as an engine: the reference, and the fallback.

MJX computes kinematics, the joint-space inertia and bias forces of each individual; the water's
forces, the added mass and the servos come from the same functions as in the population engine and
enter through the bodies' Jacobians. So the two engines share the laws, not the mechanics. The bed
is the population engine's penalty law or, where the world says so, MJX's contact solver.
"""

from __future__ import annotations

import copy
import itertools
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from jaxtyping import Array, Float

from mjx_revolve.engine import population
from mjx_revolve.engine.dynamics import inertia_and_momentum, midpoint_forces, with_bed
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.hydrodynamics import PreviousStep
from mjx_revolve.engine.plant import Plant, plant_of
from mjx_revolve.engine.robot import Robot, check_timestep, import_mjx
from mjx_revolve.engine.servos import end_stop, own_torque, servo, spring_damping
from mjx_revolve.engine.single_tree import SingleTree, make_single_tree
from mjx_revolve.engine.state import RootState, State, integrate_quat
from mjx_revolve.engine.thrusters import run_thrusters
from mjx_revolve.engine.tree import Tree
from mjx_revolve.engine.variation import Variation
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.inertia import BodyMotion, SpatialInertia, cross_force, gyroscope
from mjx_revolve.numerics.spatial import full, quat_to_mat
from mjx_revolve.water.flow import Water

mjx = import_mjx()
# Not exported, but the only way to the stages of a step and to a body's Jacobian.
from mujoco.mjx._src import forward, solver, support  # noqa: E402

_OFF = mujoco.mjtDisableBit
# Newton's steps of the contact solver and of its line search. MJX takes all steps of the search for
# every lane; MuJoCo's 50 change nothing. A choice.
_STEPS, _SEARCH = 20, 8


class MjxState(NamedTuple):
    """State of a population, `lanes` on the last axis.

    Attributes:
        qpos: `[nq, lanes]`.
        qvel: `[nv, lanes]`.
        qacc_prev: `[nv, lanes]` accelerations of the step before, the root's as rates of its
            body-frame velocities.
        command: of the thrusters, behind their lag, `[nthruster, lanes]` [-].
        submerged: submerged fractions at the step before, `[npart, nbody, lanes]` of each group of
            each level [-].
    """

    qpos: Float[Array, "nq lanes"]
    qvel: Float[Array, "nv lanes"]
    qacc_prev: Any
    command: Float[Array, "nthruster lanes"]
    submerged: Any


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
        model: MJX's.
        data: MJX's, of pose and velocity; contacts see the velocity over the ground.
        qpos: `[nq]`.
        qvel: `[nv]`.
        ahead: `[nv]` half a step ahead, for the water's forces and momenta that turn.
        acceleration: `[3]` of the current [m/s²].
        drift: spatial acceleration of each level's bodies when no joint accelerates, `[nbody, 6]`.
        swing: of each level's bodies, what the turning of the hinges' axes adds to their Jacobians,
            `[nbody, 6, nv]`, or a zero without carried water; see `dynamics.accelerate`.
    """

    model: Any
    data: Any
    qpos: jax.Array
    qvel: jax.Array
    ahead: jax.Array
    acceleration: jax.Array
    drift: list[jax.Array]
    swing: list[jax.Array]


@dataclass(frozen=True, eq=False)
class MjxEngine(Engine[MjxState]):
    """MJX's step of a robot as an `Engine`, for a population on the last axis.

    Attributes:
        robot: the robot.
        tree: the population engine's constants.
        plant: its actuators, in the robot's own order.
        columns: `[level]` of qvel that are its hinges.
        descendants: `[nv]` degrees of freedom that hang below each.
        solves: whether MJX solves the contact with the bed.
    """

    robot: Robot
    tree: SingleTree
    plant: Plant
    columns: tuple[np.ndarray, ...]
    descendants: tuple[np.ndarray, ...]
    solves: bool
    _models: dict[Any, Any] = field(default_factory=dict, repr=False)

    elementwise = False
    interaction = None

    @property
    def dt(self) -> float:
        """Of the step [s]."""
        return self.tree.world.timestep

    def _model(self, dtype: Any) -> Any:
        """MJX's model, one for each precision: it keeps the digits of the mode it is made in."""
        if dtype not in self._models:
            # A user may have set MuJoCo's own fluid, to run MuJoCo beside ours; here it stays off.
            dry = copy.copy(self.robot.mj_model)
            dry.opt.density = dry.opt.viscosity = 0.0
            with jax.ensure_compile_time_eval():
                model = mjx.put_model(dry)
            self._models[dtype] = model.replace(opt=_options(model.opt, self.solves))
        return self._models[dtype]

    def with_variation(self, variation: Variation) -> MjxEngine:
        """Refused: MJX's engine has the coefficients of its model.

        Raises:
            InputError: always.
        """
        raise InputError("engine", "'population' for other coefficients", "'mjx'")

    def init(self, qpos: Float[Array, "nq lanes"], qvel: Float[Array, "nv lanes"]) -> MjxState:
        """The state of a population, thrusters at rest."""
        length = jnp.sqrt(jnp.sum(qpos[3:7] ** 2, 0))
        command = jnp.zeros((self.tree.thrusters.count, *qpos.shape[1:]), qpos.dtype)
        qacc_prev = jnp.zeros_like(qvel)
        root, below = self.tree.fully_submerged(qpos.shape[1:], qpos.dtype)
        return MjxState(qpos.at[3:7].divide(length), qvel, qacc_prev, command, (root, *below))

    def step(
        self, state: MjxState, ctrl: Float[Array, "n lanes"], water: Water, wrench: Any = ()
    ) -> tuple[MjxState, Float[Array, " lanes"]]:
        """The state after a step, and the power of servos and ideal propellers [W]."""
        qpos, qvel, qacc_prev, command, submerged = state
        lanes = qpos.shape[-1]
        # Plain numbers stay constants, so that still water costs nothing; arrays are mapped.
        plain = lambda x: isinstance(x, int | float)  # noqa: E731
        fixed = jax.tree.map(lambda x: x if plain(x) else None, water)
        given = jax.tree.map(lambda x: None if plain(x) else x, water)
        command, thrusts, pumped = self._thrust(state, ctrl)

        def single(given: Any, xs: tuple[Any, ...]) -> Any:
            merged = jax.tree.map(
                lambda a, b: b if a is None else a, fixed, given, is_leaf=lambda x: x is None
            )
            return _step(self, self._model(qpos.dtype), merged, *xs)

        given = jax.tree.map(lambda x: jnp.broadcast_to(x, (lanes,)), given)
        qpos, qvel, qacc_prev, submerged, power = jax.vmap(single, in_axes=-1, out_axes=-1)(
            given, (qpos, qvel, qacc_prev, submerged, ctrl, thrusts)
        )
        return MjxState(qpos, qvel, qacc_prev, command, submerged), power + pumped

    def _thrust(self, state: MjxState, ctrl: jax.Array) -> tuple[Any, Any, Any]:
        """The thrusters' commands, thrusts and power."""
        thrusters, density = self.tree.thrusters, self.tree.world.density
        if not thrusters.count:
            return state.command, (), 0.0
        ctrl = ctrl[self.plant.num_hinges :]
        command, thrusts, pumped = run_thrusters(thrusters, state.command, ctrl, density)
        return command, thrusts, jnp.sum(pumped, 0)

    def observe(self, state: MjxState) -> tuple[Float[Array, "nq lanes"], Float[Array, "nv lanes"]]:
        """Qpos and qvel in MuJoCo's order."""
        return state.qpos, state.qvel

    def root(self, state: MjxState) -> RootState:
        """Pose and velocity of the core."""
        qpos, qvel = state.qpos, state.qvel
        return RootState(tuple(qpos[:3]), tuple(qpos[3:7]), tuple(qvel[:3]), tuple(qvel[3:6]))

    def joints(self, state: MjxState) -> tuple[Float[Array, "hinges lanes"], ...]:
        """Angles [rad] and speeds [rad/s] of the hinges."""
        return state.qpos[7:], state.qvel[6:]

    def thruster_command(self, state: MjxState) -> Float[Array, "nthruster lanes"]:
        """The thrusters' commands behind their lag."""
        return state.command

    # How the passes of all engines see it; their rows of hinges are those of the levels.

    def _state(self, state: MjxState) -> State:
        found = population.init(self.tree, state.qpos, state.qvel)
        return found._replace(
            submerged=found.submerged and (state.submerged[0], state.submerged[1:])
        )

    def _ordered(self, rows: jax.Array, seen: State) -> jax.Array:
        first = len(rows) - self.plant.num_hinges
        hinges = self.tree.tree_to_joints(self.tree.split_rows(rows[first:]), seen.position[0])
        return jnp.concatenate([rows[:first], hinges])

    def _targets(self, ctrl: jax.Array) -> Any:
        return self.tree.joints_to_tree(ctrl[: self.plant.num_hinges])

    def _thrusts(self, tree: Tree, state: MjxState, ctrl: jax.Array) -> Any:
        return self._thrust(state, ctrl)[1]


def make_mjx_engine(robot: Robot, contact: bool = True) -> MjxEngine:
    """MJX's step of a robot.

    Args:
        robot: from `build_robot`.
        contact: whether the robot can touch the bed.

    Returns:
        The engine.

    Raises:
        InputError: the world is not one that it can step.
    """
    model, world = robot.mj_model, robot.world
    solves = contact and world.bed is not None and world.bed.contact == "mjx"
    tree = make_single_tree(robot, contact and not solves)
    check_timestep(robot, "mjx")
    edges = np.cumsum([0] + [level.count for level in tree.below])
    # 32 bits: JAX keeps one typed copy of an array that it meets, in either mode.
    descendants = [[k for k in range(model.nv) if _descends(model, k, j)] for j in range(model.nv)]
    return MjxEngine(
        robot,
        tree,
        plant_of(robot),
        tuple(6 + tree.hinge_order[a:b] for a, b in itertools.pairwise(edges)),
        tuple(np.array(x, np.int32) for x in descendants),
        solves,
    )


# ------------------------------------------------------------------ the stages of a step


def _step(
    plan: MjxEngine,
    model: Any,
    water: Water,
    qpos: Any,
    qvel: Any,
    qacc_prev: Any,
    submerged: Any,
    ctrl: Any,
    thrusts: Any,
) -> tuple[Any, Any, Any, Any, Any]:
    """One step of one individual: (qpos, qvel, qacc_prev, submerged) after it, and servo power."""
    zero = jnp.zeros((), qpos.dtype)
    current, acceleration = (
        jnp.stack([zero + x for x in xs]) for xs in (water.current, water.acceleration)
    )
    flow = _start(plan, model, qpos, qvel, qacc_prev, current, acceleration)
    matrices = _rigid(plan, flow)
    fractions = []
    for level, before in enumerate(submerged):
        matrices, fraction = _add_water(plan, flow, matrices, level, water, thrusts, before)
        fractions.append(fraction)
    damping = jnp.asarray(plan.robot.mj_model.dof_damping * plan.dt, qpos.dtype)
    matrices = matrices._replace(mass=matrices.mass + jnp.diag(damping))
    power = zero
    # Tips to root, as in the articulated-body algorithm: a servo needs the inertia that it moves.
    for level in reversed(range(1, len(plan.tree.all))):
        matrices, spent = _add_servos(plan, flow, matrices, level, ctrl)
        power = power + spent
    kind = "gen" if plan.tree.carries else "pos"
    rates = jax.scipy.linalg.solve(matrices.mass, matrices.force, assume_a=kind)
    if plan.solves:
        smooth = rates.at[:3].add(acceleration)
        push = _contact_force(flow, matrices.mass, smooth)
        rates = rates + jax.scipy.linalg.solve(matrices.mass, push, assume_a=kind)
    return *_advance(plan, flow, rates, current), tuple(fractions), power


def _start(
    plan: MjxEngine,
    model: Any,
    qpos: Any,
    qvel: Any,
    qacc_prev: Any,
    current: Any,
    acceleration: Any,
) -> _Flow:
    """What follows from pose and velocity."""
    seen, qvel = qvel, qvel.at[:3].add(-current)
    # Momenta that turn, and the water's forces, are those half a step ahead (see `dynamics`).
    ahead = qvel + 0.5 * plan.dt * qacc_prev.at[:3].set(_rows(qpos) @ qacc_prev[:3])
    # With carried water the bodies' own momenta turn with it, below; else MuJoCo's terms hold.
    moving = jnp.zeros_like(qvel) if plan.tree.carries else qvel
    data = mjx.make_data(model).replace(qpos=qpos, qvel=seen)
    data = forward.fwd_position(model, data).replace(qvel=moving)
    data = forward.fwd_velocity(model, data)

    def velocities(time: Any) -> list[Any]:
        moved = mjx.make_data(model).replace(qpos=_moved(qpos, ahead, time))
        moved = mjx.com_pos(model, mjx.kinematics(model, moved))
        levels = range(len(plan.tree.all))
        return [
            jnp.einsum("bij,j->bi", _jacobians(plan, model, moved, k)[0], ahead) for k in levels
        ]

    # d/dt of J at constant q̇.
    zero = jnp.zeros((), qpos.dtype)
    _, drift = jax.jvp(velocities, (zero,), (zero + 1,))
    swing = [zero] * len(drift)
    if plan.tree.carries:
        swing = _swing(plan, model, data, ahead)
        drift = [x - y @ qacc_prev for x, y in zip(drift, swing, strict=True)]
    return _Flow(model, data, qpos, qvel, ahead, acceleration, drift, swing)


def _jacobians(plan: MjxEngine, model: Any, data: Any, level: int) -> tuple[Any, Any]:
    """`[nbody, 6, nv]` of a level's bodies, in their own frames, and `[nbody, 3, 3]` axes."""
    rows, axes = [], []
    for body, frame in zip(plan.tree.bodies[level], plan.tree.frames[level], strict=True):
        linear, angular = support.jac(model, data, data.xpos[body], jnp.int32(body))
        turn = data.xmat[body] @ jnp.asarray(frame, data.qpos.dtype)
        rows.append(jnp.concatenate([turn.T @ angular.T, turn.T @ linear.T]))
        axes.append(turn)
    return jnp.stack(rows), jnp.stack(axes)


def _swing(plan: MjxEngine, model: Any, data: Any, ahead: Any) -> list[jax.Array]:
    """By how much the axes of hinges turn in half a step, as `_Flow.swing`."""
    turned = mjx.com_vel(model, data.replace(qvel=ahead)).cdof_dot.at[:6].set(0)
    rates = data.replace(cdof=0.5 * plan.dt * turned)
    return [_jacobians(plan, model, rates, k)[0] for k in range(len(plan.tree.all))]


def _rigid(plan: MjxEngine, flow: _Flow) -> _Matrices:
    """MuJoCo's own mass matrix and forces, the hinges' friction among them."""
    data, mass = flow.data, support.full_m(flow.model, flow.data)
    friction = jnp.asarray(plan.robot.mj_model.dof_damping, flow.qpos.dtype)
    resisted = flow.qvel if plan.tree.carries else 0.0
    force = data.qfrc_passive - data.qfrc_bias - friction * resisted
    # The current's acceleration acts like gravity.
    return _Matrices(mass, force - mass[:, :3] @ flow.acceleration)


def _add_water(
    plan: MjxEngine,
    flow: _Flow,
    matrices: _Matrices,
    level: int,
    water: Water,
    thrusts: Any,
    submerged: Any,
) -> tuple[_Matrices, Any]:
    """Water, thrusters and bed on the bodies of a level, by the population engine's functions.

    Takes the submerged fractions of the step before, `[npart, nbody]` each; returns those of now.
    """
    tree, dt, world = plan.tree, plan.dt, plan.tree.world
    constants, drift = tree.all[level], flow.drift[level]
    jacobian, axes = _jacobians(plan, flow.model, flow.data, level)
    rate, rate_ahead = (jnp.einsum("bij,j->bi", jacobian, v) for v in (flow.qvel, flow.ahead))
    column = lambda x: tuple(x[:, i, None] for i in range(3))  # noqa: E731
    place = flow.data.xpos[jnp.asarray(tree.bodies[level])]
    midpoint = column(rate_ahead[:, :3]), column(rate_ahead[:, 3:])
    spin, velocity = column(rate[:, :3]), column(rate[:, 3:])
    (*xy, height), (x, y, z) = column(place), (column(axes[:, i]) for i in range(3))
    motion = BodyMotion(spin, velocity, z, height, x, y, tuple(xy), midpoint)
    upwards = flow.acceleration + jnp.array([0.0, 0.0, world.gravity], flow.qpos.dtype)
    gravity = column(jnp.einsum("bji,j->bi", axes, upwards))
    pushes = thrusts[:, None] if tree.thrusters.count else ()
    before = PreviousStep(tuple(x[..., None] for x in submerged), dt) if submerged else None
    external = midpoint_forces(world, constants, motion, gravity, water, pushes, before, dt)
    external = with_bed(world, constants, motion, external, water)
    n = constants.count
    wrench = jnp.concatenate([_stack(external.torque, n), _stack(external.force, n)], -1)
    implicit: list[jax.Array] = []
    lacking: Any = 0.0
    if external.carried is not None:
        implicit.append(_dense(external.carried, n))
    if external.damping is not None:
        implicit.append(dt * _dense(external.damping, n))
    if tree.carries:
        rigid, _, momentum = inertia_and_momentum(constants, external, midpoint)
        turning = cross_force(*motion.twist, *momentum)
        wrench = wrench - jnp.concatenate([_stack(x, n) for x in turning], -1)
        # The mass matrix holds the rigid inertia; its J̇ q̇ is missing, and how axes turn.
        wrench = wrench - jnp.einsum("bij,bj->bi", _dense(rigid, n), drift)
        lacking = jnp.einsum("bik,bij,bjl->kl", jacobian, _dense(rigid, n), flow.swing[level])
        gyro = gyroscope(*momentum)
        rows = [
            jnp.concatenate([_matrix(a, n), _matrix(b, n)], -1)
            for a, b in ((gyro.angular, gyro.across), (gyro.back, gyro.linear))
        ]
        implicit.append(0.5 * dt * jnp.concatenate(rows, -2))
    mass = matrices.mass + lacking
    for spatial in implicit:
        wrench = wrench - jnp.einsum("bij,bj->bi", spatial, drift)
        mass = mass + jnp.einsum("bik,bij,bjl->kl", jacobian, spatial, jacobian + flow.swing[level])
    found = _Matrices(mass, matrices.force + jnp.einsum("bij,bi->j", jacobian, wrench))
    return found, tuple(x[..., 0] for x in external.submerged)


def _add_servos(
    plan: MjxEngine, flow: _Flow, matrices: _Matrices, level: int, ctrl: Any
) -> tuple[_Matrices, Any]:
    """End stops and servos of a level's hinges, and the servos' power."""
    v, hinges = plan.columns[level - 1], plan.tree.all[level].hinges
    assert hinges is not None
    angle, speed = flow.qpos[v + 1][:, None], flow.qvel[v][:, None]
    mass, force = matrices
    moved_inertia, load = [], []
    jacobian_of, _ = _jacobians(plan, flow.model, flow.data, level)
    for j, jacobian, drifting in zip(v, jacobian_of, flow.drift[level], strict=True):
        below, row, load_j = plan.descendants[j], mass[j], force[j]
        if len(below):
            inner = mass[np.ix_(below, below)]
            back = jnp.linalg.solve(inner.T, row[below])
            row, load_j = row - back @ mass[below], load_j - back @ force[below]
        moved_inertia.append(row[j])
        # There the hinge's body is held without acceleration, J̇ q̇ included.
        held = jnp.linalg.solve(jacobian[:, :6], drifting)
        load.append(load_j + row[:6] @ held)
    moved, push = jnp.stack(moved_inertia)[:, None], jnp.stack(load)[:, None]
    damped, target = spring_damping(plan.tree.world), ctrl[v - 6][:, None]
    motor, inertia = servo(hinges, angle, speed, target, plan.dt, moved, push, damped)
    gain = plan.dt * (motor + push) / (moved + inertia)
    stop, stop_inertia = end_stop(hinges, angle, speed, plan.dt, gain)
    implicit, torque = (inertia + stop_inertia)[:, 0], (motor + stop)[:, 0]
    found = _Matrices(mass.at[v, v].add(implicit), force.at[v].add(torque))
    return found, jnp.sum(jnp.abs(own_torque(hinges, motor) * speed))


def _advance(plan: MjxEngine, flow: _Flow, rates: Any, current: Any) -> tuple[Any, Any, Any]:
    """The end of a step: semi-implicit Euler, as `state.integrate`."""
    dt, new, turn = plan.dt, flow.qvel + plan.dt * rates, _rows(flow.qpos)
    way = new
    # The velocity with which momenta turn, as in `dynamics.accelerate`.
    ahead = flow.ahead if plan.tree.carries else flow.qvel
    before = turn.T @ flow.qvel[:3]
    qacc_prev = rates.at[:3].set(turn.T @ rates[:3] - jnp.cross(ahead[3:6], turn.T @ ahead[:3]))
    if plan.tree.carries:
        quat = integrate_quat(tuple(flow.qpos[3:7]), tuple(new[3:6]), dt)
        turned = jnp.stack([jnp.stack(r) for r in quat_to_mat(quat)])
        seen = before + dt * qacc_prev[:3]
        new = new.at[:3].set(turned @ seen)
        way = way.at[:3].set(0.5 * (turn + turned) @ seen)
    new, way = (v.at[:3].add(current + dt * flow.acceleration) for v in (new, way))
    return _moved(flow.qpos, way, jnp.asarray(dt, flow.qpos.dtype)), new, qacc_prev


def _moved(qpos: Any, qvel: Any, time: Any) -> Any:
    """`[nq]` after a time at a velocity."""
    quat = integrate_quat(tuple(qpos[3:7]), tuple(time * qvel[3:6]), 1.0)
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


def _contact_force(flow: _Flow, mass: jax.Array, smooth: jax.Array) -> jax.Array:
    """Generalised force of the bed on the robot, by MJX's constraint solver.

    MuJoCo's contact model (Todorov 2014, Convex and analytically-invertible dynamics with contacts
    and constraints): among accelerations a, the least of ½ (a - a₀)ᵀ M (a - a₀) plus the contacts'
    soft constraints on J a. Here a₀ is the acceleration that our scheme gives without contact, and
    M the symmetric part of the matrix that it solves with: inertia, carried water, and the implicit
    drag, friction and servos of the step. So a contact acts against added mass and drag, too, and
    its constraint on the velocity holds at the end of the step.

    Approximated: the part of the matrix that is not symmetric, of the order of dt, can be included
    by no minimisation. The solver leaves it out, and the step that applies the force includes it:
    momentum is conserved, and the constraint is met less exactly. The softness of a
    contact (`invweight`) follows from the dry masses. A servo predicts its speed without the
    contact.

    Args:
        flow: of the step.
        mass: `[nv, nv]` of the step, not symmetric.
        smooth: `[nv]` acceleration without contact, over the ground.

    Returns:
        `[nv]` force [N, N·m].
    """
    inertia = 0.5 * (mass + mass.T)
    data = flow.data.tree_replace({"_impl.M": inertia})
    data = data.replace(qacc_smooth=smooth, qfrc_smooth=inertia @ smooth)
    return solver.solve(flow.model, data).qfrc_constraint


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
    return jnp.stack([jnp.stack(row) for row in quat_to_mat(tuple(qpos[3:7]))])


def _matrix(m: Any, n: int) -> jax.Array:
    return jnp.stack([_stack(row, n) for row in m], -2)


def _dense(inertia: SpatialInertia, n: int) -> jax.Array:
    """A spatial inertia as `[nbody, 6, 6]`."""
    blocks = full(inertia.angular), inertia.cross, full(inertia.linear)
    angular, cross, linear = (_matrix(block, n) for block in blocks)
    top = jnp.concatenate([angular, cross], -1)
    bottom = jnp.concatenate([jnp.swapaxes(cross, 1, 2), linear], -1)
    return jnp.concatenate([top, bottom], -2)
