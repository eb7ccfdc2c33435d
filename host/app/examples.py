"""Examples of every command, at the end of its help."""

_OF = {
    "render": (
        "skylamp render depth.npy image.png",
        "skylamp render dem.tif light.tif --source clear --sun 135,30 --horizontal 90 --direct 750",
        "skylamp render depth.npy image.png --lamp 40,30,-20,5 --tolerance 0.3% --error error.npy",
    ),
    "plan": ("skylamp plan dem.tif --tolerance 0.3%", "skylamp plan depth.npy --lamp 40,30,-20,5"),
    "recover": (
        "skylamp recover image.npy depth.npz",
        "skylamp recover counts.png depth.npy --white 1.0 --sides dark --source overcast",
    ),
    "horizon": (
        "skylamp horizon dem.tif svf.tif",
        "skylamp horizon dem.tif openness.tif --what openness --azimuths 32",
        "skylamp horizon big.tif svf.tif --memory 8GB --resume",
        "skylamp horizon dem.tif --at 120,80 --plot sky.png",
    ),
    "field": (
        "skylamp field depth.npy field.npy --window 10,30,10,30",
        "skylamp field depth.npy --plot rays.png",
    ),
    "chart": ("skylamp chart --out chart --sizes 128,512",),
    "backends": ("skylamp backends", "skylamp backends --json"),
    "selftest": ("skylamp selftest",),
    "doctor": ("skylamp doctor",),
    "demo": ("skylamp demo --out demo",),
    "view": ("skylamp view dem.tif", "skylamp view height.npy --height --port 8081 --no-browser"),
}


def epilog(command: str) -> str:
    """The examples of a command, a line each."""
    return "\n".join(["\b", "Examples:", *(f"  {line}" for line in _OF[command])])
