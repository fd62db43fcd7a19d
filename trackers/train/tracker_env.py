"""The training environment: one class for all tracker interfaces, rsl-rl's `VecEnv`.

A tick: raw actions become joint targets through the tracker's own front end, the physics advances 20 ms, the new state
is rewarded against the reference frame that was commanded, worlds that ended start again elsewhere in the library, and
the front end makes the next observation of the next command. Everything is masked writes over all worlds; nothing
waits for the device.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING

import torch
from rsl_rl.env import VecEnv
from tensordict import TensorDict

from arena_newton import rotations
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.kernels.newton_state import LOST_CONTACTS
from arena_newton.robot import DEFAULT_POSE, TICK, DriveGains, PhysicsRate
from arena_newton.trackers.motions import frames
from arena_newton.trackers.train import events
from arena_newton.trackers.train.graphs import captured
from arena_newton.trackers.train.motion import Motion
from arena_newton.trackers.train.references import FEET, KEY_LINKS, Frame, ReferenceBank
from arena_newton.trackers.train.rewards import REWARDS, TERMINATION_REWARD, Term
from arena_newton.trackers.train.sampling import ClipSampler
from arena_newton.trackers.train.simulation import Simulation
from arena_newton.trackers.train.tally import Tally
from arena_newton.trackers.train.terminations import TERMINATIONS, Bound

if TYPE_CHECKING:
    from arena_newton.trackers.front_end import FrontEnd
    from arena_newton.trackers.motions.library import DeviceLibrary
    from arena_newton.trackers.train.options import TrainOptions

__all__ = ["EnvConfig", "TrackerEnv"]

_PREFILL = 0.5
"""Share of the episodes that start with a history of the present frame; the others start with an empty one."""
_LOOKAHEAD = (4, 10, 25)
"""Frames ahead of the state whose commands the critic sees."""
NO_PUSH = 1e3
"""`since_push` of an episode in which none has struck yet [s]."""
_VALUE_CLIP = 50.0
"""Largest magnitude of a critic observation."""


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What shapes the environment; `TrainOptions` has the defaults."""

    worlds: int
    """Parallel worlds."""
    episode_s: float
    """Longest episode [s]."""
    adaptive: float
    """Share of the episodes that start where the tracker fails, the others start anywhere."""
    randomise: bool
    """Run the events and noise of `events.py`."""
    contacts_per_world: int
    """Contact buffer."""
    constraints_per_world: int
    """Constraint buffer."""
    graph: bool
    """Capture the physics of a tick on CUDA."""
    tick_graph: bool
    """Capture the rest of a tick on CUDA."""

    @classmethod
    def of(cls, options: TrainOptions) -> EnvConfig:
        """The part of a training's options that the environment reads, by the same names."""
        return cls(**{field.name: getattr(options, field.name) for field in dataclasses.fields(cls)})


