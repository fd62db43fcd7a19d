"""One tick from a canonical action to actuator targets: the same under episodes, the tracker suite and the oracle.

Tasks, rules and episodes are unknown here, and the physics step is the caller's:

    loop = TrackerLoop(physics, scene.robot, tracker)
    loop.fresh(every, prefill=True)      # the tracker forgets its past
    loop.anchor(every)                   # heading and reference from the robot as it is now
    loop.tick(action, every)             # action -> reference -> tracker -> ctrl
    physics.step()
"""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from arena_newton.errors import InputError
from arena_newton.interfaces import NEEDS, RobotState, TrackerCommand
from arena_newton.kernels import canonical
from arena_newton.kernels import tick as kernels
from arena_newton.kernels.launching import record
from arena_newton.physics.dynamics import Delay, value_of
from arena_newton.robot import g1
from arena_newton.robot.canonical import ACTION_WIDTH, STAND_ACTION

if TYPE_CHECKING:
    from arena_newton.interfaces import Physics, Tracker
    from arena_newton.tasks.handles import RobotHandles

__all__ = ["TrackerLoop", "WorldMask"]

JOINTS = len(g1.MUJOCO_JOINTS)
NUMBERS = itertools.count(1)
"""Numbers of the loops, by which a tracker knows the one that it belongs to."""


class WorldMask:
    """A choice of worlds on the device; uploaded only when it changes."""

    def __init__(self, worlds: int, device: wp.Device):
        """Choose no world of `worlds`; `device` is where the arrays are stored."""
        self.warp = wp.zeros(worlds, dtype=wp.int32, device=device)
        """1 = chosen, int32, shape [worlds]; the same array for ever, with changing content."""
        self.torch = torch.zeros(worlds, dtype=torch.bool, device=wp.device_to_torch(device))
        """The same as bool, shape [worlds]."""
        self._host = np.zeros(worlds, dtype=bool)
        self._bytes = self._host.tobytes()

    def choose(self, mask: np.ndarray) -> WorldMask:
        """Take the worlds of a host mask, bool, shape [worlds]; returns itself."""
        given = mask.tobytes()  # compared in a tenth of the time of `np.array_equal`
        if given != self._bytes:
            self._host[:], self._bytes = mask, given
            self.warp.assign(self._host.astype(np.int32))
            self.torch.copy_(torch.from_numpy(self._host))
        return self


