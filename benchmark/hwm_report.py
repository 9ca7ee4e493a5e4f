"""The world model alone: runs of benchmark/hwm_segment.sh -> one table of the rungs beside segmentations that know nothing.

    python benchmark/hwm_report.py        # runs/hwm_segment -> benchmark/results/hwm_segment
    python benchmark/hwm_report.py --known benchmark/results/hwm_segment   # with the runs of an earlier report, whose folders are gone

Takes whatever part of the runs is done. Means over seeds, with 95% t-intervals where there are several.
"""

import json
import math
import re
import shutil
from collections import defaultdict
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, UsageError, commit, commit_of, finished_runs, read_csv, run_main, write_csv
from intervals import with_interval

RUNGS = {
    "faithful": "(a) Eq. 3.3.1 to 3.3.7",
    "literal": "(a) all weights 1, nothing forced",
    "kl_w": "(b) KL_w ten times",
    "reset": "(c) w reset where z is read",
    "price": "(d) a price for each read",
    "narrow": "(e) narrow w, reset, budget",
    "no_budget": "(e) without the budget",
    "wander": "(f) trained on a player who wanders",
    "surprise": "(g) reads drawn to where z is foretold",
}
MEASURES = {
    "f1_8_labels_0": "F1, 8 labels, exact",
    "f1_8_labels_1": "± 1 step",
    "f1_4_rooms_0": "F1, 4 rooms, exact",
    "f1_4_rooms_either": "in or behind the door",
    "f1_4_rooms_1": "± 1 step",
    "read_rate": "reads",
    "door_entry_recall": "doors found",
    "read_rate_inside_rooms": "reads inside rooms",
    "area_under_curve_8_labels": "AUC",
    "mutual_information_z_room": "z's clusters and rooms",
    "reconstruction_mse": "MSE",
}
FLOORS = {  # measures of 4 rooms that are to be above those of all that know nothing
    "above floors: ± 1 step": ("f1_4_rooms_1",),
    "± 1 step, and in or behind the door": ("f1_4_rooms_1", "f1_4_rooms_either"),
    "± 1 step, and exact": ("f1_4_rooms_1", "f1_4_rooms_0"),
}
IGNORANT = r"always|never|coin.*|every .*"  # floors; "at each door" knows the doors


@dataclass
class Args:
    runs: Path = Path("runs/hwm_segment")
    """folder of the runs' folders"""
    out: Path = ROOT / "benchmark" / "results" / "hwm_segment"
    """folder for the table, the runs and the figures"""
    known: Path | None = None
    """folder of an earlier report, whose runs go on in this one"""


def read_runs(folder: Path) -> list[dict]:
    """One row for each finished run: rung, seed, how m was found, and its measures."""
    rows = []
    for run, result in finished_runs(folder):
        segmentation = json.loads((run / "segmentation.json").read_text())
        best = {
            key: max(floor[key] for name, floor in segmentation["floors"].items() if re.fullmatch(IGNORANT, name))
            for key in MEASURES
            if key.startswith(("f1", "area"))
        }
        best["reconstruction_mse"] = segmentation["mse_of_the_mean_frame"]
        about = {"rung": re.sub(r"_seed\d+$", "", run.name), "seed": result["seed"], "run": run.name}
        about |= {"script_sha256": result["script_sha256"], "training_seconds": result["training_seconds"]}
        for mode in ("prior", "sampled", "posterior"):
            made = segmentation[mode]
            row = {**about, "m": mode, **{key: made[key] for key in MEASURES}}
            row |= {f"{what}_from_{level}": value[level] for what, value in made["probes"].items() for level in "zw"}
            row |= {f"most_frequent_{what}": value["most frequent"] for what, value in made["probes"].items()}
            best["mutual_information_z_room"] = made["mutual_information_by_chance"]
            rows.append(row | {f"best_floor_{key}": value for key, value in best.items()})
    return rows


def read_known(folder: Path, rows: list[dict]) -> list[dict]:
    """The rows of an earlier report whose runs are not among `rows`. Raises UsageError where there is none to read."""
    try:
        known = read_csv(folder / "runs.csv")
    except OSError as error:
        raise UsageError(f"--known {folder}: runs.csv cannot be read: {error.strerror}") from None
    runs, words = {row["run"] for row in rows}, {"rung", "run", "script_sha256", "m"}
    return [
        {key: value if key in words else float(value or "nan") for key, value in row.items()}
        | {"seed": int(row["seed"])}
        for row in known
        if row["run"] not in runs
    ]


