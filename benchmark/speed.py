"""Steps per second beside peers: alternating whole processes in one run on one machine, one thread each.

    python benchmark/speed.py ppo                                  # about 15 minutes; needs the group `bench`
    python benchmark/speed.py ppo --update-epochs 10 --rounds 1    # a first look
    python benchmark/speed.py apple                                # the game alone, and DQN on it; about 3 minutes
    python benchmark/speed.py gopher                               # DQN on Gopher's pixels; about 8 minutes
    python benchmark/speed.py torcs                                # the simulator alone, and DDPG on it; about 12 minutes
    python benchmark/speed.py gail                                 # GAIL beside TRPO without it; about 3 minutes
    python benchmark/speed.py rooms                                # FourRooms beside MiniGrid; about a minute
    python benchmark/speed.py dreamer                              # a Dreamer's gradient step and its parts; about 15 minutes

Writes `benchmark/results/speed/{ppo_k10,ppo_k80,apple,gopher,torcs,gail,rooms,dreamer}.json` and `.md`: the median of each contender and of its ratios to
the peer, round by round, with their range. The ratios are the result: the machine's own speed drifts.
"""

import json
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from common import ROOT, UsageError, commit, run_main

PEER = "stable-baselines3"


@dataclass
class Args:
    what: tyro.conf.Positional[Literal["ppo", "apple", "gopher", "torcs", "gail", "rooms", "dreamer"]]
    """what to time"""
    rounds: int = 4
    """how often each contender runs, in turn"""
    update_epochs: tuple[int, ...] = (10, 80)
    """the K of PPO to time, each with a result of its own"""
    sheeprl: Path | None = None
    """Python of an environment with sheeprl, a peer of `dreamer`'s size m (benchmark/sheeprl_dreamer.py says how to make one)"""
    out: Path = ROOT / "benchmark" / "results" / "speed"
    """folder for the results"""


@dataclass
class Work:
    """What every contender does."""

    env_id: str
    update_epochs: int | None  # K of PPO
    steps: int


TASKS = ("kle/HalfCheetah-v2", "kle/Hopper-v2")


def run_process(command: list[str], folder: str) -> tuple[str, float]:
    """Run a command; return what it prints and its peak resident memory in MB."""
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
    process = subprocess.Popen(command, cwd=folder, **streams)
    out = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    if status != 0:
        raise SystemExit(f"{' '.join(command)} failed:\n{out}")
    return out, usage.ru_maxrss / 1024


def time_script(*words: object, python: Path | str = sys.executable) -> dict[str, float]:
    """Run a peer's script, which prints its figures as JSON."""
    script, *arguments = map(str, words)
    out, memory = run_process([str(python), str(ROOT / "benchmark" / script), *arguments], str(ROOT))
    return {**json.loads(out.splitlines()[-1]), "peak_memory_mb": memory}


