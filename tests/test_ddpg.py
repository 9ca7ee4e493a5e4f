"""DDPG: its targets, losses, update, noise and replay buffer against independent sources."""

import copy

import gymnasium as gym
import numpy as np
import pytest
import scipy.stats
import torch
from conftest import Counter, needs_compiler

from cleanrl_thesis import ddpg_torcs_like as ddpg

OBS, ACTIONS = 5, 2


def make(**flags):
    """Agent, optimiser, update and a minibatch of random transitions."""
    args = ddpg.Args(**{"hidden_size": 16, "batch_size": 32, "num_envs": 3, **flags})
    torch.manual_seed(0)
    agent = ddpg.Agent(OBS, ACTIONS, args.hidden_size, args.layer_norm)
    optimizer = ddpg.FlatAdam(agent, args)
    optimizer.target.add_(0.1 * torch.randn_like(optimizer.target))
    rows = torch.randn(32, 2 * OBS + ACTIONS + 2)
    rows[:, OBS + ACTIONS + 1] = 0.99 * (torch.rand(32) < 0.8)
    norm = ddpg.RunningNorm(agent.obs_scale, args.norm_obs)
    norm.update(np.random.default_rng(0).normal(1, 2, (50, OBS)).astype(np.float32))
    return args, agent, optimizer, ddpg.Update(agent, optimizer, norm, args, rows), rows


def peer_networks(agent, optimizer):
    """Copies of the networks and of the target networks as usual modules."""
    peer, target = copy.deepcopy(agent), copy.deepcopy(agent)
    for network, vector in ((peer, optimizer.vector), (target, optimizer.target)):
        for parameter, value in zip(network.parameters(), ddpg.views(vector.clone(), optimizer.shapes)):
            parameter.data = value.clone()
    return peer, target


@pytest.mark.parametrize("layer_norm", [True, False])
def test_an_update_is_that_of_two_torch_optimisers(layer_norm):
    """Lillicrap et al., 2016, Algorithm 1, with both gradients taken before either step, and L2 on the critic's weights."""
    args, agent, optimizer, update, rows = make(layer_norm=layer_norm)
    peer, target = peer_networks(agent, optimizer)
    actor_adam = torch.optim.Adam(peer.actor.parameters(), 1e-4)
    critic_adam = torch.optim.Adam(peer.critic.parameters(), 1e-3)
    for _ in range(5):
        parts = update(rows)
        obs, actions, rewards, discounts, next_obs = rows.split([OBS, ACTIONS, 1, 1, OBS], 1)
        obs, next_obs = (((part - agent.obs_scale[0]) / agent.obs_scale[1]).clip(-5, 5) for part in (obs, next_obs))
        with torch.no_grad():
            goal = rewards[:, 0] + discounts[:, 0] * target.critic(next_obs, target.actor(next_obs))
        error = ((peer.critic(obs, actions) - goal) ** 2).mean()
        decay = sum((layer.weight**2).sum() for layer in (peer.critic.first, peer.critic.second))
        actor_loss = -peer.critic(obs, peer.actor(obs)).mean()
        assert torch.allclose(torch.stack(parts[:2]), torch.stack([error, actor_loss]), rtol=1e-4, atol=1e-6)
        gradients = torch.autograd.grad(actor_loss, list(peer.actor.parameters()))
        critic_adam.zero_grad()
        (error + 0.5 * args.critic_l2 * decay).backward()
        for parameter, gradient in zip(peer.actor.parameters(), gradients):
            parameter.grad = gradient
        critic_adam.step()
        actor_adam.step()
        with torch.no_grad():
            for slow, fast in zip(target.parameters(), peer.parameters()):
                slow.mul_(1 - args.tau).add_(args.tau * fast)
    for ours, theirs in ((optimizer.vector, peer), (optimizer.target, target)):
        flat = torch.cat([parameter.detach().reshape(-1) for parameter in theirs.parameters()])
        assert torch.allclose(ours, flat, atol=5e-6)


