"""The paper's Fig. 1: an empty room lit through a window; which rays come from the window, by point.

A disc stands for the rays through a point of free space that lie in the plane of the drawing. White sectors
are the directions in which the window is seen; the others are the floor, as bright as it is, and the black
walls. Prints the window's solid angle from the field beside the closed form. Writes figure1.png:

    python performance/figure1.py --out docs
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.collections import PatchCollection
from matplotlib.patches import Circle, Rectangle, Wedge

import skylamp as sl
from skylamp.app.plot import sectors
from skylamp.radiometry import rectangle_solid_angle

COLS, ROWS, FLOOR = 73, 25, 40  # the room, in nodes; its floor is layer 40
ALBEDO = 0.2  # of the floor
MIDDLE = ROWS // 2  # the row that is drawn
WINDOW = sl.Window(x=(17.5, 35.5), y=(4.5, 20.5))
EVERY, RADIUS = 6, 2.6  # discs, in nodes
GREYS = 0.20, 0.72  # display: black walls, the floor at its brightest; the window is white


def draw_room(axes):
    """Floor, walls and ceiling, with the window left open."""
    left, right, (x0, x1), thick = -0.5, COLS - 0.5, WINDOW.x, 1.2
    axes.add_patch(Rectangle((left, 0), right - left, FLOOR, color="#cdd8e3", lw=0))
    for x, z, width, height in (
        (left - thick, -thick, thick, FLOOR + 2 * thick),
        (right, -thick, thick, FLOOR + 2 * thick),
        (left, FLOOR, right - left, thick),
        (left, -thick, x0 - left, thick),
        (x1, -thick, right - x1, thick),
    ):
        axes.add_patch(Rectangle((x, z), width, height, color="0.25", lw=0))
    axes.annotate("window", ((x0 + x1) / 2, -0.5), ha="center", va="bottom")
    axes.set(
        xlim=(left - thick, right + thick),
        ylim=(FLOOR + thick, -3.5),
        aspect="equal",
        xlabel="x [nodes]",
        ylabel="depth z [nodes]",
        xticks=range(0, COLS, 12),
        yticks=range(0, FLOOR + 1, 10),
    )
    for side in axes.spines.values():
        side.set_visible(False)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=Path("docs"), help="folder of the picture (default: docs)"
    )
    parser.add_argument(
        "--hemicube", type=int, default=33, help="M, odd (default: 33, which makes 128 sectors)"
    )
    parser.add_argument("--backend", default="auto")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)

    room = sl.Scene(np.full((ROWS, COLS), float(FLOOR)), albedo=ALBEDO, sides="dark")
    field = sl.visibility_field(room, WINDOW, hemicube=options.hemicube, backend=options.backend)
    print(
        f"Field of {field.layers} x {ROWS} x {COLS} nodes and {len(field.hemicube)} directions by"
        f" {field.backend}."
    )
    angle = field.solid_angle()
    print("solid angle of the window [sr]\n   x  depth   field  closed form")
    for x, z in ((26, 4), (26, 16), (26, 40), (50, 16), (66, 16)):
        exact = rectangle_solid_angle(*(v - x for v in WINDOW.x), *(v - MIDDLE for v in WINDOW.y), z)
        print(f"{x:4d} {z:6d} {angle[z, MIDDLE, x]:7.3f} {exact:12.3f}")

    points = [(x, MIDDLE, z) for z in range(5, FLOOR, EVERY) for x in range(6, COLS - 6, EVERY)]
    views = [field.view(point, backend=options.backend) for point in points]
    brightest = max(view.brightness[~view.visible].max() for view in views)
    figure, axes = plt.subplots(figsize=(9.5, 5.4), layout="constrained")
    draw_room(axes)
    floor = matplotlib.colors.LinearSegmentedColormap.from_list("floor", [str(g) for g in GREYS])
    for (x, _, z), view in zip(points, views):
        low, high, which = sectors(view)
        colours = np.where(view.visible[which, None], 1.0, floor(view.brightness[which] / brightest))
        wedges = [
            Wedge((x, z), RADIUS, -b, -a) for a, b in zip(low, high)
        ]  # depth is drawn downwards, which turns angles round
        axes.add_collection(PatchCollection(wedges, facecolors=colours, edgecolors=colours, linewidths=0.3))
        axes.add_patch(Circle((x, z), RADIUS, fill=False, ec="0.2", lw=0.7))
    axes.set_title(
        "Rays through points of an empty room: white from the window, grey from the floor and the black"
        " walls",
        fontsize=11,
    )
    shades = matplotlib.cm.ScalarMappable(matplotlib.colors.Normalize(0, brightest), floor)
    figure.colorbar(
        shades, ax=axes, shrink=0.75, pad=0.01, label="brightness of floor and walls (the window: 1)"
    )
    figure.savefig(options.out / "figure1.png", dpi=100, pil_kwargs={"optimize": True})
    print(f"Floor and walls: brightness up to {brightest:.4f}. Wrote {options.out / 'figure1.png'}.")


if __name__ == "__main__":
    main()
