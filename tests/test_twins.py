"""Kernels in Warp, OpenCL and NumPy are triplets, and a broken kernel makes the suite red."""

import importlib
import inspect
import re
from importlib.resources import files

import numpy as np
import pytest
import scenes
from compare import assert_bits_equal

import skylamp as sl
import skylamp.opencl
import skylamp.warp_kernels
from skylamp.constants import LADDER

STEMS = sorted(f.name[:-3] for f in files(skylamp.opencl).iterdir() if f.name.endswith(".cl"))
C_TYPES = {
    "float": "float32",
    "double": "float64",
    "int": "int32",
    "long": "int64",
    "uint": "uint32",
    "uchar": "uint8",
    "float4": "float32",
    "floats": "float32",
    "uchars": "uint8",
    "Ladder": "int32",
}  # vectors by their elements
C_NAMES = {"half_": "half"}  # half is a type in OpenCL
NOT_IN_NUMPY = {("gauss_newton", "solve")}  # one work-item takes all steps, which NumPy is never asked for
CONSTANTS = {
    "BITS": (3, 4),
    "NEAR": (6, 12),
    "SIDES": (0, 2),
    "WHAT": (0, 1),
    "FALLS": (0, 1),
    "BLOCKS": (0, 1),
    "LIGHTS": (1, 3),
}  # known when compiling: two values of each
WARP_WORDS = {
    ("luminance", "planes"),
    ("specular", "planes"),
}  # bytes that Warp loads four to a uint32, since its byte vectors are loaded one by one


def _signatures(stem):
    """{kernel: [(name, element type, is a buffer)]} of a .cl file."""
    text = re.sub(r"/\*.*?\*/", "", skylamp.opencl.source(stem), flags=re.S)
    kernels = {}
    for name, arguments in re.findall(
        r"__kernel\s+(?:__attribute__\(\(.*?\)\)\)\s*)?void\s+(\w+)\s*\((.*?)\)\s*\{", text, re.S
    ):
        parsed = []
        for argument in arguments.split(","):
            words = (
                re.sub(r"\b(__global|__constant|const|restrict)\b", " ", argument).replace("*", " * ").split()
            )
            parsed.append((C_NAMES.get(words[-1], words[-1]), C_TYPES[words[0]], "*" in words))
        kernels[name] = parsed
    return kernels


def _made(factory, **other):
    """What a function of compile-time constants gives."""
    names = inspect.signature(factory).parameters
    return factory(**{name: other.get(name, CONSTANTS[name][0]) for name in names})


def _warp_kernel(stem, name):
    import warp as wp

    found = getattr(importlib.import_module(f"skylamp.warp_kernels.{stem}"), name, None)
    return found if found is None or isinstance(found, wp.Kernel) else _made(found)


def _type(kind):
    """(element type's name, is an array) of a Warp argument."""
    is_array = hasattr(kind, "ndim")
    kind = kind.dtype if is_array else kind
    return getattr(kind, "_wp_scalar_type_", kind).__name__, is_array


def test_every_opencl_file_has_a_warp_and_a_numpy_twin():
    """The same stems in all three packages."""
    warp, in_numpy = (
        sorted(f.name[:-3] for f in files(package).iterdir() if f.name.endswith(".py") and f.name[0] != "_")
        for package in ("skylamp.warp_kernels", "skylamp.backends.numpy")
    )
    assert STEMS == warp == in_numpy and {"scan", "propagate", "luminance", "carve"} <= set(STEMS)


@pytest.mark.parametrize("stem", STEMS)
def test_kernels_have_the_same_names_and_arguments(stem):
    """Names, order, element types, and which are arrays."""
    import warp as wp

    signatures = _signatures(stem)
    assert signatures, f"no kernel found in {stem}.cl"
    module = importlib.import_module(f"skylamp.warp_kernels.{stem}")
    factories = {
        n
        for n, v in vars(module).items()
        if callable(v)
        and hasattr(v, "cache_info")
        and v.__module__ == module.__name__
        and isinstance(_made(v), wp.Kernel)
    }
    public = factories | {n for n, v in vars(module).items() if isinstance(v, wp.Kernel)}
    assert public == set(signatures)
    for name, arguments in signatures.items():
        kernel = _warp_kernel(stem, name)
        expected = [
            (label, "uint32" if (name, label) in WARP_WORDS else kind, is_buffer)
            for label, kind, is_buffer in arguments
        ]
        assert [(a.label, *_type(a.type)) for a in kernel.adj.args] == expected, f"{stem}.{name}"


