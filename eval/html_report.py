"""The report of a run as one HTML page: table, outcomes with intervals, film strips, episodes, configuration.

Whatever comes from a results folder is text to this page: it is built as a tree of elements, so nothing in a journal
can become an element or an attribute; media are linked only as plain names in `videos/` and `strips/`; and the page's
Content-Security-Policy lets no other script run than the one below, named by its hash.
"""

from __future__ import annotations

import base64
import hashlib
import json
import re
import shlex
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any
from xml.etree import ElementTree

__all__ = ["Page", "environment_facts", "page", "plain", "replay_command", "rules_that_ran", "safe_media"]

OUTCOMES = ("success", "timeout", "fall", "error")
"""Outcomes in the order of the bars."""
FAILURES_FIRST = ("fall", "timeout", "error", "success")
"""Outcomes in the order of the film strips."""
SHOWN_STRIPS = 12
"""Episodes whose strips are shown; those of the others are folded."""
SHOWN_SUCCESSES = 3
"""So many of them are kept for successes."""
MEDIA = {"ego strip": "head camera", "world strip": "world camera", "ego": "head camera", "world": "world camera"}
"""Media of an episode that the page knows → what they show."""
REPLAYED = ("policy", "tracker", "checkpoint", "rules", "drive", "engine", "device", "variant", "max_steps")
"""Flags with a value on which an episode depends, besides its task, mode, seed and repeat."""
REMOTE: dict[str, object] = {
    "remote_timeout": 60.0,
    "remote_retries": 4,
    "remote_sequential": False,
    "remote_insecure": False,
}
"""Flags that belong to a policy server → their defaults; others are named in the command."""
RULE_OWNERS = {"ball": "football"}
"""First word of a rule's item → the task that it belongs to."""

_DIRECTIONS = frozenset("\u061c\ufeff") | {chr(c) for c in (*range(0x200B, 0x2010), *range(0x2028, 0x202F))}
_DIRECTIONS |= {chr(c) for c in range(0x2066, 0x206A)}
_NAME = r"[A-Za-z0-9][A-Za-z0-9_.-]{0,199}"
_PATH = re.compile(rf"videos/{_NAME}\.mp4|strips/{_NAME}\.(?:png|jpg)")

