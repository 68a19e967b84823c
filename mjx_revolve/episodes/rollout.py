"""Rollouts: a scan of steps, from a start to a trajectory."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.controllers import BoundController, Controller
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.step import Engine, Sense, make_population_engine
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import compiler_options, fused_scan, share_once
from mjx_revolve.water.flow import Water, gust_path, water_of
from mjx_revolve.water.world import World

ENGINES = ("population", "mjx")


@partial(
    jax.tree_util.register_dataclass,
    data_fields=["time", "qpos", "qvel", "xpos", "ctrl", "power", "command"],
    meta_fields=[],
)
@dataclass(frozen=True)
class Trajectory:
    """What a robot did, one row after each step.

    Attributes:
        time: `[T]` [s]; the first row is one timestep after the start.
        qpos: `[T, nq]` root position, world frame [m], root quaternion (w, x, y, z), hinges [rad].
        qvel: `[T, nv]` root velocity, world frame [m/s], root angular velocity, body frame [rad/s],
            hinges [rad/s].
        xpos: `[T, nbody, 3]` origins of MuJoCo's bodies (0 is the world, 1 the core), world frame
            [m].
        ctrl: `[T, nu]` joint targets [rad] and commands of the thrusters [-], MuJoCo's order.
        power: `[T]` mechanical power at the servos, summed without sign, and what ideal propellers
            need for the thrust [W].
        command: `[T, nthruster]` commands of the thrusters behind their lag [-].
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    xpos: jax.Array
    ctrl: jax.Array
    power: jax.Array
    command: jax.Array | None = None


@lru_cache(maxsize=32)
def make_engine(robot: Robot, engine: str = "population", contact: bool = True) -> Engine:
    """The simulator behind a rollout.

    Args:
        robot: from `build_robot`.
        engine: "population" or "mjx".
        contact: whether the robot can touch the bed.

    Returns:
        The engine.

    Raises:
        InputError: an unknown engine, or something that it cannot do.
    """
    if engine == "population":
        return make_population_engine(robot, contact)
    if engine == "mjx":
        from mjx_revolve.engine.mjx_step import make_mjx_engine

        return make_mjx_engine(robot, contact)
    raise InputError(f"engine: expected one of {', '.join(ENGINES)}; found {engine!r}")


def roll_out(
    engine: Engine,
    drive: Callable[[Any, jax.Array, Any, Sense], tuple[Any, jax.Array]],
    flow: Callable[[jax.Array, Any], Water],
    record: Callable[[Any, jax.Array, jax.Array], Any],
    state: Any,
    drive_state: Any,
    inputs: Any,
    *,
    records: int,
    every: int,
    timestep: float,
    mode: str = "plain",
) -> tuple[Any, Any]:
    """Steps a chunk of a population and records it now and then.

    Args:
        engine: what steps it.
        drive: (controller state, time [s], inputs of this step, what the robot senses) →
            (controller state, ctrl `[nu, lanes]` in the engine's order).
        flow: (time [s], inputs of this step) → the water.
        record: (state, ctrl, energy since the last record `[lanes]` [J]) → what to keep.
        state: from `engine.init`.
        drive_state: initial controller state.
        inputs: None, or arrays `[records * every, ...]`, one row for each step.
        records: how many records.
        every: steps between them.
        timestep: [s].
        mode: how it is compiled. "plain"; "fused", for many steps of the population step (or
            another that is element-wise); "derived", to be differentiated: each step is computed
            again on the way back, so that memory grows with the state and not with its working.

    Returns:
        The last state, and the records, `[records, ...]` each.
    """

    def step(carry: Any, now: Any) -> tuple[Any, jax.Array]:
        state, drive_state, energy, count = carry
        # The step counter travels as an integer, so that time is exact however long the run.
        time = count.astype(energy.dtype) * timestep
        drive_state, ctrl = drive(drive_state, time, now, engine.sense(state))
        state, power = engine.step(state, ctrl, flow(time, now))
        return (state, drive_state, energy + timestep * power, count + 1), ctrl

    energy = jnp.zeros_like(engine.root(state)[0])
    carry = (state, drive_state, energy, jnp.zeros((), jnp.int32))
    first = None if inputs is None else jax.tree.map(lambda x: x[0], inputs)
    pack = unpack = lambda x: x
    if mode == "fused":
        step, pack, unpack = fused_scan(step, carry, first)
    else:
        step = share_once(step)
        if mode == "derived":
            step = jax.checkpoint(step, prevent_cse=False)

    def block(packed: Any, rows: Any) -> tuple[Any, Any]:
        state, drive_state, energy, count = unpack(packed)
        start = pack((state, drive_state, jnp.zeros_like(energy), count))
        if every == 1:
            row = None if rows is None else jax.tree.map(lambda x: x[0], rows)
            packed, ctrl = step(start, row)
        else:
            packed, ctrls = jax.lax.scan(step, start, rows, length=every)
            ctrl = jax.tree.map(lambda x: x[-1], ctrls)
        state, _, energy, _ = unpack(packed)
        return packed, record(state, ctrl, energy)

    if inputs is not None:
        inputs = jax.tree.map(lambda x: x.reshape(records, every, *x.shape[1:]), inputs)
    packed, kept = jax.lax.scan(block, pack(carry), inputs, length=records)
    return unpack(packed)[0], kept


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


