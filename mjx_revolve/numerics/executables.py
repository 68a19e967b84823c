"""Compiled programs kept on disk under a fingerprint, so that a later process need not trace them.

JAX's compilation cache saves the compiler's time only: a look-up needs the traced and lowered
program, which takes seconds here. So commands and their workers also keep whole executables. The
fingerprint covers the values that the program was made of, our source, the packages, the CPU and
the arguments' shapes.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import pickle
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
from jax.experimental import serialize_executable
from jaxtyping import PyTree

from mjx_revolve.numerics import runtime
from mjx_revolve.numerics.xla import fuses, jit, on_cpu

# Programs that were not read for so long are removed [s].
_LIFE = 30 * 86_400
_log = logging.getLogger(__name__)


class StoredProgram:
    """`xla.jit` of a function with its executables kept beside JAX's compilation cache."""

    def __init__(self, fun: Callable[..., PyTree], made_of: object, fast: bool = False) -> None:
        """Compiles nothing yet.

        Args:
            fun: takes pytrees of arrays; returns tuples and dictionaries of arrays.
            made_of: all values besides the arguments that `fun` depends on, picklable; None if they
                are not all known: then nothing is kept.
            fast: as of `xla.jit`.
        """
        self._fun, self._jitted = fun, jit(fun, fast=fast)
        self._made_of = made_of, fast
        self._found: dict[Any, Any] = {}

    def __call__(self, *args: PyTree) -> PyTree:
        """Calls it."""
        return self._jitted(*args) if self._folder is None else self.load(*args)(*args)

    def precompile(self, *args: PyTree) -> None:
        """Compiles it for such arguments, or reads it; where nothing is kept, by calling it."""
        self(*args) if self._folder is None else self.load(*args)

    @property
    def _folder(self) -> Path | None:
        """Where its executables are kept; None: nowhere."""
        return runtime.program_folder() if self._made_of[0] is not None and on_cpu() else None

    def load(self, *args: PyTree) -> Callable[..., PyTree]:
        """What calls it with such arguments, compiled if need be, but not called yet."""
        args = jax.tree.map(jax.numpy.asarray, args)
        if (folder := self._folder) is None:
            return self._jitted.lower(*args).compile()
        leaves, tree = jax.tree.flatten((args, {}))
        shapes = tuple((x.shape, str(x.dtype), getattr(x, "weak_type", False)) for x in leaves)
        key = tree, shapes, _modes()
        if key not in self._found:
            path = folder / self._name(str(tree), shapes)
            self._found[key] = _load(path, tree) or self._compile(path, args)
        return self._found[key]

    def cache_size(self) -> int:
        """Number of executables, one for each signature of the arguments."""
        return len(self._found) + self._jitted._cache_size()

    def _name(self, *signature: object) -> str:
        host = runtime.host_key(), *_modes(), os.environ.get("XLA_FLAGS")
        return hashlib.sha256(pickle.dumps((self._made_of, signature, host))).hexdigest()[:32]

    def _compile(self, path: Path, args: PyTree) -> Any:
        with runtime.compile_lock("program", path.name):
            if (found := _load(path, jax.tree.structure((args, {})))) is not None:
                return found  # another process has compiled it meanwhile
            # XLA:CPU (jaxlib 0.10.2) writes programs that it has itself read from JAX's cache
            # without some of their functions. So that cache must not know it: by a name of its own.
            name = f"{self._fun.__name__}_{path.name[:8]}_{time.time_ns()}"

            def fun(*args: PyTree) -> PyTree:
                return self._fun(*args)

            fun.__name__ = name
            made = jit(fun, fast=self._made_of[1]).lower(*args).compile()
            _keep(path, made)
            for entry in path.parent.parent.glob(f"jit_{name}-*"):  # it is not read again
                with contextlib.suppress(OSError):
                    entry.unlink()
        return made


def _keep(path: Path, made: Any) -> None:
    """Writes a program; if that fails, later processes start slower, with the same results."""
    beside = path.with_name(f"{path.name}.{os.getpid()}")
    try:
        payload, _, out_tree = serialize_executable.serialize(made)
        content = pickle.dumps((payload, out_tree))
        path.parent.mkdir(exist_ok=True)
        beside.write_bytes(hashlib.sha256(content).digest() + content)
        beside.replace(path)
        for old in path.parent.iterdir():
            if time.time() - old.stat().st_mtime > _LIFE:
                old.unlink()
    except (OSError, ValueError, RuntimeError) as error:
        _log.debug("a program is not kept: %s", error)
    finally:
        with contextlib.suppress(OSError):
            beside.unlink(missing_ok=True)


def _modes() -> tuple[str, bool]:
    """What may change within a process, and a program with it."""
    return str(runtime.unusual_modes()), fuses()


def _load(path: Path, tree: PyTree) -> Any:
    """The program of a file; None if it is missing or damaged."""
    try:
        data = path.read_bytes()
    except OSError:
        return None
    content = data[32:]
    if hashlib.sha256(content).digest() != data[:32]:  # half written
        return None
    try:
        payload, out_tree = pickle.loads(content)
        with contextlib.suppress(OSError):  # a folder of another user
            os.utime(path)
        return serialize_executable.deserialize_and_load(payload, tree, out_tree)
    except Exception as error:  # made on another machine or by another version
        _log.debug("a kept program is not used: %s", error)
        return None
