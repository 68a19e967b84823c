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
from mjx_revolve.engine.engines import make_engine
from mjx_revolve.engine.population import robot_acceleration
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.numerics.spatial import vsub
from mjx_revolve.water.flow import Water
from mjx_revolve.water.world import World

G = 9.81
LAWS = (World.drag, "faces", "ellipsoid", "inertia_box")
"""Of drag: ours by default, ours of faces, and MuJoCo's two."""


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


def body(name: str, world: World, links: str = "", count: int = 0) -> Robot:
    """A robot that is one module of measured.yaml, or a chain with `count` links behind it."""
    chain: dict[str, Any] = {}
    for k in reversed(range(count)):
        chain = {"children": {1: {"id": f"link{k}", "type": links} | chain}}
    tree = {"id": "core", "type": name} | chain
    return build_robot(make_morphology({"id": name, "body": tree}, modules=_types()), world)


def sizes(robot: Robot) -> np.ndarray:
    """`[3]` edges of its box [m]."""
    return np.asarray(robot.morphology.modules[0].kind.parts[0].boxes[0].size)


def tilt(degrees: Any) -> np.ndarray:
    """`[4, n]` quaternions of turns about y, x ahead to z down [deg]."""
    half = np.radians(np.atleast_1d(degrees)) / 2
    return np.stack([np.cos(half), 0 * half, np.sin(half), 0 * half])


def forces(robot: Robot, velocity: Any, degrees: Any = 0.0, flow: Water | None = None) -> Any:
    """Forces on a body that is held, or moves steadily: the first three of `loads` [N]."""
    return loads(robot, velocity, degrees, flow=flow)[:3]


def loads(
    robot: Robot, velocity: Any, degrees: Any = 0.0, turning: Any = 0.0, flow: Water | None = None
) -> Any:
    """Forces and torques on a body whose motion is prescribed.

    Args:
        robot: a single box without carried water.
        velocity: `[3, n]` of the body, world frame [m/s].
        degrees: `[n]` or a number: turn about y [deg].
        turning: likewise: how fast it turns about y [rad/s].
        flow: the water; still by default.

    Returns:
        `[4, n]` its mass times its acceleration: all forces of the water, world frame [N], and
        torque about y at its centre [N·m].
    """
    velocity = np.asarray(velocity, float)
    lanes = velocity.shape[1]
    qpos, qvel = at_rest(robot, lanes, -5.0)
    qpos[3:7] = np.broadcast_to(tilt(degrees), (4, lanes))
    qvel[:3], qvel[4] = velocity, turning
    still = Water(0.0, (0.0, 0.0, 0.0))

    def run(qpos: Any, qvel: Any, water: Water) -> Any:
        return robot_acceleration(robot, qpos, qvel, jnp.zeros((0, lanes)), water)

    with jax.enable_x64(True):
        water = jax.tree.map(jnp.asarray, still if flow is None else flow)
        found = jax.jit(run, compiler_options=quick_options())(
            jnp.asarray(qpos), jnp.asarray(qvel), water
        )
        model = robot.mj_model
        weights = [float(model.body_mass.sum())] * 3 + [float(model.body_inertia[1, 1])]
        return np.array(weights)[:, None] * np.asarray(found)[[0, 1, 2, 4]]


def driven(
    robot: Robot, velocity: np.ndarray, degrees: Any = 0.0, turning: Any = 0.0
) -> np.ndarray:
    """Forces and torques on a body that is moved, step by step, so that laws remember its way.

    Args:
        robot: a single box without carried water, so heavy that the water does not move it.
        velocity: `[T, 3, lanes]` of its centre at the beginning of each step, world frame [m/s].
        degrees: `[T, lanes]` or a number: turn about y then [deg].
        turning: likewise: how fast it turns about y [rad/s].

    Returns:
        `[T, 4, lanes]` as `loads`.
    """
    steps, _, lanes = velocity.shape
    model, dt = robot.mj_model, robot.world.timestep
    engine, water = make_engine(robot), Water(0.0, (0.0, 0.0, 0.0))
    weights = np.array([float(model.body_mass.sum())] * 3 + [float(model.body_inertia[1, 1])])

    def push(state: Any, given: Any) -> Any:
        velocity, quat, rate = given
        still = jnp.zeros_like(rate)
        state = state._replace(
            position=(still, still, still - 5),
            quat=tuple(quat),
            velocity=tuple(velocity),
            angular_velocity=(still, rate, still),
        )
        new, _ = engine.step(state, jnp.zeros((0, lanes)), water)
        change = [*vsub(new.velocity, state.velocity), new.angular_velocity[1] - rate]
        return new, jnp.stack(change) / dt

    with jax.enable_x64(True):
        wide = lambda x: np.broadcast_to(np.asarray(x, float), (steps, lanes))  # noqa: E731
        quats = np.moveaxis(tilt(wide(degrees).ravel()).reshape(4, steps, lanes), 0, 1)
        start = engine.init(*map(jnp.asarray, at_rest(robot, lanes, -5.0)))
        given = tuple(map(jnp.asarray, (velocity, quats, wide(turning))))
        run = jax.jit(lambda start, given: jax.lax.scan(push, start, given)[1],
                      compiler_options=quick_options())  # fmt: skip
        return weights[:, None] * np.asarray(run(start, given))


