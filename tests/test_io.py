"""Files: exact round trips, bit depths, damaged files, and outputs that are whole or absent."""

import pickle
import struct
import tracemalloc
import zipfile
import zlib

import imageio.v3 as imageio
import numpy as np
import pytest
import tifffile
from PIL import Image
from PIL.PngImagePlugin import PngInfo

import skylamp as sl
from skylamp import io
from skylamp.app import parsing
from skylamp.errors import InputError
from skylamp.io.files import LUMINANCE
from skylamp.io.paths import MAP_SUFFIXES

RNG = np.random.default_rng(7)
GREY8 = RNG.integers(0, 256, (13, 17), dtype=np.uint8)
GREY16 = RNG.integers(0, 65536, (13, 17), dtype=np.uint16)
FLOATS = RNG.normal(size=(13, 17)).astype(np.float32)
FLOATS[2, 3], FLOATS[4, 5] = np.nan, -np.inf


def same(got, expected):
    assert got is not expected and got.dtype == expected.dtype and got.shape == expected.shape
    assert got.tobytes() == expected.tobytes()


def refused(function, *arguments, says, **options):
    with pytest.raises(InputError) as caught:
        function(*arguments, **options)
    text = str(caught.value)
    for part in (says,) if isinstance(says, str) else says:
        assert part in text, text
    assert "\n" not in text
    return text


def png16_rgb(path):
    """A 16-bit RGB PNG by hand: Pillow cannot write one, and reads it as 8-bit."""
    rows = b"".join(b"\0" + row.tobytes() for row in np.arange(4 * 5 * 3, dtype=">u2").reshape(4, 15) * 999)
    chunk = lambda kind, body: (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    )
    header = struct.pack(">IIBBBBB", 5, 4, 16, 2, 0, 0, 0)
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", header)
        + chunk(b"IDAT", zlib.compress(rows))
        + chunk(b"IEND", b"")
    )


@pytest.mark.parametrize("suffix", [".npy", ".npz", ".tif", ".tiff", ".TIF", ".png", ".PNG"])
@pytest.mark.parametrize("array", [GREY8, GREY16, FLOATS], ids=["uint8", "uint16", "float32"])
def test_what_is_written_comes_back_to_the_bit(tmp_path, suffix, array):
    """Every format with every type that it holds, extension in either case."""
    if suffix.lower() == ".png" and array.dtype == np.float32:
        suffix = ".npy"  # PNG scales floating values: test_png_scale
    path = tmp_path / f"a{suffix}"
    assert io.write(path, array) is None
    same(io.read(path), array)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("dtype", ["int16", "int32", "uint32", "float64", ">u2", ">f4"])
def test_foreign_tiff_types(tmp_path, dtype):
    """Elevation often comes as int16 or float64, and big-endian: same values, same type."""
    array = (RNG.normal(size=(9, 7)) * 100).astype(dtype)
    tifffile.imwrite(tmp_path / "a.tif", array, compression="zlib", byteorder=">" if dtype[0] == ">" else "<")
    got = io.read(tmp_path / "a.tif")
    assert got.dtype.newbyteorder("=") == array.dtype.newbyteorder("=") and (got == array).all()


def test_layers_in_npy_and_tiff(tmp_path):
    """Three equal pages are layers, not colours."""
    for name in ("a.npy", "a.tif", "a.npz"):
        array = RNG.random((3, 6, 5), dtype=np.float32)
        io.write(tmp_path / name, array)
        same(io.read(tmp_path / name), array)


def test_caller_array_is_left_alone(tmp_path):
    """Writing scales a copy."""
    array = np.array([[np.nan, 0.5], [2.0, -1.0]], np.float32)
    before = array.tobytes()
    io.write(tmp_path / "a.png", array)
    assert array.tobytes() == before


