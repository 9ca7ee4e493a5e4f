"""DQN on the Apple game: the reinforcement learning teacher of the hybrid agent (thesis section 2.4.1).

    python cleanrl_thesis/dqn_apple.py --compile --save-model --run-dir runs/apple_teacher    # the teacher, for distill_hybrid.py
    python cleanrl_thesis/dqn_apple.py --env-id CartPole-v1 --total-timesteps 200000

Tasks: the game, which is built in (`gymnasium.make("cleanrl_thesis.dqn_apple:AppleGame-v0")`), and any Gymnasium
environment with flat `Box` observations and `Discrete` actions. `--run-dir DIR --resume` can be sent again after every
crash: on the same machine the run ends with the same bytes.

| setting | value | source |
|---|---|---|
| frames, replay buffer, ε | 8,000,000; 200,000; 1.0 → 0.1 | section 2.4.1 |
| batch, learning rate, target update, ε's share of the frames | 32, 5e-4, every 500 frames, 10% | OpenAI Baselines' defaults |
| learning rate annealed to 0 | on | ours; Baselines' is constant, with which the greedy policy jitters beside apples |
| Huber loss, gradient norm 10, double, dueling, start of learning | on, on, on, on, 1,000 frames | OpenAI Baselines' defaults |
| γ | 0.99 | ours; Baselines' plain learner has 1.0, with which a game without end has no finite values |
| updates | one every 4 frames | ours; Baselines' plain learner: one every frame; usual for Atari: every 4 |
| network | 64-64 with ReLU, dueling heads without a hidden layer | ours; Baselines has tanh, and heads of 256 |

Frames are game frames everywhere in chapter 2: with `--frame-skip 4` the agent acts once in four of them. The end of the
30 s is a time-out, not an end: the replay buffer keeps the real next observation, and its value is bootstrapped from.
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "gymnasium>=1.2",
#     "matplotlib>=3.9",
#     "numpy>=2.0",
#     "pillow>=10.1",
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
import fcntl
import functools
import hashlib
import importlib.util
import io
import json
import math
import os
import platform
import random
import re
import resource
import shutil
import signal
import sys
import time
import zipfile
from collections import deque
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import NamedTuple

import gymnasium as gym
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import safetensors.torch
import torch
import torch.nn as nn
import torch.nn.functional as F
import tyro
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    exp_name: str = "dqn_apple"
    """the name of this experiment"""
    seed: int = 1
    """seed of the experiment"""
    torch_deterministic: bool = True
    """sets `torch.backends.cudnn.deterministic`"""
    cuda: bool = False
    """train on the GPU where there is one; off by default, for small networks spend their time in launching kernels"""
    num_threads: int = 1
    """threads of torch; one is fastest for these networks and lets a sweep fill the machine with runs"""
    compile: bool = False
    """run each update step as one compiled graph (needs a C++ compiler; compiling takes seconds, once)"""
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
    """episodes of the trained agent to write into `demos/`, one .npz each and a manifest"""
    eval_episodes: int = 400
    """episodes of the evaluation at the end, with the greedy policy (section 2.4.1)"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 100_000
    """frames between checkpoints; the replay file has room for two intervals beyond `--buffer-size`"""
    stop_at: int | None = None
    """end at this frame of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: str = "AppleGame-v0"
    """the environment: AppleGame-v0 or a Gymnasium id with flat Box observations and Discrete actions"""
    total_timesteps: int = 8_000_000
    """game frames (section 2.4.1)"""
    num_envs: int = 1
    """environments stepped in turn (Baselines: 1)"""
    frame_skip: int = 1
    """frames for which an action is repeated (ours)"""
    learning_rate: float = 5e-4
    """Adam's learning rate (Baselines)"""
    anneal_lr: bool = True
    """anneal the learning rate linearly to 0; off: constant (Baselines)"""
    hidden_size: int = 64
    """units in each of the two hidden layers (Baselines)"""
    buffer_size: int = 200_000
    """transitions in the replay buffer (section 2.4.1)"""
    gamma: float = 0.99
    """discount factor γ per action (ours; Baselines' plain learner: 1.0)"""
    target_network_frequency: int = 500
    """frames between updates of the target network (Baselines)"""
    batch_size: int = 32
    """transitions per update (Baselines)"""
    start_e: float = 1.0
    """ε at the beginning (section 2.4.1)"""
    end_e: float = 0.1
    """ε in the end (section 2.4.1)"""
    exploration_fraction: float = 0.1
    """share of the frames in which ε falls linearly (Baselines)"""
    learning_starts: int = 1_000
    """frame of the first update (Baselines)"""
    train_frequency: int = 4
    """frames per update (ours; Baselines' plain learner: 1)"""
    max_grad_norm: float = 10.0
    """bound on the norm of the gradient, of all parameters together; inf for none (Baselines: the same, of each variable)"""
    double: bool = True
    """double DQN: the online network chooses the next action, the target network values it (Baselines)"""
    dueling: bool = True
    """dueling heads: Q = V + A − mean A (Baselines)"""
    n_step: int = 1
    """rewards summed before the value of the next state (Baselines: 1)"""

    # to be filled in runtime
    num_iterations: tyro.conf.Suppress[int] = 0
    """total_timesteps // (num_envs · frame_skip), times that every environment is stepped"""


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
    counts = (
        "num_envs frame_skip batch_size buffer_size eval_episodes checkpoint_interval stop_at n_step hidden_size "
        "train_frequency target_network_frequency"
    )
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("max_grad_norm", lambda x: x > 0, "must be greater than 0"),
        ("gamma start_e end_e exploration_fraction", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos learning_starts", lambda x: x >= 0, "must be at least 0"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(
        not args.env_id.startswith("ALE/"),
        "--env-id",
        args.env_id,
        "is for dqn_gopher.py, this one has no convolutions",
    )
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    frames = args.num_envs * args.frame_skip
    args.num_iterations = args.total_timesteps // frames
    allowed = f"must be at least one step of every environment, {frames} frames"
    require(args.num_iterations >= 1, "--total-timesteps", args.total_timesteps, allowed)
    learns = args.learning_starts < args.total_timesteps
    allowed = f"must be less than --total-timesteps, {args.total_timesteps}"
    require(learns, "--learning-starts", args.learning_starts, allowed)
    fits = args.batch_size <= args.buffer_size
    require(fits, "--batch-size", args.batch_size, f"must be at most --buffer-size, {args.buffer_size}")
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UsageError("--track: needs Weights and Biases: pip install wandb")
    if args.capture_video and importlib.util.find_spec("moviepy") is None:
        raise UsageError("--capture-video: needs moviepy: pip install moviepy")
    return args


