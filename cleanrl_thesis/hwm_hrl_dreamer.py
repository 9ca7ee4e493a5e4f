"""HWM HRL Dreamer in FourRooms: a high-level policy on the world model's segments (thesis section 3.3.4, Eq. 3.3.12 to 3.3.18).

    python cleanrl_thesis/hwm_hrl_dreamer.py --size xs                          # small enough for a CPU core
    python cleanrl_thesis/hwm_hrl_dreamer.py --fixed-interval 4                 # a segment every 4 steps (Eq. 3.2.2)
    python cleanrl_thesis/hwm_hrl_dreamer.py --size thesis --cuda --compile     # the thesis' sizes, 2,000,000 steps

The agent of `hwm_dreamer.py` with two levels: π^H(e | z) draws a skill e where a segment begins, π^L(a | w, z, e) acts by it until
the segment ends. `--run-dir DIR --resume` can be sent again after every crash: on the same machine the run ends with the
same bytes.

| | thesis | here |
|---|---|---|
| skills | "eight rooms" | `--num-skills 8`, one-hot |
| high-level return | V_λ^{H,τ} over segments | on the clock of the steps: rewards within a segment are summed and discounted, λ counts at its end; a segment that the dream does not finish ends with V^L(w, z, e) |
| Eq. 3.3.16, 3.3.17 | summed over the decisions | the mean over them, weighted by how likely the dream is to come to it, and by its discount |
| low-level return | V_λ^{L,h} | goes on over the boundaries |
| a dream that starts within a segment | not said | draws a skill there too, from which π^H and V^H do not learn |
| boundaries, acting, departures of the model | | as in `hwm_dreamer.py` |

Nothing makes π^L use its skill, for it sees z itself: `losses/skill_information` is I(e; a | w, z) in nats, and
`benchmark/dreamer_skills.py` shows that skills are learned where π^L does not see z.
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
    exp_name: str = "hwm_hrl_dreamer"
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
    """steps of a dream (H of Eq. 3.3.14 to 3.3.17; DreamerV2)"""
    gamma: float | None = None
    """discount factor γ (DreamerV2)"""
    gae_lambda: float = 0.95
    """λ of the returns (Eq. 3.3.14, 3.3.16; DreamerV2)"""

    # World model
    encoder: Literal["tiles", "cnn"] | None = None
    """a linear map of 2 × 2 pixels each (ours), or convolutions over 64 × 64 (DreamerV2)"""
    frame_side: int | None = None
    """pixels of the frames' side; default: 64 for a CNN (DreamerV2), two for each cell for tiles (ours)"""
    depth: int | None = None
    """features of a tile, or channels of the first convolution (DreamerV2)"""
    deter_z: int | None = None
    """size of c_t (ours; with v_t 812 numbers, as the Q&A says)"""
    stoch_z: int | None = None
    """variables of v (ours)"""
    deter_w: int | None = None
    """size of h_t (ours; with y_t 812 numbers, as the Q&A says)"""
    stoch_w: int | None = None
    """variables of y (ours)"""
    classes: int | None = None
    """classes of each, categorical as in the baseline (ours); 1: normal variables (the thesis)"""
    hidden_size: int | None = None
    """units of hidden layers in the model (DreamerV2)"""
    head_size: int | None = None
    """units of hidden layers in reward, discount, actor and critic (DreamerV2)"""
    head_layers: int | None = None
    """hidden layers in these (DreamerV2)"""
    head_norm: bool | None = None
    """layer normalisation in these (ours)"""
    image_scale: float | None = None
    """weight of the reconstruction (Eq. 3.3.5, DreamerV2: 1)"""
    std_bias: float = -4.0
    """with normal variables: added to the standard deviations' outputs at first, so that they start small (ours)"""
    kl_z_scale: float | None = None
    """weight of KL[q(z) ‖ p(z)] (Eq. 3.3.5: 1)"""
    kl_w_scale: float | None = None
    """weight of KL[q(w) ‖ p(w)] (Eq. 3.3.5: 1)"""
    kl_m_scale: float = 0.3
    """weight of KL[q(m) ‖ p(m)] (Eq. 3.3.5: 1)"""
    entropy_scale: float | None = None
    """weight of a bonus for the entropy of categorical codes, annealed to 0 over `--kl-warmup`; without it the codes become sharp on the
    goal, which is learned first, and some seeds do not see the agent for hundreds of updates (ours)"""
    kl_warmup: int | None = None
    """updates over which the weights of KL_z and KL_w grow from a tenth (ours)"""
    kl_balance: float = 0.8
    """share of each KL term's gradient that trains p, the rest trains q (DreamerV2)"""
    detach_kl_z: bool = True
    """KL_z counts at the reads, and does not price them (VTA); off: it does (Eq. 3.3.7)"""
    temperature: float = 0.3
    """last temperature of the binary Gumbel samples of m; from 1 over `--budget-updates` (ours)"""
    boundary_bound: float = 6.0
    """bound on the logits of q(m); 0 for none (ours)"""
    read_bias: float = 2.0
    """logit of q(m) at first: start with many reads (ours)"""
    w_reset: bool = False
    """w starts anew from z where z is read (VTA)"""
    c_sees_w: bool = True
    """c_t is made from w_{t-1} and a_{t-1} too (Eq. 3.3.1), not only from z_{t-1}"""
    h_sees_z: bool = True
    """h_t is made from z_t too (Eq. 3.3.1), not only from w_{t-1} and a_{t-1} (section 3.3.2)"""
    decoder_sees_h: bool = True
    """the decoder sees h_t too (Eq. 3.3.1), not only y_t and z_t"""
    decoder_sees_c: bool = True
    """the decoder sees c_t too (Eq. 3.3.1), not only v_t: c_t knows of frames a step late"""
    budget: float = 0.23
    """share of steps that q(m) may read without a price, annealed from 1 over `--budget-updates`; the step after an episode's first does
    not count (ours)"""
    budget_price: float = 10.0
    """price of the reads beyond it, on the mean read rate; 0: no budget (ours)"""
    budget_updates: int = 5_000
    """updates over which budget and temperature come to their last values (ours)"""
    fixed_interval: int = 0
    """a segment begins every so many steps instead (Eq. 3.2.2, 3.3.16); 0: where the model says"""
    reward_scale: float | None = None
    """weight of the reward's loss (Eq. 3.3.11, DreamerV2: 1)"""
    discount_scale: float = 5.0
    """weight of the loss of the end of an episode (DreamerV2)"""
    tanh_reward: bool | None = None
    """learn tanh(reward) (DreamerV2)"""
    model_learning_rate: float | None = None
    """Adam's learning rate for the world model (DreamerV2)"""

    # Behaviour
    num_skills: int = 8
    """skills that the high-level policy chooses from (section 3.3.4: eight rooms)"""
    actor_learning_rate: float | None = None
    """Adam's learning rate for both actors (DreamerV2)"""
    critic_learning_rate: float | None = None
    """Adam's learning rate for both critics (DreamerV2)"""
    adam_eps: float | None = None
    """Adam's ε for actors and critics; 1e-5 for the world model (DreamerV2)"""
    ent_coef: float | None = None
    """weight η of the entropy of both policies (Eq. 3.3.15, 3.3.17; DreamerV2)"""
    slow_interval: int = 100
    """updates between copies of the critics to the slow critics (DreamerV2)"""
    weight_decay: float = 1e-6
    """share of each weight that an update takes away (DreamerV2)"""
    max_grad_norm: float = 100.0
    """bound on the norm of each gradient; inf for none (DreamerV2)"""