@pytest.mark.parametrize("bits, dtype", [(8, np.uint8), (16, np.uint16)])
def test_png_scale(tmp_path, bits, dtype):
    """0 is 0, the maximum is full scale, NaN and what lies below are 0; the range is in the file."""
    path, full = tmp_path / "a.png", 2**bits - 1
    assert io.write(path, np.array([[0, 0.25, np.nan], [0.5, -3, 0.125]], np.float32), bits=bits) == (
        0.0,
        0.5,
    )
    same(io.read(path), np.array([[0, np.rint(full / 2), 0], [full, 0, np.rint(full / 4)]]).astype(dtype))
    assert io.read_range(path) == (0.0, 0.5)
    assert io.write(path, np.array([[1.0, 2.0, 9.0, 3.0]]), bits=bits, range=(1, 3)) == (1.0, 3.0)
    same(io.read(path), np.array([[0, np.rint(full / 2), full, full]]).astype(dtype))
    assert io.read_range(path) == (1.0, 3.0)


def test_png_of_darkness_and_infinity(tmp_path):
    """An all-black picture does not divide by zero, and infinity is not the maximum."""
    assert io.write(tmp_path / "a.png", np.zeros((3, 4))) == (0.0, 1.0)
    assert not io.read(tmp_path / "a.png").any()
    assert io.write(tmp_path / "a.png", np.array([[np.inf, 4.0, np.nan]])) == (0.0, 4.0)
    same(io.read(tmp_path / "a.png"), np.array([[255, 255, 0]], np.uint8))


def test_bool_is_black_and_white(tmp_path):
    """A mask is a picture in PNG and TIFF, and stays a mask in .npy."""
    mask = GREY8 > 100
    for name in ("a.png", "a.tif"):
        io.write(tmp_path / name, mask)
        same(io.read(tmp_path / name), mask * np.uint8(255))
    io.write(tmp_path / "a.npy", mask)
    same(io.read(tmp_path / "a.npy"), mask)


def test_range_only_where_skylamp_wrote_it(tmp_path):
    """Counts have no range, foreign files have none, and a false one is an error."""
    io.write(tmp_path / "a.png", GREY8)
    io.write(tmp_path / "a.npy", FLOATS)
    assert io.read_range(tmp_path / "a.png") is None and io.read_range(tmp_path / "a.npy") is None
    for text in ("1 nan", "2 1", "1", "a b"):
        header = PngInfo()
        header.add_text("skylamp:range", text)
        Image.fromarray(GREY8).save(tmp_path / "b.png", pnginfo=header)
        refused(io.read_range, tmp_path / "b.png", says="b.png")


@pytest.mark.parametrize(
    "options, says",
    [
        (dict(bits=12), ("bits of a PNG: got 12", "8 or 16")),
        (dict(range=(1, 1)), "low < high"),
        (dict(range=(0, np.nan)), "low < high"),
        (dict(range=(-1e308, 1e308)), "low < high"),
        (dict(range=5), ("range: got 5", "low < high")),
        (dict(range=(0, 1, 2)), "low < high"),
        (dict(range="01"), ("range: got '01'", "low < high")),
        (dict(range=(None, 1)), "low < high"),
        (dict(bits=16.0), ("bits of a PNG: got 16.0", "8 or 16")),
        (dict(bits="8"), ("bits of a PNG: got '8'", "8 or 16")),
    ],
)
def test_bad_scale(tmp_path, options, says):
    """A scale that means nothing is refused and writes nothing."""
    refused(io.write, tmp_path / "a.png", np.ones((2, 2)), says=says, **options)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "name, array, options, says",
    [
        ("a.npy", FLOATS, dict(range=(0, 1)), "other formats than PNG"),
        ("a.tif", FLOATS, dict(bits=16), "other formats than PNG"),
        ("a.npz", FLOATS, dict(bits=8), "other formats than PNG"),
        ("a.exr", FLOATS, dict(range=(0, 1)), "other formats than PNG"),
        ("a.png", GREY8, dict(range=(0, 1)), ("counts are kept", "no range, and 8 bits")),
        ("a.png", GREY16, dict(bits=8), ("counts are kept", "no range, and 16 bits")),
        ("a.png", GREY8 > 9, dict(bits=16), "counts are kept"),
        ("a.png", GREY8, dict(bits=12), "bits of a PNG: got 12"),
    ],
)
def test_an_option_that_would_do_nothing_is_refused(tmp_path, name, array, options, says):
    """They were ignored without a word; the bits that counts have may be said."""
    if name.endswith(".exr"):
        pytest.importorskip("OpenEXR")
    refused(io.write, tmp_path / name, array, says=says, **options)
    assert not list(tmp_path.iterdir())
    io.write(tmp_path / "b.png", GREY16, bits=16)
    same(io.read(tmp_path / "b.png"), GREY16)


