"""Tasks: starts, records and scores of episodes.

A `Task` owns all properties of a task; no other code depends on its name. A user's own task is a
`Task`, or a function that scores, in a file of theirs: see `find_task`.
"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.plant import BodyGeometry, body_geometry
from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.config import TaskConfig
from mjx_revolve.episodes.measure_table import MEASURES, records_of
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.user_code import (
    call_user_function,
    function_place,
    load_user_function,
    short_name,
)
from mjx_revolve.numerics.spatial import Scalar, safe_norm
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.world import World

# Optional records of a track, beside the core's position and the energy: see `Track`.
RECORDS = ("core", "joints", "contacts", "forces", "water", "target", "course")
# Number of times up to the horizon at which the depth is extrapolated. A choice.
_MOMENTS = 16
# For a record: the settings of which one must be given.
_GIVEN = {"target": ("target", "target_distance"), "course": ("course_spread",)}


@jax.tree_util.register_dataclass
@dataclass(frozen=True)
class Track:
    """An episode of many individuals, sampled at equal intervals after the settling time.

    Attributes:
        position: `[S, 3, lanes]` the robot's place, its `task.point` (the centre of mass, or the
            core), world frame [m]; the first row is where counting starts.
        clearance: `[S, lanes]` height of that point above the bed, infinite without one [m].
        energy: `[S, lanes]` work of servos and propellers since the row before, without sign [J].
        interval: time between rows [s].
        start_height: height of that point at the episode's start, world frame [m].
        length: body length, stretched out or at rest as `task.length` says [m].
        weight: of the robot in air [N].
        surface_height: [m].
        num_hinges: of the robot; a batch of different bodies has rows for more.
        quat: `[S, 4, lanes]` of the core, world from body (w, x, y, z); None unless "core" is
            recorded.
        velocity: `[S, 3, lanes]` of the core, world frame [m/s]; with quat.
        spin: `[S, 3, lanes]` angular velocity of the core, body frame [rad/s]; with quat.
        angle: `[S, nhinge, lanes]` of the hinges, the robot's order [rad]; None unless "joints" are
            recorded.
        speed: `[S, nhinge, lanes]` of the hinges [rad/s]; with angle.
        bed_force: `[S, 3, lanes]` of the bed on the robot, world frame [N]; None unless "contacts"
            are recorded.
        water_force: `[S, 3, lanes]` of the water on the robot, buoyancy included, the inertia of
            carried water not, world frame [N]; None unless "forces" are recorded.
        water_velocity: `[S, 3, lanes]` of the water at that place, as if the robot were not
            there, world frame [m/s]; None unless "water" is recorded.
        target: `[S, 3, lanes]` where the target is, world frame [m]; None unless "target" is
            recorded and there is one.
        course: `[S, 3, lanes]` the direction to keep to, a unit vector, world frame; None unless
            "course" is recorded and there is one.
    """

    position: jax.Array
    clearance: jax.Array
    energy: jax.Array
    interval: float = field(metadata={"static": True})
    start_height: jax.Array
    length: float
    weight: float
    surface_height: jax.Array | float
    num_hinges: jax.Array | float = 0
    quat: jax.Array | None = None
    velocity: jax.Array | None = None
    spin: jax.Array | None = None
    angle: jax.Array | None = None
    speed: jax.Array | None = None
    bed_force: jax.Array | None = None
    water_force: jax.Array | None = None
    water_velocity: jax.Array | None = None
    target: jax.Array | None = None
    course: jax.Array | None = None

    @property
    def duration(self) -> float:
        """Counted time [s]."""
        return self.interval * (self.position.shape[0] - 1)


def start_at_depth(
    settings: TaskConfig, world: World, figure: BodyGeometry, place: jax.Array
) -> jax.Array:
    """The core at the task's depth below the still surface.

    Args:
        settings: of the task.
        world: the world.
        figure: of the robots, `[lanes]` or one.
        place: `[3, lanes]` drawn around 0 [m].

    Returns:
        `[3, lanes]` where the cores start, world frame [m].
    """
    return place.at[2].add(world.surface_height - settings.depth)


def start_on_bed(
    settings: TaskConfig, world: World, figure: BodyGeometry, place: jax.Array
) -> jax.Array:
    """The lowest corner 5 mm above the bed, see `reach_below`; arguments of `start_at_depth`.

    Above the highest of the bed around: at the core's place, and at half and whole its radius.
    """
    assert world.bed is not None
    angles = np.linspace(0, 2 * np.pi, 16, endpoint=False)
    around = np.outer([np.cos(angles), np.sin(angles)], [0.5, 1.0]).reshape(2, -1)
    around = np.concatenate([np.zeros((2, 1)), around], 1)
    radius = jnp.asarray(figure.radius)[..., None]
    x, y = (place[k][..., None] + radius * around[k] for k in range(2))
    top = jnp.max(bed_height(world.bed, x, y), -1)
    return place.at[2].set(top + reach_below(settings, figure) + 0.005)


def start_above_bed(
    settings: TaskConfig, world: World, figure: BodyGeometry, place: jax.Array
) -> jax.Array:
    """The core at the task's height above the bed; arguments of `start_at_depth`."""
    assert world.bed is not None
    return place.at[2].set(bed_height(world.bed, place[0], place[1]) + settings.height)


