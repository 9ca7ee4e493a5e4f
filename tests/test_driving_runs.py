"""ddpg_torcs_like.py and gail_hybrid.py through the command line: runs, resumes, and what a user can get wrong."""

import csv
import importlib
import itertools
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch
import torch
from conftest import (
    ROOT,
    Counter,
    as_a_process_of_its_own,
    assert_refused,
    command,
    edit_manifest,
    flip_a_byte,
    kill_twice,
    needs_compiler,
    rewrite,
    run,
)

from cleanrl_thesis import ddpg_torcs_like as ddpg
from cleanrl_thesis import gail_hybrid as gail

DDPG, GAIL = ROOT / "cleanrl_thesis" / "ddpg_torcs_like.py", ROOT / "cleanrl_thesis" / "gail_hybrid.py"
SMALL_DDPG = [
    *("--total-timesteps", 8_000, "--num-envs", 5, "--buffer-size", 3_000, "--batch-size", 16, "--train-steps", 20),
    *("--hidden-size", 16, "--perturb-interval", 100, "--checkpoint-interval", 1_000, "--eval-episodes", 2),
    *("--keep-best-every", 2_000),
]
SMALL_GAIL = [
    *("--total-timesteps", 5_120, "--num-envs", 4, "--num-steps", 32, "--frame-skip", 2, "--human-episodes", 2),
    *("--hidden-size", 16, "--bc-epochs", 1, "--checkpoint-interval", 1, "--eval-episodes", 2),
]
RECORDS = ("episodes.csv", "updates.csv", "evaluation.json")


@pytest.fixture(scope="session")
def expert(tmp_path_factory) -> Path:
    """An undisturbed small run of DDPG."""
    folder = tmp_path_factory.mktemp("ddpg")
    run(*SMALL_DDPG, "--run-dir", "run", "--save-model", "--save-demos", 2, cwd=folder, script=DDPG)
    return folder / "run"


@pytest.fixture(scope="session")
def student(tmp_path_factory, expert) -> Path:
    """An undisturbed small run of the hybrid."""
    folder = tmp_path_factory.mktemp("gail")
    flags = ["--demos-rl", expert / "demos", "--run-dir", "run", "--save-model", "--save-demos", 2]
    run(*SMALL_GAIL, *flags, cwd=folder, script=GAIL)
    return folder / "run"


class DoubleActions(gym.Wrapper):
    """An environment whose actions are of float64."""

    def __init__(self, env: gym.Env):
        super().__init__(env)
        self.action_space = gym.spaces.Box(env.action_space.low, env.action_space.high, dtype=np.float64)


def flat(state: object) -> list[torch.Tensor]:
    """All tensors of a nested state."""
    if isinstance(state, torch.Tensor):
        return [state]
    parts = state.values() if isinstance(state, dict) else state if isinstance(state, (list, tuple)) else []
    return [tensor for part in parts for tensor in flat(part)]


def assert_same_run(left: Path, right: Path) -> None:
    """Same bytes in the records, same tensors in the checkpoints."""
    for name in RECORDS:
        assert (left / name).read_bytes() == (right / name).read_bytes(), name
    states = [torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (left, right)]
    for part in ("agent", "optimizer", "players"):
        pairs = [flat(state.get(part, {})) for state in states]
        assert len(pairs[0]) == len(pairs[1]) and all(torch.equal(*pair) for pair in zip(*pairs)), part


def kill(script: Path, flags: list, folder: Path, number: int, at_row: int) -> None:
    """Start or resume a run and send it a signal once its updates.csv has `at_row` rows."""
    line = command(*flags, "--run-dir", folder, "--resume", script=script)
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    path = folder / ("updates.csv" if script == GAIL else "episodes.csv")
    while process.poll() is None and not (path.exists() and path.read_bytes().count(b"\n") >= at_row):
        time.sleep(0.002)
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number), out


@pytest.mark.parametrize("kind", ["ddpg", pytest.param("ddpg, other task", marks=pytest.mark.slow), "gail"])
def test_a_killed_run_ends_with_the_same_bytes(kind, expert, student, tmp_path):
    script, flags, whole, rows = {
        "ddpg": (DDPG, SMALL_DDPG, expert, (5, 25)),
        "ddpg, other task": (
            DDPG,
            [*SMALL_DDPG, "--env-id", "Pendulum-v1", "--noise", "ou", "--checkpoint-interval", 700],
            tmp_path / "whole",
            (3, 12),
        ),
        "gail": (GAIL, [*SMALL_GAIL, "--demos-rl", expert / "demos"], student, (4, 12)),
    }[kind]
    if kind == "ddpg, other task":
        run(*flags, "--run-dir", whole, cwd=tmp_path, script=script)
    for number, at_row in zip((signal.SIGKILL, signal.SIGTERM), rows):
        kill(script, flags, tmp_path / "run", number, at_row)
    done = run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path, script=script)
    assert "differs" not in done.stderr
    assert_same_run(whole, tmp_path / "run")


