"""Command line: evolves a robot and documents the run in a folder.

    python -m mjx_revolve.evolve configs/lake_swim.yaml [--seed N] [--out DIR]
    python -m mjx_revolve.evolve --resume DIR

The population is spread over this host's cores, and over several hosts where `--hosts` says so (see
`mjx_revolve.evolution.pool` and `mjx_revolve.evolution.hosts`); results do not depend on it.

Heavy imports stand inside functions: thread settings must be made before NumPy and JAX are loaded.
"""

from __future__ import annotations

import argparse
import contextlib
import datetime
import os
import shlex
import signal
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mjx_revolve.evolution.crew import WorkerError
from mjx_revolve.evolution.fingerprints import FREE_SETTINGS, model_hash, settings_hash
from mjx_revolve.evolution.hosts import parse_place, parse_workers, serve
from mjx_revolve.evolution.progress import Progress
from mjx_revolve.inputs.commands import (
    Parser,
    check_place,
    describe_refusal,
    read_path,
    read_seed,
    run_command,
)
from mjx_revolve.inputs.errors import InputError
from mjx_revolve.inputs.own_code import content_name
from mjx_revolve.numerics import runtime

if TYPE_CHECKING:
    from mjx_revolve.episodes.config import Config
    from mjx_revolve.evolution.hosts import Place
    from mjx_revolve.evolution.loop import Champion, Search
    from mjx_revolve.evolution.pool import Pool
    from mjx_revolve.evolution.runs import Checkpoint, Run
    from mjx_revolve.evolution.tensorboard import TensorBoardLog

# What the bits of a run depend on, besides its configuration.
_HOST = ("versions", "cpu", "cpu_count", "device", "threads", "xla_flags")


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog="python -m mjx_revolve.evolve",
        description="Evolves a robot's controller and documents the run in a folder.",
    )
    parser.add_argument(
        "config", nargs="?", type=read_path, metavar="CONFIG", help="a YAML file, see configs/"
    )
    parser.add_argument("--seed", type=read_seed, metavar="N", help="replaces evolution.seed")
    parser.add_argument(
        "--out", type=read_path, metavar="DIR", help="run folder (default: runs/CONFIG-TIME)"
    )
    parser.add_argument(
        "--resume", type=read_path, metavar="DIR", help="continue this run folder, bit for bit"
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY.PATH=VALUE", dest="settings",
        help="replace one value of the configuration; may be repeated",
    )  # fmt: skip
    parser.add_argument(
        "--workers", metavar="N", help="processes on this host (default: its cores)"
    )
    parser.add_argument("--hosts", metavar="N", help="run this same command on N hosts")
    parser.add_argument("--coordinator", metavar="HOST:PORT", help="where host 0 listens")
    parser.add_argument("--host-index", metavar="I", help="of this host (default: the launcher's)")
    return parser


# --- signals --------------------------------------------------------------------------------------


@dataclass
class _Stop:
    """A request to stop after the current generation."""

    signal: int | None = None
    previous: dict[int, Any] = field(default_factory=dict)

    def __enter__(self) -> _Stop:
        for number in (signal.SIGINT, signal.SIGTERM):
            try:
                self.previous[number] = signal.signal(number, self._handle)
            except ValueError:  # not in the main thread: whoever owns that decides
                break
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self.previous.items():
            signal.signal(number, handler)

    def _handle(self, number: int, _: object) -> None:
        self.signal = number
        # The next one ends the process at once, even inside a compiled program.
        for other in self.previous:
            signal.signal(other, signal.SIG_DFL)
        # No print: the signal may have come in the middle of one.
        os.write(2, b"\nfinishing what is under way; press Ctrl-C again to quit at once\n")


# --- the run --------------------------------------------------------------------------------------


def _default_folder(config: Config) -> Path:
    stamp = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    folder = Path("runs") / f"{config.name}-{stamp}"
    count = 1
    while folder.exists():
        count += 1
        folder = Path("runs") / f"{config.name}-{stamp}-{count}"
    return folder


