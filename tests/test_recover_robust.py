"""recover(method="robust"): accurate, stable where carving is not, and honest about what it cannot know."""

import contextlib
import functools
import importlib
import itertools
import logging
import math
import re
import time
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import surfaces
from scipy.optimize import minimize
from surfaces import ALBEDO, SURFACES, rms

import skylamp as sl
from skylamp.backends import select
from skylamp.inverse import confidence, diagnostics, search
from skylamp.inverse.by_light import by_light
from skylamp.inverse.confidence import confidence_of
from skylamp.inverse.descent import Descent, Solution
from skylamp.inverse.finer_model import refit_of
from skylamp.inverse.multigrid import Multigrid
from skylamp.inverse.place import free_place
from skylamp.inverse.posterior import posterior_deviation
from skylamp.inverse.pyramid import IMAGE_RMS, Pyramid, noise_of, noise_of_all
from skylamp.inverse.resampling import blurred

SMALL = SIZE = 32  # half the size of performance/recover.py: a layer here is two there
LAYERS = 32
# surfaces.pair renders direct light
recover = functools.partial(sl.recover, interreflection=False)
pair, source_of = (functools.partial(f, size=SMALL) for f in (surfaces.pair, surfaces.source_of))


@functools.cache
def found(name, kind, backend, size=SIZE, **more):
    depth, image = surfaces.pair(name, kind, size)
    return recover(
        image,
        surfaces.source_of(kind, size),
        ALBEDO,
        "dark",
        layers=LAYERS * size // SIZE,
        backend=backend,
        **more,
    )


@functools.cache
def carved(name, kind, eps, backend):
    depth, image = pair(name, kind)
    return recover(
        image, source_of(kind), ALBEDO, "dark", layers=LAYERS, method="paper", eps=eps, backend=backend
    ).depth


def off(name, kind, backend, size=SIZE):
    return rms(found(name, kind, backend, size).depth - surfaces.pair(name, kind, size)[0])


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_uniform_sky(fast, name):
    """At most one layer off, and five times nearer than carving at its best eps."""
    best = min(rms(carved(name, "sky", eps, fast) - pair(name, "sky")[0]) for eps in (0.02, 0.05, 0.1))
    assert off(name, "sky", fast) < min(1.0, best / 5)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "kind", "most"),
    [("egg-crate", "sky", 0.5), ("face", "sky", 0.2), ("egg-crate", "sun", 3.0), ("bumps", "sun", 2.0)],
)
def test_hard_ones_at_full_size(fast, name, kind, most):
    """64 x 64, where a coarse grid leads astray: layers of 64."""
    assert off(name, kind, fast, 64) < most


@pytest.mark.slow
@pytest.mark.parametrize("name", ["bumps", "egg-crate", "fractal"])
def test_isotropic_lamp(fast, name):
    """At most half a layer off, forty times nearer than carving."""
    assert off(name, "lamp", fast) < min(
        0.5, rms(carved(name, "lamp", 0.05, fast) - pair(name, "lamp")[0]) / 40
    )


@pytest.mark.slow
def test_sky_with_a_sun(fast):
    """At most three layers off on a fractal, eight times nearer than carving."""
    assert off("fractal", "sun", fast) < min(
        3.0, rms(carved("fractal", "sun", 0.05, fast) - pair("fractal", "sun")[0]) / 8
    )


def _amplification(change, image, other, clean):
    return (rms(change - clean) / 64) / (rms(other - image) / image.max())


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_noise_is_damped(fast, name):
    """White noise of 3 % of the maximum changes depth by less than half of that share of its range."""
    image = surfaces.pair(name, "sky")[1]
    other = np.maximum(image + 0.03 * image.max() * np.random.default_rng(5).normal(size=image.shape), 0)
    noisy = recover(other, sl.Sky(), ALBEDO, "dark", backend=fast)
    assert _amplification(noisy.depth, image, other, found(name, "sky", fast, 64).depth) < 0.5


def _pyramid(fast, image, kind, albedo=ALBEDO):
    return Pyramid(
        select(fast),
        [image],
        [source_of(kind)],
        albedo,
        "dark",
        np.full(image.shape, 1e-3),
        np.full(image.shape, 32.0),
    )


def test_a_mosaic_takes_every_place_from_the_surface_that_fits_there(fast, monkeypatch):
    """Of two that are two layers off in one half each, before it is eased: nearly right in both, but where
    they meet.
    """
    depth, image = pair("egg-crate", "lamp")
    west = np.arange(SMALL) < SMALL // 2
    work = search.Search(Multigrid(_pyramid(fast, image, "lamp")))
    work.level = 0
    work.answers = [Solution(depth + np.where(here, 2.0, 0.0), np.inf) for here in (west, ~west)]
    monkeypatch.setattr(work.multigrid, "relax", lambda level, z, *how: Solution(z, 0.0))
    search.join(work)
    joined, away = work.answers[2].depth, np.abs(np.arange(SMALL) - (SMALL - 1) / 2) > 4
    assert rms((joined - depth)[:, away]) < 0.1 and rms(joined - depth) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name, kind", [("egg-crate", "sky"), ("face", "sky")])
def test_relief_that_is_wrong_in_one_place_is_mirrored(fast, name, kind):
    """Round the strongest relief a peak is taken for a pit. From there the same solver does not return, but
    from the mirrored relief it does.
    """
    depth, image = pair(name, kind)
    middle = blurred(np.asarray(depth, float), 6)
    row, col = np.unravel_index(np.argmax(np.abs(middle - depth)[4:-4, 4:-4]), (SMALL - 8, SMALL - 8))
    y, x = np.mgrid[:SMALL, :SMALL]
    there = np.exp(-((y - row - 4) ** 2 + (x - col - 4) ** 2) / (2 * 3.5**2))
    work = search.Search(Multigrid(_pyramid(fast, image, kind)))
    work.level = 0
    wrong = work.multigrid.settle(0, depth + 2 * there * (middle - depth))
    wrong = work.multigrid.settle(0, wrong.depth)
    assert rms(wrong.depth - depth) > 0.4
    work.answers = [wrong]
    search.start_mirrored(work)
    best = min(work.answers, key=lambda answer: answer.objective)
    assert rms(best.depth - depth) < 0.15 and best.objective < 0.2 * wrong.objective
    search.choose(work)
    assert work.answers[0] is best


def test_what_is_polished_has_no_prior_of_what_was_tried_last(fast):
    """With noise, smoothness has a coarser surface as its prior: of the answer, not of another start."""
    depth, image = pair("egg-crate", "sky")
    image = np.maximum(image + 0.03 * image.max() * np.random.default_rng(3).normal(size=image.shape), 0)
    pyramid = _pyramid(fast, image, "sky")
    pyramid.set_prior(0, depth[::-1])
    assert rms(Multigrid(pyramid).polish(0, depth).depth - depth) < 0.5


@pytest.mark.parametrize("albedo_found", [False, True])
def test_without_noise_nothing_is_left_undecided_by_it(fast, monkeypatch, albedo_found):
    """The posterior standard deviation is 0 where noise is: smoothness, however large, does
    not move a surface that is its own prior. Also where the albedo was not given.
    """
    depth, image = pair("egg-crate", "sky")
    pyramid = _pyramid(fast, image, "sky", None if albedo_found else ALBEDO)
    if albedo_found:
        pyramid.fix_albedo(0, depth)
    monkeypatch.setattr(pyramid, "smoothness", lambda level: 1.0)
    std = posterior_deviation(pyramid.problem(0), depth, pyramid.smoothness(0), 0.0)
    np.testing.assert_array_equal(std, np.zeros(depth.shape))


@pytest.mark.parametrize(
    "shape, begins",
    [
        ((64, 64), (16, 16)),
        ((32, 60), (16, 30)),
        ((96, 96), (48, 48)),
        ((128, 128), (64, 64)),
        ((256, 256), (128, 128)),
        ((300, 520), (38, 65)),
        ((256, 40), (128, 20)),
        ((20, 300), (20, 300)),
    ],
)
def test_large_images_begin_on_a_grid_that_sees_their_relief(fast, shape, begins):
    """Small ones at 16 nodes, where starts cost least; others at most 128, but never on their own grid if
    there is a coarser one.
    """
    pyramid = _pyramid(fast, np.ones(shape), "sky")
    assert pyramid.images[pyramid.start][0].shape == begins


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "method"),
    [
        ((96, 96), {"method": "lattice", "hemicube": 33, "filled": True}),
        ((70, 130), {"method": "horizon", "azimuths": 64}),
    ],
)
def test_strong_relief_in_a_large_image(fast, shape, method):
    """Deep folds darken themselves so much that no flat surface on the grid of starts leads to them: only
    shallower starts on coarser ones do.
    """
    y, x = np.indices(shape)
    depth = 16 + 24 * np.sin(x / 9.6 + 1.2 * np.sin(y / 15)) ** 2
    image = sl.render(sl.Scene(depth, albedo=0.3, sides="dark"), sl.Sky(), backend=fast, **method).image
    assert rms(recover(image, sl.Sky(), 0.3, "dark", backend=fast).depth - depth) < 0.5


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_the_confident_half_is_the_better_one(fast, name):
    """Where errors are above 0.03 nodes its error is at most 0.7 times that of the rest, and nine true depths
    of ten are within two std.
    """
    got, depth = found(name, "sky", fast, 64), surfaces.pair(name, "sky")[0]
    sure, error = got.confidence > np.median(got.confidence), np.abs(got.depth - depth)
    assert rms(error[sure]) < max(0.7 * rms(error[~sure]), 0.03)
    assert np.mean(error < 2 * got.std) > 0.9 and np.median(got.std) < 5 * rms(error)


@pytest.mark.slow
def test_the_std_is_as_large_as_the_errors(fast):
    """Of all pixels of two surfaces more than half lie within one standard deviation, most within two, and it
    is not many times too large either.
    """
    within = []
    for name in ("face", "egg-crate"):
        got = found(name, "sky", fast)
        assert got.std.dtype == np.float32 and got.std.shape == got.depth.shape and (got.std > 0).all()
        within.append(np.abs(got.depth - pair(name, "sky")[0]) / got.std)
    within = np.concatenate(within)
    assert (within < 1).mean() > 0.5 and (within < 2).mean() > 0.8 and np.median(within) > 0.1


@pytest.mark.slow
def test_the_std_knows_that_open_sides_hide_the_place_under_a_sky(fast):
    """Overcast light and open sides: 5 nodes too shallow as a whole, with a median std of 0.8."""
    y, x = np.mgrid[:32, :32]
    depth = 10 + 2 * np.sin(x / 4) * np.cos(y / 5)
    sky = sl.Sky(sl.cie_overcast())
    image = sl.render(sl.Scene(depth, 1.0, 0.5), sky, interreflection=False, backend=fast).image
    done = sl.recover(image, sky, albedo=0.5, layers=20, interreflection=False, backend=fast)
    off = np.abs(done.depth - depth)
    assert np.mean(off < 2 * done.std) > 0.95 and done.confidence.max() < 0.5
    near, far = (np.full(depth.shape, place) for place in (depth.min() - 0.1, depth.max() + 0.1))
    known = sl.recover(image, sky, 0.5, near=near, far=far, interreflection=False, backend=fast)
    assert np.median(known.std) < 0.4 * np.median(done.std)


