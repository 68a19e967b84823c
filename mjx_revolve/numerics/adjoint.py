"""The way back over a loop of steps, compiled as the way ahead is.

JAX's own way back over a scan of population steps is hundreds of small kernels for each step: it
takes 20 times as long as the way ahead, and XLA minutes to compile. Here the loop ahead keeps what
it carries into each step, one array; a step back computes that step again and derives it (which is
checkpointing at every step: memory grows with the carry alone), and is cut into small calls like
the step itself. It takes 3 times as long as the way ahead.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.numerics.xla import in_one_array, in_small_calls


def fused_back(
    step: Callable[[Any, Any, Any], Any], carry: Any, row: Any, push: jax.Array
) -> tuple[Callable[[Any, Any], Any], Callable[[Any, Any, Any], tuple[Any, jax.Array]]]:
    """The steps ahead and back of a loop whose slopes are wanted.

    Args:
        step: (carry, row, push) → carry; element-wise but for sums over what is broadcast. Of the
            carry's leaves, those `[..., lanes]` have slopes; scalars have none.
        carry: one like those that it will get.
        row: likewise; nothing is derived by it.
        push: likewise, what is added to something within the step so that slopes by it are found.

    Returns:
        (ahead, back). Ahead: (carry, row) → carry, without a push. Back: (slope by the carry after
        the step, carry before it, row) → (slope by that one, slope by the push). Carries are packed
        by `xla.in_one_array`, slopes like its first result.
    """
    pack, unpack = in_one_array(carry)
    wide = [x.ndim > 0 for x in jax.tree.leaves(carry)]
    none = jnp.zeros_like(push)

    def spread(carry: Any) -> list[jax.Array]:
        return [x for x, w in zip(jax.tree.leaves(carry), wide, strict=True) if w]

    def back(slope: Any, carry: Any, row: Any) -> Any:
        leaves, tree = jax.tree.flatten(carry)

        def run(values: list[jax.Array], push: jax.Array) -> list[jax.Array]:
            given = iter(values)
            filled = [next(given) if w else x for x, w in zip(leaves, wide, strict=True)]
            return spread(step(jax.tree.unflatten(tree, filled), row, push))

        _, pull = jax.vjp(run, spread(carry), none)
        return pull(spread(slope))

    ahead = in_small_calls(
        lambda carry, row: step(carry, row, none),
        (carry, row),
        pack,
        lambda packed, row: (unpack(packed), row),
    )
    stacked = in_small_calls(
        back,
        (carry, carry, row),
        lambda found: (pack(found[0])[0], found[1]),
        lambda slope, packed, row: (unpack((slope, packed[1])), unpack(packed), row),
    )
    return ahead, stacked
