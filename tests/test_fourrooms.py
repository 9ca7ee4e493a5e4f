"""FourRooms: the maze, its frames and its games, against MiniGrid and against what can be counted by hand."""

from collections import deque

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from minigrid.core.world_object import Goal, Wall

from cleanrl_thesis import ppo_fourrooms as method

SIZES = (11, 19)


def minigrid_state(env: method.FourRoomsEnv, cell: int, direction: int, goal: int) -> None:
    """Put MiniGrid's own agent and goal there."""
    maze = env.games.maze
    for x, y in maze.cells.tolist():
        env.grid.set(x, y, None)
    env.grid.set(*maze.cells[goal].tolist(), Goal())
    env.agent_pos, env.agent_dir = tuple(maze.cells[cell].tolist()), direction


def shrunk(picture: np.ndarray, side: int) -> np.ndarray:
    """A square picture averaged over areas: each pixel repeated until the new side divides the old one, rows, then columns."""
    times = side // np.gcd(side, len(picture))
    for _ in range(2):
        lines = picture.astype(np.float32).repeat(times, 0)
        picture = lines.reshape(side, -1, *lines.shape[1:]).mean(1).swapaxes(0, 1)
    return picture


@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize("side", [64, 22])
def test_frames_are_minigrids(size, side):
    """Within 2 grey levels of MiniGrid's picture in 2,500 states of each size, the agent beside and on the goal included."""
    env, rng = method.FourRoomsEnv(size, side=side), np.random.default_rng(0)
    env.reset(seed=0)
    cells = len(env.games.maze.cells)
    worst = 0.0
    for i in range(2_500 if side == 64 else 200):
        cell, direction = int(rng.integers(cells)), int(rng.integers(4))
        near = np.flatnonzero(np.abs(env.games.maze.cells - env.games.maze.cells[cell]).max(1) <= 1)
        goal = int(rng.choice(near if i % 2 else cells))
        minigrid_state(env, cell, direction, goal)
        expected = shrunk(env.get_frame(tile_size=32, highlight=False), side)
        frame = env.painter.draw(np.array([4 * cell + direction]), np.array([goal]))[0]
        worst = max(worst, np.abs(frame - expected).max())
    assert worst <= 2


