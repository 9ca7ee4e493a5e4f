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
# Two minutes before the time is up, Slurm sends USR1: the run writes a checkpoint and ends, and the task queues again.
lines=({{lines}})
requeue() {
  kill -USR1 "$run" && wait "$run"
  scontrol requeue "${SLURM_ARRAY_JOB_ID}_${SLURM_ARRAY_TASK_ID}"
  exit 0
}
trap requeue USR1
{{command}} "${lines[$SLURM_ARRAY_TASK_ID]}" &
run=$!
wait "$run"
