"""Command lines: flags from dataclasses, registries of names, extras, exit codes."""
