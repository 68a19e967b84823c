"""How a run begins, and how one that was stopped goes on: all that is checked before it does."""

from __future__ import annotations

import contextlib
import datetime
import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.episodes.config import Config, load_config, override_config
from mjx_revolve.evolution.fingerprints import (
    FREE_SETTINGS,
    model_hash,
    plain_settings,
    settings_hash,
)
from mjx_revolve.evolution.memory import check_memory
from mjx_revolve.evolution.pool import Pool
from mjx_revolve.evolution.runs import Checkpoint, Run, check_new_folder, create_run, open_run
from mjx_revolve.evolution.tensorboard import check_tensorboard
from mjx_revolve.inputs.commands import check_place
from mjx_revolve.inputs.errors import InputError, reading
from mjx_revolve.inputs.files import with_path
from mjx_revolve.inputs.own_code import announce, content_name
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.evolution.methods import Method

# What the bits of a run depend on, besides its configuration.
_HOST = ("versions", "cpu", "cpu_count", "device", "threads", "xla_flags")
_RUNS = Path("runs")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Start:
    """A run that is ready to go.

    Attributes:
        run: its folder, locked.
        config: its configuration, which names the folder's copies.
        fitness: what scores a population.
        method: how it is evolved.
        search: where it goes on; None: a new run.
        checkpoint: where `search` is from.
        resumed: whether it was begun before.
    """

    run: Run
    config: Config
    fitness: Pool
    method: Method
    search: Any = None
    checkpoint: Checkpoint | None = None
    resumed: bool = False

    @property
    def resumption(self) -> str:
        """Where a run that was begun before goes on, in words."""
        done = self.search.generation if self.search else 0
        return f"after generation {done}" if done else "from the start: it has no checkpoint yet"

    @property
    def is_finished(self) -> bool:
        """Whether it has all its generations and its champion already."""
        done = self.search.generation if self.search else 0
        return done >= self.config.evolution.generations and "finished" in self.run.info


def begin_run(
    path: str,
    settings: Sequence[str],
    out: str | None,
    make_pool: Callable[[Config], Pool],
    writing: contextlib.AbstractContextManager | None = None,
) -> Start:
    """Begins a new run.

    Args:
        path: the configuration: a file or a shipped one's name.
        settings: what was typed to change it, `KEY.PATH=VALUE` each.
        out: the run folder; None: one below `runs/`, named after the configuration and the time.
        make_pool: makes the fitness.
        writing: entered while the folder is made, as by `Interrupts.writing`.

    Returns:
        The run.

    Raises:
        InputError: the configuration is wrong, or the folder holds something.
        WorkerError: workers cannot be started.
    """
    config = load_config(path, settings)
    if config.evolution.tensorboard:
        check_tensorboard(config.source)
    if out:
        check_new_folder(out)  # before the expensive part
    place = Path(out) if out else _RUNS / "any"
    check_place(place / "any", f"--out {place}")
    _announce_code(config)
    fitness = make_pool(config)
    check_memory(config, fitness.num_genes, getattr(fitness, "genotype", None))
    check_search(config, fitness)
    # Not before: workers compile while evosax is imported, which takes a while.
    from mjx_revolve.evolution.methods import make_method

    info = {
        "started": timestamp(),
        "seed": config.evolution.seed,
        "config_file": str(find_shipped(path, "configs").absolute()),
        "settings": _portable(settings, config),
        "model_hash": model_hash(fitness),
        "settings_hash": settings_hash(config),
        **runtime.describe_process(),
    }
    with writing or contextlib.nullcontext():
        run, config = create_run(out or _claim_folder(config), config, **info)
    return Start(run, config, fitness, make_method(config, fitness))


def check_search(config: Config, fitness: Pool) -> None:
    """Refuses settings that only those can check who have the fitness: a strategy's, for example.

    Args:
        config: the configuration.
        fitness: its fitness.

    Raises:
        InputError: they are wrong.
    """
    from mjx_revolve.evolution.methods import make_method

    try:
        make_method(config, fitness)
    except InputError as error:
        if str(error).startswith(("evolution.", "bodies.")):
            raise InputError(f"{config.source}: {error}") from None
        raise