@pytest.mark.parametrize("stem", STEMS)
def test_numpy_kernels_have_the_same_names_and_arguments(stem):
    """Names and order as in OpenCL, then the constants that the Warp twin is asked for."""
    module = importlib.import_module(f"skylamp.backends.numpy.{stem}")
    warp_module = importlib.import_module(f"skylamp.warp_kernels.{stem}")
    for name, arguments in _signatures(stem).items():
        if (stem, name) in NOT_IN_NUMPY:
            assert not hasattr(module, name)
            continue
        parameters = [*inspect.signature(getattr(module, name)).parameters]
        twin = getattr(warp_module, name)
        constants = [] if not hasattr(twin, "cache_info") else [*inspect.signature(twin).parameters]
        expected = [label for label, _, _ in arguments]
        assert parameters[: len(expected)] == expected, f"{stem}.{name}"
        assert sorted(parameters[len(expected) :]) == sorted(constants), f"{stem}.{name}"


@pytest.mark.parametrize("stem", STEMS)
def test_a_kernel_with_constants_is_a_factory_in_warp(stem):
    """Where the OpenCL kernel uses such a constant, the Warp twin is asked for with it, and gives the same
    kernel again.
    """
    import warp as wp

    text = re.sub(r"/\*.*?\*/", "", skylamp.opencl.source(stem), flags=re.S)
    bodies = re.split(r"__kernel", text)[1:]
    for body in bodies:
        name = re.search(r"void\s+(\w+)\s*\(", body).group(1)
        twin = getattr(importlib.import_module(f"skylamp.warp_kernels.{stem}"), name)
        used = {constant for constant in CONSTANTS if re.search(rf"\b{constant}\b", body)}
        assert isinstance(twin, wp.Kernel) == (not used), f"{stem}.{name}"
        if used:
            assert set(inspect.signature(twin).parameters) == used, f"{stem}.{name}"
            assert _made(twin) is _made(twin)
            assert all(
                _made(twin) is not _made(twin, **{constant: CONSTANTS[constant][1]}) for constant in used
            )


def test_vectors_by_value_are_as_long_in_both():
    """A struct of so many integers there, a vector of so many here."""
    length = LADDER
    formal = {a.label: a.type for a in _warp_kernel("horizon", "sweep").adj.args}
    for name in ("steps", "rises", "falling_steps", "falling_rises"):
        assert formal[name]._shape_ == (length,)


@pytest.mark.parametrize("stem", STEMS)
def test_contraction_of_floating_point_is_off_in_both(stem):
    """One rounding per operation, or bits differ between devices."""
    if stem != "carve":  # it only counts
        assert "FP_CONTRACT OFF" in skylamp.opencl.source(stem)
    for name in _signatures(stem):
        options = _warp_kernel(stem, name).module.options
        assert options["fuse_fp"] is False and not options.get("fast_math", False), f"{stem}.{name}"


def _broken_bits(monkeypatch, old, new):
    """Visibility by a fresh OpenCL backend whose scan.cl has ``old`` replaced."""
    from skylamp.backends import opencl

    original = skylamp.opencl.source
    assert old in original("scan"), f"scan.cl has no {old!r}: mend this test"
    monkeypatch.setattr(
        skylamp.opencl,
        "source",
        lambda stem: original(stem).replace(old, new) if stem == "scan" else original(stem),
    )
    name = next(
        (info.name for info in sl.backends() if info.name.startswith("opencl:") and info.available), None
    )
    if name is None:
        pytest.skip("no OpenCL device")
    broken = opencl.OpenclBackend(*map(int, name.split(":")[1:]))
    monkeypatch.setattr(
        importlib.import_module("skylamp.visibility"), "select", lambda name: broken
    )  # the registry itself is left alone
    return sl.visibility(scenes.scene("plateaus"), sl.Sky(), 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("old", "new"),
    [("<= ceiling", "< ceiling"), ("1 << b", "1 << (b ^ 1)")],
    ids=["touching blocks", "elevations swapped"],
)
def test_a_broken_scan_is_seen(monkeypatch, old, new):
    """The comparison with the oracle turns red when one sign of the kernel is changed, and is green without
    the change.
    """
    with monkeypatch.context() as patch:
        assert_bits_equal(
            _broken_bits(patch, "<= ceiling", "<= ceiling"), scenes.truth("plateaus", 5, "open")
        )
    with monkeypatch.context() as patch:
        got = _broken_bits(patch, old, new)
        with pytest.raises(AssertionError, match="elements differ"):
            assert_bits_equal(got, scenes.truth("plateaus", 5, "open"))
    assert np.any(got)
