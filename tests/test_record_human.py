"""The recorder of human play: keys, rounds over a websocket, what is on disk, and what the students make of it."""

import asyncio
import itertools
import json
import math
import types
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
from conftest import assert_refused, edit_manifest, rewrite
from fastapi.testclient import TestClient
from starlette.websockets import WebSocketDisconnect

from cleanrl_thesis import distill_hybrid as distill
from cleanrl_thesis import gail_hybrid as gail
from cleanrl_thesis import record_human as record

HOME = "http://127.0.0.1:8000"
APPLE, DRIVING, GOPHER = "AppleGame-v0", "TorcsLike-v0", "ALE/Gopher-v5"


def keys(*held: str, axes: tuple[float, float] = (0.0, 0.0)) -> record.Keys:
    return record.Keys(frozenset(held), axes)


def make_args(env_id: str = APPLE, folder: str = "recordings", **given) -> record.Args:
    return record.complete_args(record.Args(env_id=env_id, player="anna", out=Path(folder), seed=1, **given))


@pytest.fixture
def at_once(monkeypatch):
    """Rounds without waiting, in which a key is pressed every 25 frames."""

    async def tick(clock) -> None:
        await asyncio.sleep(0)

    monkeypatch.setattr(record.Clock, "tick", tick)
    monkeypatch.setattr(record, "COUNTDOWN", 0)
    monkeypatch.setattr(record, "MAX_BEHIND", math.inf)  # pictures come faster than any browser draws


