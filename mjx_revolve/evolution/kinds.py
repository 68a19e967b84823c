"""The kind of search of a configuration."""

from __future__ import annotations

from mjx_revolve.episodes.config import Config
from mjx_revolve.evolution.coevolution import BodyEvolution
from mjx_revolve.evolution.colony_search import ColonyEvolution
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.gene_search import GeneEvolution
from mjx_revolve.evolution.generations import Evolution


def make_evolution(config: Config, executor: Executor) -> Evolution:
    """The search over genes, the search over bodies, or the colony of a configuration.

    Raises:
        InputError: a strategy, a selection or a name of a feature is wrong.
    """
    if config.colony is not None:
        return ColonyEvolution(config, executor)
    if config.bodies is not None:
        return BodyEvolution(config, executor)
    return GeneEvolution(config.evolution, executor)
