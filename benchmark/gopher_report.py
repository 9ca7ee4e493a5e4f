"""Gopher's runs -> Table 2.2, Fig. 2.6, the DQNs' learning curves, and whether the thesis' claims hold.

    python benchmark/gopher_report.py        # runs/gopher -> benchmark/results/gopher
    python benchmark/gopher_report.py --known benchmark/results/gopher   # with the runs of an earlier report, whose folders are gone

Takes whatever part of the runs of `benchmark/gopher_alpha.sh` is done. Scores are the number of rewards in each life, the unit in
which Table 2.2 seems to count (benchmark/results/README.md), and in `runs.csv` also the points of a game. Intervals are 95%
t-intervals of the seeds' means. A seed has its own human and student, but all students have the same DQN; differences from it hold
the error of its own score.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from apple_report import ACTS, alpha_curve, cell, mean_score, representative_alpha, temperatures
from common import (
    ROOT,
    UsageError,
    commit,
    distinct,
    finished_runs,
    kind_of,
    made_at,
    published_table,
    read_args,
    run_main,
    select,
    with_known,
    write_csv,
)
from gopher_players import Args as PlayersArgs
from gopher_players import load_method, measure, quick_human
from intervals import interval, with_interval
from matplotlib.figure import Figure

LIVES, GAMES = "rewards of a life", "points of a game"
STUDENTS = {"hybrid, α = 0.8": "alpha0.8", "BC, α = 0": "alpha0.0", "distilled DQN, α = 1": "alpha1.0"}
DQNS = {"full": "", "teacher": ", the students' teacher"}
WORDS = {"kind", "mode", "unit", "arithmetic", "script_sha256", "flags"}  # columns of runs.csv without numbers
CONTROLS = ("quick_", "episode_")  # how their folders' names begin
PLATEAU = "mean of α = 0.1 to 0.6"
WINDOW = 50  # episodes of a DQN's moving mean


@dataclass
class Args:
    runs: Path = Path("runs/gopher")
    """folder of the runs' folders"""
    human_episodes: int = 300
    """games of the synthetic human for each seed"""
    known: Path | None = None
    """folder of an earlier report, whose runs.csv stands for runs that are not in `--runs`"""
    note: str = ""
    """a sentence put above the tables, on what the runs do not record themselves"""
    out: Path = ROOT / "benchmark" / "results" / "gopher"
    """folder for tables and figures"""


def read_runs(folder: Path) -> list[dict]:
    """A row for every finished run, way to act and unit: what it was and what it scored."""
    rows = []
    for run, result in finished_runs(folder):
        args, is_student = read_args(run), "sampled" in result["evaluation"]
        evaluations = result["evaluation"] if is_student else {"greedy": result["evaluation"]}
        for mode, numbers in evaluations.items():
            for unit, scores in ((LIVES, numbers["rewards_per_life"]), (GAMES, numbers)):
                row = {"kind": kind_of(run), "seed": result["seed"]}
                row |= {"alpha": args.get("alpha", ""), "temperature": args.get("temperature", "")}
                row |= {"mode": mode, "unit": unit, "scores": scores["episodes"]}
                row |= {name: round(scores[name], 3) for name in ("mean", "std", "min", "max")}
                row |= {"kept_epoch": result["test"]["epoch"] if is_student else ""}
                row |= {"agrees_with_dqn": round(result.get("test", {}).get("accuracy_rl") or np.nan, 4)}
                row |= {"agrees_with_human": round(result.get("test", {}).get("accuracy_human", np.nan), 4)}
                row |= {"steps": result["global_step"], "training_seconds": round(result["training_seconds"])}
                row |= {"threads": args["num_threads"], "arithmetic": result["arithmetic"]}
                row |= {"flags": "" if is_student else own_flags(args)}
                rows.append(row | {"script_sha256": result["script_sha256"][:12]})
    return rows


def own_flags(args: dict) -> str:
    """In what a DQN differs from the defaults of dqn_gopher.py, which are the thesis', but for its frames."""
    flags = [("--life-loss-ends", args["life_loss_ends"]), (f"--n-step {args['n_step']}", args["n_step"] > 1)]
    return " ".join(flag for flag, holds in (*flags, ("--anneal-lr", args["anneal_lr"])) if holds)


