"""The common part of co-evolution and colony: columns and lines about the living, the champion."""

from __future__ import annotations

import json
from collections.abc import Sequence
from typing import Any, Protocol

import jax
import numpy as np

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.passport import KEPT, LONG, STEP, Passport, joint_checks, make_passport
from mjx_revolve.episodes.scoring import replay_key
from mjx_revolve.evolution.blocks import Scored, join
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.generations import Champion, SearchState, choose_candidate
from mjx_revolve.evolution.individuals import Individual, best_individuals
from mjx_revolve.evolution.learning import learnt_genes, score_brains
from mjx_revolve.inputs.errors import InputError

# Descriptors with their population mean in the metrics.
MEAN_DESCRIPTORS = ("num_modules", "num_hinges", "length", "mass", "branching", "limbs", "symmetry")

# Number of candidates where a passport is required. A choice: all of most populations.
_CANDIDATES = 64


class IndividualSearch(SearchState, Protocol):
    """State of a search over individuals."""

    @property
    def elites(self) -> tuple[Individual, ...]:
        """The best of all generations, best first."""

    @property
    def living(self) -> tuple[Individual, ...]:
        """Individuals that are alive."""


class IndividualEvolution:
    """A search; its state has `elites` and `living`, both individuals."""

    def __init__(self, config: Config, executor: Executor) -> None:
        """Prepares a search with an executor over a `BodyFitness`."""
        self.config, self.executor = config, executor
        self.fitness: BodyFitness = executor.fitness

    def best(self, search: IndividualSearch) -> Champion | None:
        """The first elite; in a colony without any, the fittest of the living."""
        elites = _elites(search)
        return self._champion(elites[0], score=elites[0].score) if elites else None

    def choose_champion(self, search: IndividualSearch) -> Champion:
        """The best candidate on fresh starts, each alone at the configuration's task.

        Raises:
            InputError: there is none: every individual failed.
        """
        required = self.fitness.bodies.selection.passport == "required"
        candidates = list_candidates(search, required)
        if not candidates:
            raise InputError("champion", "an individual with a score", "none: all failed")

        def score(indices: Sequence[int], key: jax.Array) -> Scored:
            chosen = [candidates[k] for k in indices]
            genes = [learnt_genes(self.fitness, one) for one in chosen]
            return join(score_brains(self.executor, chosen, genes, key))

        seed = self.config.evolution.seed

        def judge(k: int) -> Passport:
            one = candidates[k]
            return make_passport(self.fitness.body_fitness(one.body), one.genes, seed)

        def screen(indices: Sequence[int]) -> list[int]:
            """1 where joints do in one episode what servos can, 1 more for each score that holds.

            At half the step, and over a long time in other water: populations come to fit their
            step and what is foretold of them together. A program for all is sooner done than a
            passport of each.
            """
            robots = [self.fitness.build(candidates[k].body) for k in indices]
            genes = [np.array(candidates[k].genes, np.float32) for k in indices]
            key = replay_key(seed)
            swum = self.fitness.mixed.replay(robots, genes, key)
            settle = self.config.task.settle
            sound = [
                all(check.passed for _, check in joint_checks(robot, trajectory, settle))
                for robot, trajectory in zip(robots, swum, strict=True)
            ]
            bodies = [candidates[k].body for k in indices]
            chances = 1 + (self.fitness.step_changes(bodies, genes, key) <= STEP).astype(int)
            if self.fitness.mixed.task.unit.endswith("/s") and self.config.task.duration < LONG:
                chances += self.fitness.kept_shares(bodies, genes, key, LONG) >= KEPT
            return [int(a) * int(b) for a, b in zip(sound, chances, strict=True)]

        winner, judged = choose_candidate(
            score, np.ones(len(candidates), bool), seed, judge if required else None, screen
        )
        return self._champion(candidates[winner], **judged)

    def _champion(self, one: Individual, **judged: Any) -> Champion:
        origin = f"individual {one.number} of {self.config.unit} {one.born}, {one.origin}"
        genes = np.array(one.genes, np.float32)
        return Champion(genes=genes, origin=origin, body=one.body, individual=one.number, **judged)


def _elites(search: IndividualSearch) -> tuple[Individual, ...]:
    return search.elites or best_individuals(search.living)


def list_candidates(search: IndividualSearch, required: bool) -> tuple[Individual, ...]:
    """The individuals of which the champion is chosen.

    Where coefficients are drawn anew in each generation, the best of all generations are those that
    theirs favoured, and fail together. So where a passport is required the living compete, too.

    Args:
        search: its state.
        required: whether a passport is.

    Returns:
        The elites, best first; then, where it is, the best of the other living ones.
    """
    elites = _elites(search)
    if not required:
        return elites
    known = {one.number for one in elites}
    others = (one for one in search.living if one.number not in known)
    return elites + best_individuals(others, _CANDIDATES - len(elites))


def finite_mean(values: Sequence[float] | np.ndarray) -> float:
    """The mean of the values that are not NaN; NaN where none is finite."""
    found = np.asarray(values, float)
    return float(np.nanmean(found)) if np.isfinite(found).any() else float("nan")


def mean_descriptors(living: Sequence[Individual]) -> dict[str, float]:
    """Columns of a row: means of `MEAN_DESCRIPTORS` over the population."""
    values = {name: [one.feature(name) for one in living] for name in MEAN_DESCRIPTORS}
    return {f"mean_{name}": finite_mean(found) for name, found in values.items()}


def living_line(search: IndividualSearch) -> str:
    """A line of JSON: the numbers of the individuals that are alive after a generation."""
    numbers = [individual.number for individual in search.living]
    return json.dumps({"generation": search.generation, "living": numbers}, separators=(",", ":"))
