"""One HTML file that replays a colony: robots that are born, live beside each other, and die.

The page looks like the viewer's and needs nothing but itself. Of each robot it keeps qpos at some
moments, rounded and as differences from one to the next, which zlib then packs: a pose of the
shipped robots takes some 18 bytes of the page. Long runs of many robots keep fewer moments, so that
a page stays small enough to be sent: 64 robots for three hours, two poses a second, take 24 MB.
"""

from __future__ import annotations

import base64
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import PAGES, check_name, write_atomic
from mjx_revolve.view.course import nearer_signs
from mjx_revolve.view.packed import pack_water
from mjx_revolve.view.shoal_data import Bodies
from mjx_revolve.view.viewer import fill_page

# What a page keeps of places [m], quaternions [-] and hinges [rad]: less than can be seen. Choices.
_STEPS = (1e-3, 5e-4, 2e-3)
# A page that a browser opens without a wait, and most mail takes. A choice [bytes].
_MOST = 24_000_000
# Poses that are closer than this are none the smoother [s].
_CLOSEST = 0.02
_TRIES = 12  # at guessing how many poses fit


@dataclass(frozen=True, eq=False)
class Actor:
    """A robot on the page.

    Attributes:
        name: what the page calls it.
        robot: its body; robots that share one `Robot` share its meshes, too.
        time: `[T]` when its poses are, rising, in the colony's time [s]; poses between are
            interpolated.
        qpos: `[T, 7 + num_hinges]` its poses, MuJoCo's order, world frame.
        start: when it appears [s]; None: with its first pose.
        end: when it vanishes [s]; None: it lives on.
        info: what the page says of it when it is followed: words or numbers by name, as
            `{"parents": "3 and 7", "energy": 12.5}`.
    """

    name: str
    robot: Robot
    time: np.ndarray
    qpos: np.ndarray
    start: float | None = None
    end: float | None = None
    info: Mapping[str, str | float] = field(default_factory=dict)


@dataclass(frozen=True)
class Mark:
    """A place on the page: a charger, say, or where robots are born.

    Attributes:
        name: what the page calls it.
        place: of its middle, world frame [m].
        radius: of the ring around it, level [m].
    """

    name: str
    place: tuple[float, float, float]
    radius: float


@dataclass(frozen=True)
class Written:
    """What a page holds.

    Attributes:
        bytes: its size.
        poses: that it keeps.
        gap: least time between two poses of a robot, outside of the window; 0: all [s].
    """

    bytes: int
    poses: int
    gap: float