def _describe(config: Config, fitness: Any, folder: Path) -> str:
    """The first line: what runs."""
    robot = getattr(fitness, "robot", None)
    body = ""
    if robot is not None:
        counts = f"{robot.num_hinges} hinges, {robot.morphology.num_modules} modules"
        body = f"{robot.morphology.name} ({counts}), "
    evolution = config.evolution
    world = Path(config.world_name).stem
    import jax

    device = jax.devices()[0].device_kind
    if device == "cpu":
        device = f"cpu with {runtime.usable_cores()} cores"
    if fitness.workers > 1:
        device += f", {fitness.workers} workers"
        device += f" on {len(fitness.hosts)} hosts" if len(fitness.hosts) > 1 else ""
    return (
        f"{body}{fitness.num_genes} genes | {config.task.name} in {world} | "
        f"{evolution.strategy} {evolution.population_size} x {evolution.generations}, "
        f"seed {evolution.seed} | {device} | {_shown(folder)}"
    )


def _shown(path: Path) -> str:
    """A path as short as it can be typed here."""
    path = Path(path).absolute()
    return str(path.relative_to(Path.cwd())) if path.is_relative_to(Path.cwd()) else str(path)


def _resume_command(folder: Path) -> str:
    python = Path(sys.executable)
    name = _shown(python) if python.is_relative_to(Path.cwd()) else "python"
    return shlex.join([name, "-m", "mjx_revolve.evolve", "--resume", _shown(folder)])


def _differences(old: Any, new: Any, place: str = "") -> list[str]:
    """Places at which two nested values differ, with both values."""
    if isinstance(old, dict) and isinstance(new, dict):
        keys = [*old, *(key for key in new if key not in old)]
        return [
            line
            for key in keys
            for line in _differences(old.get(key), new.get(key), f"{place}.{key}".strip("."))
        ]
    return [] if old == new else [f"{place}: expected {old!r} as in the run; found {new!r}"]


def _check_unchanged(old: Config, new: Config, label: str) -> None:
    """Refuses a configuration that would make another run."""
    before, after = old.model_dump(), new.model_dump()
    for data in (before, after):
        for key in FREE_SETTINGS:
            del data["evolution"][key]
        if isinstance(data["world"], str):
            data["world"] = {"name": data["world"]}
    # The run holds a copy of the morphology: its words count, not its place.
    if Path(before["morphology"]).read_bytes() == Path(after["morphology"]).read_bytes():
        after["morphology"] = before["morphology"]
    for section in ("controller", "task"):  # likewise code of the user's own
        if content_name(before[section]["type"]) == content_name(after[section]["type"]):
            after[section]["type"] = before[section]["type"]
    found = _differences(before, after)
    if found:
        more = f" (and {len(found) - 1} more)" if found[1:] else ""
        free = f"evolution.{', '.join(FREE_SETTINGS)}"
        raise InputError(f"{label}: {found[0]}{more}; only {free} may change")


def _seed_setting(arguments: argparse.Namespace) -> list[str]:
    extra = [] if arguments.seed is None else [f"evolution.seed={arguments.seed}"]
    return [*arguments.settings, *extra]


def _begin(arguments: argparse.Namespace, make_fitness: Callable) -> tuple[Run, Config, Any, None]:
    """A new run."""
    from mjx_revolve.episodes.config import load_config
    from mjx_revolve.evolution.runs import check_new_folder, create_run
    from mjx_revolve.evolution.tensorboard import check_tensorboard

    if arguments.config is None:
        raise InputError("expected a CONFIG, or --resume DIR; found neither")
    settings = _seed_setting(arguments)
    config = load_config(arguments.config, settings)
    if config.evolution.tensorboard:
        check_tensorboard(config.source)
    folder = Path(arguments.out) if arguments.out else _default_folder(config)
    check_new_folder(folder)  # before the expensive part
    check_place(folder / "any", f"--out {folder}")
    fitness = make_fitness(config)
    # Not before: workers compile while evosax is imported, which takes a while.
    from mjx_revolve.evolution.strategies import make_strategy

    try:
        make_strategy(config.evolution, fitness.num_genes)
    except InputError as error:
        if str(error).startswith("evolution."):
            raise InputError(f"{config.source}: {error}") from None
        raise
    run, config = create_run(
        folder,
        config,
        started=_now(),
        seed=config.evolution.seed,
        config_file=str(Path(arguments.config).absolute()),
        settings=_portable(settings, config),
        model_hash=model_hash(fitness),
        **runtime.describe_process(),
    )
    return run, config, fitness, None


