"""The tutorials run from the first line to the last picture, and the pages build without a warning."""

import importlib.util
import os
import re
import subprocess
import sys
from pathlib import Path

import imageio.v3 as imageio
import pytest

import skylamp as sl

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
_spec = importlib.util.spec_from_file_location("docs_pictures", DOCS / "pictures.py")
pictures = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(pictures)
PAGES = sorted(page.stem for page in DOCS.glob("*.md"))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", [name for name in PAGES if pictures.blocks((DOCS / f"{name}.md").read_text(encoding="utf-8"))]
)
def test_page_runs(name, tmp_path):
    """Every block runs, in order; a tutorial's code makes each picture that the page shows."""
    page = DOCS / f"{name}.md"
    pictures.run(page, tmp_path)
    if name not in pictures.TUTORIALS:
        return
    shown = pictures.shown(page.read_text(encoding="utf-8"))
    assert shown
    for picture in shown:
        made, kept = imageio.imread(tmp_path / picture), imageio.imread(DOCS / "pictures" / picture)
        assert (
            made.shape[2:] == kept.shape[2:]
            and abs(made.shape[0] - kept.shape[0]) + abs(made.shape[1] - kept.shape[1]) <= 12
        ), picture  # fonts may differ by a pixel
        if made.shape == kept.shape:
            assert abs(made.astype(float) - kept).mean() < 6, (
                f"{picture} is not what the page makes: python docs/pictures.py {name}"
            )


def test_every_tutorial_is_there_and_shows_pictures():
    """Each kind of user has a page in the navigation, and pictures are small."""
    assert set(pictures.TUTORIALS) <= set(PAGES)
    config = (ROOT / ".ci" / "mkdocs.yml").read_text(encoding="utf-8")
    assert all(f"{name}.md" in config for name in pictures.TUTORIALS)
    everything = "".join((DOCS / f"{name}.md").read_text(encoding="utf-8") for name in PAGES)
    kept = {picture.name for picture in (DOCS / "pictures").iterdir()}
    assert kept == set(pictures.shown(everything)), "a picture that no page shows, or the other way round"
    assert all(picture.stat().st_size < 200_000 for picture in (DOCS / "pictures").iterdir())


def test_a_block_that_fails_is_seen(tmp_path):
    """The runner fails at a block that raises, a command that fails and an unknown language."""
    for text, error in (
        ("```python\n1 / 0\n```\n", ZeroDivisionError),
        ("```sh\npip install x && false\n```\n", RuntimeError),
        ("```perl\nprint 1\n```\n", ValueError),
    ):
        (tmp_path / "page.md").write_text(text)
        with pytest.raises(error):
            pictures.run(tmp_path / "page.md", tmp_path)


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path):
    """mkdocs build --strict, as CI does it; every public name has its entry."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "skylamp").symlink_to(
        Path(sl.__file__).parent
    )  # an editable install is not found by its name
    done = subprocess.run(
        [
            sys.executable,
            "-m",
            "mkdocs",
            "build",
            "--strict",
            "-f",
            str(ROOT / ".ci" / "mkdocs.yml"),
            "--site-dir",
            str(tmp_path / "site"),
        ],
        env={**os.environ, "PYTHONPATH": str(tmp_path / "packages"), "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    assert "mkdocs build --strict" in (ROOT / ".ci" / "run").read_text(encoding="utf-8")
    page = (tmp_path / "site" / "api" / "index.html").read_text(encoding="utf-8")
    entries = {name.rsplit(".", 1)[-1] for name in re.findall(r'id="skylamp\.([\w.]+)"', page)}
    assert set(sl.__all__) <= entries, set(sl.__all__) - entries
    assert ":func:" not in page and ":class:" not in page
