"""PPO in FourRooms: its functions against independent sources, and small runs through the command line."""

import itertools
import json
import math
import shutil
import sys

import numpy as np
import pytest
import torch
from conftest import ROOT, assert_refused, kill_twice, needs_compiler, run
from test_fourrooms import brute_force_steps

from cleanrl_thesis import ppo_fourrooms as method

sys.path.append(str(ROOT / "benchmark"))
import fourrooms_cuts  # noqa: E402
import fourrooms_players  # noqa: E402
import fourrooms_steps  # noqa: E402
from common import run_main  # noqa: E402

SCRIPT = ROOT / "cleanrl_thesis" / "ppo_fourrooms.py"
# 6 batches of 128 steps, a checkpoint after each
SMALL = [
    *("--total-timesteps", 768, "--num-envs", 8, "--num-steps", 16, "--num-minibatches", 4, "--channels", 4),
    *("--hidden-size", 16, "--checkpoint-interval", 1, "--eval-episodes", 5, "--learning-rate", 0.01),
]


@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("rooms")
    run(*SMALL, "--run-dir", "run", "--save-model", "--save-demos", 3, cwd=folder, script=SCRIPT)
    return folder / "run"


def small_args(**changes) -> method.Args:
    return method.complete_args(
        method.Args(num_envs=8, num_steps=16, num_minibatches=4, total_timesteps=128, **changes)
    )


def test_gae_is_the_sum_of_its_definition():
    """Σ (γλ)^l δ_{t+l} up to the end of the episode, term by term."""
    rng, steps, games, gamma, gae_lambda = np.random.default_rng(0), 12, 3, 0.97, 0.9
    rewards, dones = rng.normal(size=(steps, games)), (rng.random((steps, games)) < 0.2).astype(float)
    values = rng.normal(size=(steps + 1, games))
    advantages = method.gae(rewards, values, dones, gamma, gae_lambda)
    for i in range(games):
        for t in range(steps):
            total = 0.0
            for k in range(t, steps):
                next_value = 0 if dones[k, i] else values[k + 1, i]
                total += (gamma * gae_lambda) ** (k - t) * (rewards[k, i] + gamma * next_value - values[k, i])
                if dones[k, i]:
                    break
            assert advantages[t, i] == pytest.approx(total)


def test_ppo_loss_against_categorical():
    torch.manual_seed(0)
    logits, old_logits, values = torch.randn(64, 3), torch.randn(64, 3), torch.randn(64)
    new, old = torch.distributions.Categorical(logits=logits), torch.distributions.Categorical(logits=old_logits)
    actions, advantages, returns = old.sample(), torch.randn(64), torch.randn(64)
    batch = method.Batch(torch.zeros(64, 1), actions, old.log_prob(actions), advantages, returns)
    loss, (pg_loss, v_loss, entropy, kl, clipfrac) = method.ppo_loss(logits, values, batch, 0.2, 0.01, 0.5)
    ratio = (new.log_prob(actions) - old.log_prob(actions)).exp()
    terms = [min(float(a * r), float(a * min(max(r, 0.8), 1.2))) for a, r in zip(advantages, ratio)]
    assert pg_loss.item() == pytest.approx(-np.mean(terms), rel=1e-4)
    assert v_loss.item() == pytest.approx(0.5 * torch.nn.functional.mse_loss(values, returns).item())
    assert entropy.item() == pytest.approx(new.entropy().mean().item(), rel=1e-5)
    assert kl.item() == pytest.approx((ratio - 1 - ratio.log()).mean().item(), rel=1e-4)
    assert clipfrac.item() == pytest.approx(((ratio < 0.8) | (ratio > 1.2)).float().mean().item())
    assert loss.item() == pytest.approx((pg_loss + 0.5 * v_loss - 0.01 * entropy).item(), rel=1e-5)


def test_sampled_actions_follow_the_softmax():
    logits = torch.log(torch.tensor([0.7, 0.2, 0.1])).repeat(100_000, 1) + 5
    shares = torch.bincount(method.sample_actions(logits, torch.Generator().manual_seed(0))) / 100_000
    assert torch.allclose(shares, torch.tensor([0.7, 0.2, 0.1]), atol=0.01)


