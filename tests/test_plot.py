"""Pictures: what is drawn is what the library found, and files are whole or absent."""

import dataclasses
import json
import sys

import imageio.v3 as imageio
import numpy as np
import pytest

import skylamp as sl
from skylamp import io, oracle
from skylamp.app import cli, plot

pytest.importorskip("matplotlib")
from matplotlib.patches import Circle  # noqa: E402

Y, X = np.mgrid[:30, :48]
HILLS = 20 + 8 * np.sin(X / 6) + 4 * np.cos(Y / 5)


@pytest.fixture(scope="module")
def valley(fast):
    return sl.visibility_field(
        sl.Scene(HILLS, albedo=0.5), sl.Lamp(center=(24, 15, -6), radius=6), hemicube=9, backend=fast
    )


def discs(figure):
    return [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]


@pytest.mark.slow
def test_discs_show_the_field(valley, fast):
    """Discs stand in free space; the white share of each is the share of angle that sees the lamp."""
    figure = plot.field(valley, row=15, every=6, backend=fast)
    circles, wedges = discs(figure), figure.axes[0].collections[1:]
    assert len(circles) == len(wedges) >= 10
    shares = []
    for circle, disc in zip(circles, wedges):
        (x, z), radius = circle.center, circle.radius
        assert radius <= x <= 47 - radius + 0.5 and z + radius < valley.depth[15, round(x)]
        view = valley.view((round(x), 15, round(z)), backend=fast)
        low, high, which = plot.sectors(view)
        assert (
            high.max() - low.min() == pytest.approx(360)
            and (high > low).all()
            and (view.steps[which, 1] == 0).all()
        )
        white = (disc.get_facecolor()[:, :3] == 1).all(1)
        np.testing.assert_array_equal(white, view.visible[which])
        shares.append(((high - low) * white).sum() / 360)
    assert 0.02 < np.mean(shares) < 0.5 and np.ptp(shares) > 0.05


def test_sectors_lie_as_the_ray_goes(valley, fast):
    """A lamp overhead lights the upper sectors: depth runs downwards, the angle of -z is 90 degrees."""
    view = valley.view((24, 15, 2), backend=fast)
    low, high, which = plot.sectors(view)
    white = view.visible[which]
    assert white.any() and ((low[white] > 0) & (high[white] < 180)).all()
    figure = plot.field(valley, row=15, every=6, backend=fast)
    bottom, top = figure.axes[0].get_ylim()
    assert bottom > top


def test_sky_above_a_pixel(fast):
    """The line is the brute force's, north up; only sky above it has colour; the factor is the library's."""
    scene = sl.Scene.from_height(HILLS.max() - HILLS, sides="open")
    sky = sl.Sky(sl.cie_clear((90, 40), direct=3.0))
    figure = plot.horizon(scene, 12, 30, sky, azimuths=90, backend=fast)
    axes = figure.axes[0]
    angle, radius = axes.lines[0].get_data()
    nodes = np.array([12]), np.array([30])
    slopes = oracle.horizons(scene.depth, 1.0, sl.Azimuths(90).angles, nodes=nodes)[:, 0]
    rounded = np.degrees(2.0**-20)  # one float32 height below 32, seen from the next node
    np.testing.assert_allclose(radius[:-1], 90 - np.degrees(np.arctan(np.maximum(slopes, 0))), atol=rounded)
    np.testing.assert_allclose(
        angle[:-1], 2 * np.pi * (np.arange(90) + 0.5) / 90 + np.pi / 2
    )  # +x, east, is at 90 degrees from north
    assert axes.get_theta_direction() == -1 and axes.get_theta_offset() == pytest.approx(np.pi / 2)
    light = np.ma.masked_invalid(axes.collections[0].get_array()).reshape(180, 90)
    heights = 90 - (np.arange(180) + 0.5) / 2
    np.testing.assert_array_equal(~np.ma.getmaskarray(light), heights[:, None] >= 90 - radius[:-1])
    row, col = np.unravel_index(np.argmax(light), light.shape)
    assert abs(heights[row] - 40) < 3 and col in (0, 89)  # the bright side is east, where the sun stands
    factor = sl.sky_view_factor(scene, "horizontal", azimuths=90, backend=fast)[12, 30]
    assert f"sky-view factor of level ground {factor:.2f}" in figure.get_suptitle()
    sun = axes.lines[-1].get_data()
    assert (np.degrees(sun[0][0]) if np.ndim(sun[0]) else np.degrees(sun[0])) == pytest.approx(90)


