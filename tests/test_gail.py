"""TRPO, the hybrid discriminator and the synthetic driver against independent sources."""

import importlib
import math

import gymnasium as gym
import numpy as np
import pytest
import scipy.sparse.linalg
import torch
from conftest import ROOT, Counter
from sb3_contrib import TRPO

from cleanrl_thesis import gail_hybrid as gail

OBS, ACTIONS = 6, 3


def make_batch(size: int = 256, seed: int = 0):
    """An agent whose policy is no longer its beginning, its policy as a vector, and a batch of its own steps."""
    torch.manual_seed(seed)
    agent = gail.Agent(OBS, ACTIONS, 32)
    policy = gail.PolicyVector(agent)
    policy.vector.add_(0.05 * torch.randn_like(policy.vector))
    obs = torch.randn(size, OBS)
    with torch.no_grad():
        mean, logstd = policy(policy.vector, obs)
        actions = mean + logstd.exp() * torch.randn(size, ACTIONS)
    advantages = (actions[:, 0] * obs[:, 0]).detach() + 0.1 * torch.randn(size)
    advantages = (advantages - advantages.mean()) / advantages.std()
    return agent, policy, gail.Batch(obs, actions, actions, advantages, torch.randn(size))


# TRPO
def test_conjugate_gradient_against_scipy():
    rng = np.random.default_rng(0)
    root = rng.standard_normal((30, 30))
    matrix, b = root @ root.T + 30 * np.eye(30), rng.standard_normal(30)
    tensors = torch.from_numpy(matrix), torch.from_numpy(b)
    for iterations in (3, 10):
        ours = gail.conjugate_gradient(lambda v: tensors[0] @ v, tensors[1], iterations)
        theirs, _ = scipy.sparse.linalg.cg(matrix, b, rtol=0, maxiter=iterations)
        assert np.allclose(ours, theirs)
    ours = gail.conjugate_gradient(lambda v: tensors[0] @ v, tensors[1], 60)
    assert np.allclose(ours, np.linalg.solve(matrix, b), atol=1e-5)


