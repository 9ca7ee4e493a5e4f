#!/usr/bin/env bash
#SBATCH --job-name={{name}}
#SBATCH --array={{array}}
#SBATCH --ntasks=1
#SBATCH --cpus-per-task=1
#SBATCH --mem={{memory}}
#SBATCH --time=04:00:00
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --signal=B:USR1@120
#SBATCH --output={{logs}}/slurm_%A_%a.log
# A task of a sweep; a copy of this file may have other lines above, as --gres=gpu:1 for runs with --cuda. Two minutes before its time is up Slurm sends USR1: the run writes a checkpoint and queues again, as it
# does where an earlier process still holds its folder. After a crash it queues again up to {{retries}} times; a user's
# mistake (exit code 2) fails at once.
lines=({{lines}})
task="${SLURM_ARRAY_JOB_ID}_$SLURM_ARRAY_TASK_ID"
queue_again() { scontrol requeue "$task" && exit 0 || exit 1; }
checkpoint() {
  trap "" USR1  # Slurm may send it again, and a second one would end the run without a checkpoint
  kill -USR1 "$run"
  wait "$run"
  settle $?
}
settle() {  # the run's exit code
  case $1 in
    0) exit 0 ;;
    138) queue_again ;;
    2) tail -n 1 "{{logs}}/slurm_$task.log" | grep -q "another process is running" && sleep 10 && queue_again ;;
    *)
      echo "exit code $1" >>"{{logs}}/crashes_$task"
      [ "$(wc -l <"{{logs}}/crashes_$task")" -le {{retries}} ] && queue_again
      ;;
  esac
  exit "$1"
}
trap checkpoint USR1
{{command}} "${lines[$SLURM_ARRAY_TASK_ID]}" &
run=$!
wait "$run"
settle $?
