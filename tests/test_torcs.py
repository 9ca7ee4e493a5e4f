"""The driving task against geometry by brute force, and against what the car's numbers imply."""

import math

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from scipy.integrate import solve_ivp

from cleanrl_thesis import ddpg_torcs_like as torcs
from cleanrl_thesis import gail_hybrid as gail

ENV_ID = "cleanrl_thesis.ddpg_torcs_like:TorcsLike-v0"
STRAIGHT = torcs.Track(15, "20000")


def test_an_id_without_a_version_is_the_driving_task_too():
    for method in (torcs, gail):
        args = method.Args(env_id="TorcsLike", track_name="city")
        assert method.env_options(args)["track"] == "city"


def test_a_seed_for_each_car():
    with pytest.raises(ValueError, match="2 seeds for 3 cars"):
        torcs.TorcsLikeVectorEnv(3).reset(seed=[1, 2])


def cars_at(track: torcs.Track, distance: float, left: float, speed: float, angle: float = 0.0) -> torcs.Cars:
    """One car at a place of a road, rolling in a direction relative to the road."""
    cars = torcs.Cars(1, track)
    cars.segment[:], xy, heading = track.place(np.array(distance), np.array(left))
    cars.xy[:, 0], cars.yaw[:], cars.angle[:] = xy, heading + angle, -angle
    cars.along[:], cars.left[:] = distance - track.distances[cars.segment], left
    cars.velocity[0], cars.spin[:] = speed, speed / torcs.WHEEL_RADIUS
    cars.gear[:] = np.searchsorted(torcs.GEAR_SPEEDS, speed, "right")
    return cars


def steer(cars: torcs.Cars, gain: float = 0.6) -> float:
    """Keep to the middle of the road."""
    curvature = cars.track.curvatures[cars.segment[0]]
    along = math.atan((torcs.FRONT_AXLE + torcs.REAR_AXLE) * curvature)
    return float(np.clip((along + gain * cars.angle[0] - 0.03 * cars.left[0]) / torcs.STEERING_LOCK, -1, 1))


def scattered(name: str, number: int) -> tuple[torcs.Track, np.ndarray, np.ndarray]:
    """A road, and places on it: distance from the start line, and to the left of the middle."""
    track, rng = torcs.Track(*torcs.TRACKS[name]), np.random.default_rng(0)
    return track, rng.uniform(0, track.length, number), rng.uniform(-0.98, 0.98, number) * track.half_width


# The road
@pytest.mark.parametrize(
    "name, length, width, radius",
    [
        ("meadow", 2057.6, 15, 60),
        ("speedway", 1908.3, 25, 100),
        ("hills", 3274.2, 11, 37),
        ("city", 2587.5, 10, 15),  # TORCS' has one curve of 12.2 m
    ],
)
def test_tracks_close_and_have_the_sizes_of_torcs(name, length, width, radius):
    track = torcs.Track(*torcs.TRACKS[name])
    assert abs(track.length - length) < 0.5 and track.half_width == width / 2
    assert 1 / np.abs(track.curvatures).max() == pytest.approx(radius)
    assert abs((track.lengths * track.curvatures).sum() - 2 * np.pi) < 1e-9
    end = track.starts[:, -1] + torcs.arc(track.lengths[-1], track.curvatures[-1], track.headings[-1])
    assert np.abs(end).max() < 1e-9
    _, middle, _ = track.place(np.arange(0, track.length, 5.0), np.zeros(math.ceil(track.length / 5)))
    gaps = np.hypot(*(middle[:, :, None] - middle[:, None]))
    steps = np.abs(np.subtract.outer(*2 * [np.arange(len(gaps))]))
    far = np.minimum(steps, len(gaps) - steps) > 30
    assert gaps[far].min() > 2 * width  # the road does not meet itself


@pytest.mark.parametrize("name", torcs.TRACKS)
def test_places_are_found_again(name):
    track, distance, left = scattered(name, 500)
    segment, xy, _ = track.place(distance, left)
    along, found = track.locate(segment, xy)
    assert np.allclose(track.distances[segment] + along, distance) and np.allclose(found, left)
    later, xy, _ = track.place((distance + 1.9) % track.length, left)
    assert np.array_equal(track.follow(segment, xy)[0], later)


