"""Odd input to all public functions: any shape, type, number and brightness function."""

from dataclasses import dataclass

import numpy as np
from fuzz.cases import SIDES, Ground, depth_of, grounds, mask_of, powers_of_ten
from hypothesis import strategies as st

import skylamp as sl

CALLS = (
    "render",
    "plan",
    "horizons",
    "sky_view_factor",
    "openness",
    "visibility",
    "visibility_field",
    "recover",
)
DTYPES = (
    "float64",
    "float32",
    "float16",
    "int64",
    "uint8",
    ">f4",
    "bool",
    "complex64",
    "object",
    "longdouble",
)
SPOILT = (*(None,) * 20, np.nan, np.inf, -np.inf, -1.0, 1e30, 1e300, 5e-324)
BRIGHTNESS = (
    "number",
    "zero",
    "tiny",
    "huge",
    "overcast",
    "wrong shape",
    "nan",
    "negative",
    "raises",
    "state",
    "complex",
    "text",
    "integers",
    "float32",
    "writes",
    "colour",
    "spike",
)
ALBEDOS = (0.8, 0.0, 1.0, "map", "colour", np.nan, 2.0)
METHODS = (
    {},
    {"tolerance": 0.1},
    {"method": "horizon"},
    {"azimuths": 1},
    {"hemicube": 3},
    {"hemicube": 5, "filled": True},
    {"method": "unoccluded"},
    {"interreflection": True, "tolerance": 0.05},
    {"max_distance": 3.0},
    {"quantity": "irradiance", "parts": True},
)


class Raised(Exception):
    """What a caller's own function raises: it must come out as it is."""


@dataclass(frozen=True)
class Odd:
    """One call. ``spoilt``: what is put at one node of the depth."""

    ground: Ground
    call: str
    dtype: str
    spoilt: float | None
    source: str
    brightness: str
    albedo: object
    how: dict
    seed: int
    size: float


def cases():
    wide = grounds(
        most=24,
        reliefs=powers_of_ten(-9, 9) | st.sampled_from([1.0, 5.0]),
        spacings=powers_of_ten(-9, 9) | st.sampled_from([1.0]),
    )
    offset = st.sampled_from([0.0, 1.0, 1e7])
    return st.builds(
        lambda ground, offset, **rest: Odd(ground=Ground(**{**vars(ground), "offset": offset}), **rest),
        ground=wide,
        offset=offset,
        call=st.sampled_from(CALLS[:1] * 8 + CALLS),
        dtype=st.sampled_from(DTYPES[:2] * 15 + DTYPES),
        spoilt=st.sampled_from(SPOILT),
        source=st.sampled_from(("sky", "ball", "panel", "window", "volume", "aperture", "sun")),
        brightness=st.sampled_from(BRIGHTNESS[:1] * 20 + BRIGHTNESS),
        albedo=st.sampled_from(ALBEDOS[:2] * 10 + ALBEDOS),
        how=st.sampled_from(METHODS),
        seed=st.integers(0, 2**31),
        size=powers_of_ten(-3, 3) | powers_of_ten(-30, 30),
    )


def brightness_of(name, seed):
    calls = []
    shape = lambda L: L.shape[:-1]
    functions = {
        "number": 1.5,
        "zero": 0.0,
        "tiny": lambda L: 1e-28 * (1 - L[..., 2]),
        "huge": lambda L: 1e28 * (1 - L[..., 2]),
        "overcast": sl.cie_overcast(),
        "wrong shape": lambda L: np.ones(3),
        "nan": lambda L: np.where(L[..., 0] > 0.5, np.nan, 1.0),
        "negative": lambda L: L[..., 0],
        "raises": lambda L: (_ for _ in ()).throw(Raised("on purpose")),
        "state": lambda L: (calls.append(1), np.full(shape(L), float(len(calls))))[1],
        "complex": lambda L: np.ones(shape(L)) * 1j,
        "text": lambda L: "bright",
        "integers": lambda L: np.ones(shape(L), int),
        "float32": lambda L: np.ones(shape(L), np.float32),
        "writes": lambda L: (L.__setitem__(Ellipsis, 0), np.ones(shape(L)))[1],
        "colour": lambda L: np.stack([1 - L[..., 2]] * 3, -1),
        "spike": lambda L: 1.0 + 1e6 * (L[..., 2] < -0.999999),
    }
    return functions[name]


