"""One world in real time under a person: start-up, 50 ticks a second, pictures when there is time, saved episodes.

Ticks are never left out; a machine that is too slow runs slower than real time, and the session says so. Pictures are.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch
import warp as wp

from arena_newton.data.recording.demonstration import DemonstrationRecorder
from arena_newton.errors import InputError
from arena_newton.interfaces import EpisodeResult
from arena_newton.kernels import tick as codes
from arena_newton.pictures.camera import Camera
from arena_newton.policies.teleop.pace import Pace, TimedPicture
from arena_newton.policies.teleop.source import Telemetry, Wish
from arena_newton.policies.teleop.standing import Stander
from arena_newton.robot.canonical import STAND_ACTION, validate_action
from arena_newton.robot.g1 import TICK
from arena_newton.rules import seeding

if TYPE_CHECKING:
    from arena_newton.env import ArenaEnv
    from arena_newton.interfaces import Observation
    from arena_newton.pictures.settings import CameraConfig
    from arena_newton.policies.teleop.source import Recording, Source

__all__ = ["PersonEpisode", "SessionReport", "TeleopSession"]

LONGEST = 15_000
"""Ticks after which a recorded episode ends: five minutes."""
PICTURE_PERIOD = 0.125
"""Time between two pictures of the head camera [s]."""
FALLEN = 100
"""Ticks that a robot which fell outside a recording is left alone; then the next episode begins."""


@dataclass
class PersonEpisode:
    """An episode that a person plays."""

    index: int
    """Number of the episode in its session."""
    task: str
    tracker: str
    policy: str
    mode: str
    rules: str
    group_seed: int
    """The session's seed."""
    repeat: int
    """The same as `index`."""
    episode_seed: int
    object_seed: int


@dataclass(frozen=True)
class SessionReport:
    """Report of a session."""

    ticks: int
    """Ticks of 20 ms, start-ups included."""
    late: int
    """Those that began more than 20 ms after their time."""
    factor: float
    """Simulated time over time that passed."""
    pictures: int
    """Pictures of all kinds."""
    shed: int
    """Pictures that were put off for lack of time."""
    saved: tuple[Path, ...]
    """Files of saved episodes."""

    def __str__(self) -> str:
        late = f"{self.late} of {self.ticks} ticks late by more than {TICK * 1000:.0f} ms"
        pictures = f"{self.pictures} pictures, {self.shed} put off"
        saved = f"{len(self.saved)} episode{'s' * (len(self.saved) != 1)} saved"
        return f"real-time factor {self.factor:.3f}; {late}; {pictures}; {saved}"


