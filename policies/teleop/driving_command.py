"""Commands of teleoperation: make the world, begin the session, report it."""

from __future__ import annotations

import contextlib
import datetime
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from arena_newton import rule_sets, tasks, trackers
from arena_newton.cli.quiet import quiet_warp
from arena_newton.env import ArenaEnv
from arena_newton.errors import InputError
from arena_newton.files.new_folder import held_folder
from arena_newton.pictures.settings import SIZE_LIMITS, CameraConfig
from arena_newton.policies.protocols.ports import bind
from arena_newton.policies.teleop.browser import BrowserSource
from arena_newton.policies.teleop.driving import RANGES
from arena_newton.policies.teleop.page_server import PageServer, new_token
from arena_newton.policies.teleop.source import Source
from arena_newton.policies.teleop.teleop_options import BrowserOptions, SessionOptions
from arena_newton.policies.teleop.teleop_session import TeleopSession
from arena_newton.policies.teleop.world_view import PERIOD, WorldView
from arena_newton.rules import modes, seeding

__all__ = ["drive", "drive_by_browser", "make_world", "session_facts"]

LARGEST_SEED = 2**31 - 1
"""Largest number of a session."""


def make_world(options: SessionOptions) -> ArenaEnv:
    """The one world of a session.

    Raises:
        InputError: A flag names something unknown or absent.
    """
    if options.task not in tasks.names():
        raise InputError(f"--task {options.task}: unknown, choose from {', '.join(tasks.names())}")
    modes.get(options.mode)
    if not 0 <= options.seed <= LARGEST_SEED:
        raise InputError(f"--seed {options.seed}: expected 0 to {LARGEST_SEED}")
    variant = None
    if options.variant is not None:
        variant = Path(options.variant).expanduser()
        if not variant.is_file():
            raise InputError(f"--variant {options.variant}: no such file")
    rules = rule_sets.get(options.rules)
    trackers.check_spec(options.tracker)
    quiet_warp()
    return ArenaEnv(
        options.task,
        tracker=trackers.get(options.tracker, options.checkpoint),
        worlds=1,
        engine=options.engine,
        device=options.device,
        rules=rules,
        mode=options.mode,
        variant_file=None if variant is None else str(variant),
        fast_physics=options.fast_physics,
    )


def drive(
    env: ArenaEnv,
    source: Source,
    options: SessionOptions,
    displays: Sequence[tuple[Callable[[], None], float]] = (),
) -> int:
    """Run a session until the source quits or Ctrl-C, and say how it went.

    Args:
        env: The world; closed at the end.
        source: What a person drives with; closed at the end.
        displays: See `TeleopSession`.

    Returns:
        Exit code 0.

    Raises:
        InputError: A flag is wrong.
    """
    try:
        folder = Path(options.out or f"teleop/{datetime.datetime.now():%Y%m%d_%H%M%S}").expanduser()
        with held_folder(folder, "saves a person's episodes in it"):
            try:
                session = TeleopSession(
                    env,
                    source,
                    folder=folder,
                    seed=options.seed,
                    camera=_camera(options),
                    displays=displays,
                    facts=session_facts(env, options),
                    say=lambda line: print(line, flush=True),
                )
                with contextlib.suppress(KeyboardInterrupt):
                    session.run()
                print(f"\n{session.report()}", flush=True)
            finally:
                with contextlib.suppress(OSError):  # it holds episodes
                    folder.rmdir()
    finally:
        source.close()
        env.close()
    return 0


def session_facts(env: ArenaEnv, options: SessionOptions) -> dict[str, object]:
    """Facts on which the motion of a session's episodes depends, as `eval record --from` compares them with its own.

    Returns:
        JSON.
    """
    facts: dict[str, object] = {
        "engine": env.engine,
        "device": str(env.device),
        "drive": "auto",
        "fast_physics": options.fast_physics,
        "rules_hash": env.rules.hash_for((env.spec.name,)),
        # Of a tracker that is not bound to a world yet: how its network runs here is the environment's.
        "tracker_facts": trackers.get(options.tracker, options.checkpoint).describe(),
        "environment": env.describe(),
        "seeds": seeding.TELEOPERATION,
    }
    plain: dict[str, object] = json.loads(json.dumps(facts, default=str))
    return plain


def _camera(options: SessionOptions) -> CameraConfig | None:
    """The head camera's pictures."""
    numbers = re.fullmatch(r"([0-9]{1,4})x([0-9]{1,4})", options.ego_size)
    if numbers is None or not all(SIZE_LIMITS[0] <= int(n) <= SIZE_LIMITS[1] for n in numbers.groups()):
        raise InputError(f"--ego-size {options.ego_size}: expected width x height, such as 320x240")
    if options.no_ego:
        return None
    return CameraConfig(int(numbers[1]), int(numbers[2]), fit="native")


def drive_by_browser(options: BrowserOptions) -> int:
    """Serve the page and run the session.

    Returns:
        Exit code 0.

    Raises:
        InputError: A flag is wrong, or a port taken.
    """
    _camera(options)
    with contextlib.ExitStack() as stack:
        listening = stack.enter_context(bind(options.port, "--port"))
        env = make_world(options)
        stack.callback(env.close)
        token = new_token()
        view = None if options.no_view else WorldView(env, options.port_of_view(), token)
        facts = {
            "task": env.spec.name,
            "instruction": env.spec.instruction,
            "tracker": env.tracker.name,
            "mode": env.mode,
            "seed": options.seed,
            "ranges": RANGES,
        }
        source = BrowserSource(PageServer(listening, token, facts, None if view is None else view.url), view)
        print(f"open {source.server.url}\nCtrl-C ends the session.", flush=True)
        return drive(env, source, options, [] if view is None else [(view.draw, PERIOD)])
