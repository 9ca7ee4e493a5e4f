#!/usr/bin/env bash
# Gopher from the console's memory: the runs behind benchmark/results/gopher/ram.md. Can be sent again after every stop.
#   benchmark/gopher_ram.sh
#   SEEDS="1" WORKERS=1 benchmark/gopher_ram.sh
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/gopher_ram}
FLAGS="--obs-type ram --n-step 3 --life-loss-ends --anneal-lr --total-timesteps 2500000"
mkdir -p "$RUNS"
for seed in $SEEDS; do
  echo cleanrl_thesis/dqn_gopher.py $FLAGS --seed "$seed" --run-dir "$RUNS/seed$seed"
done | xargs -P "$WORKERS" -L 1 sh -c '"$0" "$@" --resume' "$PYTHON"
"$PYTHON" benchmark/gopher_ram.py --runs "$RUNS"
