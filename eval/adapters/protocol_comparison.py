"""``python -m arena_newton.eval protocols``: one checkpoint by our runner, `lerobot-eval` and every served protocol.

Each protocol is a program of its own, called as a user calls it; its command is in the table's file. Outcome, steps and
executed actions of each episode are read from the files that it wrote.
"""

from __future__ import annotations

import contextlib
import importlib.util
import json
import re
import signal
import subprocess
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path

import numpy as np

from arena_newton import tasks
from arena_newton.cli.extras import require
from arena_newton.cli.flags import shell_command, user_path, words
from arena_newton.errors import InputError
from arena_newton.eval.adapters.protocol_options import PROTOCOLS, ProtocolOptions
from arena_newton.eval.folders.recordings import OUTCOMES_FILE
from arena_newton.eval.folders.results import load_run
from arena_newton.eval.plan.episode_plan import PROTOCOL_REPEATS
from arena_newton.eval.plan.options import RunOptions
from arena_newton.eval.records.journal import StorageError, write_atomic
from arena_newton.files.own_processes import end, environment, start_module
from arena_newton.pages.tables import Table
from arena_newton.policies.learned.learned_card import CARD_FILE, SHIPPED
from arena_newton.policies.lerobot.checkpoint_facts import checkpoint_folder
from arena_newton.robot.canonical import ACTION_WIDTH

__all__ = ["ProtocolEpisode", "ProtocolRun", "ProtocolRow", "compare_protocols", "protocol_table", "run"]

SERVED = ("openpi", "roboarena", "vla-eval", "arena")
"""Protocols behind a server."""
SAME_BITS = tuple(name for name in PROTOCOLS if name != "learned")
"""Protocols that promise the bits of `lerobot` on engine mujoco and the CPU."""
START_S = 300.0
"""Longest wait until a server listens [s]."""
POLL = 0.1
"""Its output is looked at so often [s]."""
END_S = 30.0
"""Longest wait until it ends [s]."""
ADDRESS = "eval asks it by --policy "
"""Beginning of the line in which a server says how it is asked."""


@dataclass(frozen=True)
class ProtocolEpisode:
    """Result of an episode."""

    key: str
    """`s<group seed>/r<repeat>`."""
    outcome: str
    reason: str | None
    steps: int
    margin: float | None
    """Signed distance to success, in the task's unit."""
    actions: np.ndarray
    """Executed canonical actions, float32, shape [steps, 40]."""


@dataclass(frozen=True)
class ProtocolRun:
    """Result of a protocol's program."""

    protocol: str
    episodes: tuple[ProtocolEpisode, ...]
    seconds: float
    """Time from its start to its end [s]."""
    commands: tuple[str, ...] = ()
    """Command lines, as a user types them."""


@dataclass(frozen=True)
class ProtocolRow:
    """A protocol compared with the first one."""

    protocol: str
    successes: int
    episodes: int
    steps: tuple[int, ...]
    """Steps of each episode."""
    same_endings: bool
    """Outcome, reason and steps of every episode are those of the first protocol."""
    same_actions: bool
    """The first actions of every episode are, bit for bit."""
    same_everything: bool
    """All actions and margins of every episode are."""
    largest: float
    """Largest difference among the first actions; 0 where no action is left to compare."""
    parts_at: int | None
    """First tick at which an action differs, over all episodes; None where none does."""
    promised: bool
    """True if it must be the same."""
    seconds: float
    commands: tuple[str, ...] = field(default=())

    @property
    def kept(self) -> bool:
        """True if the promise holds."""
        return not self.promised or (self.same_endings and self.same_everything)


