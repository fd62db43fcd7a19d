"""The closed loop as one graph of torch in float64: policy, reference, tracker, drives, contacts and margin."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np
import torch
from torch.utils import checkpoint as checkpointing

from arena_newton.differentiable.engine_step import EngineState, EngineStep
from arena_newton.differentiable.judged_margin import Judgement
from arena_newton.differentiable.kernel_gradients import ReferenceState, reference_step
from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, Tracker, TrackerCommand
from arena_newton.kernels import tick as codes
from arena_newton.physics.devices import torch_threads
from arena_newton.physics.dynamics import NOISES, value_of
from arena_newton.physics.mujoco_engine import MujocoPhysics
from arena_newton.physics.policy_view import PolicyView
from arena_newton.pictures.settings import policy_cameras
from arena_newton.robot import g1, rotations
from arena_newton.robot.canonical import ACTION, ACTION_WIDTH, STAND_ACTION
from arena_newton.rollout import ending
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv
    from arena_newton.interfaces import Policy

__all__ = ["Rolled", "closed_loop", "reset_state"]


class Rolled(NamedTuple):
    """Ticks of an episode in every world; tensors are float64 on the CPU and belong to one graph."""

    margin: torch.Tensor
    """Margin to success after each tick [m], shape [ticks, worlds]; without gradients −inf from the tick on in which a
    world fell or failed."""
    qpos: torch.Tensor
    """Positions in MuJoCo's layout at step 0 and after each tick, shape [ticks + 1, worlds, nq]."""
    qvel: torch.Tensor
    """Velocities, shape [ticks + 1, worlds, nv]."""
    actions: torch.Tensor
    """Canonical actions, shape [ticks, worlds, 40]."""
    targets: torch.Tensor
    """Targets of the drives [rad], order of the actuators, shape [ticks, worlds, nu]."""
    factors: torch.Tensor
    """Factors of the model in the order of `parameters`, shape [worlds, parameters]: those given, or leaves at 1."""
    answers: bool
    """True if a gradient leads from the state through the policy to its actions; false for a plan, an expert, and any
    other policy that does not compute them in torch from the observation's state."""
    memory: float
    """Bytes that the graph keeps per tick and world, start-up included."""


def reset_state(env: ArenaEnv, seeds: Sequence[int]) -> EngineState:
    """State of the worlds at the reset of some episodes, of which `closed_loop` takes a moved one as its `start`."""
    env.reset(seeds)
    return EngineStep(env.physics).state()


def closed_loop(
    env: ArenaEnv,
    actor: torch.Tensor | torch.nn.Module | Policy,
    seeds: Sequence[int],
    ticks: int,
    *,
    parameters: Sequence[str] = (),
    factors: torch.Tensor | None = None,
    start: EngineState | None = None,
    truncate: int | None = None,
    checkpoint: int | None = None,
) -> Rolled:
    """Play the first ticks of episodes so that gradients lead from margins, positions and velocities to their causes.

    The worlds are reset, started up, judged and observed as in an evaluation; their own tracker and physics rest.
    Values differ from an evaluation's by rounding alone: all but the engine computes in float32 there.

    Args:
        env: Worlds of engine `mujoco`. All of them start again, and stand still afterwards.
        actor: Canonical actions, shape [worlds, ticks, 40]; a module of torch that gives those of a tick, shape
            [worlds, 40], from canonical states, float64, shape [worlds, 64]; or a policy, asked as `Rollout` asks it.
            Pictures are constants, and so are hands, which are open or closed.
        seeds: Episode seeds, one per world.
        ticks: Ticks from step 0 on.
        parameters: Factors of the model, named as those of `EngineStep`.
        factors: Their values, shape [worlds, parameters]; by default 1, leaves that `Rolled.factors` gives.
        start: State at the reset instead of the drawn one: that of `reset_state`, moved or with leaves for gradients.
        truncate: All that the next tick starts from is detached every so many ticks from step 0 on.
        checkpoint: Of so many ticks at a time the graph keeps the start alone; a gradient computes them again.

    Raises:
        InputError: An engine, tracker or parameter without gradient, a tensor of another shape, or a policy's error.
            Where gradients are recorded (not under `torch.no_grad`), also an episode that ended before the last tick or
            by a fall; and, when it is computed, a gradient that is not finite.
    """
    shape = env.worlds, ticks, ACTION_WIDTH
    if isinstance(actor, torch.Tensor) and actor.shape != shape:
        raise InputError(f"closed_loop: actions of shape {list(actor.shape)}, expected {list(shape)}")
    env.reset(list(seeds))
    try:
        with torch_threads(1):  # on a busy machine two take twenty times longer for products of a few rows
            loop = _Loop(env, EngineStep(env.physics, parameters), factors)
            return loop.run(actor, list(seeds), ticks, start, truncate or 0, checkpoint or 0)
    finally:
        env.release(range(env.worlds))


