"""A run that was stopped, killed or torn ends with the same bytes as one that was not."""

import contextlib
import json
import os
import shutil
import signal
import subprocess
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from conftest import SCRIPT, SMALL, assert_same_run, command, kill_twice, run

HOPPER = [
    *("--env-id", "kle/Hopper-v2", "--total-timesteps", "10240", "--num-steps", "512", "--update-epochs", "4"),
    *("--checkpoint-interval", "1", "--eval-episodes", "2", "--kle-rollback"),
]

LONG = [*SMALL, "--total-timesteps", "5120"]  # 20 iterations: time enough to be stopped in the middle


@pytest.fixture(scope="session")
def long_run(tmp_path_factory) -> Path:
    """An undisturbed run of twice the length."""
    folder = tmp_path_factory.mktemp("long")
    run(*LONG, "--run-dir", "run", cwd=folder)
    return folder / "run"


def rows(folder: Path) -> int:
    path = folder / "updates.csv"
    return path.read_bytes().count(b"\n") if path.exists() else 0


def stop_in_the_middle(flags: list, folder: Path, number: int, at_row: int) -> int:
    """Start or resume a run, send it a signal once it has written `at_row` rows, return its exit code."""
    process = subprocess.Popen(
        command(*flags, "--run-dir", folder, "--resume"), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )
    while process.poll() is None and rows(folder) <= at_row:
        time.sleep(0.002)
    process.send_signal(number)
    out, _ = process.communicate(timeout=120)
    assert process.returncode != 0, out
    return process.returncode


def test_same_seed_same_bytes_and_another_seed_others(small_run, tmp_path):
    run(*SMALL, "--run-dir", "again", cwd=tmp_path)
    assert_same_run(small_run, tmp_path / "again")
    run(*SMALL, "--run-dir", "other", "--seed", 2, cwd=tmp_path)
    assert (tmp_path / "other" / "episodes.csv").read_bytes() != (small_run / "episodes.csv").read_bytes()


def test_killed_and_resumed_on_a_mujoco_task(tmp_path):
    run(*HOPPER, "--run-dir", "whole", cwd=tmp_path)
    for at_row in (4, 11):
        assert stop_in_the_middle(HOPPER, tmp_path / "killed", signal.SIGKILL, at_row) == -signal.SIGKILL
    run(*HOPPER, "--run-dir", "killed", "--resume", cwd=tmp_path)
    assert_same_run(tmp_path / "whole", tmp_path / "killed")


def test_killed_and_resumed_with_several_environments(tmp_path):
    flags = [*LONG, "--num-envs", "2", "--num-steps", "128", "--bootstrap-truncated", "--kl-samples", "batch"]
    run(*flags, "--run-dir", "whole", cwd=tmp_path)
    stop_in_the_middle(flags, tmp_path / "killed", signal.SIGKILL, 3)
    run(*flags, "--run-dir", "killed", "--resume", cwd=tmp_path)
    assert_same_run(tmp_path / "whole", tmp_path / "killed")


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT, signal.SIGUSR1])
def test_a_signal_checkpoints_and_ends(number, long_run, tmp_path):
    flags = [flag if flag != "1" else "100000" for flag in LONG]  # no checkpoint but the signal's
    assert stop_in_the_middle(flags, tmp_path / "run", number, 2) == 128 + number
    assert (tmp_path / "run" / "checkpoint.pt").exists() and not (tmp_path / "run" / "result.json").exists()
    done = run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert "differs" not in done.stderr
    assert_same_run(long_run, tmp_path / "run")


def test_resume_starts_where_there_is_nothing_and_is_done_where_all_is(small_run, tmp_path):
    run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(small_run, tmp_path / "run")
    before = (tmp_path / "run" / "result.json").read_bytes()
    assert "done" in run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path).stdout
    assert (tmp_path / "run" / "result.json").read_bytes() == before


def test_a_finished_run_can_be_evaluated_again(small_run, tmp_path):
    shutil.copytree(small_run, tmp_path / "run")
    run(*SMALL, "--run-dir", "run", "--resume", "--eval-episodes", 5, "--save-demos", 1, cwd=tmp_path)
    assert json.loads((tmp_path / "run" / "evaluation.json").read_text())["episodes"] == 5
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


