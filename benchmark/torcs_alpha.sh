#!/usr/bin/env bash
# The driving task: DDPG experts (45 minutes each), the first of which the students learn from; hybrids over α (4 minutes
# each), more seeds of those in Table 2.3, hybrids with one thing otherwise, and clones of the drivers' actions alone: the
# runs behind benchmark/results/torcs/. After an interruption, run the same command again. An expert takes 0.9 GB of disk.
#   benchmark/torcs_alpha.sh
#   SEEDS="1" MORE_SEEDS="" ALPHAS="0.5" WORKERS=1 OUT=runs/first_look benchmark/torcs_alpha.sh
#   WORKERS=50 SLURM=benchmark/slurm_template.sh benchmark/torcs_alpha.sh     on a cluster; again when the experts are done, and for the report
set -euo pipefail
cd "$(dirname "$0")/.."
EXPERTS=${EXPERTS:-1 2} SEEDS=${SEEDS:-1 2 3} MORE_SEEDS=${MORE_SEEDS-4 5} WORKERS=${WORKERS:-2} PYTHON=${PYTHON:-.venv/bin/python} RUNS=${RUNS:-runs/torcs}
OUT=${OUT:-benchmark/results/torcs}
ALPHAS=${ALPHAS:-0.5 0.0 1.0 0.7 0.3 0.9 0.1 0.8 0.2 0.6 0.4}
MIXED=${MIXED:-0.5 0.0 1.0}
. benchmark/sweep_lines.sh  # sweep, end_unless_done
mkdir -p "$RUNS"
for seed in $EXPERTS; do
  echo "expert_seed$seed --seed $seed"
done | sweep experts cleanrl_thesis/ddpg_torcs_like.py --compile --save-model --save-demos 220 || code=$?
end_unless_done
[ -e "$RUNS/expert_seed${EXPERTS%% *}/result.json" ] || { echo "the students wait for $RUNS/expert_seed${EXPERTS%% *}"; exit "$code"; }
for seed in $SEEDS $MORE_SEEDS; do
  human="$RUNS/human_seed$seed"
  [ -e "$human/manifest.json" ] || "$PYTHON" benchmark/torcs_players.py --seed "$seed" --demos "$human"
done
student() {  # seed, α, name, more flags
  echo "$3_seed$1" --seed "$1" --alpha "$2" --demos-rl "$RUNS/expert_seed${EXPERTS%% *}/demos" --demos-human "$RUNS/human_seed$1" "${@:4}"
}
{
  for alpha in $MIXED; do
    for seed in $SEEDS; do student "$seed" "$alpha" "mix_alpha$alpha" --total-timesteps 0 --bc-epochs 20; done
  done
  for alpha in $ALPHAS; do
    for seed in $SEEDS; do student "$seed" "$alpha" "alpha$alpha"; done
  done
  for seed in $MORE_SEEDS; do
    for alpha in 0.5 0.0; do student "$seed" "$alpha" "alpha$alpha"; done
    student "$seed" 0.5 mix_alpha0.5 --total-timesteps 0 --bc-epochs 20
  done
  for seed in $SEEDS; do
    student "$seed" 0.5 penalty0_alpha0.5 --d-grad-penalty 0
    student "$seed" 0.5 bc0_alpha0.5 --bc-epochs 0
    student "$seed" 0.5 noanneal_alpha0.5 --no-anneal-kl
    student "$seed" 0.5 fisher1_alpha0.5 --fisher-every 1
  done
} | sweep students cleanrl_thesis/gail_hybrid.py --save-model --save-demos 20 --eval-episodes 100 || code=$?
end_unless_done
"$PYTHON" benchmark/torcs_report.py --runs "$RUNS" --expert "${EXPERTS%% *}" --out "$OUT"
exit "$code"
