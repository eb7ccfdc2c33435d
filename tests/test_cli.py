"""The command line: exit codes, one-line errors, data and messages apart, outputs whole or absent."""

import io as streams
import json
import os
import socket
import subprocess
import sys
import warnings

import numpy as np
import pytest
import typer

import skylamp as sl
from skylamp import io
from skylamp.app import cli, demo, examples

BOWL = (np.hypot(*np.mgrid[-6:7, -7:8]) // 2).max() - np.hypot(*np.mgrid[-6:7, -7:8]) // 2 + 1


@pytest.fixture
def here(tmp_path, monkeypatch):
    """A folder with a depth map, a height map and an image, and maps that are no depth as they are."""
    monkeypatch.chdir(tmp_path)
    np.save("below.npy", -BOWL.astype(np.float32))
    np.save("holes.npy", np.where(BOWL > BOWL.mean(), BOWL, np.nan).astype(np.float32))
    np.save("depth.npy", BOWL.astype(np.float32))
    np.save("height.npy", (BOWL.max() - BOWL).astype(np.float32))
    np.save("image.npy", sl.render(sl.Scene(BOWL), sl.Sky(), backend="numpy").image)
    return tmp_path


def run(capsys, *arguments):
    """(exit code, stdout, stderr) of one command line, run in this process."""
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    out, err = capsys.readouterr()
    return ended.value.code or 0, out, err


def fails(capsys, code, *arguments, says):
    """The command exits with ``code``, says so in one line on stderr, leaves stdout empty and no new file."""
    before = sorted(os.listdir("."))
    got, out, err = run(capsys, *arguments)
    assert got == code, err
    assert out == "" and "Traceback" not in err
    for part in (says,) if isinstance(says, str) else says:
        assert part in err, err
    if code != 2:
        assert err.startswith("skylamp: error: ") and err.count("\n") == 1, err
    assert sorted(os.listdir(".")) == before


def test_heights_in_counts_are_told(here, capsys):
    """Counts of a PNG have no unit: a warning, unless --spacing says how many are a pixel's width."""
    io.write("coin.png", (BOWL.max() - BOWL).astype(np.uint8))
    flags = "render", "coin.png", "--height", "--backend", "numpy"
    with pytest.warns(UserWarning, match=r"^Counts: .* coin.png, 0 to \d+, .*--spacing"):
        assert run(capsys, *flags, "--out", "a.npy")[0] == 0
    io.write("range.png", BOWL.max() - BOWL.astype(float))  # holds its range
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert run(capsys, *flags, "--spacing", "2", "--out", "b.npy")[0] == 0
        assert run(capsys, "render", "range.png", "--height", "--out", "c.npy")[0] == 0
    expected = sl.render(sl.Scene.from_height((BOWL.max() - BOWL) / 2), sl.Sky(), backend="numpy").image
    np.testing.assert_allclose(np.load("b.npy"), expected, rtol=1e-6)


def test_render_writes_what_the_library_renders(here, capsys):
    """Same array as sl.render; nothing on stdout."""
    code, out, err = run(
        capsys,
        "render",
        "depth.npy",
        "--out",
        "a.npy",
        "--spacing",
        "2",
        "--albedo",
        "0.5",
        "--sides",
        "dark",
        "--method",
        "lattice",
        "--hemicube",
        "5",
        "--filled",
        "--backend",
        "numpy",
        "--quantity",
        "irradiance",
        "--source",
        "overcast",
    )
    assert (code, out) == (0, ""), err
    expected = sl.render(
        sl.Scene(BOWL, 2.0, 0.5, sides="dark"),
        sl.Sky(sl.cie_overcast()),
        method="lattice",
        hemicube=5,
        filled=True,
        quantity="irradiance",
        backend="numpy",
    ).image
    np.testing.assert_array_equal(io.read("a.npy"), expected)
    assert "a.npy: 13 x 15 by numpy" in err


@pytest.mark.slow
def test_a_fixed_cost_and_a_tail(here, capsys):
    """--azimuths and --max-distance are those of sl.render, and --tail refines."""
    scene, sky = sl.Scene(BOWL, albedo=0.5), sl.Sky(sl.cie_overcast())
    common = ("--albedo", "0.5", "--source", "overcast", "--backend", "numpy")
    for options, keywords in (
        (("--azimuths", 10, "--max-distance", 3), dict(azimuths=10, max_distance=3)),
        (("--tail", "0.4%"), dict(tail=0.004)),
    ):
        code, _, err = run(capsys, "render", "depth.npy", "--out", "a.npy", *common, *options)
        assert code == 0, err
        np.testing.assert_array_equal(
            io.read("a.npy"), sl.render(scene, sky, backend="numpy", **keywords).image
        )
    fails(capsys, 3, "render", "depth.npy", "--out", "b.npy", "--azimuths", 9, "--tail", "1%", says="tail")


def test_stride_and_filled_differ(here, capsys):
    """--stride and --filled reach the library as they are."""
    np.save("walls.npy", np.where(np.arange(15) % 5 == 2, 0, 6.0)[None].repeat(13, 0))
    for flag, filled in (("--stride", False), ("--filled", True)):
        assert (
            run(
                capsys,
                "render",
                "walls.npy",
                "--out",
                "a.npy",
                flag,
                "--method",
                "lattice",
                "--backend",
                "numpy",
            )[0]
            == 0
        )
        np.testing.assert_array_equal(
            io.read("a.npy"),
            sl.render(
                sl.Scene(io.read("walls.npy")), sl.Sky(), method="lattice", filled=filled, backend="numpy"
            ).image,
        )


@pytest.mark.slow
def test_height_is_depth_upside_down(here, capsys):
    """--height gives the picture that the depth map gives."""
    assert run(capsys, "render", "depth.npy", "--out", "a.npy", "--backend", "numpy")[0] == 0
    assert run(capsys, "render", "height.npy", "--height", "--out", "b.npy", "--backend", "numpy")[0] == 0
    np.testing.assert_allclose(io.read("a.npy"), io.read("b.npy"), rtol=1e-6)
    np.savez("both.npz", depth=BOWL, height=BOWL.max() - BOWL)
    for option, out in ((), "c.npy"), (("--height",), "d.npy"):
        assert run(capsys, "render", "both.npz", *option, "--out", out, "--backend", "numpy")[0] == 0
        np.testing.assert_allclose(io.read(out), io.read("a.npy"), rtol=1e-6)


@pytest.mark.slow
def test_light_between_surfaces(here, capsys):
    """--interreflection off is direct light, on and auto are brighter in a bowl; another word is an error."""
    images = []
    for word in ("off", "on", "auto"):
        taken = "--interreflection", word, "--out", f"{word}.npy", "--backend", "numpy"
        assert run(capsys, "render", "depth.npy", *taken)[0] == 0
        images.append(io.read(f"{word}.npy"))
    assert (images[1] >= images[0]).all() and images[1].mean() > 1.01 * images[0].mean()
    assert images[2].mean() > 1.01 * images[0].mean()
    taken = "--interreflection", "maybe", "--out", "x.npy"
    assert run(capsys, "render", "depth.npy", *taken)[0] == 2


@pytest.mark.slow
def test_sources(here, capsys):
    """Lamp, window and environment map, and that --lamp alone means a lamp."""
    environment = np.random.default_rng(3).random((6, 12), dtype=np.float32)
    np.save("map.npy", environment)
    cases = {
        ("--lamp", "7,-3,-4.5,3"): sl.Lamp(center=(7, -3, -4.5), radius=3),
        ("--source", "lamp", "--lamp", "-7,6,-4.5,3"): sl.Lamp(center=(-7, 6, -4.5), radius=3),
        ("--window", "2,9,3,8"): sl.Window(x=(2, 9), y=(3, 8)),
        ("--source", "sky"): sl.Sky(),
        ("--source", "map.npy"): sl.Sky(sl.environment_map(environment)),
    }
    pictures = []
    for options, source in cases.items():
        code, _, err = run(
            capsys,
            "render",
            "depth.npy",
            "--out",
            "a.npy",
            "--method",
            "lattice",
            "--backend",
            "numpy",
            *options,
        )
        assert code == 0, err
        pictures.append(io.read("a.npy"))
        np.testing.assert_array_equal(
            pictures[-1], sl.render(sl.Scene(BOWL), source, method="lattice", backend="numpy").image
        )
    assert len({p.tobytes() for p in pictures}) == len(pictures)


@pytest.mark.slow
def test_json_is_one_object_on_stdout(here, capsys):
    """Machine-readable, alone on stdout, with the scale of a PNG."""
    code, out, err = run(capsys, "render", "depth.npy", "--out", "a.png", "--json", "--backend", "numpy")
    facts = json.loads(out)
    image = sl.render(sl.Scene(BOWL), sl.Sky(), backend="numpy").image
    assert (
        code == 0 and facts["out"] == "a.png" and facts["backend"] == "numpy" and facts["shape"] == [13, 15]
    )
    assert facts["range"] == [0.0, float(image.max())] and io.read("a.png").max() == 255
    assert (
        run(
            capsys,
            "render",
            "depth.npy",
            "--out",
            "a.png",
            "--bits",
            "16",
            "--white",
            "2",
            "--backend",
            "numpy",
        )[0]
        == 0
    )
    np.testing.assert_array_equal(
        io.read("a.png"), np.rint(image.astype(float) / 2.0 * 65535).astype(np.uint16)
    )


@pytest.mark.slow
def test_nodata(here, capsys):
    """NaN is an error until it is named as no data; so is any number."""
    holes = BOWL.astype(np.float32)
    holes[3, 4] = np.nan
    np.save("nan.npy", holes)
    fails(capsys, 3, "render", "nan.npy", "--out", "a.npy", says="NaN or infinite")
    np.save("number.npy", np.where(np.isnan(holes), -9999, holes))
    expected = sl.render(sl.Scene(BOWL, mask=~np.isnan(holes)), sl.Sky(), backend="numpy").image
    for name, value in (("nan.npy", "nan"), ("number.npy", "-9999")):
        assert run(capsys, "render", name, "--nodata", value, "--out", "a.npy", "--backend", "numpy")[0] == 0
        np.testing.assert_array_equal(io.read("a.npy"), expected)
    assert np.isnan(expected[3, 4])


def test_recover(here, capsys):
    """Depth and the mask of drilled columns, as sl.recover gives them; a PNG holds whole layers."""
    expected = sl.recover(
        io.read("image.npy"),
        sl.Sky(),
        albedo=0.8,
        spacing=2.0,
        layers=9,
        hemicube=5,
        method="paper",
        stop="sign",
        backend="numpy",
    )
    options = (
        "--method",
        "paper",
        "--spacing",
        2,
        "--layers",
        9,
        "--hemicube",
        5,
        "--stop",
        "sign",
        "--backend",
        "numpy",
    )
    code, out, err = run(capsys, "recover", "image.npy", "--out", "a.npz", "--json", *options)
    assert code == 0, err
    assert json.loads(out)["drilled"] == int(expected.drilled.sum())
    np.testing.assert_array_equal(io.read("a.npz", "depth"), expected.depth)
    with np.load("a.npz") as arrays:
        np.testing.assert_array_equal(arrays["drilled"], expected.drilled)
    assert run(capsys, "recover", "image.npy", "--out", "a.png", *options)[0] == 0
    np.testing.assert_array_equal(io.read("a.png") * 2.0, expected.depth)


@pytest.mark.slow
def test_recover_leaves_out_what_a_mask_says(here, fast, capsys):
    """--mask, 0 or nan: as mask= of the function; its gaps are black in the picture."""
    image = np.load("image.npy")
    known = np.ones(image.shape, bool)
    known[2:4, 3] = False
    np.save("mask.npy", known)
    np.save("holes.npy", np.where(known, image, np.nan))
    options = ("--sides", "dark", "--layers", 8, "--interreflection", "off", "--backend", fast)
    assert run(capsys, "recover", "holes.npy", "a.npy", "--mask", "mask.npy", *options)[0] == 0
    expected = sl.recover(
        image, sl.Sky(), 0.8, "dark", layers=8, interreflection=False, mask=known, backend=fast
    )
    np.testing.assert_array_equal(np.load("a.npy"), expected.depth)
    picture = io.read("a_picture.png")
    assert picture.min() == 0 and np.ptp(picture) > 0
    assert run(capsys, "recover", "holes.npy", "b.npy", *options)[0] == 3
    np.save("mask.npy", np.where(known, 1.0, np.nan))
    assert run(capsys, "recover", "image.npy", "b.npy", "--mask", "mask.npy", *options)[0] == 0
    np.testing.assert_array_equal(np.load("b.npy"), expected.depth)
    np.save("wide.npy", np.ones((3, 3)))
    code, _, err = run(capsys, "recover", "image.npy", "b.npy", "--mask", "wide.npy", *options)
    assert code == 3 and "wide.npy: wrong shape: got (3, 3)" in err


@pytest.mark.slow
def test_recover_writes_a_picture(here, fast, capsys):
    """A picture of image, relief, confidence and residual; an .npz holds what it was made of."""
    code, out, err = run(
        capsys,
        "recover",
        "image.npy",
        "--out",
        "a.npz",
        "--json",
        "--sides",
        "dark",
        "--layers",
        9,
        "--backend",
        fast,
        "--max-seconds",
        20,
        "--std",
        "std.npy",
    )
    assert code == 0, err
    facts = json.loads(out)
    image = io.read("image.npy")
    picture = io.read("a_picture.png")
    times = 256 // max(image.shape)
    assert facts["picture"] == "a_picture.png" and picture.shape == (
        image.shape[0] * times + 20,
        4 * (image.shape[1] * times + 10) + 10,
    )
    with np.load("a.npz") as arrays:
        assert {"depth", "confidence", "candidates", "ambiguous", "drilled", "std"} <= set(arrays)
        np.testing.assert_array_equal(io.read("std.npy"), arrays["std"])
        assert facts["std"] == "std.npy"
        confidence = np.rint(255 * arrays["confidence"])
    left = 10 + 2 * (image.shape[1] * times + 10)
    np.testing.assert_allclose(
        picture[10 : 10 + image.shape[0] * times : times, left : left + image.shape[1] * times : times],
        confidence,
        atol=1,
    )


def test_carving_has_no_standard_deviation(here, capsys):
    code, _, err = run(
        capsys, "recover", "image.npy", "--out", "a.npy", "--std", "std.npy", "--method", "paper"
    )
    assert code == 2 and "--std" in err and not os.path.exists("std.npy")


def test_counts_need_a_scale(here, capsys):
    """A PNG of ours brings its scale; a foreign one needs --white; floating values take none."""
    image = io.read("image.npy")
    io.write("ours.png", image, bits=16)
    io.write("foreign.png", io.read("ours.png"))
    options = ("--method", "paper", "--layers", 6, "--hemicube", 3, "--backend", "numpy")
    fails(
        capsys,
        3,
        "recover",
        "foreign.png",
        "--out",
        "a.npy",
        *options,
        says=("foreign.png: counts without a scale", "--white"),
    )
    fails(
        capsys,
        2,
        "recover",
        "image.npy",
        "--out",
        "a.npy",
        "--white",
        "1",
        *options,
        says="radiance as they are",
    )
    assert run(capsys, "recover", "ours.png", "--out", "a.npy", *options)[0] == 0
    assert (
        run(capsys, "recover", "foreign.png", "--white", float(image.max()), "--out", "b.npy", *options)[0]
        == 0
    )
    np.testing.assert_array_equal(io.read("a.npy"), io.read("b.npy"))
    expected = sl.recover(
        io.read("ours.png") * (np.float64(image.max()) / 65535),
        sl.Sky(),
        layers=6,
        hemicube=3,
        method="paper",
        backend="numpy",
    )
    np.testing.assert_array_equal(io.read("a.npy"), expected.depth)


def test_field(here, capsys):
    """Solid angles in every layer, or in one."""
    expected = sl.visibility_field(
        sl.Scene(BOWL), sl.Sky(), hemicube=3, layers=4, backend="numpy"
    ).solid_angle()
    options = ("--hemicube", 3, "--layers", 4, "--backend", "numpy")
    assert run(capsys, "field", "depth.npy", "--out", "a.npy", *options)[0] == 0
    np.testing.assert_array_equal(io.read("a.npy"), expected)
    assert run(capsys, "field", "depth.npy", "--out", "a.png", "--layer", 2, *options)[0] == 0
    np.testing.assert_array_equal(
        io.read("a.png"), np.rint(expected[2].astype(float) / (2 * np.pi) * 255).astype(np.uint8)
    )
    fails(capsys, 2, "field", "depth.npy", "--out", "b.png", *options, says="--layer")
    fails(capsys, 2, "field", "depth.npy", "--plot", "b.png", "--layer", 2, *options, says="--layer")
    fails(
        capsys,
        3,
        "field",
        "depth.npy",
        "--out",
        "b.npy",
        "--layer",
        4,
        *options,
        says=("--layer: got 4", "0 to 3"),
    )


def test_backends(capsys):
    """The library's list, as a table or as JSON."""
    code, out, _ = run(capsys, "backends", "--json")
    listed = json.loads(out)["backends"]
    assert code == 0 and [b["name"] for b in listed] == [b.name for b in sl.backends()]
    assert next(b for b in listed if b["name"] == "numpy")["available"] is True
    assert "numpy" in run(capsys, "backends")[1]


@pytest.mark.parametrize(
    "arguments, code, says",
    [
        (["render", "no.npy", "--out", "a.npy"], 3, "error: File not found: no.npy"),
        (["render", "depth.npy", "--out", "no/a.npy"], 3, ("no/a.npy", "no folder no")),
        (["render", "depth.npy", "--out", "a.jpg"], 3, ("unknown extension", ".npy .npz .png .tif .tiff")),
        (["render", "depth.npy", "--out", "a.npy", "--spacing", "0"], 3, "spacing"),
        (["render", "depth.npy", "--out", "a.npy", "--albedo", "1.5"], 3, "albedo"),
        (["render", "depth.npy", "--out", "a.npy", "--sides", "shut"], 2, ("'shut'", "periodic")),
        (["render", "depth.npy", "--out", "a.npy", "--method", "magic"], 2, "magic"),
        (["render", "depth.npy", "--out", "a.npy", "--quantity", "joy"], 2, "joy"),
        (["render", "depth.npy", "--out", "a.npy", "--hemicube", "8"], 3, ("hemicube", "8", "odd")),
        (
            ["render", "depth.npy", "--out", "a.npy", "--source", "moon"],
            3,
            ("--source: got 'moon'", "sky, overcast, clear, cie1 to cie15, lamp, window"),
        ),
        (["render", "depth.npy", "--out", "a.npy", "--lamp", "7,6,1000,3"], 3, "below the surface"),
        (["render", "depth.npy", "--out", "a.png", "--white", "-1"], 3, "low < high"),
        (["render", "depth.npy", "--out", "a.png", "--bits", "12"], 3, "8 or 16"),
        (["render", "depth.npy", "--out", "a.png", "--exposure", "2000"], 3, "number of stops"),
        (["render", "depth.npy", "--out", "a.npy", "--backend", "warp:cuda:99"], 4, "warp:cuda:99"),
        (["recover", "image.npy", "--out", "a.npy", "--backend", "opencl:9:9"], 4, "opencl:9:9"),
        (["recover", "image.npy", "--out", "a.npy", "--stop", "never"], 2, "never"),
        (["render", "depth.npy"], 2, "--out"),
        (["render", "depth.npy", "--out", "a.npy", "--spacing", "wide"], 2, "--spacing"),
        (["render", "depth.npy", "--out", "a.npy", "--lamp", "1,2,3"], 2, ("'1,2,3'", "X,Y,Z,R")),
        (["render", "depth.npy", "--out", "a.npy", "--window", "a,b,c,d"], 2, "X0,X1,Y0,Y1"),
        (["render", "depth.npy", "--out", "a.npy", "--source", "lamp"], 2, "without --lamp"),
        (
            ["render", "depth.npy", "--out", "a.npy", "--source", "sky", "--lamp", "1,2,3,4"],
            2,
            "goes with --source lamp",
        ),
        (["render", "depth.npy", "--out", "-", "--json"], 2, "stdout"),
        (["dance"], 2, "dance"),
        (["demo", "--out", "depth.npy"], 3, "not a folder"),
        (["render", "depth.npy", "a.npy", "--out", "b.npy"], 2, "both given: a.npy and b.npy"),
        (["horizon", "depth.npy"], 2, "no output is given"),
        (["horizon", "depth.npy", "a.npy", "--what", "sky"], 2, ("sky-view-factor", "negative-openness")),
        (["render", "depth.npy", "a.npy", "--method", "magic"], 2, ("lattice", "unoccluded")),
        (["render", "depth.npy", "a.npy", "--white", "5"], 2, ("--white", ".png")),
        (["render", "depth.npy", "a.npy", "--bits", "16"], 2, ("--bits", ".png")),
        (
            ["horizon", "depth.npy", "a.npy", "--what", "openness", "--definition", "horizontal"],
            2,
            ("--definition", "sky-view"),
        ),
        (["horizon", "depth.npy", "a.npy", "--source", "clear", "--sun", "10,20"], 2, "--plot"),
        (["horizon", "below.npy", "a.npy"], 3, "give --height"),
        (["horizon", "holes.npy", "a.npy"], 3, "--nodata nan"),
        (["recover", "holes.npy", "a.npy"], 3, "Give --mask FILE"),
    ],
)
def test_errors(here, capsys, arguments, code, says):
    """Each mistake has its exit code and its text, and leaves no file."""
    fails(capsys, code, *arguments, says=says)


@pytest.mark.parametrize("command", ["", *sorted(examples._OF)])
def test_help_shows_examples_that_parse(here, capsys, command):
    """-h is --help; every example of a command is one that it understands."""
    code, short, _ = run(capsys, *command.split(), "-h")
    assert (code, short) == run(capsys, *command.split(), "--help")[:2] and code == 0
    if not command:
        assert "--install-completion" in short
        return
    for line in examples._OF[command]:
        assert f"  {line}\n" in short
        name, given, *words = line.split()
        assert (name, given) == ("skylamp", command)
        parser = typer.main.get_command(cli.app).commands[command]
        context = parser.make_context(command, words)  # a mistake is a UsageError
        assert set(context.params) == {parameter.name for parameter in parser.params} - {"help"}


@pytest.mark.slow
def test_completion_is_offered():
    """The script of a shell is printed, and words are completed."""
    environment = {
        **os.environ,
        "_SKYLAMP_COMPLETE": "complete_bash",
        "COMP_WORDS": "skylamp render --meth",
        "COMP_CWORD": "2",
    }
    done = subprocess.run([sys.executable, "-m", "skylamp"], env=environment, capture_output=True, text=True)
    assert done.stdout.split() == ["--method"], done


@pytest.mark.slow
def test_output_comes_second_or_by_name(here, capsys):
    """INPUT OUTPUT as in gdal and rio; --quiet leaves warnings and errors alone."""
    for command, file in (("render", "depth.npy"), ("horizon", "depth.npy"), ("field", "depth.npy")):
        options = () if command == "horizon" else ("--source", "sky")
        code, out, err = run(capsys, command, file, "a.npy", "--backend", "numpy", *options)
        assert (code, out) == (0, "") and err.startswith("a.npy: "), err
        named = run(capsys, command, file, "--out", "b.npy", "--backend", "numpy", "-q", *options)
        assert named == (0, "", "")
        np.testing.assert_array_equal(io.read("a.npy"), io.read("b.npy"))
    fails(capsys, 3, "render", "none.npy", "c.npy", "--quiet", says="File not found: none.npy")


def test_output_is_checked_before_the_work(here, capsys, monkeypatch):
    """Nobody waits an hour to hear that the folder is missing."""
    for name in ("render", "recover", "visibility_field"):
        monkeypatch.setattr(sl, name, lambda *a, **k: pytest.fail("worked first"))
    for command, file in (("render", "depth.npy"), ("recover", "image.npy"), ("field", "depth.npy")):
        fails(capsys, 3, command, file, "--out", "no/a.npy", says="no folder")


def test_unexpected_errors_are_one_line_and_exit_1(here, capsys, monkeypatch):
    """A bug of ours is no traceback, unless asked for; too little memory and a full disk are exit 1 too."""

    def broken(error):
        def render(*a, **k):
            raise error

        monkeypatch.setattr(sl, "render", render)

    broken(ZeroDivisionError("two\nlines"))
    fails(
        capsys,
        1,
        "render",
        "depth.npy",
        "--out",
        "a.npy",
        says="ZeroDivisionError: two lines (--debug shows where)",
    )
    code, _, err = run(capsys, "--debug", "render", "depth.npy", "--out", "a.npy")
    assert code == 1 and "Traceback" in err
    for error in (sl.errors.CapacityError("needs 9 bytes"), OSError(28, "No space left on device")):
        broken(error)
        fails(capsys, 1, "render", "depth.npy", "--out", "a.npy", says=str(error))


def test_what_libraries_print_stays_off_stdout(here, capsys, monkeypatch):
    """Warp prints a banner: it must not end up in the JSON."""
    render = sl.render

    def chatty(*a, **k):
        print("Warp 9.9 initialized")
        return render(*a, **k)

    monkeypatch.setattr(sl, "render", chatty)
    code, out, err = run(capsys, "render", "depth.npy", "--out", "a.npy", "--json", "--backend", "numpy")
    assert code == 0 and json.loads(out) and "Warp 9.9" in err


@pytest.mark.slow
def test_as_a_process(here):
    """Version, data on stdout through a pipe, exit codes as the shell sees them, no bar off a terminal."""
    skylamp = lambda *arguments: subprocess.run(
        [sys.executable, "-m", "skylamp.app.cli", *arguments], capture_output=True, timeout=300
    )
    version = skylamp("--version")
    assert (version.returncode, version.stdout.decode().split()) == (0, ["skylamp", sl.__version__])
    piped = skylamp("render", "depth.npy", "--out", "-", "--backend", "numpy")
    assert piped.returncode == 0 and b"\x1b" not in piped.stderr and b"%" not in piped.stderr
    np.testing.assert_array_equal(
        np.load(streams.BytesIO(piped.stdout)), sl.render(sl.Scene(BOWL), sl.Sky(), backend="numpy").image
    )
    (here / "cut.tif").write_bytes(b"II*\0\x08\0\0\0")
    cut = skylamp("render", "cut.tif", "--out", "a.npy")
    assert (
        cut.returncode == 3
        and cut.stdout == b""
        and cut.stderr.count(b"\n") == 1
        and b"cut.tif" in cut.stderr
    )


@pytest.mark.slow
def test_closed_streams(here):
    """What needs a stream that is closed is refused in one line; the rest works."""
    shell = lambda line: subprocess.run(
        f"{sys.executable} -m skylamp {line}", shell=True, capture_output=True, text=True, timeout=300
    )
    lost = shell("render depth.npy --out - --backend numpy >&-")
    assert (lost.returncode, lost.stderr) == (1, "skylamp: error: --out -: stdout is closed\n")
    for streams_closed in (">&-", "2>&-", ">&- 2>&-"):
        done = shell(f"render depth.npy --out closed.npy --backend numpy {streams_closed}")
        assert done.returncode == 0 and np.load(here / "closed.npy").shape == BOWL.shape, done
        (here / "closed.npy").unlink()
    assert shell("backends >&-").returncode == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ("render", "depth.npy", "depth.npy"),
        ("render", "depth.npy", "a.npy", "--error", "depth.npy"),
        ("render", "depth.npy", "a.npy", "--error", "./a.npy"),
        ("render", "depth.npy", "--out", "depth.npy", "--memory", "1GB"),
        ("recover", "image.npy", "--out", "image.npy"),
        ("recover", "image.npy", "a.npy", "--std", "image.npy"),
        ("horizon", "height.npy", "there/../height.npy"),
        ("field", "depth.npy", "linked.npy"),
        ("render", "depth.npy", "image.npy", "--source", "image.npy"),
        ("render", "depth.npy", "a.npy", "--source", "image.npy", "--error", "image.npy"),
        ("field", "depth.npy", "image.npy", "--source", "image.npy"),
        ("recover", "image.npy", "height.npy", "--source", "height.npy"),
    ],
)
def test_an_output_never_replaces_the_input_or_another_output(here, capsys, arguments):
    """Also by another name of the same file."""
    (here / "there").mkdir()
    (here / "linked.npy").symlink_to("depth.npy")
    files = {path: path.read_bytes() for path in here.glob("*.npy")}
    fails(capsys, 2, *arguments, "--backend", "numpy", says="--out")
    assert {path: path.read_bytes() for path in here.glob("*.npy")} == files


