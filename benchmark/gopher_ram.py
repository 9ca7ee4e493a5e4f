"""Gopher from the console's memory: runs of benchmark/gopher_ram.sh -> their scores beside random play, and learning curves.

    python benchmark/gopher_ram.py        # runs/gopher_ram -> benchmark/results/gopher/ram.csv, ram.md and ram.png

The interval is a 95% t-interval over seeds. Random play is of `benchmark/results/gopher/players.csv`.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, UsageError, commit, commit_of, distinct, finished_runs, read_csv, run_main, write_csv
from gopher_report import WINDOW, dqn_curve
from intervals import with_interval
from matplotlib.figure import Figure

GAMES = ("training", "evaluation")


@dataclass
class Args:
    runs: Path = Path("runs/gopher_ram")
    """folder of the runs' folders"""
    out: Path = ROOT / "benchmark" / "results" / "gopher"
    """folder for table and figure"""


def random_score() -> float:
    """The mean points of a game of random play."""
    rows = read_csv(ROOT / "benchmark" / "results" / "gopher" / "players.csv")
    return next(float(row["mean"]) for row in rows if row["player"] == "random" and row["unit"] == "points of a game")


def row_of(run: Path, result: dict) -> dict:
    """What a run scored in points, and what it took."""
    row = {
        "seed": result["seed"],
        "frames": result["global_step"],
        "minutes": round(result["training_seconds"] / 60, 1),
    }
    for name in GAMES:
        row |= {f"{name}_{key}": round(result[name][key], 1) for key in ("episodes", "mean", "std")}
    row["rewards_of_a_life"] = round(result["evaluation"]["rewards_per_life"]["mean"], 2)
    return row | {"script_sha256": result["script_sha256"][:12]}


def table(rows: list[dict], random: float) -> str:
    """A line for each seed, and one for all."""
    games = {name: distinct(rows, f"{name}_episodes") for name in GAMES}
    lines = [
        f"| seed | frames | minutes | last {games['training']} games of training | {games['evaluation']} games of evaluation | of random play's | rewards of a life |"
    ]
    lines.append("|" + "---|" * 7)
    for row in rows:
        scores = f"{row['training_mean']:,.0f} ± {row['training_std']:,.0f} | {row['evaluation_mean']:,.0f} ± {row['evaluation_std']:,.0f}"
        times = f"{row['evaluation_mean'] / random:.1f} | {row['rewards_of_a_life']:.1f}"
        lines.append(f"| {row['seed']} | {row['frames']:,} | {row['minutes']} | {scores} | {times} |")
    means = {name: [row[name] for row in rows] for name in ("training_mean", "evaluation_mean", "rewards_of_a_life")}
    scores = f"{with_interval(means['training_mean'], 0)} | {with_interval(means['evaluation_mean'], 0)}"
    times = f"{np.mean(means['evaluation_mean']) / random:.1f} | {with_interval(means['rewards_of_a_life'], 1)}"
    lines.append(f"| all {len(rows)} | | {np.mean([row['minutes'] for row in rows]):.1f} | {scores} | {times} |")
    return "\n".join(lines) + "\n"


def curves(runs: list[Path], random: float) -> Figure:
    """The moving means of the runs' games in training."""
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.subplots()
    for run in runs:
        points = [list(point.values()) for point in dqn_curve(run)]
        axes.plot(*np.transpose(points), label=run.name.replace("seed", "seed "))
    axes.axhline(random, color="black", linestyle=":", linewidth=1, label="random play")
    axes.axhline(5 * random, color="black", linestyle="--", linewidth=1, label="five times random play")
    axes.set(
        title=f"DQN on Gopher's memory, mean of {WINDOW} games",
        xlabel="frames",
        ylabel="points of a game",
        ylim=(0, None),
    )
    axes.locator_params(axis="x", nbins=5)
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside right center", fontsize="small")
    return figure


def main(args: Args) -> None:
    finished = sorted(finished_runs(args.runs))
    if not finished:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    rows, random = [row_of(run, result) for run, result in finished], random_score()
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "ram.csv", rows)
    curves([run for run, _ in finished], random).savefig(args.out / "ram.png", dpi=130)
    made_at = ", ".join(sorted({commit_of("dqn_gopher", row["script_sha256"]) for row in rows}))
    text = (
        f"`benchmark/gopher_ram.sh`, dqn_gopher.py at {made_at}; this report at {commit()}. One thread each. Points of a game, ± the "
        f"deviation of the games, in the last line a 95% t-interval over seeds; random play has {random:,.0f}.\n\n{table(rows, random)}"
    )
    (args.out / "ram.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
