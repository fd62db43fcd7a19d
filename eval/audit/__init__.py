"""Audit of results folders: how far each was checked, from its own lines to episodes that are played again."""