@pytest.mark.parametrize(
    "arguments, says",
    [
        (("render", "depth.npy", "a.npy", "--method", "horizon", "--tolerance", "1%"), "--tolerance"),
        (("render", "depth.npy", "a.npy", "--azimuths", "16", "--tolerance", "0.01"), "--interreflection on"),
        (("recover", "image.npy", "a.npy", "--picture", "p.npy"), "allowed: a .png"),
    ],
)
def test_what_would_have_no_effect_is_refused(here, capsys, arguments, says):
    """A tolerance that no method keeps to, a picture that is none."""
    fails(capsys, 2, *arguments, "--backend", "numpy", says=says)


def test_a_tolerance_of_light_between_surfaces(here, capsys):
    """It is kept to with a method that is asked for too."""
    options = "--azimuths", "16", "--tolerance", "5%", "--interreflection", "on", "--backend", "numpy"
    assert run(capsys, "render", "depth.npy", "a.npy", *options)[0] == 0


def test_a_folder_without_permission(here, capsys, monkeypatch):
    """The error names the output, before any work and where a file cannot be made."""
    (here / "locked").mkdir()
    says = ["locked/a.npy: cannot write", "permission"]
    with monkeypatch.context() as patch:
        patch.setattr("os.access", lambda path, mode: "locked" not in str(path))
        fails(capsys, 3, "render", "depth.npy", "locked/a.npy", says=says)
    code, _, errors = run(capsys, "render", "depth.npy", "/proc/a.npy", "--backend", "numpy")
    assert code == 3 and "/proc/a.npy: cannot write" in errors and ".tmp" not in errors


