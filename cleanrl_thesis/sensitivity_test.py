"""The double-blind study of chapter 2: people see clips of play and say of each whether a human or a machine plays.

    python cleanrl_thesis/sensitivity_test.py --videos study --prepare human=recordings/anna dqn=runs/apple_teacher
    python cleanrl_thesis/sensitivity_test.py --videos study --db study.sqlite           # the study, in the browser
    python cleanrl_thesis/sensitivity_test.py --db study.sqlite --export results         # the tables' last column

`--prepare NAME=FOLDER ...` cuts clips into `--videos`/NAME/. A folder is one of recordings or of `--save-demos`, a run, whose
own script is asked for episodes, or one of videos. All are drawn by the same renderer at the same speed, without metadata.

| what | how | source |
|---|---|---|
| a participant | consents, reads the rules, then sees two clips of each agent, in an order of their own | sections 2.4.1 to 2.4.3 |
| clips | 15 s, driving 30 s, from random moments, the same for each agent; episodes that end sooner have none | sections 2.4.1 to 2.4.3; ours |
| double-blind | a clip's address is drawn at random for each participant; whose it is, is joined at `--export` alone | ours |
| what is stored | age and gender if given, verdicts, comments; no name, address or time | ours |
| an answer | is on disk when the page goes on; sent twice, it counts once and the first one stays | ours |
| interval | 95%, Wilson's for the effective number of answers, for each participant judges several clips; of these clips | ours |
"""

# /// script
# requires-python = ">=3.11"
# dependencies = [
#     "ale-py>=0.11",
#     "fastapi>=0.115",
#     "gymnasium>=1.2",
#     "imageio-ffmpeg>=0.5",
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
# ]
# ///
import contextlib
import csv
import fcntl
import hashlib
import importlib.util
import io
import itertools
import json
import math
import os
import random
import re
import secrets
import shutil
import signal
import socket
import sqlite3
import statistics
import struct
import subprocess
import sys
import tempfile
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Literal

import gymnasium as gym
import numpy as np
import tyro


# ---------------------------------------------------------------------------------------------------------------------
# Arguments
# ---------------------------------------------------------------------------------------------------------------------
@dataclass
class Args:
    videos: Path | None = None
    """the clips: a folder for each agent, with its *.mp4; `rules.txt` and `practice.mp4` beside them are shown first"""
    db: Path = Path("study.sqlite")
    """the study's answers, an SQLite database; the study goes on where it exists"""
    prepare: tuple[str, ...] = ()
    """NAME=FOLDER of each agent: cut clips into `--videos`, instead of asking people"""
    practice: Path | None = None
    """folder of the play that everyone is shown first, as for `--prepare`"""
    export: Path | None = None
    """write the table and the comments into this folder, instead of asking people"""
    clips: int = 8
    """clips to cut of each agent"""
    seconds: float | None = None
    """length of a clip; default: 15, driving 30 (sections 2.4.1 to 2.4.3)"""
    seed: int = 1
    """seed of the moments at which clips begin"""
    clips_per_agent: int = 2
    """clips of each agent that a participant sees (sections 2.4.1 to 2.4.3)"""
    consent: Path | None = None
    """a text file to be agreed to, instead of the page's own text"""
    contact: str = ""
    """who answers a participant's questions, shown below the consent"""
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


