"""Recorders of another program in a run: their metrics in journal and tables, whoever plays, and what is refused."""

import importlib
import json
import sys
from types import SimpleNamespace

import pytest
from eval_fakes import FakeEnv, factories, last_tick

from arena_newton import recorders
from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.records.journal import EpisodeRecord
from arena_newton.eval.workers.shard_merge import merge
from arena_newton.eval.workers.worker_pool import WorkerPool
from arena_newton.interfaces import Recorder
from arena_newton.recorders import Metric

RUN = ["--task", "football", "boxing", "--engine", "mujoco", "--seeds", "0", "--repeats", "4"]


def journal(folder):
    """Lines of a journal as JSON, by number."""
    return {one["index"]: one for one in map(json.loads, (folder / "episodes.jsonl").read_text().splitlines())}


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """Folder of a run with a metric."""
    folder = tmp_path_factory.mktemp("run") / "a"
    assert main([*RUN, "--out", str(folder)], factories(recorders=last_tick)) == 0
    return folder


def test_a_metric_is_in_the_journal_and_in_every_table(measured, tmp_path, capsys):
    """A line holds what a recorder gave, and only then; tables show number, mean, deviation and range of each cell."""
    lines = journal(measured)
    given = {index: line.get("extra") for index, line in lines.items()}
    assert given == {i: {"last_tick": float(o["steps"])} if o["outcome"] != "fall" else None for i, o in lines.items()}
    assert None in given.values()
    for line in lines.values():
        assert json.loads(json.dumps(EpisodeRecord.from_json("here", line).to_json())) == line
    results = json.loads((measured / "results.json").read_text())
    for cell in results["cells"]:
        steps = [o["steps"] for o in lines.values() if o["task"] == cell["task"] and o["outcome"] != "fall"]
        found, mean = cell["extra"]["last_tick"], sum(steps) / len(steps)
        assert (found["episodes"], found["least"], found["most"]) == (len(steps), min(steps), max(steps))
        assert found["mean"] == pytest.approx(mean)
        row = f"| {cell['task']:8} | twist2  | expert | base | last_tick | {len(steps)} | "
        for name in ("table.md", "report.md", "report.html"):
            assert row in (measured / name).read_text()
    assert main(["report", str(measured), "--table"]) == 0
    assert "| last_tick | " in capsys.readouterr().out
    assert main(["audit", str(measured)]) == 0
    assert "contradictions 0" in capsys.readouterr().out


def package(folder, monkeypatch):
    """Leaves a package with the recorder `ticks` where Python finds it, as an installer does."""
    text = "    name = 'ticks'\n    fold = 'last'\n    def measure(self, env):\n        return env.tick\n"
    (folder / "of_ticks.py").write_text(f"from arena_newton.recorders import Metric\nclass Ticks(Metric):\n{text}")
    (folder / "of_ticks-1.dist-info").mkdir()
    (folder / "of_ticks-1.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: of-ticks\nVersion: 1\n")
    (folder / "of_ticks-1.dist-info" / "entry_points.txt").write_text(
        "[arena_newton.recorders]\nticks = of_ticks:Ticks\n"
    )
    monkeypatch.syspath_prepend(folder)


def same_metrics(folder, measured):
    """The metrics of a folder are those of another."""
    assert (folder / "results.json").read_text().count("last_tick") == 2
    found, other = ({i: one.get("extra") for i, one in journal(where).items()} for where in (folder, measured))
    assert found == other


def test_joined_shards_keep_metrics(measured, tmp_path):
    """Shards measure as the whole plan does, and keep it when they are joined."""
    for number in ("1", "2"):
        out = ["--shard", f"{number}/2", "--out", str(tmp_path / number)]
        assert main([*RUN, *out], factories(recorders=last_tick)) == 0
    merge([tmp_path / "1", tmp_path / "2"], tmp_path / "merged")
    same_metrics(tmp_path / "merged", measured)


@pytest.mark.release
def test_other_processes_give_the_same_metrics(measured, tmp_path, monkeypatch):
    """Two processes measure as one does, also by the recorder of a package."""
    package(tmp_path, monkeypatch)
    flags = ["--recorder", "ticks", "--jobs", "2", "--out", str(tmp_path / "jobs")]
    assert main([*RUN, *flags], factories(recorders=last_tick)) == 0
    lines = journal(tmp_path / "jobs")
    assert all(lines[i]["extra"].pop("ticks") == line["steps"] for i, line in lines.items())
    assert {i: line["extra"] or None for i, line in lines.items()} == {
        i: line.get("extra") for i, line in journal(measured).items()
    }


def given(name, value):
    """Recorders that give one metric."""

    class Gives(Recorder):
        def finish(self, env, world, result):
            result.extra[name] = value

    return lambda env: [Gives()]


@pytest.mark.parametrize(
    ("name", "value", "says"),
    [
        ("a", float("nan"), "a is nan"),
        ("b", float("inf"), "b is inf"),
        ("", 1.0, " is 1.0"),
        ("c", None, "c is None"),
        ("d", "quite fast", "d is quite fast"),
    ],
)
def test_a_metric_that_is_none_is_named(tmp_path, capsys, name, value, says):
    """A metric that JSON or a table cannot hold stops the run with a line that names it."""
    assert main([*RUN, "--out", str(tmp_path / "a")], factories(recorders=given(name, value))) == 2
    said = capsys.readouterr().err
    assert f"error: recorder: metric {says}".replace("  ", " ") in said.replace("  ", " ")
    assert "expected a finite number with a name" in said and journal(tmp_path / "a") == {}


