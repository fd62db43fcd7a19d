"""ArenaEnv: a batch of worlds of one task, judged by one rule set, moved by one tracker.

A world's episode has two phases: the start-up, in which the robot takes its stance under the standing action for as
many ticks as the rule set says (none in `released`), and the episode proper, whose step 0 is the policy's first action.
Episodes of a plan, budgets and endings are `arena_newton.rollout`'s work.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.interfaces import EpisodeEvent, Observation, Spawn, Verdict
from arena_newton.kernel_cache.kernel_loading import load_kernels
from arena_newton.kernels import canonical, reset
from arena_newton.kernels import tick as kernels
from arena_newton.kernels.launching import record
from arena_newton.kernels.rules import fall
from arena_newton.physics.devices import resolve_engine
from arena_newton.physics.dynamics import NOISES, Delay, SensorNoise, value_of
from arena_newton.physics.engines import make_physics
from arena_newton.physics.scene import load_scene
from arena_newton.pictures.camera import Camera, WorldLights
from arena_newton.pictures.settings import FRONT, CameraConfig
from arena_newton.robot import g1
from arena_newton.robot.canonical import STAND_ACTION, STATE_WIDTH
from arena_newton.tracking import TrackerLoop, WorldMask

if TYPE_CHECKING:
    import newton

    from arena_newton.interfaces import Tracker
    from arena_newton.robot.g1 import DriveGains
    from arena_newton.rules.rule_types import RuleSet
    from arena_newton.tasks.base import Draws, Sample

__all__ = ["STAND_ACTION", "ArenaEnv"]

FALL_TRIGGERS = {fall.TILT: "tilt", fall.TILT_HELD: "tilt_held", fall.CONTACT: "contact"}
"""Trigger of the fall rule → its name in results."""

NO_TICK = -(1 << 62)
"""Tick of something that does not happen."""


class ArenaEnv:
    """A batch of worlds; each runs an episode of its own."""

    def __init__(
        self,
        task: str,
        *,
        tracker: Tracker,
        worlds: int = 20,
        engine: str = "auto",
        device: str | None = None,
        rules: str | RuleSet = "paper",
        mode: str = "base",
        variant_file: str | None = None,
        fast_physics: bool = False,
        drive: DriveGains | None = None,
        hands: str = "dex3",
        camera: CameraConfig | None = None,
        cameras: Mapping[str, CameraConfig] | None = None,
        threads: int | None = None,
    ):
        """Build the scene and bind tracker, judge and kernels.

        Args:
            task: Task name.
            tracker: A tracker (`arena_newton.trackers`); it belongs to this environment from now on.
            worlds: Worlds in the batch.
            engine: `auto`, `mujoco` or `warp`.
            device: Warp device, such as `cpu` or `cuda:0`.
            rules: Rule set or its name.
            mode: One of `modes.names()`.
            variant_file: A user's USD layer instead of the task's own scene.
            fast_physics: Use the tracker's fast physics rate.
            drive: Drive of the robot's joints instead of the one that tracker and rule set ask for.
            hands: `dex3`, or `fixed`: hands without joints, for tasks without grasps.
            camera: Head camera for policies that see: the same as `cameras={"front": camera}`.
            cameras: Cameras for policies that see, by the names of their pictures (`CameraConfig.named`).
            threads: CPU threads of engine `mujoco`; all by default.

        Raises:
            InputError: Something named in the message is missing or does not fit.
        """
        if worlds < 1:
            raise InputError(f"--worlds {worlds}: must be at least 1")
        if isinstance(tracker, str):
            raise InputError(f"tracker {tracker!r}: is a name, expected what arena_newton.trackers.get makes of it")
        self.spec = tasks.get(task)
        own_layer = self.spec.own_layer(mode)
        if own_layer and variant_file:
            raise InputError(f"--variant {variant_file}: --mode {mode} has a scene of its own, choose one of the two")
        self.rules = rule_sets.get(rules) if isinstance(rules, str) else rules
        variant = self.spec.variant(mode, self.rules)
        self.mode = mode
        """Mode of episodes whose own is not named."""
        self.modes = [mode] * worlds
        """Mode of each world's episode."""
        self.tracker = tracker
        self.worlds = worlds
        self.engine, device = resolve_engine(engine, device)
        given = ({} if camera is None else {FRONT: camera}) | dict(cameras or {})
        self.camera_configs = {name: one.named(name) for name, one in given.items()}
        """Configurations of `cameras`."""
        load_kernels(self.engine, device, camera=bool(self.camera_configs), suite=self.spec.suite)
        original = tracker.original_drive if self.rules.original_drive else None
        self.drive = drive or original or tracker.drive
        self.scene = load_scene(
            self.spec.name,
            worlds=self.worlds,
            device=device,
            hands=hands,
            variant=None if variant_file and variant == "base" else variant,
            rules=self.rules,
            drive=self.drive,
            variant_file=variant_file or own_layer,
            native=self.engine == "mujoco",
        )
        self.rate = tracker.rate(fast=fast_physics)
        self.physics = make_physics(self.scene, self.rate, self.engine, threads)
        self.device: wp.Device = self.physics.device
        self.torch_device: torch.device = wp.device_to_torch(self.device)
        self._raised = {o.prim: o.raised(self.scene) for o in self.spec.objects}
        self.judge = self.spec.judge(self.scene, self.rules)
        self.judge.bind(self.physics)
        self.loop = TrackerLoop(self.physics, self.scene.robot, tracker)
        """Turns actions into actuator targets."""
        self.startup_ticks: int = self.rules.startup.ticks
        """Length of the start-up [ticks]."""
        self.tick = np.zeros(self.worlds, dtype=np.int64)
        """Ticks since each world's step 0; negative during its start-up."""
        self.active = np.zeros(self.worlds, dtype=bool)
        """Worlds that run an episode."""
        self.budget = self.spec.max_steps(self.rules)
        """Step budget of the rule set [ticks]."""
        self.draws: list[Draws | None] = [None] * self.worlds
        """Random numbers drawn for each world's episode."""
        self._late: Delay | None = None
        """Latency of the policy's state; None until a world has one."""
        self._noise: SensorNoise | None = None
        """Noise of the sensors; None until a world has some."""
        self._push_tick = np.full(self.worlds, NO_TICK)
        """Tick before which each world is pushed."""
        self.planning = ""
        """Change of the contacts that makes this a planning model, which no `Rollout` takes; empty: the engine."""
        self._anchored = np.zeros(self.worlds, dtype=bool)
        self._stand = torch.tensor(STAND_ACTION, device=self.torch_device)
        self._chosen, self._stepping = WorldMask(self.worlds, self.device), WorldMask(self.worlds, self.device)
        self._lights: WorldLights | None = None
        self._newton_state: newton.State | None = None
        self.cameras = {
            name: Camera.of_config(self.scene, one, self.lights) for name, one in self.camera_configs.items()
        }
        """Cameras of policies that see, by the names of their pictures."""
        self._bind_kernels()

    def _bind_kernels(self) -> None:
        """Allocate what the judgement of a tick needs and record its launches."""
        p, h, log = self.physics, self.scene.robot, kernels.EpisodeLog
        with wp.ScopedDevice(self.device):
            self._state64 = wp.zeros((self.worlds, STATE_WIDTH), dtype=wp.float32)
            order = np.array(g1.CANONICAL_TO_MUJOCO)
            joint_qpos = wp.array(h.joint_qpos[order].astype(np.int32), dtype=wp.int32)
            joint_qvel = wp.array(h.joint_qvel[order].astype(np.int32), dtype=wp.int32)
            critical = wp.array(np.asarray(h.critical_bodies, dtype=np.int32), dtype=wp.int32)
            self._streak, self._fallen, self._trigger, self._pressed, self._bad_state, self._status = (
                wp.zeros(self.worlds, dtype=wp.int32) for _ in range(6)
            )
        self._state = wp.to_torch(self._state64)
        self._status_view = None if self.device.is_cuda else self._status.numpy()  # made once: making it takes 15 µs
        self._log = log.allocate(self.worlds, self.judge.predicates.shape[1], self.device)
        heading = self.loop.reference.heading
        self._observe = record(
            canonical.launch_state64, p.qpos, p.qvel, h.root_qpos, joint_qpos, joint_qvel, heading, self._state64
        )

        def launch_rules() -> None:
            fallen, fall_rule = (self._streak, self._fallen, self._trigger, self._pressed), self.rules.fall
            fall.launch_fall(p.qpos, h.root_qpos, p.contact_force, critical, *fallen, **dataclasses.asdict(fall_rule))
            reset.launch_nonfinite(p.qpos, p.qvel, self._bad_state)
            bad = self._bad_state, self.loop.bad_action, self.loop.bad_targets
            kernels.launch_status(self.judge.success, self._fallen, self.judge.event, *bad, self._status)
            now = self._trigger, self.judge.event, self._pressed, self.judge.predicates
            kernels.launch_log(self._log, self._stepping.warp, *now)

        self._rule = record(launch_rules)

    def describe(self) -> dict[str, object]:
        """Configuration to record with every result: engine, physics rate, drive, start-up and tracker."""
        return {
            "engine": f"{self.engine}, planning model: {self.planning}" if self.planning else self.engine,
            "device": str(self.device),
            "physics_dt": self.rate.dt,
            "substeps": self.rate.substeps,
            "drive": self.drive.name,
            "gains": {key: value for key, value in self.drive.as_json().items() if key != "name"},
            "startup_ticks": self.startup_ticks,
            "history": self.rules.startup.history,
            "tracker": self.tracker.describe(),
            **({} if self.scene.hands == "dex3" else {"hands": self.scene.hands}),
        }

    def close(self) -> None:
        """Release the physics' threads; the environment steps no more."""
        self.physics.close()
        self.active[:] = False

    @property
    def camera(self) -> Camera | None:
        """Head camera of policies that see."""
        return self.cameras.get(FRONT)

    @property
    def camera_config(self) -> CameraConfig | None:
        """Configuration that it was made from."""
        return self.camera_configs.get(FRONT)

    @property
    def lights(self) -> WorldLights:
        """Light of each world, for cameras."""
        if self._lights is None:
            self._lights = WorldLights.allocate(self.worlds, self.device, self.scene.stage)
            for world, draws in enumerate(self.draws):
                self._lights.set(world, draws.light if draws is not None else None)
        return self._lights

    def reset(
        self,
        seeds: Sequence[int],
        worlds: Sequence[int] | np.ndarray | None = None,
        *,
        spawn: Spawn | None = None,
        samples: Sequence[Mapping[str, Sample]] | None = None,
        modes: Sequence[str] | None = None,
    ) -> None:
        """Start an episode in each of `worlds` (all by default) from its episode seed alone.

        No bit of another world changes.

        Args:
            seeds: Episode seeds, one per world.
            worlds: World indices; all worlds by default.
            spawn: The robot's pose at the reset instead of the task's spawn pose.
            samples: Samples of the objects' poses instead of those that the seeds draw, one mapping per world.
            modes: Modes of the episodes, one per world, all with this environment's scene; by default `mode`.

        Raises:
            InputError: Another number of seeds, samples or modes than of worlds, a world that is not in the batch or
                named twice, or a mode with another scene.
        """
        rows = self._rows(worlds)
        for name, given in (("seeds", seeds), ("samples", samples), ("modes", modes)):
            if given is not None and len(given) != len(rows):
                raise InputError(f"{len(given)} {name} for {len(rows)} worlds")
        for mode in set(modes or ()):
            if self.spec.scene_name(mode, self.rules) != self.spec.scene_name(self.mode, self.rules):
                raise InputError(
                    f"mode {mode}: has another scene than mode {self.mode}, for which the worlds are built"
                )
        p, h = self.physics, self.scene.robot
        qpos = p.qpos0[rows].copy()
        mocap_pos = np.tile(p.mocap_pos0, (len(rows), 1, 1))
        mocap_quat = np.tile(p.mocap_quat0, (len(rows), 1, 1))
        qpos[:, h.joint_qpos] = g1.DEFAULT_POSE
        qpos[:, h.hand_qpos] = 0.0
        for k, (seed, world) in enumerate(zip(map(int, seeds), rows.tolist(), strict=True)):
            pose = (self.spec.spawn_position, self.spec.spawn_quat) if spawn is None else spawn(seed)
            qpos[k, h.root_qpos : h.root_qpos + 7] = np.concatenate(pose)
            mode = self.modes[world] = self.mode if modes is None else modes[k]
            draws = self.draws[world] = self.spec.draw(seed, mode, self.rules, None if samples is None else samples[k])
            for prim, placed in draws.placed.items():
                if self.scene.has_body(f"{prim}/Frame"):
                    mocap = self.scene.mocap_id(prim)
                    mocap_pos[k, mocap], mocap_quat[k, mocap] = placed.pos, placed.quat
                    mocap_pos[k, mocap, 2] += self._raised[prim]
                else:
                    address = self.scene.joint_qpos(prim)
                    qpos[k, address : address + 3] = placed.pos
                    qpos[k, address + 2] += self._raised[prim]
                    qpos[k, address + 3 : address + 7] = placed.quat
            if self._lights is not None:
                self._lights.set(world, draws.light)
        self._set_dynamics(rows, seeds)
        p.reset_worlds(rows, qpos, mocap_pos, mocap_quat)
        mask = self._mask(rows)
        self.loop.fresh(mask, prefill=self.rules.startup.prefill)
        self.loop.anchor(mask)
        chosen = self._chosen.choose(mask).warp
        self.judge.reset(chosen)
        reset.launch_clear(chosen, self._streak)
        kernels.launch_clear_log(self._log, chosen, -self.startup_ticks)
        self.tick[rows] = -self.startup_ticks
        self.active[rows] = True
        self._anchored[rows] = False

    def _set_dynamics(self, rows: np.ndarray, seeds: Sequence[int]) -> None:
        """Give worlds the dynamics that were drawn for their episodes; without any, those of the scene."""
        samples = [draws.dynamics if (draws := self.draws[world]) is not None else {} for world in rows.tolist()]
        self.physics.set_dynamics(rows, samples)
        self.loop.delay(rows, samples)
        if self._late is None and any(samples):
            self._late = Delay(self.worlds, STATE_WIDTH, self.torch_device)
        if self._noise is None and any(value_of(sample, name) > 0.0 for sample in samples for name in NOISES):
            noise = self._noise = SensorNoise(self.worlds, self.torch_device)
            self.loop.measured = lambda state: noise.on_robot(state, self.tick)
        for seed, world, sample in zip(seeds, rows.tolist(), samples, strict=True):
            if self._noise is not None:
                self._noise.set(world, int(seed), sample)
            if value_of(sample, "picture_noise") > 0.0 and not self.cameras:
                raise InputError(f"mode {self.modes[world]}: picture_noise, but the policy wants no picture")
            if self._late is not None:
                self._late.ticks[world] = int(value_of(sample, "state_latency"))
            pushed = value_of(sample, "push") > 0.0
            self._push_tick[world] = round(value_of(sample, "push_time") * self.budget) if pushed else NO_TICK

    def _push(self, stepping: np.ndarray) -> None:
        """Push the robots whose time has come."""
        hit = stepping & (self.tick == self._push_tick)
        if not hit.any():
            return
        change = np.zeros((self.worlds, 6), dtype=np.float32)
        for world in np.flatnonzero(hit).tolist():
            draws = self.draws[world]
            assert draws is not None
            heading = value_of(draws.dynamics, "push_heading")
            change[world, :2] = value_of(draws.dynamics, "push") * np.array((np.cos(heading), np.sin(heading)))
        self.physics.add_velocity(change, hit)

    def release(self, worlds: Sequence[int] | np.ndarray) -> None:
        """End the episodes of `worlds`: they stand still until their next reset."""
        self.active[self._rows(worlds)] = False

    def _rows(self, worlds: Sequence[int] | np.ndarray | None) -> np.ndarray:
        rows = np.arange(self.worlds) if worlds is None else np.asarray(worlds, dtype=np.int64)
        if len(rows) and (rows.min() < 0 or rows.max() >= self.worlds or len(set(rows.tolist())) < len(rows)):
            raise InputError(f"worlds {rows.tolist()}: expected different numbers from 0 to {self.worlds - 1}")
        return rows

    def _mask(self, rows: np.ndarray) -> np.ndarray:
        mask = np.zeros(self.worlds, dtype=bool)
        mask[rows] = True
        return mask

    def observe(self, mask: np.ndarray | None = None, *, image: bool = False) -> Observation:
        """State 64 of every world and, if asked, the cameras' pictures of the worlds in `mask`.

        At a world's step 0 it is anchored first: its heading is relative to the robot as it is then.

        Args:
            mask: Worlds that ask, bool, shape [worlds]; by default all that run and are past their start-up.
            image: Render the cameras too.

        Returns:
            The observation; its state is a live view of the environment's buffer, or late by the episode's latency.

        Raises:
            InputError: A picture is asked for, but the environment has no camera.
        """
        self._anchor(self.active)
        self._observe()
        state = self._state if self._late is None else self._late.late(self._state)
        if self._noise is not None:
            state = self._noise.on_state(state, self.tick)
        images, depths = dict[str, torch.Tensor](), dict[str, torch.Tensor]()
        if image and not self.cameras:
            raise InputError("the policy needs images, but the environment was built without a camera")
        for name, camera in self.cameras.items() if image else ():
            images[name] = self.render(camera, mask)
            if self._noise is not None:
                asked = np.ones(self.worlds, dtype=bool) if mask is None else mask
                images[name] = self._noise.on_picture(name, images[name], asked, self.tick)
            if self.camera_configs[name].depth:
                depths[name] = camera.distance_picture().half()
        return Observation(
            state=state,
            image=images.get(FRONT),
            mask=self.active & (self.tick >= 0) if mask is None else mask,
            task=self.spec.name,
            gym_id=self.spec.gym_id,
            instruction=self.spec.instruction,
            tracker=self.tracker.name,
            images=images,
            depths=depths,
        )

    def render(self, camera: Camera, mask: np.ndarray | None = None) -> torch.Tensor:
        """Picture of one camera, uint8, shape [worlds, H, W, 3]; worlds outside `mask` keep their last picture."""
        if self._newton_state is None:
            self._newton_state = self.scene.model.state()
        self.physics.write_newton_state(self._newton_state)
        return camera.render(self._newton_state, mask)

    def _anchor(self, mask: np.ndarray) -> None:
        """Step 0 of episodes: heading and reference are taken from the robot as it is now, counters restart."""
        mask = mask & (self.tick == 0) & ~self._anchored
        if not mask.any():
            return
        self._anchored |= mask
        chosen = self._chosen.choose(mask).warp
        self.loop.anchor(mask)
        self.judge.reset(chosen)
        if self._late is not None:
            self._late.forget(self._chosen.torch)
        kernels.launch_clear_log(self._log, chosen, 0)
        self.physics.lock_latch(chosen)

    def step(self, action: torch.Tensor | np.ndarray, worlds: np.ndarray | None = None) -> np.ndarray:
        """Advance active worlds by one tick.

        Args:
            action: Canonical actions, float32, shape [worlds, 40]; rows of worlds in their start-up are replaced by the
                standing action.
            worlds: Worlds that advance, bool, shape [worlds]; all active ones by default. The others keep every bit of
                their state, their judgement and, where the tracker's `step` takes a mask, their tracker's history, so
                that one world can be reset and led through its start-up while the others wait.

        Returns:
            Status codes of `arena_newton.kernels.tick`, int32, shape [worlds]; in the start-up only falls and errors
            count, and a world that did not advance has `RUNNING`. A world goes on until its next reset or release,
            whatever its code.

        Raises:
            InputError: No world runs an episode, actions of another shape, or a tracker's answer that fits no robot.
        """
        action = torch.as_tensor(action)
        if action.shape != self.loop.action.shape:
            raise InputError(f"actions of shape {list(action.shape)}, expected {list(self.loop.action.shape)}")
        stepping = self.active.copy() if worlds is None else self.active & worlds
        if not stepping.any():
            raise InputError("no world runs an episode: call reset() first")
        self._anchor(stepping)
        self.loop.action.copy_(action)
        starting = stepping & (self.tick < 0)
        if starting.any():
            self.loop.action[torch.from_numpy(starting).to(self.torch_device)] = self._stand
        if self._late is not None:
            self._observe()
            self._late.keep(self._state, self._stepping.choose(stepping).torch)
        self.loop.tick(self.loop.action, stepping)
        self._push(stepping)
        self.physics.set_active(stepping)
        self.physics.step()
        return self.judge_tick(stepping)

    def judge_tick(self, stepping: np.ndarray) -> np.ndarray:
        """Judge what the physics has after a tick of some worlds, bool, shape [worlds]; codes as of `step`."""
        starting = stepping & (self.tick < 0)
        self._stepping.choose(stepping)
        if (stepping == self.active).all():
            self.judge.evaluate(self.physics)
            self._rule()
        else:
            self._judge_some()
        self.tick[stepping] += 1
        status = np.where(stepping, self._statuses(), kernels.RUNNING).astype(np.int32)
        early = starting & ((status == kernels.SUCCESS) | (status > kernels.EVENT))
        if early.any():
            status[early] = np.where(self._fallen.numpy()[early] != 0, kernels.FALL, kernels.RUNNING)
        return status

    def _statuses(self) -> np.ndarray:
        """Status codes of the last tick, int32, shape [worlds]."""
        codes: np.ndarray = self._status.numpy() if self._status_view is None else self._status_view
        return codes

    def _judge_some(self) -> None:
        """Judge the tick, but leave counters and verdicts of the worlds that did not step as they were."""
        judge = self.judge
        arrays = (*judge.counters, judge.success, judge.margin, judge.event, judge.predicates)
        views = [wp.to_torch(a) for a in (*arrays, self._streak, self._fallen, self._trigger, self._pressed)]
        kept = [view.clone() for view in views]
        judge.evaluate(self.physics)
        self._rule()
        mask = self._stepping.torch
        for view, before in zip(views, kept, strict=True):
            view.copy_(torch.where(mask.view(-1, *[1] * (view.ndim - 1)), view, before))

    def verdict(self, world: int) -> Verdict:
        """Judgement of a world's episode so far, by the judge and the physics.

        Args:
            world: World index.
        """
        log, row = self._log, int(world)

        def at(array: wp.array) -> int:
            return int(array.numpy()[row])

        names = [predicate.name for predicate in self.spec.predicates]
        ticks = [None if tick == kernels.NEVER else int(tick) for tick in log.predicate_ticks.numpy()[row]]
        held = sum(tick is not None for tick in ticks)
        events = []
        if at(log.contact_tick) != kernels.NEVER:
            events.append(EpisodeEvent("contact", at(log.contact_tick)))
        if at(log.event):
            reason = self.spec.events[at(log.event)]
            events.append(EpisodeEvent("object_out", at(log.event_tick), reason.removesuffix("_out")))
        if at(log.fall_trigger):
            events.append(EpisodeEvent("fall", at(log.fall_tick), FALL_TRIGGERS[at(log.fall_trigger)]))
        return Verdict(
            margin=float(self.judge.margin.numpy()[row]),
            overflow=self.physics.overflowed(row),
            predicates=dict(zip(names, ticks, strict=True)),
            progress=1.0 if ticks and ticks[-1] is not None else held / max(len(ticks), 1),
            events=tuple(sorted(events, key=lambda event: event.tick)),
        )
