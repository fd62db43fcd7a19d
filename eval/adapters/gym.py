"""Gymnasium: a batch of worlds as a vector environment, one world as an environment, and their ids.

    import gymnasium
    import arena_newton.eval.adapters.gym  # registers a task's environment, arena_newton/VisNavi-v0 and so on

    env = gymnasium.make_vec("arena_newton/VisNavi-v0", num_envs=16)
    observation, info = env.reset(seed=0)

Seed `s` is episode `s` of the benchmark's plan: group seed `s // 20`, repeat `s % 20`. An environment that is reset by
`seed=0` therefore plays the episodes of `python -m arena_newton.eval run`, in the same worlds and with the same bits.
"""

from __future__ import annotations

import string
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, cast, get_args

import gymnasium
import numpy as np
import torch
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from arena_newton import tasks as task_registry
from arena_newton import trackers
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.eval.plan.config import DEFAULT_TRACKER
from arena_newton.eval.plan.episode_plan import PROTOCOL_REPEATS, PROTOCOL_SEEDS
from arena_newton.pictures.camera import Camera
from arena_newton.pictures.settings import STRIP_SIZES, CameraConfig, Fit
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION, STATE_WIDTH
from arena_newton.robot.g1 import TICK
from arena_newton.rollout import ending
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from typing import Any

    from arena_newton.interfaces import Tracker

__all__ = ["ArenaGymEnv", "ArenaVectorEnv", "env_id", "register"]

NAMESPACE = "arena_newton"
"""Prefix of every id."""
IMAGE_SIZE = (224, 224)
"""Width and height of observed pictures [px], as policies of the original see them."""
STARTUP = ("steps", "reset")
"""Calls in which an episode's start-up happens: steps whose action is ignored, or the reset."""
REWARDS = ("success", "margin")
"""1 at success; or the change of the task's margin per tick, and 1 at success."""
RESET_MASK = "reset_mask"
"""Option of `reset`: worlds that begin a new episode, bool, shape [num_envs]; Gymnasium's own name."""
NEW_ROLLOUT = "lerobot_new_rollout"
"""Option by which LeRobot marks a reset of its rollout; every explicit reset is one here."""
DRAWN_SEEDS = 2**31
"""A reset without a seed draws the first one below this number, and outside the protocol's."""
LARGEST_SEED = 2**62
"""Largest seed of a reset."""
PROTOCOL_EPISODES = (max(PROTOCOL_SEEDS) + 1) * PROTOCOL_REPEATS
"""Seeds below this are episodes of the benchmark's protocol."""

type Observations = dict[str, object]
type Info = dict[str, object]