_STYLE = """
:root{color-scheme:light dark;--ink:#1b2330;--soft:#566274;--line:#dce2ea;--ground:#fff;--raised:#f5f7fa;--link:#0b5cad;
--success:#2b8a63;--timeout:#d9a02b;--fall:#c8502f;--error:#7d55b4}
@media(prefers-color-scheme:dark){:root{--ink:#e6eaf0;--soft:#9aa6b6;--line:#2d3642;--ground:#12161b;--raised:#1a2027;
--link:#7fb6ff;--success:#3fae80;--timeout:#d9a940;--fall:#e0694a;--error:#a583d8}}
*{box-sizing:border-box}
body{font:15px/1.5 system-ui,-apple-system,"Segoe UI",Roboto,sans-serif;margin:0 auto;max-width:80rem;
padding:1.5rem clamp(.8rem,3vw,2rem) 4rem;color:var(--ink);background:var(--ground);overflow-wrap:break-word}
h1{font-size:1.6rem;line-height:1.2;margin:0 0 .3rem}h2{font-size:1.15rem;margin:2.2rem 0 .6rem}
a{color:var(--link)}p{margin:.4rem 0}.soft{color:var(--soft)}
code{font:.86em/1.45 ui-monospace,"DejaVu Sans Mono",monospace}
.facts{display:flex;flex-wrap:wrap;gap:.1rem 1.4rem;margin:.5rem 0;padding:0;list-style:none;color:var(--soft)}
.facts b{color:var(--ink);font-weight:600}
.warn{border-left:4px solid var(--fall);background:var(--raised);padding:.5rem .8rem;margin:.6rem 0}
.warn ul{margin:.2rem 0;padding-left:1.2rem}
.scroll{overflow-x:auto}
table{border-collapse:collapse;width:100%;font-variant-numeric:tabular-nums}
th,td{padding:.34rem .55rem;border-bottom:1px solid var(--line);text-align:right;vertical-align:top}
th{font-weight:600;vertical-align:bottom}thead th{border-bottom:2px solid var(--ink)}
.text{text-align:left}.long,code{overflow-wrap:anywhere}.figure{white-space:nowrap}
.suite td{background:var(--raised);color:var(--soft)}
.outcomes{display:grid;grid-template-columns:fit-content(13rem) minmax(12rem,1fr) fit-content(11.5rem);
gap:.1rem 1rem;align-items:center}
.outcomes svg{width:100%;height:44px;overflow:visible;display:block}.outcomes .axis{height:18px}
.axis text{font-size:11px;fill:var(--soft);text-anchor:middle}.axis text:first-child{text-anchor:start}
.axis text:last-child{text-anchor:end}
.counts{font-size:.88rem;color:var(--soft);font-variant-numeric:tabular-nums}
.success{fill:var(--success)}.timeout{fill:var(--timeout)}.fall{fill:var(--fall)}.error{fill:var(--error)}
.back{fill:var(--line)}.grid{stroke:var(--line)}.whisker{stroke:var(--ink);stroke-width:2}.rate{fill:var(--ink)}
.seed{fill:var(--ground);stroke:var(--soft);stroke-width:1.5}
.legend{display:flex;flex-wrap:wrap;gap:.2rem 1.1rem;color:var(--soft);font-size:.88rem;margin:.5rem 0}
.legend svg{width:14px;height:14px;vertical-align:-2px;margin-right:.35rem;overflow:visible}
.badge{display:inline-block;padding:0 .5rem;border-radius:.7rem;font-size:.85rem;font-weight:600;border:1.5px solid;
white-space:nowrap}
.badge.success{color:var(--success)}.badge.timeout{color:var(--timeout)}.badge.fall{color:var(--fall)}
.badge.error{color:var(--error)}
@media(prefers-color-scheme:light){.badge.timeout{color:#8a6100}}
figure{margin:0 0 1.1rem}figcaption{margin-bottom:.25rem}figcaption a{margin-left:.6rem}
.film{overflow-x:auto;margin-bottom:3px}.film a{display:block;min-width:62rem}
.film img{display:block;width:100%;height:auto;background:var(--raised);border-radius:3px}
.film img.ego{aspect-ratio:auto 3236/298}.film img.world{aspect-ratio:auto 4836/334}
.film.missing a{min-width:0;padding:.4rem .6rem;background:var(--raised)}
details{margin:.5rem 0}summary{cursor:pointer}
details>summary.head{font-size:1.15rem;font-weight:600;margin:1.2rem 0 .4rem}
details>summary.more{color:var(--link)}
.controls{display:flex;flex-wrap:wrap;gap:.5rem 1rem;align-items:center;margin:.6rem 0}.controls[hidden]{display:none}
select,button{font:inherit;color:inherit;background:var(--raised);border:1px solid var(--line);border-radius:4px;
padding:.15rem .4rem}
th button{border:0;background:none;padding:0;font-weight:600;cursor:pointer}
th[aria-sort=ascending] button::after{content:" ▲"}th[aria-sort=descending] button::after{content:" ▼"}
.links{white-space:nowrap}#episodes td a{margin-right:.5rem}#episodes td details{margin:0}
#episodes td code{display:block;user-select:all;min-width:15rem}
.why{color:var(--soft);font-size:.88rem;min-width:11rem}
.pairs td:first-child{width:15rem}
@media(max-width:74rem){table{font-size:.86rem}th,td{padding:.3rem .4rem}
CARDS(table.full)}
@media(max-width:46rem){table{font-size:inherit}
CARDS(table.cards)}
@media(max-width:48rem){
.outcomes{grid-template-columns:1fr}.outcomes .name{margin-top:.5rem}
.outcomes .name:empty,.outcomes .counts:empty{display:none}
.pairs td{display:block;border:0;padding:.05rem 0}.pairs td:first-child{width:auto;color:var(--soft);padding-top:.5rem}
}
@media print{.controls{display:none}}
"""

# Rows of a table as cards of three columns, for screens that the table does not fit.
_CARDS = """\
TABLE thead{display:none}TABLE,TABLE tbody{display:block}
TABLE tr{display:grid;grid-template-columns:repeat(auto-fill,minmax(6.4rem,1fr));gap:.1rem .8rem;padding:.5rem 0;
border-bottom:2px solid var(--line)}
TABLE tr[hidden]{display:none}
TABLE td{display:block;border:0;padding:.08rem 0;text-align:left;background:none;min-width:0}
TABLE td:empty{display:none}
TABLE td[data-label]::before{content:attr(data-label);display:block;color:var(--soft);font-size:.8rem;
white-space:normal}
TABLE td.wide,TABLE td.title{grid-column:1/-1}TABLE td.title{font-weight:600}"""
for _name in ("table.full", "table.cards"):
    _STYLE = _STYLE.replace(f"CARDS({_name})", _CARDS.replace("TABLE", _name))

