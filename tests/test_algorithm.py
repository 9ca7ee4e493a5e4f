"""Every function of the algorithm against an independent source."""

import dataclasses
import functools
import json
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import Counter, needs_compiler
from stable_baselines3.common.buffers import RolloutBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd as SB3RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize
from torch.distributions import Independent, Normal, kl_divergence

from cleanrl_thesis import ppo_continuous_kle as ppo

B, O, A = 256, 5, 3  # noqa: E741
CPU = torch.device("cpu")


@pytest.fixture(autouse=True)
def forget_compiled_graphs():
    """Each test compiles for itself: dynamo keeps eight graphs of a function and then silently runs it plainly."""
    torch._dynamo.reset()


def make_args(**overrides) -> ppo.Args:
    small = {"env_id": "Pendulum-v1", "num_steps": 128, "num_minibatches": 4, "total_timesteps": 1280}
    return ppo.complete_args(ppo.Args(**{**small, **overrides}))


def make_agent(args: ppo.Args, obs_dim: int = O, action_dim: int = A, seed: int = 0) -> ppo.Agent:
    torch.manual_seed(seed)
    return ppo.Agent(obs_dim, action_dim, args.activation, args.ortho_init, args.init_gains)


def gaussians(seed: int = 0) -> tuple[torch.Tensor, ...]:
    generator = torch.Generator().manual_seed(seed)
    mean, other = torch.randn(2, B, A, generator=generator)
    logstd, other_logstd = 0.3 * torch.randn(2, A, generator=generator)
    return mean, logstd, 0.5 * other + mean, other_logstd


def random_batch(agent: ppo.Agent, seed: int = 0) -> ppo.Batch:
    """A batch of actions that the agent itself drew, with advantages and returns at random."""
    torch.manual_seed(seed)
    obs = torch.randn(B, O)
    mean, logstd, value = (output.detach() for output in agent(obs))
    actions = mean + logstd.exp() * torch.randn(B, A)
    logprobs = ppo.gaussian_log_prob(mean, logstd, actions)
    return ppo.Batch(obs, actions, logprobs, mean, torch.randn(B), value + torch.randn(B), value)


def test_log_prob_and_kl_are_those_of_torch_distributions():
    mean, logstd, other, other_logstd = gaussians()
    p = Independent(Normal(mean, logstd.exp()), 1)
    q = Independent(Normal(other, other_logstd.exp()), 1)
    actions = p.sample()
    torch.testing.assert_close(ppo.gaussian_log_prob(mean, logstd, actions), p.log_prob(actions))
    torch.testing.assert_close(ppo.gaussian_kl(mean, logstd, other, other_logstd), kl_divergence(p, q))
    torch.testing.assert_close(ppo.gaussian_kl(other, other_logstd, mean, logstd), kl_divergence(q, p))


def test_k1_and_k3_estimate_the_divergence_from_old_to_new():
    """With actions of the old policy their means approach D(old ‖ new), and not the direction of Eq. 4.3.1."""
    torch.manual_seed(0)
    agent, old_mean, old_logstd = (
        make_agent(make_args()),
        torch.tensor([0.5, -0.3, 0.2]),
        torch.tensor([0.4, 0.0, -0.3]),
    )
    rows = 400_000
    actions = old_mean + old_logstd.exp() * torch.randn(rows, A)
    logprobs = ppo.gaussian_log_prob(old_mean.expand(rows, A), old_logstd, actions)
    fields = {"obs": torch.zeros(rows, O), "actions": actions, "logprobs": logprobs, "means": old_mean.expand(rows, A)}
    batch = ppo.Batch(**fields, advantages=logprobs, returns=logprobs, values=logprobs)
    kl = {name: value.item() for name, value in ppo.kl_estimates(agent, batch, old_logstd).items()}
    assert abs(kl["exact-old-new"] - kl["exact-new-old"]) > 0.05
    assert kl["k1"] == pytest.approx(kl["exact-old-new"], abs=0.01)
    assert kl["k3"] == pytest.approx(kl["exact-old-new"], abs=0.01)
    new = Independent(Normal(agent.actor_mean(torch.zeros(1, O)), agent.actor_logstd.exp()), 1)
    old = Independent(Normal(old_mean[None], old_logstd.exp()), 1)
    assert kl["exact-new-old"] == pytest.approx(kl_divergence(new, old).item(), rel=1e-5)  # Eq. 4.3.1


