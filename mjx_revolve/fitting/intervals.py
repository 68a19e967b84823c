"""How sure fitted numbers are: intervals by profile likelihood (Venzon and Moolgavkar 1988).

With the noise's own correlation in time.
"""

from __future__ import annotations

from collections.abc import Generator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import t as student

from mjx_revolve.fitting.estimate import (
    FEW,
    FitState,
    Model,
    System,
    correlation,
    costs_of,
    fitted_by_kind,
    free_information,
    normal_equations,
    numbers_used,
    prior_matrix,
    reach,
    with_prior,
)
from mjx_revolve.fitting.problem import FitProblem, Point

LEVEL = 0.95
"""Of intervals."""
# An end is looked for at so many places at most, each time with so many steps of all other numbers,
# of which windows' beginnings take what share is best for each. Choices.
_PLACES, _STEPS, _SHARES = 6, 6, (1.0, 0.3, 0.1)
# An end is known to this share of its distance, and the others are at rest where a step would lower
# the cost, half a square of standard deviations, by less than this. Where it still would by so much
# after all steps, the profile cannot be followed. Choices.
_KNOWN, _AT_REST, _RESTLESS = 0.03, 0.05, 0.5

Values = list[np.ndarray]
"""Residuals of each channel, `[n, d]`."""


def _widened(
    problem: FitProblem, values: list[np.ndarray], noise: dict[str, float]
) -> dict[str, float]:
    """The noise, of kinds with few measurements at least what is left of them."""
    found = dict(noise)
    for kind, x in fitted_by_kind(problem, values).items():
        if 0 < len(x) < FEW:
            degrees = max(len(x) - len(problem.parameters), 1)
            found[kind] = max(noise[kind], float(np.sqrt(np.sum(x**2) / degrees)))
    return found


@dataclass(frozen=True)
class Estimate:
    """What a fit has found.

    Attributes:
        offsets: `[P]` of the free numbers from the priors' medians.
        ends: `[P, 2]` of their intervals, from the same medians.
        covariance: `[P, P]` of them.
        information: `[P, P]` what the data alone say, windows' and recordings' own numbers unknown.
        local: `[R, L]`, and
        local_spread: `[R, L]` their standard deviations.
        noise: standard deviations by kind.
        inflation: of variances, by correlation in time, by kind.
    """

    offsets: np.ndarray
    ends: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    local: np.ndarray
    local_spread: np.ndarray
    noise: dict[str, float]
    inflation: dict[str, float]


def estimate(problem: FitProblem, state: FitState, model: Model) -> Estimate:
    """Values and their covariance at the end of a search."""
    count = len(problem.parameters)
    inflation = correlation(problem, model.values)
    noise = state.noise
    if not state.inflated:  # a search that was cut short
        noise = {kind: sigma * np.sqrt(inflation[kind]) for kind, sigma in noise.items()}
    noise = _widened(problem, model.values, noise)
    system = normal_equations(problem, model, state.point, noise)
    covariance = np.linalg.inv(with_prior(problem, system))
    information = free_information(problem, system)
    rows = sum(
        np.isfinite(left[channel.fitted]).sum() / inflation[channel.kind]
        for channel, left in zip(problem.channels, model.values, strict=True)
    )
    # Few data say little of their own noise; the priors bound what that can do.
    degrees = max(float(rows) - numbers_used(problem, system), 4.0)
    quantile = float(student.ppf((1 + LEVEL) / 2, degrees))
    return Estimate(
        state.point.free,
        _Profile(problem, state.point, model, system, noise, quantile).find_ends(),
        covariance[:count, :count],
        (information + information.T) / 2,
        state.point.local,
        np.sqrt(np.diag(covariance)[count:]).reshape(state.point.local.shape),
        {kind: sigma / np.sqrt(inflation[kind]) for kind, sigma in noise.items()},
        inflation,
    )


