"""Dreamer's behaviour in the true dynamics of FourRooms11, through the same code: nothing to blame on the world model.

    python benchmark/dreamer_true.py                              # 64 dreams of 15 steps, 6,000 updates, 2 seeds
    python benchmark/dreamer_true.py --starts 128 64 32 --horizons 15 10

Prints, and writes as `benchmark/results/dreamer/true_dynamics.md`, the mean return of the greedy policy from all starts of
the maze after each sixth of the updates; the shortest paths have 0.899. Everything else is as `dreamer_v2.py --size xs` has it.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from common import ROOT, UsageError, commit, run_main

from cleanrl_thesis import dreamer_v2

CELLS, LOOKS = 68, 6  # cells of the maze that are no walls, looks at the policy


@dataclass
class Args:
    starts: tuple[int, ...] = (64,)
    """dreams of an update"""
    horizons: tuple[int, ...] = (15,)
    """steps of a dream"""
    seeds: int = 2
    """seeds of each setting, from 1 on"""
    updates: int = 6_000
    """updates of actor and critic"""
    out: Path = ROOT / "benchmark" / "results" / "dreamer"
    """folder for the table"""


class RoomState(NamedTuple):
    """The true state."""

    pose: torch.Tensor  # (N,) cell and direction
    goal: torch.Tensor  # (N,) cell

    def features(self) -> torch.Tensor:
        """One-hot cell, direction and goal, (N, 140); scaled, for a first layer makes little of single ones."""
        sizes = (self.pose // 4, CELLS), (self.pose % 4, 4), (self.goal, CELLS)
        return 8 * torch.cat([F.one_hot(*each) for each in sizes], -1).float()


class Rooms(torch.nn.Module):
    """The true dynamics in the place of the world model; a reward does not know of the time."""

    feature_size, num_actions = 2 * CELLS + 4, 3

    def __init__(self):
        super().__init__()
        self.unused = torch.nn.Parameter(torch.zeros(1))  # the learner makes an optimiser for the model
        self.moves = torch.from_numpy(dreamer_v2.maze(11).moves)

    def noise(self, *shape: int) -> torch.Tensor:
        return torch.zeros(*shape, 1)

    def imagine_step(self, state: RoomState, action: torch.Tensor, noise: torch.Tensor) -> RoomState:
        return RoomState(self.moves[state.pose, action.argmax(-1)], state.goal)

    def outcome(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        reached = (features[..., :CELLS].argmax(-1) == features[..., -CELLS:].argmax(-1)).float()
        return reached, 1 - reached


@torch.no_grad()
def true_return(behaviour: dreamer_v2.Behaviour) -> float:
    """Mean return of the greedy policy from all starts."""
    maze = dreamer_v2.maze(11)
    moves = torch.from_numpy(maze.moves)
    pose, goal = torch.from_numpy(maze.starts.T.copy())
    returns, ended = torch.zeros(len(pose)), torch.zeros(len(pose), dtype=torch.bool)
    for step in range(1, dreamer_v2.MAX_STEPS + 1):
        pose = moves[pose, behaviour.policy(RoomState(pose, goal).features()).argmax(-1)]
        reached = (pose // 4 == goal) & ~ended
        returns[reached] = 1 - 0.9 * step / dreamer_v2.MAX_STEPS
        ended |= reached
    return float(returns.mean())


def learn(starts: int, horizon: int, updates: int, seed: int) -> list[float]:
    """Learn in dreams from anywhere in the maze; the greedy policy's return at each look."""
    args = dreamer_v2.complete_args(dreamer_v2.Args(horizon=horizon))
    torch.manual_seed(seed)
    learner, maze = dreamer_v2.Learner(args, Rooms(), torch.device("cpu")), dreamer_v2.maze(11)
    goals, returns = torch.from_numpy(np.flatnonzero(maze.rooms < 4)), []  # a goal is in a room, not in a door
    for update in range(1, updates + 1):
        pose, goal = torch.randint(4 * CELLS, (starts,)), goals[torch.randint(len(goals), (starts,))]
        goal = torch.where(pose // 4 == goal, goals[0], goal)
        learner.learn_behaviour(RoomState(pose, goal))
        if update % (updates // LOOKS) == 0:
            returns.append(true_return(learner.behaviour))
    return returns


def check_updates(updates: int) -> None:
    """Raises UsageError where the looks would not part them evenly."""
    if updates < LOOKS or updates % LOOKS:
        raise UsageError(f"--updates {updates}: must be a multiple of {LOOKS}")


def main(args: Args) -> None:
    check_updates(args.updates)
    torch.set_num_threads(1)
    looks = [f"{(look + 1) * (args.updates // LOOKS):,}" for look in range(LOOKS)]
    lines = [f"| dreams | steps | seed | {' | '.join(looks)} | minutes |", "|" + "---|" * (LOOKS + 4)]
    print("\n".join(lines))
    for starts in args.starts:
        for horizon in args.horizons:
            for seed in range(1, args.seeds + 1):
                begin = time.perf_counter()
                returns = " | ".join(f"{value:.3f}" for value in learn(starts, horizon, args.updates, seed))
                minutes = (time.perf_counter() - begin) / 60
                lines.append(f"| {starts} | {horizon} | {seed} | {returns} | {minutes:.1f} |")
                print(lines[-1], flush=True)
    args.out.mkdir(parents=True, exist_ok=True)
    head = f"`benchmark/dreamer_true.py` at {commit()}: greedy return after so many updates, one thread.\n\n"
    (args.out / "true_dynamics.md").write_text(head + "\n".join(lines) + "\n")


if __name__ == "__main__":
    run_main(main, Args, __doc__)
