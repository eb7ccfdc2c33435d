"""What must hold of every generated case, on every backend: relations between images, and brute force.

Each relation takes a case and a backend's name, and raises where it does not hold. RELATIONS names them, with
the strategy that makes their cases. performance/campaign.py takes many cases, test_relations.py a few.
"""

import warnings
from typing import NamedTuple

import numpy as np
from fuzz import files, odd
from fuzz.cases import (
    METHODS,
    Case,
    brightness_of,
    cases,
    depth_of,
    grounds,
    mask_of,
    powers_of_ten,
    rendered,
    scene_of,
    shape_of,
    source_of,
    with_ground,
)
from hypothesis import strategies as st

import skylamp as sl
from skylamp import oracle

# Float32 sums of a few hundred terms, and heights rounded to float32 before they are compared.
ROUNDING = 2e-4
DARK = 1e-6  # of brightnesses around 1: no light, but for rounding
TIE = 0.01  # of the mean light: chosen; .0036 was seen, at one node of 256
EXPLICIT = METHODS[1:]


class Relation(NamedTuple):
    """``check`` (case, backend) of cases that ``strategy`` makes; ``weight``: share of a campaign's cases."""

    strategy: st.SearchStrategy
    check: object
    weight: float


def mean_of(image):
    lit = image[np.isfinite(image) & (image > 0)]
    return float(lit.mean(dtype=float)) if lit.size else 0.0


def alike(case, got, expected, what, rounding=ROUNDING):
    """That two renderings show the same: to rounding where a method was asked for, else within tolerances.

    A few nodes may look along an edge: there one ulp decides whether a ray passes, and a lattice's ray is a
    large part of the light.
    """
    one, other = (np.asarray(out.image, float) for out in (got, expected))
    assert one.shape == other.shape, what
    assert np.array_equal(np.isnan(one), np.isnan(other)), f"{what}: other nodes are masked"
    valid = np.isfinite(other)
    scale = max(mean_of(other), mean_of(one), DARK)
    off = np.abs(one - other)[valid] / scale
    if "tolerance" in case.how:
        said = got.warnings or expected.warnings
        limit = np.inf if said else 2 * case.how["tolerance"]
        assert np.sqrt(np.mean(off**2)) <= limit, f"{what}: RMS {np.sqrt(np.mean(off**2)):.3g} of the mean"
        return
    wrong = np.abs(one - other)[valid] > max(rounding * scale, DARK)
    edges = max(1, 0.05 * off.size) if "hemicube" in case.how or case.source != "sky" else 0
    # whole heights make ties, which a sweep may settle otherwise where it adds in another order
    edges = max(edges, int(off.max(initial=0.0) <= TIE))
    assert wrong.sum() <= edges, f"{what}: {wrong.sum()} of {off.size} nodes off, by up to {off.max():.3g}"


# -- turns, mirrors, lengths ---------------------------------------------------------------------------------


def turned(brightness, matrix):
    """A function of directions for a map whose coordinates (x, y) are ``matrix`` times the former."""
    if not callable(brightness):
        return brightness
    back = np.eye(3)
    back[:2, :2] = np.linalg.inv(matrix)
    return lambda L: brightness(L @ back.T)


def moved_case(case, backend, transpose):
    """(image, image of the moved map moved back)."""
    ground, depth, shape = case.ground, depth_of(case.ground), shape_of(case)
    mask, light = mask_of(ground), brightness_of(case)
    move = (lambda a: a.T.copy()) if transpose else (lambda a: a[:, ::-1].copy())
    matrix = np.array([[0, 1], [1, 0]]) if transpose else np.array([[-1, 0], [0, 1]])
    if shape is not None and transpose:
        order = {"ball": (1, 0, 2, 3), "panel": (1, 0, 2, 4, 3), "window": (2, 3, 0, 1)}[case.source]
        shape = [shape[n] for n in order]
    elif shape is not None:
        last, shape = ground.cols - 1, list(shape)
        if case.source == "ball":
            shape[0] = last - shape[0]
        elif case.source == "panel":
            shape[0] = last - shape[0] - shape[3]
        else:
            shape[:2] = last - shape[1], last - shape[0]
    one = rendered(case, backend)
    scene = scene_of(ground, move(depth), mask=None if mask is None else move(mask))
    other = rendered(case, backend, scene, source_of(case, turned(light, matrix), shape))
    image = np.asarray(other.image)
    return one, _with_image(other, image.T if transpose else image[:, ::-1])