def test_a_rollout_is_what_the_games_gave():
    """Played again from its seeds: frames, rewards, values; a time-out is paid with the value of its last frame."""
    args, device = small_args(seed=3), torch.device("cpu")
    torch.manual_seed(0)
    agent, collector = method.Agent(args.frame_side, 3, 4, 16), method.Collector(args, device)
    games = collector.envs.games
    games.steps[:] = 90  # so that episodes are cut off
    envs = method.FourRoomsVectorEnv(8, 11, args.frame_side)
    obs, _ = envs.reset(seed=[method.episode_seed(3, i, 0) for i in range(8)])
    envs.games.steps[:] = 90
    rollout, cut_off, episodes, lengths = collector.collect(agent), 0, [], np.full(8, 90)
    for t in range(16):
        assert np.array_equal(rollout.obs[t].numpy(), obs)
        with torch.no_grad():
            logits, values = agent(torch.from_numpy(obs))
        assert np.allclose(rollout.values[t], values)
        logprobs = torch.distributions.Categorical(logits=logits).log_prob(rollout.actions[t])
        assert torch.allclose(rollout.logprobs[t], logprobs, atol=1e-6)
        obs, rewards, terminated, truncated, infos = envs.step(rollout.actions[t].numpy())
        assert np.array_equal(rollout.dones[t], terminated | truncated)
        lengths += 1
        for i in np.flatnonzero(terminated | truncated).tolist():
            episodes.append((8 * t + i + 1, float(rewards[i]), int(lengths[i])))  # the reward as it is paid
            lengths[i] = 0
        for i in np.flatnonzero(truncated & ~terminated):
            with torch.no_grad():
                rewards[i] += 0.99 * agent(torch.from_numpy(infos["final_obs"][i : i + 1]))[1].item()
            cut_off += 1
        assert np.allclose(rollout.rewards[t], rewards)
    with torch.no_grad():
        assert np.allclose(rollout.values[16], agent(torch.from_numpy(obs))[1])
    batch = method.make_batch(rollout, args, device)
    advantages = method.gae(rollout.rewards, rollout.values, rollout.dones, args.gamma, args.gae_lambda).ravel()
    assert np.allclose(batch.returns, advantages + rollout.values[:-1].ravel(), atol=1e-6)
    assert np.allclose(batch.advantages, (advantages - advantages.mean()) / advantages.std(ddof=1), atol=1e-4)
    assert torch.equal(batch.obs[9], rollout.obs[1, 1]) and batch.logprobs[9] == rollout.logprobs[1, 1]
    assert cut_off >= 7 and rollout.episodes == episodes


def random_minibatch(rows: int = 32) -> method.Batch:
    rng = np.random.default_rng(0)
    frames = torch.from_numpy(rng.integers(0, 256, (rows, 22, 22, 3), np.uint8))
    numbers = torch.from_numpy(rng.normal(size=(3, rows)).astype(np.float32))
    return method.Batch(frames, torch.from_numpy(rng.integers(0, 3, rows)), -numbers[0].abs(), *numbers[1:])


def test_the_gradient_is_clipped():
    norms = {}
    for bound in (1e-3, math.inf):
        torch.manual_seed(0)
        agent = method.Agent(22, 3, 4, 16)
        method.Update(agent, small_args(max_grad_norm=bound))(random_minibatch())
        norms[bound] = torch.cat([parameter.grad.flatten() for parameter in agent.parameters()]).norm().item()
    assert norms[1e-3] == pytest.approx(1e-3, rel=1e-2) and norms[math.inf] > 0.01


def test_each_pass_takes_every_step_once_in_another_order():
    """Four minibatches of 32 steps; the metrics are those of the last pass."""
    args, seen = small_args(update_epochs=3), []

    def update(minibatch: method.Batch) -> torch.Tensor:
        seen.append(minibatch.actions.tolist())
        return torch.full((5,), float(len(seen)))

    numbers = torch.arange(128)
    batch = method.Batch(torch.zeros(128, 1), numbers, numbers + 0.5, numbers.float(), numbers.float())
    metrics = method.update_agent(update, batch, args)
    passes = [sum(seen[i : i + 4], []) for i in (0, 4, 8)]
    assert [len(rows) for rows in seen] == [32] * 12 and all(sorted(order) == list(range(128)) for order in passes)
    orders = [list(range(128)), *passes]
    assert all(one != other for one, other in itertools.combinations(orders, 2))
    assert set(metrics.values()) == {np.mean([9, 10, 11, 12])} and len(metrics) == 5


def test_the_agent_has_the_mean_of_the_first_frames(small_run):
    """Against 20,000 games that begin; the agent's own is exact."""
    mean = torch.load(small_run / "checkpoint.pt", weights_only=True)["agent"]["obs_mean"].numpy()
    frames, _ = method.FourRoomsVectorEnv(20_000, 11, 22).reset(seed=5)
    assert mean.shape == (22, 22, 3) and mean.max() > 50 and np.abs(mean - frames.mean(0)).max() < 2


