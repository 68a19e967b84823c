"""What `experiments.validation` checks: laws of the water against closed forms, through the engine.

A case is a function that returns rows, and curves for the plots. Everything runs in float64, so
that an error is the law's or the time step's and not rounding.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from scipy.spatial import ConvexHull

from experiments.common import ROOT
from experiments.water_tank import accelerate, at_rest, box_robot, march, world
from mjx_revolve.body.module_types import Thruster
from mjx_revolve.body.morphology import load_morphology
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.episodes.simulate import simulate
from mjx_revolve.water.buoyancy import cut_box
from mjx_revolve.water.flow import gust_path, water_of
from mjx_revolve.water.laws import as_components
from mjx_revolve.water.lift_drag import lift_drag
from mjx_revolve.water.mujoco_drag import ellipsoid, ellipsoid_numbers, inertia_box
from mjx_revolve.water.plates import LiftDrag
from mjx_revolve.water.world import load_world

RHO, G = 999.1026, 9.81
# A champion of experiments/sine_swim.yaml of an earlier step, seed 0, rounded: a spider that swims.
SWIMMER = (
    -1.46, -1.66, -1.34, -2.52, -0.12, 0.37, 0.09, -1.03, 0.96, 0.97, 0.89, -0.37, 1.96, -2.55,
    -1.4, -1.13, -2.91, 0.19, -0.18, 0.16, -0.24, -1.98, -0.17, -0.75, -1.62, -0.46, -0.19,
    1.8, 0.39, -1.93, -0.13, -1.54, -1.4, -1.8, -0.89, -1.25, 1.47, 0.44, -1.19, 1.28, -1.54,
    -0.45, -1.76, -1.04, 0.58, 1.55, -1.19, 1.06, 0.35, 0.35, -0.27, -1.57, -0.02, 0.37, 0.26,
    -2.12, 2.67,
)  # fmt: skip


@dataclass(frozen=True)
class Row:
    """One comparison.

    Attributes:
        what: the quantity.
        expected: by the closed form.
        found: by the engine.
        tolerance: how far apart they may be.
        unit: of all three.
    """

    what: str
    expected: float
    found: float
    tolerance: float
    unit: str

    @property
    def passed(self) -> bool:
        """Whether it holds; NaN does not."""
        return bool(abs(self.found - self.expected) <= self.tolerance)


@dataclass(frozen=True)
class Curve:
    """One panel of the plots.

    Attributes:
        title: of the panel.
        x_label: with its unit.
        y_label: with its unit.
        lines: (label, x, y, whether it is the closed form).
    """

    title: str
    x_label: str
    y_label: str
    lines: list[tuple[str, np.ndarray, np.ndarray, bool]]


@dataclass(frozen=True)
class Result:
    """What a case found."""

    rows: list[Row]
    curves: list[Curve] = field(default_factory=list)


# ------------------------------------------------------------------------- shared


def frequency(time: np.ndarray, x: np.ndarray) -> float:
    """Angular frequency by the crossings of the mean [rad/s]."""
    x = x - (x.max() + x.min()) / 2
    k = np.flatnonzero(np.diff(np.sign(x)))
    crossings = time[k] - x[k] * (time[k + 1] - time[k]) / (x[k + 1] - x[k])
    return float(np.pi / np.mean(np.diff(crossings)))


def carried(robot: Robot) -> tuple[np.ndarray, np.ndarray]:
    """Added mass [kg] and added inertia [kg·m²] of a single box."""
    return RHO * robot.fluid.carried_mass[0], RHO * robot.fluid.carried_inertia[0]


# ------------------------------------------------------------------------- buoyancy


def thesis() -> Result:
    """The thesis's spider, dry and under water with drag off."""
    rows = []
    body = load_morphology(ROOT / "morphologies" / "spider.yaml")
    for what, buoyancy, expected in (("dry", "off", 9.81), ("under water", "mask", 0.60648)):
        robot = build_robot(body, world(gravity=G, buoyancy=buoyancy))
        time, q, *_ = march(robot, 2.0, *at_rest(robot, 1, -50.0), every=400)
        # Semi-implicit Euler covers a t (t + dt) / 2. Its legs swing a little on their servos.
        found = 2 * (-50.0 - q[-1, 2, 0]) / (time[-1] * (time[-1] + robot.world.timestep))
        rows.append(Row(f"spider falls, {what}", expected, found, 1e-3, "m/s²"))
    return Result(rows)


