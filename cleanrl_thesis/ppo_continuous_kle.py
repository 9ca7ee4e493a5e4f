"""PPO with early stopping by KL divergence: KLE-Stop and KLE-Rollback (thesis chapter 4, Algorithm 4.1).

    python cleanrl_thesis/ppo_continuous_kle.py                                     # plain PPO, K = 10
    python cleanrl_thesis/ppo_continuous_kle.py --kle-stop --update-epochs 80       # stop the update at the threshold
    python cleanrl_thesis/ppo_continuous_kle.py --kle-rollback --d-target 0.03      # stop and undo the last iteration

Tasks: the eleven of the study as `kle/Ant-v2`, ..., `kle/Walker2d-v2`, and any Gymnasium environment with `Box`
observations and actions. `--run-dir DIR --resume` can be sent again after every crash: on the same machine the run
ends with the same bytes.

Three settings of the same file:

| setting | flags |
|---|---|
| as run (default): what made the thesis' tables | none |
| as printed: Table 4.1 and section 4.3.2 to the letter | `--gae-lambda 0.97 --ent-coef 0.2 --init-gains 1 1 1 --value-learning-rate 3e-4 --norm-adv-scope batch --norm-divisor variance --kl-estimator exact-new-old --kl-timing after-iteration --rollback policy` |
| modern: recommended for new work | `--kle-rollback --update-epochs 80 --bootstrap-truncated --kl-estimator exact-old-new --kl-samples batch --kl-timing after-iteration --rollback policy-moments` |

Where the default departs from the printed thesis, it follows the logs and the script of the published runs:

| | printed | default | why |
|---|---|---|---|
| λ of GAE, entropy coefficient η | 0.97, 0.2 | 0.95, 0 | the runs' logged arguments; η repeats the row of ε |
| D_KL | Eq. 4.3.1: D(π_k ‖ π_old), exact | mean(log π_old − log π_k) on the last minibatch, an estimate of the reverse | the script |
| KLE-Stop looks | after iteration k | before the last step of iteration k | the script reuses that pass |
| KLE-Rollback undoes | the policy | policy and value function; Adam's moments stay | the script |
| scaling of observations, rewards | by the variance | by the standard deviation | the script, and openai/baselines |
| learning rates α_π, α_v | two, both 3e-4 | one optimiser over both, the same numbers | the script |

Beyond both: every episode is reset with a seed of its own, so its number and its actions determine it; a checkpoint
keeps those, and a resumed run plays the unfinished episode again instead of copying a simulator's memory.
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "gymnasium[mujoco]>=1.2",
#     "matplotlib>=3.9",
#     "mujoco>=3.3.6",
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
import random
import re
import resource
import shutil
import signal
import sys
import time
import warnings
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import gymnasium as gym
import mujoco
import numpy as np
import safetensors.torch
import torch
import torch.nn as nn
import tyro
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.envs.mujoco.half_cheetah_v4 import HalfCheetahEnv
from gymnasium.envs.mujoco.hopper_v4 import HopperEnv
from gymnasium.envs.mujoco.humanoid_v4 import HumanoidEnv
from gymnasium.envs.mujoco.walker2d_v4 import Walker2dEnv
from tensorboard.compat.proto.summary_pb2 import Summary
from torch.utils.tensorboard import SummaryWriter
from tqdm import tqdm


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    exp_name: str = "ppo_continuous_kle"
    """the name of this experiment"""
    seed: int = 1
    """seed of the experiment"""
    torch_deterministic: bool = True
    """sets `torch.backends.cudnn.deterministic`"""
    cuda: bool = False
    """train on the GPU where there is one; off by default, for 64×64 networks spend their time in launching kernels"""
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
    """write `model.safetensors` at the end: weights and the observation statistics"""
    save_demos: int = 0
    """episodes of the trained agent to write into `demos/`, one .npz each and a manifest"""
    eval_episodes: int = 10
    """episodes of the evaluation at the end"""
    eval_mode: Literal["greedy", "sampled"] = "greedy"
    """take the policy's mean or sample from it, in evaluation and demonstrations"""
    run_dir: Path | None = None
    """the run's folder; default: runs/{env_id}__{exp_name}__{seed}__{unix time}"""
    resume: bool = False
    """go on from the checkpoint in `--run-dir`; start where there is none"""
    checkpoint_interval: int = 100_000
    """environment steps between checkpoints"""
    stop_at: int | None = None
    """end at this environment step of the full schedule; `--resume` can finish the run later"""

    # Algorithm
    env_id: str = "kle/Hopper-v2"
    """the environment: `kle/{Ant,HalfCheetah,Hopper,Humanoid,InvertedPendulum,Pusher,Reacher,Striker,Swimmer,Thrower,Walker2d}-v2` or a Gymnasium id"""
    total_timesteps: int = 2_000_000
    """environment steps N_T, rounded down to whole batches (Table 4.1)"""
    num_envs: int = 1
    """environments stepped in turn"""
    num_steps: int | None = None
    """steps per environment and iteration; default: 2,048 / num_envs (as run; openai/baselines)"""
    learning_rate: float = 3e-4
    """Adam's learning rate α_π (Table 4.1)"""
    value_learning_rate: float | None = None
    """α_v (Table 4.1); default: the same as the policy's"""
    anneal_lr: bool = True
    """anneal the learning rates linearly to 0 (section 4.3.2, item 6)"""
    gamma: float = 0.99
    """discount factor γ (Table 4.1)"""
    gae_lambda: float = 0.95
    """λ of the generalised advantage estimation (Table 4.1 prints 0.97; as run 0.95)"""
    num_minibatches: int = 32
    """minibatches per update iteration; 1 takes the whole batch (section 4.3.2, item 7)"""
    update_epochs: int = 10
    """K, update iterations per batch"""
    norm_adv: bool = True
    """normalise advantages (section 4.3.2, item 2)"""
    norm_adv_scope: Literal["minibatch", "batch"] = "minibatch"
    """normalise within each minibatch (as run) or once over the batch (as printed)"""
    clip_coef: float = 0.2
    """ε of the clipped objective (Eq. 4.2.6, Table 4.1)"""
    clip_vloss: bool = True
    """clip the value loss (section 4.3.2, item 5)"""
    ent_coef: float = 0.0
    """η, weight of the entropy (Table 4.1 prints 0.2; as run 0)"""
    vf_coef: float = 0.5
    """weight of the value loss (openai/baselines)"""
    max_grad_norm: float = 0.5
    """ω, bound on the norm of all gradients together; inf for none (Table 4.1; section 4.3.2, item 8)"""
    kle_stop: bool = False
    """stop the update when the KL divergence exceeds d_target (Algorithm 4.1, line 11)"""
    kle_rollback: bool = False
    """stop the update and undo its last iteration when the KL divergence exceeds d_target (Algorithm 4.1, line 12)"""
    d_target: Annotated[float, tyro.conf.arg(aliases=["--target-kl"])] = 0.03
    """KL divergence in nats above which early stopping acts (Algorithm 4.1, line 10)"""
    kl_estimator: Literal["k1", "k3", "exact-old-new", "exact-new-old"] = "k1"
    """k1 and k3 estimate D(π_old ‖ π_k) from the actions taken; exact-new-old is Eq. 4.3.1"""
    kl_samples: Literal["last-minibatch", "batch"] = "last-minibatch"
    """the states the divergence is averaged over (Algorithm 4.1, line 9: the last minibatch)"""
    kl_timing: Literal["before-last-step", "after-iteration"] | None = None
    """when iteration k is measured; default as run: after-iteration with --kle-rollback, else before-last-step"""
    rollback: Literal["policy", "policy-value", "policy-moments"] = "policy-value"
    """what KLE-Rollback restores: the policy (as printed), with the value function (as run), with its Adam moments (whose step
    count, shared with the value function, runs on)"""
    norm_obs: bool = True
    """normalise observations by running statistics (section 4.3.2, item 3)"""
    norm_reward: bool = True
    """divide rewards by the running scale of the discounted return (section 4.3.2, item 4)"""
    norm_divisor: Literal["std", "variance"] = "std"
    """divide by the standard deviation (as run) or by the variance (as printed)"""
    clip_obs: float = 10.0
    """bound on normalised observations (section 4.3.2, item 3)"""
    clip_reward: float = 10.0
    """bound on scaled rewards (section 4.3.2, item 4)"""
    ortho_init: bool = True
    """orthogonal initialisation; off: PyTorch's default (section 4.3.2, item 9)"""
    init_gains: tuple[float, float, float] = (math.sqrt(2), 0.01, 1.0)
    """gains of hidden layers, policy output and value output (as printed: 1 1 1)"""
    activation: Literal["tanh", "relu"] = "tanh"
    """activation of the hidden layers (section 4.3.2, item 10)"""
    bootstrap_truncated: bool = False
    """at a time-out, add γ·V(final observation); off (as run): a time-out is an end"""

    # to be filled in runtime
    batch_size: tyro.conf.Suppress[int] = 0
    """num_envs · num_steps"""
    minibatch_size: tyro.conf.Suppress[int] = 0
    """batch_size / num_minibatches"""
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
    if args.num_steps is None:
        divides = args.num_envs >= 1 and 2048 % args.num_envs == 0
        require(divides, "--num-envs", args.num_envs, "must divide 2048, or give --num-steps too")
        args.num_steps = 2048 // args.num_envs
    args.value_learning_rate = args.learning_rate if args.value_learning_rate is None else args.value_learning_rate
    args.kl_timing = args.kl_timing or ("after-iteration" if args.kle_rollback else "before-last-step")
    args.stop_at = args.total_timesteps if args.stop_at is None else args.stop_at
    counts = "num_envs num_steps num_minibatches update_epochs eval_episodes checkpoint_interval stop_at"
    for names, holds, allowed in (
        (counts, lambda x: x >= 1, "must be at least 1"),
        ("learning_rate value_learning_rate d_target", lambda x: 0 < x < math.inf, "must be greater than 0 and finite"),
        ("clip_coef max_grad_norm clip_obs clip_reward", lambda x: x > 0, "must be greater than 0"),
        ("ent_coef vf_coef", lambda x: 0 <= x < math.inf, "must be at least 0 and finite"),
        ("gamma gae_lambda", lambda x: 0 <= x <= 1, "must be between 0 and 1"),
        ("init_gains", lambda gains: all(map(math.isfinite, gains)), "must be three finite numbers"),
        ("seed", lambda x: 0 <= x < 2**32, "must be between 0 and 4294967295"),
        ("num_threads", lambda x: 1 <= x <= 1024, "must be between 1 and 1024"),
        ("exp_name", lambda x: re.fullmatch(r"[\w.-]+", x), "must be of letters, digits and the signs _ . -"),
        ("save_demos", lambda x: x >= 0, "must be at least 0"),
    ):
        for name in names.split():
            require(holds(getattr(args, name)), f"--{name.replace('_', '-')}", getattr(args, name), allowed)
    require(not (args.kle_stop and args.kle_rollback), "--kle-stop --kle-rollback", "", "choose one of the two")
    require(not args.resume or args.run_dir is not None, "--resume", "", "needs --run-dir, the folder to go on in")

    args.batch_size = args.num_envs * args.num_steps
    args.minibatch_size = args.batch_size // args.num_minibatches
    args.num_iterations = args.total_timesteps // args.batch_size
    rest, flag = args.batch_size % args.num_minibatches, "--num-minibatches"
    require(rest == 0, flag, args.num_minibatches, f"must divide the batch of {args.batch_size} steps")
    normalised = args.batch_size if args.norm_adv_scope == "batch" else args.minibatch_size
    enough = normalised >= 2 or not args.norm_adv
    require(enough, flag, args.num_minibatches, "must leave at least 2 steps to normalise advantages over")
    allowed = f"must be at least one batch, {args.batch_size} steps"
    require(args.num_iterations >= 1, "--total-timesteps", args.total_timesteps, allowed)
    if args.track and importlib.util.find_spec("wandb") is None:
        raise UsageError("--track: needs Weights and Biases: pip install wandb")
    if args.capture_video and importlib.util.find_spec("moviepy") is None:
        raise UsageError("--capture-video: needs moviepy: pip install moviepy")
    return args


