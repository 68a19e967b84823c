"""What a robot was told of its sensors along an episode, in their units, and what was true."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.sensors import Sensor
from mjx_revolve.control.sense import feel, remember, start_memory
from mjx_revolve.control.sensors import Observation, Observer
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.episodes.evaluation import vary_engine
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.rollout import flow_at
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.numerics.xla import hasty_options
from mjx_revolve.water.flow import water_of


class Felt(NamedTuple):
    """One sensor over time.

    Attributes:
        sensor: as it is declared.
        rows: names of the rigid bodies or hinges that it speaks of, "" for the robot as a whole.
        told: `[T, parts, rows]` what the brain was told before each step, in the sensor's unit.
        true: `[T, parts, rows]` what was so at that time; infinite where there is nothing to feel,
            as without a bed.
    """

    sensor: Sensor
    rows: tuple[str, ...]
    told: np.ndarray
    true: np.ndarray

    @property
    def is_exact(self) -> bool:
        """Whether what is told is true, but for the range."""
        own = self.sensor
        return own.noise == 0 and own.rate is None and own.delay == 0


def feel_episode(
    fitness: Fitness, trajectory: Trajectory, key: jax.Array, trial: int = 0
) -> tuple[Felt, ...]:
    """What a robot was told in an episode, by the observer that its brain has.

    Args:
        fitness: of one body.
        trajectory: of its `replay`, or its first rows, finite ones.
        key: as there.
        trial: as there.

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
        jax.tree.map(lambda x: np.broadcast_to(np.asarray(x), _long(x, steps))[:steps], water),
    )
    found = _watcher(fitness, steps)(
        jax.tree.map(lambda x: jnp.asarray(x, start.dtype), rows),
        jax.tree.map(lambda x: jnp.asarray(x)[..., None], fitness.cues(key, trial)),
        fitness.variation(key, trial),
    )
    told, true = jax.tree.map(np.asarray, found)
    plant = fitness.engine.plant
    order = np.argsort(np.asarray(plant.source)[: plant.num_hinge_rows, 0])
    hinges = plant.names[: plant.num_hinges]
    core = robot.morphology.modules[0].name
    felt = []
    for sensor, a, b in zip(
        observer.sensors,
        _split(observer, told, order, steps),
        _split(observer, true, order, steps),
        strict=True,
    ):
        names: tuple[str, ...] = ("",)
        if sensor.where != "robot":
            names = hinges if sensor.where == "joint" else (core, *hinges)
        if sensor.each is not None:
            there = np.asarray(plant.site(sensor.place).there)[:, 0]
            kept = np.flatnonzero(np.concatenate([there[:1], there[1:][order]]))
            names, a, b = tuple(names[k] for k in kept), a[..., kept], b[..., kept]
        zero, scale = sensor.scaling
        if names:
            felt.append(Felt(sensor, names, a / scale + zero, b))
    return tuple(felt)


def _long(x: Any, steps: int) -> tuple[int, ...]:
    """The shape of a number or `[T]` as rows of an episode, at least as many as there are."""
    return (max(np.size(x), steps),)


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


def _plain(sensors: Sequence[Sensor], sense: Any) -> tuple[tuple[Any, ...], tuple[Any, ...]]:
    """What is true, as an `Observation` has its numbers, in the sensors' units."""
    robot: list[Any] = []
    joint: list[Any] = []
    for sensor in sensors:
        source = sense.places[sensor.place] if sensor.place else sense
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
def _watcher(fitness: Fitness, steps: int) -> Any:
    """Rows of an episode → what was told and what was true, `[T, ...]` each."""
    observer, world = fitness.controller.observer, fitness.robot.world
    dt = world.timestep
    assert observer is not None

    def run(rows: Any, cues: Any, variation: Any) -> Any:
        engine = vary_engine(fitness.engine, variation)
        qpos, qvel, ctrl, power, water = rows
        number = jnp.asarray(engine.plant.source[: engine.plant.num_hinge_rows])
        at = lambda k: engine.init(qpos[k][:, None], qvel[k][:, None])  # noqa: E731

        def step(carry: Any, k: jax.Array) -> Any:
            memory, seen = carry
            state, after = at(k), at(k + 1)
            time = k.astype(qpos.dtype) * dt
            now = flow_at(world, jax.tree.map(lambda x: x[k][None], water))(time, None)
            motion = engine.motions(state) if memory.past is not None else None
            sense = feel(
                world, engine, state, now, time, cues, memory, observer.feels, motion=motion
            )
            seen, told = observer.observe(seen, time, sense, number)
            asked = engine.plant.arrange(ctrl[k][:, None])
            memory = remember(
                memory, engine.root(state), engine.root(after), asked, dt * power[k][None], dt,
                motion,
            )  # fmt: skip
            return (memory, seen), (told, Observation(*_plain(observer.sensors, sense)))

        state = at(0)
        memory = start_memory(observer.feels, engine, state)
        carry = memory, observer.init(engine.joints(state)[0])
        return jax.lax.scan(step, carry, jnp.arange(steps))[1]

    hasty = fitness.config.engine == "population"
    return jax.jit(run, compiler_options=hasty_options() if hasty else None)
