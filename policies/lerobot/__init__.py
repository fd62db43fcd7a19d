"""Policies of LeRobot: what a checkpoint says of itself, and running it for all worlds at once."""
