"""Measurements of checks: what audits and `--stand` find of planted faults, and what they say of honest results."""
