"""JAX and MuJoCo, imported on the first use of an attribute: files are read without them.

    from mjx_revolve.numerics.lazy import jax, jnp

A configuration names laws of the water; to list and check them takes no JAX, to compute them does.
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
        """A module by name; its attributes are looked up once and then kept here."""

        def __getattr__(self, name: str) -> Any:
            value = getattr(importlib.import_module(self.__name__), name)
            setattr(self, name, value)
            return value

    jax, jnp, mujoco = _Module("jax"), _Module("jax.numpy"), _Module("mujoco")
