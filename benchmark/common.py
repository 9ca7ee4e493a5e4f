"""What the benchmarks share: how they start, published tables, results as CSV, and the commits that results rest on."""

import contextlib
import csv
import hashlib
import io
import json
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
    """Raise UsageError where a whole number is less than 1, or a seed less than 0."""
    for name, value in vars(args).items():
        least = 0 if name.endswith("seed") else 1
        if isinstance(value, int) and value < least:
            raise UsageError(f"--{name.replace('_', '-')} {value}: must be at least {least}")


def run_main(main: Callable, arguments: type, doc: str) -> None:
    """Run `main` with what the command line says; a wrong value is one line and exit code 2."""
    try:
        args = parse_args(arguments, doc)
        check_counts(args)
        main(args)
    except UsageError as error:
        print(f"error: {error}", file=sys.stderr)
        sys.exit(2)


def published_rows(name: str) -> list[dict[str, str]]:
    """A published table."""
    with open(ROOT / "benchmark" / "published" / name, newline="") as file:
        return list(csv.DictReader(file))


def published_table(name: str) -> dict[str, dict[str, str]]:
    """The rows of a published table by agent."""
    return {row["agent"]: row for row in published_rows(name)}


def finished_runs(folder: Path) -> Iterator[tuple[Path, dict]]:
    """The folder and the result of each run that came to the end of its schedule, in the order of their names."""
    for path in sorted(folder.glob("*/result.json")):
        result = json.loads(path.read_text())
        if result["complete"]:
            yield path.parent, result


def write_csv(path: Path, rows: list[dict]) -> None:
    """Write rows that have the same columns."""
    with open(path, "w", newline="") as file:
        writer = csv.DictWriter(file, rows[0], lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


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
