"""The driving runs -> Table 2.3, Fig. 2.8, and how each driver drives.

    python benchmark/torcs_report.py        # runs/torcs -> benchmark/results/torcs

Takes whatever part of the runs of `benchmark/torcs_alpha.sh` is done, and says which. The score is that of Table 2.3:
metres in windows of 5 s times 3.6 as the mean of each episode, 0 for the window with a crash or standstill, behind which
there are none. Intervals are 95% t-intervals of the seeds' means; a seed has its own human and student, but all students
have the same DDPG expert.
"""

import json
import re
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from apple_report import representative_alpha
from common import (
    ROOT,
    UsageError,
    commit,
    finished_runs,
    kind_of,
    made_at,
    published_table,
    read_args,
    run_main,
    select,
    write_csv,
)
from intervals import interval, with_interval
from matplotlib.figure import Figure

from cleanrl_thesis import gail_hybrid as gail

MODES = ("sampled", "greedy")
EXPERTS = {"expert": "DDPG", "human": "human"}  # folders whose demonstrations are what the students learned from
BEFORE = 60.0  # m before a curve, where its braking is measured from
NEAR = 50.0  # m, of the way along the road
TREMBLE = 0.05  # a turn of the wheel by less of its lock is not counted as a change


@dataclass
class Args:
    runs: Path = Path("runs/torcs")
    """folder of the runs' folders"""
    expert: int = 1
    """seed of the expert that the students learned from"""
    out: Path = ROOT / "benchmark" / "results" / "torcs"
    """folder for tables and figures"""
    note: str = ""
    """a sentence put above the tables, on what the runs do not record themselves"""


def read_runs(folder: Path, expert: int) -> list[dict]:
    """A row for every finished run and way to act, and for all demonstrations; experts but one are of kind `other`."""
    rows = []
    for path, result in finished_runs(folder):
        args, is_student = read_args(path), "greedy" in result["evaluation"]
        evaluations = result["evaluation"] if is_student else {"evaluation": result["evaluation"]}
        run = {"alpha": args.get("alpha", ""), "steps": result["global_step"]}
        run |= {"training_seconds": round(result["training_seconds"]), "script_sha256": result["script_sha256"][:12]}
        rows += [run_row(path, mode, numbers["driving"], run) for mode, numbers in evaluations.items()]
    for path in sorted(folder.glob("*_seed*/manifest.json")) + sorted(folder.glob("expert_seed*/demos/manifest.json")):
        run = path.parent.parent if path.parent.name == "demos" else path.parent
        if run == path.parent or is_complete(run):
            track = gail.Track(*gail.TRACKS[json.loads(path.read_text())["options"]["track"]])
            driving = gail.driving_scores(read_episodes(path.parent, 10_000), track.length)
            rows.append(run_row(run, "demonstrations", driving, {}))
    for row in rows:
        if row["kind"] == "expert" and row["seed"] != expert:
            row["kind"] = "other"
    return rows


def is_complete(folder: Path) -> bool:
    """Whether a run has come to its end, and not been stopped on the way."""
    path = folder / "result.json"
    return path.exists() and json.loads(path.read_text())["complete"]


def run_row(folder: Path, mode: str, driving: dict, run: dict) -> dict:
    """What is kept of a run's scores; `run` is empty for demonstrations."""
    name, seed = folder.name.rsplit("_seed", 1)
    return {
        "kind": kind_of(folder) if run else name,
        "seed": int(seed),
        "alpha": run.get("alpha", ""),
        "mode": mode,
        "episodes": len(driving["laps"]),
        **{key: round(driving["score"][key], 2) for key in ("mean", "std", "min", "max")},
        "metres_in_5_s": round(driving["metres_in_5_s"]["mean"], 2),
        "crashes": driving["crashes"],
        "standstills": driving["standstills"],
        "mean_laps": round(float(np.mean(driving["laps"])), 3),
        "steps": run.get("steps", ""),
        "training_seconds": run.get("training_seconds", 0),
        "script_sha256": run.get("script_sha256", ""),
    }


