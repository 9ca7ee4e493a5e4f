"""Runs a sweep: every environment, seed and setting of a grid, on this machine or on a Slurm cluster.

    python benchmark/sweep.py --command "python cleanrl_thesis/ppo_continuous_kle.py --compile" \\
        --env-ids kle/Hopper-v2 kle/Walker2d-v2 --num-seeds 2 --grid update-epochs=4,10,20 \\
        --variants none kle-stop,d-target=0.03 --runs runs/my_sweep --workers 2

`{name}.jsonl` in the folder of the runs, the manifest, has a line for each of them. Sent again, the sweep goes on with what
is not done; a finished run is never run again, also where another sweep in the same folder has finished it. `--stop-at
STEPS` ends all runs early on their full schedule, and a later sweep without it finishes them. `--slurm-template-path
benchmark/slurm_template.sh` submits arrays instead, of which `--workers` tasks run at a time. `--lines FILE` has a run on each
line, its name and its flags, in place of a grid: so the other studies beside this script use it.

The command must understand `--env-id`, `--seed`, `--run-dir`, `--resume` and `--stop-at`, and write a `result.json` at its
end, as all methods here do (hwm_segment.py has no `--env-id`: its environment is that of the demonstrations).
"""

import contextlib
import fcntl
import hashlib
import itertools
import json
import math
import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

from common import UsageError, parse_args


@dataclass
class Args:
    command: str = ""
    """what each run starts with, in quotes: interpreter, script and the flags that all runs share"""
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
    lines: Path | None = None
    """file with the name and the flags of a run on each line, in place of environments, seeds and grid; - for standard input"""
    runs: Path = Path("runs/sweep")
    """folder for the manifest, the runs' folders and logs"""
    name: str = "sweep"
    """name of the manifest; several sweeps may share a folder, and the runs that they have in common"""
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
    slurm_memory: str = "2G"
    """memory of a task, as Slurm writes it"""
    queued_code: int = 0
    """exit code where runs were submitted to Slurm; for scripts that go on once all are done"""
    only: int | None = None
    """run this line of the manifest alone, from 0 on; for the tasks of an array"""


def require(holds: bool, complaint: str) -> None:
    if not holds:
        raise UsageError(complaint)


# ---------------------------------------------------------------------------------------------------------------------
# The manifest
# ---------------------------------------------------------------------------------------------------------------------
@dataclass(frozen=True)
class Run:
    """A line of the manifest."""

    name: str  # of its folder
    command: tuple[str, ...]

    def line(self) -> str:
        return json.dumps({"name": self.name, "command": self.command})

    def setting(self) -> str:
        """What runs that take about as long have in common: the name without its seed, of a grid also without its environment."""
        name = re.sub(r"_+seed\d+$", "", self.name)
        return name.partition("__")[2] if "__seed" in self.name else name

    def stop_at(self) -> int | None:
        """The `--stop-at` of its own. Raises UsageError where that is no number."""
        for word, following in zip(self.command, (*self.command[1:], "")):
            flag, equals, value = word.partition("=")
            if flag.replace("_", "-") == "--stop-at":
                value = value if equals else following
                require(value.isdigit(), f"{self.name}: {flag} {value}: must be a number of steps")
                return int(value)
        return None


def parse_grid(entries: tuple[str, ...]) -> list[list[tuple[str, str]]]:
    """`FLAG=VALUE,VALUE` -> for each entry its (flag, value) pairs. Raises UsageError."""
    axes: dict[str, list[tuple[str, str]]] = {}
    for entry in entries:
        flag, _, values = entry.partition("=")
        flag = flag.removeprefix("--").replace("_", "-")
        require(bool(flag) and all(values.split(",")), f"--grid {entry}: must be FLAG=VALUE,VALUE,...")
        require(flag not in axes, f"--grid {entry}: the flag is there twice")
        axes[flag] = [(flag, value) for value in values.split(",")]
    return list(axes.values())


