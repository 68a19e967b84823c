"""How to repeat a run: commands to paste, and what its bits depend on."""

from __future__ import annotations

import shlex
from pathlib import Path

import yaml

from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.evolution.fingerprints import settings_hash
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.report.record import RunRecord

# Set to 1 by the command itself where nobody sets them.
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def repeat_commands(record: RunRecord) -> list[tuple[str, str]]:
    """Command lines that evolve the same run again.

    Args:
        record: the run.

    Returns:
        A few words and a command line each: from the run folder, which holds all settings; and
        from the configuration file that it began with, where that still gives the same settings.
        None of them without settings.
    """
    if record.config is None:
        return []
    again = f"{record.label.rstrip('/')}-again"
    own = [f"{record.label.rstrip('/')}/config.yaml", "--out", again]
    found = [("from this run folder", _line(record, own))]
    started = _started(record)
    if started is not None:
        found.append(("as it was started", _line(record, [*started, "--out", again])))
    return found


def _line(record: RunRecord, arguments: list[str]) -> str:
    """The command, with the environment that its bits depend on."""
    before = []
    threads = record.info.get("threads")
    for name in _THREADS:
        value = threads.get(name) if isinstance(threads, dict) else None
        if isinstance(value, str) and value != "1":
            before.append(f"{name}={shlex.quote(value)}")
    flags = record.info.get("xla_flags")
    if isinstance(flags, str) and flags:
        before.append(f"XLA_FLAGS={shlex.quote(flags)}")
    return " ".join([*before, shlex.join(["python", "-m", "mjx_revolve.evolve", *arguments])])


def _started(record: RunRecord) -> list[str] | None:
    """Configuration file, seed and settings of the command, if they still give this run."""
    file, settings = record.info.get("config_file"), record.info.get("settings", [])
    if not isinstance(file, str) or not isinstance(settings, list) or record.config is None:
        return None
    if not all(isinstance(setting, str) for setting in settings):
        return None
    try:
        config = load_config(file, settings)
        if not _is_same(config, record.config):
            return None
    except (InputError, OSError):
        return None
    path = Path(file)
    near = path.is_relative_to(Path.cwd())
    words = [str(path.relative_to(Path.cwd())) if near else file]
    words += ["--seed", str(record.config.evolution.seed)]
    for setting in settings:
        if setting.partition("=")[0].strip() != "evolution.seed":
            words += ["--set", setting]
    return words


def _is_same(config: Config, other: Config) -> bool:
    """Whether all settings are; files by what they hold, because a run has copies of its own."""
    return (
        settings_hash(config) == settings_hash(other)
        and config.evolution == other.evolution
        and _held(config) == _held(other)
    )


def _held(config: Config) -> list[bytes | str | None]:
    """What is in the files that a configuration names, or the names of what is no file."""
    world = config.world if isinstance(config.world, str) else config.world["name"]
    seeds = config.bodies.seeds if config.bodies else ()
    names = (config.morphology, *seeds, config.modules, world)
    return [Path(n).read_bytes() if n is not None and Path(n).is_file() else n for n in names]


def environment(record: RunRecord) -> list[tuple[str, str]]:
    """What a run's bits depend on beside its settings, as far as `run.json` says: name, value."""
    info = record.info
    rows: list[tuple[str, str]] = []
    versions = info.get("versions")
    if isinstance(versions, dict):
        rows.append(("versions", ", ".join(f"{name} {value}" for name, value in versions.items())))
    git = info.get("git")
    if isinstance(git, str):
        rows.append(("git revision", f"{git.rstrip('+')}{' with changes' * git.endswith('+')}"))
    names = {"platform": "platform", "cpu": "processor", "cpu_count": "cores", "device": "device"}
    rows += [(words, str(info[name])) for name, words in names.items() if info.get(name)]
    threads = info.get("threads")
    if isinstance(threads, dict):
        known = ", ".join(f"{name} {value}" for name, value in threads.items() if value)
        rows.append(("threads", known))
    times = [f"{words} {info[name]}" for name, words in
             (("started", "started"), ("finished", "finished")) if info.get(name)]  # fmt: skip
    if times:
        rows.append(("time", ", ".join(times)))
    resumed = info.get("resumed")
    if isinstance(resumed, list) and resumed:
        after = [str(entry.get("generation")) for entry in resumed if isinstance(entry, dict)]
        rows.append(("resumed after generation", ", ".join(after)))
    return rows


def sources(record: RunRecord) -> list[tuple[str, str]]:
    """Configuration, robot and genes of a run as text, so that the page alone is enough.

    Each with what it is called.
    """
    found = []
    # Never what lies elsewhere: a page is shown to others, and a run has copies of its own.
    inside = record.folder.resolve()
    if record.settings and (record.folder / "config.yaml").is_file():
        found.append(record.folder / "config.yaml")
    named = record.config.morphology if record.config is not None else None
    robot = Path(named) if named else record.folder / "champion" / "morphology.yaml"
    if robot.is_file():
        found.append(robot)
    found = [path for path in found if path.resolve().is_relative_to(inside)]
    texts = [(path.name, path.read_text(encoding="utf-8", errors="replace")) for path in found]
    if record.genes is not None:
        data = {"genes": [float(gene) for gene in record.genes]}
        genes = yaml.safe_dump(data, default_flow_style=None, width=90)
        texts.append(("The champion's genes", genes))
    return texts
