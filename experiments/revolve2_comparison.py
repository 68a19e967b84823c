"""revolve2's simulator and ours on the same robots with the same brains, side by side.

``python -m experiments.revolve2_comparison --python REVOLVE2_PYTHON``

revolve2 1.2.4 needs NumPy 1 and MuJoCo 2.3, so it lives in an environment of its own:

    python3.11 -m venv revolve2
    revolve2/bin/pip install revolve2-standards==1.2.4 revolve2-mujoco-simulator==1.2.4
    python -m experiments.revolve2_comparison --python revolve2/bin/python

Robots of revolve2's own modules (`revolve2_modules.yaml`) creep over a plane for 30 s, each with a
CPG of its own, commanded 20 times a second: in revolve2, in ours without water, and in ours on the
bed of the lake's water. Rounds alternate, so that both meet the same other load on the machine.
"""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from scipy.stats import spearmanr

from experiments.common import make_folder, make_parser, write_results
from mjx_revolve import load_modules, load_morphology, make_morphology, prepare_process
from mjx_revolve.body import Morphology
from mjx_revolve.episodes import Task, Track, start_on_bed
from mjx_revolve.episodes.config import make_config
from mjx_revolve.episodes.fitness import fit_body
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import check_path, write_atomic

HERE = Path(__file__).parent
MODULES = HERE / "revolve2_modules.yaml"
ROBOTS = ("gecko", "spider", "babya")
SECONDS, RATE, FREQUENCY = 30, 20, 1.0  # s; revolve2's usual commands/s; a choice [Hz]
# revolve2's usual step, and its floor's friction: MuJoCo's default.
TIMESTEP, FRICTION = 0.001, 1.0
DRY = {
    "name": "lake",
    "density": 1.0, "surface_height": -1.0, "buoyancy": "off", "drag": "off", "added_mass": False,
    "bed": {"kind": "flat", "height": 0.0, "friction": FRICTION},
}  # fmt: skip
WET = {"name": "lake", "bed": {"kind": "flat", "height": -3.0, "friction": FRICTION}}
WORLDS: dict[str, dict[str, Any]] = {"ours, dry": DRY, "ours, under water": WET}


def _net_way(track: Track, settings: Any) -> jax.Array:
    """How far the core has come, level [m]."""
    moved = track.position[-1] - track.position[0]
    return jnp.hypot(moved[0], moved[1])


NET_WAY = Task(_net_way, "m", start=start_on_bed, on_bed=True)


def make_population(bodies: Sequence[Morphology], size: int, seed: int) -> list[np.ndarray]:
    """Genes of individuals, whose robots are the bodies by turns: w of hinges, c of pairs."""
    draw = np.random.default_rng(seed)
    chosen = (bodies[k % len(bodies)] for k in range(size))
    return [draw.normal(size=body.num_hinges + len(body.hinge_neighbours())) for body in chosen]


def cpg_matrix(body: Morphology, genes: np.ndarray) -> np.ndarray:
    """`[2 n, 2 n]` of d(x, y)/dt = W (x, y), as `make_cpg` says [rad/s]."""
    n, matrix = body.num_hinges, np.zeros((2 * body.num_hinges, 2 * body.num_hinges))
    each = np.arange(n)
    w = 2 * np.pi * FREQUENCY * np.sin(genes[:n])
    matrix[each, n + each], matrix[n + each, each] = w, -w
    for (i, j), gene in zip(body.hinge_neighbours(), genes[n:], strict=True):
        matrix[i, j] = np.pi * FREQUENCY * np.sin(gene)
        matrix[j, i] = -matrix[i, j]
    return matrix


def load_bodies(theirs: Sequence[dict[str, Any]] = ()) -> list[Morphology]:
    """The robots, of revolve2's modules; with the cores' masses that make revolve2's of them.

    revolve2 1.2.4 loses the inertia of a robot's root on its way through URDF to MJCF: MuJoCo makes
    it anew of the boxes, of 1000 kg/m³. Its core weighs 0.478 kg, not the 0.25 that CoreV1 states.
    """
    modules = load_modules(MODULES)
    bodies = [load_morphology(name, modules) for name in ROBOTS]
    for k, other in enumerate(theirs):
        data = bodies[k].to_mapping()
        core = bodies[k].modules[0].kind.mass + other["mass"] - bodies[k].mass
        data["body"].setdefault("params", {})["mass"] = core
        bodies[k] = make_morphology(data, modules)
    return bodies


