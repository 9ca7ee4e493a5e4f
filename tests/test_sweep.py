"""benchmark/sweep.py with runs that last milliseconds; on a real Slurm in test_slurm.py."""

import contextlib
import fcntl
import functools
import importlib
import json
import os
import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import ROOT, assert_same_run
from conftest import SMALL as PPO

sys.path.insert(0, str(ROOT / "benchmark"))
sweep = importlib.import_module("sweep")

SCRIPT, TOY = ROOT / "benchmark" / "sweep.py", ROOT / "tests" / "data" / "toy_run.py"
COMMAND = ["--command", f"{sys.executable} -I {TOY}", "--runs", "runs"]
SMALL = [*COMMAND, "--env-ids", "A-v0", "B-v0", "--num-seeds", "2", "--grid", "bonus=0,5", "--workers", "2"]


def start(flags: list, folder: Path) -> subprocess.Popen:
    command = [sys.executable, str(SCRIPT), *map(str, flags)]
    return subprocess.Popen(command, cwd=folder, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def run(flags: list, folder: Path, code: int = 0, timeout: float = 100) -> tuple[str, str]:
    process = start(flags, folder)
    out, err = process.communicate(timeout=timeout)
    assert process.returncode == code, out + err
    return out, err


def records(folder: Path) -> dict[str, str]:
    return {path.parent.name: path.read_text() for path in sorted(folder.glob("runs/*/steps.txt"))}


def ends(folder: Path) -> list[int]:
    """How often each run came to its end."""
    return [path.read_text().count("\n") for path in sorted(folder.glob("runs/*/ends.txt"))]


# The manifest
def test_runs_are_the_product_of_environments_variants_grid_and_seeds():
    args = sweep.Args(command="python x.py --compile", env_ids=("kle/A-v2", "B"), num_seeds=2, start_seed=3)
    args.grid, args.variants = ("update_epochs=4,10", "--lr=1e-3"), ("none", "kle-stop,d_target=0.03")
    runs = sweep.make_runs(args)
    assert len(runs) == len({run.name for run in runs}) == 2 * 2 * 2 * 2
    assert [run.name.split("__")[-1] for run in runs] == ["seed3"] * 8 + ["seed4"] * 8
    last = runs[-1]
    assert last.name == "B__kle-stop_d_target=0.03__update-epochs=10__lr=1e-3__seed4"
    words = "python x.py --compile --env-id B --seed 4 --update-epochs 10 --lr 1e-3 --kle-stop --d-target 0.03"
    assert " ".join(last.command) == f"{words} --run-dir runs/sweep/{last.name} --resume"
    assert runs[0].name == "kle_A-v2__update-epochs=4__lr=1e-3__seed3" and runs[0].setting() == runs[1].setting()


def test_runs_of_a_setting_share_their_time():
    names = {
        "hrl_seed2": "hrl",
        "Hopper-v2__seed1": "",
        "kle_A-v2__update-epochs=4__lr=1__seed12": "update-epochs=4__lr=1",
    }
    assert {name: sweep.Run(name, ()).setting() for name in names} == names


@pytest.mark.parametrize("words, stop", [(["--stop-at", "12"], 12), (["--stop_at=7"], 7), (["--stop"], None)])
def test_a_stop_of_a_run_s_own_in_every_spelling(words, stop):
    run = sweep.Run("a", ("python", "x.py", *words))
    args = sweep.Args(stop_at=9)
    assert run.stop_at() == stop and len(sweep.command_of(args, run)) == len(run.command) + 2 * (stop is None)
    for step in (6, 8, 10, 12):
        result = {"complete": False, "global_step": step}
        assert sweep.is_done(args, run, result) == (step >= (stop or 9))


def test_another_manifest_of_the_same_name_is_refused(tmp_path):
    run(SMALL, tmp_path)
    before = (tmp_path / "runs" / "sweep.jsonl").read_bytes()
    _, err = run([*SMALL, "--num-seeds", "3"], tmp_path, code=2)
    assert "runs/sweep.jsonl: is of another sweep, which has begun 8 runs" in err and err.count("\n") == 1
    _, err = run([*SMALL, "--name", "other", "--variants", "double"], tmp_path)
    _, err = run([*SMALL, "--name", "third", "--command", f"{COMMAND[1]} --total 9"], tmp_path, code=2)
    assert "runs/A-v0__bonus=0__seed1: runs/sweep.jsonl has no such run" in err
    assert (tmp_path / "runs" / "sweep.jsonl").read_bytes() == before
    assert not (tmp_path / "runs" / "third.jsonl").exists()


def test_a_manifest_of_which_nothing_has_begun_is_replaced(tmp_path):
    """The first try had a misspelt flag."""
    run([*SMALL, "--grid", "bonos=0,5"], tmp_path, code=1)
    run(SMALL, tmp_path)
    assert ends(tmp_path) == [1] * 8


def test_runs_of_a_lost_manifest_are_not_taken_for_one_s_own(tmp_path):
    run(SMALL, tmp_path)
    (tmp_path / "runs" / "sweep.jsonl").unlink()
    _, err = run([*SMALL, "--variants", "none", "--command", f"{COMMAND[1]} --total 9"], tmp_path, code=2)
    assert "runs/A-v0__bonus=0__seed1: runs/sweep.jsonl has no such run; give another --runs" in err
    assert ends(tmp_path) == [1] * 8


def test_sweeps_in_one_folder_share_their_runs(tmp_path):
    run(SMALL, tmp_path)
    out, _ = run([*SMALL, "--name", "more", "--num-seeds", "3"], tmp_path)
    assert out.splitlines()[0].startswith("8 done") and out.splitlines()[-1].startswith("12 done, 0 running")
    assert ends(tmp_path) == [1] * 12


# The pool
def test_a_sweep_runs_everything_once(tmp_path):
    out, _ = run(SMALL, tmp_path)
    assert out.splitlines()[-1] == "8 done, 0 running, 0 waiting, 0 failed; about 0.0 core-hours left"
    whole = records(tmp_path)
    assert len(whole) == 8 and all(text.count("\n") == 20 for text in whole.values())
    assert whole["B-v0__bonus=5__seed2"].startswith("1 6\n2 7\n")
    out, _ = run(SMALL, tmp_path)
    assert out.count("\n") == 1 and out.startswith("8 done")
    assert records(tmp_path) == whole and ends(tmp_path) == [1] * 8


def test_runs_that_ended_early_are_finished_later(tmp_path):
    run([*SMALL, "--stop-at", 7], tmp_path)
    assert {text.count("\n") for text in records(tmp_path).values()} == {7}
    run([*SMALL, "--stop-at", 5], tmp_path)
    assert ends(tmp_path) == [1] * 8
    run(SMALL, tmp_path)
    assert {text.count("\n") for text in records(tmp_path).values()} == {20} and ends(tmp_path) == [2] * 8


def test_a_run_that_crashes_is_started_again(tmp_path):
    flags = [*SMALL, "--variants", "crash-at=9", "--grid", "bonus=0"]
    out, _ = run(flags, tmp_path)
    assert out.splitlines()[-1].startswith("4 done") and {t.count("\n") for t in records(tmp_path).values()} == {20}
    log = (tmp_path / "runs" / "logs" / "A-v0__crash-at=9__bonus=0__seed1.log").read_text()
    assert log.count("$ ") == 2


def test_failed_runs_are_listed_with_their_last_words(tmp_path):
    """A-v0 passes, also while the first run is not done; a flag's wrong value is not tried again."""
    flags = [*COMMAND, "--env-ids", "A-v0", "no/Such-v0", "--num-seeds", "2", "--grid", "bonus=0", "--workers", "2"]
    _, err = run(flags, tmp_path, code=1)
    assert err.count("failed: ") == 2 and "failed: no_Such-v0__bonus=0__seed1 (exit code 2, " in err
    assert "invalid choice: 'no/Such-v0'" in err and ends(tmp_path) == [1, 1]


@pytest.mark.parametrize(
    "flags, words, tries",
    [
        (["--grid", "nonsense=1,2"], "unrecognized arguments: --nonsense 1", 1),
        (["--command", "no_such_program"], "no_such_program", None),
        (["--command", f"{sys.executable} -c 1/0"], "ZeroDivisionError", 3),
    ],
)
def test_a_command_that_cannot_work_is_told_after_the_first(flags, words, tries, tmp_path):
    """Two workers: the first run ends the sweep once its tries are used up, however many are waiting."""
    _, err = run([*SMALL, "--num-seeds", "200", *flags], tmp_path, code=1)
    assert words in err and "run the same command again" in err
    logs = list((tmp_path / "runs" / "logs").iterdir())
    starts = [path.read_text().count("$ ") for path in logs if "A-v0__" in path.name and "seed1.log" in path.name]
    assert len(logs) <= 5 and (tries is None or tries in starts)


@pytest.mark.parametrize("end", ["kill", "full disk", "hangup"])
def test_a_runner_that_dies_leaves_no_run_behind(end, tmp_path):
    """Killed, with nowhere to print to, or with its terminal gone: the runs write a checkpoint and end."""
    command = [sys.executable, str(SCRIPT), *SMALL, "--command", f"{COMMAND[1]} --total 400"]
    with open("/dev/full" if end == "full disk" else os.devnull, "w") as out:
        hear = functools.partial(signal.signal, signal.SIGHUP, signal.SIG_DFL)  # also where the tests run under `nohup`
        process = subprocess.Popen(command, cwd=tmp_path, stdout=out, stderr=subprocess.PIPE, preexec_fn=hear)
    while end != "full disk" and len(records(tmp_path)) < 2:
        time.sleep(0.01)
    if end != "full disk":
        process.send_signal(signal.SIGKILL if end == "kill" else signal.SIGHUP)
    process.communicate(timeout=20)
    assert process.returncode == {"kill": -signal.SIGKILL, "full disk": 1, "hangup": 128 + signal.SIGHUP}[end]
    time.sleep(0.3)
    before = records(tmp_path)
    time.sleep(0.3)
    assert records(tmp_path) == before and ends(tmp_path) == []


def test_ctrl_c_lets_runs_write_their_checkpoints(tmp_path):
    flags = [*SMALL, "--command", f"{COMMAND[1]} --total 300"]
    process = start(flags, tmp_path)
    while len(records(tmp_path)) < 2:
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=20)
    assert process.returncode == 130 and "run the same command again to continue" in err
    before = records(tmp_path)
    assert len(before) == 2 and all(text.count("\n") < 300 for text in before.values())
    run(flags, tmp_path)
    after = records(tmp_path)
    assert all(after[name].startswith(text) for name, text in before.items()) and ends(tmp_path) == [1] * 8


