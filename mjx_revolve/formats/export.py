"""Export of a robot, its trajectory and its brain to files for other programs."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.engine.robot import Robot
from mjx_revolve.episodes.simulate import Trajectory
from mjx_revolve.formats.brain import Brain
from mjx_revolve.formats.brain_c import make_brain_c
from mjx_revolve.formats.brain_python import make_brain_python
from mjx_revolve.formats.brain_ros import make_brain_node
from mjx_revolve.formats.links import make_links, make_meshes
from mjx_revolve.formats.mjcf import make_mjcf
from mjx_revolve.formats.ros_bag import pick_rows, write_bag
from mjx_revolve.formats.sdf import make_sdf
from mjx_revolve.formats.urdf import make_urdf
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import write_atomic

# Where meshes go, beside the files that name them.
_MESHES = "meshes"
_FORMATS = "mjcf", "urdf", "sdf", "mcap", "controller"


def export_robot(
    robot: Robot,
    files: Mapping[str, str | Path],
    trajectory: Trajectory | None = None,
    meshes: str | None = None,
    brain: Brain | None = None,
) -> list[tuple[Path, str]]:
    """Writes a robot, its trajectory and its brain for other programs.

    Each file appears whole or not at all; files that are there are replaced.

    Args:
        robot: from `build_robot`.
        files: path by format ("mjcf", "urdf", "sdf", "mcap", "controller"). URDF and SDF have their
            meshes in a folder `meshes` beside them, "controller", a Python file, its C files and
            its ROS 2 node.
        trajectory: of the robot; MJCF and SDF have its start, and "mcap" requires it.
        meshes: name of that folder in URDF and SDF; by default `meshes/`, relative to the file.
        brain: from `champion_brain`; "controller" requires it.

    Returns:
        The files, with a description of each.

    Raises:
        InputError: a format is unknown, there is no trajectory for a bag, nothing of it is finite,
            the package that writes bags is missing, or there is no brain for a controller.
        OSError: a file cannot be written.
    """
    for name in files:
        if name not in _FORMATS:
            raise InputError("files", f"formats of {', '.join(_FORMATS)}", repr(name))
    paths = {name: Path(path) for name, path in files.items()}
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
        if name in paths:
            write_atomic(paths[name], make().encode())
            done.append((paths[name], words))
    folders = {paths[name].parent / _MESHES for name in ("urdf", "sdf") if name in paths}
    shapes = make_meshes(robot.morphology) if folders else {}
    for folder in folders:
        for name, mesh in shapes.items():
            content: Any = mesh.export(file_type="stl")
            write_atomic(folder / f"{name}.stl", content)
        done.append((folder, f"{len(shapes)} meshes (STL, m)"))
    if "mcap" in paths:
        if trajectory is None:
            raise InputError("mcap", "a trajectory", "none")
        write_bag(robot, trajectory, paths["mcap"])
        rows, stamps = pick_rows(robot, trajectory)
        words = f"ROS 2 bag: {stamps[-1] / 1e9:.4g} s, {len(rows)} poses"
        done.append((paths["mcap"], f"{words} of {len(make_links(robot))} links"))
    if "controller" in paths:
        if brain is None:
            raise InputError("controller", "a brain", "none")
        done += _write_brain(brain, paths["controller"])
    return done


def _write_brain(brain: Brain, path: Path) -> list[tuple[Path, str]]:
    """Writes a brain as Python, as C beside it, and as a ROS 2 node."""
    header, source = make_brain_c(brain, path.stem)
    rate = f"{brain.rate:.6g} Hz"
    made = (
        (path, make_brain_python(brain), f"the controller in Python; NumPy only; {rate}"),
        (path.with_suffix(".h"), header, "the controller in C99, its header"),
        (path.with_suffix(".c"), source, "the controller in C99"),
        (path.with_name(f"{path.stem}_node.py"), make_brain_node(brain, path.stem),
         f"ROS 2 node around {path.name}"),
    )  # fmt: skip
    for place, text, _ in made:
        write_atomic(place, text.encode())
    return [(place, words) for place, _, words in made]
