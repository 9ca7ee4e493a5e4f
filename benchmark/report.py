"""The study of chapter 4: runs -> Tables 4.2 to 4.4 and Fig. 4.1 to 4.6, published beside measured.

    python benchmark/report.py                                # runs/ppo_kle -> benchmark/results/ppo_kle
    python benchmark/report.py --steps 500000                 # the first 500,000 steps of every run that has them
    python benchmark/report.py --known DIR                    # with the runs of an earlier report whose folders are gone

Takes whatever part of the 1,210 runs of `benchmark/ppo_kle.sh` has come to `--steps`, and says which. The normalised
episode reward (NER) of a run is where its score lies between the least and the greatest of its task, in two definitions:
*as tabulated* (Table 4.2, found out from the study's logs): score, least and greatest are of last episodes; *as written*
(sections 4.4 and 4.5): the mean of the last 50 episodes, between the least and the greatest of all episodes. Least and greatest are
those of the runs at hand.

Intervals are 95% percentiles of a bootstrap stratified by task. Resamples of n seeds have (n - 1) / n of the variance that
they should have, half with 2 seeds, so the deviations from a task's mean are stretched accordingly; and so few seeds give that
variance uncertainly, so the interval is widened as Student's t is to the normal, by Welch's and Satterthwaite's degrees of
freedom. They say what other seeds would give in these tasks; a second interval, over tasks, resamples these and says what other
tasks might give, and is the only one where a task has a single seed. A claim is confirmed where the interval is above 0,
contradicted where it is below, and open else, or where there is a single task; where tasks say otherwise than seeds, both are told.
"""

import csv
import json
import os
import re
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np
from common import ROOT, UsageError, commit, commit_of, published_rows, read_csv, run_main, write_csv
from matplotlib.figure import Figure
from scipy import stats

METHODS = {"PPO": "PPO", "stop": "KLE-Stop", "rollback": "KLE-Rollback"}
COLOURS = {"PPO": "tab:blue", "stop": "tab:orange", "rollback": "tab:green"}
KS = (4, 10, 20, 40, 80)
TARGETS = (0.015, 0.02, 0.025, 0.03, 0.05)
TASKS = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "InvertedPendulum", "Pusher", "Reacher", "Striker", "Swimmer")
TASKS = tuple(f"{task}-v2" for task in (*TASKS, "Thrower", "Walker2d"))
BINS = 100  # of a run, for its curves
CURVES = ("return", "kl", "iterations")
SCORES = {
    "as tabulated": ("last_episode", "last_episode", "last_episode"),
    "as written": ("last_50", "least", "greatest"),
}
RESAMPLES = 2_000
SETTING = ("task", "method", "d_target", "K", "seed")  # what a run differs in
OF_WHOLE_RUNS = ("seconds_per_step", "all_iterations")  # columns that only finished runs have
COST = ("task", "K", "seed", *OF_WHOLE_RUNS[::-1])
# arguments in which runs of one study may differ
FREE = {"env_id", "seed", "update_epochs", "kle_stop", "kle_rollback", "d_target"}
FREE |= {"run_dir", "resume", "stop_at", "checkpoint_interval", "compile", "cuda", "num_threads", "exp_name"}
FREE |= {"track", "wandb_project_name", "wandb_entity", "capture_video", "save_model", "save_demos", "eval_episodes"}
FREE |= {"eval_mode", "kl_timing"}  # the last follows the method
MARGIN = 0.1  # of the NER, within which a setting is near another
# plain PPO's Table 4.2 by the definition of sections 4.4 and 4.5, over KS, from the study's logs
AS_WRITTEN = (0.67, 0.70, 0.59, 0.40, 0.35)


@dataclass
class Args:
    runs: Path = Path("runs/ppo_kle")
    """folder of the runs' folders"""
    steps: int = 2_000_000
    """the part of each run that is reported"""
    out: Path | None = None
    """folder for tables and figures; default: benchmark/results/ppo_kle/{steps}"""
    cost: Path | None = None
    """folder of runs that were timed with nothing beside them (stage `cost`), for the cost; default: `--runs`"""
    known: Path | None = None
    """folder of an earlier report of as many steps: its runs count as well, unless they are in `--runs`, and its cost"""
    workers: int = os.cpu_count() or 1
    """processes that read"""


