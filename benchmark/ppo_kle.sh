#!/usr/bin/env bash
# The study of chapter 4: 11 tasks × K {4, 10, 20, 40, 80} × {plain, KLE-Stop and KLE-Rollback at five d_target} × 2 seeds,
# 1,210 runs. After an interruption, run the same command again; stages share their runs.
#   benchmark/ppo_kle.sh                                                         all 1,210, 2,000,000 steps each
#   STAGES="first targets seeds others" STOP_AT=500000 benchmark/ppo_kle.sh      351 of them, 108 with more seeds, 500,000 steps
#   STAGES="K10 K80" benchmark/ppo_kle.sh                                        72 of these to 2,000,000 steps
#   STAGES="K10 K80" START_SEED=5 NUM_SEEDS=1 benchmark/ppo_kle.sh               the same of seed 5, 36 runs
#   STAGES=cost STOP_AT=100000 WORKERS=1 RUNS=runs/ppo_kle_cost benchmark/ppo_kle.sh  22 short runs that time each task
#   SETTING=printed STAGES=first STOP_AT=500000 benchmark/ppo_kle.sh             Table 4.1 and section 4.3.2 to the letter
#   SETTING=modern STAGES=first STOP_AT=500000 benchmark/ppo_kle.sh              recommended for new work; both into folders of their own
#   WORKERS=200 SLURM=benchmark/slurm_template.sh benchmark/ppo_kle.sh           on a cluster, 200 runs at a time
set -euo pipefail
cd "$(dirname "$0")/.."
STAGES=${STAGES:-all} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} SETTING=${SETTING:-as-run}
exact="--kl-timing after-iteration --kl-estimator"
case $SETTING in  # by the table of ppo_continuous_kle.py; K and how to stop are the stage's
  as-run) flags= RUNS=${RUNS:-runs/ppo_kle} ;;
  printed) flags="--gae-lambda 0.97 --ent-coef 0.2 --init-gains 1 1 1 --value-learning-rate 3e-4 --norm-adv-scope batch --norm-divisor variance $exact exact-new-old --rollback policy" ;;
  modern) flags="--bootstrap-truncated $exact exact-old-new --kl-samples batch --rollback policy-moments" ;;
  *)
    echo "SETTING=$SETTING: must be as-run, printed or modern" >&2
    exit 2
    ;;
esac
RUNS=${RUNS:-runs/ppo_kle_$SETTING}
START_SEED=${START_SEED:-1} NUM_SEEDS=${NUM_SEEDS:-2}  # of K10 and K80
SIX=(kle/{HalfCheetah,Hopper,Walker2d,Swimmer,Reacher,InvertedPendulum}-v2)
FIVE=(kle/{Ant,Humanoid,Pusher,Striker,Thrower}-v2)
sweep() {  # name of the stage, then what differs
  "$PYTHON" benchmark/sweep.py --command "$PYTHON cleanrl_thesis/ppo_continuous_kle.py --compile --checkpoint-interval 200000 $flags" \
    --runs "$RUNS" --workers "$WORKERS" ${STOP_AT:+--stop-at "$STOP_AT"} ${SLURM:+--slurm-template-path "$SLURM"} --name "$@"
}
both() { for target in "$@"; do echo "kle-stop,d-target=$target" "kle-rollback,d-target=$target"; done; }
for stage in $STAGES; do
  case $stage in first | targets | seeds | others | K10 | K80 | all | cost) ;; *)
    echo "STAGES=$STAGES: must be of first, targets, seeds, others, K10, K80, all and cost" >&2
    exit 2
    ;;
  esac
done
code=0
for stage in $STAGES; do
  case $stage in
    first) sweep first --env-ids "${SIX[@]}" --num-seeds 2 --grid update-epochs=4,10,20,40,80 --variants none $(both 0.03) ;;
    targets) sweep targets --env-ids "${SIX[@]}" --num-seeds 2 --grid update-epochs=10,80 --variants $(both 0.015 0.05) ;;
    seeds) sweep seeds --env-ids "${SIX[@]}" --start-seed 3 --num-seeds 3 --grid update-epochs=10,80 --variants none $(both 0.03) ;;
    others) sweep others --env-ids "${FIVE[@]}" --num-seeds 1 --grid update-epochs=4,10,20,40,80 --variants none $(both 0.03) ;;
    K10 | K80) sweep "$stage-seeds$START_SEED-$((START_SEED + NUM_SEEDS - 1))" --env-ids "${SIX[@]}" --start-seed "$START_SEED" \
      --num-seeds "$NUM_SEEDS" --grid "update-epochs=${stage#K}" --variants none $(both 0.03) ;;
    cost) sweep cost --env-ids "${SIX[@]}" "${FIVE[@]}" --num-seeds 1 --grid update-epochs=10,80 ;;
    all) sweep all --env-ids "${SIX[@]}" "${FIVE[@]}" --num-seeds 2 --grid update-epochs=4,10,20,40,80 \
      --variants none $(both 0.015 0.02 0.025 0.03 0.05) ;;
  esac || code=$?
  if [ "$code" -gt 1 ]; then break; fi  # failed runs, code 1, do not keep the next stage from starting
done
exit "$code"
