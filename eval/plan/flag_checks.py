"""Checks of the flags of a run by themselves, before any file is opened and anything is started."""

from __future__ import annotations

import dataclasses
import math
import re
from collections.abc import Mapping

from arena_newton.cli.extras import require
from arena_newton.cli.flags import check_least, flag_name
from arena_newton.errors import InputError
from arena_newton.eval.plan.options import Ray, Recording, Remote, RunOptions, Viewer, Workers, flags_of, is_quick
from arena_newton.eval.records.sharding import parse_shard
from arena_newton.files.text import plain_text, unprintable
from arena_newton.pictures.settings import MOST_PORT, VIEWERS
from arena_newton.robot.g1 import TWIST2_DRIVE, TWIST2_HUMANOIDARENA_DRIVE, DriveGains

__all__ = ["DRIVES", "check_flags", "check_width", "check_workers"]

DRIVES: Mapping[str, DriveGains | None] = {
    "auto": None,
    "twist2": TWIST2_DRIVE,
    "humanoidarena": TWIST2_HUMANOIDARENA_DRIVE,
}
"""Drive gains of --drive; `auto` is what rule set and tracker ask for."""
MOST_JOBS = 256
"""Processes of one machine that play."""


def check_flags(options: RunOptions) -> None:
    """Refuse flags that are wrong by themselves, without a look at any file.

    Raises:
        InputError: A flag is out of range, belongs to another that is not given, or contradicts one.
    """
    for field in dataclasses.fields(options):
        given = getattr(options, field.name)
        for text in given if isinstance(given, tuple) else (given,):
            if isinstance(text, str) and (reason := unprintable(text)) is not None:
                raise InputError(f"{flag_name(field.name)} {plain_text(text)}: {reason}")
    if options.drive not in DRIVES:
        raise InputError(f"--drive {options.drive}: unknown, choose from {', '.join(DRIVES)}")
    _check_latency(options)
    options.check_chunks(options.policy)
    _check_shard(options)
    check_least(options, 1, "video_episodes", "worlds")
    for name in ("video_episodes", "video_size", "follow"):
        if getattr(options, name) and not (options.video or options.strip or is_quick(options)):
            raise InputError(f"{flag_name(name)}: belongs to --video or --strip, neither is given")
    _check_belonging(options, Recording, "--record", options.record)
    _check_policy(options)
    _check_viewer(options)
    check_workers(options)
    check_width(options)
    if "all" in options.task and len(options.task) > 1:
        raise InputError("--task all: must be alone, name either all or single tasks")
    if options.seeds and min(options.seeds) < 0:
        raise InputError(f"--seeds {min(options.seeds)}: expected numbers of at least 0")


def _check_belonging(options: Ray | RunOptions, group: type, flag: str, given: bool) -> None:
    """Refuse flags of a group whose first one is not given."""
    for name in () if given else flags_of(group):
        if getattr(options, name) != getattr(group, name):
            raise InputError(f"{flag_name(name)}: belongs to {flag}, which is not given")


def _check_policy(options: RunOptions) -> None:
    """Refuse flags of other policies."""
    for name in set(flags_of(Remote)) - set(Remote.names_for(options.policy)):
        if getattr(options, name) != getattr(Remote, name):
            raise InputError(f"{flag_name(name)}: belongs to --policy remote:<url>, not {options.policy}")


def _check_shard(options: RunOptions) -> None:
    """Refuse a shard that is none, and one of a run that has no plan to split."""
    if options.shard is None:
        return
    parse_shard(options.shard)
    if is_quick(options):
        raise InputError(
            "--shard: splits a plan, which --task, --seeds or --repeats name; --task all is the benchmark's"
        )
    if options.keep is not None:
        raise InputError("--shard: does not go with --only-success, whose attempts follow from the earlier ones")


