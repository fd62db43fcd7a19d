"""Plug-in of LeRobot's command line for our worlds: flags, features, and the making of a batch."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import TYPE_CHECKING

from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs.configs import EnvConfig
from lerobot.processor import ObservationProcessorStep, PolicyProcessorPipeline
from lerobot.utils.constants import ACTION, OBS_ENV_STATE, OBS_IMAGES, OBS_STATE

from arena_newton import tasks as task_registry
from arena_newton.cli.flags import user_path
from arena_newton.errors import InputError
from arena_newton.eval.adapters.lerobot_env.policy_worlds import PolicyWorlds, policy_worlds
from arena_newton.pictures.settings import CAMERAS, CameraConfig, Fit
from arena_newton.policies.chunk_flags import LABELS
from arena_newton.robot.canonical import ACTION_WIDTH, STATE_WIDTH

if TYPE_CHECKING:
    from gymnasium.vector import VectorEnv

__all__ = ["ArenaNewtonEnv", "DropRepeated"]

FPS = 50
"""Ticks per second."""
REPEATED = (f"observation.{OBS_STATE}", f"observation.{OBS_ENV_STATE}")
"""Names that LeRobot gives to observations that have a dataset's name already."""
FITS = ("pad", "native")
"""`pictures.settings.Fit`."""
logger = logging.getLogger(__name__)


@dataclass
class DropRepeated(ObservationProcessorStep):  # type: ignore[misc]  # LeRobot's classes are Any to a type checker
    """Drops what is observed under a dataset's name, for `--eval.recording`; policies get it as `observation.state`."""

    def observation(self, observation: dict[str, object]) -> dict[str, object]:
        """The observation without its second copies of state and task vector."""
        return {key: value for key, value in observation.items() if key not in REPEATED}

    def transform_features(self, features: dict[str, object]) -> dict[str, object]:
        """Features are those of the policy already."""
        return features


