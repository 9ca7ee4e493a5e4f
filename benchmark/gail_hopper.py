"""GAIL on Hopper from demonstrations of our PPO: how much of the expert's return the student has.

    python benchmark/gail_hopper.py                # 3 seeds: 1,000,000 steps of PPO and 2,000,000 of GAIL each
    python benchmark/gail_hopper.py --seeds 1

After an interruption, run the same command again. Writes `benchmark/results/gail_hopper/{runs.csv,table.md}`.
"""

import json
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

from common import ROOT, commit, commit_of, run_main, write_csv
from intervals import with_interval


@dataclass
class Args:
    seeds: int = 3
    """seeds, from 1 on, each with an expert of its own"""
    workers: int = 2
    """seeds at a time, one thread each"""
    runs: Path = Path("runs/gail_hopper")
    """folder for the runs' folders"""
    out: Path = ROOT / "benchmark" / "results" / "gail_hopper"
    """folder for the results"""


EXPERT = ["--total-timesteps", 1_000_000, "--compile", "--save-demos", 50, "--eval-episodes", 50]
STUDENT = ["--alpha", 1, "--num-envs", 1, "--num-steps", 1_024, "--total-timesteps", 2_000_000, "--eval-episodes", 50]
STUDENT += ["--d-grad-penalty", 1, "--bc-epochs", 0, "--no-anneal-kl"]


def run(script: str, *flags: object) -> None:
    """Run a method on Hopper, or what is left of it."""
    command = [sys.executable, ROOT / "cleanrl_thesis" / script, "--env-id", "Hopper-v5", *flags, "--resume"]
    done = subprocess.run([str(word) for word in command], capture_output=True, text=True)
    if done.returncode:
        raise SystemExit(f"{' '.join(map(str, command))} failed:\n{done.stderr}")


def row(seed: int, args: Args) -> dict:
    """Train an expert and its student; return their returns."""
    expert, student = args.runs / f"expert_seed{seed}", args.runs / f"student_seed{seed}"
    run("ppo_continuous_kle.py", *EXPERT, "--seed", seed, "--run-dir", expert)
    run("gail_hybrid.py", *STUDENT, "--seed", seed, "--demos-rl", expert / "demos", "--run-dir", student)
    results = [json.loads((folder / "result.json").read_text()) for folder in (expert, student)]
    evaluation = results[1]["evaluation"]
    return {
        "seed": seed,
        "expert": round(results[0]["evaluation"]["mean"], 1),
        "demonstrations": round(results[1]["experts"]["rl"]["mean"], 1),
        **{mode: round(evaluation[mode]["mean"], 1) for mode in ("sampled", "greedy")},
        "share": round(evaluation["sampled"]["mean"] / results[0]["evaluation"]["mean"], 3),
        "training_seconds": round(sum(result["training_seconds"] for result in results)),
        "ppo_sha256": results[0]["script_sha256"][:12],
        "gail_sha256": results[1]["script_sha256"][:12],
    }


def main(args: Args) -> None:
    with ThreadPoolExecutor(args.workers) as pool:
        rows = list(pool.map(lambda seed: row(seed, args), range(1, args.seeds + 1)))
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "runs.csv", rows)
    names = ("seed", "expert", "demonstrations", "sampled", "greedy", "share")
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    means = [with_interval([row[name] for row in rows], 3 if name == "share" else 1) for name in names[1:]]
    lines.append(f"| mean | {' | '.join(means)} |")
    made_at = [
        f"{script}.py at {', '.join(sorted({commit_of(script, row[key]) for row in rows}))}"
        for script, key in (("ppo_continuous_kle", "ppo_sha256"), ("gail_hybrid", "gail_sha256"))
    ]
    text = (
        f"`python benchmark/gail_hopper.py --seeds {args.seeds}`, commits: {'; '.join(made_at)}; this table at {commit()}."
        f" {sum(row['training_seconds'] for row in rows) / 3600:.1f} core-hours. Mean returns of 50 episodes each; share is "
        f"the sampled student's of the expert's, ± a 95% t-interval over seeds. Students: `{' '.join(map(str, STUDENT))}`.\n\n"
        + "\n".join(lines)
        + "\n"
    )
    (args.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
