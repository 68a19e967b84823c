"""The backward pass (reverse-mode gradient) over a loop of steps, compiled like the forward pass.

JAX's own backward pass over a scan of population steps is hundreds of small kernels for each step:
it takes 20 times as long as the forward pass, and XLA takes minutes to compile it. Here the forward
loop saves the carry of each step, as one array. A backward step computes that step again and
differentiates it (checkpointing at every step: only carries are kept), and is cut into small calls
like the step itself. It takes 3 times as long as the forward pass.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import PyTree

from mjx_revolve.numerics.xla import fuse, in_fused_calls, in_one_array, is_wide

P = ParamSpec("P")
R = TypeVar("R")


def differentiate_as(fun: Callable[P, R], differentiated: Callable[P, R]) -> Callable[P, R]:
    """`fun`, but differentiated as another form of the same function.

    XLA takes minutes over the derivative of one long function, and seconds over many short ones.
    """
    called = jax.custom_jvp(fun)

    @called.defjvp
    def _differentiate(primals: PyTree, tangents: PyTree) -> PyTree:
        return jax.jvp(differentiated, primals, tangents)

    return called


def fused_back(
    step: Callable[[PyTree, PyTree, PyTree], PyTree],
    carry: PyTree,
    row: PyTree,
    offset: jax.Array,
    loops: bool = False,
) -> tuple[
    Callable[[PyTree, PyTree], PyTree], Callable[[PyTree, PyTree, PyTree], tuple[PyTree, jax.Array]]
]:
    """The forward and the backward step of a loop that is differentiated.

    Args:
        step: (carry, row, offset) → carry; element-wise but for sums over what is broadcast. Of the
            carry's leaves, the wide ones have gradients (see `xla.is_wide`).
        carry: an example of the carry.
        row: an example of the loop's input in one step; it has no gradient.
        offset: an example; added to a value within the step, for the gradient by that value.
        loops: whether the step has loops over lanes. XLA:CPU takes them in no call beside a
            derivative, so that the backward step has none then.

    Returns:
        (forward, backward). Forward: (carry, row) → carry, without an offset. Backward: (gradient
        by the carry after the step, carry before it, row) → (gradient by the carry before it,
        gradient by the offset). Carries are packed by `xla.in_one_array`, gradients like its first
        result.
    """
    pack, unpack = in_one_array(carry)
    wide = [is_wide(x) for x in jax.tree.leaves(carry)]
    none = jnp.zeros_like(offset)

    def spread(carry: PyTree) -> list[jax.Array]:
        return [x for x, w in zip(jax.tree.leaves(carry), wide, strict=True) if w]

    def back(gradient: PyTree, carry: PyTree, row: PyTree) -> PyTree:
        leaves, tree = jax.tree.flatten(carry)

        def run(values: list[jax.Array], offset: jax.Array) -> list[jax.Array]:
            given = iter(values)
            filled = [next(given) if w else x for x, w in zip(leaves, wide, strict=True)]
            return spread(step(jax.tree.unflatten(tree, filled), row, offset))

        _, pull = jax.vjp(run, spread(carry), none)
        return pull(spread(gradient))

    ahead = in_fused_calls(
        lambda carry, row: step(carry, row, none),
        (carry, row),
        pack,
        lambda packed, row: (unpack(packed), row),
    )

    def result(found: tuple[PyTree, jax.Array]) -> tuple[PyTree, jax.Array]:
        return pack(found[0])[0], found[1]

    def given(gradient: PyTree, packed: PyTree, row: PyTree) -> tuple[PyTree, PyTree, PyTree]:
        return unpack((gradient, packed[1])), unpack(packed), row

    if loops:
        whole = lambda *packed: result(back(*given(*packed)))  # noqa: E731
        return ahead, fuse(whole, inline=True, calls=False)
    return ahead, in_fused_calls(back, (carry, carry, row), result, given)