def read_text(path: Path, flag: str) -> str:
    """A text file in UTF-8. Raises UsageError."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"{flag} {path}: cannot be read: {first_line(error)}") from None


def complete_args(args: Args) -> Args:
    """Check all. Raises UsageError."""
    require(not (args.prepare and args.export), "--prepare --export", "", "exclude each other")
    needs = "is needed: the folder of the clips, a folder in it for each agent"
    require(args.export is not None or args.videos is not None, "--videos", "", needs)
    for flag, value in (("--clips", args.clips), ("--clips-per-agent", args.clips_per_agent)):
        require(value >= 1, flag, value, "must be at least 1")
    require(args.seconds is None or 0 < args.seconds < 3_600, "--seconds", args.seconds, "must be between 0 and 3600")
    require(0 <= args.seed < 2**32, "--seed", args.seed, "must be between 0 and 4294967295")
    require(0 <= args.port < 2**16, "--port", args.port, "must be between 0 and 65535")
    names = [agent.partition("=")[0] for agent in args.prepare]
    for agent, name in zip(args.prepare, names):
        named = re.fullmatch(r"[\w.-]{1,40}=.+", agent) is not None and not name.startswith(".")
        require(named, "--prepare", agent, "must be NAME=FOLDER, the name of letters, digits, -, _ and .")
    require(len(set(names)) == len(names), "--prepare", " ".join(args.prepare), "names an agent twice")
    require(args.practice is None or bool(args.prepare), "--practice", args.practice, "belongs to --prepare")
    require("practice" not in names, "--prepare", "practice", "cannot be an agent's name")
    for agent in args.prepare:
        require(Path(agent.partition("=")[2]).is_dir(), "--prepare", agent, "is no folder")
    require(args.videos is None or not args.videos.is_file(), "--videos", args.videos, "is a file, not a folder")
    require(args.export is None or not args.export.is_file(), "--export", args.export, "is a file, not a folder")
    if args.consent is not None:
        require(args.consent.is_file(), "--consent", args.consent, "is no file")
    if args.prepare and importlib.util.find_spec("imageio_ffmpeg") is None:
        raise UsageError("--prepare: needs imageio-ffmpeg: pip install imageio-ffmpeg")
    if not args.prepare and args.export is None:
        for name in ("fastapi", "uvicorn"):
            allowed = "are needed for the page: pip install fastapi uvicorn"
            require(importlib.util.find_spec(name) is not None, "fastapi and uvicorn", "", allowed)
    return args


# ---------------------------------------------------------------------------------------------------------------------
# Clips
# ---------------------------------------------------------------------------------------------------------------------
RULES = {
    "AppleGame-v0": "The player is the blue disc. It takes a red apple by touching it: each one counts. An apple that nobody "
    "takes is gone after a second and a half, and another one appears. A round lasts 30 seconds.",
    "ALE/Gopher-v5": "The player is the farmer, who keeps the gopher from three carrots. The gopher digs holes up to the "
    "garden; the farmer fills them with a shovel, and hits the gopher when it comes out.",
    "TorcsLike-v0": "The player drives the red car as far as it can in 60 seconds, on the road and past the parked cars.",
}
ATARI_SCALE = 3  # pixels of a clip for each of the console's
TRIES = 1_000  # to draw moments that every agent has clips of
CLIP_TIME = 315_532_800  # of every file, 1980-01-01: a clip does not tell when it was made


def load_method(name: str) -> ModuleType:
    """The method file of that name beside this one, which holds the game."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, Path(__file__).with_name(f"{name}.py"))
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


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
class Play:
    """Recorded play that clips are cut from."""

    env_id: str  # "" of videos
    fps: float
    lengths: dict[Path, int]  # frames of each episode or video
    options: dict

    def frames(self, path: Path, start: int, count: int) -> Iterator[np.ndarray]:
        """`count` pictures from the frame `start` on, (H, W, 3) uint8."""
        if path.suffix == ".mp4":
            frames = read_video(path)
        else:
            frames = draw_episode(self.env_id, self.options, read_arrays(path))
        yield from itertools.islice(frames, start, start + count)


def read_video(path: Path) -> Iterator[np.ndarray]:
    """The pictures of a video. Raises UsageError."""
    import imageio_ffmpeg

    try:
        parts = imageio_ffmpeg.read_frames(str(path))
        width, height = next(parts)["size"]
        for part in parts:
            yield np.frombuffer(part, np.uint8).reshape(height, width, 3)
    except (OSError, RuntimeError, StopIteration) as error:
        raise UsageError(f"--prepare {path}: no video: {first_line(error)}") from None


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """What is needed of an episode to play it again. Raises UsageError."""
    try:
        with np.load(path, allow_pickle=False) as arrays:
            return {name: arrays[name] for name in ("seed", "actions", "rewards")}
    except (KeyError, ValueError, zipfile.BadZipFile, EOFError, OSError) as error:
        raise UsageError(f"--prepare {path}: no demonstration: {first_line(error)}") from None


def draw_episode(env_id: str, options: dict, episode: dict[str, np.ndarray]) -> Iterator[np.ndarray]:
    """Play an episode again and draw what each frame shows, an agent's actions of 4 frames too. Raises UsageError."""
    repeats = 1
    if env_id.startswith("ALE/"):
        noop_max, repeats = options.get("noop_max", 30), options.get("frame_skip", 4)
        env = load_method("dqn_gopher").make_atari(env_id, frame_skip=1, frame_stack=1, noop_max=noop_max)
    else:
        load_method("ddpg_torcs_like" if env_id == "TorcsLike-v0" else "dqn_apple")
        env = gym.make(env_id, disable_env_checker=True, **options).unwrapped
    env.reset(seed=int(episode["seed"]))
    for action, reward in zip(episode["actions"], episode["rewards"].tolist()):
        for _ in range(repeats):
            _, points, terminated, truncated, _ = env.step(action)
            reward -= points
            image = env.render()
            if env_id.startswith("ALE/"):
                image = image.repeat(ATARI_SCALE, 0).repeat(ATARI_SCALE, 1)
            yield image
            if terminated or truncated:
                break
        if reward != 0:
            raise UsageError(f"--prepare: an episode of {env_id} gives other rewards when it is played again")


def find_play(folder: Path, clips: int) -> Play:
    """The play in a folder: demonstrations, a run's, made by its script where there are none, or videos. Raises UsageError."""
    for place in (folder, folder / "demos"):
        if (place / "manifest.json").exists():
            return find_episodes(place)
    if (folder / "args.json").exists():
        ask_script(folder, clips)
        return find_episodes(folder / "demos")
    paths = sorted(folder.glob("*.mp4"))
    require(bool(paths), "--prepare", folder, "holds no demonstrations, no run and no *.mp4")
    import imageio_ffmpeg

    rates, lengths = set(), {}
    for path in paths:
        try:
            about = next(imageio_ffmpeg.read_frames(str(path)))
        except (OSError, RuntimeError) as error:
            raise UsageError(f"--prepare {path}: no video: {first_line(error)}") from None
        rates.add(about["fps"])
        lengths[path] = int(about["duration"] * about["fps"])
    require(len(rates) == 1, "--prepare", folder, f"has videos of several frame rates, {sorted(rates)}")
    return Play("", rates.pop(), lengths, {})


