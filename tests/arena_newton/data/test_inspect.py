"""`data stats` and `data inspect`: figures of episodes, outliers, and one page that needs nothing else."""

import base64
import html
import json
import random
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path

import cv2
import numpy as np
import pytest
from made_episodes import make_episode

from arena_newton.data.__main__ import main
from arena_newton.data.checks.episode_figures import FIGURES, figures
from arena_newton.data.datasets.motion_source import Motion
from arena_newton.robot.canonical import ACTION, STAND_ACTION

sys.path.insert(0, str(Path(__file__).parents[2] / "fuzz"))
from mutants import damaged


def motion(joints, state=None, name="a"):
    """An episode whose reference joints are given, shape [T]; all 29 move alike."""
    action = np.tile(STAND_ACTION, (len(joints), 1))
    action[:, ACTION["joint_pos"]] = np.asarray(joints)[:, None]
    measured = np.zeros((len(joints), 64), np.float32)
    measured[:, 6:35] = action[:, ACTION["joint_pos"]] if state is None else state
    return Motion(name, "boxing", "twist2", "success", 1, measured, action)


def test_figures_are_what_they_say():
    """Length, jerk, stillness and error of motions whose figures are known."""
    time = 0.02 * np.arange(101)
    (cubic,) = figures([motion(time**3)])
    assert cubic.seconds == pytest.approx(2.02) and cubic.rows == 101
    assert cubic.jerk == pytest.approx(6.0, rel=0.02)
    half = np.concatenate([np.zeros(50), 0.01 * np.arange(51)])
    (halting,) = figures([motion(half, state=half[:, None] + 0.1)])
    assert halting.still == pytest.approx(0.5, abs=0.01)
    assert halting.error == pytest.approx(0.1, abs=1e-5)
    (single,) = figures([motion([0.3])])
    assert (single.jerk, single.still, single.score) == (0.0, 1.0, 0.0)


def test_the_odd_one_is_found():
    """One episode that differs from eight alike ones in one figure ranks first, for that figure alone."""
    rng = np.random.default_rng(0)
    time = 0.02 * np.arange(200)
    usual = [motion(0.5 * time + rng.normal(0, 1e-3), name=f"{n}") for n in range(8)]
    short = motion(0.5 * time[-60:], name="short")
    jumpy = motion(0.5 * time + 0.05 * (np.arange(200) % 20 == 0), name="jumpy")
    pose = motion(0.5 * time, np.concatenate([0.5 * time[:-1], [5.0]])[:, None], name="pose")
    for odd, reason in ((short, "seconds"), (jumpy, "jerk"), (pose, "final_pose")):
        found = figures([*usual, odd])
        best = max(found, key=lambda one: one.score)
        assert (best.name, best.is_outlier) == (odd.name, True)
        assert getattr(best, reason) != pytest.approx(np.median([getattr(one, reason) for one in found]), rel=0.2)
        assert sum(one.score > best.score / 2 for one in found) == 1
    assert not any(one.is_outlier for one in figures([*usual[:3], short])), "four are too few to be unlike"


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Six recordings, one of them a fall and much longer."""
    folder = tmp_path_factory.mktemp("recorded")
    for repeat in range(5):
        make_episode(folder, 30 + repeat, repeat=repeat)
    make_episode(folder, 120, repeat=5, outcome="fall")
    return folder


def test_stats_prints_table_and_json(folder, capsys):
    """The table names medians and ranks episodes; the JSON has every figure of every episode."""
    assert main(["stats", str(folder)]) == 0
    out = capsys.readouterr().out
    assert re.search(r"\| boxing \| twist2 \| 6 \| 5 \|", out)
    first = next(line for line in out.splitlines() if line.startswith("| boxing__"))
    assert "repeat0005" in first and "(outlier)" in first
    assert main(["stats", str(folder), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert len(found) == 6 and set(FIGURES) <= set(found[0])
    assert found[0]["outlier"] and found[0]["outcome"] == "fall" and found[0]["rows"] == 120


def test_a_dataset_has_the_figures_of_its_recordings(folder, tmp_path, capsys):
    """Figures and page of a dataset that was built of recordings, in either label protocol, are those of them."""
    pytest.importorskip("lerobot")
    wanted = None
    for labels in ("v3.1", "v4"):
        built = tmp_path / labels
        assert main(["build", str(folder), "--out", str(built), "--labels", labels]) == 0
        capsys.readouterr()
        lists = []
        for source in (folder, built):
            assert main(["stats", str(source), "--json"]) == 0
            lists.append(sorted(json.loads(capsys.readouterr().out), key=lambda one: one["seed"]))
        for one, other in zip(*lists, strict=True):
            assert one["outcome"] == other["outcome"]
            for name in FIGURES:
                assert one[name] == pytest.approx(other[name], rel=1e-4, abs=1e-6)
        assert main(["inspect", str(built), "--out", str(tmp_path / "page.html")]) == 0
        text = (tmp_path / "page.html").read_text()
        assert text.count("data:image/jpeg") == 6
        wanted = wanted or text
    capsys.readouterr()


class Outside(HTMLParser):
    """Everything on a page that could load or run something."""

    def __init__(self):
        super().__init__()
        self.found, self.images = [], []

    def handle_starttag(self, tag, attrs):
        for name, value in attrs:
            if name in ("src", "href", "data", "action", "srcset") and not (value or "").startswith("#"):
                (self.images if (value or "").startswith("data:image/jpeg;base64,") else self.found).append(value)
            if name.startswith("on") or name == "style":
                self.found.append(name)
        if tag in ("script", "iframe", "object", "embed", "link", "base", "form"):
            self.found.append(tag)


def test_the_page_needs_nothing_else(folder, tmp_path):
    """No script, no address, a strict policy; figures, phases, curves and a film strip are there."""
    out = tmp_path / "page.html"
    assert main(["inspect", str(folder), "--out", str(out), "--episodes", "2", "--pictures", "4"]) == 0
    text = out.read_text()
    page = Outside()
    page.feed(text)
    assert page.found == []
    policy = "default-src 'none'; img-src data:; base-uri 'none'; form-action 'none'; style-src 'sha256-"
    assert policy in html.unescape(text)
    assert len(page.images) == 2 and text.count("<section") == 2
    assert text.count("repeat0005") >= 2 and text.count("<tr") >= 9
    assert ">approach</span>" in text and ">strike</span>" in text
    for points in re.findall(r'points="([^"]*)"', text):
        pairs = [tuple(map(float, pair.split(","))) for pair in points.split()]
        assert len(pairs) >= 30 and all(0 <= x <= 1000 and -1 <= y <= 121 for x, y in pairs)
    data = base64.b64decode(page.images[0].partition(",")[2])
    strip = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
    assert strip.shape[:2] == (110, 4 * 110 + 3 * 2)


def test_names_from_outside_stay_text(tmp_path):
    """Markup in a recording's texts is shown as text and becomes no element."""
    evil = "<script>alert(1)</script><img src=x>"
    make_episode(tmp_path / "a", 20, arena_task=np.str_(evil), arena_phase_names=np.array([evil, "\x1b[31mb"]))
    out = tmp_path / "page.html"
    assert main(["inspect", str(tmp_path / "a"), "--out", str(out)]) == 0
    page = Outside()
    page.feed(out.read_text())
    assert page.found == [] and "&lt;script&gt;" in out.read_text() and "\x1b" not in out.read_text()


