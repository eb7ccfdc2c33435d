"""Sky-view factors by other packages on PyPI, as performance/horizon.py --peers runs them beside skylamp.

    python3 -m venv peers
    peers/bin/pip install -U pip setuptools wheel setuptools_scm cython numpy==2.4.6 scipy==1.17.1 \\
        numba==0.68.1 xarray==2026.9.0 pandas==3.1.1 urllib3 trimesh==5.2.0 embreex==4.4.0.post1
    peers/bin/pip install --no-deps --no-build-isolation --ignore-requires-python \\
        rvt-py==2.2.3 xarray-spatial==0.10.20 topocalc==0.5.0
    peers/bin/pip install -e .[plot]
    peers/bin/python performance/horizon.py --out docs --peers

Two quantities, as in skylamp.sky_view_factor; h is the horizon's elevation, not below 0:

- "solid_angle": 1 - mean of sin h over azimuth, the share of the hemisphere's solid angle.
- "tilted": E / (pi B) under a uniform sky, cosine-weighted about the surface's normal.

A runner is f(height (rows, cols) in spacings, azimuths or rays, radius in spacings) -> (rows, cols), with the
package's defaults for what is not given. rvt-py has a sky_illumination too; it is left out, since 2.2.3 turns
its azimuths the wrong way against the slope's aspect (a plane of slope 1 gets 0.94 facing east, 0.67 facing
south, where 0.85 is right).
"""

import importlib
import importlib.metadata
import time
import warnings

import numpy as np

warnings.filterwarnings("ignore", category=DeprecationWarning)

EMBREE_NODES = 20_000  # of the map at which rays are timed; the rest is reckoned from them


def rvt_py(height, azimuths=16, radius=10):
    """Nearest nodes along each azimuth up to the radius; borders mirrored."""
    import rvt.vis

    return rvt.vis.sky_view_factor(np.asarray(height, np.float32), 1.0, svf_n_dir=azimuths, svf_r_max=radius)[
        "svf"
    ]


def xarray_spatial(height, azimuths=16, radius=10):
    """Nearest nodes along each azimuth up to the radius; borders open."""
    import xarray
    from xrspatial import sky_view_factor

    grid = xarray.DataArray(np.asarray(height, float), dims=("y", "x"))
    return sky_view_factor(
        grid, max_radius=radius, n_directions=azimuths, cellsize_x=1.0, cellsize_y=1.0
    ).data


def topocalc(height, azimuths=72, radius=None):
    """Horizons of the whole map, sheared by whole nodes; borders open.

    Normals by central differences, as in the reference: with its own (Horn's, of 3 x 3 nodes) its error is a
    third larger.
    """
    from topocalc.gradient import gradient_d4
    from topocalc.viewf import viewf

    height = np.asarray(height, float)
    slope, aspect = gradient_d4(height, 1, 1, aspect_rad=True)
    return viewf(height, 1.0, nangles=azimuths, sin_slope=np.sin(slope), aspect=aspect)[0]


