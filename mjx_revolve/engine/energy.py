"""Energy along a trajectory: what a robot's motors give, and where it goes.

In the frame of the uniform current, from the very forces that a step adds up. As a step is
implicit, they are taken at the places of its beginning and the velocities of its end; over the mean
of the velocities at both ends they then do the work by which a semi-implicit step changes kinetic
energy. What is left closes to the first order of the step. Water that joins a robot at the surface
is taken along by the slam, and water that leaves it keeps its energy: both count as drag.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from mjx_revolve.engine.contact import bed_forces
from mjx_revolve.engine.dynamics import accelerate, inertia_and_momentum
from mjx_revolve.engine.hydrodynamics import ExternalForces, PreviousStep, water_forces
from mjx_revolve.engine.kinematics import forward_kinematics
from mjx_revolve.engine.level import Level
from mjx_revolve.engine.plant import actuators_of
from mjx_revolve.engine.population import actuate, init, tree_plant
from mjx_revolve.engine.robot import Robot
from mjx_revolve.engine.servos import end_stop, motor_torque, spring_damping
from mjx_revolve.engine.single_tree import SingleTree, make_single_tree
from mjx_revolve.engine.state import effective_gravity
from mjx_revolve.engine.variation import Variation
from mjx_revolve.numerics.inertia import BodyMotion
from mjx_revolve.numerics.spatial import (
    Scalar,
    Vec,
    add,
    cross,
    dot,
    matTvec,
    matvec,
    mul,
    neg,
    quat_to_mat,
    sub,
    vadd,
    vscale,
    vsub,
)
from mjx_revolve.numerics.xla import fuse, jit
from mjx_revolve.water.flow import Water, is_uniform
from mjx_revolve.water.world import World

# Rows of a trajectory at the beginning and the end of each of its steps, velocities of a `State`.
_BEGUN, _ENDED = slice(None, -1), slice(1, None)
_RATES = "velocity", "angular_velocity", "speed"


class EnergyBalance(NamedTuple):
    """Energies of an episode [J].

    Attributes:
        work: of servos and thrusters, summed without sign.
        given: the same with its sign.
        kinetic: gained, of the robot and of the water that it carries along.
        potential: gained, by weight and buoyancy.
        drag: lost to the water, to slam and waves, too.
        contact: lost to the bed and to other modules.
        joints: lost in friction and end stops.
    """

    work: float
    given: float
    kinetic: float
    potential: float
    drag: float
    contact: float
    joints: float

    @property
    def residual(self) -> float:
        """What is unaccounted for, as a share of the work, or of what is lost if that is more."""
        lost = self.drag + self.contact + self.joints
        left = self.given - self.kinetic - self.potential - lost
        return abs(left) / max(self.work, abs(lost), 1e-9)


def energy_balance(
    robot: Robot,
    qpos: Any,
    qvel: Any,
    ctrl: Any,
    command: Any,
    water: Water,
    variation: Variation | None = None,
) -> EnergyBalance | None:
    """The balance from the first row of a trajectory to its last.

    Args:
        robot: from `build_robot`.
        qpos: `[T, nq]` configurations, a row for each step.
        qvel: `[T, nv]` velocities.
        ctrl: `[T, nu]` commands.
        command: `[T, nthruster]` commands of the thrusters behind their lag.
        water: surface and current, numbers or `[T]`.
        variation: factors on coefficients, a number each; None for none.

    Returns:
        The balance; None where it cannot be had from a trajectory: in water with a velocity that
        varies in space, which has energy of its own to give, and with drag laws that have a memory.
    """
    tree = make_single_tree(robot)
    if not is_uniform(tree.world) or any(p.laws.memory for level in tree.all for p in level.parts):
        return None
    ctrl = np.asarray(ctrl)[1:, actuators_of(robot)]
    water = jax.tree.map(lambda x: jnp.asarray(x)[1:] if jnp.ndim(x) else x, water)

    rows = (jnp.asarray(np.asarray(x).T) for x in (qpos, qvel, command, ctrl))
    run = fuse(partial(_powers, tree), inline=True, calls=False)
    found = jit(run, fast=True)(*rows, water, variation)
    found = {name: np.asarray(x, float) for name, x in found.items()}
    kinetic = float(found.pop("kinetic_after")[-1] - found.pop("kinetic_before")[0])
    dt = tree.world.timestep
    return EnergyBalance(kinetic=kinetic, **{n: dt * float(x.sum()) for n, x in found.items()})


def _powers(
    tree: SingleTree, qpos: jax.Array, qvel: jax.Array, command: jax.Array, ctrl: jax.Array,
    water: Water, variation: Variation | None,
) -> dict[str, jax.Array]:  # fmt: skip
    """Of each step, `[T - 1]`, as lanes: kinetic energy before and after [J], and powers [W]."""
    tree = tree.with_variation(variation)
    lanes, dt = ctrl.shape[1:], tree.world.timestep
    before, after = (init(tree, qpos[:, rows], qvel[:, rows]) for rows in (_BEGUN, _ENDED))
    earlier = init(tree, jnp.concatenate([qpos[:, :1], qpos[:, :-2]], 1), qvel[:, _BEGUN])
    turn = quat_to_mat(before.quat)
    now, then = (vsub(x.velocity, water.current) for x in (before, after))
    # As a step has it, the velocity turns with the body.
    then = matvec(turn, matTvec(quat_to_mat(after.quat), then))
    before = before._replace(velocity=now, qacc_prev=(), submerged=())
    if tree.thrusters.count:
        before = before._replace(command=command[:, _BEGUN])
    targets, _, thrusts, _ = actuate(tree, before, tree_plant(tree).arrange(ctrl))
    rates = then, after.angular_velocity, after.speed

    def whole(rates: Any) -> dict[str, jax.Array]:
        """Sums over the robot, with these velocities at the end of the step."""
        end = before._replace(**dict(zip(_RATES, rates, strict=True)))
        motions = [forward_kinematics(tree, x, True) for x in (before, end, earlier)]
        roots, moved = zip(*motions, strict=True)
        found = [_on_bodies(tree.world, tree.root, roots, water, thrusts)]
        below = zip(*moved, before.angle, before.speed, end.speed, targets, strict=True)
        for level, (*motion, angle, began, ends, target) in zip(tree.below, below, strict=True):
            speeds = began, ends
            found.append(_on_bodies(tree.world, level, [m[0] for m in motion], water, thrusts))
            found.append(_at_hinges(tree.world, level, angle, speeds, target, dt))
        sums: dict[str, jax.Array] = {}
        for name, x in (item for each in found for item in each.items()):
            bodies = np.shape(x)[0] if np.ndim(x) else 1
            sums[name] = sums.get(name, 0.0) + jnp.sum(jnp.broadcast_to(x, (bodies, *lanes)), 0)
        return sums

    found = whole(rates)
    if tree.meets:  # what the modules' contact takes of the kinetic energy in a step

        def ahead(tree: SingleTree) -> jax.Array:
            (linear, angular, hinges), *_ = accelerate(tree, before, targets, water, thrusts, dt)
            pushed = matvec(turn, linear), angular, hinges
            own = tuple(getattr(before, name) for name in _RATES)
            return whole(jax.tree.map(lambda v, a: v + dt * a, own, pushed))["kinetic_after"]

        apart = ahead(replace(tree, pairs=tree.pairs[:0]))
        found["contact"] = found["contact"] + (apart - ahead(tree)) / dt
    return found


def _on_bodies(
    world: World, level: Level, motions: Sequence[BodyMotion], water: Water, thrusts: Any
) -> dict[str, Scalar]:
    """Of water, weight and bed, on the bodies of a level, `[nbody, lanes]` each [J, W].

    `motions`: at the step's beginning, with the velocities of its end, and a step before.
    """
    begun, motion = (x.twist for x in motions[:2])
    mean = tuple(vscale(0.5, vadd(a, b)) for a, b in zip(begun, motion, strict=True))
    at = motions[1]
    gravity = effective_gravity(world, water, at)

    def power(torque: Vec, force: Vec, velocity: Any = mean) -> Scalar:
        return add(dot(velocity[0], torque), dot(velocity[1], force))

    parts = tuple(replace(p, laws=p.laws._replace(drag="off")) for p in level.parts)
    calm = replace(world, drag="off", near_surface=False)
    no_drag = calm, replace(level, parts=parts), at, gravity, water
    past = water_forces(world, level, motions[2], gravity, water, thrusts)
    previous = PreviousStep(past.submerged, world.timestep) if past.submerged else None
    slammed = at._replace(begun=begun)
    external = water_forces(world, level, slammed, gravity, water, thrusts, previous)
    driven = idle = water_forces(*no_drag, thrusts)
    if len(thrusts):
        idle = water_forces(*no_drag, jnp.zeros_like(thrusts))
    down = tuple(map(neg, gravity))
    fall = vadd(cross(level.moment, down), idle.torque), vadd(vscale(level.mass, down), idle.force)

    def kinetic(carrying: ExternalForces, velocity: Any) -> Scalar:
        return mul(0.5, power(*inertia_and_momentum(level, carrying, velocity)[2], velocity))

    before = kinetic(external, begun)
    parted = mul(1 / world.timestep, sub(kinetic(past, begun), before))
    thrust = power(vsub(driven.torque, idle.torque), vsub(driven.force, idle.force))
    drag = power(vsub(external.torque, driven.torque), vsub(external.force, driven.force))
    bed: Scalar = 0.0
    if level.points is not None:
        bed = power(*bed_forces(world, level, at, level.points, water)[:2])
    return {
        "kinetic_before": before,
        "kinetic_after": kinetic(external, motion),
        "potential": neg(power(*fall)),
        "drag": sub(parted, drag),
        "contact": neg(bed),
        "given": thrust,
        "work": jnp.abs(thrust),
        "joints": 0.0,
    }


def _at_hinges(
    world: World, level: Level, angle: Scalar, speeds: Sequence[Scalar], target: Scalar, dt: float
) -> dict[str, Scalar]:
    """Of servos, friction and end stops, `[nbody, lanes]` each [J, W].

    `speeds`: at the step's beginning and at its end.
    """
    hinges, (before, after) = level.hinges, speeds
    mean = (before + after) / 2
    assert hinges is not None
    servo = motor_torque(hinges, angle, after, target, dt, spring_damping(world)) * mean
    stop, _ = end_stop(hinges, angle, after, dt)
    return {
        "kinetic_before": 0.5 * hinges.armature * before**2,
        "kinetic_after": 0.5 * hinges.armature * after**2,
        "given": servo,
        "work": jnp.abs(servo),
        "joints": hinges.damping * after * mean - stop * mean,
    }