def as_json(bodies: Sequence[Morphology]) -> list[list[dict[str, Any]]]:
    """The bodies as `revolve2_side` reads them."""
    keys = ("type", "parent", "slot", "orientation")
    return [[{key: getattr(m, key) for key in keys} for m in body.modules] for body in bodies]


def run_revolve2(python: Path, asked: dict[str, Any]) -> dict[str, Any]:
    """What `revolve2_side` makes of robots and brains.

    Raises:
        InputError: that Python has no revolve2.
    """
    command = [str(python), str(HERE / "revolve2_side.py")]
    try:
        done = subprocess.run(command, input=json.dumps(asked), capture_output=True, text=True)
    except OSError as error:
        raise InputError(f"--python {python}", "a Python", error.strerror) from None
    if done.returncode:
        last = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        raise InputError(f"--python {python}: expected one that has revolve2 1.2.4; found: {last}")
    return json.loads(done.stdout.splitlines()[-1])


def difference(bodies: Sequence[Morphology], theirs: Sequence[Any]) -> tuple[float, float]:
    """Largest difference of masses [kg] and of hinges' places at rest [m]."""
    masses = [abs(body.mass - other["mass"]) for body, other in zip(bodies, theirs, strict=True)]
    # What its front is attached to lies at -x in revolve2's model, here at +y.
    turn, gaps = np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), []
    for body, other in zip(bodies, theirs, strict=True):
        hinged = [body.modules[i] for i in body.hinges]
        ours = np.array([turn @ (m.position + m.rotation @ m.kind.hinge.anchor) for m in hinged])
        apart = np.linalg.norm(ours[:, None] - np.array(other["anchors"]), axis=-1)
        gaps.append(max(apart.min(0).max(), apart.min(1).max()))
    return max(masses), float(max(gaps))


def make_ours(
    world: dict[str, Any], bodies: Sequence[Morphology], genes: Sequence[np.ndarray], key: jax.Array
) -> Callable[[], np.ndarray]:
    """How far our individuals come in 30 s; a compiled program for each body, as evolution has."""
    task = {"type": f"{__file__}:NET_WAY", "duration": SECONDS, "settle": 0.0, "trials": 1}
    config = {
        "world": world, "morphology": "gecko", "modules": str(MODULES), "task": task,
        "controller": {"type": "cpg", "rate": RATE, "max_frequency": FREQUENCY},
    }  # fmt: skip
    fitness = [fit_body(make_config(config, HERE), body) for body in bodies]
    populations = [np.stack(genes[k :: len(bodies)]) for k in range(len(bodies))]

    def run() -> np.ndarray:
        pairs = zip(fitness, populations, strict=True)
        return np.stack([np.asarray(f(own, key)) for f, own in pairs], -1).ravel()

    return run