@pytest.mark.slow
def test_std_has_the_unit_of_spacing_and_confidence_has_none(fast):
    """The same image of a map three times as large: three times the std, the same confidence."""
    image, one = pair("face", "sky")[1], found("face", "sky", fast)
    large = recover(image, sl.Sky(), ALBEDO, "dark", spacing=3.0, layers=LAYERS, backend=fast)
    np.testing.assert_allclose(large.std, 3 * one.std, rtol=1e-4)
    np.testing.assert_allclose(large.confidence, one.confidence, atol=1e-4)


def test_what_confidence_says_of_a_std():
    """Of a range of 128 nodes two are right, and one node of a small range: there the median of a normal
    error's size is worth one half.
    """
    std = np.array([[1e-3, 2 / 0.6745, 4 / 0.6745, 1e6]])
    np.testing.assert_allclose(confidence_of(std, 128.0), [[1, 0.5, 0.2, 0]], atol=1e-6)
    np.testing.assert_array_equal(confidence_of(std / 2, 10.0), confidence_of(std, 128.0))


@pytest.mark.slow
def test_noise_makes_the_std_larger_and_a_second_image_smaller(fast):
    """3 % of noise; a lamp with as much noise beside the sky."""
    kinds, noise = ("sky", "lamp"), 0.03 * np.random.default_rng(2).normal(size=(2, SIZE, SIZE))
    images = [
        np.maximum(image + own * image.max(), 0)
        for image, own in zip((pair("face", kind)[1] for kind in kinds), noise)
    ]
    lights = [source_of(kind) for kind in kinds]
    one, two = (
        recover(images[:n], lights[:n], ALBEDO, "dark", layers=LAYERS, backend=fast).std for n in (1, 2)
    )
    assert np.median(one) > 2 * np.median(found("face", "sky", fast).std)
    assert np.median(two) < 0.8 * np.median(one)


@pytest.mark.slow
def test_a_spotlights_wrong_surface_has_a_large_std(fast):
    """Ripples under a spotlight are found many nodes too deep, by a surface whose image fits better than that
    of the truth: another answer tells.
    """
    depth, got = surfaces.pair("ripples", "spot", 40)[0], found("ripples", "spot", fast, 40)
    wrong = np.abs(got.depth - depth) > 5
    assert wrong.mean() > 0.5
    assert (got.confidence[wrong] < 0.5).mean() > 0.95 and np.median(got.std[wrong]) > 5


@pytest.mark.slow
def test_a_corner_shifted_behind_folds_has_a_large_std_under_a_sun(fast):
    """A corner that the sun does not join to the rest is found up to 15 nodes too deep, by every start.

    Of what is right 0.15 is marked; the share depends on the processor, by whose rounding the search goes.
    """
    depth, got = surfaces.pair("folds", "sun")[0], found("folds", "sun", fast, 64)
    wrong = np.abs(got.depth - depth)
    assert (wrong > 5).any()
    assert (got.confidence[wrong > 5] < 0.5).mean() > 0.7 and (got.confidence[wrong < 2] < 0.5).mean() < 0.2


@pytest.mark.slow
def test_a_spotlights_wrong_pixels_are_marked(fast):
    """Most of what is wrong by more than five layers is ambiguous or not trusted, a quarter at most of what
    is right within two (0.19 seen, beside all of the 134 wrong). The plane and the face are right.
    """
    wrong, right = [], []
    for name in ("bumps", "egg-crate", "fractal"):
        got = found(name, "spot", fast, 40)
        off = np.abs(got.depth - surfaces.pair(name, "spot", 40)[0])
        marked = (got.confidence < 0.5) | got.ambiguous
        wrong.append(marked[off > 5])
        right.append(marked[off < 2])
    assert np.concatenate(wrong).size > 100
    assert np.concatenate(wrong).mean() > 0.9 and np.concatenate(right).mean() < 0.25


@pytest.mark.slow
def test_real_terrain_under_a_lamp(fast):
    """A crop of real terrain, larger than the grid on which confidence is worked out: shape and normals, and
    most of it is trusted.
    """
    depth = surfaces.terrain(96)
    image = surfaces.image_of(depth, surfaces.lamp_over(96))
    got = recover(
        image, surfaces.lamp_over(96), ALBEDO, "dark", layers=int(np.ceil(1.2 * depth.max())), backend=fast
    )
    correlation, angle = surfaces.compared(depth, got.depth)
    assert correlation > 0.98 and angle < 6 and (got.confidence > 0.5).mean() > 0.7


def test_steps_end_where_scipy_ends(fast):
    """L-BFGS-B on the same objective and gradient, 16 x 16 under a sky: neither finds a surface that is
    better by more than a hundredth of the start's objective.
    """
    image = surfaces.pair("fractal", "sky", 16)[1]
    pyramid = Pyramid(
        select(fast),
        [image],
        [sl.Sky()],
        np.array(ALBEDO),
        "dark",
        np.full(image.shape, 1e-3),
        np.full(image.shape, 16.0),
    )
    problem, start, weight = pyramid.problem(0), np.full(image.shape, 8.0), 1e-3

    def objective(z):
        value = problem.value(z.reshape(image.shape), weight)
        solver = problem.gradients
        solver.gradient(problem.here, sum(problem.misfits), weight)
        return value, -problem.backend.download(solver.r[0]).astype(float)

    theirs = minimize(
        objective,
        start.ravel(),
        jac=True,
        method="L-BFGS-B",
        bounds=[(1e-3, 16.0)] * start.size,
        options={"maxiter": 500},
    )
    ours = problem.run(start, weight, 50, 300, 0.003, 1e-6)[1]
    assert abs(ours - theirs.fun) < 0.01 * problem.value(start, weight)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("what", "most", "carving"), [("noise 3 %", 0.5, 5), ("8 bits", 1.5, 20), ("albedo 5 %", 1.5, 5)]
)
def test_stable_where_carving_is_not(fast, what, most, carving):
    """Change of depth over change of image, as shares of their ranges: small, where carving multiplies it."""
    depth, image = surfaces.pair("bumps", "sky")
    noise = np.random.default_rng(7).normal(size=image.shape)
    other = {
        "noise 1 %": lambda: image + 0.01 * image.max() * noise,
        "noise 3 %": lambda: np.maximum(image + 0.03 * image.max() * noise, 0),
        # fmt: skip
        "8 bits": lambda: np.rint(image / image.max() * 255) / 255 * image.max(),
        "albedo 5 %": lambda: 1.05 * image,
    }[what]()
    robust = recover(other, sl.Sky(), ALBEDO, "dark", backend=fast)
    assert _amplification(robust.depth, image, other, found("bumps", "sky", fast, 64).depth) < most
    clean, again = (
        recover(picture, sl.Sky(), ALBEDO, "dark", method="paper", backend=fast).depth
        for picture in (image, other)
    )
    assert _amplification(again, image, other, clean) > carving


@pytest.mark.slow
def test_nothing_is_drilled(fast):
    """No column comes near the far boundary, which carving reaches."""
    assert found("bumps", "sky", fast).depth.max() < 24 and not found("bumps", "sky", fast).drilled.any()
    assert (carved("bumps", "sky", 0.002, fast) >= LAYERS).mean() > 0.3


@pytest.mark.slow
def test_a_second_image_settles_a_spotlight(fast):
    """A spotlight's image is wrong by many layers; together with the sky's image it is right."""
    depth, image = pair("egg-crate", "spot")
    alone = found("egg-crate", "spot", fast, SMALL)
    both = recover(
        [image, pair("egg-crate", "sky")[1]],
        [source_of("spot"), sl.Sky()],
        ALBEDO,
        "dark",
        layers=32,
        backend=fast,
    )
    assert rms(both.depth - depth) < min(1.0, rms(alone.depth - depth) + 0.1)