# ---------------------------------------------------------------------------------------------------------------------
# The tasks of the study
# ---------------------------------------------------------------------------------------------------------------------
BOX, CAPSULE = mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CAPSULE
CYLINDER, SPHERE = mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE


class ZeroContactHumanoidEnv(HumanoidEnv):
    """Humanoid with its 84 contact forces at zero, as mujoco-py 2.0 gave them to the published runs."""

    def _get_obs(self) -> np.ndarray:
        obs = super()._get_obs()  # (376,), the last 84 are cfrc_ext
        obs[-84:] = 0.0
        return obs


class QuickMixin:
    """Gymnasium's -v4 tasks with their default arguments, number for number, with less time spent around the simulator."""

    def do_simulation(self, ctrl: np.ndarray, n_frames: int) -> None:
        self.data.ctrl[:] = ctrl
        mujoco.mj_step(self.model, self.data, n_frames)  # without the contact forces, which these tasks do not show

    def control_cost(self, action: np.ndarray) -> float:
        return self._ctrl_cost_weight * np.add.reduce(np.square(action))


class QuickHalfCheetahEnv(QuickMixin, HalfCheetahEnv):
    def _get_obs(self) -> np.ndarray:
        return np.concatenate([self.data.qpos[1:], self.data.qvel])


class QuickHopperEnv(QuickMixin, HopperEnv):
    healthy_reward = 1.0  # Gymnasium's looks at the health once more, which changes nothing where ill health ends it

    @property
    def is_healthy(self) -> bool:
        _, height, angle, *_ = state = self.state_vector().tolist()
        return height > 0.7 and -0.2 < angle < 0.2 and all(-100 < x < 100 for x in state[2:])


class QuickWalker2dEnv(QuickMixin, Walker2dEnv):
    healthy_reward = 1.0


class ArmEnv(MujocoEnv):
    """What Pusher, Striker and Thrower share: an arm of seven joints, 23 observations, reward of the state before the step.

    The model is Gymnasium's `pusher_v5.xml`, which `edit_model` turns into the task's own, equal to the old XML file.
    Where the code of -v2 means to freeze a position (Striker's last touch of the ball, Thrower's first low point of it)
    it kept a live view of the simulator's memory, which never froze. `freeze` does what the code means.
    """

    metadata = {"render_modes": ["human", "rgb_array", "depth_array", "rgbd_tuple"], "render_fps": 20}
    bodies, reset_speed, effort_weight = ("tips_arm", "object", "goal"), 0.005, 0.1

    def __init__(self, freeze: bool = False, **kwargs):
        self.freeze, self.frozen, self.nearest = freeze, None, np.inf
        space = gym.spaces.Box(-np.inf, np.inf, (23,), np.float64)
        super().__init__("pusher_v5.xml", 5, space, default_camera_config={"distance": 4.0, "trackbodyid": 0}, **kwargs)

    def _initialize_simulation(self):
        spec = mujoco.MjSpec.from_file(self.fullpath)
        self.edit_model(spec)
        model = spec.compile()
        model.vis.global_.offwidth, model.vis.global_.offheight = self.width, self.height
        return model, mujoco.MjData(model)

    def step(self, action):
        reward = self.reward(*(self.data.body(name).xpos for name in self.bodies))
        reward -= self.effort_weight * float(np.square(action).sum())
        self.do_simulation(action, self.frame_skip)
        if self.render_mode == "human":
            self.render()
        return self._get_obs(), reward, False, False, {}

    def reset_model(self) -> np.ndarray:
        self.frozen, self.nearest = None, np.inf
        qpos = self.init_qpos.copy()
        self.place_bodies(qpos)
        qvel = self.init_qvel + self.np_random.uniform(-self.reset_speed, self.reset_speed, self.model.nv)
        qvel[7:] = 0.0
        self.set_state(qpos, qvel)
        return self._get_obs()

    def _get_obs(self) -> np.ndarray:
        positions = [self.data.body(name).xpos for name in self.bodies]
        return np.concatenate([self.data.qpos[:7], self.data.qvel[:7], *positions])

    def uniform_outside(self, low: list[float], high: list[float], center: list[float]) -> np.ndarray:
        """A uniform point of the plane that is more than 0.17 m from `center`."""
        while True:
            point = self.np_random.uniform(low, high)
            if np.linalg.norm(point - center) > 0.17:
                return point