# ------------------------------------------------------------------------- steady drag


def steady_drag(law: str = World.drag, speed: float = 0.3) -> Found:
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


def sinking_plate(drag: str = World.drag) -> Row:
    """Terminal speed of a square plate that sinks broadside, 1 kg on 0.1 m, by the steps."""
    world = tank(gravity=G, buoyancy="partial", drag=drag, added_mass=True)
    robot = body("SquarePlate", world)
    edge = sizes(robot)
    qpos, qvel = at_rest(robot, 1, -5.0)
    qpos[3:7] = tilt(90.0)  # its face down
    speed = -march(robot, 3.0, qpos, qvel, every=100)[2][-1, 2, 0]
    weight = G * (float(robot.mj_model.body_mass.sum()) - world.density * float(np.prod(edge)))
    measured = np.sqrt(2 * weight / (world.density * 1.16 * edge[1] * edge[2]))
    return Row("steady drag", "square plate that sinks broadside", measured, speed, "m/s")


# ------------------------------------------------------------------------- plates at an angle


def polars(speed: float = 0.5, drag: str = World.drag) -> Found:
    """Lift and drag coefficients of flat plates over their angle of attack."""
    world, rows, lines = tank(drag=drag), [], {}
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


def fall(coin: data.Coin, drag: str = World.drag) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Drops of a coin in 38 cm of water.

    Args:
        coin: which.
        drag: the law.

    Returns:
        `[T]` time [s], `[T]` depth of the mean track [m], `[DROPS]` how far from where they were
        let go they land [m].
    """
    world = tank(
        gravity=G, buoyancy="partial", drag=drag, added_mass=True, density=998.0,
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


def coins(drag: str = World.drag) -> Found:
    """How fast coins fall, and how far from the plumb line they land."""
    rows = []
    for coin in data.COINS:
        time, depth, landed = fall(coin, drag)
        first, last = np.interp((0.1, 0.3), depth, time)
        name = coin.module.removeprefix("Coin")
        rows.append(Row(_COIN, f"speed, {name} Kč", coin.speed, 0.2 / (last - first), "m/s"))
        away = 100 * float(np.median(landed))
        rows.append(Row(_COIN, f"landing, {name} Kč", coin.landing, away, "cm"))
    return Found(rows)


_COIN = "coins that fall"


# ------------------------------------------------------------------------- oscillating plates


def oscillating(
    numbers: Sequence[float] = (3, 5, 8, 15, 30, 60, 120),
    drag: str = World.drag,
    speed: float = 0.5,
    settle: float = 12.0,
) -> Found:
    """C_d of a plate that swings across still water, by its Keulegan-Carpenter number U T / b.

    Args:
        numbers: Keulegan-Carpenter numbers.
        drag: the law.
        speed: the plate's largest [m/s].
        settle: before the periods that are looked at [s].
    """
    world = tank(drag=drag)
    robot = body("OscillatedPlate", world)
    edge, dt = sizes(robot), world.timestep
    scale = 0.5 * world.density * edge[1] * edge[2]
    rows, found = [], []
    omega = 2 * np.pi * speed / (np.asarray(numbers, float) * edge[2])
    steps = round((settle + 4 * np.pi / omega.min()) / dt)
    time = dt * np.arange(steps)
    moves = speed * np.sin(np.outer(time, omega))
    pushes = driven(robot, np.stack([moves, 0 * moves, 0 * moves], 1))[:, 0]
    for k, number in enumerate(numbers):
        last = time > time[-1] - 4 * np.pi / omega[k]  # two periods
        move, change = moves[last, k], speed * omega[k] * np.cos(omega[k] * time[last])
        # As Keulegan and Carpenter: a term in phase with |U| U and one with the acceleration.
        terms = np.stack([scale * np.abs(move) * move, change], -1)
        ours = -np.linalg.lstsq(terms, pushes[last, k], rcond=None)[0][0]
        found.append(ours)
        if number in (3, 5, 8, 15, 30, 60):
            name, bilge = f"C_d of a plate, U T / b = {number:g}", data.plate_drag_at_bilge(number)
            rows.append(Row("oscillating plate", name, data.plate_drag(number), ours, "-"))
            rows.append(Row("oscillating plate", f"{name}, bilge keels", bilge, ours, "-"))
    return Found(rows, {drag: (np.asarray(numbers, float), np.array(found))})


# ------------------------------------------------------------------------- swimming chains

_SAMPLES = 20  # steps from one record to the next


def make_pool(drag: str = World.drag, timestep: float = 0.001) -> World:
    """The water of a pool around robots that float."""
    return tank(gravity=G, buoyancy="partial", drag=drag, added_mass=True, timestep=timestep)


_pool = make_pool  # as tests call it


def _floating(robot: Robot) -> float:
    """Height of the middle of a chain's boxes at which it floats [m]; neutral ones lie 1 m deep."""
    relative = robot.morphology.mass / (robot.world.density * robot.morphology.volume)
    return -1.0 if relative > 0.995 else float(sizes(robot)[2]) * (0.5 - relative)


