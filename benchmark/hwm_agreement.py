"""Where several world models agree that a segment ends: boundaries by the votes of runs that differ in the seed alone.

    RUNGS=surprise SEEDS="$(seq -s ' ' 11 25)" benchmark/hwm_segment.sh
    python benchmark/hwm_agreement.py     # runs/hwm_segment -> benchmark/results/hwm_segment/agreement_surprise_3.md and a figure
    RUNGS=narrow SEEDS="$(seq -s ' ' 34 63)" benchmark/hwm_segment.sh
    python benchmark/hwm_agreement.py --rung narrow --size 5 --trained 10 --first-seed 34

One model reads once on its way into another room, but at which step around the door differs from seed to seed, and from door to
door, for the bound (Eq. 3.3.5) hardly tells these steps apart. So several models make a committee. Boundaries that people see in
a film are settled in the same way, by the steps at which many of them press the button: a model votes for the steps at which
p(m) reads, each vote counts for the steps beside it too, but less, and a boundary is where the sum is greatest, if it is more than
that of half of the models at one step. Of `--trained` models the `--size` with the least KL_m are taken: those whose p(m), which sees only
the present state, foretells best q(m), which sees the frames that follow.

The vote (`hwm_segment.agree`) was chosen on seeds 1 to 8 of rung (e), `--size` on six other models of rung (g); the committees of
the tables are of other seeds, and have none in common. `hwm_segment.py --attempts 3` trains and measures one committee.
"""

import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.torch
import torch
from common import ROOT, UsageError, commit, commit_of, finished_runs, read_args, read_csv, run_main, write_csv
from hwm_report import FLOORS, IGNORANT, above_floors, best_floors
from intervals import with_interval
from matplotlib.figure import Figure

from cleanrl_thesis import hwm_segment as hwm

MEASURES = {
    "f1_4_rooms_0": "F1, 4 rooms, exact",
    "f1_4_rooms_either": "in or behind the door",
    "f1_4_rooms_1": "± 1 step",
    "f1_8_labels_0": "F1, 8 labels, exact",
    "f1_8_labels_1": "± 1 step",
    "read_rate": "reads",
    "door_entry_recall": "doors found",
    "read_rate_inside_rooms": "reads inside rooms",
}
FARTHEST = 4  # steps from a room's border that the figure shows


@dataclass
class Args:
    runs: Path = Path("runs/hwm_segment")
    """folder of the runs' folders, each with its model (`--save-model`)"""
    rung: str = "surprise"
    """runs RUNG_seedN are taken"""
    size: int = 3
    """models of a committee"""
    trained: int = 3
    """models from which it is chosen"""
    first_seed: int = 11
    """the first committee is chosen from this seed on"""
    out: Path = ROOT / "benchmark" / "results" / "hwm_segment"
    """folder for the table, the committees and the figure"""


def hwm_args(run: Path) -> hwm.Args:
    """The arguments of a run."""
    args = hwm.Args(**read_args(run))
    args.max_grad_norm = float(args.max_grad_norm)  # JSON has no infinity
    args.demos, args.heldout_demos = Path(args.demos), args.heldout_demos and Path(args.heldout_demos)
    return args


