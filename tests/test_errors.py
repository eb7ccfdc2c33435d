"""Bad input: one clear error each that says what was got and what is allowed; what an import does not do."""

import os
import pickle
import subprocess
import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import numpy as np
import pytest

import skylamp as sl
from skylamp.errors import BackendError, InputError, lacking

DEPTH = np.ones((4, 6))
NAN = np.where(np.arange(24).reshape(4, 6) == 9, np.nan, 1.0)
SCENE = sl.Scene(DEPTH)
SKY = sl.Sky()


def with_value(value, index=(1, 2)):
    out = DEPTH.copy()
    out[index] = value
    return out


SCENES = {
    "NaN without a mask": (
        lambda: sl.Scene(NAN),
        ["depth: 1 values are NaN or infinite", "(row, col) = (1, 3)", "mask=numpy.isfinite(depth)"],
    ),
    "infinity": (lambda: sl.Scene(with_value(np.inf)), ["NaN or infinite", "(1, 2)", "got inf"]),
    "NaN where the mask says valid": (
        lambda: sl.Scene(NAN, mask=np.ones((4, 6), bool)),
        ["NaN or infinite", "(1, 3)"],
    ),
    "negative depth": (
        lambda: sl.Scene(with_value(-0.5)),
        ["depth: negative", "(1, 2)", "got -0.5", ">= 0", "Scene.from_height"],
    ),
    "beyond float32": (lambda: sl.Scene(with_value(1e39)), ["too large for float32", "(1, 2)"]),
    "height beyond float32": (
        lambda: sl.Scene.from_height(with_value(1e39)),
        ["height", "too large for float32", "(1, 2)", "1e+39"],
    ),
    "three axes": (lambda: sl.Scene(np.ones((2, 3, 4))), ["depth: wrong shape", "(2, 3, 4)", "(rows, cols)"]),
    "one axis": (lambda: sl.Scene(np.ones(5)), ["depth: wrong shape", "(5,)"]),
    "a number": (lambda: sl.Scene(3.0), ["depth: wrong shape", "()"]),
    "empty": (lambda: sl.Scene(np.ones((0, 4))), ["depth: empty array", "(0, 4)"]),
    "complex": (lambda: sl.Scene(DEPTH + 0j), ["depth: wrong type", "complex128", "real numbers"]),
    "booleans": (lambda: sl.Scene(DEPTH > 0), ["depth: wrong type", "bool"]),
    "text": (lambda: sl.Scene([["a", "b"]]), ["depth: wrong type"]),
    "ragged": (lambda: sl.Scene([[1, 2], [3]]), ["depth: not an array"]),
    "None": (lambda: sl.Scene(None), ["depth: wrong type"]),
    "spacing 0": (lambda: sl.Scene(DEPTH, 0), ["spacing", "got 0.0", "> 0"]),
    "spacing negative": (lambda: sl.Scene(DEPTH, -2), ["spacing", "got -2.0"]),
    "spacing NaN": (lambda: sl.Scene(DEPTH, np.nan), ["spacing", "got nan"]),
    "spacing text": (lambda: sl.Scene(DEPTH, "wide"), ["spacing: not a number", "'wide'"]),
    "spacing pair": (lambda: sl.Scene(DEPTH, (1, 2)), ["spacing: not a number"]),
    "unknown sides": (
        lambda: sl.Scene(DEPTH, sides="closed"),
        ["sides", "'closed'", "open | dark | periodic"],
    ),
    "albedo above 1": (lambda: sl.Scene(DEPTH, albedo=1.5), ["albedo: out of range", "got 1.5", "0 to 1"]),
    "albedo negative": (lambda: sl.Scene(DEPTH, albedo=-0.1), ["albedo: out of range", "got -0.1"]),
    "albedo NaN": (lambda: sl.Scene(DEPTH, albedo=np.nan), ["albedo: out of range", "got nan"]),
    "albedo map with a hole": (
        lambda: sl.Scene(DEPTH, albedo=with_value(np.nan) / 2),
        ["albedo: out of range at (row, col) = (1, 2)"],
    ),
    "albedo map of another shape": (
        lambda: sl.Scene(DEPTH, albedo=np.ones((6, 4)) / 2),
        ["albedo: wrong shape", "(6, 4)", "(4, 6)"],
    ),
    "albedo complex": (lambda: sl.Scene(DEPTH, albedo=0.5j), ["albedo: wrong type", "complex"]),
    "mask of another shape": (
        lambda: sl.Scene(DEPTH, mask=np.ones((6, 4), bool)),
        ["mask", "(6, 4)", "(4, 6)"],
    ),
    "mask of numbers": (lambda: sl.Scene(DEPTH, mask=np.ones((4, 6))), ["mask", "float64", "bool"]),
    "mask ragged": (lambda: sl.Scene(DEPTH, mask=[[True], [True, False]]), ["mask", "bool"]),
    "mask without a valid node": (
        lambda: sl.Scene(DEPTH, mask=np.zeros((4, 6), bool)),
        ["mask: no valid node"],
    ),
    "height with NaN": (
        lambda: sl.Scene.from_height(NAN),
        ["height: 1 values", "(1, 3)", "mask=numpy.isfinite(height)"],
    ),
    "height empty": (lambda: sl.Scene.from_height(np.ones((4, 0))), ["height: empty array"]),
    "height nowhere valid": (
        lambda: sl.Scene.from_height(DEPTH, mask=np.zeros((4, 6), bool)),
        ["mask: no valid node"],
    ),
}
VOLUME = np.zeros((3, 4, 6), bool)
VOLUME[2] = True
SOURCES = {
    "a sun beyond all floats": (lambda: sl.cie_clear((10**400, 20)), ["sun: got (1000", "in degrees"]),
    "a function that returns a brightness": (
        lambda: sl.Sky(sl.cie_overcast),
        ["brightness: got the function cie_overcast itself", "Call it: cie_overcast()."],
    ),
    "an array for a number": (
        lambda: sl.uniform(np.ones((90, 3))),
        ["brightness: got array([[1., 1., 1.], ["],
    ),
    "brightness negative": (lambda: sl.Sky(-1), ["brightness", "got -1.0", ">= 0"]),
    "brightness NaN": (lambda: sl.Sky(np.nan), ["brightness", "got nan"]),
    "brightness infinite": (
        lambda: sl.Window(x=(0, 1), y=(0, 1), brightness=np.inf),
        ["brightness", "got inf"],
    ),
    "brightness an array": (lambda: sl.Sky(np.ones(4)), ["brightness", "function of unit vectors"]),
    "brightness complex": (lambda: sl.Sky(1j), ["brightness", "1j"]),
    "brightness text": (lambda: sl.Sky("bright"), ["brightness", "'bright'"]),
    "overcast negative": (lambda: sl.cie_overcast(-2), ["brightness", "-2.0"]),
    "cosine power": (lambda: sl.cosine_power(-1), ["cosine_power: power", "-1"]),
    "cosine power NaN": (lambda: sl.cosine_power(np.nan), ["cosine_power: power", "nan"]),
    "cosine power text": (lambda: sl.cosine_power("strong"), ["cosine_power: power", "'strong'"]),
    "cosine axis text": (lambda: sl.cosine_power(1, axis="down"), ["cosine_power: axis", "three"]),
    "cosine axis 0": (lambda: sl.cosine_power(1, (0, 0, 0)), ["cosine_power: axis", "not all zero"]),
    "cosine axis short": (lambda: sl.cosine_power(1, (0, 1)), ["cosine_power: axis", "three"]),
    "environment of three axes": (
        lambda: sl.environment_map(np.ones((2, 3, 4))),
        ["environment_map: wrong shape", "(2, 3, 4)"],
    ),
    "environment negative": (lambda: sl.environment_map([[1, -1]]), ["environment_map: values", "-1"]),
    "environment NaN": (
        lambda: sl.environment_map([[1, np.nan]]),
        ["environment_map: values", "finite: False"],
    ),
    "environment brighter than floats": (
        lambda: sl.environment_map(np.full((2, 4), 1e35)),
        ["environment_map: values", "at most 1e+30"],
    ),
    "type of a sky in a list": (lambda: sl.cie_sky([12], (180, 30)), ["cie_sky: type", "[12]"]),
    "environment of nan": (
        lambda: sl.environment_map(np.full((2, 4), np.nan)),
        ["environment_map: values", "nan to nan"],
    ),
    "lamp of nothing": (lambda: sl.Lamp(), ["lamp", "center and radius"]),
    "lamp without radius": (lambda: sl.Lamp(center=(1, 2, 3)), ["lamp", "center and radius"]),
    "lamp both": (lambda: sl.Lamp(center=(1, 2, 3), radius=1, volume=VOLUME), ["lamp", "volume alone"]),
    "lamp center": (lambda: sl.Lamp(center=(1, 2), radius=1), ["lamp center", "(1.0, 2.0)", "(x, y, z)"]),
    "lamp center NaN": (lambda: sl.Lamp(center=(1, np.nan, 0), radius=1), ["lamp center", "nan"]),
    "lamp radius 0": (lambda: sl.Lamp(center=(1, 2, 3), radius=0), ["lamp radius", "got 0.0", "> 0"]),
    "lamp radius negative": (lambda: sl.Lamp(center=(1, 2, 3), radius=-1), ["lamp radius", "-1.0"]),
    "lamp radius NaN": (lambda: sl.Lamp(center=(1, 2, 3), radius=np.nan), ["lamp radius", "nan"]),
    "volume of numbers": (
        lambda: sl.Lamp(volume=VOLUME * 1.0),
        ["lamp volume", "float64", "bool (layers, rows, cols)"],
    ),
    "volume ragged": (
        lambda: sl.Lamp(volume=[[[True], [True, False]]]),
        ["lamp volume", "(layers, rows, cols)"],
    ),
    "volume flat": (lambda: sl.Lamp(volume=VOLUME[0]), ["lamp volume", "(4, 6)"]),
    "volume dark": (lambda: sl.Lamp(volume=np.zeros((3, 4, 6), bool)), ["lamp volume", "nothing shines"]),
    "window of nothing": (lambda: sl.Window(), ["window", "x and y"]),
    "window without y": (lambda: sl.Window(x=(0, 1)), ["window", "x and y"]),
    "window inside out": (lambda: sl.Window(x=(2, 1), y=(0, 1)), ["window x", "(2.0, 1.0)", "low < high"]),
    "window of no width": (lambda: sl.Window(x=(0, 1), y=(1, 1)), ["window y", "low < high"]),
    "window NaN": (lambda: sl.Window(x=(0, np.nan), y=(0, 1)), ["window x", "nan"]),
    "aperture closed": (
        lambda: sl.Window(aperture=np.zeros((4, 6), bool)),
        ["window aperture", "nothing shines"],
    ),
    "aperture of numbers": (lambda: sl.Window(aperture=np.ones((4, 6))), ["window aperture", "float64"]),
}
RENDER = {
    "not a scene": (lambda: sl.render(DEPTH, SKY), ["scene", "ndarray", "skylamp.Scene"]),
    "visibility of no scene": (
        lambda: sl.visibility(DEPTH, SKY, 3, "numpy"),
        ["scene", "ndarray", "skylamp.Scene"],
    ),
    "field of no scene": (
        lambda: sl.visibility_field(DEPTH, SKY, 3, backend="numpy"),
        ["scene", "ndarray", "skylamp.Scene"],
    ),
    "view from a pair": (
        lambda: sl.visibility_field(SCENE, SKY, 3, backend="numpy").view((1, 1), "numpy"),
        ["point", "(1, 1)"],
    ),
    "not a source": (
        lambda: sl.render(SCENE, 1.0, backend="numpy"),
        ["source", "float", "Sky, Lamp or Window"],
    ),
    "a brightness for a source": (
        lambda: sl.render(SCENE, sl.cie_overcast(), backend="numpy"),
        ["source", "Sky, Lamp or Window", "sl.Sky(brightness)"],
    ),
    "tolerance a truth": (lambda: sl.render(SCENE, SKY, tolerance=True), ["tolerance", "True", "number"]),
    "unknown method": (lambda: sl.render(SCENE, SKY, "raytrace"), ["method", "'raytrace'", "lattice"]),
    "unknown quantity": (
        lambda: sl.render(SCENE, SKY, quantity="lux"),
        ["quantity", "'lux'", "radiance | irradiance"],
    ),
    "unknown weights": (
        lambda: sl.render(SCENE, SKY, weights="even"),
        ["weights", "'even'", "moment | printed"],
    ),
    "tolerance 0": (lambda: sl.render(SCENE, SKY, tolerance=0), ["tolerance", "> 0"]),
    "tolerance NaN": (lambda: sl.render(SCENE, SKY, tolerance=np.nan), ["tolerance", "nan"]),
    "even M": (lambda: sl.render(SCENE, SKY, "lattice", hemicube=8), ["hemicube", "8", "odd whole number"]),
    "M = 1": (lambda: sl.Hemicube(1), ["hemicube", "1", "from 3"]),
    "M too large": (lambda: sl.Hemicube(1001), ["hemicube", "1001", "to 129"]),
    "M a fraction": (lambda: sl.Hemicube(9.0), ["hemicube", "9.0"]),
    "M a truth": (lambda: sl.Hemicube(True), ["hemicube", "True"]),
    "unknown algorithm": (
        lambda: sl.visibility(SCENE, SKY, algorithm="magic"),
        ["algorithm", "'magic'", "scan | propagate"],
    ),
    "propagation filled": (
        lambda: sl.visibility(SCENE, SKY, filled=True, algorithm="propagate"),
        ["filled=False"],
    ),
    "field of no layers": (lambda: sl.visibility_field(SCENE, SKY, layers=0), ["layers", "0", ">= 1"]),
    "lamp below the surface": (
        lambda: sl.render(SCENE, sl.Lamp(center=(2, 1, 1.5), radius=1), backend="numpy"),
        ["lamp below the surface", "z = 1.5", "(row, col) = (1, 2)", "z <= 1.0"],
    ),
    "lamp on a periodic map": (
        lambda: sl.render(
            sl.Scene(DEPTH, sides="periodic"), sl.Lamp(center=(2, 1, -1), radius=1), backend="numpy"
        ),
        ["periodic", "volume"],
    ),
    "sphere without end": (
        lambda: sl.render(SCENE, sl.Lamp((0, 0, -4e26), 1e26), method="unoccluded", backend="numpy"),
        ["lamp: of such size", "4e+26", "extent"],
    ),
    "rectangular lamp without end": (
        lambda: sl.render(
            SCENE, sl.Lamp(corner=(0, 0, -1e13), edges=((1e13, 0, 0), (0, 1, 0))), backend="numpy"
        ),
        ["lamp: of such size", "1e+13", "extent"],
    ),
    "rectangular lamp by the lattice": (
        lambda: sl.render(
            SCENE, sl.Lamp(corner=(1, 1, -1), edges=((2, 0, 0), (0, 1, 0))), "lattice", backend="numpy"
        ),
        ["method 'lattice' with a rectangular lamp", "corner and edges", "Use method='horizon'"],
    ),
    "volume of another shape": (
        lambda: sl.visibility(sl.Scene(DEPTH.T), sl.Lamp(volume=VOLUME), backend="numpy"),
        ["lamp volume: wrong shape", "(3, 4, 6)", "(6, 4)"],
    ),
    "volume in the ground": (
        lambda: sl.visibility(SCENE, sl.Lamp(volume=VOLUME), backend="numpy"),
        ["lamp volume", "free space"],
    ),
    "aperture of another shape": (
        lambda: sl.visibility(SCENE, sl.Window(aperture=np.ones((6, 4), bool)), backend="numpy"),
        ["window aperture: wrong shape", "(6, 4)", "(4, 6)"],
    ),
    "brightness of wrong shape": (
        lambda: sl.render(SCENE, sl.Sky(lambda L: L[..., :2]), backend="numpy"),
        ["brightness function: wrong result", "shape"],
    ),
    "brightness in colour": (
        lambda: sl.recover(
            np.ones((6, 4)), sl.Sky(lambda L: np.ones((*L.shape[:-1], 3))), albedo=0.5, backend="numpy"
        ),
        ["brightness function: wrong result", "Only render takes colour"],
    ),
    "brightness of negative value": (
        lambda: sl.render(SCENE, sl.Sky(lambda L: L[..., 2]), backend="numpy"),
        ["brightness function", "L =", ">= 0"],
    ),
    "brightness of NaN": (
        lambda: sl.render(SCENE, sl.Sky(lambda L: np.full(L.shape[:-1], np.nan)), backend="numpy"),
        ["brightness function", "nan"],
    ),
    "brightness of complex value": (
        lambda: sl.render(SCENE, sl.Sky(lambda L: L[..., 0] + 1j), backend="numpy"),
        ["brightness function", "complex128"],
    ),
    "brightness of nothing": (
        lambda: sl.render(SCENE, sl.Sky(lambda L: None), backend="numpy"),
        ["brightness function", "object"],
    ),
}
IMAGE = np.full((4, 6), 0.5)
RECOVER = {
    "image NaN": (lambda: sl.recover(NAN, SKY), ["image: 1 values", "(1, 3)", ">= 0"]),
    "image negative": (lambda: sl.recover(with_value(-1), SKY), ["image: 1 values are negative", "(1, 2)"]),
    "image black": (lambda: sl.recover(0 * IMAGE, SKY), ["image: black everywhere"]),
    "image of colours": (lambda: sl.recover(np.ones((4, 6, 3)), SKY), ["image: wrong shape", "(4, 6, 3)"]),
    "image complex": (lambda: sl.recover(IMAGE + 0j, SKY), ["image: wrong type", "complex128"]),
    "image of counts": (lambda: sl.recover(np.ones((4, 6), np.uint8), SKY), ["counts", "uint8", "by 255"]),
    "image empty": (lambda: sl.recover(np.ones((0, 0)), SKY), ["image: empty array"]),
    "eps 0": (lambda: sl.recover(IMAGE, SKY, method="paper", eps=0), ["eps", "> 0"]),
    "eps NaN": (lambda: sl.recover(IMAGE, SKY, method="paper", eps=np.nan), ["eps", "nan"]),
    "unknown stop": (
        lambda: sl.recover(IMAGE, SKY, method="paper", stop="never"),
        ["stop", "'never'", "eps | sign"],
    ),
    "unknown method": (lambda: sl.recover(IMAGE, SKY, method="magic"), ["method", "'magic'", "paper"]),
    "unknown sides": (
        lambda: sl.recover(IMAGE, SKY, sides="closed"),
        ["sides", "'closed'", "open | dark | periodic"],
    ),
    "no layers": (lambda: sl.recover(IMAGE, SKY, layers=0), ["layers", "0"]),
    "half a layer": (lambda: sl.recover(IMAGE, SKY, layers=2.5), ["layers", "2.5"]),
    "several images, one source": (
        lambda: sl.recover([IMAGE, IMAGE], SKY),
        ["source: got one, of 2 images", "one per image"],
    ),
    "far beyond float32": (
        lambda: sl.recover(IMAGE, SKY, far=3e38, backend="numpy"),
        ["far: too deep", "3e+38", "1e+30 x spacing"],
    ),
    "spacing beyond float32": (
        lambda: sl.recover(IMAGE, SKY, spacing=1e38, backend="numpy"),
        ["far: too deep", "at most 3.4e38"],
    ),
    "albedo of images of one light": (
        lambda: sl.recover([IMAGE, IMAGE], [SKY, SKY], albedo=None, backend="numpy"),
        ["albedo", "These are of one light", "different lights"],
    ),
    "near by the paper": (
        lambda: sl.recover(IMAGE, SKY, near=1.0, method="paper", backend="numpy"),
        ["method 'paper'", "near", "without near, far"],
    ),
    "even M": (lambda: sl.recover(IMAGE, SKY, hemicube=4), ["hemicube", "4", "odd"]),
    "albedo 0": (lambda: sl.recover(IMAGE, SKY, albedo=0), ["albedo", "> 0"]),
    "albedo map with a black pixel": (
        lambda: sl.recover(IMAGE, SKY, albedo=with_value(0)),
        ["albedo", "> 0"],
    ),
    "albedo of another shape": (
        lambda: sl.recover(IMAGE, SKY, albedo=np.ones((6, 4))),
        ["albedo: wrong shape", "(6, 4)"],
    ),
    "spacing": (lambda: sl.recover(IMAGE, SKY, spacing=-1), ["spacing", "-1"]),
    "not a source": (
        lambda: sl.recover(IMAGE, None, backend="numpy"),
        ["source", "NoneType", "Sky, Lamp or Window"],
    ),
}
CASES = [
    (f"{room}: {name}", *case)
    for room, cases in (("scene", SCENES), ("source", SOURCES), ("render", RENDER), ("recover", RECOVER))
    for name, case in cases.items()
]


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("call", "parts"), [case[1:] for case in CASES], ids=[case[0] for case in CASES])
def test_bad_input_is_one_clear_error(call, parts):
    """An InputError of one line that names what was got and what is allowed, and no warning before it."""
    with pytest.raises(InputError) as caught:
        call()
    text = str(caught.value)
    assert isinstance(caught.value, ValueError) and isinstance(caught.value, sl.SkylampError)
    for part in parts:
        assert part in text, text
    assert "\n" not in text and text.endswith((".", ".)")), text


