"""A tank: a world of unlimited duration, to which robots are added and from which they are removed.

It has a fixed number of slots, called places, so that one compiled program serves any number of
robots; an empty place is stepped, too, and no sensor reads it. Several worlds with equal numbers of
places may be stepped together. Every robot's own time begins when it is added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from mjx_revolve.control.readings import EpisodeContext
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.interaction import ContactParameters, make_interaction
from mjx_revolve.engine.population import PopulationEngine
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.spheres import Spheres, count_spheres, pack_spheres
from mjx_revolve.episodes.fitness import MixedFitness
from mjx_revolve.episodes.rollout import Rollout, RolloutState, controlled, start_at_rest
from mjx_revolve.inputs.errors import InputError, show
from mjx_revolve.numerics.xla import jit
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World


class TankTrajectory(NamedTuple):
    """Motion of the robots in a tank, sampled at equal intervals; NumPy.

    Attributes:
        time: `[T]` since the tank's beginning [s].
        qpos: `[T, nq, places]` in its first 7 + hinges rows MuJoCo's qpos of each place's robot.
        energy: `[T, places]` work of its servos and propellers since the row before, summed without
            sign [J].
        alive: `[places]` which places were taken.
    """

    time: np.ndarray
    qpos: np.ndarray
    energy: np.ndarray
    alive: np.ndarray

    @property
    def position(self) -> np.ndarray:
        """`[T, 3, places]` of the cores, world frame [m]."""
        return self.qpos[:, :3]


class _Given(NamedTuple):
    """Inputs of a compiled stretch of time; places on the last axis."""

    bodies: Any
    spheres: Spheres
    genes: Any
    start: Any
    new: Any
    alive: Any
    since: Any
    tag: Any
    target: Any
    noise: Any
    current: Any
    time: Any


@dataclass(eq=False)
class Tank:
    """A running world; see `make_tank`.

    Attributes:
        mixed: world, controller, and room for bodies.
        places: of all worlds together.
        worlds: how many stand side by side.
        touch: contact between robots; None: they pass through each other.
        spheres: capacity for spheres of contact in each place; it grows with a robot of more.
        steps: since the beginning.
        robots: `[places]`; None: an empty place.
        state: of the rollout; None before the first `advance`.
        target: `[3, places]` of each robot, world frame [m]; None without.
    """

    mixed: MixedFitness
    places: int
    worlds: int
    touch: ContactParameters | None
    spheres: int = 0
    steps: int = 0
    robots: list[Robot | None] = field(default_factory=list, repr=False)
    state: RolloutState | None = field(default=None, repr=False)
    target: np.ndarray | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        """An empty tank."""
        count = self.places
        self.robots = [None] * count
        # Empty places are far apart.
        start = np.zeros((7, count), np.float32)
        start[0] = 1e3 + 10.0 * np.arange(count)
        start[2], start[3] = self.world.surface_height - 1, 1
        # Properties of the places, on the last axis: fields of `_Given`.
        self._slots = {
            "genes": np.zeros((self.mixed.num_genes, count), np.float32),
            "start": start,
            "new": np.zeros(count, bool),
            "since": np.zeros(count, np.int64),
            "tag": np.zeros(count, np.float32),
            "noise": np.arange(count, dtype=np.uint32),
        }
        self._current = np.array(self.world.current, np.float32)
        self._bodies: Any = None
        self._spheres: Any = None
        self._programs: dict[tuple[int, int], Any] = {}

    @property
    def world(self) -> World:
        """Around the robots, but for its current, which `set_current` may change."""
        return self.mixed.world

    @property
    def timestep(self) -> float:
        """Of the world [s]."""
        return self.world.timestep

    @property
    def time(self) -> float:
        """Since the beginning [s]."""
        return self.steps * self.timestep

    @property
    def current(self) -> np.ndarray:
        """`[3]` uniform part of the water's velocity, world frame [m/s]."""
        return self._current.copy()

    @property
    def tag(self) -> np.ndarray:
        """`[places]` numbers that identify robots to sensors."""
        return self._slots["tag"]

    @property
    def alive(self) -> np.ndarray:
        """`[places]` which places are taken."""
        return np.array([robot is not None for robot in self.robots])

    @property
    def count(self) -> int:
        """The number of robots."""
        return int(self.alive.sum())

    def age(self, place: int) -> float:
        """The time since a robot was added [s]."""
        return float(self.steps - self._slots["since"][place]) * self.timestep

    # --- robots

    def add(
        self,
        robot: Robot,
        genes: ArrayLike | None,
        position: Sequence[float],
        quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
        world: int = 0,
        noise: int | None = None,
    ) -> int:
        """Adds a robot, at rest, its hinges at 0.

        Args:
            robot: from `mixed.build`.
            genes: `[n]` of its own controller; None for a robot that keeps still.
            position: of its core, world frame [m].
            quat: of its core, world from body (w, x, y, z).
            world: in which of the worlds.
            noise: seed of its sensors' noise; by default its place's number.

        Returns:
            Its place.

        Raises:
            InputError: there is no such world, no place is free, or the robot or its genes do not
                fit.
        """
        if not 0 <= world < self.worlds:
            raise InputError("tank", f"a world below {self.worlds}", world)
        each = self.places // self.worlds
        free = [k for k in range(world * each, (world + 1) * each) if self.robots[k] is None]
        if not free:
            raise InputError("tank", "a free place", f"all {each} taken")
        if genes is None:
            wide = np.zeros(self.mixed.num_genes, np.float32)
        else:
            wide = self.mixed.pad_genes(np.asarray(genes, np.float32), robot)
        where, turn = _numbers(position), _numbers(quat)
        size = np.linalg.norm(turn)
        three = where.shape == (3,) and np.all(np.isfinite(where))
        if not (three and turn.shape == (4,) and np.isfinite(size) and size > 0):
            finite = "a finite place and a quaternion of some length"
            raise InputError("tank", finite, f"{show(position)} and {show(quat)}")
        place = free[0]
        seed = place if noise is None else noise
        if not (isinstance(seed, int | np.integer) and 0 <= seed < 2**32):
            raise InputError("noise", "a whole number >= 0 and < 2**32", show(noise))
        self._put(place, robot)
        self.robots[place] = robot
        slots = self._slots
        slots["genes"][:, place] = wide
        slots["start"][:, place] = (*where, *turn / size)
        slots["since"][place] = self.steps
        slots["new"][place] = True
        slots["noise"][place] = seed
        return place

    def remove(self, place: int) -> None:
        """Removes the robot of a place.

        Raises:
            InputError: the place is empty.
        """
        if not 0 <= place < self.places or self.robots[place] is None:
            raise InputError("tank", f"a robot in place {place}", "none")
        self.robots[place] = None

    def move(self, shift: np.ndarray) -> None:
        """Displaces robots, without a change of their velocities.

        Args:
            shift: `[3, places]` world frame [m].
        """
        new = self._slots["new"]  # they have a start, and no state yet
        self._slots["start"][:3, new] += shift[:, new]
        if self.state is None:
            return
        state = self.state.state
        moved = tuple(
            np.asarray(x) + d.astype(np.float32) for x, d in zip(state.position, shift, strict=True)
        )
        self.state = self.state._replace(state=state._replace(position=moved))

    def set_current(self, current: Sequence[float]) -> None:
        """Changes the water's uniform current.

        Args:
            current: world frame [m/s].

        Raises:
            InputError: these are no three finite numbers.
        """
        found = _numbers(current).astype(np.float32)
        if found.shape != (3,) or not np.all(np.isfinite(found)):
            raise InputError("current", "three numbers [m/s]", show(current))
        self._current = found

    def set_targets(self, target: np.ndarray | None) -> None:
        """Sets the target of each robot's sensors, `[3, places]` world frame [m]; None: none.

        Raises:
            InputError: it has another shape.
        """
        if target is not None and np.shape(target) != (3, self.places):
            found = [*np.shape(target)]
            raise InputError("target", f"[3, {self.places}], a place for each robot", found)
        self.target = None if target is None else np.array(target, np.float32)

    def _put(self, place: int, robot: Robot) -> None:
        """Writes a robot's tables into its place."""
        bodies = self.mixed.pack([robot])
        if count_spheres([robot]) > self.spheres:
            # Room for some more, as every change of shape has to be compiled for.
            more = -(-count_spheres([robot]) // 8) * 8 - self.spheres
            self.spheres += more
            if self._spheres is not None:
                room = lambda x: np.concatenate([x, np.zeros_like(x[:1]).repeat(more, 0)])  # noqa: E731
                self._spheres = jax.tree.map(room, self._spheres)
        spheres = pack_spheres([robot], self.mixed.capacity, self.spheres)
        if self._bodies is None:
            wide = lambda x: np.repeat(x, self.places, -1)  # noqa: E731
            self._bodies, self._spheres = jax.tree.map(wide, (bodies, spheres))
            return

        def write(whole: np.ndarray, own: np.ndarray) -> None:
            whole[..., place] = own[..., 0]

        jax.tree.map(write, (self._bodies, self._spheres), (bodies, spheres))

    # --- time

    def advance(self, duration: float, every: float = 0.1) -> TankTrajectory:
        """Advances the time.

        Args:
            duration: [s], in whole rows.
            every: time between rows [s], in whole steps.

        Returns:
            The robots' motion, rows at the end of each interval.

        Raises:
            InputError: a time is not above 0.
        """
        if not all(0 < time < np.inf for time in (duration, every)):
            raise InputError("tank", "times > 0 to advance by", f"{duration} and {every}")
        step = self.timestep
        stride = max(1, round(every / step))
        rows = max(1, round(duration / (stride * step)))
        alive = self.alive
        time = (self.steps + stride * np.arange(1, rows + 1)) * step
        if self._bodies is None:  # no robot was ever added
            self.steps += rows * stride
            blank = np.zeros((rows, 7 + self.mixed.capacity.hinges, self.places), np.float32)
            return TankTrajectory(time, blank, np.zeros((rows, self.places), np.float32), alive)
        given = self._given()
        state = self.state
        if state is None:
            state = self._blank(given)
            given = given._replace(new=np.ones(self.places, bool))
        state, qpos, energy = self._stretch(rows, stride)(given, state)
        self.state = jax.tree.map(np.asarray, state)
        self.steps += rows * stride
        self._slots["new"][:] = False
        return TankTrajectory(time, np.asarray(qpos), np.asarray(energy), alive)

    def _given(self) -> _Given:
        """The inputs of a stretch that begins now."""
        slots = self._slots | {"since": (self._slots["since"] - self.steps).astype(np.int32)}
        return _Given(
            self._bodies, self._spheres, **slots, alive=self.alive, target=self.target,
            current=self._current, time=np.float32(self.time),
        )  # fmt: skip

    def _engine(self, given: _Given) -> Engine:
        rows = make_batched_trees(self.world, self.mixed.capacity, given.bodies, self.places)
        looks = "nearest" in self.mixed.controller.signals
        meet = None
        if looks or self.touch is not None:
            tag = given.tag if looks else None
            meet = make_interaction(rows, given.spheres, given.alive, self.worlds, self.touch, tag)
        return PopulationEngine(rows, given.bodies.plant, interaction=meet)

    def _rollout(self, given: _Given) -> tuple[Rollout, RolloutState]:
        """The rollout, and its state if all robots were added now."""
        controller, engine = self.mixed.controller, self._engine(given)
        parameters = controller.decode(given.genes, given.bodies.plant)
        target = None if given.target is None else tuple(given.target)
        far = self.mixed.settings.sight
        sight = None if far is None else jnp.full(given.noise.shape, far, given.genes.dtype)
        context = EpisodeContext(target, None, given.noise, sight)
        policy, world, signals = controlled(controller, parameters), self.world, controller.signals
        water = Water(world.surface_height, tuple(given.current), time=given.time)
        rollout = Rollout(engine, policy, world, water, context, signals, birth=given.since)
        state = start_at_rest(engine, given.start)
        # What is one number for all would be one for each robot from the first step on.
        wide = lambda x: x if x.ndim else jnp.broadcast_to(x, given.noise.shape)  # noqa: E731
        return rollout, rollout.init(state, jax.tree.map(wide, controller.init(parameters)))

    def _blank(self, given: _Given) -> RolloutState:
        """Zeros of its shapes."""
        shapes = jax.eval_shape(lambda x: self._rollout(x)[1], jax.tree.map(jnp.asarray, given))
        return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)

    def _stretch(self, rows: int, stride: int) -> Any:
        """The program for so many rows of so many steps, compiled once."""
        key = rows, stride
        if key not in self._programs:
            self._programs[key] = jit(partial(self._run, rows, stride))
        return self._programs[key]

    def _run(self, rows: int, stride: int, given: _Given, state: RolloutState) -> Any:
        given = jax.tree.map(jnp.asarray, given)
        rollout, fresh = self._rollout(given)
        # Steps are counted from now, so that float32 can hold every robot's age.
        zero = jnp.zeros((), jnp.int32)
        state, fresh = state._replace(steps=zero), fresh._replace(steps=zero)
        pick = lambda new, old: jnp.where(given.new, new, old)  # noqa: E731
        state = jax.tree.map(pick, fresh, state)._replace(steps=zero)

        def record(now: RolloutState, ctrl: jax.Array, water: Water) -> tuple[jax.Array, jax.Array]:
            return rollout.engine.observe(now.state)[0], now.energy

        state, (qpos, energy) = rollout.advance(state, record, rows, stride)
        return state, qpos, energy

    # --- to and from a file

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All but the robots themselves, as named arrays."""
        found = {name: x.copy() for name, x in self._slots.items()}
        found |= {"steps": np.asarray(self.steps), "current": self.current, "alive": self.alive}
        if self.target is not None:
            found["target"] = self.target.copy()
        for k, leaf in enumerate(jax.tree.leaves(self.state)):
            found[f"passage.{k}"] = np.asarray(leaf)
        return found

    def from_arrays(self, arrays: Mapping[str, np.ndarray], robots: Mapping[int, Robot]) -> None:
        """The inverse of `to_arrays`, for a new tank; later results are equal bit for bit.

        Args:
            arrays: from `to_arrays`.
            robots: by place.

        Raises:
            InputError: the arrays are those of another tank.
        """
        alive = arrays["alive"]
        if alive.shape != (self.places,) or set(np.flatnonzero(alive)) != set(robots):
            raise InputError("tank", "the arrays of one with these robots", "others")
        for place, robot in robots.items():
            self._put(place, robot)
            self.robots[place] = robot
        self._slots = {name: arrays[name].copy() for name in self._slots}
        self.steps, self._current = int(arrays["steps"]), arrays["current"].copy()
        self.target = arrays["target"].copy() if "target" in arrays else None
        if "passage.0" in arrays and self._bodies is not None:
            wanted, tree = jax.tree.flatten(self._blank(self._given()))
            found = [arrays.get(f"passage.{k}") for k in range(len(wanted))]
            for want, have in zip(wanted, found, strict=True):
                if have is None or have.shape != want.shape or have.dtype != want.dtype:
                    raise InputError("tank", "the arrays of one like this", "others")
            self.state = jax.tree.unflatten(tree, found)


def _numbers(values: ArrayLike) -> np.ndarray:
    """Numbers as an array; an empty one of what is none."""
    try:
        return np.asarray(values, float)
    except (TypeError, ValueError):
        return np.zeros(0)


def make_tank(
    mixed: MixedFitness,
    places: int,
    worlds: int = 1,
    touch: ContactParameters | None = ContactParameters(),  # noqa: B008  (frozen)
    spheres: int = 0,
) -> Tank:
    """An empty tank.

    Args:
        mixed: from `make_mixed_fitness`; its world, its controller, and its room for bodies.
        places: of each world.
        worlds: number of worlds.
        touch: contact between robots; None: they pass through each other.
        spheres: largest number of spheres of a robot for contact, if known; for a robot of more the
            program is compiled anew.

    Returns:
        The tank.

    Raises:
        InputError: the world is gusty, or its bed may be touched and there is no room for that.
    """
    if mixed.world.gust is not None:
        calm = "a world without gusts, which are drawn for episodes"
        raise mixed.config.misfit("world", calm, "some")
    if mixed.world.bed is not None and not mixed.touches:
        colony = "a fitness with a colony where there is a bed, which robots reach in a long life"
        raise InputError("tank", colony, "one for episodes that end before")
    return Tank(mixed, places * worlds, worlds, touch, spheres)
