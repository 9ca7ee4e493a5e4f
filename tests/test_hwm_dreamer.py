"""HWM Dreamer: its model against independent sources, and small runs. What it shares with the baseline is tested there."""

import csv
import importlib
import json
import sys

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from conftest import ROOT, assert_boundaries_follow_their_logits, beliefs_of_play, kill_twice, needs_compiler, run
from test_dreamer import (
    UPDATE_FLAGS,
    after_an_update,
    assert_no_game_of_training_is_scored,
    assert_same_states,
    clipped_parts,
    make_data,
)

from cleanrl_thesis import dreamer_v2
from cleanrl_thesis import hwm_dreamer as method

sys.path.append(str(ROOT / "benchmark"))
import dreamer_reads  # noqa: E402

SCRIPT = ROOT / "cleanrl_thesis" / "hwm_dreamer.py"
CPU = torch.device("cpu")
TINY = {
    "deter_z": 5,
    "stoch_z": 3,
    "deter_w": 6,
    "stoch_w": 2,
    "classes": 4,
    "hidden_size": 16,
    "head_size": 16,
    "depth": 2,
}
TINY |= {"batch_size": 3, "chunk_length": 6, "starts": 8, "horizon": 4}
FLAGS = [part for name, value in TINY.items() for part in (f"--{name.replace('_', '-')}", value)]
SMALL = [*FLAGS, "--total-timesteps", 1500, "--prefill", 500, "--train-frequency", 20, "--checkpoint-interval", 500]
SMALL += ["--eval-episodes", 4, "--budget-updates", 40]
PARTS = (5, 12, 6, 8)  # sizes of c, v, h and y


def make_args(**changes) -> method.Args:
    return method.complete_args(method.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000, **changes}))


def make_model(**changes) -> method.HWM:
    torch.manual_seed(0)
    return method.HWM(make_args(**changes), 3)


def make_learner(**changes) -> method.Learner:
    return method.Learner(make_args(**changes), make_model(**changes), CPU)


def one_hot(actions: torch.Tensor) -> torch.Tensor:
    return F.one_hot(actions, 3).float()


@pytest.mark.parametrize("size", ["xs", "s", "m", "thesis"])
def test_sizes_have_as_many_features_as_the_baseline(size):
    args, baseline = method.complete_args(method.Args(size=size)), dreamer_v2.complete_args(dreamer_v2.Args(size=size))
    features = args.deter_z + args.deter_w + (args.stoch_z + args.stoch_w) * args.classes
    assert features == baseline.stoch * baseline.classes + baseline.deter
    same = "encoder frame_side depth hidden_size head_size head_layers batch_size chunk_length starts horizon gamma kl_warmup"
    same += " entropy_scale model_learning_rate"
    for name in f"{same} actor_learning_rate critic_learning_rate ent_coef adam_eps train_frequency prefill".split():
        assert getattr(args, name) == getattr(baseline, name), name
    assert args.kl_z_scale == args.kl_w_scale == baseline.kl_scale
    if size == "thesis":
        assert args.deter_z + args.stoch_z == args.deter_w + args.stoch_w == 812


def test_z_is_copied_and_read_where_m_says():
    """COPY leaves c and v as they are, UPDATE changes both; w changes with each step; `age` counts."""
    model = make_model(w_reset=True)
    state = method.Belief(*(torch.randn(2, size) for size in PARTS), torch.tensor([[3.0], [4.0]]))
    read = torch.tensor([[0.0], [1.0]])
    after, _, _ = model.step(state, one_hot(torch.tensor([0, 2])), read, torch.randn(2, 16), model.noise(2))
    assert torch.equal(after.c[0], state.c[0]) and torch.equal(after.v[0], state.v[0])
    assert not torch.equal(after.c[1], state.c[1]) and not torch.equal(after.v[1], state.v[1])
    assert (
        not torch.isclose(after.h, state.h).any()
        and not torch.equal(after.y, state.y)
        and after.age.tolist() == [[4.0], [0.0]]
    )
    expected = torch.tanh(model.w_start(torch.cat([after.c, after.v], -1)))[1]
    assert torch.allclose(after.h[1], expected)  # w starts anew from z
    literal = make_model(w_reset=False)
    after, _, _ = literal.step(state, one_hot(torch.tensor([0, 2])), read, torch.randn(2, 16), literal.noise(2))
    assert not torch.allclose(after.h[1], torch.tanh(literal.w_start(torch.cat([after.c, after.v], -1)))[1])


