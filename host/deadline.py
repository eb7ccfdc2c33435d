"""The time that a call may take: whatever works for long looks at it."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator

_call = threading.local()  # state of the call that this thread is in


def limited() -> bool:
    """Whether this thread's call has a limit."""
    return getattr(_call, "check", None) is not None


def check() -> None:
    """Raise what the limit of this thread's call raises once its time is over."""
    if limited():
        _call.check()


@contextlib.contextmanager
def checked_by(look: Callable[[], None]) -> Iterator[None]:
    """Within this context :func:`check` of this thread calls ``look``."""
    before, _call.check = getattr(_call, "check", None), look
    try:
        yield
    finally:
        _call.check = before