# Filters and sorts the episodes, and says where a picture is not there. Without it the page shows everything.
_SCRIPT = """
"use strict";
(() => {
  document.addEventListener("error", event => {
    const image = event.target, film = image.closest && image.closest(".film");
    if (!film) return;
    film.classList.add("missing");
    image.replaceWith(image.alt + ": the picture is not in this folder");
  }, true);
})();
document.addEventListener("DOMContentLoaded", () => {
  const body = document.querySelector("#episodes tbody"), box = document.querySelector("#controls");
  if (!body || !box) return;
  const rows = [...body.rows], selects = [...box.querySelectorAll("select")], count = box.querySelector("output");
  const show = () => {
    let shown = 0;
    for (const row of rows) {
      row.hidden = selects.some(s => s.value && row.dataset[s.name] !== s.value);
      shown += !row.hidden;
    }
    count.textContent = shown + " of " + rows.length + " episodes";
  };
  for (const select of selects) select.addEventListener("change", show);
  for (const head of document.querySelectorAll("#episodes th[data-key]")) {
    const button = document.createElement("button");
    button.type = "button"; button.textContent = head.textContent; head.replaceChildren(button);
    button.addEventListener("click", () => {
      const way = head.getAttribute("aria-sort") === "ascending" ? -1 : 1, key = head.dataset.key;
      for (const other of head.parentNode.children) other.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", way > 0 ? "ascending" : "descending");
      const value = row => row.dataset[key] ?? "";
      const numbers = rows.every(row => value(row) === "" || Number.isFinite(Number(value(row))));
      const order = (a, b) => {
        const x = value(a), y = value(b);
        if (x === "" || y === "") return (x === "") - (y === "");
        const by = numbers ? Number(x) - Number(y) : x < y ? -1 : x > y ? 1 : 0;
        return way * by || Number(a.dataset.index) - Number(b.dataset.index);
      };
      body.append(...[...rows].sort(order));
    });
  }
  box.hidden = false; show();
});
"""


def plain(text: object) -> str:
    """A value as text that a page, a terminal and a file can show: no control, surrogate or direction characters."""
    if not isinstance(text, str):
        text = json.dumps(text, ensure_ascii=False, sort_keys=isinstance(text, dict))
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        " " if c in "\t\n\r" else "\ufffd" if unicodedata.category(c) in ("Cc", "Cs") or c in _DIRECTIONS else c
        for c in text
    )


def safe_media(path: object) -> str | None:
    """A recording's path if it is a plain name in `videos/` or `strips/`, None otherwise."""
    return path if isinstance(path, str) and _PATH.fullmatch(path) else None


def media_of(record: Mapping[str, Any]) -> dict[str, str]:
    """An episode's recordings that the page knows, by name."""
    given = record.get("media")
    given = given if isinstance(given, dict) else {}
    found = {name: safe_media(given.get(name)) for name in MEDIA}
    return {name: path for name, path in found.items() if path is not None}


def replay_command(options: Mapping[str, Any], record: Mapping[str, Any], worlds: object = None) -> str:
    """The command line that plays an episode again, the last one of its seed's that it plays.

    Args:
        options: Flags of the run, as config.json has them.
        record: The episode.
        worlds: How many worlds asked at once, where the policy depends on it.
    """
    words = ["python", "-m", "arena_newton.eval", "--task", record["task"], "--mode", record["mode"]]
    words += ["--seeds", record["group_seed"], "--repeats", _number(record["repeat"]) + 1]
    for name in REPLAYED:
        value = options.get(name)
        if value not in (None, "", "auto"):
            words += ["--" + name.replace("_", "-"), value]
    for name, default in REMOTE.items() if plain(options.get("policy")).startswith("remote:") else ():
        value = options.get(name, default)
        if value is True:
            words += ["--" + name.replace("_", "-")]
        elif value is not False and value != default:
            words += ["--" + name.replace("_", "-"), value]
    words += ["--worlds", worlds] if worlds is not None else []
    words += ["--fast-physics"] if options.get("fast_physics") is True else []
    return " ".join(shlex.quote(plain(word)) for word in [*words, "--video", "--strip"])


