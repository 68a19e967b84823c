"""Command line and function: one HTML file that replays an episode in any browser.

``python -m mjx_revolve.viewer runs/mine``

The file holds everything: the robot's meshes, its poses and the forces on its modules along the
episode, three.js, and the page's own scripts in `viewer_page/`. It needs no server and asks for
nothing over the network.
"""

from __future__ import annotations

import base64
import dataclasses
import html
import json
import math
import os
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

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
    from mjx_revolve.water.flow import Water
    from mjx_revolve.water.world import World

_PAGE = Path(__file__).parent / "view" / "viewer_page"

# Poses per second, and how many at most: a long episode gets fewer per second.
_RATE, _MOST = 50.0, 3000
# Red, green, blue of the arrows.
_COLORS = {
    "buoyancy": (0.56, 0.93, 1.0),
    "drag": (1.0, 0.30, 0.42),
    "thrust": (1.0, 0.83, 0.25),
}
# Three quarters of a kind's arrows are shorter than the first of these shares of the body's length,
# and all are shorter than the second; of a small body, than these lengths [m].
_ARROW, _LONGEST = (0.3, 0.1), (0.65, 0.22)
# Forces below this are rounding [N].
_NOTHING = 1e-5
# A bed that is further below than this is lost in the water's haze [m].
_SIGHT = 25.0
# The bed is drawn on rings from the way's middle to the horizon.
_RINGS, _SECTORS = 110, 96


def write_viewer(episode: Episode, path: str | Path) -> None:
    """Writes the replay of an episode as one HTML file.

    The file appears whole or not at all.

    Args:
        episode: what to show; rows after the first that is not finite are left out.
        path: of the file, which ends in `.html`; its folder is made if need be.

    Raises:
        InputError: `path` has another ending, or the episode has no finite row.
        OSError: the file cannot be written.
    """
    from mjx_revolve.inputs.files import write_atomic

    write_atomic(check_page_path(path), make_page(episode).encode())


def check_page_path(path: str | Path) -> Path:
    """The path of a page to write.

    Args:
        path: as a user gave it.

    Returns:
        The same.

    Raises:
        InputError: it does not end in `.html`, or is a folder.
    """
    path = Path(path)
    if path.suffix.lower() not in (".html", ".htm"):
        raise InputError(f"{path}: expected a file name that ends in .html; found {path.name!r}")
    if path.is_dir():
        raise InputError(f"{path}: expected a file to write; found a folder")
    return path


def make_page(episode: Episode) -> str:
    """The replay of an episode as the text of an HTML file.

    Args:
        episode: what to show.

    Returns:
        The page.

    Raises:
        InputError: the episode has no finite row.
    """
    data = page_data(episode)
    read = lambda name: (_PAGE / name).read_text(encoding="utf-8")  # noqa: E731
    style = read("style.css")
    for name, color in _COLORS.items():
        level = [round(255 * x) for x in color]
        style = style.replace(
            "{{" + name.upper() + "}}", f"rgb({level[0]}, {level[1]}, {level[2]})"
        )
    # "</" would end the script that holds it.
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("</", "<\\/")
    fields = {
        "TITLE": html.escape(episode.title),
        "SUBTITLE": html.escape(_subtitle(episode)),
        "STYLE": style,
        "GRID": f"{data['grid']['step']:g}",
        "GRID_ON": "false" if data["world"]["bed"] else "true",
        "EPISODE": text,
        "LICENSE": read("LICENSE.three"),
        "THREE": read("three.min.js"),
        "SCRIPT": read("shaders.js") + read("scene.js") + read("app.js"),
    }
    # Cut once at every mark, so that nothing is looked for in what was put in.
    first, *rest = read("page.html").split("{{")
    pieces = [first]
    for piece in rest:
        name, tail = piece.split("}}", 1)
        pieces += [fields[name], tail]
    return "".join(pieces)


# --------------------------------------------------------------------- what the page is given


