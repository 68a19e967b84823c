"""The check that a population fits into the memory that is free, before it is made."""

from __future__ import annotations

import bisect
import contextlib
from pathlib import Path

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.strategy_names import find_strategy
from mjx_revolve.inputs.errors import InputError

# Memory of an individual: so many copies of its genes, and so many numbers more (scores, ranks,
# measures), measured with SNES and CMA-ES at 400,000 individuals of 5 and 40 genes, rounded up.
_COPIES, _MORE = 8, 100
# Bytes for each pair of individuals; measured.
_PAIRS = {"DifferentialEvolution": 24}
# Bytes of a small body with its genome; measured, rounded down.
_BODY = 2_000
# The smallest population of bodies that a user may ask for.
_FEWEST = 4


def check_memory(config: Config, num_genes: int) -> None:
    """Refuses a population that is larger than the free memory, by a low estimate.

    Some strategies and genotypes take more, and raise when they begin.

    Args:
        config: of a run.
        num_genes: length of its genes.

    Raises:
        InputError: it is too large; the message has the largest that fits.
    """
    free, evolution, bodies = free_memory(), config.evolution, config.bodies
    one = 4 * (_COPIES * num_genes + _MORE)
    counts, pair = {"evolution.population_size": evolution.population_size}, 0
    if bodies is None:
        pair = _PAIRS.get(find_strategy(evolution.strategy), 0)
    else:
        learners, place = bodies.learning.population_size, "bodies.learning.population_size"
        if free is not None and _FEWEST * (_BODY + one * learners) > free:
            most = max(0, int((free / _FEWEST - _BODY) / one))
            raise _too_large(config, place, most, free, learners)
        one = _BODY + one * learners
        counts["bodies.selection.offspring"] = bodies.selection.offspring or 0
    for place, found in counts.items():

        def need(count: int) -> int:
            return count * one + count**2 * pair

        if free is not None and need(found) > free:
            most = max(0, bisect.bisect_right(range(found), free, key=need) - 1)
            raise _too_large(config, place, most, free, found)


def _too_large(config: Config, place: str, most: int, free: int, found: int) -> InputError:
    fits = f"at most {most}, as {free / 1e9:.3g} GB of memory are free"
    return InputError(f"{config.origin(place)}{place}", fits, found)


def free_memory(root: Path = Path("/")) -> int | None:
    """The memory that this machine, or the container's limit, leaves [bytes].

    Args:
        root: where the system's files are.

    Returns:
        The smaller one; None where neither is known.
    """
    found = []
    with contextlib.suppress(OSError, ValueError):
        for line in (root / "proc/meminfo").read_text(encoding="ascii").splitlines():
            if line.startswith("MemAvailable:"):
                found.append(1024 * int(line.split()[1]))
    with contextlib.suppress(OSError, ValueError):  # no container, or one without a limit ("max")
        group = root / "sys/fs/cgroup"
        files = group / "memory.max", group / "memory.current"
        limit, used = (int(file.read_text(encoding="ascii")) for file in files)
        cache = 0  # of files, which the kernel gives back
        with contextlib.suppress(OSError, ValueError):
            for line in (group / "memory.stat").read_text(encoding="ascii").splitlines():
                name, count = line.split()
                cache += int(count) if name in ("inactive_file", "active_file") else 0
        found.append(max(0, limit - used + cache))
    return min(found, default=None)