class Browser:
    """The other end of the websocket, which plays rounds."""

    def __init__(self, args: record.Args):
        self.game = record.make_game(args)
        self.recordings = (
            None if args.practice else record.Recordings.open(args.out, record.about_recordings(args, self.game))
        )
        self.client = TestClient(record.make_app(args, self.game, self.recordings), base_url=HOME)

    def connect(self, **headers: str):
        return self.client.websocket_connect("ws://127.0.0.1:8000/play", headers={"origin": HOME, **headers})

    @staticmethod
    def receive(socket) -> dict:
        message = socket.receive()
        if message["type"] == "websocket.close":
            raise WebSocketDisconnect
        return message

    def until(self, socket, kind: str) -> dict:
        while True:
            message = self.receive(socket)
            if "text" in message and json.loads(message["text"])["kind"] == kind:
                return json.loads(message["text"])

    def play(self, socket, order: str, stop_after: int | None = None) -> dict:
        """One round: its last message."""
        self.until(socket, "ready")
        socket.send_json({"order": order})
        for pictures in itertools.count():
            message = self.receive(socket)
            if "text" in message and json.loads(message["text"])["kind"] == "over":
                return json.loads(message["text"])
            if pictures % 25 == 0:
                held = [["right", "up"], ["left"], ["fire", "down"], ["up"], ["right", "left"]][pictures // 25 % 5]
                socket.send_json({"held": held, "axes": [0, 0], "seq": pictures})
            if pictures == stop_after:
                socket.send_json({"order": "stop"})


def test_the_nine_moves_of_the_apple_game():
    game = record.make_game(make_args())
    ways = {(-1, 0): ["left"], (1, 0): ["right"], (0, -1): ["up"], (0, 1): ["down"], (1, 1): ["right", "down"]}
    ways |= {
        (0, 0): ["left", "right", "fire"],
        (-1, -1): ["left", "up"],
        (1, -1): ["right", "up"],
        (-1, 1): ["left", "down"],
    }
    for way, held in ways.items():
        assert tuple(distill.MOVES[:, game.action(keys(*held))]) == way


def test_the_eight_moves_of_gopher():
    game = record.make_game(make_args(GOPHER))
    names = [move.name for move in game.env.moves]
    wanted = {(): "NOOP", ("fire",): "FIRE", ("up",): "UP", ("left",): "LEFT", ("right",): "RIGHT", ("down",): "NOOP"}
    wanted |= {("fire", "up"): "UPFIRE", ("fire", "left"): "LEFTFIRE", ("fire", "right"): "RIGHTFIRE"}
    wanted |= {
        ("up", "left"): "LEFT",
        ("up", "right", "fire"): "RIGHTFIRE",
        ("left", "right"): "NOOP",
        ("down", "fire"): "FIRE",
    }
    assert {held: names[game.action(keys(*held))] for held in wanted} == wanted


def test_hands_on_wheel_and_pedal():
    """Standing still, a key turns the wheel fully in 0.25 s and the pedal in 0.2 s; fast, as far as half of the grip allows."""
    game = record.make_game(make_args(DRIVING))
    game.reset(1)
    actions = np.array([game.action(keys("left", "up")) for _ in range(13)])
    assert np.allclose(actions[:, 0], np.minimum(np.arange(1, 14) / 12.5, 1)) and actions.dtype == np.float32
    assert np.allclose(actions[:, 1], np.minimum(np.arange(1, 14) / 10, 1))
    game.speed = 40.0
    for _ in range(50):
        steering, pedal = game.action(keys("right", "down"))
    assert steering == pytest.approx(-8 * 2.64 / 1_600 / np.radians(21)) and pedal == -1
    game.speed = 0.0
    for _ in range(50):
        action = game.action(keys(axes=(0.5, 0.25)))
    assert np.allclose(action, [-0.5, 0.25])  # a gamepad's axis points to the right, the car's steering to the left


def late_keys(game: record.Driving, obs: np.ndarray, side: float) -> tuple[frozenset, float]:
    """What a careful driver holds, by an old observation; and the side on which it passes parked cars."""
    speed, others = max(obs[21] * 300 / 3.6, 1.0), obs[29:65] * 200
    ahead = others[15:21].min()
    if ahead < 60 and side == 0:
        side = -0.55 if others[10:18].min() <= others[18:26].min() else 0.55
    side = 0 if ahead > 60 and others[8:28].min() > 25 else side
    turn = (obs[0] * np.pi * 1.2 - (obs[20] - side) * 0.25) * 2 * record.WHEELBASE / speed / record.LOCK
    most = min(1.0, record.STEERING_GRIP[0] * record.WHEELBASE / speed**2 / record.LOCK)
    turn = np.clip(turn, -most, most)
    held = {"left": turn > max(game.hands[0] + 0.1 * most, 0), "right": turn < min(game.hands[0] - 0.1 * most, 0)}
    wanted = min(90, 25 + 1.3 * obs[9:12].max() * 200) / 3.6  # by the way that is free ahead
    held |= {"up": speed < wanted, "down": speed > wanted + 3}
    return frozenset(name for name, holds in held.items() if holds), side


def test_the_car_can_be_driven_by_keys_and_late_eyes():
    """A driver who sees everything 160 ms late, and changes keys every 80 ms, comes 600 m far past seven parked cars."""
    game = record.make_game(make_args(DRIVING))
    for seed in range(2):
        seen = [game.reset(seed)] * 9
        columns, side, held, distance = game.begin(seen[0]), 0.0, frozenset(), 0.0
        for step in range(3_000):
            if step % 4 == 0:
                held, side = late_keys(game, seen[-9], side)
            obs, reward, terminated, truncated, info = game.env.step(game.action(record.Keys(held)))
            game.keep(columns, obs, info)
            seen, distance = [*seen[-8:], obs], distance + reward
            if terminated or truncated:
                break
        assert distance > 550


def test_speed_is_read_where_the_car_has_it():
    game = record.make_game(make_args(DRIVING))
    columns = game.begin(game.reset(1))
    for _ in range(100):
        obs, _, _, _, info = game.env.step(game.action(keys("up")))
        game.keep(columns, obs, info)
    assert game.speed == pytest.approx(game.env.unwrapped.cars.velocity[0, 0], rel=1e-5) and game.speed > 5


def test_the_clock_keeps_time_and_does_not_catch_up(monkeypatch):
    """Frames of 20 ms that take 5 ms each to make, and one that takes 100 ms."""
    now, times = [0.0], []

    async def sleep(seconds: float) -> None:
        now[0] += seconds

    async def ticks() -> None:
        clock = record.Clock(50)
        for i in range(12):
            await clock.tick()
            times.append(now[0])
            now[0] += 0.1 if i == 5 else 0.005

    monkeypatch.setattr(record, "time", types.SimpleNamespace(perf_counter=lambda: now[0]))
    monkeypatch.setattr(asyncio, "sleep", sleep)
    asyncio.run(ticks())
    assert np.diff(times) == pytest.approx([0.02] * 5 + [0.1] + [0.02] * 5)


@pytest.mark.parametrize("env_id", [APPLE, DRIVING, GOPHER])
def test_a_round_is_recorded_as_it_was_played(env_id, at_once, tmp_path, monkeypatch, capsys):
    """The file has what a manifest says, gives the same rewards again, and is what the students read."""
    monkeypatch.chdir(tmp_path)
    browser = Browser(make_args(env_id))
    with browser.connect() as socket:
        over = browser.play(socket, "record")
    assert over["recorded"]
    manifest = json.loads(Path("recordings/manifest.json").read_text())
    assert (
        manifest["env_id"] == env_id
        and manifest["player"] == "anna"
        and list(manifest["files"]) == ["episode_00000.npz"]
    )
    with np.load("recordings/episode_00000.npz", allow_pickle=False) as arrays:
        episode = dict(arrays)
    length = len(episode["actions"])
    assert (
        episode["rewards"].sum() == over["score"]
        and episode["t_ns"].shape == (length,)
        and (np.diff(episode["t_ns"]) > 0).all()
    )
    assert episode["terminated"] ^ episode["truncated"] and episode["seed"].shape == ()
    assert len(np.unique(episode["actions"], axis=0)) > 3
    monkeypatch.chdir(tmp_path)
    assert record.cli(["--env-id", env_id, "--player", "anna", "--out", "recordings", "--verify"]) == 0
    assert "the same again" in capsys.readouterr().out
    if env_id == DRIVING:
        read = gail.read_demonstrations(Path("recordings"), gail.Args(env_id=env_id), "--demos-human")
    else:
        read = distill.read_demonstrations(Path("recordings"), env_id, 10)
    assert np.array_equal(read[0]["actions"], episode["actions"]) and len(read[0]["observations"]) == length + 1


def test_students_learn_from_a_recording(at_once, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    browser = Browser(make_args())
    with browser.connect() as socket:
        browser.play(socket, "record")
    flags = ["--alpha", "0", "--demos", "recordings", "--demo-frames", "1500", "--test-frames", "100", "--epochs", "1"]
    assert distill.cli([*flags, "--eval-episodes", "1", "--run-dir", "run"]) == 0
    assert (tmp_path / "run" / "result.json").exists()


def test_practice_and_what_is_broken_off_is_not_kept(at_once, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    browser, paid = Browser(make_args()), []
    step = browser.game.env.step

    def pay(action):
        outcome = step(action)
        paid.append(outcome[1])
        return outcome

    monkeypatch.setattr(browser.game.env, "step", pay)
    with browser.connect() as socket:
        over = browser.play(socket, "practice")
        assert over == {"kind": "over", "score": sum(paid), "recorded": False}
        assert len(paid) == 1800 and over["score"] != 0
        assert browser.play(socket, "record", stop_after=100) == {"kind": "over", "score": None, "recorded": False}
        browser.until(socket, "ready")
        socket.send_json({"order": "record"})
        browser.until(socket, "go")
    assert not list(tmp_path.iterdir())
    with browser.connect() as socket:
        assert browser.play(socket, "record")["recorded"]
    assert sorted(path.name for path in (tmp_path / "recordings").iterdir()) == ["episode_00000.npz", "manifest.json"]


@pytest.mark.parametrize("drawn, kept", [(range(0, 1900, 8), True), (range(0, 600, 8), False), ([], False)])
def test_a_round_that_nobody_sees_is_not_kept(drawn, kept, tmp_path, monkeypatch):
    """Pictures are drawn to the end, for ten seconds or never: 30 pictures, half a second, later the round is over."""
    monkeypatch.setattr(record, "COUNTDOWN", 0)
    browser = Browser(make_args(folder=tmp_path / "anna"))

    async def tick(clock) -> None:
        await asyncio.sleep(0)
        player.drawn = max((number for number in drawn if number <= player.sent), default=0)

    async def send(content) -> None:
        pass

    monkeypatch.setattr(record.Clock, "tick", tick)
    player = record.Player(types.SimpleNamespace(send_bytes=send, send_json=send))
    episode = asyncio.run(record.play_episode(browser.game, player, 1))
    assert isinstance(episode, dict) == kept and player.sent == (1801 if kept else max(drawn, default=0) + 31)


def test_only_practice(at_once, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    browser = Browser(record.complete_args(record.Args(practice=True)))
    with browser.connect() as socket:
        assert browser.until(socket, "ready")["records"] is False
        socket.send_json({"order": "record"})
        assert browser.until(socket, "over")["recorded"] is False
    assert not list(tmp_path.iterdir())


def test_one_player_at_a_time(at_once):
    browser = Browser(make_args())
    with browser.connect() as first:
        browser.until(first, "ready")
        with browser.connect() as second:
            assert second.receive_json() == {"kind": "busy"}
    with browser.connect() as third:
        browser.until(third, "ready")


@pytest.mark.parametrize(
    "headers", [{"origin": "http://evil.example"}, {"host": "evil.example", "origin": "http://evil.example"}]
)
def test_pages_of_other_sites_are_refused(headers):
    browser = Browser(make_args())
    with pytest.raises(WebSocketDisconnect), browser.connect(**headers) as socket:
        socket.receive()
    assert browser.client.get("/", headers={"host": "evil.example"}).status_code == 421
    assert browser.client.get("/").status_code == 200


@pytest.mark.parametrize(
    "message",
    [
        "no json",
        "[]",
        '{"held": ["left"]}',
        '{"held": 3, "axes": [0, 0], "seq": 1}',
        '{"held": [], "axes": [NaN, 0], "seq": 1}',
        '{"held": [], "axes": [0, 0], "seq": 1e999}',
    ],
)
def test_what_is_not_understood_ends_the_connection(message, at_once):
    browser = Browser(make_args())
    with browser.connect() as socket:
        browser.until(socket, "ready")
        socket.send_text(message)
        with pytest.raises(WebSocketDisconnect):
            browser.until(socket, "never")
    with browser.connect() as socket:
        browser.until(socket, "ready")


def test_the_page_tells_its_rules_and_holds_no_foreign_address():
    page = Browser(make_args(GOPHER)).client.get("/")
    assert "three carrots" in page.text and "http://" not in page.text.replace("http://www.w3.org", "")
    assert "script-src 'nonce-" in page.headers["content-security-policy"] and "{{" not in page.text
    assert page.headers["content-security-policy"].split("script-src 'nonce-")[1].split("'")[0] in page.text


def add(recordings: record.Recordings, seed: int) -> None:
    """An episode in which nothing is pressed for 10 frames."""
    env = gym.make(APPLE)
    observations = [env.reset(seed=seed)[0], *(env.step(4)[0] for _ in range(10))]
    columns = {"observations": np.array(observations), "actions": np.full(10, 4), "rewards": np.zeros(10)}
    times = {"t_ns": np.arange(10), "terminated": np.array(False), "truncated": np.array(True), "seed": np.array(seed)}
    recordings.add({**columns, **times})


def test_recordings_go_on_where_they_stopped(tmp_path, monkeypatch):
    """A file that was written just before a crash, and is not in the manifest yet, is taken in."""
    args = make_args(folder=tmp_path / "anna")
    about = record.about_recordings(args, record.make_game(args))
    recordings = record.Recordings.open(args.out, about)
    for seed in (1, 2, 3):
        add(recordings, seed)
    edit_manifest(args.out, lambda manifest: manifest["files"].pop("episode_00002.npz"))
    again = record.Recordings.open(args.out, about)
    assert again.files == recordings.files and again.scores == [0.0] * 3 and again.torn and not recordings.torn
    monkeypatch.setattr(record, "serve", lambda *_: None)
    assert record.cli(["--player", "anna", "--out", str(args.out), "--port", "0"]) == 0
    assert json.loads((args.out / "manifest.json").read_text())["files"] == recordings.files
    add(again, 4)
    assert sorted(json.loads((args.out / "manifest.json").read_text())["files"]) == [
        f"episode_0000{i}.npz" for i in range(4)
    ]


def test_rounds_that_are_not_kept_are_counted(at_once, tmp_path):
    """Those that were to be recorded: a score tells more beside them."""
    args = make_args(folder=tmp_path / "anna")
    browser = Browser(args)
    with browser.connect() as socket:
        browser.play(socket, "record", stop_after=5)
        browser.play(socket, "practice", stop_after=5)
        browser.play(socket, "record")
        browser.play(socket, "record", stop_after=5)
    assert json.loads((args.out / "manifest.json").read_text())["rounds_not_kept"] == 2
    again = record.Recordings.open(args.out, record.about_recordings(args, browser.game))
    assert again.lost == 2 and len(again.files) == 1


@pytest.mark.parametrize("slowness, kept", [(1.05, True), (1.2, False)])
def test_a_round_that_was_too_slow_is_not_kept(slowness, kept, at_once, tmp_path, monkeypatch):
    """The clock of the machine goes faster than the game's: who plays has more time."""
    frames = itertools.count()
    monkeypatch.setattr(record.time, "perf_counter_ns", lambda: int(next(frames) * slowness * 1e9 / 60))
    browser = Browser(make_args(folder=tmp_path / "anna"))
    with browser.connect() as socket:
        told = browser.play(socket, "record")
    assert told["recorded"] == kept and told.get("trouble") == (None if kept else record.SLOW)
    assert len(list(tmp_path.glob("anna/*.npz"))) == kept


def test_a_key_pressed_and_let_go_between_two_frames_acts_for_one():
    player = record.Player(None)
    for held in (["fire"], [], ["left"]):
        player.understand({"held": held, "axes": [0, 0], "seq": 1})
    assert player.take_keys().held == {"fire", "left"} and player.take_keys().held == {"left"}
    player.understand({"held": [], "axes": [0, 0], "seq": 2})
    assert player.take_keys().held == set()


def test_keys_of_before_a_round_do_not_act_in_it(at_once, tmp_path):
    browser = Browser(make_args(folder=tmp_path / "anna"))
    with browser.connect() as socket:
        for held in (["right"], []):
            socket.send_json({"held": held, "axes": [0, 0], "seq": 1})
        browser.until(socket, "ready")
        socket.send_json({"order": "record"})
        browser.until(socket, "over")
    with np.load(tmp_path / "anna" / "episode_00000.npz") as arrays:
        assert (arrays["actions"] == 4).all()


def test_a_disk_that_is_full_loses_no_round_that_is_kept(at_once, tmp_path, monkeypatch):
    """The episode cannot be written, then it can, and only the manifest cannot."""
    full, write = ["episode"], record.write_whole

    def write_or_fail(path: Path, content: bytes) -> None:
        if path.name.startswith(full[0]):
            raise OSError(28, "No space left on device")
        write(path, content)

    monkeypatch.setattr(record, "write_whole", write_or_fail)
    args = make_args(folder=tmp_path / "anna")
    browser, told = Browser(args), []
    with browser.connect() as socket:
        for full[0] in ("episode", "none", "manifest"):
            told.append(browser.play(socket, "record")["recorded"])
    kept = record.Recordings.open(args.out, record.about_recordings(args, record.make_game(args)))
    assert told == [False, True, True] and len(kept.files) == 2


def test_a_folder_that_is_added_to_gets_other_rounds(at_once, tmp_path):
    for _ in range(2):
        browser = Browser(make_args(folder=tmp_path / "anna"))
        with browser.connect() as socket:
            browser.play(socket, "record")
    seeds = [int(np.load(path)["seed"]) for path in sorted((tmp_path / "anna").glob("*.npz"))]
    assert len(seeds) == 2 and seeds[0] != seeds[1]


def test_practice_shows_no_round_that_is_recorded(at_once, tmp_path, monkeypatch):
    played, play_episode = [], record.play_episode
    monkeypatch.setattr(
        record, "play_episode", lambda game, player, seed: played.append(seed) or play_episode(game, player, seed)
    )
    for given in ({"practice": True}, {}):
        browser = Browser(make_args(folder=tmp_path / "anna", **given))
        with browser.connect() as socket:
            browser.play(socket, "practice" if given else "record", stop_after=3)
    assert len(set(played)) == 2


def test_recordings_of_another_emulator_are_not_added_to(tmp_path, monkeypatch, capsys):
    """Their manifest names one version; it is refused before anything is written."""
    monkeypatch.setattr(record, "serve", lambda *_: None)
    (tmp_path / "anna").mkdir()
    about = record.about_recordings(args := make_args("ALE/Gopher-v5", tmp_path / "anna"), record.make_game(args))
    record.write_json(args.out / "manifest.json", {"version": 1, **about, "ale_py": "0.0.1", "files": {}})
    flags = ["--env-id", args.env_id, "--player", "anna", "--out", args.out, "--port", 0]
    assert_refused(record, capsys, flags, ["--out", "was recorded with ale-py 0.0.1", about["ale_py"]])
    assert json.loads((args.out / "manifest.json").read_text())["ale_py"] == "0.0.1"


@pytest.mark.parametrize(
    "flags, damage, words",
    [
        (["--player", "bob"], None, ["--player", "anna", "bob"]),
        (["--env-id", DRIVING], None, ["--env-id", APPLE, DRIVING]),
        ([], lambda f: (f / "episode_00000.npz").write_bytes(b"x"), ["episode_00000.npz", "SHA-256"]),
        ([], lambda f: (f / "episode_00000.npz").unlink(), ["lacks episode_00000.npz"]),
        ([], lambda f: (f / "manifest.json").write_text("{"), ["manifest.json"]),
        ([], lambda f: (f / "manifest.json").unlink(), ["other files"]),
    ],
    ids=["player", "game", "changed", "missing", "manifest", "no manifest"],
)
def test_a_folder_that_does_not_fit_is_refused(flags, damage, words, tmp_path, capsys):
    args = make_args(folder=tmp_path / "anna")
    add(record.Recordings.open(args.out, record.about_recordings(args, record.make_game(args))), 1)
    if damage:
        damage(args.out)
    assert_refused(record, capsys, ["--player", "anna", "--out", args.out, *flags, "--port", 0], words)


def test_verify_reads_who_played(tmp_path, capsys):
    args = make_args(folder=tmp_path / "anna")
    add(record.Recordings.open(args.out, record.about_recordings(args, record.make_game(args))), 1)
    assert record.cli(["--out", str(args.out), "--verify"]) == 0
    assert "the same again" in capsys.readouterr().out
    assert_refused(record, capsys, ["--out", tmp_path, "--verify"], ["--out", "no recordings"])


@pytest.mark.parametrize(
    "env_id, options",
    [(APPLE, None), (DRIVING, {"track": "hills", "brake": False}), (GOPHER, {"frame_skip": 4, "noop_max": 0})],
)
def test_other_players_recordings_are_played_as_they_were_recorded(env_id, options, tmp_path, capsys):
    """Those of agents and of synthetic humans, which say their games' options if there are any."""
    env, rng = record.make_game(record.Args(env_id=env_id), options).env, np.random.default_rng(1)
    env.reset(seed=5)
    driving = env_id == DRIVING
    actions = np.float32([[0.01, 1]] * 150) if driving else rng.integers(env.action_space.n, size=20).repeat(20)
    episode = {"actions": actions, "rewards": np.array([env.step(action)[1] for action in actions])}
    about = {"env_id": env_id, "player": "synthetic human", **({} if options is None else {"options": options})}
    record.Recordings(tmp_path / "demos", about).add({**episode, "seed": np.array(5)})
    assert np.any(episode["rewards"] != 0)
    assert record.cli(["--env-id", env_id, "--out", str(tmp_path / "demos"), "--verify"]) == 0
    assert "the same again" in capsys.readouterr().out


def test_options_of_another_game_are_refused(tmp_path, capsys):
    record.Recordings(tmp_path, {"env_id": DRIVING, "player": "anna", "options": {"skip": 4}}).write_manifest()
    assert_refused(record, capsys, ["--env-id", DRIVING, "--out", tmp_path, "--verify"], ["--out", "skip", DRIVING])


def test_verify_finds_other_rewards(tmp_path, capsys):
    args = make_args(folder=tmp_path / "anna")
    add(record.Recordings.open(args.out, record.about_recordings(args, record.make_game(args))), 1)
    rewrite(args.out, lambda arrays: {**arrays, "rewards": np.ones(10)})
    assert record.cli(["--player", "anna", "--out", str(args.out), "--verify"]) == 1
    assert "differs" in capsys.readouterr().out


def test_export_to_minari(tmp_path, monkeypatch, capsys):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    args = make_args(folder=tmp_path / "anna")
    recordings = record.Recordings.open(args.out, record.about_recordings(args, record.make_game(args)))
    for seed in (1, 2):
        add(recordings, seed)
    flags = ["--player", "anna", "--out", str(args.out), "--export-minari", "apple/anna-v0"]
    assert record.cli(flags) == 0
    dataset = minari.load_dataset("apple/anna-v0")
    episodes = list(dataset.iterate_episodes())
    assert [len(episode.actions) for episode in episodes] == [10, 10] and episodes[0].truncations[-1]
    with np.load(args.out / "episode_00000.npz") as arrays:
        assert np.array_equal(episodes[0].observations, arrays["observations"])
    capsys.readouterr()
    assert_refused(record, capsys, flags, ["--export-minari", "exists"])


def test_frames_of_gopher_go_to_minari_without_loss(at_once, tmp_path, monkeypatch):
    import minari

    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path / "minari"))
    browser = Browser(make_args(GOPHER, tmp_path / "anna"))
    with browser.connect() as socket:
        browser.play(socket, "record")
    flags = [
        "--env-id",
        GOPHER,
        "--player",
        "anna",
        "--out",
        str(tmp_path / "anna"),
        "--export-minari",
        "gopher/anna-v0",
    ]
    assert record.cli(flags) == 0
    episode = next(minari.load_dataset("gopher/anna-v0").iterate_episodes())
    with np.load(tmp_path / "anna" / "episode_00000.npz", allow_pickle=False) as arrays:
        recorded = dict(arrays)
    observations = record.replay(record.make_game(make_args(GOPHER)), recorded)
    assert episode.observations.dtype == np.uint8 and np.array_equal(episode.observations, np.stack(observations))
    assert np.array_equal(episode.actions, recorded["actions"]) and episode.terminations[-1] == recorded["terminated"]


@pytest.mark.parametrize(
    "flags, words",
    [
        ([], ["--player", "needed"]),
        (["--player", "../anna"], ["--player", "../anna", "letters"]),
        (["--player", "anna", "--env-id", "CartPole-v1"], ["--env-id", "CartPole-v1", "AppleGame-v0"]),
        (["--player", "anna", "--env-id", "ALE/NoSuchGame-v5"], ["--env-id", "NoSuchGame"]),
        (["--player", "anna", "--env-id", DRIVING, "--track-name", "monza"], ["--track-name", "monza", "meadow"]),
        (["--player", "anna", "--port", 70_000], ["--port", "70000", "65535"]),
        (["--player", "anna", "--host", "300.1.1.1"], ["--host", "300.1.1.1"]),
        (["--player", "anna", "--out", "/proc/nowhere", "--port", 0], ["--out", "/proc/nowhere", "cannot be written"]),
        (["--player", "anna", "--seed", -1], ["--seed", "-1"]),
        (
            ["--player", "anna", "--verify", "--export-minari", "a-v0"],
            ["--verify", "--export-minari", "exclude each other"],
        ),
        (["--player", "anna", "--export-minari", "anna"], ["--export-minari", "anna", "apple/anna-v0"]),
        (["--player", "anna", "--verify"], ["--out", "recordings/anna", "no recordings"]),
        (["--player", "anna", "--no-such-flag"], ["--no-such-flag"]),
    ],
)
def test_a_wrong_value_is_one_line_and_creates_nothing(flags, words, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert_refused(record, capsys, flags, words)
    assert not list(tmp_path.iterdir())
