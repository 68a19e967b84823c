"""Films to files: H.264 in MP4, and GIF.

PyAV brings its own FFmpeg, so nothing need be installed on the system.
"""

from __future__ import annotations

import io
import math
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from types import TracebackType
from typing import Any

import av
import numpy as np
from PIL import Image

# Quality of x264 (18: nothing to be seen, 23: its default) and how long it may ponder.
_QUALITY, _PRESET = 19, "veryfast"
# A GIF has at most this many frames and bytes; it gets smaller until it fits.
_MOST_FRAMES, _MOST_BYTES = 160, 7_500_000
_GIF_WIDTH, _LEAST_WIDTH = 420, 80
# Of its 256 colours, so many are for what covers much of the picture.
_MAIN = 150


class Mp4Writer:
    """Writes frames as they come; a context manager, for the file's end must be written.

    Args:
        path: of the file.
        size: width and height, both even [pixels].
        fps: frames per second.
        title: for the file's metadata.
    """

    def __init__(self, path: Path, size: tuple[int, int], fps: int, title: str = "") -> None:
        # The index goes to the front, so that a browser can play while it loads.
        self._file = av.open(str(path), "w", format="mp4", options={"movflags": "+faststart"})
        if title:
            self._file.metadata["title"] = title
        options = {"crf": str(_QUALITY), "preset": _PRESET}
        stream: Any = self._file.add_stream("libx264", rate=fps, options=options)
        stream.width, stream.height = size
        # The one that every browser plays.
        stream.pix_fmt = "yuv420p"
        stream.time_base = Fraction(1, fps)
        self._stream = stream
        self._count = 0

    def add(self, frame: np.ndarray) -> None:
        """Appends a frame.

        Args:
            frame: `[height, width, 3]` uint8.
        """
        picture = av.VideoFrame.from_ndarray(np.ascontiguousarray(frame), format="rgb24")
        picture.pts = self._count
        self._count += 1
        for packet in self._stream.encode(picture):
            self._file.mux(packet)

    def close(self) -> None:
        """Writes what is left, and the index."""
        for packet in self._stream.encode():
            self._file.mux(packet)
        self._file.close()

    def __enter__(self) -> Mp4Writer:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if error is None:
            self.close()
        else:
            self._file.close()


class GifMaker:
    """Collects frames, small, and makes a GIF of them.

    Args:
        size: width and height of the frames [pixels].
        fps: frames per second.
        count: how many frames will come.
        limit: on the file's size [bytes].
    """

    def __init__(
        self, size: tuple[int, int], fps: int, count: int, limit: int = _MOST_BYTES
    ) -> None:
        self._width = min(_GIF_WIDTH, size[0])
        self._limit = limit
        self.every = max(1, round(fps / 15), -(-count // _MOST_FRAMES))
        self._pause = self.every / fps
        self._frames: list[Image.Image] = []
        self._seen = 0

    def add(self, frame: np.ndarray) -> None:
        """Keeps a frame, if its turn has come.

        Args:
            frame: `[height, width, 3]` uint8.
        """
        if self._seen % self.every == 0:
            self._frames.append(_shrink(Image.fromarray(frame), self._width))
        self._seen += 1

    def make(self) -> bytes:
        """Encodes the GIF, as large as it may be.

        Returns:
            The file's bytes.
        """
        width = self._width
        while True:
            content = _encode_gif([_shrink(frame, width) for frame in self._frames], self._pause)
            if len(content) <= self._limit or width <= _LEAST_WIDTH:
                return content
            # Bytes grow with the picture's area.
            share = min(0.9, math.sqrt(0.9 * self._limit / len(content)))
            width = max(_LEAST_WIDTH, int(share * width))


def _shrink(frame: Image.Image, width: int) -> Image.Image:
    if frame.width == width:
        return frame
    height = max(1, round(frame.height * width / frame.width))
    return frame.resize((width, height), Image.Resampling.LANCZOS)


def _encode_gif(frames: Sequence[Image.Image], pause: float) -> bytes:
    """Frames with one palette for all: colours do not flicker, and the file is smaller."""
    # A contact sheet of some frames stands for all.
    some = [frames[i] for i in np.unique(np.linspace(0, len(frames) - 1, 8).astype(int))]
    palette = _make_palette(Image.fromarray(np.concatenate([np.asarray(frame) for frame in some])))
    flat = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in frames]
    # GIF counts in hundredths of a second: each frame begins at its own, and the whole keeps time.
    ends = np.round(100 * pause * np.arange(1, len(flat) + 1))
    times = (10 * np.diff(ends, prepend=0.0)).astype(int).tolist()
    file = io.BytesIO()
    flat[0].save(
        file,
        format="GIF",
        save_all=True,
        append_images=flat[1:],
        duration=times if len(times) > 1 else times[0],
        loop=0,
        optimize=False,
    )
    return file.getvalue()


def _make_palette(sheet: Image.Image) -> Image.Image:
    """A palette for a picture: most of it for what covers much, the rest for what sticks out."""
    main = sheet.quantize(_MAIN, method=Image.Quantize.MEDIANCUT)
    pixels = np.asarray(sheet, np.int16).reshape(-1, 3)
    missed = np.abs(np.asarray(main.convert("RGB"), np.int16).reshape(-1, 3) - pixels).max(axis=1)
    # A robot is small in its sea: its colours would drown among blues.
    odd = pixels[missed > max(8, np.quantile(missed, 0.93))].astype(np.uint8)
    colors = list(main.getpalette() or [])[: 3 * _MAIN]
    if len(odd):
        rest = Image.fromarray(odd[None]).quantize(255 - _MAIN, method=Image.Quantize.MEDIANCUT)
        colors += list(rest.getpalette() or [])[: 3 * (255 - _MAIN)]
    palette = Image.new("P", (1, 1))
    palette.putpalette(colors)
    return palette
