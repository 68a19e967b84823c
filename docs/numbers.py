"""Fills the figures of README.md and docs/*.md from docs/results/*.json.

    python docs/numbers.py            # `make numbers`
    python docs/numbers.py --check    # changes nothing; lists what is wrong, exit code 1

A study writes `docs/results/STUDY.json` by `experiments.common.write_results`; its `numbers`, and
its `date`, `versions`, `machine` and `seeds`, are what pages can show. In a line, or in a table's
cell, a template stands in a comment, and what it gives stands between that and `<!--/-->`:

    swims <!--n {shipped.lake_swim.score:.3f}-->0.155<!--/--> body lengths per second

A table has its heading by hand and a row for each element of a list (or mapping, whose keys are
`name`), with blank lines around it, as a comment next to a row would end the table:

    <!--rows bench.spider | {name} | {ours*1e-6:.1f} | {ratio:.0f} |-->

    | case | ours, million steps/s | ratio |
    |---|---|---|
    | default water | 5.8 | 26 |

    <!--/-->

A field is STUDY.KEY.KEY..., in `rows` the row's KEY; an element of a list goes by its place or its
`name`. `*FACTOR` multiplies, the rest is Python's format. An interval reads as its `text`, a list
as its lines, null as –. Renderers drop comments outside code blocks, so that no figure
that is measured can stand in a code block.

Outside these places no figure is allowed: a number with a unit of what is measured (%, times, s,
m/s, GB, ...) or a ±, a number with decimals, a cell of a table that is a number. What is defined or
cited is named, with its reason, in `docs/constants.yaml`: as a fragment of the text, figures
included, or as the heading row of a table, for all of it. `docs/settings.md` is made from the code.
"""

from __future__ import annotations

import argparse
import json
import re
import string
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
RESULTS = ROOT / "docs" / "results"
CONSTANTS = ROOT / "docs" / "constants.yaml"

_MARK = re.compile(r"<!--(?P<kind>n|rows)\s+(?P<template>.*?)-->(?P<shown>.*?)<!--/-->", re.S)
_CODE = re.compile(r"^```(\w*)\n(.*?)^```$|``.*?``|`[^`\n]*`", re.M | re.S)
_NUMBER = r"(?<![\w./-])[±+−-]?(?:\d[\d,]*(?:\.\d+)?|\.\d+)(?:e[-−+]?\d+)?"
_UNIT = (
    r"\s?(?:%|×|times\b|fold\b|[mµn]?s\b|seconds?\b|minutes?\b|hours?\b|h\b|[kcm]?m/s\b"
    r"|(?:body )?lengths|[kMG]i?B\b|bytes\b|[mb]illion|thousand|robot seconds|steps per)"
)
_DECIMAL = r"(?<![\w./-])[+−-]?\d*\.\d+(?![\w.]*\.\d)"
_CELL = rf"(?<=\|)\s*{_NUMBER}\s*(?=\|)"
_FIGURE = re.compile(rf"{_NUMBER}-?{_UNIT}|±\s?[\d.]+|{_DECIMAL}|{_CELL}")
# Packages, whose numbers are versions.
_VERSION = re.compile(
    r"(?:Python|MuJoCo(?: C)?|JAX|NumPy|SciPy|optax|revolve2|jaxlib|jax)\s\(?\d[\d.]+"
)


def list_pages() -> list[Path]:
    """All pages with figures."""
    pages = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    return [page for page in pages if page.name != "settings.md"]


def read_results(folder: Path = RESULTS) -> dict[str, Any]:
    """What the studies found, by study."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        result = json.loads(path.read_text(encoding="utf-8"))
        found[path.stem] = result | result.pop("numbers")
    return found


class _Template(string.Formatter):
    """Fields are ways through mappings and lists; see above."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        name, _, factor = field_name.partition("*")
        value: Any = kwargs
        for key in name.split("."):
            try:
                if not isinstance(value, list):
                    value = value[key]
                elif key.isdigit():
                    value = value[int(key)]
                else:
                    value = next(element for element in value if element["name"] == key)
            except (KeyError, IndexError, TypeError, StopIteration):
                raise KeyError(f"no {key!r} of {name!r} in docs/results") from None
        return (value * float(factor) if factor else value), name

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Mapping):
            return str(value["text"])
        if isinstance(value, list):
            return "\n\n" + "\n".join(map(str, value)) + "\n\n"
        return "–" if value is None else format(value, format_spec)


