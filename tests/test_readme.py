"""README is short, its pictures are there, and its commands are those that CI runs."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
SHELL = re.findall(r"^```sh\n(.*?)^```", README, re.DOTALL | re.MULTILINE)
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(SHELL)))
def test_shell_blocks_run(number, tmp_path):
    """Every command as written; installing and the suite itself are what .ci/run does."""
    command = re.sub(r"^(pip install [^&\n]*(&& )?)?(pytest -n 2$)?", "", SHELL[number], flags=re.MULTILINE)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", command],
        cwd=tmp_path,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr


def test_it_is_short():
    """At most 150 lines; each start is a block of at most twelve lines."""
    assert README.count("\n") <= 150
    assert len(BLOCKS) == 3 and all(block.count("\n") <= 12 for block in BLOCKS)


def test_pictures_are_there_and_small():
    """Every picture that the README shows is in the repository, under 500 KB."""
    pictures = re.findall(r"!\[[^\]]*\]\(([^)]+)\)|<img src=\"([^\"]+)\"", README)
    assert len(pictures) >= 4
    for picture in (ROOT / (a or b) for a, b in pictures):
        assert picture.is_file() and picture.stat().st_size < 500_000, picture


def test_test_command_is_what_ci_runs():
    """pip install '.[test]' && pytest -n 2, here and there."""
    assert "pip install '.[test]' && pytest -n 2\n" in README
    ci = (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    assert "'.[test]'\n" in ci and re.search(r"^timeout .* pytest -n 2( --durations=\d+)?$", ci, re.MULTILINE)
