"""The Apple game's runs -> Table 2.1, Fig. 2.4, the ablations and a first measure of human-likeness.

    python benchmark/apple_report.py        # runs/apple -> benchmark/results/apple

Takes whatever part of the runs of `benchmark/apple_alpha.sh` is done, and says which. Intervals are 95% t-intervals of
the seeds' means.
"""

import itertools
import json
import re
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
import safetensors.torch
import torch
import torch.nn as nn
import torch.nn.functional as F
from apple_players import QUICK, load_method, shortest_path
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
    run_folders,
    run_main,
    select,
    write_csv,
)
from intervals import interval, paired_difference, with_interval
from matplotlib.figure import Figure
from scipy import stats

FPS = CLIP = 60  # a clip is 1 s
ACTS = {  # the students' evaluations
    "sampled": "sampled",
    "greedy": "greedy",
    "last_sampled": "sampled, last epoch",
    "last_greedy": "greedy, last epoch",
}


@dataclass
class Args:
    runs: Path = Path("runs/apple")
    """folder of the runs' folders"""
    out: Path = ROOT / "benchmark" / "results" / "apple"
    """folder for tables and figures"""
    likeness_episodes: int = 40
    """episodes of each agent and seed for the measure of human-likeness, half of them held out"""
    note: str = ""
    """a sentence put above the tables, on what the runs do not record themselves"""


def read_runs(folder: Path) -> list[dict]:
    """One row for every finished run: what it was and what it scored."""
    rows = []
    for run, result in finished_runs(folder):
        args, kind = read_args(run), kind_of(run)
        is_student = "sampled" in result["evaluation"]
        evaluations = result["evaluation"] if is_student else {"greedy": result["evaluation"]}
        for mode, numbers in evaluations.items():
            rows.append(
                {
                    "kind": kind,
                    "seed": result["seed"],
                    "alpha": args.get("alpha", ""),
                    "temperature": args.get("temperature", ""),
                    "mode": mode,
                    "episodes": numbers["episodes"],
                    **{name: round(numbers[name], 3) for name in ("mean", "std", "min", "max")},
                    "kept_epoch": result["test"]["epoch"] if is_student else "",
                    "test_accuracy_rl": round(result.get("test", {}).get("accuracy_rl") or np.nan, 4),
                    "test_accuracy_human": round(result.get("test", {}).get("accuracy_human", np.nan), 4),
                    "steps": result["global_step"],
                    "training_seconds": round(result["training_seconds"]),
                    "script_sha256": result.get("script_sha256", "not recorded")[:12],
                }
            )
    return rows


def scripted_rows(method, player, seeds: list[int]) -> list[dict]:
    """400 episodes of a scripted player for each seed; `player` maps a seed to a policy of 400 games."""
    rows = []
    for seed in seeds:
        games = [method.episode_seed(seed, method.EVALUATION_STREAM, i) for i in range(400)]
        scores = [episode["rewards"].sum() for episode in method.play(player(seed), "AppleGame-v0", games)]
        rows.append({"mean": np.mean(scores), "std": np.std(scores), "min": min(scores), "max": max(scores)})
    return rows


def table_2_1(rows: list[dict], human: list[dict], shortest: list[dict]) -> str:
    """Table 2.1, published beside measured."""
    lines = [
        "| agent | | seeds | max, mean over seeds | min, mean over seeds | avg | std |",
        "|---|---|---|---|---|---|---|",
    ]
    students = {"BC, α = 0": "alpha0.0", "hybrid, α = 0.93": "alpha0.93", "distilled DQN, α = 1": "alpha1.0"}
    measured = {
        "shortest path": [("scripted", shortest)],
        "human": [("synthetic", human)],
        "DQN": [("greedy", select(rows, "teacher", "greedy"))],
        **{
            name: [(mode, select(rows, kind, mode)) for mode in ("sampled", "greedy")]
            for name, kind in students.items()
        },
    }
    published = published_table("table_2_1.csv")
    for agent, groups in measured.items():
        if agent in published:
            cells = [published[agent][name] for name in ("max", "min", "avg", "std")]
            lines.append(f"| {agent} | **published** | 1 | {' | '.join(cells)} |")
        for name, group in groups:
            if group:
                columns = [[row[key] for row in group] for key in ("max", "min", "mean", "std")]
                cells = [f"{np.mean(columns[0]):.1f}", f"{np.mean(columns[1]):.1f}", *map(with_interval, columns[2:])]
                lines.append(f"| {agent} | {name} | {len(group)} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def alpha_curve(
    rows: list[dict], mode: str, temperature: float = 0.01, group: str = ""
) -> dict[float, dict[int, float]]:
    """The mean score for each α and seed at a temperature, which α = 0 does not depend on; `group` begins the folders."""
    curve = defaultdict(dict)
    for row in rows:
        is_swept = re.fullmatch(group + r"(T[\d.]+_)?alpha[\d.]+", row["kind"]) and row["mode"] == mode
        if is_swept and (row["temperature"] == temperature or row["alpha"] == 0):
            curve[row["alpha"]][row["seed"]] = row["mean"]
    return dict(sorted(curve.items()))