class PusherEnv(ArmEnv):
    """Push a cylinder to the goal. Pusher-v5 made the cylinder heavier, took a sphere out of it and rewards later."""

    def edit_model(self, spec: mujoco.MjSpec) -> None:
        """Turn Gymnasium's pusher into this task's model, in place."""
        cylinder = emptied(spec, "object")
        shape = {"size": [0.05] * 3, "density": 1e-5, "conaffinity": 0}
        cylinder.add_geom(type=SPHERE, rgba=[1, 1, 1, 0], **shape)
        cylinder.add_geom(type=CYLINDER, contype=1, **shape)

    def place_bodies(self, qpos: np.ndarray) -> None:
        qpos[7:9] = self.uniform_outside([-0.3, -0.2], [0.0, 0.2], [0.0, 0.0])
        qpos[9:11] = 0.0

    def reward(self, tip: np.ndarray, cylinder: np.ndarray, goal: np.ndarray) -> float:
        return -distance(cylinder, goal) - 0.5 * distance(cylinder, tip)


class StrikerEnv(ArmEnv):
    """Hit a ball so that it rolls to the goal; the distance that counts is the smallest so far."""

    reset_speed = 0.1

    def edit_model(self, spec: mujoco.MjSpec) -> None:
        """Turn Gymnasium's pusher into this task's model, in place."""
        for geom in [*spec.geoms, spec.default.geom]:
            geom.friction = [0.0, 0.0, 0.0]
        for actuator in spec.actuators:
            actuator.ctrlrange = [-3, 3]
        for geom in spec.body("r_wrist_roll_link").geoms[1:]:
            spec.delete(geom)
        hand = emptied(spec, "tips_arm")
        hand.add_geom(name="tip_arml", type=BOX, pos=[0.017, 0, 0], size=[0.003, 0.12, 0.05], contype=1, conaffinity=1)
        ball = emptied(spec, "object")
        ball.pos = [0, 0, -0.27]
        ball.add_geom(type=SPHERE, size=[0.05] * 3, contype=1, conaffinity=0)
        for joint in ball.joints:
            joint.armature = 0.1
        spec.delete(spec.body("goal"))
        goal = spec.worldbody.add_body(name="goal", pos=[0, 0, -0.323])
        goal.add_geom(type=BOX, size=[0.01] * 3, contype=0, conaffinity=0)
        wall = {"type": BOX, "pos": [0, 0.075, 0.04], "size": [0.032, 0.001, 0.04], "contype": 0, "conaffinity": 1}
        disc = {"type": CYLINDER, "size": [0.08, 0.001, 0.1], "density": 1e6, "contype": 0, "conaffinity": 0}
        goal.add_body().add_geom(**wall)
        goal.add_body(name="coaster").add_geom(**disc)
        goal.add_body(quat=rotation([0, 0, 1], 0.785)).add_geom(**wall)
        goal.add_body(quat=rotation([0, 0, 1], -0.785)).add_geom(**wall)
        add_free_joint(goal, "goal_free")

    def place_bodies(self, qpos: np.ndarray) -> None:
        ball = np.array([0.5, -0.175])
        goal = self.uniform_outside([0.15, 0.1], [0.7, 1.0], ball)
        qpos[7:9] = ball[::-1]
        qpos[9:11] = goal
        qpos[-1] = -np.arctan((ball - goal)[0] / ((ball - goal)[1] + 1e-8)) / 3.14

    def reward(self, tip: np.ndarray, ball: np.ndarray, goal: np.ndarray) -> float:
        self.nearest = min(self.nearest, distance(ball, goal))
        if self.freeze and distance(ball, tip) < 0.1:
            self.frozen = tip.copy()
        return -3.0 * self.nearest - 0.5 * distance(ball, tip if self.frozen is None else self.frozen)


class ThrowerEnv(ArmEnv):
    """Throw a ball into a box."""

    bodies, effort_weight = ("r_wrist_roll_link", "ball", "goal"), 0.002
    joints = {  # axis None: as in the Pusher
        "r_shoulder_pan_joint": ([-0.4854, 1.214602], None),
        "r_shoulder_lift_joint": ([-0.5236, 0.7963], None),
        "r_upper_arm_roll_joint": ([-1.5, 1.7], None),
        "r_elbow_flex_joint": ([-0.7, 0.7], None),
        "r_forearm_roll_joint": ([-1.5, 1.5], None),
        "r_wrist_flex_joint": ([-1, 1], [0, 0, 1]),
        "r_wrist_roll_joint": ([0, 2.25], [0, 1, 0]),
    }

    def edit_model(self, spec: mujoco.MjSpec) -> None:
        """Turn Gymnasium's pusher into this task's model, in place."""
        spec.option.gravity = [0, 0, -9.81]
        for joint in [*spec.joints, spec.default.joint]:
            joint.armature = 0.75
        for name, (bounds, axis) in self.joints.items():
            joint = spec.joint(name)
            joint.range, joint.axis = bounds, joint.axis if axis is None else axis
            set_damping(joint, 1.0)
        for actuator, bound in zip(spec.actuators, (10, 10, 10, 10, 15, 15, 15)):
            actuator.ctrlrange = [-bound, bound]
        for name in ("e1", "e2", "e1p", "e2p", "sl", "uar", "ua", "ef", "fr", "fa", "wf"):
            spec.geom(name).density = 1e-4
        spec.geom("sp").density = 1
        spec.geom("table").name = ""
        spec.geom("fa").fromto = [0, 0, 0, 0, 0, 0.291]
        spec.body("r_forearm_link").quat = rotation([1, 0, 0], 0.392)
        spec.body("r_wrist_flex_link").pos = [0, 0, 0.321]
        spec.body("r_wrist_flex_link").quat = rotation([0, 0, 1], 1.57)
        for name in ("tips_arm", "object", "goal"):
            spec.delete(spec.body(name))
        self.add_scoop(emptied(spec, "r_wrist_roll_link"))
        self.add_target(spec.worldbody.add_body(name="goal", pos=[0.575, 0.5, -0.328]))
        ball = spec.worldbody.add_body(name="ball", pos=[0.5, -0.8, 0.275])
        ball.add_geom(type=SPHERE, size=[0.03, 0.03, 0.1], density=25, contype=1, conaffinity=1)
        add_free_joint(ball, "ball_free", armature=0)

    def add_scoop(self, hand) -> None:
        """Seven bent fingers in a fan."""
        hand.quat = rotation([0, 1, 0], -1.178)
        bone = {"type": CAPSULE, "density": 1e-4, "contype": 1, "conaffinity": 1}
        hand.add_geom(fromto=[0, -0.05, 0, 0, 0.05, 0], size=[0.01, 0, 0], **bone)
        for angle in (0.392, 1.57, 1.178, 0.785, 1.96, 2.355, 2.74):
            finger = hand.add_body(quat=rotation([0, 0, 1], angle))
            points = ([0, 0.025, 0], [0, 0.075, 0.075], [0, 0.075, 0.15], [0, 0, 0.225])
            for start, end in zip(points, points[1:]):
                finger.add_geom(fromto=[*start, *end], size=[0.005, 0, 0], **bone)

    def add_target(self, goal) -> None:
        """A box without a lid, with a post in each corner, that slides on the ground."""
        floor = {"type": BOX, "pos": [0, 0, 0.005], "size": [0.075, 0.075, 0.001]}
        goal.add_geom(**floor, contype=1, conaffinity=1, density=1000)
        for x, y in ((0, 0.075), (0, -0.075), (0.075, 0), (-0.076, 0)):
            size = [0.001 if x else 0.075, 0.001 if y else 0.075, 0.03]
            goal.add_geom(type=BOX, pos=[x, y, 0.034], size=size, contype=1, conaffinity=0)
        for x, y in ((0.073, 0.073), (0.073, -0.073), (-0.073, 0.073), (-0.073, -0.073)):
            post = [x, y, 0.0075, x, y, 0.06]
            goal.add_geom(type=CAPSULE, fromto=post, size=[0.005, 0, 0], contype=1, conaffinity=0)
        for name, axis in (("goal_slidey", [0, 1, 0]), ("goal_slidex", [1, 0, 0])):
            goal.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis, range=[-10.3213, 10.3])

    def place_bodies(self, qpos: np.ndarray) -> None:
        qpos[7:9] = self.np_random.uniform(-0.3, 0.3, 2)

    def reward(self, hand: np.ndarray, ball: np.ndarray, goal: np.ndarray) -> float:
        if self.freeze and self.frozen is None and ball[2] < -0.25:
            self.frozen = ball.copy()
        return -distance((ball if self.frozen is None else self.frozen)[:2], goal[:2])


