"""Packages that are installed or not: those of extras, and MuJoCo's parts."""

from __future__ import annotations

import importlib.util
import re
from importlib.metadata import PackageNotFoundError, version

from mjx_revolve.inputs.errors import InputError

REQUIREMENTS = {
    "av": "av>=18",
    "distributed": "distributed>=2025.1",
    "gymnasium": "gymnasium>=1.1",
    "mujoco.mjx": "mujoco-mjx>=3.17,<3.18",
    "ribs": "ribs>=0.12,<0.13",
    "rosbags": "rosbags>=0.11",
    "stable_baselines3": "stable-baselines3>=2.4",
    "tensorboardX": "tensorboardX>=2.6",
}
"""What brings a module that no part of the base installation has."""


def check_package(place: str, module: str) -> None:
    """Raises `InputError` if a module that only an extra brings is missing, or too old.

    Args:
        place: what needs it.
        module: its name.
    """
    needed = REQUIREMENTS.get(module, "")
    cure = f"(pip install '{needed}')"
    if importlib.util.find_spec(module) is None:
        raise InputError(place, f"the package {module}", f"none {cure}")
    name, _, least = needed.partition(",")[0].partition(">=")
    found = installed_version(name) if name else ""
    if found and _numbers(found) < _numbers(least):
        raise InputError(place, f"{name} {least} or newer", f"{found} {cure}")


def _numbers(text: str) -> list[int]:
    return [int(x) for x in re.findall(r"\d+", text)]


def check_mujoco() -> None:
    """Raises `InputError` where files of MuJoCo 3 and 4 are mixed.

    MuJoCo 4 comes in several distributions, version 3 in one; pip leaves the core of the one in
    place when it replaces the other.
    """
    found, core = installed_version("mujoco"), installed_version("mujoco-core")
    if core not in ("", found):
        cure = "pip uninstall mujoco mujoco-core, then install mujoco again"
        both = f"{found or 'none'} with a mujoco-core of {core} ({cure})"
        raise InputError("mujoco", "one version", both)


def installed_version(name: str) -> str:
    """Version of a distribution; "" where it is not installed."""
    try:
        return version(name)
    except PackageNotFoundError:
        return ""
