"""Processes of a cluster are asked for, held to their deadline and replaced; a stand-in for Ray answers."""

import dataclasses
import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from eval_fakes import factories

from arena_newton import doctor
from arena_newton.errors import InputError, UnknownName
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.run import RunStopped, check_parts
from arena_newton.eval.workers.messages import Broke, Built, Done, Node, Opened, Ticks, broke

pytest.importorskip("ray", reason="needs the extra [ray]")
from ray.exceptions import ActorDiedError  # noqa: E402

from arena_newton.eval.workers import ray_backend, worker_pool  # noqa: E402
from arena_newton.eval.workers.worker_pool import Assignment, Job, Lost, WorkerPool  # noqa: E402


class Ref:
    """An answer that comes at once, or never."""

    def __init__(self, value=None, ready=True):
        self.value, self.ready = value, ready


class Stream:
    """The answers of a batch."""

    def __init__(self, values, hangs):
        self.left, self.hangs = [Ref(value) for value in values], hangs

    @property
    def ready(self):
        return bool(self.left) or not self.hangs

    def __next__(self):
        if not self.left:
            raise StopIteration
        return self.left.pop(0)


class Method:
    """A method of an actor."""

    def __init__(self, call):
        self.remote = call

    def options(self, num_returns):
        assert num_returns == "streaming"
        return self


class FakeRay:
    """The part of Ray that the pool uses; a test says what actors answer."""

    def __init__(self, opened, nodes):
        self.node_list, self.opened, self.asked, self.killed = nodes, opened, [], []
        self.events, self.hangs = [], False
        self.node_answer = lambda number: Node("n0", "host", number)

    def nodes(self):
        return self.node_list

    def remote(self, kind):
        return SimpleNamespace(options=lambda **resources: SimpleNamespace(remote=lambda gpu: self._actor(resources)))

    def _actor(self, resources):
        number = len(self.asked)
        self.asked.append(resources)
        return SimpleNamespace(
            number=number,
            node=Method(lambda: Ref(self.node_answer(number))),
            open=Method(lambda options, folder, cores, factories: Ref(self._open(options, folder, cores))),
            play=Method(lambda part: Stream(self.events, self.hangs)),
        )

    def _open(self, options, folder, cores):
        assert options.ray is None and os.path.isabs(folder)
        self.cores = cores
        return self.opened

    def wait(self, refs, timeout):
        return [ref for ref in refs if ref.ready][:1], []

    def get(self, ref):
        if isinstance(ref.value, Exception):
            raise ref.value
        return ref.value

    def kill(self, actor):
        self.killed.append(actor.number)


def node(name="n0", **resources):
    """A machine as Ray tells of it."""
    return {"NodeID": name, "Alive": True, "Resources": {"CPU": 8.0} | resources}


@pytest.fixture
def pool_of(tmp_path, monkeypatch):
    """Makes a pool for a plan of eight episodes, and the Ray that it asks."""

    def make(nodes=None, opened=None, **changes):
        options = RunOptions(
            **({"task": ("boxing",), "seeds": (0,), "repeats": 8, "ray": ("a:1",), "engine": "mujoco"} | changes)
        )
        planned = resolve(options)
        config, _ = check_parts(planned, factories())
        said = Opened(
            config.identity(),
            config.labels,
            config.worlds_matter,
            config.tracker_facts,
            config.policy_facts,
            doctor.versions(),
            "cpu",
        )
        fake = FakeRay(dataclasses.replace(said, **(opened or {})), nodes or [node()])
        monkeypatch.setattr(ray_backend, "ray", fake)
        folder = ResultsFolder(tmp_path / "r", planned, doctor.versions())
        folder.document = {"config_hash": config.hash}
        pool = WorkerPool(ray_backend.RayBackend(planned.flags, planned.device), len(planned.episodes), None)
        pool.job = Job(folder)
        return pool, fake, config

    return make


def assignment(pool, config):
    """The first two episodes."""
    episodes = config.episodes[:2]
    return Assignment(pool.job, ("boxing", "twist2", "base"), {episode.index: episode for episode in episodes}, 2, 0)


def messages(pool, rounds=6):
    """Messages of so many rounds."""
    return [message for _ in range(rounds) for _, _, message in pool.messages()]


def all_idle(pool):
    """Hear until all have opened the run."""
    while not (pool.workers and all(worker.job is pool.job and not worker.busy for worker in pool.workers)):
        for worker in pool.idle():
            if worker.job is not pool.job:
                pool.prepare(worker, pool.job)
        messages(pool, 1)


