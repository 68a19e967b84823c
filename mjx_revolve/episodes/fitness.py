"""Fitness: genes of a whole population to scores, as one pure JAX function.

`make_fitness` builds the robot, the controller and the task of a configuration once; what it
returns is a function of (population, key) that any optimiser can call, and that runs under jit,
vmap and grad.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.body.catalogue import MODULES, load_modules
from mjx_revolve.body.morphology import load_morphology, trim_neutral
from mjx_revolve.control.controllers import Controller, bind_genes, find_controller
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.engine.step import Engine
from mjx_revolve.episodes.config import Config, TaskConfig, load_config, make_config
from mjx_revolve.episodes.rollout import (
    Trajectory,
    flow_at,
    gusty_water,
    make_engine,
    roll_out,
    simulate,
)
from mjx_revolve.episodes.scoring import (
    WORST,
    Scores,
    average_trials,
    list_episodes,
    sample_rows,
    score_episodes,
)
from mjx_revolve.episodes.tasks import Track, find_task
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import compiler_options, derived_by, over_chunks
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.flow import Water, gust_path, water_of
from mjx_revolve.water.world import World, load_world

# Nothing made of these modules swims or sinks this fast: servos, drag and weight allow a tenth of
# it. An individual that gets further than this allows has blown up [m/s].
_FASTEST = 3.0

# How long a sea is before it begins again, as episodes see it [s].
_SEA = 1000.0


@dataclass(frozen=True, eq=False)
class Fitness:
    """Scores of a population: `fitness(population, key)`.

    Attributes:
        config: what it was made from.
        robot: the compiled robot.
        controller: genes to joint targets.
        engine: what steps the robot.
    """

    config: Config
    robot: Robot
    controller: Controller
    engine: Engine

    @property
    def num_genes(self) -> int:
        """Length of an individual's genes."""
        return self.controller.num_genes

    @cached_property
    def task(self) -> Callable[[Track, TaskConfig], jax.Array]:
        """What scores an episode: (track, settings) → `[lanes]`."""
        return find_task(self.config.task, self.config.source)

    @property
    def worst_score(self) -> float:
        """The score of a rollout that blew up."""
        return WORST

    def __call__(self, population: Any, key: jax.Array) -> jax.Array:
        """Scores a population.

        Args:
            population: `[P, num_genes]`.
            key: draws the episodes' start poses and water, the same for every individual.

        Returns:
            `[P]` mean score over the episodes, higher is better; `WORST` where a rollout blew up.
        """
        return self.evaluate(population, key)[0]

    def evaluate(self, population: Any, key: jax.Array) -> tuple[jax.Array, dict[str, jax.Array]]:
        """Scores a population and says how it moved.

        Args:
            population: `[P, num_genes]`.
            key: as above.

        Returns:
            `[P]` scores and `[P]` measures (see `tasks.measure`), means over the episodes.

        Raises:
            InputError: the population has another shape, there are no genes to evolve, or the key
                is none.
        """
        shape = jnp.shape(population)
        if len(shape) != 2 or shape[1] != self.num_genes or shape[0] < 1:
            raise InputError(f"population: expected [P, {self.num_genes}]; found {list(shape)}")
        check_key(key)
        traced = any(isinstance(x, jax.core.Tracer) for x in (population, key))
        return (self._evaluate if traced else self._jitted)(jnp.asarray(population), key)

    @cached_property
    def _jitted(self) -> Any:
        # Compiler options belong to the outermost jit, so under somebody else's we go without.
        return jax.jit(self._evaluate, compiler_options=compiler_options())

    def replay(self, genes: Any, key: jax.Array, trial: int = 0) -> Trajectory:
        """One episode of one individual, in full.

        Args:
            genes: `[num_genes]`.
            key: as in `evaluate`.
            trial: which of the key's episodes.

        Returns:
            The trajectory.
        """
        return simulate(
            self.robot,
            bind_genes(self.controller, genes),
            self.num_records * self.record_every * self.robot.world.timestep,
            qpos=self.starts(key)[0][:, trial],
            water=self.water(key, trial),
            engine=self.config.engine,
        )

    def water(self, key: jax.Array, trial: int = 0) -> Water | None:
        """The water of one of a key's episodes, as `simulate` takes it; None: just the world's."""
        _, water = self.starts(key)
        gusts = self.gusts(key)
        if water is not None:
            water = jax.tree.map(lambda x: x[trial], water)
        if gusts is not None:
            water = gusty_water(self.robot.world, gusts[..., trial], water)
        return water

    @property
    def record_every(self) -> int:
        """Timesteps between the rows of the track that tasks see."""
        return sample_rows(self.config.task, self.robot.world.timestep)[0]

    @property
    def num_records(self) -> int:
        """How many rows the track of an episode has, before the settling time is cut off."""
        return sample_rows(self.config.task, self.robot.world.timestep)[1]

    def starts(self, key: jax.Array) -> tuple[jax.Array, Water | None]:
        """Start poses and water of a key's episodes.

        Args:
            key: draws them.

        Returns:
            `[nq, trials]` qpos, and the water `[trials]` where it varies, else None.
        """
        place, quat, water = draw_starts(self.config.task, self.robot.world, key, self._reach)
        rest = jnp.asarray(self.robot.qpos0, place.dtype)[7:, None]
        rest = jnp.broadcast_to(rest, (rest.shape[0], place.shape[1]))
        return jnp.concatenate([place, quat, rest]), water

    def gusts(self, key: jax.Array) -> jax.Array | None:
        """Gusts of a key's episodes.

        Args:
            key: draws them.

        Returns:
            `[steps + 1, 3, trials]` velocity around the episode's current [m/s], or None where the
            world has no gusts.
        """
        steps = self.num_records * self.record_every
        return draw_gusts(self.config.task, self.robot.world, key, steps)

    @cached_property
    def _reach(self) -> float:
        return reach_below(self.robot, self.config.task)

    def _evaluate(self, population: Any, key: jax.Array) -> Any:
        trials = self.config.task.trials
        qpos, water = self.starts(key)
        run = partial(
            self._episode, population, qpos.astype(population.dtype), water, self.gusts(key)
        )
        return average_trials(over_chunks(run)(*list_episodes(len(population), trials)), trials)

    def _episode(
        self,
        population: jax.Array,
        qpos: jax.Array,
        water: Water | None,
        gusts: Any,
        individual: jax.Array,
        trial: jax.Array,
    ) -> Scores:
        """Scores of one chunk of episodes.

        A chunk picks what is its own from what all chunks share, so that nothing is kept for each
        episode of a population but its scores.

        Args:
            population: `[P, num_genes]`.
            qpos: `[nq, trials]` start poses.
            water: `[trials]` where it varies.
            gusts: `[steps + 1, 3, trials]` or None.
            individual: `[lanes]` whose episode each is.
            trial: `[lanes]` which of that individual's.

        Returns:
            The scores.
        """
        world, controller = self.robot.world, self.controller
        parameters = controller.decode(population[individual].T, self.engine.order)
        qpos = qpos[:, trial]
        water = jax.tree.map(lambda x: x[trial], water)
        rows = None
        if gusts is not None:
            rows = gusty_water(world, gusts[..., trial], water)
            rows = jax.tree.map(
                lambda x: jnp.broadcast_to(x, (gusts.shape[0] - 1, qpos.shape[-1])), rows
            )

        def loop(qpos: Any, parameters: Any, water: Any, rows: Any, mode: str = "plain") -> Any:
            qvel = jnp.zeros((self.robot.mj_model.nv, qpos.shape[-1]), qpos.dtype)
            still = water_of(world) if water is None else water
            _, kept = roll_out(
                self.engine,
                lambda state, time, row, sense: controller.step(parameters, state, time, sense),
                lambda time, row: flow_at(world, still if row is None else row)(time, None),
                lambda state, ctrl, energy: (self.engine.root(state), energy),
                self.engine.init(qpos, qvel),
                controller.init(parameters),
                rows,
                records=self.num_records,
                every=self.record_every,
                timestep=world.timestep,
                mode=mode,
            )
            return kept

        if self.config.engine == "population":
            episode = derived_by(partial(loop, mode="fused"), partial(loop, mode="derived"))
        else:
            episode = loop
        place, energy = episode(qpos, parameters, water, rows)
        body = self.robot.morphology
        return score_episodes(
            self.config.task,
            self.task,
            world,
            jnp.stack(place, 1),
            energy,
            qpos[:3],
            body.length,
            body.mass * max(world.gravity, 1e-9),
            _reach(self.config, self.robot),
        )


