"""Films to files: H.264 in MP4, and GIF.

PyAV brings its own FFmpeg, so nothing need be installed on the system.
"""

from __future__ import annotations

import io
import math
from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image
from tqdm import tqdm

from mjx_revolve.inputs.files import write_atomic
from mjx_revolve.view.film.draw import draw_frames
from mjx_revolve.view.film.film import Film

# Quality of x264 (18: nothing to be seen, 23: its default) and the speed of encoding.
_QUALITY, _PRESET = 19, "veryfast"
# A GIF has at most this many frames and bytes; it gets smaller until it fits.
_MOST_FRAMES, _MOST_BYTES = 160, 7_500_000
_GIF_WIDTH, _LEAST_WIDTH = 420, 80


def write_film(
    film: Film | Sequence[Film],
    opengl: str,
    mp4: str | Path | None = None,
    gif: str | Path | None = None,
) -> None:
    """Draws a film once and writes it as MP4, as GIF, or as both.

    Files appear whole or not at all. On a terminal a bar shows how far it is.

    Args:
        film: from `film.make_film` or `film.make_colony_film`; or several of one size, to be shown
            one after the other.
        opengl: from `opengl.find_opengl`.
        mp4: where to write the MP4 (H.264), or None.
        gif: where to write the GIF, or None.

    Raises:
        OSError: a file cannot be written.
    """
    films = [film] if isinstance(film, Film) else list(film)
    (size,), (fps,) = {film.size for film in films}, {film.fps for film in films}
    count = sum(len(film.time) for film in films)
    every = gif_stride(fps, count)
    small: list[Image.Image] = []

    def draw() -> Iterator[np.ndarray]:
        frames = (frame for film in films for frame in draw_frames(film, opengl))
        bar = tqdm(frames, "drawing", count, leave=False, disable=None, unit="frame")
        for number, frame in enumerate(bar):
            if gif is not None and number % every == 0:
                small.append(_shrink(Image.fromarray(frame), _GIF_WIDTH))
            yield frame

    if mp4 is not None:
        title = films[-1].title
        write_atomic(Path(mp4), lambda path: write_mp4(path, draw(), size, fps, title))
    else:
        for _ in draw():
            pass
    if gif is not None:
        write_atomic(Path(gif), make_gif(small, every / fps))


def write_mp4(
    path: Path, frames: Iterable[np.ndarray], size: tuple[int, int], fps: int, title: str = ""
) -> None:
    """Writes frames as they come.

    Args:
        path: of the file.
        frames: `[height, width, 3]` uint8 each.
        size: width and height, both even [pixels].
        fps: frames per second.
        title: for the file's metadata.
    """
    import av  # an extra; only MP4 needs it

    # The index goes to the front, so that a browser can play while it loads.
    with av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"}) as file:
        file.metadata["title"] = title
        options = {"crf": str(_QUALITY), "preset": _PRESET}
        stream: Any = file.add_stream("libx264", rate=fps, options=options)
        stream.width, stream.height = size
        # The one that every browser plays.
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, fps)
        for number, frame in enumerate(frames):
            picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
            picture.pts = number
            file.mux(stream.encode(picture))
        file.mux(stream.encode())


def gif_stride(fps: int, count: int) -> int:
    """Frames of a film of `count` frames from one that a GIF shows to the next."""
    return max(1, round(fps / 15), -(-count // _MOST_FRAMES))


def make_gif(frames: Sequence[Image.Image], pause: float, limit: int = _MOST_BYTES) -> bytes:
    """Encodes a GIF, as large as it may be.

    Args:
        frames: to show.
        pause: from one to the next [s].
        limit: on the file's size [bytes].

    Returns:
        The file's bytes.
    """
    width = min(_GIF_WIDTH, frames[0].width)
    while True:
        content = _encode_gif([_shrink(frame, width) for frame in frames], pause)
        if len(content) <= limit or width <= _LEAST_WIDTH:
            return content
        # Bytes grow with the picture's area.
        share = min(0.9, math.sqrt(0.9 * limit / len(content)))
        width = max(_LEAST_WIDTH, int(share * width))


def _shrink(frame: Image.Image, width: int) -> Image.Image:
    """A picture that is no wider than this."""
    if frame.width <= width:
        return frame
    height = max(1, round(frame.height * width / frame.width))
    return frame.resize((width, height), Image.Resampling.LANCZOS)


def _encode_gif(frames: Sequence[Image.Image], pause: float) -> bytes:
    """Frames with one palette for all: colours do not flicker, and the file is smaller."""
    # A contact sheet of some frames stands for all. A robot is small in its sea: its colours would
    # drown among blues, unless the palette covers all that there are.
    some = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 8).astype(int))]
    sheet = Image.fromarray(np.concatenate([np.asarray(frame) for frame in some]))
    palette = sheet.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=3)
    first, *rest = (frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames)
    # GIF counts in hundredths of a second: each frame begins at its own, and the whole keeps time.
    ends = np.round(100 * pause * np.arange(1, len(frames) + 1))
    times = (10 * np.diff(ends, prepend=0.0)).astype(int).tolist()
    file = io.BytesIO()
    first.save(
        file,
        format="GIF",
        save_all=True,
        append_images=rest,
        duration=times if rest else times[0],
        loop=0,
        optimize=False,
    )
    return file.getvalue()
