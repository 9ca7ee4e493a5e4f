"""sb3-contrib's TRPO on a MuJoCo task with gail_hybrid.py's batch; prints its steps per second and returns as JSON.

python benchmark/sb3_trpo.py Hopper-v5 10     # environment, batches of 2,048 steps, seed
"""

import sys

import gymnasium as gym
import torch
from sb3_contrib import TRPO
from stable_baselines3.common.monitor import Monitor
from timing import report, timed


def main(env_id: str, batches: int, seed: int = 1) -> None:
    """Networks of 100-100, 10 conjugate gradient iterations; 5 passes over the value function in batches of 128."""
    torch.set_num_threads(1)
    env = Monitor(gym.make(env_id))
    settings = {"n_steps": 2_048, "batch_size": 128, "n_critic_updates": 5, "gamma": 0.995, "gae_lambda": 0.97}
    dimensions = env.action_space.shape[0]  # it averages the KL divergence over them, where TRPO's sums
    settings |= {"cg_damping": 0.1 / dimensions, "target_kl": 0.01 / dimensions, "cg_max_steps": 10}
    settings |= {"seed": seed, "device": "cpu"}
    model = TRPO("MlpPolicy", env, policy_kwargs={"net_arch": [100, 100]}, **settings)
    speed = timed(model, 2_048, batches * 2_048)
    report(speed, last_50_returns=env.get_episode_rewards()[-50:])


if __name__ == "__main__":
    main(sys.argv[1], *map(int, sys.argv[2:]))
