"""Locks that a forked process has anew: those of its parent may be held by a thread that it does not have."""

from __future__ import annotations

import os
import threading
import weakref
from typing import Any

_owners: weakref.WeakSet[Any] = weakref.WeakSet()


def give_lock(owner: Any) -> None:
    """Sets ``owner.lock``, here and in every process that is forked from this one."""
    owner.lock = threading.RLock()
    _owners.add(owner)


def _renew() -> None:
    for owner in _owners:
        owner.lock = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_renew)