def main(argv: Sequence[str] | None = None) -> int:
    """Runs both by turns; prints a table and writes the numbers."""
    parser = make_parser("revolve2_comparison", "revolve2's simulator and ours, side by side.")
    parser.add_argument("--python", required=True, help="of an environment that has revolve2 1.2.4")
    parser.add_argument("--theirs", type=int, default=18, help="robots of revolve2 (default: 18)")
    parser.add_argument("--ours", type=int, default=768, help="robots of ours (default: 768)")
    parser.add_argument("--rounds", type=int, default=3, help="of each (default: 3)")
    parser.add_argument("--cores", type=int, default=2, help="that revolve2 uses (default: 2)")
    parser.add_argument("--seed", type=int, default=0, help="of the brains (default: 0)")
    args = parser.parse_args(argv)
    folder, python = make_folder(args.out, "revolve2_comparison"), check_path(args.python)
    if min(args.theirs, args.rounds, args.cores) < 1:
        raise InputError("--theirs, --rounds and --cores: expected numbers >= 1")
    if args.ours < args.theirs or args.ours % len(ROBOTS):
        raise InputError(f"--ours: expected a multiple of {len(ROBOTS)}, no less than --theirs")
    prepare_process()
    asked: dict[str, Any] = {
        "robots": as_json(load_bodies()), "seconds": SECONDS, "rate": RATE, "timestep": TIMESTEP,
        "cores": args.cores, "individuals": [],
    }  # fmt: skip
    bodies = load_bodies(run_revolve2(python, asked)["robots"])
    genes = make_population(bodies, args.ours, args.seed)
    asked["individuals"] = [
        {"robot": k % len(bodies), "matrix": cpg_matrix(bodies[k % len(bodies)], g).tolist()}
        for k, g in enumerate(genes[: args.theirs])
    ]
    sides = {}
    for name, world in WORLDS.items():
        print(f"compiling {name}", flush=True)
        sides[name] = make_ours(world, bodies, genes, jax.random.key(args.seed))
        sides[name]()
    speeds: dict[str, list[float]] = {name: [] for name in ("revolve2", *WORLDS)}
    ways: dict[str, np.ndarray] = {}
    for number in range(args.rounds):
        theirs = run_revolve2(python, asked)
        speeds["revolve2"].append(args.theirs * SECONDS / theirs["seconds"])
        ways["revolve2"] = np.array(theirs["ways"])
        for name, run in sides.items():
            began = time.perf_counter()
            ways[name] = run()
            speeds[name].append(args.ours * SECONDS / (time.perf_counter() - began))
        found = ", ".join(f"{name} {rates[-1]:,.0f}" for name, rates in speeds.items())
        print(f"round {number + 1}: {found} robot s/s", flush=True)
    mass, place = difference(bodies, theirs["robots"])
    numbers = {
        "robots": list(ROBOTS), "seconds": SECONDS, "revolve2_versions": theirs["versions"],
        "robots_of_revolve2": args.theirs, "robots_of_ours": args.ours, "cores": args.cores,
        "largest_difference_of_mass_kg": mass, "largest_difference_of_hinges_m": place,
        "rows": [_row(name, speeds, ways, args.theirs) for name in speeds],
    }  # fmt: skip
    say = f"same robots: masses agree to {mass:.1e} kg, hinges' places to {place:.1e} m"
    print(say, _table(numbers["rows"]), sep="\n")
    path = folder / "revolve2_comparison.json"
    write_atomic(path, (json.dumps(numbers, indent=1) + "\n").encode())
    print(f"Wrote {path}")
    if args.results:
        write_results("revolve2_comparison", numbers, [args.seed])
    return 0


def _row(
    name: str, speeds: dict[str, list[float]], ways: dict[str, np.ndarray], count: int
) -> dict[str, Any]:
    """Speed, its ratio to revolve2's of the same round, and how far the same robots come."""
    rate, base = np.array(speeds[name]), np.array(speeds["revolve2"])
    way = ways[name][:count]
    return {
        "name": name,
        "robot_seconds_per_second": float(np.median(rate)),
        "of_revolve2": float(np.median(rate / base)),
        "generations_of_64_per_minute": float(60 * np.median(rate) / (64 * SECONDS)),
        "median_way_m": float(np.median(way)),
        "rank_correlation_of_ways": float(spearmanr(way, ways["revolve2"]).statistic),
        "blown_up": int((ways[name] < 0).sum()),
    }


def _table(rows: Sequence[dict[str, Any]]) -> str:
    lines = [f"{'':18} robot s/s  of revolve2  generations of 64/min  median way  rank correlation"]
    lines += [
        f"{row['name']:18} {row['robot_seconds_per_second']:9,.0f} {row['of_revolve2']:12,.0f} "
        f"{row['generations_of_64_per_minute']:22,.2f} {row['median_way_m']:9.2f} m "
        f"{row['rank_correlation_of_ways']:17.2f}"
        for row in rows
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    raise SystemExit(run_command(main))
