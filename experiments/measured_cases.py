"""What `experiments.measured` puts beside what others measured: our laws, with nothing tuned.

A case takes robots from measured.yaml, asks the engine, and returns rows for the table. Forces are
taken from the engine's accelerations of a body without carried water, so they are what a step sees.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments import measured_data as data
from experiments.common import ROOT
from experiments.validation_cases import carried, frequency
from experiments.water_tank import at_rest, march, quick_options
from experiments.water_tank import world as tank
from mjx_revolve.body.catalogue import load_modules
from mjx_revolve.body.morphology import make_morphology
from mjx_revolve.engine.population import robot_acceleration
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

G = 9.81
LAWS = ("faces", "ellipsoid", "inertia_box")
"""Of drag: ours, and MuJoCo's two."""


@dataclass(frozen=True)
class Row:
    """One number beside a measured one.

    Attributes:
        case: which comparison.
        what: the quantity.
        measured: by others.
        ours: by the engine.
        unit: of both.
    """

    case: str
    what: str
    measured: float
    ours: float
    unit: str

    @property
    def ratio(self) -> float:
        """Ours over measured."""
        return self.ours / self.measured


@dataclass(frozen=True)
class Found:
    """What a case found.

    Attributes:
        rows: for the table.
        lines: for the pictures, by name: x and y.
    """

    rows: list[Row]
    lines: Mapping[Any, tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


@lru_cache(maxsize=1)
def _types() -> Mapping[str, Any]:
    return load_modules(ROOT / "experiments" / "measured.yaml")


def body(name: str, world: World) -> Robot:
    """A robot that is one module of measured.yaml."""
    shape = make_morphology({"id": name, "body": {"id": "core", "type": name}}, modules=_types())
    return build_robot(shape, world)


def sizes(robot: Robot) -> np.ndarray:
    """`[3]` edges of its box [m]."""
    return np.asarray(robot.morphology.modules[0].kind.parts[0].boxes[0].size)


def tilt(degrees: Any) -> np.ndarray:
    """`[4, n]` quaternions of turns about y, x ahead to z down [deg]."""
    half = np.radians(np.atleast_1d(degrees)) / 2
    return np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half])


def forces(robot: Robot, velocity: Any, degrees: Any = 0.0, flow: Water | None = None) -> Any:
    """Forces on a body that is held, or moves steadily.

    Args:
        robot: a single box.
        velocity: `[3, n]` of the body, world frame [m/s].
        degrees: `[n]` or a number: turn about y [deg].
        flow: the water; still by default.

    Returns:
        `[3, n]` its mass times its acceleration: all forces of the water, world frame [N].
    """
    velocity = np.asarray(velocity, float)
    lanes = velocity.shape[1]
    qpos, qvel = at_rest(robot, lanes, -5.0)
    qpos[3:7] = np.broadcast_to(tilt(degrees), (4, lanes))
    qvel[:3] = velocity
    still = Water(0.0, (0.0, 0.0, 0.0))

    def run(qpos: Any, qvel: Any, water: Water) -> Any:
        return robot_acceleration(robot, qpos, qvel, jnp.zeros((0, lanes)), water)

    with jax.enable_x64(True):
        water = jax.tree.map(jnp.asarray, still if flow is None else flow)
        found = jax.jit(run, compiler_options=quick_options())(
            jnp.asarray(qpos), jnp.asarray(qvel), water
        )
        return float(robot.mj_model.body_mass.sum()) * np.asarray(found)[:3]


# ------------------------------------------------------------------------- steady drag


def steady_drag(law: str = "faces", speed: float = 0.3) -> Found:
    """C_d on the frontal area of plates, rods and a torpedo, by one of the laws."""
    world, rows = tank(drag=law), []
    for what, (name, angle, area, measured) in data.STEADY_DRAG.items():
        robot = body(name, world)
        push = -forces(robot, [[speed], [0.0], [0.0]], angle)[0, 0]
        ours = push / (0.5 * world.density * speed**2 * area)
        rows.append(Row("steady drag", what, measured, ours, "-"))
    lines: dict[Any, Any] = {}
    angles = np.linspace(0.0, 45.0, 19)
    robot = body("SquareRod", world)
    turn, edge = np.radians(angles), sizes(robot)
    push = -forces(robot, np.outer([speed, 0, 0], np.ones_like(angles)), angles)[0]
    frontal = edge[1] * (edge[2] * np.cos(turn) + edge[0] * np.sin(turn))
    lines["rod"] = angles, push / (0.5 * world.density * speed**2 * frontal)
    return Found(rows, lines)


def sinking_plate() -> Row:
    """Terminal speed of a square plate that sinks broadside, 1 kg on 0.1 m, by the steps."""
    world = tank(gravity=G, buoyancy="partial", drag="faces", added_mass=True)
    robot = body("SquarePlate", world)
    edge = sizes(robot)
    qpos, qvel = at_rest(robot, 1, -5.0)
    qpos[3:7] = tilt(90.0)  # its face down
    speed = -march(robot, 3.0, qpos, qvel, every=100)[2][-1, 2, 0]
    weight = G * (float(robot.mj_model.body_mass.sum()) - world.density * float(np.prod(edge)))
    measured = np.sqrt(2 * weight / (world.density * 1.16 * edge[1] * edge[2]))
    return Row("steady drag", "square plate that sinks broadside", measured, speed, "m/s")


