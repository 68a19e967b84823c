"""Programs kept on disk: found by what they were made of, and made anew where a file is damaged."""

import jax.numpy as jnp
import pytest

from mjx_revolve.numerics import runtime
from mjx_revolve.numerics.executables import StoredProgram


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where programs are kept."""
    monkeypatch.setattr(runtime, "program_folder", lambda: tmp_path / "programs")
    monkeypatch.setattr(runtime, "compile_lock", lambda _: __import__("contextlib").nullcontext())
    return tmp_path / "programs"


def _program(made_of, traced):
    def fun(pair, x):
        traced.append(made_of)
        return pair[0] * x, {"sum": pair[1] + x.sum()}

    return StoredProgram(fun, made_of)


def test_a_program_is_traced_once_for_what_it_is_made_of(folder):
    traced = []
    arguments = (jnp.float32(2), jnp.float32(1)), jnp.arange(3, dtype=jnp.float32)
    for made_of in ("one", "one", "another"):
        product, found = _program(made_of, traced)(*arguments)
        assert product.tolist() == [0, 2, 4] and found["sum"] == 4
    assert traced == ["one", "another"] and len(list(folder.iterdir())) == 2
    _program("one", traced)(arguments[0], jnp.zeros(4))  # of another shape
    assert traced == ["one", "another", "one"]


def test_a_damaged_file_is_compiled_anew_and_unnamed_programs_are_not_kept(folder):
    traced = []
    arguments = (jnp.float32(2), jnp.float32(1)), jnp.arange(3, dtype=jnp.float32)
    _program(None, traced)(*arguments)
    assert not folder.exists()
    _program("one", traced)(*arguments)
    (file,) = folder.iterdir()
    file.write_bytes(file.read_bytes()[:-9])
    assert _program("one", traced)(*arguments)[0].tolist() == [0, 2, 4]
    assert traced == [None, "one", "one"]
