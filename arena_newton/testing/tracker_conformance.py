"""Promises of `interfaces.Tracker`, tried on a tracker without any world, with made-up commands and states.

The input of a row follows from the row's own number and the tick alone, so that the same robot can be followed alone,
among others, and next to robots that wait.
"""

from __future__ import annotations

import copy
import functools
import inspect
import json
import math
from collections.abc import Callable, Iterable, Sequence

import numpy as np
import torch

from arena_newton.interfaces import NEEDS, RobotState, Tracker, TrackerCommand
from arena_newton.robot.canonical import MIMIC, MIMIC_WIDTH
from arena_newton.robot.g1 import DEFAULT_POSE, MUJOCO_JOINTS, SPAWN_HEIGHT, TICK, DriveGains, PhysicsRate
from arena_newton.testing.findings import CheckResult, ConformanceError, Promise, Violation, json_object, perform

__all__ = ["check_tracker"]

JOINTS = len(MUJOCO_JOINTS)
WORLDS = 3
"""Rows of a batch: one that is treated specially, with a neighbour on each side."""
ONLY = 1
"""The row that ticks, forgets or is prefilled while the others do not."""
TICKS = 6
"""Ticks of a comparison: past a first frame, and short enough for slow networks."""
EXTREME_TICKS = 20
"""Ticks under zero and extreme input: 0.4 s, in which an output that feeds itself grows."""
CUDA_TOLERANCE = 1e-3
"""Default of `check_tracker`'s tolerance on CUDA [rad]: its libraries choose other sums for other batches."""

Frame = tuple[TrackerCommand, RobotState]
RowMaker = Callable[[int, int], dict[str, np.ndarray]]


def _normalised(quat: np.ndarray) -> np.ndarray:
    unit: np.ndarray = quat / np.linalg.norm(quat, axis=-1, keepdims=True)
    return unit


@functools.lru_cache(maxsize=4096)
def _row(number: int, tick: int) -> dict[str, np.ndarray]:
    """A plausible command and state of one robot at one tick."""
    rng = np.random.default_rng([number, tick])
    pose = np.asarray(DEFAULT_POSE)
    joints = pose + 0.2 * rng.standard_normal(JOINTS)
    mimic = np.zeros(MIMIC_WIDTH)
    mimic[MIMIC["velocity_xy"]] = 0.3 * rng.standard_normal(2)
    mimic[MIMIC["root_z"]] = SPAWN_HEIGHT - 0.02
    mimic[MIMIC["roll_pitch"]] = 0.05 * rng.standard_normal(2)
    mimic[MIMIC["yaw_rate"]] = 0.3 * rng.standard_normal(1)
    mimic[MIMIC["joint_pos"]] = joints
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    return {
        "mimic": mimic,
        "joints": joints,
        "joint_vel": 0.5 * rng.standard_normal(JOINTS),
        "target_quat": _normalised(upright + 0.1 * rng.standard_normal(4)),
        "quat": _normalised(upright + 0.1 * rng.standard_normal(4)),
        "ang_vel": 0.5 * rng.standard_normal(3),
        "joint_pos": pose + 0.2 * rng.standard_normal(JOINTS),
        "measured_vel": rng.standard_normal(JOINTS),
        "position": rng.standard_normal(3),
        "lin_vel": 0.5 * rng.standard_normal(3),
        "foot_force": 200.0 * rng.random(2),
        "reference_position": rng.standard_normal(3),
    }


@functools.lru_cache(maxsize=4096)
def _zero_row(number: int, tick: int) -> dict[str, np.ndarray]:
    """Nothing but zeros; orientations, which have no zero, are the identity."""
    zeros = {key: np.zeros_like(value) for key, value in _row(number, tick).items()}
    zeros["target_quat"][0] = zeros["quat"][0] = 1.0
    return zeros


@functools.lru_cache(maxsize=4096)
def _extreme_row(number: int, tick: int) -> dict[str, np.ndarray]:
    """Far beyond what a robot does: joints at 3 rad, 100 rad/s, any orientation."""
    rng = np.random.default_rng([number, tick, 1])
    scales = {"mimic": 5.0, "joints": 3.0, "joint_vel": 100.0, "ang_vel": 50.0, "joint_pos": 3.0, "measured_vel": 100.0}
    scales |= {"position": 100.0, "lin_vel": 50.0, "foot_force": 5000.0, "reference_position": 100.0}
    row = {key: np.zeros_like(value) for key, value in _row(number, tick).items()}
    for key, scale in scales.items():
        row[key] = scale * rng.choice([-1.0, 1.0], row[key].shape)
    for key in ("target_quat", "quat"):
        row[key] = _normalised(rng.standard_normal(4))
    return row