def mean_of_measured(rows: list[dict], key: str) -> str:
    """The mean over the rows that have a measure; nothing where none has it."""
    measured = [row[key] for row in rows if not math.isnan(row.get(key, math.nan))]
    return f"{np.mean(measured):.{5 if key.endswith('mse') else 2}f}" if measured else ""


def best_floors(rows: list[dict], measures: Iterable[str]) -> list[str]:
    """The mean of each measure's best floor, over the rows that have it."""
    return [mean_of_measured(rows, f"best_floor_{key}") for key in measures]


def above_floors(rows: list[dict]) -> list[str]:
    """How many rows are above the floors of each set of measures; nothing where one was not measured (nan)."""
    counts = []
    for keys in FLOORS.values():
        measured = not any(math.isnan(row[key]) for row in rows for key in keys)
        above = sum(all(row[key] > row[f"best_floor_{key}"] for key in keys) for row in rows)
        counts.append(f"{above} of {len(rows)}" if measured else "")
    return counts


def rung_table(rows: list[dict]) -> list[str]:
    """The rungs, m from p and from q, with the best floor of the same episodes below."""
    titles = *MEASURES.values(), *FLOORS
    lines = [f"| rung | m from | seeds | {' | '.join(titles)} | minutes |", "|" + "---|" * (len(titles) + 4)]
    groups = defaultdict(list)
    for row in rows:
        groups[row["rung"], row["m"]].append(row)
    modes = {"prior": "p", "sampled": "p, drawn", "posterior": "q"}
    for rung, title in RUNGS.items():
        for mode, m in modes.items():
            group = groups[rung, mode]
            if not group:
                continue
            cells = [with_interval([row[key] for row in group]) for key in MEASURES if key != "reconstruction_mse"]
            cells.append(mean_of_measured(group, "reconstruction_mse"))
            minutes = np.mean([row["training_seconds"] for row in group]) / 60
            cells += [*above_floors(group), f"{minutes:.1f}"]
            lines.append(f"| {title} | {m} | {len(group)} | {' | '.join(cells)} |")
    ends = " |" * (len(FLOORS) + 1)
    return [*lines, f"| best of those that know nothing | | | {' | '.join(best_floors(rows, MEASURES))} |{ends}"]


def probe_table(rows: list[dict]) -> list[str]:
    """What a linear probe reads from z and from w, m from p."""
    kinds = ("room", "cell", "direction", "goal")
    lines = [f"| rung | {' | '.join(f'{kind}: z, w' for kind in kinds)} |", "|" + "---|" * (len(kinds) + 1)]
    for rung, title in RUNGS.items():
        group = [row for row in rows if row["rung"] == rung and row["m"] == "prior"]
        if group:
            pairs = [[np.mean([row[f"{kind}_from_{level}"] for row in group]) for level in "zw"] for kind in kinds]
            lines.append(f"| {title} | {' | '.join(f'{z:.2f}, {w:.2f}' for z, w in pairs)} |")
    floors = [mean_of_measured(rows, f"most_frequent_{kind}") for kind in kinds]
    return [*lines, f"| the most frequent one | {' | '.join(floors)} |"]


def write_report(rows: list[dict], runs: Path, out: Path) -> None:
    """Write table, runs and the figure of each rung's first seed."""
    out.mkdir(parents=True, exist_ok=True)
    write_csv(out / "runs.csv", rows)
    scripts = sorted({commit_of("hwm_segment", row["script_sha256"]) for row in rows})
    hours = sum(row["training_seconds"] for row in rows) / 3 / 3600
    text = [f"`benchmark/hwm_segment.sh`, hwm_segment.py at {', '.join(scripts)}; this report at {commit()}. "]
    text[0] += f"{len(rows) // 3} runs, {hours:.1f} core-hours, one thread each."
    text += ["", "## Boundaries on held-out episodes", "", *rung_table(rows)]
    text += ["", "## Accuracy of linear probes, m from p", "", *probe_table(rows)]
    (out / "table.md").write_text("\n".join(text) + "\n")
    for rung in RUNGS:
        first = min((row for row in rows if row["rung"] == rung), key=lambda row: row["seed"], default=None)
        if first and (runs / first["run"]).exists():
            shutil.copy(runs / first["run"] / "figure_3_4.png", out / f"figure_3_4_{rung}.png")
    print("\n".join(text))


def main(args: Args) -> None:
    found = read_runs(args.runs)
    if args.known is not None:
        found = read_known(args.known, found) + found
    columns = dict.fromkeys(key for row in found for key in row)
    found = [{key: row.get(key, math.nan) for key in columns} for row in found]
    if not found:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    write_report(found, args.runs, args.out)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
