"""The options of the command line: type, help text and metavar of each."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Literal

import typer

from . import output

argument, unset = (partial(made, show_default=False) for made in (typer.Argument, typer.Option))

# -- of several commands
File = Annotated[
    Path,
    argument(
        metavar="INPUT",
        help="Depth, or height with --height: .npy, .npz, grey .png, .tif or .exr; a GeoTIFF holds height",
    ),
]
Target = Annotated[str | None, argument(metavar="OUTPUT", help="Output file, the same as --out")]
Out = Annotated[
    str | None,
    unset(
        "--out",
        help=".npy, .npz, .tif, .png, .exr or .hdr; - writes .npy to stdout; a GeoTIFF's .tif is one too",
    ),
]
MaybeOut = Annotated[
    str | None,
    unset("--out", help=".npy, .npz, .tif or .exr, or .png for one plane; - writes .npy to stdout"),
]
Height = Annotated[
    bool | None,
    unset(
        "--height/--depth",
        help=(
            "Content of the file: height (larger is nearer to the viewer) or depth  [default: depth, height"
            " in a GeoTIFF]"
        ),
    ),
]
Spacing = Annotated[
    float | None,
    unset(help="Distance between neighbouring nodes, in the unit of depth  [default: 1, a GeoTIFF: its own]"),
]
Resample = Annotated[
    bool,
    typer.Option("--resample", help="GeoTIFF: resample to square cells, for example from cells in degrees"),
]
Albedo = Annotated[float, typer.Option(help="Diffuse reflectance, 0 to 1")]
Albedos = Annotated[
    str, typer.Option(metavar="A|R,G,B", help="Diffuse reflectance, 0 to 1; in colour with three numbers")
]
Specular = Annotated[
    str | None,
    unset(metavar="S|R,G,B", help="Specular albedo of a lobe about the mirror direction, 0 to 1 - albedo"),
]
Exponent = Annotated[
    float | None, unset(help="Phong's exponent of that lobe; inf is an ideal mirror  [default: 20]")
]
Nodata = Annotated[float | None, unset(help="Leave out nodes of this value (a number, or nan)")]
Source = Annotated[
    str | None,
    unset(
        help=(
            "sky | overcast | clear | cie1 to cie15 | lamp | window | FILE, an environment map, as luminance"
            "  [default: lamp with --lamp, window with --window, else sky]"
        )
    ),
]
Lamp = Annotated[
    str | None, unset(metavar="X,Y,Z,R", help="Centre and radius of a spherical lamp, in the unit of spacing")
]
Window = Annotated[
    str | None, unset(metavar="X0,X1,Y0,Y1", help="Rectangle in the plane z = 0, in the unit of spacing")
]
Sun = Annotated[
    str | None,
    unset(
        metavar="AZ,EL | TIME,LAT,LON",
        help=(
            "Position of the sun, for clear and cie skies: degrees clockwise from the map's north and above"
            " the horizon, or 2026-06-21T12:00Z and degrees north and east"
        ),
    ),
]
Sides = Annotated[Literal["open", "dark", "periodic"], typer.Option(help="Surroundings of the map")]
Backend = Annotated[str, typer.Option(help="auto, or a name from `skylamp backends`")]
Hemicube = Annotated[int, typer.Option(help="Nodes along an edge of the cube of directions, odd")]
Tolerance = Annotated[str, typer.Option(help="Largest relative RMS error, with --method auto: 0.01 or 1%")]
RenderTolerance = Annotated[
    str | None,
    unset(
        help="Largest relative RMS error, with --method auto and of light between surfaces: 0.01 or 1%; 1%"
        " unless given"
    ),
]
Plot = Annotated[Path | None, unset("--plot", help="Draw a picture: .png, .svg or .pdf")]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout")]
Quiet = Annotated[
    bool, typer.Option("--quiet", "-q", callback=output.be_quiet, help="Print warnings and errors only")
]

# -- of render
Direct = Annotated[
    float,
    typer.Option(
        help="Direct normal irradiance of the sun (DNI), of a clear or CIE sky; in one unit with DHI"
    ),
]
Horizontal = Annotated[
    float | None,
    unset(
        help=(
            "Diffuse horizontal irradiance (DHI) of a clear or CIE sky, such as 90 W/m2  [default: that of a"
            " sky with brightness 1 at the zenith]"
        )
    ),
]
Method = Annotated[
    Literal["auto", "lattice", "horizon", "unoccluded"], typer.Option(help="Method of rendering")
]
LatticeHemicube = Annotated[
    int | None, unset(help="Lattice: nodes along an edge of the cube of directions, odd")
]
Filled = Annotated[
    bool | None,
    unset(
        "--filled/--stride",
        help="Lattice: test the surface between the nodes too, or only at the nodes, as in the paper",
    ),
]
Quantity = Annotated[Literal["radiance", "irradiance"], typer.Option(help="Quantity of the image")]
Interreflection = Annotated[Literal["auto", "on", "off"], typer.Option(help="Light between surfaces")]
PngWhite = Annotated[
    float | None, unset(help="PNG: the value that becomes white  [default: the maximum of the image]")
]
Bits = Annotated[int, typer.Option(help="PNG: 8 or 16")]
Exposure = Annotated[
    float | None, unset(help="PNG for display: image x 2^exposure in 8-bit sRGB; 1 becomes white")
]
ErrorFile = Annotated[
    str | None,
    unset(
        "--error",
        metavar="FILE",
        help="File for the estimated error of every pixel, in the unit of the image; requires a tolerance",
    ),
]

# -- of plan
Tail = Annotated[
    str | None, unset(help="Bound on the 99.9th percentile of the error  [default: ten tolerances]")
]

# -- of recover
Image = Annotated[
    Path, argument(metavar="INPUT", help="Image of radiance: .npy, .npz, .exr, grey .png or .tif")
]
RecoverMethod = Annotated[
    Literal["robust", "paper"],
    typer.Option(help="robust: the surface whose image is nearest to this one | paper: carving"),
]
Near = Annotated[float | None, unset(help="robust: the least depth  [default: 0]")]
Far = Annotated[float | None, unset(help="robust: the greatest depth  [default: layers x spacing]")]
MaxSeconds = Annotated[
    float | None, unset(help="robust: end the search after this time, with the best surface so far")
]
RecoveryPicture = Annotated[
    str | None,
    unset(
        help="robust: PNG of image, relief, confidence and residual, without scales  [default: beside OUT]"
    ),
]
ImageMask = Annotated[
    Path | None, unset("--mask", metavar="FILE", help="robust: image, 0 where INPUT does not count")
]
StdFile = Annotated[
    str | None,
    unset(
        "--std",
        metavar="FILE",
        help="robust: file for the standard deviation of depth at every pixel, in the unit of spacing",
    ),
]
Layers = Annotated[int, typer.Option(help="Greatest depth, in spacings; with paper, the layers to carve")]
Eps = Annotated[
    float,
    typer.Option(
        help="paper: a column stops within this difference of the image, as a share of the image's maximum"
    ),
]
Stop = Annotated[
    Literal["eps", "sign"],
    typer.Option(
        help="paper: a column stops within eps of the image, or when it becomes darker than the image (sign)"
    ),
]
CountWhite = Annotated[
    float | None, unset(help="Radiance of a full-scale count, for linear counts that skylamp did not write")
]

# -- of horizon
What = Annotated[
    Literal["sky-view-factor", "openness", "negative-openness", "slopes"],
    typer.Option(help="Quantity of the map; slopes are (azimuths, rows, cols)"),
]
Definition = Annotated[
    Literal["tilted", "horizontal", "solid_angle"], typer.Option(help="Definition of the sky-view factor")
]
Azimuths = Annotated[int, typer.Option(help="Number of directions in which horizons are searched")]
FixedAzimuths = Annotated[
    int | None,
    unset("--azimuths", help="Number of directions in which horizons are searched, instead of a tolerance"),
]
MaxDistance = Annotated[
    float | None,
    unset(help="Radius of the search for horizons, in the unit of spacing  [default: the whole map]"),
]
Memory = Annotated[
    str | None,
    unset(help="Compute a GeoTIFF tile by tile, in this much memory for all workers together, such as 8GB"),
]
Workers = Annotated[int, typer.Option(help="With --memory: number of processes, for example one per GPU")]
Scheduler = Annotated[
    str | None,
    unset(metavar="ADDRESS", help="Workers of a Dask cluster, tcp://host:port, instead of --memory"),
]
Tile = Annotated[
    int | None,
    unset(
        help="With --memory: nodes along a side of a tile, a multiple of 128  [default: 8192, or fewer if"
        " memory requires it]"
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="With --memory: continue an interrupted run")]
Cog = Annotated[bool, typer.Option("--cog", help="With --memory: write a cloud-optimized GeoTIFF")]
At = Annotated[str | None, unset(metavar="ROW,COL", help="Node that --plot shows")]
PlotSky = Annotated[
    str, typer.Option(help="Sky that --plot shows: sky | overcast | clear | cie1 to cie15 | FILE")
]

# -- of field
FieldLayers = Annotated[
    int | None, unset(help="Layers of free space, from z = 0  [default: down to the deepest node]")
]
Layer = Annotated[int | None, unset(help="Write only this layer, (rows, cols)")]
Row = Annotated[int | None, unset(help="Row of the section that --plot shows  [default: the middle one]")]

# -- of chart and demo
ChartFolder = Annotated[
    Path, unset(help="Folder for chart.png (needs matplotlib) and chart.csv; created if missing")
]
Backends = Annotated[str, unset(help="Names, separated by commas  [default: all available]")]
Sizes = Annotated[str, typer.Option(help="Rows and columns of the maps")]
DemoFolder = Annotated[Path, unset(help="Folder for the pictures; created if missing")]

# -- of view
Port = Annotated[int, typer.Option(min=1, max=65535, help="Port of this machine")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser")]