def test_results_show_shapes_and_no_numbers(fast):
    """repr of a Recovery of 16 x 16 pixels had 31,000 characters."""
    image = sl.render(sl.Scene(np.full((16, 16), 3.0)), sl.Sky(), backend=fast)
    options = dict(layers=4, max_seconds=1e-6, interreflection=False, backend=fast)
    found = sl.recover(image.image, sl.Sky(), **options)
    for text, name in ((repr(image), "image"), (repr(found), "depth")):
        assert f"{name}=(16, 16) float32, " in text and "array" not in text and "\n" not in text


@pytest.mark.parametrize("name", ["numpi", "warp", "warp:gpu:0", "opencl:7:3", "cuda", "", "opencl:x"])
def test_an_unknown_backend_is_an_error_that_names_the_nearest(name):
    """No named backend falls back to another; the message says why and which there are."""
    with pytest.raises(BackendError) as caught:
        sl.render(SCENE, SKY, backend=name)
    text = str(caught.value)
    assert (
        repr(name) in text
        and "there is no such backend" in text
        and "'numpy'" in text
        or "Nearest that is:" in text
    )
    here = [info.name for info in sl.backends() if info.available]
    assert all(n in text for n in here) and "auto" in text
    if name == "numpi":
        assert "Nearest that is: 'numpy'" in text


