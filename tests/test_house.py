"""The order of the house: which way imports run, what is private, how large a file is, which names stand twice.

Each test lists everything that breaks its rule, as `file:line: what`, and each table of exceptions says why.
"""

import ast
import collections
import functools
import re
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement

from arena_newton import tasks
from arena_newton.eval.__main__ import COMMANDS
from arena_newton.eval.records.identity import UNHASHED
from arena_newton.eval.tables.paper_numbers import PAPER_MODES
from arena_newton.rules.modes import HELD_OUT
from arena_newton.trackers.interface import MODULES
from tests.import_graph import (
    INNER,
    OUTSIDE,
    PACKAGE,
    Import,
    Module,
    circles,
    imports,
    modules,
    part_of,
    upward,
    upward_rooms,
)

ROOT = Path(__file__).resolve().parents[1]

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
LISTED = {
    "task": (tasks.PAPER, {"arena_newton/tasks/__init__.py"}, 5),
    "mode": (PAPER_MODES, {"arena_newton/rules/modes.py"}, 2),
    "held-out look": (HELD_OUT, {"arena_newton/rules/modes.py", "scene_builders/patterns.py"}, 2),
    "tracker": (tuple(MODULES), {"trackers/interface.py"}, 3),
    "channel of motion commands": (
        "trackers/motions/commands.py:MotionCommand",
        {"trackers/motions/commands.py", "kernels/footwork.py"},
        2,
    ),
    "key of the journal": (
        "eval/records/journal.py:EpisodeRecord",
        {"eval/records/journal.py", "eval/play/run.py"},
        2,
    ),
    "command of eval": (tuple(COMMANDS), {"eval/__main__.py"}, 2),
}
"""Kind of thing that is added → those that there are, or the class whose fields they are, files that list them, and
most places of a new one: these files and its own (task: record, kernel, scene, expert; tracker: module, weights; mode:
what it does; command: module)."""
OF_THE_PAPER = {
    "arena_newton/data/recording/layouts.py": "trackers that the original's datasets name",
    "eval/certification/certify_options.py": "trackers that are certified when none is named",
    "eval/certification/checks/failures.py": "seeds on which thresholds were set",
    "eval/certification/checks/rule_ticks.py": "the paper's rules, held to a second implementation",
    "eval/plan/options.py": "trackers of the default run",
    "eval/studies/action_map.py": "the paper's colours",
    "eval/tables/paper_claims.py": "the paper's claims",
    "eval/tables/paper_numbers.py": "the paper's tables",
    "eval/tables/suite_tables.py": "order of the paper's columns",
}
"""Files that list the paper's tasks, modes or trackers, or those that ship, and need no line for another one."""
MOST_LINES = 600
MOST_FILES = 20
STEMS = {
    "base": "the base class of a room's kind of thing",
    **dict.fromkeys(tasks.OWN, "a task, its expert and the builder of its scene"),
    "g1": "the robot, and the builder of its layer",
    "lab": "the worlds of the tracker suite, and the builder of their scene",
    "rotations": "those of kernels in Warp, those of everybody else in torch and NumPy",
    "canonical": "the layout, and its kernels",
}
"""Stems that two modules share, and why."""


@functools.cache
def known() -> dict[str, Module]:
    """Every module of the product by its name."""
    return modules(ROOT)


@functools.cache
def edges() -> list[Import]:
    """Every import of one by another that runs."""
    return imports(known())


def place(module: Module, line: int) -> str:
    """File and line as an editor opens them."""
    return f"{module.path.relative_to(ROOT)}:{line}"


def report(found: list[str]) -> None:
    """Fail with every violation."""
    if found:
        pytest.fail(f"{len(found)}:\n" + "\n".join(sorted(found)), pytrace=False)


def test_imports_have_no_circle():
    """No module imports itself through others, imports inside functions counted."""
    groups = circles(edges())
    report(
        [
            f"{place(known()[e.source], e.line)}: imports {e.target}, circle of {', '.join(group)}"
            for group in groups
            for e in edges()
            if e.source in group and e.target in group
        ]
    )


def test_imports_run_one_way():
    """No room imports a room above it: kernels, the world and its scenes, trackers, policies, eval, benchmarks."""
    report([f"{place(known()[e.source], e.line)}: imports {e.target}" for e in upward(edges(), known())])


