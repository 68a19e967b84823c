"""Poses of the core from recordings: rigid fits to marks, smoothing, rest."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

import numpy as np
from scipy.interpolate import make_smoothing_spline
from scipy.spatial.transform import Rotation

from mjx_revolve.engine.kinematics import body_poses
from mjx_revolve.engine.robot import Robot
from mjx_revolve.fitting.recording import GAP, MarkedPoint
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.water.bed import bed_height

# Marks fit a robot if they are so far off at most, in lengths of the robot, and are swapped or
# mirrored if that makes them fit so many times better. Choices.
_MISFIT, _BETTER = 0.1, 3.0
# Marks in space that are nearer than this to a line say less of the roll about it than that the
# robot is level [m]: a camera's usual error.
_LEVEL = 5e-3


class MarkPoints:
    """Where marks are on a robot, for given angles of its hinges."""

    def __init__(self, robot: Robot, marks: Sequence[MarkedPoint]) -> None:
        """Finds the bodies that carry them: of a module with a hinge, the part that moves."""
        self.robot, table, assembly = robot, robot.fluid, robot.assembly
        last = [int(np.flatnonzero(table.module == mark.module)[-1]) for mark in marks]
        self.body = table.body[last]
        placed = [(robot.morphology.modules[mark.module], mark.place) for mark in marks]
        place = [module.position + module.rotation @ at for module, at in placed]
        self.offset = np.array(
            [assembly.rotation[b].T @ (p - assembly.position[b])
             for b, p in zip(self.body, place, strict=True)]
        ).reshape(-1, 3)  # fmt: skip

    def at(self, qpos: np.ndarray) -> np.ndarray:
        """`[n, marks, 3]` in the world, of `[n, nq]` poses [m]."""
        if np.all(self.body == 1):
            turn = Rotation.from_quat(qpos[:, 3:7], scalar_first=True).as_matrix()
            return qpos[:, None, :3] + np.einsum("nij,mj->nmi", turn, self.offset)
        place, turns = (np.asarray(x) for x in body_poses(self.robot, qpos))  # type: ignore[arg-type]
        turned = np.einsum("nmij,mj->nmi", turns[:, self.body], self.offset)
        return place[:, self.body] + turned

    def on_core(self, angles: np.ndarray) -> np.ndarray:
        """`[n, marks, 3]` in the core's frame, of `[n, hinges]` angles [rad]."""
        still = np.tile(self.robot.qpos0[:7], (len(angles), 1))
        return self.at(np.concatenate([still, angles], 1))


def gap(time: np.ndarray, at: np.ndarray) -> np.ndarray:
    """Whether times lie in a gap of a signal, farther from its rows than most rows do.

    Args:
        time: `[n]` of the rows, rising [s].
        at: `[m]` [s].

    Returns:
        `[m]`; of a single row all but its own time.
    """
    if len(time) < 2:
        return ~np.isin(at, time)
    k = np.clip(np.searchsorted(time, at), 1, len(time) - 1)
    away = np.minimum(np.abs(at - time[k - 1]), np.abs(at - time[k]))
    # Rows may come in bursts.
    return away > GAP * float(np.quantile(np.diff(time), 0.9))


def joined_marks(time: np.ndarray, seen: np.ndarray, dims: int) -> np.ndarray:
    """Marks that are seen at times of their own, between their frames, all at the same times.

    Args:
        time: `[n]` [s].
        seen: `[n, marks, 3]` world frame, NaN where not seen [m].
        dims: how many axes are seen.

    Returns:
        The same; what lies in a gap stays NaN.
    """
    found = seen.copy()
    for m in range(seen.shape[1]):
        known = np.isfinite(seen[:, m, :dims]).all(1)
        if known.sum() < 2:
            continue
        own = time[known]
        between = ~known & ~gap(own, time) & (time > own[0]) & (time < own[-1])
        for axis in range(dims):
            found[between, m, axis] = np.interp(time[between], own, seen[known, m, axis])
    return found


