"""Generated cases: a scene, a source and how it is rendered, as numbers whose repr() makes them again."""

from dataclasses import dataclass, field, replace

import numpy as np
from hypothesis import strategies as st

import skylamp as sl

SIDES = ("open", "dark", "periodic")
GROUNDS = ("flat", "plane", "noise", "rough", "whole", "spikes", "steps", "pit")
MASKS = ("none", "none", "full", "holes", "border", "islands", "one node")
LIGHTS = ("number",) * 5 + ("overcast", "cosine", "sun", "map", "band")  # functions take longer
SOURCES = ("sky", "sky", "ball", "panel", "window")
METHODS = (
    {"tolerance": 0.05},
    {"method": "horizon", "azimuths": 8},
    {"hemicube": 5},
    {"hemicube": 5, "filled": True},
    {"method": "unoccluded"},
)


@dataclass(frozen=True)
class Ground:
    """A map: ``relief`` and ``offset`` [spacing]; heights are multiples of 2^-6 before ``relief``."""

    rows: int = 9
    cols: int = 12
    kind: str = "noise"
    seed: int = 0
    relief: float = 4.0
    offset: float = 1.0
    spacing: float = 1.0
    mask: str = "none"
    sides: str = "open"
    albedo: float = 0.5


@dataclass(frozen=True)
class Case:
    """A ground, a source by its kind, light and seed, and what render() is asked for."""

    ground: Ground = Ground()
    source: str = "sky"
    light: str = "number"
    seed: int = 0
    how: dict = field(default_factory=lambda: {"tolerance": 0.03})


# -- strategies ----------------------------------------------------------------------------------------------


def powers_of_ten(low, high):
    return st.floats(low, high).map(lambda power: float(f"{10**power:.3g}"))


USUAL = powers_of_ten(-2, 1.5), st.sampled_from([1.0, 0.25, 30.0])  # reliefs and spacings


def grounds(most=48, reliefs=USUAL[0], spacings=USUAL[1], least=1):
    small = st.integers(least, min(most, 10))
    sizes = small | small | small | small | st.integers(least, most)
    return st.builds(
        Ground,
        rows=sizes,
        cols=sizes,
        kind=st.sampled_from(GROUNDS),
        seed=st.integers(0, 2**31),
        relief=reliefs,
        offset=st.sampled_from([0.0, 0.5, 3.0]),
        spacing=spacings,
        mask=st.sampled_from(MASKS),
        sides=st.sampled_from(SIDES),
        albedo=st.sampled_from([0.0, 0.3, 0.8, 1.0]),
    )


def cases(how=METHODS, sources=SOURCES, lights=LIGHTS, **more):
    return st.builds(
        Case,
        ground=grounds(**more),
        source=st.sampled_from(sources),
        light=st.sampled_from(lights),
        seed=st.integers(0, 2**31),
        how=st.sampled_from(how),
    ).filter(is_possible)


def is_possible(case):
    """Whether the library has a method for it; others are InputErrors, which `survives` meets."""
    periodic = case.ground.sides == "periodic"
    if case.source in ("ball", "panel") and periodic:
        return False
    by_lattice = "hemicube" in case.how
    if case.source == "panel" and by_lattice:
        return False
    return not (periodic and case.source == "window" and not by_lattice)


# -- what cases are made of ----------------------------------------------------------------------------------


