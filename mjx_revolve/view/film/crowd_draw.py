"""Frames of a film of many robots: who is posed, hidden, ringed, and what is written over them."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import mujoco
import numpy as np
from PIL import Image, ImageDraw

from mjx_revolve.view.film.crowd import Crowd
from mjx_revolve.view.film.draw import SIGHT, draw_staged
from mjx_revolve.view.film.overlay import (
    PALE,
    SOFT,
    WHITE,
    YELLOW,
    Overlay,
    add_dots,
    make_fonts,
    make_motes,
    shorten,
    write_shaded,
)
from mjx_revolve.view.film.stage import build_shared_stage

# From the air, the surface's ripples are so much smaller than one's distance would have them. In
# the water the haze would be thicker by as much. A choice.
_FINE = 2.5
# A group of geoms that is not drawn.
_HIDDEN = 5
# Rings around the newborn grow, around the dead they shrink, for so long [s].
_RING = 2.0
_BORN, _DEAD = (0.62, 1.0, 0.55), (1.0, 0.42, 0.40)  # red, green, blue
# From dot to dot of a ring, and their radius, in shares of the camera's distance.
_SPACE, _DOT = 0.012, 0.0032


def draw_crowd(crowd: Crowd, way: str) -> Iterator[np.ndarray]:
    """Draws a film of many robots.

    Args:
        crowd: from `make_crowd`.
        way: of making an OpenGL context, from `opengl.find_opengl`.

    Yields:
        `[height, width, 3]` uint8, one frame after the other.
    """
    distance = crowd.shots.distance
    reach = float(np.linalg.norm(crowd.center[:, :2], axis=1).max()) + distance
    robots = dict(enumerate(crowd.robots))
    world, sight = crowd.robot.world, SIGHT * distance
    model = build_shared_stage(robots, world, reach, sight, crowd.size, plain=True)
    roots = [model.joint(f"{k}/root") for k in robots]
    owner = model.body_rootid[model.geom_bodyid]
    own = [np.flatnonzero(owner == model.jnt_bodyid[root.id]) for root in roots]
    group = model.geom_group.copy()
    fine = _FINE if crowd.shots.above else 1.0

    def pose(data: mujoco.MjData, frame: int) -> None:
        for k, root in enumerate(roots):
            shown = crowd.alive[k, frame]
            model.geom_group[own[k]] = group[own[k]] if shown else _HIDDEN
            begin = int(root.qposadr[0])
            row = crowd.qpos[k][frame]
            data.qpos[begin : begin + len(row)] = row

    yield from draw_staged(crowd, model, pose, make_crowd_overlay(crowd), way, fine)


def make_crowd_overlay(crowd: Crowd) -> Overlay:
    """Prepares what is laid over frames; see `overlay.make_overlay`.

    Args:
        crowd: whose frames they are.

    Returns:
        See `overlay.make_overlay`.
    """
    motes, write = make_motes(crowd), _make_words(crowd)

    def overlay(picture: Any, depth: np.ndarray, frame: int) -> np.ndarray:
        picture = np.array(picture)
        motes(picture, depth, frame)
        for mark in crowd.marks:
            color = PALE if mark.name == "clinic" else YELLOW
            _add_ring(picture, depth, crowd, frame, np.array(mark.place), mark.radius, 0.5, color)
        for (times, who), color, grows in ((crowd.births, _BORN, 1), (crowd.deaths, _DEAD, 0)):
            age = (crowd.time[frame] - times) / _RING
            for k, share in zip(who[(age >= 0) & (age < 1)], age[(age >= 0) & (age < 1)],
                                strict=True):  # fmt: skip
                size = crowd.robots[k].morphology.length * (0.6 + 1.4 * abs(1 - grows - share))
                place = crowd.qpos[k][frame, :3]
                alpha = 0.95 * math.sqrt(1 - share)
                _add_ring(picture, depth, crowd, frame, place, size, alpha, color)
        return write(picture, frame)

    return overlay


def _add_ring(
    picture: np.ndarray,
    depth: np.ndarray,
    crowd: Crowd,
    frame: int,
    middle: np.ndarray,
    radius: float,
    alpha: float,
    color: tuple[float, float, float],
) -> None:
    """Lays a level ring of dots around a place [m] over a picture, in place."""
    distance = crowd.shots.distance
    count = max(12, round(2 * math.pi * radius / (_SPACE * distance)))
    angle = 2 * np.pi * np.arange(count) / count
    points = middle + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
    sizes = np.full(count, _DOT * distance)
    add_dots(picture, depth, crowd, frame, points, np.full(count, alpha), sizes, color)


def _make_words(crowd: Crowd) -> Any:
    """Title, time, and how many live, were born and have died; a function of picture and frame."""
    width, height = crowd.size
    unit = max(min(crowd.size) / 480, 0.4)
    bold, plain = make_fonts(unit)
    edge, line = round(14 * unit), round(19 * unit)
    title = shorten(crowd.title, bold, width - 2 * edge)

    def words(picture: np.ndarray, frame: int) -> np.ndarray:
        image = Image.fromarray(picture)
        draw = ImageDraw.Draw(image, "RGBA")
        now, base = crowd.time[frame], height - edge
        write_shaded(draw, unit, edge, edge, title, "la", bold, WHITE)
        write_shaded(draw, unit, edge, base - line, f"{now:.1f} s", "ls", bold, WHITE)
        write_shaded(draw, unit, edge, base, _count(crowd, frame), "ls", plain, SOFT)
        return np.asarray(image)

    return words


def _count(crowd: Crowd, frame: int) -> str:
    """How many live, and what has happened since the film began."""
    now = crowd.time[frame]
    counts = [
        (int(crowd.alive[:, frame].sum()), "robot", "robots"),
        (int((crowd.births[0] <= now).sum()), "birth", "births"),
        (int((crowd.deaths[0] <= now).sum()), "death", "deaths"),
    ]
    return "   ".join(f"{n} {one if n == 1 else many}" for n, one, many in counts)
