"""Fingerprints of a run's configuration and program, which processes of one run must share."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.body.catalogue import load_modules
from mjx_revolve.inputs.packages import installed_version
from mjx_revolve.inputs.user_code import content_name
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.episodes.settings import NamedFile

FREE_SETTINGS = ("generations", "checkpoint_every", "keep_checkpoints", "tensorboard", "passport")
"""Settings of `evolution` that may change when a run is resumed; others make another run."""
# Settings that older versions lack, by section. With their default values, or with the values in
# effect in those versions (`config.OLDER`), they are left out of fingerprints, so that older runs
# can be resumed.
_LATER = {
    "task": (
        "measures", "unit", "target_turn", "sight", "touch",
        "course_spread", "course_changes", "course_turn", "course_rate", "horizon",
    ),
    "controller": ("between",),
}  # fmt: skip
# Their versions must be the same in all processes of a run.
_PACKAGES = ("jax", "jaxlib", "mujoco", "mujoco-mjx")


def hash_text(*texts: str) -> str:
    """A short fingerprint of some texts."""
    digest = hashlib.sha256()
    for text in texts:
        digest.update(text.encode() + b"\0")
    return digest.hexdigest()[:16]


def plain_settings(config: Config) -> dict[str, Any]:
    """All settings that may not change within a run; a world is always a mapping."""
    from mjx_revolve.episodes.config import state_world

    data = config.model_dump()
    for key in FREE_SETTINGS:
        del data["evolution"][key]
    data["world"] = state_world(data["world"])
    if isinstance(data["world"], str):
        data["world"] = {"name": data["world"]}
    return data


def settings_hash(config: Config, by_path: bool = False, older_world: Collection[str] = ()) -> str:
    """Fingerprint of all settings that may not change within a run.

    Files count by their content, not by their path; so do the users' own tasks and controllers.
    The robot and the world have a fingerprint of their own (`model_hash`).

    Args:
        config: of the run.
        by_path: whether current fields and data count by their path, as they did in older runs.
        older_world: fields of the world that are left out with values of older runs.
    """
    from mjx_revolve.episodes.config import OLDER, OLDER_WORLD, Config
    from mjx_revolve.episodes.settings import map_files
    from mjx_revolve.water.world import World

    def by_content(file: NamedFile) -> str:
        if file.kind == "morphology":
            return hash_text(Path(file.path).read_text("utf-8"))
        if file.kind == "code":
            return content_name(file.text)
        return file.text if file.kind == "world" or by_path else file.digest()

    data = plain_settings(config)
    del data["morphology"], data["modules"]
    data["world"]["name"] = Path(data["world"]["name"]).name
    worlds = {name: getattr(World, name) for name in OLDER_WORLD}
    _leave_out(data["world"], worlds | {name: OLDER_WORLD[name] for name in older_world})
    data = map_files(data, by_content, Config)
    for section in ("controller", "task"):
        _leave_out(data[section], {"params": {}})
    for sensor in data["controller"]["sensors"] or ():
        _leave_out(sensor, {"at": None, "each": None})
    if config.modules is not None:  # types of modules may have sensors of their own
        kinds = {kind.name: kind.sensors for kind in load_modules(config.modules).values()}
        brought = {name: [s.to_mapping() for s in own] for name, own in kinds.items() if own}
        if brought:
            data["controller"]["brought"] = brought
    for section, names in _LATER.items():
        fields = type(getattr(config, section)).model_fields
        usual = {name: fields[name].default for name in names}
        _leave_out(data[section], usual | OLDER[section])
    if (bodies := data["bodies"]) is not None:
        _leave_out(bodies, {"max_of": {}, "cloning": 0.0})
        _leave_out(bodies["selection"], {"passport": "made", "reevaluate": False})
    _leave_out(data, {"colony": None, "bodies": None, "coefficients": None})
    return hash_text(_dump(data))


def _leave_out(data: dict[str, Any], older: Mapping[str, object]) -> None:
    """Removes settings that older runs lack, where they have the values in effect there."""
    for name, value in older.items():
        if name in data and data[name] == value:
            del data[name]


def _dump(data: object) -> str:
    """Nested values as JSON, the same for the same; keys may be other than texts in `params`."""
    return json.dumps(_text_keys(data), sort_keys=True, default=str)


def _text_keys(value: object) -> object:
    if isinstance(value, dict):
        return {str(key): _text_keys(item) for key, item in value.items()}
    return [_text_keys(item) for item in value] if isinstance(value, list | tuple) else value


def fitness_hash(config: Config) -> str:
    """Fingerprint of all settings that a fitness depends on, files by their content.

    Runs of equal fingerprints can share a fitness. Seed and strategy are not part of it.
    """
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.episodes.settings import map_files

    def by_content(file: NamedFile) -> str:
        return f"{Path(file.path).name} {file.function} {file.digest()}"

    data = plain_settings(config)
    data["evolution"] = config.evolution.population_size
    return hash_text(_dump(map_files(data, by_content, Config)))


def model_hash(fitness: object) -> str:
    """Fingerprint of the compiled robot and its water; empty for a fitness without a robot."""
    from mjx_revolve.episodes.fitness import Fitness
    from mjx_revolve.evolution.body_fitness import BodyFitness

    if isinstance(fitness, BodyFitness):
        return hash_text(fitness.identity)
    if isinstance(fitness, Fitness):
        return hash_text(fitness.robot.mj_spec.to_xml(), repr(fitness.robot.world))
    return hash_text()


def identify(fitness: object) -> dict[str, Any]:
    """Program, precision, robot and world, which must be equal in all processes of a run."""
    import jax

    return {
        "mjx_revolve": runtime.source_hash(),
        **{name: installed_version(name) for name in _PACKAGES},
        "precision": str(jax.numpy.zeros(()).dtype),
        "variables": runtime.unusual_modes(),
        "device": jax.default_backend(),
        "robot and world": model_hash(fitness),
    }


def find_difference(expected: dict[str, Any], found: dict[str, Any]) -> str:
    """A difference between two results of `identify`, in words; "" where they are equal."""
    for name, value in expected.items():
        if found.get(name) != value:
            return f"{name}: expected {value} as the run has it; found {found.get(name)}"
    return ""
