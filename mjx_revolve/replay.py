"""Command line: a film of a champion, of a morphology in the water, or of a colony.

``python -m mjx_revolve.replay runs/mine`` writes `swim.mp4`, `swim.gif` and `viewer.html` into
the run folder, with `--ancestors 5` a film of the champion and those it comes of, with `--colony`
one of all robots of a colony. MuJoCo draws, with a screen or without; see `docs/replay.md`.
"""

from __future__ import annotations

import argparse
import re
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from mjx_revolve.inputs.commands import (
    Parser,
    add_colony_arguments,
    add_episode_arguments,
    check_absent,
    check_colony_arguments,
    check_episode_path,
    check_place,
    individual_name,
    note_lost,
    opening_episode,
    program,
    read_path,
    run_command,
    whole,
)
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import short_path
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.numerics.runtime import fix_environment, prepare_process
from mjx_revolve.view.film.opengl import find_opengl

if TYPE_CHECKING:
    from mjx_revolve.view.film.film import Film

_KINDS: tuple[str, ...] = (".mp4", ".gif", ".html")
_SMALLEST, _LARGEST = (64, 64), (3840, 2160)  # pixels
_USUAL, _WIDE = (640, 480), (960, 540)  # pixels; the robots of a colony are small in its sea
_MOST_FPS = 120
_MOST_ANCESTORS = 30
_EACH = 5.0  # of each in a film of ancestors, where no duration is given [s]


def _parser() -> Parser:
    parser = Parser(
        prog=program("replay"),
        description="Film a champion, or a morphology in the water: MP4, GIF and viewer.html; or a "
        "whole colony: colony.mp4.",
        examples=(
            "replay runs/mine",
            "replay runs/bodies --ancestors 5",
            "replay spider --out spider.gif",
        ),
    )
    add_episode_arguments(parser)
    add = parser.add_argument
    add("--out", type=read_path, metavar="DIR_OR_FILE",
        help="a folder for all three, or one file that ends in .mp4, .gif or .html (default: the "
        "run folder, made anew each time, or files of the morphology's name in the current folder, "
        "where none is replaced)")  # fmt: skip
    add("--size", type=_size, metavar="WIDTHxHEIGHT",
        help="of the film [pixels], both even (default: 640x480, of a colony 960x540)")  # fmt: skip
    add("--fps", type=whole(1, _MOST_FPS), default=30, metavar="N",
        help="frames per second (default: %(default)s)")  # fmt: skip
    add("--ancestors", type=whole(1, _MOST_ANCESTORS), metavar="N",
        help="a film, ancestors.mp4, of so many ancestors and the champion, or the individual, one "
        "after the other, the oldest first")  # fmt: skip
    add_colony_arguments(parser)
    add("--html", action="store_true", help="only the page for a browser; needs no OpenGL")
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


def _paths_in(place: Path, name: str, kinds: Sequence[str]) -> dict[str, Path]:
    """What files are called: in a run folder the page as `mjx_revolve.viewer` calls it."""
    paths = {kind: place / f"{name}{kind}" for kind in kinds}
    if name == "swim":
        paths[".html"] = place / "viewer.html"
    return paths


def _named_paths(out: str, kinds: Sequence[str], name: str) -> dict[str, Path]:
    """The path of `--out`, checked for the kind of file; in a folder, with this name."""
    path = Path(out)
    kind = path.suffix.lower()
    check_place(path / "any" if path.is_dir() else path, f"--out {out}")
    if kind in _KINDS and not path.is_dir():
        if kind not in kinds:
            cause = "--html" if kinds == (".html",) else "a film of several robots"
            raise InputError(
                f"--out {out}: expected a name that ends in {' or '.join(kinds)}, with {cause}"
            )
        return {kind: path}
    # A new folder may have a dot in its name (v0.2), but x.avi is a slip.
    slip = re.fullmatch(r"\.[a-z][a-z0-9]{1,4}", kind) and not out.endswith("/")
    if not path.is_dir() and (path.exists() or slip):
        found = "another file" if path.exists() else repr(path.suffix)
        wanted = f"a folder, or a name that ends in {', '.join(_KINDS)}"
        raise InputError(f"--out {out}", wanted, found)
    return _paths_in(path, name, kinds)