def test_a_run_that_goes_on_forgets_what_was_saved_of_the_agent_before(tmp_path):
    """A model and demonstrations of an early end are no longer there when the agent is another one."""
    first = run(*SMALL, "--stop-at", 512, "--save-model", "--save-demos", 1, "--run-dir", "run", cwd=tmp_path)
    folder = tmp_path / "run"
    saved = [folder / "model.safetensors", folder / "demos" / "manifest.json"]
    assert first.returncode == 0 and all(path.exists() for path in saved)
    again = ["--stop-at", 512, "--eval-episodes", 5, "--run-dir", "run", "--resume"]
    run(*SMALL, *again, cwd=tmp_path)  # the same agent
    assert all(path.exists() for path in saved)
    run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert not any(path.exists() for path in saved) and (folder / "result.json").exists()


def test_a_finished_run_without_checkpoints_is_left_alone(small_run, tmp_path):
    shutil.copytree(small_run, tmp_path / "run")
    for name in ("checkpoint.pt", "checkpoint.previous.pt"):
        (tmp_path / "run" / name).unlink()
    same = ["--save-model", "--save-demos", 2]
    assert "done" in run(*SMALL, *same, "--run-dir", "run", "--resume", cwd=tmp_path).stdout
    done = run(*SMALL, *same, "--eval-episodes", 5, "--run-dir", "run", "--resume", cwd=tmp_path, code=2)
    assert "its checkpoint is gone" in done.stderr
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


def test_a_torn_checkpoint_does_not_push_out_the_whole_one(small_run, tmp_path):
    """Killed again, after the resume from the older checkpoint and in the middle of writing the next."""
    shutil.copytree(small_run, tmp_path / "run")
    (tmp_path / "run" / "checkpoint.pt").write_bytes(b"torn")
    (tmp_path / "run" / "result.json").unlink()
    (tmp_path / "run" / "checkpoint.pt.tmp").mkdir()  # the next checkpoint cannot be written
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path, code=1)
    assert "checkpoint stays whole" in done.stderr
    (tmp_path / "run" / "checkpoint.pt.tmp").rmdir()
    run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(small_run, tmp_path / "run")


def test_stop_at_ends_early_on_the_full_schedule(small_run, tmp_path):
    run(*SMALL, "--run-dir", "run", "--stop-at", 1000, cwd=tmp_path)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["global_step"] == 1024
    first = (small_run / "updates.csv").read_bytes().splitlines()[:5]
    assert (tmp_path / "run" / "updates.csv").read_bytes().splitlines() == first
    run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(small_run, tmp_path / "run")


