"""Massively parallel evolution of modular robots under water, in JAX and MuJoCo MJX.

The names below are what users rely on; each is imported when it is first used, so that importing
the package, or starting one of its command lines, loads neither JAX nor MuJoCo.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from mjx_revolve.inputs.early import watch_imports

watch_imports()  # first of all: the rest takes time

__version__ = "0.1.0"

_WHERE = {
    "InputError": "inputs.errors",
    "load_config": "episodes.config",
    "load_modules": "body.catalogue",
    "MODULES": "body.catalogue",
    "THESIS_MODULES": "body.catalogue",
    "load_morphology": "body.morphology",
    "make_morphology": "body.morphology",
    "save_morphology": "body.morphology",
    "trim_neutral": "body.morphology",
    "add_module": "body.edits",
    "exchange_subtrees": "body.edits",
    "free_slots": "body.edits",
    "graft_subtree": "body.edits",
    "remove_module": "body.edits",
    "replace_module": "body.edits",
    "swap_subtrees": "body.edits",
    "turn_module": "body.edits",
    "load_world": "water.world",
    "make_world": "water.world",
    "build_robot": "engine.robot",
    "export_mjcf": "engine.robot",
    "make_cpg": "control.cpg",
    "make_sine": "control.sine",
    "bind_genes": "control.controller",
    "simulate": "episodes.simulate",
    "make_fitness": "episodes.fitness",
    "make_mixed_fitness": "episodes.fitness",
    "make_vector_env": "episodes.vector_env",
    "load_archive": "evolution.runs",
    "prepare_process": "numerics.runtime",
}

__all__ = ["__version__", *sorted(_WHERE)]

if TYPE_CHECKING:
    from mjx_revolve.body.catalogue import MODULES as MODULES
    from mjx_revolve.body.catalogue import THESIS_MODULES as THESIS_MODULES
    from mjx_revolve.body.catalogue import load_modules as load_modules
    from mjx_revolve.body.edits import add_module as add_module
    from mjx_revolve.body.edits import exchange_subtrees as exchange_subtrees
    from mjx_revolve.body.edits import free_slots as free_slots
    from mjx_revolve.body.edits import graft_subtree as graft_subtree
    from mjx_revolve.body.edits import remove_module as remove_module
    from mjx_revolve.body.edits import replace_module as replace_module
    from mjx_revolve.body.edits import swap_subtrees as swap_subtrees
    from mjx_revolve.body.edits import turn_module as turn_module
    from mjx_revolve.body.morphology import load_morphology as load_morphology
    from mjx_revolve.body.morphology import make_morphology as make_morphology
    from mjx_revolve.body.morphology import save_morphology as save_morphology
    from mjx_revolve.body.morphology import trim_neutral as trim_neutral
    from mjx_revolve.control.controller import bind_genes as bind_genes
    from mjx_revolve.control.cpg import make_cpg as make_cpg
    from mjx_revolve.control.sine import make_sine as make_sine
    from mjx_revolve.engine.robot import build_robot as build_robot
    from mjx_revolve.engine.robot import export_mjcf as export_mjcf
    from mjx_revolve.episodes.config import load_config as load_config
    from mjx_revolve.episodes.fitness import make_fitness as make_fitness
    from mjx_revolve.episodes.fitness import make_mixed_fitness as make_mixed_fitness
    from mjx_revolve.episodes.simulate import simulate as simulate
    from mjx_revolve.episodes.vector_env import make_vector_env as make_vector_env
    from mjx_revolve.evolution.runs import load_archive as load_archive
    from mjx_revolve.inputs.errors import InputError as InputError
    from mjx_revolve.numerics.runtime import prepare_process as prepare_process
    from mjx_revolve.water.world import load_world as load_world
    from mjx_revolve.water.world import make_world as make_world


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(importlib.import_module(f"{__name__}.{_WHERE[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *_WHERE})
