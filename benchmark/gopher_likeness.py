"""How human Gopher's agents look, without people: how surely each is told from the synthetic human, and what participants named.

    python benchmark/gopher_likeness.py        # runs/gopher -> benchmark/results/gopher/likeness.md, .csv
    python benchmark/gopher_likeness.py --known benchmark/results/gopher   # with the agents of an earlier report, whose folders are gone

Section 2.4.2 quotes people on the DQN: "systematically fills the holes with great precision", a reaction time, "unnatural lateral
movement while filling the holes", "tries to needlessly fill regions without holes". Each agent plays as many games for each seed
of the students; they are played again in the console's memory, which says where farmer, gopher and holes are. Half of the games
train a classifier of 2 s of play, which is tried on the other half. Takes whatever runs are done.
"""

import functools
import json
from collections import defaultdict
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from apple_report import load_student, median, tell_apart
from common import ROOT, UsageError, commit, finished_runs, run_folders, run_main, with_known, write_csv
from gopher_players import ENV_ID, load_method
from gopher_report import DQNS
from intervals import with_interval

UP_FIRE = 5
FPS, CLIP = 15, 30  # actions a second, and in a clip of 2 s
HUMAN = "synthetic human"
ALPHAS = ("0.0", "0.5", "0.8", "1.0")
REACH = 10  # pixels from where the farmer should stand, within which a press of the button is for something
COLUMNS = {
    "auc": ("told from the synthetic human, AUC", 3),
    "reaction": ("reaction to a hole, ms", 0),
    "turns": ("turns back a second", 2),
    "needless": ("presses with nothing there", 2),
    "moving": ("presses while moving", 2),
    "presses": ("presses a reward", 1),
    "score": ("rewards of a life", 1),
}


@dataclass
class Args:
    runs: Path = Path("runs/gopher")
    """folder of the runs' folders"""
    games: int = 20
    """games of each agent and seed, half of them held out"""
    known: Path | None = None
    """folder of an earlier report, whose likeness.csv stands for agents that are not in `--runs`"""
    out: Path = ROOT / "benchmark" / "results" / "gopher"
    """folder for the results"""


def agents_of(method, folder: Path, seed: int, games: int) -> dict[str, list[dict]]:
    """Games of each agent of a seed that is there; the second human is as good as an agent can look."""
    seeds = [method.episode_seed(seed, method.DEMONSTRATION_STREAM, i) for i in range(games)]
    in_memory = functools.partial(method.make_atari, ENV_ID, obs_type="ram", frame_stack=1)
    played = {
        name: [
            method.play_atari(method.SyntheticGopherHuman(own_seed, i), in_memory, [game])[0]
            for i, game in enumerate(seeds)
        ]
        for name, own_seed in ((HUMAN, seed), (f"{HUMAN} again", seed + 1000))
    }
    make_game = functools.partial(method.make_env, ENV_ID)
    space, num_actions = make_game().observation_space.shape, int(make_game().action_space.n)
    cautious = functools.partial(
        method.epsilon_greedy_policy, num_actions=num_actions, epsilon=method.ATARI_EPSILON, seed=seed
    )
    runs = run_folders(folder)
    for (kind, _), run in runs.items():
        if kind in DQNS:
            dqn = method.greedy_policy(method.load_teacher(run, ENV_ID), torch.device("cpu"))
            name = f"DQN of {json.loads((run / 'result.json').read_text())['global_step']:,} frames"
            played[name] = method.play_atari(cautious(dqn), make_game, seeds)
    for alpha in ALPHAS:
        run = runs.get((f"alpha{alpha}", seed))
        if run is not None:
            student = load_student(method, run, space, num_actions)
            greedy, sampled = (method.numpy_policy(student, mode, seed) for mode in ("greedy", "sampled"))
            played[f"α = {alpha}, sampled"] = method.play_atari(sampled, make_game, seeds)
            played[f"α = {alpha}, greedy"] = method.play_atari(cautious(greedy), make_game, seeds)
    game = in_memory()
    return {
        name: [{**episode, "memory": watch_memory(game, episode)} for episode in episodes]
        for name, episodes in played.items()
    }