@pytest.mark.parametrize("name", torcs.TRACKS)
def test_range_finders_against_every_metre_of_the_edges(name):
    track, distance, left = scattered(name, 150)
    segment, xy, heading = track.place(distance, left)
    along, _ = track.locate(segment, xy)
    angles = np.random.default_rng(1).uniform(-np.pi, np.pi, (150, 3))
    places = segment, along.astype(np.float32), left.astype(np.float32)
    found = track.ranges(*places, np.cos(angles).astype(np.float32), np.sin(angles).astype(np.float32))
    finely = np.arange(0, track.length, 0.25)
    edges = [track.place(finely, np.full(len(finely), side * track.half_width))[1] for side in (1, -1)]
    begins = np.concatenate(edges, 1)
    sides = np.concatenate([np.roll(edge, -1, 1) for edge in edges], 1) - begins
    for i, ray in np.ndindex(150, 3):
        way = np.array([np.cos(heading[i] + angles[i, ray]), np.sin(heading[i] + angles[i, ray])])
        to = begins - xy[:, i, None]
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = way[0] * sides[1] - way[1] * sides[0]
            distances = (to[0] * sides[1] - to[1] * sides[0]) / crossing
            share = (to[0] * way[1] - to[1] * way[0]) / crossing
        hits = distances[(distances > 0) & (share >= 0) & (share <= 1)]
        assert abs(min(hits.min(initial=np.inf), torcs.RANGE) - found[i, ray]) < 0.02


def test_range_finders_on_a_straight_by_hand():
    cars = cars_at(STRAIGHT, 5_000, 2.5, 0)
    found = cars.find_edges(np.array([0]))[0]
    assert found[0] == pytest.approx(5) and found[18] == pytest.approx(10) and found[9] == 200
    assert found[6] == pytest.approx(5 / math.sin(math.radians(30)), rel=1e-4)
    cars.left[:] = 8
    assert (cars.find_edges(np.array([0])) == -1).all()


# Other cars
def test_parked_cars_are_seen_where_they_are():
    """By hand: 100 m behind the first, whose nearest corner is 2.26 m nearer, 0.97 m to the side."""
    track = torcs.Track(*torcs.TRACKS["meadow"])
    left = torcs.PARKED_LEFT[0] * track.half_width
    found = cars_at(track, 200, left, 0).find_cars(np.array([0]))[0]
    assert found[[17, 18]].min() == pytest.approx(math.hypot(100 - 2.26, 0.97), rel=1e-5)
    assert (np.delete(found, [17, 18]) == 200).all()
    found = cars_at(track, 300, left - 3, 0).find_cars(np.array([0]))[0]  # beside it: to the left are sectors 0 to 17
    assert found[:18].min() == pytest.approx(3 - 0.97, abs=0.02)
    assert (found[5:13] < 4).all()


def test_sectors_turn_with_the_car():
    track = torcs.Track(*torcs.TRACKS["meadow"])
    for degrees, sector in (
        (4, 18),
        (-4, 17),
        (94, 27),
        (184, 0),
        (-86, 9),
    ):  # to the left, and clockwise from the rear
        found = cars_at(track, 200, 0, 0, math.radians(degrees) + 0.0375).find_cars(np.array([0]))[0]
        assert found.argmin() == sector


def test_two_cars_overlap_as_their_points_say():
    rng = np.random.default_rng(0)
    ways, yaws, others = rng.uniform(-5, 5, (2, 400)), rng.uniform(-4, 4, 400), rng.uniform(-4, 4, 400)
    half = np.array([torcs.CAR_LENGTH, torcs.CAR_WIDTH]) / 2
    grid = np.stack(np.meshgrid(*(np.linspace(-side, side, 40) for side in half))).reshape(2, -1)
    for way, yaw, other, found in zip(ways.T, yaws, others, torcs.overlap(ways, yaws, others)):
        points = torcs.turned(way[:, None] + torcs.turned(grid, other), -yaw)
        depth = (half[:, None] - np.abs(points)).min(0).max()
        assert found == (depth > 0) or abs(depth) < 0.15


def test_touching_a_parked_car_ends_the_episode():
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    while True:  # straight ahead at the first car
        env.cars.left[:] = torcs.PARKED_LEFT[0] * 7.5
        env.cars.xy[1] = env.cars.left
        env.cars.yaw[:] = 0
        _, reward, terminated, truncated, info = env.step(np.array([0.0, 0.5], np.float32))
        if terminated:
            break
    assert reward == -1 and info["crashed"] and not truncated
    assert 300 - env.cars.xy[0, 0] == pytest.approx(torcs.CAR_LENGTH, abs=0.5)


