"""Gradient steps of a Dreamer, timed: steps per second, and milliseconds of the parts, as JSON.

python benchmark/dreamer_step.py dreamer_v2 xs
python benchmark/dreamer_step.py dreamer_v2 m --bf16
"""

import importlib
import json
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

SECONDS = 8.0  # of gradient steps, after the first two


def clock(work: Callable[[], object], times: int) -> float:
    """Milliseconds of one time, without the first."""
    work()
    begin = time.perf_counter()
    for _ in range(times):
        work()
    return 1_000 * (time.perf_counter() - begin) / times


def main(script: str, size: str, *flags: str) -> None:
    method = importlib.import_module(f"cleanrl_thesis.{script}")
    args = method.complete_args(method.parse_args(["--size", size, "--prefill", "5000", *flags]))
    torch.manual_seed(1)
    torch.set_num_threads(1)
    torch.set_flush_denormal(True)
    method.keep_freed_memory()
    device = torch.device("cuda" if args.cuda else "cpu")
    model = (method.WorldModel if script == "dreamer_v2" else method.HWM)(args, 3)
    method.set_frame_statistics(model, args)
    learner = method.Learner(args, model, device)
    with tempfile.TemporaryDirectory() as folder:
        replay = method.Replay(Path(folder) / "replay.dat", args)
        collector = method.Collector(args, replay, method.Player(learner, args.num_envs))
        collector.reset()
        for _ in range(args.prefill // args.num_envs):
            collector.step(randomly=True)
        if args.compile:
            method.compile_steps(learner, replay.example(device))
        step = clock(lambda: learner.update(replay.sample(device)), 2)
        steps = max(2, round(1_000 * SECONDS / step))
        step = clock(lambda: learner.update(replay.sample(device)), steps)
        data, few = replay.sample(device), max(1, steps // 8)

        def model_gradient() -> None:
            with learner.autocast():
                loss, _, _ = method.world_model_loss(model, data, 0)
            loss.backward()

        def behaviour_gradient() -> None:
            with learner.autocast():
                losses, _ = method.behaviour_loss(learner.behaviour, dream, args.gae_lambda, args.ent_coef)
            sum(losses.values()).backward()

        with learner.autocast(), torch.no_grad():
            frames = model.normalize(data.frames.flatten(0, 1))
            parts = {"sample": clock(lambda: replay.sample(device), few)}
            parts["encoder"] = clock(lambda: model.embedding(frames), few)
            parts["model, forward"] = clock(lambda: method.world_model_loss(model, data, 0), few)
            begins = learner.draw_starts(method.world_model_loss(model, data, 0)[1], data.terminals)
            dream = method.imagine(model, learner.behaviour, begins, args.horizon, args.gamma)
            parts["dream"] = clock(
                lambda: method.imagine(model, learner.behaviour, begins, args.horizon, args.gamma), few
            )
        parts["model, forward and backward"] = clock(model_gradient, few)
        parts["actor and critic, forward and backward"] = clock(behaviour_gradient, few)
    print(json.dumps({"steps_per_second": 1_000 / step, "milliseconds": parts}))


if __name__ == "__main__":
    main(*sys.argv[1:])
