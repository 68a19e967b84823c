"""Contact of a robot's own modules: impulses between boxes, on velocities, a step ahead.

A penalty spring that is stable at a step of 20 ms lets a servo press centimetres of one module into
another. So a contact is a condition on velocities, which looks ahead (as "speculative contacts" do;
cf. Stewart & Trinkle 1996, An implicit time-stepping scheme for rigid body dynamics with inelastic
collisions and Coulomb friction, IJNME 39): with g the gap at the end of the step of the motion
without contact, n its normal, λ ≥ 0 the forces along the normals and W = J M⁻¹ Jᵀ,

    g + dt² (W λ) ≥ 0,   complementary to λ ≥ 0.

Gaps are those of the boxes themselves, exactly (`numerics.boxes`). W is that of the articulated
bodies with all that is implicit in the step: forces go through the factors that the step has
already computed, backward and forward. They act in pairs at one point, so that momentum is kept to
rounding, and they stop what they meet and never push it apart: contact takes energy. What overlaps
already is parted no faster than it was approached.

Contact has no friction: modules are smooth and wet, they meet at low speed, and what evolution must
not find are bodies that pass through themselves; a second and third direction would cost three
times as much.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from mjx_revolve.engine.meetings import Boxes, Meetings
from mjx_revolve.numerics.boxes import BoxPair, box_contact
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
    vadd,
    vsub,
)

# Candidates of one robot at a time. A choice: few robots have more in contact.
_MOST = 8
# Overlap that is let be [m], the share of the rest that is parted in a step, and the top speed of
# that [m/s]. Choices.
_SLOP, _SHARE, _TOP = 5e-4, 1.0, 1.0
# Steps towards the forces of several contacts, and the error at which they end [m]. Choices: one
# step is exact for one contact.
_STEPS, _ENOUGH = 12, 2e-5
# Added to the inverse mass of a contact [1/kg], so that what is wedged between two modules has
# finite forces. A choice: as if 50 kg gave way, where modules have some tens of grams.
_SOFTNESS = 0.02
# Score of pairs that are no candidates: squared distance of centres per squared reach [-].
_FAR = 1e3


class Bodies(NamedTuple):
    """Rigid bodies of robots, `[nbody, lanes]` each, the root first; world frame.

    Attributes:
        rotation: world from body.
        position: of the origin [m].
        velocity: of the origin [m/s].
        angular_velocity: [rad/s].
    """

    rotation: Mat
    position: Vec
    velocity: Vec
    angular_velocity: Vec

    @staticmethod
    def of(motion: BodyMotion) -> Bodies:
        """The bodies of `kinematics.stack_motions`."""
        turn = motion.axes
        velocity, spin = matvec(turn, motion.velocity), matvec(turn, motion.angular_velocity)
        return Bodies(turn, (*motion.xy, motion.height), velocity, spin)


class Acceleration(NamedTuple):
    """What forces do to robots.

    Attributes:
        bodies: angular and linear acceleration of all bodies, own frames, six of `[nbody, lanes]`.
        robot: what the step needs: of the root and the hinges, as `accelerate` returns it.
    """

    bodies: tuple[Scalar, ...]
    robot: Any


Respond = Callable[[tuple[Scalar, ...]], Acceleration]


def contact_acceleration(
    meetings: Meetings,
    boxes: Boxes,
    now: Bodies,
    ahead: Bodies,
    respond: Respond,
    nothing: Any,
    dt: float,
) -> Any:
    """Accelerations of robots by contacts of their own modules.

    Args:
        meetings: which boxes can meet.
        boxes: of the robots.
        now: the bodies.
        ahead: the bodies at the end of the step, without contact.
        respond: torques [N·m] and forces [N] about the bodies' origins, own frames, six of
            `[nbody, lanes]` → accelerations.
        nothing: zeros, as `Acceleration.robot`.
        dt: of the step [s].

    Returns:
        As `Acceleration.robot`.
    """
    near, first, second = _find_candidates(meetings, boxes, ahead)

    def resolve() -> Any:
        contacts = _Contacts(meetings, boxes, now, ahead, near, first, second, dt)
        return jax.lax.cond(
            _any(contacts.need > 0), lambda: contacts.solve(respond, nothing), lambda: nothing
        )

    return jax.lax.cond(_any(near), resolve, lambda: nothing)


# ------------------------------------------------------------------ candidates


def _find_candidates(
    meetings: Meetings, boxes: Boxes, ahead: Bodies
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Pairs of boxes whose bounding spheres will overlap, the nearest of each robot.

    Returns:
        `[k, lanes]` whether they will; and the boxes' numbers, int32.
    """
    place: Bodies = jax.tree.map(lambda x: x[meetings.body], ahead)
    center = vadd(place.position, matvec(place.rotation, boxes.position))
    radius = jnp.sqrt(dot(boxes.half_size, boxes.half_size))
    spheres = (*center, jnp.broadcast_to(radius, center[0].shape))
    lanes, dtype = center[0].shape[-1], center[0].dtype

    def insert(k: Any, best: list[tuple[jax.Array, ...]]) -> list[tuple[jax.Array, ...]]:
        """The nearest pairs so far, with pair k."""
        pair = [
            jnp.broadcast_to(jax.lax.dynamic_slice_in_dim(x, k, 1), (1, lanes))
            for x in (meetings.first, meetings.second)
        ]
        one, other = (tuple(_pick(x, which)[0] for x in spheres) for which in pair)
        apart, reach = vsub(one[:3], other[:3]), one[3] + other[3]
        score = dot(apart, apart) / (reach * reach)
        first, second = pair[0][0], pair[1][0]
        new: tuple[jax.Array, ...] = (jnp.where(first == second, _FAR, score), first, second)
        kept = []
        for old in best:
            better = new[0] < old[0]
            kept.append(tuple(jnp.where(better, x, y) for x, y in zip(new, old, strict=True)))
            new = tuple(jnp.where(better, y, x) for x, y in zip(new, old, strict=True))
        return kept

    number = jnp.zeros(lanes, jnp.int32)
    start = [(jnp.full(lanes, _FAR, dtype), number, number)]
    start = start * min(_MOST, meetings.first.shape[0])
    found = jax.lax.fori_loop(0, meetings.count, insert, start)
    scores, first, second = (jnp.stack(x) for x in zip(*found, strict=True))
    return scores < 1, first, second