@pytest.mark.parametrize("size", SIZES)
def test_maze_is_minigrids(size):
    """Walls and doors; from each pose each action leads where MiniGrid's step leads."""
    env = method.FourRoomsEnv(size)
    env.reset(seed=0)
    maze, middle = env.games.maze, size // 2
    doors = [(x, y) for x, y in maze.cells.tolist() if middle in (x, y)]
    assert sorted(doors) == sorted(method.DOORS[size]) and len(maze.cells) == (size - 3) ** 2 + 4
    assert isinstance(env.grid.get(middle, middle), Wall)
    for pose in range(len(maze.moves)):
        cell, direction = divmod(pose, 4)
        goal = (cell + len(maze.cells) // 2) % len(maze.cells)
        for action in range(3):
            minigrid_state(env, cell, direction, goal)
            env.step_count = 0
            super(method.FourRoomsEnv, env).step(action)
            after = 4 * maze.cell_at[tuple(env.agent_pos)] + env.agent_dir
            assert after == maze.moves[pose, action]


def test_the_maze_of_19_is_minigrids_own_with_seed_0():
    env = gym.make("MiniGrid-FourRooms-v0").unwrapped
    env.reset(seed=0)
    walls = np.array([[isinstance(env.grid.get(x, y), Wall) for y in range(19)] for x in range(19)])
    assert np.array_equal(walls, method.maze(19).cell_at < 0)


def test_rooms_of_the_small_maze():
    maze = method.maze(11)
    labels = {tuple(cell): room for cell, room in zip(maze.cells.tolist(), maze.rooms.tolist())}
    assert [labels[cell] for cell in ((1, 1), (4, 9), (9, 4), (6, 6))] == [0, 1, 2, 3]
    assert [labels[door] for door in method.DOORS[11]] == [4, 5, 6, 7]
    assert np.bincount(maze.rooms).tolist() == [16] * 4 + [1] * 4


def test_starts():
    """11: another room and at least 3 cells away, neither in a door; 19: any two cells. All directions alike."""
    small, large = method.maze(11), method.maze(19)
    assert len(large.starts) == 4 * 260 * 259
    agents, goals = small.starts[:, 0] // 4, small.starts[:, 1]
    pairs = {(a, g) for a, g in zip(agents.tolist(), goals.tolist())}
    expected = {
        (a, g)
        for a in range(68)
        for g in range(68)
        if small.rooms[a] < 4 and small.rooms[g] < 4 and small.rooms[a] != small.rooms[g]
        if np.abs(small.cells[a] - small.cells[g]).sum() >= 3
    }
    assert pairs == expected and len(small.starts) == 4 * len(expected)


@pytest.mark.parametrize("size", SIZES)
def test_starts_are_drawn_evenly(size):
    games = method.FourRoomsGames(size, 1_000)
    rng = np.random.default_rng(1)
    for game in range(1_000):
        games.seed(game, rng)
    goals, directions = [], []
    for _ in range(100):
        games.begin(np.arange(1_000))
        goals.append(games.goals.copy())
        directions.append(games.poses % 4)
    counts, expected = np.bincount(np.ravel(goals), minlength=len(games.maze.cells)), games.maze.starts[:, 1]
    expected = np.bincount(expected, minlength=len(counts)) * 100_000 / len(expected)
    assert ((counts - expected)[expected > 0] ** 2 / expected[expected > 0]).sum() < 2 * len(counts)  # χ²
    assert (counts[expected == 0] == 0).all()
    assert np.abs(np.bincount(np.ravel(directions)) - 25_000).max() < 700  # 5 deviations


@pytest.mark.parametrize("size", SIZES)
def test_single_and_vectorised_agree(size):
    """Ten games, 1,000 steps each: frames, rewards, ends, rooms and states."""
    seeds = list(range(10))
    vector = gym.make_vec(f"FourRooms{size}-v0", num_envs=10, vectorization_mode="vector_entry_point")
    singles = [gym.make(f"FourRooms{size}-v0", disable_env_checker=True) for _ in seeds]
    obs, info = vector.reset(seed=seeds)
    for i, (env, seed) in enumerate(zip(singles, seeds)):
        first, single_info = env.reset(seed=seed)
        assert np.array_equal(first, obs[i]) and np.array_equal(single_info["state"], info["state"][i])
    rng, ends = np.random.default_rng(2), 0
    for _ in range(1_000):
        actions = rng.choice(3, 10, p=[0.2, 0.2, 0.6])
        obs, rewards, terminated, truncated, info = vector.step(actions)
        for i, env in enumerate(singles):
            last, reward, end, cut_off, single_info = env.step(int(actions[i]))
            assert (reward, end, cut_off) == (rewards[i], terminated[i], truncated[i])
            if end or cut_off:
                ends += 1
                assert info["_final_obs"][i] and np.array_equal(info["final_obs"][i], last)
                assert np.array_equal(info["final_info"]["state"][i], single_info["state"])
                last, single_info = env.reset()
            assert np.array_equal(last, obs[i])
            assert info["room"][i] == single_info["room"]
            assert np.array_equal(info["state"][i], single_info["state"])
    assert ends > 100


def test_rewards_and_time_outs():
    """Straight to the goal three cells ahead: 1 − 0.9 · 3 / 100; and an agent that turns is cut off after 100 steps."""
    env = method.FourRoomsVectorEnv(2)
    env.reset(seed=0)
    maze = env.games.maze
    start = maze.cell_at[1, 1]
    env.games.poses[:], env.games.goals[:] = 4 * start, [maze.cell_at[4, 1], maze.cell_at[9, 9]]
    for step in range(1, 101):
        before = env.games.poses[1]
        _, rewards, terminated, truncated, _ = env.step(np.array([2 if step <= 3 else 0, 0]))
        if step == 3:
            assert terminated.tolist() == [True, False] and rewards.tolist() == [1 - 0.9 * 0.03, 0]
        assert truncated[1] == (step == 100) and not terminated[1] and rewards[1] == 0
        assert step == 100 or env.games.poses[1] == 4 * start + (before - 1) % 4


def brute_force_steps(maze: method.Maze, pose: int, goal: int) -> int:
    """Breadth-first search on coordinates."""
    x, y = maze.cells[pose // 4].tolist()
    queue, seen = deque([(x, y, pose % 4, 0)]), set()
    walls = {tuple(cell) for cell in np.argwhere(maze.cell_at < 0).tolist()}
    while queue:
        x, y, direction, steps = queue.popleft()
        if (x, y) == tuple(maze.cells[goal].tolist()):
            return steps
        if (x, y, direction) in seen:
            continue
        seen.add((x, y, direction))
        queue += [(x, y, (direction + turn) % 4, steps + 1) for turn in (1, -1)]
        ahead = (x + (1, 0, -1, 0)[direction], y + (0, 1, 0, -1)[direction])
        if ahead not in walls:
            queue.append((*ahead, direction, steps + 1))
    raise AssertionError("no way")


@pytest.mark.parametrize("size", SIZES)
def test_fewest_steps(size):
    maze, rng = method.maze(size), np.random.default_rng(3)
    steps = method.fewest_steps(maze)
    for _ in range(50):
        pose, goal = int(rng.integers(len(maze.moves))), int(rng.integers(len(maze.cells)))
        assert steps[pose, goal] == brute_force_steps(maze, pose, goal)


def test_ceiling_of_the_small_maze():
    maze = method.maze(11)
    steps = method.fewest_steps(maze)[maze.starts[:, 0], maze.starts[:, 1]]
    assert (1 - 0.9 * steps / 100).mean() == pytest.approx(0.899, abs=1e-3)


@pytest.mark.parametrize("size", SIZES)
def test_gymnasiums_checker(size):
    check_env(gym.make(f"FourRooms{size}-v0").unwrapped, skip_render_check=True)
    env = gym.make("FourRooms11-v0", render_mode="rgb_array")
    env.reset(seed=0)
    assert env.render().shape == (352, 352, 3)
    assert method.FourRoomsVectorEnv(2, size).observation_space.shape == (2, 64, 64, 3)


def test_area_weights():
    """5 pixels onto 2: the middle one is halved."""
    assert np.allclose(method.area_weights(5, 2), np.array([[1, 1, 0.5, 0, 0], [0, 0, 0.5, 1, 1]]) / 2.5)
