"""How to repeat a run: command lines, versions, and the machine that its bits depend on."""

from __future__ import annotations

import shlex
from pathlib import Path

import yaml

from mjx_revolve.episodes.config import Config, load_config
from mjx_revolve.evolution.fingerprints import settings_hash
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.view.report.record import RunRecord

# Set to 1 by the command itself where the environment does not set them.
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
    threads, flags = record.info.get("threads"), record.info.get("xla_flags")
    values = {name: threads.get(name) for name in _THREADS} if isinstance(threads, dict) else {}
    before = [f"{name}={shlex.quote(value)}" for name, value in values.items()
              if isinstance(value, str) and value != "1"]  # fmt: skip
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
        if not _is_same(load_config(file, settings), record.config):
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
    """Whether all settings are; files by their content, because a run has copies of its own."""
    return (
        settings_hash(config) == settings_hash(other)
        and config.evolution == other.evolution
        and _contents(config) == _contents(other)
    )


def _contents(config: Config) -> list[bytes | str | None]:
    """Contents of the files that a configuration names, or the names of what is no file."""
    world = config.world if isinstance(config.world, str) else config.world["name"]
    seeds = config.bodies.seeds if config.bodies else ()
    names = (config.morphology, *seeds, config.modules, world)
    return [Path(n).read_bytes() if n is not None and Path(n).is_file() else n for n in names]


def environment(record: RunRecord) -> list[tuple[str, str]]:
    """What a run's bits depend on beside its settings, as far as `run.json` says: name, value."""
    info = record.info
    rows: list[tuple[str, str]] = []
    versions, threads, resumed = (info.get(n) for n in ("versions", "threads", "resumed"))
    if isinstance(versions, dict):
        rows.append(("versions", ", ".join(f"{name} {value}" for name, value in versions.items())))
    if isinstance(git := info.get("git"), str):
        rows.append(("git revision", f"{git.rstrip('+')}{' with changes' * git.endswith('+')}"))
    names = {"platform": "platform", "cpu": "processor", "cpu_count": "cores", "device": "device"}
    rows += [(words, str(info[name])) for name, words in names.items() if info.get(name)]
    if isinstance(threads, dict):
        known = ", ".join(f"{name} {value}" for name, value in threads.items() if value)
        rows.append(("threads", known))
    times = [f"{name} {info[name]}" for name in ("started", "finished") if info.get(name)]
    if times:
        rows.append(("time", ", ".join(times)))
    if isinstance(resumed, list) and resumed:
        after = [str(entry.get("generation")) for entry in resumed if isinstance(entry, dict)]
        rows.append(("resumed after generation", ", ".join(after)))
    return rows


def sources(record: RunRecord) -> list[tuple[str, str]]:
    """Names and texts of configuration, robot and genes, so that the page alone is enough."""
    config, named = record.folder / "config.yaml", record.config and record.config.morphology
    robot = Path(named) if named else record.folder / "champion" / "morphology.yaml"
    paths = [config] * bool(record.settings) + [robot]
    # Never files elsewhere: a page is shown to others, and a run has copies of its own.
    inside = record.folder.resolve()
    texts = [
        (path.name, path.read_text(encoding="utf-8", errors="replace")) for path in paths
        if path.is_file() and path.resolve().is_relative_to(inside)
    ]  # fmt: skip
    if record.genes is not None:
        data = {"genes": [float(gene) for gene in record.genes]}
        genes = yaml.safe_dump(data, default_flow_style=None, width=90)
        texts.append(("The champion's genes", genes))
    return texts