def page_data(episode: Episode) -> dict[str, Any]:
    """What the page's scripts read, as plain values for JSON.

    Args:
        episode: what to show.

    Returns:
        Arrays are packed: base64 of little-endian float32 as `f32`, or of int16 as `i16` with a
        `scale`. Along time there is a row each `step` seconds.

    Raises:
        InputError: the episode has no finite row.
    """
    from mjx_revolve.view.forces import module_forces, sum_modules
    from mjx_revolve.view.swim_picture import smooth_path, stroke_period

    robot, trajectory = episode.robot, _finite(episode)
    world, length = robot.world, robot.morphology.length
    every = _stride(np.asarray(trajectory.time, float))
    water: Water | None = episode.water
    forces = module_forces(robot, trajectory, every, water)
    time, qpos = forces.time, np.asarray(trajectory.qpos, float)[forces.rows]
    step = float(time[-1] - time[0]) / max(len(time) - 1, 1) or world.timestep
    period = stroke_period(time, qpos[:, 7:])
    weight = robot.fluid.volume / robot.fluid.volume.sum()
    center = smooth_path(time, np.einsum("spi,p->si", forces.place, weight), period)
    place, quat = _poses(robot, qpos)
    by_module = {
        name: sum_modules(robot, getattr(forces, name)) for name in ("buoyancy", "drag", "thrust")
    }
    low = _lowest(robot, forces.place)
    surface = _first(world.surface_height if water is None else water.surface_height)
    bed = _bed(world, center, low)
    depth = surface - float(qpos[:, 2].min())
    net = qpos[-1, :2] - qpos[0, :2]
    moved = float(np.linalg.norm(net)) > 0.05 * length
    return {
        "length": length,
        "start": float(time[0]),
        "step": step,
        "count": len(time),
        # Of the way, from x towards y [deg]; who stays is shown along y.
        "heading": math.degrees(math.atan2(net[1], net[0])) if moved else 90.0,
        "core": _f32(qpos[:, :3]),
        "center": _f32(center),
        "speed": _f32(_speed(qpos[:, :3], step, period)),
        "drift": _f32(_drift(robot, forces.rows, time, trajectory, center, water, step)),
        "robot": _robot(robot, place, quat, step),
        "anchors": _anchors(robot),
        "forces": {
            name: {"color": _COLORS[name], "scale": _scale(force, length), "force": _i16(force)}
            for name, force in by_module.items()
        },
        "world": {"surface": surface, "waves": _waves(world, water), "bed": bed},
        "grid": {"height": low - 0.1 * length, "step": _round(0.6 * length)},
        "deepest": max(1.3 * depth, surface - low, 1.5 * length),
    }


def _finite(episode: Episode) -> Any:
    """The trajectory up to its first row that is not finite."""
    import jax

    kept = jax.tree.map(np.asarray, episode.trajectory)
    finite = np.isfinite(kept.qpos).all(1) & np.isfinite(kept.qvel).all(1)
    count = len(finite) if finite.all() else int(finite.argmin())
    if count == 0:
        raise InputError("trajectory.qpos: expected finite numbers in its first row; found none")
    return jax.tree.map(lambda x: x[:count], kept)


def _stride(time: np.ndarray) -> int:
    """Rows from one pose that is kept to the next."""
    dt = float(time[-1] - time[0]) / (len(time) - 1) if len(time) > 1 else 1.0
    return max(1, round(1 / (_RATE * dt)), math.ceil(len(time) / _MOST))


