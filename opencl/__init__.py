"""OpenCL twins of the Warp kernels: only .cl files, and this loader."""

from importlib.resources import files


def source(stem: str) -> str:
    """The text of ``<stem>.cl`` with its includes put in, so that a build needs no path."""
    lines = files(__package__).joinpath(f"{stem}.cl").read_text().splitlines()
    put_in = lambda line: (
        files(__package__).joinpath(line.split('"')[1]).read_text() if line.startswith("#include") else line
    )
    return "\n".join(map(put_in, lines)) + "\n"
