"""What it takes to make XLA:CPU compile a population step into one fast loop. Nothing else knows.

Two things stand in the way, and two internal annotations of XLA remove them (jaxlib is pinned for
their sake; tests/test_xla.py notices if they lose their effect; results do not depend on them):

1. XLA:CPU recomputes a shared value inside every fusion that uses it, and a tree recursion is
   nothing but shared values: the work multiplies with depth. `optimization_barrier` does not help,
   as the CPU compiler drops it before fusion. A call that is never inlined does: `share_once`.
2. Each kernel that the loop runs costs about 300 ns to dispatch, more than the arithmetic on a
   chunk of 64 individuals. A call marked `xla_cpu_small_call` is compiled into one function:
   `one_loop`. Inside it there is no scatter and no reduction: the population step writes sums out.

Both are plain identities to JAX: jit, vmap and grad go through them. On other back ends they are
left out.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental.xla_metadata import set_xla_metadata
from jax.extend import core

# Individuals stepped together on a CPU: enough to fill vector registers, few enough that the loop's
# live values stay in the first-level cache (measured: 64 to 256 alike, 16 to 32 slower).
LANES = 64

# Least cost, in plain operations, at which storing and loading a value beats computing it twice.
_WORTH = 4

# Operations that cost more than a plain one; views cost nothing.
_COST = {"sqrt": 8, "rsqrt": 8, "div": 8, "tanh": 20, "exp": 15, "atan2": 40, "sin": 20, "cos": 20}

# Views and copies: nothing is computed, so there is nothing to share.
_VIEWS = {
    "broadcast_in_dim",
    "concatenate",
    "convert_element_type",
    "copy",
    "reshape",
    "slice",
    "squeeze",
}

_COST |= dict.fromkeys(_VIEWS, 0)


def on_cpu() -> bool:
    """Whether JAX's default back end is the CPU, where the annotations mean something."""
    return jax.default_backend() == "cpu"


def compiler_options() -> dict[str, Any] | None:
    """Options for the outermost `jax.jit` of a rollout; 30 % on processors with AVX-512."""
    return {"xla_cpu_prefer_vector_width": 512} if on_cpu() else None


def _never_inlined(x: jax.Array) -> jax.Array:
    return set_xla_metadata(jax.jit(lambda y: y)(x), inlineable="false")


def share_once(fun: Callable[..., Any], worth: float = _WORTH) -> Callable[..., Any]:
    """Makes XLA compute each value that `fun` uses more than once exactly once.

    Args:
        fun: a function of pytrees of arrays.
        worth: least cost of a value that is worth storing, in plain operations.

    Returns:
        The same function, its multiply-used floating-point values behind calls that are not
        inlined.
    """

    def shared(*args: Any) -> Any:
        if not on_cpu():
            return fun(*args)
        leaves, tree = jax.tree.flatten(args)
        out_tree: list[Any] = []

        def flat(*xs: Any) -> list[Any]:
            out, structure = jax.tree.flatten(fun(*jax.tree.unflatten(tree, xs)))
            out_tree.append(structure)
            return out

        closed = jax.make_jaxpr(flat)(*leaves)
        out = _evaluate(closed.jaxpr, closed.consts, leaves, worth)
        return jax.tree.unflatten(out_tree[0], out)

    return shared


def _evaluate(jaxpr: Any, consts: list[Any], args: list[Any], worth: float) -> list[Any]:
    """Runs a jaxpr again with a barrier behind each value that several equations read."""
    uses: dict[Any, int] = {}
    for eqn in jaxpr.eqns:
        for v in {v for v in eqn.invars if not isinstance(v, core.Literal)}:
            uses[v] = uses.get(v, 0) + 1
    for v in jaxpr.outvars:
        if not isinstance(v, core.Literal):
            uses[v] = uses.get(v, 0) + 1
    env: dict[Any, Any] = dict(zip(jaxpr.constvars, consts, strict=True))
    env.update(zip(jaxpr.invars, args, strict=True))
    # What it costs to compute a value again from what is already in memory.
    cost: dict[Any, int] = {}

    def read(v: Any) -> Any:
        if not isinstance(v, core.Literal):
            return env[v]
        # Its dtype is in its aval: a bare Python number would take the mode's, 32 or 64 bits.
        aval: Any = v.aval
        return np.asarray(v.val, aval.dtype)

    for eqn in jaxpr.eqns:
        inputs = [read(v) for v in eqn.invars]
        inner = eqn.params.get("jaxpr") if eqn.primitive.name in ("jit", "pjit") else None
        if inner is not None:
            # jnp.clip, jnp.where and their like are small jitted functions.
            out = _evaluate(inner.jaxpr, inner.consts, inputs, worth)
        else:
            out = eqn.primitive.bind(*inputs, **eqn.params)
            out = out if eqn.primitive.multiple_results else [out]
        name = eqn.primitive.name
        spent = _COST.get(name, 1) + sum(
            cost.get(v, 0) for v in eqn.invars if not isinstance(v, core.Literal)
        )
        for v, x in zip(eqn.outvars, out, strict=True):
            stored = (
                uses.get(v, 0) > 1
                and spent >= worth
                and name not in _VIEWS
                and jnp.issubdtype(v.aval.dtype, jnp.floating)
                and v.aval.ndim > 0
                and inner is None
            )
            env[v] = _never_inlined(x) if stored else x
            cost[v] = 0 if stored or inner is not None else spent
    return [read(v) for v in jaxpr.outvars]


def one_loop(fun: Callable[..., Any], derived: Callable[..., Any]) -> Callable[..., Any]:
    """Makes XLA:CPU compile `fun`, a scan of element-wise steps, as one function.

    Args:
        fun: a function of pytrees of arrays.
        derived: the same function as it is to be differentiated: XLA takes minutes over the
            derivative of one long function, and seconds over many short ones.

    Returns:
        The same function.
    """

    @jax.custom_jvp
    def called(*args: Any) -> Any:
        if not on_cpu():
            return fun(*args)
        return jax.tree.map(
            lambda x: set_xla_metadata(x, inlineable="false", xla_cpu_small_call="true"),
            jax.jit(fun)(*args),
        )

    @called.defjvp
    def _derive(primals: Any, tangents: Any) -> Any:
        return jax.jvp(derived, primals, tangents)

    return called


def over_chunks(fun: Callable[..., Any], lanes: int | None = None) -> Callable[..., Any]:
    """Runs `fun` over the population in chunks of equal shape.

    The chunk's shape is fixed and the last one is padded with copies of the first individual, so an
    individual's result does not depend on the population around it.

    Args:
        fun: takes and returns pytrees of arrays with the population on the last axis.
        lanes: chunk size; by default `LANES` on a CPU, the whole population elsewhere.

    Returns:
        The same function for any population size.
    """

    def chunked(*args: Any) -> Any:
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
