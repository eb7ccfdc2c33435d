"""Imports within skylamp follow the layers that CONTRIBUTING.md lists: downwards only, and in no circle.

Functions, classes and lines are no longer than it says.
"""

import ast
import re
from collections import defaultdict, deque
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
FOLDERS = {  # package: folder, as in pyproject.toml
    "skylamp": ROOT / "host",
    "skylamp.warp_kernels": ROOT / "warp_kernels",
    "skylamp.opencl": ROOT / "opencl",
}
FUNCTION_LINES, CLASS_METHODS, COLUMNS = 80, 15, 110  # CONTRIBUTING.md, Habits; COLUMNS as in pyproject.toml
# What is larger, by its place: lines of the function, methods of the class, or lines that are too long.
# Lower a number when its part shrinks, remove the entry when it fits, and add none.
ALLOWED: dict[str, int] = {}
ORACLE = {"sources", "constants"}  # what the oracle may import: the geometry of the sources


class Edge(NamedTuple):
    """Module ``source`` imports module ``target``; ``place`` is the file and line of the import."""

    source: str
    target: str
    place: str

    def __str__(self) -> str:
        return f"{_short(self.source)} -> {_short(self.target)}  ({self.place})"


def _short(module):
    """The module's name without the leading package."""
    return module.partition(".")[2] or module


def layers(text):
    """{name: number of its layer, 0 at the top} of the fenced block ``layers``."""
    (block,) = re.findall(r"^```layers\n(.*?)^```", text, re.DOTALL | re.MULTILINE)
    names = [(name, number) for number, line in enumerate(block.splitlines()) for name in line.split()]
    assert len(dict(names)) == len(names), f"a name is listed twice: {sorted(name for name, _ in names)}"
    return dict(names)


def part(module):
    """The name under which the layers list a module: the first after ``skylamp``, or ``skylamp`` itself."""
    return _short(module).partition(".")[0]


def modules(folders):
    """{module: file} of all Python files in these folders."""
    found = {}
    for package, folder in folders.items():
        for path in folder.rglob("*.py"):
            names = path.relative_to(folder).with_suffix("").parts
            found[".".join([package, *(name for name in names if name != "__init__")])] = path
    return found


def _at_run_time(node):
    """The node and all below it, without what stands under ``if TYPE_CHECKING:``."""
    yield node
    skips = isinstance(node, ast.If) and ast.unparse(node.test).rpartition(".")[2] == "TYPE_CHECKING"
    for child in node.orelse if skips else ast.iter_child_nodes(node):
        yield from _at_run_time(child)


def _absolute(level, name, module, is_package):
    """The full name of what ``level`` dots and ``name`` mean in ``module``."""
    if not level:
        return name or ""
    base = module.split(".")
    base = base[: len(base) - level + is_package]
    return ".".join([*base, *([name] if name else [])])


def _loaded(call, module, is_package, known):
    """Modules that ``import_module`` with a literal may mean; of a computed name, all of its package."""
    if ast.unparse(call.func).rpartition(".")[2] not in ("import_module", "__import__") or not call.args:
        return []
    name = call.args[0]
    pieces = name.values if isinstance(name, ast.JoinedStr) else [name]
    if not isinstance(pieces[0], ast.Constant):
        return []
    text = pieces[0].value
    level = len(text) - len(text.lstrip("."))
    if len(pieces) == 1:
        return [_absolute(level, text[level:], module, is_package)]
    package = _absolute(level, text[level:].rpartition(".")[0], module, is_package)
    return [other for other in known if other.rpartition(".")[0] == package]