def embree(height, azimuths=256, radius=None, nodes=None, seed=0):
    """Share of ``azimuths`` (a square) jittered rays per node that meet no ground; borders open.

    Rays are cosine-weighted about the normal; the ground is two triangles per cell. nan off ``nodes`` (rows,
    cols), all unless given. Rays below the level count as blocked. The triangles' diagonals are ridges that
    the reference, linear along rows and columns, does not have: about 0.0015 of its bias on rough ground.
    """
    import trimesh.ray.ray_pyembree
    from trimesh import Trimesh

    rows, cols = nodes if nodes is not None else np.indices(height.shape).reshape(2, -1)
    height = np.asarray(height, float)
    size = height.shape[1]
    at = (np.arange(height.shape[0] - 1)[:, None] * size + np.arange(size - 1)).ravel()
    faces = np.concatenate([at[:, None] + (0, 1, size + 1), at[:, None] + (0, size + 1, size)])
    grid = np.stack([*np.indices(height.shape)[::-1], height], -1).reshape(-1, 3)
    mesh = trimesh.ray.ray_pyembree.RayMeshIntersector(Trimesh(grid, faces, process=False))
    gy, gx = (slope[rows, cols] for slope in np.gradient(height))
    normal = np.stack([-gx, -gy, np.ones_like(gx)], -1) / np.sqrt(1 + gx**2 + gy**2)[:, None]
    a = -1 / (1 + normal[:, 2])  # a frame about the normal
    b = normal[:, 0] * normal[:, 1] * a
    one, other = (
        np.stack([1 + normal[:, 0] ** 2 * a, b, -normal[:, 0]], -1),
        np.stack([b, 1 + normal[:, 1] ** 2 * a, -normal[:, 1]], -1),
    )
    origin = np.stack([cols, rows, height[rows, cols]], -1) + 1e-3 * normal
    side = round(azimuths**0.5)
    cell = np.indices((side, side)).reshape(2, 1, -1)
    rng, out = np.random.default_rng(seed), np.full(height.shape, np.nan)
    for part in np.array_split(np.arange(len(rows)), len(rows) * azimuths // 1_000_000 + 1):
        u, v = (cell + rng.random((2, len(part), azimuths))) / side
        r, turn = np.sqrt(u)[..., None], 2 * np.pi * v[..., None]
        rays = (
            r * np.cos(turn) * one[part, None]
            + r * np.sin(turn) * other[part, None]
            + np.sqrt(1 - r**2) * normal[part, None]
        )
        seen = rays[..., 2] >= 0
        seen[seen] = ~mesh.intersects_any(np.repeat(origin[part, None], azimuths, 1)[seen], rays[seen])
        out[rows[part], cols[part]] = seen.mean(1)
    return out


PEERS = {  # function, packages, modules that must import, quantity
    "rvt-py": (rvt_py, ("rvt-py",), ("rvt.vis",), "solid_angle"),
    "xarray-spatial": (xarray_spatial, ("xarray-spatial",), ("xarray", "xrspatial"), "solid_angle"),
    "topocalc": (topocalc, ("topocalc",), ("topocalc.viewf", "topocalc.gradient"), "tilted"),
    "trimesh + embreex": (embree, ("trimesh", "embreex"), ("trimesh", "embreex"), "tilted"),
}
RUNS = (  # peer, azimuths or rays, radius
    ("rvt-py", 16, 10),
    ("rvt-py", 16, 100),
    ("xarray-spatial", 16, 10),
    ("xarray-spatial", 16, 100),
    ("topocalc", 16, None),
    ("topocalc", 64, None),
    ("trimesh + embreex", 256, None),
)


def missing() -> dict[str, str]:
    """Peers that cannot be run, and why."""
    found = {}
    for name, (_, _, modules, _) in PEERS.items():
        try:
            for module in modules:
                importlib.import_module(module)
        except Exception as error:  # what a package raises when it does not fit its neighbours
            found[name] = f"{type(error).__name__}: {error}"
    return found


def version(name: str) -> str:
    return " + ".join(importlib.metadata.version(package) for package in PEERS[name][1])


def run(
    name: str, height: np.ndarray, nodes, azimuths: int, radius: int | None
) -> tuple[np.ndarray, float, float]:
    """(values at ``nodes``, seconds for the whole map, cores that were busy) of a peer."""
    function = PEERS[name][0]
    options = {"azimuths": azimuths, "radius": radius}
    if name == "xarray-spatial":
        function(height[:32, :32], azimuths, 2)  # compiles
    if name != "trimesh + embreex":
        image, seconds, cores = timed(function, height, **options)
        return image[nodes], seconds, cores
    image, few, _ = timed(function, height, nodes=nodes, **options)  # mostly the mesh and its tree
    many = np.unravel_index(np.random.default_rng(0).permutation(height.size)[:EMBREE_NODES], height.shape)
    _, seconds, cores = timed(function, height, nodes=many, **options)
    left = (height.size - len(many[0])) / (len(many[0]) - len(nodes[0]))
    return image[nodes], seconds + max(0.0, seconds - few) * left, cores


def timed(function, *args, **options):
    start, spent = time.perf_counter(), time.process_time()
    out = function(*args, **options)
    seconds = time.perf_counter() - start
    return out, seconds, (time.process_time() - spent) / seconds