def find_episodes(folder: Path) -> Play:
    """The demonstrations in a folder. Raises UsageError."""
    try:
        manifest = json.loads((folder / "manifest.json").read_text())
        files, env_id = dict(manifest["files"]), str(manifest["env_id"]).split(":")[-1]
        options = dict(manifest.get("options") or {})
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"--prepare {folder}: its manifest.json cannot be read") from None
    known = env_id in RULES or env_id.startswith("ALE/")
    require(known, "--prepare", folder, f"was recorded in {env_id}, must be of {', '.join(RULES)} or ALE/*-v5")
    lengths = {}
    for name, checksum in sorted(files.items()):
        path = folder / name
        require(
            Path(name).name == name and path.is_file(), "--prepare", folder, f"lacks {name}, which its manifest names"
        )
        same = hashlib.sha256(path.read_bytes()).hexdigest() == checksum
        require(same, "--prepare", path, "its SHA-256 is not the manifest's, the file was changed or damaged")
        repeats = options.get("frame_skip", 4) if env_id.startswith("ALE/") else 1
        lengths[path] = len(read_arrays(path)["actions"]) * repeats - (repeats - 1)  # the last may end sooner
    fps = 50 if env_id == "TorcsLike-v0" else 60
    return Play(env_id, fps, lengths, options)


def ask_script(run_dir: Path, clips: int) -> None:
    """Let a finished run's own script write episodes of its agent into `demos/`. Raises UsageError."""
    try:
        args = json.loads((run_dir / "args.json").read_text())
        script = Path(__file__).with_name(f"{args['exp_name']}.py")
    except (OSError, ValueError, KeyError, TypeError):
        raise UsageError(f"--prepare {run_dir}: its args.json cannot be read") from None
    require(script.is_file(), "--prepare", run_dir, f"needs demos/: no script is called {script.name}")
    require((run_dir / "result.json").exists(), "--prepare", run_dir, "needs demos/, and the run is not done")
    flags = [f"--run-dir={run_dir}", "--resume", f"--save-demos={2 * clips}"]
    help_text = subprocess.run([sys.executable, script, "--help"], capture_output=True, text=True).stdout
    for name, value in args.items():
        flag = f"--{name.replace('_', '-')}"
        if name in ("run_dir", "resume", "save_demos") or value is None or flag not in help_text:
            continue
        flags += [flag if value else f"--no-{flag[2:]}"] if isinstance(value, bool) else [flag, str(value)]
    print(f"{script.name} plays {2 * clips} episodes of {run_dir}", flush=True)
    done = subprocess.run(
        [sys.executable, script, *flags], stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
    )
    last = (done.stderr.strip().splitlines() or [""])[-1]
    require(done.returncode == 0, "--prepare", run_dir, f"{script.name} could not play: {last}")


def write_clip(path: Path, frames: Iterator[np.ndarray], fps: float) -> None:
    """Encode pictures as H.264 in MP4, of fixed settings and without metadata."""
    import imageio_ffmpeg

    first = next(frames)
    height, width = first.shape[0] // 2 * 2, first.shape[1] // 2 * 2
    clean = ["-map_metadata", "-1", "-fflags", "+bitexact", "-flags:v", "+bitexact", "-movflags", "+faststart"]
    options = {"codec": "libx264", "quality": None, "macro_block_size": 1, "ffmpeg_log_level": "error"}
    new = path.with_name("new.tmp.mp4")
    video = imageio_ffmpeg.write_frames(
        str(new), (width, height), fps=fps, **options, output_params=["-crf", "20", "-threads", "1", *clean]
    )
    video.send(None)
    for frame in itertools.chain([first], frames):
        video.send(np.ascontiguousarray(frame[:height, :width]))
    video.close()
    write_whole(path, without_metadata(new.read_bytes()))
    new.unlink()
    os.utime(path, (CLIP_TIME, CLIP_TIME))


def prepare(args: Args) -> int:
    """Cut clips of each agent, all of the same game, size, speed and length. Returns the exit code."""
    exists = args.videos.exists() and any(args.videos.iterdir())
    require(not exists, "--videos", args.videos, "exists; clips are cut into a new folder")
    sources = {name: Path(folder) for name, _, folder in (agent.partition("=") for agent in args.prepare)}
    if args.practice is not None:
        sources["practice"] = args.practice
    plays = {name: find_play(folder, args.clips) for name, folder in sources.items()}
    roads = {str(play.options.get("track", "")) for play in plays.values()}
    games, rates = {play.env_id or "videos" for play in plays.values()}, {play.fps for play in plays.values()}
    for what, values in (("games", games), ("frame rates", rates), ("roads", roads)):
        require(len(values) == 1, "--prepare", " ".join(args.prepare), f"are of different {what}: {sorted(values)}")
    env_id, fps = next(iter(plays.values())).env_id, next(iter(plays.values())).fps
    seconds = args.seconds or (30 if env_id == "TorcsLike-v0" else 15)
    require(seconds * fps >= 1, "--seconds", seconds, f"must be at least a frame, 1/{fps:g} s")
    cuts = choose_cuts(plays, sources, args, seconds)
    try:
        args.videos.parent.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=f"{args.videos.name}.", dir=args.videos.parent))
    except OSError as error:
        raise UsageError(f"--videos {args.videos}: cannot be written: {error.strerror}") from None
    try:
        cut_clips(new, args, plays, cuts, seconds)
        if args.videos.exists():
            args.videos.rmdir()
        os.replace(new, args.videos)
        args.videos.chmod(0o755)
    finally:
        shutil.rmtree(new, ignore_errors=True)
    return 0


