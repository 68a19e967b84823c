"""Who keeps a world running in real time, and does what those who watch it ask for.

All that touches the world happens in one thread, the one that calls `Keeper.run`: two computations
of XLA at once in one process may wait for each other for ever. Others ask (`Keeper.ask`) and listen
(`Keeper.listen`).
"""

from __future__ import annotations

import base64
import json
import math
import queue
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple, Protocol

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.course import bed_at
from mjx_revolve.view.live.wishes import Current, Drop, Pause, Rate, Remove, Reset, Wish
from mjx_revolve.view.packed import pack_waves
from mjx_revolve.view.shoal_data import Bodies
from mjx_revolve.water.world import World

# The world is stepped in slices, of which each is so long, and has so many poses. A choice: what is
# asked for is done within a tenth of a second, and between two poses motion is straight [s].
SLICE, EVERY = 0.1, 0.05
# Later than this, time that was lost is not made up for [s].
_LATE = 0.3
# How long a slice may take before it must be compiling [s].
_LONG = 1.0
_TOLD = 0.5  # how often pages are told how fast time goes [s]
_IDLE = 0.2  # how often a keeper that has nothing to do looks up [s]
_BACKLOG = 100  # messages that a listener may be behind; then it is given up
_SPREAD = 0.6  # robots are dropped so far apart, in shares of their two lengths


class TankLike(Protocol):
    """A running world, as `tank.Tank` is one: robots come and go, all are stepped together."""

    @property
    def time(self) -> float:
        """Since its beginning [s]."""

    def add(self, robot: Robot, genes: Any, position: Any, quat: Any = (1, 0, 0, 0)) -> int:
        """Puts a robot there and returns its place."""

    def remove(self, place: int) -> None:
        """Takes it away."""

    def set_current(self, current: Any) -> None:
        """Makes the water flow so everywhere [m/s]."""

    def advance(self, duration: float, every: float) -> Any:
        """Steps all for some time [s], with a row each so often [s]: a `tank.Trail`."""


@dataclass(frozen=True, eq=False)
class Entry:
    """Somebody who may be dropped.

    Attributes:
        name: in a few words.
        short: what it is called once it is in the water.
        group: where they come from.
        robot: its body in the world.
        genes: finds the genes of its controller; None: it keeps still.
    """

    name: str
    short: str
    group: str
    robot: Robot
    genes: Callable[[], np.ndarray | None] = lambda: None


class Inmate(NamedTuple):
    """Who is in the water.

    Attributes:
        key: a number that nobody else ever has.
        name: what it is called.
        place: its place in the tank.
        body: number of its body, see `shoal_data.Bodies`.
        robot: it.
        born: when it was dropped [s].
        start: where its core was then, world frame [m].
    """

    key: int
    name: str
    place: int
    body: int
    robot: Robot
    born: float
    start: tuple[float, float, float]


@dataclass
class _State:
    """What all pages show."""

    paused: bool = False
    rate: float = 1.0
    speed: float = 0.0  # that is kept up, in shares of real time
    current: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(eq=False)
