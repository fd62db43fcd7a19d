"""``policies train teachable``: can a policy without memory learn these demonstrations at all? Minutes, no GPU."""

from __future__ import annotations

import json
import time
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING

import torch

from arena_newton import tasks, trackers
from arena_newton.cli.intervals import wilson
from arena_newton.cli.quiet import quiet_warp
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.files.own_files import replace_atomically
from arena_newton.interfaces import EpisodeResult, Tracker, World
from arena_newton.policies.base import Chunk, Observation, Policy
from arena_newton.policies.experts.base import Sight
from arena_newton.policies.label_reader import read_by
from arena_newton.policies.recipes.training_recipe import REALIGN
from arena_newton.policies.train.teachable_network import PoseNetwork, fitted, pose_features, read_demonstrations
from arena_newton.rollout import Rollout
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.policies.train.policy_options import TeachableOptions

__all__ = ["PosePolicy", "teachable"]

SERIES = 3
"""Group seeds over which episodes are spread, those of the protocol."""
SAID_EVERY = 500
"""Steps between lines of the console."""


@dataclass(frozen=True)
class PlayedSeed:
    """An episode of the evaluation."""

    group_seed: int
    repeat: int
    episode_seed: int


class PosePolicy(Policy):
    """The network in the world: it is given what the demonstrations have, measured."""

    name = "poses"
    labels = "v4"
    realign = REALIGN

    def __init__(self, network: PoseNetwork, objects: Sequence[str]):
        """Play a network.

        Args:
            network: Trained on these objects.
            objects: Their names in recordings.
        """
        self.network, self.objects = network, tuple(objects)
        self.chunk_size = network.chunk

    def attach(self, env: World) -> None:
        """Find the objects in the world.

        Raises:
            InputError: It lacks one.
        """
        self._sight = Sight(env)
        prims = {placed.record: placed.prim for placed in env.spec.objects}
        lacking = [name for name in self.objects if name not in prims]
        if lacking:
            raise InputError(f"{env.spec.name}: has no object {lacking[0]}, which was recorded")
        found = [prims[name] for name in self.objects]
        scene = env.scene
        self._bodies = [scene.body_id(prim if scene.has_body(prim) else f"{prim}/Frame") for prim in found]

    def act(self, observation: Observation) -> Chunk:
        """A chunk for every world; what worlds show that do not ask is not used."""
        sight = self._sight
        objects = [(there.float().cpu(), turned.float().cpu()) for there, turned in map(sight.body, self._bodies)]
        robot = sight.root_position.float().cpu(), sight.root_quat.float().cpu()
        seen = pose_features(observation.state.float().cpu(), *robot, objects)
        with torch.inference_mode():
            # One row at a time: an episode is then the same for any number of worlds.
            rows = [self.network(row[None]) for row in seen]
        return Chunk(torch.cat(rows).clone().to(observation.state.device))


def teachable(options: TeachableOptions) -> int:
    """Train, play, and print how many episodes succeed.

    Returns:
        Exit code 0.

    Raises:
        InputError: A flag is wrong, or there are no such demonstrations.
    """
    spec = tasks.get(options.task)
    tracker = trackers.get(options.tracker)
    data = read_demonstrations(options.recording, spec.name, options.tracker)
    rows = len(data.features)
    print(f"{len(data.lengths)} demonstrations of {spec.name} through {options.tracker}, {rows:,} ticks", flush=True)
    print(
        f"the network is given the poses of the robot, {', '.join(data.objects) or 'and of nothing else'}", flush=True
    )
    began, losses = time.perf_counter(), [0.0]

    def report(step: int, loss: float) -> None:
        losses.append(loss)
        if step % SAID_EVERY == 0 or step == options.steps - 1:
            spent = time.perf_counter() - began
            print(f"step {step:,}: {loss:.4f} standard deviations off, {spent:.0f} s", flush=True)

    network = fitted(
        data,
        chunk=options.chunk,
        steps=options.steps,
        batch_size=options.batch_size,
        seed=options.seed,
        on_step=report,
    )
    trained = time.perf_counter() - began
    quiet_warp()
    results = _played(network, data.objects, options, tracker)
    solved = sum(result.outcome == "success" for result in results)
    low, high = wilson(solved, len(results))
    ended = ", ".join(f"{count} {reason}" for reason, count in Counter(str(r.reason) for r in results).most_common())
    margins = sorted(float(result.margin) for result in results)
    print(
        f"{solved} of {len(results)} succeed (95 % interval {100 * low:.0f} to {100 * high:.0f} %); {ended}; "
        f"median margin {margins[len(margins) // 2]:+.3f}"
    )
    held = Counter(name for result in results for name, tick in result.predicates.items() if tick is not None)
    if held:
        print("predicates that held: " + ", ".join(f"{name} {count}" for name, count in held.most_common()))
    if options.out is not None:
        flags = {name: str(value) if name in ("recording", "out") else value for name, value in asdict(options).items()}
        facts = {
            "flags": flags,
            "demonstrations": len(data.lengths),
            "ticks": rows,
            "objects": list(data.objects),
            "loss": losses[-1],
            "train_s": trained,
            "successes": solved,
            "episodes": [
                {**asdict(result.episode), "outcome": result.outcome, "steps": result.steps, "margin": result.margin}
                for result in results
            ],
        }
        with replace_atomically(options.out) as file:
            file.write((json.dumps(facts, indent=2) + "\n").encode())
    return 0


def _played(
    network: PoseNetwork, objects: Sequence[str], options: TeachableOptions, tracker: Tracker
) -> list[EpisodeResult]:
    """Results of the first episodes of the evaluation's group seeds."""
    gym_id = tasks.get(options.task).gym_id
    numbers = [(number % SERIES, number // SERIES) for number in range(options.episodes)]
    episodes = [PlayedSeed(group, repeat, seeding.episode_seed(gym_id, group, repeat)) for group, repeat in numbers]
    env = ArenaEnv(
        options.task,
        tracker=tracker,
        worlds=min(options.worlds, len(episodes)),
        engine=options.engine,
        device=options.device,
    )
    try:
        policy = read_by(PosePolicy(network, objects), "v4")
        return Rollout(env, policy, episodes, max_steps=options.max_steps).run()
    finally:
        env.close()
