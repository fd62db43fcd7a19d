"""A mode as a package: everything is slippery, and objects start as in execution mode.

Shows: that a mode is a record of ranges, which every command knows by its entry point.
More: docs/howto/bring/add_a_task.md.

    uv pip install -e examples/new_mode
    python -m arena_newton.eval --task football --mode base wet --tracker twist2 --seeds 0 --repeats 20
    python -m arena_newton.eval certify --task football --mode wet --checks modes
"""

from arena_newton.rules.modes import Mode

WET = Mode(
    name="wet",
    sentence="everything is slippery, and objects start in wider ranges",
    placements=lambda rule: rule.execution,
    dynamics={"friction": (0.2, 0.5)},
)
