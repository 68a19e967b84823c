"""The search for coefficients: Levenberg-Marquardt, priors, Fisher's matrix.

Residuals are weighted by the noise that is estimated on the way; single wild frames count less
(Huber 1964). Windows' beginnings are eliminated one by one (Schur complements), so that cost grows
with the length of a recording and not with its cube.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from mjx_revolve.fitting.problem import NOISE, START, FitProblem, Point
from mjx_revolve.numerics.spatial import quat_mul

# Residuals of more than so many standard deviations count less (Huber's 1.345 for pure noise costs
# 5 % of the information; frames that a tracker lost lie far beyond 3). A choice.
_HUBER = 3.0
# The search ends when a step is below this share of each number's own uncertainty [-].
_TOLERANCE = 0.02
# Derivatives are over fine steps from where a step is below this share of it, one standard
# deviation: from there on they are of what lies within the interval.
_NEAR = 1.0
FEW = 30
"""With fewer measurements of a kind, their noise is what is usual: a wrong model would else pass
for noise; intervals are widened by what is left (Birge 1932). A choice."""
# Clocks at which a search begins: two of the prior's standard deviations to both sides [s].
_CLOCKS = (0.0, -0.1, -0.05, 0.05, 0.1)
_LEAST_NOISE = 0.02  # of `NOISE`: no recording is better, and what was simulated has none at all
# In shorter windows correlation of neighbours may be chance. A choice [frames].
_FEWEST_ROWS = 12.0
# With short windows the search need not arrive, and makes so many steps at most. Choices.
_SHORT_STEPS, _SHORT_TOLERANCE = 20, 0.1
# A window is cut in two where, two standard deviations of some number away, its motion differs from
# a linear one by so much of the cost, half a square of standard deviations. A choice: from there a
# step or two of Newton's lead back to the least cost, and from beyond, they may lead anywhere.
_BENT, _AWAY = 20.0, 2.0
# The search goes on from a place nearby, one or two standard deviations of some number away, where
# the cost is so much lower: derivatives do not see beyond a jump of the motion. A choice.
_LOWER = 0.5
_LARGEST_STEP = 1.0  # in a logarithm, or in units of the prior


class System(NamedTuple):
    """Normal equations of P free numbers and G = P + R L common ones, windows eliminated.

    Attributes:
        matrix: `[G, G]` Fisher's information with the priors of all but the P free numbers.
        slope: `[G]` minus the gradient.
        starts: (window, recording, matrix `[12, 12]`, coupling `[12, G]`, slope `[12]`) of each.
    """

    matrix: np.ndarray
    slope: np.ndarray
    starts: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]]


@dataclass(frozen=True)
class FitState:
    """The search between two steps.

    Attributes:
        point: where it is.
        noise: standard deviations by kind of channel, with their correlation.
        damping: `[K, R]` Marquardt's, of each window's beginning, and
        common: of all else.
        iteration: steps done.
        cost: at the point, with this noise.
        moved: the last step over what the numbers are uncertain by.
        inflated: whether the residuals' correlation counts by now: only near the end is it that of
            noise and of the model, and not of a wrong point.
        steps: `[P]` of the differences by which derivatives are found; None while they are the
            widest ones.
    """

    point: Point
    noise: dict[str, float]
    damping: np.ndarray
    common: float = 0.0
    iteration: int = 0
    cost: float = np.inf
    moved: float = np.inf
    inflated: bool = False
    steps: np.ndarray | None = None

    @property
    def finished(self) -> bool:
        """Whether it has arrived."""
        return self.inflated and self.moved < _TOLERANCE


@dataclass(frozen=True)
class Model:
    """A problem linearised at a point.

    Attributes:
        values: `[n, d]` residuals of each channel.
        slopes: `[n, d, P + L + 12]` their derivatives.
        track: `[R, K, records, 13 + hinges]`.
    """

    values: list[np.ndarray]
    slopes: list[np.ndarray] = field(repr=False)
    track: np.ndarray = field(repr=False)


def linearize(problem: FitProblem, point: Point, steps: np.ndarray | None = None) -> Model:
    """The problem near a point; `steps`: of a state."""
    return Model(*problem.linearize(point, steps))


def costs_of(
    problem: FitProblem, point: Point, values: list[np.ndarray], noise: dict[str, float]
) -> tuple[np.ndarray, float]:
    """Half the sums of squares, wild ones less: `[K, R]` of windows, and of the priors."""
    begun = problem.drive.resets[:, None]
    cost = (np.where(begun, point.starts / problem.start_spread, 0.0) ** 2).sum(1) / 2
    for channel, left in zip(problem.channels, values, strict=True):
        z = np.abs(left / noise[channel.kind])
        z = np.where(np.isfinite(left), np.minimum(z, 1e9), 0.0)
        z = np.where(z < _HUBER, z**2 / 2, _HUBER * (z - _HUBER / 2)).sum(1) * channel.fitted
        where = problem.window_of(channel.recording, channel.time)
        cost[:, channel.recording] += np.bincount(where, z, len(cost))
    spread = np.array([p.spread for p in problem.parameters])
    prior = float(((point.free / spread) ** 2).sum()) / 2
    return cost, prior + float(((point.local / problem.local_spread) ** 2).sum()) / 2


def normal_equations(
    problem: FitProblem, model: Model, point: Point, noise: dict[str, float]
) -> System:
    """Fisher's information of what is fitted, and the gradient."""
    count, own, recordings = len(problem.parameters), len(problem.local), len(problem.recordings)
    total = count + own * recordings
    matrix, slope = np.zeros((total, total)), np.zeros(total)
    blocks: dict[tuple[int, int], list[np.ndarray]] = {}
    for k, r in zip(*np.nonzero(problem.drive.resets), strict=True):
        prior = np.diag(problem.start_spread[k, :, r] ** -2.0)
        pull = -point.starts[k, :, r] * problem.start_spread[k, :, r] ** -2.0
        blocks[int(k), int(r)] = [prior, np.zeros((START, total)), pull]
    for channel, left, slopes in zip(problem.channels, model.values, model.slopes, strict=True):
        r, sigma = channel.recording, noise[channel.kind]
        columns = [*range(count), *range(count + r * own, count + (r + 1) * own)]
        where = problem.window_of(r, channel.time)
        for k in np.unique(where[channel.fitted]):
            rows = channel.fitted & (where == k)
            value = left[rows].ravel()
            slant = slopes[rows].reshape(len(value), -1)
            known = np.isfinite(value) & np.isfinite(slant).all(1)
            z, j = value[known] / sigma, slant[known] / sigma
            weight = np.minimum(1.0, _HUBER / np.maximum(np.abs(z), 1e-9))
            common, start = j[:, : count + own], j[:, count + own :]
            matrix[np.ix_(columns, columns)] += (weight[:, None] * common).T @ common
            slope[columns] -= (weight * z) @ common
            block = blocks[int(k), r]
            block[0] = block[0] + (weight[:, None] * start).T @ start
            block[1][:, columns] += (weight[:, None] * start).T @ common
            block[2] = block[2] - (weight * z) @ start
    for r in range(recordings):
        rows = np.arange(count + r * own, count + (r + 1) * own)
        matrix[rows, rows] += problem.local_spread**-2.0
        slope[rows] -= point.local[r] * problem.local_spread**-2.0
    starts = []
    for (k, r), (own_block, coupling, gradient) in blocks.items():
        solved = np.linalg.solve(own_block, np.column_stack([coupling, gradient]))
        matrix -= coupling.T @ solved[:, :-1]
        slope -= coupling.T @ solved[:, -1]
        starts.append((k, r, own_block, coupling, gradient))
    return System((matrix + matrix.T) / 2, slope, starts)