class TrackerLoop:
    """The reference that actions integrate to, the tracker that follows it, and the actuators it drives.

    All masks are host arrays, bool, shape [worlds]. A world outside a call's mask keeps every bit: of its reference and
    its actuator targets always, of its tracker's history where the tracker's `step` takes a mask (a tracker of two
    arguments advances the history of all worlds).
    """

    def __init__(self, physics: Physics, robot: RobotHandles, tracker: Tracker, *, worlds: int | None = None):
        """Allocate buffers and bind the tracker to the worlds.

        Args:
            physics: What moves; its `qpos`, `qvel` and `ctrl` are used.
            robot: Where the robot is in them; a robot with fixed hands has no `hand_ctrl`.
            tracker: A tracker; it belongs to this loop from now on.
            worlds: Number of worlds, the physics' by default.
        """
        self.physics, self.robot, self.tracker = physics, robot, tracker
        self.worlds = physics.worlds if worlds is None else worlds
        self.device: wp.Device = physics.device
        self.torch_device: torch.device = wp.device_to_torch(self.device)
        self.reference = canonical.ReferencePose.allocate(
            self.worlds, self.device, canonical_to_mujoco=g1.CANONICAL_TO_MUJOCO, tick=g1.TICK
        )
        """Integrated actions of each world."""
        self.bad_action = wp.zeros(self.worlds, dtype=wp.int32, device=self.device)
        """Flag of `kernels.canonical` of the last tick's action, 0 = it could be executed, shape [worlds]."""
        self.bad_targets = wp.zeros(self.worlds, dtype=wp.int32, device=self.device)
        """1 = a joint target of the last tick was not finite, shape [worlds]."""
        self._action = wp.zeros((self.worlds, ACTION_WIDTH), dtype=wp.float32, device=self.device)
        self._targets = wp.zeros((self.worlds, JOINTS), dtype=wp.float32, device=self.device)
        self.action: torch.Tensor = wp.to_torch(self._action)
        """Actions of the last tick as they were executed, shape [worlds, 40]; may be written before a tick."""
        self.targets: torch.Tensor = wp.to_torch(self._targets)
        """Joint targets of the last tick [rad], MuJoCo order, own buffer, shape [worlds, 29]."""
        self._stand = wp.array(STAND_ACTION, dtype=wp.float32, device=self.device)
        self._joint_ctrl, self._hand_ctrl = self._ints(robot.joint_ctrl), self._ints(robot.hand_ctrl)
        fingers = len(robot.hand_ctrl)
        self._hand_close = self._floats((g1.HAND_CLOSE_LEFT + g1.HAND_CLOSE_RIGHT)[:fingers])
        self._hand_open = self._floats((g1.HAND_OPEN * 2)[:fingers])
        self._qpos, self._qvel = wp.to_torch(physics.qpos), wp.to_torch(physics.qvel)
        self._joint_qpos, self._joint_qvel = self._indices(robot.joint_qpos), self._indices(robot.joint_qvel)
        self._to_mujoco = self._indices(g1.MUJOCO_TO_CANONICAL)
        self._ref_joints, self._ref_vel = wp.to_torch(self.reference.joints), wp.to_torch(self.reference.joint_vel)

        def joints() -> torch.Tensor:
            return torch.zeros(self.worlds, JOINTS, device=self.torch_device)

        root, vel = robot.root_qpos, robot.root_qvel
        self.command = TrackerCommand(
            mimic=wp.to_torch(self.reference.mimic),
            joints=joints(),
            joint_vel=joints(),
            quat=wp.to_torch(self.reference.quat),
        )
        """Reference of the last tick, as the tracker got it."""
        self.state = RobotState(
            quat=self._qpos[:, root + 3 : root + 7],
            ang_vel_body=self._qvel[:, vel + 3 : vel + 6],
            joint_pos=joints(),
            joint_vel=joints(),
        )
        """Robot of the last tick, as a tracker gets it without latency; the root's numbers are live views of the
        physics."""
        self._late: tuple[Delay, Delay] | None = None
        """Latencies of the tracker's state and of the joint targets; None until a world has one."""
        self.measured: Callable[[RobotState], RobotState] | None = None
        """Sensors, which change the state that the tracker gets; None: they are exact."""
        self.lookahead: int = getattr(tracker, "lookahead", 0)
        """Coming references that the tracker reads [ticks]."""
        self._give(getattr(tracker, "needs", ()))
        self._prefill = np.zeros(self.worlds, dtype=bool)
        self._ticking = WorldMask(self.worlds, self.device)
        self._chosen = WorldMask(self.worlds, self.device)
        self._integrate, self._drive = record(self._launch_integrate), record(self._launch_drive)
        self._takes_mask = "mask" in inspect.signature(tracker.step).parameters
        tracker.bind(self.worlds, self.torch_device)
        self._number = next(NUMBERS)
        tracker.loop = self._number

    def _check_tracker(self) -> None:
        """Refuse to go on with a tracker that another loop has bound since: its past would be that of other worlds."""
        if self.tracker.loop != self._number:
            why = "another environment has bound this object since; make a tracker for each environment"
            raise InputError(f"tracker {self.tracker.name}: {why}")

    def _give(self, needs: Sequence[str]) -> None:
        """Give the tracker the further fields that it declares; all but the window are live views."""
        command, state, robot = self.command, self.state, self.robot
        for name in set(needs) - set(NEEDS):
            raise InputError(f"tracker {self.tracker.name}: needs {name!r}; known are {', '.join(NEEDS)}")
        if "position" in needs:
            command.position = wp.to_torch(self.reference.position)
            state.position = self._qpos[:, robot.root_qpos : robot.root_qpos + 3]
        if "lin_vel" in needs:
            state.lin_vel = self._qvel[:, robot.root_qvel : robot.root_qvel + 3]
        if "foot_force" in needs:
            self.physics.want_forces = True
            left, right = robot.feet
            state.foot_force = wp.to_torch(self.physics.contact_force)[:, left : right + 1 : right - left]
        if not self.lookahead:
            return
        command.ahead = command.mapped(lambda t: t.new_zeros(self.worlds, self.lookahead, t.shape[1]))
        self._announced: torch.Tensor | None = None
        self._later = canonical.ReferencePose.allocate(
            self.worlds, self.device, canonical_to_mujoco=g1.CANONICAL_TO_MUJOCO, tick=g1.TICK
        )
        self._later_action = wp.zeros_like(self._action)
        self._later_bad, self._later_mask = (wp.zeros(self.worlds, dtype=wp.int32, device=self.device) for _ in "bm")

    def _ints(self, values: np.ndarray) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.int32), dtype=wp.int32, device=self.device)

    def _floats(self, values: Sequence[float]) -> wp.array:
        return wp.array(np.asarray(values, dtype=np.float32), dtype=wp.float32, device=self.device)

    def _indices(self, values: Sequence[int] | np.ndarray) -> torch.Tensor:
        return torch.as_tensor(np.asarray(values), dtype=torch.long, device=self.torch_device)

    def _launch_integrate(self) -> None:
        """Check the actions and integrate them into the reference."""
        canonical.launch_validate_action(self._action, self.bad_action)
        kernels.launch_sanitize(self.bad_action, self._stand, self._action)
        turn = self.tracker.max_root_delta_deg
        canonical.launch_integrate(self.reference, self._action, self._ticking.warp, turn)

    def _launch_drive(self) -> None:
        """Check the targets and write them into the actuators."""
        ctrl, fingers = self.physics.ctrl, (self._hand_ctrl, self._hand_open, self._hand_close)
        kernels.launch_check_targets(self._targets, self._joint_ctrl, ctrl, self.bad_targets)
        hands, mask = self.reference.hands, self._ticking.warp
        kernels.launch_write_ctrl(self._targets, self._joint_ctrl, hands, *fingers, mask, ctrl)

    def anchor(self, mask: np.ndarray) -> None:
        """Take heading and reference of the masked worlds from the robot as it is now."""
        chosen = self._chosen.choose(mask)
        canonical.launch_reset_reference(self.reference, self.physics.qpos, self.robot.root_qpos, chosen.warp)

    def fresh(self, mask: np.ndarray, *, prefill: bool) -> None:
        """Make the tracker forget the past of the masked worlds.

        Args:
            mask: Worlds whose history ends.
            prefill: Fill the history with the first frame at the next tick, instead of leaving it as the tracker's
                `reset` made it.

        Raises:
            InputError: Another loop has bound the tracker since.
        """
        self._check_tracker()
        self.tracker.reset(self._chosen.choose(mask).torch)
        self._prefill[mask] = prefill
        for late in self._late or ():
            late.forget(self._chosen.torch)

    def delay(self, worlds: np.ndarray, samples: Sequence[Mapping[str, float]]) -> None:
        """Give worlds the latencies of samples of the dynamics, at their reset before `fresh`.

        The tracker gets the state as it was `state_latency` ticks ago, and its joint targets reach the actuators
        `action_latency` ticks later; hands open and close at once.

        Args:
            samples: Values of `modes.QUANTITIES`, one mapping per world.
        """
        if self._late is None:
            if not any(samples):
                return
            width = sum(part.shape[1] for part in self.state.tensors().values())
            self._late = Delay(self.worlds, width, self.torch_device), Delay(self.worlds, JOINTS, self.torch_device)
        for late, name in zip(self._late, ("state_latency", "action_latency"), strict=True):
            ticks = [int(value_of(sample, name)) for sample in samples]
            late.ticks[torch.from_numpy(worlds).to(self.torch_device)] = torch.tensor(ticks, device=self.torch_device)

    def _late_state(self, mask: torch.Tensor) -> RobotState:
        """Robot as its latency lets the tracker see it."""
        if self._late is None:
            return self.state
        return RobotState(**self._late[0].late_parts(self.state.tensors(), mask))

    def announce(self, coming: torch.Tensor) -> None:
        """Take the actions that follow the next tick's, for a tracker with a lookahead; they count for that tick alone.

        Args:
            coming: Canonical actions, shape [worlds, n, 40]. From a row's first action on that cannot be executed, such
                as NaN, the last reference before it is repeated, as it is after n; all are without an announcement.
        """
        self._announced = coming

    def _look_ahead(self) -> None:
        """Integrate the announced actions into the window of coming references, which the reference itself ignores."""
        command, window = self.command, self.command.ahead
        assert window is not None
        now = {name: tensor for name, tensor in command.tensors().items() if not name.startswith("ahead.")}
        for name, tensor in now.items():
            getattr(window, name).copy_(tensor[:, None].expand(-1, self.lookahead, -1))
        coming, self._announced = self._announced, None
        if coming is None or not coming.shape[1]:
            return
        later, turn = self._later, self.tracker.max_root_delta_deg
        for name, array in vars(self.reference).items():
            if isinstance(array, wp.array):
                wp.copy(getattr(later, name), array)
        self._later_mask.fill_(1)
        mask, bad, action = (wp.to_torch(a) for a in (self._later_mask, self._later_bad, self._later_action))
        whole = {name: wp.to_torch(getattr(later, name)) for name in now}
        count = min(self.lookahead, coming.shape[1])
        for k in range(count):
            action.copy_(coming[:, k])
            canonical.launch_validate_action(self._later_action, self._later_bad)
            mask.mul_(bad == 0)
            canonical.launch_integrate(later, self._later_action, self._later_mask, turn)
            for name, tensor in whole.items():
                canonical_order = name in ("joints", "joint_vel")
                getattr(window, name)[:, k] = tensor[:, self._to_mujoco] if canonical_order else tensor
        for tensor in window.tensors().values():
            tensor[:, count:] = tensor[:, count - 1 : count]

    def tick(self, action: torch.Tensor, mask: np.ndarray) -> torch.Tensor:
        """Turn one action per world into actuator targets; the physics moves on the caller's `physics.step()`.

        Args:
            action: Canonical actions, shape [worlds, 40]; `self.action` itself costs no copy. One that cannot be
                executed is replaced by the standing action and flagged in `bad_action`.
            mask: Worlds that tick.

        Returns:
            `self.targets`.

        Raises:
            InputError: The tracker's answer is not a float32 tensor of one row per world, or another loop has bound the
                tracker since.
        """
        self._check_tracker()
        ticking = self._ticking.choose(mask).torch
        if action is not self.action:
            self.action.copy_(action)
        self._integrate()
        command, state = self.command, self.state
        torch.index_select(self._ref_joints, 1, self._to_mujoco, out=command.joints)
        torch.index_select(self._ref_vel, 1, self._to_mujoco, out=command.joint_vel)
        torch.index_select(self._qpos, 1, self._joint_qpos, out=state.joint_pos)
        torch.index_select(self._qvel, 1, self._joint_qvel, out=state.joint_vel)
        if self.lookahead:
            self._look_ahead()
        state = self._late_state(ticking)
        if self.measured is not None:
            state = self.measured(state)
        first = self._prefill & mask
        if first.any():
            self.tracker.prefill(command, state, self._chosen.choose(first).torch)
            self._prefill[first] = False
        if mask.all():
            self._take(self.tracker.step(command, state))
        elif self._takes_mask:
            self._take(self.tracker.step(command, state, ticking), ticking)
        else:
            self._take(self.tracker.step(command, state), ticking)
        if self._late is not None:
            targets = self._late[1].late(self.targets)
            self._late[1].keep(self.targets, ticking)
            torch.where(ticking[:, None], targets, self.targets, out=self.targets)
        self._drive()
        return self.targets

    def _take(self, targets: torch.Tensor, mask: torch.Tensor | None = None) -> None:
        """Copy a tracker's answer, its masked rows or all, into the loop's own buffer."""
        expected = self.targets.shape
        if not isinstance(targets, torch.Tensor) or targets.shape != expected or targets.dtype != torch.float32:
            given = f"{targets.dtype} {list(targets.shape)}" if hasattr(targets, "dtype") else type(targets).__name__
            raise InputError(
                f"tracker {self.tracker.name}: joint targets are {given}, expected a torch.float32 tensor of shape "
                f"{list(expected)}"
            )
        if mask is None:
            self.targets.copy_(targets)
        else:
            torch.where(mask[:, None], targets, self.targets, out=self.targets)