def test_kl_is_zero_before_the_first_step():
    agent = make_agent(make_args())
    kl = ppo.kl_estimates(agent, random_batch(agent), agent.actor_logstd.detach())
    assert all(abs(value.item()) < 1e-6 for value in kl.values())


@pytest.fixture
def episodes_of_rewards() -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(0)
    shape = (60, 3)
    rewards, values = rng.normal(size=shape).astype(np.float32), rng.normal(size=(61, 3)).astype(np.float32)
    dones = (rng.random(shape) < 0.1).astype(np.float32)
    dones[-1, 0], dones[-1, 1] = 1.0, 0.0
    return rewards, values, dones


def test_gae_is_the_sum_of_discounted_errors(episodes_of_rewards):
    rewards, values, dones = episodes_of_rewards
    gamma, lam = 0.97, 0.9
    expected = np.zeros_like(rewards)
    for i in range(rewards.shape[1]):
        for t in range(len(rewards)):
            for later in range(t, len(rewards)):
                alive = 1.0 - dones[later, i]
                error = rewards[later, i] + gamma * alive * values[later + 1, i] - values[later, i]
                expected[t, i] += (gamma * lam) ** (later - t) * error
                if not alive:
                    break
    np.testing.assert_allclose(ppo.gae(rewards, values, dones, gamma, lam), expected, rtol=1e-4, atol=1e-5)


def test_gae_is_stable_baselines(episodes_of_rewards):
    rewards, values, dones = episodes_of_rewards
    space = gym.spaces.Box(-1, 1, (1,))
    buffer = RolloutBuffer(len(rewards), space, space, "cpu", gae_lambda=0.95, gamma=0.99, n_envs=3)
    starts = np.concatenate([np.zeros((1, 3)), dones[:-1]])
    for t in range(len(rewards)):
        fields = (np.zeros((3, 1)), np.zeros((3, 1)), rewards[t], starts[t])
        buffer.add(*fields, torch.from_numpy(values[t]), torch.zeros(3))
    buffer.compute_returns_and_advantage(torch.from_numpy(values[-1]), dones[-1])
    advantages = ppo.gae(rewards, values, dones, 0.99, 0.95)
    np.testing.assert_allclose(advantages, buffer.advantages, rtol=1e-4, atol=1e-5)


def test_running_statistics_are_those_of_numpy_and_stable_baselines():
    stream = np.random.default_rng(0).normal([3, -200, 0.01], [0.5, 30, 1e-3], (5000, 3))
    ours, theirs = ppo.RunningMeanStd((3,)), SB3RunningMeanStd(shape=(3,))
    for x in stream:
        ours.update(x)
        theirs.update(x[None])
    np.testing.assert_allclose(ours.mean, theirs.mean, rtol=1e-9)
    np.testing.assert_allclose(ours.divisor("std"), np.sqrt(theirs.var + 1e-8), rtol=1e-9)
    np.testing.assert_allclose(ours.divisor("variance"), theirs.var + 1e-8, rtol=1e-9)
    np.testing.assert_allclose(ours.mean, stream.mean(0), rtol=1e-6)
    np.testing.assert_allclose(ours.divisor("std"), stream.std(0), rtol=0.02)


def test_collected_observations_and_rewards_are_those_of_vecnormalize():
    """Up to the first end of an episode, after which VecNormalize never sees the final observation."""
    args = make_args(num_steps=200, num_minibatches=4, total_timesteps=2000)
    collector, agent = ppo.Collector([ppo.make_env("Pendulum-v1")], args), make_agent(args, 3, 1)
    collector.start()
    rollout = collector.collect(agent)
    env = VecNormalize(DummyVecEnv([lambda: gym.make("Pendulum-v1")]))
    env.venv.seed(ppo.episode_seed(args.seed, 0, 0))
    obs = env.reset()
    for t in range(199):
        np.testing.assert_allclose(rollout.obs[t], obs, rtol=1e-5, atol=1e-5)
        obs, reward, _, _ = env.step(np.clip(rollout.actions[t], -2, 2))
        assert rollout.rewards[t, 0] == pytest.approx(reward[0], rel=1e-5)
    assert rollout.dones[:, 0].tolist() == [0.0] * 199 + [1.0]
    assert len(rollout.time_outs) == 1 and rollout.time_outs[0][:2] == (199, 0)


