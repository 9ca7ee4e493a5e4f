"""dqn_apple.py and distill_hybrid.py through the command line: runs, resumes, and what a user can get wrong."""

import csv
import json
import shutil
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import safetensors
import safetensors.torch
import torch
from conftest import (
    ROOT,
    assert_refused,
    command,
    edit_manifest,
    flip_a_byte,
    kill_twice,
    needs_compiler,
    rewrite,
    run,
    sign,
)
from scipy import stats

from cleanrl_thesis import distill_hybrid as distill
from cleanrl_thesis import dqn_apple as dqn

DQN, DISTILL = ROOT / "cleanrl_thesis" / "dqn_apple.py", ROOT / "cleanrl_thesis" / "distill_hybrid.py"
SMALL_DQN = [
    *("--total-timesteps", 12_000, "--buffer-size", 3_000, "--batch-size", 16, "--checkpoint-interval", 1_000),
    *("--eval-episodes", 3, "--n-step", 2),
]
SMALL_DISTILL = [
    *("--demo-frames", 3_000, "--test-frames", 500, "--epochs", 40, "--hidden-size", 32, "--eval-episodes", 3),
    *("--checkpoint-interval", 1),
]


@pytest.fixture(scope="session")
def teacher(tmp_path_factory) -> Path:
    """An undisturbed small run of the DQN."""
    folder = tmp_path_factory.mktemp("dqn")
    run(*SMALL_DQN, "--run-dir", "run", "--save-model", "--save-demos", 2, cwd=folder, script=DQN)
    return folder / "run"


@pytest.fixture(scope="session")
def student(tmp_path_factory, teacher) -> Path:
    """An undisturbed small run of the hybrid."""
    folder = tmp_path_factory.mktemp("distill")
    flags = ["--teacher", teacher, "--run-dir", "run", "--save-model", "--save-demos", 2]
    run(*SMALL_DISTILL, *flags, cwd=folder, script=DISTILL)
    return folder / "run"


def assert_same_run(left: Path, right: Path, names: tuple[str, ...]) -> None:
    """Same bytes in the records, same tensors in the checkpoints."""
    for name in names:
        assert (left / name).read_bytes() == (right / name).read_bytes(), name
    states = [torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (left, right)]
    part = "optimizer" if "optimizer" in states[0] else "update"
    for name, value in states[0][part].items():
        assert torch.equal(value, states[1][part][name]), name


DQN_RECORDS, DISTILL_RECORDS = ("episodes.csv", "updates.csv", "evaluation.json"), ("updates.csv", "evaluation.json")


def rows(path: Path) -> int:
    return path.read_bytes().count(b"\n") if path.exists() else 0


def kill(script: Path, flags: list, folder: Path, number: int, watched: str, at_row: int) -> None:
    """Start or resume a run and send it a signal once a file has `at_row` rows."""
    line = command(*flags, "--run-dir", folder, "--resume", script=script)
    process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    while process.poll() is None and rows(folder / watched) < at_row:
        time.sleep(0.002)
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    assert process.returncode == (-number if number == signal.SIGKILL else 128 + number), out


@pytest.mark.parametrize(
    "extra", [[], ["--num-envs", 2, "--frame-skip", 3, "--total-timesteps", 18_000]], ids=["one", "two"]
)
def test_a_killed_dqn_ends_with_the_same_bytes(extra, teacher, tmp_path):
    """Killed in mid-episode, hundreds of frames after a checkpoint: the replay file has been written on."""
    flags = [*SMALL_DQN, *extra]
    whole = teacher
    if extra:
        run(*flags, "--run-dir", "whole", cwd=tmp_path, script=DQN)
        whole = tmp_path / "whole"
    for at_row in (3, 5):
        kill(DQN, flags, tmp_path / "run", signal.SIGKILL, "episodes.csv", at_row)
    kill(DQN, flags, tmp_path / "run", signal.SIGTERM, "episodes.csv", 6)
    done = run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path, script=DQN)
    assert "differs" not in done.stderr
    assert_same_run(whole, tmp_path / "run", DQN_RECORDS)


