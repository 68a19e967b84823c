"""Writes the documentation as HTML: these pages, and a reference of all modules.

    python docs/reference.py build/docs

`index.html` is the README; every `docs/*.md` becomes a page; each layer of the package and each
module has one below `mjx_revolve/`, in reading order. Made by pdoc.
"""

from __future__ import annotations

import argparse
import importlib
import pkgutil
import re
import shutil
import sys
import types
import typing
import warnings
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DOCS = ROOT / "docs"
PACKAGE = "mjx_revolve"
# The order in which a user meets the pages; those not named here follow.
FIRST = (
    "tutorial", "fit", "settings", "evolution", "viewer", "replay", "live", "report", "sweeps",
    "measures", "interchange", "physics", "parallel",
)  # fmt: skip
# The package's layers in reading order: each imports only from itself and from those before it.
LAYERS = (
    "inputs", "numerics", "water", "body", "genotypes", "engine", "control", "episodes",
    "evolution", "formats", "fitting", "view",
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


def list_layers() -> dict[str, list[str]]:
    """The full names of all public modules by layer, in reading order; the commands come last."""
    package = importlib.import_module(PACKAGE)
    layers: dict[str, list[str]] = {layer: [] for layer in LAYERS}
    commands = []
    for found in pkgutil.walk_packages(package.__path__, f"{PACKAGE}."):
        _, layer, *rest = found.name.split(".")
        if any(part.startswith("_") for part in (layer, *rest)):
            continue
        if rest:
            layers.setdefault(layer, []).append(found.name)
        elif not found.ispkg:
            commands.append(found.name)
    return layers | {"": commands}


def summary_of(layer: str) -> str:
    """The first line of a layer's docstring; "" is the front door."""
    if not layer:
        return "What users type: arguments in, messages out."
    return (importlib.import_module(f"{PACKAGE}.{layer}").__doc__ or "").partition("\n")[0]


def link_text(text: str, modules: list[str]) -> str:
    """Turns names of our files in Markdown into links, and pictures' paths into those here."""

    def link(match: re.Match[str]) -> str:
        name = match[1]
        if (DOCS / f"{name}.md").is_file() and match[0].startswith("`docs/"):
            return f"[{match[0]}]({name}.html)"
        if f"{PACKAGE}.{name.replace('/', '.')}" in modules and match[0].endswith(".py`"):
            return f"[{match[0]}]({PACKAGE}/{name}.html)"
        return match[0]

    parts = re.split(r"(^```.*?^```$)", text, flags=re.MULTILINE | re.DOTALL)
    for k in range(0, len(parts), 2):  # not inside blocks
        parts[k] = re.sub(r"`(?:docs|mjx_revolve)/([\w/]+)\.(?:md|py)`", link, parts[k])
        parts[k] = re.sub(r"\]\(docs/([\w.]+)\)", r"](\1)", parts[k])
        parts[k] = re.sub(r"\]\((\w+)\.md(#[\w-]+)?\)", r"](\1.html\2)", parts[k])
    return "".join(parts)


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


def write_docs(folder: Path) -> tuple[list[Path], list[str]]:
    """Writes all pages.

    Args:
        folder: where to; files of the same names are replaced.

    Returns:
        The HTML files, and what pdoc could not make sense of.
    """
    import pdoc.doc
    import pdoc.render

    layers = list_layers()
    modules = [name for found in layers.values() for name in found]
    package = importlib.import_module(PACKAGE)
    for layer in ["", *layers]:  # their names are imported when they are first used
        door = importlib.import_module(f"{PACKAGE}.{layer}".rstrip("."))
        for name in getattr(door, "__all__", ()):
            getattr(door, name)
    pages = {"index": ("README", ROOT / "README.md")}
    pages |= {path.stem: (title_of(path), path) for path in list_pages()}
    documents: dict[str, pdoc.doc.Module] = {
        name: pdoc.doc.Module(make_page(name, link_text(path.read_text(encoding="utf-8"), modules)))
        for name, (_, path) in pages.items()
    }
    for name in [PACKAGE, *(f"{PACKAGE}.{layer}" for layer in layers if layer), *modules]:
        module = importlib.import_module(name)
        mend_tuples(module)
        mend_checked(module)
        documents[name] = pdoc.doc.Module(module)
    pdoc.render.configure(
        docformat="google",
        footer_text=f"{PACKAGE} {package.__version__}",
        template_directory=DOCS / "pages",
    )
    pdoc.render.env.globals["prose"] = [(name, title) for name, (title, _) in pages.items()]
    pdoc.render.env.globals["layers"] = [
        (layer, summary_of(layer), found) for layer, found in layers.items()
    ]
    written = []
    with warnings.catch_warnings(record=True) as complaints:
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
    found = [str(c.message).partition("\n")[0] for c in complaints]
    return written, list(dict.fromkeys(found))


def title_of(path: Path) -> str:
    """The first heading of a page."""
    return path.read_text(encoding="utf-8").partition("\n")[0].removeprefix("# ").partition(":")[0]


def main() -> int:
    """Runs the command: 0, or 1 where pdoc had something to complain about."""
    parser = argparse.ArgumentParser(description="Writes the documentation as HTML.")
    parser.add_argument("folder", type=Path, help="where to, such as build/docs")
    folder = parser.parse_args().folder
    written, complaints = write_docs(folder)
    for complaint in complaints:
        print(f"error: {complaint}", file=sys.stderr)
    print(f"{len(written)} pages: open {folder / 'index.html'}")
    return 1 if complaints else 0


if __name__ == "__main__":
    sys.path.insert(0, str(ROOT))
    sys.exit(main())