def mean_score(rows: list[dict], kind: str, mode: str = "demonstrations") -> float:
    """Of all seeds; nan where there is none."""
    return float(np.mean([row["mean"] for row in select(rows, kind, mode)] or [np.nan]))


def pooled_std(rows: list[dict]) -> float:
    """Deviation of all episodes of all seeds, of which each has as many."""
    means, stds = (np.array([row[key] for row in rows]) for key in ("mean", "std"))
    return float(np.sqrt(np.mean(stds**2) + np.var(means)))


def table_2_3(rows: list[dict]) -> str:
    """Table 2.3, published beside measured."""
    published = published_table("table_2_3.csv")
    columns = ["driver", "acts", "seeds", "episodes", "max", "min", "avg", "std of all", "of DDPG's", "of the human's"]
    columns += ["m in 5 s", "ended early", "laps in 60 s"]
    lines = [f"| {' | '.join(columns)} |", "|" + "---|" * len(columns)]
    theirs = [float(published[name]["avg"]) for name in ("DDPG", "human")]
    ours = [mean_score(rows, kind) for kind in ("expert", "human")]
    groups = {
        "DDPG": [("demonstrations", "expert"), ("evaluation", "expert")],
        "other DDPG experts": [("evaluation", "other")],
        "hybrid, α = 0.5": [(mode, "alpha0.5") for mode in MODES],
        "without the discriminator's penalty": [(mode, "penalty0_alpha0.5") for mode in MODES],
        "without cloning first": [(mode, "bc0_alpha0.5") for mode in MODES],
        "with a constant KL bound": [(mode, "noanneal_alpha0.5") for mode in MODES],
        "Fisher matrix of the whole batch": [(mode, "fisher1_alpha0.5") for mode in MODES],
        "human": [("demonstrations", "human")],
        "GAIL, α = 0": [(mode, "alpha0.0") for mode in MODES],
        "GAIL on DDPG, α = 1": [(mode, "alpha1.0") for mode in MODES],
        "actions mixed, α = 0.5": [(mode, "mix_alpha0.5") for mode in MODES],
        "actions cloned, α = 0": [(mode, "mix_alpha0.0") for mode in MODES],
        "actions cloned, α = 1": [(mode, "mix_alpha1.0") for mode in MODES],
    }
    for name, group in groups.items():
        if name in published:
            cells = [published[name][key] for key in ("max", "min", "avg", "std")]
            cells += [f"{float(published[name]['avg']) / other:.2f}" for other in theirs]
            lines.append(f"| {name} | **published** | | | {' | '.join(cells)} | | | |")
        for mode, kind in group:
            found = select(rows, kind, mode)
            if found:
                episodes = sum(row["episodes"] for row in found)
                cells = [name, mode, str(len(found)), str(episodes)]
                cells += [f"{max(row['max'] for row in found):.0f}", f"{min(row['min'] for row in found):.0f}"]
                cells += [with_interval([row["mean"] for row in found], 1), f"{pooled_std(found):.1f}"]
                cells += [f"{mean_score(rows, kind, mode) / other:.2f}" for other in ours]
                cells += [f"{np.mean([row['metres_in_5_s'] for row in found]):.0f}"]
                cells += [f"{100 * sum(row['crashes'] + row['standstills'] for row in found) / episodes:.0f}%"]
                cells += [f"{np.mean([row['mean_laps'] for row in found]):.2f}"]
                lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def difference(rows: list[dict], kind: str, mode: str, other: str, other_mode: str) -> tuple[str, int]:
    """How much higher a driver scores than another, seed by seed, with its interval; and the number of seeds of both."""
    ours, theirs = (
        {row["seed"]: row["mean"] for row in select(rows, *pair)} for pair in ((kind, mode), (other, other_mode))
    )
    both = sorted(ours.keys() & theirs.keys())
    return with_interval([ours[seed] - theirs[seed] for seed in both], 1) if both else "", len(both)


