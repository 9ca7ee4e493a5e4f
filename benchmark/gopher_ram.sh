#!/usr/bin/env bash
# Gopher from the console's memory: the runs behind benchmark/results/gopher/ram.md. After an interruption, run the same command again.
#   benchmark/gopher_ram.sh
#   SEEDS="1" WORKERS=1 benchmark/gopher_ram.sh
#   WORKERS=3 SLURM=benchmark/slurm_template.sh benchmark/gopher_ram.sh     on a cluster; again for the report
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/gopher_ram}
FLAGS="--obs-type ram --n-step 3 --life-loss-ends --anneal-lr --total-timesteps 2500000"
. benchmark/sweep_lines.sh  # sweep, end_unless_done
mkdir -p "$RUNS"
for seed in $SEEDS; do
  echo "seed$seed" --seed "$seed"
done | sweep ram cleanrl_thesis/dqn_gopher.py $FLAGS || code=$?
end_unless_done
"$PYTHON" benchmark/gopher_ram.py --runs "$RUNS"
exit "$code"
