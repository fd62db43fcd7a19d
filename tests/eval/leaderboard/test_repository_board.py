"""The entries of the repository, and the board that is made of them."""

import re
import shutil
import subprocess
from pathlib import Path

import pytest

from arena_newton.eval.__main__ import main

ROOT = Path(__file__).resolve().parents[3]


def test_every_entry_of_the_repository_is_sound(tmp_path, monkeypatch, capsys):
    """The entries in leaderboard/ pass schema, audit and a replay, and the board names each."""
    monkeypatch.chdir(ROOT)
    flags = ["--replay", "1", "--draw", "10", "--out", str(tmp_path / "site")]
    assert main(["leaderboard", "build", *flags]) == 0, capsys.readouterr().out
    text = (tmp_path / "site" / "index.html").read_text()
    entries = [path.parent.name for path in (ROOT / "leaderboard").glob("*/entry.toml")]
    assert len(entries) >= 9 and all(f'href="{name}.html"' in text for name in entries)
    assert "<h2>merged</h2>" not in (tmp_path / "site" / "expert.html").read_text()  # an untrained policy of many tasks
    for title in ("in-GMT", "in-GMT, other modes", "cross-GMT", "merged"):
        assert f"<h2>{title}</h2>" in text
    assert text.index("WB-WAM") < text.index("Diffusion Policy (paper)") and "in Isaac Sim" in text


BROWSERS = ("chromium", "chromium-browser", "google-chrome")
PROBE = """<p></p><script>onload = () => { document.querySelector('p').textContent = Array.from(frames).map(frame => {
const d = frame.document, e = d.documentElement, s = d.querySelector('select[name=tracker]');
const before = d.querySelector('output').textContent;
const cut = [...d.querySelectorAll('small')].filter(one => one.scrollWidth > one.clientWidth + 1).length;
s.value = 'sonic'; s.dispatchEvent(new frame.Event('change'));
const head = d.querySelectorAll('th')[6]; head.querySelector('button').click();
const shown = [...head.closest('table').tBodies[0].rows].filter(r => !r.hidden).map(r => r.cells[6].dataset.value);
return [e.scrollWidth, e.clientWidth, before, d.querySelector('output').textContent, head.ariaSort, cut,
shown.join(' ')].join()}).join(';')}</script>"""


def test_the_board_in_a_browser(tmp_path, monkeypatch):
    """In a browser the board filters and sorts, and at 400 and 1280 px nothing is wider than the window or cut."""
    browser = next((path for name in BROWSERS if (path := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"needs a browser ({', '.join(BROWSERS)}), none is installed")
    monkeypatch.chdir(ROOT)
    entries = [f"leaderboard/{name}" for name in ("wb_wam", "paper_act", "paper_dp", "expert")]
    assert main(["leaderboard", "build", *entries, "--out", str(tmp_path / "site")]) == 0
    frames = "".join(f"<iframe src='site/index.html' width={width} height=900></iframe>" for width in (400, 1280))
    (tmp_path / "probe.html").write_text(frames + PROBE)
    command = [browser, "--headless=new", "--no-sandbox", "--disable-gpu", "--allow-file-access-from-files"]
    command += [f"--user-data-dir={tmp_path / 'profile'}", "--window-size=1280,900", "--virtual-time-budget=2000"]
    command += ["--dump-dom", (tmp_path / "probe.html").as_uri()]
    page = subprocess.run(command, capture_output=True, text=True, timeout=500).stdout
    frames = [frame.split(",") for frame in re.search("<p>(.*)</p>", page)[1].split(";")]
    for width, limit, before, after, sort, cut, values in frames:
        rates = [float(value) for value in values.split()]
        assert int(width) <= int(limit) and before != after and before.startswith(before.split()[2]), frames
        assert cut == "0" and sort == "descending" and len(rates) == 3 and rates == sorted(rates, reverse=True)