# The car
def test_top_speed_is_that_of_the_limiter():
    """At 9,152 rpm the last gear goes 87 m/s, at which the engine has power left."""
    cars = cars_at(STRAIGHT, 100, 0, 60)
    for _ in range(40 * torcs.FPS):
        cars.step(np.array([[0.0, 1.0]]))
    fastest = torcs.LIMIT_RPM * np.pi / 30 / torcs.GEARS[-1] * torcs.WHEEL_RADIUS
    assert fastest * torcs.DRAG * fastest**2 < 483 * torcs.LIMIT_RPM * np.pi / 30
    assert 0.97 * fastest < cars.velocity[0, 0] < 1.05 * fastest


def test_without_drive_the_drag_slows_the_car_down():
    """v' = - D v² / m, with the wheels' and the engine's inertia on top of the mass."""
    cars = cars_at(STRAIGHT, 100, 0, 80)
    for _ in range(10 * torcs.FPS):
        cars.step(np.array([[0.0, 0.0]]))
    inertia = 2 * torcs.WHEEL_INERTIA + torcs.ENGINE_INERTIA * torcs.GEARS[-1] ** 2
    mass = torcs.MASS + inertia / torcs.WHEEL_RADIUS**2
    assert cars.velocity[0, 0] == pytest.approx(80 / (1 + 80 * 10 * torcs.DRAG / mass), rel=0.003)


def test_from_0_to_100_against_an_integration_without_slip():
    """Engine torque and drag over mass and inertia, at most the grip of the loaded rear wheels; and the shifts' time."""

    def push(t, state):
        v = state[0]
        gear = torcs.GEARS[np.searchsorted(torcs.GEAR_SPEEDS, v, "right")]
        rpm = max(v / torcs.WHEEL_RADIUS * gear * 30 / np.pi, torcs.IDLE_RPM)
        force = min(100 + 383 * rpm / 8000, 483) * gear / torcs.WHEEL_RADIUS
        base, lift = torcs.FRONT_AXLE + torcs.REAR_AXLE, torcs.GRIP * torcs.HEIGHT
        force = min(force, torcs.GRIP * torcs.MASS * 9.81 * torcs.FRONT_AXLE / (base - lift))
        inertia = 2 * torcs.WHEEL_INERTIA + torcs.ENGINE_INERTIA * gear**2
        return [(force - torcs.DRAG * v * v) / (torcs.MASS + inertia / torcs.WHEEL_RADIUS**2)]

    reached = solve_ivp(push, (0, 10), [0.0], events=lambda t, s: s[0] - 100 / 3.6, max_step=0.01).t_events[0][0]
    cars, steps = cars_at(STRAIGHT, 100, 0, 0), 0
    while cars.velocity[0, 0] < 100 / 3.6:
        cars.step(np.array([[0.0, 1.0]]))
        steps += 1
    assert 3 < reached < 5.5
    assert reached < steps / torcs.FPS < reached + 2 * torcs.SHIFT_TIME + 0.35


def test_braking_distance_is_that_of_the_brakes():
    """v² / 2a from 100 km/h, a by brakes of 1.1 g on mass and inertia; the grip of 1.6 g is more than they need."""
    cars = cars_at(STRAIGHT, 100, 0, 100 / 3.6)
    while cars.velocity[0, 0] > 0.5:
        cars.step(np.array([[0.0, -1.0]]))
    inertia = 2 * torcs.WHEEL_INERTIA + torcs.ENGINE_INERTIA * torcs.GEARS[[1, 2]].mean() ** 2
    distance = (100 / 3.6) ** 2 / (2 * 1.1 * 9.81) * (1 + inertia / torcs.WHEEL_RADIUS**2 / torcs.MASS)
    assert cars.xy[0, 0] - 100 == pytest.approx(distance, rel=0.06)
    assert abs(cars.xy[1, 0]) < 0.01


def test_without_brake_negative_throttle_coasts():
    distances = []
    for brake, pedal in ((False, -1.0), (True, 0.0), (True, -1.0)):
        cars = cars_at(STRAIGHT, 100, 0, 30)
        cars.brake = brake
        for _ in range(50):
            cars.step(np.array([[0.0, pedal]]))
        distances.append(cars.xy[0, 0])
    assert distances[0] == distances[1] > distances[2] + 3


@pytest.mark.parametrize("share, holds", [(0.85, True), (1.25, False)])
def test_a_curve_of_60_m_can_be_driven_at_most_as_fast_as_the_grip_allows(share, holds):
    """μ g = v² / r."""
    track = torcs.Track(15, "200 60/180 200")
    speed = share * math.sqrt(torcs.GRIP * 9.81 * 60)
    cars = cars_at(track, 100, 0, speed)
    while cars.along[0] < 10 or cars.segment[0] < 3:
        pedal = np.clip(speed - cars.velocity[0, 0], -0.2, 0.8)
        cars.step(np.array([[steer(cars), pedal]]))
        if cars.is_off_road()[0] or cars.steps[0] > 1500:
            break
    assert (not cars.is_off_road()[0]) == holds


