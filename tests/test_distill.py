"""The hybrid loss, its labels and its update, and the synthetic human, against independent sources."""

import json
import math

import gymnasium as gym
import numpy as np
import pytest
import torch
from conftest import needs_compiler

from cleanrl_thesis import distill_hybrid as distill


@pytest.mark.parametrize("temperature", [0, 0.01, 0.5, 2])
def test_soft_labels_against_the_definition(temperature):
    q_values = torch.randn(20, 9, generator=torch.Generator().manual_seed(0))
    labels = distill.soft_labels(q_values, temperature)
    for row, label in zip(q_values.tolist(), labels):
        if temperature == 0:
            expected = [float(q == max(row)) for q in row]
        else:
            weights = [math.exp((q - max(row)) / temperature) for q in row]
            expected = [weight / sum(weights) for weight in weights]
        assert np.allclose(label, expected, atol=1e-6)


@pytest.mark.parametrize("alpha", [0.0, 0.3, 1.0])
def test_hybrid_loss_against_the_equation(alpha):
    """L_mix of section 2.3.2, summed by hand."""
    generator = torch.Generator().manual_seed(0)
    rl_logits, he_logits = torch.randn(2, 16, 9, generator=generator)
    labels = torch.softmax(torch.randn(16, 9, generator=generator), 1)
    actions = torch.randint(9, (16,), generator=generator)
    loss, (rl_loss, he_loss) = distill.hybrid_loss(rl_logits, labels, he_logits, actions, alpha)
    rl = he = 0.0
    for i in range(16):
        policies = [torch.softmax(logits[i].double(), 0) for logits in (rl_logits, he_logits)]
        rl -= sum(labels[i, a].item() * math.log(policies[0][a]) for a in range(9)) / 16
        he -= math.log(policies[1][actions[i]]) / 16
    assert math.isclose(rl_loss.item(), rl, rel_tol=1e-5) and math.isclose(he_loss.item(), he, rel_tol=1e-5)
    assert math.isclose(loss.item(), alpha * rl + (1 - alpha) * he, rel_tol=1e-5)


def test_the_loss_is_least_where_the_policy_is_the_mixture():
    """In one state, the best policy is α π_RL + (1 − α) π_HE."""
    alpha, labels = 0.7, torch.tensor([[0.1, 0.6, 0.3]])
    logits = torch.zeros(1, 3, requires_grad=True)
    optimizer = torch.optim.Adam([logits], 0.05)
    for _ in range(2000):
        loss, _ = distill.hybrid_loss(logits, labels, logits, torch.tensor([2]), alpha)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    assert torch.allclose(torch.softmax(logits, 1), torch.tensor([[0.07, 0.42, 0.51]]), atol=1e-3)


def test_split_by_frame_is_random_and_of_the_right_size():
    is_test = distill.split_frames(np.repeat(np.arange(10), 100), 150, "frame", np.random.default_rng(0))
    assert is_test.sum() == 150
    assert all(is_test[i : i + 100].any() for i in range(0, 1000, 100))


def test_split_by_episode_keeps_episodes_whole():
    episodes = np.repeat(np.arange(10), 100)
    is_test = distill.split_frames(episodes, 150, "episode", np.random.default_rng(0))
    assert is_test.sum() == 200
    assert all(is_test[i : i + 100].all() or not is_test[i : i + 100].any() for i in range(0, 1000, 100))


def test_dropout_masks_keep_the_mean():
    masks = distill.draw_masks((2, 1000, 100), 0.3)
    assert masks.unique().tolist() == pytest.approx([0.0, 1 / 0.7])
    assert abs(masks.mean().item() - 1) < 0.01


def make_update(images: bool = False, **settings):
    args = distill.complete_args(distill.Args(teacher=".", hidden_size=32, **settings))
    torch.manual_seed(0)
    generator = torch.Generator().manual_seed(1)
    rl_obs, he_obs = torch.rand(2, 64, 6, generator=generator)
    if images:
        rl_obs, he_obs = torch.randint(256, (2, 64, 4, 84, 84), dtype=torch.uint8, generator=generator)
    student = distill.Student(tuple(he_obs.shape[1:]), 9, 32)
    labels = torch.softmax(torch.randn(64, 9, generator=generator), 1)
    data = distill.Data(rl_obs, labels, he_obs, torch.randint(9, (64,), generator=generator))
    if args.states == "human":
        data = data._replace(rl_obs=data.he_obs)
    return student, distill.Update(student, args, data), data, args


