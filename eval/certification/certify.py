"""``python -m arena_newton.eval certify``: the benchmark proves itself, in one command with one page and one exit code.

Each check is a question with a measurement (`eval.certification`). Evaluations are ordinary results folders under
`<out>/runs`, so that a certification that was stopped goes on where it was.
"""

from __future__ import annotations

import os
import sys
import time
from collections.abc import Mapping, Sequence

from arena_newton import trackers
from arena_newton.cli.flags import check_least, user_path
from arena_newton.cli.quiet import quiet_warp
from arena_newton.doctor import versions
from arena_newton.errors import InputError, check_once
from arena_newton.eval.certification import certificate
from arena_newton.eval.certification.certify_options import CertifyOptions
from arena_newton.eval.certification.checks import (
    agreement,
    axes,
    closed_forms,
    error_rates,
    failures,
    gradients,
    inputs,
    legs,
    lens,
    machines,
    named_modes,
    replays,
    rule_ticks,
    sill,
    solvable,
    swap,
    visible,
)
from arena_newton.eval.certification.context import Context, with_expert
from arena_newton.eval.certification.finding import Check, CheckFinding
from arena_newton.eval.certification.jobs import command_line, play_ahead
from arena_newton.eval.certification.stand_ins.bodies import BODIES, Body
from arena_newton.eval.plan.config import plain_facts
from arena_newton.eval.plan.episode_plan import MAX_EPISODES
from arena_newton.eval.play.factories import Factories
from arena_newton.eval.records.identity import code_hash
from arena_newton.eval.records.journal import ContradictionError
from arena_newton.eval.reports.progress import duration
from arena_newton.files.text import plain_text
from arena_newton.physics.devices import resolve_engine
from arena_newton.rules import modes

__all__ = ["CHECKS", "run"]

CHECKS: tuple[Check, ...] = (
    *replays.CHECKS,
    *solvable.CHECKS,
    *inputs.CHECKS,
    *legs.CHECKS,
    *axes.CHECKS,
    *named_modes.CHECKS,
    *closed_forms.CHECKS,
    *lens.CHECKS,
    *rule_ticks.CHECKS,
    *agreement.CHECKS,
    *machines.CHECKS,
    *swap.CHECKS,
    *visible.CHECKS,
    *sill.CHECKS,
    *failures.CHECKS,
    *error_rates.CHECKS,
    *gradients.CHECKS,
)
"""All checks, in the order in which they run."""


def run(
    options: CertifyOptions,
    factories: Factories | None = None,
    *,
    bodies: Mapping[str, Body] = BODIES | failures.BODIES,
    checks: Sequence[Check] = CHECKS,
) -> int:
    """Run the checks, print a line for each, and write the certificate's files.

    Args:
        factories: What evaluations are built with; the real parts by default.
        bodies: Robots for the checks of legs, and scripted failures.
        checks: What is checked, of which `options.checks` may choose.

    Returns:
        Exit code: 0 no check fails, 1 one fails or nothing was measured.

    Raises:
        InputError: A flag is wrong, or the folder holds something else; raised before the first check.
    """
    began, chosen = time.perf_counter(), _chosen(options, checks)
    context = _context(options, factories or Factories(), bodies)
    left_out = tuple(name for name in with_expert(options.task)[1])
    for name in left_out:
        print(f"{name}: has no expert, nothing of it is checked")
    if options.quick:
        print(f"--quick: {context.episodes} episodes of each cell, so the intervals are wide")
    quiet_warp()
    facts = _facts(context, left_out, planned=[check.name for check in chosen])
    try:
        findings = _found(context, chosen, facts)
    except KeyboardInterrupt:
        if options.jobs:
            print(f"\nwhat was played is kept; go on by {command_line(options)} --resume", file=sys.stderr)
        raise
    if options.jobs:
        print(f"\n{certificate.printed(facts, findings)}\n")
    failed = [check.name for check, finding in findings.items() if finding.verdict == "fail"]
    measured = [finding for finding in findings.values() if finding.verdict != "skip"]
    result = f"{len(failed)} of {len(findings)} checks failed: {' '.join(failed)}" if failed else "no check failed"
    result = result if measured else "nothing was measured"
    print(
        f"{result}; this took {duration(time.perf_counter() - began)}\ncertificate: {context.folder / 'certify.html'}"
    )
    return 1 if failed or (options.jobs and not measured) else 0


