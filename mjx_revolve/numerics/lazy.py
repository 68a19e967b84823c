"""JAX and MuJoCo, imported when something of them is first used: files are read without them.

    from mjx_revolve.numerics.lazy import jax, jnp

A configuration names laws of the water, whose files need JAX to compute but not to be listed.
"""

from __future__ import annotations

import importlib
import types
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    import jax as jax
    import jax.numpy as jnp
    import mujoco as mujoco
else:

    class _Module(types.ModuleType):
        """A module by name; what was asked of it once is an attribute of this."""

        def __getattr__(self, name: str) -> Any:
            value = getattr(importlib.import_module(self.__name__), name)
            setattr(self, name, value)
            return value

    jax, jnp, mujoco = _Module("jax"), _Module("jax.numpy"), _Module("mujoco")
