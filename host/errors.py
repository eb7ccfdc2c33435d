"""The errors that skylamp raises on purpose: one sentence each for what, where, got, allowed, fix."""

from __future__ import annotations

import importlib
from typing import Any, Self

LONGEST_VALUE = 400  # characters of a value in a message; chosen: a path of usual length is shorter


class SkylampError(Exception):
    """Base of every error that skylamp raises on purpose."""


class InputError(SkylampError, ValueError):
    """An argument or a file is not valid."""


class BackendError(SkylampError, RuntimeError):
    """A named backend is not available, or failed."""


class CapacityError(SkylampError, MemoryError):
    """The work does not fit into the available memory."""

    # that of MemoryError, which comes first otherwise, refuses a subclass of two errors: tblib, with which
    # Dask sends errors to other processes, calls it
    def __new__(cls, *args: object) -> Self:
        return Exception.__new__(cls, *args)


class OutOfTimeError(SkylampError, TimeoutError):
    """The seconds that a call was given are over."""


def bad(what: str, got: object, allowed: str, fix: str = "") -> InputError:
    """An InputError: the fault, the value got (in one line, cut short), the allowed values and the fix."""
    text = str(got)
    if "\n" in text:  # an array
        text = " ".join(text.split())
    if len(text) > LONGEST_VALUE:
        text = f"{text[:LONGEST_VALUE]} ..."
    return InputError(f"{what}: got {text}; allowed: {allowed}." + (f" {fix}" if fix else ""))


def import_extra(what: str, package: str, extra: str, *modules: str) -> list[Any]:
    """These modules, imported in turn; the error of :func:`lacking` where one cannot be."""
    try:
        return [importlib.import_module(name) for name in modules]
    except ImportError as error:
        raise lacking(what, package, extra, error) from error


def lacking(what: str, package: str, extra: str, error: ImportError) -> InputError:
    """An InputError for a package that is not installed, or that ``error`` says is broken, with the pip
    command that installs it."""
    command = f"pip install 'skylamp[{extra}]'"
    missing = (error.name or "").partition(".")[0]
    if isinstance(error, ModuleNotFoundError) and (missing in package or missing == "cv2"):
        lacks = "not all of which are installed" if " and " in package else "which is not installed"
        return InputError(f"{what} needs {package}, {lacks}: {command}")
    return InputError(f"{what} needs {package}, which cannot be imported ({error}): {command} --upgrade")
