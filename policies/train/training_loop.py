"""The loop of a training: steps, log, checkpoints, the end of the time, and signals."""

from __future__ import annotations

import contextlib
import dataclasses
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from lerobot.utils.constants import CHECKPOINTS_DIR, PRETRAINED_MODEL_DIR

from arena_newton.errors import ArenaError, InputError
from arena_newton.files.new_folder import held_folder
from arena_newton.files.text import counted
from arena_newton.policies.lerobot.checkpoint_facts import CheckpointFacts
from arena_newton.policies.train.policy_options import PolicyTrainOptions
from arena_newton.policies.train.policy_trainer import PolicyTrainer
from arena_newton.policies.train.stored_flags import plain_options
from arena_newton.policies.train.training_log import TrainingLog
from arena_newton.policies.train.training_state import (
    TrainingProgress,
    check_new,
    checkpoint_name,
    remove_older,
    write_checkpoint,
)

__all__ = ["Processes", "TrainingLoop"]

MEASURED_STEPS = 100
"""Steps whose time decides how many fit into --minutes."""
SKIPPED_STEPS = 10
"""First steps, which are not measured: a graph is captured, memory is taken."""
MEASURED_FRACTION = 0.1
"""Most of --minutes that the measurement takes, where steps are slow."""
MEASUREMENTS = 10
"""The speed is measured again after such a part of the steps that are left."""
LARGEST_CHANGE = 0.1
"""Largest change of the number of steps that leaves the schedule as it was."""
TIME_KEPT = 0.98
"""Fraction of the time left that steps are planned for; the rest is for checkpoints and held-out losses."""
STOP_STEPS = 20
"""Steps between exchanges, among several processes, of whether one was asked to stop."""


@dataclass(frozen=True)
class Processes:
    """This process among those of `torchrun`."""

    rank: int = 0
    count: int = 1

    @property
    def first(self) -> bool:
        """True if it writes files and speaks."""
        return self.rank == 0