def test_no_game_serves_two_purposes(small_run):
    """Training, evaluation and demonstrations begin with other seeds."""
    shown = set()
    for path in (small_run / "demos").glob("*.npz"):
        with np.load(path) as arrays:
            shown.add(int(arrays["seed"]))
    scored = set(json.loads((small_run / "evaluation.json").read_text())["seeds"])
    training = {method.episode_seed(1, i, n) for i in range(8) for n in range(1_000)}
    assert (len(scored), len(shown)) == (5, 3)
    for one, other in itertools.combinations((training, scored, shown), 2):
        assert not one & other


def test_small_run_leaves_its_records(small_run):
    rows = (small_run / "updates.csv").read_text().splitlines()
    assert len(rows) == 7 and rows[0].startswith("global_step,charts/learning_rate,losses/policy_loss")
    evaluation = json.loads((small_run / "evaluation.json").read_text())
    assert evaluation["mode"] == "greedy" and 0.7 < evaluation["optimal"] < 0.99 and evaluation["episodes"] == 5
    assert evaluation["max"] <= 0.991 and json.loads((small_run / "result.json").read_text())["complete"]
    assert (small_run / "learning_curve.png").read_bytes()[1:4] == b"PNG"


def test_demonstrations_are_whole_and_can_be_played_again(small_run):
    manifest = json.loads((small_run / "demos" / "manifest.json").read_text())
    assert manifest["env_id"] == "FourRooms11-v0" and len(manifest["files"]) == 3
    env = method.make_env("FourRooms11-v0")
    for name in manifest["files"]:
        with np.load(small_run / "demos" / name) as arrays:
            episode = dict(arrays)
        obs, info = env.reset(seed=int(episode["seed"]))
        for t, action in enumerate(episode["actions"]):
            assert np.array_equal(obs, episode["observations"][t])
            assert np.array_equal(info["state"], episode["states"][t]) and info["room"] == episode["rooms"][t]
            obs, reward, terminated, truncated, info = env.step(int(action))
            assert reward == episode["rewards"][t]
        assert np.array_equal(obs, episode["observations"][-1]) and info["room"] == episode["rooms"][-1]
        assert (terminated, truncated) == (episode["terminated"], episode["truncated"])