def test_a_dqn_with_a_torn_checkpoint_finds_its_replay_buffer(teacher, tmp_path):
    """The checkpoint before the newest is an interval behind what was written into the ring."""
    shutil.copytree(teacher, tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(path.read_bytes()[:1000])
    (tmp_path / "run" / "result.json").unlink()
    done = run(*SMALL_DQN, "--run-dir", "run", "--resume", cwd=tmp_path, script=DQN)
    assert "torn" in done.stderr
    assert_same_run(teacher, tmp_path / "run", DQN_RECORDS)


def test_a_killed_student_ends_with_the_same_bytes(student, teacher, tmp_path):
    flags = [*SMALL_DISTILL, "--teacher", teacher]
    for at_row in (4, 10):
        kill(DISTILL, flags, tmp_path / "run", signal.SIGKILL, "updates.csv", at_row)
    kill(DISTILL, flags, tmp_path / "run", signal.SIGINT, "updates.csv", 22)
    run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path, script=DISTILL)
    assert_same_run(student, tmp_path / "run", DISTILL_RECORDS)


@needs_compiler
@pytest.mark.parametrize("script, flags", [(DQN, SMALL_DQN), (DISTILL, [*SMALL_DISTILL, "--alpha", 0])])
def test_compiled_through_the_command_line(script, flags, tmp_path):
    done = run(*flags, "--compile", "--run-dir", "run", cwd=tmp_path, script=script)
    assert "--compile" not in done.stderr
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["arithmetic"].lower().startswith("compiled")


def test_a_plain_run_says_so(teacher, student):
    states = [torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (teacher, student)]
    assert [state["arithmetic"] for state in states] == ["PlainUpdate on cpu", "plain, float32 on cpu"]


def test_updates_and_target_network_come_when_they_should(teacher, tmp_path):
    """One update per 4 frames from frame 1,000 on; the target network is the network of the last multiple of 500."""
    with open(teacher / "updates.csv", newline="") as file:
        assert sum(int(row["charts/updates"]) for row in csv.DictReader(file)) == (12_000 - 1_000) // 4 + 1
    states = []
    for stop_at in (11_500, 11_700):
        run(*SMALL_DQN, "--stop-at", stop_at, "--run-dir", "run", "--resume", cwd=tmp_path, script=DQN)
        states.append(torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["optimizer"])
    assert torch.equal(states[1]["target"], states[0]["vector"])
    assert not torch.equal(states[1]["target"], states[1]["vector"])


def test_the_network_with_the_best_test_accuracy_is_kept_and_the_last_one_evaluated_too(teacher, tmp_path):
    flags = [*SMALL_DISTILL, "--teacher", teacher, "--learning-rate", 0.1, "--epochs", 12, "--save-model"]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=DISTILL)
    with open(tmp_path / "run" / "updates.csv", newline="") as file:
        accuracies = [float(row["test/accuracy"]) for row in csv.DictReader(file)]
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    assert state["best"]["epoch"] == 1 + int(np.argmax(accuracies)) < 12
    evaluation = json.loads((tmp_path / "run" / "evaluation.json").read_text())
    kept = safetensors.torch.load_file(tmp_path / "run" / "model.safetensors")
    student = distill.Student((6,), 9, 32)
    vectors = {"": state["best"]["vector"], "last_": state["update"]["vector"]}
    for name, vector in vectors.items():
        shapes = [parameter.shape for parameter in student.parameters()]
        tensors = dict(zip([key for key, _ in student.named_parameters()], distill.views(vector, shapes)))
        assert name == "last_" or all(torch.equal(kept[key], tensors[key]) for key in tensors)
        student.load_state_dict(tensors)
        episodes = distill.play(distill.numpy_policy(student, "greedy", 1), "AppleGame-v0", evaluation["seeds"])
        assert [episode["rewards"].sum() for episode in episodes] == evaluation[name + "greedy"]["returns"]