class _Trial:
    """A tracker under test; each check begins with `begin`, so that none depends on the one before."""

    def __init__(self, tracker: Tracker, worlds: int, device: str, tolerance: float):
        self.tracker, self.device, self.tolerance = tracker, torch.device(device), tolerance
        self.rows = tuple(range(10, 10 + worlds))
        """Numbers of the robots."""
        self.takes_mask = "mask" in inspect.signature(tracker.step).parameters

    def checks(self) -> list[Promise]:
        """Every promise in order."""
        return [
            Promise("attributes", "name, drive and limits of the reference are sane", self.attributes),
            Promise("rate", f"physics step times substeps is one tick of {TICK:g} s", self.rate),
            Promise("targets", f"answers are float32 tensors [worlds, {JOINTS}] on the bound device", self.targets),
            Promise("finite", "targets are finite under zero and extreme commands", self.finite),
            Promise("deterministic", "the same commands after bind and reset give the same bits", self.deterministic),
            Promise("rows", "a world's targets do not depend on what the other worlds do", self.independent),
            Promise("batch", "a world's targets are the same alone and among others", self.batch),
            Promise("mask", "a tick of some worlds leaves the histories of the others alone", self.masks),
            Promise("reset", "reset forgets the past of its worlds and of no other", self.resets),
            Promise("prefill", "prefill fills the history of its worlds and of no other", self.prefills),
            Promise("inputs", "command, state and mask are not written to", self.inputs),
            Promise("buffers", "inputs are not kept: their buffers hold the next tick's numbers", self.buffers),
            Promise("describe", "describe() is a stable JSON object with the tracker's name", self.describe),
        ]

    def frame(self, tick: int, rows: Sequence[int] | None = None, kind: RowMaker = _row) -> Frame:
        """Command and state of a tick for the robots of `rows`, on the device."""
        numbers, needs = self.rows if rows is None else rows, getattr(self.tracker, "needs", ())

        def stacked(key: str, *ticks: int) -> torch.Tensor:
            values = np.stack([[kind(number, one)[key] for one in ticks or (tick,)] for number in numbers])
            return torch.tensor(values if ticks else values[:, 0], dtype=torch.float32, device=self.device)

        def command(*ticks: int) -> TrackerCommand:
            mimic, joints, vel, quat = (stacked(n, *ticks) for n in ("mimic", "joints", "joint_vel", "target_quat"))
            position = stacked("reference_position", *ticks) if "position" in needs else None
            return TrackerCommand(mimic, joints, vel, quat, position)

        now = command()
        state = RobotState(*(stacked(key) for key in ("quat", "ang_vel", "joint_pos", "measured_vel")))
        for name in NEEDS:
            setattr(state, name, stacked(name) if name in needs else None)
        if window := getattr(self.tracker, "lookahead", 0):
            now.ahead = command(*range(tick + 1, tick + 1 + window))
        return now, state

    def only(self, worlds: int | None = None) -> torch.Tensor:
        """The mask of the one world that is treated specially."""
        mask = torch.zeros(len(self.rows) if worlds is None else worlds, dtype=torch.bool, device=self.device)
        mask[min(ONLY, len(mask) - 1)] = True
        return mask

    def begin(self, worlds: int | None = None) -> None:
        """Bind and reset, as an environment does."""
        self.tracker.bind(len(self.rows) if worlds is None else worlds, self.device)
        self.tracker.reset()

    def step(self, frame: Frame, mask: torch.Tensor | None = None) -> torch.Tensor:
        """One tick as the environment makes it; returns a copy of the targets."""
        if mask is None or not self.takes_mask:
            return self.tracker.step(*frame).clone()
        return self.tracker.step(*frame, mask).clone()

    def play(self, ticks: Iterable[int], rows: Sequence[int] | None = None) -> torch.Tensor:
        """Targets of ticks of all worlds, shape [ticks, worlds, 29]."""
        return torch.stack([self.step(self.frame(tick, rows)) for tick in ticks])

    @staticmethod
    def same(found: torch.Tensor, expected: torch.Tensor, what: str, advice: str = "", tolerance: float = 0.0) -> None:
        """Compare targets [..., 29]; NaN is nowhere the same."""
        if torch.equal(found, expected):
            return
        off = (found - expected).abs().nan_to_num(nan=math.inf).max().item()
        if off > tolerance:
            raise Violation(f"{what}: targets differ by up to {off:.3g} rad{advice and '; ' + advice}")

    def attributes(self) -> None:
        tracker = self.tracker
        if not isinstance(tracker.name, str) or not tracker.name.strip():
            raise Violation(f"name is {tracker.name!r}, expected a text")
        for role in ("drive", "original_drive"):
            drive = getattr(tracker, role)
            if drive is None and role == "original_drive":
                continue
            if not isinstance(drive, DriveGains):
                raise Violation(f"{role} is a {type(drive).__name__}, expected DriveGains")
            for part, least in (("kp", 0.0), ("kd", 0.0), ("effort", 1e-9), ("armature", 0.0)):
                gains = getattr(drive, part)
                if part == "armature" and gains is None:
                    continue
                if len(gains) != JOINTS or not all(math.isfinite(gain) and gain >= least for gain in gains):
                    raise Violation(f"{role}.{part} must be {JOINTS} finite numbers of at least {least:g}: {gains}")
        turn = tracker.max_root_delta_deg
        if not (isinstance(turn, int | float) and math.isfinite(turn) and turn >= 0.0):
            raise Violation(f"max_root_delta_deg is {turn!r}, expected degrees per tick, 0 for no limit")
        window, unknown = getattr(tracker, "lookahead", 0), set(getattr(tracker, "needs", ())) - set(NEEDS)
        if unknown or not isinstance(window, int) or window < 0:
            wrong = f"needs holds {sorted(unknown)}, known are {NEEDS}" if unknown else f"lookahead is {window!r}"
            raise Violation(f"{wrong}; expected names of further fields, and a number of ticks")

    def rate(self) -> None:
        for fast in (False, True):
            rate = self.tracker.rate(fast=fast)
            if not isinstance(rate, PhysicsRate):
                raise Violation(f"rate(fast={fast}) is a {type(rate).__name__}, expected a PhysicsRate")
            if rate.substeps < 1 or abs(rate.dt * rate.substeps - TICK) > 1e-9:
                raise Violation(f"rate(fast={fast}) is {rate.dt:g} s x {rate.substeps}, which is no tick of {TICK:g} s")

    def targets(self) -> None:
        for worlds in (1, len(self.rows)):
            rows, mask = self.rows[:worlds], self.only(worlds)
            self.begin(worlds)
            self.answer(self.tracker.step(*self.frame(0, rows)), worlds, "after bind and reset")
            self.tracker.reset(mask)
            self.tracker.prefill(*self.frame(1, rows), mask)
            self.answer(self.tracker.step(*self.frame(1, rows)), worlds, "after a masked reset and prefill")
            if self.takes_mask:
                self.answer(self.tracker.step(*self.frame(2, rows), mask), worlds, "with a mask")
            self.tracker.reset()
            self.tracker.prefill(*self.frame(3, rows))
            self.answer(self.tracker.step(*self.frame(3, rows)), worlds, "after a prefill of all worlds")

    def answer(self, targets: object, worlds: int, when: str) -> None:
        """Check type, shape and device of one answer."""
        expected = f"expected a float32 tensor [{worlds}, {JOINTS}] on {self.device}"
        if not isinstance(targets, torch.Tensor):
            raise Violation(f"step {when} answers a {type(targets).__name__}, {expected}")
        if targets.shape != (worlds, JOINTS) or targets.dtype != torch.float32:
            raise Violation(f"step {when} answers {targets.dtype} {list(targets.shape)}, {expected}")
        if targets.device.type != self.device.type:
            raise Violation(f"step {when} answers on {targets.device}, {expected}")
        if targets.requires_grad:
            raise Violation(f"step {when} answers with a gradient, which grows with every tick: use torch.no_grad()")

    def finite(self) -> None:
        for kind, what in ((_zero_row, "zero"), (_extreme_row, "extreme")):
            self.begin()
            self.tracker.prefill(*self.frame(0, kind=kind))
            for tick in range(EXTREME_TICKS):
                if not self.step(self.frame(tick, kind=kind)).isfinite().all():
                    raise Violation(f"under {what} commands and states the targets of tick {tick} are not finite")

    def deterministic(self) -> None:
        self.begin()
        first = self.play(range(TICKS))
        self.begin()
        self.same(self.play(range(TICKS)), first, "the same ticks played twice", "no noise, no memory beyond reset")

    def independent(self) -> None:
        self.begin()
        expected = self.play(range(TICKS))[:, 0]
        self.begin()
        others = (self.rows[0], *(number + 100 for number in self.rows[1:]))
        self.same(self.play(range(TICKS), others)[:, 0], expected, "world 0 next to other worlds' other commands")

    def batch(self) -> str | None:
        self.begin()
        among = self.play(range(TICKS))[:, 0]
        self.begin(1)
        alone = self.play(range(TICKS), self.rows[:1])[:, 0]
        self.same(
            alone,
            among,
            f"world 0 alone and among {len(self.rows)}",
            "results would depend on --worlds; trackers.front_end.NetworkTracker computes rows apart",
            self.tolerance,
        )
        return f"the same alone and among others, within {self.tolerance:g} rad" if self.tolerance else None

    def masks(self) -> None:
        advice = "store histories of the masked rows alone" if self.takes_mask else "step takes no mask: take one"
        only = self.only()
        self.begin()
        expected = self.play(range(TICKS))
        self.begin()
        for extra in (100, 101, 102):
            self.step(self.frame(extra), only)
            self.same(self.step(self.frame(extra - 100))[~only], expected[extra - 100, ~only], "waiting worlds", advice)
        self.begin()
        every = torch.ones_like(only)
        for tick in range(TICKS):
            self.same(self.step(self.frame(tick), every), expected[tick], "a mask of all worlds and no mask")
        if self.takes_mask:
            self.begin()
            for tick in range(TICKS):
                ticked = self.step(self.frame(tick), only)[only]
                self.same(ticked, expected[tick, only], "a world that ticks while others wait")

    def resets(self) -> None:
        only, again = self.only(), range(50, 50 + TICKS)
        self.begin()
        new = self.play(again)
        self.begin()
        self.play(range(TICKS))
        old = self.play(again)
        self.begin()
        self.play(range(TICKS))
        self.tracker.reset(only)
        found = self.play(again)
        self.same(found[:, only], new[:, only], "a world that was reset and a new one", "reset must forget everything")
        self.same(found[:, ~only], old[:, ~only], "worlds next to one that was reset", "reset must keep to its mask")
        self.tracker.reset()
        self.same(self.play(again), new, "all worlds after a reset without a mask and new ones")

    def prefills(self) -> None:
        only, again = self.only(), range(50, 50 + TICKS)
        self.begin()
        self.tracker.prefill(*self.frame(50))
        filled = self.play(again)
        self.begin()
        self.play(range(TICKS))
        old = self.play(again)
        self.begin()
        self.play(range(TICKS))
        self.tracker.reset(only)
        self.tracker.prefill(*self.frame(50), only)
        found = self.play(again)
        self.same(found[:, only], filled[:, only], "a world prefilled alone and with all others")
        self.same(found[:, ~only], old[:, ~only], "worlds next to one that was prefilled", "prefill must keep its mask")

    def inputs(self) -> None:
        self.begin()
        only = self.only()
        frame, mask = self.frame(0), only.clone()
        kept = copy.deepcopy(frame)
        for what in ("prefill", "step", "step with a mask", "reset"):
            if what == "prefill":
                self.tracker.prefill(*frame, mask)
            elif what == "reset":
                self.tracker.reset(mask)
            else:
                self.step(frame, mask if what != "step" else None)
            for part, before in zip(frame, kept, strict=True):
                kept_tensors = before.tensors()
                for field, value in part.tensors().items():
                    if not torch.equal(value, kept_tensors[field]):
                        raise Violation(f"{what} writes into {type(part).__name__}.{field}")
            if not torch.equal(mask, only):
                raise Violation(f"{what} writes into its mask")

    def buffers(self) -> None:
        self.begin()
        expected = self.play(range(TICKS))
        self.begin()
        held = self.frame(0)
        for tick in range(TICKS):
            for part, new in zip(held, self.frame(tick), strict=True):
                for value, number in zip(part.tensors().values(), new.tensors().values(), strict=True):
                    value.copy_(number)
            self.same(
                self.step(held), expected[tick], f"inputs in new and in reused buffers (tick {tick})", "copy them"
            )

    def describe(self) -> None:
        self.begin()
        declared = json_object(self.tracker.describe())
        self.play(range(2))
        if json_object(self.tracker.describe()) != declared:
            raise Violation("describe() answers something else after two ticks")
        if json.loads(declared).get("name") != self.tracker.name:
            raise Violation(f"describe() must hold the name {self.tracker.name!r}: {declared}")


