"""TRPO alone, paid by the environment: the returns of gail_hybrid.py's and of sb3-contrib's, seed by seed.

    python benchmark/trpo_returns.py                          # Hopper-v5, 300,000 steps, 5 seeds each
    python benchmark/trpo_returns.py --seeds 1 --batches 10   # a first look

Writes `benchmark/results/trpo/returns.{json,md}`: the mean return of each seed's last 50 episodes, and the 95% t-interval
of the difference of both means. Same sizes of networks and batches, bound, damping and passes over the value function;
theirs is given bound and damping divided by the dimensions of the actions, for it averages the KL divergence over them.
Initial weights and the factor of the line search (theirs 0.8, ours 0.5) stay as each has them.
"""

import json
import platform
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import gymnasium as gym
import numpy as np
import torch
from common import ROOT, commit, run_main
from scipy import stats

from cleanrl_thesis import gail_hybrid as gail


@dataclass
class Args:
    env_id: str = "Hopper-v5"
    """a MuJoCo task"""
    seeds: int = 5
    """seeds of each contender, from 1 on"""
    batches: int = 146
    """batches of 2,048 steps"""
    workers: int = 2
    """runs at a time, one thread each"""
    only_seed: int | None = None
    """our run of this seed alone; prints its last 50 returns as JSON"""
    out: Path = ROOT / "benchmark" / "results" / "trpo"
    """folder for the results"""


class PaidPlayers(gail.GymPlayers):
    """Players that keep the environment's rewards."""

    def step(self, actions: np.ndarray) -> gail.Steps:
        steps = super().step(actions)
        self.rewards.append(steps.rewards[0])
        return steps


def last_returns(args: Args, seed: int) -> list[float]:
    """Train by gail_hybrid.py's TRPO with the environment's rewards; returns of the last 50 episodes."""
    torch.manual_seed(seed)
    torch.set_num_threads(1)
    settings = gail.Args(alpha=0.0, num_envs=1, num_steps=2_048, frame_skip=1, fisher_every=1, kl_slack=1.0)
    env = gym.make(args.env_id)
    space = env.action_space
    agent = gail.Agent(env.observation_space.shape[0], space.shape[0], settings.hidden_size)
    policy, rng, device = gail.PolicyVector(agent), np.random.default_rng(seed), torch.device("cpu")
    optimizer = torch.optim.Adam(agent.critic.parameters(), settings.value_learning_rate)
    players, returns = PaidPlayers([env], seed), []
    players.start()
    for _ in range(args.batches):
        players.rewards = []
        rollout = gail.collect(agent, players, space, settings, rng)
        batch = gail.make_batch(agent, rollout, np.array(players.rewards, np.float32)[:, None], space, settings, device)
        gail.trpo_step(policy, batch, settings.max_kl, settings)
        gail.update_values(agent, optimizer, batch, settings)
        returns += [episodic_return for _, episodic_return, _ in rollout.episodes]
    return returns[-50:]


def run(command: list[str]) -> dict:
    """What a process prints last, as JSON."""
    done = subprocess.run([sys.executable, *command], cwd=ROOT, capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} failed:\n{done.stderr}")
    return json.loads(done.stdout.splitlines()[-1])


def report(args: Args, means: dict[str, list[float]]) -> str:
    """The table, with the interval of the difference."""
    ours, theirs = means.values()
    lines = [f"| seed | {' | '.join(means)} |", "|---|---|---|"]
    lines += [f"| {i + 1} | {a:.0f} | {b:.0f} |" for i, (a, b) in enumerate(zip(ours, theirs))]
    lines += [f"| mean | {np.mean(ours):.0f} | {np.mean(theirs):.0f} |", ""]
    lines += [f"{args.env_id}, {args.batches * 2_048:,} steps, mean return of the last 50 episodes of training."]
    if args.seeds > 1:
        low, high = stats.ttest_ind(ours, theirs, equal_var=False).confidence_interval(0.95)
        difference = np.mean(ours) - np.mean(theirs)
        lines += [f"Difference {difference:.0f}, 95% t-interval (Welch) {low:.0f} to {high:.0f}."]
    return "\n".join(lines) + "\n"


def main(args: Args) -> None:
    if args.only_seed is not None:
        print(json.dumps({"last_50_returns": last_returns(args, args.only_seed)}))
        return
    commands = []
    for seed in range(1, args.seeds + 1):
        same = ["--env-id", args.env_id, "--batches", str(args.batches)]
        commands.append(["benchmark/trpo_returns.py", *same, "--only-seed", str(seed)])
        commands.append(["benchmark/sb3_trpo.py", args.env_id, str(args.batches - 1), str(seed)])  # after its first
    with ThreadPoolExecutor(args.workers) as pool:
        means = [float(np.mean(result["last_50_returns"])) for result in pool.map(run, commands)]
    contenders = {"gail_hybrid.py": means[::2], "sb3-contrib": means[1::2]}
    command = f"python benchmark/trpo_returns.py --env-id {args.env_id} --seeds {args.seeds} --batches {args.batches}"
    about = {"command": command, "commit": commit(), "python": platform.python_version(), "threads": 1}
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "returns.json").write_text(json.dumps({**about, "mean_returns": contenders}, indent=1) + "\n")
    text = report(args, contenders)
    (args.out / "returns.md").write_text(
        f"# TRPO beside sb3-contrib's\n\n{text}\n`{command}`, commit {about['commit']}.\n"
    )
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
