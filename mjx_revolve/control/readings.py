"""True sensor readings from the engine's state, at the core and at modules, for every engine.

One function computes the readings at the core, at one module, and at a type of modules, from the
pose and the motion of the frame there.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from mjx_revolve.control.courses import Course
from mjx_revolve.control.pursuit import Pursuer, PursuitLimits, init_pursuer, step_pursuer
from mjx_revolve.engine.engine import Engine
from mjx_revolve.engine.interaction import NO_NEIGHBOUR, InteractionForces
from mjx_revolve.engine.plant import Plant
from mjx_revolve.engine.sites import Sites
from mjx_revolve.engine.state import RootState
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import (
    Mat,
    Scalar,
    Vec,
    cross,
    dot,
    matmul,
    matTvec,
    matvec,
    quat_to_mat,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.water.bed import bed_height
from mjx_revolve.water.flow import Water, flow
from mjx_revolve.water.world import World

OPTIONAL_SIGNALS = ("force", "load", "work", "touch", "nearest", "forces", "cells")
"""Readings that cost something: computed only for a `Controller` that names them in `signals`.

Most are fields of `SensorReadings`; `forces` is `force` at modules. Modules are signals, too: "at
ID" is a module of one robot, "each TYPE" all modules of a type, in `SensorReadings.modules` by that
name.
"""
NO_INTERACTION = InteractionForces()
"""Each robot has a world to itself."""
_GRAVITY = 9.81  # of accelerometers where there is no world [m/s²]


def is_module_signal(name: str) -> bool:
    """Whether a signal names modules: "at ID" or "each TYPE"."""
    return name.startswith(("at ", "each "))


class EpisodeContext(NamedTuple):
    """Inputs of sensors that belong to the episode rather than the robot, `[lanes]` each or None.

    Attributes:
        target: initial position of the target, world frame, three of `[lanes]` [m].
        drift: its velocity [m/s]; None if it does not move.
        noise: seed of sensor noise, uint32 `[lanes]`, the same for all individuals in a trial.
        sight: distance from which the target is visible [m]; None for any.
        pursuit: speed and turning rate of a target that pursues the robot; None if it does not.
        course: direction to keep to.
    """

    target: Any = None
    drift: Any = None
    noise: jax.Array | None = None
    sight: jax.Array | None = None
    pursuit: PursuitLimits | None = None
    course: Course | None = None

    def target_at(self, time: Scalar) -> Vec:
        """Position of a target that does not pursue the robot, world frame [m], at a time [s]."""
        if self.drift is None:
            return tuple(self.target)
        return vadd(self.target, vscale(time, self.drift))


_NO_CONTEXT = EpisodeContext()


class NearestRobot(NamedTuple):
    """The nearest other robot in the same world.

    Attributes:
        toward: from core to core, core frame, three of `[lanes]` [m]; `NO_NEIGHBOUR` long if there
            is none.
        tag: number that identifies the robot, `[lanes]` [-]; 0 if there is none.
    """

    toward: Vec
    tag: jax.Array


class PreviousMotion(NamedTuple):
    """Motion of the rigid bodies before the last step, `[1 + hinge rows, lanes]` each.

    Attributes:
        velocity: of their origins, world frame [m/s].
        angular_velocity: body frame [rad/s].
    """

    velocity: Vec
    angular_velocity: Vec


class SensorMemory(NamedTuple):
    """Part of the rollout state: values of earlier steps that readings depend on; None if unused.

    Attributes:
        acceleration: of the core over the last step, world frame, three of `[lanes]` [m/s²].
        ctrl: last command, `[n, lanes]` in the plant's order.
        work: done so far, `[lanes]` [J].
        past: motion of all rigid bodies before the last step.
        pursuer: state of a target that pursues the robot.
    """

    acceleration: Vec | None = None
    ctrl: jax.Array | None = None
    work: jax.Array | None = None
    past: PreviousMotion | None = None
    pursuer: Pursuer | None = None


class SensorReadings(NamedTuple):
    """True values at the core, or at modules, before noise, rate and delay of sensors.

    At the core and at one module `[lanes]` each, vectors three of them, in the frame of the core or
    in that of the module's main box (of its moving part). At a type of modules `[1 + hinge rows,
    lanes]`: at the first such module on the core's rigid body, and on the body that each hinge
    moves.

    Attributes:
        height: of the centre above the still surface, negative under water [m].
        climb: vertical velocity [m/s].
        up: the world's vertical [-].
        angular_velocity: [rad/s].
        north: the world's x axis [-]: a compass.
        angle: of the hinges, `[hinge rows, lanes]` in the plant's order, 0 for rows without a
            hinge; of a module its own hinge, None without one [rad].
        speed: angular velocity of the hinges, as `angle` [rad/s].
        flow: velocity of the water relative to the centre [m/s].
        altitude: of the centre above the bed, straight down [m]; infinite without a bed.
        target: from the centre to the target [m]; 0 without one, and beyond its visibility.
        noise: seed of sensor noise, uint32 `[lanes]`; core only.
        force: specific force, the mean acceleration over the last step less gravity's [m/s²];
            optional: see `OPTIONAL_SIGNALS`.
        load: torque of the servos under the last command at the angle now, as `angle` [N·m];
            optional.
        work: done by servos and propellers so far [J]; core only, optional.
        touch: force of contacts on the core's rigid body, then on the body that each hinge moves,
            `[1 + hinge rows, lanes]` [N]; at a module that on its rigid body; optional.
        nearest: the nearest other robot; core only, optional.
        modules: readings at modules, by signal; core only.
        course: direction to keep to, a unit vector; 0 without; core only.
        seen: whether the target is visible, `[lanes]`; None if it always is.
        present: 1 where there is a module of the type, else 0; modules only.
        cells: normal force of contacts on the left and the right half of one module [N]; optional.
    """

    height: jax.Array
    climb: jax.Array
    up: Vec
    angular_velocity: Vec
    north: Vec | None = None
    angle: jax.Array | None = None
    speed: jax.Array | None = None
    flow: Vec | None = None
    altitude: jax.Array | None = None
    target: Vec | None = None
    noise: jax.Array | None = None
    force: Vec | None = None
    load: jax.Array | None = None
    work: jax.Array | None = None
    touch: jax.Array | None = None
    nearest: NearestRobot | None = None
    modules: Any = None
    course: Vec | None = None
    seen: jax.Array | np.ndarray | None = None
    present: jax.Array | None = None
    cells: tuple[jax.Array, jax.Array] | None = None

    @property
    def spin(self) -> Vec:
        """Old name of `angular_velocity`, for one more release."""
        return self.angular_velocity

    @property
    def places(self) -> Any:
        """Old name of `modules`, for one more release."""
        return self.modules


class _Frame(NamedTuple):
    """Pose and motion of the core or of modules, `[..., lanes]` each.

    Attributes:
        position: world frame [m].
        rotation: world from module.
        velocity: world frame [m/s].
        angular_velocity: module frame [rad/s].
        acceleration: over the last step, world frame [m/s²]; None if not computed.
    """

    position: Vec
    rotation: Mat
    velocity: Vec
    angular_velocity: Vec
    acceleration: Vec | None


def _site_frame(
    motion: BodyMotion, past: PreviousMotion | None, timestep: float, sites: Sites
) -> _Frame:
    """The frame of a module, or of a type of modules, from the motion of its rigid body."""
    if sites.row is not None:
        motion, past = jax.tree.map(lambda x: x[sites.row], (motion, past))
    like = motion.height

    def wide(x: Scalar) -> jax.Array:
        return jnp.broadcast_to(_plain(x, like), like.shape)

    offset, local = jax.tree.map(wide, (sites.position, sites.rotation))
    body: Mat = (motion.x_axis, motion.y_axis, motion.z_axis)
    spin = motion.angular_velocity
    acceleration = None
    if past is not None:
        rate = 1 / timestep
        gain = vscale(rate, vsub(matvec(body, motion.velocity), past.velocity))
        turning = vscale(rate, vsub(spin, past.angular_velocity))
        # At the middle of the step, so that the mean over it is accurate to second order.
        middle = vscale(0.5, vadd(spin, past.angular_velocity))
        own = vadd(cross(turning, offset), cross(middle, cross(middle, offset)))
        acceleration = vadd(gain, matvec(body, own))
    return _Frame(
        vadd((*motion.xy, motion.height), matvec(body, offset)),
        matmul(body, local),
        matvec(body, vadd(motion.velocity, cross(spin, offset))),
        matTvec(local, spin),
        acceleration,
    )


def _read_frame(
    world: World | None, water: Water, target: Vec | None, sight: jax.Array | None, frame: _Frame
) -> SensorReadings:
    """The readings that follow from a frame."""
    x, y, z = frame.position
    zero = jnp.zeros_like(z)
    moving: Vec = (zero, zero, zero)
    altitude = zero + jnp.inf
    if world is not None:
        current, _ = flow(world, water, x, y, z)
        moving = matTvec(frame.rotation, vsub(current, frame.velocity))
        if world.bed is not None:
            altitude = z - bed_height(world.bed, x, y)
    toward: Vec = (zero, zero, zero)
    seen = None
    if target is not None:
        toward = matTvec(frame.rotation, vsub(target, frame.position))
        if sight is not None:
            seen = dot(toward, toward) < sight * sight
            toward = tuple(jnp.where(seen, component, 0.0) for component in toward)
    force = None
    if frame.acceleration is not None:
        ahead, aside, rising = frame.acceleration
        gravity = _GRAVITY if world is None else world.gravity
        force = matTvec(frame.rotation, (ahead, aside, rising + gravity))
    return SensorReadings(
        height=z - water.surface_height,
        climb=frame.velocity[2],
        up=frame.rotation[2],
        angular_velocity=frame.angular_velocity,
        north=frame.rotation[0],
        flow=moving,
        altitude=altitude,
        target=toward,
        force=force,
        seen=seen,
    )


def read_sensors(
    world: World | None,
    engine: Engine,
    state: PyTree,
    water: Water,
    time: jax.Array,
    context: EpisodeContext,
    memory: SensorMemory,
    signals: Sequence[str] = (),
    meeting: InteractionForces = NO_INTERACTION,
    motion: BodyMotion | None = None,
) -> SensorReadings:
    """The readings at the core, and at the modules named in `signals`.

    Args:
        world: around the robots; None if no sensor reads water or bed.
        engine: of the robots.
        state: of the engine.
        water: at this time; heights count from its still surface.
        time: since the episode's start [s].
        context: of the episode.
        memory: from `init_memory` or `update_memory`.
        signals: the `OPTIONAL_SIGNALS`, and the modules, that are read.
        meeting: interaction with the other robots of the same world.
        motion: of all rigid bodies; computed if None.

    Raises:
        InputError: there is no such module.
    """
    position, quat, velocity, angular_velocity = engine.root(state)
    rotation = quat_to_mat(quat)
    angle, speed = engine.joints(state)
    zero = jnp.zeros_like(position[2])
    target = None
    if context.target is not None:
        target = context.target_at(time) if memory.pursuer is None else memory.pursuer.position
    frame = _Frame(position, rotation, velocity, angular_velocity, memory.acceleration)
    nearest = None
    if "nearest" in signals:
        lone = meeting.nearest is None
        toward = (zero, zero, zero + NO_NEIGHBOUR) if lone else meeting.nearest
        nearest = NearestRobot(matTvec(rotation, toward), zero if lone else meeting.tag)
    course = context.course
    readings = _read_frame(world, water, target, context.sight, frame)._replace(
        angle=angle,
        speed=speed,
        noise=context.noise,
        load=None if memory.ctrl is None else engine.servo_torque(state, memory.ctrl),
        work=memory.work,
        touch=(engine.contact_force(state, water, meeting.wrench) if "touch" in signals else None),
        nearest=nearest,
        course=(zero, zero, zero) if course is None else matTvec(rotation, course.at(time)),
    )
    names = tuple(filter(is_module_signal, signals))
    if not names:
        return readings
    motion = engine.body_motions(state) if motion is None else motion
    cells = engine.contact_by_half(state, water) if "cells" in signals else None
    modules = {}
    for name in names:
        sites = engine.plant.site(name)
        frame = _site_frame(motion, memory.past, engine.plant.timestep, sites)
        here = _read_frame(world, water, target, context.sight, frame)
        here = here._replace(present=jnp.broadcast_to(_plain(sites.there, zero), here.height.shape))
        if sites.module is not None:
            touch = None if readings.touch is None else readings.touch[sites.row]
            here = here._replace(touch=touch, cells=None if cells is None else cells[sites.module])
        if sites.hinge is not None:
            load = None if readings.load is None else readings.load[sites.hinge]
            hinge = sites.hinge
            here = here._replace(angle=angle[hinge], speed=speed[hinge], load=load)
        modules[name] = here
    return readings._replace(modules=modules)


def _plain(x: Scalar, like: jax.Array) -> Scalar:
    """A NumPy array in the floating-point type of the rollout."""
    return np.asarray(x, like.dtype) if isinstance(x, np.ndarray) else x


def init_memory(
    signals: Sequence[str], engine: Engine, state: PyTree, context: EpisodeContext = _NO_CONTEXT
) -> SensorMemory:
    """The memory before the first step: at rest, no work done, servos commanded to stay.

    Args:
        signals: which of `OPTIONAL_SIGNALS` are read.
        engine: of the robots.
        state: of the engine at the start.
        context: of the episode.
    """
    position = engine.root(state).position
    zero = jnp.zeros_like(position[0])
    angle = engine.joints(state)[0]
    pad = jnp.zeros((engine.plant.num_rows - angle.shape[0], *angle.shape[1:]), angle.dtype)
    pursued = context.pursuit is not None
    return SensorMemory(
        acceleration=(zero, zero, zero) if "force" in signals else None,
        ctrl=jnp.concatenate([angle, pad]) if "load" in signals else None,
        work=zero if "work" in signals else None,
        past=_motion_to_keep(engine.body_motions(state)) if "forces" in signals else None,
        pursuer=init_pursuer(context.target, position) if pursued else None,
    )


def update_memory(
    memory: SensorMemory,
    before: RootState,
    after: RootState,
    ctrl: jax.Array,
    work: jax.Array,
    dt: float,
    motion: BodyMotion | None = None,
    context: EpisodeContext = _NO_CONTEXT,
) -> SensorMemory:
    """The memory after a step.

    Args:
        memory: before it.
        before: core before it.
        after: core after it.
        ctrl: command, `[n, lanes]`.
        work: done in the step, `[lanes]` [J].
        dt: timestep [s].
        motion: of all rigid bodies before it, where specific forces at modules are read.
        context: of the episode.
    """
    acceleration, pursuer = memory.acceleration, memory.pursuer
    if acceleration is not None:
        acceleration = vscale(1 / dt, vsub(after.velocity, before.velocity))
    if pursuer is not None and context.pursuit is not None:
        pursuer = step_pursuer(pursuer, context.pursuit, before.position, dt)
    return SensorMemory(
        acceleration=acceleration,
        ctrl=None if memory.ctrl is None else ctrl,
        work=None if memory.work is None else memory.work + work,
        past=None if motion is None else _motion_to_keep(motion),
        pursuer=pursuer,
    )


def _motion_to_keep(motion: BodyMotion) -> PreviousMotion:
    """The fields of the bodies' motion that the next step's readings depend on."""
    body: Mat = (motion.x_axis, motion.y_axis, motion.z_axis)
    return PreviousMotion(matvec(body, motion.velocity), motion.angular_velocity)


def readings_at_rest(plant: Plant, lanes: int, signals: Sequence[str]) -> SensorReadings:
    """Readings of the right shapes, to check a controller with.

    Raises:
        InputError: there is no such module.
    """
    joints = jnp.zeros((plant.num_hinge_rows, lanes), jnp.float32)
    bodies = jnp.zeros((1 + plant.num_hinge_rows, lanes), jnp.float32)
    core, vector = bodies[0], (bodies,) * 3
    # Of an `Engine`, what readings call.
    engine: Any = SimpleNamespace(
        plant=plant,
        root=lambda *_: RootState((core,) * 3, (core,) * 4, (core,) * 3, (core,) * 3),
        joints=lambda *_: (joints, joints),
        servo_torque=lambda *_: joints,
        contact_force=lambda *_: bodies,
        body_motions=lambda *_: BodyMotion(
            vector, vector, vector, bodies, vector, vector, vector[:2]
        ),
        contact_by_half=lambda *_: defaultdict(lambda: (core, core)),
    )
    context = EpisodeContext(noise=jnp.zeros(lanes, jnp.uint32))
    memory = init_memory(signals, engine, (), context)
    water, time = Water(0.0, (0.0, 0.0, 0.0)), jnp.zeros((), jnp.float32)
    return read_sensors(None, engine, (), water, time, context, memory, signals)
