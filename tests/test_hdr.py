"""OpenEXR and Radiance HDR: exact round trips, colours, exposure, damaged files, tone mapping."""

import subprocess
import sys

import numpy as np
import pytest

import skylamp as sl
from skylamp import io
from skylamp.app import cli
from skylamp.errors import InputError
from skylamp.io import hdr
from skylamp.io.files import LUMINANCE
from skylamp.io.paths import HDR

OpenEXR = pytest.importorskip("OpenEXR")
cv2 = pytest.importorskip("cv2")
RNG = np.random.default_rng(11)
FLOATS = RNG.normal(size=(13, 17)).astype(np.float32)
FLOATS[2, 3], FLOATS[4, 5] = np.nan, -np.inf
LIGHT = RNG.random((12, 24, 3), dtype=np.float32) * 10 ** RNG.uniform(-3, 3, (12, 24, 1)).astype(np.float32)


def refused(says, function, *arguments, **options):
    with pytest.raises(InputError) as caught:
        function(*arguments, **options)
    assert says in str(caught.value) and "\n" not in str(caught.value), caught.value


@pytest.mark.parametrize(
    "array",
    [
        FLOATS,
        FLOATS.astype(np.float16),
        (1000 * LIGHT[..., 0]).astype(np.uint32),
        FLOATS[::2, ::-3],
        np.asfortranarray(FLOATS),
    ],
    ids=["float32", "float16", "uint32", "strided", "fortran"],
)
def test_exr_comes_back_to_the_bit(tmp_path, array):
    """Every type that it holds, NaN and infinity too; other types are refused, not converted."""
    io.write(tmp_path / "a.exr", array)
    got = io.read(tmp_path / "a.exr")
    assert got.dtype == array.dtype and got.shape == array.shape and got.tobytes() == array.tobytes()
    assert [p.name for p in tmp_path.iterdir()] == ["a.exr"]


def test_exr_of_other_types(tmp_path):
    """float64 would lose bits."""
    for array in (
        FLOATS.astype(np.float64),
        np.ones((3, 3), np.uint8),
        np.ones((3, 3, 2), np.float32),
        np.ones(3, np.float32),
    ):
        refused("float16, float32 or uint32", io.write, tmp_path / "a.exr", array)
    assert not list(tmp_path.iterdir())


def test_exr_is_read_by_others(tmp_path):
    """OpenEXR reads our channels, and we read its files with alpha and with one named channel."""
    io.write(tmp_path / "a.exr", LIGHT)
    channels = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True).channels()
    for n, name in enumerate("RGB"):
        assert channels[name].pixels.tobytes() == np.ascontiguousarray(LIGHT[..., n]).tobytes()
    np.testing.assert_allclose(
        io.read_environment(tmp_path / "a.exr"), LIGHT.astype(float) @ [0.2126, 0.7152, 0.0722], rtol=1e-6
    )
    refused("a.exr: not grey", io.read, tmp_path / "a.exr")
    header = lambda: {
        "compression": OpenEXR.PIZ_COMPRESSION,
        "type": OpenEXR.scanlineimage,
    }  # File adds to it
    OpenEXR.File(header(), {"RGBA": np.concatenate([LIGHT, LIGHT[..., :1]], -1)}).write(
        str(tmp_path / "b.exr")
    )
    np.testing.assert_array_equal(
        io.read_environment(tmp_path / "b.exr"), io.read_environment(tmp_path / "a.exr")
    )
    OpenEXR.File(header(), {"Z": FLOATS}).write(str(tmp_path / "c.exr"))
    assert io.read(tmp_path / "c.exr").tobytes() == FLOATS.tobytes()
    OpenEXR.File(header(), {"Z": FLOATS, "U": FLOATS}).write(str(tmp_path / "d.exr"))
    refused("d.exr: channels", io.read, tmp_path / "d.exr")