def test_copied_alone_into_an_empty_folder(student, teacher, tmp_path):
    for script in (DQN, DISTILL):
        shutil.copy(script, tmp_path)
    run(*SMALL_DQN, "--run-dir", "dqn", cwd=tmp_path, script=tmp_path / DQN.name, PYTHONSAFEPATH="1")
    flags = [*SMALL_DISTILL, "--teacher", teacher, "--run-dir", "student"]
    run(*flags, cwd=tmp_path, script=tmp_path / DISTILL.name, PYTHONSAFEPATH="1")
    assert (tmp_path / "dqn" / "updates.csv").read_bytes() == (teacher / "updates.csv").read_bytes()
    assert (tmp_path / "student" / "updates.csv").read_bytes() == (student / "updates.csv").read_bytes()


def test_runs_leave_what_the_readme_says(teacher, student):
    shared = {"args.json", "checkpoint.pt", "checkpoint.previous.pt", "evaluation.json", "learning_curve.png"}
    shared |= {"model.safetensors", "result.json", "updates.csv", "demos"}
    events = {path.name for path in (*teacher.iterdir(), *student.iterdir()) if "tfevents" in path.name}
    assert {path.name for path in teacher.iterdir()} - events == {*shared, "episodes.csv", "replay.dat"}
    assert {path.name for path in student.iterdir()} - events == {*shared, "demos_synthetic_human"}


@pytest.mark.parametrize("kind", ["teacher", "student"])
def test_demonstrations_can_be_played_again_and_read(kind, request):
    folder = request.getfixturevalue(kind) / "demos"
    for episode, path in zip(distill.read_demonstrations(folder, "AppleGame-v0", 10**9), sorted(folder.glob("*.npz"))):
        with np.load(path, allow_pickle=False) as arrays:
            seed, times, rewards = int(arrays["seed"]), arrays["t_ns"], arrays["rewards"]
        env = dqn.make_env("AppleGame-v0")
        obs = [env.reset(seed=seed)[0]]
        for action, reward in zip(episode["actions"], rewards):
            step = env.step(action)
            obs.append(step[0])
            assert step[1] == reward
        assert np.array_equal(obs, episode["observations"]) and step[3]
        assert len(times) == 1800 and times[60] == pytest.approx(1e9, abs=100)


def test_a_dqn_of_another_environment(tmp_path):
    flags = ["--env-id", "CartPole-v1", "--total-timesteps", 3000, "--eval-episodes", 2, "--capture-video"]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=DQN)
    assert len(list((tmp_path / "run" / "videos").glob("*.mp4"))) == 1
    assert json.loads((tmp_path / "run" / "result.json").read_text())["complete"]


@pytest.mark.parametrize("method", [dqn, distill], ids=["dqn", "distill"])
def test_environments_without_a_render_mode_and_with_odd_infos_are_evaluated(method, moody):
    episodes = method.play(lambda obs: np.zeros(4, int), moody[1], [1, 2, 3, 4], keep=True)
    assert [episode["rewards"].sum() for episode in episodes] == [4] * 4
    assert episodes[3]["observations"].ravel().tolist() == [0, 1, 2, 3, 4]


def test_the_game_by_its_full_name(tmp_path):
    name = ["--env-id", "cleanrl_thesis.dqn_apple:AppleGame-v0", "--run-dir", "run"]
    run(*SMALL_DQN[:-4], *name, "--total-timesteps", 2000, "--eval-episodes", 2, cwd=tmp_path, script=DQN)
    flags = [*SMALL_DISTILL, "--alpha", 0, "--epochs", 1, *name[:2], "--run-dir", "student"]
    run(*flags, cwd=tmp_path, script=DISTILL)
    assert all((tmp_path / name / "result.json").exists() for name in ("run", "student"))


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"short")])
def test_a_lost_replay_buffer_is_not_taken_for_an_empty_one(damage, teacher, tmp_path):
    run(*SMALL_DQN, "--stop-at", 3_000, "--run-dir", "run", cwd=tmp_path, script=DQN)
    damage(tmp_path / "run" / "replay.dat")
    done = run(*SMALL_DQN, "--run-dir", "run", "--resume", cwd=tmp_path, script=DQN, code=1)
    assert "replay.dat" in done.stderr and done.stderr.count("\n") == 1
    assert (tmp_path / "run" / "result.json").exists()