def _portable(settings: list[str], config: Config) -> list[str]:
    """Settings that mean the same in another folder."""
    places = {"morphology": config.morphology, "modules": config.modules}
    places |= {"world": config.world_name, "world.name": config.world_name}
    places |= {"controller.type": config.controller.type, "task.type": config.task.type}
    portable = []
    for setting in settings:
        key, _, value = setting.partition("=")
        is_text = not value.lstrip().startswith("{")
        place = places.get(key.strip()) if is_text else None
        portable.append(f"{key}={place}" if place else setting)
    return portable


def _continue(
    arguments: argparse.Namespace, make_fitness: Callable
) -> tuple[Run, Config, Any, Checkpoint]:
    """A run that was stopped."""
    from mjx_revolve.episodes.config import load_config, override_config
    from mjx_revolve.evolution.runs import open_run
    from mjx_revolve.evolution.tensorboard import check_tensorboard

    label = f"--resume {arguments.resume}"
    if arguments.out is not None:
        raise InputError(f"{label}: expected no --out beside it; found {arguments.out}")
    run = open_run(arguments.resume)
    settings = _seed_setting(arguments)
    old = run.load_config()
    earlier = run.info.get("settings", [])
    if arguments.config is None:
        config = override_config(old, settings)
    else:
        config = load_config(arguments.config, [*earlier, *settings])
    _check_unchanged(old, config, label)
    free = {key: getattr(config.evolution, key) for key in FREE_SETTINGS}
    config = old.model_copy(update={"evolution": old.evolution.model_copy(update=free)})
    if config.evolution.tensorboard:
        check_tensorboard(label)
    checkpoint = run.load_checkpoint()
    for name in checkpoint.damaged:
        print(f"passed over a damaged checkpoint: {name}", file=sys.stderr)
    if checkpoint.meta["settings_hash"] != settings_hash(config):
        raise InputError(f"{label}: expected the config.yaml that it began with; found it changed")
    fitness = make_fitness(config)
    if checkpoint.meta["model_hash"] != model_hash(fitness):
        raise InputError(
            f"{label}: expected the robot and the world that it began with; found them changed (a "
            "file that config.yaml names, or the program)"
        )
    run.update_info(settings=[*earlier, *_portable(settings, config)])
    _warn_about_bits(checkpoint.meta["host"])
    return run, config, fitness, checkpoint


def _warn_about_bits(before: dict[str, Any]) -> None:
    now = _host()
    found = _differences(before, now)
    if found:
        print(
            f"note: the run continues, but not bit for bit, because this process differs: "
            f"{'; '.join(found)}",
            file=sys.stderr,
        )


def _host() -> dict[str, Any]:
    info = runtime.describe_process()
    return {key: info[key] for key in _HOST}


def _now() -> str:
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def _checkpoint_meta(config: Config, fitness: Any) -> dict[str, Any]:
    return {
        "settings_hash": settings_hash(config),
        "model_hash": model_hash(fitness),
        "chunk_shape": [fitness.block or config.evolution.population_size, fitness.num_genes],
        "strategy": config.evolution.strategy,
        "host": _host(),
    }


def _save_body(run: Run, fitness: Any) -> None:
    """The champion's body: it is the same for all, so it is there from the start."""
    robot = getattr(fitness, "robot", None)
    if robot is not None:
        run.write("champion/morphology.yaml", robot.morphology.save)
        run.write("champion/robot.xml", robot.mj_spec.to_xml().encode())


def _open_log(run: Run, done: int) -> TensorBoardLog:
    """TensorBoard's copy of the metrics."""
    from mjx_revolve.evolution.tensorboard import TensorBoardLog

    table = run.load_metrics() if done else {}
    rows = [dict(zip(table, values, strict=True)) for values in zip(*table.values(), strict=True)]
    return TensorBoardLog(run.folder / "tensorboard", done, rows)


