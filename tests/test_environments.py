"""The eleven tasks of the study: the rebuilt ones against the old models, and each one's state through a checkpoint."""

import json
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cleanrl_thesis import ppo_continuous_kle as ppo

# Numbers of the XML files that gym 0.15 shipped: sums of the compiled arrays, and a trajectory.
OLD_MODELS = json.loads((Path(__file__).parent / "data" / "old_arm_models.json").read_text())
STUDY = [f"kle/{name}-v2" for name in ppo.STUDY_TASKS]
V5 = [
    f"{name}-v5"
    for name in (
        "Ant",
        "HalfCheetah",
        "Hopper",
        "Humanoid",
        "InvertedPendulum",
        "Pusher",
        "Reacher",
        "Swimmer",
        "Walker2d",
    )
]
OBSERVATIONS = {
    "Ant": 27, "HalfCheetah": 17, "Hopper": 11, "Humanoid": 376, "InvertedPendulum": 4, "Pusher": 23,
    "Reacher": 11, "Striker": 23, "Swimmer": 8, "Thrower": 23, "Walker2d": 17,
}  # fmt: skip


@pytest.mark.parametrize("task", ["Pusher", "Striker", "Thrower"])
def test_rebuilt_model_is_the_old_one(task):
    model, old = ppo.make_env(f"kle/{task}-v2").unwrapped.model, OLD_MODELS[task]
    np.testing.assert_array_equal(model.opt.gravity, old["gravity"])
    assert model.opt.timestep == old["timestep"]
    for name, (size, total, weighted) in old["arrays"].items():
        array = np.asarray(getattr(model, name), float).ravel()
        assert len(array) == size, name
        assert array.sum() == pytest.approx(total, rel=1e-12, abs=1e-12), name
        assert (array * np.arange(1, size + 1)).sum() == pytest.approx(weighted, rel=1e-12, abs=1e-12), name


@pytest.mark.parametrize("task", ["Pusher", "Striker", "Thrower"])
def test_rebuilt_model_moves_as_the_old_one(task):
    import mujoco

    model = ppo.make_env(f"kle/{task}-v2").unwrapped.model
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(200):
        data.ctrl[:] = rng.uniform(*model.actuator_ctrlrange.T)
        mujoco.mj_step(model, data)
    np.testing.assert_allclose(data.qpos, OLD_MODELS[task]["qpos_after_200_random_controls"], rtol=1e-9, atol=1e-9)


def test_pusher_is_gymnasiums_but_for_the_cylinder_and_the_time_of_the_reward(monkeypatch):
    monkeypatch.setattr(ppo.PusherEnv, "edit_model", lambda self, spec: None)  # keeps v5's cylinder
    ours, theirs = ppo.PusherEnv(), gym.make("Pusher-v5").unwrapped
    ours.reset(seed=3)
    theirs.reset(seed=3)
    theirs.set_state(ours.data.qpos.copy(), ours.data.qvel.copy())
    distances = None
    for action in np.random.default_rng(0).uniform(-2, 2, (100, 7)):
        obs, reward, terminated, truncated, _ = ours.step(action)
        their_obs, _, _, _, info = theirs.step(action)
        np.testing.assert_array_equal(obs, their_obs)
        if distances is not None:  # those of the state before this step
            assert reward == pytest.approx(distances + info["reward_ctrl"], rel=1e-9)
        distances = info["reward_dist"] + info["reward_near"]
        assert not terminated and not truncated


def body(env, name: str) -> np.ndarray:
    return env.data.body(name).xpos.copy()


def test_striker_rewards_the_state_before_the_step():
    env, rng = ppo.StrikerEnv(), np.random.default_rng(0)
    for episode in range(3):
        env.reset(seed=episode)
        nearest = np.inf
        for _ in range(100):
            action = rng.uniform(-3, 3, 7)
            tip, ball, goal = (body(env, name) for name in ("tips_arm", "object", "goal"))
            nearest = min(nearest, np.linalg.norm(ball - goal))
            expected = -3 * nearest - 0.1 * (action**2).sum() - 0.5 * np.linalg.norm(ball - tip)
            obs, reward, terminated, truncated, _ = env.step(action)
            assert reward == pytest.approx(expected, rel=1e-9)
            assert obs.shape == (23,) and not terminated and not truncated


@pytest.mark.parametrize("freeze, near", [(False, 1.0), (True, 0.7)])
def test_striker_freezes_the_last_touch_only_where_it_is_told_to(freeze, near):
    env = ppo.StrikerEnv(freeze=freeze)
    env.reset(seed=0)
    ball, far, goal = np.array([0.3, 0, 0]), np.array([1.3, 0, 0]), np.array([2.3, 0, 0])
    assert env.reward(far, ball, goal) == pytest.approx(-3 * 2.0 - 0.5 * 1.0)
    assert env.reward(ball + [0.05, 0, 0], ball, goal) == pytest.approx(-3 * 2.0 - 0.5 * 0.05)
    moved = ball + [0.75, 0, 0]  # 0.7 from the touch; the tip is 1.0 away from it
    assert env.reward(moved + [0, 1.0, 0], moved, goal) == pytest.approx(-3 * 1.25 - 0.5 * near)
    assert env.reward(moved + [0, 1.0, 0], ball, goal) == pytest.approx(-3 * 1.25 - 0.5 * (0.05 if freeze else 1.25))


