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

from arena_newton.errors import ArenaError
from arena_newton.interfaces import RobotState, TrackerCommand
from arena_newton.robot import DEFAULT_POSE, TICK, DriveGains, PhysicsRate
from arena_newton.trackers.motions import frames
from arena_newton.trackers.train import events, rotations
from arena_newton.trackers.train.motion import Motion
from arena_newton.trackers.train.references import FEET, KEY_LINKS, Frame, ReferenceBank
from arena_newton.trackers.train.rewards import REWARDS, TERMINATION_REWARD, Term
from arena_newton.trackers.train.sampling import ClipSampler
from arena_newton.trackers.train.simulation import Simulation
from arena_newton.trackers.train.terminations import TERMINATIONS, Bound

if TYPE_CHECKING:
    from arena_newton.trackers.front_end import FrontEnd
    from arena_newton.trackers.motions.library import DeviceLibrary

__all__ = ["ERRORS", "EnvConfig", "TrackerEnv", "TrainingError"]

_PREFILL = 0.5
"""Share of the episodes that start with a history of the present frame; the others start with an empty one."""
_LOOKAHEAD = (4, 10, 25)
"""Frames ahead of the state whose commands the critic sees."""
_VALUE_CLIP = 50.0
"""Largest magnitude of a critic observation."""


@dataclasses.dataclass(frozen=True)
class EnvConfig:
    """What shapes the environment."""

    worlds: int = 8192
    """Parallel worlds."""
    episode_s: float = 10.0
    """Longest episode [s]."""
    adaptive: float = 0.5
    """Share of the episodes that start where the tracker fails, the others start anywhere."""
    randomise: bool = True
    """Run the events and noise of `events.py`."""
    contacts_per_world: int = 48
    """Contact buffer."""
    constraints_per_world: int = 160
    """Constraint buffer."""
    graph: bool = True
    """Capture the physics tick on CUDA."""


class TrainingError(ArenaError):
    """Training cannot go on."""


def _rms(difference: torch.Tensor) -> torch.Tensor:
    return difference.square().mean(1).sqrt()


