"""Runs a sweep: every environment, seed and setting of a grid, on this machine or on a Slurm cluster.

    python benchmark/sweep.py --command "python cleanrl_thesis/ppo_continuous_kle.py --compile" \\
        --env-ids kle/Hopper-v2 kle/Walker2d-v2 --num-seeds 2 --grid update-epochs=4,10,20 \\
        --variants none kle-stop,d-target=0.03 --runs runs/my_sweep --workers 2

`manifest.jsonl` in the folder of the runs has a line for each of them. Sent again, the sweep goes on with what is not
done; a finished run is never run again. `--stop-at STEPS` ends all runs early on their full schedule, and a later sweep
without it finishes them. `--slurm-template-path benchmark/slurm_template.sh` submits arrays instead, `--workers` tasks at
a time.

The command needs `--env-id`, `--seed`, `--run-dir` and `--resume`, and a `result.json` at its end, as all scripts here.
"""

import fcntl
import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass, field
from pathlib import Path

import tyro


@dataclass
class Args:
    command: str = ""
    """what each run starts with: interpreter, script and the flags that all runs share"""
    env_ids: tuple[str, ...] = ()
    """environments"""
    num_seeds: int = 3
    """seeds of each setting"""
    start_seed: int = 1
    """the first of them"""
    grid: tuple[str, ...] = ()
    """FLAG=VALUE,VALUE,...: a run for each combination of the values"""
    variants: tuple[str, ...] = ("none",)
    """FLAG,FLAG=VALUE,...: a run with each of these sets of flags; none is the empty one"""
    runs: Path = Path("runs/sweep")
    """folder for the manifest, the runs' folders and logs"""
    workers: int = 1
    """runs at a time"""
    stop_at: int | None = None
    """end every run at this step of its schedule; not part of the manifest"""
    retries: int = 2
    """how often a run that failed is started again"""
    slurm_template_path: Path | None = None
    """submit to Slurm by this template instead of running here"""
    slurm_chunk: int = 1_000
    """tasks in an array; Slurm's default limit is 1,001"""
    only: int | None = None
    """run this line of the manifest alone, from 0 on; for the tasks of an array"""


class UsageError(Exception):
    """A user's mistake, told in one line; the exit code is 2."""


@dataclass(frozen=True)
class Run:
    """A line of the manifest."""

    name: str  # of its folder
    command: tuple[str, ...]

    def line(self) -> str:
        return json.dumps({"name": self.name, "command": self.command})


# ---------------------------------------------------------------------------------------------------------------------
# The manifest
# ---------------------------------------------------------------------------------------------------------------------
def parse_grid(entries: tuple[str, ...]) -> list[list[tuple[str, str]]]:
    """`FLAG=VALUE,VALUE` -> for each entry its (flag, value) pairs. Raises UsageError."""
    axes = []
    for entry in entries:
        flag, equals, values = entry.partition("=")
        flag = flag.removeprefix("--").replace("_", "-")
        if not (flag and equals and all(values.split(","))):
            raise UsageError(f"--grid {entry}: must be FLAG=VALUE,VALUE,...")
        if flag in [axis[0][0] for axis in axes]:
            raise UsageError(f"--grid {entry}: the flag is there twice")
        axes.append([(flag, value) for value in values.split(",")])
    return axes


def parse_variant(text: str) -> list[str]:
    """`FLAG,FLAG=VALUE` -> words of a command line; none of `none`."""
    words = []
    for part in [] if text == "none" else text.split(","):
        flag, equals, value = part.partition("=")
        words += [f"--{flag.removeprefix('--')}", *([value] if equals else [])]
    return words


def slug(text: str) -> str:
    """Part of a folder's name: what a shell need not quote."""
    return re.sub(r"[^A-Za-z0-9.=-]+", "_", text.replace("--", "")).strip("_")


