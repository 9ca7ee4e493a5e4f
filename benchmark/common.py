"""What the benchmarks share: how they start, published tables, runs, results as CSV, and the commits that results rest on."""

import contextlib
import csv
import hashlib
import io
import json
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import tyro

ROOT = Path(__file__).resolve().parent.parent


class UsageError(Exception):
    """A wrong value, told in one line; the exit code is 2."""


def parse_args(arguments: type, doc: str):
    """What the command line says. Raises UsageError with one line where tyro prints a box."""
    complaint = io.StringIO()
    try:
        with contextlib.redirect_stderr(complaint):
            return tyro.cli(arguments, description=doc.split("\n\n")[0])
    except SystemExit as stop:
        if not stop.code:
            raise
        lines = [line.strip("│ ") for line in complaint.getvalue().splitlines()]
        message = " ".join(line for line in lines[1:] if line and line[0] not in "─╰").split("For full helptext")[0]
        raise UsageError(message.split("Argument helptext")[0].strip()) from None


def check_counts(args) -> None:
    """Raise UsageError where a whole number, or one of several, is less than 1, or a seed less than 0."""
    for name, value in vars(args).items():
        least = 0 if name.endswith("seed") else 1
        values = value if isinstance(value, tuple) else (value,)
        if any(type(each) is int and each < least for each in values):  # a flag is no number
            raise UsageError(f"--{name.replace('_', '-')} {' '.join(map(str, values))}: must be at least {least}")


def run_main(main: Callable, arguments: type, doc: str) -> None:
    """Run `main` with what the command line says; a wrong value is one line and exit code 2, a file in the way exit code 1."""
    try:
        args = parse_args(arguments, doc)
        check_counts(args)
        main(args)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)
    except OSError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(1)


def read_csv(path: Path) -> list[dict[str, str]]:
    """The rows of a CSV file by its columns."""
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def with_known(rows: list[dict], path: Path, run: tuple[str, ...], words: set[str]) -> list[dict]:
    """`rows`, and those of an earlier report that are of other runs, which the columns `run` tell apart.

    All columns of `path` but `words` hold numbers or nothing. Raises UsageError where it cannot be read.
    """
    try:
        known = read_csv(path)
    except OSError as error:
        raise UsageError(f"--known {path.parent}: {path.name} cannot be read: {error.strerror}") from None
    known = [{key: value if key in words else number(value) for key, value in row.items()} for row in known]
    have = {tuple(row[name] for name in run) for row in rows}
    return rows + [row for row in known if tuple(row[name] for name in run) not in have]


def number(text: str) -> int | float | str:
    """What a cell holds that is a number or empty."""
    return int(text) if text.isdigit() else float(text) if text else ""


def published_rows(name: str) -> list[dict[str, str]]:
    """A published table."""
    return read_csv(ROOT / "benchmark" / "published" / name)


def published_table(name: str) -> dict[str, dict[str, str]]:
    """The rows of a published table by agent."""
    return {row["agent"]: row for row in published_rows(name)}


def finished_runs(folder: Path) -> Iterator[tuple[Path, dict]]:
    """The folder and the result of each run that came to the end of its schedule, in the order of their names."""
    for path in sorted(folder.glob("*/result.json")):
        result = json.loads(path.read_text())
        if result["complete"]:
            yield path.parent, result


def read_args(run: Path) -> dict:
    """The arguments of a run."""
    return json.loads((run / "args.json").read_text())


def kind_of(run: Path) -> str:
    """The name of a run's folder without its seed; α as Python writes the number, whether the folder has 0, 0.0 or 0.00."""
    return re.sub(r"alpha[\d.]+$", f"alpha{read_args(run).get('alpha')}", re.sub(r"_seed\d+$", "", run.name))


def run_folders(folder: Path) -> dict[tuple[str, int], Path]:
    """The folders of finished runs by kind and seed."""
    return {(kind_of(run), result["seed"]): run for run, result in finished_runs(folder)}


def distinct(rows: list[dict], column: str) -> str:
    """The numbers in a column, each once."""
    return " or ".join(f"{number:,}" for number in sorted({row[column] for row in rows}))


def write_csv(path: Path, rows: list[dict]) -> None:
    """Write rows that have the same columns, all or nothing."""
    text = io.StringIO()
    writer = csv.DictWriter(text, rows[0], lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    draft = path.with_name(path.name + ".tmp")
    draft.write_text(text.getvalue())
    draft.replace(path)


def select(rows: list[dict], kind: str, mode: str) -> list[dict]:
    """The rows of one kind of run and one way to act."""
    return [row for row in rows if row["kind"] == kind and row["mode"] == mode]


def git(*words: str) -> str:
    return subprocess.run(["git", *words], cwd=ROOT, capture_output=True, text=True).stdout


def commit() -> str:
    """The commit that is checked out, with "-dirty" where a file differs from it that is not itself a result."""
    changed = git("status", "--porcelain", "--untracked-files=no", "--", ".", ":!benchmark/results")
    return git("describe", "--always").strip() + ("-dirty" if changed else "")


def commit_of(script: str, digest: str) -> str:
    """The newest commit whose script has this checksum."""
    path = f"cleanrl_thesis/{script}.py"
    commits = git("log", "--format=%h", "--", path).split()
    found = (c for c in commits if hashlib.sha256(git("show", f"{c}:{path}").encode()).hexdigest().startswith(digest))
    return next(found, "not recorded")


def made_at(rows: list[dict], scripts: dict[str, tuple[str, ...]]) -> str:
    """The commits of the scripts that made the rows, each of those whose kind holds one of its words."""
    found = []
    for script, words in scripts.items():
        digests = {row["script_sha256"] for row in rows if any(word in row["kind"] for word in words)}
        if digests:
            found.append(f"{script}.py at {', '.join(sorted(commit_of(script, digest) for digest in digests))}")
    return "; ".join(found)