def _evolve(run: Run, config: Config, fitness: Any, begin: Search | None, stop: _Stop) -> Search:
    """All generations, or as many as there are before a request to stop or a worker's death.

    Raises:
        WorkerError: a worker died or hangs; what was done until then is saved.
    """
    from mjx_revolve.evolution.loop import evolve, start_search
    from mjx_revolve.evolution.strategies import make_strategy

    evolution = config.evolution
    search = begin
    before = 0 if begin is None else begin.generation
    log = _open_log(run, before) if evolution.tensorboard else None
    progress = Progress(before, evolution.generations)
    try:
        for search, row in evolve(evolution, fitness, begin):
            run.append_metrics(row)
            if log is not None:
                log.add(row)
            progress.show(row)
            done = search.generation
            last = done == evolution.generations
            if last or stop.signal or done % evolution.checkpoint_every == 0:
                _save(run, config, fitness, search)
            if stop.signal:
                break
    except WorkerError as error:
        if search is None:
            search = start_search(evolution, make_strategy(evolution, fitness.num_genes))
        _save(run, config, fitness, search)
        done = search.generation
        what = f"generation {done}" if done else "the start, before any generation,"
        raise WorkerError(f"{error}; {what} is saved") from None
    finally:
        progress.close()
        if log is not None:
            log.close()
    assert search is not None  # there is at least one generation, or a checkpoint
    return search


def _save(run: Run, config: Config, fitness: Any, search: Search) -> None:
    """A checkpoint, and the champion so far."""
    from mjx_revolve.evolution.loop import search_to_arrays

    arrays, meta = search_to_arrays(config.evolution, search), _checkpoint_meta(config, fitness)
    run.save_checkpoint(search.generation, arrays, meta, config.evolution.keep_checkpoints)
    if search.generation:
        run.save_champion(
            search.elites[0], score=float(search.elite_scores[0]), final=False,
            origin=f"best of generation {search.elite_generations[0]}, not yet judged on "
            "fresh starts",
        )  # fmt: skip


def _finish(run: Run, config: Config, fitness: Any, search: Search) -> None:
    """Chooses the champion, draws the pictures, and says what came out."""
    from mjx_revolve.episodes.tasks import score_unit
    from mjx_revolve.evolution.loop import REPORT_EPISODES, choose_champion
    from mjx_revolve.view import plots

    champion = choose_champion(config.evolution, fitness, search)
    facts = _champion_facts(config, champion)
    run.save_champion(champion.genes, final=True, **facts)
    unit = score_unit(config.task.type)
    spread = f"{champion.score:.3g} ± {champion.std:.2g} {unit}".rstrip()
    result = f"{spread} over {REPORT_EPISODES} fresh starts"
    title = f"{run.folder.name}: {result}"
    figure = plots.plot_fitness(
        run.load_metrics(), title, f"fitness ({unit})" if unit else "fitness"
    )
    run.write("fitness.png", plots.figure_png(figure))
    if hasattr(fitness, "replay"):
        trajectory = fitness.replay(champion.genes, champion.key)
        robot = getattr(fitness, "robot", None)
        height = float(getattr(getattr(robot, "world", None), "surface_height", 0.0))
        figure = plots.plot_trajectory(trajectory, height, title)
        run.write("trajectory.png", plots.figure_png(figure))
        if robot is not None:
            from mjx_revolve.view.swim_picture import plot_swim

            run.write("swim.png", plots.figure_png(plot_swim(robot, trajectory)))
    run.update_info(finished=_now(), generations=search.generation, champion=facts)
    print(f"champion: {result} ({champion.origin})")
    if champion.measures:
        figures = (f"{name} {value:.3g}" for name, value in champion.measures.items())
        print(f"measures: {', '.join(figures)}")
    print(f"run folder: {_shown(run.folder)}")