def _any(found: jax.Array) -> jax.Array:
    """Whether any of `[k, lanes]` is set; by halves, as a fused step has no reductions."""
    lane = found[0]
    for k in range(1, found.shape[0]):
        lane = lane | found[k]
    while lane.shape[0] > 1:
        middle = lane.shape[0] // 2
        tail = lane[2 * middle :]
        lane = jnp.concatenate([lane[:middle] | lane[middle : 2 * middle], tail])
    return lane[0]


# ------------------------------------------------------------------ contacts


def _pick(x: jax.Array, which: jax.Array) -> jax.Array:
    """Of `[n, lanes]` or `[n, 1]` numbers, `[k, lanes]` of each lane."""
    wide = jnp.broadcast_to(x, (x.shape[0], which.shape[-1]))
    return jnp.take_along_axis(wide, which, 0, mode="promise_in_bounds")


class _Side(NamedTuple):
    """One box of each candidate, `[k, lanes]` each: its body's number and motion, and its pose.

    Attributes:
        body: number of the body.
        origin: of the body [m].
        frame: world from body.
        center: of the box, now [m].
        rotation: world from box, now.
        center_ahead: at the end of the step, without contact [m].
        rotation_ahead: at the end of the step.
        half_size: [m].
        velocity: of the body's origin at the end of the step, without contact [m/s].
        spin: of the body, likewise [rad/s].
    """

    body: Any
    origin: Vec
    frame: Mat
    center: Vec
    rotation: Mat
    center_ahead: Vec
    rotation_ahead: Mat
    half_size: Vec
    velocity: Vec
    spin: Vec