def differences_table(rows: list[dict]) -> str:
    """The comparisons that section 2.4.3 makes, and that with the mixture of section 2.3.2."""
    lines = ["| | published | sampled | greedy | seeds |", "|---|---|---|---|---|"]
    published = {name: float(row["avg"]) for name, row in published_table("table_2_3.csv").items()}
    scale = mean_score(rows, "expert") / published["DDPG"]
    names = {"human": "human", "alpha0.0": "GAIL, α = 0", "mix_alpha0.5": "actions mixed, α = 0.5"}
    pairs = [("alpha0.5", "human"), ("alpha0.5", "alpha0.0"), ("alpha0.0", "human"), ("alpha0.5", "mix_alpha0.5")]
    for kind, other in pairs:
        found = [difference(rows, kind, m, other, "demonstrations" if other == "human" else m) for m in MODES]
        ours, theirs = ("hybrid, α = 0.5" if kind == "alpha0.5" else names[kind]), names[other]
        old = f"{(published[ours] - published[theirs]) * scale:+.0f}" if theirs in published else ""
        lines.append(f"| {ours}, less {theirs} | {old} | {found[0][0]} | {found[1][0]} | {found[0][1]} |")
    return "\n".join(lines) + f"\n\nPublished differences times {scale:.2f}, as the DDPG experts are to each other.\n"


def alpha_curve(rows: list[dict], mode: str) -> dict[float, list[float]]:
    """The score of each seed for each α."""
    curve = defaultdict(list)
    for row in rows:
        if re.fullmatch(r"alpha[\d.]+", row["kind"]) and row["mode"] == mode:
            curve[row["alpha"]].append(row["mean"])
    return dict(sorted(curve.items()))


def alpha_table(rows: list[dict]) -> str:
    """Fig. 2.8 in numbers, in brackets the number of seeds, and the α that the thesis' rule picks."""
    curves = {mode: alpha_curve(rows, mode) for mode in MODES}
    lines = [f"| α | {' | '.join(MODES)} |", "|---|---|---|"]
    for alpha in curves["sampled"]:
        cells = [f"{with_interval(curves[mode][alpha], 1)} ({len(curves[mode][alpha])})" for mode in MODES]
        lines.append(f"| {alpha} | {' | '.join(cells)} |")
    human = mean_score(rows, "human")
    by_seed = [{alpha: dict(enumerate(scores)) for alpha, scores in curves[mode].items()} for mode in MODES]
    picked = [representative_alpha(curve, human) for curve in by_seed]
    lines.append(f"| rule picks | {' | '.join('none' if alpha is None else str(alpha) for alpha in picked)} |")
    return "\n".join(lines) + "\n"