class ArenaVectorEnv(VectorEnv[Observations, np.ndarray, np.ndarray]):
    """Worlds of one task as a Gymnasium vector environment.

    Observation, rows are worlds: `agent_pos`, the canonical state, float32 [worlds, 64]; `pixels`, uint8 [worlds, H, W,
    3], or a dictionary of them where cameras are named; `task`, the instruction. Action: the canonical action, float32
    [worlds, 40].
    """

    metadata: dict[str, Any] = {
        "render_modes": ["rgb_array"],
        "render_fps": round(1.0 / TICK),
        "autoreset_mode": AutoresetMode.SAME_STEP,
    }

    def __init__(
        self,
        task: str,
        num_envs: int = 1,
        *,
        tracker: str | Tracker = DEFAULT_TRACKER,
        checkpoint: str | None = None,
        mode: str = "base",
        rules: str = "paper",
        engine: str = "auto",
        device: str | None = None,
        threads: int | None = None,
        variant_file: str | None = None,
        fast_physics: bool = False,
        image_size: Sequence[int] | None = IMAGE_SIZE,
        fit: Fit = "pad",
        cameras: Mapping[str, str | CameraConfig] | None = None,
        state_keys: Sequence[str] = ("agent_pos",),
        instruction: bool = True,
        startup: str = "steps",
        reward: str = "success",
        autoreset_mode: AutoresetMode | str = AutoresetMode.SAME_STEP,
        repeats: int = PROTOCOL_REPEATS,
        seed_range: str = seeding.EVALUATION,
        max_episode_steps: int | None = None,
        render_mode: str | None = "rgb_array",
    ):
        """Build the worlds.

        Args:
            task: Task name.
            num_envs: Worlds in the batch.
            tracker: Name of the tracker that executes actions, or a tracker, which then belongs to this environment.
            checkpoint: Weights of a tracker that is given by name; those of the package when none is named.
            mode: One of `modes.names()`.
            rules: Rule set.
            engine: `auto`, `mujoco` or `warp`.
            device: Warp device, such as `cpu` or `cuda:0`.
            threads: CPU threads of engine `mujoco`; all by default.
            variant_file: A USD layer instead of the task's own scene.
            fast_physics: Use the tracker's fast physics rate.
            image_size: Width and height of observed pictures [px]; None: no pictures are taken, which is much faster.
            fit: `pad` or `native`, as in `CameraConfig`: how the camera's 4:3 picture goes into another size.
            cameras: Name in `pixels` → camera (`ego`, `left_wrist`, `right_wrist`, `world` or a prim's path), or one
                with size and fit of its own; by default `pixels` is the head camera's picture itself.
            state_keys: Names under which the state is observed.
            instruction: Observe the instruction too, as `task`.
            startup: `steps`: an episode's start-up is ordinary steps whose action is ignored, and `info["startup"]`
                names the worlds that are in it. `reset`: a reset leads its worlds through it while the others wait; a
                robot that falls meanwhile is terminated by the next step.
            reward: `success`: 1 at success, else 0. `margin`: from the second tick on the change of the task's margin
                [m or the task's unit], and 1 at success.
            autoreset_mode: `SAME_STEP` (final observation and info in `info`) or `NEXT_STEP`, both as Gymnasium defines
                them, or `DISABLED`: a world that ended is frozen until it is reset. It moves no more, whatever its
                action; its observation, picture, flags and info are those of its end, its reward is 0.
            repeats: Episodes per group seed in the numbering of seeds.
            seed_range: `evaluation`, or `demonstration`: episodes of the same numbers that no evaluation ever has, to
                learn from.
            max_episode_steps: Cap on the step budget of the rule set [ticks].
            render_mode: `rgb_array`, or None.

        Raises:
            InputError: Something named in the message is unknown or does not fit.
        """
        self.startup = _choice("startup", startup, STARTUP)
        self.reward = _choice("reward", reward, REWARDS)
        self.render_mode = None if render_mode is None else _choice("render_mode", render_mode, ("rgb_array",))
        self.autoreset_mode = _autoreset_mode(autoreset_mode)
        self.metadata = type(self).metadata | {"autoreset_mode": self.autoreset_mode}
        self.seed_range = _choice("seed_range", seed_range, (seeding.EVALUATION, seeding.DEMONSTRATION))
        self.repeats = _at_least_1("repeats", repeats)
        self.num_envs = _at_least_1("num_envs", num_envs)
        cap = None if max_episode_steps is None else _at_least_1("max_episode_steps", max_episode_steps)
        size = None if image_size is None else _size(image_size, other=", or None")
        _choice("fit", fit, get_args(Fit))
        wanted = {"": "ego"} if cameras is None else cameras
        self.env = ArenaEnv(
            task,
            tracker=trackers.get(tracker, checkpoint) if isinstance(tracker, str) else tracker,
            worlds=self.num_envs,
            engine=engine,
            device=device,
            rules=rules,
            mode=mode,
            variant_file=variant_file,
            fast_physics=fast_physics,
            threads=threads,
        )
        """The worlds."""
        self.task = self.env.spec.name
        self.task_description = self.env.spec.instruction
        """Instruction in natural language."""
        self.budget = self.env.budget if cap is None else min(cap, self.env.budget)
        """Step budget of an episode after its start-up [ticks]."""
        ticks = self.env.startup_ticks if self.startup == "steps" else 0
        self._max_episode_steps = ticks + self.budget  # the name by which LeRobot asks
        self._named, self._instruction = cameras is not None, instruction
        self._cameras: dict[str, Camera] = {}
        if size is not None:
            for name, one in wanted.items():
                shown = one.named(name) if isinstance(one, CameraConfig) else CameraConfig(*size, one, fit)
                _size((shown.width, shown.height), f"cameras: {name}")
                if shown.depth:
                    raise InputError(f"cameras: {name}: depth is not observed")
                self._cameras[name] = Camera.of_config(self.env.scene, shown, self.env.lights)
        self._state_keys = tuple(state_keys)
        self._make_spaces()
        n = self.num_envs
        self._state = np.zeros((n, STATE_WIDTH), dtype=np.float32)
        self._pixels = {name: np.zeros((n, c.height, c.width, 3), np.uint8) for name, c in self._cameras.items()}
        self._film: Camera | None = None
        self._unfilmed = np.ones(n, dtype=bool)
        self._seed, self._episode_seed = np.zeros(n, dtype=np.int64), np.zeros(n, dtype=np.int64)
        self._next: int | None = None
        """Number of the next episode that nobody plays yet; None before the first reset."""
        self._begun = np.zeros(n, dtype=bool)
        self._over, self._reported, self._terminated = (np.zeros(n, dtype=bool) for _ in range(3))
        """Worlds whose episode ended; whose end a step has returned; whose end is no truncation."""
        self._outcome, self._reason = (np.full(n, "", dtype=object) for _ in range(2))
        self._margin = np.full(n, np.nan)

    def _make_spaces(self) -> None:
        """Spaces of one world and of the batch."""
        state = {name: spaces.Box(-np.inf, np.inf, (STATE_WIDTH,), np.float32) for name in self._state_keys}
        parts: dict[str, spaces.Space] = dict(state)
        if self._cameras:
            sizes = {name: (camera.height, camera.width, 3) for name, camera in self._cameras.items()}
            pictures = {name: spaces.Box(0, 255, shape, np.uint8) for name, shape in sizes.items()}
            parts["pixels"] = spaces.Dict(dict(pictures)) if self._named else pictures[""]
        if self._instruction:
            letters = string.ascii_letters + string.digits + string.punctuation + " "
            letters += "".join(sorted(set(self.task_description) - set(letters)))
            parts["task"] = spaces.Text(max(len(self.task_description), 1), charset=letters)
        self._observed = tuple(parts)
        self.single_observation_space = spaces.Dict(parts)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.single_action_space = spaces.Box(-np.inf, np.inf, (ACTION_WIDTH,), np.float32)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[Observations, Info]:
        """Begin a new episode in every world, or in those of the option `reset_mask`; no bit of the others changes.

        Args:
            seed: Number of world 0's episode, world i begins episode seed + i; or one number per world. None, or None
                for a world: the next episode that no world has played; before any seed was given a drawn one, which is
                outside the protocol.
            options: `reset_mask`, bool, shape [num_envs].

        Raises:
            InputError: A seed or an option that does not fit.
        """
        mask = self._reset_mask(options)
        first = int(seed) if isinstance(seed, int | np.integer) else None
        if first is not None:
            numbers: list[int | None] = [first + world for world in range(self.num_envs)]
        elif seed is None:
            numbers = [None] * self.num_envs
        else:
            numbers = list(cast("Sequence[int | None]", seed))
            if len(numbers) != self.num_envs:
                raise InputError(f"seed: {len(numbers)} numbers for {self.num_envs} worlds")
        for number in numbers:
            if number is not None and not (isinstance(number, int | np.integer) and 0 <= number <= LARGEST_SEED):
                raise InputError(f"seed {number}: expected a whole number from 0 to 2^62")
        super().reset(seed=None if first is None else int(first))
        self._begin(mask, numbers)
        self._look(mask)
        return self._observation(), self._info(mask)

    def episode_seed(self, number: int) -> int:
        """Seed from which everything random about episode `number` follows."""
        gym_id, (group, repeat) = self.env.spec.gym_id, divmod(number, self.repeats)
        if self.seed_range == seeding.EVALUATION:
            return seeding.episode_seed(gym_id, group, repeat)
        return seeding.recording_seed(gym_id, self.seed_range, group, repeat)

    def _reset_mask(self, options: Mapping[str, object] | None) -> np.ndarray:
        unknown = set(options or ()) - {RESET_MASK, NEW_ROLLOUT}
        if unknown:
            raise InputError(f"options {', '.join(sorted(unknown))}: unknown, known is {RESET_MASK}")
        given = (options or {}).get(RESET_MASK)
        if given is None:
            return np.ones(self.num_envs, dtype=bool)
        mask = np.asarray(given)
        if mask.dtype != np.bool_ or mask.shape != (self.num_envs,) or not mask.any():
            raise InputError(f"options {RESET_MASK}: expected bool, shape [{self.num_envs}], with at least one world")
        waiting = ~(mask | self._begun)
        if waiting.any():
            worlds = np.flatnonzero(waiting).tolist()
            raise InputError(f"options {RESET_MASK}: leaves out worlds {worlds}, which never began an episode")
        return mask.copy()

    def _begin(self, mask: np.ndarray, numbers: Sequence[int | None]) -> None:
        """Begin episodes in the worlds of a mask: those of `numbers`, of which there is one per world, or the next."""
        worlds = np.flatnonzero(mask)
        given = [numbers[world] for world in worlds]
        named = [number for number in given if number is not None]
        if named:  # what follows comes after the seeds of this reset
            self._next = max(named) + 1
        elif self._next is None:
            self._next = int(self.np_random.integers(PROTOCOL_EPISODES, DRAWN_SEEDS))
        for world, number in zip(worlds.tolist(), given, strict=True):
            if number is None:
                number = self._next or 0
                self._next = number + 1
            self._seed[world] = number
            self._episode_seed[world] = self.episode_seed(number)
        self.env.reset(self._episode_seed[worlds].tolist(), worlds)
        self._begun |= mask
        self._unfilmed |= mask
        for flags in (self._over, self._reported, self._terminated):
            flags[mask] = False
        self._outcome[mask] = self._reason[mask] = ""
        self._margin[mask] = np.nan
        if self.startup == "reset":
            self._lead_through(mask)

    def _lead_through(self, mask: np.ndarray) -> None:
        """Take the worlds of a mask through their start-up; the others wait."""
        stand = np.tile(STAND_ACTION, (self.num_envs, 1))
        while True:
            startup = mask & ~self._over & (self.env.tick < 0)
            if not startup.any():
                return
            self._end(self.env.step(stand, startup), startup)

    def _end(self, status: np.ndarray, stepped: np.ndarray) -> None:
        """End the episodes that a tick ended; their worlds stand still from now on."""
        tick = self.env.tick
        for world in np.flatnonzero(stepped).tolist():
            found = ending(self.env, int(status[world]), int(tick[world]), self.budget)
            if found is not None:
                self._outcome[world], self._reason[world], _ = found
                self._over[world] = True
                # An error is no state of the task; neither is the end of the budget.
                self._terminated[world] = found[0] != "error" and found[1] != "timeout"
        self.env.release(np.flatnonzero(self._over))

    def step(self, actions: np.ndarray | torch.Tensor) -> tuple[Observations, np.ndarray, np.ndarray, np.ndarray, Info]:
        """Advance every world that runs an episode by one tick.

        Args:
            actions: Canonical actions, float32, shape [num_envs, 40]; ignored in worlds that are in their start-up,
                that are frozen, or that this step resets. One that is not finite ends its world's episode as `error`.

        Returns:
            Observation, reward, terminated (success, a fall, a task's event), truncated (the step budget, an error) and
            info.

        Raises:
            InputError: Actions of another shape, or no reset before.
        """
        action = self._checked(actions)
        restart = self._over & self._reported if self.autoreset_mode == AutoresetMode.NEXT_STEP else self._over & False
        stepping = ~self._over
        rewards = np.zeros(self.num_envs)
        if stepping.any():
            self._end(self.env.step(action, stepping), stepping)
            rewards = self._rewards(stepping)
        if restart.any():
            self._begin(restart, [None] * self.num_envs)
        seen = stepping | restart
        self._look(seen)
        self._unfilmed |= seen
        ended = self._over & ~restart
        terminated, truncated = ended & self._terminated, ended & ~self._terminated
        self._reported |= ended
        final: Info = {}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and ended.any():
            final = self._final(ended)
            self._begin(ended, [None] * self.num_envs)
            self._look(ended)
        info = self._info(np.ones(self.num_envs, dtype=bool))
        return self._observation(), rewards, terminated, truncated, info | final

    def _checked(self, actions: np.ndarray | torch.Tensor) -> torch.Tensor:
        if not self._begun.all():
            raise InputError("no world runs an episode: call reset() first")
        try:
            action = torch.as_tensor(actions).to(torch.float32)
        except (TypeError, ValueError, RuntimeError):
            raise InputError("actions: expected an array of numbers") from None
        if action.shape != (self.num_envs, ACTION_WIDTH):
            expected = [self.num_envs, ACTION_WIDTH]
            raise InputError(f"actions of shape {list(action.shape)}, expected {expected}")
        return action

    def _rewards(self, stepped: np.ndarray) -> np.ndarray:
        """Rewards of a tick; a margin is compared with that of the episode's tick before."""
        before, acting = self._margin.copy(), stepped & (self.env.tick > 0)
        self._margin[acting] = self.env.judge.margin.numpy()[acting]
        rewards = np.where(acting & (self._outcome == "success"), 1.0, 0.0)
        if self.reward == "margin":
            with np.errstate(invalid="ignore"):
                change = self._margin - before
            rewards[acting] += np.where(np.isfinite(change), change, 0.0)[acting]
        return rewards

    def _look(self, mask: np.ndarray) -> None:
        """Take what the worlds of a mask show now; the others keep what they showed."""
        if not mask.any():
            return
        state = self.env.observe().state.cpu().numpy()
        self._state[mask] = state[mask]
        for name, camera in self._cameras.items():
            self._pixels[name][mask] = self.env.render(camera, mask).cpu().numpy()[mask]

    def _observation(self) -> Observations:
        """The last look at every world, as arrays of the caller's own."""
        shown: Observations = {name: self._state.copy() for name in self._state_keys}
        if self._pixels:
            pixels = {name: picture.copy() for name, picture in self._pixels.items()}
            shown["pixels"] = pixels if self._named else pixels[""]
        if self._instruction:
            shown["task"] = (self.task_description,) * self.num_envs
        return {name: shown[name] for name in self._observed}

    def _facts(self) -> dict[str, np.ndarray]:
        """Values of `info` for every world."""
        return {
            "startup": (self.env.tick < 0) & ~self._over,
            "seed": self._seed.copy(),
            "episode_seed": self._episode_seed.copy(),
            "steps": np.maximum(self.env.tick, 0),
            "is_success": self._outcome == "success",
        }

    def _info(self, mask: np.ndarray) -> Info:
        """Info as Gymnasium packs it, `key` and mask `_key`; how an episode ended is there for worlds that ended."""
        info: Info = {}
        for name, values in self._facts().items():
            info[name], info[f"_{name}"] = values, mask.copy()
        judged = mask & np.isfinite(self._margin)  # from an episode's first tick on
        info["margin"], info["_margin"] = np.where(judged, self._margin, 0.0), judged
        ended = mask & self._over
        if ended.any():
            for name, words in (("outcome", self._outcome), ("reason", self._reason)):
                declared = np.full(self.num_envs, None, dtype=object)
                declared[ended] = words[ended]
                info[name], info[f"_{name}"] = declared, ended.copy()
        return info

    def _final(self, ended: np.ndarray) -> Info:
        """Last observations and info of worlds that the same step resets."""
        observation, last = self._observation(), np.full(self.num_envs, None, dtype=object)
        for world in np.flatnonzero(ended).tolist():
            last[world] = _row(observation, world)
        return {
            "final_obs": last,
            "_final_obs": ended.copy(),
            "final_info": self._info(ended),
            "_final_info": ended.copy(),
        }

    def render(self) -> tuple[np.ndarray, ...] | None:
        """Picture of every world, uint8 [H, W, 3]: the first observed one, or without any the scene's world camera."""
        if self.render_mode is None:
            return None
        if self._pixels:
            return tuple(next(iter(self._pixels.values())).copy())
        if self._film is None:
            self._film = Camera.from_scene(self.env.scene, "world", *STRIP_SIZES["world"], self.env.lights)
        pictures = self.env.render(self._film, self._unfilmed).cpu().numpy()
        self._unfilmed[:] = False
        return tuple(pictures.copy())

    def call(self, name: str, *arguments: object) -> tuple[object, ...]:
        """An attribute of every world, or what a method answers for every world, as Gymnasium's own batches have it.

        Raises:
            AttributeError: There is no such attribute.
        """
        value = getattr(self, name)
        if callable(value):
            value = value(*arguments)
            if isinstance(value, tuple) and len(value) == self.num_envs:
                return value
        return (value,) * self.num_envs

    def get_attr(self, name: str) -> tuple[object, ...]:
        """An attribute of every world.

        Raises:
            AttributeError: There is no such attribute.
        """
        return self.call(name)

    def close_extras(self) -> None:
        """Release the worlds."""
        if hasattr(self, "env"):
            self.env.close()


