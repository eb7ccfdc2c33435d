"""The time of skylamp.render on NumPy arrays, compiling apart, of a scene that was not rendered before."""

import functools

import skylamp as sl

from .common import BACKENDS, METHODS, SIZES, rough_ground, skip_missing, work


@functools.cache
def compile_once(size: int, backend: str, method: str) -> None:
    """Compile or load the kernels; ``cache``, since setup runs before every sample."""
    source, options = work(method, size)
    sl.render(sl.Scene(rough_ground(size)), source, backend=backend, **options)


class Render:
    """``number`` is 1 and the scene is new for every sample, since a scene may keep what was found for it."""

    params = (SIZES, BACKENDS, METHODS)
    param_names = ("size", "backend", "method")
    number = 1
    repeat = (3, 20, 10.0)  # at least 3 samples, at most 20, or 10 s of them
    rounds = 1
    warmup_time = 0.0
    timeout = 300.0

    def setup(self, size: int, backend: str, method: str) -> None:
        skip_missing(backend, size)
        compile_once(size, backend, method)
        self.scene = sl.Scene(rough_ground(size))
        self.source, self.options = work(method, size)

    def time_render(self, size: int, backend: str, method: str) -> None:
        sl.render(self.scene, self.source, backend=backend, **self.options)
