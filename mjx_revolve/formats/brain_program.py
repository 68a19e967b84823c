"""A function of JAX as a short list of operations on flat arrays, for files that run without JAX.

The function is traced, its calls are inlined and its constants folded. Slices, reshapes, broadcasts
and gathers with constant indices become an index; sums and products of matrices are written out;
what remains is element-wise arithmetic. The set of operations is closed: `ELEMENTWISE` has each
once, in the form of NumPy and of C99.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from itertools import pairwise
from typing import Any, NamedTuple

import jax
import numpy as np
from jax.extend import core
from numpy.typing import ArrayLike

from mjx_revolve.inputs.errors import InputError


class Form(NamedTuple):
    """How an operation on elements is written: `{0}`, `{1}` ... are its arguments."""

    numpy: str
    c: str


def _function(numpy: str, c: str = "") -> Form:
    return Form(f"np.{numpy}({{0}})", f"BRAIN_F({c or numpy})({{0}})")


def _infix(sign: str) -> Form:
    return Form(f"({{0}} {sign} {{1}})", f"({{0}} {sign} {{1}})")


_LARGER, _SMALLER = "np.maximum({0}, {1})", "np.minimum({0}, {1})"
ELEMENTWISE: dict[str, Form] = {
    **{name: _function(name) for name in (
        "exp", "exp2", "expm1", "log", "log1p", "sqrt", "cbrt", "sin", "cos", "tan", "sinh",
        "cosh", "tanh", "floor", "ceil",
    )},
    **{name: _function(f"arc{name[1:]}", name) for name in (
        "asin", "acos", "atan", "asinh", "acosh", "atanh",
    )},
    "add": _infix("+"), "sub": _infix("-"), "mul": _infix("*"), "div": _infix("/"),
    "div.int": Form("(({0} - np.fmod({0}, {1})) // {1})", "({0} / {1})"),  # towards 0
    "neg": Form("(-{0})", "(-{0})"),
    "abs": _function("abs", "fabs"),
    "abs.int": Form("np.abs({0})", "({0} < 0 ? -{0} : {0})"),
    "round": _function("rint"),
    "sign": Form("np.sign({0})", "brain_sign({0})"),
    "sign.int": Form("np.sign({0})", "(({0} > 0) - ({0} < 0))"),
    "square.int": Form("np.square({0})", "({0} * {0})"),
    "square": Form("np.square({0})", "brain_square({0})"),
    "rsqrt": Form("(1 / np.sqrt({0}))", "(1 / BRAIN_F(sqrt)({0}))"),
    "logistic": Form("(1 / (1 + np.exp(-{0})))", "(1 / (1 + BRAIN_F(exp)(-{0})))"),
    "pow": Form("np.power({0}, {1})", "BRAIN_F(pow)({0}, {1})"),
    "atan2": Form("np.arctan2({0}, {1})", "BRAIN_F(atan2)({0}, {1})"),
    "rem": Form("np.fmod({0}, {1})", "BRAIN_F(fmod)({0}, {1})"),
    "rem.int": Form("np.fmod({0}, {1})", "({0} % {1})"),
    "max": Form(_LARGER, "brain_max({0}, {1})"),
    "min": Form(_SMALLER, "brain_min({0}, {1})"),
    "max.int": Form(_LARGER, "({0} > {1} ? {0} : {1})"),
    "min.int": Form(_SMALLER, "({0} < {1} ? {0} : {1})"),
    "clamp": Form("np.minimum(np.maximum({1}, {0}), {2})", "brain_min(brain_max({1}, {0}), {2})"),
    "eq": _infix("=="), "ne": _infix("!="), "lt": _infix("<"), "le": _infix("<="),
    "gt": _infix(">"), "ge": _infix(">="),
    "and": Form("({0} & {1})", "({0} && {1})"), "and.int": _infix("&"),
    "or": Form("({0} | {1})", "({0} || {1})"), "or.int": _infix("|"),
    "xor": Form("({0} ^ {1})", "({0} != {1})"), "xor.int": _infix("^"),
    "not": Form("(~{0})", "(!{0})"),
    "is_finite": Form("np.isfinite({0})", "isfinite({0})"),
    "select_n": Form("np.where({0}, {2}, {1})", "({0} ? {2} : {1})"),
    "to real": Form("{0}.astype(REAL)", "((brain_real){0})"),
    "to int": Form("{0}.astype(np.int32)", "((int32_t){0})"),
    "to bool": Form("({0} != 0)", "({0} != 0)"),
}  # fmt: skip
"""By JAX's name, with `.int` for a form of whole numbers."""

