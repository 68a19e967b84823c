"""Finds an OpenGL that works, with a screen or without.

MuJoCo chooses OpenGL when it is imported, by the environment variable MUJOCO_GL, and then has no
second try. Here each way of making a context is tried in a process of its own, where a driver that
crashes does no harm. Nothing here imports MuJoCo, so it can run before that.
"""

from __future__ import annotations

import os
import subprocess
import sys

from mjx_revolve.inputs.errors import InputError

# Code that makes a context, by its name in MUJOCO_GL, in the order of trying; elsewhere glfw.
_WAYS = {"linux": ("egl", "osmesa", "glfw"), "darwin": ("cgl", "glfw")}
_PROBE = """
import importlib, sys
import mujoco
context = importlib.import_module("mujoco." + sys.argv[1]).GLContext(64, 64)
context.make_current()
mujoco.MjrContext(mujoco.MjModel.from_xml_string("<mujoco/>"), mujoco.mjtFontScale.mjFONTSCALE_100)
"""
_TIMEOUT = 60  # s for one try


def find_opengl() -> str:
    """Which way of making a context works here.

    Returns:
        "egl", "osmesa", "glfw" or "cgl". Where MUJOCO_GL names one of them, only that is tried.

    Raises:
        InputError: none works; the message says what to install.
    """
    system = "linux" if sys.platform.startswith("linux") else sys.platform
    ways: tuple[str, ...] = _WAYS.get(system, ("glfw",))
    wish = os.environ.get("MUJOCO_GL", "").strip().lower()
    wish = {"glx": "glfw", "wgl": "glfw"}.get(wish, wish)
    if wish in ("disable", "disabled", "off", "false", "0"):
        raise InputError(f"MUJOCO_GL={wish}", "OpenGL to draw with", "it switched off")
    if wish and wish not in ("enable", "enabled", "on", "true", "1"):
        if wish not in ways:
            raise InputError("MUJOCO_GL", f"one of {', '.join(ways)}", repr(wish))
        ways = (wish,)
    display = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if system == "linux" and not display and not wish:
        ways = tuple(way for way in ways if way != "glfw")
    for way in ways:
        if _works(way):
            return way
    chosen = f" by MUJOCO_GL={wish}" if wish in ways else ""
    hint = ": apt-get install libegl1 libgl1-mesa-dri" if system == "linux" else ""
    wanted = f"one of {', '.join(ways)} to draw with{chosen}"
    raise InputError("OpenGL", wanted, f"none that works (install one{hint})")


def _works(way: str) -> bool:
    """Whether a context can be made so, tried in a process of its own."""
    # MuJoCo's own choice at import is harmless and of no interest: ours follows.
    environment = {**os.environ, "MUJOCO_GL": "disable"}
    environment.pop("PYOPENGL_PLATFORM", None)
    try:
        command = [sys.executable, "-P", "-c", _PROBE, way]
        done = subprocess.run(command, env=environment, capture_output=True, timeout=_TIMEOUT)
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0
