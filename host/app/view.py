"""`skylamp view`: a page that renders a map while the sun or the lamp is dragged over it.

NiceGUI's image reports the position of the mouse, and each frame returns through the same connection; Panel
would redraw a Bokeh figure. While the mouse moves, every few nodes are rendered in few azimuths; when it
rests, the whole map is rendered within the tolerance.
"""

from __future__ import annotations

import asyncio
import base64
import io as streams
import math
import socket
import traceback
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import imageio.v3 as imageio
import numpy as np

from ..directions import Azimuths
from ..errors import SkylampError, bad, import_extra
from ..images import Rendering
from ..rendering import render
from ..scene import Scene
from ..sources import Lamp, Sky, Source, cie_overcast
from ..sources.cie import cie_clear
from . import plot
from .parsing import INTERREFLECTION, raster_of, values_of, without

COARSE_SIDE = 160  # [node] of the map that is rendered while the mouse moves; twice takes four times as long
COARSE_AZIMUTHS = 8  # in which it is; half of it shows as stripes
REST = 0.35  # [second] without a change after which the whole map is rendered; chosen
CLICK = 4.0  # [pixel of the screen] by which the mouse may move in a click; chosen
# [pixel of the screen], longer side of the picture, and least of the other; chosen
SIDE, LEAST_SIDE = 512, 64
WHITE_PERCENTILE = 99.5  # of an image, which becomes white
GAMMA = 2.2
SOURCES = ("uniform sky", "overcast sky", "clear sky", "lamp")
SUN_LIGHT = 3.0  # irradiance by the sun's disc, beside a zenith of brightness 1; chosen for the eye


@dataclass(frozen=True)
class Settings:
    """Values of the page's controls: lengths in shares of the map's longer side, angles in degrees."""

    source: str = "clear sky"
    azimuth: float = 135.0
    elevation: float = 35.0
    lamp: tuple[float, float] = (0.5, 0.5)
    lamp_height: float = 0.15
    lamp_radius: float = 0.05
    albedo: float = 0.5
    exaggeration: float = 1.0
    tolerance: float = 0.01
    interreflection: str = "off"

    def __post_init__(self) -> None:
        """The page sends 4.0 as 4, and 4 times heights of 16 bits would stay in 16 bits."""
        object.__setattr__(self, "exaggeration", float(self.exaggeration))


