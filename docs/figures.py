"""Fills the figures of README.md and docs/*.md from docs/results/*.json.

    python docs/figures.py    # `make numbers`; exit code 1 where something is wrong, one line each

A study writes `docs/results/STUDY.json` by `experiments.common.write_results`; its `numbers`, and
its `date`, `versions`, `machine` and `seeds`, are what pages can show. Within a line, or a table's
cell, a template stands in a comment, and what it gives stands between that and `<!--/-->`:

    swims <!--n {lake_swim.score:.3f}-->0.155<!--/--> body lengths per second

A table has its heading by hand and a row for each element of a list, with blank lines around it, as
a comment next to a row would end the table:

    <!--rows bench.cases | {name} | {rows.0.median*1e-6:.1f} | {ratio:.0f} |-->

    | case | ours, million steps/s | ratio |
    |---|---|---|
    | spider, default water | 5.8 | 26 |

    <!--/-->

A field is STUDY.KEY.KEY..., in `rows` the row's KEY; an element of a list goes by its place or its
`name`. `*NUMBER` and `/NUMBER` scale it, the rest is Python's format. An interval reads as its
`text`, a list as its lines, null as –. Renderers drop comments, but not in code blocks, and a line
that begins with one is no text to them: no place can be there.

Outside these places no figure is allowed: a number with a unit of what is measured (%, times, s,
m/s, GB, ...) or a ±, a number with decimals, a cell of a table that is a number. What is defined or
cited is named, with its reason, in `docs/constants.yaml`: as a fragment of the text, figures
included, or as the first line of a table or listing, for all of it.
"""

from __future__ import annotations

import json
import re
import string
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
# It is made from the code.
_LEFT_OUT = ("settings.md",)
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
PAGES = [page for page in PAGES if page.name not in _LEFT_OUT]

_MARK = re.compile(r"(<!--(n|rows)\s+(?P<template>.*?)-->)(.*?)<!--/-->", re.S)
_CODE = re.compile(r"^```(\w*)\n(.*?)^```$|`(?:[^`\n]|\n(?!\n))+`", re.M | re.S)
_NUMBER = r"(?<![\w./-])[±+−-]?(?:\d[\d,]*(?:\.\d+)?|\.\d+)(?:e[-−+]?\d+)?"
_UNIT = (
    r"\s?(?:%|×(?!\s?[\d.])|times\b|fold\b|[mµn]?s\b|seconds?\b|minutes?\b|hours?\b|h\b|[kcm]?m/s\b"
    r"|(?:body )?lengths|[kMG]i?B\b|bytes\b|[mb]illion|thousand|robot seconds|steps per)"
)
_DECIMAL = r"(?<![\w./-])[+−-]?\d*\.\d+(?![\w.]*\.\d)"
_CELL = rf"(?<=\|)\s*{_NUMBER}\s*(?=\|)"
_FIGURE = re.compile(rf"{_NUMBER}-?{_UNIT}|±\s?[\d.]+|{_DECIMAL}|{_CELL}")
# Addresses, and versions of packages.
_OTHER = re.compile(
    r"\]\(\S+\)|https?://\S+"
    r"|(?:Python|MuJoCo(?: C)?|JAX|NumPy|SciPy|optax|revolve2|jaxlib|jax)\s\(?\d[\d.]+"
)


def read_results() -> dict[str, Any]:
    """What the studies found, by study."""
    paths = sorted((ROOT / "docs" / "results").glob("*.json"))
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in paths}
    return {name: result | result["numbers"] for name, result in found.items()}


class _Template(string.Formatter):
    """Fields are ways through mappings and lists; see above."""

    def get_field(self, field_name: str, args: Any, kwargs: Any) -> tuple[Any, str]:
        name, sign, number = [*re.split(r"([*/])", field_name), "", ""][:3]
        value: Any = kwargs
        for key in name.split("."):
            try:
                if isinstance(value, list):
                    names = {x.get("name"): k for k, x in enumerate(value) if isinstance(x, dict)}
                    value = value[names[key] if key in names else int(key)]
                else:
                    value = value[key]
            except (LookupError, TypeError, ValueError):
                raise KeyError(f"no {key!r} of {name!r} in docs/results") from None
        if sign and value is not None:
            value = value * float(number) if sign == "*" else value / float(number)
        return value, name

    def format_field(self, value: Any, format_spec: str) -> str:
        if isinstance(value, Mapping):
            return str(value["text"])
        if isinstance(value, list):
            return "\n\n" + "\n".join(map(str, value)) + "\n\n"
        return "–" if value is None else format(value, format_spec)