@pytest.mark.parametrize("logit", [-50.0, 50.0])
def test_the_dream_reads_where_the_prior_says(logit):
    model = make_model()
    torch.nn.init.zeros_(model.prior_m[-1].weight)
    torch.nn.init.constant_(model.prior_m[-1].bias, logit)
    state = method.Belief(*(torch.randn(4, size) for size in PARTS), torch.zeros(4, 1))
    after = model.imagine_step(state, one_hot(torch.tensor([0, 1, 2, 2])), model.noise(4))
    assert torch.equal(after.c, state.c) == torch.equal(after.v, state.v) == (logit < 0)
    assert (after.age == (1 if logit < 0 else 0)).all()


@pytest.mark.parametrize("classes", [1, 4])
def test_the_dream_draws_m_with_its_probability_and_v_and_y_from_their_priors(classes):
    model = make_model(classes=classes)
    torch.nn.init.zeros_(model.prior_m[-1].weight)
    torch.nn.init.constant_(model.prior_m[-1].bias, np.log(0.3 / 0.7))
    state = method.Belief(*(torch.randn(1, size).expand(20_000, size) for size in model.sizes), torch.zeros(20_000, 1))
    after = model.imagine_step(state, one_hot(torch.zeros(20_000, dtype=torch.int64)), model.noise(20_000))
    read = after.age[:, 0] == 0
    assert read.float().mean().item() == pytest.approx(0.3, abs=0.015)
    for drawn, prior in (
        (after.v[read], model.prior_z(after.c[read][:1])),
        (after.y[~read], model.prior_w(after.h[~read][:1])),
    ):
        if classes == 1:
            mean, std = prior.mean[0], prior.std[0]
        else:
            mean = prior.logits.softmax(-1).flatten()
            std = (mean * (1 - mean)).sqrt()
        assert torch.allclose(drawn.mean(0), mean, atol=0.03) and torch.allclose(drawn.std(0), std, atol=0.03)


@pytest.mark.parametrize("script", ["hwm_dreamer", "hwm_hrl_dreamer"])
def test_the_dream_takes_the_steps_of_the_inference(script):
    """Where posteriors are the priors, and m is the same, a step without a frame is one with a frame."""
    agent = importlib.import_module(f"cleanrl_thesis.{script}")
    torch.manual_seed(0)
    model = agent.HWM(agent.complete_args(agent.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000})), 3)
    model.posterior_z.forward = lambda c, embed: model.prior_z(c)
    model.posterior_w.forward = lambda hz, embed: model.prior_w(hz[:, : PARTS[2]])
    read = torch.tensor([[0.0], [1.0], [0.0], [1.0]])
    model.draw_prior_m = lambda *_: read
    state = agent.Belief(*(torch.randn(4, size) for size in PARTS), torch.zeros(4, 1))
    action, noise = one_hot(torch.tensor([0, 1, 2, 2])), model.noise(4)
    dreamed = model.imagine_step(state, action, noise)
    filtered, *_ = model.step(state, action, read, torch.zeros(4, 16), noise)
    assert all(map(torch.allclose, dreamed, filtered)) and not torch.allclose(dreamed.h, state.h)


@pytest.mark.parametrize("script", ["hwm_dreamer", "hwm_hrl_dreamer"])
def test_play_and_dreams_draw_m_from_the_prior_that_is_trained(script):
    """p(m_t | w_t, z_t, a_t), with the action that follows the belief."""
    agent, data = importlib.import_module(f"cleanrl_thesis.{script}"), make_data([[1, 0, 0, 0, 0, 0]] * 3)
    torch.manual_seed(0)
    model = agent.HWM(agent.complete_args(agent.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000})), 3)
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    made = model.observe(embed, one_hot(data.actions), data.first, 1.0)
    assert made.p_m.std() > 1e-3
    for t in range(5):
        state, p = agent.Belief(*(part[t] for part in made.belief)), torch.sigmoid(made.p_m[t])[:, None]
        action = one_hot(data.actions[t + 1])
        assert model.draw_prior_m(state, action, p - 1e-5).all()
        assert not model.draw_prior_m(state, action, p + 1e-5).any()


