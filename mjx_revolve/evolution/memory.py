"""Whether a population fits into the memory that is free, before it is made."""

from __future__ import annotations

import math
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.genotypes.genotype import Genotype
from mjx_revolve.inputs.errors import InputError

# What an individual takes: so many copies of its genes, and so many numbers more (scores, ranks,
# measures), measured with SNES and CMA-ES at 400,000 individuals of 5 and 40 genes, rounded up.
_COPIES, _MORE = 8, 100
# Bytes for each pair of individuals; measured.
_PAIRS = {"DifferentialEvolution": 24}
# Random bodies that are weighed; they differ by a third. And more than any takes for a module
# [bytes]: some 1,500 were measured with the first two genotypes, 2,300 with the third. Choices.
_BODIES, _MODULE = 16, 16_000


def check_memory(config: Config, num_genes: int, genotype: Genotype | None = None) -> None:
    """Refuses a population that is larger than the free memory, as far as that can be told.

    An estimate, and a low one: some strategies take more, and say so when they begin.

    Args:
        config: of a run.
        num_genes: length of its genes.
        genotype: what bodies are grown from, where they evolve.

    Raises:
        InputError: it is too large; the message has the largest that fits.
    """
    free = free_memory()
    if free is None:
        return
    if config.bodies is not None:
        if genotype is not None:
            _check_bodies(config, num_genes, genotype, free)
        return
    size = config.evolution.population_size
    one = 4 * (_COPIES * num_genes + _MORE)
    pair = _PAIRS.get(config.evolution.strategy, 0)
    if size * one + size**2 * pair <= free:
        return
    most = int(2 * free / (one + math.sqrt(one**2 + 4 * pair * free)))
    raise _refuse(config, "evolution.population_size", most, free, size)


def _refuse(config: Config, place: str, most: int, free: int, found: int) -> InputError:
    return InputError(
        f"{config.source}: {place}: expected at most {most}, as {free / 1e9:.3g} GB of memory are "
        f"free; found {found}"
    )


def _check_bodies(config: Config, num_genes: int, genotype: Genotype, free: int) -> None:
    """The same of bodies: of parents and children at once, with the brains that these try."""
    bodies = config.bodies
    assert bodies is not None
    parents = config.evolution.population_size
    children = bodies.selection.offspring or parents
    tried = 4 * (_COPIES * num_genes + _MORE) * bodies.learning.population_size
    if (parents + children) * bodies.max_modules * _MODULE + children * tried <= free:
        return  # by far, as nearly always: nothing has to be weighed
    body = weigh_bodies(genotype)
    if parents * body + children * (body + tried) <= free:
        return
    if bodies.selection.offspring is None:
        most = free // (2 * body + tried)
        raise _refuse(config, "evolution.population_size", most, free, parents)
    if children >= parents:
        most = max(free - parents * body, 0) // (body + tried)
        raise _refuse(config, "bodies.selection.offspring", most, free, children)
    most = max(free - children * (body + tried), 0) // body
    raise _refuse(config, "evolution.population_size", most, free, parents)


def weigh_bodies(genotype: Genotype) -> int:
    """What a random body takes with its genome, the mean of a few [bytes]."""
    rng = np.random.default_rng(0)
    # What is made once is not to count.
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
