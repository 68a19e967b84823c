"""Gymnasium: shipped tasks by their ids, one environment or many, stepped by random actions."""

import gymnasium
import numpy as np

from mjx_revolve.episodes import register_envs

register_envs()
quick = {"task.duration": 2.0, "task.settle": 0.5, "task.horizon": None}

env = gymnasium.make("mjx_revolve/FishSwim-v0", **quick)
seen, _ = env.reset(seed=0)
over = False
while not over:
    seen, reward, terminated, truncated, info = env.step(env.action_space.sample())
    over = terminated or truncated
print(f"one fish sees {len(seen)} numbers, moves {env.action_space.shape[0]} joints: "
      f"score {info['score']:.3f}")  # fmt: skip

many = gymnasium.make_vec("mjx_revolve/FishSwim-v0", 64, **quick)
many.reset(seed=0)
over = np.zeros(64, bool)  # some may end before the others
scores = np.zeros(64)
while not over.all():
    _, _, _, _, infos = many.step(many.action_space.sample())
    if "score" in infos:
        scores = np.where(infos["_score"] & ~over, infos["score"], scores)
        over |= infos["_score"]
print(f"64 of them: mean score {np.mean(scores):.3f}")
