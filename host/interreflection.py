"""Light between surfaces: whether a scene needs it, and rounds of gathering until it is within the tolerance.

A node of albedo rho that sees a share f of the sky sends light to itself by way of its neighbours; if these
were all like it, its irradiance would be E_d / (1 - rho (1 - f)). From samples alone, the difference to E_d
decides whether the light between surfaces is computed. light/interreflection.py then gathers it, and exact
strips at some nodes estimate the error.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from .backends.base import Backend
from .backends.resident import DeviceImage
from .errors import bad
from .light.horizon import OFFSET
from .light.interreflection import Bounces, Round
from .light.sweeps import Rays, Sweeps, ground_of
from .samples import ESTIMATE_SHARE, Samples, errors, lit_mean, picked, samples_of, spread_more, without_walls
from .scene import Scene
from .sources.integrals import even

# share of the tolerance that light between surfaces may have and be left out; chosen: errors add by squares,
# so that it takes a twentieth of what is left for the direct light
NEEDED = 1 / 3
# nodes whose light is computed by exact strips; chosen: they estimate an RMS to 1 / sqrt(2 x 144), 6 %, and
# their strips take time in proportion
CHECKED = 144
# nodes that these are chosen from, half evenly, half in proportion to the square of the light that they send
# to themselves; and that decide once the direct light is known. Derived: a region of 3 / 2^15 of the nodes is
# missed in 5 % of all cases, and the RMS error is 0.5 % where it lacks half of the mean light
CANDIDATE_NODES = 2**15
# azimuths of the share of sky that decides, where the source is no uniform sky; side [node] of blocks: the
# ground that lights a node lies in its own block or in one beside it. Both chosen
DECIDING_AZIMUTHS, NEAR_ALBEDO = 4, 8
WALL_AZIMUTHS = 16  # of the share of ground in a dark box, at checked nodes; chosen
MOST_COARSE_ROUNDS = 8
# share of ground below which it counts as none visible from a node, and gets no light from it: rounding;
# chosen
LEAST_GROUND = 1e-6
# RMS error of a uniform sky's light over pi by even azimuths, on rough ground (performance/horizon.py)
AZIMUTH_ERRORS = {16: 0.0031, 32: 0.0011, 64: 0.00037, 128: 0.00013}
# of the tolerance that azimuths may take for the share of sky, and at checked nodes; chosen
SKY_ERROR, CHECK_ERROR = 0.4, 0.15
# the same of the share of sky among cliffs, where the error of azimuths is some three times that on rough
# ground, and rows within which every crossing is tested there, as for the direct light
CLIFF_SKY_ERROR, FINE_NEAR = 0.12, 24
COARSE_ROUND = Round(8, 4, 4, 0.25)
# [tolerance] light between surfaces up to which rounds begin with the first level, else with the second;
# chosen: ESTIMATE_SHARE over the first one's error, which is 1 to 7 % of this light on ground without cliffs
# and 5 to 31 % among cliffs (performance/interreflection.py --first). Half and twice: 5 % less and 6 % more
# time on 17 surfaces
FIRST_LEVEL = 10
# a round of each level, after the coarse ones
FINE_ROUNDS = (
    Round(8, 2, 4, 0.25),
    Round(16, 2, 4, 0.18),
    Round(8, 1, 4, 0.18),
    Round(16, 1, 4, 0.18),
    Round(32, 1, 16, 0.125),
    Round(64, 1, 32, 0.1),
)
# RMS error over the mean of rounds without regard for cliffs, over the square root of the share of cliffs
# (performance/interreflection.py --cliffs: 0.034 to 0.042 for one house to many), and the part of the
# tolerance from which on it counts; chosen: an estimate may take ESTIMATE_SHARE, and errors add by squares
CLIFF_ERROR, CLIFF_SHARE = 0.04, 0.2
# where it does, edges hide much: crossings met one by one at least, and rounds of each level but the first
CLIFF_NEAR, CLIFF_ROUNDS = 16, 2
# from this level on, one that leaves more than this share of the error is the last: more azimuths
# do not reduce the rest
GAINED_FROM, GAINED_SHARE = 4, 0.9


@dataclass(frozen=True)
class Interreflection:
    """The decision about the light between surfaces, its reason and its error.

    included: whether it is in the image, None where that is decided while a lazy image is computed; reason:
    why, or why not; share: RMS of this light over the mean of the direct light, that of the image where it is
    included, else as estimated, None where it was not; rounds of gathering, the last in ``azimuths`` at every
    ``stride``-th node; error: of all light, RMS over its mean, by exact strips at some nodes. Where this
    light is left out, and where every tile has rounds of its own, rounds is 0, and azimuths, stride and error
    are None.
    """

    included: bool | None
    reason: str
    share: float | None = None
    rounds: int = 0
    azimuths: int | None = None
    stride: int | None = None
    error: float | None = None

    def __str__(self) -> str:
        if self.included is None:
            return f"included {self.reason}"
        if not self.included:
            return f"left out: {self.reason}"
        if self.azimuths is None:
            return f"included: {self.reason}"
        nodes = "every node" if self.stride == 1 else f"every {self.stride}nd node"
        return f"{self.rounds} rounds, the last in {self.azimuths} azimuths at {nodes}: {self.reason}"


class Included(NamedTuple):
    """Irradiances (rows, cols) float32 of all light, one per colour, the record and warnings.

    One light lies where the direct light does. ``errors``: RMS error of each [brightness x sr].
    """

    irradiances: Sequence[np.ndarray | DeviceImage]
    record: Interreflection
    errors: list[float]
    warnings: list[str]


def local_share(
    direct: np.ndarray, sky: np.ndarray, albedo: Any, after: int = 0, weights: np.ndarray | None = None
) -> float:
    """RMS of E_d q^(n + 1) / (1 - q) over the mean of E_d, q = albedo (1 - f), n = ``after`` bounces.

    That is the light that nodes send to themselves if all ground is like them: an estimate of the light
    between surfaces, or of the rest of it after some bounces. ``weights``: of the nodes.
    """
    light = float(np.average(direct, weights=weights))
    if not light > 0:
        return 0.0
    return math.sqrt(np.average(_sent(direct, sky, albedo, after) ** 2, weights=weights)) / light


def _sent(direct: np.ndarray, sky: np.ndarray, albedo: Any, after: int = 0) -> np.ndarray:
    """E_d q^(n + 1) / (1 - q) of every node, see :func:`local_share`."""
    q = albedo * (1 - np.clip(sky, 0, 1))
    q = np.minimum(q, 1 - 1e-3)  # albedo 1 where no sky is seen
    rest: np.ndarray = direct * q ** (after + 1) / (1 - q)
    return rest


def local_sums(direct: np.ndarray, sky: np.ndarray, albedo: Any) -> np.ndarray:
    """What :func:`share_of` takes of some nodes of a map: their number, and the sums of the direct light and
    of the square of what they send to themselves, (3,) float64.
    """
    sent = _sent(direct.astype(float), sky, albedo)
    return np.array([direct.size, direct.sum(dtype=float), np.square(sent).sum()])


def share_of(sums: np.ndarray) -> float:
    """:func:`local_share` of all nodes, the worst colour's, from the :func:`local_sums` (colours, 3)."""
    return max(
        math.sqrt(square / count) / (light / count) if light > 0 else 0.0 for count, light, square in sums
    )


