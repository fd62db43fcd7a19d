"""``peers --what lerobot_eval``: a learned policy's episodes by our runner and by stock `lerobot-eval`."""

from __future__ import annotations

import contextlib
import json
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import warp as wp

from arena_newton import policies
from arena_newton.cli.flags import user_path
from arena_newton.errors import ArenaError
from arena_newton.eval.bench.timing import BenchFigure, RepeatedEpisodes
from arena_newton.eval.folders.recordings import OUTCOMES_FILE
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.plan.episode_plan import PROTOCOL_REPEATS
from arena_newton.files.own_processes import environment
from arena_newton.policies.learned.learned_card import SHIPPED, shipped_card
from arena_newton.policies.lerobot.checkpoint_facts import checkpoint_folder
from benchmarks.bench_options import PeerOptions
from benchmarks.peer_pairs import Pair, on_cpu

__all__ = ["lerobot_eval_figures"]

PAIR = Pair("lerobot_eval", 5.0, "episodes/s", ("lerobot", "newton", "torch", "warp-lang"), digits=3)
CUDA_EPISODES, CPU_EPISODES = 60, 2
"""Episodes with CUDA and without, where the bar is not judged."""
TASK = "vis_navi"
"""Task of the episodes."""
CLOCK = ("started_at", "finished_at")
"""Fields of our journal with the beginning and the end of an episode."""


@dataclass(frozen=True)
class _Played:
    """Episodes that a command played."""

    seconds: float
    """Time from the first episode's start to the last one's end [s]."""
    command_seconds: float
    """Time from the command's start to its end [s]."""
    solved: int
    """Episodes that succeeded."""

    @property
    def text(self) -> str:
        return f"{self.seconds:.1f} s of {self.command_seconds:.1f} s, {self.solved} solved"


def lerobot_eval_figures(options: PeerOptions) -> Iterator[BenchFigure]:
    """Episodes per second of the whole commands: what one of them loads or compiles beforehand counts too."""
    cuda = bool(wp.is_cuda_available())
    episodes = options.episodes or (CUDA_EPISODES if cuda else CPU_EPISODES)
    label = f"{episodes} VisNavi episodes, learned policy / lerobot-eval, episodes/s"
    if options.checkpoint is None and shipped_card() is None:
        reason = "not measured: no policy comes with this package; name a checkpoint by --checkpoint"
        yield PAIR.missing(label, reason)
        return
    checkpoint = SHIPPED if options.checkpoint is None else user_path(options.checkpoint)
    checkpoint = checkpoint_folder(checkpoint, "--checkpoint ")
    physics = _physics_seconds(options, checkpoint, episodes) if cuda else None
    both = []
    for _ in range(options.long_rounds):
        with tempfile.TemporaryDirectory() as made:
            folder = Path(made)
            ours = _ours(options, checkpoint, episodes, cuda, folder / "ours")
            peer = _peer(options, checkpoint, episodes, cuda, folder / "peer")
        both.append((ours, peer))
    rounds = [(episodes / ours.command_seconds, episodes / peer.command_seconds) for ours, peer in both]
    plays = statistics.median(peer.seconds / ours.seconds for ours, peer in both)
    notes = [f"without start and end {plays:.2f} x", *(f"{ours.text} / {peer.text}" for ours, peer in both)]
    if physics is not None:
        alone = [peer.command_seconds / (ours.command_seconds - ours.seconds + physics) for ours, peer in both]
        ratio = f"{statistics.median(alone):.2f} x"
        notes.append(f"start, end and {physics:.1f} s of physics by themselves would give about {ratio}")
    unjudged = on_cpu(cuda)
    if cuda and (episodes != CUDA_EPISODES or options.steps):
        unjudged = f"not judged (the bar is for {CUDA_EPISODES} whole episodes)"
    label += f", {options.steps} steps at most" if options.steps else ""
    yield PAIR.judge(options, label, rounds, unjudged=unjudged, notes=notes)


def _spec(options: PeerOptions, checkpoint: Path) -> str:
    return "learned" if options.checkpoint is None else f"lerobot:{checkpoint}"


