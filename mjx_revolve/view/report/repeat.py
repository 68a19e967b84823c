"""How to repeat a run: a command line, versions, and the machine that its bits depend on."""

from __future__ import annotations

import shlex
from pathlib import Path

import yaml

from mjx_revolve.numerics import runtime
from mjx_revolve.view.report.record import RunRecord

# Set to 1 by the command itself where the environment does not set them.
_THREADS = ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


def repeat_command(record: RunRecord) -> str:
    """The command line that evolves the same run again, from its folder, which holds all settings.

    It has the environment that the bits depend on. "" without settings.
    """
    if record.config is None:
        return ""
    threads, flags = record.info.get("threads"), record.info.get("xla_flags")
    values = {name: threads.get(name) for name in _THREADS} if isinstance(threads, dict) else {}
    before = [f"{name}={shlex.quote(value)}" for name, value in values.items()
              if isinstance(value, str) and value != "1"]  # fmt: skip
    if isinstance(flags, str) and (given := runtime.user_flags(flags)):
        before.append(f"XLA_FLAGS={shlex.quote(given)}")
    if isinstance(variables := record.info.get("variables"), dict):
        before += [f"{name}={shlex.quote(str(value))}" for name, value in variables.items()]
    place = record.path
    words = ["python", "-m", "mjx_revolve.evolve", f"{place}/config.yaml"]
    return " ".join([*before, shlex.join([*words, "--out", f"{place}-again"])])


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
    if isinstance(variables := info.get("variables"), dict):
        rows.append(("variables", ", ".join(f"{name} {x}" for name, x in variables.items())))
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
