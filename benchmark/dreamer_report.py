"""The Dreamers in FourRooms: runs of benchmark/fourrooms.sh -> Fig. 3.5, and the steps to a return of 0.5 and of 0.85.

    python benchmark/dreamer_report.py                              # runs/dreamer_xs -> benchmark/results/dreamer/xs
    python benchmark/dreamer_report.py --known DIR                  # with the runs of an earlier report whose folders are gone

Runs that go on are in the figures, as far as the shortest of an agent's has come, and not yet in its table. Steps are counted
from the first update, after the random play of `--prefill`, whose episodes are in no mean. A run has come to a return when the
mean of its last 200 episodes is as high; near 0.5 these span some 10,000 steps. Intervals are 95% t-intervals over seeds.
"""

import json
import re
import zipfile
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, UsageError, commit, commit_of, read_args, read_csv, run_main, write_csv
from intervals import with_interval
from matplotlib.figure import Figure
from scipy import stats

AGENTS = {  # name of the runs -> title, script, colour
    "dreamer": ("Dreamer", "dreamer_v2", "tab:blue"),
    "hwm": ("HWM Dreamer", "hwm_dreamer", "tab:green"),
    "hrl": ("HWM HRL Dreamer", "hwm_hrl_dreamer", "tab:purple"),
    "hwm_fixed": ("HWM Dreamer, fixed interval", "hwm_dreamer", "tab:olive"),
    "hrl_fixed": ("HWM HRL Dreamer, fixed interval", "hwm_hrl_dreamer", "tab:pink"),
}
CAUSES = {  # the baseline, and what it does without one of the things that it needs
    "dreamer": AGENTS["dreamer"],
    "dreamer_sharp": ("codes may get sharp (--entropy-scale 0)", "dreamer_v2", "tab:red"),
    "dreamer_slow": ("the model's rate is 1e-3", "dreamer_v2", "tab:orange"),
    "dreamer_early": ("200,000 steps of random play at first", "dreamer_v2", "tab:brown"),
    "dreamer_far": ("γ is 0.99", "dreamer_v2", "tab:cyan"),
    "dreamer_uniform": ("chunks from anywhere (--rewarded-share 0)", "dreamer_v2", "tab:gray"),
    "dreamer_eps": ("Adam's ε is 1e-5", "dreamer_v2", "black"),
}
WINDOW, LEAST = 200, 50  # episodes of a moving mean, and of its first point
BINS = 200  # points of a drawn curve
POINTS = 1_000  # points of a curve, as it is drawn, compared and kept for later reports
LEVELS = (0.5, 0.85)  # learning, solved
STAGES = (20_000, 40_000, 60_000)  # steps from the first update on at which the causes are compared


@dataclass
class Args:
    runs: Path = Path("runs/dreamer_xs")
    """folder of the runs' folders"""
    out: Path | None = None
    """folder for figure, table and runs; default: benchmark/results/dreamer/{size}"""
    known: Path | None = None
    """folder of an earlier report, whose runs go on in this one"""


def moving_mean(returns: np.ndarray) -> np.ndarray:
    """Mean of the last WINDOW episodes at the end of each, of fewer at first."""
    sums, number = np.concatenate([[0], np.cumsum(returns)]), np.arange(1, len(returns) + 1)
    begin = np.maximum(number - WINDOW, 0)
    return (sums[number] - sums[begin]) / (number - begin)


def steps_to(level: float, steps: np.ndarray, means: np.ndarray) -> float:
    """The first step at which the mean of WINDOW episodes is as high; nan where it never is."""
    reached = np.flatnonzero((means >= level) & (np.arange(len(means)) >= WINDOW - 1))
    return float(steps[reached[0]]) if len(reached) else np.nan


def learned_episodes(folder: Path, prefill: int) -> tuple[np.ndarray, np.ndarray]:
    """(steps since the first update, returns) of the episodes that ended since."""
    table = np.loadtxt(folder / "episodes.csv", delimiter=",", skiprows=1, ndmin=2)
    table = table[table[:, 0] > prefill]
    return table[:, 0] - prefill, table[:, 1]