def test_radiance_round_trip(tmp_path):
    """To half a step of the shared exponent; EXPOSURE is divided out; what it cannot hold is refused."""
    io.write(tmp_path / "a.hdr", LIGHT)
    luminance = LIGHT.astype(float) @ [0.2126, 0.7152, 0.0722]
    got = io.read_environment(tmp_path / "a.hdr")
    assert (np.abs(got - luminance) <= LIGHT.max(-1) / 256).all()
    np.testing.assert_allclose(
        cv2.imread(str(tmp_path / "a.hdr"), cv2.IMREAD_UNCHANGED)[..., ::-1], LIGHT, atol=LIGHT.max() / 128
    )
    data = (tmp_path / "a.hdr").read_bytes()
    (tmp_path / "b.hdr").write_bytes(data.replace(b"\nFORMAT", b"\nEXPOSURE=2.0\nEXPOSURE= 4\nFORMAT", 1))
    np.testing.assert_allclose(io.read_environment(tmp_path / "b.hdr"), got / 8, rtol=1e-6)
    (tmp_path / "b.hdr").write_bytes(data.replace(b"\n-Y 12 +X 24\n", b"\n+Y 12 +X 24\n", 1))
    refused("order of its pixels: got +Y +X", io.read_environment, tmp_path / "b.hdr")
    for array in (FLOATS, -LIGHT, np.full((2, 2), np.nan), np.ones((3, 3), np.uint8)):
        refused("finite floats >= 0", io.write, tmp_path / "c.hdr", array)


def test_radiance_is_rounded(tmp_path):
    """OpenCV cuts mantissas off: -0.28 % of light. A carry into the exponent makes the step coarser."""
    light = np.random.default_rng(3).random((60, 60, 3)) * 10.0 ** np.arange(-30, 30)[:, None, None]
    light[0, :2] = [[255.6, 127.8, 3.1], [255.4, 127.4, 3.1]]
    io.write(tmp_path / "a.hdr", light)
    error = (hdr.read(tmp_path / "a.hdr") - light) / light.max(-1, keepdims=True)
    assert np.abs(error).max() <= 1 / 256 and abs(error.mean()) < 1e-4
    np.testing.assert_array_equal(hdr.read(tmp_path / "a.hdr")[0, :2], [[256, 128, 4], [255, 127, 3]])


def test_light_beyond_radiance_is_refused(tmp_path):
    """It came back as 0. The largest that fits comes back as it is, the least as 0."""
    for most in (2e38, 1e300, 255.5 * 2.0**119):
        refused("too bright for a Radiance picture", io.write, tmp_path / "a.hdr", np.full((2, 9), most))
    assert not list(tmp_path.iterdir())
    io.write(tmp_path / "a.hdr", np.array([[hdr.BRIGHTEST_RGBE, 0.0, 5e-324]]))
    np.testing.assert_array_equal(io.read(tmp_path / "a.hdr"), [[hdr.BRIGHTEST_RGBE, 0, 0]])


def test_exposure_and_colour_correction(tmp_path):
    """Both are cumulative, as Radiance's format says; those that are no numbers > 0 are refused."""
    io.write(tmp_path / "a.hdr", np.ones((4, 9)))
    data = (tmp_path / "a.hdr").read_bytes()

    def corrected(lines):
        (tmp_path / "a.hdr").write_bytes(data.replace(b"\nFORMAT", b"\n" + lines + b"\nFORMAT", 1))
        return io.read_environment(tmp_path / "a.hdr")

    got = corrected(b"COLORCORR= 2 4 8\nEXPOSURE=2\nCOLORCORR=2 1 1")
    np.testing.assert_allclose(got, np.dot([1 / 8, 1 / 8, 1 / 16], LUMINANCE))
    for line in (
        b"EXPOSURE=0",
        b"EXPOSURE=-1",
        b"EXPOSURE=nan",
        b"EXPOSURE=",
        b"COLORCORR=2",
        b"COLORCORR=1 0 1",
    ):
        refused(f"ValueError: {line[:8].decode()}", corrected, line)
    refused("beyond float32", corrected, b"EXPOSURE=1e-30\nEXPOSURE=1e-30")


def test_a_grey_radiance_file_is_read_as_grey(tmp_path):
    """As it was written; a coloured one is not."""
    grey = np.linspace(0.1, 1, 12, dtype=np.float32).reshape(3, 4)
    io.write(tmp_path / "a.hdr", grey)
    np.testing.assert_allclose(io.read(tmp_path / "a.hdr"), grey, rtol=2**-7)
    io.write(tmp_path / "b.hdr", grey[..., None] * np.array([1, 0.5, 1], np.float32))
    with pytest.raises(InputError, match="not grey"):
        io.read(tmp_path / "b.hdr")


