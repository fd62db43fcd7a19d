"""The driver of `run --ray` and the messages of processes: nothing is lost, nothing counts twice."""

from pathlib import Path
from types import SimpleNamespace

import pytest
from eval_fakes import FakePolicy, factories

from arena_newton import doctor
from arena_newton.cli import extras
from arena_newton.eval.__main__ import main
from arena_newton.eval.folders.run_folder import ResultsFolder
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.run import RunStopped, check_parts
from arena_newton.eval.play.run_flow import begun, progress_of
from arena_newton.eval.records.journal import Journal, read_journal
from arena_newton.eval.workers import dealing
from arena_newton.eval.workers.batch_player import play
from arena_newton.eval.workers.messages import Done, Ended, EpisodeBatch
from arena_newton.eval.workers.worker_pool import Job, Lost, Worker
from arena_newton.physics import devices

ray = pytest.importorskip("ray", reason="needs the extra [ray]")

MODES = ("base", "execution")
PLAN = {"task": ("football", "boxing"), "mode": MODES, "seeds": (0, 1), "repeats": 2}
PLAN |= {"engine": "mujoco", "worlds": 4, "ray": ()}


class StubPool:
    """Processes that play in this one, and are lost where a test says so."""

    def __init__(self, job, size, lost=lambda assignment, told: None, made_of=None):
        self.folder, self.workers, self.lost = job.folder, [Worker(job=job) for _ in range(size)], lost
        self.made_of, self.shown = made_of or factories(), None
        self.policy, self.backend = FakePolicy("expert"), SimpleNamespace(flag="--ray")
        self.sizes = []

    def idle(self):
        return [worker for worker in self.workers if worker.assignment is None]

    def assign(self, worker, assignment):
        worker.assignment, worker.last = assignment, assignment.group
        self.sizes.append((assignment.size, assignment.worlds, tuple(assignment.left)))

    def messages(self):
        for worker in self.workers:
            assignment = worker.assignment
            if assignment is None:
                continue
            told = []
            part = EpisodeBatch(
                " ".join(assignment.group),
                tuple(assignment.left),
                assignment.worlds,
                self.folder.document["config_hash"],
            )
            play(part, self.folder.config, Path("/no/shared/disk"), self.made_of, self.policy, told.append)
            loss = self.lost(assignment, told)
            for event in told if loss is None else told[: loss[0]]:
                yield assignment.job, assignment, event
            worker.assignment = None
            yield assignment.job, assignment, Done() if loss is None else loss[1]


@pytest.fixture
def driven(tmp_path):
    """Plays a plan with a stub pool; gives the records, the pool and the folder."""

    def drive(lost=lambda assignment, told: None, size=2, made_of=None, out="r", **changes):
        options = RunOptions(**(PLAN | {"out": str(tmp_path / out)} | changes))
        config, _ = check_parts(resolve(options), factories())
        folder = ResultsFolder(tmp_path / out, config, doctor.versions())
        folder.check()
        folder.make()
        job = Job(folder)
        pool = StubPool(job, size, lost, made_of)
        with Journal(folder.journal) as journal:
            folder.prepare(config, journal.records)
            done, waiting = begun(config, folder, journal.records)
            dealing._play(dealing.DealtRun(job, journal, pool, done, waiting, progress_of(config, done, waiting)))
        return read_journal(folder.journal)[0], pool, folder

    return drive


def outcomes(records):
    """Ends of the episodes, by number; each is there once."""
    assert len({record.index for record in records}) == len(records)
    return {record.index: (record.outcome, record.steps, record.margin) for record in records}


def test_batches_cover_the_plan_once(driven, tmp_path):
    """Episodes play once in batches of at most twice the worlds, as in a run; actions come without shared disk."""
    records, pool, folder = driven()
    assert all((folder.path / record.media["actions"]).is_file() for record in records)
    plan = ["--task", "football", "boxing", "--mode", *MODES, "--seeds", "0", "1", "--repeats", "2"]
    assert main(["run", *plan, "--engine", "mujoco", "--out", str(tmp_path / "one")], factories()) == 0
    assert outcomes(records) == outcomes(read_journal(tmp_path / "one" / "episodes.jsonl")[0])
    played = [index for _, _, indices in pool.sizes for index in indices]
    assert sorted(played) == list(range(16)) and max(size for size, _, _ in pool.sizes) <= 8
    _, pool, _ = driven(size=1, out="s", task=("boxing",), mode=(*MODES, "semantic"), worlds=99)
    assert [(size, worlds) for size, worlds, _ in pool.sizes] == [(8, 8), (4, 4)]  # two modes share a scene


