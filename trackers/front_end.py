"""What stands around a tracker's network: command and state in, observation out; raw output in, joint targets out.

Training and deployment share it, so that a network meets in a rollout what it met in training:

    observation = front_end.observe(command, state)
    targets = front_end.act(network(observation))

Everything runs on any torch device without waiting for it, so a CUDA graph can hold it.
"""

from __future__ import annotations

import abc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot import MUJOCO_JOINTS, DriveGains
from arena_newton.trackers.base import Tracker
from arena_newton.trackers.inference import networks
from arena_newton.trackers.inference.blocks import BlockRunner

if TYPE_CHECKING:
    from arena_newton.trackers.inference.weights_file import Weights

__all__ = ["ActionForm", "FrontEnd", "Mirror", "NetworkTracker", "residual_form"]

JOINTS = len(MUJOCO_JOINTS)


@dataclass(frozen=True)
class ActionForm:
    """How a network's raw output becomes joint targets: base + scale * clip(raw)."""

    kind: str
    """`default`: the base is the tracker's default pose. `residual`: the base is the reference of the tick."""
    scale: tuple[float, ...]
    """Radians per unit of raw output, 29, MuJoCo order."""
    clip: float = 0.0
    """Largest magnitude of the raw output that counts, 0 = no limit."""

    def __post_init__(self) -> None:
        if self.kind not in ("default", "residual"):
            raise InputError(f"action form {self.kind!r}: known are default, residual")
        if len(self.scale) != JOINTS or self.clip < 0.0:
            raise InputError(f"action form {self.kind!r}: needs {JOINTS} scales and a clip of at least 0")


def residual_form(drive: DriveGains, clip: float = 6.0) -> ActionForm:
    """Corrections of the reference joints; one unit asks a quarter of a joint's torque limit of its spring.

    Args:
        drive: The drive that executes the targets.
        clip: Largest magnitude of the raw output that counts.
    """
    return ActionForm("residual", tuple(0.25 * e / k for e, k in zip(drive.effort, drive.kp, strict=True)), clip)