class TeleopSession:
    """A person's session in one world: `run` returns when the source quits."""

    def __init__(
        self,
        env: ArenaEnv,
        source: Source,
        *,
        folder: Path,
        seed: int,
        camera: CameraConfig | None = None,
        displays: Sequence[tuple[Callable[[], None], float]] = (),
        facts: Mapping[str, object] | None = None,
        say: Callable[[str], None] = print,
        pace: Pace | None = None,
    ):
        """Prepare the first episode.

        Args:
            env: An environment of one world; its head camera is not used.
            source: What a person drives with.
            folder: Where saved episodes are written.
            seed: Number of the session; its episodes have seeds of their own range (`seeding.TELEOPERATION`).
            camera: Pictures that the source gets; None: none.
            displays: What else is drawn, each with the time between two [s].
            facts: What the saved episodes depend on, as JSON.
            say: Takes one line about each saved, lost or ended episode.
            pace: The clock; real time by default.

        Raises:
            InputError: The environment has several worlds, or the folder holds episodes of this seed.
        """
        if env.worlds != 1:
            raise InputError(f"a person drives one world, and the environment has {env.worlds}")
        self.env, self.source, self.folder, self.seed = env, source, folder, seed
        self._say = say
        self.pace = Pace() if pace is None else pace
        self.saved: list[Path] = []
        """Files so far."""
        self._recorder = DemonstrationRecorder(folder, seeds=seeding.TELEOPERATION, facts=facts)
        self._count = 0
        self._episode = self._plan(0)
        first = self._recorder.file(self._episode)
        taken = sorted(folder.glob(first.name.replace("__repeat0000.", "__repeat[0-9]*.")))
        if taken:
            raise InputError(f"--seed {seed}: {taken[0]} is there already; name another seed or --out")
        self._stander = Stander()
        self._recording: Recording = "idle"
        self._note = ""
        self._outcome: str | None = None
        self._ended = 0
        """Ticks since the episode ended."""
        self._image: np.ndarray | None = None
        self._pictures = [TimedPicture(draw, period) for draw, period in displays]
        if camera is not None:
            self._lens = Camera.from_scene(
                env.scene,
                prim=camera.prim,
                width=camera.width,
                height=camera.height,
                fit=camera.fit,
                samples=camera.samples,
                lights=env.lights,
            )
            self._pictures.append(TimedPicture(self._look, PICTURE_PERIOD))
        self._qpos, self._qvel = (wp.to_torch(a) for a in (env.physics.qpos, env.physics.qvel))

    def _plan(self, index: int) -> PersonEpisode:
        env = self.env
        seed = seeding.recording_seed(env.spec.gym_id, seeding.TELEOPERATION, self.seed, index)
        return PersonEpisode(
            index=index,
            task=env.spec.name,
            tracker=env.tracker.name,
            policy=f"teleop-{self.source.name}",
            mode=env.mode,
            rules=env.rules.name,
            group_seed=self.seed,
            repeat=index,
            episode_seed=seed,
            object_seed=seeding.object_seed(seed),
        )

    def _look(self) -> None:
        """Take a picture of the head camera."""
        self._image = self.env.render(self._lens)[0].cpu().numpy().copy()

    def _view(self, observation: Observation) -> Telemetry:
        """The robot as it is now."""
        robot = self.env.scene.robot
        qpos, qvel = self._qpos[0].cpu().numpy(), self._qvel[0].cpu().numpy()
        root, vel = robot.root_qpos, robot.root_qvel
        return Telemetry(
            tick=int(self.env.tick[0]),
            state=observation.state[0].cpu().numpy().copy(),
            root_position=qpos[root : root + 3].astype(np.float32),
            root_quat=qpos[root + 3 : root + 7].astype(np.float32),
            ang_vel_body=qvel[vel + 3 : vel + 6].astype(np.float32),
            joint_pos=qpos[robot.joint_qpos].astype(np.float32),
            joint_vel=qvel[robot.joint_qvel].astype(np.float32),
            image=self._image,
            recording=self._recording,
            outcome=self._outcome,
            note=self._note,
            factor=self.pace.recent,
        )

    def run(self, ticks: int | None = None) -> SessionReport:
        """Play until the source quits.

        Args:
            ticks: End after so many; None: only the source ends it.

        Raises:
            OSError: An episode cannot be written; the error carries the file's name.
        """
        self._begin()
        done = 0
        while ticks is None or done < ticks:
            done += 1
            self.pace.wait()
            if self.env.tick[0] < 0:
                self._tick(self.env.observe(), STAND_ACTION)
            elif not self._live():
                break
            for picture in self._pictures:
                picture.try_draw(self.pace)
        return self.report()

    def report(self) -> SessionReport:
        """Report of the session so far."""
        pace, pictures = self.pace, self._pictures
        drawn, shed = sum(p.drawn for p in pictures), sum(p.shed for p in pictures)
        return SessionReport(pace.ticks, pace.late, pace.factor, drawn, shed, tuple(self.saved))

    def _begin(self) -> None:
        """Begin the next episode with its start-up; whatever was recorded of the last one is gone."""
        self._episode = self._plan(self._count)
        self._count += 1
        self.env.reset([self._episode.episode_seed])
        self._recorder.start(self.env, 0, self._episode)
        self._stander.begin()
        self._outcome, self._ended, self._begun = None, 0, False
        self.pace.restart()

    def _live(self) -> bool:
        """One tick after the start-up; False when the source quits."""
        observation = self.env.observe()
        view = self._view(observation)
        if not self._begun:
            self._begun = True
            self.source.begin(view)
        wish = self.source.wish(view)
        action = self._stander.action(self._checked(wish))
        if wish.control == "quit":
            return False
        if wish.control != "none" and self._control(wish.control):
            return True
        if self._outcome is None:
            self._tick(observation, action)
        else:
            self._after_the_end(view)
        return True

    def _checked(self, wish: Wish) -> np.ndarray | None:
        """The source's action, if it can be executed."""
        if wish.action is None:
            return None
        try:
            return validate_action(wish.action, f"teleop {self.source.name}").reshape(-1)[: len(STAND_ACTION)]
        except InputError as error:
            self._tell(str(error))
            return None

    def _tick(self, observation: Observation, action: np.ndarray) -> None:
        """Move the world by one tick."""
        env, row = self.env, torch.from_numpy(action)[None].to(self.env.torch_device)
        recorded = self._recording == "recording" and env.tick[0] >= 0
        if recorded:
            self._recorder.before_physics(env, observation, row)
        code = int(env.step(row)[0])
        if recorded:
            self._recorder.tick(env)
        self._judge(code)
        self.source.show(self._view(env.observe()))

    def _judge(self, code: int) -> None:
        """End the episode if this tick ended it."""
        tick, event = int(self.env.tick[0]), None
        if code == codes.SUCCESS:
            event = "success"
        elif code == codes.FALL:
            event = "fall"
        elif code > codes.EVENT:
            event = self.env.spec.events[code - codes.EVENT]
        elif code != codes.RUNNING:
            event = "error"
        elif self._recording == "recording" and tick >= LONGEST:
            event = "timeout"
        # Who only practises goes on after a success, or after a ball that rolled away.
        if event in ("fall", "error") or (event and self._recording == "recording"):
            self._outcome = event
            self._tell(f"episode {self._episode.index}: {event} after {max(tick, 0) * TICK:.1f} s")
            if tick <= 0:
                self._begin()
        elif event:
            self._note = event

    def _after_the_end(self, view: Telemetry) -> None:
        """The world is still: a recorded episode waits to be saved or discarded, another one is begun again."""
        self._ended += 1
        self.source.show(view)
        if self._recording != "recording" and self._ended >= FALLEN:
            self._begin()

    def _control(self, control: str) -> bool:
        """Do what the person wants of the recording; True when another episode has begun."""
        recording = self._recording == "recording"
        again = control.endswith("_and_reset")
        if control in ("save", "save_and_reset") and recording:
            self._save()
        elif control in ("cancel", "discard_and_reset") and recording:
            self._recording = "discarded"
            self._tell(f"episode {self._episode.index}: discarded")
        elif control == "start" and not recording:
            again = self.env.tick[0] > 0 or self._outcome is not None
            self._recording = "recording"
            self._note = ""
        if again:
            self._begin()
        return again

    def _save(self) -> None:
        """Write the recorded episode."""
        env, episode = self.env, self._episode
        tick, verdict = int(env.tick[0]), env.verdict(0)
        ended = self._outcome or "stopped"
        result = EpisodeResult(
            episode=episode,
            outcome=ended if ended in ("success", "fall", "error") else "timeout",
            reason=ended,
            steps=max(tick, 0),
            margin=verdict.margin,
            overflow=verdict.overflow,
            sim_s=float((tick + env.startup_ticks) * TICK),
            predicates=verdict.predicates,
            progress=1.0 if ended == "success" else verdict.progress,
            events=verdict.events,
        )
        path = self._recorder.file(episode)
        self._recorder.finish(env, 0, result)
        self.pace.restart()  # the world stood still while the file was written
        if path.exists():
            self._recording = "saved"
            self.saved.append(path)
            self._tell(f"episode {episode.index}: {ended}, saved as {path}")
        else:
            self._recording = "discarded"
            self._tell(f"episode {episode.index}: {ended}, nothing to save")

    def _tell(self, line: str) -> None:
        if line != self._note:
            self._note = line
            self._say(line)