def continue_run(
    folder: str, path: str | None, settings: Sequence[str], make_pool: Callable[[Config], Pool]
) -> Start:
    """Opens a run that was stopped, at its newest checkpoint that is whole.

    One that was stopped before its first checkpoint begins anew.

    Args:
        folder: the run folder.
        path: the configuration, if it was given again; it must be what the run has.
        settings: what was typed to change it.
        make_pool: makes the fitness.

    Returns:
        The run.

    Raises:
        InputError: it is no run folder, has damaged checkpoints only, or would become another run.
        WorkerError: workers cannot be started.
    """
    label = f"--resume {folder}"
    run = open_run(folder)
    old = run.load_config()
    earlier = run.info.get("settings", [])
    if path is None:
        config = override_config(old, settings)
    else:
        config = load_config(path, [*earlier, *settings])
    check_unchanged(old, config, label)
    free = {key: getattr(config.evolution, key) for key in FREE_SETTINGS}
    config = old.model_copy(update={"evolution": old.evolution.model_copy(update=free)})
    if config.evolution.tensorboard:
        check_tensorboard(label)
    checkpoint = run.load_checkpoint() if run.checkpoints() else None
    for name in checkpoint.damaged if checkpoint else ():
        _log.warning("passed over a damaged checkpoint: %s", name)
    begun = checkpoint.meta if checkpoint else run.info
    settled = settings_hash(config)
    if begun.get("settings_hash", settled) != settled:  # an older version's run.json has none
        raise InputError(f"{label}: expected the config.yaml that it began with; found it changed")
    _announce_code(config)
    fitness = make_pool(config)
    check_memory(config, fitness.num_genes, getattr(fitness, "genotype", None))
    from mjx_revolve.evolution.methods import make_method

    if begun.get("model_hash") != model_hash(fitness):
        raise InputError(
            f"{label}: expected the robot and the world that it began with; found them changed (a "
            "file that config.yaml names, or the program)"
        )
    run.update_info(settings=[*earlier, *_portable(settings, config)])
    method = make_method(config, fitness)
    if checkpoint is None:
        return Start(run, config, fitness, method, resumed=True)
    if found := _differences(checkpoint.meta.get("host"), describe_host()):
        _log.warning(
            "the run continues, but not bit for bit, because this process differs: %s",
            "; ".join(found),
        )
    with reading(checkpoint.path):
        search = method.from_arrays(checkpoint.arrays)
    return Start(run, config, fitness, method, search, checkpoint, resumed=True)


def _announce_code(config: Config) -> None:
    """Tells of users' own code before workers, whom nobody watches, run it."""
    for name in (config.task.type, config.controller.type):
        announce(name)
    if config.bodies is not None:
        announce(config.bodies.genotype)


def _claim_folder(config: Config) -> Path:
    """A new folder of a run that was given none, its own even if others begin at the same time."""
    stem = f"{config.name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    count = 1
    while True:
        folder = _RUNS / (stem if count == 1 else f"{stem}-{count}")
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            count += 1
        except OSError as error:
            raise with_path(error, folder) from None
        else:
            return folder


def _differences(old: Any, new: Any, place: str = "") -> list[str]:
    """Places at which two nested values differ, with both values."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            line
            for key in old | new
            for line in _differences(old.get(key), new.get(key), f"{place}.{key}".strip("."))
        ]
    return [] if old == new else [f"{place}: expected {old!r} as in the run; found {new!r}"]


def check_unchanged(old: Config, new: Config, label: str) -> None:
    """Refuses a configuration that would make another run than the old one.

    Raises:
        InputError: they differ in more than `FREE_SETTINGS`.
    """
    before, after = plain_settings(old), plain_settings(new)
    # The run holds copies of files: what is in them counts, not their places.
    if before["morphology"] and after["morphology"]:
        after["morphology"] = _same_file(before["morphology"], after["morphology"])
    for section, key in (("controller", "type"), ("task", "type"), ("bodies", "genotype")):
        if before[section] and after[section]:
            old_name, new_name = before[section][key], after[section][key]
            if content_name(old_name) == content_name(new_name):
                after[section][key] = old_name
    if before["bodies"] and after["bodies"]:
        seeds = zip(before["bodies"]["seeds"], after["bodies"]["seeds"], strict=False)
        rest = after["bodies"]["seeds"][len(before["bodies"]["seeds"]) :]
        after["bodies"]["seeds"] = (*(_same_file(*pair) for pair in seeds), *rest)
    found = _differences(before, after)
    if found:
        more = f" (and {len(found) - 1} more)" if found[1:] else ""
        free = f"evolution.{', '.join(FREE_SETTINGS)}"
        raise InputError(f"{label}: {found[0]}{more}; only {free} may change")


def _same_file(old: str, new: str) -> str:
    """The old path where the new one holds the same."""
    return old if Path(old).read_bytes() == Path(new).read_bytes() else new


def _portable(settings: Sequence[str], config: Config) -> list[str]:
    """Settings that mean the same in another folder."""
    places = {"morphology": config.morphology, "modules": config.modules}
    places |= {"world": config.world_name, "world.name": config.world_name}
    places |= {"controller.type": config.controller.type, "task.type": config.task.type}
    portable = []
    for setting in settings:
        key, _, value = setting.partition("=")
        is_text = not value.lstrip().startswith("{")
        place = places.get(key.strip()) if is_text else None
        portable.append(f"{key}={place}" if place else setting)
    return portable


def describe_host() -> dict[str, Any]:
    """What the bits of a run depend on, besides its configuration."""
    info = runtime.describe_process()
    return {key: info[key] for key in _HOST}


def timestamp() -> str:
    """Now, in ISO 8601 with the offset from UTC."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")
