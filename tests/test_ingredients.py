"""performance/recover_without.py switches off what it names."""

import sys
from pathlib import Path

import numpy as np
import pytest

sys.path.insert(0, str(Path(__file__).parents[1] / "performance"))
import recover_without


def test_every_ingredient_is_there():
    """What a patch replaces exists, and is something else than what replaces it."""
    for name, ingredient in recover_without.INGREDIENTS.items():
        assert ingredient.patches, name
        for place, attribute, value in ingredient.patches:
            assert getattr(place, attribute) != value, f"{name}: {attribute}"


@pytest.mark.slow
def test_doubt_without_each_of_its_parts(fast):
    """One recovery, judged without each part: the figures of depth are the same, those of confidence differ.

    Afterwards everything is as it was.
    """
    name = "five fractal sky"
    found = recover_without.run_with_all(name, fast)
    parts = {key for key, one in recover_without.INGREDIENTS.items() if one.effect == "confidence"}
    assert set(found) <= parts | {recover_without.ALL} and len(found) >= 6
    own = found[recover_without.ALL]
    case = recover_without.case_of(name)
    again = recover_without.run(case, fast)
    assert recover_without.figures(case, again.depth, again.confidence) == own
    for key, row in found.items():
        assert row["rmse"] == own["rmse"] and np.isfinite(list(row.values())).all()
        if key in ("finer model", "creases", "posterior deviation"):
            assert row["brier"] != own["brier"], key
