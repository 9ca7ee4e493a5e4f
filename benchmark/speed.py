"""Steps per second beside peers: alternating whole processes in one run on one machine, one thread each.

    python benchmark/speed.py ppo                 # about 15 minutes; needs the group `bench`
    python benchmark/speed.py ppo --rounds 1      # a first look

Writes `benchmark/results/speed/ppo.json` and `ppo.md`: the median of each contender and of its ratios to the peer, round
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
    out: Path = ROOT / "benchmark" / "results" / "speed"
    """folder for the results"""


@dataclass
class Work:
    """What every contender does: `iterations` of 2,048 steps and K update iterations."""

    env_id: str
    update_epochs: int
    iterations: int


PPO_WORK = [
    Work("kle/HalfCheetah-v2", 10, 10),
    Work("kle/Hopper-v2", 10, 10),
    Work("kle/HalfCheetah-v2", 80, 2),
    Work("kle/Hopper-v2", 80, 2),
]


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


def main(args: Args) -> None:
    results = []
    args.out.mkdir(parents=True, exist_ok=True)
    commit = subprocess.run(["git", "rev-parse", "HEAD"], cwd=ROOT, capture_output=True, text=True).stdout.strip()
    about = {"command": f"python benchmark/speed.py {args.what} --rounds {args.rounds}", "commit": commit}
    about |= {"python": platform.python_version(), "threads": 1, "cores": os.cpu_count()}
    for work in PPO_WORK:
        results.append(measure(work, args.rounds))
        (args.out / f"{args.what}.json").write_text(json.dumps({**about, "results": results}, indent=1) + "\n")
    heading = (
        f"Steps per second, {args.rounds} rounds in turn, one thread each (`{about['command']}`, commit {commit[:7]})"
    )
    (args.out / f"{args.what}.md").write_text(f"{heading}\n\n{table(results)}")
    print(table(results))


if __name__ == "__main__":
    main(tyro.cli(Args))
