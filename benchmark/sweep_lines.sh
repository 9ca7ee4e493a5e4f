# What the studies here share; they read it, and set PYTHON, RUNS, WORKERS and on a cluster SLURM.
code=0
sweep() {  # name, then the words that all its runs share; on standard input a line for each: its folder's name and its own flags
  "$PYTHON" benchmark/sweep.py --lines - --runs "$RUNS" --workers "$WORKERS" ${SLURM:+--slurm-template-path "$SLURM"} --name "$1" --command "$(printf "%q " "$PYTHON" "${@:2}")"
}