def prior_matrix(problem: FitProblem) -> np.ndarray:
    """`[P, P]` information of the priors of the free numbers."""
    return np.diag([p.spread**-2.0 for p in problem.parameters])


def with_prior(problem: FitProblem, system: System) -> np.ndarray:
    """`[G, G]` information with all priors."""
    matrix, count = system.matrix.copy(), len(problem.parameters)
    matrix[:count, :count] += prior_matrix(problem)
    return matrix


def _spreads(problem: FitProblem, system: System) -> np.ndarray:
    """`[P]` what the free numbers are uncertain by."""
    covariance = np.linalg.inv(with_prior(problem, system))
    return np.sqrt(np.diag(covariance)[: len(problem.parameters)])


def step(problem: FitProblem, state: FitState, system: System) -> tuple[Point, float]:
    """A damped step, and how far it leads over what the numbers are uncertain by."""
    count, point = len(problem.parameters), state.point
    matrix, slope = with_prior(problem, system), system.slope.copy()
    slope[:count] -= prior_matrix(problem) @ point.free
    spread = np.sqrt(np.diag(np.linalg.inv(matrix)))
    damped = matrix + state.common * np.diag(np.diag(matrix))
    move = np.linalg.solve(damped, slope)
    limit = max(1.0, float(np.abs(move[:count]).max(initial=0.0)) / _LARGEST_STEP)
    move = move / limit
    reached = reach(problem, point, system, move, state.damping)
    return reached, float(np.abs(move / spread)[:count].max(initial=0.0))


