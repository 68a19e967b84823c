"""Compiles element-wise steps of a population into few fast loops on XLA:CPU.

Two internal annotations of XLA do it (`tests/numerics/test_xla.py` notices if a jaxlib no longer
heeds them). Results do not depend on them, but for the last bits.

1. XLA:CPU recomputes a shared value inside every fusion that uses it, and a tree recursion is
   nothing but shared values: the work multiplies with depth. An optimization barrier does not help,
   as the CPU compiler drops it before fusion. A call that is never inlined does: `materialize`.
2. Each kernel that a loop runs costs about 300 ns to dispatch, more than the arithmetic on a chunk
   of 64 individuals. A call marked `xla_cpu_small_call` is compiled into one function. Inside it
   there is no scatter and no reduction: the population step writes sums out. Compiling such a
   function takes time that grows with the square of its length: so long steps are cut into several
   functions. The loop over time stays outside: inside, it would be a tenth faster, but LLVM takes
   twice as long. XLA:CPU aborts ("All or none of the slices should have an explicit index") over
   a function with an unused parameter, and loops of unknown length leave such parameters behind: so
   operations that no result depends on are left out.

Other layers use `fuse_step`, `fuse`, `fuse_outermost` and `materialize`, all identities to JAX:
jit, vmap and grad go through them. They do nothing on other back ends, nor with the environment
variable `MJX_REVOLVE_FUSE=0`: the results are the same, but slower. So an error in XLA can be
distinguished from one in this package.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from contextvars import ContextVar
from typing import Any, NamedTuple, TypeVar, TypeVarTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core
from jax.interpreters import ad, batching, mlir
from jaxtyping import PyTree

from mjx_revolve.numerics.runtime import LANES as LANES

# Least cost, in plain operations, at which storing and loading a value beats computing it twice.
_WORTH = 4

# A step becomes functions of about so many stored values each, which LLVM compiles side by side.
# Measured (spider, default water, 482 values): in four pieces two cores are done in half of the
# time that one piece takes, and a step takes as long; in six it takes a sixth longer.
_PIECE = 120
# For one robot. Pieces save little there, and loops of unknown length are common: more pieces leave
# more parameters that are unused once MLIR has folded the operations that read them.
_PIECE_OF_ONE = 350

# Operations that cost more than a plain one; views cost nothing.
_COST = {"sqrt": 8, "rsqrt": 8, "div": 8, "tanh": 20, "exp": 15, "atan2": 40, "sin": 20, "cos": 20}

OLD_EMITTERS: dict[str, bool] = (
    {"xla_cpu_use_fusion_emitters": False} if jax.__version_info__ < (0, 11, 1) else {}
)
"""XLA's older emitters compile faster. jaxlib 0.11.1 has them no more, and refuses the option."""

# Views and copies: nothing is computed, so there is nothing to share.
_VIEWS = {
    "broadcast_in_dim", "concatenate", "convert_element_type", "copy", "reshape", "slice",
    "squeeze",
}  # fmt: skip

_COST |= dict.fromkeys(_VIEWS, 0)
_LOOPS = {"cond", "scan", "while"}

# Whether a function is traced that is fused as a whole, and that has no calls.
_fusing: ContextVar[bool] = ContextVar("_fusing", default=False)
_without_calls: ContextVar[bool] = ContextVar("_without_calls", default=False)

Ts = TypeVarTuple("Ts")
R = TypeVar("R")


def on_cpu() -> bool:
    """Whether JAX's default back end is the CPU."""
    return jax.default_backend() == "cpu"


def fuses() -> bool:
    """Whether programs are traced with the annotations; `MJX_REVOLVE_FUSE=0` turns them off."""
    return on_cpu() and os.environ.get("MJX_REVOLVE_FUSE") != "0"