def test_too_little_memory_is_told_before_any_worker_starts(here, capsys, monkeypatch):
    """One error with what a worker needs."""
    monkeypatch.setattr("skylamp.app.out_of_core.workers_of", lambda *_: pytest.fail("workers start"))
    for memory in ("1MB", "100MB"):
        fails(capsys, 1, "horizon", "depth.npy", "a.tif", "--memory", memory, says="one needs at least")
    fails(capsys, 2, "horizon", "depth.npy", "a.tif", "--memory", "2gb", says="8GiB")


def test_a_port_in_use(here, capsys):
    """One error, and no address that shows another program's page."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = str(other.getsockname()[1])
        fails(capsys, 3, "view", "depth.npy", "--no-browser", "--port", port, says=["--port", "free"])


def test_a_row_goes_with_a_plot(here, capsys):
    """Without one it was ignored."""
    fails(capsys, 2, "field", "depth.npy", "f.npy", "--row", "3", says="--plot")


def test_tiles_of_a_file_that_is_no_geotiff(here, capsys):
    """The error names what is needed, not the extension that the file has."""
    code, _, errors = run(capsys, "horizon", "depth.npy", "--out", "a.tif", "--memory", "1GB")
    assert code == 3 and "allowed: a whole GeoTIFF file" in errors


def test_doctor_in_one_line(here, capsys):
    """--json as of the other commands: one object in one line."""
    code, report, _ = run(capsys, "doctor", "--json")
    assert code == 0 and report.count("\n") == 1 and json.loads(report)["backends"]


@pytest.mark.slow
@pytest.mark.parametrize("module", ["skylamp", pytest.param("skylamp.app.cli", marks=pytest.mark.slow)])
def test_as_a_module(here, module):
    """python -m runs the command line, under its own name, with its exit codes."""
    call = lambda *arguments: subprocess.run(
        [sys.executable, "-m", module, *arguments], capture_output=True, text=True, timeout=300
    )
    version = call("--version")
    assert (version.returncode, version.stdout, version.stderr) == (0, f"skylamp {sl.__version__}\n", "")
    assert "Usage: skylamp [OPTIONS] COMMAND" in call("--help").stdout
    missing = call("render", "no.npy", "--out", "a.npy")
    assert missing.returncode == 3 and missing.stderr.startswith("skylamp: error: File not found: no.npy")


@pytest.mark.slow
def test_bar_on_a_terminal(here):
    """On a terminal stderr shows what is being done, and stdout stays clean."""
    pty = pytest.importorskip("pty")  # not on Windows
    terminal, stderr = pty.openpty()
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "skylamp.app.cli",
            "recover",
            "image.npy",
            "--out",
            "a.npy",
            "--json",
            "--method",
            "paper",
            "--layers",
            "4",
            "--hemicube",
            "3",
            "--backend",
            "numpy",
        ],
        stdout=subprocess.PIPE,
        stderr=stderr,
        timeout=300,
        env={**os.environ, "TERM": "xterm"},
    )
    os.close(stderr)
    shown = os.read(terminal, 1 << 16)
    os.close(terminal)
    assert done.returncode == 0 and json.loads(done.stdout) and b"carving" in shown


def test_import_is_light():
    """The library does not bring the command line or image readers with it."""
    code = (
        "import sys, skylamp; print(*[m for m in ('typer', 'rich', 'imageio', 'PIL', 'tifffile',"
        " 'matplotlib', 'skylamp.app.cli') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=300)
    assert (done.returncode, done.stdout.split()) == (0, []), done


@pytest.mark.slow
def test_demo(tmp_path, capsys):
    """Pictures, their tones and the comparison of backends."""
    code, out, err = run(capsys, "demo", "--out", tmp_path / "new" / "demo", "--json")
    assert code == 0, err
    facts = json.loads(out)
    assert sorted(p.name for p in (tmp_path / "new" / "demo").iterdir()) == sorted(
        p["file"] for p in facts["pictures"]
    )
    assert err.count("\n") == 0  # no compiler's noise, and no report beside the JSON
    for picture in facts["pictures"]:
        tones = io.read(tmp_path / "new" / "demo" / picture["file"])
        assert tones.dtype == np.uint8 and tones.std() > 20, picture
    assert all(b["bits_equal"] and b["difference"] < 1e-5 for b in facts["backends"] if b["available"])


def test_tables_print_brackets(capsys):
    """Units, files and devices whose names hold brackets stand in the tables as they are."""
    device = {
        "name": "opencl:0:0",
        "device": "card [b]",
        "seconds": 0.01,
        "bits_equal": True,
        "difference": 0,
    }
    missing = {"name": "warp:cuda:0", "device": "", "why": "no [driver]"}
    demo.print_tables(
        {
            "out": "a [s]",
            "backend": "numpy",
            "pictures": [],
            "backends": [{**device, "available": True}, {**missing, "available": False}],
        }
    )
    printed = capsys.readouterr().err
    for text in ("a [s]", "run [s]", "card [b]", "no [driver]"):
        assert text in printed


@pytest.mark.slow
def test_render_takes_colour_and_gloss(here, capsys):
    """--albedo R,G,B, --specular and --exponent are the library's; .npy, .tif and .png hold colour."""
    import imageio.v3 as imageio

    render = lambda out, *arguments: run(
        capsys, "render", "depth.npy", "--out", out, "--backend", "numpy", *arguments
    )
    for arguments, surface in (
        (["--albedo", "0.2,0.4,0.6"], sl.Lambertian((0.2, 0.4, 0.6))),
        (
            ["--albedo", "0.3", "--specular", "0.2,0.1,0.1", "--exponent", "9"],
            sl.Phong(0.3, (0.2, 0.1, 0.1), 9),
        ),
        (["--albedo", "0.1", "--specular", "0.5", "--exponent", "inf"], sl.Mirror(0.5, 0.1)),
    ):
        assert render("out.npy", *arguments)[0] == 0
        np.testing.assert_array_equal(
            np.load("out.npy"),
            sl.render(sl.Scene(np.load("depth.npy"), reflectance=surface), sl.Sky(), backend="numpy").image,
        )
    for name in ("out.png", "out.tif"):
        assert render(name, "--albedo", "0.2,0.4,0.6", "--interreflection", "off")[0] == 0
        picture = imageio.imread(name).astype(float)
        assert picture.shape == (*BOWL.shape, 3)
        np.testing.assert_allclose(picture[..., 0] / picture[..., 2], 1 / 3, atol=0.01)
    for arguments, code, says in (
        (["--exponent", "5"], 2, "--specular"),
        (["--albedo", "0.9", "--specular", "0.3"], 3, "0.2 too much"),
        (["--albedo", "1,2"], 2, "R,G,B"),
    ):
        fails(capsys, code, "render", "depth.npy", "--out", "no.npy", *arguments, says=says)
    fails(
        capsys,
        3,
        "render",
        "depth.npy",
        "--out",
        "no.png",
        "--bits",
        "16",
        "--albedo",
        "0.2,0.4,0.6",
        "--backend",
        "numpy",
        says="8 bits",
    )