def reach_below(settings: TaskConfig, figure: BodyGeometry) -> Scalar:
    """How far the rest pose reaches below the core's centre, in any attitude drawn [m].

    Of all tilts up to three standard deviations, taken for the largest.
    """
    tilt = min(3 * settings.start_tilt, np.pi / 2)
    lowest, radius = jnp.asarray(figure.lowest), jnp.asarray(figure.radius)
    beyond = radius * np.cos(tilt) < lowest * np.sin(tilt)  # the deepest tilt is a smaller one
    farthest = jnp.sqrt(lowest**2 + radius**2)
    return jnp.where(beyond, farthest, lowest * np.cos(tilt) + radius * np.sin(tilt))


@dataclass(frozen=True)
class Task:
    """A task.

    Attributes:
        score: (track, settings) → `[lanes]` scores, higher is better.
        unit: of the scores.
        records: optional fields of the track that the score depends on, of `RECORDS`.
        start: start position of episodes, like `start_at_depth`.
        on_bed: whether episodes begin on the bed, so that there must be one.
        measure: the measure that reports show beside the score.
        point: the point of `Track.position`; that of `task.point`, whatever is given here.
    """

    score: Callable[[Track, TaskConfig], jax.Array]
    unit: str = ""
    records: tuple[str, ...] = ()
    start: Callable[[TaskConfig, World, BodyGeometry, jax.Array], jax.Array] = start_at_depth
    on_bed: bool = False
    measure: str = "speed_m_s"
    point: str = "core"

    def __post_init__(self) -> None:
        """Checks the fields that users set."""
        for name in self.records:
            if name not in RECORDS:
                raise InputError("records", f"any of {', '.join(RECORDS)}", repr(name))
        if self.measure not in MEASURES:
            raise InputError("measure", f"one of {', '.join(MEASURES)}", repr(self.measure))


def _keeping(error: jax.Array, tolerance: float) -> jax.Array:
    """1 within the tolerance, 0 beyond twice it, a smooth step between."""
    beyond = jnp.clip(jnp.abs(error) / tolerance - 1, 0, 1)
    return 1 - beyond * beyond * (3 - 2 * beyond)


def _keeps_depth(track: Track, settings: TaskConfig) -> jax.Array:
    """`[S - 1, lanes]` share of each interval's progress that counts."""
    middle = (track.position[1:, 2] + track.position[:-1, 2]) / 2
    return _keeping(middle - track.start_height, settings.depth_tolerance)


def _along(way: jax.Array, settings: TaskConfig) -> jax.Array:
    """The part along the task's direction, of ways or velocities with x, y and maybe z first."""
    direction = np.asarray(settings.direction, float) / np.linalg.norm(settings.direction)
    return reduce(jnp.add, (float(u) * x for u, x in zip(direction, way, strict=False)))


def _counted(along: jax.Array, kept: jax.Array) -> jax.Array:
    """What counts of a way along a direction: ahead what was made in place, back the whole.

    Otherwise a robot that leaves its depth would lose nothing in a current that sweeps it away.
    """
    return jnp.where(along > 0, kept, along)


def _progress(track: Track, along: jax.Array, kept: jax.Array) -> jax.Array:
    """What counts of ways along a direction, `[S - 1, lanes]` [m], as a speed [body lengths/s]."""
    return jnp.sum(_counted(along, kept), 0) / (track.duration * track.length)


def moved_through_water(track: Track) -> jax.Array:
    """`[S - 1, 3, lanes]` the robot's way from row to row, less that of the water around it [m]."""
    assert track.water_velocity is not None
    water = (track.water_velocity[1:] + track.water_velocity[:-1]) / 2
    return jnp.diff(track.position, axis=0) - track.interval * water


