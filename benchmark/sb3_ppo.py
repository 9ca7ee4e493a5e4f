"""Stable-Baselines3's PPO on the work of ppo_continuous_kle.py's defaults; prints its steps per second as JSON.

python benchmark/sb3_ppo.py kle/HalfCheetah-v2 10 8     # task, K, iterations of 2,048 steps
"""

import sys

import gymnasium as gym
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from timing import report, timed


def main(env_id: str, update_epochs: int, iterations: int) -> None:
    """One environment, 2,048 steps, 32 minibatches of 64, normalised observations and rewards, clipped value loss."""
    torch.set_num_threads(1)
    gym_id = f"cleanrl_thesis.ppo_continuous_kle:{env_id}" if env_id.startswith("kle/") else env_id
    envs = VecNormalize(DummyVecEnv([lambda: Monitor(gym.make(gym_id, disable_env_checker=True))]))
    settings = {"n_steps": 2048, "batch_size": 64, "clip_range_vf": 0.2, "device": "cpu", "seed": 1}
    model = PPO("MlpPolicy", envs, n_epochs=update_epochs, **settings)
    report(timed(model, 2048, iterations * 2048))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
