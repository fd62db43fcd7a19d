"""Layers of a tracker around its network: command and state in, observation out; raw output in, joint targets out.

Training and deployment share it, so that a network sees in a rollout what it saw in training:

    observation = front_end.observe(command, state)
    targets = front_end.act(network(observation))

Everything runs on any torch device without waiting for it, so a CUDA graph can hold it.
"""

from __future__ import annotations

import abc
import copy
import functools
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Concatenate, Self

import torch

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.trackers import interface
from arena_newton.trackers.base import Tracker
from arena_newton.trackers.inference import weights_file
from arena_newton.trackers.inference.blocks import BlockRunner
from arena_newton.trackers.inference.networks import Symmetric
from arena_newton.trackers.inference.onnx_session import OnnxSession
from arena_newton.trackers.interface import JOINTS, ActionForm, residual_form

__all__ = [
    "JOINTS",
    "ActionForm",
    "FrontEnd",
    "GradedTracker",
    "Mirror",
    "NetworkTracker",
    "column",
    "plain",
    "residual_form",
    "store",
    "without_gradients",
]


def column(mask: Sequence[bool] | torch.Tensor | None, device: torch.device) -> torch.Tensor | None:
    """A mask of worlds as a bool column on `device`, shape [worlds, 1]; None (all worlds) stays None."""
    return None if mask is None else torch.as_tensor(mask, device=device).to(torch.bool)[:, None]


def store(target: torch.Tensor, value: torch.Tensor, rows: torch.Tensor | None) -> None:
    """Write `value` into `target`, where there is a `column` of worlds into their rows alone."""
    if rows is not None:
        rows = rows.view(-1, *[1] * (target.dim() - 1))
        value = torch.where(rows, value, target)
    target.copy_(value)


def without_gradients[F: FrontEnd, **P, R](
    work: Callable[Concatenate[F, P], R],
) -> Callable[Concatenate[F, P], R]:
    """`torch.no_grad`, which takes 3 µs a call, only where gradients are recorded and the front end is not `graded`."""

    @functools.wraps(work)
    def call(self: F, /, *args: P.args, **kwargs: P.kwargs) -> R:
        if self.graded or not torch.is_grad_enabled():
            return work(self, *args, **kwargs)
        with torch.no_grad():
            return work(self, *args, **kwargs)

    return call


class Mirror:
    """The mirror image (left for right) of rows of numbers: `mirror(x)[:, i] = sign[i] * x[:, index[i]]`."""

    def __init__(self, parts: Sequence[tuple[Sequence[int], Sequence[float]]], device: torch.device | str = "cpu"):
        """Join parts to a row: for each the index within it and the sign of every number."""
        index: list[int] = []
        for positions, _ in parts:
            start = len(index)
            index += [start + i for i in positions]
        self.index = torch.tensor(index, device=device)
        self.sign = torch.tensor([float(s) for _, signs in parts for s in signs], device=device)

    def __call__(self, x: torch.Tensor) -> torch.Tensor:
        """Mirror image of rows, shape [rows, width]."""
        return x.index_select(1, self.index) * self.sign


def plain(*signs: float) -> tuple[Sequence[int], Sequence[float]]:
    """A part of a `Mirror` whose numbers keep their positions."""
    return range(len(signs)), signs


