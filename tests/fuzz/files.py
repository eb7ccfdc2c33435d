"""Damaged files: every format, cut anywhere, bytes flipped, under strange names."""

import contextlib
import functools
import io as memory
import os
import tempfile
import warnings
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import tifffile
from hypothesis import strategies as st

import skylamp as sl
from skylamp import io

RNG = np.random.default_rng(7)
FLOATS = RNG.random((6, 7)).astype(np.float32)
COUNTS = RNG.integers(0, 65536, (6, 7), dtype=np.uint16)
STRIPS = {"rowsperstrip": 2, "compression": "zlib"}
MAKERS = {
    "floats.npy": lambda path: np.save(path, FLOATS),
    "counts.npz": lambda path: np.savez_compressed(path, depth=COUNTS),
    "floats.npz": lambda path: np.savez(path, FLOATS),
    "counts.png": lambda path: io.write(path, COUNTS),
    "scaled.png": lambda path: io.write(path, FLOATS),
    "floats.tif": lambda path: io.write(path, FLOATS),
    "strips.tif": lambda path: tifffile.imwrite(path, COUNTS, photometric="minisblack", **STRIPS),
    "floats.exr": lambda path: io.write(path, FLOATS),
    "colour.exr": lambda path: io.write(path, np.stack([FLOATS] * 3, -1)),
    "colour.hdr": lambda path: io.write(path, np.stack([FLOATS] * 3, -1)),
    "geo.tif": lambda path: _geotiff(path),
    "pickle.npy": lambda path: np.save(path, np.array([{}], object), allow_pickle=True),
}
NAMES = ("a", " ", "ä ö", "-rf", "a\nb", "%s", "'; --", "🗻", "a.b.c", "x" * 200, "..a", "\\", "*")


@dataclass(frozen=True)
class Damaged:
    """A file cut to a ``share`` of its length, or of which bytes are changed: (share of length, value)."""

    made: str
    name: str
    share: float
    changes: tuple


def cases():
    where = st.floats(0, 1, exclude_max=True)
    return st.builds(
        Damaged,
        made=st.sampled_from(list(MAKERS)),
        name=st.sampled_from(NAMES),
        share=st.just(1.0) | where,
        changes=st.lists(st.tuples(where, st.integers(0, 255)), max_size=3).map(tuple),
    )


def _geotiff(path):
    import rasterio
    from rasterio.transform import from_origin

    about = {"driver": "GTiff", "height": 6, "width": 7, "count": 1, "dtype": "float32", "crs": "EPSG:32633"}
    with rasterio.open(path, "w", transform=from_origin(5e5, 5e6, 30, 30), **about) as file:
        file.write(FLOATS, 1)


@functools.cache
def whole(made):
    """(bytes of the file, its array)."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / made
        MAKERS[made](path)
        return path.read_bytes()


@functools.cache
def folder():
    return tempfile.mkdtemp(prefix="skylamp-fuzz-")


def check(case, backend):
    """Every reader gives an array of real numbers, or an error of skylamp's own that names the file."""
    data = bytearray(whole(case.made))
    for share, value in case.changes:
        data[int(share * len(data))] = value
    data = bytes(data[: int(case.share * len(data))])
    path = Path(folder()) / f"{case.name}{Path(case.made).suffix}"
    path.write_bytes(data)
    before = {entry.name for entry in os.scandir(folder())}
    try:
        with warnings.catch_warnings(), contextlib.redirect_stderr(memory.StringIO()):
            warnings.simplefilter("ignore")
            for read in (io.read, io.read_environment, io.read_range, sl.geo.is_geotiff, sl.geo.read):
                if read is sl.geo.read and path.suffix != ".tif":
                    continue
                try:
                    found = read(path)
                except sl.SkylampError as error:
                    assert path.name.split("\n")[0] in str(error), f"no name in {error}"
                else:
                    if read in (io.read, io.read_environment):
                        assert found.dtype.kind in "biuf" and found.size, read
        assert path.read_bytes() == data, "the file was changed"
        assert {entry.name for entry in os.scandir(folder())} == before, "another file was made"
    finally:
        path.unlink()
