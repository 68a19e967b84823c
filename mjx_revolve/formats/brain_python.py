"""A brain as a Python file that needs NumPy only."""

from __future__ import annotations

import textwrap

import numpy as np

from mjx_revolve.formats.brain import Brain
from mjx_revolve.formats.brain_code import TEMPLATES, Code, array_text, is_bracketed
from mjx_revolve.formats.brain_program import Value, View, find_view, kind_of, number_text

# Takes of more runs than this are done by a table of places.
_MOST_RUNS = 8
_DTYPES = {"real": "REAL", "int": "np.int32", "bool": "bool"}


class _PythonCode(Code):
    language = "numpy"
    table_prefix = "_C"

    def literal(self, x: np.generic) -> str:
        text = _number(x)
        return text if not text.startswith("-") else f"({text})"

    def input_name(self, value: Value) -> str:
        return value.label

    def at(self, name: str, view: View, size: int, whole: int) -> str:
        start, step, run, period = view
        if size == whole and view == View(0):
            return name
        if size == 1 or step == 0:
            return name if whole == 1 else f"{name}[{start}:{start + 1}]"
        count = period or -(-size // run)
        part = f"{name}[{start}:{start + step * (count - 1) + 1}{f':{step}' * (step > 1)}]"
        if count == whole and step == 1:
            part = name
        if period:
            return f"np.tile({part}, {-(-size // period)})" + f"[:{size}]" * (size % period > 0)
        if run > 1:
            return f"np.repeat({part}, {run})" + f"[:{size}]" * (size % run > 0)
        return part

    def assign(self, number: int, value: Value, text: str) -> str:
        if is_bracketed(text) and len(text) < 80:  # else it breaks between its brackets
            text = text[1:-1]
        if value.size > 1 and value.op != "take" and not self._is_wide(value):
            text = f"np.broadcast_to({text}, {value.size})"
        self.lines.append(f"v{number} = {text}")
        return f"v{number}"

    def _is_wide(self, value: Value) -> bool:
        """Whether an operation's expression has all its elements, not one that stands for all."""
        for number in value.args:
            arg = self.program.values[number]
            if arg.size != value.size:
                continue
            if number in self._inline:
                found = self._is_wide(arg)
            elif number in self._names:
                found = True
            elif arg.data is not None:
                found = not (arg.data == arg.data[0]).all()
            else:
                view = find_view(arg.index)
                found = view is None or len(arg.args) > 1 or view.step != 0
            if found:
                return True
        return False

    def store(self, number: int, value: Value) -> str:
        pieces = [self.at(*run[1:]) for run in self.pieces(value)]
        text = pieces[0] if len(pieces) == 1 else f"np.concatenate([{', '.join(pieces)}])"
        if len(pieces) > _MOST_RUNS:
            names = [self.name_of(arg) for arg in value.args]
            whole = names[0] if len(names) == 1 else f"np.concatenate([{', '.join(names)}])"
            text = f"{whole}[{list(value.index)}]"
        return self.assign(number, value, text)


def make_brain_python(brain: Brain) -> str:
    """Writes a brain as Python.

    Args:
        brain: from `make_brain`.

    Returns:
        A module with a class `Brain`; it needs NumPy only.
    """
    program, code = brain.program, _PythonCode(brain.program)
    code.write()
    after = [code.name_of(program.after[k]) for k in code.live_states]
    tables = ""
    for name, data in code.constants.items():
        dtype = _DTYPES[kind_of(data.dtype)]
        tables += wrapped(f"{name} = np.array({array_text(data, _number)}, {dtype})") + "\n"
    start, states = [], [program.values[program.state[k]] for k in code.live_states]
    for k, value in zip(code.live_states, states, strict=True):
        data = program.initial[k]
        filled = f"np.full({value.size}, {_number(data[0])}, {_DTYPES[value.kind]})"
        whole = f"np.array({array_text(data, _number)}, {_DTYPES[value.kind]})"
        start.append(filled if (data == data[0]).all() else whole)
    return TEMPLATES.get_template("brain.py.jinja").render(
        brain=brain,
        sensors={signal.name: signal.size for signal in brain.signals},
        tables=tables,
        start=", ".join([*start, ""]).strip(),
        states=[value.label for value in states],
        after=after,
        lines=code.lines,
        commands=code.name_of(program.commands),
    )


def _number(x: np.generic) -> str:
    return number_text(x, "np.nan", "np.inf")


def wrapped(line: str) -> str:
    """A line of code, broken at blanks between brackets where it is long."""
    indent = " " * (len(line) - len(line.lstrip()) + 4)
    kept = line.replace(" = ", "\xa0=\xa0", 1)  # outside of brackets no line may end
    return "\n".join(
        textwrap.wrap(kept, 100, subsequent_indent=indent, break_long_words=False,
                      break_on_hyphens=False, drop_whitespace=True)
    ).replace("\xa0", " ")  # fmt: skip


TEMPLATES.filters["wrapped"] = wrapped
