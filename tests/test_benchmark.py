"""The report's numbers against scipy and by hand, and the timing tool's table."""

import csv
import hashlib
import importlib
import json
import math
import re
import sys

import numpy as np
import pytest
from conftest import ROOT
from scipy import stats

sys.path.insert(0, str(ROOT / "benchmark"))  # where the scripts find one another
from common import UsageError, check_counts, kind_of, run_main, write_csv  # noqa: E402

names = ("ppo_k10_report", "speed", "apple_report", "torcs_report")
ppo_kle = importlib.import_module("report")
report, speed, apple, torcs = map(importlib.import_module, names)


TEXTS = {path.stem: path.read_text() for path in sorted((ROOT / "benchmark").glob("*.py"))}
SCRIPTS = [name for name, text in TEXTS.items() if "run_main(main, Args" in text and "Positional" not in text]


@pytest.mark.parametrize("name", SCRIPTS)
def test_a_script_starts_with_its_defaults(name):
    check_counts(importlib.import_module(name).Args())


@pytest.mark.parametrize(
    "args, words",
    [
        (speed.Args("ppo", update_epochs=(10, 0)), "--update-epochs 10 0: must be at least 1"),
        (speed.Args("ppo", 0), "0"),
    ],
)
def test_counts_below_one_are_refused(args, words):
    with pytest.raises(UsageError, match=words):
        check_counts(args)


def test_demonstrations_of_a_quick_human(tmp_path, monkeypatch):
    """As the study's script sends it."""
    monkeypatch.setattr(sys, "argv", ["apple_players.py", "--seed", "2", "--demos", str(tmp_path / "demos")])
    players = importlib.import_module("apple_players")
    run_main(players.main, players.Args, players.__doc__)
    assert json.loads((tmp_path / "demos" / "manifest.json").read_text())["env_id"] == "AppleGame-v0"


@pytest.mark.parametrize("name", ["alpha0.5_seed1", "T0.1_alpha0.50_seed2", "mix_alpha.5_seed10"])
def test_kind_of_a_run(name, tmp_path):
    (tmp_path / name).mkdir()
    (tmp_path / name / "args.json").write_text('{"alpha": 0.5}')
    assert kind_of(tmp_path / name) == re.sub(r"[\d.]+_seed\d+", "0.5", name)


def test_a_table_that_cannot_be_written_leaves_the_one_before(tmp_path):
    write_csv(tmp_path / "a.csv", [{"x": 1}])
    for rows in ([], [{"x": 1}, {"y": 2}]):
        with pytest.raises((IndexError, ValueError)):
            write_csv(tmp_path / "a.csv", rows)
    assert (tmp_path / "a.csv").read_text() == "x\n1\n" and len(list(tmp_path.iterdir())) == 1


def test_interval_is_that_of_the_t_test():
    ours, theirs = [3.0, 5.0, 4.5, 7.0], [1.0, 2.5]
    expected = stats.ttest_ind(ours, theirs).confidence_interval(0.95)
    assert report.difference_interval(ours, theirs) == pytest.approx((expected.low, expected.high))


def fake_run(folder, task: str, seed: int, returns: list[float], complete: bool = True) -> None:
    run = folder / f"{task}__seed{seed}"
    run.mkdir(parents=True)
    rows = "".join(f"{1000 * (i + 1)},{value},1000\n" for i, value in enumerate(returns))
    (run / "episodes.csv").write_text("global_step,episodic_return,episodic_length\n" + rows)
    result = {
        "env_id": f"kle/{task}",
        "seed": seed,
        "global_step": 1000 * len(returns),
        "training_seconds": 3600.0,
        "complete": complete,
        "script_sha256": hashlib.sha256((ROOT / "cleanrl_thesis" / "ppo_continuous_kle.py").read_bytes()).hexdigest(),
    }
    (run / "result.json").write_text(json.dumps({**result, "evaluation": {"mean": 1.0}}))


