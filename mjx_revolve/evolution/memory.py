"""The check that a population fits into the memory that is free, before it is made."""

from __future__ import annotations

import bisect
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.genotypes.genotype import Genotype
from mjx_revolve.inputs.errors import InputError

# Memory of an individual: so many copies of its genes, and so many numbers more (scores, ranks,
# measures), measured with SNES and CMA-ES at 400,000 individuals of 5 and 40 genes, rounded up.
_COPIES, _MORE = 8, 100
# Bytes for each pair of individuals; measured.
_PAIRS = {"DifferentialEvolution": 24}
# Random bodies that are measured; they differ by a third. And more than any takes for a module
# [bytes]: some 1,500 were measured with the first two genotypes, 2,300 with the third. Choices.
_BODIES, _MODULE = 16, 16_000


def check_memory(config: Config, num_genes: int, genotype: Genotype | None = None) -> None:
    """Refuses a population that is larger than the free memory, by a low estimate.

    Some strategies take more, and raise when they begin.

    Args:
        config: of a run.
        num_genes: length of its genes.
        genotype: of bodies, where they evolve.

    Raises:
        InputError: it is too large; the message has the largest that fits.
    """
    free = free_memory()
    evolution, bodies = config.evolution, config.bodies
    if free is None or (bodies is not None and genotype is None):
        return
    parents = evolution.population_size
    one = 4 * (_COPIES * num_genes + _MORE)
    if bodies is None or genotype is None:
        pair = _PAIRS.get(evolution.strategy, 0)
        _check(config, "evolution.population_size", parents, lambda n: n * one + n**2 * pair, free)
        return
    # Parents and children at once, with the brains that these try.
    children = bodies.selection.offspring or parents
    tried = one * bodies.learning.population_size
    if (parents + children) * bodies.max_modules * _MODULE + children * tried <= free:
        return  # by far, as nearly always: no body has to be made
    body = weigh_bodies(genotype)

    def need(parents: int, children: int) -> int:
        return parents * body + children * (body + tried)

    place = "evolution.population_size"
    if bodies.selection.offspring is None:
        _check(config, place, parents, lambda n: need(n, n), free)
    elif children < parents:
        _check(config, place, parents, lambda n: need(n, children), free)
    else:
        place = "bodies.selection.offspring"
        _check(config, place, children, lambda n: need(parents, n), free)


def _check(config: Config, place: str, found: int, need: Callable[[int], int], free: int) -> None:
    """Refuses a number of individuals that take more than the free memory [bytes]."""
    if need(found) > free:
        most = max(0, bisect.bisect_right(range(found), free, key=need) - 1)
        raise InputError(
            f"{config.origin(place)}{place}: expected at most {most}, as {free / 1e9:.3g} GB of "
            f"memory are free; found {found}"
        )


def weigh_bodies(genotype: Genotype) -> int:
    """The memory of a random body with its genome, the mean of a few [bytes]."""
    rng = np.random.default_rng(0)
    # Objects that are made only once do not count.
    kept: list[Any] = [genotype.develop(genotype.random(rng)).descriptors]
    ours = not tracemalloc.is_tracing()
    if ours:
        tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        for _ in range(_BODIES):
            genome = genotype.random(rng)
            body = genotype.develop(genome)
            kept.append((genome, body, body.descriptors))
        return max(1, (tracemalloc.get_traced_memory()[0] - before) // _BODIES)
    finally:
        if ours:
            tracemalloc.stop()


def free_memory(root: Path = Path("/")) -> int | None:
    """The memory that this machine, or the container's limit, leaves [bytes].

    Args:
        root: where the system's files are.

    Returns:
        The smaller one; None where neither is known.
    """
    found = []
    try:
        for line in (root / "proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024 * int(line.split()[1]))
    except (OSError, ValueError):
        pass
    try:
        limit, used = (
            int((root / "sys/fs/cgroup" / name).read_text(encoding="ascii"))
            for name in ("memory.max", "memory.current")
        )
        found.append(max(0, limit - used))
    except (OSError, ValueError):  # no container, or one without a limit ("max")
        pass
    return min(found, default=None)
