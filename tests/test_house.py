"""The order of the house: which way imports run, what is private, how large a file is, which names stand twice.

Each test lists everything that breaks its rule, as `file:line: what`, and each table of exceptions says why.
"""

import ast
import collections
import re
from pathlib import Path

import pytest

from arena_newton import tasks
from arena_newton.eval.__main__ import COMMANDS
from tests.import_graph import (
    BENCHMARKS,
    INNER,
    PACKAGE,
    Module,
    circles,
    imports,
    modules,
    part_of,
    statements,
    upward,
    upward_rooms,
)

ROOT = Path(__file__).resolve().parents[1]
KNOWN = modules(ROOT)
EDGES = imports(KNOWN)

HEAVY = set("torch warp newton mujoco mujoco_warp pxr lerobot matplotlib cv2 av onnx onnxruntime rsl_rl".split())
HEAVY |= {"safetensors", "trimesh"}
"""Libraries whose import takes longer than the help of a command may."""
STARTS = (
    "__main__",
    "data.__main__",
    "eval.__main__",
    "trackers.__main__",
    "trackers.evaluate",
    "trackers.train.__main__",
)
STARTS += ("trackers.train.__main__", "trackers.motions.__main__", "usd_scenes.__main__")
STARTS += ("policies.train.__main__",)
STARTS += ("trackers.tracker_check", "policies.policy_check", "policies.teleop.__main__", "policies.serve.__main__")
STARTS += tuple(f"eval.commands.{name}" for name in COMMANDS)
"""Modules whose `--help` answers in half a second: these, and what they import at their top, import nothing heavy."""
PLANNING = ("eval.plan.config", "eval.folders.run_folder", *(f"tasks.{name}" for name in tasks.names()))
"""Modules that expand and check a plan: `eval list` and the refusal of a wrong flag answer at once too. Tasks are
imported by name."""
LATE = {
    "arena_newton.doctor": "it reports libraries that do not import",
    "arena_newton.files.sandboxed_load": "its other process imports only the library that it tries",
    "arena_newton.cli.quiet": "light modules call it before they import Warp",
}
"""Other modules that import heavy libraries inside functions, and why."""
OPTIONAL = {"matplotlib": "an extra; a test without it must pass"}
"""Libraries that may be absent."""
MOST_ANY = 35
ANY = {
    "arena_newton/differentiable/kernel_gradients.py": "a context of autograd keeps whatever it is given",
    "arena_newton/files/untrusted_files.py": "NumPy's dtypes",
    "arena_newton/interfaces.py": "JSON, opaque snapshots and the plan's own episodes",
    "arena_newton/physics/policy_view.py": "a view has the attributes of what it shows",
    "arena_newton/cli/registry.py": "what a maker takes is its own business",
    "policies/base.py": "what a maker takes is its own business, and JSON",
    "policies/remote/arena_client.py": "options of the command line and JSON",
}
"""Files of arena_newton, eval and policies with `Any` in signatures, and why."""
MOST_LINES = 600
MOST_FILES = 20
STEMS = {
    "base": "the base class of a room's kind of thing",
    "build": "every scene has its builder",
    **dict.fromkeys(tasks.names(), "a task and its expert"),
    "rotations": "those of kernels in Warp, those of everybody else in torch and NumPy",
    "canonical": "the layout, and its kernels",
}
"""Stems that two modules share, and why."""


def place(module: Module, line: int) -> str:
    """File and line as an editor opens them."""
    return f"{module.path.relative_to(ROOT)}:{line}"


def report(found: list[str]) -> None:
    """Fail with every violation."""
    if found:
        pytest.fail(f"{len(found)}:\n" + "\n".join(sorted(found)), pytrace=False)


def test_imports_have_no_circle():
    """No module imports itself through others, imports inside functions counted."""
    groups = circles(EDGES)
    report(
        [
            f"{place(KNOWN[e.source], e.line)}: imports {e.target}, circle of {', '.join(group)}"
            for group in groups
            for e in EDGES
            if e.source in group and e.target in group
        ]
    )