def parse_variant(text: str) -> list[str]:
    """`FLAG,FLAG=VALUE` -> words of a command line; no word of `none`. Raises UsageError."""
    words = []
    for part in [] if text == "none" else text.split(","):
        flag, equals, value = part.partition("=")
        flag = flag.removeprefix("--").replace("_", "-")
        holds = bool(flag) and bool(value) == bool(equals)
        require(holds, f"--variants {text}: must be FLAG,FLAG=VALUE,... or none")
        words += [f"--{flag}", *([value] if equals else [])]
    return words


def slug(text: str) -> str:
    """Part of a folder's name: what a shell need not quote."""
    return re.sub(r"[^A-Za-z0-9.=-]+", "_", text.replace("--", "")).strip("_")


def make_runs(args: Args) -> list[Run]:
    """All runs, in the order in which they are started. Raises UsageError."""
    command = "--command: give interpreter, script and the flags that all runs share, in quotes"
    require(bool(words_of(args.command)), command)
    named = bool(args.name) and slug(args.name) == args.name
    require(named, f"--name {args.name}: must be letters, digits and any of . = - _, the last not at an end")
    for name, least in (("num_seeds", 1), ("start_seed", 0), ("workers", 1), ("retries", 0), ("slurm_chunk", 1)):
        value = getattr(args, name)
        require(value >= least, f"--{name.replace('_', '-')} {value}: must be at least {least}")
    memory = re.fullmatch(r"[1-9]\d*[KMGT]?", args.slurm_memory) is not None
    require(memory, f"--slurm-memory {args.slurm_memory}: must be a number, with K, M, G or T")
    require(args.stop_at is None or args.stop_at >= 1, f"--stop-at {args.stop_at}: must be at least 1")
    runs = grid_runs(args) if args.lines is None else line_runs(args)
    name, number = Counter(run.name for run in runs).most_common(1)[0]
    flags = "--env-ids, --grid, --variants" if args.lines is None else f"--lines {args.lines}"
    require(number == 1, f"{flags}: {number} runs would have the folder {name}")
    for run in runs:
        run.stop_at()
    return runs


def words_of(command: str) -> list[str]:
    """The words of `--command`. Raises UsageError where a shell would see none."""
    try:
        return shlex.split(command)
    except ValueError as error:
        raise UsageError(f"--command {command}: {error}") from None


def make_run(args: Args, name: str, flags: list[str]) -> Run:
    words = [*words_of(args.command), *flags]
    return Run(name, (*words, "--run-dir", str(args.runs / name), "--resume"))


def grid_runs(args: Args) -> list[Run]:
    """A run for each environment, seed and setting; seeds outermost: whatever part is done has every setting. Raises UsageError."""
    require(bool(args.env_ids), "--env-ids: name at least one environment")
    axes, seeds = parse_grid(args.grid), range(args.start_seed, args.start_seed + args.num_seeds)
    runs = []
    for seed, variant, values, env_id in itertools.product(
        seeds, args.variants, itertools.product(*axes), args.env_ids
    ):
        setting = ["" if variant == "none" else variant, *(f"{flag}={value}" for flag, value in values)]
        name = "__".join(slug(part) for part in (env_id, *setting, f"seed{seed}") if part)
        flags = [word for flag, value in values for word in (f"--{flag}", value)] + parse_variant(variant)
        runs.append(make_run(args, name, ["--env-id", env_id, "--seed", str(seed), *flags]))
    return runs


def line_runs(args: Args) -> list[Run]:
    """The runs of `--lines`. Raises UsageError."""
    require(not args.env_ids and not args.grid, f"--lines {args.lines}: is in place of --env-ids and --grid")
    try:
        text = sys.stdin.read() if str(args.lines) == "-" else args.lines.read_text()
        lines = [shlex.split(line) for line in text.splitlines() if line.strip()]
    except (OSError, ValueError) as error:
        raise UsageError(f"--lines {args.lines}: cannot be read: {error}") from None
    require(bool(lines), f"--lines {args.lines}: holds no run")
    strange = next((name for name, *_ in lines if not re.fullmatch(r"(?!\.+$)[\w.=-]+", name)), None)
    require(strange is None, f"--lines {args.lines}: {strange}: must be the name of a folder")
    return [make_run(args, name, flags) for name, *flags in lines]


def manifest_path(args: Args) -> Path:
    return args.runs / f"{args.name}.jsonl"