def test_rooms_stand_in_order():
    """No room imports one of its folder that does not stand below it, for type checkers neither; each has its place."""
    found = upward_rooms([*edges(), *imports(known(), checking=True)])
    report([f"{place(known()[e.source], e.line)}: imports {e.target}" for e in found])
    for folder, order in INNER.items():
        assert {part_of(name, folder) for name in known()} - {""} == set(order.replace("|", " ").split()), folder


def test_rooms_are_small():
    """No folder holds more than 20 modules; the front doors of the world and of the evaluation hold few."""
    count = collections.Counter(module.path.parent for module in known().values() if module.path.name != "__init__.py")
    report([f"{folder.relative_to(ROOT)}: {number} modules" for folder, number in count.items() if number > MOST_FILES])
    assert count[ROOT / "eval"] <= 2 and count[ROOT / PACKAGE] <= 9


def test_the_page_of_rooms_names_each():
    """`docs/reference/rooms.md` lists the rooms of each folder from the bottom to the top, and where names are."""
    page = (ROOT / "docs" / "reference" / "rooms.md").read_text()
    packages = {module.name for module in known().values() if module.path.name == "__init__.py"}
    for folder in (PACKAGE, *(f"{PACKAGE}.{name}" for name in ("data", "trackers", "policies", "eval"))):
        title = folder.replace(".", "/") if folder.endswith("data") else f"{folder.split('.')[-1]}/"
        listed = re.findall(r"^\| `(\w+)` \|", page.split(f"### `{title}`")[1].split("\n#")[0], flags=re.MULTILINE)
        groups = [[p for p in part.split() if f"{folder}.{p}" in packages] for part in INNER[folder].split("|")]
        assert listed == [name for group in groups for name in sorted(group, key=[*listed, *group].index)], folder
    unhashed = page.split("Not hashed there: ")[1].split(";")[0]
    assert re.findall(r"`([\w/]+)`", unhashed) == [room for room in UNHASHED if not room.startswith("eval/")]
    for file, name in re.findall(r"\]\(../../(\S+)\): `(\w+)`", page):
        assert re.search(rf"(def|class) {name}\b", (ROOT / file).read_text()), f"{file}: no {name}"


QUESTION = re.compile(r"(What|Who|Whose|Whom|Why|Whether|Where|When|Which|How|Of|By|As|So|Such|From|In|To)\b")
"""Words with which no docstring begins: it begins with a noun of the field or a verb."""


def test_docstrings_name_what_they_describe():
    """No docstring of the product begins like a question or amid a phrase: `True if …`, `Number of …`."""
    found = collections.defaultdict(list)
    for module in known().values():
        for node in module.nodes:
            text = node.value.value if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) else None
            if isinstance(text, str) and QUESTION.match(text):
                found[str(module.path.parent.relative_to(ROOT))].append(f"{place(module, node.lineno)}: {text[:60]}")
    report([line for lines in found.values() for line in lines])


def private(name: str) -> bool:
    """True if a name is one module's own."""
    return name.startswith("_") and not name.startswith("__")


