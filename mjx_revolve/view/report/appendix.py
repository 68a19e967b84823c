"""The end of a report: the robot's modules, and all that it takes to repeat the runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import yaml

from mjx_revolve.body.morphology import Morphology
from mjx_revolve.view.report.data import RunRecord
from mjx_revolve.view.report.groups import Group
from mjx_revolve.view.report.page import escape, fold, listing, table
from mjx_revolve.view.report.repeat import environment, repeat_commands


def module_table(morphology: Morphology) -> str:
    """The modules of a robot by type.

    Args:
        morphology: the robot.

    Returns:
        HTML.
    """
    kinds = Counter(
        (m.kind.name, m.kind.mass, m.kind.volume, tuple(
            (part.name, part.boxes[0].size) for part in m.kind.parts
        ))
        for m in morphology.modules
    )  # fmt: skip
    rows = []
    for (name, mass, volume, parts), count in kinds.items():
        sizes = [(part, " × ".join(f"{1e3 * edge:.3g}" for edge in size)) for part, size in parts]
        boxes = sizes[0][1] if len(sizes) == 1 else "; ".join(f"{p} {s}" for p, s in sizes)
        rows.append([
            name, count, f"{1e3 * mass:.4g}", f"{1e3 * mass * count:.4g}", f"{1e6 * volume:.4g}",
            f"{1e6 * volume * count:.4g}", boxes,
        ])  # fmt: skip
    foot = ["all", morphology.num_modules, "", f"{1e3 * morphology.mass:.4g}", "",
            f"{1e6 * morphology.volume:.4g}",
            " × ".join(f"{1e3 * x:.4g}" for x in morphology.extent)]  # fmt: skip
    header = ["module", "count", "mass\ng", "together\ng", "displaced volume\ncm³",
              "together\ncm³", "boxes, x × y × z\nmm; all: at rest"]  # fmt: skip
    return table(header, rows, left=(0, 6), foot=foot, wrap=(6,))


def robots(found: Sequence[tuple[str, Morphology]]) -> str:
    """The robots, each once.

    Args:
        found: names of groups and their robots.

    Returns:
        HTML.
    """
    from mjx_revolve.inspect import module_table as lines

    parts: list[str] = []
    seen: list[Morphology] = []
    for name, morphology in found:
        if any(morphology == other for other in seen):
            continue
        seen.append(morphology)
        hinges = f"{morphology.num_hinges} hinges"
        hinges += f", {morphology.num_thrusters} thrusters" if morphology.num_thrusters else ""
        heading = f"{morphology.name}: {morphology.num_modules} modules, {hinges}"
        heading += f" ({name})" if len(found) > 1 and len({m.name for _, m in found}) > 1 else ""
        parts.append(f"<h3>{escape(heading)}</h3>{module_table(morphology)}")
        parts.append(fold("Every module and its place", listing("\n".join(lines(morphology)))))
    return "".join(parts)


def repeat(groups: Sequence[Group]) -> str:
    """How to get the same runs again.

    Args:
        groups: all groups.

    Returns:
        HTML.
    """
    parts = []
    several = sum(len(group.records) for group in groups) > 1
    for group in groups:
        for record in group.records:
            commands = repeat_commands(record)
            rows = environment(record)
            if several:
                seed = "" if record.seed is None else f", seed {record.seed}"
                parts.append(f"<h3>{escape(record.label)}{escape(seed)}</h3>")
            if not commands:
                parts.append("<p>Its settings could not be read, so there is no command.</p>")
            for words, command in commands:
                parts.append(f'<p class="soft">{escape(words)}:</p>{listing(command, True)}')
            if rows:
                inside = table(["", ""], rows, left=(0, 1), wrap=(1,)).replace(
                    "<thead>", '<thead hidden>'
                )  # fmt: skip
                parts.append(fold("Versions and machine", inside, not several))
            parts.append(_sources(record))
    parts.append(
        '<p class="soft">The same bits come out on the same kind of processor, with the versions '
        "named and the same thread settings; elsewhere, the same to rounding at first.</p>"
    )
    return "".join(parts)


def _sources(record: RunRecord) -> str:
    """Configuration and robot as text, so that the page alone is enough."""
    parts = []
    config = record.folder / "config.yaml"
    if record.settings and config.is_file():
        parts.append(fold("config.yaml", listing(config.read_text(errors="replace"))))
    morphology = record.config.morphology if record.config is not None else None
    if morphology is not None and Path(morphology).is_file():
        name = Path(morphology).name
        parts.append(fold(name, listing(Path(morphology).read_text(errors="replace"))))
    if record.genes is not None:
        data: dict[str, Any] = {"genes": [float(gene) for gene in record.genes]}
        text = yaml.safe_dump(data, default_flow_style=None, width=90)
        parts.append(fold("The champion's genes", listing(text)))
    return "".join(parts)