def test_tangent_plane(fast):
    """On a plane rising to the east, the dashed line stands at its slope there and nowhere to the west."""
    scene = sl.Scene.from_height(np.tan(np.radians(30)) * X[:9, :9].astype(float))
    axes = plot.horizon(scene, 4, 4, azimuths=180, backend=fast).axes[0]
    dashed = next(line for line in axes.lines if line.get_linestyle() == "--")
    angle, radius = np.degrees(dashed.get_xdata()[:-1]) % 360, dashed.get_ydata()[:-1]
    assert 90 - radius[np.abs(angle - 90).argmin()] == pytest.approx(30, abs=0.1)
    assert np.isnan(radius[(angle > 185) & (angle < 355)]).all()


def test_the_sky_of_a_map_whose_rows_run_north(fast):
    """Horizon and tangent plane are those of the same ground with rows that run south."""
    xr = pytest.importorskip("xarray")
    south = xr.DataArray(HILLS.max() - HILLS, {"y": -1.0 * np.arange(len(HILLS)), "x": X[0]}, ("y", "x"))
    lines = [
        plot.horizon(sl.Scene.from_height(dem), row, 17, azimuths=36, backend=fast).axes[0].lines
        for dem, row in ((south, 5), (south[::-1], len(HILLS) - 6))
    ]
    for one, other in zip(*lines, strict=True):
        np.testing.assert_allclose(one.get_ydata(), other.get_ydata(), atol=1e-4)


@pytest.mark.parametrize(("rows", "cols"), [(1, 1), (-1, 1), (1, -1), (-1, -1)])
def test_a_map_is_drawn_north_up(rows, cols):
    """By the coordinates of a DataArray; what has no value, or is masked, has no grey."""
    xr = pytest.importorskip("xarray")
    height = np.arange(12.0).reshape(3, 4)
    height[0, 1] = np.nan
    dem = xr.DataArray(height, {"y": -1.0 * np.arange(3), "x": np.arange(4.0)}, ("y", "x"))[::rows, ::cols]
    masked = np.ma.masked_invalid(height)
    for given in (dem, masked, height):
        (shown,) = plot.terrain(given, 30.0).axes[0].images
        np.testing.assert_array_equal(shown.get_array().filled(np.nan), height)
        assert np.ptp(shown.get_cmap().get_bad()[:3]) > 0.1
        assert shown.axes.get_ylim() == (2.5, -0.5)


@pytest.mark.parametrize("azimuths", [0, 2, 3.5, "a", 10**9])
def test_azimuths_of_a_horizon_are_checked(azimuths, fast):
    """They drew a wrong picture, took all memory, or raised IndexError."""
    with pytest.raises(sl.InputError, match="azimuths: got .* allowed: a whole number from 3"):
        plot.horizon(sl.Scene(HILLS), 3, 3, azimuths=azimuths, backend=fast)


def test_ground_beyond_the_radius_is_not_drawn(fast):
    """max_distance is in the unit of the spacing: a wall 20 nodes, or 600 m, to the east."""
    scene = sl.Scene.from_height(np.where(X < 40, 0.0, 300.0), 30.0)
    tops = []
    for radius in (570.0, 610.0, None):
        figure = plot.horizon(scene, 12, 20, azimuths=36, backend=fast, max_distance=radius)
        tops.append(90 - figure.axes[0].lines[0].get_ydata().min())
    expected = np.degrees(np.arctan(300 * np.cos(np.radians(5)) / 600))  # in the sectors beside due east
    np.testing.assert_allclose(tops, [0, expected, expected], atol=1e-3)


