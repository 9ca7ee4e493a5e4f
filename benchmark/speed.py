"""Steps per second beside peers: alternating whole processes in one run on one machine, one thread each.

    python benchmark/speed.py ppo                                  # about 15 minutes; needs the group `bench`
    python benchmark/speed.py ppo --update-epochs 10 --rounds 1    # a first look

Writes `benchmark/results/speed/ppo_k10.json` and `.md`, and the same for K = 80: the median of each contender and of its ratios to the peer, round
by round, with their range. The ratios are the result: the machine's own speed drifts.
"""

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro

ROOT = Path(__file__).resolve().parent.parent
PEER = "stable-baselines3"


@dataclass
class Args:
    what: tyro.conf.Positional[Literal["ppo"]]
    """what to time"""
    rounds: int = 4
    """how often each contender runs, in turn"""
    update_epochs: tuple[int, ...] = (10, 80)
    """the K to time, each with a result of its own"""
    out: Path = ROOT / "benchmark" / "results" / "speed"
    """folder for the results"""


@dataclass
class Work:
    """What every contender does: `iterations` of 2,048 steps and K update iterations."""

    env_id: str
    update_epochs: int
    iterations: int


TASKS = ("kle/HalfCheetah-v2", "kle/Hopper-v2")


def run_process(command: list[str], folder: str) -> tuple[str, float]:
    """Run a command with one thread; return what it prints and its peak resident memory in MB."""
    single = {name: "1" for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS")}
    env = {**os.environ, **single}
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, cwd=folder, env=env, **streams)
    out = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise SystemExit(f"{' '.join(command)} failed:\n{out}")
    return out, usage.ru_maxrss / 1024


def time_peer(work: Work) -> dict[str, float]:
    command = [sys.executable, str(ROOT / "benchmark" / "sb3_ppo.py"), work.env_id]
    out, memory = run_process([*command, str(work.update_epochs), str(work.iterations)], str(ROOT))
    return {**json.loads(out.splitlines()[-1]), "peak_memory_mb": memory}


def time_ours(work: Work, *flags: str) -> dict[str, float]:
    script = ROOT / "cleanrl_thesis" / "ppo_continuous_kle.py"
    steps = 2048 * work.iterations
    settings = ["--env-id", work.env_id, "--update-epochs", work.update_epochs, "--total-timesteps", steps]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, script, *settings, "--eval-episodes", 1, "--run-dir", "run", *flags]
        _, memory = run_process([str(word) for word in command], folder)
        result = json.loads((Path(folder) / "run" / "result.json").read_text())
    return {"steps_per_second": result["steps_per_second"], "peak_memory_mb": memory}


CONTENDERS = {PEER: time_peer, "plain": time_ours, "--compile": lambda work: time_ours(work, "--compile")}


def measure(work: Work, rounds: int) -> dict:
    """Let the contenders run in turn; return each one's figures, round by round, and its ratios to the peer."""
    figures = {name: [] for name in CONTENDERS}
    for round_number in range(rounds):
        for name, contender in CONTENDERS.items():
            figures[name].append(contender(work))
            speed = figures[name][-1]["steps_per_second"]
            print(
                f"{work.env_id} K={work.update_epochs} round {round_number + 1} {name}: {speed:,.0f} steps/s",
                flush=True,
            )
    speeds = {name: [row["steps_per_second"] for row in rows] for name, rows in figures.items()}
    ratios = {name: [own / peer for own, peer in zip(speeds[name], speeds[PEER])] for name in CONTENDERS}
    memory = {name: max(row["peak_memory_mb"] for row in rows) for name, rows in figures.items()}
    return {**vars(work), "steps_per_second": speeds, "ratio": ratios, "peak_memory_mb": memory}


def table(results: list[dict]) -> str:
    """The results as Markdown: medians, and the range of the ratios."""
    lines = ["| task | K | contender | steps/s | ratio | range | peak memory, MB |", "|---|---|---|---|---|---|---|"]
    for row in results:
        for name, ratios in row["ratio"].items():
            speed = f"{statistics.median(row['steps_per_second'][name]):,.0f}"
            spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
            cells = (row["env_id"], row["update_epochs"], name, speed, f"{statistics.median(ratios):.2f}", spread)
            lines.append(f"| {' | '.join(map(str, cells))} | {row['peak_memory_mb'][name]:.0f} |")
    return "\n".join(lines) + "\n"


def write_results(args: Args, update_epochs: int, results: list[dict]) -> None:
    """Write the figures of one K as JSON and as a table."""
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    line = f"python benchmark/speed.py {args.what} --update-epochs {update_epochs} --rounds {args.rounds}"
    about = {"command": line, "commit": commit, "python": platform.python_version(), "threads": 1}
    args.out.mkdir(parents=True, exist_ok=True)
    path = args.out / f"{args.what}_k{update_epochs}"
    path.with_suffix(".json").write_text(
        json.dumps({**about, "cores": os.cpu_count(), "results": results}, indent=1) + "\n"
    )
    heading = f"Steps per second, {args.rounds} rounds in turn, one thread each (`{line}`, commit {commit[:7]})"
    path.with_suffix(".md").write_text(f"{heading}\n\n{table(results)}")
    print(table(results))


def main(args: Args) -> None:
    for update_epochs in args.update_epochs:
        iterations = max(2, 100 // update_epochs)  # the peer's share of a round is about 20 s at K = 10, 40 s at 80
        results = [measure(Work(task, update_epochs, iterations), args.rounds) for task in TASKS]
        write_results(args, update_epochs, results)


if __name__ == "__main__":
    main(tyro.cli(Args))