# ------------------------------------------------------------------------- plates at an angle


def polars(speed: float = 0.5) -> Found:
    """Lift and drag coefficients of flat plates over their angle of attack."""
    world, rows, lines = tank(drag="lift_drag"), [], {}
    for polar in data.POLARS:
        robot = body(polar.module, world)
        edge = sizes(robot)
        angles = np.union1d(np.linspace(0.0, 90.0, 181), polar.angle)
        # Nose up by a negative turn about y, towards +x.
        push = forces(robot, np.outer([speed, 0, 0], np.ones_like(angles)), -angles)
        scale = 0.5 * world.density * speed**2 * edge[0] * edge[1]
        lines[polar.module, "lift"] = angles, push[2] / scale
        lines[polar.module, "drag"] = angles, -push[0] / scale
        for angle, lift, drag in zip(polar.angle, polar.lift, polar.drag, strict=True):
            if angle in (10, 20, 25):
                for what, value in (("lift", lift), ("drag", drag)):
                    ours = float(np.interp(angle, *lines[polar.module, what]))
                    name = f"{what}, aspect {polar.aspect:g}, {angle}°"
                    rows.append(Row("plates at an angle", name, value, ours, "-"))
    return Found(rows, lines)


# ------------------------------------------------------------------------- coins that fall

DROPS = 64
TILT = 5.0  # by which they may be off the level when let go, standard deviation [deg]; a choice


def fall(coin: data.Coin) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drops of a coin in 38 cm of water.

    Args:
        coin: which.

    Returns:
        `[T]` time [s], `[T]` depth of the mean track [m], `[DROPS]` how far from where they were
        let go they land [m].
    """
    world = tank(
        gravity=G, buoyancy="partial", drag="faces", added_mass=True, density=998.0,
        timestep=0.001,
    )  # fmt: skip
    robot, draw = body(coin.module, world), np.random.default_rng(0)
    qpos, qvel = at_rest(robot, DROPS, -float(sizes(robot)[2]))
    qpos[4:6] = np.radians(TILT) / 2 * draw.normal(size=(2, DROPS))
    qpos[3:7] /= np.linalg.norm(qpos[3:7], axis=0)
    time, q, *_ = march(robot, 1.5, qpos, qvel, every=5)
    depth, away = -q[:, 2], np.hypot(q[:, 0], q[:, 1])
    landed = [np.interp(0.38, d, a) for d, a in zip(depth.T, away.T, strict=True)]
    return time, depth.mean(1), np.array(landed)


def coins() -> Found:
    """How fast coins fall, and how far from the plumb line they land."""
    rows = []
    for coin in data.COINS:
        time, depth, landed = fall(coin)
        first, last = np.interp((0.1, 0.3), depth, time)
        name = coin.module.removeprefix("Coin")
        rows.append(Row(_COIN, f"speed, {name} Kč", coin.speed, 0.2 / (last - first), "m/s"))
        away = 100 * float(np.median(landed))
        rows.append(Row(_COIN, f"landing, {name} Kč", coin.landing, away, "cm"))
    return Found(rows)


_COIN = "coins that fall"


# ------------------------------------------------------------------------- oscillating plates


def oscillating(numbers: Sequence[float] = (3, 5, 8, 15, 30, 60, 120), phases: int = 256) -> Found:
    """C_d of a plate across an oscillating flow, by its Keulegan-Carpenter number U T / b."""
    world = tank(gravity=G, buoyancy="partial", drag="faces", added_mass=True)
    robot = body("OscillatedPlate", world)
    edge, speed = sizes(robot), 0.5
    scale = 0.5 * world.density * edge[1] * edge[2]
    rows, found = [], []
    phase = 2 * np.pi * (np.arange(phases) + 0.5) / phases
    for number in numbers:
        omega = 2 * np.pi * speed / (number * edge[2])
        flow, change = speed * np.sin(phase), speed * omega * np.cos(phase)
        water = Water(0.0, (flow, 0.0, 0.0), (change, 0.0, 0.0))
        push = forces(robot, np.zeros((3, phases)), flow=water)[0]
        # As Keulegan and Carpenter: a term in phase with |U| U and one with the acceleration.
        terms = np.stack([scale * np.abs(flow) * flow, change], -1)
        ours = np.linalg.lstsq(terms, push, rcond=None)[0][0]
        found.append(ours)
        if number in (5, 8, 15, 30, 60):
            name = f"C_d of a plate, U T / b = {number:g}"
            rows.append(Row("oscillating plate", name, data.plate_drag(number), ours, "-"))
    return Found(rows, {"faces": (np.asarray(numbers, float), np.array(found))})


# ------------------------------------------------------------------------- BlueROV2 Heavy

_AXES = {"surge": 0, "sway": 1, "heave": 2}


def rov() -> Found:
    """Drag and added mass of a remotely operated vehicle, from its outer box alone."""
    world = tank(drag="faces", added_mass=False)
    robot = body("BlueRov2Heavy", world)
    added, _ = carried(body("BlueRov2Heavy", tank(added_mass=True)))
    speeds = np.linspace(0.0, 1.2, 25)
    rows, lines = [], {}
    for name, axis in _AXES.items():
        linear, square = data.ROV_DRAG[name]
        push = -forces(robot, np.outer(np.eye(3)[axis], speeds))[axis]
        lines[name] = speeds, push
        for speed in (0.3, 1.0):
            theirs = (linear + square * speed) * speed
            ours = float(np.interp(speed, speeds, push))
            rows.append(Row("BlueROV2", f"drag in {name}, {speed:g} m/s", theirs, ours, "N"))
    for name, axis in _AXES.items():
        theirs = data.ROV_ADDED_MASS[name]
        rows.append(Row("BlueROV2", f"added mass in {name}", theirs, float(added[axis]), "kg"))
    return Found(rows, lines)


# ------------------------------------------------------------------------- a ship's section


def wavelength(xi: float) -> float:
    """Of the flume's wave of ξ = ω² B / 2 g [m]."""
    deep, depth = 2 * xi / data.SECTION_BREADTH, data.FLUME_DEPTH  # ω²/g = k tanh(k h)
    k = deep
    for _ in range(60):
        k = deep / np.tanh(k * depth)
    return float(2 * np.pi / k)