@pytest.mark.parametrize("freeze", [False, True])
def test_thrower_rewards_the_state_before_the_step(freeze):
    env = ppo.ThrowerEnv(freeze=freeze)
    env.reset(seed=0)
    rng, landing = np.random.default_rng(0), None
    for _ in range(300):
        action = rng.uniform(-10, 10, 7)
        ball, goal = body(env, "ball"), body(env, "goal")
        if landing is None and ball[2] < -0.25:
            landing = ball
        place = landing if freeze and landing is not None else ball
        _, reward, _, _, _ = env.step(action)
        expected = -np.linalg.norm(place[:2] - goal[:2]) - 0.002 * (action**2).sum()
        assert reward == pytest.approx(expected, rel=1e-9)
    assert landing is not None, "the ball never fell: the test would show nothing"


def test_resets_are_within_the_bounds_of_the_old_code():
    pusher, striker, thrower = ppo.PusherEnv(), ppo.StrikerEnv(), ppo.ThrowerEnv()
    samples = {"pusher": [], "striker": [], "thrower": []}
    for seed in range(300):
        for name, env, speed in (("pusher", pusher, 0.005), ("striker", striker, 0.1), ("thrower", thrower, 0.005)):
            env.reset(seed=seed)
            samples[name].append(env.data.qpos.copy())
            assert np.abs(env.data.qvel[:7]).max() <= speed and not env.data.qvel[7:].any()
    pusher, striker, thrower = (np.array(samples[name]) for name in ("pusher", "striker", "thrower"))
    assert (pusher[:, 7:9] >= [-0.3, -0.2]).all() and (pusher[:, 7:9] <= [0, 0.2]).all()
    assert np.linalg.norm(pusher[:, 7:9], axis=1).min() > 0.17 and not pusher[:, 9:11].any()
    assert (striker[:, 7:9] == [-0.175, 0.5]).all()
    goal = striker[:, 9:11]
    assert (goal >= [0.15, 0.1]).all() and (goal <= [0.7, 1.0]).all()
    offset = [0.5, -0.175] - goal
    np.testing.assert_allclose(striker[:, -1], -np.arctan(offset[:, 0] / (offset[:, 1] + 1e-8)) / 3.14)
    assert np.abs(thrower[:, 7:9]).max() <= 0.3 and np.abs(thrower[:, 7:9]).max() > 0.25


@pytest.mark.parametrize("env_id", STUDY)
def test_tasks_of_the_study(env_id):
    name = env_id[4:-3]
    env = gym.make(f"cleanrl_thesis.ppo_continuous_kle:{env_id}")
    assert env.observation_space.shape == (OBSERVATIONS[name],)
    assert env.spec.max_episode_steps == {"Reacher": 50, "Pusher": 100, "Striker": 100, "Thrower": 100}.get(name, 1000)
    if name in ("Pusher", "Striker", "Thrower"):
        check_env(env.unwrapped, skip_render_check=True)


def test_humanoid_sees_no_contact_forces():
    env, plain = ppo.make_env("kle/Humanoid-v2"), gym.make("Humanoid-v4")
    obs, _ = env.reset(seed=0)
    plain_obs, _ = plain.reset(seed=0)
    felt = False
    for _ in range(30):
        action = env.action_space.sample()
        obs, _, _, _, _ = env.step(action)
        plain_obs, _, _, _, _ = plain.step(action)
        np.testing.assert_array_equal(obs[:-84], plain_obs[:-84])
        assert not obs[-84:].any()
        felt |= bool(plain_obs[-84:].any())
    assert felt, "no contact ever: the test would show nothing"


@pytest.mark.parametrize("env_id", [*STUDY, *V5, "Pendulum-v1"])
def test_replay_restores_the_state_of_an_environment(env_id):
    """Bit for bit: stop in the middle of the third episode, replay it in a new environment, go on with both."""
    env = ppo.make_env(env_id)
    rng = np.random.default_rng(0)
    low, high = env.action_space.low, env.action_space.high
    first = ppo.Episode(env, seed=1, stream=0, gamma=0.99)
    first.start()
    lengths = []
    while first.number < 2 or len(first.actions) < 7:
        _, _, terminated, truncated = first.step(rng.uniform(low, high).astype(np.float32))
        if terminated or truncated:
            lengths.append(len(first.actions))
            first.start()
    second = ppo.Episode(ppo.make_env(env_id), seed=1, stream=0, gamma=0.99)
    second.replay(first.number, np.array(first.actions))
    assert second.episodic_return == first.episodic_return
    assert second.discounted_return == first.discounted_return
    for _ in range(60):
        action = rng.uniform(low, high).astype(np.float32)
        obs, *rest = first.step(action)
        other_obs, *other_rest = second.step(action)
        np.testing.assert_array_equal(obs, other_obs)
        assert rest == other_rest
        if rest[1] or rest[2]:
            np.testing.assert_array_equal(first.start(), second.start())


def test_episode_seeds_do_not_repeat_between_neighbouring_seeds_and_environments():
    seeds = {ppo.episode_seed(s, i, e) for s in range(10) for i in range(10) for e in range(20)}
    assert len(seeds) == 2000


@pytest.mark.parametrize(
    "task, version", [("Hopper", "v4"), ("Walker2d", "v4"), ("HalfCheetah", "v4"), ("Swimmer", "v4")]
)
def test_what_is_left_out_to_save_time_changes_no_number(task, version):
    """Fewer looks at the health and no search for islands: the same bytes as Gymnasium's own environment."""
    quick, plain = ppo.make_env(f"kle/{task}-v2"), gym.make(f"{task}-{version}")
    rng = np.random.default_rng(3)
    for episode in range(30):
        assert np.array_equal(quick.reset(seed=episode)[0], plain.reset(seed=episode)[0])
        for _ in range(100):
            action = rng.uniform(-1, 1, quick.action_space.shape).astype(np.float32)
            ours, theirs = quick.step(action), plain.step(action)
            assert np.array_equal(ours[0], theirs[0])
            assert ours[1:4] == theirs[1:4]
            if theirs[2]:
                break
    assert (task in ("Hopper", "Walker2d")) == theirs[2]
