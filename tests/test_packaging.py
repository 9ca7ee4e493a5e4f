"""Each file runs alone with its own dependencies, and all lists of versions agree."""

import ast
import importlib
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

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


DISTRIBUTIONS = {
    "PIL": "pillow",
    "ale_py": "ale-py",
    "cv2": "opencv-python-headless",
    "imageio_ffmpeg": "imageio-ffmpeg",
}
DISTRIBUTIONS |= {"torch.utils.tensorboard": "tensorboard", "gymnasium.envs.mujoco": "mujoco"}
OPTIONAL = {
    "wandb": "--track says that it is missing",
    "moviepy": "--capture-video says that it is missing",
    "minari": "--export-minari says that it is missing",
    "pydantic": "comes with fastapi",
}


def distributions(source: str) -> tuple[set[str], set[str]]:
    """What has to be installed for the imports of a script: for those of the file, and for those within functions."""
    needed = set(), set()

    def look(node: ast.AST, inside: bool) -> None:
        modules = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
        modules += [node.module] if isinstance(node, ast.ImportFrom) else []
        for module in modules:
            packages = {name for part, name in DISTRIBUTIONS.items() if f"{module}.".startswith(f"{part}.")}
            packages.add(DISTRIBUTIONS.get(module.split(".")[0], module.split(".")[0]))
            needed[inside].update(packages - sys.stdlib_module_names)
        for child in ast.iter_child_nodes(node):
            look(child, inside or isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef))

    look(ast.parse(source), False)
    return needed


@pytest.mark.parametrize("path", METHODS, ids=lambda path: path.name)
def test_script_metadata_has_what_is_imported(path):
    """All of it but what is optional, and that within functions; a method's names nothing else."""
    source = path.read_text()
    block = {canonicalize_name(Requirement(line).name) for line in script_metadata(source)["dependencies"]}
    at_the_top, within = distributions(source)
    assert {"numpy", "tyro"} <= at_the_top <= block
    assert within <= block | OPTIONAL.keys()
    assert path in TOOLS or block <= at_the_top | within


def test_imports_are_found():
    source = (
        "import os.path, cv2\nif True:\n    from torch.utils.tensorboard import X\ndef f():\n    import wandb.sdk as w"
    )
    assert distributions(source) == ({"opencv-python-headless", "torch", "tensorboard"}, {"wandb"})


HELP = """
import os, runpy, sys
sys.modules["cleanrl_thesis"] = None  # which is installed here
for path in sys.argv[1:]:
    os.chdir(os.path.dirname(path))
    sys.argv = [path, "--help"]
    try:
        runpy.run_path(path, run_name="__main__")
    except SystemExit as end:
        print(os.path.basename(path), "ends with", end.code)
"""


def test_copied_alone_into_an_empty_folder(tmp_path, small_run):
    """Each file into a folder of its own, where it says how it is used and writes nothing; one of them trains, too."""
    copies = []
    for path in METHODS:
        (tmp_path / path.stem).mkdir()
        copies.append(shutil.copy(path, tmp_path / path.stem))
    line = [sys.executable, "-B", "-c", HELP, *copies]
    done = subprocess.run(line, cwd=tmp_path, env={**os.environ, "PYTHONSAFEPATH": "1"}, capture_output=True, text=True)
    ends = [line for line in done.stdout.splitlines() if " ends with " in line]
    assert ends == [f"{path.name} ends with 0" for path in METHODS], done.stdout + done.stderr
    assert done.stdout.count("--run-dir") >= len(METHODS) - len(TOOLS)
    assert sorted(tmp_path.glob("*/*")) == sorted(map(Path, copies))
    script = tmp_path / "ppo_continuous_kle" / "ppo_continuous_kle.py"
    run(*SMALL, "--run-dir", "run", cwd=script.parent, script=script, PYTHONSAFEPATH="1")
    assert (script.parent / "run" / "updates.csv").read_bytes() == (small_run / "updates.csv").read_bytes()


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
