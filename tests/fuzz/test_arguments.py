"""Arguments of types that nobody means: one clear error, or the right answer."""

import numpy as np
import pytest

import skylamp as sl

HEIGHT = np.round(np.random.default_rng(5).random((9, 11)) * 8) / 4
HUGE = 10**400  # beyond float64

REFUSED = {
    "brightness": lambda: sl.Sky(HUGE),
    "brightness, ragged": lambda: sl.Sky([[1, 2], [3]]),
    "radius": lambda: sl.Lamp((4, 4, -5), HUGE),
    "center": lambda: sl.Lamp((4, 4, HUGE), 1.0),
    "center, of a buffer": lambda: sl.Lamp(memoryview(HEIGHT), 1.0),
    "window": lambda: sl.Window(x=(0, HUGE), y=(0, 3)),
    "power": lambda: sl.cosine_power(HUGE),
    "power, None": lambda: sl.cosine_power(None),
    "power, complex": lambda: sl.cosine_power(1j),
    "depth": lambda: sl.Scene(np.full((3, 3), np.finfo(np.longdouble).max)),
    "height": lambda: sl.Scene.from_height(np.array([[1e308, -1e308]])),
    "backend": lambda: sl.horizons(sl.Scene(HEIGHT), 8, np.array([2.0, 3.0])),
    "filled": lambda: sl.visibility(sl.Scene(HEIGHT), sl.Sky(), 3, "numpy", filled=np.array(2.0)),
    "progress": lambda: sl.visibility_field(sl.Scene(HEIGHT), sl.Sky(), 3, backend="numpy", progress="yes"),
}


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("name", REFUSED)
def test_an_argument_of_a_wrong_type_is_named(name):
    """Each raised another error before, from inside, or none."""
    with pytest.raises((sl.InputError, sl.BackendError), match=name.split(",")[0]):
        REFUSED[name]()


def test_a_matrix_is_taken_as_an_array():
    """A numpy.matrix stayed one, and products of it had other shapes."""
    with pytest.warns(PendingDeprecationWarning):
        matrix = np.asmatrix(HEIGHT)
    skies = [sl.Sky(sl.environment_map(image)) for image in (matrix, HEIGHT)]
    images = [sl.render(sl.Scene(HEIGHT), sky, azimuths=8, backend="numpy").image for sky in skies]
    assert images[0].tobytes() == images[1].tobytes()


def test_brightness_in_half_precision(fast):
    """Its largest number was compared with one that float16 does not hold: a warning, or an error."""
    with np.errstate(all="raise"):
        sky = sl.Sky(lambda L: np.full(L.shape[:-1], 0.5, np.float16))
        image = sl.render(sl.Scene(HEIGHT), sky, azimuths=8, backend=fast).image
    assert np.isfinite(image).all()