def human_rows(seeds: list[int], episodes: int, quick: bool = False) -> list[dict]:
    """The synthetic human's games for each seed, or those of the quick one, in the same units."""
    method = load_method("distill_hybrid")
    human, rows = quick_human(method) if quick else method.SyntheticGopherHuman, []
    for seed in seeds:
        measured = measure(method, "human", human, PlayersArgs(episodes=episodes, seed=seed))
        rows += [{**row, "seed": seed} for row in measured if row["unit"] in (LIVES, GAMES)]
    return rows


def score_cells(group: list[dict]) -> str:
    """Number of seeds, means of the greatest and the least score, mean and spread."""
    most, least, means, spreads = ([row[name] for row in group] for name in ("max", "min", "mean", "std"))
    return (
        f"{len(group)} | {np.mean(most):.0f} | {np.mean(least):.1f} | {with_interval(means)} | {with_interval(spreads)}"
    )


def table_2_2(rows: list[dict], human: list[dict]) -> str:
    """Table 2.2, published beside measured, and the points of a game; nobody has been asked who is a human."""
    published = published_table("table_2_2.csv")
    header = "| agent | | seeds | max, mean over seeds | min, mean over seeds | avg | std | taken for a human, of 52 | points of a game |"
    lines = [header, "|" + "---|" * 9]
    measured = {"human": [("synthetic", human)]}
    dqns = {kind: select(rows, kind, "greedy") for kind in DQNS}
    measured |= {"DQN": [(f"{distinct(dqns[kind], 'steps')} frames{DQNS[kind]}", dqns[kind]) for kind in DQNS]}
    measured |= {name: [(mode, select(rows, kind, mode)) for mode in ACTS] for name, kind in STUDENTS.items()}
    for agent, groups in measured.items():
        if agent in published:
            columns = ("max", "min", "avg", "std", "identified_as_human_of_52")
            lines.append(
                f"| {agent} | **published** | 1 | {' | '.join(published[agent][name] for name in columns)} | |"
            )
        for acts, group in groups:
            in_units = {unit: [row for row in group if row["unit"] == unit] for unit in (LIVES, GAMES)}
            if group:
                points = with_interval([row["mean"] for row in in_units[GAMES]], 0)
                lines.append(f"| {agent} | {ACTS.get(acts, acts)} | {score_cells(in_units[LIVES])} | | {points} |")
    return "\n".join(lines) + "\n"


def by_seed(rows: list[dict]) -> dict[int, float]:
    return {row["seed"]: row["mean"] for row in rows if row["unit"] == LIVES}


def trend(curve: dict[float, dict[int, float]], low: float, high: float) -> str:
    """How much a straight line through the scores of α = `low` to `high` rises, with the interval over seeds that have all."""
    alphas = [alpha for alpha in curve if low <= alpha <= high]
    slopes = [np.polyfit(alphas, [curve[a][seed] for a in alphas], 1)[0] for seed in plateau(curve, low, high)]
    rise, half = interval([(alphas[-1] - alphas[0]) * slope for slope in slopes])
    return "" if np.isnan(rise) else f"{rise:+.1f}" + ("" if np.isnan(half) else f" ± {half:.1f}") + f" ({len(slopes)})"


def plateau(curve: dict[float, dict[int, float]], low: float, high: float) -> dict[int, float]:
    """The mean over α = `low` to `high` of each seed that has all of them."""
    alphas = [alpha for alpha in curve if low <= alpha <= high]
    seeds = set.intersection(*(set(curve[alpha]) for alpha in alphas)) if len(alphas) > 2 else set()
    return {seed: float(np.mean([curve[alpha][seed] for alpha in alphas])) for seed in sorted(seeds)}


def own_error(rows: list[dict]) -> float:
    """Standard error of the DQN's score, over its lives."""
    errors = [row["std"] / row["scores"] ** 0.5 for row in select(rows, "teacher", "greedy") if row["unit"] == LIVES]
    return float(np.linalg.norm(errors) / max(1, len(errors)))