def test_steady_turn_is_the_geometry_of_the_wheels_at_low_speed():
    """At walking pace the tyres do not slip: yaw rate = v tan(steering) / wheel base."""
    cars = cars_at(torcs.Track(2000, "20000"), 5_000, 0, 4)
    for _ in range(200):
        cars.step(np.array([[0.5, np.clip(4 - cars.velocity[0, 0], -1, 1)]]))
    base, angle = torcs.FRONT_AXLE + torcs.REAR_AXLE, 0.5 * torcs.STEERING_LOCK
    assert cars.yaw_rate[0] == pytest.approx(cars.velocity[0, 0] * math.tan(angle) / base, rel=0.03)


def test_tyre_forces_peak_at_the_grip_and_fall_when_they_slide():
    slip = np.linspace(0, 50, 200_001)
    force = torcs.tyre_force(slip, np.array(5_000.0))
    assert force.max() == pytest.approx(1.6 * 5_000) and 0.1 < slip[force.argmax()] < 0.2
    assert force[-1] == pytest.approx(0.85 * 1.6 * 5_000, rel=0.01)


def test_finer_steps_change_little(monkeypatch):
    """Ten seconds of slalom at 100 km/h with 2 and with 40 substeps."""
    ends = []
    for substeps in (torcs.SUBSTEPS, 40):
        monkeypatch.setattr(torcs, "SUBSTEPS", substeps)
        cars = cars_at(torcs.Track(2000, "20000"), 5_000, 0, 28)
        for i in range(500):
            pedal = np.clip(28 - cars.velocity[0, 0], -1, 1)
            cars.step(np.array([[0.15 * math.sin(i / 20), pedal]]))
        ends.append([*cars.xy[:, 0], 20 * cars.yaw[0], cars.velocity[0, 0]])
    assert np.abs(np.subtract(*ends)).max() < 1.5  # m, of 270


def test_random_driving_stays_finite():
    env = torcs.TorcsLikeVectorEnv(64)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    for _ in range(400):
        obs, rewards, _, _, _ = env.step(rng.uniform(-1, 1, (64, 2)))
        assert np.isfinite(obs).all() and np.isfinite(rewards).all()


# The environment
def test_check_env():
    check_env(gym.make(ENV_ID, render_mode="rgb_array").unwrapped)


def test_single_and_vectorised_agree():
    """10,000 steps of 5 cars: the same bytes, through crashes and time-outs."""
    seeds = [11, 12, 13, 14, 15]
    vector = gym.make_vec(ENV_ID, num_envs=5, vectorization_mode="vector_entry_point")
    singles = [gym.make(ENV_ID) for _ in seeds]
    obs, _ = vector.reset(seed=seeds)
    assert np.array_equal(obs, [env.reset(seed=seed)[0] for env, seed in zip(singles, seeds)])
    rng, ends = np.random.default_rng(0), {"crashed": 0, "truncated": 0}
    for i in range(2_000):
        slow = np.arange(5) >= (3 if i < 1_000 else 5)  # some crash, others creep
        steering = obs[:, 0] * 6 - 0.5 * obs[:, 20] + rng.normal(0, 0.2, 5)
        pedal = np.where(slow, 0.02, 0.05 * (90 - 300 * obs[:, 21])) + rng.normal(0, 0.1, 5)
        actions = np.clip(np.stack([steering, pedal], 1), -1, 1).astype(np.float32)
        if i % 500 == 499:  # time is nearly up
            for env in (vector, *singles):
                env.unwrapped.cars.steps += torcs.EPISODE_STEPS - 100
        obs, rewards, terminated, truncated, infos = vector.step(actions)
        for j, env in enumerate(singles):
            one = env.step(actions[j])
            assert (one[1], one[2], one[3]) == (rewards[j], terminated[j], truncated[j])
            assert one[4] == {name: infos[name][j] for name in ("progress", "crashed")}
            if one[2] or one[3]:
                ends["crashed" if one[2] else "truncated"] += 1
                assert np.array_equal(one[0], infos["final_obs"][j])
                one = env.reset()
            assert np.array_equal(one[0], obs[j])
    assert ends["crashed"] > 5 and ends["truncated"] > 5