def time_ours(script: str, *flags: object) -> dict[str, float]:
    """Run a method; its steps per second are those of training alone, without start, compilation and evaluation."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, ROOT / "cleanrl_thesis" / script, *flags, "--eval-episodes", 1, "--run-dir", "run"]
        _, memory = run_process([str(word) for word in command], folder)
        result = json.loads((Path(folder) / "run" / "result.json").read_text())
    return {"steps_per_second": result["steps_per_second"], "peak_memory_mb": memory}


def ppo_contenders(work: Work) -> dict:
    flags = ["--env-id", work.env_id, "--update-epochs", work.update_epochs, "--total-timesteps", work.steps]
    return {
        PEER: lambda: time_script("sb3_ppo.py", work.env_id, work.update_epochs, work.steps // 2048),
        "plain": lambda: time_ours("ppo_continuous_kle.py", *flags),
        "--compile": lambda: time_ours("ppo_continuous_kle.py", *flags, "--compile"),
    }


def dqn_contenders(work: Work) -> dict:
    flags = ["--total-timesteps", work.steps]
    return {
        PEER: lambda: time_script("sb3_dqn.py", work.steps),
        "plain": lambda: time_ours("dqn_apple.py", *flags),
        "--compile": lambda: time_ours("dqn_apple.py", *flags, "--compile"),
    }


def gopher_contenders(work: Work) -> dict:
    """Like for like, which is without double and dueling DQN; and as the README trains the teacher."""
    flags = ["--total-timesteps", work.steps, "--buffer-size", 20_000, "--learning-starts", 800]
    simple = [*flags, "--no-double", "--no-dueling"]
    return {
        PEER: lambda: time_script("sb3_dqn_gopher.py", work.steps),
        "plain": lambda: time_ours("dqn_gopher.py", *simple),
        "--bf16": lambda: time_ours("dqn_gopher.py", *simple, "--bf16"),
        "--bf16, double and dueling": lambda: time_ours("dqn_gopher.py", *flags, "--bf16"),
    }


def measure(work: Work, contenders: dict, rounds: int) -> dict:
    """Let the contenders run in turn; return each one's figures, round by round, and its ratios to the first."""
    figures = {name: [] for name in contenders}
    name_of_work = work.env_id if work.update_epochs is None else f"{work.env_id} K={work.update_epochs}"
    for round_number in range(rounds):
        for name, contender in contenders.items():
            figures[name].append(contender())
            speed = figures[name][-1]["steps_per_second"]
            print(f"{name_of_work} round {round_number + 1} {name}: {speed:,.4g} steps/s", flush=True)
    speeds = {name: [row["steps_per_second"] for row in rows] for name, rows in figures.items()}
    peer_speeds = speeds[next(iter(contenders))]
    ratios = {name: [own / peer for own, peer in zip(speeds[name], peer_speeds)] for name in contenders}
    memory = {name: max(row["peak_memory_mb"] for row in rows) for name, rows in figures.items()}
    return {**vars(work), "steps_per_second": speeds, "ratio": ratios, "peak_memory_mb": memory}


