"""Reports are derived from configuration and journal alone, and hold what a reader needs."""

import base64
import dataclasses
import hashlib
import json
import random
import re
import shlex
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import pytest
from made_folders import document_of, folder_with, recorded
from rows import episodes, made, record

from arena_newton.errors import InputError
from arena_newton.eval.folders.results import RunRecord, load_run, results_json
from arena_newton.eval.plan.options import Remote
from arena_newton.eval.reports import report
from arena_newton.eval.reports.wording import replay_command, rules_that_ran
from arena_newton.eval.statistics.stats import error_reasons, wilson


def test_results_json(tmp_path):
    """results.json holds one cell per task, tracker, policy and mode, with the published keys."""
    run = load_run(folder_with(tmp_path / "a", episodes("football", (4, 5, 7), falls=3), 60))
    results = report.write_reports(run)
    stored = json.loads((tmp_path / "a" / "results.json").read_text())
    assert len(stored.pop("written_by")) == 12 and stored == results
    (cell,) = results["cells"]
    keys = "task tracker policy mode episodes successes falls errors sr sr_seed_std ci95 afr mean_steps".split()
    assert set(keys) <= set(cell)
    assert results["complete"] and results["finished"] == 60


def test_wall_clock_is_nowhere_in_the_tables(tmp_path):
    """Two journals that differ in order, times and a repeated episode give the same bytes in every table."""
    rows = episodes("football", (4, 5, 7), falls=3)
    late = [row | {"durations": {"wall_s": 99.0, "sim_s": 2.0}, "started_at": "x", "finished_at": "y"} for row in rows]
    stale = [rows[5] | {"outcome": "error"}]
    report.write_reports(load_run(folder_with(tmp_path / "a", rows, 60)))
    report.write_reports(load_run(folder_with(tmp_path / "b", stale + late[::-1], 60)))
    for name in ("results.json", "table.md", "table.csv", "report.md", "report.html"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes(), name


VOID = {"meta", "img", "br", "hr", "input", "link", "base"}
URLS = {"href", "src", "srcset", "action", "formaction", "poster", "data", "background", "ping", "xlink:href"}


class Tree(HTMLParser):
    """The elements of a page as a browser's parser nests them: (tag, attributes, text)."""

    def __init__(self, text):
        super().__init__()
        self.elements, self._open, self.text = [], [], {}
        self.feed(text)
        self.close()

    def handle_starttag(self, tag, attributes):
        assert len({name for name, _ in attributes}) == len(attributes), "an attribute twice"
        self.elements.append((tag, dict(attributes)))
        if tag not in VOID:
            self._open.append(tag)

    def handle_endtag(self, tag):
        assert self._open.pop() == tag

    def handle_data(self, data):
        where = self._open[-1] if self._open else ""
        self.text[where] = self.text.get(where, "") + data

    def close(self):
        super().close()
        assert not self._open

    @property
    def shape(self):
        """Every tag with the names of its attributes, and the addresses."""
        return {
            (tag, name, value if name in URLS else "") for tag, given in self.elements for name, value in given.items()
        }

    def find(self, tag, **wanted):
        return [given for name, given in self.elements if name == tag and wanted.items() <= given.items()]


def html(folder):
    """The parsed page of a results folder."""
    report.write_reports(load_run(folder))
    return Tree((folder / "report.html").read_text(encoding="utf-8"))


def test_html_is_self_contained_and_escaped(tmp_path):
    """The HTML report loads nothing from elsewhere, shows configuration and rules, and escapes what it prints."""
    rows = episodes("football", (1, 0, 0), falls=2)
    rows[1]["startup_fall"] = True
    rows[0]["media"] = {"ego": "videos/x__ego.mp4"}
    rows = [row | {"policy": "<script>"} for row in rows]
    folder = folder_with(tmp_path / "a", rows, 60, policy="<script>")
    tree = html(folder)
    text = (folder / "report.html").read_text()
    assert not re.search(r"<(link|iframe|object|embed|base)|https?://|url\(|@import", text)
    assert "&lt;script&gt;" in text and "tilt &gt; 60° &lt;&amp;&gt;" in text
    assert {given["href"] for given in tree.find("a")} == {"videos/x__ego.mp4"}
    assert "1 + 1" in text
    assert "[ego](videos/x__ego.mp4)" in (folder / "report.md").read_text()


def test_page_opens_with_table_and_bars(tmp_path):
    """Table, outcome bars with interval and seeds, strips, episodes and folded configuration stand in this order."""
    rows = [recorded(row, "ego strip", "world strip", "ego") for row in episodes("football", (10, 10, 12), falls=3)]
    folder = folder_with(tmp_path / "a", rows, 60)
    tree = html(folder)
    text = (folder / "report.html").read_text()
    places = [text.index(f">{name}<") for name in ("Results", "Outcomes", "Film strips", "Episodes", "Configuration")]
    assert places == sorted(places)
    bars = [float(r["width"].rstrip("%")) for r in tree.find("rect") if "x" in r]
    assert sum(bars) == pytest.approx(100.0, abs=0.02) and bars[0] == pytest.approx(100 * 32 / 60, abs=0.01)
    low, high = wilson(32, 60)
    assert tree.find("line", x1=f"{100 * low:.2f}%", x2=f"{100 * high:.2f}%", y1="25")
    assert len(tree.find("circle", **{"class": "seed"})) == 3 + 1  # and one in the legend
    assert [given["loading"] for given in tree.find("img")] == ["eager"] + ["lazy"] * 120
    assert len([1 for tag, given in tree.elements if tag == "tr" and "data-outcome" in given]) == 60
    folded = text[text.index(">Episodes<") :]
    assert '<details><summary class="head">Configuration' in folded


def test_failures_come_first_and_the_rest_is_folded(tmp_path):
    """Strips of falls, then of timeouts, then a few successes are shown; nothing is left out."""
    rows = [recorded(row, "ego strip") for row in episodes("football", (12, 12, 12), falls=4)]
    folder = folder_with(tmp_path / "a", rows, 60)
    opening, *shown = [given["alt"].rsplit(": ", 1)[1].split(",")[0] for given in html(folder).find("img")]
    assert opening == "success" and len(shown) == 60
    assert shown[:12] == ["fall"] * 4 + ["timeout"] * 5 + ["success"] * 3
    assert "48 more episodes" in (folder / "report.html").read_text()


def test_page_opens_with_a_strip_of_each_task(tmp_path):
    """Before the table one strip per task: its first success from outside, or its first episode where there is none."""
    rows = episodes("football", (2, 0, 0)) + episodes("boxing", (0, 0, 0), falls=60, index=60)
    rows[0]["outcome"] = "timeout"
    rows[1]["tracker"] = rows[61]["tracker"] = "u"
    rows = [recorded(row, "ego strip", "world strip") for row in rows]
    folder = folder_with(tmp_path / "a", rows, 120, tracker=["t", "u"])
    html(folder)
    text = (folder / "report.html").read_text()
    opening = text[text.index('<section id="opening">') : text.index("<h2>Results</h2>")]
    images = Tree(opening).find("img")
    stems = [given["src"] for given in images]
    assert stems == [
        "strips/football__base__seed0__repeat1__world.jpg",
        "strips/boxing__base__seed0__repeat0__world.jpg",
    ]
    captions = re.findall(r"<figcaption>(.*)</figcaption>", opening)
    said = [re.sub("<[^>]*>", "", caption) for caption in captions]
    assert said == ["success football, u, 101 steps, 2.0 s", "fall boxing, t, 100 steps, 2.0 s"]


def test_strips_of_every_cell_come_before_a_second_one(tmp_path):
    """With many tasks the strips that are shown come from as many of them as there is room for."""
    names = ("football", "boxing", "vis_navi", "open_door")
    rows = [recorded(row, "ego strip") for i, n in enumerate(names) for row in episodes(n, (9, 9, 9), index=60 * i)]
    folder = folder_with(tmp_path / "a", rows, 240)
    shown = [given["alt"].split()[0] for given in html(folder).find("img")][len(names) :][:12]
    assert {name: shown[:9].count(name) for name in names} == {
        "football": 3,
        "boxing": 2,
        "vis_navi": 2,
        "open_door": 2,
    }
    assert shown[9:] == ["football", "boxing", "vis_navi"]


def test_only_rules_of_tasks_that_ran(tmp_path):
    """Rows of other tasks, and their parts of lists, are left out; no text points at what does not follow."""
    from arena_newton import rule_sets

    for name in rule_sets.names():
        said = dict(rule_sets.table(rule_sets.get(name)))
        rows = dict(rules_that_ran(said, ["vis_navi"]))
        text = json.dumps(rows)
        assert not re.search("football|ball|double_desk|pp_box|open_door|sit_sofa|boxing|ranges below", text), text
        assert rows["fall"] == said["fall"] and "feet" in rows["vis_navi"]
        assert rows["step budget (50 Hz ticks)"].startswith("vis_navi ")
        assert "football" in dict(rules_that_ran(said, ["football"]))


def test_reasons_environments_and_variants_are_told(tmp_path):
    """Errors with counts and the command, what ran, and what a variant changes stand in both reports."""
    rows = episodes("football", (1, 0, 0))
    for i in (3, 4, 9):
        rows[i] |= {"outcome": "error", "reason": "policy", "error": "server gone" if i < 9 else "answered \x1b[2J500"}
    folder = folder_with(tmp_path / "a", rows, 60)
    document = json.loads((folder / "config.json").read_text())
    document["variant_changes"] = ["gravity is 0 m/s²"]
    document["environments"] = {
        "football base": {"engine": "warp", "physics_dt": 0.005, "substeps": 4, "drive": "twist2", "startup_ticks": 50}
    }
    (folder / "config.json").write_text(json.dumps(document))
    html(folder)
    for name in ("report.html", "report.md"):
        text = (folder / name).read_text()
        assert "5 ms × 4" in text and "gravity is 0 m/s²" in text and "\x1b" not in text
        assert "resume . --retry-errors" in text and "50 ticks" in text
    counts = [(r["message"], r["count"]) for r in error_reasons([record(row) for row in rows])]
    assert counts[0] == ("server gone", 2) and len(counts) == 2


EMPTY = episodes("boxing", (1,))[0]


def test_command_plays_the_episode_again(tmp_path):
    """An episode's command names its task, mode, seed and repeat and all that it depends on, quoted for a shell."""
    options = {"policy": "replay:a b;rm", "tracker": ["u", "t"], "max_steps": 50, "rules": "paper", "out": "secret"}
    row = {"task": "boxing", "mode": "visual", "group_seed": 2, "repeat": 3}
    command = replay_command(options, record(EMPTY | row))
    words = shlex.split(command)
    assert words[:3] == ["python", "-m", "arena_newton.eval"] and "secret" not in words
    assert words[3:7] == ["--task", "boxing", "--mode", "visual"]
    assert words[7:13] == ["--tracker", "t", "--seeds", "2", "--repeats", "4"]
    assert words[words.index("--policy") + 1] == "replay:a b;rm"
    assert words[words.index("--max-steps") + 1] == "50"
    assert not {"--worlds", "--remote-timeout", "--remote-insecure"} & set(words)


def test_command_asks_a_policy_server_in_the_same_way():
    """The command keeps how a policy server was asked, and the worlds at once if they matter."""
    episode = record(EMPTY)
    options = {"policy": "remote:https://host:1", "remote_timeout": 3.5, "remote_retries": 4, "worlds": 7}
    options |= {"remote_insecure": True, "remote_sequential": True}
    words = shlex.split(replay_command(options, episode, 7))
    assert {"--remote-insecure", "--remote-sequential"} <= set(words) and "--remote-retries" not in words
    assert words[words.index("--remote-timeout") + 1] == "3.5" and words[words.index("--worlds") + 1] == "7"
    program = {"policy": "process:python agent.py", "remote_timeout": 3.5, "remote_retries": 2}
    words = shlex.split(replay_command(program, episode))
    assert "--remote-timeout" in words and "--remote-retries" not in words
    plain = {"policy": "remote:http://host:1"} | dataclasses.asdict(Remote())
    assert not [word for word in shlex.split(replay_command(plain, episode)) if word.startswith("--remote")]


def test_worlds_of_a_policy_that_depends_on_them_stand_in_the_command(tmp_path):
    """The page's commands name --worlds only where the configuration says that results depend on it."""
    for name, worlds in (("a", None), ("b", 5)):
        folder = folder_with(tmp_path / name, episodes("football", (1, 0, 0)), 60, worlds=worlds)
        report.write_reports(load_run(folder))
        assert ("--worlds 5" in (folder / "report.html").read_text()) == (worlds == 5)


HOSTILE = (
    "<script>alert(1)</script>",
    "</title></style></script><img src=x onerror=alert(1)>",
    '"><svg onload=alert(1)>',
    "' onmouseover='alert(1)",
    "javascript:alert(1)",
    "data:text/html,<script>alert(1)</script>",
    "//evil.example/x.png",
    "https://evil.example/x.mp4",
    "file:///etc/passwd",
    "videos/../../../etc/passwd",
    "strips/..%2f..%2fx.png",
    "videos/x.mp4#javascript:alert(1)",
    "videos/x.svg",
    "strips/a.html",
    "strips/a.jpg ",
    "strips/a.jpg\n",
    "\\\\host\\share\\x.png",
    "&lt;script&gt;&#x3c;b&#x3e;",
    "]]><!--<b>-->",
    "`<b>` | [x](javascript:alert(1)) ![x](//evil.example/t.png)",
    "\x1b]8;;http://evil.example\x07\x1b[2J",
    "\u202egpj.exe\u2066",
    "\ud800\udfffx\ud800",
    "\x00\x01\x85\u2028",
    "= cmd|' /C calc'!A0",
    "\uff1cscript\uff1ealert(1)",
    "{{7*7}}${7*7}<%= 7 %>",
)
PLACES = ("task", "tracker", "policy", "mode", "reason", "error", "outcome", "group_seed", "repeat", "steps", "margin")
SLOTS = ("ego", "world", "ego strip", "world strip", "x", "<b>")


def hostile_run(number):
    """A run with hostile strings in journal and configuration; which and where follow from a number."""
    draw = random.Random(number)

    def text():
        return "".join(draw.choice(HOSTILE) for _ in range(draw.choice((1, 1, 1, 2))))

    rows = [recorded(row, "ego strip", "ego") for row in episodes("football", (1, 1, 0), repeats=2, falls=2)]
    for row in rows:
        row["media"] |= {draw.choice(SLOTS): draw.choice((text(), 7, None, ["a"])) for _ in range(3)}
    for row in draw.sample(rows, 4):
        row[draw.choice(PLACES[:6])] = text()
    rows[0] |= {"outcome": "error", "error": text()}
    document = document_of(6)
    document["config"] |= {draw.choice(["policy", "device", "<i>", text()]): text(), "task": ["football", text()]}
    document["rule_set"] |= {text(): text()}
    document["options"] |= {"policy": text(), "checkpoint": text()}
    document["variant_changes"] = [text()]
    document["environments"] = {text(): {"engine": text(), text(): {text(): text()}}}
    document["versions"] = {text(): text()}
    document, rows = json.loads(json.dumps([document, rows]))
    return RunRecord(Path("nowhere"), document, [made(row) for row in rows])


def test_strangers_results_carry_nothing_into_the_page(tmp_path, mutants):
    """Hostile journals: the page has no element, attribute or kind of address that a harmless one has not."""
    rows = [recorded(row, *SLOTS[:4]) for row in episodes("football", (2, 1, 0), falls=9)]
    rows[30] |= {"outcome": "error", "reason": "policy", "error": "x"}
    folder = folder_with(tmp_path / "a", rows, 60)
    document = json.loads((folder / "config.json").read_text())
    document |= {"variant_changes": ["x"], "versions": {"a": "1"}}
    document |= {"environments": {"football base": {"engine": "warp"}}}
    (folder / "config.json").write_text(json.dumps(document))
    harmless = html(folder)
    allowed = {(tag, name) for tag, name, _ in harmless.shape}
    scripts = harmless.text["script"], harmless.text["style"]
    for number in range(mutants):
        run = hostile_run(number)
        text = html_page(run)
        tree = Tree(text)
        assert {(tag, name) for tag, name, _ in tree.shape} <= allowed, number
        assert (tree.text["script"], tree.text["style"]) == scripts
        for _, name, address in tree.shape:
            if name in URLS:
                assert re.fullmatch(r"(videos/[\w.-]+\.mp4|strips/[\w.-]+\.(png|jpg))", address), (number, address)
        assert not any(c in text for c in "\x00\x1b\x07\u202e\u2066\u2028")
        text.encode("utf-8")
        if number % 8 == 0:
            markdown = report._markdown(run, results_json(run))
            text = re.sub(r"`[^`]*`", "", markdown)
            assert not re.search(r"(?<!\\)<(?=[A-Za-z/!?])|(?<!\\)\]\((?!videos/|strips/)", text), number
            assert "\x1b" not in markdown
            report.table_csv(results_json(run)).encode("utf-8")


def html_page(run):
    """The page of a run without writing it."""
    return report._html(run, results_json(run))


def test_policy_names_the_one_script(tmp_path):
    """The Content-Security-Policy allows this script and this style by their hashes, and nothing from elsewhere."""
    tree = html(folder_with(tmp_path / "a", episodes("football", (1, 0, 0)), 60))
    (policy,) = [m["content"] for m in tree.find("meta") if m.get("http-equiv") == "Content-Security-Policy"]
    assert policy.startswith("default-src 'none'") and "unsafe" not in policy and "http" not in policy
    for tag in ("script", "style"):
        digest = base64.b64encode(hashlib.sha256(tree.text[tag].encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert not any(name.startswith("on") or name == "style" for _, given in tree.elements for name in given)


BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


@pytest.fixture(scope="module")
def browser():
    """A headless browser."""
    found = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if found is None:
        pytest.skip(f"needs a browser ({', '.join(BROWSERS)}), none is installed")
    return found


def test_page_in_a_browser(tmp_path, browser):
    """In a browser the script runs under the policy, and at 400 and 1280 px nothing is wider than the window."""
    rows = [recorded(row, "ego strip") for row in episodes("football", (2, 1, 0), repeats=4)]
    policy = "remote:http://a-policy-server.with-a-long-name.example:8000/v1"
    rows = [row | {"policy": policy} for row in rows]
    folder = folder_with(tmp_path / "a", rows, 12)
    report.write_reports(load_run(folder))
    (folder / "strips").mkdir()
    # A probe next to the page looks at it in frames.
    (tmp_path / "probe.html").write_text(
        "".join(f"<iframe src='a/report.html' width={width} height=900></iframe>" for width in (400, 1280))
        + "<p></p><script>onload = () => { document.querySelector('p').textContent = Array.from(frames).map(frame => {"
        "const d = frame.document.documentElement; return [d.scrollWidth, d.clientWidth, "
        "d.querySelector('#controls').hidden, d.querySelector('output').textContent].join()}).join(';')}</script>"
    )
    command = [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1280,900", "--virtual-time-budget=2000"]
    command += ["--dump-dom", (tmp_path / "probe.html").as_uri()]
    page = subprocess.run(command, capture_output=True, text=True, timeout=500).stdout
    frames = [frame.split(",") for frame in re.search("<p>(.*)</p>", page)[1].split(";")]
    assert all(frame[2] == "false" and "12 of 12 episodes" in frame[3] for frame in frames), frames
    narrow, small, wide, large = (int(number) for frame in frames for number in frame[:2])
    assert narrow <= small <= 400 < wide <= large <= 1280


def test_notes_tell_what_the_table_hides(tmp_path):
    """Missing episodes, errors, overflow and a step cap are reported in words."""
    rows = episodes("football", (1, 0, 0))[:30]
    rows[3] |= {"outcome": "error"}
    rows[4] |= {"overflow": True}
    run = load_run(folder_with(tmp_path / "a", rows, 60, max_steps=50))
    text = " ".join(report.notes(run, results_json(run)))
    for words in ("30 of 60", "1 episode ended with an error", "overflowed", "50 ticks"):
        assert words in text


def test_folder_without_run_is_named(tmp_path):
    """A folder that holds no run, or a broken config.json, is bad input."""
    with pytest.raises(InputError, match=r"no config\.json"):
        load_run(tmp_path)
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(InputError, match="cannot be read"):
        load_run(tmp_path)
