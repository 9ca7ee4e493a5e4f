"""The Apple game: its rules, its two environments, and the DQN that learns it, against independent sources."""

import math
from types import SimpleNamespace

import gymnasium as gym
import numpy as np
import pytest
import scipy.stats
import torch
from conftest import needs_compiler
from gymnasium.utils.env_checker import check_env

from cleanrl_thesis import dqn_apple as dqn

STAY = 4


def action(x: int, y: int) -> int:
    return (y + 1) * 3 + x + 1


# The game
def test_games_have_spaces_of_their_own():
    """Else what one of them samples changes what another does."""
    envs = [gym.make("cleanrl_thesis.dqn_apple:AppleGame-v0") for _ in range(2)]
    for env in envs:
        env.action_space.seed(1)
    one, other = ([env.action_space.sample() for _ in range(20)] for env in envs)
    assert one == other and len(set(one)) > 1


def test_a_seed_for_each_game():
    games = dqn.AppleGameVectorEnv(4)
    for seeds in ([1, 2], [1, 2, 3, 4, 5]):
        with pytest.raises(ValueError, match=f"{len(seeds)} seeds for 4 games"):
            games.reset(seed=seeds)


def test_the_single_game_is_an_environment():
    env = gym.make("cleanrl_thesis.dqn_apple:AppleGame-v0", render_mode="rgb_array")
    check_env(env.unwrapped)
    assert env.observation_space.shape == (6,) and env.action_space.n == 9
    assert env.metadata["render_fps"] == 60


def test_the_vectorised_game_is_made_by_its_name():
    name = "cleanrl_thesis.dqn_apple:AppleGame-v0"
    games = gym.make_vec(name, num_envs=4096, vectorization_mode="vector_entry_point")
    obs, _ = games.reset(seed=1)
    assert obs.shape == (4096, 6) and games.observation_space.contains(obs)
    assert len(np.unique(obs[:, 2])) > 4000  # each game has apples of its own
    again, _ = games.reset(seed=1)
    assert np.array_equal(obs, again)


