"""The options of the command line: type, help text and metavar of each."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

from . import output

# -- of several commands
File = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT",
        help="Depth, or height with --height: .npy, .npz, grey .png, .tif or .exr; a GeoTIFF holds height",
        show_default=False,
    ),
]
Target = Annotated[
    str | None,
    typer.Argument(metavar="OUTPUT", help="Output file, the same as --out", show_default=False),
]
Out = Annotated[
    str | None,
    typer.Option(
        "--out",
        help=".npy, .npz, .tif, .png, .exr or .hdr; - writes .npy to stdout; a .tif from a GeoTIFF is one",
        show_default=False,
    ),
]
MaybeOut = Annotated[
    str | None,
    typer.Option(
        "--out",
        help=".npy, .npz, .tif or .exr, or .png for one plane; - writes .npy to stdout",
        show_default=False,
    ),
]
Height = Annotated[
    bool | None,
    typer.Option(
        "--height/--depth",
        help=(
            "Content of the file: height (larger is nearer to the viewer) or depth  [default: depth, height"
            " in a GeoTIFF]"
        ),
        show_default=False,
    ),
]
Spacing = Annotated[
    float | None,
    typer.Option(
        help="Distance between neighbouring nodes, in the unit of depth  [default: 1, a GeoTIFF: its own]",
        show_default=False,
    ),
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
    typer.Option(
        metavar="S|R,G,B",
        help="Specular albedo of a lobe about the mirror direction, 0 to 1 - albedo",
        show_default=False,
    ),
]
Exponent = Annotated[
    float | None,
    typer.Option(
        help="Phong's exponent of that lobe; inf is an ideal mirror  [default: 20]", show_default=False
    ),
]
Nodata = Annotated[
    float | None, typer.Option(help="Leave out nodes of this value (a number, or nan)", show_default=False)
]
Source = Annotated[
    str | None,
    typer.Option(
        help=(
            "sky | overcast | clear | cie1 to cie15 | lamp | window | FILE, an environment map  [default:"
            " lamp with --lamp, window with --window, else sky]"
        ),
        show_default=False,
    ),
]
Lamp = Annotated[
    str | None,
    typer.Option(
        metavar="X,Y,Z,R",
        help="Centre and radius of a spherical lamp, in the unit of spacing",
        show_default=False,
    ),
]
Window = Annotated[
    str | None,
    typer.Option(
        metavar="X0,X1,Y0,Y1", help="Rectangle in the plane z = 0, in the unit of spacing", show_default=False
    ),
]
Sun = Annotated[
    str | None,
    typer.Option(
        metavar="AZ,EL | TIME,LAT,LON",
        help=(
            "Position of the sun, for clear and cie skies: degrees clockwise from north and above the"
            " horizon, or 2026-06-21T12:00Z and degrees north and east"
        ),
        show_default=False,
    ),
]
Sides = Annotated[Literal["open", "dark", "periodic"], typer.Option(help="Surroundings of the map")]
Backend = Annotated[str, typer.Option(help="auto, or a name from `skylamp backends`")]
Hemicube = Annotated[int, typer.Option(help="Nodes along an edge of the cube of directions, odd")]
Tolerance = Annotated[str, typer.Option(help="Largest relative RMS error, with --method auto: 0.01 or 1%")]
Plot = Annotated[
    Path | None, typer.Option("--plot", help="Draw a picture: .png, .svg or .pdf", show_default=False)
]
Json = Annotated[bool, typer.Option("--json", help="Print one JSON object on stdout")]
Quiet = Annotated[
    bool,
    typer.Option(
        "--quiet",
        "-q",
        callback=output.be_quiet,
        help="Print warnings and errors only",
    ),
]
Verbose = Annotated[
    bool,
    typer.Option(
        "--verbose", "-v", callback=output.be_verbose, help="Print messages of compilers and drivers too"
    ),
]

# -- of render
Direct = Annotated[
    float,
    typer.Option(help="Direct normal irradiance of the sun, for a sky with brightness 1 at the zenith"),
]
Method = Annotated[
    Literal["auto", "lattice", "horizon", "unoccluded"], typer.Option(help="Method of rendering")
]
LatticeHemicube = Annotated[
    int | None,
    typer.Option(help="Lattice: nodes along an edge of the cube of directions, odd", show_default=False),
]
Filled = Annotated[
    bool | None,
    typer.Option(
        "--filled/--stride",
        help="Lattice: test the surface between the nodes too, or only at the nodes, as in the paper",
        show_default=False,
    ),
]
Quantity = Annotated[Literal["radiance", "irradiance"], typer.Option(help="Quantity of the image")]
Interreflection = Annotated[Literal["auto", "on", "off"], typer.Option(help="Light between surfaces")]
PngWhite = Annotated[
    float | None,
    typer.Option(
        help="PNG: the value that becomes white  [default: the maximum of the image]", show_default=False
    ),
]
Bits = Annotated[int, typer.Option(help="PNG: 8 or 16")]
Exposure = Annotated[
    float | None,
    typer.Option(
        help="PNG for display: image x 2^exposure in 8-bit sRGB; 1 becomes white", show_default=False
    ),
]
ErrorFile = Annotated[
    str | None,
    typer.Option(
        "--error",
        metavar="FILE",
        help=("File for the estimated error of every pixel, in the unit of the image; requires a tolerance"),
        show_default=False,
    ),
]

# -- of plan
Tail = Annotated[
    str | None,
    typer.Option(
        help="Bound on the 99.9th percentile of the error  [default: ten tolerances]", show_default=False
    ),
]

# -- of recover
Image = Annotated[
    Path,
    typer.Argument(
        metavar="INPUT", help="Image of radiance: .npy, .npz, grey .png or .tif", show_default=False
    ),
]
NodeSpacing = Annotated[float, typer.Option(help="Distance between neighbouring nodes")]
RecoverMethod = Annotated[
    Literal["robust", "paper"],
    typer.Option(help="robust: the surface whose image is nearest to this one | paper: carving"),
]
Near = Annotated[float | None, typer.Option(help="robust: the least depth  [default: 0]", show_default=False)]
Far = Annotated[
    float | None,
    typer.Option(help="robust: the greatest depth  [default: layers x spacing]", show_default=False),
]
MaxSeconds = Annotated[
    float | None,
    typer.Option(help="robust: stop after this time and return the best surface so far", show_default=False),
]
RecoveryPicture = Annotated[
    str | None,
    typer.Option(
        help="robust: PNG of image, relief, confidence and residual, without scales  [default: beside OUT]",
        show_default=False,
    ),
]
StdFile = Annotated[
    str | None,
    typer.Option(
        "--std",
        metavar="FILE",
        help="robust: file for the standard deviation of depth at every pixel, in the unit of spacing",
        show_default=False,
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
    float | None,
    typer.Option(
        help="Radiance of a full-scale count, for integer files that skylamp did not write",
        show_default=False,
    ),
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
MaxDistance = Annotated[
    float | None,
    typer.Option(
        help="Radius of the search for horizons, in the unit of spacing  [default: the whole map]",
        show_default=False,
    ),
]
Memory = Annotated[
    str | None,
    typer.Option(
        help="Compute a GeoTIFF tile by tile, in this much memory for all workers together, such as 8GB",
        show_default=False,
    ),
]
Workers = Annotated[int, typer.Option(help="With --memory: number of processes, for example one per GPU")]
Scheduler = Annotated[
    str | None,
    typer.Option(
        metavar="ADDRESS",
        help="Workers of a Dask cluster, tcp://host:port, instead of --memory",
        show_default=False,
    ),
]
Tile = Annotated[
    int | None,
    typer.Option(
        help="With --memory: nodes along a side of a tile  [default: 8192, or fewer if memory requires it]",
        show_default=False,
    ),
]
Resume = Annotated[bool, typer.Option("--resume", help="With --memory: continue an interrupted run")]
Cog = Annotated[bool, typer.Option("--cog", help="With --memory: write a cloud-optimized GeoTIFF")]
At = Annotated[str | None, typer.Option(metavar="ROW,COL", help="Node that --plot shows", show_default=False)]
PlotSky = Annotated[
    str, typer.Option(help="Sky that --plot shows: sky | overcast | clear | cie1 to cie15 | FILE")
]

# -- of field
FieldLayers = Annotated[
    int | None,
    typer.Option(
        help="Layers of free space, from z = 0  [default: down to the deepest node]", show_default=False
    ),
]
Layer = Annotated[int | None, typer.Option(help="Write only this layer, (rows, cols)", show_default=False)]
Row = Annotated[
    int | None,
    typer.Option(help="Row of the section that --plot shows  [default: the middle one]", show_default=False),
]

# -- of chart and demo
ChartFolder = Annotated[
    Path,
    typer.Option(
        help="Folder for chart.png (needs matplotlib) and chart.csv; created if missing",
        show_default=False,
    ),
]
Backends = Annotated[
    str, typer.Option(help="Names, separated by commas  [default: all available]", show_default=False)
]
Sizes = Annotated[str, typer.Option(help="Rows and columns of the maps")]
DemoFolder = Annotated[
    Path, typer.Option(help="Folder for the pictures; created if missing", show_default=False)
]

# -- of view
Port = Annotated[int, typer.Option(min=1, max=65535, help="Port of this machine")]
Browser = Annotated[bool, typer.Option("--browser/--no-browser", help="Open the page in the browser")]