class Mirror:
    """The mirror image (left for right) of rows of numbers: `mirror(x)[:, i] = sign[i] * x[:, index[i]]`."""

    def __init__(self, parts: Sequence[tuple[Sequence[int], Sequence[float]]], device: torch.device | str = "cpu"):
        """Put parts side by side.

        Args:
            parts: For each part the index within it and the sign of every number.
            device: Torch device of the rows.
        """
        index: list[int] = []
        for places, _ in parts:
            start = len(index)
            index += [start + i for i in places]
        self.index = torch.tensor(index, device=device)
        self.sign = torch.tensor([float(s) for _, signs in parts for s in signs], device=device)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Mirror image of rows, shape [rows, width]."""
        return x.index_select(1, self.index) * self.sign


def plain(*signs: float) -> tuple[Sequence[int], Sequence[float]]:
    """A part of a `Mirror` whose numbers stay in their places."""
    return range(len(signs)), signs


class FrontEnd(abc.ABC):
    """Base of all front ends; a subclass sets the widths and writes `reset`, `write` and `advance`."""

    interface: str = ""
    """Name of the interface in weights files, such as `twist2`."""
    obs_width: int = 0
    """Width of the observation."""
    action_width: int = JOINTS
    """Width of the raw action."""
    default_pose: tuple[float, ...] = (0.0,) * JOINTS
    """Pose that measured joints are taken relative to [rad], MuJoCo order."""
    graphable: bool = False
    """Whether a tick on CUDA is the same operations on the same buffers each time, so that a CUDA graph may hold it."""

    device: torch.device = torch.device("cpu")
    """Where the buffers live; set by `bind`."""
    obs: torch.Tensor
    """The observation's buffer, float32, shape [worlds, obs_width]."""
    last_action: torch.Tensor
    """Last raw output, unclipped, shape [worlds, action_width]."""
    base: torch.Tensor
    """What the scaled action is added to [rad], MuJoCo order, shape [worlds, 29]."""

    def __init__(self, action_form: ActionForm):
        """Keep the action form; `bind` allocates."""
        self.action_form = action_form

    def bind(self, worlds: int, device: Any = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers.

        Args:
            worlds: Number of worlds.
            device: Torch device.
            obs: Buffer for the observation, float32, shape [worlds, obs_width]; a new one by default.
        """
        self.worlds, self.device = worlds, torch.device(device)
        self.obs = torch.zeros(worlds, self.obs_width, device=self.device) if obs is None else obs
        self.last_action = torch.zeros(worlds, self.action_width, device=self.device)
        self._default = torch.tensor(self.default_pose, device=self.device)
        self._scale = torch.tensor(self.action_form.scale, device=self.device)
        self.base = self._default.repeat(worlds, 1)
        self._targets = torch.zeros(worlds, JOINTS, device=self.device)

    @abc.abstractmethod
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of the worlds in `mask` (all without one); shape [worlds], bool."""

    @abc.abstractmethod
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Pretend that the worlds in `mask` have held this command and state for a while."""

    @torch.no_grad()
    def observe(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Observation of this tick, shape [worlds, obs_width]: the buffer itself, which `act` changes.

        Calling it again before `act` replaces the tick's observation. Whoever keeps it must copy it.
        """
        if self.action_form.kind == "residual":
            self.base.copy_(command.joints)
        self.write(command, state)
        return self.obs

    @torch.no_grad()
    def act(self, raw: torch.Tensor) -> torch.Tensor:
        """Joint targets [rad], MuJoCo order, shape [worlds, 29]; ends the tick. The buffer is reused by the next call.

        Args:
            raw: The network's output, shape [worlds, action_width].
        """
        self.last_action.copy_(raw)
        self.advance()
        raw = self.to_mujoco(raw)
        if self.action_form.clip > 0.0:
            torch.clamp(raw, -self.action_form.clip, self.action_form.clip, out=self._targets)
        else:
            self._targets.copy_(raw)
        return self._targets.mul_(self._scale).add_(self.base)

    def mirror_obs(self) -> Mirror:
        """Mirror image of an observation; for symmetric weights and a mirror loss."""
        raise NotImplementedError(f"{type(self).__name__} has no mirror image: no mirror loss and no symmetric weights")

    def mirror_action(self) -> Mirror:
        """Mirror image of a raw action; for symmetric weights and a mirror loss."""
        raise NotImplementedError(f"{type(self).__name__} has no mirror image: no mirror loss and no symmetric weights")

    @abc.abstractmethod
    def write(self, command: TrackerCommand, state: RobotState) -> None:
        """Write this tick's observation into `obs`."""

    @abc.abstractmethod
    def advance(self) -> None:
        """Move histories on, after `last_action` took the raw output."""

    def to_mujoco(self, raw: torch.Tensor) -> torch.Tensor:
        """The raw output in MuJoCo order."""
        return raw


class NetworkTracker(Tracker):
    """A front end and the network behind it."""

    card: Mapping[str, Any] = {}
    """How our own weights came to be; empty for other checkpoints."""

    def __init__(
        self,
        front_end: FrontEnd,
        network: Callable[[torch.Tensor], torch.Tensor],
        *,
        checkpoint: str | None = None,
        checkpoint_hash: str = "none",
    ):
        """Join the two.

        Args:
            front_end: Makes observations and targets.
            network: Maps [rows, obs_width] to [rows, action_width], each row by itself; modules move to the device.
            checkpoint: File the weights came from.
            checkpoint_hash: First 12 hexadecimal digits of its SHA-256.
        """
        self.front_end = front_end
        self.network = network
        self.checkpoint, self.checkpoint_hash = checkpoint, checkpoint_hash

    def follow(self, weights: Weights, front_end: FrontEnd, checkpoint: str | Path) -> None:
        """Become the tracker of a weights file: its network, its drive, its physics rate.

        Args:
            weights: The file's content.
            front_end: Front end of its interface and action form.
            checkpoint: The file.
        """
        network = weights.network.deployed()
        if weights.symmetric:
            obs, action = front_end.mirror_obs(), front_end.mirror_action()
            network = networks.Symmetric(network, (obs.index, obs.sign), (action.index, action.sign)).eval()
        NetworkTracker.__init__(
            self,
            front_end,
            network,
            checkpoint=str(checkpoint),
            checkpoint_hash=weights.sha256[:12],
        )
        self.drive, self.card = weights.drive, weights.card
        self.physics_rate = self.fast_physics_rate = weights.physics

    def bind(self, worlds: int, device: Any = "cpu", scene: Any = None) -> None:
        """Allocate observation buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device, scene)
        device = torch.device(device)
        if isinstance(self.network, torch.nn.Module):
            self.network.to(device)
        self._runner = BlockRunner(self.network, self.front_end.obs_width, worlds, device)
        self.front_end.bind(worlds, device, self._runner.input)
        self._graph = _TickGraph(self._tick, worlds, device) if device.type == "cuda" and self._graphable else None
        self.reset()

    def describe(self) -> dict[str, Any]:
        """What a result must record to name this tracker exactly; once it is bound, what runs its network too."""
        inference = self._inference()
        return super().describe() | ({} if inference is None else {"inference": inference})

    def _inference(self) -> str | None:
        runner = getattr(self, "_runner", None)
        if runner is None:
            return None
        if runner.fixed:
            runner.plan()
        return f"{runner.path}, CUDA graph" if self._graph is not None else runner.path

    @property
    def _graphable(self) -> bool:
        """Whether a CUDA graph may hold a tick: everything runs on the device, by the same operations each time."""
        if not (self.front_end.graphable and isinstance(self.network, torch.nn.Module)):
            return False
        return not any(getattr(module, "on_host", False) for module in self.network.modules())

    @property
    def last_action(self) -> torch.Tensor:
        """Last raw network output, unclipped, shape [worlds, action_width]."""
        return self.front_end.last_action

    def observation(self) -> torch.Tensor:
        """The observation's buffer, shape [worlds, obs_width]; after a step its histories hold that step already."""
        return self.front_end.obs

    @torch.inference_mode()
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Forget the past of the worlds in `mask` (all without one); shape [worlds], bool."""
        self.front_end.reset(mask)

    @torch.inference_mode()
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the history of the worlds in `mask` with the present: a start is then no jump for the network."""
        self.front_end.prefill(command, state, mask)

    @torch.inference_mode()
    def step(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Joint targets of this tick [rad], MuJoCo order, shape [worlds, 29]; the buffer is reused by the next call."""
        return self._tick(command, state) if self._graph is None else self._graph(command, state)

    def _tick(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        self.front_end.observe(command, state)
        return self.front_end.act(self._runner.run())


class _TickGraph:
    """A tick held in a CUDA graph: some sixty small launches become one."""

    def __init__(self, tick: Callable[[TrackerCommand, RobotState], torch.Tensor], worlds: int, device: torch.device):
        """Allocate the inputs that the graph reads.

        Args:
            tick: What to hold; it always writes the same result buffer.
            worlds: Number of worlds.
            device: A CUDA device.
        """
        self._tick = tick

        def row(width: int) -> torch.Tensor:
            return torch.zeros(worlds, width, device=device)

        self._command = TrackerCommand(mimic=row(35), joints=row(JOINTS), joint_vel=row(JOINTS), quat=row(4))
        self._state = RobotState(quat=row(4), ang_vel_body=row(3), joint_pos=row(JOINTS), joint_vel=row(JOINTS))
        self._inputs = [*vars(self._command).values(), *vars(self._state).values()]
        self._graph: torch.cuda.CUDAGraph | None = None
        self._targets = row(0)
        self._warm = False

    def __call__(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """One tick; the first runs as it is, which makes libraries allocate what they need."""
        if not self._warm:
            self._warm = True
            return self._tick(command, state)
        torch._foreach_copy_(self._inputs, [*vars(command).values(), *vars(state).values()])
        if self._graph is None:
            graph = torch.cuda.CUDAGraph()
            # Other threads may use the device meanwhile.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                self._targets = self._tick(self._command, self._state)
            self._graph = graph
        self._graph.replay()
        return self._targets


def column(values: Sequence[bool] | torch.Tensor, device: torch.device) -> torch.Tensor:
    """A mask of worlds as a bool column on `device`, shape [worlds, 1]."""
    return torch.as_tensor(values, device=device).to(torch.bool)[:, None]
