"""Command line: a champion, or a morphology, for other programs.

``python -m mjx_revolve.export runs/mine``

Writes the robot as MJCF for stock MuJoCo, as URDF for ROS, as an SDF world for Gazebo, what it
did as a ROS 2 bag (MCAP), its controller as Python and C, and a page on how to build it.
"""

from __future__ import annotations

import argparse
import keyword
import os
import sys
from pathlib import Path

from mjx_revolve.inputs.commands import (
    Parser,
    add_episode_arguments,
    check_absent,
    check_episode_path,
    check_output_folder,
    check_place,
    individual_name,
    program,
    read_path,
    run_command,
)
from mjx_revolve.inputs.errors import InputError, plain
from mjx_revolve.inputs.files import PAGES, check_name, short_path, write_atomic
from mjx_revolve.inputs.packages import check_package
from mjx_revolve.numerics import runtime

# By option: what its file is called in a folder, what it may end in, and what it is.
_FORMATS = {
    "mjcf": ("robot.xml", (".xml",), "for stock MuJoCo"),
    "urdf": ("robot.urdf", (".urdf",), "for ROS"),
    "sdf": ("robot.sdf", (".sdf", ".world"), "a world for Gazebo, with the water"),
    "mcap": ("rollout.mcap", (".mcap",), "the rollout, as a ROS 2 bag"),
    "controller": (
        "brain.py", (".py",),
        "the controller with its genes in Python, in C99 and as a ROS 2 node beside it",
    ),
    "build": ("build.html", PAGES, "how to build it: parts, ballast, assembly, joints, STL"),
}  # fmt: skip
# Options, and the formats on which they have an effect.
_USED_BY = {"meshes": ("urdf", "sdf"), "seed": ("mjcf", "sdf", "mcap"), "duration": ("mcap",)}


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=program("export"),
        description="Write a champion, or a morphology, for MuJoCo, ROS, Gazebo and the bench: all "
        "formats into a folder, or those that are given a file.",
        examples=("export runs/mine", "export spider --mjcf spider.xml"),
    )
    add_episode_arguments(parser)
    add = parser.add_argument
    for name, (_, endings, words) in _FORMATS.items():
        add(f"--{name}", metavar=f"FILE{endings[0]}", help=words)
    add("--out", type=read_path, metavar="DIR",
        help="all formats into this folder (default: export in the run folder, individuals/N there "
        "of an individual, made anew each time, or MORPHOLOGY_export here, if there is none yet)",
    )  # fmt: skip
    add("--meshes", metavar="PREFIX",
        help="what URDF and SDF put before the names of mesh files, such as "
        "package://my_robot/meshes/ (default: meshes/, beside them)")  # fmt: skip
    return parser


def _all_files(folder: Path) -> dict[str, Path]:
    """The files of all formats in a folder."""
    return {name: folder / file for name, (file, _, _) in _FORMATS.items()}


def _named_files(arguments: argparse.Namespace) -> dict[str, Path]:
    """The files that options name."""
    files = {}
    for name, (_, endings, _) in _FORMATS.items():
        if getattr(arguments, name) is None:
            continue
        label = f"--{name} {getattr(arguments, name)}"
        files[name] = check_name(getattr(arguments, name), endings, label)
        check_place(files[name], label)
        if name == "controller":
            _check_importable(files[name], label)
        if not files[name].parent.is_dir():
            raise InputError(label, f"the folder {files[name].parent}", "none")
    if arguments.out is None:
        return files
    if files:
        raise InputError("--out", "a folder or single files", f"--{next(iter(files))}")
    check_output_folder(arguments.out)
    return _all_files(Path(arguments.out))


def _check_importable(path: Path, label: str) -> None:
    """Refuses a file that the node beside it could not import."""
    if not path.stem.isidentifier() or keyword.iskeyword(path.stem):
        wanted = "a name that Python can import (letters, digits and _)"
        raise InputError(label, wanted, repr(path.stem))


def _check_used(arguments: argparse.Namespace, files: dict[str, Path]) -> None:
    """Refuses what has no effect on the files that options name, and a folder without its end."""
    for option, formats in _USED_BY.items():
        if files and getattr(arguments, option) is not None and files.keys().isdisjoint(formats):
            wanted = ", ".join(f"--{name}" for name in formats)
            raise InputError(f"--{option}", f"{wanted} or all formats", "neither")
    if arguments.meshes and not arguments.meshes.endswith("/"):
        raise InputError("--meshes", "a prefix that ends in /", repr(arguments.meshes))


def main(argv: list[str] | None = None) -> int:
    """Writes a champion, or a morphology, for other programs.

    Args:
        argv: the arguments; None: those of the process.

    Returns:
        0.

    Raises:
        InputError: an argument or a file is wrong.
        OSError: a file cannot be written.
    """
    arguments = _parser().parse_args(argv)
    files = _named_files(arguments)
    _check_used(arguments, files)
    if not files and Path(arguments.path).is_dir():
        check_place(Path(arguments.path) / "any", arguments.path)
    check_episode_path(arguments.path)
    runtime.fix_environment()
    from mjx_revolve.episodes.early_checks import check_episode_files

    no_genes = InputError("--controller", "a champion", "a morphology, which has no genes")
    if check_episode_files(arguments) and arguments.controller is not None:
        raise no_genes
    runtime.prepare_process()
    # JAX takes seconds to import: not for `--help`.
    from mjx_revolve.episodes.champion import load_asked
    from mjx_revolve.formats.export import export_robot

    if arguments.mcap is not None:
        check_package("--mcap", "rosbags")
    episode = load_asked(arguments)
    if not files:
        if episode.folder is not None:
            name = individual_name(arguments.individual) or "export"
            folder = Path(os.path.normpath(episode.folder / name))
        else:
            folder = Path(f"{Path(episode.robot.morphology.name).name}_export")
            check_absent(folder, "folder")
        files = _all_files(folder)
    brain, lacking = None, []
    try:
        brain = None
        if "controller" in files:
            if episode.fitness is None or episode.genes is None:
                raise no_genes
            from mjx_revolve.formats.brain import champion_brain

            brain = champion_brain(episode.fitness, episode.genes)
    except InputError as error:
        if arguments.controller is not None:
            raise
        lacking.append(f"no controller: {error}")
        del files["controller"]
    try:
        if "mcap" in files:
            check_package("--mcap", "rosbags")
    except InputError as error:
        lacking.append(f"no bag: {error}")
        del files["mcap"]
    build = files.pop("build", None)
    done = export_robot(episode.robot, files, episode.trajectory, arguments.meshes, brain)
    if build is not None:
        from mjx_revolve.view.build_page import make_build_page

        write_atomic(build, make_build_page(episode.robot, episode.title).encode())
        done.append((build, "how to build it; for browsers and printers"))
    for path, words in done:
        print(plain(f"{short_path(path)}: {words}"))
    for reason in lacking:  # the other formats do not need it
        print(reason, file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
