"""The documentation as a site: these pages, the examples and the public names, with search.

    uv run python docs/build.py --out site

Pages remain as they are. Copies of them, and pages made of examples, glossary and docstrings, are written to a
temporary folder, which Sphinx turns into HTML. A warning is an error: exit code 1.
"""

import argparse
import ast
import importlib.util
import itertools
import os
import re
import shutil
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from pathlib import Path

import api_reference

ROOT = Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
PARTS = {"start": "Start", "concepts": "Concepts", "howto": "How-to", "reference": "Reference", "results": "Results"}
"""Folder of pages → title of a part of the site."""
BESIDE = {
    "start": ["docs/index"],
    "concepts": ["docs/glossary"],
    "howto": ["docs/examples"],
    "reference": ["api/index", "CONTRIBUTING", "SECURITY", "CHANGELOG"],
    "results": ["policies/weights/learned/card", "eval/tables/paper/README"],
}
"""Pages of a part that are made here or lie elsewhere; they come last."""
INDEX = {part.partition("\n")[0]: part for part in (ROOT / "docs" / "index.md").read_text().split("\n## ")[1:]}
"""Title of a part → its section of the index."""
EXAMPLES = re.findall(r"^\| \[`(\w+)\.py`\]", INDEX["Examples"], flags=re.MULTILINE)
CONFIGURATION = {
    "project": PROJECT["name"],
    "copyright": "The arena_newton contributors, Apache-2.0",
    "release": PROJECT["version"],
    "extensions": ["myst_parser"],
    "root_doc": "index",
    "smartquotes": False,
    "html_theme": "pydata_sphinx_theme",
    "html_title": "arena_newton",
    "html_context": {"default_mode": "auto"},
    "html_theme_options": {
        "show_prev_next": True,
        "navigation_with_keys": False,
        "show_nav_level": 1,
        "secondary_sidebar_items": ["page-toc"],
        "footer_start": ["copyright"],
        "footer_end": [],
    },
    "html_sidebars": {"index": []},
    "html_show_sourcelink": False,
    "html_copy_source": False,
    "myst_heading_anchors": 4,
    "python_maximum_signature_line_length": 80,
    # A type that several modules export is explained once and named in short everywhere.
    "suppress_warnings": ["ref.python"],
}


def page_links(text: str, page: Path, folder: Path) -> str:
    """A page with links that lead to other pages of the site, or to copies of the files that it names.

    Args:
        text: The page.
        page: Its path in the repository, relative to the root.
        folder: Where pages are collected.
    """

    def one(match: re.Match[str]) -> str:
        shown, target = match[1], match[2]
        path, _, heading = target.partition("#")
        if not path or "://" in target:
            return match[0]
        file = Path(os.path.normpath(page.parent / path))
        if (ROOT / file).is_dir():
            if file.name != "examples":
                return shown
            file = Path("docs/examples.md")
        elif file == Path("README.md"):
            file = Path("index.md")
        elif file.parent == Path("examples") and file.stem in EXAMPLES:
            file = file.with_suffix(".md")
        elif file.suffix != ".md" and not (folder / file).exists():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / file, folder / file)
        return f"[{shown}]({os.path.relpath(file, page.parent)}{'#' if heading else ''}{heading})"

    return re.sub(r"\[((?:[^\[\]]|\[[^\]]*\]|!\[[^\]]*\]\([^)]*\))*)\]\(([^)\s]+)\)", one, text)


def reading(part: str) -> dict[str, list[str]]:
    """Title of a group of pages → its pages, in the order in which their section of the index names them.

    A page that the section does not name is in no part, which is a warning of Sphinx.
    """
    groups: dict[str, list[str]] = {}
    for group in INDEX[PARTS[part]].split("\n### "):
        pages = dict.fromkeys(re.findall(rf"\]\({part}/([\w/]+)\.md", group))
        groups[group.partition("\n")[0]] = [f"{part}/{page}" for page in pages]
    return groups | {"More": [os.path.relpath(page, "docs") for page in BESIDE[part]]}