def test_ddpg_with_a_torn_checkpoint_finds_its_replay_buffer(expert, tmp_path):
    shutil.copytree(expert, tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    (tmp_path / "run" / "result.json").unlink()
    done = run(*SMALL_DDPG, "--run-dir", "run", "--resume", cwd=tmp_path, script=DDPG)
    assert "torn" in done.stderr
    assert_same_run(expert, tmp_path / "run")


@needs_compiler
def test_compiled_through_the_command_line(tmp_path):
    done = run(*SMALL_DDPG, "--compile", "--run-dir", "run", cwd=tmp_path, script=DDPG)
    assert "--compile" not in done.stderr
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["arithmetic"] == "compiled on cpu"


@pytest.mark.parametrize("kind", ["ddpg", "gail"])
def test_copied_alone_into_an_empty_folder(kind, expert, student, tmp_path):
    gail_flags = [*SMALL_GAIL, "--demos-rl", expert / "demos"]
    script, flags, whole = {"ddpg": (DDPG, SMALL_DDPG, expert), "gail": (GAIL, gail_flags, student)}[kind]
    copied = Path(shutil.copy(script, tmp_path))
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=copied, PYTHONSAFEPATH="1")
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (whole / "updates.csv").read_bytes()


def test_runs_leave_what_the_readme_says(expert, student):
    shared = {"args.json", "checkpoint.pt", "checkpoint.previous.pt", "evaluation.json", "learning_curve.png"}
    shared |= {"model.safetensors", "result.json", "episodes.csv", "updates.csv", "demos"}
    events = {path.name for path in (*expert.iterdir(), *student.iterdir()) if "tfevents" in path.name}
    assert {path.name for path in expert.iterdir()} - events == {*shared, "replay.dat"}
    assert {path.name for path in student.iterdir()} - events == {*shared, "demos_synthetic_human"}


def test_a_student_has_the_statistics_of_what_it_learned_from(student, expert):
    """Of all observations at which its experts act, every second one."""
    seen = []
    for folder in (expert / "demos", student / "demos_synthetic_human"):
        for path in folder.glob("*.npz"):
            with np.load(path) as arrays:
                seen.append(arrays["observations"][:-1][::2])
    saved, seen = safetensors.torch.load_file(student / "model.safetensors"), torch.from_numpy(np.concatenate(seen))
    assert torch.allclose(saved["obs_mean"], seen.mean(0), atol=1e-4)
    assert torch.allclose(saved["obs_std"], seen.std(0).clamp(min=1e-3), rtol=1e-3)