def compiler_options(fast: bool = False) -> dict[str, Any] | None:
    """Options for the outermost `jax.jit` of a rollout.

    Args:
        fast: for a program that runs once: compiles in a quarter to a third of the processor time
            and runs ten times as slow. If false, the program uses vectors of 512 bits, 30 % faster
            on processors with AVX-512.
    """
    if not on_cpu():
        return None
    if fast:
        return {"xla_backend_optimization_level": 0, **OLD_EMITTERS}
    return {"xla_cpu_prefer_vector_width": 512}


def jit(fun: Callable[..., PyTree], fast: bool = False, **settings: Any) -> Any:
    """`jax.jit` with `compiler_options`; JAX accepts those on the outermost jit only."""
    return jax.jit(fun, compiler_options=compiler_options(fast), **settings)


def is_traced(*args: PyTree) -> bool:
    """Whether arguments are traced: they belong to an outer program with its own options."""
    return any(isinstance(x, jax.core.Tracer) for x in jax.tree.leaves(args))


materialize_p = core.Primitive("materialize")
"""The identity, computed by a function of its own on a CPU; `Graph` finds its operands by it."""


@jax.jit
def _same(x: jax.Array) -> jax.Array:
    return x


def _never_inlined(x: jax.Array) -> jax.Array:
    # One function for all: tracing hundreds of them anew would take half a second.
    return set_xla_metadata(_same(x), inlineable="false")


materialize_p.def_impl(lambda x: x)
materialize_p.def_abstract_eval(lambda x: x)
batching.defvectorized(materialize_p)
# The gradient of a materialized value is materialized, too: derivatives compile 7 times as fast.
ad.deflinear2(materialize_p, lambda cotangent, _: (materialize_p.bind(cotangent),))
mlir.register_lowering(materialize_p, lambda _, x: [x])
mlir.register_lowering(
    materialize_p, mlir.lower_fun(_never_inlined, False), platform="cpu", cacheable=False
)


def materialize(x: jax.Array) -> jax.Array:
    """`x`, computed once in a kernel of its own, however many operations use it.

    Use it also for values that are broadcast: XLA:CPU would compute them again for each element of
    the wider array.
    """
    return materialize_p.bind(x) if fuses() else x


def fuse(fun: Callable[[*Ts], R], inline: bool = False, calls: bool = True) -> Callable[[*Ts], R]:
    """The same function, with each intermediate value computed once by XLA.

    Args:
        fun: a function of pytrees of arrays; element-wise but for loops, unless `inline`.
        inline: compile it into its caller instead of into a function of its own.
        calls: whether functions that are fused within it become calls of their own. Where lanes are
            many, dispatching kernels costs nothing, and without calls XLA cannot abort over one.

    Returns:
        The same function.
    """

    def shared(*args: *Ts) -> R:
        before = _without_calls.set(_without_calls.get() or not calls)
        try:
            return Graph(fun, args)(*args) if fuses() else fun(*args)
        finally:
            _without_calls.reset(before)

    return shared if inline else fuse_call(shared)


def fuse_outermost(fun: Callable[[*Ts], R], *args: *Ts) -> R:
    """`fun(*args)`, fused into its caller unless that is fused as a whole.

    For functions that users compile by a `jax.jit` of their own, and that our loops contain:
    without it XLA:CPU takes minutes for one step of a robot.

    Args:
        fun: a function of pytrees of arrays.
        *args: its arguments.

    Returns:
        Its result.
    """
    if _fusing.get() or not is_traced(*args):
        return fun(*args)
    arrays, fill = split_arrays(args)
    return fuse(lambda xs: fun(*fill(xs)), inline=True)(arrays)


def split_arrays(tree: PyTree) -> tuple[list[jax.Array], Callable[[Sequence[jax.Array]], PyTree]]:
    """The arrays of a pytree, and what puts others in their places.

    Numbers stay numbers: what they make 0 or 1 is left out while a function is traced.
    """
    leaves, structure = jax.tree.flatten(tree)
    places = [k for k, x in enumerate(leaves) if isinstance(x, jax.Array)]

    def fill(arrays: Sequence[jax.Array]) -> PyTree:
        given = dict(zip(places, arrays, strict=True))
        return jax.tree.unflatten(structure, [given.get(k, x) for k, x in enumerate(leaves)])

    return [leaves[k] for k in places], fill


