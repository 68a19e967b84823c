"""What a champion's speed owes to each law of the water, and how far it hangs on uncertain numbers.

``python -m experiments.sensitivity RUN [--out DIR]``, with RUN the finished run of a task that has
a direction, such as `experiments/sine_swim.yaml`. The same gait swims with each law switched off or
replaced, and in MuJoCo C with both of its own fluid laws; then with coefficients, motors and starts
varied by what is not known of them. `docs/sensitivity.md` discusses the result.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from experiments.common import check_whole, make_folder, make_parser, write_results
from mjx_revolve.body.table import align
from mjx_revolve.episodes.config import RobustConfig
from mjx_revolve.inputs.commands import run_command
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.files import short_path, write_atomic
from mjx_revolve.view.plots import COLORS, WIDE, in_style, new_figure

STARTS = 16  # from which each case of the table swims; the same for all
DRAWS = 256  # of uncertain numbers, for each interval
SEED = 7

RANGES: Mapping[str, float] = RobustConfig().model_dump()
"""By what factor a number may be larger or smaller than we have it, as evolution draws it with
`task.robust: true`; `RobustConfig` says where that comes from."""
NAMES = {"drag": "drag", "added_mass": "added mass", "density": "density", "motor": "motor speed"}
# How far the curves go beyond the ranges: the same for all but the density, at a tenth of which
# nothing hovers any more.
_SPAN = {"drag": 2.0, "added_mass": 2.0, "density": 1.02, "motor": 2.0}
_POINTS = 25

# The cases by what of the world changes; a weightless robot without buoyancy hovers as a trimmed
# one does, but nothing rights it.
_WEIGHTLESS = {"world.gravity": 0.0, "world.buoyancy": "off"}
OURS: Mapping[str, Mapping[str, Any]] = {
    "ours, all laws": {},
    "no added mass": {"world.added_mass": False},
    "no drag": {"world.drag": "off"},
    "drag: faces": {"world.drag": "faces"},
    "drag: lift_drag": {"world.drag": "lift_drag"},
    "drag: ellipsoid": {"world.drag": "ellipsoid"},
    "drag: inertia_box": {"world.drag": "inertia_box"},
    "buoyancy: mask": {"world.buoyancy": "mask"},
    "no buoyancy, no weight": _WEIGHTLESS,
    "no servo speed limit": {"servos": "unlimited"},
    "ellipsoid, no added mass": {"world.drag": "ellipsoid", "world.added_mass": False},
    "inertia_box, no added mass": {"world.drag": "inertia_box", "world.added_mass": False},
    "ellipsoid, no added mass, no speed limit": {
        "world.drag": "ellipsoid", "world.added_mass": False, "servos": "unlimited",
    },
}  # fmt: skip
THEIRS = {
    f"MuJoCo C, {law}{words}": (law, limited)
    for law in ("ellipsoid", "inertia_box")
    for words, limited in (("", True), (", no speed limit", False))
}
"""MuJoCo C's laws, with and without the joints' damping that `formats.mjcf` holds servos with."""


class Swim(NamedTuple):
    """How episodes went, `[n]` each.

    Attributes:
        speed: along the task's direction, after the settling time [m/s].
        rise: in that time [m].
    """

    speed: np.ndarray
    rise: np.ndarray


class Champion(NamedTuple):
    """Who swims.

    Attributes:
        config: of the run.
        genes: `[num_genes]`.
    """

    config: Any
    genes: np.ndarray


def read_champion(run: Path) -> Champion:
    """Reads the champion of a run.

    Args:
        run: its folder.

    Returns:
        The champion.

    Raises:
        InputError: there is none, or its gait cannot be played to MuJoCo C.
    """
    from mjx_revolve.episodes.champion import load_genes
    from mjx_revolve.episodes.config import load_config

    config = load_config(run / "config.yaml")
    if config.bodies is not None or config.controller.type not in ("sine", "cpg"):
        raise InputError(f"{run}: expected one body with type: sine or cpg, which sense nothing")
    if config.task.type != "directed_swim" or config.task.settle == 0:
        raise InputError(f"{run}: expected task.type: directed_swim with a task.settle > 0")
    return Champion(config, load_genes(run / "champion" / "genes.yaml"))


def measure(way: np.ndarray, task: Any) -> Swim:
    """Speeds along ways.

    Args:
        way: `[T, 3, n]` of the cores, evenly over an episode, world frame [m].
        task: its settings.

    Returns:
        What became of the episodes.
    """
    first = round(len(way) * task.settle / task.duration) - 1
    moved = way[-1] - way[first]
    ahead = np.asarray(task.direction) / np.linalg.norm(task.direction)
    return Swim(ahead @ moved / (task.duration - task.settle), moved[2])


def make_starts(champion: Champion, tilted: bool = True, count: int = STARTS) -> np.ndarray:
    """`[nq, count]` poses from which all cases start, tilted as the task says or level."""
    import jax

    from mjx_revolve import make_fitness

    changes: dict[str, Any] = {"task.trials": count}
    if not tilted:
        changes["task.start_tilt"] = 0.0
    fitness = make_fitness(champion.config, **changes)
    return np.asarray(fitness.starts(jax.random.key(SEED))[0])


def make_swimmer(champion: Champion, changes: Mapping[str, Any], varied: bool = False) -> Any:
    """Compiles the champion in a world.

    Args:
        champion: who swims.
        changes: of its configuration; `servos: unlimited` takes their top speed away.
        varied: whether what is not known exactly is an argument.

    Returns:
        (start poses `[nq, n]`, a `Variation` of `[n]` each or None) → `Swim`.
    """
    import jax.numpy as jnp

    from mjx_revolve import make_fitness
    from mjx_revolve.engine.population import make_population_engine
    from mjx_revolve.engine.variation import Variation
    from mjx_revolve.episodes.rollout import Rollout, controlled
    from mjx_revolve.numerics.xla import jit, over_chunks
    from mjx_revolve.water.flow import water_of

    settings = {key: value for key, value in changes.items() if key != "servos"}
    fitness = make_fitness(champion.config, **settings)
    robot, controller, task = fitness.robot, fitness.controller, champion.config.task
    if "servos" in changes:
        model = copy.copy(robot.mj_model)
        model.jnt_user[:] = np.inf
        robot = robot.with_model(model)
    # The bed is out of reach.
    still = make_population_engine(robot, contact=False)

    def chunk(qpos: Any, *factors: Any) -> Any:
        engine = still.with_variation(Variation(*factors)) if varied else still
        lanes = qpos.shape[-1]
        genes = jnp.broadcast_to(jnp.asarray(champion.genes, qpos.dtype)[:, None],
                                 (len(champion.genes), lanes))  # fmt: skip
        parameters = controller.decode(genes, engine.plant)
        policy, world = controlled(controller, parameters), robot.world
        rollout = Rollout(engine, policy, world, water_of(world))
        state = engine.init(qpos, jnp.zeros((robot.mj_model.nv, lanes), qpos.dtype))
        record = lambda now, ctrl, water: jnp.stack(engine.root(now.state).position)  # noqa: E731
        start = rollout.init(state, controller.init(parameters))
        return rollout.advance(start, record, fitness.num_records, fitness.record_every)[1]

    run = jit(over_chunks(chunk), fast=not varied)

    def swim(qpos: np.ndarray, variation: Any = None) -> Swim:
        factors = () if variation is None else [jnp.asarray(x, jnp.float32) for x in variation]
        return measure(np.asarray(run(jnp.asarray(qpos, jnp.float32), *factors)), task)

    return swim


def swim_in_c(
    champion: Champion, law: str, limited: bool, qpos: np.ndarray, targets: np.ndarray
) -> Swim:
    """The champion in MuJoCo C, as `mjx-revolve export` writes it.

    Args:
        champion: who swims.
        law: of MuJoCo's fluid.
        limited: whether the servos' top speed is stood for by damping of their joints.
        qpos: `[nq, n]` start poses.
        targets: `[T, nu]` of the servos, a row for each step [rad].

    Returns:
        What became of the episodes.
    """
    import mujoco

    from mjx_revolve import make_fitness
    from mjx_revolve.formats.mjcf import make_mjcf

    fitness = make_fitness(champion.config, **{"world.drag": law})
    model = mujoco.MjModel.from_xml_string(make_mjcf(fitness.robot))
    if not limited:
        stock = fitness.robot.mj_model
        model.dof_damping[:] = stock.dof_damping
        model.dof_dampingpoly[:] = 0
    data = mujoco.MjData(model)
    ways = []
    for start in qpos.T:
        mujoco.mj_resetData(model, data)
        data.qpos[:] = start
        way = []
        for row in targets:
            data.ctrl[:] = row
            mujoco.mj_step(model, data)
            way.append(data.qpos[:3].copy())
        ways.append(way)
    return measure(np.moveaxis(np.array(ways), 0, -1), champion.config.task)


def play_gait(champion: Champion) -> np.ndarray:
    """`[T, nu]` what the gait asks of the servos in an episode [rad], which depends on nothing."""
    from mjx_revolve import bind_genes, make_fitness, simulate

    fitness = make_fitness(champion.config)
    gait = bind_genes(fitness.controller, champion.genes)
    duration = champion.config.task.duration
    return np.asarray(simulate(fitness.robot, gait, duration, once=True).ctrl)


def vary_one(name: str) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Factors on one number, `[_POINTS]`, and all factors, of which the others are 1."""
    factor = np.geomspace(1 / _SPAN[name], _SPAN[name], _POINTS)
    return factor, {other: np.ones(_POINTS) for other in RANGES} | {name: factor}