def test_imports_run_one_way():
    """No room imports a room above it: kernels, the world and its scenes, trackers, policies, eval, benchmarks."""
    report([f"{place(KNOWN[e.source], e.line)}: imports {e.target}" for e in upward(EDGES, KNOWN)])


def test_rooms_stand_in_order():
    """No room imports one of its folder that does not stand below it, for type checkers neither; each has its place."""
    found = upward_rooms([*EDGES, *imports(KNOWN, checking=True)])
    report([f"{place(KNOWN[e.source], e.line)}: imports {e.target}" for e in found])
    for folder, order in INNER.items():
        assert {part_of(name, folder) for name in KNOWN} - {""} == set(order.replace("|", " ").split()), folder


def test_rooms_are_small():
    """No folder holds more than 20 modules; the front doors of the world and of the evaluation hold few."""
    count = collections.Counter(module.path.parent for module in KNOWN.values() if module.path.name != "__init__.py")
    report([f"{folder.relative_to(ROOT)}: {number} modules" for folder, number in count.items() if number > MOST_FILES])
    assert count[ROOT / "eval"] <= 2 and count[ROOT / PACKAGE] <= 9


def test_the_page_of_rooms_names_each():
    """`docs/design/rooms.md` lists the rooms of each folder from the bottom to the top, and the names at its places."""
    page = (ROOT / "docs" / "design" / "rooms.md").read_text()
    packages = {module.name for module in KNOWN.values() if module.path.name == "__init__.py"}
    for folder in (PACKAGE, f"{PACKAGE}.data", f"{PACKAGE}.policies", f"{PACKAGE}.eval"):
        title = folder.replace(".", "/") if folder.endswith("data") else f"{folder.split('.')[-1]}/"
        listed = re.findall(r"^\| `(\w+)` \|", page.split(f"### `{title}`")[1].split("\n#")[0], flags=re.MULTILINE)
        groups = [[p for p in part.split() if f"{folder}.{p}" in packages] for part in INNER[folder].split("|")]
        assert listed == [name for group in groups for name in sorted(group, key=[*listed, *group].index)], folder
    for file, name in re.findall(r"\]\(../../(\S+)\): `(\w+)`", page):
        assert re.search(rf"(def|class) {name}\b", (ROOT / file).read_text()), f"{file}: no {name}"


def private(name: str) -> bool:
    """True if a name is one module's own."""
    return name.startswith("_") and not name.startswith("__")


