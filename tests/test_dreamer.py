"""DreamerV2: its functions against independent sources, small worlds whose values are known, and small runs."""

import contextlib
import csv
import ctypes
import errno
import importlib
import json
import math
import os
import shutil
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest
import safetensors.torch
import scipy.stats
import torch
import torch.nn.functional as F
from conftest import ROOT, beliefs_of_play, kill_twice, needs_compiler, run

from cleanrl_thesis import dreamer_v2 as method
from cleanrl_thesis import ppo_fourrooms as rooms

sys.path.append(str(ROOT / "benchmark"))
import dreamer_goals  # noqa: E402
import dreamer_reads  # noqa: E402
import dreamer_report  # noqa: E402
import dreamer_true  # noqa: E402
from common import UsageError  # noqa: E402

SCRIPT = ROOT / "cleanrl_thesis" / "dreamer_v2.py"
CPU = torch.device("cpu")
TINY = {"deter": 12, "stoch": 3, "classes": 4, "hidden_size": 16, "head_size": 16, "depth": 2, "batch_size": 3}
TINY |= {"chunk_length": 6, "starts": 8, "horizon": 4}
FLAGS = [part for name, value in TINY.items() for part in (f"--{name.replace('_', '-')}", value)]
# 500 random steps, then 25 updates in each of two blocks, a checkpoint after each
SMALL = [*FLAGS, "--total-timesteps", 1500, "--prefill", 500, "--train-frequency", 20, "--checkpoint-interval", 500]
SMALL += ["--eval-episodes", 4, "--kl-warmup", 20]


def make_args(**changes) -> method.Args:
    return method.complete_args(method.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000, **changes}))


def make_learner(**changes) -> method.Learner:
    args = make_args(**changes)
    torch.manual_seed(0)
    model = method.WorldModel(args, 3)
    method.set_frame_statistics(model, args)
    return method.Learner(args, model, CPU)


def make_collector(tmp_path, learner: method.Learner, steps: int = 60) -> method.Collector:
    args = learner.args
    replay = method.Replay(tmp_path / "replay.dat", args)
    collector = method.Collector(args, replay, method.Player(learner, args.num_envs))
    collector.reset()
    for _ in range(steps):
        collector.step(randomly=True)
    return collector


def make_data(first: list[list[int]]) -> method.Chunks:
    """Random chunks; first (B, T) says where episodes begin."""
    torch.manual_seed(1)
    begins = torch.tensor(first, dtype=torch.float32).T
    frames = torch.randint(0, 256, (*begins.shape, 22, 22, 3), dtype=torch.uint8)
    actions = torch.randint(3, begins.shape) * (1 - begins).long()
    return method.Chunks(frames, actions, begins, torch.rand(begins.shape), torch.zeros(begins.shape))


def wake(module: torch.nn.Module) -> None:
    """Give heads that start at zero something to say."""
    torch.manual_seed(5)
    for parameter in module.parameters():
        torch.nn.init.normal_(parameter, std=0.3)


# The replay
def test_the_replay_holds_what_was_played(tmp_path):
    """A row is a game's episodes one after the other: played again by MiniGrid's own rules, each record agrees."""
    collector = make_collector(tmp_path, make_learner(), steps=150)
    replay, maze, ends = collector.replay, method.maze(11), 0
    for row, length in zip(replay.rows, replay.lengths):
        steps = 0
        for t in range(length):
            record = row[t]
            if record["first"]:
                assert (record["action"], record["reward"], record["terminal"]) == (0, 0, 0)
                assert (record["pose"], record["goal"]) in {tuple(start) for start in maze.starts}
                steps = 0
                continue
            steps += 1
            assert record["pose"] == maze.moves[row[t - 1]["pose"], record["action"]]
            assert record["goal"] == row[t - 1]["goal"]
            reached = record["pose"] // 4 == record["goal"]
            assert record["terminal"] == reached
            assert record["reward"] == np.float32(1 - 0.9 * steps / 100 if reached else 0)
            is_last = reached or steps == 100
            assert t + 1 == length or row[t + 1]["first"] == is_last
            ends += is_last
    assert ends >= 10


def test_chunks_are_pieces_of_the_rows(tmp_path):
    """Frames of the states, the action that led to each, `first` at the chunk's begin and where an episode begins."""
    collector = make_collector(tmp_path, make_learner(), steps=150)
    replay = collector.replay
    replay.rows["reward"] = np.arange(replay.rows.size).reshape(replay.rows.shape)  # a name for each place
    painter, inner, places = method.painter(11, 22), 0, []
    for _ in range(200):
        data = replay.sample(CPU)
        assert data.frames.shape == (6, 3, 22, 22, 3) and data.frames.dtype == torch.uint8
        for b in range(3):
            game, begin = divmod(int(data.rewards[0, b]), replay.rows.shape[1])
            rows = replay.rows[game, begin : begin + 6]
            assert begin + 6 <= replay.lengths[game]
            assert data.rewards[:, b].tolist() == rows["reward"].tolist()
            assert data.actions[:, b].tolist() == rows["action"].tolist()
            assert data.terminals[:, b].tolist() == rows["terminal"].tolist()
            assert data.first[:, b].tolist() == [1, *rows["first"][1:].tolist()]
            frames = painter.draw(rows["pose"].astype(int), rows["goal"].astype(int))
            assert np.array_equal(data.frames[:, b].numpy(), frames)
            inner += int(rows["first"][1:].sum())
            places.append(begin / (replay.lengths[game] - 5))
    assert inner > 0 and abs(np.mean(places) - 0.5) < 0.05 and min(places) < 0.02 and max(places) > 0.98


def test_some_chunks_hold_a_reward(tmp_path):
    """The asked-for share of a batch: every reward as likely, anywhere in its chunk; the same after going on."""
    learner = make_learner(batch_size=8, rewarded_share=0.25)
    replay = make_collector(tmp_path, learner, steps=0).replay
    for row in replay.rows:
        row["reward"], row["pose"] = 0, np.arange(replay.rows.shape[1])
    winners = [(0, 0), (0, 97), (1, 5), (1, 50), (1, 99)]  # at both ends, a chunk cannot hold it anywhere
    replay.rewarded = [[] for _ in replay.lengths]
    for game, t in winners:
        replay.rows[game, t]["reward"] = 1
    replay.go_on(np.array([100] * len(replay.lengths)))
    assert [(game, t) for game, found in enumerate(replay.rewarded) for t in found] == winners
    counts, offsets = dict.fromkeys(winners, 0), []
    for _ in range(1_000):
        for game, begin in list(zip(*replay.places()))[-2:]:
            assert 0 <= begin <= 94
            held = [(g, t) for g, t in winners if g == game and begin <= t < begin + 6]
            counts[held[0]] += len(held) == 1
            offsets += [50 - begin] if held == [(1, 50)] else []
    assert sum(counts.values()) == 2_000 and np.allclose(list(counts.values()), 400, atol=60)
    assert np.allclose(np.bincount(offsets, minlength=6) / len(offsets), 1 / 6, atol=0.06)


def test_rewards_are_known_where_they_are_added(tmp_path):
    replay = make_collector(tmp_path, make_learner(total_timesteps=10_000), steps=400).replay
    known = [list(found) for found in replay.rewarded]
    assert sum(map(len, known)) > 0
    replay.go_on(replay.lengths.copy())
    assert replay.rewarded == known


def test_random_play_leaves_no_belief(tmp_path):
    """Who takes over begins as a chunk does, in the middle of an episode."""
    collector = make_collector(tmp_path, make_learner(), steps=7)
    assert collector.begins.all() and not collector.replay.rows["first"][:, 7].any()
    collector.step(randomly=False)
    assert not collector.begins.any()


def test_beliefs_in_play_are_those_of_training(tmp_path):
    """Over ends of episodes, by the actions that were taken: the model infers the same from the replay."""
    learner = make_learner(num_envs=5)
    played, inferred = beliefs_of_play(method, learner, tmp_path / "replay.dat", 130)
    assert all(torch.allclose(a, b, atol=1e-4) for mine, other in zip(played, inferred) for a, b in zip(mine, other))


