"""Are skills used where model and segments are perfect? Both levels of HWM HRL Dreamer in the true dynamics of FourRooms11.

    python benchmark/dreamer_skills.py                       # 2 seeds, 3,600 updates each, about 40 minutes
    python benchmark/dreamer_skills.py --sees-z critic --out runs/skills       # one of the three settings
    python benchmark/dreamer_skills.py --seeds 1 --updates 600 --out runs/skills

z is the room (or door) that the agent is in and the goal's cell, w its cell and direction; a segment begins on entering a room or
door, or every four steps, and at each dream's start. π^L and V^L see w, z and the skill e, as Eq. 3.3.12 has it; or V^L alone does,
or neither, so that whatever π^L is to know of the goal has to come through the skill, one of eight, kept for a whole segment. What eight
can do is said by `Tables`, two levels made by hand, whose returns stand first.

Prints, and writes as `benchmark/results/dreamer/skills.md`, the mean return of the greedy policies from all starts of the maze after
each sixth of the updates (shortest paths: 0.899), and in the end: that return with skills drawn evenly instead of by π^H; what a skill
of π^H says of z, I(e; z); and what a skill that is drawn evenly says of the action, I(e; a | w, z), both in nats, over all starts, whose
goal is in another room.
Networks, rates and returns are those of `hwm_hrl_dreamer.py --size xs`, the features and the skill eight times as large.
"""

import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from common import ROOT, UsageError, commit, run_main
from dreamer_true import CELLS, LOOKS, Rooms, check_updates

from cleanrl_thesis import hwm_hrl_dreamer as hrl

PLACES = 8  # four rooms, four doors
SWEEPS = 4  # over the places
VIEWS = {"both": "w, z, e | w, z, e", "critic": "w, e | w, z, e", "neither": "w, e | w, e"}  # what π^L and V^L see


@dataclass
class Args:
    sees_z: tuple[Literal["both", "critic", "neither"], ...] = ("both", "critic", "neither")
    """which of π^L and V^L see z, each a setting of its own; with none, what stands first alone"""
    seeds: int = 2
    """seeds of each setting, from 1 on"""
    updates: int = 3_600
    """updates of all actors and critics"""
    out: Path = ROOT / "benchmark" / "results" / "dreamer"
    """folder for the table"""


class SegmentState(NamedTuple):
    """The true state, and how many steps ago its segment began."""

    pose: torch.Tensor  # (N,) cell and direction
    goal: torch.Tensor  # (N,) cell
    place: torch.Tensor  # (N,) room or door where the segment began
    age: torch.Tensor  # (N, 1)

    def features(self) -> torch.Tensor:
        """z, then w: one-hot place, goal, cell and direction, (N, 148); scaled, for a first layer makes little of single ones."""
        cell, direction = self.pose // 4, self.pose % 4
        sizes = (self.place, PLACES), (self.goal, CELLS), (cell, CELLS), (direction, 4)
        return 8 * torch.cat([F.one_hot(*each) for each in sizes], -1).float()