class _Contacts:
    """Contacts among the candidates, `[k, lanes]` each.

    Attributes:
        need: acceleration along the normal that each needs [m/s²]; not positive: no contact.
    """

    def __init__(
        self,
        meetings: Meetings,
        boxes: Boxes,
        now: Bodies,
        ahead: Bodies,
        near: jax.Array,
        first: jax.Array,
        second: jax.Array,
        dt: float,
    ) -> None:
        self.count = len(now.position[0])
        self.dt = dt

        def side(which: jax.Array) -> _Side:
            body = jnp.asarray(meetings.body, jnp.int32)[which]
            own, later = jax.tree.map(lambda x: _pick(x, body), (now, ahead))
            box: Boxes = jax.tree.map(lambda x: _pick(x, which), boxes)
            return _Side(
                body=body,
                origin=own.position,
                frame=own.rotation,
                center=vadd(own.position, matvec(own.rotation, box.position)),
                rotation=matmul(own.rotation, box.rotation),
                center_ahead=vadd(later.position, matvec(later.rotation, box.position)),
                rotation_ahead=matmul(later.rotation, box.rotation),
                half_size=box.half_size,
                velocity=later.velocity,
                spin=later.angular_velocity,
            )

        one, other = side(first), side(second)
        half = one.half_size, other.half_size
        pair = BoxPair(vsub(other.center, one.center), one.rotation, other.rotation, *half)
        later = BoxPair(
            vsub(other.center_ahead, one.center_ahead),
            one.rotation_ahead,
            other.rotation_ahead,
            *half,
        )
        contact = box_contact(pair, later)
        closing = jnp.maximum(contact.start - contact.gap, 0)
        parted = jnp.clip(-_SHARE * (contact.start + _SLOP), 0, dt * _TOP)
        target = jnp.minimum(contact.start, 0) + jnp.minimum(parted, closing)
        need = jnp.where(near, target - contact.gap, -1) / dt**2
        point = vadd(one.center, contact.point)
        speeds = [
            vadd(side.velocity, cross(side.spin, vsub(point, side.origin))) for side in (one, other)
        ]
        speed = dot(contact.normal, vsub(speeds[1], speeds[0]))
        # Normals turn within the step; so that no work is done, boxes part no faster than they met.
        self.need = jnp.minimum(need, 2 * jnp.maximum(-speed, 0) / dt)
        pushed = tuple(-x for x in contact.normal), contact.normal
        self.bodies = one.body, other.body
        # Torque and force of a unit force on each side.
        self.unit = tuple(
            (
                *matTvec(side.frame, cross(vsub(point, side.origin), push)),
                *matTvec(side.frame, push),
            )
            for side, push in zip((one, other), pushed, strict=True)
        )

    def _spread(self, force: jax.Array) -> tuple[jax.Array, ...]:
        """Torque and force on all bodies of forces along the normals, six of `[nbody, lanes]`."""
        number = jnp.arange(self.count, dtype=jnp.int32)[:, None]
        found = [jnp.zeros((self.count, force.shape[-1]), force.dtype)] * 6
        for body, unit in zip(self.bodies, self.unit, strict=True):
            for k in range(len(force)):
                own = jnp.where(number == body[k], force[k], 0)
                found = [x + own * y[k] for x, y in zip(found, unit, strict=True)]
        return tuple(found)

    def _gather(self, acceleration: tuple[jax.Array, ...]) -> jax.Array:
        """Acceleration of the contacts along their normals `[k, lanes]`."""
        total = jnp.zeros_like(self.need)
        for body, unit in zip(self.bodies, self.unit, strict=True):
            for x, y in zip(acceleration, unit, strict=True):
                total = total + _pick(x, body) * y
        return total

    def solve(self, respond: Respond, nothing: Any) -> Any:
        """The accelerations by all contacts.

        Conjugate gradients within the bounds λ ≥ 0 (cf. Dostál 2009, Optimal Quadratic Programming
        Algorithms, chapter 5): one step is exact for one contact, and each of several lessens
        ½ λᵀ W λ - λᵀ need, and with it the energy.
        """
        zero = jnp.zeros_like(self.need)

        def improve(now: Any) -> Any:
            force, found, way, curve, total = now
            slope = self.need - found
            projected = jnp.where((force > 0) | (slope > 0), slope, 0)
            # Conjugate to the last way, but where that led to a bound.
            bend = _sum(way * curve)
            share = _sum(projected * curve) / jnp.where(bend > 0, bend, 1)
            way = projected - jnp.where(bend > 0, share, 0) * way
            way = jnp.where((force > 0) | (way > 0), way, 0)
            way = jnp.where(_sum(way * slope) > 0, way, projected)
            change = respond(self._spread(way))
            curve = self._gather(change.bodies) + _SOFTNESS * way
            gain, bend = _sum(way * slope), _sum(way * curve)
            longest = jnp.where(way < 0, -force / jnp.where(way < 0, way, -1), 1e30)
            most = longest[0]
            for k in range(1, len(longest)):
                most = jnp.minimum(most, longest[k])
            length = jnp.where(bend > 0, gain / jnp.where(bend > 0, bend, 1), 0)
            stopped = length > most
            # A robot that is done stays as it is, whatever its neighbours in the batch need.
            length = jnp.where(self._is_open(force, found), jnp.minimum(length, most), 0)
            force = jnp.maximum(force + length * way, 0)
            force = jnp.where(stopped & (longest <= most), 0, force)
            total = jax.tree.map(lambda x, y: x + length * y, total, change.robot)
            way = jnp.where(stopped, 0, way)
            return force, found + length * curve, way, curve, total

        def step(_: Any, now: Any) -> Any:
            return jax.lax.cond(
                _any(self._is_open(now[0], now[1])[None]), improve, lambda x: x, now
            )

        start = zero, zero, zero, zero, nothing
        return jax.lax.fori_loop(0, _STEPS, step, start)[-1]

    def _is_open(self, force: jax.Array, found: jax.Array) -> jax.Array:
        """`[lanes]` whether forces are not good enough yet."""
        missing = self.need - found
        wrong = jnp.where(force > 0, jnp.abs(missing), missing) * self.dt**2 > _ENOUGH
        lane = wrong[0]
        for k in range(1, len(wrong)):
            lane = lane | wrong[k]
        return lane


def _sum(x: jax.Array) -> jax.Array:
    """Over the contacts; written out, as a fused step has no reductions."""
    total = x[0]
    for k in range(1, len(x)):
        total = total + x[k]
    return total
