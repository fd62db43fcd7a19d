"""Counters of a training: sums on the device, fetched once per iteration, and the guard against non-finite numbers."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from arena_newton.robot.g1 import TICK
from arena_newton.trackers.train.terms.measurement import TickMeasurement, TrainingError

__all__ = ["ERRORS", "Tally"]


def _rms(difference: torch.Tensor) -> torch.Tensor:
    return difference.square().mean(1).sqrt()


ERRORS: dict[str, Callable[[TickMeasurement], torch.Tensor]] = {
    "velocity_m_s": lambda m: m.velocity_error[:, :2].norm(dim=1),
    "legs_rad": lambda m: _rms((m.state.joint_pos - m.reference.joint_pos)[:, :12]),
    "arms_rad": lambda m: _rms((m.state.joint_pos - m.reference.joint_pos)[:, 15:]),
    "links_m": lambda m: (m.keys - m.reference.keys).norm(dim=2).mean(1),
    "height_m": lambda m: m.position_error[:, 2].abs(),
    "position_m": lambda m: m.position_error[:, :2].norm(dim=1),
    "heading_rad": lambda m: m.heading_error.abs(),
}
"""Tracking errors that are logged next to the rewards."""
_LARGEST_ERROR = 100.0
"""Largest error that counts: one exploding world must not hide the others."""


class Tally:
    """Sums over worlds and ticks since the last `collect`."""

    def __init__(self, rewards: Sequence[str], ends: Sequence[str], families: Sequence[str], device: str):
        """Name the sums."""
        self.rewards, self.ends, self.families = tuple(rewards), tuple(ends), tuple(families)
        sizes = {"reward": len(rewards), "ended": len(ends), "error": len(ERRORS)}
        sizes |= {"family_seconds": len(families), "family_falls": len(families)}
        sizes |= {"ticks": 1, "falls": 1, "overflow": 1}
        self._sums = {name: torch.zeros(size, device=device) for name, size in sizes.items()}
        self._guarded = [*(f"reward {n}" for n in rewards), "observation actor", "observation critic", "action"]
        self._bad_world = torch.full((len(self._guarded),), -1, dtype=torch.long, device=device)

    def add(
        self,
        motion: TickMeasurement,
        earned: torch.Tensor,
        ends: torch.Tensor,
        failed: torch.Tensor,
        family: torch.Tensor,
        overflow: torch.Tensor,
    ) -> None:
        """Count one tick of every world.

        Args:
            earned: Weighted reward of each term, shape [worlds, terms].
            ends: Which termination terms ended the episode, bool, shape [worlds, terms].
            failed: Whether the episode ended early, bool, shape [worlds].
            family: Family of the clip, shape [worlds].
            overflow: Non-zero where a contact buffer was full, shape [worlds].
        """
        sums = self._sums
        errors = torch.stack([error(motion) for error in ERRORS.values()], 1)
        sums["reward"].add_(earned.sum(0))
        sums["ended"].add_(ends.float().sum(0))
        sums["error"].add_(torch.where(motion.finite[:, None], errors, 0.0).clamp_max(_LARGEST_ERROR).sum(0))
        sums["family_seconds"].index_add_(0, family, torch.full_like(earned[:, 0], TICK))
        sums["family_falls"].index_add_(0, family, failed.float())
        sums["ticks"].add_(len(failed))
        sums["falls"].add_(failed.sum())
        sums["overflow"].add_((overflow != 0).sum())

    def guard(self, values: torch.Tensor, *others: torch.Tensor) -> None:
        """Remember a world for each guarded quantity that is not finite.

        These are the reward terms, then the observations of actor and critic and the action, each [worlds, n].
        """
        bad = torch.cat([~torch.isfinite(values), *(~torch.isfinite(v).all(1, keepdim=True) for v in others)], 1)
        self._bad_world.copy_(torch.where(bad.any(0), bad.int().argmax(0), self._bad_world))

    def clear(self) -> None:
        """Forget everything."""
        for sums in self._sums.values():
            sums.zero_()
        self._bad_world.fill_(-1)

    def collect(self) -> dict[str, float]:
        """Means by name; waits for the device, then clears the sums.

        Raises:
            TrainingError: A guarded quantity was not finite.
        """
        packed = torch.cat([*self._sums.values(), self._bad_world.float()]).tolist()
        self.clear()
        values: dict[str, list[float]] = {}
        for name, sums in self._sums.items():
            values[name], packed = packed[: sums.numel()], packed[sums.numel() :]
        for what, world in zip(self._guarded, packed, strict=True):
            if world >= 0:
                raise TrainingError(f"world {int(world)}: {what} is not finite")
        ticks = max(values["ticks"][0], 1.0)
        seconds = ticks * TICK
        out = {f"Reward/{n}": v / seconds for n, v in zip(self.rewards, values["reward"], strict=True)}
        out |= {f"Ends_per_s/{n}": v / seconds for n, v in zip(self.ends, values["ended"], strict=True)}
        out |= {f"Error/{n}": v / ticks for n, v in zip(ERRORS, values["error"], strict=True)}
        for name, lived, falls in zip(self.families, values["family_seconds"], values["family_falls"], strict=True):
            if lived > 0.0:
                out[f"Seconds_between_ends/{name}"] = lived / max(falls, 1.0)
        out["Train/reward_per_s"] = sum(values["reward"]) / seconds
        out["Train/seconds_between_ends"] = seconds / max(values["falls"][0], 1.0)
        out["Train/overflow_share"] = values["overflow"][0] / ticks
        return out