def directed_swim(track: Track, settings: TaskConfig) -> jax.Array:
    """Progress along a direction, over ground, while the robot keeps its depth [body lengths/s].

    What is lost counts at any depth. With a `horizon`, over that time, if the motion is continued:
    see `_foretold`.
    """
    moved = jnp.diff(track.position, axis=0)
    if settings.horizon is not None:
        return _counted(*(_along(v, settings) for v in _foretold(track, settings, moved[:, :2])))
    along = _along(jnp.swapaxes(moved, 0, 1), settings)
    return _progress(track, along, along * _keeps_depth(track, settings))


def speed(track: Track, settings: TaskConfig) -> jax.Array:
    """Net horizontal speed through the water while the robot keeps its depth [body lengths/s].

    In any direction; drift with a current does not count, and what is lost counts at any depth.
    With a `horizon`, net over that time, if the motion is continued: see `_foretold`.
    """
    moved = moved_through_water(track)[:, :2]
    if settings.horizon is not None:
        return safe_norm(tuple(_foretold(track, settings, moved)[1]))
    # Along the way that is made at its depth: a loop with its lower half off it goes nowhere.
    keeps = _keeps_depth(track, settings)
    net = jnp.sum(moved * keeps[:, None], 0)
    along = jnp.sum(moved * net, 1) / jnp.maximum(safe_norm(tuple(net)), 1e-9)
    return jnp.maximum(_progress(track, along, along * keeps), 0.0)