def albedos(scene: Scene) -> list[Any]:
    """The diffuse albedo, one or one per colour: numbers or arrays (rows, cols)."""
    albedo = np.asarray(scene.albedo, np.float32)
    if albedo.ndim in (1, 3):
        return [albedo[..., n] for n in range(3)]
    return [albedo]


def expected(scene: Scene, samples: Samples, direct: np.ndarray, sky: np.ndarray) -> float:
    """Estimated RMS of the light between surfaces over the mean of the direct light, of the worst colour.

    ``direct`` and ``sky`` (share of sky, 0 to 1): at the samples.
    """
    at = [share[samples.y, samples.x] if np.ndim(share) else share for share in albedos(scene)]
    return max(local_share(direct, sky, share) for share in at)


def share_everywhere(
    scene: Scene,
    engine: Backend,
    direct: Sequence[np.ndarray | DeviceImage],
    brightness: Sequence[float] | None,
) -> float:
    """:func:`local_share` by many nodes, of the worst colour, once the direct light is known.

    Rare ground, as a hole in a plain, falls between the samples of a plan. ``brightness``: of a uniform sky,
    which each of ``direct`` comes from; None for any other source.
    """
    samples, shares = samples_of(engine, scene, CHECKED), albedos(scene)
    if not samples.relief > 0 or brightness is not None and not max(brightness) > 0:
        return 0.0
    samples = spread_more(samples, scene, CANDIDATE_NODES)
    lights = [_at(samples, image) for image in direct]
    if brightness is None or scene.sides == "dark":
        sectors, ground = even(DECIDING_AZIMUTHS, OFFSET), ground_of(scene, None, engine)
        # walls of a dark box hide sky too, and send no light
        ground = ground._replace(sides="open") if scene.sides == "dark" else ground
        sweeps = Sweeps(engine, ground, Rays(sectors.angles, sectors.widths))
        sky = _at(samples, sweeps.image()) / math.pi
    else:
        most = int(np.argmax(brightness))
        sky = lights[most] / (math.pi * brightness[most])
    near = [_largest_near(share)[samples.y, samples.x] if np.ndim(share) else share for share in shares]
    count = max(len(lights), len(near))
    return max(local_share(lights[n % len(lights)], sky, near[n % len(near)]) for n in range(count))


