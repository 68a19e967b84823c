"""A running world in MuJoCo's own viewer: one model of all robots, posed and not simulated.

When robots come or go, the window loads another model.
"""

from __future__ import annotations

import math
import time
from concurrent.futures import Future
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.film.opengl import open_window
from mjx_revolve.view.film.stage import SURFACE, build_stage, robot_qpos
from mjx_revolve.view.live.commands import Command, Current, Drop, Pause, Remove, Reset
from mjx_revolve.view.live.simulation import LiveSimulation

# How far robots get before they leave what is drawn, and the range of sight [m]. Choices.
_WAY, _SIGHT = 10.0, 12.0
_FPS = 60
_BEHIND = 0.15  # the world, so that there is a pose to go to [s]
_STEP = 0.05  # by which a key changes the current [m/s]
_NOTE = 4.0  # how long an error is shown [s]
# GLFW's numbers of keys that MuJoCo's viewer has no use for, or none that harms.
_ENTER, _DELETE, _END, _HOME = 257, 261, 269, 268
_ARROWS = {262: (1, 0), 263: (-1, 0), 265: (0, 1), 264: (0, -1)}
_HELP = (
    "Enter\n.\nDelete\narrows\nEnd\nSpace\nHome",
    "drop\nanother one\ntake the last out\ncurrent\nstill water\npause\nreset",
)


class KeyBindings:
    """Commands that keys post.

    Attributes:
        simulation: receives them.
        chosen: index in the catalogue of the robot that is dropped next.
    """

    def __init__(self, simulation: LiveSimulation) -> None:
        self.simulation, self.chosen = simulation, 0
        self._error = (-math.inf, "")

    def press(self, key: int) -> None:
        """Posts a key's command; called by the window's thread with GLFW's number of the key."""
        if key == ord("."):
            self.chosen = (self.chosen + 1) % len(self.simulation.catalogue)
            return
        try:
            command = self._command(key)
        except InputError as error:  # a current too fast
            self._error = time.monotonic(), str(error)
            return
        if command is not None:
            self.simulation.ask(command).add_done_callback(self._done)

    def _command(self, key: int) -> Command | None:
        simulation = self.simulation
        if key in _ARROWS:
            (x, y, z), (dx, dy) = simulation.current, _ARROWS[key]
            return Current((x + _STEP * dx, y + _STEP * dy, z))
        if key == _DELETE:
            return Remove(simulation.robots[-1].key) if simulation.robots else None
        commands: dict[int, Command] = {
            _ENTER: Drop(self.chosen),
            _END: Current((0.0, 0.0, 0.0)),
            ord(" "): Pause(not simulation.paused),
            _HOME: Reset(),
        }
        return commands.get(key)

    def _done(self, future: Future[int | None]) -> None:
        if error := future.exception():
            self._error = time.monotonic(), str(error)

    def words(self) -> tuple[str, str]:
        """What the window says, in two columns."""
        simulation, (when, error) = self.simulation, self._error
        rows = {
            "next": simulation.catalogue[self.chosen].name,
            "current": ", ".join(f"{v:.2f}" for v in simulation.current) + " m/s",
            "time": f"{simulation.time:.1f} s" + (" (paused)" if simulation.paused else ""),
            "robots": str(len(simulation.robots)),
        }
        if simulation.busy:
            rows["wait"] = f"compiling, {simulation.busy:.0f} s"
        if time.monotonic() < when + _NOTE:
            rows["no"] = error
        return "\n".join(rows), "\n".join(rows.values())


class LiveScene:
    """The model of all robots in the water.

    Attributes:
        keys: of the robots.
        model: MuJoCo's.
        data: its state; only `qpos` is ever set.
    """

    def __init__(self, simulation: LiveSimulation) -> None:
        robots = {one.key: one.robot for one in simulation.robots}
        self.keys = tuple(robots)
        self.model = build_stage(robots, simulation.world, way=_WAY, sight=_SIGHT)
        self.data = mujoco.MjData(self.model)
        self.pose(dict(simulation.qpos))
        mujoco.mj_forward(self.model, self.data)

    def pose(self, qpos: dict[int, np.ndarray]) -> None:
        """Poses robots by key `[7 + num_hinges]`; one that has no pose stays."""
        for key in self.keys:
            if key in qpos:
                robot_qpos(self.model, self.data, key)[:] = qpos[key]


def show_window(simulation: LiveSimulation) -> None:
    """Shows a running world in MuJoCo's viewer until its window is closed, or the world ends.

    Args:
        simulation: runs in another thread.

    Raises:
        InputError: there is no screen with OpenGL.
    """
    keys, scene = KeyBindings(simulation), LiveScene(simulation)
    shown = open_window("--mujoco", scene.model, scene.data, key_callback=keys.press)
    with shown as window:
        with window.lock():
            window.cam.lookat[:] = (0.0, 0.0, simulation.world.surface_height - 1.0)
            window.cam.distance, window.cam.azimuth, window.cam.elevation = 3.0, 110.0, -18.0
            window.opt.geomgroup[SURFACE] = 1
        clock, last = simulation.time, time.monotonic()
        while window.is_running() and not simulation.ended:
            if tuple(one.key for one in simulation.robots) != scene.keys:
                scene = LiveScene(simulation)
                _load(window, scene)
            now = time.monotonic()
            # The time to show: a little behind the world's, without jumps.
            passed, aim = now - last, simulation.time - (0 if simulation.paused else _BEHIND)
            pace = 0.0 if simulation.paused else simulation.rate
            moved = clock + passed * pace + (aim - clock) * min(1.0, 3 * passed)
            clock, last = aim if abs(aim - clock) > 1.0 else max(clock, moved), now
            with window.lock():
                scene.pose(simulation.poses_at(clock))
                mujoco.mj_kinematics(scene.model, scene.data)
                mujoco.mj_camlight(scene.model, scene.data)
            window.set_texts([
                (None, mujoco.mjtGridPos.mjGRID_TOPLEFT, *keys.words()),
                (mujoco.mjtFontScale.mjFONTSCALE_100, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT, *_HELP),
            ])  # fmt: skip
            window.sync()
            time.sleep(1.0 / _FPS)


def _load(window: Any, scene: LiveScene) -> None:
    """Shows another model, from the same side."""
    cam = window.cam
    lookat, side = cam.lookat.copy(), (cam.distance, cam.azimuth, cam.elevation)
    # The handle has no way to load another model; the viewer itself does it so.
    window._get_sim().load(scene.model, scene.data, "")
    with window.lock():
        cam = window.cam
        cam.lookat[:] = lookat
        cam.distance, cam.azimuth, cam.elevation = side
