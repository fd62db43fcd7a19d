"""One training from options to checkpoint: references, environment, runner."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import io
import math
import os
import shlex
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.errors import InputError, naming
from arena_newton.trackers.train.options import FAMILY_WEIGHTS, TrainOptions, runner_config

if TYPE_CHECKING:
    from arena_newton.robot import DriveGains, PhysicsRate
    from arena_newton.trackers.front_end import FrontEnd
    from arena_newton.trackers.motions.library import MotionLibrary
    from arena_newton.trackers.train.runner import TrackerRunner

__all__ = ["build", "front_end", "make_library", "train"]


def front_end(tracker: str, action_form: str = "auto") -> tuple[FrontEnd, DriveGains, PhysicsRate]:
    """Front end, drive and physics rate of an interface.

    Args:
        tracker: `twist2` or `sonic`.
        action_form: `auto`, `residual` or `default`.

    Raises:
        InputError: Another interface or form.
    """
    from arena_newton.trackers.interface import get

    kind = get(tracker)
    return kind.front_end(kind.action_form(action_form)), kind.drive, kind.rate


def make_library(options: TrainOptions, device: str, seed: int) -> MotionLibrary:
    """References of a training: a library or generated ones, more files, mirror images.

    Raises:
        InputError: A file cannot be read, or a family is unknown.
    """
    from arena_newton.trackers.motions.formats import read_library
    from arena_newton.trackers.motions.library import MotionLibrary

    if options.resume is not None and options.start_from is not None:
        raise InputError("--resume goes on with a training, --start-from begins one: pass one of the two")
    if options.library is not None and options.families:
        raise InputError("--families makes references, --library reads them: pass one of the two")
    parts = []
    if options.library is not None:
        with naming("--library"):
            parts.append(MotionLibrary.load(options.library))
    else:
        from arena_newton.trackers.motions import programs

        wanted: dict[str, Any] = {"families": options.families} if options.families else {}
        with naming("--families"):
            parts.append(MotionLibrary.from_random(programs.random_clips(**wanted, seed=seed, device=device)))
    if options.clips:
        with naming("--clips"):
            more, reports = read_library(
                options.clips, family="clips", licence=options.clips_licence, source=options.clips_source
            )
        for report in reports:
            print(report.line())
        parts.append(more)
    library = MotionLibrary.concatenate(parts) if len(parts) > 1 else parts[0]
    return MotionLibrary.concatenate([library, library.mirrored()]) if options.mirror else library


def _commit(given: str) -> str:
    if given:
        return given
    try:
        folder = Path(__file__).resolve().parent
        done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, timeout=10)
        return done.stdout.strip()[:12] or "unknown"
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def _card(options: TrainOptions, library: MotionLibrary, processes: int) -> dict[str, Any]:
    """What a training can say about itself before it starts."""
    seconds = library.seconds
    families = {
        str(name): {
            "clips": int((library.family == i).sum()),
            "minutes": round(float(seconds[library.family == i].sum()) / 60.0, 2),
        }
        for i, name in enumerate(library.family_names)
    }
    licences = {str(n): int(c) for n, c in zip(*np.unique(library.licence, return_counts=True), strict=True)}
    sources = sorted({str(s) for s in library.source})
    return {
        "tracker": options.tracker,
        "command": "python -m arena_newton.trackers.train " + shlex.join(sys.argv[1:]),
        "commit": _commit(options.commit),
        "processes": processes,
        "worlds": options.worlds,
        "seed": options.seed,
        "data": {"clips": library.clips, "families": families, "mirrored": options.mirror, "sources": sources[:64]},
        "licences": licences,
    }


def check(options: TrainOptions) -> None:
    """Refuse numbers that no training can use, before anything is made.

    Raises:
        InputError: A flag's number is out of range.
    """
    bounds: tuple[tuple[str, float, float, float], ...] = (
        ("--worlds", options.worlds, 1, math.inf),
        ("--minutes", options.minutes, 0, math.inf),
        ("--iterations", options.iterations, 1, math.inf),
        ("--adaptive", options.adaptive, 0, 1),
        ("--episode-s", options.episode_s, 0.1, 3600),
        ("--seed", options.seed, 0, 2**31),
        ("--steps", options.steps, 2, math.inf),
        ("--epochs", options.epochs, 1, math.inf),
        ("--minibatches", options.minibatches, 1, options.worlds * options.steps),
        ("--learning-rate", options.learning_rate, 1e-8, 1),
        ("--desired-kl", options.desired_kl, 1e-6, 10),
        ("--entropy", options.entropy, 0, math.inf),
        ("--settle", options.settle, 0, 1),
        ("--init-std", options.init_std, 1e-3, 10),
        ("--mirror-loss", options.mirror_loss, 0, math.inf),
        ("--save-interval", options.save_interval, 1, math.inf),
        ("--keep-last", options.keep_last, 0, math.inf),
        ("--keep-every", options.keep_every, 0, math.inf),
        ("--print-interval", options.print_interval, 1, math.inf),
        ("--log-interval", options.log_interval, 1, math.inf),
        ("--contacts-per-world", options.contacts_per_world, 1, math.inf),
        ("--constraints-per-world", options.constraints_per_world, 1, math.inf),
        *((f"--families {name}", count, 1, math.inf) for name, count in options.families.items()),
        *((f"--family-weights {name}", w, 0, math.inf) for name, w in options.family_weights.items()),
        *((f"--rewards {name}", w, -1e6, 1e6) for name, w in options.rewards.items()),
    )
    for flag, value, low, high in bounds:
        if not (low <= value <= high and math.isfinite(value)):
            until = f"from {low:g} to {high:g}" if math.isfinite(high) else f"of at least {low:g}"
            raise InputError(f"{flag} {value}: expected a number {until}")
    if options.settle > 0.0 and options.minutes <= 0.0:
        raise InputError(f"--settle {options.settle}: a share of --minutes, which is not given")
    for flag, file in (("--resume", options.resume), ("--start-from", options.start_from)):
        if file is not None and not file.is_file():
            raise InputError(f"{flag} {file}: {'is a folder, expected a file' if file.is_dir() else 'no such file'}")


def check_folder(options: TrainOptions) -> None:
    """Make the log folder; refuse one that cannot be written, or whose files are another training's.

    Raises:
        InputError: The folder is no place for this training.
    """
    folder = options.log_dir
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--log-dir {folder}: is a file")
    if options.resume is None or options.resume.resolve().parent != folder.resolve():
        used = [f for kind in ("model_*.pt", "progress.jsonl", "*.safetensors") for f in sorted(folder.glob(kind))]
        if used:
            raise InputError(
                f"--log-dir {folder}: holds {used[0].name}; --resume a checkpoint of that training, or name another"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except OSError as error:
        raise InputError(f"--log-dir {folder}: cannot be written ({error.strerror})") from None


def _checkpoint(options: TrainOptions) -> tuple[dict[str, Any] | None, str]:
    """The checkpoint that a training goes on with, if any, and the action form: the checkpoint's, if there is one.

    Raises:
        InputError: The file to begin with is unfit, or of another tracker or form than asked for.
    """
    from arena_newton.trackers.inference import weights_file
    from arena_newton.trackers.train.runner import check_same, read_checkpoint

    if options.start_from is not None:
        weights_file.load(options.start_from, options.tracker, flag="--start-from")
    if options.resume is None:
        return None, options.action_form
    with naming("--resume"):
        state = read_checkpoint(options.resume)
        kind = str(state["card"]["action_form"]["kind"])
        asked = kind if options.action_form == "auto" else options.action_form
        check_same(state["card"], options.tracker, asked, options.resume)
    return state, kind


def _device(name: str) -> str:
    import torch

    if name != "cpu" and "LOCAL_RANK" in os.environ and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        name = f"cuda:{os.environ['LOCAL_RANK']}"
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name != "cpu" and not (name.startswith("cuda") and torch.cuda.is_available()):
        raise InputError(f"--device {name}: no such device here")
    return "cuda:0" if name == "cuda" else name


def build(options: TrainOptions) -> TrackerRunner:
    """Make references, environment and runner; resume if asked to.

    Raises:
        InputError: An option does not fit.
    """
    check(options)
    import torch

    from arena_newton.trackers.interface import get
    from arena_newton.trackers.train.rewards import REWARDS
    from arena_newton.trackers.train.runner import TrackerRunner
    from arena_newton.trackers.train.simulation import share_stream
    from arena_newton.trackers.train.tracker_env import EnvConfig, TrackerEnv

    if options.logger == "wandb" and importlib.util.find_spec("wandb") is None:
        raise InputError("--logger wandb: the package wandb is not installed")
    unknown = sorted(set(options.rewards) - set(REWARDS))
    if unknown:
        raise InputError(f"--rewards {unknown[0]}: no such term; known are {', '.join(REWARDS)}")
    device = _device(options.device)
    state, form = _checkpoint(options)
    if not options.bench:
        check_folder(options)
    rank, processes = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    share_stream(device)
    torch.set_float32_matmul_precision("high")
    torch.manual_seed(options.seed + rank)
    began = time.monotonic()
    library = make_library(options, device, options.seed + 1000 * rank)
    told = time.monotonic()
    weights = FAMILY_WEIGHTS | options.family_weights
    unknown = sorted(set(options.family_weights) - {str(name) for name in library.family_names})
    if unknown:
        known = ", ".join(str(name) for name in library.family_names)
        raise InputError(f"--family-weights {unknown[0]}: no such family in the library; there are {known}")
    if not any(weights.get(str(name), 1.0) > 0.0 for name in library.family_names):
        raise InputError("--family-weights: every family of the library has weight 0")
    front, drive, rate = front_end(options.tracker, form)
    rewards = {n: dataclasses.replace(t, weight=options.rewards.get(n, t.weight)) for n, t in REWARDS.items()}
    env = TrackerEnv(
        front,
        drive,
        rate,
        library.to(device),
        EnvConfig.of(options),
        device,
        rewards=rewards,
        family_weights=weights,
    )
    if rank == 0:
        print(
            f"{library.clips} clips, {library.seconds.sum() / 60.0:.1f} min of motion in {told - began:.1f} s; "
            f"{options.worlds} worlds on {device} in {time.monotonic() - told:.1f} s",
            flush=True,
        )
    card = _card(options, library, processes) | {
        "action_form": dataclasses.asdict(front.action_form),
        "drive": dataclasses.asdict(drive),
        "physics": dataclasses.asdict(rate),
        "rewards": {n: t.weight for n, t in rewards.items()},
    }
    config = runner_config(options, get(options.tracker).make_network().config(), card)
    log_dir = None if options.bench else str(options.log_dir)
    with contextlib.redirect_stdout(io.StringIO()):  # rsl-rl prints both networks layer by layer
        runner = TrackerRunner(env, config, log_dir, device)
    if state is not None:
        with naming("--resume"):
            runner.take_up(state, str(options.resume))
    elif options.start_from is not None:
        runner.start_from(options.start_from)
    return runner


def train(options: TrainOptions) -> TrackerRunner:
    """Train to the end of the limits."""
    runner = build(options)
    minutes = options.minutes or (1.0 if options.bench else 0.0)
    runner.learn(options.iterations, minutes=minutes)
    if runner.is_distributed:
        import torch

        torch.distributed.destroy_process_group()
    if not options.bench and not runner.logger.disable_logs:
        from arena_newton.trackers.train.export import ExportOptions, export

        out = options.log_dir / f"{options.tracker}.safetensors"
        export(options.log_dir / "model_last.pt", ExportOptions(out))
        print(f"wrote {out} and its card")
    if options.bench and not runner.logger.disable_logs:
        print(_bench_line(runner, options))
    return runner


def _bench_line(runner: TrackerRunner, options: TrainOptions) -> str:
    """What a training has shown of its speed, and the share of the physics in a tick."""
    import torch

    # The first iterations warm up allocators and libraries.
    rows = runner.history[3:] or runner.history
    total = sum(r["samples"] for r in rows[-1:]) - (rows[0]["samples"] if len(rows) > 1 else 0)
    spent = rows[-1]["seconds"] - (rows[0]["seconds"] if len(rows) > 1 else 0.0)
    collect = sum(r["collect_s"] for r in rows) / len(rows)
    learn = sum(r["learn_s"] for r in rows) / len(rows)
    ticks = 50 if runner.device != "cpu" else 5
    wait = (lambda: torch.cuda.synchronize(runner.device)) if runner.device != "cpu" else (lambda: None)
    wait()
    began = time.perf_counter()
    for _ in range(ticks):
        runner.env.sim.step()
    wait()
    physics = (time.perf_counter() - began) / ticks
    return (
        f"bench: {total / max(spent, 1e-9):.0f} samples/s, iteration {1e3 * (collect + learn):.1f} ms "
        f"(collect {1e3 * collect:.1f}, update {1e3 * learn:.1f}), tick {1e3 * collect / options.steps:.2f} ms "
        f"(physics {1e3 * physics:.2f}), {options.worlds} worlds x {options.steps} ticks, {options.tracker}"
    )
