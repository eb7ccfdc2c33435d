"""The demo: real ground under two skies and a lamp, depth from a picture, and every backend compared."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from rich.table import Column, Table

from .. import io
from ..backends import backends
from ..images import Rendering
from ..inverse.recover import recover
from ..rendering import render
from ..scene import Scene
from ..sources import Lamp, Sky, cie_overcast
from ..visibility import visibility
from . import mosaic, output

# Real ground is gentle: heights are exaggerated so that valleys lose sky.
EXAGGERATION = 4
DEMO_LAMP = (215, 150, -45, 40)  # x, y, z, radius [nodes]
COMPARED_AREA = slice(100, 228), slice(130, 258)  # of the sample terrain, for the comparison of backends
DEMO_STAGES = 6  # three renderings, the relief, its recovery, the comparison


@dataclass
class Pictures:
    """The pictures of the demo: a file each, its caption, and its tones for the panel of all."""

    folder: Path
    silent: bool = False  # whether files are not reported as they are written
    facts: list[dict[str, Any]] = field(default_factory=list)
    tones: list[np.ndarray] = field(default_factory=list)

    def add(self, name: str, image: np.ndarray, low: float, high: float, gamma: float, text: str) -> None:
        """One 8-bit picture: black is low, white is high, ((v - low) / (high - low))^(1 / gamma) between."""
        tone = np.clip((image - low) / (high - low), 0, 1) ** (1 / gamma)
        io.write(self.folder / name, tone, range=(0.0, 1.0))
        self.tones.append(tone)
        range = {"black": float(low), "white": float(high)}
        self.facts.append({"file": name, "shows": text, **range, "gamma": gamma})
        if not self.silent:
            output.message(f"{self.folder / name}: {text}")

    def add_panel(self) -> None:
        """All pictures on one sheet."""
        io.write(self.folder / "panel.png", mosaic.sheet_of(self.tones, 3), range=(0.0, 1.0))
        self.facts.append({"file": "panel.png", "shows": "all of them"})


def demo(
    folder: Path, backend: str, progress: Callable[[int, int], None] | None = None, silent: bool = False
) -> dict[str, Any]:
    """Write the pictures into ``folder``, each reported at once unless ``silent``.

    Returns {out, backend, pictures, seconds, compile_seconds, backends}: the captions of the pictures, the
    seconds of the three renderings, and :func:`compared`.
    """
    stages = iter(range(1, DEMO_STAGES + 1))

    def step() -> None:
        if progress:
            progress(next(stages), DEMO_STAGES)

    pictures = Pictures(folder, silent)
    height, spacing = io.terrain()
    mountains = Scene.from_height(EXAGGERATION * height, spacing=spacing)
    renderings = _mountains(mountains, backend, pictures, step)
    _relief_recovered(backend, pictures, step)
    pictures.add_panel()
    comparison = compared(Scene.from_height(height[COMPARED_AREA], spacing=spacing))
    step()
    return {
        "out": str(folder),
        "backend": renderings[0].backend,
        "pictures": pictures.facts,
        "seconds": [r.seconds for r in renderings],
        "compile_seconds": [r.compile_seconds for r in renderings],
        "backends": comparison,
    }


def _mountains(scene: Scene, backend: str, pictures: Pictures, step: Callable[[], None]) -> list[Rendering]:
    """The terrain under a uniform sky, an overcast one and a low lamp."""
    x, y, z, radius = (scene.spacing * v for v in DEMO_LAMP)
    lamp = Lamp(center=(x, y, z), radius=radius)
    lamp_text = f"a lamp, radius {DEMO_LAMP[3]} nodes, {-DEMO_LAMP[2]} nodes above the highest peak"
    renderings = []
    for name, source, text in (
        ("uniform_sky", Sky(), "uniform sky"),
        ("overcast_sky", Sky(cie_overcast()), "CIE overcast sky"),
        ("low_lamp", lamp, lamp_text),
    ):
        done = render(scene, source, method="horizon", backend=backend)
        renderings.append(done)
        if source is lamp:
            low, high, gamma = 0.0, np.percentile(done.image, 99), 2.2
        else:  # white is what open level ground would send, so that the two skies compare
            flat = Scene(np.zeros((1, 1)))
            level = render(flat, source, method="horizon", backend=backend).image[0, 0]
            low, high, gamma = 0.3 * level, level, 1.0
        text = f"Jacksboro fault, heights x {EXAGGERATION}, under {text}"
        pictures.add(f"jacksboro_x{EXAGGERATION}_{name}.png", done.image, low, high, gamma, text)
        step()
    return renderings


def _relief_recovered(backend: str, pictures: Pictures, step: Callable[[], None]) -> None:
    """Folds in a black box under a uniform sky, the depth recovered from that image, and the true one.

    Direct light alone: with the light between surfaces the recovery would take several times as long.
    """
    depth = relief()
    seen = render(Scene(depth, sides="dark"), Sky(), interreflection=False, backend=backend)
    step()
    recovered = recover(seen.image, Sky(), sides="dark", interreflection=False, backend=backend)
    step()
    error = float(np.sqrt(np.mean((recovered.depth - depth) ** 2)))
    text = "folds in a black box under a uniform sky"
    pictures.add("relief_rendered.png", seen.image, 0.0, seen.image.max(), 1.0, text)
    text = f"depth recovered from that picture, near is bright; RMS error {error:.2g} in a relief of"
    scale = -depth.max(), -depth.min(), 1.0
    pictures.add("relief_recovered.png", -recovered.depth, *scale, f"{text} {np.ptp(depth):.0f}")
    pictures.add("relief_true.png", -depth, *scale, "its true depth, same scale")


def relief() -> np.ndarray:
    """The folds of a drapery, (64, 64) depth in nodes."""
    y, x = np.mgrid[:64, :64] / 63.0
    depth: np.ndarray = 16 + 16 * np.sin(2 * np.pi * (1.6 * x + 0.2 * np.sin(2 * np.pi * y))) ** 2
    return depth


def compared(scene: Scene) -> list[dict[str, Any]]:
    """Every backend on a small scene: seconds of a second call, difference from NumPy."""
    image = render(scene, Sky(), method="lattice", hemicube=9, backend="numpy").image
    bits = visibility(scene, Sky(), hemicube=9, backend="numpy")
    table = []
    for b in backends():
        row = {"name": b.name, "device": b.device, "available": b.available, "why": b.why}
        if b.available:
            _, again = (render(scene, Sky(), method="lattice", hemicube=9, backend=b.name) for _ in range(2))
            row |= {
                "seconds": again.seconds,
                "bits_equal": np.array_equal(visibility(scene, Sky(), hemicube=9, backend=b.name), bits),
                "difference": float(np.abs(again.image - image).max()),
            }
        table.append(row)
    return table


def print_tables(facts: dict[str, Any]) -> None:
    """The pictures and the comparison of backends, on stderr."""
    console = output.console(stderr=True)
    table = Table(
        Column("picture", no_wrap=True),
        "shows",
        "black",
        "white",
        "gamma",
        title=f"Pictures in {facts['out']}, made by {facts['backend']}",
    )
    for picture in facts["pictures"]:
        tones = (f"{picture[k]:.3g}" if k in picture else "" for k in ("black", "white", "gamma"))
        table.add_row(picture["file"], picture["shows"], *tones)
    console.print(table)
    table = Table(
        "backend",
        "device",
        "run [s]",
        "bits as numpy",
        "radiance error",
        title="128 x 128 nodes, 209 directions, beside NumPy",
    )
    for row in facts["backends"]:
        if row["available"]:
            figures = (
                f"{row['seconds']:.4f}",
                "all" if row["bits_equal"] else "NO",
                f"{row['difference']:.1e}",
            )
            table.add_row(row["name"], row["device"], *figures)
        else:
            table.add_row(row["name"], row["why"])
    console.print(table)