def test_losses_lose_nothing(driven):
    """Events that are sent before a process is lost count once; the rest is played again, with the same outcomes."""
    undisturbed, _, _ = driven(out="u")
    count = iter(range(100))

    def lost(assignment, told):
        number = next(count)
        return (number % (len(told) + 1), Lost("killed", with_node=number % 2 == 0)) if number < 9 else None

    records, pool, _ = driven(lost)
    assert outcomes(records) == outcomes(undisturbed)
    assert len(pool.sizes) > 9


def test_what_ended_before_a_loss_is_not_played_again(driven):
    """An episode that was reported is in the journal, and in no later batch."""
    known = set()

    def lost(assignment, told):
        assert not known & set(assignment.left)
        after = next(i for i, event in enumerate(told) if isinstance(event, Ended)) + 1
        known.add(told[after - 1].line["index"])
        return (after, Lost("killed", with_node=True)) if len(known) < 5 else None

    driven(lost)
    assert len(known) >= 5


def test_a_poison_episode_ends_as_an_error_and_the_rest_goes_on(driven):
    """Episodes that run at a loss come into a smaller batch, then alone; after the attempts alone one is an error."""
    undisturbed, _, _ = driven(out="u")

    def lost(assignment, told):
        return (1, Lost("it died")) if 5 in assignment.left else None

    records, pool, _ = driven(lost, worlds=16)
    expected = {index: ending for index, ending in outcomes(undisturbed).items() if index != 5}
    assert {index: ending for index, ending in outcomes(records).items() if index != 5} == expected
    error = next(record for record in records if record.index == 5)
    assert (error.outcome, error.reason) == ("error", "environment")
    assert error.error == "played alone 3 times, each time its process was lost: it died"
    assert error.hashes == records[0].hashes
    with_it = [size for size, _, indices in pool.sizes if 5 in indices]
    assert with_it[-3:] == [1, 1, 1] and with_it[0] > with_it[1] > 1 and len(with_it) == 5


def test_where_every_episode_breaks_the_run_stops(driven):
    """A bug of policy or simulator does not end the whole plan as errors."""
    with pytest.raises(RunStopped, match="boxing twist2 base: 5 episodes and no other: device lost"):
        cell = {"task": ("boxing",), "mode": ("base",), "repeats": 5}
        driven(lambda assignment, told: (1, Lost("device lost", "a trace")), worlds=1, ray_attempts=1, **cell)


def test_a_loss_before_the_environment_is_built_blames_no_episode(driven):
    """A process that dies while it builds costs no episode an attempt, and batches stay as large."""
    count = iter(range(100))
    records, pool, _ = driven(
        lambda assignment, told: (0, Lost("it died")) if next(count) < 6 else None, ray_attempts=1
    )
    assert len(outcomes(records)) == 16 and all(record.outcome != "error" for record in records)
    assert pool.sizes[0][0] == pool.sizes[6][0]


def test_a_lost_machine_blames_no_episode(driven):
    """Episodes of a machine that left the cluster are not suspected."""
    count = iter(range(100))
    records, pool, _ = driven(
        lambda assignment, told: (1, Lost("gone", with_node=True)) if next(count) < 12 else None,
        worlds=1,
        ray_attempts=1,
    )
    assert all(record.outcome != "error" for record in records)


