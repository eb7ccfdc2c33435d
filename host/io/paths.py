"""Paths: which can be read, which can be written, and files that are replaced whole or not at all."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

from ..backends.base import available_memory
from ..errors import CapacityError, InputError, bad

MAP_SUFFIXES = (".npy", ".npz", ".png", ".tif", ".tiff")
HDR = (".exr", ".hdr")  # with the extra of that name

StrPath = str | os.PathLike[str]


def readable(path: StrPath) -> Path:
    """``path`` if it is a file with data and a known extension; else InputError."""
    path = Path(path)
    with reading(path):
        if path.is_dir():
            raise bad(f"{path}: cannot read", "a folder", "a file")
        if not path.exists():
            where = "" if path.is_absolute() else f" The path is looked up from {Path.cwd()}."
            raise InputError(f"File not found: {path}.{where}")
        if path.suffix.lower() not in MAP_SUFFIXES + HDR:
            photograph = path.suffix.lower() in (".jpg", ".jpeg")
            fix = "A photograph is decoded first, by skylamp.io.linear." if photograph else ""
            raise bad(f"{path}: unknown extension", repr(path.suffix), " ".join(MAP_SUFFIXES + HDR), fix)
        if path.stat().st_size == 0:
            raise bad(f"{path}: cannot read", "an empty file", "a file with data")
    return path


@contextlib.contextmanager
def reading(path: Path, kind: str = "") -> Iterator[None]:
    """Whatever a reader raises at a damaged or hostile file becomes one InputError that names the file.

    ``kind``: what it should be, unless its extension says so.
    """
    try:
        yield
    except (InputError, CapacityError):
        raise
    # the libraries raise OSError, ValueError, struct.error, zlib.error, SyntaxError, MemoryError ...
    except Exception as error:
        text = " ".join(str(error.__cause__ or error).split()) or "no reason given"
        allowed = f"a whole {kind or path.suffix.lower()} file of real numbers"
        raise bad(f"{path}: cannot read", f"{type(error).__name__}: {text}", allowed) from error


def reserve(path: Path, bytes_needed: int, promised: float = math.inf) -> None:
    """Checks of a header's sizes, before memory is allocated.

    ``promised``: bytes that the file can hold at most. ValueError if it is less; CapacityError if they do not
    fit into memory.
    """
    if bytes_needed > promised:
        raise ValueError(
            f"truncated: its header declares {bytes_needed:,} bytes, the file holds {promised:,.0f}"
        )
    if bytes_needed > available_memory():
        raise CapacityError(
            f"{path} holds {bytes_needed:,} bytes; {available_memory():,} are free. Cut it into tiles."
        )


def destination(path: Path) -> Path:
    """``path`` if its parent folder exists and no folder or device has that name; else InputError."""
    if not path.parent.is_dir():
        allowed = "a file in an existing folder"
        raise bad(f"{path}: cannot write", f"no folder {path.parent}", allowed, "Create the folder first.")
    if path.exists() and not path.is_file():
        raise bad(f"{path}: cannot write", "a folder or a device of that name", "a file")
    if not os.access(path.parent, os.W_OK):
        raise bad(f"{path}: cannot write", f"no permission for folder {path.parent}", "a folder to write to")
    return path


def folder(path: StrPath) -> Path:
    """``path`` as an existing folder, created with its parents if need be.

    Raises InputError where a file stands in the way.
    """
    path = Path(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (FileExistsError, NotADirectoryError):
        got = "a file of that name, or a file among its parents"
        raise bad(f"{path}: not a folder", got, "a folder, or a name that is free") from None
    except OSError as error:
        raise bad(f"{path}: cannot be made", error.strerror, "a folder to write to") from error
    return path


@contextlib.contextmanager
def replacing_file(path: StrPath, ending: str = "") -> Iterator[Path]:
    """A path that becomes ``path`` when the block ends well, and is gone when it does not.

    ``ending``: what it has more than the name of ``path``; a name of its own by default.
    """
    path = destination(Path(path)).resolve()  # through a symbolic link, not over it
    # in the same folder: a rename must not cross file systems
    temporary = path.with_name(path.name + ending if ending else f".{secrets.token_hex(8)}.tmp")
    try:
        yield temporary
        os.replace(temporary, path)
    except BaseException as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.filename == str(temporary):  # it could not be made
            raise bad(f"{path}: cannot write", error.strerror, "a file in a folder to write to") from error
        raise


@contextlib.contextmanager
def replacing(path: StrPath) -> Iterator[BinaryIO]:
    """A binary file that becomes ``path`` when the block ends well, and leaves no trace when it does not."""
    # read and write: numpy then writes through the file, whose errors give the cause, such as a full disk
    with replacing_file(path) as temporary, open(temporary, "x+b") as file:
        yield file
        file.flush()
        os.fsync(file.fileno())
