"""A tank: a world that goes on, in which robots come and go, and all in it are stepped together.

It has a fixed number of places, so that one compiled program serves it however many are there; a
place that nobody has is stepped along, and felt by no one. Several worlds with equally many places
may stand side by side. Every robot's own time begins when it is put in.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.control.sense import Cues
from mjx_revolve.engine.collisions import Touch, make_meeting
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.rows import make_rows
from mjx_revolve.engine.spheres import Spheres, count_spheres, pack_spheres
from mjx_revolve.engine.state import Engine
from mjx_revolve.engine.step import make_step_engine
from mjx_revolve.episodes.fitness import MixedFitness
from mjx_revolve.episodes.rollout import Passage, begin, flow_at, go_on
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics.xla import compiler_options
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World


class Trail(NamedTuple):
    """What robots did over a while, sampled at equal intervals; NumPy.

    Attributes:
        time: `[T]` since the tank's beginning [s].
        qpos: `[T, nq, places]` of each place's robot, in its first 7 + hinges rows: MuJoCo's qpos.
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
    """What a stretch of time is computed from, beside what travels on; places on the last axis."""

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
        mixed: task, world and controller, and room for bodies.
        places: how many robots there may be, in all worlds together.
        worlds: how many worlds stand side by side.
        touch: how robots' surfaces answer each other; None: they pass through each other.
        spheres: room for so many of them in each place; more is made where a robot needs it.
        steps: since the beginning.
        robots: `[places]` who is where; None: nobody.
        tag: `[places]` by which robots can tell each other apart.
    """

    mixed: MixedFitness
    places: int
    worlds: int
    touch: Touch | None
    spheres: int = 0
    steps: int = 0
    robots: list[Robot | None] = field(default_factory=list, repr=False)

    def __post_init__(self) -> None:
        """An empty tank."""
        self.robots = [None] * self.places
        self._new = np.zeros(self.places, bool)
        self._since = np.zeros(self.places, np.int64)
        self._genes = np.zeros((self.mixed.num_genes, self.places), np.float32)
        self._start = np.zeros((7, self.places), np.float32)
        self._start[3] = 1
        # Far apart, where nobody else is.
        self._start[0] = 1e3 + 10.0 * np.arange(self.places)
        self._start[2] = self.world.surface_height - 1
        self.tag = np.zeros(self.places, np.float32)
        self.target: np.ndarray | None = None
        self._noise = np.arange(self.places, dtype=np.uint32)
        self._current = np.array(self.world.current, np.float32)
        self._passage: Passage | None = None
        self._bodies: Any = None
        self._spheres: Any = None

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
    def alive(self) -> np.ndarray:
        """`[places]` which places are taken."""
        return np.array([robot is not None for robot in self.robots])

    @property
    def count(self) -> int:
        """How many robots there are."""
        return int(self.alive.sum())

    def age(self, place: int) -> float:
        """How long a robot has been in the tank [s]."""
        return float(self.steps - self._since[place]) * self.timestep

    # --- who is there

    def add(
        self,
        robot: Robot,
        genes: Any,
        position: Sequence[float],
        quat: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
        world: int = 0,
        noise: int | None = None,
    ) -> int:
        """Puts a robot in, at rest, its hinges at 0.

        Args:
            robot: from `mixed.build`.
            genes: `[n]` of its own controller; None for a robot that keeps still.
            position: of its core, world frame [m].
            quat: of its core, world from body (w, x, y, z).
            world: in which of the worlds.
            noise: what its sensors' noise is drawn from; by default its place's number.

        Returns:
            Its place.

        Raises:
            InputError: no place is free, or the robot or its genes do not fit.
        """
        each = self.places // self.worlds
        free = [k for k in range(world * each, (world + 1) * each) if self.robots[k] is None]
        if not free:
            raise InputError(f"tank: expected a free place; found all {each} taken")
        if genes is None:
            wide = np.zeros(self.mixed.num_genes, np.float32)
        else:
            wide = self.mixed.pad_genes(np.asarray(genes, np.float32), robot)
        size = np.linalg.norm(np.asarray(quat, float))
        if not (np.all(np.isfinite(position)) and np.isfinite(size) and size > 0):
            raise InputError(
                f"tank: expected a finite place and a quaternion of some length; found "
                f"{list(position)} and {list(quat)}"
            )
        place = free[0]
        self._put(place, robot)
        self.robots[place] = robot
        self._genes[:, place] = wide
        self._start[:3, place] = position
        self._start[3:, place] = np.asarray(quat, float) / size
        self._since[place] = self.steps
        self._new[place] = True
        self._noise[place] = np.uint32(place if noise is None else noise)
        return place

    def remove(self, place: int) -> None:
        """Takes a robot out.

        Args:
            place: its place.

        Raises:
            InputError: there is nobody.
        """
        if not 0 <= place < self.places or self.robots[place] is None:
            raise InputError(f"tank: expected a robot in place {place}; found none")
        self.robots[place] = None

    def move(self, shift: np.ndarray) -> None:
        """Puts robots elsewhere, moving as they were.

        Args:
            shift: `[3, places]` by how much, world frame [m].
        """
        if self._passage is None:
            return
        state = self._passage.state
        moved = tuple(
            np.asarray(x) + d.astype(np.float32) for x, d in zip(state.position, shift, strict=True)
        )
        self._passage = self._passage._replace(state=state._replace(position=moved))

    def set_current(self, current: Sequence[float]) -> None:
        """Changes the water's uniform current.

        Args:
            current: world frame [m/s].

        Raises:
            InputError: these are no three finite numbers.
        """
        found = np.asarray(current, np.float32)
        if found.shape != (3,) or not np.all(np.isfinite(found)):
            raise InputError(f"current: expected three numbers [m/s]; found {list(current)}")
        self._current = found

    def set_targets(self, target: np.ndarray | None) -> None:
        """Says where each robot's target is, for sensors that tell of it.

        Args:
            target: `[3, places]` world frame [m]; None: there is none.
        """
        self.target = None if target is None else np.asarray(target, np.float32)

    def _put(self, place: int, robot: Robot) -> None:
        """A robot's tables into its place."""
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

    # --- what they do

    def advance(self, duration: float, every: float = 0.1) -> Trail:
        """Lets time pass.

        Args:
            duration: how long [s], in whole rows.
            every: time between rows [s], in whole steps.

        Returns:
            What the robots did, rows at the end of each interval.
        """
        step = self.timestep
        stride = max(1, round(every / step))
        rows = max(1, round(duration / (stride * step)))
        alive = self.alive
        if self._bodies is None:  # nobody has ever been here
            self.steps += rows * stride
            time = (self.steps - stride * np.arange(rows)[::-1]) * step
            blank = np.zeros((rows, 7 + self.mixed.capacity.hinges, self.places), np.float32)
            return Trail(time, blank, np.zeros((rows, self.places), np.float32), alive)
        given = self._given()
        passage = self._passage
        if passage is None:
            passage = self._blank(given)
            given = given._replace(new=np.ones(self.places, bool))
        run = self._stretch(rows, stride)
        passage, qpos, energy = run(given, passage)
        self._passage = jax.tree.map(np.asarray, passage)
        time = (self.steps + stride * np.arange(1, rows + 1)) * step
        self.steps += rows * stride
        self._new[:] = False
        return Trail(time, np.asarray(qpos), np.asarray(energy), alive)

    def _given(self) -> _Given:
        """What is computed from now."""
        return _Given(
            self._bodies, self._spheres, self._genes, self._start, self._new, self.alive,
            (self._since - self.steps).astype(np.int32), self.tag, self.target, self._noise,
            self._current, np.float32(self.time),
        )  # fmt: skip

    def _engine(self, given: _Given) -> Engine:
        setup = self.mixed.setup
        rows = make_rows(self.world, self.mixed.capacity, given.bodies, self.places)
        looks = "nearest" in setup.controller.feels
        meet = None
        if looks or self.touch is not None:
            tag = given.tag if looks else None
            meet = make_meeting(rows, given.spheres, given.alive, self.worlds, self.touch, tag)
        return make_step_engine(rows, given.bodies.plant, meet=meet)

    def _begin(self, given: _Given) -> Passage:
        """What travels, for all places as if all robots were put in now."""
        controller, engine = self.mixed.setup.controller, self._engine(given)
        hinges = jnp.zeros((self.mixed.capacity.hinges, self.places), given.start.dtype)
        qpos = jnp.concatenate([given.start, hinges])
        state = engine.init(qpos, jnp.zeros_like(qpos[1:]))
        parameters = controller.decode(given.genes, given.bodies.plant)
        return begin(engine, state, controller.init(parameters), controller.feels)

    def _blank(self, given: _Given) -> Passage:
        """Zeros of its shapes."""
        shapes = jax.eval_shape(self._begin, jax.tree.map(jnp.asarray, given))
        return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)

    @cached_property
    def _programs(self) -> dict[tuple[int, int], Any]:
        return {}

    def _stretch(self, rows: int, stride: int) -> Any:
        """The program for so many rows of so many steps, compiled once."""
        key = rows, stride
        if key not in self._programs:
            run = partial(self._run, rows, stride)
            self._programs[key] = jax.jit(run, compiler_options=compiler_options())
        return self._programs[key]

    def _run(self, rows: int, stride: int, given: _Given, passage: Passage) -> Any:
        given = jax.tree.map(jnp.asarray, given)
        world, controller = self.world, self.mixed.setup.controller
        engine, fresh = self._engine(given), self._begin(given)
        pick = lambda new, old: jnp.where(given.new, new, old)  # noqa: E731
        zero = jnp.zeros((), jnp.int32)
        passage = jax.tree.map(pick, fresh._replace(count=zero), passage._replace(count=zero))
        # Steps are counted from now, so that float32 can hold every robot's age.
        passage = passage._replace(count=zero)
        parameters = controller.decode(given.genes, given.bodies.plant)
        target = None if given.target is None else tuple(given.target)
        water = Water(world.surface_height, tuple(given.current), time=given.time)

        def record(state: Any, ctrl: jax.Array, energy: jax.Array, water: Water) -> Any:
            return engine.observe(state)[0], energy

        passage, (qpos, energy) = go_on(
            engine,
            lambda state, time, row, sense: controller.step(parameters, state, time, sense),
            lambda time, row: flow_at(world, water)(time, None),
            record,
            passage,
            None,
            records=rows,
            every=stride,
            timestep=world.timestep,
            world=world,
            cues=Cues(target, None, given.noise),
            feels=controller.feels,
            since=given.since,
        )
        return passage, qpos, energy

    # --- to and from a file

    def to_arrays(self) -> dict[str, np.ndarray]:
        """All but the robots themselves, as named arrays."""
        found: dict[str, np.ndarray] = {
            "steps": np.asarray(self.steps),
            "new": self._new.copy(),
            "since": self._since.copy(),
            "genes": self._genes.copy(),
            "start": self._start.copy(),
            "tag": self.tag.copy(),
            "noise": self._noise.copy(),
            "current": self._current.copy(),
            "alive": self.alive,
        }
        if self.target is not None:
            found["target"] = self.target.copy()
        if self._passage is not None:
            for k, leaf in enumerate(jax.tree.leaves(self._passage)):
                found[f"passage.{k}"] = np.asarray(leaf)
        return found

    def from_arrays(self, arrays: Mapping[str, np.ndarray], robots: Mapping[int, Robot]) -> None:
        """The inverse, of a tank that was just made; what goes on is the same bit for bit.

        Args:
            arrays: from `to_arrays`.
            robots: by place.

        Raises:
            InputError: the arrays are those of another tank.
        """
        alive = arrays["alive"]
        if alive.shape != (self.places,) or set(np.flatnonzero(alive)) != set(robots):
            raise InputError("tank: expected the arrays of one with these robots; found others")
        for place, robot in robots.items():
            self._put(place, robot)
            self.robots[place] = robot
        self.steps = int(arrays["steps"])
        self._new, self._since = arrays["new"].copy(), arrays["since"].copy()
        self._genes, self._start = arrays["genes"].copy(), arrays["start"].copy()
        self.tag, self._noise = arrays["tag"].copy(), arrays["noise"].copy()
        self._current = arrays["current"].copy()
        self.target = arrays["target"].copy() if "target" in arrays else None
        leaves = sum(name.startswith("passage.") for name in arrays)
        if leaves and self._bodies is not None:
            blank = self._blank(self._given())
            wanted, tree = jax.tree.flatten(blank)
            found = [arrays.get(f"passage.{k}") for k in range(len(wanted))]
            for want, have in zip(wanted, found, strict=True):
                if have is None or have.shape != want.shape or have.dtype != want.dtype:
                    raise InputError("tank: expected the arrays of one like this; found others")
            self._passage = jax.tree.unflatten(tree, found)


def make_tank(
    mixed: MixedFitness,
    places: int,
    worlds: int = 1,
    touch: Touch | None = Touch(),  # noqa: B008  (frozen)
    spheres: int = 0,
) -> Tank:
    """An empty tank.

    Args:
        mixed: from `make_mixed_fitness`: its world, its controller, and the bodies that there is
            room for. Its task does not count.
        places: how many robots there may be in each world.
        worlds: how many worlds stand side by side.
        touch: how robots' surfaces answer each other; None: they pass through each other.
        spheres: most that stand for a robot in contact, if it is known: a robot that needs more
            has the tank compiled anew.

    Returns:
        The tank.

    Raises:
        InputError: the world is gusty, or its bed may be touched and there is no room for that.
    """
    if mixed.world.gust is not None:
        raise InputError(
            "tank: expected a world without gusts, which are drawn for episodes; found some"
        )
    return Tank(mixed, places * worlds, worlds, touch, spheres)
