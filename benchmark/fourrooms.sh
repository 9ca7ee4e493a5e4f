#!/usr/bin/env bash
# Dreamer, HWM Dreamer and HWM HRL Dreamer in FourRooms, and both HWM agents with segments of a fixed length: the runs behind
# benchmark/results/dreamer/. Can be sent again after every stop.
#   benchmark/fourrooms.sh
#   STEPS=300000 SEEDS="1 2" AGENTS="dreamer hwm" WORKERS=2 benchmark/fourrooms.sh     the first 300,000 steps
#   SIZE=thesis FLAGS="--cuda --compile" WORKERS=1 benchmark/fourrooms.sh
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3 4} AGENTS=${AGENTS:-dreamer hwm hrl hwm_fixed hrl_fixed} SIZE=${SIZE:-xs} ENV_ID=${ENV_ID:-FourRooms11-v0}
WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/dreamer_$SIZE} FLAGS=${FLAGS-} INTERVAL=${INTERVAL:-8}
for agent in $AGENTS; do
  case $agent in dreamer | hwm | hrl | hwm_fixed | hrl_fixed) ;; *)
    echo "AGENTS=$AGENTS: must be of dreamer, hwm, hrl, hwm_fixed and hrl_fixed" >&2
    exit 2
    ;;
  esac
done
mkdir -p "$RUNS"
for seed in $SEEDS; do
  for agent in $AGENTS; do
    case $agent in
      dreamer) script=dreamer_v2 own="" ;;
      hwm) script=hwm_dreamer own="" ;;
      hrl) script=hwm_hrl_dreamer own="" ;;
      hwm_fixed) script=hwm_dreamer own="--fixed-interval $INTERVAL" ;;
      hrl_fixed) script=hwm_hrl_dreamer own="--fixed-interval $INTERVAL" ;;
    esac
    echo cleanrl_thesis/$script.py --env-id "$ENV_ID" --size "$SIZE" --seed "$seed" ${STEPS:+--stop-at "$STEPS"} \
      --run-dir "$RUNS/${agent}_seed$seed" $own $FLAGS
  done
done | xargs -P "$WORKERS" -L 1 sh -c '"$0" "$@" --resume' "$PYTHON"
"$PYTHON" benchmark/dreamer_report.py --runs "$RUNS"
