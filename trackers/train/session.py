"""One training from options to weights: references, environment, runner, export."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.util
import io
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from arena_newton.cli.flags import shell_command
from arena_newton.errors import InputError, naming
from arena_newton.physics.devices import torch_device
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.interface import get
from arena_newton.trackers.motions import programs
from arena_newton.trackers.motions.formats import read_library
from arena_newton.trackers.motions.library import MotionLibrary
from arena_newton.trackers.train.checkpoint import Card, Checkpoint
from arena_newton.trackers.train.export import export
from arena_newton.trackers.train.runner import TrackerRunner
from arena_newton.trackers.train.simulation import share_stream
from arena_newton.trackers.train.terms import events
from arena_newton.trackers.train.terms.rewards import configured, maximum
from arena_newton.trackers.train.tracker_env import TrackerEnv
from arena_newton.trackers.train.train_options import (
    CPU_WORLDS,
    FAMILY_WEIGHTS,
    GPU_WORLDS,
    ExportOptions,
    TrainOptions,
    check,
)

__all__ = ["build", "check_folder", "make_library", "train"]


def make_library(options: TrainOptions, device: str, seed: int) -> MotionLibrary:
    """References of a training: a library or generated ones, more files, mirror images.

    Raises:
        InputError: A file cannot be read, or a family is unknown.
    """
    if options.library is not None:
        with naming("--library"):
            parts = [MotionLibrary.load(options.library)]
    else:
        wanted: dict[str, Any] = {"families": options.families} if options.families else {}
        with naming("--families"):
            parts = [MotionLibrary.from_random(programs.random_clips(**wanted, seed=seed, device=device))]
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


def _family_weights(options: TrainOptions, library: MotionLibrary) -> dict[str, float]:
    """Sampling weights of families.

    Raises:
        InputError: The options name a family that the library lacks, or leave none to sample.
    """
    names = [str(name) for name in library.family_names]
    if unknown := sorted(set(options.family_weights) - set(names)):
        raise InputError(f"--family-weights {unknown[0]}: no such family in the library; there are {', '.join(names)}")
    weights = FAMILY_WEIGHTS | options.family_weights
    if not any(weights.get(name, 1.0) > 0.0 for name in names):
        raise InputError("--family-weights: every family of the library has weight 0")
    return weights


def _commit(given: str) -> str:
    if given:
        return given
    try:
        folder = Path(__file__).resolve().parent
        done = subprocess.run(["git", "rev-parse", "HEAD"], cwd=folder, capture_output=True, text=True, timeout=10)
        return done.stdout.strip()[:12] or "unknown"
    except (OSError, subprocess.SubprocessError):
        return "unknown"


def _card(options: TrainOptions, library: MotionLibrary, env: TrackerEnv, processes: int) -> Card:
    """Card of a training as known before it starts."""
    seconds = library.seconds
    families = {
        str(name): {
            "clips": int((library.family == i).sum()),
            "minutes": round(float(seconds[library.family == i].sum()) / 60.0, 2),
        }
        for i, name in enumerate(library.family_names)
    }
    sources = sorted({str(source) for source in library.source})
    return Card(
        tracker=options.tracker,
        command=shell_command("arena_newton.trackers.train", *sys.argv[1:]),
        commit=_commit(options.commit),
        processes=processes,
        worlds=options.worlds,
        seed=options.seed,
        data={"clips": library.clips, "families": families, "mirrored": options.mirror, "sources": sources[:64]},
        licences={str(n): int(c) for n, c in zip(*np.unique(library.licence, return_counts=True), strict=True)},
        action_form=dataclasses.asdict(env.front_end.action_form),
        drive=env.interface.drive.as_json(),
        physics=dataclasses.asdict(env.interface.rate),
        rewards={name: term.weight for name, term in env.rewards.items()},
        events={name: dict(event.settings) for name, event in env.events.items()},
    )


def check_folder(options: TrainOptions) -> None:
    """Make the log folder; refuse one that cannot be written or that contains another training.

    Raises:
        InputError: The folder does not fit this training.
    """
    folder = options.log_dir
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--log-dir {folder}: is a file")
    if options.resume is None or options.resume.resolve().parent != folder.resolve():
        used = [f for kind in ("model_*.pt", "progress.jsonl", "*.safetensors") for f in sorted(folder.glob(kind))]
        if used:
            raise InputError(
                f"--log-dir {folder}: already contains a training run ({used[0].name}): "
                "use --resume to continue it, or another folder"
            )
    try:
        folder.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(f"--log-dir {folder}: cannot be written ({error.strerror})") from None


def _checkpoint(options: TrainOptions) -> tuple[Checkpoint | None, str]:
    """The checkpoint that a training continues, if any, and the action form: the checkpoint's, if there is one.

    Raises:
        InputError: The file to begin with is unfit, or of another tracker or form than asked for.
    """
    if options.start_from is not None:
        weights_file.load(options.start_from, options.tracker, flag="--start-from")
    if options.resume is None:
        return None, options.action_form
    with naming("--resume"):
        checkpoint = Checkpoint.read(options.resume)
        kind = str(checkpoint.card.action_form["kind"])
        asked = kind if options.action_form == "auto" else options.action_form
        checkpoint.check_same(options.tracker, asked, options.resume)
    return checkpoint, kind


def _with_worlds(options: TrainOptions) -> TrainOptions:
    """Options that name a number of worlds."""
    usual = CPU_WORLDS if torch_device(options.device).type == "cpu" else GPU_WORLDS
    return options if options.worlds else dataclasses.replace(options, worlds=usual)


def build(options: TrainOptions) -> TrackerRunner:
    """Make references, environment and runner; resume if asked to.

    Raises:
        InputError: An option does not fit.
    """
    check(options)
    options = _with_worlds(options)
    if options.logger == "wandb" and importlib.util.find_spec("wandb") is None:
        raise InputError("--logger wandb: the package wandb is not installed")
    rewards = configured(options.rewards, options.reward_scales)
    randomisation = events.configured(options.events)
    with naming("--tracker"):
        interface = get(options.tracker)
    device = str(torch_device(options.device))
    checkpoint, kind = _checkpoint(options)
    form = interface.action_form(kind)
    if not options.bench:
        check_folder(options)
    rank, processes = int(os.environ.get("RANK", "0")), int(os.environ.get("WORLD_SIZE", "1"))
    share_stream(device)
    torch.set_float32_matmul_precision("high")
    torch.manual_seed(options.seed + rank)
    began = time.monotonic()
    if rank == 0:
        source = "generating references" if options.library is None else f"reading {options.library}"
        print(f"{source}, then building {options.worlds} worlds on {device} ...", flush=True)
    library = make_library(options, device, options.seed + 1000 * rank)
    generated = time.monotonic()
    weights = _family_weights(options, library)
    env = TrackerEnv(
        interface,
        form,
        library.to(device),
        options,
        device,
        rewards=rewards,
        randomisation=randomisation,
        family_weights=weights,
    )
    if rank == 0:
        print(
            f"{library.clips} clips, {library.seconds.sum() / 60.0:.1f} min of motion in {generated - began:.1f} s; "
            f"{options.worlds} worlds on {device} in {time.monotonic() - generated:.1f} s",
            flush=True,
        )
        if options.verbose:
            print(_tables(env), flush=True)
    return _runner(env, options, _card(options, library, env, processes), checkpoint)


def _runner(env: TrackerEnv, options: TrainOptions, card: Card, checkpoint: Checkpoint | None) -> TrackerRunner:
    """The runner, at the state from which it is to go on."""
    folder = None if options.bench else options.log_dir
    with contextlib.redirect_stdout(io.StringIO()):  # rsl_rl prints both networks layer by layer
        runner = TrackerRunner(env, options, env.interface.make_network().config(), card, folder)
    if checkpoint is not None:
        with naming("--resume"):
            runner.resume(checkpoint, str(options.resume))
    elif options.start_from is not None:
        runner.start_from(options.start_from)
    return runner


def _tables(env: TrackerEnv) -> str:
    """Reward terms, events and critic terms of a training, as text."""
    lines = [f"reward per second, at most {maximum(env.rewards):.2f}:"]
    for name, term in env.rewards.items():
        lines.append(f"  {name:20} weight {term.weight:<8g}" + (f" scale {term.scale:g}" if term.scale else ""))
    lines.append("randomisation:" if env.events else "no randomisation")
    for name, event in env.events.items():
        lines.append(f"  {name:20} " + " ".join(f"{key} {value:g}" for key, value in event.settings.items()))
    lines.append(f"observation of the critic, {sum(env.critic_widths.values())} numbers:")
    return "\n".join(lines + [f"  {name:20} {width}" for name, width in env.critic_widths.items()])


def train(options: TrainOptions) -> TrackerRunner:
    """Train to the end of the limits."""
    options = _with_worlds(options)
    runner = build(options)
    runner.learn(options.iterations, minutes=options.minutes or (1.0 if options.bench else 0.0))
    if runner.is_distributed:
        torch.distributed.destroy_process_group()
    if runner.logger.disable_logs:
        return runner
    if options.bench:
        print(_bench_line(runner, options))
    else:
        out = options.log_dir / f"{options.tracker}.safetensors"
        export(options.log_dir / "model_last.pt", ExportOptions(out))
        print(f"wrote {out} and its card")
    return runner


def _bench_line(runner: TrackerRunner, options: TrainOptions) -> str:
    """Speed of a training, and the time of the physics in a tick."""
    # The first iterations warm up allocators and libraries.
    rows = runner.history[3:] or runner.history
    collect, learn = (statistics.mean(row[name] for row in rows) for name in ("collect_s", "learn_s"))
    rate = options.worlds * options.steps * runner.gpu_world_size / max(collect + learn, 1e-9)
    on_cuda = runner.device != "cpu"
    ticks, wait = (50, torch.cuda.synchronize) if on_cuda else (5, lambda: None)
    wait()
    began = time.perf_counter()
    for _ in range(ticks):
        runner.env.sim.step()
    wait()
    physics = (time.perf_counter() - began) / ticks
    return (
        f"bench: {rate:.0f} samples/s, iteration {1e3 * (collect + learn):.1f} ms "
        f"(collect {1e3 * collect:.1f}, update {1e3 * learn:.1f}), tick {1e3 * collect / options.steps:.2f} ms "
        f"(physics {1e3 * physics:.2f}), {options.worlds} worlds x {options.steps} ticks, {options.tracker}"
    )