def write_colony_page(
    actors: Sequence[Actor],
    path: str | Path,
    title: str,
    *,
    marks: Sequence[Mark] = (),
    leap: float | None = None,
    window: tuple[float, float] | None = None,
    most: int = _MOST,
) -> Written:
    """Writes the replay of a colony as one HTML file.

    The file appears whole or not at all.

    Args:
        actors: all who ever lived, in one world.
        path: of the file, which ends in `.html`; its folder is made if need be.
        title: its heading.
        marks: places to show.
        leap: who is farther than this from its pose before has been put there, and is not seen on
            the way [m]; None: nobody is.
        window: from when to when no pose is left out, however large that makes the page [s].
        most: about how large the page may be [bytes]; where there are too many poses for that,
            each robot keeps those that are some time apart.

    Returns:
        What the page holds.

    Raises:
        InputError: `path` has another ending, there is no actor, or one of them has no poses that
            fit its body, or too many moving bodies.
        OSError: the file cannot be written.
    """
    path = check_name(path, PAGES)
    if not actors:
        raise InputError("actors: expected at least one robot to show; found none")
    for actor in actors:
        _check(actor)
    data = _scene(actors, marks) | {"leap": leap}
    bare = len(fill_page("colony.html", title=title, subtitle="", data=data).encode())
    poses, gap, packed = _fit(actors, window, max(most - bare, most // 50))
    data |= packed
    text = fill_page("colony.html", title=title, subtitle=_subtitle(actors, gap), data=data)
    content = text.encode()
    write_atomic(path, content)
    return Written(len(content), poses, gap)


def _check(actor: Actor) -> None:
    """Refuses poses that are not those of the body."""
    time, qpos = np.asarray(actor.time), np.asarray(actor.qpos)
    place = f"actor {actor.name!r}"
    width = 7 + actor.robot.num_hinges
    if time.ndim != 1 or len(time) == 0 or qpos.shape != (len(time), width):
        raise InputError(
            f"{place}: qpos: expected [T, {width}], a row for each of at least one time; found "
            f"{[*qpos.shape]} for times {[*time.shape]}"
        )
    if not (np.isfinite(time).all() and np.isfinite(qpos).all()):
        raise InputError(f"{place}: expected finite times and poses; found others")
    if (np.diff(time) <= 0).any():
        raise InputError(f"{place}: time: expected rising times; found others")


def _born(actor: Actor) -> float:
    return float(actor.time[0]) if actor.start is None else float(actor.start)


def _scene(actors: Sequence[Actor], marks: Sequence[Mark]) -> dict[str, Any]:
    """All that a page is given but for the poses."""
    world, bodies = actors[0].robot.world, Bodies()
    listed = [
        {
            "name": actor.name,
            "body": bodies.number(actor.robot),
            "start": round(_born(actor), 3),
            "end": None if actor.end is None else round(float(actor.end), 3),
            "info": {key: _word(value) for key, value in actor.info.items()},
        }
        for actor in actors
    ]
    places = np.concatenate([np.asarray(actor.qpos, float)[:, :3] for actor in actors])
    sizes = [actor.robot.morphology.length for actor in actors]
    begin = min(_born(actor) for actor in actors)
    last = max(float(actor.time[-1]) for actor in actors)
    last = max([last, *(float(actor.end) for actor in actors if actor.end is not None)])
    low = float(places[:, 2].min()) - 0.5 * max(sizes)
    return {
        "length": float(np.median(sizes)),
        "begin": begin,
        "last": last,
        "low": places.min(0).tolist(),
        "high": places.max(0).tolist(),
        "actors": listed,
        "shapes": bodies.shapes.packed,
        "bodies": bodies.data,
        "marks": [{"name": m.name, "place": [*m.place], "radius": m.radius} for m in marks],
        **pack_water(world, places, low),
    }


def _word(value: str | float) -> str:
    return value if isinstance(value, str) else f"{float(value):.4g}"


def _subtitle(actors: Sequence[Actor], gap: float) -> str:
    """How many, where, and how often."""
    world = actors[0].robot.world
    count = f"{len(actors)} robot{'s' if len(actors) > 1 else ''}"
    often = f"a pose of each every {gap:.2g} s" if gap > 0.1 else ""
    return " \u00b7 ".join(filter(None, (count, world.name.replace("_", " "), often)))


# --- poses ----------------------------------------------------------------------------------------


def _fit(
    actors: Sequence[Actor], window: tuple[float, float] | None, room: int
) -> tuple[int, float, dict[str, Any]]:
    """As many poses as fit: how many, how far apart [s], and packed."""
    gap, total = _CLOSEST, sum(len(actor.time) for actor in actors)
    usual = max((float(np.median(np.diff(a.time))) for a in actors if len(a.time) > 1), default=0.0)
    for _ in range(_TRIES):
        kept = [_thin(np.asarray(actor.time, float), gap, window) for actor in actors]
        packed = pack_poses(actors, kept)
        count, size = sum(map(len, kept)), len(packed["poses"])
        if size <= room:
            break
        gap = max(gap, usual) * max(1.1, size / room)
    return count, gap if count < total else 0.0, packed


def _thin(time: np.ndarray, gap: float, window: tuple[float, float] | None) -> np.ndarray:
    """Rows of times `[T]` that are some time apart [s], and the first and the last."""
    slot = np.floor((time - time[0]) / gap + 1e-6)
    kept = np.r_[True, np.diff(slot) > 0]
    kept[-1] = True
    if window is not None:
        kept |= (time >= window[0]) & (time <= window[1])
    return np.flatnonzero(kept)


def pack_poses(actors: Sequence[Actor], rows: Sequence[np.ndarray]) -> dict[str, Any]:
    """Poses of all robots as one text.

    Every number is rounded to a whole number of steps, and only how it differs from the pose
    before is kept, in two bytes: first the low ones, then the high ones, packed by zlib. Rounding
    does not add up. Times are kept as they are, in single precision.

    Args:
        actors: whose poses.
        rows: which of each one's.

    Returns:
        `poses`: the text; `steps`: what the numbers are counted in (places, quaternions, hinges);
        `origins`: of each actor's places [m]; `rows`: of each actor.
    """
    kept = [
        (np.asarray(actor.time, float)[own], np.asarray(actor.qpos, float)[own])
        for actor, own in zip(actors, rows, strict=True)
    ]
    # Differences must fit two bytes, at any speed.
    origins = [qpos[0, :3].round(3) for _, qpos in kept]
    farthest = max(np.abs(np.diff(q[:, :3], axis=0)).max(initial=0.0) for _, q in kept)
    steps = (max(_STEPS[0], float(farthest) / 32000), *_STEPS[1:])
    times, numbers = [], []
    for (time, qpos), origin in zip(kept, origins, strict=True):
        place = (qpos[:, :3] - origin) / steps[0]
        turned = np.c_[place, nearer_signs(qpos[:, 3:7]) / steps[1]]
        # Angles are those of hinges, at most a turn or two.
        whole = np.round(np.c_[turned, np.clip(qpos[:, 7:], -30, 30) / steps[2]]).astype(np.int64)
        times.append(time.astype("<f4"))
        numbers.append(np.diff(whole, axis=0, prepend=0).T.ravel())  # number after number
    low_high = np.concatenate(numbers).astype("<i2").view(np.uint8).reshape(-1, 2)
    raw = np.concatenate(times).tobytes() + low_high.T.tobytes()
    return {
        "poses": base64.b64encode(zlib.compress(raw, 6)).decode(),
        "steps": steps,
        "origins": [origin.tolist() for origin in origins],
        "rows": [len(own) for own in rows],
    }