def mask_of(ground):
    """(rows, cols) bool, or None; at least one node is valid."""
    rng, shape = np.random.default_rng(ground.seed + 1), (ground.rows, ground.cols)
    if ground.mask == "none":
        return None
    valid = np.ones(shape, bool)
    if ground.mask == "holes":
        valid = rng.random(shape) < 0.8
    elif ground.mask == "border":
        valid[0] = valid[:, -1] = False
    elif ground.mask == "islands":
        valid = rng.random(shape) < 0.1
    elif ground.mask == "one node":
        valid[:] = False
    if not valid.any():
        valid[ground.rows // 2, ground.cols // 2] = True
    return valid


def depth_of(ground):
    """(rows, cols) float64 [length], nan where masked."""
    rng, shape = np.random.default_rng(ground.seed), (ground.rows, ground.cols)
    y, x = np.indices(shape)
    noise = rng.random(shape)
    if ground.kind == "flat":
        z = np.zeros(shape)
    elif ground.kind == "plane":
        z = (x * rng.integers(-4, 5) + y * rng.integers(-4, 5)) / 16
    elif ground.kind == "rough":
        z = np.cumsum(np.cumsum(noise - 0.5, 0), 1) / 4
    elif ground.kind == "whole":
        z = rng.integers(0, 4, shape)
    elif ground.kind == "spikes":
        z = np.where(noise < 0.1, 0, 1)
    elif ground.kind == "steps":
        z = (x // 4 + y // 5) % 3 / 2
    elif ground.kind == "pit":
        z = np.where((abs(x - ground.cols // 2) < 3) & (abs(y - ground.rows // 2) < 3), 1, 0)
    else:
        z = noise
    z = np.rint(np.asarray(z, float) * 64) / 64
    depth = (ground.relief * (z - z.min()) + ground.offset) * ground.spacing
    valid = mask_of(ground)
    return depth if valid is None else np.where(valid, depth, np.nan)


def scene_of(ground, depth=None, **more):
    depth = depth_of(ground) if depth is None else depth
    return sl.Scene(
        depth,
        **{
            "spacing": ground.spacing,
            "albedo": ground.albedo,
            "mask": mask_of(ground),
            "sides": ground.sides,
            **more,
        },
    )


def brightness_of(case):
    """A number or a function, its greatest value between 0.1 and 40."""
    rng = np.random.default_rng(case.seed)
    axis = np.array([*rng.normal(0, 0.6, 2), -1.0])
    axis /= np.linalg.norm(axis)
    if case.light == "number":
        return float(rng.uniform(0.2, 4))
    if case.light == "overcast":
        return sl.cie_overcast(2.0)
    if case.light == "cosine":
        return sl.cosine_power(float(rng.uniform(0.5, 12)), tuple(-axis))
    if case.light == "sun":
        size = np.cos(np.radians(rng.uniform(1, 8)))
        return Disc(tuple(axis), float(size))
    if case.light == "band":
        low = float(rng.uniform(0.0, 0.6))
        return Band(low, low + 0.2)
    assert case.light == "map", case.light
    return sl.environment_map(rng.gamma(0.7, size=(8, 16)))


@dataclass(frozen=True)
class Disc:
    """An even sky with a bright disc."""

    axis: tuple
    cosine: float

    def __call__(self, L):
        return 1 + 30.0 * (L @ np.array(self.axis) > self.cosine)


@dataclass(frozen=True)
class Band:
    """An even sky with a bright ring, by sines of elevation."""

    low: float
    high: float

    def __call__(self, L):
        return 0.2 + 3.0 * ((self.low <= -L[..., 2]) & (-L[..., 2] < self.high))


def shape_of(case):
    """The numbers of a lamp or window, lengths in spacings: None for a sky."""
    rng, (rows, cols) = np.random.default_rng(case.seed + 1), (case.ground.rows, case.ground.cols)
    x, y = rng.uniform(-0.5, 1.5) * cols, rng.uniform(-0.5, 1.5) * rows
    size = max(rows, cols)
    if case.source == "ball":
        radius = float(np.exp(rng.uniform(np.log(0.02), np.log(0.5))) * size)
        return x, y, -radius * float(rng.uniform(1.05, 4)), radius
    if case.source == "panel":
        wide, long = rng.uniform(0.05, 1, 2) * size
        return x, y, -float(rng.uniform(0.1, 1)) * size, wide, long
    if case.source == "window":
        wide, long = rng.uniform(0.1, 1.2, 2) * size
        return x - wide / 2, x + wide / 2, y - long / 2, y + long / 2
    return None


def source_of(case, brightness=None, shape=None, unit=None):
    """The source; ``unit``: length of a spacing, the ground's unless given."""
    light = brightness_of(case) if brightness is None else brightness
    shape = shape_of(case) if shape is None else shape
    unit = case.ground.spacing if unit is None else unit
    if case.source == "sky":
        return sl.Sky(light)
    numbers = [value * unit for value in shape]
    if case.source == "ball":
        return sl.Lamp(tuple(numbers[:3]), numbers[3], light)
    if case.source == "panel":
        return sl.Lamp(
            corner=tuple(numbers[:3]), edges=((numbers[3], 0, 0), (0, numbers[4], 0)), brightness=light
        )
    return sl.Window(tuple(numbers[:2]), tuple(numbers[2:]), light)


def rendered(case, backend, scene=None, source=None, **more):
    """Rendering of direct irradiance, unless more is asked for."""
    options = {"quantity": "irradiance", "interreflection": False, **case.how, **more}
    return sl.render(
        scene_of(case.ground) if scene is None else scene,
        source_of(case) if source is None else source,
        backend=backend,
        **options,
    )


def with_ground(case, **changes):
    return replace(case, ground=replace(case.ground, **changes))
