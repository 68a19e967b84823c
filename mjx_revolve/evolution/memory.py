"""Whether a population of genes fits into the memory that is free, before it is made."""

from __future__ import annotations

import math
from pathlib import Path

from mjx_revolve.episodes.config import Config
from mjx_revolve.inputs.errors import InputError

# What an individual takes: so many copies of its genes, and so many numbers more (scores, ranks,
# measures), measured with SNES and CMA-ES at 400,000 individuals of 5 and 40 genes, rounded up.
_COPIES, _MORE = 8, 100
# Bytes for each pair of individuals; measured.
_PAIRS = {"DifferentialEvolution": 24}


def check_memory(config: Config, num_genes: int) -> None:
    """Refuses a population that is larger than the free memory, as far as that can be told.

    An estimate, and a low one: some strategies take more, and say so when they begin.

    Args:
        config: of a run.
        num_genes: length of its genes.

    Raises:
        InputError: it is too large; the message has the largest that fits.
    """
    free = free_memory()
    if free is None or config.bodies is not None:
        return
    size = config.evolution.population_size
    one = 4 * (_COPIES * num_genes + _MORE)
    pair = _PAIRS.get(config.evolution.strategy, 0)
    if size * one + size**2 * pair <= free:
        return
    most = int(2 * free / (one + math.sqrt(one**2 + 4 * pair * free)))
    raise InputError(
        f"{config.source}: evolution.population_size: expected at most {most}, as "
        f"{free / 1e9:.3g} GB of memory are free; found {size}"
    )


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