def fuse_call(fun: Callable[[*Ts], R]) -> Callable[[*Ts], R]:
    """The same function (element-wise but for loops), compiled by XLA:CPU into one call."""

    def called(*args: *Ts) -> R:
        return jax.tree.map(
            lambda x: set_xla_metadata(x, inlineable="false", xla_cpu_small_call="true"),
            jax.jit(fun)(*args),
        )

    return called if fuses() and not _without_calls.get() else fun


class _Operation(NamedTuple):
    """One primitive: its equation, its inputs (numbers of values, or literals) and its outputs."""

    equation: Any
    inputs: list[Any]
    outputs: list[int]


class Graph:
    """A traced function as a list of operations on numbered values, some of which are stored.

    Calling it evaluates the function, with stored values materialized.

    Attributes:
        size: number of stored values.
    """

    def __init__(self, fun: Callable[..., PyTree], examples: PyTree, last: bool = False) -> None:
        """Traces `fun` (of pytrees of arrays) on arguments like `examples`.

        `last`: it is not differentiated any more, so that derivatives of one's own are dropped.
        """
        within = _fusing.set(True)
        try:
            closed, shapes = jax.make_jaxpr(fun, return_shape=True)(*examples)
        finally:
            _fusing.reset(within)
        self._structure = jax.tree.structure(shapes)
        self._operations: list[_Operation] = []
        self._constants: dict[int, Any] = {}
        self._kept: set[int] = set()
        self._count = 0
        self._inlined = {"jit": "jaxpr", "pjit": "jaxpr"} | (
            {"custom_jvp_call": "call_jaxpr"} if last else {}
        )
        env = {v: self._number() for v in closed.jaxpr.invars}
        self._arguments = list(env.values())
        self._results = self._inline(closed.jaxpr, closed.consts, env)
        self._operations = self._alive()
        self._stored = self._choose()
        self.size = len(self._stored)

    def __call__(self, *args: PyTree) -> PyTree:
        """Computes the function."""
        values = self._constants | dict(zip(self._arguments, jax.tree.leaves(args), strict=True))
        self._compute(self._operations, values)
        return self._finish(values)

    def in_pieces(
        self, size: int, pack: Callable[[PyTree], PyTree], unpack: Callable[..., PyTree]
    ) -> Any:
        """The function cut into pieces, each compiled by `fuse_call`.

        XLA's time for a function grows faster than its length, and pieces compile in parallel.

        Args:
            size: of a piece, in stored values.
            pack: applied to the results, within the last piece.
            unpack: maps packed arguments to the function's own, within each piece.

        Returns:
            A function: packed arguments → packed results.
        """
        count = max(1, round(self.size / size))
        piece: dict[int, int] = {}
        for op in self._operations:  # the outputs of one operation stay together
            number = len(piece) * count // max(self.size, 1)
            piece |= {v: number for v in op.outputs if v in self._stored}
        made = {v: k for k, op in enumerate(self._operations) for v in op.outputs}
        ends = [v for v in self._results if isinstance(v, int)]
        own = [[v for v in piece if piece[v] == number] for number in range(count)]
        cuts = [self._cut(k, own[k] if k < count - 1 else ends, piece, made) for k in range(count)]
        read = {v for _, inputs in cuts for v in inputs}

        def run(*args: PyTree) -> PyTree:
            values: dict[int, Any] = {}
            leaves, tree = jax.tree.flatten(args)

            def arguments(*leaves: Any) -> list[Any]:
                return jax.tree.leaves(unpack(*jax.tree.unflatten(tree, leaves)))

            def run_piece(number: int) -> PyTree:
                (operations, inputs), last = cuts[number], number == count - 1
                outputs = [v for v in own[number] if v in read]
                wanted = {v for op in operations for v in op.inputs if isinstance(v, int)}
                wanted |= set(ends if last else ())
                used = _used_inputs(arguments, leaves, [v in wanted for v in self._arguments])

                def compute(given: PyTree, *xs: Any) -> Any:
                    local = self._constants | dict(zip(inputs, xs, strict=True))
                    some = iter(given)
                    whole = [
                        next(some) if u else np.zeros(x.shape, x.dtype)
                        for x, u in zip(leaves, used, strict=True)
                    ]
                    local |= zip(self._arguments, arguments(*whole), strict=True)
                    self._compute(operations, local)
                    return pack(self._finish(local)) if last else [local[v] for v in outputs]

                given = [x for x, u in zip(leaves, used, strict=True) if u]
                found = fuse_call(compute)(given, *(values[v] for v in inputs))
                if not last:
                    values.update(zip(outputs, found, strict=True))
                return found

            for number in range(count - 1):
                run_piece(number)
            return run_piece(count - 1)

        return run

    def _cut(
        self, number: int, wanted: list[int], piece: dict[int, int], made: dict[int, int]
    ) -> tuple[list[_Operation], list[int]]:
        """Operations of the piece that computes `wanted`, and its inputs from earlier pieces."""
        needed, inputs, seen, todo = set(), [], set(), list(wanted)
        while todo:
            v = todo.pop()
            if v in seen or v not in made:  # arguments and constants are everywhere
                continue
            seen.add(v)
            if piece.get(v, number) < number:
                inputs.append(v)
                continue
            needed.add(made[v])
            todo += [x for x in self._operations[made[v]].inputs if isinstance(x, int)]
        return [self._operations[k] for k in sorted(needed)], inputs

    def _number(self) -> int:
        self._count += 1
        return self._count

    def _inline(self, jaxpr: Any, consts: Any, env: dict[Any, Any]) -> list[Any]:
        """Lists a jaxpr's operations, with the bodies of small jitted functions inlined."""
        for v, x in zip(jaxpr.constvars, consts, strict=True):
            env[v] = self._number()
            self._constants[env[v]] = x
        read = lambda v: v if isinstance(v, core.Literal) else env[v]  # noqa: E731
        for eqn in jaxpr.eqns:
            inputs = [read(v) for v in eqn.invars]
            inner = eqn.params.get(self._inlined.get(eqn.primitive.name))
            if inner is not None:
                # jnp.clip, jnp.where and others are jitted functions.
                inside = dict(zip(inner.jaxpr.invars, inputs, strict=True))
                outputs = self._inline(inner.jaxpr, inner.consts, inside)
            elif eqn.primitive is materialize_p:
                outputs = inputs
                self._kept.update(v for v in outputs if isinstance(v, int))
            else:
                outputs = [self._number() for _ in eqn.outvars]
                self._operations.append(_Operation(eqn, inputs, outputs))
            env.update(zip(eqn.outvars, outputs, strict=True))
        return [read(v) for v in jaxpr.outvars]

    def _alive(self) -> list[_Operation]:
        """The operations that some result depends on."""
        needed = {v for v in self._results if isinstance(v, int)}
        kept = []
        for op in reversed(self._operations):
            if needed.intersection(op.outputs):
                needed.update(v for v in op.inputs if isinstance(v, int))
                kept.append(op)
        return kept[::-1]

    def _choose(self) -> dict[int, bool]:
        """Values to be stored, in order; False for outputs of loops, which XLA stores anyway."""
        uses: dict[int, int] = {}
        for inputs in [*(op.inputs for op in self._operations), self._results]:
            for v in {v for v in inputs if isinstance(v, int)}:
                uses[v] = uses.get(v, 0) + 1
        # The cost of computing a value again from values in memory.
        cost: dict[int, int] = {}
        stored: dict[int, bool] = {}
        for op in self._operations:
            name = op.equation.primitive.name
            spent = _COST.get(name, 1) + sum(
                cost.get(v, 0) for v in op.inputs if isinstance(v, int)
            )
            for v, variable in zip(op.outputs, op.equation.outvars, strict=True):
                if name in _LOOPS:
                    stored[v] = False
                elif (
                    (uses.get(v, 0) > 1 or v in self._kept)
                    and spent >= _WORTH
                    and name not in _VIEWS
                    and jnp.issubdtype(variable.aval.dtype, jnp.floating)
                    and variable.aval.ndim > 0
                ):
                    stored[v] = True
                cost[v] = 0 if v in stored else spent
        return stored

    def _compute(self, operations: list[_Operation], values: dict[int, Any]) -> None:
        for op in operations:
            inputs = [_value(values, v) for v in op.inputs]
            primitive = op.equation.primitive
            # As JAX evaluates a jaxpr: rules of custom derivatives are bound as functions.
            out = primitive.bind(*inputs, **primitive.get_bind_params(op.equation.params))
            out = out if primitive.multiple_results else [out]
            for v, x in zip(op.outputs, out, strict=True):
                values[v] = materialize_p.bind(x) if self._stored.get(v) else x

    def _finish(self, values: dict[int, Any]) -> PyTree:
        return jax.tree.unflatten(self._structure, [_value(values, v) for v in self._results])


