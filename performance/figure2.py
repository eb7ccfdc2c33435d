"""The paper's Fig. 2: a slanting plane under a spherical lamp behind the viewer, and depth from its image.

The lamp shines alike in all directions, weakly directed (cos^2) and strongly directed (cos^8). Columns of the
picture: the three lamps. Rows: (1) the image of Eq. 3; (2) depth recovered from it by carving, which replaces
N.L by 1/2; (3) depth recovered from the image of Eq. 4, which has N.L = 1/2 too, so that what is wrong here
is the algorithm's own; (4) luminance of Eq. 4 down two columns of free space, beside the image's value there:
where the curve crosses it twice, the column has two answers. Prints a table. Writes figure2.png (a minute or
two on two cores):

    python performance/figure2.py --out docs
"""

import argparse
from pathlib import Path

import matplotlib
import numpy as np

matplotlib.use("Agg")
import matplotlib.pyplot as plt

import skylamp as sl

SIZE, LAYERS, ALBEDO = 64, 64, 0.8
MIDDLE, SLOPE = 40.0, 0.5  # of the plane: its depth in the middle, and layers per column
RADIUS = 24.0  # of the lamp; it touches the viewer's plane from behind
POWERS = {"isotropic": 0, "weakly directed, cos^2": 2, "strongly directed, cos^8": 8}
COLUMNS = {"a": (31, 54), "b": (56, 55)}  # (row, col) whose luminance is drawn
CENTRE = (SIZE - 1) / 2


def lamp(power):
    return sl.Lamp(
        center=(CENTRE, CENTRE, -RADIUS), radius=RADIUS, brightness=sl.cosine_power(power, axis=(0, 0, 1))
    )


def shares(cube, power):
    """What each direction adds to the luminance of Eq. 4 (D,)."""
    return ALBEDO / (2 * np.pi) * lamp(power).brightness(cube.directions) * cube.solid_angles


def brightest(image):
    """(x, y) from the middle of the image to the centroid of the pixels within 2 % of the maximum."""
    y, x = np.nonzero(image >= 0.98 * image.max())
    return x.mean() - CENTRE, y.mean() - CENTRE


def two_valued(columns, image):
    """Where luminance down a free column crosses the image's value twice, over 4 layers apart."""
    brighter = columns > image
    crossing = brighter[1:] != brighter[:-1]
    return crossing.any(0) & (len(crossing) - 1 - crossing[::-1].argmax(0) - crossing.argmax(0) > 4)


def carved(image, power, cube, eps, backend):
    """Depth from the image by the paper's method."""
    return sl.recover(
        image,
        lamp(power),
        albedo=ALBEDO,
        sides="open",
        layers=LAYERS,
        hemicube=cube,
        method="paper",
        eps=eps,
        backend=backend,
    )


def print_row(name, equation, image, found, truth, two):
    error = found.depth - truth
    rms, kept = (np.sqrt(np.mean(error[w] ** 2)) for w in (np.full(two.shape, True), ~found.drilled))
    px, py = brightest(image)
    print(
        f"{name:25} {equation:6} {f'({px:+.1f}, {py:+.1f})':>15} {np.hypot(px, py):8.1f} {rms:6.2f}"
        f" {kept:6.2f} {found.drilled.mean():8.1%} {two.mean():10.1%}"
    )


def draw_image(axis, name, image):
    """Row 1: the image of Eq. 3, its centre and its maximum."""
    axis.imshow(image, cmap="gray", vmin=0)
    px, py = brightest(image)
    axis.plot(CENTRE, CENTRE, "+", color="#1f77b4", ms=11, mew=2, label="centre")
    far = f"maximum, {np.hypot(px, py):.0f} from the centre"
    axis.plot(px + CENTRE, py + CENTRE, "x", color="#d62728", ms=9, mew=2, label=far)
    axis.legend(
        loc="upper center",
        bbox_to_anchor=(0.5, 0.0),
        ncols=2,
        fontsize=9,
        frameon=False,
        handletextpad=0.2,
        columnspacing=1.0,
    )
    axis.set_title(name, fontsize=12)


def draw_depth(axis, equation, found, truth, two):
    """Rows 2 and 3: recovered depth, what was drilled, and the outline of what is two-valued."""
    depths = plt.get_cmap("viridis_r").copy()
    depths.set_bad("#d62728")
    drawn = axis.imshow(np.where(found.drilled, np.nan, found.depth), cmap=depths, vmin=0, vmax=LAYERS)
    if two.any() and not two.all():
        axis.contour(two, [0.5], colors="black", linewidths=1.2)
    rms = np.sqrt(np.mean((found.depth - truth) ** 2))
    axis.set_title(
        f"depth from the image of {equation}: RMSE {rms:.1f},\n{found.drilled.mean():.0%} drilled,"
        f" {two.mean():.0%} two-valued",
        fontsize=10,
    )
    return drawn


