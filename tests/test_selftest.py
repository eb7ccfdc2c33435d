"""skylamp selftest passes on this machine, and is red where one backend differs or fails."""

import itertools
import json

import numpy as np
import pytest

import skylamp as sl
from skylamp.app import cli, selftest
from skylamp.errors import BackendError
from skylamp.light import propagation


def run(capsys, *arguments):
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        cli.main(["selftest", *arguments])
    return (ended.value.code or 0, *capsys.readouterr())


@pytest.mark.slow
def test_every_pair_agrees(capsys):
    """Every pair of backends on every case, the bits equal to the bit, and the cases are no dark pictures."""
    code, out, err = run(capsys, "--json")
    facts = json.loads(out)
    names = [b.name for b in sl.backends() if b.available]
    assert code == 0 and facts["passed"] is True and facts["backends"] == names, err
    got = {(c["case"], c["one"], c["other"]) for c in facts["comparisons"]}
    assert (
        got == {(case.name, *pair) for case in selftest.cases() for pair in itertools.combinations(names, 2)}
        and len(got) >= 18
    )
    assert all(c["difference"] == 0 for c in facts["comparisons"] if "bits" in c["case"])
    assert all(c["allowed"] <= 1e-5 for c in facts["comparisons"])
    for case in selftest.cases():
        values = case.make("numpy")
        assert np.unique(values).size > 100, case.name


def test_a_difference_is_exit_1(capsys, monkeypatch):
    """One bit of one backend, or a failure of it, makes it red and says which."""
    right = propagation.visibility

    def one_bit(engine, problem):
        bits = right(engine, problem)
        if engine.name == "warp:cpu":
            bits[3, 4, 0] ^= 1
        return bits

    monkeypatch.setattr(selftest, "cases", lambda every=selftest.cases: every()[:1])
    monkeypatch.setattr(propagation, "visibility", one_bit)
    code, out, err = run(capsys, "--json")
    wrong = {(c["one"], c["other"]) for c in json.loads(out)["comparisons"] if not c["passed"]}
    assert code == 1 and wrong and all("warp:cpu" in pair for pair in wrong)
    assert "DIFFERS" in run(capsys)[1]

    def fails(engine, problem):
        if engine.name == "warp:cpu":
            raise BackendError("lost the device")
        return right(engine, problem)

    monkeypatch.setattr(propagation, "visibility", fails)
    code, out, err = run(capsys)
    assert code == 1 and "failed" in out and "skylamp: warp:cpu: lost the device" in err


@pytest.mark.parametrize(
    "one, other, expected",
    [
        ([1.0, 2.0], [1.0, 2.0], 0),
        ([1.0, 2.0], [1.0, 2.2], 0.2 / 2.2),
        ([1.0, np.nan], [1.0, np.nan], 0),
        ([1.0, np.nan], [1.0, 2.0], np.inf),
        ([1.0, -np.inf], [1.0, np.inf], np.inf),
        ([np.nan, np.nan], [np.nan, np.nan], np.inf),
        ([1.0], [1.0, 1.0], np.inf),
        ([0.0], [0.0], 0),
    ],
)
def test_difference(one, other, expected):
    """NaN beside a number, other shapes and nothing but NaN never pass."""
    assert selftest.difference(np.array(one), np.array(other)) == pytest.approx(expected)


def test_difference_of_types_and_words():
    """Words count one by one; float64 is not float32."""
    words = np.arange(8, dtype=np.uint32)
    assert selftest.difference(words, words ^ np.uint32([0, 1, 0, 0, 0, 8, 0, 0])) == 0.25
    assert selftest.difference(np.ones(2), np.ones(2, np.float32)) == np.inf
    assert not selftest.Comparison("a", "b", "c", float("nan"), 1.0).passed
