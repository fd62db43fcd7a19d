"""Command line: ``python -m benchmarks <bench> [flags]`` in a checkout.

A bench is imported when it is called, so that the overview answers at once.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from arena_newton.cli.command_line import exit_code
from arena_newton.cli.extras import require
from arena_newton.cli.flags import check_bounds, parse_flags
from arena_newton.errors import InputError
from benchmarks.bench_options import (
    AuditTimeOptions,
    CameraBenchOptions,
    DatasetBenchOptions,
    DeviceOptions,
    ForgeryOptions,
    GradientBenchOptions,
    HonestOptions,
    MistakesOptions,
    PeerOptions,
    PlainBenchOptions,
    PolicyBenchOptions,
    ProcessorOptions,
    RecordingBenchOptions,
    RoundsBenchOptions,
    ServerBenchOptions,
    TrainingBenchOptions,
)

__all__ = ["BENCHES", "Item", "main"]

PROG = "python -m benchmarks"


@dataclass(frozen=True)
class Item:
    """One bench."""

    options: type[PlainBenchOptions]
    """Dataclass of its flags."""
    work: str
    """`module:function`; takes the flags, yields figures, or gives several items by name."""
    purpose: str
    """One line of the overview."""
    extras: tuple[str, ...] = ()
    """Extras that it needs."""


BENCHES = {
    "peers": Item(PeerOptions, "peers:pairs", "this product next to other programs, by turns", ("data", "train")),
    "training": Item(
        TrainingBenchOptions, "training_bench:training_figures", "steps per second of trainings", ("data", "policies")
    ),
    "dataset": Item(DatasetBenchOptions, "dataset_bench:dataset_figures", "random reads, building", ("data",)),
    "recording": Item(RecordingBenchOptions, "recording_bench:recording_figures", "recording of demonstrations"),
    "policy": Item(PolicyBenchOptions, "policy_bench:policy_figures", "episodes of a policy that sees", ("policies",)),
    "camera": Item(CameraBenchOptions, "single_figures:camera_speeds", "pictures of the head camera per second"),
    "pictures": Item(PlainBenchOptions, "single_figures:picture_costs", "time that strips and videos add"),
    "server": Item(
        ServerBenchOptions, "server_load:load_figures", "a policy server beside clients with large pictures", ("serve",)
    ),
    "generator": Item(RoundsBenchOptions, "single_figures:generator_times", "a tick of the reference generator"),
    "episodes": Item(PlainBenchOptions, "single_figures:episode_times", "60 Football episodes on two cores"),
    "gradients": Item(GradientBenchOptions, "gradient_bench:slope_figures", "exact slopes against finite differences"),
    "overview": Item(PlainBenchOptions, "single_figures:overview_times", "python -m arena_newton.eval --help"),
    "forgeries": Item(ForgeryOptions, "audits.forgeries:forgery_figures", "forged results, and what finds each"),
    "audit": Item(AuditTimeOptions, "audits.audit_times:audit_times", "duration of an audit"),
    "processors": Item(ProcessorOptions, "audits.processors:processor_figures", "replays with other instructions"),
    "devices": Item(DeviceOptions, "audits.device_ticks:device_figures", "ticks and pictures of engine warp, replayed"),
    "honest": Item(HonestOptions, "audits.honest_folders:honest_figures", "honest results that an audit accuses: none"),
    "mistakes": Item(
        MistakesOptions, "audits.planted_mistakes:mistake_figures", "a tracker's mistakes that --stand finds"
    ),
    "tests": Item(PlainBenchOptions, "single_figures:suite_times", "the test suite, kernels cached and not"),
}
"""Benches by name."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line, with the arguments of the process by default.

    Returns:
        Exit code: 0 done, 1 a measured figure misses its bar, 2 bad input, 130 interrupted.
    """
    arguments = list(sys.argv[1:] if argv is None else argv)
    return exit_code(lambda: _run(arguments))


def _run(arguments: list[str]) -> int:
    if not arguments or arguments[0] in ("-h", "--help"):
        width = max(map(len, BENCHES))
        lines = [f"  {PROG} {name:<{width}}  {bench.purpose}" for name, bench in BENCHES.items()]
        text = "\n".join(
            [f"usage: {PROG} BENCH [flags]", "", "benches:", *lines, "", "Each explains its flags by --help."]
        )
        print(text, file=sys.stdout if arguments else sys.stderr)
        return 0 if arguments else 2
    name = arguments.pop(0)
    if name not in BENCHES:
        raise InputError(f"{name}: unknown bench, known are {' '.join(BENCHES)}")
    bench = BENCHES[name]
    options = parse_flags(bench.options, arguments, f"{PROG} {name}")
    check_bounds(options)
    for extra in bench.extras:
        require(extra, f"benchmarks {name}")
    from arena_newton.cli.quiet import quiet_warp
    from arena_newton.eval.bench.timing import print_figures

    quiet_warp()
    module, _, function = bench.work.partition(":")
    work = getattr(importlib.import_module(f"benchmarks.{module}"), function)
    items = work(options) if name == "peers" else {name: lambda: work(options)}
    return print_figures(items, as_json=options.json)


if __name__ == "__main__":
    sys.exit(main())