def distance(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.linalg.norm(a - b))


def rotation(axis: list[float], angle: float) -> list[float]:
    """Quaternion of a rotation by `angle` radians about a unit `axis`."""
    return [math.cos(angle / 2), *(math.sin(angle / 2) * component for component in axis)]


def emptied(spec: mujoco.MjSpec, name: str):
    """A body of the model after its shapes are taken away."""
    for geom in spec.body(name).geoms:
        spec.delete(geom)
    return spec.body(name)


def set_damping(joint, damping: float) -> None:
    """Set a joint's damping, which newer versions of MuJoCo hold as three coefficients."""
    joint.damping = [damping, *joint.damping[1:]] if np.ndim(joint.damping) else damping


def add_free_joint(body, name: str, **options) -> None:
    """Add a free joint without limits or damping, whatever the model's defaults."""
    joint = body.add_joint(name=name, type=mujoco.mjtJoint.mjJNT_FREE, **options)
    joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    set_damping(joint, 0.0)


STUDY_TASKS = {
    "Ant": ("gymnasium.envs.mujoco.ant_v4:AntEnv", 1000),
    "HalfCheetah": (QuickHalfCheetahEnv, 1000),
    "Hopper": (QuickHopperEnv, 1000),
    "Humanoid": (ZeroContactHumanoidEnv, 1000),
    "InvertedPendulum": ("gymnasium.envs.mujoco.inverted_pendulum_v4:InvertedPendulumEnv", 1000),
    "Pusher": (PusherEnv, 100),
    "Reacher": ("gymnasium.envs.mujoco.reacher_v4:ReacherEnv", 50),
    "Striker": (StrikerEnv, 100),
    "Swimmer": ("gymnasium.envs.mujoco.swimmer_v4:SwimmerEnv", 1000),
    "Thrower": (ThrowerEnv, 100),
    "Walker2d": (QuickWalker2dEnv, 1000),
}
for task_name, (task_entry_point, task_max_steps) in STUDY_TASKS.items():
    if f"kle/{task_name}-v2" not in gym.registry:
        gym.register(f"kle/{task_name}-v2", task_entry_point, max_episode_steps=task_max_steps)


def report_mujoco_warning(text: str) -> None:
    """Pass MuJoCo's warnings on to Python's; otherwise each goes to a file in the working folder."""
    if "settotalmass" not in text:  # HalfCheetah's model, at every start
        warnings.warn(f"MuJoCo: {text}", stacklevel=2)


mujoco.set_mju_user_warning(report_mujoco_warning)


def make_env(env_id: str, render_mode: str | None = None) -> gym.Env:
    """Make an environment with `Box` observations and actions. Raises UsageError."""
    drawn = {} if render_mode is None else {"render_mode": render_mode}  # not every environment knows the word
    try:
        env = gym.make(env_id, disable_env_checker=True, **drawn)
    except (gym.error.Error, AttributeError, ImportError, OSError, TypeError, ValueError) as error:
        raise UsageError(f"--env-id {env_id}: {first_line(error)}") from None
    for name, space in (("observations", env.observation_space), ("actions", env.action_space)):
        require(isinstance(space, gym.spaces.Box), "--env-id", env_id, f"needs Box {name}, this one has {space}")
    is_continuous = np.issubdtype(env.action_space.dtype, np.floating)
    require(is_continuous, "--env-id", env_id, f"needs actions that are floats, this one has {env.action_space}")
    model = getattr(env.unwrapped, "model", None)
    if isinstance(model, mujoco.MjModel) and model.ntree == 1:  # it is one island: looking for more takes up to 7%
        model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND
    return env


# ---------------------------------------------------------------------------------------------------------------------
# Networks
# ---------------------------------------------------------------------------------------------------------------------
class Tanh(nn.Module):
    """tanh(x) by the fastest way that there is, to float tolerance.

    In a compiled graph that is 2σ(2x) − 1, a sixth off the whole update step; on the CPU without a gradient it is numpy.
    """

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        if torch.compiler.is_compiling():
            return 2 * torch.sigmoid(2 * x) - 1
        if x.device.type == "cpu" and not torch.is_grad_enabled():
            return torch.from_numpy(np.tanh(x.numpy()))
        return torch.tanh(x)


def mlp(sizes: list[int], activation: str, ortho_init: bool, hidden_gain: float, output_gain: float) -> nn.Sequential:
    """Linear layers of the given sizes with an activation between them (section 4.3.2, items 9 and 10)."""
    layers = []
    for i, (inputs, outputs) in enumerate(zip(sizes, sizes[1:])):
        linear = nn.Linear(inputs, outputs)
        is_output = i == len(sizes) - 2
        if ortho_init:
            nn.init.orthogonal_(linear.weight, output_gain if is_output else hidden_gain)
            nn.init.zeros_(linear.bias)
        layers.append(linear)
        if not is_output:
            layers.append({"tanh": Tanh, "relu": nn.ReLU}[activation]())
    return nn.Sequential(*layers)


class Agent(nn.Module):
    """Separate networks for the policy and the value function, and the statistics that normalise their input.

    The policy is a diagonal Gaussian; its log standard deviation is a free parameter. Buffers `obs_mean` and
    `obs_divisor` (O,) are saved with the weights, so that the saved file is a whole agent.
    """

    def __init__(self, obs_dim: int, action_dim: int, activation: str, ortho_init: bool, gains: tuple[float, ...]):
        super().__init__()
        hidden, policy, value = gains
        self.actor_mean = mlp([obs_dim, 64, 64, action_dim], activation, ortho_init, hidden, policy)
        self.actor_logstd = nn.Parameter(torch.zeros(action_dim))
        self.critic = mlp([obs_dim, 64, 64, 1], activation, ortho_init, hidden, value)
        self.register_buffer("obs_mean", torch.zeros(obs_dim, dtype=torch.float64))
        self.register_buffer("obs_divisor", torch.ones(obs_dim, dtype=torch.float64))

    def policy_parameters(self) -> list[nn.Parameter]:
        return [*self.actor_mean.parameters(), self.actor_logstd]

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Normalised obs (B, O) -> mean (B, A), log standard deviation (A,), value (B,)."""
        return self.actor_mean(obs), self.actor_logstd, self.critic(obs).squeeze(-1)


def numpy_policy(agent: Agent):
    """The policy's mean as a numpy function, (N, O) -> (N, A): without torch's overhead of 100 µs for one observation.

    On the CPU it shares the agent's memory; on a GPU it is a copy, to be made anew after each update. It is the twin of
    `Agent.actor_mean`: change both.
    """
    unknown = {type(module) for module in agent.actor_mean} - {nn.Linear, Tanh, nn.ReLU}
    if unknown:
        raise TypeError(f"numpy_policy would leave out what is new in actor_mean: {unknown}")
    linears = [module for module in agent.actor_mean if isinstance(module, nn.Linear)]
    layers = [[tensor.detach().cpu().numpy() for tensor in (linear.weight.T, linear.bias)] for linear in linears]
    activation = np.tanh if isinstance(agent.actor_mean[1], Tanh) else functools.partial(np.maximum, 0.0)

    def forward(x: np.ndarray) -> np.ndarray:
        for weight, bias in layers[:-1]:
            x = x.dot(weight)
            x += bias
            activation(x, out=x)
        weight, bias = layers[-1]
        return x.dot(weight) + bias

    return forward


# ---------------------------------------------------------------------------------------------------------------------
# Collecting a batch
# ---------------------------------------------------------------------------------------------------------------------
class RunningMeanStd:
    """Mean and variance of a stream of arrays (Welford), from mean 0 and variance 1 at a weight of 1e-4."""

    def __init__(self, shape: tuple[int, ...]):
        self.mean, self.count = np.zeros(shape)[()], 1e-4
        self.squares = np.full(shape, self.count)[()]  # sum of squared deviations from the mean

    def update(self, x: np.ndarray) -> None:
        """Take in one sample of the stream's shape."""
        self.count += 1.0
        delta = x - self.mean
        self.mean = self.mean + delta / self.count
        self.squares = self.squares + delta * (x - self.mean)

    def divisor(self, kind: str) -> np.ndarray:
        """What to divide by: the standard deviation or, as section 4.3.2 prints, the variance."""
        variance = self.squares / self.count + 1e-8
        return variance if kind == "variance" else variance**0.5

    def state_dict(self) -> dict:
        return {"mean": torch.as_tensor(self.mean), "squares": torch.as_tensor(self.squares), "count": self.count}

    def load_state_dict(self, state: dict) -> None:
        self.mean, self.squares, self.count = state["mean"].numpy()[()], state["squares"].numpy()[()], state["count"]


