"""The paper's Fig. 2: a slanting plane under a spherical lamp behind the viewer, more and more directed; its
image, and depth from it.

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
    """Where the luminance down a free column crosses the image's value twice, more than four layers apart
    (rows, cols).
    """
    brighter = columns > image
    crossing = brighter[1:] != brighter[:-1]
    return crossing.any(0) & (len(crossing) - 1 - crossing[::-1].argmax(0) - crossing.argmax(0) > 4)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--out", type=Path, default=Path("docs"), help="folder of the picture (default: docs)"
    )
    parser.add_argument("--hemicube", type=int, default=33, help="M, odd (default: 33)")
    parser.add_argument(
        "--eps", type=float, default=0.01, help="of carving, a share of the image's maximum (default: 0.01)"
    )
    parser.add_argument("--backend", default="auto")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    cube, backend = sl.Hemicube(options.hemicube), options.backend

    x = np.arange(SIZE) - CENTRE
    plane = np.broadcast_to(MIDDLE + SLOPE * x, (SIZE, SIZE))
    whole = np.rint(plane)
    # what a point of free space sees of the lamp; its bits do not depend on how the lamp is directed
    free = sl.visibility_field(
        sl.Scene(np.full((SIZE, SIZE), LAYERS - 1.0)), lamp(0), hemicube=cube, backend=backend
    )
    weights = np.stack([shares(cube, power) for power in POWERS.values()], 1).astype(np.float32)
    down = np.stack([cube.unpack(layer).astype(np.float32) @ weights for layer in free.bits], 0)
    seen = cube.unpack(sl.visibility(sl.Scene(whole), lamp(0), hemicube=cube, backend=backend))

    figure, axes = plt.subplots(4, 3, figsize=(10.5, 14.4), layout="constrained")
    depths = plt.get_cmap("viridis_r").copy()
    depths.set_bad("#d62728")
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
        for row, (equation, image, truth) in enumerate((("Eq. 3", shown, plane), ("Eq. 4", flat, whole)), 1):
            found = sl.recover(
                image,
                lamp(power),
                albedo=ALBEDO,
                sides="open",
                layers=LAYERS,
                hemicube=cube,
                method="paper",
                eps=options.eps,
                backend=backend,
            )
            error, two = found.depth - truth, two_valued(down[..., number], image)
            rms, kept = (np.sqrt(np.mean(error[w] ** 2)) for w in (np.full(two.shape, True), ~found.drilled))
            px, py = brightest(image)
            print(
                f"{name:25} {equation:6} {f'({px:+.1f}, {py:+.1f})':>15} {np.hypot(px, py):8.1f} {rms:6.2f}"
                f" {kept:6.2f} {found.drilled.mean():8.1%} {two.mean():10.1%}"
            )
            drawn = axes[row, number].imshow(
                np.where(found.drilled, np.nan, found.depth), cmap=depths, vmin=0, vmax=LAYERS
            )
            if two.any() and not two.all():
                axes[row, number].contour(two, [0.5], colors="black", linewidths=1.2)
            axes[row, number].set_title(
                f"depth from the image of {equation}: RMSE {rms:.1f},\n{found.drilled.mean():.0%} drilled,"
                f" {two.mean():.0%} two-valued",
                fontsize=10,
            )
        top = axes[0, number]
        top.imshow(shown, cmap="gray", vmin=0)
        px, py = brightest(shown)
        top.plot(CENTRE, CENTRE, "+", color="#1f77b4", ms=11, mew=2, label="centre")
        top.plot(
            px + CENTRE,
            py + CENTRE,
            "x",
            color="#d62728",
            ms=9,
            mew=2,
            label=f"maximum, {np.hypot(px, py):.0f} from the centre",
        )
        top.legend(
            loc="upper center",
            bbox_to_anchor=(0.5, 0.0),
            ncols=2,
            fontsize=9,
            frameon=False,
            handletextpad=0.2,
            columnspacing=1.0,
        )
        top.set_title(name, fontsize=12)
        chart = axes[3, number]
        for (label, (r, c)), colour in zip(COLUMNS.items(), ("#ff7f0e", "#1f77b4")):
            chart.plot(
                np.arange(LAYERS), down[:, r, c, number] / flat.max(), color=colour, label=f"column {label}"
            )
            chart.axhline(flat[r, c] / flat.max(), color=colour, lw=0.8, ls="--")
            chart.plot(whole[r, c], flat[r, c] / flat.max(), "o", color=colour)
            for picture in axes[1:3, number]:
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
        for axis in axes[:3, number]:
            axis.set(xticks=[], yticks=[])
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
    figure.savefig(options.out / "figure2.png", dpi=90, pil_kwargs={"optimize": True})
    print(f"Wrote {options.out / 'figure2.png'}.")


if __name__ == "__main__":
    main()