def test_two_sweeps_at_once_are_refused(tmp_path):
    process = start([*SMALL, "--command", f"{COMMAND[1]} --total 300"], tmp_path)
    while len(records(tmp_path)) < 2:
        time.sleep(0.01)
    before = (tmp_path / "runs" / "sweep.jsonl").read_text()
    _, err = run([*SMALL, "--command", f"{COMMAND[1]} --total 300"], tmp_path, code=2)
    assert "this sweep is running" in err
    (tmp_path / "lines").write_text("more --env-id A-v0 --seed 1\n")
    _, err = run([*COMMAND, "--lines", "lines"], tmp_path, code=2)
    assert "this sweep is running" in err and (tmp_path / "runs" / "sweep.jsonl").read_text() == before
    process.send_signal(signal.SIGTERM)
    process.communicate(timeout=20)


def test_a_run_that_is_busy_is_waited_for(tmp_path):
    """An earlier sweep was killed and has left a process behind."""
    flags = [*COMMAND, "--env-ids", "A-v0", "--num-seeds", "1", "--grid", "bonus=0", "--retries", "0"]
    run([*flags, "--stop-at", "3"], tmp_path)
    folder = tmp_path / "runs" / "A-v0__bonus=0__seed1"
    lock = os.open(folder, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    process = start(flags, tmp_path)
    log = tmp_path / "runs" / "logs" / f"{folder.name}.log"
    while not (log.exists() and "another process" in log.read_text()):
        time.sleep(0.05)
    os.close(lock)
    process.communicate(timeout=30)
    assert process.returncode == 0 and ends(tmp_path) == [2]


def kill_at_random(flags: list, folder: Path, most: int, longest: float) -> int:
    """SIGKILL the runner or one of its workers at random moments and send it again, until all is done; number of kills."""
    rng, kills = random.Random(1), 0
    process = start(flags, folder)
    while process.poll() is None or process.returncode != 0:
        time.sleep(rng.uniform(0, longest))
        if process.poll() is not None:
            assert process.returncode in (0, -signal.SIGKILL), process.communicate()
            process = start(flags, folder) if process.returncode else process
            continue
        children = subprocess.run(["pgrep", "-P", str(process.pid)], capture_output=True, text=True).stdout.split()
        if kills < most:
            with contextlib.suppress(ProcessLookupError):  # it ended by itself just now
                os.kill(
                    process.pid if rng.random() < 0.3 or not children else int(rng.choice(children)), signal.SIGKILL
                )
                kills += 1
    process.communicate()
    return kills


def test_random_kills_of_the_runner_and_of_its_workers_lose_nothing(tmp_path):
    """Every run's steps are there once, and one end."""
    flags = [*SMALL, "--num-seeds", "4", "--retries", "100"]
    whole = tmp_path / "whole"
    whole.mkdir()
    run(flags, whole)
    assert kill_at_random(flags, tmp_path, 20, 0.15) >= 10
    assert records(tmp_path) == records(whole) and ends(tmp_path) == [1] * 16


@pytest.mark.slow
@pytest.mark.timeout(3000)
def test_fifty_random_kills_during_a_sweep_of_ppo(tmp_path):
    """Sixteen runs end with the bytes, and the tables, of a sweep that was left alone."""
    script = ROOT / "cleanrl_thesis" / "ppo_continuous_kle.py"
    flags = ["--command", f"{sys.executable} {script} {' '.join(PPO[2:])}", "--env-ids", "Pendulum-v1"]
    flags += ["--num-seeds", "4", "--grid", "update-epochs=2,4", "--variants", "none", "kle-stop,d-target=0.001"]
    flags += ["--workers", "2", "--retries", "100", "--runs", "runs"]
    whole = tmp_path / "whole"
    whole.mkdir()
    began = time.monotonic()
    run(flags, whole, timeout=600)
    seconds = (time.monotonic() - began) / 16  # half of what a run takes, two at a time
    assert kill_at_random(flags, tmp_path, 50, seconds) == 50
    folders = sorted((tmp_path / "runs").glob("*__seed*"))
    assert len(folders) == 16
    for folder in folders:
        assert_same_run(whole / "runs" / folder.name, folder)
    for folder in (whole, tmp_path):
        report = [sys.executable, ROOT / "benchmark" / "report.py", "--runs", "runs", "--steps", "2560", "--out", "out"]
        subprocess.run(report, cwd=folder, check=True, capture_output=True)
    tables = [(folder / "out" / "tables.md").read_text() for folder in (whole, tmp_path)]
    assert tables[0].split("## Cost")[0].split("\n", 2)[2] == tables[1].split("## Cost")[0].split("\n", 2)[2]


def test_a_full_disk_stops_the_sweep_and_loses_nothing(tmp_path):
    """The log of the third run cannot be written."""
    log = tmp_path / "runs" / "logs" / "A-v0__bonus=5__seed1.log"
    log.parent.mkdir(parents=True)
    log.symlink_to("/dev/full")
    _, err = run([*SMALL, "--workers", "1"], tmp_path, code=1)
    assert "A-v0__bonus=5__seed1 could not be started: [Errno 28] No space left" in err and "to continue" in err
    assert ends(tmp_path) == [1, 1]
    log.unlink()
    run([*SMALL, "--workers", "1"], tmp_path)
    assert ends(tmp_path) == [1] * 8


# What a user can get wrong
@pytest.mark.parametrize(
    "flags, words",
    [
        (["--command", ""], "--command: give"),
        (["--env-ids"], "--env-ids"),
        (["--grid", "bonus"], "--grid bonus: must be FLAG=VALUE"),
        (["--grid", "bonus=1,,2"], "--grid bonus=1,,2: must be"),
        (["--grid", "bonus=1", "bonus=2"], "--grid bonus=2: the flag is there twice"),
        (["--grid", "bonus=1,1"], "2 runs would have the folder A-v0__bonus=1__seed1"),
        (["--variants", "double,,x"], "--variants double,,x: must be"),
        (["--num-seeds", "0"], "--num-seeds 0: must be at least 1"),
        (["--workers", "0"], "--workers 0"),
        (["--stop-at", "0"], "--stop-at 0"),
        (["--name", "a b"], "--name a b"),
        (["--slurm-memory", "2 G"], "--slurm-memory 2 G: must be a number"),
        (["--name", ""], "--name : must be letters"),
        (["--command", "python 'x.py"], "--command python 'x.py: No closing quotation"),
        (["--grid", "stop-at=5,x"], "A-v0__stop-at=x__seed1: --stop-at x: must be a number of steps"),
        (["--slurm-template-path", "no/such"], "--slurm-template-path no/such: no such file"),
        (["--only", "3"], "runs/sweep.jsonl: no readable manifest"),
        (["--runs", TOY], "toy_run.py: must be a folder"),
        (["--command", "python no/such.py"], "--command python no/such.py: there is no no/such.py"),
    ],
)
def test_bad_input_is_one_line_and_makes_nothing(flags, words, tmp_path):
    _, err = run([*SMALL, *flags], tmp_path, code=2)
    assert words in err and not list(tmp_path.iterdir())


# Slurm's part that needs no Slurm
def test_only_becomes_one_line_of_the_manifest(tmp_path):
    run([*SMALL, "--num-seeds", "1"], tmp_path)
    for path in tmp_path.glob("runs/*/*.*"):
        if path.parent.name == "B-v0__bonus=0__seed1":
            path.unlink()
    out, _ = run(["--runs", "runs", "--only", "0"], tmp_path)
    assert out == "A-v0__bonus=0__seed1 is done\n"
    run(["--runs", "runs", "--only", "1"], tmp_path)
    assert ends(tmp_path) == [1] * 4
    _, err = run(["--runs", "runs", "--only", "4"], tmp_path, code=2)
    assert "--only 4: the manifest has lines 0 to 3" in err


def test_nohup_is_heeded(monkeypatch):
    """A hangup that is ignored stays so, another one stops the sweep."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        for old, is_heard in ((signal.SIG_IGN, False), (signal.SIG_DFL, True)):
            signal.signal(signal.SIGHUP, old)
            signals = sweep.Signals()
            signals.install()
            os.kill(os.getpid(), signal.SIGHUP)
            assert (signals.received == [signal.SIGHUP]) == is_heard
    finally:
        for number, old in before.items():
            signal.signal(number, old)


def test_a_first_run_that_fails_late_stops_no_others(tmp_path):
    """Its failure ends the sweep only while nothing is done."""
    runs = [sweep.Run(name, ("false",)) for name in ("first", "second")]
    args = sweep.Args(command="false", runs=tmp_path, retries=0)
    (tmp_path / "logs").mkdir()
    for done, stops in ((0, True), (1, False)):
        state = sweep.Sweep(done=done, first=runs[0], running={runs[0]: (None, 0.0)})
        sweep.settle(args, state, runs[0], 1)
        assert state.failed == {runs[0]: 1} and bool(state.stopped) == stops


def stand_ins(folder: Path, monkeypatch) -> None:
    """Put stand-ins for squeue and sbatch first on the path; beside them they keep what they are given."""
    keep = (
        f'echo "$@" >> {folder.parent}/calls_of_sbatch; for last; do :; done; cat "$last" >> {folder.parent}/submitted'
    )
    folder.mkdir()
    for name, body in (("squeue", ""), ("sbatch", f"{keep}; echo 77")):
        (folder / name).write_text(f"#!/bin/sh\n{body}\n")
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}:{os.environ['PATH']}")


def test_arrays_are_submitted_in_chunks_of_what_is_not_done(tmp_path, monkeypatch):
    stand_ins(tmp_path / "bin", monkeypatch)
    run([*SMALL, "--num-seeds", "1"], tmp_path)
    flags = [*SMALL, "--name", "more", "--num-seeds", "3", "--slurm-chunk", "5", "--stop-at", "9", "--workers", "4"]
    flags += ["--slurm-memory", "3G"]
    out, _ = run([*flags, "--slurm-template-path", ROOT / "benchmark" / "slurm_template.sh"], tmp_path)
    assert re.findall(r"^(\d+) runs in job 77", out, re.M) == ["5", "3"]
    text = (tmp_path / "submitted").read_text()
    assert "{{" not in text and re.findall(r"--array=(\S+)", text) == ["0-4%4", "0-2%4"]
    assert re.findall(r"^lines=\((.*)\)", text, re.M) == ["4 5 6 7 8", "9 10 11"]
    assert "--runs runs --name more --stop-at 9 --only" in text and text.count("#SBATCH --mem=3G\n") == 2
    calls = (tmp_path / "calls_of_sbatch").read_text().splitlines()
    assert "--dependency" not in calls[0] and "--dependency=afterany:77" in calls[1]
    (tmp_path / "bin" / "squeue").write_text("#!/bin/sh\necho 77\n")
    for more in ([], ["--grid", "bonus=7"]):
        _, err = run(
            [*flags, *more, "--slurm-template-path", ROOT / "benchmark" / "slurm_template.sh"], tmp_path, code=2
        )
        assert "still queued" in err
    assert json.loads((tmp_path / "runs" / "more.jsonl").read_text().splitlines()[0])["name"] == "A-v0__bonus=0__seed1"


# The studies beside it, which give it their runs as lines
STAND_IN = """#!{python}
import json, os, sys
from pathlib import Path
if sys.argv[1] == "benchmark/sweep.py":
    os.execv({python!r}, [{python!r}, *sys.argv[1:]])
with open({calls!r}, "a") as file:
    file.write(json.dumps(sys.argv[1:]) + "\\n")
if "--run-dir" in sys.argv:
    run_dir = Path(sys.argv[sys.argv.index("--run-dir") + 1])
    run_dir.mkdir(parents=True, exist_ok=True)
    (run_dir / "result.json").write_text(json.dumps({{"complete": True, "global_step": 0}}))
"""


def study(script: str, folder: Path, stand_in: str = STAND_IN, **settings: str) -> list[list[str]]:
    """The command lines that a study sends, from a Python that only writes them down."""
    python = folder / "python"
    python.write_text(stand_in.format(python=sys.executable, calls=str(folder / "calls")))
    python.chmod(0o755)
    env = {
        **os.environ,
        "PYTHON": str(python),
        "RUNS": str(folder / "runs"),
        "PLAYER": str(folder / "player"),
        **settings,
    }
    subprocess.run([ROOT / "benchmark" / script], env=env, check=True, capture_output=True)
    return [json.loads(line) for line in (folder / "calls").read_text().splitlines()]


@pytest.mark.parametrize(
    "script, settings, number, report",
    [
        ("apple_alpha.sh", {"SEEDS": "1 2"}, 2 * (1 + 12 + 7 + 1 + 12 + 3 + 2 + 4 * 7), "apple_report.py"),
        ("torcs_alpha.sh", {}, 2 + 3 * (3 + 11 + 4) + 2 * 3, "torcs_report.py"),
        ("gopher_alpha.sh", {"SEEDS": "1 2"}, 2 + 2 * (11 + 4) + 4, "gopher_likeness.py"),
        (
            *("gopher_alpha.sh", {"ALPHAS": "0.0", "TEMPERATURES": "", "CONTROL_SEEDS": "", "FULL": "", "TEACHER": ""}),
            *(3, "gopher_likeness.py"),
        ),
        ("gopher_ram.sh", {}, 3, "gopher_ram.py"),
        ("fourrooms.sh", {"SEEDS": "1"}, 5, "dreamer_report.py"),
        ("fourrooms.sh", {"SEEDS": "1", "AGENTS": "hwm dreamer_early", "STEPS": "1060000"}, 2, "dreamer_report.py"),
        ("hwm_segment.sh", {"SEEDS": "1 2"}, 2 + 2 * 9, "hwm_report.py"),
        ("ppo_k10.sh", {"SEEDS": "1"}, 6, "ppo_k10_report.py"),
    ],
)
def test_every_line_of_a_study_is_a_run_that_its_method_understands(script, settings, number, report, tmp_path):
    calls = study(script, tmp_path, **settings)
    runs = [words for words in calls if words[0].startswith("cleanrl_thesis/")]
    assert len(runs) == number and calls[-1][0] == f"benchmark/{report}"
    folders = []
    for method, *flags in runs:
        args = importlib.import_module(method.removesuffix(".py").replace("/", ".")).parse_args(flags)
        assert args.resume and args.seed >= 1
        folders.append(args.run_dir)
    assert len(set(folders)) == number - script.startswith("hwm")  # where one player records twice
    early = [args for args in map(" ".join, runs) if "dreamer_early" in args]
    assert all("--stop-at 260000 " in args and args.count("--stop-at") == 1 for args in early)


@pytest.mark.parametrize(
    "script, settings, words",
    [
        ("hwm_segment.sh", {"RUNGS": "narrow typo"}, "RUNGS=narrow typo"),
        ("fourrooms.sh", {"AGENTS": "hwm typo"}, "AGENTS=hwm typo"),
        ("fourrooms.sh", {"AGENTS": "dreamer_early", "STEPS": "500000"}, "STEPS=500000"),
    ],
)
def test_a_study_that_cannot_be_sends_nothing(script, settings, words, tmp_path):
    with pytest.raises(subprocess.CalledProcessError) as error:
        study(script, tmp_path, **settings)
    assert error.value.returncode == 2 and error.value.stderr.decode().startswith(words)
    assert not (tmp_path / "calls").exists() and not (tmp_path / "runs").exists()


@pytest.mark.parametrize(
    "script, failed, settings, number, report",
    [
        ("torcs_alpha.sh", "expert_seed2", {}, 2 + 3 * (3 + 11 + 4) + 2 * 3, "torcs_report.py"),
        ("apple_alpha.sh", "teacher_seed2", {"SEEDS": "1 2"}, 2 + 12 + 7 + 1 + 12 + 3 + 2 + 4 * 7, "apple_report.py"),
    ],
)
def test_a_failed_expert_keeps_its_own_students_alone(script, failed, settings, number, report, tmp_path):
    """The driving task's are all of the first expert; in the Apple game each seed has its own."""
    fails = f'if "{failed} " in " ".join(sys.argv) + " " and "--teacher" not in sys.argv:\n    sys.exit(1)\n'
    stand_in = STAND_IN.replace('if "--run-dir"', fails + 'if "--run-dir"')
    with pytest.raises(subprocess.CalledProcessError) as error:
        study(script, tmp_path, stand_in=stand_in, **settings)
    calls = [json.loads(line) for line in (tmp_path / "calls").read_text().splitlines()]
    runs = {" ".join(words) for words in calls if words[0].startswith("cleanrl_thesis/")}
    assert error.value.returncode == 1 and calls[-1][0] == f"benchmark/{report}" and len(runs) == number


@pytest.mark.parametrize("script", ["gopher_ram.sh", "torcs_alpha.sh"])
def test_a_study_whose_runs_were_queued_waits_for_them(script, tmp_path, monkeypatch):
    """Nothing that needs the runs is begun; once they are there, the same command makes the report."""
    stand_ins(tmp_path / "bin", monkeypatch)
    settings = {"SLURM": "benchmark/slurm_template.sh"}
    with pytest.raises(FileNotFoundError):  # no method and no report was called
        study(script, tmp_path, **settings)
    if script == "gopher_ram.sh":
        for seed in (1, 2, 3):
            (tmp_path / "runs" / f"seed{seed}").mkdir()
            (tmp_path / "runs" / f"seed{seed}" / "result.json").write_text('{"complete": true}')
        assert study(script, tmp_path, **settings)[-1][0] == "benchmark/gopher_ram.py"


def test_a_study_runs_in_a_folder_with_a_blank(tmp_path):
    (tmp_path / "my python").mkdir()
    calls = study("gopher_ram.sh", tmp_path / "my python")
    assert calls[-1][0] == "benchmark/gopher_ram.py"


LINES = "one --bonus 1\n\ntwo --bonus 2 --stop-at 12\n"


def test_lines_are_runs_and_may_change(tmp_path):
    (tmp_path / "lines").write_text(LINES.splitlines()[0])
    command = [*COMMAND, "--lines", "lines"]
    command[1] += " --env-id A-v0 --seed 1"
    run(command, tmp_path)
    (tmp_path / "lines").write_text(LINES)
    out, _ = run(command, tmp_path)
    assert out.splitlines()[-1].startswith("2 done, 0 running, 0 waiting, 0 failed")
    results = {name: json.loads((tmp_path / "runs" / name / "result.json").read_text()) for name in ("one", "two")}
    assert results["one"]["complete"] and results["two"]["global_step"] == 12 and not results["two"]["complete"]
    assert run(command, tmp_path)[0].startswith("2 done, 0 running, 0 waiting, 0 failed")  # a stop of its own is an end


@pytest.mark.parametrize(
    "lines, flags, words",
    [
        ("", [], ["--lines lines", "holds no run"]),
        ("a --x 1\na --x 2", [], ["--lines lines", "2 runs", "folder a"]),
        ("../a --x 1", [], ["--lines lines", "../a"]),
        (".. --x 1", [], ["--lines lines", "..: must be the name of a folder"]),
        ("a 'b", [], ["--lines lines", "cannot be read"]),
        ("a", ["--env-ids", "A-v0"], ["--lines lines", "--env-ids"]),
        (None, [], ["--lines lines", "cannot be read"]),
    ],
)
def test_lines_that_are_no_runs_are_refused(lines, flags, words, tmp_path):
    if lines is not None:
        (tmp_path / "lines").write_text(lines)
    _, err = run([*COMMAND, "--lines", "lines", *flags], tmp_path, code=2)
    assert err.count("\n") == 1 and all(word in err for word in words), err
    assert not (tmp_path / "runs").exists()


def test_a_word_that_is_no_number_is_one_line(tmp_path):
    _, err = run([*SMALL, "--workers", "x"], tmp_path, code=2)
    assert err.count("\n") == 1 and err.startswith("error: ") and "--workers" in err
