"""What stands around the library: writers that are killed, threads, full disks, other processes."""

import contextlib
import os
import random
import signal
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

import skylamp as sl
from skylamp import io

WRITER = """
import sys, numpy as np
from skylamp import io
while True:
    for value in (1, 2):  # uint8: what a PNG does not scale
        io.write(sys.argv[1], np.full((700, 900), value, np.uint8))
        print("written", flush=True)
"""


def environment(**more):
    return {**os.environ, "PYTHONWARNINGS": "ignore", **more}


def is_whole(path):
    """Whether a file is one that WRITER wrote to its end."""
    try:
        found = io.read(path)
    except sl.SkylampError:
        return False
    return found.shape == (700, 900) and found[0, 0] in (1, 2) and np.ptp(found) == 0


def killed_writers(kills, suffix=".npy", seed=0):
    """kill -9 at random moments of a process that replaces one file over and over; how often a file was half.

    Also counts what its folder holds besides: a temporary file that a killed process left.
    """
    rng, half, left = random.Random(seed), 0, 0
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"out{suffix}"
        for _ in range(kills):
            writer = subprocess.Popen(
                [sys.executable, "-c", WRITER, str(path)], stdout=subprocess.PIPE, env=environment()
            )
            writer.stdout.readline()
            time.sleep(rng.uniform(0.0, 0.1))
            writer.send_signal(signal.SIGKILL)
            writer.wait()
            writer.stdout.close()
            half += not is_whole(path)
            for other in Path(folder).iterdir():
                if other != path:
                    left += 1
                    other.unlink()
    return half, left


def depth_of(number):
    return np.random.default_rng(number).random((9 + number, 12 + number)) * 4


def thread_work(backend):
    """One call of each kind for a thread's own map."""
    sky, lamp = sl.Sky(), lambda z: sl.Lamp((z.shape[1] / 2, 4, -6), 3)
    return [
        lambda z: sl.render(sl.Scene(z), sky, azimuths=8, backend=backend).image,
        lambda z: sl.render(sl.Scene(z), lamp(z), method="horizon", azimuths=16, backend=backend).image,
        lambda z: sl.render(sl.Scene(z), sky, hemicube=5, backend=backend).image,
        lambda z: sl.sky_view_factor(sl.Scene(z), azimuths=8, backend=backend),
        lambda z: sl.visibility(sl.Scene(z), sky, 5, backend, filled=True),
        lambda z: sl.horizons(sl.Scene(z), 4, backend),
        lambda z: sl.openness(sl.Scene(z), 4, backend),
        lambda z: (
            sl.recover(
                1 + z[:6, :6], sl.Sky(8.0), 0.5, "dark", layers=4, hemicube=3, method="paper", backend=backend
            ).depth
        ),
    ]


def wrong_on_threads(backend, threads=8, calls=200):
    """Of how many calls on as many threads at once the bytes are not those of one call after another."""
    work = thread_work(backend)
    expected = {
        (thread, n): work[n](depth_of(thread)).tobytes()
        for thread in range(threads)
        for n in range(len(work))
    }
    start = threading.Barrier(threads)

    def run(thread):
        start.wait()
        chosen = [(thread + n) % len(work) for n in range(calls)]
        return sum(work[n](depth_of(thread)).tobytes() != expected[thread, n] for n in chosen)

    with ThreadPoolExecutor(threads) as pool:
        return sum(pool.map(run, range(threads)))


def ran(code, *, timeout=300, preparation=None, options=(), **more):
    """(exit status, stdout, stderr) of Python code in a process of its own."""
    done = subprocess.run(
        [sys.executable, *options, "-c", code],
        capture_output=True,
        text=True,
        timeout=timeout,
        env=environment(**more),
        preexec_fn=preparation,
    )
    return done.returncode, done.stdout, done.stderr


@contextlib.contextmanager
def small_disk(megabytes=1):
    """A folder on a disk of its own that is soon full; None where mounting is not allowed."""
    with tempfile.TemporaryDirectory() as folder:
        size = f"size={megabytes}m"
        made = subprocess.run(["mount", "-t", "tmpfs", "-o", size, "tmpfs", folder], capture_output=True)
        if made.returncode:
            yield None
            return
        try:
            yield Path(folder)
        finally:
            subprocess.run(["umount", folder], check=True)
