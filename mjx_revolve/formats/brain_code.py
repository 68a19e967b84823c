"""The common part of a brain's code in all languages: stored arrays and inline expressions.

A value that is used once, by an element-wise operation, is written inline, in brackets; elements
taken from a stored array by a simple index are written as that array with the index.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Literal

import numpy as np

from mjx_revolve.formats.brain_program import (
    ELEMENTWISE,
    Program,
    Value,
    View,
    find_view,
    split_runs,
)
from mjx_revolve.inputs.templates import make_templates


def one_line(text: str) -> str:
    """A line that ends no comment, whatever names are in it."""
    one = " ".join(text.split())
    return one.replace("\\", "/").replace('"', "'").replace("*/", "* /")


TEMPLATES = make_templates(Path(__file__).with_name("templates"), html=False)
"""Of the files, around what `Code` writes."""
TEMPLATES.filters["one_line"] = one_line
# Longer expressions get a name; a choice.
_MAX_EXPRESSION = 100


class Code(ABC):
    """The step of a program as lines in a language; `lines` writes it.

    Attributes:
        language: field of the forms that it writes.
        table_prefix: of the names of tables, before their numbers.
        constants: name and value of the tables that the lines use.
        lines: of the step.
    """

    language: Literal["numpy", "c"]
    table_prefix: str

    def __init__(self, program: Program) -> None:
        self.program = program
        self.constants: dict[str, np.ndarray] = {}
        self.lines: list[str] = []
        self._tables: dict[tuple[str, bytes], str] = {}
        self._names: dict[int, str] = {}
        self._inline: dict[int, str] = {}

    @cached_property
    def live_states(self) -> list[int]:
        """Which of the state's arrays have an effect."""
        return [k for k, n in enumerate(self.program.state) if n in self.program.live]

    @cached_property
    def _results(self) -> set[int]:
        """Values that outlive the step."""
        return {self.program.commands, *(self.program.after[k] for k in self.live_states)}

    @cached_property
    def _users(self) -> dict[int, list[int]]:
        """For each value, the values that depend on it."""
        found: dict[int, list[int]] = {}
        for number in self.program.live:
            for arg in self.program.values[number].args:
                found.setdefault(arg, []).append(number)
        return found

    def _is_whole(self, number: int) -> bool:
        """Whether a value must stand in memory as a whole."""
        users = (self.program.values[user].op for user in self._users.get(number, ()))
        return number in self._results or "take" in users

    def _is_inline(self, number: int, value: Value, text: str) -> bool:
        """Whether an expression stands where it is used: there only, and as often."""
        users = self._users.get(number, [])
        return (
            len(users) == 1
            and self.program.values[users[0]].size == value.size
            and not self._is_whole(number)
            and len(text) < _MAX_EXPRESSION
        )

    def write(self) -> None:
        """Writes the lines of the step."""
        for number in sorted(self.program.live):
            self._write(number, self.program.values[number])

    def _write(self, number: int, value: Value) -> None:
        if value.op == "input":
            self._names[number] = self.input_name(value)
        elif value.data is not None:
            return  # a constant is written where it is used
        elif value.op == "take":
            simple = len(value.args) == 1 and find_view(value.index) is not None
            if self._is_whole(number) or not simple:
                self._names[number] = self.store(number, value)
        else:
            text = self.element(value)
            if self._is_inline(number, value, text):
                self._inline[number] = text
            else:
                self._names[number] = self.assign(number, value, text)

    def element(self, value: Value) -> str:
        """An operation on elements, from its arguments."""
        args = [self.operand(arg) for arg in value.args]
        return getattr(ELEMENTWISE[value.op], self.language).format(*args)

    def operand(self, number: int) -> str:
        """A value in an expression."""
        value = self.program.values[number]
        if number in self._inline:
            return self._inline[number]
        if number in self._names:
            return self.at(self._names[number], View(0), value.size, value.size)
        if value.data is not None and (value.data == value.data[0]).all():
            return self.literal(value.data[0])
        view = find_view(value.index) if value.op == "take" and len(value.args) == 1 else None
        if view is None:
            return self.at(self.name_of(number), View(0), value.size, value.size)
        [source] = value.args
        return self.at(self.name_of(source), view, value.size, self.program.values[source].size)

    def pieces(self, value: Value) -> Iterator[tuple[int, str, View, int, int]]:
        """A take as runs: where each goes, its source, the view, its length and the source's."""
        names = [self.name_of(arg) for arg in value.args]
        ends = np.cumsum([0, *(self.program.values[arg].size for arg in value.args)]).tolist()
        for place, start, count in split_runs(value.index):
            # A run may go on from one source into the next.
            for name, (low, high) in zip(names, pairwise(ends), strict=True):
                first, last = max(start, low), min(start + count, high)
                if first < last:
                    yield place + first - start, name, View(first - low), last - first, high - low

    def name_of(self, number: int) -> str:
        """The name of a stored value, or of a constant's table."""
        if number in self._names:
            return self._names[number]
        data = self.program.values[number].data
        assert data is not None
        key = data.dtype.str, data.tobytes()
        if key not in self._tables:
            self._tables[key] = f"{self.table_prefix}{len(self._tables)}"
            self.constants[self._tables[key]] = data
        return self._tables[key]

    @abstractmethod
    def literal(self, x: np.generic) -> str:
        """A number."""

    @abstractmethod
    def input_name(self, value: Value) -> str:
        """The name of an input."""

    @abstractmethod
    def at(self, name: str, view: View, size: int, whole: int) -> str:
        """`size` elements of an array of `whole`, in an expression."""

    @abstractmethod
    def assign(self, number: int, value: Value, text: str) -> str:
        """Writes an expression into an array, and returns the array's name."""

    @abstractmethod
    def store(self, number: int, value: Value) -> str:
        """Writes a take into an array, and returns its name."""


def array_text(data: np.ndarray, number: Callable[[np.generic], str]) -> str:
    """A constant's numbers in a row."""
    return f"[{', '.join(map(number, data))}]"


def is_bracketed(text: str) -> bool:
    """Whether one pair of brackets is around all of an expression."""
    depth = 0
    for k, letter in enumerate(text):
        depth += (letter == "(") - (letter == ")")
        if depth == 0:
            return text.startswith("(") and k == len(text) - 1
    return False
