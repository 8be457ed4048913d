"""The import contracts of pyproject.toml, proved by planting what they forbid."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINTER = Path(sys.executable).with_name("lint-imports")


@pytest.fixture(scope="module")
def tree(tmp_path_factory):
    """The packages and their contracts, in a place where they may be spoilt."""
    folder = tmp_path_factory.mktemp("tree")
    shutil.copy(ROOT / "pyproject.toml", folder)
    for package in ("companion", "fdi", "sitl", "configs"):
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


def lint(folder):
    environment = os.environ | {"PYTHONPATH": str(folder)}
    done = subprocess.run([LINTER, "--no-cache"], cwd=folder, env=environment, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout


def test_the_tree_as_it_is_keeps_its_contracts(tree):
    code, said = lint(tree)
    assert code == 0, said


@pytest.mark.parametrize(
    ("file", "line", "contract"),
    [
        ("companion/core.py", "import time", "the pure half of companion reads no clock"),
        ("companion/align.py", "from companion import core", "companion is built in layers"),
        ("fdi/windows.py", "import scipy", "fdi imports none of the others"),
        ("sitl/wind.py", "import companion.errors", "sitl imports neither fdi nor companion"),
        ("sitl/parafoil/step.py", "import random", "in sitl only the clock and the server"),
        ("companion/recorder.py", "import numba", "the live path flies nothing"),
    ],
)
def test_what_is_forbidden_is_found(tree, file, line, contract):
    path = tree / file
    kept = path.read_text()
    path.write_text(kept + f"\n{line}\n")
    try:
        code, said = lint(tree)
    finally:
        path.write_text(kept)
    assert code != 0
    assert any(contract in told and "BROKEN" in told for told in said.splitlines()), said
