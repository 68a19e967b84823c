"""Command line: a champion, or a morphology, for other programs.

``python -m mjx_revolve.export runs/mine``

Writes the robot as MJCF for stock MuJoCo, as URDF for ROS, as an SDF world for Gazebo, and what it
did as a ROS 2 bag (MCAP).
"""

from __future__ import annotations

import argparse
import os
import sys
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
)
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.engine.robot import Robot
    from mjx_revolve.episodes.champion import Episode
    from mjx_revolve.episodes.simulate import Trajectory

# Formats: what their files are called in a folder, and what they may end in.
_FILES = {"mjcf": "robot.xml", "urdf": "robot.urdf", "sdf": "robot.sdf", "mcap": "rollout.mcap"}
_ENDINGS = {"mjcf": (".xml",), "urdf": (".urdf",), "sdf": (".sdf", ".world"), "mcap": (".mcap",)}

# Where meshes go, beside the files that name them.
_MESHES = "meshes"


def export(
    robot: Robot,
    files: dict[str, Path],
    trajectory: Trajectory | None = None,
    meshes: str | None = None,
) -> list[tuple[Path, str]]:
    """Writes a robot, and what it did, for other programs.

    Each file appears whole or not at all; files that are there are replaced.

    Args:
        robot: from `build_robot`.
        files: by format ("mjcf", "urdf", "sdf", "mcap"), where each goes. URDF and SDF have their
            meshes in a folder `meshes` beside them.
        trajectory: what it did; MJCF and SDF start where it starts, and "mcap" cannot do without.
        meshes: what URDF and SDF call that folder; by default `meshes/`, as seen from the file.

    Returns:
        The files, and what each is, in words.

    Raises:
        InputError: there is no trajectory for a bag, nothing of it is finite, or the package that
            writes bags is missing.
        OSError: a file cannot be written.
    """
    import numpy as np

    from mjx_revolve.formats.links import make_links, make_meshes
    from mjx_revolve.formats.mjcf import make_mjcf
    from mjx_revolve.formats.sdf import make_sdf
    from mjx_revolve.formats.urdf import make_urdf
    from mjx_revolve.inputs.files import write_atomic

    done: list[tuple[Path, str]] = []
    start = None if trajectory is None else np.asarray(trajectory.qpos)[0]
    if start is not None and not np.isfinite(start).all():
        start = None
    prefix = f"{_MESHES}/" if meshes is None else meshes
    makers: dict[str, tuple[Callable[[], str], str]] = {
        "mjcf": (lambda: make_mjcf(robot, start), "MJCF; opens in stock MuJoCo"),
        "urdf": (lambda: make_urdf(robot, prefix), "URDF; meshes beside it"),
        "sdf": (lambda: make_sdf(robot, prefix, start), "SDF world for Gazebo; meshes beside it"),
    }
    for name, (make, words) in makers.items():
        if name in files:
            write_atomic(files[name], make().encode())
            done.append((files[name], words))
    shapes = make_meshes(robot.morphology)
    for folder in {files[name].parent / _MESHES for name in ("urdf", "sdf") if name in files}:
        for name, mesh in shapes.items():
            content: Any = mesh.export(file_type="stl")
            write_atomic(folder / f"{name}.stl", content)
        done.append((folder, f"{len(shapes)} meshes (STL, m)"))
    if "mcap" in files:
        from mjx_revolve.formats.ros_bag import pick_rows, write_bag

        if trajectory is None:
            raise InputError("mcap: expected a trajectory; found none")
        write_bag(robot, trajectory, files["mcap"])
        rows, stamps = pick_rows(robot, trajectory)
        words = f"ROS 2 bag: {stamps[-1] / 1e9:.4g} s, {len(rows)} poses"
        done.append((files["mcap"], f"{words} of {len(make_links(robot))} links"))
    return done


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m mjx_revolve.export",
        description="Write a champion, or a morphology, for MuJoCo, ROS and Gazebo: all formats "
        "into a folder, or those that are given a file.",
    )
    add_episode_arguments(parser)
    parser.add_argument("--mjcf", metavar="FILE.xml", help="for stock MuJoCo")
    parser.add_argument("--urdf", metavar="FILE.urdf", help="for ROS")
    parser.add_argument("--sdf", metavar="FILE.sdf", help="a world for Gazebo, with the water")
    parser.add_argument("--mcap", metavar="FILE.mcap", help="the rollout, as a ROS 2 bag")
    parser.add_argument(
        "--out",
        type=read_path,
        metavar="DIR",
        help="all formats into this folder (default: export in the run folder, or "
        "MORPHOLOGY_export here)",
    )
    parser.add_argument(
        "--meshes",
        metavar="PREFIX",
        help="what URDF and SDF put before the names of mesh files, such as "
        "package://my_robot/meshes/ (default: meshes/, beside them)",
    )
    return parser


def _named_files(arguments: argparse.Namespace) -> dict[str, Path]:
    """The files that were asked for by name."""
    files = {}
    for name, endings in _ENDINGS.items():
        given = getattr(arguments, name)
        if given is None:
            continue
        path = Path(given)
        if path.suffix.lower() not in endings:
            raise InputError(
                f"--{name} {path}: expected a name that ends in {' or '.join(endings)}; found "
                f"{path.suffix!r}"
            )
        if path.is_dir():
            raise InputError(f"--{name} {path}: expected a file; found a folder")
        check_place(path, f"--{name} {path}")
        files[name] = path
    if arguments.out is None:
        return files
    if files:
        raise InputError(f"--out: expected a folder or single files; found --{next(iter(files))}")
    folder = Path(arguments.out)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: expected a folder; found a file")
    check_place(folder / "any", f"--out {folder}")
    return {name: folder / file for name, file in _FILES.items()}


def _usual_files(episode: Episode) -> dict[str, Path]:
    """Where files go that were given no name: never over what is there."""
    if episode.folder is not None:
        folder = Path(os.path.normpath(episode.folder / "export"))
    else:
        folder = Path(f"{Path(episode.robot.morphology.name).name}_export")
    if folder.exists():
        raise InputError(f"{folder}: expected no such folder yet; name it with --out to replace it")
    return {name: folder / file for name, file in _FILES.items()}


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
    check_episode_path(arguments.path)
    runtime.prepare_process()
    # JAX takes seconds to import: not for those who ask for help.
    from mjx_revolve.episodes.champion import load_episode
    from mjx_revolve.formats.ros_bag import check_rosbags

    if arguments.mcap is not None:
        check_rosbags()
    episode = load_episode(arguments.path, arguments.world, arguments.duration, arguments.seed)
    files = files or _usual_files(episode)
    lacking = None
    if arguments.mcap is None and "mcap" in files:
        try:
            check_rosbags()
        except InputError as error:  # the other formats do not need it
            lacking = error
            del files["mcap"]
    for path, words in export(episode.robot, files, episode.trajectory, arguments.meshes):
        print(f"{path}: {words}")
    if lacking is not None:
        print(f"no bag: {lacking}", file=sys.stderr)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
