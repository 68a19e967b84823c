"""XML as other programs read it: elements in one call, numbers, comments that wrap."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np

# What a text or an attribute is made from; see `to_value`.
Value = str | bool | float | Iterable[float]


def node(tag: str, /, *content: Element | Value, **attributes: Value) -> Element:
    """An element.

    Args:
        tag: its name.
        content: elements that stand in it, or a value that is its text.
        attributes: their values.
    """
    made = Element(tag, {name: to_value(value) for name, value in attributes.items()})
    for one in content:
        if isinstance(one, Element):
            made.append(one)
        else:
            made.text = to_value(one)
    return made


def nodes(**values: Value) -> list[Element]:
    """Elements that hold a value each, in the order of the arguments."""
    return [node(tag, value) for tag, value in values.items()]


def to_value(value: Value) -> str:
    """A value as XML has it.

    Numbers have twelve digits: one by itself however small it is, several without the rounding
    errors around 0 that turned vectors have.
    """
    if isinstance(value, str):
        return value
    if isinstance(value, bool):
        return str(value).lower()
    x = np.asarray(value, np.float64)
    return " ".join(f"{one:z.12g}" for one in (np.round(x, 15) if x.ndim else [x]))


def to_document(root: Element, comment: str) -> str:
    """An XML document, indented.

    Args:
        root: of the document.
        comment: that stands above it.
    """
    ElementTree.indent(root)
    body = ElementTree.tostring(root, encoding="unicode")
    return f'<?xml version="1.0"?>\n{to_comment(comment)}\n{body}\n'


def to_comment(text: str) -> str:
    """An XML comment; two hyphens, which none may hold, are spread."""
    text = text.strip("\n")
    while "--" in text:
        text = text.replace("--", "- -")
    return f"<!--\n{text}\n-->"


def to_list(lines: Iterable[tuple[object, str]]) -> str:
    """The lines of a comment that apply, each wrapped behind a dash.

    Args:
        lines: whether each applies, and its text.
    """
    wrapper = textwrap.TextWrapper(98, initial_indent="  - ", subsequent_indent="    ")
    return "\n".join(wrapper.fill(line) for holds, line in lines if holds)
