"""What a user can get wrong is one line and exit code 2, and nothing is created."""

import contextlib
import hashlib
import json
import math
import os
import pty
import shutil
import subprocess
import sys
import termios
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import safetensors.torch
import torch
from conftest import SCRIPT, SMALL, command, run

from cleanrl_thesis import ppo_continuous_kle as ppo

BAD = [
    (["--env-id", "NoSuchTask-v2"], ["--env-id", "NoSuchTask"]),
    (["--env-id", "kle/NoSuchTask-v2"], ["--env-id", "NoSuchTask"]),
    (["--env-id", "no_such_module:Task-v0"], ["--env-id", "no_such_module"]),
    (["--env-id", "CartPole-v1"], ["--env-id", "CartPole-v1", "Box actions", "Discrete"]),
    (["--kle-stop", "--kle-rollback"], ["--kle-stop", "--kle-rollback"]),
    (["--d-target", "0"], ["--d-target", "0.0", "greater than 0"]),
    (["--d-target", "-0.03"], ["--d-target", "-0.03", "greater than 0"]),
    (["--d-target", "nan"], ["--d-target", "nan"]),
    (["--target-kl", "0"], ["--d-target", "0.0"]),
    (["--d-target", "high"], ["--d-target", "high"]),
    (["--update-epochs", "0"], ["--update-epochs", "0", "at least 1"]),
    (["--num-minibatches", "31"], ["--num-minibatches", "31", "2048"]),
    (["--num-minibatches", "2048"], ["--num-minibatches", "2048", "at least 2"]),
    (["--num-envs", "3"], ["--num-envs", "3", "2048"]),
    (["--num-steps", "0"], ["--num-steps", "0", "at least 1"]),
    (["--num-envs", "0"], ["--num-envs", "0"]),
    (["--total-timesteps", "100"], ["--total-timesteps", "100", "2048"]),
    (["--learning-rate", "nan"], ["--learning-rate", "nan"]),
    (["--learning-rate", "inf"], ["--learning-rate", "inf"]),
    (["--value-learning-rate", "-1"], ["--value-learning-rate", "-1"]),
    (["--gamma", "1.5"], ["--gamma", "1.5", "between 0 and 1"]),
    (["--ent-coef", "nan"], ["--ent-coef", "nan"]),
    (["--seed", "-1"], ["--seed", "-1"]),
    (["--num-threads", "0"], ["--num-threads", "0", "between 1 and 1024"]),
    (["--num-threads", "99999999999"], ["--num-threads", "99999999999", "between 1 and 1024"]),
    (["--exp-name", "../elsewhere"], ["--exp-name", "../elsewhere"]),
    (["--stop-at", "0"], ["--stop-at", "0"]),
    (["--checkpoint-interval", "0"], ["--checkpoint-interval", "0"]),
    (["--kl-estimator", "k2"], ["--kl-estimator", "k2", "k3"]),
    (["--init-gains", "1", "nan", "1"], ["--init-gains", "nan"]),
    (["--no-such-flag"], ["--no-such-flag"]),
    (["--resume"], ["--resume", "--run-dir"]),
    (["--run-dir", "/proc/no/such/folder"], ["--run-dir", "/proc/no/such/folder"]),
]


def assert_refused(capsys, flags: list[str], words: list[str]) -> None:
    """Exit code 2, one line on stderr with the words, nothing on stdout."""
    assert ppo.cli(flags) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("error: "), err
    for word in words:
        assert word in err, err