@pytest.mark.parametrize("script", ["hwm_dreamer", "hwm_hrl_dreamer"])
def test_what_is_drawn_trains_the_posteriors(script):
    """Through the codes: without the weights of the KL divergences, which have a gradient of their own."""
    agent = importlib.import_module(f"cleanrl_thesis.{script}")
    scales = dict.fromkeys(("kl_z", "kl_w", "kl_m", "entropy", "reward", "discount"), 0.0)
    changes = {f"{name}_scale": value for name, value in scales.items()} | {"budget_price": 0.0}
    torch.manual_seed(0)
    model = agent.HWM(agent.complete_args(agent.Args(**TINY | changes, prefill=500, total_timesteps=1000)), 3)
    agent.world_model_loss(model, make_data([[1, 0, 0, 0, 0, 0]] * 3), 0)[0].backward()
    for posterior in (model.posterior_z, model.posterior_w):
        assert posterior.outer.weight.grad.abs().max() > 1e-6


def test_normal_draws_and_their_divergence():
    torch.manual_seed(0)
    q, p = (method.Normal(torch.randn(5, 3), torch.rand(5, 3) + 0.1) for _ in range(2))
    assert torch.equal(method.draw(q, torch.ones(5, 3)), q.mean + q.std)
    normal = torch.distributions.Normal
    expected = torch.distributions.kl_divergence(normal(*q), normal(*p)).sum(-1)
    assert torch.allclose(method.kl_divergence(q, p), expected, atol=1e-4)


def test_acting_is_the_inference_of_training_step_by_step():
    """`filter` with the boundaries that training drew makes the same beliefs."""
    model, data = make_model(), make_data([[1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0]])
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    torch.manual_seed(2)
    made = model.observe(embed, one_hot(data.actions), data.first, 0.5)
    assert 3 < made.reads.sum() < 18
    torch.manual_seed(2)
    model.draw_m(made.q_m, 0.5)
    noise, state = model.noise(6, 3), model.start(3)
    for t in range(6):
        model.draw_prior_m = lambda state, action, uniform, t=t: made.reads[t, :, None].detach()
        state, *_ = model.filter(state, one_hot(data.actions[t]), data.first[t, :, None], embed[t], noise[t])
        for part, whole in zip(state, made.belief):
            assert torch.allclose(part, whole[t], atol=1e-5), t


def test_beliefs_in_play_are_those_of_training(tmp_path):
    """Over ends of episodes, by the actions that were taken; with intervals, for m is drawn from p in play and from q here."""
    args = make_args(num_envs=5, fixed_interval=4)
    torch.manual_seed(0)
    learner = method.Learner(args, method.HWM(args, 3), CPU)
    played, inferred = beliefs_of_play(method, learner, tmp_path / "replay.dat", 130, 1.0)
    assert all(torch.allclose(a, b, atol=1e-4) for mine, other in zip(played, inferred) for a, b in zip(mine, other))


def test_reads_are_those_of_q_and_the_posteriors_see_the_frame():
    """m_t says whether z is read with the frame of step t + 1; with an episode's first it is anyway."""
    model, data = make_model(), make_data([[1, 0, 0, 0, 1, 0]])
    logits = 50 * torch.tensor([[-1.0], [1.0], [-1.0], [1.0], [1.0], [-1.0]])
    model.posterior_m.forward = lambda embed, first: logits
    embed = torch.randn(6, 1, 16)
    inferred = []
    for change in (0.0, 1.0):
        embed[3] += change  # z is copied there
        torch.manual_seed(2)
        inferred.append(model.observe(embed, one_hot(data.actions), data.first, 0.5))
    before, after = inferred
    assert before.reads[:, 0].tolist() == [1, 0, 1, 0, 1, 1] and before.forced[:, 0].tolist() == [1, 0, 0, 0, 1, 0]
    for q, other in ((before.q_z, after.q_z), (before.q_w, after.q_w)):
        assert torch.equal(q[0][:3], other[0][:3]) and not torch.isclose(q[0][3], other[0][3]).any()


def test_boundaries_drawn_by_gumbel_noise_have_the_probability_of_their_logit():
    assert_boundaries_follow_their_logits(make_model())


