"""Stable-Baselines3's DQN on the Apple game at dqn_apple.py's defaults; prints its steps per second as JSON.

python benchmark/sb3_dqn.py 50000     # frames
"""

import sys

import gymnasium as gym
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.monitor import Monitor
from timing import report, timed


def main(frames: int) -> None:
    """One game, a batch of 32 every 4 frames, a network of 64-64; it has no double or dueling DQN."""
    torch.set_num_threads(1)
    env = Monitor(gym.make("cleanrl_thesis.dqn_apple:AppleGame-v0", disable_env_checker=True))
    settings = {"learning_rate": 5e-4, "buffer_size": 200_000, "batch_size": 32, "learning_starts": 1_000}
    settings |= {"train_freq": 4, "gradient_steps": 1, "target_update_interval": 500, "seed": 1, "device": "cpu"}
    model = DQN("MlpPolicy", env, exploration_final_eps=0.1, policy_kwargs={"net_arch": [64, 64]}, **settings)
    report(timed(model, 2_000, frames))


if __name__ == "__main__":
    main(int(sys.argv[1]))
