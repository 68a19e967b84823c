"""A world that runs in real time, and the commands that change it.

Only the thread that calls `LiveSimulation.run` uses the world: two computations of XLA at once in
one process may deadlock. Other threads queue commands (`LiveSimulation.ask`) and read events
(`LiveSimulation.listen`).
"""

from __future__ import annotations

import base64
import json
import math
import queue
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.live.commands import Command, Current, Drop, Pause, Rate, Remove, Reset
from mjx_revolve.view.page_data import RobotMeshes
from mjx_revolve.view.surroundings import bed_at
from mjx_revolve.water.world import World

if TYPE_CHECKING:
    from mjx_revolve.episodes.tank import Tank

# The world is stepped in slices of this length, each with poses this far apart. A choice: commands
# are done within a tenth of a second, and between two poses motion is straight [s].
SLICE, EVERY = 0.1, 0.05
# Time that is lost beyond this is not made up for [s].
_MAX_LAG = 0.3
# A slice that takes longer than this must be compiling [s].
_COMPILING = 1.0
_REPORT = 0.5  # from one event of the world's state to the next [s]
_IDLE_INTERVAL = 0.2  # time between two checks of the queue, if there is nothing to do [s]
_BACKLOG = 100  # events that a listener may be behind; then it is dropped
_SPREAD = 0.6  # robots are dropped so far apart, in shares of their two lengths


class CatalogueEntry(NamedTuple):
    """A robot that may be dropped.

    Attributes:
        name: in a few words.
        short: its name in the water.
        group: where it comes from.
        robot: its body in the world.
        genes: finds the genes of its controller; None: it keeps still.
    """

    name: str
    short: str
    group: str
    robot: Robot
    genes: Callable[[], np.ndarray | None] = lambda: None


class LiveRobot(NamedTuple):
    """A robot in the water.

    Attributes:
        key: a number that no other robot ever has.
        name: shown beside it.
        slot: in the tank.
        body: index of its body in `LiveSimulation.meshes`.
        robot: its body.
        born: when it was dropped [s].
        start: where its core was then, world frame [m].
    """

    key: int
    name: str
    slot: int
    body: int
    robot: Robot
    born: float
    start: tuple[float, float, float]


