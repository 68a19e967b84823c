"""Finds an OpenGL that works, with a screen or without, and whether there is a screen.

MuJoCo chooses OpenGL when it is imported, by the environment variable MUJOCO_GL, and then has no
second try. Here each way of making a context is tried in a process of its own, where a driver that
crashes does no harm. Nothing here imports MuJoCo, so it can run before that.
"""

from __future__ import annotations

import os
import subprocess
import sys
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from mjx_revolve.inputs.errors import InputError

# Code that makes a context, by its name in MUJOCO_GL, in the order of trying.
_WAYS = {
    "linux": ("egl", "osmesa", "glfw"),
    "darwin": ("cgl", "glfw"),
    "win32": ("glfw",),
}
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
        raise InputError(f"MUJOCO_GL={wish}: expected OpenGL to draw with; found it switched off")
    if wish and wish not in ("enable", "enabled", "on", "true", "1"):
        if wish not in ways:
            raise InputError(f"MUJOCO_GL: expected one of {', '.join(ways)}; found {wish!r}")
        ways = (wish,)
    if system == "linux" and not _has_display() and not wish:
        ways = tuple(way for way in ways if way != "glfw")
    for way in ways:
        if _works(way):
            return way
    chosen = f" by MUJOCO_GL={wish}" if wish in ways else ""
    hint = ": apt-get install libegl1 libgl1-mesa-dri" if system == "linux" else ""
    raise InputError(
        f"OpenGL: expected one of {', '.join(ways)} to draw with{chosen}; found none that works "
        f"(install one{hint})"
    )


def check_screen(
    option: str = "--view", hint: str = "without --view a film is written, which needs none"
) -> None:
    """Refuses an option that needs a screen where there is none.

    Args:
        option: that needs a screen.
        hint: what to do without one.

    Raises:
        InputError: there is no screen.
    """
    if sys.platform.startswith("linux") and not _has_display():
        raise InputError(
            f"{option}: expected a screen; found neither DISPLAY nor WAYLAND_DISPLAY set ({hint})"
        )
    # MuJoCo's viewer would end the process with a complaint of its own.
    import glfw

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        if not glfw.init():
            raise InputError(
                f"{option}: expected a screen; found none that lets us open a window ({hint})"
            )


@contextmanager
def open_window(option: str, model: Any, data: Any, **more: Any) -> Iterator[Any]:
    """MuJoCo's viewer without its side panels.

    Args:
        option: of the command line, for the message.
        model: MuJoCo's.
        data: its state.
        more: arguments of `mujoco.viewer.launch_passive`.

    Yields:
        The window's handle.

    Raises:
        InputError: there is no screen with OpenGL.
    """
    import mujoco.viewer

    before = set(threading.enumerate())
    try:
        window = mujoco.viewer.launch_passive(
            model, data, show_left_ui=False, show_right_ui=False, **more
        )
    except Exception as error:  # GLFW's, X's and macOS's reasons come in many kinds
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise InputError(f"{option}: expected a screen with OpenGL; found: {reason}") from None
    with window:
        yield window
    # The viewer's thread must be through with GLFW before Python ends, and GLFW with it.
    for thread in set(threading.enumerate()) - before:
        if "_launch" in thread.name:
            thread.join(timeout=10.0)


def _has_display() -> bool:
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _works(way: str) -> bool:
    """Whether a context can be made so, tried in a process of its own."""
    known = ("PYOPENGL_PLATFORM", "MUJOCO_GL")
    environment = {name: value for name, value in os.environ.items() if name not in known}
    # MuJoCo's own choice at import is harmless and of no interest: ours follows.
    environment["MUJOCO_GL"] = "disable"
    try:
        done = subprocess.run(
            [sys.executable, "-P", "-c", _PROBE, way],
            env=environment,
            capture_output=True,
            timeout=_TIMEOUT,
            check=False,
        )
    except (OSError, subprocess.SubprocessError):
        return False
    return done.returncode == 0
