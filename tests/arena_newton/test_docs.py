"""The documentation's examples run, and the names in it exist."""

import html
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from arena_newton.data import __main__ as data
from arena_newton.eval import __main__ as evaluation

ROOT = Path(__file__).resolve().parents[2]
DOCS = sorted((ROOT / "docs").rglob("*.md"))
PARTS = "start concepts howto reference results".split()
FOLDERS = "arena_newton eval policies trackers kernels usd_scenes tests benchmarks examples docs".split()


def test_the_index_names_every_page():
    """Every page of docs/ lies in the folder of a part and is linked from the index, which gives the order."""
    linked = set(re.findall(r"\]\(([\w./]+\.md)", (ROOT / "docs" / "index.md").read_text()))
    pages = {str(page.relative_to(ROOT / "docs")) for page in DOCS} - {"index.md"}
    assert linked >= pages and {page.split("/")[0] for page in pages} == set(PARTS)


@pytest.mark.parametrize("page", [ROOT / "README.md", *DOCS], ids=lambda page: page.stem)
def test_pages_are_short(page):
    """A page has at most 250 lines, the README 150."""
    assert len(page.read_text().splitlines()) <= (150 if page.parent == ROOT else 250)


def anchors(page: Path) -> set[str]:
    titles = re.findall(r"^#+ (.+)$", page.read_text(), flags=re.MULTILINE)
    return {re.sub(r"[^\w -]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("page", [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *DOCS], ids=lambda page: page.stem)
def test_links_lead_somewhere(page):
    """Files and headings that a page links to, or names, are there; links to others are whole addresses by https."""
    for path in re.findall(rf"`((?:{'|'.join(FOLDERS)})/[\w./-]+)`", page.read_text()):
        assert (ROOT / path).exists(), path
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if ":" in target:
            assert re.fullmatch(r"https://(?:[a-z0-9-]+\.)+[a-z]{2,}(?:/[\w./~%#?=&+-]*)?", target), target
        else:
            file, _, heading = target.partition("#")
            other = (page.parent / file).resolve() if file else page
            assert other.exists(), target
            assert not heading or heading in anchors(other), target


@pytest.mark.release
def test_the_site(tmp_path):
    """The site builds without a warning or a dead link, with every page, glossary, examples and public names."""
    pytest.importorskip("sphinx", reason="needs the extra [docs]: sphinx is not installed")
    command = [sys.executable, str(ROOT / "docs" / "build.py"), "--out", str(tmp_path)]
    built = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    listed = (tmp_path / "llms.txt").read_text()
    pages = [page.relative_to(ROOT).with_suffix(".html") for page in DOCS]
    assert all(f"({page})" in listed and (tmp_path / page).is_file() for page in pages)

    for page in set(tmp_path.rglob("*.html")) - set(tmp_path.glob("_static/*")):
        for target in re.findall(r'(?:href|src)="([^"#?]+)', page.read_text()):
            assert ":" in target or (page.parent / target).exists(), f"{page}: {target}"

    def text(page: str) -> str:
        return html.unescape(re.sub(r"<[^>]+>", "", (tmp_path / page).read_text()))

    rows = (ROOT / "CONTRIBUTING.md").read_text().split("## Glossary")[1].split("\n\n")[2].splitlines()[2:]
    cells = [re.sub(r"[`*]", "", cell.strip()) for row in rows for cell in row.strip("|").split("|")]
    assert len(rows) > 30 and [cell for cell in cells if cell not in text("docs/glossary.html")] == []
    examples = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert all(f"python examples/{name}.py" in text(f"examples/{name}.html") for name in examples)
    assert {path.stem for path in (tmp_path / "examples").glob("*.html")} == examples
    public = (tmp_path / "api" / "arena_newton.html").read_text()
    assert all(f'id="arena_newton.{name}"' in public for name in ("ArenaEnv", "ArenaEnv.step", "Rollout.run"))


def test_commands_of_the_page_exist():
    """The page of commands lists every command of the one command line, and no other."""
    from arena_newton.__main__ import COMMANDS

    table = (ROOT / "docs" / "reference" / "commands.md").read_text()
    first = "\n".join(line.split("|")[1] for line in table.splitlines() if line.startswith("| `"))
    listed = re.findall(r"`([^`]+)`", first)
    for command in COMMANDS:
        assert any(f"{words} ".startswith(f"{command.words} ") for words in listed), command.words
    assert {f"data {name}" for name in data.COMMANDS} <= set(listed)
    assert {f"eval {name}" for name in evaluation.COMMANDS} - {"eval run"} <= set(listed)
    known = {word for command in COMMANDS for word in command.words.split()}
    assert {words.split()[0] for words in listed} <= known | {"validate", "list", "preview", "new"}


def test_the_world_from_python():
    """Every block of docs/howto/program/api.md runs, one after the other, and gives what the page says."""
    blocks = re.findall(
        r"^```python\n(.*?)^```$",
        (ROOT / "docs" / "howto" / "program" / "api.md").read_text(),
        flags=re.DOTALL | re.MULTILINE,
    )
    for module in re.findall(r"^from (arena_newton[\w.]*) import", "".join(blocks), flags=re.MULTILINE):
        assert module in ("arena_newton", "arena_newton.kernels.rules"), "not the package's public names"
    world: dict = {"__name__": "docs_api"}
    for number, block in enumerate(blocks, start=1):
        exec(compile(block, f"docs/howto/program/api.md, block {number}", "exec"), world)
    observation, env = world["observation"], world["env"]
    assert observation.state.shape == (2, 64) and observation.image.shape == (2, 64, 64, 3)
    assert observation.image.dtype == torch.uint8 and observation.image.float().std() > 5.0
    assert observation.instruction == "Kick the soccer ball into the goal." and observation.tracker == "twist2"
    assert world["picture"].shape == (2, 64, 64, 3) and world["picture"].float().std() > 5.0
    assert [(r.episode.episode_seed, r.outcome, r.steps) for r in world["results"]] == [
        (seed, "timeout", 8) for seed in (1, 2, 3)
    ]
    assert world["other"].startup_ticks == 0 and not world["other"].active.any() and not env.active.any()
    step, ball = world["plan"].grad[:, :2], world["where"].grad[:, world["judge"].ball]
    assert step.isfinite().all() and step.abs().max() > 0.0
    assert ball.isfinite().all() and ball.norm(dim=1).min() > 0.5


TUTORIALS = (ROOT / "docs" / "start" / "tutorials.md").read_text().split("\n## ")[1:]


@pytest.mark.release
@pytest.mark.parametrize("part", TUTORIALS, ids=lambda part: part.splitlines()[0])
def test_a_tutorial_runs_as_it_stands(part, tmp_path, monkeypatch, capsys):
    """Commands and programs of a tutorial run one after the other in an empty folder, and say what it says."""
    monkeypatch.chdir(tmp_path)
    for kind, block in re.findall(r"^```(\w+)\n(.*?)^```$", part, flags=re.DOTALL | re.MULTILINE):
        if kind == "usda":
            Path(re.search(r"Save this as `([\w.]+)`", part)[1]).write_text(block)
        elif kind == "python":
            exec(compile(block, "docs/start/tutorials.md", "exec"), {"__name__": "tutorial"})
        else:
            for line in block.replace("\\\n", "").splitlines():
                python, minus, module, *flags = shlex.split(line)
                assert (python, minus) == ("python", "-m")
                monkeypatch.setattr(sys, "argv", [module, *flags])
                with pytest.raises(SystemExit) as ended:
                    runpy.run_module(module, run_name="__main__")
                assert not ended.value.code, line
    said = capsys.readouterr().out
    for words in re.findall(r"`(timeout|reward/s|early end every)`", part):
        assert words in said
