"""Imports of the product: read from the sources, checked by `test_house.py`, and drawn by rooms.

    python tests/import_graph.py --out docs/pictures/imports_after.png
    python tests/import_graph.py --root ../before --out imports_before.png    # another checkout

A box is a room, or a single module of a folder that has rooms; it is above all that it imports. An arrow is as thick as
there are imports. Red: rooms that import each other. Imports inside functions count, imports for type checkers do not.
"""

from __future__ import annotations

import argparse
import ast
import collections
import functools
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from itertools import permutations
from pathlib import Path

import matplotlib
from matplotlib import pyplot
from matplotlib.colors import to_rgb
from PIL import Image

PACKAGE = "arena_newton"
OUTSIDE = ("benchmarks", "scene_builders")
"""Folders next to the package, for work in a checkout: they import it, and nothing in it imports them."""
ROOMS = {"kernels": 0, "usd_scenes": 1, PACKAGE: 1, "trackers": 2, "policies": 3, "eval": 4}
ROOMS |= dict.fromkeys(OUTSIDE, 6)
"""Folder → level; a module imports from its own level and from those below. Scenes are next to the world: the world
reads their files with their checks, which load a scene to look at it."""
INNER = {
    f"{PACKAGE}.eval": """records | statistics | plan | folders | reports | play | adapters workers | suites | tables
        | audit certification studies loop bench | leaderboard | commands | __main__""",
    f"{PACKAGE}.eval.certification": """certify_options stand_ins | context | finding | claims | checks
        | certificate jobs | certify""",
    PACKAGE: """errors | files | cli pages | robot | interfaces rules | kernel_cache tasks | physics | rule_sets
        | pictures recorders | tracking | env | rollout | data | differentiable testing | doctor | __main__""",
    f"{PACKAGE}.data": "readers | recording | datasets | checks | __main__",
    f"{PACKAGE}.policies": """chunk_flags recipes | base | label_reader open_loop stand serve_example | protocols
        | replay_dataset | replay | lerobot | experts learned remote | serve | train | teleop | policy_check""",
    f"{PACKAGE}.policies.train": """frames network_memory policy_options teachable_network training_log
        | checkpoint_packing families stored_flags teachable | network_compiler | policy_trainer | training_state
        | trained_start training_loop | training | training_check __main__""",
    f"{PACKAGE}.trackers": """interface motions | base | inference | front_end
        | evaluation mjlab pd sonic train twist2 | evaluate tracker_check __main__""",
    f"{PACKAGE}.trackers.train": """checkpoint curves model references train_options | export logger sampling simulation
        | terms | graphs tally | ppo tracker_env | runner | session | __main__""",
}
"""Folder → its rooms and single modules from the bottom to the top: each imports from those before it. Imports for type
checkers count here."""
NAMES_ABOVE = {
    f"{PACKAGE}.interfaces": "protocols name the types that they connect",
    f"{PACKAGE}.trackers.interface": "an interface names the front end and the network that it stands for",
    f"{PACKAGE}.tasks": "a judge is handed the scene and the physics that it reads",
    f"{PACKAGE}.trackers.train.terms": "a term is handed the worlds of the training that it reads",
}
"""Rooms whose imports for type checkers may name what stands above them, and why."""
FRONT_DOOR = f"{PACKAGE}.__main__"
"""The command line imports every other module by name when it is asked for; it is above all rooms."""


@dataclass(frozen=True)
class Import:
    """One import of a product module by another."""

    source: str
    target: str
    line: int
    late: bool
    """Inside a function."""
    checking: bool = False
    """For type checkers alone."""


@dataclass(frozen=True)
class Module:
    """One source file of the product."""

    name: str
    path: Path
    tree: ast.Module

    @functools.cached_property
    def nodes(self) -> list[ast.AST]:
        """Syntax tree, flat."""
        return list(ast.walk(self.tree))

    @functools.cached_property
    def statements(self) -> list[tuple[ast.Import | ast.ImportFrom, bool, bool]]:
        """Import statements, and whether each is inside a function and whether it is for type checkers alone."""
        found: list[tuple[ast.Import | ast.ImportFrom, bool, bool]] = []

        def walk(nodes: Iterable[ast.AST], late: bool, checking: bool) -> None:
            for node in nodes:
                if isinstance(node, ast.Import | ast.ImportFrom):
                    found.append((node, late, checking))
                elif isinstance(node, ast.If) and isinstance(node.test, ast.Name) and node.test.id == "TYPE_CHECKING":
                    walk(node.body, late, True)
                    walk(node.orelse, late, False)
                elif not isinstance(node, ast.expr):
                    function = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
                    walk(ast.iter_child_nodes(node), late or function, checking)

        walk(self.tree.body, False, False)
        return found

    @property
    def running(self) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
        """Import statements that run, and whether each is inside a function."""
        return ((statement, late) for statement, late, checking in self.statements if not checking)

    @property
    def room(self) -> str:
        """Top-level folder."""
        parts = self.name.split(".")
        return next((part for part in (parts[0], *parts[1:2]) if part in ROOMS and part != PACKAGE), PACKAGE)

    @property
    def level(self) -> int:
        """Level of the room; the front door is above all rooms of the package."""
        return ROOMS["eval"] + 1 if self.name == FRONT_DOOR else ROOMS[self.room]