def run(options: ProtocolOptions) -> int:
    """Play, print the table, and write protocols.json and protocols.md.

    Returns:
        Exit code: 0 what is promised holds, 1 it does not.

    Raises:
        InputError: A flag is wrong, or a protocol's program failed.
        StorageError: A file cannot be written.
    """
    checkpoint = SHIPPED if options.checkpoint is None else user_path(options.checkpoint)
    checkpoint = checkpoint_folder(checkpoint, "--checkpoint ")
    protocols = _checked(options, checkpoint)
    out = user_path(options.out)
    if out.exists() and (not out.is_dir() or any(out.iterdir())):
        raise InputError(f"--out {out}: is not an empty folder")
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StorageError(f"--out {out}: cannot be made ({error.strerror})") from None
    plays = []
    for protocol in protocols:
        plays.append(_play(protocol, options, checkpoint, out / protocol))
        play = plays[-1]
        solved = sum(episode.outcome == "success" for episode in play.episodes)
        print(f"{protocol}: {solved} of {len(play.episodes)}, {play.seconds:.0f} s", flush=True)
    promised = SAME_BITS if (options.engine, options.device) == ("mujoco", "cpu") else ()
    rows = compare_protocols(plays, options.first, promised)
    message = f"{checkpoint}, {options.task} through {options.tracker}, engine {options.engine}, {options.device}"
    text = protocol_table(rows, options.first)
    commands = "\n".join(f"- {row.protocol}: " + "; ".join(f"`{line}`" for line in row.commands) for row in rows)
    write_atomic(out / "protocols.md", f"{message}\n\n{text}\n{commands}\n")
    # Keys of a stored file do not follow the name of the command.
    compared = [asdict(row) for row in rows]
    facts = {"flags": asdict(options), "checkpoint": str(checkpoint), "protocols": compared}
    write_atomic(out / "protocols.json", json.dumps(facts, indent=2) + "\n")
    print(f"\n{message}\n\n{text}")
    broken = [row.protocol for row in rows if not row.kept]
    print(f"differs, but must not: {' '.join(broken)}" if broken else "what is promised holds")
    print(f"written: {out / 'protocols.md'} and protocols.json")
    return 1 if broken else 0


def compare_protocols(plays: Sequence[ProtocolRun], first: int, promised: Sequence[str]) -> list[ProtocolRow]:
    """Compare each protocol with the first one.

    Args:
        plays: Results of the protocols, over the same episodes in the same order.
        first: Actions of each episode that count as its beginning.
        promised: Protocols that must be the same; a first one that is not among them promises nothing for the others.

    Raises:
        InputError: A protocol played other episodes than the first one.
    """
    against = plays[0]
    rows = []
    for play in plays:
        keys, wanted = ([episode.key for episode in one.episodes] for one in (play, against))
        if keys != wanted:
            others = f"{against.protocol} {' '.join(wanted)}"
            raise InputError(f"protocol {play.protocol}: played {' '.join(keys)}, protocol {others}")
        pairs = list(zip(play.episodes, against.episodes, strict=True))
        parts = [tick for ours, theirs in pairs if (tick := _parts_at(ours.actions, theirs.actions)) is not None]
        begun = [(ours.actions[:first], theirs.actions[:first]) for ours, theirs in pairs]
        rows.append(
            ProtocolRow(
                protocol=play.protocol,
                successes=sum(episode.outcome == "success" for episode in play.episodes),
                episodes=len(play.episodes),
                steps=tuple(episode.steps for episode in play.episodes),
                same_endings=all((a.outcome, a.reason, a.steps) == (b.outcome, b.reason, b.steps) for a, b in pairs),
                same_actions=all(_parts_at(a, b) is None for a, b in begun),
                same_everything=not parts and all(a.margin == b.margin for a, b in pairs),
                largest=max((_largest(a, b) for a, b in begun), default=0.0),
                parts_at=min(parts, default=None),
                promised=play.protocol in promised and against.protocol in promised,
                seconds=play.seconds,
                commands=play.commands,
            )
        )
    return rows


def protocol_table(rows: Sequence[ProtocolRow], first: int) -> str:
    """The comparison as a table in Markdown."""
    head = ("protocol", "successes", "steps", f"first {first} actions", "largest difference", "all actions, margins")
    lines = []
    for row in rows:
        actions, all_of_it = ("same bits" if same else "differ" for same in (row.same_actions, row.same_everything))
        steps = " ".join(str(number) for number in row.steps)
        parts = "–" if row.parts_at is None else str(row.parts_at)
        won = f"{row.successes} of {row.episodes}"
        lines.append((f"`{row.protocol}`", won, steps, actions, f"{row.largest:.1e}", all_of_it, parts))
    return "\n".join(Table((*head, "first difference at tick"), lines, "lrllrlr").compact()) + "\n"


