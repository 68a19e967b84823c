"""Names of evosax's strategies, known before evosax is imported, which takes seconds."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING

from mjx_revolve.inputs.errors import InputError

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config

# All of evosax 0.3 but SV_CMA_ES and SV_Open_ES: they evolve several populations side by side,
# which is another loop.
STRATEGY_NAMES = (
    "ARS", "ASEBO", "CMAAnchoredLES", "CMA_ES", "CR_FM_NES", "DES", "ESMC", "EvoTF_ES",
    "GradientlessDescent", "GuidedES", "HillClimbing", "iAMaLGaM_Full", "iAMaLGaM_Univariate",
    "LES", "LM_MA_ES", "MA_ES", "NoiseReuseES", "Open_ES", "PersistentES", "PGPE", "RandomSearch",
    "Rm_ES", "Sep_CMA_ES", "SimulatedAnnealing", "SimpleES", "SNES", "xNES",
    "DifferentialEvolution", "DiffusionEvolution", "GESMR_GA", "LGA", "MR15_GA", "PSO", "SAMR_GA",
    "SimpleGA",
)  # fmt: skip
# Common names, beside evosax's. Case, `-` and `_` do not matter.
_OTHER_NAMES = {
    "de": "DifferentialEvolution",
    "ga": "SimpleGA",
    "pepg": "PGPE",
    "discoveredes": "DES",
    "learnedes": "LES",
    "learnedga": "LGA",
}


def _plain(name: str) -> str:
    return name.replace("_", "").replace("-", "").replace(" ", "").lower()


def find_strategy(name: str, place: str = "evolution.strategy") -> str:
    """Finds a strategy's evosax name.

    Args:
        name: given by the user; case, `-` and `_` do not matter, and `DE` is an alias.
        place: of the name, for messages.

    Returns:
        One of `STRATEGY_NAMES`.

    Raises:
        InputError: there is no such strategy.
    """
    known = {_plain(known): known for known in STRATEGY_NAMES} | _OTHER_NAMES
    if _plain(name) in known:
        return known[_plain(name)]
    near = difflib.get_close_matches(_plain(name), known, n=1, cutoff=0.5)
    hint = f"; did you mean {known[near[0]]}?" if near else ""
    raise InputError(place, f"one of {', '.join(STRATEGY_NAMES)}", f"{name!r}{hint}")


def check_strategies(config: Config) -> None:
    """Refuses the name of a strategy that there is not; raises InputError."""
    if config.bodies is None:
        find_strategy(config.evolution.strategy)
    else:
        find_strategy(config.bodies.learning.strategy, "bodies.learning.strategy")
