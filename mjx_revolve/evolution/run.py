"""A run: begun or resumed, evolved generation by generation, saved, and finished."""

from __future__ import annotations

import contextlib
import datetime
import itertools
import json
import logging
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, TextIO

from mjx_revolve.episodes.config import OLDER_WORLD, Config, load_config, override_config
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.passport import PASSPORT, make_passport
from mjx_revolve.episodes.settings import NamedFile, map_files
from mjx_revolve.evolution.body_fitness import BodyFitness
from mjx_revolve.evolution.executor import Executor
from mjx_revolve.evolution.fingerprints import (
    FREE_SETTINGS,
    model_hash,
    plain_settings,
    settings_hash,
)
from mjx_revolve.evolution.generations import Champion, Evolution, run_generations
from mjx_revolve.evolution.interrupts import Interrupts
from mjx_revolve.evolution.jobs import WorkerError
from mjx_revolve.evolution.kinds import make_evolution
from mjx_revolve.evolution.memory import check_memory
from mjx_revolve.evolution.progress import Progress
from mjx_revolve.evolution.run_folder import (
    Checkpoint,
    RunFolder,
    check_new_folder,
    create_run_folder,
    open_run_folder,
)
from mjx_revolve.evolution.tensorboard import TensorBoardLog, check_tensorboard
from mjx_revolve.inputs.commands import check_place
from mjx_revolve.inputs.errors import InputError, reading, show
from mjx_revolve.inputs.files import naming
from mjx_revolve.inputs.overrides import merge_override, read_overrides
from mjx_revolve.inputs.shipped import find_shipped
from mjx_revolve.inputs.user_code import announce
from mjx_revolve.numerics import runtime

# Entries of `describe_host` on which the bits of a run depend, besides its configuration.
_HOST = ("versions", "cpu", "cpu_count", "device", "threads", "xla_flags", "variables")
_RUNS = Path("runs")
_log = logging.getLogger(__name__)

MakeExecutor = Callable[[Config], Executor]


