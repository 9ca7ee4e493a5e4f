"""Steps per second of FourRooms with frames of the whole maze and random actions, as JSON for speed.py.

python benchmark/fourrooms_steps.py MiniGrid-FourRooms-v0 1 1000     # MiniGrid's own frames, 152 × 152, 8 pixels a cell
python benchmark/fourrooms_steps.py FourRooms11-v0 1 5000            # one game of ours, 64 × 64
python benchmark/fourrooms_steps.py FourRooms11-v0 256 1000          # 256 side by side, 1,000 steps each
"""

import time
from dataclasses import dataclass

import gymnasium as gym
import minigrid.wrappers
import tyro
from common import UsageError, run_main
from timing import report

import cleanrl_thesis.ppo_fourrooms  # noqa: F401, registers the mazes


@dataclass
class Args:
    env_id: tyro.conf.Positional[str]
    """FourRooms11-v0, FourRooms19-v0, or one of MiniGrid's"""
    games: tyro.conf.Positional[int]
    """games side by side"""
    steps: tyro.conf.Positional[int]
    """steps of each"""


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


def main(args: Args) -> None:
    if args.env_id not in gym.registry:
        raise UsageError(f"{args.env_id}: no environment of this name")
    if args.env_id.startswith("MiniGrid"):
        env = minigrid.wrappers.RGBImgObsWrapper(gym.make(args.env_id, highlight=False, disable_env_checker=True))
        report(time_single(env, args.steps))
    elif args.games == 1:
        report(time_single(gym.make(args.env_id, disable_env_checker=True), args.steps))
    else:
        envs = gym.make_vec(args.env_id, args.games, vectorization_mode="vector_entry_point")
        report(time_many(envs, args.steps))


if __name__ == "__main__":
    run_main(main, Args, __doc__)
