"""Writes the documentation as HTML: these pages, and a reference of all public names.

    python docs/reference.py build/docs

`index.html` is the README; every `docs/*.md` and every notebook becomes a page; the package and
each public subpackage has one with the names that it exports. Where `docs/gallery.py` has written
its pages into the same folder, one leads to them. Made by pdoc.
"""

from __future__ import annotations

import argparse
import importlib
import json
import re
import shutil
import sys
import types
import typing
import warnings
from pathlib import Path
from typing import Any

import pdoc.doc
import pdoc.render
from gallery import describe_gallery

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PACKAGE = "mjx_revolve"
# The order in which a user meets the pages; those not named here follow.
FIRST = (
    "tutorial", "fit", "settings", "evolution", "viewer", "replay", "live", "report", "sweeps",
    "measures", "interchange", "physics", "parallel",
)  # fmt: skip
# The public subpackages in reading order: each imports only from itself and from those before it.
DOORS = (
    "water", "body", "genotypes", "engine", "control", "episodes", "evolution", "formats",
    "fitting", "view",
)  # fmt: skip

_DOT = r'((?:</span><span class="o">)?\.(?:</span><span class="n">)?)'
# What Python says of values and types, and what is meant.
_PLAINER = [
    (re.compile(pattern), better)
    for pattern, better in (
        (rf"jax{_DOT}jaxlib{_DOT}_jax{_DOT}Array", r"jax\1Array"),
        (r"Annotated\[([^&<]*?), (?:Before|After)Validator\(.*?\)\]", r"\1"),
        (r"(?:=\s*)?<span class=\"default_value\">PydanticUndefined</span>", ""),
        (r" at 0x[0-9a-f]{6,}", ""),
    )
]


def list_pages() -> list[Path]:
    """The Markdown pages in a sensible order, the README apart."""
    place = {name: k for k, name in enumerate(FIRST)}
    return sorted(DOCS.glob("*.md"), key=lambda path: (place.get(path.stem, 99), path.stem))


def summary_of(door: str) -> str:
    """The first line of a subpackage's docstring."""
    return (importlib.import_module(f"{PACKAGE}.{door}").__doc__ or "").partition("\n")[0]


def link_text(text: str) -> str:
    """Turns names of our pages in Markdown into links, and pictures' paths into those here."""

    def link(match: re.Match[str]) -> str:
        found = (DOCS / f"{match[1]}.md").is_file()
        return f"[{match[0]}]({match[1]}.html)" if found else match[0]

    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    for k in range(0, len(parts), 2):  # not inside blocks
        parts[k] = re.sub(r"`docs/([\w/]+)\.md`", link, parts[k])
        parts[k] = re.sub(r"`notebooks/(\w+)\.ipynb`", r"[\g<0>](\1.html)", parts[k])
        parts[k] = re.sub(r"\]\(docs/([\w.]+)\)", r"](\1)", parts[k])
        parts[k] = re.sub(r"\]\((\w+)\.md(#[\w-]+)?\)", r"](\1.html\2)", parts[k])
    return "".join(parts)