@functools.cache
def both_lit(name, kinds, backend, brighter=1.0):
    """(truth, its albedo, what is found) of a chequered surface under two sources, its albedo not given."""
    y, x = np.indices((SMALL, SMALL)) // 4
    albedo = np.where((x + y) % 2, 0.7, 0.3)
    images = [brighter * pair(name, kind)[1] * albedo / ALBEDO for kind in kinds]
    return (
        pair(name, kinds[0])[0],
        albedo,
        recover(images, [source_of(kind) for kind in kinds], None, "dark", layers=LAYERS, backend=backend),
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_two_images_tell_the_albedo(fast, name):
    """A chequered surface under a sky and under a lamp: depth and albedo of every pixel."""
    depth, albedo, got = both_lit(name, ("sky", "lamp"), fast)
    assert rms(got.depth - depth) < 0.3 and rms(got.albedo - albedo) < 0.04
    assert (got.confidence > 0.5).mean() > 0.8 and got.warnings == []


@pytest.mark.slow
@pytest.mark.parametrize("brighter", [1e-4, 1e9])
def test_an_albedo_in_any_unit(fast, brighter):
    """Images so many times as bright, as counts may be: the albedo is as many times as large, depth the
    same.
    """
    *_, got = both_lit("fractal", ("sky", "lamp"), fast)
    *_, other = both_lit("fractal", ("sky", "lamp"), fast, brighter)
    assert rms(got.depth - other.depth) < 0.02 and rms(other.albedo / brighter - got.albedo) < 0.01


@pytest.mark.slow
def test_light_between_surfaces_in_another_unit(fast):
    """What ground sends to ground is not known of images in counts: "auto" leaves it out, True warns."""
    size, kinds = 20, ("sky", "lamp")
    images = [1e4 * surfaces.pair("bumps", kind, size)[1] for kind in kinds]
    lights = [surfaces.source_of(kind, size) for kind in kinds]
    options = dict(albedo=None, sides="dark", layers=size, backend=fast)
    direct, auto = (sl.recover(images, lights, interreflection=b, **options) for b in (False, "auto"))
    np.testing.assert_array_equal(auto.depth, direct.depth)
    assert not auto.interreflection and direct.warnings == []
    assert [w[:38] for w in auto.warnings] == ["Light between surfaces is left out: th"]
    asked = sl.recover(images, lights, interreflection=True, max_seconds=1.0, **options)
    assert any(w.startswith("Light between surfaces is wrong: ") for w in asked.warnings)
    usual = [image / 1e4 for image in images]
    found = sl.recover(usual, lights, interreflection=True, max_seconds=1.0, **options)
    assert not any("another unit" in w for w in found.warnings)


def test_images_with_other_coordinates_are_refused(fast):
    """Of several DataArrays, an albedo and a bound: rows in another order are not taken one by one."""
    xarray = pytest.importorskip("xarray")
    image = xarray.DataArray(
        np.ones((8, 9)), dims=("y", "x"), coords={"y": np.arange(8.0), "x": np.arange(9.0)}
    )
    lamp = sl.Lamp(center=(4.0, 4.0, -9.0), radius=2.0)
    recovered = functools.partial(recover, backend=fast, layers=4)
    with pytest.raises(sl.InputError, match="image 2: coordinate 'y'"):
        recovered([image, image[::-1]], [lamp, lamp])
    for name in ("albedo", "near"):
        with pytest.raises(sl.InputError, match=f"{name}: coordinate 'y'"):
            recovered(image, lamp, **{name: 0.5 * image[::-1]})


@pytest.mark.slow
def test_the_axes_are_those_of_any_image_that_has_them(fast):
    """A plain array first: the coordinates of the second image were ignored, its depths 3 layers wrong."""
    xarray = pytest.importorskip("xarray")
    y, x = np.mgrid[:16, :16]
    values = 0.2 + 0.01 * y + 0.005 * x
    labelled = xarray.DataArray(
        values, dims=("y", "x"), coords={"y": 1.0 * np.arange(16), "x": np.arange(16.0)}
    )
    lights = [sl.Lamp(center=(24.0, 4.0, -9.0), radius=2.0), sl.Sky()]
    both, second = (
        recover([first, labelled], lights, backend=fast, layers=4) for first in (labelled, values)
    )
    np.testing.assert_array_equal(both.depth, second.depth)
    assert second.depth.dims == ("y", "x")


@pytest.mark.slow
def test_an_albedo_that_two_images_do_not_tell_is_not_trusted(fast):
    """Two skies say little of it: what is wrong by more than a layer is marked, what is trusted is far better
    than the rest, and a warning says why.
    """
    depth, _, got = both_lit("bumps", ("sky", "sun"), fast)
    off = np.abs(got.depth - depth)
    assert (off > 1).mean() > 0.2
    assert (got.confidence < 0.5)[off > 1].mean() > 0.9
    assert (got.confidence > 0.5).mean() > 0.1 and rms(off[got.confidence > 0.5]) < 0.3 * rms(off)
    assert any("albedo" in warning for warning in got.warnings)


def _painted(depth, paint, lights, noise, sides, backend):
    """What is found of ground painted in squares of two albedos, which are not given, and its errors."""
    y, x = np.indices(depth.shape)
    scene = sl.Scene(depth, albedo=np.choose((x // 5 + y // 7) % 2, paint), sides=sides)
    options = dict(tolerance=0.002, interreflection=False, backend=backend)
    images, random = [sl.render(scene, light, **options).image for light in lights], np.random.default_rng(7)
    images = [np.maximum(i + noise * i.max() * random.normal(size=i.shape), 0) for i in images]
    got = recover(images, lights, None, sides, layers=16, backend=backend)
    return got, np.abs(got.depth - depth)


_Y, _X = np.mgrid[:24, :24]
WAVES = 6 + 2 * np.sin(_X / 4 + 0.3) * np.cos(_Y / 5) + 0.05 * _X
LAMPS = [sl.Lamp(at, radius=2, brightness=25) for at in ((-10, 5, -12), (30, 12, -15), (10, 35, -10))]


@pytest.mark.parametrize("noise", [0.0, 0.01, 0.03])
@pytest.mark.parametrize("kinds", [("sky",), ("sky", "lamp")])
def test_paint_is_no_noise(noise, kinds):
    """Squares of 4 nodes were 10 % of noise, by whose smoothness depth was a node off in clean images."""
    paint, random = np.choose(np.indices((32, 32)).sum(0) // 4 % 2, (0.3, 0.7)), np.random.default_rng(4)
    images = [pair("bumps", kind)[1] * paint for kind in kinds]
    images = [image / rms(image) + noise * random.normal(size=image.shape) for image in images]
    known, albedo = [np.ones((32, 32)) for _ in images], paint if len(kinds) == 1 else None
    assert noise_of_all(images, known, 0.5) > 0.1
    assert 0.7 * noise <= noise_of_all(images, known, albedo) < 1.3 * noise + 1e-3
    known[0][:, :16] = known[-1][:, 15:] = 0  # no pixel is known of both, or of the one
    expected = noise_of_all(images, known, 0.5)
    assert noise_of_all(images, known, albedo) == expected and (expected > 0) == (len(kinds) > 1)


@pytest.mark.slow
def test_three_lamps_fix_a_painted_surface(fast):
    """The std followed the contrast of the paint: 3.7 nodes on average where the error is 0.06."""
    got, off = _painted(WAVES, (0.7, 0.2), LAMPS, 0, "open", fast)
    assert rms(off) < 0.1 and got.std.mean() < 1.5 and got.warnings == []


@pytest.mark.slow
def test_walls_alone_do_not_tell_the_place(fast):
    """Two skies over an unknown albedo, 1 % of noise: three nodes off with a std of 0.1 and no warning."""
    skies = [sl.Sky(), sl.Sky(sl.cosine_power(20, (0.5, 0.3, -0.8)))]
    got, off = _painted(WAVES, (0.4, 0.4), skies, 0.01, "dark", fast)
    assert rms(off) > 2 and np.mean(off < 2 * got.std) > 0.85
    assert any("depends on the albedo" in text for text in got.warnings)


@pytest.mark.slow
def test_noise_of_an_unknown_albedo_counts(fast):
    """A sky and a lamp over rough ground, 1 % of noise: 38 % of the depths were within two std."""
    row, col = np.fft.fftfreq(24)[:, None], np.fft.rfftfreq(24)
    waves = np.fft.rfft2(np.random.default_rng(3).normal(size=(24, 24)))
    relief = np.fft.irfft2(waves * np.exp(-((6 * np.hypot(row, col)) ** 2)), (24, 24))
    depth = np.maximum(6 + 2 * (relief - relief.mean()) / relief.std(), 0.5)
    got, off = _painted(depth, (0.4, 0.4), [sl.Sky(), LAMPS[0]], 0.01, "dark", fast)
    assert np.mean(off < 2 * got.std) > 0.75


def test_one_image_cannot_tell_the_albedo():
    """albedo=None with one image, or with method='paper', is an error that names several images."""
    for more in (
        {"image": np.ones((8, 8)), "source": sl.Sky()},
        {"image": [np.ones((8, 8))], "source": [sl.Sky()]},
        {"image": np.ones((8, 8)), "source": sl.Sky(), "method": "paper"},
    ):
        with pytest.raises(sl.InputError, match="several images"):
            recover(albedo=None, sides="dark", backend="numpy", **more)


@pytest.mark.slow
def test_a_prior_is_kept_and_helps(fast):
    """near and far, as maps: depth lies between them, and nearer to the truth."""
    depth, image = pair("egg-crate", "spot")
    got = recover(
        image,
        source_of("spot"),
        ALBEDO,
        "dark",
        near=np.maximum(depth - 3, 0),
        far=depth + 3,
        layers=32,
        backend=fast,
    )
    assert (
        (got.depth >= depth - 3.001).all()
        and (got.depth <= depth + 3.001).all()
        and rms(got.depth - depth) < 1.0
    )


@pytest.mark.slow
def test_all_backends_find_the_same_depth(backend):
    """To the last bit, from flat starts to the answer."""
    expected = found("bumps", "sky", "numpy", 12)
    got = found("bumps", "sky", backend, 12)
    np.testing.assert_array_equal(got.depth, expected.depth)
    np.testing.assert_allclose(got.confidence, expected.confidence, atol=1e-6)
    assert got.backend == backend and np.ptp(got.depth) > 1


@pytest.mark.slow
def test_spacing_is_a_unit(fast):
    """Everything twice as long: the same image, twice the depth."""
    depth, image = pair("bumps", "lamp")
    lamp = source_of("lamp")
    double = sl.Lamp(center=tuple(2 * c for c in lamp.center), radius=2 * lamp.radius)
    got = recover(image, double, ALBEDO, "dark", spacing=2.0, layers=32, backend=fast)
    np.testing.assert_allclose(got.depth, 2 * found("bumps", "lamp", fast, SMALL).depth, atol=1e-3)


SHINE = {
    "sky": sl.Sky,
    "lamp": lambda k: sl.Lamp((20, 10, -12), 5, k),
    "window": lambda k: sl.Window((4, 28), (4, 28), k),
    # fmt: skip
    "rectangle": lambda k: sl.Lamp(corner=(5, 5, -9), edges=((12, 0, 0), (0, 9, 0)), brightness=k),
}


@functools.cache
def lit_by(kind, backend):
    """Image (32, 32) float64 of waves under a source of brightness 1."""
    y, x = np.mgrid[:32, :32]
    return sl.render(
        sl.Scene(8 + 6 * np.sin(x / 5 + np.sin(y / 7)) ** 2, albedo=0.3, sides="dark"),
        SHINE[kind](1.0),
        method="horizon",
        backend=backend,
    ).image.astype(float)


@functools.cache
def under(kind, backend, k=1.0, **more):
    return recover(k * lit_by(kind, backend), SHINE[kind](k), 0.3, "dark", layers=32, backend=backend, **more)


@pytest.mark.slow
@pytest.mark.parametrize("kind", SHINE)
def test_light_so_many_times_as_strong(fast, kind):
    """A brightness that is a number: depth, confidence and warnings are those of brightness 1, and the
    residual is in the image's unit.
    """
    one = under(kind, fast)
    for k in (0.5, 100.0) if kind == "sky" else (100.0,):
        got = under(kind, fast, k)
        np.testing.assert_allclose(got.depth, one.depth, atol=1e-3)
        np.testing.assert_allclose(got.confidence, one.confidence, atol=1e-3)
        np.testing.assert_allclose(got.residual / k, one.residual, atol=1e-6)
        assert got.warnings == one.warnings
    assert np.ptp(one.depth) > 4 and one.confidence.mean() > 0.8


def test_carving_under_light_so_many_times_as_strong(fast):
    """A brightness that is a number: carving finds the depth of brightness 1."""
    for k in (0.5, 100.0):
        np.testing.assert_array_equal(
            under("sky", fast, k, method="paper").depth, under("sky", fast, method="paper").depth
        )


@pytest.mark.slow
def test_two_lights_of_different_strength(fast):
    """Each image in the unit of its own source: the same depth, and the same albedo, which is not known."""
    got = [
        recover(
            [sky * lit_by("sky", fast), lamp * lit_by("lamp", fast)],
            [SHINE["sky"](sky), SHINE["lamp"](lamp)],
            None,
            "dark",
            layers=32,
            backend=fast,
        )
        for sky, lamp in ((1.0, 1.0), (100.0, 0.25))
    ]
    np.testing.assert_allclose(got[1].depth, got[0].depth, atol=1e-3)
    np.testing.assert_allclose(got[1].albedo, got[0].albedo, atol=1e-4)
    assert abs(got[0].albedo.mean() - 0.3) < 0.05


@pytest.mark.parametrize("kind", SHINE)
@pytest.mark.parametrize("method", ["robust", "paper"])
def test_nothing_is_recovered_from_darkness(kind, method):
    """A source of brightness 0 is an error, for both methods."""
    with pytest.raises(sl.InputError, match="brightness: got 0;.*darkness"):
        recover(np.ones((8, 8)), SHINE[kind](0), sides="dark", method=method, backend="numpy")


@pytest.mark.slow
def test_the_place_of_what_repeats_is_not_known(fast):
    """Under a sky an image over periodic sides is the same at any depth: std holds the bounds, a warning says
    so.
    """
    y, x = np.mgrid[:24, :24]
    depth = 10 + 3 * np.sin(2 * np.pi * x / 24)
    scene, options = sl.Scene(depth, albedo=0.5, sides="periodic"), dict(interreflection=False, backend=fast)
    image = sl.render(scene, sl.Sky(), **options).image
    found = sl.recover(image, sl.Sky(), 0.5, "periodic", layers=24, **options)
    assert any(text.startswith("Periodic sides") for text in found.warnings)
    assert (abs(found.depth - depth) < 2 * found.std).all() and np.median(found.confidence) < 0.1


def test_arguments_of_the_paper_are_told(fast):
    """hemicube, eps and stop do nothing in method "robust": it says so."""
    image = np.full((6, 6), 0.5)
    given = dict(layers=2, interreflection=False, backend=fast)
    found = sl.recover(image, sl.Sky(), hemicube=5, stop="sign", **given)
    assert any(text.startswith("Not used: hemicube, stop. ") for text in found.warnings)
    assert not any("Not used" in text for text in sl.recover(image, sl.Sky(), **given).warnings)


def test_no_time_for_light_between_surfaces_is_said(fast):
    """By "auto", which searches by direct light first: std is that of a model without it."""
    image = pair("bumps", "sky")[1]
    options = dict(layers=LAYERS, max_seconds=1e-6, backend=fast)
    for choice in ("auto", False):
        found = sl.recover(image, sl.Sky(), ALBEDO, "dark", interreflection=choice, **options)
        told = [text for text in found.warnings if text.startswith("Light between surfaces: it is left out")]
        assert len(told) == (choice == "auto"), found.warnings


@pytest.mark.slow
@pytest.mark.parametrize(
    "x, sides, is_told, is_open",
    [(-40.0, "open", True, True), (-4.0, "open", True, False), (4.0, "open", False, False)]
    + [(-20.0, "dark", False, False)],
)
def test_a_lamp_beside_the_map_is_told(x, sides, is_told, is_open):
    """Surfaces 5 nodes off explain its image, and std was 0.2. A lamp much higher than it is far from the map
    tells of the depth.
    """
    corner, edges = (x - 2, 8.0, -30.0), ((4.0, 0, 0), (0, 4.0, 0))
    for lamp in (sl.Lamp(center=(x, 10.0, -30.0), radius=6.0), sl.Lamp(corner=corner, edges=edges)):
        options = dict(layers=10, max_seconds=1e-6, interreflection=False, backend="numpy")
        found = sl.recover(np.full((32, 32), 0.02), lamp, 0.5, sides, **options)
        told = [text for text in found.warnings if text.startswith("Lamp beside the map: by ")]
        assert len(told) == is_told, found.warnings
        if is_open:
            assert found.std.min() >= 2 and found.confidence.max() < 0.5  # evenly 2.6, of 10 layers


@pytest.mark.slow
@pytest.mark.parametrize("x, most", [(-4.0, 0.3), (-40.0, math.inf)])
def test_depth_under_a_lamp_beside_the_map(fast, x, most):
    """Right where the lamp is much higher than it is far away; else it may be off by nodes, within 2 std."""
    y, across = np.mgrid[:32, :32]
    z = 9 + 1.5 * np.sin(across / 6) * np.cos(y / 5)
    lamp = sl.Lamp(center=(x, 10.0, -30.0), radius=4.0)
    image = sl.render(sl.Scene(z, albedo=0.5), lamp, interreflection=False, backend=fast).image
    found = recover(image, lamp, 0.5, "open", layers=24, backend=fast)
    off = np.abs(found.depth - z)
    assert rms(off) < most and (off < 2 * found.std).mean() > 0.9, rms(off)


SUN = sl.Sky(sl.cosine_power(8, (-0.6, -0.2, 0.8)))


def place_of(lights, sides="open", albedo=None, shape=(24, 24), ground=6.0):
    bounds = np.full(shape, 1.0), np.full(shape, 16.0)
    images = [np.ones(shape)] * len(lights)
    return free_place(Pyramid(select("numpy"), images, lights, albedo, sides, *bounds), ground)


@pytest.mark.parametrize(
    "lights",
    [
        [sl.Lamp((-20.0, 10.0, -16.0), 3.0)],
        [sl.Lamp((-14.0, 10.0, -16.0), 3.0), sl.Lamp((34.0, 16.0, -16.0), 3.0)],
        [sl.Lamp((10.0, 4.0, -25.0), 3.0), sl.Lamp((40.0, 12.0, -16.0), 3.0)],
        [sl.Lamp((-20.0, 10.0, -16.0), 3.0), sl.Sky()],
        [sl.Window((-32, -30), (9, 11)), sl.Sky()],
        pytest.param([SUN, sl.Lamp((-20.0, 10.0, -16.0), 3.0)], marks=pytest.mark.slow),
    ],
    ids=["lamp", "two of one height", "two", "lamp and sky", "window and sky", "sun and lamp"],
)
def test_how_surfaces_move_while_the_images_stay_the_same(lights, fast):
    """The image, or the ratio of two, changes by 1 to 7 % as much as by half a node of all nodes alike."""
    y, x = np.mgrid[:24, :24]
    z = 6 + 0.1 * np.sin(x / 5) * np.cos(y / 6)
    place = place_of(lights, albedo=0.8 if len(lights) == 1 else None)
    moved, line = place.lines(z.shape)
    assert moved.max() == 1 and moved.min() > 0.1 and 20 < line.max() < 60
    smooth = place.solution(z.shape)[0]
    smooth = np.exp(smooth - smooth.max())

    def logarithm(depth):
        options = dict(tolerance=1e-4, interreflection=False, backend=fast)
        scene = sl.Scene(depth, sides="open")
        images = [np.log(sl.render(scene, light, **options).image.astype(float)) for light in lights]
        return (images[0] - images[1] if len(images) == 2 else images[0])[1:-1, 1:-1]  # central differences

    own = logarithm(z)
    alike, evenly = (rms(logarithm(z + by / 2) - own) for by in (smooth, np.ones_like(z)))
    assert alike < 0.1 * evenly


@pytest.mark.slow
def test_where_lights_fix_the_place():
    """Where the line through them meets the map; and three lights, two of a known albedo, walls."""
    beside, above = sl.Lamp((-20.0, 10.0, -16.0), 3.0), sl.Lamp((10.0, 10.0, -16.0), 3.0)
    higher = sl.Lamp((9.0, 12.0, -40.0), 3.0)
    inside = sl.Lamp((-46.0, 10.0, -38.0), 3.0)  # and beside: at x = 6, y = 10
    assert place_of([beside, above]) and place_of([beside, sl.Sky()]) and place_of([beside], albedo=0.5)
    for lights in ([above, higher], [beside, inside], [above, sl.Sky()]):
        assert place_of(lights) is None
    assert place_of([above], albedo=0.5) is None and place_of([beside, above], albedo=0.5) is None
    assert place_of([beside, above, higher]) is None and place_of([SUN], albedo=0.5) is None
    assert place_of([SUN, sl.Sky()]) and place_of([SUN, sl.Sky()], "dark") is None
    hole, other = sl.Window((-32, -20), (4, 16)), sl.Window((2, 20), (2, 20))
    assert place_of([hole], albedo=0.5) and place_of([hole, other]) and place_of([hole, sl.Sky()])
    assert place_of([other], albedo=0.5) is None and place_of([other, sl.Sky()]) is None
    assert place_of([sl.Sky(), sl.Sky(sl.cie_overcast())]) is None  # neither tells anything
    moved, line = place_of([SUN, sl.Sky()]).lines((24, 24))
    assert moved.min() > 0.999 and 20 < line.max() < 40  # lines that never meet
    assert place_of([beside, sl.Sky()], "dark") is None and place_of([beside, above], "dark")


@pytest.mark.parametrize(
    "lights",
    [
        [sl.Lamp((-1e-200, 10.0, -16.0), 3.0)],
        [sl.Lamp((10.0, 10.0, -16.0), 3.0), sl.Lamp((10.0 + 1e-3, 10.0, -16.0), 3.0)],
        [sl.Lamp((30.0, 10.0, 5.999), 1e-3), sl.Lamp((-1e8, 10.0, -1e4), 3.0)],
    ],
    ids=["at the border", "two at one place", "on the ground and far away"],
)
def test_free_places_stay_finite(lights):
    place = place_of(lights, albedo=0.8 if len(lights) == 1 else None)
    moved, line = place.lines((24, 24))
    assert np.isfinite(moved).all() and 0 < moved.min() and moved.max() == 1 and line.min() == 0


@pytest.mark.slow
def test_two_lamps_over_an_unknown_albedo(fast):
    """Depth was 7 nodes off with a std of 0.2 and no warning; on a line that meets the map it is right."""
    y, x = np.mgrid[:36, :36]
    z = 8 + 2 * np.exp(-((x - 18) ** 2 + (y - 18) ** 2) / 60)
    for places, is_free in ((((-18, -12), (54, -12)), True), (((-18, -40), (4, -12)), False)):
        lamps = [sl.Lamp((at, 18, high), 3.0, brightness=60.0) for at, high in places]
        scene = sl.Scene(z, albedo=0.5)
        images = [sl.render(scene, lamp, interreflection=False, backend=fast).image for lamp in lamps]
        found = recover(images, lamps, None, layers=24, backend=fast)
        told = [text for text in found.warnings if text.startswith("Two lights over an unknown albedo: ")]
        assert len(told) == is_free, found.warnings
        off = np.abs(found.depth - z)
        assert (off < 2 * found.std).mean() > 0.9
        if is_free:
            assert found.std.min() > 1 and found.confidence.max() < 0.5
        else:
            assert off.max() < 0.5, off.max()


def wavy():
    """A relief of 24 x 24 nodes, 3 to 13 deep, its lights, and their images in a dark box, albedo 0.3."""
    y, x = np.mgrid[:24, :24]
    lights = sl.Sky(), sl.Lamp(center=(12, 12, -12), radius=5)
    scene = sl.Scene(8 + 5 * np.sin(x / 6) * np.cos(y / 7), albedo=0.3, sides="dark")
    options = dict(interreflection=False, backend="numpy")
    return lights, [sl.render(scene, light, **options).image for light in lights]


@pytest.mark.slow
@pytest.mark.parametrize(
    "change, layers, told",
    [
        (lambda image: image, 24, None),
        (lambda image: image, 12, "Depth limit: "),
        (lambda image: np.minimum(image, np.percentile(image, 95)), 24, "Clipped: 5%"),
    ],
    ids=["right", "too shallow", "clipped"],
)
@pytest.mark.parametrize("number", [0, 1], ids=["sky", "lamp"])
def test_what_std_does_not_include_is_told(fast, number, change, layers, told):
    """Errors of 0.4 to 1.8 nodes with a confidence of 0.95 to 1 had no warning."""
    light, image = (part[number] for part in wavy())
    options = dict(interreflection=False, backend=fast)
    found = sl.recover(change(image), light, 0.3, "dark", layers=layers, **options)
    said = [text for text in found.warnings if text.startswith(("Depth limit", "Clipped"))]
    assert [text.startswith(told or "") for text in said] == [True] * (told is not None), found.warnings


def test_level_ground_is_not_clipped(fast):
    """Its pixels have one value, as has open ground beside a house."""
    depth = np.full((20, 20), 6.0)
    depth[5:11, 6:15] = 3
    options = dict(interreflection=False, backend=fast)
    image = sl.render(sl.Scene(depth, albedo=0.3), sl.Sky(2.0), **options).image
    found = sl.recover(image, sl.Sky(2.0), 0.3, layers=8, max_seconds=1e-6, **options)
    assert not any(text.startswith("Clipped") for text in found.warnings)


@pytest.mark.slow
def test_every_image_is_judged(fast):
    """The first alone was: the second in counts had no warning."""
    lights, (sky, lamp) = wavy()
    options = dict(layers=24, interreflection=False, max_seconds=2, backend=fast)
    for swap in (1, -1):
        images, order = [sky, 255 * lamp / lamp.max()][::swap], lights[::swap]
        found = sl.recover(images, order, 0.3, "dark", **options)
        name = f"image {2 if swap == 1 else 1}"
        assert any(f"model and {name} differ" in text for text in found.warnings), found.warnings


def _in_a_box(name, gap):
    """(depth, image, mask) of 32 x 32 nodes; ``gap``: its place and radius [nodes]."""
    depth, image = surfaces.pair(name, "sky", 32)
    row, col, radius = gap
    y, x = np.indices(depth.shape)
    return depth, image, np.hypot(y - row, x - col) > radius


MASKED = dict(albedo=ALBEDO, sides="dark", layers=32, interreflection=False)


@pytest.mark.slow
def test_what_does_not_count_changes_nothing(fast):
    """Whatever the pixels of a gap hold, the answer has the same bytes; a highlight there does no harm."""
    depth, image, mask = _in_a_box("bumps", (12, 20, 4))
    given = image.copy()
    found, *others = (
        sl.recover(np.where(mask, image, value), sl.Sky(), mask=mask, backend=fast, **MASKED)
        for value in (np.nan, -1.0, 3 * image.max())
    )
    for other in others:
        for name in ("depth", "std", "confidence"):
            np.testing.assert_array_equal(getattr(found, name), getattr(other, name))
    assert np.array_equal(np.isnan(found.residual), ~mask) and np.isfinite(found.std).all()
    error = np.abs(found.depth - depth)
    assert rms(error[mask]) < 0.3 and (error < 2 * found.std)[~mask].mean() > 0.9
    assert found.std[12, 20] > 2 * found.std[12, 15]  # inside and at the edge
    assert np.array_equal(image, given)
    shiny = np.where(mask, image, 3 * image.max())
    assert rms(sl.recover(shiny, sl.Sky(), backend=fast, **MASKED).depth - depth) > 1


@pytest.mark.slow
def test_a_mask_that_leaves_nothing_out_is_no_mask(fast):
    _, image, mask = _in_a_box("bumps", (12, 20, 0))
    with_mask, without = (
        sl.recover(image, sl.Sky(), mask=given, backend=fast, **MASKED) for given in (mask | True, None)
    )
    np.testing.assert_array_equal(with_mask.depth, without.depth)
    np.testing.assert_array_equal(with_mask.std, without.std)


@pytest.mark.slow
def test_images_have_masks_of_their_own(fast):
    """Two lights over an unknown albedo, each with a gap; two images of one light are one without gaps."""
    depth, _, mask = _in_a_box("bumps", (12, 20, 4))
    _, _, other = _in_a_box("bumps", (20, 8, 3))
    lights = [sl.Sky(), sl.Lamp(center=(15.5, 15.5, -3), radius=4)]
    scene = sl.Scene(depth, albedo=ALBEDO, sides="dark")
    images = [
        sl.render(scene, light, "horizon", azimuths=64, interreflection=False, backend=fast).image
        for light in lights
    ]
    options = MASKED | dict(albedo=None, backend=fast)
    gaps = [np.where(known, image, np.nan) for known, image in zip((mask, other), images)]
    found = sl.recover(gaps, lights, mask=[mask, other], **options)
    assert rms(found.depth - depth) < 0.4
    assert rms(found.albedo - ALBEDO) < 0.05
    options["albedo"] = ALBEDO
    twice = sl.recover([gaps[0], images[0]], [sl.Sky()] * 2, mask=[mask, None], **options)
    once = sl.recover(images[0], sl.Sky(), **options)
    np.testing.assert_array_equal(twice.depth, once.depth)
    assert np.isfinite(twice.residual).all()


@pytest.mark.slow
def test_a_gap_is_no_dark_place_for_light_between_surfaces(fast):
    """Ground that no image shows sends what its surroundings do (0.10 nodes seen; 0.55 without)."""
    depth, image = surfaces.pair("pits", "sky", 32, interreflection=True)
    _, _, mask = _in_a_box("pits", (12, 20, 4))
    options = MASKED | dict(interreflection=True, backend=fast)
    found = sl.recover(image, sl.Sky(), mask=mask, **options)
    assert found.interreflection and rms((found.depth - depth)[mask]) < 0.2


def test_a_wide_gap_is_told(fast):
    """From a tenth of the side on; a narrow one is not."""
    _, image, _ = _in_a_box("bumps", (0, 0, 0))
    for radius, told in ((3, False), (8, True)):
        mask = _in_a_box("bumps", (14, 16, radius))[2]
        found = sl.recover(image, sl.Sky(), mask=mask, max_seconds=1e-6, backend=fast, **MASKED)
        assert any(text.startswith("Wide gap") for text in found.warnings) is told


@pytest.mark.slow
def test_ground_that_no_image_lights_counts_as_a_gap(fast):
    """Outside the cone of a spotlight. Its std was 0.3 where depth erred by 0.9 nodes, 80 % within 3 std."""
    y, x = np.mgrid[:28, :28]
    depth, narrow = 8 + 1.5 * np.sin(x / 3.3 + 0.1 * y), np.cos(np.radians(20))
    lamp = sl.Lamp((14, 14, -15), 2.0, brightness=lambda L: 8 * np.clip((-L[..., 2] - narrow) * 20, 0, 1))
    image = sl.render(sl.Scene(depth, albedo=0.5), lamp, interreflection=False, tolerance=3e-3).image
    found = sl.recover(image, lamp, albedo=0.5, layers=24, interreflection=False, backend=fast)
    off, dark = np.abs(found.depth - depth), image < 1e-3 * image.max()
    assert np.mean(off[dark] <= 2 * found.std[dark]) > 0.9
    assert rms(found.std[~dark]) < 0.1 and np.mean(off[~dark] <= 2 * found.std[~dark]) > 0.9
    assert any(text.startswith("Wide gap") for text in found.warnings)


def test_a_source_that_lights_no_ground_is_told(fast):
    """No albedo can help; std is no more than the bounds of depth allow (it was 430 of 24 nodes)."""
    image = 0.3 + 0.01 * np.add.outer(np.arange(16.0), np.arange(16.0))
    below = sl.Lamp((8, 8, 60), 3.0)
    found = sl.recover(image, below, albedo=0.5, layers=24, interreflection=False, backend=fast)
    assert any("no light of the source reaches the surface" in text for text in found.warnings)
    assert not any("a larger albedo" in text for text in found.warnings)
    assert found.std.max() < 23 / np.sqrt(3) and found.confidence.max() < 0.1


def test_of_a_depth_between_bounds_any_is_as_likely():
    """The deviation from a given one, against uniform samples."""
    low, high, z = np.array([0.0, 2.0, 1.0]), np.array([4.0, 8.0, 1.0]), np.array([2.0, 2.0, 1.0])
    truths = low + (high - low) * (np.arange(10000)[:, None] + 0.5) / 10000
    found = confidence.unknown_from(z, low, high)
    np.testing.assert_allclose(found, np.sqrt(np.mean((truths - z) ** 2, 0)), rtol=1e-6, atol=1e-12)


def test_one_pixel_tells_nearly_nothing(fast):
    """Its std was 0.08 where the error was 2 layers, and that of the gap around it 0.2."""
    _, image, _ = _in_a_box("bumps", (0, 0, 0))
    mask = np.zeros(image.shape, bool)
    mask[12, 16] = True
    found = sl.recover(image, sl.Sky(), mask=mask, max_seconds=1e-6, backend=fast, **MASKED)
    bounds = MASKED["layers"] - 1
    assert found.std.min() > 0.8 * bounds / np.sqrt(12) and found.confidence.max() < 0.5


@pytest.mark.parametrize("shape", [(17, 100), (1, 70)])
def test_long_images_have_no_small_grid(fast, shape):
    """Their coarsest grid is longer than 64 nodes; the search for a warning on gaps found none and failed."""
    image = 0.3 + 0.01 * np.random.default_rng(1).random(shape)
    assert sl.recover(image, sl.Sky(), backend=fast, max_seconds=1e-6, **MASKED).depth.shape == shape


def test_merged_images_may_differ_in_unit_and_mask():
    """Pixels that only one of them knows are in the unit of both; a black overlap is told."""
    image, mask = np.linspace(0.1, 0.4, 16).reshape(4, 4), np.eye(4) > 0
    lights = [sl.Sky(1.0), sl.Sky(4.0)]
    merged = by_light([image * mask, 4 * image * ~mask], lights, [mask, ~mask])
    assert merged.lights[0].brightness == 2.5 and merged.known[0].all() and not merged.warnings
    np.testing.assert_allclose(merged.images[0], 2.5 * image)
    both = by_light([image, 0 * image], [sl.Sky(), sl.Sky()], [mask | True] * 2)
    assert both.warnings[0].startswith("Exposure") and "inf times" in both.warnings[0]


def test_noise_is_seen_between_dead_pixels():
    """Of 2 %, with a fifth of the pixels lost at random; none is seen where no pixels are neighbours."""
    generator = np.random.default_rng(3)
    image = 0.02 * generator.normal(size=(64, 64))
    known = generator.random(image.shape) > 0.2
    assert 0.01 < noise_of(np.where(known, image, 0), known) < 0.03
    assert noise_of(image, np.indices(image.shape).sum(0) % 2 > 0) == 0


@pytest.mark.slow
def test_gaps_of_a_dataarray_do_not_count(fast):
    xarray = pytest.importorskip("xarray")
    _, image, mask = _in_a_box("bumps", (12, 20, 4))
    image = np.where(mask, image, np.nan)
    labelled = xarray.DataArray(image, dims=("y", "x"))
    found = sl.recover(labelled, sl.Sky(), backend=fast, **MASKED)
    expected = sl.recover(image, sl.Sky(), mask=mask, backend=fast, **MASKED)
    np.testing.assert_array_equal(found.depth.values, expected.depth)
    assert np.array_equal(np.isnan(found.residual.values), ~mask)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (
            dict(mask=np.ones((3, 3), bool)),
            r"mask: wrong type or shape.*shape \(3, 3\); allowed: bool, shape \(8, 8\)",
        ),
        (dict(mask=np.ones((8, 8))), "mask: wrong type or shape: got dtype float64"),
        (dict(mask=np.zeros((8, 8), bool)), "mask: no pixel of the image counts"),
        (dict(mask=[np.ones((8, 8), bool)]), "mask: masks: got 1; allowed: one, or a list of 2"),
        (
            dict(mask=np.eye(8) > 0, method="paper"),
            "method 'paper': got lists of images, gaps of the image or mask",
        ),
        (dict(), "wherever the mask is True. Pass mask=numpy.isfinite"),
    ],
)
def test_masks_that_do_not_fit_are_refused(options, message):
    images = [np.full((8, 8), 0.3), np.full((8, 8), 0.3)]
    if not options:
        images[1][3, 4] = np.nan
    with pytest.raises(sl.InputError, match=message):
        sl.recover(images, [sl.Sky(), sl.Lamp((4, 4, -3), 1)], 0.5, **options)


def test_a_masked_array_is_refused_with_advice():
    with pytest.raises(sl.InputError, match="mask=~numpy.ma.getmaskarray"):
        sl.recover(np.ma.masked_array(np.ones((4, 4)), False), sl.Sky(), 0.3)


def test_coordinates_that_are_not_the_spacing_are_told(fast):
    """As by Scene: 1 is taken."""
    xarray = pytest.importorskip("xarray")
    at = 30.0 * np.arange(8)
    image = xarray.DataArray(np.full((8, 8), 0.3), dims=("y", "x"), coords={"y": at, "x": at})
    options = dict(layers=4, max_seconds=1e-6, interreflection=False, backend=fast)
    with pytest.warns(UserWarning, match="^Spacing: 1 is taken, and the coordinates are 30 apart"):
        sl.recover(image, sl.Sky(), 0.5, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        sl.recover(image, sl.Sky(), 0.5, spacing=30.0, **options)


@pytest.mark.slow
def test_wrong_sides_are_suspected(fast):
    """An image from a dark box, taken to be open: the walls' shade has no other cause, and a warning says so;
    with the right sides none does.
    """
    image = pair("bumps", "sky")[1]
    wrong = recover(image, sl.Sky(), ALBEDO, "open", layers=32, backend=fast).warnings
    assert any("ill-posed" in warning for warning in wrong)
    bright = recover(3 * image, sl.Sky(), ALBEDO, "dark", layers=32, backend=fast).warnings
    assert any("brighter than the model" in warning for warning in bright)
    assert found("bumps", "sky", fast, SMALL).warnings == []


@pytest.mark.slow
def test_a_small_lamp_is_named(fast):
    """Smaller than a node of the coarsest grid at the deepest depth."""
    image = pair("plane", "lamp")[1]
    got = recover(
        image,
        sl.Lamp(center=(15.5, 15.5, -3), radius=0.5),
        ALBEDO,
        "dark",
        layers=32,
        max_seconds=1.0,
        backend=fast,
    )
    assert any("Small lamp" in warning for warning in got.warnings)


@pytest.mark.slow
@pytest.mark.parametrize(
    "source, narrow",
    [
        (sl.Window(x=(8, 38), y=(9, 33)), False),
        (sl.Window(x=(-6, 14), y=(-4, 20)), False),
        (sl.Lamp(corner=(10, 12, -6), edges=((24, 0, 0), (0, 20, 0))), False),
        (sl.Window(x=(4, 44), y=(22, 24)), True),
        (sl.Lamp(corner=(4, 22, -6), edges=((40, 0, 0), (0, 2, 0))), True),
    ],
)
def test_doubt_under_rectangles(fast, source, narrow):
    """Of depths from exact images about as many as should be lie within one and two std; narrow rectangles,
    of which that is not so, are told."""
    off = []
    for seed in (31,) if narrow else (31, 32, 33):
        waves = np.random.default_rng(seed).normal(size=(48, 25)) * np.exp(1j * seed)
        row, col = np.fft.fftfreq(48)[:, None], np.fft.rfftfreq(48)
        relief = np.fft.irfft2(48 * waves * np.exp(-((24 * np.hypot(row, col)) ** 2)), (48, 48))
        depth = 6 + 8 * (relief - relief.min()) / np.ptp(relief)
        scene = sl.Scene(depth, albedo=0.6, sides="dark")
        image = sl.render(scene, source, tolerance=0.003, backend=fast, interreflection=False).image
        got = recover(image, source, 0.6, "dark", layers=24, backend=fast, interreflection=False)
        assert any(text.startswith("Narrow source") for text in got.warnings) == narrow
        off.append(np.abs(got.depth - depth) / got.std)
    if not narrow:
        assert np.mean(np.array(off) < 1) > 0.5 and np.mean(np.array(off) < 2) > 0.8


@pytest.mark.slow
def test_time_is_kept_and_the_best_so_far_is_given(fast, monkeypatch):
    """A millionth of a second: a whole map, a warning, no error, and not all flat surfaces are tried."""
    depth, image = pair("bumps", "sky")
    found("bumps", "sky", fast, SMALL)  # compiled before
    value, flat = Descent.value, []
    monkeypatch.setattr(
        Descent, "value", lambda self, z, *more: (flat.append(np.ptp(z) == 0), value(self, z, *more))[1]
    )
    got = recover(image, sl.Sky(), ALBEDO, "dark", layers=LAYERS, max_seconds=1e-6, backend=fast)
    assert 0 < sum(flat) < search.FLATS / 2
    assert (
        got.depth.shape == depth.shape
        and np.isfinite(got.depth).all()
        and any("Out of time" in warning for warning in got.warnings)
    )


@pytest.mark.slow
def test_time_may_end_anywhere(fast, monkeypatch):
    """A clock that goes on by a second whenever it is asked ends the search in every part of it: a whole
    surface each time, and none that is worse than a flat one.
    """
    depth, image = surfaces.pair("egg-crate", "sky")
    cut = 0
    for seconds in (1, 2, 3, 25, 80, 130, 180, 230, 280, 330, 380):
        ticks = itertools.count()
        with monkeypatch.context() as patch:
            patch.setattr(time, "perf_counter", lambda ticks=ticks: next(ticks))
            got = recover(image, sl.Sky(), ALBEDO, "dark", backend=fast, max_seconds=seconds)
        cut += any("Out of time" in warning for warning in got.warnings)
        assert got.depth.shape == image.shape and rms(got.depth - depth) < 8
    assert cut > 6


def test_time_that_ends_before_answers_are_joined(fast, monkeypatch):
    """The last of them is of a coarser grid then, of which no mosaic can be made (AssertionError before)."""
    _, image = surfaces.pair("bumps", "sky")
    work, refined = search.Search(Multigrid(_pyramid(fast, image, "sky"))), []

    def cut(z, *grids, **more):
        refined.append(z)
        return Solution(z, math.inf)

    monkeypatch.setattr(work.multigrid, "refine", cut)
    work.pyramid.stop = lambda: len(refined) == 2
    work.answers = [Solution(work.flat(share, work.level), 1.0) for share in (0.4, 0.6)]
    with pytest.raises(search.OutOfTime):
        search.compare(work)
    assert len(refined) == 2


def test_an_interrupt_gives_the_best_so_far(fast):
    """Ctrl-C after the first level: that level's surface, at full size."""
    depth, image = pair("bumps", "sky")
    calls = []

    def progress(done, total):
        calls.append((done, total))
        if len(calls) == 1:
            raise KeyboardInterrupt

    got = recover(image, sl.Sky(), ALBEDO, "dark", layers=LAYERS, backend=fast, progress=progress)
    assert calls == [(1, 2)] and len(got.levels) == 1
    assert (
        got.depth.shape == depth.shape
        and rms(got.depth - depth) < 8
        and any("Interrupted" in warning for warning in got.warnings)
    )


@pytest.mark.slow
def test_auto_estimates_one_confidence_and_an_interrupt_ends_it(fast, monkeypatch):
    """Direct light and all light are both tried, and the better is judged; after Ctrl-C there is no second
    try.
    """
    module, judged, calls = importlib.import_module("skylamp.inverse.recover"), [], []
    judgement_of = module.judgement_of
    monkeypatch.setattr(module, "judgement_of", lambda *of: judged.append(of) or judgement_of(*of))
    image = pair("bumps", "sky")[1][:16, :16]

    def ask(progress=None):
        return sl.recover(image, sl.Sky(), ALBEDO, "dark", layers=LAYERS, backend=fast, progress=progress)

    def interrupt(*_):
        calls.append(1)
        raise KeyboardInterrupt

    ask()
    assert len(judged) == 1
    assert not ask(interrupt).interreflection and len(judged) == 2 and len(calls) == 1


def test_an_interrupt_before_the_first_level_gives_a_flat_surface(fast, monkeypatch):
    """Ctrl-C while flat surfaces are compared: the one halfway between the bounds, and no error."""

    def interrupt(work):
        raise KeyboardInterrupt

    monkeypatch.setattr(search, "STAGES", (interrupt,))
    depth, image = pair("bumps", "sky")
    got = recover(image, sl.Sky(), ALBEDO, "dark", layers=LAYERS, backend=fast)
    np.testing.assert_allclose(got.depth, LAYERS / 2, rtol=1e-3)
    assert any("Interrupted" in warning for warning in got.warnings) and got.levels == ()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "begins"),
    [("_likelier", "Interrupted: this is"), ("judgement_of", "Interrupted before the confidence")],
)
def test_an_interrupt_after_the_search_keeps_its_surface(fast, monkeypatch, name, begins):
    """Ctrl-C while answers are compared, or judged: then any depth between the bounds is as likely."""
    module = importlib.import_module("skylamp.inverse.recover")
    depth, image = pair("bumps", "sky")
    limits = dict(near=4.0, far=np.full((8, 8), 30.0), backend=fast)
    ask = functools.partial(sl.recover, image[:8, :8], sl.Sky(), ALBEDO, "dark", **limits)
    whole = ask()

    def interrupt(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, name, interrupt)
    got = ask()
    assert rms(got.depth - whole.depth) < 0.5 and any(text.startswith(begins) for text in got.warnings)
    if name == "judgement_of":
        np.testing.assert_allclose(got.std, 26 / math.sqrt(12), rtol=1e-6)
        assert got.confidence.max() < 0.1 and not got.ambiguous.any()


def test_seconds_of_waiting_for_other_threads_count(fast, monkeypatch):
    """The clock of ``max_seconds`` starts before the call waits for the device."""
    module, happened = importlib.import_module("skylamp.inverse.recover"), []
    engine, stopwatch = select(fast), module.stopwatch

    class Lock:
        def __enter__(self):
            happened.append("device")
            return engine_lock.__enter__()

        def __exit__(self, *error):
            return engine_lock.__exit__(*error)

    engine_lock = engine.lock
    monkeypatch.setattr(module, "stopwatch", lambda *of: happened.append("clock") or stopwatch(*of))
    monkeypatch.setattr(engine, "lock", Lock())
    recover(pair("bumps", "sky")[1][:8, :8], sl.Sky(), ALBEDO, "dark", backend=fast)
    assert happened[:2] == ["clock", "device"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("light", "seed", "blur", "most"),
    [
        (sl.Lamp((16, 16, -12), radius=4), 300, 0.8, 1.6),
        (sl.Lamp((4, 16, -8), radius=3), 300, 0.9, 0.8),
        (sl.Sky(), 11, 0.8, 1.4),
    ],
)
def test_fine_relief_is_not_noise(fast, light, seed, blur, most):
    """It was taken for noise and smoothed away, without a word: 2.5 to 4 nodes off, a tenth to a quarter of
    the true depths within 2 std.
    """
    depth, finer = surfaces.fine(seed, blur)
    image = surfaces.fine_image(finer, light)
    got = recover(image, light, 0.5, "dark", layers=LAYERS, backend=fast)
    assert rms(got.depth - depth) < most
    assert (np.abs(got.depth - depth) < 2 * got.std).mean() > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("power", [0, 1])
def test_noise_is_not_fine_relief(fast, power):
    """Even, and in proportion to brightness: depth that explained it would be more than a node off."""
    lamp = sl.Lamp((4, 16, -8), radius=3)
    depth, finer = surfaces.fine(300, 2.0)
    image = surfaces.fine_image(finer, lamp)
    random = np.random.default_rng(300).standard_normal(image.shape)
    image = np.maximum(image + 0.1 * rms(image) ** (1 - power) * image**power * random, 0)
    got = recover(image, lamp, 0.5, "dark", layers=LAYERS, backend=fast)
    assert got.levels[-1].residual > 0.07 and rms(got.depth - depth) < 0.8


@pytest.mark.parametrize(
    ("residual", "noise", "blurred_by", "relief", "poorly"),
    [
        (0.15, 0.1, 1, True, True),
        (0.15, 0.1, 0, False, False),
        (0.27, 0.1, 0, False, True),
        (0.108, 0.1, 1, False, False),
        (0.035, 0.005, 1, False, True),
        (0.02, 0.005, 1, False, False),
    ],
)
def test_a_residual_is_held_against_noise(residual, noise, blurred_by, relief, poorly):
    """More than noise and 3 % of the image: unexplained if neighbours are alike, or from 2.5 times on."""
    pyramid = SimpleNamespace(noise=noise * IMAGE_RMS, sides="dark", interreflection=False)
    errors = np.random.default_rng(0).standard_normal((1, 24, 24))
    errors = np.stack([blurred(errors[0], blurred_by)]) if blurred_by else errors
    errors *= residual * IMAGE_RMS / rms(errors)
    assert diagnostics.is_relief(pyramid, errors) == relief
    assert any("Poorly" in text for text in diagnostics.of_residual(pyramid, errors[0])) == poorly


def test_an_image_in_a_wrong_unit_tells_no_depth(fast):
    """10^10 times too dim: std was 0.002 nodes beside a residual of 400,000,000,000 % of the image."""
    image = 1e-10 * pair("bumps", "sky")[1][:16, :16]
    got = recover(image, sl.Sky(), ALBEDO, "dark", layers=LAYERS, backend=fast)
    assert got.std.min() > 9 and got.confidence.max() < 0.1
    assert any(
        re.match(r"Poorly explained: .* differ by [0-9.e+]+ times the image", text) for text in got.warnings
    )


@pytest.mark.slow
def test_a_lamp_below_the_surface_that_was_found_is_said(fast):
    """With the light that is missing; not where all of the lamp stands above it."""
    y, x = np.mgrid[:24, :24].astype(float)
    depth = 8 + 4 * np.sin(x / 5) * np.cos(y / 6)
    for z, told in ((-3, False), (5.5, True)):
        lamp = sl.Lamp((12, 12, z), radius=1.0)
        image = sl.render(sl.Scene(depth, albedo=0.5, sides="dark"), lamp, interreflection=False).image
        got = recover(image, lamp, 0.5, "dark", layers=24, backend=fast)
        assert any(text.startswith("Lamp below ground") for text in got.warnings) == told


@pytest.mark.slow
def test_an_interrupted_cycle_leaves_the_targets_as_they_were(fast):
    """Ctrl-C while a coarse grid works for a finer one: what is done with that grid afterwards is about its
    own image again.
    """
    pyramid, calls = _pyramid(fast, surfaces.pair("fractal", "sky", 96)[1], "sky"), itertools.count()

    def stop():
        if next(calls) == 5:  # on the coarser grid: four times on the finer one, three steps and once between
            raise KeyboardInterrupt

    pyramid.stop = stop
    with pytest.raises(KeyboardInterrupt):
        Multigrid(pyramid).cycles(0, np.full((96, 96), 30.0))
    assert 1 in pyramid.problems
    for level, problem in pyramid.problems.items():
        target = problem.backend.download(problem.images[0].target).reshape(problem.shape)
        np.testing.assert_array_equal(target, pyramid.images[level][0].astype(np.float32))


@pytest.mark.slow
def test_levels_and_their_residuals(fast, caplog):
    """Every grid is told of, coarse to fine, with its residual, in the result and to the log; what the
    residual says is true.
    """
    with caplog.at_level(logging.INFO, "skylamp"):
        depth, image = pair("fractal", "lamp")
        got = recover(image, source_of("lamp"), ALBEDO, "dark", layers=32, backend=fast)
    shapes = [level.shape for level in got.levels]
    assert shapes == [(16, 16), (32, 32)], "each once, as it was left"
    told = [record.getMessage() for record in caplog.records]
    assert [any(text.startswith(f"{rows} x {cols}: ") for text in told) for rows, cols in shapes] == [
        True,
        True,
    ]
    assert got.levels[-1].residual == pytest.approx(rms(got.residual) / rms(image), rel=0.05)
    assert (
        got.confidence.shape == got.ambiguous.shape == depth.shape and got.candidates.shape[1:] == depth.shape
    )
    np.testing.assert_array_equal(got.candidates[0], got.depth)
    assert 0 <= got.confidence.min() and got.confidence.max() <= 1


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        ({"image": [np.ones((8, 8))] * 2, "source": [sl.Sky()]}, "as many sources as images"),
        ({"image": [np.ones((8, 8)), np.ones((8, 9))], "source": [sl.Sky()] * 2}, "one shape"),
        ({"near": 5, "far": 4}, "near < far"),
        ({"near": np.ones((3, 3))}, "near: wrong shape"),
        ({"far": np.nan}, "far: got nan; allowed: finite depth >= 0"),
        ({"near": np.where(np.eye(8) > 0, -2.0, 1.0)}, "near: got -2; allowed"),
        ({"max_seconds": 0}, "max_seconds"),
        ({"source": sl.Lamp(volume=np.ones((1, 8, 8), bool))}, "method='paper'"),
        ({"source": sl.Lamp(center=(4, 4, -4), radius=2), "sides": "periodic"}, "periodic"),
        ({"method": "paper", "near": 1}, "method='robust'"),
    ],
)
@pytest.mark.filterwarnings("error")
def test_bad_arguments(arguments, says):
    """Each is an InputError that says what is allowed, without a warning of NumPy's before it."""
    with pytest.raises(sl.InputError, match=says):
        recover(
            **{"image": np.ones((8, 8)), "source": sl.Sky(), "sides": "dark", "backend": "numpy", **arguments}
        )