def test_reward_scale_forgets_the_return_at_the_end_of_an_episode():
    args = make_args(num_steps=400, total_timesteps=4000)
    collector = ppo.Collector([ppo.make_env("Pendulum-v1")], args)
    collector.start()
    collector.collect(make_agent(args, 3, 1))
    assert collector.episodes[0].number == 2 and collector.episodes[0].discounted_return == 0.0


def test_a_time_out_is_bootstrapped_with_the_value_of_the_final_observation():
    advantages = {}
    for bootstrap in (False, True):
        args = make_args(num_steps=256, total_timesteps=2560, bootstrap_truncated=bootstrap)
        agent = make_agent(args, 3, 1)
        collector = ppo.Collector([ppo.make_env("Pendulum-v1")], args)
        collector.start()
        rollout = collector.collect(agent)
        advantages[bootstrap] = ppo.make_batch(agent, rollout, args, CPU).advantages
    t, _, final = rollout.time_outs[0]
    value = agent(torch.from_numpy(final)[None])[2].item()
    difference = (advantages[True] - advantages[False])[: t + 1].flip(0)
    expected = args.gamma * value * (args.gamma * args.gae_lambda) ** torch.arange(t + 1)
    torch.testing.assert_close(difference, expected, rtol=1e-3, atol=1e-5)
    assert torch.equal(advantages[True][t + 1 :], advantages[False][t + 1 :])


@pytest.mark.parametrize("flags", [{}, {"norm_adv_scope": "batch"}, {"norm_adv_scope": "batch", "norm_adv": False}])
def test_a_batch_by_hand(flags):
    """Every column, step by step and environment by environment: two of these, three steps, an end and a time-out."""
    args = make_args(num_envs=2, num_steps=3, num_minibatches=1, bootstrap_truncated=True, gae_lambda=0.8, **flags)
    agent, rng = make_agent(args), np.random.default_rng(0)
    with torch.no_grad():
        agent.actor_logstd.copy_(torch.tensor([0.5, -0.2, 0.1]))
    obs, actions, rewards, last = (
        rng.standard_normal(shape).astype(np.float32) for shape in [(4, 2, O), (3, 2, A), (3, 2), (O,)]
    )
    dones = np.array([[0, 1], [1, 0], [0, 0]], np.float32)
    rollout = ppo.Rollout(obs, actions, rewards.copy(), dones, [(0, 1, last)], [])
    batch = ppo.make_batch(agent, rollout, args, CPU)
    value = {(t, i): agent.critic(torch.from_numpy(obs[t, i])).item() for t in range(4) for i in range(2)}
    expected = np.zeros((3, 2))
    for i in range(2):
        following = 0.0
        for t in reversed(range(3)):
            reward = rewards[t, i] + (
                args.gamma * agent.critic(torch.from_numpy(last)).item() if (t, i) == (0, 1) else 0
            )
            delta = reward + args.gamma * value[t + 1, i] * (1 - dones[t, i]) - value[t, i]
            following = expected[t, i] = delta + args.gamma * 0.8 * following * (1 - dones[t, i])
    scaled = expected.ravel()
    if flags.get("norm_adv", True) and args.norm_adv_scope == "batch":
        scaled = (scaled - scaled.mean()) / scaled.std(ddof=1)
    places = [(t, i) for t in range(3) for i in range(2)]
    for row, (t, i) in enumerate(places):
        mean = agent.actor_mean(torch.from_numpy(obs[t, i]))
        logprob = Independent(Normal(mean, agent.actor_logstd.exp()), 1).log_prob(torch.from_numpy(actions[t, i]))
        assert np.array_equal(batch.obs[row], obs[t, i]) and np.array_equal(batch.actions[row], actions[t, i])
        assert torch.allclose(batch.means[row], mean, atol=1e-6)
        assert batch.logprobs[row].item() == pytest.approx(logprob.item(), abs=1e-5)
        assert batch.advantages[row].item() == pytest.approx(scaled[row], abs=1e-5)
        assert batch.returns[row].item() == pytest.approx(expected[t, i] + value[t, i], abs=1e-5)
        assert batch.values[row].item() == pytest.approx(value[t, i], abs=1e-6)
    assert {len(column) for column in batch} == {6}