def _used_inputs(fun: Callable[..., PyTree], args: list[Any], wanted: list[bool]) -> list[bool]:
    """Which arguments of a function its wanted results depend on."""
    jaxpr = jax.make_jaxpr(fun)(*args).jaxpr
    ends = (v for v, w in zip(jaxpr.outvars, wanted, strict=True) if w)
    needed = {v for v in ends if not isinstance(v, core.Literal)}
    for eqn in reversed(jaxpr.eqns):
        if needed.intersection(eqn.outvars):
            needed.update(v for v in eqn.invars if not isinstance(v, core.Literal))
    # Random keys are always kept: there is no zero to replace them.
    key = lambda v: jnp.issubdtype(v.aval.dtype, jax.dtypes.extended)  # noqa: E731
    return [v in needed or key(v) for v in jaxpr.invars]


def _value(values: dict[int, Any], v: Any) -> Any:
    if isinstance(v, int):
        return values[v]
    # A literal's dtype is in its aval: a bare Python number would take the mode's, 32 or 64 bits.
    return np.asarray(v.val, v.aval.dtype)


def take_lanes(x: jax.Array, which: jax.Array | None) -> jax.Array:
    """`x[..., which]` without bounds checks: `which` must be within bounds; None: all."""
    if which is None:
        return x
    dims = jax.lax.GatherDimensionNumbers(
        offset_dims=tuple(range(x.ndim - 1)), collapsed_slice_dims=(x.ndim - 1,),
        start_index_map=(x.ndim - 1,),
    )  # fmt: skip
    mode = jax.lax.GatherScatterMode.PROMISE_IN_BOUNDS
    return jax.lax.gather(x, which[:, None], dims, (*x.shape[:-1], 1), mode=mode)