@pytest.mark.slow
def test_surfaces_are_what_they_are_said_to_be():
    """Relief of 15 to 22 nodes, and an image that a grid's own model nearly makes too."""
    for name in SURFACES:
        depth, image = surfaces.pair(name, "sky")
        assert 15 < np.ptp(depth) < 22 and image.min() > 0
        own = sl.render(
            sl.Scene(depth, albedo=ALBEDO, sides="dark"), sl.Sky(), method="horizon", azimuths=64
        ).image
        assert rms(own - image) < 0.03 * rms(image)


@pytest.mark.slow
def test_light_between_surfaces_is_told_from_direct_light(fast):
    """Pits, albedo 0.8: an image with light between surfaces and one without give the same depth, each by its
    own model, and direct light alone is wrong by layers in the first.
    """
    size = 24
    depth = surfaces.pair("pits", "sky", size)[0]
    scene = sl.Scene(depth, albedo=ALBEDO, sides="dark")
    out = sl.render(scene, sl.Sky(), "horizon", azimuths=64, interreflection=True, parts=True, backend=fast)
    ask = functools.partial(
        sl.recover, source=sl.Sky(), albedo=ALBEDO, sides="dark", layers=size, backend=fast
    )
    both, alone = ask(out.image), ask(out.image, interreflection=False)
    assert both.interreflection and not alone.interreflection
    assert rms(both.depth - depth) < 0.15 and rms(alone.depth - depth) > 1
    direct = ask(out.direct)
    assert not direct.interreflection and rms(direct.depth - depth) < 0.15


