"""Commands of a plan, played side by side: each on the GPUs that have the fewest, when those before it are done.

`commands.jsonl` has a line for each command that ended, from which the seconds of the stages are; its output is in
`logs/`. What a killed call leaves unfinished is begun again by the next one.
"""

from __future__ import annotations

import contextlib
import json
import os
import subprocess
import time
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from arena_newton.errors import InputError
from arena_newton.eval.loop.plan_commands import ALL_GPUS, STAGES, PlanCommand
from arena_newton.eval.records.schema import MAX_CONFIG_BYTES
from arena_newton.files.own_processes import end, environment, how_it_ended, start_module
from arena_newton.files.stored_json import parse, read_regular
from arena_newton.files.text import plain_text

__all__ = ["COMMANDS_FILE", "CommandPlayer", "CommandTime", "command_times", "stage_seconds"]

COMMANDS_FILE = "commands.jsonl"
"""Lines of the commands that ended."""
BAD_INPUT = 2
"""Exit code of a command that would fail again."""
POLL = 0.1
"""Processes are looked at so often [s]."""
PATIENCE = 60.0
"""Time in which a command ends that was told to [s]; a training saves its state first."""


@dataclass(frozen=True)
class CommandTime:
    """A command that ended."""

    stage: str
    name: str
    began: float
    """Time since the epoch [s]."""
    ended: float
    code: int


def command_times(out: Path) -> list[CommandTime]:
    """Commands that ended, in their order; a line that a kill cut is left out."""
    found = []
    with contextlib.suppress(FileNotFoundError):
        for line in read_regular(out / COMMANDS_FILE, MAX_CONFIG_BYTES).splitlines():
            with contextlib.suppress(ValueError, TypeError):
                one = CommandTime(**parse(line))
                if one.ended >= one.began:
                    found.append(one)
    return found


def stage_seconds(times: Iterable[CommandTime]) -> dict[str, float]:
    """Time in which a command of each stage ran, then that of any, as `all` [s]; pauses between calls are none."""
    times = list(times)
    spans = {stage: [one for one in times if one.stage == stage] for stage in STAGES}
    return {name: _covered(some) for name, some in [*spans.items(), ("all", times)] if some}


def _covered(times: Sequence[CommandTime]) -> float:
    total, until = 0.0, 0.0
    for one in sorted(times, key=lambda one: one.began):
        total += max(0.0, one.ended - max(one.began, until))
        until = max(until, one.ended)
    return total


@dataclass
class _Running:
    """A command that runs."""

    command: PlanCommand
    process: subprocess.Popen[bytes]
    gpus: tuple[str, ...]
    began: float