class LiveSimulation:
    """Runs a tank in real time.

    Attributes:
        world: of the tank.
        catalogue: robots that may be dropped.
        meshes: of all robots that were ever dropped.
        robots: those in the water.
        qpos: their newest poses, by key.
        time: of these [s].
        paused: whether time stands still.
        rate: seconds in the water for each real one [-].
        current: the water's velocity, as it was last set [m/s].
    """

    def __init__(
        self,
        tank: Tank,
        world: World,
        catalogue: Sequence[CatalogueEntry],
        first: Sequence[Drop] = (Drop(0),),
    ) -> None:
        """Prepares a simulation.

        Args:
            tank: used by nothing else from now on.
            world: of the tank.
            catalogue: robots that may be dropped.
            first: robots in the water at the beginning.
        """
        self.world, self.catalogue, self.meshes = world, catalogue, RobotMeshes()
        self.robots: tuple[LiveRobot, ...] = ()
        self.qpos: dict[int, np.ndarray] = {}
        self.time, self.paused, self.rate = 0.0, False, 1.0
        self.current: tuple[float, float, float] = world.current
        self._tank, self._first = tank, first
        self._speed = 0.0  # the rate that is kept up [-]
        self._slice_since: float | None = None  # when the present slice began
        self._stopped = threading.Event()
        self._commands: queue.Queue[tuple[Command, Future[int | None]]] = queue.Queue()
        self._listeners: list[queue.Queue[str | None]] = []
        self._lock = threading.Lock()
        self._count = 0  # of all robots that were ever dropped
        self._names: dict[str, int] = {}  # how many of each name
        self._random = np.random.default_rng()

    # ------------------------------------------------------------------ from any thread

    def ask(self, command: Command) -> Future[int | None]:
        """Queues a command.

        Args:
            command: what to do.

        Returns:
            Of a `Drop` the robot's key, of others None; or an `InputError`.
        """
        future: Future[int | None] = Future()
        self._commands.put((command, future))
        return future

    def listen(self) -> queue.Queue[str | None]:
        """Events from now on, as they are sent, after those that say what there is; None ends."""
        listener: queue.Queue[str | None] = queue.Queue(_BACKLOG)
        with self._lock:
            there = {key: pose[None] for key, pose in dict(self.qpos).items()}
            listener.put(self.state_event())
            listener.put(self._bodies_event({one.body for one in self.robots}))
            listener.put(self._cast_event())
            if there:
                listener.put(_poses_event([self.time], there))
            self._listeners.append(listener)
            if self.ended:
                listener.put(None)
        return listener

    def leave(self, listener: queue.Queue[str | None]) -> None:
        """Sends a listener no more events."""
        with self._lock, suppress(ValueError):
            self._listeners.remove(listener)

    def stop(self) -> None:
        """Ends `run` after the slice that is being stepped."""
        self._stopped.set()

    @property
    def ended(self) -> bool:
        """Whether the world has ended, or is about to."""
        return self._stopped.is_set()

    @property
    def busy(self) -> float:
        """How long the present slice has been taking; 0 where that is not long [s]."""
        since = self._slice_since
        took = 0.0 if since is None else time.monotonic() - since
        return took if took > _COMPILING else 0.0

    def state_event(self) -> str:
        """The event with the state that all pages show."""
        state = {
            "time": round(self.time, 4),
            "paused": self.paused,
            "rate": self.rate,
            "speed": round(self._speed, 3),
            "current": [*self.current],
            "busy": round(self.busy, 1),
        }
        return _event("state", state)

    # ------------------------------------------------------------------ in its own thread

    def run(self) -> None:
        """Runs the world until `stop`."""
        try:
            self._slice_since = time.monotonic()
            for drop in self._first:
                self._drop(drop)
            self._slice_since = None
            self.publish(self.state_event())
            self._loop()
        finally:
            self._slice_since = None
            self.stop()
            with self._lock:
                for listener in self._listeners:
                    with suppress(queue.Full):
                        listener.put_nowait(None)
            while not self._commands.empty():
                self._commands.get()[1].set_exception(InputError("the world has ended"))

    def _loop(self) -> None:
        due = last = reported = time.monotonic()
        while not self.ended:
            now = time.monotonic()
            resting = self.paused or not self._listeners
            # A world that is slower than its pace listens, too.
            if resting or due > now or not self._commands.empty():
                self._answer(_IDLE_INTERVAL if resting else due - now)
                if resting:
                    due = last = time.monotonic()
                continue
            self._step()
            now = time.monotonic()
            real = SLICE / self.rate
            due = max(due + real, now - _MAX_LAG)
            # A mean over the last second or so.
            speed = SLICE / max(now - last, 1e-6) if now - last > 1.05 * real else self.rate
            self._speed += min(1.0, max(now - last, real)) * (speed - self._speed)
            last = now
            if now > reported + _REPORT:
                reported = now
                self.publish(self.state_event())

    def _answer(self, timeout: float) -> None:
        """Does the next command, or waits for one so long [s]."""
        try:
            command, future = self._commands.get(timeout=max(timeout, 1e-3))
        except queue.Empty:
            return
        try:
            future.set_result(self._do(command))
        except InputError as error:
            future.set_exception(error)
        self.publish(self.state_event())

    def _step(self) -> None:
        self._slice_since = time.monotonic()
        trajectory = self._tank.advance(SLICE, EVERY)
        times, qpos = np.asarray(trajectory.time), np.asarray(trajectory.qpos)
        waited = self.busy > 0
        self._slice_since = None
        self.time = float(self._tank.time)
        rows = {}
        for one in self.robots:
            own = qpos[:, : 7 + one.robot.num_hinges, one.slot].astype("<f4")
            if np.isfinite(own).all():
                rows[one.key] = own
            else:
                self._remove(one)
                self.publish(_event("note", f"{one.name} has blown up, and was taken out"))
        self.qpos = {key: poses[-1] for key, poses in rows.items()}
        self.publish(_poses_event(times, rows))
        if waited:
            self.publish(self.state_event())

    # ------------------------------------------------------------------ commands

    def _do(self, command: Command) -> int | None:
        match command:
            case Drop():
                return self._drop(command)
            case Remove():
                found = [one for one in self.robots if one.key == command.key]
                if not found:
                    raise InputError("remove.key", "a robot's", command.key)
                self._remove(found[0])
            case Current():
                self._set_current(command.velocity)
            case Pause():
                self.paused = command.on
            case Rate():
                self.rate = command.factor
            case Reset():
                for one in self.robots:
                    self._remove(one)
                self._names.clear()
                self._set_current(self.world.current)
                self.paused, self.rate = False, 1.0
                for drop in self._first:
                    self._drop(drop)
        return None

    def _set_current(self, velocity: tuple[float, float, float]) -> None:
        self._tank.set_current(velocity)
        self.current = velocity

    def _drop(self, command: Drop) -> int:
        if command.entry >= len(self.catalogue):
            raise InputError("drop.entry", f"a number below {len(self.catalogue)}", command.entry)
        entry = self.catalogue[command.entry]
        robot = entry.robot
        body = self.meshes.add(robot)
        x, y = self._free_place(command.place or (0.0, 0.0), robot)
        z = self.world.surface_height - command.depth
        if self.world.bed is not None:
            ground = float(bed_at(self.world.bed, np.array([x]), np.array([y]))[0])
            z = max(z, ground + 0.5 * robot.morphology.length)
        turn = self._random.uniform(-180, 180) if command.heading is None else command.heading
        half = math.radians(turn) / 2
        quat = (math.cos(half), 0.0, 0.0, math.sin(half))
        slot = self._tank.add(robot, entry.genes(), (x, y, z), quat)
        key, self._count = self._count, self._count + 1
        self._names[entry.short] = number = self._names.get(entry.short, 0) + 1
        name = entry.short if number == 1 else f"{entry.short} #{number}"
        pose = np.zeros(7 + robot.num_hinges, "<f4")
        pose[:7] = x, y, z, *quat
        self.qpos[key] = pose
        self.robots += (LiveRobot(key, name, slot, body, robot, self.time, (x, y, z)),)
        self.publish(self._bodies_event({body}))
        self.publish(self._cast_event())
        self.publish(_poses_event([self.time], {key: pose[None]}))
        return key

    def _remove(self, one: LiveRobot) -> None:
        self._tank.remove(one.slot)
        self.robots = tuple(other for other in self.robots if other is not one)
        self.qpos.pop(one.key, None)
        self.publish(self._cast_event())

    def _free_place(self, place: tuple[float, float], robot: Robot) -> tuple[float, float]:
        """The place nearest to one that is clear of other robots, on a spiral around it."""
        length = robot.morphology.length
        taken = [
            (self.qpos[one.key][:2], _SPREAD * (length + one.robot.morphology.length))
            for one in self.robots
            if one.key in self.qpos
        ]
        for k in range(2000):
            # Turns by the golden angle fill a disc evenly.
            r, angle = 0.3 * length * math.sqrt(k), 2.399963 * k
            x, y = place[0] + r * math.cos(angle), place[1] + r * math.sin(angle)
            if all(math.hypot(x - at[0], y - at[1]) >= far for at, far in taken):
                return x, y
        raise InputError("drop.place", "a place with room around it", [*place])

    # ------------------------------------------------------------------ events

    def publish(self, text: str) -> None:
        """Sends an event to all listeners; one that is too far behind is dropped."""
        with self._lock:
            for listener in list(self._listeners):
                try:
                    listener.put_nowait(text)
                except queue.Full:  # its page is suspended, and will connect again
                    self._listeners.remove(listener)
                    with suppress(queue.Empty):
                        listener.get_nowait()
                    listener.put_nowait(None)

    def _bodies_event(self, numbers: set[int]) -> str:
        """Bodies with the shapes of their pieces, before the first robot that has them."""
        bodies = []
        for number in sorted(numbers):
            body = self.meshes.bodies[number]
            shapes = {piece[1]: self.meshes.shapes[piece[1]] for piece in body["pieces"]}
            bodies.append({"number": number, **body, "shapes": shapes})
        return _event("bodies", bodies)

    def _cast_event(self) -> str:
        cast = [
            {
                "key": one.key,
                "name": one.name,
                "body": one.body,
                "born": round(one.born, 3),
                "start": [round(x, 4) for x in one.start],
            }
            for one in self.robots
        ]
        return _event("cast", cast)


def _poses_event(times: Iterable[float], rows: dict[int, np.ndarray]) -> str:
    """Poses `[T, width]` by key, at times `[T]` [s]."""
    numbers = np.concatenate([x.ravel() for x in rows.values()]) if rows else np.zeros(0)
    poses = {
        "t": [round(float(t), 4) for t in times],
        "keys": list(rows),
        "widths": [x.shape[1] for x in rows.values()],
        "q": base64.b64encode(numbers.astype("<f4").tobytes()).decode(),
    }
    return _event("poses", poses)


def _event(name: str, data: object) -> str:
    """A server-sent event."""
    return f"event: {name}\ndata: {json.dumps(data, separators=(',', ':'), allow_nan=False)}\n\n"