def fill_mark(mark: re.Match[str], results: Mapping[str, Any]) -> str:
    """A marked place with what its template gives now; KeyError, ValueError where it is wrong."""
    opening, kind, template, shown = mark.groups()
    if kind == "n":
        return f"{opening}{_Template().vformat(template, (), results)}<!--/-->"
    key, row = template.split("|", 1)
    found, _ = _Template().get_field(key.strip(), (), results)
    head = re.match(r"\s*(\|.*\|\n\|[-:| ]+\|\n)", shown)
    if head is None:
        raise ValueError(f"{key.strip()}: a table without a heading")
    lines = "".join(_Template().vformat(f"|{row}\n", (), element) for element in found)
    return f"{opening}\n\n{head[1]}{lines}\n<!--/-->"


def find_figures(text: str, fragments: list[str]) -> Iterator[tuple[int, str]]:
    """Lines and what is wrong in them: figures outside marked places that are no constants."""
    for match in re.finditer(r"^ *<!--n .*-->.*\S.*", text, re.M):
        yield text.count("\n", 0, match.start()) + 1, "a line begins with a marked place"
    # What is taken out leaves its line breaks.
    blank = lambda match: re.sub(r"[^\n]", " ", match[0])  # noqa: E731

    def own_words(mark: re.Match[str]) -> str:
        """What a template says beside its fields, which is no result."""
        words = re.sub(r"\{[^}]*\}", " ", mark["template"])
        return words + "\n" * (mark[0].count("\n") - words.count("\n"))

    text = _MARK.sub(own_words, text)
    for fragment in fragments:
        words = r"\s+".join(map(re.escape, fragment.split()))
        words += r"(?:\n\|.*)*" if re.fullmatch(r"\|.*\|", fragment) else ""
        words += r"(?s:.*?)\n```" if fragment.startswith("```") else ""
        text, count = re.subn(words, blank, text)
        if not count:
            yield 0, f"{fragment!r} of docs/constants.yaml is not here any more"

    def words_of(code: re.Match[str]) -> str:
        """What a listing prints, or says in comments; of other code what is a mere number."""
        if code[0].startswith("```"):
            return code[0] if code[1] == "text" else re.sub(r"(?m)^[^#\n]*", "", code[0])
        return blank(code) if re.search(r"[A-Za-z_/=\[{]{2}", code[0]) else code[0]

    text = _OTHER.sub(blank, _CODE.sub(words_of, text))
    for match in _FIGURE.finditer(text):
        line = text.count("\n", 0, match.start()) + 1
        yield line, f"{match[0].strip()!r} is in no results file"


def check_page(page: Path, results: Mapping[str, Any]) -> tuple[str, list[str]]:
    """A page with its marked places filled, and what is wrong with it, in lines."""
    text, name = page.read_text(encoding="utf-8"), page.relative_to(ROOT)
    constants = yaml.safe_load((ROOT / "docs" / "constants.yaml").read_text(encoding="utf-8"))
    fragments = [x for some in constants.get(page.name, {}).values() for x in some]
    wrong = [f"{name}:{line}: {what}" for line, what in find_figures(text, fragments)]
    try:
        return _MARK.sub(lambda mark: fill_mark(mark, results), text), wrong
    except (KeyError, ValueError) as error:
        return text, [*wrong, f"{name}: {error.args[0]}"]


def main() -> int:
    """Fills all pages, and prints what is wrong with them."""
    results, wrong = read_results(), []
    for page in PAGES:
        filled, lines = check_page(page, results)
        wrong += lines
        page.write_text(filled, encoding="utf-8")
    print("\n".join(wrong))
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