def has_curve(folder: Path) -> bool:
    """Whether as many episodes have ended since the first update as the first mean is of."""
    prefill = read_args(folder)["prefill"]
    return len(learned_episodes(folder, prefill)[0]) >= LEAST


def read_run(folder: Path) -> dict:
    """A run's row, and POINTS of its moving mean over the steps with updates.

    The comparison's columns stand where the run has made one, those of the end where it has ended.
    """
    args = read_args(folder)
    steps, returns = learned_episodes(folder, args["prefill"])
    means = moving_mean(returns)
    row = {"agent": re.sub(r"_seed\d+$", "", folder.name), "seed": args["seed"], "size": args["size"]}
    row |= {"env_id": args["env_id"], "prefill": args["prefill"], "steps": int(steps[-1]), "episodes": len(steps)}
    row |= {f"steps_to_{level}": steps_to(level, steps, means) for level in LEVELS} | {"last_200": float(means[-1])}
    updates = np.genfromtxt(folder / "updates.csv", delimiter=",", names=True, deletechars="", ndmin=1)
    for name in ("real", "dreamed"):
        values = updates[f"eval/{name}_return"]
        row[f"{name}_return"] = float(values[~np.isnan(values)][-1]) if (~np.isnan(values)).any() else np.nan
    result = folder / "result.json"
    ended = json.loads(result.read_text()) if result.exists() else {}
    row |= {name: ended.get(name, "") for name in ("training_seconds", "script_sha256")}
    row["greedy"] = ended["evaluation"]["mean"] if ended else np.nan
    at = np.unique(np.linspace(LEAST - 1, len(steps) - 1, POINTS).astype(int))
    return {"row": row, "steps": steps[at].astype(np.float32), "means": means[at].astype(np.float32)}


def cell(text: str) -> float | int | str:
    """What a cell of `runs.csv` holds."""
    if text.isdigit():
        return int(text)
    try:
        return float(text)
    except ValueError:
        return text


def read_known(folder: Path) -> list[dict]:
    """The runs of an earlier report as `read_runs` gives them. Raises UsageError where it cannot be read."""
    try:
        rows = read_csv(folder / "runs.csv")
        curves = np.load(folder / "curves.npz")
        words = {"agent", "size", "env_id", "script_sha256"}
        rows = [{key: text if key in words else cell(text) for key, text in row.items()} for row in rows]
        return [{"row": row, **dict(zip(("steps", "means"), curves[run_name(row)]))} for row in rows]
    except (OSError, ValueError, KeyError, zipfile.BadZipFile) as error:
        raise UsageError(f"--known {folder}: cannot be read: {error}") from None


def run_name(row: dict) -> str:
    return f"{row['agent']}_seed{row['seed']}"


def read_runs(folder: Path, known: list[dict] = ()) -> list[dict]:
    """All runs of known agents that have a curve, and those runs of an earlier report that are not among them.

    Raises UsageError where their sizes or tasks differ.
    """
    paths = sorted(path.parent for path in folder.glob("*/updates.csv") if path.stat().st_size)
    paths = [path for path in paths if re.sub(r"_seed\d+$", "", path.name) in AGENTS | CAUSES]
    runs = [read_run(path) for path in paths if has_curve(path)]
    names = {run_name(run["row"]) for run in runs}
    runs = sorted(
        runs + [run for run in known if run_name(run["row"]) not in names], key=lambda run: run_name(run["row"])
    )
    kinds = {(run["row"]["size"], run["row"]["env_id"]) for run in runs}
    if len(kinds) != 1:
        raise UsageError(f"--runs {folder}: " + ("holds runs of several kinds" if kinds else "holds no run"))
    return runs


def has_ended(row: dict) -> bool:
    return not np.isnan(row["greedy"])