@dataclass
class Run:
    """A run, from `begin` or `resume`; after `evolve` it has its champion.

    Attributes:
        folder: its folder, locked.
        config: its configuration, which names the folder's copies.
        executor: scores its populations.
        evolution: how genes or bodies are searched for.
        search: the state after the last generation; None: before the first.
        checkpoint: where `search` is from.
        resumed: whether it was begun before.
    """

    folder: RunFolder
    config: Config
    executor: Executor
    evolution: Evolution
    search: Any = None
    checkpoint: Checkpoint | None = None
    resumed: bool = False
    _steps: Iterator[tuple[Any, dict[str, float]]] | None = field(default=None, repr=False)
    _unsaved: bool = field(default=False, repr=False)
    _settings: Sequence[str] = field(default=(), repr=False)  # that a resumed run was given

    @property
    def generation(self) -> int:
        """Number of finished generations."""
        return self.search.generation if self.search else 0

    @property
    def unit(self) -> str:
        """As `Config.unit`."""
        return self.config.unit

    @property
    def resumption(self) -> str:
        """The generation from which a resumed run continues, in words."""
        done = self.generation
        return f"after {self.unit} {done}" if done else "from the start: it has no checkpoint yet"

    @property
    def is_finished(self) -> bool:
        """Whether it has all generations and its champion, chosen by the passport of now."""
        done = self.generation >= self.config.evolution.generations
        known = self.folder.load_config().evolution.passport
        return done and "finished" in self.folder.info and known == self.config.evolution.passport

    # --- begin and resume ---

    @classmethod
    def begin(
        cls,
        path: str,
        settings: Sequence[str],
        out: str | None,
        make_executor: MakeExecutor,
        writing: contextlib.AbstractContextManager | None = None,
    ) -> Run:
        """Begins a new run.

        Args:
            path: the configuration: a file or a shipped one's name.
            settings: what replaces its values, `KEY.PATH=VALUE` each.
            out: the run folder; None: one below `runs/`, named after the configuration and the
                time.
            make_executor: makes the executor.
            writing: entered while the folder is made, as by `Interrupts.writing`.

        Raises:
            InputError: the configuration is wrong, or the folder holds something.
            WorkerError: workers cannot be started.
        """
        config = load_config(path, settings)
        check_tensorboard(config, config.source)
        if out:
            check_new_folder(out)  # before the expensive part
        stamps = _stamps(config)
        place = Path(out) if out else _RUNS / "any"
        check_place(place / "any", f"--out {place}" if out else str(_RUNS))
        executor = _prepare(config, make_executor)
        check_search(config, executor)
        if _stamps(config) != stamps:  # the copies would be of another robot than the fitness
            whole = "files that stay as they are until the run has begun"
            raise InputError(config.source, whole, "one that it names changed")
        info = {
            "started": timestamp(),
            "seed": config.evolution.seed,
            "config_file": str(find_shipped(path, "configs").absolute()),
            "settings": _portable(settings, config),
            "model_hash": model_hash(executor.fitness),
            "settings_hash": settings_hash(config),
            **runtime.describe_process(),
        }
        with writing or contextlib.nullcontext():
            folder, config = create_run_folder(out or claim_folder(config.name), config, **info)
        return cls(folder, config, executor, make_evolution(config, executor))

    @classmethod
    def resume(
        cls, folder: str, path: str | None, settings: Sequence[str], make_executor: MakeExecutor
    ) -> Run:
        """Opens a run that was stopped, at its newest checkpoint that is whole.

        One that was stopped before its first checkpoint begins anew.

        Args:
            folder: the run folder.
            path: the configuration, if it was given again; it must be what the run has.
            settings: what replaces its values, `KEY.PATH=VALUE` each.
            make_executor: makes the executor.

        Raises:
            InputError: it is no run folder, has damaged checkpoints only, or would become another
                run.
            WorkerError: workers cannot be started.
        """
        label = f"--resume {folder}"
        with contextlib.ExitStack() as failed:
            files = open_run_folder(folder)
            failed.callback(files.abandon)
            old = files.load_config()
            earlier = files.info.get("settings", [])
            if path is None:
                config = override_config(old, settings)
            else:
                config = load_config(path, [*earlier, *settings])
            check_unchanged(old, config, label)
            free = {key: getattr(config.evolution, key) for key in FREE_SETTINGS}
            config = old.model_copy(update={"evolution": old.evolution.model_copy(update=free)})
            check_tensorboard(config, label)
            checkpoint = files.load_checkpoint() if files.checkpoints() else None
            for name in checkpoint.damaged if checkpoint else ():
                _log.warning("passed over a damaged checkpoint: %s", name)
            begun = checkpoint.meta if checkpoint else files.info
            settled = settings_hash(config)
            known = begun.get("settings_hash", settled)  # an older version's run.json has none
            worlds = [(), *((name,) for name in OLDER_WORLD), tuple(OLDER_WORLD)]
            ways = itertools.product((False, True), worlds)
            if known not in {settings_hash(config, *way) for way in ways}:
                raise InputError(label, "the config.yaml that it began with", "it changed")
            executor = _prepare(config, make_executor)
            if begun.get("model_hash") != model_hash(executor.fitness):
                changed = "them changed (a file that config.yaml names, or the program)"
                raise InputError(label, "the robot and the world that it began with", changed)
            if checkpoint is None and files.champion_path:
                # A champion is written after a checkpoint: all of them are lost, which this says.
                files.load_checkpoint()
            run = cls(files, config, executor, make_evolution(config, executor), resumed=True)
            run._settings = [*earlier, *_portable(settings, config)]
            if checkpoint is not None:
                if found := _differences(checkpoint.meta.get("host"), describe_host()):
                    _log.warning(
                        "the run continues, but not bit for bit, because this process differs: %s",
                        "; ".join(found),
                    )
                with reading(checkpoint.path):
                    run.search = run.evolution.from_arrays(checkpoint.arrays)
                run.checkpoint = checkpoint
                done = run.generation
                if done > config.evolution.generations and "finished" not in files.info:
                    least = f"at least {done}, which are done"
                    raise InputError(
                        f"{label}: evolution.generations", least, config.evolution.generations
                    )
            failed.pop_all()
            return run

    # --- generations ---

    def evolve(
        self,
        interrupts: Interrupts,
        draw: Callable[[Run, Champion], None],
        log: TextIO | None = None,
        label: str = "",
    ) -> Champion | None:
        """Runs and saves the remaining generations, or those before an interrupt.

        Args:
            interrupts: checked after each generation.
            draw: draws the run's pictures; see `finish`.
            log: gets the progress in plain lines; None: standard output shows it.
            label: of the live line that a terminal has beside the log.

        Returns:
            The champion; None where generations are left.

        Raises:
            WorkerError: no worker is left to score; what was done until then is saved.
            OSError: the disk is full.
        """
        with interrupts.writing:
            self._write_start()
        total = self.config.evolution.generations
        progress = Progress(self.generation, total, unit=self.unit, log=log, label=label)
        with contextlib.closing(progress):
            self._evolve(interrupts, progress)
            if interrupts.signal and self.generation < total:
                return None
            return self.finish(draw, progress.say)

    def _write_start(self) -> None:
        """Describes the run; a resumed one drops what came after its checkpoint."""
        files = self.folder
        if self.resumed:
            files.rewind(self.checkpoint)
            resumption = {"time": timestamp(), "generation": self.generation, "argv": sys.argv}
            resumed = [*files.info.get("resumed", []), resumption]
            files.update_info(
                settings=self._settings, resumed=resumed, finished=None, champion=None
            )
            files.save_config(self.config)
        files.update_info(workers=self.executor.describe())
        # Where the body is the same for all, it is there from the start.
        if isinstance(self.executor.fitness, Fitness):
            files.write("champion/morphology.yaml", self.executor.fitness.robot.morphology.save)

    def _evolve(self, interrupts: Interrupts, progress: Progress) -> None:
        """Generations until the last one, an interrupt, or the loss of all workers."""
        evolution = self.config.evolution
        log = self._open_log() if evolution.tensorboard else None
        interrupts.rescue = self.save
        try:
            for _ in range(self.generation, evolution.generations):
                progress.show(self.step(interrupts.writing, log))
                if interrupts.signal:
                    break
            with interrupts.writing:
                self.save()
        except WorkerError as error:
            if self.search is None:
                self.search = self.evolution.start()
            with interrupts.writing:
                self._unsaved = True
                self.save()
            what = f"{self.unit} {self.generation}"
            what = what if self.generation else f"the start, before any {self.unit},"
            raise WorkerError(f"{error}; {what} is saved") from None
        finally:
            if log is not None:
                log.close()

    def step(
        self, writing: contextlib.AbstractContextManager, log: TensorBoardLog | None = None
    ) -> dict[str, float]:
        """Evolves one generation, writes it down, and saves it if a checkpoint is due.

        Args:
            writing: entered while files are written.
            log: a second log of the figures.

        Returns:
            The generation's figures, a row of `metrics.csv`.
        """
        evolution = self.config.evolution
        if self._steps is None:
            self._steps = run_generations(self.evolution, evolution.generations, self.search)
        search, row = next(self._steps)
        with writing:
            self.folder.append_metrics(row)
            for name, lines in self.evolution.logs(search).items():
                self.folder.append_lines(name, lines)
            if log is not None:
                log.add(row)
            self.search, self._unsaved = search, True
            last = self.generation == evolution.generations
            if last or self.generation % evolution.checkpoint_every == 0:
                self.save()
        return row

    def _open_log(self) -> TensorBoardLog:
        table = self.folder.load_metrics() if self.generation else {}
        rows = [dict(zip(table, row, strict=True)) for row in zip(*table.values(), strict=True)]
        return TensorBoardLog(self.folder.path / "tensorboard", self.generation, rows)

    def save(self) -> None:
        """Saves a checkpoint and the champion so far, if they are not saved yet."""
        if not self._unsaved:
            return
        config, executor = self.config, self.executor
        size = executor.block or config.evolution.population_size
        meta = {
            "settings_hash": settings_hash(config),
            "model_hash": model_hash(executor.fitness),
            "chunk_shape": [size, executor.num_genes],
            "strategy": config.evolution.strategy if config.bodies is None else config.bodies.name,
            "host": describe_host(),
        }
        keep = config.evolution.keep_checkpoints
        arrays = self.evolution.to_arrays(self.search)
        self.folder.save_checkpoint(self.generation, arrays, meta, keep)
        if self.generation:
            self._save_best()
        self._unsaved = False

    def _save_files(self) -> None:
        for name, content in self.evolution.files(self.search).items():
            self.folder.write(name, content)

    def _save_best(self) -> None:
        """Writes the champion so far, and the search's files beside it."""
        self._save_files()
        best = self.evolution.best(self.search)
        if best is None:
            return
        (self.folder.path / PASSPORT).unlink(missing_ok=True)  # an older champion's
        number = {} if best.individual is None else {"individual": best.individual}
        origin = f"{best.origin}, not yet evaluated on fresh starts"
        self.folder.save_champion(
            best.genes, best.body, score=best.score, final=False, origin=origin, **number
        )

    def finish(self, draw: Callable[[Run, Champion], None], say: Callable[[str], None]) -> Champion:
        """Judges the champion on fresh starts.

        Args:
            draw: draws the run's pictures; the run counts as finished once they are there.
            say: says what is under way.
        """
        config = self.config
        say("judging the champion on fresh starts")
        self._save_files()  # a run may have been killed right behind its last checkpoint
        champion = self.evolution.choose_champion(self.search)
        facts: dict[str, object] = {
            "score": champion.score,
            "score_std": champion.std,
            "origin": champion.origin,
            "controller": config.controller.name,
            "task": config.task.name,
            "measures": champion.measures,
        }
        if champion.individual is not None:
            facts["individual"] = champion.individual
        if champion.failed:
            facts["failed_starts"] = champion.failed
        self.folder.save_champion(champion.genes, champion.body, final=True, **facts)
        (self.folder.path / PASSPORT).unlink(missing_ok=True)  # an earlier choice's
        champion = self._judge(champion, say)
        say("drawing pictures")
        draw(self, champion)
        self.folder.update_info(finished=timestamp(), generations=self.generation, champion=facts)
        return champion

    def _judge(self, champion: Champion, say: Callable[[str], None]) -> Champion:
        """The champion with its passport, written down."""
        fitness, config = self.executor.fitness, self.config
        if isinstance(fitness, BodyFitness):
            assert champion.body is not None
            fitness = fitness.body_fitness(champion.body)
        bodies = config.bodies
        required = bodies is not None and bodies.selection.passport == "required"
        wanted = config.evolution.passport or required
        if champion.passport is None and wanted and isinstance(fitness, Fitness):
            say("making the champion's passport")
            try:
                found = make_passport(fitness, champion.genes, config.evolution.seed)
                champion = replace(champion, passport=found)
            except InputError as error:  # of a user's own task, which other times may not suit
                _log.warning("the champion has no passport: %s", error)
        if champion.passport is not None:
            self.folder.write(PASSPORT, champion.passport.to_text().encode())
        return champion

    def close(self) -> None:
        """Lets other processes open the folder."""
        self.folder.close()