def check_key(key: Any) -> None:
    """Refuses what `jax.random` would not draw from, such as a bare seed.

    Args:
        key: from `jax.random.key`, or one of the older arrays of uint32.

    Raises:
        InputError: it is something else.
    """
    dtype = getattr(key, "dtype", None)
    if dtype is None or not (jnp.issubdtype(dtype, jax.dtypes.prng_key) or dtype == jnp.uint32):
        raise InputError(f"key: expected jax.random.key(SEED); found {key!r}")


def draw_starts(
    task: TaskConfig, world: World, key: jax.Array, reach: Any
) -> tuple[jax.Array, jax.Array, Water | None]:
    """Start poses of the core, and water, of a key's episodes.

    Args:
        task: how starts vary.
        world: the world.
        key: draws them.
        reach: how far robots reach below their core (`reach_below`) [m]; a crawler starts above
            the bed by that.

    Returns:
        `[3, trials]` place [m], `[4, trials]` quaternion, and the water `[trials]` where it varies,
        else None.
    """
    trials = task.trials
    place_key, tilt_key, yaw_key, current_key = jax.random.split(key, 4)
    place = task.start_position * jax.random.normal(place_key, (3, trials))
    tilt = task.start_tilt * jax.random.normal(tilt_key, (2, trials))
    yaw = task.start_yaw * jax.random.normal(yaw_key, (trials,))
    if task.type == "crawl" and world.bed is not None:
        # The lowest corner of any module 5 mm above the bed, whatever the tilt.
        height = bed_height(world.bed, place[0], place[1]) + reach + 0.005
        place = place.at[2].set(height)
    else:
        place = place.at[2].add(world.surface_height - task.depth)
    quat = _euler_quat(tilt[0], tilt[1], yaw)
    if task.current_std == 0 and not world.waves:
        return place, quat, None
    extra = task.current_std * jax.random.normal(current_key, (2, trials))
    x, y, z = world.current
    full = jnp.full((trials,), 0.0, place.dtype)
    water = Water(full + world.surface_height, (x + extra[0], y + extra[1], full + z))
    if world.waves:
        # Episodes begin at any moment of the sea.
        time_key = jax.random.fold_in(key, 2)
        water = water._replace(time=jax.random.uniform(time_key, (trials,), maxval=_SEA))
    return place, quat, jax.tree.map(lambda x: jnp.broadcast_to(x, (trials,)), water)