class TrackerEnv(VecEnv):
    """References tracked in the lab by a front end's robot."""

    def __init__(
        self,
        front_end: FrontEnd,
        drive: DriveGains,
        rate: PhysicsRate,
        library: DeviceLibrary,
        config: EnvConfig,
        device: str = "cpu",
        *,
        rewards: Mapping[str, Term] = REWARDS,
        terminations: Mapping[str, Bound] = TERMINATIONS,
        randomisation: Mapping[str, events.Event] = events.EVENTS,
        family_weights: Mapping[str, float] | None = None,
    ):
        """Build the worlds.

        Args:
            front_end: Observation and action of the tracker, not yet bound.
            drive: Gains of the tracker.
            rate: Physics rate of the tracker.
            library: References on `device`.
            config: Sizes and switches.
            device: `cpu` or `cuda:N`.
            rewards: Reward terms by name.
            terminations: Termination terms by name.
            randomisation: Events by name.
            family_weights: Weights of families in the sampling, 1 where not named.
        """
        self.cfg = config
        self.num_envs = worlds = config.worlds
        self.device = device
        self.num_actions = front_end.action_width
        self.max_episode_length = round(config.episode_s / TICK)
        self.front_end, self.rewards, self.terminations = front_end, dict(rewards), dict(terminations)
        self.events = dict(randomisation) if config.randomise else {}
        self.bank = ReferenceBank(library, device)
        self.sampler = ClipSampler(self.bank, config.adaptive, dict(family_weights or {}))
        self.sim = Simulation(
            worlds,
            device,
            drive,
            rate,
            contacts_per_world=config.contacts_per_world,
            constraints_per_world=config.constraints_per_world,
            graph=config.graph,
        )
        self._every = torch.ones(worlds, dtype=torch.bool, device=device)
        self.delay = torch.zeros(worlds, dtype=torch.bool, device=device)
        zero = torch.zeros(worlds, 1, device=device)
        self.privileged: dict[str, torch.Tensor] = {
            "friction": zero,
            "trunk_mass": zero.repeat(1, 2),
            "centre_of_mass": zero.repeat(1, 6),
            "payload": zero.repeat(1, 2),
            "motor_strength": zero.repeat(1, 29),
        }
        events.apply(self, "start", self._every, self.events)
        self._constants = torch.cat(list(self.privileged.values()), 1)
        self.sim.finish()
        self._pushed_links = [self.sim.bodies[n] for n in (*events.HANDS, "torso_link")]
        self._key_bodies = torch.tensor([self.sim.bodies[n] for n in KEY_LINKS], device=device)
        self._default = torch.tensor(DEFAULT_POSE, device=device)
        self._on_ground = torch.tensor((1.0, 1.0, 0.0), device=device)
        self._families = torch.eye(len(self.bank.family_names), device=device)
        self._kinds = torch.arange(1, 4, device=device)

        front_end.bind(worlds, device)
        self._pose = torch.tensor(front_end.default_pose, device=device)
        self._scale = torch.tensor(front_end.action_form.scale, device=device)
        numbers = torch.arange(self.num_actions, device=device)[None]
        self._raw_order = torch.argsort(front_end.to_mujoco(numbers)[0])
        self._allocate()
        with torch.no_grad():
            self._restart(self._every)
            self._observe(self._every)
        self._graphs: dict[str, torch.cuda.CUDAGraph] = {}
        if config.tick_graph and device.startswith("cuda"):
            self._capture()

    def _allocate(self) -> None:
        """Buffers that keep their place, so that a CUDA graph can hold a tick."""
        worlds, device = self.num_envs, self.device

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        self.episode_length_buf, self.frame = zeros(worlds, dtype=torch.long), zeros(worlds, dtype=torch.long)
        self._action, self._last_action = zeros(worlds, self.num_actions), zeros(worlds, self.num_actions)
        self._targets = zeros(worlds, 29)
        self._feet, self._foot_vel = zeros(worlds, 2, 3), zeros(worlds, 2, 3)
        self._next_rows = zeros(worlds, self.bank.data.shape[1])
        self._next = self.bank.split(self._next_rows)
        self.since_push = zeros(worlds)
        self._reward, self._done = zeros(worlds), zeros(worlds, dtype=torch.long)
        self._time_out = zeros(worlds, dtype=torch.bool)
        self._critic_obs: torch.Tensor | None = None
        self._weights = torch.tensor([t.weight for t in self.rewards.values()], device=device)
        self._limits = torch.tensor([b.limit for b in self.terminations.values()], device=device)
        self.tally = Tally(list(self.rewards), list(self.terminations), self.bank.family_names, device)

    @torch.no_grad()
    def _capture(self) -> None:
        """Hold what a tick does around the physics in two CUDA graphs."""
        for _ in range(3):
            self.step(self.reference_action())
        torch.cuda.synchronize(self.device)
        for name, work in (("before", self._before), ("after", self._after)):
            self._graphs[name] = captured(work, "tick-graph")
        torch.cuda.synchronize(self.device)
        self._restart(self._every)
        self._observe(self._every)
        self.sampler.clear()
        self.tally.clear()

    def _run(self, name: str, work: Callable[[], None]) -> None:
        graph = self._graphs.get(name)
        if graph is None:
            work()
        else:
            graph.replay()

    # -- rsl-rl's interface -----------------------------------------------------------------------------------------

    def get_observations(self) -> TensorDict:
        """Observations of the present state: groups `actor` and `critic`."""
        assert self._critic_obs is not None
        return TensorDict(
            {"actor": self.front_end.obs.clone(), "critic": self._critic_obs.clone()}, batch_size=[self.num_envs]
        )

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
        """Raw actions become targets, some of them a tick late."""
        targets = self.front_end.act(self._action)
        self.sim.targets.copy_(torch.where(self.delay[:, None], self._targets, targets))
        self._targets.copy_(targets)

    def _after(self) -> None:
        """The new state is judged, ended worlds start again, the next observations are made."""
        self.frame.add_(1)
        self.episode_length_buf.add_(1)
        self.since_push.add_(TICK)
        motion = self._measure(self._next)
        reward, failed = self._judge(motion)
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
        """The raw action that asks for the next reference frame's joints, shape [worlds, actions]."""
        form = self.front_end.action_form
        if form.kind == "residual":
            return torch.zeros(self.num_envs, self.num_actions, device=self.device)
        asked = (self._next.joint_pos - self._pose) / self._scale
        return asked.index_select(1, self._raw_order)

    def collect(self) -> dict[str, float]:
        """Means since the last call, by name, and new sampling weights; waits for the device once.

        Raises:
            TrainingError: A reward term, an observation or an action was not finite.
        """
        self.sampler.renew()
        return self.tally.collect()

    # -- parts of a tick --------------------------------------------------------------------------------------------

    def _measure(self, reference: Frame) -> Motion:
        """Compare the measured state with a reference frame."""
        sim = self.sim
        finite = torch.isfinite(sim.qpos).all(1) & torch.isfinite(sim.qvel).all(1)
        quat = sim.root_quat
        heading, wanted = frames.heading(quat), frames.heading(reference.root_quat)
        velocity = rotations.turn(-heading, sim.root_vel)
        gravity, down = rotations.gravity_in_body(quat), rotations.gravity_in_body(reference.root_quat)
        key_pos = sim.body_pos.index_select(1, self._key_bodies)
        below = sim.root_pos * self._on_ground
        first = self.episode_length_buf <= 1
        moved = torch.where(first[:, None, None], 0.0, (key_pos[:, FEET] - self._feet) / TICK).clamp(-10.0, 10.0)
        self._feet.copy_(key_pos[:, FEET])
        self._foot_vel.copy_(moved)
        return Motion(
            reference=reference,
            root_pos=sim.root_pos,
            heading=heading,
            heading_error=frames.wrap_angle(wanted - heading),
            position_error=rotations.turn(-heading, reference.root_pos - sim.root_pos),
            velocity=velocity,
            velocity_error=rotations.turn(-wanted, reference.lin_vel) - velocity,
            yaw_rate_error=-((reference.ang_vel * down).sum(1) - (sim.root_ang_vel * gravity).sum(1)),
            tilt_error=torch.atan2(torch.linalg.cross(gravity, down).norm(dim=1), (gravity * down).sum(1)),
            gravity=gravity,
            ang_vel=sim.root_ang_vel,
            joint_pos=sim.joint_pos,
            joint_vel=sim.joint_vel,
            joint_acc=sim.joint_acc,
            torque=sim.torque,
            joint_range=sim.joint_range,
            keys=rotations.turn(-heading[:, None], key_pos - below[:, None]),
            foot_vel=moved,
            action=self._action,
            last_action=self._last_action,
            since_push=self.since_push,
            finite=finite,
            first=first,
        )

    def _judge(self, motion: Motion) -> tuple[torch.Tensor, torch.Tensor]:
        """Reward [worlds] and early ends [worlds] of a tick; adds to the counters."""
        values = torch.stack([term.value(motion) for term in self.rewards.values()], 1)
        # What a broken physics state spoils is no fault of a term: the world ends and earns nothing.
        values = torch.where(motion.finite[:, None], values, 0.0)
        assert self._critic_obs is not None
        self.tally.guard(values, self.front_end.obs, self._critic_obs, self._action)
        ends = torch.stack([bound.value(motion) for bound in self.terminations.values()], 1) > self._limits
        failed = ends.any(1) | ~motion.finite
        earned = values * (self._weights * TICK)
        family = self.bank.family.index_select(0, self.bank.clip_of.index_select(0, self.frame))
        self.tally.add(motion, earned, ends, failed, family, self.sim.overflow & LOST_CONTACTS)
        return earned.sum(1) + TERMINATION_REWARD * failed, failed

    def _restart(self, mask: torch.Tensor) -> None:
        """Put the masked worlds into a random frame of a sampled clip, at the reference's state with a little noise."""
        sim, worlds, row = self.sim, self.num_envs, mask[:, None]
        self.frame.copy_(torch.where(mask, self.sampler.sample(worlds), self.frame))
        start = self.bank.gather(self.frame)
        noise = events.START_NOISE if self.cfg.randomise else dict.fromkeys(events.START_NOISE, 0.0)

        def around(value: torch.Tensor, name: str) -> torch.Tensor:
            return value + noise[name] * (2.0 * torch.rand_like(value) - 1.0)

        xy = around(start.root_pos[:, :2], "xy")
        z = start.root_pos[:, 2:] + noise["z"] * torch.rand(worlds, 1, device=self.device)
        tilt = noise["tilt"] * (2.0 * torch.rand(worlds, 3, device=self.device) - 1.0)
        turned = frames.quat_from_yaw(noise["heading"] * (2.0 * torch.rand(worlds, device=self.device) - 1.0))
        quat = rotations.turned_by(frames.quat_multiply(turned, start.root_quat), tilt)

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
        put(self._targets, start.joint_pos)
        self._action.masked_fill_(row, 0.0)
        self._foot_vel.masked_fill_(row[:, None], 0.0)
        sim.overflow.masked_fill_(mask, 0)
        self.episode_length_buf.masked_fill_(mask, 0)
        self.since_push.masked_fill_(mask, NO_PUSH)
        clip = self.bank.clip_of.index_select(0, self.frame)
        bank = self.bank
        sim.place_supports(
            mask,
            bank.support_kind.index_select(0, clip),
            bank.support_pos.index_select(0, clip),
            bank.support_quat.index_select(0, clip),
        )
        events.apply(self, "reset", mask, self.events)

    def _observe(self, fresh: torch.Tensor) -> None:
        """Make the observations of the present state and the next frame's command.

        Args:
            fresh: Worlds whose episode starts, bool, shape [worlds].
        """
        now = self.bank.gather(self.frame)
        self._next_rows.copy_(self.bank.rows(torch.minimum(self.frame + 1, self.bank.last.index_select(0, self.frame))))
        ahead = self._next
        command = TrackerCommand(
            mimic=ahead.mimic, joints=ahead.joint_pos, joint_vel=ahead.joint_vel, quat=ahead.root_quat
        )
        state = self._noisy_state()
        self.front_end.reset(fresh)
        if self.cfg.randomise:
            fresh = fresh & (torch.rand(self.num_envs, device=self.device) < _PREFILL)
        self.front_end.prefill(command, state, fresh)
        self.front_end.observe(command, state)
        critic = self._critic(now)
        if self._critic_obs is None:
            self._critic_obs = critic.clone()
        else:
            self._critic_obs.copy_(critic)

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

    def _critic(self, now: Frame) -> torch.Tensor:
        """What only the critic sees, shape [worlds, n]: the exact state, all errors, the future, the randomisation."""
        sim, bank = self.sim, self.bank
        heading, wanted = frames.heading(sim.root_quat), frames.heading(now.root_quat)
        velocity = rotations.turn(-heading, sim.root_vel)
        position_error = rotations.turn(-heading, now.root_pos - sim.root_pos)
        turn_error = frames.wrap_angle(wanted - heading)
        key_pos = sim.body_pos.index_select(1, self._key_bodies)
        keys = rotations.turn(-heading[:, None], key_pos - (sim.root_pos * self._on_ground)[:, None])
        # Body poses of worlds that just started again are those before the start: the reference's stand in.
        fresh = (self.episode_length_buf == 0)[:, None, None]
        keys = torch.where(fresh, now.keys, keys)
        last = bank.last.index_select(0, self.frame)
        future = [bank.mimic.index_select(0, torch.minimum(self.frame + k, last)) for k in _LOOKAHEAD]
        clip = bank.clip_of.index_select(0, self.frame)
        kind = bank.support_kind.index_select(0, clip)
        support = rotations.turn(-heading, bank.support_pos.index_select(0, clip) - sim.root_pos)
        force = torch.cat([sim.body_force[:, link, :3] for link in self._pushed_links], 1)
        parts = (
            0.25 * sim.root_ang_vel,
            rotations.gravity_in_body(sim.root_quat),
            sim.joint_pos - self._default,
            sim.joint_pos - now.joint_pos,
            0.05 * sim.joint_vel,
            self.front_end.last_action,
            self._next.mimic,
            velocity,
            rotations.turn(-wanted, now.lin_vel) - velocity,
            sim.root_pos[:, 2:],
            position_error,
            torch.stack((torch.sin(turn_error), torch.cos(turn_error)), 1),
            keys.flatten(1),
            (now.keys - keys).flatten(1),
            rotations.turn(-heading[:, None], self._foot_vel).flatten(1),
            *future[:-1],
            future[-1][:, :6],
            self._families.index_select(0, bank.family.index_select(0, clip)),
            torch.where((kind > 0)[:, None], support, 0.0),
            (kind[:, None] == self._kinds).float(),
            rotations.turn(-heading[:, None], force.unflatten(1, (-1, 3))).flatten(1) * 0.1,
            self.delay[:, None].float(),
            self._constants,
        )
        return torch.cat(parts, 1).clamp(-_VALUE_CLIP, _VALUE_CLIP)