def table_of_contents(pages: Iterable[str], hidden: bool = False, caption: str = "") -> str:
    """A list of the pages below this one."""
    options = (":hidden:\n" if hidden else "") + (f":caption: {caption}\n" if caption else "")
    return f"\n```{{toctree}}\n{options}:maxdepth: 1\n\n" + "\n".join(pages) + "\n```\n"


def example_page(name: str) -> str:
    """An example: what it shows, its pictures, its source."""
    source = (ROOT / "examples" / f"{name}.py").read_text()
    said = ast.get_docstring(ast.parse(source)) or ""
    pictures = sorted((ROOT / "docs" / "pictures" / "examples").glob(f"{name}*"))
    shown = "".join(f"\n![What {name}.py shows](../docs/pictures/examples/{picture.name})\n" for picture in pictures)
    return f"# {name}.py\n\n{said}\n{shown}\n```python\n{source}```\n"


def collect(folder: Path) -> None:
    """Write all pages of the site as Markdown, with their pictures, into a folder."""
    shutil.copytree(ROOT / "docs", folder / "docs", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    listed = {ROOT / f"{page}.md" for pages in BESIDE.values() for page in pages}
    for path in {ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), *filter(Path.is_file, listed)}:
        name = path.relative_to(ROOT)
        text = page_links((ROOT / name).read_text(), name, folder)
        if name.name == "README.md" and name.parent == Path():
            text += table_of_contents([f"docs/{part}" for part in PARTS], True)
            name = Path("index.md")
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)
    for title, section in INDEX.items():
        name = Path("docs") / f"{title.lower().replace('-', '')}.md"
        lists = reading(name.stem) if name.stem in PARTS else {"": [f"../examples/{example}" for example in EXAMPLES]}
        text = page_links(f"# {section}\n".replace("\n### ", "\n## "), name, folder)
        text += "".join(table_of_contents(pages, True, group) for group, pages in lists.items() if pages)
        (folder / name).write_text(text)
    words = (ROOT / "CONTRIBUTING.md").read_text().split("## Glossary\n")[1].split("\n## ")[0]
    (folder / "docs" / "glossary.md").write_text(f"# Glossary\n{words}")
    (folder / "examples").mkdir(exist_ok=True)
    for example in EXAMPLES:
        (folder / "examples" / f"{example}.md").write_text(example_page(example))
    (folder / "api").mkdir()
    for module, text in api_reference.pages().items():
        (folder / "api" / f"{module}.md").write_text(text)
    first = "# Public names\n\nModules for programs of your own, with all that they export.\n"
    (folder / "api" / "index.md").write_text(first + table_of_contents(api_reference.MODULES))


def llms(folder: Path) -> str:
    """The file `llms.txt`: the project in a sentence, and each page with its title, by parts of the site."""
    lines = [f"# {PROJECT['name']}", "", f"> {PROJECT['description']}"]
    for part, title in PARTS.items():
        lines += ["", f"## {title}", ""]
        for name in itertools.chain.from_iterable(reading(part).values()):
            page = os.path.normpath(f"docs/{name}")
            title = (folder / f"{page}.md").read_text().splitlines()[0].removeprefix("# ")
            lines.append(f"- [{title}]({page}.html)")
    return "\n".join(lines) + "\n"


def build(out: Path) -> int:
    """Build the site.

    Args:
        out: Folder of the site; files of the same names are replaced.

    Returns:
        0, or 1 if Sphinx warned.
    """
    from sphinx.application import Sphinx

    with tempfile.TemporaryDirectory() as name:
        pages, trees = Path(name) / "pages", Path(name) / "trees"
        pages.mkdir()
        collect(pages)
        site = Sphinx(pages, None, out, trees, "html", CONFIGURATION, status=None, warningiserror=True)
        site.build(force_all=True)
        (out / "llms.txt").write_text(llms(pages))
        return site.statuscode


def main() -> int:
    """Build the site that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("site"), help="folder of the site")
    out = parser.parse_args().out
    if importlib.util.find_spec("sphinx") is None:
        print("docs/build.py: needs the extra [docs] (sphinx is not installed): uv sync --extra docs", file=sys.stderr)
        return 2
    code = build(out)
    if not code:
        print(f"open {out / 'index.html'}")
    return code


if __name__ == "__main__":
    raise SystemExit(main())
