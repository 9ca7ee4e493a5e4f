"""What the tests share: small runs through the command line."""

import contextlib
import fcntl
import hashlib
import importlib
import io
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import threading
import time
import unittest.mock
from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch
import torch.nn.functional as F

ROOT = Path(__file__).resolve().parent.parent
SCRIPT = ROOT / "cleanrl_thesis" / "ppo_continuous_kle.py"
# 10 iterations of 256 steps, a checkpoint after each
SMALL = [
    *("--env-id", "Pendulum-v1", "--total-timesteps", "2560", "--num-steps", "256", "--num-minibatches", "8"),
    *("--update-epochs", "2", "--checkpoint-interval", "1", "--eval-episodes", "2"),
]
torch.set_num_threads(1)
NO_SKIPS = "CLEANRL_THESIS_NO_SKIPS" in os.environ  # .ci/run has installed Slurm and Chromium: they have to work
needs_compiler = pytest.mark.skipif(shutil.which("g++") is None, reason="needs a C++ compiler")


def command(*flags: object, script: Path = SCRIPT) -> list[str]:
    return [sys.executable, str(script), *map(str, flags)]


def run(
    *flags: object, cwd: Path, code: int = 0, script: Path = SCRIPT, **environment: str
) -> subprocess.CompletedProcess:
    """Run a script to its end and check its exit code.

    It runs within this process, for to start Python and PyTorch takes seconds; in one of its own where the script is a
    copy, is compiled, or needs environment variables, and beside others.
    """
    is_copy = script.parent != ROOT / "cleanrl_thesis"
    if is_copy or environment or "--compile" in flags or threading.current_thread() is not threading.main_thread():
        env, streams = {**os.environ, **environment}, {"capture_output": True, "text": True}
        done = subprocess.run(command(*flags, script=script), cwd=cwd, env=env, timeout=600, **streams)
    else:
        cli, out, err = importlib.import_module(f"cleanrl_thesis.{script.stem}").cli, io.StringIO(), io.StringIO()
        streams = contextlib.redirect_stdout(out), contextlib.redirect_stderr(err)
        with contextlib.chdir(cwd), streams[0], streams[1], as_a_process_of_its_own():
            returned = cli([str(flag) for flag in flags])
        done = subprocess.CompletedProcess(flags, returned, out.getvalue(), err.getvalue())
    assert done.returncode == code, f"exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
    return done


@contextlib.contextmanager
def as_a_process_of_its_own():
    """Take back what a script leaves to the end of its process.

    Run folders that are locked, denormals that are flushed, the number of threads, and what signals do.
    """
    threads = torch.get_num_threads()
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGUSR1)}
    with unittest.mock.patch.object(fcntl, "flock", side_effect=fcntl.flock) as flock:
        try:
            yield
        finally:
            for call in flock.call_args_list:
                os.close(call.args[0])
            torch.set_flush_denormal(False)
            torch.set_num_threads(threads)
            for number, handler in handlers.items():
                signal.signal(number, handler)


def ends_before_it_is_killed(process: subprocess.Popen, seconds: float) -> bool:
    """Kill a process after so many seconds; return whether it came to its end first."""
    try:
        process.wait(timeout=seconds)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
        return False
    return True


def modified(path: Path) -> int:
    try:
        return path.stat().st_mtime_ns
    except FileNotFoundError:  # not written yet, or a run has just moved it to make room for the next
        return 0


