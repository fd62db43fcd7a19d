"""Pages of public names for the site, read from the sources: nothing is imported."""

import ast
import functools
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
MODULES = (
    "arena_newton",
    "arena_newton.policies",
    "arena_newton.trackers",
    "arena_newton.tasks",
    "arena_newton.rule_sets",
    "arena_newton.rules.rule_types",
    "arena_newton.rules.modes",
    "arena_newton.robot.canonical",
    "arena_newton.eval.plan.episode_plan",
    "arena_newton.eval.play.factories",
    "arena_newton.differentiable",
    "arena_newton.testing",
    "arena_newton.data.recording.episode",
    "arena_newton.trackers.motions.commands",
    "arena_newton.interfaces",
    "arena_newton.errors",
)
"""Modules with a page, in the order of reading; each page has the names of `__all__`. A name that several modules offer
is explained on the first of their pages."""
SECTION = re.compile(r"(Args|Attributes|Returns|Raises|Yields):")


def source(module: str) -> Path | None:
    """File of a module of this package, or None."""
    path = ROOT.joinpath(*module.split("."))
    return next((file for file in (path / "__init__.py", path.with_suffix(".py")) if file.is_file()), None)


@functools.cache
def parsed(module: str) -> ast.Module:
    """Syntax tree of a module of this package.

    Raises:
        LookupError: There is no such module.
    """
    if file := source(module):
        return ast.parse(file.read_text())
    raise LookupError(f"docs/api_reference.py: no module {module}")


def statements(body: list[ast.stmt]) -> Iterator[tuple[ast.stmt, str]]:
    """Statements of a module or class, those for type checkers too, each with the string that follows it."""
    for number, node in enumerate(body):
        if isinstance(node, ast.If):
            yield from statements(node.body)
        after = body[number + 1] if number + 1 < len(body) else None
        told = isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant) and str(after.value.value)
        yield node, inspect.cleandoc(told or "")


def named(node: ast.stmt) -> list[str]:
    """Names that a statement defines or imports."""
    match node:
        case ast.ClassDef(name=name) | ast.FunctionDef(name=name) | ast.TypeAlias(name=ast.Name(id=name)):
            return [name]
        case ast.Assign(targets=targets):
            return [target.id for target in targets if isinstance(target, ast.Name)]
        case ast.AnnAssign(target=ast.Name(id=name)):
            return [name]
        case ast.ImportFrom(names=names):
            return [alias.asname or alias.name for alias in names]
    return []


def public(tree: ast.Module) -> list[str]:
    """Names of a module's `__all__`."""
    return [
        name
        for node in tree.body
        if isinstance(node, ast.Assign | ast.AugAssign) and node.value
        for target in (node.targets if isinstance(node, ast.Assign) else [node.target])
        if isinstance(target, ast.Name) and target.id == "__all__"
        for name in ast.literal_eval(node.value)
    ]


def definition(module: str, name: str) -> tuple[str, ast.stmt, str] | None:
    """Module, statement and explanation of a public name, wherever it is defined; None for a module.

    Raises:
        LookupError: The module neither defines nor imports the name.
    """
    for node, told in statements(parsed(module).body):
        if name in named(node):
            if not isinstance(node, ast.ImportFrom):
                return module, node, told
            if source(f"{node.module}.{name}"):
                return None
            return definition(str(node.module), name)
    raise LookupError(f"docs/api_reference.py: {module} has no {name}")


def markdown(docstring: str) -> str:
    """A docstring with its sections as lists."""
    lines, section = [], ""
    for line in docstring.splitlines():
        if match := SECTION.fullmatch(line):
            section = match[1]
            lines += ["", f"**{'Parameters' if section == 'Args' else section}**", ""]
        elif section and line and not line.startswith("    "):
            section = ""
            lines += ["", line]
        elif section in ("Args", "Attributes", "Raises") and (entry := re.match(r"    ([\w*, ]+): (.*)", line)):
            lines.append(f"- `{entry[1]}`: {entry[2]}")
        else:
            lines.append(f"  {line.strip()}" if section else line)
    return "\n".join(lines).strip()


def directive(kind: str, head: str, body: str, fence: int, options: str = "") -> str:
    """One object of Sphinx' Python domain."""
    marks = "`" * fence
    return f"{marks}{{py:{kind}}} {head}\n{options}\n{body}\n{marks}\n"