def swim(
    robot: Robot, gaits: Sequence[data.Gait], shares: Any = 1.0, settle: float = 5.0
) -> tuple[np.ndarray, float]:
    """Speeds of a chain whose joints do what gaits prescribe.

    Args:
        robot: the chain, its core the head.
        gaits: one for each lane.
        shares: `[joints, lanes]` of the gaits' amplitudes, or a number.
        settle: before windows begin [s]; they end ten periods and as much later.

    Returns:
        `[gaits]` median over windows of two periods of the head's displacement in them over their
        time [m/s], and the largest error of a joint over its amplitude, after `settle` [-].
    """
    frequency, amplitude, lag = np.array([(g.frequency, g.amplitude, g.lag) for g in gaits]).T
    joint = np.arange(robot.num_hinges)[:, None]
    size = np.radians(amplitude) * shares

    def angles(time: Any) -> np.ndarray:
        """`[T, joints, lanes]` [rad]."""
        turns = frequency * np.asarray(time)[:, None, None] - joint * lag
        return size * np.sin(2 * np.pi * turns)

    dt = robot.world.timestep
    count = round((settle + 10 / frequency.min()) / dt / _SAMPLES) * _SAMPLES
    targets = angles(dt * np.arange(1, count + 1))
    qpos, qvel = at_rest(robot, len(gaits), _floating(robot))
    qpos[7:] = angles([0.0])[0]
    qvel[6:] = (angles([1e-4])[0] - angles([-1e-4])[0]) / 2e-4
    time, q, *_ = march(robot, count * dt, qpos, qvel, targets, every=_SAMPLES)
    late = time > settle
    error = np.abs(q[:, 7:] - angles(time))[late] / size
    speeds = []
    for k, rate in enumerate(frequency):
        window = round(2 / rate / (dt * _SAMPLES))
        way = np.hypot(*(q[late][window:, :2, k] - q[late][:-window, :2, k]).T)
        speeds.append(np.median(way) / (window * dt * _SAMPLES))
    return np.array(speeds), float(np.nanmax(np.where(size > 0, error, 0.0)))


