"""Hooks of the pages: MathJax from a package, the command line from its own help, files of the top level.

MathJax's files are copied from the package django-static-mathjax (extra ``docs``), so that the pages load
nothing from another server. ``<!-- include: FILE -->`` stands for a file of the top level, and
``<!-- command line -->`` for the help of every command. Every tutorial can be downloaded as a notebook
that is made from its page (docs/pages.py).
"""

import re
import sys
from importlib.metadata import files
from pathlib import Path

import typer
from mkdocs.structure.files import File

sys.path.insert(0, str(Path(__file__).resolve().parent.parent / "docs"))
import pages

ROOT = Path(__file__).resolve().parent.parent
TUTORIALS = "tutorials/"
MATHJAX = "mathjax/static/mathjax/es5/"
NEEDED = re.compile(re.escape(MATHJAX) + r"(tex-chtml\.js|output/chtml/fonts/woff-v2/[\w-]+\.woff)$")


def on_files(found, *, config):
    for path in files("django-static-mathjax"):
        if NEEDED.match(str(path)):
            name = "assets/mathjax/" + str(path).removeprefix(MATHJAX)
            found.append(File.generated(config, name, abs_src_path=str(path.locate())))
    for page in [page for page in found if page.src_uri.startswith(TUTORIALS)]:
        name = page.src_uri.removesuffix(".md") + ".ipynb"
        text = Path(page.abs_src_path).read_text(encoding="utf-8")
        found.append(File.generated(config, name, content=pages.notebook(text)))
    return found


def on_page_markdown(markdown, *, page, config, files):
    markdown = re.sub(r"^<!-- include: ([\w.]+) -->$", _include, markdown, flags=re.MULTILINE)
    if page.file.src_uri.startswith(TUTORIALS):
        file = Path(page.file.src_uri).stem + ".ipynb"
        link = f'<a href="{file}" download>Download this page as a notebook</a>'
        markdown = re.sub(r"\A(# .*\n)", rf"\1\n{link}\n", markdown)
    mark = "<!-- command line -->"
    return markdown.replace(mark, _commands()) if mark in markdown else markdown


def _include(match):
    text = (ROOT / match.group(1)).read_text(encoding="utf-8")
    return re.sub(r"\]\(docs/([\w./-]+)\)", r"](../\1)", text)


def _commands():
    from skylamp.app.cli import app

    group = typer.main.get_command(app)
    text = []
    with typer.Context(group, info_name="skylamp") as context:
        for name in group.list_commands(context):
            text.append(_command(group.get_command(context, name), name, context))
    return "\n".join(text)


def _command(command, name, parent):
    with typer.Context(command, info_name=name, parent=parent) as context:
        rows = [option.get_help_record(context) or ("", "") for option in command.get_params(context)]
        usage = command.get_usage(context).removeprefix("Usage: ")
    head = (command.help or "").strip()
    table = "\n".join(f"| {_cell(f'`{one}`')} | {_cell(other)} |" for one, other in dict.fromkeys(rows))
    usage = " ".join(usage.split())
    return f"## skylamp {name}\n\n{head}\n\n    {usage}\n\n| option | meaning |\n|---|---|\n{table}\n"


def _cell(text):
    return re.sub(r"\s+", " ", text).replace("|", "\\|")
