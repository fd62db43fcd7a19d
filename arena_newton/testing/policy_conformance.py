"""Promises of `interfaces.Policy`, tried on a policy with made-up observations or with those of real worlds.

What a made-up world shows follows from its episode seed and the number of actions it has played, so that the same
episode can be followed alone, among others, and next to worlds that wait. A policy that reads the world itself in
`attach` needs real worlds, which are given as a maker of environments.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import Protocol

import numpy as np
import torch

from arena_newton import tasks as task_registry
from arena_newton.data.readers.label_protocols import LABELS
from arena_newton.errors import InputError
from arena_newton.interfaces import Chunk, Observation, Policy, World
from arena_newton.pictures.settings import CameraConfig, policy_cameras
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION, STATE_WIDTH
from arena_newton.rules import seeding
from arena_newton.testing.findings import (
    CheckResult,
    ConformanceError,
    Promise,
    Violation,
    json_object,
    perform,
)

__all__ = ["MAX_CHUNK", "SEEDS", "check_policy"]

SEEDS = (11, 12, 13)
"""Episode seeds of the worlds by default."""
ONLY = 1
"""The world that is asked, begins again or has a broken state while the others do not."""
ASKS = 4
"""Queries of a world in a comparison."""
MAX_CHUNK = 4096
"""Most actions of one answer, 82 s of blind execution; the limit of policy servers too."""
TOLERANCE = 1e-4
"""Default of `check_policy`'s tolerance [rad, m]: far below what a joint follows, above the rounding of a network whose
batch has another size."""

MakeWorlds = Callable[[int], World]
"""Number of worlds → an environment with that many."""


class _Stage(Protocol):
    """Worlds in which episodes are played."""

    worlds: int
    task: str
    gym_id: str

    def begin(self, seeds: Sequence[int], worlds: Sequence[int]) -> None:
        """Start episodes in some worlds."""

    def observe(self, asking: np.ndarray) -> Observation:
        """Present observation of the worlds."""

    def play(self, actions: torch.Tensor, playing: np.ndarray) -> None:
        """Execute a chunk, shape [worlds, n, 40], in some worlds."""


class _MadeUp:
    """Worlds without physics."""

    def __init__(self, policy: Policy, worlds: int, task: str):
        spec = task_registry.get(task)
        self.worlds, self.task, self.gym_id, self.instruction = worlds, task, spec.gym_id, spec.instruction
        self.cameras = policy_cameras(policy)
        self.seeds, self.ticks = np.zeros(worlds, np.int64), np.zeros(worlds, np.int64)

    def begin(self, seeds: Sequence[int], worlds: Sequence[int]) -> None:
        self.seeds[list(worlds)] = seeds
        self.ticks[list(worlds)] = 0

    def observe(self, asking: np.ndarray) -> Observation:
        state = np.zeros((self.worlds, STATE_WIDTH), np.float32)
        sizes = {name: (self.worlds, camera.height, camera.width) for name, camera in self.cameras.items()}
        images = {name: np.zeros((*size, 3), np.uint8) for name, size in sizes.items()}
        depths = {name: np.zeros(size, np.float16) for name, size in sizes.items() if self.cameras[name].depth}
        for world, key in enumerate(zip(self.seeds.tolist(), self.ticks.tolist(), strict=True)):
            rng = np.random.default_rng(key)
            state[world] = 0.1 * rng.standard_normal(STATE_WIDTH)
            state[world, :6] += STAND_ACTION[3:9]
            for name, image in images.items():
                image[world] = rng.integers(0, 256, image.shape[1:], np.uint8)
                if name in depths:
                    depths[name][world] = rng.uniform(0.0, 10.0, image.shape[1:3])
        return Observation(
            state=torch.from_numpy(state),
            image=None,
            mask=asking.copy(),
            task=self.task,
            gym_id=self.gym_id,
            instruction=self.instruction,
            images={name: torch.from_numpy(image) for name, image in images.items()},
            depths={name: torch.from_numpy(depth) for name, depth in depths.items()},
        )

    def play(self, actions: torch.Tensor, playing: np.ndarray) -> None:
        self.ticks[playing] += actions.shape[1]


class _Real:
    """Worlds of an environment; episodes may end there, which is not judged."""

    def __init__(self, policy: Policy, env: World):
        self.env, self.image = env, bool(policy_cameras(policy))
        self.worlds, self.task, self.gym_id = env.worlds, env.spec.name, env.spec.gym_id
        policy.attach(env)

    def begin(self, seeds: Sequence[int], worlds: Sequence[int]) -> None:
        self.env.reset(seeds, list(worlds))
        standing = torch.from_numpy(STAND_ACTION).repeat(self.worlds, 1)
        beginning = np.zeros(self.worlds, dtype=bool)
        beginning[list(worlds)] = True
        for _ in range(self.env.startup_ticks):
            self.env.step(standing, beginning)

    def observe(self, asking: np.ndarray) -> Observation:
        return self.env.observe(asking, image=self.image)

    def play(self, actions: torch.Tensor, playing: np.ndarray) -> None:
        for action in actions.unbind(1):
            self.env.step(action, playing)


class _Trial:
    """A policy under test; every run begins new episodes in all worlds."""

    def __init__(
        self, policy: Policy, seeds: Sequence[int], task: str, make_worlds: MakeWorlds | None, tolerance: float
    ):
        self.policy, self.seeds, self.task, self.tolerance = policy, tuple(seeds), task, tolerance
        self.make_worlds = make_worlds
        self._made: dict[int, World] = {}

    def checks(self) -> list[Promise]:
        """Every promise in order."""
        asks = "an episode does not depend on when other worlds ask"
        return [
            Promise("attributes", "name, picture, chunk, labels, dependence on worlds are declared", self.attributes),
            Promise("chunk", f"act answers a Chunk of valid actions [worlds, n, {ACTION_WIDTH}]", self.chunk),
            Promise("seeds", "the same seeds and observations give the same actions again", self.seeded),
            Promise("reset", "reset begins an episode in its worlds and touches no other", self.resets),
            Promise("asks", asks, self.asks),
            Promise("rows", "a world's actions do not depend on what other worlds show", self.rows),
            Promise(
                "batch", f"a world's actions are the same alone and among others, within {self.tolerance:g}", self.batch
            ),
            Promise("observation", "state, picture and mask are not written to", self.observation),
            Promise(
                "errors", "a world that cannot be served is named in Chunk.errors; the others are served", self.errors
            ),
            Promise("describe", "describe() is a stable JSON object with a name", self.describe),
            Promise("close", "close() can be called twice", self.close),
        ]

    def stage(self, worlds: int) -> _Stage:
        """Worlds to play in; environments are made once per size."""
        if self.make_worlds is None:
            return _MadeUp(self.policy, worlds, self.task)
        if worlds not in self._made:
            self._made[worlds] = self.make_worlds(worlds)
        return _Real(self.policy, self._made[worlds])

    def end(self) -> None:
        """Close the environments that were made."""
        for env in self._made.values():
            env.close()

    def reset(self, stage: _Stage, seeds: Sequence[int], worlds: Sequence[int]) -> None:
        """Begin episodes in a stage and in the policy, as a rollout does."""
        stage.begin(seeds, worlds)
        given, mask = [0] * stage.worlds, np.zeros(stage.worlds, dtype=bool)
        for seed, world in zip(seeds, worlds, strict=True):
            given[world], mask[world] = seeding.policy_seed(seed), True
        self.policy.reset(given, [stage.gym_id] * stage.worlds, mask)

    def run(
        self,
        seeds: Sequence[int],
        asks: Sequence[Sequence[int]] | None = None,
        again: tuple[int, int, int] | None = None,
    ) -> list[np.ndarray]:
        """Play episodes and collect what was decided for each world.

        Args:
            seeds: Episode seed per world.
            asks: Worlds that ask, round by round; all, `ASKS` times, by default.
            again: Round before which one world begins again, the world, and its new seed.

        Returns:
            Actions of each world in order, shape [actions, 40]; from its new beginning on where there is one.
        """
        stage = self.stage(len(seeds))
        self.reset(stage, seeds, range(len(seeds)))
        decided: list[list[np.ndarray]] = [[] for _ in seeds]
        for number, asking in enumerate(asks or [range(len(seeds))] * ASKS):
            if again is not None and again[0] == number:
                self.reset(stage, [again[2]], [again[1]])
                decided[again[1]] = []
            mask = np.zeros(len(seeds), dtype=bool)
            mask[list(asking)] = True
            actions = self.taken(self.policy.act(stage.observe(mask)), mask)
            for world in asking:
                decided[world].append(actions[world].numpy().copy())
            stage.play(actions, mask)
        return [np.concatenate([np.empty((0, ACTION_WIDTH), np.float32), *parts]) for parts in decided]

    def taken(self, chunk: Chunk, mask: np.ndarray) -> torch.Tensor:
        """The actions of an answer, standing where no world asked; float32, shape [worlds, n, 40].

        Raises:
            Violation: The answer is no chunk for these worlds, or a world that asked got no valid action.
        """
        worlds = len(mask)
        if not isinstance(chunk, Chunk):
            raise Violation(f"act answers a {type(chunk).__name__}, expected a Chunk")
        actions = torch.as_tensor(chunk.actions).detach().cpu()
        if actions.ndim != 3 or actions.shape[::2] != (worlds, ACTION_WIDTH) or not 1 <= actions.shape[1] <= MAX_CHUNK:
            raise Violation(
                f"act answers actions of shape {list(actions.shape)}, expected [{worlds}, n, {ACTION_WIDTH}] with n "
                f"from 1 to {MAX_CHUNK}"
            )
        _check_named(chunk, mask)
        if chunk.errors:
            world, text = next(iter(chunk.errors.items()))
            raise Violation(f"world {world} got no action: {text}")
        if chunk.phases is not None and (
            len(chunk.phases) != worlds or not all(phase is None or isinstance(phase, str) for phase in chunk.phases)
        ):
            raise Violation(f"phases must be {worlds} texts or None: {chunk.phases}")
        protocol = LABELS.get(getattr(self.policy, "labels", None) or "v3.1", LABELS["v3.1"])
        for world in np.flatnonzero(mask):
            try:
                protocol.validate(actions[world].numpy(), f"world {world}")
            except InputError as error:
                raise Violation(str(error)) from None
        standing = torch.from_numpy(STAND_ACTION).expand_as(actions)
        return torch.where(torch.from_numpy(mask)[:, None, None], actions.float(), standing)

    def same(
        self, found: np.ndarray, expected: np.ndarray, what: str, advice: str = "", tolerance: float = 0.0
    ) -> None:
        """Compare actions of one world, as many as both have."""
        count = min(len(found), len(expected))
        off = float(np.abs(found[:count].astype(np.float64) - expected[:count]).max())
        if off > tolerance:
            raise Violation(f"{what}: actions differ by up to {off:.3g}{advice and '; ' + advice}")

    @functools.cached_property
    def usual(self) -> list[np.ndarray]:
        """Actions of the episodes when all worlds ask each time."""
        return self.run(self.seeds)

    @property
    def excused(self) -> str | None:
        """The remark of promises that this policy says it does not make."""
        return "not promised: depends_on_worlds" if getattr(self.policy, "depends_on_worlds", False) else None

    def attributes(self) -> None:
        policy = self.policy
        if not isinstance(policy.name, str) or not policy.name.strip():
            raise Violation(f"name is {policy.name!r}, expected a text")
        if not isinstance(policy.needs_image, bool):
            raise Violation(f"needs_image is {policy.needs_image!r}, expected True or False")
        if (labels := getattr(policy, "labels", None)) not in (None, *LABELS):
            raise Violation(f"labels are {labels!r}, expected one of {', '.join(LABELS)} or None")
        camera, size = getattr(policy, "camera", None), getattr(policy, "chunk_size", 1)
        if camera is not None and not isinstance(camera, CameraConfig):
            raise Violation(f"camera is a {type(camera).__name__}, expected a CameraConfig or None")
        cameras = getattr(policy, "cameras", None)
        named = isinstance(cameras, Mapping) and all(isinstance(one, CameraConfig) for one in cameras.values())
        if cameras is not None and not named:
            raise Violation("cameras is no mapping of names to CameraConfig")
        if isinstance(size, bool) or not isinstance(size, int) or not 1 <= size <= MAX_CHUNK:
            raise Violation(f"chunk_size is {size!r}, expected a whole number from 1 to {MAX_CHUNK}")
        if not isinstance(getattr(policy, "depends_on_worlds", False), bool):
            raise Violation("depends_on_worlds is neither True nor False")

    def chunk(self) -> None:
        self.run(self.seeds)
        self.run(self.seeds[:1])
        stage = self.stage(len(self.seeds))
        stage.begin(self.seeds, range(stage.worlds))
        self.policy.reset(list(map(seeding.policy_seed, self.seeds)), [stage.gym_id] * stage.worlds)
        mask = np.ones(stage.worlds, dtype=bool)
        self.taken(self.policy.act(stage.observe(mask)), mask)

    def seeded(self) -> None:
        first = self.usual
        self.run(self.seeds[::-1], [[0], [0, ONLY]])
        for world, (found, expected) in enumerate(zip(self.run(self.seeds), first, strict=True)):
            self.same(found, expected, f"world {world} twice", "draw noise from the seed; forget everything in reset")

    def resets(self) -> str | None:
        if self.excused:
            return self.excused
        expected = self.usual
        asks = [range(len(self.seeds))] * (2 * ASKS)
        found = self.run(self.seeds, asks, (ASKS - 1, ONLY, self.seeds[ONLY]))
        advice = "reset must clear its worlds' memory"
        self.same(found[ONLY], expected[ONLY], f"world {ONLY} begun again and new", advice)
        undisturbed = self.run(self.seeds, asks)
        for world in range(len(self.seeds)):
            if world != ONLY:
                what = f"world {world} while world {ONLY} begins again"
                self.same(found[world], undisturbed[world], what, "reset must keep to its mask")
        return None

    def asks(self) -> str | None:
        if self.excused:
            return self.excused
        every = range(len(self.seeds))
        expected = self.usual
        found = self.run(self.seeds, [every, [ONLY], [ONLY], *[[w for w in every if w != ONLY]] * 3, [ONLY], every])
        for world in every:
            what = f"world {world} when worlds ask in turn"
            self.same(
                found[world], expected[world], what, "advance the memory of observation.mask alone", self.tolerance
            )
        return None

    def rows(self) -> str | None:
        if self.excused:
            return self.excused
        expected = self.usual
        found = self.run(self.seeds[:1] * len(self.seeds))  # the others show the episode of world 0
        self.same(found[0], expected[0], "world 0 next to other episodes", tolerance=self.tolerance)
        return None

    def batch(self) -> str | None:
        if self.excused:
            return self.excused
        among = self.usual
        alone = self.run(self.seeds[:1])
        advice = "else declare depends_on_worlds = True"
        self.same(alone[0], among[0], f"world 0 alone and among {len(self.seeds)}", advice, self.tolerance)
        return None

    def observation(self) -> None:
        stage = self.stage(len(self.seeds))
        self.reset(stage, self.seeds, range(stage.worlds))
        mask = np.ones(stage.worlds, dtype=bool)
        mask[ONLY] = False
        seen = stage.observe(mask)
        state, images = seen.state.clone(), {name: image.clone() for name, image in seen.images.items()}
        self.policy.act(seen)
        if not torch.equal(seen.state, state):
            raise Violation("act writes into observation.state, which is the world's own buffer")
        if any(not torch.equal(seen.images[name], image) for name, image in images.items()):
            raise Violation("act writes into observation.images, which the recorder keeps too")
        expected = np.arange(stage.worlds) != ONLY
        if not np.array_equal(seen.mask, expected):
            raise Violation("act writes into observation.mask")

    def errors(self) -> str | None:
        if self.make_worlds is not None:
            return "not tried in real worlds, which end an episode with a broken state themselves"
        stage = self.stage(len(self.seeds))
        mask = np.ones(stage.worlds, dtype=bool)
        self.reset(stage, self.seeds, range(stage.worlds))
        good = self.policy.act(stage.observe(mask))
        self.reset(stage, self.seeds, range(stage.worlds))
        seen = stage.observe(mask)
        seen.state[ONLY] = math.nan
        try:
            chunk = self.policy.act(seen)
        except Exception as error:
            raise Violation(
                f"one world's broken state stops all: {type(error).__name__}: {error}; name it in Chunk.errors"
            ) from None
        _check_named(chunk, mask)
        rows = np.flatnonzero(np.arange(stage.worlds) != ONLY)
        for world in rows.tolist():
            if world in chunk.errors:
                raise Violation(f"world {world} is refused for the broken state of world {ONLY}: {chunk.errors[world]}")
            if not self.excused:
                found, expected = (torch.as_tensor(one.actions)[world].cpu().numpy() for one in (chunk, good))
                what = f"world {world} next to a broken state"
                self.same(np.nan_to_num(found, nan=math.inf), expected, what, tolerance=self.tolerance)
        return None

    def describe(self) -> None:
        describe = getattr(self.policy, "describe", None)
        if describe is None:
            raise Violation("has no describe(); policies.Policy has one that gives the name")
        self.run(self.seeds, [range(len(self.seeds))])
        declared = json_object(describe())
        self.run(self.seeds)
        if json_object(describe()) != declared:
            raise Violation("describe() answers something else after an episode")
        if "name" not in describe():
            raise Violation(f"describe() must hold a name: {declared}")

    def close(self) -> None:
        for _ in range(2):
            getattr(self.policy, "close", lambda: None)()


def _check_named(chunk: Chunk, mask: np.ndarray) -> None:
    """Check the worlds that an answer names in its errors.

    Raises:
        Violation: A world that did not ask, or no text.
    """
    for world, text in chunk.errors.items():
        if not isinstance(world, int | np.integer) or not 0 <= world < len(mask) or not mask[world]:
            raise Violation(f"errors name world {world!r}, which did not ask")
        if not isinstance(text, str) or not text.strip():
            raise Violation(f"errors say {text!r} about world {world}, expected a text")


def check_policy(
    policy: Policy,
    *,
    task: str = "football",
    seeds: Sequence[int] = SEEDS,
    make_worlds: MakeWorlds | None = None,
    tolerance: float = TOLERANCE,
    raises: bool = True,
) -> list[CheckResult]:
    """Try every promise of `interfaces.Policy` on a policy.

    Args:
        policy: The policy; it is closed afterwards.
        task: Task of the made-up observations.
        seeds: Episode seeds, one per world, at least 2 and different; those that the policy knows, if it knows some.
        make_worlds: Makes an environment of a number of worlds, for policies that read the world in `attach`. Those
            that are made are closed at the end. Without it `attach` is not called, and nothing is simulated.
        tolerance: Largest difference of a world's actions alone and among others, where a network's rounding may show
            [rad, m]. Everything else is compared bit for bit.
        raises: Whether broken promises are an error, as a test wants it.

    Returns:
        A finding per check.

    Raises:
        ConformanceError: At least one promise is broken; the message lists all.
        ValueError: Fewer than 2 seeds, or one twice.
        InputError: The policy's own `check` or `check_task` refuses.
    """
    if len(seeds) < 2 or len(set(seeds)) < len(seeds):
        raise ValueError(f"seeds {list(seeds)}: masks need at least 2 different ones")
    if hasattr(policy, "check"):
        policy.check()
    if hasattr(policy, "check_task"):
        policy.check_task(task)
    trial = _Trial(policy, seeds, task, make_worlds, tolerance)
    try:
        results = perform(trial.checks())
    finally:
        trial.end()
    if raises and not all(result.ok for result in results):
        raise ConformanceError(f"policy {policy.name}", results)
    return results