def make_runs(args: Args) -> list[Run]:
    """All runs, seeds outermost: whatever part is done has every setting. Raises UsageError."""
    command = shlex.split(args.command)
    for holds, complaint in (
        (command, "--command: give interpreter, script and the flags that all runs share, in quotes"),
        (args.env_ids, "--env-ids: name at least one environment"),
        (args.num_seeds >= 1, f"--num-seeds {args.num_seeds}: must be at least 1"),
        (args.start_seed >= 0, f"--start-seed {args.start_seed}: must be at least 0"),
        (args.workers >= 1, f"--workers {args.workers}: must be at least 1"),
        (args.retries >= 0, f"--retries {args.retries}: must be at least 0"),
        (args.slurm_chunk >= 1, f"--slurm-chunk {args.slurm_chunk}: must be at least 1"),
    ):
        if not holds:
            raise UsageError(complaint)
    runs = []
    seeds = range(args.start_seed, args.start_seed + args.num_seeds)
    axes = parse_grid(args.grid)
    for seed, variant, values, env_id in itertools.product(
        seeds, args.variants, itertools.product(*axes), args.env_ids
    ):
        flags = [word for flag, value in values for word in (f"--{flag}", value)] + parse_variant(variant)
        parts = [
            env_id,
            "" if variant == "none" else variant,
            *(f"{flag}={value}" for flag, value in values),
            f"seed{seed}",
        ]
        name = "__".join(slug(part) for part in parts if part)
        whole = [*command, "--env-id", env_id, "--seed", str(seed), *flags]
        runs.append(Run(name, (*whole, "--run-dir", str(args.runs / name), "--resume")))
    names = [run.name for run in runs]
    twice = next((name for name in names if names.count(name) > 1), None) if len(set(names)) < len(names) else None
    if twice:
        raise UsageError(f"--grid, --variants: two runs would have the folder {twice}")
    return runs


def open_manifest(args: Args, runs: list[Run]) -> None:
    """Write the manifest, or see that it is the one that is there. Raises UsageError where it is another."""
    path = args.runs / "manifest.jsonl"
    lines = [run.line() for run in runs]
    if path.exists():
        old = path.read_text().splitlines()
        if old != lines:
            at = next((i for i, (a, b) in enumerate(zip(old, lines)) if a != b), min(len(old), len(lines)))
            raise UsageError(
                f"--runs {args.runs}: holds another sweep, of {len(old)} runs for {len(lines)}, from run {at + 1} on; "
                "give another folder"
            )
        return
    args.runs.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".tmp")
    draft.write_text("".join(line + "\n" for line in lines))
    draft.replace(path)


def read_manifest(folder: Path) -> list[Run]:
    """The runs of a sweep. Raises UsageError where there is no manifest."""
    try:
        rows = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
        return [Run(row["name"], tuple(row["command"])) for row in rows]
    except (OSError, ValueError, KeyError) as error:
        raise UsageError(f"--runs {folder}: no readable manifest.jsonl: {error}") from None


def read_result(folder: Path) -> dict | None:
    """What a run wrote at its end; None while it is not done."""
    try:
        return json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return None


def is_done(folder: Path, stop_at: int | None) -> bool:
    """Whether a run has come to the end of its schedule, or to `stop_at`."""
    result = read_result(folder)
    return result is not None and (result["complete"] or stop_at is not None and result["global_step"] >= stop_at)


# ---------------------------------------------------------------------------------------------------------------------
# On this machine
# ---------------------------------------------------------------------------------------------------------------------
BUSY = "another process is running in it"  # a run that an earlier, killed sweep has left behind
THREADS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS")}


@dataclass
class Sweep:
    """What is where; changed by the workers under `lock`."""

    waiting: deque[Run]
    running: dict[Run, subprocess.Popen] = field(default_factory=dict)
    done: list[Run] = field(default_factory=list)
    failed: dict[Run, int] = field(default_factory=dict)  # with the exit code
    attempts: dict[Run, int] = field(default_factory=dict)
    seconds: list[float] = field(default_factory=list)  # of the runs that ended here
    stopped: str = ""  # why nothing more is started
    lock: threading.Lock = field(default_factory=threading.Lock)