def draw_factors(names: Sequence[str], count: int = DRAWS) -> dict[str, np.ndarray]:
    """`[count]` factors each, drawn within their ranges; 1 for those that are not named."""
    rng = np.random.default_rng(SEED)
    share = {name: rng.uniform(-1, 1, count) for name in RANGES}
    return {
        name: width ** (share[name] if name in names else np.zeros(count))
        for name, width in RANGES.items()
    }


def compare_laws(champion: Champion) -> dict[str, Swim]:
    """All cases of the table."""
    qpos = make_starts(champion)
    found = {}
    for name, changes in OURS.items():
        found[name] = make_swimmer(champion, changes)(qpos)
        print(f"{name}: {100 * found[name].speed.mean():.2f} cm/s", flush=True)
    targets = play_gait(champion)
    for name, (law, limited) in THEIRS.items():
        found[name] = swim_in_c(champion, law, limited, qpos, targets)
        print(f"{name}: {100 * found[name].speed.mean():.2f} cm/s", flush=True)
    return found


def table(found: Mapping[str, Swim]) -> list[list[str]]:
    """The table's rows: speeds, their spread over the starts, and what they are worth."""
    usual = found["ours, all laws"].speed.mean()
    rows = [["case", "speed (cm/s)", "over starts", "change", "rise (m)"]]
    for name, swim in found.items():
        mean = swim.speed.mean()
        rows.append([
            name, f"{100 * mean:.2f}", f"± {100 * swim.speed.std(ddof=1):.2f}",
            f"{100 * (mean / usual - 1):+.1f} %", f"{swim.rise.mean():+.2f}",
        ])  # fmt: skip
    return rows