def fuse_step(
    step: Callable[[PyTree, PyTree], tuple[PyTree, PyTree]], carry: PyTree, row: PyTree
) -> Any:
    """The fastest form of a loop's step over a chunk of a population.

    A step becomes one function, or several if it is long; XLA's loop calls them. The carry is
    packed into one array, because every array that a loop carries costs as much as a call.

    Args:
        step: (carry, row) → (carry, output); element-wise. The carry's leaves are `[..., lanes]`
            floats of one type; other leaves are carried unpacked.
        carry: an example of the carry.
        row: an example of the loop's input in one step.

    Returns:
        (step, pack, unpack): the step on packed carries, and functions between carries and packed
        ones.
    """
    if not fuses():
        return step, lambda x: x, lambda x: x
    pack, unpack = in_one_array(carry)
    fused = Graph(step, (carry, row), last=True).in_pieces(
        _piece_size(carry),
        lambda result: (pack(result[0]), result[1]),
        lambda packed, row: (unpack(packed), row),
    )
    return fused, pack, unpack


def _piece_size(examples: PyTree) -> int:
    lanes = max((x.shape[-1] for x in jax.tree.leaves(examples) if jnp.ndim(x)), default=1)
    return _PIECE if lanes > 1 else _PIECE_OF_ONE


