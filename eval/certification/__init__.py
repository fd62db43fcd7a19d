"""The checks of `python -m arena_newton.eval certify`, one module for each group, and what they share."""
