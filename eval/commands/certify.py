"""`python -m arena_newton.eval certify`: checks of the benchmark and its certificate."""

from __future__ import annotations

import dataclasses
import os
from typing import TYPE_CHECKING

from arena_newton.eval.certification.certify_options import CertifyOptions

if TYPE_CHECKING:
    from arena_newton.eval.play.factories import Factories

__all__ = ["QUICK_JOBS", "run"]

QUICK_JOBS = 2
"""Processes that play at once under --quick where nobody says how many."""


def run(options: CertifyOptions, factories: Factories | None = None) -> int:
    """Run the checks."""
    from arena_newton.eval.certification import certify

    if options.quick and options.jobs == 1 and factories is None:
        options = dataclasses.replace(options, jobs=min(QUICK_JOBS, len(os.sched_getaffinity(0))))
    return certify.run(options, factories)
