"""Radiometry against closed forms."""

import numpy as np
import pytest

import skylamp as sl
from skylamp import radiometry as r


def unit(*v):
    return np.array(v, float) / np.linalg.norm(v)


def test_foreshortening():
    """cos(theta) of unit vectors that broadcast, 0 from behind."""
    directions = [(0, 0, 1), unit(0, 3, 4), unit(1, 0, -1)]
    np.testing.assert_allclose(r.foreshortening((0, 0, 1), directions), [1, 0.8, 0])


def test_angle_of_a_curve():
    """dphi = dl cos / r, summed: half a circle whatever the curve between its ends; a line by arctangents."""
    line = np.stack([np.linspace(-3, 5, 2001), np.full(2001, 2.0)], -1)
    middle, step = (line[1:] + line[:-1]) / 2, np.diff(line, axis=0)
    distance = np.linalg.norm(middle, axis=1)
    pieces = r.planar_angle(np.linalg.norm(step, axis=1), middle[:, 1] / distance, distance)
    exact = np.arctan(5 / 2) + np.arctan(3 / 2)
    assert abs(pieces.sum() - exact) < 1e-6
    assert abs(abs(r.curve_angle(line)) - exact) < 1e-12
    t = np.linspace(0, 2 * np.pi, 50)
    round_it = np.stack([3 * np.cos(t) + 0.5, np.sin(t) - 0.2], -1)
    np.testing.assert_allclose(
        r.curve_angle(np.stack([round_it, round_it + [9, 0]])), [2 * np.pi, 0], atol=1e-12
    )


def test_solid_angles():
    """An octant, a rectangle by its own closed form, a patch as its limit, and a far one by dA cos / r^2."""
    assert abs(r.polygon_solid_angle(np.eye(3)) - np.pi / 2) < 1e-12
    x0, x1, y0, y1, d = -1.0, 2.5, 0.3, 4.0, 1.7
    corners = np.array([[x0, y0, d], [x1, y0, d], [x1, y1, d], [x0, y1, d]])
    assert abs(r.polygon_solid_angle(corners) - r.rectangle_solid_angle(x0, x1, y0, y1, d)) < 1e-12
    assert r.rectangle_solid_angle([x0], [x1], [y0], [y1], [d]) == r.rectangle_solid_angle(x0, x1, y0, y1, d)
    assert abs(r.polygon_solid_angle(corners[::-1]) - r.polygon_solid_angle(corners)) < 1e-12
    normal, eye = unit(1, 2, 2), np.array([30.0, 10, 80])
    u = np.cross(normal, [1, 0, 0])
    v = np.cross(normal, u)
    small = eye + 0.05 * np.array([-u - v, u - v, u + v, v - u])
    area = 4 * 0.05**2 * np.linalg.norm(u) * np.linalg.norm(v)
    far = np.linalg.norm(eye)
    assert (
        abs(r.patch_solid_angle(area, abs(normal @ eye) / far, far) / r.polygon_solid_angle(small) - 1) < 1e-5
    )


def test_transfer_between_two_discs():
    """d3E summed over two coaxial discs is pi L A_1 F_12 by the tables of view factors, from either end."""
    radius, gap, n = (1.0, 1.5), 2.0, 40
    discs = []
    for R in radius:
        rings = R * np.sqrt((np.arange(n) + 0.5) / n)
        t = 2 * np.pi * (np.arange(n) + 0.5) / n
        discs.append(((rings[:, None] * np.exp(1j * t)).ravel(), np.pi * R**2 / n**2))
    (p, a), (q, b) = discs
    distance = np.sqrt(np.abs(p[:, None] - q) ** 2 + gap**2)
    cosine = gap / distance
    power = r.transfer(3.0, cosine, a, cosine, b, distance)
    s = 1 + (1 + (radius[1] / gap) ** 2) / (radius[0] / gap) ** 2
    view = (s - np.sqrt(s**2 - 4 * (radius[1] / radius[0]) ** 2)) / 2
    assert abs(power.sum() / (np.pi * 3 * np.pi * radius[0] ** 2 * view) - 1) < 2e-3
    back = r.transfer(3.0, cosine, b, cosine, a, distance)
    np.testing.assert_allclose(back, power, rtol=1e-12)
    np.testing.assert_allclose(r.radiance_of_transfer(power, cosine, a, cosine, b, distance), 3.0, rtol=1e-12)