@pytest.mark.parametrize(
    ("depths", "rounds", "mosaics"),
    [((1.0, 1.01), 2, 0), ((1.0, 2.0, 1.0), 3, 1), ((1.0, 2.0, 3.0, 4.0, 5.0), 4, 1)],
)
def test_rounds_end_where_an_answer_is_found_again(monkeypatch, depths, rounds, mosaics):
    """Four at most; a mosaic only of answers that differ."""
    left, made = list(depths), []
    monkeypatch.setattr(search, "bounced", lambda *_: None)
    monkeypatch.setattr(search, "without", lambda *_: contextlib.nullcontext())
    monkeypatch.setattr(search, "on_coarser_grid", lambda z: z)
    monkeypatch.setattr(search, "_of_mosaic", lambda *_: made.append(1) or Solution(np.zeros((2, 2)), 9.0))

    def grid(settle):
        pyramid = SimpleNamespace(set_prior=lambda *_: None, problem=lambda _: None)
        return SimpleNamespace(
            pyramid=pyramid, multigrid=SimpleNamespace(settle=settle), check_time=lambda: None
        )

    direct = grid(lambda _, z: Solution(z, 0.0))
    between = grid(lambda _, z: Solution(np.full((2, 2), depth := left.pop(0)), -depth))
    best = search._after_rounds(between, direct, 0, np.zeros((2, 2)), [], 4)
    assert (len(depths) - len(left), len(made)) == (rounds, mosaics)
    assert best.depth[0, 0] == max(depths[:rounds])


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("egg-crate", "sky"), ("egg-crate", "sun"), ("pits", "lamp")])
def test_light_between_surfaces_does_not_cost_accuracy(fast, name, kind):
    """Within a tenth of a layer (0.03, 0.07 and 0.01 seen). Without the answer by direct light to start from,
    the first ends 2.3 layers off.
    """
    depth, image = pair(name, kind, interreflection=True)
    got = sl.recover(image, source_of(kind), ALBEDO, "dark", layers=LAYERS, backend=fast)
    assert got.interreflection and rms(got.depth - depth) < 0.1


