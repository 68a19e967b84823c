"""Command line: one HTML file that replays an episode in any browser.

``python -m mjx_revolve.viewer runs/mine``, and of a run in which a colony lives, all of it:
``python -m mjx_revolve.viewer runs/mine --colony``
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

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
)
from mjx_revolve.inputs.errors import plain
from mjx_revolve.inputs.files import PAGES, check_name, short_path
from mjx_revolve.numerics import runtime


def main(argv: list[str] | None = None) -> int:
    """Writes the replay of a champion, or of a morphology, as one HTML file.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or a file is wrong.
        OSError: the file cannot be written.
    """
    parser = Parser(
        prog=program("viewer"),
        description="Write one HTML file that replays an episode in any browser, offline.",
        examples=(
            "viewer runs/mine",
            "viewer spider --world lake --out spider.html",
            "viewer runs/colony --colony",
        ),
    )
    add_episode_arguments(parser)
    parser.add_argument(
        "--out", type=read_path, metavar="FILE.html",
        help="default: viewer.html in the run folder (of an individual, individuals/N.html there; "
        "with --colony, colony.html), made anew each time; or the morphology's name in the current "
        "folder, where no file is replaced",
    )  # fmt: skip
    add_colony_arguments(parser)
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_place(check_name(arguments.out, PAGES), arguments.out)
    elif Path(arguments.path).is_dir():
        check_place(Path(arguments.path) / "any", arguments.path)
    check_episode_path(arguments.path)
    check_colony_arguments(arguments)
    # JAX takes seconds to import: not for `--help`, nor for wrong files.
    runtime.fix_environment()
    if arguments.colony:
        return _write_colony(arguments)
    from mjx_revolve.episodes.early_checks import check_episode_files

    check_episode_files(arguments)
    from mjx_revolve.episodes.champion import load_asked

    runtime.prepare_process()
    episode = load_asked(arguments)
    name = individual_name(arguments.individual) or "viewer"
    out = arguments.out or _usual_path(episode.folder, name, episode.robot.morphology.name)
    from mjx_revolve.view.poses import finite_rows
    from mjx_revolve.view.viewer import write_viewer

    episode, lost = finite_rows(episode)
    note_lost(lost)
    write_viewer(episode, out)
    size = Path(out).stat().st_size / 1e6
    length = f"{episode.trajectory.time[-1]:.4g} s"
    print(plain(f"{short_path(out)}: {length}, {size:.2f} MB; open it in a browser"))
    return 0


def _write_colony(arguments: argparse.Namespace) -> int:
    """Writes the page of a whole colony."""
    from mjx_revolve.episodes.run_reader import find_run

    folder = find_run(arguments.path)
    out = Path(arguments.out) if arguments.out else _usual_path(folder, "colony", "colony")
    from mjx_revolve.view.colony import DURATION, record_colony

    runtime.prepare_process()
    with opening_episode(arguments):
        seen = record_colony(folder, arguments.time, arguments.duration or DURATION)
    from mjx_revolve.view.viewer import write_colony_page

    written = write_colony_page(seen.robots, out, seen.title, marks=seen.marks, leap=seen.leap)
    span = f"{len(seen.robots)} robots, {seen.start:.4g} to {seen.end:.4g} s"
    print(plain(f"{short_path(out)}: {span}, {written.bytes / 1e6:.2f} MB; open it in a browser"))
    return 0


def _usual_path(folder: Path | None, inside: str, name: str) -> Path:
    """Where a page goes that was given no name: in a run folder it is made anew."""
    if folder:
        return Path(os.path.normpath(folder / f"{inside}.html"))
    path = Path(Path(f"{name}.html").name)  # a robot's name may lead elsewhere
    check_absent(path)
    return path


if __name__ == "__main__":
    sys.exit(run_command(main))
