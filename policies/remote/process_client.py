"""The policy that is a program of this machine: JSON lines on its standard input and output.

The messages (docs/howto/bring/policy_server.md) are those of the original's HTTP protocol; one program answers for all
worlds, one query after the other.
"""

from __future__ import annotations

import json
import os
import select
import subprocess
import tempfile
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import cast

import numpy as np
from PIL import Image

from arena_newton.errors import InputError
from arena_newton.files.own_processes import end, how_it_ended
from arena_newton.files.text import plain_text
from arena_newton.policies.base import Json, Observation
from arena_newton.policies.protocols import arena_codec
from arena_newton.policies.protocols.handshake import ServedFacts, read_facts
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.policies.remote.address import ServerAddress
from arena_newton.policies.remote.arena_client import RemotePolicy
from arena_newton.policies.remote.client import MAX_REPLY, Images
from arena_newton.policies.remote.link import RemoteError, ServerLink
from arena_newton.policies.remote.program import ProgramCommand

__all__ = ["ProcessPolicy"]

PATIENCE = 5.0
"""Time that a program has to end by itself once its input is closed [s]."""


class _Program(ServerLink[bytes, tuple[int, bytes]]):
    """The running program: a line for each request, and a line with the request's number for each answer."""

    transient = ()

    def __init__(self, command: ProgramCommand):
        super().__init__(command.shown)
        self._words = command.words
        self._process: subprocess.Popen[bytes] | None = None
        self._turn, self._number = threading.RLock(), 0
        self._out, self._in = bytearray(), bytearray()

    def start(self) -> subprocess.Popen[bytes]:
        """Start the program, once; it writes its errors where this process does, and Ctrl-C does not reach it."""
        if self._process is None:
            pipe = subprocess.PIPE
            self._process = subprocess.Popen(self._words, stdin=pipe, stdout=pipe, bufsize=0, start_new_session=True)
            for file in (self._process.stdin, self._process.stdout):
                assert file is not None
                os.set_blocking(file.fileno(), False)
        return self._process

    def exchange(self, kind: str, request: bytes, end: float) -> tuple[int, bytes]:
        """Send a line, and take the line that answers it; those that come too late for their requests are left out."""
        with self._turn:
            process = self.start()
            self._number += 1
            head = f'{{"request": "{kind.strip(" ()")}", "id": {self._number}'.encode()
            self._out += head + (b"}" if request == b"{}" else b", " + request[1:]) + b"\n"
            while True:
                line = self._line(process, end)
                number = self._number_of(line)
                if number == self._number:
                    return 200, line
                if number is None or not 0 < number < self._number:
                    wrote = plain_text(line.decode(errors="replace"), 80)
                    expected = f"expected a JSON object with the request's id, {self._number}, on one line"
                    raise RemoteError(f"{self.url}{kind}: wrote {wrote} to its standard output, {expected}")

    def _number_of(self, line: bytes) -> int | None:
        try:
            number = json.loads(line)["id"]
        except (ValueError, TypeError, KeyError, IndexError, RecursionError):
            return None
        return number if type(number) is int else None

    def _line(self, process: subprocess.Popen[bytes], end: float) -> bytes:
        """The next line that the program writes; meanwhile it is given what it has not read yet."""
        assert process.stdin is not None and process.stdout is not None
        given, taken = process.stdin.fileno(), process.stdout.fileno()
        while b"\n" not in self._in:
            left = end - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            ready = select.poll()
            ready.register(taken, select.POLLIN)
            if self._out:
                ready.register(given, select.POLLOUT)
            found = dict(ready.poll(1000.0 * left))
            if taken in found:
                piece = os.read(taken, 1 << 16)
                self._in += piece
                if not piece:
                    raise ConnectionError(f"the program ended ({how_it_ended(process, PATIENCE)})")
                if len(self._in) > MAX_REPLY:
                    self.end()
                    raise ValueError(f"the reply is longer than {MAX_REPLY >> 20} MiB")
            elif given in found:
                try:
                    del self._out[: os.write(given, self._out[: 1 << 16])]
                except BrokenPipeError:  # it has ended, or reads no more: its output tells
                    self._out.clear()
        line, _, rest = self._in.partition(b"\n")
        self._in = rest
        return bytes(line)

    def alive(self, timeout: float) -> bool:
        """True if the program runs."""
        return self._process is not None and self._process.poll() is None

    def abort(self) -> None:
        """Nothing: an exchange ends at its deadline, and the program answers other worlds too."""

    def close(self) -> None:
        """Nothing: an answer that comes too late is known by its number."""

    def end(self) -> None:
        """Close the program's input, and kill it if it does not end."""
        if self._process is not None and self._process.stdin is not None and self._process.stdout is not None:
            self._process.stdin.close()
            end(self._process, PATIENCE)
            if self._turn.acquire(timeout=PATIENCE):  # whoever waits for an answer has met the end
                self._process.stdout.close()
                self._turn.release()


class ProcessPolicy(RemotePolicy):
    """Asks a program; the answer to its request `config` may declare what a server's does."""

    name = "process"
    reset_kind, infer_kind, described = " (reset)", " (infer)", "a policy program"

    def __init__(self, command: str | None, *, timeout: float = 60.0, labels: str = "v3.1"):
        """Read the command, with `timeout` and `labels` as of `RemoteClient`; nothing is started yet.

        Raises:
            InputError: It is none, or its program is not found.
        """
        self.command = ProgramCommand.read(command)
        super().__init__(self.command.shown, retries=0, sequential=True, timeout=timeout, labels=labels)
        self._program = _Program(self.command)
        self._files: tempfile.TemporaryDirectory[str] | None = None

    def _address(self, url: str) -> ServerAddress:
        return ServerAddress("arena", "pipe", "", 0, "")

    def reach(self) -> None:
        """Start the program.

        Raises:
            InputError: It cannot be started.
        """
        try:
            self._program.start()
        except OSError as error:
            raise InputError(f"--policy process:{self.url}: {error.strerror}") from None

    def _declared(self) -> ServedFacts:
        replies, errors = self._gather(" (config)", {0: b"{}"}, lambda content: cast(Json, content))
        if errors:
            raise self.refusal(errors[0])
        if replies[0].get("picture_files") is True:
            self._files = self._files or tempfile.TemporaryDirectory(prefix="arena_pictures_")
        try:
            return read_facts(replies[0], f"{self.url} (config)")
        except WireError as error:
            raise InputError(f"--policy process:{error}") from None

    def _connect(self) -> _Program:  # type: ignore[override]  # the other link of the same messages
        return self._program

    def _request(self, seen: Observation, state: np.ndarray, images: Images, world: int) -> bytes:
        query = self._query(seen, state, images, world)
        if self._files is None:
            return arena_codec.pack_query(query)
        files = {name: Path(self._files.name) / f"world{world}_{name}.png" for name in query.images}
        for name, path in files.items():
            Image.fromarray(np.asarray(query.images[name])).save(path, compress_level=1)
        return arena_codec.pack_query(replace(query, images={}), files)

    def describe(self) -> Json:
        """The command instead of an address, and what the program says of itself; complete after `check`."""
        return {"command" if name == "url" else name: value for name, value in super().describe().items()}

    def close(self) -> None:
        """End the program."""
        super().close()
        self._program.end()
        if self._files is not None:
            self._files.cleanup()
            self._files = None