@pytest.mark.parametrize("clip_vloss", [True, False])
@pytest.mark.parametrize("norm_adv", [True, False])
def test_loss_is_the_one_derived_by_hand(clip_vloss, norm_adv):
    agent = make_agent(make_args())
    batch = random_batch(agent)
    mean, logstd, value = (x.detach() + 0.1 * torch.randn_like(x) for x in agent(batch.obs))
    weights = {"clip_coef": 0.2, "ent_coef": 0.01, "vf_coef": 0.7}
    loss, parts = ppo.ppo_loss((mean, logstd, value), batch, clip_vloss=clip_vloss, norm_adv=norm_adv, **weights)
    policy_sum = value_sum = clipped = 0.0
    advantages = batch.advantages.double().numpy()
    if norm_adv:
        advantages = (advantages - advantages.mean()) / (advantages.std(ddof=1) + 1e-8)
    for i in range(B):
        logprob = Normal(mean[i].double(), logstd.double().exp()).log_prob(batch.actions[i].double()).sum()
        ratio = math.exp(logprob - batch.logprobs[i])
        clipped += ratio < 0.8 or ratio > 1.2
        policy_sum += min(ratio * advantages[i], max(0.8, min(1.2, ratio)) * advantages[i])
        target, old = batch.returns[i].item(), batch.values[i].item()
        error = (value[i].item() - target) ** 2
        if clip_vloss:
            error = max(error, (old + max(-0.2, min(0.2, value[i].item() - old)) - target) ** 2)
        value_sum += 0.5 * error
    entropy = Normal(mean[0], logstd.exp()).entropy().sum().item()
    assert parts[0].item() == pytest.approx(-policy_sum / B, abs=1e-5)
    assert parts[1].item() == pytest.approx(value_sum / B, rel=1e-4)
    assert parts[2].item() == pytest.approx(clipped / B) and clipped > 0
    assert ppo.gaussian_entropy(logstd).item() == pytest.approx(entropy, rel=1e-5)
    assert loss.item() == pytest.approx(-policy_sum / B - 0.01 * entropy + 0.7 * value_sum / B, rel=1e-4)


def test_numpy_policy_is_the_torch_policy():
    for activation in ("tanh", "relu"):
        agent = make_agent(make_args(activation=activation))
        obs = torch.randn(7, O)
        np.testing.assert_allclose(ppo.numpy_policy(agent)(obs.numpy()), agent(obs)[0].detach(), rtol=1e-4, atol=1e-6)


def test_initial_weights_are_orthogonal_with_the_given_gains():
    agent = make_agent(make_args(init_gains=(2.0, 0.5, 3.0)))
    for layer, gain in ((agent.actor_mean[2], 2.0), (agent.actor_mean[4], 0.5), (agent.critic[4], 3.0)):
        product = layer.weight @ layer.weight.T
        torch.testing.assert_close(product, gain**2 * torch.eye(len(product)), rtol=1e-4, atol=1e-4)
        assert not layer.bias.any()
    assert not agent.actor_logstd.any()


def test_packed_rows_unpack_to_the_same_batch():
    batch = random_batch(make_agent(make_args()))
    for column, unpacked in zip(batch, ppo.Batch.unpack(batch.pack(), A)):
        assert torch.equal(column, unpacked)


class ReferenceUpdate:
    """The step with torch.optim.Adam and clip_grad_norm_ on ordinary parameters."""

    def __init__(self, agent, optimizer, loss_function, max_grad_norm):
        self.agent, self.loss_function, self.max_grad_norm = agent, loss_function, max_grad_norm
        critic = list(agent.critic.parameters())
        groups = [{"params": agent.policy_parameters(), "lr": 3e-3}, {"params": critic, "lr": 1e-3}]
        self.adam = torch.optim.Adam(groups, eps=1e-5)

    def __call__(self, rows):
        minibatch = ppo.Batch.unpack(rows, A)
        loss, _ = self.loss_function(self.agent(minibatch.obs), minibatch)
        self.adam.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.agent.parameters(), self.max_grad_norm)
        self.adam.step()