@pytest.mark.parametrize("name", [None, 3, ["numpy"], b"numpy"])
def test_a_backend_that_is_no_name_is_an_error(name):
    """Not a traceback from inside."""
    with pytest.raises(BackendError, match="backend: got .*; allowed: a name"):
        sl.visibility(SCENE, SKY, 3, name)


def test_a_backend_that_is_not_here_says_why():
    """A missing GPU is named with the reason, as is every entry of backends() that is not available."""
    for info in sl.backends():
        assert info.available != bool(info.why)
        if not info.available:
            with pytest.raises(BackendError) as caught:
                sl.render(SCENE, SKY, backend=info.name)
            assert info.why in str(caught.value) and repr(info.name) in str(caught.value)


def test_auto_says_what_it_took():
    """The first of backends(), by its full name; "opencl" is the first OpenCL device."""
    out = sl.render(SCENE, SKY, "lattice", hemicube=3)
    infos = [info for info in sl.backends() if info.available]
    assert out.backend == infos[0].name
    devices = [info.name for info in infos if info.name.startswith("opencl:")]
    if devices:
        assert sl.render(SCENE, SKY, "lattice", hemicube=3, backend="opencl").backend == devices[0]


def python(code, **environment):
    """The standard output of a fresh interpreter, away from the repository."""
    done = subprocess.run(
        [sys.executable, "-c", code],
        capture_output=True,
        text=True,
        env={**os.environ, **environment},
        cwd=Path(sys.executable).parent,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_skylamp_starts_no_backend():
    """Neither Warp nor OpenCL is imported until a backend is asked for."""
    assert (
        python(
            "import sys, skylamp; print([m for m in ('warp', 'pyopencl', 'matplotlib', 'typer') if m in"
            " sys.modules])"
        ).strip()
        == "[]"
    )


def test_all_public_names_are_there():
    """__all__ and what it promises."""
    assert all(hasattr(sl, name) for name in sl.__all__) and len(set(sl.__all__)) == len(sl.__all__)
    assert {
        "Scene",
        "Sky",
        "Lamp",
        "Window",
        "Hemicube",
        "render",
        "visibility",
        "visibility_field",
        "recover",
        "backends",
    } <= set(sl.__all__)


def test_the_rooms_are_not_imported_twice():
    """From the repository's root `import host` would work too, and load every module a second time."""
    sl.render(SCENE, SKY, "lattice", hemicube=3)
    assert not {"host", "opencl", "warp_kernels"} & set(sys.modules)


@pytest.mark.slow
def test_without_an_opencl_driver_opencl_is_missing_with_a_reason():
    """No driver found: the rest works, a named opencl is an error, auto takes another and says which."""
    out = python(
        "import pyopencl as cl\n"
        "def without(): raise cl.LogicError('clGetPlatformIDs', -1001)\n"
        "cl.get_platforms = without\n"
        "import skylamp as sl, numpy as np\n"
        "info = [b for b in sl.backends() if b.name.startswith('opencl')]\n"
        "print(len(info), info[0].available, bool(info[0].why))\n"
        "scene = sl.Scene(np.ones((3, 4)))\n"
        "print(sl.render(scene, sl.Sky(), 'lattice', hemicube=3).backend.split(':')[0])\n"
        "try: sl.render(scene, sl.Sky(), backend='opencl')\n"
        "except sl.BackendError as error: print(error)\n"
    )  # the wheel's loader finds PoCL beside itself, whatever variables hide
    lines = [line for line in out.splitlines() if line.startswith(("1 ", "warp", "numpy", "backend"))]
    assert lines[0] == "1 False True" and lines[1] in ("warp", "numpy")
    assert "'opencl' is not available" in lines[2] and "OpenCL" in lines[2]


def test_ctrl_c_while_a_driver_is_imported_is_ctrl_c(monkeypatch):
    """And no UnboundLocalError of a module that is not there yet."""
    from skylamp.backends import opencl

    def interrupt(name, *args, **more):
        raise KeyboardInterrupt

    monkeypatch.setattr("builtins.__import__", interrupt)
    with pytest.raises(KeyboardInterrupt):
        opencl.probe()


@pytest.mark.parametrize(
    ("version", "available"),
    [
        ("OpenCL 3.0 PoCL HSTR: pthread-x86_64-unknown-linux-gnu-generic", False),
        ("OpenCL 3.0 PoCL HSTR: pthread-x86_64-pc-linux-gnu-znver3", True),
        ("OpenCL 3.0 PoCL HSTR: pthread-aarch64-unknown-linux-gnu-generic", True),
    ],
)
def test_a_pocl_that_is_older_than_the_processor_is_not_available(monkeypatch, version, available):
    """Its compiler calls such an x86 "generic" and refuses the name; "auto" must not take it."""
    cl = pytest.importorskip("pyopencl")
    from skylamp.backends import opencl

    device = SimpleNamespace(
        max_compute_units=2, name="cpu", double_fp_config=1, version=version, type=cl.device_type.CPU
    )
    platform = SimpleNamespace(version="OpenCL 3.0 PoCL 3.0", get_devices=lambda: [device])
    monkeypatch.setattr(cl, "get_platforms", lambda: [platform])
    (info,) = opencl.probe()
    assert info.available is available
    assert available or "apt install pocl-opencl-icd" in info.why


SMALL = sl.Scene(np.ones((4, 5)))


@pytest.mark.parametrize(
    ("call", "says"),
    [
        (lambda: sl.Scene(np.ones((3, 3)), "1"), "spacing: not a number"),
        (lambda: sl.horizons(SMALL, 4, "numpy", max_seconds="1"), "max_seconds: not a number"),
        (lambda: sl.render(SMALL, sl.Sky(), interreflection=np.array([1, 2])), "interreflection"),
        (lambda: sl.visibility_field(SMALL, sl.Sky(), 3, max_bytes="many"), "max_bytes: not a number"),
        (lambda: sl.sky_over_time(np.array([["2026-06-21T12:00Z"]]), 40, 0), "more than one axis"),
    ],
)
def test_wrong_types_are_one_error_at_the_door(call, says):
    """Text is no number, an array no choice."""
    with pytest.raises(InputError, match=says):
        call()


@pytest.mark.parametrize("builds", [True, False])
def test_a_program_that_does_not_build_is_built_again(monkeypatch, builds):
    """Processes that compile into one cache disturb one another; a kernel that never builds is an error."""
    from skylamp.backends import opencl, select

    engine, failures = select("opencl"), opencl.BUILDS - builds
    whole, attempts = engine.cl.Program, []

    def program(*args):
        attempts.append(args)
        return whole(args[0], "no kernel") if len(attempts) <= failures else whole(*args)

    monkeypatch.setattr(engine.cl, "Program", program)
    if builds:
        assert opencl._program(engine, "carve", engine.lanes, ()).kernel_names
    else:
        with pytest.raises(BackendError, match="carve.cl does not build on"):
            opencl._program(engine, "carve", engine.lanes, ())
    assert len(attempts) == opencl.BUILDS


@pytest.mark.parametrize("how", [{}, {"method": "horizon"}, {"method": "lattice"}])
@pytest.mark.parametrize(
    "lamp", [sl.Lamp(corner=(1, 1, 1), edges=((1, 0, 0), (0, 1, 0))), sl.Lamp((1, 1, 1), 0.5)]
)
def test_a_lamp_over_a_map_that_repeats_is_sent_to_no_other_method(lamp, how):
    """None renders it; each error named the other method."""
    with pytest.raises(sl.InputError, match="sides='open' or 'dark'") as caught:
        sl.render(sl.Scene(np.full((4, 4), 5.0), sides="periodic"), lamp, backend="numpy", **how)
    assert "Use method" not in str(caught.value)


@pytest.mark.parametrize(
    "kind", [sl.SkylampError, sl.InputError, sl.BackendError, sl.CapacityError, sl.OutOfTimeError]
)
def test_errors_travel_between_processes(kind):
    """By pickle, and by tblib, which Dask loads: it makes an error without its arguments first."""
    error = pickle.loads(pickle.dumps(kind("what, where")))
    assert type(error) is kind and str(error) == "what, where"
    assert type(kind.__new__(kind)) is kind


def test_a_broken_package_is_not_called_missing():
    """A package that is there and cannot be imported: its own error, and to upgrade."""
    gone = lacking("a picture", "matplotlib", "plot", ModuleNotFoundError(name="matplotlib"))
    broken = lacking("a picture", "matplotlib", "plot", ImportError("numpy.core.multiarray failed"))
    assert str(gone).endswith("which is not installed: pip install 'skylamp[plot]'")
    assert "cannot be imported (numpy.core.multiarray failed)" in str(broken) and "--upgrade" in str(broken)


def test_a_folder_that_pyopencl_left_behind(monkeypatch):
    """An uninstalled pyopencl that is a namespace without names makes OpenCL unavailable, and no error."""
    from skylamp.backends import opencl

    monkeypatch.setitem(sys.modules, "pyopencl", ModuleType("pyopencl"))
    (info,) = opencl.probe()
    assert not info.available and info.why == "pyopencl is not installed"


def test_a_package_of_which_a_part_is_missing_is_broken():
    """Another module that a package imports is named; pip would find the package itself."""
    error = ModuleNotFoundError("No module named 'affine'", name="affine")
    assert "cannot be imported (No module named 'affine')" in str(
        lacking("a GeoTIFF", "rasterio", "geo", error)
    )


def test_functions_of_no_module_are_brightness_functions():
    """As exec makes them: their __module__ is None."""
    made = {}
    exec("def even(L): return 1 + 0 * L[..., 0]", made)
    scene = sl.Scene(np.zeros((3, 3)))
    images = [sl.render(scene, sl.Sky(light), backend="numpy").image for light in (made["even"], 1.0)]
    np.testing.assert_allclose(*images, rtol=1e-3)
