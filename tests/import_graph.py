"""The product's imports: read from the sources, checked by `test_house.py`, and drawn.

    python tests/import_graph.py --out docs/design/imports_after.png
    python tests/import_graph.py --root ../before --out imports_before.png    # another checkout

Rooms are columns, from those that know nobody on the left to those that know everybody on the right; every module is a
row of its room's column. Grey: an import that runs towards the left. Red: one that runs to the right, or one that is
part of a circle. Imports inside functions count, imports for type checkers do not.
"""

from __future__ import annotations

import argparse
import ast
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import matplotlib
from matplotlib import pyplot
from PIL import Image

PACKAGE = "arena_newton"
ROOMS = {"kernels": 0, "usd_scenes": 1, PACKAGE: 1, "trackers": 2, "policies": 3, "eval": 4}
"""Folder → level; a module imports from its own level and from those below. Scenes stand next to the world: the world
reads their files with their checks, their authors load a scene to look at it."""
INNER = {
    f"{PACKAGE}.eval": """records | statistics | plan | folders | reports | play | adapters workers | suites | tables
        | certification studies loop bench | commands | __main__""",
    f"{PACKAGE}.eval.certification": """certify_options stand_ins | context | finding | claims | checks
        | certificate jobs | certify""",
    PACKAGE: """errors | files | cli | robot | interfaces rules | kernel_cache tasks | physics | rule_sets | pictures
        | tracking | env | rollout | data | differentiable testing | doctor | __main__""",
    f"{PACKAGE}.data": "readers | recording | datasets | checks | __main__",
    f"{PACKAGE}.policies": """recipes | base | label_reader open_loop stand serve_example | protocols | replay_dataset
        | replay | lerobot | experts learned remote | serve | train | teleop | policy_check""",
}
"""Folder → its rooms and single modules from the bottom to the top: each imports from those before it. Imports for type
checkers count here."""
NAMES_ABOVE = {
    f"{PACKAGE}.interfaces": "protocols name the types that they connect",
    f"{PACKAGE}.tasks": "a judge is handed the scene and the physics that it reads",
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
    lines: int

    @property
    def room(self) -> str:
        """Top-level folder."""
        second = self.name.split(".")[1] if "." in self.name else ""
        return second if second in ROOMS else PACKAGE

    @property
    def level(self) -> int:
        """Level of the room; the front door is above all."""
        return max(ROOMS.values()) + 1 if self.name == FRONT_DOOR else ROOMS[self.room]


def modules(root: Path) -> dict[str, Module]:
    """Every module of a checkout by its name."""
    found = {}
    for room in ROOMS:
        for path in sorted((root / room).rglob("*.py")):
            parts = path.relative_to(root).with_suffix("").parts
            if room == PACKAGE and len(parts) > 1 and parts[1] in ROOMS:
                continue  # the link to another room
            parts = parts if parts[0] == PACKAGE else (PACKAGE, *parts)
            name = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
            text = path.read_text(encoding="utf-8")
            found[name] = Module(name, path, ast.parse(text), text.count("\n"))
    return found


def statements(tree: ast.AST, *, checking: bool = False) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
    """Import statements that run, or those for type checkers, and whether each stands inside a function."""

    def walk(node: ast.AST, late: bool, runs: bool) -> Iterator[tuple[ast.Import | ast.ImportFrom, bool]]:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.Import | ast.ImportFrom):
                if runs != checking:
                    yield child, late
            elif isinstance(child, ast.If) and "TYPE_CHECKING" in ast.unparse(child.test):
                for part, others in ((child.body, False), (child.orelse, True)):
                    yield from walk(ast.Module(part, []), late, others)
            else:
                function = isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda)
                yield from walk(child, late or function, runs)

    yield from walk(tree, False, True)


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
        for statement, late in statements(module.tree, checking=checking)
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


def draw(root: Path, out: Path, title: str) -> None:
    """Write the picture of a checkout's imports."""
    matplotlib.use("Agg")
    known = modules(root)
    edges = imports(known)
    group_of = {name: number for number, group in enumerate(circles(edges)) for name in group}
    wrong = set(upward(edges, known))
    wrong |= {e for e in edges if e.source in group_of and group_of[e.source] == group_of.get(e.target)}
    columns: dict[str, list[str]] = {}
    for name, module in known.items():
        inner = name.split(".")
        if module.path.name == "__init__.py" and not any(name in (e.source, e.target) for e in edges):
            continue
        folder = inner[1:-1] if module.room == PACKAGE else inner[2:-1]
        wide = module.room in (PACKAGE, "trackers") and folder
        columns.setdefault(f"{module.room}/{folder[0]}" if wide else module.room, []).append(name)
    order = [c for room in ROOMS for c in sorted(columns) if c == room or c.startswith(f"{room}/")]
    across = {column: 2.0 * i for i, column in enumerate(order)}
    height = max(len(names) for names in columns.values())
    at: dict[str, tuple[float, float]] = {}
    for column in order:
        names = sorted(columns[column])
        gap = height / (len(names) + 1)
        for row, name in enumerate(names):
            at[name] = (across[column], height - gap * (row + 1))
    figure, axes = pyplot.subplots(figsize=(2.3 * len(order), 0.36 * height + 1.6), dpi=95)
    for edge in sorted(edges, key=lambda e: e in wrong):
        if edge.source not in at or edge.target not in at:
            continue
        red = edge in wrong
        axes.annotate(
            "",
            xy=at[edge.target],
            xytext=at[edge.source],
            arrowprops={
                "arrowstyle": "-|>" if red else "-",
                "color": "#c62828" if red else "#78909c",
                "alpha": 0.9 if red else 0.22,
                "linewidth": 1.6 if red else 0.6,
                "connectionstyle": "arc3,rad=0.25" if at[edge.source][0] == at[edge.target][0] else "arc3,rad=0.03",
                "shrinkA": 3,
                "shrinkB": 3,
            },
            zorder=3 if red else 1,
        )
    bad = {name for edge in wrong for name in (edge.source, edge.target)}
    for name, (x, y) in at.items():
        short = name.removeprefix(f"{PACKAGE}.")
        for prefix in sorted(order, key=len, reverse=True):
            short = short.removeprefix(prefix.removeprefix(f"{PACKAGE}/").replace("/", ".") + ".")
        box = {"boxstyle": "round,pad=0.2", "facecolor": "#fdecea" if name in bad else "white", "linewidth": 0.5}
        box["edgecolor"] = "#c62828" if name in bad else "#b0bec5"
        axes.text(x, y, short, ha="center", va="center", fontsize=7.5, bbox=box, zorder=4)
    for column in order:
        label = column.replace("/", "/\n")
        axes.text(across[column], height + 0.4, label, ha="center", va="bottom", fontsize=11, fontweight="bold")
    lines, count = sum(m.lines for m in known.values()), len(circles(edges))
    up = len(upward(edges, known))
    note = f"{len(known)} modules, {lines} lines, {len(edges)} imports ({sum(e.late for e in edges)} inside functions)"
    axes.set_title(f"{title}\n{note}; {up} upward, {count} circles", fontsize=12, pad=34)
    axes.set_xlim(-1.0, across[order[-1]] + 1.0)
    axes.set_ylim(-0.5, height + 1.4)
    axes.axis("off")
    figure.tight_layout()
    out.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(out)
    Image.open(out).convert("RGB").quantize(64, method=Image.Quantize.FASTOCTREE).save(
        out, optimize=True
    )  # a fifth of the size


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
