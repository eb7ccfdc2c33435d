"""README and the pages: code runs and prints as shown, links hold, numbers are those of the data."""

import importlib.util
import inspect
import json
import os
import re
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import imageio.v3 as imageio
import pytest

import skylamp as sl

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"


def _module(name):
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


pages, tables = _module("pages"), _module("tables")
TEXTS = {pages.name_of(page): page.read_text(encoding="utf-8") for page in pages.pages()}
RUN = [name for name, text in TEXTS.items() if pages.blocks(text)]
TUTORIALS = [name for name in TEXTS if name.startswith("tutorials/")]


def _path(name):
    return ROOT / "README.md" if name == "README" else DOCS / f"{name}.md"


@pytest.mark.slow
@pytest.mark.parametrize("name", RUN)
def test_page_runs_and_prints_what_it_shows(name, tmp_path):
    """Every block runs, in order; what it prints and the pictures that it makes are those of the page."""
    for number, (printed, (_, _, kept)) in enumerate(
        zip(pages.run(_path(name), tmp_path), pages.blocks(TEXTS[name]), strict=True)
    ):
        again = f"python docs/pages.py --write {name}"
        assert not printed.strip() or kept, f"block {number} prints and nothing is shown: {again}"
        if kept:
            differing = pages.compare(printed, kept)
            assert differing is None, f"block {number}: {differing}; {again}"
    for picture in pages.shown(TEXTS[name]):
        if not (tmp_path / picture).exists():
            assert name not in TUTORIALS, f"{picture} is made by no block"
            continue
        made, kept = imageio.imread(tmp_path / picture), imageio.imread(DOCS / "pictures" / picture)
        assert (
            made.shape[2:] == kept.shape[2:]
            and abs(made.shape[0] - kept.shape[0]) + abs(made.shape[1] - kept.shape[1]) <= 12
        ), picture  # fonts may differ by a pixel
        if made.shape == kept.shape:
            assert abs(made.astype(float) - kept).mean() < 6, f"{picture} differs: {again}"


@pytest.mark.parametrize("name", TEXTS)
def test_code_fits_into_the_column(name):
    """No line of a block is cut at 1280 pixels: 100 characters of the page's font."""
    for _, code, _ in pages.blocks(TEXTS[name]):
        assert max(map(len, code.splitlines()), default=0) <= 100, code


@pytest.mark.parametrize("name", TEXTS)
def test_measured_numbers_are_those_of_the_data(name):
    """Every table and number between data marks is made from the CSV and JSON files."""
    assert tables.made(TEXTS[name]) == TEXTS[name], "python docs/tables.py"


def test_a_wrong_number_is_seen(monkeypatch):
    """A changed digit on a page, and a changed value in the data, are both differences."""
    name = next(name for name, text in TEXTS.items() if "<!-- data: tolerances -->" in text)
    text = re.sub(r"(?s)(<!-- data: tolerances -->.*?)\d", r"\g<1>777", TEXTS[name], count=1)
    assert tables.made(text) == TEXTS[name] != text
    rows = tables.rows
    monkeypatch.setattr(tables, "rows", lambda name: [{**row, "over": "9"} for row in rows(name)])
    assert tables.made(TEXTS[name]) != TEXTS[name]


def test_data_tell_their_machine_and_date():
    """Data written since performance/record.py exists have machine, cores, versions and date."""
    for path in [DOCS / "lattice_error.csv", DOCS / "recover.json"]:
        head = path.read_text(encoding="utf-8")[:1500]
        assert all(word in head for word in ("date", "machine", "cores", "numpy", "skylamp")), path


def test_compare_sees_differences():
    """Other words, other counts of lines and numbers beyond rounding differ; rounding does not."""
    assert pages.compare("mean 0.501 m\n", "mean 0.500 m\n") is None
    assert pages.compare("mean 0.551 m\n", "mean 0.500 m\n")
    assert pages.compare("mean 0.500 km\n", "mean 0.500 m\n")
    assert pages.compare("a\nb\n", "a\n")
    assert pages.compare("a\nx\ny\nb\n", "a\n...\nb\n") is None
    assert pages.compare("a\nx\ny\nc\n", "a\n...\nb\n")
    assert pages.compare("(64, 64)", "(64, 32)") and pages.compare("7 azimuths", "6 azimuths")


@pytest.mark.parametrize("tutorial", sorted((DOCS / "tutorials").glob("*.md")), ids=lambda path: path.stem)
def test_notebooks_have_the_code_of_their_page(tutorial):
    """Cells hold the code that test_page_runs_and_prints_what_it_shows runs, and no link or picture."""
    text = tutorial.read_text(encoding="utf-8")
    book = json.loads(pages.notebook(text))
    cells = {kind: ["".join(c["source"]) for c in book["cells"] if c["cell_type"] == kind]
             for kind in ("code", "markdown")}  # fmt: skip
    expected = [("%%sh\n" if language == "sh" else "") + code for language, code, _ in pages.blocks(text)]
    assert [code.strip() for code in cells["code"]] == [code.strip() for code in expected]
    assert all(
        "![" not in words and "](.." not in words and "```" not in words for words in cells["markdown"]
    )
    assert pages.notebook(text) == pages.notebook(text)


def test_output_is_written_below_its_block():
    """What a block printed replaces what was shown below it, and appears where nothing was."""
    text = "# A\n\n```python\nprint(1)\n```\n\n```text\n2\n```\n\nb\n\n```python\nprint(3)\n```\n"
    new = pages.with_output(text, ["1\n", "3\n"])
    assert [kept for _, _, kept in pages.blocks(new)] == ["1\n", "3\n"]
    assert pages.with_output(new, ["1\n", "3\n"]) == new and "\n\nb\n\n" in new