ERRORS: dict[str, Callable[[Motion], torch.Tensor]] = {
    "velocity_m_s": lambda m: m.velocity_error[:, :2].norm(dim=1),
    "legs_rad": lambda m: _rms((m.joint_pos - m.reference.joint_pos)[:, :12]),
    "arms_rad": lambda m: _rms((m.joint_pos - m.reference.joint_pos)[:, 15:]),
    "links_m": lambda m: (m.keys - m.reference.keys).norm(dim=2).mean(1),
    "height_m": lambda m: m.position_error[:, 2].abs(),
    "position_m": lambda m: m.position_error[:, :2].norm(dim=1),
    "heading_rad": lambda m: m.heading_error.abs(),
}
"""Tracking errors that are logged beside the rewards."""


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
        self.episode_length_buf = torch.zeros(worlds, dtype=torch.long, device=device)
        self.frame = torch.zeros(worlds, dtype=torch.long, device=device)
        self._action = torch.zeros(worlds, self.num_actions, device=device)
        self._targets = torch.zeros(worlds, 29, device=device)
        self._feet = torch.zeros(worlds, 2, 3, device=device)
        self._foot_vel = torch.zeros(worlds, 2, 3, device=device)
        self._make_counters()
        with torch.no_grad():
            self._restart(self._every)
            self._observe(self._every)

    def _make_counters(self) -> None:
        terms, ends = len(self.rewards), len(self.terminations)
        zeros = lambda *shape: torch.zeros(shape, device=self.device)  # noqa: E731
        self._sums = {
            "reward": zeros(terms),
            "ended": zeros(ends),
            "error": zeros(len(ERRORS)),
            "family_seconds": zeros(len(self.bank.family_names)),
            "family_falls": zeros(len(self.bank.family_names)),
            "ticks": zeros(1),
            "falls": zeros(1),
            "overflow": zeros(1),
        }
        self._weights = torch.tensor([t.weight for t in self.rewards.values()], device=self.device)
        self._limits = torch.tensor([b.limit for b in self.terminations.values()], device=self.device)
        # The guard's names: reward terms, then observations, then the policy's actions.
        self.guarded = [*(f"reward {n}" for n in self.rewards), "observation actor", "observation critic", "action"]
        self._bad_world = torch.full((len(self.guarded),), -1, dtype=torch.long, device=self.device)

    # -- rsl-rl's interface -----------------------------------------------------------------------------------------

    def get_observations(self) -> TensorDict:
        """Observations of the present state: groups `actor` and `critic`."""
        return TensorDict({"actor": self.front_end.obs.clone(), "critic": self._critic_obs}, batch_size=[self.num_envs])

    @torch.no_grad()
    def step(self, actions: torch.Tensor) -> tuple[TensorDict, torch.Tensor, torch.Tensor, dict]:
        """Advance all worlds by one tick.

        Args:
            actions: Raw actions, shape [worlds, actions].

        Returns:
            Observations, rewards [worlds], dones [worlds] (int64) and extras with `time_outs`.
        """
        last_action, self._action = self._action, actions.detach()
        targets = self.front_end.act(self._action)
        self.sim.targets.copy_(torch.where(self.delay[:, None], self._targets, targets))
        self._targets.copy_(targets)
        self.sim.step()
        self.frame += 1
        self.episode_length_buf += 1

        motion = self._measure(self._next, last_action)
        reward, failed = self._judge(motion)
        over = (self.frame >= self.bank.last.index_select(0, self.frame)) | (
            self.episode_length_buf >= self.max_episode_length
        )
        time_out = over & ~failed
        done = failed | over
        self.sampler.record(self.frame, failed, TICK)

        self._restart(done)
        events.apply(self, "interval", ~done, self.events)
        self._observe(done)
        return self.get_observations(), reward, done.long(), {"time_outs": time_out}

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
        packed = torch.cat([*(v.reshape(-1) for v in self._sums.values()), self._bad_world.float()]).tolist()
        values: dict[str, list[float]] = {}
        for name, sums in self._sums.items():
            values[name], packed = packed[: sums.numel()], packed[sums.numel() :]
            sums.zero_()
        for what, world in zip(self.guarded, packed, strict=True):
            if world >= 0:
                raise TrainingError(f"world {int(world)}: {what} is not finite")
        ticks = max(values["ticks"][0], 1.0)
        seconds = ticks * TICK
        out = {f"Reward/{n}": v / seconds for n, v in zip(self.rewards, values["reward"], strict=True)}
        out |= {f"Ends_per_s/{n}": v / seconds for n, v in zip(self.terminations, values["ended"], strict=True)}
        out |= {f"Error/{n}": v / ticks for n, v in zip(ERRORS, values["error"], strict=True)}
        for name, lived, falls in zip(
            self.bank.family_names, values["family_seconds"], values["family_falls"], strict=True
        ):
            if lived > 0.0:
                out[f"Seconds_between_ends/{name}"] = lived / max(falls, 1.0)
        out["Train/reward_per_s"] = sum(values["reward"]) / seconds
        out["Train/seconds_between_ends"] = seconds / max(values["falls"][0], 1.0)
        out["Train/overflow_share"] = values["overflow"][0] / ticks
        return out

    # -- parts of a tick --------------------------------------------------------------------------------------------

    def _measure(self, reference: Frame, last_action: torch.Tensor) -> Motion:
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
        self._foot_vel = moved
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
            last_action=last_action,
            finite=finite,
            first=first,
        )

    def _judge(self, motion: Motion) -> tuple[torch.Tensor, torch.Tensor]:
        """Reward [worlds] and early ends [worlds] of a tick; adds to the counters."""
        values = torch.stack([term.value(motion) for term in self.rewards.values()], 1)
        # What a broken physics state spoils is no fault of a term: the world ends and earns nothing.
        values = torch.where(motion.finite[:, None], values, 0.0)
        self._guard(values)
        ends = torch.stack([bound.value(motion) for bound in self.terminations.values()], 1) > self._limits
        failed = ends.any(1) | ~motion.finite
        earned = values * (self._weights * TICK)
        reward = earned.sum(1) + TERMINATION_REWARD * failed
        sums = self._sums
        sums["reward"] += earned.sum(0)
        sums["ended"] += ends.float().sum(0)
        errors = torch.stack([error(motion) for error in ERRORS.values()], 1)
        sums["error"] += torch.where(motion.finite[:, None], errors, 0.0).clamp_max(100.0).sum(0)
        family = self.bank.family.index_select(0, self.bank.clip_of.index_select(0, self.frame))
        sums["family_seconds"].index_add_(0, family, torch.full_like(reward, TICK))
        sums["family_falls"].index_add_(0, family, failed.float())
        sums["ticks"] += self.num_envs
        sums["falls"] += failed.sum()
        sums["overflow"] += (self.sim.overflow != 0).sum()
        return reward, failed

    def _guard(self, values: torch.Tensor) -> None:
        """Remember a world for each guarded term that is not finite, without waiting for the device."""
        checked = (self.front_end.obs, self._critic_obs, self._action)
        bad = [~torch.isfinite(values), *(~torch.isfinite(v).all(1, keepdim=True) for v in checked)]
        bad_terms = torch.cat(bad, 1)
        self._bad_world = torch.where(bad_terms.any(0), bad_terms.int().argmax(0), self._bad_world)

    def _restart(self, mask: torch.Tensor) -> None:
        """Put the masked worlds into a random frame of a sampled clip, at the reference's state with a little noise."""
        sim, worlds, row = self.sim, self.num_envs, mask[:, None]
        self.frame = torch.where(mask, self.sampler.sample(worlds), self.frame)
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
        self._action = torch.where(row, 0.0, self._action)
        self._foot_vel = torch.where(row[:, None], 0.0, self._foot_vel)
        sim.overflow.masked_fill_(mask, 0)
        self.episode_length_buf.masked_fill_(mask, 0)
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
        self._next = self.bank.gather(torch.minimum(self.frame + 1, self.bank.last.index_select(0, self.frame)))
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
        self._critic_obs = self._critic(now)

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