def amphibot_glide(drag: str = World.drag) -> Found:
    """Way and rotation of a chain with frozen joints that glides at the surface."""
    glide, robot = data.AMPHIBOT_GLIDE, body("ChainHead", make_pool(drag), "ChainModule", 6)
    angles, half = np.radians(glide.angles), data.CHAIN_MODULE / 2

    def marks(q: np.ndarray) -> np.ndarray:
        """`[T, 2]` mean of the marks: modules' middles, and hinges between them [m]."""
        along = 2 * np.arctan2(q[:, 6, 0], q[:, 3, 0])
        place, found = q[:, :2, 0], [q[:, :2, 0]]
        for k in range(len(angles)):
            for turn in (0.0, angles[k]):  # to the hinge, and on to the next middle
                along = along + turn
                place = place + half * np.stack([np.cos(along), np.sin(along)], 1)
                found.append(place)
        return np.mean(found, 0)

    qpos, qvel = at_rest(robot, 1, _floating(robot))
    start = np.radians(glide.heading)
    qpos[3], qpos[6], qpos[7:] = np.cos(start / 2), np.sin(start / 2), angles[:, None]
    rate = np.radians(glide.turning)
    arm = marks(qpos[None])[0] - qpos[:2, 0]
    qvel[:2, 0] = glide.velocity - rate * np.array([-arm[1], arm[0]])
    qvel[5] = rate
    time, q, *_ = march(robot, glide.time[-1] + 0.1, qpos, qvel, angles[:, None])
    way = np.linalg.norm(marks(q) - marks(qpos[None]), axis=1)
    rotation = np.degrees(2 * np.unwrap(np.arctan2(q[:, 6, 0], q[:, 3, 0])) - start)
    rows = []
    for what, theirs, ours, unit in (
        ("way", glide.way, way, "m"),
        ("rotation", glide.rotation, rotation, "deg"),
    ):
        for at, value in zip(glide.time, theirs, strict=True):
            found = float(np.interp(at, time, ours))
            rows.append(Row("AmphiBot", f"glide, {what} after {at:g} s", value, found, unit))
    return Found(rows, {"way": (time, way), "rotation": (time, rotation)})


def swimmers(drag: str = World.drag) -> Found:
    """Speeds of chains that swim by their joints: AmphiBot, the lamprey robot, Mamba's ratio."""
    gait, pool = data.AMPHIBOT_SWIM, make_pool(drag)
    [speed], _ = swim(body("ChainHead", pool, "ChainModule", 6), [gait])
    rows = [Row("AmphiBot", "swim", gait.speed, speed, "m/s")]
    speeds, _ = swim(body("ChainHead", pool, "ChainModule", 5), data.LAMPREY)
    for gait, ours in zip(data.LAMPREY, speeds, strict=True):
        name = f"{gait.amplitude:g}°, φ {5 * gait.lag:.3g}"
        rows.append(Row("lamprey robot", name, gait.speed, ours, "m/s"))
    joint = np.arange(8, 0, -1)[:, None]  # from the head; 1 is at the tail
    shares = np.concatenate([np.ones((8, 1)), (9 - joint) / 10], 1)
    gait = data.Gait(1 / 3, 40.0, 1 / 9, 0.0)
    mamba = body("MambaHead", make_pool(drag, 0.004), "MambaLink", 8)
    speeds, _ = swim(mamba, [gait, gait], shares, 15.0)
    measured = data.MAMBA["eel-like"] / data.MAMBA["lateral"]
    rows.append(Row("Mamba", "eel-like over lateral speed", measured, speeds[1] / speeds[0], "-"))
    return Found(rows)


def log_scatter(rows: Sequence[Row]) -> tuple[float, float]:
    """Bias and scatter of rows: mean ratio and standard deviation, both of its logarithm [-]."""
    ratio = np.log([row.ratio for row in rows])
    return float(np.exp(ratio.mean())), float(ratio.std(ddof=1))


# ------------------------------------------------------------------------- a flapping foil


def foil(drag: str = World.drag, phases: int = 512, periods: int = 6) -> list[Row]:
    """Thrust and efficiency of a towed foil that heaves and pitches, in its last period.

    Its added mass is left out: in a motion that repeats, its mean force and power are 0.
    """
    rows = []
    speed, heave = data.FOIL_SPEED, data.FOIL_HEAVE
    phase = 2 * np.pi * (np.arange(periods * phases) + 0.5) / phases
    for case in data.FLAPPING:
        omega = np.pi * case.strouhal * speed / heave
        world = tank(drag=drag, timestep=2 * np.pi / omega / phases)
        robot = body("FlappingFoil", world)
        chord, span, _ = sizes(robot)
        behind, scale = (0.5 - data.FOIL_PIVOT) * chord, 0.5 * world.density * speed**2
        scale *= chord * span
        most = np.arctan(np.pi * case.strouhal) - np.radians(case.angle)
        rising = omega * heave * np.cos(phase)
        pitch, rate = most * np.cos(phase), -most * omega * np.sin(phase)  # nose up
        # The centre lies behind the pivot; turns about y are nose down.
        velocity = np.stack([speed + 0 * phase, 0 * phase, rising])
        velocity += behind * rate * np.stack([np.sin(pitch), 0 * pitch, -np.cos(pitch)])
        whole = driven(robot, velocity.T[..., None], -np.degrees(pitch)[:, None], -rate[:, None])
        push, (pitch, rate, rising) = (
            whole[-phases:, :, 0].T,
            (x[-phases:] for x in (pitch, rate, rising)),
        )
        thrust = push[0].mean()
        power = -(push[2] * rising).mean()
        power += (rate * (push[3] - behind * (push[0] * np.sin(pitch) - push[2] * np.cos(pitch)))
                  ).mean()  # fmt: skip
        rows.append(Row(_FOIL, f"C_T, {case.who}", case.thrust, thrust / scale, "-"))
        rows.append(Row(_FOIL, f"η, {case.who}", case.efficiency, thrust * speed / power, "-"))
        theirs, ours = case.thrust / case.efficiency, power / speed / scale
        rows.append(Row(_FOIL, f"C_P, {case.who}", theirs, ours, "-"))
    return rows


