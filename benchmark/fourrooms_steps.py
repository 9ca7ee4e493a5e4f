"""Steps per second of FourRooms with frames of the whole maze and random actions, as JSON for speed.py.

python benchmark/fourrooms_steps.py MiniGrid-FourRooms-v0 1 1000     # MiniGrid's own frames, 152 × 152, 8 pixels a cell
python benchmark/fourrooms_steps.py FourRooms11-v0 1 5000            # one game of ours, 64 × 64
python benchmark/fourrooms_steps.py FourRooms11-v0 256 1000          # 256 side by side, 1,000 steps each
"""

import sys
import time

import gymnasium as gym
import minigrid.wrappers
from sb3_timing import report

import cleanrl_thesis.ppo_fourrooms  # noqa: F401, registers the mazes


def time_single(env: gym.Env, steps: int) -> float:
    env.action_space.seed(1)
    env.reset(seed=1)
    start = time.perf_counter()
    for _ in range(steps):
        _, _, terminated, truncated, _ = env.step(env.action_space.sample())
        if terminated or truncated:
            env.reset()
    return steps / (time.perf_counter() - start)


def time_many(envs: gym.vector.VectorEnv, steps: int) -> float:
    envs.action_space.seed(1)
    envs.reset(seed=1)
    actions = [envs.action_space.sample() for _ in range(steps)]
    start = time.perf_counter()
    for action in actions:
        envs.step(action)
    return envs.num_envs * steps / (time.perf_counter() - start)


def main(env_id: str, games: int, steps: int) -> None:
    if env_id.startswith("MiniGrid"):
        env = minigrid.wrappers.RGBImgObsWrapper(gym.make(env_id, highlight=False, disable_env_checker=True))
        report(time_single(env, steps))
    elif games == 1:
        report(time_single(gym.make(env_id, disable_env_checker=True), steps))
    else:
        report(time_many(gym.make_vec(env_id, games, vectorization_mode="vector_entry_point"), steps))


if __name__ == "__main__":
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]))