class Keeper:
    """Runs a tank.

    Attributes:
        tank: nobody else touches it from now on.
        world: of the tank.
        stock: who may be dropped.
        first: who is there at the beginning.
        waits: whether time stands still while nobody listens.
    """

    tank: TankLike
    world: World
    stock: Sequence[Entry]
    first: Sequence[Drop] = (Drop(0),)
    waits: bool = True
    bodies: Bodies = field(default_factory=Bodies)

    def __post_init__(self) -> None:
        self._wishes: queue.Queue[tuple[Wish, Future[Any]]] = queue.Queue()
        self._listeners: list[queue.Queue[str | None]] = []
        self._lock = threading.Lock()
        self._state = _State(current=self.world.current)
        self._busy: float | None = None  # since when a slice is being stepped
        self._stopped = threading.Event()
        self._count = 0  # of all who were ever dropped
        self._named: dict[str, int] = {}  # of each name
        self._random = np.random.default_rng()
        self.inmates: tuple[Inmate, ...] = ()
        self.qpos: dict[int, np.ndarray] = {}
        self.time = 0.0
        # The last poses of all, oldest first: time [s] and qpos by key.
        self.recent: deque[tuple[float, dict[int, np.ndarray]]] = deque(maxlen=8)

    # ------------------------------------------------------------------ from any thread

    def ask(self, wish: Wish) -> Future[Any]:
        """Asks for something; the result is there once it is done.

        Args:
            wish: what.

        Returns:
            Of a `Drop` the robot's key, of others None; or an `InputError`.
        """
        future: Future[Any] = Future()
        self._wishes.put((wish, future))
        return future

    def listen(self) -> queue.Queue[str | None]:
        """All that happens from now on, after what there is: events as they are sent; None ends."""
        listener: queue.Queue[str | None] = queue.Queue(_BACKLOG)
        with self._lock:
            there = {key: pose[None] for key, pose in dict(self.qpos).items()}
            listener.put(self._tell_state())
            listener.put(self._tell_cast())
            if there:
                listener.put(_tell_poses([self.time], there))
            self._listeners.append(listener)
            if self._stopped.is_set():
                listener.put(None)
        return listener

    def leave(self, listener: queue.Queue[str | None]) -> None:
        """Somebody does not listen any more."""
        with self._lock, suppress(ValueError):
            self._listeners.remove(listener)

    def stop(self) -> None:
        """Ends `run` after the slice that is being stepped."""
        self._stopped.set()

    @property
    def current(self) -> tuple[float, float, float]:
        """The water's velocity, as it was last asked for [m/s]."""
        return self._state.current

    @property
    def rate(self) -> float:
        """Seconds in the water for each real one [-]."""
        return self._state.rate

    @property
    def ended(self) -> bool:
        """Whether the world has ended, or is about to."""
        return self._stopped.is_set()

    @property
    def paused(self) -> bool:
        """Whether time stands still."""
        return self._state.paused

    @property
    def busy(self) -> float:
        """How long the present slice has been taking; 0 where it is none that takes long [s]."""
        since = self._busy
        took = 0.0 if since is None else time.monotonic() - since
        return took if took > _LONG else 0.0

    def state_now(self) -> str:
        """The event that says what all pages show."""
        return self._tell_state()

    # ------------------------------------------------------------------ in its own thread

    def run(self) -> None:
        """Runs the world until it is told to stop."""
        try:
            self._busy = time.monotonic()
            for drop in self.first:
                self._drop(drop)
            self._busy = None
            self._publish(self._tell_state())
            self._keep()
        finally:
            self._busy = None
            self.stop()
            with self._lock:
                for listener in self._listeners:
                    with suppress(queue.Full):
                        listener.put_nowait(None)
            while not self._wishes.empty():
                self._wishes.get()[1].set_exception(InputError("the world has ended"))

    def _keep(self) -> None:
        due = last = told = time.monotonic()
        while not self._stopped.is_set():
            now = time.monotonic()
            resting = self._state.paused or (self.waits and not self._listeners)
            if resting or due > now:
                self._answer(_IDLE if resting else due - now)
                if resting:
                    due = last = time.monotonic()
                continue
            self._step()
            now = time.monotonic()
            real = SLICE / self._state.rate
            due = max(due + real, now - _LATE)
            # A mean over the last second or so.
            speed = SLICE / max(now - last, 1e-6) if now - last > 1.05 * real else self._state.rate
            share = min(1.0, max(now - last, real))
            self._state.speed += share * (speed - self._state.speed)
            last = now
            if now > told + _TOLD:
                told = now
                self._publish(self._tell_state())

    def _answer(self, patience: float) -> None:
        """Does what is asked for, or waits for that so long [s]."""
        try:
            wish, future = self._wishes.get(timeout=max(patience, 1e-3))
        except queue.Empty:
            return
        try:
            future.set_result(self._do(wish))
        except InputError as error:
            future.set_exception(error)
        self._publish(self._tell_state())

    def _step(self) -> None:
        self._busy = time.monotonic()
        trail = self.tank.advance(SLICE, EVERY)
        times, qpos = np.asarray(trail.time), np.asarray(trail.qpos)
        waited = self.busy > 0
        self._busy = None
        self.time = float(self.tank.time)
        rows = {}
        for one in self.inmates:
            own = qpos[:, : 7 + one.robot.num_hinges, one.place].astype("<f4")
            if np.isfinite(own).all():
                rows[one.key] = own
            else:
                self._remove(one)
                self._publish(_event("note", f"{one.name} has blown up, and was taken out"))
        self.qpos = {key: poses[-1] for key, poses in rows.items()}
        for k, moment in enumerate(times):
            self.recent.append((float(moment), {key: poses[k] for key, poses in rows.items()}))
        self._publish(_tell_poses(times, rows))
        if waited:
            self._publish(self._tell_state())

    # ------------------------------------------------------------------ wishes

    def _do(self, wish: Wish) -> Any:
        match wish:
            case Drop():
                return self._drop(wish)
            case Remove():
                for one in self.inmates:
                    if one.key == wish.key:
                        return self._remove(one)
                raise InputError(f"remove.key: expected a robot's; found {wish.key}")
            case Current():
                self._flow(wish.velocity)
            case Pause():
                self._state.paused = wish.on
            case Rate():
                self._state.rate = wish.factor
            case Reset():
                for one in self.inmates:
                    self._remove(one)
                self._flow(self.world.current)
                self._state.paused, self._state.rate = False, 1.0
                for drop in self.first:
                    self._drop(drop)
        return None

    def _flow(self, velocity: Any) -> None:
        self.tank.set_current(velocity)
        self._state.current = tuple(velocity)

    def _drop(self, wish: Drop) -> int:
        if wish.who >= len(self.stock):
            raise InputError(
                f"drop.who: expected a number below {len(self.stock)}; found {wish.who}"
            )
        entry = self.stock[wish.who]
        robot = entry.robot
        body = self.bodies.number(robot)
        x, y = self._free_place(wish.place or (0.0, 0.0), robot)
        z = self.world.surface_height - wish.depth
        if self.world.bed is not None:
            ground = float(bed_at(self.world.bed, np.array([x]), np.array([y]))[0])
            z = max(z, ground + 0.5 * robot.morphology.length)
        turn = self._random.uniform(-180, 180) if wish.heading is None else wish.heading
        half = math.radians(turn) / 2
        turned = (math.cos(half), 0.0, 0.0, math.sin(half))
        place = self.tank.add(robot, entry.genes(), (x, y, z), turned)
        key, self._count = self._count, self._count + 1
        self._named[entry.short] = number = self._named.get(entry.short, 0) + 1
        name = entry.short if number == 1 else f"{entry.short} #{number}"
        pose = np.zeros(7 + robot.num_hinges, "<f4")
        pose[:7] = x, y, z, *turned
        self.qpos[key] = pose
        self.inmates = (*self.inmates, Inmate(key, name, place, body, robot, self.time, (x, y, z)))
        self._publish(self._tell_cast())
        self._publish(_tell_poses([self.time], {key: pose[None]}))
        return key

    def _remove(self, one: Inmate) -> None:
        self.tank.remove(one.place)
        self.inmates = tuple(other for other in self.inmates if other is not one)
        self.qpos.pop(one.key, None)
        self._publish(self._tell_cast())

    def _free_place(self, place: tuple[float, float], robot: Robot) -> tuple[float, float]:
        """The place nearest to one that is clear of others, on a spiral around it."""
        length = robot.morphology.length
        taken = [
            (self.qpos[one.key][:2], _SPREAD * (length + one.robot.morphology.length))
            for one in self.inmates
            if one.key in self.qpos
        ]
        for k in range(2000):
            # Turns by the golden angle fill a disc evenly.
            r, angle = 0.3 * length * math.sqrt(k), 2.399963 * k
            x, y = place[0] + r * math.cos(angle), place[1] + r * math.sin(angle)
            if all(math.hypot(x - at[0], y - at[1]) >= far for at, far in taken):
                return x, y
        raise InputError(f"drop.place: expected a place with room around it; found {[*place]}")

    # ------------------------------------------------------------------ what is told

    def _publish(self, text: str) -> None:
        with self._lock:
            for listener in list(self._listeners):
                try:
                    listener.put_nowait(text)
                except queue.Full:  # it sleeps; its page will come again
                    self._listeners.remove(listener)
                    with suppress(queue.Empty):
                        listener.get_nowait()
                    listener.put_nowait(None)

    def _tell_state(self) -> str:
        state, moving = self._state, replace(self.world, current=self._state.current)
        return _event(
            "state",
            {
                "time": round(self.time, 4),
                "paused": state.paused,
                "rate": state.rate,
                "speed": round(state.speed, 3),
                "current": [*state.current],
                "busy": round(self.busy, 1),
                "waves": pack_waves(moving, 0.0),
            },
        )

    def _tell_cast(self) -> str:
        return _event(
            "cast",
            [
                {
                    "key": one.key,
                    "name": one.name,
                    "body": one.body,
                    "born": round(one.born, 3),
                    "start": [round(x, 4) for x in one.start],
                }
                for one in self.inmates
            ],
        )


def _tell_poses(times: Any, rows: dict[int, np.ndarray]) -> str:
    """Poses `[T, width]` by key, at times `[T]` [s]."""
    numbers = np.concatenate([x.ravel() for x in rows.values()]) if rows else np.zeros(0)
    return _event(
        "poses",
        {
            "t": [round(float(t), 4) for t in times],
            "keys": list(rows),
            "widths": [x.shape[1] for x in rows.values()],
            "q": base64.b64encode(numbers.astype("<f4").tobytes()).decode(),
        },
    )


def _event(name: str, data: Any) -> str:
    """A server-sent event."""
    return f"event: {name}\ndata: {json.dumps(data, separators=(',', ':'), allow_nan=False)}\n\n"