def table(rows: list[dict]) -> list[str]:
    """One line for each agent, of its runs that have ended; where not every seed has come to a return, how many have."""
    heads = ["steps", *(f"steps to {level}" for level in LEVELS), "last 200 episodes", "greedy"]
    lines = [f"| agent | seeds | {' | '.join(heads)} | dreamed less real return | minutes |", "|" + "---|" * 9]
    for agent, (title, _, _) in AGENTS.items():
        group = [row for row in rows if row["agent"] == agent and has_ended(row)]
        if not group:
            continue
        cells = [f"{min(row['steps'] for row in group):,}"]
        for level in LEVELS:
            known = [row[f"steps_to_{level}"] for row in group if not np.isnan(row[f"steps_to_{level}"])]
            some = f" ({len(known)} of {len(group)})" if 0 < len(known) < len(group) else ""
            cells.append(with_interval(known, 0) + some if known else "not reached")
        cells += [with_interval([row[name] for row in group], 3) for name in ("last_200", "greedy")]
        gaps = [row["dreamed_return"] - row["real_return"] for row in group if not np.isnan(row["dreamed_return"])]
        cells.append(with_interval(gaps, 3) if gaps else "")
        cells.append(f"{np.mean([row['training_seconds'] / 60 for row in group]):.0f}")
        lines.append(f"| {title} | {len(group)} | {' | '.join(cells)} |")
    return lines


def mean_at(run: dict, step: int) -> float:
    """The moving mean at a step from the first update on; nan where the run has not come so far."""
    has_come = run["steps"][-1] + 1_000 >= step  # ten games of 100 steps at most: an episode ends within 1,000
    return float(np.interp(step, run["steps"], run["means"])) if has_come else np.nan


def needs_table(runs: list[dict], stages: tuple[int, ...] = STAGES) -> list[str]:
    """What the baseline comes to without one of the things that it needs, at the same steps; one line for each of them.

    A cell is empty until all of its seeds have come so far.
    """
    heads = [f"return after {stage:,}" for stage in stages]
    lines = [f"| Dreamer | seeds | steps | steps to 0.5 | {' | '.join(heads)} |", "|" + "---|" * (4 + len(stages))]
    for agent, (title, _, _) in CAUSES.items():
        group = [run for run in runs if run["row"]["agent"] == agent]
        if not group:
            continue
        reached = [run["row"]["steps_to_0.5"] for run in group if not np.isnan(run["row"]["steps_to_0.5"])]
        some = f" ({len(reached)} of {len(group)})" if 0 < len(reached) < len(group) else ""
        cells = [f"{min(run['row']['steps'] for run in group):,}"]
        cells.append(with_interval(reached, 0) + some if reached else "not reached")
        for stage in stages:
            values = [mean_at(run, stage) for run in group]
            cells.append("" if np.isnan(values).any() else with_interval(values, 3))
        lines.append(f"| {'as it is' if agent == 'dreamer' else title} | {len(group)} | {' | '.join(cells)} |")
    return lines


def differences(rows: list[dict]) -> list[str]:
    """Each agent less the one that it adds to, with Welch's 95% interval where both have two seeds or more and all came so far."""
    lines = []
    for later, earlier in (("hwm", "dreamer"), ("hrl", "hwm"), ("hwm_fixed", "hwm"), ("hrl_fixed", "hrl")):
        cells = []
        for name, digits in (("steps_to_0.5", 0), ("last_200", 3), ("greedy", 3)):
            groups = [
                [row[name] for row in rows if row["agent"] == agent and has_ended(row)] for agent in (later, earlier)
            ]
            if min(map(len, groups)) < 2 or np.isnan(groups[0] + groups[1]).any():
                cells.append("")
                continue
            low, high = stats.ttest_ind(*groups, equal_var=False).confidence_interval()
            middle = np.mean(groups[0]) - np.mean(groups[1])
            cells.append(f"{middle:+,.{digits}f} [{low:+,.{digits}f}, {high:+,.{digits}f}]")
        if any(cells):
            lines.append(f"| {AGENTS[later][0]} less {AGENTS[earlier][0]} | {' | '.join(cells)} |")
    head = ["", "| 95% by Welch | steps to 0.5 | last 200 episodes | greedy |", "|" + "---|" * 4]
    return head + lines if lines else []


