"""In which units Table 2.2 counts, and how the constants of Gopher's synthetic human were chosen: scores of scripted players.

    python benchmark/gopher_players.py                 # random play and the synthetic human, beside Table 2.2's human
    python benchmark/gopher_players.py --calibrate     # neighbouring constants too
    python benchmark/gopher_players.py --demos DIR     # demonstrations of a human who acts on what the student sees too

A hole that is filled up by one row gives 20 points, a gopher that is hit 100. OpenAI Baselines, with which the thesis'
DQN was trained, sees an episode for each life, and the rewards' signs instead of the rewards. Writes
`benchmark/results/gopher/players.csv` and `.md`.
"""

import functools
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from apple_players import load_method
from common import ROOT, commit, published_table, run_main, write_csv

ENV_ID = "ALE/Gopher-v5"
UNITS = {  # a score of each episode, or of each of its lives
    "points of a game": lambda method, episode: [episode["rewards"].sum()],
    "points of a game / 20": lambda method, episode: [episode["rewards"].sum() / 20],
    "points of a game / 100": lambda method, episode: [episode["rewards"].sum() / 100],
    "points of a life / 20": lambda method, episode: [sum(part) / 20 for part in lives_of(method, episode)],
    "rewards of a game": lambda method, episode: [(episode["rewards"] > 0).sum()],
    "rewards of a life": lambda method, episode: method.rewards_per_life(episode),
}
QUICK = {"reaction": 2}  # what it acts on is among the four frames that a student sees
CALIBRATION = {
    "reaction": (3, 4, 5),
    "aim_error": (2.0, 3.0, 4.0),
    "lapse": (0.0, 0.01, 0.02),
    "taps": ((2, 4), (2, 5)),
}


@dataclass
class Args:
    episodes: int = 100
    """episodes of each player"""
    seed: int = 1
    """seed of the games and of the players"""
    calibrate: bool = False
    """also play with neighbouring constants of the synthetic human, one changed at a time"""
    demos: Path | None = None
    """only write demonstrations of a quick human into this folder, as many as a student takes by default"""
    out: Path = ROOT / "benchmark" / "results" / "gopher"
    """folder for the results"""


def lives_of(method, episode: dict[str, np.ndarray]) -> list[np.ndarray]:
    """The rewards of each life, as `rewards_per_life` parts them."""
    lost = np.flatnonzero(np.diff(episode["lives"]) < 0) + 2
    return [part for part in np.split(episode["rewards"], lost) if len(part)]


def random_player(method, seed: int, episode: int):
    rng = np.random.default_rng([seed, episode])
    return lambda obs: rng.integers(8, size=len(obs))


def episodes_of(method, make_player, args: Args) -> list[dict[str, np.ndarray]]:
    """Each episode with a player of its own."""
    make_game = functools.partial(method.make_atari, ENV_ID, obs_type="ram", frame_stack=1)
    seeds = [method.episode_seed(args.seed, 0, i) for i in range(args.episodes)]
    return [method.play_atari(make_player(args.seed, i), make_game, [seed])[0] for i, seed in enumerate(seeds)]


def measure(method, player: str, make_player, args: Args) -> list[dict]:
    """The scores of a player in each unit."""
    episodes, rows = episodes_of(method, make_player, args), []
    for unit, score in UNITS.items():
        scores = [value for episode in episodes for value in score(method, episode)]
        numbers = {name: round(float(getattr(np, name)(scores)), 2) for name in ("max", "min", "mean", "std")}
        rows.append({"player": player, "unit": unit, "scores": len(scores), **numbers})
    return rows


def table(rows: list[dict]) -> str:
    """The rows as Markdown, the published one first."""
    names = list(rows[0])
    human = published_table("table_2_2.csv")["human"]
    lines = [f"| {' | '.join(names)} |", "|" + "---|" * len(names)]
    lines.append(
        f"| Table 2.2: human | not said | not said | {' | '.join(human[key] for key in ('max', 'min', 'avg', 'std'))} |"
    )
    lines += [f"| {' | '.join(str(row[name]) for name in names)} |" for row in rows]
    return "\n".join(lines) + "\n"


def quick_human(method) -> type:
    """The synthetic human with a reaction time of two actions, 133 ms."""
    return type("QuickHuman", (method.SyntheticGopherHuman,), QUICK)


def write_quick_demonstrations(method, args: Args) -> None:
    """Demonstrations of the quick human, in the games of the calibrated one."""
    method.SyntheticGopherHuman = quick_human(method)
    demo_args = method.complete_args(method.Args(env_id=ENV_ID, seed=args.seed, alpha=0.0))
    args.demos.mkdir(parents=True, exist_ok=True)
    about = {"env_id": ENV_ID, "player": "synthetic human, quick", "mode": "scripted"}
    method.save_episodes(args.demos, method.make_gopher_demonstrations(demo_args), about)


def main(args: Args) -> None:
    method = load_method("distill_hybrid")
    if args.demos is not None:
        return write_quick_demonstrations(method, args)
    human = method.SyntheticGopherHuman
    rows = measure(method, "random", functools.partial(random_player, method), args)
    rows += measure(method, "synthetic human", human, args)
    for name, values in CALIBRATION.items() if args.calibrate else ():
        for value in values:
            if value != getattr(human, name):
                other = type("Other", (human,), {name: value})
                rows += measure(method, f"synthetic human, {name} {value}", other, args)[-1:]
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(args.out / "players.csv", rows)
    line = f"python benchmark/gopher_players.py{' --calibrate' if args.calibrate else ''} --episodes {args.episodes}"
    (args.out / "players.md").write_text(f"`{line} --seed {args.seed}`, commit {commit()}\n\n{table(rows)}")
    print(table(rows))


if __name__ == "__main__":
    run_main(main, Args, __doc__)