def test_observations_are_normalised_by_all_that_came():
    """As numpy's mean and deviation, at least 0.1 of it, clipped to 5; restored; and left alone with --no-norm-obs."""
    obs = np.random.default_rng(0).normal(3, [2, 0.5, 0.01], (1_000, 3)).astype(np.float32)
    norm = ddpg.RunningNorm(torch.tensor([[0.0] * 3, [1.0] * 3]), True)
    for part in np.split(obs, 100):
        norm.update(part)
    expected = (obs - obs.mean(0)) / np.maximum(obs.std(0), 0.1)
    assert np.allclose(norm(obs), expected, atol=1e-4) and np.abs(norm(obs + 100)).max() == 5
    again = ddpg.RunningNorm(torch.zeros(2, 3), True)
    again.load_state_dict(norm.state_dict())
    for each in (norm, again):
        each.update(obs[:7])
    assert np.array_equal(again(obs), norm(obs)) and torch.equal(again.scale, norm.scale)
    off = ddpg.RunningNorm(torch.tensor([[0.0] * 3, [1.0] * 3]), False)
    off.update(obs)
    assert np.array_equal(off(obs), obs)


@needs_compiler
def test_compiled_update_is_the_plain_one():
    (*_, plain_optimizer, plain, rows), (*_, optimizer, compiled, _) = make(), make(compile=True)
    assert compiled.is_compiled and not plain.is_compiled
    for _ in range(20):
        parts = [torch.stack(update(rows)) for update in (plain, compiled)]
        assert torch.allclose(parts[0], parts[1], rtol=1e-4, atol=1e-5)
    assert torch.allclose(plain_optimizer.vector, optimizer.vector, atol=1e-5)
    assert torch.allclose(plain_optimizer.target, optimizer.target, atol=1e-5)


@pytest.mark.parametrize("compile", [False, pytest.param(True, marks=needs_compiler)])
def test_learning_rates_are_annealed(compile):
    """An update is as long as the share of the learning rates that is left, and at 0 none."""
    *_, optimizer, update, rows = make(compile=compile)
    lengths = []
    for remaining in (1.0, 0.5, 0.0):
        optimizer.anneal(remaining)
        optimizer.mean.zero_(), optimizer.square.zero_(), optimizer.step.zero_()
        before = optimizer.vector.clone()
        update(rows)
        lengths.append((optimizer.vector - before).norm().item())
    assert lengths[1] == pytest.approx(lengths[0] / 2, rel=1e-2) and lengths[2] == 0


@pytest.mark.parametrize("layer_norm", [True, False])
def test_the_actor_in_numpy_is_the_actor_in_torch(layer_norm):
    _, agent, optimizer, *_ = make(layer_norm=layer_norm)
    obs = torch.randn(7, OBS)
    parameters = optimizer.actor_arrays(optimizer.actor_vector())
    with torch.no_grad():
        agent.actor.output.weight.mul_(300)  # numpy sees the change: it shares the memory
        assert np.allclose(ddpg.numpy_actions(parameters, obs.numpy()), agent.actor(obs), atol=1e-6)
    many = optimizer.actor_arrays(np.stack([optimizer.actor_vector() * share for share in np.linspace(0.5, 1, 7)]))
    for i in range(7):
        one = {name: array[i] for name, array in many.items()}
        assert np.allclose(ddpg.numpy_actions(many, obs.numpy())[i], ddpg.numpy_actions(one, obs.numpy()[i : i + 1])[0])


def test_noise_is_on_all_parameters_but_the_norms():
    args, agent, optimizer, *_ = make()
    noise = ddpg.ParameterNoise(optimizer, args, ACTIONS, np.random.default_rng(0))
    draws = np.stack([noise.draw() for _ in range(4_000)]) - optimizer.actor_vector()
    parts = optimizer.actor_arrays(draws)
    for name, part in parts.items():
        deviation = part.reshape(4_000, -1).std(0)
        assert (deviation == 0).all() if "norm" in name else np.allclose(deviation, args.noise_std, rtol=0.1)


def test_the_size_of_the_noise_goes_to_where_actions_are_as_far_as_asked():
    args, agent, optimizer, *_ = make()
    with torch.no_grad():
        agent.actor.output.weight.mul_(100)
    noise = ddpg.ParameterNoise(optimizer, args, ACTIONS, np.random.default_rng(0))
    obs = np.random.default_rng(1).standard_normal((64, OBS)).astype(np.float32)
    distances = [noise.adapt(obs) for _ in range(1_500)]
    assert np.mean(distances[-500:]) == pytest.approx(args.noise_std, rel=0.15)
    before = noise.size
    assert (noise.adapt(obs) > args.noise_std) == (noise.size < before)
    assert max(noise.size, before) / min(noise.size, before) == pytest.approx(1.01)