def after_twenty_steps(make_update, **overrides) -> dict[str, torch.Tensor]:
    """The parameters after twenty steps on the same minibatches from the same start."""
    args = make_args(learning_rate=3e-3, value_learning_rate=1e-3, **overrides)
    agent = make_agent(args)
    rows = random_batch(agent).pack()
    optimizer = ppo.FlatAdam(agent, args.learning_rate, args.value_learning_rate)
    loss = functools.partial(ppo.ppo_loss, clip_coef=0.2, clip_vloss=True, norm_adv=True, ent_coef=0.01, vf_coef=0.5)
    update = make_update(agent, optimizer, loss, args.max_grad_norm)
    for i in range(20):
        update(rows[(i % 4) * 64 : (i % 4 + 1) * 64])
    return dict(agent.named_parameters())


@pytest.mark.parametrize("max_grad_norm", [0.05, 0.5, math.inf])
def test_flat_optimizer_is_torch_adam(max_grad_norm):
    ours = after_twenty_steps(ppo.PlainUpdate, max_grad_norm=max_grad_norm)
    reference = after_twenty_steps(ReferenceUpdate, max_grad_norm=max_grad_norm)
    start = make_agent(make_args())
    for name, value in ours.items():
        torch.testing.assert_close(value, reference[name], rtol=1e-3, atol=2e-5)
        assert (value - start.get_parameter(name)).abs().max() > 5e-4, f"{name} did not move: this would show nothing"


@needs_compiler
@pytest.mark.parametrize("activation", ["tanh", "relu"])
def test_compiled_update_gives_the_plain_numbers(activation):
    plain = after_twenty_steps(ppo.PlainUpdate, activation=activation)
    compiled = after_twenty_steps(functools.partial(ppo.CompiledUpdate, batch_rows=64), activation=activation)
    for name, value in plain.items():
        torch.testing.assert_close(value, compiled[name], rtol=1e-3, atol=2e-5)


def iterate(args: ppo.Args, wrap=lambda update: update) -> tuple[ppo.Agent, dict]:
    """One iteration of the algorithm on Pendulum; returns the agent and the metrics."""
    agent = make_agent(args, 3, 1)
    optimizer = ppo.FlatAdam(agent, args.learning_rate, args.value_learning_rate)
    collector = ppo.Collector([ppo.make_env(args.env_id)], args)
    collector.start()
    batch = ppo.make_batch(agent, collector.collect(agent), args, CPU)
    update = wrap(ppo.make_update(agent, optimizer, args))
    return agent, ppo.update_policy(agent, optimizer, update, batch, args)


@pytest.mark.parametrize(
    "flags",
    [
        {"norm_adv": False},
        {"norm_adv_scope": "batch"},
        {"norm_obs": False},
        {"norm_reward": False},
        {"norm_divisor": "variance"},
        {"clip_obs": 0.5},
        {"clip_reward": 0.01},
        {"clip_vloss": False},
        {"num_minibatches": 1},
        {"max_grad_norm": math.inf},
        {"ortho_init": False},
        {"init_gains": (1.0, 1.0, 1.0)},
        {"activation": "relu"},
        {"clip_coef": 0.01},
        {"ent_coef": 0.2},
        {"vf_coef": 2.0},
        {"gae_lambda": 0.5},
        {"gamma": 0.9},
        {"value_learning_rate": 1e-3},
        {"update_epochs": 3},
        {"kle_stop": True, "d_target": 1e-6},
        {"kle_rollback": True, "d_target": 1e-6},
    ],
    ids=str,
)
def test_every_flag_changes_the_training(flags):
    default, _ = iterate(make_args())
    changed, _ = iterate(make_args(**flags))
    assert any(not torch.equal(p, q) for p, q in zip(default.parameters(), changed.parameters()))


def test_each_iteration_takes_the_batch_in_another_order(monkeypatch):
    """All of it, each row once; so not the order of time, and not the same one again."""
    rows, batches, make_batch = [], [], ppo.make_batch
    monkeypatch.setattr(ppo, "make_batch", lambda *its: batches.append(make_batch(*its)) or batches[-1])
    iterate(make_args(update_epochs=3), lambda update: lambda its: rows.append(its.clone()) or update(its))
    assert [len(minibatch) for minibatch in rows] == [32] * 12
    orders = [[row.tobytes() for row in its.numpy()] for its in (batches[0].pack(), *torch.cat(rows).split(128))]
    assert len(orders) == 4 and len(set(orders[0])) == 128
    assert all(sorted(order) == sorted(orders[0]) for order in orders)
    assert len({tuple(order) for order in orders}) == 4