@pytest.mark.slow
def test_a_finer_model_puts_the_model_right_but_no_noise(fast):
    """Without noise the answer is twice as near as the grid's own model leads (0.033 and 0.078 nodes seen);
    with 3 % of noise it stays there.
    """
    depth, image = pair("face", "sky")
    noisy = image + 0.03 * image.max() * np.random.default_rng(2).normal(size=image.shape)
    for values, share in ((image, (0.99, 1)), (np.maximum(noisy, 0), (0, 0.05))):
        pyramid = _pyramid(fast, values, "sky")
        work = search.Search(Multigrid(pyramid))
        work.run()
        _, z = pyramid.best
        refit = refit_of(pyramid, 0, z)
        assert share[0] <= refit.share <= share[1]
        got = recover(values, sl.Sky(), ALBEDO, "dark", layers=LAYERS, backend=fast)
        np.testing.assert_allclose(got.depth, z + refit.share * (refit.depth - z), atol=1e-3)
        if values is image:
            assert rms(got.depth - depth) < rms(z - depth) / 2


def test_a_carving_has_no_light_between_surfaces():
    with pytest.raises(sl.InputError, match="interreflection"):
        sl.recover(np.ones((4, 4)), sl.Sky(), method="paper", interreflection=True, backend="numpy")
    with pytest.raises(sl.InputError, match="interreflection"):
        sl.recover(np.ones((4, 4)), sl.Sky(), interreflection="yes", backend="numpy")