class FrontEnd(abc.ABC):
    """Base of all front ends; a subclass sets the widths and writes `prefill`, `write` and `advance`.

    Where it writes buffers by operations in place (`copy_`, `mul_`) rather than by `out=`, gradients pass (`graded`).
    """

    obs_width: int = 0
    """Width of the observation."""
    action_width: int = JOINTS
    """Width of the raw action."""
    default_pose: tuple[float, ...] = (0.0,) * JOINTS
    """Pose that measured joints are taken relative to [rad], MuJoCo order."""
    needs: Sequence[str] = ()
    """Fields of `interfaces.NEEDS` that it reads."""
    lookahead: int = 0
    """Coming references that it reads [ticks]."""
    graphable: bool = False
    """True if a tick on CUDA is the same operations on the same buffers each time, so that a CUDA graph may hold it."""

    device: torch.device = torch.device("cpu")
    """Device of the buffers; set by `bind`."""
    graded: bool = False
    """True if autograd records the ticks of buffers in float64; see `GradedTracker`."""
    obs: torch.Tensor
    """The observation's buffer, float32, shape [worlds, obs_width]."""
    last_action: torch.Tensor
    """Last raw output, unclipped, shape [worlds, action_width]."""
    base: torch.Tensor
    """Joint positions to which the scaled action is added [rad], MuJoCo order, shape [worlds, 29]."""

    def __init__(self, action_form: ActionForm):
        """Keep the action form; `bind` allocates."""
        self.action_form = action_form

    def bind(self, worlds: int, device: torch.device | str = "cpu", obs: torch.Tensor | None = None) -> None:
        """Allocate buffers; `obs`, if it is given, receives the observation, float32, shape [worlds, obs_width]."""
        self.worlds, self.device = worlds, torch.device(device)
        self.obs = torch.zeros(worlds, self.obs_width, device=self.device) if obs is None else obs
        self.last_action = torch.zeros(worlds, self.action_width, device=self.device)
        self._default = torch.tensor(self.default_pose, device=self.device)
        self._scale = torch.tensor(self.action_form.scale, device=self.device)
        self.base = self._default.repeat(worlds, 1)
        self._targets = torch.zeros(worlds, JOINTS, device=self.device)

    @torch.no_grad()
    def reset(self, mask: torch.Tensor | None = None) -> None:
        """Set observation and last action of the worlds in `mask`, bool, shape [worlds], to zero; all without one."""
        rows = column(mask, self.device)
        for buffer in (self.obs, self.last_action):
            buffer.zero_() if rows is None else buffer.masked_fill_(rows, 0.0)

    @abc.abstractmethod
    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """Fill the observation history of the masked worlds with the current frame."""

    @without_gradients
    def observe(self, command: TrackerCommand, state: RobotState) -> torch.Tensor:
        """Observation of this tick, shape [worlds, obs_width]: the buffer itself, which `act` changes.

        Calling it again before `act` replaces the tick's observation. Copy what you keep.
        """
        if self.action_form.kind == "residual":
            self.base.copy_(command.joints)
        self.write(command, state)
        return self.obs

    @without_gradients
    def act(self, raw: torch.Tensor, mask: torch.Tensor | None = None) -> torch.Tensor:
        """Joint targets [rad], MuJoCo order, shape [worlds, 29]; ends the tick. The buffer is reused by the next call.

        Args:
            raw: The network's output, shape [worlds, action_width].
            mask: Worlds whose histories advance, bool, shape [worlds]; all without one.
        """
        rows = column(mask, self.device)
        store(self.last_action, raw, rows)
        self.advance(rows)
        raw = self.to_mujoco(raw)
        self._targets.copy_(raw)
        if self.action_form.clip > 0.0:
            self._targets.clamp_(-self.action_form.clip, self.action_form.clip)
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
    def advance(self, rows: torch.Tensor | None = None) -> None:
        """Advance the histories by this tick, after `last_action` took the raw output.

        Args:
            rows: Worlds that advance, bool, shape [worlds, 1], for `store`; all without it. The histories of the others
                must keep every bit; the current frame, which every tick writes again, need not.
        """

    def to_mujoco(self, raw: torch.Tensor) -> torch.Tensor:
        """The raw output in MuJoCo order."""
        return raw


class NetworkTracker(Tracker):
    """A front end and the network behind it."""

    card: Mapping[str, Any] = {}
    """Origin of our own weights; empty for other checkpoints."""

    def __init__(
        self,
        front_end: FrontEnd,
        network: torch.nn.Module,
        *,
        checkpoint: str | None = None,
        checkpoint_hash: str = "none",
    ):
        """Join a front end and a network, which maps [rows, obs_width] to [rows, action_width], each row by itself."""
        self.front_end = front_end
        self.needs, self.lookahead = front_end.needs, front_end.lookahead
        self.network = network
        self.checkpoint, self.checkpoint_hash = checkpoint, checkpoint_hash

    @classmethod
    def from_weights(cls, path: str | Path) -> Self:
        """The tracker of a weights file: its network, its drive, its physics rate.

        Raises:
            InputError: The file is absent, damaged or of another interface.
        """
        weights = weights_file.load(path, cls.name)
        front_end = interface.get(cls.name).front_end(weights.action_form)
        network = weights.network.deployed()
        if weights.symmetric:
            obs, action = front_end.mirror_obs(), front_end.mirror_action()
            network = Symmetric(network, (obs.index, obs.sign), (action.index, action.sign)).eval()
        tracker = cls(front_end, network, checkpoint=str(path), checkpoint_hash=weights.sha256[:12])
        tracker.drive, tracker.card = weights.drive, weights.card
        tracker.physics_rate = tracker.fast_physics_rate = weights.physics
        return tracker

    def bind(self, worlds: int, device: torch.device | str = "cpu") -> None:
        """Allocate observation buffers for `worlds` worlds on `device`."""
        super().bind(worlds, device)
        device = torch.device(device)
        for session in [module for module in self.network.modules() if isinstance(module, OnnxSession)]:
            session.convert(device)
        self.network.to(device)
        self._runner = BlockRunner(self.network, self.front_end.obs_width, worlds, device)
        self.front_end.bind(worlds, device, self._runner.input)
        self._graph = _TickGraph(self._tick, worlds, device) if device.type == "cuda" and self._graphable else None
        self.reset()

    def describe(self) -> dict[str, Any]:
        """Facts to record with every result to name this tracker exactly; once bound, the network's runner too."""
        if (runner := getattr(self, "_runner", None)) is None:
            return super().describe()
        return super().describe() | {"inference": runner.path + (", CUDA graph" if self._graph is not None else "")}

    @property
    def _graphable(self) -> bool:
        """True if a CUDA graph may hold a tick: everything runs on the device, by the same operations each time."""
        return self.front_end.graphable and not any(getattr(m, "on_host", False) for m in self.network.modules())

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
        """Fill the observation history of the masked worlds with the current frame: a start is then no jump."""
        self.front_end.prefill(command, state, mask)

    @torch.inference_mode()
    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """See `interfaces.Tracker`; the buffer is reused by the next call."""
        if mask is not None and mask.device.type == "cpu" and bool(mask.all()):
            mask = None
        return (self._graph or self._tick)(command, state, mask)

    def graded(self, worlds: int) -> GradedTracker:
        """See `Tracker.graded`.

        Raises:
            InputError: A network in ONNX Runtime that torch modules cannot repeat.
        """
        if isinstance(self.network, OnnxSession):
            network = self.network.as_torch()
        elif any(isinstance(module, OnnxSession) for module in self.network.modules()):
            raise InputError(f"tracker {self.name} has no gradient: {self.checkpoint} runs in ONNX Runtime")
        else:
            network = copy.deepcopy(self.network)
        return GradedTracker(self.front_end, network.to("cpu", torch.float64).requires_grad_(False), worlds)

    def _tick(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None) -> torch.Tensor:
        self.front_end.observe(command, state)
        return self.front_end.act(self._runner.run(), mask)