def _foretold(track: Track, settings: Any, moved: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Horizontal net velocity over the horizon, extrapolated from the track's halves.

    From one half to the next a robot turns by ψ and rises by some height. n displacements d, each
    turned by ψ from the one before, have the sum d sin(nψ/2) / sin(ψ/2), turned by (n - 1) ψ/2 from
    the first: 0 for full circles. Halves are equal, and follow each other: of an odd number of
    intervals the last is left out.

    Returns:
        `[2, lanes]` each [body lengths/s]: of the whole way, and of that at its depth.
    """
    half = max(1, moved.shape[0] // 2)
    begins = 0, min(half, moved.shape[0] - half)
    first, second = (jnp.sum(moved[k : k + half], 0) for k in begins)
    way = (safe_norm(tuple(first)) + safe_norm(tuple(second))) / 2
    ahead = first[0] * second[0] + first[1] * second[1]
    aside = first[0] * second[1] - first[1] * second[0]
    # Where nothing moves there is no angle, and no derivative of it.
    angle = lambda y, x: jnp.arctan2(y, x + jnp.where((x == 0) & (y == 0), 1.0, 0.0))  # noqa: E731
    turn = angle(aside, ahead) / 2
    count = settings.horizon / (half * track.interval)
    straight = jnp.sinc(count * turn / np.pi) / jnp.sinc(turn / np.pi)
    heading = angle(first[1], first[0]) + (count - 1) * turn
    height = track.position[:, 2] - track.start_height
    begun, ended = (jnp.mean(height[k : k + half + 1], 0) for k in begins)
    heights = begun + np.linspace(0, 1, _MOMENTS)[:, None] * count * (ended - begun)
    keeps = jnp.mean(_keeping(heights, settings.depth_tolerance), 0)
    towards = jnp.stack([jnp.cos(heading), jnp.sin(heading)])
    unit = half * track.interval * track.length
    return way * straight / unit * towards, way * straight * keeps / unit * towards


def reach_target(track: Track, settings: TaskConfig) -> jax.Array:
    """How much nearer to the target the robot ends than it began [body lengths]."""
    fixed = None if settings.target is None else np.asarray(settings.target, float)

    def away_at(k: int) -> jax.Array:
        target = fixed if track.target is None else track.target[k]
        assert target is not None
        return safe_norm(tuple(track.position[k][i] - target[i] for i in range(3)))

    away = away_at(0), away_at(-1)
    return (away[0] - away[1]) / track.length


def _left_of_way(track: Track, settings: TaskConfig) -> jax.Array:
    """`[S, lanes]` least distance to the target so far, as a share of the first distance.

    1 until the robot comes nearer, 0 from the time at which it touches the target.
    """
    assert track.target is not None
    away = safe_norm(tuple(track.position[:, i] - track.target[:, i] for i in range(3)))
    beyond = jnp.maximum(away - settings.touch, 0.0)
    return jax.lax.cummin(beyond) / jnp.maximum(beyond[0], 1e-6)


def search(track: Track, settings: TaskConfig) -> jax.Array:
    """The share of the way to the target that is covered, on average over time [of the way].

    At each time the largest share so far: coming near once is enough, and touching the target
    sooner scores more. 1 would be to touch it at once.
    """
    return 1 - jnp.mean(_left_of_way(track, settings), 0)


def escape(track: Track, settings: TaskConfig) -> jax.Array:
    """The pursuer's least distance so far, on average over time [of the first distance].

    1 if the pursuer never comes nearer than at the start. 0 counts from the time at which it
    touches the robot, and while the robot is off its depth: diving away would take no sensors.
    """
    keeps = _keeping(track.position[:, 2] - track.start_height, settings.depth_tolerance)
    return jnp.mean(_left_of_way(track, settings) * keeps, 0)


def follow_course(track: Track, settings: TaskConfig) -> jax.Array:
    """Progress along a course that turns, over ground, at its depth [body lengths/s]."""
    assert track.course is not None
    moved = jnp.diff(track.position, axis=0)
    # At a sudden turn, the mean of the courses before and after counts.
    course = (track.course[1:] + track.course[:-1]) / 2
    along = jnp.sum(moved * course, 1)
    return _progress(track, along, along * _keeps_depth(track, settings))


def hold_depth(track: Track, settings: TaskConfig) -> jax.Array:
    """Minus the root mean square distance from the start's depth [body lengths]."""
    error = (track.position[:, 2] - track.start_height) / track.length
    # The tiny term keeps the gradient finite where the error is 0.
    return -jnp.sqrt(jnp.mean(error * error, 0) + 1e-12)


def hold_heading(track: Track, settings: TaskConfig) -> jax.Array:
    """Minus the root mean square errors of depth and of heading, added up [body lengths + rad].

    Heading is the direction of the core's x axis seen from above; its target is `direction`.
    """
    assert track.quat is not None
    w, x, y, z = (track.quat[:, i] for i in range(4))
    ahead, aside = w * w + x * x - y * y - z * z, 2 * (x * y + w * z)
    # The tiny term: the heading of a core with x upright is undefined, and so is its gradient.
    level = np.asarray(settings.direction, float)[:2]
    level = level / max(np.linalg.norm(level), 1e-9)
    cosine, sine = float(level[0]), float(level[1])
    across, along = cosine * aside - sine * ahead, cosine * ahead + sine * aside
    error = jnp.arctan2(across, along + jnp.where(along == 0, 1e-9, 0))
    return hold_depth(track, settings) - jnp.sqrt(jnp.mean(error * error, 0) + 1e-12)


def follow_bed(track: Track, settings: Any) -> jax.Array:
    """Progress along a direction while the robot keeps a height above the bed [body lengths/s]."""
    height = track.clearance - settings.height
    return crawl(replace(track, clearance=height), settings)


def crawl(track: Track, settings: TaskConfig) -> jax.Array:
    """Progress along a direction while the robot stays near the bed [body lengths/s]."""
    along = _along(jnp.swapaxes(jnp.diff(track.position, axis=0), 0, 1), settings)
    middle = (track.clearance[1:] + track.clearance[:-1]) / 2
    return _progress(track, along, along * _keeping(middle, settings.depth_tolerance))


_SPEED = "body lengths/s"
TASKS: Mapping[str, Task] = {
    "directed_swim": Task(directed_swim, _SPEED),
    "speed": Task(speed, _SPEED, records=("water",)),
    "reach_target": Task(reach_target, "body lengths", records=("target",)),
    "hold_depth": Task(hold_depth, "body lengths", measure="depth_error_m"),
    "hold_heading": Task(hold_heading, "body lengths + rad", records=("core",)),
    "follow_course": Task(follow_course, _SPEED, records=("course",)),
    "search": Task(search, "of the way", records=("target",)),
    "escape": Task(escape, "of the first distance", records=("target",)),
    "follow_bed": Task(follow_bed, _SPEED, start=start_above_bed, on_bed=True),
    "crawl": Task(crawl, _SPEED, start=start_on_bed, on_bed=True),
}
"""The tasks by their names in configurations."""


def find_task(settings: TaskConfig, source: str = "config") -> Task:
    """The task that a configuration names, with the records of its `measures`.

    Args:
        settings: a `config.TaskConfig`. Its `type` is a name in `TASKS`, or FILE.py:NAME for one of
            the user's own: a `Task`, or a function that takes a `Track` and these settings and
            returns `[lanes]` scores, higher is better, by JAX, so that it can be compiled. A
            function says its unit in brackets in the first line of its docstring, as ours do:
            `Mean height above the bed [body lengths].`
        source: what messages call the configuration.

    Returns:
        The task.

    Raises:
        InputError: the file or the name is missing, or it does not score a track; one line says
            where.
    """
    name = settings.type
    task = TASKS[name] if name in TASKS else _load_task(name, f"{source}: task.type")
    for record, fields in _GIVEN.items():
        if record in task.records and all(getattr(settings, field) is None for field in fields):
            what = f"{' or '.join(fields)}, as {short_name(name)} records the {record}"
            raise InputError(f"{source}: task", what, "none")
    records = dict.fromkeys((*task.records, *records_of(settings.measures)))
    task = replace(task, records=tuple(records), point=settings.point)
    if settings.unit == "m":
        unit = score_unit(name, "m")
        if unit == task.unit:
            reason = f"as the scores of {short_name(name)} do not say that they are in body lengths"
            raise InputError(f"{source}: task.unit", f"body_lengths, {reason}", "m")
        task = replace(task, score=partial(_score_in_metres, task.score), unit=unit)
    if name in TASKS:
        return task
    try:
        expected, example = f"{short_name(name)} to score a track", _example_track(task.records)
        found = call_user_function(
            name, expected, jax.eval_shape, lambda track: task.score(track, settings), example
        )
    except InputError as error:
        if "NoneType" not in str(error):
            raise
        hint = "what it reads of joints, forces and more it records"
        raise InputError(f'{error}; {hint}: Task(score, records=("joints",))') from None
    if not isinstance(found, jax.ShapeDtypeStruct) or found.shape != (_LANES,):
        shown = list(found.shape) if isinstance(found, jax.ShapeDtypeStruct) else type(found)
        each = f"a score for each lane, [{_LANES}] for a position of [{_ROWS}, 3, {_LANES}]"
        raise InputError(function_place(name), each, shown)
    return task


def _score_in_metres(score: Callable, track: Track, settings: TaskConfig) -> jax.Array:
    """The score of a body of length 1 m."""
    return score(replace(track, length=1.0), settings)


def _load_task(name: str, label: str) -> Task:
    found = load_user_function(name, label, Task)
    if isinstance(found, Task):
        return found
    units = re.findall(r"\[([^\[\]]+)\]", (inspect.getdoc(found) or "").partition("\n")[0])
    return Task(found, units[-1] if units else "")


# Distinct numbers, so that a confusion of axes causes an error.
_ROWS, _LANES, _HINGES = 7, 3, 5


def _example_track(records: tuple[str, ...]) -> Any:
    """The shapes of a track."""

    def given(*shape: int) -> Any:
        return jax.ShapeDtypeStruct(shape, jnp.float32)

    of = {"core": ("quat", "velocity", "spin"), "joints": ("angle", "speed")}
    of |= {"contacts": ("bed_force",), "forces": ("water_force",), "water": ("water_velocity",)}
    of |= {"target": ("target",), "course": ("course",)}
    wide = {"quat": 4, "angle": _HINGES, "speed": _HINGES}
    more = {field: given(_ROWS, wide.get(field, 3), _LANES) for r in records for field in of[r]}
    return Track(
        position=given(_ROWS, 3, _LANES),
        clearance=given(_ROWS, _LANES),
        energy=given(_ROWS, _LANES),
        interval=0.1,
        start_height=given(_LANES),
        length=0.5,
        weight=1.0,
        surface_height=0.0,
        num_hinges=_HINGES,
        **more,
    )


def _find_task(name: str) -> Task | None:
    """The task of a `type`; None where it cannot be read."""
    try:
        return TASKS[name] if name in TASKS else _load_task(name, "task.type")
    except InputError:
        return None


def body_length(robot: Robot, settings: TaskConfig | None) -> float:
    """Body length in which a task counts; without a task, that at rest [m]."""
    if settings is None or settings.length == "rest":
        return robot.morphology.length
    return float(body_geometry(robot).stretched)


COLONY_FITNESS = "fitness in the colony"
"""What stands where the unit of a colony's own scores would."""


def score_unit(name: str, unit: str = "body_lengths") -> str:
    """Unit of the scores of a task's `type` and `unit`; "" where it is not known."""
    task = _find_task(name)
    found = "" if task is None else task.unit
    return found.replace("body lengths", "m") if unit == "m" else found


def shown_measure(name: str, unit: str = "body_lengths") -> str:
    """Name of the measure that reports show beside the score of a task's `type` and `unit`."""
    task = _find_task(name)
    found = Task.measure if task is None else task.measure
    return "speed_bl_s" if (found, unit) == ("speed_m_s", "m") else found