@pytest.mark.parametrize(
    "text, error",
    [
        ("```python\n1 / 0\n```\n", ZeroDivisionError),
        ("```sh\npip install x && false\n```\n", RuntimeError),
        ("```perl\nprint 1\n```\n", ValueError),
    ],
)
def test_a_block_that_fails_is_seen(text, error, tmp_path):
    """The runner fails at a block that raises, a command that fails and an unknown language."""
    (tmp_path / "page.md").write_text(text)
    with pytest.raises(error):
        pages.run(tmp_path / "page.md", tmp_path)


def test_pictures_are_shown_and_small():
    """Every kept picture is shown by a page, and the other way round; none is large."""
    kept = {picture.name for picture in (DOCS / "pictures").iterdir()}
    assert kept == {picture for text in TEXTS.values() for picture in pages.shown(text)}
    assert all(picture.stat().st_size < 250_000 for picture in (DOCS / "pictures").iterdir())
    assert all(pages.shown(TEXTS[name]) for name in TUTORIALS) and len(TUTORIALS) >= 4


def _anchors(text):
    """Anchors of the headings of a page, as mkdocs and GitHub name them."""
    headings = re.findall(
        r"^#+ (.+)$", re.sub(r"^```.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE), re.MULTILINE
    )
    return {re.sub(r"[^\w\s-]", "", heading.lower()).strip().replace(" ", "-") for heading in headings}


@pytest.mark.parametrize("name", TEXTS)
def test_links_lead_somewhere(name):
    """Every relative link and picture is a file, and every anchor a heading; others are https."""
    text = re.sub(r"^```.*?^```$|`[^`\n]+`", "", TEXTS[name], flags=re.DOTALL | re.MULTILINE)
    links = re.findall(r"\]\(([^)\s]+)\)|(?:src|href|data)=\"([^\"]+)\"", text)
    for link in (one or other for one, other in links):
        if re.match(r"https://|mailto:", link):
            continue
        path, _, anchor = link.partition("#")
        target = (_path(name).parent / path).resolve() if path else _path(name)
        assert target.exists(), f"{name}: {link}"
        if anchor:
            assert anchor in _anchors(target.read_text(encoding="utf-8")), f"{name}: {link}"


def test_public_functions_document_their_result():
    """Every public function documents the value that it returns."""
    functions = {name: getattr(sl, name) for name in sl.__all__ if inspect.isfunction(getattr(sl, name))}
    assert len(functions) > 15
    lacking = [name for name, function in functions.items() if "Returns" not in inspect.getdoc(function)]
    assert not lacking, lacking


def test_every_page_is_in_the_navigation():
    """Each page is listed, once, except those that are being added by others."""
    config = (ROOT / ".ci" / "mkdocs.yml").read_text(encoding="utf-8")
    listed = re.findall(r": ([\w/-]+)\.md$", config, re.MULTILINE)
    assert len(listed) == len(set(listed)) and set(listed) <= set(TEXTS)
    assert {name for name in TEXTS if "/" in name} <= set(listed)


class _Loaded(HTMLParser):
    """Addresses that a page loads: scripts, styles, pictures, fonts."""

    def __init__(self):
        super().__init__()
        self.addresses = []

    def handle_starttag(self, tag, attributes):
        given = dict(attributes)
        if tag in ("script", "img", "iframe", "source", "object") or given.get("rel") in (
            "stylesheet",
            "icon",
            "preload",
        ):
            self.addresses += [given[name] for name in ("src", "href", "data") if given.get(name)]


@pytest.mark.slow
def test_pages_build_without_a_warning(tmp_path):
    """mkdocs build --strict: every public name has its entry, nothing comes from elsewhere."""
    (tmp_path / "packages").mkdir()
    (tmp_path / "packages" / "skylamp").symlink_to(
        Path(sl.__file__).parent
    )  # an editable install is not found by its name
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "-f", str(ROOT / ".ci" / "mkdocs.yml")]
    python_path = os.pathsep.join([str(tmp_path / "packages"), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(
        [*command, "--site-dir", str(tmp_path / "site")],
        env={**os.environ, "PYTHONPATH": python_path, "NO_MKDOCS_2_WARNING": "1"},
        capture_output=True,
        text=True,
        timeout=300,
    )
    assert done.returncode == 0, done.stderr
    built = {path: path.read_text(encoding="utf-8") for path in (tmp_path / "site").rglob("*.html")}
    reference = "".join(page for path, page in built.items() if "reference" in path.parts)
    entries = {name.rsplit(".", 1)[-1] for name in re.findall(r'id="skylamp\.([\w.]+)"', reference)}
    assert set(sl.__all__) <= entries, set(sl.__all__) - entries
    assert ":func:" not in reference and ":class:" not in reference
    for path, page in built.items():
        loaded = _Loaded()
        loaded.feed(page)
        for address in loaded.addresses:
            assert not re.match(r"(https?:)?//", address), f"{path.name} loads {address}"
    for tutorial in (DOCS / "tutorials").glob("*.md"):
        book = tmp_path / "site" / "tutorials" / f"{tutorial.stem}.ipynb"
        assert book.read_text(encoding="utf-8") == pages.notebook(tutorial.read_text(encoding="utf-8"))
        assert f'href="{book.name}" download' in book.with_suffix(".html").read_text(encoding="utf-8")
    assert (tmp_path / "site" / "assets" / "mathjax" / "tex-chtml.js").stat().st_size > 1e6
    assert any((tmp_path / "site" / "assets" / "mathjax").rglob("*.woff"))
    for command in ("render", "recover", "plan", "horizon", "field", "backends"):
        assert f"skylamp {command}" in (tmp_path / "site" / "reference" / "cli.html").read_text()