@pytest.mark.parametrize(
    "options, says",
    [
        (dict(name="allow_pickle"), "name of an array: got 'allow_pickle'"),
        (dict(name="file"), "name of an array: got 'file'"),
        (dict(allow_pickle=GREY8), "name of an array: got 'allow_pickle'"),
        (dict(name=None), "name of an array: got None"),
        (dict(name=""), "name of an array: got ''"),
        (dict(image=GREY8), "two arrays of one name: got 'image'"),
        (dict(other=np.array([{}, None])), "array other: got dtype object"),
        (dict(other="text"), "array other: got dtype <U4"),
        (dict(other=np.ma.masked_less(FLOATS, 0)), "array other: a numpy masked array"),
        (dict(other=np.zeros(0)), "array other: got dtype float64, shape (0,)"),
        (dict(other=[[1, 2], [3]]), "array other: got ValueError"),
    ],
)
def test_npz_refuses_what_it_would_not_give_back(tmp_path, options, says):
    """NumPy pickled objects, dropped masks and took two names as its own parameters."""
    refused(io.write, tmp_path / "a.npz", FLOATS, says=says, **options)
    assert not list(tmp_path.iterdir())


def test_npz_names(tmp_path):
    """The named array, or the only one; never a guess, and height is not taken for depth."""
    path = tmp_path / "a.npz"
    np.savez(path, depth=FLOATS, drilled=GREY8 > 9)
    same(io.read(path), FLOATS)
    same(io.read(path, "depth"), FLOATS)
    refused(io.read, path, "height", says=("a.npz", "which array is the height", "depth, drilled"))
    np.savez(path, GREY8)
    same(io.read(path, "depth"), GREY8)
    np.savez(path, height=GREY8)
    same(io.read(path), GREY8)
    refused(io.read, path, "depth", says=("got arrays height", "named depth"))
    np.savez(path, depth=GREY8, height=GREY8)
    refused(io.read, path, says="arrays depth, height")
    np.savez(path, one=GREY8, two=GREY8)
    refused(io.read, path, says="arrays one, two")
    np.savez(path)
    refused(io.read, path, says="a.npz")
    io.write(path, FLOATS, name="depth", drilled=FLOATS > 0)
    with np.load(path) as arrays:
        assert sorted(arrays.files) == ["depth", "drilled"]


def test_sixteen_bit_rgb_png_is_refused(tmp_path):
    """The trap: imageio hands back 8 bits without a word."""
    png16_rgb(tmp_path / "a.png")
    assert imageio.imread(tmp_path / "a.png").dtype == np.uint8, "the reader has learnt: relax the refusal"
    refused(
        io.read,
        tmp_path / "a.png",
        says=("16-bit RGB PNG", "grey PNG of 8 or 16 bits", "Convert it to one grey channel"),
    )
    refused(io.read_environment, tmp_path / "a.png", says=("16-bit RGB PNG", "RGB of 8 bits"))


def test_reader_that_changes_depth_is_caught(tmp_path, monkeypatch):
    """Should imageio ever halve a grey 16-bit file, the check after reading sees it."""
    io.write(tmp_path / "a.png", GREY16)
    monkeypatch.setattr(imageio, "imread", lambda *a, **k: GREY8)
    refused(io.read, tmp_path / "a.png", says=("the reader changed the data", "uint8", "16-bit grey PNG"))


@pytest.mark.parametrize(
    "mode, says",
    [
        ("RGB", "8-bit RGB PNG"),
        ("RGBA", "8-bit RGB with alpha"),
        ("LA", "8-bit grey with alpha"),
        ("P", "palette PNG"),
        ("1", "got 1-bit grey PNG"),
    ],
)
def test_png_that_is_not_plain_grey(tmp_path, mode, says):
    """Colour, alpha, palettes and packed bits are never converted silently."""
    Image.fromarray(GREY8).convert(mode).save(tmp_path / "a.png")
    refused(io.read, tmp_path / "a.png", says=("a.png", says))


