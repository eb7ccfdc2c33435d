"""recover(): depth from images, by analysis and synthesis or by the paper's inverse algorithm (Eq. 4)."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from .. import sources
from ..arrays import Labels, Quantity, axes_of, labelled, labels_of, lies_on, short_repr
from ..backends import select
from ..backends.base import Backend, stopwatch, timed, within
from ..checks import as_real, at, one_of, positive_number, real_array, whole_number
from ..directions import Hemicube
from ..errors import bad
from ..interreflection import check_choice
from ..light.finite import left_below
from ..light.propagation import Progress
from ..scene import Scene, check_spacing, known_of, mask_of
from . import diagnostics
from .by_light import by_light
from .carving import carved_layers
from .confidence import UNTRUSTED, confidence_of, judgement_of, unjudged
from .finer_model import refit_of
from .multigrid import Multigrid
from .pyramid import NEAREST, Level, Pyramid, residuals_of, share_of_images
from .resampling import doubled, filled, halved_depth
from .search import OutOfTime, Rival, Search

RECOVER_METHODS = ("robust", "paper")
STOPS = ("eps", "sign")
MOST_LAYERS = 2**20
# [nodes] that a bound of depth may be; chosen: sums of depths, and products with their derivatives, stay
# within float32
DEEPEST = 1e30
CANDIDATE_DEPTH = Quantity("depth_candidate", None, "depth that fits the image too, in the unit of spacing")
MAPS = (  # fields of Recovery that are maps
    Quantity("depth", None, "depth, in the unit of spacing"),
    Quantity("std", None, "standard deviation of the depth, in the unit of spacing"),
    Quantity("confidence", "1", "confidence in the depth"),
    Quantity("ambiguous", "1", "whether other depths fit the image too"),
    Quantity("albedo", "1", "diffuse reflectance"),
    Quantity("drilled", "1", "whether carving went through to the back"),
    Quantity("residual", None, "model less image, in the unit of the image"),
)
# share of the residual of all light below which that of direct light alone is believed
DIRECT_SHARE = 0.25
# what models leave of their own images, added in squares to both residuals before they are compared. Of
# eleven images with light between surfaces (28 to 40 nodes a side) that light left at most 0.0007; of direct
# images, where it did not explain them too, 0.0027 and more. Without it two of the eleven are called direct
MODEL_RESIDUAL = 6e-4
# share of the residual that an answer to images without noise may leave, to be taken: 0.03 to 0.23 of fine
# relief (see diagnostics.NOISE_TIMES). Chosen: what wrong arguments leave, noise does not explain
RELIEF_SHARE = 0.25
LEAST_RESIDUAL = 1e-12  # that another is divided by
INTERRUPTED = "Interrupted: this is the best so far."


@dataclass(frozen=True, eq=False)
class Recovery:
    """What recover() gives.

    depth (rows, cols) float32 [unit of spacing]; std (rows, cols) float32 [unit of spacing]: posterior
    standard deviation of depth, of noise, model error and other answers (docs/explanation/inverse.md),
    finite, since no pixel is masked; too small where no other answer contradicts a wrong one, as in some
    regions under one sun or lamp; None by the paper's method; confidence (rows, cols) float32, 0 to 1: about
    how likely it is that depth is within 1/64 of its range, and at least a node; below 0.5: do not
    trust (1 where the paper's method did not drill, else 0); candidates (n, rows, cols) float32:
    the depth itself, and other depths at which a pixel has its value while the surface goes up or down as a
    whole, nan where there is none; ambiguous (rows, cols) bool: there are such, and the confidence is below
    0.5; drilled (rows, cols) bool: columns that carving went through to the back; residual (rows, cols)
    float32: model - image of the first image, or of the mean of those of its light, nan where that does not
    count (0 for the paper's method); albedo (rows, cols) float32: that which was found, None if it was given;
    levels: shape, residual and seconds of every grid, of direct light where the search was there by that
    alone; backend (its name); seconds since the call, without compiling; compile_seconds; warnings;
    interreflection: whether the model of the images has light between surfaces. Arrays of an image that is an
    xarray.DataArray are some too.

    Examples
    --------
    >>> y, x = np.mgrid[:16, :16]
    >>> depth = 6 + 2 * np.sin(x / 4) * np.sin(y / 4)
    >>> scene = sl.Scene(depth, albedo=0.3, sides="dark")
    >>> image = sl.render(scene, sl.Sky(), interreflection=False).image
    >>> found = sl.recover(image, sl.Sky(), 0.3, "dark", layers=16, interreflection=False)
    >>> bool(np.sqrt(np.mean((found.depth - depth) ** 2)) < 0.2), found.confidence.shape
    (True, (16, 16))
    """

    depth: np.ndarray
    drilled: np.ndarray
    backend: str
    seconds: float
    compile_seconds: float
    warnings: list[str] = field(default_factory=list)
    std: np.ndarray | None = None
    confidence: np.ndarray | None = None
    candidates: np.ndarray | None = None
    ambiguous: np.ndarray | None = None
    albedo: np.ndarray | None = None
    residual: np.ndarray | None = None
    levels: tuple[Level, ...] = ()
    interreflection: bool = False

    __repr__ = short_repr


def recover(
    image: Any,
    source: sources.Source | Sequence[sources.Source],
    albedo: Any = 0.8,
    sides: str = "open",
    spacing: float = 1.0,
    layers: int = 64,
    hemicube: int | Hemicube = 9,
    method: str = "robust",
    eps: float = 0.02,
    stop: str = "eps",
    near: Any = None,
    far: Any = None,
    max_seconds: float | None = None,
    backend: str = "auto",
    *,
    interreflection: bool | str = "auto",
    mask: Any = None,
    progress: Progress | None = None,
) -> Recovery:
    """Depth from one image, or from several of the same surface.

    Parameters
    ----------
    image : (rows, cols) real array, or a list of such
        Radiance [unit of brightness], finite, >= 0. Those of the same light count as one, their mean.
    source : Sky, Lamp or Window, or a list, one per image
    sides, spacing, albedo
        As in the scene; ``albedo`` a number or (rows, cols), > 0; or None, of several images: found with the
        depth, it exceeds 1 if images are in another unit than brightness; "auto" then takes direct light.
    layers : int
        The deepest depth in spacings, unless ``far`` is given; the lattice's depth.
    method : "robust" or "paper"
        ``robust``: the surface whose image, by horizons and with normals, is nearest to the given ones
        (docs/explanation). ``paper``: one image, carved (Langer and Zucker, section 6, Eq. 4): columns go
        down from z = 0, above which a lamp must lie, until their luminance, with N.L = 1/2, is the image's.
    hemicube, eps, stop
        Of method="paper"; "robust" warns. stop="eps": a column stops where |B - I| <= eps x max(image);
        "sign": at the first layer where B equals I or has passed it; this often drills fewer columns.
    near, far : number or (rows, cols) array [unit of spacing], optional
        Of method="robust": between which depth lies; 0 and layers x spacing unless given.
    max_seconds : float, optional
        Then, or on Ctrl-C, "robust" takes the best surface so far, with a warning; its confidence may take as
        long again, unless Ctrl-C is pressed then. "paper" raises an error.
    interreflection : "auto", True or False
        Of method="robust": whether ground lights ground in the images, as in photographs and by default in
        those of :func:`skylamp.render`. "auto": both are tried, and direct light, which is several times as
        fast, is used if its residual is less than a quarter of the other; std includes the other answer.
    mask : (rows, cols) bool array, or a list of such, one per image, optional
        Of method="robust": True where the image counts. Elsewhere, as at highlights or the background, it
        may hold anything, and depth goes on smoothly. Gaps of a DataArray (nan, _FillValue) never count.
    progress : callable, optional
        Called with (levels or layers done, their number, which may double). Logger "skylamp" gets residuals.

    Returns
    -------
    Recovery
        Raises InputError, BackendError, CapacityError or OutOfTimeError.

    Examples
    --------
    >>> sl.recover(np.full((8, 8), 0.5), sl.Sky(), 0.5, "dark", layers=8).depth.shape
    (8, 8)
    """
    one_of(method, RECOVER_METHODS, "method")
    one_of(stop, STOPS, "stop")
    check_choice(interreflection)
    if not (progress is None or callable(progress)):
        raise bad("progress", repr(progress), "a function of (done, their number), or None")
    given = _checked(image, source, albedo, sides, spacing, layers, method, mask)
    eps = positive_number(eps, "eps")
    cube, engine = hemicube if isinstance(hemicube, Hemicube) else Hemicube(hemicube), select(backend)
    if method == "robust":
        limits = _limits(near, far, max_seconds, given, engine)
        with engine.lock:
            given.warnings.extend(_unused(hemicube=hemicube, eps=eps, stop=stop))
            return _labelled(_recovered(given, limits, engine, progress, interreflection), given.labels)
    _check_carving(given, near, far, interreflection)
    with within(max_seconds, "recover", engine):
        return _labelled(_carved(given, cube, eps, stop, engine, progress), given.labels)


def _unused(**given: Any) -> list[str]:
    """The warning for arguments of method "paper" given to "robust"; the defaults count as not given."""
    usual = inspect.signature(recover).parameters
    names = [name for name, value in given.items() if value != usual[name].default]
    return [f"Not used: {', '.join(names)}. Only method 'paper' has them."] if names else []


def _check_carving(given: _Given, near: Any, far: Any, interreflection: bool | str) -> None:
    """InputError for arguments that method "paper" cannot use."""
    unusable = {
        "lists of images": given.several,
        "near": near is not None,
        "far": far is not None,
        "gaps of the image or mask": not all(known.all() for known in given.known),
        "interreflection=True": interreflection is True,
    }
    if any(unusable.values()):
        got = ", ".join(name for name, is_given in unusable.items() if is_given)
        allowed = "one image and one source, without near, far, gaps or light between surfaces"
        raise bad("method 'paper'", got, allowed, "Use method='robust'.")


@dataclass(frozen=True, eq=False)
class _Given:
    """Checked arguments: images (rows, cols) float64 with their sources; the scene at depth 0, its albedo 1
    if that is not given; the deepest layer.
    """

    images: list[np.ndarray]
    known: list[np.ndarray]  # (rows, cols) bool of each: where it counts; elsewhere it is interpolated
    lights: list[sources.Source]
    several: bool  # lists were given
    labels: Labels | None
    scene: Scene
    albedo_given: bool
    layers: int
    names: list[str]  # of the images, in messages
    warnings: list[str]


def _checked(
    image: Any, source: Any, albedo: Any, sides: str, spacing: float, layers: int, method: str, mask: Any
) -> _Given:
    several = isinstance(image, (list, tuple)) and isinstance(source, (list, tuple))
    if not several and isinstance(image, (list, tuple)) and len(image) and getattr(image[0], "ndim", 0) == 2:
        raise bad("source", f"one, of {len(image)} images", "a list of sources, one per image")
    images, lights = (list(image), list(source)) if several else ([image], [source])
    if not images or len(images) != len(lights):
        raise bad(
            "image and source: lists of different length",
            f"{len(images)} and {len(lights)}",
            "as many sources as images, at least one",
        )
    labels = next((found for found in map(labels_of, images) if found is not None), None)
    for number, other in enumerate(images, 1):
        lies_on(labels, other, f"image {number}")
    lies_on(labels, albedo, "albedo")
    masks = list(mask) if isinstance(mask, (list, tuple)) and several else [mask] * len(images)
    if len(masks) != len(images):
        raise bad("mask: masks", len(masks), f"one, or a list of {len(images)}, one per image")
    for given in masks:
        lies_on(labels, given, "mask")
    images, known = map(list, zip(*map(_radiance, images, masks)))
    if len({picture.shape for picture in images}) > 1:
        raise bad("images of different shape", [picture.shape for picture in images], "one shape")
    for light in lights:
        _check_light(light)
    count, merged = len(images), by_light(images, lights, known)
    images, lights = list(map(filled, merged.images, merged.known)), merged.lights
    whole_number(layers, "layers", 1, MOST_LAYERS - 1)
    if albedo is None and (len(images) == 1 or method != "robust"):
        same = "These are of one light. " if len(images) < count else ""
        advice = f"{same}It can be found from several images under different lights, by method='robust'."
        raise bad("albedo", None, "a number or (rows, cols)", advice)
    if labels is not None:  # the units that an image has are no lengths
        check_spacing(spacing, labels._replace(attrs={}))
    scene = Scene(np.zeros(images[0].shape), spacing, 1.0 if albedo is None else albedo, None, sides)
    if np.ndim(scene.albedo) in (1, 3):
        raise bad(
            "albedo",
            f"RGB, shape {np.shape(scene.albedo)}",
            "a number or (rows, cols): recover takes one channel",
        )
    if np.any(np.asarray(scene.albedo) <= 0):
        raise bad("albedo", 0.0, "> 0: a black surface tells nothing of its depth")
    lights = [sources.on_axes(light, axes_of(labels)) for light in lights]
    return _Given(
        images,
        merged.known,
        lights,
        several,
        labels,
        scene,
        albedo is not None,
        int(layers),
        merged.names,
        merged.warnings,
    )


def _radiance(values: Any, mask: Any) -> tuple[np.ndarray, np.ndarray]:
    """The image (rows, cols) float64, 0 where it does not count, and (rows, cols) bool: where it does."""
    image = as_real(values, "image")
    if image.dtype in (np.uint8, np.uint16):
        raise bad(
            "image: counts of a file",
            f"dtype {image.dtype}",
            "radiance in the unit of the source's brightness, floating",
            f"Divide it by {np.iinfo(image.dtype).max}, and multiply by the radiance of the largest count;"
            " of a photograph take skylamp.io.linear(image), since sRGB is not linear.",
        )
    known = known_of(values, labels_of(values), mask_of(mask, image.shape))
    known = np.ones(image.shape, bool) if known is None else known
    if not known.any():
        raise bad("mask: no pixel of the image counts", "False everywhere", "at least one True")
    image = image.astype(np.float64)
    wrong = known & ~(np.isfinite(image) & (image >= 0))
    if wrong.any():
        raise bad(
            f"image: {wrong.sum()} values are negative, NaN or infinite, first {at(wrong)}",
            image[wrong][0],
            "finite radiance >= 0 wherever the mask is True",
            "Pass mask=numpy.isfinite(image) to leave gaps out.",
        )
    image = np.where(known, image, 0.0)
    if image.max() < np.finfo(np.float32).tiny:
        raise bad("image: black everywhere", f"maximum {image.max()}", "at least one lit pixel that counts")
    return image, known


def _check_light(light: Any) -> None:
    sources.check_source(light)
    # what has colour, or a sun's disc, is refused here
    sources.radiance(light, np.array([[0.0, 0.0, -1.0]]))
    if not sources.number_of(light) > 0:
        raise bad("source: brightness", light.brightness, "> 0: nothing can be recovered from darkness")


def _labelled(done: Recovery, labels: Labels | None) -> Recovery:
    """With the coordinates of the image's DataArray, if it was one."""
    if labels is None or done.candidates is None:
        return done
    maps: dict[str, Any] = {kind.name: labelled(getattr(done, kind.name), labels, kind) for kind in MAPS}
    numbers = np.arange(len(done.candidates))
    return replace(
        done, **maps, candidates=labelled(done.candidates, labels, CANDIDATE_DEPTH, candidate=numbers)
    )


def _carved(
    given: _Given, cube: Hemicube, eps: float, stop: str, engine: Backend, progress: Progress | None
) -> Recovery:
    (image,), (source,), scene = given.images, given.lights, given.scene
    work = lambda: carved_layers(engine, image, source, scene, given.layers, cube, eps, stop, progress)
    in_layers, seconds, compiling = timed(engine, work)
    drilled = in_layers >= given.layers
    depth = (in_layers * scene.spacing).astype(np.float32)
    return Recovery(
        depth=depth,
        drilled=drilled,
        backend=engine.name,
        seconds=seconds,
        compile_seconds=compiling,
        warnings=diagnostics.of_carving(image, source, scene.sides, drilled, stop),
        confidence=(~drilled).astype(np.float32),
        candidates=depth[None],
        ambiguous=np.zeros(depth.shape, bool),
        residual=np.zeros(depth.shape, np.float32),
    )


class _Limits(NamedTuple):
    """Between which depths (rows, cols) [nodes] the surface lies, and how long it may take.

    ``spent``: seconds since the call, without compiling; those of waiting for other threads count.
    """

    low: np.ndarray
    high: np.ndarray
    seconds: float
    spent: Callable[[], float]


def _limits(near: Any, far: Any, max_seconds: float | None, given: _Given, engine: Backend) -> _Limits:
    for bound, name in ((near, "near"), (far, "far")):
        lies_on(given.labels, bound, name)
    seconds = math.inf if max_seconds is None else positive_number(max_seconds, "max_seconds")
    spacing, shape = given.scene.spacing, given.scene.shape
    low = _bound(near, 0.0, "near", shape) / spacing
    high = _bound(far, given.layers * spacing, "far", shape) / spacing
    if not (low < high).all():
        raise bad(
            f"near and far: {(low >= high).sum()} pixels {at(low >= high)}",
            "near >= far",
            "near < far everywhere",
        )
    if high.max() > DEEPEST or high.max() * spacing > np.finfo(np.float32).max:
        allowed = f"at most {DEEPEST:g} x spacing, and at most 3.4e38"
        raise bad("far: too deep", f"{high.max() * spacing:.3g}", allowed, "Use a smaller unit.")
    return _Limits(low, high, seconds, stopwatch(engine))


def _bound(value: Any, usual: float, what: str, shape: tuple[int, int]) -> np.ndarray:
    bound = real_array(usual if value is None else value, what, None)
    if bound.ndim and bound.shape != shape:
        raise bad(f"{what}: wrong shape", bound.shape, f"a number or an array of shape {shape}")
    allowed = np.isfinite(bound) & (bound >= 0)
    if not allowed.all():
        raise bad(what, f"{bound[~allowed][0]:g}", "finite depth >= 0")
    return np.broadcast_to(bound, shape)


@dataclass(frozen=True, eq=False)
class _Answer:
    """The surface z of grid ``level`` that a search ended with, or had when it was cut short.

    ``cut``: the warning that it was; else nothing.
    """

    search: Search
    level: int
    z: np.ndarray
    levels: list[Level]
    warnings: list[str]
    cut: str


def _recovered(
    given: _Given, limits: _Limits, engine: Backend, progress: Progress | None, interreflection: bool | str
) -> Recovery:
    """The answer, its confidence and warnings: that to images without noise, if it leaves much less of them
    where fine relief may have been taken for noise.
    """
    for light in given.lights:
        _check_shape(light, given.scene.sides)
    compiled = engine.compile_seconds
    answer = _explained(given, limits, engine, progress, interreflection)
    pyramid = answer.search.pyramid
    is_done = not answer.cut and answer.level == 0
    if is_done and diagnostics.is_relief(pyramid, residuals_of(pyramid, 0, answer.z)):
        again = _part(progress, 1, 2)
        other = _explained(given, limits, engine, again, interreflection, has_noise=False)
        if other.cut:
            answer = replace(answer, cut=other.cut)
        elif other.levels[-1].residual < RELIEF_SHARE * answer.levels[-1].residual:
            answer = other
    return _recovery(given, limits, answer, compiled)


def _explained(
    given: _Given,
    limits: _Limits,
    engine: Backend,
    progress: Progress | None,
    interreflection: bool | str,
    has_noise: bool = True,
) -> _Answer:
    """As asked; for "auto" with light between surfaces, or without if that explains the images better, or
    if their unit, and so what ground sends to ground, is not that of the sources.
    """
    parts = 1 if interreflection is False else 2
    search = partial(_answer, given, limits, engine, has_noise=has_noise)
    direct = search(_part(progress, 0, parts))
    if interreflection is False:
        return direct
    if interreflection == "auto":
        left_out = [diagnostics.NO_TIME] if direct.cut else []
        if not (direct.cut or given.albedo_given):
            left_out = diagnostics.of_unit(_usual_albedo(direct), False)
        if left_out:
            direct.warnings.extend(left_out)
            if (rest := _part(progress, 1, parts)) and not direct.cut:  # there is no second part
                rest(direct.search.pyramid.start + 1, direct.search.pyramid.start + 1)
            return direct
    answer = search(_part(progress, 1, parts), direct)
    if interreflection == "auto" and not answer.cut:
        try:
            answer = _likelier(answer, direct)
        except KeyboardInterrupt:
            answer = replace(answer, cut=INTERRUPTED)
    return answer


def _part(progress: Progress | None, number: int, parts: int) -> Progress | None:
    """``progress`` of the whole for a part of it, from 0 on, of as many steps as each other part."""
    if progress is None:
        return None
    return lambda done, count: progress(number * count + done, parts * count)


def _likelier(answer: _Answer, direct: _Answer) -> _Answer:
    """The answer with light between surfaces, or that without if it leaves much less of the images, by the
    grid's model or by a finer one. The other answer is its rival.
    """
    left = {one: _unexplained(one) for one in (answer, direct)}
    told = (np.hypot(left[one], MODEL_RESIDUAL) for one in (direct, answer))
    is_direct = any(less < DIRECT_SHARE * more for less, more in zip(*told))
    own, other = (direct, answer) if is_direct else (answer, direct)
    difference = halved_depth(other.z - own.z, own.search.comparing - own.level)
    likeness = min(1.0, left[own][-1] / max(left[other][-1], LEAST_RESIDUAL))
    own.search.rivals.append(Rival(difference, likeness**4))
    return own


def _unexplained(answer: _Answer) -> tuple[float, float]:
    """Rms of what the surface leaves of the images, over theirs: by the grid's model, and by the finer one
    where that puts it right.
    """
    pyramid, left = answer.search.pyramid, answer.levels[-1].residual
    if answer.level or not pyramid.is_small(0) or not pyramid.albedo_known:
        return left, left
    residuals = residuals_of(pyramid, 0, answer.z)
    refit = refit_of(pyramid, 0, answer.z)
    return left, share_of_images(residuals + refit.share * (np.stack(refit.residuals) - residuals))


def _usual_albedo(answer: _Answer) -> float:
    """The median of the albedo that was found, where none was given."""
    pyramid = answer.search.pyramid
    return pyramid.expected_albedo * float(np.median(pyramid.albedo[0]))


def _answer(
    given: _Given,
    limits: _Limits,
    engine: Backend,
    progress: Progress | None,
    direct: _Answer | None = None,
    *,
    has_noise: bool,
) -> _Answer:
    """The problem on all grids, and the search until its limit of time. ``direct``: the answer by direct
    light, if this one is to be with light between surfaces.
    """
    scene, cut = given.scene, ""
    levels, reached = list[Level]() if direct is None else direct.levels.copy(), set[tuple[int, ...]]()
    lights = [_in_nodes(light, scene.spacing) for light in given.lights]
    warnings = diagnostics.of_images(
        given.images, given.known, lights, scene, float(limits.high.max()), given.albedo_given
    )
    warnings.extend(given.warnings)
    pyramid = Pyramid(
        engine,
        given.images,
        lights,
        scene.albedo if given.albedo_given else None,
        scene.sides,
        *(np.maximum(limits.low, NEAREST), limits.high),
        direct is not None,
        known=given.known,
        has_noise=has_noise,
    )

    def report(level: Level) -> None:
        levels[:] = [other for other in levels if other.shape != level.shape] + [level]
        reached.add(level.shape)
        if progress:
            progress(min(len(reached), pyramid.start), pyramid.start + 1)

    pyramid.report, pyramid.spent = report, limits.spent
    pyramid.stop = lambda: limits.spent() > limits.seconds
    several = any(map(_directed, lights))  # answers: then the lower objective need not be the right one's
    search = Search(Multigrid(pyramid, several), None if direct is None else direct.search)
    if direct is not None and direct.cut:
        return replace(direct, search=search)
    try:
        search.run()
        if progress:
            progress(pyramid.start + 1, pyramid.start + 1)
    except OutOfTime:
        cut = f"Out of time after {limits.seconds:g} s: this is the best so far."
    except KeyboardInterrupt:
        cut = INTERRUPTED
    low, high = pyramid.bounds[-1]
    if pyramid.best is None and direct is not None:  # cut before it had a surface of its own
        return replace(direct, search=search, warnings=warnings, cut=cut)
    level, z = pyramid.best or (pyramid.coarsest, (low + high) / 2)
    return _Answer(search, level, z, levels, warnings, cut)


def _recovery(given: _Given, limits: _Limits, answer: _Answer, compiled: float) -> Recovery:
    """Confidence, the finest grid, warnings. ``compiled``: seconds of the backend's before the call."""
    scene, search, pyramid = given.scene, answer.search, answer.search.pyramid
    level, z, low, high = answer.level, answer.z, limits.low, limits.high
    depth_range = float((high - low).mean())
    if pyramid.interreflection and not given.albedo_given:
        answer.warnings.extend(diagnostics.of_unit(_usual_albedo(answer), True))
    rivals = search.rivals_of(level, z)
    try:
        judged = judgement_of(search.multigrid, level, z, rivals, search.comparing, depth_range)
    except KeyboardInterrupt:
        judged = unjudged(low, high)
        answer.warnings.append(
            "Interrupted before the confidence was known: std is that of any depth between near and far."
        )

    for finer in range(level - 1, -1, -1):
        z = 2 * doubled(z, pyramid.shape(finer))
    z = np.clip(z, low, high)
    levels = answer.levels
    residuals = residuals_of(pyramid, 0, z)
    if judged.refit is not None:
        z, residuals = (
            own + judged.share * (other - own)
            for own, other in ((z, judged.refit.depth), (residuals, np.array(judged.refit.residuals)))
        )
        levels = [*levels[:-1], Level(z.shape, share_of_images(residuals), limits.spent())]
    std = judged.std
    if share_of_images(residuals) >= 1:  # as far off as black is: it tells nothing of depth
        std = np.maximum(std, unjudged(low, high).std)
    confidence = confidence_of(std, depth_range)
    ambiguous = np.isfinite(judged.others).any(0) & (confidence < UNTRUSTED)
    depth = (z * scene.spacing).astype(np.float32)
    warnings = [*answer.warnings, *filter(None, [answer.cut])]
    warnings += diagnostics.of_free_place(judged.place, pyramid.sources)
    warnings += _lamps_below(replace(scene, depth=depth), given.lights, pyramid.engine)
    warnings += [*diagnostics.of_gaps(pyramid), *diagnostics.of_limits(z, low, high)]
    for name, residual in zip(given.names if len(residuals) > 1 else ["image"], residuals):
        warnings += diagnostics.of_residual(pyramid, residual, name)
    place_is_known = not (judged.place or diagnostics.of_place(pyramid.sides, pyramid.sources))
    warnings += diagnostics.of_ground(pyramid, levels[-1].residual if levels else 0.0)
    counts = np.any(given.known, axis=0)
    warnings += diagnostics.of_confidence(
        confidence[counts], ambiguous[counts], given.albedo_given, place_is_known
    )

    return Recovery(
        depth=depth,
        drilled=np.zeros(scene.shape, bool),
        backend=pyramid.engine.name,
        seconds=limits.spent(),
        compile_seconds=pyramid.engine.compile_seconds - compiled,
        warnings=warnings,
        std=(std * scene.spacing).astype(np.float32),
        confidence=confidence.astype(np.float32),
        candidates=np.concatenate([depth[None], (judged.others * scene.spacing).astype(np.float32)]),
        ambiguous=ambiguous,
        albedo=None if given.albedo_given else pyramid.albedo[0].astype(np.float32),
        residual=np.where(given.known[0], residuals[0] * pyramid.units[0], np.nan).astype(np.float32),
        levels=tuple(levels),
        interreflection=pyramid.interreflection,
    )


def _lamps_below(scene: Scene, lights: Sequence[sources.Source], engine: Backend) -> list[str]:
    """A warning where the surface that was found is higher than a part of a lamp."""
    lost = max(
        (left_below(scene, light, engine) for light in lights if isinstance(light, sources.Lamp)), default=0.0
    )
    return diagnostics.of_lamps_below(lost)


def _check_shape(light: sources.Source, sides: str) -> None:
    """InputError for sources that slices cannot represent, on these sides."""
    if (isinstance(light, sources.Lamp) and light.volume is not None) or (
        isinstance(light, sources.Window) and light.aperture is not None
    ):
        raise bad(
            "method 'robust' with a lamp given as a volume or a window given as an aperture",
            "a shape of nodes",
            "a sphere or a rectangle",
            "Use method='paper'.",
        )
    if sides == "periodic" and not isinstance(light, sources.Sky):
        raise bad(
            "method 'robust' with sides='periodic'", type(light).__name__, "a sky, or sides='open' or 'dark'"
        )


def _in_nodes(light: sources.Source, spacing: float) -> sources.Source:
    """A source with its lengths in nodes."""

    def scaled(value: Any) -> Any:  # None stays
        return tuple(map(scaled, value)) if isinstance(value, tuple) else value and value / spacing

    lengths = {"x", "y", "center", "radius", "corner", "edges"} & vars(light).keys()
    return replace(light, **{name: scaled(getattr(light, name)) for name in lengths})


def _directed(light: sources.Source) -> bool:
    """Whether a lamp or window shines more into some directions: then luminance along a column rises and
    falls, and one image has several answers.
    """
    return not isinstance(light, sources.Sky) and callable(light.brightness)