def flow_at(world: World, water: Water) -> Callable[[jax.Array, Any], Water]:
    """The water at each moment of a rollout whose surface and current do not change.

    Args:
        world: the world.
        water: at the start; where there are waves, its time is when the rollout begins.

    Returns:
        What `roll_out` takes as `flow`.
    """
    if not world.waves:
        return lambda time, row: water
    return lambda time, row: water._replace(time=water.time + time)


@lru_cache(maxsize=64)
def _compiled(
    robot: Robot, engine: str, steps: int, controller: Controller | None, still: bool
) -> Any:
    """The jitted rollout of one robot; cached, so that a second call compiles nothing.

    `still` leaves the water's surface and current to the world, as constants that fold away.
    """
    simulator = make_engine(robot, engine)
    dt = robot.world.timestep

    def run(
        qpos: Any, qvel: Any, drive_input: Any, water: Water | None, mode: str = "plain"
    ) -> Trajectory:
        parameters, drive_state, targets = None, (), None
        if controller is None:
            targets = drive_input[:, simulator.order, None]
            drive = lambda s, time, row, sense: (s, row[0])  # noqa: E731
        else:
            parameters = controller.decode(drive_input[:, None], simulator.order)
            drive_state = controller.init(parameters)
            drive = lambda s, time, row, sense: controller.step(  # noqa: E731
                parameters, s, time, sense
            )
        moving = None if still else water
        if moving is None:
            flow = flow_at(robot.world, water_of(robot.world))
        else:
            moving = jax.tree.map(lambda x: jnp.broadcast_to(x, (steps,))[:, None], moving)
            flow = lambda time, row: flow_at(robot.world, row[1])(time, None)  # noqa: E731
        keep = lambda state, ctrl, energy: (state, ctrl, energy)  # noqa: E731
        _, (states, ctrl, energy) = roll_out(
            simulator,
            drive,
            flow,
            keep,
            simulator.init(qpos[:, None], qvel[:, None]),
            drive_state,
            (targets, moving),
            records=steps,
            every=1,
            timestep=dt,
            mode=mode,
        )
        qs, vs = jax.vmap(simulator.observe)(states)
        back = np.argsort(simulator.order)
        return Trajectory(
            time=dt * jnp.arange(1, steps + 1, dtype=qs.dtype),
            qpos=qs[..., 0],
            qvel=vs[..., 0],
            xpos=body_positions(robot, qs[..., 0]),
            ctrl=ctrl[..., 0][:, back],
            power=energy[..., 0] / dt,
            command=jax.vmap(simulator.command)(states)[..., 0],
        )

    mode = "fused" if engine == "population" else "plain"
    jitted = jax.jit(partial(run, mode=mode), compiler_options=compiler_options())
    return jitted, partial(run, mode="derived")


def gusty_water(world: World, path: jax.Array, water: Water | None = None) -> Water:
    """The water along a path of gusts.

    Args:
        world: whose gusts they are.
        path: `[steps + 1, 3, ...]` from `water.gust_path` [m/s], around the world's current.
        water: what else differs from the world; its current is that around which the gusts blow.

    Returns:
        Water whose current and acceleration are `[steps, ...]`.
    """
    base = water_of(world) if water is None else water
    current = tuple(c + path[:-1, i] for i, c in enumerate(base.current))
    change = jnp.diff(path, axis=0) / world.timestep
    return base._replace(current=current, acceleration=tuple(change[:, i] for i in range(3)))