# Of these only reals: NumPy and C differ for integers.
_REALS_ONLY = ("pow", "clamp")
_REDUCTIONS = {"reduce_sum": "add", "reduce_prod": "mul", "reduce_max": "max", "reduce_min": "min"}

# What they are of no elements, as of robots without hinges.
_OF_NOTHING = {"reduce_sum": 0, "dot_general": 0, "reduce_prod": 1,
               "reduce_max": -np.inf, "reduce_min": np.inf}  # fmt: skip
_NEUTRAL = {"add": 0, "sub": 0, "mul": 1, "div": 1}
_SAME = ("materialize", "copy", "copy_p", "optimization_barrier", "reduce_precision",
         "stop_gradient")  # fmt: skip
_CALLS = (
    "jit", "pjit", "closed_call", "core_call", "remat", "checkpoint", "custom_jvp_call",
    "custom_vjp_call",
)  # fmt: skip
# Operations that only move elements, with the operands that are moved; others are constant indices.
_MOVES: dict[str, tuple[int, ...] | None] = {
    "reshape": None, "squeeze": None, "slice": None, "transpose": None,
    "broadcast_in_dim": None, "concatenate": None, "rev": None, "pad": None, "split": None,
    "stack": None, "unstack": None, "tile": None,
    "gather": (0,), "dynamic_slice": (0,), "dynamic_update_slice": (0, 1), "scatter": (0, 2),
}  # fmt: skip
_EVEN = jax.lax.RoundingMethod.TO_NEAREST_EVEN
_KINDS = {"f": "real", "i": "int", "b": "bool"}


@dataclass(frozen=True)
class Value:
    """A flat array of a program.

    Attributes:
        kind: "real", "int" or "bool".
        size: number of elements.
        op: a name in `ELEMENTWISE`, or "input", "constant" or "take" (see `index`).
        args: numbers of the values that it is made of.
        index: `[size]` of a "take": which element of its arguments, one behind the other.
        data: `[size]` of a constant.
        label: of an input: its name.
    """

    kind: str
    size: int
    op: str
    args: tuple[int, ...] = ()
    index: tuple[int, ...] = ()
    data: np.ndarray | None = field(default=None, compare=False)
    label: str = ""


@dataclass(frozen=True)
class Program:
    """A step as a list of operations.

    Attributes:
        values: each after its arguments.
        commands: number of the value that is the result.
        state: numbers of the values that are the state before the step.
        after: of those that are the state after it.
        initial: the state at the start.
    """

    values: tuple[Value, ...]
    commands: int
    state: tuple[int, ...]
    after: tuple[int, ...]
    initial: tuple[np.ndarray, ...]

    @cached_property
    def live(self) -> frozenset[int]:
        """Numbers of the values that commands follow from, now or through the state later."""
        found: set[int] = set()
        wanted = [self.commands]
        while wanted:
            number = wanted.pop()
            if number in found:
                continue
            found.add(number)
            wanted += self.values[number].args
            if number in self.state:
                wanted.append(self.after[self.state.index(number)])
        return frozenset(found)