def test_private_names_stay_at_home():
    """No module imports or reads another one's private names."""
    found = []
    for module in KNOWN.values():
        for statement, _ in statements(module.tree):
            if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith((PACKAGE, BENCHMARKS)):
                names = [a.name for a in statement.names if private(a.name)]
                found += [f"{place(module, statement.lineno)}: {statement.module}.{name}" for name in names]
        nodes = list(ast.walk(module.tree))
        # Attributes that the file sets, methods that it defines: its own, on whatever they are read.
        own = {n.attr for n in nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)}
        own |= {n.name for n in nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}
        own |= {n.id for n in nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        strangers = set()  # modules of other packages keep their own order
        for statement, _ in statements(module.tree):
            source = statement.module or "" if isinstance(statement, ast.ImportFrom) else ""
            for alias in statement.names:
                if not (source or alias.name).startswith((PACKAGE, BENCHMARKS)):
                    strangers.add((alias.asname or alias.name).split(".")[0])
        inherited = {"_replace", "_asdict"}
        for node in nodes:
            if isinstance(node, ast.Attribute) and private(node.attr) and node.attr not in own | inherited:
                base = ast.unparse(node.value).split(".")[0].split("(")[0]
                if base not in strangers | {"self", "cls", "super"}:
                    found.append(f"{place(module, node.lineno)}: {ast.unparse(node)}")
    report(found)


def signatures(tree: ast.Module) -> list[tuple[int, ast.expr]]:
    """Line and annotation of every argument and answer."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            a = node.args
            for arg in (*a.posonlyargs, *a.args, *a.kwonlyargs, *filter(None, (a.vararg, a.kwarg))):
                if arg.annotation is not None:
                    found.append((arg.lineno, arg.annotation))
            if node.returns is not None:
                found.append((node.lineno, node.returns))
    return found


def test_signatures_say_types():
    """`Any` is in few signatures of the world, the policies and the evaluation, each for a reason."""
    found = []
    for module in KNOWN.values():
        if module.room in (PACKAGE, "eval", "policies"):
            for line, annotation in signatures(module.tree):
                if re.search(r"\bAny\b", ast.unparse(annotation)):
                    found.append((str(module.path.relative_to(ROOT)), place(module, line)))
    report([where for file, where in found if file not in ANY])
    assert len(found) <= MOST_ANY, f"{len(found)}:\n" + "\n".join(sorted(where for _, where in found))
    assert not set(ANY) - {file for file, _ in found}, "no longer needed"


def light() -> set[str]:
    """The modules that a `--help` or a plan loads."""
    following = collections.defaultdict(set)
    for edge in EDGES:
        if not edge.late:
            following[edge.source].add(edge.target)
    found: set[str] = set()
    todo = [f"{BENCHMARKS}.__main__", *(f"{PACKAGE}.{start}" for start in STARTS + PLANNING)]
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            packages = [name.rsplit(".", n)[0] for n in range(1, name.count(".") + 1)]
            todo += [*following[name], *(p for p in packages if p in KNOWN)]
    return found


def tops(statement: ast.Import | ast.ImportFrom) -> set[str]:
    """Packages that a statement imports."""
    names = [a.name for a in statement.names] if isinstance(statement, ast.Import) else [statement.module or ""]
    return {name.split(".")[0] for name in names}


def test_heavy_imports_stand_at_the_top():
    """Only what a `--help` or a plan loads imports heavy libraries late; it imports none at its top."""
    found, lights = [], light()
    for module in KNOWN.values():
        for statement, late in statements(module.tree):
            for name in sorted(tops(statement) & HEAVY):
                if not late and module.name in lights:
                    found.append(
                        f"{place(module, statement.lineno)}: {name} at the top of a module that --help or a plan loads"
                    )
                if late and module.name not in lights | set(LATE) and name not in OPTIONAL:
                    found.append(f"{place(module, statement.lineno)}: {name} inside a function")
    report(found)
    assert not set(LATE) - set(KNOWN), "no such module"


def test_files_are_short():
    """No file of the product or its tests is longer than one sitting."""
    files = [m.path for m in KNOWN.values()] + sorted((ROOT / "tests").rglob("*.py"))
    sizes = {str(path.relative_to(ROOT)): path.read_text().count("\n") for path in files}
    report([f"{file}:{MOST_LINES}: {lines} lines" for file, lines in sizes.items() if lines > MOST_LINES])


def test_a_stem_names_one_thing():
    """Two modules have one name only where a table says why."""
    homes = collections.defaultdict(list)
    for module in KNOWN.values():
        named = f"{PACKAGE}.eval.commands.{module.path.stem}"  # a command's file has the name of what it calls
        if not module.path.stem.startswith("__") and module.name != named:
            homes[module.path.stem].append(module)
    doubled = {stem: found for stem, found in homes.items() if len(found) > 1}
    report([place(m, 1) for stem, found in doubled.items() if stem not in STEMS for m in found])
    assert not set(STEMS) - set(doubled), "no longer needed"


def test_a_class_name_names_one_thing():
    """No public class name stands twice."""
    homes = collections.defaultdict(list)
    for module in KNOWN.values():
        for node in module.tree.body:
            if isinstance(node, ast.ClassDef) and not private(node.name):
                homes[node.name].append(place(module, node.lineno))
    # Interfaces name what they describe after it.
    described = {"Judge", "Physics", "Policy", "Tracker"}
    doubled = {name: found for name, found in homes.items() if len(found) > 1 + (name in described)}
    report([f"{where}: {name}" for name, found in doubled.items() for where in found])


def test_few_tests_are_long():
    """At most twenty tests wait for `pytest -m release`."""
    marks = [
        f"{path.relative_to(ROOT)}: {line}"
        for path in sorted((ROOT / "tests").rglob("test_*.py"))
        for line in path.read_text().splitlines()
        if re.search(r"\bmark\.release$|marks=.*\bmark\.release\b", line)
    ]
    assert len(marks) <= 20, marks
