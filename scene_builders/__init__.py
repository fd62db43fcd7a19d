"""Builders of the USD layers in `usd_scenes`, from a checkout: `python -m scene_builders --help`."""
