"""Writes docs/settings.md, every task, controller and setting, and the schemas of YAML files.

    python docs/settings.py

Both from the code that reads them; tests compare them, so that they cannot go stale.
"""

from __future__ import annotations

import ast
import inspect
import re
import sys
import textwrap
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

from pydantic_core import PydanticUndefined

from mjx_revolve import schema
from mjx_revolve.control.table import CONTROLLERS
from mjx_revolve.episodes import config as settings
from mjx_revolve.episodes.strategy_names import STRATEGY_NAMES
from mjx_revolve.episodes.tasks import TASKS
from mjx_revolve.inputs.validation_messages import describe, fields_of
from mjx_revolve.water.bed import Bed
from mjx_revolve.water.buoyancy import BUOYANCY_LAWS
from mjx_revolve.water.currents import Gust, Shear, Wave
from mjx_revolve.water.drag import DRAG_LAWS
from mjx_revolve.water.law_names import list_coefficients
from mjx_revolve.water.plates import Fossen, LiftDrag
from mjx_revolve.water.world import SurfaceTension, World

PAGE = Path(__file__).with_name("settings.md")
SCHEMAS = Path(schema.__file__).with_name("schemas")
# The parts of a world that are mappings of their own.
_PARTS: dict[str, type] = {
    "bed": Bed, "gust": Gust, "shear": Shear, "waves": Wave, "lift_drag": LiftDrag,
    "surface_tension": SurfaceTension,
}  # fmt: skip
_HEAD = """# Tasks, controllers and all settings

Written by `python docs/settings.py` from the code that reads configurations; do not edit it by
hand. Each setting can be replaced on the command line, as in `--set task.duration=5`; what is left
out has the value under "usual". `task.robust`, `bodies`, `bodies.archive`, `colony` and
`colony.energy` are off where they are left out; with them come their usual values
(`task.robust: true` has all of its own). A value that does not fit is refused with one line that
says what was expected.
"""

_FAILED = """Frames are those of `docs/glossary.md`; heights are those of the robot's `point`.

A rollout that is no longer finite counts as blown up, with a score of -1000; so does one that gets
farther from its start than a robot could in the episode: at √(9 + F) m/s (F the thrusters' newtons)
and the water's own velocity (currents, shear, field and gusts; waves go round), with its length
and, if it sinks, its free fall. Lower scores of a task of your own count as -1000: scale them."""


def meanings(kind: type) -> dict[str, str]:
    """What each field means: the docstring behind it, or its line under `Attributes`."""
    found: dict[str, str] = {}
    (tree,) = ast.parse(textwrap.dedent(inspect.getsource(kind))).body
    assert isinstance(tree, ast.ClassDef)
    for field, after in zip(tree.body, tree.body[1:], strict=False):
        said = after.value if isinstance(after, ast.Expr) else None
        if isinstance(field, ast.AnnAssign) and isinstance(said, ast.Constant):
            found[ast.unparse(field.target)] = " ".join(str(said.value).split())
    _, _, listed = (inspect.getdoc(kind) or "").partition("Attributes:\n")
    for name, text in re.findall(r"^    (\w+): (.*(?:\n {8,}.*)*)", listed, re.MULTILINE):
        found.setdefault(name, " ".join(text.split()))
    return found


def usual(field: Any) -> str:
    """The value of a field that is left out."""
    value = field.get_default(call_default_factory=True)
    if value is PydanticUndefined:
        return "must be given"
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, tuple) and value and isinstance(value[0], tuple):
        return "all 0"
    if isinstance(value, tuple):
        return f"`[{', '.join(f'{x:.7g}' if isinstance(x, float) else str(x) for x in value)}]`"
    if isinstance(value, int | float | str | dict):
        return f"`{value:.7g}`" if isinstance(value, float) else f"`{value}`"
    return "as below"


def table(kind: type, prefix: str = "") -> Iterator[str]:
    """A class's settings, those of other sections apart."""
    meant = meanings(kind)
    yield "| setting | takes | usual | |"
    yield "|---|---|---|---|"
    for name, field in fields_of(kind).items():
        if "Config" in str(field.annotation):
            continue
        takes = describe(Annotated[(field.annotation, field)])
        cells = (f"`{prefix}{name}`", takes, usual(field), meant.get(name, ""))
        yield f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"
    yield ""