def simulate(
    robot: Robot,
    ctrl: Any = None,
    duration: float | None = None,
    *,
    qpos: Any = None,
    qvel: Any = None,
    key: jax.Array | None = None,
    water: Water | None = None,
    engine: str = "population",
) -> Trajectory:
    """Simulates one robot.

    Args:
        robot: from `build_robot`.
        ctrl: joint targets [rad]: None (all 0), `[nu]` (held), `[T, nu]` (a row for each step), a
            `BoundController` (see `controllers.bind_genes`), or a function of time [s] that
            returns `[nu]` and that JAX can trace. Thrusters take commands within their range.
        duration: [s]; by default as long as `ctrl` has rows, else 5.
        qpos: `[nq]` start; by default the rest pose 1 m below the surface. Root position, world
            frame [m], quaternion (w, x, y, z), hinges [rad].
        qvel: `[nv]` start, by default at rest; root velocity, world frame [m/s], root angular
            velocity, body frame [rad/s], hinges [rad/s].
        key: if given, the default start pose is turned at random about the vertical; it also draws
            the world's gusts (`jax.random.key(0)` by default).
        water: surface and current, by default the world's; each a number or `[T]`, a row for each
            step. It replaces the world's gusts.
        engine: "population" or "mjx".

    Returns:
        The trajectory, one row after each step. Differentiable in qpos, qvel, ctrl and water.

    Raises:
        InputError: a shape or a number is wrong.
    """
    model, dt = robot.mj_model, robot.world.timestep
    controller: Controller | None = None
    rows: Any = None
    if isinstance(ctrl, BoundController):
        controller, drive_input = ctrl.controller, _array("genes", ctrl.genes, (-1,))
        if drive_input.shape[0] != controller.num_genes:
            raise InputError(
                f"genes: expected {controller.num_genes} numbers; found {drive_input.shape[0]}"
            )
    elif ctrl is not None and not callable(ctrl):
        rows = _array("ctrl", ctrl, None)
        if rows.ndim not in (1, 2) or rows.shape[-1] != model.nu:
            raise InputError(
                f"ctrl: expected [{model.nu}] or [T, {model.nu}]; found {list(rows.shape)}"
            )
    steps = _steps(rows, duration, dt)
    if controller is None:
        if ctrl is None:
            rows = jnp.zeros(model.nu)
        elif callable(ctrl):
            rows = jax.vmap(lambda t: jnp.asarray(ctrl(t)))(dt * jnp.arange(steps))
        if rows.shape[-1] != model.nu:
            raise InputError(f"ctrl: expected {model.nu} targets; found {rows.shape[-1]}")
        drive_input = jnp.broadcast_to(rows, (steps, model.nu))
    if qpos is None:
        qpos = robot.start_qpos()
        if key is not None:
            half = jax.random.uniform(key, (), minval=-np.pi, maxval=np.pi) / 2
            turned = jnp.stack([jnp.cos(half), 0 * half, 0 * half, jnp.sin(half)])
            qpos = jnp.asarray(qpos).at[3:7].set(turned)
    qpos = _array("qpos", qpos, (model.nq,))
    qvel = jnp.zeros(model.nv) if qvel is None else _array("qvel", qvel, (model.nv,))
    if water is None and robot.world.gust is not None:
        gust_key = jax.random.fold_in(jax.random.key(0) if key is None else key, 1)
        path = gust_path(robot.world.gust, gust_key, steps, dt, 1)[..., 0]
        water = gusty_water(robot.world, path)
    if water is not None:
        water = jax.tree.map(lambda x: _array("water", x, None), water)
        for leaf in jax.tree.leaves(water):
            if leaf.ndim > 1 or (leaf.ndim == 1 and leaf.shape[0] not in (1, steps)):
                raise InputError(f"water: expected numbers or [{steps}]; found {list(leaf.shape)}")
    jitted, plain = _compiled(robot, engine, steps, controller, water is None)
    traced = any(
        isinstance(x, jax.core.Tracer) for x in jax.tree.leaves((qpos, qvel, drive_input, water))
    )
    return (plain if traced else jitted)(qpos, qvel, drive_input, water)


def _steps(rows: Any, duration: float | None, dt: float) -> int:
    if duration is not None and (
        isinstance(duration, bool)
        or not isinstance(duration, int | float | np.number)
        or not np.isfinite(duration)
        or duration <= 0
    ):
        raise InputError(f"duration: expected seconds > 0; found {duration!r}")
    if rows is not None and rows.ndim == 2:
        steps = rows.shape[0]
        if duration is not None and abs(duration - steps * dt) > dt:
            raise InputError(
                f"duration: expected {steps * dt:g} s, as ctrl has {steps} rows of {dt:g} s; "
                f"found {duration:g}"
            )
        return steps
    return max(1, round((5.0 if duration is None else duration) / dt))


def _array(place: str, value: Any, shape: tuple[int, ...] | None) -> jax.Array:
    try:
        array = jnp.asarray(value, dtype=jnp.result_type(float))
    except (TypeError, ValueError):
        raise InputError(f"{place}: expected numbers; found {value!r}") from None
    if shape is not None and (
        array.ndim != len(shape)
        or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True))
    ):
        raise InputError(f"{place}: expected shape {list(shape)}; found {list(array.shape)}")
    if not isinstance(array, jax.core.Tracer) and not bool(jnp.all(jnp.isfinite(array))):
        raise InputError(f"{place}: expected finite numbers; found NaN or infinity")
    return array