@pytest.mark.parametrize("warm", [99, 999])
def test_kl_z_prices_the_reads_unless_it_is_detached(warm):
    """The loss is the same; q(m) has the gradient of its reads weighed by KL_z (Eq. 3.3.7), or none of it."""
    data, losses, slopes = make_data([[1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0]]), [], []
    changes = {"classes": 1, "budget_price": 0.0, "kl_z_scale": 0.7, "kl_warmup": 1_000, "kl_balance": 0.5}
    for detaches in (True, False):
        model = make_model(**changes, detach_kl_z=detaches)
        torch.manual_seed(5)
        loss, _, _ = method.world_model_loss(model, data, warm)
        loss.backward()
        losses.append(loss.item())
        slopes.append(model.posterior_m.logit.weight.grad.clone())
    model.zero_grad()
    torch.manual_seed(5)
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    made = model.observe(embed, one_hot(data.actions), data.first, method.schedule(model.args, warm)[0])
    normal = torch.distributions.Normal
    kl_z = torch.distributions.kl_divergence(normal(*made.q_z), normal(*model.prior_z(made.belief.c))).sum(-1)
    (0.7 * (warm + 1) / 1_000 * made.reads * kl_z.detach()).mean().backward()
    wanted = model.posterior_m.logit.weight.grad
    assert losses[0] == pytest.approx(losses[1], rel=1e-6) and wanted.abs().max() > 1e-5
    assert torch.allclose(slopes[1] - slopes[0], wanted, rtol=1e-3, atol=1e-6)


def test_nothing_leaks_over_the_border_of_an_episode():
    """Beliefs, reads and logits of an episode do not change with the frames and actions of the one before."""
    model, data = make_model(), make_data([[1, 0, 0, 1, 0, 0]])

    def infer(data):
        torch.manual_seed(3)
        embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
        made = model.observe(embed, one_hot(data.actions), data.first, 0.5)
        return [*made.belief, made.reads, made.q_m]

    changed = data._replace(frames=data.frames.clone(), actions=data.actions.clone())
    changed.frames[:3] = 255 - changed.frames[:3]
    changed.actions[:4] = (changed.actions[:4] + 1) % 3  # the action at its first step is of the episode before
    for before, after in zip(infer(data), infer(changed)):
        assert torch.equal(before[3:], after[3:])


@pytest.mark.parametrize("script", ["hwm_dreamer", "hwm_hrl_dreamer"])
@pytest.mark.parametrize("part", ["action", "c", "v", "h", "y"])
def test_the_next_state_follows_from_the_action_and_each_part_of_the_one_before(script, part):
    """c where z is read, from the action, c, v, h and y; h where it is not, from the action, z, h and y (Eq. 3.3.1)."""
    agent = importlib.import_module(f"cleanrl_thesis.{script}")
    args = agent.complete_args(agent.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000}))
    torch.manual_seed(0)
    model = agent.HWM(args, 3)
    state, noise = agent.Belief(*(torch.randn(1, size) for size in PARTS), torch.zeros(1, 1)), model.noise(1)

    def after(state, action: int, read: float):
        made, *_ = model.step(
            state, one_hot(torch.tensor([action])), torch.full((1, 1), read), torch.zeros(1, 16), noise
        )
        return made

    changed = state if part == "action" else state._replace(**{part: getattr(state, part) + 1})
    action = 2 if part == "action" else 0
    assert not torch.allclose(after(state, 0, 1.0).c, after(changed, action, 1.0).c)
    assert not torch.allclose(after(state, 0, 0.0).h, after(changed, action, 0.0).h)


@pytest.mark.parametrize("script", ["hwm_dreamer", "hwm_hrl_dreamer"])
def test_posteriors_know_the_past_and_the_frame(script):
    """q(v) sees c and the frame, q(y) sees h, z and the frame (Eq. 3.3.2)."""
    agent = importlib.import_module(f"cleanrl_thesis.{script}")
    args = agent.complete_args(agent.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000}))
    torch.manual_seed(0)
    model, embed = agent.HWM(args, 3), torch.randn(1, 16)
    state, noise = agent.Belief(*(torch.randn(1, size) for size in PARTS), torch.zeros(1, 1)), model.noise(1)

    def posteriors(state, embed) -> list[torch.Tensor]:
        return [q.logits for q in model.step(state, torch.zeros(1, 3), torch.zeros(1, 1), embed, noise)[1:]]

    plain = posteriors(state, embed)
    for part, levels in (("c", (0, 1)), ("v", (1,)), ("h", (1,)), ("embed", (0, 1))):
        changed = state if part == "embed" else state._replace(**{part: getattr(state, part) + 1})
        found = posteriors(changed, embed + (part == "embed"))
        for level in (0, 1):
            assert torch.allclose(plain[level], found[level]) == (level not in levels), (part, level)


