"""The training environment: one class for all tracker interfaces, rsl_rl's `VecEnv`.

A tick: raw actions become joint targets through the tracker's own front end, the physics advances 20 ms, the new state
is rewarded against the reference frame that was commanded, worlds that ended start again elsewhere in the library, and
the front end makes the next observation of the next command. Everything is masked writes over all worlds; nothing
waits for the device. The evaluation's tick (`arena_newton.tracking`) is not used here: its masks are read on the host,
which would synchronise the GPU and break the CUDA graphs, and its command is integrated from actions where this one is
read from the library.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from arena_newton.errors import InputError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.kernels.newton_state import LOST_CONTACTS
from arena_newton.physics.dynamics import Delay
from arena_newton.robot import rotations
from arena_newton.robot.g1 import DEFAULT_POSE, TICK
from arena_newton.trackers.train.graphs import captured
from arena_newton.trackers.train.references import FEET, KEY_LINKS, Frame, ReferenceBank
from arena_newton.trackers.train.sampling import ClipSampler
from arena_newton.trackers.train.simulation import Simulation
from arena_newton.trackers.train.tally import Tally
from arena_newton.trackers.train.terms import critic, events
from arena_newton.trackers.train.terms.measurement import TickMeasurement
from arena_newton.trackers.train.terms.rewards import REWARDS, TERMINATION_REWARD, Term
from arena_newton.trackers.train.terms.terminations import TERMINATIONS, Bound
from arena_newton.trackers.train.train_options import TrainOptions

if TYPE_CHECKING:
    from arena_newton.trackers.front_end import FrontEnd
    from arena_newton.trackers.interface import ActionForm, Interface
    from arena_newton.trackers.motions.library import DeviceLibrary

__all__ = ["TrackerEnv"]

_PREFILL = 0.5
"""Fraction of the episodes that start with a history of the current frame; the others start with an empty one."""
NO_PUSH = 1e3
"""`since_push` of an episode without a push so far [s]."""


class TrackerEnv(VecEnv):
    """References tracked in the lab by a front end's robot."""

    def __init__(
        self,
        interface: Interface,
        form: ActionForm,
        library: DeviceLibrary,
        options: TrainOptions,
        device: str = "cpu",
        *,
        rewards: Mapping[str, Term] = REWARDS,
        terminations: Mapping[str, Bound] = TERMINATIONS,
        randomisation: Mapping[str, events.Event] = events.EVENTS,
        critic_terms: Mapping[str, critic.CriticTerm] = critic.CRITIC,
        family_weights: Mapping[str, float] | None = None,
    ):
        """Build the worlds on a device, `cpu` or `cuda:N`; families without a weight have 1.

        Raises:
            InputError: The interface needs a measurement that training does not make.
        """
        self.cfg = options
        self.num_envs = worlds = options.worlds
        self.device = device
        self.max_episode_length = round(options.episode_s / TICK)
        self.interface = interface
        self.front_end: FrontEnd = interface.front_end(form)
        front_end = self.front_end
        if "foot_force" in front_end.needs:
            raise InputError(f"interface {interface.name!r}: needs foot_force, which training does not measure")
        self._lookahead = torch.arange(1, front_end.lookahead + 1, device=device)
        self.num_actions = front_end.action_width
        self.rewards, self.terminations = dict(rewards), dict(terminations)
        self.events = dict(randomisation) if options.randomise else {}
        self.critic = dict(critic_terms)
        self.critic_widths: dict[str, int] = {}
        """Width of each critic term."""
        self.bank = ReferenceBank(library, device)
        self.sampler = ClipSampler(self.bank, options.adaptive, dict(family_weights or {}))
        self.sim = Simulation(interface.drive, interface.rate, options, device)
        self._every = torch.ones(worlds, dtype=torch.bool, device=device)
        self.late_targets: Delay = Delay(worlds, 29, torch.device(device))
        """Latency of each world's joint targets."""
        drawn = self.events.get("state_delay")
        self._state_ages = drawn is not None and drawn.settings["fraction"] > 0.0
        if not self._state_ages:
            self.critic.pop("state_delay", None)  # checkpoints of trainings without it can be resumed
        width = 65 + 3 * len({"position", "lin_vel"} & set(front_end.needs))
        self.late_state: Delay = Delay(worlds, width if self._state_ages else 0, torch.device(device))
        """Latency of the state that each world's tracker gets; of no state where the events draw none."""
        zero = torch.zeros(worlds, 1, device=device)
        self.privileged: dict[str, torch.Tensor] = {
            "friction": zero,
            "trunk_mass": zero.repeat(1, 2),
            "centre_of_mass": zero.repeat(1, 6),
            "payload": zero.repeat(1, 2),
            "motor_strength": zero.repeat(1, 29),
        }
        """Values drawn by the start events, by name, each of shape [worlds, n]."""
        events.apply(self, "start", self._every, self.events)
        self.randomised: torch.Tensor = torch.cat(list(self.privileged.values()), 1)
        self.sim.finish()
        self.pushed_links = [self.sim.bodies[name] for name in (*events.HANDS, "torso_link")]
        """Bodies on which events apply forces."""
        self._foot_bodies = torch.tensor([self.sim.bodies[name] for name in KEY_LINKS[FEET]], device=device)
        self.default_pose: torch.Tensor = torch.tensor(DEFAULT_POSE, device=device)
        """The robot's default joint positions [rad], shape [29]."""
        self.families = torch.eye(len(self.bank.family_names), device=device)
        """One-hot rows of the families."""
        self.support_kinds = torch.arange(1, 4, device=device)

        front_end.bind(worlds, device)
        self._pose = torch.tensor(front_end.default_pose, device=device)
        self._scale = torch.tensor(front_end.action_form.scale, device=device)
        numbers = torch.arange(self.num_actions, device=device)[None]
        self._raw_order = torch.argsort(front_end.to_mujoco(numbers)[0])
        self._allocate()
        self.reset()
        self._graphs: dict[str, torch.cuda.CUDAGraph] = {}
        if options.tick_graph and device.startswith("cuda"):
            self._capture()

    def _allocate(self) -> None:
        """Buffers that keep their addresses, so that a CUDA graph can hold a tick."""
        worlds, device = self.num_envs, self.device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        self.episode_length_buf, self.frame = zeros(worlds, dtype=torch.long), zeros(worlds, dtype=torch.long)
        self._action, self._last_action = zeros(worlds, self.num_actions), zeros(worlds, self.num_actions)
        self._feet, self._foot_vel = zeros(worlds, 2, 3), zeros(worlds, 2, 3)
        self._next_rows = zeros(worlds, self.bank.data.shape[1])
        self.ahead: Frame = self.bank.split(self._next_rows)
        """The reference frame that is commanded next."""
        self.since_push = zeros(worlds)
        """Time since the last push of each world [s], shape [worlds]."""
        self._reward, self._done = zeros(worlds), zeros(worlds, dtype=torch.long)
        self._time_out = zeros(worlds, dtype=torch.bool)
        self._critic_obs: torch.Tensor | None = None
        self._weights = torch.tensor([t.weight for t in self.rewards.values()], device=device)
        self._limits = torch.tensor([b.limit for b in self.terminations.values()], device=device)
        self.tally = Tally(list(self.rewards), list(self.terminations), self.bank.family_names, device)

    @torch.no_grad()
    def _capture(self) -> None:
        """Capture the parts of a tick before and after the physics in two CUDA graphs."""
        for _ in range(3):
            self.step(self.reference_action())
        torch.cuda.synchronize(self.device)
        for name, work in (("before", self._before), ("after", self._after)):
            self._graphs[name] = captured(work, "tick-graph")
        torch.cuda.synchronize(self.device)
        self.reset()
        self.sampler.clear()
        self.tally.clear()

    def _run(self, name: str, work: Callable[[], None]) -> None:
        (self._graphs[name].replay if name in self._graphs else work)()

    # -- rsl_rl's interface -----------------------------------------------------------------------------------------

    def get_observations(self) -> TensorDict:
        """Observations of the current state: groups `actor` and `critic`."""
        assert self._critic_obs is not None
        return TensorDict(
            {"actor": self.front_end.obs.clone(), "critic": self._critic_obs.clone()}, batch_size=[self.num_envs]
        )

    @torch.no_grad()
    def reset(self, frame: torch.Tensor | None = None) -> None:
        """Start an episode in every world, in sampled frames of the library or given ones, shape [worlds]."""
        self._restart(self._every, frame)
        self._observe(self._every)

    @torch.no_grad()
    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Advance all worlds by one tick.

        Args:
            actions: Raw actions, shape [worlds, actions].

        Returns:
            Observations, rewards [worlds], dones [worlds] (int64) and extras with `time_outs`.
        """
        self._last_action.copy_(self._action)
        self._action.copy_(actions)
        self._run("before", self._before)
        self.sim.step()
        self._run("after", self._after)
        return self.get_observations(), self._reward, self._done, {"time_outs": self._time_out}

    def _before(self) -> None:
        """Turn raw actions into targets, some of them late."""
        targets = self.front_end.act(self._action)
        self.sim.targets.copy_(self.late_targets.late(targets))
        self.late_targets.keep(targets, self._every)

    def _after(self) -> None:
        """Judge the new state, start ended worlds again, make the next observations."""
        self.frame.add_(1)
        self.episode_length_buf.add_(1)
        self.since_push.add_(TICK)
        self._track_feet()
        reward, failed = self._judge(self._measure(self.ahead))
        over = (self.frame >= self.bank.last.index_select(0, self.frame)) | (
            self.episode_length_buf >= self.max_episode_length
        )
        done = failed | over
        self._reward.copy_(reward)
        self._done.copy_(done)
        self._time_out.copy_(over & ~failed)
        self.sampler.record(self.frame, failed, TICK)
        self._restart(done)
        events.apply(self, "interval", ~done, self.events)
        self._observe(done)

    def reference_action(self) -> torch.Tensor:
        """The raw action whose targets are the next reference frame's joints, shape [worlds, actions]."""
        form = self.front_end.action_form
        if form.kind == "residual":
            return torch.zeros(self.num_envs, self.num_actions, device=self.device)
        asked = (self.ahead.joint_pos - self._pose) / self._scale
        return asked.index_select(1, self._raw_order)

    def collect(self) -> dict[str, float]:
        """Means since the last call by name; renews the sampling weights and waits for the device once.

        Raises:
            TrainingError: A reward term, an observation or an action was not finite.
        """
        self.sampler.renew()
        return self.tally.collect()

    # -- parts of a tick --------------------------------------------------------------------------------------------

    def clip(self) -> torch.Tensor:
        """Clip that each world follows, shape [worlds]."""
        return self.bank.clip_of.index_select(0, self.frame)

    def _measure(self, reference: Frame) -> TickMeasurement:
        return TickMeasurement(self.sim, reference, self._foot_vel, self._action, self._last_action, self.since_push)

    def _track_feet(self) -> None:
        """Velocities of the feet over the tick; zero on an episode's first, whose start is not measured."""
        feet = self.sim.body_pos.index_select(1, self._foot_bodies)
        first = (self.episode_length_buf <= 1)[:, None, None]
        self._foot_vel.copy_(torch.where(first, 0.0, (feet - self._feet) / TICK).clamp(-10.0, 10.0))
        self._feet.copy_(feet)

    def _judge(self, m: TickMeasurement) -> tuple[torch.Tensor, torch.Tensor]:
        """Reward [worlds] and early ends [worlds] of a tick; adds to the counters."""
        values = torch.stack([term.value(m) for term in self.rewards.values()], 1)
        # A state that is not finite is not a term's fault: the world's episode ends and earns nothing.
        values = torch.where(m.finite[:, None], values, 0.0)
        assert self._critic_obs is not None
        self.tally.guard(values, self.front_end.obs, self._critic_obs, self._action)
        ends = torch.stack([bound.value(m) for bound in self.terminations.values()], 1) > self._limits
        failed = ends.any(1) | ~m.finite
        earned = values * (self._weights * TICK)
        family = self.bank.family.index_select(0, self.clip())
        self.tally.add(m, earned, ends, failed, family, self.sim.overflow & LOST_CONTACTS)
        return earned.sum(1) + TERMINATION_REWARD * failed, failed

    def _restart(self, mask: torch.Tensor, frame: torch.Tensor | None = None) -> None:
        """Put the masked worlds into a sampled (or given) frame, at the reference's state with a little noise."""
        sim, worlds, row = self.sim, self.num_envs, mask[:, None]
        self.frame.copy_(torch.where(mask, self.sampler.sample(worlds) if frame is None else frame, self.frame))
        start = self.bank.gather(self.frame)
        noise = events.START_NOISE if self.cfg.randomise else dict.fromkeys(events.START_NOISE, 0.0)

        def around(value: torch.Tensor, name: str) -> torch.Tensor:
            return value + noise[name] * (2.0 * torch.rand_like(value) - 1.0)

        xy = around(start.root_pos[:, :2], "xy")
        z = start.root_pos[:, 2:] + noise["z"] * torch.rand(worlds, 1, device=self.device)
        tilt = noise["tilt"] * (2.0 * torch.rand(worlds, 3, device=self.device) - 1.0)
        turned = rotations.quat_from_yaw(noise["heading"] * (2.0 * torch.rand(worlds, device=self.device) - 1.0))
        quat = rotations.turned_by(rotations.quat_multiply(turned, start.root_quat), tilt)

        def put(view: torch.Tensor, value: torch.Tensor | float) -> None:
            view.copy_(torch.where(row, value, view))

        put(sim.root_pos, torch.cat((xy, z), 1))
        put(sim.root_quat, quat)
        put(sim.root_vel, around(start.lin_vel, "lin_vel"))
        put(sim.root_ang_vel, around(start.ang_vel, "ang_vel"))
        low, high = sim.joint_range[:, 0], sim.joint_range[:, 1]
        put(sim.joint_pos, around(start.joint_pos, "joint_pos").clamp(low, high))
        put(sim.joint_vel, around(start.joint_vel, "joint_vel"))
        put(sim.warmstart, 0.0)
        self.late_targets.forget(mask)
        self.late_targets.keep(start.joint_pos, mask)
        self._action.masked_fill_(row, 0.0)
        self._foot_vel.masked_fill_(row[:, None], 0.0)
        sim.overflow.masked_fill_(mask, 0)
        self.episode_length_buf.masked_fill_(mask, 0)
        self.since_push.masked_fill_(mask, NO_PUSH)
        bank, clip = self.bank, self.clip()
        supports = (bank.support_kind, bank.support_pos, bank.support_quat)
        sim.place_supports(mask, *(part.index_select(0, clip) for part in supports))
        events.apply(self, "reset", mask, self.events)

    def _observe(self, first: torch.Tensor) -> None:
        """Make the observations of the current state and the next frame's command.

        Args:
            first: Worlds whose episode starts, bool, shape [worlds].
        """
        now = self.bank.gather(self.frame)
        self._next_rows.copy_(self.bank.rows(torch.minimum(self.frame + 1, self.bank.last.index_select(0, self.frame))))
        command = self._command(self.ahead)
        if ticks := self.front_end.lookahead:
            later = self.frame[:, None] + 1 + self._lookahead
            frames = torch.minimum(later, self.bank.last.index_select(0, self.frame)[:, None])
            window = self._command(self.bank.gather(frames.flatten()))
            command.ahead = window.mapped(lambda t: t.unflatten(0, (-1, ticks)))
        state = self._noisy_state()
        if "position" in self.front_end.needs:
            state.position = self.sim.root_pos
        if "lin_vel" in self.front_end.needs:
            state.lin_vel = self.sim.root_vel
        if self._state_ages:
            self.late_state.forget(first)
            state = RobotState(**self.late_state.late_parts(state.tensors(), self._every))
        self.front_end.reset(first)
        if self.cfg.randomise:
            first = first & (torch.rand(self.num_envs, device=self.device) < _PREFILL)
        self.front_end.prefill(command, state, first)
        self.front_end.observe(command, state)
        exact = self._measure(now)
        # Body positions of worlds that just started again are those before the start: take the reference's.
        exact.keys = torch.where((self.episode_length_buf == 0)[:, None, None], now.keys, exact.keys)
        observation = critic.observe(self, exact)
        if self._critic_obs is None:
            self._critic_obs = observation
        else:
            self._critic_obs.copy_(observation)

    def _command(self, frame: Frame) -> TrackerCommand:
        position = frame.root_pos if "position" in self.front_end.needs else None
        return TrackerCommand(frame.mimic, frame.joint_pos, frame.joint_vel, frame.root_quat, position)

    def _noisy_state(self) -> RobotState:
        sim = self.sim
        if not self.cfg.randomise:
            return RobotState(sim.root_quat, sim.root_ang_vel, sim.joint_pos, sim.joint_vel)
        half = events.OBSERVATION_NOISE
        noise = 2.0 * torch.rand(self.num_envs, 64, device=self.device) - 1.0
        return RobotState(
            quat=rotations.turned_by(sim.root_quat, half["tilt"] * noise[:, :3]),
            ang_vel_body=sim.root_ang_vel + half["ang_vel"] * noise[:, 3:6],
            joint_pos=sim.joint_pos + half["joint_pos"] * noise[:, 6:35],
            joint_vel=sim.joint_vel + half["joint_vel"] * noise[:, 35:64],
        )