@dataclass(frozen=True, eq=False)
class Map:
    """A map of depth or height and the Python lines that read it as ``values``, ``mask`` and ``spacing``."""

    values: np.ndarray
    is_height: bool
    spacing: float
    mask: np.ndarray | None
    lines: tuple[str, ...]

    @cached_property
    def coarse(self) -> tuple[slice, slice]:
        """Rows and columns of the coarse map, in the middle of those that they stand for; a node is valid."""
        stride = max(1, int(max(self.values.shape)) // COARSE_SIDE)
        while True:
            rows, cols = (slice(min(stride // 2, (n - 1) // 2), None, stride) for n in self.values.shape)
            if stride == 1 or self.mask is None or self.mask[rows, cols].any():
                return rows, cols
            stride -= 1

    @cached_property
    def nearest(self) -> float:
        """The highest valid height, or the least valid depth."""
        values = self.values if self.mask is None else self.values[self.mask]
        return float(np.max(values) if self.is_height else np.min(values))


def read(
    file: Path, height: bool | None, spacing: float | None, resample: bool, nodata: float | None = None
) -> Map:
    """The map in a file, without the nodes whose value is ``nodata``. Raises InputError."""
    found = _read(file, height, spacing, resample)
    if nodata is None:
        return found
    number = repr(nodata) if math.isfinite(nodata) else f"float({str(nodata)!r})"
    known = "values == values  # not nan" if math.isnan(nodata) else f"values != {number}"
    lines = *found.lines, f"known = {known}", "mask = known if mask is None else mask & known"
    return replace(found, mask=without(nodata, found.values, found.mask), lines=lines)


def _read(file: Path, height: bool | None, spacing: float | None, resample: bool) -> Map:
    """The whole map in a file."""
    raster = raster_of(file, resample, spacing)
    if raster is not None:
        step = raster.spacing
        call = f"raster = geo.read({str(file)!r}{', resample=True' * resample})"
        parts = f"values, mask, spacing = raster.values, raster.mask, {step!r}"
        lines = "from skylamp import geo", call, parts
        return Map(raster.values, height is not False, step, raster.mask, lines)
    kind, step = "height" if height else "depth", 1.0 if spacing is None else spacing
    values = values_of(file, height, spacing)
    call = f"values, mask, spacing = io.read({str(file)!r}, {kind!r}, scaled=True), None, {step!r}"
    return Map(values, bool(height), step, None, ("from skylamp import io", call))


class Viewer:
    """Renders a map by settings; independent of the page."""

    def __init__(self, ground: Map, backend: str = "auto"):
        self.ground, self.backend = ground, backend
        self._scenes: dict[tuple[Any, ...], Scene] = {}

    def scene(self, settings: Settings, coarse: bool = False) -> Scene:
        """The scene, of every few nodes alone if ``coarse``; the last two are kept."""
        key = settings.exaggeration, settings.albedo, coarse
        if key not in self._scenes:
            ground, nodes = self.ground, self.ground.coarse if coarse else np.s_[::1, ::1]
            make = Scene.from_height if ground.is_height else Scene
            mask, values = None if ground.mask is None else ground.mask[nodes], ground.values[nodes]
            if coarse and ground.is_height:  # counted from the highest of all nodes, as the lamp is
                make, values = Scene, ground.nearest - values.astype(float)
            kept = [(k, s) for k, s in self._scenes.items() if k[2] != coarse]
            self._scenes = dict(kept)
            spacing = nodes[0].step * ground.spacing
            self._scenes[key] = make(settings.exaggeration * values, spacing, settings.albedo, mask)
        return self._scenes[key]

    def source(self, settings: Settings, coarse: bool = False) -> Source:
        """The source, over the scene of these settings."""
        if settings.source == "uniform sky":
            return Sky()
        if settings.source == "overcast sky":
            return Sky(cie_overcast())
        if settings.source == "clear sky":
            return Sky(cie_clear((settings.azimuth, settings.elevation), direct=SUN_LIGHT))
        x, y, z = self._center(settings)
        if coarse:  # counted from the first node of the coarse map
            x, y = (at - s.start * self.ground.spacing for at, s in zip((x, y), self.ground.coarse[::-1]))
        return Lamp(center=(x, y, z), radius=self._length(settings.lamp_radius))

    def _length(self, share: float) -> float:
        """[unit of spacing]."""
        return _short(share * float(max(self.ground.values.shape)) * self.ground.spacing)

    def _center(self, settings: Settings) -> tuple[float, float, float]:
        """The lamp's centre, so far above the highest node that it stands clear of it."""
        rows, cols = self.ground.values.shape
        x, y = (_short(at * n * self.ground.spacing) for at, n in zip(settings.lamp, (cols, rows)))
        least = 0.0 if self.ground.is_height else settings.exaggeration * self.ground.nearest
        return x, y, _short(least - self._length(settings.lamp_height + settings.lamp_radius))

    def coarse(self, settings: Settings) -> Rendering:
        """A quick image of every few nodes."""
        scene, source = self.scene(settings, True), self.source(settings, True)
        azimuths: Any = COARSE_AZIMUTHS
        if isinstance(source, Sky):  # even ones: to place them by brightness takes a third of the time
            azimuths = Azimuths(COARSE_AZIMUTHS)
        return render(scene, source, "horizon", backend=self.backend, azimuths=azimuths)

    def refined(self, settings: Settings) -> Rendering:
        """The image within the tolerance."""
        between: Any = INTERREFLECTION[settings.interreflection]
        scene, source = self.scene(settings), self.source(settings)
        return render(scene, source, "auto", settings.tolerance, self.backend, interreflection=between)

    def tones(self, image: np.ndarray) -> np.ndarray:
        """(rows, cols) uint8 of the whole map's shape."""
        white = float(np.nanpercentile(image, WHITE_PERCENTILE)) or 1.0
        shown = np.rint(255 * np.nan_to_num(np.clip(image / white, 0, 1)) ** (1 / GAMMA)).astype(np.uint8)
        if image.shape == self.ground.values.shape:
            return shown
        stride = self.ground.coarse[0].step
        at = (
            np.minimum(np.arange(n) // stride, here - 1)
            for n, here in zip(self.ground.values.shape, image.shape)
        )
        tones: np.ndarray = shown[np.ix_(*at)]
        return tones

    def code(self, settings: Settings) -> str:
        """Python lines that make the refined image."""
        make = "sl.Scene.from_height" if self.ground.is_height else "sl.Scene"
        if settings.source == "lamp":
            source = f"sl.Lamp(center={self._center(settings)}, radius={self._length(settings.lamp_radius)})"
        elif settings.source == "clear sky":
            sun = f"({settings.azimuth}, {settings.elevation})"
            source = f"sl.Sky(sl.cie_clear({sun}, direct={SUN_LIGHT}))"
        else:
            source = "sl.Sky()" if settings.source == "uniform sky" else "sl.Sky(sl.cie_overcast())"
        between = INTERREFLECTION[settings.interreflection]
        call = f"tolerance={settings.tolerance}, interreflection={between!r}, backend={self.backend!r}"
        return "\n".join(
            [
                "import skylamp as sl",
                *self.ground.lines,
                f"scene = {make}({settings.exaggeration} * values, spacing, {settings.albedo}, mask)",
                f"source = {source}",
                f"image = sl.render(scene, source, {call}).image",
            ]
        )

    def horizon_plot(self, settings: Settings, row: int, col: int) -> bytes:
        """A PNG of the sky above a node."""
        source = self.source(settings)
        sky = source if isinstance(source, Sky) else Sky()
        buffer = streams.BytesIO()
        plot.horizon(self.scene(settings), row, col, sky, backend=self.backend).savefig(buffer, dpi=80)
        return buffer.getvalue()


def _short(length: float) -> float:
    """With as many digits as a reader wants, whatever the unit is."""
    return float(f"{length:.9g}")


def data_url(content: bytes, kind: str) -> str:
    """``content`` as a source of an image element."""
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


class Page:
    """One visitor's page: controls, picture and text, and the loop that renders them."""

    def __init__(self, viewer: Viewer, ui: Any, run: Any):
        self.viewer, self.ui, self.run = viewer, ui, run
        self.settings, self.image = Settings(), np.zeros((1, 1), np.uint8)
        self.changed = asyncio.Event()
        self.pressed: tuple[float, float] | None = None  # where the button went down [pixel of the screen]
        self.dragged = False  # since the button was pressed: a drag may end where it began
        self.node: tuple[float, float] | None = None  # whose horizon is shown, (x, y)
        self.frames, self.running = 0, False
        rows, cols = viewer.ground.values.shape
        # width and height of the picture [pixel of the screen]
        self.side = [max(LEAST_SIDE, SIDE * n / max(rows, cols)) for n in (cols, rows)]
        with ui.row().classes("w-full no-wrap"):
            with ui.column():
                events = ["mousedown", "mousemove", "mouseup"]
                self.picture = ui.interactive_image(
                    size=(cols, rows), on_mouse=self._mouse, events=events, cross=False
                )
                width, height = self.side
                self.picture.classes("picture")
                self.picture.style(f"width: {width:.0f}px; height: {height:.0f}px; touch-action: none")
                self.status = ui.label("rendering").classes("status")
                self.plan = ui.label("").style(f"max-width: {SIDE}px")
                self.horizon = ui.image().style(f"width: {SIDE}px")
                self.horizon.set_visibility(False)
            with ui.column().style("min-width: 22em"):
                self._controls()
                self.code = ui.code("", language="python").classes("w-full")
        self.client = ui.context.client
        self.client.on_connect(self._loop)

    def _controls(self) -> None:
        ui, settings = self.ui, self.settings
        ui.label("Drag over the map: the sun or the lamp. Click a node: its horizon.")
        self._select("source", list(SOURCES), settings.source)
        for name, low, high, step in (
            ("albedo", 0.05, 1.0, 0.05),
            ("exaggeration", 0.5, 8.0, 0.5),
            ("lamp_height", 0.01, 0.5, 0.01),
            ("lamp_radius", 0.01, 0.3, 0.01),
        ):
            ui.label(name.replace("_", " "))
            value = getattr(settings, name)
            ui.slider(min=low, max=high, step=step, value=value, on_change=self._set(name)).props("label")
        self._select("tolerance", {0.03: "3 %", 0.01: "1 %", 0.003: "0.3 %"}, settings.tolerance)
        between = ["off", "auto", "on"]
        self._select("interreflection", between, settings.interreflection, "light between surfaces")
        ui.button("Save image", on_click=self._save).classes("save")
        ui.button("Save Python", on_click=self._save_code)

    def _select(self, name: str, options: Any, value: Any, label: str = "") -> None:
        box = self.ui.select(options, value=value, label=label or name, on_change=self._set(name))
        box.classes("w-full")

    def _set(self, name: str) -> Any:
        def change(event: Any) -> None:
            self._ask(replace(self.settings, **{name: event.value}))

        return change

    def _ask(self, settings: Settings) -> None:
        self.settings = settings
        self.changed.set()

    def _mouse(self, event: Any) -> None:
        """Press and move: the sun or the lamp follows. Press and release at one place: the node's horizon."""
        at = event.image_x, event.image_y  # [node]
        rows, cols = self.viewer.ground.values.shape
        place = at[0] / cols * self.side[0], at[1] / rows * self.side[1]
        if event.type == "mousedown":
            self.pressed, self.dragged = place, False
        elif self.pressed is None:
            return
        elif event.type == "mouseup":
            self.pressed = None
            if not self.dragged:
                self.ui.timer(0.01, lambda: self._show_horizon(*at), once=True)
        elif event.buttons and (self.dragged or math.dist(place, self.pressed) > CLICK):
            self.dragged = True
            self._ask(self._moved(*at))

    def _moved(self, x: float, y: float) -> Settings:
        """With the lamp at a place, or the sun in its direction from the middle, in the zenith there."""
        rows, cols = self.viewer.ground.values.shape
        if self.settings.source == "lamp":
            return replace(self.settings, lamp=(round(x / cols, 4), round(y / rows, 4)))
        east, north = x - cols / 2, rows / 2 - y
        away = math.hypot(east, north) / (min(rows, cols) / 2)
        return replace(
            self.settings,
            azimuth=round(math.degrees(math.atan2(east, north)) % 360, 1),
            elevation=round(90 * max(0.01, 1 - away), 1),
        )

    async def _loop(self) -> None:
        """Frames while settings change, the refined image when they rest: one render at a time."""
        if self.running:  # a browser that connects again
            return
        self.running, task = True, asyncio.current_task()
        assert task is not None, "NiceGUI runs what a connection begins as a task"
        self.client.on_delete(lambda: task.cancel())  # the browser is gone for good
        await self._refine(self.settings)
        while True:
            await self.changed.wait()
            self.changed.clear()
            await self._frame(self.settings)
            try:
                await asyncio.wait_for(self.changed.wait(), REST)
            except TimeoutError:
                await self._refine(self.settings)

    async def _frame(self, settings: Settings) -> None:
        if (done := await self._shown(self.viewer.coarse, settings)) is None:
            return
        self.frames += 1
        self.status.set_text(f"frame {self.frames}: {1000 * done.seconds:.0f} ms, every"
                             f" {self.viewer.ground.coarse[0].step} nodes")  # fmt: skip

    async def _refine(self, settings: Settings) -> None:
        if (done := await self._shown(self.viewer.refined, settings)) is None:
            return
        assert done.error is not None, "an image within a tolerance has an error"
        error = float(np.sqrt(np.nanmean(np.square(done.error)))) / float(np.nanmean(done.image))
        self.status.set_text(f"refined: {1000 * done.seconds:.0f} ms by {done.backend}, estimated error"
                             f" {100 * error:.2g} %")  # fmt: skip
        self.plan.set_text("; ".join([done.plan.line, *done.warnings]))
        self.code.set_content(self.viewer.code(settings))
        if self.node is not None:
            await self._show_horizon(*self.node)

    async def _shown(self, rendered: Any, settings: Settings) -> Rendering | None:
        """The rendering, once its picture is on the page; None where it fails, or the server ends."""

        def drawn() -> tuple[Rendering, np.ndarray, bytes]:
            done = rendered(settings)
            image = self.viewer.tones(np.asarray(done.image))
            return done, image, imageio.imwrite("<bytes>", image, extension=".jpg", quality=85)

        shown: tuple[Rendering, np.ndarray, bytes] | None = await self._done(drawn)
        if shown is None:
            return None
        done, self.image, encoded = shown
        self.picture.set_source(data_url(encoded, "jpeg"))
        return done

    async def _show_horizon(self, x: float, y: float) -> None:
        rows, cols = self.viewer.ground.values.shape
        row, col = min(rows - 1, max(0, int(y))), min(cols - 1, max(0, int(x)))
        drawn = await self._done(self.viewer.horizon_plot, self.settings, row, col)
        self.node = None if drawn is None else (x, y)
        self.horizon.set_visibility(drawn is not None)
        if drawn is not None:
            self.horizon.set_source(data_url(drawn, "png"))

    async def _done(self, work: Callable[..., Any], *arguments: Any) -> Any:
        """What ``work`` returns; None where it fails, which the page says, or the server ends."""
        try:
            return await self.run.io_bound(work, *arguments)
        except Exception as error:  # the page goes on
            self.status.set_text(str(error) or type(error).__name__)
            if not isinstance(error, SkylampError):
                traceback.print_exc()
            return None

    def _save(self) -> None:
        self.ui.download(imageio.imwrite("<bytes>", self.image, extension=".png"), "skylamp.png")

    def _save_code(self) -> None:
        self.ui.download(self.viewer.code(self.settings).encode(), "skylamp_image.py")


def check_port(port: int) -> None:
    """InputError where another program listens on this port, or it is not allowed to this user."""
    try:
        socket.create_server(("127.0.0.1", port)).close()
    except OSError as error:
        raise bad("--port", f"{port} ({error.strerror})", "a port that is free") from None


def imported() -> Any:
    """NiceGUI. Raises InputError without it."""
    return import_extra("skylamp view", "nicegui", "view", "nicegui")[0]


def serve(viewer: Viewer, port: int, opens: bool) -> None:
    """Serve the page on this machine until it is interrupted. Raises InputError without NiceGUI."""
    nicegui = imported()

    @nicegui.ui.page("/")  # type: ignore[untyped-decorator]
    def page() -> None:
        Page(viewer, nicegui.ui, nicegui.run)

    nicegui.ui.run(
        host="127.0.0.1", port=port, show=opens, reload=False, title="skylamp", show_welcome_message=False
    )