def script_divergence(monkeypatch, values: list[float], estimator: str = "k1") -> list[int]:
    """Let the measured divergence be `values`, under one estimator's name; returns the list that counts its samples."""
    samples = []

    def scripted(agent, batch, old_logstd):
        kl = dict.fromkeys(("k1", "k3", "exact-old-new", "exact-new-old"), torch.tensor(0.0))
        kl[estimator] = torch.tensor(values[len(samples)] if len(samples) < len(values) else 0.0)
        samples.append(len(batch.obs))
        return kl

    monkeypatch.setattr(ppo, "kl_estimates", scripted)
    return samples


@pytest.mark.parametrize("mode", ["kle_stop", "kle_rollback"])
@pytest.mark.parametrize("crossing", [1, 3, 7, None])
@pytest.mark.parametrize("estimator", ["k1", "k3", "exact-old-new", "exact-new-old"])
def test_early_stopping_ends_at_the_first_crossing(monkeypatch, mode, crossing, estimator):
    """Also where the divergence falls below the threshold again, and never after more than K iterations."""
    samples = script_divergence(monkeypatch, [0.01 if k != crossing else 0.04 for k in range(1, 8)], estimator)
    steps = []
    args = make_args(update_epochs=7, kl_estimator=estimator, **{mode: True})
    _, metrics = iterate(args, lambda update: lambda rows: steps.append(1) or update(rows))
    iterations = crossing or 7
    assert metrics["charts/update_iterations"] == iterations
    assert len(steps) == iterations * args.num_minibatches
    assert metrics["charts/rolled_back"] == int(mode == "kle_rollback" and crossing is not None)
    assert len(samples) == iterations + 1  # one more for the log
    assert metrics["losses/approx_kl"] == pytest.approx(0.04 if crossing else 0.01)


@pytest.mark.parametrize("timing, steps_before", [("before-last-step", 3), ("after-iteration", 4)])
@pytest.mark.parametrize("samples, size", [("last-minibatch", 32), ("batch", 128)])
def test_the_divergence_is_measured_when_and_where_it_is_told_to(monkeypatch, timing, steps_before, samples, size):
    """Four minibatches of 32: before or after the last one's step, on it or on the whole batch."""
    steps, measured = [], []
    sizes = script_divergence(monkeypatch, [0.0] * 9)
    scripted = ppo.kl_estimates
    monkeypatch.setattr(ppo, "kl_estimates", lambda *given: measured.append(len(steps)) or scripted(*given))
    args = make_args(update_epochs=2, kle_stop=True, kl_timing=timing, kl_samples=samples)
    iterate(args, lambda update: lambda rows: steps.append(1) or update(rows))
    assert measured == [steps_before, 4 + steps_before, 8] and sizes == [size, size, 128]


def test_without_early_stopping_all_k_iterations_run():
    _, metrics = iterate(make_args(update_epochs=7, d_target=1e-9))
    assert metrics["charts/update_iterations"] == 7


@pytest.mark.parametrize("scope", ["policy", "policy-value", "policy-moments"])
@pytest.mark.parametrize("compiled", [False, pytest.param(True, marks=needs_compiler)])
@pytest.mark.parametrize("crossing", [1, 3])
def test_rollback_restores_bit_for_bit(monkeypatch, scope, compiled, crossing):
    args = make_args(kle_rollback=True, rollback=scope, update_epochs=5, compile=compiled)
    calls, before, after = [], {}, {}
    script_divergence(monkeypatch, [float(k == crossing) for k in range(1, 6)])

    def everything(update) -> dict[str, torch.Tensor]:
        adam = update.optimizer
        value = slice(adam.policy.stop, None)
        moments = {"mean of policy": adam.mean[adam.policy], "square of policy": adam.square[adam.policy]}
        moments |= {"mean of value": adam.mean[value], "square of value": adam.square[value]}
        return {name: tensor.detach().clone() for name, tensor in [*update.agent.named_parameters(), *moments.items()]}

    def snapshot(update):
        def wrapped(rows):
            if len(calls) == (crossing - 1) * args.num_minibatches:
                before.update(everything(update))
            calls.append(1)
            after["update"] = update
            return update(rows)

        return wrapped

    _, metrics = iterate(args, snapshot)
    assert metrics["charts/rolled_back"] == 1 and metrics["charts/update_iterations"] == crossing
    for name, value in everything(after["update"]).items():
        restored = {
            "policy": name.startswith("actor"),
            "policy-value": name.startswith(("actor", "critic")),
            "policy-moments": name.startswith("actor") or name.endswith("of policy"),
        }[scope]
        assert torch.equal(value, before[name]) == restored, name