def temperatures(rows: list[dict], group: str = "") -> list[float]:
    swept = [row for row in rows if re.fullmatch(group + r"(T[\d.]+_)?alpha[\d.]+", row["kind"])]
    return sorted({row["temperature"] for row in swept if row["alpha"] > 0})


def mean_score(scores: dict[int, float]) -> float:
    return float(np.mean(list(scores.values())))


def representative_alpha(curve: dict[float, dict[int, float]], human: float) -> float | None:
    """The thesis' rule: the smallest α tried above 0 whose score is better than the human's."""
    better = [alpha for alpha, scores in curve.items() if alpha > 0 and mean_score(scores) > human]
    return min(better) if better else None


def cell(scores: dict[int, float], most: int) -> str:
    """Mean and interval, and the number of seeds where it is not all of them."""
    number = "" if len(scores) == most else f" ({len(scores)})"
    return with_interval(list(scores.values()), 1) + number if scores else ""


def alpha_table(rows: list[dict], mode: str) -> str:
    """Fig. 2.4 in numbers: score for each α and temperature; in brackets the number of seeds where it is not all."""
    columns = {
        f"T = {temperature}": alpha_curve(rows, mode, temperature) for temperature in temperatures(rows) or [0.01]
    }
    alphas = sorted({alpha for curve in columns.values() for alpha in curve})
    most = max((len(scores) for curve in columns.values() for scores in curve.values()), default=0)
    lines = [f"| α, {ACTS[mode]} | {' | '.join(columns)} |", "|---|" + "---|" * len(columns)]
    for alpha in alphas:
        cells = [cell(curve.get(alpha, {}), most) for curve in columns.values()]
        lines.append(f"| {alpha} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def shape_table(rows: list[dict], humans: dict[str, float]) -> str:
    """The thesis' dip (α = 0.7 below α = 0) and rise (from 0.7 to 1) in each curve, and the α that its rule picks.

    The fall from 0.5 to 0.9 was looked for after the curves were seen.
    """
    header = "| synthetic human | T | student | α = 0 | α = 0.7 | α = 1 | 0.7 less 0 | 1 less 0.7 | 0.9 less 0.5 | rule picks α |"
    lines = [header, "|" + "---|" * 10]
    for (group, human), mode in itertools.product(humans.items(), ACTS):
        for temperature in temperatures(rows, group):
            curve = alpha_curve(rows, mode, temperature, group)
            if not {0.0, 0.7, 1.0} <= curve.keys():
                continue
            values = [f"{mean_score(curve[alpha]):.1f}" for alpha in (0.0, 0.7, 1.0)]
            pairs = ((0.7, 0.0), (1.0, 0.7), (0.9, 0.5))
            changes = [paired_difference(curve.get(first, {}), curve.get(second, {})) for first, second in pairs]
            who = f"{group.strip('_') or 'calibrated'}, {human:.1f}"
            cells = (who, temperature, ACTS[mode], *values, *changes, representative_alpha(curve, human))
            lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def kept_table(rows: list[dict]) -> str:
    """Which epoch the rule of the best test accuracy keeps, and what that costs against the last epoch."""
    lines = ["| α, T = 0.01 | kept epochs | sampled, kept less last | greedy, kept less last |", "|---|---|---|---|"]
    curves = {mode: alpha_curve(rows, mode) for mode in ACTS}
    for alpha in curves["sampled"]:
        epochs = ", ".join(str(row["kept_epoch"]) for row in select(rows, f"alpha{alpha}", "sampled"))
        costs = [
            paired_difference(curves[mode][alpha], curves[f"last_{mode}"][alpha]) for mode in ("sampled", "greedy")
        ]
        lines.append(f"| {alpha} | {epochs} | {' | '.join(costs)} |")
    return "\n".join(lines) + "\n"


def ablation_table(rows: list[dict]) -> str:
    """The other states and splits beside the main sweep at the same α, and seed by seed less it."""
    less = " | ".join(f"{ACTS[mode]}, less the main sweep" for mode in ACTS)
    lines = [
        f"| runs | seeds | sampled | greedy | agrees with DQN | with human | {less} |",
        "|" + "---|" * (6 + len(ACTS)),
    ]
    kinds = {row["kind"] for row in rows if row["mode"] == "sampled"}
    others = sorted(kind for kind in kinds if kind.startswith(("own_", "episode_")))
    for kind in sorted(kinds & {kind.split("_", 1)[1] for kind in others}) + others:
        sampled, greedy = select(rows, kind, "sampled"), select(rows, kind, "greedy")
        columns = [[row["mean"] for row in sampled], [row["mean"] for row in greedy]]
        agreement = [[row[f"test_accuracy_{name}"] for row in sampled] for name in ("rl", "human")]
        cells = [kind, len(sampled), *map(with_interval, columns), *(with_interval(column, 3) for column in agreement)]
        for mode in ACTS:
            own, main = (
                {row["seed"]: row["mean"] for row in select(rows, each, mode)} for each in (kind, kind.split("_")[-1])
            )
            cells.append(paired_difference(own, main) if kind in others else "")
        lines.append(f"| {' | '.join(map(str, cells))} |")
    return "\n".join(lines) + "\n"


def figure_2_4(rows: list[dict], humans: dict[str, float]) -> Figure:
    """Score over α: a row of panels for each human and kept network, a column for each way to act, a line for each T."""
    panels = [("", ""), ("", "last_"), *([("quick_", "last_")] if "quick_" in humans else [])]
    figure = Figure(figsize=(11, 1 + 3.2 * len(panels)), layout="constrained")
    teacher, _ = interval([row["mean"] for row in select(rows, "teacher", "greedy")])
    published = published_table("table_2_1.csv")
    stars = {0.0: float(published["BC, α = 0"]["avg"]), 0.93: float(published["hybrid, α = 0.93"]["avg"])}
    every = sorted({temperature for group in humans for temperature in temperatures(rows, group)})
    colours = {temperature: f"C{i}" for i, temperature in enumerate(every)}
    most = len({row["seed"] for row in rows})
    grid = figure.subplots(len(panels), 2, sharex=True, sharey=True, squeeze=False)
    for row, (group, network) in zip(grid, panels):
        for axes, mode in zip(row, ("sampled", "greedy")):
            for temperature in temperatures(rows, group):
                curve = alpha_curve(rows, network + mode, temperature, group)
                means, halves = np.array([interval(list(scores.values())) for scores in curve.values()]).T
                has_all = all(len(scores) == most for scores in curve.values())
                style = {"color": colours[temperature], "linestyle": "-" if has_all else "--", "linewidth": 1 + has_all}
                axes.plot(list(curve), means, marker="o", markersize=3.5, label=f"T = {temperature}", **style)
                if has_all:
                    low, high = means - np.nan_to_num(halves), means + np.nan_to_num(halves)
                    axes.fill_between(list(curve), low, high, color=colours[temperature], alpha=0.15, linewidth=0)
            axes.axhline(teacher, color="black", linestyle="--", linewidth=1, label="DQN")
            axes.axhline(humans[group], color="black", linestyle=":", linewidth=1, label="synthetic human")
            if not group:
                axes.plot(list(stars), list(stars.values()), "k*", markersize=9, label="published (Table 2.1)")
            who = f"{group.strip('_')} human, {ACTS[network + mode]}".strip()
            axes.set(title=who if group else ACTS[network + mode], ylim=(0, None))
            axes.spines[["top", "right"]].set_visible(False)
        row[0].set_ylabel("apples in 30 s")
    for axes in grid[-1]:
        axes.set_xlabel("α, weight of the DQN")
    figure.legend(*grid[0, 1].get_legend_handles_labels(), fontsize="small", loc="outside right center")
    figure.suptitle(f"Fig. 2.4: mean score over α; bands are 95% intervals of {most} seeds, thin lines have fewer")
    return figure


# ---------------------------------------------------------------------------------------------------------------------
# Human-likeness without people
# ---------------------------------------------------------------------------------------------------------------------
def load_student(method, folder: Path, obs_shape: tuple[int, ...] = (6,), num_actions: int = 9):
    with safetensors.safe_open(folder / "model.safetensors", "pt") as file:
        args = json.loads(file.metadata()["args"])
    student = method.Student(obs_shape, num_actions, args["hidden_size"])
    student.load_state_dict(safetensors.torch.load_file(folder / "model.safetensors"))
    return student


HUMAN = "synthetic human"


def agents_of(method, folder: Path, seed: int, episodes: int) -> dict[str, list[dict]]:
    """Episodes of each agent of a seed that is there; the second human is as good as an agent can look."""
    seeds = [method.episode_seed(seed, method.DEMONSTRATION_STREAM, i) for i in range(episodes)]
    policies = {
        HUMAN: method.SyntheticHuman(episodes, seed),
        f"{HUMAN} again": method.SyntheticHuman(episodes, seed + 1000),
    }
    if (folder / f"teacher_seed{seed}" / "result.json").exists():
        teacher = method.load_teacher(folder / f"teacher_seed{seed}", "AppleGame-v0")
        policies["DQN"] = method.numpy_greedy(teacher)
    runs = run_folders(folder)
    for alpha in ("0.0", "0.5", "0.8", "0.93", "1.0"):
        run = runs.get((f"alpha{alpha}", seed))
        if run is not None:
            student = load_student(method, run)
            for mode in ("sampled", "greedy"):
                policies[f"α = {alpha}, {mode}"] = method.numpy_policy(student, mode, seed)
    return {name: method.play(policy, "AppleGame-v0", seeds, keep=True) for name, policy in policies.items()}


def clips(episodes: list[dict]) -> tuple[torch.Tensor, np.ndarray]:
    """Seconds of play as (clips, channels, frames), with the number of the episode each is from.

    Channels: which of the nine actions, and the way to the apple.
    """
    seconds, numbers = [], []
    for number, episode in enumerate(episodes):
        actions = F.one_hot(torch.from_numpy(episode["actions"].astype(np.int64)), 9).float()
        frames = torch.cat([actions, torch.from_numpy(episode["observations"][:-1, 4:])], 1)
        seconds += frames[: len(frames) // CLIP * CLIP].split(CLIP)
        numbers += [number] * (len(frames) // CLIP)
    return torch.stack(seconds).transpose(1, 2), np.array(numbers)


def auc(positive: np.ndarray, negative: np.ndarray) -> float:
    """Probability that a score of the first kind is above one of the second."""
    return stats.mannwhitneyu(positive, negative).statistic / (len(positive) * len(negative))


def tell_apart(human: list[dict], agent: list[dict], seed: int, clips: Callable = clips) -> float:
    """AUC on clips of held-out episodes of a classifier that learned to tell the agent from the human on the others."""
    (human_clips, human_numbers), (agent_clips, agent_numbers) = clips(human), clips(agent)
    of_human, of_agent = (torch.from_numpy(each < len(human) // 2) for each in (human_numbers, agent_numbers))
    x = torch.cat([human_clips[of_human], agent_clips[of_agent]])
    y = torch.cat([torch.zeros(int(of_human.sum())), torch.ones(int(of_agent.sum()))])
    torch.manual_seed(seed)
    network = nn.Sequential(
        *(nn.Conv1d(x.shape[1], 32, 5), nn.ReLU(), nn.Conv1d(32, 32, 5, stride=2), nn.ReLU()),
        *(nn.AdaptiveAvgPool1d(4), nn.Flatten(), nn.Linear(128, 32), nn.ReLU(), nn.Linear(32, 1)),
    )
    optimizer = torch.optim.Adam(network.parameters(), 1e-3, weight_decay=1e-4)
    for _ in range(12):
        for rows in torch.randperm(len(x)).split(64):
            loss = F.binary_cross_entropy_with_logits(network(x[rows]).squeeze(1), y[rows])
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    with torch.no_grad():
        scores = [network(part).squeeze(1).numpy() for part in (agent_clips[~of_agent], human_clips[~of_human])]
    return auc(*scores)


def reaction_times(episodes: list[dict], moves: np.ndarray) -> list[int]:
    """Frames from an apple's appearance to the first change to an action that leads nearer to it.

    Apples that are gone before are left out. `moves` (2, 9) are the directions of the actions.
    """
    times = []
    for episode in episodes:
        apples, ways, actions = *np.split(episode["observations"][:-1, 2:], 2, axis=1), episode["actions"]
        appears = np.flatnonzero((apples[1:] != apples[:-1]).any(1)) + 1
        nearer = (moves[:, actions].T * ways).sum(1) > 0
        turns = np.flatnonzero((actions[1:] != actions[:-1]) & nearer[1:]) + 1
        following = np.append(appears[1:], len(actions))
        first = np.append(turns, len(actions))[np.searchsorted(turns, appears)]
        times += (first - appears)[first < following].tolist()
    return times


def median(values: list[int]) -> float:
    return float(np.median(values)) if values else np.nan


def direction_changes_per_second(episodes: list[dict]) -> float:
    """How often the avatar moves on in another direction; standing still between does not count."""
    changes = 0
    for episode in episodes:
        moving = episode["actions"][episode["actions"] != 4]
        changes += np.count_nonzero(moving[1:] != moving[:-1])
    return changes * FPS / sum(len(episode["actions"]) for episode in episodes)


def likeness_table(method, folder: Path, seeds: list[int], episodes: int) -> str:
    """How well each agent is told from the synthetic human, and two numbers that people named."""
    measures = defaultdict(lambda: defaultdict(list))
    for seed in seeds:
        agents = agents_of(method, folder, seed, episodes)
        for name, played in agents.items():
            if name != HUMAN:
                measures[name]["auc"].append(tell_apart(agents[HUMAN], played, seed))
            measures[name]["score"].append(float(np.mean([episode["rewards"].sum() for episode in played])))
            measures[name]["reaction"].append(median(reaction_times(played, method.MOVES)) / FPS * 1000)
            measures[name]["changes"].append(direction_changes_per_second(played))
    lines = [
        "| agent | seeds | told from the synthetic human, AUC | reaction, ms (median) | direction changes per s | score |",
        "|---|---|---|---|---|---|",
    ]
    for name, values in measures.items():
        told = with_interval(values["auc"], 3) if values["auc"] else ""
        cells = (len(values["score"]), told, with_interval(values["reaction"], 0), with_interval(values["changes"], 1))
        lines.append(f"| {name} | {' | '.join(map(str, cells))} | {with_interval(values['score'], 1)} |")
    return "\n".join(lines) + "\n"


def provenance(rows: list[dict], seeds: list[int]) -> str:
    """What the results rest on."""
    count = len({(row["kind"], row["seed"]) for row in rows})
    hours = sum(row["training_seconds"] for row in rows if row["mode"] == "greedy") / 3600
    scripts = {"dqn_apple": ("teacher",), "distill_hybrid": ("alpha",)}
    return (
        f"`benchmark/apple_alpha.sh`, commits: {made_at(rows, scripts)}; this report at {commit()}. {count} runs, "
        f"{hours:.1f} core-hours of training, seeds {', '.join(map(str, seeds))}; each mean is over {distinct(rows, 'episodes')} episodes, each ± "
        "is a 95% t-interval over seeds. A student is of the epoch with the best test accuracy where no other is named."
        "\n\n"
    )


def main(args: Args) -> None:
    torch.set_num_threads(1)
    rows = read_runs(args.runs)
    if not rows:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    method = load_method("distill_hybrid")
    seeds = sorted({row["seed"] for row in rows})
    quick_human = type("QuickHuman", (method.SyntheticHuman,), QUICK)
    human = scripted_rows(method, lambda seed: method.SyntheticHuman(400, seed), seeds)
    shortest = scripted_rows(method, lambda seed: shortest_path(method), seeds)
    humans = {"": float(np.mean([row["mean"] for row in human]))}
    if any(row["kind"].startswith("quick_") for row in rows):
        quick = scripted_rows(method, lambda seed: quick_human(400, seed), seeds)
        humans["quick_"] = float(np.mean([row["mean"] for row in quick]))
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "runs.csv", rows)
    sections = {
        "Table 2.1": table_2_1(rows, human, shortest),
        "Fig. 2.4": "\n".join(alpha_table(rows, mode) for mode in ACTS),
        "Dip, rise and rule": shape_table(rows, humans),
        "Which network is kept": kept_table(rows),
        "States and split": ablation_table(rows),
        "Human-likeness without people": likeness_table(method, args.runs, seeds, args.likeness_episodes),
    }
    text = (
        provenance(rows, seeds)
        + (f"{args.note}\n\n" if args.note else "")
        + "\n".join(f"## {name}\n\n{table}" for name, table in sections.items())
    )
    (args.out / "table.md").write_text(text)
    figure_2_4(rows, humans).savefig(args.out / "fig_2_4.png", dpi=130)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
