"""Where an agent on the hierarchical world model begins its segments of time: how often z is read, by what the agent did.

    python benchmark/dreamer_reads.py runs/dreamer_xs/hwm_seed1

Plays evaluation episodes with the agent of a run's last checkpoint, m drawn from p(m) as in play, and prints, for each kind of
step, how many there are and the share of them at which z is read. `age` tells a clock from a choice: the share of reads by
the steps since the last one.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from common import UsageError, run_main
from dreamer_goals import load

AGES = 8


@dataclass
class Args:
    run: tyro.conf.Positional[Path]
    """a run's folder, with its checkpoint and replay"""
    episodes: int = 500
    """evaluation episodes, with sampled actions"""


def play(method, learner, its, seeds: list[int]) -> dict[str, np.ndarray]:
    """One episode for each seed, side by side: `reads`, `rooms` and `poses` (T, N) on arriving at a step, and `lasts` (N,)."""
    envs = method.FourRoomsVectorEnv(len(seeds), method.ROOM_SIZES[its.env_id], its.frame_side)
    obs, info = envs.reset(seed=seeds)
    player, begins = method.Player(learner, len(seeds)), np.ones(len(seeds), bool)
    lasts, over, columns = np.zeros(len(seeds), np.intp), np.zeros(len(seeds), bool), []
    while not over.all():
        player.observe(obs, begins)
        state, age = info["state"], player.state.age.squeeze(1).numpy()
        columns.append((age == 0, info["room"], 4 * state[:, 0] + state[:, 1]))
        obs, _, terminated, truncated, info = envs.step(player.act())
        begins = terminated | truncated
        lasts[begins & ~over] = len(columns)
        over |= begins
    reads, rooms, poses = (np.stack(column) for column in zip(*columns))
    return {"reads": reads, "rooms": rooms, "poses": poses, "lasts": lasts}


def kinds_of_steps(rooms: np.ndarray, poses: np.ndarray) -> dict[str, np.ndarray]:
    """Masks (T, N) of the kinds of steps, by the room (4 and more: a door) and the pose that each arrived at."""
    before, was, number = np.roll(rooms, 1, 0), np.roll(poses, 1, 0), np.arange(len(rooms))[:, None]
    later, stays, in_room = number > 1, rooms == before, rooms < 4
    turns, bumps = (poses // 4 == was // 4) & (poses != was), poses == was
    return {
        "the first after an episode's beginning": np.broadcast_to(number == 1, rooms.shape),
        "arrives in a door": later & ~in_room & ~stays,
        "leaves a door": later & in_room & ~stays,
        "in a room, walks": later & in_room & stays & ~turns & ~bumps,
        "in a room, turns": later & in_room & stays & turns,
        "in a door, turns": later & ~in_room & stays & turns,
        "walks against a wall": later & stays & bumps,
    }


def ages(reads: np.ndarray) -> np.ndarray:
    """Steps since the last read, at each step before its own read: (T, N), 0 at the first."""
    age, made = np.zeros(reads.shape[1], np.intp), []
    for read in reads:
        made.append(age)
        age = np.where(read, 0, age) + 1
    return np.stack(made)


def main(args: Args) -> None:
    torch.set_num_threads(1)
    method, its, learner, _ = load(args.run)
    if not hasattr(method, "HWM"):
        raise UsageError(f"{args.run}: a run of {its.exp_name}, whose model has no segments")
    seeds = [method.episode_seed(its.seed, method.EVALUATION_STREAM, i) for i in range(args.episodes)]
    with method.own_randomness(its.seed):
        played = play(method, learner, its, seeds)
    reads, number = played["reads"], np.arange(len(played["reads"]))[:, None]
    there = (number > 0) & (number < played["lasts"])  # steps that the model was free to read at
    later = there & (number > 1)
    print(f"{args.run}: {later.sum():,} steps after an episode's second, {reads[later].mean():.3f} of them read")
    print("| step | number | read |\n|---|---|---|")
    age = ages(reads)
    kinds = kinds_of_steps(played["rooms"], played["poses"])
    kinds |= {
        f"age {n}" + (" and more" if n == AGES else ""): later & (age.clip(max=AGES) == n) for n in range(1, AGES + 1)
    }
    for name, mask in kinds.items():
        ours = mask & there
        if ours.any():
            print(f"| {name} | {ours.sum():,} | {reads[ours].mean():.3f} |")


if __name__ == "__main__":
    run_main(main, Args, __doc__)
