"""`eval matrix --ray` and `--jobs`: one pool plays the cells of a suite, several at once; what is lost is played again.

Processes are objects of this process, which answer in turn; a test says when one dies.
"""

import contextlib
import functools
import itertools
import json
import re
from types import SimpleNamespace

import pytest
from eval_fakes import FakeEnv, FakePolicy, factories
from made_folders import SUITE, contents, journals

from arena_newton.errors import InputError
from arena_newton.eval.__main__ import main
from arena_newton.eval.play import run
from arena_newton.eval.suites.suite_records import load_cell, read_suite
from arena_newton.eval.workers.shard_merge import merge

ray = pytest.importorskip("ray", reason="needs the extra [ray]")
from ray.exceptions import ActorDiedError  # noqa: E402

from arena_newton.eval.workers import batch_player, dealing, local_backend, ray_backend, worker_pool  # noqa: E402
from arena_newton.eval.workers.actor import EpisodeActor  # noqa: E402
from arena_newton.eval.workers.backend import WorkerLost  # noqa: E402
from arena_newton.eval.workers.messages import Done, Node  # noqa: E402


class Answer:
    """An answer that is computed when it is fetched."""

    def __init__(self, work):
        self.work = work


class InlineRay:
    """The part of Ray that the pool uses; `dies` is asked before each answer."""

    def __init__(self, dies=lambda: False, cores=2.0):
        self.dies, self.opened, self.actors, self.killed = dies, [], 0, 0
        self.machine = {"NodeID": "n0", "Alive": True, "Resources": {"CPU": cores}}

    def nodes(self):
        return [self.machine]

    def remote(self, kind):
        return SimpleNamespace(options=lambda **resources: SimpleNamespace(remote=self._actor))

    def _actor(self, gpu):
        self.actors += 1
        actor, number = EpisodeActor(), self.actors

        def opening(options, folder, cores, made_of):
            self.opened.append((number, folder))
            return Answer(lambda: actor.open(options, folder, (0, 1 << 20), made_of))

        playing = SimpleNamespace(remote=lambda part: map(lambda event: Answer(lambda: event), actor.play(part)))
        return SimpleNamespace(
            node=SimpleNamespace(remote=lambda: Answer(lambda: Node("n0", "host", number))),
            open=SimpleNamespace(remote=opening),
            play=SimpleNamespace(options=lambda num_returns: playing),
        )

    def wait(self, refs, timeout):
        return refs, []

    def get(self, ref):
        if self.dies():
            raise ActorDiedError
        return ref.work()

    def kill(self, actor):
        self.killed += 1


class InlineProcess:
    """A process of --jobs, whose answers are those of an actor of `InlineRay`."""

    def __init__(self, fake, gpu):
        self.fake, self.gpu, self.runs, self.pipe, self.actor = fake, gpu, True, self, fake._actor(gpu)

    def ask(self, method, *arguments):
        called = getattr(self.actor, method)
        self.answers = called.options("streaming").remote(*arguments) if method == "play" else None
        self.answer = called.remote(*arguments) if method != "play" else None

    def take(self):
        answer = self.answer if self.answers is None else next(self.answers, None)
        if self.fake.dies():
            raise WorkerLost
        return Done() if answer is None else answer.work()

    def end(self):
        self.runs = False
        self.fake.killed += 1


def stand_in(patch, dies=lambda: False, cores=2.0):
    """Put a stand-in with so many cores in the place of Ray and of the processes of --jobs."""
    found = InlineRay(dies, cores)
    patch.setattr(ray_backend, "ray", found)
    patch.setattr(ray_backend, "in_cluster", lambda address: contextlib.nullcontext())
    patch.setattr(local_backend, "LocalProcess", functools.partial(InlineProcess, found))
    patch.setattr(local_backend, "connection", SimpleNamespace(wait=lambda pipes, timeout: pipes))
    patch.setattr(worker_pool, "FIRST_PAUSE", 0.0)
    patch.setenv("OMP_NUM_THREADS", "2")
    return found