def _with_image(out, image):
    return Shown(np.array(image), out.warnings)


class Shown(NamedTuple):
    """An image and what was warned of."""

    image: np.ndarray
    warnings: list


def mirrored_maps_have_mirrored_images(case, backend):
    one, other = moved_case(case, backend, transpose=False)
    alike(case, one, other, "mirrored")


def transposed_maps_have_transposed_images(case, backend):
    one, other = moved_case(case, backend, transpose=True)
    alike(case, one, other, "transposed")


def the_unit_of_length_is_free(case, backend):
    """By a power of two to the bit under skies, else by any factor; rays of a lattice may touch an edge."""
    rng = np.random.default_rng(case.seed)
    power = case.seed % 2 == 0 or "hemicube" in case.how
    k = 2.0 ** int(rng.integers(-20, 20)) if power else float(10 ** rng.uniform(-6, 6))
    unit = case.ground.spacing * k
    one = rendered(case, backend)
    scene = scene_of(case.ground, depth_of(case.ground) * k, spacing=unit)
    other = rendered(case, backend, scene, source_of(case, unit=unit))
    alike(case, one, other, f"lengths times {k:g}")
    if power and case.source == "sky":
        assert np.asarray(one.image).tobytes() == np.asarray(other.image).tobytes(), f"bytes, times {k:g}"


def only_differences_of_height_count(case, backend):
    """Under a sky, without walls. Rays of a lattice touch edges: none of their heights is rounded."""
    if "hemicube" in case.how:
        case = with_ground(case, relief=max(1.0, np.rint(64 * case.ground.relief)) / 64)
    up = float(np.random.default_rng(case.seed).integers(1, 64)) * case.ground.spacing
    one = rendered(case, backend)
    other = rendered(case, backend, scene_of(case.ground, depth_of(case.ground) + up))
    alike(case, one, other, f"heights + {up:g}")


def the_type_and_layout_of_arrays_are_free(case, backend):
    depth = depth_of(case.ground).astype(np.float32)
    one = rendered(case, backend, scene_of(case.ground, depth))
    kinds = {
        "float64": depth.astype(np.float64),
        "big-endian": depth.astype(">f4"),
        "Fortran": np.asfortranarray(depth),
        "strided": np.repeat(np.repeat(depth, 2, 0), 2, 1)[::2, 1::2],
        "reversed": depth[::-1, ::-1].copy()[::-1, ::-1],
    }
    name = list(kinds)[case.seed % len(kinds)]
    given = kinds[name]
    before = given.tobytes()
    other = rendered(case, backend, scene_of(case.ground, given))
    assert np.asarray(one.image).tobytes() == np.asarray(other.image).tobytes(), name
    assert given.tobytes() == before, "the caller's array was changed"


# -- light ---------------------------------------------------------------------------------------------------


def bytes_repeat(case, backend):
    how = {"quantity": "radiance", "interreflection": "auto" if "tolerance" in case.how else False}
    one, other = (rendered(case, backend, **how) for _ in range(2))
    assert np.asarray(one.image).tobytes() == np.asarray(other.image).tobytes()
    assert one.warnings == other.warnings and one.plan == other.plan


def backends_agree(case, backend):
    """With NumPy's."""
    alike(case, rendered(case, backend), rendered(case, "numpy"), f"{backend} and numpy")


def sources_add(case, backend):
    """The image of a sum of brightnesses is the sum of their images."""
    one, two = brightness_of(case), sl.cie_overcast(0.7)
    value = one if callable(one) else lambda L: np.full(L.shape[:-1], one)
    images = [rendered(case, backend, source=source_of(case, light)) for light in (value, two)]
    both = rendered(case, backend, source=source_of(case, lambda L: value(L) + two(L)))
    total = Shown(
        sum(np.asarray(out.image, float) for out in images), [t for o in images for t in o.warnings]
    )
    alike(case, both, total, "a sum of sources")