def test_noise_on_actions_goes_on_through_an_episode(tmp_path, monkeypatch):
    """`--perturb-interval` is of perturbed actors alone; the noise begins with each episode."""
    begun = []
    monkeypatch.setattr(ddpg.ActionNoise, "begin", lambda noise, i: begun.append(i))
    flags = ["--env-id", "Pendulum-v1", "--noise", "ou", "--total-timesteps", 1_500, "--num-envs", 5]
    flags += ["--batch-size", 16, "--perturb-interval", 10, "--keep-best-every", 0, "--eval-episodes", 1]
    flags += ["--run-dir", tmp_path / "run"]
    assert ddpg.cli([str(flag) for flag in flags]) == 0
    episodes = ddpg.read_episodes(tmp_path / "run")
    assert len(episodes) >= 5 and len(begun) in (len(episodes), len(episodes) + 5)


def test_each_environment_has_a_perturbed_actor_of_its_own():
    args, _, optimizer, *_ = make(noise_ladder=False)
    noise = ddpg.ParameterNoise(optimizer, args, ACTIONS, np.random.default_rng(0))
    for i in range(3):
        noise.begin(i)
    obs = np.tile(np.ones(OBS, np.float32), (3, 1))
    first = noise.act(obs)
    assert len(np.unique(first, axis=0)) == 3
    noise.begin(1)
    assert (noise.act(obs) == first).all(1).tolist() == [True, False, True]


@pytest.mark.parametrize("kind", ["parameter", "gaussian"])
def test_the_noise_falls_from_the_first_environment_to_the_last(kind):
    args, agent, optimizer, *_ = make(noise=kind, num_envs=5)
    with torch.no_grad():
        agent.actor.output.weight.mul_(10)
    explorer = ddpg.ParameterNoise if kind == "parameter" else ddpg.ActionNoise
    noise = explorer(optimizer, args, ACTIONS, np.random.default_rng(0))
    obs = np.ones((5, OBS), np.float32)
    ways = []
    for _ in range(300):
        for i in range(5):
            noise.begin(i)
        ways.append(noise.act(obs) - ddpg.numpy_actions(optimizer.actor_arrays(optimizer.actor_vector()), obs))
    sizes = np.square(ways).mean((0, 2)) ** 0.5
    assert (np.diff(sizes) < 0).all() and sizes[-1] < 1e-6
    assert ddpg.noise_shares(ddpg.Args(num_envs=1)).tolist() == [1]


@pytest.mark.parametrize("kind", ["gaussian", "ou", "none"])
def test_noise_on_actions(kind):
    """A Gaussian's deviation is as given; the Ornstein-Uhlenbeck process goes steps of 0.1 σ, and 0.01 θ back to 0."""
    args, _, optimizer, *_ = make(noise=kind, noise_ladder=False)
    noise = ddpg.ActionNoise(optimizer, args, ACTIONS, np.random.default_rng(0))
    obs = np.zeros((3, OBS), np.float32)
    actions = np.stack([noise.act(obs) for _ in range(500 if kind == "ou" else 20_000)])
    greedy = ddpg.numpy_actions(optimizer.actor_arrays(optimizer.actor_vector()), obs)
    if kind == "ou":
        rng, expected = np.random.default_rng(0), np.zeros((3, ACTIONS))
        for _ in range(500):
            expected = expected - 0.15 * 0.01 * expected + 0.1 * 0.2 * rng.standard_normal((3, ACTIONS))
        assert np.allclose(noise.noise, expected, atol=1e-4) and np.allclose(actions[-1], greedy + expected, atol=1e-4)
        noise.begin(1)
        assert (noise.noise[1] == 0).all() and (noise.noise[0] != 0).all()
    else:
        assert np.allclose((actions - greedy).std(), 0.2 if kind == "gaussian" else 0, rtol=0.02)


def test_the_ring_keeps_the_last_transitions(tmp_path):
    buffer = ddpg.ReplayBuffer(tmp_path / "replay.dat", capacity=10, spare=4, width=8)
    for i in range(0, 36, 3):
        numbers = np.arange(i, i + 3, dtype=np.float64)
        pairs = np.repeat(numbers[:, None], 2, 1)
        buffer.add(pairs, pairs + 0.5, numbers, np.full(3, 0.9), pairs + 1)
    rows = buffer.sample(3_000, np.random.default_rng(0))
    assert sorted(set(rows[:, 4].tolist())) == list(range(26, 36))
    assert torch.equal(rows[:, 0], rows[:, 4]) and torch.equal(rows[:, 2], rows[:, 4] + 0.5)
    assert torch.equal(rows[:, 7], rows[:, 4] + 1) and torch.allclose(rows[:, 5], torch.tensor(0.9))
    counts = np.bincount(rows[:, 4].numpy().astype(int) - 26)
    assert scipy.stats.chisquare(counts).pvalue > 1e-3
    again = ddpg.ReplayBuffer(tmp_path / "replay.dat", capacity=10, spare=4, width=8, added=36)
    assert np.array_equal(again.array, buffer.array)