SIZES = {  # what a flag that is not given stands for, by --size; features are as many as the baseline's
    "size": ("xs", "s", "m", "thesis"),
    "prefill": (1_000_000, 1_000_000, 50_000, 50_000),
    "batch_size": (24, 24, 16, 16),
    "chunk_length": (10, 10, 50, 50),
    "rewarded_share": (0.1, 0.1, 0.0, 0.0),
    "starts": (64, 64, 800, 800),
    "gamma": (0.95, 0.95, 0.999, 0.999),
    "encoder": ("tiles", "tiles", "cnn", "cnn"),
    "depth": (16, 24, 16, 48),
    "deter_z": (128, 256, 306, 300),
    "stoch_z": (4, 8, 306, 512),
    "deter_w": (128, 256, 306, 300),
    "stoch_w": (20, 40, 306, 512),
    "classes": (16, 16, 1, 1),
    "hidden_size": (128, 256, 200, 600),
    "head_size": (128, 256, 200, 400),
    "head_layers": (2, 2, 4, 4),
    "head_norm": (True, True, False, False),
    "image_scale": (0.25, 0.25, 1.0, 1.0),
    "kl_z_scale": (1.0, 1.0, 0.1, 0.1),
    "kl_w_scale": (1.0, 1.0, 0.1, 0.1),
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
    counts += " depth deter_z stoch_z deter_w stoch_w classes hidden_size head_size head_layers slow_interval"
    counts += " budget_updates"
    rates = "model_learning_rate actor_learning_rate critic_learning_rate adam_eps image_scale"
    scales = "kl_z_scale kl_w_scale kl_m_scale entropy_scale reward_scale discount_scale ent_coef"
    scales += " boundary_bound budget_price"
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("chunk_length num_skills", lambda x: x >= 2, "must be at least 2"),
        (rates, lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("max_grad_norm", lambda x: x > 0, "must be greater than 0"),
        (scales, lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        (
            "gamma gae_lambda kl_balance rewarded_share budget weight_decay",
            lambda x: 0 <= x <= 1,
            "must be between 0 and 1",
        ),
        ("temperature", lambda x: 0 < x <= 1, "must be greater than 0 and at most 1"),
        ("std_bias read_bias", math.isfinite, "must be finite"),
        ("fixed_interval kl_warmup", lambda x: x >= 0, "must be at least 0"),
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
    allowed = f"must be less than --chunk-length {args.chunk_length}, or no chunk would hold a segment's end"
    require(args.fixed_interval < args.chunk_length, "--fixed-interval", args.fixed_interval, allowed)
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


def mlp(input_size: int, hidden_size: int, output_size: int, hidden_layers: int = 1) -> nn.Sequential:
    """Densely connected layers with ELU."""
    sizes = [input_size] + [hidden_size] * hidden_layers
    layers = [layer for a, b in zip(sizes, sizes[1:]) for layer in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], output_size))


class Normal(NamedTuple):
    """Independent normal distributions, mean and standard deviation of the same shape."""

    mean: torch.Tensor
    std: torch.Tensor


class Categorical(NamedTuple):
    """Independent categorical distributions."""

    logits: torch.Tensor  # (..., variables, classes)


class DistributionHead(nn.Module):
    """Features, and for a posterior the frame's embedding, -> the distribution of v or y.

    Categorical where there are classes, else N(μ, σ) with σ = 2 sigmoid(x / 2) + 0.1, x starting near `std_bias`.
    """

    def __init__(self, input_size: int, variables: int, args: Args):
        super().__init__()
        self.classes = args.classes
        outputs = variables * max(2, args.classes)
        self.inner, self.outer = nn.Linear(input_size, args.hidden_size), nn.Linear(args.hidden_size, outputs)
        if self.classes == 1:
            with torch.no_grad():
                self.outer.bias[variables:] += args.std_bias

    def forward(self, features: torch.Tensor, embed: torch.Tensor | float = 0.0) -> Normal | Categorical:
        """Features (..., input_size), embed (..., hidden) -> of `variables` numbers, or of as many one-hot codes."""
        x = self.outer(F.silu(self.inner(features) + embed)).float()
        if self.classes > 1:
            return Categorical(x.unflatten(-1, (-1, self.classes)))
        mean, std = x.chunk(2, -1)
        return Normal(mean, 2 * torch.sigmoid(std / 2) + 0.1)


class Recurrence(nn.Module):
    """A GRU cell behind a layer over all that it sees."""

    def __init__(self, input_size: int, hidden_size: int, state_size: int):
        super().__init__()
        self.inner, self.cell = nn.Linear(input_size, hidden_size), GRUCell(hidden_size, state_size)

    def forward(self, x: torch.Tensor, state: torch.Tensor) -> torch.Tensor:
        """Input (N, input_size) and state (N, state_size) -> the next state (N, state_size)."""
        return self.cell(F.silu(self.inner(x)), state)


def draw(distribution: Normal | Categorical, noise: torch.Tensor) -> torch.Tensor:
    """A draw with its gradient, by a normal or a uniform number for each variable (..., V) -> (..., V · classes)."""
    if isinstance(distribution, Normal):
        return distribution.mean + distribution.std * noise
    return straight_through(distribution.logits, noise).flatten(-2)


def kl_categorical(q: torch.Tensor, p: torch.Tensor) -> torch.Tensor:
    """KL[q ‖ p] of independent categorical distributions by their logits (..., stoch, classes) -> (...)."""
    log_q, log_p = q.log_softmax(-1), p.log_softmax(-1)
    return (log_q.exp() * (log_q - log_p)).sum((-1, -2))


def entropy(logits: torch.Tensor) -> torch.Tensor:
    """Entropy of independent categorical distributions by their logits (..., stoch, classes) -> (...)."""
    log_p = logits.log_softmax(-1)
    return -(log_p.exp() * log_p).sum((-1, -2))


def kl_divergence(q: Normal | Categorical, p: Normal | Categorical) -> torch.Tensor:
    """KL[q ‖ p], summed over the variables."""
    if isinstance(q, Categorical):
        return kl_categorical(q.logits, p.logits)
    ratio = (q.std / p.std).square()
    return 0.5 * (ratio + ((q.mean - p.mean) / p.std).square() - 1 - ratio.log()).sum(-1)


def kl_bernoulli(q_logit: torch.Tensor, p_logit: torch.Tensor) -> torch.Tensor:
    """KL[q ‖ p] of Bernoulli distributions, in closed form."""
    q = torch.sigmoid(q_logit)
    return q * (F.logsigmoid(q_logit) - F.logsigmoid(p_logit)) + (1 - q) * (
        F.logsigmoid(-q_logit) - F.logsigmoid(-p_logit)
    )


def balanced(kl, q, p, balance: float) -> torch.Tensor:
    """KL[q ‖ p], whose gradient trains p with weight `balance` and q with the rest (DreamerV2)."""
    still = [type(x)(*(part.detach() for part in x)) if isinstance(x, tuple) else x.detach() for x in (q, p)]
    return balance * kl(still[0], p) + (1 - balance) * kl(q, still[1])


class Posterior(nn.Module):
    """q(m_t | O) = Bernoulli(σ(φ(O))), where φ is a temporal convolution that ends at the borders of its episode (Eq. 3.3.2).

    A step stands in for the one that it lacks there, or at the end of a chunk, which so cannot be told from any other step.
    """

    def __init__(self, input_size: int, hidden_size: int, bias: float, bound: float):
        super().__init__()
        sizes = [3 * input_size, 3 * hidden_size, 3 * hidden_size]
        self.layers = nn.ModuleList(
            nn.Sequential(nn.Linear(size, hidden_size), nn.LayerNorm(hidden_size), nn.ELU()) for size in sizes
        )
        self.logit, self.bound = nn.Linear(hidden_size, 1), bound
        nn.init.constant_(self.logit.bias, bias)

    def forward(self, embed: torch.Tensor, first: torch.Tensor) -> torch.Tensor:
        """embed (T, B, E), first (T, B), 1 where an episode begins -> logits (T, B)."""
        x, goes_on = embed, (first[1:] == 0)[:, :, None]  # (T - 1, B, 1): steps t and t + 1 are of one episode
        for layer in self.layers:
            before = torch.cat([x[:1], torch.where(goes_on, x[:-1], x[1:])])
            after = torch.cat([torch.where(goes_on, x[1:], x[:-1]), x[-1:]])
            x = layer(torch.cat([before, x, after], -1))
        logit = self.logit(x).squeeze(-1)
        return self.bound * torch.tanh(logit / self.bound) if self.bound else logit


class Belief(NamedTuple):
    """z_t = [c_t, v_t] and w_t = [h_t, y_t], and the steps since z was read."""

    c: torch.Tensor  # (..., deter_z)
    v: torch.Tensor  # (..., stoch_z · classes)
    h: torch.Tensor  # (..., deter_w)
    y: torch.Tensor  # (..., stoch_w · classes)
    age: torch.Tensor  # (..., 1): 0 at a read

    def features(self) -> torch.Tensor:
        """What reward, discount, actor and critic see, (..., F)."""
        return torch.cat(self[:4], -1)


class Inference(NamedTuple):
    """What the model makes of T steps."""

    belief: Belief  # (T, B, ...)
    reads: torch.Tensor  # (T, B): 1 where z was read, 0 where it was copied
    forced: torch.Tensor  # (T, B): 1 where the read was not the model's choice
    q_z: Normal | Categorical  # (T, B, ...)
    q_w: Normal | Categorical  # (T, B, ...)
    q_m: torch.Tensor  # (T, B): logits
    p_m: torch.Tensor  # (T - 1, B): logits; the action of the last step is not known


class HWM(nn.Module):
    """The generative process of Eq. 3.3.1, the variational distributions of Eq. 3.3.2, and heads for reward and discount."""

    STEPS = ("step", "imagine_step")  # what `--compile` compiles

    def __init__(self, args: Args, num_actions: int):
        super().__init__()
        self.args, self.num_actions = args, num_actions
        numbers = args.stoch_z * args.classes, args.stoch_w * args.classes
        self.sizes = args.deter_z, numbers[0], args.deter_w, numbers[1]  # of a Belief
        dz, sz, dw, sw, hidden = args.deter_z, self.sizes[1], args.deter_w, self.sizes[3], args.hidden_size
        z, w, side, tiles = dz + sz, dw + sw, args.frame_side, args.encoder == "tiles"
        self.feature_size = z + w
        self.register_buffer("frame_mean", torch.full((side, side, 3), 127.5))
        self.register_buffer("frame_scale", torch.full((side, side, 3), 255.0))
        self.encoder = TileEncoder(side, args.depth) if tiles else ConvEncoder(args.depth)
        self.embed = nn.Linear(self.encoder.size, hidden)
        self.posterior_m = Posterior(hidden, 64, args.read_bias, args.boundary_bound)  # q(m | O)
        self.z_rnn = Recurrence(sz + dw + sw + num_actions, hidden, dz)  # f_z-rnn
        self.prior_z = DistributionHead(dz, args.stoch_z, args)  # p(v_t | c_t)
        self.posterior_z = DistributionHead(dz, args.stoch_z, args)  # q(v_t | c_t, o_t)
        self.w_rnn = Recurrence(sw + num_actions + z, hidden, dw)  # f_w-rnn
        self.w_start = nn.Linear(z, dw)  # for `--w-reset`
        self.prior_w = DistributionHead(dw, args.stoch_w, args)  # p(y_t | h_t)
        self.posterior_w = DistributionHead(dw + z, args.stoch_w, args)  # q(y_t | h_t, z_t, o_t)
        self.prior_m = mlp(w + z + num_actions, hidden, 1, 2)  # p(m_t | w_t, z_t, a_t)
        self.decoder = (  # p(o_t | w_t, z_t)
            TileDecoder(self.feature_size, side, args.depth) if tiles else ConvDecoder(self.feature_size, args.depth)
        )
        self.reward = head(self.feature_size, args.head_size, 1, args.head_layers, args.head_norm)
        self.discount = head(self.feature_size, args.head_size, 1, args.head_layers, args.head_norm)

    def normalize(self, frames: torch.Tensor) -> torch.Tensor:
        """Frames (..., side, side, 3) uint8 -> what the model sees."""
        return (frames - self.frame_mean) / self.frame_scale

    def embedding(self, frames: torch.Tensor) -> torch.Tensor:
        """Normalised frames (N, side, side, 3) -> (N, hidden)."""
        return self.embed(self.encoder(frames))

    def start(self, batch: int) -> Belief:
        return Belief(*(self.frame_mean.new_zeros(batch, size) for size in (*self.sizes, 1)))

    def noise(self, *shape: int) -> torch.Tensor:
        """What steps draw m, v and y with, (*shape, 1 + stoch_z + stoch_w): a uniform number, then uniform or normal ones."""
        make = torch.rand if self.args.classes > 1 else torch.randn
        numbers = make(*shape, self.args.stoch_z + self.args.stoch_w).to(self.frame_mean.device)
        return torch.cat([uniforms(*shape, 1, device=self.frame_mean.device), numbers], -1)

    def draws(self, noise: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Noise (..., 1 + stoch_z + stoch_w) -> its parts for m, v and y."""
        return noise.split([1, self.args.stoch_z, self.args.stoch_w], -1)

    def low_level(self, state: Belief, z: torch.Tensor, previous_action, read) -> torch.Tensor:
        """h_t (B, deter_w) from w_{t-1}, a_{t-1} and z_t; with `--w-reset` from z_t alone where z was read."""
        h = self.w_rnn(torch.cat([state.y, previous_action, z * self.args.h_sees_z], -1), state.h)
        return read * torch.tanh(self.w_start(z)) + (1 - read) * h if self.args.w_reset else h

    def high_level(self, state: Belief, previous_action) -> torch.Tensor:
        """c_t (B, deter_z) where z is read."""
        low = torch.cat([state.h, state.y, previous_action], -1) * self.args.c_sees_w
        return self.z_rnn(torch.cat([state.v, low], -1), state.c)

    def step(self, state: Belief, previous_action, read, embed: torch.Tensor, noise: torch.Tensor) -> tuple:
        """One step with a frame: the belief at t from that at t − 1, and q(v_t) and q(y_t).

        previous_action (B, A), read (B, 1), embed (B, hidden), noise (B, 1 + stoch_z + stoch_w).
        """
        _, draw_v, draw_y = self.draws(noise)
        c = read * self.high_level(state, previous_action) + (1 - read) * state.c  # UPDATE or COPY
        q_z = self.posterior_z(c, embed)
        v = read * draw(q_z, draw_v) + (1 - read) * state.v
        z = torch.cat([c, v], -1)
        h = self.low_level(state, z, previous_action, read)
        q_w = self.posterior_w(torch.cat([h, z], -1), embed)
        return Belief(c, v, h, draw(q_w, draw_y), (1 - read.detach()) * (state.age + 1)), q_z, q_w

    def draw_prior_m(self, state: Belief, action: torch.Tensor, uniform: torch.Tensor) -> torch.Tensor:
        """m_t (B, 1), drawn from p(m_t | w_t, z_t, a_t), or every `--fixed-interval` steps."""
        if self.args.fixed_interval:
            return (state.age + 1 >= self.args.fixed_interval).float()
        logits = self.prior_m(torch.cat([state.features(), action], -1))
        return (uniform < torch.sigmoid(logits.float())).float()

    def filter(self, state: Belief, action: torch.Tensor, begins: torch.Tensor, embed, noise: torch.Tensor) -> tuple:
        """One step with a frame, m from p(m); begins (B, 1): 1 where an episode begins, whose past is forgotten."""
        read = torch.maximum(begins, self.draw_prior_m(state, action, noise[..., :1]))
        forgotten = Belief(*((1 - begins) * part for part in state))
        return self.step(forgotten, (1 - begins) * action, read, embed, noise)

    def imagine_step(self, state: Belief, action: torch.Tensor, noise: torch.Tensor) -> Belief:
        """One step without a frame: m, v and y from their priors (Eq. 3.3.1)."""
        uniform, draw_v, draw_y = self.draws(noise)
        read = self.draw_prior_m(state, action, uniform)
        c = read * self.high_level(state, action) + (1 - read) * state.c
        v = read * draw(self.prior_z(c), draw_v) + (1 - read) * state.v
        z = torch.cat([c, v], -1)
        h = self.low_level(state, z, action, read)
        return Belief(c, v, h, draw(self.prior_w(h), draw_y), (1 - read) * (state.age + 1))

    def draw_m(self, logits: torch.Tensor, temperature: float) -> torch.Tensor:
        """Bernoulli samples of logits (T, B) by the binary Gumbel trick, with the gradient of the soft ones."""
        uniform = uniforms(*logits.shape, device=logits.device).clamp(1e-6, 1 - 1e-6)
        soft = torch.sigmoid((logits + torch.logit(uniform)) / temperature)
        return (soft > 0.5).float() + (soft - soft.detach())

    def observe(self, embed: torch.Tensor, actions: torch.Tensor, first: torch.Tensor, temperature: float) -> Inference:
        """Infer T steps, m from q(m | O): embed (T, B, hidden), actions before each step (T, B, A), first (T, B)."""
        q_m = self.posterior_m(embed, first).float()
        m, noise, state = self.draw_m(q_m, temperature), self.noise(*first.shape), self.start(first.shape[1])
        made = []
        for t in range(len(embed)):
            begins = first[t, :, None]
            if self.args.fixed_interval:
                read = torch.maximum(begins, (state.age + 1 >= self.args.fixed_interval).float())
                force = torch.ones_like(begins)
            else:
                read, force = begins + (1 - begins) * (m[t - 1, :, None] if t else 0), begins
            state = Belief(*((1 - begins) * part for part in state))
            state, q_z, q_w = self.step(state, (1 - begins) * actions[t], read, embed[t], noise[t])
            made.append((state, q_z, q_w, read, force))
        *states, reads, forced = zip(*made)
        belief, q_z, q_w = (type(column[0])(*(torch.stack(part) for part in zip(*column))) for column in states)
        p_m = self.prior_m(torch.cat([belief.features()[:-1], actions[1:]], -1)).squeeze(-1).float()
        return Inference(belief, torch.stack(reads)[..., 0], torch.stack(forced)[..., 0], q_z, q_w, q_m, p_m)

    def decode(self, belief: Belief) -> torch.Tensor:
        """Beliefs (N, ...) -> normalised frames (N, side, side, 3)."""
        c, h = belief.c * self.args.decoder_sees_c, belief.h * self.args.decoder_sees_h
        return self.decoder(torch.cat([c, belief.v, h, belief.y], -1))

    def outcome(self, features: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Features (..., F) of states -> the reward on arriving there, and the probability that the episode goes on, (...)."""
        return self.reward(features).squeeze(-1).float(), torch.sigmoid(self.discount(features).squeeze(-1).float())


def warm_up(args: Args, updates: int) -> float:
    """The share of its weight that the KL divergence has, from a tenth to all over `--kl-warmup` updates."""
    share = (updates + 1) / args.kl_warmup if args.kl_warmup else 1.0
    return min(1.0, max(0.1, share))


def schedule(args: Args, updates: int) -> tuple[float, float]:
    """Temperature and read budget after so many updates."""
    ramp = min(1.0, updates / args.budget_updates)
    return 1 + (args.temperature - 1) * ramp, 1 + (args.budget - 1) * ramp


def world_model_loss(model: HWM, data: Chunks, updates: int) -> tuple[torch.Tensor, Belief, dict[str, torch.Tensor]]:
    """−J_HWM + J_R (Eq. 3.3.5, 3.3.11) per step after so many updates, the beliefs (T, B, ...), and the parts of the loss."""
    args, (temperature, budget) = model.args, schedule(model.args, updates)
    frames = model.normalize(data.frames.flatten(0, 1))  # (T · B, side, side, 3)
    embed = model.embedding(frames).unflatten(0, data.first.shape)
    actions = F.one_hot(data.actions, model.num_actions).float()
    made = model.observe(embed, actions, data.first, temperature)
    flat = Belief(*(part.flatten(0, 1) for part in made.belief))
    image = 0.5 * F.mse_loss(model.decode(flat).float(), frames, reduction="sum") / len(frames)
    p_z, p_w = model.prior_z(made.belief.c), model.prior_w(made.belief.h)
    weight = made.reads.detach() if args.detach_kl_z else made.reads  # Eq. 3.3.7 weights KL_z by q(M)
    kl_z = weight * balanced(kl_divergence, made.q_z, p_z, args.kl_balance)
    kl_w = balanced(kl_divergence, made.q_w, p_w, args.kl_balance)
    decides = 1 - made.forced[1:]  # q(m_t) pairs with p(m_t) where step t + 1 was free to read or to copy
    kl_m = decides * balanced(kl_bernoulli, made.q_m[:-1], made.p_m, args.kl_balance)
    settled = decides * (1 - data.first[:-1])  # a read after the first ends no segment: at the first c knows nothing
    expected = (torch.sigmoid(made.q_m[:-1]) * settled).sum() / settled.sum().clamp(min=1)  # the read rate, by q(m)
    features = as_computed(flat.features())
    target = data.rewards.tanh() if args.tanh_reward else data.rewards
    reward = 0.5 * (model.reward(features).squeeze(-1).float() - target.flatten()).square().mean()
    goes_on = model.discount(features).squeeze(-1).float()
    discount = F.binary_cross_entropy_with_logits(goes_on, 1 - data.terminals.flatten())
    share, code_entropy = warm_up(args, updates), 0.0
    if args.classes > 1:
        code_entropy = (made.reads.detach() * entropy(made.q_z.logits)).mean() + entropy(made.q_w.logits).mean()
    loss = (
        args.image_scale * image
        + args.reward_scale * reward
        + args.discount_scale * discount
        + share * (args.kl_z_scale * kl_z.mean() + args.kl_w_scale * kl_w.mean())
        + args.kl_m_scale * kl_m.mean()
        - (1 - share) * args.entropy_scale * code_entropy
        + args.budget_price * F.relu(expected - budget)
    )
    inside = 1 - data.first  # a first frame costs tens of nats, which say nothing of the dynamics
    read = made.reads.detach() * inside
    parts = {"image": image, "reward": reward, "discount": discount, "kl_m": kl_m.mean()}
    parts |= {"kl_z": (kl_z * inside).sum() / read.sum().clamp(min=1)}
    parts |= {"kl_w": (kl_w * inside).sum() / inside.sum().clamp(min=1)}
    follows = inside[1:] * (1 - data.first[:-1])
    later = (read[1:] * follows).sum()
    parts |= {"read_rate": later / follows.sum().clamp(min=1), "segment_length": follows.sum() / later.clamp(min=1)}
    if not args.fixed_interval:
        spread = ((torch.sigmoid(made.q_m[:-1]) - expected).square() * settled).sum() / settled.sum().clamp(min=1)
        agreement = ((made.p_m > 0) == (made.q_m[:-1] > 0)).float()
        parts |= {"read_spread": spread.sqrt()}  # 0: q(m) is the same everywhere
        parts |= {"agreement": (agreement * decides).sum() / decides.sum().clamp(min=1)}
    return loss, made.belief, {f"losses/{name}": value.detach() for name, value in parts.items()}


# ---------------------------------------------------------------------------------------------------------------------
# Behaviour: actor and critic in the dream
# ---------------------------------------------------------------------------------------------------------------------
class Behaviour(nn.Module):
    """Actor and critic of both levels, and the slow critics that the returns are made with."""

    STEPS = ("policy",)

    def __init__(self, args: Args, model: nn.Module):
        super().__init__()
        self.num_skills, self.z_size = args.num_skills, args.deter_z + args.stoch_z * args.classes
        shape, low = (args.head_layers, args.head_norm), model.feature_size + args.num_skills
        self.actor = head(low, args.head_size, model.num_actions, *shape)
        self.critic = head(low, args.head_size, 1, *shape)
        self.high_actor = head(self.z_size, args.head_size, args.num_skills, *shape)
        self.high_critic = head(self.z_size, args.head_size, 1, *shape)
        self.slow_critic = copy.deepcopy(self.critic).requires_grad_(False)
        self.slow_high_critic = copy.deepcopy(self.high_critic).requires_grad_(False)

    def parts(self) -> dict[str, nn.Module]:
        """What learns, each by its own loss."""
        low = {"actor": self.actor, "critic": self.critic}
        return low | {"high_actor": self.high_actor, "high_critic": self.high_critic}

    def copy_critics(self) -> None:
        self.slow_critic.load_state_dict(self.critic.state_dict())
        self.slow_high_critic.load_state_dict(self.high_critic.state_dict())

    def policy(self, features: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
        """Logits of π^L(a | w, z, e), (..., A); features (..., F), skill (..., K) one-hot."""
        return self.actor(torch.cat([features, skill], -1)).float()

    def high_policy(self, features: torch.Tensor) -> torch.Tensor:
        """Logits of π^H(e | z), (..., K); the features of z stand first."""
        return self.high_actor(features[..., : self.z_size]).float()

    def value(self, features: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
        """V^L(w, z, e), (...); features (..., F), skill (..., K) one-hot."""
        return self.critic(torch.cat([features, skill], -1)).squeeze(-1).float()

    def slow_value(self, features: torch.Tensor, skill: torch.Tensor) -> torch.Tensor:
        """The slow critic's V^L, of the same shapes."""
        return self.slow_critic(torch.cat([features, skill], -1)).squeeze(-1).float()

    def high_value(self, features: torch.Tensor) -> torch.Tensor:
        """V^H(z), (..., F) -> (...); the features of z stand first."""
        return self.high_critic(features[..., : self.z_size]).squeeze(-1).float()

    def slow_high_value(self, features: torch.Tensor) -> torch.Tensor:
        """The slow critic's V^H, of the same shapes."""
        return self.slow_high_critic(features[..., : self.z_size]).squeeze(-1).float()

    def choose(self, features: torch.Tensor, uniform: torch.Tensor) -> torch.Tensor:
        """A skill (..., K) drawn from π^H(e | z)."""
        return one_hot_sample(self.high_policy(features), uniform)


class Dream(NamedTuple):
    """H steps from each of N states: action h is taken at state h by skill h and leads to state h + 1."""

    features: torch.Tensor  # (H + 1, N, F)
    actions: torch.Tensor  # (H, N, A) one-hot
    rewards: torch.Tensor  # (H, N), on arriving at state h + 1
    discounts: torch.Tensor  # (H, N): γ times the probability that the episode goes on at state h + 1
    skills: torch.Tensor  # (H + 1, N, K) one-hot
    decides: torch.Tensor  # (H + 1, N): 1 where a segment begins; a dream's first skill is drawn within one, too


@torch.no_grad()
def imagine(model: nn.Module, behaviour: Behaviour, state: NamedTuple, horizon: int, gamma: float) -> Dream:
    """Dream from states (N, ...) by the policies of both levels."""
    games, device = len(state.features()), state[0].device
    noise, choices = model.noise(horizon, games), uniforms(horizon, games, device=device)
    skill_choices = uniforms(horizon + 1, games, device=device)
    features, actions = [state.features()], []
    skills, decides = [behaviour.choose(features[0], skill_choices[0])], [(state.age == 0).float().squeeze(1)]
    for h in range(horizon):
        actions.append(one_hot_sample(behaviour.policy(features[-1], skills[-1]), choices[h]))
        state = model.imagine_step(state, actions[-1], noise[h])
        features.append(state.features())
        read = (state.age == 0).float()  # (N, 1): m_h = 1
        skills.append(read * behaviour.choose(features[-1], skill_choices[h + 1]) + (1 - read) * skills[-1])
        decides.append(read.squeeze(1))
    stacked = as_computed(torch.stack(features))  # (H + 1, N, F)
    rewards, goes_on = model.outcome(stacked[1:])
    chosen = as_computed(torch.stack(skills))  # (H + 1, N, K)
    return Dream(stacked, torch.stack(actions), rewards, gamma * goes_on, chosen, torch.stack(decides))


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


def high_return(rewards, discounts, decides, high_values, last_value, gae_lambda: float) -> torch.Tensor:
    """V_λ^{H,τ} of Eq. 3.3.16, the λ-return over segments, on the steps' clock: G_h = r_{h+1} + d_{h+1} X_{h+1}.

    X_{h+1} is (1 − λ) V^H_{h+1} + λ G_{h+1} where a segment begins (m_h = 1), and G_{h+1} within one. The dream ends with V^H where
    a segment begins there, else with last_value (N,), V^L of the segment that goes on. rewards and discounts (H, N), decides and
    high_values (H + 1, N), where decides_{h+1} is m_h -> (H, N).
    """
    returns, following = [], torch.where(decides[-1] > 0, high_values[-1], last_value)
    for h in reversed(range(len(rewards))):
        mixed = (1 - gae_lambda) * high_values[h + 1] + gae_lambda * following
        following = rewards[h] + discounts[h] * torch.where(decides[h + 1] > 0, mixed, following)
        returns.append(following)
    return torch.stack(returns[::-1])


def policy_loss(logits, chosen, advantages, weights, ent_coef: float) -> tuple[torch.Tensor, torch.Tensor]:
    """A policy's loss of either level (Eq. 3.3.15, 3.3.17), its terms weighted and summed, and its entropies (...).

    logits and chosen (..., A), advantages and weights (...).
    """
    log_policy = logits.log_softmax(-1)
    entropy = -(log_policy.exp() * log_policy).sum(-1)
    terms = (log_policy * chosen).sum(-1) * advantages + ent_coef * entropy
    return -(weights * terms).sum(), entropy


def behaviour_loss(
    behaviour: Behaviour, dream: Dream, gae_lambda: float, ent_coef: float
) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """The losses of both actors (Eq. 3.3.15, 3.3.17) and both critics (Eq. 3.3.14, 3.3.16) by their names, and what to log.

    The returns less the slow critics stand in the place of V.
    """
    features, skills = dream.features[:-1], dream.skills[:-1]
    with torch.no_grad():
        values = behaviour.slow_value(dream.features, dream.skills)
        high_values = behaviour.slow_high_value(dream.features)
        returns = lambda_return(dream.rewards, dream.discounts, values, gae_lambda)
        high_returns = high_return(dream.rewards, dream.discounts, dream.decides, high_values, values[-1], gae_lambda)
        weights, decides = dream_weights(dream.discounts), dream.decides[:-1] > 0
        num_decisions = decides.sum().clamp(min=1)
    logits = behaviour.policy(features, skills)
    actor, entropy = policy_loss(logits, dream.actions, returns - values[:-1], weights, ent_coef)  # Eq. 3.3.15
    critic = (weights * 0.5 * (behaviour.value(features, skills) - returns).square()).mean()  # Eq. 3.3.14
    high_features, advantages = features[decides], (high_returns - high_values[:-1])[decides]  # (M, F), (M,)
    chosen, high_weights, high_logits = skills[decides], weights[decides], behaviour.high_policy(high_features)
    high_actor, high_entropy = policy_loss(high_logits, chosen, advantages, high_weights, ent_coef)  # Eq. 3.3.17
    errors = 0.5 * (behaviour.high_value(high_features) - high_returns[decides]).square()
    high_critic = (high_weights * errors).sum() / num_decisions  # Eq. 3.3.16
    losses = {"actor": actor / weights.numel(), "critic": critic}
    losses |= {"high_actor": high_actor / num_decisions, "high_critic": high_critic}
    parts = {
        **losses,
        "entropy": entropy.mean(),
        "high_entropy": high_entropy.sum() / num_decisions,
        "advantage_std": (returns - values[:-1]).std(correction=0),
    }
    parts |= {
        "dream_return": returns.mean(),
        "dream_reward": dream.rewards.max(),  # the greatest one, not the mean
        "dream_reads": dream.decides[1:].mean(),
    }
    parts |= {"skill_usage_entropy": skill_usage_entropy(behaviour, dream.features[0])}
    parts |= {"skill_information": skill_information(behaviour, dream.features[0])}
    return losses, {f"losses/{name}": value.detach() for name, value in parts.items()}


@torch.no_grad()
def skill_usage_entropy(behaviour: Behaviour, features: torch.Tensor) -> torch.Tensor:
    """Entropy in nats of how often π^H chooses each skill, over states with features (N, F)."""
    usage = behaviour.high_policy(features).softmax(-1).mean(0)
    return -(usage * usage.clamp(min=1e-8).log()).sum()


@torch.no_grad()
def skill_information(behaviour: Behaviour, features: torch.Tensor) -> torch.Tensor:
    """I(e; a | w, z) in nats, the mean over states with features (N, F): how much the skill says of the action."""
    skills = torch.eye(behaviour.num_skills, device=features.device)
    each = torch.stack([behaviour.policy(features, skill.expand(len(features), -1)).softmax(-1) for skill in skills], 1)
    chosen = behaviour.high_policy(features).softmax(-1)[..., None]  # (N, K, 1)

    def entropy(p: torch.Tensor) -> torch.Tensor:
        return -(p * p.clamp(min=1e-12).log()).sum(-1)

    return (entropy((chosen * each).sum(1)) - (chosen[..., 0] * entropy(each)).sum(1)).mean()


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
        self.skill = model.frame_mean.new_zeros(num_games, learner.args.num_skills)

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
        """An action for each game, (N,): drawn, or the most probable; where a segment begins, a skill first."""
        behaviour, features = self.learner.behaviour, self.state.features()
        with self.learner.autocast():
            self.skill = torch.where(self.state.age == 0, pick(behaviour.high_policy(features), greedy), self.skill)
            logits = behaviour.policy(features, self.skill)
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
            "belief": [*self.player.state, self.player.action, self.player.skill],
            "lengths": lengths,
            "begins": begins,
        }

    def load_state_dict(self, state: dict) -> None:
        """Go on from what `state_dict` returned, and from the rows of the replay buffer's file."""
        games = self.envs.games
        for name, tensor in state["games"].items():
            array = getattr(games, name)
            array[:] = tensor.numpy().view(array.dtype)
        *belief, self.player.action, self.player.skill = (
            part.to(self.player.learner.device) for part in state["belief"]
        )
        self.player.state = type(self.player.state)(*belief)
        self.replay.go_on(state["lengths"].numpy())
        self.begins = state["begins"].numpy().copy()
        self.obs = self.envs.draw()


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "hwm_hrl_dreamer 1"
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
    axes.set_title(f"{args.env_id}, HWM HRL Dreamer, size {args.size}, seed {args.seed}")
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

    model = HWM(args, int(ROOM_ACTIONS.n))
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
                logged.append(learner.update(data))  # Eq. 3.3.18

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