def test_as_many_as_there_is_room_for(pool_of):
    """Cores and fractions of GPUs are asked for per actor; cores of one machine are taken once."""
    pool, fake, config = pool_of()
    assert fake.asked == [{"num_cpus": 4, "num_gpus": 0.0, "max_restarts": 0}] * 2
    assert pool.opened(pool.job).hash == config.hash
    all_idle(pool)
    assert sorted(worker.rank for worker in pool.workers) == [0, 1] and fake.cores in ((0, 4), (4, 4))
    gpus = [node(GPU=2.0, CPU=32.0), node("n1", CPU=2.0)]
    pool, fake, _ = pool_of(gpus, engine="warp", ray_gpus=0.5)
    assert len(fake.asked) == 4 and fake.asked[0]["num_gpus"] == 0.5 and fake.asked[0]["num_cpus"] == 4
    assert len(pool_of(ray_actors=3)[0].workers) == 3
    assert len(pool_of([node(CPU=256.0)])[0].workers) == 8, "no more than episodes"


def test_machines_that_join_are_used(pool_of, monkeypatch):
    """Actors are added when the cluster grows."""
    pool, fake, _ = pool_of()
    all_idle(pool)
    fake.node_list.append(node("n1"))
    monkeypatch.setattr(worker_pool, "GROWTH", 0.0)
    messages(pool, 1)
    assert len(pool.workers) == 4


def test_a_batch_is_reported(pool_of):
    """Events come in their order, then the end; then the process waits."""
    pool, fake, config = pool_of(ray_actors=1)
    all_idle(pool)
    fake.events = [Built({}), Ticks(3)]
    pool.assign(pool.idle()[0], assignment(pool, config))
    assert messages(pool) == [Built({}), Ticks(3), Done()] and pool.idle()


def test_a_batch_past_its_deadline_is_stopped(pool_of):
    """Its process is killed, the batch is reported as lost, and another process is asked for."""
    pool, fake, config = pool_of(ray_actors=1, ray_minutes=0.001)
    all_idle(pool)
    fake.hangs = True
    pool.assign(pool.idle()[0], assignment(pool, config))
    pool.workers[0].until -= 1.0
    assert messages(pool, 1) == [Lost("took longer than 0.001 min (--ray-minutes)")]
    assert fake.killed == [0]
    pool.workers[0].again_at = 0.0
    all_idle(pool)
    assert len(fake.asked) == 2


def test_death_is_told_with_its_machine(pool_of):
    """A machine that left the cluster is distinguished from a process that died."""
    for alive in (True, False):
        pool, fake, config = pool_of(ray_actors=1)
        all_idle(pool)
        fake.events = [ActorDiedError()]
        pool.assign(pool.idle()[0], assignment(pool, config))
        fake.node_list[0]["Alive"] = alive
        (lost,) = messages(pool, 1)
        assert lost.with_node != alive


def test_processes_that_never_begin_stop_the_run(pool_of, monkeypatch):
    """Five in a row that break before an environment is built: the cause is reported."""
    monkeypatch.setattr(worker_pool, "LONGEST_PAUSE", 0.0)
    pool, fake, _ = pool_of(ray_actors=1)
    fake.opened = Broke("broken", "ImportError: no newton", "a trace")
    with pytest.raises(RunStopped, match="--ray a:1: 5 processes on host ended one after the other: ImportError"):
        pool.opened(pool.job)
    assert len(fake.asked) == 5


def test_other_code_or_versions_are_refused(pool_of):
    """A node that would play something else is named, with what differs."""
    versions = doctor.versions() | {"mujoco": "3.0"}
    with pytest.raises(InputError, match=r"--ray a:1: on node host mujoco is 3\.0, here .*; all nodes need the"):
        pool, _, _ = pool_of(opened={"versions": versions})
        pool.opened(pool.job)
    pool, fake, config = pool_of()
    fake.opened = dataclasses.replace(fake.opened, identity=config.identity() | {"code": "0123"})
    with pytest.raises(InputError, match="on node host code is 0123"):
        pool.opened(pool.job)
    pool, fake, _ = pool_of()
    fake.opened = Broke("input", "--policy x: no such file", "")
    with pytest.raises(InputError, match="^--policy x: no such file$"):
        pool.opened(pool.job)


def test_a_name_that_other_processes_lack_is_explained(pool_of):
    """A name that a program registers is refused where others play, with what to do; other unknown values are not."""
    pool, fake, _ = pool_of()
    fake.opened = broke(UnknownName("--recorder own: unknown recorder; known are speed"))
    with pytest.raises(InputError, match="own: unknown .*; --ray a:1 plays in other processes .* an entry point"):
        pool.opened(pool.job)
    fake.opened = broke(InputError("--device gpu: unknown, choose cpu, cuda or cuda:N"))
    with pytest.raises(InputError, match="^--device gpu: unknown, choose cpu, cuda or cuda:N$"):
        pool.opened(pool.job)


def test_the_driver_loads_no_physics():
    """A process that deals episodes out needs no GPU or simulator: neither torch nor Warp is imported.

    A process that plays begins alike, so that its cores and GPU are settled before they load.
    """
    heavy = "{'torch', 'warp', 'newton', 'mujoco'}"
    names = "dealing", "local_backend", "ray_backend"
    program = (
        f"import sys\nfrom arena_newton.eval.workers import {', '.join(names)}\nprint(*{heavy} & set(sys.modules))"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=500, check=True)
    assert done.stdout.split() == []
