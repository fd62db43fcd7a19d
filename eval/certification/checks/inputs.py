"""Do policy and tracker know no more than they are given: a seed that leads to no placement, a command and a state?"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import torch

from arena_newton import policies, rule_sets, tasks
from arena_newton.eval.certification.checks.replays import recorded
from arena_newton.eval.certification.checks.traces import world_of
from arena_newton.eval.certification.context import Context
from arena_newton.eval.certification.finding import Check, CheckFinding, skipped
from arena_newton.eval.plan.config import resolve
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.play.run import check_parts
from arena_newton.files.stored_json import JsonObject
from arena_newton.files.text import counted
from arena_newton.interfaces import Chunk, Observation, RobotState, Tracker, TrackerCommand
from arena_newton.pages.tables import Table
from arena_newton.policies.base import Mask, Policy
from arena_newton.robot.canonical import STAND_ACTION
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding

__all__ = ["CHECKS", "Heard", "targets_alone"]

SEEDS_TRIED = 4
"""Episodes whose placements are sought in the seeds that a policy is given."""
HEARD_TICKS = 150
"""Longest episode in which a tracker is listened to [ticks]."""


class Collector(Policy):
    """Stands, and keeps every number that it is given of an episode."""

    name = "collector"

    def __init__(self) -> None:
        """Know nothing yet."""
        self.given: list[int] = []

    def check_task(self, task: str, mode: str | None = None, seeds: Sequence[int] = ()) -> None:
        """See `Policy.check_task`."""
        self.given += seeds

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: Mask = None) -> None:
        """See `Policy.reset`."""
        self.given += seeds

    def act(self, observation: Observation) -> Chunk:
        """See `Policy.act`."""
        return Chunk(np.tile(STAND_ACTION, (len(observation.state), 1, 1)))


def policy_inputs(context: Context) -> CheckFinding:
    """Give a policy its episodes as a run does, and draw placements from each number that it was given."""
    rows, wrong = [], []
    tracker = context.trackers[0]
    for task in context.tasks[:1] if context.options.quick else context.tasks:
        measure = functools.partial(_sought, context, task, tracker)
        found = context.measured("policy-inputs", task, tracker, {"seeds": SEEDS_TRIED}, measure)
        rows.append((task, str(found["given"]), f"{found['known']}/{found['episodes']}"))
        wrong += [
            f"{task}: placements of {found['known']} of {found['episodes']} episodes follow from the seed"
        ] * bool(found["known"])
    sheet = Table(
        ("task", "numbers given", "placements"), rows, title="What follows from the seeds that a policy is given"
    )
    summary = "a policy's seeds lead to no placement of their episodes, tried as seeds of episodes and of objects"
    note = (
        "A seed is for noise alone: the SHA-256 of the episode's. It is no secret: who tries every number of a plan "
        "finds the episode. A plan that is always the same can be learned by heart by its pictures too."
    )
    return CheckFinding("fail" if wrong else "pass", wrong[0] if wrong else summary, (sheet,), (*wrong, note))


def _sought(context: Context, task: str, tracker: str) -> JsonObject:
    """Numbers that a policy is given of a task's first episodes, and of how many they tell the placements."""
    policy, spec, rules = Collector(), tasks.get(task), rule_sets.get("paper").task(task)
    options = RunOptions(task=(task,), tracker=(tracker,), policy="stand", seeds=(0,), repeats=SEEDS_TRIED)
    made = dataclasses.replace(context.factories, policy=lambda spec, **options: policy)
    config, _ = check_parts(resolve(options), made)
    env = world_of(context, task, tracker, worlds=SEEDS_TRIED)
    Rollout(env, policy, config.episodes, max_steps=1).run()
    env.close()
    known = 0
    tried = {number for seed in policy.given for number in (seed, seeding.object_seed(seed))}  # it is its own inverse
    for episode in config.episodes:
        truth = spec.sample(episode.episode_seed, "base", rules)
        known += any(spec.sample(seed, "base", rules) == truth for seed in tried)
    return {"given": len(policy.given), "known": known, "episodes": len(config.episodes)}