def docstring_setting(name: str) -> ppo.Args:
    """The flags that the file's docstring gives for a setting, parsed."""
    (row,) = (line for line in ppo.__doc__.splitlines() if line.startswith(f"| {name}"))
    return ppo.complete_args(ppo.parse_args(row.split("|")[2].strip().strip("`").split()))


def test_docstring_settings_are_those_of_the_sheet():
    printed, modern = docstring_setting("as printed"), docstring_setting("modern")
    assert (printed.gae_lambda, printed.ent_coef, printed.init_gains) == (0.97, 0.2, (1.0, 1.0, 1.0))
    assert (printed.norm_adv_scope, printed.norm_divisor, printed.rollback) == ("batch", "variance", "policy")
    assert (printed.kl_estimator, printed.kl_samples) == ("exact-new-old", "last-minibatch")
    assert modern.kle_rollback and modern.bootstrap_truncated and (modern.update_epochs, modern.d_target) == (80, 0.03)
    assert (modern.kl_estimator, modern.kl_samples, modern.rollback) == ("exact-old-new", "batch", "policy-moments")
    assert printed.kl_timing == modern.kl_timing == "after-iteration"


def test_settings_that_the_sheet_prints_are_the_defaults():
    args = ppo.complete_args(ppo.Args())
    expected = {"total_timesteps": 2_000_000, "gamma": 0.99, "gae_lambda": 0.95, "ent_coef": 0.0, "clip_coef": 0.2}
    expected |= {"max_grad_norm": 0.5, "learning_rate": 3e-4, "value_learning_rate": 3e-4, "batch_size": 2048}
    expected |= {"minibatch_size": 64, "update_epochs": 10, "d_target": 0.03, "kl_timing": "before-last-step"}
    assert {name: dataclasses.asdict(args)[name] for name in expected} == expected


@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
def test_gpu_gives_the_numbers_of_the_cpu():
    agents = []
    for device in (CPU, torch.device("cuda")):
        args = make_args()
        agent = make_agent(args, 3, 1).to(device)
        optimizer = ppo.FlatAdam(agent, 3e-4, 3e-4)
        collector = ppo.Collector([ppo.make_env("Pendulum-v1")], args)
        collector.start()
        batch = ppo.make_batch(agent, collector.collect(agent), args, device)
        ppo.update_policy(agent, optimizer, ppo.make_update(agent, optimizer, args), batch, args)
        agents.append(agent.cpu())
    for p, q in zip(*(agent.parameters() for agent in agents)):
        torch.testing.assert_close(p, q, rtol=1e-3, atol=1e-4)


def test_ends_time_outs_returns_and_noise_of_a_rollout():
    """Both end an episode, a time-out alone has a last observation; returns are raw; noise has the policy's deviation.

    Actions are those that were drawn, also beyond the bounds within which the environment gets them.
    """
    args = make_args(num_steps=16, total_timesteps=160, norm_divisor="variance")
    agent = make_agent(args, 1, 1)
    with torch.no_grad():
        agent.actor_logstd.fill_(1.0)
    env, taken = Counter(), []
    step = env.step
    env.step = lambda action: taken.append(action) or step(action)
    collector = ppo.Collector([env], args)
    collector.start()
    rollout = collector.collect(agent)
    assert np.flatnonzero(rollout.dones[:, 0]).tolist() == [3, 7, 11, 15]
    assert [t for t, _, _ in rollout.time_outs] == [7, 15]
    assert rollout.episodes == [(4, 4.0, 4), (8, 4.0, 4), (12, 4.0, 4), (16, 4.0, 4)]
    noise = np.random.default_rng(np.random.SeedSequence(args.seed)).standard_normal((16, 1, 1), np.float32)
    with torch.no_grad():
        mean = agent.actor_mean(torch.from_numpy(rollout.obs[:16])).numpy()
    assert np.allclose((rollout.actions - mean) / math.exp(1), noise, atol=1e-4)
    assert np.abs(rollout.actions).max() > 2 and np.array_equal(np.clip(rollout.actions[:, 0], -1, 1), taken)
    collector.update_agent_statistics(agent)
    assert np.allclose(agent.obs_divisor, collector.obs_stats.divisor("variance"))
    assert np.allclose(agent.obs_mean, collector.obs_stats.mean)


