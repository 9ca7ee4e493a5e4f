# What the studies here share; they read it, and set PYTHON, RUNS, WORKERS, on a cluster SLURM, and SLURM_MEMORY where 2G are too little.
code=0
sweep() {  # name, then the words that all its runs share; on standard input a line for each: its folder's name and its own flags
  "$PYTHON" benchmark/sweep.py --lines - --runs "$RUNS" --workers "$WORKERS" ${SLURM:+--slurm-template-path "$SLURM" --slurm-memory "${SLURM_MEMORY:-2G}" --queued-code 3} --name "$1" --command "$(printf "%q " "$PYTHON" "${@:2}")"
}
end_unless_done() {  # after failed runs, code 1, which are listed, what follows is of the others
  if [ "$code" = 3 ]; then
    echo "runs were queued; run the same command again when they are done"
    exit 0
  fi
  [ "$code" -le 1 ] || exit "$code"
}
