"""Interfaces of the world, the trackers and the policies: the records that pass between them, and each one's promises.

Nothing here behaves, and nothing here imports a room above it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Protocol, Self

if TYPE_CHECKING:
    import mujoco
    import newton
    import numpy as np
    import torch
    import warp as wp

    from arena_newton.physics.scene import Scene
    from arena_newton.pictures.camera import Camera, WorldLights
    from arena_newton.pictures.settings import CameraConfig
    from arena_newton.robot.g1 import DriveGains, PhysicsRate
    from arena_newton.tasks.base import TaskSpec
    from arena_newton.tracking import TrackerLoop

__all__ = [
    "Chunk",
    "Disturbance",
    "EpisodeEvent",
    "EpisodeResult",
    "Judge",
    "NEEDS",
    "Observation",
    "Physics",
    "Planned",
    "Policy",
    "Predicate",
    "Recorder",
    "RobotState",
    "Spawn",
    "Tracker",
    "TrackerCommand",
    "Verdict",
    "World",
]

Spawn = Callable[[int], tuple[Sequence[float], Sequence[float]]]
"""Episode seed → the robot's root position [m] and orientation wxyz at the reset."""


@dataclass
class Observation:
    """Observation of a policy; rows are worlds."""

    state: torch.Tensor
    """Canonical state, float32, shape [worlds, 64]."""
    image: torch.Tensor | None
    """Head camera, uint8, shape [worlds, H, W, 3]; None when the policy needs none: `images["front"]`."""
    mask: np.ndarray
    """Worlds that ask for a new chunk, bool, shape [worlds]."""
    task: str
    """Task name."""
    gym_id: str
    """The original benchmark's task id (sent to policy servers)."""
    instruction: str
    """Natural-language instruction."""
    tracker: str = ""
    """Name of the tracker that executes the actions; empty: not known."""
    images: Mapping[str, torch.Tensor] = field(default_factory=dict)
    """Pictures of all cameras that the policy wants, by their names, each as `image`."""
    depths: Mapping[str, torch.Tensor] = field(default_factory=dict)
    """Distance along the ray to what each pixel of a picture shows [m], 0 where it shows nothing, float16, shape
    [worlds, H, W]; of cameras with `depth`, and of worlds that ask."""

    def __post_init__(self) -> None:
        """Complete `image` and `images` by each other."""
        if self.image is not None and not self.images:
            self.images = {"front": self.image}
        self.image = self.images.get("front")


@dataclass
class Chunk:
    """A policy's answer."""

    actions: torch.Tensor | np.ndarray
    """Canonical actions, float32, shape [worlds, n, 40]; only rows of the asking worlds are read."""
    errors: dict[int, str] = field(default_factory=dict)
    """World → what went wrong; those episodes end as `error`, the others go on."""
    phases: Sequence[str | None] | None = None
    """Name of the phase that each world is in from this chunk on, where the policy knows phases; rows as `actions`."""


class _Tensors:
    """Base of records whose fields are tensors, or None where a tracker does not declare them."""

    def tensors(self) -> dict[str, torch.Tensor]:
        """Fields that are given, by their names; those of `ahead` with it in front, such as `ahead.joints`."""
        found = {}
        for name, value in vars(self).items():
            if isinstance(value, _Tensors):
                found |= {f"{name}.{inner}": tensor for inner, tensor in value.tensors().items()}
            elif value is not None:
                found[name] = value
        return found

    def mapped(self, change: Callable[[torch.Tensor], torch.Tensor]) -> Self:
        """The same record of changed tensors."""
        made: dict[str, Any] = {}
        for name, value in vars(self).items():
            made[name] = (
                value.mapped(change) if isinstance(value, _Tensors) else value if value is None else change(value)
            )
        return type(self)(**made)


NEEDS = ("position", "lin_vel", "foot_force")
"""Fields of `RobotState` and `TrackerCommand` that are None, unless the tracker names them in its `needs`."""


@dataclass
class RobotState(_Tensors):
    """Measured robot state; rows are worlds, joints in MuJoCo order."""

    quat: torch.Tensor
    """Root orientation wxyz, shape [worlds, 4]."""
    ang_vel_body: torch.Tensor
    """Root angular velocity in the body frame [rad/s], shape [worlds, 3]."""
    joint_pos: torch.Tensor
    """[rad], shape [worlds, 29]."""
    joint_vel: torch.Tensor
    """[rad/s], shape [worlds, 29]."""
    position: torch.Tensor | None = None
    """Root position in the world [m], shape [worlds, 3]."""
    lin_vel: torch.Tensor | None = None
    """Velocity of the root's origin in the world frame [m/s], shape [worlds, 3]."""
    foot_force: torch.Tensor | None = None
    """Norm of the net contact force on left and right foot in the last physics step [N], shape [worlds, 2]."""