def test_demonstrations_with_noise(small_run, tmp_path):
    """Of a finished run, beside those without noise: all actions random, so that each comes in a third of the steps."""
    shutil.copytree(small_run, tmp_path / "run")
    flags = ["--save-model", "--save-demos", 40, "--demo-noise", 1, "--resume"]
    run(*SMALL, *flags, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    manifest = json.loads((tmp_path / "run" / "demos_noise_1" / "manifest.json").read_text())
    assert manifest["noise"] == 1 and len(manifest["files"]) == 40 and (tmp_path / "run" / "demos").is_dir()
    actions = [np.load(tmp_path / "run" / "demos_noise_1" / name)["actions"] for name in manifest["files"]]
    shares = np.bincount(np.concatenate(actions), minlength=3) / sum(map(len, actions))
    assert abs(shares - 1 / 3).max() < 0.05


def test_same_seed_same_bytes_and_another_seed_others(small_run, tmp_path):
    run(*SMALL, "--run-dir", "again", cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "again")
    run(*SMALL, "--run-dir", "other", "--seed", 2, cwd=tmp_path, script=SCRIPT)
    assert (small_run / "updates.csv").read_bytes() != (tmp_path / "other" / "updates.csv").read_bytes()


def assert_same_states(left, right) -> None:
    for name in ("episodes.csv", "updates.csv", "evaluation.json"):
        assert (left / name).read_bytes() == (right / name).read_bytes(), name
    states = [torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (left, right)]
    for name in ("agent", "collector"):
        for key, value in states[0][name].items():
            assert torch.equal(value, states[1][name][key]), (name, key)
    for number, moments in states[0]["optimizer"]["state"].items():
        for key, value in moments.items():
            assert torch.equal(value, states[1]["optimizer"]["state"][number][key]), (number, key)


def test_demonstrations_of_an_earlier_player_are_refused(small_run, tmp_path, capsys):
    """The player of step 384 is gone once the run has come further."""
    shutil.copytree(small_run, tmp_path / "run")
    flags = [*SMALL, "--stop-at", 384, "--save-demos", 1, "--run-dir", tmp_path / "run", "--resume"]
    assert_refused(method, capsys, flags, ["--stop-at 384", "is at step"])
    assert (tmp_path / "run" / "result.json").exists()


@pytest.mark.parametrize("torn", [False, True])
def test_a_stopped_run_goes_on_to_the_same_bytes(small_run, tmp_path, torn):
    flags = [*SMALL, "--run-dir", "run", "--resume"]
    run(*flags, "--stop-at", 384, cwd=tmp_path, script=SCRIPT)
    if torn:  # the one before it is taken; the records are cut back
        path = tmp_path / "run" / "checkpoint.pt"
        path.write_bytes(path.read_bytes()[:1000])
        with open(tmp_path / "run" / "episodes.csv", "a") as file:
            file.write("999,0,1\n")
    run(*flags, cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "run")


@needs_compiler
def test_compiled_and_plain_agree(tmp_path):
    """The same minibatch, the same parameters: parts of the loss and gradients."""
    args = small_args(channels=4, hidden_size=16)
    results = []
    for compiles in (False, True):
        torch.manual_seed(0)
        args.compile = compiles
        agent = method.Agent(args.frame_side, 3, 4, 16)
        update = method.Update(agent, args)
        assert update.is_compiled == compiles
        parts = [update(random_minibatch()) for _ in range(3)]
        results.append((torch.stack(parts), torch.cat([value.detach().flatten() for value in agent.parameters()])))
    assert torch.allclose(results[0][0], results[1][0], atol=1e-4)
    assert torch.allclose(results[0][1], results[1][1], atol=1e-4)


def test_bfloat16_and_float32_agree():
    """The same minibatch, the same parameters: policy and values, and the direction of the gradient."""
    batch, results = random_minibatch(), []
    for bf16 in (False, True):
        torch.manual_seed(0)
        agent = method.Agent(22, 3, 8, 32, bf16)
        made = agent(batch.obs)
        assert all(part.dtype == torch.float32 for part in made)
        method.ppo_loss(*made, batch, 0.2, 0.01, 0.5)[0].backward()
        gradient = torch.cat([parameter.grad.flatten() for parameter in agent.parameters()])
        results.append((*(part.detach() for part in made), gradient))
    single, half = results
    assert not torch.equal(single[2], half[2])
    assert torch.allclose(single[0], half[0], atol=2e-3) and torch.allclose(single[1], half[1], rtol=0.02, atol=0.02)
    assert torch.cosine_similarity(single[2], half[2], 0) > 0.995


def test_a_folder_of_another_run_is_refused(small_run, tmp_path):
    words = ["--seed 2 (was 1)", "must be as in"]
    done = run(*SMALL, "--run-dir", small_run, "--resume", "--seed", 2, cwd=tmp_path, code=2, script=SCRIPT)
    assert all(word in done.stderr for word in words) and done.stderr.count("\n") == 1


@pytest.mark.parametrize("mode", ["greedy", "sampled"])
def test_play_draws_or_takes_the_best(mode):
    args, agent = small_args(), method.Agent(22, 3, 4, 16)
    with torch.no_grad():
        agent.actor.weight.zero_()
        agent.actor.bias.copy_(torch.tensor([0.2, 0.5, 0.3]).log())
    actions = np.concatenate([episode["actions"] for episode in method.play(agent, args, list(range(200)), mode)])
    shares = np.bincount(actions, minlength=3) / len(actions)
    assert np.allclose(shares, [0, 1, 0] if mode == "greedy" else [0.2, 0.5, 0.3], atol=0.02)


def test_the_optimal_return_is_that_of_shortest_ways(tmp_path, monkeypatch):
    """By breadth-first search from the starts of the episodes that were played."""
    args, maze = small_args(eval_episodes=40), method.maze(11)
    agent, played, play = method.Agent(args.frame_side, 3, 4, 16), [], method.play
    monkeypatch.setattr(method, "play", lambda *its: played.extend(found := play(*its)) or found)
    evaluation = method.evaluate(agent, args, tmp_path)
    starts = [episode["states"][0].tolist() for episode in played]
    steps = [brute_force_steps(maze, 4 * cell + direction, goal) for cell, direction, goal in starts]
    assert len(steps) == 40 and evaluation["optimal"] == pytest.approx(np.mean([1 - 0.9 * n / 100 for n in steps]))
    assert evaluation["solved"] == np.mean([episode["rewards"].sum() > 0 for episode in played])


def test_parameters_that_explode_end_the_run(tmp_path):
    flags = [*SMALL[:-1], 1e30, "--max-grad-norm", "inf", "--run-dir", "run"]
    done = run(*flags, cwd=tmp_path, code=1, script=SCRIPT)
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


def test_copied_alone(small_run, tmp_path):
    (tmp_path / "mine.py").write_text(SCRIPT.read_text())
    run(*SMALL, "--run-dir", "run", cwd=tmp_path, script=tmp_path / "mine.py", PYTHONSAFEPATH="1")
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_killed_runs_end_with_the_same_bytes(tmp_path, seed):
    flags = [*SMALL, "--total-timesteps", 25_600, "--seed", seed]
    run(*flags, "--run-dir", tmp_path / "whole", cwd=tmp_path, script=SCRIPT)
    kill_twice([*flags, "--run-dir", str(tmp_path / "run")], 12, seed, SCRIPT, after_checkpoints=True)
    run(*flags, "--run-dir", tmp_path / "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert_same_states(tmp_path / "whole", tmp_path / "run")


def test_learning_rate_is_annealed(small_run):
    rates = [float(line.split(",")[1]) for line in (small_run / "updates.csv").read_text().splitlines()[1:]]
    assert np.allclose(rates, 0.01 * (1 - np.arange(6) / 6)) and not math.isnan(sum(rates))
    optimizer = torch.load(small_run / "checkpoint.pt", weights_only=True)["optimizer"]
    assert optimizer["param_groups"][0]["lr"] == pytest.approx(0.01 / 6)


def test_table_of_the_players(small_run, tmp_path):
    shutil.copytree(small_run, tmp_path / "runs" / "11_seed1")
    rows = fourrooms_players.read_runs(tmp_path / "runs")
    evaluation = json.loads((small_run / "evaluation.json").read_text())
    assert rows[0]["greedy"] == evaluation["mean"] and rows[0]["steps"] == 768
    line = fourrooms_players.table(rows).splitlines()[2]
    assert line.startswith("| FourRooms11-v0 | 1 | 768 | 0 |")
    assert f"| {evaluation['mean'] / evaluation['optimal']:.3f} |" in line


@pytest.mark.parametrize(
    "words, complaint",
    [([], "required"), (["FourRooms11-v0", "0", "9"], "0: must be at least 1"), (["Chess", "1", "9"], "Chess: no env")],
)
def test_wrong_words_for_the_timing_are_one_line(words, complaint, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["fourrooms_steps.py", *words])
    with pytest.raises(SystemExit) as stop:
        run_main(fourrooms_steps.main, fourrooms_steps.Args, fourrooms_steps.__doc__)
    err = capsys.readouterr().err
    assert stop.value.code == 2 and err.startswith("error: ") and complaint in err and err.count("\n") == 1


def test_the_timing_takes_one_game_and_many(monkeypatch, capsys):
    for games in (1, 8):
        monkeypatch.setattr(sys, "argv", ["fourrooms_steps.py", "FourRooms11-v0", str(games), "20"])
        run_main(fourrooms_steps.main, fourrooms_steps.Args, fourrooms_steps.__doc__)
        assert json.loads(capsys.readouterr().out)["steps_per_second"] > 0


def play_once(player: fourrooms_cuts.Player, pose: int, goal: int, ends, rng) -> tuple[int, int]:
    """Where a segment is left, and after how many steps, by playing it."""
    for t in range(1, 101):
        following = player.moves(pose, goal)
        pose = int(rng.choice(list(following), p=list(following.values())))
        if pose == fourrooms_cuts.END or ends(pose, t):
            return pose, t
    raise AssertionError


def test_entries_of_segments_are_those_of_play():
    """Where a room is left, and after how long, by the recursion and by playing it 4,000 times."""
    player, rng = fourrooms_cuts.Player(0.1), np.random.default_rng(0)
    pose, goal = (int(value) for value in player.maze.starts[5_000])
    ends = fourrooms_cuts.by_label(player.maze.rooms)(pose)
    left, length = fourrooms_cuts.entry(player, pose, goal, ends)
    played = [play_once(player, pose, goal, ends, rng) for _ in range(4_000)]
    assert sum(left.values()) == pytest.approx(1, abs=1e-4)
    assert length == pytest.approx(np.mean([t for _, t in played]), rel=0.05)
    for after, share in left.items():
        assert share == pytest.approx(np.mean([where == after for where, _ in played]), abs=0.03)


def test_costs_of_segments_known_by_hand():
    """A read at every step tells one bit wherever two actions are as good; one that never comes tells nothing."""
    player, starts = fourrooms_cuts.Player(0.0), method.maze(11).starts[::997]
    rate, bits = fourrooms_cuts.cost(player, starts, lambda begin: lambda pose, t: False)
    assert (rate, bits) == (0, 0)
    rate, bits = fourrooms_cuts.cost(player, starts, lambda begin: lambda pose, t: True)
    lengths = player.steps[starts[:, 0], starts[:, 1]]
    assert rate == pytest.approx((lengths - 1).sum() / lengths.sum()) and 0 < bits < 0.5