def modules(root: Path) -> dict[str, Module]:
    """Every module of a checkout by its name."""
    found = {}
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            if room == PACKAGE and len(parts) > 1 and parts[1] in ROOMS:
                continue  # the link to another room
            parts = parts if parts[0] in (PACKAGE, *OUTSIDE) else (PACKAGE, *parts)
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = path.read_text(encoding="utf-8")
            found[name] = Module(name, path, ast.parse(text))
    return found


def imported(statement: ast.Import | ast.ImportFrom, module: Module, known: dict[str, Module]) -> Iterator[str]:
    """Product modules that a statement imports."""
    if isinstance(statement, ast.Import):
        yield from (alias.name for alias in statement.names if alias.name in known)
        return
    base = statement.module or ""
    if statement.level:
        package = module.name if module.path.name == "__init__.py" else module.name.rpartition(".")[0]
        above = package.split(".")[: len(package.split(".")) - statement.level + 1]
        base = ".".join([*above, *filter(None, [base])])
    for alias in statement.names:
        inner = f"{base}.{alias.name}"
        if inner in known:
            yield inner
        elif base in known and base != PACKAGE:  # the package's own version and lazy names run nothing
            yield base


def imports(known: dict[str, Module], *, checking: bool = False) -> list[Import]:
    """Every import of one product module by another that runs, or that is for type checkers."""
    return [
        Import(module.name, target, statement.lineno, late, checking)
        for module in known.values()
        for statement, late, for_checkers in module.statements
        if for_checkers == checking
        for target in imported(statement, module, known)
        if target != module.name
    ]


def circles(edges: list[Import]) -> list[list[str]]:
    """Groups of modules each of which imports all others of the group, directly or not (Tarjan 1972)."""
    following: dict[str, list[str]] = {}
    for edge in edges:
        following.setdefault(edge.source, []).append(edge.target)
    index: dict[str, int] = {}
    low: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(node: str) -> None:
        index[node] = low[node] = len(index)
        stack.append(node)
        for other in following.get(node, ()):
            if other not in index:
                visit(other)
                low[node] = min(low[node], low[other])
            elif other in stack:
                low[node] = min(low[node], index[other])
        if low[node] == index[node]:
            group = stack[stack.index(node) :]
            del stack[stack.index(node) :]
            if len(group) > 1:
                found.append(sorted(group))

    for node in sorted(following):
        if node not in index:
            visit(node)
    return found


def upward(edges: list[Import], known: dict[str, Module]) -> list[Import]:
    """Imports of a room above."""
    return [e for e in edges if known[e.target].level > known[e.source].level and e.target != FRONT_DOOR]


def part_of(name: str, folder: str) -> str:
    """Room or single module of a folder that a module belongs to; empty for the folder itself and strangers."""
    inside = name.removeprefix(f"{folder}.") if name.startswith(f"{folder}.") else ""
    part = inside.partition(".")[0]
    return "" if folder == PACKAGE and part in ROOMS else part


def upward_rooms(edges: list[Import]) -> list[Import]:
    """Imports of a room by another one of its folder that does not stand above it."""
    found = []
    for folder, text in INNER.items():
        level = {part: number for number, parts in enumerate(text.split("|")) for part in parts.split()}
        for edge in edges:
            source, target = part_of(edge.source, folder), part_of(edge.target, folder)
            named = edge.checking and f"{folder}.{source}" in NAMES_ABOVE
            if source and target and source != target and level[target] >= level[source] and not named:
                found.append(edge)
    return found


SPLIT = (PACKAGE, f"{PACKAGE}.data", *(f"{PACKAGE}.{room}" for room in ("trackers", "policies", "eval")))
"""Folders of which a picture shows the parts."""
_SHADES = "#8d6e63 #c0a030 #2e7d32 #1565c0 #6a1b9a #37474f #546e7a #b08a50".split()
COLOURS = dict(zip(ROOMS, _SHADES, strict=True))
"""Colour of each top-level folder in a picture."""