class ArenaGymEnv(gymnasium.Env[Observations, np.ndarray]):
    """One world of a task as a Gymnasium environment; many worlds are far cheaper in one `ArenaVectorEnv`."""

    metadata: dict[str, Any] = {key: ArenaVectorEnv.metadata[key] for key in ("render_modes", "render_fps")}

    def __init__(self, task: str, *, render_mode: str | None = None, **options: object):
        """Build the world.

        Args:
            task: Task name.
            render_mode: `rgb_array`, or None.
            options: Those of `ArenaVectorEnv`, without `num_envs` and `autoreset_mode`.

        Raises:
            InputError: Something named in the message is unknown or does not fit.
        """
        for name in ("num_envs", "autoreset_mode"):
            if name in options:
                raise InputError(f"{name}: belongs to make_vec, this environment is one world")
        given = cast("dict[str, Any]", options)
        self.batch = ArenaVectorEnv(task, 1, render_mode=render_mode, autoreset_mode=AutoresetMode.DISABLED, **given)
        """The batch of one world."""
        self.render_mode = render_mode
        self.observation_space = self.batch.single_observation_space
        self.action_space = self.batch.single_action_space

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, object] | None = None
    ) -> tuple[Observations, Info]:
        """Begin episode `seed` of the plan, or the next one; see `ArenaVectorEnv.reset`."""
        super().reset(seed=seed)
        if options:
            raise InputError(f"options {', '.join(sorted(options))}: unknown, there are none")
        observation, info = self.batch.reset(seed=seed)
        return _row(observation, 0), _row_of_info(info)

    def step(self, action: np.ndarray) -> tuple[Observations, float, bool, bool, Info]:
        """Advance by one tick under a canonical action, float32, shape [40]; after the end nothing moves."""
        observation, reward, terminated, truncated, info = self.batch.step(np.asarray(action)[None])
        flags = bool(terminated[0]), bool(truncated[0])
        return _row(observation, 0), float(reward[0]), *flags, _row_of_info(info)

    def render(self) -> np.ndarray | None:
        """The picture, uint8 [H, W, 3]; see `ArenaVectorEnv.render`."""
        pictures = self.batch.render()
        return None if pictures is None else pictures[0]

    def close(self) -> None:
        """Release the world."""
        self.batch.close()


