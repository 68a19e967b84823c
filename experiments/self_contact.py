"""How deep random bodies press into themselves under random gaits.

``python -m experiments.self_contact``

Bodies of `random_bodies` beat all their hinges with sines of random amplitude and frequency, up to
faster than the servos turn, in open water. The overlap is that of `self_overlap`, exact, at every
step, and not what the contact itself measures. What was found so far is written after some
hundred bodies; ``--results`` writes ``docs/results``, too.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from experiments.common import RESULTS, make_folder, make_parser, write_results
from experiments.random_bodies import random_body
from mjx_revolve import load_world
from mjx_revolve.engine.batch import Capacity, fit_capacity, pack_bodies
from mjx_revolve.engine.batched_trees import make_batched_trees
from mjx_revolve.engine.population import PopulationEngine
from mjx_revolve.engine.robot import Robot, build_robot
from mjx_revolve.engine.self_overlap import self_overlap
from mjx_revolve.episodes.rollout import Rollout, StepInputs, open_loop
from mjx_revolve.inputs.commands import read_seconds, run_command, whole
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.numerics import xla
from mjx_revolve.water.flow import water_of
from mjx_revolve.water.world import World

# Bodies that are stepped together, those between two reports, and the depth beyond which an overlap
# counts [m].
_CHUNK, _POPULATION, _DEEP = 64, 500, 3e-3


def random_gaits(robot: Robot, lanes: int, steps: int, seed: int = 0) -> np.ndarray:
    """`[steps, nu, lanes]` sines of all amplitudes [rad], as fast as the servos and faster."""
    draw = np.random.default_rng(seed)
    size = robot.num_hinges, lanes
    time = robot.world.timestep * np.arange(steps)[:, None, None]
    middle, swing = draw.uniform(-0.5, 0.5, size), draw.uniform(0.2, 1.0, size)
    return middle + swing * np.sin(draw.uniform(2, 8, size) * time + draw.uniform(0, 7, size))


def make_march(world: Any, capacity: Capacity, steps: int) -> Any:
    """A function: (tables, `[steps, hinges, lanes]` targets) → `[steps, nq, lanes]`, from rest."""

    def run(bodies: Any, ctrl: jax.Array) -> jax.Array:
        trees = make_batched_trees(world, capacity, bodies, ctrl.shape[-1])
        engine = PopulationEngine(trees, bodies.plant)
        rollout = Rollout(engine, open_loop, world, water_of(world))
        qpos = jnp.zeros((7 + capacity.hinges, ctrl.shape[-1]), ctrl.dtype)
        qpos = qpos.at[3].set(1.0).at[2].set(-2.0)
        start = rollout.init(engine.init(qpos, jnp.zeros_like(qpos[1:])))
        keep = lambda now, *_: engine.observe(now.state)[0]  # noqa: E731
        inputs = StepInputs(ctrl=jax.vmap(bodies.plant.arrange)(ctrl))
        found: jax.Array = rollout.advance(start, keep, steps, 1, inputs)[1]
        return found

    return run


class _March:
    """Robots under gaits of their own, by a program that is compiled anew only for larger ones."""

    def __init__(self, world: World, seconds: float) -> None:
        self.world, self.steps = world, round(seconds / world.timestep)
        self.seen: list[Robot] = []
        self.capacity: Capacity | None = None
        self.run: Any = None

    def deepest_overlaps(self, robots: Sequence[Robot], seeds: Sequence[int]) -> list[float]:
        """Of each robot [m]; infinite where it blows up."""
        self.seen += robots
        try:
            if self.capacity is None:
                raise InputError("none yet")
            pack_bodies(robots, self.capacity)
        except InputError:
            self.capacity = fit_capacity(self.seen)
            self.run = xla.jit(make_march(self.world, self.capacity, self.steps))
        found = []
        for start in range(0, len(robots), _CHUNK):
            some = list(robots[start : start + _CHUNK])
            padded = some + some[:1] * (_CHUNK - len(some))
            ctrl = np.zeros((self.steps, self.capacity.hinges, _CHUNK), np.float32)
            for k, robot in enumerate(some):
                gait = random_gaits(robot, 1, self.steps, seeds[start + k])
                ctrl[:, : robot.num_hinges, k] = gait[..., 0]
            bodies = pack_bodies(padded, self.capacity)
            qpos = np.asarray(self.run(bodies, ctrl), np.float64)
            for k, robot in enumerate(some):
                own = qpos[:, : 7 + robot.num_hinges, k]
                sound = np.isfinite(own).all()
                depth = self_overlap(robot, own).depth.max() if sound else np.inf
                found.append(float(np.round(depth, 6)))  # some overlap by 3 mm at rest
        return found


def study(bodies: int, seconds: float, timestep: float, seed: int = 0) -> Iterator[dict[str, Any]]:
    """What random bodies do, those that cannot meet themselves left out, after each population."""
    world = load_world("lake", bed=None, self_contact=True, timestep=timestep)
    march, depths = _March(world, seconds), []
    for first in range(seed, seed + bodies, _POPULATION):
        draws = range(first, min(first + _POPULATION, seed + bodies))
        every = [(k, build_robot(random_body(k, 4 + k % 9, 6), world)) for k in draws]
        met = [(k, robot) for k, robot in every if len(robot.assembly.meeting_pairs)]
        if met:
            depths += march.deepest_overlaps([robot for _, robot in met], [k for k, _ in met])
        depth = np.array(depths)
        finite = depth[np.isfinite(depth)]
        yield {
            "timestep_ms": round(1000 * timestep),
            "bodies": draws.stop - seed,
            "bodies_that_can_meet": len(depth),
            "not_finite": int(len(depth) - len(finite)),
            "touch": int(np.sum(finite > 0)),
            "beyond_1_mm": int(np.sum(finite > 1e-3)),
            "beyond_3_mm": int(np.sum(finite > _DEEP)),
            "deepest_mm": round(1000 * float(finite.max(initial=0)), 2),
        }


def main(argv: list[str] | None = None) -> int:
    """Command line."""
    parser = make_parser("self_contact", "Random bodies under random gaits: how deep they overlap.")
    parser.add_argument(
        "--bodies", type=whole(1), default=10000, help="how many (default: 10000); a fifth at 20 ms"
    )
    parser.add_argument(
        "--seconds", type=read_seconds, default=2.0, help="of each gait (default: 2)"
    )
    options = parser.parse_args(argv)
    folder, steps = make_folder(options.out, "self_contact"), {}
    for timestep, bodies in ((0.02, -(-options.bodies // 5)), (0.005, options.bodies)):
        for found in study(bodies, options.seconds, timestep):
            print(found, flush=True)
            steps[timestep] = found
            numbers = {"seconds": options.seconds, "steps": [steps[k] for k in sorted(steps)]}
            for place in [folder, RESULTS] if options.results else [folder]:
                write_results("self_contact", numbers, [0], place)
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