# ---------------------------------------------------------------------------------------------------------------------
# The Apple game
# ---------------------------------------------------------------------------------------------------------------------
FPS, EPISODE_FRAMES = 60, 1_800  # an episode is 30 s
SPEED = np.float32(0.00825)  # sides of the plane, per frame and axis; chosen by hand, see benchmark/apple_players.py
REACH = np.float32(0.06)  # distance at which an apple is taken, in sides of the plane
LIFETIME = 90  # frames until an apple that nobody takes is gone
MOVES = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)], np.float32).T  # (2, 9); action 4 stays


def mixed(bits: np.ndarray) -> np.ndarray:
    """Scramble 64-bit numbers (the output function of SplitMix64), so that neighbours have nothing in common."""
    bits = (bits ^ (bits >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    bits = (bits ^ (bits >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return bits ^ (bits >> np.uint64(31))


class AppleGames:
    """N games side by side, from which the single and the vectorised environment are made: so they agree bit for bit.

    An avatar on the unit square, x to the right and y down, takes apples for 30 s (section 2.4.1). A game's apples
    follow from its key, 64 random bits, and from how many it has had.
    """

    def __init__(self, num_games: int):
        self.keys, self.draws = (np.zeros(num_games, np.uint64) for _ in range(2))
        self.avatars, self.apples = (np.zeros((2, num_games), np.float32) for _ in range(2))
        self.frames, self.ages, self.scores = (np.zeros(num_games, np.int32) for _ in range(3))

    def seed(self, game: int, rng: np.random.Generator) -> None:
        """Give a game a new key."""
        self.keys[game], self.draws[game] = rng.integers(2**64, dtype=np.uint64), 0

    def begin(self, games: np.ndarray) -> None:
        """Start an episode in the games of the given indices: the avatar in the middle, an apple somewhere."""
        self.avatars[:, games] = 0.5
        self.frames[games] = self.scores[games] = 0
        self.place_apples(games)

    def place_apples(self, games: np.ndarray) -> None:
        """Put a new apple somewhere on the plane in the games of the given indices."""
        self.draws[games] += np.uint64(1)
        bits = mixed(self.keys[games] + self.draws[games] * np.uint64(0x9E3779B97F4A7C15))
        self.apples[0, games] = (bits >> np.uint64(40)) * 2.0**-24
        self.apples[1, games] = (bits >> np.uint64(16) & np.uint64(0xFFFFFF)) * 2.0**-24
        self.ages[games] = 0

    def step(self, actions: np.ndarray) -> np.ndarray:
        """Move each avatar for one frame by its action (N,); return which of them take an apple, (N,) bool."""
        self.avatars += (SPEED * MOVES)[:, actions]
        np.minimum(np.maximum(self.avatars, 0, out=self.avatars), 1, out=self.avatars)
        self.frames += 1
        self.ages += 1
        x, y = self.apples - self.avatars
        taken = x * x + y * y <= REACH * REACH
        self.scores += taken
        over = (taken | (self.ages == LIFETIME)).nonzero()[0]
        if len(over):
            self.place_apples(over)
        return taken

    def observe(self) -> np.ndarray:
        """Avatar, apple, and the way from the one to the other, (N, 6) float32."""
        return np.concatenate([self.avatars, self.apples, self.apples - self.avatars]).T.copy()

    def draw(self, game: int, side: int = 480) -> np.ndarray:
        """Picture of a game for people, (side + bar, side, 3) uint8: score and time left above the plane."""
        bar, fine = side // 10, 2 * side  # drawn at twice the size, for smooth edges
        diameter = fine * float(REACH / (1 + REACH))  # the discs touch when the apple is taken, and stay in the picture
        image = PIL.Image.new("RGB", (fine, fine + 2 * bar), (238, 243, 232))
        pen = PIL.ImageDraw.Draw(image)
        left = 1 - self.frames[game] / EPISODE_FRAMES
        pen.rectangle((0, 0, fine, 2 * bar - 1), fill=(40, 48, 56))
        pen.rectangle((0, 2 * bar - 12, fine * left, 2 * bar - 1), fill=(240, 180, 60))
        font = PIL.ImageFont.load_default(1.1 * bar)
        pen.text((0.4 * bar, 0.9 * bar), f"apples {self.scores[game]}", (255, 255, 255), font, "lm")
        pen.text((fine - 0.4 * bar, 0.9 * bar), f"{left * EPISODE_FRAMES / FPS:.1f} s", (255, 255, 255), font, "rm")
        corner = np.array([0, 2 * bar]) + diameter / 2
        (a, b), (x, y) = (corner + point[:, game] * (fine - diameter) for point in (self.apples, self.avatars))
        pen.line((a, b - 0.4 * diameter, a + 0.2 * diameter, b - 0.8 * diameter), (110, 74, 40), fine // 100)
        for middle_x, middle_y, colour in ((a, b, (214, 48, 49)), (x, y, (45, 98, 198))):
            low, high = -diameter / 2, diameter / 2
            pen.ellipse((middle_x + low, middle_y + low, middle_x + high, middle_y + high), colour)
        return np.asarray(image.reduce(2))


APPLE_OBSERVATIONS = gym.spaces.Box(np.repeat([0, 0, -1], 2).astype(np.float32), np.ones(6, np.float32))
APPLE_ACTIONS = gym.spaces.Discrete(9)


class AppleGameEnv(gym.Env):
    """The Apple game for one player. The end after 30 s is a truncation."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode
        self.observation_space, self.action_space = copy.deepcopy((APPLE_OBSERVATIONS, APPLE_ACTIONS))
        self.games, self.game = AppleGames(1), np.zeros(1, np.intp)
        self.games.seed(0, self.np_random)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        if seed is not None:
            self.games.seed(0, self.np_random)
        self.games.begin(self.game)
        return self.games.observe()[0], {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        taken = self.games.step(np.reshape(action, 1))
        return self.games.observe()[0], float(taken[0]), False, bool(self.games.frames[0] == EPISODE_FRAMES), {}

    def render(self) -> np.ndarray:
        return self.games.draw(0)


class AppleGameVectorEnv(gym.vector.VectorEnv):
    """The Apple game for N players; a game that ends begins anew within the same step."""

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": FPS,
        "autoreset_mode": gym.vector.AutoresetMode.SAME_STEP,
    }

    def __init__(self, num_envs: int = 1, render_mode: str | None = None):
        self.num_envs, self.render_mode = num_envs, render_mode
        self.single_observation_space, self.single_action_space = copy.deepcopy((APPLE_OBSERVATIONS, APPLE_ACTIONS))
        self.observation_space = gym.vector.utils.batch_space(APPLE_OBSERVATIONS, num_envs)
        self.action_space = gym.vector.utils.batch_space(APPLE_ACTIONS, num_envs)
        self.games, self.all_games = AppleGames(num_envs), np.arange(num_envs)
        self.seed_games(np.random.SeedSequence().generate_state(num_envs).tolist())

    def seed_games(self, seeds: list[int]) -> None:
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} games")
        for game, seed in enumerate(seeds):
            self.games.seed(game, gym.utils.seeding.np_random(seed)[0])

    def reset(self, *, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin every game anew; a list of seeds gives each game what `AppleGameEnv.reset(seed=)` gives it."""
        if seed is not None:
            is_number = isinstance(seed, (int, np.integer))
            seeds = np.random.SeedSequence(int(seed)).generate_state(self.num_envs).tolist() if is_number else seed
            self.seed_games(seeds)
        self.games.begin(self.all_games)
        return self.games.observe(), {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        taken = self.games.step(actions)
        truncated = self.games.frames == EPISODE_FRAMES
        infos = {}
        if truncated.any():
            infos = {"final_obs": self.games.observe(), "_final_obs": truncated}
            self.games.begin(truncated.nonzero()[0])
        return self.games.observe(), taken.astype(np.float64), np.zeros(self.num_envs, bool), truncated, infos

    def render(self) -> tuple[np.ndarray, ...]:
        return tuple(self.games.draw(game) for game in self.all_games)


if "AppleGame-v0" not in gym.registry:
    gym.register("AppleGame-v0", AppleGameEnv, vector_entry_point=AppleGameVectorEnv)


def make_env(env_id: str, render_mode: str | None = None) -> gym.Env:
    """Make an environment with flat `Box` observations and `Discrete` actions. Raises UsageError."""
    drawn = {} if render_mode is None else {"render_mode": render_mode}  # not every environment knows the word
    try:
        env = gym.make(env_id, disable_env_checker=True, **drawn)
    except (gym.error.Error, AttributeError, ImportError, OSError, TypeError, ValueError) as error:
        raise UsageError(f"--env-id {env_id}: {first_line(error)}") from None
    space, actions = env.observation_space, env.action_space
    is_flat = isinstance(space, gym.spaces.Box) and len(space.shape) == 1
    require(is_flat, "--env-id", env_id, f"needs flat Box observations, this one has {space}")
    is_discrete = isinstance(actions, gym.spaces.Discrete) and actions.start == 0
    require(is_discrete, "--env-id", env_id, f"needs Discrete actions from 0, this one has {actions}")
    return env


# ---------------------------------------------------------------------------------------------------------------------
# Network
# ---------------------------------------------------------------------------------------------------------------------
class QNetwork(nn.Module):
    """Q(s, ·) of each action: a trunk of two layers, then one linear head, or with `dueling` V(s) + A(s, ·) − mean A."""

    def __init__(self, obs_dim: int, num_actions: int, hidden_size: int, dueling: bool):
        super().__init__()
        first, second = nn.Linear(obs_dim, hidden_size), nn.Linear(hidden_size, hidden_size)
        self.trunk = nn.Sequential(first, nn.ReLU(), second, nn.ReLU())
        self.advantage = nn.Linear(hidden_size, num_actions)
        self.value = nn.Linear(hidden_size, 1) if dueling else None

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (B, O) -> action values (B, A)."""
        features = self.trunk(obs)
        advantage = self.advantage(features)
        if self.value is None:
            return advantage
        return self.value(features) + advantage - advantage.mean(1, keepdim=True)


def numpy_greedy(agent: QNetwork):
    """argmax Q as a numpy function, (N, O) -> (N,): without torch's overhead of 100 µs for one observation.

    On the CPU it shares the agent's memory; on a GPU it is a copy, to be made anew after each update. It needs no V(s).
    """
    linears = [agent.trunk[0], agent.trunk[2], agent.advantage]
    layers = [[tensor.detach().cpu().numpy() for tensor in (linear.weight.T, linear.bias)] for linear in linears]
    *hidden, (output_weight, output_bias) = layers

    def greedy(x: np.ndarray) -> np.ndarray:
        for weight, bias in hidden:
            x = x.dot(weight)
            x += bias
            np.maximum(x, 0, out=x)
        x = x.dot(output_weight)
        x += output_bias
        return x.argmax(1)

    return greedy


# ---------------------------------------------------------------------------------------------------------------------
# Playing, and the replay buffer
# ---------------------------------------------------------------------------------------------------------------------
EVALUATION_STREAM, DEMONSTRATION_STREAM = 1_000_000, 1_000_001


@functools.lru_cache
def episode_seeds(seed: int, stream: int, block: int) -> list[int]:
    """Seeds of episodes 256 · block and on; a SeedSequence for each would take longer than the environment's reset."""
    return np.random.SeedSequence([seed, stream, block]).generate_state(256).tolist()


def episode_seed(seed: int, stream: int, episode: int) -> int:
    """Seed of an episode: sub-environment `stream` of run `seed`, or one of the streams that are not trained on."""
    return episode_seeds(seed, stream, episode // 256)[episode % 256]


class Episode:
    """An environment and the episode that it is in.

    Each reset has a seed of its own, so the episode's number and actions determine the environment's state: a
    checkpoint keeps those two, and `replay` plays them again. Holds for every environment whose randomness comes from
    `reset(seed=)`.
    """

    def __init__(self, env: gym.Env, seed: int, stream: int, frame_skip: int):
        self.env, self.seed, self.stream, self.frame_skip = env, seed, stream, frame_skip
        self.number = -1

    def start(self) -> np.ndarray:
        """Begin the next episode and return its first observation (O,)."""
        self.number += 1
        self.actions: list[int] = []
        self.episodic_return, self.frames = 0.0, 0
        return self.env.reset(seed=episode_seed(self.seed, self.stream, self.number))[0]

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool]:
        """Apply an action for `frame_skip` frames; return observation (O,), sum of rewards, terminated, truncated."""
        self.actions.append(action)
        total = 0.0
        for _ in range(self.frame_skip):
            obs, reward, terminated, truncated, _ = self.env.step(action)
            total += float(reward)
            self.frames += 1
            if terminated or truncated:
                break
        self.episodic_return += total
        return obs, total, terminated, truncated

    def replay(self, number: int, actions: list[int]) -> np.ndarray:
        """Play episode `number` again up to the last of `actions` and return the observation (O,) there."""
        self.number = number - 1
        obs = self.start()
        for action in actions:
            obs, _, _, _ = self.step(action)
        return obs


def row_bytes(obs_dim: int) -> int:
    """Bytes of a transition in the replay buffer: two observations (O,), action, return and discount as float32."""
    return 4 * (2 * obs_dim + 3)


class ReplayBuffer:
    """The last `capacity` transitions, in a file that is written in place: a checkpoint keeps only how many there were.

    A row is (obs (O,), action, return of n steps, discount of what follows, next obs (O,)). The ring has `spare` more
    rows, so that what a checkpoint counts is still there after `spare` further transitions.
    """

    def __init__(self, path: Path, capacity: int, spare: int, obs_dim: int, added: int = 0):
        """Go on in the file after `added` transitions, or begin it. Raises RunError where it is not the whole file."""
        self.capacity, self.slots, self.added = capacity, capacity + spare, added
        shape, size = (self.slots, row_bytes(obs_dim) // 4), self.slots * row_bytes(obs_dim)
        if added and not (path.exists() and path.stat().st_size == size):
            raise RunError(f"{path}: not the replay buffer of the last checkpoint; the run cannot be resumed")
        path.touch()
        with open(path, "r+b") as file:  # not "a": file systems without fallocate of their own refuse it then
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is an error here, not a signal later
            file.truncate(size)
        self.rows = np.memmap(path, np.float32, "r+", shape=shape)
        self.array = np.asarray(self.rows)  # the same memory, without memmap's overhead on each access

    def add(self, obs: np.ndarray, action: int, n_step_return: float, discount: float, next_obs: np.ndarray) -> None:
        row, obs_dim = self.array[self.added % self.slots], len(obs)
        row[:obs_dim], row[obs_dim + 3 :] = obs, next_obs
        row[obs_dim : obs_dim + 3] = action, n_step_return, discount
        self.added += 1

    def sample(self, batch_size: int, rng: np.random.Generator) -> torch.Tensor:
        """Uniformly drawn rows, (M, 2 O + 3)."""
        oldest = max(0, self.added - self.capacity)
        return torch.from_numpy(self.array[rng.integers(oldest, self.added, batch_size) % self.slots])

    def sync(self) -> int:
        """Bring everything onto the disk; return how many transitions there were."""
        self.rows.flush()
        return self.added


class Player:
    """Plays one environment ε-greedily and turns its steps into transitions of n steps."""

    def __init__(self, episode: Episode, args: Args):
        self.episode, self.gamma, self.n_step = episode, args.gamma, args.n_step
        self.obs: np.ndarray | None = None
        self.window: deque[tuple[np.ndarray, int, float]] = deque()  # steps that wait for their n-th reward

    def start(self) -> None:
        """Begin the next episode."""
        self.obs = self.episode.start()

    def step(self, action: int, buffer: ReplayBuffer) -> tuple[float, int] | None:
        """Take an action; return (return, frames) of the episode if it ended, and then begin the next."""
        episode = self.episode
        obs, reward, terminated, truncated = episode.step(action)
        self.window.append((self.obs, action, reward))
        self.obs = obs
        ended = terminated or truncated
        while self.window and (ended or len(self.window) == self.n_step):
            self.add_oldest(buffer, terminated)
        if not ended:
            return None
        result = episode.episodic_return, episode.frames
        self.start()
        return result

    def add_oldest(self, buffer: ReplayBuffer, terminated: bool) -> None:
        """Move the oldest waiting step into the buffer. A time-out bootstraps from the next value, a termination does not."""
        total, discount = 0.0, 1.0
        for _, _, reward in self.window:
            total += discount * reward
            discount *= self.gamma
        obs, action, _ = self.window.popleft()
        buffer.add(obs, action, total, 0.0 if terminated else discount, self.obs)

    def state_dict(self) -> dict:
        """All that `load_state_dict` restores, as tensors and plain values."""
        actions = torch.tensor(self.episode.actions, dtype=torch.int64)
        waiting = len(self.window)
        return {"number": self.episode.number, "actions": actions, "obs": torch.tensor(self.obs), "waiting": waiting}

    def load_state_dict(self, state: dict) -> bool:
        """Play the saved episode again; return whether that gave the saved observation bit for bit."""
        actions, episode = state["actions"].tolist(), self.episode
        first = len(actions) - state["waiting"]
        self.obs = episode.replay(state["number"], actions[:first])
        for action in actions[first:]:
            obs, reward, _, _ = episode.step(action)
            self.window.append((self.obs, action, reward))
            self.obs = obs
        return np.array_equal(self.obs, state["obs"].numpy())


def linear_schedule(start: float, end: float, duration: float, t: int) -> float:
    """From `start` to `end` over `duration`, then `end`."""
    return start + (end - start) * t / duration if t < duration else end


# ---------------------------------------------------------------------------------------------------------------------
# The algorithm
# ---------------------------------------------------------------------------------------------------------------------
class Minibatch(NamedTuple):
    """M transitions of n steps."""

    obs: torch.Tensor  # (M, O)
    actions: torch.Tensor  # (M,) int64
    returns: torch.Tensor  # (M,), discounted sum of the n rewards
    discounts: torch.Tensor  # (M,), γⁿ, or 0 where the episode ended; fewer steps than n before a time-out
    next_obs: torch.Tensor  # (M, O), as many steps later

    @classmethod
    def unpack(cls, rows: torch.Tensor) -> "Minibatch":
        """The transitions of the replay buffer's rows (M, 2 O + 3), as views but for the actions."""
        obs_dim = (rows.shape[1] - 3) // 2
        obs, actions, returns, discounts, next_obs = rows.split([obs_dim, 1, 1, 1, obs_dim], 1)
        return cls(obs, actions.squeeze(1).long(), returns.squeeze(1), discounts.squeeze(1), next_obs)


def td_target(minibatch: Minibatch, target_q: torch.Tensor, online_q: torch.Tensor | None) -> torch.Tensor:
    """R + γⁿ Q_target(s', a'), (M,): a' is the best for the online network if that is given (double DQN), else its own.

    target_q and online_q (M, A) are the two networks' values of `next_obs`.
    """
    if online_q is None:
        next_value = target_q.amax(1)
    else:
        next_value = target_q.gather(1, online_q.argmax(1, keepdim=True)).squeeze(1)
    return minibatch.returns + minibatch.discounts * next_value


def dqn_loss(
    q: torch.Tensor, minibatch: Minibatch, target: torch.Tensor
) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
    """Huber loss of the values q (M, A) against the target (M,); and as scalars the TD error's size and the mean Q."""
    value = q.gather(1, minibatch.actions[:, None]).squeeze(1)
    return F.smooth_l1_loss(value, target), ((value - target).abs().mean().detach(), value.mean().detach())


def views(vector: torch.Tensor, shapes: list[torch.Size]) -> list[torch.Tensor]:
    """Cut a vector into tensors of the given shapes, without a copy."""
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes)]


class FlatAdam:
    """Adam over one vector, of which the agent's parameters become views; the target network's are of `target`.

    One vector is clipped and stepped faster than a dozen tensors, and copied at once into the target network.
    """

    def __init__(self, agent: QNetwork, target_network: QNetwork, learning_rate: float):
        self.initial_rate = learning_rate
        self.parameters = list(agent.parameters())
        self.shapes = [parameter.shape for parameter in self.parameters]
        self.vector = torch.cat([parameter.detach().reshape(-1) for parameter in self.parameters])
        self.target = self.vector.clone()
        self.gradient, self.mean, self.square = (torch.zeros_like(self.vector) for _ in range(3))
        self.step = torch.zeros((), device=self.vector.device)
        self.rate = torch.full_like(self.step, learning_rate)
        for parameter, value, gradient in zip(
            self.parameters, views(self.vector, self.shapes), views(self.gradient, self.shapes)
        ):
            parameter.data, parameter.grad = value, gradient
        for parameter, value in zip(target_network.parameters(), views(self.target, self.shapes)):
            parameter.data = value

    def anneal(self, remaining: float) -> None:
        """Set the learning rate to a share of the initial one."""
        self.rate.fill_(self.initial_rate * remaining)

    def state_dict(self) -> dict[str, torch.Tensor]:
        names = ("vector", "target", "mean", "square", "step")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        for name, tensor in self.state_dict().items():
            tensor.copy_(state[name])


def adam_step(vector, mean, square, step, rates, gradient, max_grad_norm: float, eps: float) -> None:
    """Clip the gradient's norm and take one step of Adam; changes the first four in place.

    All tensors are (P,), but `step`, a scalar that counts the steps, and `rates`, (P,) or a scalar.
    """
    gradient = gradient * (max_grad_norm / (gradient.norm() + 1e-6)).clamp(max=1.0)
    step.add_(1)
    mean.lerp_(gradient, 1 - 0.9)
    square.mul_(0.999).addcmul_(gradient, gradient, value=1 - 0.999)
    denominator = (square / (1 - 0.999**step)).sqrt_().add_(eps)
    vector.sub_(rates * (mean / (1 - 0.9**step)) / denominator)


class PlainUpdate:
    """One step of Adam on one minibatch."""

    def __init__(self, agent: QNetwork, target_network: QNetwork, optimizer: FlatAdam, args: Args):
        self.agent, self.target_network, self.optimizer = agent, target_network, optimizer
        self.double, self.max_grad_norm = args.double, args.max_grad_norm

    def __call__(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Change the agent and the optimiser by the replay buffer's rows; return the TD error's size and the mean Q."""
        minibatch = Minibatch.unpack(rows)
        with torch.no_grad():
            online_q = self.agent(minibatch.next_obs) if self.double else None
            target = td_target(minibatch, self.target_network(minibatch.next_obs), online_q)
        loss, parts = dqn_loss(self.agent(minibatch.obs), minibatch, target)
        adam = self.optimizer
        adam.gradient.zero_()
        loss.backward()
        with torch.no_grad():
            self.adam_step(adam.vector, adam.mean, adam.square, adam.step, adam.rate, adam.gradient)
        return parts

    def adam_step(self, vector, mean, square, step, rate, gradient) -> None:
        adam_step(vector, mean, square, step, rate, gradient, self.max_grad_norm, 1e-8)


class CompiledUpdate(PlainUpdate):
    """The same step, gradient included, as one compiled graph."""

    def __init__(self, agent: QNetwork, target_network: QNetwork, optimizer: FlatAdam, args: Args):
        super().__init__(agent, target_network, optimizer, args)
        self.names = [name for name, _ in agent.named_parameters()]
        self.variables = (optimizer.vector, optimizer.mean, optimizer.square, optimizer.step, optimizer.rate)
        self.compiled = torch.compile(self.step, options={"cpp_wrapper": True})  # kernels called from C++: saves 25 µs
        example = optimizer.vector.new_zeros(args.batch_size, 2 * agent.trunk[0].in_features + 3)
        torch.compiler.set_stance("default")
        with torch.no_grad():  # compiles, and changes nothing but copies
            self.compiled(*(tensor.clone() for tensor in self.variables), optimizer.target, example)
        torch.compiler.set_stance("default", skip_guard_eval_unsafe=True)  # every call is alike: saves 30 µs of each

    def q_values(self, vector: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """The action values (M, A) as a function of the vector of parameters."""
        parameters = dict(zip(self.names, views(vector, self.optimizer.shapes)))
        return torch.func.functional_call(self.agent, parameters, (obs,))

    def loss(self, vector: torch.Tensor, minibatch: Minibatch, target: torch.Tensor):
        """`dqn_loss` as a function of the vector of parameters (P,); target (M,)."""
        return dqn_loss(self.q_values(vector, minibatch.obs), minibatch, target)

    def step(self, vector, mean, square, step, rate, target_vector, rows) -> tuple[torch.Tensor, ...]:
        """One update by the replay's `rows` (M, 2 O + 3) as one graph; changes the vectors (P,) but the target's in place."""
        minibatch = Minibatch.unpack(rows)
        online_q = self.q_values(vector, minibatch.next_obs) if self.double else None
        target = td_target(minibatch, self.q_values(target_vector, minibatch.next_obs), online_q)
        gradient, parts = torch.func.grad(self.loss, has_aux=True)(vector, minibatch, target)
        self.adam_step(vector, mean, square, step, rate, gradient)
        return parts

    def __call__(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Change the agent and the optimiser by the replay buffer's rows; return the TD error's size and the mean Q."""
        with torch.no_grad():
            return self.compiled(*self.variables, self.optimizer.target, rows)


def make_update(agent: QNetwork, target_network: QNetwork, optimizer: FlatAdam, args: Args) -> PlainUpdate:
    """The compiled step with `--compile` where a compiler is at hand, else the plain one."""
    plain = PlainUpdate(agent, target_network, optimizer, args)
    if not args.compile:
        return plain
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
        return plain
    try:
        return CompiledUpdate(agent, target_network, optimizer, args)
    except Exception as error:  # whatever the compiler's tool chain lacks, the plain step needs none of it
        print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)
        return plain


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "dqn_apple 1"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "capture_video", "save_model", "save_demos")
FREE_ON_RESUME = {"run_dir", "resume", "stop_at", *FINISH}  # not checkpoint_interval, which sizes replay.dat
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
MAX_EVALUATION_STEPS = 100_000  # of an episode, where the environment has no time limit


class WithoutInfos(gym.Wrapper):
    """Drops infos, which `SyncVectorEnv` stacks, and cannot where they differ in kind or shape."""

    def reset(self, **kwargs) -> tuple[np.ndarray, dict]:
        return super().reset(**kwargs)[0], {}

    def step(self, action) -> tuple[np.ndarray, float, bool, bool, dict]:
        return *super().step(action)[:4], {}


def make_games(env_id: str, num_envs: int) -> gym.vector.VectorEnv:
    """Environments side by side: the Apple game's own vectorised one, else copies stepped in turn."""
    if env_id.split(":")[-1] == "AppleGame-v0":
        return AppleGameVectorEnv(num_envs)
    same_step = gym.vector.AutoresetMode.SAME_STEP
    return gym.vector.SyncVectorEnv([lambda: WithoutInfos(make_env(env_id))] * num_envs, autoreset_mode=same_step)


def play(policy, env_id: str, seeds: list[int], frame_skip: int = 1, keep: bool = False) -> list[dict[str, np.ndarray]]:
    """One episode for each seed, side by side, by a function from observations (N, O) to actions (N,).

    Returns for each `rewards` (T,), `terminated`, `truncated` and `seed`; with `keep` also `observations` (T + 1, O) and
    `actions` (T,).
    """
    games = make_games(env_id, len(seeds))
    obs, _ = games.reset(seed=seeds)
    running, lengths = np.ones(len(seeds), bool), np.zeros(len(seeds), int)
    terminated, truncated = np.zeros(len(seeds), bool), np.zeros(len(seeds), bool)
    observations, actions, rewards = [obs], [], []
    while running.any():
        if len(rewards) % frame_skip == 0:
            action = policy(obs)
        obs, reward, ends, time_outs, infos = games.step(action)
        time_outs = time_outs | (len(rewards) + 1 == MAX_EVALUATION_STEPS)
        rewards.append(reward)
        if keep:
            after = obs.copy()
            for i in np.flatnonzero(infos.get("_final_obs", [])):
                after[i] = infos["final_obs"][i]
            observations.append(after)
            actions.append(action)
        lengths += running
        terminated |= running & ends
        truncated |= running & time_outs
        running &= ~(ends | time_outs)
    games.close()
    episodes = []
    for i, length in enumerate(lengths):
        episode = {"rewards": np.array([reward[i] for reward in rewards[:length]], np.float64)}
        episode |= {"terminated": terminated[i], "truncated": truncated[i], "seed": np.array(seeds[i])}
        if keep:
            episode["observations"] = np.array([obs[i] for obs in observations[: length + 1]])
            episode["actions"] = np.array([action[i] for action in actions[:length]])
        episodes.append(episode)
    return episodes


def check_video(env_id: str) -> None:
    """Raise UsageError where the environment cannot be drawn, before hours are spent on training."""
    try:
        env = make_env(env_id, "rgb_array")
        env.reset(seed=0)
        env.render()
        env.close()
    except Exception as error:  # each renderer has its own
        raise UsageError(f"--capture-video: cannot draw {env_id} here: {first_line(error)}") from None


def record_video(episode: dict[str, np.ndarray], args: Args, run_dir: Path) -> None:
    """Play an episode again by its seed and actions and write it into `videos/`."""
    env = gym.wrappers.RecordVideo(make_env(args.env_id, "rgb_array"), str(run_dir / "videos"), lambda episode: True)
    env.reset(seed=int(episode["seed"]))
    for action in episode["actions"].tolist():
        env.step(action)
    env.close()


def evaluate(agent: QNetwork, args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes that training never saw; write `evaluation.json` and, if asked, a video."""
    policy = numpy_greedy(agent)
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    episodes = play(policy, args.env_id, seeds, args.frame_skip, keep=args.capture_video)
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    if args.capture_video:
        record_video(episodes[0], args, run_dir)
    evaluation = {"env_id": args.env_id, "mode": "greedy", **summary(returns), "returns": returns, "seeds": seeds}
    write_json(run_dir / "evaluation.json", evaluation)
    return evaluation


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(agent: QNetwork, args: Args, run_dir: Path) -> None:
    """Write `--save-demos` episodes of the greedy policy into `demos/`."""
    seeds = [episode_seed(args.seed, DEMONSTRATION_STREAM, i) for i in range(args.save_demos)]
    episodes = play(numpy_greedy(agent), args.env_id, seeds, args.frame_skip, keep=True)
    write_demonstrations(
        run_dir / "demos", episodes, {"env_id": args.env_id, "player": args.exp_name, "mode": "greedy"}
    )


def write_demonstrations(folder: Path, episodes: list[dict[str, np.ndarray]], about: dict) -> None:
    """Write episodes as `episode_*.npz`, and a manifest with `about` and their checksums (SHA-256).

    Each file has observations (T + 1, ...), actions (T, ...), rewards (T,), terminated, truncated, seed, and t_ns (T,),
    the time of each action in nanoseconds, simulated where the environment says how many frames a second has.
    """
    folder.mkdir(exist_ok=True)
    step_ns = round(1e9 / make_env(about["env_id"]).metadata.get("render_fps", 1))
    manifest = {"version": 1, **about, "files": {}}
    for i, episode in enumerate(episodes):
        content = io.BytesIO()
        np.savez(content, **episode, t_ns=np.arange(len(episode["rewards"]), dtype=np.int64) * step_ns)
        write_whole(folder / f"episode_{i:05d}.npz", content.getvalue())
        manifest["files"][f"episode_{i:05d}.npz"] = hashlib.sha256(content.getvalue()).hexdigest()
    write_json(folder / "manifest.json", manifest)


def read_episodes(run_dir: Path) -> np.ndarray:
    """`episodes.csv` as (number of episodes, 3): global step, return, length."""
    lines = (run_dir / "episodes.csv").read_text().splitlines()[1:]
    return np.array([line.split(",") for line in lines], np.float64).reshape(-1, 3)


def plot_learning_curve(run_dir: Path, args: Args, evaluation: dict) -> None:
    """Draw `learning_curve.png`: every episode's return, their moving mean, and the evaluation."""
    from matplotlib.figure import Figure

    steps, returns, _ = read_episodes(run_dir).T
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, returns, ".", markersize=2, alpha=0.3, color="tab:blue", label="episodes in training (ε-greedy)")
    window = min(50, max(1, len(returns)))
    if len(returns):
        means = np.convolve(returns, np.ones(window) / window, "valid")
        axes.plot(steps[window - 1 :], means, color="tab:blue", label=f"mean of {window} episodes")
    level = evaluation["mean"]
    label = f"evaluation (greedy, {args.eval_episodes} episodes): {level:,.1f}"
    axes.axhline(level, color="tab:orange", linestyle="--", label=label)
    axes.set_title(f"{args.env_id}, DQN, seed {args.seed}")
    axes.set_xlabel("frames")
    axes.set_ylabel("episodic return")
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="best", fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    content = io.BytesIO()
    figure.savefig(content, dpi=150)
    write_whole(run_dir / "learning_curve.png", content.getvalue())


def print_table(result: dict) -> None:
    """Print the last episodes of training and the evaluation, one line each."""
    print(f"{'':32}{'episodes':>9}{'mean':>11}{'std':>11}{'min':>11}{'max':>11}")
    for name in ("training", "evaluation"):
        row = result[name]
        numbers = "".join(f"{row[key]:>11.1f}" for key in ("mean", "std", "min", "max") if row[key] is not None)
        print(f"{name + ' (' + row['mode'] + ')':32}{row['episodes']:>9}{numbers}")


# ---------------------------------------------------------------------------------------------------------------------
# Training
# ---------------------------------------------------------------------------------------------------------------------
LOG_INTERVAL = 10_000  # frames between rows of updates.csv


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


class Means:
    """Means of the metrics of the updates since the last row of updates.csv."""

    def __init__(self):
        self.td_error = self.q_value = 0.0
        self.count = 0

    def add(self, parts: tuple[torch.Tensor, ...]) -> None:
        self.td_error += parts[0].item()
        self.q_value += parts[1].item()
        self.count += 1

    def take(self) -> dict[str, float]:
        """The means so far, and begin anew."""
        count = max(1, self.count)
        means = {"losses/td_error": self.td_error / count, "losses/q_values": self.q_value / count}
        metrics = {"charts/updates": self.count, **means}
        self.td_error = self.q_value = 0.0
        self.count = 0
        return metrics


def main(args: Args) -> int:
    """Train, evaluate and write everything into the run's folder. Returns the exit code."""
    args = complete_args(args)
    envs = [make_env(args.env_id) for _ in range(args.num_envs)]
    if args.capture_video:
        check_video(args.env_id)
    frames_per_step, obs_dim = args.num_envs * args.frame_skip, envs[0].observation_space.shape[0]
    between = max(args.checkpoint_interval, frames_per_step) + args.n_step * args.num_envs  # two checkpoints, at most
    spare = 2 * min(between, args.num_iterations * args.num_envs)
    check_disk(args, "--buffer-size", args.buffer_size, (args.buffer_size + spare) * row_bytes(obs_dim))
    run_dir, checkpoint = open_run_dir(args)
    last_iteration = min(args.num_iterations, math.ceil(args.stop_at / frames_per_step))
    if is_done(run_dir, args, last_iteration * frames_per_step):
        print(f"{run_dir} is done")
        return 0
    lost = checkpoint is None and (run_dir / "result.json").exists()
    require(not lost, "--resume", run_dir, "was finished with other flags, and its checkpoint is gone")
    write_json(run_dir / "args.json", arguments(args))
    print(run_dir)
    if args.track:
        start_wandb(args, run_dir)

    random.seed(args.seed)  # for environments that draw from these two; their resumed runs end with other bytes
    np.random.seed(args.seed)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.num_threads)
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    stop = StopSignal()

    num_actions = int(envs[0].action_space.n)
    agent = QNetwork(obs_dim, num_actions, args.hidden_size, args.dueling).to(device)
    target_network = QNetwork(obs_dim, num_actions, args.hidden_size, args.dueling).to(device)
    optimizer = FlatAdam(agent, target_network, args.learning_rate)
    players = [Player(Episode(env, args.seed, i, args.frame_skip), args) for i, env in enumerate(envs)]
    added = 0 if checkpoint is None else checkpoint["added"]
    is_trained = checkpoint is not None and checkpoint["iteration"] >= last_iteration  # only its end is done again
    buffer = None if is_trained else ReplayBuffer(run_dir / "replay.dat", args.buffer_size, spare, obs_dim, added)
    rng = np.random.default_rng(np.random.SeedSequence(args.seed))
    means = Means()
    iteration, training_seconds, offsets = 0, 0.0, {"episodes": 0, "updates": 0}
    if checkpoint is None:
        for player in players:
            player.start()
    else:
        iteration, training_seconds = checkpoint["iteration"], checkpoint["training_seconds"]
        offsets = checkpoint["offsets"]
        optimizer.load_state_dict(checkpoint["optimizer"])
        rng.bit_generator.state = json.loads(checkpoint["rng"])
        vars(means).update(checkpoint["means"])
        same = [player.load_state_dict(state) for player, state in zip(players, checkpoint["players"])]
        if not all(same):
            print("--resume: the replayed episode differs (another machine?), goes on with it", file=sys.stderr)
    update = make_update(agent, target_network, optimizer, args)
    arithmetic = f"{type(update).__name__} on {device.type}"
    if checkpoint and checkpoint["arithmetic"] != arithmetic:
        print(f"--resume: was {checkpoint['arithmetic']}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    greedy = numpy_greedy(agent)
    global_step = iteration * frames_per_step
    episodes_csv = CsvLog(run_dir / "episodes.csv", offsets["episodes"])
    updates_csv = CsvLog(run_dir / "updates.csv", offsets["updates"])
    forget_end(run_dir, iteration < last_iteration)
    writer = SummaryWriter(str(run_dir), purge_step=global_step + 1)
    progress = tqdm(total=last_iteration * frames_per_step, initial=global_step, unit="frame", disable=None)
    exploration_frames = args.exploration_fraction * args.total_timesteps
    last_time = time.perf_counter()

    while iteration < last_iteration:
        iteration += 1
        epsilon = linear_schedule(args.start_e, args.end_e, exploration_frames, global_step)
        remaining = 1.0 - global_step / args.total_timesteps if args.anneal_lr else 1.0
        for i, player in enumerate(players):
            explores = rng.random() < epsilon
            action = int(rng.integers(num_actions)) if explores else int(greedy(player.obs[None])[0])
            ended = player.step(action, buffer)
            if ended:
                step = global_step + (i + 1) * args.frame_skip
                episodes_csv.write({"global_step": step, "episodic_return": ended[0], "episodic_length": ended[1]})
                charts = {"charts/episodic_return": ended[0], "charts/episodic_length": ended[1]}
                add_scalars(writer, charts, step)
                progress.set_postfix_str(f"return {ended[0]:.1f}", refresh=False)
        before, global_step = global_step, global_step + frames_per_step

        if buffer.added >= args.batch_size and global_step >= args.learning_starts:
            for _ in range(global_step // args.train_frequency - before // args.train_frequency):
                optimizer.anneal(remaining)
                means.add(update(buffer.sample(args.batch_size, rng).to(device)))
                greedy = numpy_greedy(agent) if device.type == "cuda" else greedy
        if global_step // args.target_network_frequency > before // args.target_network_frequency:
            optimizer.target.copy_(optimizer.vector)

        logs = global_step // LOG_INTERVAL > before // LOG_INTERVAL or iteration == args.num_iterations
        crossed = global_step // args.checkpoint_interval > before // args.checkpoint_interval
        if not (logs or crossed or stop.received or iteration == last_iteration):
            continue
        progress.update(global_step - progress.n)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        if not optimizer.vector.isfinite().all():
            raise RunError(f"frame {global_step}: the network's parameters are no longer finite")
        if logs:
            schedules = {"charts/epsilon": epsilon, "charts/learning_rate": remaining * args.learning_rate}
            metrics = {**schedules, **means.take()}
            updates_csv.write({"global_step": global_step, **metrics})
            add_scalars(writer, {**metrics, "charts/SPS": global_step / training_seconds}, global_step)
        if crossed or stop.received or iteration == last_iteration:
            state = {
                "args": arguments(args),
                "arithmetic": arithmetic,
                "iteration": iteration,
                "training_seconds": training_seconds,
                "offsets": {"episodes": episodes_csv.sync(), "updates": updates_csv.sync()},
                "optimizer": optimizer.state_dict(),
                "added": buffer.sync(),
                "rng": json.dumps(rng.bit_generator.state),
                "means": dict(vars(means)),
                "players": [player.state_dict() for player in players],
            }
            writer.flush()
            save_checkpoint(run_dir, state)
        if stop.received and iteration < last_iteration:
            progress.close()
            writer.close()
            print(f"stopped by signal {stop.received} at frame {global_step}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    finish_run(agent, args, run_dir, global_step, training_seconds, writer)
    writer.close()
    return 0


def finish_run(agent: QNetwork, args: Args, run_dir: Path, global_step: int, seconds: float, writer) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last."""
    evaluation = evaluate(agent, args, run_dir)
    for name in ("mean", "std", "min", "max"):
        writer.add_scalar(f"eval/episodic_return_{name}", evaluation[name], global_step)
    if args.save_model:
        model = safetensors.torch.save(agent.state_dict(), {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", model)
    if args.save_demos:
        save_demonstrations(agent, args, run_dir)
    plot_learning_curve(run_dir, args, evaluation)
    versions = {module.__name__: module.__version__ for module in (gym, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": global_step,
        "complete": global_step == args.num_iterations * args.num_envs * args.frame_skip,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training": {"mode": "ε-greedy", **summary(read_episodes(run_dir)[-50:, 1])},
        "evaluation": {name: value for name, value in evaluation.items() if name not in ("returns", "seeds")},
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