def test_render_writes_the_error(here, capsys):
    """--error writes the estimate of every pixel in any format; refused where no tolerance decides."""
    assert (
        run(
            capsys,
            "render",
            "depth.npy",
            "--out",
            "a.npy",
            "--error",
            "e.npy",
            "--tolerance",
            "3%",
            "--backend",
            "numpy",
        )[0]
        == 0
    )
    wanted = sl.render(sl.Scene(np.load("depth.npy")), sl.Sky(), tolerance=0.03, backend="numpy")
    np.testing.assert_array_equal(np.load("a.npy"), wanted.image)
    np.testing.assert_array_equal(np.load("e.npy"), wanted.error)
    assert (
        run(capsys, "render", "depth.npy", "--out", "b.npy", "--error", "e.png", "--backend", "numpy")[0] == 0
        and os.path.getsize("e.png") > 100
    )
    fails(
        capsys,
        2,
        "render",
        "depth.npy",
        "--out",
        "c.npy",
        "--error",
        "f.npy",
        "--method",
        "horizon",
        "--backend",
        "numpy",
        says="--error",
    )
    black = "--albedo", "0", "--specular", "0.5", "--backend", "numpy"
    command = "render", "depth.npy", "--out", "c.npy", "--error", "f.npy"
    fails(capsys, 2, *command, *black, says="an albedo above 0")
    fails(
        capsys,
        3,
        "render",
        "depth.npy",
        "--out",
        "c.npy",
        "--error",
        "f.exe",
        "--backend",
        "numpy",
        says="f.exe",
    )