class Segments(Rooms):
    """The true dynamics with segments, in the place of the world model."""

    z_size, feature_size = PLACES + CELLS, PLACES + 2 * CELLS + 4

    def __init__(self, every: int):
        """every: steps of a segment; 0 for segments that are stays in a room or door."""
        super().__init__()
        self.every, self.places = every, torch.from_numpy(hrl.maze(11).rooms)

    def begin(self, pose: torch.Tensor, goal: torch.Tensor) -> SegmentState:
        return SegmentState(pose, goal, self.places[pose // 4], torch.zeros(len(pose), 1))

    def imagine_step(self, state: SegmentState, action: torch.Tensor, noise: torch.Tensor) -> SegmentState:
        pose = self.moves[state.pose, action.argmax(-1)]
        place = self.places[pose // 4]
        read = (state.age[:, 0] + 1 >= self.every) if self.every else place != state.place
        age = torch.where(read[:, None], 0.0, state.age + 1)
        return SegmentState(pose, state.goal, torch.where(read, place, state.place), age)

    def outcome(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        goal, cell = features[..., PLACES : self.z_size], features[..., self.z_size : self.z_size + CELLS]
        reached = (goal.argmax(-1) == cell.argmax(-1)).float()
        return reached, 1 - reached


def prepare(behaviour: hrl.Behaviour, sees_z: str) -> None:
    """Scale the skill as the features are; whichever of the lower level's networks does not see z has zeros in its place."""
    actor = torch.ones(Segments.feature_size + behaviour.num_skills)
    actor[Segments.feature_size :] = 8
    critic = actor.clone()
    actor[: Segments.z_size] = float(sees_z == "both")
    critic[: Segments.z_size] = float(sees_z != "neither")
    for network, scale in ((behaviour.actor, actor), (behaviour.critic, critic), (behaviour.slow_critic, critic)):
        network.register_forward_pre_hook(lambda module, inputs, scale=scale: (inputs[0] * scale,))


def best(logits: torch.Tensor) -> torch.Tensor:
    return F.one_hot(logits.argmax(-1), logits.shape[-1]).float()


@torch.no_grad()
def true_returns(behaviour: hrl.Behaviour, model: Segments, draws_skills: bool = False) -> torch.Tensor:
    """Returns of the greedy policies from all starts, (N,); or of the lower one alone, with skills drawn evenly."""
    state = model.begin(*torch.from_numpy(hrl.maze(11).starts.T.copy()))
    returns, ended, skill = torch.zeros(len(state.pose)), torch.zeros(len(state.pose), dtype=torch.bool), 0.0
    for step in range(1, hrl.MAX_STEPS + 1):
        features = state.features()
        choices = behaviour.high_policy(features)
        choices = torch.rand(choices.shape) if draws_skills else choices
        skill = torch.where(state.age == 0, best(choices), skill)
        state = model.imagine_step(state, best(behaviour.policy(features, skill)), None)
        reached = (state.pose // 4 == state.goal) & ~ended
        returns[reached] = 1 - 0.9 * step / hrl.MAX_STEPS
        ended |= reached
    return returns


def ways(moves: np.ndarray, inside: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """First actions of the shortest paths to cells `ends` that stay in cells `inside` before, for each pose, (P,)."""
    cell = np.arange(len(moves)) // 4
    steps = np.where(np.isin(cell, ends), 0.0, np.inf)
    allowed = np.isin(cell, inside) | np.isin(cell, ends)
    while True:
        after = np.where(allowed[moves], steps[moves], np.inf)
        shorter = np.where(allowed, np.minimum(steps, 1 + after.min(1)), np.inf)
        if np.array_equal(shorter, steps):
            return after.argmin(1)
        steps = shorter


class Tables:
    """Two levels made by hand: in a room two skills lead to its doors and four round a quarter of it, in a door to either side.

    π^L sees pose and skill, π^H place and goal; for each of these it takes the skill with the best returns, in turn.
    """

    num_skills = 8

    def __init__(self, model: Segments):
        self.maze = hrl.maze(11)
        self.actions = torch.from_numpy(np.stack([self.skill(e) for e in range(self.num_skills)]))
        self.skills = torch.zeros(PLACES, CELLS, dtype=torch.long)
        for place in [*range(PLACES)] * SWEEPS:
            returns = []
            for skill in range(self.num_skills):
                self.skills[place] = skill
                returns.append(self.returns(model))
            self.skills[place] = torch.stack(returns).argmax(0)

    def returns(self, model: Segments) -> torch.Tensor:
        """Mean return from anywhere in the maze for each goal, (CELLS,)."""
        poses, goals = torch.arange(4 * CELLS).repeat(CELLS), torch.arange(CELLS).repeat_interleave(4 * CELLS)
        state, skill, returns = model.begin(poses, goals), torch.zeros_like(poses), torch.zeros(len(poses))
        for step in range(1, hrl.MAX_STEPS + 1):
            skill = torch.where(state.age[:, 0] == 0, self.skills[state.place, goals], skill)
            state = model.imagine_step(state, F.one_hot(self.actions[skill, state.pose], 3), None)
            reached = (state.pose // 4 == goals) & (returns == 0)
            returns[reached] = 1 - 0.9 * step / hrl.MAX_STEPS
        return returns.reshape(CELLS, -1).mean(1)

    def skill(self, e: int) -> np.ndarray:
        """What a skill does in each pose, (P,)."""
        cells, rooms, moves = self.maze.cells, self.maze.rooms, self.maze.moves
        actions = np.zeros(len(moves), np.int64)
        for place in range(PLACES):
            inside = np.flatnonzero(rooms == place)
            beside = np.abs(cells[:, None] - cells[inside]).sum(-1).min(1) == 1
            exits = np.flatnonzero(beside & (rooms != place))  # two doors, or the cells on both sides of a door
            chosen = ways(moves, inside, exits[[e % 2]]) if place >= 4 or e < 2 else self.round(inside, e % 4)
            actions = np.where(np.isin(np.arange(len(moves)) // 4, inside), chosen, actions)
        return actions

    def round(self, inside: np.ndarray, quarter: int) -> np.ndarray:
        """To the nearest of the four cells of a quarter of a room, and then clockwise round it, (P,)."""
        moves, headings = self.maze.moves, hrl.HEADINGS
        corner = self.maze.cells[inside].min(0) + 2 * np.array([quarter % 2, quarter // 2])
        ring = [self.maze.cell_at[tuple(corner + step)] for step in ((0, 0), (1, 0), (1, 1), (0, 1))]
        chosen = ways(moves, inside, np.array(ring))
        for cell, after in zip(ring, ring[1:] + ring[:1]):
            way = np.flatnonzero((headings == self.maze.cells[after] - self.maze.cells[cell]).all(1))[0]
            for heading in range(4):
                turns = [after_turn % 4 == way for after_turn in moves[4 * cell + heading, :2]]
                chosen[4 * cell + heading] = 2 if heading == way else int(turns[1])
        return chosen

    def high_policy(self, features: torch.Tensor) -> torch.Tensor:
        place, goal = features[:, :PLACES].argmax(1), features[:, PLACES : Segments.z_size].argmax(1)
        return F.one_hot(self.skills[place, goal], self.num_skills).float()

    def policy(self, features: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
        cell, heading = features[:, Segments.z_size :].split((CELLS, 4), 1)
        return F.one_hot(self.actions[skill.argmax(1), 4 * cell.argmax(1) + heading.argmax(1)], 3).float()


def mean_entropy(p: torch.Tensor) -> float:
    return float(-(p * p.clamp(min=1e-12).log()).sum(-1).mean())


@torch.no_grad()
def use_of_skills(behaviour: hrl.Behaviour, model: Segments) -> tuple[float, float]:
    """I(e; z) of π^H, and I(e; a | w, z) of skills that are as likely as each other, in nats, over all starts."""
    features = model.begin(*torch.from_numpy(hrl.maze(11).starts.T.copy())).features()
    chosen = behaviour.high_policy(features).softmax(-1)
    skills = torch.eye(behaviour.num_skills)
    acts = torch.stack([behaviour.policy(features, skill.expand(len(features), -1)).softmax(-1) for skill in skills])
    return mean_entropy(chosen.mean(0)) - mean_entropy(chosen), mean_entropy(acts.mean(0)) - mean_entropy(acts)


def learn(every: int, sees_z: str, updates: int, seed: int) -> tuple[list[float], float, float, float]:
    """Learn in dreams from anywhere in the maze.

    Returns the greedy policies' return at each look; in the end that with skills drawn evenly, and `use_of_skills`.
    """
    args = hrl.complete_args(hrl.Args())
    args.deter_z, args.stoch_z = Segments.z_size, 0
    torch.manual_seed(seed)
    model, maze = Segments(every), hrl.maze(11)
    learner = hrl.Learner(args, model, torch.device("cpu"))
    prepare(learner.behaviour, sees_z)
    goals, returns = torch.from_numpy(np.flatnonzero(maze.rooms < 4)), []  # a goal is in a room, not in a door
    for update in range(1, updates + 1):
        pose, goal = torch.randint(4 * CELLS, (args.starts,)), goals[torch.randint(len(goals), (args.starts,))]
        learner.learn_behaviour(model.begin(pose, torch.where(pose // 4 == goal, goals[0], goal)))
        if update % (updates // LOOKS) == 0:
            returns.append(float(true_returns(learner.behaviour, model).mean()))
    drawn = float(true_returns(learner.behaviour, model, draws_skills=True).mean())
    return returns, drawn, *use_of_skills(learner.behaviour, model)


def main(args: Args) -> None:
    check_updates(args.updates)
    if args.seeds < 1:
        raise UsageError(f"--seeds {args.seeds}: must be at least 1")
    args.out.mkdir(parents=True, exist_ok=True)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    looks = " | ".join(f"{(look + 1) * (args.updates // LOOKS):,}" for look in range(LOOKS))
    lines = [
        f"| segments | π^L sees | V^L sees | seed | {looks} | any skill | I(e; z) | I(e; a \\| w, z) | minutes |",
        "|" + "---|" * (LOOKS + 8),
    ]
    print("\n".join(lines))
    kinds = {0: "rooms and doors", 4: "4 steps"}
    for every, segments in kinds.items():
        model = Segments(every)
        tables = Tables(model)
        returns = [float(true_returns(tables, model, draws_skills).mean()) for draws_skills in (False, True)]
        blank = " | " * (LOOKS - 1)
        lines.append(f"| {segments} | w, e | by hand | {blank} | {returns[0]:.3f} | {returns[1]:.3f} | | | |")
        print(lines[-1], flush=True)
    for every, segments in kinds.items():
        for sees_z in args.sees_z:
            for seed in range(1, args.seeds + 1):
                begin = time.perf_counter()
                returns, drawn, of_z, of_action = learn(every, sees_z, args.updates, seed)
                cells = [segments, VIEWS[sees_z], seed, *(f"{value:.3f}" for value in returns)]
                cells += [
                    f"{drawn:.3f}",
                    f"{of_z:.3f}",
                    f"{of_action:.3f}",
                    f"{(time.perf_counter() - begin) / 60:.1f}",
                ]
                lines.append(f"| {' | '.join(map(str, cells))} |")
                print(lines[-1], flush=True)
    head = f"`benchmark/dreamer_skills.py` at {commit()}: greedy return after so many updates, one thread.\n\n"
    (args.out / "skills.md").write_text(head + "\n".join(lines) + "\n")


if __name__ == "__main__":
    run_main(main, Args, __doc__)
