"""DQN on Atari's Gopher: the reinforcement learning teacher of the hybrid agent (thesis section 2.4.2).

    python cleanrl_thesis/dqn_gopher.py --bf16 --save-model --run-dir runs/gopher_dqn     # as in the thesis, for distill_hybrid.py
    python cleanrl_thesis/dqn_gopher.py --life-loss-ends --n-step 3 --anneal-lr --bf16 --save-model   # the teacher of the results
    python cleanrl_thesis/dqn_gopher.py --obs-type ram --n-step 3 --life-loss-ends --anneal-lr --total-timesteps 2500000   # minutes
    python cleanrl_thesis/dqn_gopher.py --env-id ALE/Breakout-v5

Tasks: every `ALE/*-v5` of ale-py, with the usual preprocessing (frames of 84 × 84 greys, the brighter of two, four of them
stacked; an action lasts four frames; up to 30 idle frames at first), which equals Gymnasium's `AtariPreprocessing` and
`FrameStackObservation`. `--run-dir DIR --resume` can be sent again after every crash, within an episode too: on the same
machine the run ends with the same bytes.

| setting | value | source |
|---|---|---|
| frames, replay buffer, ε | 10,010,000; 1,000,000; 1.0 → 0.01 | section 2.4.2 |
| batch, learning rate, γ, ε's share of the frames | 32, 1e-4, 0.99, 10% | OpenAI Baselines' defaults for Atari |
| updates, target updates, start of learning | every 4 actions, every 1,000, after 10,000 (flags count frames: times 4) | OpenAI Baselines' defaults for Atari |
| network, Huber loss, gradient norm 10, double, dueling, rewards' signs | on | OpenAI Baselines' defaults for Atari |
| prioritised replay, the end of a life as an end | off; off (`--life-loss-ends`) | ours; on in OpenAI Baselines |
| repeated actions | with probability 0.25 | `ALE/*-v5`; thesis: not given |
| games side by side | 8 | ours |

Frames are game frames here, an action lasting four: the "frames of gameplay" of section 2.4.2, to the letter (OpenAI Baselines
counts actions, of which as many would be 40 million frames). The replay buffer holds every frame that the agent saw once: 7,063 bytes
for each, 7.8 GB with the room between two checkpoints, in a file that the operating system keeps in memory as far as it can.
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "ale-py>=0.11",
#     "gymnasium>=1.2",
#     "matplotlib>=3.9",
#     "numpy>=2.0",
#     "opencv-python-headless>=4.10",
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import ale_py
import cv2
import gymnasium as gym
import numpy as np
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
    exp_name: str = "dqn_gopher"
    """the name of this experiment"""
    seed: int = 1
    """seed of the experiment"""
    torch_deterministic: bool = True
    """sets `torch.backends.cudnn.deterministic`"""
    cuda: bool = False
    """train on the GPU where there is one"""
    num_threads: int = 1
    """threads of torch; one lets a sweep fill the machine with runs"""
    bf16: bool = False
    """the network's layers in bfloat16: faster where the processor has instructions for it"""
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
    eval_episodes: int = 100
    """episodes of the evaluation at the end"""
    eval_epsilon: float = 0.01
    """share of random actions in evaluation, video and demonstrations; without any a game can wait for a key forever"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 200_000
    """frames between checkpoints; the replay file has room for two intervals beyond `--buffer-size`"""
    stop_at: int | None = None
    """end at this frame of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: str = "ALE/Gopher-v5"
    """a game of ale-py: ALE/*-v5"""
    obs_type: Literal["pixels", "ram"] = "pixels"
    """what the agent sees: frames, or the console's 128 bytes of memory"""
    total_timesteps: int = 10_010_000
    """game frames (section 2.4.2)"""
    num_envs: int = 8
    """games side by side"""
    frame_skip: int = 4
    """frames for which an action is repeated"""
    frame_stack: int = 4
    """frames that are stacked into one observation"""
    noop_max: int = 30
    """most idle frames at the start of an episode"""
    learning_rate: float = 1e-4
    """Adam's learning rate (Baselines)"""
    anneal_lr: bool = False
    """anneal the learning rate linearly to 0; off: constant (Baselines)"""
    hidden_size: int = 512
    """units of the last hidden layer, half of them for either dueling head (Baselines)"""
    buffer_size: int = 1_000_000
    """frames in the replay buffer, of those that the agent saw (section 2.4.2)"""
    gamma: float = 0.99
    """discount factor γ per action (Baselines)"""
    n_step: int = 1
    """actions whose rewards are summed before the value of the next state (Baselines: 1)"""
    target_network_frequency: int = 4_000
    """frames between updates of the target network (Baselines)"""
    batch_size: int = 32
    """transitions per update (Baselines)"""
    start_e: float = 1.0
    """ε at the beginning (section 2.4.2)"""
    end_e: float = 0.01
    """ε in the end (section 2.4.2)"""
    exploration_fraction: float = 0.1
    """share of the frames in which ε falls linearly (Baselines)"""
    learning_starts: int = 40_000
    """frame of the first update (Baselines)"""
    train_frequency: int = 16
    """frames per update (Baselines)"""
    max_grad_norm: float = 10.0
    """bound on the norm of the gradient, of all parameters together; inf for none (Baselines: the same, of each variable)"""
    double: bool = True
    """double DQN: the online network chooses the next action, the target network values it (Baselines)"""
    dueling: bool = True
    """dueling heads: Q = V + A − mean A (Baselines)"""
    clip_rewards: bool = True
    """learn from the rewards' signs (Baselines)"""
    life_loss_ends: bool = False
    """learn as if the loss of a life ended the episode (on in Baselines)"""

    # to be filled in runtime
    num_iterations: tyro.conf.Suppress[int] = 0
    """total_timesteps // (num_envs · frame_skip), times that every game is stepped"""


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
        "num_envs frame_skip frame_stack batch_size buffer_size eval_episodes checkpoint_interval stop_at "
        "train_frequency target_network_frequency n_step"
    )
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("max_grad_norm", lambda x: x > 0, "must be greater than 0"),
        ("gamma start_e end_e exploration_fraction eval_epsilon", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos learning_starts noop_max", lambda x: x >= 0, "must be at least 0"),
        ("hidden_size", lambda x: x >= 2 and x % 2 == 0, "must be even and at least 2"),
        ("frame_stack", lambda x: x <= 255, "must be at most 255"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    frames = args.num_envs * args.frame_skip
    args.num_iterations = args.total_timesteps // frames
    allowed = f"must be at least one step of every game, {frames} frames"
    require(args.num_iterations >= 1, "--total-timesteps", args.total_timesteps, allowed)
    learns = args.learning_starts < args.total_timesteps
    allowed = f"must be less than --total-timesteps, {args.total_timesteps}"
    require(learns, "--learning-starts", args.learning_starts, allowed)
    rows = args.frame_stack + args.n_step + 1  # of two to draw from, one may begin no transition
    least = rows * args.num_envs
    allowed = f"must be at least --frame-stack, --n-step and one more frames of every game, {least}"
    require(args.buffer_size >= least, "--buffer-size", args.buffer_size, allowed)
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UsageError("--track: needs Weights and Biases: pip install wandb")
    if args.capture_video and importlib.util.find_spec("moviepy") is None:
        raise UsageError("--capture-video: needs moviepy: pip install moviepy")
    return args


# ---------------------------------------------------------------------------------------------------------------------
# The game
# ---------------------------------------------------------------------------------------------------------------------
SIDE, RAM_BYTES = 84, 128
ATARI_FPS = 60  # the console's frames a second


class AtariGame(gym.Env):
    """A game of ale-py as Mnih et al. (2015) show it: the last frames that the agent saw, newest last.

    Observations are (frame_stack, 84, 84) uint8, equal to Gymnasium's
    `FrameStackObservation(AtariPreprocessing(gym.make(env_id, frameskip=1), noop_max, frame_skip), frame_stack)`,
    or of `ram` the console's memory at the same steps, (frame_stack, 128).
    An episode follows from the seed of its reset and its actions. The end after 30 minutes is a truncation.
    """

    metadata = {"render_modes": ["rgb_array"]}

    def __init__(
        self,
        env_id: str,
        obs_type: str = "pixels",
        frame_skip: int = 4,
        frame_stack: int = 4,
        noop_max: int = 30,
        render_mode: str | None = None,
    ):
        spec = gym.spec(env_id)
        self.render_mode, self.obs_type, self.frame_skip, self.noop_max = render_mode, obs_type, frame_skip, noop_max
        self.metadata = {**self.metadata, "render_fps": ATARI_FPS // frame_skip}
        self.rom = ale_py.roms.get_rom_path(spec.kwargs["game"])
        self.emulator = ale_py.ALEInterface()
        self.emulator.setFloat("repeat_action_probability", spec.kwargs["repeat_action_probability"])
        self.emulator.setInt("max_num_frames_per_episode", spec.kwargs["max_num_frames_per_episode"])
        self.emulator.loadROM(self.rom)
        self.moves = self.emulator.getMinimalActionSet()
        self.shape = (RAM_BYTES,) if obs_type == "ram" else (SIDE, SIDE)
        self.screens = np.zeros((2, *self.emulator.getScreenDims()), np.uint8)
        self.stack = np.zeros((frame_stack, *self.shape), np.uint8)
        self.observation_space = gym.spaces.Box(0, 255, self.stack.shape, np.uint8)
        self.action_space = gym.spaces.Discrete(len(self.moves))

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin an episode; with a seed, the one that `gym.make(env_id).reset(seed=seed)` begins."""
        if seed is not None:
            numpy_seed, emulator_seed = np.random.SeedSequence(seed).generate_state(2)
            self.np_random = np.random.default_rng(int(numpy_seed))
            self.emulator.setInt("random_seed", emulator_seed.astype(np.int32))
            self.emulator.loadROM(self.rom)
        self.emulator.reset_game()
        for _ in range(self.np_random.integers(1, self.noop_max + 1) if self.noop_max else 0):
            self.emulator.act(ale_py.Action.NOOP)
            if self.emulator.game_over():
                self.emulator.reset_game()
        self.lives = self.emulator.lives()
        self.screens[1] = 0
        self.look(0)
        self.stack[:] = self.frame()
        return self.stack.copy(), {"lives": self.lives}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        """Repeat an action for `frame_skip` frames, or until the game is over; the reward is the sum of the points."""
        reward = 0.0
        for left in range(self.frame_skip - 1, -1, -1):
            reward += self.emulator.act(self.moves[action])
            if self.emulator.game_over():
                break
            if left < 2:
                self.look(left)
        self.lives = self.emulator.lives()
        self.stack[:-1] = self.stack[1:]
        self.stack[-1] = self.frame()
        terminated, truncated = self.emulator.game_over(with_truncation=False), self.emulator.game_truncated()
        return self.stack.copy(), reward, terminated, truncated, {"lives": self.lives}

    def look(self, which: int) -> None:
        """Put the screen's greys into one of the two whose brighter pixels are seen: sprites flicker."""
        if self.obs_type == "pixels":
            self.emulator.getScreenGrayscale(self.screens[which])

    def frame(self) -> np.ndarray:
        """What the agent sees of the last two frames, (84, 84) or (128,) uint8."""
        if self.obs_type == "ram":
            return self.emulator.getRAM()
        if self.frame_skip > 1:
            np.maximum(self.screens[0], self.screens[1], out=self.screens[0])
        return cv2.resize(self.screens[0], (SIDE, SIDE), interpolation=cv2.INTER_AREA)

    def render(self) -> np.ndarray:
        return self.emulator.getScreenRGB()


def make_atari(env_id: str, render_mode: str | None = None, **options) -> AtariGame:
    """Make a game of ale-py, with the options of AtariGame. Raises UsageError."""
    gym.register_envs(ale_py)
    ale_py.ALEInterface.setLoggerMode(ale_py.LoggerMode.Error)
    try:
        known = gym.spec(env_id).entry_point == "ale_py.env:AtariEnv" and env_id.endswith("-v5")
    except gym.error.Error as error:
        raise UsageError(f"--env-id {env_id}: {first_line(error)}") from None
    require(known, "--env-id", env_id, "must be a game of ale-py: ALE/*-v5")
    return AtariGame(env_id, render_mode=render_mode, **options)


def game_options(args: Args) -> dict:
    """The options of AtariGame."""
    return {name: getattr(args, name) for name in ("obs_type", "frame_skip", "frame_stack", "noop_max")}


# ---------------------------------------------------------------------------------------------------------------------
# Network
# ---------------------------------------------------------------------------------------------------------------------
def has_bf16(device: torch.device) -> bool:
    """Whether the device computes in bfloat16: a CPU without such instructions takes several times as long as in float32."""
    return device.type != "cpu" or torch.ops.mkldnn._is_mkldnn_bf16_supported()


class AtariQNetwork(nn.Module):
    """Q(s, ·) of each action: convolutions (for the memory's bytes two layers), a hidden layer, one linear head.

    With `dueling` two heads, each on one half of the hidden layer: V(s) + A(s, ·) − mean A.
    """

    def __init__(
        self, obs_shape: tuple[int, ...], num_actions: int, hidden_size: int, dueling: bool, bf16: bool = False
    ):
        super().__init__()
        self.bf16, self.head_size = bf16, (hidden_size // 2 if dueling else hidden_size)
        if len(obs_shape) == 3:
            layers = nn.Conv2d(obs_shape[0], 32, 8, 4), nn.Conv2d(32, 64, 4, 2), nn.Conv2d(64, 64, 3, 1)
        else:
            layers = nn.Linear(math.prod(obs_shape), 256), nn.Linear(256, 256)
        self.trunk = nn.ModuleList(layers)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            features = self.features(torch.zeros(1, *obs_shape)).shape[1]
        self.hidden = nn.Linear(features, hidden_size)
        self.advantage = nn.Linear(self.head_size, num_actions)
        self.value = nn.Linear(self.head_size, 1) if dueling else None

    def features(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (B, S, 84, 84) or (B, S, 128) of 0 to 255 -> features (B, F)."""
        first, *others = self.trunk
        x = obs.to(torch.bfloat16 if self.bf16 else torch.float32)  # exact: bfloat16 has all integers up to 256
        weight = first.weight / 255  # instead of the observations, which are more
        if obs.ndim == 4:  # channels last in memory, which is faster
            x = F.conv2d(x.contiguous(memory_format=torch.channels_last), weight, first.bias, first.stride)
        else:
            x = F.linear(x.flatten(1), weight, first.bias)
        for layer in others:
            x = layer(torch.relu(x))
        return torch.relu(x).flatten(1)

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (B, S, 84, 84) or (B, S, 128) uint8 -> action values (B, A)."""
        with torch.autocast(obs.device.type, torch.bfloat16, enabled=self.bf16):
            hidden = torch.relu(self.hidden(self.features(obs)))
        hidden = hidden.float()
        advantage = self.advantage(hidden[:, -self.head_size :])
        if self.value is None:
            return advantage
        return self.value(hidden[:, : self.head_size]) + advantage - advantage.mean(1, keepdim=True)


def greedy_policy(agent: AtariQNetwork, device: torch.device):
    """argmax Q as a numpy function, observations (N, ...) uint8 -> actions (N,)."""

    def greedy(obs: np.ndarray) -> np.ndarray:
        with torch.no_grad():
            return agent(torch.from_numpy(obs).to(device)).argmax(1).cpu().numpy()

    return greedy


def epsilon_greedy_policy(greedy, num_actions: int, epsilon: float, seed: int):
    """The greedy policy with a share of random actions."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, EVALUATION_STREAM]))

    def policy(obs: np.ndarray) -> np.ndarray:
        random_actions = rng.integers(num_actions, size=len(obs))
        return np.where(rng.random(len(obs)) < epsilon, random_actions, greedy(obs))

    return policy


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


GOES_ON, ENDS, NOT_PLAYED = 0, 1, 2  # what follows a frame: another one with a value, one without, or no action at all


class Minibatch(NamedTuple):
    """M transitions of n steps."""

    obs: torch.Tensor  # (M, S, ...) uint8
    actions: torch.Tensor  # (M,) int64
    returns: torch.Tensor  # (M,), discounted sum of the n rewards
    discounts: torch.Tensor  # (M,), γⁿ, or 0 where the episode ended; fewer steps than n before a time-out
    next_obs: torch.Tensor  # (M, S, ...) uint8, as many steps later

    def to(self, device: torch.device) -> "Minibatch":
        return Minibatch(*(tensor.to(device) for tensor in self))


def row_type(frame_shape: tuple[int, ...]) -> np.dtype:
    """What the replay buffer keeps of one game's step: 7,063 bytes with a frame of 84 × 84."""
    fields = [("frame", np.uint8, frame_shape), ("reward", np.float32)]
    return np.dtype(fields + [(name, np.uint8) for name in ("action", "age", "follows")])


class ReplayBuffer:
    """The last `rows` steps of N games, each frame once, in a file that is written in place.

    A row has for each game its newest frame, what the agent did there, and the reward. An observation is put together of
    the rows before, but for those of the episode before. The ring has room for `spare` more rows, so that what a
    checkpoint counts is still there after `spare` further ones; the checkpoint keeps only how many rows there were.
    """

    def __init__(self, path: Path, rows: int, spare: int, num_envs: int, obs_shape: tuple[int, ...], added: int = 0):
        """Go on in the file after `added` rows, or begin it. Raises RunError where it is not the whole file."""
        self.rows, self.slots, self.num_envs, self.added = rows, rows + spare, num_envs, added
        self.frame_stack, *frame_shape = obs_shape
        self.dtype = row_type(tuple(frame_shape))
        size = self.slots * num_envs * self.dtype.itemsize
        if added and not (path.exists() and path.stat().st_size == size):
            raise RunError(f"{path}: not the replay buffer of the last checkpoint; the run cannot be resumed")
        path.touch()
        with open(path, "r+b") as file:  # not "a": file systems without fallocate of their own refuse it then
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is an error here, not a signal later
            file.truncate(size)
        self.map = np.memmap(path, self.dtype, "r+", shape=(self.slots * num_envs,))
        self.fields = {name: np.asarray(self.map[name]) for name in self.dtype.names}  # without memmap's overhead

    def add(self, game: int, frame: np.ndarray, age: int, action: int, reward: float, follows: int) -> None:
        """Write what a game showed into the row that is being filled; `next_row` ends it."""
        slot = self.added % self.slots * self.num_envs + game
        values = {"frame": frame, "reward": reward, "action": action, "age": min(age, 255), "follows": follows}
        for name, value in values.items():
            self.fields[name][slot] = value

    def next_row(self) -> None:
        self.added += 1

    def sample(self, batch_size: int, gamma: float, n_step: int, rng: np.random.Generator) -> Minibatch:
        """Transitions that are drawn uniformly; the newest rows have no n next ones yet."""
        oldest = self.added - self.rows
        first = oldest + self.frame_stack - 1 if oldest > 0 else 0
        low, high = first * self.num_envs, (self.added - n_step) * self.num_envs
        picks, total = rng.integers(low, high, batch_size), self.slots * self.num_envs
        while (unplayed := self.fields["follows"][picks % total] == NOT_PLAYED).any():
            picks[unplayed] = rng.integers(low, high, unplayed.sum())
        actions = self.fields["action"][picks % total].astype(np.int64)
        returns, discounts, ends = self.followed(picks, gamma, n_step)
        return Minibatch(*map(torch.from_numpy, (self.stacked(picks), actions, returns, discounts, self.stacked(ends))))

    def followed(self, picks: np.ndarray, gamma: float, n_step: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Returns and discounts (M,) float32 of n steps from the rows `picks`, and the rows where these end, at a time-out earlier."""
        total, ends, goes_on = self.slots * self.num_envs, picks.copy(), np.ones(len(picks), bool)
        returns, discounts = np.zeros(len(picks), np.float32), np.ones(len(picks), np.float32)
        for _ in range(n_step):
            follows = self.fields["follows"][ends % total]
            goes_on &= follows != NOT_PLAYED
            returns += np.where(goes_on, discounts * self.fields["reward"][ends % total], np.float32(0))
            discounts[goes_on] *= np.where(follows == GOES_ON, np.float32(gamma), np.float32(0))[goes_on]
            ends[goes_on] += self.num_envs
            goes_on &= follows == GOES_ON
        return returns, discounts, ends

    def stacked(self, picks: np.ndarray) -> np.ndarray:
        """The observations (M, S, ...) whose newest frames are `picks`; an episode's first frame stands in for those before."""
        total = self.slots * self.num_envs
        back = np.minimum(np.arange(self.frame_stack - 1, -1, -1), self.fields["age"][picks % total][:, None])
        return self.fields["frame"][(picks[:, None] - back * self.num_envs) % total]

    def sync(self) -> int:
        """Bring everything onto the disk; return how many rows there were."""
        self.map.flush()
        return self.added


class Players:
    """Plays games side by side and puts what they show into the replay buffer.

    Each reset has a seed of its own, so the episode's number and actions determine a game: a checkpoint keeps those two, and
    `load_state_dict` plays them again. (The emulator's own saved state lacks the action that a game may repeat next.)
    """

    def __init__(self, games: list[AtariGame], args: Args):
        self.games, self.args = games, args
        self.numbers, self.actions = [-1] * len(games), [[] for _ in games]
        self.returns, self.over = np.zeros(len(games)), np.ones(len(games), bool)
        self.obs = np.zeros((len(games), *games[0].stack.shape), np.uint8)

    def start(self, i: int, number: int) -> None:
        """Begin an episode of game i."""
        self.numbers[i], self.actions[i], self.returns[i], self.over[i] = number, [], 0, False
        self.obs[i], _ = self.games[i].reset(seed=episode_seed(self.args.seed, i, number))

    def act(self, i: int, action: int) -> tuple[float, bool]:
        """Take an action in game i; return the reward, and whether no value follows it."""
        self.actions[i].append(action)
        game, lives = self.games[i], self.games[i].lives
        self.obs[i], reward, terminated, truncated, _ = game.step(action)
        self.returns[i] += reward
        self.over[i] = terminated or truncated
        return reward, terminated or (self.args.life_loss_ends and game.lives < lives)

    def step(self, actions: np.ndarray, buffer: ReplayBuffer) -> list[tuple[float, int]]:
        """Take an action in each game; return (return in points, frames) of the episodes that ended.

        They begin anew in the step after, so that the buffer has their last frames too.
        """
        ended = []
        for i, action in enumerate(actions.tolist()):
            frame, age = self.obs[i, -1].copy(), len(self.actions[i])
            if self.over[i]:
                self.start(i, self.numbers[i] + 1)
                buffer.add(i, frame, age, 0, 0.0, NOT_PLAYED)
                continue
            reward, ends = self.act(i, action)
            seen = float(np.sign(reward)) if self.args.clip_rewards else reward
            buffer.add(i, frame, age, action, seen, ENDS if ends else GOES_ON)
            if self.over[i]:
                ended.append((float(self.returns[i]), len(self.actions[i]) * self.args.frame_skip))
        buffer.next_row()
        return ended

    def state_dict(self) -> dict:
        """All that `load_state_dict` restores, as tensors and plain values."""
        actions = [torch.tensor(each, dtype=torch.uint8) for each in self.actions]
        return {"numbers": list(self.numbers), "actions": actions, "obs": torch.tensor(self.obs)}

    def load_state_dict(self, state: dict) -> bool:
        """Play the saved episodes again; return whether that gave the saved observations bit for bit."""
        for i, (number, actions) in enumerate(zip(state["numbers"], state["actions"])):
            self.start(i, number)
            for action in actions.tolist():
                self.act(i, action)
        return np.array_equal(self.obs, state["obs"].numpy())


def linear_schedule(start: float, end: float, duration: float, t: int) -> float:
    """From `start` to `end` over `duration`, then `end`."""
    return start + (end - start) * t / duration if t < duration else end


# ---------------------------------------------------------------------------------------------------------------------
# The algorithm
# ---------------------------------------------------------------------------------------------------------------------
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


class Learner:
    """The online and the target network, and Adam."""

    def __init__(self, make_network, args: Args, device: torch.device):
        self.args = args
        self.agent, self.target_network = make_network().to(device), make_network().to(device)
        self.copy_to_target()
        self.optimizer = torch.optim.Adam(self.agent.parameters(), args.learning_rate, eps=1e-8, fused=True)

    def copy_to_target(self) -> None:
        self.target_network.load_state_dict(self.agent.state_dict())

    def update(self, minibatch: Minibatch, learning_rate: float) -> tuple[torch.Tensor, ...]:
        """One step of Adam; returns as scalars the TD error's size and the mean Q."""
        with torch.no_grad():
            online_q = self.agent(minibatch.next_obs) if self.args.double else None
            target = td_target(minibatch, self.target_network(minibatch.next_obs), online_q)
        loss, parts = dqn_loss(self.agent(minibatch.obs), minibatch, target)
        self.optimizer.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self.agent.parameters(), self.args.max_grad_norm)
        self.optimizer.param_groups[0]["lr"] = learning_rate
        self.optimizer.step()
        return parts

    def is_finite(self) -> bool:
        return all(bool(parameter.isfinite().all()) for parameter in self.agent.parameters())

    def state_dict(self) -> dict[str, dict]:
        """All that `load_state_dict` restores."""
        parts = {"agent": self.agent, "target_network": self.target_network, "optimizer": self.optimizer}
        return {name: part.state_dict() for name, part in parts.items()}

    def load_state_dict(self, state: dict[str, dict]) -> None:
        self.agent.load_state_dict(state["agent"])
        self.target_network.load_state_dict(state["target_network"])
        self.optimizer.load_state_dict(state["optimizer"])


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "dqn_gopher 2"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "eval_epsilon", "capture_video", "save_model", "save_demos")
FREE_ON_RESUME = {
    "run_dir",
    "resume",
    "stop_at",
    "num_threads",
    *FINISH,
}  # not checkpoint_interval, which sizes replay.dat
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
GAMES_AT_ONCE = 16


def play_atari(policy, make_game, seeds: list[int]) -> list[dict[str, np.ndarray]]:
    """One episode for each seed, up to 16 side by side, by a function from observations (N, ...) to actions (N,).

    Returns for each `actions`, `rewards` and `lives` (T,), `terminated`, `truncated`, `seed`, and `emulator_state` before the
    first action, as bytes.
    """
    games, episodes = [make_game() for _ in range(min(GAMES_AT_ONCE, len(seeds)))], []
    for block in range(0, len(seeds), GAMES_AT_ONCE):
        episodes += play_together(policy, games, seeds[block : block + GAMES_AT_ONCE])
    return episodes


def play_together(policy, games: list[AtariGame], seeds: list[int]) -> list[dict[str, np.ndarray]]:
    """One episode for each seed, each in a game of its own; see `play_atari`."""
    obs = [game.reset(seed=seed)[0] for game, seed in zip(games, seeds)]
    episodes = [{"seed": np.array(seed)} for seed in seeds]
    for game, episode in zip(games, episodes):
        state = game.emulator.cloneState(include_rng=True).__getstate__()
        episode["emulator_state"] = np.frombuffer(state, np.uint8)
    steps, running = [[] for _ in seeds], list(range(len(seeds)))
    while running:
        actions = policy(np.stack([obs[i] for i in running]))
        for i, action in zip(tuple(running), actions.tolist()):
            obs[i], reward, terminated, truncated, info = games[i].step(action)
            steps[i].append((action, reward, info["lives"]))
            if terminated or truncated:
                running.remove(i)
                episodes[i] |= {"terminated": np.array(terminated), "truncated": np.array(truncated)}
    for episode, columns in zip(episodes, steps):
        for name, column, dtype in zip(
            ("actions", "rewards", "lives"), zip(*columns), (np.int64, np.float64, np.int64)
        ):
            episode[name] = np.array(column, dtype)
    return episodes


def check_video(args: Args) -> None:
    """Raise UsageError where the game cannot be drawn, before hours are spent on training."""
    try:
        env = make_atari(args.env_id, "rgb_array", **game_options(args))
        env.reset(seed=0)
        env.render()
    except Exception as error:  # a broken installation of ale-py
        raise UsageError(f"--capture-video: cannot draw {args.env_id} here: {first_line(error)}") from None


def record_video(episode: dict[str, np.ndarray], args: Args, run_dir: Path) -> None:
    """Play an episode of `play_atari` again and write it into `videos/`."""
    env = make_atari(args.env_id, "rgb_array", **game_options(args))
    env = gym.wrappers.RecordVideo(env, str(run_dir / "videos"), lambda episode: True)
    env.reset(seed=int(episode["seed"]))
    for action in episode["actions"].tolist():
        env.step(action)
    env.close()


def evaluation_policy(agent: AtariQNetwork, args: Args, device: torch.device):
    """The greedy policy with `--eval-epsilon`."""
    num_actions = agent.advantage.out_features
    return epsilon_greedy_policy(greedy_policy(agent, device), num_actions, args.eval_epsilon, args.seed)


def evaluate(agent: AtariQNetwork, args: Args, run_dir: Path, device: torch.device) -> dict:
    """Play `--eval-episodes` episodes that training never saw; write `evaluation.json` and, if asked, a video."""
    policy = evaluation_policy(agent, args, device)
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    episodes = play_atari(policy, lambda: make_atari(args.env_id, **game_options(args)), seeds)
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    if args.capture_video:
        record_video(episodes[0], args, run_dir)
    lives = [score for episode in episodes for score in rewards_per_life(episode)]
    evaluation = {
        "env_id": args.env_id,
        "mode": f"ε = {args.eval_epsilon}",
        **summary(returns),
        "rewards_per_life": summary(lives),
    }
    write_json(run_dir / "evaluation.json", {**evaluation, "returns": returns, "lives": lives, "seeds": seeds})
    return evaluation


def rewards_per_life(episode: dict[str, np.ndarray]) -> list[int]:
    """How many rewards there were in each life of an episode: as Table 2.2 seems to count (`benchmark/results/README.md`)."""
    lost = np.flatnonzero(np.diff(episode["lives"]) < 0) + 2  # behind the step in which it was lost
    return [int((part > 0).sum()) for part in np.split(episode["rewards"], lost) if len(part)]


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(agent: AtariQNetwork, args: Args, run_dir: Path, device: torch.device) -> None:
    """Write `--save-demos` episodes into `demos/`."""
    seeds = [episode_seed(args.seed, DEMONSTRATION_STREAM, i) for i in range(args.save_demos)]
    make_game = functools.partial(make_atari, args.env_id, **game_options(args))
    episodes = play_atari(evaluation_policy(agent, args, device), make_game, seeds)
    about = {"env_id": args.env_id, "player": args.exp_name, "mode": f"ε = {args.eval_epsilon}"}
    about["options"] = game_options(args)
    write_atari_demonstrations(run_dir / "demos", episodes, about)


def write_atari_demonstrations(folder: Path, episodes: list[dict[str, np.ndarray]], about: dict) -> None:
    """Write episodes as `episode_*.npz`, and a manifest with `about` and their checksums (SHA-256).

    Each file has actions (T,), rewards (T,), lives (T,), terminated, truncated, seed, emulator_state, and t_ns (T,), the time of
    each action in nanoseconds of the game. Observations are not stored: emulator and actions give them again.
    """
    folder.mkdir(exist_ok=True)
    step_ns = round(1e9 * about["options"]["frame_skip"] / ATARI_FPS)
    manifest = {"version": 1, **about, "ale_py": ale_py.__version__, "files": {}}
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
    label = f"evaluation ({evaluation['mode']}, {args.eval_episodes} episodes): {level:,.1f}"
    axes.axhline(level, color="tab:orange", linestyle="--", label=label)
    axes.set_title(f"{args.env_id}, DQN on {args.obs_type}, seed {args.seed}")
    axes.set_xlabel("frames")
    axes.set_ylabel("episodic return")
    axes.locator_params(axis="x", nbins=6)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="best", fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    content = io.BytesIO()
    figure.savefig(content, dpi=150)
    write_whole(run_dir / "learning_curve.png", content.getvalue())


def print_table(result: dict) -> None:
    """Print the last episodes of training and the evaluation, one line each."""
    print(f"{'':32}{'episodes':>9}{'mean':>11}{'std':>11}{'min':>11}{'max':>11}")
    evaluation = result["evaluation"]
    per_life = {"mode": "per life", **evaluation["rewards_per_life"]}
    rows = {"training": result["training"], "evaluation": evaluation, "number of rewards": per_life}
    for name, row in rows.items():
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
    games = [make_atari(args.env_id, **game_options(args)) for _ in range(args.num_envs)]
    if args.capture_video:
        check_video(args)
    frames_per_step, obs_shape = args.num_envs * args.frame_skip, games[0].observation_space.shape
    between = max(args.checkpoint_interval // frames_per_step, 1) + 1  # rows of two checkpoints, at most
    spare = 2 * min(between, args.num_iterations)
    rows = min(args.buffer_size // args.num_envs, args.num_iterations)
    row_bytes = args.num_envs * row_type(obs_shape[1:]).itemsize
    check_disk(args, "--buffer-size", args.buffer_size, (rows + spare) * row_bytes)
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

    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    torch.set_num_threads(args.num_threads)
    torch.set_flush_denormal(True)  # Adam's means of gradients that have vanished: several times slower otherwise
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    stop = StopSignal()

    num_actions = int(games[0].action_space.n)
    shapes = obs_shape, num_actions, args.hidden_size
    bf16 = args.bf16 and has_bf16(device)
    if args.bf16 and not bf16:
        print("--bf16: no bfloat16 instructions here, goes on in float32", file=sys.stderr)
    learner = Learner(lambda: AtariQNetwork(*shapes, args.dueling, bf16), args, device)
    players = Players(games, args)
    added = 0 if checkpoint is None else checkpoint["added"]
    is_trained = checkpoint is not None and checkpoint["iteration"] >= last_iteration  # only its end is done again
    buffer = None if is_trained else ReplayBuffer(run_dir / "replay.dat", rows, spare, args.num_envs, obs_shape, added)
    rng = np.random.default_rng(np.random.SeedSequence(args.seed))
    means = Means()
    iteration, training_seconds, offsets = 0, 0.0, {"episodes": 0, "updates": 0}
    if checkpoint is None:
        for i in range(args.num_envs):
            players.start(i, 0)
    else:
        iteration, training_seconds = checkpoint["iteration"], checkpoint["training_seconds"]
        offsets = checkpoint["offsets"]
        learner.load_state_dict(checkpoint["learner"])
        rng.bit_generator.state = json.loads(checkpoint["rng"])
        vars(means).update(checkpoint["means"])
        if not players.load_state_dict(checkpoint["players"]):
            print("--resume: a replayed episode differs (another machine?), goes on with it", file=sys.stderr)
    threads = f"{args.num_threads} thread{'s' * (args.num_threads > 1)}"
    arithmetic = f"{'bfloat16' if bf16 else 'float32'} on {device.type}, {threads}"
    if checkpoint and checkpoint["arithmetic"] != arithmetic:
        was = checkpoint["arithmetic"]
        print(f"--resume: was {was}, goes on as {arithmetic}: bytes may differ", file=sys.stderr)
    greedy = greedy_policy(learner.agent, device)
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
        explores = rng.random(args.num_envs) < epsilon
        actions = rng.integers(num_actions, size=args.num_envs)
        if not explores.all():
            actions = np.where(explores, actions, greedy(players.obs))
        before, global_step = global_step, global_step + frames_per_step
        for episodic_return, length in players.step(actions, buffer):
            episodes_csv.write(
                {"global_step": global_step, "episodic_return": episodic_return, "episodic_length": length}
            )
            charts = {"charts/episodic_return": episodic_return, "charts/episodic_length": length}
            add_scalars(writer, charts, global_step)
            progress.set_postfix_str(f"return {episodic_return:.1f}", refresh=False)

        if global_step >= args.learning_starts and buffer.added > max(args.frame_stack, args.n_step):
            for _ in range(global_step // args.train_frequency - before // args.train_frequency):
                minibatch = buffer.sample(args.batch_size, args.gamma, args.n_step, rng).to(device)
                means.add(learner.update(minibatch, remaining * args.learning_rate))
        if global_step // args.target_network_frequency > before // args.target_network_frequency:
            learner.copy_to_target()

        logs = global_step // LOG_INTERVAL > before // LOG_INTERVAL or iteration == args.num_iterations
        crossed = global_step // args.checkpoint_interval > before // args.checkpoint_interval
        if not (logs or crossed or stop.received or iteration == last_iteration):
            continue
        progress.update(global_step - progress.n)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        if not learner.is_finite():
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
                "learner": learner.state_dict(),
                "added": buffer.sync(),
                "rng": json.dumps(rng.bit_generator.state),
                "means": dict(vars(means)),
                "players": players.state_dict(),
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
    finish_run(learner.agent, args, run_dir, global_step, training_seconds, arithmetic, writer, device)
    writer.close()
    return 0


def finish_run(
    agent: AtariQNetwork,
    args: Args,
    run_dir: Path,
    global_step: int,
    seconds: float,
    arithmetic: str,
    writer,
    device: torch.device,
) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last."""
    evaluation = evaluate(agent, args, run_dir, device)
    for name in ("mean", "std", "min", "max"):
        writer.add_scalar(f"eval/episodic_return_{name}", evaluation[name], global_step)
    if args.save_model:
        model = safetensors.torch.save(agent.state_dict(), {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", model)
    if args.save_demos:
        save_demonstrations(agent, args, run_dir, device)
    plot_learning_curve(run_dir, args, evaluation)
    versions = {module.__name__: module.__version__ for module in (ale_py, cv2, gym, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": global_step,
        "complete": global_step == args.num_iterations * args.num_envs * args.frame_skip,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training": {"mode": "ε-greedy", **summary(read_episodes(run_dir)[-50:, 1])},
        "evaluation": evaluation,
        "arithmetic": arithmetic,
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
