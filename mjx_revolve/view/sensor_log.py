"""Sensor traces: outputs of the sensors along an episode, in their units, and the true values."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.readings import EpisodeContext, SensorReadings
from mjx_revolve.control.sensors import Observation, Observer, count_samples
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.engine.state import State
from mjx_revolve.engine.variation import Variation
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.rollout import Rollout, RolloutState, StepInputs, with_variation
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.numerics.xla import jit
from mjx_revolve.water.flow import water_of

# The fields of a state that a trajectory has.
_POSE = ("position", "quat", "velocity", "angular_velocity", "angle", "speed")


class SensorTrace(NamedTuple):
    """One sensor over time.

    Attributes:
        sensor: as it is declared.
        rows: names of the rigid bodies or hinges that it measures; "" for the robot as a whole.
        given: `[T, parts, rows]` input of the controller before each step, in the sensor's unit.
        true: `[T, parts, rows]` true value at that time; infinite if there is none, as without a
            bed.
        rate: of the values given: the sensor's own, or that of the controller's commands, between
            which they are held; None: new ones in each step [Hz].
    """

    sensor: Sensor
    rows: tuple[str, ...]
    given: np.ndarray
    true: np.ndarray
    rate: float | None

    @property
    def is_exact(self) -> bool:
        """Whether the values given are the true ones, but for the range."""
        own = self.sensor
        return own.noise == 0 and self.rate is None and own.delay == 0


def trace_sensors(
    fitness: Fitness, trajectory: Trajectory, key: jax.Array, trial: int = 0
) -> tuple[SensorTrace, ...]:
    """The inputs of a controller in an episode, by its own observer.

    Args:
        fitness: of one body.
        trajectory: of its `replay`, or its first rows, finite ones.
        key: as of the `replay`.
        trial: as of the `replay`.

    Returns:
        The sensors in their order, as far as the robot has any such hinges or modules; none where
        the controller takes no declared ones.
    """
    observer = fitness.controller.observer
    if observer is None:
        return ()
    steps, robot = len(trajectory.time), fitness.robot
    start = np.asarray(fitness.starts(key)[0])[:, trial]
    given = fitness.water(key, trial)
    water = water_of(robot.world) if given is None else given
    rows = (
        np.concatenate([start[None], trajectory.qpos]),
        np.concatenate([np.zeros_like(trajectory.qvel[:1]), trajectory.qvel]),
        np.asarray(trajectory.ctrl)[:, actuators_of(robot)],
        np.asarray(trajectory.power),
        # A number, or a row for each step of the whole episode.
        jax.tree.map(lambda x: np.broadcast_to(x, (max(np.size(x), steps),))[:steps], water),
    )
    found = _compiled(fitness, steps)(
        jax.tree.map(lambda x: jnp.asarray(x, start.dtype), rows),
        jax.tree.map(lambda x: jnp.asarray(x)[..., None], fitness.context(key, trial)),
        trajectory.variation,
    )
    given, true = jax.tree.map(np.asarray, found)
    if fitness.controller.rate is not None:  # the brain has what there was at its last command
        count = count_samples(robot.world.timestep * np.arange(steps), fitness.controller.rate)
        acted = np.searchsorted(count, count)
        given = jax.tree.map(lambda x: x[acted], given)
    plant = fitness.engine.plant
    order = np.argsort(np.asarray(plant.source)[: plant.num_hinge_rows, 0])
    hinges = plant.names[: plant.num_hinges]
    core = robot.morphology.modules[0].name
    traces = []
    both = (_split(observer, found, order, steps) for found in (given, true))
    for sensor, a, b in zip(observer.sensors, *both, strict=True):
        names: tuple[str, ...] = ("",)
        if sensor.where != "robot":
            names = hinges if sensor.where == "joint" else (core, *hinges)
        if sensor.each is not None:
            there = np.asarray(plant.site(sensor.place).there)[:, 0]
            kept = np.flatnonzero(np.concatenate([there[:1], there[1:][order]]))
            names, a, b = tuple(names[k] for k in kept), a[..., kept], b[..., kept]
        zero, scale = sensor.scaling
        if names:
            rate = sensor.rate or fitness.controller.rate
            traces.append(SensorTrace(sensor, names, a / scale + zero, b, rate))
    return tuple(traces)


def _split(
    observer: Observer, found: Observation, order: np.ndarray, steps: int
) -> Iterator[np.ndarray]:
    """`[T, parts, rows]` of sensor after sensor, hinges in the robot's order."""
    robot, joint = iter(found.robot), iter(found.joint)
    for sensor in observer.sensors:
        count = len(sensor.kind.parts)
        columns = [np.zeros((steps, count, 0))]
        if sensor.where != "joint":
            columns.append(np.stack([next(robot) for _ in range(count)], 1))
        if sensor.where != "robot" and len(order):
            columns.append(np.stack([next(joint)[:, order, 0] for _ in range(count)], 1))
        yield np.concatenate([np.reshape(x, (*x.shape[:2], -1)) for x in columns], 2)


def _plain(
    sensors: Sequence[Sensor], sense: SensorReadings
) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """What is true, as an `Observation` has its numbers, in the sensors' units."""
    robot: list[Any] = []
    joint: list[Any] = []
    for sensor in sensors:
        source = sense.modules[sensor.place] if sensor.place else sense
        for value in sensor.kind.signal(source):
            if sensor.where == "robot":
                robot.append(value)
            elif sensor.where == "joint":
                joint.append(value)
            else:
                robot.append(value[0])
                joint.append(value[1:])
    return tuple(robot), tuple(joint)


@lru_cache(maxsize=4)
def _compiled(fitness: Fitness, steps: int) -> Any:
    """Rows of an episode → what the observer gave and what was true, `[T, ...]` each."""
    observer, rate = fitness.controller.observer, fitness.controller.rate
    assert observer is not None

    def run(rows: PyTree, context: EpisodeContext, variation: Variation | None) -> PyTree:
        engine = with_variation(fitness.engine, variation)
        qpos, qvel, ctrl, power, water = rows
        number = jnp.asarray(engine.plant.source[: engine.plant.num_hinge_rows])
        state_at = lambda k: engine.init(qpos[k][:, None], qvel[k][:, None])  # noqa: E731

        def policy(
            state: PyTree, time: jax.Array, readings: SensorReadings, ctrl: PyTree
        ) -> PyTree:
            if rate is not None:
                time = count_samples(time, rate) / rate
            seen, observed = observer.observe(state[0], time, readings, number)
            return (seen, observed, Observation(*_plain(observer.sensors, readings))), ctrl

        rollout = Rollout(
            engine, policy, fitness.world, water_of(fitness.world), context, observer.signals
        )

        def step(now: RolloutState, k: jax.Array) -> PyTree:
            own = jax.tree.map(lambda x: x[k][None], water)
            inputs = StepInputs(own, engine.plant.arrange(ctrl[k][:, None]))
            (seen, *found), command, around, motion = rollout.act(now, inputs)
            state = state_at(k + 1)
            if isinstance(now.state, State) and len(now.state.pressed):
                # Forces of the robot's own modules on each other do not follow from its pose.
                rest = engine.step(now.state, command, around)[0]._asdict()
                pose = {key: value for key, value in state._asdict().items() if key in _POSE}
                state = State(**rest | pose)
            then = rollout.update(now, state, power[k][None], (seen,), command, motion)
            return then, found

        state = state_at(0)
        now = rollout.init(state, (observer.init(engine.joints(state)[0]),))
        return jax.lax.scan(step, now, jnp.arange(steps))[1]

    return jit(run, fast=fitness.config.engine == "population")
