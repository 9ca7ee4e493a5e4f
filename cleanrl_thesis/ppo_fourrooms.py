"""PPO from pixels in FourRooms: the agent whose episodes the hierarchical world model is trained on (thesis section 3.4).

    python cleanrl_thesis/ppo_fourrooms.py --save-model                                                  # near-optimal play
    python cleanrl_thesis/ppo_fourrooms.py --stop-at 1100000 --save-demos 2300 --run-dir runs/rooms      # the episodes

The task is built in (`gymnasium.make("cleanrl_thesis.ppo_fourrooms:FourRooms11-v0")`): MiniGrid's FourRooms with fixed doors,
three actions, and frames of the whole maze, 64 × 64 × 3. `gymnasium.make_vec` gives the same game by tables, a hundred times
faster; training uses that. `--run-dir DIR --resume` can be sent again after every crash: on the same machine the
run ends with the same bytes.

| setting | here | source |
|---|---|---|
| maze | 11 × 11 cells, doors at (5, 2), (2, 5), (7, 5), (5, 8); goal in another room, at least 3 cells away | the author's public code; the thesis names MiniGrid-FourRooms-v0, 19 × 19, whose shortest episodes are longer than its 14.4 steps |
| 19 × 19 cells | `FourRooms19-v0`: agent and goal anywhere, doors as MiniGrid draws them with seed 0 | MiniGrid; the thesis has fixed doors |
| settings there | `--total-timesteps 9000000 --hidden-size 256 --num-minibatches 32 --update-epochs 3 --learning-rate 7e-4` | ours: 0.85 of 0.86 (one seed); 6,000,000 steps gave 0.84 and 0.76 (two), with the defaults 12,000,000 gave 0.78 |
| first direction of the agent | drawn | ours; the author's code has it face up |
| algorithm | PPO; Stable-Baselines3 in the thesis | our own; γ, λ, ε, weight of the value loss and bound on the gradient are Stable-Baselines3's defaults, other settings chosen by measurement (the thesis gives none) |
| demonstrations | sampled actions of a player stopped at 1,100,000 steps: 14.8 steps an episode, in the thesis 14.4 | the finished player hardly varies its ways: 0.015 nats an action; `--demo-mode greedy` takes the best one |
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
import csv
import fcntl
import functools
import hashlib
import importlib.util
import io
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
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import gymnasium as gym
import minigrid.envs
import numpy as np
import safetensors.torch
import torch
import torch.nn as nn
import tyro
from minigrid.core.grid import Grid
from minigrid.core.mission import MissionSpace
from minigrid.core.world_object import Goal, Wall
from minigrid.minigrid_env import MiniGridEnv
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    exp_name: str = "ppo_fourrooms"
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
    """compile the loss and its gradient (needs a C++ compiler; compiling takes seconds, once); slower than without on the CPU that it was tried on"""
    bf16: bool = False
    """convolutions and the hidden layer in bfloat16: faster where the processor has instructions for it"""
    track: bool = False
    """also log to Weights and Biases (`pip install wandb`)"""
    wandb_project_name: str = "cleanrl-thesis"
    """the project of Weights and Biases"""
    wandb_entity: str | None = None
    """the team of Weights and Biases"""
    capture_video: bool = False
    """record the first evaluation episode into `videos/` (`pip install moviepy`)"""
    save_model: bool = False
    """write `model.safetensors` at the end"""
    save_demos: int = 0
    """episodes of the trained agent to write into `demos/`, one .npz each and a manifest; 2,300 of a player stopped at 1,100,000 steps are 34,000 pairs"""
    demo_mode: Literal["sampled", "greedy"] = "sampled"
    """how the agent acts in `--save-demos`"""
    demo_noise: float = 0.0
    """share of the actions of `--save-demos` that are drawn at random instead: the agent wanders; written into `demos_noise_{demo_noise}/`"""
    eval_episodes: int = 2_000
    """episodes of the evaluation at the end, with the most probable action"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 100_000
    """environment steps between checkpoints"""
    stop_at: int | None = None
    """end at this environment step of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: Literal["FourRooms11-v0", "FourRooms19-v0"] = "FourRooms11-v0"
    """the maze of 11 × 11 cells (the author's code) or of 19 × 19 (MiniGrid)"""
    total_timesteps: int = 3_000_000
    """environment steps, rounded down to whole batches (ours)"""
    frame_side: int | None = None
    """pixels of the side of the frames that the agent sees, demonstrations have 64; default: two for each cell (ours)"""
    channels: int = 16
    """channels of the first convolution; the second has twice as many (ours)"""
    hidden_size: int = 128
    """units of the hidden layer (ours)"""
    num_envs: int = 256
    """games side by side (ours)"""
    num_steps: int = 64
    """steps of each game per batch (ours)"""
    learning_rate: float = 5e-4
    """Adam's learning rate (ours)"""
    anneal_lr: bool = True
    """anneal the learning rate linearly to 0 (ours)"""
    gamma: float = 0.99
    """discount factor γ (Stable-Baselines3)"""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimation, A(τ, V, t) of Eq. 4.2.3 (Stable-Baselines3)"""
    num_minibatches: int = 64
    """minibatches per update iteration (ours)"""
    update_epochs: int = 4
    """update iterations per batch (ours)"""
    clip_coef: float = 0.2
    """ε of the clipped objective, Eq. 4.2.6 (Stable-Baselines3)"""
    ent_coef: float = 0.01
    """weight of the entropy (ours)"""
    vf_coef: float = 0.5
    """weight of the value loss (Stable-Baselines3)"""
    max_grad_norm: float = 0.5
    """bound on the norm of the gradient; inf for none (Stable-Baselines3)"""

    # to be filled in runtime
    batch_size: tyro.conf.Suppress[int] = 0
    """num_envs · num_steps"""
    num_iterations: tyro.conf.Suppress[int] = 0
    """total_timesteps // batch_size"""


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
    args.stop_at = args.total_timesteps if args.stop_at is None else args.stop_at
    counts = "num_envs num_steps num_minibatches update_epochs eval_episodes checkpoint_interval stop_at"
    counts += " channels hidden_size"
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("clip_coef max_grad_norm", lambda x: x > 0, "must be greater than 0"),
        ("ent_coef vf_coef", lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("gamma gae_lambda", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos", lambda x: x >= 0, "must be at least 0"),
        ("demo_noise", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    args.frame_side = 2 * ROOM_SIZES[args.env_id] if args.frame_side is None else args.frame_side
    holds = 8 <= args.frame_side <= 128 and args.frame_side % 2 == 0
    require(holds, "--frame-side", args.frame_side, "must be an even number from 8 to 128")
    args.batch_size = args.num_envs * args.num_steps
    divides = args.batch_size % args.num_minibatches == 0
    require(divides, "--num-minibatches", args.num_minibatches, f"must divide the batch of {args.batch_size} steps")
    allowed = "must be at least 2 steps, for the advantages' deviation"
    require(args.batch_size >= 2, "--num-envs · --num-steps", args.batch_size, allowed)
    args.num_iterations = args.total_timesteps // args.batch_size
    allowed = f"must be at least one batch of {args.batch_size} steps"
    require(args.num_iterations >= 1, "--total-timesteps", args.total_timesteps, allowed)
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


class FourRoomsEnv(minigrid.envs.FourRoomsEnv):
    """MiniGrid's game in a maze with fixed doors; observations are frames of the whole maze, (side, side, 3) uint8."""

    metadata = {"render_modes": ["human", "rgb_array"], "render_fps": 10}

    def __init__(self, size: int = 11, side: int = 64, render_mode: str | None = None):
        self.games = FourRoomsGames(size, 1)  # where episodes begin, and the state as numbers
        self.game, self.painter = np.zeros(1, np.intp), painter(size, side)
        mission = MissionSpace(mission_func=self._gen_mission)
        options = {"max_steps": MAX_STEPS, "render_mode": render_mode, "highlight": False}
        MiniGridEnv.__init__(self, mission, width=size, height=size, **options)
        self.observation_space, self.action_space = room_frames(side), ROOM_ACTIONS
        self.games.seed(0, self.np_random)

    def _gen_grid(self, width: int, height: int) -> None:
        self.games.begin(self.game)
        cells, (cell, direction, goal) = self.games.maze.cells.tolist(), self.games.state()[0].tolist()
        self.grid = Grid(width, height)
        for x, y in np.argwhere(self.games.maze.cell_at < 0).tolist():
            self.grid.set(x, y, Wall())
        self.put_obj(Goal(), *cells[goal])
        self.agent_pos, self.agent_dir = tuple(cells[cell]), direction

    def observe(self) -> tuple[np.ndarray, dict]:
        """The frame (side, side, 3) of MiniGrid's state, and the state as numbers."""
        self.games.poses[0] = 4 * self.games.maze.cell_at[tuple(self.agent_pos)] + self.agent_dir
        info = {name: value[0] for name, value in make_info(self.games).items()}
        return self.painter.draw(self.games.poses, self.games.goals)[0], info

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        if seed is not None:
            gym.Env.reset(self, seed=seed)
            self.games.seed(0, self.np_random)
        super().reset()
        return self.observe()

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        _, reward, terminated, truncated, _ = super().step(action)
        obs, info = self.observe()
        return obs, float(reward), terminated, truncated, info


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
for room_id, room_size in ROOM_SIZES.items():
    if room_id not in gym.registry:
        gym.register(room_id, FourRoomsEnv, vector_entry_point=FourRoomsVectorEnv, kwargs={"size": room_size})


def make_env(env_id: str, render_mode: str | None = None, side: int = 64) -> gym.Env:
    return gym.make(env_id, side=side, render_mode=render_mode, disable_env_checker=True)


# ---------------------------------------------------------------------------------------------------------------------
# Network
# ---------------------------------------------------------------------------------------------------------------------
def orthogonal(layer: nn.Module, gain: float) -> nn.Module:
    """The layer with orthogonal weights and biases of 0 at first."""
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


OBS_SCALE = 64.0  # grey levels; the agent is a few pixels of 70 levels, the goal of 255


def has_bf16(device: torch.device) -> bool:
    """Whether the device computes in bfloat16: a CPU without such instructions takes several times as long as in float32."""
    return device.type != "cpu" or torch.ops.mkldnn._is_mkldnn_bf16_supported()


class Agent(nn.Module):
    """Policy and value on one trunk: two convolutions, the first over squares of 2 × 2 pixels, and a hidden layer."""

    def __init__(self, side: int, num_actions: int, channels: int, hidden_size: int, bf16: bool = False):
        super().__init__()
        gain, cells, self.bf16 = math.sqrt(2), side // 2, bf16
        self.register_buffer("obs_mean", torch.zeros(side, side, 3))
        self.convolutions = nn.Sequential(
            orthogonal(nn.Conv2d(3, channels, 2, 2), gain),
            nn.ReLU(),
            orthogonal(nn.Conv2d(channels, 2 * channels, 3, 1), gain),
            nn.ReLU(),
        )
        self.hidden = nn.Sequential(
            orthogonal(nn.Linear(2 * channels * (cells - 2) ** 2, hidden_size), gain), nn.ReLU()
        )
        self.actor = orthogonal(nn.Linear(hidden_size, num_actions), 0.01)
        self.critic = orthogonal(nn.Linear(hidden_size, 1), 1.0)

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Frames (B, side, side, 3) uint8 -> logits (B, A), values (B,); channels stay last in memory, which is faster."""
        x = ((obs - self.obs_mean) / OBS_SCALE).permute(0, 3, 1, 2)
        with torch.autocast(obs.device.type, torch.bfloat16, enabled=self.bf16):
            features = self.hidden(self.convolutions(x).permute(0, 2, 3, 1).flatten(1))
        features = features.float()  # the ratio of probabilities needs more digits than bfloat16 has
        return self.actor(features), self.critic(features).squeeze(1)


def mean_frame(args: Args) -> torch.Tensor:
    """The mean of the frames with which episodes can begin, (side, side, 3), which is subtracted from each."""
    task = maze(ROOM_SIZES[args.env_id])
    starts = task.starts[:: max(1, len(task.starts) // 20_000)]
    frames = painter(task.size, args.frame_side).draw(starts[:, 0], starts[:, 1])
    return torch.from_numpy(frames.mean(0, dtype=np.float64).astype(np.float32))


def sample_actions(logits: torch.Tensor, generator: torch.Generator | None = None) -> torch.Tensor:
    """Draw from the softmax of logits (N, A) -> (N,): the largest of the logits with Gumbel noise."""
    noise = torch.empty(logits.shape).exponential_(generator=generator).log()  # drawn on the CPU: one state to restore
    return (logits - noise.to(logits.device)).argmax(1)


# ---------------------------------------------------------------------------------------------------------------------
# Playing
# ---------------------------------------------------------------------------------------------------------------------
EVALUATION_STREAM, DEMONSTRATION_STREAM = 1_000_000, 1_000_001


@functools.lru_cache
def episode_seeds(seed: int, stream: int, block: int) -> list[int]:
    """Seeds of episodes 256 · block and on; a SeedSequence for each would take longer than the environment's reset."""
    return np.random.SeedSequence([seed, stream, block]).generate_state(256).tolist()


def episode_seed(seed: int, stream: int, episode: int) -> int:
    """Seed of an episode: sub-environment `stream` of run `seed`, or one of the streams that are not trained on."""
    return episode_seeds(seed, stream, episode // 256)[episode % 256]


class Rollout(NamedTuple):
    """T steps of N games; where an episode ended, the next observation is the first of the following one."""

    obs: torch.Tensor  # (T, N, side, side, 3) uint8
    actions: torch.Tensor  # (T, N)
    logprobs: torch.Tensor  # (T, N)
    values: np.ndarray  # (T + 1, N)
    rewards: np.ndarray  # (T, N), with γ V(final observation) added where the episode was cut off
    dones: np.ndarray  # (T, N), 1 where the episode ended with step t
    episodes: list[tuple[int, float, int]]  # step within the rollout, return, length


class Collector:
    """Games side by side, and what of their episodes goes on between rollouts."""

    def __init__(self, args: Args, device: torch.device):
        self.args, self.device = args, device
        self.envs = FourRoomsVectorEnv(args.num_envs, ROOM_SIZES[args.env_id], args.frame_side)
        self.obs, _ = self.envs.reset(seed=[episode_seed(args.seed, i, 0) for i in range(args.num_envs)])

    def act(self, agent: Agent, obs: np.ndarray) -> tuple[torch.Tensor, ...]:
        """Frames (N, side, side, 3) -> sampled actions (N,), their log-probabilities (N,), values (N,), and the frames."""
        frames = torch.from_numpy(obs).to(self.device)
        logits, values = agent(frames)
        actions = sample_actions(logits)
        logprobs = logits.log_softmax(1).gather(1, actions[:, None]).squeeze(1)
        return actions, logprobs, values, frames

    def values(self, agent: Agent, obs: np.ndarray) -> np.ndarray:
        """Frames (N, side, side, 3) -> values (N,)."""
        return agent(torch.from_numpy(obs).to(self.device))[1].cpu().numpy()

    @torch.no_grad()
    def collect(self, agent: Agent) -> Rollout:
        """Play `num_steps` steps of each game by the agent's policy."""
        args, columns, episodes = self.args, [], []
        rewards, dones = (np.zeros((args.num_steps, args.num_envs), np.float32) for _ in range(2))
        for t in range(args.num_steps):
            actions, logprobs, values, frames = self.act(agent, self.obs)
            columns.append((frames, actions, logprobs, values))
            lengths = self.envs.games.steps + 1
            self.obs, rewards[t], terminated, truncated, infos = self.envs.step(actions.cpu().numpy())
            dones[t] = terminated | truncated
            for i in np.flatnonzero(dones[t]).tolist():
                episodes.append((t * args.num_envs + i + 1, float(rewards[t, i]), int(lengths[i])))
            cut_off = np.flatnonzero(truncated & ~terminated)
            if len(cut_off):  # a time-out is not an end
                rewards[t, cut_off] += args.gamma * self.values(agent, infos["final_obs"][cut_off])
        obs, actions, logprobs, values = (torch.stack(column) for column in zip(*columns))
        all_values = np.concatenate([values.cpu().numpy(), self.values(agent, self.obs)[None]])
        return Rollout(obs, actions, logprobs, all_values, rewards, dones, episodes)

    def state_dict(self) -> dict[str, torch.Tensor]:
        """Keys, starts drawn, poses, goals and steps of the games."""
        games = self.envs.games
        names = ("keys", "draws", "poses", "goals", "steps")
        return {name: torch.from_numpy(getattr(games, name).view(np.int64).copy()) for name in names}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        games = self.envs.games
        for name, tensor in state.items():
            array = getattr(games, name)
            array[:] = tensor.numpy().view(array.dtype)
        self.obs = self.envs.draw()


# ---------------------------------------------------------------------------------------------------------------------
# The algorithm
# ---------------------------------------------------------------------------------------------------------------------
def gae(rewards: np.ndarray, values: np.ndarray, dones: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """Generalised advantage estimation, A(τ, V, t) of Eq. 4.2.3, for all games at once.

    rewards (T, N), values (T + 1, N), dones (T, N), 1 where the episode ended with step t -> advantages (T, N).
    """
    advantages, advantage = np.empty_like(rewards), np.zeros_like(rewards[0])
    alive = 1 - dones
    deltas = rewards + gamma * values[1:] * alive - values[:-1]
    for t in reversed(range(len(rewards))):
        advantage = deltas[t] + gamma * gae_lambda * alive[t] * advantage
        advantages[t] = advantage
    return advantages


class Batch(NamedTuple):
    """B steps as tensors."""

    obs: torch.Tensor  # (B, side, side, 3) uint8
    actions: torch.Tensor  # (B,) int64
    logprobs: torch.Tensor  # (B,)
    advantages: torch.Tensor  # (B,)
    returns: torch.Tensor  # (B,)

    def rows(self, indices: torch.Tensor) -> "Batch":
        """The steps of the given indices (M,)."""
        return Batch(*(column[indices] for column in self))


def make_batch(rollout: Rollout, args: Args, device: torch.device) -> Batch:
    """Estimate the advantages of a rollout, and flatten it.

    Advantages are normalised over the whole batch: at first most minibatches hold no reward, and alone each would blow up
    the value function's noise.
    """
    advantages = gae(rollout.rewards, rollout.values, rollout.dones, args.gamma, args.gae_lambda)
    b_advantages, b_returns = (
        torch.from_numpy(array).to(device).flatten() for array in (advantages, advantages + rollout.values[:-1])
    )
    b_advantages = (b_advantages - b_advantages.mean()) / (b_advantages.std() + 1e-8)
    return Batch(*(column.flatten(0, 1) for column in rollout[:3]), b_advantages, b_returns)


def ppo_loss(
    logits: torch.Tensor, values: torch.Tensor, minibatch: Batch, clip_coef: float, ent_coef: float, vf_coef: float
) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
    """The loss to minimise, and as scalars the policy's loss, the value's, the entropy, the KL divergence (k3) and the
    share of clipped ratios, before the step. logits (M, A), values (M,)."""
    log_policy = logits.log_softmax(1)
    logratio = log_policy.gather(1, minibatch.actions[:, None]).squeeze(1) - minibatch.logprobs
    ratio = logratio.exp()  # ρ_t(θ)
    clipped_ratio = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    pg_loss = -torch.min(minibatch.advantages * ratio, minibatch.advantages * clipped_ratio).mean()  # Eq. 4.2.6
    v_loss = 0.5 * (values - minibatch.returns).square().mean()
    entropy = -(log_policy.exp() * log_policy).sum(1).mean()
    loss = pg_loss + vf_coef * v_loss - ent_coef * entropy
    with torch.no_grad():
        kl = (ratio - 1 - logratio).mean()
        clipfrac = (clipped_ratio != ratio).float().mean()
    return loss, (pg_loss.detach(), v_loss.detach(), entropy.detach(), kl, clipfrac)


PARTS = ("policy_loss", "value_loss", "entropy", "kl_k3", "clipfrac")


class Update:
    """Steps of Adam on minibatches."""

    def __init__(self, agent: Agent, args: Args):
        self.agent, self.args = agent, args
        self.optimizer = torch.optim.Adam(agent.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)
        self.loss, self.is_compiled = self.plain_loss, False
        if args.compile:
            self.compile()

    def compile(self) -> None:
        """Compile the loss and its gradient where a compiler is at hand."""
        compiler = os.environ.get("CXX", "g++")
        if shutil.which(compiler) is None:
            print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
            return
        rows, side = self.args.batch_size // self.args.num_minibatches, self.args.frame_side
        device = self.agent.critic.weight.device
        frames = torch.zeros(rows, side, side, 3, dtype=torch.uint8, device=device)
        numbers = torch.zeros(rows, device=device)
        torch.compiler.set_stance("default")
        compiled = torch.compile(self.plain_loss)
        try:  # and changes nothing: the gradients are set to zero before each step
            compiled(Batch(frames, numbers.long(), numbers, numbers, numbers))[0].backward()
            self.loss, self.is_compiled = compiled, True
        except Exception as error:  # whatever the compiler's tool chain lacks, the plain step needs none of it
            print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)

    def plain_loss(self, minibatch: Batch) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """A minibatch of M steps -> `ppo_loss` of the agent: the loss and its five parts, as scalars."""
        args = self.args
        return ppo_loss(*self.agent(minibatch.obs), minibatch, args.clip_coef, args.ent_coef, args.vf_coef)

    def anneal(self, remaining: float) -> None:
        """Set the learning rate to a share of the initial one."""
        for group in self.optimizer.param_groups:
            group["lr"] = remaining * self.args.learning_rate

    def __call__(self, minibatch: Batch) -> torch.Tensor:
        """Change the agent by a minibatch; return the parts of the loss before the step, (5,)."""
        loss, parts = self.loss(minibatch)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.agent.parameters(), self.args.max_grad_norm)
        self.optimizer.step()
        return torch.stack(parts)


def update_agent(update: Update, batch: Batch, args: Args) -> dict[str, float]:
    """`update_epochs` passes over the batch in shuffled minibatches; returns the means of the last pass' metrics."""
    for _ in range(args.update_epochs):
        shuffled = torch.randperm(args.batch_size).to(batch.obs.device)
        parts = [update(batch.rows(rows)) for rows in shuffled.chunk(args.num_minibatches)]
    means = torch.stack(parts).mean(0).tolist()
    return {f"losses/{name}": value for name, value in zip(PARTS, means)}


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "ppo_fourrooms 2"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "capture_video", "save_model", "save_demos", "demo_mode", "demo_noise")
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
@torch.no_grad()
def play(agent: Agent, args: Args, seeds: list[int], mode: str, noise: float = 0.0) -> list[dict[str, np.ndarray]]:
    """One episode for each seed, side by side, with sampled or greedy actions, or with the chance `noise` any action.

    Returns for each `states` (T + 1, 3): cell, direction, goal cell; `rooms` (T + 1,), `actions` (T,), `rewards` (T,),
    `terminated`, `truncated` and `seed`.
    """
    device = next(agent.parameters()).device
    generator, rng = torch.Generator().manual_seed(args.seed), np.random.default_rng(args.seed)
    envs = FourRoomsVectorEnv(len(seeds), ROOM_SIZES[args.env_id], args.frame_side)
    obs, info = envs.reset(seed=seeds)
    states, rooms, actions, rewards, ends = [info["state"]], [info["room"]], [], [], []
    for _ in range(MAX_STEPS):
        parts = torch.from_numpy(obs).split(256)
        logits = torch.cat([agent(part.to(device))[0] for part in parts])
        chosen = sample_actions(logits, generator) if mode == "sampled" else logits.argmax(1)
        actions.append(chosen.cpu().numpy())
        if noise > 0:
            is_random = rng.random(len(seeds)) < noise
            actions[-1] = np.where(is_random, rng.integers(logits.shape[1], size=len(seeds)), actions[-1])
        obs, reward, terminated, truncated, info = envs.step(actions[-1])
        final = info.get("final_info", info)
        states.append(final["state"])
        rooms.append(final["room"])
        rewards.append(reward)
        ends.append((terminated, truncated))
    episodes = []
    for i, seed in enumerate(seeds):
        length = next(t for t in range(MAX_STEPS) if ends[t][0][i] or ends[t][1][i]) + 1
        terminated, truncated = (np.array(end[i]) for end in ends[length - 1])
        episode = {"states": np.array([state[i] for state in states[: length + 1]])}
        episode |= {"rooms": np.array([room[i] for room in rooms[: length + 1]])}
        episode |= {"actions": np.array([action[i] for action in actions[:length]])}
        episode |= {"rewards": np.array([reward[i] for reward in rewards[:length]])}
        episodes.append({**episode, "terminated": terminated, "truncated": truncated, "seed": np.array(seed)})
    return episodes


def fewest_steps(maze: Maze) -> np.ndarray:
    """The least number of actions from each pose to each goal cell, (4 C, C)."""
    cells = np.arange(len(maze.cells))
    steps = np.where(np.arange(len(maze.moves))[:, None] // 4 == cells, 0, len(maze.moves))
    while True:
        shorter = np.minimum(steps, 1 + steps[maze.moves].min(1))
        if np.array_equal(shorter, steps):
            return steps
        steps = shorter


def evaluate(agent: Agent, args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes that training never saw, greedily; write `evaluation.json` and, if asked, a video.

    `optimal` is the mean return of shortest paths from the same starts, `solved` the share of the goals that were reached.
    """
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    episodes = play(agent, args, seeds, "greedy")
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    first = np.array([episode["states"][0] for episode in episodes])
    shortest = fewest_steps(maze(ROOM_SIZES[args.env_id]))[4 * first[:, 0] + first[:, 1], first[:, 2]]
    optimal = float((1 - 0.9 * (shortest / MAX_STEPS)).mean())
    solved = float(np.mean([episode["terminated"] for episode in episodes]))
    if args.capture_video:
        record_video(agent, args, run_dir)
    evaluation = {"env_id": args.env_id, "mode": "greedy", **summary(returns), "optimal": optimal, "solved": solved}
    write_json(run_dir / "evaluation.json", {**evaluation, "returns": returns, "seeds": seeds})
    return evaluation


def check_video(env_id: str) -> None:
    """Raise UsageError where the environment cannot be drawn, before hours are spent on training."""
    try:
        env = make_env(env_id, "rgb_array")
        env.reset(seed=0)
        env.render()
        env.close()
    except Exception as error:  # each renderer has its own
        raise UsageError(f"--capture-video: cannot draw {env_id} here: {first_line(error)}") from None


@torch.no_grad()
def record_video(agent: Agent, args: Args, run_dir: Path) -> None:
    """Play the first evaluation episode once more and write it into `videos/`."""
    env = gym.wrappers.RecordVideo(
        make_env(args.env_id, "rgb_array", args.frame_side), str(run_dir / "videos"), lambda episode: True
    )
    obs, _ = env.reset(seed=episode_seed(args.seed, EVALUATION_STREAM, 0))
    ended = False
    while not ended:
        logits, _ = agent(torch.from_numpy(obs[None]).to(next(agent.parameters()).device))
        obs, _, terminated, truncated, _ = env.step(int(logits.argmax()))
        ended = terminated or truncated
    env.close()


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(agent: Agent, args: Args, run_dir: Path, global_step: int) -> None:
    """Write `--save-demos` episodes into `demos/` or `demos_noise_.../`, with the frames of the task, (T + 1, 64, 64, 3) uint8."""
    seeds = [episode_seed(args.seed, DEMONSTRATION_STREAM, i) for i in range(args.save_demos)]
    pictures = painter(ROOM_SIZES[args.env_id], 64)
    episodes = (
        {"observations": pictures.draw(4 * episode["states"][:, 0] + episode["states"][:, 1], episode["states"][:, 2])}
        | episode
        for episode in play(agent, args, seeds, args.demo_mode, args.demo_noise)
    )
    about = {"env_id": args.env_id, "player": args.exp_name, "mode": args.demo_mode, "noise": args.demo_noise}
    about |= {"global_step": global_step}
    folder = f"demos_noise_{args.demo_noise:g}" if args.demo_noise else "demos"
    write_demonstrations(run_dir / folder, episodes, about)


def write_demonstrations(folder: Path, episodes: Iterable[dict[str, np.ndarray]], about: dict) -> None:
    """Write episodes as `episode_*.npz`, and a manifest with `about` and their checksums (SHA-256).

    Each file has observations (T + 1, ...), actions (T, ...), rewards (T,), terminated, truncated, seed, and t_ns (T,),
    the time of each action in nanoseconds, simulated where the environment says how many frames a second has; here also
    states (T + 1, 3) and rooms (T + 1,), and the files are compressed.
    """
    folder.mkdir(exist_ok=True)
    step_ns = round(1e9 / make_env(about["env_id"]).metadata.get("render_fps", 1))
    manifest = {"version": 1, **about, "files": {}}
    for i, episode in enumerate(episodes):
        content = io.BytesIO()
        np.savez_compressed(content, **episode, t_ns=np.arange(len(episode["rewards"]), dtype=np.int64) * step_ns)
        write_whole(folder / f"episode_{i:05d}.npz", content.getvalue())
        manifest["files"][f"episode_{i:05d}.npz"] = hashlib.sha256(content.getvalue()).hexdigest()
    write_json(folder / "manifest.json", manifest)


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
    window = min(500, max(1, len(returns)))
    if len(returns):
        means = np.convolve(returns, np.ones(window) / window, "valid")
        axes.plot(steps[window - 1 :], means, color="tab:blue", label=f"mean of {window} episodes (sampled)")
    label = f"evaluation (greedy, {args.eval_episodes} episodes): {evaluation['mean']:.3f}"
    axes.axhline(evaluation["mean"], color="tab:orange", linestyle="--", label=label)
    label = f"shortest paths from the same starts: {evaluation['optimal']:.3f}"
    axes.axhline(evaluation["optimal"], color="black", linestyle=":", label=label)
    axes.set_title(f"{args.env_id}, PPO, seed {args.seed}")
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
    if args.capture_video:
        check_video(args.env_id)
    run_dir, checkpoint = open_run_dir(args)
    last_iteration = min(args.num_iterations, math.ceil(args.stop_at / args.batch_size))
    reached = 0 if checkpoint is None else checkpoint["iteration"]
    is_behind = reached <= last_iteration  # or the demonstrations would be another player's
    require(is_behind, "--stop-at", args.stop_at, f"{run_dir} is at step {reached * args.batch_size} already")
    if is_done(run_dir, args, last_iteration * args.batch_size):
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
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    stop = StopSignal()

    collector = Collector(args, device)
    bf16 = args.bf16 and has_bf16(device)
    if args.bf16 and not bf16:
        print("--bf16: no bfloat16 instructions here, goes on in float32", file=sys.stderr)
    agent = Agent(args.frame_side, 3, args.channels, args.hidden_size, bf16).to(device)
    agent.obs_mean.copy_(mean_frame(args))
    update = Update(agent, args)
    iteration, training_seconds, offsets = 0, 0.0, {"episodes": 0, "updates": 0}
    if checkpoint is not None:
        iteration, training_seconds = checkpoint["iteration"], checkpoint["training_seconds"]
        offsets = checkpoint["offsets"]
        agent.load_state_dict(checkpoint["agent"])
        update.optimizer.load_state_dict(checkpoint["optimizer"])
        collector.load_state_dict(checkpoint["collector"])
        torch.set_rng_state(checkpoint["torch_rng"])
    kind = "compiled" if update.is_compiled else "plain"
    arithmetic = f"{kind}, {'bfloat16' if bf16 else 'float32'} on {device.type}"
    if checkpoint and checkpoint["arithmetic"] != arithmetic:
        print(f"--resume: was {checkpoint['arithmetic']}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    global_step = iteration * args.batch_size
    episodes_csv = CsvLog(run_dir / "episodes.csv", offsets["episodes"])
    updates_csv = CsvLog(run_dir / "updates.csv", offsets["updates"])
    forget_end(run_dir, iteration < last_iteration)
    writer = SummaryWriter(str(run_dir), purge_step=global_step + 1)
    progress = tqdm(total=last_iteration * args.batch_size, initial=global_step, unit="step", disable=None)
    last_time = time.perf_counter()

    while iteration < last_iteration:
        iteration += 1
        remaining = 1.0 - (iteration - 1) / args.num_iterations if args.anneal_lr else 1.0
        update.anneal(remaining)

        rollout = collector.collect(agent)
        metrics = update_agent(update, make_batch(rollout, args, device), args)
        metrics = {"charts/learning_rate": remaining * args.learning_rate, **metrics}

        for step, episodic_return, length in rollout.episodes:
            row = {"global_step": global_step + step, "episodic_return": episodic_return, "episodic_length": length}
            episodes_csv.write(row)
        global_step += args.batch_size
        _, mean_return, mean_length = np.mean(rollout.episodes, 0).tolist() if rollout.episodes else (math.nan,) * 3
        metrics |= {"charts/episodic_return": mean_return, "charts/episodic_length": mean_length}
        progress.set_postfix_str(f"return {mean_return:.3f}", refresh=False)
        progress.update(args.batch_size)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        updates_csv.write({"global_step": global_step, **metrics})
        add_scalars(writer, {**metrics, "charts/SPS": global_step / training_seconds}, global_step)
        if not all(parameter.isfinite().all() for parameter in agent.parameters()):
            raise RunError(f"step {global_step}: the agent's parameters are no longer finite (last losses: {metrics})")

        crossed = global_step // args.checkpoint_interval > (global_step - args.batch_size) // args.checkpoint_interval
        if crossed or stop.received or iteration == last_iteration:
            state = {
                "args": arguments(args),
                "arithmetic": arithmetic,
                "iteration": iteration,
                "training_seconds": training_seconds,
                "offsets": {"episodes": episodes_csv.sync(), "updates": updates_csv.sync()},
                "agent": agent.state_dict(),
                "optimizer": update.optimizer.state_dict(),
                "collector": collector.state_dict(),
                "torch_rng": torch.get_rng_state(),
            }
            writer.flush()
            save_checkpoint(run_dir, state)
        if stop.received and iteration < last_iteration:
            progress.close()
            writer.close()
            print(f"stopped by signal {stop.received} at step {global_step}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    finish_run(agent, args, run_dir, global_step, training_seconds, writer)
    writer.close()
    return 0


def finish_run(agent: Agent, args: Args, run_dir: Path, global_step: int, seconds: float, writer) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last."""
    evaluation = evaluate(agent, args, run_dir)
    for name in ("mean", "std", "min", "max"):
        writer.add_scalar(f"eval/episodic_return_{name}", evaluation[name], global_step)
    if args.save_model:
        model = safetensors.torch.save(agent.state_dict(), {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", model)
    if args.save_demos:
        save_demonstrations(agent, args, run_dir, global_step)
    plot_learning_curve(run_dir, args, evaluation)
    versions = {module.__name__: module.__version__ for module in (gym, minigrid, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": global_step,
        "complete": global_step == args.num_iterations * args.batch_size,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training": {"mode": "sampled", **summary(read_episodes(run_dir)[-500:, 1])},
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