def _check_latency(options: RunOptions) -> None:
    """Refuse a latency that outlasts what is executed; chunks that are too short show at the first query."""
    replan, late = options.replan, options.latency_ticks
    check_least(options, 0, "latency_ticks")
    if replan is not None and 0 < replan <= late:
        raise InputError(f"--latency-ticks {late}: expected fewer ticks than --replan {replan}")
    if options.ensemble and replan is None and late:
        raise InputError(
            f"--latency-ticks {late}: --ensemble queries every tick; name more than {late} ticks by --replan"
        )


def _check_viewer(options: RunOptions) -> None:
    """Refuse a viewer that cannot be started, before anything is."""
    _check_belonging(options, Viewer, "--viewer", options.viewer is not None)
    if options.viewer not in (None, *VIEWERS):
        raise InputError(f"--viewer {options.viewer}: unknown, choose from {', '.join(VIEWERS)}")
    if options.viewer_follow and options.viewer != "viser":
        raise InputError(f"--viewer-follow: belongs to --viewer viser, not {options.viewer}")
    if not 1 <= options.viewer_port <= MOST_PORT:
        raise InputError(f"--viewer-port {options.viewer_port}: expected 1 to {MOST_PORT}")
    if options.viewer == "viser":
        require("teleop", "--viewer viser", ("viser",))
    if options.viewer == "rerun":
        require("rerun", "--viewer rerun")
    if options.viewer_failures:
        require("teleop", "--viewer-failures", ("viser",))


def check_width(options: RunOptions) -> None:
    """Refuse a rule for the number of episodes that cannot be one.

    Raises:
        InputError: A number is out of range, or a flag does not go with it.
    """
    width, most = options.until_width, options.max
    if width is None:
        if most is not None:
            raise InputError("--max: belongs to --until-width, which is not given")
        return
    if not 0 < width < 1:
        raise InputError(f"--until-width {width:g}: expected more than 0 and less than 1, such as 0.14")
    check_least(options, 1, "max")
    if options.shard is not None:
        raise InputError("--shard: does not go with --until-width, whose episodes follow from the earlier ones")


def check_workers(options: Workers) -> None:
    """Refuse processes that cannot be asked for, before any is started or a cluster is looked for.

    Raises:
        InputError: A number is out of range, a flag does not go with it, or the extra is missing.
    """
    _check_belonging(options, Ray, "--ray", options.ray is not None)
    if not 1 <= options.jobs <= MOST_JOBS:
        raise InputError(f"--jobs {options.jobs}: expected 1 to {MOST_JOBS}")
    if options.dealt and getattr(options, "viewer", None) is not None:
        raise InputError("--viewer: shows worlds of this process, and with --ray or --jobs none are; drop one of both")
    device = getattr(options, "device", None) or ""
    if options.jobs > 1 and re.fullmatch(r"cuda:0*[1-9]\d*", device):
        raise InputError(f"--device {device}: --jobs takes all GPUs in turn; choose some by CUDA_VISIBLE_DEVICES")
    if options.ray is None:
        return
    if options.jobs > 1:
        raise InputError(f"--jobs {options.jobs}: are processes of this machine, not of --ray; drop one of both")
    addresses = [text for text in options.ray if text == "auto" or re.fullmatch(r"[^/\s]+:[0-9]{1,5}", text)]
    if len(options.ray) > 1 or len(addresses) < len(options.ray):
        raise InputError(f"--ray {' '.join(options.ray)}: expected one address, such as 10.0.0.1:6379, auto, or none")
    check_least(options, 1, "ray_actors", "ray_cpus", "ray_attempts")
    gpus, minutes = options.ray_gpus, options.ray_minutes
    if gpus is not None and not 0 < gpus <= 1:
        raise InputError(f"--ray-gpus {gpus:g}: expected more than 0 and at most 1; an environment is on one GPU")
    if not 0 < minutes < math.inf:
        raise InputError(f"--ray-minutes {minutes:g}: expected more than 0, and finite")
    require("ray", "--ray")
