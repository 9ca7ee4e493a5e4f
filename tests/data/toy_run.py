"""A run as the sweep knows it, in milliseconds: counts to --total, notes each step, locks its folder, can be stopped."""

import argparse
import fcntl
import json
import os
import signal
import sys
import time
from pathlib import Path

parser = argparse.ArgumentParser()
parser.add_argument("--env-id", choices=["A-v0", "B-v0"])
for name, value in {"--seed": 1, "--total": 20, "--stop-at": 10**9, "--crash-at": -1, "--bonus": 0}.items():
    parser.add_argument(name, type=int, default=value)
parser.add_argument("--run-dir", type=Path)
parser.add_argument("--resume", action="store_true")
parser.add_argument("--double", action="store_true")
args = parser.parse_args()
args.run_dir.mkdir(parents=True, exist_ok=True)
lock = os.open(args.run_dir, os.O_RDONLY)
try:
    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
except OSError:
    print(f"error: --run-dir {args.run_dir}: another process is running in it")
    sys.exit(2)
stop = []
signal.signal(signal.SIGTERM, lambda number, frame: stop.append(number))
record = args.run_dir / "steps.txt"
step = record.read_text().count("\n") if record.exists() else 0
last = min(args.total, args.stop_at)
while step < last:
    time.sleep(0.01)
    step += 1
    with open(record, "a") as file:
        file.write(f"{step} {(step + args.bonus) * (2 if args.double else 1)}\n")
    if step == args.crash_at:
        os.abort()
    if stop:
        sys.exit(128 + stop[0])
with open(args.run_dir / "ends.txt", "a") as file:
    file.write(f"{step}\n")
result = {"global_step": step, "complete": step == args.total, "training_seconds": 0.01 * step}
draft = args.run_dir / "result.tmp"
draft.write_text(json.dumps(result))
draft.replace(args.run_dir / "result.json")