def node_of(module: Module) -> str:
    """Room of a module in a picture: the part of the innermost divided folder, such as `eval.plan` or `env`."""
    inner = {part for folder in SPLIT if (part := part_of(module.name, folder)) and f"{folder}.{part}" not in SPLIT}
    folders = [f for f in SPLIT if part_of(module.name, f) in inner]
    name = f"{folders[-1]}.{part_of(module.name, folders[-1])}" if folders else f"{PACKAGE}.{module.room}"
    return name.removeprefix(f"{PACKAGE}.")


def levels(edges: Collection[tuple[str, str]], nodes: Iterable[str]) -> dict[str, int]:
    """Level of each room: one above the highest room that it imports; rooms of a circle share theirs."""
    groups = circles([Import(source, target, 0, False) for source, target in edges])
    one = {name: group[0] for group in groups for name in group}
    below: dict[str, set[str]] = {}
    for source, target in edges:
        if one.get(source, source) != one.get(target, target):
            below.setdefault(one.get(source, source), set()).add(one.get(target, target))
    found: dict[str, int] = {}

    def level(node: str) -> int:
        if node not in found:
            found[node] = 1 + max((level(other) for other in below.get(node, ())), default=-1)
        return found[node]

    return {node: level(one.get(node, node)) for node in nodes}


def draw(root: Path, out: Path, title: str) -> None:
    """Write the picture of a checkout's rooms and their imports."""
    matplotlib.use("Agg")
    known = modules(root)
    edges = imports(known)
    used = {name for edge in edges for name in (edge.source, edge.target)}
    rooms: dict[str, list[Module]] = {}
    for name, module in known.items():
        if name in used or module.path.name != "__init__.py":
            rooms.setdefault(node_of(module), []).append(module)
    room = {module.name: name for name, inside in rooms.items() for module in inside}
    count = collections.Counter((room[e.source], room[e.target]) for e in edges if room[e.source] != room[e.target])
    rows: dict[int, list[str]] = {}
    for name, level in levels(count, rooms).items():
        rows.setdefault(level, []).append(name)
    both = {pair for group in circles([Import(*pair, 0, False) for pair in count]) for pair in permutations(group, 2)}
    at: dict[str, tuple[float, float]] = {}
    wide = 7.0 + 0.5 * max(map(len, rows.values()))
    for level in sorted(rows):  # a room stands above the middle of what it imports
        middle = {
            name: sum(at[b][0] * n for (a, b), n in count.items() if a == name and b in at)
            / max(1, sum(n for (a, b), n in count.items() if a == name and b in at))
            for name in rows[level]
        }
        for number, name in enumerate(sorted(rows[level], key=lambda name: (middle[name], name))):
            at[name] = (wide * (number + 0.5) / len(rows[level]) + 0.12 * (level % 2), level)
    figure, axes = pyplot.subplots(figsize=(1.35 * wide, 0.6 * len(rows) + 1.2), dpi=min(80.0, 1250 / wide))
    for pair, number in sorted(count.items(), key=lambda item: (item[0] in both, item[1])):
        shade = [0.35 * part + 0.65 for part in to_rgb(COLOURS[rooms[pair[0]][0].room])]
        colour = "#c62828" if pair in both else shade
        line = {"arrowstyle": "-|>", "color": colour, "linewidth": 0.5 * number**0.6, "shrinkA": 9, "shrinkB": 9}
        line |= {"connectionstyle": "arc3,rad=0.08"}
        axes.annotate("", xy=at[pair[1]], xytext=at[pair[0]], arrowprops=line)
    for name, (x, y) in at.items():
        inside = rooms[name]
        number = sum(module.path.name != "__init__.py" for module in inside)
        files = f"\n{number} files" if number > 1 else ""
        box = {"boxstyle": "round,pad=0.25", "facecolor": "white", "edgecolor": COLOURS[inside[0].room]}
        axes.text(x, y, name + files, ha="center", va="center", fontsize=8.5 if files else 7, bbox=box, zorder=4)
    loose = sum(len(inside) == 1 and inside[0].path.name != "__init__.py" for inside in rooms.values())
    note = f"{len(rooms) - loose} rooms, {loose} single modules, {len(count)} arrows; red: rooms that import each other"
    axes.set_title(
        f"{title}\n{len(known)} modules, {len(edges)} imports, {note} ({len(both & set(count))})", fontsize=11
    )
    axes.set_xlim(-0.4, wide + 0.4)
    axes.set_ylim(-0.6, len(rows) - 0.4)
    axes.axis("off")
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    Image.open(out).convert("RGB").quantize(64, method=Image.Quantize.FASTOCTREE).save(out, optimize=True)


def main() -> None:
    """Draw one checkout."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("."), help="checkout to read")
    parser.add_argument("--out", type=Path, required=True, help="picture to write, .png")
    parser.add_argument("--title", default="Imports of arena_newton", help="line above the picture")
    options = parser.parse_args()
    draw(options.root.resolve(), options.out, options.title)


if __name__ == "__main__":
    main()
