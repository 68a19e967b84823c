"""The overlay of a film's frames: motes in the water, marks, and words.

Motes and marks make motion visible; the words are title, time, speed, depth and a scale.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from mjx_revolve.view.film.camera import FOVY
from mjx_revolve.view.film.film import ColonyNotes, EpisodeNotes, Film
from mjx_revolve.view.palette import ACCENT, BIRTH, CURRENT, DEATH, DUST, PLACE, RGB, TARGET
from mjx_revolve.view.surroundings import bed_at, is_moving, water_drift

# Motes in a cube around the camera, and its edge in camera distances.
_MOTES, _CUBE = 1500, 6.0
# The trail: a mark every so often, for so long [s].
_MARK, _TRAIL = 0.25, 12.0
_REACH = 7  # of a dot [pixels]
# Rings of births grow, those of deaths shrink, for so long [s].
_RING = 2.0
# From dot to dot of a ring, and their radius, in shares of the camera's distance.
_SPACE, _DOT = 0.012, 0.0032
# Colours of words and lines, with opacity, and of their shadow.
_WHITE, _SHADE, _SOFT = (255, 255, 255, 245), (4, 28, 44, 150), (226, 240, 246, 235)
AIM, FLOW = ((*(round(255 * x) for x in color), 255) for color in (TARGET, CURRENT))

Overlay = Callable[[np.ndarray, np.ndarray, int], np.ndarray]
_Dots = tuple[np.ndarray, np.ndarray, np.ndarray, RGB]
"""Places `[n, 3]` [m], opacities `[n]`, radii `[n]` [m] and the colour of soft dots."""


def make_overlay(film: Film) -> Overlay:
    """Prepares what is laid over frames.

    Args:
        film: of the frames.

    Returns:
        A function of a picture `[height, width, 3]` uint8, its depths along the view `[height,
        width]` [m] and the frame's number, which returns a new picture.
    """
    layers = [] if film.shots.above else [_make_motes(film)]
    if isinstance(film.notes, EpisodeNotes):
        layers.append(partial(_trail, film, film.notes))
        words = _make_episode_words(film, film.notes)
    else:
        layers.append(partial(_rings, film, film.notes))
        words = partial(_write_colony, film, film.notes)

    def overlay(picture: np.ndarray, depth: np.ndarray, frame: int) -> np.ndarray:
        picture = np.array(picture)
        for layer in layers:
            for dots in layer(frame):
                _add_dots(picture, depth, film, frame, dots)
        pen = Pen(picture)
        words(pen, frame)
        return np.asarray(pen.image)

    return overlay


# --- dots -----------------------------------------------------------------------------------------


def _make_motes(film: Film) -> Callable[[int], Iterator[_Dots]]:
    """Motes that go with the water around the middle of what is shown, waves apart."""
    random = np.random.default_rng(3)
    edge = _CUBE * film.shots.distance
    place = random.uniform(0.0, edge, (_MOTES, 3))
    weight = random.uniform(0.25, 1.0, _MOTES) ** 2
    drift = water_drift(film.world, film.water, film.center, 1 / film.fps)
    size = 0.0032 * film.shots.distance * (0.5 + weight)

    def motes_in(frame: int) -> Iterator[_Dots]:
        camera = film.shots.position[frame]
        corner = camera - edge / 2
        motes = corner + (place + drift[frame] - corner) % edge
        off = np.linalg.norm(motes - camera, axis=1) / (edge / 2)
        alpha = 0.9 * weight * np.clip(1.0 - off, 0.0, 1.0) ** 0.7
        # Not in the lens, and none that stands in the air.
        surface = np.asarray(film.water.surface_height)[frame]
        alpha *= np.clip(8.0 * off - 1.2, 0.0, 1.0) * (motes[:, 2] < surface - 0.02)
        yield motes, alpha, size, DUST

    return motes_in


def _trail(film: Film, notes: EpisodeNotes, frame: int) -> Iterator[_Dots]:
    """Marks along the way, that fade."""
    places = np.arange(0, len(film.time), max(1, round(_MARK * film.fps)))
    age = (frame - places) / film.fps
    recent = (age > 0) & (age < _TRAIL)
    marks, age = notes.way[places[recent]], age[recent]
    # They come up behind the robot rather than inside it.
    away = np.linalg.norm(marks - film.center[frame], axis=1)
    alpha = 0.85 * (1.0 - age / _TRAIL)
    alpha *= np.clip(4.0 * away / notes.radius[frame] - 2.0, 0.0, 1.0)
    yield marks, alpha, np.full(len(marks), 0.0065 * film.shots.distance), ACCENT


def _rings(film: Film, notes: ColonyNotes, frame: int) -> Iterator[_Dots]:
    """Level rings of dots: around places, and around robots that are born or die."""
    distance = film.shots.distance

    def ring(middle: np.ndarray | RGB, radius: float, alpha: float, color: RGB) -> _Dots:
        count = max(12, round(2 * math.pi * radius / (_SPACE * distance)))
        angle = 2 * np.pi * np.arange(count) / count
        points = middle + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=-1)
        return points, np.full(count, alpha), np.full(count, _DOT * distance), color

    for mark in notes.marks:
        yield ring(mark.place, mark.radius, 0.5, PLACE)
    for (times, index), color, grows in ((notes.births, BIRTH, 1), (notes.deaths, DEATH, 0)):
        for time, k in zip(times, index, strict=True):
            age, one = (film.time[frame] - time) / _RING, film.robots[k]
            if 0 <= age < 1:
                radius = one.robot.morphology.length * (0.6 + 1.4 * abs(1 - grows - age))
                yield ring(one.qpos[frame, :3], radius, 0.95 * math.sqrt(1 - age), color)


def _add_dots(picture: np.ndarray, depth: np.ndarray, film: Film, frame: int, dots: _Dots) -> None:
    """Lays soft dots over a picture, in place.

    Not where something stands before them, by the depths of the picture [m].
    """
    points, alpha, size, color = dots
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


# --- words ----------------------------------------------------------------------------------------


@lru_cache
def _font(name: str, size: int) -> ImageFont.FreeTypeFont:
    return ImageFont.truetype(Path(matplotlib.get_data_path()) / "fonts" / "ttf" / name, size)


class Pen:
    """Draws words, with a shadow, and lines over a picture `[height, width, 3]` uint8."""

    def __init__(self, picture: np.ndarray) -> None:
        self.image = Image.fromarray(picture)
        # Draws half-transparent colours over an opaque picture.
        self.draw = ImageDraw.Draw(self.image, "RGBA")
        self.width, self.height = self.image.size
        self.unit = max(min(self.image.size) / 480, 0.4)  # of sizes [pixels]
        self.bold = _font("DejaVuSans-Bold.ttf", round(15 * self.unit))
        self.plain = _font("DejaVuSans.ttf", round(12.5 * self.unit))
        self.edge, self.line = round(14 * self.unit), round(19 * self.unit)
        self.base = self.height - self.edge

    def write(
        self, x: float, y: float, words: str, anchor: str, color: Any = _SOFT, bold: bool = False
    ) -> None:
        """Words at a place [pixels]."""
        font, shift = self.bold if bold else self.plain, max(1, round(self.unit))
        for off, fill in ((shift, _SHADE), (0, color)):
            self.draw.text((x + off, y + off), words, font=font, anchor=anchor, fill=fill)

    def title(self, words: str) -> None:
        """At the top, as much as there is room for."""
        words = shown = " ".join(words.split())  # an id may have line breaks
        while words and self.bold.getlength(shown) > self.width - 2 * self.edge:
            words = words[:-1]
            shown = words + "…"
        self.write(self.edge, self.edge, shown, "la", _WHITE, bold=True)

    def arrow(self, middle: np.ndarray, along: np.ndarray, color: Any) -> None:
        """An arrow around a place [pixels]."""
        unit = self.unit
        along = along / max(float(np.linalg.norm(along)), 1e-9)
        across, tip = np.array([-along[1], along[0]]), middle + 20 * unit * along
        neck, thick = tip - 9 * unit * along, max(2, round(2.5 * unit))
        self.draw.line([tuple(middle - 20 * unit * along), tuple(neck)], fill=color, width=thick)
        wings = (tip, neck + 5 * unit * across, neck - 5 * unit * across)
        self.draw.polygon([tuple(point) for point in wings], fill=color)


def _write_colony(film: Film, notes: ColonyNotes, pen: Pen, frame: int) -> None:
    """Title, time, and how many robots are alive, were born and have died."""
    pen.title(film.title)
    pen.write(pen.edge, pen.base - pen.line, f"{film.time[frame]:.1f} s", "ls", _WHITE, bold=True)
    pen.write(pen.edge, pen.base, count_words(film, notes, frame), "ls")


def count_words(film: Film, notes: ColonyNotes, frame: int) -> str:
    """How many robots are alive in a frame, and births and deaths since the film began."""
    counts = [
        (sum(int(one.alive[frame]) for one in film.robots), "robot", "robots"),
        (int((notes.births[0] <= film.time[frame]).sum()), "birth", "births"),
        (int((notes.deaths[0] <= film.time[frame]).sum()), "death", "deaths"),
    ]
    return "   ".join(f"{n} {one if n == 1 else many}" for n, one, many in counts)


def _make_episode_words(film: Film, notes: EpisodeNotes) -> Callable[[Pen, int], None]:
    """Title, score, time, speed, depth, scale; the current and the target."""
    shots, below, flows = film.shots, _bed_words(film), is_moving(notes.current)

    def words(pen: Pen, frame: int) -> None:
        if flows:
            _sign_current(pen, film, notes.current[frame], frame)
        if notes.target is not None:
            _sign_target(pen, film, notes.target[frame], notes.target_name, frame)
        unit, edge, base, tick = pen.unit, pen.edge, pen.base, 4 * pen.unit
        pen.title(film.title)
        pen.write(edge, edge + pen.line, notes.score, "la")
        pen.write(edge, base - pen.line, f"{film.time[frame]:.1f} s", "ls", _WHITE, bold=True)
        away = float(np.linalg.norm(shots.position[frame] - shots.target[frame]))
        metre = pen.height / 2 / (away * math.tan(FOVY / 2))
        length = _round_length(min(110 * unit, 0.25 * pen.width) / metre)
        left, right = pen.width - edge - length * metre, pen.width - edge
        facts = _facts(film, notes, frame, below)
        # In small pictures the last facts have no room beside the scale.
        while len(facts) > 1 and pen.plain.getlength("   ".join(facts)) > left - 3 * edge:
            facts.pop()
        pen.write(edge, base, "   ".join(facts), "ls")
        for shift, color in ((1, _SHADE), (0, _WHITE)):
            bar = [(left, base - tick), (left, base), (right, base), (right, base - tick)]
            bar = [(x + shift, y + shift) for x, y in bar]
            pen.draw.line(bar, fill=color, width=max(1, round(1.5 * unit)))
        named = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
        pen.write((left + right) / 2, base - 2 * tick, named, "ms")

    return words


def _sign_current(pen: Pen, film: Film, current: np.ndarray, frame: int) -> None:
    """The current as an arrow in a corner."""
    right, up = film.shots.axes(frame)[:2]
    along, speed = np.array([right @ current, -(up @ current)]), float(np.linalg.norm(current))
    x = pen.width - 70 * pen.unit
    if np.linalg.norm(along) > 0.05 * speed:
        pen.arrow(np.array([x, 62 * pen.unit]), along, FLOW)
    pen.write(x, 24 * pen.unit, f"current {speed:.2f} m/s", "mm", FLOW)


def _sign_target(pen: Pen, film: Film, target: np.ndarray, name: str, frame: int) -> None:
    """The target: marked, or pointed at from the edge."""
    unit = pen.unit
    flat, away = film.shots.project(frame, target[None])
    middle = np.array([pen.width / 2, pen.height / 2])
    at = middle + pen.height / 2 * flat[0] * (1, -1)
    words = f"{name}, {np.linalg.norm(target - film.center[frame]):.2g} m"
    if away[0] > 0 and (at > 0).all() and (at < (pen.width, pen.height)).all():
        for reach in (5 * unit, 10 * unit):
            box, thick = [*(at - reach), *(at + reach)], max(2, round(2.5 * unit))
            pen.draw.ellipse(box, outline=AIM, width=thick)
        pen.write(at[0], at[1] - 22 * unit, words, "mm", AIM)
    else:
        along = (at - middle) * (1 if away[0] > 0 else -1)
        room = middle - 80 * unit  # from the middle to where arrows stand
        edge = middle + along / max(float(np.abs(along / room).max()), 1e-9)
        pen.arrow(edge, along, AIM)
        pen.write(edge[0], edge[1] - 30 * unit, words, "mm", AIM)


def _facts(film: Film, notes: EpisodeNotes, frame: int, below: str) -> list[str]:
    """Speed, depth, and what is known of the bed."""
    speed = float(notes.speed[frame])
    depth = float(np.asarray(film.water.surface_height)[frame] - film.center[frame, 2])
    facts = [
        f"{speed:.2f} m/s" if speed >= 0.1 else f"{100 * speed:.1f} cm/s",
        f"{speed / notes.length:.2f} body lengths/s",
        f"depth {depth:.2f} m" if depth >= -0.005 else f"{-depth:.2f} m above the water",
    ]
    return [*facts, below] if below else facts


def _bed_words(film: Film) -> str:
    """How far below the bed lies, where it is out of sight."""
    bed, (x, y, z) = film.world.bed, film.center.T
    if bed is None:
        return "no bed"
    below = float((z - bed_at(bed, x, y)).min())
    return f"bed {below:.0f} m below" if below > 6 * film.shots.distance else ""


def _round_length(most: float) -> float:
    """The largest of 1, 2, 5 times a power of ten that is no more than this."""
    power = 10.0 ** math.floor(math.log10(most))
    return max(k * power for k in (1, 2, 5) if k * power <= most)