class Builder:
    """Values, as they are made; equal ones are one."""

    def __init__(self) -> None:
        self.values: list[Value] = []
        self._known: dict[Any, int] = {}

    def add(self, value: Value) -> int:
        """The number of a value."""
        data = None if value.data is None else (value.data.dtype.str, value.data.tobytes())
        number = self._known.setdefault((value, data), len(self.values))
        if number == len(self.values):
            self.values.append(value)
        return number

    def constant(self, data: ArrayLike) -> int:
        """A constant of any shape."""
        flat = np.asarray(data).reshape(-1)
        return self.add(Value(kind_of(flat.dtype), flat.size, "constant", data=flat))

    def input(self, label: str, kind: str, size: int) -> int:
        """An input by its name."""
        return self.add(Value(kind, size, "input", label=label))

    def apply(self, name: str, kind: str, *args: int) -> int:
        """An element-wise operation; additions of 0 and multiplications by 1 are left out."""
        size = max(self.values[number].size for number in args)
        for k in (0, 1) if name in _NEUTRAL and kind == "real" else ():
            data, other = self.values[args[k]].data, args[1 - k]
            if (
                data is None
                or self.values[other].size != size
                or (name in ("sub", "div") and k == 0)
            ):
                continue
            if (data == _NEUTRAL[name]).all():
                return other
        return self.add(Value(kind, size, name, args))

    def take(self, args: Sequence[int], index: ArrayLike) -> int:
        """Elements of values that stand one behind the other."""
        parts = []  # of (value, element), with takes of takes resolved
        for number in args:
            value = self.values[number]
            own = [(number, k) for k in range(value.size)]
            is_take = value.op == "take"
            parts += [self._find(value, k) for k in value.index] if is_take else own
        chosen = [parts[k] for k in np.asarray(index).reshape(-1).tolist()]
        sources = tuple(dict.fromkeys(number for number, _ in chosen))
        if len(sources) == 1 and [k for _, k in chosen] == [*range(self.values[sources[0]].size)]:
            return sources[0]
        sizes = [self.values[number].size for number in sources]
        starts = dict(zip(sources, np.cumsum([0, *sizes]), strict=False))
        where = tuple(int(starts[number]) + k for number, k in chosen)
        known = [self.values[n].data for n in sources]
        data = None
        if sources and all(x is not None for x in known):
            data = np.concatenate([x for x in known if x is not None])[list(where)]
        kind = self.values[args[0]].kind
        return self.add(Value(kind, len(where), "take", sources, where, data=data))

    def _find(self, value: Value, k: int) -> tuple[int, int]:
        """The source of an element of a take, and the place in it."""
        for number in value.args:
            if k < self.values[number].size:
                return number, k
            k -= self.values[number].size
        raise AssertionError("an index past the end of a take's arguments")

    def run(self, closed: core.ClosedJaxpr, args: Sequence[int]) -> list[int]:
        """The results of a closed jaxpr.

        Raises:
            InputError: it has an operation that is not known.
        """
        jaxpr, env = closed.jaxpr, {}
        for variable, constant in zip(jaxpr.constvars, closed.consts, strict=True):
            env[variable] = self.constant(constant)
        env |= dict(zip(jaxpr.invars, args, strict=True))

        def read(atom: core.Var | core.Literal) -> int:
            return self.constant(atom.val) if isinstance(atom, core.Literal) else env[atom]

        for equation in jaxpr.eqns:
            found = self._apply(equation, [read(atom) for atom in equation.invars])
            env |= dict(zip(equation.outvars, found, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _apply(self, equation: Any, args: list[int]) -> list[int]:
        name, params = equation.primitive.name, equation.params
        if name in _CALLS:
            inner = next(params[key] for key in ("jaxpr", "call_jaxpr", "fun_jaxpr")
                         if key in params)  # fmt: skip
            if isinstance(inner, core.Jaxpr):
                inner = core.ClosedJaxpr(inner, ())
            return self.run(inner, args)
        if name in _SAME:
            return args
        if -1 in args:
            raise InputError(
                "controller: expected a step without the simulation's sensor noise, as devices "
                "have their own; found one that reads its seed"
            )
        shapes, out = [atom.aval.shape for atom in equation.invars], equation.outvars[0].aval
        if len(equation.outvars) == 1 and out.size == 0:  # as of robots without hinges
            return [self.constant(np.zeros(0, out.dtype))]
        if name in _OF_NOTHING and any(atom.aval.size == 0 for atom in equation.invars):
            return [self.constant(np.full(out.size, _OF_NOTHING[name], out.dtype))]
        if name in _MOVES:
            return self._move(equation, args, shapes)
        known = [self.values[number].data for number in args]
        if all(x is not None for x in known):
            arrays = [np.asarray(x).reshape(shape) for x, shape in zip(known, shapes, strict=True)]
            found = equation.primitive.bind(*arrays, **params)
            return [self.constant(x) for x in (found if isinstance(found, list) else [found])]
        kind, size = kind_of(out.dtype), int(np.prod(out.shape))
        if name in _REDUCTIONS and kind != "bool":
            keep = [k for k in range(len(shapes[0])) if k not in params["axes"]]
            grid = np.arange(self.values[args[0]].size).reshape(shapes[0])
            grid = grid.transpose(*keep, *params["axes"]).reshape(size, -1)
            return [self._fold(_REDUCTIONS[name], kind, [self.take(args, row) for row in grid.T])]
        if name == "dot_general":
            return [self._dot(kind, args, shapes, params["dimension_numbers"])]
        if name == "integer_pow" and kind == "real":
            power = self.constant(np.full(1, float(params["y"])))
            return [self.apply("pow", kind, *args, power)]
        form = self._form(equation, args)
        if form == f"to {self.values[args[0]].kind}":
            return args
        for k, (number, shape) in enumerate(zip(args, shapes, strict=True)):
            if self.values[number].size not in (1, size):  # axes of size 1 stretch
                grid = np.arange(self.values[number].size).reshape(shape)
                args[k] = self.take([number], np.broadcast_to(grid, out.shape))
        return [self.apply(form, kind, *args)]

    def _form(self, equation: Any, args: list[int]) -> str:
        """The name in `ELEMENTWISE` of an operation on elements."""
        name, params = equation.primitive.name, equation.params
        kinds = [self.values[number].kind for number in args]
        if name == "convert_element_type":
            return f"to {kind_of(equation.outvars[0].aval.dtype)}"
        odd = (
            name not in ELEMENTWISE
            or (name in _REALS_ONLY and "real" not in kinds)
            or (name == "round" and params["rounding_method"] != _EVEN)
            or (name == "select_n" and (kinds[0] != "bool" or len(args) != 3))
            or (name == "not" and kinds[0] != "bool")
        )
        if odd:
            shown = name if name not in ELEMENTWISE else f"{name} of {' and '.join(kinds)}"
            raise InputError(
                "controller: expected operations that a file can hold (arithmetic on elements, "
                "sums, products of matrices, constant places); found JAX's "
                f"{shown!r} in its step"
            )
        return f"{name}.int" if kinds[0] == "int" and f"{name}.int" in ELEMENTWISE else name

    def _move(self, equation: Any, args: list[int], shapes: list[tuple[int, ...]]) -> list[int]:
        """An operation that only moves elements, applied to their indices."""
        name, params = equation.primitive.name, equation.params
        if name == "gather" and params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP:
            return self._gather_or_fill(equation, args, shapes)
        which = _MOVES[name]
        moved = [*range(len(args))] if which is None else [*which]
        first, grids = 0, []
        for k, (number, shape) in enumerate(zip(args, shapes, strict=True)):
            if k in moved:
                size = self.values[number].size
                grids.append(np.arange(first, first + size, dtype=np.int32).reshape(shape))
                first += size
                continue
            grids.append(self._places(number, name).reshape(shape))
        made = equation.primitive.bind(*grids, **params)
        found = made if isinstance(made, list | tuple) else [made]
        sources = [args[k] for k in moved]
        return [self.take(sources, np.asarray(x)) for x in found]

    def _places(self, number: int, name: str) -> np.ndarray:
        """Constant places in an array, for such an operation."""
        data = self.values[number].data
        if data is None:
            raise InputError(
                "controller: expected constant places in arrays; found JAX's "
                f"{name!r} at places that its step computes"
            )
        return np.asarray(data)

    def _gather_or_fill(
        self, equation: Any, args: list[int], shapes: list[tuple[int, ...]]
    ) -> list[int]:
        """Elements at constant places; those past the end are what the operation fills in."""
        where, size = self._places(args[1], "gather"), self.values[args[0]].size
        params, dtype = equation.params, equation.outvars[0].aval.dtype
        grid = np.arange(size, dtype=np.int32).reshape(shapes[0])
        params = {**params, "fill_value": size}
        at = equation.primitive.bind(grid, where.reshape(shapes[1]), **params)
        fill = equation.params["fill_value"]
        usual = {"real": np.nan, "bool": True}.get(kind_of(dtype), np.iinfo(np.int32).min)
        blank = self.constant(np.full(1, usual if fill is None else fill, dtype))
        return [self.take([args[0], blank], np.asarray(at))]

    def _fold(self, op: str, kind: str, terms: list[int]) -> int:
        """Terms put together one after the other."""
        op = f"{op}.int" if kind == "int" and f"{op}.int" in ELEMENTWISE else op
        found = terms[0]
        for term in terms[1:]:
            found = self.apply(op, kind, found, term)
        return found

    def _dot(self, kind: str, args: list[int], shapes: list[tuple[int, ...]], numbers: Any) -> int:
        """A product of matrices, written out along the axes that are summed over."""
        contract, batch = numbers
        grids, frees = [], []
        for k in (0, 1):
            free = [n for n in range(len(shapes[k])) if n not in (*contract[k], *batch[k])]
            grid = np.arange(self.values[args[k]].size).reshape(shapes[k])
            grids.append(grid.transpose(*contract[k], *batch[k], *free))
            frees.append([shapes[k][n] for n in free])
        count = int(np.prod([shapes[0][n] for n in contract[0]]))
        shape = [shapes[0][n] for n in batch[0]]
        left = grids[0].reshape(count, *shape, *frees[0], *[1] * len(frees[1]))
        right = grids[1].reshape(count, *shape, *[1] * len(frees[0]), *frees[1])
        terms = []
        for a, b in zip(*np.broadcast_arrays(left, right), strict=True):
            pair = self.take([args[0]], a), self.take([args[1]], b)
            terms.append(self.apply("mul", kind, *pair))
        return self._fold("add", kind, terms)


def kind_of(dtype: Any) -> str:
    """The kind of a value of a NumPy type.

    Raises:
        InputError: there is none.
    """
    kind = _KINDS.get(np.dtype(dtype).kind) if not jax.dtypes.issubdtype(
        dtype, jax.dtypes.extended
    ) else None  # fmt: skip
    if kind is None:
        raise InputError(
            "controller", "real numbers, signed whole numbers or truth values in its step", dtype
        )
    return kind


class View(NamedTuple):
    """An index of a simple form: `start + step * ((i // run) % period)`."""

    start: int
    step: int = 1
    run: int = 1
    period: int = 0  # 0: none


def find_view(index: Sequence[int]) -> View | None:
    """The simple form of an index, no step backwards; None if it has none."""
    places, size = np.asarray(index), len(index)
    start, counter = int(places[0]), np.arange(size)
    steps = np.diff(places)
    changes, back = np.flatnonzero(steps), np.flatnonzero(places[1:] == start)
    run = int(changes[0]) + 1 if len(changes) else size
    period = int(back[back >= run - 1][0]) + 1 if (back >= run - 1).any() and run < size else 0
    for view in (
        View(start, int(steps[0]) if size > 1 else 1),
        View(start, int(places[run] - start) if run < size else 0, run),
        View(start, int(steps[0]) if size > 1 else 1, 1, period),
    ):
        turn = counter // view.run
        turn = turn % view.period if view.period else turn
        if view.step >= 0 and (start + view.step * turn == places).all():
            return view
    return None


def split_runs(index: Sequence[int]) -> list[tuple[int, int, int]]:
    """An index as runs (first of them, start, count) of neighbouring elements."""
    places = np.asarray(index)
    cuts = [0, *(np.flatnonzero(np.diff(places) != 1) + 1).tolist(), len(places)]
    return [(a, int(places[a]), b - a) for a, b in pairwise(cuts)]


def number_text(x: np.generic, nan: str, infinity: str) -> str:
    """A number that C and Python read to the same bits; `nan`, `infinity`: names of these."""
    if not isinstance(x, np.floating):
        return str(x).lower() if infinity == "INFINITY" else str(x)
    if not np.isfinite(x):
        return nan if np.isnan(x) else infinity if x > 0 else f"-{infinity}"
    return repr(float(x))
