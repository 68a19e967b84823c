"""A rollout that remembers its way, and the way back along it: slopes by what drives it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp

from mjx_revolve.episodes.rollout import Passage
from mjx_revolve.numerics.adjoint import fused_back
from mjx_revolve.numerics.xla import in_one_array

Pull = Callable[[Any], tuple[Passage, list[jax.Array]]]


def roll_out_taped(
    told: Callable[[Any, Passage, Any], tuple[Any, jax.Array, Any]],
    step: Callable[[Passage, Any, Any], tuple[Passage, jax.Array]],
    record: Callable[[Passage, jax.Array, Any], Any],
    parameters: Any,
    now: Passage,
    still: jax.Array,
    inputs: Any,
    *,
    records: int,
    every: int,
) -> tuple[Passage, Any, Pull]:
    """Steps a chunk of a population on, records it now and then, and can go back, once.

    Each step is kept as what it began from, and computed again on the way back. Slopes by the
    parameters are not gathered in the loop, where they would be arrays as large as the parameters
    at every step, but from all steps of a record at once: the loop only finds the slopes by the
    commands and by the controllers' states.

    Args:
        told: (parameters, rollout, inputs of this step) → (controller state, ctrl, water), as of
            `rollout.make_drive`.
        step: from `rollout.make_step`, of these parameters.
        record: (rollout, ctrl of the last step, its inputs) → what to keep, arrays of floats.
        parameters: of the controllers; slopes are found by those leaves that are arrays of floats.
        now: the rollout, before the first step or later; its scalars have no slopes.
        still: `[n, lanes]` zeros, like ctrl.
        inputs: None, or arrays `[records, every, ...]`, one row for each step.
        records: how many.
        every: steps between them.

    Returns:
        The rollout at its end; the records, `[records, ...]` each; and the way back, slopes by the
        records → (slopes by `now`, slopes by `floats_of(parameters)`).
    """
    carry = (now, still)
    pack, unpack = in_one_array(carry)
    first = jax.tree.map(lambda x: x[0, 0], inputs)
    ahead, back = fused_back(
        lambda carry, row, push: step(carry[0], row, push), carry, first, still
    )

    def renew(block: Any, scalars: Any) -> Any:
        """Packed, without the work so far: that of a record is its own."""
        begun, ctrl = unpack((block, scalars))
        return pack((begun._replace(energy=jnp.zeros_like(begun.energy)), ctrl))

    def keep(block: Any, scalars: Any, rows: Any) -> Any:
        last = jax.tree.map(lambda x: x[-1], rows)
        then, ctrl = unpack((block, scalars))
        return record(then, ctrl, last)

    def forth(packed: Any, rows: Any) -> tuple[Any, Any]:
        go = lambda packed, row: (ahead(packed, row), packed)  # noqa: E731
        packed, path = jax.lax.scan(go, renew(packed[0], packed[1]), rows, every)
        return packed, (path, packed, keep(packed[0], packed[1], rows))

    end, (paths, ends, kept) = jax.lax.scan(forth, pack(carry), inputs, records)
    values = floats_of(parameters)

    def by_parameters(path: Any, rows: Any, after: jax.Array, push: jax.Array) -> list[jax.Array]:
        """Slopes by the parameters, from those by what they told the steps along a path."""

        def tell(values: list[jax.Array]) -> Any:
            filled = _fill(parameters, values)

            def one(packed: Any, row: Any) -> Any:
                drive_state, ctrl, *_ = told(filled, unpack(packed)[0], row)
                return wide_of(drive_state), ctrl

            return jax.vmap(one)(path, rows)

        _, pull = jax.vjp(tell, values)
        states = jax.vmap(lambda block, packed: wide_of(unpack((block, packed[1]))[0].drive_state))
        found: list[jax.Array] = pull((states(after, path), push))[0]
        return found

    def pull(by_kept: Any) -> tuple[Passage, list[jax.Array]]:
        def retreat(carried: Any, given: Any) -> tuple[Any, None]:
            slope, total = carried
            path, (block, scalars), rows, by_row = given
            slope = slope + jax.vjp(lambda x: keep(x, scalars, rows), block)[1](by_row)[0]

            def one(slope: Any, given: Any) -> Any:
                before, push = back(slope, *given)
                return before, (slope, push)

            slope, (after, push) = jax.lax.scan(one, slope, (path, rows), every, reverse=True)
            found = by_parameters(path, rows, after, push)
            return (
                renew(slope, scalars)[0],
                [a + b for a, b in zip(total, found, strict=True)],
            ), None

        begun = jnp.zeros_like(end[0]), [jnp.zeros_like(x) for x in values]
        (slope, total), _ = jax.lax.scan(
            retreat, begun, (paths, ends, inputs, by_kept), records, reverse=True
        )
        return unpack((slope, end[1]))[0], total

    return unpack(end)[0], kept, pull


def floats_of(tree: Any) -> list[jax.Array]:
    """The leaves that are arrays of floats, in order."""
    return [x for x in jax.tree.leaves(tree) if _is_float(x)]


def _is_float(x: Any) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)


def _fill(tree: Any, values: list[jax.Array]) -> Any:
    """The tree with other arrays of floats."""
    given = iter(values)
    return jax.tree.map(lambda x: next(given) if _is_float(x) else x, tree)


def wide_of(tree: Any) -> list[jax.Array]:
    """The leaves that have slopes."""
    return [x for x in jax.tree.leaves(tree) if x.ndim > 0]
