#!/usr/bin/env bash
# Dreamer, HWM Dreamer and HWM HRL Dreamer in FourRooms, and both HWM agents with segments of a fixed length; and dreamer_*, the
# baseline without one of the things that it needs: the runs behind benchmark/results/dreamer/. After an interruption, run the same command again.
#   benchmark/fourrooms.sh
#   STEPS=1100000 SEEDS="1 2" AGENTS="dreamer hwm" WORKERS=2 benchmark/fourrooms.sh     the first 1,100,000 steps
#   STEPS=1060000 SEEDS=1 AGENTS="dreamer_sharp dreamer_slow dreamer_early dreamer_far dreamer_uniform dreamer_eps" benchmark/fourrooms.sh
#   SIZE=thesis FLAGS="--cuda --compile" WORKERS=1 benchmark/fourrooms.sh     on Slurm with a template of your own that asks for a GPU
#   WORKERS=20 SLURM=benchmark/slurm_template.sh benchmark/fourrooms.sh     on a cluster; again for the report
#   KNOWN=benchmark/results/dreamer/xs benchmark/fourrooms.sh    the report goes on from an earlier one whose run folders are gone
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3 4} AGENTS=${AGENTS:-dreamer hwm hrl hwm_fixed hrl_fixed} SIZE=${SIZE:-xs} ENV_ID=${ENV_ID:-FourRooms11-v0}
WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/dreamer_$SIZE} FLAGS=${FLAGS---compile}
INTERVAL=${INTERVAL:-4}
. benchmark/sweep_lines.sh  # sweep, end_unless_done
script() {  # AGENT: its file and its own flags
  case $1 in
    dreamer) echo dreamer_v2.py ;;
    dreamer_sharp) echo dreamer_v2.py --entropy-scale 0 ;;
    dreamer_slow) echo dreamer_v2.py --model-learning-rate 1e-3 ;;
    dreamer_early) echo dreamer_v2.py --prefill 200000 ;;
    dreamer_far) echo dreamer_v2.py --gamma 0.99 ;;
    dreamer_uniform) echo dreamer_v2.py --rewarded-share 0 ;;
    dreamer_eps) echo dreamer_v2.py --adam-eps 1e-5 ;;
    hwm) echo hwm_dreamer.py ;;
    hrl) echo hwm_hrl_dreamer.py ;;
    hwm_fixed) echo hwm_dreamer.py --fixed-interval "$INTERVAL" ;;
    hrl_fixed) echo hwm_hrl_dreamer.py --fixed-interval "$INTERVAL" ;;
    *) echo "AGENTS=$AGENTS: must be of dreamer, hwm, hrl, hwm_fixed, hrl_fixed, dreamer_{sharp,slow,early,far,uniform,eps}" >&2; exit 2 ;;
  esac
}
less_play() {  # AGENT: steps of random play at first that it has fewer than the others, and so in all
  case $1 in dreamer_early) echo 800000 ;; *) echo 0 ;; esac
}
for agent in $AGENTS; do
  script "$agent" >/dev/null
  less=$(less_play "$agent")
  [ -z "${STEPS:-}" ] || [ "$STEPS" -gt "$less" ] || { echo "STEPS=$STEPS: must be more than $less for $agent" >&2; exit 2; }
done
mkdir -p "$RUNS"
for seed in $SEEDS; do
  for agent in $AGENTS; do
    read -r file own <<<"$(script "$agent")"
    echo "${agent}_seed$seed" cleanrl_thesis/$file --env-id "$ENV_ID" --size "$SIZE" --seed "$seed" ${STEPS:+--stop-at $((STEPS - $(less_play "$agent")))} \
      $own $FLAGS
  done
done | sweep agents || code=$?
end_unless_done
"$PYTHON" benchmark/dreamer_report.py --runs "$RUNS" ${KNOWN:+--known "$KNOWN"}
exit "$code"