@pytest.mark.parametrize(
    "option", [["--what", "slopes"], ["--azimuths", "4"], ["--definition", "horizontal"]]
)
def test_a_picture_alone_refuses_options_of_the_output(tmp_path, option, capsys):
    """They were ignored; a place that is no number is an error of one line."""
    np.save(tmp_path / "h.npy", HILLS)
    words = ["horizon", str(tmp_path / "h.npy"), "--height", "--plot", str(tmp_path / "p.png"), "--at"]
    for at, more, code in (("3,3", option, 2), ("nan,3", [], 3)):
        with pytest.raises(SystemExit) as end:
            cli.main([*words, at, *more])
        assert end.value.code == code
    assert "two whole numbers" in capsys.readouterr().err and not (tmp_path / "p.png").exists()


@pytest.mark.slow
def test_panels(fast):
    """Image, depth, truth, error and confidence with their own values, both depths on one scale."""
    image = sl.render(sl.Scene(HILLS, sides="dark"), sl.Sky(), backend=fast).image
    found = sl.recover(image, sl.Sky(), sides="dark", layers=30, interreflection=False, backend=fast)
    shown = [axes.images[0] for axes in plot.recovery(image, found, HILLS).axes if axes.images]
    error = found.depth - HILLS
    for picture, values in zip(shown, (image, found.depth, HILLS, error, found.confidence), strict=True):
        np.testing.assert_array_equal(picture.get_array(), values)
    assert shown[1].get_clim() == shown[2].get_clim()
    painted = dataclasses.replace(
        found, albedo=np.linspace(0.1, 0.9, found.depth.size).reshape(found.depth.shape)
    )
    shown = [axes.images[0] for axes in plot.recovery(image, painted).axes if axes.images]
    np.testing.assert_array_equal(shown[-1].get_array(), painted.albedo)
    assert shown[-1].get_clim() == (0, 0.9) and len(shown) == 4
    with pytest.raises(sl.InputError, match="plot.recovery: image"):
        plot.recovery(image[1:], found)
    with pytest.raises(sl.InputError, match="plot.recovery: image"):
        plot.recovery("a", found)


@pytest.mark.parametrize(
    "work, says",
    [
        (lambda f, s: plot.field(f, row=30), "row: got 30; allowed: a whole number from 0 to 29"),
        (lambda f, s: plot.field(f, row=True), "row: got True"),
        (lambda f, s: plot.field(f, every=1), "at least 2"),
        (lambda f, s: plot.field(f, every=40), "at least one disc"),
        (lambda f, s: plot.horizon(s, 30, 0), "row: got 30"),
        (lambda f, s: plot.horizon(s, 0, 1.5), "col: got 1.5"),
        (lambda f, s: plot.horizon(s, 0, 0), "not masked"),
        (lambda f, s: plot.horizon(s, 3, 3, f.source), "got Lamp; allowed: a Sky"),
        (lambda f, s: plot.save(None, "a.jpg"), ".png .svg .pdf"),
        (lambda f, s: plot.save(None, "no/a.png"), "no folder no"),
        (lambda f, s: plot.save(None, "a.png", dpi=0), "dpi: got 0"),
        (lambda f, s: plot.save(None, "a.png", dpi=1e9), "dpi: got 1000000000.0; allowed: at most 10000"),
        (lambda f, s: plot.field(3), "field: got int"),
    ],
)
def test_errors(valley, work, says, tmp_path, monkeypatch):
    """One clear error each."""
    monkeypatch.chdir(tmp_path)
    mask = np.ones(HILLS.shape, bool)
    mask[0, 0] = False
    with pytest.raises(sl.InputError) as caught:
        work(valley, sl.Scene(HILLS, mask=mask))
    assert says in str(caught.value)