def test_the_page_in_a_browser(folder, tmp_path):
    """Chromium draws the film strip and the curves: the page has their colours, and blocks nothing of its own."""
    browser = shutil.which("chromium")
    if browser is None:
        pytest.skip("needs Debian's package chromium")
    out, shot = tmp_path / "page.html", tmp_path / "page.png"
    assert main(["inspect", str(folder), "--out", str(out)]) == 0
    flags = ["--headless", "--no-sandbox", "--hide-scrollbars", f"--user-data-dir={tmp_path / 'profile'}"]
    flags += ["--enable-logging=stderr", f"--screenshot={shot}", "--window-size=1200,1400", f"file://{out}"]
    log = subprocess.run([browser, *flags], capture_output=True, text=True, timeout=500).stderr
    assert "Content Security Policy" not in log, log
    picture = cv2.imread(str(shot)).astype(int)
    for colour in ((47, 111, 179), (217, 130, 43)):  # --c0 and --c1 of the style
        assert (np.abs(picture[:, :, ::-1] - colour).max(axis=2) < 12).sum() > 200


def test_bad_input_is_one_clear_error(folder, tmp_path, capsys):
    """Flags and folders that do not fit are named, with exit code 2."""
    for arguments, message in {
        ("inspect", str(folder), "--episodes", "0"): "--episodes 0",
        ("inspect", str(folder), "--pictures", "1"): "--pictures 1",
        ("stats", str(tmp_path)): "holds no episodes",
        ("stats", str(tmp_path / "none")): "no such folder",
    }.items():
        assert main(list(arguments)) == 2
        assert message in capsys.readouterr().err
    assert main(["inspect", str(folder), "--out", str(tmp_path)]) == 2
    assert "cannot be written" in capsys.readouterr().err


def test_damaged_recordings(tmp_path, capsys, mutants):
    """Damaged recordings and videos are shown, or refused in one line that names them."""
    folder, rng = tmp_path / "a", random.Random(4)
    make_episode(folder, 12, size=16)
    sound = {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}
    counts = {0: 0, 2: 0}
    for _ in range(mutants):
        path = rng.choice(list(sound))
        path.write_bytes(damaged(sound[path], rng))
        code = main(["inspect", str(folder), "--out", str(tmp_path / "page.html"), "--pictures", "3"])
        error = capsys.readouterr().err
        counts[code] += 1
        assert code == 0 or str(folder) in error, error
        path.write_bytes(sound[path])
    assert counts[2] > mutants // 5 and counts[0] > 0, counts