def test_random_play_then_the_policy_and_updates(tmp_path, monkeypatch):
    """Which of the two acts on each side of --prefill, and after how many updates the model's losses are told to be."""
    calls, counts = [], []
    for name in ("act", "act_randomly"):
        plain = getattr(method.Player, name)
        acts = lambda *its, name=name, plain=plain, **more: calls.append(name) or plain(*its, **more)  # noqa: E731
        monkeypatch.setattr(method.Player, name, acts)
    loss = method.world_model_loss
    monkeypatch.setattr(method, "world_model_loss", lambda *its: counts.append(its[2]) or loss(*its))
    run(*SMALL, "--train-frequency", 50, "--stop-at", 1000, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    assert calls[:100] == ["act_randomly"] * 50 + ["act"] * 50 and counts == list(range(10))
    assert set(calls[100:]) == {"act"}  # the evaluation


def test_the_player_draws_or_takes_the_best():
    learner = make_learner()
    player = method.Player(learner, 20_000)
    learner.behaviour.policy = lambda features: torch.tensor([0.2, 0.5, 0.3]).log().expand(len(features), 3)
    assert (player.act(greedy=True) == 1).all() and player.action[:, 1].all()
    actions = player.act()
    assert np.allclose(np.bincount(actions) / 20_000, [0.2, 0.5, 0.3], atol=0.015)
    assert np.array_equal(player.action.argmax(1), actions)


# The model
def test_the_cell_keeps_its_state_by_its_update_gate():
    """Gate by gate, in numpy: gates of the normalised sums, the update's less 1, as in DreamerV2."""
    torch.manual_seed(0)
    cell, x, state = method.GRUCell(3, 4), torch.randn(2, 3), torch.randn(2, 4)
    sums = np.concatenate([x, state], 1) @ cell.linear.weight.detach().numpy().T
    sums = (sums - sums.mean(1, keepdims=True)) / np.sqrt(sums.var(1, keepdims=True) + 1e-5)
    reset, candidate, update = sums[:, :4], sums[:, 4:8], 1 / (1 + np.exp(1 - sums[:, 8:]))
    expected = update * np.tanh(candidate / (1 + np.exp(-reset))) + (1 - update) * state.numpy()
    assert np.allclose(cell(x, state).detach(), expected, atol=1e-5)


def test_tiles_are_squares_of_two_by_two_pixels():
    """The encoder is a convolution of stride 2; the decoder puts each tile where the encoder has it."""
    torch.manual_seed(0)
    encoder, frames = method.TileEncoder(10, 4), torch.randn(3, 10, 10, 3)
    kernel = encoder.map.weight.view(4, 2, 2, 3).permute(0, 3, 1, 2)
    expected = F.conv2d(frames.permute(0, 3, 1, 2), kernel, encoder.map.bias, stride=2)
    assert torch.allclose(encoder(frames), F.silu(expected).permute(0, 2, 3, 1).flatten(1), atol=1e-5)
    decoder = method.TileDecoder(5, 10, 4)
    tiles = decoder.spread(torch.ones(1, 5)).view(5, 5, 4).permute(2, 0, 1)[None]
    kernel = decoder.map.weight.view(2, 2, 3, 4).permute(3, 2, 0, 1)
    expected = F.conv_transpose2d(tiles, kernel, stride=2) + decoder.map.bias.view(2, 2, 3).permute(2, 0, 1).repeat(
        1, 5, 5
    )
    assert torch.allclose(decoder(torch.ones(1, 5)), expected.permute(0, 2, 3, 1), atol=1e-5)


@pytest.mark.parametrize("size", ["xs", "s", "m", "thesis"])
def test_sizes(size):
    args = method.complete_args(method.Args(size=size))
    if size == "thesis":
        assert args.stoch * args.classes + args.deter == 1_624  # Q&A 5
        args.depth = args.hidden_size = args.head_size = 8  # the shapes are what is looked at
    model = method.WorldModel(args, 3)
    frames = torch.zeros(2, args.frame_side, args.frame_side, 3)
    assert model.embedding(frames).shape == (2, args.hidden_size)
    assert model.decoder(torch.zeros(2, model.feature_size)).shape == frames.shape


def test_draws_follow_the_probabilities_and_carry_their_gradient():
    logits = torch.log(torch.tensor([0.6, 0.3, 0.1])).repeat(50_000, 1).requires_grad_()
    drawn = method.straight_through(logits, torch.rand(50_000))
    assert ((drawn.detach() - 1).abs() < 1e-6).sum() == 50_000 and torch.allclose(
        drawn.sum(-1), torch.ones(50_000), atol=1e-5
    )
    assert torch.allclose(drawn.detach().mean(0), torch.tensor([0.6, 0.3, 0.1]), atol=0.01)
    weights = torch.tensor([1.0, -2.0, 3.0])
    (drawn[0] @ weights).backward()
    again = logits.detach()[0].requires_grad_()
    (again.softmax(-1) @ weights).backward()
    assert torch.allclose(logits.grad[0], again.grad, atol=1e-6)


def test_kl_against_torch_distributions():
    torch.manual_seed(0)
    q, p = torch.randn(5, 3, 4), torch.randn(5, 3, 4)
    categorical = torch.distributions.OneHotCategorical
    expected = torch.distributions.kl_divergence(categorical(logits=q), categorical(logits=p)).sum(-1)
    assert torch.allclose(method.kl_categorical(q, p), expected, atol=1e-5)
    q, p = q.requires_grad_(), p.requires_grad_()
    value = method.balanced(method.kl_categorical, q, p, 0.8)
    assert torch.allclose(value, expected, atol=1e-5)
    gradients = torch.autograd.grad(value.sum(), (q, p))
    whole = torch.autograd.grad(method.kl_categorical(q, p).sum(), (q, p))
    assert torch.allclose(gradients[0], 0.2 * whole[0], atol=1e-6) and torch.allclose(
        gradients[1], 0.8 * whole[1], atol=1e-6
    )


def test_four_fifths_of_the_kl_gradient_train_the_prior():
    """In steps without a past, where the prior's weights are in p alone and the posterior's in q alone."""
    learner, data = make_learner(), make_data([[1, 1], [1, 1]])
    args, model = learner.args, learner.model
    args.image_scale = args.reward_scale = args.discount_scale = args.entropy_scale = 0.0
    weights = model.prior_layers[-1].weight, model.posterior_out.weight
    torch.manual_seed(2)
    loss, _, _ = method.world_model_loss(model, data, 10**6)
    torch.manual_seed(2)
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    made = model.observe(embed, F.one_hot(data.actions, 3).float(), data.first)
    categorical = torch.distributions.OneHotCategorical
    plain = torch.distributions.kl_divergence(categorical(logits=made.posterior), categorical(logits=made.prior))
    whole = torch.autograd.grad(plain.sum(-1).mean(), weights)
    for part, wanted, share in zip(torch.autograd.grad(loss, weights), whole, (0.8, 0.2)):
        assert wanted.abs().max() > 1e-4 and torch.allclose(part, share * wanted, rtol=1e-3, atol=1e-7)


def test_the_weight_of_the_kl_grows_from_a_tenth():
    args = make_args(kl_warmup=1_000)
    shares = [method.warm_up(args, updates) for updates in (0, 49, 499, 999, 5_000)]
    assert shares == pytest.approx([0.1, 0.1, 0.5, 1, 1])
    assert method.warm_up(make_args(kl_warmup=0, entropy_scale=0.0), 0) == 1


def test_an_episode_forgets_the_one_before_and_nothing_of_its_own():
    """`first` masks the state and action before the step at which it stands, not one step early or late."""
    learner = make_learner()
    model = learner.model
    embed, actions = torch.randn(6, 2, 16), F.one_hot(torch.randint(3, (6, 2)), 3).float()
    first = torch.zeros(6, 2)
    first[0], first[3, 0] = 1, 1

    def deter(embed, actions):
        torch.manual_seed(1)
        return model.observe(embed, actions, first).state.deter

    plain = deter(embed, actions)
    for t in range(3):  # the past of step 3 in chunk 0 is forgotten, that in chunk 1 is not
        changed = embed.clone()
        changed[t] += 5
        after = deter(changed, actions)
        assert torch.equal(after[3:, 0], plain[3:, 0]) and not torch.equal(after[3:, 1], plain[3:, 1])
        assert torch.equal(after[: t + 1], plain[: t + 1])
        if t < 2:
            assert not torch.equal(after[t + 1 : 3, 0], plain[t + 1 : 3, 0])
    changed = actions.clone()
    changed[3] = 1 - changed[3]  # the action before an episode's first frame is of the episode before
    after = deter(embed, changed)
    assert torch.equal(after[3, 0], plain[3, 0]) and not torch.equal(after[3, 1], plain[3, 1])


def test_what_is_drawn_trains_the_posterior(tmp_path):
    """Through the codes: without the weight of the KL divergence, which has a gradient of its own."""
    learner = make_learner(kl_scale=0.0, entropy_scale=0.0, reward_scale=0.0, discount_scale=0.0)
    wake(learner.model)
    method.world_model_loss(learner.model, make_collector(tmp_path, learner).replay.sample(CPU), 0)[0].backward()
    assert learner.model.posterior_out.weight.grad.abs().max() > 1e-6


@pytest.mark.parametrize("tanh", [False, True])
def test_loss_is_the_sum_of_its_parts(tmp_path, tanh):
    learner = make_learner(kl_balance=0.5, reward_scale=3.0, tanh_reward=tanh)
    wake(learner.model)
    data = make_collector(tmp_path, learner).replay.sample(CPU)
    data.rewards[2, 1], data.terminals[2, 1] = 0.7, 1.0
    torch.manual_seed(3)
    loss, states, parts = method.world_model_loss(learner.model, data, 499)
    torch.manual_seed(3)
    model, frames = learner.model, learner.model.normalize(data.frames)
    embed = model.embedding(frames.flatten(0, 1)).unflatten(0, (6, 3))
    made = model.observe(embed, F.one_hot(data.actions, 3).float(), data.first)
    features = torch.cat([made.state.stoch, made.state.deter], -1)
    assert torch.equal(features, states.features())
    image = reward = discount = kl = entropy = 0.0
    for t in range(6):
        for b in range(3):
            image += 0.5 * (model.decoder(features[t, b][None])[0] - frames[t, b]).square().sum()
            predicted, goes_on = model.outcome(features[t, b])
            target = np.tanh(data.rewards[t, b].item()) if tanh else data.rewards[t, b]
            reward += 0.5 * (predicted - target) ** 2
            discount -= torch.log(1 - goes_on if data.terminals[t, b] else goes_on)
            kl += method.kl_categorical(made.posterior[t, b], made.prior[t, b])
            entropy += torch.distributions.OneHotCategorical(logits=made.posterior[t, b]).entropy().sum()
    total = (0.25 * image + 3 * reward + 5 * discount + 0.5 * kl - 0.5 * 0.3 * entropy) / 18  # half of the warm-up
    assert loss.item() == pytest.approx(total.item(), rel=1e-4)
    assert parts["losses/image"].item() == pytest.approx(image.item() / 18, rel=1e-4)
    assert parts["losses/reward"].item() == pytest.approx(reward.item() / 18, rel=1e-4)
    inside = data.first == 0  # a first frame has no past to be foretold from
    of_steps = method.kl_categorical(made.posterior, made.prior)[inside]
    assert parts["losses/kl"].item() == pytest.approx(of_steps.mean().item(), rel=1e-4)


def test_frames_are_normalised():
    """The mean over all starts is 0; every channel that is not dim has size 1."""
    learner, starts = make_learner(), method.maze(11).starts
    frames = torch.from_numpy(method.painter(11, 22).draw(starts[:, 0], starts[:, 1]))
    x = learner.model.normalize(frames).double()
    assert x.mean(0).abs().max() < 1e-2
    sizes = x.square().mean((0, 1, 2)).sqrt()
    assert sizes.max() == pytest.approx(1, abs=1e-2) and sizes.min() > 0.05


def test_pictures_of_the_convolutions_are_between_minus_and_plus_a_half():
    """Nothing behind the decoder's last layer bounds them."""
    args = method.complete_args(method.Args(size="m", depth=1))
    model = method.WorldModel(args, 3)
    method.set_frame_statistics(model, args)
    ends = model.normalize(torch.tensor([0, 255], dtype=torch.uint8)[:, None, None, None].expand(2, 64, 64, 3))
    assert ends[0].unique().tolist() == [-0.5] and ends[1].unique().tolist() == [0.5]
    with torch.no_grad():
        model.decoder.layers[-1].weight.zero_()
        model.decoder.layers[-1].bias.fill_(-0.5)
        assert (model.decoder(torch.randn(2, model.feature_size)) == -0.5).all()


def test_the_posterior_knows_the_past_and_the_frame():
    model = make_learner().model
    deter, embed = torch.randn(2, 12), torch.randn(2, 16)
    plain = model.posterior(deter, embed)
    assert not torch.allclose(plain, model.posterior(deter + 1, embed))
    assert not torch.allclose(plain, model.posterior(deter, embed + 1))


# Returns and the dream
def brute_force_return(rewards, discounts, values, gae_lambda, h) -> float:
    """The mean of all n-step returns from step h, weighed by (1 − λ) λ^(n − 1), the rest on the longest (Sutton & Barto)."""
    horizon, total = len(rewards), 0.0
    for n in range(1, horizon - h + 1):
        value, weight = 0.0, 1.0
        for k in range(h, h + n):
            value += weight * rewards[k]
            weight *= discounts[k]
        value += weight * values[h + n]
        share = gae_lambda ** (n - 1) * (1 - gae_lambda if n < horizon - h else 1)
        total += share * value
    return total


@pytest.mark.parametrize("terminal", [None, *range(6)])
def test_lambda_return_by_brute_force(terminal):
    rng = np.random.default_rng(0)
    rewards, discounts, values = rng.normal(size=(6, 2)), 0.97 * rng.random((6, 2)), rng.normal(size=(7, 2))
    if terminal is not None:
        discounts[terminal] = 0
    tensors = [torch.from_numpy(array) for array in (rewards, discounts, values)]
    returns = method.lambda_return(*tensors, 0.9).numpy()
    for h in range(6):
        for n in range(2):
            expected = brute_force_return(rewards[:, n], discounts[:, n], values[:, n], 0.9, h)
            assert returns[h, n] == pytest.approx(expected)
    if terminal is not None:  # nothing behind the end counts
        assert returns[terminal] == pytest.approx(rewards[terminal])


def test_the_action_that_reaches_the_goal_has_its_weight():
    """The weight of state h is that the dream goes on up to h; the end at h + 1 takes nothing from action h."""
    discounts = torch.tensor([[0.9], [0.0], [0.9], [0.9]])  # state 2 is the end
    assert method.dream_weights(discounts).squeeze(1).tolist() == pytest.approx([1, 0.9, 0, 0])


def test_the_dream_draws_the_state_from_its_prior():
    model = make_learner().model
    wake(model)
    state = method.State(*(part.expand(20_000, -1) for part in model.start(1)))
    actions = F.one_hot(torch.ones(20_000, dtype=torch.int64), 3).float()
    after = model.imagine_step(state, actions, model.noise(20_000))
    deter = model.recur(state, actions)
    assert torch.equal(after.deter, deter) and after.deter.abs().max() > 0
    shares = model.prior(deter[:1]).softmax(-1).flatten()
    assert torch.allclose(after.stoch.mean(0), shares, atol=0.015) and 0.02 < shares.min() < shares.max() < 0.98


class ChainState(NamedTuple):
    place: torch.Tensor  # (N, 5) one-hot

    def features(self) -> torch.Tensor:
        return self.place


class Chain(torch.nn.Module):
    """Places 0 to 4; action 1 leads up, 0 down; to arrive at 4 pays 1 and ends the episode."""

    feature_size, num_actions = 5, 2

    def __init__(self):
        super().__init__()
        self.unused = torch.nn.Parameter(torch.zeros(1))

    def noise(self, *shape):
        return torch.zeros(*shape, 1)

    def imagine_step(self, state, action, noise):
        place = (state.place.argmax(-1) + 2 * action.argmax(-1) - 1).clamp(0, 4)
        return ChainState(F.one_hot(place, 5).float())

    def outcome(self, features):
        return features[..., 4], 1 - features[..., 4]


def chain_starts() -> ChainState:
    return ChainState(torch.eye(5)[:4].repeat(8, 1))


def test_actions_are_scored_at_the_states_where_they_are_taken():
    """Log-probabilities of action h at features h, the return of h + 1 on: one update raises what leads to the goal."""
    torch.manual_seed(0)
    behaviour = method.Behaviour(make_args(), Chain())
    actions = F.one_hot(torch.tensor([[1], [1]]), 2).float()
    features = torch.eye(5)[[2, 3, 4]][:, None]
    dream = method.Dream(features, actions, torch.tensor([[0.0], [1.0]]), torch.tensor([[0.9], [0.0]]))
    loss = method.behaviour_loss(behaviour, dream, 1.0, 0.0)[0]["actor"]
    log_policy = behaviour.actor(features[:-1]).log_softmax(-1)[..., 1]  # advantages 0.9 and 1, weights 1 and 0.9
    expected = -(log_policy[0] * 0.9 + 0.9 * log_policy[1] * 1.0).sum() / 2
    assert loss.item() == pytest.approx(expected.item(), rel=1e-5)


def test_losses_of_actor_and_critic():
    """Step by step: later ones count as much as the dream is likely to come there, discounted; entropy is a gain."""
    torch.manual_seed(0)
    behaviour = method.Behaviour(make_args(), Chain())
    for module in behaviour.parts().values():
        wake(module)
    behaviour.copy_critics()
    wake(behaviour.critic.append(torch.nn.Linear(1, 1)))  # other than the slow one
    features, actions = torch.randn(4, 3, 5), F.one_hot(torch.randint(2, (3, 3)), 2).float()
    rewards, discounts = torch.randn(3, 3), 0.3 + 0.6 * torch.rand(3, 3)
    losses, _ = method.behaviour_loss(behaviour, method.Dream(features, actions, rewards, discounts), 0.8, 0.1)
    slow, actor, critic = behaviour.slow_critic(features).squeeze(-1), 0.0, 0.0
    assert not torch.allclose(slow, behaviour.value(features))
    for n in range(3):
        weight = 1.0
        for h in range(3):
            target = slow[3, n]
            for k in reversed(range(h, 3)):
                target = rewards[k, n] + discounts[k, n] * (0.2 * slow[k + 1, n] + 0.8 * target)
            policy = torch.distributions.Categorical(logits=behaviour.policy(features[h, n]))
            gain = policy.log_prob(actions[h, n].argmax()) * (target - slow[h, n]) + 0.1 * policy.entropy()
            actor -= weight * gain / 9
            critic += weight * 0.5 * (behaviour.value(features[h, n]) - target) ** 2 / 9
            weight *= discounts[h, n]
    assert losses["actor"].item() == pytest.approx(actor.item(), rel=1e-4)
    assert losses["critic"].item() == pytest.approx(critic.item(), rel=1e-4)


def test_each_part_has_its_own_rate():
    rates = {"model_learning_rate": 1e-3, "actor_learning_rate": 2e-3, "critic_learning_rate": 3e-3}
    optimizers = make_learner(**rates, adam_eps=1e-7, weight_decay=1e-4).optimizers
    for name, (rate, eps) in {"model": (1e-3, 1e-5), "actor": (2e-3, 1e-7), "critic": (3e-3, 1e-7)}.items():
        (group,) = optimizers[name].param_groups
        assert (group["lr"], group["eps"]) == (rate, eps) and group["lr"] * group["weight_decay"] == pytest.approx(1e-4)


def norms_of_gradients(learner) -> dict[str, float]:
    """Of each module after its last step."""
    return {
        name: torch.cat([p.grad.flatten() for p in module.parameters() if p.grad is not None]).norm().item()
        for name, module in learner.modules.items()
    }


def clipped_parts(make, data, bound: float) -> set[str]:
    """The parts whose gradients each have the norm `bound` where that is the bound, and at least twice as much without one."""
    norms = []
    for limit in (np.inf, bound):
        learner = make(max_grad_norm=limit)
        wake(learner.behaviour)
        learner.update(data)
        norms.append(norms_of_gradients(learner))
    return {
        part for part, norm in norms[1].items() if norm == pytest.approx(bound, rel=0.01) and norms[0][part] > 2 * bound
    }


def test_each_gradient_is_clipped_by_its_own_norm():
    assert clipped_parts(make_learner, make_data([[1, 0, 0, 0, 0, 0]] * 3), 0.01) == {"model", "actor", "critic"}


def after_an_update(learner, data) -> torch.Tensor:
    """All parameters after an update of heads that have something to say, late enough for every schedule to count."""
    for module in (learner.model.reward, learner.model.discount, learner.behaviour):
        wake(module)
    learner.updates = 9
    torch.manual_seed(6)
    learner.update(data)
    modules = learner.model, learner.behaviour
    return torch.cat([value.flatten() for module in modules for value in module.state_dict().values()])


UPDATE_FLAGS = [  # of all three agents
    *({"starts": 5}, {"horizon": 2}, {"gamma": 0.5}, {"gae_lambda": 0.5}, {"ent_coef": 0.1}, {"slow_interval": 10}),
    *({"image_scale": 1.0}, {"entropy_scale": 0.0}, {"kl_warmup": 11}, {"kl_balance": 0.5}, {"reward_scale": 1.0}),
    *({"discount_scale": 1.0}, {"tanh_reward": True}, {"model_learning_rate": 1e-4}, {"actor_learning_rate": 1e-4}),
    *({"critic_learning_rate": 1e-4}, {"adam_eps": 1e-3}, {"weight_decay": 1e-3}, {"max_grad_norm": 0.01}),
]


@pytest.mark.parametrize("flags", [*UPDATE_FLAGS, {"kl_scale": 0.3}], ids=str)
def test_every_flag_changes_an_update(flags):
    data = make_data([[1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0]])
    default, changed = (after_an_update(make_learner(**changes), data) for changes in ({}, flags))
    assert not torch.equal(default, changed)


def test_the_slow_critic_is_copied_at_its_interval():
    calls, learner = [], method.Learner(make_args(slow_interval=3), Chain(), CPU)
    learner.behaviour.copy_critics = lambda: calls.append(learner.updates)
    for _ in range(7):
        learner.learn_behaviour(chain_starts())
    assert calls == [3, 6]


def test_dreams_start_at_states_that_do_not_end_an_episode():
    learner = make_learner(starts=8)
    terminals = torch.zeros(4, 5)
    terminals[1, 2] = terminals[3] = 1
    names = torch.arange(20.0).view(4, 5, 1)
    drawn = [learner.draw_starts(method.State(names, -names), terminals) for _ in range(100)]
    assert all(torch.equal(each.stoch, -each.deter) and len(each.stoch.unique()) == 8 for each in drawn)
    alive = set(range(20)) - {7, 15, 16, 17, 18, 19}
    assert set(torch.cat([each.stoch for each in drawn]).int().flatten().tolist()) == alive


def test_critic_and_actor_on_a_chain():
    """Actor and critic come to the best policy and to its values, γ^(3 − place)."""
    args = make_args(gamma=0.9, horizon=8, head_size=32, slow_interval=20, ent_coef=1e-3)
    torch.manual_seed(0)
    learner = method.Learner(args, Chain(), CPU)
    for _ in range(1_500):
        learner.learn_behaviour(chain_starts())
    with torch.no_grad():
        values, policy = (
            learner.behaviour.value(torch.eye(5)[:4]),
            learner.behaviour.policy(torch.eye(5)[:4]).softmax(-1),
        )
    assert torch.allclose(values, torch.tensor([0.729, 0.81, 0.9, 1.0]), atol=0.04), values
    assert (policy[:, 1] > 0.95).all(), policy


def test_random_play_at_first_holds_a_reward_at_nearly_every_goal(tmp_path):
    """A goal at which nothing was ever paid is never sought."""
    args = method.complete_args(method.Args(num_envs=100, total_timesteps=1_100_000))
    torch.manual_seed(0)
    replay = method.Replay(tmp_path / "replay.dat", args)
    model = method.WorldModel(args, 3)
    collector = method.Collector(args, replay, method.Player(method.Learner(args, model, CPU), args.num_envs))
    collector.reset()
    for _ in range(args.prefill // args.num_envs):
        collector.step(randomly=True)
    rewards, maze = dreamer_goals.rewards_at_goals(replay, 68), method.maze(11)
    assert rewards.sum() == sum((row["reward"] > 0).sum() for row in replay.rows) > 400
    assert not rewards[maze.rooms >= 4].any()
    assert (rewards[maze.rooms < 4] > 0).sum() >= 62  # of 64


@pytest.mark.slow
def test_policy_learning_in_the_true_dynamics_solves_the_maze():
    """The second instrument of the study: the same actor, critic and returns, with nothing to blame on the model."""
    returns = dreamer_true.learn(starts=64, horizon=15, updates=6_000, seed=1)
    assert returns[-1] >= 0.85, returns


def test_a_record_with_other_columns_is_not_gone_on_with(tmp_path):
    """As where a later version of a script logs more: values would stand under the wrong names."""
    log = method.CsvLog(tmp_path / "log.csv", 0)
    log.write({"step": 1, "loss": 0.5})
    for row, error in (({"step": 2, "new": 1, "loss": 0.4}, True), ({"step": 2, "loss": 0.4}, False)):
        log = method.CsvLog(tmp_path / "log.csv", 16)
        with pytest.raises(method.RunError, match="log.csv: has other columns") if error else contextlib.nullcontext():
            log.write(row)
    log.sync()
    assert (tmp_path / "log.csv").read_text() == "step,loss\n1,0.5\n2,0.4\n"


# Runs
@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dreamer")
    run(*SMALL, "--run-dir", "run", "--save-model", cwd=folder, script=SCRIPT)
    return folder / "run"


def test_comparisons_with_reality_leave_no_trace_in_the_training(small_run, tmp_path, monkeypatch):
    """As many draws, of other games, between two updates: the parameters in the end are the same."""
    monkeypatch.setattr(method, "COMPARISON", 500)
    assert method.cli([*map(str, SMALL), "--run-dir", str(tmp_path / "run")]) == 0
    rows = list(csv.DictReader((tmp_path / "run" / "updates.csv").read_text().splitlines()))
    assert all(math.isfinite(float(row["eval/real_return"])) for row in rows)
    learners = [
        torch.load(folder / "checkpoint.pt", weights_only=True)["learner"] for folder in (small_run, tmp_path / "run")
    ]
    for left, right in zip(*(learner["model"].values() for learner in learners)):
        assert torch.equal(left, right)


@pytest.mark.parametrize("name", ["dreamer_v2", "hwm_dreamer", "hwm_hrl_dreamer"])
def test_a_model_with_convolutions_is_saved(name, tmp_path):
    """Their weights lie channels last in memory, which safetensors refuses."""
    agent = importlib.import_module(f"cleanrl_thesis.{name}")
    args = agent.complete_args(agent.parse_args(["--size", "m", "--prefill", "1000", "--total-timesteps", "1500"]))
    model = (agent.WorldModel if name == "dreamer_v2" else agent.HWM)(args, 3)
    assert not all(value.is_contiguous() for value in model.state_dict().values())
    flags = ["--encoder", "cnn", "--depth", 1, "--classes", 2, "--batch-size", 1, "--chunk-length", 4, "--horizon", 2]
    flags += [
        "--prefill",
        500,
        "--total-timesteps",
        1000,
        "--train-frequency",
        500,
        "--eval-episodes",
        1,
        "--save-model",
    ]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=ROOT / "cleanrl_thesis" / f"{name}.py")
    saved = safetensors.torch.load_file(tmp_path / "run" / "model.safetensors")
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)["learner"]["model"]
    assert all(torch.equal(saved[f"model.{key}"], value) for key, value in state.items())