def kill_twice(
    flags: list,
    seconds: float,
    seed: int,
    script: Path = SCRIPT,
    after_checkpoints: bool = False,
    share: float | None = None,
) -> None:
    """Start a run that takes about `seconds`, kill it, resume it, and kill it again, both at random moments.

    With `after_checkpoints` these are within an interval or so of its next checkpoint (or within a given share of the
    seconds), but for the first kill of an odd seed, which comes before anything is saved.
    """
    rng, folder, kills = random.Random(seed), Path(flags[flags.index("--run-dir") + 1]), 0
    path, longest = folder / "checkpoint.pt", seconds * (share or (0.1 if after_checkpoints else 0.8))
    while kills < 2:
        early, before = after_checkpoints and kills == 0 and seed % 2 == 1, modified(path)
        line = command(*flags, "--resume", script=script)
        process = subprocess.Popen(line, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        while after_checkpoints and not early and process.poll() is None and modified(path) in (0, before):
            time.sleep(0.005)
        if ends_before_it_is_killed(process, rng.uniform(0.5, 3) if early else rng.uniform(0, longest)):
            shutil.rmtree(folder)
            kills, longest = 0, 0.7 * longest
        else:
            kills += 1


class Counter(gym.Env):
    """Observes its step; pays 1 a step and ends after 4, by a time-out in every second episode."""

    observation_space = gym.spaces.Box(-np.inf, np.inf, (1,), np.float32)
    action_space = gym.spaces.Box(-1, 1, (1,), np.float32)
    episodes = 0

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.step_number, self.episodes = 0, self.episodes + 1
        return np.zeros(1, np.float32), {}

    def step(self, action):
        self.step_number += 1
        over, times_out = self.step_number == 4, self.episodes % 2 == 0
        return np.full(1, self.step_number, np.float32), 1.0, over and not times_out, over and times_out, {}


class Moody(Counter):
    """Knows no render mode; its infos differ in kind and shape from copy to copy."""

    copies = 0

    def __init__(self):
        Moody.copies += 1
        self.number = Moody.copies

    def step(self, action):
        *rest, _ = super().step(action)
        return *rest, {"note": np.zeros(self.number) if self.number % 3 else None}


class DiscreteMoody(Moody):
    action_space = gym.spaces.Discrete(2)


@pytest.fixture
def moody():
    """Ids of the two, while the test runs."""
    for entry_point in (Moody, DiscreteMoody):
        gym.register(f"{entry_point.__name__}-v0", entry_point)
    yield "Moody-v0", "DiscreteMoody-v0"
    for name in ("Moody-v0", "DiscreteMoody-v0"):
        gym.registry.pop(name)


def assert_boundaries_follow_their_logits(model) -> None:
    """Drawn by Gumbel noise: each with the probability of its logit, and with the gradient of the soft sample."""
    torch.manual_seed(0)
    logits = torch.tensor([-2.0, 0.0, 1.5])[:, None].repeat(1, 50_000).requires_grad_()
    drawn = model.draw_m(logits, 0.5)
    assert set(drawn.detach().unique().tolist()) <= {0.0, 1.0}
    assert torch.allclose(drawn.mean(1), torch.sigmoid(logits[:, 0]), atol=0.01)
    gradient = torch.autograd.grad(drawn.sum(), logits)[0]
    assert (gradient >= 0).all() and (gradient > 0).float().mean() > 0.5


def beliefs_of_play(method, learner, path: Path, steps: int, *extra: float) -> tuple[list, list]:
    """What a player believed as it played, and what the model infers of the same records of the replay, with the same draws.

    `extra` is given to the model's `observe`. Two lists of states of the games, one for each step.
    """
    args, width, looks = learner.args, learner.model.noise(1).shape[-1], []
    learner.model.noise = lambda *shape: torch.full((*shape, width), 0.5)
    collector = method.Collector(args, method.Replay(path, args), method.Player(learner, args.num_envs))
    player, replay, observe = collector.player, collector.replay, collector.player.observe

    def look(frames, begins):
        observe(frames, begins)
        looks.append((replay.lengths - 1, player.state))

    player.observe = look
    collector.reset()
    for _ in range(steps):
        collector.step(randomly=False)
    inferred = []
    for row, length in zip(replay.rows, replay.lengths):
        records = row[:length]
        frames = replay.painter.draw(records["pose"].astype(np.intp), records["goal"].astype(np.intp))
        actions = F.one_hot(torch.from_numpy(records["action"].astype(np.int64)), 3).float()[:, None]
        first = torch.from_numpy(records["first"].astype(np.float32))[:, None]
        with torch.no_grad():
            embed = learner.model.embedding(learner.model.normalize(torch.from_numpy(frames)))[:, None]
            inferred.append(learner.model.observe(embed, actions, first, *extra)[0])
    assert sum((row["first"][:length] > 0).sum() for row, length in zip(replay.rows, replay.lengths)) > args.num_envs
    belief, wanted = [], []
    for places, state in looks:
        belief += [[part[game] for part in state] for game in range(args.num_envs)]
        wanted += [[part[place, 0] for part in inferred[game]] for game, place in enumerate(places)]
    return belief, wanted


def assert_same_run(left: Path, right: Path) -> None:
    """Same bytes in the records, same parameters and optimiser in the checkpoints."""
    for name in ("episodes.csv", "updates.csv", "evaluation.json"):
        assert (left / name).read_bytes() == (right / name).read_bytes(), name
    states = [torch.load(folder / "checkpoint.pt", weights_only=True) for folder in (left, right)]
    for name, value in states[0]["agent"].items():
        assert torch.equal(value, states[1]["agent"][name]), name
    for name, value in states[0]["optimizer"].items():
        assert torch.equal(value, states[1]["optimizer"][name]), name


@pytest.fixture(scope="session")
def small_run(tmp_path_factory) -> Path:
    """An undisturbed small run."""
    folder = tmp_path_factory.mktemp("small")
    run(*SMALL, "--run-dir", "run", "--save-model", "--save-demos", 2, cwd=folder)
    return folder / "run"


def assert_refused(module, capsys, flags: list, words: list[str]) -> None:
    """Exit code 2, one line on stderr with the words, nothing on stdout."""
    assert module.cli([str(flag) for flag in flags]) == 2
    out, err = capsys.readouterr()
    assert out == "" and err.count("\n") == 1 and err.startswith("error: "), err
    for word in words:
        assert word in err, err


def rewrite(folder: Path, change) -> None:
    """Change the arrays of the first demonstration and sign it anew."""
    path = folder / "episode_00000.npz"
    with np.load(path) as arrays:
        changed = change(dict(arrays))
    content = io.BytesIO()
    np.savez(content, **changed)
    path.write_bytes(content.getvalue())
    sign(folder, path)


def sign(folder: Path, path: Path) -> None:
    """Put the checksum of a file into the manifest."""
    digest = hashlib.sha256(path.read_bytes()).hexdigest()
    edit_manifest(folder, lambda manifest: manifest["files"].update({path.name: digest}))


def edit_manifest(folder: Path, change) -> None:
    manifest = json.loads((folder / "manifest.json").read_text())
    change(manifest)
    (folder / "manifest.json").write_text(json.dumps(manifest))


def flip_a_byte(folder: Path) -> None:
    path = folder / "episode_00000.npz"
    content = bytearray(path.read_bytes())
    content[len(content) // 2] ^= 1
    path.write_bytes(content)