def bounded(x: np.ndarray, low: np.ndarray | float, high: np.ndarray | float) -> np.ndarray:
    """`np.clip` without its overhead on small arrays."""
    return np.minimum(np.maximum(x, low), high)


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
    `reset(seed=)`; where episodes have no end, checkpoints grow with the run.
    """

    def __init__(self, env: gym.Env, seed: int, stream: int, gamma: float):
        self.env, self.seed, self.stream, self.gamma = env, seed, stream, gamma
        self.action_shape = env.action_space.shape
        self.number = -1

    def start(self) -> np.ndarray:
        """Begin the next episode and return its first observation (O,)."""
        self.number += 1
        self.actions: list[np.ndarray] = []
        self.episodic_return = self.discounted_return = 0.0
        obs, _ = self.env.reset(seed=episode_seed(self.seed, self.stream, self.number))
        return obs.reshape(-1)

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool]:
        """Apply an action (A,) within the bounds; return observation (O,), reward, terminated, truncated."""
        self.actions.append(action.copy())  # some environments change theirs
        obs, reward, terminated, truncated, _ = self.env.step(action.reshape(self.action_shape))
        reward = float(reward)
        self.episodic_return += reward
        self.discounted_return = self.gamma * self.discounted_return + reward
        return obs.reshape(-1), reward, terminated, truncated

    def replay(self, number: int, actions: np.ndarray) -> np.ndarray:
        """Play episode `number` again up to the last of `actions` (T, A) and return the observation (O,) there."""
        self.number = number - 1
        obs = self.start()
        for action in actions:
            obs, _, _, _ = self.step(action)
        return obs


class Rollout(NamedTuple):
    """T steps of N environments, in the agent's units: observations normalised, rewards scaled."""

    obs: np.ndarray  # (T + 1, N, O) float32; the last is the one to act on next
    actions: np.ndarray  # (T, N, A) float32, not clipped to the bounds
    rewards: np.ndarray  # (T, N)
    dones: np.ndarray  # (T, N), 1 where the episode ended with this step
    time_outs: list[tuple[int, int, np.ndarray]]  # (t, i, final observation (O,)) of the episodes that ran out of time
    episodes: list[tuple[int, float, int]]  # (steps into the rollout, return, length) of the episodes that ended


class Collector:
    """Steps a list of environments with the agent's policy; keeps all that lasts from one rollout to the next."""

    def __init__(self, envs: list[gym.Env], args: Args):
        self.args = args
        self.episodes = [Episode(env, args.seed, i, args.gamma) for i, env in enumerate(envs)]
        self.low, self.high = np.ravel(envs[0].action_space.low), np.ravel(envs[0].action_space.high)
        self.obs_dim, self.action_dim = math.prod(envs[0].observation_space.shape), len(self.low)
        self.rng = np.random.default_rng(np.random.SeedSequence(args.seed))
        self.obs_stats, self.return_stats = RunningMeanStd((self.obs_dim,)), RunningMeanStd(())
        self.raw_obs = np.zeros((len(envs), self.obs_dim))

    def start(self) -> None:
        """Begin the first episode of each environment."""
        for i, episode in enumerate(self.episodes):
            self.raw_obs[i] = episode.start()
            self.obs_stats.update(self.raw_obs[i])

    def normalize(self, obs: np.ndarray) -> np.ndarray:
        """Raw observations (..., O) to the agent's input (section 4.3.2, item 3)."""
        if not self.args.norm_obs:
            return obs
        scaled = obs - self.obs_stats.mean
        scaled /= self.obs_stats.divisor(self.args.norm_divisor)
        return bounded(scaled, -self.args.clip_obs, self.args.clip_obs)

    def scale_reward(self, reward: float, discounted_return: float) -> float:
        """Divide by the running scale of the discounted return (section 4.3.2, item 4)."""
        if not self.args.norm_reward:
            return reward
        self.return_stats.update(discounted_return)
        scaled = reward / self.return_stats.divisor(self.args.norm_divisor)
        return min(max(scaled, -self.args.clip_reward), self.args.clip_reward)

    def collect(self, agent: Agent) -> Rollout:
        """Fill the batch with the current policy (Algorithm 4.1, line 3)."""
        steps, num_envs = self.args.num_steps, len(self.episodes)
        rollout = Rollout(
            obs=np.empty((steps + 1, num_envs, self.obs_dim), np.float32),
            actions=np.empty((steps, num_envs, self.action_dim), np.float32),
            rewards=np.empty((steps, num_envs), np.float32),
            dones=np.zeros((steps, num_envs), np.float32),
            time_outs=[],
            episodes=[],
        )
        policy, std = numpy_policy(agent), agent.actor_logstd.detach().exp().cpu().numpy()
        noise = self.rng.standard_normal(rollout.actions.shape, np.float32) * std
        for t in range(steps):
            rollout.obs[t] = self.normalize(self.raw_obs)
            rollout.actions[t] = policy(rollout.obs[t]) + noise[t]
            actions = bounded(rollout.actions[t], self.low, self.high)
            for i, episode in enumerate(self.episodes):
                obs, reward, terminated, truncated = episode.step(actions[i])
                rollout.rewards[t, i] = self.scale_reward(reward, episode.discounted_return)
                self.obs_stats.update(obs)
                if terminated or truncated:
                    rollout.dones[t, i] = 1.0
                    step = t * num_envs + i + 1
                    rollout.episodes.append((step, episode.episodic_return, len(episode.actions)))
                    if truncated and not terminated:
                        rollout.time_outs.append((t, i, self.normalize(obs).astype(np.float32)))
                    obs = episode.start()
                    self.obs_stats.update(obs)
                self.raw_obs[i] = obs
        rollout.obs[steps] = self.normalize(self.raw_obs)
        return rollout

    def update_agent_statistics(self, agent: Agent) -> None:
        """Copy the statistics into the agent's buffers, which are saved with it."""
        if self.args.norm_obs:
            agent.obs_mean.copy_(torch.from_numpy(self.obs_stats.mean))
            agent.obs_divisor.copy_(torch.from_numpy(self.obs_stats.divisor(self.args.norm_divisor)))

    def state_dict(self) -> dict:
        """All that `load_state_dict` restores, as tensors and plain values."""
        episodes = [
            {"number": episode.number, "actions": torch.from_numpy(np.array(episode.actions))}
            for episode in self.episodes
        ]
        return {
            "episodes": episodes,
            "raw_obs": torch.from_numpy(self.raw_obs.copy()),
            "rng": json.dumps(self.rng.bit_generator.state),
            "obs_stats": self.obs_stats.state_dict(),
            "return_stats": self.return_stats.state_dict(),
        }

    def load_state_dict(self, state: dict) -> bool:
        """Restore everything; return whether the replayed episodes gave the saved observations bit for bit."""
        self.rng.bit_generator.state = json.loads(state["rng"])
        self.obs_stats.load_state_dict(state["obs_stats"])
        self.return_stats.load_state_dict(state["return_stats"])
        for i, (episode, saved) in enumerate(zip(self.episodes, state["episodes"])):
            self.raw_obs[i] = episode.replay(saved["number"], saved["actions"].numpy())
        return np.array_equal(self.raw_obs, state["raw_obs"].numpy())


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