def draw_gusts(task: TaskConfig, world: World, key: jax.Array, steps: int) -> jax.Array | None:
    """Gusts of a key's episodes: `[steps + 1, 3, trials]` [m/s], or None without gusts."""
    if world.gust is None:
        return None
    gust_key = jax.random.fold_in(key, 1)
    return gust_path(world.gust, gust_key, steps, world.timestep, task.trials)


def reach_below(robot: Robot, task: TaskConfig) -> float:
    """How far the rest pose reaches below the core's centre, in any attitude drawn [m]."""
    points = []
    for module in robot.morphology.modules:
        for part in module.kind.parts:
            low, high = part.bounds
            for corner in np.ndindex(2, 2, 2):
                local = np.asarray(part.position) + np.where(corner, high, low)
                points.append(module.position + module.rotation @ local)
    cloud = np.array(points)
    tilt = min(3 * task.start_tilt, np.pi / 2)
    radius = np.linalg.norm(cloud[:, :2], axis=1).max()
    return float(-cloud[:, 2].min() * np.cos(tilt) + radius * np.sin(tilt))


def _euler_quat(roll: Any, pitch: Any, yaw: Any) -> jax.Array:
    """`[4, n]` quaternion (w, x, y, z) of roll, then pitch, then yaw [rad]."""
    (cr, sr), (cp, sp), (cy, sy) = ((jnp.cos(x / 2), jnp.sin(x / 2)) for x in (roll, pitch, yaw))
    return jnp.stack(
        [
            cr * cp * cy + sr * sp * sy,
            sr * cp * cy - cr * sp * sy,
            cr * sp * cy + sr * cp * sy,
            cr * cp * sy - sr * sp * cy,
        ]
    )


