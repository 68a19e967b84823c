"""The result of a run in words and pictures, when it ends."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from mjx_revolve.episodes.config import Config
from mjx_revolve.episodes.fitness import Fitness
from mjx_revolve.episodes.named_files import read_modules
from mjx_revolve.episodes.scoring import REPORT_EPISODES
from mjx_revolve.episodes.tasks import score_unit
from mjx_revolve.evolution.generations import Champion
from mjx_revolve.evolution.run import Run
from mjx_revolve.evolution.strategies import FAILED_SCORE
from mjx_revolve.formats.mjcf import make_mjcf
from mjx_revolve.view.body_pictures import plot_best
from mjx_revolve.view.colony_history import read_history
from mjx_revolve.view.colony_pictures import plot_history
from mjx_revolve.view.convergence import plot_colony, plot_fitness
from mjx_revolve.view.motion import replay_motion
from mjx_revolve.view.motion_plots import plot_trajectory
from mjx_revolve.view.plots import figure_png, with_unit
from mjx_revolve.view.swim_picture import draw_motion


def describe_score(champion: Champion, config: Config) -> str:
    """The result of a run: `0.158 ± 0.0025 body lengths/s, mean ± SD over 16 fresh starts`."""
    unit = score_unit(config.task.type, config.task.unit)
    score = f"{champion.score:.3g} ± {champion.std:.2g} {unit}".rstrip()
    mark = (champion.passport.mark or "passes its passport") if champion.passport else ""
    found = f"{score}, mean ± SD over {REPORT_EPISODES} fresh starts"
    if champion.failed:
        found += f"; {champion.failed} of them failed, and count as {FAILED_SCORE:g}"
    return found + (f"; {mark}" if mark else "")


def save_pictures(run: Run, champion: Champion) -> None:
    """Writes a run's pictures, and the champion as MJCF with water, as far as there is a robot.

    Args:
        run: the run, its generations done.
        champion: the champion, evaluated.

    Raises:
        OSError: the disk is full.
    """
    folder, fitness, config = run.folder, run.executor.fitness, run.config
    if config.bodies is not None:
        fitness = fitness.body_fitness(champion.body)
    title = f"{folder.path.name}: {describe_score(champion, config)}"
    if config.colony is None:
        label = with_unit("fitness", score_unit(config.task.type, config.task.unit))
        figures = {"fitness.png": plot_fitness(folder.load_metrics(), title, label)}
    else:
        title = f"{folder.path.name}: the champion swims {describe_score(champion, config)}"
        figures = _draw_colony(run, champion)
    if config.bodies is not None:
        figures["bodies.png"] = plot_best(folder.path, read_modules(config), title)
    if isinstance(fitness, Fitness):
        assert champion.key is not None  # it is evaluated
        trajectory = fitness.replay(champion.genes, champion.key)
        height = float(fitness.robot.world.surface_height)
        figures["trajectory.png"] = plot_trajectory(trajectory, height, title)
        # In the first of the poses from which it was evaluated.
        model = make_mjcf(fitness.robot, np.asarray(trajectory.qpos[0]))
        folder.write("champion/robot.xml", model.encode())
        figures["swim.png"] = draw_motion(replay_motion(fitness, trajectory, champion.key))
    for name, figure in figures.items():
        folder.write(name, figure_png(figure))


def _draw_colony(run: Run, champion: Champion) -> dict[str, Figure]:
    """Pictures of a colony by the names of their files."""
    folder, config = run.folder, run.config
    metrics = folder.load_metrics()
    history, _ = read_history(folder.path, float(metrics["time"][-1]))
    title = f"{folder.path.name}: {len(history.spans)} robots lived"
    room = config.evolution.population_size
    figures = plot_history(history, config.colony, room, champion.individual, title)
    figures["fitness"] = plot_colony(metrics, title)
    return {f"{name}.png": figure for name, figure in figures.items()}