def ddpg_contenders(work: Work) -> dict:
    """Like for like with one car; then ten side by side; then as by default, where an action is held for 5 steps."""
    ours = {
        "plain, 1 car": ["--frame-skip", 1, "--num-envs", 1],
        "--compile, 1 car": ["--compile", "--frame-skip", 1, "--num-envs", 1],
        "--compile, 10 cars": ["--compile", "--frame-skip", 1],
        "--compile, 10 cars, 5 steps an action": ["--compile"],
    }

    def contender(flags: list):
        return lambda: time_ours("ddpg_torcs_like.py", "--total-timesteps", work.steps, *flags)

    return {
        PEER: lambda: time_script("sb3_ddpg.py", work.steps // 4),
        **{name: contender(f) for name, f in ours.items()},
    }


def trpo_contenders(work: Work, demos: Path) -> dict:
    """Every step of a batch for the Fisher matrix, as the peer, and a round of the discriminator after each batch."""
    flags = ["--env-id", work.env_id, "--num-envs", 1, "--num-steps", 2048, "--alpha", 1, "--demos-rl", demos]
    flags += ["--fisher-every", 1, "--g-steps", 1, "--bc-epochs", 0, "--total-timesteps", work.steps]
    return {
        "sb3-contrib, TRPO": lambda: time_script("sb3_trpo.py", work.env_id, work.steps // 2048),
        "gail_hybrid.py, GAIL": lambda: time_ours("gail_hybrid.py", *flags),
    }


def time_environment(name: str, num_envs: int, steps: int, rounds: int) -> list[float]:
    """Steps per second of a vectorised environment alone, with random actions, one thread, round by round."""
    import gymnasium as gym
    import numpy as np

    envs = gym.make_vec(name, num_envs=num_envs, vectorization_mode="vector_entry_point")
    envs.reset(seed=1)
    rng = np.random.default_rng(1)
    space = envs.single_action_space
    if isinstance(space, gym.spaces.Discrete):
        actions = rng.integers(0, space.n, (steps, num_envs))
    else:
        actions = rng.uniform((-0.1, 0), (0.1, 1), (steps, num_envs, 2)).astype(np.float32)  # so that the cars drive
    speeds = []
    for _ in range(rounds):
        start = time.perf_counter()
        for action in actions:
            envs.step(action)
        speeds.append(num_envs * steps / (time.perf_counter() - start))
    return speeds


def table(results: list[dict]) -> str:
    """The results as Markdown: medians, and the range of the ratios."""
    lines = ["| task | K | contender | steps/s | ratio | range | peak memory, MB |", "|---|---|---|---|---|---|---|"]
    for row in results:
        for name, ratios in row["ratio"].items():
            speed = f"{statistics.median(row['steps_per_second'][name]):,.0f}"
            spread = f"{min(ratios):.2f} to {max(ratios):.2f}"
            cells = (row["env_id"], row["update_epochs"] or "", name, speed, f"{statistics.median(ratios):.2f}", spread)
            lines.append(f"| {' | '.join(map(str, cells))} | {row['peak_memory_mb'][name]:.0f} |")
    return "\n".join(lines) + "\n"


def write_results(
    args: Args, name: str, flags: str, results: list[dict], more: dict | None = None, text: str | None = None
) -> None:
    """Write the figures as JSON and as a table; `flags` are those that this part of the measurement depends on."""
    line = f"python benchmark/speed.py {args.what}{flags} --rounds {args.rounds}"
    about = {"command": line, "commit": commit(), "python": platform.python_version(), "threads": 1}
    args.out.mkdir(parents=True, exist_ok=True)
    figures = {**about, "cores": os.cpu_count(), **(more or {}), "results": results}
    (args.out / f"{name}.json").write_text(json.dumps(figures, indent=1) + "\n")
    what = "Gradient steps" if text else "Steps per second"
    text = f"{what}, {args.rounds} rounds in turn, one thread each (`{line}`, commit {about['commit']})\n\n{text or table(results)}"
    for key, speeds in (more or {}).items():
        median, low, high = (f"{value / 1e6:.2f}" for value in (statistics.median(speeds), min(speeds), max(speeds)))
        text += f"\n{key}: {median} million steps/s ({low} to {high})\n"
    (args.out / f"{name}.md").write_text(text)
    print(text)


def time_ppo(args: Args) -> None:
    for update_epochs in args.update_epochs:
        steps = 2048 * max(2, 100 // update_epochs)  # the peer's share of a round is about 20 s at K = 10, 40 s at 80
        works = [Work(task, update_epochs, steps) for task in TASKS]
        results = [measure(work, ppo_contenders(work), args.rounds) for work in works]
        write_results(args, f"ppo_k{update_epochs}", f" --update-epochs {update_epochs}", results)


def time_apple(args: Args) -> None:
    name = "cleanrl_thesis.dqn_apple:AppleGame-v0"
    game = {"AppleGame-v0, 4,096 games side by side": time_environment(name, 4096, 1_000, args.rounds)}
    work = Work("AppleGame-v0", None, 50_000)
    write_results(args, "apple", "", [measure(work, dqn_contenders(work), args.rounds)], game)


def time_gopher(args: Args) -> None:
    work = Work("ALE/Gopher-v5", None, 32_000)
    write_results(args, "gopher", "", [measure(work, gopher_contenders(work), args.rounds)])


def time_torcs(args: Args) -> None:
    name = "cleanrl_thesis.ddpg_torcs_like:TorcsLike-v0"
    simulator = {"TorcsLike-v0, 1,024 cars side by side": time_environment(name, 1024, 400, args.rounds)}
    work = Work("TorcsLike-v0", None, 40_000)
    write_results(args, "torcs", "", [measure(work, ddpg_contenders(work), args.rounds)], simulator)


def time_gail(args: Args) -> None:
    work = Work("Hopper-v5", None, 20 * 2048)
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, ROOT / "cleanrl_thesis" / "ppo_continuous_kle.py", "--env-id", work.env_id]
        command += ["--total-timesteps", 2048, "--save-demos", 50, "--eval-episodes", 1, "--run-dir", "expert"]
        run_process([str(word) for word in command], folder)
        contenders = trpo_contenders(work, Path(folder) / "expert" / "demos")
        write_results(args, "gail", "", [measure(work, contenders, args.rounds)])


def rooms_contenders(work: Work) -> dict:
    """Frames of the whole maze at each step: MiniGrid's own (19 × 19 cells), and ours one by one and side by side."""
    return {
        "MiniGrid, RGBImgObsWrapper": lambda: time_script("fourrooms_steps.py", "MiniGrid-FourRooms-v0", 1, 1_000),
        "one game": lambda: time_script("fourrooms_steps.py", work.env_id, 1, 5_000),
        "64 games": lambda: time_script("fourrooms_steps.py", work.env_id, 64, work.steps // 64),
        "256 games": lambda: time_script("fourrooms_steps.py", work.env_id, 256, work.steps // 256),
    }


def time_rooms(args: Args) -> None:
    works = [Work(f"FourRooms{size}-v0", None, 256 * 1_000) for size in (11, 19)]
    write_results(args, "rooms", "", [measure(work, rooms_contenders(work), args.rounds) for work in works])


DREAMERS = {  # rows of the result: script, size, the contenders' flags, of which the first is the plain form
    "xs": ("dreamer_v2", "xs", ["", "--bf16", "--compile"]),
    "m: deter 200, CNN of depth 16, 16 × 50": ("dreamer_v2", "m", ["", "--compile", "--bf16", "--bf16 --compile"]),
    "xs, HWM Dreamer": ("hwm_dreamer", "xs", ["", "--bf16", "--compile"]),
    "xs, HWM HRL Dreamer": ("hwm_hrl_dreamer", "xs", ["", "--bf16", "--compile"]),
}


def dreamer_table(results: list[dict]) -> str:
    """Milliseconds of a gradient step, its ratio to the plain form, and milliseconds of its parts."""
    parts = list(results[0]["milliseconds"]["plain"][0])
    lines = [f"| size | form | ms | ratio | range | {' | '.join(parts)} |", "|" + "---|" * (5 + len(parts))]
    for row in results:
        for name, speeds in row["steps_per_second"].items():
            ratios = [1 / ratio for ratio in row["ratio"][name]]
            cells = [
                row["env_id"],
                name,
                f"{1_000 / statistics.median(speeds):.0f}",
                f"{statistics.median(ratios):.2f}",
            ]
            cells.append(f"{min(ratios):.2f} to {max(ratios):.2f}")
            rounds = row["milliseconds"].get(name)  # a peer has none
            cells += [f"{statistics.median(each[part] for each in rounds):.1f}" if rounds else "" for part in parts]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def time_dreamer(args: Args) -> None:
    """The parts of a gradient step, and at size m that of sheeprl where it is at hand.

    Without bfloat16 instructions the forms with `--bf16` are left out: they would be the others once more.
    """
    import torch

    if args.sheeprl and not args.sheeprl.is_file():
        raise UsageError(f"--sheeprl {args.sheeprl}: must be the Python of an environment with sheeprl")
    look = "import importlib.util, sys; sys.exit(importlib.util.find_spec('sheeprl') is None)"
    if args.sheeprl and subprocess.run([args.sheeprl.absolute(), "-c", look]).returncode:
        raise UsageError(
            f"--sheeprl {args.sheeprl}: has no sheeprl; benchmark/sheeprl_dreamer.py says how to install it"
        )
    results = []
    has_bf16 = torch.ops.mkldnn._is_mkldnn_bf16_supported()
    for title, (script, size, forms) in DREAMERS.items():
        forms = [flags for flags in forms if has_bf16 or "--bf16" not in flags]
        parts: dict[str, list] = {}

        def contender(flags: str, script=script, size=size, parts=parts) -> dict:
            figures = time_script("dreamer_step.py", script, size, *flags.split())
            parts.setdefault(flags or "plain", []).append(figures.pop("milliseconds"))
            return figures

        contenders = {flags or "plain": lambda flags=flags, run=contender: run(flags) for flags in forms}
        if args.sheeprl and size == "m":
            contenders["sheeprl"] = lambda: time_script("sheeprl_dreamer.py", python=args.sheeprl.absolute())
        results.append({**measure(Work(title, None, 1), contenders, args.rounds), "milliseconds": parts})
    write_results(args, "dreamer", " --sheeprl PYTHON" if args.sheeprl else "", results, text=dreamer_table(results))


def main(args: Args) -> None:
    if args.sheeprl and args.what != "dreamer":
        raise UsageError(f"--sheeprl {args.sheeprl}: is a peer of `dreamer` only, not of `{args.what}`")
    times = {"ppo": time_ppo, "apple": time_apple, "torcs": time_torcs, "gail": time_gail, "rooms": time_rooms}
    times |= {"dreamer": time_dreamer, "gopher": time_gopher}
    times[args.what](args)


if __name__ == "__main__":
    for name in ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"):
        os.environ[name] = "1"  # before numpy is imported
    run_main(main, Args, __doc__)