def clipping() -> Result:
    """A tilted box cut by the surface, against the hull of the cut polyhedron."""
    draw, rows = np.random.default_rng(0), []
    half = np.array([0.3, 0.2, 0.05])
    errors, moments = [], []
    corners = half * np.array(list(np.ndindex(2, 2, 2))) * 2 - half
    edges = [(i, j) for i in range(8) for j in range(i) if bin(i ^ j).count("1") == 1]
    for _ in range(60):
        up = draw.normal(size=3)
        up /= np.linalg.norm(up)
        depth = draw.uniform(-0.7, 0.7) * np.abs(up) @ half
        below = depth - corners @ up
        points = [corners[below > 0]]
        for i, j in edges:
            if below[i] * below[j] < 0:
                t = below[i] / (below[i] - below[j])
                points.append((corners[i] + t * (corners[j] - corners[i]))[None])
        cloud = np.concatenate(points)
        hull, middle = ConvexHull(cloud), cloud.mean(0)
        volume, first = 0.0, np.zeros(3)
        for simplex in hull.simplices:
            a, b, c = cloud[simplex]
            part = abs(np.dot(a - middle, np.cross(b - middle, c - middle))) / 6
            volume, first = volume + part, first + part * (a + b + c + middle) / 4
        with jax.enable_x64(True):
            share, moment = cut_box(tuple(jnp.asarray(up)), jnp.asarray(depth), tuple(half))
        whole = 8 * np.prod(half)
        errors.append(abs(float(share) - volume / whole))
        moments.append(np.abs(np.array(moment) - first / whole).max())
    rows.append(Row("share of a tilted box, worst of 60", 0.0, max(errors), 1e-12, "-"))
    rows.append(Row("its first moment, worst of 60", 0.0, max(moments), 1e-12, "m"))
    return Result(rows)


