"""The hierarchical world model (HWM) alone: reconstruction and segmentation of episodes (thesis section 3.3, Fig. 3.4).

    python cleanrl_thesis/ppo_fourrooms.py --stop-at 1100000 --save-demos 2300 --run-dir runs/rooms      # the episodes
    python cleanrl_thesis/hwm_segment.py --demos runs/rooms/demos                                        # the default, rung (e)

It is trained to maximise J_HWM (Eq. 3.3.5) on 25,000 observation-action pairs; the other episodes of the folder are held out,
and measured as in section 3.5.1: z_0 from q(z), later z from p(z), w from q(w), the boundary m from p(m). `segmentation.json`
has each measure beside those of segmentations that know nothing; `figure_3_4.png` is Fig. 3.4. `--run-dir DIR --resume` can
be sent again after every crash: on the same machine the run ends with the same bytes.

| | thesis | here |
|---|---|---|
| v_t on COPY | not said | copied, as in VTA: drawn anew each step it would make z a fast variable |
| q(z_t), q(w_t) | mean field | q(v_t given c_t, o_t), used where z is read; q(y_t given h_t, z_t, o_t) |
| h_t | by Eq. 3.3.1 from z_t too, by its rule in section 3.3.2 not | from z_t too, the only way from z to w; `--no-h-sees-z`: not |
| q(m given O) | temporal convolution | three layers of width 3 and a linear one, which end at the borders of an episode |
| KL terms | weight 1 | z and w 0.1, balanced 0.8 as in Dreamer; m on its own scale |
| `--w-reset` | no | yes: w starts anew from z where z is read (VTA) |
| `--narrow-w`, `--no-decoder-sees-h`, `--no-decoder-sees-c` | no | yes: the decoder sees v and 4 noisy numbers of w in ±1, else w alone carries all and nothing holds a segment |
| `--budget` | no | the share of steps that may be read, annealed from all; more costs `--budget-price` each |
| forced reads and copies | no | in training a read after 20 steps without (`--max-segment-length`), and with `--max-segments` copies after so many (VTA); KL_m leaves these steps out, VTA trains q there |
| KL_z prices reads | yes | no (`--detach-kl-z`, VTA) |

Left alone, m collapses: z is never read again, or at every step. The settings tried against that are the rungs (a) to (g) of a
ladder (`benchmark/hwm_segment.sh`); the default is rung (e). Rung (a) is Eq. 3.3.1 to 3.3.7 but for forced reads and copies, the
weights of KL_z, KL_w and the reconstruction, the red channel's factor and the balance of the KL terms:
`--no-w-reset --no-narrow-w --decoder-sees-h --decoder-sees-c --no-detach-kl-z --budget-price 0 --boundary-bound 0
--read-bias 0 --stoch-w 16 --kl-m-scale 1 --max-segments 10`; rung (g), which draws reads to where z is foretold:
`--kl-z-scale 1 --no-c-sees-w --surprise-price 4 --foretell-copies 0.1 --total-updates 5000 --budget-updates 3200`, with
`--attempts 3` also the boundaries on which most of three models agree; the others are in `benchmark/hwm_segment.sh`.
Frames are shrunk and centred, and the agent's red counts more.
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "matplotlib>=3.9",
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
from typing import NamedTuple

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
    exp_name: str = "hwm_segment"
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
    """compile the step of the model (needs a C++ compiler; compiling takes a minute, once)"""
    track: bool = False
    """also log to Weights and Biases (`pip install wandb`)"""
    wandb_project_name: str = "cleanrl-thesis"
    """the project of Weights and Biases"""
    wandb_entity: str | None = None
    """the team of Weights and Biases"""
    save_model: bool = False
    """write `model.safetensors` at the end"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}, the environment that of `--demos`"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 200
    """updates between checkpoints"""
    stop_at: int | None = None
    """end at this update of all attempts together; `--resume` can finish the run later"""

    # Data
    demos: Path | None = None
    """folder of demonstrations with `states` and `rooms`, as `ppo_fourrooms.py --save-demos` writes it (section 3.4)"""
    train_pairs: int = 25_000
    """observation-action pairs to train on (section 3.4); the episodes after them are held out"""
    heldout_episodes: int = 400
    """episodes held out, at most (ours)"""
    heldout_demos: Path | None = None
    """demonstrations of a second player to measure on: the probes learn from the first 400 of the episodes with its first
    `--train-pairs` pairs, the episodes after these are held out; default: `--demos` serves for both (ours)"""
    frame_side: int = 22
    """pixels of the frames' side, to which the recorded ones are shrunk; two for each cell of the 11 × 11 maze (ours)"""
    red_scale: float = 5.0
    """factor on the red channel: the agent is small, and would be found late (ours)"""

    # Algorithm
    attempts: int = 1
    """models trained one after the other, each from weights of its own: that with the greatest J_HWM (`objective`) is kept, and the
    boundaries on which most of them agree are measured too (ours)"""
    total_updates: int = 4_000
    """gradient steps of an attempt (ours)"""
    batch_size: int = 16
    """chunks per batch (ours)"""
    chunk_length: int = 32
    """steps of a chunk; episodes follow each other in it (ours)"""
    learning_rate: float = 3e-3
    """Adam's learning rate; after a warm-up of 100 updates, and three tenths of it in the last three tenths (ours)"""
    max_grad_norm: float = 100.0
    """bound on the norm of the gradient; inf for none (DreamerV2)"""
    deter_z: int = 64
    """size of c_t (ours; the agents' `--size thesis`: 300)"""
    stoch_z: int = 32
    """size of v_t (ours; there 512)"""
    deter_w: int = 64
    """size of h_t (ours; there 300)"""
    stoch_w: int = 4
    """size of y_t (ours; there 512)"""
    hidden_size: int = 128
    """units of hidden layers (ours)"""
    std_bias: float = -4.0
    """added to the standard deviations' outputs at first, so that they start small (ours)"""
    image_scale: float | None = None
    """weight of the reconstruction; default: (64 / frame_side)², as if the frames had 64 pixels (ours; Eq. 3.3.5: 1)"""
    kl_z_scale: float = 0.1
    """weight of KL[q(z) ‖ p(z)] (Eq. 3.3.5: 1; as the baseline's)"""
    kl_w_scale: float = 0.1
    """weight of KL[q(w) ‖ p(w)] (Eq. 3.3.5: 1; as the baseline's)"""
    kl_m_scale: float = 0.3
    """weight of KL[q(m) ‖ p(m)] (Eq. 3.3.5: 1)"""
    kl_balance: float = 0.8
    """share of each KL term's gradient that trains p, the rest trains q (DreamerV2)"""
    detach_kl_z: bool = True
    """KL_z counts at the reads, and does not price them (VTA); off: it does (Eq. 3.3.7)"""
    temperature: float = 0.3
    """last temperature of the binary Gumbel samples of m; from 1 over `--budget-updates` (ours)"""
    boundary_bound: float = 4.0
    """bound on the logits of q(m); 0 for none (ours)"""
    read_bias: float = 2.0
    """logit of q(m) at first: start with many reads (ours)"""
    max_segment_length: int = 20
    """in training, a read is forced after as many steps without; 0 for never (VTA)"""
    max_segments: int = 0
    """in training, a copy is forced after as many segments of an episode; 0 for never (VTA: 10)"""
    w_reset: bool = True
    """w starts anew from z where z is read (VTA; the thesis: no)"""
    narrow_w: bool = True
    """means of y in ±1 and a fixed noise in q(y), so that it carries few bits (ours)"""
    narrow_std: float = 0.4
    """that noise's standard deviation (ours)"""
    c_sees_w: bool = True
    """c_t is made from w_{t-1} and a_{t-1} too (Eq. 3.3.1), not only from z_{t-1} (VTA)"""
    h_sees_z: bool = True
    """h_t is made from z_t too (Eq. 3.3.1), not only from w_{t-1} and a_{t-1} (section 3.3.2)"""
    decoder_sees_h: bool = False
    """the decoder sees h_t too (Eq. 3.3.1), not only y_t and z_t"""
    decoder_sees_c: bool = False
    """the decoder sees c_t too (Eq. 3.3.1), not only v_t: c_t knows of frames a step late"""
    read_price: float = 0.0
    """price of a read, on the mean read rate (ours)"""
    budget: float = 0.15
    """share of steps read without a price, from 1 over `--budget-updates` (ours)"""
    budget_price: float = 50.0
    """price of the reads beyond it, on the mean read rate; 0: no budget (ours)"""
    budget_updates: int | None = None
    """updates of an attempt over which budget and temperature come to their last values; default: 80% of them (ours)"""
    surprise_price: float = 0.0
    """price, per nat, of reads whose KL_z exceeds the mean over reads; those below it earn as much. It rises from 0 over
    `--surprise-updates` once the budget is annealed; with it read rates below the budget cost too; 0 for none (ours)"""
    surprise_updates: int = 500
    """updates over which that price grows (ours)"""
    foretell_copies: float = 0.0
    """weight of KL_z at steps that copy, q(z) held: p(z) learns how surprising a read there would be (ours)"""

    # to be filled in runtime
    env_id: tyro.conf.Suppress[str] = ""
    """the environment of the demonstrations"""


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
    args.stop_at = args.attempts * args.total_updates if args.stop_at is None else args.stop_at
    args.budget_updates = math.ceil(0.8 * args.total_updates) if args.budget_updates is None else args.budget_updates
    counts = "checkpoint_interval attempts stop_at train_pairs heldout_episodes total_updates batch_size hidden_size"
    counts += " deter_z stoch_z deter_w stoch_w budget_updates surprise_updates"
    scales = "kl_z_scale kl_w_scale kl_m_scale read_price budget_price surprise_price foretell_copies boundary_bound"
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("chunk_length", lambda x: x >= 2, "must be at least 2"),
        ("frame_side", lambda x: 4 <= x <= 64, "must be between 4 and 64"),
        ("learning_rate red_scale narrow_std", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("max_grad_norm", lambda x: x > 0, "must be greater than 0"),
        (scales, lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("read_bias std_bias", math.isfinite, "must be finite"),
        ("kl_balance budget", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("temperature", lambda x: 0 < x <= 1, "must be greater than 0 and at most 1"),
        ("max_segment_length max_segments", lambda x: x >= 0, "must be at least 0"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    args.image_scale = (64 / args.frame_side) ** 2 if args.image_scale is None else args.image_scale
    require(0 < args.image_scale < math.inf, "--image-scale", args.image_scale, "must be greater than 0 and finite")
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    needed = "needed: a folder that `ppo_fourrooms.py --save-demos 2300` has written"
    require(args.demos is not None, "--demos", "", needed)
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UsageError("--track: needs Weights and Biases: pip install wandb")
    return args


# ---------------------------------------------------------------------------------------------------------------------
# Demonstrations
# ---------------------------------------------------------------------------------------------------------------------
class Episode(NamedTuple):
    """T steps of an episode: the pairs (o_t, a_t), and where the agent is."""

    frames: np.ndarray  # (T, side, side, 3) float32, shrunk
    actions: np.ndarray  # (T,) int64
    states: np.ndarray  # (T, 3): the agent's cell, its direction, the goal's cell
    rooms: np.ndarray  # (T,): 0 to 3, or 4 to 7 in a door


def area_weights(length: int, side: int) -> np.ndarray:
    """The matrix (side, length) that shrinks a line of pixels by averaging, each weighted by the part of it that is covered."""
    edges = np.linspace(0, length, side + 1)
    pixels = np.arange(length)
    covered = np.minimum(edges[1:, None], pixels + 1) - np.maximum(edges[:-1, None], pixels)
    return np.maximum(covered, 0) * side / length


def read_episode(path: Path, checksum: str, side: int, flag: str) -> Episode:
    """One demonstration. Raises UsageError where it is not what the manifest says, or has no square images or rooms."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{flag} {path}: cannot be read: {error.strerror}") from None
    same = hashlib.sha256(content).hexdigest() == checksum
    require(same, flag, path, "its SHA-256 is not the manifest's, the file was changed or damaged")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            names = ("observations", "actions", "states", "rooms")
            observations, actions, states, rooms = (arrays[name] for name in names)
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise UsageError(f"{flag} {path}: no demonstration with rooms: {first_line(error)}") from None
    steps, shape = len(actions), observations.shape
    is_square = len(shape) == 4 and shape[1] == shape[2] >= side and shape[3] == 3 and observations.dtype == np.uint8
    require(is_square, flag, path, f"observations must be square uint8 images of at least --frame-side {side}")
    fits = len(observations) == len(rooms) == steps + 1 and states.shape == (steps + 1, 3) and steps >= 1
    require(fits, flag, path, f"must have T + 1 observations, states and rooms for T actions, T is {steps}")
    integers = all(np.issubdtype(array.dtype, np.integer) and (array >= 0).all() for array in (actions, states, rooms))
    require(bool(integers), flag, path, "actions, states and rooms must be whole numbers from 0")
    weights = area_weights(shape[1], side).astype(np.float32)
    frames = np.einsum("ia,tabc,jb->tijc", weights, observations[:-1].astype(np.float32), weights, optimize=True)
    return Episode(frames, actions.astype(np.int64), states[:-1].astype(np.int64), rooms[:-1].astype(np.int64))


def read_demonstrations(folder: Path, side: int, flag: str = "--demos") -> tuple[list[Episode], str]:
    """All episodes of a folder, in the order of their names, and the environment's id. Raises UsageError."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        files, recorded, version = dict(manifest["files"]), str(manifest["env_id"]), manifest["version"]
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{flag} {folder}: holds no demonstrations, it has no readable manifest.json") from None
    require(version == 1, flag, folder, f"its manifest is of version {version}, this script reads version 1")
    require(bool(files), flag, folder, "holds no demonstrations, its manifest names no file")
    return [read_episode(folder / name, checksum, side, flag) for name, checksum in sorted(files.items())], recorded


def split_episodes(episodes: list[Episode], args: Args, flag: str = "--demos") -> tuple[list[Episode], list[Episode]]:
    """The first episodes with `--train-pairs` steps, and those held out after them. Raises UsageError where there are too few."""
    ends = np.cumsum([len(episode.actions) for episode in episodes])
    first = int(np.searchsorted(ends, args.train_pairs)) + 1
    allowed = f"must leave at least one episode of {flag} to hold out; it has {ends[-1]} pairs"
    require(first < len(episodes), "--train-pairs", args.train_pairs, allowed)
    enough = args.chunk_length < ends[first - 1]
    require(enough, "--chunk-length", args.chunk_length, f"must be less than the {ends[first - 1]} steps to train on")
    return episodes[:first], episodes[first : first + args.heldout_episodes]


PROBED_EPISODES = 400  # that the probes learn from, at most


class Split(NamedTuple):
    """Which episodes serve for what."""

    training: list[Episode]
    probed: list[Episode]  # from which the probes learn
    heldout: list[Episode]


def read_split(args: Args) -> tuple[Split, str]:
    """The episodes of `--demos` and `--heldout-demos`, and the environment's id. Raises UsageError."""
    demonstrations, env_id = read_demonstrations(args.demos, args.frame_side)
    training, heldout = split_episodes(demonstrations, args)
    probed = training
    if args.heldout_demos is not None:
        others, other_id = read_demonstrations(args.heldout_demos, args.frame_side, "--heldout-demos")
        require(other_id == env_id, "--heldout-demos", args.heldout_demos, f"must be of {env_id}, is of {other_id}")
        probed, heldout = split_episodes(others, args, "--heldout-demos")
    return Split(training, probed[:PROBED_EPISODES], heldout), env_id


class Normalizer(NamedTuple):
    """Frames <-> what the model sees: the mean frame subtracted, red scaled, flat."""

    mean: np.ndarray  # (side, side, 3) in 0 to 1
    scale: np.ndarray  # (3,)

    def normalize(self, frames: np.ndarray) -> np.ndarray:
        """(..., side, side, 3) in grey levels -> (..., F)"""
        x = (frames / 255 - self.mean) * self.scale
        return x.reshape(*frames.shape[:-3], -1).astype(np.float32)

    def frames(self, x: np.ndarray) -> np.ndarray:
        """(..., F) -> (..., side, side, 3) in 0 to 1"""
        return np.clip(x.reshape(*x.shape[:-1], *self.mean.shape) / self.scale + self.mean, 0, 1)


class Sequence(NamedTuple):
    """Episodes one after the other (N steps), or side by side (T steps of B episodes)."""

    frames: torch.Tensor  # (N, F) or (T, B, F)
    actions: torch.Tensor  # (N,) or (T, B)
    first: torch.Tensor  # (N,) or (T, B): 1 where an episode begins

    def chunks(self, starts: torch.Tensor, length: int) -> "Sequence":
        """Of episodes one after the other, the chunks (length, B) that begin at starts (B,)."""
        rows = starts + torch.arange(length, device=starts.device)[:, None]
        return Sequence(*(column[rows] for column in self))


def in_a_row(episodes: list[Episode], normalizer: Normalizer) -> Sequence:
    """Episodes one after the other."""
    frames = np.concatenate([normalizer.normalize(episode.frames) for episode in episodes])
    first = np.concatenate([np.arange(len(episode.actions)) == 0 for episode in episodes])
    actions = np.concatenate([episode.actions for episode in episodes])
    return Sequence(*(torch.from_numpy(array) for array in (frames, actions, first.astype(np.float32))))


def side_by_side(episodes: list[Episode], normalizer: Normalizer) -> Sequence:
    """Episodes side by side; behind the shorter ones zeros, each the beginning of an episode, so that q(m) ends before them."""
    steps = max(len(episode.actions) for episode in episodes)
    frames = np.zeros((steps, len(episodes), normalizer.mean.size), np.float32)
    actions, first = np.zeros((steps, len(episodes)), np.int64), np.zeros((steps, len(episodes)), np.float32)
    first[0] = 1
    for i, episode in enumerate(episodes):
        frames[: len(episode.actions), i] = normalizer.normalize(episode.frames)
        actions[: len(episode.actions), i] = episode.actions
        first[len(episode.actions) :, i] = 1
    return Sequence(*(torch.from_numpy(array) for array in (frames, actions, first)))


# ---------------------------------------------------------------------------------------------------------------------
# The hierarchical world model (Eq. 3.3.1 to 3.3.7)
# ---------------------------------------------------------------------------------------------------------------------
# T steps of B sequences stand first in every shape: (T, B, ...). m_t = 1 says that a new segment begins with step t + 1, so
# step t reads (UPDATE) where m_{t-1} = 1, and copies (COPY) where it is 0.
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


def mlp(input_size: int, hidden_size: int, output_size: int, hidden_layers: int = 1) -> nn.Sequential:
    """Densely connected layers with ELU."""
    sizes = [input_size] + [hidden_size] * hidden_layers
    layers = [layer for a, b in zip(sizes, sizes[1:]) for layer in (nn.Linear(a, b), nn.ELU())]
    return nn.Sequential(*layers, nn.Linear(sizes[-1], output_size))


class Normal(NamedTuple):
    """Independent normal distributions, mean and standard deviation of the same shape."""

    mean: torch.Tensor
    std: torch.Tensor


class NormalHead(nn.Module):
    """Features -> N(μ, σ) with σ = 2 sigmoid(x / 2) + 0.1, x starting near `std_bias`."""

    def __init__(self, input_size: int, hidden_size: int, size: int, std_bias: float):
        super().__init__()
        self.layers = mlp(input_size, hidden_size, 2 * size)
        with torch.no_grad():
            self.layers[-1].bias[size:] += std_bias

    def forward(self, features: torch.Tensor) -> Normal:
        """Features (..., input_size) -> mean and standard deviation, (..., size) each."""
        mean, std = self.layers(features).chunk(2, -1)
        return Normal(mean, 2 * torch.sigmoid(std / 2) + 0.1)


def kl_normal(q: Normal, p: Normal) -> torch.Tensor:
    """KL[q ‖ p], summed over the last axis."""
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
    """q(m_t | O) = Bernoulli(σ(φ(O))), where φ is a temporal convolution that ends at the borders of its episode (Eq. 3.3.2)."""

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
        x, goes_on = embed, (1 - first[1:])[:, :, None]  # (T - 1, B, 1): steps t and t + 1 are of one episode
        for layer in self.layers:
            border = torch.zeros_like(x[:1])
            before = torch.cat([border, x[:-1] * goes_on])
            after = torch.cat([x[1:] * goes_on, border])
            x = layer(torch.cat([before, x, after], -1))
        logit = self.logit(x).squeeze(-1)
        return self.bound * torch.tanh(logit / self.bound) if self.bound else logit


def uniforms(*shape: int, device: torch.device) -> torch.Tensor:
    """Uniform numbers, drawn on the CPU: one random state to restore."""
    return torch.rand(shape).to(device)


class Belief(NamedTuple):
    """z_t = [c_t, v_t] and w_t = [h_t, y_t]."""

    c: torch.Tensor  # (..., deter_z)
    v: torch.Tensor  # (..., stoch_z)
    h: torch.Tensor  # (..., deter_w)
    y: torch.Tensor  # (..., stoch_w)


class Inference(NamedTuple):
    """What the model makes of T steps."""

    belief: Belief  # (T, B, ...)
    reads: torch.Tensor  # (T, B): 1 where z was read, 0 where it was copied
    forced: torch.Tensor  # (T, B): 1 where the read or copy was not the model's choice
    updated: torch.Tensor  # (T, B, deter_z): c_t if z is read
    q_z: Normal  # (T, B, stoch_z), if z is read
    q_w: Normal  # (T, B, stoch_w)
    q_m: torch.Tensor  # (T, B): logits
    p_m: torch.Tensor  # (T, B): logits


class HWM(nn.Module):
    """The generative process of Eq. 3.3.1 and the variational distributions of Eq. 3.3.2."""

    def __init__(self, args: Args, frame_mean: np.ndarray, num_actions: int):
        super().__init__()
        self.args, self.num_actions, frame_size = args, num_actions, frame_mean.size
        self.register_buffer("frame_mean", torch.tensor(np.ascontiguousarray(frame_mean), dtype=torch.float32))
        dz, sz, dw, sw, hidden = args.deter_z, args.stoch_z, args.deter_w, args.stoch_w, args.hidden_size
        z, w, embed = dz + sz, dw + sw, hidden
        self.encoder = mlp(frame_size, hidden, embed)
        self.posterior_m = Posterior(embed, 64, args.read_bias, args.boundary_bound)  # q(m | O)
        self.z_rnn = GRUCell(sz + dw + sw + num_actions, dz)  # f_z-rnn
        self.prior_z = NormalHead(dz, hidden, sz, args.std_bias)  # p(v_t | c_t)
        self.posterior_z = NormalHead(dz + embed, hidden, sz, args.std_bias)  # q(v_t | c_t, o_t)
        self.w_rnn = GRUCell(sw + num_actions + z, dw)  # f_w-rnn
        self.w_start = nn.Linear(z, dw)  # for `--w-reset`
        self.prior_w = NormalHead(dw, hidden, sw, args.std_bias)  # p(y_t | h_t)
        self.posterior_w = NormalHead(w - sw + z + embed, hidden, sw, args.std_bias)  # q(y_t | h_t, z_t, o_t)
        self.prior_m = mlp(w + z + num_actions, hidden, 1, 2)  # p(m_t | w_t, z_t, a_t)
        self.decoder = mlp(w + z, hidden, frame_size)  # p(o_t | w_t, z_t)

    def normalizer(self) -> Normalizer:
        """What the model's frames are made with."""
        return Normalizer(self.frame_mean.cpu().numpy(), np.array([self.args.red_scale, 1, 1], np.float32))

    def low_level(self, head: NormalHead, features: torch.Tensor) -> Normal:
        """The head's distribution; with `--narrow-w` its mean lies in ±1 and the posterior's σ is fixed."""
        mean, std = head(features)
        if not self.args.narrow_w:
            return Normal(mean, std)
        noise = self.args.narrow_std
        return Normal(mean.tanh(), torch.full_like(std, noise) if head is self.posterior_w else 0.2 + 0.3 * std)

    def draw_m(self, logits: torch.Tensor, temperature: float) -> torch.Tensor:
        """Bernoulli samples of logits (T, B) by the binary Gumbel trick, with the gradient of the soft ones."""
        uniform = uniforms(*logits.shape, device=logits.device).clamp(1e-6, 1 - 1e-6)
        soft = torch.sigmoid((logits + torch.logit(uniform)) / temperature)
        return (soft > 0.5).float() + (soft - soft.detach())

    def start(self, batch: int, like: torch.Tensor) -> Belief:
        args = self.args
        sizes = (args.deter_z, args.stoch_z, args.deter_w, args.stoch_w)
        return Belief(*(like.new_zeros(batch, size) for size in sizes))

    def step(self, state: Belief, previous_action, read, begins, embed, noise: tuple, z_from_prior: bool) -> tuple:
        """One step: the belief at t from that at t − 1; c_t and q(v_t) as they are if z is read; q(y_t).

        previous_action (B, A), read and begins (B, 1), embed (B, E); noise are standard normal draws for v and y, or zeros.
        """
        low = torch.cat([state.h, state.y, previous_action], -1) * self.args.c_sees_w
        updated = self.z_rnn(torch.cat([state.v, low], -1), state.c)
        c = read * updated + (1 - read) * state.c  # UPDATE or COPY
        q_z = self.posterior_z(torch.cat([updated, embed], -1))
        v = q_z.mean + q_z.std * noise[0]
        if z_from_prior:  # section 3.5.1: z_0 from q, later ones from p
            v = begins * v + (1 - begins) * self.prior_z(updated).mean
        v = read * v + (1 - read) * state.v
        z = torch.cat([c, v], -1)
        h = self.w_rnn(torch.cat([state.y, previous_action, z * self.args.h_sees_z], -1), state.h)
        if self.args.w_reset:
            h = read * torch.tanh(self.w_start(z)) + (1 - read) * h
        q_w = self.low_level(self.posterior_w, torch.cat([h, z, embed], -1))
        y = q_w.mean + q_w.std * noise[1]
        return Belief(c, v, h, y), updated, q_z, q_w

    def infer(self, data: Sequence, mode: str = "train", temperature: float = 1.0) -> Inference:
        """Run over T steps of B sequences.

        mode: "train" draws all from q; "posterior" takes means of q and its more probable m; "prior" is section 3.5.1, z from
        p but for an episode's first, w from q, and the more probable m of p; "sampled" is "prior" with m drawn from p.
        """
        frames, actions, first = data
        steps, batch = first.shape
        embed = self.encoder(frames)  # (T, B, E)
        q_m = self.posterior_m(embed, first)  # (T, B)
        trains = mode == "train"
        m = self.draw_m(q_m, temperature) if trains else (q_m > 0).float()
        taken = F.one_hot(actions, self.num_actions).float()  # (T, B, A)
        sizes = (self.args.stoch_z, self.args.stoch_w)
        noise = [torch.randn(steps, batch, size).to(frames.device) * trains for size in sizes]
        state = self.start(batch, frames)
        length, segments = frames.new_zeros(batch, 1), frames.new_zeros(batch, 1)
        previous_m, previous_action = frames.new_zeros(batch, 1), torch.zeros_like(taken[0])
        made = []
        for t in range(steps):
            # READ is forced where a chunk or an episode begins
            begins = first[t, :, None] if t else torch.ones_like(length)
            read, force = begins + (1 - begins) * previous_m, begins
            if trains and self.args.max_segment_length:
                too_long = (length >= self.args.max_segment_length).float()
                read, force = torch.maximum(read, too_long), torch.maximum(force, too_long)
            if trains and self.args.max_segments:
                too_many = (1 - begins) * (segments >= self.args.max_segments).float()
                read, force = (1 - too_many) * read, torch.maximum(force, too_many)
            length = (1 - read.detach()) * length + 1
            segments = (1 - begins) * segments + read.detach()
            state = Belief(*((1 - begins) * part for part in state))
            previous_action = (1 - begins) * previous_action
            draws = noise[0][t], noise[1][t]
            state, updated, q_z, q_w = self.step(
                state, previous_action, read, begins, embed[t], draws, mode in ("prior", "sampled")
            )
            made.append((state, q_z, q_w, updated, read, force))
            previous_action, previous_m = taken[t], m[t, :, None]
            if mode in ("prior", "sampled"):
                p = torch.sigmoid(self.prior_m(torch.cat([*state, taken[t]], -1)))
                previous_m = (p > (uniforms(*p.shape, device=p.device) if mode == "sampled" else 0.5)).float()
        *states, updates, reads, forced = zip(*made)
        belief, q_z, q_w = (type(column[0])(*(torch.stack(part) for part in zip(*column))) for column in states)
        updated, reads, forced = (torch.stack(column) for column in (updates, reads, forced))  # (T, B, ...)
        p_m = self.prior_m(torch.cat([*belief, taken], -1)).squeeze(-1)
        return Inference(belief, reads.squeeze(-1), forced.squeeze(-1), updated, q_z, q_w, q_m, p_m)

    def decode(self, belief: Belief, use_z: float = 1.0, use_w: float = 1.0) -> torch.Tensor:
        """Mean of p(o_t | w_t, z_t), (..., F); 0 turns z or w off (rows b to d of Fig. 3.4)."""
        c, v, h, y = belief
        c, h = c * self.args.decoder_sees_c, h * self.args.decoder_sees_h
        return self.decoder(torch.cat([use_z * c, use_z * v, use_w * h, use_w * y], -1))


def hwm_loss(
    model: HWM, data: Sequence, temperature: float, budget: float, surprise_price: float = 0.0
) -> tuple[torch.Tensor, dict]:
    """−J_HWM (Eq. 3.3.5) per step, and its terms.

    budget: the share of steps that may be read without a price; surprise_price: the price, per nat, of reads chosen by q(m) whose
    KL_z exceeds their mean; those below it earn as much.
    """
    args, made = model.args, model.infer(data, "train", temperature)
    reconstruction = 0.5 * args.image_scale * (model.decode(made.belief) - data.frames).square().sum(-1)  # (T, B)
    p_z, p_w = model.prior_z(made.updated), model.low_level(model.prior_w, made.belief.h)
    weight = made.reads.detach() if args.detach_kl_z else made.reads  # Eq. 3.3.7 weights KL_z by q(M)
    surprise = balanced(kl_normal, made.q_z, p_z, args.kl_balance)  # of a read, whether or not there is one
    kl_z = weight * surprise
    kl_w = balanced(kl_normal, made.q_w, p_w, args.kl_balance)
    chosen = 1 - made.forced
    decides = torch.cat([chosen[1:], torch.zeros_like(chosen[:1])])  # m_t is not used before a forced read
    kl_m = decides * balanced(kl_bernoulli, made.q_m, made.p_m, args.kl_balance)
    reads = made.reads * chosen
    read_rate = reads.sum() / chosen.sum().clamp(min=1)
    loss = (reconstruction + args.kl_z_scale * kl_z + args.kl_w_scale * kl_w + args.kl_m_scale * kl_m).mean()
    excess = read_rate - budget
    loss = loss + args.read_price * read_rate + args.budget_price * (excess.abs() if surprise_price else F.relu(excess))
    still = Normal(*(part.detach() for part in made.q_z))
    loss = loss + args.foretell_copies * ((1 - made.reads.detach()) * kl_normal(still, p_z)).mean()
    usual = (reads * surprise).sum() / reads.sum().clamp(min=1)
    loss = loss + surprise_price * (reads * (surprise - usual).detach()).mean()  # 0, its gradient moves q(m) alone
    terms = {"reconstruction": reconstruction, "kl_z": kl_z, "kl_w": kl_w, "kl_m": kl_m, "read_rate": read_rate}
    agreement = ((made.p_m > 0) == (made.q_m > 0)).float()
    terms["agreement"] = (agreement * decides).sum() / decides.sum().clamp(min=1)
    terms["segment_length"] = made.reads.numel() / made.reads.sum()
    return loss, {name: value.detach().mean() for name, value in terms.items()}


# ---------------------------------------------------------------------------------------------------------------------
# Learning
# ---------------------------------------------------------------------------------------------------------------------
def schedule(args: Args, update: int) -> tuple[float, float, float, float]:
    """Learning rate, temperature, read budget and price of surprise of an update, counted from 0."""
    update %= args.total_updates
    ramp = min(1.0, update / args.budget_updates)
    late = min(1.0, max(0, update - args.budget_updates) / args.surprise_updates)
    rate = args.learning_rate * min(1.0, (update + 1) / 100) * (1.0 if update < 0.7 * args.total_updates else 0.3)
    return rate, 1 + (args.temperature - 1) * ramp, 1 + (args.budget - 1) * ramp, late * args.surprise_price


def train_step(model: HWM, optimizer: torch.optim.Adam, data: Sequence, update: int) -> dict[str, torch.Tensor]:
    """One gradient step on a batch of chunks; returns the terms of the loss before it."""
    args = model.args
    rate, temperature, budget, surprise_price = schedule(args, update)
    for group in optimizer.param_groups:
        group["lr"] = rate
    starts = torch.randint(len(data.actions) - args.chunk_length + 1, (args.batch_size,)).to(data.actions.device)
    loss, terms = hwm_loss(model, data.chunks(starts, args.chunk_length), temperature, budget, surprise_price)
    optimizer.zero_grad()
    loss.backward()
    nn.utils.clip_grad_norm_(model.parameters(), args.max_grad_norm)
    optimizer.step()
    return {"loss": loss.detach(), **terms}


@torch.no_grad()
def objective(model: HWM, data: Sequence) -> float:
    """J_HWM per step of the training data, with m, z and w drawn from q: KL terms weigh 1 (Eq. 3.3.5), frames as in training."""
    args, state = model.args, torch.get_rng_state()
    torch.manual_seed(args.seed)
    starts = torch.arange(0, len(data.actions) - args.chunk_length + 1, args.chunk_length)
    _, terms = hwm_loss(model, data.chunks(starts.to(data.actions.device), args.chunk_length), args.temperature, 1.0)
    torch.set_rng_state(state)
    return -sum(terms[name].item() for name in ("reconstruction", "kl_z", "kl_w", "kl_m"))


def new_model(
    args: Args, frame_mean: np.ndarray, num_actions: int, device: torch.device
) -> tuple[HWM, torch.optim.Adam]:
    """A model with weights of its own, and its optimiser."""
    model = HWM(args, frame_mean, num_actions).to(device)
    return model, torch.optim.Adam(model.parameters(), lr=args.learning_rate, eps=1e-5, fused=True)


def compile_step(model: HWM, data: Sequence, args: Args) -> bool:
    """Compile the model's step where a compiler is at hand; return whether that went well."""
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
        return False
    plain, state = model.step, torch.get_rng_state()
    torch.compiler.set_stance("default")
    model.step = torch.compile(plain)
    try:
        starts = torch.zeros(args.batch_size, dtype=torch.int64, device=data.actions.device)
        hwm_loss(model, data.chunks(starts, args.chunk_length), 1.0, 1.0)[0].backward()
    except Exception as error:  # whatever the compiler's tool chain lacks, the plain step needs none of it
        print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)
        model.step = plain
    model.zero_grad()
    torch.set_rng_state(state)
    return model.step is not plain


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "hwm_segment 3"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("save_model", "heldout_episodes", "heldout_demos")
FREE_ON_RESUME = {"run_dir", "resume", "stop_at", "checkpoint_interval", "demos", *FINISH}
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
# How good a segmentation is
# ---------------------------------------------------------------------------------------------------------------------
# A segmentation of an episode with T steps is a bool array (T - 1,): whether a new segment begins with step t + 1.
def merge_doors(rooms: np.ndarray) -> np.ndarray:
    """Room labels (T,) in which a door belongs to the room that is being left: 4 labels, one boundary a crossing."""
    merged = rooms.copy()
    for t in range(1, len(rooms)):
        if merged[t] >= 4:
            merged[t] = merged[t - 1]
    return merged


def matches(found: np.ndarray, true: np.ndarray, before: int, after: int) -> int:
    """The largest number of pairs of boundaries, each used once, the found one at most `before` steps early or `after` late."""
    found, true = np.flatnonzero(found).tolist(), np.flatnonzero(true).tolist()
    count = i = j = 0
    while i < len(found) and j < len(true):
        if -before <= found[i] - true[j] <= after:
            count, i, j = count + 1, i + 1, j + 1
        elif found[i] < true[j]:
            i += 1
        else:
            j += 1
    return count


def f1_score(found: list[np.ndarray], true: list[np.ndarray], before: int, after: int) -> dict[str, float]:
    """Precision, recall and F1 of boundaries, over all episodes together."""
    hits = sum(matches(a, b, before, after) for a, b in zip(found, true))
    claimed, real = (sum(int(part.sum()) for part in parts) for parts in (found, true))
    precision, recall = hits / max(claimed, 1), hits / max(real, 1)
    return {"precision": precision, "recall": recall, "f1": 2 * hits / max(claimed + real, 1)}


AGREEMENT_KERNEL = np.array([1, 2, 3, 2, 1])  # what a model's vote for a boundary counts for the steps around it


def agree(votes: np.ndarray) -> np.ndarray:
    """Boundaries (T − 1,) of N models' (N, T − 1): where the votes weigh more than those of half of the models at one step.

    The greatest sums come first, no two within the kernel's reach. Each model reads once around a door, but at steps that differ;
    so do viewers who press a button at a cut. Every read votes, so several of one model around a step weigh more than one.
    """
    reach, steps = len(AGREEMENT_KERNEL) // 2, votes.shape[1]
    agreed = np.zeros(steps, bool)
    if steps == 0:
        return agreed
    sums = np.convolve(votes.sum(0), AGREEMENT_KERNEL)[reach : reach + steps]
    while 2 * sums.max() > AGREEMENT_KERNEL.max() * len(votes):
        t = int(sums.argmax())
        agreed[t] = True
        sums[max(0, t - reach) : t + reach + 1] = -1
    return agreed


def near(boundaries: np.ndarray) -> np.ndarray:
    """Which steps are at most one from a boundary, (T - 1,)."""
    padded = np.pad(boundaries, 1)
    return padded[:-2] | padded[1:-1] | padded[2:]


def boundary_scores(found: list[np.ndarray], rooms: list[np.ndarray]) -> dict[str, float]:
    """All measures of boundaries for episodes with room labels (T,) each.

    `_0` is exact, `_1` within a step; `4_rooms_either` takes the last step in the door or the first behind it, for the door can
    be of either room.
    """
    scores = {"read_rate": float(np.concatenate(found).mean())}
    scores["segment_length"] = sum(map(len, rooms)) / (sum(int(part.sum()) for part in found) + len(rooms))
    for name, labels in (("8_labels", rooms), ("4_rooms", [merge_doors(each) for each in rooms])):
        true = [each[1:] != each[:-1] for each in labels]
        for tolerance in (0, 1):
            score = f1_score(found, true, tolerance, tolerance)
            scores |= {f"{key}_{name}_{tolerance}": value for key, value in score.items()}
    scores |= {f"{key}_4_rooms_either": value for key, value in f1_score(found, true, 1, 0).items()}
    entries = [(each[:-1] < 4) & (each[1:] >= 4) for each in rooms]
    scores["door_entry_recall"] = f1_score(found, entries, 1, 1)["recall"]
    inside = np.concatenate([part[~near(each[1:] != each[:-1])] for part, each in zip(found, rooms)])
    scores["read_rate_inside_rooms"] = float(inside.mean()) if len(inside) else math.nan
    return scores


def area_under_curve(scores: np.ndarray, true: np.ndarray) -> float:
    """Probability that a boundary has a higher score than another step; ties count half."""
    _, inverse, counts = np.unique(scores, return_inverse=True, return_counts=True)
    ranks = (np.cumsum(counts) - (counts - 1) / 2)[inverse]
    positives = int(true.sum())
    if positives in (0, len(true)):
        return math.nan
    return float((ranks[true].sum() - positives * (positives + 1) / 2) / (positives * (len(true) - positives)))


def curve_areas(scores: np.ndarray, rooms: list[np.ndarray]) -> dict[str, float]:
    """The same for the boundaries of both labellings, from scores of all episodes' steps, one after the other."""
    labels = {"8_labels": rooms, "4_rooms": [merge_doors(each) for each in rooms]}
    true = {name: np.concatenate([part[1:] != part[:-1] for part in each]) for name, each in labels.items()}
    return {f"area_under_curve_{name}": area_under_curve(scores, each) for name, each in true.items()}


def floors(rooms: list[np.ndarray], states: list[np.ndarray], read_rate: float, rng: np.random.Generator) -> dict:
    """The same measures of segmentations that know nothing of rooms, and of one that reads at each door."""
    moves = [each[1:, 0] != each[:-1, 0] for each in states]
    base_rate = float(np.concatenate([each[1:] != each[:-1] for each in rooms]).mean())
    move_rate = read_rate * sum(map(len, moves)) / max(1, sum(int(part.sum()) for part in moves))

    def every(k: int) -> list[np.ndarray]:
        return [np.isin(np.arange(len(part)), np.flatnonzero(part)[k - 1 :: k]) for part in moves]

    made = {
        "always": [np.ones(len(part), bool) for part in moves],
        "never": [np.zeros(len(part), bool) for part in moves],
    }
    made["coin at the truth's rate"] = [rng.random(len(part)) < base_rate for part in moves]
    made["coin at the model's rate, on moves"] = [part & (rng.random(len(part)) < move_rate) for part in moves]
    made |= {f"every {k} steps": [np.arange(1, len(part) + 1) % k == 0 for part in moves] for k in range(2, 8)}
    made |= {f"every {k} moves" if k > 1 else "every move": every(k) for k in (1, 2, 3)}
    made["at each door"] = [(each[:-1] < 4) & (each[1:] >= 4) for each in rooms]
    return {
        name: boundary_scores(found, rooms) | curve_areas(np.concatenate(found), rooms) for name, found in made.items()
    }


def linear_probe(train: tuple[np.ndarray, np.ndarray], test: tuple[np.ndarray, np.ndarray]) -> float:
    """Accuracy on `test` of a ridge regression from features (N, D) onto one-hot labels (N,), fitted on `train`."""
    (x, labels), (test_x, test_labels) = train, test
    mean, std = x.mean(0), x.std(0) + 1e-4

    def design(features: np.ndarray) -> np.ndarray:
        return np.concatenate([(features - mean) / std, np.ones((len(features), 1))], 1).astype(np.float64)

    a, classes = design(x), int(max(labels.max(), test_labels.max())) + 1
    weights = np.linalg.solve(a.T @ a + 1e-3 * len(a) * np.eye(a.shape[1]), a.T @ np.eye(classes)[labels])
    return float(((design(test_x) @ weights).argmax(1) == test_labels).mean())


def k_means(x: np.ndarray, clusters: int, rng: np.random.Generator, rounds: int = 50) -> np.ndarray:
    """Labels (N,) of points (N, D) by Lloyd's algorithm, from distant first centres (k-means++)."""
    centres = x[rng.integers(len(x), size=1)]
    while len(centres) < clusters:
        nearest = ((x[:, None] - centres) ** 2).sum(-1).min(1)
        share = nearest / nearest.sum() if nearest.sum() > 0 else np.full(len(x), 1 / len(x))
        centres = np.concatenate([centres, x[rng.choice(len(x), size=1, p=share)]])
    for _ in range(rounds):
        labels = ((x[:, None] - centres) ** 2).sum(-1).argmin(1)
        centres = np.stack([x[labels == k].mean(0) if (labels == k).any() else centres[k] for k in range(clusters)])
    return labels


def normalised_mutual_information(a: np.ndarray, b: np.ndarray) -> float:
    """Of two labellings (N,): 2 I / (H_a + H_b), 0 where one of them says nothing."""
    joint = np.zeros((a.max() + 1, b.max() + 1))
    np.add.at(joint, (a, b), 1 / len(a))

    def entropy(p: np.ndarray) -> float:
        return float(-(p[p > 0] * np.log(p[p > 0])).sum())

    parts = entropy(joint.sum(1)), entropy(joint.sum(0))
    return 2 * (sum(parts) - entropy(joint.ravel())) / sum(parts) if sum(parts) > 0 else 0.0


# ---------------------------------------------------------------------------------------------------------------------
# Evaluation (section 3.5.1)
# ---------------------------------------------------------------------------------------------------------------------
class Segmented(NamedTuple):
    """What the model makes of episodes side by side, as numpy arrays of the steps that exist."""

    found: list[np.ndarray]  # (T - 1,) bool each: a new segment begins with step t + 1
    scores: np.ndarray  # logits of the boundary for all of these steps, one episode after the other
    z: np.ndarray  # (N, |z|) for all steps, one episode after the other
    w: np.ndarray  # (N, |w|)
    error: float  # mean squared error of a pixel's channel, in 0 to 1


@torch.no_grad()
def segment(model: HWM, episodes: list[Episode], mode: str, device: torch.device) -> Segmented:
    """Run the model over whole episodes in the given mode of `HWM.infer`."""
    normalizer = model.normalizer()
    data = Sequence(*(column.to(device) for column in side_by_side(episodes, normalizer)))
    made = model.infer(data, mode)
    reconstructed = normalizer.frames(model.decode(made.belief).cpu().numpy())
    logits = (made.q_m if mode == "posterior" else made.p_m).cpu().numpy()
    reads = made.reads.cpu().numpy() > 0.5
    z = torch.cat(made.belief[:2], -1).cpu().numpy()
    w = torch.cat(made.belief[2:], -1).cpu().numpy()
    steps = [len(episode.actions) for episode in episodes]
    errors = [((reconstructed[:n, i] - episodes[i].frames / 255) ** 2).mean((1, 2, 3)) for i, n in enumerate(steps)]
    return Segmented(
        found=[reads[1:n, i] for i, n in enumerate(steps)],
        scores=np.concatenate([logits[: n - 1, i] for i, n in enumerate(steps)]),
        z=np.concatenate([z[:n, i] for i, n in enumerate(steps)]),
        w=np.concatenate([w[:n, i] for i, n in enumerate(steps)]),
        error=float(np.concatenate(errors).mean()),
    )


ATTEMPT_MEASURES = ("f1_4_rooms_0", "f1_4_rooms_1", "read_rate", "door_entry_recall")


def attempts_scores(model: HWM, models: list[dict], episodes: list[Episode], device) -> tuple[list[dict], dict]:
    """How good the boundaries of p(m) are in each model of these parameters, and all measures of those on which most agree."""
    found, rooms = [], [episode.rooms for episode in episodes]
    for parameters in models:
        model.load_state_dict(parameters)
        found.append(segment(model, episodes, "prior", device).found)
    scores = [boundary_scores(each, rooms) for each in found]
    agreed = boundary_scores([agree(np.stack(votes)) for votes in zip(*found)], rooms)
    return [{name: each[name] for name in ATTEMPT_MEASURES} for each in scores], agreed


def probes(train: Segmented, test: Segmented, train_episodes: list[Episode], test_episodes: list[Episode]) -> dict:
    """What a linear probe reads from z and from w, and how well the most frequent label does."""
    labels = []
    for episodes in (train_episodes, test_episodes):
        states = np.concatenate([episode.states for episode in episodes])
        rooms = np.concatenate([episode.rooms for episode in episodes])
        labels.append({"room": rooms, "cell": states[:, 0], "direction": states[:, 1], "goal": states[:, 2]})
    accuracy = {}
    for name in labels[0]:
        known, true = (side[name] for side in labels)
        features = {"z": (train.z, test.z), "w": (train.w, test.w)}
        parts = {level: linear_probe((x, known), (y, true)) for level, (x, y) in features.items()}
        accuracy[name] = {**parts, "most frequent": float((true == np.bincount(known).argmax()).mean())}
    return accuracy


def evaluate(model: HWM, episodes: Split, args: Args, device: torch.device) -> dict:
    """All measures on the held-out episodes: m from p (section 3.5.1), drawn from p, and from q; and their floors."""
    heldout = episodes.heldout
    rooms, states = [episode.rooms for episode in heldout], [episode.states for episode in heldout]
    torch.manual_seed(args.seed)
    rng, chance, results = np.random.default_rng(args.seed), np.random.default_rng([args.seed, 1]), {}
    for mode in ("prior", "sampled", "posterior"):
        made = segment(model, heldout, mode, device)
        result = {**boundary_scores(made.found, rooms), "reconstruction_mse": made.error}
        result |= curve_areas(made.scores, rooms)
        standard = (made.z - made.z.mean(0)) / (made.z.std(0) + 1e-4)
        clusters, labels = k_means(standard, 8, rng), np.concatenate(rooms)
        result["mutual_information_z_room"] = normalised_mutual_information(clusters, labels)
        result["mutual_information_by_chance"] = normalised_mutual_information(clusters, chance.permutation(labels))
        result["probes"] = probes(segment(model, episodes.probed, mode, device), made, episodes.probed, heldout)
        results[mode] = result
    constant = np.concatenate([episode.frames for episode in heldout]) / 255 - model.normalizer().mean
    about = {
        "episodes": len(heldout),
        "pairs": int(sum(map(len, rooms))),
        "mse_of_the_mean_frame": float((constant**2).mean()),
    }
    return {**about, **results, "floors": floors(rooms, states, results["prior"]["read_rate"], rng)}


SEGMENT_COLOURS = ("tab:blue", "tab:orange", "tab:green", "tab:red", "tab:purple", "tab:brown", "tab:pink", "tab:olive")


@torch.no_grad()
def draw_figure(model: HWM, episode: Episode, device: torch.device, path: Path) -> None:
    """Fig. 3.4: an episode, and what the decoder makes of z and w turned on one after the other; colours are segments."""
    from matplotlib.figure import Figure

    normalizer = model.normalizer()
    data = Sequence(*(column.to(device) for column in side_by_side([episode], normalizer)))
    made = model.infer(data, "prior")
    rows = [("(a) truth", episode.frames / 255)]
    for name, use_z, use_w in (("(b) none", 0, 0), ("(c) z", 1, 0), ("(d) w", 0, 1), ("(e) z and w", 1, 1)):
        rows.append((name, normalizer.frames(model.decode(made.belief, use_z, use_w)[:, 0].cpu().numpy())))
    segments = np.cumsum(made.reads[:, 0].cpu().numpy() > 0.5) - 1
    steps = len(episode.actions)
    figure = Figure(figsize=(0.8 * steps + 1.2, 4.6), layout="constrained")
    axes = figure.subplots(len(rows), steps, squeeze=False)
    for line, (name, frames) in zip(axes, rows):
        line[0].set_ylabel(name, rotation=0, ha="right", va="center")
        for t, one in enumerate(line):
            one.imshow(frames[t], interpolation="nearest")
            one.set(xticks=[], yticks=[])
            for spine in one.spines.values():
                spine.set(color=SEGMENT_COLOURS[segments[t] % len(SEGMENT_COLOURS)], linewidth=3)
    for t, one in enumerate(axes[0]):
        one.set_title(f"t = {t}", fontsize="small")
    content = io.BytesIO()
    figure.savefig(content, dpi=110)
    write_whole(path, content.getvalue())


def longest_way(episodes: list[Episode], most: int = 16) -> Episode:
    """The first episode with the most rooms among those of at most so many steps."""
    short = [episode for episode in episodes if len(episode.actions) <= most] or episodes[:1]
    return max(short, key=lambda episode: (len(set(episode.rooms.tolist())), len(episode.actions)))


def print_table(segmentation: dict) -> None:
    """Print the boundaries' measures, one line each, with the floors below."""
    keys = ("f1_8_labels_0", "f1_8_labels_1", "f1_4_rooms_0", "f1_4_rooms_1", "read_rate", "door_entry_recall")
    keys += ("read_rate_inside_rooms",)
    titles = ("F1 8, 0", "F1 8, 1", "F1 4, 0", "F1 4, 1", "reads", "doors", "inside")
    print(f"{'':38}" + "".join(f"{title:>9}" for title in titles))
    modes = {
        "prior": "m from p",
        "sampled": "m drawn from p",
        "posterior": "m from q",
        "agreed": "m where most models agree",
    }
    rows = {title: segmentation[mode] for mode, title in modes.items() if mode in segmentation} | segmentation["floors"]
    for name, row in rows.items():
        print(f"{name:38}" + "".join(f"{row[key]:>9.2f}" for key in keys))


# ---------------------------------------------------------------------------------------------------------------------
# Training
# ---------------------------------------------------------------------------------------------------------------------
LOG_INTERVAL = 50  # updates between rows of updates.csv


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


def fingerprint(episodes: list[Episode]) -> str:
    """What the training data are, for a run that goes on with the same."""
    digest = hashlib.sha256()
    for episode in episodes:
        digest.update(episode.frames.tobytes() + episode.actions.tobytes())
    return digest.hexdigest()


def main(args: Args) -> int:
    """Train, measure and write everything into the run's folder. Returns the exit code."""
    args = complete_args(args)
    episodes, args.env_id = read_split(args)
    data_id = fingerprint(episodes.training)
    run_dir, checkpoint = open_run_dir(args)
    last_update = min(args.attempts * args.total_updates, args.stop_at)
    same_data = checkpoint is None or checkpoint["data"] == data_id
    require(same_data, "--resume", run_dir, "the demonstrations are no longer those that the run began with")
    if is_done(run_dir, args, last_update):
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
    torch.set_flush_denormal(True)
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    stop = StopSignal()

    frame_mean = np.concatenate([episode.frames for episode in episodes.training]).mean(0) / 255
    num_actions = max(int(episode.actions.max()) for episode in episodes.training) + 1
    model, optimizer = new_model(args, frame_mean, num_actions, device)
    data = Sequence(*(column.to(device) for column in in_a_row(episodes.training, model.normalizer())))
    update, training_seconds, offset, objectives, models = 0, 0.0, 0, [], []
    if checkpoint is not None:
        update, training_seconds, offset = checkpoint["update"], checkpoint["training_seconds"], checkpoint["offset"]
        objectives, models = checkpoint["objectives"], checkpoint["models"]
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
    is_compiled = args.compile and update < last_update and compile_step(model, data, args)
    if checkpoint is not None:
        torch.set_rng_state(checkpoint["torch_rng"])
    arithmetic = f"{'compiled' if is_compiled else 'plain'} on {device.type}"
    if checkpoint and update < last_update and checkpoint["arithmetic"] != arithmetic:
        print(f"--resume: was {checkpoint['arithmetic']}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    updates_csv = CsvLog(run_dir / "updates.csv", offset)
    forget_end(run_dir, update < last_update)
    writer = SummaryWriter(str(run_dir), purge_step=update + 1)
    progress = tqdm(total=last_update, initial=update, unit="update", disable=None)
    last_time = time.perf_counter()

    while update < last_update:
        if update and update % args.total_updates == 0:  # the next attempt
            model, optimizer = new_model(args, frame_mean, num_actions, device)
            if is_compiled:
                compile_step(model, data, args)
        terms = train_step(model, optimizer, data, update)
        update += 1
        progress.update(1)
        if update % args.total_updates == 0:
            objectives.append(objective(model, data))
            models.append({name: value.clone() for name, value in model.state_dict().items()})
        crossed = update % args.checkpoint_interval == 0
        ends = update % args.total_updates == 0 or update == last_update
        if not (update % LOG_INTERVAL == 0 or crossed or stop.received or ends):
            continue
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        metrics = {f"losses/{name}": value.item() for name, value in terms.items()}
        if update % LOG_INTERVAL == 0 or update % args.total_updates == 0:
            updates_csv.write({"global_step": update, **metrics})
            add_scalars(writer, {**metrics, "charts/updates_per_second": update / training_seconds}, update)
        if not all(parameter.isfinite().all() for parameter in model.parameters()):
            raise RunError(f"update {update}: the model's parameters are no longer finite (last metrics: {metrics})")
        if crossed or stop.received or update == last_update:
            state = {
                "args": arguments(args),
                "arithmetic": arithmetic,
                "data": data_id,
                "update": update,
                "training_seconds": training_seconds,
                "offset": updates_csv.sync(),
                "objectives": objectives,
                "models": models,
                "model": model.state_dict(),
                "optimizer": optimizer.state_dict(),
                "torch_rng": torch.get_rng_state(),
            }
            writer.flush()
            save_checkpoint(run_dir, state)
        if stop.received and update < last_update:
            progress.close()
            writer.close()
            print(f"stopped by signal {stop.received} after update {update}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    measured = {"attempts": []}
    if models:
        scores, agreed = attempts_scores(model, models, episodes.heldout, device)
        measured["attempts"] = [{"objective": value, **each} for value, each in zip(objectives, scores)]
        measured |= {"agreed": agreed} if len(models) > 1 else {}
        model.load_state_dict(models[int(np.argmax(objectives))])
    finish_run(model, measured, episodes, args, run_dir, update, training_seconds, device, writer)
    writer.close()
    return 0


def finish_run(
    model: HWM,
    measured: dict,
    episodes: Split,
    args: Args,
    run_dir: Path,
    update: int,
    seconds,
    device,
    writer,
) -> None:
    """Measure, draw Fig. 3.4, save what was asked for, and write `result.json` last; `measured` is of all attempts."""
    segmentation = {**evaluate(model, episodes, args, device), **measured}
    write_json(run_dir / "segmentation.json", segmentation)
    scores = {f"eval/{name}": value for name, value in segmentation["prior"].items() if isinstance(value, float)}
    add_scalars(writer, scores, update)
    draw_figure(model, longest_way(episodes.heldout), device, run_dir / "figure_3_4.png")
    if args.save_model:
        content = safetensors.torch.save(model.state_dict(), {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", content)
    versions = {module.__name__: module.__version__ for module in (np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": update,
        "complete": update == args.attempts * args.total_updates,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training_seconds": seconds,
        "updates_per_second": update / seconds,
        "peak_memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        / (1024 if sys.platform == "linux" else 1024**2),
        "versions": {**versions, "python": platform.python_version()},
        "script_sha256": SCRIPT_SHA256,
    }
    write_json(run_dir / "result.json", result)
    print_table(segmentation)


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
