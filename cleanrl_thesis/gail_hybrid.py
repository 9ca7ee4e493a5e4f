"""Hybrid of reinforcement and imitation learning by GAIL with TRPO (thesis sections 2.3.2 and 2.4.3, Eq. 2.3.1).

    python cleanrl_thesis/gail_hybrid.py --demos-rl runs/expert/demos                 # the hybrid, α = 0.5
    python cleanrl_thesis/gail_hybrid.py --alpha 0                                    # GAIL on the human
    python cleanrl_thesis/gail_hybrid.py --alpha 1 --demos-rl runs/expert/demos       # GAIL on the DDPG expert
    python cleanrl_thesis/gail_hybrid.py --env-id Hopper-v5 --alpha 1 --demos-rl runs/hopper/demos

The student π and the discriminator D play L_mix(π) = E_π[log D] + α E_RL[log(1 − D)] + (1 − α) E_HE[log(1 − D)]
(Eq. 2.3.1): D makes it large, so D → 1 means *student*; π makes it small, by TRPO with the reward −log D. The reward of
the environment never reaches the student.

The expert's demonstrations are those of `ddpg_torcs_like.py --save-demos`, or `ppo_continuous_kle.py`'s. The human is by default
a **synthetic** one: a script that looks at the road now and then, reacts late and steers inexactly; it is made from no
agent, and its score stands to the DDPG experts' as in Table 2.3. `--demos-human` takes recordings.
`--run-dir DIR --resume` can be sent again after every crash: on the same machine the run ends with the same bytes.

| setting | value | source |
|---|---|---|
| steps | 5,000,000 for GAIL (α = 0), else 7,500,000 | section 2.4.3 |
| KL bound, discriminator's learning rate | 0.01, 1e-3 | section 2.4.3 |
| the bound is annealed to a hundredth | on | ours; the study's code keeps it |
| networks | two layers of 100 with tanh, for policy, values and discriminator | the study's code |
| updates of the policy for one of the discriminator | 3 | the study's code |
| batch | 64 actions in each of 16 environments | ours; the study's code has 1,024 in one for GAIL, 512 for the hybrid |
| an action is held, while driving | for 5 steps, 0.1 s, as by `ddpg_torcs_like.py` | ours; the study's code acts in each step |
| penalty on the discriminator's gradient | 10 (`--d-grad-penalty 0`: Eq. 2.3.1 alone) | ours; the number is that of Gulrajani et al. 2017 |
| start by behaviour cloning | 20 passes (`--bc-epochs 0`: none) | an option of the study's code |
| Fisher matrix | from a fifth of a batch | OpenAI Baselines'; the full step is then often too long and is halved; the scores are the same |
| actions that the discriminator sees | within the bounds | ours; the study's code shows them as sampled |
| CG iterations, damping; γ, λ; passes over the value function, rate; entropies | 10, 0.1; 0.995, 0.97; 5, 1e-3; 0, 1e-3 | the study's code |
| which label is the expert's | D → 0 | Eq. 2.3.1; the prose and the study's code have D and 1 − D swapped |
| normalisation of observations | mean and standard deviation of the demonstrations, fixed | ours; the study's code keeps running ones |
| a time-out | the value goes on behind it | ours; the study's code takes it for an end |
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "gymnasium[mujoco]>=1.2",
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
    exp_name: str = "gail_hybrid"
    """the name of this experiment"""
    seed: int = 1
    """seed of the experiment"""
    torch_deterministic: bool = True
    """sets `torch.backends.cudnn.deterministic`"""
    cuda: bool = False
    """train on the GPU where there is one; off by default, for small networks spend their time in launching kernels"""
    num_threads: int = 1
    """threads of torch; one is fastest for these networks and lets a sweep fill the machine with runs"""
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
    eval_episodes: int = 20
    """episodes of the evaluation at the end, sampled and greedy"""
    eval_mode: Literal["sampled", "greedy"] = "sampled"
    """whether video and demonstrations sample from the policy or take its mean"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 100_000
    """steps between checkpoints"""
    stop_at: int | None = None
    """end at this step of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: str = "TorcsLike-v0"
    """the environment: TorcsLike-v0 or a Gymnasium id with flat Box observations and Box actions with bounds, best of about ±1: the
    policy begins with a deviation of 1 (ours; section 2.4.3 has TORCS)"""
    track_name: str = "meadow"
    """the road of TorcsLike-v0: meadow, speedway, hills or city (ours, after roads of TORCS)"""
    brake: bool = True
    """TorcsLike-v0: negative throttle brakes; off: it coasts, as in gym_torcs (ours)"""
    demos_rl: Path | None = None
    """folder of the RL expert's demonstrations; needed for α > 0, and not read for α = 0 (section 2.4.3)"""
    demos_human: Path | None = None
    """folder of recorded demonstrations (section 2.4.3); default: the synthetic human's are made and put into
    `demos_synthetic_human/` (ours); not read for α = 1"""
    human_episodes: int = 220
    """episodes of 60 s of the synthetic human (section 2.4.3)"""
    alpha: float = 0.5
    """α, weight of the RL expert against the human (Eq. 2.3.1)"""
    total_timesteps: int | None = None
    """environment steps; default: 5,000,000 for α = 0, else 7,500,000 (section 2.4.3)"""
    num_envs: int = 16
    """environments side by side (ours; the study's code has one)"""
    num_steps: int = 64
    """actions of each environment per update (ours; the study's code has 1,024 for GAIL, 512 for the hybrid)"""
    frame_skip: int | None = None
    """steps for which an action is held, of which demonstrations give the first; default: 5 for TorcsLike-v0, else 1 (ours; the
    study's code acts in each step)"""
    g_steps: int = 3
    """updates of the policy for each round of the discriminator (the study's code)"""
    d_steps: int = 1
    """steps of Adam in such a round (the study's code)"""
    learning_rate: float = 1e-3
    """Adam's learning rate for the discriminator (section 2.4.3)"""
    value_learning_rate: float = 1e-3
    """Adam's learning rate for the value function (the study's code)"""
    value_epochs: int = 5
    """passes over each batch for the value function (the study's code)"""
    value_batch_size: int = 128
    """steps per update of the value function (Baselines)"""
    max_kl: float = 0.01
    """bound on the mean KL divergence of an update (section 2.4.3)"""
    anneal_kl: bool = True
    """anneal the bound linearly to a hundredth (ours); off: constant (the study's code)"""
    kl_slack: float = 1.5
    """the line search takes a step whose KL divergence is up to this many bounds (Baselines)"""
    cg_iterations: int = 10
    """iterations of the conjugate gradient method (the study's code)"""
    cg_damping: float = 0.1
    """multiple of the identity that is added to the Fisher matrix (the study's code)"""
    fisher_every: int = 5
    """the Fisher matrix is estimated from one in so many steps of a batch, drawn at random (Baselines, which takes every fifth)"""
    gamma: float = 0.995
    """discount factor γ of one action, which is `--frame-skip` steps (the study's code)"""
    gae_lambda: float = 0.97
    """λ of generalised advantage estimation (the study's code)"""
    ent_coef: float = 0.0
    """weight of the policy's entropy (the study's code)"""
    d_ent_coef: float = 1e-3
    """weight of the discriminator's entropy (the study's code)"""
    d_grad_penalty: float = 10.0
    """weight of the penalty on the discriminator's gradient between student and experts; 0: Eq. 2.3.1 as it stands (ours; the
    number is that of Gulrajani et al. 2017)"""
    reward_form: Literal["positive", "signed"] = "positive"
    """positive: −log D, with which it pays to survive (Eq. 2.3.1); signed: log(1 − D) − log D, with which it need not (ours)"""
    bc_epochs: int = 20
    """passes of behaviour cloning before GAIL, counted over the human's demonstrations (at α = 1 the RL expert's), 0 for none; both
    experts' losses are weighted by α and 1 − α, which between 0 and 1 mixes their actions into one mean, as section 2.3.2 warns
    against; with `--total-timesteps 0` nothing follows (an option of the study's code)"""
    hidden_size: int = 100
    """units in each of the two hidden layers of all networks (the study's code)"""

    # to be filled in runtime
    batch_size: tyro.conf.Suppress[int] = 0
    """environment steps of an update: num_envs · num_steps · frame_skip"""
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
    if args.total_timesteps is None:
        args.total_timesteps = 5_000_000 if args.alpha == 0 else 7_500_000
    args.stop_at = max(1, args.total_timesteps) if args.stop_at is None else args.stop_at
    if args.frame_skip is None:
        args.frame_skip = 5 if is_driving(args.env_id) else 1
    counts = (
        "num_envs eval_episodes checkpoint_interval stop_at human_episodes hidden_size "
        "g_steps d_steps value_epochs value_batch_size cg_iterations fisher_every frame_skip"
    )
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate value_learning_rate max_kl", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("kl_slack", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("cg_damping ent_coef d_ent_coef d_grad_penalty", lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("alpha gamma gae_lambda", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos bc_epochs", lambda x: x >= 0, "must be at least 0"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(args.num_steps >= 2, "--num-steps", args.num_steps, "must be at least 2")
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")
    require(args.track_name in TRACKS, "--track-name", args.track_name, f"must be one of {', '.join(TRACKS)}")
    has_rl = args.alpha == 0 or args.demos_rl is not None
    allowed = (
        "needs --demos-rl, a folder that ddpg_torcs_like.py or ppo_continuous_kle.py has written with --save-demos"
    )
    require(has_rl, "--alpha", args.alpha, allowed)
    has_human = args.alpha == 1 or args.demos_human is not None or is_driving(args.env_id)
    require(
        has_human, "--env-id", args.env_id, "needs --demos-human for α < 1; only TorcsLike-v0 has a synthetic human"
    )
    args.batch_size = args.num_envs * args.num_steps * args.frame_skip
    args.num_iterations = args.total_timesteps // args.batch_size
    allowed = f"must be at least one batch, {args.batch_size} steps, or 0 with --bc-epochs above 0"
    clones = args.total_timesteps == 0 and args.bc_epochs > 0
    require(args.num_iterations >= 1 or clones, "--total-timesteps", args.total_timesteps, allowed)
    actions = args.num_envs * args.num_steps
    require(args.d_steps <= actions, "--d-steps", args.d_steps, f"must be at most the actions of a batch, {actions}")
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
    return {"track": args.track_name, "brake": args.brake} if is_driving(args.env_id) else {}


