"""A short run, its champion replayed, and a page to watch it in a browser."""

import numpy as np

from mjx_revolve.episodes import load_episode
from mjx_revolve.evolve import main
from mjx_revolve.view import module_forces, sum_modules, write_viewer

main(["smoke", "--out", "run"])
episode = load_episode("run")  # the champion from a start that evolution never saw
robot, trajectory = episode.robot, episode.trajectory
write_viewer(episode, "swim.html")

forces = module_forces(robot, trajectory, every=20)  # .time [S], .drag [S, npart, 3] [N]
drag = np.linalg.norm(sum_modules(robot, forces.drag), axis=-1).max(axis=0)  # [nmodule]
for module, newton in zip(robot.morphology.modules, drag, strict=True):
    print(f"{module.name:16} largest drag {newton:.4f} N")
