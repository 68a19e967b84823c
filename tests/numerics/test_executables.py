"""Programs kept on disk: found by what they were made of, and made anew where a file is damaged."""

import os
import time
from unittest.mock import Mock

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from mjx_revolve.numerics import runtime
from mjx_revolve.numerics.executables import StoredProgram

PAIR = jnp.float32(2), jnp.float32(1)
ARGUMENTS = PAIR, jnp.arange(3, dtype=jnp.float32)


@pytest.fixture
def caches(tmp_path, monkeypatch):
    """An empty cache of JAX's, and programs beside it."""
    jax_cache, least = "jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs"
    old = {name: getattr(jax.config, name) for name in (jax_cache, least)}
    jax.config.update(jax_cache, str(tmp_path))
    jax.config.update(least, 1e9)
    compilation_cache.reset_cache()
    monkeypatch.setattr(runtime, "program_folder", lambda: tmp_path / "programs")
    yield tmp_path
    for name, value in old.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def _program(made_of, traced):
    def fun(pair, x):
        traced.append(made_of)
        return pair[0] * x, {"sum": pair[1] + x.sum()}

    return StoredProgram(fun, made_of)


def _check(program, arguments=ARGUMENTS):
    product, found = program(*arguments)
    assert product.tolist() == (2 * arguments[1]).tolist()
    assert found["sum"] == 1 + arguments[1].sum()


def _programs(caches):
    return sorted(caches.glob("programs/*"))


def test_a_program_is_traced_once_for_what_it_is_made_of(caches):
    traced = []
    for made_of in ("one", "one", "another"):
        _check(_program(made_of, traced))
    assert traced == ["one", "another"] and len(_programs(caches)) == 2
    _check(_program("one", traced), (PAIR, jnp.ones(4)))  # of another shape
    assert traced == ["one", "another", "one"]


@pytest.mark.parametrize("content", [lambda x: x[:-9], lambda x: b"", lambda x: b"other" * 99])
def test_a_damaged_file_is_compiled_anew(caches, content):
    traced = []
    _check(_program("one", traced))
    (file,) = _programs(caches)
    whole = file.read_bytes()
    file.write_bytes(content(whole))
    _check(_program("one", traced))
    assert traced == ["one", "one"] and len(file.read_bytes()) == len(whole)
    _check(_program("one", traced))
    assert traced == ["one", "one"]


def test_unnamed_programs_are_not_kept_and_old_ones_are_removed(caches):
    traced = []
    _check(_program(None, traced))
    assert not _programs(caches)
    _check(_program("one", traced))
    (file,) = _programs(caches)
    os.utime(file, (time.time() - 31 * 86_400,) * 2)
    _check(_program("another", traced))
    assert file not in _programs(caches)


def test_programs_that_jax_s_cache_knows_are_kept_whole(caches):
    """As those of another version whose program is the same; jaxlib would write parts of them."""
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    traced = []
    for made_of in ("one", "another", "another"):
        _check(_program(made_of, traced))
    assert traced == ["one", "another"] and len(_programs(caches)) == 2
    _programs(caches)[0].unlink()
    for made_of in ("one", "another", "one", "another"):
        _check(_program(made_of, traced))
    assert len(traced) == 3 and len(_programs(caches)) == 2
    assert not list(caches.glob("*fun*"))  # nothing is there twice


def test_a_program_is_loaded_before_it_is_called(caches):
    for made_of in ("one", None):
        traced = []
        program = _program(made_of, traced)
        called = program.load(*ARGUMENTS)
        assert traced == [made_of]
        assert called(*ARGUMENTS)[0].tolist() == program(*ARGUMENTS)[0].tolist()
        assert traced == [made_of]


def test_a_folder_without_rights_takes_no_lock(caches, monkeypatch):
    monkeypatch.setattr("builtins.open", Mock(side_effect=PermissionError))
    with runtime.compile_lock("job", "one"):
        pass


def test_a_users_flags_of_xla_stay(monkeypatch):
    for given in ("--xla_dump_to=here", "--xla_backend_extra_options=-inline-threshold=9"):
        monkeypatch.setenv("XLA_FLAGS", given)
        runtime.fix_environment()
        flags = os.environ["XLA_FLAGS"]
        assert runtime.user_flags(flags) == given
        assert ("unroll" in flags) == ("dump" in given)


def test_random_numbers_of_another_kind_are_another_program(caches):
    def fun(key):
        return jax.random.normal(key, (3,))

    found = []
    for way in (True, False):
        with jax.threefry_partitionable(way):
            found.append(StoredProgram(fun, "draws")(jax.random.key(0)).tolist())
    assert found[0] != found[1] and len(_programs(caches)) == 2
