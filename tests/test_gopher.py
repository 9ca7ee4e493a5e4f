"""Gopher: the game beside Gymnasium's wrappers, the replay buffer beside a list, runs of the DQN and of its students."""

import csv
import fcntl
import functools
import importlib
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import ale_py
import cv2
import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch
import torch
from conftest import ROOT, assert_refused, command, edit_manifest, kill_twice, modified, rewrite, run
from gymnasium.utils.env_checker import check_env
from gymnasium.wrappers import AtariPreprocessing, FrameStackObservation
from scipy import stats

from cleanrl_thesis import distill_hybrid as distill
from cleanrl_thesis import dqn_gopher as dqn

SCRIPT = ROOT / "cleanrl_thesis" / "dqn_gopher.py"
RAM = ["--obs-type", "ram", "--hidden-size", 32, "--eval-episodes", 2, "--eval-epsilon", 0.5]
SMALL = [
    *(*RAM, "--total-timesteps", 20_000, "--num-envs", 4, "--buffer-size", 1_000, "--learning-starts", 4_000),
    *("--checkpoint-interval", 4_000),
]
RECORDS = ("episodes.csv", "updates.csv", "evaluation.json")


# The game
def gymnasiums(env_id: str, obs_type: str) -> gym.Env:
    gym.register_envs(ale_py)
    if obs_type == "ram":
        return FrameStackObservation(gym.make(env_id, obs_type="ram"), 4)
    return FrameStackObservation(AtariPreprocessing(gym.make(env_id, frameskip=1)), 4)


@pytest.mark.parametrize(
    "env_id, obs_type, frames",
    [("ALE/Gopher-v5", "pixels", 1_000), ("ALE/Breakout-v5", "pixels", 300), ("ALE/Gopher-v5", "ram", 1_000)],
)
def test_frames_are_gymnasiums(env_id, obs_type, frames):
    """Over episodes with and without seeds, whose actions the emulator repeats by chance."""
    theirs = gymnasiums(env_id, obs_type)
    ours = dqn.make_atari(env_id, obs_type=obs_type, noop_max=30 if obs_type == "pixels" else 0)
    rng, seeds = np.random.default_rng(0), iter([5, 6, None, None, None, None])
    assert ours.observation_space == theirs.observation_space and ours.action_space == theirs.action_space
    ended = True
    for _ in range(frames):
        if ended:
            seed = next(seeds)
            (expected, _), (obs, _) = theirs.reset(seed=seed), ours.reset(seed=seed)
            assert np.array_equal(obs, expected)
        action = int(rng.integers(ours.action_space.n))
        expected, obs = theirs.step(action), ours.step(action)
        assert np.array_equal(obs[0], expected[0])
        assert obs[1:4] == expected[1:4] and obs[4]["lives"] == expected[4]["lives"]
        ended = obs[2]


def test_gymnasium_finds_no_fault():
    check_env(dqn.make_atari("ALE/Gopher-v5"), skip_render_check=True)


def test_an_episode_of_thirty_minutes_is_a_time_out():
    game = dqn.make_atari("ALE/Pong-v5", obs_type="ram", frame_skip=1, noop_max=0)
    game.emulator.setInt("max_num_frames_per_episode", 50)
    game.reset(seed=0)
    steps = [game.step(0) for _ in range(50)]
    assert [step[3] for step in steps] == [False] * 49 + [True] and not any(step[2] for step in steps)


# The replay buffer
FRAMES, GAMES, STACK = 40, 3, 4


def filled(tmp_path: Path, rows: int, spare: int, seed: int = 0) -> tuple[dqn.ReplayBuffer, list]:
    """A ring through which each game's numbered frames have gone, and for each transition what it should be."""
    buffer = dqn.ReplayBuffer(tmp_path / "replay.dat", rows, spare, GAMES, (STACK, 2))
    rng, history, expected = np.random.default_rng(seed), [[] for _ in range(GAMES)], []
    ages, before = np.zeros(GAMES, int), [dqn.GOES_ON] * GAMES
    for row in range(FRAMES):
        for game in range(GAMES):
            frame = np.array([row, game], np.uint8)
            history[game] = [*history[game], frame] if ages[game] else [frame]
            follows = rng.choice([dqn.GOES_ON, dqn.ENDS], p=[0.8, 0.2])
            if rng.random() < {dqn.ENDS: 0.5, dqn.GOES_ON: 0.1, dqn.NOT_PLAYED: 0}[before[game]]:
                follows = dqn.NOT_PLAYED  # else ENDS was the loss of a life; behind GOES_ON it is a time-out
            buffer.add(game, frame, ages[game], row % 5, float(row), follows)
            padded = [history[game][0]] * STACK + history[game]
            expected.append((row, game, np.array(padded[-STACK:]), follows))
            ages[game] = 0 if follows == dqn.NOT_PLAYED else ages[game] + 1
        before = [each[3] for each in expected[-GAMES:]]
        buffer.next_row()
    return buffer, expected


@pytest.mark.parametrize("n_step", [1, 3])
@pytest.mark.parametrize("rows, spare", [(100, 10), (20, 5)], ids=["all", "the newest"])
def test_what_is_drawn_is_what_was_seen(rows, spare, n_step, tmp_path):
    buffer, expected = filled(tmp_path, rows, spare)
    by_frame = {(row, game): (obs, follows) for row, game, obs, follows in expected}
    minibatch = buffer.sample(4_000, 0.9, n_step, np.random.default_rng(1))
    seen = set()
    for obs, action, reward, discount, next_obs in zip(*map(torch.Tensor.tolist, minibatch)):
        row, game = obs[-1]
        wanted, follows = by_frame[row, game]
        assert obs == wanted.tolist() and follows != dqn.NOT_PLAYED
        total, weight, end = 0.0, 1.0, row
        for _ in range(n_step):
            follows = by_frame[end, game][1]
            if follows == dqn.NOT_PLAYED:  # a time-out: the value of its last frame
                break
            total, weight, end = total + weight * end, (0.9 * weight if follows == dqn.GOES_ON else 0), end + 1
            if follows == dqn.ENDS:
                break
        assert action == row % 5 and (reward, discount) == pytest.approx((total, weight), rel=1e-5)
        assert next_obs == by_frame[end, game][0].tolist()
        seen.add((row, game))
    first = 0 if rows > FRAMES else FRAMES - rows + STACK - 1
    played = {key for key, (_, follows) in by_frame.items() if follows != dqn.NOT_PLAYED}
    assert seen == {(row, game) for row, game in played if first <= row < FRAMES - n_step}