def read_manifest(path: Path) -> list[Run]:
    """The runs of a sweep. Raises UsageError where there is no manifest."""
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        return [Run(row["name"], tuple(row["command"])) for row in rows]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UsageError(f"{path}: no readable manifest: {error}") from None


def check_begun(args: Args, runs: list[Run], manifests: dict[Path, list[Run]]) -> None:
    """Raise UsageError unless all that was begun in the folder belongs to this sweep, or to another that is known."""
    path = manifest_path(args)
    begun = [run for run in manifests.get(path, []) if (args.runs / run.name).exists()]
    differs = f"{path}: is of another sweep, which has begun {len(begun)} runs; give another --name or --runs"
    require(not begun, differs)
    known = {run.name: (run.command, other) for other, old in manifests.items() if other != path for run in old}
    for run in runs:
        if (args.runs / run.name).exists():
            command, other = known.get(run.name, ((), path))
            require(command == run.command, f"{args.runs / run.name}: {other} has no such run; give another --runs")


def check_manifest(args: Args, runs: list[Run]) -> None:
    """Raise UsageError where runs were begun otherwise, or cannot begin."""
    require(args.runs.is_dir() or not args.runs.exists(), f"--runs {args.runs}: must be a folder")
    for script in [word for word in words_of(args.command) if word.endswith(".py")][:1]:
        require(Path(script).is_file(), f"--command {args.command}: there is no {script}")
    path = manifest_path(args)
    manifests = {other: read_manifest(other) for other in sorted(args.runs.glob("*.jsonl"))}
    if args.lines is None and manifests.get(path) != runs:  # lines may change: each run compares its own arguments
        check_begun(args, runs, manifests)


@contextlib.contextmanager
def hold(args: Args):
    """Keep the sweep for oneself. Raises UsageError where it is running."""
    args.runs.mkdir(parents=True, exist_ok=True)
    with open(manifest_path(args).with_suffix(".lock"), "w") as lock:  # beside the manifest, which is replaced
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise UsageError(f"{manifest_path(args)}: this sweep is running") from None
        yield


def write_manifest(args: Args, runs: list[Run]) -> None:
    """Write the manifest, whole or not at all."""
    path = manifest_path(args)
    draft = path.with_suffix(".tmp")
    with open(draft, "w") as file:
        file.writelines(run.line() + "\n" for run in runs)
        file.flush()
        os.fsync(file.fileno())
    draft.replace(path)


def read_result(folder: Path) -> dict | None:
    """What a run wrote at its end; None while it is not done."""
    try:
        return json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return None


def is_done(args: Args, run: Run, result: dict | None) -> bool:
    """Whether a run has come to the end of its schedule, or to its `--stop-at`."""
    stops = [run.stop_at(), args.stop_at, math.inf]
    stop_at = next(stop for stop in stops if stop is not None)
    return result is not None and (result.get("complete", False) or result.get("global_step", 0) >= stop_at)


# ---------------------------------------------------------------------------------------------------------------------
# On this machine
# ---------------------------------------------------------------------------------------------------------------------
BUSY = "another process is running in it"  # a run that an earlier, killed sweep has left behind
BUSY_WAIT = 5.0  # s until it is tried again
THREADS = {f"{name}_NUM_THREADS": "1" for name in ("OMP", "MKL", "OPENBLAS")}


@dataclass
class Sweep:
    """What is where; changed by the workers under `lock`."""

    waiting: deque[Run] = field(default_factory=deque)
    running: dict[Run, tuple[subprocess.Popen, float]] = field(default_factory=dict)  # with the time of the start
    done: int = 0
    failed: dict[Run, int] = field(default_factory=dict)  # with the exit code
    failures: Counter[Run] = field(default_factory=Counter)
    seconds: dict[str, list[float]] = field(default_factory=dict)  # of training, by setting
    first: Run | None = None  # whose failure ends the sweep, while nothing is done
    stopped: str = ""  # why nothing more is started
    lock: threading.Lock = field(default_factory=threading.Lock)


