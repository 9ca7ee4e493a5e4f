"""What a segmentation of FourRooms11 costs at best: how often it reads, and how surprising its reads are.

    python benchmark/fourrooms_cuts.py         # about a minute -> benchmark/results/hwm_segment/cuts.md

A hierarchical world model that reads the state where a region ends pays for each read (its budget or price), and for what the
state at a read tells that the one before did not: the entropy of the pose with which a region is entered, given the pose at the
read before, the goal and the policy. Both are computed here from the maze and a policy, for regions bounded by lines parallel
to the walls, for the rooms, and for a read every k steps. The policy takes one of the shortest paths, each tie drawn, and with
probability `noise` any action instead.
"""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, UsageError, commit, run_main

from cleanrl_thesis import ppo_fourrooms as rooms

END = -1  # the goal, where no read follows
Distribution = dict[int, float]  # over poses, or END


@dataclass
class Args:
    episodes: int = 1_000
    """starts, drawn as the task draws them"""
    noises: tuple[float, ...] = (0.0, 0.055)
    """shares of random actions; 0.055 makes the entropy of an action 0.19 nats, that of the player stopped early"""
    out: Path = ROOT / "benchmark" / "results" / "hwm_segment"
    """folder for the table"""


class Player:
    """Shortest ways in the maze of 11 × 11 cells, with noise."""

    def __init__(self, noise: float):
        self.maze, self.noise = rooms.maze(11), noise
        self.steps = rooms.fewest_steps(self.maze)

    def moves(self, pose: int, goal: int) -> Distribution:
        """The pose after a step, END at the goal."""
        following = self.maze.moves[pose]
        left = self.steps[following, goal]
        best = left == left.min()
        weights = self.noise / 3 + (1 - self.noise) * best / best.sum()
        made: Distribution = Counter()
        for after, weight in zip(following.tolist(), weights.tolist()):
            made[END if after // 4 == goal else after] += weight
        return made


def entry(player: Player, pose: int, goal: int, ends: Callable[[int, int], bool]) -> tuple[Distribution, float]:
    """Where the segment that begins at a pose is left, and its expected length; ends(pose, t) says whether t steps later the
    next one begins. What has come to no end after MAX_STEPS is left out."""
    inside: Distribution = {pose: 1.0}
    left: Distribution = Counter()
    length = 0.0
    for t in range(1, rooms.MAX_STEPS + 1):
        following: Distribution = Counter()
        for here, weight in inside.items():
            length += weight
            for after, share in player.moves(here, goal).items():
                (left if after == END or ends(after, t) else following)[after] += weight * share
        inside = following
        if sum(inside.values()) < 1e-6:
            break
    return left, length


def cost(
    player: Player, starts: np.ndarray, segment: Callable[[int], Callable[[int, int], bool]]
) -> tuple[float, float]:
    """Reads per step and bits per step over episodes from starts (N, 2), of a segmentation: segment(pose) gives the `ends` of
    the segment that begins there."""
    rng, known = np.random.default_rng(0), {}
    reads, bits, steps = 0, 0.0, 0.0
    for pose, goal in starts.tolist():
        while pose != END:
            if (pose, goal) not in known:
                left, length = entry(player, pose, goal, segment(pose))
                p = np.array(list(left.values()))
                known[pose, goal] = np.array(list(left))[p > 0].tolist(), p[p > 0] / p.sum(), length
            poses, p, length = known[pose, goal]
            bits, steps = bits - float((p * np.log2(p)).sum()), steps + length
            pose = poses[rng.choice(len(p), p=p)]
            reads += pose != END
    return reads / steps, bits / steps


def by_label(labels: np.ndarray) -> Callable[[int], Callable[[int, int], bool]]:
    """Segments that end where a label of the cells (C,) changes."""
    return lambda begin: lambda pose, t: bool(labels[pose // 4] != labels[begin // 4])


def segmentations(maze: rooms.Maze) -> dict[str, Callable]:
    x, y = maze.cells.T
    made = {}
    for line in range(2, 9):
        where = {4: ", the walls: the door is of the room behind", 5: ", the walls: the door is of the room before"}
        made[f"lines after column and row {line}{where.get(line, '')}"] = by_label(2 * (x > line) + (y > line))
    made["rooms and doors, 8 labels"] = by_label(maze.rooms)
    made |= {f"every {k} steps": lambda begin, k=k: lambda pose, t: t == k for k in (4, 6, 8, 10)}
    return made


def main(args: Args) -> None:
    if not all(0 <= noise <= 1 for noise in args.noises):
        raise UsageError(f"--noises {' '.join(map(str, args.noises))}: must be between 0 and 1")
    maze = rooms.maze(11)
    starts = maze.starts[np.random.default_rng(1).integers(len(maze.starts), size=args.episodes)]
    lines = [f"`python benchmark/fourrooms_cuts.py --episodes {args.episodes}` at {commit()}.", ""]
    head = [f"reads per step, {noise:.1%} random | bits per step" for noise in args.noises]
    lines += [f"| segments end at | {' | '.join(head)} |", "|" + "---|" * (1 + 2 * len(args.noises))]
    for name, segment in segmentations(maze).items():
        costs = [cost(Player(noise), starts, segment) for noise in args.noises]
        lines.append(f"| {name} | {' | '.join(f'{reads:.3f} | {bits:.4f}' for reads, bits in costs)} |")
    args.out.mkdir(parents=True, exist_ok=True)
    (args.out / "cuts.md").write_text("\n".join(lines) + "\n")
    print("\n".join(lines))


if __name__ == "__main__":
    run_main(main, Args, __doc__)