def test_a_million_frames_take_eight_gigabytes():
    """Each frame is there once, with seven bytes beside it, and room for two checkpoints: what the docstring states."""
    fields, args = dqn.row_type((84, 84)), dqn.complete_args(dqn.Args())
    assert fields.itemsize == 84 * 84 + 7 == 7_063
    between = args.checkpoint_interval // args.frame_skip + args.num_envs
    assert round((args.buffer_size + 2 * between) * fields.itemsize / 1e9, 1) == 7.8


def test_the_file_of_a_run_is_as_large_as_stated(small):
    rows, spare = 1_000 // 4, 2 * (4_000 // 16 + 1)
    assert (small / "replay.dat").stat().st_size == (rows + spare) * 4 * (128 + 7)


def test_the_file_is_made_where_the_system_cannot_reserve_it(tmp_path, monkeypatch):
    """The C library's way to do without takes no file that is open for appending."""
    opened = []
    monkeypatch.setattr(
        os, "posix_fallocate", lambda file, begin, size: opened.append(fcntl.fcntl(file, fcntl.F_GETFL))
    )
    dqn.ReplayBuffer(tmp_path / "replay.dat", 10, 2, 3, (4, 5))
    assert opened and not opened[0] & os.O_APPEND


# Playing
class ScriptedGame:
    """Has a reward, lives, and whether it has ended or run out of time, for each step of an episode; shows its number."""

    def __init__(self, episodes: list[list[tuple[float, int, bool, bool]]]):
        self.episodes, self.stack = iter(episodes), np.zeros((2, 1), np.uint8)
        self.shown = 0

    def look(self) -> np.ndarray:
        self.stack[:-1] = self.stack[1:]
        self.stack[-1] = self.shown
        self.shown += 1
        return self.stack.copy()

    def reset(self, seed: int) -> tuple[np.ndarray, dict]:
        self.steps, self.lives = iter(next(self.episodes)), 3
        return self.look(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict]:
        reward, self.lives, terminated, truncated = next(self.steps)
        return self.look(), reward, terminated, truncated, {}


@pytest.mark.parametrize("signs, life_ends", [(True, False), (False, True)])
def test_what_players_put_into_the_buffer(signs, life_ends, tmp_path):
    """Signs or points; an end, a lost life where asked for, and a time-out, behind which a value is left."""
    script = [[(20.0, 3, False, False), (100.0, 2, False, False), (-5.0, 2, True, False)], [(0.0, 3, False, True)], []]
    args = dqn.Args(clip_rewards=signs, life_loss_ends=life_ends)
    players = dqn.Players([ScriptedGame(script)], args)
    players.start(0, 0)
    buffer = dqn.ReplayBuffer(tmp_path / "replay.dat", 10, 2, 1, (2, 1))
    ended = [players.step(np.array([action]), buffer) for action in (4, 5, 6, 7, 1, 2)]
    assert ended == [[], [], [(115.0, 12)], [], [(0.0, 4)], []]
    rows = buffer.map[: buffer.added]
    assert rows["frame"].ravel().tolist() == [0, 1, 2, 3, 4, 5]  # the last ones of episodes too
    assert rows["reward"].tolist() == ([1, 1, -1, 0, 0, 0] if signs else [20, 100, -5, 0, 0, 0])
    goes_on, ends, not_played = dqn.GOES_ON, dqn.ENDS, dqn.NOT_PLAYED
    lost = ends if life_ends else goes_on
    assert rows["follows"].tolist() == [goes_on, lost, ends, not_played, goes_on, not_played]
    assert rows["age"].tolist() == [0, 1, 2, 3, 0, 1]
    played = [0, 1, 2, 4]
    assert rows["action"][played].tolist() == [4, 5, 6, 1]


# The network
@pytest.mark.parametrize("shape", [(4, 84, 84), (4, 128)])
@pytest.mark.parametrize("dueling", [True, False])
def test_bfloat16_gives_nearly_the_same_values(shape, dueling):
    torch.manual_seed(1)
    network = dqn.AtariQNetwork(shape, 8, 64, dueling)
    obs = torch.randint(0, 256, (16, *shape), dtype=torch.uint8)
    values = network(obs)
    network.bf16 = True
    assert values.shape == (16, 8)
    assert torch.allclose(network(obs), values, atol=0.01 * values.abs().max().item() + 0.005)


def test_the_first_layer_sees_the_brightness_between_0_and_1():
    network = dqn.AtariQNetwork((4, 84, 84), 8, 64, False)
    obs = torch.randint(0, 256, (2, 4, 84, 84), dtype=torch.uint8)
    x = obs / 255
    for layer in network.trunk:
        x = torch.relu(layer(x))
    assert torch.allclose(network.features(obs), x.flatten(1), atol=1e-5)


@pytest.mark.parametrize("double", [True, False])
def test_an_update_is_adams_on_the_huber_loss(double):
    torch.manual_seed(2)
    args = dqn.Args(obs_type="ram", double=double)
    learner = dqn.Learner(lambda: dqn.AtariQNetwork((1, 128), 3, 8, True), args, torch.device("cpu"))
    with torch.no_grad():
        for parameter in learner.target_network.parameters():
            parameter.add_(0.1 * torch.randn_like(parameter))
    obs, next_obs = (torch.randint(0, 256, (5, 1, 128), dtype=torch.uint8) for _ in range(2))
    minibatch = dqn.Minibatch(obs, torch.tensor([0, 1, 2, 0, 1]), torch.randn(5), 0.9 * torch.ones(5), next_obs)
    q, choice = learner.agent(obs), (learner.agent if double else learner.target_network)(next_obs).argmax(1)
    target = minibatch.returns + 0.9 * learner.target_network(next_obs)[range(5), choice].detach()
    error = q[range(5), minibatch.actions] - target
    loss = torch.where(error.abs() < 1, 0.5 * error**2, error.abs() - 0.5).mean()
    gradients = torch.autograd.grad(loss, list(learner.agent.parameters()))
    before = [parameter.detach().clone() for parameter in learner.agent.parameters()]
    learner.update(minibatch, 1e-3)
    for parameter, old, gradient in zip(learner.agent.parameters(), before, gradients):
        assert torch.allclose(parameter, old - 1e-3 * gradient / (gradient.abs() + 1e-8), atol=1e-6)