def begin_sweep(args: Args, runs: list[Run]) -> Sweep:
    """A sweep with what is done and what is not."""
    sweep = Sweep()
    for run in runs:
        result = read_result(args.runs / run.name)
        if is_done(args, run, result):
            count_done(sweep, run, result)
        else:
            sweep.waiting.append(run)
    if not sweep.done and sweep.waiting:
        sweep.first = sweep.waiting[0]
    return sweep


def count_done(sweep: Sweep, run: Run, result: dict) -> None:
    sweep.done += 1
    sweep.seconds.setdefault(run.setting(), []).append(result.get("training_seconds", 0.0))


def command_of(args: Args, run: Run) -> list[str]:
    """The words that start a run; one that has a `--stop-at` of its own keeps it."""
    stops_here = args.stop_at is not None and run.stop_at() is None
    return [*run.command, *(["--stop-at", str(args.stop_at)] if stops_here else [])]


def log_path(args: Args, run: Run) -> Path:
    return args.runs / "logs" / f"{run.name}.log"


def log_end(args: Args, run: Run, lines: int = 15) -> str:
    """The last lines that a run printed."""
    try:
        return "\n".join(
            f"    {line}" for line in log_path(args, run).read_text(errors="replace").splitlines()[-lines:]
        )
    except OSError as error:
        return f"    {error}"


def start(args: Args, run: Run) -> subprocess.Popen:
    """Start a run in a session of its own, so that Ctrl-C reaches it by this script alone."""
    with open(log_path(args, run), "ab") as log:
        log.write(f"$ {shlex.join(command_of(args, run))}\n".encode())
        log.flush()
        environment = {**os.environ, **THREADS}
        streams = {"stdin": subprocess.DEVNULL, "stdout": log, "stderr": subprocess.STDOUT}
        command = [*leash(), *command_of(args, run)]
        return subprocess.Popen(command, **streams, env=environment, start_new_session=True)


def leash() -> list[str]:
    """Words that let a run write a checkpoint and end when this script is killed; none where util-linux is missing."""
    return ["setpriv", "--pdeathsig", "TERM", "--"] if shutil.which("setpriv") else []


def settle(args: Args, sweep: Sweep, run: Run, code: int) -> bool:
    """Put a run whose process has ended where it belongs. Returns whether it was found busy."""
    del sweep.running[run]
    result = read_result(args.runs / run.name)
    is_busy = code == 2 and BUSY in log_end(args, run, 1)
    if code == 0 and is_done(args, run, result):
        count_done(sweep, run, result)
    elif is_busy or sweep.stopped:
        sweep.waiting.append(run)
    else:
        sweep.failures[run] += 1
        if code != 2 and sweep.failures[run] <= args.retries:
            sweep.waiting.appendleft(run)
        else:
            sweep.failed[run] = code
            if run == sweep.first and not sweep.done:
                sweep.stopped = "the first run failed, so the others were stopped"
    return is_busy


def work(args: Args, sweep: Sweep) -> None:
    """One worker; what it fails of ends the sweep."""
    try:
        run_waiting(args, sweep)
    except Exception as error:
        sweep.stopped = f"failed: {error!r}"


def run_waiting(args: Args, sweep: Sweep) -> None:
    """Run after run until none is waiting."""
    while True:
        with sweep.lock:
            if sweep.stopped or not sweep.waiting:
                return
            run = sweep.waiting.popleft()
            try:
                process = start(args, run)
            except OSError as error:
                sweep.waiting.appendleft(run)
                sweep.stopped = sweep.stopped or f"{run.name} could not be started: {error}"
                return
            sweep.running[run] = process, time.monotonic()
        code = process.wait()
        with sweep.lock:
            is_busy = settle(args, sweep, run, code)
        if is_busy:
            time.sleep(BUSY_WAIT)


def core_hours_left(sweep: Sweep) -> float | None:
    """Mean training time of the same settings for each run that is left, of all where none is done; None at the start."""
    if not sweep.done:
        return None
    means = {setting: sum(seconds) / len(seconds) for setting, seconds in sweep.seconds.items()}
    overall = sum(means.values()) / len(means)
    left = [means.get(run.setting(), overall) for run in (*sweep.waiting, *sweep.running)]
    return sum(left) / 3600


