#!/usr/bin/env bash
# Gopher: a teacher from pixels, students of it and of the synthetic human over α, and over T at two α, with controls, and a DQN of
# all the thesis' frames; the runs behind benchmark/results/gopher/. After an interruption, run the same command again. 10,010,000
# frames take about 3 hours of a core with bfloat16, 4 without (benchmark/results/speed/gopher.md), 7 of two cores without AVX-512,
# and 8 GB for the replay. The teacher has 4,000,000, where the other's games in training had 3,300 points, 0.61 of its last score.
#   benchmark/gopher_alpha.sh
#   SEEDS="1" WORKERS=1 FULL= benchmark/gopher_alpha.sh     without the DQN of all frames, of which nothing learns
#   THREADS=2 benchmark/gopher_alpha.sh     DQNs with both cores, where nothing else runs
#   WORKERS=50 SLURM=benchmark/slurm_template.sh benchmark/gopher_alpha.sh     students on a cluster; again for the report
#   ALPHAS=0.0 TEMPERATURES= CONTROL_SEEDS= FULL= TEACHER= benchmark/gopher_alpha.sh     the human's clones alone, which need no DQN
#   KNOWN=benchmark/results/gopher benchmark/gopher_alpha.sh     the reports go on from earlier ones whose run folders are gone
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/gopher}
OUT=${OUT:-benchmark/results/gopher} THREADS=${THREADS:-1} FULL=${FULL-$RUNS/full_seed1}
TEACHER=${TEACHER-$RUNS/teacher_seed1} TEACHER_FRAMES=${TEACHER_FRAMES:-4000000}
ALPHAS=${ALPHAS:-0.8 1.0 0.0 0.5 0.6 0.7 0.9 0.3 0.4 0.2 0.1}
TEMPERATURES=${TEMPERATURES-0.1 0} OTHER_ALPHAS=${OTHER_ALPHAS:-0.8 1.0}
CONTROL_SEEDS=${CONTROL_SEEDS-${SEEDS%% *}}
SLURM_MEMORY=${SLURM_MEMORY:-6G}  # a student holds 1.6 GB of frames, for a moment twice
. benchmark/sweep_lines.sh  # sweep, end_unless_done
mkdir -p "$RUNS"
dqn() {  # folder, frames
  # lives end episodes as in Baselines; targets of three steps stand for its prioritised replay; the rate falls, for the last network
  # is the teacher. Two threads only on an otherwise idle machine: waiting threads spin, and competing processes slow the run down.
  "$PYTHON" cleanrl_thesis/dqn_gopher.py --total-timesteps "$2" --life-loss-ends --n-step 3 --anneal-lr --bf16 \
    --num-threads "$THREADS" --save-model --eval-episodes 400 --run-dir "$1" --resume
}
[ -z "$TEACHER" ] || dqn "$TEACHER" "$TEACHER_FRAMES"
for seed in $CONTROL_SEEDS; do  # a human who reacts to what the student sees too
  demos="$RUNS/quick_demos_seed$seed"
  [ -e "$demos/manifest.json" ] || "$PYTHON" benchmark/gopher_players.py --seed "$seed" --demos "$demos"
done
student() {  # seed, α, name, more flags
  local teacher="--teacher $TEACHER"
  if [ "$2" = 0.0 ]; then teacher=; fi  # a clone of the human
  echo "$3_seed$1" --seed "$1" --alpha "$2" $teacher "${@:4}"
}
{
  for alpha in $ALPHAS; do
    for seed in $SEEDS; do student "$seed" "$alpha" "alpha$alpha"; done
  done
  for temperature in $TEMPERATURES; do
    for alpha in $OTHER_ALPHAS; do
      for seed in $SEEDS; do student "$seed" "$alpha" "T${temperature}_alpha$alpha" --temperature "$temperature"; done
    done
  done
  for seed in $CONTROL_SEEDS; do
    for alpha in 0.0 0.8; do
      student "$seed" "$alpha" "quick_alpha$alpha" --demos "$RUNS/quick_demos_seed$seed"
      student "$seed" "$alpha" "episode_alpha$alpha" --split episode
    done
  done
} | sweep students cleanrl_thesis/distill_hybrid.py --env-id ALE/Gopher-v5 --bf16 --compile --save-model || code=$?
end_unless_done
[ -z "$FULL" ] || dqn "$FULL" 10010000
"$PYTHON" benchmark/gopher_report.py --runs "$RUNS" --out "$OUT" ${KNOWN:+--known "$KNOWN"} ${NOTE:+--note "$NOTE"}
"$PYTHON" benchmark/gopher_likeness.py --runs "$RUNS" --out "$OUT" ${KNOWN:+--known "$KNOWN"}
exit "$code"