@pytest.mark.parametrize("bound", [1e-3, math.inf])
def test_the_norm_of_all_gradients_together_is_bounded(bound):
    torch.manual_seed(2)
    args = dqn.Args(obs_type="ram", max_grad_norm=bound)
    learner = dqn.Learner(lambda: dqn.AtariQNetwork((1, 128), 3, 8, True), args, torch.device("cpu"))
    obs = torch.randint(0, 256, (5, 1, 128), dtype=torch.uint8)
    learner.update(dqn.Minibatch(obs, torch.tensor([0, 1, 2, 0, 1]), torch.full((5,), 5.0), torch.zeros(5), obs), 1e-3)
    norm = torch.cat([parameter.grad.flatten() for parameter in learner.agent.parameters()]).norm().item()
    assert norm == pytest.approx(1e-3, rel=0.01) if bound < 1 else norm > 0.1


def test_the_dueling_heads_are_a_value_and_advantages_without_mean():
    torch.manual_seed(2)
    network = dqn.AtariQNetwork((1, 128), 3, 8, True)
    obs = torch.randint(0, 256, (5, 1, 128), dtype=torch.uint8)
    with torch.no_grad():
        hidden = torch.relu(network.hidden(network.features(obs)))
        q, value, advantage = network(obs), network.value(hidden[:, :4]), network.advantage(hidden[:, 4:])
    assert torch.allclose(q.mean(1, keepdim=True), value, atol=1e-6)
    assert torch.allclose(q - value, advantage - advantage.mean(1, keepdim=True), atol=1e-6)


def test_rewards_of_each_life():
    lives, rewards = np.array([3, 3, 2, 2, 2, 1, 1, 0]), np.array([20, 0, 0, 100, 20, 20, 0, 0])
    assert dqn.rewards_per_life({"lives": lives, "rewards": rewards}) == [1, 3, 0]
    assert dqn.rewards_per_life({"lives": lives[:4], "rewards": rewards[:4]}) == [1, 1]  # a time-out within a life


# Runs
@pytest.fixture(scope="session")
def small(tmp_path_factory) -> Path:
    """An undisturbed small run."""
    folder = tmp_path_factory.mktemp("gopher")
    run(*SMALL, "--run-dir", "run", "--save-model", "--save-demos", 2, cwd=folder, script=SCRIPT)
    return folder / "run"


def assert_same_run(left: Path, right: Path) -> None:
    for name in RECORDS:
        assert (left / name).read_bytes() == (right / name).read_bytes(), name
    states = [torch.load(folder / "checkpoint.pt", weights_only=True)["learner"] for folder in (left, right)]
    for part in ("agent", "target_network"):
        for name, value in states[0][part].items():
            assert torch.equal(value, states[1][part][name]), name
    moments = [list(state["optimizer"]["state"].values()) for state in states]
    assert moments[0]
    for mine, other in zip(*moments, strict=True):
        assert all(torch.equal(value, other[name]) for name, value in mine.items())


def kill(flags: list, folder: Path, number: int) -> None:
    """Start or resume a run and send it a signal soon after its next checkpoint."""
    path, line = folder / "checkpoint.pt", command(*flags, "--run-dir", folder, "--resume", script=SCRIPT)
    before = modified(path)
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while process.poll() is None and modified(path) in (0, before):
        time.sleep(0.002)
    time.sleep(0.1)  # rows and frames that the checkpoint does not count
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number), out


def test_a_killed_run_ends_with_the_same_bytes(small, tmp_path):
    """Killed within the episodes of four games, each time it has gone on: they are played again from their seeds."""
    for number in (signal.SIGKILL, signal.SIGKILL, signal.SIGTERM):
        kill(SMALL, tmp_path / "run", number)
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert "differs" not in done.stderr
    assert_same_run(small, tmp_path / "run")


def test_a_torn_checkpoint_goes_on_from_the_one_before(small, tmp_path):
    """By then the ring has gone round: what that checkpoint counts has to be there still."""
    flags = [*SMALL, "--run-dir", "run", "--resume"]
    run(*flags, "--stop-at", 16_000, cwd=tmp_path, script=SCRIPT)
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    assert "torn" in run(*flags, cwd=tmp_path, script=SCRIPT).stderr
    assert_same_run(small, tmp_path / "run")


def test_schedules_of_a_run(tmp_path, monkeypatch):
    """ε falls to --end-e over its share of the frames, the learning rate to 0 over all, and Adam gets it."""
    rates, step = [], torch.optim.Adam.step
    monkeypatch.setattr(torch.optim.Adam, "step", lambda adam: rates.append(adam.param_groups[0]["lr"]) or step(adam))
    flags = [
        *RAM,
        "--total-timesteps",
        40_000,
        "--learning-starts",
        32_000,
        "--anneal-lr",
        "--exploration-fraction",
        0.5,
        "--no-double",
    ]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    updates = np.genfromtxt(tmp_path / "run" / "updates.csv", delimiter=",", names=True, deletechars="")
    frames = updates["global_step"] - 32  # of the step before, which was taken with them
    assert np.allclose(updates["charts/epsilon"], np.maximum(1 - 0.99 * frames / 20_000, 0.01))
    assert np.allclose(updates["charts/learning_rate"], 1e-4 * (1 - frames / 40_000))
    assert np.allclose(rates, np.repeat(1e-4 * (1 - np.arange(32_000 - 32, 40_000 - 32 + 1, 32) / 40_000), 2))


