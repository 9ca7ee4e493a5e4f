"""The synthetic driver beside the DDPG experts: how its numbers were chosen, and its demonstrations.

    python benchmark/torcs_players.py --calibrate                              # runs/torcs -> benchmark/results/torcs
    python benchmark/torcs_players.py --seed 1 --demos runs/torcs/human_seed1  # 220 episodes of 60 s

`--calibrate` measures the driver at several values of its boldness, which was fitted, as was its spread: the score is to
stand to the experts' as 637 to 819 (Table 2.3), without a crash, for the people of Table 2.3 never scored below 588. Each
expert also drives one whole lap from standstill, for which 60 s are not quite enough, in other episodes.
"""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors.torch
from common import ROOT, UsageError, commit, published_table, run_main, write_csv

from cleanrl_thesis import ddpg_torcs_like as ddpg
from cleanrl_thesis import gail_hybrid as gail

LAPS_STREAM = 1_000_020  # of the episodes of one lap, which no script has
LAPS = 20
MOST_SECONDS = 180  # for a lap


@dataclass
class Args:
    seed: int = 1
    """seed of the driver and of its episodes"""
    episodes: int = 220
    """episodes of 60 s"""
    demos: Path | None = None
    """write the episodes as demonstrations into this folder, and nothing else"""
    calibrate: bool = False
    """also measure other values of the boldness"""
    runs: Path = Path("runs/torcs")
    """folder with the experts, expert_seed*"""
    out: Path = ROOT / "benchmark" / "results" / "torcs"
    """folder for the tables"""


def drive(boldness: float, args: Args) -> list[dict[str, np.ndarray]]:
    """Episodes of the driver at a boldness."""
    driver = type("Driver", (gail.SyntheticDriver,), {"boldness": boldness})
    seeds = [gail.episode_seed(args.seed, gail.HUMAN_STREAM, i) for i in range(args.episodes)]
    games = gail.TorcsLikeVectorEnv(args.episodes)
    return gail.play(driver(games.cars, args.seed), games, seeds, keep=True)


def write_demonstrations(args: Args) -> None:
    args.demos.mkdir(parents=True, exist_ok=True)
    about = {"env_id": "TorcsLike-v0", "options": gail.env_options(gail.Args()), "player": "synthetic human"}
    about |= {"mode": "scripted"}
    gail.write_demonstrations(args.demos, drive(gail.SyntheticDriver.boldness, args), about)


def load_expert(run: Path):
    """The policy of a finished run of ddpg_torcs_like.py."""
    args = ddpg.Args(**json.loads((run / "args.json").read_text()))  # as written, with a text for the folder
    agent = ddpg.Agent(65, 2, args.hidden_size, args.layer_norm)
    agent.load_state_dict(safetensors.torch.load_file(run / "model.safetensors"))
    norm = ddpg.RunningNorm(agent.obs_scale, args.norm_obs)
    policy = ddpg.make_policy(ddpg.FlatAdam(agent, args), norm, ddpg.TORCS_ACTIONS)
    return ddpg.held(policy, args.frame_skip)


def lap_row(run: Path, seed: int) -> dict:
    """How an expert's episodes of one lap end."""
    ddpg.EPISODE_STEPS = MOST_SECONDS * ddpg.FPS
    seeds = [ddpg.episode_seed(seed, LAPS_STREAM, i) for i in range(LAPS)]
    episodes = ddpg.play(load_expert(run), ddpg.TorcsLikeVectorEnv(LAPS, max_laps=1), seeds)
    length = ddpg.Track(*ddpg.TRACKS["meadow"]).length
    whole = [e for e in episodes if not (e["rewards"] == -1).any() and e["rewards"].sum() >= length]
    seconds = [len(episode["rewards"]) / ddpg.FPS for episode in whole]
    fastest, slowest = (f"{function(seconds):.1f}" if seconds else "" for function in (min, max))
    return {"seed": seed, "episodes": LAPS, "whole laps": len(whole), "fastest, s": fastest, "slowest, s": slowest}


def row(name: str, scores: dict, expert: float) -> dict:
    """A line of the table."""
    numbers = {key: round(scores["score"][key], 1) for key in ("mean", "std", "min", "max")}
    ratio = round(scores["score"]["mean"] / expert, 3)
    return {
        "driver": name,
        "episodes": len(scores["laps"]),
        **numbers,
        "of DDPG's": ratio,
        "crashes": scores["crashes"],
    }


def table(rows: list[dict]) -> str:
    """Rows with the same columns in Markdown."""
    lines = [f"| {' | '.join(rows[0])} |", "|" + "---|" * len(rows[0])]
    return "\n".join([*lines, *(f"| {' | '.join(map(str, line.values()))} |" for line in rows)]) + "\n"


def main(args: Args) -> None:
    if args.demos is not None:
        return write_demonstrations(args)
    results = [json.loads(path.read_text()) for path in sorted(args.runs.glob("expert_seed*/result.json"))]
    if not results:
        raise UsageError(f"--runs {args.runs}: holds no finished expert_seed*, to compare with")
    experts = [result["evaluation"]["driving"] for result in results]
    expert = float(np.mean([scores["score"]["mean"] for scores in experts]))
    length = gail.Track(*gail.TRACKS["meadow"]).length
    chosen = gail.SyntheticDriver.boldness
    others = [0.96, 0.98, 1.0, 1.02, 1.04, 1.06, 1.08] if args.calibrate else []
    rows = [row(f"DDPG, seed {result['seed']}", scores, expert) for result, scores in zip(results, experts)]
    for boldness in sorted({chosen, *others}):
        scores = gail.driving_scores(drive(boldness, args), length)
        rows.append(row(f"boldness {boldness}{' (chosen)' if boldness == chosen else ''}", scores, expert))
    published = published_table("table_2_3.csv")
    goal = float(published["human"]["avg"]) / float(published["DDPG"]["avg"])
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "players.csv", rows)
    laps = [lap_row(args.runs / f"expert_seed{result['seed']}", result["seed"]) for result in results]
    command = f"python benchmark/torcs_players.py{' --calibrate' if args.calibrate else ''} --seed {args.seed}"
    text = f"`{command}`, commit {commit()}. Table 2.3: {goal:.3f} of DDPG's.\n\n{table(rows)}\n"
    text += f"One lap of {length:,.0f} m from standstill, without the limit of 60 s:\n\n{table(laps)}"
    (args.out / "players.md").write_text(text)
    print(text)


if __name__ == "__main__":
    run_main(main, Args, __doc__)
