"""Fingerprints of what a run is made of, by which two processes know that they have the same."""

from __future__ import annotations

import hashlib
import importlib.metadata
import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.body.catalogue import load_modules
from mjx_revolve.inputs.own_code import content_name, parse_own
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config

FREE_SETTINGS = ("generations", "checkpoint_every", "keep_checkpoints", "tensorboard")
"""What may change in `evolution` when a run is resumed; all else would make it another run."""
# Settings of a task that runs of older versions know nothing of: as they are usually, they are left
# out of fingerprints, so that such runs can go on.
_LATER_IN_TASK = (
    "target_turn", "sight", "touch",
    "course_spread", "course_changes", "course_turn", "course_rate",
)  # fmt: skip
# What must be the same in all processes of a run, besides our own source.
_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


def hash_text(*texts: str) -> str:
    """A short fingerprint of some texts."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()[:16]


def plain_settings(config: Config) -> dict[str, Any]:
    """All settings that may not change while a run goes on; a world is always a mapping."""
    data = config.model_dump()
    for key in FREE_SETTINGS:
        del data["evolution"][key]
    if isinstance(data["world"], str):
        data["world"] = {"name": data["world"]}
    return data


def settings_hash(config: Config) -> str:
    """Of all settings that may not change while a run goes on.

    Files count by their content, not by their place; so do the users' own tasks and controllers.
    The robot and the world have a fingerprint of their own (`model_hash`).
    """
    data = plain_settings(config)
    del data["morphology"], data["modules"]
    for section in ("controller", "task"):
        data[section]["type"] = content_name(data[section]["type"])
        if not data[section]["params"]:  # as runs have it from before there were any
            del data[section]["params"]
    for sensor in data["controller"]["sensors"] or ():
        for key in ("at", "each"):  # likewise
            if sensor[key] is None:
                del sensor[key]
    if config.modules is not None:  # which tell brains more than the configuration does
        kinds = {kind.name: kind.sensors for kind in load_modules(config.modules).values()}
        brought = {name: [s.to_mapping() for s in own] for name, own in kinds.items() if own}
        if brought:
            data["controller"]["brought"] = brought
    if not data["task"]["measures"]:  # likewise
        del data["task"]["measures"]
    for name in _LATER_IN_TASK:
        if data["task"][name] == type(config.task).model_fields[name].default:
            del data["task"][name]
    if data["colony"] is None:  # likewise
        del data["colony"]
    if data["bodies"] is None:
        del data["bodies"]
    else:
        bodies = data["bodies"]
        bodies["genotype"] = content_name(bodies["genotype"])
        bodies["seeds"] = [hash_text(Path(path).read_text("utf-8")) for path in bodies["seeds"]]
    data["world"]["name"] = Path(data["world"]["name"]).name
    return hash_text(_dump(data))


def _dump(data: Any) -> str:
    """Nested values as JSON, the same for the same; keys may be other than texts in `params`."""
    return json.dumps(_text_keys(data), sort_keys=True, default=str)


def _text_keys(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(key): _text_keys(item) for key, item in value.items()}
    return [_text_keys(item) for item in value] if isinstance(value, list | tuple) else value


def fitness_hash(config: Config) -> str:
    """Of all settings that a fitness is made of, files by their content.

    Runs that have it in common can share a fitness. It does not know the seed, nor how genes are
    searched for.
    """
    data = plain_settings(config)
    data["evolution"] = config.evolution.population_size
    return hash_text(_dump(_by_content(data)))


def _by_content(value: Any) -> Any:
    """The same nested values, absolute paths of files replaced by what is in them."""
    if isinstance(value, dict):
        return {key: _by_content(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_by_content(item) for item in value]
    if not isinstance(value, str) or parse_own(value):
        return content_name(value) if isinstance(value, str) else value
    if os.path.isabs(value) and os.path.isfile(value):
        return f"{Path(value).name} {hashlib.sha256(Path(value).read_bytes()).hexdigest()}"
    return value


def model_hash(fitness: Any) -> str:
    """Of the compiled robot and the water around it; a fitness without a robot will do."""
    identity = getattr(fitness, "identity", None)
    if isinstance(identity, str):
        return hash_text(identity)
    robot = getattr(fitness, "robot", None)
    return hash_text() if robot is None else hash_text(robot.mj_spec.to_xml(), repr(robot.world))


def program_versions() -> dict[str, str]:
    """What must be the same in all processes of a run: our source and the engines' versions."""
    versions = {name: importlib.metadata.version(name) for name in _PACKAGES}
    return {"mjx_revolve": runtime.source_hash(), **versions}


def identify(fitness: Any) -> dict[str, Any]:
    """What a worker must have in common with its leader: program, precision, robot and world."""
    import jax

    return program_versions() | {
        "precision": str(jax.numpy.zeros(()).dtype),
        "device": jax.default_backend(),
        "robot and world": model_hash(fitness),
    }


def find_difference(expected: dict[str, Any], found: dict[str, Any]) -> str:
    """In what a worker differs from its leader, in words; nothing: in nothing that matters."""
    for name, value in expected.items():
        if found.get(name) != value:
            return f"{name}: expected {value} as the run has it; found {found.get(name)}"
    return ""