def gae(rewards: np.ndarray, values: np.ndarray, dones: np.ndarray, gamma: float, gae_lambda: float) -> np.ndarray:
    """Generalised advantage estimation, A(τ, V, t) of Eq. 4.2.3.

    rewards (T, N), values (T + 1, N), dones (T, N), 1 where the episode ended with step t -> advantages (T, N).
    """
    advantages = np.empty_like(rewards)
    columns = (array.T.tolist() for array in (rewards, values, dones))  # lists: faster than numpy scalars
    for i, (reward, value, done) in enumerate(zip(*columns)):
        advantage = 0.0
        for t in range(len(reward) - 1, -1, -1):
            alive = 1.0 - done[t]
            delta = reward[t] + gamma * value[t + 1] * alive - value[t]
            advantage = delta + gamma * gae_lambda * alive * advantage
            advantages[t, i] = advantage
    return advantages


class Batch(NamedTuple):
    """B steps as tensors; `means` (of the policy that acted) serve the exact KL divergence."""

    obs: torch.Tensor  # (B, O)
    actions: torch.Tensor  # (B, A)
    logprobs: torch.Tensor  # (B,)
    means: torch.Tensor  # (B, A)
    advantages: torch.Tensor  # (B,)
    returns: torch.Tensor  # (B,)
    values: torch.Tensor  # (B,)

    def pack(self) -> torch.Tensor:
        """All columns side by side, (B, O + 2A + 4): one gather shuffles them, in a quarter of the time of seven."""
        return torch.cat([column.reshape(len(self.obs), -1) for column in self], 1)

    @classmethod
    def unpack(cls, rows: torch.Tensor, action_dim: int) -> "Batch":
        """The batch whose packed rows (M, O + 2A + 4) are given, as views."""
        obs_dim = rows.shape[1] - 2 * action_dim - 4
        obs, actions, logprobs, means, *scalars = rows.split([obs_dim, action_dim, 1, action_dim, 1, 1, 1], 1)
        return cls(obs, actions, logprobs.squeeze(1), means, *(scalar.squeeze(1) for scalar in scalars))


@torch.no_grad()
def make_batch(agent: Agent, rollout: Rollout, args: Args, device: torch.device) -> Batch:
    """Evaluate the acting policy and the value function on a whole rollout at once and estimate the advantages."""
    steps, num_envs = rollout.rewards.shape
    obs = torch.from_numpy(rollout.obs).to(device).flatten(0, 1)  # (B + N, O)
    actions = torch.from_numpy(rollout.actions).to(device).flatten(0, 1)  # (B, A)
    mean, logstd, value = agent(obs)
    values = value.cpu().numpy().reshape(steps + 1, num_envs)
    rewards = rollout.rewards
    if args.bootstrap_truncated and rollout.time_outs:
        rewards = rewards.copy()
        final_obs = torch.from_numpy(np.stack([final for _, _, final in rollout.time_outs])).to(device)
        for (t, i, _), final_value in zip(rollout.time_outs, agent(final_obs)[2].tolist()):
            rewards[t, i] += args.gamma * final_value
    advantages = gae(rewards, values, rollout.dones, args.gamma, args.gae_lambda)
    b_advantages = torch.from_numpy(advantages).to(device).flatten()
    b_values = value[: args.batch_size].clone()
    b_returns = b_advantages + b_values  # V_target of section 4.3.2, item 5
    if args.norm_adv and args.norm_adv_scope == "batch":
        b_advantages = (b_advantages - b_advantages.mean()) / (b_advantages.std() + 1e-8)
    b_means, b_obs = mean[: args.batch_size].clone(), obs[: args.batch_size]
    b_logprobs = gaussian_log_prob(b_means, logstd, actions)
    return Batch(b_obs, actions, b_logprobs, b_means, b_advantages, b_returns, b_values)


def ppo_loss(
    outputs: tuple[torch.Tensor, torch.Tensor, torch.Tensor],
    minibatch: Batch,
    clip_coef: float,
    clip_vloss: bool,
    norm_adv: bool,
    ent_coef: float,
    vf_coef: float,
) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
    """The loss to minimise, and as scalars the policy's loss, the value's and the share of clipped ratios.

    `outputs` are the agent's for the minibatch: mean (M, A), logstd (A,), value (M,).
    """
    mean, logstd, value = outputs
    advantages, old_value = minibatch.advantages, minibatch.values
    if norm_adv:
        std, center = torch.std_mean(advantages)
        advantages = (advantages - center) / (std + 1e-8)
    ratio = torch.exp(gaussian_log_prob(mean, logstd, minibatch.actions) - minibatch.logprobs)  # ρ_t(θ)
    clipped_ratio = ratio.clamp(1 - clip_coef, 1 + clip_coef)
    pg_loss = -torch.min(advantages * ratio, advantages * clipped_ratio).mean()  # Eq. 4.2.6

    v_error = value - minibatch.returns
    v_squared = v_error * v_error  # cheaper than a power, backward too
    if clip_vloss:  # section 4.3.2, item 5
        v_clipped_error = torch.clamp(value, old_value - clip_coef, old_value + clip_coef) - minibatch.returns
        v_squared = torch.max(v_squared, v_clipped_error * v_clipped_error)
    v_loss = 0.5 * v_squared.mean()

    loss = pg_loss + vf_coef * v_loss
    if ent_coef:
        loss = loss - ent_coef * gaussian_entropy(logstd)
    with torch.no_grad():
        clipfrac = (clipped_ratio != ratio).float().mean()
    return loss, (pg_loss, v_loss, clipfrac)


@torch.no_grad()
def kl_estimates(agent: Agent, batch: Batch, old_logstd: torch.Tensor) -> dict[str, torch.Tensor]:
    """How far the policy has moved from the one that acted, averaged over the batch's states.

    k1 and k3 estimate D_KL(π_old ‖ π_k) from the actions taken; "exact-new-old" is Eq. 4.3.1 in closed form.
    """
    mean, logstd = agent.actor_mean(batch.obs), agent.actor_logstd
    logratio = gaussian_log_prob(mean, logstd, batch.actions) - batch.logprobs  # log ρ_t(θ)
    return {
        "k1": -logratio.mean(),
        "k3": (torch.exp(logratio) - 1 - logratio).mean(),
        "exact-old-new": gaussian_kl(batch.means, old_logstd, mean, logstd).mean(),
        "exact-new-old": gaussian_kl(mean, logstd, batch.means, old_logstd).mean(),
    }


def views(vector: torch.Tensor, shapes: list[torch.Size]) -> list[torch.Tensor]:
    """Cut a vector into tensors of the given shapes, without a copy."""
    parts = vector.split([shape.numel() for shape in shapes])
    return [part.view(shape) for part, shape in zip(parts, shapes)]