def test_radiance_does_not_change_along_a_ray():
    """Twice as far, a quarter of the power from a quarter of the solid angle: the radiance is the same."""
    distance = np.array([1.0, 2, 7])
    power = r.transfer(5.0, 0.8, 0.01, 0.6, 0.02, distance)
    np.testing.assert_allclose(power * distance**2, power[0])
    np.testing.assert_allclose(
        power / (0.02 * 0.6 * r.patch_solid_angle(0.01, 0.8, distance)), 5.0
    )  # as patch 2 measures it


def test_irradiance_and_radiosity():
    """Uniform: pi L. 1 / cos(theta): 2 pi. An overcast sky: 7 pi / 9. Radiosity is pi x radiance."""
    assert abs(r.irradiance(lambda L: np.ones(len(L))) - np.pi) < 1e-12
    assert abs(r.irradiance(lambda L: 1 / L[:, 2], elevations=200) / (2 * np.pi) - 1) < 4e-3
    assert abs(r.irradiance(lambda L: sl.cie_overcast()(L * [1, 1, -1])) - 7 * np.pi / 9) < 1e-5
    np.testing.assert_allclose(
        r.irradiance(lambda L: L[:, 2:] * [1, 2, 0.5]), 2 * np.pi / 3 * np.array([1, 2, 0.5]), rtol=1e-5
    )
    np.testing.assert_allclose(r.radiosity([1.0, 4.0]), [np.pi, 4 * np.pi])
    assert abs(r.radiosity(lambda L: np.full(len(L), 2.0)) - r.radiosity(2.0)) < 1e-12
    assert r.radiance_of_radiosity(r.radiosity(2.0)) == pytest.approx(2.0)


def test_reflectance_of_a_constant_brdf():
    """rho_d = pi x rho_brdf from every side; and a BRDF that depends on one direction."""
    incoming = np.array([[0, 0, 1.0], unit(1, 0, 1), unit(0, 3, 0.1)])
    np.testing.assert_allclose(
        r.directional_hemispheric(lambda i, o: np.full(len(o), 0.2), incoming), 0.2 * np.pi
    )
    np.testing.assert_allclose(
        r.directional_hemispheric(lambda i, o: i[:, 2] * o[:, 2], incoming),
        2 * np.pi / 3 * incoming[:, 2],
        rtol=1e-5,
    )


def test_light_for_the_eye():
    """1 W at 555 nm is 683 lm; there and back; a sphere of luminance L is pi R^2 L candela to every side."""
    assert r.lumens(1.0) == 683 and r.watts(683.0) == 1
    assert r.watts(r.lumens(12.5, 0.3), 0.3) == pytest.approx(12.5)
    sphere = r.intensity(1000.0, np.pi * 0.1**2)
    assert r.point_irradiance(sphere, 0.5, 4.0) == pytest.approx(np.pi * 1000 * (0.1 / 4) ** 2 * 0.5)
    with pytest.raises(sl.InputError, match="luminous efficiency.*0 to 1"):
        r.lumens(1.0, 1.5)


def test_where_a_point_will_do():
    """The error of I / r^2, exactly: a disc gives pi L R^2 / (r^2 + R^2); for a sphere there is none."""
    R, distance = 0.5, np.array([0.5, 1, 5, 50])
    exact = r.disc_moment(np.tile([0, 0, 1.0], (4, 1)), R / np.hypot(R, distance)) @ [
        0,
        0,
        1.0,
    ]  # the cone that the disc fills
    point = r.point_irradiance(r.intensity(1.0, np.pi * R**2), 1.0, distance)
    np.testing.assert_allclose(point / exact - 1, r.point_error(R, distance), rtol=1e-9)
    sphere = r.disc_moment(np.tile([0, 0, 1.0], (3, 1)), R / distance[1:]) @ [0, 0, 1.0]
    np.testing.assert_allclose(point[1:], sphere)
    assert not r.point_error(R, distance, "sphere").any()
    assert r.point_error(R, r.point_distance(R, 0.01)) == pytest.approx(0.01)
    assert r.point_error(1.0, 10.0) == pytest.approx(0.01)  # five diameters
    with pytest.raises(sl.InputError, match="disc | sphere"):
        r.point_error(1, 1, "cube")