def _targets(node, module, is_package, known):
    """Full names that a node of the syntax tree imports."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        base = _absolute(node.level, node.module, module, is_package)
        names = [f"{base}.{alias.name}" for alias in node.names]
        return [name if name in known else base for name in names]
    return _loaded(node, module, is_package, known) if isinstance(node, ast.Call) else []


def imports(found):
    """Edges of the import graph of these modules, each once.

    Imports in functions count as those of the module do. To import ``a.b.c`` runs ``a`` and ``a.b`` too:
    these are edges as well, except those that hold the importing module, which are being imported already.
    """
    edges = {}
    for module, path in sorted(found.items()):
        is_package = path.name == "__init__.py"
        holders = {module.rsplit(".", n)[0] for n in range(module.count(".") + 1)}
        for node in _at_run_time(ast.parse(path.read_text(encoding="utf-8"))):
            for target in _targets(node, module, is_package, found):
                above = {target.rsplit(".", n)[0] for n in range(1, target.count(".") + 1)} - holders
                for other in sorted(above | {target} - {module}):
                    if other in found:
                        place = f"{str(path).removeprefix(f'{ROOT}/')}:{node.lineno}"
                        edges.setdefault((module, other), Edge(module, other, place))
    return list(edges.values())


def upward(edges, layer_of):
    """Edges from a layer to one above it; of a package and a module in it, the module."""
    known = [edge for edge in edges if part(edge.source) in layer_of and part(edge.target) in layer_of]
    up = [edge for edge in known if layer_of[part(edge.target)] < layer_of[part(edge.source)]]
    within = {(edge.source, edge.target.rpartition(".")[0]) for edge in up}
    return [edge for edge in up if (edge.source, edge.target) not in within]


def circles(edges):
    """The shortest circle through each edge that is in one, as tuples of modules, each circle once."""
    after = {}
    for edge in edges:
        after.setdefault(edge.source, []).append(edge.target)
    found = set()
    for edge in edges:
        before, waiting = {edge.target: None}, deque([edge.target])
        while waiting and edge.source not in before:
            module = waiting.popleft()
            for other in after.get(module, ()):
                if other not in before:
                    before[other] = module
                    waiting.append(other)
        if edge.source in before:
            way = [edge.source]
            while way[-1] != edge.target:
                way.append(before[way[-1]])
            way.reverse()
            first = way.index(min(way))
            found.add(tuple(way[first:] + way[:first]))
    return sorted(found)


def report(what, found):
    """Fail with one line for each fault."""
    if found:
        pytest.fail(
            f"{len(found)} {what} (CONTRIBUTING.md):\n" + "\n".join(f"  {one}" for one in found),
            pytrace=False,
        )


@pytest.fixture(scope="module")
def layer_of():
    """The layers of CONTRIBUTING.md."""
    return layers((ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8"))


@pytest.fixture(scope="module")
def graph():
    """The import graph of the package."""
    return imports(modules(FOLDERS))


def test_every_module_belongs_to_a_layer(layer_of):
    """Each module under host/ is listed, itself or its package, and nothing is listed that is not there."""
    there = modules(FOLDERS)
    missing = sorted(_short(module) for module in there if part(module) not in layer_of)
    stale = sorted(set(layer_of) - {part(module) for module in there})
    report("modules in no layer", missing)
    report("names of layers that are no module", stale)


def test_no_import_goes_upwards(graph, layer_of):
    """A module imports from its own layer and from those below it."""
    report("imports that go upwards", upward(graph, layer_of))


def test_no_circle(graph):
    """No module imports itself by way of others, imports inside functions among them."""
    report(
        "circles of imports", [" -> ".join(map(_short, [*circle, circle[0]])) for circle in circles(graph)]
    )


def test_the_oracle_stands_apart(graph):
    """The oracle shares nothing with what it checks but the geometry of the sources."""
    known = {*ORACLE, "oracle"}
    found = [edge for edge in graph if part(edge.source) == "oracle" and part(edge.target) not in known]
    report("imports of the oracle besides the sources", found)


def test_files_that_contributing_names_are_there():
    """The recipes point to real files."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`((?:host|opencl|warp_kernels|tests|performance|docs|\.ci)/[\w./-]+)[ `]", text))
    assert len(named) > 20
    report("files that are not there", sorted(name for name in named if not (ROOT / name).exists()))


def test_kernels_are_launched_where_contributing_says():
    """The table of stems names all of them, and the files in which each is launched."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| `(\w+)` \| [^|]+ \| ([^|]+) \| `tests/", text, re.MULTILINE)
    told = {stem: set(re.findall(r"`(host/[\w/]+\.py)`", files)) for stem, files in rows}
    assert set(told) == {path.stem for path in (ROOT / "opencl").glob("*.cl")}
    launches = {stem: re.compile(rf'launch\(\s*"{stem}"') for stem in told}
    real = {stem: set() for stem in told}
    for path in (ROOT / "host").rglob("*.py"):
        code = path.read_text(encoding="utf-8")
        for stem, launch in launches.items():
            if launch.search(code):
                real[stem].add(str(path.relative_to(ROOT)))
    assert told == real


def rows_of_warnings():
    """The rows of CONTRIBUTING.md's table of warnings."""
    text = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| .+$", text.split("decides on a warning")[1].split("\n\n")[1], re.MULTILINE)[1:]
    assert len(rows) >= 13
    return rows


def test_warnings_are_decided_where_contributing_says():
    """Every name in its table of warnings is defined or used in a file that is named with it."""
    missing = []
    for row in rows_of_warnings():
        cells = row.split("|")[2:4]
        code = [(ROOT / name).read_text(encoding="utf-8") for name in re.findall(r"`(host/[\w/]+\.py)`", row)]
        for name in re.findall(r"`([\w.]+)`", " ".join(cells)):
            last = name.rsplit(".")[-1]
            if not any(
                re.search(rf"^\s*(?:def {last}\b|{last}\b.*=)|\b{last}:", file, re.MULTILINE) for file in code
            ):
                missing.append(name)
    report("names that are not there", missing)


