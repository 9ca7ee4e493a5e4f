"""A person plays in the browser, and each episode is recorded (thesis chapter 2: the human expert).

    python cleanrl_thesis/record_human.py --player anna                                  # the Apple game
    python cleanrl_thesis/record_human.py --env-id ALE/Gopher-v5 --player anna --out recordings/anna_gopher
    python cleanrl_thesis/record_human.py --env-id TorcsLike-v0 --player anna --out recordings/anna_driving
    python cleanrl_thesis/record_human.py --practice                                     # to try a game, without recording
    python cleanrl_thesis/record_human.py --player anna --verify                         # play the recordings again
    python cleanrl_thesis/record_human.py --player anna --export-minari apple/anna-v0

Open the address that it prints. Rules come first, then rounds for practice, then rounds that are recorded into `--out`, in the
format that `distill_hybrid.py --demos` and `gail_hybrid.py --demos-human` read. Sent again, it adds to the folder.

| what | how |
|---|---|
| clock | this process': 60 frames a second, the driving task 50; the browser sends which keys are held, and shows pictures |
| action | the keys that are held when the frame begins; Atari's games are played frame by frame, where agents act for 4 frames |
| driving by keys | steering turns within 0.25 s as far as half of the grip allows at that speed, pedals in 0.2 s; recorded is what the car was given |
| an episode | is on disk before the next one begins; one that is broken off, whose page loses focus or draws nothing for a second, is not kept |
| `t_ns` | when each action was taken, in nanoseconds from the episode's beginning |

Each file follows from its seed and actions: `--verify` plays all of them again and compares every reward.
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "ale-py>=0.11",
#     "fastapi>=0.115",
#     "gymnasium>=1.2",
#     "matplotlib>=3.9",
#     "numpy>=2.0",
#     "opencv-python-headless>=4.10",
#     "pillow>=10.1",
#     "safetensors>=0.4",
#     "tensorboard>=2.17",
#     "torch>=2.7",
#     "tqdm>=4.66",
#     "tyro>=0.9",
#     "uvicorn>=0.30",
#     "websockets>=13.0",
# ]
# ///
import asyncio
import contextlib
import fcntl
import hashlib
import importlib.util
import io
import json
import math
import os
import re
import secrets
import signal
import socket
import sys
import tempfile
import time
import warnings
import zipfile
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import ModuleType

import cv2
import gymnasium as gym
import numpy as np
import tyro


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    env_id: str = "AppleGame-v0"
    """the game: AppleGame-v0, TorcsLike-v0, ALE/Gopher-v5 or another ALE/*-v5"""
    player: str | None = None
    """who plays, as the recordings will say: letters, digits, - and _"""
    out: Path | None = None
    """folder of the recordings; default: recordings/{player}"""
    practice: bool = False
    """record nothing: for people who get to know a game"""
    verify: bool = False
    """play every recorded episode again and compare its rewards, instead of recording"""
    export_minari: str | None = None
    """write the recordings as the Minari dataset of this id, instead of recording (`pip install "minari[hdf5]"`)"""
    seed: int | None = None
    """seed from which, with the number of recordings in the folder, the seeds of the episodes follow; default: random"""
    track_name: str = "meadow"
    """road of the driving task: meadow, speedway, hills or city"""
    brake: bool = True
    """whether a negative pedal brakes in the driving task"""
    host: str = "127.0.0.1"
    """address to listen on; 0.0.0.0 lets every machine of the network in"""
    port: int = 8000
    """port to listen on; 0 takes a free one"""


class UsageError(Exception):
    """A user's mistake, told in one line; the exit code is 2."""


def parse_args(argv: list[str] | None = None) -> Args:
    """Read the command line. Raises UsageError with one line where tyro prints a box."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(Args, args=argv, description=__doc__.split("\n\n")[0])
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│ ") for line in complaint.getvalue().splitlines()]
        message = " ".join(line for line in lines[1:] if line and line[0] not in "─╰").split("For full helptext")[0]
        raise UsageError(message.split("Argument helptext")[0].strip()) from None


def first_line(error: Exception) -> str:
    return (str(error) or repr(error)).splitlines()[0]


def require(holds: bool, flag: str, value: object, allowed: str) -> None:
    """Raise UsageError naming the flag, its value and what is allowed, unless `holds`."""
    if not holds:
        raise UsageError(f"{flag} {value}".strip() + f": {allowed}")


def read_about(folder: Path) -> tuple[str, dict]:
    """Who is recorded in a folder, and with which options of the game. Raises UsageError."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        return str(manifest["player"]), dict(manifest.get("options") or {})
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"--out {folder}: holds no recordings, it has no readable manifest.json") from None


def complete_args(args: Args) -> Args:
    """Fill in the folder, and check all. Raises UsageError."""
    reads = args.verify or args.export_minari is not None
    if reads and args.player is None and args.out is not None:
        args.player = read_about(args.out)[0]
    elif not args.practice:
        require(args.player is not None, "--player", "", "is needed: who plays? (--practice records nothing)")
        named = re.fullmatch(r"[\w-]{1,40}", args.player) is not None
        require(named, "--player", args.player, "must be 1 to 40 letters, digits, - or _")
    args.out = args.out or Path("recordings") / str(args.player)
    require(0 <= args.port < 2**16, "--port", args.port, "must be between 0 and 65535")
    require(args.seed is None or 0 <= args.seed < 2**32, "--seed", args.seed, "must be between 0 and 4294967295")
    modes = {"--practice": args.practice, "--verify": args.verify, "--export-minari": args.export_minari is not None}
    given = [flag for flag, holds in modes.items() if holds]
    require(len(given) <= 1, " ".join(given), "", "exclude each other")
    if args.export_minari is not None:
        named = re.fullmatch(r"([\w-]+/)*[\w-]+-v\d+", args.export_minari) is not None
        require(named, "--export-minari", args.export_minari, "must be a Minari id as apple/anna-v0")
        needs_minari = 'needs Minari: pip install "minari[hdf5]"'
        there = all(importlib.util.find_spec(name) is not None for name in ("minari", "h5py"))
        require(there, "--export-minari", "", needs_minari)
    elif not args.verify:
        for name in ("fastapi", "uvicorn", "websockets"):
            allowed = "are needed for the page: pip install fastapi uvicorn websockets"
            require(importlib.util.find_spec(name) is not None, "fastapi, uvicorn and websockets", "", allowed)
    return args


# ---------------------------------------------------------------------------------------------------------------------
# Games
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Keys:
    """What the player holds: names of keys (left, right, up, down, fire), and a gamepad's steering and pedal."""

    held: frozenset[str] = frozenset()
    axes: tuple[float, float] = (0.0, 0.0)
    seq: int = 0  # number of the browser's last message

    def along(self, low: str, high: str) -> int:
        """-1, 0 or 1 by two opposite keys."""
        return (high in self.held) - (low in self.held)


def load_method(name: str) -> ModuleType:
    """The method file of that name beside this one, which holds the game."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


class Game:
    """What the recorder asks of a game. Episodes follow from the seed of the reset and the actions."""

    rules: str
    keys: str
    unit: str
    action_dtype: type = np.int64
    options: dict = {}
    env: gym.Env

    def reset(self, seed: int) -> np.ndarray:
        return self.env.reset(seed=seed)[0]

    def action(self, keys: Keys):
        """The action for the keys that are held."""
        raise NotImplementedError

    def begin(self, obs: np.ndarray) -> dict[str, list]:
        """The columns of a new recording."""
        return {"observations": [obs]}

    def keep(self, columns: dict[str, list], obs: np.ndarray, info: dict) -> None:
        """Add what a step gave to the columns."""
        columns["observations"].append(obs)

    def draw(self) -> np.ndarray:
        """What the player sees, (H, W, 3) uint8."""
        return self.env.unwrapped.render()

    def picture(self) -> bytes:
        """The same, packed for the browser."""
        image = cv2.cvtColor(self.draw(), cv2.COLOR_RGB2BGR)
        return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, 92])[1].tobytes()


class Apple(Game):
    """AppleGame-v0: nine actions."""

    rules = (
        "You are the blue disc. Touch the red apple to take it: each one counts. An apple that nobody takes is gone after a "
        "second and a half, and another one appears. A round lasts 30 seconds."
    )
    keys, unit = "Arrow keys or W A S D move; two at once move diagonally.", "apples"

    def __init__(self, args: Args, recorded: dict):
        load_method("dqn_apple")
        self.env = gym.make("AppleGame-v0", disable_env_checker=True)
        self.fps = self.env.metadata["render_fps"]

    def action(self, keys: Keys) -> int:
        return (keys.along("up", "down") + 1) * 3 + keys.along("left", "right") + 1

    def draw(self) -> np.ndarray:
        return self.env.unwrapped.games.draw(0, side=360)  # smaller than videos: it is on the way from key to picture


class Atari(Game):
    """A game of ale-py, frame by frame: an action for each, where the agents hold theirs for 4."""

    rules = "Play as well as you can. The round ends when the game does."
    keys, unit = "Arrow keys or W A S D move; the space bar is the button.", "points"

    def __init__(self, args: Args, recorded: dict):
        method = load_method("dqn_gopher")
        self.options = {"frame_skip": 1, "noop_max": 30} | recorded
        try:
            self.env = method.make_atari(args.env_id, frame_stack=1, **self.options)
        except method.UsageError as error:
            raise UsageError(str(error)) from None
        self.fps = method.ATARI_FPS / self.options["frame_skip"]
        self.numbers = {move.name: i for i, move in enumerate(self.env.moves)}
        if args.env_id == "ALE/Gopher-v5":
            self.rules = (
                "Keep the gopher from the three carrots. It digs holes up to the garden: stand over a hole and press the "
                "button to fill it, a shovel at a time. When the gopher comes out, hit it with the button. Three carrots "
                "stolen, and the round is over. Press the button to begin, and again after each carrot."
            )

    def action(self, keys: Keys) -> int:
        vertical = ("UP", "", "DOWN")[keys.along("up", "down") + 1]
        horizontal = ("LEFT", "", "RIGHT")[keys.along("left", "right") + 1]
        fire = "FIRE" if "fire" in keys.held else ""
        names = vertical + horizontal + fire, horizontal + fire, vertical + fire, fire, horizontal, vertical, "NOOP"
        return next(self.numbers[name] for name in names if name in self.numbers)

    def begin(self, obs: np.ndarray) -> dict[str, list]:
        self.emulator_state = self.env.emulator.cloneState(include_rng=True).__getstate__()
        return {"lives": []}

    def keep(self, columns: dict[str, list], obs: np.ndarray, info: dict) -> None:
        columns["lives"].append(info["lives"])

    def picture(self) -> bytes:
        image = cv2.cvtColor(self.draw(), cv2.COLOR_RGB2BGR)
        return cv2.imencode(".png", image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes()


STEERING_GRIP = np.array([8.0, 14.0])  # m/s² that keys, and a gamepad, may ask of the tyres, which hold 15.7
WHEELBASE, LOCK = 2.64, math.radians(21)  # m, and the car's greatest steering angle
TURN_TIME, PEDAL_TIME = 0.25, 0.2  # s from the middle to the end
SPEED_INDEX, SPEED_SCALE = 21, 300 / 3.6  # of the speed in the observation, in m/s


class Driving(Game):
    """TorcsLike-v0: keys or a gamepad move a steering wheel and a pedal, which the car is given."""

    rules = (
        "Drive as far as you can in 60 seconds. Hold the gas when the count ends: who stands still for a second is out. Stay on "
        "the road and away from the parked cars: the round ends where you leave the road or touch a car."
    )
    keys = "Left and right arrow, or A and D, steer; up or W is the gas, down or S the brake. A gamepad works too."
    unit, action_dtype = "m", np.float32

    def __init__(self, args: Args, recorded: dict):
        self.method = load_method("ddpg_torcs_like")
        self.options = recorded or {"track": args.track_name, "reward": "distance", "brake": args.brake}
        try:
            self.env = gym.make("TorcsLike-v0", disable_env_checker=True, **self.options)
        except ValueError as error:
            raise UsageError(f"--track-name {args.track_name}: {first_line(error)}") from None
        self.fps = self.env.metadata["render_fps"]

    def reset(self, seed: int) -> np.ndarray:
        self.hands, self.speed = np.zeros(2), 0.0
        return super().reset(seed)

    def action(self, keys: Keys) -> np.ndarray:
        """Move the hands towards where the keys, or the gamepad, ask for."""
        by_keys, by_pad = np.minimum(STEERING_GRIP * WHEELBASE / max(self.speed, 1.0) ** 2 / LOCK, 1)
        steering = keys.along("right", "left") * by_keys - keys.axes[0] * by_pad
        asked = np.clip([steering, keys.along("down", "up") + keys.axes[1]], [-by_pad, -1], [by_pad, 1])
        reach = np.array([by_keys / TURN_TIME, 1 / PEDAL_TIME]) / self.fps
        self.hands[0] = np.clip(self.hands[0], -by_pad, by_pad)
        self.hands += np.clip(asked - self.hands, -reach, reach)
        return self.hands.astype(np.float32)

    def draw(self) -> np.ndarray:
        return self.method.draw_car(self.env.unwrapped.cars, 0, side=360)

    def keep(self, columns: dict[str, list], obs: np.ndarray, info: dict) -> None:
        super().keep(columns, obs, info)
        self.speed = float(obs[SPEED_INDEX]) * SPEED_SCALE


def make_game(args: Args, recorded: dict | None = None) -> Game:
    """The game of `--env-id`, to be played again with the options that were recorded. Raises UsageError."""
    games = {"AppleGame-v0": Apple, "TorcsLike-v0": Driving}
    atari = args.env_id.startswith("ALE/")
    require(atari or args.env_id in games, "--env-id", args.env_id, f"must be {', '.join(games)} or ALE/*-v5")
    try:
        return (Atari if atari else games[args.env_id])(args, recorded or {})
    except TypeError as error:
        raise UsageError(f"--out {args.out}: options {recorded} are none of {args.env_id}: {error}") from None


# ---------------------------------------------------------------------------------------------------------------------
# Recordings
# ---------------------------------------------------------------------------------------------------------------------
HUMAN_STREAM = 1_000_002
PRACTICE_STREAM = 1_000_005  # or those who practise would know the rounds that are recorded


def write_whole(path: Path, content: bytes, keep_old_as: str | None = None) -> None:
    """Write a file so that after a crash it is there whole or not at all; on request keep the one that it replaces."""
    temporary = path.with_name(path.name + ".tmp")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    if keep_old_as is not None and path.exists():
        os.replace(path, path.with_name(keep_old_as))
    os.replace(temporary, path)
    folder = os.open(path.parent, os.O_RDONLY)
    os.fsync(folder)
    os.close(folder)


def write_json(path: Path, content: dict) -> None:
    write_whole(path, (json.dumps(content, indent=2) + "\n").encode())


@dataclass
class Recordings:
    """A folder of episodes, `episode_*.npz`, with a manifest of their checksums."""

    folder: Path
    about: dict
    files: dict[str, str] = field(default_factory=dict)
    scores: list[float] = field(default_factory=list)
    torn: bool = False  # whether a crash came between an episode and the manifest
    saved: dict = field(default_factory=dict)  # the manifest as it was
    lost: int = 0  # recorded rounds that were broken off, or could not be kept

    @classmethod
    def open(cls, folder: Path, about: dict) -> "Recordings":
        """The recordings that are there already, none where there is no folder. Raises UsageError."""
        recordings = cls(folder, about)
        if not folder.exists():
            return recordings
        require(folder.is_dir(), "--out", folder, "is not a folder")
        paths = sorted(path for path in folder.glob("episode_*.npz") if re.fullmatch(r"episode_\d{5}\.npz", path.name))
        manifest = folder / "manifest.json"
        if not manifest.exists():
            only_torn = all(path.suffix == ".tmp" for path in folder.iterdir())
            require(only_torn, "--out", folder, "holds other files than recordings")
            return recordings
        try:
            saved = json.loads(manifest.read_text())
            files, recordings.lost = dict(saved["files"]), int(saved.get("rounds_not_kept", 0))
        except (OSError, ValueError, KeyError, TypeError):
            raise UsageError(f"--out {folder}: its manifest.json cannot be read") from None
        for name, flag in (("env_id", "--env-id"), ("player", "--player"), ("options", "--track-name or --brake")):
            allowed = f"has recordings of {flag} {saved.get(name)}, now it is {about[name]}"
            require((saved.get(name) or {}) == about[name], "--out", folder, allowed)
        for path in paths:  # a file that is not in the manifest was written just before a crash
            content = path.read_bytes()
            same = files.get(path.name, checksum := hashlib.sha256(content).hexdigest()) == checksum
            require(same, "--out", path, "its SHA-256 is not the manifest's, the file was changed or damaged")
            recordings.files[path.name] = checksum
            recordings.scores.append(float(read_arrays(path)["rewards"].sum()))
        missing = sorted(files.keys() - recordings.files.keys())
        require(not missing, "--out", folder, f"lacks {', '.join(missing)}, which its manifest names")
        recordings.torn, recordings.saved = recordings.files.keys() != files.keys(), saved
        return recordings

    def check_emulator(self) -> None:
        """Raise UsageError where episodes of another emulator are there: the manifest names one."""
        was, now = self.saved.get("ale_py"), self.about.get("ale_py")
        allowed = f"was recorded with ale-py {was}, here is {now}; choose another folder"
        require(was in (None, now), "--out", self.folder, allowed)

    def write_manifest(self) -> None:
        about = {"version": 1, **self.about, "rounds_not_kept": self.lost}
        write_json(self.folder / "manifest.json", {**about, "files": self.files})

    def note_lost(self) -> None:
        """Count a round that is not kept, without which the scores of the kept ones would look like those of all."""
        self.lost += 1
        if self.files:
            with contextlib.suppress(OSError):  # the next round's manifest has it
                self.write_manifest()

    def add(self, episode: dict[str, np.ndarray]) -> None:
        """Write an episode, and then the manifest."""
        self.folder.mkdir(parents=True, exist_ok=True)
        if not self.files:
            self.write_manifest()
        content = io.BytesIO()
        np.savez(content, **episode)
        name = f"episode_{max((int(name[8:13]) for name in self.files), default=-1) + 1:05d}.npz"
        write_whole(self.folder / name, content.getvalue())
        self.files[name] = hashlib.sha256(content.getvalue()).hexdigest()
        self.scores.append(float(episode["rewards"].sum()))
        self.write_manifest()


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """The arrays of a recorded episode. Raises UsageError."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            needed = {name: arrays[name] for name in ("actions", "rewards", "seed")}  # KeyError where one is missing
            return {**arrays, **needed}
    except (KeyError, ValueError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise UsageError(f"--out {path}: no recording: {first_line(error)}") from None


def about_recordings(args: Args, game: Game) -> dict:
    """What a manifest says besides the files."""
    about = {"env_id": args.env_id, "player": args.player, "mode": "human", "fps": game.fps, "options": game.options}
    return {**about, **({"ale_py": load_method("dqn_gopher").ale_py.__version__} if isinstance(game, Atari) else {})}


def replay(game: Game, episode: dict[str, np.ndarray]) -> list[np.ndarray] | None:
    """Play an episode again: its observations, (T + 1) of them, or None where rewards differ."""
    observations = [game.reset(int(episode["seed"]))]
    for action, reward in zip(episode["actions"], episode["rewards"].tolist()):
        obs, again, _, _, _ = game.env.step(action)
        if again != reward:
            return None
        observations.append(obs)
    return observations


def verify(args: Args) -> int:
    """Play every episode again and print its score. Returns the exit code: 1 where one went another way."""
    game = make_game(args, read_about(args.out)[1])
    recordings = Recordings.open(args.out, about_recordings(args, game))
    require(bool(recordings.files), "--out", args.out, "holds no recordings")
    failures = 0
    for name, score in zip(recordings.files, recordings.scores):
        episode = read_arrays(args.out / name)
        again = replay(game, episode)
        failures += again is None
        times = episode.get("t_ns", np.arange(len(episode["actions"])) * 1e9 / game.fps)
        played = times[-1] / 1e9 + 1 / game.fps
        print(f"{name}  {score:8.1f} {game.unit}  {played:6.1f} s  {'differs' if again is None else 'the same again'}")
    return int(failures > 0)


def export_minari(args: Args) -> int:
    """Write the recordings as a Minari dataset, images without loss. Returns the exit code."""
    import minari
    from minari.data_collector import EpisodeBuffer

    game = make_game(args, read_about(args.out)[1])
    recordings = Recordings.open(args.out, about_recordings(args, game))
    require(bool(recordings.files), "--out", args.out, "holds no recordings")
    exists = args.export_minari in minari.list_local_datasets()
    require(not exists, "--export-minari", args.export_minari, "exists already")
    buffers = []
    for i, name in enumerate(recordings.files):
        episode = read_arrays(args.out / name)
        observations = replay(game, episode)
        require(observations is not None, "--out", args.out / name, "gives other rewards when it is played again")
        over = np.zeros((2, len(episode["actions"])), bool)
        over[:, -1] = episode["terminated"], episode["truncated"]
        columns = {"observations": np.stack(observations), "actions": episode["actions"]}
        columns |= {"rewards": episode["rewards"], "terminations": over[0], "truncations": over[1]}
        buffers.append(EpisodeBuffer(id=i, seed=int(episode["seed"]), **columns))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of addresses that these recordings have none of
        minari.create_dataset_from_buffers(
            args.export_minari,
            buffers,
            observation_space=game.env.observation_space,
            action_space=game.env.action_space,
            algorithm_name=args.player,
            author=args.player,
            description=f"{args.env_id}, {game.fps:g} steps a second",
            jpeg_encoding=False,
        )
    print(f"{args.export_minari}: {len(buffers)} episodes")
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# Playing
# ---------------------------------------------------------------------------------------------------------------------
COUNTDOWN, BUSY_TIME = 3, 1.0  # s before a round, and until a page that was just loaded anew is free
MAX_BEHIND = 0.5  # s of pictures that the browser has not drawn; beyond, nobody sees what is played
MAX_SLOWNESS = 0.1  # of a round's time, by which it may last longer than the game: who has more time plays better
SILENT = "The browser drew no picture for half a second: this round is not kept. Load the page again if this repeats."
SLOW = "The computer or the connection was too slow: the game ran slower than it should, and this round is not kept."
MAX_BODY = 16_384  # bytes that a browser may send at once
NAMES = {"left", "right", "up", "down", "fire"}


class Player:
    """The browser at the other end: what it holds, what it has drawn, and what it asked for."""

    def __init__(self, websocket):
        self.websocket, self.keys = websocket, Keys()
        self.tapped: frozenset[str] = frozenset()  # what was held since the last frame
        self.sent, self.drawn = 0, 0  # pictures, and the newest of them that is on the screen
        self.orders: asyncio.Queue[str] = asyncio.Queue()  # practice, record
        self.stopped, self.gone = False, False

    async def listen(self) -> None:
        """Read messages until the browser is gone. One that is not understood ends the connection."""
        from fastapi import WebSocketDisconnect

        expected = WebSocketDisconnect, RuntimeError, ValueError, KeyError, TypeError, AttributeError, OverflowError
        try:
            while True:
                self.understand(json.loads(await self.websocket.receive_text()))
        except expected:
            pass
        finally:
            self.gone = self.stopped = True
            self.orders.put_nowait("gone")

    def understand(self, message: dict) -> None:
        """`{"held": [names], "axes": [x, y], "seq": n}`, `{"drawn": n}` or `{"order": "practice" | "record" | "stop"}`."""
        if "drawn" in message:
            self.drawn = min(int(message["drawn"]), self.sent)
            return
        if "order" in message:
            order = message["order"]
            if order == "stop":
                self.stopped = True
            elif order in ("practice", "record") and self.orders.empty():
                self.stopped = False
                self.orders.put_nowait(order)
            return
        axes = [min(max(float(x), -1.0), 1.0) for x in message["axes"]]
        if len(axes) != 2 or not all(map(math.isfinite, axes)):
            raise ValueError("axes")
        self.keys = Keys(frozenset(message["held"]) & NAMES, (axes[0], axes[1]), int(message["seq"]) % 2**32)
        self.tapped |= self.keys.held

    def take_keys(self) -> Keys:
        """The keys for a frame: those that are held, and those that were pressed and let go since the last one."""
        keys = replace(self.keys, held=self.keys.held | self.tapped)
        self.tapped = frozenset()
        return keys

    async def show(self, picture: bytes) -> None:
        """Send a picture, with the number of the message whose keys it follows and its own."""
        self.sent += 1
        numbers = self.keys.seq.to_bytes(4, "little") + self.sent.to_bytes(4, "little")
        await self.websocket.send_bytes(numbers + picture)

    async def tell(self, **message) -> None:
        await self.websocket.send_json(message)


class Clock:
    """Ticks at a fixed rate. After a delay it goes on from there, instead of catching up."""

    def __init__(self, fps: int):
        self.period, self.next = 1 / fps, time.perf_counter()

    async def tick(self) -> None:
        self.next = max(self.next + self.period, time.perf_counter())
        await asyncio.sleep(max(self.next - time.perf_counter(), 0))


async def play_episode(game: Game, player: Player, seed: int) -> dict[str, np.ndarray] | str | None:
    """Play one episode in real time; None where it was broken off, and why where it cannot be kept.

    Returns what `Recordings.add` writes: actions (T, ...), rewards (T,), t_ns (T,), terminated, truncated, seed, and
    observations (T + 1, ...), or for Atari lives (T,) and emulator_state.
    """
    columns = {"actions": [], "rewards": [], "t_ns": [], **game.begin(game.reset(seed))}
    await player.show(game.picture())
    for left in range(COUNTDOWN, 0, -1):
        await player.tell(kind="countdown", left=left)
        for _ in range(20):
            await asyncio.sleep(0.05)
            if player.stopped:
                return None
    await player.tell(kind="go")
    player.tapped = frozenset()  # keys of before
    clock, begun = Clock(game.fps), time.perf_counter_ns()
    while True:
        await clock.tick()
        if player.stopped:
            return None
        if player.sent - player.drawn > MAX_BEHIND * game.fps:
            return SILENT
        action = game.action(player.take_keys())
        columns["t_ns"].append(time.perf_counter_ns() - begun)
        obs, reward, terminated, truncated, info = game.env.step(action)
        columns["actions"].append(action)
        columns["rewards"].append(reward)
        game.keep(columns, obs, info)
        await player.show(game.picture())
        if terminated or truncated:
            break
    frames, seconds = len(columns["t_ns"]) - 1, columns["t_ns"][-1] / 1e9
    if seconds > (1 + MAX_SLOWNESS) * frames / game.fps + 0.1:
        return SLOW
    dtypes = {"actions": game.action_dtype, "rewards": np.float64, "t_ns": np.int64, "lives": np.int64}
    episode = {name: np.array(column, dtypes.get(name)) for name, column in columns.items()}
    if isinstance(game, Atari):
        episode["emulator_state"] = np.frombuffer(game.emulator_state, np.uint8)
    return {**episode, "terminated": np.array(terminated), "truncated": np.array(truncated), "seed": np.array(seed)}


async def serve_player(websocket, game: Game, recordings: Recordings | None, seeds: np.random.SeedSequence) -> None:
    """Play rounds as the browser orders them until it is gone; keep those that it orders to record."""
    from fastapi import WebSocketDisconnect

    player = Player(websocket)
    listener = asyncio.create_task(player.listen())
    try:
        while True:
            scores = [] if recordings is None else recordings.scores
            await player.tell(kind="ready", scores=scores, records=recordings is not None)
            order = await player.orders.get()
            if player.gone:
                return
            recorded = order == "record" and recordings is not None
            episode = await play_episode(game, player, int(seeds.spawn(1)[0].generate_state(1)[0]))
            kept = isinstance(episode, dict)
            if kept and recorded:
                before = len(recordings.files)
                try:
                    recordings.add(episode)
                except OSError as error:
                    print(f"error: --out {recordings.folder}: {first_line(error)}", file=sys.stderr)
                    if len(recordings.files) == before:  # else the round is kept, only the manifest lacks it
                        await player.tell(kind="over", score=None, recorded=False, trouble=first_line(error))
                        continue
            elif recorded:
                recordings.note_lost()
            trouble = {"trouble": episode} if isinstance(episode, str) else {}
            score = float(episode["rewards"].sum()) if kept else None
            await player.tell(kind="over", score=score, recorded=recorded and kept, **trouble)
    except WebSocketDisconnect:
        return
    except RuntimeError:  # it was lost while something was sent
        if not player.gone:
            raise
    finally:
        listener.cancel()


# ---------------------------------------------------------------------------------------------------------------------
# The page
# ---------------------------------------------------------------------------------------------------------------------
def allowed_hosts(host: str) -> set[str] | None:
    """Names by which browsers may call this server, against rebinding of foreign names; None: all."""
    host = host.lower()  # as browsers write it
    return None if host in ("0.0.0.0", "::") else {"127.0.0.1", "localhost", "[::1]", host, f"[{host}]"}


def make_app(args: Args, game: Game, recordings: Recordings | None):
    """The web application: a page, and a websocket for one player at a time."""
    from fastapi import FastAPI, Response, WebSocket, WebSocketDisconnect
    from fastapi.requests import HTTPConnection

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    page, hosts, busy = Path(__file__).with_suffix(".html").read_text(), allowed_hosts(args.host), asyncio.Lock()
    # a folder that is added to gets other rounds
    stream = [PRACTICE_STREAM] if recordings is None else [HUMAN_STREAM, len(recordings.files)]
    seeds = np.random.SeedSequence(None if args.seed is None else [args.seed, *stream])
    about = {"title": args.env_id, "rules": game.rules, "keys": game.keys, "unit": game.unit}

    def is_known(connection: HTTPConnection) -> bool:
        name = re.sub(r":\d+$", "", connection.headers.get("host", ""))
        return hosts is None or name in hosts

    @app.get("/")
    def show_page(connection: HTTPConnection) -> Response:
        """The page; only its own script and style may run in it."""
        if not is_known(connection):
            return Response("unknown host", 421)
        nonce = secrets.token_urlsafe(16)
        policy = "default-src 'none'; base-uri 'none'; frame-ancestors 'none'; connect-src 'self'; worker-src blob:; "
        policy += f"script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'"
        content = page.replace("{{nonce}}", nonce).replace("{{about}}", json.dumps(about).replace("<", "\\u003c"))
        headers = {"Content-Security-Policy": policy, "Cache-Control": "no-store", "X-Content-Type-Options": "nosniff"}
        return Response(content, media_type="text/html", headers=headers)

    @app.websocket("/play")
    async def play(websocket: WebSocket) -> None:
        origin = websocket.headers.get("origin", "").partition("://")[2]
        if not is_known(websocket) or origin != websocket.headers.get("host"):
            await websocket.close(1008)  # another site's page
            return
        await websocket.accept()
        try:
            await asyncio.wait_for(busy.acquire(), BUSY_TIME)
        except TimeoutError:
            await websocket.send_json({"kind": "busy"})
            await websocket.close()
            return
        try:
            await serve_player(websocket, game, recordings, seeds)
        finally:
            busy.release()
        with contextlib.suppress(RuntimeError, WebSocketDisconnect):  # the browser went first
            await websocket.close()

    return app


def listen(host: str, port: int) -> socket.socket:
    """A socket on that address, where browsers wait until `serve` answers. Raises UsageError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise UsageError(f"--host {host} --port {port}: cannot be listened on: {error.strerror}") from None
    return listener


def serve(app, listener: socket.socket, host: str) -> None:
    """Answer browsers until Ctrl-C or SIGTERM."""
    import uvicorn

    name = socket.gethostname() if host in ("0.0.0.0", "::") else f"[{host}]" if ":" in host else host
    print(f"open http://{name}:{listener.getsockname()[1]} in a browser; Ctrl-C ends", flush=True)
    settings = {"log_level": "warning", "access_log": False, "server_header": False, "date_header": False}
    settings |= {"ws_max_size": MAX_BODY, "ws_per_message_deflate": False, "timeout_graceful_shutdown": 1}
    settings |= {"ws_ping_interval": 5, "ws_ping_timeout": 5}  # s; a browser that is lost keeps others out for as long
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with contextlib.suppress(KeyboardInterrupt):
        uvicorn.Server(uvicorn.Config(app, **settings)).run(sockets=[listener])


def make_folder(folder: Path) -> None:
    """Make the folder of the recordings before anybody plays, and keep others out of it. Raises UsageError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            fcntl.flock(os.open(folder, os.O_RDONLY), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UsageError(f"--out {folder}: another recorder is running in it") from None
    except OSError as error:
        raise UsageError(f"--out {folder}: cannot be written to: {error.strerror}") from None


def main(args: Args) -> int:
    """Record, or read what was recorded. Returns the exit code."""
    args = complete_args(args)
    if args.verify:
        return verify(args)
    if args.export_minari is not None:
        return export_minari(args)
    game = make_game(args)
    listener, recordings = listen(args.host, args.port), None
    if not args.practice:
        make_folder(args.out)
        recordings = Recordings.open(args.out, about_recordings(args, game))
        recordings.check_emulator()
        if recordings.torn:
            recordings.write_manifest()
    serve(make_app(args, game, recordings), listener, args.host)
    if recordings is not None:
        print(f"{args.out}: {len(recordings.files)} episodes")
        with contextlib.suppress(OSError):  # it is not empty
            args.out.rmdir()
    return 0


def cli(argv: list[str] | None = None) -> int:
    """Run from the command line: a user's mistake is one line and exit code 2, a full disk one line and exit code 1."""
    try:
        return main(parse_args(argv))
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(cli())