def test_without_matplotlib(valley, monkeypatch):
    """The error names the pip command."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    for work in (
        lambda: plot.field(valley),
        lambda: plot.horizon(sl.Scene(HILLS), 3, 3),
        lambda: plot.save(None, "a.png"),
    ):
        with pytest.raises(
            sl.InputError,
            match=r"a picture needs matplotlib, which is not installed: pip install 'skylamp\[plot\]'",
        ):
            work()


def run(capsys, *arguments):
    capsys.readouterr()
    with pytest.raises(SystemExit) as ended:
        cli.main([str(a) for a in arguments])
    return (ended.value.code or 0, *capsys.readouterr())


@pytest.mark.slow
def test_command_line(tmp_path, monkeypatch, capsys, fast):
    """Each picture by its verb, alone or beside the array; mistakes leave nothing behind."""
    monkeypatch.chdir(tmp_path)
    np.save("d.npy", HILLS)
    np.save("i.npy", sl.render(sl.Scene(HILLS), sl.Sky(), backend=fast).image)
    for command in (
        ["field", "d.npy", "--lamp", "24,15,-6,6", "--hemicube", "5", "--plot", "f.png"],
        ["horizon", "d.npy", "--at", "12,30", "--plot", "h.svg"],
        [
            "horizon",
            "d.npy",
            "--out",
            "v.npy",
            "--at",
            "12,30",
            "--plot",
            "h.png",
            "--source",
            "clear",
            "--sun",
            "120,40",
        ],
        [
            "recover",
            "i.npy",
            "--layers",
            "4",
            "--interreflection",
            "off",
            "--out",
            "r.npy",
            "--plot",
            "r.png",
        ],
    ):
        code, out, err = run(capsys, *command, "--backend", fast)
        assert (code, out) == (0, ""), err
    np.testing.assert_array_equal(io.read("v.npy"), sl.sky_view_factor(sl.Scene(HILLS), backend=fast))
    assert (tmp_path / "h.svg").read_bytes().startswith(b"<?xml")
    for name in ("f.png", "h.png", "r.png"):
        picture = imageio.imread(name)
        assert picture.shape[0] > 150 and picture.shape[1] > 500 and picture[..., :3].std() > 20, name
    there = sorted(p.name for p in tmp_path.iterdir())
    for code, command in (
        (2, ["horizon", "d.npy"]),
        (2, ["horizon", "d.npy", "--at", "1,2"]),
        (2, ["horizon", "d.npy", "--plot", "a.png"]),
        (3, ["horizon", "d.npy", "--at", "1,99", "--plot", "a.png"]),
        (3, ["horizon", "d.npy", "--at", "1.5,2", "--plot", "a.png"]),
        (2, ["field", "d.npy"]),
        (3, ["field", "d.npy", "--plot", "a.jpg"]),
        (3, ["field", "d.npy", "--plot", "no/a.png"]),
        (2, ["horizon", "d.npy", "--what", "joy", "--out", "a.npy"]),
        (3, ["horizon", "d.npy", "--at", "1,2", "--plot", "a.png", "--source", "lamp.exr"]),
    ):
        assert run(capsys, *command)[0] == code, command
    assert sorted(p.name for p in tmp_path.iterdir()) == there


@pytest.mark.parametrize(
    "what, make",
    [
        ("openness", sl.openness),
        ("negative-openness", lambda *a, **k: sl.openness(*a, negative=True, **k)),
        ("slopes", sl.horizons),
    ],
)
def test_horizons_by_command(tmp_path, capsys, fast, what, make):
    """Each kind reaches the library as it is, with azimuths and reach."""
    np.save(tmp_path / "d.npy", HILLS)
    code, out, err = run(
        capsys,
        "horizon",
        tmp_path / "d.npy",
        "--spacing",
        2,
        "--what",
        what,
        "--azimuths",
        8,
        "--max-distance",
        20,
        "--out",
        tmp_path / "a.npy",
        "--json",
        "--backend",
        fast,
    )
    assert code == 0, err
    facts = json.loads(out)
    expected = make(sl.Scene(HILLS, 2.0), 8, fast, max_distance=20)
    assert facts["what"] == what and facts["shape"] == list(expected.shape) and facts["plot"] is None
    np.testing.assert_array_equal(io.read(tmp_path / "a.npy"), expected)


def test_terrain_has_north_and_a_scale_bar_of_a_round_length():
    """On 100 nodes of 30 m the bar is 500 m long, at most a quarter of the map; the values are the map's."""
    values = np.arange(8000.0).reshape(80, 100)
    axes = plot.terrain(values, 30.0, "title", "height [m]").axes[0]
    np.testing.assert_array_equal(axes.images[0].get_array(), values)
    assert {"N", "500 m"} <= {text.get_text() for text in axes.texts}
    x = axes.lines[-1].get_xdata()
    assert x[1] - x[0] == pytest.approx(500 / 30)
    north = next(text for text in axes.texts if text.get_text() == "N")
    assert north.xy[1] < north.xyann[1], "the arrow points up, to row 0"
    with pytest.raises(sl.InputError, match="terrain: spacing"):
        plot.terrain(values, 0.0)
    with pytest.raises(sl.InputError, match="terrain: values"):
        plot.terrain(values[0], 1.0)


