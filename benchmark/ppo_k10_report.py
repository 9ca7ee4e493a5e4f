"""Plain PPO at K = 10, six tasks: runs -> table and figure, published beside measured.

    python benchmark/ppo_k10_report.py                  # runs/ppo_k10 -> benchmark/results/ppo_k10

Takes whatever part of the runs is done, and says which.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import UsageError, commit, commit_of, finished_runs, read_csv, run_main, write_csv
from matplotlib.figure import Figure
from scipy import stats

BENCHMARK = Path(__file__).resolve().parent


@dataclass
class Args:
    runs: Path = Path("runs/ppo_k10")
    """folder of the runs' folders"""
    out: Path = BENCHMARK / "results" / "ppo_k10"
    """folder for tables and figures"""


def read_runs(folder: Path) -> list[dict]:
    """One row for every run that came to the end of its schedule: what Table 4.4 and its steadier form need, and what it cost."""
    rows = []
    for run, result in finished_runs(folder):
        episodes = read_csv(run / "episodes.csv")
        returns = [float(row["episodic_return"]) for row in episodes]
        rows.append(
            {
                "task": result["env_id"].removeprefix("kle/"),
                "seed": result["seed"],
                "steps": result["global_step"],
                "episodes": len(returns),
                "last_episode": round(returns[-1], 2),
                "last_50": round(float(np.mean(returns[-50:])), 2),
                "greedy_evaluation": round(result["evaluation"]["mean"], 2),
                "training_seconds": round(result["training_seconds"]),
                "folder": run.name,
                "script_sha256": result["script_sha256"][:12],
            }
        )
    return rows


def difference_interval(ours: list[float], theirs: list[float], level: float = 0.95) -> tuple[float, float]:
    """Confidence interval of the difference of two means, with one variance for both: the method should be the same."""
    freedom = len(ours) + len(theirs) - 2
    squares = sum(np.sum((np.array(sample) - np.mean(sample)) ** 2) for sample in (ours, theirs))
    error = np.sqrt(squares / freedom * (1 / len(ours) + 1 / len(theirs)))
    margin = stats.t.ppf(0.5 + level / 2, freedom) * error
    difference = float(np.mean(ours) - np.mean(theirs))
    return difference - margin, difference + margin


def number(value: float) -> str:
    return f"{value:,.1f}" if abs(value) < 100 else f"{value:,.0f}"


def ppo_k10_table(published: list[dict], runs: list[dict]) -> str:
    """Per task: the published seeds, ours, and the difference of the means with its interval, as Markdown."""
    header = "| task | measure | published, seeds 1, 2 | measured, by seed | mean | difference of means, 95% |"
    lines = [header, "|---|---|---|---|---|---|"]
    for task in dict.fromkeys(row["task"] for row in published):
        for measure, name in (("last_episode", "last episode"), ("last_50", "mean of the last 50")):
            theirs = [float(row[measure]) for row in published if row["task"] == task]
            ours = [run[measure] for run in sorted(runs, key=lambda run: run["seed"]) if run["task"] == task]
            cells = [task, name, ", ".join(map(number, theirs)), ", ".join(map(number, ours)) or "not done"]
            if len(ours) > 1:
                low, high = difference_interval(ours, theirs)
                note = "" if low <= 0 <= high else " **outside**"
                difference = np.mean(ours) - np.mean(theirs)
                cells += [number(np.mean(ours)), f"{number(difference)} [{number(low)}, {number(high)}]{note}"]
            else:
                cells += ["", ""]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def moving_mean(values: np.ndarray, window: int) -> np.ndarray:
    return np.convolve(values, np.ones(window) / window, "valid")


def ppo_k10_figure(published: list[dict], runs: list[dict], folder: Path) -> Figure:
    """Learning curves of every seed, moving mean of 50 episodes; the published last-50 means as dashed lines."""
    tasks = list(dict.fromkeys(row["task"] for row in published))
    figure = Figure(figsize=(12, 6.4), layout="constrained")
    for axes, task in zip(figure.subplots(2, 3).flat, tasks):
        for i, run in enumerate(run for run in runs if run["task"] == task):
            table = np.loadtxt(folder / run["folder"] / "episodes.csv", delimiter=",", skiprows=1)
            curve = moving_mean(table[:, 1], 50)
            every = max(1, len(curve) // 2000)
            axes.plot(
                table[49::every, 0] / 1e6, curve[::every], color=f"C{i}", linewidth=1, label=f"seed {run['seed']}"
            )
        for row in published:
            if row["task"] == task:
                label = "published, last 50" if row["seed"] == "1" else None
                axes.axhline(float(row["last_50"]), color="black", linestyle="--", linewidth=0.8, label=label)
        axes.set_title(task)
        axes.spines[["top", "right"]].set_visible(False)
        if task == tasks[0]:
            axes.legend(fontsize="small")
    figure.supxlabel("environment steps, millions")
    figure.supylabel("episodic return, mean of 50 episodes")
    figure.suptitle("Plain PPO, K = 10, as run: measured (lines) and published (dashed)")
    return figure


def provenance(runs: list[dict]) -> str:
    """What the results rest on."""
    made_at = sorted({commit_of("ppo_continuous_kle", run["script_sha256"]) for run in runs})
    hours = sum(run["training_seconds"] for run in runs) / 3600
    return (
        f"`benchmark/ppo_k10.sh`, ppo_continuous_kle.py at {', '.join(made_at)}; `python benchmark/ppo_k10_report.py` at "
        f"{commit()}. {len(runs)} runs, {hours:.1f} core-hours of training.\n\n"
    )


def main(args: Args) -> None:
    published, runs = read_csv(BENCHMARK / "published" / "ppo_k10_seeds.csv"), read_runs(args.runs)
    if not runs:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "runs.csv", runs)
    table = ppo_k10_table(published, runs)
    (args.out / "table.md").write_text(provenance(runs) + table)
    ppo_k10_figure(published, runs, args.runs).savefig(args.out / "learning_curves.png", dpi=110)
    print(table)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