def draw_columns(chart, pictures, down, flat, whole):
    """Row 4: luminance down the two columns, which are marked in the pictures above."""
    most = flat.max()
    for (label, (r, c)), colour in zip(COLUMNS.items(), ("#ff7f0e", "#1f77b4")):
        chart.plot(np.arange(LAYERS), down[:, r, c] / most, color=colour, label=f"column {label}")
        chart.axhline(flat[r, c] / most, color=colour, lw=0.8, ls="--")
        chart.plot(whole[r, c], flat[r, c] / most, "o", color=colour)
        for picture in pictures:
            picture.plot(c, r, "o", color=colour, mec="white", ms=6)
            picture.annotate(
                label,
                (c, r),
                (-5, 0),
                textcoords="offset points",
                ha="right",
                va="center",
                color="white",
                weight="bold",
            )
    chart.set(xlabel="depth [layers]", xlim=(0, LAYERS - 1), ylim=(0, None))


def finish(figure, axes, drawn, plane, path):
    """Labels that all columns share, and the file."""
    axes[3, 0].set_ylabel(
        "luminance of Eq. 4, share of the maximum\n(dashed: the image; dot: the truth)", fontsize=9
    )
    axes[3, 0].legend(fontsize=9)
    figure.colorbar(
        drawn,
        ax=axes[1:3, :],
        location="bottom",
        shrink=0.6,
        aspect=40,
        pad=0.01,
        label="depth [layers]; red: drilled; black outline: two-valued columns",
    )
    figure.suptitle(
        f"A slanting plane, depth {plane.min():.0f} (left) to {plane.max():.0f} (right), under a sphere of"
        f" radius {RADIUS:.0f} behind the viewer",
        fontsize=12,
    )
    figure.savefig(path, dpi=90, pil_kwargs={"optimize": True})
    print(f"Wrote {path}.")


def arguments():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=Path("docs"), help="folder of the picture (default: docs)"
    )
    parser.add_argument("--hemicube", type=int, default=33, help="M, odd (default: 33)")
    parser.add_argument(
        "--eps", type=float, default=0.01, help="of carving, a share of the image's maximum (default: 0.01)"
    )
    parser.add_argument("--backend", default="auto")
    return parser.parse_args()


def main():
    options = arguments()
    options.out.mkdir(parents=True, exist_ok=True)
    cube, backend = sl.Hemicube(options.hemicube), options.backend
    plane = np.broadcast_to(MIDDLE + SLOPE * (np.arange(SIZE) - CENTRE), (SIZE, SIZE))
    whole = np.rint(plane)
    # what a point of free space sees of the lamp; its bits do not depend on how the lamp is directed
    space = sl.Scene(np.full((SIZE, SIZE), LAYERS - 1.0))
    free = sl.visibility_field(space, lamp(0), hemicube=cube, backend=backend)
    weights = np.stack([shares(cube, power) for power in POWERS.values()], 1).astype(np.float32)
    down = np.stack([cube.unpack(layer).astype(np.float32) @ weights for layer in free.bits], 0)
    seen = cube.unpack(sl.visibility(sl.Scene(whole), lamp(0), hemicube=cube, backend=backend))

    figure, axes = plt.subplots(4, 3, figsize=(10.5, 14.4), layout="constrained")
    print(
        f"{'lamp':25} {'image':6} {'maximum at':>15} {'distance':>8} {'RMSE':>6} {'kept':>6} {'drilled':>8}"
        f" {'two-valued':>10}"
    )
    for number, (name, power) in enumerate(POWERS.items()):
        shown = sl.render(
            sl.Scene(plane, albedo=ALBEDO),
            lamp(power),
            method="lattice",
            hemicube=options.hemicube,
            filled=True,
            backend=backend,
        ).image
        flat = seen @ weights[:, number]
        draw_image(axes[0, number], name, shown)
        for row, (equation, image, truth) in enumerate((("Eq. 3", shown, plane), ("Eq. 4", flat, whole)), 1):
            found = carved(image, power, cube, options.eps, backend)
            two = two_valued(down[..., number], image)
            print_row(name, equation, image, found, truth, two)
            drawn = draw_depth(axes[row, number], equation, found, truth, two)
        draw_columns(axes[3, number], axes[1:3, number], down[..., number], flat, whole)
        for axis in axes[:3, number]:
            axis.set(xticks=[], yticks=[])
    finish(figure, axes, drawn, plane, options.out / "figure2.png")


if __name__ == "__main__":
    main()