def _flume(**fields: Any) -> World:
    return tank(
        gravity=G, buoyancy="partial", drag="faces", added_mass=True, density=1000.0, **fields
    )


def _pitch(qpos: np.ndarray) -> np.ndarray:
    """Turn about y of `[T, nq, 1]` poses [rad]."""
    return 2 * np.arctan2(qpos[:, 5, 0], qpos[:, 3, 0])


_SHIP = "ship's section"
# The box's centre lies this far below the surface at a draught of 0.2 m.
_SUNK = 0.2 - 0.256 / 2


def section_periods() -> list[Row]:
    """Natural periods in heave and roll, from decays."""
    robot = body("ShipSection", _flume())
    rows = []
    for name, height, turn in (("heave", 0.02, 0.0), ("roll", 0.0, 8.0)):
        qpos, qvel = at_rest(robot, 1, height - _SUNK)
        qpos[3:7] = tilt(turn)
        time, q, *_ = march(robot, 12.0, qpos, qvel)
        way = q[:, 2, 0] if name == "heave" else _pitch(q)
        ours = 2 * np.pi / frequency(time, way)
        rows.append(Row(_SHIP, f"period in {name}", data.SECTION_PERIODS[name], ours, "s"))
    return rows


def section_in_waves(xi: float, duration: float = 90.0) -> tuple[float, float]:
    """Amplitudes of the section in heave [mm] and roll [deg], over the last ten periods."""
    waves = [{"amplitude": data.WAVE_AMPLITUDE, "wavelength": wavelength(xi)}]
    robot = body("ShipSection", _flume(waves=waves, water_depth=data.FLUME_DEPTH))
    omega = np.sqrt(2 * xi * G / data.SECTION_BREADTH)
    time, q, *_ = march(robot, duration, *at_rest(robot, 1, -_SUNK), every=4)
    last = time > duration - 10 * 2 * np.pi / omega
    # What drifts meets the waves a little less often: their frequency is fitted, too.
    best = (np.inf, 0.0, 0.0)
    for shift in np.linspace(0.9, 1.05, 61):
        turn = omega * shift * time[last]
        basis = np.stack([np.cos(turn), np.sin(turn), np.ones_like(turn), turn], -1)
        amplitudes, left = [], 0.0
        for way in (1e3 * q[last, 2, 0], np.degrees(_pitch(q[last]))):
            fit, rest, *_ = np.linalg.lstsq(basis, way, rcond=None)
            amplitudes.append(float(np.hypot(fit[0], fit[1])))
            left += float(rest[0])
        best = min(best, (left, *amplitudes))
    return best[1], best[2]


def section(steps: Sequence[float] | None = None) -> Found:
    """Natural periods, and amplitudes in regular waves, of a ship's section in a flume."""
    if steps is None:
        steps = (0.2, 0.25, 0.3, 0.34, 0.37, 0.4, 0.42, 0.44, 0.46, 0.48, 0.5, 0.525, 0.55, 0.6,
                 0.7, 0.85, 1.0, 1.25, 1.5, 1.75)  # fmt: skip
    rows = section_periods()
    found = {xi: section_in_waves(xi) for xi in steps}
    for motion in data.SECTION_FREE:
        if motion.xi in found and motion.roll is not None:
            heave, roll = found[motion.xi]
            at = f"at ξ = {motion.xi:g}"
            rows.append(Row(_SHIP, f"heave {at}", motion.heave, heave, "mm"))
            rows.append(Row(_SHIP, f"roll {at}", motion.roll, roll, "deg"))
    xi = np.array(sorted(found))
    values = np.array([found[x] for x in xi])
    return Found(rows, {"heave": (xi, values[:, 0]), "roll": (xi, values[:, 1])})