@pytest.mark.parametrize("flags, words", BAD, ids=lambda value: " ".join(value) if value and value[0][0] == "-" else "")
def test_a_wrong_value_is_one_line_and_creates_nothing(flags, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert_refused(capsys, flags, words)
    assert list(tmp_path.iterdir()) == []


def test_a_wrong_value_has_no_traceback_in_a_shell(tmp_path):
    done = run("--d-target", 0, cwd=tmp_path, code=2)
    assert done.stderr == "error: --d-target 0.0: must be greater than 0 and finite\n" and done.stdout == ""
    assert list(tmp_path.iterdir()) == []


def test_a_missing_optional_package_is_named(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    for flag, module in (("--track", "wandb"), ("--capture-video", "moviepy")):
        monkeypatch.setitem(sys.modules, module, None)
        assert_refused(capsys, [flag], [flag, f"pip install {module}"])
    assert list(tmp_path.iterdir()) == []


def snapshot(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture
def copied_run(small_run, tmp_path) -> Path:
    shutil.copytree(small_run, tmp_path / "run")
    return tmp_path / "run"


def test_an_existing_folder_is_not_overwritten(copied_run, capsys):
    before = snapshot(copied_run)
    assert_refused(capsys, [*SMALL, "--run-dir", str(copied_run)], ["--run-dir", str(copied_run), "--resume"])
    assert snapshot(copied_run) == before


def test_a_resume_with_other_hyperparameters_names_them(copied_run, capsys):
    before = snapshot(copied_run)
    flags = [*SMALL, "--run-dir", str(copied_run), "--resume", "--gamma", "0.9", "--seed", "7"]
    assert_refused(capsys, flags, ["--gamma 0.9 (was 0.99)", "--seed 7 (was 1)"])
    assert snapshot(copied_run) == before


def foreign(folder: Path) -> None:
    import torch

    torch.save({"weights": torch.zeros(3)}, folder / "checkpoint.pt")


def pickled(folder: Path) -> None:
    import pickle

    (folder / "checkpoint.pt").write_bytes(pickle.dumps({"format": ppo.CHECKPOINT_FORMAT}))


def flipped(folder: Path) -> None:
    content = bytearray((folder / "checkpoint.pt").read_bytes())
    content[len(content) // 2] ^= 1
    (folder / "checkpoint.pt").write_bytes(content)


@pytest.mark.parametrize(
    "damage", [foreign, pickled, flipped, lambda folder: (folder / "checkpoint.pt").write_bytes(b"")]
)
def test_a_corrupt_or_foreign_checkpoint_is_refused(copied_run, capsys, damage):
    (copied_run / "result.json").unlink()
    (copied_run / "checkpoint.previous.pt").unlink()
    damage(copied_run)
    before = snapshot(copied_run)
    assert ppo.cli([*SMALL, "--run-dir", str(copied_run), "--resume"]) == 2
    assert "no whole checkpoint" in capsys.readouterr().err
    assert snapshot(copied_run) == before


def test_a_folder_of_something_else_is_refused(tmp_path, capsys):
    (tmp_path / "thesis.tex").write_text("x")
    assert_refused(capsys, [*SMALL, "--run-dir", str(tmp_path), "--resume"], ["--resume", str(tmp_path), "args.json"])
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.tex"]


def test_one_process_at_a_time_runs_in_a_folder(tmp_path, capsys):
    folder = tmp_path / "run"
    flags = [*SMALL, "--run-dir", str(folder)]
    process = subprocess.Popen(
        command(*flags, "--update-epochs", 200), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
    )
    try:
        while not (folder / "episodes.csv").exists():
            assert process.poll() is None
        assert_refused(capsys, [*flags, "--update-epochs", "200", "--resume"], ["--run-dir", "another process"])
    finally:
        process.kill()
        process.wait()


def test_help_lists_every_flag(capsys):
    with pytest.raises(SystemExit) as stop:
        ppo.cli(["--help"])
    assert stop.value.code == 0
    out = capsys.readouterr().out
    for flag in ("--kle-rollback", "--d-target", "--target-kl", "--capture-video", "--save-model", "Table 4.1"):
        assert flag in out


def test_a_run_leaves_what_the_readme_says(small_run):
    names = {path.name for path in small_run.iterdir()}
    assert names >= {
        "args.json", "episodes.csv", "updates.csv", "checkpoint.pt", "checkpoint.previous.pt", "model.safetensors",
        "evaluation.json", "learning_curve.png", "result.json", "demos",
    }  # fmt: skip
    assert any(name.startswith("events.out.tfevents") for name in names)
    updates = (small_run / "updates.csv").read_text().splitlines()
    assert len(updates) == 11 and updates[-1].startswith("2560,")
    assert "SPS" not in updates[0] and "time" not in updates[0]
    episodes = ppo.read_episodes(small_run)
    assert episodes[:, 2].tolist() == [200.0] * 12 and episodes[0, 0] == 200
    result = json.loads((small_run / "result.json").read_text())
    assert result["global_step"] == 2560
    assert result["training"]["mean"] == pytest.approx(episodes[:, 1].mean())
    assert (small_run / "learning_curve.png").read_bytes()[:4] == b"\x89PNG"


def test_evaluation_is_what_the_saved_model_does(small_run):
    """The file alone is the agent: load it, normalise as it says, act with the mean."""
    tensors = safetensors.torch.load_file(small_run / "model.safetensors")
    evaluation = json.loads((small_run / "evaluation.json").read_text())
    env = gym.make("Pendulum-v1")
    for seed, expected in zip(evaluation["seeds"], evaluation["returns"]):
        obs, _ = env.reset(seed=seed)
        total, done = 0.0, False
        while not done:
            x = ((obs - tensors["obs_mean"].numpy()) / tensors["obs_divisor"].numpy()).clip(-10, 10)
            for layer in (0, 2, 4):
                weight, bias = (tensors[f"actor_mean.{layer}.{name}"].numpy() for name in ("weight", "bias"))
                x = weight @ x + bias
                x = np.tanh(x) if layer < 4 else x
            obs, reward, terminated, truncated, _ = env.step(x.clip(-2, 2))
            total, done = total + reward, terminated or truncated
        assert total == pytest.approx(expected, rel=1e-4)
    assert evaluation["mode"] == "greedy" and evaluation["episodes"] == 2
    assert evaluation["mean"] == pytest.approx(np.mean(evaluation["returns"]))


def test_demonstrations_can_be_played_again_from_seed_and_actions(small_run):
    import hashlib

    manifest = json.loads((small_run / "demos" / "manifest.json").read_text())
    assert manifest["env_id"] == "Pendulum-v1" and len(manifest["files"]) == 2
    env = gym.make("Pendulum-v1")
    for name, checksum in manifest["files"].items():
        path = small_run / "demos" / name
        assert hashlib.sha256(path.read_bytes()).hexdigest() == checksum
        demo = np.load(path, allow_pickle=False)
        obs, _ = env.reset(seed=int(demo["seed"]))
        np.testing.assert_array_equal(obs, demo["observations"][0])
        for t, action in enumerate(demo["actions"]):
            obs, reward, terminated, truncated, _ = env.step(action)
            np.testing.assert_array_equal(obs, demo["observations"][t + 1])
            assert reward == demo["rewards"][t]
        assert terminated == demo["terminated"] and truncated == demo["truncated"]
        assert demo["t_ns"].shape == demo["rewards"].shape and (np.diff(demo["t_ns"]) > 0).all()


def test_no_gpu_is_said_and_no_reason_to_stop(tmp_path):
    done = run(*SMALL, "--cuda", "--run-dir", "run", cwd=tmp_path, CUDA_VISIBLE_DEVICES="")
    assert "--cuda: no GPU here" in done.stderr and (tmp_path / "run" / "result.json").exists()


def test_no_compiler_is_said_and_no_reason_to_stop(tmp_path, small_run):
    done = run(*SMALL, "--compile", "--run-dir", "run", cwd=tmp_path, CXX="no-such-compiler")
    assert "--compile: no C++ compiler" in done.stderr
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


def test_no_progress_bar_where_there_is_no_terminal(tmp_path):
    done = run(*SMALL, "--run-dir", "run", cwd=tmp_path)
    assert "%|" not in done.stderr and "evaluation (greedy)" in done.stdout


def test_a_progress_bar_on_a_terminal(tmp_path):
    master, slave = pty.openpty()
    termios.tcsetwinsize(slave, (24, 120))
    process = subprocess.Popen(command(*SMALL, "--run-dir", "run"), cwd=tmp_path, stdout=slave, stderr=slave)
    os.close(slave)
    shown = b""
    with contextlib.suppress(OSError):  # the terminal closes with the process
        while part := os.read(master, 4096):
            shown += part
    assert process.wait() == 0 and b"step/s" in shown and b"2560/2560" in shown


def test_compiled_run_through_the_command_line(small_run, tmp_path):
    if shutil.which("g++") is None:
        pytest.skip("needs a C++ compiler")
    done = run(*SMALL, "--compile", "--save-model", "--stop-at", 512, "--run-dir", "run", cwd=tmp_path)
    assert "--compile" not in done.stderr
    plain, compiled = (
        np.loadtxt(folder / "updates.csv", delimiter=",", skiprows=1, max_rows=2)
        for folder in (small_run, tmp_path / "run")
    )
    np.testing.assert_allclose(compiled, plain, rtol=0.02, atol=2e-3)
    assert set(safetensors.torch.load_file(tmp_path / "run" / "model.safetensors")) >= {"actor_logstd", "obs_mean"}


def test_a_broken_compiler_is_said_and_no_reason_to_stop(tmp_path, small_run):
    """One that is there but fails."""
    cache = {"TORCHINDUCTOR_CACHE_DIR": str(tmp_path / "cache"), "CXX": "false"}
    done = run(*SMALL, "--compile", "--run-dir", "run", cwd=tmp_path, **cache)
    assert "--compile: failed" in done.stderr
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


def test_learning_rate_anneals_to_zero(small_run, tmp_path):
    rates = np.loadtxt(small_run / "updates.csv", delimiter=",", skiprows=1)[:, 1]
    np.testing.assert_allclose(rates, 3e-4 * np.linspace(1, 0.1, 10))
    run(*SMALL, "--no-anneal-lr", "--stop-at", 512, "--run-dir", "run", cwd=tmp_path)
    assert (np.loadtxt(tmp_path / "run" / "updates.csv", delimiter=",", skiprows=1)[:, 1] == 3e-4).all()


def test_video(tmp_path):
    run(*SMALL, "--capture-video", "--run-dir", "run", cwd=tmp_path, SDL_VIDEODRIVER="dummy")
    (video,) = (tmp_path / "run" / "videos").glob("*.mp4")
    assert video.stat().st_size > 1000


def test_weights_and_biases_offline(tmp_path):
    pytest.importorskip("wandb")
    run(*SMALL, "--track", "--run-dir", "run", cwd=tmp_path, WANDB_MODE="offline", WANDB_SILENT="true")
    assert list((tmp_path / "run" / "wandb").glob("offline-run-*/*.wandb"))


def test_weights_and_biases_without_a_login_is_one_line_and_loses_no_result(copied_run, tmp_path):
    pytest.importorskip("wandb")
    flags = [*SMALL, "--track", "--run-dir", copied_run, "--resume", "--eval-episodes", 3]
    home = {"HOME": str(tmp_path), "WANDB_API_KEY": "", "WANDB_MODE": "online"}
    done = run(*flags, cwd=tmp_path, code=2, **home)
    assert done.stderr.startswith("error: --track: ") and done.stderr.count("\n") == 1
    assert (copied_run / "result.json").exists()


def test_a_run_that_did_not_begin_can_be_sent_again(tmp_path):
    """Without --resume too: there is nothing to lose but `args.json`."""
    pytest.importorskip("wandb")
    home = {"HOME": str(tmp_path), "WANDB_API_KEY": "", "WANDB_MODE": "online"}
    run(*SMALL, "--track", "--run-dir", "run", cwd=tmp_path, code=2, **home)
    assert {path.name for path in (tmp_path / "run").iterdir()} <= {"args.json", "wandb"}
    run(*SMALL, "--stop-at", 256, "--run-dir", "run", cwd=tmp_path)
    assert (tmp_path / "run" / "result.json").exists()


def test_parameters_that_explode_end_the_run(tmp_path):
    flags = [*SMALL, "--learning-rate", 1e30, "--max-grad-norm", "inf", "--run-dir", "run"]
    done = run(*flags, cwd=tmp_path, code=1)
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


def test_too_little_memory_is_one_line(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ppo, "Agent", lambda *its: torch.empty(2**60))
    assert ppo.cli([*SMALL, "--run-dir", "run"]) == 1
    err = capsys.readouterr().err
    assert err.count("\n") == 1 and err.startswith("error: not enough memory: "), err


def test_another_error_of_torch_is_a_bug_and_keeps_its_traceback(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(ppo, "Agent", lambda *its: torch.empty(2) + torch.empty(3))
    with pytest.raises(RuntimeError, match="size of tensor"):
        ppo.cli([*SMALL, "--run-dir", "run"])


def test_the_digest_is_of_the_script_that_ran(tmp_path):
    """And not of what the file has become when the run ends."""
    script = tmp_path / "ppo_continuous_kle.py"
    shutil.copy(SCRIPT, script)
    digest = hashlib.sha256(script.read_bytes()).hexdigest()
    process = subprocess.Popen(command(*SMALL, "--run-dir", "run", script=script), cwd=tmp_path, stdout=subprocess.PIPE)
    assert process.stdout.readline() == b"run\n"  # the script has been read
    script.write_text(script.read_text() + "\n")
    assert process.wait(timeout=300) == 0
    assert json.loads((tmp_path / "run" / "result.json").read_text())["script_sha256"] == digest


def test_a_name_may_hold_the_word_infinity(tmp_path):
    args = ppo.Args(exp_name="ToInfinity", run_dir=tmp_path / "Infinity", max_grad_norm=math.inf)
    written = ppo.arguments(args)
    assert written["exp_name"] == "ToInfinity" and written["run_dir"] == str(tmp_path / "Infinity")
    assert written["max_grad_norm"] == "inf"


def test_tensorboard_has_what_the_csv_has(small_run):
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(small_run), size_guidance={"scalars": 0}).Reload()
    header, *rows = (line.split(",") for line in (small_run / "updates.csv").read_text().splitlines())
    for column, name in enumerate(header[1:], 1):
        values = [event.value for event in events.Scalars(name)]
        np.testing.assert_allclose(values, [float(row[column]) for row in rows], rtol=1e-6)
    assert len(events.Scalars("charts/SPS")) == len(rows)
    evaluation = json.loads((small_run / "evaluation.json").read_text())
    assert events.Scalars("eval/episodic_return_mean")[0].value == pytest.approx(evaluation["mean"], rel=1e-6)
    assert len(events.Scalars("charts/episodic_return")) == 12


def test_several_environments_share_the_batch(tmp_path):
    flags = ["--env-id", "Pendulum-v1", "--total-timesteps", 4096, "--num-envs", 4, "--eval-episodes", 1]
    run(*flags, "--run-dir", "run", cwd=tmp_path)
    args = json.loads((tmp_path / "run" / "args.json").read_text())
    assert (args["num_steps"], args["batch_size"], args["minibatch_size"]) == (512, 2048, 64)
    returns = ppo.read_episodes(tmp_path / "run")[:, 1]
    assert len(returns) == 4 * (1024 // 200) and len(set(returns)) == len(returns)


def test_adam_gets_the_annealed_rates(tmp_path, monkeypatch):
    """Not only the record: ten iterations of two epochs of eight minibatches."""
    rates, step = [], ppo.adam_step
    monkeypatch.setattr(ppo, "adam_step", lambda *its: rates.append(its[4].max().item()) or step(*its))
    run(*SMALL, "--run-dir", "run", cwd=tmp_path)
    args = json.loads((tmp_path / "run" / "args.json").read_text())
    assert np.allclose(rates, np.repeat(args["learning_rate"] * (1 - np.arange(10) / 10), 16), rtol=1e-5)


def test_the_agent_has_the_statistics_of_its_collector(small_run):
    state = torch.load(small_run / "checkpoint.pt", weights_only=True)
    mean = state["collector"]["obs_stats"]["mean"]
    assert np.allclose(state["agent"]["obs_mean"], mean) and np.abs(mean).max() > 1e-3


def test_evaluation_plays_no_episode_of_the_training(small_run):
    scored = set(json.loads((small_run / "evaluation.json").read_text())["seeds"])
    assert scored and not scored & {ppo.episode_seed(1, 0, n) for n in range(1_000)}