# --- checks before a run --------------------------------------------------------------------------


def _prepare(config: Config, make_executor: MakeExecutor) -> Executor:
    """The executor, once the user's code may run and the population fits into memory."""
    for file in config.files:  # before workers run it, as their errors are not seen here
        if file.kind == "code":
            announce(file.text)
    executor = make_executor(config)
    check_genes(config, executor)
    return executor


def check_genes(config: Config, executor: Executor) -> None:
    """Refuses a robot that has none, and populations that do not fit into memory; InputError."""
    fitness = executor.fitness
    if isinstance(fitness, Fitness) and not fitness.engine.plant.num_actuators:
        robot = "a robot with hinges or thrusters, as its controller is to evolve"
        found = f"none in {show(fitness.robot.morphology.name)}"
        raise InputError(f"{config.source}: morphology", robot, found)
    check_memory(config, executor.num_genes)


def check_search(config: Config, executor: Executor) -> None:
    """Refuses settings that can be checked only with the fitness, such as a strategy's.

    Raises:
        InputError: they are wrong.
    """
    try:
        make_evolution(config, executor)
        size, seeds = config.evolution.population_size, config.bodies and len(config.bodies.seeds)
        if seeds and config.colony is None and seeds > size:
            least = f"at least as many as bodies.seeds ({seeds})"
            raise InputError("evolution.population_size", least, size)
    except InputError as error:
        if str(error).startswith(("evolution.", "bodies.")):
            raise config.blame(error) from None
        raise