class TrainingLoop:
    """The loop of a training: steps, log, checkpoints, the end of the time."""

    def __init__(
        self,
        options: PolicyTrainOptions,
        out: Path,
        trainer: PolicyTrainer,
        facts: CheckpointFacts,
        processes: Processes,
        progress: TrainingProgress | None,
    ):
        """Prepare the loop; nothing is written yet.

        Args:
            trainer: At the step from which it goes on.
            facts: What checkpoints say, but for steps and time.
            processes: This process and the others.
            progress: Of the checkpoint with which it goes on; None for a new training.
        """
        self._options, self._out, self._trainer = options, out, trainer
        self._facts, self._processes = facts, processes
        self._before = progress.minutes if progress is not None else 0.0
        self._new = progress is None
        self._total = trainer.recipe.steps
        if options.minutes and not options.steps and not (progress is not None and progress.steps):
            self._total = 0  # until the speed is measured
        self._started = 0.0
        self._stopped = False
        self._measured_from: tuple[int, float] | None = None
        self._last: Path | None = None
        self._last_row: dict[str, float] = {}

    @property
    def minutes(self) -> float:
        """Time of the optimization so far [min]."""
        return self._before + (time.monotonic() - self._started) / 60.0

    def work(self) -> Path:
        """Take all steps; returns the folder of the last checkpoint.

        Raises:
            InputError: The folder cannot be made, another process trains in it, or the log cannot be written.
            ArenaError: The loss is not finite.
        """
        with held_folder(self._out, "trains in it") if self._processes.first else contextlib.nullcontext():
            if self._processes.first and self._new:
                check_new(self._out)  # another one may have come and gone while this one decoded
            try:
                return self._work()
            except OSError as error:  # of the log; checkpoints say it themselves
                raise InputError(f"--out {self._out}: cannot be written ({error.strerror or error})") from error

    def _work(self) -> Path:
        options, trainer, first = self._options, self._trainer, self._processes.first
        if first:
            remove_older(self._out, 0)
        pairs = tuple(trainer.drawn)
        log = TrainingLog(self._out, step=trainer.step, quiet=options.quiet, pairs=pairs) if first else None
        begin, said = trainer.step, ""
        self._started = time.monotonic()
        try:
            with _stopping(self._stop):
                row_at = (trainer.step, self._started)
                while not self._total or trainer.step < self._total:
                    trainer.advance()
                    if trainer.compiler_fault != said:
                        said = trainer.compiler_fault
                        print(said, file=sys.stderr, flush=True)
                    self._fit_to_time(begin)
                    done = bool(self._total) and trainer.step >= self._total
                    if log is not None:
                        log.advance(trainer.step, self._total)
                    held = trainer.step % options.hold_out_every == 0 or done
                    if trainer.step % options.log_every == 0 or done or (held and len(trainer.held)):
                        row_at = self._log(log, row_at, held)
                    if self._asked_to_stop():
                        break
                    if not done and options.save_every and trainer.step % options.save_every == 0:
                        self._save()
                last = self._save()
        finally:
            if log is not None:
                log.close()
        if self._stopped:
            if first:
                print(
                    f"stopped after {counted(trainer.step, 'step')}; go on with: python -m arena_newton.policies.train "
                    f"--resume {self._out}",
                    flush=True,
                )
            raise KeyboardInterrupt
        if first and not options.quiet:
            for line in self._pair_lines():
                print(line)
            print(f"{counted(trainer.step, 'step')} in {self.minutes:.1f} min; wrote {last / PRETRAINED_MODEL_DIR}")
        return last

    def _stop(self) -> None:
        self._stopped = True

    def _asked_to_stop(self) -> bool:
        """True if a signal came, to any of the processes."""
        if self._processes.count == 1:
            return self._stopped
        if self._trainer.step % STOP_STEPS:
            return False
        flag = torch.tensor(float(self._stopped), device=self._trainer.device)
        torch.distributed.all_reduce(flag)
        self._stopped = bool(flag)
        return self._stopped

    def _fit_to_time(self, begin: int) -> None:
        """Fix the number of steps once their speed is known, anew where other programs change it in the first half."""
        trainer, budget = self._trainer, self._options.minutes
        if not budget or (self._total and trainer.step > self._total / 2):
            return
        if self._measured_from is None:
            taken = trainer.step - begin
            if self._total or taken >= SKIPPED_STEPS or self.minutes - self._before > MEASURED_FRACTION / 2 * budget:
                _wait(trainer.device)
                self._measured_from = trainer.step, time.monotonic()
            return
        since, at = self._measured_from
        count = trainer.step - since
        if count < max(MEASURED_STEPS, (self._total - since) // MEASUREMENTS) and (
            self._total or self.minutes - self._before < MEASURED_FRACTION * budget
        ):
            return
        _wait(trainer.device)
        now = time.monotonic()
        left = max(0.0, budget - self.minutes) * 60.0 * TIME_KEPT
        steps = trainer.step + int(left * count / max(now - at, 1e-9))
        if self._processes.count > 1:
            agreed = torch.tensor(float(steps), dtype=torch.float64, device=trainer.device)
            torch.distributed.broadcast(agreed, 0)
            steps = int(agreed)
        if abs(steps - self._total) > LARGEST_CHANGE * self._total:
            self._total = max(steps, trainer.step)
            trainer.fix_steps(self._total)
        self._measured_from = trainer.step, now

    def _log(self, log: TrainingLog | None, row_at: tuple[int, float], held: bool) -> tuple[int, float]:
        """Write a row; returns step and time from which the next one's speed counts."""
        trainer = self._trainer
        loss = float(trainer.loss)  # waits for the device
        now = time.monotonic()
        if not math.isfinite(loss):
            raise ArenaError(
                f"the loss is {loss} at step {trainer.step}; the last checkpoint is {self._last or 'none'}: a smaller "
                "--lr, or another --recipe"
            )
        if log is None:
            return trainer.step, now
        row = {
            "step": float(trainer.step),
            "minutes": self.minutes,
            "loss": loss,
            "learning_rate": trainer.recipe.lr * trainer.recipe.lr_factor(max(0, trainer.step - 1)),
            "gradient_norm": float(trainer.gradient_norm),
            "steps_per_s": (trainer.step - row_at[0]) / max(now - row_at[1], 1e-9),
        }
        row |= {f"loss_{pair}": value for pair, value in trainer.pair_losses().items()}
        if held and len(trainer.held):
            row["held_out_loss"], of_pairs = trainer.held_out_losses()
            row |= {f"held_out_loss_{pair}": value for pair, value in of_pairs.items()}
        log.record(row)
        self._last_row = row
        return trainer.step, time.monotonic()

    def _pair_lines(self) -> list[str]:
        """Each pair of task and tracker: its fraction of the samples, and its losses in the last row of the log."""
        drawn, row = self._trainer.drawn, self._last_row
        total, lines = max(1, sum(drawn.values())), []
        for pair, count in drawn.items():
            losses = [
                f"{words} {row[name]:.4f}"
                for words, name in (("loss", f"loss_{pair}"), ("held out", f"held_out_loss_{pair}"))
                if name in row
            ]
            lines.append(", ".join([f"{pair}: {100 * count / total:.1f} % of the samples", *losses]))
        return lines

    def _save(self) -> Path:
        """Write a checkpoint of this step; only the first process does, once all hold the same."""
        trainer, options = self._trainer, self._options
        trainer.check_agreement()
        progress = TrainingProgress(
            step=trainer.step,
            steps=self._total,
            minutes=self.minutes,
            processes=self._processes.count,
            batch_size=trainer.recipe.batch_size,
            options=plain_options(options),
            datasets=self._facts.datasets,
        )
        facts = dataclasses.replace(self._facts, steps=trainer.step, minutes=round(self.minutes, 3))
        if self._processes.first:
            self._last = write_checkpoint(self._out, trainer, facts, progress)
            remove_older(self._out, options.keep)
        return self._last or self._out / CHECKPOINTS_DIR / checkpoint_name(trainer.step)


def _wait(device: torch.device) -> None:
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextlib.contextmanager
def _stopping(stop: Callable[[], None]) -> Iterator[None]:
    """Ctrl-C and SIGTERM ask for the end after the current step; a second one comes through at once."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def asked(number: int, frame: object) -> None:
        stop()
        signal.signal(signal.SIGINT, signal.default_int_handler)  # whoever asks twice does not wait

    for number in before:
        signal.signal(number, asked)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
