"""Runs the tutorials and keeps the pictures that they show: every thumbnail is what a page's own code made.

python docs/pictures.py            # all pages; or: python docs/pictures.py vision terrain
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).resolve().parent
TUTORIALS = ("vision", "terrain", "relief", "year")


def blocks(text: str) -> list[tuple[str, str]]:
    """(language, code) of every fenced block, in order."""
    return re.findall(r"^```(\w+)[^\n]*\n(.*?)^```$", text, re.DOTALL | re.MULTILINE)


def shown(text: str) -> list[str]:
    """Names of the pictures under pictures/ that a page shows."""
    return re.findall(r"\(pictures/([\w.]+)\)", text)


def shell(code: str, folder) -> None:
    """Run a block of shell lines in ``folder``, with the Python that runs this; installing is left to CI."""
    code = re.sub(r"^pip install [^&\n]*(&& )?", "", code, flags=re.MULTILINE)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", code],
        cwd=folder,
        env={**os.environ, "PATH": path},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"exit {done.returncode} of\n{code}\n{done.stderr}")


def run(page: Path, folder) -> None:
    """Run every block of a page in order, in one namespace, in ``folder``."""
    names, folder = {"__name__": "__main__"}, Path(folder).resolve()
    with contextlib.chdir(folder):
        for number, (language, code) in enumerate(blocks(page.read_text(encoding="utf-8"))):
            if language == "python":
                exec(compile(code, f"{page.name}, block {number}", "exec"), names)
            elif language == "sh":
                shell(code, folder)
            else:
                raise ValueError(f"{page.name}, block {number}: {language}, which nothing here runs")


if __name__ == "__main__":
    for name in sys.argv[1:] or TUTORIALS:
        page = DOCS / f"{name}.md"
        with tempfile.TemporaryDirectory() as folder:
            run(page, folder)
            for picture in shown(page.read_text(encoding="utf-8")):
                shutil.copy(Path(folder) / picture, DOCS / "pictures" / picture)
                print("wrote", DOCS / "pictures" / picture)
