"""A GPU's turn: one program for a whole population, beside MJX and mujoco_warp on the same robot.

``python -m experiments.gpu [--population N ...] [--robot NAME] [--steps N] [--rounds N]``

Where JAX finds a GPU, programs are compiled for it; else on the CPU, by JAX's own fusion, without
our annotations for XLA:CPU and without chunks. All engines step the same robot without water, with
constant commands: what they all have. Ours in the default water is shown besides. What is printed
was measured in this run; an engine that is not installed, or fails, is named as such.
"""

from __future__ import annotations

import os
import statistics
import sys
import time
from collections.abc import Callable
from typing import Any

from experiments.bench_cases import PHYSICS
from experiments.common import RESULTS, ROOT, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.inputs.commands import run_command, whole
from mjx_revolve.inputs.errors import InputError

_DEPTH = 2.0  # of the start [m]

Made = tuple[Callable[[], Any], float]
"""A function that steps the population, and the timestep [s]."""


def _robot(name: str, physics: str) -> Any:
    from mjx_revolve import build_robot, load_morphology, load_world

    fields = dict(PHYSICS[physics])
    body = load_morphology(str(ROOT / "morphologies" / f"{name}.yaml"))
    return build_robot(body, load_world(fields.pop("name"), **fields))


def make_ours(name: str, count: int, steps: int, physics: str = "none") -> Made:
    """Our step of the whole population at once."""
    import jax
    import jax.numpy as jnp

    from mjx_revolve.engine.engines import make_engine
    from mjx_revolve.episodes.rollout import Rollout, held
    from mjx_revolve.water.flow import water_of

    robot = _robot(name, physics)
    engine = make_engine(robot, "population")
    low, high = (jnp.asarray(x, jnp.float32) for x in (engine.plant.low, engine.plant.high))
    share = jax.random.uniform(jax.random.key(0), (len(low), count), jnp.float32)
    qpos = jnp.asarray(robot.start_qpos(_DEPTH), jnp.float32)[:, None]

    @jax.jit
    def run(qpos: Any, ctrl: Any) -> Any:
        rollout = Rollout(engine, held(ctrl), robot.world, water_of(robot.world))
        qvel = jnp.zeros((robot.mj_model.nv, count), jnp.float32)
        start = rollout.init(engine.init(jnp.tile(qpos, (1, count)), qvel))
        last, _ = rollout.advance(start, lambda *_: (), 1, steps)
        return jnp.stack(last.state.position)

    ctrl = low + (high - low) * share
    return lambda: jax.block_until_ready(run(qpos, ctrl)), robot.world.timestep


def make_mjx(name: str, count: int, steps: int) -> Made:
    """Plain `jit(vmap(mjx.step))` in a scan."""
    import jax
    import jax.numpy as jnp
    from mujoco import mjx

    robot = _robot(name, "none")
    model = mjx.put_model(robot.mj_model)
    ctrl = jnp.full((count, robot.mj_model.nu), 0.3, jnp.float32)
    data = jax.vmap(lambda _: mjx.make_data(model))(jnp.arange(count))

    @jax.jit
    def run(data: Any) -> Any:
        step = jax.vmap(mjx.step, in_axes=(None, 0))
        return jax.lax.scan(lambda d, _: (step(model, d), None), data, None, steps)[0].qpos

    data = data.replace(ctrl=ctrl)
    return lambda: jax.block_until_ready(run(data)), robot.world.timestep


def make_warp(name: str, count: int, steps: int) -> Made:
    """`mujoco_warp.step` of as many worlds, captured in a graph on a GPU."""
    import mujoco_warp
    import warp

    robot = _robot(name, "none")
    model = mujoco_warp.put_model(robot.mj_model)
    data = mujoco_warp.make_data(robot.mj_model, nworld=count)

    def advance() -> None:
        mujoco_warp.reset_data(model, data)
        data.ctrl.fill_(0.3)
        for _ in range(steps):
            mujoco_warp.step(model, data)

    advance()  # compiles
    if not warp.get_device().is_cuda:
        return lambda: (advance(), warp.synchronize()), robot.world.timestep
    with warp.ScopedCapture() as capture:
        advance()
    return lambda: (warp.capture_launch(capture.graph), warp.synchronize()), robot.world.timestep


ENGINES: dict[str, Callable[..., Made]] = {
    "ours, no water": make_ours,
    "ours, default water": lambda *given: make_ours(*given, physics="default"),
    "MJX, no water": make_mjx,
    "mujoco_warp, no water": make_warp,
}


def measure(make: Callable[..., Made], given: tuple[str, int, int], rounds: int) -> dict[str, Any]:
    """Times one engine.

    Args:
        make: of `ENGINES`.
        given: robot, individuals, steps of a call.
        rounds: calls, after one that compiles.

    Returns:
        Steps per second and the seconds until the first call was done; or `error`, why not.
    """
    began = time.perf_counter()
    try:
        run, step = make(*given)
        run()
    except ImportError as error:
        return {"error": f"not installed ({error.name})"}
    except Exception as error:
        said = (str(error).splitlines() or ["no message"])[0]
        return {"error": f"{type(error).__name__}: {said[:80]}"}
    ready, spent = time.perf_counter() - began, []
    for _ in range(rounds):
        began = time.perf_counter()
        run()
        spent.append(time.perf_counter() - began)
    rate = given[1] * given[2] / statistics.median(spent)
    return {
        "steps_per_second": rate, "robot_seconds_per_second": rate * step, "first_call_s": ready,
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Measures all engines at all sizes, prints a table and writes gpu.json."""
    parser = make_parser("gpu", "One program for a whole population, beside MJX and mujoco_warp.")
    parser.add_argument(
        "--population", type=whole(1), nargs="+", default=[1024, 8192, 65536], metavar="N"
    )
    parser.add_argument("--robot", default="spider", help="a shipped morphology")
    parser.add_argument("--steps", type=whole(1), default=200, metavar="N", help="in a call")
    parser.add_argument("--rounds", type=whole(1), default=3, metavar="N")
    options = parser.parse_args(argv)
    if not (ROOT / "morphologies" / f"{options.robot}.yaml").is_file():
        raise InputError("--robot", "a shipped morphology", repr(options.robot))
    os.environ["MJX_REVOLVE_FUSE"] = "0"  # our annotations for XLA:CPU
    import jax

    device = jax.devices()[0]
    print(f"{device.platform}: {device.device_kind}; {options.robot}, {options.steps} steps a call")
    found = []
    for count in options.population:
        for name, make in ENGINES.items():
            result = measure(make, (options.robot, count, options.steps), options.rounds)
            found.append({"engine": name, "population": count} | result)
    rows = [("", "individuals", "Msteps/s", "robot s/s", "first call, s")]
    for row in found:
        rates = (
            (row["error"], "", "") if "error" in row else
            (f"{row['steps_per_second'] / 1e6:.3f}", f"{row['robot_seconds_per_second']:.0f}",
             f"{row['first_call_s']:.1f}")
        )  # fmt: skip
        rows.append((row["engine"], str(row["population"]), *rates))
    print("\n".join(align(rows)))
    folder = RESULTS if options.results else make_folder(options.out, "gpu")
    done, missing = ([row for row in found if ("error" in row) == bad] for bad in (False, True))
    numbers = {
        "platform": device.platform, "robot": options.robot, "rows": done, "missing": missing
    }  # fmt: skip
    print(f"written: {write_results('gpu', numbers, (0,), folder)}")
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