def albedo_is_linear(case, backend):
    """Direct radiance is albedo E / pi, whatever the albedo."""
    light = np.asarray(rendered(case, backend).image, float)
    for albedo in (0.0, 0.25, 1.0):
        scene = scene_of(case.ground, albedo=albedo)
        image = np.asarray(rendered(case, backend, scene, quantity="radiance").image, float)
        np.testing.assert_allclose(image, albedo * light / np.pi, rtol=1e-5, atol=1e-30)


def ground_raised_elsewhere_never_brightens(case, backend):
    """A uniform sky, no node beside the raised one, whose normals change."""
    rng, ground = np.random.default_rng(case.seed), case.ground
    row, col = int(rng.integers(ground.rows)), int(rng.integers(ground.cols))
    depth = depth_of(ground)
    if not np.isfinite(depth[row, col]):
        return
    higher = depth.copy()
    higher[row, col] *= rng.random()
    one, other = (rendered(case, backend, scene_of(ground, z), sl.Sky()).image for z in (depth, higher))
    y, x = np.indices(depth.shape)
    apart = [abs(y - row), abs(x - col)]
    if ground.sides == "periodic":
        apart = [np.minimum(a, n - a) for a, n in zip(apart, depth.shape)]
    far = (apart[0] + apart[1] > 1) & np.isfinite(one)
    more = np.maximum(0, (np.asarray(other, float) - one)[far])
    # Behind cliffs (docs/explanation/model.md) a sweep may lose the horizons of an azimuth or two, a quarter
    # of the light, at few nodes; the lattice differs by rounding alone.
    most, rms = (ROUNDING, ROUNDING) if "hemicube" in case.how else (1 / 4, 0.01)
    assert more.max(initial=0.0) <= np.pi * most, f"{more.max():.3g} brighter"
    square = float(np.mean(more**2)) if more.size else 0.0
    assert square <= (np.pi * rms) ** 2, f"RMS {np.sqrt(square):.3g} brighter"


def no_more_light_than_there_is(case, backend):
    """0 <= E <= pi x the greatest brightness, of all light too; no number of the report is broken."""
    out = rendered(case, backend, interreflection=case.seed % 2 == 0 and "tolerance" in case.how)
    image = np.asarray(out.image, float)
    valid = mask_of(case.ground)
    finite = np.isfinite(image)
    assert np.array_equal(finite, np.ones_like(finite) if valid is None else valid), "not finite"
    light = brightness_of(case)
    most = light if not callable(light) else 31.0 if case.light == "sun" else greatest(light)
    slack = 1 + (4 * case.how["tolerance"] if "tolerance" in case.how else 0.02)
    values = image[finite]
    assert values.min() >= 0, f"negative: {values.min():.3g}, mean {mean_of(image):.3g}"
    if not out.warnings:
        assert values.max() <= slack * np.pi * most + 1e-30, f"{values.max():.4g} of {np.pi * most:.4g}"
    if "tolerance" in case.how:
        error = np.asarray(out.error)[finite]
        assert (error >= 0).all() and (np.isfinite(error).all() or out.warnings), "error"


def greatest(light):
    azimuth, sine = np.meshgrid(np.linspace(0, 2 * np.pi, 241), np.linspace(0, 1, 121))
    return float(np.max(light(sl.sources.directions_of(azimuth, sine))))


def tiles_equal_the_whole(case, backend):
    """Where the margin holds all of the map, to rounding of heights."""
    scene, K = scene_of(case.ground), 8
    whole = sl.sky_view_factor(scene, azimuths=K, backend=backend)
    tiled = sl.sky_view_factor(scene, azimuths=K, backend=backend, tiling=sl.Tiling(64, 64, 4))
    np.testing.assert_allclose(tiled, whole, rtol=0, atol=2e-3)


# -- brute force ---------------------------------------------------------------------------------------------

KEPT = {"cases": 0, "kept": 0, "unwarned": 0, "worst": 0.0}  # of the tolerance, over all cases so far