def test_four_bit_png(tmp_path):
    """Pillow scales 4-bit grey up to 8 bits: other values than the file's."""
    chunk = lambda kind, body: (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    )
    (tmp_path / "a.png").write_bytes(
        b"\x89PNG\r\n\x1a\n"
        + chunk(b"IHDR", struct.pack(">IIBBBBB", 2, 1, 4, 0, 0, 0, 0))
        + chunk(b"IDAT", zlib.compress(b"\0\x5a"))
        + chunk(b"IEND", b"")
    )
    refused(io.read, tmp_path / "a.png", says="got 4-bit grey PNG")


def test_tiff_that_is_not_plain_grey(tmp_path):
    """RGB, palette, inverted grey, unequal pages and packed bits."""
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, np.zeros((4, 5, 3), np.uint8), photometric="rgb")
    refused(io.read, path, says=("a.tif", "not grey", "3 samples", "RGB"))
    tifffile.imwrite(path, GREY8, photometric="palette", colormap=np.zeros((3, 256), np.uint16))
    refused(io.read, path, says="PALETTE")
    tifffile.imwrite(path, GREY8, photometric="miniswhite")
    refused(io.read, path, says="MINISWHITE")
    tifffile.imwrite(path, GREY8 > 9, photometric="minisblack")
    refused(io.read, path, says="1 bits per sample")
    with tifffile.TiffWriter(path) as file:
        file.write(GREY8)
        file.write(GREY8[:4])
    refused(io.read, path, says=("2 pages", "equal pages"))


def test_pickles_and_other_types(tmp_path):
    """A pickle is code; complex, text and structures are not heights."""
    np.save(tmp_path / "a.npy", np.array([{}], object), allow_pickle=True)
    refused(io.read, tmp_path / "a.npy", says=("a.npy", "pickles, which are never read"))
    np.savez(tmp_path / "a.npz", np.array([{}], object))
    refused(io.read, tmp_path / "a.npz", says="pickles, which are never read")
    for array in (np.ones((2, 2), complex), np.array([["a"]]), np.zeros((2, 2), "f4,f4")):
        np.save(tmp_path / "a.npy", array)
        refused(io.read, tmp_path / "a.npy", says=("wrong type", "real numbers"))
        refused(io.write, tmp_path / "b.npy", array, says="cannot write the array")
    np.save(tmp_path / "a.npy", np.zeros((0, 5)))
    refused(io.read, tmp_path / "a.npy", says=("empty array", "(0, 5)"))


class Opened:
    """A pickle of it leaves a trace where it is read."""

    def __reduce__(self):
        return open, ("read", "w")


@pytest.mark.parametrize("name", ["a.npy", "a.npz", "a.png", "a.tif", "a.exr", "a.hdr"])
def test_no_pickle_is_read(tmp_path, monkeypatch, name):
    """Whatever the extension says, and inside an array as well."""
    monkeypatch.chdir(tmp_path)
    plain = pickle.dumps(Opened())
    (np.savez if name.endswith("z") else np.save)(tmp_path / "b", np.array([Opened()], object))
    for data in (plain, next(tmp_path.glob("b.np?")).read_bytes()):
        (tmp_path / name).write_bytes(data)
        for read in (io.read, io.read_environment):
            refused(read, tmp_path / name, says="cannot read")
    assert not (tmp_path / "read").exists()


