"""Hybrid of reinforcement and imitation learning by policy distillation (thesis sections 2.3.2, 2.4.1 and 2.4.2).

    python cleanrl_thesis/distill_hybrid.py --teacher runs/apple_teacher             # the hybrid, α = 0.93
    python cleanrl_thesis/distill_hybrid.py --alpha 0                                # behaviour cloning of the human
    python cleanrl_thesis/distill_hybrid.py --alpha 1 --teacher runs/apple_teacher   # distillation of the DQN
    python cleanrl_thesis/distill_hybrid.py --teacher runs/apple_teacher --demos recordings/anna
    python cleanrl_thesis/distill_hybrid.py --env-id ALE/Gopher-v5 --bf16 --teacher runs/gopher_teacher      # α = 0.8

L_mix(π) = α E_s[− Σ_a π_RL⁽ᵀ⁾(a|s) log π(a|s)] + (1 − α) E_s[− Σ_a π_HE(a|s) log π(a|s)]: cross-entropy against the DQN's
softmax at temperature T (soft labels) and against the human's actions (hard labels), both over the human's states.

The teacher is a run of `dqn_apple.py` or `dqn_gopher.py` with `--save-model`. The human is by default a **synthetic** one: a
script with a reaction time, motor noise, keys that are held too long or too short, slips and lapses, calibrated to the mean
of Table 2.1's or 2.2's human row; it is made from no agent. `--demos` takes recordings instead. `--run-dir DIR --resume` can be sent
again after every crash: on the same machine the run ends with the same bytes.

| setting | value | source |
|---|---|---|
| frames, for testing | 16,000, of them 1,500 drawn at random; Gopher 55,000 and 5,000, each seen before an action of four game frames | sections 2.4.1, 2.4.2 |
| Adam's learning rate, dropout, α | 1e-4, 0.5, 0.93; Gopher 0.8 | sections 2.4.1, 2.4.2 |
| which network is kept | the one with the best test accuracy, α · (agrees with the DQN) + (1 − α) · (with the human); the last one is evaluated too | section 2.4.1 says test accuracy |
| T, network, batch, epochs | 0.01, 256-256 with ReLU, in Gopher behind the small convolutions of DQN's first paper, 64, 100 | ours, not given; benchmark/apple_alpha.sh compares T |
| split | by frame: neighbours of a test frame are trained on; `--split episode` keeps whole episodes apart | section 2.4.1; ours |

Demonstrations of Atari hold seeds and actions; their frames, 28 kB each as stacks of four, are made again in memory (1.6 GB, for
a moment twice that; three times with `--states own`).
People play frame by frame (`record_human.py`): each of their frames is one to learn from, seen as an agent would see it there.
The number of rewards in each life, the unit in which Table 2.2 seems to count (`benchmark/results/README.md`), is in `evaluation.json` beside
the points.
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "ale-py>=0.11",
#     "gymnasium>=1.2",
#     "matplotlib>=3.9",
#     "numpy>=2.0",
#     "opencv-python-headless>=4.10",
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import ale_py
import cv2
import gymnasium as gym
import numpy as np
import PIL.Image
import PIL.ImageDraw
import PIL.ImageFont
import safetensors
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
    exp_name: str = "distill_hybrid"
    """the name of this experiment"""
    seed: int = 1
    """seed of the experiment, and of the synthetic human's demonstrations"""
    torch_deterministic: bool = True
    """sets `torch.backends.cudnn.deterministic`"""
    cuda: bool = False
    """train on the GPU where there is one; off by default, for small networks spend their time in launching kernels"""
    num_threads: int = 1
    """threads of torch; one is fastest for these networks and lets a sweep fill the machine with runs"""
    compile: bool = False
    """run each update step as one compiled graph (needs a C++ compiler; compiling takes seconds, once)"""
    bf16: bool = False
    """the student's first layers and Atari's DQN in bfloat16: faster where the processor has instructions for it"""
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
    """episodes of the student to write into `demos/`, one .npz each and a manifest"""
    eval_episodes: int | None = None
    """episodes of the evaluation at the end, sampled and greedy; default: 400 (section 2.4.1), Atari 100"""
    eval_mode: Literal["sampled", "greedy"] = "sampled"
    """mode of video and demonstrations: sample from the policy, or take its most probable action (in Atari with 1% random ones)"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 10
    """epochs between checkpoints"""
    stop_at: int | None = None
    """end at this epoch of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: str = "AppleGame-v0"
    """the environment: AppleGame-v0, ALE/Gopher-v5, or with `--demos` another ALE/*-v5 or a Gymnasium id with flat Box or
    image observations (channels first, uint8) and Discrete actions; flat ones enter as they are, best within about ±1"""
    teacher: Path | None = None
    """folder of the DQN's run, with `model.safetensors`; needed for α > 0"""
    demos: Path | None = None
    """folder of recorded demonstrations; default: the synthetic human's are made and put into `demos_synthetic_human/`"""
    demo_frames: int | None = None
    """frames of the human, and with `--states own` of the DQN; default: 16,000 (section 2.4.1), Atari 55,000 (2.4.2), which are
    what an agent sees before each action of four game frames, or a person at every game frame"""
    test_frames: int | None = None
    """frames kept for testing; default: 1,500 (section 2.4.1), Atari 5,000 (section 2.4.2)"""
    split: Literal["frame", "episode"] = "frame"
    """draw the test set by frame (section 2.4.1) or by episode"""
    alpha: float | None = None
    """α, weight of the DQN against the human; default: 0.93 (section 2.4.1), Atari 0.8 (section 2.4.2)"""
    temperature: float = 0.01
    """T of the soft labels; 0 makes them hard (section 2.3.2; the value is ours)"""
    states: Literal["human", "own"] = "human"
    """states of the DQN's term: the human's, or those of the DQN's own play (section 2.3.2)"""
    epochs: int = 100
    """passes over the training set (ours)"""
    batch_size: int = 64
    """frames per update (ours)"""
    learning_rate: float = 1e-4
    """Adam's learning rate (section 2.4.1)"""
    dropout: float = 0.5
    """share of hidden units left out in training (section 2.4.1)"""
    hidden_size: int = 256
    """units in each of the two hidden layers (ours)"""


DEFAULTS = {"demo_frames": 16_000, "test_frames": 1_500, "alpha": 0.93, "eval_episodes": 400}
ATARI_DEFAULTS = {"demo_frames": 55_000, "test_frames": 5_000, "alpha": 0.8, "eval_episodes": 100}


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


def is_atari(env_id: str) -> bool:
    return env_id.startswith("ALE/")