class FlatAdam:
    """Adam over one vector, of which the agent's parameters become views: the policy's first, then the value function's.

    One vector is clipped and stepped faster than a dozen tensors, and a slice of it is what KLE-Rollback restores.
    """

    def __init__(self, agent: Agent, learning_rate: float, value_learning_rate: float):
        self.parameters = [*agent.policy_parameters(), *agent.critic.parameters()]
        if len(self.parameters) < len(list(agent.parameters())):
            raise ValueError(
                "a part of the agent is neither in policy_parameters() nor in critic, and would not be trained"
            )
        self.shapes = [parameter.shape for parameter in self.parameters]
        self.vector = torch.cat([parameter.detach().reshape(-1) for parameter in self.parameters])
        self.gradient, self.mean, self.square = (torch.zeros_like(self.vector) for _ in range(3))
        for i, value in enumerate(views(self.vector, self.shapes)):
            self.parameters[i].data = value
        for i, gradient in enumerate(views(self.gradient, self.shapes)):
            self.parameters[i].grad = gradient
        self.step = torch.zeros((), device=self.vector.device)
        self.policy = slice(0, sum(parameter.numel() for parameter in agent.policy_parameters()))
        self.initial_rates = torch.full_like(self.vector, value_learning_rate)  # Table 4.1: α_v and α_π
        self.initial_rates[self.policy] = learning_rate
        self.rates = self.initial_rates.clone()

    def anneal(self, remaining: float) -> None:
        """Set the learning rates to a share of the initial ones (section 4.3.2, item 6)."""
        self.rates.copy_(self.initial_rates * remaining)

    def state_dict(self) -> dict[str, torch.Tensor]:
        return {"mean": self.mean, "square": self.square, "step": self.step}

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
    """One step of Adam on one minibatch (Algorithm 4.1, line 7)."""

    def __init__(self, agent: Agent, optimizer: FlatAdam, loss_function, max_grad_norm: float):
        self.agent, self.optimizer = agent, optimizer
        self.loss_function, self.max_grad_norm = loss_function, max_grad_norm

    def __call__(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Change the agent and the optimiser by a packed minibatch; return the parts of the loss before the step."""
        minibatch = Batch.unpack(rows, len(self.agent.actor_logstd))
        loss, parts = self.loss_function(self.agent(minibatch.obs), minibatch)
        adam = self.optimizer
        adam.gradient.zero_()
        loss.backward()
        with torch.no_grad():
            self.adam_step(adam.vector, adam.mean, adam.square, adam.step, adam.rates, adam.gradient)
        return parts

    def adam_step(self, vector, mean, square, step, rates, gradient) -> None:
        adam_step(vector, mean, square, step, rates, gradient, self.max_grad_norm, 1e-5)  # section 4.3.2, item 8


class CompiledUpdate(PlainUpdate):
    """The same step, gradient included, as one compiled graph."""

    def __init__(self, agent: Agent, optimizer: FlatAdam, loss_function, max_grad_norm: float, batch_rows: int):
        super().__init__(agent, optimizer, loss_function, max_grad_norm)
        names = {parameter: name for name, parameter in agent.named_parameters()}
        self.names = [names[parameter] for parameter in optimizer.parameters]
        self.variables = (optimizer.vector, optimizer.mean, optimizer.square, optimizer.step)
        self.compiled = torch.compile(self.step, options={"cpp_wrapper": True})  # kernels called from C++: saves 25 µs
        example = optimizer.vector.new_zeros(batch_rows, len(agent.obs_mean) + 2 * len(agent.actor_logstd) + 4)
        torch.compiler.set_stance("default")
        with torch.no_grad():  # compiles, and changes nothing but copies
            self.compiled(*(tensor.clone() for tensor in self.variables), optimizer.rates, example)
        torch.compiler.set_stance("default", skip_guard_eval_unsafe=True)  # every call is alike: saves 30 µs of each

    def loss(self, vector: torch.Tensor, rows: torch.Tensor) -> tuple[torch.Tensor, tuple[torch.Tensor, ...]]:
        """The loss as a function of the vector of parameters."""
        parameters = dict(zip(self.names, views(vector, self.optimizer.shapes)))
        minibatch = Batch.unpack(rows, len(self.agent.actor_logstd))
        return self.loss_function(torch.func.functional_call(self.agent, parameters, (minibatch.obs,)), minibatch)

    def step(self, vector, mean, square, step, rates, rows) -> tuple[torch.Tensor, ...]:
        gradient, parts = torch.func.grad(self.loss, has_aux=True)(vector, rows)
        self.adam_step(vector, mean, square, step, rates, gradient)
        return parts

    def __call__(self, rows: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Change the agent and the optimiser by a packed minibatch; return the parts of the loss before the step."""
        with torch.no_grad():
            return self.compiled(*self.variables, self.optimizer.rates, rows)


def make_update(agent: Agent, optimizer: FlatAdam, args: Args) -> PlainUpdate | CompiledUpdate:
    """The compiled step with `--compile` where a compiler is at hand, else the plain one."""
    loss_function = functools.partial(
        ppo_loss,
        clip_coef=args.clip_coef,
        clip_vloss=args.clip_vloss,
        norm_adv=args.norm_adv and args.norm_adv_scope == "minibatch",
        ent_coef=args.ent_coef,
        vf_coef=args.vf_coef,
    )
    plain = PlainUpdate(agent, optimizer, loss_function, args.max_grad_norm)
    if not args.compile:
        return plain
    compiler = os.environ.get("CXX", "g++")
    if shutil.which(compiler) is None:
        print(f"--compile: no C++ compiler ({compiler}) here, goes on without", file=sys.stderr)
        return plain
    try:
        return CompiledUpdate(agent, optimizer, loss_function, args.max_grad_norm, args.minibatch_size)
    except Exception as error:  # whatever the compiler's tool chain lacks, the plain step needs none of it
        print(f"--compile: failed ({first_line(error)}), goes on without", file=sys.stderr)
        return plain


def restorable(optimizer: FlatAdam, scope: str) -> list[torch.Tensor]:
    """The tensors that KLE-Rollback restores (`--rollback`), as views."""
    policy = optimizer.policy
    return {
        "policy": [optimizer.vector[policy]],
        "policy-value": [optimizer.vector],
        "policy-moments": [optimizer.vector[policy], optimizer.mean[policy], optimizer.square[policy]],
    }[scope]


def update_policy(agent: Agent, optimizer: FlatAdam, update, batch: Batch, args: Args) -> dict[str, float]:
    """Algorithm 4.1, lines 4 to 15: up to K update iterations, ended early by the KL divergence.

    Returns the metrics of the update; `charts/update_iterations` counts from 1, a rolled-back iteration included.
    """
    old_logstd = agent.actor_logstd.detach().clone()  # line 4
    rows = batch.pack()
    tensors = restorable(optimizer, args.rollback)
    early_stopping = args.kle_stop or args.kle_rollback
    rolled_back = False
    for k in range(1, args.update_epochs + 1):  # line 5
        before = [tensor.clone() for tensor in tensors] if args.kle_rollback else []
        measured = early_stopping or k == args.update_epochs
        *others, last = rows[torch.randperm(len(rows)).to(rows.device)].split(args.minibatch_size)
        samples = batch if args.kl_samples == "batch" else Batch.unpack(last, len(old_logstd))
        for minibatch in others:  # line 6
            update(minibatch)  # line 7
        if measured and args.kl_timing == "before-last-step":
            kl = kl_estimates(agent, samples, old_logstd)[args.kl_estimator].item()
        pg_loss, v_loss, clipfrac = update(last)
        if measured and args.kl_timing == "after-iteration":
            kl = kl_estimates(agent, samples, old_logstd)[args.kl_estimator].item()  # line 9
        if early_stopping and kl > args.d_target:  # line 10
            if args.kle_rollback:  # line 12
                for tensor, value in zip(tensors, before):
                    tensor.copy_(value)
                rolled_back = True
            break  # lines 11 and 12

    moved = kl_estimates(agent, batch, old_logstd)
    return {
        "charts/update_iterations": k,
        "charts/rolled_back": int(rolled_back),
        "losses/policy_loss": pg_loss.item(),
        "losses/value_loss": v_loss.item(),
        "losses/entropy": gaussian_entropy(agent.actor_logstd).item(),
        "losses/clipfrac": clipfrac.item(),
        "losses/approx_kl": kl,
        "losses/kl_k1": moved["k1"].item(),
        "losses/kl_k3": moved["k3"].item(),
        "losses/kl_exact_old_new": moved["exact-old-new"].item(),
        "losses/kl_exact_new_old": moved["exact-new-old"].item(),
        "losses/explained_variance": (1 - (batch.returns - batch.values).var() / batch.returns.var()).item(),
    }


# ---------------------------------------------------------------------------------------------------------------------
# The run's folder and its checkpoints
# ---------------------------------------------------------------------------------------------------------------------
CHECKPOINT_FORMAT = "ppo_continuous_kle 1"
SCRIPT_SHA256 = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()  # now, for the file may change while it runs
FINISH = ("eval_episodes", "eval_mode", "capture_video", "save_model", "save_demos")
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
MAX_EVALUATION_STEPS = 100_000  # of an episode, where the environment has no time limit


def play(agent: Agent, env: gym.Env, args: Args, seed: int) -> dict[str, np.ndarray]:
    """One episode with frozen statistics: raw observations (T + 1, ...), actions (T, ...), rewards (T,), how it ended."""
    policy, std = numpy_policy(agent), agent.actor_logstd.detach().exp().cpu().numpy()
    mean, divisor = agent.obs_mean.cpu().numpy(), agent.obs_divisor.cpu().numpy()
    low, high = np.ravel(env.action_space.low), np.ravel(env.action_space.high)
    rng = np.random.default_rng([seed, 1])  # [seed] alone would be the environment's own stream
    obs, _ = env.reset(seed=seed)
    observations, actions, rewards = [np.array(obs)], [], []
    terminated = truncated = False
    while not (terminated or truncated):
        x = np.ravel(obs)
        if args.norm_obs:
            x = bounded((x - mean) / divisor, -args.clip_obs, args.clip_obs)
        action = policy(x[None].astype(np.float32))[0]
        if args.eval_mode == "sampled":
            action = action + std * rng.standard_normal(len(std), np.float32)
        action = bounded(action, low, high).reshape(env.action_space.shape)
        actions.append(action.copy())
        obs, reward, terminated, truncated, _ = env.step(action)
        observations.append(np.array(obs))  # some environments give the same array in every step
        rewards.append(reward)
        truncated = truncated or len(rewards) == MAX_EVALUATION_STEPS
    return {
        "observations": np.array(observations),
        "actions": np.array(actions),
        "rewards": np.array(rewards, np.float64),
        "terminated": np.array(terminated),
        "truncated": np.array(truncated),
        "seed": np.array(seed),
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


def evaluate(agent: Agent, args: Args, run_dir: Path) -> dict:
    """Play `--eval-episodes` episodes that training never saw; write `evaluation.json` and, if asked, a video."""
    env = make_env(args.env_id, "rgb_array" if args.capture_video else None)
    if args.capture_video:
        env = gym.wrappers.RecordVideo(env, str(run_dir / "videos"), lambda episode: episode == 0)
    seeds = [episode_seed(args.seed, EVALUATION_STREAM, i) for i in range(args.eval_episodes)]
    returns = [float(play(agent, env, args, seed)["rewards"].sum()) for seed in seeds]
    env.close()
    evaluation = {"env_id": args.env_id, "mode": args.eval_mode, **summary(returns), "returns": returns, "seeds": seeds}
    write_json(run_dir / "evaluation.json", evaluation)
    return evaluation


def summary(returns: list[float] | np.ndarray) -> dict[str, float | None]:
    """Number, mean, standard deviation, minimum and maximum of episode returns; None where there are none."""
    functions = {"mean": np.mean, "std": np.std, "min": np.min, "max": np.max}
    numbers = {name: float(function(returns)) if len(returns) else None for name, function in functions.items()}
    return {"episodes": len(returns), **numbers}


def save_demonstrations(agent: Agent, args: Args, run_dir: Path) -> None:
    """Write `--save-demos` episodes as `demos/episode_*.npz`, and a manifest with their checksums.

    Each file has observations (T + 1, ...), actions (T, ...), rewards (T,), terminated, truncated, seed, and t_ns (T,),
    the time of each action in nanoseconds, simulated where the environment says how long a step is.
    """
    folder = run_dir / "demos"
    folder.mkdir(exist_ok=True)
    env = make_env(args.env_id)
    step_ns = round(1e9 * getattr(env.unwrapped, "dt", 1 / env.metadata.get("render_fps", 1)))
    manifest = {"version": 1, "env_id": args.env_id, "player": args.exp_name, "mode": args.eval_mode, "files": {}}
    for i in range(args.save_demos):
        episode = play(agent, env, args, episode_seed(args.seed, DEMONSTRATION_STREAM, i))
        content = io.BytesIO()
        np.savez(content, **episode, t_ns=np.arange(len(episode["rewards"]), dtype=np.int64) * step_ns)
        write_whole(folder / f"episode_{i:05d}.npz", content.getvalue())
        manifest["files"][f"episode_{i:05d}.npz"] = hashlib.sha256(content.getvalue()).hexdigest()
    env.close()
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
    axes.plot(steps, returns, ".", markersize=2, alpha=0.3, color="tab:blue", label="episodes in training")
    window = min(50, max(1, len(returns)))
    if len(returns):
        means = np.convolve(returns, np.ones(window) / window, "valid")
        axes.plot(steps[window - 1 :], means, color="tab:blue", label=f"mean of {window} episodes")
    level = evaluation["mean"]
    label = f"evaluation ({args.eval_mode}, {args.eval_episodes} episodes): {level:,.1f}"
    axes.axhline(level, color="tab:orange", linestyle="--", label=label)
    mode = "KLE-Stop" if args.kle_stop else "KLE-Rollback" if args.kle_rollback else "PPO"
    threshold = f", $d_{{target}}$ = {args.d_target}" if args.kle_stop or args.kle_rollback else ""
    axes.set_title(f"{args.env_id}, {mode}, K = {args.update_epochs}{threshold}, seed {args.seed}")
    axes.set_xlabel("environment steps")
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
    envs = [make_env(args.env_id) for _ in range(args.num_envs)]
    if args.capture_video:
        check_video(args.env_id)
    run_dir, checkpoint = open_run_dir(args)
    last_iteration = min(args.num_iterations, math.ceil(args.stop_at / args.batch_size))
    if is_done(run_dir, args, last_iteration * args.batch_size):
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

    collector = Collector(envs, args)
    agent = Agent(collector.obs_dim, collector.action_dim, args.activation, args.ortho_init, args.init_gains).to(device)
    optimizer = FlatAdam(agent, args.learning_rate, args.value_learning_rate)
    iteration, training_seconds, offsets = 0, 0.0, {"episodes": 0, "updates": 0}
    if checkpoint is None:
        collector.start()
    else:
        iteration, training_seconds = checkpoint["iteration"], checkpoint["training_seconds"]
        offsets = checkpoint["offsets"]
        agent.load_state_dict(checkpoint["agent"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        torch.set_rng_state(checkpoint["torch_rng"])
        if not collector.load_state_dict(checkpoint["collector"]):
            print("--resume: the replayed episode differs (another machine?), goes on with it", file=sys.stderr)
    update = make_update(agent, optimizer, args)
    arithmetic = f"{type(update).__name__} on {device.type}"
    if checkpoint and checkpoint["arithmetic"] != arithmetic:
        print(f"--resume: was {checkpoint['arithmetic']}, goes on as {arithmetic}: bytes will differ", file=sys.stderr)
    global_step = iteration * args.batch_size
    episodes_csv = CsvLog(run_dir / "episodes.csv", offsets["episodes"])
    updates_csv = CsvLog(run_dir / "updates.csv", offsets["updates"])
    forget_end(run_dir, iteration < last_iteration)
    writer = SummaryWriter(str(run_dir), purge_step=global_step + 1)
    progress = tqdm(total=last_iteration * args.batch_size, initial=global_step, unit="step", disable=None)
    last_time = time.perf_counter()

    while iteration < last_iteration:  # Algorithm 4.1, line 1
        iteration += 1
        remaining = 1.0 - (iteration - 1) / args.num_iterations if args.anneal_lr else 1.0
        optimizer.anneal(remaining)

        rollout = collector.collect(agent)  # lines 2 and 3
        batch = make_batch(agent, rollout, args, device)
        metrics = update_policy(agent, optimizer, update, batch, args)  # lines 4 to 15
        metrics = {"charts/learning_rate": remaining * args.learning_rate, **metrics}
        collector.update_agent_statistics(agent)

        for step, episodic_return, length in rollout.episodes:
            row = {"global_step": global_step + step, "episodic_return": episodic_return, "episodic_length": length}
            episodes_csv.write(row)
            charts = {"charts/episodic_return": episodic_return, "charts/episodic_length": length}
            add_scalars(writer, charts, global_step + step)
            progress.set_postfix_str(f"return {episodic_return:.1f}", refresh=False)
        global_step += args.batch_size
        progress.update(args.batch_size)
        now = time.perf_counter()
        training_seconds, last_time = training_seconds + now - last_time, now
        updates_csv.write({"global_step": global_step, **metrics})
        add_scalars(writer, {**metrics, "charts/SPS": global_step / training_seconds}, global_step)
        if not optimizer.vector.isfinite().all():
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
                "optimizer": optimizer.state_dict(),
                "torch_rng": torch.get_rng_state(),
                "collector": collector.state_dict(),
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
        save_demonstrations(agent, args, run_dir)
    plot_learning_curve(run_dir, args, evaluation)
    versions = {module.__name__: module.__version__ for module in (gym, mujoco, np, torch)}
    result = {
        "env_id": args.env_id,
        "seed": args.seed,
        "global_step": global_step,
        "complete": global_step == args.num_iterations * args.batch_size,
        "finish": {name: arguments(args)[name] for name in FINISH},
        "training": {"mode": "sampled", **summary(read_episodes(run_dir)[-50:, 1])},
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