@EnvConfig.register_subclass("arena_newton")
@dataclass
class ArenaNewtonEnv(EnvConfig):  # type: ignore[misc]  # as above
    """Worlds of one task, or of several one after the other; `--env.<field>` on LeRobot's command line."""

    task: str | None = "vis_navi"
    """Task name, several with commas between, or `all`."""
    fps: int = FPS
    """Ticks per second; the world has no other."""
    tracker: str = "twist2"
    """Tracker that executes actions."""
    checkpoint: str | None = None
    """Its weights; those of the package when none are named."""
    mode: str = "base"
    """The test mode, as of `--mode`."""
    rules: str = "paper"
    """Rule set."""
    engine: str = "auto"
    """`auto`, `mujoco` or `warp`."""
    device: str | None = None
    """Device of the worlds and of the tracker, such as `cpu` or `cuda:0`."""
    variant_file: str | None = None
    """USD layer instead of the one task's own scene."""
    fast_physics: bool = False
    """Use the tracker's fast physics rate."""
    cameras: str | None = None
    """Observed cameras, with commas between: front, left_wrist, right_wrist, world; the policy's, or front."""
    image_width: int | None = None
    """Width of pictures [px]; the policy's, or 224."""
    image_height: int | None = None
    """Height of pictures [px]; the policy's, or 224."""
    fit: Fit | None = None
    """`pad` or `native`: how the camera's 4:3 picture goes into another size; the policy's, or `pad`."""
    episode_length: int | None = None
    """Cap on the step budget of the rule set [ticks]."""
    labels: str | None = None
    """Protocol of the policy's actions: v3.1, or v4, which is decoded per world; the policy's, or v3.1."""
    realign: float | None = None
    """Fraction of the gap between commanded and measured heading that v4 closes each tick; the policy's."""
    query_ticks: int | None = None
    """Ticks between two queries of the policy, at which `realign` of v4 measures the heading: its n_action_steps."""
    task_vector: str | None = None
    """Tasks in the order of the one-hot vector that the policy is given, with commas between; the policy's, or none."""
    tracker_vector: str | None = None
    """Trackers in the order of the numbers that follow in it, after which one is that of any other; the policy's."""
    episodes: str | None = None
    """Folder that gets what LeRobot's files leave out: a line per episode, and its actions for `replay:`."""

    def __post_init__(self) -> None:
        """Take over what the policy of `--policy.path` says of itself, and name the features.

        Raises:
            InputError: An unknown task, camera or protocol, a number that is out of range, another number of ticks
                per second than the world has, or a damaged file of the policy.
        """
        if self.fps != FPS:
            raise InputError(f"--env.fps {self.fps}: the world has {FPS} ticks per second")
        if self.max_parallel_tasks != 1:  # threads would break captured CUDA graphs
            raise InputError(
                f"--env.max_parallel_tasks {self.max_parallel_tasks}: tasks run one after the other, use 1"
            )
        declared = policy_worlds()
        if declared.source is not None:
            logger.info("%s says %s; flags that are given count more", declared.source, declared.sentence)
        worlds = self.policy_worlds = PolicyWorlds(
            labels=declared.labels if self.labels is None else self.labels,
            realign=declared.realign if self.realign is None else self.realign,
            query_ticks=declared.query_ticks if self.query_ticks is None else self.query_ticks,
            task_vector=declared.task_vector if self.task_vector is None else _names(self.task_vector),
            tracker_vector=declared.tracker_vector if self.tracker_vector is None else _names(self.tracker_vector),
            cameras=self._pictures(declared),
        )
        if worlds.labels not in LABELS:
            raise InputError(f"--env.labels {worlds.labels}: unknown, choose from {', '.join(LABELS)}")
        if self.fit not in (None, *FITS):
            raise InputError(f"--env.fit {self.fit}: unknown, choose from {', '.join(FITS)}")
        if not 0.0 <= worlds.realign <= 1.0:
            raise InputError(f"--env.realign {worlds.realign}: expected 0 to 1")
        if worlds.query_ticks < 1:
            raise InputError(f"--env.query_ticks {worlds.query_ticks}: expected at least 1")
        for task in self.tasks:
            task_registry.get(task)
            if worlds.task_vector and task not in worlds.task_vector:
                raise InputError(f"--env.task {task}: the policy was trained on {', '.join(worlds.task_vector)}")
        self.features = {
            ACTION: PolicyFeature(FeatureType.ACTION, (ACTION_WIDTH,)),
            OBS_STATE: PolicyFeature(FeatureType.STATE, (STATE_WIDTH,)),
            **{
                f"{OBS_IMAGES}.{name}": PolicyFeature(FeatureType.VISUAL, (one.height, one.width, 3))
                for name, one in worlds.cameras.items()
            },
        }
        if worlds.task_vector:
            width = len(worlds.task_vector) + (len(worlds.tracker_vector) + 1 if worlds.tracker_vector else 0)
            self.features[OBS_ENV_STATE] = PolicyFeature(FeatureType.ENV, (width,))
        self.features_map = {key: key for key in self.features}

    @property
    def tasks(self) -> tuple[str, ...]:
        """Task names."""
        names = _names(self.task or "")
        if not names:
            raise InputError("--env.task: nothing named, at least one task is needed")
        return task_registry.PAPER if names == ("all",) else names

    def _pictures(self, declared: PolicyWorlds) -> dict[str, CameraConfig]:
        """Cameras by their names in datasets: the policy's, with what the flags change."""
        names = tuple(declared.cameras) if self.cameras is None else _names(self.cameras)
        usual = next(iter(declared.cameras.values()))
        for flag, pixels in (("image_width", self.image_width), ("image_height", self.image_height)):
            if pixels is not None and pixels < 1:
                raise InputError(f"--env.{flag} {pixels}: expected at least 1 [px]")
        found = {}
        for name in names:
            if name not in CAMERAS:
                raise InputError(f"--env.cameras {name}: unknown, choose from {', '.join(CAMERAS)}")
            one = declared.cameras.get(name, usual)
            size = self.image_width or one.width, self.image_height or one.height
            found[name] = CameraConfig(*size, CAMERAS[name], self.fit or one.fit)
        return found

    @property
    def gym_kwargs(self) -> dict[str, object]:
        """Options of `arena_newton.eval.adapters.gym.ArenaVectorEnv`.

        The start-up is inside the reset, so that a policy is first asked at step 0; ended worlds are frozen until
        LeRobot's next rollout. The state has its name of datasets too: a recording of LeRobot has columns by it.
        """
        return {
            "tracker": self.tracker,
            "checkpoint": self.checkpoint,
            "mode": self.mode,
            "rules": self.rules,
            "engine": self.engine,
            "device": self.device,
            "variant_file": self.variant_file,
            "fast_physics": self.fast_physics,
            "cameras": self.policy_worlds.cameras,
            "state_keys": ("agent_pos", OBS_STATE),
            "instruction": False,
            "startup": "reset",
            "autoreset_mode": "disabled",
            "max_episode_steps": self.episode_length,
        }

    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """One batch of worlds per task, as {task: {0: batch}}.

        Args:
            n_envs: Worlds in a batch, LeRobot's `--eval.batch_size`.
            use_async_envs: Ignored: the worlds of a batch are simulated at once, in this process.
        """
        from arena_newton.eval.adapters.lerobot_env.labelled_worlds import make_worlds

        folder = None if self.episodes is None else user_path(self.episodes)
        made: dict[str, dict[int, VectorEnv]] = {}
        for task in self.tasks:
            made[task] = {0: make_worlds(task, n_envs, self.policy_worlds, folder, self.gym_kwargs)}
        return made

    def get_env_processors(self) -> tuple[PolicyProcessorPipeline, PolicyProcessorPipeline]:
        """Processors of observations before the policy's own ones, and of actions after them."""
        return PolicyProcessorPipeline(steps=[DropRepeated()]), PolicyProcessorPipeline(steps=[])


def _names(given: str) -> tuple[str, ...]:
    """Names of a list with commas."""
    return tuple(name.strip() for name in given.split(",") if name.strip())
