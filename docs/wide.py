"""The wide picture of README: one terrain, heights x 4, under three lights.

python docs/wide.py        # writes docs/wide.png
"""

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import skylamp as sl
from skylamp import io
from skylamp.app import plot

OUT = Path(__file__).resolve().parent / "wide.png"


def main() -> None:
    height, spacing = io.terrain()
    height = 4.0 * height[40:240, 60:360]
    scene = sl.Scene.from_height(height, spacing, albedo=0.4)
    rows, cols = height.shape
    top = -0.2 * spacing * cols
    lamp = sl.Lamp(center=(0.7 * spacing * cols, 0.3 * spacing * rows, top), radius=0.03 * spacing * cols)
    sun = sl.Sky(sl.cie_clear((300.0, 40.0), horizontal=90.0, direct=750.0))
    panels = (
        ("sky-view factor", sl.sky_view_factor(scene)),
        ("clear sky with the sun in the north-west", sl.render(scene, sun).image),
        ("spherical lamp", sl.render(scene, lamp).image),
    )
    figure = Figure(figsize=(12, 2.95), layout="constrained")
    for axes, (title, values) in zip(figure.subplots(1, 3), panels):
        low, high = np.percentile(values, (0.5, 99.5))
        plot.draw_terrain(axes, values, spacing, title, vmin=low, vmax=high)
    figure.savefig(OUT, dpi=100, pil_kwargs={"optimize": True})
    print("wrote", OUT)


if __name__ == "__main__":
    main()
