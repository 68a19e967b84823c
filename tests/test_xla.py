"""The compiler tricks: identities to JAX, and noticed when XLA stops taking them."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_revolve.xla import on_cpu, one_loop, over_chunks, share_once

LANES = jnp.linspace(-1, 1, 64, dtype=jnp.float32)


def step(x):
    """A value that several others use, several times over: what a tree recursion is made of."""
    for _ in range(6):
        y = jnp.sqrt(x * x + 1) / (1 + 0.1 * x)
        x = jnp.clip(y * y - y * x + 0.5 * x, -2, 2)
    return x


def rolled(x, body):
    return jax.lax.scan(lambda s, _: (body(s), None), x, None, length=5)[0]


@pytest.mark.slow
def test_they_change_nothing():
    plain = rolled(LANES, step)
    tricked = jax.jit(one_loop(lambda x: rolled(x, share_once(step)), lambda x: rolled(x, step)))
    np.testing.assert_allclose(tricked(LANES), plain, rtol=1e-5)
    slope = jax.grad(lambda x: jnp.sum(tricked(x)))(LANES)
    np.testing.assert_allclose(
        slope, jax.grad(lambda x: jnp.sum(rolled(x, step)))(LANES), rtol=1e-4, atol=1e-5
    )
    both = jax.vmap(tricked)(jnp.stack([LANES, 2 * LANES]))
    np.testing.assert_allclose(both[0], plain, rtol=1e-5)


@pytest.mark.skipif(not on_cpu(), reason="the tricks are for XLA:CPU")
def test_xla_still_takes_them():
    """A misspelt or withdrawn annotation would be ignored in silence: look at the compiled text."""

    def text(fun):
        return jax.jit(fun).lower(LANES).compile().as_text()

    plain = text(lambda x: rolled(x, step))
    shared = text(lambda x: rolled(x, share_once(step)))
    looped = text(one_loop(lambda x: rolled(x, share_once(step)), lambda x: rolled(x, step)))
    # Shared values stay behind calls of their own that were not inlined.
    assert shared.count(" call(") > plain.count(" call(")
    assert "xla_cpu_small_call" in looped and "xla_cpu_small_call" not in shared


def test_chunks_are_all_of_one_shape():
    seen = []

    def fun(x, y):
        seen.append(x.shape)
        return {"sum": x + y, "rows": jnp.stack([x, y])}

    x = jnp.arange(10.0)
    out = over_chunks(fun, lanes=4)(x, 2 * x)
    np.testing.assert_array_equal(out["sum"], 3 * x)
    np.testing.assert_array_equal(out["rows"], jnp.stack([x, 2 * x]))
    assert set(seen) == {(4,)}
