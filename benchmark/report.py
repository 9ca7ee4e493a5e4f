"""The study of chapter 4: runs -> Tables 4.2 to 4.4 and Fig. 4.1 to 4.6, published beside measured.

    python benchmark/report.py                                # runs/ppo_kle -> benchmark/results/ppo_kle
    python benchmark/report.py --steps 500000                 # the first 500,000 steps of every run that has them

Takes whatever part of the 1,210 runs of `benchmark/ppo_kle.sh` has come to `--steps`, and says which. The normalised
episode reward (NER) of a run is where its score lies between the least and the greatest of its task, in two definitions:
*as tabulated* (Table 4.2, found out from the study's logs): score, least and greatest are of last episodes; *as written*
(section 4.4): the mean of the last 50 episodes, between the least and the greatest of all episodes. Intervals are 95%
percentiles of a bootstrap stratified by task, which with 2 seeds is rough.
"""

import csv
import json
import os
from collections import defaultdict
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import tyro
from apple_players import ROOT, commit
from apple_report import commit_of, write_csv
from matplotlib.figure import Figure

METHODS = {"PPO": "PPO", "stop": "KLE-Stop", "rollback": "KLE-Rollback"}
COLOURS = {"PPO": "tab:blue", "stop": "tab:orange", "rollback": "tab:green"}
KS = (4, 10, 20, 40, 80)
TARGETS = (0.015, 0.02, 0.025, 0.03, 0.05)
TASKS = ("Ant", "HalfCheetah", "Hopper", "Humanoid", "InvertedPendulum", "Pusher", "Reacher", "Striker", "Swimmer")
TASKS = tuple(f"{task}-v2" for task in (*TASKS, "Thrower", "Walker2d"))
BINS = 100  # of a run, for its curves
SCORES = {
    "as tabulated": ("last_episode", "last_episode", "last_episode"),
    "as written": ("last_50", "least", "greatest"),
}
RESAMPLES = 2_000


@dataclass
class Args:
    runs: Path = Path("runs/ppo_kle")
    """folder of the runs' folders"""
    steps: int = 2_000_000
    """the part of each run that is reported"""
    out: Path | None = None
    """folder for tables and figures; default: benchmark/results/ppo_kle/{steps}"""
    workers: int = os.cpu_count() or 1
    """processes that read"""


