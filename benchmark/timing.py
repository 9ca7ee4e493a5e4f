"""What the scripts of the peers share."""

import json
import time


def timed(model, warm_up: int, steps: int) -> float:
    """Steps per second of a Stable-Baselines3 model over `steps` steps, after some that are not timed."""
    model.learn(warm_up)
    start = time.perf_counter()
    model.learn(steps, reset_num_timesteps=False)
    return steps / (time.perf_counter() - start)


def report(steps_per_second: float, **more) -> None:
    """Print the figures as `speed.py` reads them."""
    print(json.dumps({"steps_per_second": steps_per_second, **more}))