def _parts_at(ours: np.ndarray, theirs: np.ndarray) -> int | None:
    """First tick at which actions differ in any bit, or one of two episodes has ended; None where none does."""
    common = min(len(ours), len(theirs))
    other = (ours[:common].view(np.uint32) != theirs[:common].view(np.uint32)).any(axis=1)
    if other.any():
        return int(np.argmax(other))
    return common if len(ours) != len(theirs) else None


def _largest(ours: np.ndarray, theirs: np.ndarray) -> float:
    common = min(len(ours), len(theirs))
    return float(np.abs(ours[:common] - theirs[:common]).max()) if common else 0.0


def _checked(options: ProtocolOptions, checkpoint: Path) -> tuple[str, ...]:
    """The protocols that can be played, once the flags are checked."""
    tasks.get(options.task)
    for name in options.protocols:
        if name not in PROTOCOLS:
            raise InputError(f"--protocols {name}: unknown, choose from {' '.join(PROTOCOLS)}")
    if not options.protocols or len(set(options.protocols)) != len(options.protocols):
        raise InputError("--protocols: name at least one, each once")
    if not 1 <= options.episodes <= PROTOCOL_REPEATS:
        raise InputError(f"--episodes {options.episodes}: expected 1 to {PROTOCOL_REPEATS}")
    for name, value in (("first", options.first), ("max-steps", options.max_steps)):
        if value is not None and value < 1:
            raise InputError(f"--{name} {value}: expected at least 1")
    if set(options.protocols) & set(SERVED):
        require("serve", "eval protocols")
    if "lerobot-eval" in options.protocols:
        require("data", "eval protocols --protocols lerobot-eval")
        if importlib.util.find_spec("lerobot") is None:
            raise InputError("eval protocols --protocols lerobot-eval: LeRobot is not installed")
    protocols = options.protocols
    if "learned" in protocols and not (checkpoint / CARD_FILE).is_file():
        print(f"learned: left out, {checkpoint} is not packed (holds no {CARD_FILE})")
        protocols = tuple(name for name in protocols if name != "learned")
    if not protocols:
        raise InputError("--protocols: none is left")
    return protocols


def _play(protocol: str, options: ProtocolOptions, checkpoint: Path, folder: Path) -> ProtocolRun:
    """Play the episodes through a protocol."""
    folder.mkdir()
    began = time.perf_counter()
    if protocol == "lerobot-eval":
        commands, found = [_stock_command(options, checkpoint, folder)], folder
        _call(protocol, commands[0], folder / "output.txt", (0,))
        endings = _stock_endings(protocol, folder, options)
    else:
        commands, found = [], folder / "run"
        with contextlib.ExitStack() as stack:
            spec = f"{protocol}:{checkpoint}"
            if protocol in SERVED:
                served = ["arena_newton.policies.serve", "--policy", f"lerobot:{checkpoint}", "--protocol", protocol]
                served += ["--port", "0", "--task", options.task, "--tracker", options.tracker]
                served += ["--device", options.device]
                commands.append(served)
                spec = stack.enter_context(_server(protocol, commands[0], folder / "server.txt"))
            commands.append(_run_command(options, spec, found))
            _call(protocol, commands[-1], folder / "output.txt", (0, 1))
        endings = _run_endings(found)
    seconds = time.perf_counter() - began
    episodes = []
    for key, (outcome, reason, steps, margin) in endings.items():
        path = found / "actions" / f"{options.task}_base_{key.replace('/', '_')}.npz"
        episodes.append(ProtocolEpisode(key, outcome, reason, steps, margin, _actions(path)))
    return ProtocolRun(protocol, tuple(episodes), seconds, tuple(shell_command(*line) for line in commands))


def _actions(path: Path) -> np.ndarray:
    """Actions of an episode, float32, shape [steps, 40]; none where it ended before its step 0."""
    if not path.is_file():
        return np.zeros((0, ACTION_WIDTH), np.float32)
    with np.load(path) as file:
        return np.ascontiguousarray(file["action"], np.float32)


