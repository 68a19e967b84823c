"""Command line and function: a film of a champion, or of a morphology in the water.

``python -m mjx_revolve.replay runs/mine`` writes `swim.mp4`, `swim.gif` and `viewer.html` into
the run folder. Films are drawn by MuJoCo, with a screen or without; see `docs/replay.md`.
"""

from __future__ import annotations

import argparse
import math
import os
import re
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.inputs.commands import (
    Parser,
    add_episode_arguments,
    check_episode_path,
    check_place,
    read_path,
    run_command,
    whole,
)
from mjx_revolve.inputs.errors import InputError

if TYPE_CHECKING:
    from mjx_revolve.episodes.champion import Episode
    from mjx_revolve.view.film.film import Film

_KINDS = (".mp4", ".gif", ".html")
_SMALLEST, _LARGEST = (64, 64), (3840, 2160)  # pixels
_MOST_FPS = 120


def write_film(
    film: Film,
    opengl: str,
    mp4: Path | None = None,
    gif: Path | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> None:
    """Draws a film once and writes it as MP4, as GIF, or as both.

    Files appear whole or not at all.

    Args:
        film: from `film.make_film`.
        opengl: from `opengl.find_opengl`.
        mp4: where to write the MP4 (H.264), or None.
        gif: where to write the GIF, or None.
        progress: told after each frame how many are drawn, and of how many.

    Raises:
        OSError: a file cannot be written.
    """
    from mjx_revolve.inputs.files import write_atomic
    from mjx_revolve.view.film.film import draw_frames
    from mjx_revolve.view.film.video import GifMaker, Mp4Writer

    count = len(film.time)
    small = None if gif is None else GifMaker(film.size, film.fps, count)

    def draw(take: Callable[[Any], None]) -> None:
        for number, frame in enumerate(draw_frames(film, opengl), 1):
            take(frame)
            if small is not None:
                small.add(frame)
            if progress is not None:
                progress(number, count)

    def encode(path: Path) -> None:
        with Mp4Writer(path, film.size, film.fps, film.episode.title) as writer:
            draw(writer.add)

    if mp4 is not None:
        write_atomic(mp4, encode)
    elif small is not None:
        draw(lambda frame: None)
    if gif is not None and small is not None:
        write_atomic(gif, small.make())


# --- the command line ----------------------------------------------------------------------------


def _parser() -> Parser:
    parser = Parser(
        prog="python -m mjx_revolve.replay",
        description="Film a champion, or a morphology in the water: MP4, GIF and viewer.html.",
    )
    add_episode_arguments(parser)
    parser.add_argument(
        "--out",
        type=read_path,
        metavar="DIR_OR_FILE",
        help="a folder for all three, or one file that ends in .mp4, .gif or .html (default: the "
        "run folder, or files of the morphology's name in the current folder)",
    )
    parser.add_argument(
        "--size",
        type=_size,
        default="640x480",
        metavar="WIDTHxHEIGHT",
        help="of the film [pixels], both even (default: %(default)s)",
    )
    parser.add_argument(
        "--fps",
        type=whole(1, _MOST_FPS),
        default=30,
        metavar="N",
        help="frames per second (default: %(default)s)",
    )
    parser.add_argument(
        "--html", action="store_true", help="only the page for a browser; needs no OpenGL"
    )
    parser.add_argument("--view", action="store_true", help="look at it in MuJoCo's viewer instead")
    return parser


def _size(text: str) -> tuple[int, int]:
    match = re.fullmatch(r"(\d{1,5})x(\d{1,5})", text.strip().lower())
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    inside = all(a <= b <= c for a, b, c in zip(_SMALLEST, size, _LARGEST, strict=True))
    if not inside or any(edge % 2 for edge in size):
        raise argparse.ArgumentTypeError(
            f"expected WIDTHxHEIGHT, even numbers of pixels from {_SMALLEST[0]}x"
            f"{_SMALLEST[1]} to {_LARGEST[0]}x{_LARGEST[1]}; found {text!r}"
        )
    return size


def _file_name(name: str, kind: str) -> str:
    """What a file is called: in a run folder the page as `mjx_revolve.viewer` calls it."""
    return "viewer.html" if (name, kind) == ("swim", ".html") else f"{name}{kind}"


def _named_paths(out: str | None, html: bool) -> dict[str, Path] | None:
    """Where `--out` wants which kind of file; None where it says nothing."""
    if out is None:
        return None
    path = Path(out)
    kind = path.suffix.lower()
    check_place(path / "any" if path.is_dir() else path, f"--out {out}")
    if kind not in _KINDS or path.is_dir():
        # A new folder may have a dot in its name (v0.2), but x.avi is a slip.
        slip = re.fullmatch(r"\.[a-z][a-z0-9]{1,4}", kind) and not out.endswith("/")
        if not path.is_dir() and (path.exists() or slip):
            raise InputError(
                f"--out {out}: expected a folder, or a name that ends in {', '.join(_KINDS)}; "
                f"found {'another file' if path.exists() else repr(path.suffix)}"
            )
        return {k: path / _file_name("swim", k) for k in (_KINDS if not html else (".html",))}
    if html and kind != ".html":
        raise InputError(f"--out {out}: expected a name that ends in .html, with --html")
    return {kind: path}


def _usual_paths(place: Path, name: str, html: bool) -> dict[str, Path]:
    """Where files go that were given no name: never over files that are there.

    A page that is there already does not keep a film from being made.
    """
    kinds = _KINDS if not html else (".html",)
    paths = {kind: place / _file_name(name, kind) for kind in kinds}
    page = paths.get(".html")
    if not html and page is not None and page.exists():
        print(f"{page}: there already, and left as it is")
        del paths[".html"]
    for path in paths.values():
        if path.exists():
            raise InputError(
                f"{path}: expected no such file yet; say where with --out to replace it"
            )
    return paths


def _run_folder(path: Path) -> Path | None:
    """The run folder that a path belongs to, before anything is read."""
    if path.is_file():
        path = path.parent if path.name == "genes.yaml" else Path(os.devnull)
    for folder in (path, path.parent):
        if (folder / "config.yaml").is_file():
            return folder
    return None


def main(argv: list[str] | None = None) -> int:
    """Films a champion, or a morphology.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or a file is wrong, or there is no OpenGL to draw with.
        OSError: a file cannot be written.
    """
    arguments = _parser().parse_args(argv)
    path = Path(arguments.path)
    paths = _named_paths(arguments.out, arguments.html)
    folder = _run_folder(path)
    if arguments.view:
        if arguments.out is not None or arguments.html:
            raise InputError("--view: expected neither --out nor --html: it writes nothing")
        _check_screen()
    elif paths is None and folder is not None:
        paths = _usual_paths(folder, "swim", arguments.html)
    check_episode_path(path)
    opengl = ""
    if not arguments.view and (paths is None or set(paths) != {".html"}) and not arguments.html:
        # Before anything imports MuJoCo, which looks for OpenGL at once and stumbles over it.
        from mjx_revolve.view.film.opengl import find_opengl

        opengl = find_opengl()

    from mjx_revolve.numerics.runtime import prepare_process

    prepare_process()
    from mjx_revolve.episodes.champion import load_episode

    episode = load_episode(path, arguments.world, arguments.duration, arguments.seed)
    if arguments.view:
        _view(episode)
        return 0
    if paths is None:
        paths = _usual_paths(Path(), str(episode.robot.morphology.name), arguments.html)
    if opengl:
        _film(episode, paths, opengl, arguments.size, arguments.fps)
    if ".html" in paths:
        from mjx_revolve.viewer import write_viewer

        write_viewer(episode, paths[".html"])
        _say(paths[".html"], "open it in a browser")
    return 0


def _film(
    episode: Episode, paths: dict[str, Path], opengl: str, size: tuple[int, int], fps: int
) -> None:
    """Draws the film and says what was written."""
    from mjx_revolve.view.film.film import make_film

    film = make_film(episode, size, fps)
    _note_lost(film)
    mp4, gif = paths.get(".mp4"), paths.get(".gif")
    live = sys.stderr.isatty()

    def progress(number: int, count: int) -> None:
        if live:
            end = "\r" if number < count else "\r\033[K"
            print(f"drawing frame {number} of {count}", end=end, file=sys.stderr, flush=True)

    write_film(film, opengl, mp4, gif, progress)
    seconds = len(film.time) / fps
    if mp4 is not None:
        _say(mp4, f"{seconds:.3g} s, {size[0]} x {size[1]}, {fps} frames/s")
    if gif is not None:
        _say(gif, f"{seconds:.3g} s")


def _note_lost(film: Film) -> None:
    if film.lost is not None:
        print(
            f"note: the trajectory is not finite from {film.lost:.4g} s on; shown up to there",
            file=sys.stderr,
        )


def _say(path: Path, words: str) -> None:
    print(f"{path}: {words}, {path.stat().st_size / 1e6:.2f} MB")


# --- MuJoCo's viewer -----------------------------------------------------------------------------


def _check_screen() -> None:
    """Refuses `--view` where nobody could see it."""
    hint = "(without --view a film is written, which needs none)"
    if sys.platform.startswith("linux") and not (
        os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    ):
        raise InputError(
            f"--view: expected a screen; found neither DISPLAY nor WAYLAND_DISPLAY set {hint}"
        )
    # MuJoCo's viewer would end the process with a complaint of its own.
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = glfw.init()
    if not found:
        raise InputError(f"--view: expected a screen; found none that lets us open a window {hint}")


def _view(episode: Episode) -> None:
    """Plays an episode over and over in MuJoCo's viewer, until its window is closed."""
    import threading
    import time

    import mujoco
    import mujoco.viewer

    from mjx_revolve.view.film.film import make_film
    from mjx_revolve.view.film.scene import build_scene

    film = make_film(episode, fps=60)
    _note_lost(film)
    shots = film.shots
    model = build_scene(film.robot, sight=9.0 * shots.distance, origin=film.origin.tolist())
    data = mujoco.MjData(model)
    before = set(threading.enumerate())
    try:
        window = mujoco.viewer.launch_passive(model, data, show_left_ui=False, show_right_ui=False)
    except Exception as error:  # GLFW's, X's and macOS's reasons come in many kinds
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise InputError(f"--view: expected a screen with OpenGL; found: {reason}") from None
    with window:
        with window.lock():
            axes = shots.axes(0)
            window.cam.lookat[:] = shots.target[0] - film.origin
            window.cam.distance = shots.distance
            window.cam.azimuth = math.degrees(math.atan2(axes[2, 1], axes[2, 0]))
            window.cam.elevation = math.degrees(math.asin(axes[2, 2]))
        begun, last = time.monotonic(), 0
        while window.is_running():
            frame = int((time.monotonic() - begun) * film.fps) % len(film.time)
            with window.lock():
                data.qpos[:] = film.qpos[frame]
                data.qpos[:3] -= film.origin
                # The user may turn the camera; it goes along with the robot.
                window.cam.lookat[:] += shots.target[frame] - shots.target[last]
                mujoco.mj_forward(model, data)
            last = frame
            window.sync()
            time.sleep(0.5 / film.fps)
    # The viewer's thread must be through with GLFW before Python ends, and GLFW with it.
    for thread in set(threading.enumerate()) - before:
        thread.join(timeout=10.0)


if __name__ == "__main__":
    sys.exit(run_command(main))