def check_tracker(
    tracker: Tracker,
    *,
    worlds: int = WORLDS,
    device: str = "cpu",
    tolerance: float | None = None,
    raises: bool = True,
) -> list[CheckResult]:
    """Try every promise of `interfaces.Tracker` on a tracker.

    Args:
        tracker: The tracker; it is bound and reset many times and belongs to nobody afterwards.
        worlds: Worlds in the larger batch, at least 2.
        device: Torch device to bind it to.
        tolerance: Largest difference of a world's targets alone and among others [rad]; 0 on the CPU, where results
            must not depend on the number of worlds, and `CUDA_TOLERANCE` on CUDA by default.
        raises: Whether broken promises are an error, as a test wants it.

    Returns:
        A finding per check.

    Raises:
        ConformanceError: At least one promise is broken; the message lists all.
        ValueError: Fewer than 2 worlds.
    """
    if worlds < 2:
        raise ValueError(f"worlds {worlds}: masks need at least 2")
    if tolerance is None:
        tolerance = 0.0 if torch.device(device).type == "cpu" else CUDA_TOLERANCE
    results = perform(_Trial(tracker, worlds, device, tolerance).checks())
    if raises and not all(result.ok for result in results):
        raise ConformanceError(f"tracker {tracker.name}", results)
    return results