@pytest.fixture
def inline(monkeypatch):
    """Makes a stand-in for processes, of Ray or of --jobs."""
    return functools.partial(stand_in, monkeypatch)


@pytest.fixture
def suite(tmp_path):
    """Path of the suite file."""
    path = tmp_path / "small.toml"
    path.write_text(SUITE)
    return path


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """Folder of the suite that was played without Ray."""
    folder = tmp_path_factory.mktemp("alone")
    (folder / "small.toml").write_text(SUITE)
    assert main(["matrix", str(folder / "small.toml"), "--out", str(folder / "out")], factories()) == 0
    return folder / "out"


RAY, JOBS = ("--ray", "--ray-cpus", "1"), ("--jobs", "2")


def call(suite, out, *flags, by=RAY, **changes):
    """Exit code of `eval matrix` with processes of one core."""
    command = ["matrix", str(suite), "--out", str(out), *by, *flags]
    return main(command, factories(**changes))


def merged(out, target):
    """All files of all cells but for the times, as `merge` writes each cell alone."""
    found = {}
    for cell in read_suite(out).cells:
        merge([out / cell.folder], target / cell.folder)
        found[cell.id] = contents(target / cell.folder)
    return found


@pytest.fixture(scope="module")
def undisturbed(alone):
    """Folder of the suite that two processes played without any loss, and the stand-in for Ray."""
    with pytest.MonkeyPatch.context() as patch:
        fake, out = stand_in(patch), alone.parent / "ray"
        assert call(alone.parent / "small.toml", out) == 0
        return out, fake


def test_the_same_bytes_as_without(undisturbed, alone, tmp_path):
    """Journals, tables and reports of all cells are those of one process, and suite.json says the same of them."""
    out, _ = undisturbed
    assert merged(out, tmp_path / "a") == merged(alone, tmp_path / "b")
    found, wanted = read_suite(out), read_suite(alone)
    for mine, its in zip(found.cells, wanted.cells, strict=True):
        assert (mine.id, mine.config, mine.status, mine.finished, mine.successes, mine.device) == (
            (its.id, its.config, "done", 4, its.successes, "cpu")
        )
        assert mine.wall_s > 0 and load_cell(found, mine).document["status"]["state"] == "success"


def test_modes_with_facts_of_their_own_play_in_one_batch(inline, suite, tmp_path):
    """Processes take cells that play at once by the ranges of all their modes: those of `dynamics` beside `base`."""
    text = suite.read_text()
    assert 'modes = ["base", "visual"]' in text
    suite.write_text(text.replace('modes = ["base", "visual"]', 'modes = ["base", "dynamics"]'))
    inline()
    assert call(suite, tmp_path / "out", by=JOBS) == 0
    assert {(cell.mode, cell.status) for cell in read_suite(tmp_path / "out").cells} == {
        ("base", "done"),
        ("dynamics", "done"),
    }


def test_one_crew_for_all_cells(undisturbed):
    """Processes are asked for once; cells are opened by who plays them; who is free before the end helps another.

    Cells in several modes of one scene are opened once. A process plays the cells of its environment first.
    """
    _, fake = undisturbed
    assert fake.actors == 2 and {number for number, _ in fake.opened} == {1, 2}
    folders = [folder for _, folder in fake.opened]
    assert len(set(folders)) == 4 and len(folders) < 8
    groups = {n: [folder.split("/")[-2] for number, folder in fake.opened if number == n] for n in (1, 2)}
    changes = sum(before != after for one in groups.values() for before, after in itertools.pairwise(one))
    assert changes <= 2, groups