@pytest.mark.slow
@pytest.mark.parametrize(("sides", "brightness"), [("open", 0.5), ("periodic", sl.cie_overcast())])
def test_relief_under_an_even_sky_without_walls(fast, sides, brightness):
    """A flat surface, where the search begins, is a stationary point of such images: it must be left, and the
    standard deviation must cover the reliefs that look alike.
    """
    y, x = np.mgrid[:24, :24] * (2 * np.pi / 24)
    depth, sky = 12 + 3 * np.sin(x) * np.sin(y + 1) - np.cos(2 * x + y), sl.Sky(brightness)
    image = sl.render(
        sl.Scene(depth, albedo=0.5, sides=sides), sky, interreflection=False, backend=fast
    ).image
    got = recover(image, sky, 0.5, sides, layers=24, backend=fast)
    again = sl.render(sl.Scene(got.depth, albedo=0.5, sides=sides), sky, interreflection=False, backend=fast)
    assert rms(again.image - image) < 0.2 * image.std()
    assert np.mean(np.abs(got.depth - depth) < 2 * got.std) > 0.95


def test_an_even_image_without_walls_is_flat_in_the_middle(fast):
    """It tells nothing of where the surface lies, so the answer is the middle of the bounds."""
    got = recover(np.full((16, 16), 0.5), sl.Sky(), 0.5, layers=24, near=4.0, backend=fast)
    np.testing.assert_allclose(got.depth, 14, atol=1e-3)
    np.testing.assert_allclose(got.std, 20 / np.sqrt(12), rtol=0.01)