@dataclass
class TrackerCommand(_Tensors):
    """The reference of one tick; rows are worlds, joints in MuJoCo order."""

    mimic: torch.Tensor
    """TWIST2's mimic command, shape [worlds, 35]."""
    joints: torch.Tensor
    """Reference joint positions [rad], shape [worlds, 29]."""
    joint_vel: torch.Tensor
    """Backward difference of the reference joints [rad/s], shape [worlds, 29]."""
    quat: torch.Tensor
    """Reference root orientation in the world, wxyz, shape [worlds, 4]."""
    position: torch.Tensor | None = None
    """Reference root position in the world [m], shape [worlds, 3]."""
    ahead: TrackerCommand | None = None
    """References of the next `lookahead` ticks, for trackers that declare it; fields have shape [worlds, lookahead, n].

    They come from the policy's chunk. Where it ends earlier, its last reference is repeated; without any later action
    it is the reference of this tick."""


@dataclass(frozen=True)
class Predicate:
    """One step on the way to a task's success, such as `approach` or `contact`."""

    name: str
    sentence: str
    """Condition of the predicate, in one sentence."""


@dataclass(frozen=True)
class EpisodeEvent:
    """Something that happened once in an episode."""

    kind: str
    """`contact`: a critical body was pressed for the first time; `object_out`; `fall`."""
    tick: int
    """Ticks since step 0."""
    detail: str = ""
    """Trigger of a fall (`tilt`, `tilt_held`, `contact`), name of an object."""


@dataclass(frozen=True)
class Verdict:
    """Judgement of one world's episode so far, by the judge and the physics."""

    margin: float
    """Signed distance to success [m or the task's unit]."""
    overflow: bool = False
    """A contact or constraint buffer overflowed."""
    predicates: Mapping[str, int | None] = field(default_factory=dict)
    """Predicate of the task, in its order → first tick since step 0 at which it held; None where it never did."""
    progress: float = 0.0
    """Fraction of the task's predicates that have held, in [0, 1]; 1 after a success."""
    events: tuple[EpisodeEvent, ...] = ()
    """Events in the order of their ticks."""


@dataclass
class EpisodeResult:
    """Ending of one planned episode."""

    episode: Any
    """The plan's object, a `Planned`."""
    outcome: str
    """`success`, `fall`, `timeout` or `error`."""
    reason: str
    """Finer cause, such as `ball_out`, `startup_fall`, `nonfinite_state`."""
    steps: int
    """Control ticks executed after the start-up."""
    margin: float
    """Signed distance to success at the end."""
    startup_fall: bool = False
    """The robot fell in the start-up, before the policy acted."""
    overflow: bool = False
    """A contact or constraint buffer overflowed in this episode's world."""
    sim_s: float = 0.0
    """Simulated time [s]."""
    wall_s: float = 0.0
    """Wall-clock time from reset to end [s]."""
    error: str | None = None
    """Message of an `error`."""
    phases: tuple[tuple[str, int], ...] = ()
    """The policy's phases: name and first tick since step 0, each time one begins."""
    predicates: Mapping[str, int | None] = field(default_factory=dict)
    """Predicates as in `Verdict`."""
    progress: float = 0.0
    """Progress as in `Verdict`."""
    events: tuple[EpisodeEvent, ...] = ()
    """Events as in `Verdict`."""
    extra: dict[str, float] = field(default_factory=dict)
    """Metrics of recorders by name, which `Recorder.finish` may add: finite numbers."""


class Planned(Protocol):
    """An episode of a plan, as far as the world must know it."""

    @property
    def episode_seed(self) -> int:
        """Everything random about the episode follows from it."""


