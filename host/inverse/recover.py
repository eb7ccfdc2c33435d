"""recover(): depth from images, by analysis and synthesis or by the paper's inverse algorithm (Eq. 4)."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field, replace

import numpy as np

from .. import sources
from ..arrays import labelled, labels_of
from ..backends import select
from ..checks import at, one_of, positive_number, real_array
from ..directions import Hemicube
from ..errors import bad
from ..light.propagation import Problem, Progress, carve
from ..rendering import timed
from ..scene import Scene
from .pyramid import BETTER, BRIGHT, LOST, SMALL, Level, Pyramid, blurred, doubled, halved

METHODS = ("robust", "paper")
STOPS = ("eps", "sign")
UNIT = 2**30  # the largest sum of weights, and so of light, in carving's whole numbers
DOUBT, LEAST_DOUBT = (
    0.025,
    1.0,
)  # of the range of depths, and nodes at least: two answers this far apart are worth half the confidence
CONFINED = (0.9, 0.75)  # shares of the pixels whose depth the first answer leaves to the others
CLEARLY = (
    0.9  # share of the objective below which another start's answer is taken, where one answer is expected
)
HOPE = 8.0  # times the objective on a coarser grid up to which a start is followed
ALIKE = 0.05  # nodes (rms) between surfaces that are one answer
RIVAL = 6.0  # times the objective up to which another start counts as an answer
WEIGHT = 4.0  # of the doubt that noise leaves, against that of another start
UNTOLD = 0.2  # of the pixels are not trusted: so many that a warning says that the albedo is not known
UNEVEN = 1.4  # of the distance to the surface with a more even albedo, where it is not known
# of the squared distance to the surface of a finer model, which is about the same in nodes on every grid
FINE = 9.0
POOR = 0.02  # share of the image's rms that model and image may differ by in a place that is to be believed
BADLY = 0.03  # residual, as a share of the image, from which an image is called unexplained


class _OutOfTime(Exception):
    """max_seconds are over."""


@dataclass(frozen=True, eq=False)
class Recovery:
    """What recover() gives.

    depth (rows, cols) float32 [unit of spacing]; confidence (rows, cols) float32, 0 to 1, below 0.5: do not
    trust (1 where the paper's method did not drill, else 0); candidates (n, rows, cols) float32: the depth
    itself, and other depths at which a pixel has its value while the surface goes up or down as a whole, nan
    where there is none; ambiguous (rows, cols) bool: there are such, and the confidence is below 0.5; drilled
    (rows, cols) bool: columns that carving went through to the back; residual (rows, cols) float32: model -
    image of the first image (0 for the paper's method); albedo (rows, cols) float32: that which was found,
    None if it was given; levels: shape, residual and seconds of every grid; backend (its name); seconds
    without compiling, compile_seconds; warnings. Arrays of an image that is an xarray.DataArray are some too.
    """

    depth: np.ndarray
    drilled: np.ndarray
    backend: str
    seconds: float
    compile_seconds: float
    warnings: list[str] = field(default_factory=list)
    confidence: np.ndarray | None = None
    candidates: np.ndarray | None = None
    ambiguous: np.ndarray | None = None
    albedo: np.ndarray | None = None
    residual: np.ndarray | None = None
    levels: tuple[Level, ...] = ()


def recover(
    image,
    source,
    albedo=0.8,
    sides: str = "open",
    spacing: float = 1.0,
    layers: int = 64,
    hemicube: int | Hemicube = 9,
    method: str = "robust",
    eps: float = 0.02,
    stop: str = "eps",
    near=None,
    far=None,
    max_seconds: float | None = None,
    backend: str = "auto",
    *,
    progress: Progress | None = None,
) -> Recovery:
    """Depth from one image, or from several of the same surface.

    Parameters
    ----------
    image : (rows, cols) real array, or a list of such
        Radiance, in the unit of the source's brightness. Finite, >= 0. Several images are for
        method="robust".
    source : Sky, Lamp or Window, or a list, one per image
    sides, spacing, albedo
        As in the scene that the image shows; ``albedo`` a number or (rows, cols), > 0; or None, of several
        images by method="robust": every pixel's is found with its depth (one image cannot tell a dark surface
        from a deep one). It may exceed 1 if the sources' brightness is in another unit than the images. For
        method="paper" a lamp must lie above z = 0 or be given as a volume that starts at layer 0, since
        carving starts from a surface at z = 0.
    layers : int
        The deepest depth in spacings, unless ``far`` says otherwise; the lattice's depth.
    method : "robust" or "paper"
        ``robust``: the surface whose image, by horizons and with normals, is nearest to the given one, coarse
        to fine (skylamp.synthesis). ``paper``: carving (Langer and Zucker, section 6, inverse algorithm, Eq.
        4): all columns start at depth 0 and go down a layer at a time while their luminance, with N.L
        replaced by 1/2, does not match the image.
    hemicube, eps, stop
        Of method="paper". stop="eps": a column stops where |B - I| <= eps x max(image); "sign": at the first
        layer where B equals I or has passed it; on most scenes this drills fewer columns.
    near, far : number or (rows, cols) array [unit of spacing], optional
        Of method="robust": between which depth lies; 0 and layers x spacing unless given.
    max_seconds : float, optional
        Of method="robust": the best surface found so far is given when they are over, or on
        KeyboardInterrupt, with a warning.
    progress : callable, optional
        Called with (levels or layers done, their number). The residual of every level goes to the logger
        "skylamp".

    Raises
    ------
    InputError, BackendError, CapacityError
    """
    one_of(method, METHODS, "method")
    one_of(stop, STOPS, "stop")
    several = isinstance(image, (list, tuple)) and isinstance(source, (list, tuple))
    images, lights = (list(image), list(source)) if several else ([image], [source])
    if not images or len(images) != len(lights):
        raise bad(
            "image and source: lists of different length",
            f"{len(images)} and {len(lights)}",
            "as many sources as images, at least one",
        )
    labels = labels_of(images[0])
    images = [_radiance(picture) for picture in images]
    if len({picture.shape for picture in images}) > 1:
        raise bad("images of different shape", [picture.shape for picture in images], "one shape")
    if isinstance(layers, bool) or not isinstance(layers, (int, np.integer)) or not 1 <= layers < 2**20:
        raise bad("layers", repr(layers), "a whole number from 1 to 1048575")
    eps = positive_number(eps, "eps")
    cube = hemicube if isinstance(hemicube, Hemicube) else Hemicube(hemicube)
    if albedo is None and (len(images) == 1 or method != "robust"):
        raise bad(
            "albedo",
            None,
            "a number or (rows, cols)",
            "It can be found from several images under different lights, by method='robust'.",
        )
    start = Scene(np.zeros(images[0].shape), spacing, 1.0 if albedo is None else albedo, None, sides)
    if np.ndim(start.albedo) in (1, 3):
        raise bad(
            "albedo",
            f"RGB, shape {np.shape(start.albedo)}",
            "a number or (rows, cols): recover takes one channel",
        )
    if np.any(np.asarray(start.albedo) <= 0):
        raise bad("albedo", 0.0, "> 0: a black surface tells nothing of its depth")
    for light in lights:
        if not isinstance(light, sources.Source):
            raise bad("source", type(light).__name__, "Sky, Lamp or Window")
        sources.radiance(
            light, np.array([[0.0, 0.0, -1.0]])
        )  # what has colour, or a sun's disc, is refused here
        if not callable(light.brightness) and not light.brightness > 0:
            raise bad("source: brightness", light.brightness, "> 0: nothing can be recovered from darkness")
    if method == "robust":
        engine = select(backend)
        with engine.lock:
            return _labelled(
                _robust(
                    images,
                    lights,
                    start,
                    None if albedo is None else start.albedo,
                    layers,
                    near,
                    far,
                    max_seconds,
                    engine,
                    progress,
                ),
                labels,
            )
    if several or near is not None or far is not None or max_seconds is not None:
        raise bad(
            "method 'paper' with several images, near, far or max_seconds",
            "what it cannot use",
            "one image and one source",
            "Use method='robust'.",
        )
    return _labelled(_carved(images[0], lights[0], start, layers, cube, eps, stop, backend, progress), labels)


def _labelled(done: Recovery, labels) -> Recovery:
    """With the coordinates of the image's DataArray, if it was one."""
    if labels is None:
        return done
    maps = {
        name: labelled(getattr(done, name), labels)
        for name in ("depth", "confidence", "ambiguous", "albedo", "drilled", "residual")
    }
    return replace(
        done, **maps, candidates=labelled(done.candidates, labels, candidate=np.arange(len(done.candidates)))
    )


def _radiance(image) -> np.ndarray:
    image = real_array(image, "image")
    wrong = ~(np.isfinite(image) & (image >= 0))
    if wrong.any():
        raise bad(
            f"image: {wrong.sum()} values are negative, NaN or infinite, first {at(wrong)}",
            image[wrong][0],
            "finite radiance >= 0",
        )
    if image.max() < np.finfo(np.float32).tiny:
        raise bad("image: black everywhere", f"maximum {image.max()}", "at least one lit pixel")
    return image


def _carved(image, source, start, layers, cube, eps, stop, backend, progress) -> Recovery:
    spacing, albedo, sides = start.spacing, start.albedo, start.sides
    low, high, weights = carving_integers(
        image,
        albedo,
        sources.radiance(source, cube.directions),
        cube.solid_angles,
        eps if stop == "eps" else 0.0,
    )
    engine = select(backend)
    # A ball must not lie below the surface that carving starts from; a volume may go down with it.
    deep = Scene(np.full(image.shape, float(layers) * spacing), spacing, albedo, None, sides)
    volume = isinstance(source, sources.Lamp) and source.volume is not None
    problem = Problem(
        np.zeros(image.shape, np.float32),
        1.0,
        sides,
        cube.steps,
        sources.geometry(source, deep if volume else start, 1.0),
    )
    (depth,), seconds, compiling = timed(
        engine, lambda: (carve(engine, problem, low, high, weights, int(layers), stop == "sign", progress),)
    )
    drilled = depth >= layers
    warnings = []
    if drilled.any():
        warnings.append(
            f"Drilled: {drilled.mean():.1%} of the columns never matched the image and were carved through to"
            " the back"
            + (
                "; one that stops early shadows the rest. stop='sign' often drills fewer."
                if stop == "eps"
                else "; the image is darker there than any depth explains."
            )
        )
    if sides == "open" and isinstance(source, sources.Sky):
        warnings.append(OPEN_SKY)
    if step := _count(image):
        warnings.append(
            f"Few counts: the image's values are multiples of {step:.2g} of its maximum, so depth can be no"
            " finer than what changes it by that."
        )
    depth = (depth * spacing).astype(np.float32)
    return Recovery(
        depth,
        drilled,
        engine.name,
        seconds,
        compiling,
        warnings,
        (~drilled).astype(np.float32),
        depth[None],
        np.zeros(depth.shape, bool),
        np.zeros(depth.shape, np.float32),
    )


OPEN_SKY = "Open sides under a sky are ill-posed: a flat surface explains a plane's image at any depth."


def _robust(images, lights, start, albedo, layers, near, far, max_seconds, engine, progress) -> Recovery:
    spacing, sides, shape = start.spacing, start.sides, start.shape
    low, high = (
        _bound(near, 0.0, "near", shape) / spacing,
        _bound(far, layers * spacing, "far", shape) / spacing,
    )
    if not (low < high).all():
        raise bad(
            f"near and far: {(low >= high).sum()} pixels {at(low >= high)}",
            "near >= far",
            "near < far everywhere",
        )
    for light in lights:
        if getattr(light, "volume", None) is not None or getattr(light, "aperture", None) is not None:
            raise bad(
                "method 'robust' with a lamp given as a volume or a window given as an aperture",
                "a shape of nodes",
                "a sphere or a rectangle",
                "Use method='paper'.",
            )
        if sides == "periodic" and not isinstance(light, sources.Sky):
            raise bad(
                "method 'robust' with sides='periodic'",
                type(light).__name__,
                "a sky, or sides='open' or 'dark'",
            )
    seconds_left = math.inf if max_seconds is None else positive_number(max_seconds, "max_seconds")
    lights = [_in_nodes(light, spacing) for light in lights]
    levels: list[Level] = []
    warnings = _before(images, lights, start, low, high)

    def note(level):
        levels[:] = [other for other in levels if other.shape != level.shape] + [level]
        if progress:
            progress(len(levels), pyramid.first + 1)

    several = any(map(_directed, lights))  # answers: then the lower objective need not be the right one's
    pyramid = Pyramid(engine, images, lights, albedo, sides, np.maximum(low, 1e-3), high, several, note=note)
    compiled = engine.compile_seconds
    spent = lambda: time.perf_counter() - pyramid.began - (engine.compile_seconds - compiled)
    pyramid.stop = lambda: spent() > seconds_left
    rivals, cut = [], None

    def in_time():
        if pyramid.stop():
            raise _OutOfTime

    def around(answer, begun, level):
        """This answer, which began with that surface on that grid, shallower ones that begin there, and their
        mosaic.
        """
        starts = [answer]
        for share in CONFINED:
            other, found = pyramid.confined(float(np.quantile(answer[0], share)), begun, level, middle)
            in_time()  # else it is of a coarser grid
            if all(_apart(other, one) > ALIKE for one, _ in starts):
                starts.append((other, found))
        _join(pyramid, middle, starts)
        return starts

    objective = lambda answer: answer[1]
    try:
        shares, misfits = pyramid.flat()
        first, half = pyramid.first, 0 if max(shape) <= SMALL else pyramid.first
        nearest = shares[np.argmin(misfits)]
        flat = [low + nearest * (high - low) for low, high in pyramid.bounds]
        if first == pyramid.top:
            pyramid.lighten(flat[-1])
        middle = max(half, first - 1)  # the grid on which starts are sorted out
        coarse = pyramid.begin(flat[first], first, middle)
        starts = around(coarse, flat[first], first)
        if min(starts, key=objective)[1] > LOST * pyramid.good(middle):
            begun, answer = pyramid.elsewhere(nearest, middle)
            in_time()  # else it is of a coarser grid
            if answer[1] < BETTER * min(starts, key=objective)[1]:
                coarse = answer
                pyramid.accept(middle, answer[0])
                starts = around(coarse, begun, pyramid.top)
        z, value = coarse
        if half < middle:
            z, value = pyramid.climb(z, middle, half)
        in_time()
        answers = starts
        if half < middle:
            answers = [(z, value)] + [
                pyramid.climb(other, middle, half, keep=False)
                for other, found in starts[1:]
                if found < HOPE * max(coarse[1], pyramid.good(middle))
            ]
            in_time()
            _join(pyramid, half, answers)
        best, least = min(answers, key=objective)
        if least < (BETTER if several else CLEARLY) * value:
            z, value = best, least
        rivals = [
            (other - z, min(1, value / found) ** (1 if several else 2))
            for other, found in answers
            if other is not z and found < RIVAL * value
        ]
        z, value = pyramid.polish(half, z)
        if half:
            z, value = pyramid.climb(z, half, 0)
        in_time()
    except _OutOfTime:
        cut = f"Out of time after {seconds_left:g} s: this is the best so far."
    except KeyboardInterrupt:
        cut = "Interrupted: this is the best so far."
    if cut:
        warnings.append(cut)
    level, z = (
        pyramid.best
        if pyramid.best
        else (
            pyramid.top,
            np.broadcast_to((pyramid.bounds[-1][0] + pyramid.bounds[-1][1]) / 2, pyramid.images[-1][0].shape),
        )
    )
    confidence, candidates = _trust(
        pyramid, level, z, [] if cut else rivals, half, depth_range=float((high - low).mean())
    )
    while level:
        level -= 1
        z = 2 * doubled(z, pyramid.images[level][0].shape)
    z = np.clip(z, low, high)
    residual = pyramid.problem(0).irradiances(z)[0] - pyramid.images[0][0]
    warnings += _after(pyramid, residual, lights, sides)
    ambiguous = np.isfinite(candidates).any(0) & (confidence < 0.5)
    depth = (z * spacing).astype(np.float32)
    candidates = np.concatenate([depth[None], (candidates * spacing).astype(np.float32)])
    if ambiguous.mean() >= 0.005:
        warnings.append(
            f"Ambiguous: {ambiguous.mean():.0%} of the pixels have several depths that explain them; give"
            " near= and far=, or a second image."
        )
    if albedo is None and (confidence < 0.5).mean() > UNTOLD:
        warnings.append(
            f"Depth hangs on the albedo at {(confidence < 0.5).mean():.0%} of the pixels: these images hardly"
            " tell the two apart; another under a lamp, or a known albedo, would."
        )
    return Recovery(
        depth,
        np.zeros(shape, bool),
        engine.name,
        spent(),
        engine.compile_seconds - compiled,
        warnings,
        confidence.astype(np.float32),
        candidates,
        ambiguous,
        pyramid.albedo[0].astype(np.float32) if albedo is None else None,
        (residual * pyramid.units[0]).astype(np.float32),
        tuple(levels),
    )


def _join(pyramid, level, answers) -> None:
    """Adds the mosaic of these surfaces, if there are several and none is good: different starts are right in
    different places.
    """
    if len(answers) > 1 and min(found for _, found in answers) > pyramid.good(level):
        answers.append(pyramid.mosaic(level, [z for z, _ in answers]))


def _apart(one, other) -> float:
    return math.sqrt(np.mean((one - other) ** 2))


def _directed(light) -> bool:
    """Whether a lamp or window shines more into some directions: then luminance along a column rises and
    falls, and one image has several answers.
    """
    return not isinstance(light, sources.Sky) and callable(light.brightness)


def _trust(pyramid, level, z, rivals, half, depth_range) -> tuple[np.ndarray, np.ndarray]:
    """(confidence, other candidates (n, rows, cols) in nodes), on the finest grid.

    Doubt is the distance to other starts' surfaces (``rivals``: apart on grid ``half``, and how well theirs
    explain the image beside this one), to the surface that a finer model finds, to that of a more even albedo
    where it is not known, what noise could do (Pyramid.doubt), and how badly the image is met in the
    neighbourhood. An albedo that was not known is settled on the way.
    """
    poor = blurred((pyramid.problem(level).irradiances(z)[0] - pyramid.images[level][0]) ** 2)
    small, grid = z, level
    while max(small.shape) > SMALL and grid < pyramid.top:
        small, poor, grid = _halved(small), halved(poor), grid + 1
    limit = max(DOUBT * depth_range, LEAST_DOUBT) / 2**grid
    hangs = 0.0  # on the albedo
    if not pyramid.albedo_known:
        hangs = (UNEVEN * blurred(np.abs(pyramid.evener(grid, small) - small))) ** 2
        pyramid.settle(level, z)
    # sharp, since what noise could do is a bound; what is really off is ordered by the rest
    doubt = (
        (WEIGHT * pyramid.doubt(grid, small)) ** 4 / limit**2
        + FINE * blurred(((pyramid.finer(grid, small) - small) / 2 ** (grid - level)) ** 2)
        + hangs
    )
    for apart, share in rivals:
        for _ in range(grid - half):
            apart = _halved(apart)
        doubt = doubt + (share * blurred(np.abs(apart))) ** 2
    confidence = 1 / (1 + doubt / limit**2 + poor / (POOR * BRIGHT + 3 * pyramid.noise * 0.5**level) ** 2)
    shifts, light = pyramid.column(grid, small)
    crosses = (light[:-1] > 0) != (light[1:] > 0)
    share = light[:-1] / np.where(crosses, light[:-1] - light[1:], 1)
    where = shifts[:-1, None, None] + share * (shifts[1] - shifts[0])
    own, low, high = small * 2**grid, *(bound * 2**grid for bound in pyramid.bounds[grid])
    valid = crosses & (np.abs(where) > 2 * DOUBT * depth_range) & (own + where >= low) & (own + where <= high)
    order = np.argsort(~valid, axis=0, kind="stable")[:2]
    others = np.take_along_axis(np.where(valid, own + where, np.nan), order, 0)
    while grid:
        grid -= 1
        shape = pyramid.images[grid][0].shape
        confidence = np.clip(doubled(confidence, shape), 0, 1)
        others = others.repeat(2, 1).repeat(2, 2)[:, : shape[0], : shape[1]]
    return confidence, others


def _halved(z):
    return halved(z) / 2


def _bound(value, usual, what, shape) -> np.ndarray:
    bound = real_array(usual if value is None else value, what, None)
    if bound.ndim and bound.shape != shape:
        raise bad(f"{what}: wrong shape", bound.shape, f"a number or an array of shape {shape}")
    if not np.isfinite(bound).all() or bound.min() < 0:
        raise bad(what, f"{np.nanmin(bound)} to {np.nanmax(bound)}", "finite depth >= 0")
    return np.broadcast_to(bound, shape)


def _in_nodes(light: sources.Source, spacing: float) -> sources.Source:
    """A source with its lengths in nodes."""
    scaled = lambda vector: tuple(part / spacing for part in vector)
    if isinstance(light, sources.Window):
        return sources.Window(scaled(light.x), scaled(light.y), light.brightness)
    if isinstance(light, sources.Lamp) and light.center is not None:
        return sources.Lamp(scaled(light.center), light.radius / spacing, light.brightness)
    if isinstance(light, sources.Lamp):
        return sources.Lamp(
            corner=scaled(light.corner), edges=tuple(map(scaled, light.edges)), brightness=light.brightness
        )
    return light


def _before(images, lights, start, low, high) -> list[str]:
    """What can be told from the images alone."""
    found = []
    if start.sides == "open" and all(isinstance(light, sources.Sky) for light in lights):
        found.append(OPEN_SKY)
    for image in images:
        values = np.unique(image)
        if 2 < len(values) <= 256 < image.size:
            step = float(np.median(np.diff(values)))
            along = np.concatenate([np.abs(np.diff(image, axis=a)).ravel() for a in (0, 1)])
            if np.median(along) < step:
                found.append(
                    f"8-bit steps: the image has {len(values)} values, {step:.2g} apart, and most neighbours"
                    " differ by less; fine relief is lost in them."
                )
    for light in lights:
        if isinstance(light, sources.Lamp) and light.center is not None:
            away = float(high.max()) - light.center[2]
            if light.radius / max(away, light.radius) < 0.5 / min(16, *start.shape):
                found.append(
                    f"Small lamp: its radius of {light.radius:.3g} nodes is below the resolution of the"
                    f" coarsest grid at depth {high.max():.3g}; its shadows are sharper than a grid shows."
                )
    return found


def _after(pyramid, residual, lights, sides) -> list[str]:
    """What the residual tells."""
    found = []
    rms = math.sqrt(float(np.mean(residual**2))) / BRIGHT
    target = pyramid.images[0][0]
    too_bright = (residual < -0.1 * BRIGHT) & (residual < -5 * pyramid.noise)
    if too_bright.mean() > 0.02:
        found.append(
            f"Image brighter than the model can make it at {too_bright.mean():.0%} of the pixels: a larger"
            " albedo or brightness, or other sides, may be right."
        )
    if rms > BADLY + 2 * pyramid.noise / BRIGHT:
        rim = np.ones(target.shape, bool)
        edge = max(1, min(target.shape) // 8)
        rim[edge:-edge, edge:-edge] = False
        worse = np.mean(residual[rim] ** 2) > 2 * np.mean(residual[~rim] ** 2) if (~rim).any() else False
        found.append(
            f"Poorly explained: model and image differ by {rms:.0%} of the image (rms)"
            + (
                f", most of all near the border: wrong sides are suspected (sides={sides!r} was given)."
                if worse
                else (
                    "; wrong sides, albedo or source are suspected, or relief that this resolution does not"
                    " show."
                )
            )
        )
    return found


COARSE = 1 / 200  # of the maximum: an image of fewer counts is coarser than the paper's eps


def _count(image) -> float:
    """The count of a coarsely quantized image, over its maximum; 0 where its values are no multiples of one."""
    steps = np.diff(np.unique(image))
    if not steps.size or steps.min() < COARSE * image.max():
        return 0.0
    number = np.append(steps, image.max()) / steps.min()
    return (
        float(steps.min() / image.max())
        if np.abs(number - np.rint(number)).max() < 1e-3 * number.max()
        else 0.0
    )


def carving_integers(image, albedo, brightness, solid_angles, eps: float):
    """(low, high) (rows, cols) and weights (D,), int32: image - eps max(image), image + eps max(image) and B
    dOmega / (2 pi) of Eq. 4 in one unit. The albedo, which may be a map, divides the image instead of
    multiplying the weights.
    """
    target = image / np.asarray(albedo, float)
    slack = eps * image.max() / np.asarray(albedo, float)
    light = brightness * solid_angles / (2 * np.pi)
    unit = UNIT / max(light.sum(), np.max(target + slack))
    whole = lambda values: np.rint(np.broadcast_to(values * unit, np.shape(values))).astype(np.int64)
    middle, width = whole(target), np.broadcast_to(whole(slack), target.shape)
    return (middle - width).astype(np.int32), (middle + width).astype(np.int32), whole(light).astype(np.int32)