def make_fitness(config: Config | str | Path | dict[str, Any], **overrides: Any) -> Fitness:
    """Builds the fitness function of a configuration.

    Args:
        config: a `Config`, the path of a YAML file, or a mapping like one.
        **overrides: settings that replace the configuration's, dotted names through `**`:
            `make_fitness(path, engine="mjx", **{"task.duration": 5.0})`.

    Returns:
        The fitness function.

    Raises:
        InputError: the configuration, the morphology or the world is wrong; the message says where.
    """
    if isinstance(config, Config):
        if overrides:
            config = make_config(config.model_dump(), overrides=overrides, source=config.source)
    elif isinstance(config, dict):
        config = make_config(config, overrides=overrides)
    else:
        config = load_config(config, overrides=overrides)
    modules = MODULES | load_modules(config.modules) if config.modules else MODULES
    morphology = load_morphology(config.morphology, modules, config.allow_overlap)
    try:
        world = load_world(config.world_name, **config.world_overrides)
    except InputError as error:
        raise InputError(f"{config.source}: {error}") from None
    if config.trim == "neutral":
        morphology = trim_neutral(morphology, world.density)
    if config.task.type == "crawl" and world.bed is None:
        raise InputError(
            f"{config.source}: task.type: crawl expected a world with a bed; found none"
        )
    robot = build_robot(morphology, world)
    settings = config.controller
    if settings.depth is None:
        settings = settings.model_copy(update={"depth": config.task.depth})
    controller = find_controller(robot, settings, config.source)
    contact = may_touch_bed(config, robot)
    fitness = Fitness(config, robot, controller, make_engine(robot, config.engine, contact))
    _ = fitness.task  # found now, so that a mistake in a user's own shows before any rollout
    return fitness


def may_touch_bed(config: Config, robot: Robot) -> bool:
    """Whether the bed is within reach of an episode; if not, the step needs no contact.

    Reach is what a robot at `_FASTEST` covers, plus its fall where the water does not carry it. An
    individual that outruns it counts as blown up, so nothing can pass through an absent bed unseen.
    """
    world, task = robot.world, config.task
    if world.bed is None:
        return False
    reach = _reach(config, robot)
    line = np.linspace(-reach, reach, 101)
    highest = float(np.max(bed_height(world.bed, *np.meshgrid(line, line))))
    return task.type == "crawl" or world.surface_height - task.depth - reach < highest


def _reach(config: Config, robot: Robot) -> float:
    """How far from its start an episode of one robot may lead [m]."""
    world = robot.world
    sinks = (
        world.buoyancy == "off"
        or world.density * robot.morphology.volume < robot.morphology.mass / 2
    )
    return farthest(config, world, robot.morphology.length, sinks)


def farthest(config: Config, world: World, length: float, sinks: bool) -> float:
    """How far from its start an episode may lead [m].

    Args:
        config: its task.
        world: the world.
        length: of the robot [m].
        sinks: whether the water carries less than half of its weight.

    Returns:
        The distance; who gets further has blown up.
    """
    task = config.task
    current = np.linalg.norm(world.current) + 4 * task.current_std
    fall = 0.5 * world.gravity * task.duration**2 if sinks else 0.0
    return float((_FASTEST + current) * task.duration + fall + 4 * task.start_position + length)