def _largest_near(albedo: np.ndarray) -> np.ndarray:
    """The largest albedo (rows, cols) of the ground near every node, which lights it."""
    rows, cols = (-(-n // NEAR_ALBEDO) for n in albedo.shape)
    ends = [(0, blocks * NEAR_ALBEDO - n) for blocks, n in zip((rows, cols), albedo.shape)]
    blocks = np.pad(albedo, ends, "edge").reshape(rows, NEAR_ALBEDO, cols, NEAR_ALBEDO).max((1, 3))
    around = np.pad(blocks, 1, "edge")
    most = np.max([around[i : i + rows, j : j + cols] for i in range(3) for j in range(3)], 0)
    wide: np.ndarray = most.repeat(NEAR_ALBEDO, 0).repeat(NEAR_ALBEDO, 1)
    return wide[: albedo.shape[0], : albedo.shape[1]]


def is_needed(share: float, tolerance: float) -> bool:
    """Whether leaving out that much costs more than NEEDED of the tolerance."""
    return share > NEEDED * tolerance


def check_choice(interreflection: Any) -> None:
    """InputError unless it is "auto", True or False."""
    is_auto = isinstance(interreflection, str) and interreflection == "auto"
    if not isinstance(interreflection, bool) and not is_auto:
        raise bad("interreflection", repr(interreflection), '"auto", True or False')


def choice(interreflection: bool | str, share: float | None, tolerance: float) -> tuple[str, str]:
    """(decision, reason), for a plan."""
    why = reason(share, tolerance)
    if isinstance(interreflection, bool):
        return ("included" if interreflection and share != 0 else "left out"), f"as asked; {why}"
    if share is not None and not is_needed(share, tolerance):
        return "left out", why
    last = FINE_ROUNDS[_first_level(share or 0.0, tolerance)]
    return "included", f"{why}; coarse rounds, then {last.azimuths} azimuths at every 2nd node"


def reason(share: float | None, tolerance: float) -> str:
    """Why light between surfaces is included, or left out, by the estimate of how much it is."""
    if share is None:
        return "how much it is was not estimated before"
    compared = "more" if is_needed(share, tolerance) else "no more"
    return (
        f"it is about {100 * share:.2g} % of the direct light (RMS over the mean), {compared} than a third of"
        " the tolerance"
    )


def _first_level(share: float, tolerance: float) -> int:
    return 0 if share <= FIRST_LEVEL * tolerance else 1


def sky_share(
    scene: Scene,
    engine: Backend,
    tolerance: float,
    has_cliffs: bool = False,
    max_distance: float | None = None,
) -> DeviceImage:
    """Cosine-weighted share of the sky visible from every node, by a sweep."""
    sectors = even(_azimuths((CLIFF_SKY_ERROR if has_cliffs else SKY_ERROR) * tolerance), OFFSET)
    ground = ground_of(scene, max_distance, engine)
    near = FINE_NEAR if has_cliffs else None
    sweeps = Sweeps(engine, ground, Rays(sectors.angles, sectors.widths), near=near)
    image = sweeps.image()
    image.scale(1 / math.pi)
    return image


def _azimuths(allowed: float) -> int:
    """The fewest azimuths whose error is no more than ``allowed``, or the most."""
    return next((n for n, error in AZIMUTH_ERRORS.items() if error <= allowed), max(AZIMUTH_ERRORS))


def included(
    scene: Scene,
    engine: Backend,
    direct: Sequence[np.ndarray | DeviceImage],
    tolerance: float,
    why: str,
    error: float = 0.0,
    sky: np.ndarray | DeviceImage | None = None,
    is_part: bool = False,
    tail: float | None = None,
    max_distance: float | None = None,
) -> Included:
    """All light within the tolerance, from the direct light of each colour.

    One light may be a DeviceImage, which is used in place. ``error``: RMS of that of ``direct`` over its
    mean; ``sky``: share of sky at every node, if ``direct`` is proportional to it. ``is_part``:
    ``sky`` is that of a part of a map, beyond which ground hides sky too. That ground
    counts as being as bright as the ground that is visible within the part. ``tail``: bound of the 99.9th
    percentile of the error over the mean, beyond which there is a warning. ``max_distance`` [unit of
    spacing]: ground farther away hides no sky, so that what a node gets from ground is so much less.
    """
    samples = samples_of(engine, scene, CHECKED)
    is_part = is_part or max_distance is not None
    # walls of a dark box are no ground, so that strips tell nothing of the direct light's error
    is_uniform = sky is not None and not is_part and scene.sides != "dark"
    has_cliffs = CLIFF_ERROR * math.sqrt(samples.cliffs) > CLIFF_SHARE * tolerance
    sky = sky_share(scene, engine, tolerance, has_cliffs, max_distance) if sky is None else sky
    shares = albedos(scene)
    count = max(len(direct), len(shares))
    lights, shares = ([values[n % len(values)] for n in range(count)] for values in (direct, shares))
    weights = _choose_checked(samples, scene, lights, shares, sky)
    bounces = Bounces(engine, scene, samples, lights, shares, sky)
    check = _Check(bounces, lights, shares, sky, weights, error, is_uniform, is_part)
    coarse = check.coarse_rounds(tolerance)
    bounces.run([COARSE_ROUND] * coarse)
    done, level, before = coarse, _first_level(check.share, tolerance), math.inf
    while True:
        rounds = _rounds(level, has_cliffs)
        bounces.run(rounds)
        done += len(rounds)
        total, rms_errors = check.errors(_azimuths(CHECK_ERROR * tolerance))
        useless = level >= GAINED_FROM and total > GAINED_SHARE * before
        if total <= ESTIMATE_SHARE * tolerance or level + 1 == len(FINE_ROUNDS) or useless:
            break
        before, level = total, level + 1
    last = rounds[-1]
    record = Interreflection(True, why, check.found, done, last.azimuths, last.stride, total)
    warnings = []
    if total > tolerance:
        warnings.append(
            f"Tolerance: with the light between surfaces the estimated error is {100 * total:.4g} %"
            f" of the mean (RMS), more than the {100 * tolerance:.4g} % asked for."
        )
    if tail is not None and check.tail > tail:
        warnings.append(
            f"Tail: with the light between surfaces the 99.9th percentile of the error is about"
            f" {100 * check.tail:.2g} % of the mean, more than the {100 * tail:.3g} % asked for."
        )
    if check.guessed > tolerance:
        warnings.append(
            f"Tolerance: about {100 * check.guessed:.1g} % of the light (RMS over the mean) comes from ground"
            " beyond a tile's halo, which is taken to be as bright as the ground within."
        )
    on_device = count == 1 and isinstance(direct[0], DeviceImage)
    irradiances = [bounces.device_image()] if on_device else bounces.irradiance()
    return Included(irradiances, record, rms_errors, warnings)


def _choose_checked(
    samples: Samples,
    scene: Scene,
    direct: Sequence[np.ndarray | DeviceImage],
    albedo: Sequence[Any],
    sky: np.ndarray | DeviceImage,
) -> np.ndarray:
    """Move the samples to CHECKED of many nodes; the weights of these, by which they stand for all."""
    many = spread_more(samples, scene, CANDIDATE_NODES)
    if len(many) <= CHECKED:
        return np.ones(len(samples))
    seen, likely = _at(many, sky), np.zeros(len(many))
    for image, share in zip(direct, albedo):
        light = _at(many, image)
        light = np.maximum(light, light.mean())  # ground around a node in shadow may be lit
        sent = _sent(light, seen, share[many.y, many.x] if np.ndim(share) else share) ** 2
        likely = np.maximum(likely, sent / max(float(sent.mean()), 1e-300))
    likely = (1 + likely / max(float(likely.mean()), 1e-300)) / 2 if likely.any() else np.ones(len(likely))
    ends = np.cumsum(likely)
    chosen = np.searchsorted(ends, ends[-1] * (np.arange(CHECKED) + 0.5) / CHECKED)
    samples.set_nodes(many.x[chosen], many.y[chosen])
    weights: np.ndarray = 1 / likely[chosen]
    return weights


def _rounds(level: int, has_cliffs: bool) -> tuple[Round, ...]:
    """Rounds of a level."""
    this = FINE_ROUNDS[level]
    if not has_cliffs:
        return (this,)
    near = this._replace(near=max(this.near, CLIFF_NEAR))
    return (near,) * (CLIFF_ROUNDS if level else 1)


class _Check:
    """Light at some nodes, by which the rounds are chosen and their error is estimated."""

    def __init__(
        self,
        bounces: Bounces,
        direct: Sequence[np.ndarray | DeviceImage],
        albedo: Sequence[Any],
        sky: np.ndarray | DeviceImage,
        weights: np.ndarray,
        error: float,
        is_uniform: bool,
        is_part: bool,
    ):
        self.weights = weights  # of the nodes
        self.bounces, self.error, self.is_uniform, self.is_part = bounces, error, is_uniform, is_part
        self.guessed = 0.0  # RMS over the mean of the light that comes from beyond the map
        self.tail = 0.0  # 99.9th percentile of the error over the mean
        self.found = 0.0  # RMS of the present light between surfaces over the mean of the direct light
        samples = bounces.samples
        self.sky, *self.direct = (_at(samples, image) for image in (sky, *direct))
        self.open = self.sky  # share of what is no ground; the walls of a dark box are none
        if bounces.sides == "dark":
            self.open = 2 * without_walls(samples).uniform(even(WALL_AZIMUTHS, OFFSET).angles).mean(0)
        self.albedo = [share[samples.y, samples.x] if np.ndim(share) else share for share in albedo]
        self.share = self._left(0)

    def _left(self, rounds: int) -> float:
        """Light that bounces more often than ``rounds`` times, of the worst colour."""
        return max(
            local_share(light, self.open, share, rounds, self.weights)
            for light, share in zip(self.direct, self.albedo)
        )

    def coarse_rounds(self, tolerance: float) -> int:
        """Rounds of the coarse gather until light that bounces more often is within the tolerance.

        The rounds begin with an estimate of all bounces, so that the error is a part of that light alone,
        and one round more is at least that of the first level.
        """
        rounds = range(1, MOST_COARSE_ROUNDS)
        return next((n for n in rounds if self._left(n + 1) <= tolerance), MOST_COARSE_ROUNDS)

    def errors(self, azimuths: int) -> tuple[float, list[float]]:
        """(RMS error over the mean of all light, of the worst colour; RMS error of every colour).

        By exact strips of the present light in so many azimuths. The residual is what one more bounce
        changes; all bounces more change it by 1 / (1 - q), if all ground is alike. The direct light's own
        error is part of it under a uniform sky, whose strips are known as well: where less sky is seen there
        is more ground. Under other sources it is independent.
        """
        totals, (light, sky) = self.bounces.total_at_samples(), self.bounces.at_samples(azimuths)
        worst, rms_errors = 0.0, []
        self.guessed = self.tail = self.found = 0.0
        for total, direct, share, sent in zip(totals, self.direct, self.albedo, light):
            mean, first = lit_mean(total, self.weights), lit_mean(direct, self.weights)
            if (light_first := self._mean(direct)) > 0:
                self.found = max(self.found, math.sqrt(self._mean((total - direct) ** 2)) / light_first)
            if self.is_part:
                more = sent * ((1 - self.sky) / np.maximum(1 - sky, LEAST_GROUND) - 1)
                sent = sent + more
                guessed = math.sqrt(self._mean(np.maximum(more, 0) ** 2))
                self.guessed = max(self.guessed, guessed / mean if mean > 0 else 0.0)
            exact, shared = direct, self.error * first
            if self.is_uniform and self.sky.any():
                exact, shared = sky * (direct.sum() / self.sky.sum()), 0.0
            q = np.minimum(share * (1 - np.clip(self.open, 0, 1)), 1 - 1e-3)
            off = (exact + sent - total) / (1 - q)
            rms = math.hypot(math.sqrt(self._mean(off**2)), shared)
            rms_errors.append(rms)
            worst = max(worst, rms / mean if mean > 0 else 0.0)
            times = np.rint(4 * self.weights).astype(int)  # at most 8
            total, off = np.repeat(total, times), np.repeat(off, times)
            self.tail = max(self.tail, errors(total, total + off).tail)
        return worst, rms_errors

    def _mean(self, values: np.ndarray) -> float:
        """Over all nodes, by those that are checked."""
        return float(np.average(values, weights=self.weights))


def _at(samples: Samples, image: np.ndarray | DeviceImage) -> np.ndarray:
    """An image at the samples, (nodes,) float64."""
    if isinstance(image, DeviceImage):
        return picked(samples, image.values).astype(float)
    return samples.of(image)
