#!/usr/bin/env bash
# Plain PPO, K = 10, as run, on six tasks: the runs behind benchmark/results/ppo_k10/. After an interruption, run the same command again.
#   benchmark/ppo_k10.sh            seeds 1 and 2, two runs at a time
#   SEEDS="1 2 3 4 5" WORKERS=8 benchmark/ppo_k10.sh
#   WORKERS=8 SLURM=benchmark/slurm_template.sh benchmark/ppo_k10.sh     on a cluster; again for the report
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/ppo_k10}
. benchmark/sweep_lines.sh  # sweep, end_unless_done
mkdir -p "$RUNS"
for seed in $SEEDS; do
  for task in Hopper HalfCheetah Walker2d Swimmer Reacher InvertedPendulum; do
    echo "$task-v2__seed$seed" --env-id "kle/$task-v2" --seed "$seed"
  done
done | sweep k10 cleanrl_thesis/ppo_continuous_kle.py --compile --checkpoint-interval 200000 || code=$?
end_unless_done
"$PYTHON" benchmark/ppo_k10_report.py --runs "$RUNS"
exit "$code"