class Sensitivity(NamedTuple):
    """How the speed varies.

    Attributes:
        usual: from a level start with nothing varied [m/s].
        curves: by number, (factors, `Swim`).
        draws: by what is drawn, `Swim` of `[DRAWS]`.
    """

    usual: float
    curves: Mapping[str, tuple[np.ndarray, Swim]]
    draws: Mapping[str, Swim]


def vary(champion: Champion) -> Sensitivity:
    """Varies one number at a time, then draws each within its range, then all."""
    from mjx_revolve.engine.variation import Variation

    swim = make_swimmer(champion, {}, varied=True)
    level = make_starts(champion, tilted=False, count=1)
    tilted = make_starts(champion, count=DRAWS)

    def run(factors: Mapping[str, np.ndarray], qpos: np.ndarray) -> Swim:
        count = len(factors["drag"])
        found: Swim = swim(np.broadcast_to(qpos, (len(qpos), count)), Variation(**factors))
        return found

    usual = run(draw_factors((), 1), level).speed[0]
    curves = {}
    for name in RANGES:
        factor, factors = vary_one(name)
        curves[name] = factor, run(factors, level)
    draws = {"start": run(draw_factors(()), tilted)}
    draws |= {NAMES[name]: run(draw_factors((name,)), level) for name in RANGES}
    draws["all at once"] = run(draw_factors(tuple(RANGES)), tilted)
    return Sensitivity(float(usual), curves, draws)


