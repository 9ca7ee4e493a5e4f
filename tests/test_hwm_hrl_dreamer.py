"""HWM HRL Dreamer: both levels of its behaviour against independent sources, and small runs. The rest is tested in its twins."""

import csv
import json
import sys
from typing import NamedTuple

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from conftest import ROOT, kill_twice, needs_compiler, run
from test_dreamer import (
    after_an_update,
    assert_no_game_of_training_is_scored,
    assert_same_states,
    clipped_parts,
    make_data,
    wake,
)
from test_hwm_dreamer import SMALL, TINY

from cleanrl_thesis import hwm_hrl_dreamer as method

sys.path.append(str(ROOT / "benchmark"))
import dreamer_skills  # noqa: E402

SCRIPT = ROOT / "cleanrl_thesis" / "hwm_hrl_dreamer.py"
CPU = torch.device("cpu")


def make_args(**changes) -> method.Args:
    return method.complete_args(method.Args(**{**TINY, "prefill": 500, "total_timesteps": 1000, **changes}))


def brute_force_high(rewards, discounts, decides, high_values, last_value, gae_lambda: float, h: int) -> float:
    """Eq. 3.3.16's λ-return from step h, segment by segment.

    A segment's reward is the discounted sum of its steps'; the λ-return over n segments mixes what 1, 2, ... segments and the
    value behind them are worth, and the segment that the dream does not finish is worth the value of its level.
    """
    ends = [k for k in range(h + 1, len(decides)) if decides[k]]  # states at which the following segments begin
    horizon = len(rewards)

    def discounted(begin: int, end: int) -> tuple[float, float]:
        total, weight = 0.0, 1.0
        for k in range(begin, end):
            total += weight * rewards[k]
            weight *= discounts[k]
        return total, weight

    total, weight = discounted(h, horizon)
    longest = total + weight * (high_values[horizon] if decides[horizon] else last_value)
    sums = [(end, *discounted(h, end)) for end in ends if end < horizon]
    shorter = [reward + weight * high_values[end] for end, reward, weight in sums]
    value, share = 0.0, 1.0
    for each in shorter:
        value += share * (1 - gae_lambda) * each
        share *= gae_lambda
    return value + share * longest


@pytest.mark.parametrize("boundary", [None, *range(1, 7)])
@pytest.mark.parametrize("terminal", [None, 0, 3, 5])
def test_high_return_by_brute_force(boundary, terminal):
    """With a boundary at each place, one at the horizon, none, several; and an end of the episode within the dream."""
    rng = np.random.default_rng(0)
    rewards, discounts = rng.normal(size=(6, 3)), 0.97 * rng.random((6, 3))
    high_values, last_value = rng.normal(size=(7, 3)), rng.normal(size=3)
    decides = np.zeros((7, 3))
    decides[0] = 1
    if boundary is not None:
        decides[boundary] = 1
    decides[[2, 4], 1] = 1
    decides[1:, 2] = 1
    if terminal is not None:
        discounts[terminal] = 0
    tensors = [torch.from_numpy(array) for array in (rewards, discounts, decides, high_values, last_value)]
    returns = method.high_return(*tensors, 0.9).numpy()
    for n in range(3):
        for h in range(6):
            columns = rewards[:, n], discounts[:, n], decides[:, n], high_values[:, n], last_value[n]
            assert returns[h, n] == pytest.approx(brute_force_high(*columns, 0.9, h)), (h, n)
    if terminal is not None:
        assert returns[terminal] == pytest.approx(rewards[terminal])


def test_high_return_is_the_low_one_where_each_step_is_a_segment():
    torch.manual_seed(0)
    rewards, discounts, values = torch.randn(5, 2), torch.rand(5, 2), torch.randn(6, 2)
    both = method.high_return(rewards, discounts, torch.ones(6, 2), values, torch.zeros(2), 0.8)
    assert torch.allclose(both, method.lambda_return(rewards, discounts, values, 0.8), atol=1e-6)


class CorridorState(NamedTuple):
    place: torch.Tensor  # (N, 9) one-hot
    room: torch.Tensor  # (N, 3) one-hot
    age: torch.Tensor  # (N, 1): 0 where a room was entered

    def features(self) -> torch.Tensor:
        """z is the room, w the place."""
        return torch.cat([self.room, self.place], -1)