def log_path(args: Args, run: Run) -> Path:
    return args.runs / "logs" / f"{run.name}.log"


def log_end(args: Args, run: Run, lines: int = 15) -> str:
    """The last lines that a run printed."""
    try:
        return "\n".join(
            "    " + line for line in log_path(args, run).read_text(errors="replace").splitlines()[-lines:]
        )
    except OSError as error:
        return f"    {error}"


def start(args: Args, run: Run) -> subprocess.Popen:
    """Start a run in a process group of its own, so that Ctrl-C reaches it by this script alone."""
    command = [*run.command, *(["--stop-at", str(args.stop_at)] if args.stop_at is not None else [])]
    with open(log_path(args, run), "ab") as log:
        log.write(f"$ {shlex.join(command)}\n".encode())
        log.flush()
        environment = {**os.environ, **THREADS}
        return subprocess.Popen(command, stdout=log, stderr=subprocess.STDOUT, env=environment, start_new_session=True)


def settle(args: Args, sweep: Sweep, run: Run, code: int, seconds: float) -> None:
    """Put a run whose process has ended where it belongs."""
    sweep.running.pop(run)
    if code == 0 and is_done(args.runs / run.name, args.stop_at):
        sweep.done.append(run)
        sweep.seconds.append(seconds)
    elif sweep.stopped:
        sweep.waiting.appendleft(run)
    elif code == 2 and BUSY in log_end(args, run, 1) or sweep.attempts[run] <= args.retries and code != 2:
        sweep.waiting.append(run)
    else:
        sweep.failed[run] = code
        if not sweep.done:
            sweep.stopped = "the first run failed"


def work(args: Args, sweep: Sweep) -> None:
    """One worker: run after run until none is waiting."""
    while True:
        with sweep.lock:
            if sweep.stopped or not sweep.waiting:
                return
            run = sweep.waiting.popleft()
            try:
                process = start(args, run)
            except OSError as error:
                sweep.waiting.appendleft(run)
                sweep.stopped = str(error)
                return
            sweep.running[run] = process
            sweep.attempts[run] = sweep.attempts.get(run, 0) + 1
            began = time.monotonic()
        code = process.wait()
        with sweep.lock:
            settle(args, sweep, run, code, time.monotonic() - began)
            is_busy = code == 2 and run in sweep.waiting
        if is_busy:
            time.sleep(5)


def status_line(sweep: Sweep, workers: int) -> str:
    """Numbers of runs, and the core-hours that are left by the mean of those that ended here."""
    left = len(sweep.waiting) + len(sweep.running)
    mean = sum(sweep.seconds) / len(sweep.seconds) if sweep.seconds else None
    hours = "" if mean is None else f", about {left * mean / 3600:.1f} core-hours left"
    numbers = f"{len(sweep.done)} done, {len(sweep.running)} running, {len(sweep.waiting)} waiting"
    return f"{numbers}, {len(sweep.failed)} failed{hours}"


def checkpoint_all(sweep: Sweep, reason: str) -> None:
    """Start nothing more, and let every run write a checkpoint and end."""
    with sweep.lock:
        sweep.stopped = reason
        for process in sweep.running.values():
            process.send_signal(signal.SIGTERM)


def run_here(args: Args, runs: list[Run]) -> int:
    """Run what is not done with a pool of workers. Returns the exit code."""
    (args.runs / "logs").mkdir(exist_ok=True)
    lock = os.open(args.runs, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        raise UsageError(f"--runs {args.runs}: another sweep is running in it") from None
    sweep = Sweep(deque())
    for run in runs:
        (sweep.done if is_done(args.runs / run.name, args.stop_at) else sweep.waiting).append(run)
    signals = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, frame: signals.append(number))
    workers = [threading.Thread(target=work, args=(args, sweep), daemon=True) for _ in range(args.workers)]
    for worker in workers:
        worker.start()
    shown, is_terminal = "", sys.stdout.isatty()
    while any(worker.is_alive() for worker in workers):
        if signals and not sweep.stopped:
            checkpoint_all(sweep, f"stopped by signal {signals[0]}")
        line = status_line(sweep, args.workers)
        if line != shown:
            print(f"\r\033[K{line}" if is_terminal else line, end="" if is_terminal else "\n", flush=True)
            shown = line
        time.sleep(0.2)
    if is_terminal:
        print()
    return report_end(args, sweep, signals)