def test_observations_by_hand():
    cars = cars_at(torcs.Track(*torcs.TRACKS["meadow"]), 100, -3, 30, angle=0.2)
    cars.velocity[1], cars.yaw_rate[:] = 1.5, 0.4
    obs = cars.observe(np.array([0]))[0]
    assert obs.shape == (65,) and obs.dtype == np.float32
    assert obs[0] == pytest.approx(-0.2 / np.pi)
    assert np.allclose(obs[1:20], cars.find_edges(np.array([0]))[0] / 200)
    assert obs[20] == pytest.approx(-3 / 7.5)
    assert np.allclose(obs[21:24], [30 * 3.6 / 300, 1.5 * 3.6 / 300, 0])
    right, left = (30 / torcs.WHEEL_RADIUS + side * 0.4 * torcs.HALF_TRACK / torcs.WHEEL_RADIUS for side in (1, -1))
    assert np.allclose(obs[24:28], np.array([right, left, right, left]) / 100)
    assert obs[28] == pytest.approx(30 / torcs.WHEEL_RADIUS * torcs.GEARS[2] * 30 / np.pi / 10_000)
    assert np.allclose(obs[29:], cars.find_cars(np.array([0]))[0] / 200)


def test_rewards_are_metres_of_progress_or_speed():
    for reward in ("distance", "speed"):
        env = gym.make(ENV_ID, reward=reward).unwrapped
        env.reset(seed=1)
        total = 0.0
        for _ in range(100):
            _, reward_of_step, terminated, _, info = env.step(np.array([0, 0.3], np.float32))
            expected = env.cars.velocity[0, 0] * math.cos(env.cars.angle[0]) * 3.6
            assert reward_of_step == (info["progress"] if reward == "distance" else pytest.approx(expected))
            assert not terminated
            total += info["progress"]
        assert total == pytest.approx(env.cars.raced[0])
        assert total == pytest.approx(env.cars.along[0] - torcs.START)


def test_standing_turning_back_and_the_laps_end_the_episode():
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, np.float32))[2] for _ in range(51)]
    assert ends == [False] * 50 + [True]
    env.reset(seed=0)
    env.cars.yaw += np.pi
    _, reward, terminated, _, info = env.step(np.zeros(2, np.float32))
    assert terminated and not info["crashed"] and reward == pytest.approx(0, abs=1e-6)
    env = gym.make(ENV_ID, max_laps=0.01).unwrapped
    env.reset(seed=0)
    while not env.step(np.array([0, 0.5], np.float32))[2]:
        pass
    assert 20.5 < env.cars.raced[0] < 22


def test_leaving_the_road_ends_the_episode():
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    while True:
        obs, reward, terminated, _, info = env.step(np.array([0.5, 0.5], np.float32))
        if terminated:
            break
    assert reward == -1 and info["crashed"] and obs[20] > 1 and np.allclose(obs[1:20], -1 / 200)
    assert env.observation_space.contains(obs)


def test_a_minute_is_a_time_out():
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    env.cars.steps[:] = torcs.EPISODE_STEPS - 1
    env.cars.velocity[0] = 10
    _, _, terminated, truncated, _ = env.step(np.zeros(2, np.float32))
    assert truncated and not terminated


@pytest.mark.parametrize("action", [[0.0, math.nan], [math.inf, 0.0], [0.0], [0.0, 0.0, 0.0]])
def test_an_action_of_another_kind_is_named(action):
    env = gym.make(ENV_ID).unwrapped
    env.reset(seed=0)
    with pytest.raises(ValueError, match="actions .*: must be 1 pairs of finite numbers"):
        env.step(np.array(action))


def test_actions_are_clipped():
    ends = []
    for size in (1.0, 7.0):
        env = gym.make(ENV_ID).unwrapped
        env.reset(seed=0)
        ends.append([env.step(np.array([0.1, size]))[0] for _ in range(20)][-1])
    assert np.array_equal(*ends)


@pytest.mark.parametrize("options", [{"track": "monza"}, {"reward": "fame"}])
def test_an_unknown_option_is_named(options):
    with pytest.raises(ValueError, match=f"{next(iter(options))} {next(iter(options.values()))}: must be"):
        torcs.TorcsLikeEnv(**options)


def test_the_picture_has_road_cars_and_map():
    env = gym.make(ENV_ID, render_mode="rgb_array").unwrapped
    env.reset(seed=0)
    while env.cars.raced[0] < 60:
        env.step(np.array([-0.3 * env.cars.left[0] / 7.5 + env.cars.angle[0], 0.5], np.float32))
    picture = env.render()
    assert picture.shape == (480, 480, 3) and picture.dtype == np.uint8
    colours = {tuple(colour) for colour in picture.reshape(-1, 3).tolist()}
    assert {(196, 40, 44), (232, 170, 44), (84, 88, 94), (120, 160, 96)} <= colours  # own car, parked, road, grass