def test_report_of_part_of_the_runs(tmp_path):
    rng = np.random.default_rng(0)
    returns = {seed: rng.normal(1600, 50, 200).tolist() for seed in (1, 2)}
    for seed, values in returns.items():
        fake_run(tmp_path / "runs", "HalfCheetah-v2", seed, values)
    (tmp_path / "runs" / "HalfCheetah-v2__seed3").mkdir()  # not finished
    fake_run(tmp_path / "runs", "HalfCheetah-v2", 4, [0.0] * 60, complete=False)  # ended early by --stop-at
    report.main(report.Args(tmp_path / "runs", tmp_path / "out"))
    with open(tmp_path / "out" / "runs.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["last_50"]) for row in rows] == pytest.approx(
        [np.mean(returns[s][-50:]) for s in (1, 2)], abs=0.01
    )
    assert [float(row["last_episode"]) for row in rows] == pytest.approx([returns[s][-1] for s in (1, 2)], abs=0.01)
    text = (tmp_path / "out" / "table.md").read_text()
    assert "2 runs, 2.0 core-hours" in text and "| HalfCheetah-v2 | last episode | 1,804, 1,448 |" in text
    assert re.match(r"`benchmark/ppo_k10.sh`, ppo_continuous_kle.py at (\w+|not recorded); .* at \w+", text)
    assert "| Hopper-v2 | last episode | 3,609, 1,276 | not done |" in text
    assert (tmp_path / "out" / "learning_curves.png").read_bytes()[:4] == b"\x89PNG"


def test_a_difference_outside_the_interval_is_marked():
    published = [{"task": "T", "seed": str(s), "last_episode": "100", "last_50": str(99 + s)} for s in (1, 2)]
    runs = [{"task": "T", "seed": s, "last_episode": 100.0, "last_50": 200.0 + s} for s in (1, 2, 3)]
    table = report.ppo_k10_table(published, runs)
    assert table.count("**outside**") == 1 and "**outside**" in table.splitlines()[3]


def test_dreamer_table_has_the_parts_of_ours_alone():
    speeds, ratio = {"plain": [0.25, 0.2], "sheeprl": [0.125, 0.05]}, {"plain": [1.0, 1.0], "sheeprl": [0.5, 0.25]}
    parts = {"plain": [{"dream": 900.0}, {"dream": 1_000.0}]}
    row = {"env_id": "m", "steps_per_second": speeds, "ratio": ratio, "milliseconds": parts}
    lines = speed.dreamer_table([row]).splitlines()
    assert lines[2] == "| m | plain | 4444 | 1.00 | 1.00 to 1.00 | 950.0 |"
    assert lines[3] == "| m | sheeprl | 11429 | 3.00 | 2.00 to 4.00 |  |"


def test_a_sheeprl_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(UsageError, match="--sheeprl"):
        speed.time_dreamer(speed.Args("dreamer", sheeprl=tmp_path / "none"))


@pytest.mark.parametrize(
    "words, complaint", [(["ppo", "--rounds", "0"], "--rounds 0"), (["ppo", "--sheeprl", "x"], "--sheeprl x")]
)
def test_a_wrong_value_is_one_line_and_exit_code_2(words, complaint, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["speed.py", *words])
    with pytest.raises(SystemExit) as stop:
        run_main(speed.main, speed.Args, speed.__doc__)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and err.startswith(f"error: {complaint}: ") and err.count("\n") == 1


@pytest.mark.parametrize(
    "module, words, complaint",
    [
        (speed, ["ppo", "--rounds", "x"], "--rounds"),
        (speed, ["chess"], "chess"),
        (ppo_kle, ["--workers", "0"], "--workers 0: must be at least 1"),
        (ppo_kle, ["--known", "no/such/folder"], "--known no/such/folder"),
    ],
)
def test_what_cannot_be_read_is_one_line(module, words, complaint, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["script.py", *words])
    with pytest.raises(SystemExit) as stop:
        run_main(module.main, module.Args, module.__doc__)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and err.startswith("error: ") and complaint in err and err.count("\n") == 1


def test_speed_table_has_medians_and_ratios_round_by_round():
    speeds = {"stable-baselines3": [100.0, 200.0, 150.0], "plain": [400.0, 600.0, 300.0]}
    ratio = {name: [a / b for a, b in zip(values, speeds["stable-baselines3"])] for name, values in speeds.items()}
    memory = dict.fromkeys(speeds, 500.0)
    row = {"env_id": "T", "update_epochs": 10, "steps_per_second": speeds, "ratio": ratio, "peak_memory_mb": memory}
    assert "| T | 10 | plain | 400 | 3.00 | 2.00 to 4.00 | 500 |" in speed.table([row])


def test_auc_is_the_share_of_pairs_in_order():
    rng = np.random.default_rng(0)
    agent, human = rng.integers(0, 6, 40), rng.integers(0, 4, 30)
    pairs = [(a > h) + 0.5 * (a == h) for a in agent for h in human]
    assert math.isclose(apple.auc(agent, human), np.mean(pairs))


