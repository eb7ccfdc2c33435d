"""`skylamp view`: what its page renders, and the page itself in headless Chromium."""

import os
import socket
import subprocess
import sys
import time
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path

import imageio.v3 as imageio
import numpy as np
import pytest
import typer

from skylamp.app import view
from skylamp.errors import InputError

pytest.importorskip("nicegui")
CHROMIUM, DRIVER = "/usr/bin/chromium", "/usr/bin/chromedriver"


@pytest.fixture
def file(tmp_path):
    y, x = np.mgrid[:48, :64]
    np.save(tmp_path / "height.npy", (6 * np.sin(x / 7) * np.cos(y / 5) + 0.1 * x).astype(np.float32))
    return tmp_path / "height.npy"


@pytest.mark.parametrize("settings", [
    view.Settings(), view.Settings("lamp", lamp=(0.2, 0.7), exaggeration=2.0, interreflection="on"),
    view.Settings("overcast sky", albedo=0.2, tolerance=0.03),
], ids=lambda s: s.source)  # fmt: skip
@pytest.mark.parametrize("height", [True, False])
def test_the_python_lines_make_the_image(file, settings, height, fast):
    """What the page saves as Python gives the page's image, bit for bit."""
    if not height:
        np.save(file, 20 - np.load(file))
    viewer = view.Viewer(view.read(file, height, 2.0, False), fast)
    names = {}
    exec(viewer.code(settings), names)
    np.testing.assert_array_equal(names["image"], viewer.refined(settings).image)
    assert viewer.coarse(settings).image.shape == (48, 64)


@pytest.mark.parametrize("nodata", [np.nan, -9999.0])
def test_nodes_without_data(file, nodata, fast):
    """They are masked in the page's image and in that of its Python lines."""
    values = np.load(file)
    values[3:9, 5:11] = nodata
    np.save(file, values)
    with pytest.raises(InputError) if np.isnan(nodata) else nullcontext():
        view.Viewer(view.read(file, True, 2.0, False), fast).scene(view.Settings())
    viewer, names = view.Viewer(view.read(file, True, 2.0, False, nodata), fast), {}
    exec(viewer.code(view.Settings()), names)
    image = viewer.refined(view.Settings()).image
    np.testing.assert_array_equal(names["image"], image)
    np.testing.assert_array_equal(np.isnan(image), (values != nodata) == (values != values))


def test_resample_is_of_a_geotiff(file):
    """It was ignored for other files."""
    with pytest.raises(typer.BadParameter, match="not a GeoTIFF"):
        view.read(file, True, None, True)


@pytest.mark.slow
def test_settings_reach_the_image(file, fast):
    """Each control changes the image, and the coarse map is every few nodes of the whole one."""
    viewer = view.Viewer(view.read(file, True, None, False), fast)
    start = view.Settings()
    image = viewer.refined(start).image
    for changes in (
        {"azimuth": 200.0}, {"elevation": 60.0}, {"source": "lamp"}, {"albedo": 0.9}, {"exaggeration": 3.0},
        {"tolerance": 1e-4}, {"interreflection": "on"},
    ):  # fmt: skip
        assert not np.array_equal(viewer.refined(replace(start, **changes)).image, image), changes
    large = view.Map(np.zeros((400, 330)), True, 3.0, None, ())
    assert large.coarse == (slice(1, None, 2), slice(1, None, 2))
    coarse = view.Viewer(large, fast).coarse(view.Settings())
    assert coarse.image.shape == (200, 165) and view.Viewer(large, fast).tones(coarse.image).shape == (
        400,
        330,
    )


@pytest.mark.parametrize("shape", [(1, 700), (5, 2000), (2000, 5), (400, 330), (3, 2)])
def test_pictures_have_the_shape_of_the_map(shape, fast):
    """Of narrow maps too, coarse and whole."""
    viewer = view.Viewer(view.Map(np.zeros(shape, np.float32), True, 1.0, None, ()), fast)
    for image in (viewer.coarse(view.Settings()).image, np.ones(shape, np.float32)):
        assert viewer.tones(image).shape == shape


