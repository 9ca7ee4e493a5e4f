"""Each file runs alone with its own dependencies, and all lists of versions agree."""

import ast
import importlib
import re
import shlex
import shutil
import subprocess
import sys
import tomllib

import pytest
from conftest import ROOT, SMALL, run
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from test_copies import METHODS, TOOLS

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def script_metadata(source: str) -> dict:
    """The PEP 723 block of a script."""
    block = re.search(r"^# /// script\n((?:#.*\n)+?)# ///$", source, re.MULTILINE)
    return tomllib.loads("".join(line[2:] or "\n" for line in block[1].splitlines(keepends=True)))


def lock() -> dict[str, str]:
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    pins = (line.split("==") for line in lines if not line.startswith("#"))
    return {canonicalize_name(name): version.split(";")[0].strip() for name, version in pins}


@pytest.mark.parametrize("path", METHODS, ids=lambda path: path.name)
def test_script_metadata_agrees_with_the_project(path):
    metadata = script_metadata(path.read_text())
    assert metadata["requires-python"] == PROJECT["project"]["requires-python"]
    without_extras = {line.replace("[mujoco]", "") for line in PROJECT["project"]["dependencies"]}
    pages = PROJECT["dependency-groups"]["study"] if path in TOOLS else []
    assert set(metadata["dependencies"]) <= {*PROJECT["project"]["dependencies"], *without_extras, *pages}


def test_lock_satisfies_the_project():
    pins = lock()
    groups = PROJECT["dependency-groups"]
    named = [line for group in groups.values() for line in group if isinstance(line, str)]
    for line in PROJECT["project"]["dependencies"] + named:
        requirement = Requirement(line)
        assert requirement.specifier.contains(pins[canonicalize_name(requirement.name)]), line


def test_lock_has_no_addresses():
    text = (ROOT / "requirements.lock").read_text()
    assert "://" not in text and "--index" not in text and "--find-links" not in text


def test_copied_alone_into_an_empty_folder(tmp_path, small_run):
    for path in METHODS:
        shutil.copy(path, tmp_path / path.name)
    run(*SMALL, "--run-dir", "run", cwd=tmp_path, script=tmp_path / "ppo_continuous_kle.py", PYTHONSAFEPATH="1")
    assert (tmp_path / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


def test_package_is_importable_from_anywhere(tmp_path):
    code = "import gymnasium; print(gymnasium.make('cleanrl_thesis.ppo_continuous_kle:kle/Thrower-v2').spec.id)"
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True)
    assert done.stdout == "kle/Thrower-v2\n", done.stderr


def anchors(page: str) -> set[str]:
    """What GitHub makes of a page's headings to link to."""
    titles = re.findall(r"^#+ (.*)$", page, re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", ["README.md", "benchmark/results/README.md"])
def test_every_link_leads_somewhere(page):
    text = (ROOT / page).read_text()
    for target, anchor in re.findall(r"\]\(([^)#]*)#?([^)]*)\)", text):
        assert "://" in target or ((ROOT / page).parent / target).exists(), target
        if anchor:
            assert anchor in anchors((((ROOT / page).parent / target) if target else ROOT / page).read_text()), anchor


def example_commands() -> list[str]:
    """`NAME.py FLAGS` of every command that the README or a method's docstring shows."""
    texts = [(ROOT / "README.md").read_text(), *(ast.get_docstring(ast.parse(path.read_text())) for path in METHODS)]
    lines = [line.split("#")[0].strip() for text in texts for line in text.splitlines()]
    found = [re.fullmatch(r"(?:uv run|python) cleanrl_thesis/(\w+\.py.*)", line) for line in lines]
    return sorted({match[1] for match in found if match})


@pytest.mark.parametrize("command", example_commands())
def test_every_command_that_is_shown_is_understood(command):
    script, *flags = shlex.split(command)
    method = importlib.import_module(f"cleanrl_thesis.{script.removesuffix('.py')}")
    assert "--help" in flags or isinstance(method.parse_args(flags), method.Args)