class Heard:
    """Every call of a tracker and its answers, while it plays."""

    def __init__(self, tracker: Tracker):
        """Listen to a tracker from now on."""
        self.calls: list[tuple[str, dict[str, Any], torch.Tensor | None]] = []
        for name in ("reset", "prefill", "step"):
            setattr(tracker, name, self._listening(name, getattr(tracker, name)))

    def _listening(self, name: str, call: Callable[..., object]) -> Callable[..., object]:
        def heard(*given: object, **named: object) -> object:
            kept = [_copied(part) for part in given], {key: _copied(part) for key, part in named.items()}
            answer = call(*given, **named)
            kept_answer = answer.clone() if isinstance(answer, torch.Tensor) else None
            self.calls.append((name, {"given": kept[0], "named": kept[1]}, kept_answer))
            return answer

        return heard


def _copied(part: object) -> object:
    """A copy of a mask, or of the tensors of a command or state."""
    if isinstance(part, torch.Tensor):
        return part.clone()
    return part.mapped(torch.clone) if isinstance(part, RobotState | TrackerCommand) else None


def _renewed(kept: dict[str, object], part: object) -> object:
    """The copy as the same object at each call, as a tracker in a world is given its command and state."""
    if not isinstance(part, RobotState | TrackerCommand):
        return part
    same = kept.setdefault(type(part).__name__, part.mapped(torch.clone))
    assert isinstance(same, RobotState | TrackerCommand)
    for value, new in zip(same.tensors().values(), part.tensors().values(), strict=True):
        value.copy_(new)
    return same


def targets_alone(heard: Heard, tracker: Tracker, worlds: int, device: torch.device) -> tuple[int, int | None]:
    """Ask a tracker that is in no world the same again.

    Returns:
        Ticks that were asked, and the first one with other targets; None where all are the same to the last bit.
    """
    tracker.bind(worlds, device)
    kept: dict[str, Any] = {}
    ticks = 0
    for name, parts, answer in heard.calls:
        given = [_renewed(kept, part) for part in parts["given"]]
        again = getattr(tracker, name)(*given, **{key: _renewed(kept, part) for key, part in parts["named"].items()})
        if name == "step":
            assert answer is not None
            if not torch.equal(again.view(torch.int32), answer.view(torch.int32)):
                return ticks, ticks
            ticks += 1
    return ticks, None


def tracker_inputs(context: Context) -> CheckFinding:
    """Play recorded actions, which are known in advance, and ask a tracker that is in no world the same."""
    if context.options.engine != "mujoco":
        return skipped("bits are promised on engine mujoco alone")
    rows, wrong = [], []
    for tracker, task in itertools.product(
        context.trackers, context.tasks[:1] if context.options.quick else context.tasks
    ):
        measure = functools.partial(_listen, context, task, tracker)
        found = context.measured("tracker-inputs", task, tracker, {"ticks": HEARD_TICKS}, measure)
        rows.append((task, tracker, str(found["ticks"]), "none" if found["differs"] is None else str(found["differs"])))
        if found["differs"] is not None:
            wrong.append(
                f"{task} through {tracker}: other targets at tick {found['differs']} without world and actions"
            )
    head = ("task", "tracker", "ticks compared", "first tick with other targets")
    summary = f"{counted(len(rows), 'tracker')} gave the same targets again from command and state alone, bit for bit"
    summary = wrong[0] if wrong else summary
    return CheckFinding(
        "fail" if wrong else "pass", summary, (Table(head, rows, title="Trackers outside of a world"),), tuple(wrong)
    )


def _listen(context: Context, task: str, name: str) -> JsonObject:
    """Ticks of a replay, and the first one whose targets do not follow from command and state."""
    cell = recorded(context, task, name)
    record = next((one for one in context.evaluate(cell) if one.steps), None)
    if record is None:
        return {"ticks": 0, "differs": 0}
    env = world_of(context, task, name, worlds=1)
    heard = Heard(env.tracker)
    replay = policies.get(f"replay:{context.path(cell) / 'actions'}")
    Rollout(env, replay, [record], max_steps=HEARD_TICKS).run()
    device = env.torch_device
    ticks, differs = targets_alone(heard, context.factories.tracker(name, None), 1, device)
    env.close()
    return {"ticks": ticks, "differs": differs}


CHECKS = (
    Check(
        "policy-inputs",
        "Does nothing of an episode's placements follow from the seed that a policy is given?",
        policy_inputs,
    ),
    Check(
        "tracker-inputs", "Do a tracker's targets follow from its command and the robot's state alone?", tracker_inputs
    ),
)
"""This module's checks."""