def interval_of(speed: np.ndarray) -> tuple[float, float, float]:
    """Median, and the 5th and 95th percentile."""
    return tuple(float(x) for x in np.percentile(speed, (50, 5, 95)))  # type: ignore[return-value]


@in_style
def draw(found: Sensitivity, others: Mapping[str, Sensitivity] = MappingProxyType({})) -> Any:
    """Curves of one number at a time, and intervals of what is drawn, as a figure.

    Args:
        found: of the champion.
        others: of others, by what they are called, whose intervals stand beside.

    Returns:
        The figure.
    """
    figure = new_figure(WIDE, 4.2)
    one, many = figure.subplots(1, 2, width_ratios=(1.15, 1))
    for color, (name, (factor, swim)) in zip(COLORS, found.curves.items(), strict=False):
        share = swim.speed / found.usual
        width = RANGES[name]
        one.plot(factor, share, color=color, linewidth=1.0, alpha=0.6)
        known = np.abs(np.log(factor)) <= np.log(width) * (1 + 1e-9)
        edges = np.array([1 / width, *factor[known], width])
        thick = np.interp(np.log(edges), np.log(factor), share)
        one.plot(edges, thick, color=color, linewidth=3.2, label=NAMES[name])
    one.set_xscale("log")
    one.set_xticks([0.5, 0.7, 1.0, 1.4, 2.0], ["0.5", "0.7", "1", "1.4", "2"])
    one.minorticks_off()
    one.axhline(1.0, color="#6b7680", linewidth=0.8)
    one.set_xlabel("factor on the number (thick: the range in which it is not known)", fontsize=9)
    one.set_ylabel("speed / speed as evolved", fontsize=9)
    one.legend(frameon=False, fontsize=9)
    one.set_title("one at a time, from a level start")
    rng = np.random.default_rng(0)
    names = [*reversed(found.draws)]
    everybody = {"the champion": found} | dict(others)
    for k, (who, its) in enumerate(everybody.items()):
        color, shift = ("#3b3b3b", COLORS[4])[k % 2], 0.36 * ((len(everybody) - 1) / 2 - k)
        for row, name in enumerate(names):
            speed = 100 * its.draws[name].speed
            middle, low, high = interval_of(speed)
            jitter = row + shift + rng.uniform(-0.12, 0.12, len(speed))
            many.plot(speed, jitter, ".", color=color, alpha=0.15, markersize=3)
            label = who if row == 0 else None
            many.plot([low, high], [row + shift] * 2, color=color, linewidth=3.0, label=label)
            many.plot([middle], [row + shift], "o", color=color, markeredgecolor="white",
                      markersize=7)  # fmt: skip
    many.set_yticks(range(len(names)), names)
    many.set_xlabel("speed (cm/s): median, 5 to 95 %", fontsize=9)
    many.set_title(f"{DRAWS} draws from the ranges")
    if others:
        many.set_ylim(top=len(names) + 0.3)
        many.legend(frameon=False, fontsize=9, loc="upper left")
    return figure