def test_a_player_is_told_from_another_but_not_from_itself():
    """Players who go right or left half of the time, at random; and one who never goes left."""

    def episodes(seed: int, moves: list[int]) -> list[dict]:
        rng = np.random.default_rng(seed)
        obs = np.zeros((601, 6), np.float32)
        return [{"actions": rng.choice(moves, 600), "observations": obs} for _ in range(12)]

    assert 0.35 < apple.tell_apart(episodes(0, [3, 5]), episodes(1, [3, 5]), 0) < 0.65
    assert apple.tell_apart(episodes(0, [3, 5]), episodes(1, [4, 5]), 0) > 0.99


def test_reaction_is_the_first_change_that_leads_nearer():
    apples = np.repeat([[0.1, 0.1], [0.2, 0.9], [0.7, 0.3]], [5, 10, 9], axis=0)
    ways = np.repeat([[-1.0, 0.0], [0.5, 0.0], [-0.5, 0.2]], [5, 10, 9], axis=0)
    observations = np.concatenate([np.zeros((24, 2)), apples, ways], 1)
    # moving left as the second apple comes at 5: lets go at 6, goes up at 7, right at 9; never turns to the third
    actions = np.array([3] * 6 + [4] + [1] * 2 + [5] * 15)
    moves = np.array([(x, y) for y in (-1, 0, 1) for x in (-1, 0, 1)]).T
    episode = {"observations": np.concatenate([observations, observations[-1:]]), "actions": actions}
    assert apple.reaction_times([episode], moves) == [4]


def test_direction_changes_do_not_count_standing_still():
    episode = {"actions": np.array([4, 5, 5, 4, 5, 3, 4, 4, 8, 8])}  # right, left, down and right
    assert math.isclose(apple.direction_changes_per_second([episode, episode]), 2 * 60 / 10)


def test_the_rule_picks_the_smallest_alpha_above_the_human():
    curve = {0.0: {1: 9.0}, 0.3: {1: 4.0, 2: 5.0}, 0.5: {1: 6.0, 2: 5.0}, 0.7: {1: 8.0}}
    assert apple.representative_alpha(curve, 5.0) == 0.5 and apple.representative_alpha(curve, 9.0) is None


def test_marks_of_the_road_are_passed_once_a_lap():
    place = np.arange(205.0, 4_600.0, 10.0)  # two laps and some of a road of 2,000 m
    found = torcs.crossings(place, np.array([100.0, 300.0, 900.0]), 2_000.0)
    assert sorted((number, place[step]) for number, step in found) == [
        (0, 2_105.0),
        (0, 4_105.0),
        (1, 305.0),
        (1, 2_305.0),
        (1, 4_305.0),
        (2, 905.0),
        (2, 2_905.0),
    ]


def test_the_wheel_turns_back_where_it_does_by_more_than_a_tremble():
    wheel = [0, 0.2, 0.4, 0.38, 0.5, 0.1, -0.3, -0.28, -0.31, 0.2, 0.2, 0.24]
    assert torcs.wheel_changes(np.array(wheel)) == 2  # at 0.5 and at -0.31
    assert torcs.wheel_changes(0.04 * np.arange(50.0)) == 0
    times = np.arange(0, 10, 0.02)
    assert torcs.wheel_changes(np.sin(2 * np.pi * times)) == 20


def test_habits_of_a_car_whose_way_is_known():
    """70 km/h throughout, 2 m left of the middle, past the first two parked cars."""
    track = torcs.gail.Track(*torcs.gail.TRACKS["meadow"])
    steps = 700
    observations = np.zeros((steps + 1, 65), np.float32)
    observations[:, 20], observations[:, 21] = 2 / track.half_width, 70 / 300
    episode = {"rewards": np.full(steps, 70 / 3.6 / 50), "observations": observations, "actions": np.zeros((steps, 2))}
    found = torcs.habits([episode], track)
    assert found["speed"] == pytest.approx(70) and found["slowing"] == pytest.approx(0, abs=1e-4)
    gaps = [abs(2 - left * track.half_width) - torcs.gail.CAR_WIDTH for left in torcs.gail.PARKED_LEFT[:2]]
    assert found["gap"] == pytest.approx(np.mean(gaps), abs=1e-5)
    assert (found["left of 0"], found["left of 1"], found["changes"], found["crashes"]) == (0, 1, 0, 0)
    for steps, left, into_cars in ((200, 2, 0), (250, 2, 1), (250, -9, 0)):  # at 277 and 297 m; a car stands at 300 m
        crash = {name: array[:steps].copy() for name, array in episode.items()}
        crash["rewards"][-1], observations[steps, 20] = -1, left / track.half_width
        crash["observations"] = observations[: steps + 1]
        found = torcs.habits([crash], track)
        assert (found["crashes"], found["into cars"]) == (1, into_cars), (steps, left)