_FOIL = "flapping foil"


# ------------------------------------------------------------------------- BlueROV2 Heavy

_AXES = {"surge": 0, "sway": 1, "heave": 2}


def rov() -> Found:
    """Drag and added mass of a remotely operated vehicle, from its outer box alone."""
    world = tank(drag=World.drag, added_mass=False)
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
        gravity=G, buoyancy="partial", drag=World.drag, added_mass=True, density=1000.0, **fields
    )


def _pitch(qpos: np.ndarray) -> np.ndarray:
    """Turn about y of `[T, nq, 1]` poses [rad]."""
    return 2 * np.arctan2(qpos[:, 5, 0], qpos[:, 3, 0])


_SHIP = "ship's section"
# The box's centre lies this far below the surface at a draught of 0.2 m.
_SUNK = 0.2 - 0.256 / 2


def section_periods(near_surface: bool = False) -> list[Row]:
    """Natural periods in heave and roll, from decays."""
    robot = body("ShipSection", _flume(near_surface=near_surface))
    rows = []
    for name, height, turn in (("heave", 0.02, 0.0), ("roll", 0.0, 8.0)):
        qpos, qvel = at_rest(robot, 1, height - _SUNK)
        qpos[3:7] = tilt(turn)
        time, q, *_ = march(robot, 12.0, qpos, qvel)
        way = q[:, 2, 0] if name == "heave" else _pitch(q)
        if near_surface:  # it dies down soon, so that what is left at the end is its rest
            way = way - way[-1]
            k = np.flatnonzero(np.diff(np.sign(way)))[:4]
            crossings = time[k] - way[k] * (time[k + 1] - time[k]) / (way[k + 1] - way[k])
            ours = float(2 * np.mean(np.diff(crossings)))
        else:
            ours = 2 * np.pi / frequency(time, way)
        rows.append(Row(_SHIP, f"period in {name}", data.SECTION_PERIODS[name], ours, "s"))
    return rows


def section_in_waves(
    xi: float, duration: float = 90.0, near_surface: bool = False
) -> tuple[float, float]:
    """Amplitudes of the section in heave [mm] and roll [deg], over the last ten periods."""
    waves = [{"amplitude": data.WAVE_AMPLITUDE, "wavelength": wavelength(xi)}]
    robot = body(
        "ShipSection", _flume(waves=waves, water_depth=data.FLUME_DEPTH, near_surface=near_surface)
    )
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


def section(steps: Sequence[float] | None = None, near_surface: bool = False) -> Found:
    """Natural periods, and amplitudes in regular waves, of a ship's section in a flume."""
    if steps is None:
        steps = (0.2, 0.25, 0.3, 0.34, 0.37, 0.4, 0.42, 0.44, 0.46, 0.48, 0.5, 0.525, 0.55, 0.6,
                 0.7, 0.85, 1.0, 1.25, 1.5, 1.75)  # fmt: skip
    rows = section_periods(near_surface)
    found = {xi: section_in_waves(xi, near_surface=near_surface) for xi in steps}
    for motion in data.SECTION_FREE:
        if motion.xi in found and motion.roll is not None:
            heave, roll = found[motion.xi]
            at = f"at ξ = {motion.xi:g}"
            rows.append(Row(_SHIP, f"heave {at}", motion.heave, heave, "mm"))
            rows.append(Row(_SHIP, f"roll {at}", motion.roll, roll, "deg"))
    xi = np.array(sorted(found))
    values = np.array([found[x] for x in xi])
    return Found(rows, {"heave": (xi, values[:, 0]), "roll": (xi, values[:, 1])})