def less(first: dict[int, float], second: dict[int, float], error: float = 0.0) -> str:
    """Mean difference of the seeds that both have, with its interval; `error` is the standard error that all share."""
    differences = [first[seed] - second[seed] for seed in first.keys() & second.keys()]
    difference, half = interval(differences)
    half = float(np.hypot(half, 1.96 * error))
    spread = "" if np.isnan(half) else f" ± {half:.1f}"
    return "" if np.isnan(difference) else f"{difference:+.1f}{spread} ({len(differences)})"


def claims_table(rows: list[dict], human: list[dict]) -> str:
    """The order, the plateau up to α = 0.6, at the human's score, and the rise from 0.7 of Fig. 2.6; in brackets the seeds.

    Differences are taken seed by seed. The first column decides, students who sample, of the best test accuracy; the others are
    for comparison.
    """
    published = {name: float(row["avg"]) for name, row in published_table("table_2_2.csv").items()}
    lines = [f"| rewards of a life | published | {' | '.join(ACTS.values())} |", "|---|---|" + "---|" * len(ACTS)]
    dqn = by_seed(select(rows, "teacher", "greedy"))
    students = sorted({row["seed"] for row in rows if row["kind"] in STUDENTS.values()})
    teachers = dict.fromkeys(students, np.mean(list(dqn.values()))) if dqn else {}
    pairs = (
        ("DQN", "hybrid, α = 0.8"),
        ("hybrid, α = 0.8", "human"),
        ("hybrid, α = 0.8", "BC, α = 0"),
        ("distilled DQN, α = 1", "hybrid, α = 0.8"),
        (PLATEAU, "human"),
        ("α = 0.6", "α = 0.1"),
        ("α = 1", "α = 0.7"),
    )
    for first, second in pairs:
        known = first in published and second in published
        cells = [f"{published[first] - published[second]:+.1f}" if known else ""]
        for mode in ACTS:
            curve = alpha_curve([row for row in rows if row["unit"] == LIVES], mode)
            scores = {name: curve.get(float(kind[5:]), {}) for name, kind in STUDENTS.items()}
            scores |= {f"α = {alpha:g}": values for alpha, values in curve.items()}
            scores |= {"DQN": teachers, "human": by_seed(human), PLATEAU: plateau(curve, 0.1, 0.6)}
            have = scores.get(first) and scores.get(second)
            error = own_error(rows) if first == "DQN" else 0.0
            cells.append(less(scores[first], scores[second], error) if have else "")
        lines.append(f"| {first}, less {second} | {' | '.join(cells)} |")
    curves = [alpha_curve([row for row in rows if row["unit"] == LIVES], mode) for mode in ACTS]
    for low, high in ((0.1, 0.6), (0.7, 1.0)):
        cells = [trend(curve, low, high) for curve in curves]
        lines.append(f"| a straight line from α = {low:g} to {high:g} rises by | | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def swept_temperatures(rows: list[dict]) -> list[float]:
    """Of the students that are there; the default where there are none but clones, which do not depend on it."""
    return temperatures(rows) or [0.01]


def alpha_table(rows: list[dict], mode: str, human: float) -> str:
    """Fig. 2.6 in numbers: score for each α and temperature, and the α that the thesis' rule picks."""
    columns = {temperature: alpha_curve(rows, mode, temperature) for temperature in swept_temperatures(rows)}
    alphas = sorted({alpha for curve in columns.values() for alpha in curve})
    most = max(len(scores) for curve in columns.values() for scores in curve.values())
    lines = [f"| α, {ACTS[mode]} | " + " | ".join(f"T = {temperature}" for temperature in columns) + " |"]
    lines.append("|---|" + "---|" * len(columns))
    for alpha in alphas:
        lines.append(f"| {alpha} | {' | '.join(cell(curve.get(alpha, {}), most) for curve in columns.values())} |")
    picked = [representative_alpha(curve, human) if len(curve) == len(alphas) else "" for curve in columns.values()]
    lines.append(f"| rule picks | {' | '.join('none' if alpha is None else str(alpha) for alpha in picked)} |")
    return "\n".join(lines) + "\n"


def agreement_table(rows: list[dict]) -> str:
    """How often the kept network agrees with its teachers on the test frames, which chose it.

    They are drawn one by one, so that neighbours which share three of four pictures are learned from, but for "episode_".
    """
    lines = ["| runs | seeds | kept epochs | agrees with DQN | with human |", "|---|---|---|---|---|"]
    kept = [row for row in rows if row["mode"] == "sampled" and row["unit"] == LIVES]
    for kind in sorted({row["kind"] for row in kept}):
        group = select(kept, kind, "sampled")
        epochs = ", ".join(str(row["kept_epoch"]) for row in group)
        known = {name: [row[name] for row in group] for name in ("agrees_with_dqn", "agrees_with_human")}
        cells = ["" if np.isnan(values).any() else with_interval(values, 3) for values in known.values()]
        lines.append(f"| {kind} | {len(group)} | {epochs} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def controls_table(rows: list[dict], quick: list[dict]) -> str:
    """Students of a human who reacts within what they see ("quick"), and those whose test frames are of other episodes."""
    lines = [
        "| run | seeds | its human | sampled | greedy | sampled, less the run without the word |",
        "|" + "---|" * 6,
    ]
    lives = [row for row in rows if row["unit"] == LIVES]
    for kind in sorted({row["kind"] for row in lives if row["kind"].startswith(CONTROLS)}):
        scores, usual = (by_seed(select(lives, name, "sampled")) for name in (kind, kind.split("_", 1)[1]))
        human = with_interval([row["mean"] for row in quick if row["unit"] == LIVES], 1) if "quick" in kind else ""
        means = [with_interval([row["mean"] for row in select(lives, kind, mode)], 1) for mode in ("sampled", "greedy")]
        lines.append(f"| {kind} | {len(scores)} | {human} | {' | '.join(means)} | {less(scores, usual)} |")
    return "\n".join(lines) + "\n"


def figure_2_6(rows: list[dict], human: float) -> Figure:
    """Score over α, a panel for each way to act and kept network, a line for each T."""
    figure = Figure(figsize=(10, 6.5), layout="constrained")
    published = {name: float(row["avg"]) for name, row in published_table("table_2_2.csv").items()}
    stars = {0.0: published["BC, α = 0"], 0.8: published["hybrid, α = 0.8"]}
    teacher = list(by_seed(select(rows, "teacher", "greedy")).values())
    grid = figure.subplots(2, 2, sharex=True, sharey=True)
    for axes, mode in zip(grid.flat, ACTS):
        for i, temperature in enumerate(swept_temperatures(rows)):
            curve = alpha_curve(rows, mode, temperature)
            means, halves = np.array([interval(list(scores.values())) for scores in curve.values()]).T
            is_swept, style = len(curve) > 4, {"color": f"C{i}", "markersize": 3, "label": f"T = {temperature}"}
            axes.errorbar(list(curve), means, np.nan_to_num(halves), fmt="o-" if is_swept else "o", capsize=2, **style)
        if teacher:
            axes.axhline(np.mean(teacher), color="black", linestyle="--", linewidth=1, label="DQN")
        axes.axhline(human, color="black", linestyle=":", linewidth=1, label="synthetic human")
        axes.plot(list(stars), list(stars.values()), "k*", markersize=8, label="published (Table 2.2)")
        axes.set(title=ACTS[mode], ylim=(0, None))
        axes.spines[["top", "right"]].set_visible(False)
    for axes in grid[1]:
        axes.set_xlabel("α, weight of the DQN")
    for axes in grid[:, 0]:
        axes.set_ylabel("rewards of a life")
    figure.legend(*grid[0, 0].get_legend_handles_labels(), fontsize="small", loc="outside right center")
    curves = [alpha_curve(rows, "sampled", temperature) for temperature in swept_temperatures(rows)]
    seeds = sorted({len(scores) for curve in curves for scores in curve.values()})
    number = " to ".join(map(str, sorted({seeds[0], seeds[-1]})))
    figure.suptitle(f"Fig. 2.6: mean score over α; bars are 95% intervals of {number} seed{'s' * (seeds[-1] > 1)}")
    return figure


def dqn_curve(run: Path) -> list[dict]:
    """The moving mean of a DQN's episodes in training, at 200 points; empty where none has ended."""
    lines = (run / "episodes.csv").read_text().splitlines()[1:]
    if not lines:
        return []
    ends, returns, _ = np.array([line.split(",") for line in lines], np.float64).T
    width = min(WINDOW, len(returns))
    means = np.convolve(returns, np.ones(width) / width, "valid")
    at = np.linspace(ends[width - 1], ends[-1], 200)
    values = np.interp(at, ends[width - 1 :], means)
    return [{"frames": int(x), f"mean_of_{width}_episodes": round(float(y), 1)} for x, y in zip(at, values)]


def dqn_flags(rows: list[dict]) -> str:
    """In what the DQNs differ from the thesis'."""
    flags = sorted({row["flags"] for row in rows if row["flags"]})
    return f"The DQN was trained with `{'`, `'.join(flags)}`, which is ours. " if flags else ""


def provenance(rows: list[dict], note: str) -> str:
    """What the results rest on."""
    runs = {(row["kind"], row["seed"]): row for row in rows}
    hours = sum(row["training_seconds"] * row["threads"] for row in runs.values()) / 3600
    arithmetic = " and ".join(sorted({row["arithmetic"].split(" on ")[0].split(", ")[-1] for row in runs.values()}))
    scripts = {"dqn_gopher": tuple(DQNS), "distill_hybrid": ("alpha",)}
    return (
        f"`benchmark/gopher_alpha.sh`, commits: {made_at(rows, scripts)}; this report at {commit()}. {len(runs)} runs, "
        f"{hours:.1f} core-hours of training, in {arithmetic}; each ± is a 95% t-interval over seeds. All students learn from "
        "the same DQN, another of which would be other; differences from it hold the error of its own score. "
        f"{dqn_flags(rows)}A student learns at T = 0.01 where no other is named, and is of the epoch with the best test "
        f"accuracy; greedy players have 1% of random actions.{f' {note}' if note else ''}\n\n"
    )


def main(args: Args) -> None:
    rows = read_runs(args.runs)
    if args.known is not None:
        rows = with_known(rows, args.known / "runs.csv", ("kind", "seed"), WORDS)
        rows.sort(key=lambda row: (row["kind"], row["seed"]))
    if not rows:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    lives = [row for row in rows if row["unit"] == LIVES]
    human = human_rows(sorted({row["seed"] for row in rows}), args.human_episodes)
    quick_seeds = sorted({row["seed"] for row in rows if row["kind"].startswith("quick")})
    human_score = mean_score(by_seed(human))
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "runs.csv", rows)
    sections = {"Table 2.2": table_2_2(rows, human)}
    if any(alpha_curve(lives, "sampled", temperature) for temperature in swept_temperatures(lives)):
        sections["The thesis' claims"] = claims_table(rows, human)
        sections["Fig. 2.6"] = "\n".join(alpha_table(lives, mode, human_score) for mode in ACTS)
        sections["Which network is kept"] = agreement_table(rows)
        if any(row["kind"].startswith(CONTROLS) for row in rows):
            sections["Controls"] = controls_table(rows, human_rows(quick_seeds, args.human_episodes, quick=True))
        figure_2_6(lives, human_score).savefig(args.out / "fig_2_6.png", dpi=130)
    for run, _ in finished_runs(args.runs):
        kind = kind_of(run)
        if kind in DQNS:
            (args.out / f"{kind}.png").write_bytes((run / "learning_curve.png").read_bytes())
            curve = dqn_curve(run)
            if curve:
                write_csv(args.out / f"{kind}.csv", curve)
    text = provenance(rows, args.note) + "\n".join(f"## {name}\n\n{table}" for name, table in sections.items())
    (args.out / "table.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
