"""Series of the charts stay apart for people with each of the three kinds of colour blindness."""

import importlib.util
import subprocess
import sys
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from skylamp.app import chart

PATH = Path(__file__).parents[1] / "performance" / "stability.py"
spec = importlib.util.spec_from_file_location("stability_colours", PATH)
stability = importlib.util.module_from_spec(spec)
spec.loader.exec_module(stability)

# Machado, Oliveira and Fernandes (2009), "A physiologically-based model for simulation of color vision
# deficiency", severity 1, for linear RGB
SIMULATED = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
# IEC 61966-2-1, linear sRGB to XYZ, over the white point D65
XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]) / np.array(
    [[0.9505], [1.0], [1.089]]
)
APART = 12.0  # CIE 1976 difference; 2.3 is just noticeable, twice of this fails for Okabe and Ito's own set


def lab(colour, kind):
    """CIE L*a*b* of a colour "#rrggbb" as somebody with this kind of colour vision sees it."""
    srgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)]) / 255
    linear = np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
    x, y, z = np.cbrt(XYZ @ np.clip(SIMULATED[kind] @ linear, 1e-4, 1))
    return np.array([116 * y - 16, 500 * (x - y), 200 * (y - z)])


def nearest(colours, kind):
    """The least difference of two of the colours."""
    return min(np.linalg.norm(lab(a, kind) - lab(b, kind)) for a, b in combinations(set(colours), 2))


SERIES = {
    "speed and accuracy": [*chart.COLOURS.values(), chart.PEER_COLOUR],
    "stability": [stability.DEFAULT_COLOUR, stability.BAD_COLOUR, *stability.OTHER_COLOURS],
    "matrix": list(stability.STATES.values()),
}


@pytest.mark.parametrize("kind", SIMULATED)
@pytest.mark.parametrize("name", SERIES)
def test_series_stay_apart(name, kind):
    """Every pair of colours of a chart differs clearly in each kind of colour vision."""
    assert nearest(SERIES[name], kind) > APART


def test_red_and_green_fall_together_in_the_simulation():
    """The test can fail: a red and a green of one lightness differ for normal vision alone."""
    pair = ["#b85c00", "#6c7e00"]
    assert nearest(pair, "normal") > 40 and nearest(pair, "deuteranopia") < APART


def test_packages_have_markers_of_their_own():
    """Peers that share a colour differ in their markers; the SVG gives the setting of a point on hover."""
    assert len(set(chart.MARKERS.values())) == len(chart.MARKERS)


def test_every_series_has_a_tested_colour():
    """The methods of all panels have colours in the set that is tested above; peers have one, too."""
    methods = {method for kind in chart.CLASSES for method, *_ in chart.settings(kind)}
    assert methods | {"robust", "paper", "peer Mitsuba 3"} <= set(chart.COLOURS)
    assert set(chart.TITLES) == {*chart.CLASSES, chart.INVERSE}


@pytest.mark.slow
def test_a_panel_is_measured_and_merged(fast, tmp_path):
    """speed_accuracy.py replaces the rows of a panel that is measured again, keeps others and draws all."""
    script = PATH.parent / "speed_accuracy.py"
    old = "class,size,backend,method,units,error,seconds,planning,again\n" + "".join(
        f"{kind},32,opencl:0:0,horizon,8,0.5,1,0,1\n" for kind in ("smooth", "window")
    )
    (tmp_path / "speed_accuracy.csv").write_text(old)
    words = "--out", tmp_path, "--quick", "--panels", "window", "--backends", fast, "--drawn", ""
    subprocess.run([sys.executable, script, *words], check=True, capture_output=True)
    lines = (tmp_path / "speed_accuracy.csv").read_text().splitlines()
    assert lines[0].startswith("# window: date: ")
    assert sum(line.startswith("smooth,") for line in lines) == 1
    window = [line for line in lines if line.startswith("window,")]
    assert len(window) > 10 and not any(",0.5,1" in line for line in window)
    assert "tolerance of 1.0%" in (tmp_path / "speed_accuracy.svg").read_text()


@pytest.mark.slow
def test_all_light_is_the_truth_of_the_bright_panel(fast):
    """Direct light alone stops at its error; within a tolerance all light is found."""
    rows = chart.measure([fast], (32,), kinds=("albedo",))
    error = lambda method, units: next(
        r["error"] for r in rows if (r["method"], r["units"]) == (method, units)
    )
    assert 0.1 < error("horizon", 64) < 0.3 and error("plan", 0.01) < 0.01


@pytest.mark.slow
def test_the_inverse_has_axes_of_its_own(tmp_path):
    """Its points are drawn whatever the size of the other maps; the best eps of the paper's is filled."""
    row = {"class": "smooth", "size": 512, "backend": "opencl", "method": "horizon", "units": 8, "best": 0}
    row |= {"error": 0.1, "seconds": 1.0, "surface": ""}
    other = {"class": chart.INVERSE, "size": 64, "surface": "bumps", "units": 0.02}
    rows = [row, {**row, **other, "method": "paper", "best": 1}, {**row, **other, "method": "robust"}]
    chart.draw(rows, tmp_path / "chart.svg")
    text = (tmp_path / "chart.svg").read_text()
    assert "bumps: the paper&#x27;s carving, eps 0.02 (the best) (opencl): 1 s, RMSE in layers 0.1" in text
    assert "bumps: the default (opencl): 1 s" in text


@pytest.mark.slow
def test_svg_has_the_setting_on_hover(tmp_path):
    """Every drawn point has a title with its method, its time and its error."""
    rows = [
        {"class": kind, "size": 64, "backend": "opencl:0:0", "method": "horizon", "units": units}
        | {"error": 0.1 / units, "seconds": units / 1000, "planning": 0.0}
        for kind in chart.CLASSES
        for units in (8, 16)
    ]
    rows.append({**rows[0], "method": "plan", "units": 0.01, "planning": 0.004})
    rows.append({**rows[0], "method": "peer rvt-py", "backend": "peer"})
    rows.append({**rows[0], "size": 32, "units": 99})
    chart.draw(rows, tmp_path / "chart.svg")
    text = (tmp_path / "chart.svg").read_text()
    assert text.count("<title>horizon, ") == 2 * len(chart.CLASSES) and "<title>horizon, 99" not in text
    assert "tolerance of 1.0%; planning is 50% of the time" in text and "<title>rvt-py, 8: 0.008 s" in text
