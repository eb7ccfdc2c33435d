"""README is short, its pictures are there, and its commands are those that CI runs; test_docs runs them."""

import re
from pathlib import Path

ROOT = Path(__file__).parent.parent
README = (ROOT / "README.md").read_text(encoding="utf-8")
BLOCKS = re.findall(r"^```python\n(.*?)^```", README, re.DOTALL | re.MULTILINE)


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