@pytest.mark.slow
def test_auto_believes_direct_light_by_the_finer_model(fast):
    """By the grid's own model, whose error hides the difference, it took these images for all light, a node
    off.
    """
    depth, sky, lamp = _waves(80), sl.Sky(), sl.Lamp((16, 10, -10), 5)
    scene = sl.Scene(depth, albedo=0.8, sides="dark")
    render = functools.partial(sl.render, scene, interreflection=False, tolerance=0.002, backend=fast)
    images = [render(light).image for light in (sky, lamp)]
    got = sl.recover(images, [sky, lamp], 0.8, "dark", layers=24, backend=fast)
    assert not got.interreflection and rms(got.depth - depth) < 0.05


def _waves(seed):
    """A surface of 32 x 32 nodes, 10 deep, of five random waves."""
    y, x = np.mgrid[:32, :32]
    rng, depth = np.random.default_rng(seed), np.zeros((32, 32))
    for _ in range(5):
        length, angle, phase = rng.uniform(0.06, 0.32), rng.uniform(0, 2 * np.pi), rng.uniform(0, 6.3)
        depth += rng.normal() * np.cos(length * (x * np.cos(angle) + y * np.sin(angle)) + phase)
    depth -= depth.mean()
    return 12 + 5 * depth / np.abs(depth).max()


@pytest.mark.slow
def test_the_answer_that_auto_does_not_take_is_a_rival(fast):
    """Direct and all light explain this image alike: std covers the true surface, though the other was taken.

    Without the rival no true depth is within 3 std.
    """
    depth = _waves(83)
    scene = sl.Scene(depth, albedo=0.8, sides="dark")
    image = sl.render(scene, sl.Sky(), interreflection=False, tolerance=0.002, backend=fast).image
    got = sl.recover(image, sl.Sky(), 0.8, "dark", layers=24, backend=fast)
    assert got.interreflection and rms(got.depth - depth) > 0.5
    assert np.mean(np.abs(got.depth - depth) < 2 * got.std) > 0.95


@pytest.mark.slow
def test_images_of_one_light_count_as_one(fast):
    """Two copies tell no more than one image, of brightness 1 and 3 together no more than of their mean."""
    image, ask = pair("bumps", "lamp")[1][:16, :16], functools.partial(recover, layers=LAYERS, backend=fast)
    lamp, brighter = sl.Lamp((8, 8, -8), 4), sl.Lamp((8, 8, -8), 4, brightness=3.0)
    spot = [sl.Lamp((8, 8, -8), 4, brightness=surfaces.source_of("lamp").brightness)] * 2
    for images, lights in (([image, image], [lamp, lamp]), ([image, 3 * image], [lamp, brighter])):
        once, twice = ask(image, lamp, ALBEDO, "dark"), ask(images, lights, ALBEDO, "dark")
        np.testing.assert_allclose(twice.depth, once.depth, atol=1e-3)
        np.testing.assert_allclose(twice.std, once.std, rtol=1e-2)
        assert not any(text.startswith("Exposure") for text in twice.warnings)
        with pytest.raises(sl.InputError, match="different lights"):
            ask(images, lights, None, "dark")
    told = ask([image, 1.2 * image], spot, ALBEDO, "dark").warnings
    assert any("images 1 and 2 are of the same light" in text and "1.2 times" in text for text in told)


@pytest.mark.slow
def test_what_is_said_of_several_images_does_not_depend_on_their_order(fast):
    """std, other depths and their mark; of an image that the other contradicts, too."""
    y, x = np.mgrid[:16, :16]
    scene = sl.Scene(8 + 2 * np.sin(x / 4) * np.cos(y / 5), albedo=0.5, sides="dark")
    lamps = [sl.Lamp((8, 5, -6), 3), sl.Lamp((2, 13, -5), 3)]
    images = [sl.render(scene, lamp, interreflection=False, backend=fast).image for lamp in lamps]
    images[1] *= 1.3
    one, other = (
        recover(images[::step], lamps[::step], 0.5, "dark", layers=16, backend=fast) for step in (1, -1)
    )
    np.testing.assert_allclose(one.depth, other.depth, atol=0.02)
    # the random vectors that probe the posterior fall on other images
    np.testing.assert_allclose(np.median(one.std / other.std), 1, atol=0.05)
    assert np.mean(np.isfinite(one.candidates) == np.isfinite(other.candidates)) > 0.99


@pytest.mark.slow
@pytest.mark.parametrize("interreflection", [False, True])
def test_progress_goes_up_to_its_end(fast, interreflection):
    steps = []
    image = pair("bumps", "sky")[1][:16, :16]
    sl.recover(
        image,
        sl.Sky(),
        ALBEDO,
        "dark",
        layers=LAYERS,
        backend=fast,
        interreflection=interreflection,
        progress=lambda *step: steps.append(step),
    )
    done, counts = zip(*steps)
    assert list(done) == sorted(done) and done[-1] == counts[-1] and len(set(counts)) == 1
    lamps, steps[:] = [sl.Lamp((8, 8, -8), 4), sl.Lamp((2, 13, -5), 3)], []
    if not interreflection:  # "auto" leaves the second half out where the unit is not that of the lamps
        sl.recover(
            [100 * image, 90 * image], lamps, None, "dark", layers=8, backend=fast,
            progress=lambda *step: steps.append(step),
        )  # fmt: skip
        assert steps[-1][0] == steps[-1][1] and len({count for _, count in steps}) == 1
    with pytest.raises(sl.InputError, match="progress"):
        sl.recover(image, sl.Sky(), backend=fast, progress=3)


@pytest.mark.parametrize(
    ("make", "same"),
    [
        (lambda: sl.Sky(sl.cie_overcast()), True),
        (lambda: sl.Sky(sl.uniform(2.0)), True),
        (lambda: sl.Sky(sl.environment_map(np.linspace(1, 2, 32).reshape(4, 8))), True),
        (lambda: sl.Window((2, 9), (2, 9), sl.cosine_power(3)), True),
        (lambda: sl.Sky(lambda L: np.ones(L.shape[:-1])), False),
        (lambda: sl.Sky(AlikeInAnArray()), False),
    ],
)
def test_lights_that_are_made_alike_are_the_same(make, same):
    """Equal arguments of the package's own brightnesses; functions of a user's are the same or not."""
    images = [np.full((4, 4), 0.5)] * 3
    known = [np.ones((4, 4), bool)] * 3
    merged = by_light(images, [make(), sl.Lamp((1, 1, -3), 1), make()], known)
    assert merged.names == (
        ["mean of images 1 and 3", "image 2"] if same else ["image 1", "image 2", "image 3"]
    )
    one = make()
    assert len(by_light(images[:2], [one, one], known[:2]).lights) == 1


class AlikeInAnArray:
    """A brightness whose comparison is an array, as that of a dataclass with an array may be."""

    def __call__(self, L):
        return np.ones(L.shape[:-1])

    def __eq__(self, other):
        return np.ones(3, bool)


@pytest.mark.slow
@pytest.mark.parametrize("interreflection", [False, True])
def test_doubt_of_relief_does_not_depend_on_the_time(fast, interreflection):
    """Under an even sky without walls, where a search that was cut told a tenth of its std."""
    y, x = np.mgrid[:16, :16] * (2 * np.pi / 16)
    depth = 8 + 2.7 * np.sin(x) * np.sin(1.3 * y + 1) - 1.3 * np.cos(2 * x + y)
    image = sl.render(sl.Scene(depth, albedo=0.5), sl.Sky(), interreflection=False, backend=fast).image
    ask = functools.partial(
        sl.recover, image, sl.Sky(), 0.5, layers=16, backend=fast, interreflection=interreflection
    )
    for seconds in (0.05, 0.3, None):
        got = ask(max_seconds=seconds)
        assert got.levels and np.ptp(got.depth) > 0.5
        assert np.mean(got.std**2) > 2 * got.depth.std() ** 2
        assert np.mean(np.abs(got.depth - depth) < 2 * got.std) > 0.95


def test_a_search_without_time_is_in_the_middle(fast):
    """Where all flat surfaces explain the image alike it has no reason to be elsewhere."""
    image = np.random.default_rng(0).uniform(0.3, 0.5, (16, 16))
    got = recover(image, sl.Sky(), 0.5, layers=24, backend=fast, max_seconds=1e-3)
    np.testing.assert_allclose(got.depth, 12, atol=0.01)


@pytest.mark.parametrize(
    ("brightness", "even"),
    [(1.0, True), (sl.cie_overcast(), True), (sl.cosine_power(20, (0.5, 0.3, -0.8)), False)],
)
def test_even_light_is_told_from_directed_light(fast, brightness, even):
    """Slight relief and its mirror image look alike under the first two."""
    y, x = np.mgrid[:24, :24] * (2 * np.pi / 24)
    image = 0.3 + 0.05 * np.sin(x) * np.sin(y + 1) + 0.02 * np.cos(2 * x + y)
    sky = sl.Sky(brightness)
    bounds = np.full(image.shape, 1e-3), np.full(image.shape, 24.0)
    work = search.Search(Multigrid(Pyramid(select(fast), [image], [sky], 0.5, "open", *bounds)))
    search.start_flat(work)
    assert work.even == even and work.share == 0.5


@pytest.mark.slow
def test_a_bowl_with_light_between_surfaces_is_not_taken_for_direct_light(fast):
    """Direct light explains its image as well as a model can, by a surface 1.8 nodes off."""
    y, x = np.mgrid[:28, :28] - 14.0
    depth = 3 + 8 * np.clip(1 - (x**2 + y**2) / (0.42 * 28) ** 2, 0, None)
    sky = sl.Sky(sl.cie_clear((120, 8), zenith=1.0))
    scene = sl.Scene(depth, albedo=0.8, sides="dark")
    image = sl.render(scene, sky, interreflection=True, tolerance=0.002, backend=fast).image
    got = sl.recover(image, sky, 0.8, "dark", layers=17, backend=fast)
    assert got.interreflection and rms(got.depth - depth) < 0.1


def test_a_wide_bound_does_not_hide_the_surface(fast):
    """Flat surfaces that are compared lie 12,500 nodes apart, and the surface is 8 deep at most."""
    y, x = np.mgrid[-8:8, -8:8]
    depth = 4 + np.hypot(x, y) / 4
    image = sl.render(
        sl.Scene(depth, albedo=0.5, sides="dark"), sl.Sky(), interreflection=False, backend=fast
    ).image
    for far in (1e6, 1e9):
        assert rms(recover(image, sl.Sky(), 0.5, "dark", far=far, backend=fast).depth - depth) < 0.1