def free_information(problem: FitProblem, system: System) -> np.ndarray:
    """`[P, P]` what the data say of the free numbers, the other common ones unknown."""
    count, matrix = len(problem.parameters), system.matrix
    across, rest = matrix[:count, count:], matrix[count:, count:]
    return matrix[:count, :count] - across @ np.linalg.solve(rest, across.T)


def reach(
    problem: FitProblem, point: Point, system: System, move: np.ndarray,
    damping: np.ndarray | None = None, share: float = 1.0,
) -> Point:  # fmt: skip
    """Where a `[G]` move of the common numbers leads, and a share of the windows' beginnings'."""
    count = len(problem.parameters)
    damping = np.zeros(problem.drive.resets.shape) if damping is None else damping
    free = np.array(
        [p.bound(x) for p, x in zip(problem.parameters, point.free + move[:count], strict=True)]
    )
    starts = point.starts.copy()
    for k, r, block, coupling, pull in system.starts:
        own = block + damping[k, r] * np.diag(np.diag(block))
        starts[k, :, r] += share * np.linalg.solve(own, pull - coupling @ move)
    local = point.local + move[count:].reshape(point.local.shape)
    return Point(free, local, starts)


def fitted_by_kind(problem: FitProblem, values: list[np.ndarray]) -> dict[str, np.ndarray]:
    """Residuals of all that is fitted, by kind, in a row each."""
    rows: dict[str, list[np.ndarray]] = {}
    for channel, left in zip(problem.channels, values, strict=True):
        x = left[channel.fitted]
        rows.setdefault(channel.kind, []).append(x[np.isfinite(x)])
    return {kind: np.concatenate(many) for kind, many in rows.items()}


def estimate_noise(problem: FitProblem, values: list[np.ndarray], used: float) -> dict[str, float]:
    """Standard deviations by kind, robust against wild frames; `used`: numbers fitted."""
    rows = fitted_by_kind(problem, values)
    share = max(1 - used / max(sum(map(len, rows.values())), 1), 0.1)
    found = {}
    for kind, x in rows.items():
        sigma = NOISE[kind]
        if len(x) >= FEW:
            # Clipped where Huber's weights begin, again and again.
            sigma = float(np.sqrt(np.mean(x**2)))
            for _ in range(8):
                sigma = float(np.sqrt(np.mean(np.minimum(x**2, (_HUBER * sigma) ** 2))))
            sigma /= float(np.sqrt(share))
        found[kind] = max(sigma, _LEAST_NOISE * NOISE[kind])
    return found