def test_single_and_vectorised_game_agree_over_100_000_random_steps():
    seeds, steps = [3, 1, 4, 15], 25_000
    games = gym.make_vec("AppleGame-v0", num_envs=4, vectorization_mode="vector_entry_point")
    singles = [gym.make("AppleGame-v0") for _ in seeds]
    rng, ends = np.random.default_rng(0), 0
    obs, _ = games.reset(seed=seeds)
    assert np.array_equal(obs, [single.reset(seed=seed)[0] for single, seed in zip(singles, seeds)])
    for _ in range(steps):
        actions = rng.integers(0, 9, 4)
        obs, rewards, terminations, truncations, infos = games.step(actions)
        for i, single in enumerate(singles):
            single_obs, reward, terminated, truncated, _ = single.step(actions[i])
            assert (reward, terminated, truncated) == (rewards[i], terminations[i], truncations[i])
            if truncated:
                ends += 1
                assert infos["_final_obs"][i] and np.array_equal(infos["final_obs"][i], single_obs)
                single_obs, _ = single.reset()
            assert np.array_equal(obs[i], single_obs)
    assert ends == 4 * (steps // 1800)


def test_an_episode_is_30_seconds_and_a_truncation():
    env = gym.make("AppleGame-v0")
    env.reset(seed=0)
    ends = [env.step(STAY)[2:4] for _ in range(1800)]
    assert ends == [(False, False)] * 1799 + [(False, True)]


@pytest.mark.parametrize("x", [-1, 0, 1])
@pytest.mark.parametrize("y", [-1, 0, 1])
def test_each_action_moves_by_the_speed_on_each_axis(x, y):
    env = gym.make("AppleGame-v0")
    before, _ = env.reset(seed=0)
    after = env.step(action(x, y))[0]
    assert np.allclose(after[:2] - before[:2], [x * dqn.SPEED, y * dqn.SPEED], atol=1e-6)
    assert np.allclose(after[4:], after[2:4] - after[:2])


def test_the_avatar_stays_on_the_plane():
    env = gym.make("AppleGame-v0")
    env.reset(seed=0)
    for _ in range(300):
        obs = env.step(action(1, -1))[0]
    assert np.array_equal(obs[:2], [1, 0])


def test_an_apple_is_taken_at_the_reach_and_not_before():
    games = dqn.AppleGames(2)
    games.begin(np.arange(2))
    reach = float(dqn.REACH)
    games.apples[:, 0] = 0.5 + reach * 0.7, 0.5 + reach * 0.7  # 0.99 of the reach
    games.apples[:, 1] = 0.5 + reach * 0.72, 0.5 + reach * 0.72
    kept = games.apples[:, 1].copy()
    assert games.step(np.array([STAY, STAY])).tolist() == [True, False]
    assert games.scores.tolist() == [1, 0] and np.array_equal(games.apples[:, 1], kept)
    assert games.ages.tolist() == [0, 1]


def test_an_apple_that_nobody_takes_is_gone_after_its_lifetime():
    games = dqn.AppleGames(1)
    games.begin(np.arange(1))
    games.avatars[:], games.apples[:] = 0, 0.9
    for _ in range(dqn.LIFETIME - 1):
        games.step(np.array([STAY]))
    assert np.allclose(games.apples, 0.9)
    games.step(np.array([STAY]))
    assert not np.allclose(games.apples, 0.9) and games.scores[0] == 0


def test_apples_are_uniform_and_unrelated():
    games = dqn.AppleGames(20_000)
    games.keys[:] = np.arange(20_000)  # even keys that are neighbours
    draws = []
    for _ in range(2):
        games.place_apples(np.arange(20_000))
        draws.append(games.apples.copy())
    columns = [*draws[0], *draws[1]]
    for column in columns:
        assert column.min() >= 0 and column.max() < 1
        assert scipy.stats.kstest(column, "uniform").pvalue > 1e-3
    assert np.abs(np.corrcoef(columns) - np.eye(4)).max() < 0.03
    assert abs(np.corrcoef(columns[0][:-1], columns[0][1:])[0, 1]) < 0.03


def test_mixed_is_splitmix64():
    """Against the first outputs of the published generator for seed 1234567."""
    steps = np.arange(1, 6, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    expected = [
        6457827717110365317,
        3203168211198807973,
        9817491932198370423,
        4593380528125082431,
        16408922859458223821,
    ]
    assert dqn.mixed(np.uint64(1234567) + steps).tolist() == expected


def test_the_shortest_path_player_scores_as_the_thesis_dqn():
    """Table 2.1: 36.27."""

    def shortest(obs: np.ndarray) -> np.ndarray:
        moves = np.where(np.abs(obs[:, 4:]) > dqn.SPEED / 2, np.sign(obs[:, 4:]), 0).astype(int)
        return (moves[:, 1] + 1) * 3 + moves[:, 0] + 1

    returns = [episode["rewards"].sum() for episode in dqn.play(shortest, "AppleGame-v0", list(range(400)))]
    assert abs(np.mean(returns) - 36.27) < 0.75


def test_the_picture_shows_avatar_apple_score_and_time():
    env = gym.make("AppleGame-v0", render_mode="rgb_array")
    env.reset(seed=0)
    games = env.unwrapped.games
    games.apples[:, 0], games.avatars[:, 0] = (0.25, 0.75), (0.75, 0.25)
    picture = env.render()
    assert picture.shape == (528, 480, 3) and picture.dtype == np.uint8
    red, blue = (214, 48, 49), (45, 98, 198)

    def middle(colour):
        y, x = np.nonzero((np.abs(picture.astype(int) - colour) < 10).all(2))
        return x.mean() / 480, (y.mean() - 48) / 480

    assert np.allclose(middle(red), (0.25, 0.75), atol=0.03)
    assert np.allclose(middle(blue), (0.75, 0.25), atol=0.03)
    games.scores[0] = 7
    scored = env.render()
    assert not np.array_equal(picture[:40, :240], scored[:40, :240]) and np.array_equal(
        picture[:, 240:], scored[:, 240:]
    )
    games.frames[0] += 900
    later = env.render()
    assert not np.array_equal(later[:48, 240:], scored[:48, 240:]) and np.array_equal(later[48:], scored[48:])


# The algorithm
def minibatch(size: int = 32, num_actions: int = 9) -> dqn.Minibatch:
    generator = torch.Generator().manual_seed(0)
    obs, next_obs = torch.rand(2, size, 6, generator=generator)
    actions = torch.randint(num_actions, (size,), generator=generator)
    returns = torch.rand(size, generator=generator)
    discounts = torch.where(torch.rand(size, generator=generator) < 0.2, 0.0, 0.97)
    return dqn.Minibatch(obs, actions, returns, discounts, next_obs)


def pack(batch: dqn.Minibatch) -> torch.Tensor:
    columns = (batch.actions.float(), batch.returns, batch.discounts)
    return torch.cat([batch.obs, *(column[:, None] for column in columns), batch.next_obs], 1)


def test_rows_unpack_to_what_was_packed():
    batch = minibatch()
    for column, expected in zip(dqn.Minibatch.unpack(pack(batch)), batch):
        assert torch.equal(column, expected)


@pytest.mark.parametrize("double", [True, False])
def test_td_target_against_a_loop(double):
    batch = minibatch()
    target_q, online_q = torch.randn(2, 32, 9, generator=torch.Generator().manual_seed(1))
    got = dqn.td_target(batch, target_q, online_q if double else None)
    for i in range(32):
        best = max(range(9), key=lambda a: (online_q if double else target_q)[i, a].item())
        expected = batch.returns[i] + batch.discounts[i] * target_q[i, best]
        assert math.isclose(got[i].item(), expected.item(), rel_tol=1e-6)


def test_loss_is_hubers_on_the_taken_action():
    batch = minibatch()
    q, target = torch.randn(32, 9) * 3, torch.randn(32)
    loss, (error, value) = dqn.dqn_loss(q, batch, target)
    differences = [(q[i, batch.actions[i]] - target[i]).item() for i in range(32)]
    huber = [0.5 * d * d if abs(d) < 1 else abs(d) - 0.5 for d in differences]
    assert math.isclose(loss.item(), np.mean(huber), rel_tol=1e-5)
    assert math.isclose(error.item(), np.abs(differences).mean(), rel_tol=1e-5)
    assert math.isclose(value.item(), q[torch.arange(32), batch.actions].mean().item(), rel_tol=1e-5)


def test_dueling_heads_have_the_value_as_mean():
    network = dqn.QNetwork(6, 9, 64, dueling=True)
    obs = torch.rand(5, 6)
    with torch.no_grad():
        assert torch.allclose(network(obs).mean(1), network.value(network.trunk(obs)).squeeze(1), atol=1e-6)


@pytest.mark.parametrize("dueling", [True, False])
def test_numpy_policy_is_the_networks(dueling):
    network = dqn.QNetwork(6, 9, 64, dueling)
    obs = torch.rand(200, 6)
    assert dqn.numpy_greedy(network)(obs.numpy()).tolist() == network(obs).argmax(1).tolist()


def make_update(**settings):
    torch.manual_seed(0)
    args = dqn.complete_args(dqn.Args(**settings))
    agent, target = dqn.QNetwork(6, 9, 64, args.dueling), dqn.QNetwork(6, 9, 64, args.dueling)
    optimizer = dqn.FlatAdam(agent, target, args.learning_rate)
    return agent, target, optimizer, dqn.make_update(agent, target, optimizer, args)


@pytest.mark.parametrize("double", [True, False])
def test_update_is_torchs_adam_on_the_loss(double):
    """Five steps beside torch.optim.Adam, clip_grad_norm_ and a loss that is written anew."""
    agent, target, optimizer, update = make_update(double=double, max_grad_norm=0.1)
    peer = dqn.QNetwork(6, 9, 64, True)
    peer.load_state_dict(agent.state_dict())
    adam = torch.optim.Adam(peer.parameters(), 5e-4, eps=1e-8)
    for _ in range(5):
        batch = minibatch()
        update(pack(batch))
        with torch.no_grad():
            chooser = peer if double else target
            best = chooser(batch.next_obs).argmax(1)
            goal = batch.returns + batch.discounts * target(batch.next_obs)[torch.arange(32), best]
        loss = torch.nn.HuberLoss()(peer(batch.obs)[torch.arange(32), batch.actions], goal)
        adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(peer.parameters(), 0.1)
        adam.step()
    for ours, theirs in zip(agent.parameters(), peer.parameters()):
        assert torch.allclose(ours, theirs, atol=2e-6)
    assert torch.equal(optimizer.target, torch.cat([p.detach().reshape(-1) for p in target.parameters()]))


@needs_compiler
def test_compiled_update_is_the_plain_one():
    plain, compiled = make_update(), make_update(compile=True)
    assert isinstance(compiled[3], dqn.CompiledUpdate)
    for _ in range(20):
        parts = [update(pack(minibatch())) for *_, update in (plain, compiled)]
        assert torch.allclose(torch.stack(parts[0]), torch.stack(parts[1]), atol=1e-5)
    assert torch.allclose(plain[2].vector, compiled[2].vector, atol=1e-5)


# Playing and the replay buffer
def test_the_ring_keeps_the_last_transitions(tmp_path):
    buffer = dqn.ReplayBuffer(tmp_path / "replay.dat", capacity=10, spare=4, obs_dim=2)
    for i in range(37):
        buffer.add(np.full(2, i), i % 3, float(i), 0.5, np.full(2, i + 1))
    rows = buffer.sample(2000, np.random.default_rng(0))
    returns = rows[:, 3]
    assert sorted(set(returns.tolist())) == list(range(27, 37))
    assert torch.equal(rows[:, 0], returns) and torch.equal(rows[:, 6], returns + 1)
    assert torch.equal(rows[:, 2], returns % 3)
    counts = np.bincount(returns.numpy().astype(int) - 27)
    assert scipy.stats.chisquare(counts).pvalue > 1e-3
    again = dqn.ReplayBuffer(tmp_path / "replay.dat", capacity=10, spare=4, obs_dim=2)
    assert np.array_equal(again.array, buffer.array)


class Script(gym.Env):
    """Rewards 1, 2, 3, ... for `length` steps, then the end of the given kind."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Discrete(2)

    def __init__(self, length: int, terminates: bool):
        self.length, self.terminates = length, terminates

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.t = 0
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.t += 1
        over = self.t == self.length
        return np.full(1, self.t, np.float32), float(self.t), over and self.terminates, over and not self.terminates, {}


@pytest.mark.parametrize("terminates", [True, False])
@pytest.mark.parametrize("n_step", [1, 3, 10])
def test_n_step_transitions_against_a_loop(n_step, terminates, tmp_path):
    gamma, length = 0.9, 7
    player = dqn.Player(dqn.Episode(Script(length, terminates), 1, 0, 1), SimpleNamespace(gamma=gamma, n_step=n_step))
    buffer = dqn.ReplayBuffer(tmp_path / "replay.dat", 100, 0, 1)
    player.start()
    ended = [player.step(t % 2, buffer) for t in range(length)]
    assert ended == [None] * (length - 1) + [(28.0, 7)]
    assert buffer.added == length
    for t, (obs, taken, total, discount, next_obs) in enumerate(buffer.array[:length].tolist()):
        last = min(t + n_step, length)
        expected = sum(gamma**k * (t + k + 1) for k in range(last - t))
        assert (obs, taken, next_obs) == (t, t % 2, last)
        assert math.isclose(total, expected, rel_tol=1e-6)
        ends = terminates and last == length
        assert math.isclose(discount, 0.0 if ends else gamma ** (last - t), rel_tol=1e-6)


def test_an_action_is_repeated_for_the_frames_that_are_skipped():
    episode = dqn.Episode(Script(7, True), 1, 0, 4)
    episode.start()
    assert episode.step(0)[1:] == (1.0 + 2 + 3 + 4, False, False)
    assert episode.step(0)[1:] == (5.0 + 6 + 7, True, False)
    assert episode.frames == 7


@pytest.mark.parametrize("n_step", [1, 5])
def test_a_player_goes_on_from_its_checkpoint(n_step, tmp_path):
    args = SimpleNamespace(gamma=0.99, n_step=n_step)
    players = [dqn.Player(dqn.Episode(dqn.make_env("CartPole-v1"), 1, 0, 1), args) for _ in range(2)]
    buffers = [dqn.ReplayBuffer(tmp_path / name, 1000, 0, 4) for name in "ab"]
    players[0].start()
    rng = np.random.default_rng(0)
    for _ in range(97):
        players[0].step(int(rng.integers(2)), buffers[0])
    assert players[1].load_state_dict(players[0].state_dict())
    before = buffers[0].added
    for _ in range(60):
        taken = int(rng.integers(2))
        assert players[0].step(taken, buffers[0]) == players[1].step(taken, buffers[1])
    assert np.array_equal(buffers[0].array[before : buffers[0].added], buffers[1].array[: buffers[1].added])


def test_exploration_falls_linearly():
    values = [dqn.linear_schedule(1.0, 0.1, 100, t) for t in (0, 50, 100, 1000)]
    assert np.allclose(values, [1.0, 0.55, 0.1, 0.1])
    assert dqn.linear_schedule(1.0, 0.1, 0, 0) == 0.1


def test_play_gives_whole_episodes_in_any_environment():
    rng = np.random.default_rng(0)
    episodes = dqn.play(lambda obs: rng.integers(0, 2, len(obs)), "CartPole-v1", [5, 6, 7], keep=True)
    for seed, episode in zip((5, 6, 7), episodes):
        env = gym.make("CartPole-v1")
        obs, _ = env.reset(seed=seed)
        observations, rewards = [obs], []
        for taken in episode["actions"]:
            obs, reward, terminated, _, _ = env.step(taken)
            observations.append(obs)
            rewards.append(reward)
        assert terminated and episode["terminated"] and not episode["truncated"]
        assert np.array_equal(episode["observations"], observations)
        assert np.array_equal(episode["rewards"], rewards)
