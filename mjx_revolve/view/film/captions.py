"""Words over a film: what it shows, how long, how fast, how deep, and how large things are."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING

import matplotlib
import numpy as np
from PIL import Image, ImageDraw, ImageFont

if TYPE_CHECKING:
    from mjx_revolve.view.film.film import Film

_WHITE, _SHADE = (255, 255, 255, 245), (4, 28, 44, 150)
_SOFT = (226, 240, 246, 235)


class Captions:
    """Writes over the frames of a film.

    Args:
        film: whose frames they are.
    """

    def __init__(self, film: Film) -> None:
        self._film = film
        height = min(film.size[1], film.size[0])
        self._unit = max(height / 480, 0.4)
        fonts = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
        self._bold = ImageFont.truetype(fonts / "DejaVuSans-Bold.ttf", round(15 * self._unit))
        self._plain = ImageFont.truetype(fonts / "DejaVuSans.ttf", round(12.5 * self._unit))
        self._length = film.robot.morphology.length
        self._bed = self._bed_words()

    def _bed_words(self) -> str:
        """How far below the bed lies, where it is out of sight."""
        film = self._film
        bed = film.robot.world.bed
        if bed is None:
            return "no bed"
        from mjx_revolve.water.bed import bed_height

        at = film.balls[0].astype(np.float32)
        below = float(np.min(at[:, 2] - np.asarray(bed_height(bed, at[:, 0], at[:, 1]))))
        return f"bed {below:.0f} m below" if below > 6 * film.shots.distance else ""

    def draw(self, picture: np.ndarray, frame: int) -> np.ndarray:
        """Writes over a frame.

        Args:
            picture: `[height, width, 3]` uint8.
            frame: its number.

        Returns:
            A new picture.
        """
        film = self._film
        image = Image.fromarray(picture)
        # Draws half-transparent colours over an opaque picture.
        draw = ImageDraw.Draw(image, "RGBA")
        width, height = image.size
        edge = round(14 * self._unit)
        line = round(19 * self._unit)

        def write(
            x: float,
            y: float,
            words: str,
            font: ImageFont.FreeTypeFont,
            anchor: str,
            color: tuple[int, ...] = _WHITE,
        ) -> None:
            shift = max(1, round(self._unit))
            draw.text((x + shift, y + shift), words, font=font, anchor=anchor, fill=_SHADE)
            draw.text((x, y), words, font=font, anchor=anchor, fill=color)

        write(edge, edge, self._fitted(film.episode.title, width - 2 * edge), self._bold, "la")
        episode = film.episode
        if episode.score is not None:
            unit = f" {episode.score_unit}".rstrip()
            words = f"score {episode.score:.3g}{unit}, mean over fresh starts"
            write(edge, edge + line, words, self._plain, "la", _SOFT)
        speed = float(film.speed[frame])
        depth = film.water.surface_height - float(film.balls[0][frame, 2])
        fast = f"{speed:.2f} m/s" if speed >= 0.1 else f"{100 * speed:.1f} cm/s"
        lengths = f"{speed / self._length:.2f} body lengths/s"
        base = height - edge
        write(edge, base - line, f"{film.time[frame]:.1f} s", self._bold, "ls")
        deep = f"depth {depth:.2f} m" if depth >= -0.005 else f"{-depth:.2f} m above the water"
        left, right, named = self._scale(frame, width - edge)
        facts = [word for word in (fast, lengths, deep, self._bed) if word]
        # In small pictures the last facts have no room beside the scale.
        while len(facts) > 1 and self._plain.getlength("   ".join(facts)) > left - 3 * edge:
            facts.pop()
        write(edge, base, "   ".join(facts), self._plain, "ls", _SOFT)
        tick, wide = 4 * self._unit, max(1, round(1.5 * self._unit))
        for shift, color in ((1, _SHADE), (0, _WHITE)):
            bar = [(left, base - tick), (left, base), (right, base), (right, base - tick)]
            draw.line([(x + shift, y + shift) for x, y in bar], fill=color, width=wide)
        write((left + right) / 2, base - 2 * tick, named, self._plain, "ms", _SOFT)
        return np.asarray(image)

    def _fitted(self, words: str, room: float) -> str:
        """Words that fit, cut where they are too many."""
        if self._bold.getlength(words) <= room:
            return words
        while words and self._bold.getlength(words + "…") > room:
            words = words[:-1]
        return words + "…"

    def _scale(self, frame: int, right: float) -> tuple[float, float, str]:
        """Ends of a bar of a round length at the robot's distance [pixels], and the length."""
        shots, height = self._film.shots, self._film.size[1]
        away = float(np.linalg.norm(shots.position[frame] - shots.target[frame]))
        metre = height / 2 / (away * math.tan(shots.fovy / 2))
        room = min(110 * self._unit, 0.25 * self._film.size[0])
        power = 10.0 ** math.floor(math.log10(room / metre))
        length = max(k * power for k in (1, 2, 5) if k * power * metre <= room)
        named = f"{length:g} m" if length >= 1 else f"{100 * length:g} cm"
        return right - length * metre, right, named