def numbers_used(problem: FitProblem, system: System) -> float:
    """How many numbers the data have determined: the trace of information over information."""
    count = len(problem.parameters)
    whole = with_prior(problem, system)
    used = float(np.trace(np.linalg.solve(whole[:count, :count], system.matrix[:count, :count])))
    for k, r, block, _, _ in system.starts:
        spread = problem.start_spread[k, :, r]
        used += START - float(np.trace(np.linalg.inv(block) @ np.diag(spread**-2.0)))
    return used


def correlation(problem: FitProblem, values: list[np.ndarray]) -> dict[str, float]:
    """By how much the residuals' correlation inflates variances, by kind.

    In time by (1 + ρ) / (1 - ρ) of neighbouring frames; within a frame, as of marks that a wrong
    turn moves together, by how many fewer independent numbers it has than noise would.
    """
    lagged: dict[str, list[tuple[float, float, float]]] = {}
    crowded: dict[str, list[tuple[float, int]]] = {}
    for channel, left in zip(problem.channels, values, strict=True):
        where = problem.window_of(channel.recording, channel.time)
        whole = left[channel.fitted]
        whole = np.where(np.isfinite(whole), whole, 0.0)
        whole = whole[:, np.any(whole != 0, 0)]
        rows, columns = whole.shape
        if rows > 1 and columns > 1:
            square = np.linalg.svd(whole, compute_uv=False) ** 2
            alone = rows * columns / (rows + columns)
            crowd = alone * float((square**2).sum() / max(square.sum() ** 2, 1e-30))
            crowded.setdefault(channel.kind, []).append((crowd, rows))
        for k in np.unique(where[channel.fitted]):
            x = left[channel.fitted & (where == k)]
            for column in x.T:
                own = column[np.isfinite(column)]  # rows of other sensors may lie between
                if len(own) > 1:  # a mean speed has no neighbour
                    total = float(own @ own)
                    both = float(own[:-1] @ own[1:]), total, total * len(own)
                    lagged.setdefault(channel.kind, []).append(both)
    found = {channel.kind: 1.0 for channel in problem.channels}
    for kind, many in lagged.items():
        product, square_sum, weighted = (sum(x[k] for x in many) for k in range(3))
        rows = max(weighted / max(square_sum, 1e-30), _FEWEST_ROWS)
        # What is fitted takes some of it away (Marriott and Pope 1954).
        rho = (product / max(square_sum, 1e-30) + 1 / rows) / (1 - 3 / rows)
        rho = min(max(rho, 0.0), max(0.95, (rows - 1) / (rows + 1)))
        crowd = 1.0
        if kind in crowded:
            crowd = sum(c * n for c, n in crowded[kind]) / sum(n for _, n in crowded[kind])
        found[kind] = (1 + rho) / (1 - rho) * max(crowd, 1.0)
    return found


def begin(problem: FitProblem, seed: int) -> FitState:
    """The first state: the best of some draws of the prior and, where unknown, of headings."""
    origin = problem.origin()
    noise = {channel.kind: NOISE[channel.kind] for channel in problem.channels}
    draw = np.random.default_rng(seed)
    spread = np.array([p.spread for p in problem.parameters])
    points = [origin]
    room = problem.lanes - 1
    if problem.free_heading.any():
        for k in range(1, room + 1):
            starts = origin.starts.copy()
            starts[:, 5, problem.free_heading] = 2 * np.pi * k / (room + 1)
            points.append(replace(origin, starts=starts))
    else:
        drawn = spread * draw.normal(size=(room, len(spread)))
        points += [replace(origin, free=free) for free in drawn]
    none = np.zeros(problem.drive.resets.shape)
    costs = recording_costs(problem, points, noise)
    best = origin
    if problem.free_heading.any():
        starts = origin.starts.copy()
        for r in range(len(problem.recordings)):
            starts[..., r] = points[int(np.argmin(costs[:, r]))].starts[..., r]
        # It is where the prior of the heading lies from here on.
        problem.roots[:] = _turned(problem.roots, starts[:, 5])
    else:
        best = points[int(np.argmin(costs.sum(1)))]
    first = FitState(best, noise, none)
    pieces = problem.in_pieces()
    if "clock" not in problem.local:
        same = bool((problem.short == problem.drive.resets).all())
        return first if same else _arrive(pieces, first)
    # A search finds a delay only from near it.
    arrived, clock = [], problem.local.index("clock")
    for late in _CLOCKS:
        local = best.local.copy()
        local[:, clock] = late
        arrived.append(_arrive(pieces, replace(first, point=replace(best, local=local))))
    # One by one: points that are simulated together have one clock.
    totals = [recording_costs(pieces, [one.point], noise).sum() for one in arrived]
    return arrived[int(np.argmin(totals))]