def floating() -> Result:
    """A box of 0.6 of the water's density: draft, bobbing, and the shift by added mass."""
    size, ratio = np.array([0.2, 0.16, 0.1]), 0.6
    mass, rows, lines = ratio * RHO * np.prod(size), [], []
    area, draft = size[0] * size[1], ratio * size[2]
    for added in (False, True):
        robot = box_robot(
            size, mass, world(gravity=G, buoyancy="partial", added_mass=added, timestep=0.001)
        )
        qpos, qvel = at_rest(robot, 1, size[2] / 2 - draft + 0.005)
        time, q, *_ = march(robot, 4.0, qpos, qvel)
        inertia = mass + ratio * carried(robot)[0][2]
        label = "with added mass" if added else "without added mass"
        expected = np.sqrt(RHO * G * area / inertia)
        found = frequency(time, q[:, 2, 0])
        rows.append(Row(f"bobbing, {label}", expected, found, 0.01 * expected, "rad/s"))
        lines.append((label, time, 1e3 * (q[:, 2, 0] - size[2] / 2 + draft), False))
    robot = box_robot(
        size, mass, world(gravity=G, buoyancy="partial", drag="faces", added_mass=True)
    )
    qpos, qvel = at_rest(robot, 1, size[2] / 2 - draft + 0.03)
    _, q, *_ = march(robot, 40.0, qpos, qvel, every=5)
    # Quadratic drag never quite ends the bobbing: the mean over the last 10 s.
    found = size[2] / 2 - q[-q.shape[0] // 4 :, 2, 0].mean()
    rows.insert(0, Row("mean draft, 30 to 40 s with drag", draft, found, 2e-4, "m"))
    return Result(rows, [Curve("A box bobs at its draft", "time [s]", "height [mm]", lines)])


def righting() -> Result:
    """A submerged neutral box with its ballast low swings like a pendulum."""
    size, arm = np.array([0.2, 0.16, 0.1]), 0.01
    volume = float(np.prod(size))
    rows = []
    for added in (False, True):
        tank = world(gravity=G, buoyancy="partial", added_mass=added, timestep=0.001)
        robot = box_robot(size, RHO * volume, tank, center_of_volume=(0, 0, arm))
        qpos, qvel = at_rest(robot, 1, -5.0)
        qpos[3:7, 0] = [np.cos(0.01), np.sin(0.01), 0, 0]
        time, q, *_ = march(robot, 4.0, qpos, qvel)
        inertia = robot.mj_model.body_inertia[1].copy()
        # MuJoCo keeps principal inertias in an order of its own; about x it is this one.
        about = RHO * volume / 12 * (size[1] ** 2 + size[2] ** 2)
        assert np.any(np.isclose(inertia, about))
        expected = np.sqrt(RHO * G * volume * arm / (about + carried(robot)[1][0]))
        found = frequency(time, 2 * np.arcsin(q[:, 4, 0]))
        label = "with" if added else "without"
        rows.append(
            Row(f"righting, {label} added inertia", expected, found, 0.01 * expected, "rad/s")
        )
    return Result(rows)


# ------------------------------------------------------------------------- drag and added mass


def falling() -> Result:
    """Two modules sink on each of their faces by v = v_t tanh(t / τ), τ = (m + m_a) v_t / net."""
    rows, lines = [], []
    # World from body: which edge stands upright, and how it comes to.
    down = np.array([2, 1, 0])
    sides = np.array([[1, 0, 0, 0], [0.5**0.5, 0.5**0.5, 0, 0], [0.5**0.5, 0, 0.5**0.5, 0]]).T
    core = np.array([0.089, 0.089, 0.045]), 0.09, 5.054e-5
    brick = np.array([0.041, 0.041, 0.0355]), 0.0102 + 0.005, 1.07e-5  # with 5 g of ballast
    for name, (size, mass, volume) in {"core": core, "brick": brick}.items():
        net, area = (mass - RHO * volume) * G, (np.prod(size) / size)[down]
        terminal = np.sqrt(2 * net / (RHO * 1.05 * area))
        for added in (False, True):
            tank = world(
                gravity=G, buoyancy="partial", drag="faces", added_mass=added, timestep=0.001
            )
            robot = box_robot(size, mass, tank, volume)
            qpos, qvel = at_rest(robot, 3, -20.0)
            qpos[3:7] = sides
            # Longer, and with carried water the rounding of the pose grows to a tumble (Munk).
            time, _, v, _ = march(robot, 2.0, qpos, qvel, every=10)
            tau = (mass + carried(robot)[0][down]) * terminal / net
            expected = terminal * np.tanh(time[:, None] / tau)
            label = f"{name}, {'with' if added else 'without'} added mass"
            # First order in the time step: up to dt / 2τ of the speed on the way.
            worst = np.abs(-v[:, 2] - expected).max()
            rows.append(Row(f"approach to v_t, {label}", 0.0, worst, 0.01 * terminal[0], "m/s"))
            end = np.abs(-v[-1, 2] / expected[-1] - 1).max()
            rows.append(Row(f"speed at 2 s, {label}", 0.0, end, 3e-3, "-"))
            lines += [(label, time, -v[:, 2, 0], False), ("tanh", time, expected[:, 0], True)]
    return Result(rows, [Curve("Modules sink", "time [s]", "speed [m/s]", lines)])


def drifting() -> Result:
    """A neutral box in a current: u - u / (1 + u c t / m)."""
    size, current = np.array([0.1, 0.08, 0.06]), 0.3
    volume = float(np.prod(size))
    tank = world(drag="faces", added_mass=True, current=(current, 0, 0))
    robot = box_robot(size, RHO * volume, tank)
    time, _, v, _ = march(robot, 8.0, *at_rest(robot, 1, -5.0), every=10)
    inertia = RHO * volume + carried(robot)[0][0]
    c = 0.5 * RHO * 1.05 * size[1] * size[2]
    expected = current - current / (1 + current * c * time / inertia)
    worst = np.abs(v[:, 0, 0] - expected).max()
    lines = [("box", time, v[:, 0, 0], False), ("closed form", time, expected, True)]
    return Result(
        [Row("drift to a current, over 8 s", 0.0, worst, 2e-5, "m/s")],
        [Curve("A box drifts with the current", "time [s]", "speed [m/s]", lines)],
    )


def munk() -> Result:
    """A body that moves askew is turned broadside on: ½ (A_z - A_x) U² sin 2α about y."""
    size, mass = np.array([0.2, 0.1, 0.03]), 0.5
    robot = box_robot(size, mass, world(added_mass=True))
    alpha = np.linspace(-np.pi / 2, np.pi / 2, 9)
    qpos, qvel = at_rest(robot, 9, -5.0)
    qvel[0], qvel[2] = 0.4 * np.cos(alpha), 0.4 * np.sin(alpha)
    added, spin = carried(robot)
    inertia = mass / 12 * (size[0] ** 2 + size[2] ** 2) + spin[1]
    expected = 0.5 * (added[2] - added[0]) * 0.4**2 * np.sin(2 * alpha) / inertia
    worst = np.abs(accelerate(robot, qpos, qvel)[4] - expected).max()
    return Result([Row("Munk's moment over inertia, worst of 9", 0.0, worst, 1e-9, "rad/s²")])


def conserving() -> Result:
    """Drag-free tumbling of plates that carry 3, 10 and 30 times their mass, 2 s at 5 ms."""
    rows, lines = [], []
    draw = np.random.default_rng(1)
    for mass in (0.5, 0.16, 0.05):
        robot = box_robot((0.2, 0.1, 0.01), mass, world(added_mass=True))
        qpos, qvel = at_rest(robot, 8, -5.0)
        qvel[:] = draw.normal(size=qvel.shape)
        added, spin = carried(robot)
        own = mass / 12 * np.array([0.1**2 + 0.01**2, 0.2**2 + 0.01**2, 0.2**2 + 0.1**2])

        def energy(
            q: np.ndarray, v: np.ndarray, a: Any = added, i: Any = own + spin, m: float = mass
        ) -> Any:
            turn = np.zeros(9)
            mujoco.mju_quat2Mat(turn, q[3:7] / np.linalg.norm(q[3:7]))
            seen = turn.reshape(3, 3).T @ v[:3]
            return 0.5 * ((m + a) @ seen**2 + i @ v[3:] ** 2)

        time, q, v, _ = march(robot, 2.0, qpos, qvel, every=10)
        first = np.array([energy(qpos[:, k], qvel[:, k]) for k in range(8)])
        later = np.array(
            [[energy(a[:, k], b[:, k]) for k in range(8)] for a, b in zip(q, v, strict=True)]
        )
        worst = np.abs(later / first - 1).max()
        times = added[2] / mass
        rows.append(Row(f"energy, {times:.0f} times its mass carried", 0.0, worst, 1e-9, "-"))
        lines.append((f"{times:.0f} times its mass", time, (later / first - 1)[:, 0], False))
    return Result(rows, [Curve("Energy of drag-free plates", "time [s]", "relative change", lines)])


def moving_frame() -> Result:
    """The arm-less spider in still water, and in a current with the current's speed added."""
    body = load_morphology(ROOT / "morphologies" / "spider.yaml")
    current = np.array([0.3, -0.2, 0.0])
    ends = []
    for flow in (np.zeros(3), current):
        robot = build_robot(body, load_world("lake", bed=None, current=tuple(flow)))
        qpos, qvel = at_rest(robot, 1, -0.1)
        qvel[:3, 0] = flow
        ctrl = np.full((8, 1), 0.4)
        time, q, *_ = march(robot, 1.0, qpos, qvel, ctrl, every=20)
        ends.append(q[-1, :, 0] - np.concatenate([time[-1] * flow, np.zeros(len(qpos) - 3)]))
    worst = np.abs(ends[1] - ends[0]).max()
    return Result([Row("Galilean invariance, spider over 1 s", 0.0, worst, 1e-9, "m, rad")])


def mujoco_laws() -> Result:
    """MuJoCo C's `qfrc_passive` of three boxes in a wind, for both of its models."""
    rows, draw = [], np.random.default_rng(6)
    for law in ("inertia_box", "ellipsoid"):
        shape, worst = 'fluidshape="ellipsoid"' if law == "ellipsoid" else "", 0.0
        for size in np.array([(0.1, 0.06, 0.03), (0.05, 0.05, 0.05), (0.02, 0.3, 0.02)]):
            half = " ".join(map(str, size / 2))
            model = mujoco.MjModel.from_xml_string(
                f"""<mujoco><option density="{RHO}" viscosity="0.3" wind=".3 -.2 .1"
                gravity="0 0 0"/><worldbody><body><freejoint/><geom type="box" size="{half}"
                mass=".3" {shape}/></body></worldbody></mujoco>"""
            )
            data = mujoco.MjData(model)
            for _ in range(20):
                data.qpos[3:7], data.qvel[:] = draw.normal(size=4), draw.normal(size=6)
                mujoco.mj_forward(model, data)
                turn = data.xmat[1].reshape(3, 3)
                wanted = np.array([*(turn.T @ data.qfrc_passive[:3]), *data.qfrc_passive[3:]])
                with jax.enable_x64(True):
                    v = tuple(jnp.asarray(turn.T @ (data.qvel[:3] - model.opt.wind)))
                    w = tuple(jnp.asarray(data.qvel[3:]))
                    if law == "inertia_box":
                        found = inertia_box(v, w, tuple(size), RHO, 0.3)
                    else:
                        numbers = ellipsoid_numbers(size / 2, model.geom_fluid[0], RHO, 0.3)
                        found = ellipsoid(v, w, as_components(numbers), True)
                error = np.abs(np.concatenate([np.stack(x) for x in found]) - wanted)
                worst = max(worst, error.max() / np.abs(wanted).max())
        rows.append(Row(f"MuJoCo's {law}, worst of 60", 0.0, worst, 1e-10, "-"))
    return Result(rows)


def plate() -> Result:
    """Lift and drag coefficients of the catalogue's fin through and past its stall."""
    p = LiftDrag(cla=1.257, cda=0.465, alpha_stall=np.pi / 6, cla_stall=-0.6285, cda_stall=0.9)
    angles = np.radians([-80, -30, -10, 10, 30, 60, 80])

    def coefficients(alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        v = (jnp.cos(alpha), 0 * alpha, -jnp.sin(alpha))
        force = lift_drag(v, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0), 1.0, 2.0, p)
        along = sum(f * x for f, x in zip(force, v, strict=True))
        lift = force[2] * jnp.cos(alpha) + force[0] * jnp.sin(alpha)
        return np.asarray(lift), -np.asarray(along)

    def by_hand(alpha: float) -> tuple[float, float]:
        size, past = abs(alpha), max(0.0, abs(alpha) - p.alpha_stall)
        lift = p.cla * min(size, p.alpha_stall) + p.cla_stall * past
        return np.sign(alpha) * max(lift, 0.0), p.cda * min(
            size, p.alpha_stall
        ) + p.cda_stall * past

    with jax.enable_x64(True):
        found = coefficients(jnp.asarray(angles))
        fine = np.linspace(-np.pi / 2 + 0.01, np.pi / 2 - 0.01, 181)
        lift, drag = coefficients(jnp.asarray(fine))
    wanted = np.array([by_hand(a) for a in angles]).T
    rows = [
        Row(f"c_{name} of a fin at 7 angles, worst", 0.0, np.abs(f - w).max(), 1e-12, "-")
        for name, f, w in zip("ld", found, wanted, strict=True)
    ]
    degrees = np.degrees(fine)
    lines = [("lift", degrees, lift, False), ("drag", degrees, drag, False)]
    return Result(
        rows, [Curve("A fin stalls at 30°", "angle of attack [deg]", "coefficient [-]", lines)]
    )


# ------------------------------------------------------------------------- what moves by itself


def thrusting() -> Result:
    """A box with a thruster: √(2 T / ρ C_d A) in the end, and 1 - 1/e of its command after τ."""
    size = np.array([0.2, 0.1, 0.1])
    volume = float(np.prod(size))
    pusher = Thruster(gain=1.5, time_constant=0.2)
    robot = box_robot(size, RHO * volume, world(drag="faces", added_mass=True), thruster=pusher)
    qpos, qvel = at_rest(robot, 1, -5.0)
    qvel[0] = 0.3
    time, _, v, _ = march(robot, 60.0, qpos, qvel, np.ones((1, 1)), every=40)
    expected = np.sqrt(2 * 1.5 / (RHO * 1.05 * size[1] * size[2]))
    with jax.enable_x64(True):
        track = simulate(robot, np.ones((40, 1)))
    lag = 1 - np.exp(-1.0)
    lines = [
        ("box", time, v[:, 0, 0], False),
        ("steady speed", time, np.full_like(time, expected), True),
    ]
    return Result(
        [
            Row("thruster, steady speed", expected, v[-1, 0, 0], 1e-3 * expected, "m/s"),
            Row("its command after one time constant", lag, float(track.command[39, 0]), 1e-9, "-"),
        ],
        [Curve("A thruster pushes a box", "time [s]", "speed [m/s]", lines)],
    )


def gusts() -> Result:
    """Mean, standard deviation and memory of a gusty current, at two time steps."""
    tank = world(gust={"std": 0.1, "time": 2.0})
    assert tank.gust is not None
    rows, trials = [], 2000
    for dt in (0.005, 1.0):
        steps = round(4.0 / dt)
        path = np.asarray(gust_path(tank.gust, jax.random.key(0), steps, dt, trials))[:, 0]
        last = path[-1]
        # Three standard errors of each estimate.
        rows.append(
            Row(f"gust, mean at dt {dt:g} s", 0.0, last.mean(), 3 * 0.1 / trials**0.5, "m/s")
        )
        rows.append(
            Row(f"gust, std at dt {dt:g} s", 0.1, last.std(), 3 * 0.1 / (2 * trials) ** 0.5, "m/s")
        )
        memory = np.corrcoef(path[-1 - round(2.0 / dt)], last)[0, 1]
        rows.append(
            Row(
                f"gust, correlation over T at dt {dt:g} s", np.exp(-1), memory, 3 / trials**0.5, "-"
            )
        )
    return Result(rows)


def orbiting() -> Result:
    """A small neutral body under a deep-water wave goes round with the water, a e^(kz).

    So it does where a current takes both through the wave's pattern: at ω - k c, at the same speed.
    """
    amplitude, length, depth = 0.05, 4.0, 0.5
    tank = world(
        gravity=G, buoyancy="partial", drag="faces", added_mass=True,
        waves=[{"amplitude": amplitude, "wavelength": length}],
    )  # fmt: skip
    side = 0.04
    robot = box_robot((side,) * 3, RHO * side**3, tank)
    k = 2 * np.pi / length
    omega = np.sqrt(G * k)
    current = np.array([0.0, 0.3, -0.3])
    qpos, qvel = at_rest(robot, 3, -depth)
    qvel[0] = current + amplitude * omega * np.exp(-k * depth)
    period = 2 * np.pi / omega
    water = water_of(tank)._replace(current=(current, 0 * current, 0 * current))
    time, q, *_ = march(robot, 3 * period, qpos, qvel, water=water)
    rows = []
    for c, z in zip(current, q[:, 2].T, strict=True):
        expected = amplitude * np.exp(-k * depth) * omega / (omega - k * c)
        # Stokes's drift carries it along; a parabola takes up what is left of it in z.
        phase, ones = (omega - k * c) * time, np.ones_like(time)
        basis = np.stack([np.cos(phase), np.sin(phase), ones, time, time**2], -1)
        fit = np.linalg.lstsq(basis, z, rcond=None)[0]
        name = f"orbit under a wave{f', in a current of {c:g} m/s' if c else ''}"
        rows.append(Row(name, expected, np.hypot(fit[0], fit[1]), 0.05 * expected, "m"))
    lines = [("body", 1e3 * q[:, 0, 0], 1e3 * (q[:, 2, 0] + depth), False)]
    return Result(
        rows,
        [Curve("Three periods under a wave (with Stokes's drift)", "x [mm]", "z [mm]", lines)],
    )


# ------------------------------------------------------------------------- the bed


def sliding() -> Result:
    """A core on dry flat ground: what it sinks in, and μ g."""
    bed = {"kind": "flat", "height": -2.0}
    robot = box_robot((0.089, 0.089, 0.045), 0.09, world(gravity=G, bed=bed, timestep=0.001))
    assert robot.world.bed is not None
    sunk = 0.09 * G / 4 / robot.world.bed.stiffness
    qpos, qvel = at_rest(robot, 2, -2.0 + 0.0225 - sunk)
    qvel[0, 1] = 1.0
    time, q, v, _ = march(robot, 0.1, qpos, qvel)
    found = (1.0 - v[-1, 0, 1]) / time[-1]
    return Result(
        [
            Row("depth of rest on the bed", sunk, -2.0 + 0.0225 - q[-1, 2, 0], 1e-6, "m"),
            Row("sliding deceleration μ g", 0.6 * G, found, 0.02 * 0.6 * G, "m/s²"),
        ]
    )


# ------------------------------------------------------------------------- the step


def gradients() -> Result:
    """The derivative of a rollout through the surface, against central differences."""
    robot = box_robot(
        (0.1, 0.08, 0.06), 0.4, world(gravity=G, buoyancy="partial", drag="faces", added_mass=True)
    )
    with jax.enable_x64(True):
        qpos = jnp.asarray(robot.start_qpos(-0.05))
        qvel = jnp.zeros(6).at[3].set(0.5)

        def end(height: Any) -> Any:
            return simulate(robot, duration=0.4, qpos=qpos.at[2].set(height), qvel=qvel).qpos[-1, 2]

        found = float(jax.grad(end)(0.05))
        wanted = float(end(0.05 + 1e-6) - end(0.05 - 1e-6)) / 2e-6
    return Result(
        [Row("slope of a fall into the water", wanted, found, 1e-5 * abs(wanted) + 1e-8, "-")]
    )


def converging() -> Result:
    """Where a swimming spider is after 10 s, at the step of sine_swim.yaml and at half."""
    from mjx_revolve import make_fitness

    ends, path = {}, ROOT / "experiments" / "sine_swim.yaml"
    with jax.enable_x64(True):
        for step in (0.005, 0.0025):
            fitness = make_fitness(path, **{"world.timestep": step})
            track = fitness.replay(np.array(SWIMMER), jax.random.key(5))
            ends[step] = np.asarray(track.qpos)[-1, :3]
    ways = {step: np.linalg.norm(end - [0, 0, -2]) for step, end in ends.items()}
    longer = abs(ways[0.005] / ways[0.0025] - 1)
    moved = np.linalg.norm(ends[0.005] - ends[0.0025]) / ways[0.0025]
    # The gait has no compass: a turn that differs by 0.07 rad in 10 s moves the end by half of it.
    return Result(
        [
            Row("halved step changes a swimmer's way by", 0.0, longer, 0.01, "of it"),
            Row("halved step moves its end by", 0.0, moved, 0.05, "of its way"),
        ]
    )


CASES: dict[str, Callable[[], Result]] = {
    "thesis": thesis,
    "clipping": clipping,
    "floating": floating,
    "righting": righting,
    "falling": falling,
    "drifting": drifting,
    "Munk": munk,
    "plate": plate,
    "MuJoCo": mujoco_laws,
    "conservation": conserving,
    "moving frame": moving_frame,
    "thruster": thrusting,
    "gusts": gusts,
    "waves": orbiting,
    "bed": sliding,
    "gradient": gradients,
    "time step": converging,
}
# What takes under half a minute together.
QUICK_CASES = ("thesis", "clipping", "Munk", "plate", "MuJoCo", "drifting", "gusts", "bed")
