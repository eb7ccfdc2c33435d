"""Every public name has an example in its docstring, which runs and gives what it shows."""

import doctest
import inspect

import numpy as np
import pytest

import skylamp as sl

NAMES = [
    name
    for name in sl.__all__
    if not (inspect.isclass(getattr(sl, name)) and issubclass(getattr(sl, name), Exception))
]
NEEDS = {"SkyOverTime": "pvlib", "sky_over_time": "pvlib", "sun_position": "pvlib"}


@pytest.mark.parametrize("name", NAMES)
def test_the_example_of_a_public_name_runs(name):
    """With numpy as np and skylamp as sl."""
    pytest.importorskip(NEEDS.get(name, "numpy"))
    text = inspect.getdoc(getattr(sl, name))
    test = doctest.DocTestParser().get_doctest(text, {"np": np, "sl": sl}, name, None, None)
    assert test.examples, f"{name} has no example"
    said = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    runner.run(test, out=said.append)
    assert not runner.failures, "".join(said)