# ---------------------------------------------------------------------------------------------------------------------
# Reading
# ---------------------------------------------------------------------------------------------------------------------
def read_table(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """Columns of a CSV file of numbers, (columns, rows)."""
    with open(path) as file:
        names = file.readline().strip().split(",")
        if names == [""]:  # it has only begun
            return np.zeros((len(columns), 0))
        table = np.loadtxt(file, delimiter=",", usecols=[names.index(name) for name in columns], ndmin=2)
    return table.T if table.size else np.zeros((len(columns), 0))


def binned(at: np.ndarray, values: np.ndarray, steps: int) -> np.ndarray:
    """Mean of the values in each of BINS equal parts of the run, (BINS,); nan where there is none."""
    bins = np.minimum((at - 1) * BINS // steps, BINS - 1).astype(int)
    counts = np.bincount(bins, minlength=BINS)
    with np.errstate(invalid="ignore"):
        return (np.bincount(bins, values, BINS) / counts).astype(np.float32)


def read_result(folder: Path) -> dict | None:
    """What a run wrote at its end; None while it is not done, or goes on."""
    try:
        return json.loads((folder / "result.json").read_text())
    except (OSError, ValueError):
        return None


def read_run(steps: int, folder: Path) -> dict:
    """A row for `runs.csv` from a run's first `steps`, and curves of BINS numbers; without them, its speed alone."""
    args = json.loads((folder / "args.json").read_text())
    at, returns = read_table(folder / "episodes.csv", ("global_step", "episodic_return"))
    names = ("global_step", "charts/update_iterations", "losses/kl_exact_new_old")
    update, iterations, kl = read_table(folder / "updates.csv", names)
    result = read_result(folder)
    method = "stop" if args["kle_stop"] else "rollback" if args["kle_rollback"] else "PPO"
    row = {
        "task": args["env_id"].removeprefix("kle/"),
        "method": method,
        "d_target": args["d_target"] if method != "PPO" else "",
        "K": args["update_epochs"],
        "seed": args["seed"],
    }
    same = {name: value for name, value in args.items() if name not in FREE}
    if result is not None:
        row["seconds_per_step"] = 1 / result["steps_per_second"]
        row["all_iterations"] = float(iterations.mean())
    if not len(update) or update[-1] < steps - args["batch_size"] or not (at <= steps).any():
        return {"row": row, "args": same}
    returns, at = returns[at <= steps], at[at <= steps]
    iterations, kl, update = iterations[update <= steps], kl[update <= steps], update[update <= steps]
    early, quarter = update <= 500_000, len(update) // 4
    row |= {
        "steps": int(update[-1]),
        "episodes": len(returns),
        "last_episode": round(float(returns[-1]), 3),
        "last_50": round(float(returns[-50:].mean()), 3),
        "least": round(float(returns.min()), 3),
        "greatest": round(float(returns.max()), 3),
        "iterations": round(float(iterations.mean()), 3),
        "iterations_500k": round(float(iterations[early].mean()), 3),
        "iterations_first_quarter": round(float(iterations[:quarter].mean()), 3),
        "iterations_last_quarter": round(float(iterations[-quarter:].mean()), 3),
        "mean_kl": round(float(kl.mean()), 5),
        "log_kl": round(float(np.log10(np.maximum(kl, 1e-8)).mean()), 4),
        "script_sha256": "" if result is None else result["script_sha256"][:12],
    }
    curves = binned(at, returns, steps), binned(update, kl, steps), binned(update, iterations, steps)
    return {"row": row, "args": same, "curves": dict(zip(CURVES, curves))}


def read_runs(folder: Path, steps: int, workers: int) -> list[dict]:
    """All runs of a folder; those that have not come to `steps` have no curves.

    Raises UsageError where runs are not of one study.
    """
    folders = sorted(path.parent for path in folder.glob("*/updates.csv"))
    with ProcessPoolExecutor(workers) as pool:
        runs = list(pool.map(partial(read_run, steps), folders, chunksize=8))
    for run, path in zip(runs, folders):
        other = next((key for key, value in runs[0]["args"].items() if run["args"].get(key) != value), None)
        if other is not None:
            raise UsageError(f"{path}: has another {other} than {folders[0]}; a report is of one study")
    settings = [tuple(run["row"][key] for key in SETTING) for run in runs]
    twice = next((path for path, setting in zip(folders, settings) if settings.count(setting) > 1), None)
    if twice is not None:
        raise UsageError(f"{twice}: is there twice, under another name")
    return runs


def read_known(folder: Path, steps: int) -> list[dict]:
    """The runs of an earlier report as `read_runs` gives them; without curves where the report has kept none.

    Raises UsageError where there are none, or they are not of `steps`.
    """
    if not (folder / "runs.csv").is_file():
        raise UsageError(f"--known {folder}: holds no report, it has no runs.csv")
    curves = dict(np.load(folder / "curves.npz")) if (folder / "curves.npz").exists() else {}
    with open(folder / "runs.csv", newline="") as file:
        rows = [{key: number(key, value) for key, value in row.items()} for row in csv.DictReader(file)]
    other = next((row["steps"] for row in rows if not 0.9 * steps < row["steps"] <= steps), None)
    if other is not None:
        raise UsageError(f"--known {folder}: holds runs of {other:,} steps, not of {steps:,}")
    runs = [
        {"row": {key: value for key, value in row.items() if value != "" or key not in OF_WHOLE_RUNS}} for row in rows
    ]
    for run in runs:
        run["curves"] = dict(zip(CURVES, curves[key])) if (key := run_name(run["row"])) in curves else {}
    return runs


def number(column: str, text: str) -> int | float | str:
    """What a cell of `runs.csv` or `cost.csv` holds."""
    if column in ("task", "method", "script_sha256") or not text:
        return text
    return int(text) if text.isdigit() else float(text)


def run_name(row: dict) -> str:
    return "_".join(str(row[key]) for key in SETTING)


def in_order(runs: list[dict], known: list[dict]) -> list[dict]:
    """Runs, and those known runs that are not among them, in the order of their settings."""
    names = {run_name(run["row"]) for run in runs}
    runs = runs + [run for run in known if run_name(run["row"]) not in names]
    return sorted(runs, key=lambda run: [str(run["row"][key]) for key in SETTING])


# ---------------------------------------------------------------------------------------------------------------------
# Statistics
# ---------------------------------------------------------------------------------------------------------------------
Scores = dict[str, np.ndarray]  # task -> (..., seeds)


def normalise(rows: list[dict], definition: str) -> None:
    """Put the NER into every row, under the name of the definition."""
    score, least, greatest = SCORES[definition]
    tasks = {row["task"] for row in rows}
    low = {task: min(row[least] for row in rows if row["task"] == task) for task in tasks}
    high = {task: max(row[greatest] for row in rows if row["task"] == task) for task in tasks}
    for row in rows:
        width = high[row["task"]] - low[row["task"]]
        row[definition] = (row[score] - low[row["task"]]) / width if width else 0.0


def select(rows: list[dict], method: str, k: int | None = None, target: float | None = None) -> list[dict]:
    """Rows of a method; of one K and one d_target where they are given."""
    wanted = {"method": method} | ({} if k is None else {"K": k}) | ({} if target is None else {"d_target": target})
    return [row for row in rows if all(row[name] == value for name, value in wanted.items())]


def on_all_tasks(rows: list[dict], *setting) -> list[dict]:
    """Rows of a setting that has a run of every task, else none: means over other tasks cannot be compared."""
    found = select(rows, *setting)
    return found if {row["task"] for row in found} == {row["task"] for row in rows} else []


def by_task(rows: list[dict], column: str) -> Scores:
    scores = defaultdict(list)
    for row in rows:
        scores[row["task"]].append(row[column])
    return {task: np.array(values, float) for task, values in scores.items()}


def mean_of_tasks(scores: Scores) -> np.ndarray:
    """Mean of each task's mean, (...); every task counts the same."""
    return np.mean([values.mean(-1) for values in scores.values()], 0)


def interquartile_mean(scores: Scores) -> np.ndarray:
    """Mean of the middle half of all runs (Agarwal et al. 2021), (...); a quarter, rounded down, is cut at each end."""
    values = np.sort(np.concatenate(list(scores.values()), -1), -1)
    cut = values.shape[-1] // 4
    return values[..., cut : values.shape[-1] - cut].mean(-1)


def draw_runs(scores: Scores, rng: np.random.Generator) -> Scores:
    """RESAMPLES times as many runs, drawn with replacement within each task: (seeds,) -> (RESAMPLES, seeds)."""
    return {task: values[rng.integers(len(values), size=(RESAMPLES, len(values)))] for task, values in scores.items()}


def resample(scores: Scores, rng: np.random.Generator) -> Scores:
    """The same, with deviations stretched so that their means have the variance of means of so many seeds."""
    drawn = draw_runs(scores, rng)
    for task, values in scores.items():
        factor = np.sqrt(len(values) / max(1, len(values) - 1))
        drawn[task] = values.mean() + factor * (drawn[task] - values.mean())
    return drawn


def freedom(*groups: Scores) -> float:
    """Degrees of freedom of a sum of the tasks' means (Welch 1947, Satterthwaite 1946); infinite where runs do not differ."""
    runs = [values for group in groups for values in group.values() if len(values) > 1]
    variances = np.array([values.var(ddof=1) / len(values) for values in runs])
    squares = sum(variance**2 / (len(values) - 1) for variance, values in zip(variances, runs))
    return float(variances.sum() ** 2 / squares) if squares > 0 else np.inf


def widening(degrees: float) -> float:
    """By how much Student's 95% interval is wider than the normal one."""
    return float(stats.t.ppf(0.975, degrees) / stats.norm.ppf(0.975))


def bootstrap(statistic: Callable[..., np.ndarray], *groups: Scores) -> tuple[float, float, float]:
    """A statistic of groups of runs, and its 95% interval by a bootstrap stratified by task."""
    rng, middle = np.random.default_rng(0), float(statistic(*groups))
    drawn = statistic(*(resample(group, rng) for group in groups))
    ends = middle + widening(freedom(*groups)) * (np.percentile(drawn, (2.5, 97.5)) - middle)
    return middle, float(ends[0]), float(ends[1])


def bootstrap_tasks(statistic: Callable[..., np.ndarray], *groups: Scores) -> tuple[float, float, float]:
    """The same by resampling the tasks, which all groups have in common; deviations are stretched for their number."""
    rng, tasks = np.random.default_rng(0), list(groups[0])
    middle, number = float(statistic(*groups)), len(tasks)
    drawn = []
    for chosen in rng.integers(number, size=(RESAMPLES, number)):
        drawn.append(float(statistic(*({i: group[tasks[k]] for i, k in enumerate(chosen)} for group in groups))))
    stretch = np.sqrt(number / max(1, number - 1)) * widening(max(1, number - 1))
    low, high = middle + stretch * (np.percentile(drawn, (2.5, 97.5)) - middle)
    return middle, float(low), float(high)


def has_seeds(*groups: Scores, least: int = 2) -> bool:
    """Whether each task of each group has so many runs, so that there is an interval."""
    return all(len(values) >= least for group in groups for values in group.values())


def even(scores: Scores) -> Scores:
    """As many runs of each task, the first ones, so that each task counts the same where runs are pooled."""
    least = min(len(values) for values in scores.values())
    return {task: values[:least] for task, values in scores.items()}


def common(*groups: Scores) -> list[Scores]:
    """The groups, each with the tasks that all of them have."""
    tasks = sorted(set.intersection(*(set(group) for group in groups)))
    return [{task: group[task] for task in tasks} for group in groups]


# ---------------------------------------------------------------------------------------------------------------------
# Tables
# ---------------------------------------------------------------------------------------------------------------------
SETTINGS = [("PPO", None), *((method, target) for method in ("rollback", "stop") for target in TARGETS)]


def setting_name(method: str, target: float | None) -> str:
    return METHODS[method] if target is None else f"{METHODS[method]}, d_target = {target}"


def published(name: str) -> dict[tuple[str, str], dict[str, str]]:
    """A published table by its first two columns."""
    rows = published_rows(name)
    return {(row["method"], row["d_target"]): row for row in rows}


def cell(theirs: str | None, ours: list[str]) -> str:
    """Published, then measured; a dash for what is not published beside what is measured."""
    return " / ".join([*([] if theirs is None else [theirs or "–"]), *ours]) if any(ours) else theirs or ""


def all_tasks(rows: list[dict]) -> list[str]:
    """The study's tasks that there are, then others."""
    present = {row["task"] for row in rows}
    return [task for task in TASKS if task in present] + sorted(present - set(TASKS))


def grid_table(
    rows: list[dict], columns: list[str], theirs: dict | None, digits: int, settings: list
) -> list[list[str]]:
    """Settings × K: the published number, then means over tasks; in brackets their number where it is not all of them."""
    lines, tasks = [["", *(f"K = {k}" for k in KS)]], len(all_tasks(rows))
    for method, target in settings:
        line = [setting_name(method, target)]
        for k in KS:
            found = select(rows, method, k, target)
            ours = [f"{mean_of_tasks(by_task(found, column)):.{digits}f}" for column in columns if found]
            number = len({row["task"] for row in found})
            key = METHODS[method], "" if target is None else f"{target:g}"
            old = None if theirs is None else theirs.get(key, {}).get(str(k), "")
            line.append(cell(old, ours) + (f" ({number} tasks)" if 0 < number < tasks else ""))
        lines.append(line)
    return lines


def table_4_4(rows: list[dict], theirs: dict[str, dict[str, str]] | None) -> list[list[str]]:
    """Task × K of plain PPO: published, last episode, mean of the last 50."""
    lines = [["", *(f"K = {k}" for k in KS)]]
    for task in TASKS if theirs is not None else all_tasks(rows):
        line = [task]
        for k in KS:
            found = [row for row in select(rows, "PPO", k) if row["task"] == task]
            means = [np.mean([row[column] for row in found]) for column in ("last_episode", "last_50") if found]
            old = None if theirs is None else theirs.get(task, {}).get(str(k), "")
            line.append(cell(old, [f"{mean:,.1f}" for mean in means]))
        lines.append(line)
    return lines


def markdown(lines: list[list[str]]) -> str:
    head, *body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([head, "|" + "---|" * len(lines[0]), *body]) + "\n"


def latex(lines: list[list[str]], caption: str) -> str:
    """The same as a LaTeX table, which needs `booktabs`."""

    def escape(text: str) -> str:
        for old, new in (("%", r"\%"), ("&", r"\&"), ("_", r"\_"), ("d\\_target", r"$d_\mathrm{target}$"), ("–", "--")):
            text = text.replace(old, new)
        return re.sub(r"(?<![\w-])-(?=\d)", "$-$", text)

    head, *body = (" & ".join(map(escape, line)) + r" \\" for line in lines)
    columns = "l" + "r" * (len(lines[0]) - 1)
    rows = [head, r"\midrule", *body]
    inside = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", *rows, r"\bottomrule", r"\end{tabular}"]
    return "\n".join([r"\begin{table}", rf"\caption{{{escape(caption)}}}", *inside, r"\end{table}"]) + "\n"


def coverage(rows: list[dict], steps: int) -> str:
    """Which part of the grid is there."""
    grid = {(task, method, target or "", k) for task in TASKS for method, target in SETTINGS for k in KS}
    settings = [(row["task"], row["method"], row["d_target"], row["K"]) for row in rows]
    in_study = sum(setting in grid and row["seed"] <= 2 for setting, row in zip(settings, rows))
    seeds = ", ".join(map(str, sorted({row["seed"] for row in rows})))
    return (
        f"{len(rows)} runs of {steps:,} steps, {in_study} of them of the study's 1,210; {len(grid & set(settings))} of its 605 "
        f"settings; tasks: {', '.join(all_tasks(rows))}; seeds: {seeds}. Numbers are means over the seeds that a setting has, "
        "then over tasks."
    )


# ---------------------------------------------------------------------------------------------------------------------
# Findings
# ---------------------------------------------------------------------------------------------------------------------
class Finding(NamedTuple):
    """A claim of the study as a number that it says is positive."""

    claim: str
    published: str
    measured: str
    over_tasks: str
    verdict: str


def verdict(low: float, high: float) -> str:
    return "confirmed" if low > 0 else "contradicted" if high < 0 else "open"


def tell(
    claim: str, theirs: str, statistic: Callable[..., np.ndarray], *groups: Scores, margin: float = 0.0, digits: int = 2
) -> Finding | None:
    """A finding on the tasks that all groups of runs have; None where there is none."""
    groups = tuple(common(*groups)) if all(groups) else ()
    if not groups or not groups[0]:
        return None
    seeds = sorted({len(values) for group in groups for values in group.values()})
    middle, *by_tasks = bootstrap_tasks(statistic, *groups)
    counts = f"{len(groups[0])} task{'s' * (len(groups[0]) > 1)}, {' to '.join(map(str, sorted({seeds[0], seeds[-1]})))} seed{'s' * (seeds[-1] > 1)}"
    if len(groups[0]) < 2:
        return Finding(claim, theirs, f"{middle:+.{digits}f}, {counts}", "", "open")

    def text(ends: list[float]) -> str:
        return f"[{ends[0]:+.{digits}f}, {ends[1]:+.{digits}f}]"

    over_tasks = verdict(*(end + margin for end in by_tasks))
    if seeds[0] == 1:
        return Finding(claim, theirs, f"{middle:+.{digits}f}, {counts}", text(by_tasks), over_tasks + ", over tasks")
    _, *by_seeds = bootstrap(statistic, *groups)
    told = verdict(*(end + margin for end in by_seeds))
    also = "" if told == over_tasks else f"; over tasks {over_tasks}"
    return Finding(claim, theirs, f"{middle:+.{digits}f} {text(by_seeds)}, {counts}", text(by_tasks), told + also)


def minus(a: Scores, b: Scores) -> np.ndarray:
    return mean_of_tasks(a) - mean_of_tasks(b)


def spread(split: int) -> Callable[..., np.ndarray]:
    """By how much the means of the first `split` settings range wider than those of the others."""
    return lambda *scores: (
        np.ptp([*map(mean_of_tasks, scores[:split])], 0) - np.ptp([*map(mean_of_tasks, scores[split:])], 0)
    )


def spreads(rows: list[dict], column: str, method: str, k: int) -> Finding | None:
    """The claim that the score changes more with K of plain PPO than with d_target at one K; as many of both."""
    targets = [t for t in TARGETS if select(rows, method, k, t)]
    ks = [k for k in KS if select(rows, "PPO", k)]
    number = min(len(targets), len(ks))
    if number < 2:
        return None
    ks, targets = (
        [list_[i] for i in np.linspace(0, len(list_) - 1, number).round().astype(int)] for list_ in (ks, targets)
    )
    groups = [by_task(select(rows, "PPO", k), column) for k in ks]
    groups += [by_task(select(rows, method, k, t), column) for t in targets]
    claim = f"{METHODS[method]} at K = {k}: the range over d_target {tuple(targets)} is below PPO's over K {tuple(ks)}"
    return tell(claim, "", spread(number), *groups)


def published_ner(definition: str, method: str, k: int, target: float | None = None) -> float | None:
    """A cell of Table 4.2; by the definition as written only plain PPO's is known."""
    if definition == "as written":
        return AS_WRITTEN[KS.index(k)] if method == "PPO" else None
    return float(published("table_4_2.csv")[METHODS[method], "" if target is None else f"{target:g}"][str(k)])


def findings(rows: list[dict], definition: str, is_whole: bool) -> list[Finding]:
    """The claims of section 4.5, of Fig. 4.1 and 4.2, and of Table 4.3, on whatever runs there are."""
    found: list[Finding | None] = []

    def ner(claim: str, ours: tuple, others: tuple, margin: float = 0.0) -> None:
        """That the NER of a setting (method, K, d_target) is above another's, or not below it by the margin."""
        old = [published_ner(definition, *setting) for setting in (ours, others)]
        theirs = f"{old[0] - old[1]:+.2f}" if is_whole and None not in old else ""
        groups = [by_task(select(rows, *setting), definition) for setting in (ours, others)]
        found.append(tell(claim, theirs, minus, *groups, margin=margin))

    def positive(claim: str, part: list[dict], value: Callable[[dict], float]) -> None:
        scores = by_task([{**row, "value": value(row)} for row in part], "value")
        found.append(tell(claim, "", mean_of_tasks, scores, digits=1))

    for k in (4, 20, 40, 80):
        ner(f"PPO: K = 10 above K = {k}", ("PPO", 10), ("PPO", k))
    for k in (40, 80):
        groups = [by_task(select(rows, "PPO", each), "log_kl") for each in (k, 10)]
        found.append(tell(f"PPO: KL divergence at K = {k} above K = 10, powers of ten", "", minus, *groups))
    early = {method: METHODS[method] for method in ("stop", "rollback")}
    for method, name in early.items():
        for k in (20, 40, 80):
            claim = f"{name} 0.03 at K = {k}: near PPO at K = 10, no more than {MARGIN} below"
            ner(claim, (method, k, 0.03), ("PPO", 10), margin=MARGIN)
        for k in (4, 10, 80):
            ner(f"{name} 0.03 above PPO at the same K = {k}", (method, k, 0.03), ("PPO", k))
    positive(
        "KLE-Stop 0.03 at K = 4: iterations fewer than 4, by",
        select(rows, "stop", 4, 0.03),
        lambda r: 4 - r["iterations"],
    )
    for method, name in early.items():
        few, many = (by_task(select(rows, method, 80, target), "iterations") for target in (0.015, 0.05))
        found.append(
            tell(
                f"{name} at K = 80: more iterations with d_target = 0.05 than with 0.015",
                "",
                minus,
                many,
                few,
                digits=1,
            )
        )
        few, many = (by_task(select(rows, method, k, 0.03), "iterations") for k in (10, 80))
        found.append(tell(f"{name} 0.03: more iterations at K = 80 than at K = 10", "", minus, many, few, digits=1))
        late = select(rows, method, 80, 0.03)
        claim = f"{name} 0.03 at K = 80: more iterations in the last quarter of these steps than in the first"
        positive(claim, late, lambda r: r["iterations_last_quarter"] - r["iterations_first_quarter"])
    found += [spreads(rows, definition, method, k) for method in early for k in (80, 10)]
    return [finding for finding in found if finding is not None]


def wins(rows: list[dict], column: str, k: int) -> str:
    """On how many tasks KLE-Stop with 0.03 has a lower mean than plain PPO."""
    groups = [by_task(part, column) for part in (select(rows, "stop", k, 0.03), select(rows, "PPO", k))]
    if not all(groups):
        return ""
    stop, plain = common(*groups)
    return f"{sum(stop[task].mean() < plain[task].mean() for task in stop)} of {len(stop)}"


def findings_table(rows: list[dict], definition: str, is_whole: bool) -> list[list[str]]:
    head = ["claim", "published", "measured, 95% over seeds", "95% over tasks", "verdict"]
    lines = [head, *map(list, findings(rows, definition, is_whole))]
    for k, old in ((10, "3 of 11"), (4, "")):
        if wins(rows, definition, k):
            theirs = old if is_whole else ""
            lines.append(
                [f"K = {k}: tasks on which KLE-Stop 0.03 is below PPO", theirs, wins(rows, definition, k), "", ""]
            )
    for k, old in ((4, "50.63"), (10, "72.58"), (80, "20.08")):
        scores = by_task(select(rows, "PPO", k), definition)
        if scores:
            measured = f"{100 * mean_of_tasks(scores):.2f}"
            lines.append([f"PPO at K = {k}: % of the best (section 4.5.1)", old if is_whole else "", measured, "", ""])
    means = [
        100 * mean_of_tasks(by_task(on_all_tasks(rows, method, 80, target), definition))
        for method, target in SETTINGS[1:]
        if on_all_tasks(rows, method, 80, target)
    ]
    if means:
        measured, old = f"{min(means):.2f} to {max(means):.2f}, {len(means)} settings", "55.84 to 76.89"
        lines.append(
            ["early stops at K = 80: % of the best (section 4.5.3)", old if is_whole else "", measured, "", ""]
        )
    return lines


def iqm_table(rows: list[dict], column: str) -> list[list[str]]:
    """Interquartile means of the settings that have all tasks, with their intervals where each task has three seeds.

    Of two the interval would cover the mean in 84% of all cases (of 250 simulated with six tasks; of five in 94%).
    """
    lines = [["", *(f"K = {k}" for k in KS)]]
    for method, target in SETTINGS:
        line = [setting_name(method, target)]
        for k in KS:
            found = on_all_tasks(rows, method, k, target)
            scores = even(by_task(found, column)) if found else {}
            middle, low, high = bootstrap(interquartile_mean, scores) if scores else (0, 0, 0)
            interval = f" [{low:.2f}, {high:.2f}]" if has_seeds(scores, least=3) else ""
            line.append(f"{middle:.2f}{interval}" if scores else "")
        lines.append(line)
    return lines


def study_iterations() -> list[float]:
    """Iterations per update of the study's 55 settings of a task: K for plain PPO, else Table 4.3."""
    early = [float(row[str(k)]) for row in published_rows("table_4_3.csv") for k in KS]
    return [*map(float, KS), *early]


def cost_table(rows: list[dict]) -> list[list[str]]:
    """What 1,210 runs of 2,000,000 steps take on one core: seconds per step are a + b · iterations, fitted for each task."""
    lines = [["task", "runs", "a, µs", "b, µs", "steps/s at K = 10", "steps/s at K = 80", "core-hours of its 110 runs"]]
    total, known = 0.0, 0
    for task in all_tasks(rows):
        own = [row for row in rows if row["task"] == task and "seconds_per_step" in row]
        iterations = np.array([row["all_iterations"] for row in own])
        if len(own) < 2 or np.ptp(iterations) < 1:
            continue
        b, a = np.polyfit(iterations, [row["seconds_per_step"] for row in own], 1)
        hours = 2 * 2e6 * sum(a + b * each for each in study_iterations()) / 3600
        total, known = total + hours, known + 1
        speeds = [f"{1 / (a + b * k):,.0f}" for k in (10, 80)]
        lines.append([task, str(len(own)), f"{1e6 * a:.1f}", f"{1e6 * b:.2f}", *speeds, f"{hours:.1f}"])
    lines.append([f"sum of {known} of 11 tasks", *[""] * 5, f"{total:.1f}"])
    return lines


# ---------------------------------------------------------------------------------------------------------------------
# Figures
# ---------------------------------------------------------------------------------------------------------------------
def new_figure(title: str, rows: int, columns: int, width: float, height: float):
    figure = Figure(figsize=(width, height), layout="constrained")
    axes = figure.subplots(rows, columns, squeeze=False)
    for each in axes.flat:
        each.spines[["top", "right"]].set_visible(False)
    figure.suptitle(title)
    return figure, axes


def legend(axes, size: str) -> None:
    """A legend, where there is something to name."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(fontsize=size)


def score_over_k(axes, rows: list[dict], column: str) -> None:
    """Fig. 4.1a: mean over tasks; the band of plain PPO is the bootstrap's, of the others the range over d_target.

    Of settings that have all tasks.
    """
    for method in METHODS:
        ks = [k for k in KS if on_all_tasks(rows, method, k, None if method == "PPO" else 0.03)]
        if not ks:
            continue
        if method == "PPO":
            groups = [by_task(on_all_tasks(rows, method, k), column) for k in ks]
            middle, low, high = np.array([bootstrap(mean_of_tasks, group) for group in groups]).T
            low, high = (np.where([has_seeds(group) for group in groups], edge, np.nan) for edge in (low, high))
        else:
            means = [
                [
                    mean_of_tasks(by_task(on_all_tasks(rows, method, k, t), column))
                    for t in TARGETS
                    if on_all_tasks(rows, method, k, t)
                ]
                for k in ks
            ]
            middle = [mean_of_tasks(by_task(on_all_tasks(rows, method, k, 0.03), column)) for k in ks]
            low, high = ([f(each) if len(each) > 1 else np.nan for each in means] for f in (min, max))
        label = METHODS[method] + ("" if method == "PPO" else " 0.03")
        axes.plot(ks, middle, "o-", color=COLOURS[method], markersize=4, label=label)
        axes.fill_between(ks, low, high, color=COLOURS[method], alpha=0.15, linewidth=0)
        axes.vlines(ks, low, high, color=COLOURS[method], alpha=0.4)  # no band goes to a K that has one d_target
    axes.set(xscale="log", xlabel="K", ylabel="NER", title="(a) all tasks")
    axes.set_xticks(KS, map(str, KS))
    axes.minorticks_off()
    legend(axes, "small")


def with_curves(runs: list[dict], task: str, *setting) -> list[dict]:
    """The runs of a task and a setting whose curves are known."""
    return [run for run in runs if run["curves"] and run["row"]["task"] == task and select([run["row"]], *setting)]


def curve(axes, runs: list[dict], name: str, steps: int, **style) -> None:
    """Mean and range of the seeds' curves."""
    at = (np.arange(BINS) + 0.5) * steps / BINS / 1e6
    curves = np.array([run["curves"][name] for run in runs])
    known = ~np.isnan(curves).all(0)
    low, middle, high = (f(curves[:, known], 0) for f in (np.nanmin, np.nanmean, np.nanmax))
    (line,) = axes.plot(at[known], middle, linewidth=1.2, **style)
    axes.fill_between(at[known], low, high, color=line.get_color(), alpha=0.12, linewidth=0)


def figure_4_1(runs: list[dict], column: str, steps: int) -> Figure:
    """NER over K; then HalfCheetah's return, KL divergence and iterations."""
    figure, axes = new_figure(f"Fig. 4.1, {steps:,} steps", 1, 4, 16, 3.8)
    score_over_k(axes[0, 0], [run["row"] for run in runs], column)
    panels = {"return": "(b) return", "kl": "(c) KL divergence (Eq. 4.3.1)", "iterations": "(d) iterations per update"}
    for panel, (name, title) in zip(axes[0, 1:], panels.items()):
        for method, target in (("PPO", None), ("stop", 0.03), ("rollback", 0.03)):
            for k, line in ((10, "-"), (80, "--")):
                found = with_curves(runs, "HalfCheetah-v2", method, k, target)
                if found:
                    label = f"{METHODS[method]}{'' if target is None else f' {target}'}, K = {k}"
                    curve(panel, found, name, steps, color=COLOURS[method], linestyle=line, label=label)
        panel.set(title=f"{title}, HalfCheetah-v2", xlabel="steps, millions")
        if name == "kl":
            panel.set_yscale("log")
    legend(axes[0, 1], "x-small")
    return figure


def figure_4_2(rows: list[dict], column: str) -> Figure:
    """NER of the settings that have all tasks; bars are means over the K that all d_target have, dots each K from the left."""
    title = "Fig. 4.2: K of plain PPO beside d_target of the early stops (dots: each K, from the left)"
    figure, axes = new_figure(title, 1, 3, 12, 3.6)
    axes[0, 0].set_ylabel("NER")
    for panel, method in zip(axes[0], METHODS):
        targets = (
            [None] if method == "PPO" else [t for t in TARGETS if any(on_all_tasks(rows, method, k, t) for k in KS)]
        )
        ks = [k for k in KS if targets and all(on_all_tasks(rows, method, k, target) for target in targets)]
        bars = [[(None, k)] for k in ks] if method == "PPO" else [[(target, k) for k in ks] for target in targets]
        for x, bar in enumerate(bars if ks else []):
            groups = [by_task(select(rows, method, k, target), column) for target, k in bar]
            middle, low, high = bootstrap(lambda *each: np.mean([*map(mean_of_tasks, each)], 0), *groups)
            panel.bar(x, middle, color=COLOURS[method], alpha=0.6)
            if has_seeds(*groups):
                panel.errorbar(x, middle, [[max(0, middle - low)], [max(0, high - middle)]], color="black", capsize=3)
            for (_, k), group in zip(bar if method != "PPO" else [], groups):
                panel.plot(x + (KS.index(k) - 2) * 0.15, mean_of_tasks(group), "o", color="black", markersize=2.5)
        names = [f"K = {k}" for k in ks] if method == "PPO" else [f"{target:g}" for target in targets]
        panel.set_xticks(range(len(names)), names)
        panel.set(title=METHODS[method] + ("" if method == "PPO" else ", by d_target"), ylim=(0, 1))
    return figure


def task_figures(runs: list[dict], steps: int) -> dict[str, Figure]:
    """Fig. 4.3 to 4.6: three tasks each, one a column: NER, return, KL divergence and iterations over K."""
    figures = {}
    rows = [run["row"] for run in runs]
    measures = {"as written": "NER", "last_50": "return", "mean_kl": "KL divergence", "iterations": "iterations"}
    for number, begin in enumerate(range(0, len(TASKS), 3)):
        tasks = [task for task in TASKS[begin : begin + 3] if any(row["task"] == task for row in rows)]
        if not tasks:
            continue
        title = f"Fig. 4.{3 + number}, {steps:,} steps\nmeans, and ranges over seeds; early stops with 0.03"
        figure, axes = new_figure(title, len(measures), len(tasks), 3.6 * len(tasks) + 1, 9)
        for column, task in enumerate(tasks):
            for panel, (measure, name) in zip(axes[:, column], measures.items()):
                for method, target in (("PPO", None), ("stop", 0.03), ("rollback", 0.03)):
                    found = [row for row in select(rows, method, None, target) if row["task"] == task]
                    ks = sorted({row["K"] for row in found})
                    values = [[row[measure] for row in found if row["K"] == k] for k in ks]
                    means = [np.mean(each) for each in values]
                    panel.plot(ks, means, "o-", color=COLOURS[method], markersize=3, label=METHODS[method])
                    low, high = [min(each) for each in values], [max(each) for each in values]
                    panel.fill_between(ks, low, high, color=COLOURS[method], alpha=0.15, linewidth=0)
                panel.set_xscale("log")
                panel.set_xticks(KS, map(str, KS))
                panel.minorticks_off()
                panel.set_ylabel(name if column == 0 else "")
                if measure == "mean_kl":
                    panel.set_yscale("log")
            axes[0, column].set_title(task)
            axes[-1, column].set_xlabel("K")
        legend(axes[0, 0], "x-small")
        figures[f"fig_4_{3 + number}"] = figure
    return figures


def curves_figure(runs: list[dict], steps: int) -> Figure:
    """Learning curves of each task at K = 10 and K = 80."""
    tasks = all_tasks([run["row"] for run in runs])
    columns = min(4, len(tasks))
    lines = -(-len(tasks) // columns)
    figure, axes = new_figure(
        f"Return in training: means and ranges over seeds, {steps:,} steps", lines, columns, 4 * columns, 3 * lines
    )
    for panel, task in zip(axes.flat, tasks):
        for method, target in (("PPO", None), ("stop", 0.03), ("rollback", 0.03)):
            for k, line in ((10, "-"), (80, "--")):
                found = with_curves(runs, task, method, k, target)
                if found:
                    label = f"{METHODS[method]}{'' if target is None else f' {target}'}, K = {k}"
                    curve(panel, found, "return", steps, color=COLOURS[method], linestyle=line, label=label)
        panel.set_title(task)
    for panel in axes.flat[len(tasks) :]:
        panel.set_visible(False)
    legend(axes.flat[0], "x-small")
    figure.supxlabel("steps, millions")
    return figure


def heat_map(rows: list[dict], column: str) -> Figure:
    """NER of K × d_target for each early stop, beside plain PPO; of the settings that have all tasks."""
    figure, axes = new_figure("NER by K and d_target", 1, 2, 10, 3.6)
    for panel, method in zip(axes[0], ("stop", "rollback")):
        names = ["PPO", *map(str, TARGETS)]
        settings = [[("PPO", k) for k in KS], *([(method, k, target) for k in KS] for target in TARGETS)]
        groups = [[on_all_tasks(rows, *setting) for setting in line] for line in settings]
        table = np.array(
            [[mean_of_tasks(by_task(each, column)) if each else np.nan for each in line] for line in groups]
        )
        panel.imshow(table, vmin=0, vmax=1, cmap="viridis", aspect="auto")
        for (y, x), value in np.ndenumerate(table):
            if not np.isnan(value):
                panel.text(x, y, f"{value:.2f}", ha="center", va="center", color="white" if value < 0.6 else "black")
        panel.set_xticks(range(len(KS)), [f"K = {k}" for k in KS])
        panel.set_yticks(range(len(names)), names)
        panel.set_title(METHODS[method])
    axes[0, 0].set_ylabel("d_target")
    return figure


def profiles(rows: list[dict], column: str) -> Figure:
    """Share of the runs above each score (performance profiles), at K = 10 and K = 80.

    The bands are of the plain bootstrap: stretched scores would be none that a run had.
    """
    figure, axes = new_figure("Performance profiles: share of runs with at least this NER", 1, 2, 9, 3.6)
    levels = np.linspace(0, 1, 101)

    def profile(scores: Scores) -> np.ndarray:
        """(..., seeds) -> (..., levels)"""
        return np.mean([(values[..., None, :] >= levels[:, None]).mean(-1) for values in scores.values()], 0)

    for panel, k in zip(axes[0], (10, 80)):
        for method, target in (("PPO", None), ("stop", 0.03), ("rollback", 0.03)):
            scores, rng = by_task(on_all_tasks(rows, method, k, target), column), np.random.default_rng(0)
            if not scores:
                continue
            panel.plot(levels, profile(scores), color=COLOURS[method], label=METHODS[method])
            if has_seeds(scores):
                low, high = np.percentile(profile(draw_runs(scores, rng)), (2.5, 97.5), axis=0)
                panel.fill_between(levels, low, high, color=COLOURS[method], alpha=0.15, linewidth=0)
        panel.set(title=f"K = {k}", xlabel="NER", ylim=(0, 1))
    legend(axes[0, 0], "small")
    return figure


# ---------------------------------------------------------------------------------------------------------------------
# The report
# ---------------------------------------------------------------------------------------------------------------------
def provenance(rows: list[dict], args: Args, old: int) -> str:
    """What the results rest on; `old` runs are of an earlier report."""
    digests = {row["script_sha256"] for row in rows} - {""}
    made_at = sorted({commit_of("ppo_continuous_kle", digest) for digest in digests})
    flags = "".join(f" --{name} {value}" for name, value in (("cost", args.cost), ("known", args.known)) if value)
    timed = "; the cost is from `STAGES=cost STOP_AT=100000 WORKERS=1` of the same script (`cost.csv`)"
    hours = sum(row["steps"] * row["seconds_per_step"] for row in rows if "seconds_per_step" in row) / 3600
    gone = f" {old} of the runs are those of an earlier report, whose folders are gone; " if old else ""
    without = "curves are drawn from the runs that have them." if old else ""
    return (
        f"`benchmark/ppo_kle.sh`, ppo_continuous_kle.py at {', '.join(made_at)}; `python benchmark/report.py --steps "
        f"{args.steps}{flags}` at {commit()}. {hours:.1f} core-hours of training, one thread each"
        f"{timed if was_timed_alone(args) else ''}.{gone}{without}\n\n{coverage(rows, args.steps)}\n\n"
    )


def tables(rows: list[dict], timed: list[dict], steps: int) -> dict[str, list[list[str]]]:
    """All tables by their captions; published numbers, which are of 2,000,000 steps, only beside runs of as many.

    The cost is that of the rows `timed`, whose runs need not have come so far.
    """
    is_whole = steps == 2_000_000
    ner, iterations, returns = None, None, None
    if is_whole:
        ner, iterations = published("table_4_2.csv"), published("table_4_3.csv")
        returns = {row["task"]: row for row in published_rows("table_4_4.csv")}
    old, of = ("published / ", "") if is_whole else ("", f", first {steps:,} steps")
    spans = ["iterations", "iterations_500k"] if steps > 500_000 else ["iterations"]
    names = "whole run / first 500,000 steps" if steps > 500_000 else f"first {steps:,} steps"
    made = {
        f"Table 4.2: NER{of}, {old}as tabulated / as written": grid_table(rows, list(SCORES), ner, 2, SETTINGS),
        f"Table 4.3: iterations per update, {old}{names}": grid_table(rows, spans, iterations, 2, SETTINGS[1:]),
        f"Table 4.4: return of plain PPO{of}, {old}last episode / last 50 episodes": table_4_4(rows, returns),
    }
    for definition in SCORES:
        made[f"Findings, NER {definition}{of}"] = findings_table(rows, definition, is_whole)
    caption = f"Interquartile mean of the NER as written{of}, with its 95% interval where each task has three seeds"
    made[caption] = iqm_table(rows, "as written")
    made["Cost of the study on one core"] = cost_table(timed)
    return made


def was_timed_alone(args: Args) -> bool:
    """Whether the cost is from runs with nothing beside them, in this report or in the earlier one."""
    return bool(args.cost or args.known and (args.known / "cost.csv").exists())


def timed_runs(args: Args, found: list[dict]) -> list[dict]:
    """The rows that the cost is from: of runs timed alone, of the earlier report's, or of all runs. Raises UsageError."""
    if args.cost:
        timed = [run["row"] for run in in_order(read_runs(args.cost, args.steps, args.workers), [])]
        if not any("seconds_per_step" in row for row in timed):
            raise UsageError(f"--cost {args.cost}: holds no finished run")
        return timed
    if was_timed_alone(args):
        rows = read_csv(args.known / "cost.csv")
        return [{key: number(key, value) for key, value in row.items()} for row in rows]
    return [run["row"] for run in found]


def write_runs(out: Path, runs: list[dict]) -> None:
    """`runs.csv` and `curves.npz`, from which a later report can go on."""
    rows = [run["row"] for run in runs]
    columns = dict.fromkeys((*rows[0], *OF_WHOLE_RUNS))
    write_csv(out / "runs.csv", [{key: row.get(key, "") for key in columns} for row in rows])
    curves = {run_name(run["row"]): np.array([*run["curves"].values()], np.float32) for run in runs if run["curves"]}
    np.savez_compressed(out / "curves.npz", **curves)


def main(args: Args) -> None:
    found = read_runs(args.runs, args.steps, args.workers)
    of_folders = [run for run in found if "curves" in run]
    known = read_known(args.known, args.steps) if args.known else []
    runs = in_order(of_folders, known)
    if not runs:
        raise UsageError(f"--runs {args.runs}: holds no run of {args.steps:,} steps")
    timed = timed_runs(args, in_order(found, known))
    out = args.out or ROOT / "benchmark" / "results" / "ppo_kle" / f"{args.steps}"
    out.mkdir(parents=True, exist_ok=True)
    write_runs(out, runs)
    rows = [run["row"] for run in runs]
    for definition in SCORES:
        normalise(rows, definition)
    if was_timed_alone(args):
        write_csv(out / "cost.csv", [{key: row[key] for key in COST} for row in timed if "seconds_per_step" in row])
    made = tables(rows, timed, args.steps)
    text = provenance(rows, args, len(runs) - len(of_folders)) + "\n".join(
        f"## {name}\n\n{markdown(lines)}" for name, lines in made.items()
    )
    (out / "tables.md").write_text(text)
    (out / "tables.tex").write_text("\n".join(latex(lines, name) for name, lines in made.items()))
    figures = {"fig_4_1": figure_4_1(runs, "as written", args.steps), "fig_4_2": figure_4_2(rows, "as written")}
    figures |= task_figures(runs, args.steps)
    figures |= {"learning_curves": curves_figure(runs, args.steps), "heat_map": heat_map(rows, "as written")}
    figures["profiles"] = profiles(rows, "as written")
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png", dpi=110)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