def test_nodata_moves_no_lamp_and_ends_no_frame(fast):
    """The lamp stands above the highest valid depth; a coarse map keeps a valid node, if few are."""
    depth = np.full((40, 50), 20.0, np.float32)
    depth[3, 4] = -9999
    viewer = view.Viewer(view.Map(depth, False, 1.0, depth > 0, ()), fast)
    assert viewer.source(view.Settings("lamp")).center == (25.0, 20.0, 10.0)
    mask = np.zeros((400, 400), bool)
    mask[1::2, 1::2] = True
    sparse = view.Viewer(view.Map(np.zeros((400, 400), np.float32), True, 1.0, mask, ()), fast)
    assert np.isfinite(sparse.coarse(view.Settings()).image).any()


def test_heights_of_16_bits_are_exaggerated(fast):
    """The page sends whole numbers as such, and 4 times 8843 m in int16 is a pit."""
    ground = view.Map(np.array([[5000, 8843]], np.int16), True, 90.0, None, ("values, mask, spacing = V",))
    viewer, settings = view.Viewer(ground, fast), view.Settings(exaggeration=4)
    for coarse in (False, True):
        np.testing.assert_array_equal(viewer.scene(settings, coarse).depth, [[4 * 3843, 0]])
    names = {"V": (ground.values, None, 90.0)}
    exec(viewer.code(settings), names)
    np.testing.assert_array_equal(names["scene"].depth, [[4 * 3843, 0]])


@pytest.mark.parametrize("is_height", [True, False])
def test_coarse_and_whole_image_have_the_lamp_at_one_place(is_height, fast):
    """Over a tower that the coarse map misses; its nodes are in the middle of those that they stand for."""
    height = np.zeros((480, 960))
    height[200, 401] = 300.0
    ground = view.Map(height if is_height else 400 - height, is_height, 2.0, None, ())
    viewer = view.Viewer(ground, fast)
    settings = view.Settings("lamp", lamp=(0.8, 0.7), lamp_height=0.03, lamp_radius=0.02)
    assert ground.coarse == (slice(3, None, 6), slice(3, None, 6)) and not height[ground.coarse].any()
    quick, whole = viewer.coarse(settings).image, viewer.refined(settings).image
    np.testing.assert_allclose(quick[:, 90:], whole[ground.coarse][:, 90:], rtol=0.02)
    np.testing.assert_array_equal(viewer.tones(quick)[ground.coarse], viewer.tones(quick)[::6, ::6])


@pytest.mark.parametrize("spacing", [1e-8, 1.0, 1e9])
def test_lamps_have_a_size_in_every_unit(spacing, fast):
    """They were rounded to six decimals."""
    viewer = view.Viewer(view.Map(np.zeros((20, 30)), True, spacing, None, ()), fast)
    lamp = viewer.source(view.Settings("lamp"))
    assert lamp.radius == pytest.approx(1.5 * spacing) and lamp.center == pytest.approx(
        (15 * spacing, 10 * spacing, -6 * spacing)
    )


@contextmanager
def page(file, *options):
    """The address of a page that serves ``file``."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    # pytest's own environment variables would put NiceGUI into its test mode
    clean = {k: v for k, v in os.environ.items() if not k.startswith(("PYTEST", "NICEGUI"))}
    words = "view", str(file), "--height", "--port", str(port), "--no-browser", *options
    served = subprocess.Popen([sys.executable, "-m", "skylamp", *words], env=clean, stderr=subprocess.PIPE)
    try:
        for _ in range(600):
            with socket.socket() as there:
                if there.connect_ex(("127.0.0.1", port)) == 0:
                    break
            assert served.poll() is None, served.stderr.read()
            time.sleep(0.1)
        yield f"http://127.0.0.1:{port}"
    finally:
        served.terminate()
        served.wait(30)


def until(found, what, seconds=120):
    """The first true value of ``found()``."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        value = found()
        if value:
            return value
        time.sleep(0.1)
    pytest.fail(f"not within {seconds} s: {what}")


def chromium(downloads):
    """Headless Chromium, Debian's."""
    assert Path(CHROMIUM).exists() and Path(DRIVER).exists(), "apt-get install chromium chromium-driver"
    from selenium import webdriver

    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,1000"):
        options.add_argument(word)
    options.add_experimental_option("prefs", {"download.default_directory": str(downloads)})
    return webdriver.Chrome(options, webdriver.ChromeService(DRIVER))