def _champion_facts(config: Config, champion: Champion) -> dict[str, Any]:
    return {
        "score": champion.score,
        "score_std": champion.std,
        "origin": champion.origin,
        "controller": config.controller.name,
        "task": config.task.name,
        "measures": champion.measures,
    }


def main(argv: list[str] | None = None, make_fitness: Callable | None = None) -> int:
    """Runs the command.

    Args:
        argv: the arguments; None: `sys.argv[1:]`.
        make_fitness: makes a fitness (see `loop.Fitness`) from a `Config`; None: the real one. See
            `pool.make_pool`.

    Returns:
        The exit code: 0 when the run is finished, 130 or 143 when it was interrupted, 1 when the
        disk refused a file or a worker failed.

    Raises:
        InputError: the arguments, the configuration or the run folder are wrong.
    """
    arguments = _parser().parse_args(argv)
    workers, place = parse_workers(arguments.workers), parse_place(arguments)
    with contextlib.ExitStack() as open_pools:
        if place is None or place.index == 0:
            return _lead(arguments, workers, make_fitness, place, open_pools)
        try:
            settings, cache = _seed_setting(arguments), runtime.prepare_process()
            return serve(arguments, settings, make_fitness, workers, place, cache)
        except WorkerError as error:
            print(f"error: {error}", file=sys.stderr)
            return 1


def _lead(
    arguments: argparse.Namespace,
    workers: int | None,
    make_fitness: Callable | None,
    place: Place | None,
    open_pools: contextlib.ExitStack,
) -> int:
    """A whole run; `open_pools` ends its workers."""

    def make(config: Config) -> Pool:
        from mjx_revolve.evolution.pool import make_pool

        return open_pools.enter_context(make_pool(config, workers, make_fitness, place))

    try:
        runtime.prepare_process()
        start = _begin if arguments.resume is None else _continue
        run, config, fitness, checkpoint = start(arguments, make)
    except KeyboardInterrupt:
        print("interrupted before the first generation", file=sys.stderr)
        return 130
    except WorkerError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    try:
        return _work(run, config, fitness, checkpoint)
    except KeyboardInterrupt:
        return 130
    except WorkerError as error:
        print(f"error: {error}\nresume: {_resume_command(run.folder)}", file=sys.stderr)
        return 1
    except OSError as error:
        print(f"error: {describe_refusal(error)}", file=sys.stderr)
        if run.checkpoints():
            print(
                f"the last checkpoint, {_shown(run.checkpoints()[0])}, is intact; make room, then\n"
                f"resume: {_resume_command(run.folder)}",
                file=sys.stderr,
            )
        return 1
    finally:
        run.close()


def _work(run: Run, config: Config, fitness: Any, checkpoint: Checkpoint | None) -> int:
    """Everything after the arguments are known to be right."""
    from mjx_revolve.evolution.loop import search_from_arrays

    search = None
    if checkpoint is not None:
        search = search_from_arrays(config.evolution, fitness.num_genes, checkpoint.arrays)
        finished = "finished" in run.info
        if search.generation >= config.evolution.generations and finished:
            print(
                f"{_shown(run.folder)}: finished after {search.generation} generations; to go on: "
                f"--set evolution.generations={2 * search.generation}"
            )
            return 0
        run.rewind(checkpoint)
        run.save_config(config)
        resumed = [*run.info.get("resumed", []),
                   {"time": _now(), "generation": search.generation, "argv": sys.argv}]  # fmt: skip
        run.update_info(resumed=resumed, finished=None, champion=None)
    run.update_info(workers=fitness.describe())
    print(_describe(config, fitness, run.folder), flush=True)
    if search is not None:
        print(f"resuming after generation {search.generation}", flush=True)
    with _Stop() as stop:
        _save_body(run, fitness)
        search = _evolve(run, config, fitness, search, stop)
        if stop.signal and search.generation < config.evolution.generations:
            print(
                f"stopped after generation {search.generation}; all of it is saved\n"
                f"resume: {_resume_command(run.folder)}",
                flush=True,
            )
            return 128 + stop.signal
        _finish(run, config, fitness, search)
    return 0


if __name__ == "__main__":
    sys.exit(run_command(main))
