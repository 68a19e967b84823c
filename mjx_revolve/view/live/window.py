"""A running world in MuJoCo's own viewer: one model of all who are there, posed and not simulated.

Who comes or goes makes another model, which the window loads.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.film.stage import SURFACE, build_shared_stage
from mjx_revolve.view.live.keeper import Keeper
from mjx_revolve.view.live.wishes import Current, Drop, Pause, Remove, Reset, Wish

# How far robots get before they leave what is drawn, and how far one sees [m]. Choices.
_WAY, _SIGHT = 10.0, 12.0
_FPS = 60
_BEHIND = 0.15  # the world, so that there is a pose to go to [s]
_STEP = 0.05  # by which a key changes the current [m/s]
_NOTE = 4.0  # how long a complaint is shown [s]
# GLFW's numbers of keys that MuJoCo's viewer has no use for, or none that harms.
_ENTER, _DELETE, _RIGHT, _LEFT, _DOWN, _UP, _HOME, _END = 257, 261, 262, 263, 264, 265, 268, 269
_HELP = (
    "Enter\n.\nDelete\narrows\nEnd\nSpace\nHome",
    "drop\nanother one\ntake the last out\ncurrent\nstill water\npause\nreset",
)


@dataclass(eq=False)
class Hands:
    """What keys ask for.

    Attributes:
        keeper: who is asked.
        chosen: number in the stock of who is dropped next.
        note: what was refused last.
    """

    keeper: Keeper
    chosen: int = 0
    note: tuple[float, str] = field(default=(-math.inf, ""))

    def press(self, key: int) -> None:
        """Does what a key is for; called by the window's thread.

        Args:
            key: GLFW's number of it.
        """
        keeper = self.keeper
        x, y, z = keeper.current
        pushes = {_RIGHT: (1, 0), _LEFT: (-1, 0), _UP: (0, 1), _DOWN: (0, -1)}
        if key == ord("."):
            self.chosen = (self.chosen + 1) % len(keeper.stock)
        elif key == _ENTER:
            self._ask(lambda: Drop(self.chosen))
        elif key == _DELETE and keeper.inmates:
            self._ask(lambda: Remove(keeper.inmates[-1].key))
        elif key in pushes:
            dx, dy = pushes[key]
            self._ask(lambda: Current((x + _STEP * dx, y + _STEP * dy, z)))
        elif key == _END:
            self._ask(lambda: Current((0.0, 0.0, 0.0)))
        elif key == ord(" "):
            self._ask(lambda: Pause(not keeper.paused))
        elif key == _HOME:
            self._ask(Reset)

    def _ask(self, make: Callable[[], Wish]) -> None:
        try:
            self.keeper.ask(make()).add_done_callback(self._hear)
        except InputError as error:  # a current too fast
            self.note = time.monotonic(), str(error)

    def _hear(self, future: Any) -> None:
        if error := future.exception():
            self.note = time.monotonic(), str(error)

    def words(self) -> tuple[str, str]:
        """What the window says, in two columns."""
        keeper, (when, note) = self.keeper, self.note
        left = ["next", "current", "time", "robots"]
        current = ", ".join(f"{v:.2f}" for v in keeper.current)
        right = [
            keeper.stock[self.chosen].name,
            f"{current} m/s",
            f"{keeper.time:.1f} s" + (" (paused)" if keeper.paused else ""),
            str(len(keeper.inmates)),
        ]
        if keeper.busy:
            left.append("wait")
            right.append(f"compiling, {keeper.busy:.0f} s")
        if time.monotonic() < when + _NOTE:
            left.append("no")
            right.append(note)
        return "\n".join(left), "\n".join(right)


@dataclass(eq=False)
class Scene:
    """The model of all who are there.

    Attributes:
        keys: of whom, in their order.
        model: MuJoCo's.
        data: its state; only `qpos` is ever set.
    """

    keys: tuple[int, ...]
    model: mujoco.MjModel
    data: mujoco.MjData

    def pose(self, qpos: dict[int, np.ndarray]) -> None:
        """Puts robots where they are.

        Args:
            qpos: `[7 + num_hinges]` by key; who is not in it stays.
        """
        for key in self.keys:
            if key in qpos:
                begin = int(self.model.joint(f"{key}/root").qposadr[0])
                self.data.qpos[begin : begin + len(qpos[key])] = qpos[key]


def make_scene(keeper: Keeper, dressed: dict[int, Robot]) -> Scene:
    """Composes the model of all who are there.

    Args:
        keeper: whose world.
        dressed: robots by body that were drawn before; new ones join them. They are built anew:
            MuJoCo's models of those that are stepped are for others to change.

    Returns:
        The scene, everybody posed.
    """
    inmates = keeper.inmates
    for one in inmates:
        if one.body not in dressed:
            dressed[one.body] = build_robot(one.robot.morphology, keeper.world)
    robots = {one.key: dressed[one.body] for one in inmates}
    model = build_shared_stage(robots, keeper.world, _WAY, _SIGHT)
    scene = Scene(tuple(robots), model, mujoco.MjData(model))
    scene.pose(dict(keeper.qpos))
    mujoco.mj_forward(model, scene.data)
    return scene


def poses_at(keeper: Keeper, moment: float) -> dict[int, np.ndarray]:
    """Where everybody was at a moment [s], between the poses that are known."""
    recent = list(keeper.recent)
    if not recent:
        return dict(keeper.qpos)
    k = next((k for k, (when, _) in enumerate(recent) if when >= moment), len(recent) - 1)
    late, after = recent[k]
    early, before = recent[max(k - 1, 0)]
    share = 1.0 if late <= early else min(max((moment - early) / (late - early), 0.0), 1.0)
    found = {}
    for key, pose in after.items():
        other = before.get(key, pose).copy()
        if other[3:7] @ pose[3:7] < 0:
            other[3:7] *= -1
        found[key] = (1 - share) * other + share * pose  # MuJoCo normalises quaternions itself
    return found


def show_window(keeper: Keeper) -> None:
    """Shows a running world in MuJoCo's viewer until its window is closed, or the world ends.

    Args:
        keeper: who runs it, in another thread.

    Raises:
        InputError: there is no screen with OpenGL.
    """
    import mujoco.viewer

    dressed: dict[int, Robot] = {}
    hands, scene = Hands(keeper), make_scene(keeper, dressed)
    before = set(threading.enumerate())
    try:
        window = mujoco.viewer.launch_passive(
            scene.model, scene.data, key_callback=hands.press, show_left_ui=False,
            show_right_ui=False,
        )  # fmt: skip
    except Exception as error:  # GLFW's, X's and macOS's reasons come in many kinds
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"--mujoco: expected a screen with OpenGL; found: {reason}") from None
    clock, last = keeper.time, time.monotonic()
    with window:
        with window.lock():
            window.cam.lookat[:] = (0.0, 0.0, keeper.world.surface_height - 1.0)
            window.cam.distance, window.cam.azimuth, window.cam.elevation = 3.0, 110.0, -18.0
            window.opt.geomgroup[SURFACE] = 1
        while window.is_running() and not keeper.ended:
            if tuple(one.key for one in keeper.inmates) != scene.keys:
                scene = make_scene(keeper, dressed)
                camera = _camera(window)
                # The handle has no way to load another model; the viewer itself does it so.
                window._get_sim().load(scene.model, scene.data, "")
                with window.lock():
                    _put_camera(window, camera)
            now = time.monotonic()
            clock, last = _follow(clock, keeper, now - last), now
            with window.lock():
                scene.pose(poses_at(keeper, clock))
                mujoco.mj_kinematics(scene.model, scene.data)
                mujoco.mj_camlight(scene.model, scene.data)
            window.set_texts([
                (None, mujoco.mjtGridPos.mjGRID_TOPLEFT, *hands.words()),
                (mujoco.mjtFontScale.mjFONTSCALE_100, mujoco.mjtGridPos.mjGRID_BOTTOMLEFT, *_HELP),
            ])  # fmt: skip
            window.sync()
            time.sleep(1.0 / _FPS)
    # The viewer's thread must be through with GLFW before Python ends, and GLFW with it.
    for thread in set(threading.enumerate()) - before:
        if "_launch" in thread.name:
            thread.join(timeout=10.0)


def _follow(clock: float, keeper: Keeper, passed: float) -> float:
    """The time to show: a little behind the world's, without jumps."""
    aim = keeper.time - _BEHIND
    if abs(aim - clock) > 1.0:
        return aim
    if keeper.paused:
        return clock + (keeper.time - clock) * min(1.0, 4 * passed)
    moved = clock + passed * keeper.rate + (aim - clock) * min(1.0, 2.5 * passed)
    return min(max(clock, moved), keeper.time)


def _camera(window: Any) -> tuple[Any, ...]:
    cam = window.cam
    return cam.lookat.copy(), cam.distance, cam.azimuth, cam.elevation


def _put_camera(window: Any, camera: tuple[Any, ...]) -> None:
    cam = window.cam
    cam.lookat[:], cam.distance, cam.azimuth, cam.elevation = camera
