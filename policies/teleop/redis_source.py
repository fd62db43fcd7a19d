"""A person's actions from a Redis server, as the original benchmark's PICO sender writes them; state goes back.

One transaction reads all keys of a tick and one writes all, so that body, hands and time belong together. Two machines
have two clocks: a frame is new when its time changed, and old when it has not changed for `STALE` by our clock.
"""

from __future__ import annotations

import io
import json
import time
from collections.abc import Callable
from typing import get_args

import numpy as np
import redis
import torch
from PIL import Image
from redis.backoff import NoBackoff
from redis.retry import Retry

from arena_newton.errors import InputError
from arena_newton.files.text import plain_text
from arena_newton.policies.teleop import redis_keys as keys
from arena_newton.policies.teleop.redis_reference import Reference
from arena_newton.policies.teleop.source import Control, Telemetry, Wish
from arena_newton.robot.canonical import HAND_CLOSED
from arena_newton.robot.g1 import HAND_CLOSE_LEFT, HAND_CLOSE_RIGHT, HAND_OPEN
from arena_newton.robot.rotations import roll_pitch

__all__ = ["RedisSource", "connect"]

STALE = 0.3
"""A sender that has written nothing new for this time is silent, and the robot comes to a stand [s]."""
ANSWER = 0.1
"""A server that does not answer within this time counts as lost [s]."""
AGAIN = 1.0
"""Time between two attempts to reach a lost server [s]."""
QUALITY = 80
"""Quality of the head camera's JPEG."""
COMMANDS: dict[str, Control] = {name: name for name in get_args(Control) if name != "quit"}
"""The original's commands, which are the session's."""
MOST_LINES = 50
"""Most kinds of unfit input that are reported."""
RESET: Control = "discard_and_reset"
"""Control for a reset from outside: an episode that was reset is no demonstration."""


def connect(host: str, port: int, db: int) -> redis.Redis:
    """A connection to a Redis server that answers.

    Raises:
        InputError: It does not answer, or has no such database.
    """
    client = redis.Redis(
        host=host, port=port, db=db, socket_timeout=ANSWER, socket_connect_timeout=ANSWER, retry=Retry(NoBackoff(), 0)
    )
    try:
        client.ping()
    except (redis.RedisError, OSError, ValueError, OverflowError) as error:
        client.close()
        raise InputError(f"--host {host} --port {port} --db {db}: no Redis server ({plain_text(str(error))})") from None
    return client