_WITHOUT = ("state_latency", "action_latency", "push", *NOISES)
"""Dynamics of an episode that are not part of the loop."""


class _Graded(Tracker, Protocol):
    """A tracker with ticks that autograd records (`trackers.Tracker.graded`)."""

    def memory(self) -> tuple[torch.Tensor, ...]: ...

    def resumed(self, memory: Sequence[torch.Tensor]) -> _Graded: ...


class _Carry(NamedTuple):
    """All that the next tick starts from."""

    state: EngineState
    reference: ReferenceState
    memory: tuple[torch.Tensor, ...]

    @classmethod
    def of(cls, flat: Sequence[torch.Tensor]) -> _Carry:
        first, second = len(EngineState._fields), len(EngineState._fields) + len(ReferenceState._fields)
        return cls(EngineState(*flat[:first]), ReferenceState(*flat[first:second]), tuple(flat[second:]))

    def flat(self) -> tuple[torch.Tensor, ...]:
        return *self.state, *self.reference, *self.memory


Decide = Callable[[EngineState, ReferenceState], torch.Tensor]
"""The next actions in a state, shape [n, worlds, 40]."""


class _Loop:
    """One call of `closed_loop`."""

    def __init__(self, env: ArenaEnv, step: EngineStep, factors: torch.Tensor | None):
        self._env, self._step, self._all = env, step, np.ones(env.worlds, dtype=bool)
        assert isinstance(env.physics, MujocoPhysics)  # of any other there is no `EngineStep`
        self._physics = env.physics
        if not hasattr(env.tracker, "graded"):
            raise InputError(f"tracker {env.tracker.name} has no gradient: it defines no graded()")
        if env.loop.lookahead or "foot_force" in getattr(env.tracker, "needs", ()):
            raise InputError(f"tracker {env.tracker.name} has no gradient: it needs later references or foot forces")
        for name, draws in itertools.product(_WITHOUT, env.draws):
            if draws is not None and value_of(draws.dynamics, name) > 0.0:
                raise InputError(f"closed_loop: mode {env.mode} draws a {name}, which has no gradient")
        self._tracker: _Graded = env.tracker.graded(env.worlds)
        if factors is None:
            factors = torch.ones(env.worlds, len(step.parameters), dtype=torch.float64)
            factors.requires_grad_(bool(step.parameters))
        self._factors, self._graded = factors, torch.is_grad_enabled()
        robot = env.scene.robot
        self._root = slice(robot.root_qpos, robot.root_qpos + 7)
        self._speed = slice(robot.root_qvel, robot.root_qvel + 6)
        order = robot.joint_qpos, robot.joint_qvel, robot.joint_ctrl, robot.hand_ctrl
        self._at, self._moving, self._joints, self._hands = (torch.tensor(np.asarray(part)).long() for part in order)
        fingers = len(robot.hand_ctrl)
        hands = (g1.HAND_OPEN * 2)[:fingers], (g1.HAND_CLOSE_LEFT + g1.HAND_CLOSE_RIGHT)[:fingers]
        self._open, self._closed = torch.tensor(hands, dtype=torch.float64)
        self._live = self._all.copy()
        self._judgements: list[Judgement] = []
        """Judgement of each tick that was played, start-up included."""

    def run(
        self,
        actor: torch.Tensor | torch.nn.Module | Policy,
        seeds: list[int],
        ticks: int,
        start: EngineState | None,
        truncate: int,
        checkpoint: int,
    ) -> Rolled:
        env, first = self._env, -self._env.startup_ticks
        self._last = ticks
        start = self._step.state() if start is None else start
        for world, row in enumerate(zip(start.qpos.detach().numpy(), start.qvel.detach().numpy(), strict=True)):
            self._physics.put(world, *row)
        decide, answers = self._decides(actor, seeds), False
        carry = _Carry(start, self._anchored(start), self._tracker.memory())
        chunk = torch.from_numpy(STAND_ACTION).double().expand(-first, env.worlds, -1)
        rows: list[tuple[torch.Tensor, ...]] = []
        states: list[EngineState] = []
        with _graph_bytes(actor, getattr(self._tracker, "network", None)) as kept:
            tick = first
            while tick < ticks:
                if tick == 0:
                    env.observe()  # at step 0 the reference starts where the robot is
                    carry = carry._replace(reference=self._anchored(carry.state))
                    states, rows = [carry.state], []
                if truncate and tick > 0 and tick % truncate == 0:
                    carry = _Carry.of([part.detach() for part in carry.flat()])
                if not len(chunk):
                    chunk = decide(carry.state, carry.reference)[: ticks - tick]
                    answers = answers or (chunk.requires_grad and not isinstance(actor, torch.Tensor))
                stops = [(tick // every + 1) * every - tick for every in (truncate, checkpoint) if every]
                actions, chunk = chunk.tensor_split([min([len(chunk), *stops])])
                if checkpoint:
                    for part in (*carry.flat(), actions):
                        kept.add(part)
                    work = self._part, tick, actions, *carry.flat()
                    found = checkpointing.checkpoint(*work, use_reentrant=False, preserve_rng_state=False)
                else:
                    found = self._part(tick, actions, *carry.flat())
                for number, action in enumerate(actions):
                    qpos, qvel, targets = found[3 * number : 3 * number + 3]
                    states.append(EngineState(qpos, qvel, start.carried))
                    rows.append((action, targets))
                carry = _Carry.of(found[3 * len(actions) :])
                tick += len(actions)
            margins = [
                judgement.margin(self._step, state)
                for judgement, state in zip(self._judgements[-first:], states[1:], strict=True)
            ]
        qpos, qvel = torch.stack([state.qpos for state in states]), torch.stack([state.qvel for state in states])
        actions, targets = (torch.stack(column) for column in zip(*rows, strict=True))
        per_tick = kept.bytes / (env.worlds * (ticks - first))
        return Rolled(torch.stack(margins), qpos, qvel, actions, targets, self._factors, answers, per_tick)

    def _anchored(self, state: EngineState) -> ReferenceState:
        return ReferenceState.anchored(state.qpos[:, self._root])

    def _decides(self, actor: torch.Tensor | torch.nn.Module | Policy, seeds: list[int]) -> Decide:
        """The actor as a function of the state."""
        env = self._env
        if isinstance(actor, torch.Tensor):
            plan = actor.cpu().double().transpose(0, 1)
            return lambda state, reference: plan
        if isinstance(actor, torch.nn.Module):
            return lambda state, reference: actor(self._canonical(state, reference)).double()[None]
        view, sees = PolicyView(env), bool(policy_cameras(actor))
        actor.attach(view)
        actor.reset([seeding.policy_seed(seed) for seed in seeds], [env.spec.gym_id] * env.worlds, self._all)

        def decide(state: EngineState, reference: ReferenceState) -> torch.Tensor:
            view.refresh()
            seen, exact = env.observe(self._all, image=sees), self._canonical(state, reference).float()
            # The environment's numbers, with the graph's gradient.
            answer = actor.act(dataclasses.replace(seen, state=seen.state.cpu() + (exact - exact.detach())))
            for world, message in answer.errors.items():
                raise InputError(f"closed_loop: world {world}: policy {actor.name}: {message}")
            return torch.as_tensor(answer.actions).cpu().double().transpose(0, 1)

        return decide

    def _canonical(self, state: EngineState, reference: ReferenceState) -> torch.Tensor:
        """Canonical state as `kernels.canonical.launch_state64` has it, shape [worlds, 64]."""
        quat = rotations.quat_multiply(rotations.quat_from_yaw(-reference.heading), state.qpos[:, self._root][:, 3:])
        columns = rotations.matrix_from_quat(torch.nn.functional.normalize(quat, dim=1))[..., :2].flatten(1)
        order = list(g1.CANONICAL_TO_MUJOCO)
        return torch.cat([columns, state.qpos[:, self._at[order]], state.qvel[:, self._moving[order]]], dim=1)

    def _part(self, begin: int, actions: torch.Tensor, *flat: torch.Tensor) -> tuple[torch.Tensor, ...]:
        """Some ticks: qpos, qvel and targets of each, then all that the next tick starts from."""
        known = any(part.requires_grad for part in (actions, *flat, self._factors))
        with torch.set_grad_enabled(known and torch.is_grad_enabled()):
            return self._played(begin, actions, _Carry.of(flat))

    def _played(self, begin: int, actions: torch.Tensor, carry: _Carry) -> tuple[torch.Tensor, ...]:
        state, reference, tracker = carry.state, carry.reference, self._tracker.resumed(carry.memory)
        env, found = self._env, list[torch.Tensor]()
        for tick, action in enumerate(actions, begin):
            mimic, reference = reference_step(action, reference, max_root_delta_deg=env.tracker.max_root_delta_deg)
            joint_vel = reference.joint_vel[:, list(g1.MUJOCO_TO_CANONICAL)]
            command = TrackerCommand(mimic, mimic[:, 6:], joint_vel, reference.quat, reference.position)
            root, speed = state.qpos[:, self._root], state.qvel[:, self._speed]
            joints = state.qpos[:, self._at], state.qvel[:, self._moving]
            robot = RobotState(root[:, 3:], speed[:, 3:], *joints, position=root[:, :3], lin_vel=speed[:, :3])
            if tick == -env.startup_ticks and env.rules.startup.prefill:
                tracker.prefill(command, robot)
            driven = tracker.step(command, robot)
            targets = driven.new_zeros(env.worlds, env.physics.nu).index_copy(1, self._joints, driven)
            closes = (action[:, ACTION["hands"]] >= 0.5).repeat_interleave(len(self._hands) // 2, dim=1)
            targets = targets.index_copy(1, self._hands, torch.where(closes, self._closed, self._open))
            state = self._step(state, targets, self._factors)
            if state.qpos.requires_grad:
                state.qpos.register_hook(_finite(tick))
            if tick + env.startup_ticks == len(self._judgements):  # not where a part is computed again
                self._judge(tick)
            found += [state.qpos, state.qvel, targets]
        return *found, *_Carry(state, reference, tracker.memory()).flat()

    def _judge(self, tick: int) -> None:
        """Judge the tick in the environment's own worlds.

        Raises:
            InputError: Gradients are recorded and an episode has ended.
        """
        env = self._env
        self._physics.set_active(self._all)
        self._physics.follow(self._step.data)
        status = env.judge_tick(self._all)
        self._live &= (status == codes.RUNNING) | (status == codes.SUCCESS)
        self._judgements.append(Judgement(env, self._live))
        for world, code in enumerate(status.tolist() if self._graded else ()):
            found = ending(env, code, tick + 1, env.budget)
            if found is not None and (tick + 1 < self._last or found[0] in ("fall", "error")):
                raise InputError(
                    f"closed_loop: world {world} ended after tick {tick + 1} ({found[1]}), across which a gradient has "
                    f"no meaning: ask for fewer ticks than {self._last}, or use torch.no_grad()"
                )


def _finite(tick: int) -> Callable[[torch.Tensor], None]:
    def check(gradient: torch.Tensor) -> None:
        if not gradient.isfinite().all():
            raise InputError(f"closed_loop: the gradient to the state after tick {tick + 1} is not finite")

    return check


class _Kept:
    """Bytes of the tensors that a graph keeps."""

    def __init__(self, constants: set[int]):
        self._seen, self.bytes = constants, 0

    def add(self, tensor: torch.Tensor) -> tuple[torch.Tensor, int]:
        """Count a tensor's memory once; returns it with its version."""
        memory = tensor.untyped_storage()
        if memory.data_ptr() not in self._seen:
            self._seen.add(memory.data_ptr())
            self.bytes += memory.nbytes()
        return tensor, tensor._version


def _unchanged(kept: tuple[torch.Tensor, int]) -> torch.Tensor:
    tensor, version = kept
    if tensor._version != version:
        raise InputError("closed_loop: a tensor that the gradient needs was written again, by a tracker or a policy")
    return tensor


@contextlib.contextmanager
def _graph_bytes(*modules: object) -> Iterator[_Kept]:
    """Count what the graph keeps of the block, weights of the modules aside."""
    networks = [module for module in modules if isinstance(module, torch.nn.Module)]
    weights = {t.untyped_storage().data_ptr() for one in networks for t in (*one.parameters(), *one.buffers())}
    kept = _Kept(weights)
    with torch.autograd.graph.saved_tensors_hooks(kept.add, _unchanged):
        yield kept