def fit_rigid(
    model: np.ndarray, seen: np.ndarray, planar: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Poses that bring points nearest to marks (Kabsch 1976), frame by frame.

    Args:
        model: `[n, marks, 3]` core frame [m].
        seen: `[n, marks, 3]` world frame, NaN where not seen [m].
        planar: whether only x and y are.

    Returns:
        `[n, 3]` positions, NaN where too few marks are seen, `[n, 4]` quaternions, and `[n]` root
        mean square of what is left [m].
    """
    dims = 2 if planar else 3
    known = np.isfinite(seen[..., :dims]).all(-1)
    weight = known / np.maximum(known.sum(1, keepdims=True), 1)
    y = np.where(known[..., None], seen[..., :dims], 0.0)
    x = model[..., :dims]
    middle = [np.einsum("nm,nmi->ni", weight, p) for p in (x, y)]
    across = np.einsum("nm,nmi,nmj->nij", weight, x - middle[0][:, None], y - middle[1][:, None])
    if not planar:
        # Of marks on a line, the turn nearest to level: they say nothing of the roll about it.
        line = np.linalg.svd(across, compute_uv=False)[:, 1] < _LEVEL**2
        across[line, 2, 2] += _LEVEL**2
    u, _, v = np.linalg.svd(across)
    flip = np.ones((len(x), dims))
    flip[:, -1] = np.sign(np.linalg.det(u) * np.linalg.det(v))
    turn = np.einsum("nji,nj,nkj->nik", v, flip, u)
    place = middle[1] - np.einsum("nij,nj->ni", turn, middle[0])
    left = y - np.einsum("nij,nmj->nmi", turn, x) - place[:, None]
    error = np.sqrt(np.einsum("nm,nmi->n", weight, left**2))
    whole = np.tile(np.eye(3), (len(x), 1, 1))
    whole[:, :dims, :dims] = turn
    position = np.zeros((len(x), 3))
    position[:, :dims] = place
    position[known.sum(1) < dims] = np.nan
    return position, Rotation.from_matrix(whole).as_quat(scalar_first=True), error


def check_marks(
    model: np.ndarray,
    seen: np.ndarray,
    planar: bool,
    names: Sequence[str],
    time: np.ndarray,
    length: float,
) -> None:
    """Refuses marks that are not on this robot as said.

    Raises:
        InputError: their scale, their order or their handedness is another one.
    """
    count = model.shape[1]
    if count < 2:
        return
    dims = 2 if planar else 3
    known = np.isfinite(seen[..., :dims]).all(-1, keepdims=True)
    several = known[..., 0].sum(1) > 1
    if not several.any():
        raise InputError("marks", "two or more of them at a time", "never two")
    model, seen, known, time = model[several], seen[several], known[several], time[several]
    spread = []
    for points in (seen, model):
        variance = np.nanvar(np.where(known, points[..., :dims], np.nan), axis=1).sum(-1)
        spread.append(float(np.sqrt(np.nanmedian(variance))))
    ratio = spread[0] / max(spread[1], 1e-9)
    if not 0.8 < ratio < 1.25:
        raise InputError(
            f"marks: expected them as far apart as on the robot, {spread[1]:.3g} m; found "
            f"{spread[0]:.3g}: another scale (--map mark.NAME.x=COLUMN*{1 / ratio:.3g}), or "
            "another robot?"
        )
    if count <= dims and not (planar and count == 2):
        return
    error = fit_rigid(model, seen, planar)[2]
    usual = float(np.median(error))
    if usual > 0.02 * length:
        mirrored = float(np.median(fit_rigid(model, seen * (1.0, -1.0, 1.0), planar)[2]))
        if mirrored < usual / _BETTER:
            raise InputError(
                "marks: expected y to the left of x; found them mirrored, as in pictures, where y "
                "points down (--map mark.NAME.y=COLUMN*-FACTOR)"
            )
    for rows in (np.ones(len(error), bool), error > max(5 * usual, 0.05 * length)):
        bad = float(np.median(error[rows])) if rows.any() else 0.0
        if bad < 0.02 * length:
            continue
        for a, b in itertools.combinations(range(count), 2):
            order = np.arange(count)
            order[[a, b]] = b, a
            if np.median(fit_rigid(model[rows], seen[rows][:, order], planar)[2]) < bad / _BETTER:
                raise InputError(
                    f"marks {names[a]} and {names[b]}: expected them as on the robot; found them "
                    f"swapped from {time[rows][0]:.13g} s on"
                )
    if usual > _MISFIT * length:
        raise InputError(
            f"marks: expected them to be on a robot {length:.2g} m long; found them {usual:.2g} m "
            "off: another robot, or other places on it?"
        )


def smooth(time: np.ndarray, value: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Smoothing splines, as stiff as foretells every other row from the rest best (Woltring 1986).

    Args:
        time: `[n]` rising [s].
        value: `[n, d]`; rows with NaN are left out.
        at: `[m]` times [s].

    Returns:
        `[m, d]` values and `[m, d]` rates.
    """
    known = np.isfinite(value).all(1)
    t, y = time[known], value[known]
    at = np.clip(at, t[0], t[-1])
    if len(t) < 6:
        order = min(len(t) - 1, 2)
        lines = [np.polynomial.Polynomial.fit(t, column, order) for column in y.T]
        found = [np.stack([f(at) for f in g], -1) for g in (lines, [f.deriv() for f in lines])]
        return found[0], found[1]
    # Lengths from a frame to the whole, to the fourth power, as stiffness grows with length.
    usual = float(np.median(np.diff(t)))
    lengths = np.geomspace(usual, max(t[-1] - t[0], 4 * usual), 14)
    stiffness = lengths**4 / usual / (2 * np.pi) ** 4
    if len(t) < 12:
        best = stiffness[len(stiffness) // 3]
    else:
        errors = []
        for lam in stiffness:
            foretold = [make_smoothing_spline(t[::2], c[::2], lam=lam)(t[1:-1:2]) for c in y.T]
            errors.append(float(np.mean((np.stack(foretold, -1) - y[1:-1:2]) ** 2)))
        best = 2 * stiffness[int(np.argmin(errors))]  # of twice as many rows
    splines = [make_smoothing_spline(t, column, lam=best) for column in y.T]
    values = np.stack([f(at) for f in splines], -1)
    return values, np.stack([f.derivative()(at) for f in splines], -1)


def rest_height(robot: Robot) -> float:
    """Height of the core where a level robot floats; else 1 m down, or half way to the bed [m]."""
    table, layout, world = robot.fluid, robot.assembly.layout, robot.world
    carried = world.density * table.volume.sum()
    if robot.morphology.mass > 0.995 * carried:
        room = np.inf
        if world.bed is not None:
            origin = np.zeros(1)
            room = world.surface_height - float(bed_height(world.bed, origin, origin)[0])
        return world.surface_height - min(1.0, room / 2)
    reach = np.sum(np.abs(layout.rotation[:, 2]) * table.half_size, 1)
    low, high = -1.0, 1.0
    for _ in range(50):
        middle = (low + high) / 2
        under = np.clip((reach - middle - layout.position[:, 2]) / (2 * reach), 0, 1)
        if world.density * (under @ table.volume) > robot.morphology.mass:
            low = middle
        else:
            high = middle
    return world.surface_height + low