class RedisSource:
    """Reads one sender's stream; a `Source` of teleoperation."""

    name = "redis"

    def __init__(
        self,
        client: redis.Redis,
        reference: Reference,
        *,
        clock: Callable[[], float] = time.monotonic,
        say: Callable[[str], None] = print,
    ):
        """Read nothing yet.

        Args:
            client: Connection, of `connect`.
            reference: What the sender sends (`redis_reference`).
            clock: Time [s].
            say: Takes one line about each kind of unfit input, once.
        """
        self.client, self.reference = client, reference
        self.backend = keys.BACKENDS[reference.backend]
        self._clock, self._say = clock, say
        self._reported: set[str] = set()
        self._begun = False
        self._stamps: tuple[float | None, float | None] = (None, None)
        self._frame: np.ndarray | None = None
        self._hands: np.ndarray | None = None
        self._fresh_at = 0.0
        self._sequence: int | None = None
        self._started = False
        self._lost_at: float | None = None
        self._shown: np.ndarray | None = None
        self._asked = (
            *(keys.T_ACTION, keys.GMR_FRAME_INDEX, keys.RECORDING_CONTROL, keys.RESET_TRIGGER, keys.CONTROLLERS),
            *keys.ACTION_HANDS,
            *reference.keys,
        )

    def begin(self, view: Telemetry) -> None:
        """An episode begins: what was sent before is forgotten, and the sender is notified that input counts from now.

        After the person's own `start` the sender's stream goes on as it is: a new epoch would put it back to idle.
        """
        self.reference.begin()
        own, self._started = self._started, False
        begun, self._begun = self._begun, True
        if own:
            self._frame = None
            return
        self._try(lambda: self._announce(after_reset=begun))

    def _announce(self, *, after_reset: bool = False) -> None:
        """Delete the stream, and publish a new epoch."""
        self._frame, self._hands, self._stamps = None, None, (None, None)
        with self.client.pipeline(transaction=True) as pipe:
            pipe.delete(*self.backend.stream, keys.RESET_TRIGGER)
            if after_reset:
                done = {"status": "complete", "timestamp": _now_ms()}
                pipe.set(keys.RESET_COMPLETE, json.dumps(done), ex=keys.RESET_TTL)
            pipe.set(self.backend.ready, keys.input_ready(self.backend))
            pipe.execute()

    def wish(self, view: Telemetry) -> Wish:
        """The action of this tick; none while the sender is silent or sends what is unfit."""
        self._started = False
        values = self._try(self._values)
        if values is None:
            return Wish(None)
        control = self._control(values, view)
        new = self._take(values)
        if self._frame is None or self._clock() - self._fresh_at > STALE:
            return Wish(None, control)
        action = self.reference.action(self._frame, self._hands, new=new)
        if self.reference.limited:
            self._tell(f"the sender's {self.reference.limited} jumped: limited")
        return Wish(action, control)

    def _values(self) -> dict[str, bytes]:
        """All keys of a tick, each at most one byte longer than what is accepted; empty where it is absent."""
        with self.client.pipeline(transaction=True) as pipe:
            for key in self._asked:
                pipe.getrange(key, 0, keys.LARGEST)
            found = pipe.execute(raise_on_error=False)
        values = {}
        for key, value in zip(self._asked, found, strict=True):
            if isinstance(value, redis.ResponseError):
                self._tell(f"{key}: is not a text")
            values[key] = value if isinstance(value, bytes) else b""
        return values

    def _control(self, values: dict[str, bytes], view: Telemetry) -> Control:
        """The person's command, once for each sequence; a reset from outside."""
        found: Control = "none"
        try:
            recorded = keys.recording_command(values[keys.RECORDING_CONTROL])
            if recorded is not None and recorded.sequence != self._sequence:
                if recorded.command not in COMMANDS:
                    raise InputError(f"{keys.RECORDING_CONTROL}: command {plain_text(recorded.command, 40)!r} unknown")
                self._sequence, found = recorded.sequence, COMMANDS[recorded.command]
        except InputError as error:
            self._tell(str(error))
        if values[keys.RESET_TRIGGER]:
            self._try(lambda: self.client.delete(keys.RESET_TRIGGER))
            if found in ("none", "cancel"):
                found = RESET
            elif found == "save":
                found = "save_and_reset"
        self._started = found == "start"
        return found

    def _take(self, values: dict[str, bytes]) -> bool:
        """Keep a frame that is new and fit; whether there was one."""
        try:
            stamps = (
                keys.stamp(keys.T_ACTION, values[keys.T_ACTION]),
                keys.stamp(keys.GMR_FRAME_INDEX, values[keys.GMR_FRAME_INDEX]),
            )
            if stamps == self._stamps or stamps == (None, None):
                return False
            self._stamps = stamps
            parts = [values[key] for key in self.reference.keys]
            if not all(parts):
                return False
            left, right = (values[key] for key in keys.ACTION_HANDS)
            hands = keys.closed_hands(values[keys.CONTROLLERS], (left, right))
            frame = self.reference.read(parts)
        except InputError as error:
            self._tell(str(error))
            return False
        self._frame, self._fresh_at = frame, self._clock()
        self._hands = self._hands if hands is None else hands
        return True

    def show(self, view: Telemetry) -> None:
        """Write state, camera and status back, all at once."""
        quat = torch.from_numpy(view.root_quat.astype(np.float64))
        body = np.concatenate([view.ang_vel_body, roll_pitch(quat).numpy(), view.joint_pos])
        closed = np.zeros(2) if self._hands is None else self._hands
        hands = [
            list(close if is_closed >= HAND_CLOSED else HAND_OPEN)
            for close, is_closed in zip((HAND_CLOSE_LEFT, HAND_CLOSE_RIGHT), closed, strict=True)
        ]
        status = {
            "tick": view.tick,
            "recording": view.recording,
            "outcome": view.outcome,
            "note": view.note,
            "factor": round(view.factor, 3),
        }

        def write() -> None:
            with self.client.pipeline(transaction=True) as pipe:
                pipe.set(keys.STATE_BODY, json.dumps([round(float(n), 6) for n in body]))
                for key, targets in zip(keys.STATE_HANDS, hands, strict=True):
                    pipe.set(key, json.dumps(targets))
                pipe.set(keys.STATE_NECK, "[0.0, 0.0]")  # the G1 of the benchmark has none
                pipe.set(keys.T_STATE, _now_ms())
                pipe.set(keys.STATUS, json.dumps(status))
                if view.image is not None and view.image is not self._shown:
                    pipe.set(keys.CAMERA, _jpeg(view.image))
                pipe.execute()
            self._shown = view.image

        self._try(write)

    def close(self) -> None:
        """Take back that input is wanted, and disconnect."""
        self._try(lambda: self.client.delete(self.backend.ready))
        self.client.close()

    def _try[T](self, call: Callable[[], T]) -> T | None:
        """Ask the server; None while it is lost. A server that is back gets a new epoch."""
        now = self._clock()
        try:
            if self._lost_at is not None:
                if now - self._lost_at < AGAIN:
                    return None
                self._lost_at = now
                self._announce()
                self._lost_at = None
                self._say("Redis: the server is back")
            return call()
        except (redis.RedisError, OSError) as error:
            if self._lost_at is None:
                self._say(f"Redis: {plain_text(str(error), 120)}; the robot stands until the server is back")
            self._lost_at, self._frame = now, None
            return None

    def _tell(self, line: str) -> None:
        """Say each kind of line once: numbers in it do not make it another kind."""
        kind = "".join(c for c in line if not c.isdigit())
        if kind not in self._reported and len(self._reported) < MOST_LINES:
            self._reported.add(kind)
            self._say(f"Redis: {line}")


def _now_ms() -> int:
    return int(time.time() * 1e3)


def _jpeg(image: np.ndarray) -> bytes:
    file = io.BytesIO()
    Image.fromarray(image).save(file, "JPEG", quality=QUALITY)
    return file.getvalue()