@dataclass
class CommandPlayer:
    """Plays commands in a folder."""

    out: Path
    gpus: Sequence[str]
    """GPUs of this machine, as `CUDA_VISIBLE_DEVICES` names them."""
    most: Mapping[str, int]
    """Stage → commands of it at once; others one."""
    held: int
    """Open file that keeps the folder: commands that outlive this process keep it until they have ended."""
    again: int = 0
    """Times that a command is begun again that failed; bad input fails at once."""
    failed: dict[str, str] = field(default_factory=dict)
    """Commands that failed, and why."""
    _begun: Counter[str] = field(default_factory=Counter)
    _running: list[_Running] = field(default_factory=list)

    def play(self, commands: Sequence[PlanCommand]) -> bool:
        """Play what is not done; False if a command failed, after all that do not need it.

        Raises:
            KeyboardInterrupt: Ctrl-C or SIGTERM; running commands kept what they had.
        """
        (self.out / "logs").mkdir(exist_ok=True)
        done = {str(command) for command in commands if command.done()}
        waiting = [command for command in commands if str(command) not in done]
        for stage in STAGES:
            mine = [command for command in commands if command.stage == stage]
            left = sum(command in waiting for command in mine)
            if mine:
                print(f"{stage}: {f'{left} of {len(mine)} to do' if left else 'finished before'}", flush=True)

        def ready(command: PlanCommand) -> bool:
            ended = done if command.needs_all else done | (self.failed.keys() - set(map(str, waiting)))
            return ended.issuperset(command.after) and (command.needs_all or not done.isdisjoint(command.after))

        try:
            while waiting or self._running:
                for command in sorted(filter(ready, waiting), key=lambda one: -one.size):
                    if self._has_room(command):
                        waiting.remove(command)
                        try:
                            self._begin(command)
                        except InputError as error:  # others go on: one whole training is enough to play
                            self.failed[str(command)] = str(error)
                            print(f"[{command}] failed: {error}", flush=True)
                time.sleep(POLL)
                for one in self._ended():
                    if self._ended_well(one):
                        done.add(str(one.command))
                    elif one.process.returncode != BAD_INPUT and self._begun[str(one.command)] <= self.again:
                        waiting.append(one.command)
                if not self._running and not any(map(ready, waiting)):
                    break  # what is left needs a command that failed
        finally:
            for one in self._running:
                one.process.terminate()
            for one in self._running:
                end(one.process, PATIENCE)
                self._note(one)
        return not self.failed

    def _has_room(self, command: PlanCommand) -> bool:
        same = [one for one in self._running if one.command.stage == command.stage]
        return len(same) < self.most.get(command.stage, 1)

    def _begin(self, command: PlanCommand) -> None:
        """Start a command's process."""
        module, *arguments = command.words()
        variables = environment()
        taken = [name for one in self._running for name in one.gpus]
        count = len(self.gpus) if command.gpus == ALL_GPUS else command.gpus
        gpus = tuple(sorted(self.gpus, key=taken.count)[:count])
        variables |= {"CUDA_VISIBLE_DEVICES": ",".join(gpus)}
        log = self._log(command)
        with log.open("ab") as file:
            file.write(f"$ python -m {' '.join([module, *map(str, arguments)])}\n".encode())
            file.flush()
            process = start_module(
                module,
                *arguments,
                variables=variables,
                files=[self.held],
                output=file.fileno(),
                errors=file.fileno(),
                tied=True,
            )
        self._running.append(_Running(command, process, gpus, time.time()))
        self._begun[str(command)] += 1
        self.failed.pop(str(command), None)
        on = f" on GPU {','.join(gpus)}" if gpus else ""
        print(f"[{command}] begun{on}", flush=True)

    def _log(self, command: PlanCommand) -> Path:
        return self.out / "logs" / f"{str(command).replace(' ', '_')}.log"

    def _ended(self) -> list[_Running]:
        """Commands that have ended since the last call."""
        ended = [one for one in self._running if one.process.poll() is not None]
        self._running = [one for one in self._running if one not in ended]
        return ended

    def _ended_well(self, one: _Running) -> bool:
        """Note and say how a command ended; False if it failed."""
        seconds, code = self._note(one), one.process.returncode
        if code == 0 or (code == 1 and one.command.done()):  # 1: episodes that ended as errors count
            print(f"[{one.command}] {seconds:.1f} s", flush=True)
            return True
        log = self._log(one.command)
        last = plain_text("".join(log.read_bytes()[-2000:].decode(errors="replace").splitlines()[-1:]), 300)
        self.failed[str(one.command)] = f"{how_it_ended(one.process, 0.0)}: {last} ({log})"
        print(f"[{one.command}] failed: {self.failed[str(one.command)]}", flush=True)
        return False

    def _note(self, one: _Running) -> float:
        """Write the line of a command that ended, and return its time [s]."""
        now = time.time()
        line = CommandTime(one.command.stage, one.command.name, one.began, now, one.process.returncode)
        with (self.out / COMMANDS_FILE).open("a") as file:
            file.write(json.dumps(vars(line)) + "\n")
            file.flush()
            os.fsync(file.fileno())
        return now - one.began