class BothEnds(Counter):
    """Ends after 4 steps, by a fall at the time-out."""

    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward, terminated or truncated, terminated or truncated, info


def test_a_fall_at_the_time_out_is_a_fall():
    args = make_args(num_steps=16, total_timesteps=160)
    collector = ppo.Collector([BothEnds()], args)
    collector.start()
    rollout = collector.collect(make_agent(args, 1, 1))
    assert rollout.dones.sum() == 4 and rollout.time_outs == []


def test_evaluation_and_demonstrations_play_in_the_mode_that_is_asked_for(tmp_path):
    """Greedy the mean of normalised observations, sampled with the policy's deviation around it; both within bounds."""
    agent = make_agent(make_args(init_gains=(1.0, 1.0, 1.0)), 3, 1)
    with torch.no_grad():
        agent.actor_logstd.fill_(0.5)
        agent.actor_mean[4].bias.fill_(0.3)
    agent.obs_mean.copy_(torch.tensor([0.1, -0.2, 0.5]))
    agent.obs_divisor.copy_(torch.tensor([0.7, 0.5, 2.0]))
    scores, noise = {}, {}
    for mode in ("greedy", "sampled"):
        args = make_args(eval_mode=mode, eval_episodes=2, save_demos=3)
        (tmp_path / mode).mkdir()
        evaluation = ppo.evaluate(agent, args, tmp_path / mode)
        scores[mode] = evaluation["returns"]
        env = ppo.make_env("Pendulum-v1")
        assert evaluation["returns"] == [
            ppo.play(agent, env, args, seed)["rewards"].sum() for seed in evaluation["seeds"]
        ]
        ppo.save_demonstrations(agent, args, tmp_path / mode)
        deviations = []
        for path in sorted((tmp_path / mode / "demos").glob("*.npz")):
            with np.load(path, allow_pickle=False) as arrays:
                obs, actions = arrays["observations"][:-1], arrays["actions"]
            scaled = (torch.from_numpy(obs) - agent.obs_mean) / agent.obs_divisor
            mean = agent.actor_mean(scaled.clamp(-args.clip_obs, args.clip_obs).float()).detach().numpy()
            deviations.append(actions - mean)
            assert np.abs(actions).max() <= 2
        noise[mode] = np.concatenate(deviations)
        manifest = json.loads((tmp_path / mode / "demos" / "manifest.json").read_text())
        assert evaluation["mode"] == manifest["mode"] == mode and len(deviations) == 3
    assert np.abs(noise["greedy"]).max() < 1e-5 and set(scores["greedy"]).isdisjoint(scores["sampled"])
    quartiles = np.quantile(noise["sampled"] / math.exp(0.5), [0.25, 0.5, 0.75])  # of 600: bounds do not move them
    assert np.allclose(quartiles, Normal(0, 1).icdf(torch.tensor([0.25, 0.5, 0.75])), atol=0.15)


def test_networks_that_would_not_be_played_or_trained_whole_are_refused():
    agent = make_agent(make_args())
    agent.actor_mean[1] = torch.nn.SiLU()
    with pytest.raises(TypeError, match="SiLU"):
        ppo.numpy_policy(agent)
    agent.encoder = torch.nn.Linear(O, O)
    with pytest.raises(ValueError, match="would not be trained"):
        ppo.FlatAdam(agent, 3e-4, 1e-3)


class SameArray(Counter):
    """Gives the same array in every step, and changes the actions that it is given."""

    def reset(self, **kwargs):
        self.obs, infos = super().reset(**kwargs)
        return self.obs, infos

    def step(self, action):
        action *= 0
        self.obs[:], *rest = super().step(action)
        return self.obs, *rest


def test_demonstrations_are_copies():
    args = make_args()
    agent, env = make_agent(args, 1, 1), SameArray()
    torch.nn.init.ones_(agent.actor_mean[-1].bias)
    episode = ppo.play(agent, env, args, 1)
    assert episode["observations"].ravel().tolist() == [0, 1, 2, 3, 4] and (episode["actions"] != 0).all()
    player = ppo.Episode(env, 1, 0, 0.99)
    player.start()
    player.step(np.ones(1, np.float32))
    assert player.actions[0].tolist() == [1]