@pytest.mark.parametrize("shape", [(1, 1), (2, 3), (20, 400)])
def test_north_and_the_scale_bar_lie_on_small_and_on_long_maps(shape):
    """Inside the map's frame, whatever its size; a long title is broken into lines."""
    figure = plot.terrain(np.ones(shape), 30.0, "a long title " * 9, vmin=0)
    figure.canvas.draw()
    axes = figure.axes[0]
    frame = axes.get_window_extent()
    bar = axes.lines[-1].get_window_extent()
    assert frame.y0 <= bar.y0 <= frame.y1 and frame.x0 <= bar.x0 < bar.x1 <= frame.x1
    for text in axes.texts:
        x, y = text.get_window_extent().get_points().mean(0)
        assert frame.x0 <= x <= frame.x1 and frame.y0 <= y <= frame.y1, text.get_text()
    title = axes.title.get_window_extent()
    assert 0 <= title.x0 and title.x1 <= figure.bbox.x1


def test_recovery_without_a_value():
    """nan is drawn as missing, a black image black; something else than a Recovery is refused."""
    depth = np.full((8, 8), 3.0)
    found = sl.Recovery(depth, np.zeros((8, 8), bool), "numpy", 0.0, 0.0, confidence=np.ones((8, 8)))
    truth = np.where(np.eye(8, dtype=bool), np.nan, depth)
    figure = plot.recovery(np.zeros((8, 8)), found, truth)
    image, _, true = [axes.images[0] for axes in figure.axes if axes.images][:3]
    assert image.norm(0.0) == 0 and image.norm.vmax > 0
    assert true.get_array().mask.sum() == 8
    with pytest.raises(sl.InputError, match="plot.recovery: found: got NoneType"):
        plot.recovery(np.zeros((8, 8)), None)
    with pytest.raises(sl.InputError, match="plot.save: figure: got NoneType"):
        plot.save(None, "a.png")


@pytest.mark.parametrize(
    "options, says",
    [
        (dict(spacing=(30.0, 30.0)), "spacing"),
        (dict(vmin=3.0, vmax=1.0), "vmin, vmax"),
        (dict(vmin=10.0), "vmin, vmax"),
        (dict(vmax=-1.0), "vmin, vmax"),
        (dict(vmin="low"), "vmin, vmax"),
        (dict(vmin=np.nan), "vmin, vmax"),
        (dict(values=np.ones((2, 3), complex)), "values"),
        (dict(values=np.ones((0, 3))), "values"),
    ],
)
def test_terrain_refuses_what_matplotlib_would_fail_at(options, says):
    """Limits out of order are so beside the map's own least and largest value too."""
    with pytest.raises(sl.InputError, match=f"plot.terrain: {says}"):
        plot.terrain(**{"values": np.arange(6.0).reshape(2, 3), "spacing": 30.0, **options})


def test_terrain_shows_dollars(tmp_path):
    """Mathtext that matplotlib cannot read is shown as it is; what it can read is set."""
    for text, read in (("$5_$", False), ("a $\\foo$", False), ("m$^2$", True), ("5 $", True)):
        figure = plot.terrain(np.arange(6.0).reshape(2, 3), 30.0, text, text)
        assert figure.axes[0].title.get_parse_math() == figure.axes[1].yaxis.label.get_parse_math() == read
        plot.save(figure, tmp_path / "a.png", dpi=20)
    assert not plot.terrain(np.full((2, 3), np.nan), 30.0).axes[0].title.get_text()