def test_private_names_stay_at_home():
    """No module imports or reads another one's private names."""
    found = []
    for module in known().values():
        for statement, _ in module.running:
            if isinstance(statement, ast.ImportFrom) and (statement.module or "").startswith((PACKAGE, *OUTSIDE)):
                names = [a.name for a in statement.names if private(a.name)]
                found += [f"{place(module, statement.lineno)}: {statement.module}.{name}" for name in names]
        # Attributes that the file sets, methods that it defines: its own, on whatever they are read.
        own = {n.attr for n in module.nodes if isinstance(n, ast.Attribute) and isinstance(n.ctx, ast.Store)}
        own |= {n.name for n in module.nodes if isinstance(n, ast.FunctionDef | ast.ClassDef)}
        own |= {n.id for n in module.nodes if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        strangers = set()  # modules of other packages keep their own order
        for statement, _ in module.running:
            source = statement.module or "" if isinstance(statement, ast.ImportFrom) else ""
            for alias in statement.names:
                if not (source or alias.name).startswith((PACKAGE, *OUTSIDE)):
                    strangers.add((alias.asname or alias.name).split(".")[0])
        inherited = {"_replace", "_asdict", "_fields", "_version", "_is_view"}  # of named tuples and of tensors
        for node in module.nodes:
            if isinstance(node, ast.Attribute) and private(node.attr) and node.attr not in own | inherited:
                base = ast.unparse(node.value).split(".")[0].split("(")[0]
                if base not in strangers | {"self", "cls", "super"}:
                    found.append(f"{place(module, node.lineno)}: {ast.unparse(node)}")
    report(found)


def signatures(module: Module) -> list[tuple[int, ast.expr]]:
    """Line and annotation of every argument and answer."""
    found = []
    for node in module.nodes:
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
    for module in known().values():
        if module.room in (PACKAGE, "eval", "policies"):
            for line, annotation in signatures(module):
                if re.search(r"\bAny\b", ast.unparse(annotation)):
                    found.append((str(module.path.relative_to(ROOT)), place(module, line)))
    report([where for file, where in found if file not in ANY])
    assert len(found) <= MOST_ANY, f"{len(found)}:\n" + "\n".join(sorted(where for _, where in found))
    assert not set(ANY) - {file for file, _ in found}, "no longer needed"


def loaded(*starts: str) -> set[str]:
    """Modules that an import of these loads, imports inside functions aside."""
    following = collections.defaultdict(set)
    for edge in edges():
        if not edge.late:
            following[edge.source].add(edge.target)
    found: set[str] = set()
    todo = [*starts]
    while todo:
        name = todo.pop()
        if name not in found:
            found.add(name)
            packages = [name.rsplit(".", n)[0] for n in range(1, name.count(".") + 1)]
            todo += [*following[name], *(p for p in packages if p in known())]
    return found


def tops(statement: ast.Import | ast.ImportFrom) -> set[str]:
    """Packages that a statement imports."""
    names = [a.name for a in statement.names] if isinstance(statement, ast.Import) else [statement.module or ""]
    return {name.split(".")[0] for name in names}


def test_heavy_imports_stand_at_the_top():
    """Only what a `--help` or a plan loads imports heavy libraries late; it imports none at its top."""
    starts = [f"{top}.__main__" for top in OUTSIDE] + [f"{PACKAGE}.{start}" for start in STARTS + PLANNING]
    found, lights = [], loaded(*starts)
    for module in known().values():
        for statement, late in module.running:
            for name in sorted(tops(statement) & HEAVY):
                if not late and module.name in lights:
                    found.append(
                        f"{place(module, statement.lineno)}: {name} at the top of a module that --help or a plan loads"
                    )
                if late and module.name not in lights | set(LATE) and name not in OPTIONAL:
                    found.append(f"{place(module, statement.lineno)}: {name} inside a function")
    report(found)
    assert not set(LATE) - set(known()), "no such module"


LIGHT = {
    ("eval.adapters.lerobot_env",): {"warp", "newton", "mujoco", "pxr"},
    ("policies.protocols.arena_codec", "policies.protocols.handshake"): {"msgpack", "websockets"},
    ("policies.learned.learned_policy",): {"lerobot", "torchvision", "draccus", "transformers"},
}
"""Modules whose import does not load some libraries."""


@pytest.mark.parametrize("modules", LIGHT, ids=" and ".join)
def test_light_modules_stay_light(modules):
    """LeRobot's help waits for no physics, handshakes need no `[serve]`, and packed policies no LeRobot."""
    found = [
        f"{place(known()[name], statement.lineno)}: {ast.unparse(statement)}"
        for name in loaded(*(f"{PACKAGE}.{module}" for module in modules))
        for statement, late in known()[name].running
        if not late and tops(statement) & LIGHT[modules]
    ]
    report(found)


def test_what_is_imported_is_a_dependency():
    """Every package that the code imports is named as a direct dependency or extra, not left to another's."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = [line for lines in project["optional-dependencies"].values() for line in lines]
    named = {Requirement(line).name for line in [*project["dependencies"], *extras]}
    names = {"PIL": "pillow", "pxr": "usd-core", "warp": "warp-lang", "cv2": "opencv-python-headless"}
    names |= {"zmq": "pyzmq", "sklearn": "scikit-learn", "huggingface_hub": "huggingface-hub"}
    names |= {"mujoco_warp": "mujoco-warp", "rsl_rl": "rsl-rl-lib"}
    # rsl-rl's own interface is made of tensordicts: whichever it brings is the right one.
    allowed = {*sys.stdlib_module_names, "_typeshed", PACKAGE, *OUTSIDE, "tensordict"}
    # Run by the interpreter of that other program, never imported.
    theirs = {"benchmarks.mjlab_training": {"mjlab"}}
    found = []
    for module in known().values():
        for node in module.nodes:
            if isinstance(node, ast.Import | ast.ImportFrom):
                for top in tops(node) - allowed - theirs.get(module.name, set()):
                    if names.get(top, top) not in named:
                        found.append(f"{place(module, node.lineno)}: imports {top}")
    report(found)


def test_what_no_run_is_known_by_moves_nothing():
    """Only plan and play import unhashed rooms, of these only what is stored, kept and reported; `pages` is for all."""
    rooms = {f"{PACKAGE}.{room.replace('/', '.')}" for room in UNHASHED}

    def unhashed(name: str) -> set[str]:
        return {room for room in rooms if f"{name}.".startswith(f"{room}.")}

    allowed = {f"{PACKAGE}.eval.{room}" for room in ("records", "folders", "reports", "statistics")}
    commands = {f"{PACKAGE}.trackers.{name}" for name in ("evaluate", "tracker_check")}
    found = []
    for edge in [*edges(), *imports(known(), checking=True)]:
        file = known()[edge.source].path
        if unhashed(edge.source) or file.name == "__main__.py" or edge.source.startswith(OUTSIDE):
            continue
        # Command lines by other names; no run imports them.
        if edge.source not in commands and (reached := unhashed(edge.target) - {f"{PACKAGE}.pages"}):
            if part_of(edge.source, f"{PACKAGE}.eval") not in ("plan", "play") or not reached <= allowed:
                found.append(f"{place(known()[edge.source], edge.line)}: imports {edge.target}")
    report(found)


def named_together(node: ast.AST) -> set[str]:
    """Names that a collection, a call's keywords or a class' fields list."""
    match node:
        case ast.Tuple(elts=parts) | ast.List(elts=parts) | ast.Set(elts=parts) | ast.Dict(keys=parts):
            return {str(part.value) for part in parts if isinstance(part, ast.Constant)}
        case ast.Call(keywords=keywords):
            return {str(keyword.arg) for keyword in keywords}
        case ast.ClassDef(body=body):
            return {
                line.target.id for line in body if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
            }
    return set()


@functools.cache
def lists() -> list[tuple[str, set[str]]]:
    """Names that are listed together, with their file."""
    kinds = (ast.Tuple, ast.List, ast.Set, ast.Dict, ast.Call, ast.ClassDef)
    return [
        (str(module.path.relative_to(ROOT)), together)
        for module in known().values()
        for node in module.nodes
        if isinstance(node, kinds) and len(together := named_together(node)) > 1
    ]


@pytest.mark.parametrize("kind", LISTED)
def test_what_is_added_is_added_in_few_places(kind):
    """Tasks, modes, trackers, channels, journal keys and commands are listed where they are registered, nowhere else.

    A file lists them that names half of them together, or all where they are few.
    """
    names, files, most = LISTED[kind]
    if isinstance(names, str):
        file, _, name = names.partition(":")
        tree = ast.parse((ROOT / file).read_text())
        (names,) = (named_together(node) for node in tree.body if isinstance(node, ast.ClassDef) and node.name == name)
    own = {"task": 4, "mode": 1, "tracker": 2, "command of eval": 1}.get(kind, 0)
    assert len(files) + own <= most
    least = len(names) if len(names) < 5 else len(names) / 2
    listing = {file for file, together in lists() if len(together & set(names)) >= least}
    assert files <= listing, "the table is out of date"
    report([f"{file}: lists each {kind}" for file in listing - files - set(OF_THE_PAPER)])


def test_files_are_short():
    """No file of the product or its tests is longer than one sitting."""
    files = [m.path for m in known().values()] + sorted((ROOT / "tests").rglob("*.py"))
    sizes = {str(path.relative_to(ROOT)): path.read_text().count("\n") for path in files}
    report([f"{file}:{MOST_LINES}: {lines} lines" for file, lines in sizes.items() if lines > MOST_LINES])


def test_a_stem_names_one_thing():
    """Two modules have one name only where a table says why."""
    homes = collections.defaultdict(list)
    for module in known().values():
        named = f"{PACKAGE}.eval.commands.{module.path.stem}"  # a command's file has the name of what it calls
        if not module.path.stem.startswith("__") and module.name != named:
            homes[module.path.stem].append(module)
    doubled = {stem: found for stem, found in homes.items() if len(found) > 1}
    report([place(m, 1) for stem, found in doubled.items() if stem not in STEMS for m in found])
    assert not set(STEMS) - set(doubled), "no longer needed"


def test_a_class_name_names_one_thing():
    """No public class name stands twice."""
    homes = collections.defaultdict(list)
    for module in known().values():
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