def test_a_process_stays_in_its_scene(inline, suite, tmp_path):
    """The next cell of a process is one that has the scene of the last, as one environment serves both."""
    suite.write_text(SUITE.replace('["base", "visual"]', '["base", "semantic", "visual"]'))
    fake = inline()
    assert call(suite, tmp_path / "out", "--ray-actors", "1") == 0
    cells = ["/".join(folder.split("/")[-4:]) for _, folder in fake.opened]
    order = ("expert/twist2/{}/base", "still/twist2/{}/base", "expert/twist2/{}/semantic")
    assert cells == [name.format(task) for task in ("boxing", "football") for name in order]


@pytest.mark.parametrize(("device", "most"), [("cpu", 4), ("NVIDIA H200", 8)])
def test_a_gpu_plays_a_cell_whole(inline, suite, tmp_path, monkeypatch, device, most):
    """Cells are divided among processes without a GPU alone; those with the longest episodes begin first."""
    text = SUITE.replace("worlds = 2", "worlds = 8").replace('["boxing", "football"]', '["football", "boxing"]')
    suite.write_text(text.partition('[[policies]]\nname = "still"')[0])
    monkeypatch.setattr(batch_player, "device_name", lambda _: device)
    dealt, deal = [], dealing.DealtRun.next

    def seen(run, worker):
        given = deal(run, worker)
        dealt.append((given.group[0], len(given.left), given.worlds))
        return given

    monkeypatch.setattr(dealing.DealtRun, "next", seen)
    inline()
    assert call(suite, tmp_path / "out", by=("--jobs", "4")) == 0
    named, counts, worlds = zip(*dealt, strict=True)
    assert named[0] == "boxing" and (max(counts), max(worlds), sum(counts)) == (most, most, 16)


@pytest.mark.parametrize(("every", "by"), [(11, (*RAY, "--ray-attempts", "99")), (11, JOBS)], ids=str)
def test_losses_lose_nothing(inline, suite, alone, tmp_path, every, by):
    """Processes die while they begin, open a cell and play; every episode is in its journal once, with its outcome."""
    count = itertools.count(1)
    fake = inline(lambda: next(count) % every == 0)
    assert call(suite, tmp_path / "out", by=by) == 0
    assert journals(tmp_path / "out") == journals(alone)
    assert fake.killed > 2


def test_interrupted_and_continued(inline, suite, alone, tmp_path, capsys):
    """Ctrl-C ends with code 130 and prints the command; it, or one without Ray, continues to the same episodes."""
    out, count = tmp_path / "out", itertools.count()

    def interrupt():
        if next(count) == 25:
            raise KeyboardInterrupt
        return False

    inline(interrupt)
    assert call(suite, out, "--ray-actors", "2") == 130
    said = capsys.readouterr().out
    assert re.search(r"interrupted; \d of 6 cells done; continue with: .*--ray --ray-actors 2 --ray-cpus 1\n", said)
    states = {cell.status for cell in read_suite(out).cells}
    assert "started" in states
    inline()
    assert call(suite, out, "--limit", "1") == 0
    assert main(["matrix", str(suite), "--out", str(out)], factories()) == 0
    assert journals(out) == journals(alone)
    documents = [json.loads(path.read_text()) for path in out.glob("*/*/*/*/config.json")]
    assert {document["status"]["state"] for document in documents} == {"success"} and len(documents) == 6


def test_rows_of_the_default_run_share_processes(inline, tmp_path, monkeypatch, capsys):
    """Experts and the policy that sees are played by the same two processes; a line says so before they load."""
    said, opened = [], dealing.WorkerPool.opened
    monkeypatch.setattr(
        dealing.WorkerPool, "opened", lambda *given: (said.append(capsys.readouterr().err), opened(*given))[1]
    )
    monkeypatch.setattr(run, "_recorder", lambda *_: None)  # these worlds have nothing to draw
    fake, out = inline(), tmp_path / "out"
    assert main(["--device", "cpu", "--jobs", "2", "--out", str(out)], factories()) == 0
    assert fake.actors == 2 and {folder for _, folder in fake.opened} == {str(out), str(out / "learned")}
    folders = out, out / "learned"
    episodes = sum(len((folder / "episodes.jsonl").read_text().splitlines()) for folder in folders)
    assert said[0].endswith(f"  loading tracker and policy for {episodes} episodes; processes: 2\n")
    for folder in folders:
        assert json.loads((folder / "results.json").read_text())["complete"]


