"""DreamerV2 with discrete actions in FourRooms: the baseline of the hierarchical world model's agents (thesis section 3.5.2).

    python cleanrl_thesis/dreamer_v2.py --size xs                          # small enough for a CPU core
    python cleanrl_thesis/dreamer_v2.py --size thesis --cuda --compile     # the thesis' sizes, 2,000,000 steps

A recurrent state-space model learns from the whole history of play to reconstruct frames, rewards and ends; actor and critic
learn in what it imagines (Hafner et al. 2021). The replay keeps each state as three numbers and draws its frame when it is
sampled. `--run-dir DIR --resume` can be sent again after every crash: on the same machine the run ends with the same bytes.

The thesis gives the size of the state, 1,624 numbers, and 400,000 updates in 2,000,000 steps (here 390,000, for there are none
during the random play); the other sizes and rates of `--size thesis` are those of DreamerV2 and of the public code of the thesis'
author.

| | `--size thesis` | `--size xs` |
|---|---|---|
| frames | 64 × 64, CNN of depth 48 | 22 × 22, a linear map of each 2 × 2 pixels (a cell of the 11 × 11 maze has four) |
| state | deter 600, 32 × 32 classes | deter 128, 16 × 32 classes |
| image | pixels / 255 − 0.5, weight 1 | mean frame subtracted, channels of unit size, weight 0.25 |
| KL | scale 0.1 | scale 1 after a warm-up of 1,000 updates: at 0.1 it pays to ignore the agent, a few pixels |
| codes | no bonus for their entropy | a bonus during the warm-up: without it codes of some seeds show the goal alone for hundreds of updates; a whole run without it did as well * |
| batches | 16 × 50, all states start a dream | 24 × 10, 64 states start one; a tenth of the chunks hold a reward: with all drawn from anywhere nothing was learned in 60,000 steps * |
| γ | 0.999 | 0.95: the frame does not show the time that a reward depends on, so only γ makes the agent hurry; at 0.99 a wrong value lives long, for states that see no reward learn it from each other |
| Adam's ε | 1e-5 | 1e-8 for actor and critic; 1e-5 did as well * |
| random play at first | 50,000 steps | 1,000,000 steps, with a reward or more at each of 64 goal cells; after 200,000 there are 10 to 17 without one, which are never sought |
| rates | 2e-4, 4e-5, 1e-4 | 3e-3 for the model (1e-3 did as well *), 1e-3 for actor and critic |
| rewards | tanh, weight 1 | as they are, weight 10 |
| layers | SiLU, where DreamerV2 has ELU, which is slower on large batches; the last layer of each head starts at 0 | the same, normalised in the heads |

Where there is a *: one run, 60,000 steps with updates (`benchmark/results/dreamer/xs/table.md`).
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "gymnasium>=1.2",
#     "matplotlib>=3.9",
#     "minigrid>=3.0",
#     "numpy>=2.0",
#     "safetensors>=0.4",
#     "tensorboard>=2.17",
#     "torch>=2.7",
#     "tqdm>=4.66",
#     "tyro>=0.9",
# ]
# ///
import contextlib
import copy
import csv
import ctypes
import fcntl
import functools
import hashlib
import importlib.util
import io
import itertools
import json
import math
import os
import platform
import re
import resource
import shutil
import signal
import sys
import time
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import gymnasium as gym
import minigrid
import numpy as np
import safetensors.torch
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from minigrid.core.grid import Grid
from minigrid.core.world_object import Goal, Wall
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    exp_name: str = "dreamer_v2"
    """the name of this experiment"""
    seed: int = 1
    """seed of the experiment"""
    torch_deterministic: bool = True
    """sets `torch.backends.cudnn.deterministic`"""
    cuda: bool = False
    """train on the GPU where there is one"""
    num_threads: int = 1
    """threads of torch; one lets a sweep fill the machine with runs"""
    compile: bool = False
    """compile the steps of the model and of the dream (needs a C++ compiler; compiling takes a minute, once)"""
    bf16: bool = False
    """matrix products and convolutions in bfloat16, where that is faster"""
    track: bool = False
    """also log to Weights and Biases (`pip install wandb`)"""
    wandb_project_name: str = "cleanrl-thesis"
    """the project of Weights and Biases"""
    wandb_entity: str | None = None
    """the team of Weights and Biases"""
    capture_video: bool = False
    """record the first evaluation episode, and a dream below what happened, into `videos/` (`pip install moviepy`)"""
    save_model: bool = False
    """write `model.safetensors` at the end"""
    eval_episodes: int = 500
    """episodes of the evaluation at the end, with the most probable action"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 20_000
    """environment steps between checkpoints"""
    stop_at: int | None = None
    """end at this environment step of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: Literal["FourRooms11-v0", "FourRooms19-v0"] = "FourRooms11-v0"
    """the maze of 11 × 11 cells (the author's code) or of 19 × 19 (MiniGrid)"""
    size: Literal["xs", "s", "m", "thesis"] = "xs"
    """what the flags below whose default is None stand for (`SIZES`); sources are those of `thesis`, the other values are ours"""
    total_timesteps: int = 2_000_000
    """environment steps (section 3.4)"""
    num_envs: int = 10
    """games side by side (ours)"""
    prefill: int | None = None
    """first environment steps, of random play, without updates (DreamerV2)"""
    train_frequency: int = 5
    """environment steps per update (section 3.4: 400,000 updates)"""
    batch_size: int | None = None
    """chunks per batch (DreamerV2)"""
    chunk_length: int | None = None
    """steps of a chunk; episodes follow each other in it (DreamerV2)"""
    rewarded_share: float | None = None
    """share of a batch's chunks that are drawn so that they hold a reward, above 0 at least one chunk, as soon as the replay holds a
    reward; the others are drawn from anywhere (ours)"""
    starts: int | None = None
    """states of a batch at which dreams start, at most (DreamerV2: all)"""
    horizon: int = 15
    """steps of a dream (DreamerV2)"""
    gamma: float | None = None
    """discount factor γ (DreamerV2)"""
    gae_lambda: float = 0.95
    """λ of the returns (DreamerV2)"""

    # World model
    encoder: Literal["tiles", "cnn"] | None = None
    """a linear map of 2 × 2 pixels each (ours), or convolutions over 64 × 64 (DreamerV2)"""
    frame_side: int | None = None
    """pixels of the frames' side; default: 64 for a CNN (DreamerV2), two for each cell for tiles (ours)"""
    depth: int | None = None
    """features of a tile, or channels of the first convolution (DreamerV2)"""
    deter: int | None = None
    """units of the recurrent state (DreamerV2; with the codes 1,624 numbers, as the Q&A says)"""
    stoch: int | None = None
    """categorical variables of the stochastic state (DreamerV2)"""
    classes: int | None = None
    """classes of each (DreamerV2)"""
    hidden_size: int | None = None
    """units of hidden layers in the model (DreamerV2)"""
    head_size: int | None = None
    """units of hidden layers in reward, discount, actor and critic (DreamerV2)"""
    head_layers: int | None = None
    """hidden layers in these (DreamerV2)"""
    head_norm: bool | None = None
    """layer normalisation in these (ours)"""
    image_scale: float | None = None
    """weight of the reconstruction (DreamerV2: 1)"""
    kl_scale: float | None = None
    """weight of the KL divergence (DreamerV2)"""
    entropy_scale: float | None = None
    """weight of a bonus for the entropy of the codes, annealed to 0 over `--kl-warmup`; without it the codes become sharp on the
    goal, which is learned first, and some seeds do not see the agent for hundreds of updates (ours)"""
    kl_warmup: int | None = None
    """updates over which the weight of the KL divergence grows from a tenth (ours)"""
    kl_balance: float = 0.8
    """share of its gradient that trains the prior, the rest trains the posterior (DreamerV2)"""
    reward_scale: float | None = None
    """weight of the reward's loss (DreamerV2: 1)"""
    discount_scale: float = 5.0
    """weight of the loss of the end of an episode (DreamerV2)"""
    tanh_reward: bool | None = None
    """learn tanh(reward) (DreamerV2)"""
    model_learning_rate: float | None = None
    """Adam's learning rate for the world model (DreamerV2)"""

    # Behaviour
    actor_learning_rate: float | None = None
    """Adam's learning rate for the actor (DreamerV2)"""
    critic_learning_rate: float | None = None
    """Adam's learning rate for the critic (DreamerV2)"""
    adam_eps: float | None = None
    """Adam's ε for actor and critic; 1e-5 for the world model (DreamerV2)"""
    ent_coef: float | None = None
    """weight of the actor's entropy η (Eq. 3.3.9; DreamerV2)"""
    slow_interval: int = 100
    """updates between copies of the critic to the slow critic (DreamerV2)"""
    weight_decay: float = 1e-6
    """share of each weight that an update takes away (DreamerV2)"""
    max_grad_norm: float = 100.0
    """bound on the norm of each gradient; inf for none (DreamerV2)"""


SIZES = {  # what a flag that is not given stands for, by --size
    "size": ("xs", "s", "m", "thesis"),
    "prefill": (1_000_000, 1_000_000, 50_000, 50_000),
    "batch_size": (24, 24, 16, 16),
    "chunk_length": (10, 10, 50, 50),
    "rewarded_share": (0.1, 0.1, 0.0, 0.0),
    "starts": (64, 64, 800, 800),
    "gamma": (0.95, 0.95, 0.999, 0.999),
    "encoder": ("tiles", "tiles", "cnn", "cnn"),
    "depth": (16, 24, 16, 48),
    "deter": (128, 256, 200, 600),
    "stoch": (16, 32, 32, 32),
    "classes": (32, 32, 32, 32),
    "hidden_size": (128, 256, 200, 600),
    "head_size": (128, 256, 200, 400),
    "head_layers": (2, 2, 4, 4),
    "head_norm": (True, True, False, False),
    "image_scale": (0.25, 0.25, 1.0, 1.0),
    "kl_scale": (1.0, 1.0, 0.1, 0.1),
    "entropy_scale": (0.3, 0.3, 0.0, 0.0),
    "kl_warmup": (1_000, 1_000, 0, 0),
    "reward_scale": (10.0, 10.0, 1.0, 1.0),
    "tanh_reward": (False, False, True, True),
    "model_learning_rate": (3e-3, 3e-3, 2e-4, 2e-4),
    "actor_learning_rate": (1e-3, 1e-3, 4e-5, 4e-5),
    "critic_learning_rate": (1e-3, 1e-3, 1e-4, 1e-4),
    "adam_eps": (1e-8, 1e-8, 1e-8, 1e-5),
    "ent_coef": (3e-3, 3e-3, 1e-3, 1e-3),
}


class UsageError(Exception):
    """A user's mistake, told in one line; the exit code is 2."""


class RunError(Exception):
    """A run that cannot go on, told in one line; the exit code is 1."""


def parse_args(argv: list[str] | None = None) -> Args:
    """Read the command line. Raises UsageError with one line where tyro prints a box."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Args, args=argv, description=__doc__.split("\n\n")[0])
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│ ") for line in complaint.getvalue().splitlines()]
        message = " ".join(line for line in lines[1:] if line and line[0] not in "─╰").split("For full helptext")[0]
        raise UsageError(message.split("Argument helptext")[0].strip()) from None


def first_line(error: Exception) -> str:
    return (str(error) or repr(error)).splitlines()[0]


def require(holds: bool, flag: str, value: object, allowed: str) -> None:
    """Raise UsageError naming the flag, its value and what is allowed, unless `holds`."""
    if not holds:
        raise UsageError(f"{flag} {value}".strip() + f": {allowed}")


def complete_args(args: Args) -> Args:
    """Fill in the values that follow from others, and check all. Raises UsageError."""
    column = SIZES["size"].index(args.size)
    for name, values in SIZES.items():
        setattr(args, name, values[column] if getattr(args, name) is None else getattr(args, name))
    if args.frame_side is None:
        args.frame_side = 64 if args.encoder == "cnn" else 2 * ROOM_SIZES[args.env_id]
    args.stop_at = args.total_timesteps if args.stop_at is None else args.stop_at
    counts = "num_envs eval_episodes checkpoint_interval stop_at train_frequency batch_size starts horizon"
    counts += " depth deter stoch hidden_size head_size head_layers slow_interval"
    rates = "model_learning_rate actor_learning_rate critic_learning_rate adam_eps image_scale"
    scales = "kl_scale entropy_scale reward_scale discount_scale ent_coef"
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("chunk_length classes", lambda x: x >= 2, "must be at least 2"),
        (rates, lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("max_grad_norm", lambda x: x > 0, "must be greater than 0"),
        (scales, lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("gamma gae_lambda kl_balance rewarded_share weight_decay", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("kl_warmup", lambda x: x >= 0, "must be at least 0"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("prefill total_timesteps", lambda x: x >= BLOCK and x % BLOCK == 0, f"must be a multiple of {BLOCK}"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    divides = BLOCK % args.num_envs == 0
    require(divides, "--num-envs", args.num_envs, f"must divide {BLOCK}, the steps of a row of updates.csv")
    fits = args.prefill // args.num_envs > args.chunk_length
    require(fits, "--prefill", args.prefill, "must give each game more steps than --chunk-length")
    more = args.prefill < args.total_timesteps
    require(more, "--prefill", args.prefill, f"must be less than --total-timesteps {args.total_timesteps}")
    if args.encoder == "cnn":
        require(args.frame_side == 64, "--frame-side", args.frame_side, "must be 64 with --encoder cnn")
    holds = 8 <= args.frame_side <= 128 and args.frame_side % 2 == 0
    require(holds, "--frame-side", args.frame_side, "must be an even number from 8 to 128")
    warms = args.entropy_scale == 0 or args.kl_warmup > 0
    require(warms, "--entropy-scale", args.entropy_scale, "does nothing without --kl-warmup")
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UsageError("--track: needs Weights and Biases: pip install wandb")
    if args.capture_video and importlib.util.find_spec("moviepy") is None:
        raise UsageError("--capture-video: needs moviepy: pip install moviepy")
    return args


# ---------------------------------------------------------------------------------------------------------------------
# FourRooms
# ---------------------------------------------------------------------------------------------------------------------
MAX_STEPS = 100  # H, after which an episode is cut off
DOORS = {  # x, y of the upper, left, right and lower door
    11: ((5, 2), (2, 5), (7, 5), (5, 8)),
    19: ((9, 7), (6, 9), (14, 9), (9, 12)),  # those that MiniGrid draws with seed 0
}
HEADINGS = np.array([(1, 0), (0, 1), (-1, 0), (0, -1)])  # x, y of a step forward: MiniGrid's directions 0 to 3
TILE_SIDE = 32  # pixels of a cell in MiniGrid's picture


class Maze:
    """Four rooms with fixed doors, as tables over the C free cells and the 4 C poses (4 · cell + direction).

    In the maze of 11 cells the goal is in another room than the agent and at least 3 cells away, and neither is in a
    door; in that of 19 cells both are on any two cells, as MiniGrid places them.
    """

    def __init__(self, size: int):
        self.size = size
        wall = np.zeros((size, size), bool)  # by x, y
        wall[:: size // 2], wall[:, :: size // 2] = True, True
        wall[tuple(np.transpose(DOORS[size]))] = False
        self.cells = np.argwhere(~wall)  # (C, 2) x, y
        self.cell_at = np.full((size, size), -1)  # (size, size) by x, y; -1 in a wall
        self.cell_at[tuple(self.cells.T)] = np.arange(len(self.cells))
        x, y = self.cells.T
        self.rooms = 2 * (x > size // 2) + (y > size // 2)  # (C,): 0 to 3 are rooms, 4 to 7 doors
        self.rooms[self.cell_at[tuple(np.transpose(DOORS[size]))]] = range(4, 8)
        self.moves = self.find_moves()
        self.starts = self.find_starts()

    def find_moves(self) -> np.ndarray:
        """The pose after each action in each pose, (4 C, 3)."""
        poses = np.arange(4 * len(self.cells))
        cells, directions = poses // 4, poses % 4
        ahead = self.cell_at[tuple((self.cells[cells] + HEADINGS[directions]).T)]
        forward = np.where(ahead < 0, poses, 4 * ahead + directions)
        return np.stack([4 * cells + (directions - 1) % 4, 4 * cells + (directions + 1) % 4, forward], 1)

    def find_starts(self) -> np.ndarray:
        """All pairs of the agent's pose and the goal's cell with which an episode can begin, (S, 2)."""
        agents, goals = np.indices((len(self.cells), len(self.cells))).reshape(2, -1)
        allowed = agents != goals
        if self.size == 11:
            distance = np.abs(self.cells[agents] - self.cells[goals]).sum(1)
            rooms = self.rooms[agents], self.rooms[goals]
            allowed = (distance >= 3) & (rooms[0] != rooms[1]) & (np.maximum(*rooms) < 4)
        pairs = np.stack([agents[allowed], goals[allowed]], 1)
        return (pairs[:, None] * [4, 1] + np.arange(4)[:, None] * [1, 0]).reshape(-1, 2)


def area_weights(length: int, side: int) -> np.ndarray:
    """The matrix (side, length) that shrinks a line of pixels by averaging, each weighted by the part of it that is covered."""
    edges = np.linspace(0, length, side + 1)
    pixels = np.arange(length)
    covered = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return np.maximum(covered, 0) * side / length


class Painter:
    """Draws states as frames (side, side, 3): MiniGrid's picture of the whole maze, without highlight, shrunk.

    Shrinking is linear, so a frame is one of the C frames of a goal, with what the agent changes in the window around
    its cell added to it.
    """

    def __init__(self, maze: Maze, side: int):
        self.side = side
        weights = area_weights(TILE_SIDE * maze.size, side).reshape(side, maze.size, TILE_SIDE)

        def shrunk(tile: np.ndarray, cell: np.ndarray) -> np.ndarray:
            """What a tile (32, 32, 3) in the cell x, y adds to the frame, (side, side, 3)."""
            return np.einsum("ia,abc,jb->ijc", weights[:, cell[1]], tile, weights[:, cell[0]], optimize=True)

        def tile(thing, direction: int | None = None) -> np.ndarray:
            return Grid.render_tile(thing, agent_dir=direction, tile_size=TILE_SIDE).astype(np.float64)

        floor, goal, wall = tile(None), tile(Goal()), tile(Wall())
        everywhere = np.indices((maze.size, maze.size)).reshape(2, -1).T
        empty = sum(shrunk(wall if maze.cell_at[tuple(cell)] < 0 else floor, cell) for cell in everywhere)
        with_goal = [np.rint(empty + shrunk(goal - floor, cell)) for cell in maze.cells]
        self.goal_frames = np.ascontiguousarray(with_goal, np.uint8).reshape(len(with_goal), -1)  # (C, 3 side²)
        width = math.ceil(side / maze.size) + 1
        corners = np.minimum(maze.cells * side // maze.size, side - width)  # (C, 2) x, y
        inside = np.arange(width)
        rows, columns = corners[:, 1, None, None] + inside[:, None], corners[:, 0, None, None] + inside
        pixels = (rows * side + columns).reshape(len(corners), -1)
        self.windows = (3 * pixels[:, :, None] + np.arange(3)).reshape(len(corners), -1)  # (C, K) indices of bytes
        self.changes = np.zeros((2, 4 * len(corners), self.windows.shape[1]), np.uint8)  # modulo 256
        for pose in range(4 * len(corners)):
            cell = pose // 4
            for on_goal, thing in enumerate((None, Goal())):
                before = empty + on_goal * shrunk(goal - floor, maze.cells[cell])
                after = before + shrunk(tile(thing, pose % 4) - (goal if on_goal else floor), maze.cells[cell])
                change = np.rint(after) - np.rint(before)
                self.changes[on_goal, pose] = change.reshape(-1)[self.windows[cell]].astype(np.int64) % 256

    def draw(self, poses: np.ndarray, goals: np.ndarray) -> np.ndarray:
        """The frames (N, side, side, 3) uint8 of poses (N,) and goal cells (N,)."""
        frames, cells = self.goal_frames[goals], poses // 4
        changed = self.windows[cells] + frames.shape[1] * np.arange(len(frames))[:, None]
        frames.reshape(-1)[changed] += self.changes[(cells == goals).astype(np.intp), poses]
        return frames.reshape(-1, self.side, self.side, 3)


@functools.lru_cache
def maze(size: int) -> Maze:
    return Maze(size)


@functools.lru_cache
def painter(size: int, side: int) -> Painter:
    return Painter(maze(size), side)


def mixed(bits: np.ndarray) -> np.ndarray:
    """Scramble 64-bit numbers (the output function of SplitMix64), so that neighbours have nothing in common."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


class FourRoomsGames:
    """N games side by side, by tables. The starts of a game follow from its key, 64 random bits, and their number."""

    def __init__(self, size: int, num_games: int):
        self.maze = maze(size)
        self.keys, self.draws = (np.zeros(num_games, np.uint64) for _ in range(2))
        self.poses, self.goals, self.steps = (np.zeros(num_games, np.intp) for _ in range(3))

    def seed(self, game: int, rng: np.random.Generator) -> None:
        """Give a game a new key."""
        self.keys[game], self.draws[game] = rng.integers(2**64, dtype=np.uint64), 0

    def begin(self, games: np.ndarray) -> None:
        """Start an episode in the games of the given indices."""
        self.draws[games] += np.uint64(1)
        bits = mixed(self.keys[games] + self.draws[games] * np.uint64(0x9E3779B97F4A7C15))
        starts = self.maze.starts[bits % np.uint64(len(self.maze.starts))]
        self.poses[games], self.goals[games], self.steps[games] = starts[:, 0], starts[:, 1], 0

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Move by actions (N,); return rewards (N,), 1 − 0.9 steps / H at the goal, and which games are there."""
        self.poses = self.maze.moves[self.poses, actions]
        self.steps += 1
        reached = self.poses // 4 == self.goals
        return np.where(reached, 1 - 0.9 * (self.steps / MAX_STEPS), 0.0), reached

    def state(self) -> np.ndarray:
        """Cell, direction and goal cell of each game, (N, 3)."""
        return np.stack([self.poses // 4, self.poses % 4, self.goals], 1)


ROOM_ACTIONS = gym.spaces.Discrete(3)  # left, right, forward


def room_frames(side: int) -> gym.spaces.Box:
    return gym.spaces.Box(0, 255, (side, side, 3), np.uint8)


def make_info(games: FourRoomsGames) -> dict[str, np.ndarray]:
    """`state` (N, 3): cell, direction, goal cell; `room` (N,): 0 to 3, or 4 to 7 in a door."""
    state = games.state()
    return {"state": state, "room": games.maze.rooms[state[:, 0]]}


class FourRoomsVectorEnv(gym.vector.VectorEnv):
    """FourRooms N times side by side, by tables; a game that ends begins anew within the same step."""

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": 10,
        "autoreset_mode": gym.vector.AutoresetMode.SAME_STEP,
    }

    def __init__(self, num_envs: int = 1, size: int = 11, side: int = 64, render_mode: str | None = None):
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space, self.single_action_space = room_frames(side), ROOM_ACTIONS
        self.observation_space = gym.vector.utils.batch_space(self.single_observation_space, num_envs)
        self.action_space = gym.vector.utils.batch_space(ROOM_ACTIONS, num_envs)
        self.games, self.all_games = FourRoomsGames(size, num_envs), np.arange(num_envs)
        self.painter = painter(size, side)
        self.seed_games(np.random.SeedSequence().generate_state(num_envs).tolist())

    def seed_games(self, seeds: list[int]) -> None:
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} games")
        for game, seed in enumerate(seeds):
            self.games.seed(game, gym.utils.seeding.np_random(seed)[0])

    def draw(self) -> np.ndarray:
        """The frames of all games, (N, side, side, 3)."""
        return self.painter.draw(self.games.poses, self.games.goals)

    def reset(self, *, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin every game anew; a list of seeds gives each game its own, as if it were played alone."""
        if seed is not None:
            is_number = isinstance(seed, (int, np.integer))
            seeds = np.random.SeedSequence(int(seed)).generate_state(self.num_envs).tolist() if is_number else seed
            self.seed_games(seeds)
        self.games.begin(self.all_games)
        return self.draw(), make_info(self.games)

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        rewards, terminated = self.games.step(actions)
        truncated = self.games.steps == MAX_STEPS
        ended, infos = terminated | truncated, {}
        if ended.any():
            infos = {"final_obs": self.draw(), "_final_obs": ended, "final_info": make_info(self.games)}
            self.games.begin(np.flatnonzero(ended))
        return self.draw(), rewards, terminated, truncated, {**make_info(self.games), **infos}

    def render(self) -> tuple[np.ndarray, ...]:
        return tuple(painter(self.games.maze.size, 16 * self.games.maze.size).draw(self.games.poses, self.games.goals))


ROOM_SIZES = {"FourRooms11-v0": 11, "FourRooms19-v0": 19}  # cells of the maze's side


# ---------------------------------------------------------------------------------------------------------------------
# The replay: the whole history, as numbers
# ---------------------------------------------------------------------------------------------------------------------
RECORD = np.dtype(  # a step of a game: the state that it led to, its action and its reward
    [("pose", "<u2"), ("goal", "<u2"), ("action", "u1"), ("first", "u1"), ("terminal", "u1"), ("reward", "<f4")]
)


class Chunks(NamedTuple):
    """B chunks of T steps: the action before each frame, and what it led to."""

    frames: torch.Tensor  # (T, B, side, side, 3) uint8
    actions: torch.Tensor  # (T, B) int64; 0 where an episode begins
    first: torch.Tensor  # (T, B), 1 where an episode, or the chunk, begins
    rewards: torch.Tensor  # (T, B)
    terminals: torch.Tensor  # (T, B), 1 where the goal was reached


def draw_from_rows(counts: np.ndarray, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Rows (number,) and places in them (number,), each of all the places (counts of each row) as likely as the other."""
    ends = np.cumsum(counts)
    drawn = torch.randint(int(ends[-1]), (number,)).numpy()
    rows = np.searchsorted(ends, drawn, side="right")
    return rows, drawn - (ends - counts)[rows]


class Replay:
    """A row of records for each game, one episode after the other, in a file of the run's folder that is written in place."""

    def __init__(self, path: Path, args: Args, goes_on: bool = False):
        """Raises RunError where the file of a run that goes on is not there whole."""
        self.args, self.painter = args, painter(ROOM_SIZES[args.env_id], args.frame_side)
        capacity = 2 * args.total_timesteps // args.num_envs + 2  # an episode has a first record and at least one more
        size = args.num_envs * capacity * RECORD.itemsize
        if goes_on and not (path.exists() and path.stat().st_size == size):
            raise RunError(f"{path}: missing or cut short; the run cannot go on without its replay")
        path.touch()
        with open(path, "r+b") as file:  # not "a": file systems without fallocate of their own refuse it then
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is an error here, not a signal later
            file.truncate(size)
        self.rows = np.memmap(path, RECORD, "r+", shape=(args.num_envs, capacity))
        self.lengths = np.zeros(args.num_envs, np.int64)
        self.rewarded: list[list[int]] = [[] for _ in range(args.num_envs)]  # of each game, the records with a reward

    def add(self, games: np.ndarray, state: np.ndarray, **columns) -> None:
        """Append a record to each of the games (G,): states (G, 3) and columns of RECORD, (G,) or a number."""
        record = np.zeros(len(games), RECORD)
        record["pose"], record["goal"] = 4 * state[:, 0] + state[:, 1], state[:, 2]
        for name, values in columns.items():
            record[name] = values
        for game in games[record["reward"] > 0].tolist():
            self.rewarded[game].append(int(self.lengths[game]))
        self.rows[games, self.lengths[games]] = record
        self.lengths[games] += 1

    def go_on(self, lengths: np.ndarray) -> None:
        """Take up the rows of a run that goes on, of these lengths; what was written after them is forgotten."""
        self.lengths[:] = lengths
        self.rewarded = [np.flatnonzero(row["reward"][:length] > 0).tolist() for row, length in zip(self.rows, lengths)]

    def example(self, device: torch.device) -> Chunks:
        """A batch of the right shapes, to compile with."""
        shape, side = (self.args.chunk_length, self.args.batch_size), self.args.frame_side
        frames, zeros = torch.zeros(*shape, side, side, 3, dtype=torch.uint8), torch.zeros(shape)
        return Chunks(*(tensor.to(device) for tensor in (frames, zeros.long(), zeros, zeros, zeros)))

    def places(self) -> tuple[np.ndarray, np.ndarray]:
        """Games (B,) and records (B,) where chunks begin: anywhere, or for `--rewarded-share` of them so that they hold a reward."""
        args, places = self.args, self.lengths - self.args.chunk_length + 1
        counts = np.array([len(rows) for rows in self.rewarded])
        least = int(args.rewarded_share > 0)
        rewarded = max(least, round(args.rewarded_share * args.batch_size)) if counts.any() else 0
        games, begins = draw_from_rows(places, args.batch_size - rewarded)
        if rewarded:
            winners, numbers = draw_from_rows(counts, rewarded)
            ends = np.array([self.rewarded[game][number] for game, number in zip(winners, numbers)])
            begin = ends - torch.randint(args.chunk_length, (rewarded,)).numpy()
            games = np.concatenate([games, winners])
            begins = np.concatenate([begins, begin.clip(0, places[winners] - 1)])
        return games, begins

    def sample(self, device: torch.device) -> Chunks:
        """A batch of chunks."""
        args = self.args
        games, begins = self.places()
        records = self.rows[games, begins + np.arange(args.chunk_length)[:, None]]  # (T, B)
        frames = self.painter.draw(records["pose"].ravel().astype(np.intp), records["goal"].ravel().astype(np.intp))
        actions = records["action"].astype(np.int64)
        first, rewards, terminals = (records[name].astype(np.float32) for name in ("first", "reward", "terminal"))
        first[0] = 1
        arrays = frames.reshape(*records.shape, *frames.shape[1:]), actions, first, rewards, terminals
        return Chunks(*(torch.from_numpy(array).to(device) for array in arrays))


# ---------------------------------------------------------------------------------------------------------------------
# Networks
# ---------------------------------------------------------------------------------------------------------------------
class GRUCell(nn.Module):
    """GRU with layer normalisation, whose update gate is biased towards keeping the state (as DreamerV2's)."""

    def __init__(self, input_size: int, state_size: int):
        super().__init__()
        self.linear = nn.Linear(input_size + state_size, 3 * state_size, bias=False)
        self.norm = nn.LayerNorm(3 * state_size)

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Input (N, input_size) and state (N, state_size) -> the next state (N, state_size)."""
        reset, candidate, update = self.norm(self.linear(torch.cat([x, state], -1))).chunk(3, -1)
        update = torch.sigmoid(update - 1)
        return update * torch.tanh(torch.sigmoid(reset) * candidate) + (1 - update) * state


def head(input_size: int, hidden_size: int, output_size: int, layers: int, norm: bool) -> nn.Sequential:
    """Densely connected layers with SiLU, each behind a layer normalisation where `norm`; the last one starts at 0."""
    sizes, modules = [input_size] + [hidden_size] * layers, []
    for a, b in zip(sizes, sizes[1:]):
        modules += [nn.Linear(a, b), *([nn.LayerNorm(b)] if norm else []), nn.SiLU()]
    last = nn.Linear(sizes[-1], output_size)
    nn.init.zeros_(last.weight)
    nn.init.zeros_(last.bias)
    return nn.Sequential(*modules, last)


class TileEncoder(nn.Module):
    """One linear map of every 2 × 2 pixels; its features, side by side, are the embedding."""

    def __init__(self, side: int, depth: int):
        super().__init__()
        self.map, self.size = nn.Linear(12, depth), depth * (side // 2) ** 2

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """(N, side, side, 3) -> (N, size)"""
        tiles = frames.unflatten(2, (-1, 2)).unflatten(1, (-1, 2)).transpose(2, 3).flatten(3)  # (N, rows, columns, 12)
        return F.silu(self.map(tiles)).flatten(1)


class TileDecoder(nn.Module):
    """Linear from the features to all tiles: a hidden layer would make codes that the prior cannot predict."""

    def __init__(self, input_size: int, side: int, depth: int):
        super().__init__()
        self.side, self.depth = side, depth
        self.spread, self.map = nn.Linear(input_size, depth * (side // 2) ** 2), nn.Linear(depth, 12)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """(N, features) -> (N, side, side, 3)"""
        rows = self.side // 2
        pixels = self.map(self.spread(features).unflatten(1, (rows, rows, self.depth)))  # (N, rows, columns, 2 · 2 · 3)
        return pixels.unflatten(3, (2, 6)).transpose(2, 3).reshape(-1, self.side, self.side, 3)


class ConvEncoder(nn.Module):
    """Four convolutions of stride 2 over 64 × 64 pixels."""

    def __init__(self, depth: int):
        super().__init__()
        channels = [3, depth, 2 * depth, 4 * depth, 8 * depth]
        layers = [layer for a, b in zip(channels, channels[1:]) for layer in (nn.Conv2d(a, b, 4, 2), nn.SiLU())]
        self.layers, self.size = nn.Sequential(*layers).to(memory_format=torch.channels_last), 32 * depth

    def forward(self, frames: torch.Tensor) -> torch.Tensor:
        """(N, 64, 64, 3) -> (N, size)"""
        return self.layers(frames.permute(0, 3, 1, 2)).flatten(1)  # a permuted frame is channels_last


class ConvDecoder(nn.Module):
    """Four transposed convolutions to 64 × 64 pixels; the first one, over a single pixel, is a linear map."""

    def __init__(self, input_size: int, depth: int):
        super().__init__()
        channels = [4 * depth, 2 * depth, depth, 3]
        self.spread = nn.Linear(input_size, 32 * depth)
        self.first = nn.Linear(32 * depth, 5 * 5 * channels[0])
        layers = [nn.SiLU()]
        for a, b, kernel in zip(channels, channels[1:], (5, 6, 6)):
            layers += [nn.ConvTranspose2d(a, b, kernel, 2), nn.SiLU()]
        self.layers = nn.Sequential(*layers[:-1]).to(memory_format=torch.channels_last)

    def forward(self, features: torch.Tensor) -> torch.Tensor:
        """(N, features) -> (N, 64, 64, 3)"""
        pixels = self.first(self.spread(features)).unflatten(1, (5, 5, -1))  # (N, 5, 5, 4 depth)
        return self.layers(pixels.permute(0, 3, 1, 2)).permute(0, 2, 3, 1)  # a permuted picture is channels_last


def has_bf16(device: torch.device) -> bool:
    """Whether the device computes in bfloat16: a CPU without such instructions takes several times as long as in float32."""
    return device.type != "cpu" or torch.ops.mkldnn._is_mkldnn_bf16_supported()


def as_computed(x: torch.Tensor) -> torch.Tensor:
    """x in the type that matrix products are computed in: cast once, and not before each of them."""
    device = x.device.type
    return x.to(torch.get_autocast_dtype(device)) if torch.is_autocast_enabled(device) else x


def uniforms(*shape: int, device: torch.device) -> torch.Tensor:
    """Uniform numbers, drawn on the CPU: one random state to restore."""
    return torch.rand(shape).to(device)


def one_hot_sample(logits: torch.Tensor, uniform: torch.Tensor) -> torch.Tensor:
    """A one-hot draw from the softmax of logits (..., C), by one uniform number for each (...): the inverse of its distribution."""
    below = logits.detach().softmax(-1).cumsum(-1)
    index = torch.searchsorted(below, uniform[..., None] * below[..., -1:])
    index = index.clamp(max=logits.shape[-1] - 1)  # nan: the last
    return torch.zeros_like(below).scatter_(-1, index, 1.0)


def straight_through(logits: torch.Tensor, uniform: torch.Tensor) -> torch.Tensor:
    """A one-hot draw whose gradient is that of the probabilities."""
    probabilities = logits.softmax(-1)
    return one_hot_sample(logits, uniform) + probabilities - probabilities.detach()


class State(NamedTuple):
    """The world's state s_t."""

    stoch: torch.Tensor  # (..., stoch · classes), one-hot each
    deter: torch.Tensor  # (..., deter)

    def features(self) -> torch.Tensor:
        """What decoder, reward, discount, actor and critic see, (..., F)."""
        return torch.cat([self.stoch, self.deter], -1)


class Observed(NamedTuple):
    """What the model makes of T steps of B chunks."""

    state: State  # (T, B, ...)
    posterior: torch.Tensor  # (T, B, stoch, classes) logits
    prior: torch.Tensor  # (T, B, stoch, classes) logits


class WorldModel(nn.Module):
    """The recurrent state-space model with categorical states (Hafner et al. 2021)."""

    STEPS = ("filter", "imagine_step")  # what `--compile` compiles

    def __init__(self, args: Args, num_actions: int):
        super().__init__()
        self.args, self.num_actions = args, num_actions
        stoch, hidden, side = args.stoch * args.classes, args.hidden_size, args.frame_side
        self.feature_size = stoch + args.deter
        tiles = args.encoder == "tiles"
        self.register_buffer("frame_mean", torch.full((side, side, 3), 127.5))
        self.register_buffer("frame_scale", torch.full((side, side, 3), 255.0))
        self.encoder = TileEncoder(side, args.depth) if tiles else ConvEncoder(args.depth)
        self.decoder = (
            TileDecoder(self.feature_size, side, args.depth) if tiles else ConvDecoder(self.feature_size, args.depth)
        )
        self.input_stoch, self.input_action = nn.Linear(stoch, hidden), nn.Linear(num_actions, hidden, bias=False)
        self.rnn = GRUCell(hidden, args.deter)
        self.prior_layers = nn.Sequential(nn.Linear(args.deter, hidden), nn.SiLU(), nn.Linear(hidden, stoch))
        self.embed = nn.Linear(self.encoder.size, hidden)
        self.posterior_deter = nn.Linear(args.deter, hidden, bias=False)
        self.posterior_out = nn.Linear(hidden, stoch)
        self.reward = head(self.feature_size, args.head_size, 1, args.head_layers, args.head_norm)
        self.discount = head(self.feature_size, args.head_size, 1, args.head_layers, args.head_norm)

    def normalize(self, frames: torch.Tensor) -> torch.Tensor:
        """Frames (..., side, side, 3) uint8 -> what the model sees."""
        return (frames - self.frame_mean) / self.frame_scale

    def start(self, batch: int) -> State:
        sizes, like = (self.args.stoch * self.args.classes, self.args.deter), self.frame_mean
        return State(*(like.new_zeros(batch, size) for size in sizes))

    def logits(self, flat: torch.Tensor) -> torch.Tensor:
        return flat.unflatten(-1, (self.args.stoch, self.args.classes)).float()

    def recur(self, state: State, action: torch.Tensor) -> torch.Tensor:
        """h_t = f(s_{t-1}, a_{t-1}); action (B, A) one-hot -> (B, deter)."""
        return self.rnn(F.silu(self.input_stoch(state.stoch) + self.input_action(action)), state.deter)

    def prior(self, deter: torch.Tensor) -> torch.Tensor:
        """p(s_t | h_t): logits (..., stoch, classes)."""
        return self.logits(self.prior_layers(deter))

    def posterior(self, deter: torch.Tensor, embed: torch.Tensor) -> torch.Tensor:
        """q(s_t | h_t, o_t): logits (..., stoch, classes)."""
        return self.logits(self.posterior_out(F.silu(self.posterior_deter(deter) + embed)))

    def embedding(self, frames: torch.Tensor) -> torch.Tensor:
        """Normalised frames (N, side, side, 3) -> (N, hidden)."""
        return self.embed(self.encoder(frames))

    def noise(self, *shape: int) -> torch.Tensor:
        """What steps draw their states with, (*shape, stoch)."""
        return uniforms(*shape, self.args.stoch, device=self.frame_mean.device)

    def filter(self, state: State, action, begins, embed: torch.Tensor, noise: torch.Tensor) -> tuple:
        """One step with a frame: the state s_t, and the posterior's logits.

        action (B, A): the one before the frame; begins (B, 1): 1 where an episode begins, whose past is forgotten.
        """
        keep = 1 - begins
        deter = self.recur(State(*(keep * part for part in state)), keep * action)
        posterior = self.posterior(deter, embed)
        return State(straight_through(posterior, noise).flatten(-2), deter), posterior

    def observe(self, embed: torch.Tensor, actions: torch.Tensor, first: torch.Tensor) -> Observed:
        """Filter T steps: embed (T, B, hidden), actions (T, B, A), first (T, B)."""
        state, noise, made = self.start(embed.shape[1]), self.noise(*first.shape), []
        for t in range(len(embed)):
            state, posterior = self.filter(state, actions[t], first[t, :, None], embed[t], noise[t])
            made.append((*state, posterior))
        stoch, deter, posterior = (torch.stack(column) for column in zip(*made))
        return Observed(State(stoch, deter), posterior, self.prior(deter))

    def imagine_step(self, state: State, action: torch.Tensor, noise: torch.Tensor) -> State:
        """One step without a frame: s_t ~ p(s_t | h_t)."""
        deter = self.recur(state, action)
        return State(one_hot_sample(self.prior(deter), noise).flatten(-2), deter)

    def decode(self, state: State) -> torch.Tensor:
        """States (N, ...) -> normalised frames (N, side, side, 3)."""
        return self.decoder(state.features())

    def outcome(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features (..., F) of states -> the reward on arriving there, and the probability that the episode goes on, (...)."""
        return self.reward(features).squeeze(-1).float(), torch.sigmoid(self.discount(features).squeeze(-1).float())


def kl_categorical(q: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    """KL[q ‖ p] of independent categorical distributions by their logits (..., stoch, classes) -> (...)."""
    log_q, log_p = q.log_softmax(-1), p.log_softmax(-1)
    return (log_q.exp() * (log_q - log_p)).sum((-1, -2))


def entropy(logits: torch.Tensor) -> torch.Tensor:
    """Entropy of independent categorical distributions by their logits (..., stoch, classes) -> (...)."""
    log_p = logits.log_softmax(-1)
    return -(log_p.exp() * log_p).sum((-1, -2))


def balanced(kl, q, p, balance: float) -> torch.Tensor:
    """KL[q ‖ p], whose gradient trains p with weight `balance` and q with the rest (DreamerV2)."""
    still = [type(x)(*(part.detach() for part in x)) if isinstance(x, tuple) else x.detach() for x in (q, p)]
    return balance * kl(still[0], p) + (1 - balance) * kl(q, still[1])


def warm_up(args: Args, updates: int) -> float:
    """The share of its weight that the KL divergence has, from a tenth to all over `--kl-warmup` updates."""
    share = (updates + 1) / args.kl_warmup if args.kl_warmup else 1.0
    return min(1.0, max(0.1, share))


def world_model_loss(
    model: WorldModel, data: Chunks, updates: int
) -> tuple[torch.Tensor, State, dict[str, torch.Tensor]]:
    """The world model's loss of DreamerV2 (Hafner et al. 2021, section 2.1) per step after so many updates.

    Returns it, the states (T, B, ...), and the parts of the loss. The entropy of the codes, in the warm-up, is ours.
    """
    args = model.args
    frames = model.normalize(data.frames.flatten(0, 1))  # (T · B, side, side, 3)
    embed = model.embedding(frames).unflatten(0, data.first.shape)
    actions = F.one_hot(data.actions, model.num_actions).float()
    made = model.observe(embed, actions, data.first)
    features = as_computed(made.state.features().flatten(0, 1))
    image = 0.5 * F.mse_loss(model.decoder(features).float(), frames, reduction="sum") / len(frames)
    target = data.rewards.tanh() if args.tanh_reward else data.rewards
    reward = 0.5 * (model.reward(features).squeeze(-1).float() - target.flatten()).square().mean()
    goes_on = model.discount(features).squeeze(-1).float()
    discount = F.binary_cross_entropy_with_logits(goes_on, 1 - data.terminals.flatten())
    kl = balanced(kl_categorical, made.posterior, made.prior, args.kl_balance)
    share = warm_up(args, updates)
    loss = (
        args.image_scale * image
        + args.reward_scale * reward
        + args.discount_scale * discount
        + share * args.kl_scale * kl.mean()
        - (1 - share) * args.entropy_scale * entropy(made.posterior).mean()
    )
    inside = 1 - data.first  # a first frame costs tens of nats, which say nothing of the dynamics
    parts = {
        "image": image,
        "reward": reward,
        "discount": discount,
        "kl": (kl * inside).sum() / inside.sum().clamp(min=1),
    }
    return loss, made.state, {f"losses/{name}": value.detach() for name, value in parts.items()}


# ---------------------------------------------------------------------------------------------------------------------
# Behaviour: actor and critic in the dream
# ---------------------------------------------------------------------------------------------------------------------
class Behaviour(nn.Module):
    """Actor, critic, and the slow critic that the returns are made with."""

    STEPS = ("policy",)

    def __init__(self, args: Args, model: nn.Module):
        super().__init__()
        shape = args.head_layers, args.head_norm
        self.actor = head(model.feature_size, args.head_size, model.num_actions, *shape)
        self.critic = head(model.feature_size, args.head_size, 1, *shape)
        self.slow_critic = copy.deepcopy(self.critic).requires_grad_(False)

    def parts(self) -> dict[str, nn.Module]:
        """What learns, each by its own loss."""
        return {"actor": self.actor, "critic": self.critic}

    def copy_critics(self) -> None:
        self.slow_critic.load_state_dict(self.critic.state_dict())

    def policy(self, features: torch.Tensor) -> torch.Tensor:
        """Logits of the actions, (..., A)."""
        return self.actor(features).float()

    def value(self, features: torch.Tensor) -> torch.Tensor:
        """The critic's V of states with features (..., F), (...)."""
        return self.critic(features).squeeze(-1).float()

    def slow_value(self, features: torch.Tensor) -> torch.Tensor:
        """The slow critic's, (..., F) -> (...)."""
        return self.slow_critic(features).squeeze(-1).float()


class Dream(NamedTuple):
    """H steps from each of N states: action h is taken at state h and leads to state h + 1."""

    features: torch.Tensor  # (H + 1, N, F)
    actions: torch.Tensor  # (H, N, A) one-hot
    rewards: torch.Tensor  # (H, N), on arriving at state h + 1
    discounts: torch.Tensor  # (H, N): γ times the probability that the episode goes on at state h + 1


@torch.no_grad()
def imagine(model: nn.Module, behaviour: Behaviour, state: NamedTuple, horizon: int, gamma: float) -> Dream:
    """Dream from states (N, ...) by the actor's policy."""
    games = len(state.features())
    noise, choices = model.noise(horizon, games), uniforms(horizon, games, device=state[0].device)
    features, actions = [state.features()], []
    for h in range(horizon):
        actions.append(one_hot_sample(behaviour.policy(features[-1]), choices[h]))
        state = model.imagine_step(state, actions[-1], noise[h])
        features.append(state.features())
    stacked = as_computed(torch.stack(features))  # (H + 1, N, F)
    rewards, goes_on = model.outcome(stacked[1:])
    return Dream(stacked, torch.stack(actions), rewards, gamma * goes_on)


def lambda_return(
    rewards: torch.Tensor, discounts: torch.Tensor, values: torch.Tensor, gae_lambda: float
) -> torch.Tensor:
    """V_λ^h of Eq. 3.3.8, as in DreamerV2: G_h = r_{h+1} + d_{h+1} ((1 − λ) V_{h+1} + λ G_{h+1}), G_H = V_H.

    rewards and discounts (H, N), values (H + 1, N) -> (H, N).
    """
    returns, following = [], values[-1]
    for h in reversed(range(len(rewards))):
        following = rewards[h] + discounts[h] * ((1 - gae_lambda) * values[h + 1] + gae_lambda * following)
        returns.append(following)
    return torch.stack(returns[::-1])


def dream_weights(discounts: torch.Tensor) -> torch.Tensor:
    """How likely, and how much discounted, state h of a dream is: Π_{k ≤ h} d_k; discounts (H, N) -> (H, N), 1 at first."""
    return torch.cat([torch.ones_like(discounts[:1]), discounts[:-1]]).cumprod(0)


def behaviour_loss(
    behaviour: Behaviour, dream: Dream, gae_lambda: float, ent_coef: float
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """The losses of the actor (Eq. 3.3.9) and of the critic (Eq. 3.3.8) by their names, and what to log.

    Eq. 3.3.9 with the return less the slow critic in the place of V.
    """
    with torch.no_grad():
        values = behaviour.slow_value(dream.features)
        returns = lambda_return(dream.rewards, dream.discounts, values, gae_lambda)
        weights, advantages = dream_weights(dream.discounts), returns - values[:-1]
    log_policy = behaviour.policy(dream.features[:-1]).log_softmax(-1)
    entropy = -(log_policy.exp() * log_policy).sum(-1)
    logprobs = (log_policy * dream.actions).sum(-1)
    actor_loss = -(weights * (logprobs * advantages + ent_coef * entropy)).mean()  # Eq. 3.3.9
    critic_loss = (weights * 0.5 * (behaviour.value(dream.features[:-1]) - returns).square()).mean()  # Eq. 3.3.8
    losses = {"actor": actor_loss, "critic": critic_loss}
    parts = {**losses, "entropy": entropy.mean(), "advantage_std": advantages.std(correction=0)}
    parts |= {"dream_return": returns.mean(), "dream_reward": dream.rewards.max()}  # the greatest one, not the mean
    return losses, {f"losses/{name}": value.detach() for name, value in parts.items()}


class Learner:
    """The world model, the behaviour, and their optimisers."""

    def __init__(self, args: Args, model: nn.Module, device: torch.device):
        self.args, self.device, self.updates = args, device, 0
        self.bf16 = args.bf16 and has_bf16(device)
        self.model = model.to(device)
        self.behaviour = Behaviour(args, model).to(device)
        self.modules = {"model": self.model, **self.behaviour.parts()}
        self.optimizers = {name: self.make_optimizer(name) for name in self.modules}

    def make_optimizer(self, name: str) -> torch.optim.AdamW:
        """Adam with decoupled weight decay for one of the modules, at the rate of its kind."""
        args = self.args
        rates = {
            "model": args.model_learning_rate,
            "actor": args.actor_learning_rate,
            "critic": args.critic_learning_rate,
        }
        rate, eps = rates[name.split("_")[-1]], 1e-5 if name == "model" else args.adam_eps
        decay = args.weight_decay / rate  # torch multiplies it by the rate
        return torch.optim.AdamW(self.modules[name].parameters(), rate, eps=eps, weight_decay=decay, fused=True)

    def descend(self, **losses: torch.Tensor) -> None:
        """One step of Adam for each named loss."""
        for name in losses:
            self.optimizers[name].zero_grad()
        sum(losses.values()).backward()
        for name in losses:
            nn.utils.clip_grad_norm_(self.modules[name].parameters(), self.args.max_grad_norm)
            self.optimizers[name].step()

    def autocast(self) -> contextlib.AbstractContextManager:
        """bfloat16 for matrix products with `--bf16`."""
        return torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16)

    def update(self, data: Chunks) -> dict[str, torch.Tensor]:
        """One gradient step on everything (Eq. 3.3.11; with two levels Eq. 3.3.18); returns what to log."""
        states, parts = self.learn_model(data)
        return {**parts, **self.learn_behaviour(self.draw_starts(states, data.terminals))}

    def learn_model(self, data: Chunks) -> tuple[NamedTuple, dict[str, torch.Tensor]]:
        """One step of the world model; returns the states (T, B, ...) that it made, and what to log."""
        with self.autocast():
            loss, states, parts = world_model_loss(self.model, data, self.updates)
        self.descend(model=loss)
        return states, parts

    def learn_behaviour(self, begins: NamedTuple) -> dict[str, torch.Tensor]:
        """One step of actor and critic in dreams that begin at states (N, ...); returns what to log."""
        args = self.args
        with self.autocast():
            dream = imagine(self.model, self.behaviour, begins, args.horizon, args.gamma)
        with self.autocast():  # anew: older versions of torch keep weights that were cast without a gradient
            losses, parts = behaviour_loss(self.behaviour, dream, args.gae_lambda, args.ent_coef)
        self.descend(**losses)
        self.updates += 1
        if self.updates % args.slow_interval == 0:
            self.behaviour.copy_critics()
        return parts

    def draw_starts(self, states: NamedTuple, terminals: torch.Tensor) -> NamedTuple:
        """States (N, ...) of a batch (T, B, ...) that do not end an episode, `--starts` of them at most."""
        alive = torch.nonzero(terminals.flatten() == 0).squeeze(1)
        chosen = alive[torch.randperm(len(alive))[: self.args.starts].to(alive.device)]
        return type(states)(*(part.detach().flatten(0, 1)[chosen] for part in states))

    def is_finite(self) -> bool:
        parameters = itertools.chain(self.model.parameters(), self.behaviour.parameters())
        return all(bool(parameter.isfinite().all()) for parameter in parameters)

    def state_dict(self) -> dict:
        optimizers = {name: optimizer.state_dict() for name, optimizer in self.optimizers.items()}
        modules = {"model": self.model.state_dict(), "behaviour": self.behaviour.state_dict()}
        return {**modules, "optimizers": optimizers, "updates": self.updates}

    def load_state_dict(self, state: dict) -> None:
        self.model.load_state_dict(state["model"])
        self.behaviour.load_state_dict(state["behaviour"])
        for name, optimizer in self.optimizers.items():
            optimizer.load_state_dict(state["optimizers"][name])
        self.updates = state["updates"]


def compile_steps(learner: Learner, data: Chunks) -> bool:
    """Compile the steps of model, dream and actor where a compiler is at hand; return whether that went well."""
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
        return False
    model, behaviour, state = learner.model, learner.behaviour, torch.get_rng_state()
    plain = [(owner, name, getattr(owner, name)) for owner in (model, behaviour) for name in owner.STEPS]
    torch.compiler.set_stance("default")
    for owner, name, step in plain:
        setattr(owner, name, torch.compile(step))
    works = True
    try:
        with learner.autocast():
            loss, states, _ = world_model_loss(model, data, 0)
            dream = imagine(model, behaviour, learner.draw_starts(states, data.terminals), 2, 1.0)
            sum(behaviour_loss(behaviour, dream, 1.0, 0.0)[0].values(), loss).backward()
    except Exception as error:  # whatever the compiler's tool chain lacks, the plain steps need none of it
        print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)
        for owner, name, step in plain:
            setattr(owner, name, step)
        works = False
    torch.set_rng_state(state)
    return works


def keep_freed_memory() -> None:
    """Have glibc keep what is freed: otherwise each large tensor's memory comes from the kernel anew, page by page."""
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)  # other C libraries have none
    if mallopt is not None:
        mallopt(-4, 0)  # M_MMAP_MAX: no block of its own for a large tensor
        mallopt(-1, 2**31 - 1)  # M_TRIM_THRESHOLD: nothing is given back


def set_frame_statistics(model: nn.Module, args: Args) -> None:
    """For tiles: subtract the mean frame, and make the channels of unit size; none is magnified more than ten times."""
    if args.encoder != "tiles":
        return
    task = maze(ROOM_SIZES[args.env_id])
    starts = task.starts[:: max(1, len(task.starts) // 20_000)]
    frames = painter(task.size, args.frame_side).draw(starts[:, 0], starts[:, 1]).astype(np.float64)
    mean = frames.mean(0)
    scale = np.sqrt(((frames - mean) ** 2).mean((0, 1, 2)))
    model.frame_mean.copy_(torch.from_numpy(mean))
    model.frame_scale.copy_(torch.from_numpy(np.maximum(scale, scale.max() / 10)))


# ---------------------------------------------------------------------------------------------------------------------
# Playing
# ---------------------------------------------------------------------------------------------------------------------
EVALUATION_STREAM = 1_000_000


@functools.lru_cache
def episode_seeds(seed: int, stream: int, block: int) -> list[int]:
    """Seeds of episodes 256 · block and on; a SeedSequence for each would take longer than the environment's reset."""
    return np.random.SeedSequence([seed, stream, block]).generate_state(256).tolist()


def episode_seed(seed: int, stream: int, episode: int) -> int:
    """Seed of an episode: sub-environment `stream` of run `seed`, or one of the streams that are not trained on."""
    return episode_seeds(seed, stream, episode // 256)[episode % 256]


def pick(logits: torch.Tensor, greedy: bool) -> torch.Tensor:
    """The most probable choice of each row of logits (N, C), or one that is drawn; one-hot, (N, C)."""
    if greedy:
        return F.one_hot(logits.argmax(-1), logits.shape[-1]).float()
    return one_hot_sample(logits, uniforms(len(logits), device=logits.device))


class Player:
    """Acts in N games side by side: the state that it believes each game to be in, and its last action."""

    def __init__(self, learner: Learner, num_games: int):
        self.learner = learner
        model = learner.model
        self.state, self.action = model.start(num_games), model.frame_mean.new_zeros(num_games, model.num_actions)

    @torch.no_grad()
    def observe(self, frames: np.ndarray, begins: np.ndarray) -> None:
        """Take in frames (N, side, side, 3); begins (N,) says where an episode begins."""
        model, device = self.learner.model, self.learner.device
        with self.learner.autocast():
            embed = model.embedding(model.normalize(torch.from_numpy(frames).to(device)))
            first = torch.from_numpy(begins.astype(np.float32)).to(device)[:, None]
            state, *_ = model.filter(self.state, self.action, first, embed, model.noise(len(frames)))
        self.state = type(state)(*(part.float() for part in state))

    @torch.no_grad()
    def act(self, greedy: bool = False) -> np.ndarray:
        """An action for each game, (N,): drawn, or the most probable."""
        with self.learner.autocast():
            logits = self.learner.behaviour.policy(self.state.features())
        self.action = pick(logits, greedy)
        return self.action.argmax(-1).cpu().numpy()

    def act_randomly(self) -> np.ndarray:
        """An action for each game, (N,), every one as likely as the other."""
        actions = torch.randint(self.action.shape[1], (len(self.action),))
        self.action = F.one_hot(actions, self.action.shape[1]).float().to(self.action.device)
        return actions.numpy()


class Collector:
    """Games side by side whose steps go into the replay."""

    def __init__(self, args: Args, replay: Replay, player: Player):
        self.args, self.replay, self.player = args, replay, player
        self.envs = FourRoomsVectorEnv(args.num_envs, ROOM_SIZES[args.env_id], args.frame_side)
        self.games, self.begins = np.arange(args.num_envs), np.ones(args.num_envs, bool)

    def reset(self) -> None:
        """Begin the first episodes."""
        seeds = [episode_seed(self.args.seed, i, 0) for i in range(self.args.num_envs)]
        self.obs, info = self.envs.reset(seed=seeds)
        self.replay.add(self.games, info["state"], first=1)

    def step(self, randomly: bool) -> list[tuple[int, float, int]]:
        """One step of each game; returns (game, return, length) of the episodes that it ended.

        Random play sees nothing: who takes over begins in the middle of an episode, as chunks do.
        """
        if not randomly:
            self.player.observe(self.obs, self.begins)
        actions = self.player.act_randomly() if randomly else self.player.act()
        lengths = self.envs.games.steps + 1
        self.obs, rewards, terminated, truncated, infos = self.envs.step(actions)
        is_over = terminated | truncated
        self.begins = is_over | randomly
        final = infos["final_info"] if is_over.any() else infos
        self.replay.add(self.games, final["state"], action=actions, reward=rewards, terminal=terminated)
        ended = np.flatnonzero(is_over)
        self.replay.add(ended, infos["state"][ended], first=1)
        # the last reward is the whole return: FourRooms pays at the goal alone
        return [(i, float(rewards[i]), int(lengths[i])) for i in ended.tolist()]

    def state_dict(self) -> dict:
        """The games, what the player believes, and the lengths of the replay's rows."""
        names, games = ("keys", "draws", "poses", "goals", "steps"), self.envs.games
        state = {name: torch.from_numpy(getattr(games, name).view(np.int64).copy()) for name in names}
        self.replay.rows.flush()
        lengths, begins = torch.from_numpy(self.replay.lengths.copy()), torch.from_numpy(self.begins.copy())
        return {
            "games": state,
            "belief": [*self.player.state, self.player.action],
            "lengths": lengths,
            "begins": begins,
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from what `state_dict` returned, and from the rows of the replay buffer's file."""
        games = self.envs.games
        for name, tensor in state["games"].items():
            array = getattr(games, name)
            array[:] = tensor.numpy().view(array.dtype)
        *belief, self.player.action = (part.to(self.player.learner.device) for part in state["belief"])
        self.player.state = type(self.player.state)(*belief)
        self.replay.go_on(state["lengths"].numpy())
        self.begins = state["begins"].numpy().copy()
        self.obs = self.envs.draw()


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "dreamer_v2 1"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "capture_video", "save_model")
FREE_ON_RESUME = {"run_dir", "resume", "stop_at", "checkpoint_interval", *FINISH}
FREE_ON_RESUME |= {"track", "wandb_project_name", "wandb_entity"}


def write_whole(path: Path, content: bytes, keep_old_as: str | None = None) -> None:
    """Write a file so that after a crash it is there whole or not at all; on request keep the one that it replaces."""
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    if keep_old_as is not None and path.exists():
        os.replace(path, path.with_name(keep_old_as))
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    os.fsync(folder)
    os.close(folder)


def write_json(path: Path, content: dict) -> None:
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


def arguments(args: Args) -> dict:
    """The arguments as JSON knows them: paths and infinity as strings, tuples as lists."""
    values = {name: "inf" if value == math.inf else value for name, value in asdict(args).items()}
    return json.loads(json.dumps(values, default=str))


def save_checkpoint(run_dir: Path, state: dict) -> None:
    """Write `checkpoint.pt`; the one before it stays as `checkpoint.previous.pt`."""
    content = io.BytesIO()
    torch.save({"format": CHECKPOINT_FORMAT, "script_sha256": SCRIPT_SHA256, **state}, content)
    write_whole(run_dir / "checkpoint.pt", content.getvalue(), keep_old_as="checkpoint.previous.pt")


def read_checkpoint(path: Path) -> dict | None:
    """The checkpoint in a file, or None where the file is torn or is no checkpoint of this script."""
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.testzip() is not None:  # torch does not compare checksums
                return None
        state = torch.load(path, map_location="cpu", weights_only=True)
    except Exception:  # every way in which a foreign file is no checkpoint
        return None
    return state if isinstance(state, dict) and state.get("format") == CHECKPOINT_FORMAT else None


def load_checkpoint(run_dir: Path) -> dict | None:
    """The newest whole checkpoint; None where there is no file. Raises UsageError where no file is whole."""
    paths = [run_dir / name for name in ("checkpoint.pt", "checkpoint.previous.pt") if (run_dir / name).exists()]
    states = [read_checkpoint(path) for path in paths]
    whole = [state for state in states if state is not None]
    require(bool(whole) or not paths, "--resume", run_dir, "holds no whole checkpoint of this script")
    if whole and states[0] is None:
        print(f"{paths[0]}: torn, goes on from the one before", file=sys.stderr)
        paths[0].unlink()  # or the next checkpoint would push out the whole one
    return whole[0] if whole else None


def read_arguments(run_dir: Path) -> dict:
    """The arguments of the run in a folder. Raises UsageError where it is no run."""
    try:
        return dict(json.loads((run_dir / "args.json").read_text()))
    except (OSError, ValueError, TypeError):
        raise UsageError(f"--resume {run_dir}: is no run of this script, it has no readable args.json") from None


def check_disk(args: Args, flag: str, value: int, size: int) -> None:
    """Raise UsageError where the replay of a new run, a file of `size` bytes, has no room."""
    folder = (args.run_dir or Path("runs")).absolute()
    try:
        begun = (folder / "replay.dat").exists()
        disk = shutil.disk_usage(next(path for path in (folder, *folder.parents) if path.exists()))
    except OSError:
        return  # of a folder that cannot be: `open_run_dir` says so
    allowed = f"its replay takes {size / 1e9:,.1f} GB of disk, {disk.free / 1e9:,.1f} are left"
    require(begun or size <= disk.free, flag, value, allowed)


def check_same_run(args: Args, saved: dict, run_dir: Path) -> None:
    """Raise UsageError unless the saved arguments agree with all that the results depend on."""
    current = arguments(args)
    allowed = f"{run_dir} holds a run of another script or version, {saved.get('exp_name')}"
    require(saved.keys() <= current.keys(), "--resume", "", allowed)
    changed = [name for name in current if name not in FREE_ON_RESUME and current[name] != saved.get(name)]
    differences = [f"--{name.replace('_', '-')} {current[name]} (was {saved.get(name)})" for name in changed]
    require(not changed, "--resume", ", ".join(differences), f"must be as in {run_dir}")


def open_run_dir(args: Args) -> tuple[Path, dict | None]:
    """Create the run's folder, or with `--resume` go on in it; return it and its checkpoint.

    The folder stays locked while the process lives. Where it raises UsageError, no whole file in it has changed.
    """
    name = f"{args.env_id.replace('/', '_')}__{args.exp_name}__{args.seed}__{int(time.time())}"
    run_dir, checkpoint = args.run_dir or Path("runs") / name, None
    try:
        run_dir.mkdir(parents=True, exist_ok=True)
        fcntl.flock(os.open(run_dir, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
        if all(path.suffix == ".tmp" or path.name in ("args.json", "wandb") for path in run_dir.iterdir()):  # not begun
            write_json(run_dir / "args.json", arguments(args))
            return run_dir, None
        require(args.resume, "--run-dir", run_dir, "exists; give --resume to go on in it, or another folder")
        check_same_run(args, read_arguments(run_dir), run_dir)
        checkpoint = load_checkpoint(run_dir)
    except BlockingIOError:
        raise UsageError(f"--run-dir {run_dir}: another process is running in it") from None
    except OSError as error:
        raise UsageError(f"--run-dir {run_dir}: cannot be used: {error.strerror}") from None
    if checkpoint is not None:
        check_same_run(args, checkpoint["args"], run_dir)
        if checkpoint.get("script_sha256", SCRIPT_SHA256) != SCRIPT_SHA256:
            print("--resume: this script has changed since the last checkpoint: bytes may differ", file=sys.stderr)
    return run_dir, checkpoint


def is_done(run_dir: Path, args: Args, last_step: int) -> bool:
    """Whether `result.json` says that the run has come to `last_step` and was evaluated as asked for."""
    if not (run_dir / "result.json").exists():
        return False
    result, wanted = json.loads((run_dir / "result.json").read_text()), arguments(args)
    return result["global_step"] >= last_step and result["finish"] == {name: wanted[name] for name in FINISH}


def forget_end(run_dir: Path, goes_on: bool) -> None:
    """Remove `result.json`, and where training `goes_on` what was saved of the agent as it was then."""
    saved = ("model.safetensors", "demos*/manifest.json", "videos/*.mp4") if goes_on else ()
    for pattern in ("result.json", *saved):
        for path in run_dir.glob(pattern):
            if path.parent.name != "demos_synthetic_human":  # which a student learns from
                path.unlink()


class CsvLog:
    """A CSV file that grows; what was written after the last checkpoint is cut off when a run is resumed."""

    def __init__(self, path: Path, length: int):
        self.file = open(path, "a", newline="", buffering=1)  # noqa: SIM115
        if path.stat().st_size < length:
            raise RunError(f"{path}: shorter than at the last checkpoint; the run cannot be resumed")
        self.file.truncate(length)
        self.file.seek(0, os.SEEK_END)
        self.path, self.writer, self.columns = path, csv.writer(self.file, lineterminator="\n"), None
        if length:
            with open(path, newline="") as file:
                self.columns = next(csv.reader(file))

    def write(self, row: dict) -> None:
        """Append a row, after the header where the file is empty. Raises RunError where the row has other columns."""
        if self.columns is None:
            self.writer.writerow(row)
            self.columns = list(row)
        if list(row) != self.columns:
            raise RunError(f"{self.path}: has other columns than this version of the script writes")
        self.writer.writerow(row.values())

    def sync(self) -> int:
        """Bring everything onto the disk; return the file's length."""
        self.file.flush()
        os.fsync(self.file.fileno())
        return self.file.tell()


def add_scalars(writer: SummaryWriter, values: dict[str, float], step: int) -> None:
    """Log scalars as one event of TensorBoard, in less time than `SummaryWriter.add_scalar` takes for one of them."""
    summary = Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in values.items()])
    writer.file_writer.add_summary(summary, step)


class StopSignal:
    """SIGINT, SIGTERM and SIGUSR1 ask for a checkpoint and an end after the current iteration; a second ends at once."""

    numbers = (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)

    def __init__(self):
        self.received = 0
        for number in self.numbers:
            signal.signal(number, self.receive)

    def receive(self, number: int, frame) -> None:
        self.received = number
        self.release()

    def release(self) -> None:
        for number in self.numbers:
            signal.signal(number, signal.SIG_DFL)


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation
# ---------------------------------------------------------------------------------------------------------------------
@contextlib.contextmanager
def own_randomness(seed: int):
    """Draws within do not change those of the training."""
    state = torch.get_rng_state()
    torch.manual_seed(seed)
    yield
    torch.set_rng_state(state)


def play(learner: Learner, args: Args, seeds: list[int], greedy: bool) -> dict[str, np.ndarray]:
    """One episode for each seed, side by side.

    Returns `returns` (N,), `solved` (N,), and of the first game `states` (T + 1, 3) and `actions` (T,); `starts` (N, 3).
    """
    envs = FourRoomsVectorEnv(len(seeds), ROOM_SIZES[args.env_id], args.frame_side)
    obs, info = envs.reset(seed=seeds)
    player, begins = Player(learner, len(seeds)), np.ones(len(seeds), bool)
    returns, solved, ended = np.zeros(len(seeds)), np.zeros(len(seeds), bool), np.zeros(len(seeds), bool)
    starts, states, actions = info["state"], [info["state"][0]], []
    while not ended.all():
        player.observe(obs, begins)
        chosen = player.act(greedy)
        obs, rewards, terminated, truncated, info = envs.step(chosen)
        if not ended[0]:
            states.append(info.get("final_info", info)["state"][0])
            actions.append(chosen[0])
        returns += rewards * ~ended
        solved |= terminated & ~ended
        begins = terminated | truncated
        ended |= begins
    return {
        "returns": returns,
        "solved": solved,
        "starts": starts,
        "states": np.array(states),
        "actions": np.array(actions),
    }


@torch.no_grad()
def dreamed_returns(learner: Learner, args: Args, seeds: list[int]) -> np.ndarray:
    """What the model imagines of the same episodes after their first frame: undiscounted returns of MAX_STEPS steps, (N,)."""
    envs = FourRoomsVectorEnv(len(seeds), ROOM_SIZES[args.env_id], args.frame_side)
    obs, _ = envs.reset(seed=seeds)
    player = Player(learner, len(seeds))
    player.observe(obs, np.ones(len(seeds), bool))
    with learner.autocast():
        dream = imagine(learner.model, learner.behaviour, player.state, MAX_STEPS, 1.0)
    rewards = dream.rewards.clamp(-0.999, 0.999).atanh() if args.tanh_reward else dream.rewards
    return (dream_weights(dream.discounts) * rewards).sum(0).cpu().numpy()


def compare_dream(learner: Learner, args: Args, episodes: int = 200) -> dict[str, float]:
    """Returns of sampled episodes, real and dreamed, from the same starts, each as likely as the other."""
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(episodes)]
    with own_randomness(args.seed):
        real, dreamed = play(learner, args, seeds, greedy=False)["returns"], dreamed_returns(learner, args, seeds)
    return {"eval/real_return": float(real.mean()), "eval/dreamed_return": float(dreamed.mean())}


def fewest_steps(maze: Maze) -> np.ndarray:
    """The least number of actions from each pose to each goal cell, (4 C, C)."""
    cells = np.arange(len(maze.cells))
    steps = np.where(np.arange(len(maze.moves))[:, None] // 4 == cells, 0, len(maze.moves))
    while True:
        shorter = np.minimum(steps, 1 + steps[maze.moves].min(1))
        if np.array_equal(shorter, steps):
            return steps
        steps = shorter


def evaluate(learner: Learner, args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes with seeds that training does not use, greedily; write `evaluation.json`, `dream.png` and videos.

    `optimal` is the mean return of shortest paths from the same starts, `solved` the share of the goals that were reached.
    """
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    with own_randomness(args.seed):
        made = play(learner, args, seeds, greedy=True)
        truth, dream = dream_frames(learner, args, made["states"], made["actions"])
    cell, direction, goal = made["starts"].T
    shortest = fewest_steps(maze(ROOM_SIZES[args.env_id]))[4 * cell + direction, goal]
    optimal = float((1 - 0.9 * (shortest / MAX_STEPS)).mean())
    draw_dream(truth, dream, run_dir / "dream.png")
    if args.capture_video:
        record_videos(args, made["states"], truth, dream, run_dir)
    about = {"env_id": args.env_id, "mode": "greedy", **summary(made["returns"])}
    evaluation = {**about, "optimal": optimal, "solved": float(made["solved"].mean()), **compare_dream(learner, args)}
    write_json(run_dir / "evaluation.json", {**evaluation, "returns": made["returns"].tolist(), "seeds": seeds})
    return evaluation


CONTEXT = 3  # frames that the model sees before it dreams on


@torch.no_grad()
def dream_frames(
    learner: Learner, args: Args, states: np.ndarray, actions: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """An episode's frames, and what the model makes of them: filtered for CONTEXT frames, then dreamed by the same actions.

    states (T + 1, 3), actions (T,) -> two of (T + 1, side, side, 3) uint8.
    """
    model, player = learner.model, Player(learner, 1)
    truth = painter(ROOM_SIZES[args.env_id], args.frame_side).draw(4 * states[:, 0] + states[:, 1], states[:, 2])
    seen = []
    for t, frame in enumerate(truth):
        if t < CONTEXT:
            player.observe(frame[None], np.array([t == 0]))
        else:
            player.state = model.imagine_step(player.state, player.action, model.noise(1))
        seen.append(model.decode(player.state).float() * model.frame_scale + model.frame_mean)
        if t < len(actions):
            player.action = F.one_hot(torch.tensor([actions[t]]), model.num_actions).float().to(learner.device)
    return truth, torch.cat(seen).clamp(0, 255).round().byte().cpu().numpy()


def draw_dream(truth: np.ndarray, dream: np.ndarray, path: Path, most: int = 20) -> None:
    """Draw an episode above what the model makes of it."""
    from matplotlib.figure import Figure

    steps = min(most, len(truth))
    figure = Figure(figsize=(0.8 * steps + 1, 2.2), layout="constrained")
    axes = figure.subplots(2, steps, squeeze=False)
    for line, name, frames in zip(axes, ("truth", "dream"), (truth, dream)):
        line[0].set_ylabel(name)
        for t, one in enumerate(line):
            one.imshow(frames[t], interpolation="nearest")
            one.set(xticks=[], yticks=[])
    for t, one in enumerate(axes[0]):
        one.set_title(f"t = {t}" + (", seen" if t < CONTEXT else ""), fontsize="xx-small")
    content = io.BytesIO()
    figure.savefig(content, dpi=110)
    write_whole(path, content.getvalue())


def record_videos(args: Args, states: np.ndarray, truth: np.ndarray, dream: np.ndarray, run_dir: Path) -> None:
    """Write `videos/episode.mp4`, as MiniGrid draws it, and `videos/dream.mp4`, the truth above the dream."""
    from moviepy.video.io.ImageSequenceClip import ImageSequenceClip

    size = ROOM_SIZES[args.env_id]
    episode = painter(size, 16 * size).draw(4 * states[:, 0] + states[:, 1], states[:, 2])
    both = np.concatenate([truth, dream], 1).repeat(4, 1).repeat(4, 2)
    (run_dir / "videos").mkdir(exist_ok=True)
    for name, frames in (("episode", episode), ("dream", both)):
        clip = ImageSequenceClip(list(frames), fps=FourRoomsVectorEnv.metadata["render_fps"])
        clip.write_videofile(str(run_dir / "videos" / f"{name}.mp4"), logger=None)


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def read_episodes(run_dir: Path) -> np.ndarray:
    """`episodes.csv` as (number of episodes, 3): global step, return, length."""
    lines = (run_dir / "episodes.csv").read_text().splitlines()[1:]
    return np.array([line.split(",") for line in lines], np.float64).reshape(-1, 3)


def plot_learning_curve(run_dir: Path, args: Args, evaluation: dict) -> None:
    """Draw `learning_curve.png`: the moving mean of the episodes' returns, the evaluation, and what is possible."""
    from matplotlib.figure import Figure

    steps, returns, _ = read_episodes(run_dir).T
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    window = min(200, max(1, len(returns)))
    if len(returns):
        means = np.convolve(returns, np.ones(window) / window, "valid")
        axes.plot(steps[window - 1 :], means, color="tab:blue", label=f"mean of {window} episodes (sampled)")
    label = f"evaluation (greedy, {args.eval_episodes} episodes): {evaluation['mean']:.3f}"
    axes.axhline(evaluation["mean"], color="tab:orange", linestyle="--", label=label)
    label = f"shortest paths from the same starts: {evaluation['optimal']:.3f}"
    axes.axhline(evaluation["optimal"], color="black", linestyle=":", label=label)
    axes.set_title(f"{args.env_id}, DreamerV2, size {args.size}, seed {args.seed}")
    axes.set_xlabel("environment steps")
    axes.set_ylabel("episodic return")
    axes.set_ylim(0, 1)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="best", fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    content = io.BytesIO()
    figure.savefig(content, dpi=150)
    write_whole(run_dir / "learning_curve.png", content.getvalue())


def print_table(result: dict) -> None:
    """Print the last episodes of training and the evaluation, one line each."""
    print(f"{'':32}{'episodes':>9}{'mean':>9}{'std':>9}{'min':>9}{'max':>9}{'optimal':>9}{'solved':>9}")
    for name in ("training", "evaluation"):
        row = result[name]
        keys = ("mean", "std", "min", "max", "optimal", "solved")
        numbers = "".join(f"{row[key]:>9.3f}" for key in keys if row.get(key) is not None)
        print(f"{name + ' (' + row['mode'] + ')':32}{row['episodes']:>9}{numbers}")


# ---------------------------------------------------------------------------------------------------------------------
# Training
# ---------------------------------------------------------------------------------------------------------------------
BLOCK = 500  # environment steps of a row of updates.csv
COMPARISON = 20_000  # environment steps between comparisons of dream and reality


def start_wandb(args: Args, run_dir: Path) -> None:
    """Mirror TensorBoard to Weights and Biases; a resumed run goes on in the same place. Raises UsageError."""
    import wandb

    run_id = hashlib.sha256(str(run_dir.resolve()).encode()).hexdigest()[:16]
    try:
        wandb.init(
            project=args.wandb_project_name,
            entity=args.wandb_entity,
            sync_tensorboard=True,
            config=asdict(args),
            name=run_dir.name,
            dir=run_dir,
            id=run_id,
            resume="allow",
        )
    except wandb.Error as error:  # no login, no connection, no such team
        raise UsageError(f"--track: {first_line(error)}") from None


def main(args: Args) -> int:
    """Train, evaluate and write everything into the run's folder. Returns the exit code."""
    args = complete_args(args)
    check_disk(args, "--total-timesteps", args.total_timesteps, 2 * args.total_timesteps * RECORD.itemsize)
    run_dir, checkpoint = open_run_dir(args)
    last_step = min(args.total_timesteps, math.ceil(args.stop_at / BLOCK) * BLOCK)
    if is_done(run_dir, args, last_step):
        print(f"{run_dir} is done")
        return 0
    lost = checkpoint is None and (run_dir / "result.json").exists()
    require(not lost, "--resume", run_dir, "was finished with other flags, and its checkpoint is gone")
    write_json(run_dir / "args.json", arguments(args))
    print(run_dir)
    if args.track:
        start_wandb(args, run_dir)

    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.num_threads)
    torch.set_flush_denormal(True)  # Adam slows down on denormal numbers, means of gradients that have vanished
    keep_freed_memory()
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    stop = StopSignal()

    model = WorldModel(args, int(ROOM_ACTIONS.n))
    set_frame_statistics(model, args)
    learner = Learner(args, model, device)
    if args.bf16 and not learner.bf16:
        print("--bf16: no bfloat16 instructions here, goes on in float32", file=sys.stderr)
    collector = Collector(
        args, Replay(run_dir / "replay.dat", args, checkpoint is not None), Player(learner, args.num_envs)
    )
    global_step, training_seconds, offsets = 0, 0.0, {"episodes": 0, "updates": 0}
    if checkpoint is not None:
        global_step, training_seconds = checkpoint["global_step"], checkpoint["training_seconds"]
        offsets = checkpoint["offsets"]
        learner.load_state_dict(checkpoint["learner"])
        collector.load_state_dict(checkpoint["collector"])
    is_compiled = args.compile and compile_steps(learner, collector.replay.example(device))
    if checkpoint is not None:
        torch.set_rng_state(checkpoint["torch_rng"])
    else:
        collector.reset()
    precision = "bfloat16" if learner.bf16 else "float32"
    arithmetic = f"{'compiled' if is_compiled else 'plain'}, {precision} on {device.type}"
    if checkpoint and checkpoint["arithmetic"] != arithmetic:
        print(f"--resume: was {checkpoint['arithmetic']}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    episodes_csv = CsvLog(run_dir / "episodes.csv", offsets["episodes"])
    updates_csv = CsvLog(run_dir / "updates.csv", offsets["updates"])
    forget_end(run_dir, global_step < last_step)
    writer = SummaryWriter(str(run_dir), purge_step=global_step + 1)
    progress = tqdm(total=last_step, initial=global_step, unit="step", disable=None)
    last_time = time.perf_counter()

    while global_step < last_step:
        returns, logged = [], []
        for step in range(global_step, global_step + BLOCK, args.num_envs):
            # act in each game, at random at first; what happens goes into the replay
            for game, episodic_return, length in collector.step(randomly=step < args.prefill):
                ended = step + game + 1
                row = {"global_step": ended, "episodic_return": episodic_return, "episodic_length": length}
                episodes_csv.write(row)
                charts = {"charts/episodic_return": episodic_return, "charts/episodic_length": length}
                add_scalars(writer, charts, ended)
                returns.append(episodic_return)
            # learn from chunks of all that was played: the model, and in its dreams the behaviour
            due = max(0, step + args.num_envs - args.prefill) // args.train_frequency
            while learner.updates < due:
                data = collector.replay.sample(device)
                logged.append(learner.update(data))

        global_step += BLOCK
        mean_return = float(np.mean(returns)) if returns else math.nan
        progress.set_postfix_str(f"return {mean_return:.3f}", refresh=False)
        progress.update(BLOCK)
        metrics = {}
        if logged:
            metrics = {name: torch.stack([each[name] for each in logged]).mean().item() for name in logged[0]}
            is_due = global_step % COMPARISON == 0
            unknown = {"eval/real_return": math.nan, "eval/dreamed_return": math.nan}
            compared = compare_dream(learner, args) if is_due else unknown
            metrics |= compared
            updates_csv.write({"global_step": global_step, "charts/episodic_return": mean_return, **metrics})
            if not learner.is_finite():
                raise RunError(f"step {global_step}: the parameters are no longer finite (last metrics: {metrics})")
        seconds, last_time = time.perf_counter() - last_time, time.perf_counter()
        training_seconds += seconds
        add_scalars(writer, {**metrics, "charts/SPS": BLOCK / seconds}, global_step)

        crossed = global_step // args.checkpoint_interval > (global_step - BLOCK) // args.checkpoint_interval
        if crossed or stop.received or global_step == last_step:
            state = {
                "args": arguments(args),
                "arithmetic": arithmetic,
                "global_step": global_step,
                "training_seconds": training_seconds,
                "offsets": {"episodes": episodes_csv.sync(), "updates": updates_csv.sync()},
                "learner": learner.state_dict(),
                "collector": collector.state_dict(),
                "torch_rng": torch.get_rng_state(),
            }
            writer.flush()
            save_checkpoint(run_dir, state)
        if stop.received and global_step < last_step:
            progress.close()
            writer.close()
            print(f"stopped by signal {stop.received} at step {global_step}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    finish_run(learner, args, run_dir, global_step, training_seconds, writer)
    writer.close()
    return 0


def finish_run(learner: Learner, args: Args, run_dir: Path, global_step: int, seconds: float, writer) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last."""
    evaluation = evaluate(learner, args, run_dir)
    for name in ("mean", "std", "min", "max"):
        writer.add_scalar(f"eval/episodic_return_{name}", evaluation[name], global_step)
    if args.save_model:
        parts = {"model": learner.model.state_dict(), "behaviour": learner.behaviour.state_dict()}
        tensors = {
            f"{part}.{name}": value.contiguous() for part, state in parts.items() for name, value in state.items()
        }
        content = safetensors.torch.save(tensors, {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", content)
    plot_learning_curve(run_dir, args, evaluation)
    versions = {module.__name__: module.__version__ for module in (gym, minigrid, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": global_step,
        "updates": learner.updates,
        "complete": global_step == args.total_timesteps,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training": {"mode": "sampled", **summary(read_episodes(run_dir)[-200:, 1])},
        "evaluation": evaluation,
        "training_seconds": seconds,
        "steps_per_second": global_step / seconds,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        / (1024 if sys.platform == "linux" else 1024**2),
        "versions": {**versions, "python": platform.python_version()},
        "script_sha256": SCRIPT_SHA256,
    }
    write_json(run_dir / "result.json", result)
    print_table(result)


def cli(argv: list[str] | None = None) -> int:
    """Run from the command line: a user's mistake is one line and exit code 2, a run that had to stop one line and 1."""
    try:
        return main(parse_args(argv))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except RunError as error:
        print(f"error: {error}", file=sys.stderr)
    except (OSError, MemoryError) as error:
        print(f"error: {error}; a checkpoint stays whole: go on with --run-dir and --resume", file=sys.stderr)
    except RuntimeError as error:  # torch's own way to say that memory is short
        if not isinstance(error, torch.OutOfMemoryError) and "allocate" not in str(error):
            raise
        print(f"error: not enough memory: {first_line(error)}", file=sys.stderr)
    return 1


if __name__ == "__main__":
    sys.exit(cli())
