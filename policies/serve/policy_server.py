"""One policy for many robots: every session is a row of the policy's batch, queries that come close together are one.

A policy's memory belongs to the row, so to the session: `begin` clears it with the episode's seed, and a session that
leaves frees its row. What a session is answered does not depend on which others asked with it, as far as the policy
keeps its promises (docs/howto/bring/policy_server.md). One thread has the policy; every connection has its own
and waits for it.
"""

from __future__ import annotations

import hashlib
import json
import math
import sys
import threading
import time
import traceback
import zlib
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import CancelledError, Future
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
import torch

from arena_newton import tasks
from arena_newton.data.readers.label_protocols import action_names, protocol
from arena_newton.data.recording.layouts import state_names
from arena_newton.errors import ArenaError, InputError
from arena_newton.files.text import plain_text
from arena_newton.interfaces import Observation
from arena_newton.pictures.settings import CAMERAS, FRONT, CameraConfig, policy_cameras
from arena_newton.policies.base import Policy, PolicyUnavailable
from arena_newton.policies.protocols.handshake import RATE, ServedFacts, ServedPicture
from arena_newton.policies.protocols.packed_picture import PackedPicture
from arena_newton.policies.protocols.picture_fit import fitted_picture
from arena_newton.policies.protocols.policy_messages import Begin, Query
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.serve.message_readers import MessageReaders
from arena_newton.robot.canonical import ACTION_WIDTH, IDENTITY_ROT6D, STATE_WIDTH

__all__ = ["Answer", "PolicyServer", "Refused", "ServerCounts"]

LONGEST_ACT = 600.0
"""Time after which a waiting connection gives up on the policy [s]."""
IDLE = 30.0
"""Time without a request after which no batch waits for a session any more, and after which one that no connection
holds may lose its row to another [s]."""
SMALL_MESSAGE = 64 * 2**10
"""Largest message that a connection reads itself [bytes]."""
ABANDONED = 5.0
"""The same of a session whose connection has closed, until it asks over another one [s]."""
WARM_UP_SEED = 0
"""Seed of the query before the first one, which nobody is answered."""

type Reason = Literal["unfit", "unknown_episode", "full", "policy", "closing"]
"""Reason of a refusal: unfit content, an unknown episode, no free row, the policy failed, or the server ends."""


class Refused(ArenaError):
    """A request that gets no answer; one line says why."""

    def __init__(self, reason: Reason, message: str):
        """Say why."""
        super().__init__(plain_text(message, 300))
        self.reason: Reason = reason


@dataclass(frozen=True)
class Answer:
    """Answer to a session."""

    actions: np.ndarray
    """The chunk, float32, shape [n, 40]."""
    infer_ms: float
    """Time from the request to its answer, waiting for a batch included [ms]."""


@dataclass
class ServerCounts:
    """Counts of a server's work so far."""

    episodes: int = 0
    queries: int = 0
    """Queries that were answered by the policy."""
    repeated: int = 0
    """Queries that were answered from memory, because they came twice."""
    refused: int = 0
    act_seconds: float = 0.0
    """Time in the policy [s]."""
    batches: Counter[int] = field(default_factory=Counter)
    """Queries in one call of the policy → number of calls."""
    started: float = field(default_factory=time.monotonic)
    first_query: float | None = None
    last_query: float = 0.0

    def summary(self) -> list[str]:
        """Lines for the console."""
        calls = sum(self.batches.values())
        busy = self.last_query - (self.first_query or 0.0)
        rate = f", {self.queries / busy:.1f} queries/s while asked" if self.queries > 1 and busy > 0 else ""
        lines = [
            f"{self.episodes} episodes, {self.queries} queries answered, {self.repeated} repeated, "
            f"{self.refused} refused{rate}"
        ]
        if calls:
            sizes = ", ".join(f"{size}: {count}" for size, count in sorted(self.batches.items()))
            each = 1000 * self.act_seconds / calls
            lines.append(f"{calls} calls of the policy, {each:.1f} ms each; batch sizes {sizes}")
        return lines


@dataclass(frozen=True)
class _Task:
    """Task of a session as the policy receives it."""

    name: str
    gym_id: str
    instruction: str


@dataclass
class _Session:
    row: int
    seed: int
    task: _Task
    held: bool
    """True if a connection holds it, so that it leaves with the connection."""
    used: float
    abandoned: bool = False
    """True if its last connection has closed."""
    last: tuple[int | None, int] | None = None
    """Step and content of the last query."""
    answer: np.ndarray | None = None
    """Answer to the last query."""

    def follows(self, step: int) -> bool:
        """True if a query may come so many actions into the episode: at most the last chunk after the last query."""
        if self.last is None:
            return False
        before = self.last[0]
        return before is None or before <= step and (self.answer is None or step <= before + len(self.answer))


