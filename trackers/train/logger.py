"""The log of a training: printed lines, progress.jsonl and curves; its statistics are fetched once per iteration."""

from __future__ import annotations

import json
import statistics
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from rsl_rl.utils.logger import Logger

from arena_newton.trackers.train.train_options import TrainOptions

__all__ = ["DeviceLogger", "IterationTimes"]


@dataclass(frozen=True)
class IterationTimes:
    """Duration of the parts of one iteration."""

    collect: float
    """Rollout [s]."""
    learn: float
    """Update [s]."""
    samples: int
    """Samples of all processes."""


class DeviceLogger(Logger):
    """rsl_rl's log, fetched from the device once per iteration."""

    def __init__(self, options: TrainOptions, best_reward: float, **settings: Any):
        """Empty buffers; means are over ten iterations' episodes, `best_reward` per second is perfect tracking's."""
        super().__init__(**settings)
        self.options, self.best_reward = options, best_reward
        self.history: list[dict[str, float]] = []
        """Measurements of each iteration."""
        self.rewbuffer, self.lenbuffer = deque(maxlen=10), deque(maxlen=10)
        self._ended = torch.zeros(3, device=self.device)  # episodes, their rewards, their lengths
        self._written: float = 0

    @property
    def writes(self) -> bool:
        """True if this process writes files."""
        return self.log_dir is not None and not self.disable_logs

    def _store_code_state(self) -> list[str]:
        """Disabled: the card records the commit; local diffs are not copied."""
        return []

    def process_env_step(
        self, rewards: torch.Tensor, dones: torch.Tensor, extras: dict, intrinsic_rewards: torch.Tensor | None = None
    ) -> None:
        """Count one tick."""
        if self.disable_logs:
            return
        self.cur_reward_sum += rewards
        self.cur_episode_length += 1
        done = (dones > 0).float()
        lived, earned = self.cur_episode_length * done, self.cur_reward_sum * done
        self._ended += torch.stack((done.sum(), earned.sum(), lived.sum()))
        keep = 1.0 - done
        self.cur_reward_sum *= keep
        self.cur_episode_length *= keep

    def fetch(self) -> None:
        """Copy the episode statistics to the host; once per iteration."""
        count, reward, length = self._ended.tolist()
        self._ended.zero_()
        if count:
            self.rewbuffer.append(reward / count)
            self.lenbuffer.append(length / count)

    def record(
        self, progress: Mapping[str, float], times: IterationTimes, measured: Mapping[str, float], *, first: bool
    ) -> None:
        """Take an iteration into the history; print and write it where the intervals ask for it.

        Args:
            progress: `iteration`, `samples`, `seconds`, `learning_rate` and `std`.
            measured: Losses as `Loss/<name>` and the environment's means.
            first: Whether it is the first iteration of a call.
        """
        if self.disable_logs:
            return
        row = {
            "iteration": progress["iteration"],
            "samples": progress["samples"],
            "seconds": round(progress["seconds"], 2),
            "samples_per_s": round(times.samples / (times.collect + times.learn)),
            "collect_s": round(times.collect, 4),
            "learn_s": round(times.learn, 4),
            "learning_rate": progress["learning_rate"],
            "std": progress["std"],
            "episode_reward": statistics.mean(self.rewbuffer) if self.rewbuffer else 0.0,
            "episode_length": statistics.mean(self.lenbuffer) if self.lenbuffer else 0.0,
            **measured,
        }
        self.history.append(row)
        if first or row["iteration"] % self.options.print_interval == 0:
            self._print(row)
        if self.writer is not None and (first or row["iteration"] % self.options.log_interval == 0):
            self._write(row)

    def finish(self) -> None:
        """Write the last iteration where the interval left it out, and close the curves."""
        if self.history and self.history[-1]["iteration"] != self._written:
            self._write(self.history[-1])
        self.stop_logging_writer()

    def _print(self, row: Mapping[str, float]) -> None:
        print(
            f"it {row['iteration']:5d}  {row['samples'] / 1e6:8.2f}M  {row['seconds']:7.1f} s  "
            f"{row['samples_per_s']:7d}/s ({row['collect_s']:.3f}+{row['learn_s']:.3f})  "
            f"reward/s {row['Train/reward_per_s']:6.3f} of {self.best_reward:.2f}  "
            f"early end every {row['Train/seconds_between_ends']:.2f} s  "
            f"velocity error {row['Error/velocity_m_s']:.3f}  leg error {row['Error/legs_rad']:.3f}  "
            f"learning rate {row['learning_rate']:.1e}  kl {row['Loss/kl']:.4f}  std {row['std']:.2f}  "
            f"value loss {row['Loss/value']:.3f}",
            flush=True,
        )

    def _write(self, row: Mapping[str, float]) -> None:
        """Add an iteration to progress.jsonl and to the curves."""
        self._written = row["iteration"]
        with (Path(self.log_dir) / "progress.jsonl").open("a") as file:
            file.write(json.dumps(row) + "\n")
        for name, value in row.items():
            if name != "iteration":
                self.writer.add_scalar(name if "/" in name else f"Train/{name}", value, int(row["iteration"]))
