#!/usr/bin/env bash
# Plain PPO, K = 10, as run, on six tasks: the runs behind benchmark/results/ppo_k10/. Can be sent again after every stop.
#   benchmark/ppo_k10.sh            seeds 1 and 2, two runs at a time
#   SEEDS="1 2 3 4 5" WORKERS=8 benchmark/ppo_k10.sh
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/ppo_k10}
mkdir -p "$RUNS"
for seed in $SEEDS; do
  for task in Hopper HalfCheetah Walker2d Swimmer Reacher InvertedPendulum; do
    echo "--env-id kle/$task-v2 --seed $seed --run-dir $RUNS/$task-v2__seed$seed"
  done
done | xargs -P "$WORKERS" -L 1 "$PYTHON" cleanrl_thesis/ppo_continuous_kle.py --compile --checkpoint-interval 200000 --resume
"$PYTHON" benchmark/ppo_k10_report.py --runs "$RUNS"
