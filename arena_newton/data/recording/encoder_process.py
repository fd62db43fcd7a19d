"""``python -m arena_newton.data.recording.encoder_process``: a process that encodes films for a recorder.

The recorder writes pictures into memory that both map and says over a socket which film each belongs to. The process
answers when it has read the pictures of a message, when a film is finished, and when one could not be written. It ends
with its recorder: by the end of the connection, or because its parent is another one.
"""

from __future__ import annotations

import contextlib
import json
import mmap
import os
import socket
import struct
import sys
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from arena_newton.data.recording.episode_film import Film

__all__ = ["SlotMemory", "main", "packed", "unpacked"]

LENGTH = struct.Struct("<I")
"""Prefix of a message: the number of its bytes, which are JSON."""
PATIENCE = 1.0
"""Time after which a process that waits makes sure that its recorder is alive [s]."""


def packed(message: Mapping[str, object]) -> bytes:
    """A message as bytes."""
    text = json.dumps(message, separators=(",", ":")).encode()
    return LENGTH.pack(len(text)) + text


def unpacked(received: bytearray) -> Iterator[dict[str, object]]:
    """The whole messages at the beginning of what was received; they are taken out of it."""
    while len(received) >= LENGTH.size:
        (size,) = LENGTH.unpack_from(received)
        end = LENGTH.size + size
        if len(received) < end:
            return
        message = json.loads(bytes(received[LENGTH.size : end]))
        del received[:end]
        yield message


class SlotMemory:
    """Slots for the pictures of one tick and camera, each followed by their depths, in memory of several processes."""

    def __init__(self, fd: int, slots: int, worlds: int, height: int, width: int, depth: int):
        """Map the memory.

        Args:
            fd: A file of `size` bytes.
            worlds: Pictures of a slot.
            height: Height of a picture [px].
            width: Width of a picture [px].
            depth: 1 where there are depths, float16 [m], otherwise 0.
        """
        pictures, pixels = worlds * height * width * 3, worlds * height * width
        start = -(-pictures // 64) * 64
        stride = start + (2 * pixels if depth else 0)
        stride = -(-stride // mmap.PAGESIZE) * mmap.PAGESIZE
        self.size = slots * stride
        """Bytes of the memory."""
        os.ftruncate(fd, self.size)
        self.memory = mmap.mmap(fd, self.size)
        shape, buffer = (worlds, height, width), self.memory
        firsts = range(0, self.size, stride)
        self.pictures = [np.ndarray((*shape, 3), np.uint8, buffer, first) for first in firsts]
        """Pictures of each slot, uint8, shape [worlds, H, W, 3]."""
        self.depths = [np.ndarray(shape, np.float16, buffer, first + start) for first in firsts] if depth else None
        """Depth of each slot, shape [worlds, H, W]."""


class _Films:
    """The films that a process makes."""

    def __init__(self, connection: socket.socket, parent: int):
        self._connection, self._parent = connection, parent
        connection.settimeout(PATIENCE)
        self._films: dict[int, Film] = {}
        self._memories: list[SlotMemory] = []

    def work(self) -> None:
        """Do what comes until the connection ends; what is unfinished then is dropped."""
        received = bytearray()
        while True:
            try:
                part = self._connection.recv(1 << 16)
            except TimeoutError:
                self._end_with_parent()
                continue
            except ConnectionError:
                part = b""
            if not part:
                break
            received += part
            for message in unpacked(received):
                self._end_with_parent()
                self._do(message)
        self._end_with_parent()
        for film in self._films.values():
            film.discard()

    def _end_with_parent(self) -> None:
        """Leave everything as it is where the recorder was killed: another one may already write the same files."""
        if os.getppid() != self._parent:
            os._exit(1)

    def _do(self, message: dict[str, object]) -> None:
        match message:
            case {"memory": memories}:
                self._memories = [SlotMemory(*numbers) for numbers in cast("list[list[int]]", memories)]
            case {
                "film": int(number),
                "video": str(video),
                "depth": str(depth),
                "fps": float(fps),
                "lossless": bool(exact),
            }:
                self._films[number] = Film(Path(video), Path(depth), fps, exact)
            case {"camera": int(camera), "slot": int(slot), "rows": rows}:
                memory = self._memories[camera]
                pictures, depths = memory.pictures[slot], memory.depths
                for number, row in cast("list[tuple[int, int]]", rows):
                    self._add(number, pictures[row], None if depths is None else depths[slot][row])
                self._answer({"released": [camera, slot]})
            case {"close": int(number)}:
                self._close(number)
            case {"discard": int(number)}:
                if (film := self._films.pop(number, None)) is not None:
                    film.discard()
                self._answer({"dropped": number})

    def _add(self, number: int, picture: np.ndarray, depth: np.ndarray | None) -> None:
        """Append a picture; a film that cannot be written is reported and dropped."""
        if (film := self._films.get(number)) is None:
            return
        try:
            film.add(picture, depth)
        except Exception as error:
            self._broken(number, error)

    def _close(self, number: int) -> None:
        film = self._films.get(number)
        try:
            facts = None if film is None else film.close()
        except Exception as error:
            self._broken(number, error)
            facts, film = None, None
        self._films.pop(number, None)
        self._answer({"closed": number, "whole": film is not None, "facts": facts and vars(facts)})

    def _broken(self, number: int, error: Exception) -> None:
        """Say why a film cannot be written, and drop it."""
        film = self._films.pop(number)
        with contextlib.suppress(OSError):
            film.discard()
        code, name = (error.errno, error.filename) if isinstance(error, OSError) else (None, None)
        reason = os.strerror(code) if code else f"{type(error).__name__}: {error}"
        self._answer({"error": reason, "errno": code, "file": os.fspath(name or film.video)})

    def _answer(self, message: Mapping[str, object]) -> None:
        left = memoryview(packed(message))
        while left:
            try:
                left = left[self._connection.send(left) :]
            except TimeoutError:
                self._end_with_parent()
            except ConnectionError:  # the next message says how the recorder ended
                return


def main(descriptor: str, parent: str) -> None:
    """Encode until the recorder ends the connection.

    Args:
        descriptor: Number of the open socket.
        parent: Process that the recorder is in.
    """
    cv2.setNumThreads(0)
    with socket.socket(fileno=int(descriptor)) as connection:
        _Films(connection, int(parent)).work()


if __name__ == "__main__":
    main(*sys.argv[1:])
