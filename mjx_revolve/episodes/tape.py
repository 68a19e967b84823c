"""A rollout that records its states, and its backward pass: gradients by controller parameters."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, PyTree

from mjx_revolve.control.readings import NO_INTERACTION
from mjx_revolve.episodes.rollout import Recorder, Rollout, RolloutState, StepInputs
from mjx_revolve.numerics.adjoint import fused_back
from mjx_revolve.numerics.xla import in_one_array, is_wide

Pull = Callable[[PyTree], tuple[RolloutState, list[jax.Array]]]


def advance_taped(
    make: Callable[[PyTree], Rollout],
    recorder: Recorder,
    parameters: PyTree,
    now: RolloutState,
    still: Float[Array, "n lanes"],
    inputs: StepInputs,
    *,
    records: int,
    every: int,
) -> tuple[RolloutState, PyTree, Pull]:
    """`Rollout.advance` with a backward pass, which may be called once.

    The state before each step is kept, and the step computed again in the backward pass. Gradients
    by the parameters are not summed in the loop, where each step would add arrays as large as the
    parameters, but over all steps of a record at once: the loop computes only gradients by commands
    and by controllers' states.

    Args:
        make: parameters of the controllers → rollout.
        recorder: makes a record, of arrays of floats.
        parameters: gradients are found by those leaves that are arrays of floats.
        now: before the first step or later; its scalars have no gradients.
        still: zeros, like ctrl.
        inputs: `[records, every, ...]`.
        records: number of records.
        every: steps between them.

    Returns:
        The state after the last step; the records, `[records, ...]` each; and the backward pass:
        gradients by the records → (gradients by `now`, gradients by `float_leaves(parameters)`).
    """
    rollout = make(parameters)
    carry = (now, still)
    pack, unpack = in_one_array(carry)
    first = jax.tree.map(lambda x: x[0, 0], inputs)

    def step(carry: PyTree, row: StepInputs, offset: jax.Array) -> PyTree:
        return rollout.step(carry[0], (row, NO_INTERACTION), offset)

    ahead, back = fused_back(step, carry, first, still, rollout.engine.tree.meets)

    def renew(block: PyTree, scalars: PyTree) -> PyTree:
        """Packed, without the work so far: that of a record is its own."""
        begun, ctrl = unpack((block, scalars))
        return pack((begun._replace(energy=jnp.zeros_like(begun.energy)), ctrl))

    def keep(block: PyTree, scalars: PyTree, rows: StepInputs) -> PyTree:
        then, ctrl = unpack((block, scalars))
        return rollout.record(recorder, then, ctrl, jax.tree.map(lambda x: x[-1], rows))

    def forth(packed: PyTree, rows: StepInputs) -> tuple[PyTree, PyTree]:
        go = lambda packed, row: (ahead(packed, row), packed)  # noqa: E731
        packed, path = jax.lax.scan(go, renew(packed[0], packed[1]), rows, every)
        return packed, (path, packed, keep(packed[0], packed[1], rows))

    end, (paths, ends, kept) = jax.lax.scan(forth, pack(carry), inputs, records)
    values = float_leaves(parameters)

    def by_parameters(
        path: PyTree, rows: StepInputs, after: jax.Array, offset: jax.Array
    ) -> list[jax.Array]:
        """Gradients by the parameters, from those by the controllers' outputs along a path."""

        def act(values: list[jax.Array]) -> PyTree:
            filled = make(_fill(parameters, values))

            def one(packed: PyTree, row: StepInputs) -> PyTree:
                controller_state, ctrl, *_ = filled.act(unpack(packed)[0], row)
                return wide_leaves(controller_state), ctrl

            return jax.vmap(one)(path, rows)

        def states(block: jax.Array, packed: PyTree) -> list[jax.Array]:
            return wide_leaves(unpack((block, packed[1]))[0].controller_state)

        _, pull = jax.vjp(act, values)
        return pull((jax.vmap(states)(after, path), offset))[0]

    def pull(by_kept: PyTree) -> tuple[RolloutState, list[jax.Array]]:
        def retreat(carried: PyTree, given: PyTree) -> tuple[PyTree, None]:
            gradient, total = carried
            path, (block, scalars), rows, by_row = given
            gradient = gradient + jax.vjp(lambda x: keep(x, scalars, rows), block)[1](by_row)[0]

            def one(gradient: PyTree, given: PyTree) -> PyTree:
                before, offset = back(gradient, *given)
                return before, (gradient, offset)

            gradient, (after, offset) = jax.lax.scan(
                one, gradient, (path, rows), every, reverse=True
            )
            found = by_parameters(path, rows, after, offset)
            total = [a + b for a, b in zip(total, found, strict=True)]
            return (renew(gradient, scalars)[0], total), None

        begun = jnp.zeros_like(end[0]), [jnp.zeros_like(x) for x in values]
        (gradient, total), _ = jax.lax.scan(
            retreat, begun, (paths, ends, inputs, by_kept), records, reverse=True
        )
        return unpack((gradient, end[1]))[0], total

    return unpack(end)[0], kept, pull


def float_leaves(tree: PyTree) -> list[jax.Array]:
    """The leaves that are arrays of floats, in order."""
    return [x for x in jax.tree.leaves(tree) if _is_float(x)]


def _is_float(x: PyTree) -> bool:
    return isinstance(x, jax.Array) and jnp.issubdtype(x.dtype, jnp.floating)


def _fill(tree: PyTree, values: list[jax.Array]) -> PyTree:
    """The tree with other arrays of floats."""
    given = iter(values)
    return jax.tree.map(lambda x: next(given) if _is_float(x) else x, tree)


def wide_leaves(tree: PyTree) -> list[jax.Array]:
    """The leaves that have gradients."""
    return [x for x in jax.tree.leaves(tree) if is_wide(x)]