@pytest.mark.parametrize("states", ["human", "own"])
def test_update_is_torchs_adam_on_the_loss(states):
    student, update, data, args = make_update(states=states)
    layers = [torch.nn.Linear(6, 32), torch.nn.Linear(32, 32), torch.nn.Linear(32, 9)]
    for layer, source in zip(layers, student.layers):
        layer.load_state_dict(source.state_dict())
    adam = torch.optim.Adam([parameter for layer in layers for parameter in layer.parameters()], 1e-4)

    def peer(obs: torch.Tensor, masks: torch.Tensor) -> torch.Tensor:
        hidden = torch.relu(layers[1](torch.relu(layers[0](obs)) * masks[0])) * masks[1]
        return torch.log_softmax(layers[2](hidden), 1)

    for _ in range(5):
        masks = distill.draw_masks((2, 64, 32), 0.5)
        update(data, masks)
        rl = -(data.rl_labels * peer(data.rl_obs, masks)).sum(1).mean()
        he = -peer(data.he_obs, masks)[torch.arange(64), data.he_actions].mean()
        adam.zero_grad()
        (args.alpha * rl + (1 - args.alpha) * he).backward()
        adam.step()
    for layer, source in zip(layers, student.layers):
        assert torch.allclose(layer.weight, source.weight, atol=2e-6)


@needs_compiler
@pytest.mark.parametrize("images", [False, True])
def test_compiled_update_is_the_plain_one(images):
    (_, plain, data, _), (_, compiled, _, _) = make_update(images), make_update(images, compile=True)
    assert compiled.is_compiled and not plain.is_compiled
    for _ in range(20):
        masks = distill.draw_masks((2, 64, 32), 0.5)
        parts = [torch.stack(update(data, masks)) for update in (plain, compiled)]
        assert torch.allclose(parts[0], parts[1], atol=1e-5)
    assert torch.allclose(plain.vector, compiled.vector, atol=1e-5)


@pytest.mark.parametrize("mode", ["sampled", "greedy"])
def test_numpy_policy_is_the_students(mode):
    student = distill.Student((6,), 9, 32)
    obs = torch.rand(1, 6).repeat(20_000, 1)
    actions = distill.numpy_policy(student, mode, 0)(obs.numpy())
    with torch.no_grad():
        probabilities = torch.softmax(student(obs[:1]), 1)[0]
    if mode == "greedy":
        assert set(actions) == {int(probabilities.argmax())}
    else:
        assert np.allclose(np.bincount(actions, minlength=9) / 20_000, probabilities, atol=0.015)


@pytest.mark.parametrize("mode", ["sampled", "greedy"])
def test_demonstrations_and_the_video_are_of_the_mode_that_is_asked_for(mode, tmp_path, monkeypatch):
    """Greedy the best action in every frame, sampled as often as the policy has it; scores are there of both modes."""
    filmed = []
    monkeypatch.setattr(distill, "record_video", lambda episode, *its: filmed.append(episode))
    settings = {"eval_mode": mode, "save_demos": 2, "eval_episodes": 1, "capture_video": True}
    student, update, _, args = make_update(**settings)
    evaluation = distill.evaluate(student, update, {"": update.vector.clone()}, args, tmp_path)
    distill.save_demonstrations(student, args, tmp_path)
    demos = distill.read_demonstrations(tmp_path / "demos", "AppleGame-v0", 10**9)
    manifest = json.loads((tmp_path / "demos" / "manifest.json").read_text())
    assert manifest["mode"] == mode and len(demos) == 2 and len(filmed) == 1
    assert filmed[0]["rewards"].sum() == evaluation[mode]["returns"][0]
    for episode in (*demos, *filmed):
        with torch.no_grad():
            policy = torch.softmax(student(torch.from_numpy(episode["observations"][:-1])), 1).numpy()
        taken = policy.argmax(1) == episode["actions"]
        if mode == "greedy":
            assert taken.all()
        else:  # sums of independent draws, within four standard deviations
            best = policy.max(1)
            assert abs(taken.sum() - best.sum()) < 4 * np.sqrt((best * (1 - best)).sum())
            assert best.mean() < 0.5


