"""PPO in FourRooms: runs -> one table of their returns beside the shortest paths from the same starts.

for seed in 1 2 3; do
  python cleanrl_thesis/ppo_fourrooms.py --bf16 --seed $seed --save-model --run-dir runs/fourrooms/11_seed$seed --resume
  python cleanrl_thesis/ppo_fourrooms.py --env-id FourRooms19-v0 --bf16 --total-timesteps 6000000 --hidden-size 256 \\
    --num-minibatches 32 --update-epochs 3 --learning-rate 7e-4 --seed $seed --save-model \\
    --run-dir runs/fourrooms/19_seed$seed --resume
done   # the slower of two seeds once more, with --seed 2 --total-timesteps 9000000
python benchmark/fourrooms_players.py        # runs/fourrooms -> benchmark/results/fourrooms
"""

from dataclasses import dataclass
from pathlib import Path

from common import ROOT, UsageError, commit, commit_of, distinct, finished_runs, run_main, write_csv


@dataclass
class Args:
    runs: Path = Path("runs/fourrooms")
    """folder of the runs' folders"""
    out: Path = ROOT / "benchmark" / "results" / "fourrooms"
    """folder for the table"""


def read_runs(folder: Path) -> list[dict]:
    """One row for each run that came to the end of its steps."""
    rows = []
    for _, result in finished_runs(folder):
        greedy = result["evaluation"]
        row = {"env_id": result["env_id"], "seed": result["seed"], "steps": result["global_step"]}
        row |= {"minutes": round(result["training_seconds"] / 60, 1), "sampled": result["training"]["mean"]}
        row |= {"sampled_episodes": result["training"]["episodes"], "greedy_episodes": greedy["episodes"]}
        row |= {"greedy": greedy["mean"], "optimal": greedy["optimal"], "solved": greedy["solved"]}
        rows.append({**row, "commit": commit_of("ppo_fourrooms", result["script_sha256"])})
    return rows


def table(rows: list[dict]) -> str:
    """The rows as Markdown, the greedy return as a share of the optimal one beside it."""
    sampled, greedy = (distinct(rows, f"{mode}_episodes") for mode in ("sampled", "greedy"))
    heads = ["task", "seed", "steps", "minutes", f"sampled, last {sampled}", f"greedy, {greedy}"]
    heads += ["shortest paths", "share", "solved", "commit"]
    lines = [f"| {' | '.join(heads)} |", "|" + "---|" * len(heads)]
    for row in rows:
        share = row["greedy"] / row["optimal"]
        sampled = "" if row["sampled"] is None else f"{row['sampled']:.3f}"  # no episode came to its end
        cells = [row["env_id"], row["seed"], f"{row['steps']:,}", f"{row['minutes']:.0f}", sampled]
        cells += [f"{value:.3f}" for value in (row["greedy"], row["optimal"], share, row["solved"])]
        lines.append(f"| {' | '.join(map(str, [*cells, row['commit']]))} |")
    return "\n".join(lines) + "\n"


def main(args: Args) -> None:
    found = read_runs(args.runs)
    if not found:
        raise UsageError(f"--runs {args.runs}: holds no finished run")
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "players.csv", found)
    text = f"`benchmark/fourrooms_players.py` at {commit()}; one thread each, beside other processes.\n\n{table(found)}"
    (args.out / "players.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