def kl_m(run: Path) -> float:
    """KL[q(m) ‖ p(m)] per step in training, the mean over the last fifth of it."""
    values = [float(row["losses/kl_m"]) for row in read_csv(run / "updates.csv")]
    return float(np.mean(values[-max(1, len(values) // 5) :]))


def segment(run: Path) -> tuple[list[np.ndarray], list[hwm.Episode]]:
    """What the model of a run finds in the held-out episodes, m from p (section 3.5.1), and these."""
    args = hwm_args(run)
    episodes, _ = hwm.read_split(args)
    parameters = safetensors.torch.load_file(run / "model.safetensors")
    num_actions = max(int(episode.actions.max()) for episode in episodes.training) + 1
    model = hwm.HWM(args, parameters["frame_mean"].numpy(), num_actions)
    model.load_state_dict(parameters)
    return hwm.segment(model, episodes.heldout, "prior", torch.device("cpu")).found, episodes.heldout


def offsets(found: list[np.ndarray], rooms: list[np.ndarray]) -> np.ndarray:
    """Boundaries at each of -FARTHEST to FARTHEST steps from the step with which a room is left, per crossing."""
    counts, crossings = np.zeros(2 * FARTHEST + 1), 0
    for made, each in zip(found, rooms):
        merged = hwm.merge_doors(each)
        for t in np.flatnonzero(merged[1:] != merged[:-1]):
            near = np.flatnonzero(made) - t
            counts += np.bincount(near[abs(near) <= FARTHEST] + FARTHEST, minlength=len(counts))
            crossings += 1
    return counts / crossings


def score(name: str, seeds: list[int], found: list[np.ndarray], episodes: list[hwm.Episode]) -> dict:
    """A row of the table: the measures, and the best that a segmentation has which knows nothing."""
    rooms, states = [each.rooms for each in episodes], [each.states for each in episodes]
    made = hwm.boundary_scores(found, rooms)
    floors = hwm.floors(rooms, states, made["read_rate"], np.random.default_rng(0))
    best = {
        key: max(floor[key] for title, floor in floors.items() if re.fullmatch(IGNORANT, title))
        for key in MEASURES
        if key.startswith("f1")
    }
    row = {"boundaries": name, "seeds": " ".join(map(str, seeds)), **{key: made[key] for key in MEASURES}}
    row |= {f"best_floor_{key}": value for key, value in best.items()}
    return row | {f"at_{i - FARTHEST:+d}": value for i, value in enumerate(offsets(found, rooms))}


def table(rows: list[dict]) -> list[str]:
    """Models and committees, means with 95% t-intervals, and the best floor."""
    titles = *MEASURES.values(), *FLOORS
    lines = [f"| boundaries | of | {' | '.join(titles)} |", "|" + "---|" * (len(titles) + 2)]
    for name in dict.fromkeys(row["boundaries"] for row in rows):
        group = [row for row in rows if row["boundaries"] == name]
        cells = [with_interval([row[key] for row in group]) for key in MEASURES] + above_floors(group)
        lines.append(f"| {name} | {len(group)} | {' | '.join(cells)} |")
    return [
        *lines,
        f"| best of those that know nothing | | {' | '.join(best_floors(rows, MEASURES))} |{' |' * len(FLOORS)}",
    ]


def draw(rows: list[dict], path: Path) -> None:
    """Where boundaries are, by steps from the step with which a room is left: one line for each model and committee."""
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    names = list(dict.fromkeys(row["boundaries"] for row in rows))
    for name, axis in zip(names, figure.subplots(1, len(names), sharey=True)):
        for row in rows:
            if row["boundaries"] == name:
                x = range(-FARTHEST, FARTHEST + 1)
                axis.plot(x, [row[f"at_{i:+d}"] for i in x], marker="o", markersize=3, alpha=0.6)
        axis.axvspan(-1, 1, color="0.9", zorder=0)
        axis.set(title=name, xlabel="steps after the room is left", xticks=range(-FARTHEST, FARTHEST + 1))
    figure.axes[0].set_ylabel("boundaries per crossing")
    figure.savefig(path, dpi=120)


def main(args: Args) -> None:
    """Measure each model and each committee, and write table, rows and figure."""
    if args.size > args.trained:
        raise UsageError(f"--size {args.size}: must be at most --trained {args.trained}")
    runs = {
        result["seed"]: run
        for run, result in finished_runs(args.runs)
        if run.name == f"{args.rung}_seed{result['seed']}"
    }
    seeds = sorted(seed for seed in runs if seed >= args.first_seed)
    groups = [seeds[i : i + args.trained] for i in range(0, len(seeds) - args.trained + 1, args.trained)]
    if not groups:
        found = f"has {len(seeds)} finished runs {args.rung}_seedN from --first-seed {args.first_seed} on"
        raise UsageError(f"--runs {args.runs}: {found}, --trained {args.trained} are needed")
    rows, committees = [], []
    for group in groups:
        parts = {seed: segment(runs[seed]) for seed in group}
        episodes = parts[group[0]][1]
        kls = {seed: kl_m(runs[seed]) for seed in group}
        rows += [{**score("one model", [seed], parts[seed][0], episodes), "kl_m": kls[seed]} for seed in group]
        chosen = sorted(sorted(group, key=kls.get)[: args.size])
        agreed = [hwm.agree(np.stack(votes)) for votes in zip(*(parts[seed][0] for seed in chosen))]
        name = f"most of {args.size} models" + ("" if args.size == args.trained else f" of {args.trained}")
        committees.append({**score(name, chosen, agreed, episodes), "kl_m": np.mean([kls[seed] for seed in chosen])})
    rows += committees
    results = [json.loads((runs[seed] / "result.json").read_text()) for group in groups for seed in group]
    scripts = sorted({commit_of("hwm_segment", result["script_sha256"]) for result in results})
    hours = sum(result["training_seconds"] for result in results) / 3600
    flags = f"--rung {args.rung} --size {args.size} --trained {args.trained} --first-seed {args.first_seed}"
    text = [
        f"`python benchmark/hwm_agreement.py {flags}` at {commit()}, runs of hwm_segment.py at {', '.join(scripts)}: ",
        "",
    ]
    text[0] += f"{len(results)} runs {args.rung}, {hours:.1f} core-hours, one thread each."
    text += table(rows)
    args.out.mkdir(parents=True, exist_ok=True)
    name = f"agreement_{args.rung}_{args.size}" + ("" if args.size == args.trained else f"_of_{args.trained}")
    (args.out / f"{name}.md").write_text("\n".join(text) + "\n")
    write_csv(args.out / f"{name}.csv", rows)
    draw(rows, args.out / f"{name}.png")
    print("\n".join(text))


if __name__ == "__main__":
    torch.set_num_threads(1)
    run_main(main, Args, __doc__)