# ---------------------------------------------------------------------------------------------------------------------
# Reading
# ---------------------------------------------------------------------------------------------------------------------
def read_table(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """Columns of a CSV file of numbers, (columns, rows)."""
    with open(path) as file:
        names = file.readline().strip().split(",")
        table = np.loadtxt(file, delimiter=",", usecols=[names.index(name) for name in columns], ndmin=2)
    return table.T if table.size else np.zeros((len(columns), 0))


def binned(at: np.ndarray, values: np.ndarray, steps: int) -> np.ndarray:
    """Mean of the values in each of BINS equal parts of the run, (BINS,); nan where there is none."""
    bins = np.minimum((at - 1) * BINS // steps, BINS - 1).astype(int)
    counts = np.bincount(bins, minlength=BINS)
    with np.errstate(invalid="ignore"):
        return (np.bincount(bins, values, BINS) / counts).astype(np.float32)


def read_run(steps: int, folder: Path) -> dict:
    """A row for `runs.csv` from a run's first `steps`, and curves of BINS numbers; without them, its speed alone."""
    args, result = (json.loads((folder / name).read_text()) for name in ("args.json", "result.json"))
    method = "stop" if args["kle_stop"] else "rollback" if args["kle_rollback"] else "PPO"
    row = {
        "task": args["env_id"].removeprefix("kle/"),
        "method": method,
        "d_target": args["d_target"] if method != "PPO" else "",
        "K": args["update_epochs"],
        "seed": args["seed"],
        "steps_per_second": round(result["steps_per_second"], 1),
    }
    if result["global_step"] < steps - args["batch_size"]:
        return {"row": row}
    at, returns = read_table(folder / "episodes.csv", ("global_step", "episodic_return"))
    names = ("global_step", "charts/update_iterations", "losses/kl_exact_new_old")
    update, iterations, kl = read_table(folder / "updates.csv", names)
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
        "training_seconds": round(result["training_seconds"] * update[-1] / result["global_step"], 1),
        "script_sha256": result["script_sha256"][:12],
    }
    curves = binned(at, returns, steps), binned(update, kl, steps), binned(update, iterations, steps)
    return {"row": row, "curves": dict(zip(("return", "kl", "iterations"), curves))}


def read_runs(folder: Path, steps: int, workers: int) -> list[dict]:
    """All runs in the order of their settings; those that have not come to `steps` have no curves."""
    folders = sorted(path.parent for path in folder.glob("*/result.json"))
    with ProcessPoolExecutor(workers) as pool:
        runs = list(pool.map(partial(read_run, steps), folders, chunksize=8))
    return sorted(runs, key=lambda run: [str(run["row"][key]) for key in ("task", "method", "d_target", "K", "seed")])


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


def resample(scores: Scores, rng: np.random.Generator) -> Scores:
    """RESAMPLES times as many runs, drawn with replacement within each task: (seeds,) -> (RESAMPLES, seeds)."""
    return {task: values[rng.integers(len(values), size=(RESAMPLES, len(values)))] for task, values in scores.items()}


def bootstrap(statistic: Callable[..., np.ndarray], *groups: Scores) -> tuple[float, float, float]:
    """A statistic of groups of runs, and its 95% percentile interval by a bootstrap stratified by task."""
    rng = np.random.default_rng(0)
    low, high = np.percentile(statistic(*(resample(group, rng) for group in groups)), (2.5, 97.5))
    return float(statistic(*groups)), float(low), float(high)


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


def published_rows(name: str) -> list[dict[str, str]]:
    with open(ROOT / "benchmark" / "published" / name, newline="") as file:
        return list(csv.DictReader(file))


def published(name: str) -> dict[tuple[str, str], dict[str, str]]:
    """A published table by its first two columns."""
    rows = published_rows(name)
    return {(row["method"], row["d_target"]): row for row in rows}


def cell(theirs: str | None, ours: list[str]) -> str:
    """Published, then measured."""
    return " / ".join([theirs or "", *ours]) if any(ours) else theirs or ""


def grid_table(
    rows: list[dict], measures: dict[str, str], theirs: dict, digits: int, settings: list
) -> list[list[str]]:
    """Settings × K: the published number, then means over tasks of the measures' columns."""
    lines = [["", *(f"K = {k}" for k in KS)]]
    for method, target in settings:
        line = [setting_name(method, target)]
        for k in KS:
            found = select(rows, method, k, target)
            ours = [f"{mean_of_tasks(by_task(found, column)):.{digits}f}" for column in measures.values() if found]
            old = theirs.get((METHODS[method], "" if target is None else f"{target:g}"), {}).get(str(k))
            line.append(cell(old, ours))
        lines.append(line)
    return lines


def table_4_4(rows: list[dict], theirs: dict[str, dict[str, str]]) -> list[list[str]]:
    """Task × K of plain PPO: published, last episode, mean of the last 50."""
    lines = [["", *(f"K = {k}" for k in KS)]]
    for task in TASKS:
        line = [task]
        for k in KS:
            found = [row for row in select(rows, "PPO", k) if row["task"] == task]
            means = [np.mean([row[column] for row in found]) for column in ("last_episode", "last_50") if found]
            line.append(cell(theirs.get(task, {}).get(str(k)), [f"{mean:,.1f}" for mean in means]))
        lines.append(line)
    return lines


def markdown(lines: list[list[str]]) -> str:
    head, *body = (f"| {' | '.join(line)} |" for line in lines)
    return "\n".join([head, "|" + "---|" * len(lines[0]), *body]) + "\n"


def latex(lines: list[list[str]], caption: str) -> str:
    """The same as a LaTeX table, which needs `booktabs`."""

    def escape(text: str) -> str:
        for old, new in (("%", r"\%"), ("_", r"\_"), ("±", r"$\pm$"), ("d\\_target", r"$d_\mathrm{target}$")):
            text = text.replace(old, new)
        return text

    head, *body = (" & ".join(map(escape, line)) + r" \\" for line in lines)
    columns = "l" + "r" * (len(lines[0]) - 1)
    rows = [head, r"\midrule", *body]
    inside = [rf"\begin{{tabular}}{{{columns}}}", r"\toprule", *rows, r"\bottomrule", r"\end{tabular}"]
    return "\n".join([r"\begin{table}", rf"\caption{{{escape(caption)}}}", *inside, r"\end{table}"]) + "\n"


def coverage(rows: list[dict], folder_steps: int) -> str:
    """Which part of the grid is there."""
    cells = len({(row["task"], row["method"], row["d_target"], row["K"]) for row in rows})
    in_study = [row for row in rows if row["seed"] <= 2]
    tasks = sorted({row["task"] for row in rows})
    seeds = sorted({row["seed"] for row in rows})
    return (
        f"{len(rows)} runs of {folder_steps:,} steps, {len(in_study)} of them of the study's 1,210 (seeds 1 and 2): "
        f"{cells} of 605 settings; {len(tasks)} of 11 tasks ({', '.join(tasks)}); seeds {', '.join(map(str, seeds))}."
    )


# ---------------------------------------------------------------------------------------------------------------------
# Findings
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Finding:
    """A claim of the study as a difference that it says is positive."""

    claim: str
    published: str
    measured: str
    verdict: str


def verdict(low: float, high: float) -> str:
    return "confirmed" if low > 0 else "contradicted" if high < 0 else "open"


def difference(
    claim: str, theirs: str, ours: list[dict], others: list[dict], column: str, digits: int = 2
) -> Finding | None:
    """The claim that one group's mean over tasks is above the other's, on the tasks that both have."""
    if not ours or not others or not {row["task"] for row in ours} & {row["task"] for row in others}:
        return None
    groups = common(by_task(ours, column), by_task(others, column))
    middle, low, high = bootstrap(lambda a, b: mean_of_tasks(a) - mean_of_tasks(b), *groups)
    seeds = sorted({len(values) for group in groups for values in group.values()})
    counts = f"{len(groups[0])} tasks, {'–'.join(map(str, sorted({seeds[0], seeds[-1]})))} seeds"
    text = f"{middle:+.{digits}f} [{low:+.{digits}f}, {high:+.{digits}f}], {counts}"
    return Finding(claim, theirs, text, verdict(low, high))


def spread(split: int) -> Callable[..., np.ndarray]:
    """By how much the means of the first `split` settings range wider than those of the others."""
    return lambda *scores: (
        np.ptp([*map(mean_of_tasks, scores[:split])], 0) - np.ptp([*map(mean_of_tasks, scores[split:])], 0)
    )


def spreads(rows: list[dict], column: str, method: str, k: int) -> Finding | None:
    """The claim that the score changes more with K of plain PPO than with d_target at one K."""
    over_k = {k: by_task(select(rows, "PPO", k), column) for k in KS if select(rows, "PPO", k)}
    targets = {t: by_task(select(rows, method, k, t), column) for t in TARGETS if select(rows, method, k, t)}
    if len(over_k) < 2 or len(targets) < 2:
        return None
    groups = common(*over_k.values(), *targets.values())
    middle, low, high = bootstrap(spread(len(over_k)), *groups)
    text = f"{middle:+.2f} [{low:+.2f}, {high:+.2f}], {len(groups[0])} tasks, {len(over_k)} K, {len(targets)} d_target"
    claim = f"{METHODS[method]}, K = {k}: d_target matters less than K (range over K less range over d_target)"
    return Finding(claim, "+", text, verdict(low, high))


def wins(rows: list[dict], column: str, k: int) -> str:
    """On how many tasks KLE-Stop with 0.03 has a lower mean than plain PPO."""
    groups = [by_task(part, column) for part in (select(rows, "stop", k, 0.03), select(rows, "PPO", k))]
    if not all(groups):
        return ""
    stop, plain = common(*groups)
    return f"{sum(stop[task].mean() < plain[task].mean() for task in stop)} of {len(stop)}"


def best_k(rows: list[dict], column: str) -> int:
    """The K at which plain PPO has the highest mean over tasks."""
    means = {k: mean_of_tasks(by_task(select(rows, "PPO", k), column)) for k in KS if select(rows, "PPO", k)}
    return max(means, key=means.get)


def findings(rows: list[dict], column: str) -> list[Finding]:
    """The claims of section 4.5, and of Fig. 4.1 and 4.2, on whatever runs there are."""
    plain = {k: select(rows, "PPO", k) for k in KS}
    best = best_k(rows, column)
    found = [
        difference("PPO: K = 10 above K = 4", "+0.11", plain[10], plain[4], column),
        difference("PPO: K = 10 above K = 20", "+0.13", plain[10], plain[20], column),
        difference("PPO: K = 10 above K = 80 (unlearning)", "+0.34", plain[10], plain[80], column),
        difference("KL divergence: PPO at K = 80 above K = 10", "+ (Fig. 4.1c)", plain[80], plain[10], "mean_kl", 3),
    ]
    for method, old in (("stop", ("+0.36", "+0.02")), ("rollback", ("+0.38", "+0.04"))):
        ours, name = select(rows, method, 80, 0.03), METHODS[method]
        found.append(difference(f"K = 80: {name} 0.03 above PPO", old[0], ours, plain[80], column))
        claim = f"{name} 0.03 at K = 80 above PPO at its best K ({best})"
        found.append(difference(claim, old[1], ours, plain[best], column))
    for method in ("stop", "rollback"):
        ours = select(rows, method, 10, 0.03)
        old = "+0.07" if method == "stop" else "+0.05"
        found.append(difference(f"K = 10: {METHODS[method]} 0.03 above PPO", old, ours, plain[10], column))
    stop = {k: select(rows, "stop", k, 0.03) for k in KS}
    found.append(difference("K = 4: KLE-Stop 0.03 above PPO", "+0.13", stop[4], plain[4], column))
    late = [{**row, "late": row["iterations_last_quarter"] - row["iterations_first_quarter"]} for row in stop[80]]
    none = [{**row, "late": 0.0} for row in late]
    claim = "KLE-Stop 0.03, K = 80: more iterations in the last quarter than in the first"
    found.append(difference(claim, "+ (Fig. 4.1d)", late, none, "late", 1))
    found += [spreads(rows, column, method, k) for method in ("stop", "rollback") for k in (80, 10)]
    return [finding for finding in found if finding is not None]


def findings_table(rows: list[dict], column: str) -> list[list[str]]:
    lines = [["claim", "published", "measured, 95%", "verdict"]]
    lines += [[each.claim, each.published, each.measured, each.verdict] for each in findings(rows, column)]
    for k, old in ((10, "3 of 11"), (4, "")):
        if wins(rows, column, k):
            lines.append([f"K = {k}: tasks on which KLE-Stop 0.03 is below PPO", old, wins(rows, column, k), ""])
    return lines


def iqm_table(rows: list[dict], column: str) -> list[list[str]]:
    """Interquartile means with their intervals."""
    lines = [["", *(f"K = {k}" for k in KS)]]
    for method, target in SETTINGS:
        line = [setting_name(method, target)]
        for k in KS:
            scores = by_task(select(rows, method, k, target), column)
            middle, low, high = bootstrap(interquartile_mean, scores) if scores else (0, 0, 0)
            line.append(f"{middle:.2f} [{low:.2f}, {high:.2f}]" if scores else "")
        lines.append(line)
    return lines


def cost_table(rows: list[dict]) -> list[list[str]]:
    """Steps per second by task and K, and what 1,210 runs of 2,000,000 steps take on one core at those speeds."""
    lines = [["task", *(f"K = {k}" for k in KS), "core-hours of its 110 runs"]]
    total, known = 0.0, 0
    for task in TASKS:
        own = [row for row in rows if row["task"] == task]
        speeds = {k: [row["steps_per_second"] for row in own if row["K"] == k] for k in KS}
        line = [task, *(f"{np.median(speeds[k]):,.0f}" if speeds[k] else "" for k in KS)]
        if all(speeds.values()):
            hours = sum(22 * 2e6 / speed for speed in (cell_speed(own, k) for k in KS)) / 3600
            total, known = total + hours, known + 1
            line.append(f"{hours:.1f}")
        else:
            line.append("")
        lines.append(line)
    lines.append([f"sum of {known} tasks", *[""] * len(KS), f"{total:.1f}"])
    return lines


def cell_speed(rows: list[dict], k: int) -> float:
    """Harmonic mean of the steps per second at a K, in which plain PPO counts 1 and each early stop 5, as in the study."""
    speeds = {method: [row["steps_per_second"] for row in select(rows, method, k)] for method in METHODS}
    weights = {method: 1 if method == "PPO" else 5 for method, found in speeds.items() if found}
    seconds = sum(weight / float(np.median(speeds[method])) for method, weight in weights.items())
    return sum(weights.values()) / seconds


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


def score_over_k(axes, rows: list[dict], column: str) -> None:
    """Fig. 4.1a: mean over tasks; the band of plain PPO is the bootstrap's, of the others the range over d_target."""
    for method in METHODS:
        ks = [k for k in KS if select(rows, method, k, None if method == "PPO" else 0.03)]
        if not ks:
            continue
        if method == "PPO":
            found = [bootstrap(mean_of_tasks, by_task(select(rows, method, k), column)) for k in ks]
            middle, low, high = np.array(found).T
        else:
            means = [
                [
                    mean_of_tasks(by_task(select(rows, method, k, t), column))
                    for t in TARGETS
                    if select(rows, method, k, t)
                ]
                for k in ks
            ]
            middle = [mean_of_tasks(by_task(select(rows, method, k, 0.03), column)) for k in ks]
            low, high = [min(each) for each in means], [max(each) for each in means]
        label = METHODS[method] + ("" if method == "PPO" else " 0.03")
        axes.plot(ks, middle, "o-", color=COLOURS[method], markersize=4, label=label)
        axes.fill_between(ks, low, high, color=COLOURS[method], alpha=0.15, linewidth=0)
    axes.set(xscale="log", xlabel="K", ylabel="NER", title="(a) all tasks")
    axes.set_xticks(KS, map(str, KS))
    axes.minorticks_off()
    axes.legend(fontsize="small")


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
                found = [run for run in runs if run["row"] in select([run["row"]], method, k, target)]
                found = [run for run in found if run["row"]["task"] == "HalfCheetah-v2"]
                if found:
                    label = f"{METHODS[method]}{'' if target is None else f' {target}'}, K = {k}"
                    curve(panel, found, name, steps, color=COLOURS[method], linestyle=line, label=label)
        panel.set(title=f"{title}, HalfCheetah-v2", xlabel="steps, millions")
        if name == "kl":
            panel.set_yscale("log")
    axes[0, 1].legend(fontsize="x-small")
    return figure


def figure_4_2(rows: list[dict], column: str) -> Figure:
    """NER of every setting; bars are means over tasks and K, dots each K, the least on the left."""
    figure, axes = new_figure(
        "Fig. 4.2: K of plain PPO beside d_target of the early stops (dots: K = 4 to 80 from the left)", 1, 3, 12, 3.6
    )
    axes[0, 0].set_ylabel("NER")
    for panel, method in zip(axes[0], METHODS):
        settings = [(f"K = {k}", select(rows, method, k)) for k in KS]
        if method != "PPO":
            settings = [(f"{target:g}", select(rows, method, None, target)) for target in TARGETS]
        for x, (_, found) in enumerate(settings):
            if found:
                middle, low, high = bootstrap(mean_of_tasks, by_task(found, column))
                panel.bar(x, middle, color=COLOURS[method], alpha=0.6)
                panel.errorbar(x, middle, [[middle - low], [high - middle]], color="black", capsize=3)
                for k in sorted({row["K"] for row in found}) if method != "PPO" else []:
                    score = mean_of_tasks(by_task([row for row in found if row["K"] == k], column))
                    panel.plot(x + (KS.index(k) - 2) * 0.15, score, "o", color="black", markersize=2.5)
        panel.set_xticks(range(len(settings)), [name for name, _ in settings])
        panel.set(title=METHODS[method] + ("" if method == "PPO" else ", by d_target"), ylim=(0, 1))
    return figure


def task_figures(runs: list[dict], steps: int) -> list[Figure]:
    """Fig. 4.3 to 4.6: three tasks each, one a column: NER over K, return over K, KL divergence and iterations over K."""
    figures = []
    rows = [run["row"] for run in runs]
    measures = {"as written": "NER", "last_50": "return", "mean_kl": "KL divergence", "iterations": "iterations"}
    for number, begin in enumerate(range(0, len(TASKS), 3)):
        tasks = [task for task in TASKS[begin : begin + 3] if any(row["task"] == task for row in rows)]
        if not tasks:
            continue
        title = f"Fig. 4.{3 + number}, {steps:,} steps: means, and ranges over seeds; early stops with 0.03"
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
        axes[0, 0].legend(fontsize="x-small")
        figures.append(figure)
    return figures


def curves_figure(runs: list[dict], steps: int) -> Figure:
    """Learning curves of each task at K = 10 and K = 80."""
    tasks = [task for task in TASKS if any(run["row"]["task"] == task for run in runs)]
    columns = min(4, len(tasks))
    lines = -(-len(tasks) // columns)
    figure, axes = new_figure(
        f"Return in training: means and ranges over seeds, {steps:,} steps", lines, columns, 4 * columns, 3 * lines
    )
    for panel, task in zip(axes.flat, tasks):
        for method, target in (("PPO", None), ("stop", 0.03), ("rollback", 0.03)):
            for k, line in ((10, "-"), (80, "--")):
                found = [run for run in runs if select([run["row"]], method, k, target) and run["row"]["task"] == task]
                if found:
                    label = f"{METHODS[method]}{'' if target is None else f' {target}'}, K = {k}"
                    curve(panel, found, "return", steps, color=COLOURS[method], linestyle=line, label=label)
        panel.set_title(task)
    for panel in axes.flat[len(tasks) :]:
        panel.set_visible(False)
    axes.flat[0].legend(fontsize="x-small")
    figure.supxlabel("steps, millions")
    return figure


def heat_map(rows: list[dict], column: str) -> Figure:
    """NER of K × d_target for each early stop, beside plain PPO."""
    figure, axes = new_figure("NER by K and d_target", 1, 2, 10, 3.6)
    for panel, method in zip(axes[0], ("stop", "rollback")):
        names = ["PPO", *map(str, TARGETS)]
        groups = [[select(rows, "PPO", k) for k in KS], *([select(rows, method, k, t) for k in KS] for t in TARGETS)]
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
    """Share of the runs above each score (performance profiles), at K = 10 and K = 80, with bootstrap bands."""
    figure, axes = new_figure("Performance profiles: share of runs with at least this NER", 1, 2, 9, 3.6)
    levels = np.linspace(0, 1, 101)

    def profile(scores: Scores) -> np.ndarray:
        """(..., seeds) -> (..., levels)"""
        return np.mean([(values[..., None, :] >= levels[:, None]).mean(-1) for values in scores.values()], 0)

    for panel, k in zip(axes[0], (10, 80)):
        for method, target in (("PPO", None), ("stop", 0.03), ("rollback", 0.03)):
            scores, rng = by_task(select(rows, method, k, target), column), np.random.default_rng(0)
            if scores:
                low, high = np.percentile(profile(resample(scores, rng)), (2.5, 97.5), axis=0)
                panel.plot(levels, profile(scores), color=COLOURS[method], label=METHODS[method])
                panel.fill_between(levels, low, high, color=COLOURS[method], alpha=0.15, linewidth=0)
        panel.set(title=f"K = {k}", xlabel="NER", ylim=(0, 1))
    axes[0, 0].legend(fontsize="small")
    return figure


# ---------------------------------------------------------------------------------------------------------------------
# The report
# ---------------------------------------------------------------------------------------------------------------------
def provenance(rows: list[dict], args: Args) -> str:
    """What the results rest on."""
    made_at = sorted({commit_of("ppo_continuous_kle", digest) for digest in {row["script_sha256"] for row in rows}})
    hours = sum(row["training_seconds"] for row in rows) / 3600
    return (
        f"`benchmark/ppo_kle.sh`, ppo_continuous_kle.py at {', '.join(made_at)}; `python benchmark/report.py --steps "
        f"{args.steps}` at {commit()}. {hours:.1f} core-hours of training, one thread each.\n\n"
        f"{coverage(rows, args.steps)}\n\n"
    )


def tables(rows: list[dict], all_rows: list[dict], is_whole: bool) -> dict[str, list[list[str]]]:
    """All tables by their captions; published numbers, which are of 2,000,000 steps, only beside whole runs.

    Speeds are those of `all_rows`, of runs that have not come so far too.
    """
    ner, iterations, returns = ({}, {}, {})
    if is_whole:
        ner, iterations = published("table_4_2.csv"), published("table_4_3.csv")
        returns = {row["task"]: row for row in published_rows("table_4_4.csv")}
    old = "published / " if is_whole else ""
    both = dict.fromkeys(SCORES)
    early = {"iterations": "iterations", "first": "iterations_500k"}
    written = "as written"
    return {
        f"Table 4.2: NER, {old}as tabulated / as written": grid_table(rows, {d: d for d in both}, ner, 2, SETTINGS),
        f"Table 4.3: iterations per update, {old}whole run / first 500,000 steps": grid_table(
            rows, early, iterations, 2, SETTINGS[1:]
        ),
        f"Table 4.4: return of plain PPO, {old}last episode / last 50 episodes": table_4_4(rows, returns),
        "Findings of section 4.5, by the NER as written": findings_table(rows, written),
        "Interquartile mean of the NER as written, with its 95% interval": iqm_table(rows, written),
        "Cost: median steps per second of all runs, also shorter ones, one thread; core-hours of 2,000,000 steps": cost_table(
            all_rows
        ),
    }


def main(args: Args) -> None:
    found = read_runs(args.runs, args.steps, args.workers)
    runs = [run for run in found if "curves" in run]
    if not runs:
        raise SystemExit(f"--runs {args.runs}: holds no run of {args.steps:,} steps")
    out = args.out or ROOT / "benchmark" / "results" / "ppo_kle" / f"{args.steps}"
    out.mkdir(parents=True, exist_ok=True)
    rows = [run["row"] for run in runs]
    write_csv(out / "runs.csv", rows)
    for definition in SCORES:
        normalise(rows, definition)
    made = tables(rows, [run["row"] for run in found], args.steps == 2_000_000)
    text = provenance(rows, args) + "\n".join(f"## {name}\n\n{markdown(lines)}" for name, lines in made.items())
    (out / "tables.md").write_text(text)
    (out / "tables.tex").write_text("\n".join(latex(lines, name) for name, lines in made.items()))
    figures = {"fig_4_1": figure_4_1(runs, "as written", args.steps), "fig_4_2": figure_4_2(rows, "as written")}
    figures |= {f"fig_4_{3 + i}": figure for i, figure in enumerate(task_figures(runs, args.steps))}
    figures |= {"learning_curves": curves_figure(runs, args.steps), "heat_map": heat_map(rows, "as written")}
    figures["profiles"] = profiles(rows, "as written")
    for name, figure in figures.items():
        figure.savefig(out / f"{name}.png", dpi=110)
    print(text)


if __name__ == "__main__":
    main(tyro.cli(Args, description=__doc__.split("\n\n")[0]))