@pytest.mark.parametrize("kind", ["expert", "student"])
def test_demonstrations_can_be_played_again(kind, request):
    folder = request.getfixturevalue(kind) / "demos"
    assert json.loads((folder / "manifest.json").read_text())["options"]["track"] == "meadow"
    for path in sorted(folder.glob("*.npz")):
        with np.load(path, allow_pickle=False) as arrays:
            seed, times, rewards = int(arrays["seed"]), arrays["t_ns"], arrays["rewards"]
            actions, observations = arrays["actions"], arrays["observations"]
        env = ddpg.make_env("TorcsLike-v0")
        obs = [env.reset(seed=seed)[0]]
        for action, reward in zip(actions, rewards):
            step = env.step(action)
            obs.append(step[0])
            assert step[1] == reward
        assert np.array_equal(obs, observations) and (step[2] or step[3])
        assert times[50] == pytest.approx(1e9)
        skip = {"expert": 5, "student": 2}[kind]  # each action is held for so many steps
        blocks = actions[: len(actions) // skip * skip].reshape(-1, skip, 2)
        assert (blocks == blocks[:, :1]).all() and (blocks[1:, 0] != blocks[:-1, 0]).any()


def test_a_student_is_evaluated_as_it_drives(tmp_path, monkeypatch):
    """Each action is held for `--frame-skip` steps, in both modes."""
    torch.manual_seed(0)
    agent, acts = gail.Agent(65, 2, 16), []

    def play(policy, games, seeds, keep=False):
        acts.append([policy(np.full((len(seeds), 65), t, np.float32)) for t in range(3)])
        return [{"rewards": np.zeros(300), "terminated": np.array(False)}]

    monkeypatch.setattr(gail, "play", play)
    monkeypatch.setattr(gail, "measured", lambda episodes, args: {})
    gail.evaluate(agent, gail.Args(env_id="TorcsLike-v0", frame_skip=2, alpha=0.0, eval_episodes=1), tmp_path)
    assert len(acts) == 2
    for first, held, other in acts:
        assert np.array_equal(first, held) and not np.array_equal(held, other)


@pytest.mark.parametrize(
    "flags",
    [
        ["--noise", "gaussian", "--track-name", "city", "--no-brake"],
        ["--reward", "speed", "--no-layer-norm", "--noise", "none", "--reward-scale", 0.01],
        ["--env-id", "cleanrl_thesis.ddpg_torcs_like:TorcsLike-v0", "--track-name", "hills"],
    ],
)
def test_other_ways_to_train_an_expert(flags, expert, tmp_path):
    run(*SMALL_DDPG, "--total-timesteps", 1_000, *flags, "--run-dir", "run", cwd=tmp_path, script=DDPG)
    updates = (tmp_path / "run" / "updates.csv").read_bytes()
    assert updates.count(b"\n") >= 2 and updates != (expert / "updates.csv").read_bytes()[: len(updates)]
    assert len(json.loads((tmp_path / "run" / "result.json").read_text())["evaluation"]["driving"]["laps"]) == 2


def test_a_student_of_another_task(tmp_path):
    """GAIL on Pendulum, from demonstrations of a small DDPG run; a warm start, the signed reward."""
    flags = ["--env-id", "Pendulum-v1", "--save-demos", 3, "--run-dir", "expert", "--eval-episodes", 2]
    run(*SMALL_DDPG, *flags, cwd=tmp_path, script=DDPG)
    flags = ["--env-id", "Pendulum-v1", "--alpha", 1, "--demos-rl", "expert/demos", "--run-dir", "run"]
    more = ["--bc-epochs", 2, "--reward-form", "signed", "--d-steps", 2]
    run(*SMALL_GAIL, *flags, *more, cwd=tmp_path, script=GAIL)
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["experts"].keys() == {"rl"} and not (tmp_path / "run" / "demos_synthetic_human").exists()


def test_mixing_the_actions_alone(expert, tmp_path):
    """Behaviour cloning without a step of GAIL; sent again, it is done."""
    flags = [*SMALL_GAIL, "--demos-rl", expert / "demos", "--total-timesteps", 0, "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=GAIL)
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["complete"] and result["global_step"] == 0 and result["steps_per_second"] is None
    assert result["evaluation"]["greedy"]["episodes"] == 2
    assert "is done" in run(*flags, "--resume", cwd=tmp_path, script=GAIL).stdout


def test_an_expert_without_weight_is_not_learned_from(expert, tmp_path):
    """α = 0 with the RL expert's demonstrations at hand is α = 0 without them."""
    flags = [*SMALL_GAIL, "--total-timesteps", 1_024, "--alpha", 0]
    run(*flags, "--demos-rl", expert / "demos", "--run-dir", "with", cwd=tmp_path, script=GAIL)
    run(*flags, "--run-dir", "without", cwd=tmp_path, script=GAIL)
    assert (tmp_path / "with" / "updates.csv").read_bytes() == (tmp_path / "without" / "updates.csv").read_bytes()


def test_the_student_never_sees_the_reward(student, expert, tmp_path, monkeypatch):
    """With tenfold rewards it learns the same; those of its episodes are other ones."""

    class RicherPlayers(gail.CarPlayers):
        def step(self, *args, **options) -> gail.Steps:
            before = self.returns.copy()
            steps = super().step(*args, **options)
            self.returns += 9 * np.where(self.returns > before, self.returns - before, 0)
            return steps._replace(rewards=10 * steps.rewards)

    monkeypatch.setattr(gail, "CarPlayers", RicherPlayers)
    run(*SMALL_GAIL, "--demos-rl", expert / "demos", "--run-dir", "run", cwd=tmp_path, script=GAIL)
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (student / "updates.csv").read_bytes()
    assert (tmp_path / "run" / "episodes.csv").read_bytes() != (student / "episodes.csv").read_bytes()


def test_recorded_demonstrations_are_those_that_are_learned_from(student, expert, tmp_path):
    """The synthetic human's folder given as a recording leads to the same student."""
    flags = [*SMALL_GAIL, "--demos-rl", expert / "demos", "--demos-human", student / "demos_synthetic_human"]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=GAIL)
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (student / "updates.csv").read_bytes()


def test_the_report_takes_whatever_is_done(expert, student, tmp_path):
    """Of one seed: both experts, the hybrid, a clone; what is not finished is left out."""
    flags = [*SMALL_GAIL, "--demos-rl", expert / "demos", "--total-timesteps", 0]
    run(*flags, "--run-dir", tmp_path / "runs" / "mix_alpha0.5_seed1", cwd=tmp_path, script=GAIL)
    shutil.copytree(expert, tmp_path / "runs" / "expert_seed1")
    shutil.copytree(expert, tmp_path / "runs" / "expert_seed2")
    (tmp_path / "runs" / "expert_seed2" / "result.json").unlink()
    shutil.copytree(student, tmp_path / "runs" / "alpha0.5_seed1")
    shutil.copytree(student / "demos_synthetic_human", tmp_path / "runs" / "human_seed1")
    run("--runs", "runs", "--out", "out", cwd=tmp_path, script=ROOT / "benchmark" / "torcs_report.py")
    text = (tmp_path / "out" / "table.md").read_text()
    human = json.loads((student / "result.json").read_text())["experts"]["human"]["driving"]["score"]
    extremes = f"{human['max']:.0f} | {human['min']:.0f}"
    assert f"| human | demonstrations | 1 | 2 | {extremes} | {human['mean']:.1f} | {human['std']:.1f} |" in text
    assert "| DDPG | **published** | | | 823 | 818 | 819 | 0.5 | 1.00 | 1.29 |" in text
    assert "| hybrid, α = 0.5, less human | " in text
    assert "| actions mixed, α = 0.5 | greedy | 1 |" in text and "| DDPG | 1 |" in text
    assert (tmp_path / "out" / "fig_2_8.png").stat().st_size > 10_000
    with open(tmp_path / "out" / "runs.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 2 + 1 + 2 * 2


def test_a_saved_expert_drives_as_it_was_evaluated(expert, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmark")
    players = importlib.import_module("torcs_players")
    evaluation = json.loads((expert / "evaluation.json").read_text())
    episodes = ddpg.play(players.load_expert(expert), ddpg.TorcsLikeVectorEnv(2), evaluation["seeds"])
    assert [episode["rewards"].sum() for episode in episodes] == evaluation["returns"]
    monkeypatch.setattr(ddpg, "EPISODE_STEPS", ddpg.EPISODE_STEPS)
    laps = players.lap_row(expert, 1)
    assert laps["episodes"] == 20 and laps["whole laps"] == 0 and laps["fastest, s"] == ""


@pytest.mark.parametrize(
    "damage, words",
    [
        (lambda folder: [path.unlink() for path in folder.iterdir()], ["no readable manifest.json"]),
        (lambda folder: edit_manifest(folder, lambda m: m.update(files={})), ["names no file"]),
        (lambda folder: edit_manifest(folder, lambda m: m.update(version=2)), ["version 2"]),
        (lambda folder: edit_manifest(folder, lambda m: m.update(env_id="Hopper-v4")), ["Hopper-v4", "TorcsLike-v0"]),
        (lambda folder: edit_manifest(folder, lambda m: m["options"].update(track="city")), ["city", "meadow"]),
        (lambda folder: edit_manifest(folder, lambda m: m["options"].update(brake=False)), ["--brake False", "True"]),
        (lambda folder: (folder / "episode_00000.npz").unlink(), ["episode_00000.npz", "cannot be read"]),
        (flip_a_byte, ["episode_00000.npz", "SHA-256"]),
        (lambda f: rewrite(f, lambda a: {**a, "observations": a["observations"][:, :5]}), ["(T + 1, 65)"]),
        (lambda f: rewrite(f, lambda a: {**a, "actions": a["actions"][:, 0]}), ["(T, 2)"]),
        (lambda f: rewrite(f, lambda a: {**a, "actions": a["actions"] * np.nan}), ["actions", "finite"]),
        (lambda f: rewrite(f, lambda a: {**a, "rewards": a["rewards"][:5]}), ["rewards"]),
        (
            lambda f: rewrite(f, lambda a: {**a, "observations": a["observations"][:1], "actions": a["actions"][:0]}),
            ["step"],
        ),
        (lambda f: rewrite(f, lambda a: {**a, "actions": np.array([{}], object)}), ["no demonstration"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_demonstration_is_named(damage, words, expert, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(expert / "demos", "demos")
    damage(Path("demos"))
    flags = ["--alpha", 1, "--demos-rl", "demos", "--run-dir", "run"]
    assert_refused(gail, capsys, flags, ["--demos-rl demos", *words])
    assert not Path("run").exists()


def test_a_resume_with_other_hyperparameters_names_them(student, expert, tmp_path, capsys):
    shutil.copytree(student, tmp_path / "run")
    flags = [*SMALL_GAIL, "--run-dir", tmp_path / "run", "--resume", "--demos-rl", expert / "demos", "--gamma", 0.9]
    assert_refused(gail, capsys, flags, ["--gamma 0.9", "was"])


def test_a_student_goes_on_with_another_interval_between_checkpoints(student, expert, tmp_path):
    flags = [*SMALL_GAIL, "--demos-rl", expert / "demos", "--run-dir", "run", "--resume", "--save-model"]
    flags += ["--save-demos", 2, "--checkpoint-interval"]
    run(*flags, 1_000, "--stop-at", 512, cwd=tmp_path, script=GAIL)
    run(*flags, 700, cwd=tmp_path, script=GAIL)
    assert_same_run(tmp_path / "run", student)
    assert "is done" in run(*flags, 1_000, cwd=tmp_path, script=GAIL).stdout


def test_a_clone_is_evaluated_anew(expert, tmp_path):
    """As a student is that was trained: from its checkpoint, by other flags of the end."""
    flags = [*SMALL_GAIL, "--demos-rl", expert / "demos", "--total-timesteps", 0, "--run-dir", "run", "--resume"]
    run(*flags, cwd=tmp_path, script=GAIL)
    before = (tmp_path / "run" / "evaluation.json").read_bytes()
    run(*flags, "--save-model", cwd=tmp_path, script=GAIL)
    assert (tmp_path / "run" / "evaluation.json").read_bytes() == before
    assert (tmp_path / "run" / "model.safetensors").exists()


def test_a_clone_is_kept_where_it_is_stopped(expert, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    clone = gail.behaviour_cloning

    def stopped(*args) -> None:
        clone(*args)
        os.kill(os.getpid(), signal.SIGTERM)

    monkeypatch.setattr(gail, "behaviour_cloning", stopped)
    flags = [*map(str, SMALL_GAIL), "--demos-rl", str(expert / "demos"), "--total-timesteps", "0", "--run-dir", "run"]
    with as_a_process_of_its_own():
        assert gail.cli(flags) == 128 + signal.SIGTERM
    assert "before the evaluation" in capsys.readouterr().out
    assert (tmp_path / "run" / "checkpoint.pt").exists() and not (tmp_path / "run" / "result.json").exists()
    run(*flags, "--resume", cwd=tmp_path, script=GAIL)
    assert (tmp_path / "run" / "result.json").exists()


@pytest.mark.parametrize("flag", ["--seeds", "--workers"])
def test_gail_on_hopper_names_a_wrong_count(flag, monkeypatch, capsys):
    monkeypatch.syspath_prepend(ROOT / "benchmark")
    hopper, common = importlib.import_module("gail_hopper"), importlib.import_module("common")
    monkeypatch.setattr(sys, "argv", ["gail_hopper.py", flag, "0"])
    with pytest.raises(SystemExit) as stop:
        common.run_main(hopper.main, hopper.Args, hopper.__doc__)
    assert stop.value.code == 2 and capsys.readouterr().err == f"error: {flag} 0: must be at least 1\n"


@pytest.mark.parametrize("steps", [512, 0])
def test_a_resume_with_other_demonstrations_is_refused(steps, expert, tmp_path, monkeypatch, capsys):
    """Of a student, and of a clone."""
    monkeypatch.chdir(tmp_path)
    shutil.copytree(expert / "demos", "demos")
    flags = [*SMALL_GAIL, "--total-timesteps", steps, "--alpha", 1, "--demos-rl", "demos", "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=GAIL)
    assert "is done" in run(*flags, "--resume", cwd=tmp_path, script=GAIL).stdout
    rewrite(Path("demos"), lambda arrays: {**arrays, "actions": -arrays["actions"]})
    more = ["--eval-episodes", 3] if steps else []
    assert_refused(gail, capsys, [*flags, "--resume", *more], ["--resume", "demonstrations"])


@pytest.mark.parametrize("mode", gail.MODES)
def test_the_video_is_the_first_evaluation_episode(mode, student, tmp_path, monkeypatch):
    args = gail.complete_args(gail.Args(capture_video=True, eval_episodes=3, eval_mode=mode, frame_skip=2, alpha=0))
    agent, filmed = gail.Agent(65, 2, 16), []
    agent.load_state_dict(safetensors.torch.load_file(student / "model.safetensors"))
    monkeypatch.setattr(gail, "record_video", lambda episode, args, run_dir: filmed.append(episode))
    evaluation = gail.evaluate(agent, args, tmp_path)
    env = gail.make_env(args.env_id, **gail.env_options(args))
    env.reset(seed=int(filmed[0]["seed"]))
    played = sum(env.step(action)[1] for action in filmed[0]["actions"])
    assert len(filmed) == 1 and played == pytest.approx(evaluation[mode]["returns"][0], rel=1e-6)


@pytest.mark.parametrize("script", [DDPG, GAIL], ids=["ddpg", "gail"])
def test_parameters_that_explode_end_the_run(script, expert, tmp_path):
    flags = [*SMALL_DDPG] if script == DDPG else [*SMALL_GAIL, "--demos-rl", expert / "demos"]
    flags += ["--learning-rate" if script == DDPG else "--value-learning-rate", 1e30]  # TRPO's step has a bound
    done = run(*flags, "--run-dir", "run", cwd=tmp_path, code=1, script=script)
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


class WholeActions(Counter):
    action_space = gym.spaces.Box(-3, 3, (1,), np.int64)


def test_actions_of_float64_are_bounded_in_float32():
    gym.register("Doubles-v0", lambda **_: DoubleActions(gym.make("Pendulum-v1")))
    try:
        space = gail.action_space(gail.Args(env_id="Doubles-v0"))
    finally:
        gym.registry.pop("Doubles-v0")
    actions = np.array([[3.0], [-0.5]], np.float32)
    assert space.low.dtype == space.high.dtype == gail.bounded(actions, space.low, space.high).dtype == np.float32
    assert gail.bounded(actions, space.low, space.high).tolist() == [[2.0], [-0.5]]


@pytest.mark.parametrize("method", [ddpg, gail], ids=["ddpg", "gail"])
def test_environments_without_a_render_mode_and_with_odd_infos_are_evaluated(method, moody):
    games = method.make_games(method.Args(env_id=moody[0]), 4)
    episodes = method.play(lambda obs: np.zeros((4, 1), np.float32), games, [1, 2, 3, 4], keep=True)
    assert [episode["rewards"].sum() for episode in episodes] == [4] * 4
    assert episodes[3]["observations"].ravel().tolist() == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("method", [ddpg, gail], ids=["ddpg", "gail"])
def test_actions_that_are_whole_numbers_are_refused(method):
    gym.register("Whole-v0", WholeActions)
    try:
        with pytest.raises(method.UsageError, match="--env-id Whole-v0: needs .* floats"):
            method.make_env("Whole-v0")
    finally:
        gym.registry.pop("Whole-v0")


def test_a_network_that_the_numpy_twin_does_not_know_is_refused():
    agent = gail.Agent(3, 1, 8)
    gail.numpy_mean(agent)
    agent.actor_mean.insert(1, torch.nn.LayerNorm(8))
    with pytest.raises(TypeError, match="LayerNorm"):
        gail.numpy_mean(agent)


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", ["ddpg", "gail"])
def test_six_runs_killed_at_random_end_with_the_same_bytes(kind, expert, tmp_path):
    """Each is killed twice, after a checkpoint; every second one at first before there is any."""
    script, flags = {"ddpg": (DDPG, SMALL_DDPG), "gail": (GAIL, [*SMALL_GAIL, "--demos-rl", expert / "demos"])}[kind]
    start = time.time()
    run(*flags, "--run-dir", "whole", cwd=tmp_path, script=script)
    seconds = time.time() - start

    def kill_and_resume(number: int) -> None:
        flags_of_run = [*flags, "--run-dir", tmp_path / f"run{number}"]
        kill_twice(flags_of_run, seconds, number, script, after_checkpoints=True)
        run(*flags, "--run-dir", f"run{number}", "--resume", cwd=tmp_path, script=script)
        assert_same_run(tmp_path / "whole", tmp_path / f"run{number}")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(kill_and_resume, range(6)))


def test_the_kept_policy_is_evaluated_and_saved(tmp_path, monkeypatch):
    consider = ddpg.Best.consider
    at_2000 = lambda best, agent, score, step: consider(best, agent, score, step) if step == 2_000 else None  # noqa: E731
    monkeypatch.setattr(ddpg.Best, "consider", at_2000)
    run(*SMALL_DDPG, "--save-model", "--run-dir", "run", cwd=tmp_path, script=DDPG)
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    agent = ddpg.Agent(65, 2, 16, True)
    agent.load_state_dict(safetensors.torch.load_file(tmp_path / "run" / "model.safetensors"))
    saved = torch.cat([parameter.detach().reshape(-1) for parameter in agent.actor.parameters()])
    assert torch.equal(saved, state["best"]["vector"][: len(saved)])
    assert not torch.equal(saved, state["optimizer"]["vector"][: len(saved)])


def replayed(folder: Path, width: int) -> np.ndarray:
    """The transitions in the replay buffer of a run that has not gone round."""
    added = torch.load(folder / "checkpoint.pt", weights_only=True)["added"]
    return np.fromfile(folder / "replay.dat", np.float32).reshape(-1, width)[:added]


def test_the_replay_file_is_as_large_as_the_disk_was_asked_for(tmp_path, monkeypatch):
    asked, check = [], ddpg.check_disk
    monkeypatch.setattr(ddpg, "check_disk", lambda *its: asked.append(its[3]) or check(*its))
    run(*SMALL_DDPG, "--total-timesteps", 200, "--run-dir", "run", cwd=tmp_path, script=DDPG)
    assert asked == [(tmp_path / "run" / "replay.dat").stat().st_size]


def test_what_is_replayed(expert, tmp_path):
    """No value behind a crash, one behind a time-out; rewards times --reward-scale. Of Pendulum all that its games give again."""
    discounts = replayed(expert, 2 * 65 + 2 + 2)[:, 65 + 2 + 1]
    crashes = (expert / "episodes.csv").read_text().count("\n") - 1  # 1,600 steps of each car: too few for a time-out
    assert (discounts == 0).sum() == crashes > 0 and np.allclose(discounts[discounts > 0], 0.99)
    flags = ["--env-id", "Pendulum-v1", "--keep-best-every", 0, "--reward-scale", 0.1, "--buffer-size", 9_000]
    run(*SMALL_DDPG, *flags, "--run-dir", "run", cwd=tmp_path, script=DDPG)
    rows, episodes = replayed(tmp_path / "run", 9), ddpg.read_episodes(tmp_path / "run")
    assert np.allclose(rows[:, 5], 0.99) and len(episodes) == 40
    assert rows[:, 4].sum() == pytest.approx(0.1 * episodes[:, 1].sum(), rel=1e-4)
    assert len(rows) == 1_600 and 0.5 < np.abs(rows[:, 3]).max() <= 1  # actions as the actor gives them
    env = gym.make("Pendulum-v1")
    for i in range(5):
        for t, row in enumerate(rows[i::5]):
            if t % 40 == 0:  # an episode of 200 steps
                obs, _ = env.reset(seed=ddpg.episode_seed(1, i, t // 40))
            assert np.allclose(obs, row[:3], atol=1e-4)
            rewards = []
            for _ in range(5):
                obs, reward, *_ = env.step(2 * row[3:4])
                rewards.append(reward)
            assert np.allclose(obs, row[6:], atol=1e-4) and 0.1 * sum(rewards) == pytest.approx(row[4], abs=1e-3)


def test_the_normalization_is_of_all_observations_that_were_acted_on(expert):
    norm = torch.load(expert / "checkpoint.pt", weights_only=True)["norm"]
    obs = replayed(expert, 2 * 65 + 2 + 2)[:, :65].astype(np.float64)
    assert norm["count"] == len(obs) > 0
    expected = [obs.mean(0), np.maximum(obs.std(0), 0.1)]
    assert np.allclose(norm["scale"], expected, atol=1e-4)


def test_adam_gets_the_annealed_rates_of_actor_and_critic(tmp_path, monkeypatch):
    """Ten iterations of 20 updates."""
    rates, step = [], ddpg.adam_step
    at = lambda *its: rates.append((its[4][0].item(), its[4][-1].item())) or step(*its)  # noqa: E731
    monkeypatch.setattr(ddpg, "adam_step", at)
    flags = ["--total-timesteps", 1_000, "--keep-best-every", 0, "--run-dir", "run"]
    run(*SMALL_DDPG, *flags, cwd=tmp_path, script=DDPG)
    args, remaining = ddpg.Args(), np.repeat(1 - np.arange(10) / 10, 20)[:, None]
    assert np.allclose(rates, remaining * [args.actor_learning_rate, args.learning_rate], rtol=1e-5)


def test_the_experts_are_in_their_places(expert, tmp_path, monkeypatch):
    """The first, whose weight is α, is that of --demos-rl, the second the human."""
    seen = []
    monkeypatch.setattr(gail, "behaviour_cloning", lambda agent, experts, args: seen.append(experts))
    flags = ["--demos-rl", expert / "demos", "--total-timesteps", 0, "--run-dir", "run"]
    run(*SMALL_GAIL, *flags, cwd=tmp_path, script=GAIL)
    for expert_demos, folder in zip(seen[0], (expert / "demos", tmp_path / "run" / "demos_synthetic_human")):
        with np.load(folder / "episode_00000.npz") as arrays:
            first = arrays["actions"][::2].astype(np.float32).clip(-1, 1)
        assert np.allclose(expert_demos.actions[: len(first)], first)


def test_noise_is_drawn_and_adapted_when_it_should(tmp_path, monkeypatch):
    """Anew with each episode, and in all environments every 100 steps of 5; its size at every 50th update."""
    begun, adapted, noise = [], [], ddpg.ParameterNoise
    begin, adapt = noise.begin, noise.adapt
    monkeypatch.setattr(noise, "begin", lambda self, i: begun.append(i) or begin(self, i))
    monkeypatch.setattr(noise, "adapt", lambda self, obs: adapted.append(1) or adapt(self, obs))
    run(*SMALL_DDPG, "--keep-best-every", 0, "--run-dir", "run", cwd=tmp_path, script=DDPG)
    ended = len(ddpg.read_episodes(tmp_path / "run"))
    args = json.loads((tmp_path / "run" / "args.json").read_text())
    actions = args["total_timesteps"] // (args["num_envs"] * args["frame_skip"])
    assert len(begun) == 5 + ended + 5 * (actions // (100 // args["frame_skip"]))
    updates = args["train_steps"] * (args["total_timesteps"] // args["rollout_steps"])
    assert len(adapted) == math.ceil(updates / args["adapt_interval"]) > 1 and ended > 5


def test_evaluation_counts_metres_whatever_the_reward():
    games = ddpg.make_games(ddpg.Args(reward="speed"), 2)
    games.reset(seed=[1, 2])
    for _ in range(30):
        _, rewards, _, _, infos = games.step(np.full((2, 2), [0.0, 0.5]))
        assert np.array_equal(rewards, infos["progress"]) and (rewards < 2).all()
    assert rewards.min() > 0.01


def test_the_kl_bound_falls_and_the_discriminator_learns_every_third_time(expert, tmp_path, monkeypatch):
    bounds, rounds = [], []
    step, update = gail.trpo_step, gail.update_discriminator
    monkeypatch.setattr(gail, "trpo_step", lambda *its: bounds.append(its[2]) or step(*its))
    monkeypatch.setattr(gail, "update_discriminator", lambda *its: rounds.append(len(bounds)) or update(*its))
    flags = ["--demos-rl", expert / "demos", "--run-dir", "run"]
    run(*SMALL_GAIL, *flags, cwd=tmp_path, script=GAIL)
    args = gail.Args()
    assert np.allclose(bounds, args.max_kl * (1 - np.arange(20) / 20)) and args.g_steps == 3
    assert [number for number in rounds if number] == [3, 6, 9, 12, 15, 18]


def seeds_of(folder: Path) -> set[int]:
    """Of the demonstrations in a folder."""
    found = set()
    for path in folder.glob("*.npz"):
        with np.load(path) as arrays:
            found.add(int(arrays["seed"]))
    return found


def test_no_game_serves_two_purposes(student, tmp_path, monkeypatch):
    """Training, the choice of the policy, evaluation and demonstrations have episodes of their own; so has the student."""
    played, play = [], ddpg.play
    monkeypatch.setattr(ddpg, "play", lambda *its, **more: played.append(set(its[2])) or play(*its, **more))
    run(*SMALL_DDPG, "--save-demos", 2, "--run-dir", "run", cwd=tmp_path, script=DDPG)
    *chosen, scored, shown = played
    training = {ddpg.episode_seed(1, i, n) for i in range(5) for n in range(1_000)}
    for one, other in itertools.combinations((training, set().union(*chosen), scored, shown), 2):
        assert one and not one & other
    scored = set(json.loads((student / "evaluation.json").read_text())["seeds"])
    training = {gail.episode_seed(1, i, n) for i in range(4) for n in range(1_000)}
    others = (training, scored, seeds_of(student / "demos"), seeds_of(student / "demos_synthetic_human"))
    for one, other in itertools.combinations(others, 2):
        assert one and not one & other