def test_boundaries_see_three_steps_to_each_side_within_their_episode():
    model = make_model(boundary_bound=0.0)
    embed = torch.randn(15, 1, 16, requires_grad=True)
    for begin, seen in ((0, range(4, 11)), (6, range(6, 11)), (9, range(4, 9))):
        first = torch.zeros(15, 1)
        first[[0, begin]] = 1
        (gradient,) = torch.autograd.grad(model.posterior_m(embed, first)[7].sum(), embed)
        assert torch.nonzero(gradient.abs().sum((1, 2))).flatten().tolist() == list(seen)


def test_boundaries_see_no_ends_of_chunks():
    """In frames that stand still every step looks the same, where an episode or the chunk begins or ends too."""
    model, data = make_model(), make_data([[1, 0, 0, 1, 0, 0]])
    embed = torch.ones(6, 1, model.embed.out_features)
    logits = model.posterior_m(embed, data.first)
    assert torch.allclose(logits, logits[:1].expand_as(logits))
    assert model.posterior_m(embed + torch.randn_like(embed), data.first).std() > 0


@pytest.mark.parametrize("script", ["hwm_dreamer", "hwm_hrl_dreamer"])
@pytest.mark.parametrize("classes", [1, 4])
@pytest.mark.parametrize("level", ["z", "w", "m"])
def test_four_fifths_of_each_kl_gradient_train_the_prior(script, classes, level):
    """In steps where the prior's weights are in p alone and the posterior's in q alone: without a past, and m of one of two."""
    agent = importlib.import_module(f"cleanrl_thesis.{script}")
    scales = {f"kl_{each}_scale": float(each == level) for each in "zwm"}
    torch.manual_seed(0)
    model = agent.HWM(agent.complete_args(agent.Args(**TINY | {"classes": classes, "budget_price": 0.0} | scales)), 3)
    args, data = model.args, make_data([[1, 0 if level == "m" else 1]] * 2)
    args.image_scale = args.reward_scale = args.discount_scale = args.entropy_scale = 0.0
    weights = {
        "z": (model.prior_z.outer.weight, model.posterior_z.outer.weight),
        "w": (model.prior_w.outer.weight, model.posterior_w.outer.weight),
        "m": (model.prior_m[-1].weight, model.posterior_m.logit.weight),
    }[level]
    torch.manual_seed(2)
    loss, _, _ = agent.world_model_loss(model, data, 10**6)
    torch.manual_seed(2)
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    made = model.observe(embed, one_hot(data.actions), data.first, args.temperature)

    def of(given):
        if level == "m":
            return torch.distributions.Bernoulli(logits=given)
        return (
            torch.distributions.Normal(*given)
            if classes == 1
            else torch.distributions.OneHotCategorical(given[0].exp())
        )

    q = {"z": made.q_z, "w": made.q_w, "m": made.q_m[:-1]}[level]
    p = {"z": model.prior_z(made.belief.c), "w": model.prior_w(made.belief.h), "m": made.p_m}[level]
    plain = torch.distributions.kl_divergence(of(q), of(p))
    whole = torch.autograd.grad((plain if level == "m" else plain.sum(-1)).mean(), weights)
    for part, wanted, share in zip(torch.autograd.grad(loss, weights), whole, (0.8, 0.2)):
        assert wanted.abs().max() > 1e-5 and torch.allclose(part, share * wanted, rtol=1e-3, atol=1e-7)


def test_each_gradient_is_clipped_by_its_own_norm():
    assert clipped_parts(make_learner, make_data([[1, 0, 0, 0, 0, 0]] * 3), 0.001) == {"model", "actor", "critic"}