def test_players_return_the_real_next_observation_and_go_on():
    players = ddpg.GymPlayers([Counter(), Counter()], seed=0)
    players.start()
    for episode in range(3):
        for t in range(1, 5):
            steps = players.step(np.zeros((2, 1)))
            assert steps.next_obs[:, 0].tolist() == [t, t]
            assert steps.terminated.tolist() == [t == 4 and episode % 2 == 0] * 2
            assert steps.ended == ([(0, 4.0, 4), (1, 4.0, 4)] if t == 4 else [])
            assert players.obs[:, 0].tolist() == [t % 4, t % 4]


def test_cars_have_seeds_of_their_own_and_are_restored():
    """As the single environment's; and in a second instance from the saved arrays, bit for bit."""

    def begin():
        return ddpg.CarPlayers(ddpg.TorcsLikeVectorEnv(3), seed=5)

    players, rng = begin(), np.random.default_rng(0)
    players.start()
    single = ddpg.TorcsLikeEnv()
    assert np.array_equal(single.reset(seed=ddpg.episode_seed(5, 2, 0))[0], players.obs[2])
    ended = []
    for _ in range(400):
        ended += players.step(rng.uniform([0, 0.2], [0.3, 1], (3, 2))).ended
    assert len(ended) > 3
    other = begin()
    assert other.load_state_dict(copy.deepcopy(players.state_dict()))
    for _ in range(400):
        actions = rng.uniform([0, 0.2], [0.3, 1], (3, 2))
        ours, theirs = players.step(actions), other.step(actions)
        assert np.array_equal(ours.next_obs, theirs.next_obs) and np.array_equal(players.obs, other.obs)
        assert ours.ended == theirs.ended


# Scores
def test_window_scores_by_hand():
    """Windows of 250 steps: whole, of a crash, cut short; one who stands still from the start has 0."""
    drive = np.full(600, 0.5)
    assert ddpg.window_scores(drive, False) == [125.0, 125.0]
    crash = np.append(drive[:400], -1.0)
    assert ddpg.window_scores(crash, True) == [125.0, 0.0]
    assert ddpg.window_scores(drive[:500], True) == [125.0, 0.0]
    assert ddpg.window_scores(np.array([0.5, -1.0]), True) == [0.0]
    assert ddpg.window_scores(np.full(20, 0.5), False) == []
    stands = np.zeros(51)
    episodes = [(drive, False), (crash, True), (stands, True)]
    scores = ddpg.driving_scores([{"rewards": r, "terminated": np.array(t)} for r, t in episodes], 100.0)
    assert scores["metres_in_5_s"]["mean"] == (125 + 62.5 + 0) / 3 and scores["score"]["max"] == 450
    assert (scores["crashes"], scores["standstills"], scores["laps"]) == (1, 1, [3.0, 2.0, 0.0])


def test_actions_are_scaled_to_the_bounds():
    space = gym.spaces.Box(np.array([-2, 0], np.float32), np.array([2, 1], np.float32))
    scaled = ddpg.scaled(np.array([[-1.0, -1.0], [0.0, 0.0], [1.0, 1.0]]), space)
    assert scaled.tolist() == [[-2, 0], [0, 0.5], [2, 1]]


def test_an_action_is_held_until_its_end_or_the_episode_s():
    """Rewards are summed up to the end of the episode; what the next one does with the rest of the action is left out."""
    players = ddpg.GymPlayers([Counter(), Counter()], seed=0)
    players.start()
    ddpg.step_and_hold(players, np.zeros((2, 1)), 1)
    steps = ddpg.step_and_hold(players, np.zeros((2, 1)), 2)
    assert (steps.next_obs[:, 0].tolist(), steps.rewards.tolist(), steps.ended) == ([3, 3], [2, 2], [])
    steps = ddpg.step_and_hold(players, np.zeros((2, 1)), 3)
    assert steps.next_obs[:, 0].tolist() == [4, 4] and steps.rewards.tolist() == [1, 1]
    assert steps.terminated.tolist() == [True, True] and [i for i, _, _ in steps.ended] == [0, 1]
    assert players.obs[:, 0].tolist() == [2, 2]


