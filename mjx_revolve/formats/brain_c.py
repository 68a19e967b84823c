"""A brain as C99 without allocation: a header and a source file."""

from __future__ import annotations

import re

import numpy as np

from mjx_revolve.formats.brain import Brain
from mjx_revolve.formats.brain_code import TEMPLATES, Code, array_text, is_bracketed
from mjx_revolve.formats.brain_program import Value, View, kind_of, number_text

_TYPES = {"real": "brain_real", "int": "int32_t", "bool": "bool"}


class _CCode(Code):
    language = "c"
    table_prefix = "c"

    def literal(self, x: np.generic) -> str:
        text = _number(x)
        return f"((brain_real){text})" if isinstance(x, np.floating) else f"({text})"

    def input_name(self, value: Value) -> str:
        if value.label == "time":
            return "time"
        state = re.fullmatch(r"state\d+", value.label)
        return f"{'state' if state else 'sensors'}->{value.label}"

    def at(self, name: str, view: View, size: int, whole: int) -> str:
        if name == "time":
            return name
        start, step, run, period = view
        if size == 1 or step == 0 or whole == 1:
            return f"{name}[{start}]"
        turn = f"i / {run}" if run > 1 else f"i % {period}" if period else "i"
        turn = turn if step == 1 else f"{step} * ({turn})" if turn != "i" else f"{step} * i"
        return f"{name}[{f'{start} + ' * (start > 0)}{turn}]"

    def assign(self, number: int, value: Value, text: str) -> str:
        text = text[1:-1] if is_bracketed(text) else text
        self.write_loop(f"v{number}", value.size, text)
        return f"v{number}"

    def write_loop(self, name: str, size: int, text: str, first: int = 0) -> None:
        """Writes an expression, in which `i` counts, into a part of an array."""
        if size == 1:
            text = re.sub(r"\bi\b", "0", text)
            self.lines.append(f"{name}[{first}] = {text};")
            return
        place = f"{first} + i" if first else "i"
        self.lines.append(f"for (i = 0; i < {size}; i++) {name}[{place}] = {text};")

    def store(self, number: int, value: Value) -> str:
        for place, source, view, size, whole in self.pieces(value):
            self.write_loop(f"v{number}", size, self.at(source, view, size, whole), place)
        return f"v{number}"


def make_brain_c(brain: Brain, stem: str) -> tuple[str, str]:
    """Writes a brain as C99.

    Args:
        brain: from `make_brain`.
        stem: the files' name without its ending.

    Returns:
        The header and the source file; they need the standard mathematical library only.
    """
    program, code = brain.program, _CCode(brain.program)
    code.write()
    states = [program.values[program.state[k]] for k in code.live_states]
    header = TEMPLATES.get_template("brain.h.jinja").render(
        brain=brain, states=states, types=_TYPES
    )
    copies = []
    for k, value in zip(code.live_states, states, strict=True):
        after = program.after[k]
        name = code.name_of(after)
        if program.values[after].op == "input":  # it may be written before it is read
            code.assign(after, program.values[after], code.operand(after))
            name = f"v{after}"
        copies.append((value, code.at(name, View(0), value.size, value.size)))
    for value, text in copies:
        code.write_loop(f"state->{value.label}", value.size, text)
    count = len(brain.commands)
    result = code.at(code.name_of(program.commands), View(0), count, count)
    code.write_loop("commands", count, result)
    lines, buffers = share_buffers(code.lines, program.values)
    start = _CCode(program)
    for k, value in zip(code.live_states, states, strict=True):
        data = program.initial[k]
        text = start.literal(data[0])
        if not (data == data[0]).all():
            text = f"s{k}[i]"
            code.constants[f"s{k}"] = data
        start.write_loop(f"state->{value.label}", value.size, text)
    tables = [
        f"static const {_TYPES[kind_of(data.dtype)]} "
        f"{name}[{data.size}] = {{{array_text(data, _number)[1:-1]}}};"
        for name, data in code.constants.items()
    ]
    return header, TEMPLATES.get_template("brain.c.jinja").render(
        brain=brain,
        stem=stem,
        tables=tables,
        start=_function(start.lines, ["state"]),
        body=_function([*buffers, *lines], ["state", "time", "sensors"]),
    )


def _function(lines: list[str], arguments: list[str]) -> str:
    """The body of a function: the counter that it may need, and arguments that it does not."""
    text = "\n".join(lines)
    head = ["int i;"] if "(i = 0" in text else []
    unused = [f"(void){name};" for name in arguments if not re.search(rf"\b{name}\b", text)]
    stored = [line for line in lines if line.startswith("static ")]
    return "\n".join(f"    {x}" for x in [*stored, *head, *unused, *lines[len(stored) :]])


def share_buffers(lines: list[str], values: tuple[Value, ...]) -> tuple[list[str], list[str]]:
    """Lets arrays share memory where one is no longer read when the other is written.

    Args:
        lines: of the step, with a name v1, v2 ... for each value.
        values: of the program.

    Returns:
        The lines with the names of buffers, and the buffers' declarations.
    """
    pattern = re.compile(r"\bv(\d+)\b")
    first: dict[int, int] = {}
    last: dict[int, int] = {}
    for k, line in enumerate(lines):
        for number in map(int, pattern.findall(line)):
            first.setdefault(number, k)
            last[number] = k
    buffers: list[tuple[str, int, int]] = []  # type, size, the last line that uses it
    names: dict[int, str] = {}
    for number in sorted(first, key=lambda n: first[n]):
        kind, size = _TYPES[values[number].kind], values[number].size
        free = [
            k for k, (own, _, busy) in enumerate(buffers) if own == kind and busy < first[number]
        ]
        # The one that fits best: the least that is large enough, or else the largest.
        free.sort(key=lambda k: (buffers[k][1] < size, abs(buffers[k][1] - size)))
        place = free[0] if free else len(buffers)
        if not free:
            buffers.append((kind, 0, 0))
        buffers[place] = kind, max(size, buffers[place][1]), last[number]
        names[number] = f"b{place}"
    renamed = [pattern.sub(lambda found: names[int(found[1])], line) for line in lines]
    declared = [f"static {kind} b{k}[{size}];" for k, (kind, size, _) in enumerate(buffers)]
    return renamed, declared


def _number(x: np.generic) -> str:
    return number_text(x, "NAN", "INFINITY")