HWM_FLAGS = [
    *({"kl_z_scale": 0.5}, {"kl_w_scale": 0.5}, {"kl_m_scale": 1.0}, {"detach_kl_z": False}, {"temperature": 0.5}),
    *({"boundary_bound": 3.0}, {"read_bias": 1.0}, {"w_reset": True}, {"c_sees_w": False}, {"h_sees_z": False}),
    *(
        {"decoder_sees_h": False},
        {"decoder_sees_c": False},
        {"budget": 1.0},
        {"budget_price": 1.0},
        {"budget_updates": 20},
        {"fixed_interval": 2},
    ),
]


@pytest.mark.parametrize("flags", [*UPDATE_FLAGS, *HWM_FLAGS, {"classes": 1}], ids=str)
def test_every_flag_changes_an_update(flags):
    data = make_data([[1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0]])
    changes = ({}, flags) if flags != {"classes": 1} else (flags, {**flags, "std_bias": -2.0})  # of normal variables
    default, changed = (after_an_update(make_learner(**{"budget_updates": 10, **each}), data) for each in changes)
    assert not torch.equal(default, changed)


@pytest.mark.parametrize(("classes", "tanh"), [(1, True), (4, False)])
def test_loss_is_the_sum_of_its_terms(classes, tanh):
    """Eq. 3.3.5 and J_R by torch.distributions; m_t pairs with the action that followed step t."""
    changes = {"kl_balance": 0.5, "kl_warmup": 1_000, "kl_z_scale": 0.7, "kl_w_scale": 0.3, "budget_price": 0.0}
    changes |= {"classes": classes, "budget_updates": 1, "tanh_reward": tanh}
    model, data = make_model(**changes), make_data([[1, 0, 0, 0, 0, 0], [1, 0, 1, 0, 0, 0], [1, 0, 0, 0, 0, 1]])
    data.terminals[1, 1] = 1
    torch.manual_seed(4)
    loss, belief, parts = method.world_model_loss(model, data, 499)
    torch.manual_seed(4)
    frames = model.normalize(data.frames)
    embed = model.embedding(frames.flatten(0, 1)).unflatten(0, (6, 3))
    made = model.observe(embed, one_hot(data.actions), data.first, model.args.temperature)
    bernoulli, kl = torch.distributions.Bernoulli, torch.distributions.kl_divergence

    def of(given):
        if classes == 1:
            return torch.distributions.Normal(*given)
        return torch.distributions.OneHotCategorical(logits=given.logits)

    def at(many, t, b):
        return of(type(many)(*(part[t, b] for part in many)))

    total = 0.0
    for t in range(6):
        for b in range(3):
            here = method.Belief(*(part[t, b][None] for part in made.belief))
            total += 0.25 * 0.5 * (model.decode(here)[0] - frames[t, b]).square().sum()
            q_z, q_w = at(made.q_z, t, b), at(made.q_w, t, b)
            p_z, p_w = model.prior_z(here.c[0]), model.prior_w(here.h[0])
            total += (
                0.5 * 0.7 * made.reads[t, b] * kl(q_z, of(p_z)).sum() + 0.5 * 0.3 * kl(q_w, of(p_w)).sum()
            )  # half warm
            if classes > 1:
                total -= 0.5 * 0.3 * (made.reads[t, b] * q_z.entropy().sum() + q_w.entropy().sum())
            if t < 5 and not data.first[t + 1, b]:
                p_m = model.prior_m(torch.cat([*here[:4], one_hot(data.actions[t + 1, b])[None]], -1))[0, 0]
                total += 0.3 * kl(bernoulli(logits=made.q_m[t, b]), bernoulli(logits=p_m)) * 18 / 15  # a mean of 5 × 3
            reward, goes_on = model.outcome(here.features()[0])
            target = np.tanh(data.rewards[t, b].item()) if tanh else data.rewards[t, b]
            total += 10 * 0.5 * (reward - target) ** 2
            total -= 5 * torch.log(1 - goes_on if data.terminals[t, b] else goes_on)
    assert loss.item() == pytest.approx(total.item() / 18, rel=1e-4)
    assert all(torch.equal(a, b) for a, b in zip(belief, made.belief))
    inside, free = 1 - data.first, 1 - made.forced[1:]  # steps with a past; and those that m decided
    kl_w = method.kl_divergence(made.q_w, model.prior_w(made.belief.h))
    assert parts["losses/kl_w"].item() == pytest.approx(((kl_w * inside).sum() / inside.sum()).item(), rel=1e-4)
    kl_z, read = method.kl_divergence(made.q_z, model.prior_z(made.belief.c)), made.reads * inside
    assert parts["losses/kl_z"].item() == pytest.approx(((kl_z * read).sum() / read.sum()).item(), rel=1e-4)
    agrees = ((made.p_m > 0) == (made.q_m[:-1] > 0)).float()
    assert parts["losses/agreement"].item() == pytest.approx(((agrees * free).sum() / free.sum()).item())
    settled = (1 - data.first[1:]) * (1 - data.first[:-1])  # steps that neither begin an episode nor come next
    assert parts["losses/read_rate"].item() == pytest.approx(
        (made.reads[1:] * settled).sum().item() / settled.sum().item()
    )


