"""``peers --what tracker_training``: our training of a tracker beside mjlab's G1 tracking task, same walk."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
import tempfile
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from arena_newton.errors import ArenaError, InputError
from arena_newton.eval.bench.timing import BenchFigure, seconds_of
from arena_newton.trackers.motions.library import MotionLibrary
from arena_newton.trackers.motions.programs import random_clips
from benchmarks.bench_options import PeerOptions
from benchmarks.peer_pairs import Pair, on_cpu

__all__ = ["MjlabTraining", "OwnTraining", "tracker_training_figures"]

PAIR = Pair("tracker_training", 1.2, "samples/s", ("mujoco-warp", "newton", "rsl-rl-lib", "torch", "warp-lang"))
CUDA_WORLDS, CPU_WORLDS = (4096, 8192), (4,)
"""Worlds with CUDA and without, where the bar is not judged."""
WARM_UP = 3
"""Iterations of both before the first round, with CUDA: kernels, graphs, allocators."""
WALK_SECONDS = 10.0
"""Length of the walk that both track [s]."""
FPS = 50.0
"""Frames per second of our motions."""
SCRIPT = Path(__file__).with_name("mjlab_training.py")
"""Program that mjlab's interpreter runs."""
ANSWER_S = 900.0
"""Longest wait for an answer of mjlab [s]."""


class MjlabTraining:
    """mjlab's task in a process of its own interpreter; it waits between rounds."""

    def __init__(self, python: str, motion: Path, worlds: int, device: str, folder: Path):
        """Start it and wait until its task is built.

        Args:
            python: The interpreter.
            motion: NPZ with root_pos, root_quat, joint_pos and fps.
            device: cpu or cuda:0.
            folder: What it prints besides its answers is kept here until it ends.

        Raises:
            InputError: There is no such interpreter, or it lacks mjlab.
            ArenaError: It ended or did not answer.
        """
        found = shutil.which(python)
        if found is None:
            raise InputError(f"--mjlab-python {python}: is not a program")
        # Its own packages alone: ours have other versions. Nobody is asked for an account.
        hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
        environment = {name: value for name, value in os.environ.items() if name not in hidden}
        environment |= {"WANDB_MODE": "disabled", "HF_HUB_OFFLINE": "1"}
        self._log = folder / "mjlab.txt"
        with self._log.open("w") as errors:
            # -P: modules beside the script must not be taken for those that mjlab imports.
            self._process = subprocess.Popen(
                [found, "-P", str(SCRIPT), str(motion), str(worlds), device],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                text=True,
                env=environment,
                cwd=folder,
            )
        try:
            facts = self._answer()
        except BaseException:
            self.close()
            if "No module named 'mjlab'" in self._log.read_text(errors="replace"):
                raise InputError(f"--mjlab-python {python}: mjlab is not installed there (pip install mjlab)") from None
            raise
        self.versions: dict[str, str] = dict(facts["versions"])
        """Packages of its interpreter."""
        self.physics = str(facts["physics"])
        """Step and substeps of its control tick."""

    def speed(self, iterations: int) -> float:
        """Train on for so many iterations; samples per second.

        Raises:
            ArenaError: It ended or did not answer.
        """
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # the answer that is missing says why
            self._process.stdin.write(f"{iterations}\n")
            self._process.stdin.flush()
        answer = self._answer()
        return float(answer["samples"]) / float(answer["seconds"])

    def _answer(self) -> dict:
        """The next JSON line."""
        assert self._process.stdout is not None
        too_late = threading.Timer(ANSWER_S, self._process.kill)
        too_late.start()
        try:
            for line in self._process.stdout:
                with contextlib.suppress(json.JSONDecodeError):  # what a library printed
                    found = json.loads(line)
                    if isinstance(found, dict):
                        return found
        finally:
            too_late.cancel()
        self._process.wait()
        lines = [line.strip() for line in self._log.read_text(errors="replace").splitlines() if line.strip()]
        last = lines[-1][:300] if lines else "it printed nothing"
        raise ArenaError(f"mjlab ended with code {self._process.returncode}: {last}")

    def close(self) -> None:
        """End it."""
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.kill()
        self._process.wait()
        with contextlib.suppress(BrokenPipeError):
            self._process.stdin.close()
        self._process.stdout.close()


class OwnTraining:
    """Our training of TWIST2 with its default options, which writes nothing."""

    def __init__(self, library: Path, worlds: int, device: str):
        """Build it.

        Args:
            library: The motions, NPZ.
            device: cpu or cuda:0.
        """
        # Here, because the training's libraries are an extra.
        from arena_newton.trackers.train.session import build
        from arena_newton.trackers.train.train_options import TrainOptions

        self.options = TrainOptions(tracker="twist2", worlds=worlds, device=device, library=library, bench=True)
        with contextlib.redirect_stdout(io.StringIO()):
            self._runner = build(self.options)

    def speed(self, iterations: int) -> float:
        """Train on for so many iterations; samples per second."""
        with contextlib.redirect_stdout(io.StringIO()):  # its lines would be among the figures
            seconds = seconds_of(lambda: self._runner.learn(iterations))
        return iterations * self.options.worlds * self.options.steps / seconds


def tracker_training_figures(options: PeerOptions) -> Iterator[BenchFigure]:
    """Samples per second, rollout and update together, for each number of worlds."""
    cuda = torch.cuda.is_available()
    for worlds in options.training_worlds or (CUDA_WORLDS if cuda else CPU_WORLDS):
        label = f"tracker training, samples/s / mjlab's G1 tracking task, {worlds} worlds"
        if not options.mjlab_python:
            yield PAIR.missing(label, "not measured: name an interpreter that has mjlab by --mjlab-python")
            continue
        rounds, mjlab = _rounds(options, worlds, "cuda:0" if cuda else "cpu")
        text = ", ".join(f"{one} {version}" for one, version in mjlab.versions.items())
        notes = [f"peer: {text}, {mjlab.physics}"]
        yield PAIR.judge(options, label, rounds, unjudged=on_cpu(cuda), notes=notes, peer_versions=mjlab.versions)


def _rounds(options: PeerOptions, worlds: int, device: str) -> tuple[list[tuple[float, float]], MjlabTraining]:
    """Speeds of both, by turns."""
    assert options.mjlab_python is not None
    with tempfile.TemporaryDirectory() as made:
        folder = Path(made)
        walk = random_clips({"walk": 1}, seconds=WALK_SECONDS)
        library, motion = folder / "walk_library.npz", folder / "walk.npz"
        MotionLibrary.from_random(walk).save(library)
        names = ("root_pos", "root_quat", "joint_pos")
        np.savez(motion, fps=FPS, **{name: walk[name][0].numpy() for name in names})
        mjlab = MjlabTraining(options.mjlab_python, motion, worlds, device, folder)
        try:
            ours = OwnTraining(library, worlds, device)
            for side in (ours, mjlab):
                side.speed(1 if device == "cpu" else WARM_UP)
            iterations = options.iterations
            rounds = [(ours.speed(iterations), mjlab.speed(iterations)) for _ in range(options.long_rounds)]
        finally:
            mjlab.close()
    return rounds, mjlab