def figure_2_8(rows: list[dict]) -> Figure:
    """Score over α, with the published ones scaled as their DDPG is to ours."""
    figure = Figure(figsize=(7.5, 4.2), layout="constrained")
    axes = figure.subplots()
    expert, human = mean_score(rows, "expert"), mean_score(rows, "human")
    for mode, colour in zip(MODES, ("tab:blue", "tab:orange")):
        curve = alpha_curve(rows, mode)
        means, halves = np.array([interval(scores) for scores in curve.values()]).T
        axes.plot(list(curve), means, "o-", color=colour, markersize=4, label=f"hybrid, {mode}")
        low, high = means - np.nan_to_num(halves), means + np.nan_to_num(halves)
        axes.fill_between(list(curve), low, high, color=colour, alpha=0.15, linewidth=0)
        mixed = {row["alpha"]: row for row in rows if row["kind"].startswith("mix_alpha") and row["mode"] == mode}
        points = {alpha: [r["mean"] for r in select(rows, row["kind"], mode)] for alpha, row in sorted(mixed.items())}
        if points:
            heights = [np.mean(scores) for scores in points.values()]
            axes.plot(list(points), heights, "x", color=colour, label=f"actions mixed by cloning, {mode}")
    axes.axhline(expert, color="black", linestyle="--", linewidth=1, label=f"DDPG, {expert:.0f}")
    axes.axhline(human, color="black", linestyle=":", linewidth=1, label=f"synthetic human, {human:.0f}")
    published = {name: float(row["avg"]) for name, row in published_table("table_2_3.csv").items()}
    scale = expert / published["DDPG"]
    stars = {0.0: published["GAIL, α = 0"] * scale, 0.5: published["hybrid, α = 0.5"] * scale}
    axes.plot(list(stars), list(stars.values()), "k*", markersize=9, label=f"published (times {scale:.2f})")
    axes.set(xlabel="α, weight of the DDPG expert", ylabel="score, (km/h) s", ylim=(0, None))
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(fontsize="small", loc="center left", bbox_to_anchor=(1, 0.5))
    seeds = sorted({len(scores) for scores in alpha_curve(rows, "sampled").values()})
    axes.set_title(f"Fig. 2.8: {' to '.join(map(str, sorted({seeds[0], seeds[-1]})))} seeds, bands are 95% intervals")
    return figure


# ---------------------------------------------------------------------------------------------------------------------
# How they drive
# ---------------------------------------------------------------------------------------------------------------------
def read_episodes(folder: Path, most: int) -> list[dict[str, np.ndarray]]:
    """The first demonstrations that a folder's manifest names; none where there is no manifest, or not yet."""
    path, episodes = folder / "manifest.json", []
    names = sorted(json.loads(path.read_text())["files"]) if path.exists() else []
    for name in names[:most]:
        with np.load(folder / name, allow_pickle=False) as arrays:
            episodes.append(dict(arrays))
    return episodes


def traces(episode: dict[str, np.ndarray], track) -> dict[str, np.ndarray]:
    """What an episode's car did after each step, (T,): m raced since the start line, m left, km/h, wheel."""
    progress = np.where(episode["rewards"] == -1, 0, episode["rewards"])
    obs = episode["observations"][1:]
    left = obs[:, 20] * track.half_width
    return {
        "place": gail.START + np.cumsum(progress),
        "left": left,
        "speed": obs[:, 21] * 300,
        "wheel": episode["actions"][:, 0].clip(-1, 1),
    }


