"""How the constants of the Apple game and of its synthetic human were chosen: scores of scripted players.

    python benchmark/apple_players.py                       # both players at the chosen constants, beside Table 2.1
    python benchmark/apple_players.py --calibrate           # neighbouring constants too, about two minutes
    python benchmark/apple_players.py --demos DIR --seed 1  # demonstrations of a human who is nearer to the DQN

The game is fixed by two published rows that have to fit at once: the shortest-path player near the DQN's, 36.27 ± 5.44
with at most 53, and a person's near 18.71 ± 2.86. Apples live for 90 frames because the human then needs a reaction time
of 17 frames, 0.28 s, as people have; with 60 frames it would be 0.2 s, with 120 above 0.35 s. Both players' deviations
are not fitted. Writes `benchmark/results/apple/players.csv` and `.md`.
"""

import importlib.util
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from common import ROOT, commit, published_table, run_main, write_csv

PLAYERS = {"shortest path": "DQN", "synthetic human": "human"}  # and the row of Table 2.1 that each is to be like

QUICK = {"reaction": 4.0, "lapse": 0.0, "lag": 1.0, "pause": 3.0, "slip": 0.0}  # what the quick human has otherwise


@dataclass
class Args:
    episodes: int = 400
    """episodes of each player, as in Table 2.1"""
    seed: int = 1
    """seed of the games and of the synthetic human"""
    calibrate: bool = False
    """also play with neighbouring constants"""
    demos: Path | None = None
    """only write demonstrations of a quick human into this folder, as many as a student takes by default"""
    out: Path = ROOT / "benchmark" / "results" / "apple"
    """folder for the results"""


def load_method(name: str):
    """A method file as a module of its own, so that its constants can be changed."""
    spec = importlib.util.spec_from_file_location(name, ROOT / "cleanrl_thesis" / f"{name}.py")
    module = sys.modules[name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def shortest_path(method):
    """The player who moves on both axes until each is within half a step: no path takes fewer frames."""

    def act(obs: np.ndarray) -> np.ndarray:
        way = obs[:, 4:]
        moves = np.where(np.abs(way) > method.SPEED / 2, np.sign(way), 0).astype(int)
        return (moves[:, 1] + 1) * 3 + moves[:, 0] + 1

    return act


def measure(method, player: str, args: Args) -> dict:
    """Play with the constants that `method` has now; return them and the scores."""
    seeds = [method.episode_seed(args.seed, 0, i) for i in range(args.episodes)]
    human = method.SyntheticHuman(args.episodes, args.seed)
    policy = human if player == "synthetic human" else shortest_path(method)
    scores = [episode["rewards"].sum() for episode in method.play(policy, "AppleGame-v0", seeds)]
    return {
        "player": player,
        "speed": float(str(method.SPEED)),
        "reach": float(str(method.REACH)),
        "lifetime": method.LIFETIME,
        "reaction": human.reaction if player == "synthetic human" else "",
        "episodes": args.episodes,
        "mean": round(float(np.mean(scores)), 2),
        "std": round(float(np.std(scores)), 2),
        "min": int(min(scores)),
        "max": int(max(scores)),
    }


def write_quick_demonstrations(method, args: Args) -> None:
    """Demonstrations of the synthetic human without lapses and with reactions and pauses of a few frames."""
    human = type("QuickHuman", (method.SyntheticHuman,), QUICK)
    count = method.DEFAULTS["demo_frames"] // method.EPISODE_FRAMES + 1
    seeds = [method.episode_seed(args.seed, method.HUMAN_STREAM, i) for i in range(count)]
    episodes = method.play(human(count, args.seed), "AppleGame-v0", seeds, keep=True)
    args.demos.mkdir(parents=True, exist_ok=True)
    about = {"env_id": "AppleGame-v0", "player": "synthetic human, quick", "mode": "scripted"}
    method.write_demonstrations(args.demos, episodes, about)


def neighbours(method, args: Args):
    """Rows at other constants: for each reach and lifetime the speed at which the shortest path scores as published."""
    target = float(published_table("table_2_1.csv")["DQN"]["avg"])
    constants = method.SPEED, method.REACH, method.LIFETIME, method.SyntheticHuman.reaction
    for reach, lifetime in ((0.06, 45), (0.06, 60), (0.06, 75), (0.06, 90), (0.06, 120), (0.05, 90), (0.07, 90)):
        slow, fast = 0.006, 0.012
        method.REACH, method.LIFETIME = np.float32(reach), lifetime
        for _ in range(10):
            method.SPEED = np.float32(round((slow + fast) / 2, 5))
            if measure(method, "shortest path", args)["mean"] < target:
                slow = (slow + fast) / 2
            else:
                fast = (slow + fast) / 2
        yield measure(method, "shortest path", args)
        for method.SyntheticHuman.reaction in (12.0, 15.0, 17.0, 20.0):
            yield measure(method, "synthetic human", args)
    method.SPEED, method.REACH, method.LIFETIME, method.SyntheticHuman.reaction = constants


def table(rows: list[dict]) -> str:
    """The rows as Markdown, the published ones first."""
    names = list(rows[0])
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    for agent in PLAYERS.values():
        row = published_table("table_2_1.csv")[agent]
        cells = [f"Table 2.1: {agent}", "", "", "", "", 400, *(row[name] for name in ("avg", "std", "min", "max"))]
        lines.append(f"| {' | '.join(map(str, cells))} |")
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    return "\n".join(lines) + "\n"


def main(args: Args) -> None:
    method = load_method("distill_hybrid")
    if args.demos is not None:
        return write_quick_demonstrations(method, args)
    rows = [measure(method, player, args) for player in PLAYERS]
    if args.calibrate:
        rows += neighbours(method, args)
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "players.csv", rows)
    line = f"python benchmark/apple_players.py{' --calibrate' if args.calibrate else ''} --seed {args.seed}"
    (args.out / "players.md").write_text(f"`{line}`, commit {commit()}\n\n{table(rows)}")
    print(table(rows))


if __name__ == "__main__":
    run_main(main, Args, __doc__)