def read_notebook(path: Path) -> str:
    """A notebook as Markdown, its code in blocks, without results."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    texts = ("".join(cell["source"]) for cell in cells)
    return "\n\n".join(
        text if cell["cell_type"] == "markdown" else f"```python\n{text}\n```"
        for cell, text in zip(cells, texts, strict=True)
    )


def list_texts(folder: Path) -> dict[str, str]:
    """The pages of prose by name, in reading order, as Markdown; the README is `index`."""
    pages = [*sorted((ROOT / "notebooks").glob("*.ipynb")), *list_pages()]
    texts = {"index": ROOT / "README.md"} | {path.stem: path for path in pages}
    read = {
        name: read_notebook(path) if path.suffix == ".ipynb" else path.read_text(encoding="utf-8")
        for name, path in texts.items()
    }
    gallery = describe_gallery(folder)
    first, *rest = read.items()
    return dict([first, *([("gallery", gallery)] if gallery else []), *rest])


def make_page(name: str, text: str) -> types.ModuleType:
    """A page of prose in the clothes of a module, as pdoc wants it."""
    page = types.ModuleType(name, text)
    page.__docformat__ = "markdown"  # type: ignore[attr-defined]
    page.__all__ = []  # type: ignore[attr-defined]
    return page


def mend_tuples(module: types.ModuleType) -> None:
    """Makes a module's named tuples readable.

    Their constructors have annotations as texts, and none of the names that these texts hold; their
    fields have docstrings such as "Alias for field number 0".
    """
    for value in vars(module).values():
        if isinstance(value, type) and issubclass(value, tuple) and hasattr(value, "_fields"):
            new: Any = value.__new__
            new.__annotations__ = typing.get_type_hints(value)
            new.__doc__ = ""
            for name in value._fields:
                getattr(value, name).__doc__ = ""


def mend_checked(module: types.ModuleType) -> None:
    """Makes a module's checked dataclasses readable.

    What their fields are checked for is left out of their types. Their constructors name a type
    that is there for type checkers only.
    """
    for value in vars(module).values():
        if isinstance(value, type) and "__pydantic_fields__" in vars(value):
            init: Any = value.__init__  # type: ignore[misc]
            if "__dataclass_self__" in getattr(init, "__annotations__", {}):
                del init.__annotations__["__dataclass_self__"]
                value.__annotations__ = typing.get_type_hints(value)


def mend_values(document: pdoc.doc.Module) -> None:
    """Gives the tables that a door exports their docstrings, which stand where they are made.

    Their values, which are long, are left out.
    """
    stub = Path(document.source_file or "").with_suffix(".pyi").read_text(encoding="utf-8")
    for home, name in re.findall(r"^from \.([\w.]+) import (\w+)", stub, re.MULTILINE):
        member = document.members[name]
        if isinstance(member, pdoc.doc.Variable):
            made = pdoc.doc.Module(importlib.import_module(f"{document.modulename}.{home}")).members
            # A value that is made when it is first used has the docstring of what makes it.
            vars(member)["docstring"] = made.get(name, made.get("__getattr__")).docstring
            vars(member)["default_value_str"] = ""


def write_docs(folder: Path) -> tuple[list[Path], list[str]]:
    """Writes all pages.

    Args:
        folder: where to; files of the same names are replaced.

    Returns:
        The HTML files, and what pdoc could not make sense of.
    """
    texts = list_texts(folder)
    documents: dict[str, pdoc.doc.Module] = {
        name: pdoc.doc.Module(make_page(name, link_text(text))) for name, text in texts.items()
    }
    for door in [PACKAGE, *(f"{PACKAGE}.{door}" for door in DOORS)]:
        module = importlib.import_module(door)
        for name in module.__all__:  # which are imported when they are first used
            getattr(module, name)
        mend_tuples(module)
        mend_checked(module)
        documents[door] = pdoc.doc.Module(module)
        mend_values(documents[door])
    pdoc.render.configure(
        docformat="google",
        footer_text=f"{PACKAGE} {importlib.import_module(PACKAGE).__version__}",
        template_directory=DOCS / "pages",
    )
    pdoc.render.env.globals["prose"] = [
        (name, "README" if name == "index" else title_of(text)) for name, text in texts.items()
    ]
    pdoc.render.env.globals["doors"] = [(door, summary_of(door)) for door in DOORS]
    written = []
    with warnings.catch_warnings(record=True) as warned:
        warnings.simplefilter("always", UserWarning)
        for name, document in documents.items():
            path = folder / f"{name.replace('.', '/')}.html"
            path.parent.mkdir(parents=True, exist_ok=True)
            text = pdoc.render.html_module(document, documents)
            for pattern, better in _PLAINER:
                text = pattern.sub(better, text)
            path.write_text(text, encoding="utf-8")
            written.append(path)
        index = pdoc.render.search_index(documents)
        (folder / "search.js").write_text(index, encoding="utf-8")
    for picture in (*DOCS.glob("*.png"), *DOCS.glob("*.jpg")):
        shutil.copyfile(picture, folder / picture.name)
    found = [str(c.message).partition("\n")[0] for c in warned]
    return written, list(dict.fromkeys(found))


def title_of(text: str) -> str:
    """The first heading of a page."""
    return text.partition("\n")[0].removeprefix("# ").partition(":")[0]


def main() -> int:
    """Runs the command: 0, or 1 where pdoc warned."""
    parser = argparse.ArgumentParser(description="Writes the documentation as HTML.")
    parser.add_argument("folder", type=Path, help="where to, such as build/docs")
    folder = parser.parse_args().folder
    written, warned = write_docs(folder)
    for warning in warned:
        print(f"error: {warning}", file=sys.stderr)
    print(f"{len(written)} pages: open {folder / 'index.html'}")
    return 1 if warned else 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
