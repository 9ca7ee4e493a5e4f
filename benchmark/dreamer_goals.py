"""What a Dreamer in FourRooms makes of goals at which it has been rewarded, and of those at which it never was.

    python benchmark/dreamer_goals.py runs/dreamer_xs/dreamer_seed1

Plays 1,000 evaluation episodes with the agent of a run's last checkpoint and prints, by how many rewards its replay holds at
the goal's cell: cells, episodes, share of the goals reached, and mean return. A dream pays only what the replay has paid.
"""

import importlib
from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import torch
import tyro
from common import UsageError, read_args, run_main

DREAMERS = ("dreamer_v2", "hwm_dreamer", "hwm_hrl_dreamer")
GROUPS = {"0": (0, 0), "1 to 2": (1, 2), "3 to 9": (3, 9), "10 and more": (10, 10**9)}  # rewards at a goal's cell


@dataclass
class Args:
    run: tyro.conf.Positional[Path]
    """a run's folder, with its checkpoint and replay"""
    episodes: int = 1_000
    """evaluation episodes, with sampled actions"""


def load(run: Path) -> tuple:
    """Script, arguments, agent and replay of a run. Raises UsageError where there is no checkpoint."""
    path = run / "checkpoint.pt"
    saved = torch.load(path, map_location="cpu", weights_only=True) if path.exists() else {}
    if saved.get("format", "").split(" ")[0] not in DREAMERS:
        raise UsageError(f"{run}: holds no checkpoint of a Dreamer")
    arguments = read_args(run)
    method = importlib.import_module(f"cleanrl_thesis.{saved['format'].split(' ')[0]}")
    names = {field.name for field in fields(method.Args)} - {"run_dir", "resume"}
    args = method.Args(**{name: value for name, value in arguments.items() if name in names})
    model = (method.WorldModel if hasattr(method, "WorldModel") else method.HWM)(args, int(method.ROOM_ACTIONS.n))
    learner = method.Learner(args, model, torch.device("cpu"))
    learner.load_state_dict(saved["learner"])
    replay = method.Replay(run / "replay.dat", args, goes_on=True)
    replay.go_on(saved["collector"]["lengths"].numpy())
    return method, args, learner, replay


def rewards_at_goals(replay, cells: int) -> np.ndarray:
    """How many rewards the replay holds at each goal cell, (cells,)."""
    goals = [row["goal"][places] for row, places in zip(replay.rows, replay.rewarded)]
    return np.bincount(np.concatenate(goals), minlength=cells)


def main(args: Args) -> None:
    torch.set_num_threads(1)
    method, its, learner, replay = load(args.run)
    maze = method.maze(method.ROOM_SIZES[its.env_id])
    rewards = rewards_at_goals(replay, len(maze.cells))
    seeds = [method.episode_seed(its.seed, method.EVALUATION_STREAM, i) for i in range(args.episodes)]
    with method.own_randomness(its.seed):
        played = method.play(learner, its, seeds, greedy=False)
    goals, possible = played["starts"][:, 2], np.unique(maze.starts[:, 1])
    print(f"{args.run}: {replay.lengths.sum():,} records, {rewards.sum():,} rewards")
    print("| rewards at the goal's cell | cells | episodes | reached | return |\n|---|---|---|---|---|")
    for name, (least, most) in GROUPS.items():
        cells = possible[(rewards[possible] >= least) & (rewards[possible] <= most)]
        ours = np.isin(goals, cells)
        if ours.any():
            reached, mean = played["solved"][ours].mean(), played["returns"][ours].mean()
            print(f"| {name} | {len(cells)} | {ours.sum()} | {reached:.2f} | {mean:.3f} |")


if __name__ == "__main__":
    run_main(main, Args, __doc__)
