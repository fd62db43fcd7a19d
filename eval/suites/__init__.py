"""Suites: many runs as one plan, and the suite files that come with the package."""