def _row(observation: Observations, world: int) -> Observations:
    """Observation of one world."""
    row: Observations = {}
    for name, value in observation.items():
        if isinstance(value, dict):
            row[name] = _row(value, world)
        else:
            row[name] = cast("Sequence[object]", value)[world]
    return row


def _row_of_info(info: Info) -> Info:
    """Info of the one world of a batch, as Python's own types; what its mask leaves out is left out."""
    found: Info = {}
    for name, values in info.items():
        if not name.startswith("_") and cast("np.ndarray", info[f"_{name}"])[0]:
            value = cast("np.ndarray", values)[0]
            found[name] = value.item() if isinstance(value, np.generic) else value
    return found


def _choice(name: str, given: str, known: Sequence[str]) -> str:
    if given not in known:
        raise InputError(f"{name} {given}: unknown, choose from {', '.join(known)}")
    return given


def _at_least_1(name: str, given: int) -> int:
    if given < 1:
        raise InputError(f"{name} {given}: must be at least 1")
    return int(given)


def _size(given: Sequence[int], where: str = "image_size", other: str = "") -> tuple[int, int]:
    if len(given) != 2 or min(given) < 1:
        raise InputError(f"{where} {list(given)}: expected width and height of at least 1 [px]{other}")
    return int(given[0]), int(given[1])


def _autoreset_mode(given: AutoresetMode | str) -> AutoresetMode:
    if isinstance(given, AutoresetMode):
        return given
    known = {mode.value.lower(): mode for mode in AutoresetMode} | {mode.name.lower(): mode for mode in AutoresetMode}
    if given.lower() not in known:
        names = ", ".join(mode.name for mode in AutoresetMode)
        raise InputError(f"autoreset_mode {given}: unknown, choose from {names}")
    return known[given.lower()]


def env_id(task: str) -> str:
    """Gymnasium's id of a task: `vis_navi` is arena_newton/VisNavi-v0, `pp_box` arena_newton/PPBox-v0.

    A word of two letters is an abbreviation and written in capitals.
    """
    words = [word.upper() if len(word) == 2 else word.capitalize() for word in task.split("_")]
    return f"{NAMESPACE}/{''.join(words)}-v0"


def register() -> None:
    """Register every task with Gymnasium that is not registered yet."""
    for task in task_registry.names():
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                env_id(task),
                entry_point=f"{__name__}:{ArenaGymEnv.__name__}",
                vector_entry_point=f"{__name__}:{ArenaVectorEnv.__name__}",
                kwargs={"task": task},
            )


register()