def tolerance_is_kept(case, backend):
    """The RMS error by brute force is within the tolerance, or a warning says that it is not."""
    ground, tolerance = case.ground, case.how["tolerance"]
    out = rendered(case, backend)
    scene = scene_of(ground)
    depth, valid = np.asarray(scene.depth, float), scene.valid
    rng = np.random.default_rng(case.seed)
    # in the plane of a window its light is not defined
    known = np.argwhere(valid & (depth > 0) if case.source == "window" else valid)
    if not len(known):
        return
    nodes = tuple(known[rng.permutation(len(known))[:48]].T)
    light, source = brightness_of(case), source_of(case)
    more = {"sides": ground.sides}
    if case.source == "sky":
        count = 384
        angles = 2 * np.pi * (np.arange(count) + 0.37) / count
        slopes = oracle.horizons(depth, ground.spacing, angles, ground.sides, nodes=nodes)
        widths = np.full(count, 2 * np.pi / count)
        exact = oracle.sky_irradiance(
            depth, ground.spacing, valid, angles, widths, slopes, light, nodes, ground.sides
        )
    elif case.source == "window":
        exact = oracle.window_irradiance(depth, ground.spacing, valid, source, nodes, 16384, **more)
    else:
        lamp = source
        if case.source == "panel":
            lamp = source.corner, *source.edges, light
        exact = oracle.lamp_irradiance(depth, ground.spacing, valid, lamp, nodes, 16384, **more)
    image = np.asarray(out.image, float)
    mean = mean_of(image)
    if mean == 0 and exact.max() <= 0:
        return
    # a mean counts as a millionth at least of the light of the brightest direction (docs on tolerance)
    off = np.sqrt(np.mean((image[nodes] - exact) ** 2)) / max(mean, mean_of(exact), DARK)
    noise = 0.004  # of 16384 rays, and of few nodes for the mean
    KEPT["cases"] += 1
    KEPT["kept"] += int(off <= tolerance + noise)
    if not any(text.startswith(("Tolerance", "Tail")) for text in out.warnings):
        KEPT["worst"] = max(KEPT["worst"], float(off / tolerance))
        KEPT["unwarned"] += int(off > 1.5 * tolerance + noise)
        assert off <= 1.5 * tolerance + noise, f"{off:.4f} off, {tolerance} asked for, no warning"


# -- everything else -----------------------------------------------------------------------------------------


def nothing_breaks(case, backend):
    """Any input ends in a result that is whole, or in an error of skylamp's own."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        odd.check(case, backend)


MOVABLE = cases(how=METHODS, lights=("number",) * 4 + ("overcast", "cosine", "map"), most=24).filter(
    lambda case: (
        not (
            "azimuths" in case.how
            and (case.light != "number" or case.source != "sky")  # placed by the light
            or "hemicube" in case.how
            and (case.ground.sides == "dark" or case.source == "window")  # half-open
        )
    )
)
SKIES = {"sources": ("sky",)}
RELATIONS = {
    "files": Relation(files.cases(), files.check, 60),
    "nothing breaks": Relation(odd.cases(), nothing_breaks, 8),
    "mirrors": Relation(MOVABLE, mirrored_maps_have_mirrored_images, 1.5),
    "turns": Relation(MOVABLE, transposed_maps_have_transposed_images, 1.5),
    "unit of length": Relation(cases(most=32), the_unit_of_length_is_free, 2),
    "differences of height": Relation(
        cases(how=METHODS, **SKIES).filter(lambda case: case.ground.sides != "dark"),
        only_differences_of_height_count,
        1,
    ),
    "types and layouts": Relation(cases(most=32), the_type_and_layout_of_arrays_are_free, 1.5),
    "bytes repeat": Relation(cases(), bytes_repeat, 2),
    "backends agree": Relation(cases(most=24), backends_agree, 2),
    "sources add": Relation(cases(how=METHODS[:1] + METHODS[2:4] * 2, most=24), sources_add, 1),
    "albedo": Relation(cases(how=EXPLICIT, most=32), albedo_is_linear, 1),
    "raised ground": Relation(  # a tolerance allows single nodes ten times as much
        cases(how=METHODS[1:4], lights=("number",), **SKIES), ground_raised_elsewhere_never_brightens, 2
    ),
    "energy": Relation(cases(), no_more_light_than_there_is, 2),
    "tiles": Relation(cases(lights=("number",), **SKIES), tiles_equal_the_whole, 1),
    "tolerance": Relation(
        cases(
            how=({"tolerance": 0.03}, {"tolerance": 0.01}),
            lights=("number",) * 4 + ("overcast", "cosine"),
            most=20,
            least=4,
        ),
        tolerance_is_kept,
        1.5,
    ),
}
__all__ = ["Case", "RELATIONS", "grounds", "powers_of_ten", "with_ground"]