def test_environment_lights_a_scene(tmp_path, fast):
    """The command line takes both as a sky, and they light alike to the bits that .hdr has."""
    light = np.ones((16, 32, 3), np.float32)
    light[:, 4] = 5
    np.save(tmp_path / "flat.npy", np.full((4, 5), 2.0))
    images = []
    for name in ("e.exr", "e.hdr"):
        io.write(tmp_path / name, light)
        with pytest.raises(SystemExit) as ended:
            cli.main(
                [
                    "render",
                    str(tmp_path / "flat.npy"),
                    "--source",
                    str(tmp_path / name),
                    "--out",
                    str(tmp_path / "a.exr"),
                    "--backend",
                    fast,
                ]
            )
        assert not ended.value.code
        images.append(io.read(tmp_path / "a.exr"))
    expected = sl.render(
        sl.Scene(np.full((4, 5), 2.0)),
        sl.Sky(sl.environment_map(light @ np.float64(LUMINANCE))),
        backend=fast,
    ).image
    np.testing.assert_allclose(images[0], expected, rtol=1e-6)
    np.testing.assert_allclose(images[1], images[0], rtol=1e-2)


@pytest.mark.parametrize("suffix", HDR)
def test_truncated_and_damaged(tmp_path, suffix):
    """Cut: one InputError; with bytes changed: one InputError, or a picture."""
    path = tmp_path / f"a{suffix}"
    io.write(path, LIGHT)
    data = path.read_bytes()
    for length in sorted({1, 8, 40, *np.linspace(10, len(data) - 1, 25).astype(int).tolist(), len(data) - 1}):
        path.write_bytes(data[:length])
        refused(f"a{suffix}: cannot read", io.read_environment, path)
    for _ in range(60):
        position = int(RNG.integers(len(data)))
        path.write_bytes(
            data[:position] + bytes([data[position] ^ int(RNG.integers(1, 256))]) + data[position + 1 :]
        )
        try:
            assert io.read_environment(path).ndim == 2
        except InputError as error:
            assert path.name in str(error)
    for wrong in (
        b"x",
        b"hello, world\n" * 50,
        RNG.bytes(3000),
        b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 2000000000 +X 2000000000\n",
    ):
        path.write_bytes(wrong)
        refused(f"a{suffix}: cannot read", io.read, path)


def test_hostile_size(tmp_path):
    """A header that claims a picture of 2^40 pixels is refused before memory is asked for."""
    io.write(tmp_path / "a.exr", FLOATS)
    data = (tmp_path / "a.exr").read_bytes()
    window = np.array([0, 0, 16, 12], np.int32).tobytes()
    assert data.count(window) == 2
    (tmp_path / "a.exr").write_bytes(
        data.replace(window, np.array([0, 0, 2**20 - 1, 2**20 - 1], np.int32).tobytes())
    )
    refused("a.exr", io.read, tmp_path / "a.exr")


@pytest.mark.parametrize("suffix, package", [(".exr", "OpenEXR"), (".hdr", "opencv-python-headless")])
def test_without_the_extra(tmp_path, monkeypatch, suffix, package):
    """Reading and writing name the pip command, and nothing is written."""
    path = tmp_path / f"a{suffix}"
    io.write(path, LIGHT)
    monkeypatch.setitem(sys.modules, "OpenEXR", None)
    monkeypatch.setitem(sys.modules, "cv2", None)
    for work in (
        lambda: io.read(path),
        lambda: io.read_environment(path),
        lambda: io.write(tmp_path / f"b{suffix}", LIGHT),
        lambda: io.writable(tmp_path / f"b{suffix}"),
    ):
        refused(f"needs {package}, which is not installed: pip install 'skylamp[hdr]'", work)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("suffix", HDR)
