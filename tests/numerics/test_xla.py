"""The compiler tricks: identities to JAX, and noticed when XLA stops taking them."""

import re
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from mjx_revolve.numerics import xla
from mjx_revolve.numerics.adjoint import differentiate_as
from mjx_revolve.numerics.xla import fuse, fuse_outermost, fuse_step, on_cpu, over_chunks

LANES = jnp.linspace(-1, 1, 64, dtype=jnp.float32)


def step(x):
    """A value that several others use, several times over: what a tree recursion is made of."""
    for _ in range(6):
        y = jnp.sqrt(x * x + 1) / (1 + 0.1 * x)
        x = jnp.clip(y * y - y * x + 0.5 * x, -2, 2)
    return x


def rolled(x, body):
    return jax.lax.scan(lambda s, _: (body(s), None), x, None, length=5)[0]


def turn(carry, row):
    """A step of a carry with leaves of several shapes; a row comes in, and one goes out."""
    x, (y, count, signs) = carry
    x = step(x + row) + 0.1 * y[0]
    y = jnp.stack([jnp.sin(x) * y[1], jnp.cos(x + y[0])])
    return (x, (y, count + 1, signs + (x > 0))), x * y[1] * count


def fused(x):
    rows = jnp.linspace(0, 1, 7)
    carry = (x, (jnp.stack([x, -x]), jnp.zeros((), jnp.int32), jnp.zeros(x.shape, jnp.int32)))
    packed_turn, pack, unpack = fuse_step(turn, carry, rows[0])
    packed, kept = jax.lax.scan(packed_turn, pack(carry), rows)
    return unpack(packed), kept


def plain(x):
    carry, kept = (x, (jnp.stack([x, -x]), 0, jnp.zeros(x.shape, jnp.int32))), []
    for row in np.linspace(0, 1, 7, dtype=np.float32):
        carry, one = turn(carry, row)
        kept.append(one)
    return carry, jnp.stack(kept)


@pytest.mark.parametrize("calls", [True, False])
def test_without_calls_there_are_none_to_abort_over(calls):
    whole = fuse(lambda x: jax.lax.cond(x[0] > 0, fuse(step), step, x), inline=True, calls=calls)
    assert ("xla_cpu_small_call" in jax.jit(whole).lower(LANES).as_text()) == calls


@pytest.mark.slow
@pytest.mark.parametrize("pieces", [1, 2, 5])
def test_they_change_nothing(monkeypatch, pieces):
    """Whole, and cut into pieces: to rounding, as the compiler may contract other products."""
    monkeypatch.setattr(xla, "_PIECE", xla.Graph(step, (LANES,)).size / pieces)
    tricked = jax.jit(differentiate_as(fused, plain))
    agree = partial(jax.tree.map, partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5))
    agree(tricked(LANES), plain(LANES))
    both = jax.vmap(tricked)(jnp.stack([LANES, 2 * LANES]))
    agree(jax.tree.map(lambda x: x[0], both), plain(LANES))
    slope, expected = (jax.grad(lambda x, f=f: jnp.sum(f(x)[1]))(LANES) for f in (tricked, plain))
    np.testing.assert_allclose(slope, expected, rtol=1e-3, atol=1e-4)


def test_functions_with_a_derivative_of_their_own_keep_it():
    for fun in (jax.nn.relu, jax.scipy.special.xlogy):
        given = (LANES,) * (1 if fun is jax.nn.relu else 2)
        for make in (lambda f: f, lambda f: jax.grad(lambda *x: jnp.sum(f(*x)))):
            found, expected = make(fuse(fun))(*given), make(fun)(*given)
            np.testing.assert_allclose(found, expected, rtol=1e-6)


@pytest.mark.skipif(not on_cpu(), reason="the tricks are for XLA:CPU")
def test_what_no_result_needs_is_left_out():
    """XLA:CPU aborts over a called function with an argument that only such operations use."""

    def fun(x, unused):
        return jnp.tanh(x), jnp.sqrt(unused) + jnp.exp(x)

    left = str(jax.make_jaxpr(fuse(lambda *xs: fun(*xs)[0], inline=True))(LANES, LANES))
    both = str(jax.make_jaxpr(fuse(fun, inline=True))(LANES, LANES))
    assert "sqrt" in both and "exp" in both and "tanh" in left
    assert "sqrt" not in left and "exp" not in left


@pytest.mark.skipif(not on_cpu(), reason="the tricks are for XLA:CPU")
def test_xla_still_takes_them(monkeypatch):
    """A misspelt or withdrawn annotation would be ignored in silence: look at the compiled text."""

    def text(fun):
        return jax.jit(lambda x: fun(x)).lower(LANES).compile().as_text()

    bare = text(lambda x: rolled(x, step))
    shared = text(lambda x: rolled(x, fuse(step, inline=True)))
    # Shared values stay behind calls of their own that were not inlined.
    assert shared.count(" call(") > bare.count(" call(")
    marked = lambda x: len(re.findall(r" call\(.*xla_cpu_small_call", text(x)))  # noqa: E731
    assert marked(lambda x: rolled(x, fuse(step, inline=True))) == 0
    assert marked(fused) == 1
    monkeypatch.setattr(xla, "_PIECE", 2)
    assert marked(fused) == round(xla.Graph(step, (LANES,)).size / 2) > 2


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


@pytest.mark.skipif(not on_cpu(), reason="the annotations are for CPUs")
def test_a_function_is_fused_once_whatever_its_caller_does():
    """By itself it is fused, with its numbers as they are; within a fused function it is not."""
    seen = []

    def scaled(x, factor):
        seen.append(factor)
        return step(factor * x)

    alone = jax.make_jaxpr(lambda x: fuse_outermost(scaled, x, 2.0))(LANES)
    within = jax.make_jaxpr(fuse(lambda x: fuse_outermost(scaled, x, 2.0), inline=True))(LANES)
    plainly = jax.make_jaxpr(fuse(lambda x: scaled(x, 2.0), inline=True))(LANES)
    assert "materialize" in str(alone) and str(within) == str(plainly)
    assert set(map(type, seen)) == {float}
    assert (fuse_outermost(scaled, LANES, 2.0) == step(2.0 * LANES)).all()


def test_without_the_annotations_the_results_are_the_same(monkeypatch):
    """`MJX_REVOLVE_FUSE=0` tells an error of XLA's from one of ours."""
    tricked = jax.jit(lambda x: (fused(x), fuse(step)(x)))(LANES)
    monkeypatch.setenv("MJX_REVOLVE_FUSE", "0")
    bare = jax.jit(lambda x: (fused(x), fuse(step)(x)))
    assert "materialize" not in str(jax.make_jaxpr(bare)(LANES))
    assert "small_call" not in bare.lower(LANES).as_text()
    jax.tree.map(partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-5), bare(LANES), tricked)