class Quadrants(gym.Env):
    """Images with a bright square in one quarter, two frames of them; the action that names it earns 1, 20 times."""

    observation_space = gym.spaces.Box(0, 255, (2, 40, 40), np.uint8)
    action_space = gym.spaces.Discrete(4)

    def __init__(self, render_mode=None):
        self.render_mode = render_mode

    def draw(self) -> np.ndarray:
        self.quarter = int(self.np_random.integers(4))
        obs = self.np_random.integers(0, 100, (2, 40, 40), dtype=np.uint8)
        y, x = 20 * (self.quarter // 2) + 5, 20 * (self.quarter % 2) + 5
        obs[:, y : y + 10, x : x + 10] = 255
        return obs

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.steps = 0
        return self.draw(), {}

    def step(self, action):
        reward = float(action == self.quarter)
        self.steps += 1
        return self.draw(), reward, False, self.steps == 20, {}


def test_a_student_sees_bytes_as_shares_of_255():
    """Channels last and with 255 in the weights, the convolutions give what the layers in their order give."""
    student = distill.Student((4, 84, 84), 8, 256)
    images = torch.randint(0, 256, (5, 4, 84, 84), dtype=torch.uint8)
    features = student.features(images)
    assert torch.allclose(features, student.convolutions(images / 255), atol=1e-6)
    assert features.abs().max() > 0.01


@pytest.mark.parametrize("flags", [[], ["--compile", "--split", "episode"]])
def test_a_student_of_images_learns_from_recordings(tmp_path, monkeypatch, flags):
    """The convolutional student, from demonstrations of a player who looks at the brightest quarter."""
    monkeypatch.setitem(gym.registry, "Quadrants-v0", gym.envs.registration.EnvSpec("Quadrants-v0", Quadrants))

    def look(obs):
        return obs.reshape(len(obs), 2, 2, 20, 2, 20).mean((1, 3, 5)).reshape(len(obs), 4).argmax(1)

    episodes = distill.play(look, "Quadrants-v0", list(range(30)), keep=True)
    assert all(episode["rewards"].sum() == 20 for episode in episodes)
    (tmp_path / "demos").mkdir()
    distill.write_demonstrations(tmp_path / "demos", episodes, {"env_id": "Quadrants-v0", "player": "a", "mode": "b"})
    sizes = ["--demo-frames", "600", "--test-frames", "100", "--epochs", "6", "--learning-rate", "1e-3"]
    command = ["--env-id", "Quadrants-v0", "--alpha", "0", "--demos", str(tmp_path / "demos"), *sizes, *flags]
    assert distill.cli([*command, "--eval-episodes", "20", "--run-dir", str(tmp_path / "run")]) == 0
    result = json.loads((tmp_path / "run" / "result.json").read_text())
    assert result["evaluation"]["greedy"]["mean"] > 18


def test_recorded_images_must_be_bytes(tmp_path, monkeypatch):
    monkeypatch.setitem(gym.registry, "Quadrants-v0", gym.envs.registration.EnvSpec("Quadrants-v0", Quadrants))
    episodes = distill.play(lambda obs: np.zeros(len(obs), int), "Quadrants-v0", [0], keep=True)
    episodes[0]["observations"] = episodes[0]["observations"] / 255
    distill.write_demonstrations(tmp_path, episodes, {"env_id": "Quadrants-v0", "player": "a", "mode": "b"})
    with pytest.raises(distill.UsageError, match="must be uint8, they are float64"):
        distill.read_demonstrations(tmp_path, "Quadrants-v0", 10**9)


@pytest.mark.parametrize("states", ["human", "own"])
def test_frames_are_labelled_by_the_teacher_where_the_term_asks(states):
    """Over the human's states both terms see the same frames; over its own the DQN's are those of its play."""
    args = distill.Args(teacher="a teacher", states=states, temperature=0.5, demo_frames=1_000)
    torch.manual_seed(0)
    teacher = distill.QNetwork(6, 9, 16, True)
    human = distill.join_frames(distill.make_human_demonstrations(args), 1_000)
    data = distill.label_frames(human, teacher, args)
    assert torch.equal(data.he_obs, torch.from_numpy(human.obs)) and data.he_actions.tolist() == human.actions.tolist()
    with torch.no_grad():
        assert torch.allclose(data.rl_labels, torch.softmax(teacher(data.rl_obs) / 0.5, 1))
    assert torch.equal(data.rl_obs, data.he_obs) == (states == "human")
    if states == "own":
        seed = distill.episode_seed(args.seed, distill.DEMONSTRATION_STREAM, 0)
        env = distill.make_env("AppleGame-v0")
        obs, _ = env.reset(seed=seed)
        for row in data.rl_obs:
            assert np.array_equal(row, obs)
            obs = env.step(int(teacher(row[None]).argmax()))[0]


@pytest.mark.parametrize("states", ["human", "own"])
def test_agreement_and_loss_on_test_frames_by_hand(states):
    student, update, data, args = make_update(states=states)
    numbers = distill.measure(student, data, args)
    agrees_rl = agrees_human = 0
    with torch.no_grad():
        rl_logs, he_logs = (student(obs).log_softmax(1) for obs in (data.rl_obs, data.he_obs))
        for i in range(64):
            agrees_rl += int(student(data.rl_obs[i : i + 1]).argmax()) == int(data.rl_labels[i].argmax())
            agrees_human += int(student(data.he_obs[i : i + 1]).argmax()) == int(data.he_actions[i])
    assert numbers["test/accuracy_human"] == pytest.approx(agrees_human / 64)
    assert numbers["test/accuracy_rl"] == pytest.approx(agrees_rl / 64)
    rl, he = -(data.rl_labels * rl_logs).sum(1).mean(), -he_logs[range(64), data.he_actions].mean()
    assert numbers["test/loss"] == pytest.approx((args.alpha * rl + (1 - args.alpha) * he).item(), rel=1e-5)
    expected = (args.alpha * agrees_rl + (1 - args.alpha) * agrees_human) / 64
    assert numbers["test/accuracy"] == pytest.approx(expected)


def test_an_epoch_takes_each_training_frame_once_in_another_order():
    """A last minibatch of fewer frames is left out."""
    obs, training, seen = torch.arange(100.0)[:, None], torch.arange(1, 100, 2)[:47], []
    data = distill.Data(obs, torch.zeros(100, 2), obs, torch.zeros(100, dtype=torch.long))

    def update(minibatch, masks):
        seen.append(minibatch.he_obs[:, 0].int().tolist())
        return torch.zeros(2).unbind()

    for _ in range(2):
        distill.train_epoch(update, data, training, distill.Args(batch_size=10, hidden_size=4))
    assert [len(frames) for frames in seen] == 8 * [10]
    one, two = sum(seen[:4], []), sum(seen[4:], [])
    assert one != sorted(one) and one != two
    assert len(set(one)) == len(set(two)) == 40 and set(one + two) <= set(training.tolist())


# The synthetic human
def test_the_synthetic_human_scores_as_the_published_one():
    """Table 2.1: 18.71 ± 2.86 with from 11 to 27."""
    human = distill.SyntheticHuman(400, seed=3)
    scores = [episode["rewards"].sum() for episode in distill.play(human, "AppleGame-v0", list(range(400)))]
    assert abs(np.mean(scores) - 18.71) < 0.7
    assert 2.5 < np.std(scores) < 3.9


def test_the_synthetic_human_needs_time_to_react_and_holds_its_keys():
    human = distill.SyntheticHuman(50, seed=3)
    episodes = distill.play(human, "AppleGame-v0", list(range(50)), keep=True)
    first_moves = [np.flatnonzero(episode["actions"] != 4)[0] for episode in episodes]
    assert min(first_moves) > 6 and 13 < np.median(first_moves) < 22  # frames: 0.1 s and 0.2 to 0.4 s
    changes = [np.mean(episode["actions"][1:] != episode["actions"][:-1]) for episode in episodes]
    assert np.mean(changes) * 60 < 8  # key changes per second


def test_the_synthetic_human_is_the_same_for_the_same_seed():
    runs = [distill.play(distill.SyntheticHuman(2, seed), "AppleGame-v0", [1, 2], keep=True) for seed in (5, 5, 6)]
    same, other = (all(np.array_equal(a["actions"], b["actions"]) for a, b in zip(runs[0], run)) for run in runs[1:])
    assert same and not other