def common_windows(
    plays: dict[str, dict[Path, int]], frames: int, clips: int, rng: np.random.Generator
) -> dict[str, list[tuple[Path, int]]] | None:
    """Where clips of so many frames begin, for each agent in other episodes, but for all at the same moments.

    The moment would tell them apart, which pictures show: an agent that often crashes has no late ones. Moments are drawn evenly
    until each agent has an episode for each of them, if possible always another one; None where it never has.
    """
    latest = min(max(lengths.values(), default=0) for lengths in plays.values()) - frames
    for _ in range(TRIES if latest >= 0 else 0):
        starts = np.sort(rng.integers(0, latest + 1, clips))[::-1].tolist()  # the fewest episodes have the late ones
        cuts = {name: place_windows(lengths, frames, starts, rng) for name, lengths in plays.items()}
        if all(windows is not None for windows in cuts.values()):
            return cuts
    return None


def place_windows(
    lengths: dict[Path, int], frames: int, starts: list[int], rng: np.random.Generator
) -> list[tuple[Path, int]] | None:
    """An episode for each start, drawn of those that are long enough; one that has a clip already only where no other is left."""
    taken: dict[Path, list[int]] = {path: [] for path in lengths}
    windows = []
    for start in starts:
        fit = [path for path, length in lengths.items() if length >= start + frames]
        fit = [path for path in fit if all(abs(start - other) >= frames for other in taken[path])]
        fit = [path for path in fit if not taken[path]] or fit
        if not fit:
            return None
        path = fit[rng.integers(len(fit))]
        taken[path].append(start)
        windows.append((path, start))
    return windows


