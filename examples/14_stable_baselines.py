"""Stable-Baselines3: PPO on 64 fish at once, long enough to see that it learns something."""

import numpy as np
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from mjx_revolve.episodes import make_sb3_env

quick = {"task.duration": 4.0, "task.settle": 0.5, "task.horizon": None}
water = VecMonitor(make_sb3_env("fish_swim", 64, **quick))
model = PPO("MlpPolicy", water, n_steps=20, batch_size=320, gamma=0.98, seed=0)
for _ in range(3):
    model.learn(10_240, reset_num_timesteps=False)
    returns = [episode["r"] for episode in model.ep_info_buffer]
    print(f"{model.num_timesteps} steps: mean return {np.mean(returns):.3f}")