def test_only_so_many_successes_are_played(driven):
    """With --only-success the rounds are those of one process, whatever is lost."""
    count = iter(range(100))

    def lost(assignment, told):
        return (len(told) // 2, Lost("killed", with_node=True)) if next(count) % 3 == 0 else None

    plain, _, _ = driven(out="a", keep=2, worlds=20, size=1)
    records, _, _ = driven(lost, keep=2, size=3)
    assert outcomes(records) == outcomes(plain)
    assert len(records) < 16


FLAGS = ["run", "--task", "boxing", "--engine", "mujoco"]


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--ray-actors", "2"], "--ray-actors: belongs to --ray, which is not given"),
        (["--ray", "a:1", "b:1"], "--ray a:1 b:1: expected one address"),
        (["--ray", "ray://a:1"], "--ray ray://a:1: expected one address"),
        (["--ray", "127.0.0.1:1"], "--ray 127.0.0.1:1: no Ray cluster answers (Connection refused)"),
        (["--ray", "127.0.0.1:99999"], "--ray 127.0.0.1:99999: no Ray cluster answers"),
        (["--ray", "--ray-actors", "0"], "--ray-actors 0: expected at least 1"),
        (["--ray", "--ray-attempts", "0"], "--ray-attempts 0: expected at least 1"),
        (["--ray", "--ray-minutes", "-1"], "--ray-minutes -1: expected more than 0, and finite"),
        (["--ray", "--ray-minutes", "nan"], "--ray-minutes nan: expected more than 0, and finite"),
        (["--ray", "--ray-gpus", "2"], "--ray-gpus 2: expected more than 0 and at most 1"),
        (["--ray", "--ray-gpus", "0.5"], "--ray-gpus 0.5: engine mujoco runs on the CPU"),
        (["--ray", "--device", "cuda"], "--device cuda: engine mujoco runs on the CPU"),
        (["--ray", "--device", "tpu"], "--device tpu: unknown"),
        (["--ray", "--viewer", "usd"], "--viewer: shows worlds of this process"),
        (["--jobs", "2", "--viewer", "usd"], "--viewer: shows worlds of this process"),
        (["--jobs", "2", "--ray"], "--jobs 2: are processes of this machine, not of --ray"),
        (["--jobs", "2", "--ray-minutes", "1"], "--ray-minutes: belongs to --ray, which is not given"),
        (["--jobs", "0"], "--jobs 0: expected 1 to 256"),
        (["--jobs", "2", "--device", "cuda"], "--device cuda: engine mujoco runs on the CPU"),
        (["--jobs", "2", "--device", "cuda:1"], "--device cuda:1: --jobs takes all GPUs in turn"),
    ],
)
def test_wrong_flags_are_refused_before_a_process_starts(flags, said, tmp_path, capsys):
    """Each is one line with exit code 2, and no folder is made."""
    assert main([*FLAGS, *flags, "--out", str(tmp_path / "r")], factories()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"error: {said}") and error.count("\n") == 1
    assert not (tmp_path / "r").exists() and not ray.is_initialized()


def test_a_missing_extra_is_one_line(tmp_path, capsys, monkeypatch):
    """Without Ray the extra and its command are named."""
    find = extras.importlib.util.find_spec
    monkeypatch.setattr(extras.importlib.util, "find_spec", lambda name: None if name == "ray" else find(name))
    assert main([*FLAGS, "--ray", "--out", str(tmp_path / "r")], factories()) == 2
    assert "--ray: needs the extra [ray]" in capsys.readouterr().err


def test_engine_of_a_cluster(monkeypatch, tmp_path):
    """Processes on GPUs are asked for by engine, device or fraction; Warp looks for nothing on this machine."""
    gpus = tmp_path / "gpus"
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setattr(devices, "NVIDIA_DEVICES", gpus)
    monkeypatch.setattr(devices, "DRIVERS", ())
    assert devices.cluster_engine("auto", None, None) == ("mujoco", "cpu")
    assert devices.cluster_engine("auto", None, 0.5) == ("warp", "cuda:0")
    assert devices.cluster_engine("auto", "cuda:3", None) == ("warp", "cuda:0")
    assert devices.cluster_engine("warp", None, None) == ("warp", "cuda:0")
    assert devices.cluster_engine("warp", "cpu", None) == ("warp", "cpu")
    (gpus / "0000:01:00.0").mkdir(parents=True)
    assert devices.cluster_engine("auto", None, None) == ("warp", "cuda:0")
    assert devices.cluster_engine("mujoco", None, None) == ("mujoco", "cpu")
    for named, seen in (("3, 1", ["3", "1"]), ("1,-1,0", ["1"]), ("", [])):
        monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
        assert devices.visible_gpus() == seen
        assert devices.cluster_engine("auto", None, None) == (("warp", "cuda:0") if seen else ("mujoco", "cpu"))
    assert resolve(RunOptions(task=("football",), engine="warp", jobs=2)).device == "cpu", "GPUs of others are not its"