def _arrive(pieces: FitProblem, state: FitState) -> FitState:
    """Where the search begins in earnest: where one with short windows has led."""
    model = linearize(pieces, state.point)
    for _ in range(_SHORT_STEPS):
        state, model = advance(pieces, state, model)
        if state.moved < _SHORT_TOLERANCE:
            break
    noise = {kind: NOISE[kind] for kind in state.noise}
    return FitState(state.point, noise, np.zeros_like(state.damping))


def _turned(roots: np.ndarray, turn: np.ndarray) -> np.ndarray:
    """States with the core turned about z [rad]."""
    found, about_z = roots.copy(), (np.cos(turn / 2), 0.0, 0.0, np.sin(turn / 2))
    found[:, 3:7] = np.stack(quat_mul(about_z, tuple(np.moveaxis(roots[:, 3:7], 1, 0))), 1)
    return found


def recording_costs(
    problem: FitProblem, points: list[Point], noise: dict[str, float]
) -> np.ndarray:
    """`[points, R]` sums of squares, wild ones less."""
    tracks = problem.simulate(points)
    found = np.zeros((len(points), len(problem.recordings)))
    for channel, left in zip(problem.channels, problem.residuals(tracks), strict=True):
        z = np.abs(left[:, channel.fitted] / noise[channel.kind])
        z = np.where(np.isfinite(z), z, 0.0)
        bent = np.where(z < 30, z**2 / 2, 30 * (z - 15))
        found[:, channel.recording] += bent.sum((1, 2))
    return found


def _look_around(
    problem: FitProblem, state: FitState, model: Model
) -> tuple[Point | None, np.ndarray]:
    """What lies one or two standard deviations of each number away, the others at rest.

    Returns:
        The best point there, if it is better than the state's, and `[K, R]` where windows are to
        begin anew, as the motion before is too far from linear.
    """
    count, resets = len(problem.parameters), problem.drive.resets
    system = normal_equations(problem, model, state.point, state.noise)
    covariance = np.linalg.inv(with_prior(problem, system))
    at_rest = system._replace(starts=[(*x[:4], 0 * x[4]) for x in system.starts])
    points = []
    for k in range(count):
        move = covariance[:, k] / np.sqrt(covariance[k, k])
        # The commands' clock is the first point's.
        move[count:] = np.where(np.tile([n == "clock" for n in problem.local], len(resets[0])),
                                0.0, move[count:])  # fmt: skip
        points += [
            reach(problem, state.point, at_rest, far * move) for far in (_AWAY, -_AWAY, 1.0, -1.0)
        ]
    bent = np.zeros(resets.shape)
    windows, prior = costs_of(problem, state.point, model.values, state.noise)
    lowest, best = float(windows.sum()) + prior - _LOWER, None
    room = problem.lanes
    for first in range(0, len(points), room):
        some = points[first : first + room]
        left = problem.residuals(problem.simulate(some))
        for i, point in enumerate(some):
            windows, prior = costs_of(problem, point, [x[i] for x in left], state.noise)
            if float(windows.sum()) + prior < lowest:
                lowest, best = float(windows.sum()) + prior, point
        for channel, values, slopes, off in zip(
            problem.channels, model.values, model.slopes, left, strict=True
        ):
            r = channel.recording
            where = problem.window_of(r, channel.time)
            for i, point in enumerate(some):
                starts = (point.starts - state.point.starts)[where, :, r]
                common = np.concatenate([point.free - state.point.free,
                                         (point.local - state.point.local)[r]])  # fmt: skip
                moved = np.concatenate([np.tile(common, (len(where), 1)), starts], 1)
                linear = values + np.einsum("ndj,nj->nd", slopes, moved)
                square = ((off[i] - linear) / state.noise[channel.kind]) ** 2 / 2
                square = np.nansum(square, 1) * channel.fitted
                own = np.bincount(where, square, len(bent))
                bent[:, r] = np.maximum(bent[:, r], own)
    return best, middles(resets, bent > _BENT, problem.short)