def test_fisher_products_are_those_of_the_hessian_of_the_kl_divergence():
    _, policy, batch = make_batch(50)
    old = policy.vector.clone().double()
    obs = batch.obs.double()
    policy.mean.double()
    with torch.no_grad():
        old_mean, old_logstd = policy(old, obs)

    def kl(vector: torch.Tensor) -> torch.Tensor:
        mean, logstd = policy(vector, obs)
        ours = torch.distributions.Normal(old_mean, old_logstd.exp())
        return torch.distributions.kl_divergence(ours, torch.distributions.Normal(mean, logstd.exp())).sum(1).mean()

    hessian = torch.autograd.functional.hessian(kl, old)
    multiply = gail.fisher_product(policy, old, obs, 0.1)
    for seed in range(3):
        v = torch.randn(len(old), dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
        expected = hessian @ v + 0.1 * v
        assert (multiply(v) - expected).norm() < 1e-6 * expected.norm()


def test_a_step_of_trpo_improves_the_surrogate_within_the_bound():
    args = gail.Args(alpha=0.0)
    for seed in range(5):
        agent, policy, batch = make_batch(seed=seed)
        old = policy.vector.clone()
        metrics = gail.trpo_step(policy, batch, args.max_kl, args)
        assert 0 < metrics["losses/kl"] <= 1.5 * args.max_kl and metrics["losses/gain"] > 0
        with torch.no_grad():
            (mean, logstd), (old_mean, old_logstd) = policy(policy.vector, batch.obs), policy(old, batch.obs)
            pairs = [torch.distributions.Normal(m, s.exp()) for m, s in ((old_mean, old_logstd), (mean, logstd))]
            kl = torch.distributions.kl_divergence(*pairs).sum(1).mean()
            assert torch.allclose(agent.actor_mean(batch.obs), mean)  # the agent's own parameters have moved
        assert kl.item() == pytest.approx(metrics["losses/kl"], rel=1e-3)


def test_without_damping_the_full_step_is_as_long_as_the_bound_allows():
    """½ sᵀ F s = max KL for the step before the line search; in a quadratic model that is the KL divergence."""
    args = gail.Args(alpha=0.0, cg_damping=1e-4, cg_iterations=60, fisher_every=1)
    _, policy, batch = make_batch(2_000)
    metrics = gail.trpo_step(policy, batch, 1e-5, args)
    assert metrics["charts/halvings"] == 0 and metrics["losses/kl"] == pytest.approx(1e-5, rel=0.1)


def test_the_bound_falls_linearly_to_a_hundredth():
    args = gail.Args(alpha=0.0, max_kl=0.02, num_iterations=200)
    assert [gail.kl_bound(iteration, args) for iteration in (1, 51, 101)] == [0.02, 0.015, 0.01]
    assert gail.kl_bound(200, args) == pytest.approx(0.0002)
    assert gail.kl_bound(200, gail.Args(alpha=0.0, anneal_kl=False, num_iterations=200)) == 0.01


def test_the_line_search_goes_back_until_the_bound_holds():
    """With a third of the bound allowed, a full step is too long, whatever it gains."""
    args = gail.Args(alpha=0.0, fisher_every=1, kl_slack=0.3)
    _, policy, batch = make_batch(2_000)
    metrics = gail.trpo_step(policy, batch, 0.01, args)
    assert metrics["charts/halvings"] == 1 and 0 < metrics["losses/kl"] <= 0.003 and metrics["losses/gain"] > 0


def test_the_line_search_goes_back_until_the_surrogate_gains():
    """With no limit on the KL divergence, a step far beyond the quadratic model loses."""
    args = gail.Args(alpha=0.0, fisher_every=1, kl_slack=1e9)
    _, policy, batch = make_batch(2_000)
    metrics = gail.trpo_step(policy, batch, 1e4, args)
    assert metrics["charts/halvings"] > 0 and metrics["losses/gain"] > 0


def test_no_step_is_taken_where_none_helps():
    args = gail.Args(alpha=0.0)
    _, policy, batch = make_batch()
    old = policy.vector.clone()
    metrics = gail.trpo_step(policy, batch._replace(advantages=torch.zeros(256)), 0.01, args)
    assert torch.equal(policy.vector, old) and metrics["losses/kl"] == 0


def test_entropy_is_a_gain():
    """The surrogate is that of torch.distributions, and more by the weighed entropy; a step raises every deviation for it."""
    _, policy, batch = make_batch()
    old = policy.vector.clone()
    with torch.no_grad():
        mean, logstd = policy(old, batch.obs)
        pi, weight = torch.distributions.Normal(mean, logstd.exp()), torch.rand(256)
        logprobs = pi.log_prob(batch.actions).sum(1)
        expected = (weight * batch.advantages).mean() + 0.1 * pi.entropy()[0].sum()
        found = gail.surrogate(policy, old, batch, logprobs - weight.log(), 0.1)
    assert found.item() == pytest.approx(expected.item(), rel=1e-4)
    still = batch._replace(advantages=torch.zeros(256))
    gail.trpo_step(policy, still, 0.01, gail.Args(alpha=0.0, ent_coef=0.1))
    assert (policy.vector[-ACTIONS:] > old[-ACTIONS:]).all()


def test_gae_by_the_definition():
    """Sums of (γλ)^l δ, over every episode; behind a time-out the value goes on, behind an end it does not."""
    rng = np.random.default_rng(0)
    rewards, values, next_values = rng.standard_normal((3, 12, 2))
    ended = rng.random((12, 2)) < 0.3
    terminated = ended & (rng.random((12, 2)) < 0.5)
    found = gail.gae(rewards, values, next_values, terminated, ended, 0.9, 0.8)
    for i in range(2):
        for t in range(12):
            expected, weight = 0.0, 1.0
            for k in range(t, 12):
                follows = 0.0 if terminated[k, i] else 0.9 * next_values[k, i]
                expected += weight * (rewards[k, i] + follows - values[k, i])
                weight *= 0.9 * 0.8
                if ended[k, i]:
                    break
            assert found[t, i] == pytest.approx(expected)


# The discriminator
@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_discriminator_loss_against_the_equation(alpha):
    """−L_mix of Eq. 2.3.1, summed by hand, less the entropy of D's verdicts."""
    generator = torch.Generator().manual_seed(0)
    student, rl, human = (torch.randn(size, generator=generator) for size in (20, 20, 20))
    loss, metrics = gail.discriminator_loss(student, rl, human, alpha, 0.01)
    d = [[1 / (1 + math.exp(-logit)) for logit in part.tolist()] for part in (student, rl, human)]
    l_mix = sum(math.log(x) for x in d[0]) / 20
    l_mix += alpha * sum(math.log(1 - x) for x in d[1]) / 20 + (1 - alpha) * sum(math.log(1 - x) for x in d[2]) / 20
    parts = [-sum(x * math.log(x) + (1 - x) * math.log(1 - x) for x in part) / 20 for part in d]
    entropy = 0.5 * parts[0] + 0.5 * (alpha * parts[1] + (1 - alpha) * parts[2])
    assert metrics["losses/l_mix"].item() == pytest.approx(l_mix, rel=1e-5)
    assert loss.item() == pytest.approx(-l_mix - 0.01 * entropy, rel=1e-5)
    assert list(metrics) == list(gail.DISCRIMINATOR_METRICS)


def test_the_best_discriminator_is_the_student_s_share():
    """For densities p of the student and q = α RL + (1 − α) HE, Eq. 2.3.1 is greatest at D = p / (p + q)."""
    p, rl, human, alpha = (
        torch.tensor([0.5, 0.3, 0.2]),
        torch.tensor([0.1, 0.8, 0.1]),
        torch.tensor([0.3, 0.3, 0.4]),
        0.3,
    )
    logits = torch.zeros(3, requires_grad=True)
    optimizer = torch.optim.Adam([logits], 0.05)
    draws = [torch.multinomial(x, 40_000, True, generator=torch.Generator().manual_seed(0)) for x in (p, rl, human)]
    for _ in range(400):
        loss, _ = gail.discriminator_loss(*(logits[draw] for draw in draws), alpha, 0.0)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    q = alpha * rl + (1 - alpha) * human
    assert torch.allclose(torch.sigmoid(logits), p / (p + q), atol=0.01)


def test_accuracy_on_an_expert_without_weight_is_not_a_number():
    _, metrics = gail.discriminator_loss(*torch.tensor([[1.0, -1.0], [1.0, -1.0], [-1.0, -1.0]]), 0.0, 0.0)
    assert metrics["discriminator/accuracy_human"] == 1 and metrics["discriminator/accuracy_student"] == 0.5
    assert metrics["discriminator/accuracy_rl"].isnan()


def test_the_student_is_paid_for_looking_like_the_experts():
    logits = torch.tensor([-3.0, 0.0, 3.0])  # like an expert, undecided, like the student
    positive, signed = (gail.imitation_reward(logits, form) for form in ("positive", "signed"))
    assert torch.allclose(positive, -torch.log(torch.sigmoid(logits)))
    assert torch.allclose(signed, torch.log(1 - torch.sigmoid(logits)) - torch.log(torch.sigmoid(logits)), atol=1e-5)
    assert (positive > 0).all() and (positive.diff() < 0).all() and (signed.diff() < 0).all()


# Demonstrations and driver
def test_the_synthetic_driver_is_the_same_for_the_same_seed_and_reacts_late():
    def drive(seed: int) -> list[dict]:
        games = gail.TorcsLikeVectorEnv(3)
        return gail.play(gail.SyntheticDriver(games.cars, seed), games, [1, 2, 3], keep=True)

    runs = [drive(seed) for seed in (5, 5, 6)]
    same, other = (all(np.array_equal(a["actions"], b["actions"]) for a, b in zip(runs[0], run)) for run in runs[1:])
    assert same and not other
    for episode in runs[0]:
        pedal = episode["actions"][:, 1]
        assert (pedal[: gail.SyntheticDriver.reaction] == 0).all() and (
            pedal[: gail.SyntheticDriver.reaction + 1] > 0
        ).any()
        changes = np.mean((np.diff(episode["actions"], axis=0) != 0).any(1))
        assert 1 / 20 < changes < 1 / 5  # hands move some five times a second


def test_demonstrations_are_normalised_and_within_bounds():
    space = gym.spaces.Box(-1, 1, (2,), np.float32)
    rng = np.random.default_rng(0)
    episode = {"observations": rng.normal(3, 2, (1_001, 4)), "actions": rng.normal(0, 2, (1_000, 2))}
    demonstrations = gail.Demonstrations([episode], space, 1)
    assert demonstrations.actions.abs().max() == 1 and len(demonstrations.obs) == 1_000
    agent = gail.Agent(4, 2, 8)
    agent.set_normalization(demonstrations.obs)
    normalised = agent.normalize(demonstrations.obs)
    assert normalised.mean(0).abs().max() < 1e-5 and (normalised.std(0) - 1).abs().max() < 1e-3
    obs, actions = demonstrations.sample(50)
    for row, action in zip(obs, actions):
        i = (demonstrations.obs == row).all(1).nonzero()[0, 0]
        assert torch.equal(demonstrations.actions[i], action)


def test_demonstrations_are_the_steps_at_which_a_student_with_frame_skip_acts():
    rng = np.random.default_rng(0)
    lengths = (12, 10, 3)  # each episode begins anew
    episodes = [{"observations": rng.random((n + 1, 4)), "actions": rng.random((n, 2))} for n in lengths]
    demonstrations = gail.Demonstrations(episodes, gym.spaces.Box(-1, 1, (2,), np.float32), 5)
    steps = [(0, 0), (0, 5), (0, 10), (1, 0), (1, 5), (2, 0)]
    for got, name in ((demonstrations.obs, "observations"), (demonstrations.actions, "actions")):
        assert np.array_equal(got, np.array([episodes[i][name][t] for i, t in steps], np.float32))


def test_a_rollout_holds_each_action():
    args = gail.Args(num_envs=3, num_steps=4, frame_skip=5)
    torch.manual_seed(0)
    agent, players = gail.Agent(65, 2, 8), gail.make_players(args)
    players.start()
    cars = gail.make_players(args)
    cars.start()
    space = gail.make_env(args.env_id).action_space
    rollout = gail.collect(agent, players, space, args, np.random.default_rng(0))
    assert rollout.actions.shape == (4, 3, 2) and players.games.cars.steps.tolist() == [20] * 3
    for obs, actions, next_obs in zip(rollout.obs, rollout.actions, rollout.next_obs):
        assert np.array_equal(obs, cars.obs)
        for _ in range(5):
            cars.step(gail.bounded(actions, space.low, space.high))
        assert np.array_equal(next_obs, cars.obs)


def test_ends_and_time_outs_of_a_rollout():
    """Two games that end after 4 steps, the first time by an end, the second by a time-out."""
    args = gail.Args(num_envs=2, num_steps=8, frame_skip=1)
    players = gail.GymPlayers([Counter(), Counter()], 0)
    players.start()
    rollout = gail.collect(gail.Agent(1, 1, 8), players, Counter.action_space, args, np.random.default_rng(0))
    for i in range(2):
        assert np.flatnonzero(rollout.ended[:, i]).tolist() == [3, 7]
        assert np.flatnonzero(rollout.terminated[:, i]).tolist() == [3]
        assert rollout.obs[:, i, 0].tolist() == 2 * [0, 1, 2, 3] and rollout.next_obs[:, i, 0].tolist() == 2 * [
            1,
            2,
            3,
            4,
        ]
    assert rollout.episodes == [(8, 4.0, 4)] * 2 + [(16, 4.0, 4)] * 2


def test_gradient_penalty():
    """Of a plane it is (slope - 1)²; of a network, the mean over points between, by differences in double precision."""
    torch.manual_seed(0)
    student, expert = torch.randn(2, 40, 5, dtype=torch.float64)
    slope = torch.tensor([0.0, 3.0, 0.0, -4.0, 0.0], dtype=torch.float64)
    assert gail.gradient_penalty(lambda x: x @ slope, student, expert).item() == pytest.approx((5 - 1) ** 2)

    logits = torch.nn.Sequential(torch.nn.Linear(5, 7), torch.nn.Tanh(), torch.nn.Linear(7, 1)).double()
    torch.manual_seed(1)
    penalty = gail.gradient_penalty(logits, student, expert)
    torch.manual_seed(1)
    share = torch.rand(40, 1)
    between, step = expert + share * (student - expert), 1e-6 * torch.eye(5, dtype=torch.float64)
    with torch.no_grad():
        gradients = [(logits(between + axis) - logits(between - axis)) / 2e-6 for axis in step]
    lengths = torch.cat(gradients, 1).norm(dim=1)
    assert penalty.item() == pytest.approx(((lengths - 1) ** 2).mean().item(), rel=1e-6)
    penalty.backward()
    assert logits[0].weight.grad.abs().max() > 0


def test_the_discriminator_learns_with_and_without_its_penalty():
    """Experts at +1, student at -1: logits get the right signs, and with the penalty they stay as steep as 1."""
    space, args = gym.spaces.Box(-2, 2, (1,)), gail.Args(alpha=0.25, d_grad_penalty=0.0)
    episode = {"observations": np.zeros((1_001, OBS)), "actions": np.ones((1_000, 1))}
    experts = gail.Experts(*(gail.Demonstrations([episode], space, 1) for _ in range(2)))
    obs, actions = torch.zeros(500, OBS), -torch.ones(500, 1)
    batch = gail.Batch(obs, actions, actions, torch.zeros(500), torch.zeros(500))
    steepness = {}
    for weight in (0.0, 10.0):
        torch.manual_seed(0)
        agent, args.d_grad_penalty = gail.Agent(OBS, 1, 32), weight
        optimizer = torch.optim.Adam(agent.discriminator.parameters(), 1e-3)
        for _ in range(600):
            metrics = gail.update_discriminator(agent, optimizer, batch, experts, args)
        assert metrics["discriminator/accuracy_student"] == metrics["discriminator/accuracy_human"] == 1
        with torch.no_grad():
            student, expert = (agent.logits(torch.cat([obs[:1], a[:1]], 1)).item() for a in (actions, -actions))
        assert student > 0 > expert
        steepness[weight] = (student - expert) / 2
    assert steepness[10.0] == pytest.approx(1, abs=0.1) and steepness[0.0] > 3


@pytest.mark.parametrize("env_id", ["InvertedPendulum-v5", "Hopper-v5"])
def test_a_step_of_trpo_is_sb3_contrib_s(env_id, monkeypatch):
    """From the same weights, on the same 2,048 steps, both move the policy's parameters by the same vector.

    Theirs averages the KL divergence over the A dimensions of the actions, where TRPO's sums: its bound and its damping
    are ours divided by A.
    """
    theirs = TRPO("MlpPolicy", gym.make(env_id), seed=1, device="cpu")
    theirs.learn(2_048)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(theirs, "train", lambda: None)
        theirs.learn(2_048, reset_num_timesteps=False)
    steps, policy_net = next(theirs.rollout_buffer.get()), theirs.policy.mlp_extractor.policy_net
    obs_dim, action_dim = theirs.observation_space.shape[0], theirs.action_space.shape[0]
    agent = gail.Agent(obs_dim, action_dim, 64)
    for ours, layer in zip(agent.actor_mean[::2], (policy_net[0], policy_net[2], theirs.policy.action_net)):
        ours.load_state_dict(layer.state_dict())
    agent.actor_logstd.data = theirs.policy.log_std.detach().clone()
    policy = gail.PolicyVector(agent)
    old = policy.vector.clone()
    advantages = (steps.advantages - steps.advantages.mean()) / (steps.advantages.std() + 1e-8)
    batch = gail.Batch(steps.observations.float(), steps.actions, steps.actions, advantages, steps.returns)
    same = {"cg_iterations": theirs.cg_max_steps, "cg_damping": action_dim * theirs.cg_damping}
    args = gail.Args(alpha=0.0, fisher_every=1, **same)
    metrics = gail.trpo_step(policy, batch, action_dim * theirs.target_kl, args)
    assert metrics["charts/halvings"] == 0

    monkeypatch.setattr(torch, "randn_like", torch.zeros_like)  # theirs begins the search at a small random vector
    theirs.train()
    parameters = [*policy_net.parameters(), *theirs.policy.action_net.parameters(), theirs.policy.log_std]
    found = torch.cat([parameter.detach().reshape(-1) for parameter in parameters])
    assert (found - policy.vector).norm() < 1e-3 * (found - old).norm()


def test_behaviour_cloning_mixes_two_actions_into_one_between_them():
    """Experts who steer to opposite sides: the mean is the weighted one, which neither takes (section 2.3.2)."""
    space = gym.spaces.Box(-1, 1, (1,))
    rng = np.random.default_rng(0)

    def expert(action: float) -> gail.Demonstrations:
        observations = rng.standard_normal((2_001, OBS))
        return gail.Demonstrations([{"observations": observations, "actions": np.full((2_000, 1), action)}], space, 1)

    torch.manual_seed(0)
    agent = gail.Agent(OBS, 1, 16)
    experts = gail.Experts(rl=expert(-0.8), human=expert(0.8))
    gail.behaviour_cloning(agent, experts, gail.Args(alpha=0.25, bc_epochs=120))
    means = agent.actor_mean(experts.human.obs)
    assert means.mean().item() == pytest.approx(0.4, abs=0.03) and means.std() < 0.1
    spread = 0.8 * 2 * (0.25 * 0.75) ** 0.5  # deviation of a coin between both
    assert agent.actor_logstd.exp().item() == pytest.approx(spread, rel=0.1)


def test_trpo_alone_has_the_environments_rewards(monkeypatch):
    """As benchmark/trpo_returns.py has it beside sb3-contrib's: the pendulum's return is the length of its episode."""
    monkeypatch.syspath_prepend(ROOT / "benchmark")
    trpo = importlib.import_module("trpo_returns")
    returns = trpo.last_returns(trpo.Args(env_id="InvertedPendulum-v5", batches=1), 1)
    assert 10 < len(returns) <= 50 and all(value == int(value) >= 0 for value in returns) and sum(returns) > 50


# From the demonstrations to the update
SPACE = gym.spaces.Box(-1, 1, (1,))


def one_action(action: float) -> gail.Demonstrations:
    """An expert who always does the same."""
    episode = {"observations": np.zeros((101, OBS), np.float32), "actions": np.full((100, 1), action, np.float32)}
    return gail.Demonstrations([episode], SPACE, 1)


def of_student(action: float, size: int) -> gail.Batch:
    actions = torch.full((size, 1), action)
    return gail.Batch(torch.zeros(size, OBS), actions, actions, torch.zeros(size), torch.zeros(size))


@pytest.mark.parametrize("alpha", [0.0, 1.0])
def test_alpha_is_the_weight_of_the_reinforcement_learning_expert(alpha):
    """The discriminator takes for the student's (logit above 0) what the expert without weight does, not the other's."""
    torch.manual_seed(0)
    agent = gail.Agent(OBS, 1, 32)
    adam, args = torch.optim.Adam(agent.discriminator.parameters(), 1e-3), gail.Args(alpha=alpha, d_grad_penalty=0.0)
    for _ in range(600):
        gail.update_discriminator(
            agent, adam, of_student(0.0, 500), gail.Experts(one_action(1.0), one_action(-1.0)), args
        )
    rl, human = (agent.logits(torch.tensor([[0.0] * OBS + [action]])).item() for action in (1.0, -1.0))
    assert (rl < 0 < human) if alpha else (human < 0 < rl)


def test_the_discriminator_sees_student_and_experts_alike():
    """Observations normalised on both sides, and the actions as the environment had them, within its bounds."""
    agent, seen = gail.Agent(OBS, 1, 8), []
    agent.set_normalization(5 + 3 * torch.randn(200, OBS))
    logits = agent.logits
    agent.logits = lambda pairs: seen.append(pairs.detach()) or logits(pairs)
    batch = of_student(3.0, 20)._replace(seen=torch.ones(20, 1), obs=torch.full((20, OBS), 0.5))
    adam = torch.optim.SGD(agent.discriminator.parameters(), 0.0)
    experts, args = gail.Experts(one_action(1.0), one_action(-1.0)), gail.Args(alpha=0.5, d_grad_penalty=0.0, d_steps=1)
    gail.update_discriminator(agent, adam, batch, experts, args)
    zero = agent.normalize(torch.zeros(1, OBS)).expand(20, -1)
    assert torch.equal(seen[0], torch.cat([batch.obs, batch.seen], 1)) and zero.abs().min() > 1
    for pairs, action in zip(seen[1:], (1.0, -1.0), strict=True):
        assert torch.allclose(pairs, torch.cat([zero, torch.full((20, 1), action)], 1))


def test_a_clone_acts_on_normalised_observations():
    """The expert steers by how far its first observation is from the mean."""
    torch.manual_seed(0)
    agent, obs = gail.Agent(OBS, 1, 32), 5 + 3 * torch.randn(4_001, OBS)
    agent.set_normalization(obs)
    actions = 0.3 * agent.normalize(obs)[:-1, :1]
    expert = gail.Demonstrations(
        [{"observations": obs.numpy(), "actions": actions.numpy()}], gym.spaces.Box(-9, 9, (1,)), 1
    )
    gail.behaviour_cloning(agent, gail.Experts(expert, expert), gail.Args(alpha=0.5, bc_epochs=60))
    with torch.no_grad():
        found = agent.actor_mean(agent.normalize(obs))[:-1]
    assert (found - actions).square().mean() < 0.05 * actions.var()


def test_each_experts_penalty_has_its_weight(monkeypatch):
    torch.manual_seed(0)
    agent, losses = gail.Agent(OBS, 1, 32), []
    experts, adam = (
        gail.Experts(one_action(1.0), one_action(-1.0)),
        torch.optim.SGD(agent.discriminator.parameters(), 0.0),
    )
    plain = gail.discriminator_loss
    monkeypatch.setattr(
        gail, "gradient_penalty", lambda logits, student, expert: expert[0, -1].clamp(min=0)
    )  # 1 of RL's
    backward = torch.Tensor.backward
    monkeypatch.setattr(torch.Tensor, "backward", lambda loss: losses.append(loss.item()) or backward(loss))
    monkeypatch.setattr(gail, "discriminator_loss", lambda *its: (0 * plain(*its)[0], {}))
    gail.update_discriminator(
        agent, adam, of_student(0.0, 50), experts, gail.Args(alpha=0.3, d_grad_penalty=2.0, d_steps=1)
    )
    assert losses == pytest.approx([2 * 0.3])


def test_a_batch_by_hand():
    """Rewards and values of what the environment had, actions within bounds; time-outs are no ends."""
    torch.manual_seed(0)
    agent, args = gail.Agent(OBS, 1, 8), gail.Args(gamma=0.9, gae_lambda=0.8)
    agent.set_normalization(1 + torch.randn(99, OBS))
    obs, next_obs = np.random.default_rng(0).standard_normal((2, 3, 2, OBS)).astype(np.float32)
    ended, terminated = np.zeros((2, 3, 2), bool)
    ended[0, 1] = ended[1, 0] = terminated[0, 1] = True
    rollout = gail.Rollout(obs, np.full((3, 2, 1), 3, np.float32), next_obs, terminated, ended, [])
    rewards = gail.imitation_rewards(agent, rollout, SPACE, "positive", torch.device("cpu"))
    logits = agent.logits(agent.pairs(torch.from_numpy(obs).flatten(0, 1), torch.ones(6, 1)))
    assert np.allclose(rewards.ravel(), -torch.sigmoid(logits).log().detach(), atol=1e-5)
    batch = gail.make_batch(agent, rollout, rewards, SPACE, args, torch.device("cpu"))
    with torch.no_grad():
        flat = (agent.normalize(torch.from_numpy(each).flatten(0, 1)) for each in (obs, next_obs))
        values, next_values = (agent.value(each).numpy().reshape(3, 2) for each in flat)
    advantages = np.zeros((3, 2))
    for i in range(2):
        following = 0.0
        for t in reversed(range(3)):
            delta = rewards[t, i] + 0.9 * next_values[t, i] * (not terminated[t, i]) - values[t, i]
            following = delta + 0.9 * 0.8 * following * (not ended[t, i])
            advantages[t, i] = following
    assert np.allclose(batch.returns, (advantages + values).ravel(), atol=1e-5)
    scaled = (advantages - advantages.mean()) / advantages.std()
    assert np.allclose(batch.advantages, scaled.ravel(), atol=1e-4)
    assert (batch.seen == 1).all() and (batch.actions == 3).all()


def test_the_critic_learns_the_returns():
    torch.manual_seed(0)
    agent, args = gail.Agent(OBS, 1, 32), gail.Args(batch_size=256)
    obs = torch.randn(256, OBS)
    returns = 3 + obs[:, 0]
    batch = gail.Batch(obs, obs[:, :1], obs[:, :1], -returns, returns)
    optimizer = torch.optim.Adam(agent.critic.parameters(), 1e-2)
    losses = [gail.update_values(agent, optimizer, batch, args) for _ in range(60)]
    assert losses[-1] < 0.1 * losses[0]


def test_the_student_acts_as_it_is_trained():
    """In rollouts and in evaluation: the mean of normalised observations, and noise of the policy's deviation."""
    torch.manual_seed(0)
    agent, space = gail.Agent(65, 2, 8), gym.spaces.Box(-9, 9, (2,))
    agent.set_normalization(3 + 2 * torch.randn(500, 65))
    with torch.no_grad():
        agent.actor_logstd.fill_(-1.0)
        agent.actor_mean[4].weight.mul_(50)
    obs = 3 + 8 * torch.randn(4_000, 65)
    with torch.no_grad():
        mean = agent.actor_mean(agent.normalize(obs)).numpy()
    assert np.allclose(gail.make_policy(agent, "greedy", space, 0)(obs.numpy()), mean, atol=1e-4)
    noise = gail.make_policy(agent, "sampled", space, 0)(obs.numpy()) - mean
    assert noise.std() == pytest.approx(math.exp(-1), rel=0.03)
    args = gail.Args(num_envs=3, num_steps=4, frame_skip=1)
    players = gail.make_players(args)
    players.start()
    rollout = gail.collect(agent, players, gail.make_env(args.env_id).action_space, args, np.random.default_rng(0))
    with torch.no_grad():
        mean = agent.actor_mean(agent.normalize(torch.from_numpy(rollout.obs))).numpy()
    rng = np.random.default_rng(0)
    noise = np.stack([rng.standard_normal((3, 2), np.float32) for _ in range(4)])
    assert np.allclose((rollout.actions - mean) / math.exp(-1), noise, atol=1e-3)