@dataclass(frozen=True)
class _Profile:
    """The cost around a solution, least by all numbers but one.

    Attributes:
        problem: that was solved.
        best: its solution.
        model: the problem there.
        system: normal equations there.
        noise: standard deviations by kind, with correlation.
        quantile: standard deviations from a number to its end if all were linear.
    """

    problem: FitProblem
    best: Point
    model: Model
    system: System
    noise: dict[str, float]
    quantile: float

    def find_ends(self) -> np.ndarray:
        """`[P, 2]` ends of intervals, offsets: all of them are looked for at once, in lanes."""
        count = len(self.problem.parameters)
        searches = [self.find_end(k, side) for k in range(count) for side in (-1.0, 1.0)]
        wanted = {i: next(search) for i, search in enumerate(searches)}
        ends = np.zeros(len(searches))
        while wanted:
            points = [point for many in wanted.values() for point in many]
            values = iter(self.simulate(points))
            tried = {i: [next(values) for _ in many] for i, many in wanted.items()}
            wanted = {}
            for i, many in tried.items():
                try:
                    wanted[i] = searches[i].send(many)
                except StopIteration as stop:
                    ends[i] = stop.value
        return np.sort(ends.reshape(count, 2), 1)

    def simulate(self, points: Sequence[Point]) -> list[Values]:
        """Residuals at points."""
        problem, found = self.problem, []
        count, clock = len(problem.parameters), [n == "clock" for n in problem.local]
        room = problem.lanes - 1
        for first in range(0, len(points), room):
            some = points[first : first + room]
            # All of them are simulated with the commands at the best point's clock.
            left = problem.residuals(problem.simulate([self.best, *some]))
            left = [x[1:] for x in left]
            for i, point in enumerate(some):
                values = [x[i] for x in left]
                for c, channel in enumerate(problem.channels):
                    late = (point.local - self.best.local)[channel.recording] * clock
                    own = self.model.slopes[c][..., count : count + len(clock)]
                    values[c] = values[c] + np.where(late, own * late, 0.0).sum(-1)
                found.append(values)
        return found

    def find_end(self, k: int, side: float) -> Generator[list[Point], list[Values], float]:
        """Looks for where the cost has grown by quantile² / 2; yields points, is sent residuals.

        The end is bracketed and interpolated. At each place the others are brought to rest first,
        by Newton's steps with the derivatives at the best point.

        Returns:
            The end, an offset of number k.
        """
        problem, best, quantile = self.problem, self.best, self.quantile
        windows, rest = costs_of(problem, best, self.model.values, self.noise)
        least = float(windows.sum()) + rest
        covariance = np.linalg.inv(with_prior(problem, self.system))
        linear = quantile * float(np.sqrt(covariance[k, k]))
        still = self.system._replace(starts=[(*x[:4], 0 * x[4]) for x in self.system.starts])
        move = covariance[:, k] * side * linear / covariance[k, k]
        point = reach(problem, best, still, move)
        # Distances, and square roots of twice the cost there: of the farthest that is within the
        # interval, and of the nearest beyond.
        place, inside, outside = linear, (0.0, 0.0), None
        for _ in range(_PLACES):
            trials, lowest, foreseen = [point], np.inf, np.inf
            for _ in range(_STEPS):
                tried = yield trials
                moved, values, cost = self._pick(trials, tried)
                if cost < lowest:
                    lowest, point = cost, moved
                    trials, foreseen = self._step(k, point, values)
                else:
                    break
                if foreseen < _AT_REST:
                    break
            height = float(np.sqrt(2 * max(lowest - least, 0.0)))
            if height > quantile and foreseen > _RESTLESS:
                # No more than the linear end, or what was seen to be within, is known.
                return best.free[k] + side * max(inside[0], linear)
            if height < quantile:
                inside = place, height
            else:
                outside = place, height
            if outside is None:
                ahead = place * min(max(quantile / max(height, 0.1), 1.02), 2.0)
            else:
                (a, low), (b, high) = inside, outside
                ahead = a + (b - a) * (quantile - low) / (high - low)
            if abs(ahead - place) < _KNOWN * place:
                break
            if outside is not None:
                ahead = min(max(ahead, a + 0.2 * (b - a)), a + 0.9 * (b - a))
            far = ahead / place
            pairs = zip(vars(best).values(), vars(point).values(), strict=True)
            point = Point(*(x + far * (y - x) for x, y in pairs))
            place = ahead
        return best.free[k] + side * ahead

    def _pick(self, trials: list[Point], tried: list[Values]) -> tuple[Point, Values, float]:
        """Of points that differ in windows' beginnings the best, window by window."""
        problem = self.problem
        pairs = [costs_of(problem, p, x, self.noise) for p, x in zip(trials, tried, strict=True)]
        windows = np.stack([own for own, _ in pairs])
        which = windows.argmin(0)
        starts = np.stack([p.starts for p in trials])
        starts = np.take_along_axis(starts, which[None, :, None], 0)[0]
        values = []
        for c, channel in enumerate(problem.channels):
            own = which[problem.window_of(channel.recording, channel.time), channel.recording]
            values.append(np.stack([x[c] for x in tried])[own, np.arange(len(own))])
        cost = float(windows.min(0).sum()) + pairs[0][1]
        return replace(trials[0], starts=starts), values, cost

    def _step(self, k: int, point: Point, values: Values) -> tuple[list[Point], float]:
        """Newton's step of all but number k, with shares of the beginnings' and its gain."""
        count = len(self.problem.parameters)
        model = replace(self.model, values=values)
        now = normal_equations(self.problem, model, point, self.noise)
        matrix, slope = with_prior(self.problem, now), now.slope.copy()
        slope[:count] -= prior_matrix(self.problem) @ point.free
        move, others = np.zeros(len(slope)), np.arange(len(slope)) != k
        move[others] = np.linalg.solve(matrix[np.ix_(others, others)], slope[others])
        gain = float(slope @ move) / 2
        gain += sum(float(x[4] @ np.linalg.solve(x[2], x[4])) / 2 for x in now.starts)
        trials = [reach(self.problem, point, now, move, share=share) for share in _SHARES]
        return trials, gain