def check_unchanged(old: Config, new: Config, label: str) -> None:
    """Refuses a configuration that would make another run than the old one.

    Files are the same where their content is: the run holds copies of them.

    Raises:
        InputError: they differ in more than `FREE_SETTINGS`.
    """
    known: dict[str, NamedFile] = {}
    settings = map_files(
        plain_settings(old), lambda file: known.setdefault(file.place, file).text, Config
    )

    def same(file: NamedFile) -> str:
        before = known.get(file.place)
        if before is None or before.function != file.function:
            return file.text
        return before.text if before.digest() == file.digest() else file.text

    found = _differences(settings, map_files(plain_settings(new), same, Config))
    if found:
        more = f" (and {len(found) - 1} more)" if found[1:] else ""
        free = f"evolution.{', '.join(FREE_SETTINGS)}"
        raise InputError(f"{label}: {found[0]}{more}; only {free} may change")


def _differences(old: object, new: object, place: str = "") -> list[str]:
    """Places at which two nested values differ, with both values."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            line
            for key in old | new
            for line in _differences(old.get(key), new.get(key), f"{place}.{key}".strip("."))
        ]
    return [] if old == new else [f"{place}: expected {old!r} as in the run; found {new!r}"]


def _portable(settings: Sequence[str], config: Config) -> list[str]:
    """Settings that mean the same in another folder: absolute paths of files."""
    texts = {file.place: file.text for file in config.files}
    world = texts.get("world") or texts.get("world.name")
    texts |= {"world": world, "world.name": world} if world else {}
    portable = []
    for setting in settings:
        ((key, value),) = read_overrides([setting])[0].items()
        given: dict[str, Any] = {}
        merge_override(given, key, value, "--set")
        found: Any = map_files(given, lambda file: texts.get(file.place, file.text), Config)
        for step in key.split("."):
            given, found = given[step], found[step]
        # As YAML: a folder's name may hold ` #` or `: `.
        text = json.dumps(found, ensure_ascii=False) if found != given else None
        portable.append(f"{key}={text}" if text else setting)
    return portable


def describe_host() -> dict[str, object]:
    """Program and machine, on which the bits of a run depend besides its configuration."""
    info = runtime.describe_process()
    return {key: info[key] for key in _HOST}


def _stamps(config: Config) -> list[tuple[int, int]]:
    """Values that change when a file that the configuration names is written."""
    found = (Path(file.path).stat() for file in config.files)
    return [(x.st_size, x.st_mtime_ns) for x in found]


def timestamp() -> str:
    """Now, in ISO 8601 with the offset from UTC."""
    return datetime.datetime.now().astimezone().isoformat(timespec="seconds")


def claim_folder(name: str) -> Path:
    """A new folder below `runs/`, unique even if other runs begin at the same time."""
    stem = f"{name}-{datetime.datetime.now():%Y%m%d-%H%M%S}"
    names = itertools.chain([stem], (f"{stem}-{n}" for n in itertools.count(2)))
    with naming(_RUNS):
        _RUNS.mkdir(parents=True, exist_ok=True)
    while True:
        folder = _RUNS / next(names)
        with naming(folder), contextlib.suppress(FileExistsError):
            folder.mkdir()
            return folder
