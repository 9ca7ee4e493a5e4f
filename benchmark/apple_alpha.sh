#!/usr/bin/env bash
# The Apple game: a teacher for each seed, students over α and T, other states and splits, and students of a human who is
# nearer to the DQN ("quick"); the runs behind benchmark/results/apple/.
# After an interruption, run the same command again. Two runs at a time: about 3 hours on 2 cores.
#   benchmark/apple_alpha.sh
#   SEEDS="1" WORKERS=1 benchmark/apple_alpha.sh
#   WORKERS=50 SLURM=benchmark/slurm_template.sh benchmark/apple_alpha.sh     on a cluster; again when the teachers are done, and for the report
set -euo pipefail
cd "$(dirname "$0")/.."
SEEDS=${SEEDS:-1 2 3 4 5} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/apple}
ALPHAS=${ALPHAS:-0.93 1.0 0.0 0.5 0.8 0.9 0.7 0.6 0.4 0.3 0.2 0.1}
OTHER_ALPHAS=${OTHER_ALPHAS:-0.93 1.0 0.5 0.7 0.8 0.3 0.9}
. benchmark/sweep_lines.sh  # sweep, end_unless_done
mkdir -p "$RUNS"
for seed in $SEEDS; do
  echo "teacher_seed$seed --seed $seed"
done | sweep teachers cleanrl_thesis/dqn_apple.py --compile --save-model || code=$?
end_unless_done
ready= missing=
for seed in $SEEDS; do
  if [ -e "$RUNS/teacher_seed$seed/result.json" ]; then ready="$ready $seed"; else missing="$missing $RUNS/teacher_seed$seed"; fi
done
[ -z "$missing" ] || echo "students wait for$missing"
if [ -z "$ready" ] || { [ -n "${SLURM:-}" ] && [ -n "$missing" ]; }; then exit "$code"; fi  # an array is queued once, for all
SEEDS=${ready# }
FEWER_SEEDS=${FEWER_SEEDS:-$(echo $SEEDS | cut -d " " -f 1-3)}
for seed in $SEEDS; do
  demos="$RUNS/quick_demos_seed$seed"
  [ -e "$demos/manifest.json" ] || "$PYTHON" benchmark/apple_players.py --seed "$seed" --demos "$demos"
done
student() {  # seed, α, name, more flags
  echo "$3_seed$1" --seed "$1" --teacher "$RUNS/teacher_seed$1" --alpha "$2" "${@:4}"
}
{
  for seed in $SEEDS; do
    for alpha in $ALPHAS; do student "$seed" "$alpha" "alpha$alpha"; done
  done
  for seed in $SEEDS; do
    for alpha in $OTHER_ALPHAS; do student "$seed" "$alpha" "T0.5_alpha$alpha" --temperature 0.5; done
    quick=(--demos "$RUNS/quick_demos_seed$seed")
    student "$seed" 0.0 quick_alpha0.0 "${quick[@]}"
    for temperature in 0.01 0.5; do
      for alpha in 0.93 1.0 0.5 0.7 0.8 0.3; do
        student "$seed" "$alpha" "quick_T${temperature}_alpha$alpha" --temperature "$temperature" "${quick[@]}"
      done
    done
    for alpha in 0.5 0.93 1.0; do student "$seed" "$alpha" "own_alpha$alpha" --states own; done
    for alpha in 0.0 0.93; do student "$seed" "$alpha" "episode_alpha$alpha" --split episode; done
  done
  for seed in $FEWER_SEEDS; do
    for temperature in 0 0.1 1 2; do
      for alpha in $OTHER_ALPHAS; do
        student "$seed" "$alpha" "T${temperature}_alpha$alpha" --temperature "$temperature"
      done
    done
  done
} | sweep students cleanrl_thesis/distill_hybrid.py --compile --save-model || code=$?
end_unless_done
"$PYTHON" benchmark/apple_report.py --runs "$RUNS"
exit "$code"