def status_line(sweep: Sweep) -> str:
    """Numbers of runs, and what is left to do."""
    hours = core_hours_left(sweep)
    left = "" if hours is None else f"; about {hours:.1f} core-hours left"
    numbers = f"{sweep.done} done, {len(sweep.running)} running, {len(sweep.waiting)} waiting"
    return f"{numbers}, {len(sweep.failed)} failed{left}"


def live_table(sweep: Sweep) -> list[str]:
    """The status, and a line for each run that is running."""
    now = time.monotonic()
    return [status_line(sweep), *(f"  {now - began:6.0f} s  {run.name}" for run, (_, began) in sweep.running.items())]


def show(sweep: Sweep, shown: list[str]) -> list[str]:
    """Draw the table over the one before on a terminal; elsewhere print the status where it has changed."""
    with sweep.lock:
        lines = live_table(sweep)
    if sys.stdout.isatty():
        size = shutil.get_terminal_size()
        lines = [line[: size.columns - 1] for line in lines[: size.lines - 1]]
        up = f"\033[{len(shown)}F" if shown else ""
        print(f"{up}\033[J" + "\n".join(lines), flush=True)
    elif lines[0] != (shown or [""])[0]:
        print(lines[0], flush=True)
    return lines


def signal_all(sweep: Sweep, number: int) -> None:
    with sweep.lock:
        for process, _ in sweep.running.values():
            process.send_signal(number)


@dataclass
class Signals:
    """Ctrl-C, SIGTERM and SIGHUP as they come: the first lets all runs write a checkpoint, the second kills them."""

    received: list[int] = field(default_factory=list)
    obeyed: int = 0

    def install(self) -> None:
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:  # as `nohup` leaves it
                signal.signal(number, lambda number, frame: self.received.append(number))

    def obey(self, sweep: Sweep) -> None:
        """Pass on what has come since."""
        for number in self.received[self.obeyed :]:
            sweep.stopped = f"stopped by signal {number}"
            signal_all(sweep, signal.SIGTERM if self.obeyed == 0 else signal.SIGKILL)
            self.obeyed += 1


def run_here(args: Args, runs: list[Run]) -> int:
    """Run what is not done with a pool of workers. Returns the exit code."""
    (args.runs / "logs").mkdir(exist_ok=True)
    signals = Signals()
    signals.install()
    sweep = begin_sweep(args, runs)
    workers = [threading.Thread(target=work, args=(args, sweep), daemon=True) for _ in range(args.workers)]
    for worker in workers:
        worker.start()
    try:
        watch(sweep, workers, signals)
    finally:  # also where the table cannot be printed: no run is left behind
        if any(worker.is_alive() for worker in workers):
            sweep.stopped = sweep.stopped or "interrupted"
            signal_all(sweep, signal.SIGTERM)
        for worker in workers:
            worker.join()
    return report_end(args, sweep, signals)


def watch(sweep: Sweep, workers: list[threading.Thread], signals: Signals) -> None:
    """Show what goes on until all workers have ended."""
    shown, is_stopping = [], False
    while any(worker.is_alive() for worker in workers):
        signals.obey(sweep)
        if sweep.stopped and not signals.obeyed and not is_stopping:
            is_stopping = True
            signal_all(sweep, signal.SIGTERM)
        shown = show(sweep, shown)
        time.sleep(0.2)
    show(sweep, shown)


def report_end(args: Args, sweep: Sweep, signals: Signals) -> int:
    """Say what failed and what is left. Returns the exit code."""
    for run, code in sweep.failed.items():
        print(f"failed: {run.name} (exit code {code}, {log_path(args, run)}):\n{log_end(args, run)}", file=sys.stderr)
    if sweep.stopped:
        print(f"{sweep.stopped}; run the same command again to continue", file=sys.stderr)
    if signals.received:
        return 128 + signals.received[0]
    return 1 if sweep.failed or sweep.stopped else 0