class Tracker(Protocol):
    """Turns the reference of one 50 Hz tick into 29 joint targets for every world at once (`trackers.base`)."""

    name: str
    drive: DriveGains
    original_drive: DriveGains | None
    physics_rate: PhysicsRate
    fast_physics_rate: PhysicsRate
    max_root_delta_deg: float
    needs: Sequence[str]
    lookahead: int
    loop: int

    def rate(self, *, fast: bool = False) -> PhysicsRate:
        """Physics step and substeps per tick."""

    def bind(self, worlds: int, device: Any = "cpu") -> None:
        """Allocate buffers for `worlds` worlds on a torch device."""

    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of the worlds in `mask`, bool, shape [worlds]; all without one."""

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the observation history of the masked worlds with the current frame."""

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Joint targets of this tick [rad], MuJoCo order, shape [worlds, 29]; valid until the next call.

        Args:
            command: Reference of the tick.
            state: Measured state.
            mask: Worlds that advance, bool, shape [worlds]; all without one. The history of the others stays as it is,
                bit for bit, and their rows of the answer mean nothing.
        """

    def describe(self) -> dict[str, Any]:
        """Facts to record with every result so that this tracker is named exactly, as JSON."""


class Policy(Protocol):
    """Looks at all worlds that ask and answers a chunk of canonical actions for each (`policies.base`)."""

    name: str
    needs_image: bool

    def attach(self, env: World) -> None:
        """Get to know the environment before its first episode."""

    def reset(self, seeds: Sequence[int], tasks: Sequence[str], mask: np.ndarray | None = None) -> None:
        """Begin new episodes in the worlds of `mask`; `seeds` are for noise alone (`seeding.policy_seed`)."""

    def act(self, observation: Observation) -> Chunk:
        """Actions for the worlds that ask."""


class Physics(Protocol):
    """A batch of worlds that moves (`arena_newton.physics.engines`): Warp arrays in MuJoCo's layout, a row a world."""

    engine: str
    worlds: int
    device: wp.Device
    qpos: wp.array
    """Positions, shape [worlds, nq]."""
    qvel: wp.array
    """Velocities, shape [worlds, nv]."""
    ctrl: wp.array
    """Actuator targets, shape [worlds, nu]."""
    xpos: wp.array
    """Body positions [m], shape [worlds, nbody, 3]."""
    xquat: wp.array
    """Body orientations wxyz, shape [worlds, nbody, 4]."""
    xipos: wp.array
    """Body centres of mass [m], shape [worlds, nbody, 3]."""
    contact_force: wp.array
    """Norm of the net contact force on each body [N], shape [worlds, nbody]."""
    want_forces: bool
    """Fill `contact_force` every tick (otherwise only in worlds tilted beyond 60°, engine `mujoco`)."""

    @property
    def models(self) -> Sequence[mujoco.MjModel]:
        """One MuJoCo model for all worlds, or one per world."""

    @property
    def external_force(self) -> wp.array:
        """Force [N] and torque [N·m] on each body, world frame, float32, shape [worlds, nbody, 6].

        Acts at the body's centre of mass and stays until it is changed or the world is reset.
        """

    def add_velocity(self, change: np.ndarray, mask: np.ndarray | None = None) -> None:
        """Add to the robot root's velocity: linear [m/s], world frame; angular [rad/s], body frame; [worlds, 6]."""

    def set_dynamics(self, worlds: np.ndarray, samples: Sequence[Mapping[str, float]]) -> None:
        """Give worlds the friction, masses and gains of samples of `modes.QUANTITIES`; an empty one, the scene's."""

    def set_active(self, mask: np.ndarray) -> None:
        """Worlds that `step` moves, bool, shape [worlds]; the others keep every bit of their state."""

    def step(self) -> None:
        """Advance the active worlds by one 50 Hz tick under the present `ctrl`."""

    def snapshot(self) -> Any:
        """Everything that the next tick depends on, as an opaque value for `restore`."""

    def restore(self, snapshot: Any, mask: np.ndarray | None = None) -> None:
        """Put the masked worlds (all without a mask) back into the state of a snapshot, bit for bit."""

    def write_newton_state(self, state: newton.State) -> None:
        """Write body poses into a Newton state, for rendering."""

    def overflowed(self, world: int) -> bool:
        """True if a contact or constraint buffer overflowed in this world since its reset."""

    def close(self) -> None:
        """Release threads; the physics steps no more."""