def curves_figure(runs: list[dict], agents: dict, title: str) -> Figure:
    """Fig. 3.5: the mean over seeds of the moving means, and their range, up to where the shortest run has come."""
    figure = Figure(figsize=(8, 4.5), layout="constrained")
    axes = figure.subplots()
    groups = defaultdict(list)
    for run in runs:
        groups[run["row"]["agent"]].append(run)
    for agent, (name, _, colour) in agents.items():
        group = groups[agent]
        if not group:
            continue
        at = np.linspace(max(run["steps"][0] for run in group), min(run["steps"][-1] for run in group), BINS)
        curves = np.array([np.interp(at, run["steps"], run["means"]) for run in group])
        axes.plot(at, curves.mean(0), color=colour, label=f"{name}, {len(group)} seed{'s' * (len(group) > 1)}")
        axes.fill_between(at, curves.min(0), curves.max(0), color=colour, alpha=0.15, linewidth=0)
    for level in LEVELS:
        axes.axhline(level, color="black", linestyle=":", linewidth=0.8)
    row = runs[0]["row"]
    axes.set_title(
        f"{title}: {row['env_id']}, size {row['size']}; mean of {WINDOW} episodes, range over seeds", fontsize="medium"
    )
    axes.set(xlabel="environment steps from the first update on", ylabel="episodic return", ylim=(0, 1))
    axes.xaxis.set_major_formatter("{x:,.0f}")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize="small")
    return figure


def write_report(runs: list[dict], out: Path) -> None:
    """Write the figures, the tables and the rows of the runs."""
    out.mkdir(parents=True, exist_ok=True)
    rows = [run["row"] for run in runs]
    write_csv(out / "runs.csv", rows)
    curves = {run_name(run["row"]): np.array([run["steps"], run["means"]]) for run in runs}
    np.savez_compressed(out / "curves.npz", **curves)
    scripts = {((AGENTS | CAUSES)[row["agent"]][1], row["script_sha256"]) for row in rows if row["script_sha256"]}
    made_at = ", ".join(f"{name}.py at {commit_of(name, digest)}" for name, digest in sorted(scripts))
    play = " or ".join(f"{steps:,}" for steps in sorted({row["prefill"] for row in rows}, reverse=True))
    about = f"{made_at or 'runs that go on'}; this report at {commit()}. One thread each. Steps from the first update on, after {play}"
    text = [f"`benchmark/fourrooms.sh`, {about} of random play.", ""]
    text += table(rows) + differences(rows)
    going_on = [f"{run_name(row)} ({row['steps']:,} steps)" for row in rows if not has_ended(row)]
    if going_on:
        text += ["", f"In the figures only, for they go on: {', '.join(going_on)}."]
    curves_figure(runs, AGENTS, "Fig. 3.5").savefig(out / "fig_3_5.png", dpi=110)
    if any(row["agent"] not in AGENTS for row in rows):
        head = f"Steps from the first update on; returns are means of the last {WINDOW} episodes, or of all since the first update."
        text += ["", "## What the baseline needs", "", head, "", *needs_table(runs)]
        curves_figure(runs, CAUSES, "What the baseline needs").savefig(out / "causes.png", dpi=110)
    (out / "table.md").write_text("\n".join(text) + "\n")
    print("\n".join(text))


def main(args: Args) -> None:
    found = read_runs(args.runs, read_known(args.known) if args.known is not None else [])
    size = found[0]["row"]["size"]
    write_report(found, args.out or ROOT / "benchmark" / "results" / "dreamer" / size)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
