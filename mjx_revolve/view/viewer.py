"""One HTML file that replays robots in any browser: an episode, or a colony.

A file holds everything: meshes, poses, water, forces, three.js, and the scripts of `viewer_page/`.
It needs no server and nothing from the network. A pose is stored as qpos, rounded, as the
difference from the pose before, packed by zlib: a pose of the shipped robots takes some 18 bytes.
Long runs of many robots keep fewer poses, so that a page stays small enough to be sent: 64 robots
for three hours, two poses a second, take 24 MB.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import PAGES, check_name, write_atomic
from mjx_revolve.inputs.templates import make_templates
from mjx_revolve.view.palette import page_palette

if TYPE_CHECKING:
    from mjx_revolve.episodes.champion import Episode
    from mjx_revolve.view.page_data import Packed
    from mjx_revolve.view.recording import Mark, ReplayRobot

_FILES = Path(__file__).parent / "viewer_page"
# Rounding of positions [m], quaternions [-] and hinges [rad] of many robots: invisible. Choices.
_STEPS = (1e-3, 5e-4, 2e-3)
# A page that a browser opens without a wait, and most mail takes. A choice [bytes].
_MAX_BYTES = 24_000_000
# Poses that are closer than this do not make motion smoother [s].
_CLOSEST = 0.02
_TRIES = 12  # at guessing how many poses fit


@dataclass(frozen=True)
class PageSummary:
    """The contents of a page.

    Attributes:
        bytes: its size.
        poses: how many poses it keeps.
        gap: least time between two poses of a robot, outside of the window; 0: all are kept [s].
    """

    bytes: int
    poses: int
    gap: float


def write_viewer(episode: Episode, path: str | Path, forces: bool = True) -> None:
    """Writes the replay of an episode as one HTML file, whole or not at all.

    Args:
        episode: what to show; rows after the first that is not finite are left out.
        path: of the file, which ends in `.html`; its folder is made if need be.
        forces: whether the page has arrows of forces, which take seconds to compile.

    Raises:
        InputError: `path` has another ending, or the episode has no finite row.
        OSError: the file cannot be written.
    """
    write_atomic(check_name(path, PAGES), make_page(episode, forces).encode())


def make_page(episode: Episode, forces: bool = True) -> str:
    """The replay of an episode as the text of an HTML file; see `write_viewer`."""
    from mjx_revolve.view.episode_data import episode_data

    subtitle, data = _episode_subtitle(episode), episode_data(episode, forces)
    return fill_page("replay", maker="viewer", title=episode.title, subtitle=subtitle, data=data)


def write_colony_page(
    robots: Sequence[ReplayRobot],
    path: str | Path,
    title: str,
    *,
    marks: Sequence[Mark] = (),
    leap: float | None = None,
    window: tuple[float, float] | None = None,
    most: int = _MAX_BYTES,
) -> PageSummary:
    """Writes the replay of many robots as one HTML file, whole or not at all.

    Args:
        robots: all that ever appear, in one world.
        path: of the file, which ends in `.html`; its folder is made if need be.
        title: its heading.
        marks: places to show.
        leap: a robot that is farther than this from its pose before was put there, and is not
            shown on the way [m]; None: never.
        window: from when to when no pose is left out, however large that makes the page [s].
        most: about how large the page may be [bytes]; where there are too many poses for that,
            each robot keeps those that are some time apart.

    Returns:
        The page's contents.

    Raises:
        InputError: `path` has another ending, there is no robot, or one of them has poses that do
            not fit its body.
        OSError: the file cannot be written.
    """
    path = check_name(path, PAGES)
    if not robots:
        raise InputError("robots", "at least one robot to show", "none")
    for one in robots:
        one.check()
    world = robots[0].robot.world
    low = min(float(np.asarray(one.qpos)[:, 2].min()) for one in robots)
    size = max(one.robot.morphology.length for one in robots)
    from mjx_revolve.view.page_data import replay_data

    data = replay_data(robots, low - 0.5 * size, marks, leap) | {"many": True, "episode": None}
    page = {"maker": "colony", "title": title}
    bare = len(fill_page("replay", subtitle="", data=data, **page).encode())
    poses, gap, packed = _fit(robots, window, max(most - bare, most // 50, 1))
    count = f"{len(robots)} robot{'s' if len(robots) > 1 else ''}"
    often = f"a pose of each every {gap:.2g} s" if gap > 0.1 else ""
    subtitle = " \u00b7 ".join(filter(None, (count, world.name.replace("_", " "), often)))
    content = fill_page("replay", subtitle=subtitle, data=data | packed, **page).encode()
    write_atomic(path, content)
    return PageSummary(len(content), poses, gap)


def fill_page(template: str, **values: object) -> str:
    """A page of `viewer_page/`, with all files that it needs inside.

    Args:
        template: its name there: "replay" or "live".
        values: `maker`, `title`, `subtitle`, and `data` for its scripts.

    Returns:
        The text of an HTML file.
    """
    pages = make_templates(_FILES)
    pages.policies["json.dumps_kwargs"] = {"separators": (",", ":"), "allow_nan": False}
    file = lambda name: (_FILES / name).read_text(encoding="utf-8")  # noqa: E731
    page = pages.get_template(f"{template}.html")
    return page.render(file=file, palette=page_palette(), script=f"{template}.js", **values)


def _episode_subtitle(episode: Episode) -> str:
    """Score, body and water in a line."""
    body, world = episode.robot.morphology, episode.robot.world
    words = []
    if episode.score is not None:
        words.append(f"{episode.score:.3g} {episode.score_unit} over {episode.starts}")
    words += body.counts.split(", ")
    words.append(world.name.replace("_", " "))
    if any(world.current):
        words.append(f"current {math.hypot(*world.current):.2g} m/s")
    moving = {"gusts": world.gust, "shear": world.shear, "a field of currents": world.current_field}
    words += [name for name, value in moving.items() if value is not None]
    if world.waves:
        largest = max(wave.amplitude for wave in world.waves)
        upto = " up to" * (len(world.waves) > 1)
        words.append(f"waves of amplitude{upto} {largest:.2g} m")
    return " \u00b7 ".join(words)


def _fit(
    robots: Sequence[ReplayRobot], window: tuple[float, float] | None, room: int
) -> tuple[int, float, Packed]:
    """As many poses as fit into so many bytes: how many, how far apart [s], and packed."""
    from mjx_revolve.view.page_data import pack_poses

    times = [np.asarray(one.time, float) for one in robots]
    qpos = [np.asarray(one.qpos, float) for one in robots]
    gap, total, size = _CLOSEST, sum(map(len, times)), 0
    usual = min((float(np.median(np.diff(t))) for t in times if len(t) > 1), default=0.0)
    longest = max(float(t[-1] - t[0]) for t in times)
    for attempt in range(_TRIES):
        if attempt:
            gap = max(gap, usual) * max(1.1, size / room)
        rows = [_thin(time, gap, window) for time in times]
        kept_times = [x[own] for x, own in zip(times, rows, strict=True)]
        kept_qpos = [x[own] for x, own in zip(qpos, rows, strict=True)]
        packed = pack_poses(kept_times, kept_qpos, _STEPS)
        count, size = sum(map(len, rows)), len(packed["poses"])
        if size <= room or gap > longest:  # what is left is in the window
            break
    return count, min(gap, longest) if count < total else 0.0, packed


def _thin(time: np.ndarray, gap: float, window: tuple[float, float] | None) -> np.ndarray:
    """Rows of times `[T]` that are some time apart [s], and the first and the last."""
    slot = np.floor((time - time[0]) / gap + 1e-6)
    kept = np.r_[True, np.diff(slot) > 0]
    kept[-1] = True
    if window is not None:
        kept |= (time >= window[0]) & (time <= window[1])
    return np.flatnonzero(kept)
