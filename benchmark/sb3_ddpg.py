"""Stable-Baselines3's DDPG on the driving task with ddpg_torcs_like.py's settings; prints its steps per second as JSON.

python benchmark/sb3_ddpg.py 10000     # steps
"""

import sys

import gymnasium as gym
import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import NormalActionNoise
from timing import report, timed


def main(steps: int) -> None:
    """One car, 50 batches of 64 after every 100 steps, networks of 64-64; it has no layer norm or L2, and Gaussian noise."""
    torch.set_num_threads(1)
    env = Monitor(gym.make("cleanrl_thesis.ddpg_torcs_like:TorcsLike-v0", disable_env_checker=True))
    settings = {"learning_rate": 1e-3, "buffer_size": 1_000_000, "batch_size": 64, "learning_starts": 100, "tau": 0.01}
    settings |= {"train_freq": 100, "gradient_steps": 50, "gamma": 0.99, "seed": 1, "device": "cpu"}
    noise = NormalActionNoise(np.zeros(2), 0.2 * np.ones(2))
    model = DDPG("MlpPolicy", env, action_noise=noise, policy_kwargs={"net_arch": [64, 64]}, **settings)
    report(timed(model, 1_000, steps))


if __name__ == "__main__":
    main(int(sys.argv[1]))