def _run_command(options: ProtocolOptions, spec: str, folder: Path) -> list[str]:
    """Our runner."""
    flags = RunOptions(
        task=(options.task,),
        tracker=(options.tracker,),
        policy=spec,
        seeds=(0,),
        repeats=options.episodes,
        worlds=options.episodes,
        engine=options.engine,
        device=options.device,
        max_steps=options.max_steps,
        actions=True,
        out=str(folder),
    )
    return ["arena_newton.eval", "run", *words(flags)]


def _stock_command(options: ProtocolOptions, checkpoint: Path, folder: Path) -> list[str]:
    """LeRobot's own command line: one world a batch, so that each forward pass has one row as on our CPU."""
    line = ["lerobot.scripts.lerobot_eval"]
    line += ["--env.discover_packages_path=arena_newton.eval.adapters.lerobot_env", "--env.type=arena_newton"]
    line += [f"--env.task={options.task}", f"--env.tracker={options.tracker}", f"--env.engine={options.engine}"]
    line += [f"--env.device={options.device}", f"--env.episodes={folder}", f"--policy.path={checkpoint}"]
    line += [f"--policy.device={options.device}", f"--eval.n_episodes={options.episodes}", "--eval.batch_size=1"]
    line += ["--seed=0", f"--output_dir={folder / 'lerobot'}"]
    return line if options.max_steps is None else [*line, f"--env.episode_length={options.max_steps}"]


def _start(command: Sequence[str], log: Path) -> subprocess.Popen[bytes]:
    """A program, whose output goes into a file."""
    variables = environment(one_thread=True)
    with log.open("wb") as file:
        return start_module(*command, variables=variables, output=file.fileno(), errors=subprocess.STDOUT, apart=False)


def _call(protocol: str, command: Sequence[str], log: Path, allowed: Sequence[int]) -> None:
    """Run a program to its end."""
    process = _start(command, log)
    try:
        code = process.wait()
    finally:
        end(process, END_S, signal.SIGINT)
    if code not in allowed:
        raise InputError(f"protocol {protocol}: exit code {code}, {_last_line(log)}; all of it is in {log}")


def _last_line(log: Path) -> str:
    lines = [line.strip() for line in log.read_text(errors="replace").splitlines() if line.strip()]
    return lines[-1][:300] if lines else "it printed nothing"


@contextlib.contextmanager
def _server(protocol: str, command: Sequence[str], log: Path) -> Iterator[str]:
    """A server that listens; gives the policy by which it is asked."""
    made, until = _start(command, log), time.monotonic() + START_S
    try:
        while not (found := re.search(f"^{ADDRESS}(.*)\n", log.read_text(errors="replace"), re.MULTILINE)):
            if made.poll() is not None or time.monotonic() > until:
                why = f"its server does not listen, {_last_line(log)}"
                raise InputError(f"protocol {protocol}: {why}; all of it is in {log}")
            time.sleep(POLL)
        yield found[1]
    finally:
        end(made, END_S, signal.SIGINT)


type Ending = tuple[str, str | None, int, float | None]


def _run_endings(folder: Path) -> Mapping[str, Ending]:
    """Endings of the episodes of a results folder."""
    return {
        f"s{one.group_seed}/r{one.repeat}": (one.outcome, one.reason, one.steps, one.margin)
        for one in load_run(folder).records
    }


def _stock_endings(protocol: str, folder: Path, options: ProtocolOptions) -> Mapping[str, Ending]:
    """Endings of the episodes that the environment of `lerobot-eval` wrote, checked against LeRobot's own file."""
    lines = [json.loads(line) for line in (folder / OUTCOMES_FILE).read_text().splitlines()]
    info = json.loads((folder / "lerobot" / "eval_info.json").read_text())
    successes = info["per_task"][0]["metrics"]["successes"]
    if [line["outcome"] == "success" for line in lines] != successes or len(lines) != options.episodes:
        where = f"{folder / 'lerobot'}, {OUTCOMES_FILE} otherwise"
        raise InputError(f"protocol {protocol}: LeRobot counts {successes} in {where}")
    return {
        f"s{line['group_seed']}/r{line['repeat']}": (line["outcome"], line["reason"], line["steps"], line["margin"])
        for line in lines
    }