class Corridor(torch.nn.Module):
    """Places 0 to 8 in three rooms of three; action 1 leads up, 0 down; to arrive at 8 pays 1 and ends the episode."""

    feature_size, num_actions = 12, 2

    def __init__(self):
        super().__init__()
        self.unused = torch.nn.Parameter(torch.zeros(1))

    def noise(self, *shape):
        return torch.zeros(*shape, 1)

    def imagine_step(self, state, action, noise):
        place = (state.place.argmax(-1) + 2 * action.argmax(-1) - 1).clamp(0, 8)
        room = place // 3
        age = (state.age + 1) * (room == state.room.argmax(-1))[:, None]
        return CorridorState(F.one_hot(place, 9).float(), F.one_hot(room, 3).float(), age)

    def outcome(self, features):
        return features[..., 11], 1 - features[..., 11]


def corridor_starts() -> CorridorState:
    """Each place but the goal, four times: a room has been entered on its left."""
    place = torch.arange(8).repeat(4)
    return CorridorState(F.one_hot(place, 9).float(), F.one_hot(place // 3, 3).float(), (place % 3).float()[:, None])


def make_learner(**changes) -> method.Learner:
    args = make_args(deter_z=2, stoch_z=1, classes=1, **changes)
    torch.manual_seed(0)
    return method.Learner(args, Corridor(), CPU)


def test_skills_are_kept_in_a_segment_and_redrawn_at_its_end():
    learner = make_learner(num_skills=4)
    starts = corridor_starts()
    dream = method.imagine(learner.model, learner.behaviour, starts, 30, 0.9)
    rooms = dream.features[..., :3].argmax(-1)
    assert torch.equal(dream.decides[1:] > 0, rooms[1:] != rooms[:-1])
    assert torch.equal(dream.decides[0], (starts.age == 0).squeeze(1).float())  # none within a segment
    changed = (dream.skills[1:] != dream.skills[:-1]).any(-1)
    assert not (changed & (dream.decides[1:] == 0)).any()
    kept = 1 - changed[dream.decides[1:] > 0].float().mean()
    assert kept.item() == pytest.approx(0.25, abs=0.1)  # four skills, as likely as each other at first


def test_actions_in_a_dream_are_those_of_the_skill_at_hand():
    learner = make_learner(num_skills=2)
    learner.behaviour.policy = lambda features, skill: 100 * skill
    dream = method.imagine(learner.model, learner.behaviour, corridor_starts(), 30, 0.9)
    assert torch.equal(dream.actions, dream.skills[:-1]) and not torch.equal(dream.skills[0], dream.skills[-1])


def test_both_levels_learn_a_corridor():
    """The low level's values are γ^(7 − place); the high level's those of a room's first place, where it decides."""
    learner = make_learner(gamma=0.9, horizon=10, head_size=32, slow_interval=20, ent_coef=1e-3, num_skills=3)
    for _ in range(2_000):
        learner.learn_behaviour(corridor_starts())
    state = CorridorState(torch.eye(9)[:8], F.one_hot(torch.arange(8) // 3, 3).float(), torch.zeros(8, 1))
    with torch.no_grad():
        skill = F.one_hot(learner.behaviour.high_policy(state.features()).argmax(-1), 3).float()
        values = learner.behaviour.value(state.features(), skill)
        policy = learner.behaviour.policy(state.features(), skill).softmax(-1)[:, 1]
        high = learner.behaviour.high_value(state.features())
    expected = 0.9 ** torch.arange(7.0, -1, -1)
    assert torch.allclose(values, expected, atol=0.06), values
    assert (policy > 0.9).all(), policy
    assert torch.allclose(high[[0, 3, 6]], expected[[0, 3, 6]], atol=0.06), high


def test_losses_of_both_levels():
    """Eq. 3.3.14 and 3.3.15 by a loop over the steps, Eq. 3.3.16 and 3.3.17 over the decisions, weighed by how likely the dream
    comes to them."""
    learner = make_learner(num_skills=3)
    torch.manual_seed(3)
    for parameter in learner.behaviour.parameters():
        torch.nn.init.normal_(parameter, std=0.4)
    behaviour = learner.behaviour
    dream = method.imagine(learner.model, behaviour, corridor_starts(), 6, 0.9)
    losses, _ = method.behaviour_loss(behaviour, dream, 0.8, 0.01)
    with torch.no_grad():
        values = behaviour.slow_critic(torch.cat([dream.features, dream.skills], -1)).squeeze(-1)
        high = behaviour.slow_high_critic(dream.features[..., :3]).squeeze(-1)  # the features of z
        assert not torch.allclose(values, behaviour.value(dream.features, dream.skills))
        assert not torch.allclose(high, behaviour.high_value(dream.features))
        returns = method.high_return(dream.rewards, dream.discounts, dream.decides, high, values[-1], 0.8)
        actor = critic = number = low_actor = low_critic = 0.0
        for n in range(32):
            weight = 1.0
            for h in range(6):
                features, skill, target = dream.features[h, n], dream.skills[h, n], values[6, n]
                for k in reversed(range(h, 6)):
                    mixed = 0.2 * values[k + 1, n] + 0.8 * target
                    target = dream.rewards[k, n] + dream.discounts[k, n] * mixed
                policy = torch.distributions.Categorical(logits=behaviour.policy(features, skill))
                gain = policy.log_prob(dream.actions[h, n].argmax()) * (target - values[h, n])
                low_actor -= weight * (gain + 0.01 * policy.entropy())
                low_critic += weight * 0.5 * (behaviour.value(features, skill) - target) ** 2
                if dream.decides[h, n]:
                    number += 1
                    log_policy = behaviour.high_policy(dream.features[h, n]).log_softmax(-1)
                    entropy = -(log_policy.exp() * log_policy).sum()
                    chosen = log_policy[dream.skills[h, n].argmax()]
                    actor -= weight * (chosen * (returns[h, n] - high[h, n]) + 0.01 * entropy)
                    critic += weight * 0.5 * (behaviour.high_value(dream.features[h, n]) - returns[h, n]) ** 2
                weight *= dream.discounts[h, n]
    assert losses["actor"].item() == pytest.approx(float(low_actor / (6 * 32)), rel=1e-4)
    assert losses["critic"].item() == pytest.approx(float(low_critic / (6 * 32)), rel=1e-4)
    assert losses["high_actor"].item() == pytest.approx(float(actor / number), rel=1e-4)
    assert losses["high_critic"].item() == pytest.approx(float(critic / number), rel=1e-4)


def make_agent(**changes) -> method.Learner:
    args = make_args(**changes)
    torch.manual_seed(0)
    return method.Learner(args, method.HWM(args, 3), CPU)


def test_each_gradient_is_clipped_by_its_own_norm():
    assert clipped_parts(make_agent, make_data([[1, 0, 0, 0, 0, 0]] * 3), 0.001) == {
        "model",
        "actor",
        "critic",
        "high_actor",
        "high_critic",
    }


@pytest.mark.parametrize(
    "flags",
    [{"horizon": 2}, {"gamma": 0.5}, {"gae_lambda": 0.5}, {"ent_coef": 0.1}, {"slow_interval": 10}, {"num_skills": 3}]
    + [{"actor_learning_rate": 1e-4}, {"critic_learning_rate": 1e-4}, {"adam_eps": 1e-3}, {"max_grad_norm": 0.001}],
    ids=str,
)
def test_every_flag_changes_an_update(flags):
    data = make_data([[1, 0, 0, 0, 0, 0], [1, 0, 0, 1, 0, 0], [1, 0, 0, 0, 0, 0]])
    default, changed = (after_an_update(make_agent(**changes), data) for changes in ({}, flags))
    assert not torch.equal(default, changed)


def test_both_slow_critics_become_the_critics():
    behaviour = make_learner().behaviour
    wake(behaviour)
    behaviour.copy_critics()
    for slow, live in ((behaviour.slow_critic, behaviour.critic), (behaviour.slow_high_critic, behaviour.high_critic)):
        assert all(map(torch.equal, slow.state_dict().values(), live.state_dict().values()))


def test_a_dream_without_a_decision_teaches_the_high_level_nothing():
    learner = make_learner(num_skills=3)
    middle = CorridorState(torch.eye(9)[[1, 4]], torch.eye(3)[[0, 1]], torch.ones(2, 1))
    dream = method.imagine(learner.model, learner.behaviour, middle, 1, 0.9)  # one step, to a room's other places
    dream = dream._replace(decides=torch.zeros(2, 2))
    losses, _ = method.behaviour_loss(learner.behaviour, dream, 0.8, 0.01)
    assert losses["high_actor"].item() == losses["high_critic"].item() == 0


def test_information_of_the_skill():
    """ln 2 where each of two skills, as likely as the other, has an action of its own; 0 where the skill is not seen."""
    learner = make_learner(num_skills=2, head_layers=1)
    behaviour, features = learner.behaviour, corridor_starts().features()
    assert method.skill_information(behaviour, features).item() == pytest.approx(0, abs=1e-6)
    behaviour.policy = lambda features, skill: 40 * skill
    assert method.skill_information(behaviour, features).item() == pytest.approx(np.log(2), abs=1e-4)
    behaviour.high_policy = lambda features: torch.tensor([0.9, 0.1]).log().expand(len(features), 2)
    entropy = -(0.9 * np.log(0.9) + 0.1 * np.log(0.1))  # a skill that is seldom drawn says little
    assert method.skill_information(behaviour, features).item() == pytest.approx(entropy, abs=1e-4)


def test_entropy_of_the_use_of_skills():
    """That of how often each is drawn, not the mean of how uncertain the draws are."""
    learner = make_learner(num_skills=2)
    behaviour, features = learner.behaviour, corridor_starts().features()
    behaviour.high_policy = lambda features: 40 * F.one_hot(torch.arange(len(features)) % 2, 2).float()
    assert method.skill_usage_entropy(behaviour, features).item() == pytest.approx(np.log(2), abs=1e-6)
    behaviour.high_policy = lambda features: torch.tensor([40.0, 0.0]).expand(len(features), 2)
    assert method.skill_usage_entropy(behaviour, features).item() == pytest.approx(0, abs=1e-6)


def test_the_player_acts_by_its_skill():
    args = make_args(num_skills=3)
    torch.manual_seed(0)
    learner = method.Learner(args, method.HWM(args, 3), CPU)
    learner.behaviour.high_policy = lambda features: torch.tensor([[0.0, 0.0, 0.0]]).expand(len(features), 3)
    learner.behaviour.policy = lambda features, skill: 40 * skill
    player = method.Player(learner, 500)
    player.observe(np.zeros((500, 22, 22, 3), np.uint8), np.ones(500, bool))
    actions = player.act()
    assert np.array_equal(actions, player.skill.argmax(1)) and np.bincount(actions).min() > 100


def test_greedy_takes_the_best_skill_and_the_best_action():
    learner = make_agent(num_skills=3)
    learner.behaviour.high_policy = lambda features: torch.tensor([0.1, 0.2, 0.0]).expand(len(features), 3)
    learner.behaviour.policy = lambda features, skill: torch.tensor([0.3, 0.0, 0.1]).expand(len(features), 3)
    player = method.Player(learner, 200)
    side = learner.args.frame_side
    player.observe(np.zeros((200, side, side, 3), np.uint8), np.ones(200, bool))
    actions = player.act(greedy=True)
    assert (player.skill.argmax(1) == 1).all() and (actions == 0).all()
    assert len(set(player.act().tolist())) == 3 == len(set(player.skill.argmax(1).tolist()))


def test_the_player_keeps_its_skill_until_z_is_read(tmp_path):
    args = make_args(num_skills=4, fixed_interval=5)
    torch.manual_seed(0)
    learner = method.Learner(args, method.HWM(args, 3), CPU)
    player, skills = method.Player(learner, 6), []
    frames = np.zeros((6, 22, 22, 3), np.uint8)
    for t in range(15):
        player.observe(frames, np.full(6, t == 0))
        player.act()
        skills.append(player.skill)
    for t in range(1, 15):
        assert torch.equal(skills[t], skills[t - 1]) == (t % 5 != 0), t


# Skills in the true dynamics
def walk(every: int, steps: int) -> tuple[list[int], list[int], list[int]]:
    """A walk straight up through a door: cells' rooms, ages and the places of z, step by step."""
    maze, model = method.maze(11), dreamer_skills.Segments(every)
    x, y = method.DOORS[11][1]  # the left door, between the upper and the lower room on the left
    cell = int(maze.cell_at[x, y + 3])
    up = next(d for d in range(4) if tuple(method.HEADINGS[d]) == (0, -1))
    state = model.begin(torch.tensor([4 * cell + up]), torch.tensor([0]))
    states = [state]
    for _ in range(steps):
        state = model.imagine_step(state, F.one_hot(torch.tensor([2]), 3).float(), None)
        states.append(state)
    rooms = [int(maze.rooms[int(state.pose) // 4]) for state in states]
    return rooms, [int(state.age) for state in states], [int(state.place) for state in states]


def test_segments_begin_in_rooms_and_doors():
    rooms, ages, places = walk(0, 5)
    assert rooms[:3] == [rooms[0]] * 3 and rooms[3] >= 4 and rooms[4] != rooms[0]
    assert ages == [0, 1, 2, 0, 0, 1] and places == rooms


def test_segments_of_four_steps():
    rooms, ages, places = walk(4, 5)
    assert ages == [0, 1, 2, 3, 0, 1]
    assert places == [rooms[0]] * 4 + [rooms[4]] * 2


@pytest.mark.parametrize(
    "sees_z, hidden", [("both", [False] * 3), ("critic", [True, False, False]), ("neither", [True] * 3)]
)
def test_who_does_not_see_z_knows_of_the_goal_by_the_skill(sees_z, hidden):
    args = make_args()
    args.deter_z, args.stoch_z = dreamer_skills.Segments.z_size, 0
    model = dreamer_skills.Segments(0)
    behaviour = method.Behaviour(args, model)
    for parameter in behaviour.parameters():
        torch.nn.init.normal_(parameter)
    features = model.begin(torch.tensor([8, 8]), torch.tensor([0, 60])).features()  # two goals
    one, two = torch.eye(args.num_skills)[[0, 0]], torch.eye(args.num_skills)[:2]
    networks = behaviour.policy, behaviour.value, behaviour.slow_value
    assert not any(torch.equal(*network(features, one)) for network in networks)
    dreamer_skills.prepare(behaviour, sees_z=sees_z)
    assert [torch.equal(*network(features, one)) for network in networks] == hidden
    assert not any(torch.equal(*network(features, two)) for network in networks)
    assert not torch.equal(*behaviour.high_policy(features))


def test_eight_skills_by_hand_lead_to_every_goal():
    """What eight can do through the same two levels: their own count of returns and the instrument's agree."""
    model = dreamer_skills.Segments(4)
    tables = dreamer_skills.Tables(model)
    maze, by_goal = method.maze(11), tables.returns(model)
    returns = dreamer_skills.true_returns(tables, model)
    assert returns.min() > 0 and returns.mean() > 0.86
    pose, goal = maze.starts[5_000]  # walked by hand, reading the tables
    place, age, skill, steps = int(maze.rooms[pose // 4]), 0, 0, 0
    while pose // 4 != goal:
        skill = int(tables.skills[place, goal]) if age == 0 else skill
        pose, steps = maze.moves[pose, int(tables.actions[skill, pose])], steps + 1
        age = (age + 1) % 4
        place = int(maze.rooms[pose // 4]) if age == 0 else place
    assert returns[5_000] == pytest.approx(1 - 0.9 * steps / 100)
    assert by_goal[np.unique(maze.starts[:, 1])].min() > 0.8


def test_use_of_skills():
    """Skills that tell two classes of goals apart say ln 2 of z; actions that follow them by halves say ln 2 of those."""
    model = dreamer_skills.Segments(0)

    class ByHalves:
        num_skills = 4

        def high_policy(self, features):
            far = features[:, dreamer_skills.PLACES : model.z_size].argmax(-1) % 2
            return 40 * F.one_hot(far, 4).float()

        def policy(self, features, skill):
            return 40 * F.one_hot(skill.argmax(-1) // 2, 3).float()

    of_z, of_action = dreamer_skills.use_of_skills(ByHalves(), model)
    assert of_z == pytest.approx(np.log(2), abs=0.01) and of_action == pytest.approx(np.log(2), abs=1e-3)


# Runs
@pytest.fixture(scope="module")
def small_run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("hrl")
    run(*SMALL, "--run-dir", "run", "--save-model", cwd=folder, script=SCRIPT)
    return folder / "run"


def test_small_run_leaves_its_records(small_run):
    rows = list(csv.DictReader((small_run / "updates.csv").read_text().splitlines()))
    assert [row["global_step"] for row in rows] == ["1000", "1500"]
    assert float(rows[0]["losses/skill_usage_entropy"]) > 1 and "losses/skill_information" in rows[0]
    assert json.loads((small_run / "result.json").read_text())["updates"] == 50


def test_evaluation_plays_no_game_of_the_training(small_run):
    assert_no_game_of_training_is_scored(small_run, method)


def test_a_stopped_run_goes_on_to_the_same_bytes(small_run, tmp_path):
    for stop_at in (500, 1000, 1500):
        run(*SMALL, "--run-dir", "run", "--resume", "--stop-at", stop_at, cwd=tmp_path, script=SCRIPT)
    assert_same_states(small_run, tmp_path / "run")


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
def test_a_killed_run_ends_with_the_same_bytes(tmp_path):
    flags = [*SMALL, "--total-timesteps", 5_000]
    run(*flags, "--run-dir", tmp_path / "whole", cwd=tmp_path, script=SCRIPT)
    kill_twice([*flags, "--run-dir", str(tmp_path / "run")], 14, 0, SCRIPT, after_checkpoints=True)
    run(*flags, "--run-dir", tmp_path / "run", "--resume", cwd=tmp_path, script=SCRIPT)
    assert_same_states(tmp_path / "whole", tmp_path / "run")
