"""Frames a second of `skylamp view` while the mouse drags the sun or the lamp, counted in headless Chromium.

    python performance/view.py --out docs [--backend opencl]

Serves the terrain that skylamp brings, mirrored to 512 x 512 nodes, and moves the mouse round the middle of
the picture for three seconds, once with every frame of the screen. A frame counts when the browser has loaded
it and draws it. Browser and server share the cores. Writes view.csv; a minute.
Needs selenium, `pip install '.[view]'` and `apt-get install chromium chromium-driver`.
"""

import argparse
import csv
import os
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import record
from selenium import webdriver
from selenium.webdriver.common.by import By

from skylamp import io

SIDE = 512  # [node]
DRAG = 3.0  # [second]
ROUNDS = 5  # of which the median is given
CHROMIUM, DRIVER = "/usr/bin/chromium", "/usr/bin/chromedriver"
DRAGGING = """
const [seconds, done] = arguments, picture = document.querySelector('.picture img')
const box = picture.getBoundingClientRect(), start = performance.now(), shown = []
let loaded = false, moves = 0
const load = () => { loaded = true }
const mouse = (kind, turn) => picture.dispatchEvent(new MouseEvent(kind, {
    bubbles: true, buttons: kind == 'mouseup' ? 0 : 1,
    clientX: box.x + box.width * (0.5 + 0.3 * Math.cos(2 * Math.PI * turn)),
    clientY: box.y + box.height * (0.5 + 0.3 * Math.sin(2 * Math.PI * turn)),
}))
const step = () => {
    const now = (performance.now() - start) / 1000
    if (loaded) shown.push(now)
    loaded = false
    if (now < seconds) {
        moves += 1
        mouse('mousemove', now / seconds)
        requestAnimationFrame(step)
    } else {
        mouse('mouseup', 1)
        picture.removeEventListener('load', load)
        done([shown, moves, now])
    }
}
picture.addEventListener('load', load)
mouse('mousedown', 0)
requestAnimationFrame(step)
"""


def browser() -> Any:
    """Headless Chromium, Debian's."""
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for word in ("--headless=new", "--no-sandbox", "--disable-dev-shm-usage", "--window-size=1280,1000"):
        options.add_argument(word)
    return webdriver.Chrome(options, webdriver.ChromeService(DRIVER))


def wait(found: Any, seconds: float = 120.0) -> None:
    """Until ``found()`` is true. Raises TimeoutError."""
    end = time.monotonic() + seconds
    while not found():
        if time.monotonic() > end:
            raise TimeoutError(f"Nothing within {seconds:.0f} s")
        time.sleep(0.1)


def rest(page: Any) -> None:
    """Wait until the refined image has been shown for a second."""
    refined = lambda: page.find_element(By.CSS_SELECTOR, ".status").text.startswith("refined")
    wait(lambda: refined() and (time.sleep(1) or refined()))


def choose(page: Any, source: str) -> None:
    """Set the control named source, the page's first."""
    page.find_elements(By.CSS_SELECTOR, ".q-select")[0].click()
    entry = lambda: [e for e in page.find_elements(By.CSS_SELECTOR, ".q-item") if e.text == source]
    wait(entry)
    time.sleep(0.5)  # the list unfolds
    entry()[0].click()
    time.sleep(1)


def measure(page: Any, source: str) -> dict[str, object]:
    """One line of the table."""
    choose(page, source)
    rates, gaps, moves = [], [], []
    for n in range(ROUNDS + 1):
        rest(page)
        shown, moved, seconds = page.execute_async_script(DRAGGING, DRAG)
        if n:  # the first compiles
            rates.append(len(shown) / seconds)
            moves.append(moved / seconds)
            gaps.append(np.diff([0, *shown, seconds]).max())
    return {
        "source": source,
        "side": SIDE,
        "frames_per_second": round(float(np.median(rates)), 1),
        "least": round(min(rates), 1),
        "longest_gap_ms": round(1000 * float(np.median(gaps))),
        "moves_per_second": round(float(np.median(moves))),
        "load": round(os.getloadavg()[0], 1),
    }


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def answers(port: int) -> bool:
    with socket.socket() as there:
        return there.connect_ex(("127.0.0.1", port)) == 0


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, required=True, help="folder")
    parser.add_argument("--backend", default="opencl")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    height, spacing = io.terrain()
    file = Path(tempfile.mkdtemp()) / "height.npy"
    np.save(file, np.pad(height, [(0, SIDE - n) for n in height.shape], "symmetric").astype(np.float32))
    port = free_port()
    words = ["view", str(file), "--height", "--spacing", str(spacing), "--port", str(port), "--no-browser"]
    words += ["--backend", options.backend]
    served = subprocess.Popen([sys.executable, "-m", "skylamp", *words])
    page = browser()
    try:
        wait(lambda: answers(port))
        page.set_script_timeout(60)
        page.get(f"http://127.0.0.1:{port}")
        rest(page)
        rows = [measure(page, source) for source in ("clear sky", "lamp")]
    finally:
        page.quit()
        served.terminate()
        served.wait(30)
    for row in rows:
        print(row)
    with open(options.out / "view.csv", "w", newline="", encoding="utf-8") as out:
        out.write(record.comment(backend=options.backend) + "\n")
        writer = csv.DictWriter(out, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


if __name__ == "__main__":
    main()