def choose_cuts(plays: dict[str, Play], sources: dict[str, Path], args: Args, seconds: float) -> dict[str, list]:
    """Where the clips of each agent begin, and that for practice, of an episode that no other clip is of. Raises UsageError."""
    rng, agents = np.random.default_rng(args.seed), {name: play for name, play in plays.items() if name != "practice"}
    frames = round(seconds * next(iter(plays.values())).fps)
    for name, play in agents.items():
        count = sum(length // frames for length in play.lengths.values())
        allowed = f"has {count} clips of {seconds:g} s, needs {args.clips}: --clips or --seconds may be less"
        require(count >= args.clips, "--prepare", f"{name}={sources[name]}", allowed)
    cuts = common_windows({name: play.lengths for name, play in agents.items()}, frames, args.clips, rng)
    allowed = f"have no {args.clips} clips of {seconds:g} s each that begin at the same moments: --clips or --seconds may be less"
    require(cuts is not None, "--prepare", " ".join(args.prepare), allowed)
    if "practice" in plays:
        shown = {path.resolve() for windows in cuts.values() for path, _ in windows}
        free = {path: length for path, length in plays["practice"].lengths.items() if path.resolve() not in shown}
        shown_first = common_windows({"practice": free}, frames, 1, rng)
        allowed = f"has no episode of {seconds:g} s of which the agents' clips show nothing: --clips may be less"
        require(shown_first is not None, "--practice", args.practice, allowed)
        cuts |= shown_first
    return cuts


def cut_clips(folder: Path, args: Args, plays: dict[str, Play], cuts: dict[str, list], seconds: float) -> None:
    """Write the clips of all agents, the rules, and whence each clip comes."""
    made = []
    for name, windows in cuts.items():
        for i, (path, start) in enumerate(windows):
            clip, fps = folder / ("practice.mp4" if name == "practice" else f"{name}/{i:03d}.mp4"), plays[name].fps
            clip.parent.mkdir(exist_ok=True)
            write_clip(clip, plays[name].frames(path, start, round(seconds * fps)), fps)
            made.append({"clip": str(clip.relative_to(folder)), "from": path.name, "second": round(start / fps, 2)})
        print(f"{name}: {len(windows)} clip{'s' * (len(windows) > 1)} of {seconds:g} s")
    env_id = next(iter(plays.values())).env_id
    if env_id in RULES:
        write_whole(folder / "rules.txt", (RULES[env_id] + "\n").encode())
    write_json(folder / "prepared.json", {"env_id": env_id, "seed": args.seed, "clips": made})
    find_clips(folder, 1)  # raises where what was made is not alike


# ---------------------------------------------------------------------------------------------------------------------
# What a clip's file tells
# ---------------------------------------------------------------------------------------------------------------------
CONTAINERS = {b"moov", b"trak", b"mdia", b"minf", b"stbl"}
METADATA = {b"udta", b"meta", b"uuid"}


def boxes(content: bytes, at: int = 0, end: int | None = None) -> Iterator[tuple[bytes, int, int]]:
    """The boxes of an MP4 file (ISO 14496-12), and those within: kind, and where its inside begins and ends.

    Raises ValueError or struct.error where one is cut off.
    """
    end = len(content) if end is None else end
    while at < end:
        size, kind = struct.unpack_from(">I4s", content, at)
        head = 16 if size == 1 else 8
        size = struct.unpack_from(">Q", content, at + 8)[0] if size == 1 else size or end - at
        if size < head or at + size > end:
            raise ValueError("no MP4 video, or cut off")
        yield kind, at + head, at + size
        if kind in CONTAINERS:
            yield from boxes(content, at + head, at + size)
        at += size


def without_metadata(content: bytes) -> bytes:
    """An MP4 file whose boxes of metadata are free space."""
    clean = bytearray(content)
    for kind, start, end in boxes(content):
        if kind in METADATA:
            clean[start - 4 : end] = b"free" + bytes(end - start)
    return bytes(clean)


def describe_clip(content: bytes) -> tuple[float, int, int, int]:
    """Seconds, width, height and number of frames of an MP4 file.

    Raises ValueError or struct.error where it is none, is cut off, or holds metadata.
    """
    found = {kind: content[start:end] for kind, start, end in boxes(content)}
    if not {b"mvhd", b"tkhd", b"stsz"} <= found.keys():
        raise ValueError("no MP4 video, or cut off")
    if METADATA & found.keys():
        raise ValueError("holds metadata, which could tell the agent")
    created, _, scale, duration = struct.unpack_from(">QQIQ" if found[b"mvhd"][0] else ">IIII", found[b"mvhd"], 4)
    times = [found[kind][4:12] if found[kind][0] else found[kind][4:8] for kind in (b"tkhd", b"mdhd") if kind in found]
    if created or any(map(any, times)):
        raise ValueError("holds the time at which it was made, which could tell the agent")
    width, height = struct.unpack_from(">II", found[b"tkhd"], len(found[b"tkhd"]) - 8)
    return duration / scale, width >> 16, height >> 16, struct.unpack_from(">I", found[b"stsz"], 8)[0]


@dataclass
class Clip:
    """One clip of an agent."""

    agent: str
    path: Path
    sha256: str


def find_clips(videos: Path, per_agent: int) -> list[Clip]:
    """All clips of the agents' folders: alike in length and size, and without metadata. Raises UsageError."""
    require(videos.is_dir(), "--videos", videos, "is no folder")
    agents = sorted(path for path in videos.iterdir() if path.is_dir() and not path.name.startswith("."))
    require(bool(agents), "--videos", videos, "has no folder of an agent")
    clips, like = [], None
    for folder in agents:
        paths = sorted(folder.glob("*.mp4"))
        require(len(paths) >= per_agent, "--videos", folder, f"has {len(paths)} *.mp4, each agent needs {per_agent}")
        for path in paths:
            is_inside = path.resolve().is_relative_to(videos.resolve()) and path.is_file() and not path.is_symlink()
            require(is_inside, "--videos", path, "is a link, or no file")
            content = path.read_bytes()
            try:
                found = describe_clip(content)
            except (ValueError, struct.error) as error:
                message = first_line(error)
                raise UsageError(f"--videos {path}: {message}; --prepare makes clips that tell nothing") from None
            like = like or (path, found)
            same = abs(found[0] - like[1][0]) < 0.05 and found[1:] == like[1][1:]
            allowed = "is {:.2f} s of {} x {}, {} frames".format(*found)
            other = "but {}/{} is {:.2f} s of {} x {}, {} frames".format(like[0].parent.name, like[0].name, *like[1])
            require(same, "--videos", path, f"{allowed}, {other}: it could tell the agent")
            clips.append(Clip(folder.name, path, hashlib.sha256(content).hexdigest()))
    return clips


# ---------------------------------------------------------------------------------------------------------------------
# Answers
# ---------------------------------------------------------------------------------------------------------------------
SCHEMA = """
CREATE TABLE IF NOT EXISTS clips (clip INTEGER PRIMARY KEY, agent TEXT, file TEXT, sha256 TEXT UNIQUE);
CREATE TABLE IF NOT EXISTS participants (participant INTEGER PRIMARY KEY, key TEXT UNIQUE, age INTEGER, gender TEXT);
CREATE TABLE IF NOT EXISTS trials (
    participant INTEGER REFERENCES participants, position INTEGER, clip INTEGER REFERENCES clips, address TEXT UNIQUE,
    verdict TEXT CHECK (verdict IN ('human', 'machine')), why TEXT,
    PRIMARY KEY (participant, position), UNIQUE (participant, clip)
);
"""


@contextlib.contextmanager
def transaction(path: Path) -> Iterator[sqlite3.Connection]:
    """All of it is on disk at the end, or nothing."""
    with contextlib.closing(sqlite3.connect(path, timeout=60, isolation_level=None)) as db:
        db.execute("PRAGMA synchronous = FULL")
        db.execute("BEGIN IMMEDIATE")
        try:
            yield db
        except BaseException:
            db.execute("ROLLBACK")
            raise
        db.execute("COMMIT")


def lock_database(path: Path) -> None:
    """Keep other servers, with other clips, out of a database as long as this process lives. Raises UsageError."""
    try:
        fcntl.flock(os.open(path, os.O_RDWR | os.O_CREAT, 0o644), fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise UsageError(f"--db {path}: another study is running on it") from None
    except OSError as error:
        raise UsageError(f"--db {path}: cannot be written to: {error.strerror}") from None


def open_database(path: Path, clips: list[Clip]) -> None:
    """Create the tables, or go on with those that are there. Raises UsageError."""
    try:
        with contextlib.closing(sqlite3.connect(path)) as db:
            db.execute("PRAGMA journal_mode = WAL")
            db.executescript(SCHEMA)
        with transaction(path) as db:
            known = {sha256: agent for sha256, agent in db.execute("SELECT sha256, agent FROM clips")}
            there = {clip.sha256: clip.agent for clip in clips}
            missing = f"clips that {path} has are missing or have changed"
            require(known.items() <= there.items(), "--videos", "", missing)
            require(len(there) == len(clips), "--videos", "", "has the same clip twice")
            rows = [(clip.agent, clip.path.name, clip.sha256) for clip in clips if clip.sha256 not in known]
            random.SystemRandom().shuffle(rows)  # so that a clip's number tells nothing
            db.executemany("INSERT INTO clips (agent, file, sha256) VALUES (?, ?, ?)", rows)
    except sqlite3.Error as error:
        raise UsageError(f"--db {path}: {first_line(error)}") from None


def join(path: Path, key: str, age: int | None, gender: str | None, per_agent: int) -> None:
    """Note a participant, and draw clips in a random order: of each agent those with the fewest answers. Twice is once.

    Where they have as many, those come first that are least often with participants who have not answered yet.
    """
    with transaction(path) as db:
        if db.execute("SELECT 1 FROM participants WHERE key = ?", (key,)).fetchone():
            return
        cursor = db.execute("INSERT INTO participants (key, age, gender) VALUES (?, ?, ?)", (key, age, gender))
        seen = db.execute(
            "SELECT agent, clips.clip, COUNT(verdict), COUNT(position) FROM clips LEFT JOIN trials USING (clip) GROUP BY clips.clip"
        ).fetchall()
        rng, agents = random.SystemRandom(), {}
        rng.shuffle(seen)
        for agent, clip, *_ in sorted(seen, key=lambda row: row[2:]):
            agents.setdefault(agent, []).append(clip)
        drawn = [clip for clips in agents.values() for clip in clips[:per_agent]]
        rng.shuffle(drawn)
        rows = [(cursor.lastrowid, i, clip, secrets.token_urlsafe(16)) for i, clip in enumerate(drawn)]
        db.executemany("INSERT INTO trials (participant, position, clip, address) VALUES (?, ?, ?, ?)", rows)


def next_trial(path: Path, key: str) -> dict | None:
    """What a participant sees next: position, total and the clip's address, or that all is done; None for a stranger."""
    with contextlib.closing(sqlite3.connect(path, timeout=60)) as db:
        rows = db.execute(
            "SELECT position, address, verdict FROM trials JOIN participants USING (participant) WHERE key = ? ORDER BY position",
            (key,),
        ).fetchall()
    if not rows:
        return None
    left = [(position, address) for position, address, verdict in rows if verdict is None]
    if not left:
        return {"done": True, "total": len(rows)}
    return {"done": False, "position": left[0][0], "total": len(rows), "address": left[0][1]}


def note_answer(path: Path, key: str, address: str, verdict: str, why: str) -> bool:
    """Keep an answer to the clip that the participant is at; one that is answered already stays. False: not theirs yet."""
    with transaction(path) as db:
        row = db.execute(
            "SELECT participant, position, verdict FROM trials JOIN participants USING (participant) WHERE key = ? AND address = ?",
            (key, address),
        ).fetchone()
        if row is None:
            return False
        participant, position, before = row
        if before is not None:
            return True
        open_before = "SELECT 1 FROM trials WHERE participant = ? AND position < ? AND verdict IS NULL"
        if db.execute(open_before, (participant, position)).fetchone():
            return False
        change = "UPDATE trials SET verdict = ?, why = ? WHERE participant = ? AND position = ?"
        db.execute(change, (verdict, why, participant, position))
        return True


def clip_file(path: Path, address: str) -> str | None:
    """SHA-256 of the clip at an address."""
    with contextlib.closing(sqlite3.connect(path, timeout=60)) as db:
        row = db.execute("SELECT sha256 FROM trials JOIN clips USING (clip) WHERE address = ?", (address,)).fetchone()
    return None if row is None else row[0]


# ---------------------------------------------------------------------------------------------------------------------
# Export
# ---------------------------------------------------------------------------------------------------------------------
QUANTILE = statistics.NormalDist().inv_cdf(0.975)


def interval(human: np.ndarray, judged: np.ndarray) -> tuple[float, float]:
    """95% interval of the share `human.sum() / judged.sum()`, counts of each participant (P,).

    Wilson's with the number of answers divided by the design effect, for one person's answers are alike. The effect is
    estimated from the participants' deviations from the share, and kept between 1 (independent answers) and that of one answer
    a participant, which is taken where all answers are the same and nothing can be estimated.
    """
    answers, share = judged.sum(), human.sum() / judged.sum()
    most = (judged**2).sum() / answers
    effect = most
    if len(judged) > 1 and 0 < share < 1:
        variance = ((human - share * judged) ** 2).sum() * len(judged) / (len(judged) - 1) / answers**2
        effect = np.clip(variance * answers / (share * (1 - share)), 1, most)
    z2 = QUANTILE**2 * effect / answers
    middle, half = share + z2 / 2, math.sqrt(share * (1 - share) * z2 + z2 * z2 / 4)
    return max(0.0, float(middle - half) / (1 + z2)), min(1.0, float(middle + half) / (1 + z2))


def guarded(text: object) -> str:
    """Text of a cell that no spreadsheet takes for a formula."""
    text = "" if text is None else str(text)
    return re.sub(r"(^|[\t\r\n;])(?=\s*[=+\-@\uff1d\uff0b\uff0d\uff20])|^(?=[\t\r\n])", r"\1'", text)


def write_csv(path: Path, rows: list[dict]) -> None:
    """Write rows with the names of their columns."""
    content = io.StringIO()
    writer = csv.DictWriter(content, rows[0].keys(), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    write_whole(path, content.getvalue().encode())


def count_verdicts(answers: list[tuple]) -> list[dict]:
    """For each agent the column "Identified as Human", from answers (participant, agent, verdict, position, clip, ...).

    The interval is that of other people who see the same clips.
    """
    rows = []
    for agent in sorted({answer[1] for answer in answers}):
        people = sorted({who for who, name, *_ in answers if name == agent})
        judged = np.array([sum(who == p and name == agent for who, name, *_ in answers) for p in people])
        human = np.array(
            [sum(who == p and name == agent and what == "human" for who, name, what, *_ in answers) for p in people]
        )
        low, high = interval(human, judged)
        row = {"agent": guarded(agent), "identified_as_human": int(human.sum()), "judged": int(judged.sum())}
        row |= {"share": round(float(human.sum() / judged.sum()), 4), "low": round(low, 4), "high": round(high, 4)}
        rows.append({**row, "participants": len(people), "clips": len({a[4] for a in answers if a[1] == agent})})
    return rows


def export(args: Args) -> int:
    """Join answers and agents: print the table, write it, the comments and who took part. Returns the exit code.

    Participants are numbered anew, at random, and ages and genders stand apart: whoever knows when somebody was there finds
    nothing of theirs.
    """
    require(args.db.is_file(), "--db", args.db, "is no file")
    query = (
        "SELECT participant, agent, verdict, position, file, why, age, gender FROM trials JOIN clips USING (clip) "
        "JOIN participants USING (participant) WHERE verdict IS NOT NULL ORDER BY participant, position"
    )
    try:
        with contextlib.closing(sqlite3.connect(f"{args.db.resolve().as_uri()}?mode=ro", uri=True)) as db:
            answers = db.execute(query).fetchall()
    except sqlite3.Error as error:
        raise UsageError(f"--db {args.db}: is no database of a study: {first_line(error)}") from None
    require(bool(answers), "--db", args.db, "holds no answers yet")
    rows, rng, people = count_verdicts(answers), random.SystemRandom(), {answer[0]: answer[6:] for answer in answers}
    numbers = dict(zip(people, rng.sample(range(1, len(people) + 1), len(people))))
    names = ("participant", "agent", "verdict", "position", "clip", "comment")
    answers = sorted(((numbers[who], *rest) for who, *rest in answers), key=lambda answer: (answer[0], answer[3]))
    comments = [{name: guarded(value) for name, value in zip(names, answer)} for answer in answers]
    about = [
        {"age": guarded(age), "gender": guarded(gender)}
        for age, gender in rng.sample(list(people.values()), len(people))
    ]
    try:
        args.export.mkdir(parents=True, exist_ok=True)
        write_csv(args.export / "identified_as_human.csv", rows)
        write_csv(args.export / "comments.csv", comments)
        write_csv(args.export / "participants.csv", about)
    except OSError as error:
        raise UsageError(f"--export {args.export}: cannot be written: {error.strerror}") from None
    print(f"{'agent':<24}identified as human      share and 95% interval   participants")
    for row in rows:
        share = f"{row['share']:.0%}  [{row['low']:.0%}, {row['high']:.0%}]"
        counts = f"{row['identified_as_human']} of {row['judged']}"
        print(f"{row['agent']:<24}{counts:>19}{share:>28}{row['participants']:>15}")
    return 0


# ---------------------------------------------------------------------------------------------------------------------
# The page
# ---------------------------------------------------------------------------------------------------------------------
MAX_BODY = 16_384  # bytes that a browser may send at once
MAX_COMMENT = 2_000  # characters
GENDERS = Literal["female", "male", "another"]


def allowed_hosts(host: str) -> set[str] | None:
    """Names by which browsers may call this server, against rebinding of foreign names; None: all."""
    host = host.lower()  # as browsers write it
    return None if host in ("0.0.0.0", "::") else {"127.0.0.1", "localhost", "[::1]", host, f"[{host}]"}


def video_response(content: bytes, asked: str | None):
    """A video, or the part of it that a Range header asks for; headers are the same for every clip of that size."""
    from fastapi import Response

    headers = {"Accept-Ranges": "bytes", "Cache-Control": "no-store"}
    match = re.fullmatch(r"bytes=(\d{1,12})-(\d{0,12})", asked or "")
    if match is None:
        return Response(content, media_type="video/mp4", headers=headers)
    first, last = int(match[1]), min(int(match[2] or len(content)), len(content) - 1)
    if first > last:
        return Response(status_code=416, headers={"Content-Range": f"bytes */{len(content)}"})
    headers["Content-Range"] = f"bytes {first}-{last}/{len(content)}"
    return Response(content[first : last + 1], 206, media_type="video/mp4", headers=headers)


def refused(method: str, headers, hosts: set[str] | None) -> tuple[int, str] | None:
    """Status and reason where a request is of a foreign host or page, or too large; None where it may go on."""
    host, origin = headers.get("host", ""), headers.get("origin")
    if hosts is not None and re.sub(r":\d+$", "", host) not in hosts:
        return 421, "unknown host"
    if origin is not None and origin.partition("://")[2] != host:
        return 403, "another site's page"
    length = headers.get("content-length", "0" if method in ("GET", "HEAD") else "")
    if "transfer-encoding" in headers or not length.isdecimal():
        return 411, "needs Content-Length"
    return (413, "too large") if int(length) > MAX_BODY else None


def about_study(args: Args, clips: list[Clip]) -> dict:
    """What the page tells a participant."""
    rules = args.videos / "rules.txt"
    return {
        "consent": None if args.consent is None else read_text(args.consent, "--consent"),
        "contact": args.contact,
        "rules": read_text(rules, "--videos") if rules.is_file() else "",
        "practice": (args.videos / "practice.mp4").is_file(),
        "clips": len({clip.agent for clip in clips}) * args.clips_per_agent,
        "seconds": round(describe_clip(clips[0].path.read_bytes())[0]),
    }


def make_app(args: Args, clips: list[Clip]):
    """The web application: a page, three requests of it, and the clips."""
    from fastapi import FastAPI, HTTPException, Request, Response
    from fastapi.exceptions import RequestValidationError
    from pydantic import BaseModel, Field

    app = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
    page, hosts = Path(__file__).with_suffix(".html").read_text(), allowed_hosts(args.host)
    paths = {clip.sha256: clip.path for clip in clips}
    practice = args.videos / "practice.mp4"
    about = about_study(args, clips)

    class Key(BaseModel):
        key: str = Field(pattern="^[0-9a-f]{32}$")

    class Person(Key):
        age: int | None = Field(default=None, ge=1, le=120)
        gender: GENDERS | None = None

    class Answer(Key):
        address: str = Field(max_length=64)
        verdict: Literal["human", "machine"]
        why: str = Field(default="", max_length=MAX_COMMENT)

    @app.exception_handler(RequestValidationError)
    def refuse(request: Request, error: RequestValidationError) -> Response:
        return Response("not understood", 422)  # without what was sent, which may have no encoding

    @app.middleware("http")
    async def guard(request: Request, call_next) -> Response:
        if (refusal := refused(request.method, request.headers, hosts)) is not None:
            return Response(refusal[1], refusal[0])
        response = await call_next(request)
        response.headers["X-Content-Type-Options"] = "nosniff"
        response.headers["Referrer-Policy"] = "no-referrer"
        return response

    @app.get("/")
    def show_page() -> Response:
        nonce = secrets.token_urlsafe(16)
        policy = "default-src 'none'; base-uri 'none'; frame-ancestors 'none'; form-action 'none'; "
        policy += "connect-src 'self'; media-src 'self' blob:; "
        policy += f"script-src 'nonce-{nonce}'; style-src 'nonce-{nonce}'"
        content = page.replace("{{nonce}}", nonce).replace("{{about}}", json.dumps(about).replace("<", "\\u003c"))
        headers = {"Content-Security-Policy": policy, "Cache-Control": "no-store"}
        return Response(content, media_type="text/html", headers=headers)

    def trial_of(key: str) -> dict:
        trial = next_trial(args.db, key)
        if trial is None:
            raise HTTPException(404, "unknown participant")
        return trial

    @app.post("/join")
    def take_part(person: Person) -> dict:
        join(args.db, person.key, person.age, person.gender, args.clips_per_agent)
        return trial_of(person.key)

    @app.post("/next")
    def go_on(person: Key) -> dict:
        return trial_of(person.key)

    @app.post("/answer")
    def answer(given: Answer) -> dict:
        if not note_answer(args.db, given.key, given.address, given.verdict, given.why):
            raise HTTPException(409, "not the clip that is shown")
        return trial_of(given.key)

    @app.get("/practice.mp4")
    def show_practice(request: Request) -> Response:
        if not about["practice"]:
            raise HTTPException(404)
        return video_response(practice.read_bytes(), request.headers.get("range"))

    @app.get("/clip/{address}")
    def show_clip(address: str, request: Request) -> Response:
        """The clip at an address; 503 where its file cannot be read, for which the page asks again."""
        sha256 = clip_file(args.db, address)
        if sha256 not in paths:
            raise HTTPException(404)
        try:
            content = paths[sha256].read_bytes()
        except OSError as error:
            where = f"{args.videos}: a clip cannot be read"  # which one would tell whoever leads the study
            print(f"error: --videos {where}: {error.strerror}", file=sys.stderr, flush=True)
            raise HTTPException(503, "cannot be read") from None
        return video_response(content, request.headers.get("range"))

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


def main(args: Args) -> int:
    """Cut clips, ask people, or count what they said. Returns the exit code."""
    args = complete_args(args)
    if args.prepare:
        return prepare(args)
    if args.export is not None:
        return export(args)
    clips = find_clips(args.videos, args.clips_per_agent)
    app, listener = make_app(args, clips), listen(args.host, args.port)
    lock_database(args.db)
    open_database(args.db, clips)
    serve(app, listener, args.host)
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
