"""ArenaEnv: a batch of worlds of one task, judged by one rule set, moved by one tracker.

A world's episode has two phases: the start-up, in which the robot takes its stance under a standing command for as many
ticks as the rule set says (none in `released`), and the episode proper, whose step 0 is the policy's first action.
"""

from __future__ import annotations

import dataclasses
import functools
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton import robot as g1
from arena_newton.canonical import STAND_ACTION
from arena_newton.errors import InputError
from arena_newton.interfaces import EpisodeResult, Observation, RobotState, TrackerCommand

if TYPE_CHECKING:
    from arena_newton.robot import DriveGains
    from arena_newton.rules import RuleSet

__all__ = ["STAND_ACTION", "ArenaEnv", "Spawn"]

Spawn = Callable[[int], tuple[Sequence[float], Sequence[float]]]
"""Episode seed → the robot's root position [m] and orientation wxyz at the reset."""

EVENTS = {1: "ball_out"}
"""A judge's event number → reason of the timeout."""


class ArenaEnv:
    """A batch of worlds; see `run_episodes` for the loop that keeps all of them busy."""

    def __init__(
        self,
        task: str,
        *,
        tracker: Any,
        worlds: int = 20,
        engine: str = "auto",
        device: str | None = None,
        rules: str | RuleSet = "paper",
        mode: str = "base",
        variant_file: str | None = None,
        fast_physics: bool = False,
        drive: DriveGains | None = None,
        camera: Any = None,
        threads: int | None = None,
    ):
        """Build the scene and bind tracker, judge and kernels.

        Args:
            task: Task name.
            tracker: A bound-once tracker (`arena_newton.trackers`).
            worlds: Worlds in the batch.
            engine: `auto`, `mujoco` or `warp`.
            device: Warp device, such as `cpu` or `cuda:0`.
            rules: Rule set or its name.
            mode: `base`, `execution`, `semantic` or `visual`.
            variant_file: A user's USD layer instead of the task's own scene.
            fast_physics: Use the tracker's fast physics rate.
            drive: Drive of the robot's joints instead of the one that tracker and rule set ask for.
            camera: `CameraConfig` of the head camera for policies that see, or None.
            threads: CPU threads of engine `mujoco`; all by default.

        Raises:
            InputError: Something named in the message is missing or does not fit.
        """
        import torch
        import warp as wp

        from arena_newton import rule_sets, tasks
        from arena_newton.kernels import canonical
        from arena_newton.physics import make_physics, resolve_engine
        from arena_newton.scene import load_scene

        if worlds < 1:
            raise InputError(f"--worlds {worlds}: must be at least 1")
        self.spec = tasks.get(task)
        self.rules = rule_sets.get(rules) if isinstance(rules, str) else rules
        self.mode = mode
        self.tracker = tracker
        self.worlds = worlds
        self.engine, device = resolve_engine(engine, device)
        self.drive = drive or self._own_drive(tracker, self.rules)
        self.scene = load_scene(
            task,
            worlds=worlds,
            device=device,
            variant=None if variant_file and mode != "semantic" else self.spec.variant(mode, self.rules),
            rules=self.rules,
            drive=self.drive,
            variant_file=variant_file,
            native=self.engine == "mujoco",
        )
        self.rate = tracker.fast_physics_rate if fast_physics else tracker.physics_rate
        self.physics = make_physics(self.scene, self.rate, self.engine, threads)
        self.device = self.physics.device
        self.torch_device = wp.device_to_torch(self.device)
        self._raised = {o.prim: o.raised(self.scene) for o in self.spec.objects}
        self.judge = self.spec.judge(self.scene, self.rules)
        self.judge.bind(self.physics)

        h = self.scene.robot
        canonical_order = np.array(g1.CANONICAL_TO_MUJOCO)

        def ints(values: Iterable[int]) -> Any:
            return wp.array(np.asarray(list(values), dtype=np.int32), dtype=wp.int32, device=self.device)

        def zeros(*shape: int, dtype: Any = wp.float32) -> Any:
            return wp.zeros(shape, dtype=dtype, device=self.device)

        self._canonical_qpos = ints(h.joint_qpos[canonical_order])
        self._canonical_qvel = ints(h.joint_qvel[canonical_order])
        self._joint_ctrl, self._hand_ctrl = ints(h.joint_ctrl), ints(h.hand_ctrl)
        hands = len(h.hand_ctrl)
        close = (g1.HAND_CLOSE_LEFT + g1.HAND_CLOSE_RIGHT)[:hands]
        self._hand_close = wp.array(np.array(close, np.float32), dtype=wp.float32, device=self.device)
        self._hand_open = wp.array(
            np.array((g1.HAND_OPEN * 2)[:hands], np.float32), dtype=wp.float32, device=self.device
        )
        self._critical = ints(h.critical_bodies)
        self.reference = canonical.ReferencePose.allocate(
            worlds, self.device, canonical_to_mujoco=g1.CANONICAL_TO_MUJOCO, tick=g1.TICK
        )
        self._state64, self._action = zeros(worlds, 64), zeros(worlds, 40)
        self._stand = wp.array(STAND_ACTION, dtype=wp.float32, device=self.device)
        self._streak, self._fallen = zeros(worlds, dtype=wp.int32), zeros(worlds, dtype=wp.int32)
        self._bad_state, self._bad_action = zeros(worlds, dtype=wp.int32), zeros(worlds, dtype=wp.int32)
        self._bad_targets, self._targets = zeros(worlds, dtype=wp.int32), zeros(worlds, len(h.joint_ctrl))
        self._status, self._mask = zeros(worlds, dtype=wp.int32), zeros(worlds, dtype=wp.int32)
        self._mask_host = np.zeros(worlds, dtype=np.int32)

        t = wp.to_torch
        self._t_qpos, self._t_qvel = t(self.physics.qpos), t(self.physics.qvel)
        self._t_action, self._t_state, self._t_targets = t(self._action), t(self._state64), t(self._targets)

        def indices(values: Sequence[int] | np.ndarray) -> Any:
            return torch.tensor(values, dtype=torch.long, device=self.torch_device)

        self._i_q, self._i_v = indices(h.joint_qpos), indices(h.joint_qvel)
        self._to_mujoco = indices(g1.MUJOCO_TO_CANONICAL)
        self._t_stand = torch.tensor(STAND_ACTION, device=self.torch_device)
        self._t_ref_joints, self._t_ref_vel = t(self.reference.joints), t(self.reference.joint_vel)
        self._t_mimic, self._t_ref_quat = t(self.reference.mimic), t(self.reference.quat)
        tracker.bind(worlds, self.torch_device)

        self.startup_ticks: int = self.rules.startup.ticks
        """Length of the start-up [ticks]."""
        self.tick = np.zeros(worlds, dtype=np.int64)
        """Ticks since each world's step 0; negative during its start-up."""
        self.active = np.zeros(worlds, dtype=bool)
        """Worlds that run an episode."""
        self._fresh, self._anchored = np.zeros(worlds, dtype=bool), np.zeros(worlds, dtype=bool)
        self.draws: list[Any] = [None] * worlds
        self.lights: Any = None
        self.camera: Any = None
        if camera is not None:
            self.add_camera(camera)

    @staticmethod
    def _own_drive(tracker: Any, rules: RuleSet) -> DriveGains:
        original = getattr(tracker, "original_drive", None)
        return original if rules.original_drive and original is not None else tracker.drive

    def describe(self) -> dict[str, Any]:
        """What ran, for results to record: engine, physics rate, drive, start-up and tracker."""
        return {
            "engine": self.engine,
            "device": str(self.device),
            "physics_dt": self.rate.dt,
            "substeps": self.rate.substeps,
            "drive": self.drive.name,
            "gains": {key: value for key, value in dataclasses.asdict(self.drive).items() if key != "name"},
            "startup_ticks": self.startup_ticks,
            "history": self.rules.startup.history,
            "tracker": self.tracker.describe(),
        }

    def close(self) -> None:
        """Let go of the physics' threads; the environment steps no more."""
        self.physics.close()
        self.active[:] = False

    def add_camera(self, config: Any) -> Any:
        """Attach the head camera (done at construction when `camera` is given)."""
        from arena_newton.pictures.camera import Camera

        self.camera = Camera.from_scene(
            self.scene,
            self.physics,
            prim=config.prim,
            width=config.width,
            height=config.height,
            lights=self._lights(),
            fit=config.fit,
            samples=config.samples,
        )
        return self.camera

    def _lights(self) -> Any:
        from arena_newton.pictures.camera import WorldLights

        if self.lights is None:
            self.lights = WorldLights.allocate(self.worlds, self.device, self.scene.stage)
            for w, draws in enumerate(self.draws):
                self.lights.set(w, draws.light if draws is not None else None)
        return self.lights

    def reset(
        self,
        seeds: Sequence[int],
        worlds: Sequence[int] | np.ndarray | None = None,
        *,
        spawn: Spawn | None = None,
    ) -> None:
        """Start an episode in each of `worlds` (all by default) from its episode seed alone.

        Args:
            seeds: Episode seeds, one a world.
            worlds: World indices; all worlds by default.
            spawn: Where the robot stands at the reset instead of the task's spawn pose.

        Raises:
            InputError: Another number of seeds than of worlds, or a world that is not in the batch or named twice.
        """
        from arena_newton.kernels import canonical, reset

        rows = np.arange(self.worlds) if worlds is None else np.asarray(worlds, dtype=np.int64)
        if len(seeds) != len(rows):
            raise InputError(f"{len(seeds)} seeds for {len(rows)} worlds")
        if len(rows) and (rows.min() < 0 or rows.max() >= self.worlds or len(set(rows.tolist())) < len(rows)):
            raise InputError(f"worlds {rows.tolist()}: expected different numbers from 0 to {self.worlds - 1}")
        p, h = self.physics, self.scene.robot
        qpos = p.qpos0[rows].copy()
        mocap_pos = np.tile(p.mocap_pos0, (len(rows), 1, 1))
        mocap_quat = np.tile(p.mocap_quat0, (len(rows), 1, 1))
        place = spawn or (lambda _: (self.spec.spawn_position, self.spec.spawn_quat))
        qpos[:, h.joint_qpos] = g1.DEFAULT_POSE
        qpos[:, h.hand_qpos] = 0.0
        for k, (seed, w) in enumerate(zip(seeds, rows, strict=True)):
            qpos[k, h.root_qpos : h.root_qpos + 7] = np.concatenate(place(int(seed)))
            draws = self.draws[w] = self.spec.draw(int(seed), self.mode, self.rules)
            for prim, pose in draws.placed.items():
                if self.scene.has_body(f"{prim}/Frame"):
                    mocap = self.scene.mocap_id(prim)
                    mocap_pos[k, mocap], mocap_quat[k, mocap] = pose.pos, pose.quat
                else:
                    address = self.scene.joint_qpos(prim)
                    qpos[k, address : address + 3] = pose.pos
                    qpos[k, address + 2] += self._raised[prim]
                    qpos[k, address + 3 : address + 7] = pose.quat
            if self.lights is not None:
                self.lights.set(int(w), draws.light)
        p.reset_worlds(rows, qpos, mocap_pos, mocap_quat)
        mask = self._upload(rows)
        canonical.launch_reset_reference(self.reference, p.qpos, h.root_qpos, mask)
        self.judge.reset(mask)
        reset.launch_clear(mask, self._streak)
        self.tracker.reset(self._torch_mask(rows))
        self.tick[rows] = -self.startup_ticks
        self.active[rows] = True
        self._fresh[rows] = self.rules.startup.prefill
        self._anchored[rows] = False

    def _upload(self, rows: np.ndarray) -> Any:
        host = np.zeros(self.worlds, dtype=np.int32)
        host[rows] = 1
        if not np.array_equal(host, self._mask_host):
            self._mask_host = host
            self._mask.assign(host)
        return self._mask

    def _take_targets(self, targets: Any) -> None:
        """Copy a tracker's answer into the environment's own buffer.

        Raises:
            InputError: It is no float32 tensor of one row a world.
        """
        import torch

        expected = self._t_targets.shape
        if not isinstance(targets, torch.Tensor) or targets.shape != expected or targets.dtype != torch.float32:
            given = f"{targets.dtype} {list(targets.shape)}" if hasattr(targets, "dtype") else type(targets).__name__
            raise InputError(
                f"tracker {self.tracker.name}: joint targets are {given}, expected a torch.float32 tensor of shape "
                f"{list(expected)}"
            )
        self._t_targets.copy_(targets)

    def _torch_mask(self, rows: np.ndarray) -> Any:
        import torch

        host = np.zeros(self.worlds, dtype=bool)
        host[rows] = True
        return torch.from_numpy(host).to(self.torch_device)

    def observe(self, mask: np.ndarray | None = None, *, image: bool = False) -> Observation:
        """State 64 of every world and, if asked, the head camera's picture of the worlds in `mask`.

        At a world's step 0 its frame is laid down first: headings are relative to the robot as it stands then.

        Args:
            mask: Worlds that ask, bool, shape [worlds]; by default all that run and are past their start-up.
            image: Render the head camera too.

        Returns:
            The observation; its state is a live view of the environment's buffer.
        """
        from arena_newton.kernels import canonical

        self._anchor()
        p, h = self.physics, self.scene.robot
        canonical.launch_state64(
            p.qpos,
            p.qvel,
            h.root_qpos,
            h.root_qvel,
            self._canonical_qpos,
            self._canonical_qvel,
            self.reference.heading,
            self._state64,
        )
        picture = None
        if image:
            if self.camera is None:
                raise InputError("the policy needs images, but the environment was built without a camera")
            picture = self.render(self.camera, mask)
        asked = self.active & (self.tick >= 0) if mask is None else mask
        return Observation(
            state=self._t_state,
            image=picture,
            mask=asked,
            task=self.spec.name,
            gym_id=self.spec.gym_id,
            instruction=self.spec.instruction,
        )

    def render(self, camera: Any, mask: np.ndarray | None = None) -> Any:
        """Render one camera; uint8 torch tensor [worlds, H, W, 3]."""
        if not hasattr(self, "_newton_state"):
            self._newton_state = self.scene.model.state()
        self.physics.write_newton_state(self._newton_state)
        return camera.render(self._newton_state, mask)

    def _anchor(self) -> None:
        """Step 0 of episodes: heading and reference are taken from the robot as it stands now, counters restart."""
        from arena_newton.kernels import canonical

        rows = np.flatnonzero(self.active & (self.tick == 0) & ~self._anchored)
        if not len(rows):
            return
        self._anchored[rows] = True
        mask = self._upload(rows)
        p, h = self.physics, self.scene.robot
        canonical.launch_reset_reference(self.reference, p.qpos, h.root_qpos, mask)
        self.judge.reset(mask)
        p.lock_latch(mask)

    def step(self, action: Any) -> np.ndarray:
        """Advance every active world one tick.

        Args:
            action: Canonical actions, float32 tensor or array [worlds, 40]; rows of worlds in their start-up are
                replaced by the standing command.

        Returns:
            Status codes of `arena_newton.kernels.tick`, int32 [worlds]; in the start-up only falls and errors count.
            A world goes on until its next reset, whatever its code.

        Raises:
            InputError: No world was reset yet, actions of another shape, or a tracker's answer that fits no robot.
        """
        import torch

        from arena_newton.kernels import canonical, fall, reset, tick

        p, h = self.physics, self.scene.robot
        action = torch.as_tensor(action)
        if action.shape != self._t_action.shape:
            raise InputError(f"actions of shape {list(action.shape)}, expected {list(self._t_action.shape)}")
        if not self.active.any():
            raise InputError("no world runs an episode: call reset() first")
        self._anchor()
        self._t_action.copy_(action)
        settling = self.active & (self.tick < 0)
        if settling.any():
            self._t_action[torch.from_numpy(settling).to(self.torch_device)] = self._t_stand
        canonical.launch_validate_action(self._action, self._bad_action)
        tick.launch_sanitize(self._bad_action, self._stand, self._action)
        mask = self._upload(np.flatnonzero(self.active))
        canonical.launch_integrate(self.reference, self._action, mask, self.tracker.max_root_delta_deg)
        command = TrackerCommand(
            mimic=self._t_mimic,
            joints=self._t_ref_joints.index_select(1, self._to_mujoco),
            joint_vel=self._t_ref_vel.index_select(1, self._to_mujoco),
            quat=self._t_ref_quat,
        )
        root, vel = h.root_qpos, h.root_qvel
        state = RobotState(
            quat=self._t_qpos[:, root + 3 : root + 7],
            ang_vel_body=self._t_qvel[:, vel + 3 : vel + 6],
            joint_pos=self._t_qpos.index_select(1, self._i_q),
            joint_vel=self._t_qvel.index_select(1, self._i_v),
        )
        if self._fresh.any():
            self.tracker.prefill(command, state, self._torch_mask(np.flatnonzero(self._fresh)))
            self._fresh[:] = False
        self._take_targets(self.tracker.step(command, state))
        tick.launch_check_targets(self._targets, self._joint_ctrl, p.ctrl, self._bad_targets)
        tick.launch_write_ctrl(
            self._targets,
            self._joint_ctrl,
            self.reference.hands,
            self._hand_ctrl,
            self._hand_open,
            self._hand_close,
            mask,
            p.ctrl,
        )
        p.set_active(self.active)
        p.step()
        self.judge.evaluate(p)
        fall.launch_fall(
            p.qpos,
            h.root_qpos,
            p.contact_force,
            self._critical,
            self._streak,
            self._fallen,
            **self._fall_rule,
        )
        reset.launch_nonfinite(p.qpos, p.qvel, self._bad_state)
        tick.launch_status(
            self.judge.success,
            self._fallen,
            self.judge.event,
            self._bad_state,
            self._bad_action,
            self._bad_targets,
            self._status,
        )
        self.tick[self.active] += 1
        status = self._status.numpy().copy()
        early = settling & ((status == tick.SUCCESS) | (status > tick.EVENT))
        if early.any():
            status[early] = np.where(self._fallen.numpy()[early] != 0, tick.FALL, tick.RUNNING)
        return status

    @functools.cached_property
    def _fall_rule(self) -> dict[str, Any]:
        return dataclasses.asdict(self.rules.fall)

    def run_episodes(
        self,
        policy: Any,
        episodes: Sequence[Any],
        on_finish: Callable[[EpisodeResult], None] | None = None,
        on_tick: Callable[[int], None] | None = None,
        recorder: Any = None,
        max_steps: int | None = None,
        spawn: Spawn | None = None,
    ) -> list[EpisodeResult]:
        """Run planned episodes, giving each world the next one as soon as it is free.

        Args:
            policy: A policy (`arena_newton.policies`).
            episodes: Objects with `episode_seed` (and whatever the caller needs back).
            on_finish: Called with each result, in the order of ending.
            on_tick: Called each tick with the number of active worlds.
            recorder: Takes pictures: `.start(env, world, episode)`, `.tick(env)`, `.finish(env, world, result)`.
            max_steps: Step budget instead of the rule set's.
            spawn: Where the robot stands at a reset instead of the task's spawn pose.

        Returns:
            Results in the order of `episodes`.
        """
        import torch

        from arena_newton.kernels import tick as codes

        budget = max_steps or self.spec.max_steps(self.rules)
        waiting = deque(enumerate(episodes))
        running: list[tuple[int, Any] | None] = [None] * self.worlds
        started = np.zeros(self.worlds)
        results: list[EpisodeResult | None] = [None] * len(episodes)
        chunk = torch.zeros((self.worlds, 1, 40), device=self.torch_device)
        cursor, length = np.zeros(self.worlds, np.int64), np.zeros(self.worlds, np.int64)
        rows = torch.arange(self.worlds, device=self.torch_device)
        policy_errors: dict[int, str] = {}

        def assign(free: list[int]) -> None:
            taken = [(w, *waiting.popleft()) for w in free if waiting]
            for w in free:
                running[w] = None
                self.active[w] = False
            if not taken:
                return
            worlds = [w for w, _, _ in taken]
            self.reset([e.episode_seed for _, _, e in taken], worlds, spawn=spawn)
            mask = np.zeros(self.worlds, dtype=bool)
            mask[worlds] = True
            seeds = [0] * self.worlds
            for w, i, e in taken:
                running[w], started[w] = (i, e), time.perf_counter()
                seeds[w] = e.episode_seed
                length[w] = cursor[w] = 0
                if recorder is not None:
                    recorder.start(self, w, e)
            policy.reset(seeds, [self.spec.gym_id] * self.worlds, mask)

        def finish(w: int, outcome: str, reason: str, error: str | None = None) -> None:
            index, episode = running[w]  # type: ignore[misc]
            startup = outcome == "fall" and self.tick[w] <= 0
            result = EpisodeResult(
                episode=episode,
                outcome=outcome,
                reason="startup_fall" if startup else reason,
                steps=max(int(self.tick[w]), 0),
                margin=float(self.judge.margin.numpy()[w]),
                startup_fall=startup,
                overflow=self.physics.overflowed(w),
                sim_s=float((self.tick[w] + self.startup_ticks) * g1.TICK),
                wall_s=time.perf_counter() - started[w],
                error=error,
            )
            results[index] = result
            if recorder is not None:
                recorder.finish(self, w, result)
            if on_finish is not None:
                on_finish(result)

        attach = getattr(policy, "attach", None)
        if attach is not None:
            attach(self)
        assign(list(range(self.worlds)))
        while self.active.any():
            asks = self.active & (self.tick >= 0) & (cursor >= length)
            if asks.any():
                answer = policy.act(self.observe(asks, image=policy.needs_image))
                actions = torch.as_tensor(answer.actions, dtype=torch.float32, device=self.torch_device)
                if actions.ndim != 3 or actions.shape[::2] != (self.worlds, 40) or not actions.shape[1]:
                    raise InputError(
                        f"policy {getattr(policy, 'name', type(policy).__name__)}: a chunk of shape "
                        f"{list(actions.shape)}, expected [{self.worlds}, n, 40] with n of at least 1"
                    )
                if actions.shape[1] > chunk.shape[1]:
                    chunk = torch.nn.functional.pad(chunk, (0, 0, 0, actions.shape[1] - chunk.shape[1]))
                ask = torch.from_numpy(asks).to(self.torch_device)
                chunk[ask, : actions.shape[1]] = actions[ask]
                cursor[asks], length[asks] = 0, actions.shape[1]
                policy_errors = {w: message for w, message in answer.errors.items() if asks[w]}
                for w, message in policy_errors.items():
                    finish(w, "error", "policy", message)
                if policy_errors:
                    assign(list(policy_errors))
                    continue  # without a start-up the new episodes ask before this tick
            acting = self.active & (self.tick >= 0)
            index = torch.from_numpy(np.where(acting, np.minimum(cursor, chunk.shape[1] - 1), 0)).to(self.torch_device)
            status = self.step(chunk[rows, index])
            cursor[acting] += 1
            if recorder is not None:
                recorder.tick(self)
            ended = []
            for w in np.flatnonzero(self.active):
                code, t = int(status[w]), int(self.tick[w])
                if code == codes.ERROR_STATE:
                    finish(w, "error", "nonfinite_state", "the simulation state of this world became non-finite")
                elif code == codes.ERROR_TARGETS:
                    finish(w, "error", "tracker", f"tracker {self.tracker.name}: a joint target is not finite")
                elif code == codes.ERROR_ACTION:
                    finish(w, "error", "bad_action", "the policy's action is non-finite or its rot6d is degenerate")
                elif code == codes.SUCCESS:
                    finish(w, "success", "success")
                elif code == codes.FALL:
                    finish(w, "fall", "fall")
                elif code > codes.EVENT:
                    finish(w, "timeout", EVENTS[code - codes.EVENT])
                elif t >= budget:
                    finish(w, "timeout", "timeout")
                else:
                    continue
                ended.append(int(w))
            if ended:
                assign(ended)
            if on_tick is not None:
                on_tick(int(self.active.sum()))
        return [r for r in results if r is not None]