def complete_args(args: Args) -> Args:
    """Fill in the values that follow from others, and check all. Raises UsageError."""
    for name, value in (ATARI_DEFAULTS if is_atari(args.env_id) else DEFAULTS).items():
        if getattr(args, name) is None:
            setattr(args, name, value)
    args.stop_at = args.epochs if args.stop_at is None else args.stop_at
    counts = "eval_episodes checkpoint_interval stop_at demo_frames test_frames epochs batch_size hidden_size"
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("temperature", lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("alpha", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("dropout", lambda x: 0 <= x < 1, "must be at least 0 and less than 1"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos", lambda x: x >= 0, "must be at least 0"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    allowed = f"must be less than --demo-frames, {args.demo_frames}"
    require(args.test_frames < args.demo_frames, "--test-frames", args.test_frames, allowed)
    needs_teacher = args.alpha > 0 and args.teacher is None
    require(
        not needs_teacher,
        "--alpha",
        args.alpha,
        "needs --teacher, the folder of a run of dqn_apple.py or dqn_gopher.py --save-model",
    )
    together = args.states == "human" or args.teacher is not None and args.split == "frame"
    require(together, "--states", "own", "needs --teacher, and --split frame: the DQN's frames are of other episodes")
    known = args.demos is not None or args.env_id.split(":")[-1] in SYNTHETIC_HUMANS
    require(
        known, "--env-id", args.env_id, f"needs --demos; only {' and '.join(SYNTHETIC_HUMANS)} have a synthetic human"
    )
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


# ---------------------------------------------------------------------------------------------------------------------
# Atari
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


# ---------------------------------------------------------------------------------------------------------------------
# Environments
# ---------------------------------------------------------------------------------------------------------------------
def is_image(space: gym.Space) -> bool:
    """Whether observations are images, (C, H, W) uint8, large enough for the convolutions."""
    shape = space.shape if isinstance(space, gym.spaces.Box) and space.dtype == np.uint8 else ()
    return len(shape) == 3 and min(shape[1:]) >= 20


def make_env(env_id: str, render_mode: str | None = None) -> gym.Env:
    """Make an environment with flat `Box` or image observations and `Discrete` actions. Raises UsageError."""
    if is_atari(env_id):
        return make_atari(env_id, render_mode)
    drawn = {} if render_mode is None else {"render_mode": render_mode}  # not every environment knows the word
    try:
        env = gym.make(env_id, disable_env_checker=True, **drawn)
    except (gym.error.Error, AttributeError, ImportError, OSError, TypeError, ValueError) as error:
        raise UsageError(f"--env-id {env_id}: {first_line(error)}") from None
    space, actions = env.observation_space, env.action_space
    is_flat = isinstance(space, gym.spaces.Box) and len(space.shape) == 1
    allowed = "needs flat Box observations or images, (C, H, W) uint8 and at least 20 x 20; this one has"
    require(is_flat or is_image(space), "--env-id", env_id, f"{allowed} {space}")
    is_discrete = isinstance(actions, gym.spaces.Discrete) and actions.start == 0
    require(is_discrete, "--env-id", env_id, f"needs Discrete actions from 0, this one has {actions}")
    return env


# ---------------------------------------------------------------------------------------------------------------------
# The synthetic human
# ---------------------------------------------------------------------------------------------------------------------
class SyntheticHuman:
    """A scripted player with a person's limits, for N Apple games at once; it is made from no agent.

    It notices an apple after a reaction time. Then it presses the key of each axis, of one a little later than of the
    other, for as long as the way seems to need; looks where that has led, and corrects. Times are in frames. Calibrated
    by hand to the mean of Table 2.1's human row, 18.71 ± 2.86: 18.8 ± 3.4 as measured by benchmark/apple_players.py.
    """

    reaction, reaction_spread = 17.0, 0.25  # median time to notice a new apple, and its deviation as a share
    lapse, lapse_frames = 0.05, (15.0, 45.0)  # how often the mind is elsewhere, and for how much longer
    lag = 4.0  # mean time from the first axis' key to the second's
    hold_spread, hold_error, shortest_hold = 0.12, 2.0, 4.0  # of a key press: as a share, in frames, and the least
    pause, pause_spread = 9.0, 0.3  # median time from letting go of a key to the next look, and its deviation
    slip = 0.02  # how often the opposite key is pressed
    tolerance = 0.5  # distance on an axis that it takes for none, as a share of the reach

    def __init__(self, num_games: int, seed: int):
        self.rng = np.random.default_rng(np.random.SeedSequence([seed, HUMAN_STREAM]))
        self.frame = 0
        self.apples = np.full((num_games, 2), np.nan, np.float32)  # on the plane
        self.aims = np.zeros((num_games, 2), np.float32)  # noticed
        self.notices = np.full(num_games, np.inf)  # frame at which the new apple is noticed
        self.keys = np.zeros((num_games, 2), np.int64)  # -1, 0 or 1 on each axis
        self.acts = np.full((num_games, 2), np.inf)  # frame of the axis' next change

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Observations (N, 6) of the next frame -> actions (N,)."""
        avatars, apples = obs[:, :2], obs[:, 2:4]
        self.expect((apples != self.apples).any(1))
        self.apples = apples.copy()
        self.notice(self.frame >= self.notices)
        self.act(*np.nonzero(self.frame >= self.acts), avatars)
        self.frame += 1
        return (self.keys[:, 1] + 1) * 3 + self.keys[:, 0] + 1

    def expect(self, new: np.ndarray) -> None:
        """Draw the time at which each new apple will be noticed; `new` (N,) says where there is one."""
        count = int(new.sum())
        times = self.reaction * np.exp(self.reaction_spread * self.rng.standard_normal(count))
        times += (self.rng.random(count) < self.lapse) * self.rng.uniform(*self.lapse_frames, count)
        self.notices[new] = self.frame + times

    def notice(self, now: np.ndarray) -> None:
        """Let go of the keys and aim at the apple, where `now` (N,) says so."""
        count = int(now.sum())
        self.aims[now], self.keys[now], self.notices[now] = self.apples[now], 0, np.inf
        second = self.rng.integers(0, 2, count)
        delays = np.zeros((count, 2))
        delays[np.arange(count), second] = self.lag * self.rng.exponential(size=count)
        self.acts[now] = self.frame + delays

    def act(self, games: np.ndarray, axes: np.ndarray, avatars: np.ndarray) -> None:
        """Press or let go of the keys of the given games and axes; draw until when."""
        ways = (self.aims - avatars)[games, axes]
        spread, error, rest = self.rng.standard_normal((3, len(games)))
        slips = self.rng.random(len(games)) < self.slip
        presses = (self.keys[games, axes] == 0) & (np.abs(ways) > self.tolerance * float(REACH))
        pauses = self.pause * np.exp(self.pause_spread * rest)
        holds = np.abs(ways) / float(SPEED) * np.exp(self.hold_spread * spread) + self.hold_error * error
        holds = np.where(slips, pauses, np.maximum(holds, self.shortest_hold))
        self.keys[games, axes] = np.where(presses, np.sign(ways) * np.where(slips, -1, 1), 0)
        self.acts[games, axes] = self.frame + np.where(presses, holds, pauses)


FARMER_X, GOPHER_X, SCENE, GOPHER_Y = 31, 41, 82, 85  # bytes of the console's memory
IN_PLAY, RISING, ABOVE_GROUND = 7, 14, 35  # values of the scene, and heights of the gopher
HOLES = np.array([15, 31, 47, 111, 127, 143])  # where they can be, in pixels from the left
HOLE_BYTES, HOLE_BITS = np.array([0, 1, 1, 4, 4, 5]), np.array([128, 24, 1, 24, 1, 24])  # in each of the garden's rows
NOOP, FIRE, GO_RIGHT, GO_LEFT, RIGHT_FIRE, LEFT_FIRE = 0, 1, 3, 4, 6, 7
ROWS, ROW_BYTES = 3, 6  # of the garden above the tunnel, from the surface down
SHOVEL, BONK = 4, 3  # how far right of a hole, or of the gopher, the farmer has to stand


class SyntheticGopherHuman:
    """A scripted player of Gopher with a person's limits; it is made from no agent, and reads the console's memory.

    It sees everything late, but knows where its own hands are. It runs to where the gopher comes up, else to the deepest hole
    nearby, stops a little off, and taps the button; now and then its mind is elsewhere. Calibrated by hand to the mean of
    Table 2.2's human row, in rewards per life: see benchmark/gopher_players.py.
    """

    reaction = 4  # how late it sees, in actions of 4 frames: 267 ms
    aim_error = 2.5  # deviation of the place where it wants to stand, in pixels, for each new aim
    close_enough = 3.0  # pixels from there
    taps = (2, 5)  # actions from one press of the button to the next, at least, and at most one less
    lapse, lapse_actions = 0.005, 8.0  # how often the mind is elsewhere, per action, and for how many on average

    def __init__(self, seed: int, episode: int):
        self.rng = np.random.default_rng(np.random.SeedSequence([seed, HUMAN_STREAM, episode]))
        self.seen: list[np.ndarray] = []  # the memory at the last actions, oldest first
        self.aim, self.error = None, 0.0
        self.actions, self.next_tap, self.awake_at = 0, 0, 0

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """The console's memory (1, 1, 128) -> action (1,)."""
        memory = obs[0, -1].astype(int)
        self.seen = [*self.seen, memory][-self.reaction - 2 :]
        self.actions += 1
        late = max(0, len(self.seen) - 1 - self.reaction)
        return np.array([self.act(int(memory[FARMER_X]), self.seen[max(0, late - 1)], self.seen[late])])

    def act(self, farmer: int, earlier: np.ndarray, late: np.ndarray) -> int:
        """The action, by what was seen `reaction` actions ago, and one before."""
        if self.actions < self.awake_at:
            return NOOP
        if self.rng.random() < self.lapse:
            self.awake_at = self.actions + self.rng.exponential(self.lapse_actions)
        if late[SCENE] != IN_PLAY:
            return self.tap(NOOP)
        aim, place, reach = self.choose(farmer, earlier, late)
        if aim != self.aim:
            self.aim, self.error = aim, self.rng.normal(0, self.aim_error)
        way = place + self.error - farmer
        move = NOOP if abs(way) <= self.close_enough else GO_RIGHT if way > 0 else GO_LEFT
        return self.tap(move) if abs(place - farmer) <= reach else move

    def choose(self, farmer: int, earlier: np.ndarray, late: np.ndarray) -> tuple[str | int, float, float]:
        """What it is about, where the farmer should stand for it, and from how far away it begins to tap."""
        height, gopher = late[GOPHER_Y], late[GOPHER_X]
        speed = gopher - earlier[GOPHER_X] if abs(gopher - earlier[GOPHER_X]) < 20 else 0
        garden = late[: ROWS * ROW_BYTES].reshape(ROWS, ROW_BYTES)
        depths = ((garden[:, HOLE_BYTES] & HOLE_BITS) > 0).sum(0)  # rows that are dug, of each hole
        if height >= ABOVE_GROUND:
            return "running", gopher + speed * self.reaction + BONK, 9
        if height >= RISING and depths[np.abs(HOLES - gopher).argmin()] == ROWS:
            return "rising", gopher + BONK, 6 if height >= ABOVE_GROUND - 5 else -1
        if depths.max() > 0:
            hole = int((depths - np.abs(HOLES + SHOVEL - farmer) / 60).argmax())
            return hole, HOLES[hole] + SHOVEL, 4
        return "nothing", 80, -1

    def tap(self, move: int) -> int:
        """Press the button besides, if it is time to."""
        if self.actions < self.next_tap:
            return move
        self.next_tap = self.actions + self.rng.integers(*self.taps)
        return {NOOP: FIRE, GO_RIGHT: RIGHT_FIRE, GO_LEFT: LEFT_FIRE}[move]


SYNTHETIC_HUMANS = ("AppleGame-v0", "ALE/Gopher-v5")


# ---------------------------------------------------------------------------------------------------------------------
# Networks: the teachers, and the student
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


def convolutions(channels: int) -> nn.Sequential:
    """The convolutions of Mnih et al. (2013), smaller than the DQN's, for images (M, C, H, W)."""
    layers = nn.Conv2d(channels, 16, 8, 4), nn.Conv2d(16, 32, 4, 2)
    return nn.Sequential(*(part for layer in layers for part in (layer, nn.ReLU())), nn.Flatten())


class Student(nn.Module):
    """π(a|s) as a network of two hidden layers, over convolutions where observations are images."""

    def __init__(self, obs_shape: tuple[int, ...], num_actions: int, hidden_size: int, bf16: bool = False):
        super().__init__()
        self.convolutions, features, self.bf16 = None, obs_shape[0], bf16
        if len(obs_shape) == 3:
            self.convolutions = convolutions(obs_shape[0])
            features = self.convolutions(torch.zeros(1, *obs_shape)).shape[1]
        self.layers = nn.ModuleList(
            [nn.Linear(features, hidden_size), nn.Linear(hidden_size, hidden_size), nn.Linear(hidden_size, num_actions)]
        )

    def features(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (M, O) -> the same; images (M, C, H, W) of 0 to 255 -> (M, F)."""
        if self.convolutions is None:
            return obs.float()
        first, *others = self.convolutions
        x = obs.to(torch.bfloat16 if self.bf16 else torch.float32)  # exact: bfloat16 has all integers up to 256
        x = x.contiguous(memory_format=torch.channels_last)  # faster; and 255 divides the weights, which are fewer
        x = F.conv2d(x, first.weight / 255, first.bias, first.stride)
        for layer in others:
            x = layer(x)
        return x

    def forward(self, obs: torch.Tensor, masks: torch.Tensor | None = None) -> torch.Tensor:
        """Observations (M, O), or (M, C, H, W) uint8 -> logits (M, A); `masks` (2, M, H) multiply the hidden units."""
        first, second, output = self.layers
        with torch.autocast(obs.device.type, torch.bfloat16, enabled=self.bf16):
            hidden = torch.relu(first(self.features(obs)))
        hidden = hidden.float()
        hidden = torch.relu(second(hidden if masks is None else hidden * masks[0]))
        return output(hidden if masks is None else hidden * masks[1])


def draw_masks(shape: tuple[int, int, int], dropout: float) -> torch.Tensor:
    """Dropout masks, drawn outside of the network so that they are the same in a compiled graph: 0 or 1 / (1 − p)."""
    return (torch.rand(shape) >= dropout).float() / (1 - dropout)


# ---------------------------------------------------------------------------------------------------------------------
# Demonstrations and teacher
# ---------------------------------------------------------------------------------------------------------------------
EVALUATION_STREAM, DEMONSTRATION_STREAM = 1_000_000, 1_000_001
HUMAN_STREAM = 1_000_002
STUDENT_STREAM = 1_000_003  # of its demonstrations: other episodes than the teacher's, 1_000_001


@functools.lru_cache
def episode_seeds(seed: int, stream: int, block: int) -> list[int]:
    """Seeds of episodes 256 · block and on; a SeedSequence for each would take longer than the environment's reset."""
    return np.random.SeedSequence([seed, stream, block]).generate_state(256).tolist()


def episode_seed(seed: int, stream: int, episode: int) -> int:
    """Seed of an episode: sub-environment `stream` of run `seed`, or one of the streams that are not trained on."""
    return episode_seeds(seed, stream, episode // 256)[episode % 256]


ATARI_SKIP, ATARI_EPSILON = 4, 0.01  # frames of an action; random actions of greedy players, who could wait forever
RECORDED = {"frame_skip": ATARI_SKIP, "noop_max": 30}  # options of AtariGame that demonstrations have to share


class Frames(NamedTuple):
    """F frames of play."""

    obs: np.ndarray  # (F, O) float32, or images (F, C, H, W) uint8
    actions: np.ndarray  # (F,) int64
    episodes: np.ndarray  # (F,), number of the episode of each frame


def join_frames(episodes: list[dict[str, np.ndarray]], frames: int) -> Frames:
    """The first frames of a list of episodes."""
    numbers = [np.full(len(episode["actions"]), i) for i, episode in enumerate(episodes)]
    obs = np.concatenate([episode["observations"][:-1] for episode in episodes])
    actions = np.concatenate([episode["actions"] for episode in episodes])
    obs = obs[:frames] if obs.ndim == 4 else obs[:frames].astype(np.float32)
    return Frames(obs, actions[:frames].astype(np.int64), np.concatenate(numbers)[:frames])


def read_episode(path: Path, checksum: str, env: gym.Env, frame_skip: int = ATARI_SKIP) -> dict[str, np.ndarray]:
    """One demonstration. Raises UsageError where it is not what the manifest says, or is none of this environment."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"--demos {path}: cannot be read: {error.strerror}") from None
    same = hashlib.sha256(content).hexdigest() == checksum
    require(same, "--demos", path, "its SHA-256 is not the manifest's, the file was changed or damaged")
    atari = isinstance(env, AtariGame)
    names = ("actions", "rewards", *(("lives", "seed", "emulator_state") if atari else ("observations",)))
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            episode = {name: arrays[name] for name in names}
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise UsageError(f"--demos {path}: no demonstration: {first_line(error)}") from None
    actions, rewards, number = episode["actions"], episode["rewards"], int(env.action_space.n)
    if not atari:
        check_observations(path, episode["observations"], actions, env)
    inside = np.issubdtype(actions.dtype, np.integer) and bool(((actions >= 0) & (actions < number)).all())
    require(inside, "--demos", path, f"actions must be whole numbers from 0 to {number - 1}")
    scored = np.issubdtype(rewards.dtype, np.number) and rewards.shape == actions.shape and np.isfinite(rewards).all()
    require(bool(scored), "--demos", path, "rewards must be finite numbers (T,)")
    if atari:
        seed = episode["seed"]
        seeded = seed.shape == () and np.issubdtype(seed.dtype, np.integer) and seed >= 0
        allowed = "needs actions (T,), and as seed a whole number from 0 on"
        require(actions.ndim == 1 and bool(seeded), "--demos", path, allowed)
        lives = episode["lives"]
        counted = lives.shape == actions.shape and np.issubdtype(lives.dtype, np.integer)
        require(counted, "--demos", path, "lives must be whole numbers (T,)")
        episode["observations"] = watch(env, episode) if frame_skip == ATARI_SKIP else watch_frames(env, episode)
        allowed = "gives other rewards when it is played again: of another version of ale-py?"
        require(episode["observations"] is not None, "--demos", path, allowed)
    return episode


def check_observations(path: Path, observations: np.ndarray, actions: np.ndarray, env: gym.Env) -> None:
    """Raise UsageError where they do not fit actions and environment."""
    shape = env.observation_space.shape
    fits = actions.ndim == 1 and observations.shape == (len(actions) + 1, *shape)
    allowed = f"observations must be (T + 1, {', '.join(map(str, shape))}) and actions (T,), they are"
    require(fits, "--demos", path, f"{allowed} {observations.shape} and {actions.shape}")
    finite = np.issubdtype(observations.dtype, np.number) and bool(np.isfinite(observations).all())
    require(finite, "--demos", path, "observations must be finite numbers")
    same_kind = not is_image(env.observation_space) or observations.dtype == np.uint8
    require(same_kind, "--demos", path, f"observations must be uint8, they are {observations.dtype}")


def watch(game: AtariGame, episode: dict[str, np.ndarray]) -> np.ndarray | None:
    """What a game shows when an episode is played again, (T + 1, S, 84, 84); None where it goes another way."""
    observations = [game.reset(seed=int(episode["seed"]))[0]]
    state = game.emulator.cloneState(include_rng=True).__getstate__()
    same = state == episode["emulator_state"].tobytes()
    for action, reward in zip(episode["actions"].tolist(), episode["rewards"].tolist()):
        obs, points, _, _, _ = game.step(action)
        observations.append(obs)
        same = same and points == reward
    return np.stack(observations) if same else None


def watch_frames(game: AtariGame, episode: dict[str, np.ndarray]) -> np.ndarray | None:
    """The same where each frame has an action, as people play: (T + 1, S, 84, 84), stacks as an agent would see them.

    An agent that acts at this frame, and has acted for 4 frames each time before, sees this one and those 4, 8 and 12 ago.
    """
    first = game.reset(seed=int(episode["seed"]))[0][-1]
    state = game.emulator.cloneState(include_rng=True).__getstate__()
    same = state == episode["emulator_state"].tobytes()
    ages = np.arange(len(game.stack) - 1, -1, -1) * game.frame_skip
    screen, frames = game.screens[0].copy(), [first] * (ages[0] + 1)
    for action, reward in zip(episode["actions"].tolist(), episode["rewards"].tolist()):
        same = same and game.emulator.act(game.moves[action]) == reward
        game.screens[1] = screen
        game.look(0)
        screen = game.screens[0].copy()
        frames.append(game.frame())
    steps = np.arange(ages[0], len(frames))
    return np.stack(frames)[steps[:, None] - ages] if same else None


def read_demonstrations(folder: Path, env_id: str, frames: int) -> list[dict[str, np.ndarray]]:
    """Episodes of a folder in the order of their names, until there are so many frames. Raises UsageError."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        files, recorded, version = dict(manifest["files"]), str(manifest["env_id"]), manifest["version"]
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"--demos {folder}: holds no demonstrations, it has no readable manifest.json") from None
    require(version == 1, "--demos", folder, f"its manifest is of version {version}, this script reads version 1")
    require(bool(files), "--demos", folder, "holds no demonstrations, its manifest names no file")
    same_game = recorded.split(":")[-1] == env_id.split(":")[-1]
    require(same_game, "--demos", folder, f"was recorded in {recorded}, --env-id is {env_id}")
    env, frame_skip = make_env(env_id), ATARI_SKIP
    if is_atari(env_id):
        options = manifest["options"] if isinstance(manifest.get("options"), dict) else {}
        frame_skip = options.get("frame_skip")
        same = frame_skip in (1, ATARI_SKIP) and options.get("noop_max") == RECORDED["noop_max"]
        require(same, "--demos", folder, f"was recorded with {options}, needs {RECORDED} or a frame_skip of 1")
    episodes: list[dict[str, np.ndarray]] = []
    for name, checksum in sorted(files.items()):
        if sum(len(episode["actions"]) for episode in episodes) < frames:
            episodes.append(read_episode(folder / name, checksum, env, frame_skip))
    return episodes


def make_human_demonstrations(args: Args) -> list[dict[str, np.ndarray]]:
    """Episodes of the synthetic human, enough for `--demo-frames`."""
    if is_atari(args.env_id):
        return make_gopher_demonstrations(args)
    count = math.ceil(args.demo_frames / EPISODE_FRAMES)
    seeds = [episode_seed(args.seed, HUMAN_STREAM, i) for i in range(count)]
    return play(SyntheticHuman(count, args.seed), args.env_id, seeds, keep=True)


def make_gopher_demonstrations(args: Args) -> list[dict[str, np.ndarray]]:
    """The same in Gopher: the human reads the memory, then each episode is played again for its frames."""
    episodes, frames, game = [], 0, make_env(args.env_id)
    make_game = functools.partial(make_atari, args.env_id, obs_type="ram", frame_stack=1)
    while frames < args.demo_frames:
        human = SyntheticGopherHuman(args.seed, len(episodes))
        episode = play_atari(human, make_game, [episode_seed(args.seed, HUMAN_STREAM, len(episodes))])[0]
        episodes.append({**episode, "observations": watch(game, episode)})
        frames += len(episode["actions"])
    return episodes


def load_teacher(folder: Path, env_id: str, bf16: bool = False) -> QNetwork | AtariQNetwork:
    """The network of a run of dqn_apple.py, or for Atari of dqn_gopher.py. Raises UsageError."""
    path, script = folder / "model.safetensors", "dqn_gopher.py" if is_atari(env_id) else "dqn_apple.py"
    require(path.exists(), "--teacher", folder, f"has no model.safetensors; train it with {script} --save-model")
    try:
        with safetensors.safe_open(path, "pt") as file:
            args = json.loads(file.metadata()["args"])
        trained_on = str(args["env_id"])
    except (safetensors.SafetensorError, OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"--teacher {path}: is no model of {script}: {first_line(error)}") from None
    same_game = trained_on.split(":")[-1] == env_id.split(":")[-1]
    require(same_game, "--teacher", folder, f"was trained on {trained_on}, --env-id is {env_id}")
    skip, own_skip = args.get("frame_skip"), ATARI_SKIP if is_atari(env_id) else 1
    require(skip == own_skip, "--teacher", folder, f"acts once in {skip} frames, the student in {own_skip}")
    env = make_env(env_id)
    try:
        shape, num_actions = env.observation_space.shape, int(env.action_space.n)
        if is_atari(env_id):
            teacher = AtariQNetwork(shape, num_actions, args["hidden_size"], args["dueling"], bf16)
        else:
            teacher = QNetwork(shape[0], num_actions, args["hidden_size"], args["dueling"])
        teacher.load_state_dict(safetensors.torch.load_file(path))
    except (safetensors.SafetensorError, KeyError, TypeError, RuntimeError) as error:
        raise UsageError(f"--teacher {path}: its network has another shape: {first_line(error)}") from None
    return teacher


# ---------------------------------------------------------------------------------------------------------------------
# The algorithm
# ---------------------------------------------------------------------------------------------------------------------
def soft_labels(q_values: torch.Tensor, temperature: float) -> torch.Tensor:
    """π_RL⁽ᵀ⁾(·|s), (F, A): softmax(Q / T), and for T = 0 one on the best action (section 2.3.2)."""
    if temperature == 0:
        return F.one_hot(q_values.argmax(1), q_values.shape[1]).float()
    return torch.softmax(q_values / temperature, 1)


def hybrid_loss(
    rl_logits: torch.Tensor, rl_labels: torch.Tensor, he_logits: torch.Tensor, he_actions: torch.Tensor, alpha: float
) -> tuple[torch.Tensor, tuple[torch.Tensor, torch.Tensor]]:
    """L_mix of section 2.3.2 and its two terms, the DQN's and the human's.

    Logits are the student's in the states of each term, (M, A); rl_labels (M, A), he_actions (M,).
    """
    rl_loss = -(rl_labels * F.log_softmax(rl_logits, 1)).sum(1).mean()
    he_loss = F.cross_entropy(he_logits, he_actions)
    return alpha * rl_loss + (1 - alpha) * he_loss, (rl_loss.detach(), he_loss.detach())


class Data(NamedTuple):
    """F frames to learn from; row i of the first two and of the last two need not be the same frame."""

    rl_obs: torch.Tensor  # (F, O) or images, states of the DQN's term
    rl_labels: torch.Tensor  # (F, A), π_RL⁽ᵀ⁾ there
    he_obs: torch.Tensor  # (F, O) or images, states of the human's term
    he_actions: torch.Tensor  # (F,)

    def shares_states(self) -> bool:
        """Whether the DQN's term is over the human's states."""
        return self.rl_obs is self.he_obs

    def at(self, frames: torch.Tensor) -> "Data":
        """The frames of the given indices, or where a mask says so."""
        he_obs = self.he_obs[frames]
        rl_obs = he_obs if self.shares_states() else self.rl_obs[frames]
        return Data(rl_obs, self.rl_labels[frames], he_obs, self.he_actions[frames])

    def to(self, device: torch.device) -> "Data":
        he_obs = self.he_obs.to(device)
        rl_obs = he_obs if self.shares_states() else self.rl_obs.to(device)
        return Data(rl_obs, self.rl_labels.to(device), he_obs, self.he_actions.to(device))


def split_frames(episodes: np.ndarray, test_frames: int, by: str, rng: np.random.Generator) -> np.ndarray:
    """Which frames are for testing, (F,) bool: drawn at random, or whole episodes until there are enough."""
    if by == "frame":
        order = rng.permutation(len(episodes))
        return np.isin(np.arange(len(episodes)), order[:test_frames])
    order = rng.permutation(np.unique(episodes))
    sizes = np.cumsum([(episodes == episode).sum() for episode in order])
    return np.isin(episodes, order[: np.searchsorted(sizes, test_frames) + 1])


def views(vector: torch.Tensor, shapes: list[torch.Size]) -> list[torch.Tensor]:
    """Cut a vector into tensors of the given shapes, without a copy."""
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes)]


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


class Update:
    """One step of Adam on one minibatch; all parameters are one vector, of which the student's become views."""

    def __init__(self, student: Student, args: Args, minibatch: Data):
        self.student, self.args = student, args
        self.names = [name for name, _ in student.named_parameters()]
        self.shapes = [parameter.shape for parameter in student.parameters()]
        self.vector = torch.cat([parameter.detach().reshape(-1) for parameter in student.parameters()])
        self.mean, self.square = torch.zeros_like(self.vector), torch.zeros_like(self.vector)
        self.count = torch.zeros((), device=self.vector.device)
        for parameter, value in zip(student.parameters(), views(self.vector, self.shapes)):
            parameter.data = value
        self.step, self.is_compiled = self.plain_step, False
        if args.compile:
            self.compile(minibatch)

    def compile(self, minibatch: Data) -> None:
        """Compile the step where a compiler is at hand; `minibatch` is an example."""
        compiler = os.environ.get("CXX", "g++")
        if shutil.which(compiler) is None:
            print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
            return
        compiled = torch.compile(self.plain_step, options={"cpp_wrapper": True})
        masks = self.vector.new_ones(2, len(minibatch.he_obs), self.args.hidden_size)
        try:
            torch.compiler.set_stance("default")
            with torch.no_grad():  # compiles, and changes nothing but copies
                compiled(*(tensor.clone() for tensor in self.state_dict().values()), minibatch, masks)
            torch.compiler.set_stance("default", skip_guard_eval_unsafe=True)  # every call is alike
            self.step, self.is_compiled = compiled, True
        except Exception as error:  # whatever the compiler's tool chain lacks, the plain step needs none of it
            print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)

    def loss(self, vector: torch.Tensor, minibatch: Data, masks: torch.Tensor):
        """L_mix as a function of the vector of parameters."""
        parameters = dict(zip(self.names, views(vector, self.shapes)))
        he_logits = torch.func.functional_call(self.student, parameters, (minibatch.he_obs, masks))
        rl_logits = he_logits
        if self.args.states == "own":  # by the flag, for a compiled graph cannot tell one tensor from another
            rl_logits = torch.func.functional_call(self.student, parameters, (minibatch.rl_obs, masks))
        return hybrid_loss(rl_logits, minibatch.rl_labels, he_logits, minibatch.he_actions, self.args.alpha)

    def plain_step(self, vector, mean, square, count, minibatch: Data, masks: torch.Tensor):
        """A step of Adam on `loss`; changes the first four, (P,) and a scalar, in place; returns the two terms of the loss."""
        gradient, parts = torch.func.grad(self.loss, has_aux=True)(vector, minibatch, masks)
        adam_step(vector, mean, square, count, self.args.learning_rate, gradient, math.inf, 1e-8)
        return parts

    def __call__(self, minibatch: Data, masks: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Change the student by a minibatch; return the two terms of the loss before the step."""
        with torch.no_grad():
            return self.step(*self.state_dict().values(), minibatch, masks)

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"vector": self.vector, "mean": self.mean, "square": self.square, "count": self.count}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        for name, tensor in self.state_dict().items():
            tensor.copy_(state[name])


@torch.no_grad()
def measure(student: Student, data: Data, args: Args) -> dict[str, float]:
    """Loss and agreement with each teacher on frames that are not trained on."""
    he_logits = torch.cat([student(part) for part in data.he_obs.split(5_000)])
    rl_logits = he_logits if data.shares_states() else torch.cat([student(part) for part in data.rl_obs.split(5_000)])
    loss, _ = hybrid_loss(rl_logits, data.rl_labels, he_logits, data.he_actions, args.alpha)
    agrees_rl = (rl_logits.argmax(1) == data.rl_labels.argmax(1)).float().mean().item()
    agrees_he = (he_logits.argmax(1) == data.he_actions).float().mean().item()
    accuracy = args.alpha * agrees_rl + (1 - args.alpha) * agrees_he
    agrees_rl = agrees_rl if args.teacher is not None else math.nan
    return {
        "test/loss": loss.item(),
        "test/accuracy": accuracy,
        "test/accuracy_rl": agrees_rl,
        "test/accuracy_human": agrees_he,
    }


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "distill_hybrid 2"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "eval_mode", "capture_video", "save_model", "save_demos")
FREE_ON_RESUME = {"run_dir", "resume", "stop_at", "checkpoint_interval", *FINISH}
FREE_ON_RESUME |= {"track", "wandb_project_name", "wandb_entity"}
FREE_ON_RESUME |= {"teacher", "demos"}  # what they hold is compared, not where it lies


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


def has_begun(run_dir: Path | None) -> bool:
    """Whether a folder holds more than what a crash left behind before the run began."""
    return run_dir is not None and run_dir.is_dir() and any(path.suffix != ".tmp" for path in run_dir.iterdir())


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


def rewards_per_life(episode: dict[str, np.ndarray]) -> list[int]:
    """How many rewards there were in each life of an episode: as Table 2.2 seems to count (`benchmark/results/README.md`)."""
    lost = np.flatnonzero(np.diff(episode["lives"]) < 0) + 2  # behind the step in which it was lost
    return [int((part > 0).sum()) for part in np.split(episode["rewards"], lost) if len(part)]


def check_video(env_id: str) -> None:
    """Raise UsageError where the environment cannot be drawn, before hours are spent on training."""
    try:
        env = make_env(env_id, "rgb_array")
        env.reset(seed=0)
        env.render()
        env.close()
    except Exception as error:  # each renderer has its own
        raise UsageError(f"--capture-video: cannot draw {env_id} here: {first_line(error)}") from None


def numpy_policy(student: Student, mode: str, seed: int):
    """The policy as a function of numpy arrays, observations (N, O) or images -> (N,): sampled, or its best action."""
    device = next(student.parameters()).device
    rng = np.random.default_rng([seed, 1])

    @torch.no_grad()
    def policy(obs: np.ndarray) -> np.ndarray:
        logits = student(torch.from_numpy(obs).to(device)).cpu().numpy()
        if mode == "sampled":
            logits = logits + rng.gumbel(size=logits.shape)  # the largest of these is a sample of the softmax
        return logits.argmax(1)

    return policy


def record_video(episode: dict[str, np.ndarray], args: Args, run_dir: Path) -> None:
    """Play an episode again by its seed and actions and write it into `videos/`."""
    env = gym.wrappers.RecordVideo(make_env(args.env_id, "rgb_array"), str(run_dir / "videos"), lambda episode: True)
    env.reset(seed=int(episode["seed"]))
    for action in episode["actions"].tolist():
        env.step(action)
    env.close()


def play_student(student: Student, mode: str, args: Args, seeds: list[int], keep: bool = False) -> list[dict]:
    """One episode of the student for each seed; see `play` and `play_atari`."""
    policy = numpy_policy(student, mode, args.seed)
    if not is_atari(args.env_id):
        return play(policy, args.env_id, seeds, keep=keep)
    if mode == "greedy":
        policy = epsilon_greedy_policy(policy, student.layers[-1].out_features, ATARI_EPSILON, args.seed)
    return play_atari(policy, functools.partial(make_env, args.env_id), seeds)


def evaluate(student: Student, update: Update, networks: dict[str, torch.Tensor], args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes with each network in each mode; write `evaluation.json` and, if asked, a video.

    `networks` are vectors of parameters (P,), by the prefix of their entries: `last_` for the last epoch's, none for the
    kept one's. The student is left with the last of them. Where both are the same network, it plays once.
    """
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    evaluation = {"env_id": args.env_id, "seeds": seeds}
    for name, vector in networks.items():
        update.vector.copy_(vector)
        if name == "" and not args.capture_video and torch.equal(vector, networks["last_"]):
            evaluation |= {mode: evaluation[f"last_{mode}"] for mode in ("sampled", "greedy")}
            continue
        for mode in ("sampled", "greedy"):
            episodes = play_student(student, mode, args, seeds, keep=args.capture_video)
            returns = [float(episode["rewards"].sum()) for episode in episodes]
            evaluation[name + mode] = {"mode": mode, **summary(returns), "returns": returns}
            if is_atari(args.env_id):
                lives = [score for episode in episodes for score in rewards_per_life(episode)]
                evaluation[name + mode] |= {"rewards_per_life": summary(lives), "lives": lives}
            if args.capture_video and name + mode == args.eval_mode:
                record_video(episodes[0], args, run_dir)
    write_json(run_dir / "evaluation.json", evaluation)
    return evaluation


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(student: Student, args: Args, run_dir: Path) -> None:
    """Write `--save-demos` episodes of the student into `demos/`."""
    seeds = [episode_seed(args.seed, STUDENT_STREAM, i) for i in range(args.save_demos)]
    episodes = play_student(student, args.eval_mode, args, seeds, keep=True)
    about = {"env_id": args.env_id, "player": f"{args.exp_name}, alpha {args.alpha}", "mode": args.eval_mode}
    save_episodes(run_dir / "demos", episodes, about)


def save_episodes(folder: Path, episodes: list[dict[str, np.ndarray]], about: dict) -> None:
    """Write demonstrations; those of Atari without observations, which seeds and actions give again."""
    if is_atari(about["env_id"]):
        episodes = [{name: each[name] for name in each if name != "observations"} for each in episodes]
        about = {**about, "options": RECORDED, "ale_py": ale_py.__version__}
    write_demonstrations(folder, episodes, about)


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


def plot_learning_curve(run_dir: Path, args: Args, best_epoch: int) -> None:
    """Draw `learning_curve.png`: the student's agreement with each teacher on the test frames, by epoch."""
    from matplotlib.figure import Figure

    with open(run_dir / "updates.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    epochs = [int(row["global_step"]) for row in rows]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    lines = {
        "test/accuracy_rl": "with the DQN's best action",
        "test/accuracy_human": f"with the {'synthetic human' if args.demos is None else 'human'}'s action",
    }
    for name, label in lines.items():
        if name != "test/accuracy_rl" or args.teacher is not None:
            axes.plot(epochs, [float(row[name]) for row in rows], label=label)
    axes.axvline(best_epoch, color="gray", linestyle=":", label="kept")
    axes.set_title(f"{args.env_id}, hybrid with α = {args.alpha}, T = {args.temperature}, seed {args.seed}")
    axes.set_xlabel("epoch")
    axes.set_ylabel(f"agreement on test frames, split by {args.split}")
    axes.legend(loc="best", fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    content = io.BytesIO()
    figure.savefig(content, dpi=150)
    write_whole(run_dir / "learning_curve.png", content.getvalue())


def print_table(result: dict) -> None:
    """Print the human's episodes and the student's, of the kept and of the last network, one line each."""
    print(f"{'':32}{'episodes':>9}{'mean':>11}{'std':>11}{'min':>11}{'max':>11}")
    rows = {f"human ({result['human']['player']})": result["human"]}
    rows |= {f"student, {mode}": result["evaluation"][mode] for mode in ("sampled", "greedy")}
    rows |= {f"of the last epoch, {mode}": result["evaluation"][f"last_{mode}"] for mode in ("sampled", "greedy")}
    for name, row in rows.items():
        numbers = "".join(f"{row[key]:>11.1f}" for key in ("mean", "std", "min", "max") if row[key] is not None)
        print(f"{name:32}{row['episodes']:>9}{numbers}")


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


def read_human(args: Args) -> list[dict[str, np.ndarray]]:
    """The human's episodes. Raises UsageError."""
    if args.demos is None:
        episodes = make_human_demonstrations(args)
    else:
        episodes = read_demonstrations(args.demos, args.env_id, args.demo_frames)
    available = sum(len(episode["actions"]) for episode in episodes)
    flag = "--demo-frames" if args.demos is None else f"--demos {args.demos}: --demo-frames"
    require(available >= args.demo_frames, flag, args.demo_frames, f"there are only {available}")
    return episodes


def label_frames(human: Frames, teacher: QNetwork | None, args: Args) -> Data:
    """The frames of both terms (section 2.3.2); without a teacher, for α = 0, the DQN's labels are zeros."""
    he_obs, he_actions = torch.from_numpy(human.obs), torch.from_numpy(human.actions)
    if teacher is None:
        num_actions = int(make_env(args.env_id).action_space.n)
        return Data(he_obs, torch.zeros(len(he_obs), num_actions), he_obs, he_actions)
    rl_obs = he_obs
    if args.states == "own":
        rl_obs = torch.from_numpy(join_frames(play_teacher(teacher, len(he_obs), args), len(he_obs)).obs)
    with torch.no_grad():
        q_values = torch.cat([teacher(part) for part in rl_obs.split(5_000)])
    return Data(rl_obs, soft_labels(q_values, args.temperature), he_obs, he_actions)


def play_teacher(teacher: QNetwork | AtariQNetwork, frames: int, args: Args) -> list[dict[str, np.ndarray]]:
    """The first episodes of the DQN with so many frames; in Atari with a hundredth of random actions."""
    episodes: list[dict[str, np.ndarray]] = []
    game, made, played = make_env(args.env_id), 0, 0
    while made < frames:
        seeds = [episode_seed(args.seed, DEMONSTRATION_STREAM, played + i) for i in range(10)]
        if is_atari(args.env_id):
            policy = greedy_policy(teacher, torch.device("cpu"))
            policy = epsilon_greedy_policy(policy, teacher.advantage.out_features, ATARI_EPSILON, seeds[0])
            new = play_atari(policy, functools.partial(make_env, args.env_id), seeds)
        else:
            new = play(numpy_greedy(teacher), args.env_id, seeds, keep=True)
        played += len(new)
        for episode in new:
            if made < frames:  # frames of Atari fill the memory
                seen = {"observations": watch(game, episode)} if is_atari(args.env_id) else {}
                episodes.append({**episode, **seen})
                made += len(episode["actions"])
    return episodes


def fingerprint(human: Frames, teacher: QNetwork | None) -> str:
    """SHA-256 of all that is learned from."""
    digest = hashlib.sha256(human.obs)
    digest.update(human.actions)
    for tensor in () if teacher is None else teacher.state_dict().values():
        digest.update(tensor.numpy().tobytes())
    return digest.hexdigest()


def train_epoch(update: Update, data: Data, training: torch.Tensor, args: Args) -> dict[str, float]:
    """One pass over the frames of the indices `training` in a random order; a last minibatch of fewer is left out."""
    sums, count = torch.zeros(2, device=data.rl_obs.device), 0
    for frames in training[torch.randperm(len(training))].split(args.batch_size):
        if len(frames) < args.batch_size and count:
            break
        masks = draw_masks((2, len(frames), args.hidden_size), args.dropout).to(sums.device)
        sums += torch.stack(update(data.at(frames.to(sums.device)), masks))
        count += 1
    rl_loss, he_loss = (sums / count).tolist()
    return {"losses/rl": rl_loss, "losses/human": he_loss}


def main(args: Args) -> int:
    """Train, evaluate and write everything into the run's folder. Returns the exit code."""
    args = complete_args(args)
    make_env(args.env_id).close()
    if args.capture_video:
        check_video(args.env_id)
    last_epoch = min(args.epochs, args.stop_at)
    begun = open_run_dir(args) if has_begun(args.run_dir) else None  # before the minutes that demonstrations take
    if begun and is_done(args.run_dir, args, last_epoch):
        print(f"{args.run_dir} is done")
        return 0
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    bf16 = args.bf16 and has_bf16(device)
    teacher_bf16 = args.bf16 and has_bf16(torch.device("cpu"))  # which labels the frames on the CPU
    teacher = None if args.teacher is None else load_teacher(args.teacher, args.env_id, teacher_bf16)
    human_episodes = read_human(args)
    torch.set_num_threads(args.num_threads)
    human = join_frames(human_episodes, args.demo_frames)
    if is_atari(args.env_id):  # gigabytes, which are in `human` now
        for episode in human_episodes:
            del episode["observations"]
    data = label_frames(human, teacher, args)
    split_rng = np.random.default_rng(np.random.SeedSequence([args.seed, 0]))
    is_test = torch.from_numpy(split_frames(human.episodes, args.test_frames, args.split, split_rng))
    require(not is_test.all(), "--split", args.split, f"leaves no episode to train on, with {args.test_frames} to test")
    run_dir, checkpoint = begun or open_run_dir(args)
    data_id = fingerprint(human, teacher)
    same_data = checkpoint is None or checkpoint["data"] == data_id
    require(same_data, "--resume", run_dir, "demonstrations or teacher are no longer those that the run began with")
    lost = checkpoint is None and (run_dir / "result.json").exists()
    require(not lost, "--resume", run_dir, "was finished with other flags, and its checkpoint is gone")
    write_json(run_dir / "args.json", arguments(args))
    print(run_dir)
    if args.track:
        start_wandb(args, run_dir)
    if args.demos is None:
        about = {"env_id": args.env_id, "player": "synthetic human", "mode": "scripted"}
        save_episodes(run_dir / "demos_synthetic_human", human_episodes, about)

    random.seed(args.seed)  # for environments that draw from these two; their resumed runs end with other bytes
    np.random.seed(args.seed)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    if args.bf16 and not bf16:
        print("--bf16: no bfloat16 instructions here, goes on in float32", file=sys.stderr)
    stop = StopSignal()

    data, test, training = data.to(device), data.at(is_test).to(device), torch.nonzero(~is_test).squeeze(1)
    shapes = tuple(data.he_obs.shape[1:]), data.rl_labels.shape[1], args.hidden_size
    student = Student(*shapes, bf16).to(device)
    update = Update(student, args, data.at(training[: args.batch_size].to(device)))
    kind, numbers = "compiled" if update.is_compiled else "plain", "bfloat16" if bf16 else "float32"
    arithmetic = f"{kind}, {numbers} on {device.type}"
    best = {"vector": update.vector.clone(), "accuracy": -1.0, "epoch": 0, **dict.fromkeys(("rl", "human"), 0.0)}
    epoch, training_seconds, offset = 0, 0.0, 0
    if checkpoint is not None:
        epoch, training_seconds, offset = checkpoint["epoch"], checkpoint["training_seconds"], checkpoint["offset"]
        update.load_state_dict(checkpoint["update"])
        best = checkpoint["best"]
        torch.set_rng_state(checkpoint["torch_rng"])
        if checkpoint["arithmetic"] != arithmetic:
            was = checkpoint["arithmetic"]
            print(f"--resume: was {was}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    updates_csv = CsvLog(run_dir / "updates.csv", offset)
    forget_end(run_dir, epoch < last_epoch)
    writer = SummaryWriter(str(run_dir), purge_step=epoch + 1)
    progress = tqdm(total=last_epoch, initial=epoch, unit="epoch", disable=None)
    last_time = time.perf_counter()

    while epoch < last_epoch:
        epoch += 1
        metrics = {**train_epoch(update, data, training, args), **measure(student, test, args)}
        if metrics["test/accuracy"] > best["accuracy"]:
            agreement = {"rl": metrics["test/accuracy_rl"], "human": metrics["test/accuracy_human"]}
            best = {"vector": update.vector.clone(), "accuracy": metrics["test/accuracy"], "epoch": epoch, **agreement}
        progress.update(1)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        updates_csv.write({"global_step": epoch, **metrics})
        add_scalars(writer, metrics, epoch)
        if not update.vector.isfinite().all():
            raise RunError(f"epoch {epoch}: the student's parameters are no longer finite (last metrics: {metrics})")

        if epoch % args.checkpoint_interval == 0 or stop.received or epoch == last_epoch:
            state = {
                "args": arguments(args),
                "arithmetic": arithmetic,
                "data": data_id,
                "epoch": epoch,
                "training_seconds": training_seconds,
                "offset": updates_csv.sync(),
                "update": update.state_dict(),
                "best": best,
                "torch_rng": torch.get_rng_state(),
            }
            writer.flush()
            save_checkpoint(run_dir, state)
        if stop.received and epoch < last_epoch:
            progress.close()
            writer.close()
            print(f"stopped by signal {stop.received} after epoch {epoch}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    human_returns = [float(episode["rewards"].sum()) for episode in human_episodes]
    human_summary = {"player": "synthetic human" if args.demos is None else "recorded", **summary(human_returns)}
    if is_atari(args.env_id):
        lives = [number for episode in human_episodes for number in rewards_per_life(episode)]
        human_summary["rewards_per_life"] = summary(lives)
    finish_run(student, update, args, run_dir, epoch, training_seconds, arithmetic, best, human_summary, writer)
    writer.close()
    return 0


def finish_run(
    student: Student,
    update: Update,
    args: Args,
    run_dir: Path,
    epoch: int,
    seconds: float,
    arithmetic: str,
    best: dict,
    human: dict,
    writer,
) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last."""
    networks = {"last_": update.vector.clone(), "": best["vector"]}
    evaluation = evaluate(student, update, networks, args, run_dir)
    modes = [name + mode for name in networks for mode in ("sampled", "greedy")]
    for mode in modes:
        for name in ("mean", "std", "min", "max"):
            writer.add_scalar(f"eval/episodic_return_{name}_{mode}", evaluation[mode][name], epoch)
    if args.save_model:
        model = safetensors.torch.save(student.state_dict(), {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", model)
    if args.save_demos:
        save_demonstrations(student, args, run_dir)
    plot_learning_curve(run_dir, args, best["epoch"])
    versions = {module.__name__: module.__version__ for module in (gym, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": epoch,
        "complete": epoch == args.epochs,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "human": human,
        "test": {
            "epoch": best["epoch"],
            "accuracy_rl": None if args.teacher is None else best["rl"],
            "accuracy_human": best["human"],
        },
        "evaluation": {
            mode: {name: value for name, value in evaluation[mode].items() if name not in ("returns", "lives")}
            for mode in modes
        },
        "arithmetic": arithmetic,
        "training_seconds": seconds,
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
