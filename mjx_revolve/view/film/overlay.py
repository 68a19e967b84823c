"""What is laid over a film's frames: motes in the water, marks along the way, and words.

Motes and marks show that the robot moves; the words say what is shown, how long, how fast, how
deep, and how large things are.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_revolve.view.course import bed_at, water_drift
from mjx_revolve.view.film.camera import FOVY
from mjx_revolve.view.film.film import Film, Shown
from mjx_revolve.view.surroundings import moves, target_of, water_velocity

# Motes in a cube around the camera, and its edge in camera distances.
_MOTES, _CUBE = 1500, 6.0
# The trail: a mark every so often, for so long [s].
_MARK, _TRAIL = 0.25, 12.0
# Red, green, blue of both.
PALE, YELLOW = (0.86, 0.97, 1.0), (1.0, 0.88, 0.45)
_REACH = 7  # of a dot [pixels]
WHITE, _SHADE, SOFT = (255, 255, 255, 245), (4, 28, 44, 150), (226, 240, 246, 235)

_AIM, _FLOW = (255, 92, 150, 255), (122, 255, 220, 255)  # target, current

Overlay = Callable[[Any, np.ndarray, int], np.ndarray]
_Dots = Callable[[np.ndarray, np.ndarray, int], None]


def make_overlay(film: Film) -> Overlay:
    """Prepares what is laid over frames.

    Args:
        film: whose frames they are.

    Returns:
        A function of a picture `[height, width, 3]` uint8, its depths along the view `[height,
        width]` [m] and the frame's number, which returns a new picture.
    """
    layers = (make_motes(film), _make_marks(film))
    write = _make_captions(film)

    def overlay(picture: Any, depth: np.ndarray, frame: int) -> np.ndarray:
        picture = np.array(picture)
        for layer in layers:
            layer(picture, depth, frame)
        return write(picture, frame)

    return overlay


def make_motes(film: Shown) -> _Dots:
    """Motes that go where the water goes that is around the robot, waves apart."""
    random = np.random.default_rng(3)
    edge = _CUBE * film.shots.distance
    place = random.uniform(0.0, edge, (_MOTES, 3))
    weight = random.uniform(0.25, 1.0, _MOTES) ** 2
    drift = water_drift(film.robot, film.water, film.center, 1 / film.fps)
    size = 0.0032 * film.shots.distance * (0.5 + weight)

    def draw(picture: np.ndarray, depth: np.ndarray, frame: int) -> None:
        camera = film.shots.position[frame]
        corner = camera - edge / 2
        motes = corner + (place + drift[frame] - corner) % edge
        off = np.linalg.norm(motes - camera, axis=1) / (edge / 2)
        alpha = 0.9 * weight * np.clip(1.0 - off, 0.0, 1.0) ** 0.7
        # Not in the lens, and none that stands in the air.
        surface = np.asarray(film.water.surface_height)[frame]
        alpha *= np.clip(8.0 * off - 1.2, 0.0, 1.0) * (motes[:, 2] < surface - 0.02)
        add_dots(picture, depth, film, frame, motes, alpha, size, PALE)

    return (lambda picture, depth, frame: None) if film.shots.above else draw


def _make_marks(film: Film) -> _Dots:
    """Marks along the way, that fade."""
    places = np.arange(0, len(film.time), max(1, round(_MARK * film.fps)))

    def draw(picture: np.ndarray, depth: np.ndarray, frame: int) -> None:
        age = (frame - places) / film.fps
        recent = (age > 0) & (age < _TRAIL)
        marks, age = film.way[places[recent]], age[recent]
        # They come up behind the robot rather than inside it.
        away = np.linalg.norm(marks - film.center[frame], axis=1)
        alpha = 0.85 * (1.0 - age / _TRAIL)
        alpha *= np.clip(4.0 * away / film.radius[frame] - 2.0, 0.0, 1.0)
        size = np.full(len(marks), 0.0065 * film.shots.distance)
        add_dots(picture, depth, film, frame, marks, alpha, size, YELLOW)

    return draw


def add_dots(
    picture: np.ndarray,
    depth: np.ndarray,
    film: Shown,
    frame: int,
    points: np.ndarray,
    alpha: np.ndarray,
    size: np.ndarray,
    color: tuple[float, float, float],
) -> None:
    """Lays soft dots of radii `size` [m] at points `[n, 3]` [m] over a picture, in place.

    Not where something stands before them, by the depths of the picture [m].
    """
    height, width = depth.shape
    flat, away = film.shots.project(frame, points)
    x, y = width / 2 + flat[:, 0] * height / 2 - 0.5, height / 2 - flat[:, 1] * height / 2 - 0.5
    radius = size / np.maximum(away, 1e-6) / math.tan(FOVY / 2) * height / 2
    shown = (away > 0.05 * film.shots.distance) & (alpha > 0.01) & (radius < 40)
    shown &= (np.abs(2 * x - width) < width + 18) & (np.abs(2 * y - height) < height + 18)
    # Dots smaller than a pixel are drawn as large as one, and fainter.
    wide, alpha = np.clip(radius, 0.8, 5.0), alpha * np.minimum(1.0, (radius / 0.8) ** 2)
    layer = np.zeros((height, width))
    rows, columns = np.arange(height)[:, None], np.arange(width)
    for k in np.flatnonzero(shown):
        column, row = math.floor(x[k]), math.floor(y[k])
        across = slice(max(column - _REACH, 0), max(column + _REACH + 1, 0))
        up = slice(max(row - _REACH, 0), max(row + _REACH + 1, 0))
        square = (columns[across] - x[k]) ** 2 + (rows[up] - y[k]) ** 2
        cover = alpha[k] * np.exp(-square / wide[k] ** 2)
        layer[up, across] += cover * (away[k] < depth[up, across])
    place = np.nonzero(layer > 0.004)
    share = np.minimum(layer[place], 1.0)[:, None]
    old = picture[place].astype(float)
    picture[place] = np.round(old + share * (255 * np.asarray(color) - old)).astype(np.uint8)


def make_fonts(unit: float) -> tuple[Any, Any]:
    """The bold and the plain font of captions, for a unit of so many pixels."""
    fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    bold = ImageFont.truetype(fonts / "DejaVuSans-Bold.ttf", round(15 * unit))
    return bold, ImageFont.truetype(fonts / "DejaVuSans.ttf", round(12.5 * unit))


def shorten(title: str, font: Any, room: float) -> str:
    """A title that fits into so many pixels."""
    if font.getlength(title) > room:
        while title and font.getlength(title + "…") > room:
            title = title[:-1]
        title += "…"
    return title


def write_shaded(
    draw: ImageDraw.ImageDraw, unit: float, x: float, y: float, words: str,
    anchor: str, font: Any, color: Any,
) -> None:  # fmt: skip
    """Words with a shadow, at a place [pixels]."""
    shift = max(1, round(unit))
    draw.text((x + shift, y + shift), words, font=font, anchor=anchor, fill=_SHADE)
    draw.text((x, y), words, font=font, anchor=anchor, fill=color)


def _make_captions(film: Film) -> Callable[[np.ndarray, int], np.ndarray]:
    """Words over a frame; they take a picture and a frame's number and return a new picture."""
    (width, height), episode, shots = film.size, film.episode, film.shots
    unit = max(min(film.size) / 480, 0.4)
    bold, plain = make_fonts(unit)
    edge, line, tick = round(14 * unit), round(19 * unit), 4 * unit
    base, below = height - edge, _bed_words(film)
    title = shorten(episode.title, bold, width - 2 * edge)
    score = ""
    if episode.score is not None:
        score = f"score {episode.score:.3g} {episode.score_unit}".rstrip()
        score += f", mean over {episode.starts}"

    sign = _make_signs(film, unit)

    def caption(picture: np.ndarray, frame: int) -> np.ndarray:
        image = Image.fromarray(picture)
        # Draws half-transparent colours over an opaque picture.
        draw = ImageDraw.Draw(image, "RGBA")

        def write(x: float, y: float, words: str, anchor: str, font: Any, color: Any) -> None:
            write_shaded(draw, unit, x, y, words, anchor, font, color)

        for x, y, words, color in sign(draw, frame):
            write(x, y, words, "mm", plain, color)
        write(edge, edge, title, "la", bold, WHITE)
        write(edge, edge + line, score, "la", plain, SOFT)
        write(edge, base - line, f"{film.time[frame]:.1f} s", "ls", bold, WHITE)
        away = float(np.linalg.norm(shots.position[frame] - shots.target[frame]))
        metre = height / 2 / (away * math.tan(FOVY / 2))
        length = _round_length(min(110 * unit, 0.25 * width) / metre)
        left, right = width - edge - length * metre, width - edge
        facts = _facts(film, frame, below)
        # In small pictures the last facts have no room beside the scale.
        while len(facts) > 1 and plain.getlength("   ".join(facts)) > left - 3 * edge:
            facts.pop()
        write(edge, base, "   ".join(facts), "ls", plain, SOFT)
        for shift, color in ((1, _SHADE), (0, WHITE)):
            bar = [(left, base - tick), (left, base), (right, base), (right, base - tick)]
            bar = [(x + shift, y + shift) for x, y in bar]
            draw.line(bar, fill=color, width=max(1, round(1.5 * unit)))
        named = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
        write((left + right) / 2, base - 2 * tick, named, "ms", plain, SOFT)
        return np.asarray(image)

    return caption