def test_three_tenths_are_explored_and_no_game_is_played_twice(tmp_path, monkeypatch):
    """Each of four games explores by itself; what it trains on is neither evaluated nor saved as a demonstration."""
    chosen, seeds, step, reset = [], [], dqn.Players.step, dqn.AtariGame.reset

    def note(game, *, seed=None, options=None):
        seeds.append(int(seed))
        return reset(game, seed=seed, options=options)

    monkeypatch.setattr(dqn.AtariGame, "reset", note)
    monkeypatch.setattr(dqn.Players, "step", lambda its, actions, to: chosen.append(actions) or step(its, actions, to))
    monkeypatch.setattr(dqn, "greedy_policy", lambda *its: lambda obs: np.full(len(obs), 5))
    flags = [*SMALL, "--total-timesteps", 8_000, "--learning-starts", 7_999, "--start-e", 0.3, "--end-e", 0.3]
    run(*flags, "--save-demos", 1, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    is_greedy = np.array(chosen) == 5
    assert is_greedy.shape == (500, 4)
    share = 0.7 + 0.3 / 8
    for part, probability in ((is_greedy, share), (is_greedy.all(1), share**4)):
        assert stats.binomtest(int(part.sum()), part.size, probability).pvalue > 0.001
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    assert len(evaluation["seeds"]) == 2 and seeds[-3:-1] == evaluation["seeds"]
    assert len(seeds) >= 4 + 3 and len(set(seeds)) == len(seeds)


def test_a_run_on_pixels_stops_and_goes_on(tmp_path):
    flags = ["--total-timesteps", 3_200, "--buffer-size", 500, "--learning-starts", 1_600, "--checkpoint-interval", 800]
    flags += [
        "--eval-episodes",
        1,
        "--eval-epsilon",
        1,
        "--bf16",
        "--noop-max",
        5,
        "--life-loss-ends",
        "--no-clip-rewards",
    ]
    run(*flags, "--run-dir", "whole", cwd=tmp_path, script=SCRIPT)
    run(*flags, "--stop-at", 2_016, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert_same_run(tmp_path / "whole", tmp_path / "run")


def test_updates_and_target_network_come_when_they_should(small, tmp_path):
    """One update per 16 frames from frame 4,000 on; the target network is the network of the last multiple of 4,000."""
    with open(small / "updates.csv", newline="") as file:
        assert sum(int(row["charts/updates"]) for row in csv.DictReader(file)) == (20_000 - 4_000) // 16 + 1
    states = []
    for stop_at in (8_000, 9_000):
        run(*SMALL, "--stop-at", stop_at, "--run-dir", "run", "--resume", cwd=tmp_path, script=SCRIPT)
        states.append(torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["learner"])
    for name, value in states[1]["target_network"].items():
        assert torch.equal(value, states[0]["agent"][name])
    assert not torch.equal(states[1]["agent"]["hidden.weight"], states[0]["agent"]["hidden.weight"])


def test_demonstrations_can_be_played_again(small):
    """From the seed, and from the emulator's state."""
    manifest = json.loads((small / "demos" / "manifest.json").read_text())
    assert manifest["env_id"] == "ALE/Gopher-v5" and len(manifest["files"]) == 2
    for path in sorted((small / "demos").glob("*.npz")):
        with np.load(path, allow_pickle=False) as arrays:
            demo = dict(arrays)
        assert demo["t_ns"][15] == pytest.approx(1e9, abs=100)
        game = dqn.make_atari(manifest["env_id"], **manifest["options"])
        game.reset(seed=int(demo["seed"]))
        seeded = [game.step(int(action)) for action in demo["actions"]]
        game = dqn.make_atari(manifest["env_id"], **manifest["options"])
        game.reset(seed=0)
        state = ale_py.ALEState.__new__(ale_py.ALEState)
        state.__setstate__(demo["emulator_state"].tobytes())
        game.emulator.restoreState(state)
        restored = [game.step(int(action)) for action in demo["actions"]]
        for steps in (seeded, restored):
            assert np.array_equal([step[1] for step in steps], demo["rewards"])
            assert np.array_equal([step[4]["lives"] for step in steps], demo["lives"])
            assert steps[-1][2] == demo["terminated"]


def test_the_model_plays_as_it_was_evaluated(small):
    args = json.loads((small / "args.json").read_text())
    network = dqn.AtariQNetwork((4, 128), 8, args["hidden_size"], args["dueling"], args["bf16"])
    network.load_state_dict(safetensors.torch.load_file(small / "model.safetensors"))
    evaluation = json.loads((small / "evaluation.json").read_text())
    policy = dqn.epsilon_greedy_policy(dqn.greedy_policy(network, torch.device("cpu")), 8, 0.5, seed=1)
    episodes = dqn.play_atari(policy, lambda: dqn.make_atari("ALE/Gopher-v5", obs_type="ram"), evaluation["seeds"])
    assert [episode["rewards"].sum() for episode in episodes] == evaluation["returns"]


def test_runs_leave_what_the_readme_says(small):
    names = {path.name for path in small.iterdir() if "tfevents" not in path.name}
    shared = {"args.json", "checkpoint.pt", "checkpoint.previous.pt", "evaluation.json", "learning_curve.png"}
    assert names == {*shared, "model.safetensors", "result.json", "updates.csv", "demos", "episodes.csv", "replay.dat"}


def test_copied_alone_into_an_empty_folder(small, tmp_path):
    shutil.copy(SCRIPT, tmp_path)
    run(*SMALL, "--run-dir", "run", cwd=tmp_path, script=tmp_path / SCRIPT.name, PYTHONSAFEPATH="1")
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small / "updates.csv").read_bytes()


def test_a_video_is_the_first_evaluation_episode(tmp_path):
    """As long as that episode, a picture of each of its steps and of its beginning."""
    flags = [
        *RAM,
        "--total-timesteps",
        3_200,
        "--learning-starts",
        1_600,
        "--noop-max",
        0,
        "--capture-video",
        "--run-dir",
        "run",
    ]
    run(*flags, cwd=tmp_path, script=SCRIPT)
    (path,) = (tmp_path / "run" / "videos").glob("*.mp4")
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    video, pictures = cv2.VideoCapture(str(path)), 0
    while video.read()[0]:
        pictures += 1
    network, args = dqn.AtariQNetwork((4, 128), 8, 32, True), dqn.Args(obs_type="ram", noop_max=0, eval_epsilon=0.5)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    network.load_state_dict(state["learner"]["agent"])
    make_game = functools.partial(dqn.make_atari, "ALE/Gopher-v5", **dqn.game_options(args))
    policy = dqn.evaluation_policy(network, args, torch.device("cpu"))
    first = dqn.play_atari(policy, make_game, evaluation["seeds"])[0]
    assert pictures - len(first["actions"]) in (0, 1)  # the writer may leave out the last


def test_a_lost_replay_buffer_is_not_taken_for_an_empty_one(tmp_path):
    run(*SMALL, "--stop-at", 8_000, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    (tmp_path / "run" / "replay.dat").unlink()
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path, script=SCRIPT, code=1)
    assert "replay.dat" in done.stderr and done.stderr.count("\n") == 1


def test_a_folder_that_cannot_be_is_named_and_not_its_disk(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert_refused(dqn, capsys, ["--run-dir", "x" * 300], ["--run-dir", "cannot be used"])


def test_a_resume_may_take_other_threads(tmp_path):
    """For the last few updates, because threads that wait for one another spin, and tests have others beside them."""
    run(*SMALL, "--stop-at", 19_200, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    done = run(*SMALL, "--num-threads", 2, "--run-dir", "run", "--resume", cwd=tmp_path, script=SCRIPT)
    was = "--resume: was float32 on cpu, 1 thread, goes on as float32 on cpu, 2 threads: bytes may differ"
    assert was in done.stderr
    assert json.loads((tmp_path / "run" / "result.json").read_text())["arithmetic"] == "float32 on cpu, 2 threads"


def test_a_resume_with_other_hyperparameters_names_them(small, tmp_path, capsys):
    shutil.copytree(small, tmp_path / "run")
    flags = [*SMALL, "--gamma", 0.9, "--run-dir", tmp_path / "run", "--resume"]
    assert_refused(dqn, capsys, flags, ["--gamma 0.9", "was 0.99"])


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_runs_killed_at_random_end_with_the_same_bytes(small, tmp_path):
    for seed in range(6):
        flags = [*SMALL, "--run-dir", tmp_path / f"run{seed}"]
        kill_twice(flags, 12, seed, SCRIPT, after_checkpoints=True)
        run(*flags, "--resume", cwd=tmp_path, script=SCRIPT)
        assert_same_run(small, tmp_path / f"run{seed}")


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_it_learns_from_the_memory(tmp_path):
    """Random play gets 335 points; 2,500,000 frames bring five times as many (benchmark/gopher_ram.sh)."""
    flags = ["--obs-type", "ram", "--n-step", 3, "--life-loss-ends", "--anneal-lr", "--total-timesteps", 1_000_000]
    run(*flags, "--eval-episodes", 30, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["mean"] > 750


# The synthetic human, and students
DISTILL = ROOT / "cleanrl_thesis" / "distill_hybrid.py"
SMALL_DISTILL = [
    *("--env-id", "ALE/Gopher-v5", "--demo-frames", 600, "--test-frames", 100, "--epochs", 4, "--hidden-size", 32),
    *("--eval-episodes", 1, "--checkpoint-interval", 1),
]


def test_learning_from_the_first_frame(tmp_path):
    """There is no minibatch before the ring has a stack of frames and n steps."""
    flags = [*RAM, "--total-timesteps", 1_600, "--learning-starts", 0, "--n-step", 9, "--train-frequency", 4]
    run(*flags, "--num-envs", 2, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    with open(tmp_path / "run" / "updates.csv", newline="") as file:
        updates = sum(int(row["charts/updates"]) for row in csv.DictReader(file))
    assert 2 * (200 - 11) <= updates < 2 * 200  # two for each of 200 steps, but the first ten or so


def test_parameters_that_explode_end_the_run(tmp_path):
    done = run(*SMALL, "--learning-rate", 1e30, "--run-dir", "run", cwd=tmp_path, code=1, script=SCRIPT)
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


@pytest.fixture(scope="session")
def pixel_teacher(tmp_path_factory) -> Path:
    """A DQN on pixels that has hardly begun to learn."""
    folder = tmp_path_factory.mktemp("gopher")
    flags = ["--total-timesteps", 1_600, "--learning-starts", 800, "--hidden-size", 32, "--noop-max", 30, "--bf16"]
    flags += ["--eval-episodes", 1, "--eval-epsilon", 1, "--save-model", "--run-dir", "run"]
    run(*flags, cwd=folder, script=SCRIPT)
    return folder / "run"


@pytest.fixture(scope="session")
def student(tmp_path_factory, pixel_teacher) -> Path:
    """An undisturbed small run of the hybrid on Gopher."""
    folder = tmp_path_factory.mktemp("distill")
    flags = ["--teacher", pixel_teacher, "--run-dir", "run", "--save-model", "--save-demos", 1, "--bf16"]
    run(*SMALL_DISTILL, *flags, cwd=folder, script=DISTILL)
    return folder / "run"


def test_the_report_takes_whatever_is_done(pixel_teacher, student, tmp_path):
    """Published rows beside measured ones, differences seed by seed, and no claim of what is not there."""
    for name, folder in (("teacher_seed1", pixel_teacher), ("alpha0.8_seed1", student)):
        shutil.copytree(folder, tmp_path / "runs" / name)
    flags = [*SMALL_DISTILL, "--teacher", pixel_teacher, "--bf16", "--epochs", 1, "--alpha", 0]
    run(*flags, "--run-dir", tmp_path / "runs" / "alpha0.0_seed1", cwd=tmp_path, script=DISTILL)
    script = ROOT / "benchmark" / "gopher_report.py"
    run("--runs", "runs", "--out", "out", "--human-episodes", 1, cwd=tmp_path, script=script)
    text = (tmp_path / "out" / "table.md").read_text()
    hybrid, clone = (
        json.loads((tmp_path / "runs" / f"alpha{alpha}_seed1" / "result.json").read_text())["evaluation"]["sampled"]
        for alpha in ("0.8", "0.0")
    )
    assert "| hybrid, α = 0.8 | **published** | 1 | 132 | 0 | 26.05 | 24.31 | 31 | |" in text
    mean = hybrid["rewards_per_life"]["mean"]
    assert f"| hybrid, α = 0.8 | sampled | 1 | {hybrid['rewards_per_life']['max']:.0f} |" in text
    assert f"| {mean:.2f} |" in text and f"| {hybrid['mean']:.0f} |" in text
    assert f"| hybrid, α = 0.8, less BC, α = 0 | +2.1 | {mean - clone['rewards_per_life']['mean']:+.1f} (1) |" in text
    assert "| α = 1, less α = 0.7 |  |  |  |  |  |" in text and "nan" not in text
    shutil.copytree(tmp_path / "runs" / "alpha0.0_seed1", tmp_path / "more" / "alpha0_seed1")
    for name in ("teacher_seed1", "teacher_ram_seed1"):  # no student yet, and a run that is none of the sweep
        shutil.copytree(pixel_teacher, tmp_path / "teachers" / name)
    shutil.copytree(pixel_teacher, tmp_path / "more" / "teacher_seed1")
    for runs, has in (("teachers", False), ("more", True)):
        run("--runs", runs, "--out", runs, "--human-episodes", 1, cwd=tmp_path, script=script)
        assert ("| BC, α = 0 | sampled | 1 |" in (tmp_path / runs / "table.md").read_text()) == has
    for name in ("fig_2_6.png", "teacher.png", "runs.csv"):
        assert (tmp_path / "out" / name).stat().st_size > 100
    for gone in ("alpha0.0_seed1", "teacher_seed1"):
        shutil.rmtree(tmp_path / "runs" / gone)
    flags = ["--runs", "runs", "--human-episodes", 1, "--out", "again", "--known"]
    run(*flags, "out", cwd=tmp_path, script=script)
    for name in ("runs.csv", "table.md"):
        assert (tmp_path / "again" / name).read_text() == (tmp_path / "out" / name).read_text()
    assert (
        "--known nowhere: runs.csv cannot be read" in run(*flags, "nowhere", cwd=tmp_path, script=script, code=2).stderr
    )


def test_the_report_of_runs_from_the_memory(small, tmp_path):
    for seed in (1, 2):
        shutil.copytree(small, tmp_path / "runs" / f"seed{seed}")
    script = ROOT / "benchmark" / "gopher_ram.py"
    run("--runs", "runs", "--out", "out", cwd=tmp_path, script=script)
    score = json.loads((small / "evaluation.json").read_text())["mean"]
    text = (tmp_path / "out" / "ram.md").read_text()
    assert "random play has 335" in text and f"| {score:.0f} ± 0 | {score / 335:.1f} |" in text.splitlines()[-1]
    assert (tmp_path / "out" / "ram.png").read_bytes()[1:4] == b"PNG"
    assert "holds no finished run" in run("--runs", "out", cwd=tmp_path, script=script, code=2).stderr


def test_trends_and_differences_of_scores():
    """Straight lines seed by seed, against SciPy's; a difference from the DQN holds the error of its own score."""
    sys.path.insert(0, str(ROOT / "benchmark"))  # where the scripts find one another
    report = importlib.import_module("gopher_report")
    rng = np.random.default_rng(0)
    curve = {alpha: {seed: 20 + 5 * alpha + rng.normal() for seed in (1, 2, 3)} for alpha in (0.0, 0.2, 0.4, 0.6, 0.7)}
    del curve[0.2][3]
    alphas = [0.0, 0.2, 0.4, 0.6]
    rises = [0.6 * stats.linregress(alphas, [curve[a][seed] for a in alphas]).slope for seed in (1, 2)]
    half = stats.t.ppf(0.975, 1) * stats.sem(rises)
    assert report.trend(curve, 0, 0.6) == f"{np.mean(rises):+.1f} ± {half:.1f} (2)"
    level = report.plateau(curve, 0, 0.6)
    assert level == {seed: pytest.approx(np.mean([curve[a][seed] for a in alphas])) for seed in (1, 2)}
    assert report.plateau(curve, 0.6, 0.7) == {}
    assert report.trend(curve, 0.6, 0.7) == ""  # two points are no line
    first, second = {1: 40.0, 2: 40.0, 3: 40.0}, {2: 25.0, 3: 26.0, 4: 0.0}
    spread = stats.t.ppf(0.975, 1) * stats.sem([15.0, 14.0])
    assert report.less(first, second, 2.0) == f"+14.5 ± {np.hypot(spread, 1.96 * 2):.1f} (2)"
    teacher = [{"kind": "teacher", "mode": "greedy", "unit": report.LIVES, "std": 30.0, "scores": 900}]
    assert report.own_error(teacher) == pytest.approx(1)


def test_the_teacher_s_curve_is_the_moving_mean_of_its_episodes(tmp_path):
    sys.path.insert(0, str(ROOT / "benchmark"))  # where the scripts find one another
    report = importlib.import_module("gopher_report")
    (tmp_path / "episodes.csv").write_text("global_step,episodic_return,episodic_length\n")
    assert report.dqn_curve(tmp_path) == []
    rows = "".join(f"{100 * (i + 1)},{i % 2 * 10},5\n" for i in range(101))
    (tmp_path / "episodes.csv").write_text("global_step,episodic_return,episodic_length\n" + rows)
    curve = report.dqn_curve(tmp_path)
    assert len(curve) == 200 and (curve[0]["frames"], curve[-1]["frames"]) == (5_000, 10_100)
    assert {row["mean_of_50_episodes"] for row in curve} == {5.0}


def test_habits_of_a_player_who_is_known():
    """A hole is dug at t = 5 and filled by two presses, of which the second moves; a third press is for nothing."""
    sys.path.insert(0, str(ROOT / "benchmark"))  # where the scripts find one another
    likeness = importlib.import_module("gopher_likeness")
    memory, actions = np.zeros((30, 128), np.int64), np.zeros(30, np.int64)
    memory[:, distill.SCENE], memory[:, distill.FARMER_X] = distill.IN_PLAY, distill.HOLES[2] + distill.SHOVEL - 5
    memory[5:12, (distill.ROWS - 1) * distill.ROW_BYTES + distill.HOLE_BYTES[2]] = distill.HOLE_BITS[2]
    actions[[2, 3, 9, 11, 20]] = [distill.GO_LEFT, distill.GO_RIGHT, distill.FIRE, distill.LEFT_FIRE, distill.FIRE]
    actions[21] = distill.FIRE  # held
    rewards = np.zeros(30)
    rewards[11] = 20.0
    episode = {"memory": memory, "actions": actions, "rewards": rewards}
    found = likeness.habits(distill, [episode])
    expected = {"reaction": 4 / 15 * 1000, "turns": 2 / 2, "needless": 1 / 3, "moving": 1 / 3, "presses": 3}
    assert found == pytest.approx(expected)
    cut, numbers = likeness.clips(distill, [episode])
    assert cut.shape == (1, 12, 30) and numbers.tolist() == [0]
    assert cut[0, :8, 9].tolist() == [0, 1, 0, 0, 0, 0, 0, 0]
    assert cut[0, 10, 9].item() == pytest.approx(5 / 80) and cut[0, 11, 9].item() == pytest.approx(1 / 3)


def test_likeness_of_whatever_is_done(student, pixel_teacher, tmp_path):
    """Memory is what the human saw; the table has each agent."""
    sys.path.insert(0, str(ROOT / "benchmark"))  # where the scripts find one another
    likeness = importlib.import_module("gopher_likeness")
    make_game = functools.partial(distill.make_atari, "ALE/Gopher-v5", obs_type="ram", frame_stack=1)
    human, saw = distill.SyntheticGopherHuman(1, 0), []
    episode = distill.play_atari(lambda obs: (saw.append(obs[0, -1]), human(obs))[1], make_game, [7])[0]
    assert np.array_equal(likeness.watch_memory(make_game(), episode), np.array(saw))
    for name, folder in (("teacher_seed1", pixel_teacher), ("alpha0.8_seed1", student)):
        shutil.copytree(folder, tmp_path / "runs" / name)
    script = ROOT / "benchmark" / "gopher_likeness.py"
    run("--runs", "runs", "--games", 2, "--out", "out", cwd=tmp_path, script=script)
    text = (tmp_path / "out" / "likeness.md").read_text()
    frames = json.loads((pixel_teacher / "result.json").read_text())["global_step"]
    agents = [
        "synthetic human",
        "synthetic human again",
        f"DQN of {frames:,} frames",
        "α = 0.8, greedy",
        "α = 0.8, sampled",
    ]
    assert [line.split(" | ")[0][2:] for line in text.splitlines()[4:]] == agents and "nan" not in text
    assert "holds no finished student" in run("--runs", "out", cwd=tmp_path, script=script, code=2).stderr
    shutil.rmtree(tmp_path / "runs" / "teacher_seed1")
    run("--runs", "runs", "--games", 2, "--out", "again", "--known", "out", cwd=tmp_path, script=script)
    assert (tmp_path / "again" / "likeness.csv").read_text() == (tmp_path / "out" / "likeness.csv").read_text()


def memory_after(actions: list[int]) -> np.ndarray:
    """The console's memory after some actions in an episode without idle frames at first."""
    game = dqn.make_atari("ALE/Gopher-v5", obs_type="ram", frame_stack=1, noop_max=0)
    game.reset(seed=3)
    for action in actions:
        obs, *_ = game.step(action)
    return obs[0].astype(int)


def test_the_memory_is_where_the_synthetic_human_looks():
    """The farmer goes a pixel a frame; in a while the gopher digs holes, of which the farmer's shovel fills one."""
    idle = 300 * [distill.NOOP]
    there = memory_after(idle)
    assert there[distill.SCENE] == distill.IN_PLAY
    right = memory_after([*idle, *(10 * [distill.GO_RIGHT])])
    assert 30 <= right[distill.FARMER_X] - there[distill.FARMER_X] <= 40  # an action is repeated by chance
    garden = there[: distill.ROWS * distill.ROW_BYTES].reshape(distill.ROWS, distill.ROW_BYTES)
    dug = (garden[:, distill.HOLE_BYTES] & distill.HOLE_BITS) > 0
    assert dug.any() and not (dug[:-1] & ~dug[1:]).any()  # from the tunnel up
    human = distill.SyntheticGopherHuman(1, 0)
    _, place, _ = human.choose(there[distill.FARMER_X], there, there)
    assert place - distill.SHOVEL in distill.HOLES[dug.any(0)]


def test_the_synthetic_human_sees_late_but_knows_where_its_hands_are():
    human, saw = distill.SyntheticGopherHuman(1, 0), []
    human.act = lambda farmer, earlier, late: saw.append((farmer, int(earlier[0]), int(late[0]))) or distill.NOOP
    for t in range(12):
        memory = np.zeros((1, 1, 128), np.uint8)
        memory[..., 0], memory[..., distill.FARMER_X] = t, 100 + t
        human(memory)
    assert saw[4:] == [(100 + t, max(0, t - 5), t - 4) for t in range(4, 12)]  # 4 actions of 4 frames, 267 ms


@pytest.mark.slow
def test_the_synthetic_human_scores_as_the_published_one():
    """23.87 rewards of a life in Table 2.2."""
    make_game = functools.partial(distill.make_atari, "ALE/Gopher-v5", obs_type="ram", frame_stack=1)
    lives = []
    for i in range(40):
        (episode,) = distill.play_atari(distill.SyntheticGopherHuman(1, i), make_game, [i])
        lives += distill.rewards_per_life(episode)
    assert abs(np.mean(lives) - 23.87) < 3 * np.std(lives) / len(lives) ** 0.5 < 6, np.mean(lives)


def test_the_synthetic_human_presses_and_lets_go():
    make_game = functools.partial(distill.make_atari, "ALE/Gopher-v5", obs_type="ram", frame_stack=1)
    first, again = (distill.play_atari(distill.SyntheticGopherHuman(1, 0), make_game, [7])[0] for _ in range(2))
    assert np.array_equal(first["actions"], again["actions"])
    presses = np.isin(first["actions"], (distill.FIRE, distill.RIGHT_FIRE, distill.LEFT_FIRE))
    assert presses.any() and not (presses[1:] & presses[:-1]).any()
    assert first["rewards"].sum() > 0


def test_a_stopped_student_of_gopher_ends_with_the_same_bytes(student, pixel_teacher, tmp_path):
    flags = [*SMALL_DISTILL, "--teacher", pixel_teacher, "--bf16", "--run-dir", "run"]
    run(*flags, "--stop-at", 2, cwd=tmp_path, script=DISTILL)
    run(*flags, "--resume", cwd=tmp_path, script=DISTILL)
    for name in ("updates.csv", "evaluation.json"):
        assert (tmp_path / "run" / name).read_bytes() == (student / name).read_bytes()
    states = [
        torch.load(folder / "checkpoint.pt", weights_only=True)["update"] for folder in (student, tmp_path / "run")
    ]
    assert all(torch.equal(value, states[1][name]) for name, value in states[0].items())
    evaluation = json.loads((student / "evaluation.json").read_text())
    assert evaluation["sampled"]["rewards_per_life"]["episodes"] >= 3


def test_a_finished_student_is_not_prepared_again(student, tmp_path, monkeypatch, capsys):
    """It is told before the teacher is read and anything is played; and so is that a folder is taken."""
    args = json.loads((student / "args.json").read_text())
    flags = [*SMALL_DISTILL, "--teacher", args["teacher"], "--bf16", "--save-model", "--save-demos", 1]
    for name in ("run", "taken"):  # a process keeps its lock
        shutil.copytree(student, tmp_path / name)

    def never(*its, **named):
        raise AssertionError("prepared")

    for name in ("read_human", "load_teacher", "play_atari", "watch", "Update"):
        monkeypatch.setattr(distill, name, never)
    assert distill.cli([*map(str, flags), "--run-dir", str(tmp_path / "run"), "--resume"]) == 0
    assert f"{tmp_path / 'run'} is done" in capsys.readouterr().out
    assert_refused(distill, capsys, [*flags, "--run-dir", tmp_path / "taken"], ["--run-dir", "exists"])


def test_recordings_of_gopher_are_played_again_and_learned_from(student, pixel_teacher, tmp_path):
    """The synthetic human's folder given as a recording leads to the same student; its files hold no frames."""
    demos = student / "demos_synthetic_human"
    with np.load(next(demos.glob("*.npz")), allow_pickle=False) as arrays:
        assert "observations" not in arrays and arrays["emulator_state"].dtype == np.uint8
    flags = [*SMALL_DISTILL, "--teacher", pixel_teacher, "--bf16", "--demos", demos, "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=DISTILL)
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (student / "updates.csv").read_bytes()
    human, paid, lives = json.loads((tmp_path / "run" / "result.json").read_text())["human"], 0, 0
    for path in demos.glob("*.npz"):
        with np.load(path, allow_pickle=False) as arrays:
            paid, lives = paid + (arrays["rewards"] > 0).sum(), lives + 1 + (np.diff(arrays["lives"])[:-1] < 0).sum()
    assert human["player"] == "recorded" and human["rewards_per_life"]["episodes"] == lives
    assert human["rewards_per_life"]["mean"] == pytest.approx(paid / lives)


def test_lives_of_the_players_report_are_those_of_the_method(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmark")
    players = importlib.import_module("gopher_players")
    episode = {"lives": np.array([3, 3, 2, 2, 1, 0]), "rewards": np.array([20.0, 0, 100, 0, 20, 20])}
    scores = {unit: score(distill, episode) for unit, score in players.UNITS.items()}
    assert scores["rewards of a life"] == [(part > 0).sum() for part in players.lives_of(distill, episode)] == [2, 1, 1]
    assert scores["points of a life / 20"] == [6, 1, 1] and scores["points of a game"] == [160]


def test_demonstrations_of_a_quick_human_are_read_by_a_student(tmp_path, monkeypatch):
    """As gopher_alpha.sh has them made, but of less play."""
    monkeypatch.syspath_prepend(ROOT / "benchmark")
    players = importlib.import_module("gopher_players")
    method = players.load_method("distill_hybrid")
    complete = method.complete_args
    monkeypatch.setattr(method, "complete_args", lambda args: complete(replace(args, demo_frames=200, test_frames=50)))
    players.write_quick_demonstrations(method, players.Args(seed=2, demos=tmp_path / "demos"))
    (episode,) = distill.read_demonstrations(tmp_path / "demos", "ALE/Gopher-v5", 200)
    assert len(episode["actions"]) >= 200 and method.SyntheticGopherHuman.reaction == 2


def test_frames_of_a_person_are_what_an_agent_would_see(student):
    """Actions held for 4 frames, given as one for each frame: every fourth stack is the one that was seen."""
    path = sorted((student / "demos").glob("*.npz"))[0]
    with np.load(path, allow_pickle=False) as arrays:
        episode = {name: arrays[name] for name in ("actions", "rewards", "seed", "emulator_state")}
    game = dqn.make_atari("ALE/Gopher-v5")
    count = 200
    episode |= {name: episode[name][:count] for name in ("actions", "rewards")}
    seen = distill.watch(game, episode)
    single = dqn.make_atari("ALE/Gopher-v5", frame_skip=1)
    single.reset(seed=int(episode["seed"]))
    rewards = np.array([single.step(action)[1] for action in episode["actions"].repeat(4)])
    frames = distill.watch_frames(game, {**episode, "actions": episode["actions"].repeat(4), "rewards": rewards})
    assert frames.shape == (4 * count + 1, 4, 84, 84)
    assert np.array_equal(frames[::4], seen)
    rewards[100] += 1
    assert distill.watch_frames(game, {**episode, "actions": episode["actions"].repeat(4), "rewards": rewards}) is None


@pytest.mark.parametrize(
    "damage, words",
    [
        (lambda f: rewrite(f, lambda a: {**a, "actions": 7 - a["actions"]}), ["other rewards", "ale-py"]),
        (lambda f: rewrite(f, lambda a: {**a, "emulator_state": a["emulator_state"][::-1]}), ["other rewards"]),
        (lambda f: rewrite(f, lambda a: {**a, "seed": np.array([1, 2])}), ["seed a whole number"]),
        (lambda f: rewrite(f, lambda a: {**a, "seed": np.array(-1)}), ["seed a whole number"]),
        (lambda f: rewrite(f, lambda a: {**a, "seed": np.array("x")}), ["seed a whole number"]),
        (lambda f: edit_manifest(f, lambda m: m.update(options=["frame_skip"])), ["recorded with {}"]),
        (lambda f: rewrite(f, lambda a: {k: v for k, v in a.items() if k != "seed"}), ["no demonstration"]),
        (lambda f: edit_manifest(f, lambda m: m["options"].update(frame_skip=3)), ["frame_skip", "3"]),
        (lambda f: edit_manifest(f, lambda m: m["options"].update(frame_skip=1)), ["other rewards"]),
        (lambda f: rewrite(f, lambda a: {**a, "lives": a["lives"][:-1]}), ["lives must be whole numbers (T,)"]),
        (lambda f: rewrite(f, lambda a: {**a, "lives": np.array("x")}), ["lives must be whole numbers (T,)"]),
    ],
    ids=["actions", "state", "seeds", "negative", "word", "list", "none", "skip", "frames", "life", "lives"],
)
def test_a_wrong_recording_is_named(damage, words, student, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(student / "demos", "demos")
    damage(Path("demos"))
    flags = ["--env-id", "ALE/Gopher-v5", "--alpha", 0, "--demos", "demos", "--run-dir", "run"]
    assert_refused(distill, capsys, flags, ["--demos demos", *words])
    assert not Path("run").exists()


def test_a_teacher_that_reads_the_memory_is_refused(small, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    flags = ["--env-id", "ALE/Gopher-v5", "--teacher", small, "--run-dir", "run"]
    assert_refused(distill, capsys, flags, ["--teacher", "another shape"])
    flags = ["--env-id", "ALE/Gopher-v5", "--teacher", tmp_path / "none", "--run-dir", "run"]
    assert_refused(distill, capsys, flags, ["--teacher", "dqn_gopher.py --save-model"])


def test_no_more_of_the_dqns_play_is_made_into_frames_than_is_learned_from(monkeypatch):
    """Ten games are played at once; the frames of one are made only while there are too few."""
    watched, teacher = [], dqn.AtariQNetwork((4, 84, 84), 8, 32, True)
    monkeypatch.setattr(distill, "play_atari", lambda policy, make, seeds: [{"actions": np.zeros(100)} for _ in seeds])
    monkeypatch.setattr(distill, "watch", lambda game, episode: watched.append(episode))
    episodes = distill.play_teacher(teacher, 1_250, distill.Args(env_id="ALE/Gopher-v5"))
    assert len(episodes) == len(watched) == 13


@pytest.mark.parametrize("mode, share", [("greedy", 0.01 * 7 / 8), ("sampled", 0.0)])
def test_greedy_students_of_gopher_take_a_hundredth_of_random_actions(mode, share, monkeypatch):
    taken, student = [], distill.Student((6,), 8, 4)
    with torch.no_grad():
        student.layers[2].weight.zero_()
        student.layers[2].bias.copy_(40 * torch.eye(8)[3])
    obs = np.zeros((40_000, 6), np.float32)
    monkeypatch.setattr(distill, "play_atari", lambda policy, make_game, seeds: taken.append(policy(obs)) or [])
    distill.play_student(student, mode, distill.Args(env_id="ALE/Gopher-v5"), [1])
    assert (taken[0] != 3).mean() == pytest.approx(share, abs=0.002)


def test_states_of_the_dqn_itself(pixel_teacher, tmp_path):
    flags = [*SMALL_DISTILL, "--teacher", pixel_teacher, "--states", "own", "--epochs", 1, "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=DISTILL)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["complete"]