def test_metrics_of_one_name_are_refused(tmp_path, capsys):
    """Two metrics of one name, of which a line could hold one, are an error that names both; so is one twice."""

    class Ticks(Metric):
        name = "ticks"

    class Hops(Metric):
        name = "ticks"

    assert main([*RUN, "--out", str(tmp_path / "a")], factories(recorders=lambda env: [Ticks(env), Hops(env)])) == 2
    said = capsys.readouterr().err
    assert "error: metric ticks: is the name of" in said and "<locals>.Ticks and of" in said and "<locals>.Hops" in said
    assert journal(tmp_path / "a") == {}
    recorders.register("ticks", Ticks)
    try:
        assert main([*RUN, "--recorder", "ticks", "ticks", "--out", str(tmp_path / "b")]) == 2
        assert "error: --recorder ticks: given twice" in capsys.readouterr().err
    finally:
        recorders.unregister("ticks")
    assert main([*RUN, "--recorder", "nope", "--out", str(tmp_path / "b")]) == 2
    said = capsys.readouterr().err
    known = ", ".join(recorders.names()) or "none: no package is installed that offers one"
    assert f"--recorder nope: unknown recorder; known are {known}\n" in said


def test_a_metric_that_two_recorders_give_is_refused(tmp_path, capsys):
    """A recorder that would overwrite another one's metric, even with the same number, stops the run by both names."""

    class First(Recorder):
        def finish(self, env, world, result):
            result.extra["speed"] = 1.0

    class Second(Recorder):
        def finish(self, env, world, result):
            result.extra |= {"height": 2.0, "speed": 1.0}

    assert main([*RUN, "--out", str(tmp_path / "a")], factories(recorders=lambda env: [First(), Second()])) == 2
    said = capsys.readouterr().err
    assert "error: metric speed: is the name of" in said and "<locals>.First and of" in said
    assert "<locals>.Second; rename one" in said and journal(tmp_path / "a") == {}


def test_a_metric_of_any_size_has_its_figures(tmp_path):
    """A metric that a float just holds is in the tables, though its sum and its square are too large."""
    big = sys.float_info.max
    assert main([*RUN, "--out", str(tmp_path / "a")], factories(recorders=given("big", big))) == 0
    for cell in json.loads((tmp_path / "a" / "results.json").read_text())["cells"]:
        assert cell["extra"]["big"] == {"episodes": 4, "mean": big, "std": 0.0, "least": big, "most": big}


def test_a_run_goes_on_with_its_recorders_alone(measured, tmp_path, monkeypatch, capsys):
    """A run that another program would measure otherwise is refused, since half of its lines would lack the metric."""
    lines = (measured / "episodes.jsonl").read_text().splitlines(keepends=True)
    (tmp_path / "half").mkdir()
    (tmp_path / "half" / "config.json").write_bytes((measured / "config.json").read_bytes())
    (tmp_path / "half" / "episodes.jsonl").write_text("".join(lines[:5]))
    assert main(["resume", str(tmp_path / "half")], factories(recorders=given("other", 1.0))) == 2
    assert "was run with recorders " in capsys.readouterr().err
    (tmp_path / "study.py").write_text("import eval_fakes\n\n\ndef made(env):\n    return eval_fakes.last_tick(env)\n")
    monkeypatch.syspath_prepend(tmp_path)
    again = importlib.import_module("study").made
    assert main(["resume", str(tmp_path / "half")], factories(recorders=again)) == 2
    assert "was run with recorders " in capsys.readouterr().err
    assert main(["resume", str(tmp_path / "half")], factories(recorders=last_tick)) == 0


@pytest.mark.parametrize("made", ["local", "main"])
def test_parts_that_no_other_process_can_import_are_refused(tmp_path, monkeypatch, capsys, made):
    """With --jobs a part of a function, or of the program that was started, is refused by name."""
    recorders = given("a", 1.0)
    if made == "main":
        monkeypatch.setattr(sys.modules["__main__"], "last_tick", last_tick, raising=False)
        monkeypatch.setattr(last_tick, "__module__", "__main__")
        recorders = last_tick
    assert main([*RUN, "--jobs", "2", "--out", str(tmp_path / "a")], factories(recorders=recorders)) == 2
    said = capsys.readouterr().err
    assert "error: --jobs 2: Factories.recorders is <function " in said
    assert "other processes import it by module and name" in said
    assert "Traceback" not in said


def test_ray_carries_no_recorders_of_the_program(monkeypatch):
    """Recorders are known by the file of their code, which on a node is another; other parts may travel."""
    backend = SimpleNamespace(flag="--ray", room=lambda: 0)
    monkeypatch.setattr(sys.modules["__main__"], "last_tick", last_tick, raising=False)
    monkeypatch.setattr(last_tick, "__module__", "__main__")
    with pytest.raises(InputError, match=r"^--ray: Factories\.recorders is <function last_tick"):
        WorkerPool(backend, 0, factories(recorders=last_tick))
    monkeypatch.setattr(FakeEnv, "__module__", "__main__")
    WorkerPool(backend, 0, factories(env=FakeEnv))
