"""The stability atlas (docs/evidence/stability.md): each failure is there in the method that has it.

In the default it is gone, or a warning names it.
"""

import importlib.util
from pathlib import Path

import pytest

PATH = Path(__file__).parents[1] / "performance" / "stability.py"
spec = importlib.util.spec_from_file_location("stability", PATH)
stability = importlib.util.module_from_spec(spec)
spec.loader.exec_module(stability)


def test_the_atlas_is_whole():
    """At least twelve failures, each with a section and a figure in the document."""
    assert len(stability.FAILURES) >= 12
    text = (PATH.parents[1] / "docs" / "evidence" / "stability.md").read_text()
    for name, failure in stability.FAILURES.items():
        assert f"## {failure.title}\n" in text
        assert (PATH.parents[1] / "docs" / f"stability-{name.replace(' ', '-')}.png").exists()
        assert failure.good or failure.warns, "nothing is done about it"


@pytest.mark.slow
@pytest.mark.parametrize("name", stability.FAILURES)
def test_the_failure_is_there_and_seen_to(fast, name):
    """Beyond the limit at the harmful value only; there the default is good, or a warning names it."""
    failure = stability.FAILURES[name]
    harmless, harmful = (failure.measure(value, fast) for value in failure.quick)
    assert harmless[failure.bad] <= failure.limit < harmful[failure.bad], (harmless, harmful)
    if failure.good:
        assert (
            harmful[failure.good] <= failure.limit and harmful[failure.good] < 0.5 * harmful[failure.bad]
        ), harmful
    if failure.warns:
        calm, loud = (failure.warns(value, fast) for value in failure.quick)
        assert any(text.startswith(failure.says) for text in loud), loud
        assert not any(text.startswith(failure.says) for text in calm), calm