def test_reads_beyond_the_budget_cost_their_price():
    """The expected ones, by q(m), of the steps after the second; the gradient reaches q(m)."""
    data, losses, slopes = make_data([[1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0]]), [], []
    for price in (0.0, 10.0):
        torch.manual_seed(5)
        model = make_model(budget_price=price, budget=0.1)
        loss, _, _ = method.world_model_loss(model, data, 10**6)
        loss.backward()
        losses.append(loss.item())
        slopes.append(model.posterior_m.logit.bias.grad.item())
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    q_m = torch.sigmoid(model.posterior_m(embed, data.first))
    rate = torch.cat([q_m[1:5, 0], q_m[1:2, 1], q_m[4:5, 1]]).mean().item()
    assert rate > 0.1 and losses[1] - losses[0] == pytest.approx(10 * (rate - 0.1), rel=1e-3)
    assert slopes[1] > slopes[0]


def test_budget_and_temperature_come_down():
    args = make_args(budget_updates=100, budget=0.2, temperature=0.3)
    assert method.schedule(args, 0) == (1, 1) and method.schedule(args, 50) == pytest.approx((0.65, 0.6))
    assert method.schedule(args, 100) == method.schedule(args, 10**6) == pytest.approx((0.3, 0.2))


def test_a_fixed_interval_reads_every_k_steps_from_an_episodes_first():
    model, data = make_model(fixed_interval=3), make_data([[1, 0, 0, 0, 0, 0], [1, 0, 1, 0, 0, 0]])
    embed = model.embedding(model.normalize(data.frames.flatten(0, 1))).unflatten(0, data.first.shape)
    made = model.observe(embed, one_hot(data.actions), data.first, 1.0)
    assert made.reads.T.tolist() == [[1, 0, 0, 1, 0, 0], [1, 0, 1, 0, 0, 1]] and made.forced.all()
    state, ages = method.Belief(*(part[0] for part in made.belief)), []
    for _ in range(7):
        state = model.imagine_step(state, one_hot(torch.zeros(2, dtype=torch.int64)), model.noise(2))
        ages.append(int(state.age[0]))
    assert ages == [1, 2, 0, 1, 2, 0, 1]
    loss, _, parts = method.world_model_loss(model, data, 0)
    assert torch.isfinite(loss) and parts["losses/kl_m"] == 0
    assert parts["losses/read_rate"].item() == pytest.approx(2 / 6)  # of the steps that neither begin nor come next
    assert parts["losses/segment_length"].item() == pytest.approx(6 / 2)


# Runs
@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hwm_dreamer")
    run(*SMALL, "--run-dir", "run", "--save-model", cwd=folder, script=SCRIPT)
    return folder / "run"


def test_small_run_leaves_its_records(small_run):
    rows = list(csv.DictReader((small_run / "updates.csv").read_text().splitlines()))
    assert [row["global_step"] for row in rows] == ["1000", "1500"] and float(rows[0]["losses/read_rate"]) > 0
    result = json.loads((small_run / "result.json").read_text())
    assert result["complete"] and result["updates"] == 50
    for name in ("learning_curve.png", "dream.png"):
        assert (small_run / name).read_bytes()[1:4] == b"PNG"


def test_evaluation_plays_no_game_of_the_training(small_run):
    assert_no_game_of_training_is_scored(small_run, method)


