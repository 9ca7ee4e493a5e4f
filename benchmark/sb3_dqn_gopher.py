"""Stable-Baselines3's DQN on Gopher's pixels at dqn_gopher.py's settings; prints its frames per second as JSON.

python benchmark/sb3_dqn_gopher.py 40000     # game frames
"""

import sys

import ale_py
import gymnasium as gym
import torch
from stable_baselines3 import DQN
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecFrameStack
from timing import report, timed

GAMES, FRAME_SKIP = 8, 4


def make_game() -> gym.Env:
    env = gym.make("ALE/Gopher-v5", frameskip=1)
    return Monitor(gym.wrappers.AtariPreprocessing(env, frame_skip=FRAME_SKIP, grayscale_newaxis=True))


def main(frames: int) -> None:
    """Eight games, a batch of 32 every 4 actions, the network of Mnih et al. (2015); no double or dueling DQN."""
    torch.set_num_threads(1)
    gym.register_envs(ale_py)
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    env = VecFrameStack(DummyVecEnv([make_game] * GAMES), 4)
    settings = {"learning_rate": 1e-4, "buffer_size": 20_000, "batch_size": 32, "learning_starts": 200, "seed": 1}
    settings |= {"train_freq": 1, "gradient_steps": GAMES // 4, "target_update_interval": 1_000, "device": "cpu"}
    model = DQN("CnnPolicy", env, exploration_final_eps=0.01, **settings)
    report(FRAME_SKIP * timed(model, 800, frames // FRAME_SKIP))


if __name__ == "__main__":
    main(int(sys.argv[1]))
