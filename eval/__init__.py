"""The judge: plan, run, journal, statistics and report of a benchmark run (``python -m arena_newton.eval``)."""