# ---------------------------------------------------------------------------------------------------------------------
# On Slurm
# ---------------------------------------------------------------------------------------------------------------------
def run_only(args: Args) -> int:
    """Become the process of one line of the manifest, unless it is done: signals reach it as they come."""
    runs = read_manifest(manifest_path(args))
    require(0 <= args.only < len(runs), f"--only {args.only}: the manifest has lines 0 to {len(runs) - 1}")
    run = runs[args.only]
    if is_done(args, run, read_result(args.runs / run.name)):
        print(f"{run.name} is done")
        return 0
    os.environ.update(THREADS)
    command = command_of(args, run)
    os.execvp(command[0], command)


def slurm(*words: str) -> str:
    """What a command of Slurm prints. Raises UsageError where it fails or is not installed."""
    try:
        done = subprocess.run(words, capture_output=True, text=True)
    except FileNotFoundError:
        raise UsageError(f"--slurm-template-path: {words[0]} is not installed here") from None
    require(done.returncode == 0, f"{shlex.join(words)} failed: {done.stderr.strip()}")
    return done.stdout.strip()


def fill(template: str, values: dict[str, str]) -> str:
    """The template with its {{names}} filled in. Raises UsageError for a name that is not there."""
    for name in re.findall(r"\{\{(\w+)\}\}", template):
        require(name in values, f"--slurm-template-path: {{{{{name}}}}} must be one of {', '.join(values)}")
    return re.sub(r"\{\{(\w+)\}\}", lambda match: values[match[1]], template)


def chunks(items: list[int], size: int) -> Iterator[list[int]]:
    for begin in range(0, len(items), size):
        yield items[begin : begin + size]


def free_job_name(args: Args) -> str:
    """The name of a sweep's jobs. Raises UsageError where some are queued, which still read the manifest."""
    folder = str(args.runs.resolve())
    require(not re.search(r"\s", folder), f"--runs {args.runs}: must be without blanks for Slurm")
    job_name = f"{args.runs.name}-{args.name}-{hashlib.sha256(folder.encode()).hexdigest()[:6]}"
    queued = slurm("squeue", "--me", "--noheader", "--format=%A", f"--name={job_name}")
    require(not queued, f"--name {args.name}: jobs of this sweep are still queued, squeue --name={job_name}")
    return job_name


def submit(args: Args, runs: list[Run], job_name: str) -> int:
    """Submit what is not done as arrays of at most `--slurm-chunk` tasks, one after the other. Returns the exit code.

    Raises UsageError.
    """
    left = [i for i, run in enumerate(runs) if not is_done(args, run, read_result(args.runs / run.name))]
    template = args.slurm_template_path.read_text()
    for part in ("slurm", "logs"):
        (args.runs / part).mkdir(exist_ok=True)
    after: list[str] = []
    one = [sys.executable, str(Path(__file__).resolve()), "--runs", str(args.runs), "--name", args.name]
    one += [] if args.stop_at is None else ["--stop-at", str(args.stop_at)]
    for number, lines in enumerate(chunks(left, args.slurm_chunk)):
        values = {
            "name": job_name,
            "array": f"0-{len(lines) - 1}%{args.workers}",
            "lines": " ".join(map(str, lines)),
            "memory": args.slurm_memory,
            "logs": f"{args.runs.resolve()}/logs",
            "retries": str(args.retries),
            "command": shlex.join([*one, "--only"]),
        }
        script = args.runs / "slurm" / f"{args.name}_{number}.sh"
        script.write_text(fill(template, values))
        job = slurm("sbatch", "--parsable", *after, str(script))
        print(f"{len(lines)} runs in job {job} ({script})")
        after = [f"--dependency=afterany:{job}"]  # so that --workers holds for all of them
    if not left:
        print(f"all {len(runs)} runs are done")
    return args.queued_code if left else 0


def main(args: Args) -> int:
    if args.only is not None:
        return run_only(args)
    runs = make_runs(args)
    template = args.slurm_template_path
    require(template is None or template.is_file(), f"--slurm-template-path {template}: no such file")
    job_name = "" if template is None else free_job_name(args)
    check_manifest(args, runs)
    with hold(args):
        write_manifest(args, runs)
        return run_here(args, runs) if template is None else submit(args, runs, job_name)


def cli() -> int:
    try:
        return main(parse_args(Args, __doc__))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error}; run the same command again to continue", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(cli())