def crossings(place: np.ndarray, marks: np.ndarray, length: float) -> list[tuple[int, int]]:
    """(number of the mark, first step beyond it) for each time that a mark of the road is passed."""
    laps = np.arange(int(place[-1] // length) + 1)
    goals = (marks[:, None] + laps * length).ravel()
    numbers = np.repeat(np.arange(len(marks)), len(laps))
    is_passed = (goals > place[0]) & (goals <= place[-1])
    return list(zip(numbers[is_passed].tolist(), np.searchsorted(place, goals[is_passed]).tolist()))


def wheel_changes(wheel: np.ndarray) -> int:
    """How often the wheel begins to turn the other way, by more than TREMBLE of its lock."""
    changes, extreme, direction = 0, wheel[0], 0
    for angle in wheel:
        if direction * (angle - extreme) > 0:
            extreme = angle
        elif abs(angle - extreme) > TREMBLE:
            changes += direction != 0
            direction, extreme = (1 if angle > extreme else -1), angle
    return changes


def habits(episodes: list[dict[str, np.ndarray]], track) -> dict[str, float]:
    """What participants named, as numbers."""
    parked, parked_left = np.array(gail.PARKED, float), np.array(gail.PARKED_LEFT) * track.half_width
    curves = track.distances[(track.curvatures != 0) & (np.roll(track.curvatures, 1) != track.curvatures)]
    found = defaultdict(list)
    steps = sum(len(episode["rewards"]) for episode in episodes)
    changes, crashes, into_cars, near_each = 0, 0, 0, np.zeros(len(parked), int)
    for episode in episodes:
        trace = traces(episode, track)
        place, speed = trace["place"], trace["speed"]
        changes += wheel_changes(trace["wheel"])
        found["speed"] += speed.tolist()
        for _, step in crossings(place, curves, track.length):
            before = np.searchsorted(place, place[step] - BEFORE)
            if before:
                found["into curves"].append(speed[step])
                found["slowing"].append(speed[before] - speed[step])
        for number, step in crossings(place, parked, track.length):
            way = trace["left"][step] - parked_left[number]
            found["gap"].append(abs(way) - gail.CAR_WIDTH)
            found[f"left of {number}"].append(way > 0)
        if (episode["rewards"] == -1).any():
            crashes += 1
            ways = np.abs((parked - place[-1] + track.length / 2) % track.length - track.length / 2)
            near_each[ways.argmin()] += ways.min() < NEAR
            into_cars += bool(abs(trace["left"][-1]) <= track.half_width and ways.min() < gail.CAR_LENGTH + 1)
    means = {name: float(np.mean(values)) for name, values in found.items()}
    return {
        **means,
        "changes": changes * gail.FPS / steps,
        "episodes": len(episodes),
        "crashes": crashes,
        "into cars": into_cars,
        "near cars": near_each.sum(),
        **{f"near {number}": count for number, count in enumerate(near_each)},
    }


def drivers(folder: Path, expert: int, most: int) -> dict[str, list[list[dict[str, np.ndarray]]]]:
    """Demonstrations of each driver, a list for each finished run that has some."""
    found = {name: [] for name in EXPERTS.values()}
    for run in sorted(path for path in folder.glob("*_seed*") if path.is_dir()):
        kind, seed = run.name.rsplit("_seed", 1)
        if kind == "expert" and int(seed) != expert:
            continue
        if kind == "human" or is_complete(run):
            kind = kind if kind == "human" else kind_of(run)
            episodes = read_episodes(run if kind == "human" else run / "demos", most)
            found.setdefault(EXPERTS.get(kind, kind), []).extend([episodes] if episodes else [])
    return {name: seeds for name, seeds in found.items() if seeds}


def paths_figure(found: dict[str, list[list[dict[str, np.ndarray]]]], track, episodes: int = 6) -> Figure:
    """The first lap of some episodes of each driver's first seed, with the road unrolled; crosses are crashes."""
    names = {"DDPG": "DDPG", "human": "synthetic human", "alpha0.0": "GAIL, α = 0", "alpha0.5": "hybrid, α = 0.5"}
    names |= {"mix_alpha0.5": "actions mixed, α = 0.5"}
    shown = [name for name in names if name in found]
    figure = Figure(figsize=(11, 1 + 1.3 * len(shown)), layout="constrained")
    for axes, name in zip(figure.subplots(len(shown), sharex=True, squeeze=False)[:, 0], shown):
        for begin, length in zip(track.distances[track.curvatures != 0], track.lengths[track.curvatures != 0]):
            axes.axvspan(begin, begin + length, color="0.93", linewidth=0)
        for episode in found[name][0][:episodes]:
            trace = traces(episode, track)
            steps = np.searchsorted(trace["place"], track.length)
            axes.plot(trace["place"][:steps], trace["left"][:steps], color="tab:blue", linewidth=0.8)
            if (episode["rewards"] == -1).any() and steps == len(trace["place"]):
                axes.plot(trace["place"][-1], trace["left"][-1], "x", color="tab:red", clip_on=False, zorder=3)
        parked = gail.PARKED, np.array(gail.PARKED_LEFT) * track.half_width
        axes.plot(*parked, "s", color="black", markersize=4)
        axes.set(xlim=(gail.START - 10, track.length), ylim=(-track.half_width, track.half_width), ylabel="left, m")
        axes.set_title(names[name], fontsize="medium", loc="left")
    axes.set_xlabel("way from the start line, m; curves are grey, parked cars black")
    return figure


def habit_tables(found: dict[str, list[list[dict[str, np.ndarray]]]], track) -> str:
    """How each driver drives; and on which side of each parked car."""
    measured = {name: [habits(part, track) for part in seeds] for name, seeds in found.items()}
    columns = {
        "speed": "km/h",
        "into curves": "into curves, km/h",
        "slowing": f"slowed down {BEFORE:.0f} m before them by, km/h",
        "gap": "gap to parked cars, m",
        "changes": "wheel turned back, per s",
    }
    lines = [
        f"| driver | seeds | {' | '.join(columns.values())} | episodes | crashes | within {NEAR:.0f} m of a parked car | into one |",
        "|---|" + "---|" * 10,
    ]
    for name, seeds in measured.items():
        cells = [with_interval([habit[key] for habit in seeds if key in habit], 1) for key in columns]
        sums = [sum(habit[key] for habit in seeds) for key in ("episodes", "crashes", "near cars", "into cars")]
        lines.append(f"| {name} | {len(seeds)} | {' | '.join(map(str, [*cells, *sums]))} |")
    head = [f"| driver | {' | '.join(f'{way} m' for way in gail.PARKED)} |", "|---|" + "---|" * len(gail.PARKED)]
    lines += ["", "Share of passes on the left of each parked car, by its way from the start line:", "", *head]
    for name, seeds in measured.items():
        sides = [[habit[f"left of {i}"] for habit in seeds if f"left of {i}" in habit] for i in range(len(gail.PARKED))]
        lines.append(f"| {name} | {' | '.join(f'{np.mean(side):.2f}' if side else '' for side in sides)} |")
    lines += ["", f"Crashes within {NEAR:.0f} m of each, in the same episodes:", "", *head]
    for name, seeds in measured.items():
        counts = [str(sum(habit[f"near {i}"] for habit in seeds)) for i in range(len(gail.PARKED))]
        lines.append(f"| {name} | {' | '.join(counts)} |")
    return "\n".join(lines) + "\n"


def provenance(rows: list[dict]) -> str:
    """What the results rest on."""
    own = [row for row in rows if row["mode"] in ("greedy", "evaluation")]
    hours = sum(row["training_seconds"] for row in own) / 3600
    scripts = {"ddpg_torcs_like": ("expert", "other"), "gail_hybrid": ("alpha",)}
    seeds = ", ".join(map(str, sorted({row["seed"] for row in own})))
    return (
        f"`benchmark/torcs_alpha.sh`, commits: {made_at(own, scripts)}; this report at {commit()}. {len(own)} runs, "
        f"{hours:.1f} core-hours of training, seeds {seeds}; each ± is a 95% t-interval over seeds.\n\n"
    )


def main(args: Args) -> None:
    rows = read_runs(args.runs, args.expert)
    if not rows:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    if not select(rows, "expert", "demonstrations"):
        raise UsageError(
            f"--expert {args.expert}: {args.runs} holds no finished run of that expert with demonstrations"
        )
    track, found = gail.Track(*gail.TRACKS["meadow"]), drivers(args.runs, args.expert, 20)
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "runs.csv", rows)
    sections = {
        "Table 2.3": table_2_3(rows),
        "Differences, seed by seed": differences_table(rows),
        "Fig. 2.8": alpha_table(rows),
        "How they drive (sampled students)": habit_tables(found, track),
    }
    text = (
        provenance(rows)
        + (f"{args.note}\n\n" if args.note else "")
        + "\n".join(f"## {name}\n\n{table}" for name, table in sections.items())
    )
    (args.out / "table.md").write_text(text)
    paths_figure(found, track).savefig(args.out / "paths.png", dpi=110)
    if alpha_curve(rows, "sampled"):
        figure_2_8(rows).savefig(args.out / "fig_2_8.png", dpi=130)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