def test_a_finished_run_is_evaluated_anew_without_its_replay_buffer(teacher, tmp_path):
    shutil.copytree(teacher, tmp_path / "run")
    (tmp_path / "run" / "replay.dat").unlink()
    run(
        *SMALL_DQN[:-4], *SMALL_DQN[-2:], "--eval-episodes", 4, "--run-dir", "run", "--resume", cwd=tmp_path, script=DQN
    )
    assert json.loads((tmp_path / "run" / "result.json").read_text())["evaluation"]["episodes"] == 4


def test_stop_at_and_going_on_is_one_run(teacher, tmp_path):
    run(*SMALL_DQN, "--stop-at", 7_321, "--run-dir", "run", cwd=tmp_path, script=DQN)
    run(*SMALL_DQN, "--run-dir", "run", "--resume", cwd=tmp_path, script=DQN)
    assert_same_run(teacher, tmp_path / "run", DQN_RECORDS)


@pytest.mark.parametrize("flags", [["--states", "own", "--alpha", 0.5], ["--split", "episode", "--temperature", 0]])
def test_the_other_ways_to_learn(flags, teacher, tmp_path):
    run(*SMALL_DISTILL, "--teacher", teacher, *flags, "--run-dir", "run", cwd=tmp_path, script=DISTILL)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["evaluation"]["sampled"]["episodes"] == 3