def report_end(args: Args, sweep: Sweep, signals: list[int]) -> int:
    """Say what failed and what is left. Returns the exit code."""
    print(status_line(sweep, args.workers))
    for run, code in sweep.failed.items():
        print(f"failed: {run.name} (exit code {code}, {log_path(args, run)}):\n{log_end(args, run)}", file=sys.stderr)
    if sweep.stopped:
        print(f"{sweep.stopped}; sent again, the sweep goes on", file=sys.stderr)
    if signals:
        return 128 + signals[0]
    return 1 if sweep.failed or sweep.waiting else 0


# ---------------------------------------------------------------------------------------------------------------------
# On Slurm
# ---------------------------------------------------------------------------------------------------------------------
def run_only(args: Args, runs: list[Run]) -> int:
    """Become the process of one line of the manifest, unless it is done: signals reach it as they come."""
    if not 0 <= args.only < len(runs):
        raise UsageError(f"--only {args.only}: the manifest has lines 0 to {len(runs) - 1}")
    run = runs[args.only]
    if is_done(args.runs / run.name, args.stop_at):
        print(f"{run.name} is done")
        return 0
    command = [*run.command, *(["--stop-at", str(args.stop_at)] if args.stop_at is not None else [])]
    os.environ.update(THREADS)
    os.execvp(command[0], command)


def fill(template: str, values: dict[str, str]) -> str:
    """The template with its {{names}} filled in."""
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def submit(args: Args, runs: list[Run]) -> int:
    """Submit what is not done as arrays of at most `--slurm-chunk` tasks."""
    left = [i for i, run in enumerate(runs) if not is_done(args.runs / run.name, args.stop_at)]
    template = args.slurm_template_path.read_text()
    (args.runs / "slurm").mkdir(exist_ok=True)
    (args.runs / "logs").mkdir(exist_ok=True)
    for number, begin in enumerate(range(0, len(left), args.slurm_chunk)):
        lines = left[begin : begin + args.slurm_chunk]
        flags = [] if args.stop_at is None else ["--stop-at", str(args.stop_at)]
        one = [sys.executable, str(Path(__file__).resolve()), "--runs", str(args.runs), *flags, "--only"]
        values = {
            "array": f"0-{len(lines) - 1}%{args.workers}",
            "lines": " ".join(map(str, lines)),
            "logs": str(args.runs / "logs"),
            "name": args.runs.name,
            "command": shlex.join(one),
        }
        script = args.runs / "slurm" / f"array_{number}.sh"
        script.write_text(fill(template, values))
        done = subprocess.run(["sbatch", "--parsable", str(script)], capture_output=True, text=True)
        if done.returncode:
            print(f"sbatch {script} failed: {done.stderr.strip()}", file=sys.stderr)
            return 1
        print(f"{len(lines)} runs in job {done.stdout.strip()} ({script})")
    if not left:
        print(f"all {len(runs)} runs are done")
    return 0


def main(args: Args) -> int:
    if args.only is not None:
        return run_only(args, read_manifest(args.runs))
    runs = make_runs(args)
    if args.slurm_template_path is not None and not args.slurm_template_path.is_file():
        raise UsageError(f"--slurm-template-path {args.slurm_template_path}: no such file")
    open_manifest(args, runs)
    return submit(args, runs) if args.slurm_template_path is not None else run_here(args, runs)


def cli() -> int:
    try:
        return main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error}; sent again, the sweep goes on", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(cli())