def test_held_cars_are_those_whose_sensors_work_in_every_step():
    """The steps between are driven without sensors: same rewards, ends and observations, through crashes."""
    players, others = (ddpg.CarPlayers(ddpg.TorcsLikeVectorEnv(3), seed=5) for _ in range(2))
    rng, ends = np.random.default_rng(0), 0
    for each in (players, others):
        each.start()
    for _ in range(150):
        actions = rng.uniform([0, 0.2], [0.3, 1], (3, 2))
        held = ddpg.step_and_hold(players, actions, 5)
        ended, rewards, terminated = [], np.zeros(3), np.zeros(3, bool)
        next_obs = np.zeros((3, 65), np.float32)
        for _ in range(5):
            steps = others.step(actions)
            for i in {0, 1, 2} - {i for i, _, _ in ended}:
                rewards[i] += steps.rewards[i]
                next_obs[i], terminated[i] = steps.next_obs[i], steps.terminated[i]
            ended += steps.ended
        ends += len(ended)
        assert held.ended == ended and np.array_equal(players.obs, others.obs)
        assert np.array_equal(held.next_obs, next_obs)
        assert np.array_equal(held.rewards, rewards) and np.array_equal(held.terminated, terminated)
    assert ends > 3


def test_a_held_policy_acts_anew_every_few_steps():
    act = ddpg.held(lambda obs: obs.copy(), 3)
    assert [act(np.array([t])).item() for t in range(7)] == [0, 0, 0, 3, 3, 3, 6]


def test_the_best_policy_is_kept(monkeypatch):
    """Of mean returns 1, 3 and 4, the last with a deviation of 2: the second; with the normalisation and critic that it had."""
    args, _, optimizer, update, _ = make()
    best, space = ddpg.Best(optimizer, update.norm), gym.spaces.Box(-1, 1, (ACTIONS,))
    returns, vectors, scales = iter([(1.0, 1.0), (3.0, 3.0), (2.0, 6.0)]), [], []
    monkeypatch.setattr(ddpg, "make_games", lambda args, number: None)
    monkeypatch.setattr(ddpg, "play", lambda *_: [{"rewards": np.array([value])} for value in next(returns)])
    for step in (10, 20, 30):
        vectors.append(optimizer.vector.clone())
        scales.append(update.norm.scale.clone())
        best.consider(args, space, step)
        optimizer.vector.add_(1.0)
        update.norm.update(np.ones((50, OBS), np.float32))
    again = ddpg.Best(optimizer, update.norm)
    again.load_state_dict(best.state_dict())
    again.restore()
    assert torch.equal(optimizer.vector, vectors[1]) and torch.equal(update.norm.scale, scales[1])
    assert (again.step, again.score) == (20, 3.0)
    assert best.last_mean_return == 4
    obs = np.ones((2, OBS), np.float32)
    assert np.allclose(update.norm(obs), (obs - scales[1][0].numpy()) / scales[1][1].numpy())


def test_the_best_policy_is_found_by_play_that_holds_its_actions(monkeypatch):
    args, _, optimizer, update, _ = make(frame_skip=2)
    best, acts = ddpg.Best(optimizer, update.norm), []

    def play(policy, games, seeds):
        acts.extend(policy(np.full((len(seeds), OBS), t, np.float32)) for t in range(3))
        return [{"rewards": np.zeros(3)}]

    monkeypatch.setattr(ddpg, "make_games", lambda args, number: None)
    monkeypatch.setattr(ddpg, "play", play)
    best.consider(args, gym.spaces.Box(-1, 1, (ACTIONS,)), 10)
    assert np.array_equal(acts[0], acts[1]) and not np.array_equal(acts[1], acts[2])


def test_returns_of_the_cars_are_those_of_their_episodes():
    players = ddpg.CarPlayers(ddpg.TorcsLikeVectorEnv(3), 5)
    players.start()
    rng, totals, lengths, ends = np.random.default_rng(0), np.zeros(3), np.zeros(3, int), 0
    for _ in range(600):
        steps = players.step(rng.uniform([0.0, 0.2], [0.3, 1.0], (3, 2)))
        totals += steps.rewards
        lengths += 1
        for i, episodic_return, length in steps.ended:
            assert (episodic_return, length) == (pytest.approx(totals[i]), lengths[i])
            totals[i] = lengths[i] = 0
            ends += 1
    assert ends > 3