def called(node: ast.FunctionDef, method: bool) -> str:
    """Parameters of a function, without `self`, and what it returns."""
    given = node.args
    if method and not any(ast.unparse(d) == "staticmethod" for d in node.decorator_list):
        (given.posonlyargs or given.args)[:1] = []
    returns = f" -> {ast.unparse(node.returns)}" if node.returns else ""
    return f"({ast.unparse(given)}){returns}"


def value(node: ast.stmt) -> str:
    """Type and short value of a constant, as options of its directive."""
    options = f":type: {ast.unparse(node.annotation)}\n" if isinstance(node, ast.AnnAssign) else ""
    right = getattr(node, "value", None)
    text = ast.unparse(right) if right else ""
    return options + (f":value: {text}\n" if 0 < len(text) <= 80 and "\n" not in text and "field(" not in text else "")


def members(node: ast.ClassDef) -> Iterator[str]:
    """Public attributes, properties and methods of a class."""
    made = next((n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"), None)
    for line, told in statements(made.body if made else []):
        target = line.targets[0] if isinstance(line, ast.Assign) else getattr(line, "target", None)
        if told and isinstance(target, ast.Attribute) and not target.attr.startswith("_"):
            shown = f":type: {ast.unparse(line.annotation)}\n" if isinstance(line, ast.AnnAssign) else ""
            yield directive("attribute", target.attr, markdown(told), 5, shown)
    for line, told in statements(node.body):
        for name in named(line):
            if name.startswith("_"):
                continue
            if isinstance(line, ast.FunctionDef):
                marks = [ast.unparse(mark) for mark in line.decorator_list]
                if any(mark.endswith((".setter", "overload")) for mark in marks):
                    continue
                body = markdown(ast.get_docstring(line) or "")
                if any(mark.endswith("property") for mark in marks):
                    shown = f":type: {ast.unparse(line.returns)}\n" if line.returns else ""
                    yield directive("property", name, body, 5, shown)
                else:
                    shown = "".join(f":{m}:\n" for m in ("classmethod", "staticmethod") if m in marks)
                    yield directive("method", f"{name}{called(line, True)}", body, 5, shown)
            elif isinstance(line, ast.Assign | ast.AnnAssign):
                yield directive("attribute", name, markdown(told), 5, value(line))


def explained(node: ast.stmt, name: str, told: str) -> str:
    """A class, function or constant."""
    if isinstance(node, ast.FunctionDef):
        return directive("function", f"{name}{called(node, False)}", markdown(ast.get_docstring(node) or ""), 6)
    if isinstance(node, ast.ClassDef):
        made = next((n for n in node.body if isinstance(n, ast.FunctionDef) and n.name == "__init__"), None)
        body = [markdown(ast.get_docstring(node) or "")]
        if bases := [f"`{ast.unparse(base)}`" for base in node.bases]:
            body.insert(0, f"Bases: {', '.join(bases)}")
        body.append(markdown((made and ast.get_docstring(made)) or ""))
        head = name + (called(made, True).partition(" -> ")[0] if made else "")
        return directive("class", head, "\n\n".join([*body, *members(node)]), 6)
    return directive("data", name, markdown(told), 6, value(node))


def pages() -> dict[str, str]:
    """Module → its page, in Markdown with directives of MyST.

    Raises:
        LookupError: A module or a public name is not there.
    """
    homes: dict[tuple[str, str], str] = {}
    made = {}
    for module in MODULES:
        tree = parsed(module)
        said = markdown(ast.get_docstring(tree) or "")
        parts = [f"# {module}\n\n{said}\n", f"```{{py:module}} {module}\n```\n"]
        for name in public(tree):
            found = definition(module, name)
            if found is None:
                home = next((m for m in MODULES if m.endswith(f".{name}")), "")
                parts.append(f"- `{name}`: a module" + (f", [{home}]({home}.md)" if home else "") + "\n")
            elif home := homes.get((found[0], name), ""):
                parts.append(f"- `{name}`: explained with [{home}]({home}.md)\n")
            else:
                homes[found[0], name] = module
                parts.append(explained(found[1], name, found[2]))
        made[module] = "\n".join(parts)
    return made