def texts(tree, inside=""):
    """(function, text) of all literals below a node of the syntax tree; of an f-string what comes first."""
    for child in ast.iter_child_nodes(tree):
        if isinstance(child, ast.JoinedStr):
            child = child.values[0]
        if isinstance(child, ast.Constant) and isinstance(child.value, str):
            yield inside, child.value
        yield from texts(child, child.name if isinstance(child, ast.FunctionDef) else inside)


def test_every_warning_is_in_both_tables():
    """What messages.md lists is said somewhere, by a function that CONTRIBUTING.md names with its file."""
    listed = (ROOT / "docs" / "reference" / "messages.md").read_text(encoding="utf-8").split("## Errors")[0]
    cells = re.findall(r"^\| (`[^|]+) \|", listed, re.MULTILINE)
    begins = {word for cell in cells for word in re.findall(r"`([A-Z8][^`]+)`", cell)}
    assert len(begins) > 30
    recipes, said, missing = rows_of_warnings(), set(), []
    for path in sorted((ROOT / "host").rglob("*.py")):
        for function, text in texts(ast.parse(path.read_text(encoding="utf-8"))):
            found = {word for word in begins if re.match(rf"{re.escape(word)}\b", text)}
            said |= found
            place = str(path.relative_to(ROOT))
            named = any(place in row and re.search(rf"\b{function}`", row) for row in recipes)
            warning = re.match(r"[A-Z8][\w -]{2,29}: ", text) or found and " " in text
            if warning and bool(found) != named and function and "\n" not in text:
                missing.append(f"{place} {function}: {text}")
    report("warnings that one table lacks", missing)
    put_together = {  # at run time
        "Open sides",
        "Periodic sides",
        "Small window",
        "Image brighter than the model can make it",
    }
    report("warnings of messages.md that nothing says", sorted(begins - said - put_together))


def constants_of(tree):
    """Names of the constants that a module defines."""
    for node in tree.body:
        if not isinstance(node, (ast.Assign, ast.AnnAssign)) or node.value is None:
            continue
        for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
            names = target.elts if isinstance(target, ast.Tuple) else [target]
            for name in names:
                if isinstance(name, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]+", name.id):
                    yield name.id


def test_a_constant_has_a_name_of_its_own():
    """No two modules of host/ give one name to different constants."""
    places = defaultdict(list)
    for path in sorted((ROOT / "host").rglob("*.py")):
        if "numpy" not in path.parts:  # kernels: float32 copies of what host/constants.py holds
            for name in constants_of(ast.parse(path.read_text(encoding="utf-8"))):
                places[name].append(str(path.relative_to(ROOT)))
    assert len(places) > 400
    report("names of several constants", [f"{name}: {at}" for name, at in places.items() if len(at) > 1])


def definitions(tree, prefix=""):
    """(qualified name, node) of all functions and classes below a node of the syntax tree."""
    for child in ast.iter_child_nodes(tree):
        named = isinstance(child, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef))
        name = f"{prefix}{child.name}" if named else prefix
        if named:
            yield name, child
        yield from definitions(child, f"{name}." if named else prefix)


def large_definitions(path, place):
    """{place: size} of functions of more than FUNCTION_LINES lines and classes of more than CLASS_METHODS.

    A function's lines count from ``def`` to its last one, a class's methods with its properties.
    """
    found = {}
    for name, node in definitions(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ClassDef):
            size = sum(isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef)) for one in node.body)
            limit = CLASS_METHODS
        else:
            size, limit = node.end_lineno - node.lineno + 1, FUNCTION_LINES
        if size > limit:
            found[f"{place}:{name}"] = size
    return found


def long_lines(path, place):
    """{place: count} if the file has lines of more than COLUMNS columns; else nothing."""
    count = sum(len(line) > COLUMNS for line in path.read_text(encoding="utf-8").splitlines())
    return {place: count} if count else {}


def beyond(found, allowed):
    """Faults in words: sizes that are not allowed or above what is, and allowances that nothing needs."""
    return [
        *(f"{name}: {size}" for name, size in sorted(found.items()) if name not in allowed),
        *(
            f"{name}: {found[name]}, and {size} is allowed"
            for name, size in allowed.items()
            if found.get(name, 0) > size
        ),
        *(f"{name}: fits, remove it from ALLOWED" for name in allowed if name not in found),
    ]


def sources_of(*folders, suffixes):
    """(file, its place from the top of the repository) of all files with these suffixes."""
    found = [path for folder in folders for path in sorted((ROOT / folder).rglob("*"))]
    return [(path, path.relative_to(ROOT).as_posix()) for path in found if path.suffix in suffixes]