def environment_facts(facts: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What an environment said of itself, in words: engine, physics rate, drive, start-up and the rest."""
    left = dict(facts)
    found: list[tuple[str, str]] = [(name, plain(left.pop(name))) for name in ("engine", "device") if name in left]
    dt, substeps = left.pop("physics_dt", None), left.pop("substeps", None)
    if isinstance(dt, int | float) and not isinstance(dt, bool):
        found.append(("physics", f"{1e3 * dt:g} ms" + (f" × {plain(substeps)}" if substeps is not None else "")))
    if "drive" in left:
        found.append(("drive", plain(left.pop("drive"))))
    if "startup_ticks" in left:
        found.append(("start-up", f"{plain(left.pop('startup_ticks'))} ticks"))
    return found + [(plain(name), plain(value)) for name, value in left.items()]


def tasks_of(config: Mapping[str, Any], records: Sequence[Mapping[str, Any]]) -> list[str]:
    """Names of a run's tasks: those of its configuration, or those of its records where that names none."""
    named = config.get("task")
    return [plain(name) for name in (named if isinstance(named, list) else _distinct(records, "task"))]


def rules_that_ran(rule_set: Mapping[str, Any], tasks: Sequence[str]) -> list[tuple[str, str]]:
    """The rows of a rule set that speak of the tasks of a run, or of all tasks."""
    from arena_newton import tasks as specs

    others = [name for name in specs.names() if name not in tasks]
    objects = {o.record for name in tasks if name in specs.names() for o in specs.get(name).objects}
    foreign = {o.record for name in others for o in specs.get(name).objects} - objects
    rows = []
    for item, said in rule_set.items():
        words = re.findall(r"\w+", plain(item))
        owner = RULE_OWNERS.get(words[0]) if words else None
        named = {word for word in words if word in specs.names()} | ({owner} if owner else set())
        if named and not named & set(tasks):
            continue
        text = plain(said).replace("see the ranges below", "ranges: docs/rules.md")
        # A remark on other tasks alone is left out; lists of tasks or of their objects keep what belongs to the run.
        for remark in re.findall(r" \([^()]*\)", text):
            told = set(re.findall(r"\w+", remark)) & set(specs.names())
            text = text.replace(remark, "") if told and not told & set(tasks) else text
        parts = text.split(", ")
        heads = [part.split(" ")[0] for part in parts]
        if all(head in foreign or head in objects or head in specs.names() for head in heads):
            kept = [part for part, head in zip(parts, heads, strict=True) if head not in foreign and head not in others]
            if not kept:
                continue
            text = ", ".join(kept)
        rows.append((plain(item), text))
    return rows


@dataclass(frozen=True)
class Page:
    """What the page shows."""

    document: Mapping[str, Any]
    """Content of config.json."""
    records: Sequence[Mapping[str, Any]]
    """Finished episodes in plan order."""
    results: Mapping[str, Any]
    """Content of results.json."""
    notes: Sequence[str]
    """What a reader must know besides the table."""
    head: Sequence[str]
    """Column names of the table."""
    rows: Sequence[Sequence[str]]
    """The table: a row per cell, then a row per suite."""
    reasons: Sequence[Mapping[str, Any]]
    """Why episodes ended as errors: `reason`, `message`, `count`."""


def _number(value: object) -> int:
    return value if isinstance(value, int) and not isinstance(value, bool) else 0


def _element(parent: ElementTree.Element | None, tag: str, *content: object, **attributes: object) -> Any:
    """Add an element; text and attribute values are cleaned, `_` in a name stands for `-`, `class_` for `class`."""
    given = {n.rstrip("_").replace("_", "-"): plain(v) for n, v in attributes.items() if v is not None}
    element = ElementTree.Element(tag, given) if parent is None else ElementTree.SubElement(parent, tag, given)
    for part in content:
        if isinstance(part, ElementTree.Element):
            element.append(part)
        elif len(element):
            element[-1].tail = (element[-1].tail or "") + plain(part)
        else:
            element.text = (element.text or "") + plain(part)
    return element


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


# A page opened from a disk has no origin that 'self' could mean in every browser, hence `file:`.
POLICY = (
    "default-src 'none'; img-src 'self' file:; media-src 'self' file:; base-uri 'none'; form-action 'none'; "
    f"style-src {_hash(_STYLE)}; script-src {_hash(_SCRIPT)}"
)
"""Content-Security-Policy of the page."""


def page(content: Page) -> str:
    """The page as text, the same for the same content byte for byte."""
    root = _element(None, "html", lang="en")
    head = _element(root, "head")
    _element(head, "meta", charset="utf-8")
    _element(head, "meta", http_equiv="Content-Security-Policy", content=POLICY)
    _element(head, "meta", name="viewport", content="width=device-width,initial-scale=1")
    _element(head, "title", f"HumanoidArena results {plain(content.results['config_hash'])}")
    style, script = _element(head, "style"), _element(head, "script")
    body = _element(root, "body")
    _opening(body, content)
    _table(body, content)
    _outcomes(body, content.results["cells"])
    _errors(body, content)
    _strips(body, content.records)
    _episodes(body, content)
    _folded(body, content)
    # The only two texts that are not escaped, and the only two that are ours alone.
    style.text, script.text = _STYLE, _SCRIPT
    return "<!doctype html>\n" + ElementTree.tostring(root, encoding="unicode", method="html") + "\n"


def _distinct(records: Iterable[Mapping[str, Any]], key: str) -> list[str]:
    return list(dict.fromkeys(plain(record[key]) for record in records))


def _opening(body: ElementTree.Element, content: Page) -> None:
    config, results = content.document["config"], content.results
    _element(body, "h1", "HumanoidArena results")
    facts = _element(body, "ul", class_="facts")

    def fact(name: str, value: object) -> None:
        _element(facts, "li", f"{name} ", _element(None, "b", value))

    fact("episodes", f"{results['finished']} of {results['planned']}")
    for name in ("policy", "tracker", "rules"):
        if name in config:
            fact(name, config[name])
    for name in ("task", "mode", "seeds"):
        values = config.get(name)
        if isinstance(values, list):
            fact(name + "s" if name != "seeds" and len(values) > 1 else name, " ".join(map(plain, values)))
    if "repeats" in config:
        fact("repeats", config["repeats"])
    environments = [e for e in (content.document.get("environments") or {}).values() if isinstance(e, dict)]
    shared = [environment_facts(e) for e in environments]
    for name in ("engine", "physics", "drive", "start-up"):
        values = list(dict.fromkeys(dict(e)[name] for e in shared if name in dict(e)))
        if values:
            fact(name, " or ".join(values))
        elif name in config:
            fact(name, config[name])
    fact("configuration", results["config_hash"])
    for note in content.notes:
        _element(body, "p", note, class_="warn")
    changes = content.document.get("variant_changes")
    if isinstance(changes, list) and changes:
        box = _element(body, "div", _element(None, "b", "The scene is a variant that differs from the built-in one:"))
        box.set("class", "warn")
        listed = _element(box, "ul")
        for sentence in changes:
            _element(listed, "li", sentence)


def _table(body: ElementTree.Element, content: Page) -> None:
    _element(body, "h2", "Results")
    head, rows = list(content.head), [list(row) for row in content.rows]
    cells = len(content.results["cells"])
    # What is the same in every row is said once, above.
    dropped = {i for i in (1, 2, 3) if len({row[i] for row in rows}) == 1}
    if dropped:
        said = ", ".join(f"{head[i]} {rows[0][i]}" for i in sorted(dropped))
        _element(body, "p", f"All rows: {said}.", class_="soft")
    box = _element(body, "div", class_="scroll")
    table = _element(box, "table", class_="cards" if len(dropped) > 1 else "cards full")
    line = _element(_element(table, "thead"), "tr")
    kept = [i for i in range(len(head)) if i not in dropped]
    for i in kept:
        _element(line, "th", head[i], class_="text" if i < 4 else None, scope="col")
    rest = _element(table, "tbody")
    for number, row in enumerate(rows):
        line = _element(rest, "tr", class_="suite" if number >= cells else None)
        for i in kept:
            style = "text title" if i == 0 else "text" if i < 4 else "figure"
            label = None if i == 0 or not row[i] else head[i]
            _element(line, "td", row[i], class_=style, data_label=label)
    _element(
        body,
        "p",
        "SR: success rate ± population standard deviation over group seeds (suite rows: over all task and seed rates "
        "pooled). CI: Wilson. AFR: falls per episode. Falls at start happened while the tracker settled.",
        class_="soft",
    )


def _per_cent(fraction: float) -> str:
    return f"{100 * fraction:.2f}%"


def _outcomes(body: ElementTree.Element, cells: Sequence[Mapping[str, Any]]) -> None:
    """A bar of outcomes per cell; under it the success rate with its interval and the rates of the group seeds."""
    if not cells:
        return
    _element(body, "h2", "Outcomes")
    legend = _element(body, "div", class_="legend")

    def entry(text: str, shape: str, class_: str, **attributes: object) -> None:
        item = _element(legend, "span")
        _element(_element(item, "svg", aria_hidden="true"), shape, class_=class_, **attributes)
        item[-1].tail = text

    for outcome in OUTCOMES:
        entry(outcome, "rect", outcome, width=12, height=12, y=1)
    entry("success rate", "circle", "rate", cx=7, cy=7, r=4.5)
    entry("95 % Wilson interval", "line", "whisker", x1=0, x2=14, y1=7, y2=7)
    entry("rate of a group seed", "circle", "seed", cx=7, cy=7, r=4)
    grid = _element(body, "div", class_="outcomes")
    names = [("tracker", "policy", "mode")[i] for i in range(3)]
    differing = [name for name in names if len({plain(cell[name]) for cell in cells}) > 1]
    for cell in cells:
        title = " ".join([plain(cell["task"]), *(plain(cell[name]) for name in differing)])
        counts = {
            "success": cell["successes"],
            "timeout": cell["timeouts"],
            "fall": cell["falls"],
            "error": cell["errors"],
        }
        _element(grid, "div", title, class_="name")
        _bar(grid, title, cell, counts)
        words = [f"{counts[outcome]} {outcome}" for outcome in OUTCOMES if counts[outcome]]
        _element(grid, "div", ", ".join(words), class_="counts")
    _element(grid, "div", class_="name")
    axis = _element(grid, "svg", class_="axis", aria_hidden="true")
    for tick in (0, 25, 50, 75, 100):
        _element(axis, "text", f"{tick} %" if tick in (0, 100) else tick, x=f"{tick}%", y=12)
    _element(grid, "div", class_="counts")


def _bar(parent: ElementTree.Element, title: str, cell: Mapping[str, Any], counts: Mapping[str, int]) -> None:
    episodes = cell["episodes"]
    said = f"{title}: " + ", ".join(f"{counts[outcome]} {outcome}" for outcome in OUTCOMES)
    chart = _element(parent, "svg", role="img", aria_label=f"{said} of {episodes}")
    for tick in (0, 25, 50, 75, 100):
        _element(chart, "line", class_="grid", x1=f"{tick}%", x2=f"{tick}%", y1=0, y2=42)
    done = 0
    for outcome in OUTCOMES:
        if episodes and counts[outcome]:
            share = _per_cent(counts[outcome] / episodes)
            part = _element(chart, "rect", class_=outcome, x=_per_cent(done / episodes), y=2, width=share, height=15)
            _element(part, "title", f"{counts[outcome]} {outcome}")
            done += counts[outcome]
    if cell["ci95"] is None:
        return
    low, high = (_per_cent(bound) for bound in cell["ci95"])
    whisker = _element(chart, "g", class_="whisker")
    _element(whisker, "line", x1=low, x2=high, y1=25, y2=25)
    for end in (low, high):
        _element(whisker, "line", x1=end, x2=end, y1=21, y2=29)
    _element(whisker, "title", f"95 % Wilson interval {low} to {high}")
    rate = _element(chart, "circle", class_="rate", cx=_per_cent(cell["sr"]), cy=25, r=4.5)
    _element(rate, "title", f"success rate {_per_cent(cell['sr'])}")
    same: dict[float, int] = {}
    for seed, value in cell["sr_per_seed"].items():
        # Seeds of one rate stand beside each other.
        beside = same[value] = same.get(value, -1) + 1
        group = _element(chart, "svg", x=_per_cent(value), overflow="visible")
        dot = _element(group, "circle", class_="seed", cx=(-9 if value > 0.5 else 9) * beside, cy=38, r=4)
        _element(dot, "title", f"group seed {plain(seed)}: {_per_cent(value)}")


def _errors(body: ElementTree.Element, content: Page) -> None:
    if not content.reasons:
        return
    _element(body, "h2", "Errors")
    table = _element(_element(body, "div", class_="scroll"), "table")
    line = _element(_element(table, "thead"), "tr")
    for name in ("reason", "message"):
        _element(line, "th", name, class_="text", scope="col")
    _element(line, "th", "episodes", scope="col")
    rows = _element(table, "tbody")
    for entry in content.reasons:
        line = _element(rows, "tr")
        _element(line, "td", entry["reason"], class_="text")
        _element(line, "td", entry["message"], class_="text long")
        _element(line, "td", entry["count"])
    _element(
        body,
        "p",
        "Run them again, in the folder of this page: ",
        _element(None, "code", "python -m arena_newton.eval resume . --retry-errors"),
    )


def _strips(body: ElementTree.Element, records: Sequence[Mapping[str, Any]]) -> None:
    """Film strips inline, failures first; more than a page's worth is folded."""
    filmed = [r for r in records if any(name.endswith("strip") for name in media_of(r))]
    if not filmed:
        return

    def place(record: Mapping[str, Any]) -> int:
        outcome = record["outcome"]
        return FAILURES_FIRST.index(outcome) if outcome in FAILURES_FIRST else 0

    ordered = sorted(filmed, key=place)  # stable: plan order within an outcome
    # Every task and mode is to be seen, before a second one of any.
    turns: dict[tuple[str, str, bool], int] = {}
    turn = {}
    for record in ordered:
        cell = (plain(record["task"]), plain(record["mode"]), record["outcome"] == "success")
        turn[id(record)] = turns[cell] = turns.get(cell, -1) + 1
    wins = sorted((r for r in ordered if r["outcome"] == "success"), key=lambda r: turn[id(r)])
    failures = sorted((r for r in ordered if r["outcome"] != "success"), key=lambda r: turn[id(r)])
    shown = failures[: SHOWN_STRIPS - min(SHOWN_SUCCESSES, len(wins))]
    shown += wins[: SHOWN_STRIPS - len(shown)]
    shown.sort(key=place)
    folded = [r for r in ordered if not any(r is s for s in shown)]
    _element(body, "h2", "Film strips")
    section = _element(body, "section", id="strips")
    for record in shown:
        _film(section, record)
    if folded:
        more = _element(section, "details")
        _element(more, "summary", f"{len(folded)} more episodes", class_="more")
        for record in folded:
            _film(more, record)


def _title(record: Mapping[str, Any]) -> str:
    return f"{plain(record['task'])} {plain(record['mode'])}, seed {plain(record['group_seed'])} " + (
        f"repeat {plain(record['repeat'])}"
    )


def _outcome(record: Mapping[str, Any]) -> str:
    return record["outcome"] if record["outcome"] in OUTCOMES else "error"


def _seconds(record: Mapping[str, Any]) -> str:
    steps = _number(record["steps"])
    return f"{steps} steps, {steps * 0.02:.1f} s"


def _film(parent: ElementTree.Element, record: Mapping[str, Any]) -> None:
    media = media_of(record)
    badge = _element(None, "span", plain(record["outcome"]), class_=f"badge {_outcome(record)}")
    reason = record.get("reason")
    why = f" ({plain(reason)})" if reason and reason != record["outcome"] else ""
    said = f" {_title(record)}, {_seconds(record)}{why}"
    figure = _element(parent, "figure")
    caption = _element(figure, "figcaption", badge, said)
    for name in ("ego", "world"):
        if name in media:
            _element(caption, "a", f"video, {MEDIA[name]}", href=media[name])
    for name in ("ego", "world"):
        path = media.get(f"{name} strip")
        if path:
            alt = f"{_title(record)}: {record['outcome']}, {MEDIA[name]}"
            image = _element(None, "img", src=path, alt=alt, loading="lazy", decoding="async", class_=name)
            _element(_element(figure, "div", class_="film"), "a", image, href=path)


_COLUMNS = (
    ("task", "task"),
    ("mode", "mode"),
    ("seed", "seed"),
    ("repeat", "repeat"),
    ("outcome", "outcome"),
    ("reason", None),
    ("steps", "steps"),
    ("margin", "margin"),
    ("pictures", None),
    ("play it again", None),
)
"""Columns of the list of episodes and the keys that they are sorted by."""


def _episodes(body: ElementTree.Element, content: Page) -> None:
    records = content.records
    _element(body, "h2", "Episodes")
    if not records:
        _element(body, "p", "None is finished.", class_="soft")
        return
    _element(
        body,
        "p",
        "The command of an episode plays its group seed from repeat 0 up to it; the last of them is the episode. "
        "Margin: signed distance to success at the end.",
        class_="soft",
    )
    controls = _element(body, "div", id="controls", class_="controls", hidden="")
    for name in ("outcome", "task", "mode"):
        label = _element(controls, "label", f"{name} ")
        select = _element(label, "select", name=name, autocomplete="off")
        _element(select, "option", "all", value="")
        for value in _distinct(records, name):
            _element(select, "option", value, value=value)
    _element(controls, "output")
    table = _element(_element(body, "div", class_="scroll"), "table", id="episodes", class_="cards full")
    line = _element(_element(table, "thead"), "tr")
    for name, key in _COLUMNS:
        style = None if name in ("seed", "repeat", "steps", "margin") else "text"
        _element(line, "th", name, class_=style, scope="col", data_key=key)
    rows = _element(table, "tbody")
    for record in records:
        _row(rows, record, content.document)


def _row(rows: ElementTree.Element, record: Mapping[str, Any], document: Mapping[str, Any]) -> None:
    margin = record.get("margin")
    margin = margin if isinstance(margin, int | float) and not isinstance(margin, bool) else None
    line = _element(
        rows,
        "tr",
        data_index=_number(record["index"]),
        data_task=record["task"],
        data_mode=record["mode"],
        data_seed=record["group_seed"],
        data_repeat=record["repeat"],
        data_outcome=record["outcome"],
        data_steps=_number(record["steps"]),
        data_margin="" if margin is None else repr(margin),
    )
    _element(line, "td", record["task"], class_="text title")
    _element(line, "td", record["mode"], class_="text", data_label="mode")
    _element(line, "td", record["group_seed"], data_label="seed")
    _element(line, "td", record["repeat"], data_label="repeat")
    badge = _element(None, "span", plain(record["outcome"]), class_=f"badge {_outcome(record)}")
    _element(line, "td", badge, class_="text")
    reason = record.get("reason")
    why = _element(line, "td", "" if reason in (None, record["outcome"]) else reason, class_="text")
    if record.get("error"):
        message = plain(record["error"])
        _element(why, "div", message if len(message) <= 300 else message[:299] + "…", class_="why")
    _element(line, "td", _number(record["steps"]), data_label="steps")
    _element(line, "td", "-" if margin is None else f"{margin:.3f}", class_="figure", data_label="margin")
    media = media_of(record)
    pictures = _element(line, "td", class_="text wide")
    for kind, ending in (("strip", " strip"), ("video", "")):
        links = [(camera, media[camera + ending]) for camera in ("ego", "world") if camera + ending in media]
        if links:
            entry = _element(pictures, "div", f"{kind} ", class_="links")
            for camera, path in links:
                _element(entry, "a", camera, href=path)
    command = _element(None, "details", _element(None, "summary", "command"))
    worlds = document["config"].get("worlds")  # stands there only where the policy depends on it
    _element(command, "code", replay_command(document.get("options") or {}, record, worlds))
    _element(line, "td", command, class_="text wide")


def _pairs(parent: ElementTree.Element, rows: Iterable[tuple[str, str]]) -> None:
    table = _element(_element(parent, "table", class_="pairs"), "tbody")
    for name, value in rows:
        line = _element(table, "tr")
        _element(line, "td", name, class_="text")
        _element(line, "td", _element(None, "code", value), class_="text")


def _fold(body: ElementTree.Element, title: str, rows: Sequence[tuple[str, str]]) -> None:
    if rows:
        folded = _element(body, "details")
        _element(folded, "summary", title, class_="head")
        _pairs(folded, rows)


def _folded(body: ElementTree.Element, content: Page) -> None:
    document, config = content.document, content.document["config"]
    groups: dict[str, list[str]] = {}
    for name, facts in (document.get("environments") or {}).items():
        if isinstance(facts, dict):
            groups.setdefault(json.dumps(environment_facts(facts)), []).append(plain(name))
    for facts, names in groups.items():
        title = "What ran" if len(groups) == 1 else f"What ran: {', '.join(names)}"
        _fold(body, title, [(name, value) for name, value in json.loads(facts)])
    ran = tasks_of(config, content.records)
    _fold(body, f"Rule set {plain(config.get('rules', ''))}", rules_that_ran(document["rule_set"], ran))
    _fold(body, "Configuration", [(plain(key), plain(value)) for key, value in config.items()])
    versions = document.get("versions")
    if isinstance(versions, dict):
        _fold(body, "Versions", [(plain(key), plain(value)) for key, value in versions.items()])