def test_failing_write_leaves_no_trace(tmp_path, monkeypatch, suffix):
    """A full disk at the last moment."""

    def full(descriptor):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.fsync", full)
    with pytest.raises(OSError, match="No space left"):
        io.write(tmp_path / f"a{suffix}", LIGHT)
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_command_line_stays_one_line(tmp_path):
    """What OpenEXR and OpenCV print about damage is kept off stdout and stderr."""
    np.save(tmp_path / "d.npy", np.ones((3, 3)))
    for suffix in HDR:
        io.write(tmp_path / f"a{suffix}", LIGHT)
        cut = tmp_path / f"cut{suffix}"
        cut.write_bytes((tmp_path / f"a{suffix}").read_bytes()[:-300])
        done = subprocess.run(
            [
                sys.executable,
                "-m",
                "skylamp.app.cli",
                "render",
                str(tmp_path / "d.npy"),
                "--source",
                str(cut),
                "--out",
                str(tmp_path / "o.npy"),
            ],
            capture_output=True,
            timeout=300,
        )
        assert (
            done.returncode == 3
            and done.stdout == b""
            and done.stderr.count(b"\n") == 1
            and cut.name.encode() in done.stderr
        ), done


def test_tone_mapping(tmp_path, capsys):
    """sRGB's curve: 0.5 is count 188, 0.001 is 3, NaN is black; a stop doubles; --exposure does it."""
    image = np.array([[0.0, 0.001, 0.5], [1.0, 7.0, np.nan]], np.float32)
    assert io.tone_mapped(image).tolist() == [[0, 3, 188], [255, 255, 0]]
    assert io.tone_mapped(image / 4, 2).tolist() == io.tone_mapped(image).tolist()
    for exposure in (np.nan, None, [1, 2], 2000.0, "1", 10**400):
        refused("exposure: got", io.tone_mapped, image, exposure)
    assert io.tone_mapped([[1e300, 0.0]], 1000).tolist() == [[255, 0]]
    assert io.tone_mapped(image > 1).tolist() == [[0, 0, 0], [0, 255, 0]]
    for wrong in (np.ones((2, 2), complex), "ab", np.ma.masked_less(image, 1), [[1, 2], [3]]):
        refused("tone_mapped: image", io.tone_mapped, wrong)
    np.save(tmp_path / "d.npy", np.ones((3, 4)))
    command = ["render", str(tmp_path / "d.npy"), "--backend", "numpy", "--exposure", "-1", "--out"]
    with pytest.raises(SystemExit) as ended:
        cli.main([*command, str(tmp_path / "a.png")])
    assert not ended.value.code
    assert (io.read(tmp_path / "a.png") == io.tone_mapped([[0.4]])).all()  # albedo 0.8 under a sky of 1
    for wrong in (["a.npy"], ["a.png", "--bits", "16"], ["a.png", "--white", "1"]):
        with pytest.raises(SystemExit) as ended:
            cli.main([*command, str(tmp_path / wrong[0]), *wrong[1:]])
        assert ended.value.code == 2


def test_linear_decodes_what_tone_mapped_encodes():
    """Every count of 8 bits comes back; 16 bits and tones alike; by the standard's own numbers."""
    counts = np.arange(256, dtype=np.uint8)
    light = io.linear(counts)
    assert (io.tone_mapped(light) == counts).all() and light[[0, 255]].tolist() == [0, 1]
    np.testing.assert_array_equal(io.linear(counts * np.uint16(257)), light)
    np.testing.assert_array_equal(io.linear(counts / 255), light)
    assert io.linear(np.uint8([[188]]))[0, 0] == pytest.approx(((188 / 255 + 0.055) / 1.055) ** 2.4)
    assert io.linear(np.uint8([5]))[0] == pytest.approx(5 / 255 / 12.92)
    for wrong in (np.arange(3), [1.5, 0.0], [-0.1], [np.nan], ["a"]):
        refused("linear: image", io.linear, wrong)


def test_an_environment_keeps_its_colours_if_asked(tmp_path):
    """(rows, cols, 3) as they are in the file; luminance unless asked."""
    colours = np.random.default_rng(0).random((4, 8, 3)).astype(np.float32)
    io.write(tmp_path / "a.exr", colours)
    kept, grey = (io.read_environment(tmp_path / "a.exr", colour=way) for way in (True, False))
    np.testing.assert_array_equal(kept, colours)
    np.testing.assert_allclose(grey, colours @ [0.2126, 0.7152, 0.0722], rtol=1e-6)