def _poses(robot: Robot, qpos: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`[S, nbody, 3]` positions [m] and `[S, nbody, 4]` quaternions of the bodies but the world."""
    import mujoco

    data = mujoco.MjData(robot.mj_model)
    place, quat = [], []
    for row in qpos:
        data.qpos[:] = row
        mujoco.mj_kinematics(robot.mj_model, data)
        place.append(data.xpos[1:].copy())
        quat.append(data.xquat[1:].copy())
    turns = np.array(quat)
    # q and -q are the same rotation: neighbours in time take the nearer one.
    flips = np.where((turns[1:] * turns[:-1]).sum(-1) < 0, -1.0, 1.0)
    turns[1:] *= np.cumprod(flips, axis=0)[..., None]
    return np.array(place), turns


def _robot(robot: Robot, place: np.ndarray, quat: np.ndarray, step: float) -> dict[str, Any]:
    """Meshes of the parts, on which bodies they are, and how those move."""
    from mjx_revolve.view.pictures import make_pieces

    fluid, modules = robot.fluid, robot.morphology.modules
    row = np.cumsum([0] + [len(module.kind.parts) for module in modules])
    shapes: dict[bytes, int] = {}
    packed: list[Any] = []
    pieces: list[Any] = []
    seen: set[int] = set()
    for piece in make_pieces(robot.morphology):
        k = int(row[piece.module]) + piece.part
        if k in seen:  # after the parts come rods and arrows, for pictures at rest
            continue
        seen.add(k)
        part = modules[piece.module].kind.parts[piece.part]
        # The module's frame seen from the body; the table has the centre of the part's main box.
        center = np.asarray(part.position) + np.asarray(part.boxes[0].position)
        matrix = np.eye(4)
        matrix[:3, :3] = fluid.rotation[k]
        matrix[:3, 3] = fluid.position[k] - fluid.rotation[k] @ center
        key = np.round(piece.corners, 7).tobytes()
        if key not in shapes:
            shapes[key] = len(packed)
            packed.append(_i16(piece.corners))
        pieces.append(
            {
                "body": int(fluid.body[k]) - 1,
                "shape": shapes[key],
                "color": [round(float(x), 4) for x in piece.color],
                "matrix": [round(float(x), 7) for x in matrix.T.ravel()],  # by columns
            }
        )
    return {
        "bodies": place.shape[1],
        "shapes": packed,
        "pieces": pieces,
        "position": _f32(place),
        "quaternion": _i16(quat),
    }


def _anchors(robot: Robot) -> list[dict[str, Any]]:
    """Where each module's arrows begin: at the centre of its part that displaces most."""
    fluid, anchors = robot.fluid, []
    for module in range(robot.morphology.num_modules):
        rows = np.flatnonzero(fluid.module == module)
        k = int(rows[fluid.volume[rows].argmax()])
        place = fluid.position[k] + fluid.rotation[k] @ fluid.center_of_volume[k]
        anchors.append({"body": int(fluid.body[k]) - 1, "place": place.round(6).tolist()})
    return anchors


def _scale(force: np.ndarray, length: float) -> float:
    """Length of an arrow per newton [m/N]; 0 where there is no such force."""
    size = np.linalg.norm(force, axis=-1)
    size = size[size > _NOTHING]
    if not size.size:
        return 0.0
    usual, longest = (max(share * length, least) for share, least in (_ARROW, _LONGEST))
    return min(usual / float(np.percentile(size, 75)), longest / float(size.max()))


def _waves(world: World, water: Water | None) -> list[dict[str, float]]:
    """The world's waves as a cos(k·p - ωt + φ), t of the episode."""
    begun = 0.0 if water is None else _first(water.time)
    waves = []
    for wave in world.waves:
        if wave.amplitude == 0:
            continue
        k = wave.wavenumber(world.gravity, world.water_depth)
        x, y = math.cos(wave.direction), math.sin(wave.direction)
        along = k * (x * world.current[0] + y * world.current[1])
        omega = wave.frequency(world.gravity, world.water_depth) + along
        phase = math.remainder(wave.phase - omega * begun, 2 * math.pi)
        waves.append({
            "k": k, "x": x, "y": y, "amplitude": wave.amplitude, "omega": omega, "phase": phase,
        })  # fmt: skip
    return waves


def _drift(
    robot: Robot,
    rows: np.ndarray,
    time: np.ndarray,
    trajectory: Any,
    center: np.ndarray,
    water: Water | None,
    step: float,
) -> np.ndarray:
    """How far the water around the robot has gone, its waves apart: `[S, 3]` [m]."""
    from mjx_revolve.view.forces import water_at
    from mjx_revolve.water.flow import flow

    now = water_at(robot, rows, time, len(trajectory.time), water)
    still = dataclasses.replace(robot.world, waves=())
    velocity, _ = flow(still, now, *center.T.astype(np.float32))
    speed = np.stack([np.broadcast_to(np.asarray(x, float), time.shape) for x in velocity], -1)
    return np.concatenate([np.zeros((1, 3)), np.cumsum(step * speed[:-1], axis=0)])


def _speed(path: np.ndarray, step: float, period: float | None) -> np.ndarray:
    """Speed along a path over the stroke around each row, or over a second: `[S]` [m/s]."""
    rows, last = np.arange(len(path)), len(path) - 1
    whole = min(max(1, round((period or 1.0) / step)), last)
    if whole == 0:
        return np.zeros(1)
    # A whole stroke at the path's ends too, or the to and fro within one would show.
    first = np.clip(rows - whole // 2, 0, last - whole)
    return np.linalg.norm(path[first + whole] - path[first], axis=1) / (whole * step)


def _lowest(robot: Robot, place: np.ndarray) -> float:
    """A height below all parts along the way [m]."""
    reach = np.linalg.norm(robot.fluid.half_size, axis=1)
    return float((place[..., 2] - reach).min())


def _bed(world: World, center: np.ndarray, low: float) -> dict[str, Any] | None:
    """The bed on rings around the way, or None where it is out of sight."""
    from mjx_revolve.water.bed import bed_height

    if world.bed is None:
        return None
    middle = (center.min(0) + center.max(0)) / 2
    radius = np.concatenate([[0.0], np.geomspace(0.1, 1500.0, _RINGS - 1)])
    angle = 2 * np.pi * np.arange(_SECTORS) / _SECTORS
    x = middle[0] + radius[:, None] * np.cos(angle)
    y = middle[1] + radius[:, None] * np.sin(angle)
    height = np.asarray(bed_height(world.bed, x.astype(np.float32), y.astype(np.float32)))
    reach = float(np.ptp(center[:, :2], axis=0).max()) + _SIGHT
    if low - float(height[radius <= reach].max()) > _SIGHT:
        return None
    return {
        "center": middle[:2].tolist(),
        "rings": _RINGS,
        "sectors": _SECTORS,
        "radius": _f32(radius),
        "height": _f32(height),
    }


def _subtitle(episode: Episode) -> str:
    """Score, body and water in a line."""
    robot, world = episode.robot, episode.robot.world
    body = robot.morphology
    words = []
    if episode.score is not None:
        words.append(f"{episode.score:.3g} {episode.score_unit} over fresh starts")
    words.append(_counted(body.num_modules, "module"))
    words += [_counted(n, name) for n, name in ((body.num_hinges, "hinge"),) if n]
    words += [_counted(n, name) for n, name in ((body.num_thrusters, "thruster"),) if n]
    words.append(world.name.replace("_", " "))
    if any(world.current):
        words.append(f"current {math.hypot(*world.current):.2g} m/s")
    moving = {"gusts": world.gust, "shear": world.shear, "a field of currents": world.current_field}
    words += [name for name, value in moving.items() if value is not None]
    if world.waves:
        height = 2 * math.hypot(*(wave.amplitude for wave in world.waves))
        words.append(f"waves of {height:.2g} m")
    return " \u00b7 ".join(words)


def _counted(n: int, name: str) -> str:
    return f"{n} {name}" + ("" if n == 1 else "s")


# --------------------------------------------------------------------- small things


def _f32(values: Any) -> dict[str, str]:
    """Packs numbers whole."""
    return {"f32": base64.b64encode(np.asarray(values, "<f4").tobytes()).decode()}


def _i16(values: np.ndarray) -> dict[str, Any]:
    """Packs numbers to 1/32767 of the largest."""
    most = float(np.abs(values).max(initial=0.0))
    scale = most / 32767 if most > 0 else 1.0
    whole = np.round(values / scale).astype("<i2")
    return {"i16": base64.b64encode(whole.tobytes()).decode(), "scale": scale}


def _first(value: Any) -> float:
    """A number, or the first of its rows."""
    return float(np.ravel(np.asarray(value, float))[0])


def _round(value: float) -> float:
    """The largest of 1, 2, 5 times a power of ten up to a value."""
    power = 10.0 ** math.floor(math.log10(value))
    return next(k * power for k in (5, 2, 1) if k * power <= value * 1.0001)


# --------------------------------------------------------------------- the command line


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
        prog="python -m mjx_revolve.viewer",
        description="Write one HTML file that replays an episode in any browser, offline.",
    )
    add_episode_arguments(parser)
    parser.add_argument(
        "--out",
        type=read_path,
        metavar="FILE.html",
        help="default: viewer.html in the run folder, or the morphology's name in the current "
        "folder",
    )
    arguments = parser.parse_args(argv)
    if arguments.out is not None:
        check_page_path(arguments.out)
        check_place(arguments.out, arguments.out)
    check_episode_path(arguments.path)
    runtime.prepare_process()
    # JAX takes seconds to import: not for those who ask for help.
    from mjx_revolve.episodes.champion import load_episode

    episode = load_episode(arguments.path, arguments.world, arguments.duration, arguments.seed)
    out = arguments.out or _usual_path(episode)
    write_viewer(episode, out)
    size = Path(out).stat().st_size / 1e6
    print(f"{out}: {episode.trajectory.time[-1]:.4g} s, {size:.2f} MB; open it in a browser")
    return 0


def _usual_path(episode: Episode) -> Path:
    """Where a page goes that was given no name: never over a file that is there."""
    if episode.folder is not None:
        path = Path(os.path.normpath(episode.folder / "viewer.html"))
    else:
        path = Path(f"{episode.robot.morphology.name}.html")
    if path.exists():
        raise InputError(f"{path}: expected no such file yet; name it with --out to replace it")
    return path


if __name__ == "__main__":
    sys.exit(run_command(main))
