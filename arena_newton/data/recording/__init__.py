"""Demonstrations as they are recorded: one NPZ per episode, one MP4 per camera."""
