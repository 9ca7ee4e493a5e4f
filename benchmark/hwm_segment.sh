#!/usr/bin/env bash
# The hierarchical world model alone: episodes of PPO, then for each rung of the ladder against collapse a model for each seed;
# the runs behind benchmark/results/hwm_segment/. After an interruption, run the same command again.
#   benchmark/hwm_segment.sh
#   SEEDS="1" RUNGS="faithful narrow" benchmark/hwm_segment.sh
#   WORKERS=40 SLURM=benchmark/slurm_template.sh benchmark/hwm_segment.sh     on a cluster; again for the report
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3 4 5} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/hwm_segment}
RUNGS=${RUNGS:-narrow surprise faithful literal reset kl_w price no_budget wander} PLAYER=${PLAYER:-runs/fourrooms/11_seed1_early}
. benchmark/sweep_lines.sh  # sweep, end_unless_done
# rung (a): Eq. 3.3.1 to 3.3.7; (b), (c) and (d) change one thing of it
FAITHFUL="--no-w-reset --no-narrow-w --decoder-sees-h --decoder-sees-c --no-detach-kl-z --budget-price 0 --boundary-bound 0 --read-bias 0"
FAITHFUL+=" --stoch-w 16 --kl-m-scale 1 --max-segments 10"
lines=$(
  for rung in $RUNGS; do
    demos=$PLAYER/demos
    case $rung in
      narrow) flags="" ;;                                # (e) the default
      no_budget) flags="--budget-price 0" ;;             # (e) without the budget
      surprise)                                          # (g) reads drawn to where z is foretold from z
        flags="--kl-z-scale 1 --no-c-sees-w --surprise-price 4 --foretell-copies 0.1 --total-updates 5000 --budget-updates 3200 --compile"
        ;;
      faithful) flags="$FAITHFUL" ;;
      literal)                                           # (a) with all weights 1 and nothing forced; balanced halves are one KL
        flags="$FAITHFUL --kl-z-scale 2 --kl-w-scale 2 --kl-m-scale 2 --kl-balance 0.5 --image-scale 1 --red-scale 1"
        flags+=" --max-segment-length 0 --max-segments 0"
        ;;
      kl_w) flags="$FAITHFUL --kl-w-scale 1" ;;          # (b) a larger weight of KL_w
      reset) flags="$FAITHFUL --w-reset" ;;              # (c) w starts anew where z is read
      price) flags="$FAITHFUL --read-price 10" ;;        # (d) a price for each read
      wander)                                            # (f) trained on a player who wanders, measured on the other's episodes
        demos=$PLAYER/demos_noise_0.8
        flags="--heldout-demos $PLAYER/demos --budget 0.03 --narrow-std 0.3 --total-updates 3000 --chunk-length 64"
        flags+=" --batch-size 8 --max-segment-length 0"
        ;;
      *)
        echo "RUNGS=$RUNGS: must be of surprise, narrow, no_budget, faithful, literal, kl_w, reset, price and wander" >&2
        exit 2
        ;;
    esac
    for seed in $SEEDS; do
      echo "${rung}_seed$seed" --demos "$demos" --seed "$seed" $flags
    done
  done
)
record() {  # DEMOS flags...: episodes of the player stopped at 1,100,000 steps, unless they are there
  [ -e "$PLAYER/$1/manifest.json" ] || "$PYTHON" cleanrl_thesis/ppo_fourrooms.py --stop-at 1100000 --save-model \
    --run-dir "$PLAYER" --resume "${@:2}" >&2
}
mkdir -p "$RUNS"
record demos --save-demos 2300
case " $RUNGS " in *" wander "*) record demos_noise_0.8 --save-demos 500 --demo-noise 0.8 ;; esac
sweep models cleanrl_thesis/hwm_segment.py --save-model <<<"$lines" || code=$?
end_unless_done
"$PYTHON" benchmark/hwm_report.py --runs "$RUNS" ${KNOWN:+--known "$KNOWN"}
exit "$code"
