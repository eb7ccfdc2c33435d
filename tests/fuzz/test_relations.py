"""A few generated cases of every relation; performance/campaign.py takes thousands."""

import pytest
from fuzz import relations
from hypothesis import given, settings


def holds(name, backend, count):
    """Cases are those of hypothesis' own seed: the same in every run."""
    relation = relations.RELATIONS[name]

    @settings(max_examples=count)
    @given(relation.strategy)
    def check(case):
        relation.check(case, backend)

    check()


@pytest.mark.slow
@pytest.mark.parametrize("name", relations.RELATIONS)
def test_relations_hold_of_a_few_cases(fast, name):
    """On one backend."""
    holds(name, fast, 3)


@pytest.mark.slow
@pytest.mark.parametrize("name", relations.RELATIONS)
def test_relations_hold(backend, name):
    """On every backend."""
    holds(name, backend, 4)


def test_relations_can_fail(fast, monkeypatch):
    """An image that is wrong by a hundredth at one node breaks each relation that compares two."""
    whole, calls = relations.rendered, []

    def wrong(case, *args, **more):
        out = whole(case, *args, **more)
        image = out.image.copy()
        calls.append(1)
        image[0, 0] *= 1 + 0.5 * (len(calls) % 2)
        return relations.Shown(image, out.warnings)

    monkeypatch.setattr(relations, "rendered", wrong)
    case = relations.Case(how={"method": "horizon", "azimuths": 8})
    for check in (
        relations.mirrored_maps_have_mirrored_images,
        relations.transposed_maps_have_transposed_images,
        relations.the_unit_of_length_is_free,
        relations.only_differences_of_height_count,
        relations.the_type_and_layout_of_arrays_are_free,
        relations.backends_agree,
    ):
        with pytest.raises(AssertionError):
            check(case, fast)