def _run_folder(path: Path) -> Path | None:
    """The run folder that a path belongs to, before anything is read."""
    if not path.exists() or (path.is_file() and path.name != "genes.yaml"):
        return None  # the name of a shipped robot is no path
    base = path.parent if path.is_file() else path
    above = Path(short_path(base.absolute().parent))  # of the current folder, too
    return next((f for f in (base, above) if (f / "config.yaml").is_file()), None)


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
    path, out = Path(arguments.path), arguments.out
    several = arguments.colony or arguments.ancestors is not None
    if arguments.ancestors is not None and arguments.html:
        raise InputError("--ancestors: expected no --html: it makes a film")
    if arguments.colony and (arguments.html or arguments.ancestors is not None):
        raise InputError("--colony", "neither --html nor --ancestors", "one")
    kinds = (".html",) if arguments.html else (".mp4", ".gif") if several else _KINDS
    arguments.size = arguments.size or (_WIDE if arguments.colony else _USUAL)
    name = "colony" if arguments.colony else individual_name(arguments.individual) or "swim"
    if arguments.ancestors is not None:
        name = f"{name}-ancestors".removeprefix("swim-")
    paths = None if out is None else _named_paths(out, kinds, name)
    folder = _run_folder(path)
    if paths is None and folder is not None:
        kinds = kinds[:1] if several else kinds
        paths = _paths_in(folder, name, kinds)
        check_place(folder / name, str(folder))
    check_episode_path(path)
    check_colony_arguments(arguments)
    wanted = kinds if paths is None else paths
    if ".mp4" in wanted:
        check_package("MP4", "av")
    fix_environment()
    from mjx_revolve.episodes.early_checks import check_episode_files

    check_episode_files(arguments)
    # Before anything imports MuJoCo, which looks for OpenGL at once and stumbles over it.
    films = set(wanted) != {".html"}
    opengl = find_opengl() if films else ""

    prepare_process()
    from mjx_revolve.episodes.champion import load_asked

    episode = None
    if several:
        with opening_episode(arguments):
            make = _colony_films if arguments.colony else _ancestor_films
            made = make(arguments, folder)
    else:
        episode = load_asked(arguments)
        made = []
        if paths is None:
            name = Path(f"{episode.robot.morphology.name}.").name[:-1]  # it may lead elsewhere
            paths = _paths_in(Path(), name, kinds)
            for file in paths.values():
                check_absent(file)
        if films:
            from mjx_revolve.view.film.film import make_film

            made = [make_film(episode, arguments.size, arguments.fps)]
    paths = paths or {}
    for film in made:
        note_lost(film.lost)
    if made:
        from mjx_revolve.view.film.video import write_film

        write_film(made, opengl, paths.get(".mp4"), paths.get(".gif"))
        _say_films(paths, made)
    if episode is not None and ".html" in paths:
        if not films:  # a film says so itself
            from mjx_revolve.view.poses import finite_rows

            note_lost(finite_rows(episode)[1])
        from mjx_revolve.view.viewer import write_viewer

        write_viewer(episode, paths[".html"])
        _say(paths, ".html", "open it in a browser")
    return 0


def _ancestor_films(arguments: argparse.Namespace, folder: Path | None) -> list[Film]:
    """Films of an individual and its ancestors, the oldest first."""
    from mjx_revolve.episodes.champion import champion_number, load_individuals, read_individuals
    from mjx_revolve.episodes.early_checks import refuse_world
    from mjx_revolve.view.film.film import make_film
    from mjx_revolve.view.population import pick_ancestors, read_population
    from mjx_revolve.view.poses import cut_episode

    refuse_world(arguments.world, arguments.modules)
    if folder is None:
        raise InputError(arguments.path, "a run folder, for --ancestors", "none")
    number = arguments.individual
    read_individuals(folder, [])  # refuses runs in which no bodies evolve
    number = champion_number(folder) if number is None else number
    family = pick_ancestors(read_population(folder)[0], number, arguments.ancestors)
    numbers = [one.number for one in family] or [number]
    films = []
    for episode in load_individuals(folder, numbers, arguments.duration, arguments.seed):
        if arguments.duration is None:
            episode = cut_episode(episode, _EACH)
        films.append(make_film(episode, arguments.size, arguments.fps))
    return films


def _colony_films(arguments: argparse.Namespace, _: Path | None) -> list[Film]:
    """A film of all robots of a colony."""
    from mjx_revolve.view.colony import DURATION, record_colony
    from mjx_revolve.view.film.film import make_colony_film

    path, duration = Path(arguments.path), arguments.duration or DURATION
    recording = record_colony(path, arguments.time, duration)
    return [make_colony_film(recording, arguments.size, arguments.fps)]


def _say_films(paths: dict[str, Path], films: Sequence[Film]) -> None:
    """Says what was written of films in one file."""
    film, frames = films[0], sum(len(film.time) for film in films)
    length = f"{frames / film.fps:.3g} s"
    count = sum(len(film.robots) for film in films)
    length += f", {count} robots" if count > 1 else ""
    _say(paths, ".mp4", f"{length}, {film.size[0]} x {film.size[1]}, {film.fps} frames/s")
    _say(paths, ".gif", length)


def _say(paths: dict[str, Path], kind: str, words: str) -> None:
    """Says what was written, if it was."""
    if kind in paths:
        place = short_path(paths[kind])
        print(plain(f"{place}: {words}, {paths[kind].stat().st_size / 1e6:.2f} MB"))


if __name__ == "__main__":
    sys.exit(run_command(main))