def is_wide(x: jax.Array) -> bool:
    """Whether a leaf of a loop's carry is an array of floats; these are packed together."""
    return x.ndim > 0 and bool(jnp.issubdtype(x.dtype, jnp.floating))


def in_one_array(carry: PyTree) -> tuple[Callable[[PyTree], PyTree], Callable[[PyTree], PyTree]]:
    """Functions that pack what a loop carries.

    Args:
        carry: an example; its leaves are `[..., lanes]` floats of one type, or other values.

    Returns:
        (pack, unpack): between a carry and (`[rows, lanes]` of its wide leaves, one below the
        other; the list of other leaves).
    """
    leaves, tree = jax.tree.flatten(carry)
    wide = [is_wide(x) for x in leaves]
    rows = np.cumsum([0] + [x.size // x.shape[-1] for x, w in zip(leaves, wide, strict=True) if w])

    def pack(carry: PyTree) -> PyTree:
        leaves = jax.tree.leaves(carry)
        blocks = [x.reshape(-1, x.shape[-1]) for x in leaves if is_wide(x)]
        return jnp.concatenate(blocks), [x for x in leaves if not is_wide(x)]

    def unpack(packed: PyTree) -> PyTree:
        block, others = packed[0], iter(packed[1])
        slices = (block[a:b] for a, b in itertools.pairwise(rows))
        found = [
            next(slices).reshape(x.shape) if w else next(others)
            for x, w in zip(leaves, wide, strict=True)
        ]
        return jax.tree.unflatten(tree, found)

    return pack, unpack


def in_fused_calls(
    fun: Callable[..., PyTree],
    examples: PyTree,
    pack: Callable[[PyTree], PyTree],
    unpack: Callable[..., PyTree],
) -> Callable[..., PyTree]:
    """A function of packed arguments and results, as a few calls of compiled pieces.

    Args:
        fun: element-wise.
        examples: of its arguments.
        pack: applied to its results.
        unpack: maps packed arguments to the arguments of `fun`.

    Returns:
        A function: packed arguments → packed results.
    """
    if not fuses():
        return lambda *args: pack(fun(*unpack(*args)))
    return Graph(fun, examples, last=True).in_pieces(_piece_size(examples), pack, unpack)


def over_chunks(fun: Callable[[*Ts], R], lanes: int | None = None) -> Callable[[*Ts], R]:
    """Runs `fun` over the population in chunks of equal shape.

    The chunk's shape is fixed and the last one is padded with copies of the first individual, so an
    individual's result does not depend on the population around it.

    Args:
        fun: takes and returns pytrees of arrays with the population on the last axis.
        lanes: chunk size; by default `LANES` on a CPU, the whole population elsewhere.

    Returns:
        The same function for any population size.
    """

    def chunked(*args: *Ts) -> R:
        population = jax.tree.leaves(args)[0].shape[-1]
        size = lanes or (LANES if on_cpu() else population)
        count = -(-population // size)
        padding = count * size - population

        def split(x: jax.Array) -> jax.Array:
            x = jnp.concatenate([x, jnp.repeat(x[..., :1], padding, -1)], -1) if padding else x
            return jnp.moveaxis(x.reshape(*x.shape[:-1], count, size), -2, 0)

        def join(x: jax.Array) -> jax.Array:
            x = jnp.moveaxis(x, 0, -2)
            return x.reshape(*x.shape[:-2], count * size)[..., :population]

        if count == 1:
            chunk = jax.tree.map(lambda x: split(x)[0], args)
            return jax.tree.map(lambda x: x[..., :population], fun(*chunk))
        out = jax.lax.map(lambda chunk: fun(*chunk), jax.tree.map(split, args))
        return jax.tree.map(join, out)

    return chunked