def watch_memory(game, episode: dict[str, np.ndarray]) -> np.ndarray:
    """The console's memory before each action, (T, 128), by playing an episode again."""
    memory = [game.reset(seed=int(episode["seed"]))[0][-1]]
    for action in episode["actions"][:-1].tolist():
        memory.append(game.step(action)[0][-1])
    return np.array(memory, np.int64)


def depths_of(method, memory: np.ndarray) -> np.ndarray:
    """Rows that are dug of each hole, (T, 6)."""
    garden = memory[:, : method.ROWS * method.ROW_BYTES].reshape(-1, method.ROWS, method.ROW_BYTES)
    return ((garden[:, :, method.HOLE_BYTES] & method.HOLE_BITS) > 0).sum(1)


def lateral(method, actions: np.ndarray) -> np.ndarray:
    """-1, 0 or 1 for each action: the way that the farmer is sent."""
    right, left = (
        np.isin(actions, each) for each in ((method.GO_RIGHT, method.RIGHT_FIRE), (method.GO_LEFT, method.LEFT_FIRE))
    )
    return right.astype(int) - left


def clips(method, episodes: list[dict]) -> tuple[torch.Tensor, np.ndarray]:
    """Clips of 2 s as (clips, channels, actions), with the number of the episode each is from.

    Channels: which of the eight actions, the way to the gopher and its height, the way to the nearest hole and its depth.
    """
    found, numbers = [], []
    for number, episode in enumerate(episodes):
        memory, depths = episode["memory"], depths_of(method, episode["memory"])
        ways = method.HOLES + method.SHOVEL - memory[:, method.FARMER_X, None]
        nearest = np.where(depths > 0, np.abs(ways), 1_000).argmin(1)[:, None]
        way, depth = (np.take_along_axis(each, nearest, 1)[:, 0] for each in (ways, depths))
        gopher = memory[:, method.GOPHER_X] - memory[:, method.FARMER_X]
        numeric = np.stack(
            [gopher / 80, memory[:, method.GOPHER_Y] / 40, way * (depth > 0) / 80, depth / method.ROWS], 1
        )
        actions = F.one_hot(torch.from_numpy(episode["actions"]), 8).float()
        steps = torch.cat([actions, torch.from_numpy(numeric).float()], 1)
        found += steps[: len(steps) // CLIP * CLIP].split(CLIP)
        numbers += [number] * (len(steps) // CLIP)
    return torch.stack(found).transpose(1, 2), np.array(numbers)


def reactions(method, episode: dict) -> list[int]:
    """Actions from a hole's first row, where there was none, to the first new action that goes there or presses the button.

    Holes that are filled, or are not alone any more, before that are left out.
    """
    depths, actions = depths_of(method, episode["memory"]), episode["actions"]
    count, times = (depths > 0).sum(1), []
    held, ways = holds_button(method, actions), lateral(method, actions)
    changes = np.flatnonzero(actions[1:] != actions[:-1]) + 1
    for begin in np.flatnonzero((count[1:] == 1) & (count[:-1] == 0)) + 1:
        place = method.HOLES[depths[begin].argmax()] + method.SHOVEL
        for t in changes[changes >= begin]:
            if count[t] != 1:
                break
            if held[t] or ways[t] * (place - episode["memory"][t, method.FARMER_X]) > 0:
                times.append(int(t - begin))
                break
    return times


def holds_button(method, actions: np.ndarray) -> np.ndarray:
    """Whether the button is held with each action."""
    return np.isin(actions, (method.FIRE, UP_FIRE, method.RIGHT_FIRE, method.LEFT_FIRE))


def presses(method, episode: dict) -> np.ndarray:
    """How often the button is pressed in play; with no hole or gopher there; and while the farmer moves."""
    memory, held = episode["memory"], holds_button(method, episode["actions"])
    new = held & ~np.concatenate([[False], held[:-1]]) & (memory[:, method.SCENE] == method.IN_PLAY)
    farmer = memory[:, method.FARMER_X, None]
    holes = (depths_of(method, memory) > 0) & (np.abs(method.HOLES + method.SHOVEL - farmer) <= REACH)
    gopher = (memory[:, method.GOPHER_Y] >= method.RISING) & (
        np.abs(memory[:, method.GOPHER_X] + method.BONK - farmer[:, 0]) <= REACH
    )
    needless, moving = new & ~holes.any(1) & ~gopher, new & (lateral(method, episode["actions"]) != 0)
    return np.array([new.sum(), needless.sum(), moving.sum()])


def turns(method, episode: dict) -> int:
    """How often the farmer is sent the other way; standing still between does not count."""
    ways = lateral(method, episode["actions"])
    moves = ways[ways != 0]
    return np.count_nonzero(moves[1:] != moves[:-1])


def habits(method, episodes: list[dict]) -> dict[str, float]:
    """What participants named, as numbers over all episodes."""
    times = [time for episode in episodes for time in reactions(method, episode)]
    pressed, needless, moving = sum(presses(method, episode) for episode in episodes)
    rewards = sum((episode["rewards"] > 0).sum() for episode in episodes)
    seconds = sum(len(episode["actions"]) for episode in episodes) / FPS
    return {
        "reaction": median(times) / FPS * 1000,
        "turns": sum(turns(method, episode) for episode in episodes) / seconds,
        "needless": needless / max(1, pressed),
        "moving": moving / max(1, pressed),
        "presses": pressed / max(1, rewards),
    }


def measure(method, folder: Path, seeds: list[int], games: int) -> list[dict]:
    """A row for each agent and seed."""
    rows = []
    for seed in seeds:
        agents = agents_of(method, folder, seed, games)
        for name, played in agents.items():
            told = {}
            if name != HUMAN:
                told["auc"] = tell_apart(agents[HUMAN], played, seed, functools.partial(clips, method))
            score = np.mean([score for episode in played for score in method.rewards_per_life(episode)])
            rows.append(
                {"agent": name, "seed": seed, "auc": "", **told, **habits(method, played), "score": float(score)}
            )
    return rows


def in_order(row: dict) -> tuple:
    """Humans first, then the DQNs, then their students."""
    agent = row["agent"]
    return not agent.startswith(HUMAN), not agent.startswith("DQN"), agent, row["seed"]


def table(rows: list[dict]) -> str:
    """Means over seeds with 95% t-intervals, as Markdown."""
    values = defaultdict(lambda: defaultdict(list))
    for row in rows:
        for name in COLUMNS:
            if row[name] != "":
                values[row["agent"]][name].append(row[name])
    lines = [
        f"| agent | seeds | {' | '.join(title for title, _ in COLUMNS.values())} |",
        "|" + "---|" * (len(COLUMNS) + 2),
    ]
    for agent, measured in values.items():
        cells = [with_interval(measured[name], digits) for name, (_, digits) in COLUMNS.items()]
        lines.append(f"| {agent} | {len(measured['score'])} | {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def main(args: Args) -> None:
    torch.set_num_threads(1)
    seeds = sorted({result["seed"] for run, result in finished_runs(args.runs) if run.name.startswith("alpha")})
    if not seeds:
        raise UsageError(f"--runs {args.runs}: holds no finished student")
    rows = measure(load_method("distill_hybrid"), args.runs, seeds, args.games)
    if args.known is not None:
        rows = with_known(rows, args.known / "likeness.csv", ("agent", "seed"), {"agent"})
    rows.sort(key=in_order)
    args.out.mkdir(parents=True, exist_ok=True)
    write_csv(
        args.out / "likeness.csv",
        [{key: round(v, 4) if isinstance(v, float) else v for key, v in row.items()} for row in rows],
    )
    text = f"`python benchmark/gopher_likeness.py --games {args.games}` at {commit()}; greedy players have 1% of random actions.\n\n"
    (args.out / "likeness.md").write_text(text + table(rows))
    print(table(rows))


if __name__ == "__main__":
    run_main(main, Args, __doc__)