def test_same_seed_same_bytes(small_run, tmp_path):
    run(*SMALL, "--run-dir", "again", cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "again")


def test_a_stopped_run_goes_on_to_the_same_bytes(small_run, tmp_path):
    for stop_at in (500, 1000, 1500):
        run(*SMALL, "--run-dir", "run", "--resume", "--stop-at", stop_at, cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "run")


def test_kinds_of_steps_and_ages():
    """One game: two walks in room 0, a turn, a bump, into a door, a turn there and out of it; reads at steps 0, 2 and 5."""
    rooms, poses = np.array([[0, 0, 0, 0, 0, 4, 4, 1]]).T, 4 * np.array([[0, 1, 2, 2, 2, 9, 9, 12]]).T
    poses[3:] += 1
    poses[6:] += 1
    kinds = dreamer_reads.kinds_of_steps(rooms, poses)
    steps = {name: np.flatnonzero(mask).tolist() for name, mask in kinds.items()}
    assert list(steps.values()) == [[1], [5], [7], [2], [3], [6], [4]]
    assert dreamer_reads.ages(np.array([[1, 0, 1, 0, 0, 1, 0]], bool).T).T.tolist() == [[0, 1, 2, 1, 2, 3, 1]]


def test_a_fixed_interval_is_seen_in_play(tmp_path, capsys):
    """Reads by a run with segments of 4 steps: at age 4 and at no other, as often in one kind of step as in the other."""
    run(*SMALL, "--fixed-interval", 4, "--stop-at", 1000, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    capsys.readouterr()
    dreamer_reads.main(dreamer_reads.Args(tmp_path / "run", episodes=20))
    head, _, _, *lines = capsys.readouterr().out.splitlines()
    rows = [line.strip("| ").split(" | ") for line in lines]
    steps = sum(int(number.replace(",", "")) for name, number, _ in rows if name.startswith("age"))
    assert f" {steps:,} steps after an episode's second, 0.2" in head
    reads = {name: float(rate) for name, _, rate in rows}
    assert [name for name in reads if name.startswith("age")] == [f"age {n}" for n in (1, 2, 3, 4)]
    assert [reads[f"age {n}"] for n in (1, 2, 3, 4)] == [0, 0, 0, 1]
    assert reads["in a room, turns"] == pytest.approx(0.25, abs=0.05)


@pytest.mark.parametrize("flags", [["--fixed-interval", 4], ["--w-reset", "--no-decoder-sees-h"], ["--classes", 1]])
def test_other_models_run(tmp_path, flags):
    run(*SMALL, *flags, "--stop-at", 1000, "--run-dir", "run", cwd=tmp_path, script=SCRIPT)
    assert json.loads((tmp_path / "run" / "result.json").read_text())["updates"] == 25


def test_copied_alone(small_run, tmp_path):
    (tmp_path / "mine.py").write_text(SCRIPT.read_text())
    run(*SMALL, "--run-dir", "run", cwd=tmp_path, script=tmp_path / "mine.py", PYTHONSAFEPATH="1")
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


@needs_compiler
def test_compiled_and_plain_agree():
    """The same batch, the same draws: parts of the losses."""
    data, results = make_data([[1, 0, 0, 0, 0, 0]] * 3), []
    for compiles in (False, True):
        torch.manual_seed(0)
        learner = method.Learner(make_args(), method.HWM(make_args(), 3), CPU)
        assert not compiles or method.compile_steps(learner, data)
        torch.manual_seed(7)
        parts = [learner.update(data) for _ in range(3)]
        results.append({name: value.item() for name, value in parts[-1].items()})
    for name, value in results[0].items():
        assert results[1][name] == pytest.approx(value, rel=1e-3, abs=1e-4), name


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(2))
def test_killed_runs_end_with_the_same_bytes(tmp_path, seed):
    flags = [*SMALL, "--total-timesteps", 5_000, "--seed", seed]
    run(*flags, "--run-dir", tmp_path / "whole", cwd=tmp_path, script=SCRIPT)
    kill_twice([*flags, "--run-dir", str(tmp_path / "run")], 14, seed, SCRIPT, after_checkpoints=True)
    run(*flags, "--run-dir", tmp_path / "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert_same_states(tmp_path / "whole", tmp_path / "run")