class GradedTracker(Tracker):
    """Ticks of a network's tracker that autograd records: its own front end and network, in float64 on the CPU.

    The buffers of the front end are those of one graph; `resumed` continues with others, from what `memory` gives.
    Tensors that are attributes of the front end itself, and not of an object within it, are copied; memory kept
    elsewhere is shared with the tracker that it came from.
    """

    def __init__(self, front_end: FrontEnd, network: torch.nn.Module, worlds: int):
        """Bind a copy of a front end; the network is taken as it is."""
        self._origin, self.network, self.worlds = front_end, network, worlds
        self.front_end = copy.copy(front_end)
        self.front_end.graded = True
        usual = torch.get_default_dtype()
        torch.set_default_dtype(torch.float64)  # of all buffers, those of a subclass too
        try:
            # Views of a buffer without a history could not be written to once another view has got one.
            obs = torch.zeros(worlds, front_end.obs_width, requires_grad=True).clone()
            self.front_end.bind(worlds, obs=obs)
        finally:
            torch.set_default_dtype(usual)
        self.front_end.reset()
        self._buffers = [
            value
            for name, value in vars(self.front_end).items()
            if isinstance(value, torch.Tensor) and value is not vars(front_end).get(name)
            if not value._is_view() and value.dtype != torch.long
        ]

    def memory(self) -> tuple[torch.Tensor, ...]:
        """Buffers from which the next tick starts."""
        return tuple(value.clone() for value in self._buffers)

    def resumed(self, memory: Sequence[torch.Tensor]) -> GradedTracker:
        """The tracker with buffers of its own, which start from a memory."""
        other = GradedTracker(self._origin, self.network, self.worlds)
        for buffer, value in zip(other._buffers, memory, strict=True):
            buffer.copy_(value)
        for view in vars(other.front_end).values():
            getattr(view, "grad_fn", None)  # a view takes the history of its buffer when it is asked for it
        return other

    def prefill(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> None:
        """See `Tracker.prefill`."""
        self.front_end.prefill(command, state, mask)

    def step(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None = None) -> torch.Tensor:
        """See `Tracker.step`; float64, a tensor of its own."""
        observation = self.front_end.observe(command, state).clone()
        return self.front_end.act(self.network(observation), mask).clone()


Tick = Callable[[TrackerCommand, RobotState, torch.Tensor | None], torch.Tensor]


class _TickGraph:
    """A tick held in a CUDA graph: some sixty small launches become one; ticks with a mask have a second graph."""

    def __init__(self, tick: Tick, worlds: int, device: torch.device):
        """Keep the tick, whose first call shows which inputs there are; it must always write the same result buffer."""
        self._tick = tick
        self._command: TrackerCommand
        self._state: RobotState
        self._inputs: list[torch.Tensor] = []
        self._mask = torch.ones(worlds, dtype=torch.bool, device=device)
        self._graphs: dict[bool, tuple[torch.cuda.CUDAGraph, torch.Tensor]] = {}

    def __call__(self, command: TrackerCommand, state: RobotState, mask: torch.Tensor | None) -> torch.Tensor:
        """One tick; the first runs as it is, which makes libraries allocate what they need."""
        if not self._inputs:
            self._command, self._state = command.mapped(torch.empty_like), state.mapped(torch.empty_like)
            self._inputs = [*self._command.tensors().values(), *self._state.tensors().values()]
            return self._tick(command, state, mask)
        torch._foreach_copy_(self._inputs, [*command.tensors().values(), *state.tensors().values()])
        masked = mask is not None
        if mask is not None:
            self._mask.copy_(mask)
        if masked not in self._graphs:
            graph = torch.cuda.CUDAGraph()
            # Other threads may use the device meanwhile.
            with torch.cuda.graph(graph, capture_error_mode="thread_local"):
                targets = self._tick(self._command, self._state, self._mask if masked else None)
            self._graphs[masked] = graph, targets
        graph, targets = self._graphs[masked]
        graph.replay()
        return targets