def middles(resets: np.ndarray, chosen: np.ndarray, short: np.ndarray) -> np.ndarray:
    """`[K, R]` the middles of chosen windows of several pieces, where short ones may begin."""
    found = np.zeros(resets.shape, bool)
    for k, r in zip(*np.nonzero(chosen & resets), strict=True):
        later = np.flatnonzero(resets[k + 1 :, r] | ~short[k + 1 :, r])
        length = int(later[0]) + 1 if len(later) else len(resets) - int(k)
        if length > 1:
            found[k + length // 2, r] = True
    return found


def _go_on(problem: FitProblem, state: FitState, model: Model) -> tuple[FitState, Model]:
    """A search that has arrived goes on from a better place, or with windows that are cut."""
    better, cut = _look_around(problem, state, model)
    state = replace(state, damping=0 * state.damping, common=0.0)
    if better is not None:
        state = replace(state, point=better)
    elif cut.any():
        problem.drive.resets[cut] = True
    else:
        return replace(state, inflated=True), model
    return state, linearize(problem, state.point, state.steps)


def advance(problem: FitProblem, state: FitState, model: Model) -> tuple[FitState, Model]:
    """One step of the search; the damping grows until a step lowers the cost."""
    if state.steps is None and state.moved < _NEAR:
        system = normal_equations(problem, model, state.point, state.noise)
        state = replace(state, steps=_spreads(problem, system))
        model = linearize(problem, state.point, state.steps)
    elif not state.inflated and state.moved < _TOLERANCE:
        state, model = _go_on(problem, state, model)
    system = normal_equations(problem, model, state.point, state.noise)
    plain = estimate_noise(problem, model.values, numbers_used(problem, system))
    # What errs together counts once: the prior then holds where the model errs, and not the frames.
    inflation = correlation(problem, model.values) if state.inflated else {}
    noise = {kind: x * float(np.sqrt(inflation.get(kind, 1.0))) for kind, x in plain.items()}
    system = normal_equations(problem, model, state.point, noise)
    windows, prior = costs_of(problem, state.point, model.values, noise)
    now = float(windows.sum()) + prior
    steps = None if state.steps is None else _spreads(problem, system)
    state = replace(state, noise=noise, cost=now, steps=steps)
    for _ in range(8):
        point, moved = step(problem, state, system)
        tried = linearize(problem, point, state.steps)
        others, prior = costs_of(problem, point, tried.values, noise)
        cost = float(others.sum()) + prior
        better = others <= windows + 1.0
        eased = np.where(state.damping > 1e-3, state.damping / 10, 0.0)
        damping = np.where(better, eased, np.maximum(10 * state.damping, 1e-1))
        if cost <= now + 1e-6 * abs(now):
            common = state.common / 10 if state.common > 1e-3 else 0.0
            return replace(state, point=point, damping=damping, common=common, cost=cost,
                           iteration=state.iteration + 1, moved=moved), tried  # fmt: skip
        if moved < _TOLERANCE:
            break
        common = 10 * state.common if state.common else 1e-2
        state = replace(state, damping=damping, common=common)
    state = replace(state, iteration=state.iteration + 1, moved=0.0)
    return state, linearize(problem, state.point, state.steps)  # with these steps, as a resumed fit
