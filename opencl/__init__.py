"""OpenCL twins of the Warp kernels: only .cl files, and this loader."""

import re
from importlib.resources import files

from skylamp import constants


def source(stem: str) -> str:
    """The text of ``<stem>.cl`` with its includes put in, so that a build needs no path."""
    lines = files(__package__).joinpath(f"{stem}.cl").read_text().splitlines()
    put_in = lambda line: (
        files(__package__).joinpath(line.split('"')[1]).read_text() if line.startswith("#include") else line
    )
    return "\n".join(map(put_in, lines)) + "\n"


def defines(stem: str) -> list[str]:
    """The build options for those of the shared constants that ``<stem>.cl`` names."""
    named = set(re.findall(r"\w+", source(stem)))
    numbers = {}
    for name, value in vars(constants).items():
        if isinstance(value, tuple):
            numbers |= {f"{name}_{i}": part for i, part in enumerate(value)}
        elif isinstance(value, (int, float)):
            numbers[name] = value
    literal = lambda value: f"{value!r}f" if isinstance(value, float) else str(value)
    return [f"-D{name}={literal(value)}" for name, value in numbers.items() if name in named]