class Judge(Protocol):
    """Judges every world once per tick, on the device (`tasks.base`)."""

    success: wp.array
    """1 = success, int32, shape [worlds]."""
    margin: wp.array
    """Signed distance to success, float32, shape [worlds]."""
    event: wp.array
    """0 nothing, otherwise one of the task's events, int32, shape [worlds]."""
    predicates: wp.array
    """1 where a predicate of the task holds at this tick, int32, [worlds, n], columns as `TaskSpec.predicates`."""
    counters: list[wp.array]
    """Everything else that the next tick's verdict depends on, rows are worlds: what `reset` clears."""

    def evaluate(self, physics: Any) -> None:
        """Fill the outputs for the state after this tick."""

    def reset(self, mask: wp.array) -> None:
        """Forget the past of the worlds in `mask`, int32, shape [worlds], 1 = reset."""


class World(Protocol):
    """A batch of worlds of one task (`arena_newton.env.ArenaEnv`)."""

    spec: TaskSpec
    scene: Scene
    tracker: Any
    loop: TrackerLoop
    """Turns actions into actuator targets; holds what was executed at the last tick."""
    mode: str
    """Evaluation mode of episodes whose own is not named."""
    modes: list[str]
    """Evaluation mode of each world's episode."""
    worlds: int
    torch_device: torch.device
    startup_ticks: int
    """Length of the start-up [ticks]."""
    tick: np.ndarray
    """Ticks since each world's step 0, int64, shape [worlds]; negative in its start-up."""
    active: np.ndarray
    """Worlds that run an episode, bool, shape [worlds]."""
    budget: int
    """Step budget of the rule set [ticks]."""
    cameras: dict[str, Camera]
    """Cameras of policies that see, by the names of their pictures."""
    camera_configs: dict[str, CameraConfig]
    """Configurations that they were made from."""

    @property
    def camera(self) -> Camera | None:
        """Head camera of policies that see."""

    @property
    def physics(self) -> Physics:
        """Physics engine that moves the worlds."""

    @property
    def lights(self) -> WorldLights:
        """Light of each world, for cameras."""

    def reset(
        self,
        seeds: Sequence[int],
        worlds: Sequence[int] | np.ndarray | None = None,
        *,
        spawn: Spawn | None = None,
        samples: Sequence[Mapping[str, dict[str, float]]] | None = None,
        modes: Sequence[str] | None = None,
    ) -> None:
        """Start an episode in each of `worlds` (all by default) from its episode seed alone."""

    def release(self, worlds: Sequence[int] | np.ndarray) -> None:
        """End the episodes of `worlds`: they stand still until their next reset."""

    def observe(self, mask: np.ndarray | None = None, *, image: bool = False) -> Observation:
        """State of every world and, if asked, the cameras' pictures of the worlds in `mask`."""

    def step(self, action: torch.Tensor | np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance active worlds (those of a bool mask, if given) by one tick.

        Returns:
            Status codes of `arena_newton.kernels.tick`, int32, shape [worlds].
        """

    def render(self, camera: Any, mask: np.ndarray | None = None) -> torch.Tensor:
        """Picture of one camera, uint8, shape [worlds, H, W, 3]."""

    def verdict(self, world: int) -> Verdict:
        """Judgement of a world's episode so far, by the judge and the physics."""

    def describe(self) -> dict[str, Any]:
        """Configuration to record with every result, as JSON."""

    def close(self) -> None:
        """Release the physics' threads; the environment steps no more."""


class Recorder:
    """Base of what looks on while episodes run; `rollout.Rollout` calls it, a subclass overrides what it needs.

    A metric of an episode is added to `EpisodeResult.extra` in `finish`; it must not change the worlds.
    """

    wants_observation: bool = False
    """True if `before_physics` needs the observation of every tick, which costs a kernel launch."""

    def start(self, env: World, world: int, episode: Any) -> None:
        """An episode begins in a world: it was reset."""

    def query(self, env: World, observation: Observation) -> None:
        """The policy is asked: by the worlds in the observation's mask, with what they show it."""

    def before_physics(self, env: World, observation: Observation | None, action: torch.Tensor) -> None:
        """A tick begins.

        Args:
            env: The worlds.
            observation: State of this tick, without a picture unless the policy asked for one at this tick; None where
                no recorder wants observations.
            action: What the policy decided for this tick (the label), float32, shape [worlds, 40]; rows of worlds that
                do not act mean nothing. A disturbance changes what is executed, never this.
        """

    def tick(self, env: World) -> None:
        """A tick is over."""

    def finish(self, env: World, world: int, result: EpisodeResult) -> None:
        """An episode ended; the world still shows its last state."""


Disturbance = Callable[["World", "torch.Tensor"], "torch.Tensor"]
"""(environment, actions [worlds, 40]) → what is executed instead; must not write into its argument."""