@dataclass
class _Job:
    kind: Literal["begin", "query", "end", "leave"]
    owner: str
    session: str
    message: Begin | Query | None
    done: Future[Answer]
    held: bool = True
    came: float = field(default_factory=time.monotonic)


class PolicyServer:
    """Answers the queries of many sessions by one policy, those of `max_wait` seconds in one call."""

    def __init__(
        self,
        policy: Policy,
        *,
        max_batch_size: int = 16,
        max_wait: float = 0.02,
        max_sessions: int = 64,
        tracker: str = "",
        device: str | torch.device = "cpu",
    ):
        """Take the policy; `start` begins to serve.

        Args:
            policy: Answers by one label protocol, which `facts` declares.
            max_batch_size: Most queries in one call of the policy.
            max_wait: How long the first query of a batch waits for others [s].
            max_sessions: Rows of the policy, so most episodes at once.
            tracker: As of `Observation`.
            device: Torch device of what the policy sees.
        """
        self.policy, self.tracker, self.device = policy, tracker, torch.device(device)
        self.max_batch_size, self.max_wait, self.max_sessions = max_batch_size, max_wait, max_sessions
        self.counts = ServerCounts()
        self.protocol = protocol(policy.labels or "v3.1")
        self._facts: ServedFacts | None = None
        self._cameras = policy_cameras(policy)
        state = torch.zeros(max_sessions, STATE_WIDTH)
        state[:, : len(IDENTITY_ROT6D)] = torch.tensor(IDENTITY_ROT6D)
        self._state = state.to(self.device)
        self._images = {
            name: torch.zeros((max_sessions, one.height, one.width, 3), dtype=torch.uint8, device=self.device)
            for name, one in self._cameras.items()
        }
        self._seeds, self._tasks = [0] * max_sessions, [""] * max_sessions
        self._free = list(range(max_sessions))[::-1]
        self._sessions: dict[tuple[str, str], _Session] = {}
        self._unseeded = 0
        self._jobs: deque[_Job] = deque()
        self._news = threading.Condition()
        self._closed = False
        self.readers = MessageReaders()
        self._thread = threading.Thread(target=self._work, name="policy", daemon=True)
        self._known = {}
        for spec in tasks.specs():
            known = _Task(spec.name, spec.gym_id, spec.instruction)
            self._known |= {spec.name: known, spec.gym_id: known}

    @property
    def facts(self) -> ServedFacts:
        """Facts that the server declares; complete after `start`."""
        if self._facts is None:
            raise RuntimeError("the server has not begun")
        return self._facts

    def start(self, task: str = "boxing") -> None:
        """Validate the policy, query it once so that everything is loaded and compiled, and begin to serve.

        Args:
            task: Of the query that nobody sees.

        Raises:
            InputError: The policy cannot work, or only in the process of the world.
        """
        self.policy.check()
        for name, camera in self._cameras.items():
            prim = camera.named(name).prim
            if CAMERAS.get(name) != prim or camera.depth:
                kind = f"the depth of {name}" if camera.depth else f"camera {prim} as {name}"
                raise InputError(f"--policy {self.policy.name}: observes {kind}, which no protocol carries")
        known = self._known.get(task, _Task(task, task, ""))
        everyone = np.ones(self.max_sessions, dtype=bool)
        self.policy.reset([WARM_UP_SEED] * self.max_sessions, [known.gym_id] * self.max_sessions, everyone)
        chunk = self.policy.act(self._observation(known, [0]))
        if 0 in chunk.errors:
            raise InputError(f"--policy {self.policy.name}: {chunk.errors[0]}")
        self._check_shape(chunk.actions)
        labels, pictures = self.protocol.name, {name: ServedPicture.of(one) for name, one in self._cameras.items()}
        about = json.loads(json.dumps(self.policy.describe(), default=str))
        digest = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:12]
        self._facts = ServedFacts(
            policy=f"{self.policy.name} {digest}",
            labels=labels,
            realign=float(getattr(self.policy, "realign", 0.0)) if labels == "v4" else None,
            action_names=tuple(action_names(labels)),
            state_names=tuple(state_names()),
            chunk_length=int(chunk.actions.shape[1]),
            rate_hz=RATE,
            needs_picture=bool(pictures),
            picture=pictures.get(FRONT),
            cameras=pictures if {*pictures} - {FRONT} else None,
            seeded=not self.policy.depends_on_worlds,
            facts=about,
        )
        self._thread.start()

    def begin(self, owner: str, begin: Begin, *, held: bool = True) -> None:
        """Begin an episode in a session: its memory is cleared.

        Args:
            owner: Connection, or whoever the session belongs to.
            begin: The client's description of the episode.
            held: The session lives until its owner leaves; otherwise it may lose its row when it is idle.

        Raises:
            Refused: No row is free, or the policy cannot do the task.
        """
        self._wait_for(_Job("begin", owner, begin.session, begin, Future(), held))

    def query(self, owner: str, query: Query, *, held: bool = True) -> Answer:
        """The chunk of a session, by one call of the policy for all that ask at this time.

        The same query again (seed, step and content) is given the same answer again. One with `step` 0, or without a
        step in a session that has no episode, begins an episode.

        Raises:
            Refused: The query is unfit, its episode is not known, or the policy failed.
        """
        return self._wait_for(_Job("query", owner, query.session, self._fitted(query), Future(), held))

    def read[T](self, size: int, read: Callable[[], T]) -> T:
        """Content of a message, read in its turn; a small one is read at once.

        Args:
            size: Bytes of the message.

        Raises:
            Refused: The server closes.
        """
        return read() if size <= SMALL_MESSAGE else self._in_turn(size, read)

    def _in_turn[T](self, size: int, read: Callable[[], T]) -> T:
        try:
            return self.readers.run(size, read)
        except CancelledError:
            raise Refused("closing", "the server is closing") from None

    def end(self, owner: str, session: str) -> None:
        """End a session's episode and free its row."""
        self._put(_Job("end", owner, session, None, Future()))

    def abandon(self, owner: str, session: str) -> None:
        """The connection of a session that is not held has closed: it loses its row sooner, unless it asks again."""
        found = self._sessions.get((owner, session))
        if found is not None:
            found.abandoned = True

    def leave(self, owner: str) -> None:
        """End all sessions of an owner."""
        self._put(_Job("leave", owner, "", None, Future()))

    def close(self) -> None:
        """Stop; who waits for an answer is refused."""
        with self._news:
            self._closed = True
            self._news.notify_all()
        self.readers.close()
        if self._thread.is_alive():
            self._thread.join(timeout=5.0)
        self.policy.close()

    def _put(self, job: _Job) -> None:
        with self._news:
            if self._closed:
                job.done.set_exception(Refused("closing", "the server is closing"))
                return
            self._jobs.append(job)
            self._news.notify_all()

    def _wait_for(self, job: _Job) -> Answer:
        self._put(job)
        try:
            return job.done.result(LONGEST_ACT)
        except TimeoutError:
            raise Refused("policy", f"the policy gave no answer within {LONGEST_ACT:g} s") from None

    def _work(self) -> None:
        """Take jobs in their order; queries of different sessions together."""
        while True:
            with self._news:
                self._news.wait_for(lambda: self._closed or bool(self._jobs))
                if self._closed:
                    break
                job = self._jobs.popleft()
            if job.kind != "query":
                self._do(job)
                continue
            self._answer(self._batch(job))
        for job in self._jobs:
            job.done.set_exception(Refused("closing", "the server is closing"))

    def _batch(self, first: _Job) -> list[_Job]:
        """Queries that are answered together; what begins or ends meanwhile is done at once, unless it is theirs."""
        batch, keys = [first], {(first.owner, first.session)}
        end = first.came + self.max_wait
        while len(batch) < self.max_batch_size:
            job = self._next(keys, end)
            if job is None:
                break
            if job.kind == "query":
                batch.append(job)
                keys.add((job.owner, job.session))
            else:
                self._do(job)
        return batch

    def _next(self, keys: set[tuple[str, str]], end: float) -> _Job | None:
        """The next job that does not have to wait for the sessions `keys`; None where there is none until `end`."""
        with self._news:
            # Nobody else can ask where every session already does; those that were left behind count no more.
            now = time.monotonic()
            others = [s for key, s in self._sessions.items() if key not in keys and now - s.used < IDLE]
            if not self._jobs and others:
                self._news.wait_for(lambda: self._closed or bool(self._jobs), max(end - time.monotonic(), 0.0))
            if self._closed or not self._jobs:
                return None
            job = self._jobs[0]
            owners = {owner for owner, _ in keys}
            if (job.owner, job.session) in keys or (job.kind == "leave" and job.owner in owners):
                return None
            return self._jobs.popleft()

    def _do(self, job: _Job) -> None:
        """Begin or end."""
        try:
            if isinstance(job.message, Begin):
                self._begin((job.owner, job.session), job.message, job.held)
            elif job.kind == "end":
                self._drop((job.owner, job.session))
            else:
                for key in [key for key in self._sessions if key[0] == job.owner]:
                    self._drop(key)
            job.done.set_result(Answer(np.zeros((0, ACTION_WIDTH), np.float32), 0.0))
        except Exception as error:
            job.done.set_exception(self._refusal(error))

    def _begin(self, key: tuple[str, str], begin: Begin, held: bool) -> _Session:
        task = self._task(begin.task, begin.instruction)
        if task.name:
            self.policy.check_task(task.name)
        session = self._sessions.get(key)
        seed = begin.seed
        if seed is None:
            seed, self._unseeded = self._unseeded, self._unseeded + 1
        row = self._row(key[0]) if session is None else session.row
        session = self._sessions[key] = _Session(row, seed, task, held, time.monotonic())
        self._seeds[row], self._tasks[row] = seed, task.gym_id
        mask = np.zeros(self.max_sessions, dtype=bool)
        mask[row] = True
        try:
            self.policy.reset(list(self._seeds), list(self._tasks), mask)
        except BaseException:
            self._drop(key)
            raise
        self.counts.episodes += 1
        return session

    def _row(self, owner: str) -> int:
        """A free row, or that of an idle session that no connection holds, or that is of the same connection."""
        if not self._free:
            idle = [
                (s.used + (ABANDONED if s.abandoned else IDLE), key)
                for key, s in self._sessions.items()
                if not s.held or key[0] == owner
            ]
            until, key = min(idle, default=(math.inf, ("", "")))
            if time.monotonic() < until:
                raise Refused("full", f"all {self.max_sessions} sessions are in use; --max-sessions of the server")
            self._drop(key)
        return self._free.pop()

    def _drop(self, key: tuple[str, str]) -> None:
        session = self._sessions.pop(key, None)
        if session is not None:
            self._free.append(session.row)

    def _task(self, text: str, instruction: str) -> _Task:
        """The task that a message means, by Gym id, name or instruction; its own words where it is none of ours."""
        known = self._known.get(text)
        if known is None and not text:
            known = next((one for one in self._known.values() if one.instruction == instruction), None)
        if known is None:
            return _Task(text, text, instruction)
        return _Task(known.name, known.gym_id, instruction or known.instruction)

    def _session(self, job: _Job, query: Query, content: int) -> _Session:
        """The session of a query; a query that begins an episode makes it."""
        key = (job.owner, job.session)
        session = self._sessions.get(key)
        if session is not None:
            other = query.seed is not None and query.seed != session.seed
            again = session.last is not None and session.last != (0, content)
            if query.step == 0 and (other or again):
                session = None
            elif other:
                raise Refused(
                    "unfit", f"the query is of seed {query.seed}, the session's episode of seed {session.seed}"
                )
        if query.step and (session is None or not session.follows(query.step)):
            raise Refused(
                "unknown_episode",
                f"the query is {query.step} actions into an episode that the server does not know (it was started "
                "again, or the session was idle and lost its row, or began another episode); begin the episode again",
            )
        if session is None:
            session = self._begin(key, Begin(query.session, query.seed, query.task, query.instruction), job.held)
        session.used, session.abandoned = time.monotonic(), False
        task = self._task(query.task, query.instruction) if query.task or query.instruction else session.task
        if task != session.task:
            if task.name != session.task.name:
                self.policy.check_task(task.name)
            session.task = task
        return session

    def _answer(self, batch: Sequence[_Job]) -> None:
        """Put the queries of a batch into the policy's rows, and answer them task by task."""
        groups: dict[_Task, list[tuple[_Job, _Session]]] = {}
        now = time.monotonic()
        self.counts.first_query = self.counts.first_query or now
        for job in batch:
            query = job.message
            try:
                if not isinstance(query, Query):
                    raise TypeError("no query")
                content = zlib.crc32(query.state.tobytes(), zlib.crc32(query.instruction.encode()))
                for name in self._cameras:
                    if isinstance(picture := query.images.get(name), np.ndarray):
                        content = zlib.crc32(picture.tobytes(), content)
                session = self._session(job, query, content)
                if query.step is not None and session.last == (query.step, content) and session.answer is not None:
                    self.counts.repeated += 1
                    job.done.set_result(Answer(session.answer, 1000 * (time.monotonic() - job.came)))
                    continue
                self._see(session.row, query)
                session.last, session.answer = (query.step, content), None
                groups.setdefault(session.task, []).append((job, session))
            except Exception as error:
                job.done.set_exception(self._refusal(error))
        for task, asking in groups.items():
            self._act(task, asking)
        self.counts.last_query = time.monotonic()

    def _fitted(self, query: Query) -> Query:
        """A query as the policy sees it: its pictures scaled. Large pictures never wait unpacked for others."""
        images = {name: query.images[name] for name in self._cameras if name in query.images}
        for name, picture in images.items():
            camera = self._cameras[name]
            if isinstance(picture, np.ndarray) and picture.shape[:2] == (camera.height, camera.width):
                continue

            def fit(picture: np.ndarray | PackedPicture = picture, camera: CameraConfig = camera) -> np.ndarray:
                pixels = picture.unpacked() if isinstance(picture, PackedPicture) else picture
                return fitted_picture(pixels, camera)

            try:
                images[name] = self._in_turn(picture.nbytes, fit)
            except Exception as error:
                raise self._refusal(error) from None
        return replace(query, images=images)

    def _see(self, row: int, query: Query) -> None:
        """Put what a session sees into its row."""
        if query.robot_type and query.robot_type != self.protocol.robot_type:
            kinds = f"{plain_text(query.robot_type, 60)!r}, the policy's actions are for {self.protocol.robot_type!r}"
            raise Refused("unfit", f"robot_type is {kinds} (label protocol {self.protocol.name})")
        for name, images in self._images.items():
            if name not in query.images:
                of = "" if name == FRONT else f" of {name}"
                raise Refused("unfit", f"policy {self.policy.name} needs a picture{of}, the message holds none")
            images[row] = torch.from_numpy(np.ascontiguousarray(query.images[name])).to(self.device)
        self._state[row] = torch.from_numpy(query.state).to(self.device)

    def _observation(self, task: _Task, rows: Sequence[int]) -> Observation:
        mask = np.zeros(self.max_sessions, dtype=bool)
        mask[list(rows)] = True
        described = task.name, task.gym_id, task.instruction, self.tracker
        return Observation(self._state, self._images.get(FRONT), mask, *described, images=self._images)

    def _act(self, task: _Task, asking: Sequence[tuple[_Job, _Session]]) -> None:
        """One call of the policy."""
        rows = [session.row for _, session in asking]
        began = time.monotonic()
        try:
            chunk = self.policy.act(self._observation(task, rows))
            self._check_shape(chunk.actions)
            chosen = torch.as_tensor(chunk.actions)[rows].detach().cpu().numpy()
        except Exception as error:
            refusal = self._refusal(error, "policy")
            for job, _ in asking:  # what the policy remembers of them is not known
                self._drop((job.owner, job.session))
                job.done.set_exception(refusal)
            return
        self.counts.act_seconds += time.monotonic() - began
        self.counts.batches[len(rows)] += 1
        self.counts.queries += len(rows)
        for (job, session), made in zip(asking, chosen, strict=True):
            try:
                if session.row in chunk.errors:
                    raise Refused("policy", chunk.errors[session.row])
                session.answer = self.protocol.validate(made, f"policy {self.policy.name}").copy()
                job.done.set_result(Answer(session.answer, 1000 * (time.monotonic() - job.came)))
            except Exception as error:
                job.done.set_exception(self._refusal(error, "policy"))

    def _check_shape(self, actions: torch.Tensor | np.ndarray) -> None:
        shape = tuple(actions.shape)
        if len(shape) != 3 or shape[::2] != (self.max_sessions, ACTION_WIDTH) or not shape[1]:
            wanted = f"[{self.max_sessions}, n, {ACTION_WIDTH}]"
            raise InputError(f"policy {self.policy.name}: a chunk of shape {list(shape)}, expected {wanted}")

    def _refusal(self, error: Exception, reason: Reason = "unfit") -> Refused:
        """Error for the client; the console prints all of it where it is not the client's fault."""
        self.counts.refused += 1
        match error:
            case Refused():
                return error
            case PolicyUnavailable():
                return Refused("policy", str(error))
            case WireError() | InputError():
                return Refused(reason, str(error))
        print("".join(traceback.format_exception(error)), file=sys.stderr, flush=True)
        return Refused("policy", f"the policy failed ({type(error).__name__}); the server's console says more")