def fill_mark(mark: re.Match[str], results: Mapping[str, Any]) -> str:
    """A marked place with what its template gives now.

    Raises:
        KeyError: the results have no such field.
        ValueError: a format is wrong, or a table has no heading.
    """
    opening, template = mark[0][: mark.start("shown") - mark.start()], mark["template"].strip()
    if mark["kind"] == "n":
        return f"{opening}{_Template().vformat(template, (), results)}<!--/-->"
    head = re.match(r"\s*(\|.*\|\n\|[-:| ]+\|\n)", mark["shown"])
    if head is None:
        raise ValueError("a table without a heading")
    key, _, row = template.partition(" ")
    found, _ = _Template().get_field(key, (), results)
    if isinstance(found, Mapping):
        found = [{"name": name} | values for name, values in found.items()]
    lines = "".join(_Template().vformat(row.strip(), (), element) + "\n" for element in found)
    return f"{opening}\n\n{head[1]}{lines}\n<!--/-->"


def fill_page(text: str, results: Mapping[str, Any]) -> str:
    """A page with all its marked places filled."""
    return _MARK.sub(lambda mark: fill_mark(mark, results), text)


def find_figures(text: str, constants: Mapping[str, list[str]]) -> Iterator[tuple[int, str]]:
    """Figures outside marked places that are no constants, with their lines.

    Also `(0, fragment)` for each constant that the page does not have.
    """
    # What is taken out leaves its line breaks.
    blank = lambda match: re.sub(r"[^\n]", " ", match[0])  # noqa: E731

    def code(match: re.Match[str]) -> str:
        if match[0].startswith("```"):  # what a listing says in words, or prints
            text = match[1] == "text"
            return match[0] if text else re.sub(r"^[^#\n]*", "", match[0], flags=re.M)
        return blank(match) if re.search(r"[A-Za-z_/=\[{]{2}", match[0]) else match[0]

    text = _MARK.sub(blank, text)
    for fragment in (x for fragments in constants.values() for x in fragments):
        words = r"\s+".join(map(re.escape, fragment.split()))
        table = r"(?:\n\|.*)*" if fragment.startswith("|") and fragment.endswith("|") else ""
        text, count = re.subn(words + table, blank, text)
        if not count:
            yield 0, fragment
    text = _VERSION.sub(blank, re.sub(r"\]\(\S+\)|https?://\S+", blank, _CODE.sub(code, text)))
    for match in _FIGURE.finditer(text):
        line = text.count("\n", 0, match.start()) + 1
        yield line, match[0].strip()


def main(argv: list[str] | None = None) -> int:
    """Fills the pages, or checks them."""
    parser = argparse.ArgumentParser(description="Fills the pages' figures from docs/results.")
    parser.add_argument("--check", action="store_true", help="change nothing, list what is wrong")
    check = parser.parse_args(argv).check
    results, wrong = read_results(), 0
    constants = yaml.safe_load(CONSTANTS.read_text(encoding="utf-8"))
    for page in list_pages():
        text = page.read_text(encoding="utf-8")
        name = page.relative_to(ROOT)
        filled = fill_page(text, results)
        found = find_figures(filled, constants.get(page.name, {}))
        complaints = [(line, f"{figure!r} is in no results file") for line, figure in found]
        if check and filled != text:
            complaints.append((0, "not as docs/results has it: run make numbers"))
        elif filled != text:
            page.write_text(filled, encoding="utf-8")
        for line, what in complaints:
            print(f"{name}:{line}: {what}")
        wrong += len(complaints)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