def test_plan_takes_the_sources_of_render(capsys, tmp_path):
    """A clear sky with its sun, which has azimuths of its own."""
    io.write(tmp_path / "a.npy", np.random.default_rng(0).random((16, 16)) + 1)
    sky = ("--source", "clear", "--sun", "135,30", "--direct", "3", "--json")
    code, out, _ = run(capsys, "plan", str(tmp_path / "a.npy"), *sky)
    assert code == 0 and "bright parts" in {choice["what"] for choice in json.loads(out)["choices"]}


def test_chart_measures_nothing_of_a_wrong_call(here, capsys):
    """An error leaves no folder behind."""
    fails(capsys, 3, "chart", "--out", "new", "--sizes", "4", says="sizes")
    fails(capsys, 4, "chart", "--out", "new", "--backend", "numpy,cuda:9", says="cuda:9")


def test_what_cannot_be_written_or_drawn_is_refused_before_work(here, capsys, monkeypatch):
    """Numbers of a PNG, the node and the sky of a picture: nothing is rendered before they are right."""
    for name in ("render", "sky_view_factor"):
        monkeypatch.setattr(sl, name, lambda *_, **__: pytest.fail("work was done"))
    for flags, says in (
        (("--white", "-1"), "--white"),
        (("--white", "nan"), "--white"),
        (("--bits", "12"), "--bits: got 12; allowed: 8 or 16"),
    ):
        fails(capsys, 3, "render", "depth.npy", "--out", "a.png", *flags, says=says)
    both = "horizon", "depth.npy", "--out", "a.npy", "--plot", "b.png"
    fails(capsys, 3, *both, "--at", "1.5,2", says="two whole numbers")
    fails(capsys, 2, *both, "--at", "1,2", "--source", "lamp", says="is a sky here")


def test_measured_irradiance_of_a_clear_sky(here, capsys):
    """Open level ground receives DHI + DNI x sin(elevation)."""
    np.save("level.npy", np.zeros((8, 8)))
    sky = "--source", "clear", "--sun", "135,30", "--horizontal", "90", "--direct", "750"
    flags = "--quantity", "irradiance", "--backend", "numpy"
    assert run(capsys, "render", "level.npy", "a.npy", "--height", *sky, *flags)[0] == 0
    np.testing.assert_allclose(np.load("a.npy"), 90 + 750 * 0.5, rtol=1e-4)
    fails(capsys, 2, "render", "level.npy", "b.npy", "--horizontal", "90", says="--horizontal: goes with")