@pytest.mark.parametrize("damage", [lambda content: content[: len(content) // 2], lambda content: b"", bytes.swapcase])
def test_a_torn_checkpoint_falls_back_to_the_one_before(damage, small_run, tmp_path):
    shutil.copytree(small_run, tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.pt"
    path.write_bytes(damage(path.read_bytes()))
    (tmp_path / "run" / "result.json").unlink()
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert "torn" in done.stderr
    assert_same_run(small_run, tmp_path / "run")


def test_killed_between_the_two_renames_of_a_checkpoint(small_run, tmp_path):
    shutil.copytree(small_run, tmp_path / "run")
    os.replace(tmp_path / "run" / "checkpoint.pt", tmp_path / "run" / "checkpoint.pt.tmp")
    (tmp_path / "run" / "result.json").unlink()
    run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(small_run, tmp_path / "run")


def test_killed_before_the_first_checkpoint(long_run, tmp_path):
    flags = [flag if flag != "1" else "100000" for flag in LONG]
    stop_in_the_middle(flags, tmp_path / "run", signal.SIGKILL, 4)
    assert not (tmp_path / "run" / "checkpoint.pt").exists()
    run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(long_run, tmp_path / "run")


def test_stopped_right_after_a_resume(small_run, tmp_path):
    """A checkpoint before anything was appended remembers the right length of the CSV files."""
    flags = [flag if flag != "256" else "16" for flag in SMALL]  # an episode spans many iterations
    run(*flags, "--run-dir", "whole", cwd=tmp_path)
    folder = tmp_path / "run"
    stop_in_the_middle(flags, folder, signal.SIGKILL, 30)
    for _ in range(3):
        stop_in_the_middle(flags, folder, signal.SIGTERM, rows(folder))
    run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(tmp_path / "whole", folder)


def test_killed_while_the_folder_was_made(small_run, tmp_path):
    (tmp_path / "run").mkdir()
    (tmp_path / "run" / "args.json.tmp").write_text("{")
    run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert_same_run(small_run, tmp_path / "run")


def test_a_changed_script_is_said(tmp_path):
    copy = Path(shutil.copy(SCRIPT, tmp_path))
    run(*SMALL, "--run-dir", "run", "--stop-at", 1280, cwd=tmp_path, script=copy)
    done = run(*SMALL, "--run-dir", "run", "--resume", "--stop-at", 1536, cwd=tmp_path, script=copy)
    assert "script has changed" not in done.stderr
    with open(copy, "a") as file:
        file.write("\n")
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path, script=copy)
    assert "--resume: this script has changed" in done.stderr


def test_another_machines_episode_is_said(small_run, tmp_path, monkeypatch):
    """Where the replayed episode differs, the run says so and goes on."""
    import torch

    shutil.copytree(small_run, tmp_path / "run")
    path = tmp_path / "run" / "checkpoint.previous.pt"
    state = torch.load(path, weights_only=True)
    state["collector"]["raw_obs"] += 1e-9
    torch.save(state, tmp_path / "run" / "checkpoint.pt")
    (tmp_path / "run" / "result.json").unlink()
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path)
    assert "replayed episode differs" in done.stderr


def test_a_full_disk_stops_the_run_with_a_whole_checkpoint(long_run, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=600k", "tmpfs", disk], capture_output=True, text=True)
    if mount.returncode:
        pytest.skip(f"cannot mount a small disk here: {mount.stderr.strip()}")
    try:
        process = subprocess.Popen(
            command(*LONG, "--run-dir", disk / "run"), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        while rows(disk / "run") < 3:
            assert process.poll() is None
            time.sleep(0.002)
        with contextlib.suppress(OSError), open(disk / "filler", "wb", buffering=0) as filler:
            while True:
                filler.write(b"x" * 1024)
        _, err = process.communicate(timeout=120)
        assert process.returncode == 1, err
        assert err.count("\n") == 1 and "No space left" in err and "--resume" in err, err
        (disk / "filler").unlink()
        shutil.copytree(disk / "run", tmp_path / "run")
        run(*LONG, "--run-dir", "run", "--resume", cwd=tmp_path)
        assert_same_run(long_run, tmp_path / "run")
    finally:
        subprocess.run(["umount", "--lazy", disk], check=True)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_twenty_runs_killed_at_random_end_with_the_same_bytes(tmp_path):
    """Each is killed twice, at any moment behind a checkpoint, every other one first in its first 3 s; half are compiled."""
    flags, seconds = {"plain": HOPPER, "compiled": [*HOPPER, "--compile"]}, {}
    for kind in flags:
        run(*flags[kind], "--run-dir", kind, cwd=tmp_path)
        seconds[kind] = json.loads((tmp_path / kind / "result.json").read_text())["training_seconds"]

    def kill_and_resume(number: int) -> None:
        kind = ("plain", "compiled")[number // 10]
        kill_twice(
            [*flags[kind], "--run-dir", tmp_path / f"run{number}"],
            seconds[kind],
            number,
            after_checkpoints=True,
            share=0.5,
        )
        run(*flags[kind], "--run-dir", f"run{number}", "--resume", cwd=tmp_path)
        assert_same_run(tmp_path / kind, tmp_path / f"run{number}")

    with ThreadPoolExecutor(2) as pool:
        list(pool.map(kill_and_resume, range(20)))
