"""Run the pages: every code block, every printed output and every picture of README and docs/ is made here.

    python docs/pages.py --write                      # all pages: write their output and pictures anew
    python docs/pages.py --write tutorials/images     # one page

A block of ``text`` directly after a block of code holds what that code printed. ``compare`` allows numbers to
differ by 2 % or by two units of the last digit that is shown, since devices round differently. A line of
``...`` stands for any lines.
"""

import argparse
import contextlib
import io
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

DOCS = Path(__file__).resolve().parent
ROOT = DOCS.parent
FENCE = re.compile(r"^```(\w+)[^\n]*\n(.*?)^```$", re.DOTALL | re.MULTILINE)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?", re.IGNORECASE)
PICTURES = "pictures"
SHARE = 0.02  # by which a printed number may differ; twice of it hides a wrong third digit


def pages() -> list[Path]:
    """All pages, README first."""
    return [ROOT / "README.md", *sorted(DOCS.rglob("*.md"))]


def name_of(page: Path) -> str:
    """README, or the path inside docs/ without its ending."""
    return page.stem if page.parent == ROOT else page.relative_to(DOCS).with_suffix("").as_posix()


def blocks(text: str) -> list[tuple[str, str, str | None]]:
    """(language, code, printed output or None) of every block of code, in order."""
    found: list[tuple[str, str, str | None]] = []
    last = 0
    for match in FENCE.finditer(text):
        language, body = match.groups()
        if language == "text":
            if found and not text[last : match.start()].strip():
                found[-1] = (*found[-1][:2], body)
            continue
        found.append((language, body, None))
        last = match.end()
    return found


def shown(text: str) -> list[str]:
    """Names of the pictures under pictures/ that a page shows."""
    return list(dict.fromkeys(re.findall(rf"[(\"](?:\.\./|docs/)?{PICTURES}/([\w.-]+)[)\"]", text)))


def notebook(text: str) -> str:
    """A page as a Jupyter notebook without output, by jupytext: same code, same words.

    Blocks of printed output, pictures and addresses of other pages are left out, since a notebook that was
    downloaded prints and draws its own and stands alone.
    """
    import jupytext

    text = re.sub(r"^```text\n.*?^```\n+", "", text, flags=re.DOTALL | re.MULTILINE)
    prose = re.split(r"(^```.*?^```$)", text, flags=re.DOTALL | re.MULTILINE)
    for number in range(0, len(prose), 2):
        tables = re.sub(r"^(?:\|.*\n)+", _without_pictures, prose[number], flags=re.MULTILINE)
        without = re.sub(r"!\[[^]]*\]\([^)]*\)(\{[^}]*\})?", "", tables)
        prose[number] = re.sub(r"\[([^]]*)\]\((?!https:)[^)]*\)", r"\1", without)
    made = jupytext.reads("".join(prose), "md")
    made.metadata = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
    for number, cell in enumerate(made.cells):
        cell.id = f"cell-{number}"  # jupytext's are random
        cell.metadata = {}
    return jupytext.writes(made, "ipynb")


def _without_pictures(table: re.Match[str]) -> str:
    return "" if "![" in table[0] else table[0]


def shell(code: str, folder) -> str:
    """What lines of shell print, run in ``folder`` with this Python; packages are installed by CI."""
    code = re.sub(r"^pip install [^&\n]*(&& )?(pytest -n 2$)?", "", code, flags=re.MULTILINE)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        ["bash", "-euo", "pipefail", "-c", code],
        cwd=folder,
        env={**os.environ, "PATH": path, "COLUMNS": "100"},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise RuntimeError(f"exit {done.returncode} of\n{code}\n{done.stderr}")
    return done.stdout


def run(page: Path, folder) -> list[str]:
    """Run every block of a page in order, in one namespace, in ``folder``; what each printed."""
    names, folder, printed = {"__name__": "__main__"}, Path(folder).resolve(), []
    with contextlib.chdir(folder):
        for number, (language, code, _) in enumerate(blocks(page.read_text(encoding="utf-8"))):
            if language == "python":
                screen = io.StringIO()
                with contextlib.redirect_stdout(screen):
                    exec(compile(code, f"{page.name}, block {number}", "exec"), names)
                printed.append(screen.getvalue())
            elif language == "sh":
                printed.append(shell(code, folder))
            else:
                raise ValueError(f"{page.name}, block {number}: {language}, which nothing here runs")
    return printed


def compare(printed: str, kept: str) -> str | None:
    """The first difference as a sentence; None where both agree."""
    there, here = (_lines(text) for text in (kept, printed))
    if "..." in there:
        first = there.index("...")
        last = len(there) - first - 1
        there = [*there[:first], *there[first + 1 :]]
        here = [*here[:first], *here[len(here) - last :]] if len(here) >= first + last else here
    if len(there) != len(here):
        return f"{len(here)} lines were printed, {len(there)} are shown"
    for one, other in zip(there, here):
        numbers = NUMBER.findall(one), NUMBER.findall(other)
        if NUMBER.sub("#", one).split() != NUMBER.sub("#", other).split() or not all(
            map(_near, numbers[0], numbers[1])
        ):
            return f"printed: {other!r}, shown: {one!r}"
    return None


def _lines(text: str) -> list[str]:
    return [line.rstrip() for line in text.strip().splitlines()]


def _near(kept: str, printed: str) -> bool:
    mantissa, _, exponent = kept.lower().partition("e")
    digits = len(mantissa.partition(".")[2])
    unit = 10.0 ** (int(exponent or 0) - digits) if digits or exponent else 0.0
    return abs(float(kept) - float(printed)) <= max(2 * unit, SHARE * abs(float(kept))) + 1e-12


def with_output(text: str, printed: list[str]) -> str:
    """The page with what its code printed; output that is shown shortened by ``...`` stays as it is."""
    pieces, last, number, kept = [], 0, -1, blocks(text)
    for match in FENCE.finditer(text):
        if match.group(1) != "text":
            number += 1
            pieces.append(text[last : match.end()])
            last = match.end()
            new = printed[number]
            if kept[number][2] and "..." in _lines(kept[number][2]):
                new = kept[number][2]
            if new.strip():
                pieces.append("\n\n```text\n" + "\n".join(_lines(new)) + "\n```")
        elif number >= 0 and not text[last : match.start()].strip():
            last = match.end()
    return "".join(pieces) + text[last:]


def write(page: Path) -> None:
    """Run a page and write its output and its pictures."""
    text = page.read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory() as folder:
        page.write_text(with_output(text, run(page, folder)), encoding="utf-8")
        for picture in shown(text):
            if (Path(folder) / picture).exists():
                shutil.copy(Path(folder) / picture, DOCS / PICTURES / picture)
    print("wrote", page.relative_to(ROOT))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--write", action="store_true", required=True)
    parser.add_argument("pages", nargs="*", help="such as README or tutorials/images; all unless given")
    names = parser.parse_args().pages
    for page in pages():
        if (not names or name_of(page) in names) and blocks(page.read_text(encoding="utf-8")):
            write(page)