def sections(kind: Any, prefix: str = "") -> Iterator[tuple[str, type]]:
    """The sections of a section, in order."""
    for name, field in fields_of(kind).items():
        options = [field.annotation, *getattr(field.annotation, "__args__", ())]
        for option in options:
            if inspect.isclass(option) and option.__name__.endswith("Config"):
                yield prefix + name, option
                yield from sections(option, f"{prefix}{name}.")


def first_paragraph(function: Any) -> str:
    """Of a docstring, on one line."""
    return " ".join((inspect.getdoc(function) or "").partition("\n\n")[0].split())


def law_tables() -> list[str]:
    """The laws that a world or a module can choose, and their coefficients."""
    lines = [
        "### Laws",
        "",
        "| law | what it is | in a step | `task.robust` |",
        "|---|---|---|---|",
    ]
    lines += [f"| `buoyancy: {law.name}` | {law.summary} | | |" for law in BUOYANCY_LAWS.values()]
    for law in DRAG_LAWS.values():
        step = "explicit" if law.explicit else "implicit"
        varied = "varied" if law.varied else "refused"
        lines.append(f"| `drag: {law.name}` | {law.summary} | {step} | {varied} |")
    lines += ["", "Coefficients of modules; those without a field stand under `coefficients`.", ""]
    lines += ["| coefficient | law | unit | usual | meaning |", "|---|---|---|---|---|"]
    for law_name, c in list_coefficients():
        where = c.name if c.own_field else f"coefficients.{c.name}"
        meaning = f"{c.meaning}; or three, along the part's axes" if c.per_axis else c.meaning
        lines.append(f"| `{where}` | `{law_name}` | {c.unit} | `{c.default:g}` | {meaning} |")
    return [*lines, ""]


def make_page() -> str:
    """The page."""
    lines = [_HEAD, "## Tasks", "", "`task.type`; `docs/tutorial.md` writes one of your own.", ""]
    lines += ["| task | score | unit | cannot do without |", "|---|---|---|---|"]
    for name, task in TASKS.items():
        needs = [f"`{x}`" for x in settings.TASKS[name]] + ["a world with a bed"] * task.on_bed
        needs += ["`target` or `target_distance`"] * (name in settings.TO_TARGETS)
        said = re.sub(r" \[[^\]]+\].$", "", first_paragraph(task.score))
        lines.append(f"| `{name}` | {said} | {task.unit} | {', '.join(needs)} |")
    lines += ["", *_FAILED.split("\n")]
    lines += [
        "",
        "## Controllers",
        "",
        "`controller.type`; a function in a user's own file as well.",
        "",
    ]
    lines += ["| controller | | settings that only it has |", "|---|---|---|"]
    for name, kind in CONTROLLERS.items():
        only = ", ".join(f"`{x}`" for x in kind.settings)
        lines.append(f"| `{name}` | {first_paragraph(kind.make)} | {only} |")
    lines += ["", "## A configuration", "", "`docs/evolution.md` describes `bodies`.", ""]
    lines += table(settings.Config)
    for name, kind in sections(settings.Config):
        lines += [f"### `{name}`: {first_paragraph(kind)}", ""]
        lines += table(kind, f"{name}.")
    strategies = ", ".join(f"`{name}`" for name in STRATEGY_NAMES)
    where = "`evolution.strategy` and `bodies.learning.strategy`"
    lines += ["### Strategies", "", f"{where}, by evosax's names: {strategies}."]
    lines += ["", "## A world", "", "`docs/physics.md` has the laws.", ""]
    lines += table(World)
    lines += law_tables()
    for name, kind in (_PARTS | {"fossen": Fossen}).items():
        of = " (of a module)" if kind is Fossen else ""
        lines += [f"### `{name}`{of}: {first_paragraph(kind)}", ""]
        lines += table(kind, f"{name}.")
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    PAGE.write_text(make_page(), encoding="utf-8")
    for kind in schema.KINDS:
        SCHEMAS.joinpath(f"{kind}.json").write_text(schema.show_schema(kind), encoding="utf-8")
    sys.exit(0)