def _found(context: Context, chosen: Sequence[Check], facts: certificate.Facts) -> dict[Check, CheckFinding]:
    """Run the checks; each is printed and written as it ends."""
    options, findings = context.options, dict[Check, CheckFinding]()
    if options.jobs > 1:
        play_ahead(options, context.tasks, [check.name for check in chosen], _say)
    for check in chosen:
        started = time.perf_counter()
        try:
            finding = findings[check] = check.run(context)
        except ContradictionError as error:
            declared = plain_text(str(error).replace(f"{context.folder}/", ""), 300)
            finding = findings[check] = CheckFinding("fail", declared)
        spent = duration(time.perf_counter() - started)
        print(f"{finding.verdict:<4}  {check.name:<12}  {finding.summary}  ({spent})", flush=True)
        if options.jobs:
            certificate.write(context.folder, facts, findings)
    return findings


def _chosen(options: CertifyOptions, checks: Sequence[Check]) -> list[Check]:
    """The checks that the flags ask for."""
    known = [check.name for check in checks]
    for name in options.checks:
        if name not in known:
            raise InputError(f"--checks {name}: unknown, choose from {' '.join(known)}")
    for name in options.mode:
        modes.get(name)
    if not options.mode and named_modes.NAME in options.checks:
        raise InputError(f"--checks {named_modes.NAME}: name the modes by --mode")
    unnamed = () if options.mode else (named_modes.NAME,)
    return [
        check for check in checks if (check.name in options.checks if options.checks else check.name not in unnamed)
    ]


def _context(options: CertifyOptions, factories: Factories, bodies: Mapping[str, Body]) -> Context:
    """Check the flags and open the folder."""
    names, without = with_expert(options.task)
    if not names:
        raise InputError(f"--task {' '.join(without)}: no expert, and every check plays one")
    check_once("--tracker", options.tracker)
    for tracker in options.tracker:
        trackers.check_spec(tracker)
        if getattr(factories.tracker(tracker, None), "lookahead", 0):
            why = "reads the coming reference, which recorded actions do not hold: no replay of its episodes is equal"
            raise InputError(f"--tracker {tracker}: {why}, and certify compares them")
    if not options.tracker:
        raise InputError("--tracker: nothing given, at least one is needed")
    if options.episodes is not None and not 1 <= options.episodes <= MAX_EPISODES:
        raise InputError(f"--episodes {options.episodes}: expected 1 to {MAX_EPISODES:,}")
    if options.jobs < 0:
        raise InputError(f"--jobs {options.jobs}: expected 0 or more")
    check_least(options, 1, "worlds")
    if options.twist2_checkpoint is not None:
        try:
            trackers.get("twist2", user_path(options.twist2_checkpoint))
        except InputError as error:
            raise InputError(str(error).replace("--checkpoint", "--twist2-checkpoint", 1)) from None
    if not options.out.strip():
        raise InputError("--out: is empty, name a folder")
    resolve_engine(options.engine, options.device)
    folder = user_path(options.out)
    if folder.exists() and not folder.is_dir():
        raise InputError(f"--out {folder}: is a file")
    if folder.exists() and any(folder.iterdir()):
        if not (folder / "runs").is_dir() and not (folder / certificate.FILE).is_file():
            raise InputError(f"--out {folder}: is not empty and holds no certification; choose another folder")
        if not options.resume:
            raise InputError(
                f"--out {folder}: holds a certification; go on with it by --resume or choose another folder"
            )
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "runs").mkdir(exist_ok=True)
    return Context(options, folder, names, _say, factories, bodies)


def _say(text: str) -> None:
    print(f"  {text}", file=sys.stderr, flush=True)


def _facts(context: Context, left_out: Sequence[str], planned: Sequence[str]) -> certificate.Facts:
    """Facts about the certified benchmark."""
    options = context.options
    engine, device = resolve_engine(options.engine, options.device)
    return {
        "tasks": list(context.tasks),
        "without_expert": list(left_out),
        "trackers": list(context.trackers),
        "episodes": context.episodes,
        "quick": options.quick,
        "engine": engine,
        "device": device,
        "code": code_hash(),
        "planned": list(planned),
        "command": command_line(options),
        "cores": len(os.sched_getaffinity(0)),
        "versions": plain_facts(versions()),
    }