def intervals(found: Sensitivity, tolerance: float) -> list[list[str]]:
    """Rows of what is drawn: range, speeds, and how many leave their depth."""
    rows = [["drawn", "range", "median", "5 to 95 %", "left their depth"]]
    widths = {NAMES[name]: f"/ or x {width:g}" for name, width in RANGES.items()}
    for name, swim in found.draws.items():
        middle, low, high = interval_of(swim.speed)
        away = np.mean(np.abs(swim.rise) > tolerance)
        rows.append([
            name, widths.get(name, "the task's" if name == "start" else "all of them"),
            f"{100 * middle:.2f} cm/s", f"{100 * low:.2f} to {100 * high:.2f}", f"{away:.0%}",
        ])  # fmt: skip
    return rows


def results_of(
    laws: Mapping[str, Swim], found: Sensitivity, beside: Mapping[str, Sensitivity]
) -> dict[str, Any]:
    """What the tables and the text of `docs/sensitivity.md` show; speeds in cm/s."""
    usual = laws["ours, all laws"].speed.mean() if laws else float("nan")
    words = ("", "robust_")
    rows = []
    for name in found.draws:
        row: dict[str, Any] = {"name": name}
        for prefix, its in zip(words, (found, *beside.values()), strict=False):
            middle, low, high = interval_of(100 * its.draws[name].speed)
            row |= {f"{prefix}median": middle, f"{prefix}low": low, f"{prefix}high": high}
            row[f"{prefix}kept"] = low / (100 * its.usual)
        rows.append(row)
    return {
        "laws": [
            {"name": name, "speed": 100 * s.speed.mean(), "spread": 100 * s.speed.std(ddof=1),
             "change": s.speed.mean() / usual - 1, "rise_m": s.rise.mean()}
            for name, s in laws.items()
        ],
        "usual": 100 * found.usual,
        "curves": {name: {"factor": factor, "share": swim.speed / found.usual}
                   for name, (factor, swim) in found.curves.items()},
        "draws": rows,
    }  # fmt: skip


def main(argv: list[str] | None = None) -> int:
    """Swims all cases, prints the tables, writes `sensitivity.png`."""
    parser = make_parser("sensitivity", "What each law is worth, and what is uncertain.")
    parser.add_argument("run", metavar="RUN", help="folder of a run of experiments/sine_swim.yaml")
    parser.add_argument(
        "--robust", metavar="RUN", help="folder of the same with task.robust=true, to stand beside"
    )
    parser.add_argument("--no-laws", action="store_true", help="leave out the table of the laws")
    options = parser.parse_args(argv)
    check_whole(parser, options, "no_laws")
    if options.results and not options.robust:
        raise InputError("--results", "a run to stand beside, by --robust", "none")
    champion = read_champion(Path(options.run))
    others = {"evolved with robust": options.robust} if options.robust else {}
    rivals = {name: read_champion(Path(run)) for name, run in others.items()}
    folder = make_folder(options.out, "sensitivity")

    from mjx_revolve.numerics.runtime import prepare_process
    from mjx_revolve.view.plots import figure_png

    prepare_process()
    found = vary(champion)
    beside = {name: vary(rival) for name, rival in rivals.items()}
    write_atomic(folder / "sensitivity.png", figure_png(draw(found, beside)))
    for name, its in {"the champion": found, **beside}.items():
        print(f"{name}: {100 * its.usual:.2f} cm/s from a level start, nothing varied")
        print("\n".join(align(intervals(its, champion.config.task.depth_tolerance))) + "\n")
    laws = {} if options.no_laws else compare_laws(champion)
    if laws:
        print("\n".join(align(table(laws))))
    if options.results:
        seeds = [run.config.evolution.seed for run in (champion, *rivals.values())]
        write_results("sensitivity", results_of(laws, found, beside), seeds)
    print(f"\nwritten: sensitivity.png in {short_path(folder)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(run_command(main))