def test_recorded_demonstrations_are_those_that_are_learned_from(student, teacher, tmp_path):
    """The synthetic human's folder given as a recording leads to the same student."""
    flags = [*SMALL_DISTILL, "--teacher", teacher, "--demos", student / "demos_synthetic_human", "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=DISTILL)
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (student / "updates.csv").read_bytes()


def test_the_report_takes_whatever_is_done(teacher, student, tmp_path):
    """Of one seed; a temperature of the quick human's students that the others do not have."""
    shutil.copytree(teacher, tmp_path / "runs" / "teacher_seed1")
    shutil.copytree(student, tmp_path / "runs" / "alpha0.93_seed1")
    flags = [*SMALL_DISTILL, "--teacher", teacher, "--epochs", 2, "--save-model"]
    for name, *more in (
        ("alpha0.0", "--alpha", 0),
        ("alpha0.7", "--alpha", 0.7),
        ("alpha1.0", "--alpha", 1),
        ("quick_T0.5_alpha0.7", "--alpha", 0.7, "--temperature", 0.5),
        ("own_alpha0.93", "--states", "own"),
    ):
        run(*flags, *more, "--run-dir", tmp_path / "runs" / f"{name}_seed1", cwd=tmp_path, script=DISTILL)
    script = ROOT / "benchmark" / "apple_report.py"
    run("--runs", "runs", "--out", "out", "--likeness-episodes", 2, cwd=tmp_path, script=script)
    text = (tmp_path / "out" / "table.md").read_text()
    result = json.loads((teacher / "result.json").read_text())
    assert f"| DQN | greedy | 1 | {result['evaluation']['max']:.1f} |" in text
    assert "| DQN | **published** | 1 | 53 | 15 | 36.27 | 5.44 |" in text
    assert "nan" not in text and "| α = 0.93, greedy | 1 |" in text
    assert (tmp_path / "out" / "fig_2_4.png").stat().st_size > 10_000
    with open(tmp_path / "out" / "runs.csv", newline="") as file:
        assert len(list(csv.DictReader(file))) == 1 + 6 * 4


# What a user can get wrong
def no_archive(folder: Path) -> None:
    (folder / "episode_00000.npz").write_bytes(b"no archive")
    sign(folder, folder / "episode_00000.npz")


def pickled(folder: Path) -> None:
    rewrite(folder, lambda arrays: {**arrays, "actions": np.array([{"an": "object"}], object)})


def empty(folder: Path) -> None:
    for path in folder.iterdir():
        path.unlink()


@pytest.mark.parametrize(
    "damage, words",
    [
        (empty, ["no readable manifest.json"]),
        (lambda folder: edit_manifest(folder, lambda m: m.update(files={})), ["names no file"]),
        (lambda folder: edit_manifest(folder, lambda m: m.update(version=2)), ["version 2"]),
        (
            lambda folder: edit_manifest(folder, lambda m: m.update(env_id="ALE/Gopher-v5")),
            ["ALE/Gopher-v5", "AppleGame-v0"],
        ),
        (lambda folder: (folder / "episode_00000.npz").unlink(), ["episode_00000.npz", "cannot be read"]),
        (flip_a_byte, ["episode_00000.npz", "SHA-256"]),
        (no_archive, ["episode_00000.npz", "no demonstration"]),
        (pickled, ["episode_00000.npz", "no demonstration"]),
        (lambda f: rewrite(f, lambda a: {**a, "observations": a["observations"][:, :5]}), ["(T + 1, 6)", "(1801, 5)"]),
        (lambda f: rewrite(f, lambda a: {**a, "observations": a["observations"][:-1]}), ["(T + 1, 6)", "(1800, 6)"]),
        (lambda f: rewrite(f, lambda a: {**a, "observations": a["observations"] * np.nan}), ["finite"]),
        (lambda f: rewrite(f, lambda a: {**a, "actions": a["actions"] + 5}), ["actions", "from 0 to 8"]),
        (lambda f: rewrite(f, lambda a: {**a, "actions": a["actions"] * 0.5}), ["actions", "whole numbers"]),
        (lambda f: rewrite(f, lambda a: {k: v for k, v in a.items() if k != "actions"}), ["no demonstration"]),
        (lambda f: rewrite(f, lambda a: {**a, "rewards": a["rewards"] * np.nan}), ["rewards", "finite"]),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_a_wrong_demonstration_is_named(damage, words, student, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(student / "demos", "demos")
    damage(Path("demos"))
    flags = ["--alpha", 0, "--demos", "demos", "--demo-frames", 3000, "--run-dir", "run"]
    assert_refused(distill, capsys, flags, ["--demos demos", *words])
    assert not Path("run").exists()


def test_too_few_demonstrations_are_named(student, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert_refused(distill, capsys, ["--alpha", 0, "--demos", student / "demos"], ["--demo-frames 16000", "3600"])


def test_a_teacher_of_another_game_is_named(teacher, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    tensors = safetensors.torch.load_file(teacher / "model.safetensors")
    for metadata, words in (
        (
            {"args": json.dumps({"env_id": "ALE/Gopher-v5", "dueling": True, "frame_skip": 4})},
            ["ALE/Gopher-v5", "AppleGame-v0"],
        ),
        (
            {"args": json.dumps({"env_id": "AppleGame-v0", "dueling": False, "hidden_size": 64, "frame_skip": 1})},
            ["another shape"],
        ),
        ({"args": json.dumps({"env_id": "AppleGame-v0", "frame_skip": 4})}, ["once in 4 frames"]),
        ({}, ["no model of dqn_apple.py"]),
    ):
        safetensors.torch.save_file(tensors, "model.safetensors", metadata)
        assert_refused(distill, capsys, ["--teacher", ".", "--run-dir", "run"], ["--teacher", *words])
    Path("model.safetensors").write_bytes(b"no model")
    assert_refused(distill, capsys, ["--teacher", ".", "--run-dir", "run"], ["--teacher", "no model of dqn_apple.py"])
    assert not Path("run").exists()


@pytest.mark.parametrize(
    "kind, module, flags",
    [("teacher", dqn, [*SMALL_DQN, "--gamma", 0.9]), ("student", distill, [*SMALL_DISTILL, "--alpha", 0])],
)
def test_a_resume_with_other_hyperparameters_names_them(kind, module, flags, request, tmp_path, capsys):
    shutil.copytree(request.getfixturevalue(kind), tmp_path / "run")
    flag, value = flags[-2:]
    assert_refused(
        module, capsys, [*flags, "--run-dir", tmp_path / "run", "--resume"], [f"{flag} {float(value)}", "was"]
    )


def test_a_resume_with_other_demonstrations_is_refused(student, tmp_path):
    demos, flags = tmp_path / "demos", [*SMALL_DISTILL, "--alpha", 0, "--demos", "demos", "--run-dir", "run"]
    shutil.copytree(student / "demos_synthetic_human", demos)
    run(*flags, cwd=tmp_path, script=DISTILL)
    rewrite(demos, lambda arrays: {**arrays, "actions": 8 - arrays["actions"]})
    done = run(*flags, "--resume", "--eval-episodes", 4, cwd=tmp_path, script=DISTILL, code=2)
    assert "--resume" in done.stderr and "demonstrations" in done.stderr and done.stderr.count("\n") == 1


def test_a_resume_with_another_teacher_is_refused(student, teacher, tmp_path):
    shutil.copytree(student, tmp_path / "run")
    flags = [*SMALL_DISTILL, "--teacher", teacher, "--run-dir", "run", "--resume", "--eval-episodes", 4]
    run(*flags, cwd=tmp_path, script=DISTILL)
    model = safetensors.torch.load_file(teacher / "model.safetensors")
    with safetensors.safe_open(teacher / "model.safetensors", "pt") as file:
        metadata = file.metadata()
    model["advantage.bias"] += 1.0 * torch.arange(9)
    original = (teacher / "model.safetensors").read_bytes()
    try:
        safetensors.torch.save_file(model, teacher / "model.safetensors", metadata)
        done = run(*flags[:-1], 5, cwd=tmp_path, script=DISTILL, code=2)
    finally:
        (teacher / "model.safetensors").write_bytes(original)
    assert "--resume" in done.stderr and "teacher" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("kind", ["teacher", "student"])
def test_runs_killed_at_random_end_with_the_same_bytes(kind, teacher, tmp_path):
    """Each is killed twice, at any moment behind a checkpoint, every other one first in its first 3 s; half are compiled."""
    script, plain, records = {
        "teacher": (DQN, SMALL_DQN, DQN_RECORDS),
        "student": (DISTILL, [*SMALL_DISTILL, "--teacher", teacher], DISTILL_RECORDS),
    }[kind]
    flags, seconds = {"plain": plain, "compiled": [*plain, "--compile"]}, {}
    for name in flags:
        run(*flags[name], "--run-dir", name, cwd=tmp_path, script=script)
        seconds[name] = json.loads((tmp_path / name / "result.json").read_text())["training_seconds"]

    def kill_and_resume(number: int) -> None:
        name = ("plain", "compiled")[number // 3]
        folder = tmp_path / f"run{number}"
        kill_twice(
            [*flags[name], "--run-dir", folder], seconds[name], number, script, after_checkpoints=True, share=0.5
        )
        run(*flags[name], "--run-dir", f"run{number}", "--resume", cwd=tmp_path, script=script)
        assert_same_run(tmp_path / name, tmp_path / f"run{number}", records)

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(kill_and_resume, range(6)))


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_a_teacher_and_its_student_play_well(tmp_path):
    """A tenth of the budget: the DQN near the shortest path (36), the student of hard labels far above a human's 19.

    In six seeds a greedy student has 25 to 34 apples, for it is caught between two of them in some episodes, and a
    sampled one 29 to 34.
    """
    flags = ["--total-timesteps", 800_000, "--compile", "--save-model", "--run-dir", "teacher"]
    run(*flags, cwd=tmp_path, script=DQN)
    flags = [
        "--teacher",
        "teacher",
        "--alpha",
        1,
        "--temperature",
        0,
        "--epochs",
        40,
        "--compile",
        "--run-dir",
        "student",
    ]
    run(*flags, cwd=tmp_path, script=DISTILL)
    results = [
        json.loads((tmp_path / name / "result.json").read_text())["evaluation"] for name in ("teacher", "student")
    ]
    assert results[0]["mean"] > 30
    assert results[1]["greedy"]["mean"] > 21
    assert results[1]["sampled"]["mean"] > 25


def test_what_is_tested_on_is_not_trained_on(tmp_path, monkeypatch):
    trained, tested, shares = [], [], set()
    epoch, measure, draw = distill.train_epoch, distill.measure, distill.draw_masks
    monkeypatch.setattr(distill, "train_epoch", lambda *its: trained.append((its[1].he_obs, its[2])) or epoch(*its))
    monkeypatch.setattr(distill, "measure", lambda *its: tested.append(its[1].he_obs) or measure(*its))
    monkeypatch.setattr(distill, "draw_masks", lambda shape, share: shares.add(share) or draw(shape, share))
    run(*SMALL_DISTILL, "--alpha", 0, "--epochs", 1, "--run-dir", "run", cwd=tmp_path, script=DISTILL)
    obs, indices = trained[0]
    assert len(tested[0]) == 500 and len(indices) == 2_500 and shares == {0.5}

    def frames(x: torch.Tensor) -> list[bytes]:
        return sorted(row.tobytes() for row in x.numpy())

    assert frames(torch.cat([obs[indices], tested[0]])) == frames(obs)


@pytest.mark.parametrize("script", [DQN, DISTILL], ids=["dqn", "distill"])
def test_parameters_that_explode_end_the_run(script, teacher, tmp_path):
    flags = SMALL_DQN if script == DQN else [*SMALL_DISTILL, "--teacher", teacher]
    done = run(*flags, "--learning-rate", 1e30, "--run-dir", "run", cwd=tmp_path, code=1, script=script)
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


def test_adam_gets_the_annealed_rates_and_three_tenths_are_explored(tmp_path, monkeypatch):
    """Not only the record: an update each 4 frames from frame 1,000 on, and the network's action unless ε is drawn."""
    rates, played, step, act = [], [], dqn.adam_step, dqn.Player.step
    monkeypatch.setattr(dqn, "adam_step", lambda *its: rates.append(its[4].item()) or step(*its))
    monkeypatch.setattr(dqn.Player, "step", lambda its, action, to: played.append(action) or act(its, action, to))
    monkeypatch.setattr(dqn, "numpy_greedy", lambda agent: lambda obs: np.full(len(obs), 5))
    flags = ["--total-timesteps", 3_000, "--start-e", 0.3, "--end-e", 0.3, "--run-dir", "run"]
    run(*SMALL_DQN, *flags, cwd=tmp_path, script=DQN)
    assert np.allclose(rates, 5e-4 * (1 - np.arange(999, 3_000, 4) / 3_000), rtol=1e-5)
    counts = np.bincount(played, minlength=9)
    assert counts.sum() == 3_000 and stats.chisquare(counts, 3_000 * (0.7 * np.eye(9)[5] + 0.3 / 9)).pvalue > 0.001


def test_a_linear_schedule_at_a_few_frames():
    frames = (0, 1, 500, 999, 1_000, 5_000)
    expected = [1, 1 - 0.9 / 1_000, 0.55, 0.1 + 0.9 / 1_000, 0.1, 0.1]
    assert [dqn.linear_schedule(1.0, 0.1, 1_000, t) for t in frames] == pytest.approx(expected)
    assert dqn.linear_schedule(1.0, 0.1, 0, 0) == 0.1


def test_exploration_of_the_dqn_falls_over_its_share(tmp_path, monkeypatch):
    """And with ε = 1 the network is never asked."""
    asked, schedule = [], dqn.linear_schedule
    monkeypatch.setattr(dqn, "linear_schedule", lambda *its: asked.append(its) or schedule(*its))
    flags = ["--total-timesteps", 3_000, "--start-e", 1, "--end-e", 1, "--run-dir", "run"]

    def never(agent):
        def ask(obs):
            assert (tmp_path / "run" / "episodes.csv").exists() and len(obs) > 1, "asked in training"
            return np.zeros(len(obs), int)

        return ask

    monkeypatch.setattr(dqn, "numpy_greedy", never)
    run(*SMALL_DQN, *flags, cwd=tmp_path, script=DQN)
    assert asked == [(1.0, 1.0, 0.1 * 3_000, frame) for frame in range(3_000)]


def test_no_game_serves_two_purposes(teacher, student):
    """Training and evaluation of the DQN; the human's, the student's evaluation and its demonstrations."""
    scored = set(json.loads((teacher / "evaluation.json").read_text())["seeds"])
    assert not scored & {dqn.episode_seed(1, i, n) for i in range(2) for n in range(1_000)}
    sets = [set(json.loads((student / "evaluation.json").read_text())["seeds"])]
    for name in ("demos", "demos_synthetic_human"):
        sets.append(set())
        for path in (student / name).glob("*.npz"):
            with np.load(path) as arrays:
                sets[-1].add(int(arrays["seed"]))
    for one, other in ((0, 1), (0, 2), (1, 2)):
        assert sets[one] and not sets[one] & sets[other]