# ---------------------------------------------------------------------------------------------------------------------
# The synthetic human
# ---------------------------------------------------------------------------------------------------------------------
class SyntheticDriver:
    """A scripted driver with a person's limits, for N cars at once; it is made from no agent.

    It looks at road and car now and then, and what it then decides reaches the hands a reaction time later. It steers for
    a point ahead of where the car will be by then, a little too much or too little, and corrects with the next look; it
    slows down before curves and parked cars once they are in sight. Its numbers are guesses but for the boldness, which was
    fitted: on the road `meadow` its mean is 475 (km/h) s, 0.78 of the DDPG expert's, as in Table 2.3 (seed 1; no crash in 220
    episodes, of five seeds 3 in 1,100). Its standard deviation, 12 to 14, was not fitted (Table 2.3: 31). On other roads it
    crashes more often.
    """

    look, look_spread = 7.0, 0.3  # median time between looks in steps of 0.02 s, and its standard deviation as a share
    reaction = 8  # steps from a look to the hands
    sight = 120.0  # m of road that it heeds
    comfort = 7.0  # m/s² to the side in curves
    braking = 4.5  # m/s² with which it expects to slow down
    fastest = 46.0  # m/s on a straight
    passing = 0.82  # share of that beside parked cars
    room = 3.6  # m between the middles of two cars when it passes
    preview = 1.2  # s, to the point that it steers for; in curves less, but at least 1 s
    cutting = 2.0  # m by which the straight line to that point may cut a curve
    steering_error, hand_error = 0.15, 0.012  # of each correction, as a share; and of the wheel, as a share of its lock
    boldness, boldness_spread = 1.04, 0.03  # shares of the speeds above that it dares: median over episodes, deviation

    def __init__(self, cars: Cars, seed: int):
        self.cars, self.rng = cars, np.random.default_rng(np.random.SeedSequence([seed, HUMAN_STREAM]))
        num_cars = len(cars.yaw)
        self.step, self.next_look = 0, np.zeros(num_cars)
        self.hands = np.zeros((self.reaction + 1, 2, num_cars))  # steering and pedal of the last steps
        self.decided = np.zeros((2, num_cars))
        self.boldness = self.boldness * np.exp(self.boldness_spread * self.rng.standard_normal(num_cars))
        self.heeded, self.side = np.full(num_cars, -1), np.ones(num_cars)  # which parked car, and where it passes it

    def __call__(self, obs: np.ndarray) -> np.ndarray:
        """Actions (N, 2) for the next step; it sees the road itself and not the observations."""
        looking = np.flatnonzero(self.step >= self.next_look)
        if len(looking):
            self.decided[:, looking] = self.steering(looking), self.pedal(looking)
            spread = np.exp(self.look_spread * self.rng.standard_normal(len(looking)))
            self.next_look[looking] = self.step + self.look * spread
        self.hands[self.step % len(self.hands)] = self.decided
        self.step += 1
        return self.hands[self.step % len(self.hands)].T.astype(np.float32)  # the oldest

    def parked_ahead(self, cars: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Way in m to the next parked car that each driver heeds, inf for none; and its number, -1 for none."""
        track, speed = self.cars.track, self.cars.velocity[0, cars]
        place = track.distances[self.cars.segment[cars]] + self.cars.along[cars]
        gaps = (np.array(PARKED) - place[:, None] + 8) % track.length - 8  # heeded until 8 m behind
        nearest = gaps.argmin(1)
        gap = gaps[np.arange(len(cars)), nearest]
        heeds = gap < np.maximum(60, 2.5 * speed)
        return np.where(heeds, gap, np.inf), np.where(heeds, nearest, -1)

    def choose_sides(self, cars: np.ndarray, number: np.ndarray) -> np.ndarray:
        """Where the drivers go to pass a parked car, (n,) m left of the middle of the road; chosen once for each."""
        parked = np.array(PARKED_LEFT)[number] * self.cars.track.half_width
        nearer = np.where(self.cars.left[cars] > parked, 1, -1)
        side = np.where(np.abs(parked) < 0.5, nearer, -np.sign(parked))
        self.side[cars] = np.where(number == self.heeded[cars], self.side[cars], side)
        self.heeded[cars] = number
        return parked + self.side[cars] * self.room

    def steering(self, cars: np.ndarray) -> np.ndarray:
        """Where the given drivers turn the wheel to, (n,) in [-1, 1]: towards a point ahead on the road."""
        track, state = self.cars.track, self.cars
        speed = state.velocity[0, cars]
        _, number = self.parked_ahead(cars)
        target = np.where(number < 0, 0, self.choose_sides(cars, number))
        target = np.clip(target, CAR_WIDTH - track.half_width, track.half_width - CAR_WIDTH)
        place, way = track.distances[state.segment[cars]] + state.along[cars], np.maximum(self.preview * speed, 8)
        segment, _, _ = track.place(place + way, target)
        chord = np.sqrt(8 * self.cutting / np.maximum(np.abs(track.curvatures[segment]), 1e-4))
        _, point, _ = track.place(place + np.clip(way, speed, np.maximum(speed, chord)), target)

        delay = (self.reaction + self.look / 2) / FPS
        turn = state.yaw_rate[cars] * delay
        expected = state.xy[:, cars] + delay * turned(state.velocity[:, cars], state.yaw[cars] + turn / 2)
        way = point - expected
        bearing = np.arctan2(way[1], way[0]) - state.yaw[cars] - turn
        wheel = np.arctan((FRONT_AXLE + REAR_AXLE) * 2 * np.sin(bearing) / np.hypot(*way)) / STEERING_LOCK
        held = self.decided[0, cars]
        error, hand = self.rng.standard_normal((2, len(cars)))
        wheel = held + (wheel - held) * (1 + self.steering_error * error) + self.hand_error * hand
        return np.clip(wheel, -1, 1)

    def pedal(self, cars: np.ndarray) -> np.ndarray:
        """Throttle or, below 0, brake of the given drivers, (n,): by how much they are above or below the speed they dare."""
        track, speed = self.cars.track, self.cars.velocity[0, cars]
        place = track.distances[self.cars.segment[cars]] + self.cars.along[cars]
        ahead = np.arange(0, self.sight, 8)
        segment, _, _ = track.place(place[:, None] + ahead, np.zeros((len(cars), len(ahead))))
        sharpest = self.comfort / self.fastest**2  # curves wider than this do not count
        limit = np.sqrt(self.comfort / np.maximum(np.abs(track.curvatures[segment]), sharpest))
        way = np.maximum(ahead - 0.2 * speed[:, None], 0)
        dared = np.sqrt(limit**2 + 2 * self.braking * way).min(1)
        gap, _ = self.parked_ahead(cars)
        beside = np.sqrt((self.passing * self.fastest) ** 2 + 2 * self.braking * np.maximum(gap - 20, 0))
        excess = speed - self.boldness[cars] * np.minimum(dared, beside)
        brake = -np.clip(0.12 * excess, 0.15, 0.8)
        return np.select([excess > 1.5, excess > 0, excess > -1.5], [brake, -0.03, 0.35], 0.9)


# ---------------------------------------------------------------------------------------------------------------------
# Demonstrations
# ---------------------------------------------------------------------------------------------------------------------
def read_episode(path: Path, checksum: str, env: gym.Env, flag: str) -> dict[str, np.ndarray]:
    """One demonstration. Raises UsageError where it is not what the manifest says, or is none of this environment."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UsageError(f"{flag} {path}: cannot be read: {error.strerror}") from None
    same = hashlib.sha256(content).hexdigest() == checksum
    require(same, flag, path, "its SHA-256 is not the manifest's, the file was changed or damaged")
    try:
        with np.load(io.BytesIO(content), allow_pickle=False) as arrays:
            observations, actions, rewards = arrays["observations"], arrays["actions"], arrays["rewards"]
            terminated = bool(arrays["terminated"])
    except (KeyError, ValueError, TypeError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise UsageError(f"{flag} {path}: no demonstration: {first_line(error)}") from None
    obs_dim, action_dim = env.observation_space.shape[0], env.action_space.shape[0]
    require(actions.ndim > 0, flag, path, "its actions are no array of steps")
    fits = observations.shape == (len(actions) + 1, obs_dim) and actions.shape == (len(actions), action_dim)
    allowed = f"observations must be (T + 1, {obs_dim}) and actions (T, {action_dim}), they are"
    require(fits, flag, path, f"{allowed} {observations.shape} and {actions.shape}")
    require(len(actions) > 0, flag, path, "must have at least one step")
    for name, array in (("observations", observations), ("actions", actions), ("rewards", rewards)):
        finite = np.issubdtype(array.dtype, np.number) and bool(np.isfinite(array).all())
        require(finite, flag, path, f"{name} must be finite numbers")
    require(rewards.shape == (len(actions),), flag, path, "rewards must be (T,)")
    return {"observations": observations, "actions": actions, "rewards": rewards, "terminated": terminated}


def read_demonstrations(folder: Path, args: Args, flag: str) -> list[dict[str, np.ndarray]]:
    """All episodes of a folder, in the order of their names. Raises UsageError."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        files, recorded, version = dict(manifest["files"]), str(manifest["env_id"]), manifest["version"]
        options = dict(manifest.get("options", {}))
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"{flag} {folder}: holds no demonstrations, it has no readable manifest.json") from None
    require(version == 1, flag, folder, f"its manifest is of version {version}, this script reads version 1")
    require(bool(files), flag, folder, "holds no demonstrations, its manifest names no file")
    same_task = recorded.split(":")[-1] == args.env_id.split(":")[-1]
    require(same_task, flag, folder, f"was recorded in {recorded}, --env-id is {args.env_id}")
    flags = {"track": "--track-name", "brake": "--brake"}
    for name, value in env_options(args).items():
        then = options.get(name, value)
        require(then == value, flag, folder, f"was recorded with {flags[name]} {then}, now it is {value}")
    env = make_env(args.env_id, **env_options(args))
    return [read_episode(folder / name, checksum, env, flag) for name, checksum in sorted(files.items())]


class Demonstrations:
    """Steps of one expert at which the student would act, from which the discriminator's minibatches are drawn."""

    def __init__(self, episodes: list[dict[str, np.ndarray]], space: gym.spaces.Box, frame_skip: int):
        obs = np.concatenate([episode["observations"][:-1:frame_skip] for episode in episodes])
        actions = np.concatenate([episode["actions"][::frame_skip] for episode in episodes])
        self.obs = torch.from_numpy(obs.astype(np.float32))  # (S, O)
        self.actions = torch.from_numpy(bounded(actions.astype(np.float32), space.low, space.high))  # (S, A)
        self.digest = hashlib.sha256(self.obs.numpy().tobytes() + self.actions.numpy().tobytes()).hexdigest()

    def sample(self, size: int) -> tuple[torch.Tensor, torch.Tensor]:
        """Observations and actions of steps drawn at random."""
        rows = torch.randint(len(self.obs), (size,))
        return self.obs[rows], self.actions[rows]

    def move(self, device: torch.device) -> None:
        self.obs, self.actions = self.obs.to(device), self.actions.to(device)


class Experts(NamedTuple):
    """Both experts; one that is not there, and so has no weight, is the other."""

    rl: Demonstrations
    human: Demonstrations

    def fingerprint(self) -> str:
        """SHA-256 of all that is learned from."""
        return self.rl.digest + self.human.digest


# ---------------------------------------------------------------------------------------------------------------------
# Playing
# ---------------------------------------------------------------------------------------------------------------------
EVALUATION_STREAM = 1_000_000
HUMAN_STREAM = 1_000_002
STUDENT_STREAM = 1_000_003  # of its demonstrations: other episodes than the experts', 1_000_001


def bounded(x: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """`np.clip` without its overhead on small arrays."""
    return np.minimum(np.maximum(x, low), high)


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


# ---------------------------------------------------------------------------------------------------------------------
# Networks
# ---------------------------------------------------------------------------------------------------------------------
def mlp(inputs: int, hidden_size: int, outputs: int, output_scale: float) -> nn.Sequential:
    """Two hidden layers with tanh; the output's weights begin with rows of norm `output_scale` (Baselines)."""
    layers = [nn.Linear(inputs, hidden_size), nn.Linear(hidden_size, hidden_size), nn.Linear(hidden_size, outputs)]
    for layer, scale in zip(layers, (1.0, 1.0, output_scale)):
        nn.init.normal_(layer.weight)
        layer.weight.data *= scale / layer.weight.data.norm(dim=1, keepdim=True)
        nn.init.zeros_(layer.bias)
    first, second, output = layers
    return nn.Sequential(first, nn.Tanh(), second, nn.Tanh(), output)


class Agent(nn.Module):
    """Gaussian policy, its value function, the discriminator, and the normalisation of observations for all three."""

    def __init__(self, obs_dim: int, action_dim: int, hidden_size: int):
        super().__init__()
        self.actor_mean = mlp(obs_dim, hidden_size, action_dim, 0.01)
        self.actor_logstd = nn.Parameter(torch.zeros(action_dim))
        self.critic = mlp(obs_dim, hidden_size, 1, 1.0)
        self.discriminator = mlp(obs_dim + action_dim, hidden_size, 1, 1.0)
        self.register_buffer("obs_mean", torch.zeros(obs_dim))
        self.register_buffer("obs_std", torch.ones(obs_dim))

    def set_normalization(self, obs: torch.Tensor) -> None:
        """Take mean and standard deviation from observations (S, O)."""
        self.obs_mean.copy_(obs.mean(0))
        self.obs_std.copy_(obs.std(0).clamp(min=1e-3))

    def normalize(self, obs: torch.Tensor) -> torch.Tensor:
        """Observations (..., O) as the environment gives them -> as all networks see them, within ±10 standard deviations."""
        return ((obs - self.obs_mean) / self.obs_std).clamp(-10, 10)

    def value(self, obs: torch.Tensor) -> torch.Tensor:
        """Normalised observations (B, O) -> values (B,)."""
        return self.critic(obs).squeeze(1)

    def pairs(self, obs: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
        """Observations (B, O) as the environment gives them, actions (B, A) -> the discriminator's inputs, (B, O + A)."""
        return torch.cat([self.normalize(obs), actions], 1)

    def logits(self, pairs: torch.Tensor) -> torch.Tensor:
        """Inputs (B, O + A) -> logit of D, (B,): large for the student, small for experts."""
        return self.discriminator(pairs).squeeze(1)


def numpy_mean(agent: Agent):
    """The policy's mean as a numpy function, (N, O) -> (N, A); shares the agent's memory on the CPU.

    It is the twin of `Agent.actor_mean`: change both.
    """
    unknown = {type(module) for module in agent.actor_mean} - {nn.Linear, nn.Tanh}
    if unknown:
        raise TypeError(f"numpy_mean would leave out what is new in actor_mean: {unknown}")
    tensors = [(layer.weight.T, layer.bias) for layer in agent.actor_mean if isinstance(layer, nn.Linear)]
    layers = [[tensor.detach().cpu().numpy() for tensor in pair] for pair in tensors]
    obs_mean, obs_std = agent.obs_mean.cpu().numpy(), agent.obs_std.cpu().numpy()

    def mean(obs: np.ndarray) -> np.ndarray:
        x = np.clip((obs - obs_mean) / obs_std, -10, 10)
        for weight, bias in layers[:-1]:
            x = np.tanh(x @ weight + bias)
        weight, bias = layers[-1]
        return x @ weight + bias

    return mean


class Rollout(NamedTuple):
    """T actions in each of N environments, as arrays."""

    obs: np.ndarray  # (T, N, O)
    actions: np.ndarray  # (T, N, A), as sampled
    next_obs: np.ndarray  # (T, N, O), the real ones where an episode ended
    terminated: np.ndarray  # (T, N) bool
    ended: np.ndarray  # (T, N) bool, by an end or a time-out
    episodes: list[tuple[int, float, int]]  # step of the rollout, return and length of each episode that ended


def collect(agent: Agent, players: GymPlayers | CarPlayers, space: gym.spaces.Box, args: Args, rng) -> Rollout:
    """Sample `--num-steps` actions for each environment."""
    mean, deviation = numpy_mean(agent), agent.actor_logstd.detach().exp().cpu().numpy()
    columns: dict[str, list[np.ndarray]] = {name: [] for name in ("obs", "actions", "next_obs", "terminated", "ended")}
    episodes = []
    for t in range(args.num_steps):
        obs = players.obs.copy()
        actions = mean(obs)
        actions += deviation * rng.standard_normal(actions.shape, np.float32)
        steps = step_and_hold(players, bounded(actions, space.low, space.high), args.frame_skip)
        ended = np.zeros(len(obs), bool)
        for i, episodic_return, length in steps.ended:
            ended[i] = True
            episodes.append(((t + 1) * len(obs) * args.frame_skip, episodic_return, length))
        for name, array in zip(columns, (obs, actions, steps.next_obs, steps.terminated, ended)):
            columns[name].append(array)
    return Rollout(*(np.stack(column) for column in columns.values()), episodes)


# ---------------------------------------------------------------------------------------------------------------------
# The algorithm
# ---------------------------------------------------------------------------------------------------------------------
def gaussian_log_prob(mean: torch.Tensor, logstd: torch.Tensor, actions: torch.Tensor) -> torch.Tensor:
    """log π(a|s) of a diagonal Gaussian: mean (B, A), logstd (A,), actions (B, A) -> (B,)."""
    z = (actions - mean) * torch.exp(-logstd)
    return -torch.addcmul(logstd + 0.5 * math.log(2 * math.pi), z, z, value=0.5).sum(-1)


def gaussian_entropy(logstd: torch.Tensor) -> torch.Tensor:
    """Entropy of a diagonal Gaussian, a scalar."""
    return (logstd + 0.5 * math.log(2 * math.pi * math.e)).sum()


def gaussian_kl(mean_p: torch.Tensor, logstd_p: torch.Tensor, mean_q: torch.Tensor, logstd_q: torch.Tensor):
    """D_KL(p ‖ q) of diagonal Gaussians in each state: means (B, A), log standard deviations (A,) -> (B,)."""
    variance_ratio = torch.exp(2 * (logstd_p - logstd_q))
    distance = (mean_p - mean_q) * torch.exp(-logstd_q)
    return (logstd_q - logstd_p + 0.5 * (variance_ratio + distance * distance - 1)).sum(-1)


DISCRIMINATOR_METRICS = ("losses/l_mix", *(f"discriminator/accuracy_{name}" for name in ("student", "rl", "human")))


def discriminator_loss(
    student: torch.Tensor, rl: torch.Tensor, human: torch.Tensor, alpha: float, ent_coef: float
) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """−L_mix (Eq. 2.3.1) less the entropy, of the logits of D, (M,), for steps of the student and of both experts.

    Student and experts count the same in the entropy, the experts by their weights; the accuracy on an expert without
    weight is nan.
    """
    # D makes Eq. 2.3.1 large: D → 1 for the student, D → 0 for experts. The prose of section 2.3.2 and of Q&A 1
    # minimises over w, and the study's code labels experts 1: both have D and 1 − D swapped, and are the same game.
    l_mix = F.logsigmoid(student).mean()
    l_mix = l_mix + alpha * F.logsigmoid(-rl).mean() + (1 - alpha) * F.logsigmoid(-human).mean()
    entropies = [(F.softplus(x) - torch.sigmoid(x) * x).mean() for x in (student, rl, human)]
    entropy = 0.5 * entropies[0] + 0.5 * (alpha * entropies[1] + (1 - alpha) * entropies[2])
    hits = {"student": (student > 0, 1.0), "rl": (rl < 0, alpha), "human": (human < 0, 1 - alpha)}
    shares = {name: hit.float().mean() if weight else torch.tensor(math.nan) for name, (hit, weight) in hits.items()}
    metrics = {f"discriminator/accuracy_{name}": share for name, share in shares.items()}
    return -l_mix - ent_coef * entropy, {"losses/l_mix": l_mix.detach(), **metrics}


def gradient_penalty(logits, student: torch.Tensor, expert: torch.Tensor) -> torch.Tensor:
    """How far the logit's gradient is from length 1 on the ways from student to expert (Gulrajani et al. 2017, Eq. 3).

    Inputs of the discriminator (M, O + A), paired at random; the result is a scalar, the mean square.
    """
    share = torch.rand(len(student), 1).to(student.device)  # drawn by the generator that a checkpoint keeps
    between = (share * student + (1 - share) * expert).requires_grad_()
    (gradient,) = torch.autograd.grad(logits(between).sum(), between, create_graph=True)
    return (gradient.norm(dim=1) - 1).square().mean()


def imitation_reward(logits: torch.Tensor, form: str) -> torch.Tensor:
    """What the student is paid, (B,): −log D (Eq. 2.3.1), or log(1 − D) − log D."""
    # −log D is always positive: where episodes end early it pays to survive, whatever the experts do.
    return F.softplus(-logits) if form == "positive" else -logits


def gae(rewards, values, next_values, terminated, ended, gamma: float, gae_lambda: float) -> np.ndarray:
    """Generalised advantage estimation, A(τ, V, t) of Eq. 4.2.3 (Schulman et al. 2016, Eq. 16); all arrays (T, N).

    The values are those of the real next observations: behind a time-out too.
    """
    advantages, advantage = np.empty_like(rewards), np.zeros_like(rewards[0])
    for t in reversed(range(len(rewards))):
        delta = rewards[t] + gamma * next_values[t] * ~terminated[t] - values[t]
        advantage = delta + gamma * gae_lambda * ~ended[t] * advantage
        advantages[t] = advantage
    return advantages


class Batch(NamedTuple):
    """B steps as tensors."""

    obs: torch.Tensor  # (B, O), normalised
    actions: torch.Tensor  # (B, A), as sampled
    seen: torch.Tensor  # (B, A), as the environment and so the discriminator had them, within bounds
    advantages: torch.Tensor  # (B,), mean 0 and standard deviation 1
    returns: torch.Tensor  # (B,)


def flat_tensor(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """(T, N, ...) -> (T · N, ...)"""
    return torch.from_numpy(array).to(device).flatten(0, 1)


@torch.no_grad()
def imitation_rewards(
    agent: Agent, rollout: Rollout, space: gym.spaces.Box, form: str, device: torch.device
) -> np.ndarray:
    """The student's rewards by the discriminator, (T, N)."""
    seen = bounded(rollout.actions, space.low, space.high)
    logits = agent.logits(agent.pairs(flat_tensor(rollout.obs, device), flat_tensor(seen, device)))
    return imitation_reward(logits, form).cpu().numpy().reshape(rollout.ended.shape)


@torch.no_grad()
def make_batch(agent: Agent, rollout: Rollout, rewards: np.ndarray, space: gym.spaces.Box, args: Args, device) -> Batch:
    """Estimate values and advantages for rewards (T, N)."""
    obs, next_obs = (agent.normalize(flat_tensor(array, device)) for array in (rollout.obs, rollout.next_obs))
    values, next_values = (agent.value(x).cpu().numpy().reshape(rewards.shape) for x in (obs, next_obs))
    advantages = gae(rewards, values, next_values, rollout.terminated, rollout.ended, args.gamma, args.gae_lambda)
    returns = flat_tensor(advantages + values, device)
    advantages = (advantages - advantages.mean()) / (advantages.std() + 1e-8)
    actions, seen = rollout.actions, bounded(rollout.actions, space.low, space.high)
    return Batch(obs, flat_tensor(actions, device), flat_tensor(seen, device), flat_tensor(advantages, device), returns)


def conjugate_gradient(multiply, b: torch.Tensor, iterations: int, tolerance: float = 1e-10) -> torch.Tensor:
    """Solve A x = b, (P,), by the method of Hestenes and Stiefel; `multiply` is v -> A v, A symmetric and positive."""
    x, residual, direction = torch.zeros_like(b), b.clone(), b.clone()
    square = residual @ residual
    for _ in range(iterations):
        if square < tolerance:
            break
        product = multiply(direction)
        length = square / (direction @ product)
        x += length * direction
        residual -= length * product
        new_square = residual @ residual
        direction = residual + new_square / square * direction
        square = new_square
    return x


def views(vector: torch.Tensor, shapes: list[torch.Size]) -> list[torch.Tensor]:
    """Cut a vector into tensors of the given shapes, without a copy."""
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes)]


class PolicyVector:
    """The policy as a function of one vector of its parameters, (P,): those of the mean, then the log deviations."""

    def __init__(self, agent: Agent):
        self.mean = agent.actor_mean
        self.names = [name for name, _ in agent.actor_mean.named_parameters()]
        parameters = [*agent.actor_mean.parameters(), agent.actor_logstd]
        self.shapes = [parameter.shape for parameter in parameters]
        self.vector = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
        for parameter, value in zip(parameters, views(self.vector, self.shapes)):
            parameter.data = value

    def __call__(self, vector: torch.Tensor, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Mean (B, A) and log deviation (A,) for normalised observations (B, O)."""
        *parts, logstd = views(vector, self.shapes)
        return torch.func.functional_call(self.mean, dict(zip(self.names, parts)), (obs,)), logstd


def fisher_product(policy: PolicyVector, vector: torch.Tensor, obs: torch.Tensor, damping: float):
    """The function v -> (F + damping · I) v, (P,) -> (P,): F is the Hessian of the mean KL divergence at the policy itself.

    For a Gaussian it is Jᵀ J / σ² over the means, averaged over the observations (B, O), and 2 I over the log deviations.
    """
    means, transposed = torch.func.vjp(lambda parameters: policy(parameters, obs)[0], vector)  # u -> Jᵀ u
    _, jacobian = torch.func.vjp(lambda means: transposed(means)[0], torch.zeros_like(means))  # v -> J v
    size = policy.shapes[-1].numel()
    weight = (-2 * vector[-size:]).exp() / len(obs)

    def multiply(direction: torch.Tensor) -> torch.Tensor:
        (product,) = transposed(jacobian(direction)[0] * weight)
        product[-size:] += 2 * direction[-size:]
        return product + damping * direction

    return multiply


def surrogate(policy: PolicyVector, vector: torch.Tensor, batch: Batch, old_logprobs, ent_coef: float) -> torch.Tensor:
    """Mean of ratio · advantage (Eq. 4.2.4), and the entropy: what TRPO makes large; a scalar, for old_logprobs (B,)."""
    mean, logstd = policy(vector, batch.obs)
    ratio = (gaussian_log_prob(mean, logstd, batch.actions) - old_logprobs).exp()  # ρ_t(θ)
    return (ratio * batch.advantages).mean() + ent_coef * gaussian_entropy(logstd)


def kl_bound(iteration: int, args: Args) -> float:
    """`--max-kl` in the first iteration; with `--anneal-kl` it falls linearly, to a hundredth at the end."""
    remaining = 1 - (iteration - 1) / args.num_iterations
    return args.max_kl * max(remaining, 0.01) if args.anneal_kl else args.max_kl


@torch.no_grad()
def trpo_step(policy: PolicyVector, batch: Batch, max_kl: float, args: Args) -> dict[str, float]:
    """The natural gradient step of the greatest length within the KL bound, and a line search back from there.

    Eq. 4.2.4 under Eq. 4.2.5, solved as in Schulman et al. 2015, appendix C.
    """
    old = policy.vector.clone()
    old_mean, old_logstd = policy(old, batch.obs)
    old_logprobs = gaussian_log_prob(old_mean, old_logstd, batch.actions)
    objective = functools.partial(surrogate, policy, batch=batch, old_logprobs=old_logprobs, ent_coef=args.ent_coef)
    gradient = torch.func.grad(objective)(old)
    before = objective(old)

    some = torch.randperm(len(batch.obs))[:: args.fisher_every]
    multiply = fisher_product(policy, old, batch.obs[some], args.cg_damping)
    direction = conjugate_gradient(multiply, gradient, args.cg_iterations)
    full = direction * torch.sqrt(2 * max_kl / (direction @ multiply(direction)).clamp(min=1e-12))
    for halvings in range(10):
        vector = old + 0.5**halvings * full
        mean, logstd = policy(vector, batch.obs)
        kl = gaussian_kl(old_mean, old_logstd, mean, logstd).mean()
        gain = objective(vector) - before
        if kl <= args.kl_slack * max_kl and gain > 0:  # Eq. 4.2.5
            policy.vector.copy_(vector)
            return {"losses/gain": gain.item(), "losses/kl": kl.item(), "charts/halvings": halvings}
    return {"losses/gain": 0.0, "losses/kl": 0.0, "charts/halvings": 10}


def update_values(agent: Agent, optimizer: torch.optim.Adam, batch: Batch, args: Args) -> float:
    """Fit the value function to the returns; return the last pass' mean squared error."""
    for _ in range(args.value_epochs):
        losses = []
        for inds in torch.randperm(len(batch.obs)).split(args.value_batch_size):
            loss = F.mse_loss(agent.value(batch.obs[inds]), batch.returns[inds])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
            losses.append(loss.detach())
    return torch.stack(losses).mean().item()


def update_discriminator(
    agent: Agent, optimizer: torch.optim.Adam, batch: Batch, experts: Experts, args: Args
) -> dict[str, float]:
    """One round of the discriminator: as many steps of each expert as of the student."""
    totals: dict[str, float] = {}
    for inds in torch.randperm(len(batch.obs)).tensor_split(args.d_steps):
        student = torch.cat([batch.obs[inds], batch.seen[inds]], 1)
        rl, human = (agent.pairs(*demos.sample(len(inds))) for demos in experts)
        loss, metrics = discriminator_loss(*map(agent.logits, (student, rl, human)), args.alpha, args.d_ent_coef)
        if args.d_grad_penalty:
            penalties = [gradient_penalty(agent.logits, student, expert) for expert in (rl, human)]
            loss = loss + args.d_grad_penalty * (args.alpha * penalties[0] + (1 - args.alpha) * penalties[1])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        for name, value in metrics.items():
            totals[name] = totals.get(name, 0.0) + value.item() / args.d_steps
    return totals


def behaviour_cloning(agent: Agent, experts: Experts, args: Args) -> None:
    """Maximise the likelihood of both experts' actions, weighted by α and 1 − α as in Eq. 2.3.1 (Adam, 3e-4, 128 steps of each)."""
    optimizer = torch.optim.Adam([*agent.actor_mean.parameters(), agent.actor_logstd], 3e-4, fused=True)
    for _ in range(args.bc_epochs * len(experts.human.obs) // 128):
        losses = []
        for demonstrations in experts:
            obs, actions = demonstrations.sample(128)
            means = agent.actor_mean(agent.normalize(obs))
            losses.append(-gaussian_log_prob(means, agent.actor_logstd, actions).mean())
        optimizer.zero_grad()
        (args.alpha * losses[0] + (1 - args.alpha) * losses[1]).backward()
        optimizer.step()


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "gail_hybrid 1"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "eval_mode", "capture_video", "save_model", "save_demos")
FREE_ON_RESUME = {"run_dir", "resume", "stop_at", "checkpoint_interval", *FINISH}
FREE_ON_RESUME |= {"track", "wandb_project_name", "wandb_entity"}
FREE_ON_RESUME |= {"demos_rl", "demos_human"}  # their data are compared, not their names


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


def learned_from(run_dir: Path, checkpoint: dict | None) -> str | None:
    """Fingerprint of the demonstrations that a run learns from, of a finished clone too; None where it has not begun."""
    if checkpoint is not None:
        return checkpoint["data"]
    result = run_dir / "result.json"
    return json.loads(result.read_text()).get("data") if result.exists() else None


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
MODES = ("sampled", "greedy")


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


def action_space(args: Args) -> gym.spaces.Box:
    """The task's actions, with bounds in the networks' float32."""
    space = make_env(args.env_id, **env_options(args)).action_space
    return gym.spaces.Box(space.low.astype(np.float32), space.high.astype(np.float32))


def make_policy(agent: Agent, mode: str, space: gym.spaces.Box, seed: int):
    """The policy as a function from observations (N, O) to the environment's actions (N, A): sampled, or its mean."""
    mean, deviation = numpy_mean(agent), agent.actor_logstd.detach().exp().cpu().numpy()
    rng = np.random.default_rng([seed, 1])

    def policy(obs: np.ndarray) -> np.ndarray:
        actions = mean(obs.astype(np.float32))
        if mode == "sampled":
            actions += deviation * rng.standard_normal(actions.shape, np.float32)
        return bounded(actions, space.low, space.high)

    return policy


def record_video(episode: dict[str, np.ndarray], args: Args, run_dir: Path) -> None:
    """Play an episode of `play` again by its seed and actions and write it into `videos/`."""
    env = make_env(args.env_id, "rgb_array", **env_options(args))
    env = gym.wrappers.RecordVideo(env, str(run_dir / "videos"), lambda episode: True)
    env.reset(seed=int(episode["seed"]))
    for action in episode["actions"]:
        env.step(action)
    env.close()


def evaluate(agent: Agent, args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes that training never saw, in each mode; write `evaluation.json` and, if asked, a video."""
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    space, evaluation = action_space(args), {"env_id": args.env_id, "seeds": seeds}
    for mode in MODES:
        policy = held(make_policy(agent, mode, space, args.seed), args.frame_skip)
        films = args.capture_video and mode == args.eval_mode
        episodes = play(policy, make_games(args, len(seeds)), seeds, keep=films)
        evaluation[mode] = {"mode": mode, **measured(episodes, args)}
        if films:
            record_video(episodes[0], args, run_dir)
    write_json(run_dir / "evaluation.json", evaluation)
    return evaluation


def measured(episodes: list[dict[str, np.ndarray]], args: Args) -> dict:
    """Returns of episodes, and of the driving task the scores of Table 2.3."""
    returns = [float(episode["rewards"].sum()) for episode in episodes]
    numbers = {**summary(returns), "returns": returns}
    if is_driving(args.env_id):
        numbers["driving"] = driving_scores(episodes, Track(*TRACKS[args.track_name]).length)
    return numbers


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(agent: Agent, args: Args, run_dir: Path) -> None:
    """Write `--save-demos` episodes of the student into `demos/`."""
    seeds = [episode_seed(args.seed, STUDENT_STREAM, i) for i in range(args.save_demos)]
    policy = make_policy(agent, args.eval_mode, action_space(args), args.seed)
    episodes = play(held(policy, args.frame_skip), make_games(args, len(seeds)), seeds, keep=True)
    about = {"player": f"{args.exp_name}, alpha {args.alpha}", "mode": args.eval_mode}
    write_demonstrations(run_dir / "demos", episodes, {"env_id": args.env_id, "options": env_options(args), **about})


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
    """Draw `learning_curve.png`: every episode's return, their moving mean, and the evaluations."""
    from matplotlib.figure import Figure

    steps, returns, _ = read_episodes(run_dir).T
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    axes.plot(steps, returns, ".", markersize=2, alpha=0.3, color="tab:blue", label="episodes in training")
    window = min(50, max(1, len(returns)))
    if len(returns):
        means = np.convolve(returns, np.ones(window) / window, "valid")
        axes.plot(steps[window - 1 :], means, color="tab:blue", label=f"mean of {window} episodes")
    for mode, colour in zip(MODES, ("tab:orange", "tab:green")):
        level = evaluation[mode]["mean"]
        label = f"evaluation ({mode}, {args.eval_episodes} episodes): {level:,.1f}"
        axes.axhline(level, color=colour, linestyle="--", label=label)
    where = f"{args.env_id}, {args.track_name}" if is_driving(args.env_id) else args.env_id
    axes.set_title(f"{where}, GAIL hybrid with α = {args.alpha}, seed {args.seed}")
    axes.set_xlabel("steps")
    axes.set_ylabel("episodic return, which the student never sees")
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.legend(loc="best", fontsize="small")
    axes.spines[["top", "right"]].set_visible(False)
    content = io.BytesIO()
    figure.savefig(content, dpi=150)
    write_whole(run_dir / "learning_curve.png", content.getvalue())


def print_table(result: dict) -> None:
    """Print the experts' demonstrations, the last episodes of training and the evaluations, one line each."""
    print(f"{'':32}{'episodes':>9}{'mean':>11}{'std':>11}{'min':>11}{'max':>11}")
    groups = {**result["experts"], "training": result["training"], **result["evaluation"]}
    rows = dict(groups)
    rows |= {f"{name}, (km/h) s": group["driving"]["score"] for name, group in groups.items() if "driving" in group}
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


def human_demonstrations(args: Args) -> list[dict[str, np.ndarray]]:
    """Episodes of the recorded or of the synthetic human; none where they have no weight. Raises UsageError."""
    if args.alpha == 1:
        return []
    if args.demos_human is not None:
        return read_demonstrations(args.demos_human, args, "--demos-human")
    seeds = [episode_seed(args.seed, HUMAN_STREAM, i) for i in range(args.human_episodes)]
    games = TorcsLikeVectorEnv(len(seeds), **env_options(args))
    return play(SyntheticDriver(games.cars, args.seed), games, seeds, keep=True)


def rl_demonstrations(args: Args) -> list[dict[str, np.ndarray]]:
    """Episodes of the RL expert; none where they have no weight. Raises UsageError."""
    return [] if args.alpha == 0 else read_demonstrations(args.demos_rl, args, "--demos-rl")


def main(args: Args) -> int:
    """Train, evaluate and write everything into the run's folder. Returns the exit code."""
    args = complete_args(args)
    env, space = make_env(args.env_id, **env_options(args)), action_space(args)
    if args.capture_video:
        check_video(args.env_id)
    torch.set_num_threads(args.num_threads)
    human, rl = human_demonstrations(args), rl_demonstrations(args)
    experts = Experts(*(Demonstrations(part, space, args.frame_skip) for part in (rl or human, human or rl)))
    about_experts = {name: measured(part, args) for name, part in (("rl", rl), ("human", human)) if part}
    run_dir, checkpoint = open_run_dir(args)
    last_iteration = min(args.num_iterations, math.ceil(args.stop_at / args.batch_size))
    data_id = experts.fingerprint()
    same_data = learned_from(run_dir, checkpoint) in (None, data_id)
    require(same_data, "--resume", run_dir, "demonstrations are no longer those that the run began with")
    if is_done(run_dir, args, last_iteration * args.batch_size):
        print(f"{run_dir} is done")
        return 0
    lost = checkpoint is None and (run_dir / "result.json").exists()
    require(not lost, "--resume", run_dir, "was finished with other flags, and its checkpoint is gone")
    write_json(run_dir / "args.json", arguments(args))
    print(run_dir)
    if args.track:
        start_wandb(args, run_dir)
    if human and args.demos_human is None:
        about = {"env_id": args.env_id, "options": env_options(args), "player": "synthetic human", "mode": "scripted"}
        write_demonstrations(run_dir / "demos_synthetic_human", human, about)
    del human, rl  # the arrays are in `experts` now

    random.seed(args.seed)  # for environments that draw from these two; their resumed runs end with other bytes
    np.random.seed(args.seed)
    torch.manual_seed(args.seed)
    torch.backends.cudnn.deterministic = args.torch_deterministic
    if args.cuda and not torch.cuda.is_available():
        print("--cuda: no GPU here, goes on with the CPU", file=sys.stderr)
    device = torch.device("cuda" if args.cuda and torch.cuda.is_available() else "cpu")
    stop = StopSignal()

    agent = Agent(env.observation_space.shape[0], space.shape[0], args.hidden_size)
    agent.set_normalization(torch.cat([demonstrations.obs for demonstrations in experts]))
    agent = agent.to(device)
    for demonstrations in experts:
        demonstrations.move(device)
    policy = PolicyVector(agent)
    value_optimizer = torch.optim.Adam(agent.critic.parameters(), args.value_learning_rate, fused=True)
    d_optimizer = torch.optim.Adam(agent.discriminator.parameters(), args.learning_rate, fused=True)
    optimizers = {"discriminator": d_optimizer, "value": value_optimizer}
    players = make_players(args)
    rng = np.random.default_rng(np.random.SeedSequence(args.seed))
    iteration, training_seconds, offsets = 0, 0.0, {"episodes": 0, "updates": 0}
    round_metrics: dict[str, float] = dict.fromkeys(DISCRIMINATOR_METRICS, math.nan)
    if checkpoint is None:
        start = time.perf_counter()
        behaviour_cloning(agent, experts, args)
        training_seconds = time.perf_counter() - start
        players.start()
    else:
        iteration, training_seconds = checkpoint["iteration"], checkpoint["training_seconds"]
        offsets, round_metrics = checkpoint["offsets"], checkpoint["round_metrics"]
        agent.load_state_dict(checkpoint["agent"])
        for name, optimizer in optimizers.items():
            optimizer.load_state_dict(checkpoint["optimizer"][name])
        rng.bit_generator.state = json.loads(checkpoint["rng"])
        torch.set_rng_state(checkpoint["torch_rng"])
        if not players.load_state_dict(checkpoint["players"]):
            print("--resume: the replayed episode differs (another machine?), goes on with it", file=sys.stderr)
        if checkpoint["arithmetic"] != device.type:
            print(
                f"--resume: was on {checkpoint['arithmetic']}, goes on as {device.type}: bytes will differ",
                file=sys.stderr,
            )
    global_step = iteration * args.batch_size
    logs = {name: CsvLog(run_dir / f"{name}.csv", offset) for name, offset in offsets.items()}
    forget_end(run_dir, iteration < last_iteration)
    writer = SummaryWriter(str(run_dir), purge_step=global_step + 1)
    begun = {"args": arguments(args), "arithmetic": device.type, "data": data_id}
    if checkpoint is None and last_iteration == 0:  # a clone, which is done but for its evaluation
        counters = {"iteration": 0, "training_seconds": training_seconds, "round_metrics": round_metrics}
        save_checkpoint(run_dir, {**begun, **counters, **state_of(agent, optimizers, rng, players, logs)})
        if stop.received:
            writer.close()
            print(f"stopped by signal {stop.received} before the evaluation; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received
    progress = tqdm(total=last_iteration * args.batch_size, initial=global_step, unit="step", disable=None)
    last_time = time.perf_counter()

    while iteration < last_iteration:
        iteration += 1
        rollout = collect(agent, players, space, args, rng)
        rewards = imitation_rewards(agent, rollout, space, args.reward_form, device)
        batch = make_batch(agent, rollout, rewards, space, args, device)
        metrics = {"charts/imitation_reward": float(rewards.mean())}
        metrics |= trpo_step(policy, batch, kl_bound(iteration, args), args)
        metrics["losses/value_loss"] = update_values(agent, value_optimizer, batch, args)
        metrics["charts/policy_std"] = agent.actor_logstd.exp().mean().item()
        if iteration % args.g_steps == 0:
            round_metrics = update_discriminator(agent, d_optimizer, batch, experts, args)
        metrics |= round_metrics

        for step, episodic_return, length in rollout.episodes:
            row = {"global_step": global_step + step, "episodic_return": episodic_return, "episodic_length": length}
            logs["episodes"].write(row)
            charts = {"charts/episodic_return": episodic_return, "charts/episodic_length": length}
            add_scalars(writer, charts, global_step + step)
            progress.set_postfix_str(f"return {episodic_return:.1f}", refresh=False)
        before, global_step = global_step, global_step + args.batch_size
        progress.update(args.batch_size)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        logs["updates"].write({"global_step": global_step, **metrics})
        add_scalars(writer, {**metrics, "charts/SPS": global_step / training_seconds}, global_step)
        if not all(parameter.isfinite().all() for parameter in agent.parameters()):
            raise RunError(f"step {global_step}: the agent's parameters are no longer finite (last metrics: {metrics})")

        crossed = global_step // args.checkpoint_interval > before // args.checkpoint_interval
        if crossed or stop.received or iteration == last_iteration:
            counters = {"iteration": iteration, "training_seconds": training_seconds, "round_metrics": round_metrics}
            writer.flush()
            save_checkpoint(run_dir, {**begun, **counters, **state_of(agent, optimizers, rng, players, logs)})
        if stop.received and iteration < last_iteration:
            progress.close()
            writer.close()
            print(f"stopped by signal {stop.received} at step {global_step}; go on with --run-dir {run_dir} --resume")
            return 128 + stop.received

    progress.close()
    stop.release()
    finish_run(agent, about_experts, data_id, args, run_dir, global_step, training_seconds, writer)
    writer.close()
    return 0


def state_of(agent: Agent, optimizers: dict, rng: np.random.Generator, players, logs: dict[str, CsvLog]) -> dict:
    """What a resumed run goes on from, besides its counters."""
    return {
        "offsets": {name: log.sync() for name, log in logs.items()},
        "agent": agent.state_dict(),
        "optimizer": {name: optimizer.state_dict() for name, optimizer in optimizers.items()},
        "rng": json.dumps(rng.bit_generator.state),
        "torch_rng": torch.get_rng_state(),
        "players": players.state_dict(),
    }


def finish_run(
    agent: Agent,
    experts_summary: dict,
    data_id: str,
    args: Args,
    run_dir: Path,
    global_step: int,
    seconds: float,
    writer: SummaryWriter,
) -> None:
    """Evaluate, draw, save what was asked for, and write `result.json` last."""
    evaluation = evaluate(agent, args, run_dir)
    for mode in MODES:
        for name in ("mean", "std", "min", "max"):
            writer.add_scalar(f"eval/episodic_return_{name}_{mode}", evaluation[mode][name], global_step)
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
        "complete": global_step == args.num_iterations * args.batch_size,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "experts": experts_summary,
        "data": data_id,
        "training": {"mode": "sampled", **summary(read_episodes(run_dir)[-50:, 1])},
        "evaluation": {
            mode: {name: value for name, value in evaluation[mode].items() if name != "returns"} for mode in MODES
        },
        "training_seconds": seconds,
        "steps_per_second": global_step / seconds if global_step else None,
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
