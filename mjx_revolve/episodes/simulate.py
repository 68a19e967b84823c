"""One robot, simulated: `simulate` and the trajectory that it returns."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from mjx_revolve.control.controller import BoundController, Controller
from mjx_revolve.control.readings import EpisodeContext
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.kinematics import body_poses
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.rollout import (
    Policy,
    Rollout,
    RolloutState,
    StepInputs,
    controlled,
    open_loop,
    with_variation,
)
from mjx_revolve.episodes.starts import check_key, draw_gusts, gusty_water, noise_key, target_path
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.inputs.short_repr import short_repr
from mjx_revolve.numerics.xla import is_traced, jit
from mjx_revolve.water.flow import Water, water_of


@jax.tree_util.register_dataclass
@dataclass(frozen=True, repr=False)
class Trajectory:
    """Motion of one robot, one row after each step.

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
        surface_height: `[T]` z of the still surface, world frame [m]; None for the world's.
        target: `[T, 3]` where the target was, world frame [m]; None without one.
        variation: factors on coefficients of water and motors, a number each; None for none.
    """

    time: jax.Array
    qpos: jax.Array
    qvel: jax.Array
    xpos: jax.Array
    ctrl: jax.Array
    power: jax.Array
    command: jax.Array | None = None
    surface_height: jax.Array | None = None
    target: jax.Array | None = None
    variation: Variation | None = None

    __repr__ = short_repr


@lru_cache(maxsize=64)
def _compiled(
    robot: Robot, engine: str, steps: int, controller: Controller | None, still: bool, once: bool
) -> Any:
    """The jitted rollout of one robot; cached, so that a second call compiles nothing.

    `still` leaves the water's surface and current to the world, as constants that fold away.
    """
    unvaried = make_engine(robot, engine)
    dt = robot.world.timestep
    # MuJoCo's actuators in the robot's own order, and where each stands among the engine's rows.
    own = actuators_of(robot)
    back = np.argsort(own[unvaried.plant.source[:, 0]]).astype(np.int32)

    def run(
        qpos: jax.Array,
        qvel: jax.Array,
        drive_input: PyTree,
        water: Water | None,
        context: EpisodeContext,
        variation: Variation | None,
        differentiable: bool = False,
    ) -> Trajectory:
        simulator = with_variation(unvaried, variation)
        context = jax.tree.map(lambda x: x[None], context)
        policy: Policy = open_loop
        controller_state, targets = (), None
        if controller is None:
            targets = jax.vmap(simulator.plant.arrange)(drive_input[:, own, None])
        else:
            parameters = controller.decode(drive_input[:, None], simulator.plant)
            policy = controlled(controller, parameters)
            controller_state = controller.init(parameters)
        wide = lambda x: jnp.broadcast_to(x, (steps,))[:, None]  # noqa: E731
        moving: Water | None = None if still else jax.tree.map(wide, water)
        signals = () if controller is None else controller.signals
        rollout = Rollout(simulator, policy, robot.world, water_of(robot.world), context, signals)

        def record(now: RolloutState, ctrl: jax.Array, water: Water) -> PyTree:
            return now.state, ctrl, now.energy, now.memory.pursuer

        now = rollout.init(simulator.init(qpos[:, None], qvel[:, None]), controller_state)
        inputs = StepInputs(moving, targets)
        _, rows = rollout.advance(now, record, steps, 1, inputs, differentiable)
        states, ctrl, energy, pursuer = rows
        time = dt * jnp.arange(1, steps + 1, dtype=energy.dtype)
        target = None if pursuer is None else jnp.stack(pursuer.position, 1)
        if target is None and context.target is not None:
            target = target_path(context, time)
        qs, vs = jax.vmap(simulator.observe)(states)
        return Trajectory(
            time=time,
            qpos=qs[..., 0],
            qvel=vs[..., 0],
            xpos=body_poses(robot, qs[..., 0])[0],
            ctrl=ctrl[..., 0][:, back],
            power=energy[..., 0] / dt,
            command=jax.vmap(simulator.thruster_command)(states)[..., 0],
            surface_height=None if moving is None else moving.surface_height[:, 0],
            target=None if target is None else target[..., 0],
        )

    return jit(run, fast=once and engine == "population"), partial(run, differentiable=True)


def simulate(
    robot: Robot,
    ctrl: ArrayLike | BoundController | Callable[[jax.Array], ArrayLike] | None = None,
    duration: float | None = None,
    *,
    qpos: ArrayLike | None = None,
    qvel: ArrayLike | None = None,
    key: jax.Array | None = None,
    water: Water | None = None,
    engine: str = "population",
    once: bool = False,
    context: EpisodeContext | None = None,
    variation: Variation | None = None,
) -> Trajectory:
    """Simulates one robot.

    Args:
        robot: from `build_robot`.
        ctrl: joint targets [rad]: None (all 0), `[nu]` (held), `[T, nu]` (a row for each step), a
            `BoundController` (see `controller.bind_genes`), or a function of time [s] that
            returns `[nu]` and that JAX can trace. Thrusters take commands within their range.
        duration: [s]; by default as long as `ctrl` has rows, else 5.
        qpos: `[nq]` start; by default the rest pose 1 m below the world's still surface, whatever
            that of `water`. Root position, world frame [m], quaternion (w, x, y, z), hinges [rad].
        qvel: `[nv]` start, by default at rest; root velocity, world frame [m/s], root angular
            velocity, body frame [rad/s], hinges [rad/s].
        key: if given, the default start pose is turned at random about the vertical; it also draws
            the world's gusts (`jax.random.key(0)` by default).
        water: surface and current, by default the world's; each a number or `[T]`, a row for each
            step. It replaces the world's gusts. A number for the waves' time is that at the start.
            Where the current changes, give its acceleration, too: without it, none pushes bodies.
        engine: "population" or "mjx".
        once: compile quickly into a slower program; faster in all for a minute or less.
        context: of the sensors, a number each; by default no target, and noise that `key` draws.
        variation: factors on coefficients of water and motors, a number each; by default none.

    Returns:
        The trajectory, one row after each step. Differentiable in qpos, qvel, ctrl,
        water and variation.

    Raises:
        InputError: a shape or a number is wrong.
    """
    if not isinstance(robot, Robot):
        raise InputError("robot", "what `build_robot` returns", type(robot).__name__)
    if isinstance(ctrl, Controller):
        raise InputError("ctrl", "a controller with its genes, of `bind_genes`", "one without")
    robot = robot.as_edited()
    model, dt = robot.mj_model, robot.world.timestep
    if key is not None:
        check_key(key)
    controller: Controller | None = None
    rows: Any = None
    if isinstance(ctrl, BoundController):
        controller, drive_input = ctrl.controller, _array("genes", ctrl.genes, (-1,))
        if drive_input.shape[0] != controller.num_genes:
            raise InputError("genes", f"{controller.num_genes} numbers", drive_input.shape[0])
        # Programs are kept by their controller, and users may have given it lists.
        named = ("gene_names", "genes", "signals")
        controller = controller._replace(**{x: tuple(getattr(controller, x)) for x in named})
    elif ctrl is not None and not callable(ctrl):
        rows = _array("ctrl", ctrl, None)
        if rows.ndim not in (1, 2) or rows.shape[-1] != model.nu or rows.shape[0] == 0 < model.nu:
            raise InputError("ctrl", f"[{model.nu}] or [T, {model.nu}]", list(rows.shape))
    steps = _steps(rows, duration, dt)
    if controller is None:
        if ctrl is None:
            rows = jnp.zeros(model.nu)
        elif callable(ctrl):
            rows = jax.vmap(lambda t: jnp.asarray(ctrl(t)))(dt * jnp.arange(steps))
            if rows.shape[1:] != (model.nu,):
                found = rows.shape[-1] if rows.ndim == 2 else list(rows.shape[1:])
                raise InputError("ctrl", f"{model.nu} targets", found)
            rows = _array("ctrl", rows, None)
        drive_input = jnp.broadcast_to(rows, (steps, model.nu))
    if qpos is None:
        qpos = robot.start_qpos()
        if key is not None:
            half = jax.random.uniform(key, (), minval=-np.pi, maxval=np.pi) / 2
            turned = jnp.stack([jnp.cos(half), 0 * half, 0 * half, jnp.sin(half)])
            qpos = jnp.asarray(qpos).at[3:7].set(turned)
    qpos = _array("qpos", qpos, (model.nq,))
    if not is_traced(qpos) and not np.any(qpos[3:7]):
        zeros = "zeros ([1, 0, 0, 0] for the rest pose)"
        raise InputError("qpos[3:7]", "a quaternion (w, x, y, z) of any length but 0", zeros)
    qvel = jnp.zeros(model.nv) if qvel is None else _array("qvel", qvel, (model.nv,))
    if water is None and robot.world.gust is not None:
        path = draw_gusts(robot.world, jax.random.key(0) if key is None else key, steps, 1)
        water = gusty_water(robot.world, path[..., 0])
    if water is not None:
        vectors = () if not isinstance(water, Water) else (water.current, water.acceleration)
        if [isinstance(x, tuple | list) and len(x) for x in vectors] != [3, 3]:
            expected = "a Water with three numbers in current and in acceleration"
            raise InputError("water", expected, show(vectors or water))
        water = jax.tree.map(lambda x: _array("water", x, None), water)
        for leaf in jax.tree.leaves(water):
            if leaf.ndim > 1 or (leaf.ndim == 1 and leaf.shape[0] not in (1, steps)):
                raise InputError("water", f"numbers or [{steps}]", list(leaf.shape))
        if water.time.shape == (steps,):  # the rollout adds the time since its start
            water = water._replace(time=water.time - dt * jnp.arange(steps))
    context = EpisodeContext() if context is None else context
    if context.noise is None:
        noise = noise_key(jax.random.key(0) if key is None else key)
        context = context._replace(noise=jax.random.bits(noise, (), "uint32"))
    context = jax.tree.map(jnp.asarray, context)
    context = context._replace(noise=jnp.asarray(context.noise).astype(jnp.uint32))
    if variation is not None:
        if engine != "population":
            raise InputError("variation", f"none, as engine is {engine}", "some")
        variation = Variation(*(_array("variation", x, ()) for x in variation))
    jitted, plain = _compiled(robot, engine, steps, controller, water is None, once)
    given = qpos, qvel, drive_input, water, context, variation
    return replace((plain if is_traced(given) else jitted)(*given), variation=variation)


def _steps(rows: Any, duration: float | None, dt: float) -> int:
    real = isinstance(duration, int | float | np.number) and not isinstance(duration, bool)
    if duration is not None and not (real and 0 < duration < np.inf):
        raise InputError("duration", "seconds > 0", repr(duration))
    if rows is not None and rows.ndim == 2:
        steps = rows.shape[0]
        if duration is not None and abs(duration - steps * dt) > dt:
            same = f"{steps * dt:g} s, as ctrl has {steps} rows of {dt:g} s"
            raise InputError("duration", same, f"{duration:g}")
        return steps
    return max(1, round((5.0 if duration is None else duration) / dt))


def _array(place: str, value: ArrayLike, shape: tuple[int, ...] | None) -> jax.Array:
    try:
        array = jnp.asarray(value, dtype=jnp.result_type(float))
    except (TypeError, ValueError):
        raise InputError(place, "numbers", repr(value)) from None
    if shape is not None and (
        array.ndim != len(shape)
        or any(n not in (-1, m) for n, m in zip(shape, array.shape, strict=True))
    ):
        raise InputError(place, f"shape {list(shape)}", list(array.shape))
    if not is_traced(array) and not bool(jnp.all(jnp.isfinite(array))):
        raise InputError(place, "finite numbers", "NaN or infinity")
    return array