def _series(episodes: int) -> tuple[list[int], int]:
    """Group seeds of our episodes, and repeats of each."""
    groups, rest = divmod(episodes, PROTOCOL_REPEATS)
    return (list(range(groups)), PROTOCOL_REPEATS) if groups and not rest else ([0], episodes)


def _physics_seconds(options: PeerOptions, checkpoint: Path, episodes: int) -> float:
    """Time of the physics in the same episodes, all at once on CUDA, each tick's waited for [s]."""
    seeds, repeats = _series(episodes)
    policy = policies.get(_spec(options, checkpoint))
    side = RepeatedEpisodes(TASK, policy, repeats, seeds=seeds, worlds=episodes, cuda=True)
    with contextlib.closing(side):
        side.play(2)  # loads and captures
        parts, _ = side.parts(options.steps or None)
    return parts["physics"]


def _ours(options: PeerOptions, checkpoint: Path, episodes: int, cuda: bool, folder: Path) -> _Played:
    """Play them by `eval run`."""
    seeds, repeats = _series(episodes)
    spec = _spec(options, checkpoint)
    line = [sys.executable, "-P", "-m", "arena_newton.eval", "run", "--task", TASK, "--tracker", "twist2"]
    line += ["--policy", spec, "--seeds", *map(str, seeds), "--repeats", str(repeats), "--worlds", str(episodes)]
    line += ["--engine", "warp" if cuda else "mujoco", "--device", "cuda" if cuda else "cpu", "--out", str(folder)]
    if options.steps:
        line += ["--max-steps", str(options.steps)]
    seconds = _timed("eval run", line, (0, 1))
    records = load_run(folder).records
    if len(records) != episodes:
        raise ArenaError(f"eval run: {len(records)} episodes instead of {episodes}")
    # Of one machine and one batch: the clock of the records is the same.
    began, ended = ([datetime.fromisoformat(str(getattr(one, name))) for one in records] for name in CLOCK)
    played = (max(ended) - min(began)).total_seconds()
    return _Played(played, seconds, sum(one.outcome == "success" for one in records))


def _peer(options: PeerOptions, checkpoint: Path, episodes: int, cuda: bool, folder: Path) -> _Played:
    """Play them by `lerobot-eval`, which counts the seconds itself once its environment is built."""
    engine, device = ("warp", "cuda") if cuda else ("mujoco", "cpu")
    line = [sys.executable, "-P", "-m", "lerobot.scripts.lerobot_eval"]
    line += ["--env.discover_packages_path=arena_newton.eval.adapters.lerobot_env", "--env.type=arena_newton"]
    line += [f"--env.task={TASK}", "--env.tracker=twist2", f"--env.engine={engine}", f"--env.device={device}"]
    line += [f"--env.episodes={folder}", f"--policy.path={checkpoint}", f"--policy.device={device}", "--seed=0"]
    # One batch, as many worlds as on our side.
    line += [f"--eval.n_episodes={episodes}", f"--eval.batch_size={episodes}", f"--output_dir={folder / 'lerobot'}"]
    if options.steps:
        line += [f"--env.episode_length={options.steps}"]
    seconds = _timed("lerobot-eval", line, (0,))
    played = (folder / OUTCOMES_FILE).read_text().splitlines()
    if len(played) != episodes:
        raise ArenaError(f"lerobot-eval: {len(played)} episodes instead of {episodes}")
    info = json.loads((folder / "lerobot" / "eval_info.json").read_text())
    solved = sum(json.loads(one)["outcome"] == "success" for one in played)
    return _Played(float(info["overall"]["eval_s"]), seconds, solved)


def _timed(name: str, command: Sequence[str], allowed: Sequence[int]) -> float:
    """Seconds of a program from its start to its end."""
    began = time.perf_counter()
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment(), check=False
    )
    seconds = time.perf_counter() - began
    if done.returncode not in allowed:
        lines = [line.strip() for line in done.stdout.splitlines() if line.strip()]
        last = lines[-1][:300] if lines else "it printed nothing"
        raise ArenaError(f"{name} ended with code {done.returncode}: {last}")
    return seconds