@pytest.mark.parametrize(("cores", "viewer", "jobs"), [(8, (), 2), (1, (), 1), (2, ("--viewer", "usd"), 1)])
def test_two_processes_play_the_default_run(tmp_path, monkeypatch, cores, viewer, jobs):
    """Two processes play it on two cores or more, one on one core or where a viewer shows worlds of this process."""
    played = []

    def execute(folders, factories):
        played.append((folders[0] if isinstance(folders, list) else folders).config.flags.jobs)
        return 0

    monkeypatch.setattr(dealing, "execute", execute)
    monkeypatch.setattr(run, "execute", execute)
    monkeypatch.setattr("os.sched_getaffinity", lambda _: set(range(cores)))
    assert main(["--device", "cpu", *viewer, "--out", str(tmp_path / "out")]) == 0
    assert set(played) == {jobs}


class Ignorant(FakePolicy):
    """Knows no football."""

    def check_task(self, task, mode=None, seeds=()):
        if task == "football" and self.name.startswith("remote"):
            raise InputError("knows no football")


def test_a_failing_cell_stops_or_is_passed(inline, suite, alone, tmp_path, capsys):
    """Without --keep-going the suite stops with the cell's name and code 2, with it the others are played: code 1."""
    suite.write_text(SUITE.replace('spec = "stand"', 'spec = "remote:http://127.0.0.1:9"'))
    out = tmp_path / "out"
    inline()
    assert call(suite, out, policy=Ignorant) == 2
    said = capsys.readouterr().err
    assert "cell still/twist2/football/base: knows no football" in said and "--keep-going" in said
    assert call(suite, out, "--keep-going", policy=Ignorant) == 1
    assert "failed: still/twist2/football/base: knows no football" in capsys.readouterr().out
    states = {cell.id: cell.status for cell in read_suite(out).cells}
    assert [name for name, status in states.items() if status != "done"] == ["still/twist2/football/base"]
    assert states["still/twist2/football/base"] == "failed"
    assert call(suite, out) == 0


class Hasty(FakeEnv):
    """A world that breaks in every process."""

    def __init__(self, task, **options):
        if task == "boxing":
            raise RuntimeError("no room for it")
        super().__init__(task, **options)


def test_a_cell_that_ends_every_process_is_passed(inline, suite, tmp_path, capsys, monkeypatch):
    """Five processes one after the other that break on a cell fail this cell alone."""
    monkeypatch.setattr(worker_pool, "LONGEST_PAUSE", 0.0)
    inline(cores=1.0)
    out = tmp_path / "out"
    assert call(suite, out, "--keep-going", env=Hasty) == 1
    failed = {cell.id: cell.error for cell in read_suite(out).cells if cell.status == "failed"}
    assert {name.split("/")[2] for name in failed} == {"boxing"} and len(failed) == 3
    assert all("5 processes on host ended one after the other: RuntimeError: no room" in e for e in failed.values())
    assert {c.status for c in read_suite(out).cells if c.task == "football"} == {"done"}


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--ray-actors", "2"], "--ray-actors: belongs to --ray, which is not given"),
        (["--ray", "--ray-gpus", "2"], "--ray-gpus 2: expected more than 0 and at most 1"),
        (["--ray", "nowhere"], "--ray nowhere: expected one address"),
    ],
)
def test_wrong_flags_are_refused_first(suite, tmp_path, capsys, flags, said):
    """Each is one line with exit code 2, and no folder is made."""
    assert main(["matrix", str(suite), "--out", str(tmp_path / "out"), *flags], factories()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {said}") and error.count("\n") == 1
    assert not (tmp_path / "out").exists()
