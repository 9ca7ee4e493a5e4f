#!/usr/bin/env bash
#SBATCH --job-name={{name}}
#SBATCH --array={{array}}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --mem=2G
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:USR1@120
#SBATCH --output={{logs}}/slurm_%A_%a.log
# A task of a sweep. Two minutes before its time is up Slurm sends USR1: the run writes a checkpoint and queues again. After a
# crash it queues again too, up to {{retries}} times; a user's mistake (exit code 2) fails at once.
lines=({{lines}})
queue_again() {
  scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"
  exit 0
}
checkpoint() {
  kill -USR1 "$run" && wait "$run"
  queue_again
}
trap checkpoint USR1
{{command}} "${lines[$SLURM_ARRAY_TASK_ID]}" &
run=$!
wait "$run"
code=$?
if [ "$code" -ne 0 ] && [ "$code" -ne 2 ] && [ "${SLURM_RESTART_COUNT:-0}" -lt {{retries}} ]; then queue_again; fi
exit "$code"
