"""The first call of a process with empty kernel caches: importing, compiling and one small render."""

from pathlib import Path

from .common import BACKENDS, METHODS, skip_missing

SIZE = 64  # rows and columns; chosen: the call itself takes some hundredths of a second
EMPTY_CACHES = """
import os, sys, tempfile
sys.path.insert(0, {folder!r})
caches = tempfile.TemporaryDirectory()
for name in ("POCL_CACHE_DIR", "WARP_CACHE_PATH", "XDG_CACHE_HOME", "CUDA_CACHE_PATH"):
    os.environ[name] = os.path.join(caches.name, name)
    os.mkdir(os.environ[name])
"""
FIRST_CALL = """
import skylamp as sl
from benchmarks.common import rough_ground, work
source, options = work({method!r}, {size})
sl.render(sl.Scene(rough_ground({size})), source, backend={backend!r}, **options)
"""


class FirstCall:
    """asv runs the text of a ``timeraw`` benchmark in a process of its own."""

    params = (BACKENDS, METHODS)
    param_names = ("backend", "method")
    number = 1
    repeat = 1
    rounds = 1
    timeout = 300.0

    def setup(self, backend: str, method: str) -> None:
        skip_missing(backend, SIZE)

    def timeraw_first_call(self, backend: str, method: str) -> tuple[str, str]:
        call = FIRST_CALL.format(method=method, backend=backend, size=SIZE)
        return call, EMPTY_CACHES.format(folder=str(Path(__file__).parents[1]))