@pytest.mark.slow
def test_drag_change_click_and_save_in_a_browser(file, tmp_path):
    """Headless Chromium, Debian's: the picture follows the mouse, is refined at rest, and is saved."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By
    from selenium.webdriver.common.keys import Keys

    with page(file) as address:
        browser = chromium(tmp_path)
        try:
            browser.get(address)
            status = lambda: browser.find_element(By.CSS_SELECTOR, ".status").text
            picture = lambda: browser.find_element(By.CSS_SELECTOR, ".picture img")
            refined = lambda: status().startswith("refined") and "estimated error" in status()
            until(refined, "the first image")
            first = picture().get_attribute("src")
            ActionChains(browser).move_to_element(picture()).click_and_hold().move_by_offset(90, 40).perform()
            until(lambda: status().startswith(("frame", "refined")), "a frame")
            ActionChains(browser).move_by_offset(60, 30).release().perform()
            until(lambda: refined() and picture().get_attribute("src") != first, "the sun elsewhere")
            assert "135.0, 35.0" not in (text := browser.find_element(By.CSS_SELECTOR, "code").text)
            assert "sl.cie_clear(" in text
            second = picture().get_attribute("src")
            slider = browser.find_elements(By.CSS_SELECTOR, ".q-slider")[1]  # the exaggeration
            ActionChains(browser).move_to_element(slider).click().send_keys(Keys.ARROW_RIGHT).perform()
            until(lambda: refined() and picture().get_attribute("src") != second, "other heights")
            ActionChains(browser).move_to_element(picture()).click().perform()
            # in one step, since the page replaces these elements
            shown = "[...document.querySelectorAll('.q-img img')].filter(e => e.offsetParent).map(e => e.src)"
            plots = lambda: browser.execute_script(f"return {shown}")
            until(plots, "the horizon of a node")
            stale = plots()
            ActionChains(browser).move_to_element(slider).click().send_keys(Keys.ARROW_LEFT).perform()
            until(lambda: set(plots()) - set(stale), "its horizon over other heights")
            until(refined, "the image of these")
            browser.find_element(By.CSS_SELECTOR, ".save").click()
            until((tmp_path / "skylamp.png").exists, "the saved image")
            if os.environ.get("SKYLAMP_SCREENSHOT"):
                browser.save_screenshot(os.environ["SKYLAMP_SCREENSHOT"])
            names = {}
            exec(browser.find_element(By.CSS_SELECTOR, "code").text.replace("\u00a0", " "), names)
        finally:
            browser.quit()
    saved = imageio.imread(tmp_path / "skylamp.png")
    viewer = view.Viewer(view.read(file, True, None, False))
    np.testing.assert_array_equal(saved, viewer.tones(np.asarray(names["image"])))


@pytest.mark.slow
def test_a_narrow_map_with_nodata_in_a_browser(tmp_path):
    """It is large enough to be dragged, a short drag is one, and what fails is said and ends nothing."""
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    height = np.arange(32.0).reshape(2, 16) % 5
    height[:, 8:] = np.nan
    np.save(tmp_path / "narrow.npy", height)
    with page(tmp_path / "narrow.npy", "--nodata", "nan") as address:
        browser = chromium(tmp_path)
        try:
            browser.get(address)
            status = lambda: browser.find_element(By.CSS_SELECTOR, ".status").text
            picture = browser.find_element(By.CSS_SELECTOR, ".picture img")
            until(lambda: status().startswith("refined"), "the first image")
            assert picture.size == {"width": 512, "height": 64}
            ActionChains(browser).move_to_element_with_offset(picture, 150, 0).click().perform()
            until(lambda: "not masked" in status(), "why there is no horizon")
            drag = ActionChains(browser).move_to_element_with_offset(picture, -100, 0).click_and_hold()
            drag.move_by_offset(20, 5).release().perform()
            until(lambda: status().startswith("refined"), "the image after that")
            assert "135.0, 35.0" not in browser.find_element(By.CSS_SELECTOR, "code").text
        finally:
            browser.quit()
