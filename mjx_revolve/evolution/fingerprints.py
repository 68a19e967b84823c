"""Fingerprints of what a run is made of, by which two processes know that they have the same."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.inputs.own_code import content_name

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config

FREE_SETTINGS = ("generations", "checkpoint_every", "keep_checkpoints", "tensorboard")
"""What may change in `evolution` when a run is resumed; all else would make it another run."""


def hash_text(*texts: str) -> str:
    """A short fingerprint of some texts."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()[:16]


def settings_hash(config: Config) -> str:
    """Of all settings that may not change while a run goes on.

    Files count by their content, not by their place; so do the users' own tasks and controllers.
    The robot and the world have a fingerprint of their own (`model_hash`).

    Args:
        config: the configuration.

    Returns:
        16 hexadecimal digits.
    """
    data = config.model_dump(exclude={"morphology", "modules"})
    for key in FREE_SETTINGS:
        del data["evolution"][key]
    for section in ("controller", "task"):
        data[section]["type"] = content_name(data[section]["type"])
        if not data[section]["params"]:  # as runs have it from before there were any
            del data[section]["params"]
    if isinstance(data["world"], str):
        data["world"] = {"name": data["world"]}
    data["world"]["name"] = Path(data["world"]["name"]).name
    return hash_text(json.dumps(data, sort_keys=True, default=str))


def model_hash(fitness: Any) -> str:
    """Of the compiled robot and the water around it.

    Args:
        fitness: from `make_fitness`; one without a robot will do.

    Returns:
        16 hexadecimal digits.
    """
    robot = getattr(fitness, "robot", None)
    return hash_text() if robot is None else hash_text(robot.mj_spec.to_xml(), repr(robot.world))