_Sign = tuple[float, float, str, tuple[int, int, int, int]]


def _make_signs(film: Film, unit: float) -> Callable[[ImageDraw.ImageDraw, int], list[_Sign]]:
    """The current as an arrow in a corner, and the target: marked, or pointed at from the edge.

    Args:
        film: whose frames they are.
        unit: of sizes [pixels].

    Returns:
        A function of a picture's pen and the frame's number, which draws and returns words: where
        their middle is [pixels], and their colour.
    """
    (width, height), shots = film.size, film.shots
    fitness = film.episode.fitness
    way = target_of(None if fitness is None else fitness.config.task, film.episode.trajectory)
    if way is not None:
        rows = np.asarray(film.episode.trajectory.time, float)
        way = np.stack([np.interp(film.time, rows, x) for x in way[: len(rows)].T], axis=-1)
    current = water_velocity(film.robot, film.water, film.center)
    flows, arm, thick = moves(current), 20 * unit, max(2, round(2.5 * unit))

    def arrow(draw: ImageDraw.ImageDraw, middle: np.ndarray, along: np.ndarray, color: Any) -> None:
        along = along / max(float(np.linalg.norm(along)), 1e-9)
        across, tip = np.array([-along[1], along[0]]), middle + arm * along
        neck = tip - 9 * unit * along
        draw.line([tuple(middle - arm * along), tuple(neck)], fill=color, width=thick)
        wings = (tip, neck + 5 * unit * across, neck - 5 * unit * across)
        draw.polygon([tuple(point) for point in wings], fill=color)

    def sign(draw: ImageDraw.ImageDraw, frame: int) -> list[_Sign]:
        words: list[_Sign] = []
        if flows:
            right, up = shots.axes(frame)[:2]
            along = np.array([right @ current[frame], -(up @ current[frame])])
            middle = np.array([width - 70 * unit, 62 * unit])
            if np.linalg.norm(along) > 0.05 * np.linalg.norm(current[frame]):
                arrow(draw, middle, along, _FLOW)
            speed = f"current {np.linalg.norm(current[frame]):.2f} m/s"
            words.append((middle[0], 24 * unit, speed, _FLOW))
        if way is not None:
            target = way[frame]
            flat, away = shots.project(frame, target[None])
            middle = np.array([width / 2, height / 2])
            at = middle + height / 2 * flat[0] * (1, -1)
            inside = away[0] > 0 and (at > 0).all() and (at < (width, height)).all()
            left = f"{np.linalg.norm(target - film.center[frame]):.2g} m"
            if inside:
                for reach in (5 * unit, 10 * unit):
                    draw.ellipse([*(at - reach), *(at + reach)], outline=_AIM, width=thick)
                words.append((at[0], at[1] - 22 * unit, f"target, {left}", _AIM))
            else:
                along = (at - middle) * (1 if away[0] > 0 else -1)
                room = middle - 80 * unit  # from the middle to where arrows stand
                edge = middle + along / max(float(np.abs(along / room).max()), 1e-9)
                arrow(draw, edge, along, _AIM)
                words.append((edge[0], edge[1] - 30 * unit, f"target, {left}", _AIM))
        return words

    return sign


def _facts(film: Film, frame: int, below: str) -> list[str]:
    """How fast, how deep, and what is known of the bed."""
    speed = float(film.speed[frame])
    depth = float(np.asarray(film.water.surface_height)[frame] - film.center[frame, 2])
    facts = [
        f"{speed:.2f} m/s" if speed >= 0.1 else f"{100 * speed:.1f} cm/s",
        f"{speed / film.robot.morphology.length:.2f} body lengths/s",
        f"depth {depth:.2f} m" if depth >= -0.005 else f"{-depth:.2f} m above the water",
    ]
    return [*facts, below] if below else facts


def _bed_words(film: Film) -> str:
    """How far below the bed lies, where it is out of sight."""
    bed, (x, y, z) = film.robot.world.bed, film.center.T
    if bed is None:
        return "no bed"
    below = float((z - bed_at(bed, x, y)).min())
    return f"bed {below:.0f} m below" if below > 6 * film.shots.distance else ""


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no more than this."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(k * power for k in (1, 2, 5) if k * power <= most)
