"""DDPG on a driving task: the reinforcement learning expert of the hybrid by GAIL (thesis section 2.4.3).

    python cleanrl_thesis/ddpg_torcs_like.py --compile --save-demos 220 --run-dir runs/expert      # for gail_hybrid.py
    python cleanrl_thesis/ddpg_torcs_like.py --track-name hills --noise ou
    python cleanrl_thesis/ddpg_torcs_like.py --env-id Pendulum-v1 --total-timesteps 50000 --num-envs 1 --frame-skip 1

Tasks: the simulator, which is built in (`gymnasium.make("cleanrl_thesis.ddpg_torcs_like:TorcsLike-v0")`), and any
Gymnasium environment with flat `Box` observations and bounded `Box` actions. `--run-dir DIR --resume` can be sent again
after every crash: on the same machine the run ends with the same bytes.

| setting | value | source |
|---|---|---|
| steps, replay buffer | 10,000,000; 1,000,000 | section 2.4.3 |
| learning rate of actor and critic | 1e-4, 1e-3 | OpenAI Baselines' defaults; section 2.4.3 names them the other way round |
| both annealed to 0 | on | ours; Baselines' are constant |
| policy that is kept | the one with the highest mean minus standard deviation of its returns in 200 episodes, which are played every 200,000 steps and serve nothing else | ours; Baselines' is the last |
| γ, τ, batch, L2 of the critic, layer norm | 0.99, 0.01, 64, 1e-2, on | OpenAI Baselines' defaults |
| observations | normalised by running statistics, clipped to 5 standard deviations, each taken as at least 0.1 | OpenAI Baselines' defaults |
| updates | 50 after every 100 steps | OpenAI Baselines' defaults; there 100 steps are 100 actions, here 20, for each is held for 5 steps |
| noise | on the parameters, adapted to an action distance of 0.2 | OpenAI Baselines' defaults |
| network | 64-64 with ReLU, the action enters the critic's second layer | OpenAI Baselines' defaults |
| an action | held for 5 steps, 0.1 s; the reward is scaled by 0.1 | ours; Baselines has 1 and 1 |
| cars side by side | 10, each with a perturbed actor of its own, drawn anew every 10 s; from all of the noise for the first to none for the last | ours; Baselines has one |

The driving task stands in for TORCS with the wrapper of the study: the same 65 observations, two actions and rewards, a
car with the numbers of TORCS' car1-trb1, and roads of the same length, width and least radius as TORCS' tracks (but
15 m for 12.2 m in `city`). It is flat, so the vertical speed that is observed is always 0.
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
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Literal, NamedTuple

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
    exp_name: str = "ddpg_torcs_like"
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
    eval_episodes: int = 20
    """episodes of the evaluation at the end, without noise"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 100_000
    """steps between checkpoints; the replay file has room for two intervals beyond `--buffer-size`"""
    stop_at: int | None = None
    """end at this step of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: str = "TorcsLike-v0"
    """the environment: TorcsLike-v0 or a Gymnasium id with flat Box observations and bounded Box actions (ours; section 2.4.3
    has TORCS)"""
    track_name: str = "meadow"
    """the road of TorcsLike-v0: meadow, speedway, hills or city (ours, after roads of TORCS)"""
    reward: Literal["distance", "speed"] = "distance"
    """TorcsLike-v0: metres of progress, or the speed along the road in km/h; -1 for a crash; evaluations, the policy that is
    kept and demonstrations count metres in any case (section 2.4.3; speed: the study's code)"""
    brake: bool = True
    """TorcsLike-v0: negative throttle brakes; off: it coasts, as in gym_torcs (ours)"""
    total_timesteps: int = 10_000_000
    """environment steps (section 2.4.3)"""
    num_envs: int = 10
    """environments side by side (ours; Baselines has one)"""
    frame_skip: int = 5
    """steps for which an action is held; all other numbers of steps count each of them (ours; Baselines has 1)"""
    actor_learning_rate: float = 1e-4
    """Adam's learning rate for the actor (Baselines)"""
    learning_rate: float = 1e-3
    """Adam's learning rate for the critic (Baselines)"""
    anneal_lr: bool = True
    """anneal both learning rates linearly to 0 (ours); off: constant (Baselines)"""
    keep_best_every: int = 200_000
    """steps between evaluations of 200 episodes without noise, and one at the end: the policy is kept whose returns have the
    highest mean minus standard deviation (ours); 0: the last (Baselines)"""
    critic_l2: float = 1e-2
    """weight of half the squared weights of the critic's two hidden layers in its loss (Baselines, there of three layers)"""
    hidden_size: int = 64
    """units in each of the two hidden layers (Baselines)"""
    layer_norm: bool = True
    """normalise the hidden layers (Baselines)"""
    norm_obs: bool = True
    """bring observations to mean 0 and standard deviation 1 by running statistics, clipped to ±5 (Baselines)"""
    buffer_size: int = 1_000_000
    """transitions in the replay buffer, 536 bytes each with TorcsLike-v0 (section 2.4.3)"""
    gamma: float = 0.99
    """discount factor γ of one action, which is `--frame-skip` steps (Baselines)"""
    tau: float = 0.01
    """share of the networks that goes into the target networks with each update (Baselines)"""
    batch_size: int = 64
    """transitions per update (Baselines)"""
    rollout_steps: int = 100
    """environment steps between updates (Baselines)"""
    train_steps: int = 50
    """updates after them (Baselines)"""
    reward_scale: float = 0.1
    """factor of the reward in training (ours; Baselines has 1)"""
    noise: Literal["parameter", "ou", "gaussian", "none"] = "parameter"
    """noise on the actor's parameters, or on its actions: Ornstein-Uhlenbeck or Gaussian (Baselines)"""
    noise_std: float = 0.2
    """standard deviation of the noise on actions; for noise on the parameters the distance of actions aimed at (Baselines)"""
    noise_ladder: bool = True
    """the first environment has all of the noise, the last none, those between shares of it; off: each has all (ours)"""
    perturb_interval: int = 500
    """steps of an environment after which its perturbed actor is drawn anew, as at the start of each episode (ours)"""
    adapt_interval: int = 50
    """updates between changes of the size of the noise on the parameters (Baselines)"""

    # to be filled in runtime
    num_iterations: tyro.conf.Suppress[int] = 0
    """total_timesteps // rollout_steps"""


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
        "num_envs frame_skip batch_size buffer_size eval_episodes checkpoint_interval stop_at hidden_size "
        "rollout_steps perturb_interval adapt_interval"
    )
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate actor_learning_rate", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("reward_scale", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("critic_l2", lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("noise_std", lambda x: 0 <= x <= MAX_NOISE, f"must be between 0 and {MAX_NOISE:g}"),
        ("gamma tau", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos train_steps keep_best_every", lambda x: x >= 0, "must be at least 0"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    require(args.track_name in TRACKS, "--track-name", args.track_name, f"must be one of {', '.join(TRACKS)}")
    at_once = args.num_envs * args.frame_skip
    whole = args.rollout_steps % at_once == 0
    require(whole, "--rollout-steps", args.rollout_steps, f"must be a multiple of --num-envs · --frame-skip, {at_once}")
    args.num_iterations = args.total_timesteps // args.rollout_steps
    allowed = f"must be at least --rollout-steps, {args.rollout_steps}"
    require(args.num_iterations >= 1, "--total-timesteps", args.total_timesteps, allowed)
    fits = args.batch_size <= args.buffer_size
    require(fits, "--batch-size", args.batch_size, f"must be at most --buffer-size, {args.buffer_size}")
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UsageError("--track: needs Weights and Biases: pip install wandb")
    if args.capture_video and importlib.util.find_spec("moviepy") is None:
        raise UsageError("--capture-video: needs moviepy: pip install moviepy")
    return args


# ---------------------------------------------------------------------------------------------------------------------
# The driving task
# ---------------------------------------------------------------------------------------------------------------------
FPS, EPISODE_STEPS = 50, 3_000  # a control step is 0.02 s, an episode at most 60 s
SUBSTEPS = 2  # of the physics in a control step
RANGE = 200.0  # m, of the range finders and of the sensors for other cars
START = 200.0  # m from the start line
PARKED = (300, 400, 500, 600, 700, 800, 870, 1_000, 1_200, 1_630)  # m from the start line, of ten cars in the way
PARKED_LEFT = (0.5, -0.5, 0.4, -0.6, 0.0, 0.5, -0.4, 0.6, -0.5, 0.3)  # 1 at the left edge of the road, -1 at its right
TRACKS = {  # width in m, then length in m of each straight, and radius in m / degrees to the left of each arc
    "meadow": (15, "369.2 80/90 94.8 60/-60 121.5 60/110 89.3 90/60 * 120/-40 95.3 60/110 * 100/90"),
    "speedway": (25, "430 100/90 210 100/90 * 100/90 * 100/90"),
    "hills": (
        11,
        "567 37/110 119.6 50/-80 266 70/90 210.6 45/-60 173.7 37/120 280.8 120/60 394.1 60/-70 * 50/90 * 90/100",
    ),
    "city": (10, "536.9 15/90 360 15/90 90.6 20/-90 310 30/90 210.6 15/90 287.5 15/-90 * 20/90 * 25/90"),
}  # long, wide and curved as TORCS' g-track-1, a-speedway, ruudskogen and aalborg; the two * close the road


def arc(length, curvature, heading=0.0):
    """Where a path of constant curvature ends, (2, ...): it begins at the origin with the given heading."""
    middle = heading + curvature * length / 2
    chord = length * np.sinc(curvature * length / (2 * np.pi))
    return chord * np.stack([np.cos(middle), np.sin(middle)])


class Track:
    """A closed road of straights and arcs, in arrays with one number for each segment; arcs turn by at most 90 degrees.

    A place on the road is a segment, the way `along` it in m and the way `left` of its middle in m.
    """

    def __init__(self, width: float, plan: str):
        """`plan` as in TRACKS; without a * the road need not close."""
        lengths, curvatures, free = [], [], []
        for piece in plan.split():
            if "/" in piece:
                radius, degrees = map(float, piece.split("/"))
                parts = math.ceil(abs(degrees) / 90)
                lengths += [radius * math.radians(abs(degrees)) / parts] * parts
                curvatures += [math.copysign(1 / radius, degrees)] * parts
            else:
                free += [len(lengths)] if piece == "*" else []
                lengths.append(0.0 if piece == "*" else float(piece))
                curvatures.append(0.0)
        self.half_width = width / 2
        self.lengths, self.curvatures = np.array(lengths), np.array(curvatures)
        self.headings = np.concatenate([[0.0], np.cumsum(self.lengths * self.curvatures)[:-1]])  # at the beginning
        if free:
            gap = arc(self.lengths, self.curvatures, self.headings).sum(1)
            self.lengths[free] = np.linalg.solve(arc(1.0, 0.0, self.headings[free]), -gap)
        steps = arc(self.lengths, self.curvatures, self.headings)
        self.starts = np.concatenate([np.zeros((2, 1)), np.cumsum(steps, 1)], 1)[:, :-1]  # (2, S), x and y
        self.distances = np.concatenate([[0.0], np.cumsum(self.lengths)])[:-1]  # from the start line
        self.length = float(self.lengths.sum())
        radii = 1 / np.where(self.curvatures == 0, 1.0, np.abs(self.curvatures))
        columns = self.lengths, np.sign(self.curvatures), radii
        self.sensed = np.stack(columns).astype(np.float32)  # (3, S), what the range finders need

    def place(self, distance: np.ndarray, left: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Distance from the start line and way to the left -> segment, x and y (2, ...), heading of the road."""
        segment = np.searchsorted(self.distances, distance % self.length, "right") - 1
        along = distance % self.length - self.distances[segment]
        heading = self.headings[segment] + self.curvatures[segment] * along
        middle = self.starts[:, segment] + arc(along, self.curvatures[segment], self.headings[segment])
        return segment, middle + left * np.stack([-np.sin(heading), np.cos(heading)]), heading

    def locate(self, segment: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Way along the given segments and to the left of their middle, each (N,), of points (2, N) near them."""
        x, y = xy - self.starts[:, segment]
        cosine, sine = np.cos(self.headings[segment]), np.sin(self.headings[segment])
        ahead, aside = cosine * x + sine * y, cosine * y - sine * x
        curvature = self.curvatures[segment]
        is_straight = curvature == 0
        radius = 1 / np.where(is_straight, 1.0, curvature)  # negative to the right
        sign, outward = np.sign(radius), np.abs(radius) - np.sign(radius) * aside
        along = np.where(is_straight, ahead, np.abs(radius) * np.arctan2(ahead, outward))
        return along, np.where(is_straight, aside, sign * (np.abs(radius) - np.hypot(ahead, outward)))

    def follow(self, segment: np.ndarray, xy: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """As `locate`, after moving on to the segment that each point is beside now."""
        along, left = self.locate(segment, xy)
        moved = np.flatnonzero((along < 0) | (along >= self.lengths[segment]))
        if len(moved):
            segment = segment.copy()
            segment[moved] = (segment[moved] + np.where(along[moved] < 0, -1, 1)) % len(self.lengths)
            along[moved], left[moved] = self.locate(segment[moved], xy[:, moved])
        return segment, along, left

    def ranges(self, segment, along, left, cosine, sine) -> np.ndarray:
        """Distance to the road's edge along R rays from each of M places on the road, at most RANGE, (M, R).

        Places are (M,); the rays' directions relative to the road are given by cosine and sine, (M, R). A ray is
        followed from segment to segment, in the frame of the place where it enters one: x along the road, y to the left.
        """
        shape, found = cosine.shape, np.full(cosine.size, RANGE, np.float32)
        rays, travelled = np.arange(cosine.size).reshape(cosine.shape), np.zeros_like(cosine)
        while rays.size:
            length, sign, radius = self.sensed[:, segment]
            wall, leave, left_end, cosine_end, sine_end = (np.empty_like(cosine) for _ in range(5))
            for rows, across in ((sign == 0, across_straight), (sign != 0, across_arc)):
                rows = np.flatnonzero(rows)
                state = (column[rows, None] for column in (along, left, length, sign, radius))
                ends = across(cosine[rows], sine[rows], *state, self.half_width)
                wall[rows], leave[rows], left_end[rows], cosine_end[rows], sine_end[rows] = ends
            hits = wall <= leave
            found[rays[hits]] = (travelled + wall)[hits]
            travelled += leave
            goes_on = ~hits & (travelled < RANGE)
            forward = (cosine >= 0)[goes_on]
            segment = np.broadcast_to(segment[:, None], hits.shape)[goes_on] + np.where(forward, 1, -1)
            segment %= len(self.lengths)
            along, left = np.where(forward, 0, self.sensed[0, segment]), left_end[goes_on]
            columns = rays, travelled, cosine_end, sine_end
            rays, travelled, cosine, sine = (column[goes_on][:, None] for column in columns)
        return np.clip(found, 0, RANGE).reshape(shape)


def across_straight(cosine, sine, along, left, length, sign, radius, half_width):
    """Follow rays in straights: way to the road's edge, way to the segment's end, and the rays' `left`, cosine and sine there.

    All are (M, R) or broadcast to it; `sign` and `radius` are those of `across_arc`, which is called alike.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        wall = (np.copysign(half_width, sine) - left) / sine
        leave = np.where(cosine >= 0, length - along, along) / np.abs(cosine)
    return wall, leave, left + leave * sine, cosine, sine


def across_arc(cosine, sine, along, left, length, sign, radius, half_width):
    """As `across_straight`, in arcs to the left (`sign` 1) or to the right (-1)."""
    own = radius - sign * left  # distance from the centre
    inward = sign * sine
    nearest = (own * cosine) ** 2  # square of the ray's least distance from the centre
    inner = (radius - half_width) ** 2 - nearest
    meets_inner = (inward > 0) & (inner > 0)
    root = np.sqrt(np.where(meets_inner, inner, np.maximum((radius + half_width) ** 2 - nearest, 0)))
    wall = own * inward + np.where(meets_inner, -root, root)

    ahead, behind = (length - along) / radius, -along / radius  # turns of the road until the segment's ends
    cosine_turn = np.where(cosine >= 0, np.cos(ahead), np.cos(behind))
    sine_turn = np.where(cosine >= 0, np.sin(ahead), np.sin(behind))
    cosine_end = cosine * cosine_turn + inward * sine_turn
    sine_end = sine * cosine_turn - sign * cosine * sine_turn
    with np.errstate(divide="ignore", invalid="ignore"):
        leave = np.where(cosine_end * cosine > 0, own * sine_turn / cosine_end, np.inf)
        outward = leave * cosine * sine_turn + (own - leave * inward) * cosine_turn
        return wall, leave, sign * (radius - outward), cosine_end, sine_end


# The car is TORCS' car1-trb1, as far as its file says; what is marked "ours" is a guess that fits it.
MASS = 1_150 + 94 * 0.75  # kg, with 94 l of fuel
FRONT_AXLE, REAR_AXLE = 1.22, 1.42  # m before and behind the centre of mass
YAW_INERTIA = MASS * FRONT_AXLE * REAR_AXLE  # kg m²; ours
HEIGHT = 0.3  # m, of the centre of mass; ours
CAR_LENGTH, CAR_WIDTH, HALF_TRACK = 4.52, 1.94, 0.8  # m; half the distance between wheels of an axle is ours
STEERING_LOCK = np.radians(21)
GRIP = 1.6  # µ
SLIDING = 0.85  # share of the grip that is left when a tyre slides; ours
STIFFNESS = 15.0  # of the tyre, so that the grip is greatest at a slip of 0.15; ours
SLIP_FLOOR = 3.0  # m/s, least speed that slip is measured against: the model has no rest
DRAG = 0.5 * 1.2 * 0.35 * 1.92  # N / (m/s)²
WHEEL_RADIUS, WHEEL_INERTIA = 0.33, 2.4  # m, and kg m² of an axle's two wheels; ours
ENGINE_INERTIA = 0.1  # kg m²; ours
TORQUE = (100.0, 483.0)  # N m at full throttle, at rest and from 8,000 rpm on
TORQUE_SLOPE = (483 - 100) / 8_000  # N m / rpm
IDLE_RPM, LIMIT_RPM = 1_000.0, 9_152.0
GEARS = 4.5 * np.array([3.0, 1.9, 1.4, 1.1, 0.9, 0.77])  # engine turns for a turn of the wheels
GEAR_SPEEDS = np.array([50, 80, 110, 140, 170]) / 3.6  # m/s from which the next gear is taken
GEAR_GAP = 10 / 3.6  # m/s that the speed has to fall below that for the gear to be left again; ours
SHIFT_TIME = 0.15  # s without drive
BRAKE = np.array([0.54, 0.46]) * 1.1 * MASS * 9.81 * WHEEL_RADIUS  # N m at the axles; 1.1 g in all is ours
RAYS = -np.radians(np.arange(-90, 91, 10))  # from the left of the car to its right
CORNERS = np.array([[1, 1, -1, -1], [1, -1, -1, 1]]) * np.array([[CAR_LENGTH], [CAR_WIDTH]]) / 2  # (2, 4)
OUTLINE = np.concatenate([np.linspace(CORNERS[:, i - 1], CORNERS[:, i], n)[1:] for i, n in enumerate((17, 8, 17, 8))]).T
NEAR = 20.0  # m, within which other cars are seen by points of their outline, and not only by their nearest corner


def turned(xy: np.ndarray, angle: np.ndarray) -> np.ndarray:
    """Points (2, ...) turned to the left by angles (...)."""
    (x, y), cosine, sine = xy, np.cos(angle), np.sin(angle)
    return np.array([cosine * x - sine * y, sine * x + cosine * y])


def wrapped(angle: np.ndarray) -> np.ndarray:
    """The same angle between -π and π."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


def tyre_force(slip: np.ndarray, load: np.ndarray) -> np.ndarray:
    """Force of a tyre in N at a combined slip, under a load in N: grows, peaks at load · GRIP, and falls to SLIDING of it."""
    shape = 2 - 2 / np.pi * np.arcsin(SLIDING)
    return GRIP * load * np.sin(shape * np.arctan(STIFFNESS * slip))


class Cars:
    """N cars that drive alone on the same road among parked ones: a dynamic bicycle model on tyres that saturate.

    The single and the vectorised environment are both made from this, so they agree bit for bit.
    """

    changing = "xy velocity spin yaw yaw_rate push shifting raced segment gear steps along left angle"

    def __init__(self, num_cars: int, track: Track, brake: bool = True):
        self.track, self.brake = track, brake
        self.xy, self.velocity, self.spin = (np.zeros((2, num_cars)) for _ in range(3))  # velocity: ahead, to the left
        self.yaw, self.yaw_rate, self.push, self.shifting, self.raced = (np.zeros(num_cars) for _ in range(5))
        self.segment, self.gear, self.steps = (np.zeros(num_cars, int) for _ in range(3))
        self.along, self.left, self.angle = (np.zeros(num_cars) for _ in range(3))
        _, self.parked, self.parked_yaw = track.place(np.array(PARKED), np.array(PARKED_LEFT) * track.half_width)
        yaw = self.parked_yaw[:, None]
        self.corners = self.parked[:, :, None] + turned(CORNERS[:, None], yaw)  # (2, P, 4)
        self.outlines = self.parked[:, :, None] + turned(OUTLINE[:, None], yaw)  # (2, P, 46)

    def state_dict(self) -> dict[str, np.ndarray]:
        """All arrays that change, by name."""
        return {name: getattr(self, name) for name in self.changing.split()}

    def load_state_dict(self, state: dict[str, np.ndarray]) -> None:
        vars(self).update({name: state[name] for name in self.changing.split()})

    def begin(self, car: int, rng: np.random.Generator) -> None:
        """Put a car at rest near the middle of the road, START from the start line."""
        left, turn = rng.uniform(-0.25, 0.25) * self.track.half_width, rng.uniform(-0.05, 0.05)
        segment, xy, heading = self.track.place(np.array(START), np.array(left))
        self.xy[:, car], self.yaw[car], self.segment[car] = xy, heading + turn, segment
        self.along[car], self.left[car], self.angle[car] = START - self.track.distances[segment], left, -turn
        for array in (self.velocity, self.spin, self.yaw_rate, self.push, self.shifting, self.raced):
            array[..., car] = 0
        self.gear[car] = self.steps[car] = 0

    def step(self, actions: np.ndarray) -> np.ndarray:
        """Drive for one control step by steering and throttle, (N, 2) in [-1, 1]; return the progress (N,) in m."""
        steering, pedal = np.clip(actions.T.astype(np.float64), -1, 1)
        before = self.track.distances[self.segment] + self.along
        self.change_gear()
        cosine, sine = np.cos(steering * STEERING_LOCK), np.sin(steering * STEERING_LOCK)
        throttle, brake = np.maximum(pedal, 0), np.maximum(-pedal, 0) * self.brake
        for _ in range(SUBSTEPS):
            self.substep(cosine, sine, throttle, brake)
        self.segment, self.along, self.left = self.track.follow(self.segment, self.xy)
        road = self.track.headings[self.segment] + self.track.curvatures[self.segment] * self.along
        self.angle = wrapped(road - self.yaw)
        progress = self.track.distances[self.segment] + self.along - before
        half = self.track.length / 2
        progress = (progress + half) % self.track.length - half
        self.raced += progress
        self.steps += 1
        return progress

    def change_gear(self) -> None:
        """Choose the gear by the speed; while it changes there is no drive."""
        up = np.searchsorted(GEAR_SPEEDS, self.velocity[0], "right")
        down = np.searchsorted(GEAR_SPEEDS - GEAR_GAP, self.velocity[0], "right")
        gear = np.clip(self.gear, up, down)
        self.shifting = np.where(gear != self.gear, SHIFT_TIME, np.maximum(self.shifting - 1 / FPS, 0))
        self.gear = gear

    def rpm(self) -> np.ndarray:
        """Speed of the engine, (N,) in turns per minute; below idle the clutch slips."""
        return np.maximum(self.spin[1] * GEARS[self.gear] * 30 / np.pi, IDLE_RPM)

    def substep(self, cosine, sine, throttle: np.ndarray, brake: np.ndarray) -> None:
        """Integrate the equations of motion over 1 / (FPS · SUBSTEPS) s; spins implicitly, for they are stiff."""
        dt = 1 / (FPS * SUBSTEPS)
        ahead, left = self.velocity
        left_front, left_rear = left + FRONT_AXLE * self.yaw_rate, left - REAR_AXLE * self.yaw_rate
        rolling = np.array([ahead * cosine + left_front * sine, ahead])  # m/s along the wheels, front and rear
        lateral = np.array([left_front * cosine - ahead * sine, left_rear])  # across them
        reference = np.maximum(np.abs(rolling), SLIP_FLOOR)

        shift = self.push * HEIGHT
        load = MASS * np.array([9.81 * REAR_AXLE - shift, 9.81 * FRONT_AXLE + shift]) / (FRONT_AXLE + REAR_AXLE)
        sliding = self.spin * WHEEL_RADIUS - rolling
        slip = np.sqrt(sliding * sliding + lateral * lateral) / reference + 1e-9
        per_speed = tyre_force(slip, load) / (slip * reference)  # N / (m/s)

        ratio, rpm = GEARS[self.gear], self.rpm()
        runs = (self.shifting == 0) & (rpm < LIMIT_RPM)
        torque = throttle * np.minimum(TORQUE[0] + rpm * TORQUE_SLOPE, TORQUE[1]) * ratio * runs
        inertia = np.array([np.full_like(ratio, WHEEL_INERTIA), WHEEL_INERTIA + ENGINE_INERTIA * ratio**2])
        torque = np.array([np.zeros_like(torque), torque])
        resistance = inertia + dt * WHEEL_RADIUS**2 * per_speed
        spin = (inertia * self.spin + dt * (torque + WHEEL_RADIUS * per_speed * rolling)) / resistance
        most = dt * BRAKE[:, None] * brake / resistance
        self.spin = spin - np.clip(spin, -most, most)

        along_front, ahead_rear = per_speed * (self.spin * WHEEL_RADIUS - rolling)  # N, along the wheels
        across_front, left_rear = -per_speed * lateral
        ahead_front = along_front * cosine - across_front * sine
        left_front = along_front * sine + across_front * cosine
        self.push = (ahead_front + ahead_rear - DRAG * ahead * np.abs(ahead)) / MASS
        yaw_push = (FRONT_AXLE * left_front - REAR_AXLE * left_rear) / YAW_INERTIA
        pushes = np.array([self.push + left * self.yaw_rate, (left_front + left_rear) / MASS - ahead * self.yaw_rate])
        self.velocity = self.velocity + dt * pushes
        self.yaw_rate = self.yaw_rate + dt * yaw_push
        self.xy = self.xy + dt * turned(self.velocity, self.yaw + dt / 2 * self.yaw_rate)
        self.yaw = self.yaw + dt * self.yaw_rate

    def is_off_road(self) -> np.ndarray:
        return np.abs(self.left) > self.track.half_width

    def is_damaged(self) -> np.ndarray:
        """Which cars touch a parked one, (N,) bool."""
        ways = self.parked[:, None] - self.xy[:, :, None]  # (2, N, P)
        cars, others = np.nonzero((ways * ways).sum(0) < CAR_LENGTH**2 + CAR_WIDTH**2)
        damaged = np.zeros(len(self.yaw), bool)
        damaged[cars] |= overlap(ways[:, cars, others], self.yaw[cars], self.parked_yaw[others])
        return damaged

    def observe(self, cars: np.ndarray) -> np.ndarray:
        """What the cars of the given indices see, (N, 65) float32, in the order and scale of gym_torcs."""
        speeds = self.velocity[:, cars] * 3.6 / 300
        spins = self.spin[:, cars] + self.yaw_rate[cars] * HALF_TRACK / WHEEL_RADIUS * np.array([[[1]], [[-1]]])
        columns = [
            self.angle[cars, None] / np.pi,
            self.find_edges(cars) / RANGE,
            self.left[cars, None] / self.track.half_width,
            np.concatenate([speeds, np.zeros((1, len(cars)))]).T,
            spins.transpose(2, 1, 0).reshape(len(cars), 4) / 100,  # right and left of the front, then of the rear
            self.rpm()[cars, None] / 10_000,
            self.find_cars(cars) / RANGE,
        ]
        return np.concatenate(columns, 1, dtype=np.float32)

    def find_edges(self, cars: np.ndarray) -> np.ndarray:
        """Distance to the edge of the road along each of RAYS, (N, 19) in m; -1 for cars beside the road."""
        rays = (-self.angle[cars, None] + RAYS).astype(np.float32)
        places = self.segment[cars], self.along[cars].astype(np.float32), self.left[cars].astype(np.float32)
        found = self.track.ranges(*places, np.cos(rays), np.sin(rays))
        found[np.abs(self.left[cars]) > self.track.half_width] = -1
        return found

    def find_cars(self, cars: np.ndarray) -> np.ndarray:
        """Distance to the nearest parked car in each of 36 sectors of 10 degrees, (N, 36) in m, clockwise from the rear."""
        found = np.full((len(cars), 36), RANGE, np.float32)
        ways = self.parked[:, None] - self.xy[:, cars, None]  # (2, N, P)
        squares = (ways * ways).sum(0)
        for least, most, points in ((NEAR, RANGE + CAR_LENGTH, self.corners), (0, NEAR, self.outlines)):
            rows, others = np.nonzero((squares >= least**2) & (squares < most**2))
            x, y = points[:, others] - self.xy[:, cars[rows], None]
            if least:
                nearest = np.arange(len(rows)), (x * x + y * y).argmin(1)
                x, y = x[nearest][:, None], y[nearest][:, None]
            clockwise = self.yaw[cars[rows], None] - np.arctan2(y, x)  # from straight ahead
            sectors = np.floor(clockwise * (18 / np.pi)).astype(int) + 18
            np.minimum.at(found, (rows[:, None], sectors % 36), np.hypot(x, y).astype(np.float32))
        return np.minimum(found, RANGE)


def overlap(way: np.ndarray, yaw: np.ndarray, other_yaw: np.ndarray) -> np.ndarray:
    """Whether two cars touch, (M,) bool: no side of either has the other wholly beyond it.

    `way` (2, M) leads from the middle of the one to the middle of the other.
    """
    apart = np.zeros(len(yaw), bool)
    for own, turn in ((yaw, other_yaw - yaw), (other_yaw, yaw - other_yaw)):
        reach = np.abs(turned(CORNERS[:, :, None], turn)).max(1)  # (2, M), of the other along this one's axes
        apart |= (np.abs(turned(way, -own)) > reach + CORNERS[:, :1]).any(0)
    return ~apart


TORCS_LOW = np.repeat([-1, -0.005, -2, -3, -20, 0, 0], [1, 19, 1, 3, 4, 1, 36]).astype(np.float32)
TORCS_HIGH = np.repeat([1, 1, 2, 3, 20, 1, 1], [1, 19, 1, 3, 4, 1, 36]).astype(np.float32)
TORCS_OBSERVATIONS = gym.spaces.Box(TORCS_LOW, TORCS_HIGH)
TORCS_ACTIONS = gym.spaces.Box(-1, 1, (2,))


class TorcsRules:
    """What the single and the vectorised environment share: reward, end and information of each step (section 2.4.3)."""

    def set_rules(self, num_cars: int, track: str, reward: str, brake: bool, max_laps: float | None) -> None:
        if track not in TRACKS:
            raise ValueError(f"track {track}: must be one of {', '.join(TRACKS)}")
        if reward not in ("distance", "speed"):
            raise ValueError(f"reward {reward}: must be distance or speed")
        self.cars, self.reward = Cars(num_cars, Track(*TRACKS[track]), brake), reward
        self.most = np.inf if max_laps is None else max_laps * self.cars.track.length

    def drive(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, dict]:
        """Drive by actions (N, 2); return rewards, terminations and truncations, (N,), and information."""
        if actions.shape != (len(self.cars.yaw), 2) or not np.isfinite(actions).all():
            raise ValueError(f"actions {actions}: must be {len(self.cars.yaw)} pairs of finite numbers")
        cars = self.cars
        progress = cars.step(actions)
        crashed = cars.is_off_road() | cars.is_damaged()
        speed = cars.velocity[0] * np.cos(cars.angle)
        rewards = np.where(crashed, -1.0, progress if self.reward == "distance" else speed * 3.6)
        stands = (cars.steps > 50) & (speed < 1 / 3.6)
        terminated = crashed | stands | (np.cos(cars.angle) < 0) | (cars.raced >= self.most)
        truncated = (cars.steps >= EPISODE_STEPS) & ~terminated
        return rewards, terminated, truncated, {"progress": progress, "crashed": crashed}


class TorcsLikeEnv(gym.Env, TorcsRules):
    """One car. The end after 60 s is a truncation."""

    metadata = {"render_modes": ["rgb_array"], "render_fps": FPS}

    def __init__(self, render_mode=None, track="meadow", reward="distance", brake=True, max_laps=None):
        self.observation_space, self.action_space = copy.deepcopy((TORCS_OBSERVATIONS, TORCS_ACTIONS))
        self.render_mode, self.car = render_mode, np.zeros(1, int)
        self.set_rules(1, track, reward, brake, max_laps)

    def reset(self, *, seed: int | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        super().reset(seed=seed)
        self.cars.begin(0, self.np_random)
        return self.cars.observe(self.car)[0], {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict]:
        rewards, terminated, truncated, infos = self.drive(np.asarray(action)[None])
        info = {name: values[0].item() for name, values in infos.items()}
        obs = self.cars.observe(self.car)[0]
        return obs, float(rewards[0]), bool(terminated[0]), bool(truncated[0]), info

    def render(self) -> np.ndarray:
        return draw_car(self.cars, 0)


class TorcsLikeVectorEnv(gym.vector.VectorEnv, TorcsRules):
    """N cars, each alone on its road; an episode that ends is followed by a new one within the same step."""

    metadata = {
        "render_modes": ["rgb_array"],
        "render_fps": FPS,
        "autoreset_mode": gym.vector.AutoresetMode.SAME_STEP,
    }

    def __init__(self, num_envs=1, render_mode=None, track="meadow", reward="distance", brake=True, max_laps=None):
        self.num_envs, self.render_mode, self.all_cars = num_envs, render_mode, np.arange(num_envs)
        self.single_observation_space, self.single_action_space = copy.deepcopy((TORCS_OBSERVATIONS, TORCS_ACTIONS))
        self.observation_space = gym.vector.utils.batch_space(TORCS_OBSERVATIONS, num_envs)
        self.action_space = gym.vector.utils.batch_space(TORCS_ACTIONS, num_envs)
        self.set_rules(num_envs, track, reward, brake, max_laps)
        self.seed_cars(np.random.SeedSequence().generate_state(num_envs).tolist())

    def seed_cars(self, seeds: list[int]) -> None:
        if len(seeds) != self.num_envs:
            raise ValueError(f"{len(seeds)} seeds for {self.num_envs} cars")
        self.generators = [gym.utils.seeding.np_random(seed)[0] for seed in seeds]

    def begin(self, cars: np.ndarray) -> None:
        for car in cars:
            self.cars.begin(car, self.generators[car])

    def reset(self, *, seed: int | list[int] | None = None, options: dict | None = None) -> tuple[np.ndarray, dict]:
        """Begin every episode anew; a list of seeds gives each car what `TorcsLikeEnv.reset(seed=)` gives it."""
        if seed is not None:
            is_number = isinstance(seed, (int, np.integer))
            self.seed_cars(
                np.random.SeedSequence(int(seed)).generate_state(self.num_envs).tolist() if is_number else seed
            )
        self.begin(self.all_cars)
        return self.cars.observe(self.all_cars), {}

    def step(
        self, actions: np.ndarray, observes: bool = True
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict]:
        """Gymnasium's; without `observes`, which takes half of the time, all observations but the final ones are 0."""
        rewards, terminated, truncated, infos = self.drive(np.asarray(actions))
        over = terminated | truncated
        ended = over.nonzero()[0]
        obs = self.cars.observe(self.all_cars) if observes else np.zeros((self.num_envs, 65), np.float32)
        if len(ended):
            infos |= {"final_obs": obs.copy(), "_final_obs": over}
            if not observes:
                infos["final_obs"][ended] = self.cars.observe(ended)
            self.begin(ended)
            if observes:
                obs[ended] = self.cars.observe(ended)
        return obs, rewards, terminated, truncated, infos

    def render(self) -> tuple[np.ndarray, ...]:
        return tuple(draw_car(self.cars, car) for car in self.all_cars)


if "TorcsLike-v0" not in gym.registry:
    gym.register("TorcsLike-v0", TorcsLikeEnv, vector_entry_point=TorcsLikeVectorEnv)


def draw_car(cars: Cars, car: int, side: int = 480) -> np.ndarray:
    """View of a car from above for people, (side, side, 3) uint8: it drives upwards; below are its speed and a map."""
    fine, scale = 2 * side, 2 * side / 100  # drawn at twice the size, for smooth edges; 100 m are seen
    track, own = cars.track, cars.xy[:, car]
    upright = np.pi / 2 - cars.yaw[car]

    def pixels(xy: np.ndarray) -> list[tuple[float, float]]:
        x, y = turned(xy - own.reshape(2, *[1] * (xy.ndim - 1)), upright) * scale
        return list(zip((fine / 2 + x).tolist(), (0.75 * fine - y).tolist()))

    image = PIL.Image.new("RGB", (fine, fine), (120, 160, 96))
    pen = PIL.ImageDraw.Draw(image)
    distance = track.distances[cars.segment[car]] + cars.along[car] + np.arange(-40, 112, 2)
    stripes = np.arange(0, track.length, 10)
    for half, colour in ((1.08, (235, 235, 235)), (1.0, (84, 88, 94))):
        edges = [track.place(distance, np.full(len(distance), side * half * track.half_width))[1] for side in (1, -1)]
        pen.polygon(pixels(np.concatenate([edges[0], edges[1][:, ::-1]], 1)), colour)
    near = stripes[np.abs((stripes - distance[20] + track.length / 2) % track.length - track.length / 2) < 110]
    for start in near:
        ends = track.place(np.array([start, start + 4.0]), np.zeros(2))[1]
        pen.line(pixels(ends), (200, 200, 200), int(0.25 * scale))
    for i in range(cars.parked.shape[1]):
        pen.polygon(pixels(cars.parked[:, i, None] + turned(CORNERS, cars.parked_yaw[i])), (232, 170, 44))
    pen.polygon(pixels(own[:, None] + turned(CORNERS, cars.yaw[car])), (196, 40, 44))
    font = PIL.ImageFont.load_default(0.06 * fine)
    pen.rectangle((0, 0.9 * fine, fine, fine), fill=(40, 48, 56))
    left = (EPISODE_STEPS - cars.steps[car]) / FPS
    text = f"{cars.velocity[0, car] * 3.6:.0f} km/h", f"{cars.raced[car]:.0f} m", f"{left:.1f} s"
    for x, line in zip((0.04, 0.45, 0.8), text):
        pen.text((x * fine, 0.95 * fine), line, (255, 255, 255), font, "lm")
    outline = track.place(np.arange(0, track.length, 10), np.zeros(len(stripes)))[1]
    low, size = outline.min(1, keepdims=True), np.ptp(outline, axis=1).max()
    corner = np.array([[0.72], [0.26]]) * fine

    def on_map(xy: np.ndarray) -> list[tuple[float, float]]:
        x, y = corner + (xy - low) / size * 0.24 * fine * np.array([[1], [-1]])
        return list(zip(x.tolist(), y.tolist()))

    pen.line(on_map(np.concatenate([outline, outline[:, :1]], 1)), (255, 255, 255), 6)
    ((x, y),) = on_map(own[:, None])
    pen.ellipse((x - 10, y - 10, x + 10, y + 10), (196, 40, 44))
    return np.asarray(image.reduce(2))


def make_env(env_id: str, render_mode: str | None = None, **options) -> gym.Env:
    """Make an environment with flat `Box` observations and bounded `Box` actions. Raises UsageError."""
    drawn = {} if render_mode is None else {"render_mode": render_mode}  # not every environment knows the word
    try:
        env = gym.make(env_id, disable_env_checker=True, **drawn, **options)
    except (gym.error.Error, AttributeError, ImportError, OSError, TypeError, ValueError) as error:
        raise UsageError(f"--env-id {env_id}: {first_line(error)}") from None
    space, actions = env.observation_space, env.action_space
    is_flat = isinstance(space, gym.spaces.Box) and len(space.shape) == 1
    require(is_flat, "--env-id", env_id, f"needs flat Box observations, this one has {space}")
    is_bounded = isinstance(actions, gym.spaces.Box) and len(actions.shape) == 1 and actions.is_bounded()
    is_bounded = is_bounded and np.issubdtype(actions.dtype, np.floating)
    require(is_bounded, "--env-id", env_id, f"needs bounded flat Box actions of floats, this one has {actions}")
    return env


def is_driving(env_id: str) -> bool:
    return env_id.split(":")[-1] in ("TorcsLike", "TorcsLike-v0")


def env_options(args: Args) -> dict:
    """What the driving task is made with; nothing for other environments."""
    driving = {"track": args.track_name, "reward": args.reward, "brake": args.brake}
    return driving if is_driving(args.env_id) else {}


# ---------------------------------------------------------------------------------------------------------------------
# Networks
# ---------------------------------------------------------------------------------------------------------------------
class Actor(nn.Module):
    """π(s) in [-1, 1]: two hidden layers, normalised on request."""

    def __init__(self, obs_dim: int, action_dim: int, hidden_size: int, layer_norm: bool):
        super().__init__()
        self.first, self.second = nn.Linear(obs_dim, hidden_size), nn.Linear(hidden_size, hidden_size)
        self.norms = nn.ModuleList([nn.LayerNorm(hidden_size) if layer_norm else nn.Identity() for _ in range(2)])
        self.output = small_output(nn.Linear(hidden_size, action_dim))

    def forward(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (B, O) -> actions (B, A)."""
        hidden = torch.relu(self.norms[0](self.first(obs)))
        return torch.tanh(self.output(torch.relu(self.norms[1](self.second(hidden)))))


class Critic(nn.Module):
    """Q(s, a): two hidden layers; the action enters the second."""

    def __init__(self, obs_dim: int, action_dim: int, hidden_size: int, layer_norm: bool):
        super().__init__()
        self.first, self.second = nn.Linear(obs_dim, hidden_size), nn.Linear(hidden_size + action_dim, hidden_size)
        self.norms = nn.ModuleList([nn.LayerNorm(hidden_size) if layer_norm else nn.Identity() for _ in range(2)])
        self.output = small_output(nn.Linear(hidden_size, 1))

    def forward(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Observations (B, O) and actions (B, A) -> values (B,)."""
        hidden = torch.relu(self.norms[0](self.first(obs)))
        hidden = torch.relu(self.norms[1](self.second(torch.cat([hidden, actions], 1))))
        return self.output(hidden).squeeze(1)


class Agent(nn.Module):
    """Actor and critic, and mean and standard deviation of the observations that both are given normalised."""

    def __init__(self, obs_dim: int, action_dim: int, hidden_size: int, layer_norm: bool):
        super().__init__()
        self.actor = Actor(obs_dim, action_dim, hidden_size, layer_norm)
        self.critic = Critic(obs_dim, action_dim, hidden_size, layer_norm)
        self.register_buffer("obs_scale", torch.tensor([[0.0], [1.0]]).repeat(1, obs_dim))


def small_output(layer: nn.Linear) -> nn.Linear:
    """Begin with outputs near 0."""
    nn.init.uniform_(layer.weight, -3e-3, 3e-3)
    nn.init.uniform_(layer.bias, -3e-3, 3e-3)
    return layer


def numpy_actions(parameters: dict[str, np.ndarray], obs: np.ndarray) -> np.ndarray:
    """The actor in numpy, (N, O) -> (N, A): without torch's overhead of 100 µs for a few observations.

    `parameters` are the actor's by name; with a dimension of N in front, each observation has an actor of its own.
    """

    def linear(x: np.ndarray, name: str) -> np.ndarray:
        weight, bias = parameters[f"{name}.weight"], parameters[f"{name}.bias"]
        if weight.ndim == 2:
            return x @ weight.T + bias
        return (weight @ x[:, :, None])[:, :, 0] + bias

    def norm(x: np.ndarray, name: str) -> np.ndarray:
        if f"{name}.weight" not in parameters:
            return x
        x = x - x.mean(1, keepdims=True)
        x /= np.sqrt((x * x).mean(1, keepdims=True) + np.float32(1e-5))
        return x * parameters[f"{name}.weight"] + parameters[f"{name}.bias"]

    hidden = np.maximum(norm(linear(obs, "first"), "norms.0"), 0)
    return np.tanh(linear(np.maximum(norm(linear(hidden, "second"), "norms.1"), 0), "output"))


# ---------------------------------------------------------------------------------------------------------------------
# Playing, and the replay buffer
# ---------------------------------------------------------------------------------------------------------------------
EVALUATION_STREAM, DEMONSTRATION_STREAM = 1_000_000, 1_000_001
SELECTION_STREAM, SELECTION_EPISODES = 1_000_004, 200


@functools.lru_cache
def episode_seeds(seed: int, stream: int, block: int) -> list[int]:
    """Seeds of episodes 256 · block and on; a SeedSequence for each would take longer than the environment's reset."""
    return np.random.SeedSequence([seed, stream, block]).generate_state(256).tolist()


def episode_seed(seed: int, stream: int, episode: int) -> int:
    """Seed of an episode: sub-environment `stream` of run `seed`, or one of the streams that are not trained on."""
    return episode_seeds(seed, stream, episode // 256)[episode % 256]


class Steps(NamedTuple):
    """What a step of N environments gave."""

    next_obs: np.ndarray  # (N, O), the real one where an episode ended
    rewards: np.ndarray  # (N,)
    terminated: np.ndarray  # (N,) bool
    ended: list[tuple[int, float, int]]  # environment, return and length of each episode that ended


class GymPlayers:
    """Environments that are stepped in turn.

    Each reset has a seed of its own, so the episode's number and actions determine the environment's state: a
    checkpoint keeps those two, and they are played again on resume. Holds for every environment whose randomness comes
    from `reset(seed=)`.
    """

    def __init__(self, envs: list[gym.Env], seed: int):
        self.envs, self.seed = envs, seed
        self.numbers, self.actions, self.returns = [-1] * len(envs), [[] for _ in envs], [0.0] * len(envs)
        self.obs = np.zeros((len(envs), envs[0].observation_space.shape[0]), np.float32)

    def start(self) -> None:
        """Begin the first episode of each environment."""
        for i in range(len(self.envs)):
            self.begin(i)

    def begin(self, i: int) -> None:
        """Begin the next episode of an environment."""
        self.numbers[i] += 1
        self.actions[i], self.returns[i] = [], 0.0
        self.obs[i] = self.envs[i].reset(seed=episode_seed(self.seed, i, self.numbers[i]))[0]

    def step(self, actions: np.ndarray, observes: bool = True) -> Steps:
        """Apply an action (N, A) to each environment; begin anew those whose episode ends. It observes in any case."""
        rewards, terminated, ended = np.zeros(len(self.envs)), np.zeros(len(self.envs), bool), []
        over = []
        for i, env in enumerate(self.envs):
            self.actions[i].append(actions[i].copy())
            self.obs[i], rewards[i], terminated[i], truncated, _ = env.step(actions[i])
            self.returns[i] += rewards[i]
            if terminated[i] or truncated:
                ended.append((i, self.returns[i], len(self.actions[i])))
                over.append(i)
        next_obs = self.obs.copy()
        for i in over:
            self.begin(i)
        return Steps(next_obs, rewards, terminated, ended)

    def state_dict(self) -> dict:
        """All that `load_state_dict` restores, as tensors and plain values."""
        actions = [torch.from_numpy(np.array(actions, np.float32)) for actions in self.actions]
        return {"numbers": list(self.numbers), "actions": actions, "obs": torch.tensor(self.obs)}

    def load_state_dict(self, state: dict) -> bool:
        """Play the saved episodes again; return whether that gave the saved observations bit for bit."""
        for i, env in enumerate(self.envs):
            self.numbers[i] = state["numbers"][i] - 1
            self.begin(i)
            for action in state["actions"][i].numpy():
                self.obs[i], reward, _, _, _ = env.step(action)
                self.actions[i].append(action)
                self.returns[i] += float(reward)  # as in `step`, whose rewards are float64
        return np.array_equal(self.obs, state["obs"].numpy())


class CarPlayers:
    """The driving task's cars, stepped side by side; a checkpoint keeps their arrays. Used as `GymPlayers` is."""

    def __init__(self, games: TorcsLikeVectorEnv, seed: int):
        self.games, self.seed, self.numbers = games, seed, np.zeros(games.num_envs, int)
        self.returns = np.zeros(games.num_envs)

    def seed_next(self, i: int) -> None:
        """Give a car the seed of its episode of the present number."""
        self.games.generators[i] = gym.utils.seeding.np_random(episode_seed(self.seed, i, int(self.numbers[i])))[0]

    def start(self) -> None:
        for i in range(self.games.num_envs):
            self.seed_next(i)
        self.obs, _ = self.games.reset()
        for i in range(self.games.num_envs):
            self.numbers[i] += 1
            self.seed_next(i)

    def step(self, actions: np.ndarray, observes: bool = True) -> Steps:
        """As above; without `observes`, only the observations of episodes that end."""
        lengths = self.games.cars.steps + 1
        self.obs, rewards, terminated, truncated, infos = self.games.step(actions, observes)
        self.returns += rewards
        ended = []
        for i in np.flatnonzero(terminated | truncated):
            ended.append((int(i), float(self.returns[i]), int(lengths[i])))
            self.returns[i] = 0.0
            self.numbers[i] += 1
            self.seed_next(i)
        return Steps(infos.get("final_obs", self.obs), rewards, terminated, ended)

    def state_dict(self) -> dict:
        arrays = {"numbers": self.numbers, "returns": self.returns, "obs": self.obs, **self.games.cars.state_dict()}
        return {name: torch.from_numpy(array.copy()) for name, array in arrays.items()}

    def load_state_dict(self, state: dict) -> bool:
        arrays = {name: tensor.numpy().copy() for name, tensor in state.items()}
        self.numbers, self.returns, self.obs = (arrays.pop(name) for name in ("numbers", "returns", "obs"))
        self.games.cars.load_state_dict(arrays)
        for i in range(self.games.num_envs):
            self.seed_next(i)
        return np.array_equal(self.games.cars.observe(self.games.all_cars), self.obs)


def step_and_hold(players: GymPlayers | CarPlayers, actions: np.ndarray, frame_skip: int) -> Steps:
    """Hold actions (N, A) for `frame_skip` steps, with the sums of rewards until an episode's end.

    An episode that begins on the way is driven by the same action, and its steps until then are not learned from.
    """
    if frame_skip == 1:
        return players.step(actions)
    goes_on, terminated = np.ones(len(actions), bool), np.zeros(len(actions), bool)
    next_obs, rewards, ended = np.zeros_like(players.obs), np.zeros(len(actions)), []
    for t in range(frame_skip):
        steps = players.step(actions, observes=t == frame_skip - 1)
        next_obs[goes_on] = steps.next_obs[goes_on]
        rewards += goes_on * steps.rewards
        terminated |= goes_on & steps.terminated
        ended += steps.ended
        goes_on[[i for i, _, _ in steps.ended]] = False
    return Steps(next_obs, rewards, terminated, ended)


def held(policy, frame_skip: int):
    """A policy that acts anew every `frame_skip` steps, from the first on."""
    steps, actions = 0, None

    def act(obs: np.ndarray) -> np.ndarray:
        nonlocal steps, actions
        if steps % frame_skip == 0:
            actions = policy(obs)
        steps += 1
        return actions

    return act


def make_players(args: Args) -> GymPlayers | CarPlayers:
    """The environments to train in."""
    if is_driving(args.env_id):
        return CarPlayers(TorcsLikeVectorEnv(args.num_envs, **env_options(args)), args.seed)
    return GymPlayers([make_env(args.env_id) for _ in range(args.num_envs)], args.seed)


class RunningNorm:
    """Brings observations to mean 0 and standard deviation 1 by those of all that it has taken in, clipped to 5 (Baselines).

    Without `is_on` it changes nothing.
    """

    least = 0.1  # of the standard deviation (Baselines)

    def __init__(self, scale: torch.Tensor, is_on: bool):
        """`scale` (2, O) keeps mean and standard deviation; it is changed in place."""
        self.scale, self.is_on, self.limit = scale, is_on, 5.0 if is_on else math.inf
        self.count, self.sums = 0, np.zeros(scale.shape)  # of observations and of their squares
        self.mean, self.deviation = scale.cpu().numpy()

    def update(self, obs: np.ndarray) -> None:
        """Take in observations (N, O)."""
        if not self.is_on:
            return
        self.count += len(obs)
        self.sums += obs.sum(0), np.einsum("no,no->o", obs, obs, dtype=np.float64)
        mean, square = self.sums / self.count
        deviation = np.sqrt(np.maximum(square - mean * mean, self.least**2))
        self.set_scale(torch.from_numpy(np.stack([mean, deviation])))

    def set_scale(self, scale: torch.Tensor) -> None:
        """Normalise by another mean and standard deviation, (2, O)."""
        self.scale.copy_(scale)
        self.mean, self.deviation = self.scale.cpu().numpy()

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Observations (N, O) as the networks see them."""
        return np.clip((obs - self.mean) / self.deviation, -self.limit, self.limit)

    def state_dict(self) -> dict:
        return {"count": self.count, "sums": torch.from_numpy(self.sums.copy()), "scale": self.scale}

    def load_state_dict(self, state: dict) -> None:
        self.count, self.sums = state["count"], state["sums"].numpy().copy()
        self.set_scale(state["scale"])


def make_policy(optimizer: "FlatAdam", norm: RunningNorm, space: gym.spaces.Box):
    """The actor without noise as a function from observations (N, O) to the environment's actions (N, A)."""
    parameters = optimizer.actor_arrays(optimizer.actor_vector())
    return lambda obs: scaled(numpy_actions(parameters, norm(obs.astype(np.float32))), space)


def scaled(actions: np.ndarray, space: gym.spaces.Box) -> np.ndarray:
    """Actions (N, A) from [-1, 1] to the bounds of the environment's."""
    return (space.low + (actions + 1) / 2 * (space.high - space.low)).astype(np.float32)


class ReplayBuffer:
    """The last `capacity` transitions, in a file that is written in place: a checkpoint keeps only how many there were.

    A row is (obs (O,), action (A,), reward, discount of what follows, next obs (O,)). The ring has `spare` more rows, so
    that what a checkpoint counts is still there after `spare` further transitions.
    """

    def __init__(self, path: Path, capacity: int, spare: int, width: int, added: int = 0):
        """Go on in the file after `added` transitions, or begin it. Raises RunError where it is not the whole file."""
        self.capacity, self.slots, self.added = capacity, capacity + spare, added
        shape = (self.slots, width)
        size = 4 * math.prod(shape)
        if added and not (path.exists() and path.stat().st_size == size):
            raise RunError(f"{path}: not the replay buffer of the last checkpoint; the run cannot be resumed")
        path.touch()
        with open(path, "r+b") as file:  # not "a": file systems without fallocate of their own refuse it then
            if hasattr(os, "posix_fallocate"):
                os.posix_fallocate(file.fileno(), 0, size)  # a full disk is an error here, not a signal later
            file.truncate(size)
        self.rows = np.memmap(path, np.float32, "r+", shape=shape)
        self.array = np.asarray(self.rows)  # the same memory, without memmap's overhead on each access

    def add(self, obs, actions, rewards, discounts, next_obs) -> None:
        """Append N transitions, in this order."""
        slots = (self.added + np.arange(len(obs))) % self.slots
        columns = obs, actions, rewards[:, None], discounts[:, None], next_obs
        self.array[slots] = np.concatenate(columns, 1, dtype=np.float32, casting="same_kind")
        self.added += len(obs)

    def sample(self, batch_size: int, rng: np.random.Generator) -> torch.Tensor:
        """Uniformly drawn rows, (M, 2 O + A + 2)."""
        oldest = max(0, self.added - self.capacity)
        return torch.from_numpy(self.array[rng.integers(oldest, self.added, batch_size) % self.slots])

    def sync(self) -> int:
        """Bring everything onto the disk; return how many transitions there were."""
        self.rows.flush()
        return self.added


def noise_shares(args: Args) -> np.ndarray:
    """How much of the noise each environment has, (N,)."""
    return np.linspace(1, 0, args.num_envs) if args.noise_ladder else np.ones(args.num_envs)


MAX_NOISE = 10.0  # of parameters, which it drowns; no larger one brings actions further away


class ParameterNoise:
    """An actor for each environment with noise on its parameters (Plappert et al., 2018), but for those of the norms.

    The size of the noise is adapted so that the actions are `--noise-std` away from those without noise.
    """

    def __init__(self, optimizer: "FlatAdam", args: Args, action_dim: int, rng: np.random.Generator):
        self.optimizer, self.rng, self.target, self.size = optimizer, rng, args.noise_std, args.noise_std
        names = optimizer.actor_names
        sizes = [shape.numel() for shape in optimizer.shapes[: len(names)]]
        has_noise = np.concatenate([np.full(size, "norm" not in name) for name, size in zip(names, sizes)])
        self.mask, self.shares = has_noise.astype(np.float32), noise_shares(args)
        self.vectors = np.zeros((args.num_envs, len(self.mask)), np.float32)
        self.actors = optimizer.actor_arrays(self.vectors)

    def draw(self, share: float = 1.0) -> np.ndarray:
        """The actor's parameters with a share of the noise, (P,)."""
        noise = self.rng.standard_normal(len(self.mask), np.float32)
        return self.optimizer.actor_vector() + np.float32(share * self.size) * self.mask * noise

    def begin(self, i: int) -> None:
        """Perturb the actor of an environment anew."""
        self.vectors[i] = self.draw(self.shares[i])

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Observations (N, O) -> actions (N, A)."""
        return numpy_actions(self.actors, obs)

    def adapt(self, obs: np.ndarray) -> float:
        """Bring the size nearer to what `--noise-std` asks for, as measured in observations (M, O); return the distance."""
        noisy = numpy_actions(self.optimizer.actor_arrays(self.draw()), obs)
        way = noisy - numpy_actions(self.optimizer.actor_arrays(self.optimizer.actor_vector()), obs)
        distance = float(np.sqrt(np.mean(way * way)))
        self.size = min(self.size * (1 / 1.01 if distance > self.target else 1.01), MAX_NOISE)
        return distance

    def state_dict(self) -> dict:
        return {"size": self.size, "vectors": torch.from_numpy(self.vectors.copy())}

    def load_state_dict(self, state: dict) -> None:
        self.size = state["size"]
        self.vectors[:] = state["vectors"].numpy()


class ActionNoise:
    """Noise that is added to the actions: Gaussian, or Ornstein-Uhlenbeck with θ = 0.15 and steps of 0.01 (Baselines)."""

    def __init__(self, optimizer: "FlatAdam", args: Args, action_dim: int, rng: np.random.Generator):
        self.optimizer, self.rng, self.kind = optimizer, rng, args.noise
        self.size = 0.0 if args.noise == "none" else args.noise_std
        self.shares = noise_shares(args)[:, None]
        self.noise = np.zeros((args.num_envs, action_dim))

    def begin(self, i: int) -> None:
        """Begin the noise of an environment anew."""
        self.noise[i] = 0

    def act(self, obs: np.ndarray) -> np.ndarray:
        """Observations (N, O) -> actions (N, A)."""
        draws = self.size * self.rng.standard_normal(self.noise.shape)
        self.noise = self.noise * (1 - 0.15 * 0.01) + 0.1 * draws if self.kind == "ou" else draws
        actions = numpy_actions(self.optimizer.actor_arrays(self.optimizer.actor_vector()), obs)
        return np.clip(actions + self.shares * self.noise, -1, 1).astype(np.float32)

    def adapt(self, obs: np.ndarray) -> float:
        """Nothing to adapt."""
        return math.nan

    def state_dict(self) -> dict:
        return {"noise": torch.from_numpy(self.noise.copy())}

    def load_state_dict(self, state: dict) -> None:
        self.noise = state["noise"].numpy().copy()


class Best:
    """The policy whose returns in the evaluations for `--keep-best-every` have the highest mean minus standard deviation.

    By the mean alone, a fast policy that crashes in 9 of 200 episodes is better than a slower one that never crashes.
    """

    def __init__(self, optimizer: "FlatAdam", norm: RunningNorm):
        self.optimizer, self.norm = optimizer, norm
        self.vector, self.scale = optimizer.vector.clone(), norm.scale.clone()
        self.step, self.score, self.last_mean_return = 0, -math.inf, math.nan

    def consider(self, args: Args, space: gym.spaces.Box, step: int) -> None:
        """Evaluate the present policy, and keep it where none was better; `last_mean_return` is the mean of its returns."""
        seeds = [episode_seed(args.seed, SELECTION_STREAM, i) for i in range(SELECTION_EPISODES)]
        policy = held(make_policy(self.optimizer, self.norm, space), args.frame_skip)
        returns = [episode["rewards"].sum() for episode in play(policy, make_games(args, len(seeds)), seeds)]
        self.last_mean_return, score = float(np.mean(returns)), float(np.mean(returns) - np.std(returns))
        if score >= self.score:
            self.step, self.score = step, score
            self.vector.copy_(self.optimizer.vector)
            self.scale.copy_(self.norm.scale)

    def restore(self) -> None:
        """Make it the agent's, with the critic of that time; the last one stays where there was no evaluation."""
        if self.step:
            self.optimizer.vector.copy_(self.vector)
            self.norm.set_scale(self.scale)

    def state_dict(self) -> dict:
        names = ("vector", "scale", "step", "score", "last_mean_return")
        return {name: getattr(self, name) for name in names}

    def load_state_dict(self, state: dict) -> None:
        self.vector.copy_(state["vector"])
        self.scale.copy_(state["scale"])
        self.step, self.score, self.last_mean_return = state["step"], state["score"], state["last_mean_return"]


# ---------------------------------------------------------------------------------------------------------------------
# The algorithm
# ---------------------------------------------------------------------------------------------------------------------
class Minibatch(NamedTuple):
    """M transitions."""

    obs: torch.Tensor  # (M, O)
    actions: torch.Tensor  # (M, A)
    rewards: torch.Tensor  # (M,)
    discounts: torch.Tensor  # (M,), γ, or 0 where the episode ended
    next_obs: torch.Tensor  # (M, O)

    @classmethod
    def unpack(cls, rows: torch.Tensor, scale: torch.Tensor, limit: float) -> "Minibatch":
        """The transitions of the replay buffer's rows (M, 2 O + A + 2), observations as `RunningNorm` brings them."""
        obs_dim = scale.shape[1]
        action_dim = rows.shape[1] - 2 * obs_dim - 2
        obs, actions, rewards, discounts, next_obs = rows.split([obs_dim, action_dim, 1, 1, obs_dim], 1)
        obs, next_obs = (((part - scale[0]) / scale[1]).clamp(-limit, limit) for part in (obs, next_obs))
        return cls(obs, actions, rewards.squeeze(1), discounts.squeeze(1), next_obs)


def views(vector: torch.Tensor, shapes: list[torch.Size]) -> list[torch.Tensor]:
    """Cut a vector into tensors of the given shapes, without a copy."""
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes)]


class FlatAdam:
    """Adam over one vector, of which the agent's parameters become views, the actor's first; and the target networks'.

    One vector is stepped faster than two dozen tensors, and mixed at once into the target networks.
    """

    def __init__(self, agent: Agent, args: Args):
        self.actor_names, self.critic_names = ([n for n, _ in part.named_parameters()] for part in agent.children())
        parameters = list(agent.parameters())
        self.shapes = [parameter.shape for parameter in parameters]
        self.vector = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
        self.target = self.vector.clone()
        self.mean, self.square = torch.zeros_like(self.vector), torch.zeros_like(self.vector)
        self.step = torch.zeros((), device=self.vector.device)
        self.actor_size = sum(shape.numel() for shape in self.shapes[: len(self.actor_names)])
        self.initial_rates = torch.full_like(self.vector, args.learning_rate)
        self.initial_rates[: self.actor_size] = args.actor_learning_rate
        self.rates = self.initial_rates.clone()
        for parameter, value in zip(parameters, views(self.vector, self.shapes)):
            parameter.data = value

    def anneal(self, remaining: float) -> None:
        """Set the learning rates to a share of the initial ones."""
        torch.mul(self.initial_rates, remaining, out=self.rates)

    def networks(self, vector: torch.Tensor) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
        """The actor's and the critic's parameters by name, as views of a vector."""
        parts, split = views(vector, self.shapes), len(self.actor_names)
        return dict(zip(self.actor_names, parts[:split])), dict(zip(self.critic_names, parts[split:]))

    def actor_vector(self) -> np.ndarray:
        """The actor's parameters; on the CPU a view."""
        return self.vector[: self.actor_size].cpu().numpy()

    def actor_arrays(self, vectors: np.ndarray) -> dict[str, np.ndarray]:
        """Vectors of parameters (..., P) as the actor's by name, each with the same dimensions in front; views."""
        shapes = self.shapes[: len(self.actor_names)]
        parts = np.split(vectors, np.cumsum([shape.numel() for shape in shapes])[:-1], axis=-1)
        arrays = [part.reshape(*vectors.shape[:-1], *shape) for part, shape in zip(parts, shapes)]
        assert all(np.shares_memory(array, vectors) for array in arrays)
        return dict(zip(self.actor_names, arrays))

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


def compiled_gradient(loss, vector: torch.Tensor, *inputs) -> tuple[torch.Tensor, tuple]:
    """Gradient of `loss(vector, *inputs)[0]`, (P,), and the second of what it returns."""
    return torch.func.grad(loss, has_aux=True)(vector, *inputs)


def plain_gradient(loss, vector: torch.Tensor, *inputs) -> tuple[torch.Tensor, tuple]:
    """The same by autograd, which cannot be compiled, but takes less time where nothing is."""
    vector = vector.detach().requires_grad_()
    with torch.enable_grad():
        value, parts = loss(vector, *inputs)
    return torch.autograd.grad(value, vector)[0], parts


class Update:
    """One step of Adam on one minibatch, for actor and critic at once, and one of the target networks."""

    def __init__(self, agent: Agent, optimizer: FlatAdam, norm: RunningNorm, args: Args, example: torch.Tensor):
        """`example` are rows as they will come, (M, 2 O + A + 2)."""
        self.agent, self.optimizer, self.norm, self.args = agent, optimizer, norm, args
        self.weights = [f"{name}.weight" for name in ("first", "second")]
        self.step, self.is_compiled = self.plain_step, False
        if args.compile:
            self.compile(example)

    def compile(self, example: torch.Tensor) -> None:
        """Compile the step where a compiler is at hand."""
        compiler = os.environ.get("CXX", "g++")
        if shutil.which(compiler) is None:
            print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
            return
        compiled = torch.compile(self.plain_step, options={"cpp_wrapper": True})
        try:
            torch.compiler.set_stance("default")
            with torch.no_grad():  # compiles, and changes nothing but copies
                compiled(*(tensor.clone() for tensor in self.optimizer.state_dict().values()), self.norm.scale, example)
            torch.compiler.set_stance("default", skip_guard_eval_unsafe=True)  # every call is alike
            self.step, self.is_compiled = compiled, True
        except Exception as error:  # whatever the compiler's tool chain lacks, the plain step needs none of it
            print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)

    def actions(self, vector: torch.Tensor, obs: torch.Tensor) -> torch.Tensor:
        """π(s), (M, A), by the vector of parameters."""
        return torch.func.functional_call(self.agent.actor, self.optimizer.networks(vector)[0], (obs,))

    def values(self, vector: torch.Tensor, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Q(s, a), (M,), by the vector of parameters."""
        return torch.func.functional_call(self.agent.critic, self.optimizer.networks(vector)[1], (obs, actions))

    def target_values(self, target: torch.Tensor, minibatch: Minibatch) -> torch.Tensor:
        """r + γ Q'(s', π'(s')), (M,), by the target networks (Lillicrap et al. 2016, Algorithm 1)."""
        next_actions = self.actions(target, minibatch.next_obs)
        return minibatch.rewards + minibatch.discounts * self.values(target, minibatch.next_obs, next_actions)

    def loss(self, vector: torch.Tensor, minibatch: Minibatch, targets: torch.Tensor):
        """The critic's squared error with L2, plus the actor's -Q(s, π(s)), which changes the actor alone."""
        values = self.values(vector, minibatch.obs, minibatch.actions)
        critic = self.optimizer.networks(vector)[1]
        decay = 0.5 * self.args.critic_l2 * sum(critic[name].square().sum() for name in self.weights)
        critic_loss = F.mse_loss(values, targets)
        actor_loss = -self.values(vector.detach(), minibatch.obs, self.actions(vector, minibatch.obs)).mean()
        parts = critic_loss.detach(), actor_loss.detach(), values.mean().detach()
        return critic_loss + decay + actor_loss, parts

    def plain_step(self, vector, target, mean, square, step, scale, rows) -> tuple[torch.Tensor, ...]:
        """Change the parameters, those of the target networks and Adam's moments, (P,) each, and Adam's count, a scalar.

        scale (2, O), rows (M, 2 O + A + 2) -> losses of critic and actor, and the mean Q, as scalars.
        """
        minibatch = Minibatch.unpack(rows, scale, self.norm.limit)
        targets = self.target_values(target, minibatch)
        differentiate = compiled_gradient if torch.compiler.is_compiling() else plain_gradient
        gradient, parts = differentiate(self.loss, vector, minibatch, targets)
        adam_step(vector, mean, square, step, self.optimizer.rates, gradient, math.inf, 1e-8)
        target.lerp_(vector, self.args.tau)
        return parts

    def __call__(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Change the agent by the replay buffer's rows; return the losses of critic and actor and the mean Q."""
        with torch.no_grad():
            return self.step(*self.optimizer.state_dict().values(), self.norm.scale, rows)


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "ddpg_torcs_like 3"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "capture_video", "save_model", "save_demos")
# not checkpoint_interval: the size of replay.dat follows from it
FREE_ON_RESUME = {"run_dir", "resume", "stop_at", *FINISH}
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
WINDOW = 5 * FPS  # steps in a window of the driving score, 5 s


class WithoutInfos(gym.Wrapper):
    """Drops infos, which `SyncVectorEnv` stacks, and cannot where they differ in kind or shape."""

    def reset(self, **kwargs) -> tuple[np.ndarray, dict]:
        return super().reset(**kwargs)[0], {}

    def step(self, action) -> tuple[np.ndarray, float, bool, bool, dict]:
        return *super().step(action)[:4], {}


def make_games(args: Args, num_envs: int) -> gym.vector.VectorEnv:
    """Environments side by side: the driving task's own, scored by distance whatever the reward, or copies in turn."""
    if is_driving(args.env_id):
        return TorcsLikeVectorEnv(num_envs, track=args.track_name, brake=args.brake)
    same_step = gym.vector.AutoresetMode.SAME_STEP
    return gym.vector.SyncVectorEnv([lambda: WithoutInfos(make_env(args.env_id))] * num_envs, autoreset_mode=same_step)


def play(policy, games: gym.vector.VectorEnv, seeds: list[int], keep: bool = False) -> list[dict[str, np.ndarray]]:
    """One episode for each seed, side by side, by a function from observations (N, O) to actions (N, A).

    Returns for each `rewards` (T,), `terminated`, `truncated` and `seed`; with `keep` also `observations` (T + 1, O) and
    `actions` (T, A).
    """
    obs, _ = games.reset(seed=seeds)
    running, lengths = np.ones(len(seeds), bool), np.zeros(len(seeds), int)
    terminated, truncated = np.zeros(len(seeds), bool), np.zeros(len(seeds), bool)
    observations, actions, rewards = [obs], [], []
    while running.any():
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


def window_scores(rewards: np.ndarray, terminated: bool) -> list[float]:
    """Metres in each window of 5 s of an episode, 0 for the last one of an episode that ended early.

    A window that is cut short by the end of the time is left out, and there are none behind an end.
    """
    windows = [rewards[start : start + WINDOW] for start in range(0, len(rewards), WINDOW)]
    scores = [float(window.sum()) for window in windows]
    if terminated:
        return [*scores[:-1], 0.0]
    return scores if len(windows[-1]) == WINDOW else scores[:-1]


def driving_scores(episodes: list[dict[str, np.ndarray]], length: float) -> dict:
    """Table 2.3's score of episodes on a road, from their means, in m and in (km/h) s.

    Also crashes, and as `standstills` all other early ends (stood still or turned round); and the laps of each episode.
    """
    windows = [window_scores(episode["rewards"], bool(episode["terminated"])) for episode in episodes]
    means = [float(np.mean(scores)) for scores in windows if scores]
    crashes = sum((episode["rewards"] == -1).any() for episode in episodes)
    return {
        "metres_in_5_s": summary(means),
        "score": summary([mean * 3.6 for mean in means]),
        "crashes": int(crashes),
        "standstills": int(sum(episode["terminated"] for episode in episodes) - crashes),
        "laps": [float(episode["rewards"][episode["rewards"] != -1].sum() / length) for episode in episodes],
    }


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
    """Play an episode of `play` again by its seed and actions and write it into `videos/`."""
    env = make_env(args.env_id, "rgb_array", **env_options(args))
    env = gym.wrappers.RecordVideo(env, str(run_dir / "videos"), lambda episode: True)
    env.reset(seed=int(episode["seed"]))
    for action in episode["actions"]:
        env.step(action)
    env.close()


def evaluate(policy, args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes that training never saw; write `evaluation.json` and, if asked, a video."""
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    episodes = play(held(policy, args.frame_skip), make_games(args, len(seeds)), seeds, keep=args.capture_video)
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    if args.capture_video:
        record_video(episodes[0], args, run_dir)
    evaluation = {
        "env_id": args.env_id,
        "mode": "without noise",
        **summary(returns),
        "returns": returns,
        "seeds": seeds,
    }
    if is_driving(args.env_id):
        evaluation["driving"] = driving_scores(episodes, Track(*TRACKS[args.track_name]).length)
    write_json(run_dir / "evaluation.json", evaluation)
    return evaluation


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(policy, args: Args, run_dir: Path) -> None:
    """Write `--save-demos` episodes of the actor without noise into `demos/`."""
    seeds = [episode_seed(args.seed, DEMONSTRATION_STREAM, i) for i in range(args.save_demos)]
    episodes = play(held(policy, args.frame_skip), make_games(args, len(seeds)), seeds, keep=True)
    options = {**env_options(args), "reward": "distance"} if is_driving(args.env_id) else {}
    about = {"env_id": args.env_id, "options": options, "player": args.exp_name, "mode": "without noise"}
    write_demonstrations(run_dir / "demos", episodes, about)


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
    axes.plot(steps, returns, ".", markersize=2, alpha=0.3, color="tab:blue", label="episodes in training (with noise)")
    window = min(50, max(1, len(returns)))
    if len(returns):
        means = np.convolve(returns, np.ones(window) / window, "valid")
        axes.plot(steps[window - 1 :], means, color="tab:blue", label=f"mean of {window} episodes")
    level = evaluation["mean"]
    label = f"evaluation (without noise, {args.eval_episodes} episodes): {level:,.1f}"
    if not (is_driving(args.env_id) and args.reward == "speed"):  # the evaluation counts metres
        axes.axhline(level, color="tab:orange", linestyle="--", label=label)
    where = f"{args.env_id}, {args.track_name}" if is_driving(args.env_id) else args.env_id
    axes.set_title(f"{where}, DDPG, seed {args.seed}")
    axes.set_xlabel("steps")
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
    rows = {f"{name} ({result[name]['mode']})": result[name] for name in ("training", "evaluation")}
    driving = result["evaluation"].get("driving")
    if driving:
        rows |= {"m in 5 s, means of episodes": driving["metres_in_5_s"], "(km/h) s, as in Table 2.3": driving["score"]}
    for name, row in rows.items():
        numbers = "".join(f"{row[key]:>11.1f}" for key in ("mean", "std", "min", "max") if row[key] is not None)
        print(f"{name:32}{row['episodes']:>9}{numbers}")
    if driving:
        ends = f"{driving['crashes']} crashes, {driving['standstills']} other early ends"
        print(f"{ends}; laps from {min(driving['laps']):.2f} to {max(driving['laps']):.2f}")


# ---------------------------------------------------------------------------------------------------------------------
# Training
# ---------------------------------------------------------------------------------------------------------------------
LOG_INTERVAL = 10_000  # steps between rows of updates.csv


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

    names = ("losses/critic", "losses/actor", "losses/q_values")

    def __init__(self):
        self.sums, self.count = torch.zeros(len(self.names)), 0

    def add(self, parts: tuple[torch.Tensor, ...]) -> None:
        self.sums += torch.stack(parts).cpu()
        self.count += 1

    def take(self) -> dict[str, float]:
        """The means so far, and begin anew."""
        means = (self.sums / max(1, self.count)).tolist()
        metrics = {"charts/updates": self.count, **dict(zip(self.names, means))}
        self.sums, self.count = torch.zeros(len(self.names)), 0
        return metrics


def main(args: Args) -> int:
    """Train, evaluate and write everything into the run's folder. Returns the exit code."""
    args = complete_args(args)
    env = make_env(args.env_id, **env_options(args))
    if args.capture_video:
        check_video(args.env_id)
    spare = 2 * (min(max(args.checkpoint_interval, args.rollout_steps), args.total_timesteps) + args.rollout_steps)
    row_bytes = 4 * (2 * env.observation_space.shape[0] + env.action_space.shape[0] + 2)
    check_disk(args, "--buffer-size", args.buffer_size, (args.buffer_size + spare) * row_bytes)
    run_dir, checkpoint = open_run_dir(args)
    last_iteration = min(args.num_iterations, math.ceil(args.stop_at / args.rollout_steps))
    if is_done(run_dir, args, last_iteration * args.rollout_steps):
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

    obs_dim, action_dim = env.observation_space.shape[0], env.action_space.shape[0]
    agent = Agent(obs_dim, action_dim, args.hidden_size, args.layer_norm).to(device)
    optimizer = FlatAdam(agent, args)
    norm = RunningNorm(agent.obs_scale, args.norm_obs)
    best = Best(optimizer, norm)
    players = make_players(args)
    rng = np.random.default_rng(np.random.SeedSequence(args.seed))
    explorer = (ParameterNoise if args.noise == "parameter" else ActionNoise)(optimizer, args, action_dim, rng)
    added, width = 0 if checkpoint is None else checkpoint["added"], 2 * obs_dim + action_dim + 2
    is_trained = checkpoint is not None and checkpoint["iteration"] >= last_iteration  # only its end is done again
    buffer = None if is_trained else ReplayBuffer(run_dir / "replay.dat", args.buffer_size, spare, width, added)
    at_once = args.num_envs * args.frame_skip
    perturb_interval = max(1, args.perturb_interval // args.frame_skip)
    means = Means()
    iteration, updates, training_seconds, offsets = 0, 0, 0.0, {"episodes": 0, "updates": 0}
    noise_distance = math.nan
    if checkpoint is None:
        players.start()
        for i in range(args.num_envs):
            explorer.begin(i)
    else:
        iteration, updates, noise_distance = checkpoint["iteration"], checkpoint["updates"], checkpoint["distance"]
        training_seconds, offsets = checkpoint["training_seconds"], checkpoint["offsets"]
        optimizer.load_state_dict(checkpoint["optimizer"])
        norm.load_state_dict(checkpoint["norm"])
        best.load_state_dict(checkpoint["best"])
        explorer.load_state_dict(checkpoint["explorer"])
        rng.bit_generator.state = json.loads(checkpoint["rng"])
        vars(means).update(checkpoint["means"])
        if not players.load_state_dict(checkpoint["players"]):
            print("--resume: the replayed episode differs (another machine?), goes on with it", file=sys.stderr)
    update = Update(agent, optimizer, norm, args, optimizer.vector.new_zeros(args.batch_size, width))
    arithmetic = f"{'compiled' if update.is_compiled else 'plain'} on {device.type}"
    if checkpoint and checkpoint["arithmetic"] != arithmetic:
        print(f"--resume: was {checkpoint['arithmetic']}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    global_step = iteration * args.rollout_steps
    episodes_csv = CsvLog(run_dir / "episodes.csv", offsets["episodes"])
    updates_csv = CsvLog(run_dir / "updates.csv", offsets["updates"])
    forget_end(run_dir, iteration < last_iteration)
    writer = SummaryWriter(str(run_dir), purge_step=global_step + 1)
    progress = tqdm(total=last_iteration * args.rollout_steps, initial=global_step, unit="step", disable=None)
    last_time = time.perf_counter()

    while iteration < last_iteration:
        iteration += 1
        before = global_step
        for _ in range(args.rollout_steps // at_once):
            obs = players.obs.copy()
            norm.update(obs)
            actions = explorer.act(norm(obs))
            steps = step_and_hold(players, scaled(actions, env.action_space), args.frame_skip)
            discounts = args.gamma * ~steps.terminated
            buffer.add(obs, actions, args.reward_scale * steps.rewards, discounts, steps.next_obs)
            global_step += at_once
            for i, episodic_return, length in steps.ended:
                explorer.begin(i)
                episodes_csv.write(
                    {"global_step": global_step, "episodic_return": episodic_return, "episodic_length": length}
                )
                charts = {"charts/episodic_return": episodic_return, "charts/episodic_length": length}
                add_scalars(writer, charts, global_step)
                progress.set_postfix_str(f"return {episodic_return:.1f}", refresh=False)
            if args.noise == "parameter" and (global_step // at_once) % perturb_interval == 0:
                for i in range(args.num_envs):
                    explorer.begin(i)

        optimizer.anneal(1.0 - before / args.total_timesteps if args.anneal_lr else 1.0)
        for _ in range(args.train_steps if buffer.added >= args.batch_size else 0):
            if updates % args.adapt_interval == 0:
                noise_distance = explorer.adapt(norm(buffer.sample(args.batch_size, rng).numpy()[:, :obs_dim]))
            means.add(update(buffer.sample(args.batch_size, rng).to(device)))
            updates += 1
        if not optimizer.vector.isfinite().all():
            raise RunError(f"step {global_step}: the networks' parameters are no longer finite")
        schedule_ends = iteration == args.num_iterations  # last_iteration may be that of an earlier --stop-at
        every = args.keep_best_every
        if every and (schedule_ends or global_step // every > before // every):
            best.consider(args, env.action_space, global_step)

        logs = global_step // LOG_INTERVAL > before // LOG_INTERVAL or schedule_ends
        crossed = global_step // args.checkpoint_interval > before // args.checkpoint_interval
        if not (logs or crossed or stop.received or iteration == last_iteration):
            continue
        progress.update(global_step - progress.n)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        if logs:
            metrics = {**means.take(), "charts/noise_size": explorer.size, "charts/noise_distance": noise_distance}
            metrics["charts/selection_return"] = best.last_mean_return
            updates_csv.write({"global_step": global_step, **metrics})
            add_scalars(writer, {**metrics, "charts/SPS": global_step / training_seconds}, global_step)
        if crossed or stop.received or iteration == last_iteration:
            state = {
                "args": arguments(args),
                "arithmetic": arithmetic,
                "iteration": iteration,
                "updates": updates,
                "distance": noise_distance,
                "training_seconds": training_seconds,
                "offsets": {"episodes": episodes_csv.sync(), "updates": updates_csv.sync()},
                "optimizer": optimizer.state_dict(),
                "norm": norm.state_dict(),
                "best": best.state_dict(),
                "explorer": explorer.state_dict(),
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
            print(f"stopped by signal {stop.received} at step {global_step}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    best.restore()
    policy = make_policy(optimizer, norm, env.action_space)
    finish_run(agent, policy, best.step, args, run_dir, global_step, training_seconds, writer)
    writer.close()
    return 0


def finish_run(
    agent: Agent, policy, kept_step: int, args: Args, run_dir: Path, global_step: int, seconds: float, writer
) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last; the policy is that of `kept_step`, if not 0."""
    evaluation = evaluate(policy, args, run_dir)
    for name in ("mean", "std", "min", "max"):
        writer.add_scalar(f"eval/episodic_return_{name}", evaluation[name], global_step)
    if args.save_model:
        model = safetensors.torch.save(agent.state_dict(), {"args": json.dumps(arguments(args))})
        write_whole(run_dir / "model.safetensors", model)
    if args.save_demos:
        save_demonstrations(policy, args, run_dir)
    plot_learning_curve(run_dir, args, evaluation)
    versions = {module.__name__: module.__version__ for module in (gym, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": global_step,
        "kept_step": kept_step or global_step,
        "complete": global_step == args.num_iterations * args.rollout_steps,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training": {"mode": "with noise", **summary(read_episodes(run_dir)[-50:, 1])},
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