@pytest.mark.parametrize("name", ["dreamer_v2", "hwm_dreamer", "hwm_hrl_dreamer"])
def test_tiles_show_each_cell_with_two_pixels_in_either_maze(name):
    agent, sides = importlib.import_module(f"cleanrl_thesis.{name}"), []
    for flags in (
        ["--env-id", "FourRooms19-v0"],
        [],
        ["--size", "thesis"],
        ["--env-id", "FourRooms19-v0", "--frame-side", "40"],
    ):
        sides.append(agent.complete_args(agent.parse_args(flags)).frame_side)
    assert sides == [38, 22, 64, 40]
    pose, goal = agent.maze(19).starts[0].tolist()  # four times the cell, and the direction
    frames = agent.painter(19, 38).draw(pose // 4 * 4 + np.arange(4), np.full(4, goal))
    assert min(np.abs(frames[i].astype(int) - frames[j]).max() for i in range(4) for j in range(i)) > 20


@pytest.mark.parametrize(("share", "batch", "counts"), [(0, 24, [24]), (0.1, 24, [22, 2]), (0.03, 16, [15, 1])])
def test_a_share_above_none_is_one_chunk_at_least(share, batch, counts, tmp_path, monkeypatch):
    collector = make_collector(tmp_path, make_learner(rewarded_share=share, batch_size=batch))
    collector.replay.rewarded[0] = [20]
    asked, draw = [], method.draw_from_rows
    monkeypatch.setattr(method, "draw_from_rows", lambda rows, number: (asked.append(number), draw(rows, number))[1])
    collector.replay.sample(CPU)
    assert asked == counts


def test_small_run_leaves_its_records(small_run):
    rows = list(csv.DictReader((small_run / "updates.csv").read_text().splitlines()))
    assert [row["global_step"] for row in rows] == ["1000", "1500"]
    result = json.loads((small_run / "result.json").read_text())
    assert result["complete"] and result["updates"] == 50
    evaluation = json.loads((small_run / "evaluation.json").read_text())
    assert evaluation["mode"] == "greedy" and evaluation["episodes"] == 4 and 0.7 < evaluation["optimal"] < 0.99
    assert 0 <= evaluation["eval/real_return"] < 1
    for name in ("learning_curve.png", "dream.png"):
        assert (small_run / name).read_bytes()[1:4] == b"PNG"


def scalars(folder) -> dict[str, list[tuple[int, float]]]:
    """What TensorBoard has: (step, value) of each event of each name."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder), size_guidance={"scalars": 0}).Reload()
    return {name: [(event.step, event.value) for event in events.Scalars(name)] for name in events.Tags()["scalars"]}


@pytest.mark.parametrize("name", ["dreamer_v2", "hwm_dreamer", "hwm_hrl_dreamer"])
def test_tensorboard_has_every_episode_and_update(name, tmp_path):
    """Of random play too, each at its step; and the columns of updates.csv but for the mean of a row's episodes."""
    flags = ["--batch-size", 1, "--chunk-length", 4, "--horizon", 2, "--prefill", 500, "--total-timesteps", 1000]
    flags += ["--num-envs", 2, "--train-frequency", 100, "--eval-episodes", 1, "--run-dir", "run"]
    run(*flags, cwd=tmp_path, script=ROOT / "cleanrl_thesis" / f"{name}.py")
    folder = tmp_path / "run"
    found = scalars(folder)
    episodes = np.genfromtxt(folder / "episodes.csv", delimiter=",", names=True)
    for column in ("episodic_return", "episodic_length"):
        written = [(int(step), np.float32(value)) for step, value in zip(episodes["global_step"], episodes[column])]
        assert found[f"charts/{column}"] == written and written[0][0] <= 500, column
    header, *rows = csv.reader((folder / "updates.csv").read_text().splitlines())
    for i, column in enumerate(header):
        if column not in ("global_step", "charts/episodic_return"):
            steps, values = zip(*found[column])
            assert steps == tuple(int(row[0]) for row in rows)
            np.testing.assert_allclose(values, [float(row[i]) for row in rows], rtol=1e-6)
    evaluation = json.loads((folder / "evaluation.json").read_text())
    assert found["eval/episodic_return_mean"][0][1] == np.float32(evaluation["mean"]) and found["charts/SPS"]


def assert_no_game_of_training_is_scored(folder, method) -> None:
    """The seeds of its evaluation are none of those with which its games begin, nor any of their streams."""
    scored = set(json.loads((folder / "evaluation.json").read_text())["seeds"])
    games = json.loads((folder / "args.json").read_text())["num_envs"]
    assert scored and not scored & {method.episode_seed(1, game, i) for game in range(games) for i in range(256)}


def test_evaluation_plays_no_game_of_the_training(small_run):
    assert_no_game_of_training_is_scored(small_run, method)


def assert_same_states(left, right) -> None:
    for name in ("episodes.csv", "updates.csv", "evaluation.json"):
        assert (left / name).read_bytes() == (right / name).read_bytes(), name
    states = [torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (left, right)]

    def compare(a, b, path=""):
        if isinstance(a, dict):
            assert a.keys() == b.keys()
            for key in a:
                compare(a[key], b[key], f"{path}/{key}")
        elif isinstance(a, list):
            for i, (x, y) in enumerate(zip(a, b, strict=True)):
                compare(x, y, f"{path}/{i}")
        else:
            assert torch.equal(a, b) if isinstance(a, torch.Tensor) else a == b, path

    for name in ("learner", "collector", "torch_rng", "global_step"):
        compare(states[0][name], states[1][name], name)
    lengths = states[0]["collector"]["lengths"].tolist()
    rows = [np.fromfile(folder / "replay.dat", method.RECORD).reshape(len(lengths), -1) for folder in (left, right)]
    for game, length in enumerate(lengths):
        assert np.array_equal(rows[0][game, :length], rows[1][game, :length])


def test_same_seed_same_bytes_and_another_seed_others(small_run, tmp_path):
    run(*SMALL, "--run-dir", "again", cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "again")
    run(*SMALL, "--run-dir", "other", "--seed", 2, cwd=tmp_path, script=SCRIPT)
    assert (small_run / "updates.csv").read_bytes() != (tmp_path / "other" / "updates.csv").read_bytes()


@pytest.mark.parametrize("torn", [False, True])
@pytest.mark.parametrize("stop_at", [500, 1000])
def test_a_stopped_run_goes_on_to_the_same_bytes(small_run, tmp_path, torn, stop_at):
    flags = [*SMALL, "--run-dir", "run", "--resume"]
    run(*flags, "--stop-at", stop_at, cwd=tmp_path, script=SCRIPT)
    if torn:  # the one before it is taken, or the run starts anew; the records are cut back
        path = tmp_path / "run" / "checkpoint.pt"
        if not (tmp_path / "run" / "checkpoint.previous.pt").exists():
            shutil.copy(path, tmp_path / "run" / "checkpoint.previous.pt")
        path.write_bytes(path.read_bytes()[:1000])
        with open(tmp_path / "run" / "episodes.csv", "a") as file:
            file.write("999,0,1\n")
    run(*flags, cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "run")


@needs_compiler
@pytest.mark.slow
def test_a_compiled_run_goes_on_to_the_same_bytes(tmp_path):
    flags = [*SMALL, "--compile"]
    run(*flags, "--run-dir", "whole", cwd=tmp_path, script=SCRIPT)
    run(*flags, "--run-dir", "run", "--stop-at", 1000, cwd=tmp_path, script=SCRIPT)
    run(*flags, "--run-dir", "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert_same_states(tmp_path / "whole", tmp_path / "run")
    assert torch.load(tmp_path / "run" / "checkpoint.pt")["arithmetic"].startswith("compiled")


@needs_compiler
def test_compiled_and_plain_agree(tmp_path):
    """The same batch, the same draws: parts of the losses, and parameters after three updates."""
    results = []
    for compiles in (False, True):
        learner = make_learner(compile=compiles)
        wake(learner.behaviour)
        folder = tmp_path / str(compiles)
        folder.mkdir()
        replay = make_collector(folder, learner).replay
        assert not compiles or method.compile_steps(learner, replay.example(CPU))
        torch.manual_seed(7)
        parts = [learner.update(replay.sample(CPU)) for _ in range(3)]
        weights = torch.cat([value.detach().flatten() for value in learner.behaviour.actor.parameters()])
        results.append(({name: value.item() for name, value in parts[-1].items()}, weights))
    for name, value in results[0][0].items():
        assert results[1][0][name] == pytest.approx(value, rel=1e-3, abs=1e-4), name
    assert torch.allclose(results[0][1], results[1][1], atol=1e-3)


def test_bfloat16_stays_near_float32(tmp_path):
    """The losses of the same batch and draws, but for rounding."""
    learner = make_learner(size="m", encoder="cnn", frame_side=64)
    data = make_collector(tmp_path, learner, steps=20).replay.sample(CPU)
    losses = []
    for learner.bf16 in (False, True):
        torch.manual_seed(1)
        with learner.autocast():
            losses.append(method.world_model_loss(learner.model, data, 1_000)[0].item())
    assert losses[1] == pytest.approx(losses[0], rel=0.02)
    wake(learner.behaviour)
    learner.update(data)
    assert all(parameter.grad.abs().sum() > 0 for parameter in learner.behaviour.actor.parameters())


FAULTS = """
import resource
import torch
from cleanrl_thesis.dreamer_v2 import keep_freed_memory
torch.set_num_threads(1)
def faults():
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(10):
        torch.zeros(10_000_000)  # 40 MB: more than glibc keeps by itself
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before
before = faults()
keep_freed_memory()
faults()
print(before, faults())
"""


@pytest.mark.skipif(not hasattr(ctypes.CDLL(None), "mallopt"), reason="not glibc")
def test_freed_memory_is_used_again():
    done = subprocess.run([sys.executable, "-c", FAULTS], cwd=ROOT, capture_output=True, text=True, check=True)
    before, after = map(int, done.stdout.split())
    assert 10 * after < before


def test_without_bfloat16_instructions_float32_is_used(monkeypatch):
    monkeypatch.setattr(method, "has_bf16", lambda device: False)
    assert not make_learner(bf16=True).bf16
    monkeypatch.setattr(method, "has_bf16", lambda device: True)
    assert make_learner(bf16=True).bf16 and not make_learner(bf16=False).bf16


@pytest.mark.slow
@pytest.mark.parametrize("seed", [2, 3])
def test_the_agent_is_drawn_soon(tmp_path, seed):
    """Without `--entropy-scale` these seeds draw the goal alone, and red, which only the agent has, not at all."""
    args = method.complete_args(method.Args(bf16=True))
    torch.manual_seed(seed)
    learner = method.Learner(args, method.WorldModel(args, 3), CPU)
    method.set_frame_statistics(learner.model, args)
    replay = make_collector(tmp_path, learner, steps=2_000).replay
    for _ in range(700):
        learner.updates += 1
        learner.learn_model(replay.sample(CPU))
    data = replay.sample(CPU)
    with torch.no_grad():
        frames = learner.model.normalize(data.frames.flatten(0, 1))
        embed = learner.model.embedding(frames).unflatten(0, data.first.shape)
        made = learner.model.observe(embed, F.one_hot(data.actions, 3).float(), data.first)
        wrong = learner.model.decoder(made.state.features().flatten(0, 1)) - frames
    red = wrong[..., 0].square().sum() / frames[..., 0].square().sum()
    assert red < 0.6, red


@pytest.mark.slow
@pytest.mark.skipif(not method.has_bf16(CPU), reason="this CPU emulates bfloat16, for ten minutes")
def test_learning_curve_in_bfloat16_stays_within_seeds_of_float32(tmp_path):
    """Image and KL loss over 300 updates of a CNN model: three seeds in each arithmetic, whose ranges meet at each stage."""
    curves = {}
    for bf16 in (False, True):
        for seed in range(3):
            args = make_args(size="m", batch_size=6, chunk_length=8, deter=64, hidden_size=64, bf16=bf16)
            torch.manual_seed(seed)
            learner = method.Learner(args, method.WorldModel(args, 3), CPU)
            learner.bf16 = bf16  # on a CPU without bfloat16 instructions, too
            folder = tmp_path / f"{bf16}{seed}"
            folder.mkdir()
            replay = make_collector(folder, learner, steps=100).replay
            parts = [learner.update(replay.sample(CPU)) for _ in range(300)]
            for name in ("losses/image", "losses/kl"):
                stages = np.array([part[name].item() for part in parts]).reshape(3, 100).mean(1)
                curves.setdefault((name, bf16), []).append(stages)
    for name in ("losses/image", "losses/kl"):
        single, half = (np.array(curves[name, bf16]) for bf16 in (False, True))  # (seeds, stages)
        assert (single.mean(0)[1:] < single.mean(0)[:-1]).all() or name == "losses/kl", single  # it learns
        room = 0.5 * np.ptp(single, 0) + 0.02 * single.mean(0)
        assert (half.mean(0) > single.min(0) - room).all() and (half.mean(0) < single.max(0) + room).all(), (
            single,
            half,
        )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dreamer_v2", "hwm_dreamer", "hwm_hrl_dreamer"])
def test_the_world_model_learns_what_the_mean_frame_does_not_show(name, tmp_path):
    """300 updates of `--size xs`: less than half of the image loss that is left where every frame is drawn as their mean."""
    flags = ["--prefill", 10_000, "--total-timesteps", 11_500, "--starts", 8, "--horizon", 3, "--eval-episodes", 4]
    run(*flags, "--run-dir", "run", cwd=tmp_path, script=ROOT / "cleanrl_thesis" / f"{name}.py")
    state = torch.load(tmp_path / "run" / "checkpoint.pt", weights_only=True)
    lengths = state["collector"]["lengths"].tolist()
    rows = np.fromfile(tmp_path / "run" / "replay.dat", method.RECORD).reshape(len(lengths), -1)
    records = np.concatenate([row[:length] for row, length in zip(rows, lengths)])[::5]
    frames = rooms.painter(11, 22).draw(records["pose"].astype(int), records["goal"].astype(int)).astype(np.float64)
    x = (frames - frames.mean(0)) / state["learner"]["model"]["frame_scale"].numpy()
    of_the_mean_frame = 0.5 * np.square(x).sum((1, 2, 3)).mean()
    *_, last = csv.DictReader((tmp_path / "run" / "updates.csv").read_text().splitlines())
    assert float(last["losses/image"]) < 0.5 * of_the_mean_frame


def test_copied_alone(small_run, tmp_path):
    (tmp_path / "mine.py").write_text(SCRIPT.read_text())
    run(*SMALL, "--run-dir", "run", cwd=tmp_path, script=tmp_path / "mine.py", PYTHONSAFEPATH="1")
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


def test_a_folder_of_another_run_is_refused(small_run, tmp_path):
    words = ["--seed 2 (was 1)", "must be as in"]
    done = run(*SMALL, "--run-dir", small_run, "--resume", "--seed", 2, cwd=tmp_path, code=2, script=SCRIPT)
    assert all(word in done.stderr for word in words) and done.stderr.count("\n") == 1


def test_a_folder_of_another_script_is_refused(small_run, tmp_path):
    done = run(
        "--run-dir", small_run, "--resume", cwd=tmp_path, code=2, script=ROOT / "cleanrl_thesis" / "dqn_apple.py"
    )
    assert "holds a run of another script or version, dreamer_v2" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.parametrize("change", [lambda path: path.unlink(), lambda path: path.write_bytes(path.read_bytes()[:99])])
def test_a_run_does_not_go_on_without_its_replay(tmp_path, change):
    run(*SMALL, "--run-dir", "run", "--stop-at", 1000, cwd=tmp_path, script=SCRIPT)
    change(tmp_path / "run" / "replay.dat")
    done = run(*SMALL, "--run-dir", "run", "--resume", cwd=tmp_path, code=1, script=SCRIPT)
    assert "replay.dat: missing or cut short" in done.stderr and done.stderr.count("\n") == 1


@pytest.mark.skipif(not hasattr(os, "posix_fallocate"), reason="this system reserves no bytes")
def test_a_full_disk_is_one_line_before_the_first_step(tmp_path, monkeypatch):
    """The replay's bytes are reserved: a page without a block would end the process by a signal, hours later."""
    args = make_args()
    size = method.Replay(tmp_path / "replay.dat", args).rows.nbytes
    about = (tmp_path / "replay.dat").stat()
    assert about.st_size == size <= 512 * about.st_blocks

    def full(file, begin, size):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full)
    done = run(*SMALL, "--run-dir", "run", cwd=tmp_path, code=1, script=SCRIPT)
    assert "No space left on device" in done.stderr and done.stderr.count("\n") == 1
    assert not (tmp_path / "run" / "episodes.csv").exists()


def test_parameters_that_explode_end_the_run(tmp_path):
    flags = [*SMALL, "--model-learning-rate", 1e30, "--max-grad-norm", "inf", "--run-dir", "run"]
    done = run(*flags, cwd=tmp_path, code=1, script=SCRIPT)
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


@pytest.mark.parametrize("name", ["dreamer_v2", "hwm_dreamer", "hwm_hrl_dreamer"])
def test_parameters_that_explode_with_the_last_update_end_the_run(name, tmp_path, monkeypatch):
    """Its losses, which are from before the step, are finite."""
    agent = importlib.import_module(f"cleanrl_thesis.{name}")
    update = agent.Learner.update

    def explode(learner, data):
        metrics = update(learner, data)
        next(learner.behaviour.parameters()).data.fill_(math.nan)
        return metrics

    monkeypatch.setattr(agent.Learner, "update", explode)
    flags = ["--batch-size", 1, "--chunk-length", 4, "--horizon", 2, "--prefill", 500, "--total-timesteps", 1000]
    flags += ["--train-frequency", 500, "--eval-episodes", 1, "--run-dir", "run"]
    done = run(*flags, cwd=tmp_path, code=1, script=ROOT / "cleanrl_thesis" / f"{name}.py")
    assert "no longer finite" in done.stderr and not (tmp_path / "run" / "result.json").exists()


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_killed_runs_end_with_the_same_bytes(tmp_path, seed):
    flags = [*SMALL, "--total-timesteps", 5_000, "--seed", seed]
    run(*flags, "--run-dir", tmp_path / "whole", cwd=tmp_path, script=SCRIPT)
    kill_twice([*flags, "--run-dir", str(tmp_path / "run")], 12, seed, SCRIPT, after_checkpoints=True)
    run(*flags, "--run-dir", tmp_path / "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert_same_states(tmp_path / "whole", tmp_path / "run")


def test_the_dream_starts_from_what_was_seen(small_run, tmp_path):
    """An episode's frames above those of the model: as many, and of the same size."""
    learner = make_learner()
    states = np.array([[0, 0, 60], [0, 1, 60], [0, 2, 60], [0, 3, 60], [0, 0, 60]])
    truth, dream = method.dream_frames(learner, learner.args, states, np.array([1, 1, 1, 1]))
    assert truth.shape == dream.shape == (5, 22, 22, 3) and truth.dtype == dream.dtype == np.uint8
    assert np.array_equal(truth, method.painter(11, 22).draw(4 * states[:, 0] + states[:, 1], states[:, 2]))
    wake(learner.model)
    dreams = []
    for changed in (None, 1, 3):  # the model sees three frames
        other = states.copy()
        if changed is not None:
            other[changed, 0] = 30
        torch.manual_seed(0)
        dreams.append(method.dream_frames(learner, learner.args, other, np.array([1, 1, 1, 1]))[1])
    assert not np.array_equal(dreams[1][3:], dreams[0][3:]) and np.array_equal(dreams[2], dreams[0])


class Shortest:
    """Reads a game's state from its frame and goes a shortest path."""

    greedy: list[bool] = []
    begun: list[np.ndarray] = []

    def __init__(self, learner, num_games: int):
        maze = method.maze(11)
        poses, goals = (grid.ravel() for grid in np.meshgrid(np.arange(len(maze.moves)), np.unique(maze.starts[:, 1])))
        frames = method.painter(11, 22).draw(poses, goals)
        self.state_of = {frame.tobytes(): state for frame, state in zip(frames, zip(poses, goals))}
        self.after = method.fewest_steps(maze)[maze.moves]  # (poses, actions, goals)

    def observe(self, frames: np.ndarray, begins: np.ndarray) -> None:
        self.states = [self.state_of[frame.tobytes()] for frame in frames]
        self.begun.append(begins.copy())

    def act(self, greedy: bool = False) -> np.ndarray:
        self.greedy.append(greedy)
        return np.array([self.after[pose, :, goal].argmin() for pose, goal in self.states])


def test_a_player_of_shortest_ways_has_the_optimal_return(tmp_path, monkeypatch):
    learner, picture = make_learner(eval_episodes=50), np.zeros((2, 22, 22, 3), np.uint8)
    monkeypatch.setattr(method, "Player", Shortest)
    monkeypatch.setattr(Shortest, "greedy", [])
    monkeypatch.setattr(method, "dream_frames", lambda *_: (picture, picture))
    monkeypatch.setattr(method, "compare_dream", lambda *_: {})
    evaluation = method.evaluate(learner, learner.args, tmp_path)
    assert evaluation["mean"] == pytest.approx(evaluation["optimal"]) and evaluation["solved"] == 1
    assert set(Shortest.greedy) == {True} and evaluation["mode"] == "greedy"


def test_a_dream_is_compared_with_sampled_play_of_the_same_games(monkeypatch):
    learner, asked = make_learner(), []

    def play(learner, args, seeds, greedy):
        asked.append((seeds, greedy))
        return {"returns": np.array([0.2, 0.4])}

    monkeypatch.setattr(method, "play", play)
    monkeypatch.setattr(method, "dreamed_returns", lambda learner, args, seeds: (asked.append(seeds), np.ones(2))[1])
    found = method.compare_dream(learner, learner.args, 2)
    assert found == {"eval/real_return": pytest.approx(0.3), "eval/dreamed_return": 1}
    seeds = [method.episode_seed(1, method.EVALUATION_STREAM, i) for i in range(2)]
    assert asked == [(seeds, False), seeds]


@pytest.mark.parametrize("greedy", [True, False])
def test_returns_of_an_evaluation_are_those_of_each_first_episode(greedy, monkeypatch):
    """Games that have ended go on until the last one has; what they earn then does not count."""
    monkeypatch.setattr(method, "Player", Shortest)
    monkeypatch.setattr(Shortest, "greedy", [])
    monkeypatch.setattr(Shortest, "begun", [])
    learner = make_learner()
    played = method.play(learner, learner.args, list(range(30)), greedy)
    poses, goals = 4 * played["starts"][:, 0] + played["starts"][:, 1], played["starts"][:, 2]
    steps = method.fewest_steps(method.maze(11))[poses, goals]
    assert np.allclose(played["returns"], 1 - 0.9 * steps / 100) and played["solved"].all()
    assert len(played["actions"]) == steps[0] == len(played["states"]) - 1
    assert steps.max() > 2 * steps.min() and set(Shortest.greedy) == {greedy}
    begun = np.array(Shortest.begun)  # what is believed is kept within an episode, and forgotten behind its end
    assert begun[0].all() and len(begun) == steps.max()
    for game, end in enumerate(steps):
        assert not begun[1:end, game].any() and (end == steps.max() or begun[end, game])


@pytest.mark.parametrize("tanh", [True, False])
def test_dreamed_returns_are_undiscounted_over_an_episodes_length(tanh, monkeypatch):
    """Rewards count as far as the dream is likely to come, and as they are where the model learns their tanh."""
    learner, asked = make_learner(tanh_reward=tanh), []
    rewards, goes_on = torch.tensor([[0.1, 0.2], [0.3, 0.4]]), torch.tensor([[0.5, 1.0], [0.0, 1.0]])

    def imagine(model, behaviour, state, horizon, gamma):
        asked.append((state.stoch.sum(-1).tolist(), horizon, gamma))
        return method.Dream(torch.zeros(3, 2, 1), torch.zeros(2, 2, 3), rewards, goes_on)

    monkeypatch.setattr(method, "imagine", imagine)
    paid = rewards.atanh() if tanh else rewards
    expected = [paid[0, 0] + 0.5 * paid[1, 0], paid[0, 1] + paid[1, 1]]
    assert np.allclose(method.dreamed_returns(learner, learner.args, [1, 2]), expected, atol=1e-5)
    assert asked == [([3, 3], 100, 1.0)]  # one class of each code: the first frame has been seen


# The report
def test_steps_to_a_return_and_curves(tmp_path):
    """Runs whose moving mean is known: the step of the 200th episode in a row with as much."""
    for name, jump in (
        ("dreamer_seed1", 300),
        ("dreamer_seed2", 500),
        ("hwm_seed1", 10_000),
        ("dreamer_slow_seed1", 10_000),
    ):
        folder = tmp_path / "runs" / name
        folder.mkdir(parents=True)
        about = {"seed": int(name[-1]), "size": "xs", "env_id": "FourRooms11-v0", "prefill": 2_000}
        (folder / "args.json").write_text(json.dumps(about))
        after = [0.9 if i >= jump else 0.1 for i in range(200, 1_000)]
        returns = [1.0] * 200 + after  # random play's first
        lines = [f"{10 * (i + 1)},{value},10" for i, value in enumerate(returns)]
        (folder / "episodes.csv").write_text("global_step,episodic_return,episodic_length\n" + "\n".join(lines) + "\n")
        columns = "global_step,eval/real_return,eval/dreamed_return\n"
        (folder / "updates.csv").write_text(columns + "5000,0.2,0.5\n10000,nan,nan\n")
        ended = {"training_seconds": 120.0, "script_sha256": "none", "evaluation": {"mean": 0.8}}
        (folder / "result.json").write_text(json.dumps(ended))
    runs = dreamer_report.read_runs(tmp_path / "runs")
    rows = {(run["row"]["agent"], run["row"]["seed"]): run["row"] for run in runs}
    assert rows["dreamer", 1]["steps_to_0.5"] == 10 * (300 + 100) - 2_000 and np.isnan(rows["hwm", 1]["steps_to_0.5"])
    assert (
        rows["dreamer", 1]["steps_to_0.85"] == 10 * (300 + 188) - 2_000
    )  # 0.1 + 0.8 · 188 / 200 is the first above 0.85
    assert runs[0]["steps"].tolist() == list(range(500, 8_010, 10)) and np.allclose(runs[0]["means"][:51], 0.1)
    assert np.allclose(runs[0]["means"][[52, 150]], [(0.1 * 100 + 0.9 * 2) / 102, 0.5])
    lines = dreamer_report.table([run["row"] for run in runs])
    assert (
        lines[2].startswith("| Dreamer | 2 | 8,000 | 3,000 ± 12,706 | ")
        and "| not reached | not reached | 0.100 | 0.800 |" in lines[3]
    )
    assert "| 0.300 ± 0.000 |" in lines[2]
    dreamer_report.write_report(runs, tmp_path / "out")
    for name in ("fig_3_5.png", "causes.png"):
        assert (tmp_path / "out" / name).read_bytes()[1:4] == b"PNG"
    text = (tmp_path / "out" / "table.md").read_text()
    assert (
        text.count("| Dreamer | 2 |") == 1 and text.count("the model's rate is 1e-3 | 1 | 8,000 | not reached |") == 1
    )
    lines_of_needs = dreamer_report.needs_table(runs, stages=(700, 8_900, 9_100))
    assert lines_of_needs[2] == "| as it is | 2 | 8,000 | 3,000 ± 12,706 | 0.100 ± 0.000 | 0.900 ± 0.000 |  |"
    assert lines_of_needs[3].endswith("| 1 | 8,000 | not reached | 0.100 | 0.100 |  |")
    for name in ("dreamer_seed2", "hwm_seed1", "dreamer_slow_seed1"):  # the folders of an earlier machine are gone
        shutil.rmtree(tmp_path / "runs" / name)
    later = dreamer_report.read_runs(tmp_path / "runs", dreamer_report.read_known(tmp_path / "out"))
    assert dreamer_report.table([run["row"] for run in later]) == lines
    assert all(
        np.allclose(a["means"], b["means"]) and np.array_equal(a["steps"], b["steps"]) for a, b in zip(runs, later)
    )
    with pytest.raises(UsageError, match="--known .*: cannot be read"):
        dreamer_report.read_known(tmp_path)
    (tmp_path / "out" / "curves.npz").write_bytes(b"torn")
    with pytest.raises(UsageError, match="--known .*: cannot be read"):
        dreamer_report.read_known(tmp_path / "out")
    (tmp_path / "runs" / "dreamer_seed1" / "result.json").unlink()  # as if it went on
    assert (
        "| Dreamer | 1 |"
        in dreamer_report.table([run["row"] for run in dreamer_report.read_runs(tmp_path / "runs", later[1:])])[2]
    )
    path = tmp_path / "runs" / "dreamer_seed1" / "episodes.csv"
    path.write_text("".join(path.read_text().splitlines(True)[: 1 + 200 + 49]))
    with pytest.raises(UsageError, match="holds no run"):  # its first mean is yet to come
        dreamer_report.read_runs(tmp_path / "runs")


def test_goals_by_what_the_replay_paid(small_run, tmp_path, capsys):
    dreamer_goals.main(dreamer_goals.Args(small_run, episodes=50))
    lines = capsys.readouterr().out.splitlines()
    rewards = int(lines[0].split()[-2])
    episodes = np.genfromtxt(small_run / "episodes.csv", delimiter=",", names=True)
    assert rewards == (episodes["episodic_return"] > 0).sum()
    cells, played = (sum(int(line.split("|")[column]) for line in lines[3:]) for column in (2, 3))
    assert cells == 64 and played == 50
    with pytest.raises(UsageError, match="no checkpoint"):
        dreamer_goals.main(dreamer_goals.Args(small_run.parent))
    torch.save({"format": "ppo_fourrooms 1"}, tmp_path / "checkpoint.pt")
    with pytest.raises(UsageError, match="no checkpoint"):
        dreamer_goals.main(dreamer_goals.Args(tmp_path))
    with pytest.raises(UsageError, match="whose model has no segments"):
        dreamer_reads.main(dreamer_reads.Args(small_run))


def test_differences_of_agents():
    """Welch's interval, by its formula; none where an agent has one seed."""
    values = {"dreamer": (0.7, 0.8, 0.84), "hwm": (0.6, 0.75, 0.72), "hrl": (0.7,)}
    names = ("steps_to_0.5", "last_200", "greedy")
    rows = [{"agent": agent, **dict.fromkeys(names, value)} for agent, many in values.items() for value in many]
    a, b = (np.array(values[agent]) for agent in ("hwm", "dreamer"))
    shares = a.var(ddof=1) / 3, b.var(ddof=1) / 3
    freedom = sum(shares) ** 2 / (shares[0] ** 2 / 2 + shares[1] ** 2 / 2)
    half, mean = scipy.stats.t.ppf(0.975, freedom) * sum(shares) ** 0.5, a.mean() - b.mean()
    (line,) = dreamer_report.differences(rows)[3:]
    assert (
        line.endswith(f"| {mean:+.3f} [{mean - half:+.3f}, {mean + half:+.3f}] |")
        and "HWM Dreamer less Dreamer" in line
    )
    rows[0]["steps_to_0.5"] = np.nan
    (line,) = dreamer_report.differences(rows)[3:]
    assert line.split(" | ")[1:3] == ["", f"{mean:+.3f} [{mean - half:+.3f}, {mean + half:+.3f}]"]
    assert dreamer_report.differences(rows[2:]) == []


def test_moving_mean():
    values = np.random.default_rng(0).random(450)
    means = dreamer_report.moving_mean(values)
    for i in (0, 5, 198, 199, 200, 449):
        assert means[i] == pytest.approx(values[max(0, i - 199) : i + 1].mean())


def test_a_folder_without_runs_is_refused(tmp_path):
    with pytest.raises(UsageError, match="holds no run"):
        dreamer_report.read_runs(tmp_path)
