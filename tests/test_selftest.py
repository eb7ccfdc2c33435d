"""skylamp selftest passes on this machine, and is red where one backend differs or fails."""

import itertools
import json
from dataclasses import replace

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
    checked = {(c["name"], c["backend"]) for c in facts["checks"]}
    assert checked == {(check, name) for check in selftest.CHECKS for name in names}
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

    monkeypatch.setattr(selftest, "CHECKS", {})
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


@pytest.mark.filterwarnings("error")
def test_tiles_of_the_test_itself_warn_nobody(fast):
    """What their far ground adds is what is measured."""
    selftest.CHECKS["seam of tiles"][0](fast)
    next(case for case in selftest.cases() if "tiles" in case.name).make(fast)


WRONG = {  # a result that is wrong by so little, and the check that tells
    "render": (
        lambda out: replace(out, image=out.image * np.float32(1.01)),
        "plane under a sky, closed form",
    ),
    "sky_view_factor": (lambda svf: svf + np.float32(0.01), "floor of a trench, closed form"),
    "visibility": (lambda bits: bits ^ np.uint32(1), "visibility bits, brute force"),
    "recover": (lambda out: replace(out, depth=out.depth + 0.2), "depth from an image [nodes, RMS]"),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", WRONG)
def test_a_wrong_result_is_told(name, fast, monkeypatch):
    """A right one passes, one that is slightly wrong does not."""
    spoil, check = WRONG[name]
    made, bound = selftest.CHECKS[check]
    assert made(fast) <= bound
    right = getattr(selftest, name)
    monkeypatch.setattr(selftest, name, lambda *a, **more: spoil(right(*a, **more)))
    assert not selftest.Check(check, fast, made(fast), bound).passed


def test_a_check_that_fails_or_raises_is_exit_1(capsys, monkeypatch):
    """It says which, on a line of its own with figure and bound, and goes on to the next."""

    def lost(backend):
        raise BackendError("lost the device")

    checks = {"too far": (lambda backend: 0.5, 0.25), "lost": (lost, 1.0), "fine": (lambda backend: 0.0, 0.0)}
    monkeypatch.setattr(selftest, "CHECKS", checks)
    monkeypatch.setattr(selftest, "cases", lambda: [])
    code, out, err = run(capsys)
    assert code == 1 and "lost the device" in err
    line = next(line for line in out.splitlines() if "too far" in line)
    assert "5.0e-01  WRONG" in line and "2e-01" in line and "numpy" in out
    code, out, err = run(capsys, "--json")
    found = [c for c in json.loads(out)["checks"] if c["backend"] == "numpy"]
    assert [c["passed"] for c in found] == [False, False, True]
    monkeypatch.setattr(selftest, "CHECKS", {"fine": checks["fine"]})
    assert run(capsys)[0] == 0


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