def source_of(case):
    rng, light = np.random.default_rng(case.seed), brightness_of(case.brightness, case.seed)
    shape, unit = (case.ground.rows, case.ground.cols), case.ground.spacing
    x, y = rng.uniform(-1, 2, 2) * max(shape) * unit
    size = case.size * unit
    if case.source == "sky":
        return sl.Sky(light)
    if case.source == "sun":
        return sl.Sky(sl.cie_sky(12, (rng.uniform(0, 360), rng.uniform(0, 90)), direct=2.0))
    if case.source == "ball":
        return sl.Lamp((x, y, -size * rng.uniform(0, 3)), size, light)
    if case.source == "panel":
        return sl.Lamp(corner=(x, y, -size), edges=((size, 0, 0), (0, unit, 0)), brightness=light)
    if case.source == "window":
        return sl.Window((x - size, x + size), (y - unit, y + size), light)
    flags = rng.random(shape) < 0.3
    if case.source == "aperture":
        return sl.Window(aperture=flags, brightness=light)
    return sl.Lamp(volume=np.stack([flags, ~flags]), brightness=light)


def albedo_of(case):
    shape = case.ground.rows, case.ground.cols
    if case.albedo == "map":
        return np.random.default_rng(case.seed).random(shape)
    return (0.2, 0.5, 0.9) if case.albedo == "colour" else case.albedo


def check(case, backend):
    """Calls, and looks at what comes back; sl.SkylampError and the caller's own Raised are good ends."""
    try:
        with np.errstate(all="ignore"):
            depth = depth_of(case.ground)
            if case.spoilt is not None:
                depth[-1, 0] = case.spoilt
            depth = depth.astype(case.dtype)
        before = depth.copy()
        scene = sl.Scene(depth, case.ground.spacing, albedo_of(case), mask_of(case.ground), case.ground.sides)
        found = called(case, scene, source_of(case), backend)
    except (sl.SkylampError, Raised) as error:
        assert str(error).strip(), "an error without a word"
        return
    if case.dtype != "object":
        assert depth.tobytes() == before.tobytes(), "the caller's array was changed"
    valid = scene.valid
    for name, image in found.items():
        image = np.asarray(image)
        if image.dtype.kind != "f":
            continue
        per_azimuth = name == "horizons"  # which come first there; colours come last
        where = image[..., valid] if per_azimuth else image[valid]
        low = -np.inf if name == "horizons" else 0
        assert not np.isnan(where).any(), f"{name}: nan at a valid node"
        # where nothing is lit by exact rays any error is infinite times the light, and a warning says so
        unbounded = name == "horizons" or name == "error" and found["warned"].any()
        assert unbounded or np.isfinite(where).all(), f"{name}: infinite"
        assert name == "openness" or not (where < low).any(), f"{name}: {where.min()}"


def called(case, scene, source, backend):
    """{name: array} of what a call gives."""
    if case.call == "render":
        out = sl.render(scene, source, backend=backend, **case.how)
        assert all(isinstance(text, str) and text for text in out.warnings) and str(out.plan)
        images = {"image": out.image, "error": out.error, "direct": out.direct}
        images["warned"] = np.array(["Tolerance" in text for text in out.warnings], bool)
        return {name: image for name, image in images.items() if image is not None}
    if case.call == "plan":
        assert str(sl.plan(scene, source, backend=backend))
        return {}
    if case.call in ("visibility", "visibility_field"):
        if case.call == "visibility":
            return {"bits": sl.visibility(scene, source, 5, backend, filled=case.seed % 2 == 0)}
        field = sl.visibility_field(scene, source, 3, backend=backend, max_bytes=10**7)
        return {"bits": field.words}
    if case.call == "recover":
        image = np.where(scene.valid, scene.depth, 1.0)[:12, :12]
        out = sl.recover(image, source, 0.5, scene.sides, layers=8, max_seconds=1.0, backend=backend)
        assert np.isfinite(out.depth).all() and ((out.confidence >= 0) & (out.confidence <= 1)).all()
        return {}
    return {case.call: getattr(sl, case.call)(scene, azimuths=8, backend=backend)}


__all__ = ["SIDES", "Odd", "cases", "check"]