def promising(tmp_path):
    """Small files whose headers promise 4 TiB and more: path of each."""
    large = np.broadcast_to(np.float32(0), (2**20, 2**20))
    header = np.lib.format.header_data_from_array_1_0(large)
    with open(tmp_path / "a.npy", "wb") as file:
        np.lib.format.write_array_header_1_0(file, header)
        file.write(bytes(1000))
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        archive.write(tmp_path / "a.npy", "depth.npy")
    chunk = lambda kind, body: (
        struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))
    )
    start = chunk(b"IHDR", struct.pack(">IIBBBBB", 2**20, 2**21, 16, 0, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(bytes(10**6))) + chunk(b"IEND", b"")
    (tmp_path / "a.png").write_bytes(b"\x89PNG\r\n\x1a\n" + start + body)
    tifffile.imwrite(tmp_path / "a.tif", GREY16)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as file:
        for tag in ("ImageWidth", "ImageLength"):
            file.pages[0].tags[tag].overwrite(2**20)
    (tmp_path / "a.hdr").write_bytes(
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 1048576 +X 1048576\n" + bytes(99)
    )
    return sorted(path for path in tmp_path.iterdir())


def test_headers_that_promise_terabytes(tmp_path):
    """They are refused by what they say, before memory is taken."""
    for path in promising(tmp_path):
        tracemalloc.start()
        refused(io.read_environment if path.suffix == ".hdr" else io.read, path, says=path.name)
        assert tracemalloc.get_traced_memory()[1] < 2**24, path
        tracemalloc.stop()


def test_a_file_that_does_not_fit_into_memory(tmp_path, monkeypatch):
    """Is a CapacityError that names the bytes, not an abort."""
    monkeypatch.setattr("skylamp.io.paths.available_memory", lambda: 100)
    for name in ("a.npy", "a.npz", "a.png", "a.tif"):
        io.write(tmp_path / name, GREY16)
        with pytest.raises(sl.CapacityError, match="100 are free"):
            io.read(tmp_path / name)


def test_paths_that_cannot_be_read(tmp_path):
    """Missing, folder, empty, unknown extension, too long a name."""
    refused(io.read, tmp_path / "no.npy", says=("File not found", "no.npy"))
    (tmp_path / "dir.npy").mkdir()
    refused(io.read, tmp_path / "dir.npy", says="a folder")
    for suffix in MAP_SUFFIXES:
        (tmp_path / f"empty{suffix}").write_bytes(b"")
        refused(io.read, tmp_path / f"empty{suffix}", says="an empty file")
    (tmp_path / "a.jpg").write_bytes(b"x")
    refused(io.read, tmp_path / "a.jpg", says=("'.jpg'", ".npy .npz .png .tif .tiff"))
    refused(io.read, tmp_path / ("x" * 300 + ".npy"), says="cannot read")


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
def test_wrong_content(tmp_path, suffix):
    """Noise, text, and another format's bytes under the name."""
    path = tmp_path / f"a{suffix}"
    others = {}
    for other in MAP_SUFFIXES:
        io.write(tmp_path / f"other{other}", GREY8)
        others[other] = (tmp_path / f"other{other}").read_bytes()
    kin = {".tif", ".tiff"} if suffix.startswith(".tif") else {suffix}
    for data in (
        b"x",
        b"hello, world\n" * 50,
        RNG.bytes(5000),
        *(d for s, d in others.items() if s not in kin),
    ):
        path.write_bytes(data)
        refused(io.read, path, says=(path.name, "cannot read"))


FORMATS = {
    "npy": ("a.npy", lambda p: np.save(p, GREY16)),
    "npz": ("a.npz", lambda p: np.savez(p, GREY16)),
    "npz-deflate": ("a.npz", lambda p: np.savez_compressed(p, GREY16)),
    "png8": ("a.png", lambda p: io.write(p, GREY8)),
    "png16": ("a.png", lambda p: io.write(p, GREY16)),
    "tif": ("a.tif", lambda p: io.write(p, FLOATS)),
    "tif-strips": ("a.tif", lambda p: tifffile.imwrite(p, GREY16, rowsperstrip=2)),
    "tif-deflate": ("a.tif", lambda p: tifffile.imwrite(p, FLOATS, rowsperstrip=3, compression="zlib")),
    "tif-pages": (
        "a.tif",
        lambda p: tifffile.imwrite(p, np.stack([GREY16] * 3), photometric="minisblack", metadata=None),
    ),
}


@pytest.mark.parametrize("kind", FORMATS)
def test_truncated_files(tmp_path, kind):
    """Cut anywhere, a file is refused; it is never read as if the rest were zeros."""
    name, make = FORMATS[kind]
    path = tmp_path / name
    make(path)
    whole, data = io.read(path), path.read_bytes()
    for length in sorted(
        {
            1,
            4,
            7,
            8,
            9,
            33,
            100,
            *np.linspace(10, len(data) - 1, 40).astype(int),
            len(data) - 12,
            len(data) - 2,
            len(data) - 1,
        }
    ):
        path.write_bytes(data[:length])
        try:
            got = io.read(path)
        except InputError as error:
            assert name in str(error) and "\n" not in str(error)
        else:  # a TIFF may end in bytes that say nothing about the picture
            assert kind.startswith("tif") and got.tobytes() == whole.tobytes() and got.shape == whole.shape, (
                length
            )
    path.write_bytes(data)
    same(io.read(path), whole)


@pytest.mark.parametrize("kind", FORMATS)
def test_damaged_files_never_crash(tmp_path, kind):
    """Flipped bytes give an array or an InputError, nothing else; a PNG's checksums catch every one."""
    name, make = FORMATS[kind]
    path = tmp_path / name
    make(path)
    data = path.read_bytes()
    for _ in range(60):
        position = int(RNG.integers(len(data)))
        path.write_bytes(
            data[:position] + bytes([data[position] ^ int(RNG.integers(1, 256))]) + data[position + 1 :]
        )
        try:
            io.read(path)
        except InputError as error:
            assert name in str(error)
        else:
            assert not kind.startswith("png")


@pytest.mark.parametrize("suffix", MAP_SUFFIXES)
@pytest.mark.parametrize("older", [False, True], ids=["new", "replacing"])
def test_failing_write_leaves_no_trace(tmp_path, monkeypatch, suffix, older):
    """Disk full at the last moment: the older file is as it was, and no temporary file stays."""
    path = tmp_path / f"a{suffix}"
    if older:
        path.write_bytes(b"older")

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        io.write(path, GREY8)
    assert {p.name: p.read_bytes() for p in tmp_path.iterdir()} == ({path.name: b"older"} if older else {})


def test_interrupted_write_leaves_no_trace(tmp_path):
    """Also when the writer itself is stopped half way."""
    with pytest.raises(KeyboardInterrupt):
        with io.replacing(tmp_path / "a.npy") as file:
            file.write(b"half")
            raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_link_is_written_through(tmp_path):
    """A symbolic link stays one, and its file is replaced."""
    (tmp_path / "real").mkdir()
    (tmp_path / "real" / "b.npy").write_bytes(b"older")
    (tmp_path / "a.npy").symlink_to(tmp_path / "real" / "b.npy")
    io.write(tmp_path / "a.npy", GREY8)
    assert (tmp_path / "a.npy").is_symlink()
    same(io.read(tmp_path / "real" / "b.npy"), GREY8)


def test_places_that_cannot_be_written(tmp_path):
    """No parent, unknown extension, a folder or a device of that name, what a format does not hold."""
    refused(
        io.write,
        tmp_path / "no" / "a.npy",
        GREY8,
        says=("no folder", str(tmp_path / "no"), "existing folder"),
    )
    assert not list(tmp_path.iterdir())
    for name in ("a.jpg", "a"):
        refused(io.write, tmp_path / name, GREY8, says=("unknown extension", ".npy .npz .png .tif .tiff"))
    (tmp_path / "d.npy").mkdir()
    refused(io.write, tmp_path / "d.npy", GREY8, says="a folder or a device")
    refused(io.write, tmp_path / "a.png", np.zeros((2, 3, 4)), says=("one picture", "(2, 3, 4)", ".npy"))
    refused(io.write, tmp_path / "a.npy", GREY8, says="several arrays in an .npz", other=GREY8)
    refused(io.write, tmp_path / "a.npy", np.zeros((0, 3)), says="at least one")
    with pytest.raises(InputError, match="a device"), io.replacing("/dev/null"):
        pytest.fail("a device was opened for writing")


def test_output_folder(tmp_path):
    """Made with its parents, left alone when it is there, refused where a file stands."""
    assert io.folder(tmp_path / "a" / "b").is_dir() and io.folder(tmp_path / "a" / "b").is_dir()
    (tmp_path / "file").write_bytes(b"")
    for name in ("file", "file/below"):
        refused(io.folder, tmp_path / name, says="not a folder")


def test_environment_maps(tmp_path):
    """Grey or RGB; luminance of the three; counts become 0 to 1."""
    rgb = RNG.integers(0, 256, (4, 8, 3), dtype=np.uint8)
    Image.fromarray(rgb).save(tmp_path / "a.png")
    np.testing.assert_allclose(
        io.read_environment(tmp_path / "a.png"), (rgb / 255) @ [0.2126, 0.7152, 0.0722], rtol=1e-14
    )
    np.save(tmp_path / "a.npy", rgb / np.float32(16))
    np.testing.assert_allclose(
        io.read_environment(tmp_path / "a.npy"), (rgb / 16) @ [0.2126, 0.7152, 0.0722], rtol=1e-6
    )
    io.write(tmp_path / "g.png", GREY16)
    np.testing.assert_array_equal(io.read_environment(tmp_path / "g.png"), GREY16 / 65535)
    values = 1 + 3 * GREY8 / 255
    values[0, :2] = 1, 4
    io.write(tmp_path / "r.png", values, bits=16, range=(1.0, 4.0))
    np.testing.assert_allclose(io.read_environment(tmp_path / "r.png"), values, atol=1.6 / 65535)
    np.testing.assert_array_equal(
        io.read_environment(tmp_path / "r.png"), io.read(tmp_path / "r.png", scaled=True)
    )
    io.write(tmp_path / "c.png", 2.0 * rgb, range=(0, 1020))
    np.testing.assert_allclose(io.read_environment(tmp_path / "c.png"), 2.0 * rgb @ LUMINANCE, atol=2.01)
    np.save(tmp_path / "a.npy", np.zeros((4, 8, 2)))
    refused(io.read_environment, tmp_path / "a.npy", says="(rows, cols, 3)")


def test_terrain():
    """The array of matplotlib's sample data, value for value, and the spacing that its latitude gives."""
    height, spacing = io.terrain()
    assert height.shape == (344, 403) and height.dtype == np.float32 and (height == np.rint(height)).all()
    assert (height.min(), height.max(), height[0, 0], int(height.sum(dtype=np.float64))) == (
        236,
        1076,
        483,
        73617913,
    )
    degree = (
        np.pi / 180 * 6371008.8
    )  # metres, mean Earth radius; the ellipsoid differs by less than half a percent
    assert spacing == pytest.approx(3 / 3600 * degree * np.cos(np.radians(36.5896)) ** 0.5, rel=5e-3)


def test_terrain_is_matplotlibs():
    """Compared with the original where matplotlib is there and brings it."""
    cbook = pytest.importorskip("matplotlib.cbook")
    np.testing.assert_array_equal(
        io.terrain()[0], cbook.get_sample_data("jacksboro_fault_dem.npz")["elevation"]
    )


def test_counts_of_a_png_become_the_values_that_they_stand_for(tmp_path):
    """``skylamp render`` took counts up to 65535 for depths."""
    depth = np.linspace(7, 13, 64).reshape(8, 8)
    io.write(tmp_path / "d.png", depth, bits=16)
    assert io.read(tmp_path / "d.png").dtype == np.uint16
    np.testing.assert_allclose(io.read(tmp_path / "d.png", scaled=True), depth, atol=13 / 65535)
    io.write(tmp_path / "counts.png", np.arange(64, dtype=np.uint8).reshape(8, 8))
    assert io.read(tmp_path / "counts.png", scaled=True).dtype == np.uint8
    scene, _ = parsing.scene(tmp_path / "d.png", None, None, None, None, "dark")
    np.testing.assert_allclose(scene.depth, depth, atol=13 / 65535)


@pytest.mark.parametrize("name, dtype", [("x.png", ">u2"), ("x.exr", ">f4"), ("x.tif", ">f8")])
def test_the_order_of_bytes_does_not_matter(tmp_path, name, dtype):
    values = np.arange(0, 62000, 1000).reshape(2, 31).astype(dtype)
    assert io.write(tmp_path / name, values) is None
    assert io.read(tmp_path / name).dtype == np.dtype(dtype).newbyteorder("=")
    np.testing.assert_array_equal(io.read(tmp_path / name), values)


@pytest.mark.parametrize(
    "array",
    [
        np.arange(5.0),
        np.float64(1),
        np.ones((2, 3, 4, 5)),
        np.ones((2, 2), np.longdouble),
        np.ma.masked_less(np.eye(3), 0.5),
    ],
)
def test_a_tiff_refuses_what_it_would_not_give_back(tmp_path, array):
    with pytest.raises(InputError, match="x.tif"):
        io.write(tmp_path / "x.tif", array)
    assert not any(tmp_path.iterdir())