def test_functions_and_classes_are_not_too_large():
    """No function under host/ has more than 80 lines, no class more than 15 methods."""
    found = {}
    for path, place in sources_of("host", suffixes={".py"}):
        found |= large_definitions(path, place)
    allowed = {place: size for place, size in ALLOWED.items() if ":" in place}
    report(
        f"functions beyond {FUNCTION_LINES} lines or classes beyond {CLASS_METHODS} methods",
        beyond(found, allowed),
    )


def test_lines_are_not_too_long():
    """No line of the package, kernels in OpenCL C among it, has more than 110 columns."""
    found = {}
    for path, place in sources_of("host", "opencl", "warp_kernels", suffixes={".py", ".cl", ".h"}):
        found |= long_lines(path, place)
    allowed = {place: size for place, size in ALLOWED.items() if ":" not in place}
    report(f"files with lines beyond {COLUMNS} columns, and how many", beyond(found, allowed))


def test_what_is_too_large_is_found(tmp_path):
    """One line more than allowed, one method more, one column more; at the limit nothing is found."""
    path = tmp_path / "made_up.py"

    def text(more):
        body = "        pass\n" * (FUNCTION_LINES - 1 + more)
        methods = "    @property\n    def p(self): pass\n" * (CLASS_METHODS - 1 + more)
        return f"class A:\n    def f(self):\n{body}{methods}{'#' * (COLUMNS + more)}\n"

    path.write_text(text(0), encoding="utf-8")
    assert large_definitions(path, "a.py") == long_lines(path, "a.py") == {}
    path.write_text(text(1), encoding="utf-8")
    assert large_definitions(path, "a.py") == {"a.py:A": CLASS_METHODS + 1, "a.py:A.f": FUNCTION_LINES + 1}
    assert long_lines(path, "a.py") == {"a.py": 1}


def test_allowances_only_shrink():
    """Allowed sizes pass; larger ones, others, and allowances that are no longer needed do not."""
    assert beyond({"a": 90}, {"a": 90}) == beyond({"a": 85}, {"a": 90}) == []
    assert beyond({"a": 91, "b": 81}, {"a": 90, "c": 82}) == [
        "b: 81",
        "a: 91, and 90 is allowed",
        "c: fits, remove it from ALLOWED",
    ]


MADE_UP = {
    "__init__.py": "from .high import top\n",
    "high/__init__.py": "from .top import TOP\n",
    "high/top.py": "import numpy\nfrom .. import middle\nfrom ..low import base\nTOP = 1\n",
    "middle.py": "import skylamp.low.base\ndef f():\n    from .high import TOP\n",
    "low/__init__.py": "",
    "low/base.py": (
        "from typing import TYPE_CHECKING\n"
        "if TYPE_CHECKING:\n    from ..high import top\nelse:\n    from . import one\n"
    ),
    "low/one.py": (
        "import importlib\ndef f(stem):\n    importlib.import_module(f'.kernels.{stem}', __package__)\n"
    ),
    "low/kernels/__init__.py": "",
    "low/kernels/two.py": "from ...middle import f\n",
    "stray.py": "",
}


@pytest.fixture
def made_up(tmp_path):
    """Modules of a small package with one fault of each kind."""
    for name, text in MADE_UP.items():
        path = tmp_path / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8")
    return modules({"skylamp": tmp_path})


def test_faults_of_a_small_package_are_found(made_up):
    """Imports in functions, of computed names and of holding packages count; those for type checkers not."""
    edges = imports(made_up)
    assert {(_short(edge.source), _short(edge.target)) for edge in edges} == {
        ("skylamp", "high"),
        ("skylamp", "high.top"),
        ("high", "high.top"),
        ("high.top", "middle"),
        ("high.top", "low"),
        ("high.top", "low.base"),
        ("middle", "low"),
        ("middle", "low.base"),
        ("middle", "high"),
        ("low.base", "low.one"),
        ("low.one", "low.kernels"),
        ("low.one", "low.kernels.two"),
        ("low.kernels.two", "middle"),
    }
    layer_of = layers("```layers\nskylamp\nhigh\nmiddle\nlow\n```\n")
    assert [(_short(edge.source), _short(edge.target), edge.place) for edge in upward(edges, layer_of)] == [
        ("low.kernels.two", "middle", f"{made_up['skylamp.low.kernels.two']}:1"),
        ("middle", "high", f"{made_up['skylamp.middle']}:3"),
    ]
    assert [[_short(module) for module in circle] for circle in circles(edges)] == [
        ["high", "high.top", "low.base", "low.one", "low.kernels.two", "middle"],
        ["high", "high.top", "middle"],
        ["low.base", "low.one", "low.kernels.two", "middle"],
    ]
    assert [name for name in made_up if part(name) not in layer_of] == ["skylamp.stray"]


def test_a_name_in_two_layers_is_refused():
    """Else the second place would win without a word."""
    with pytest.raises(AssertionError, match="listed twice"):
        layers("```layers\nlight\nlow light\n```\n")
