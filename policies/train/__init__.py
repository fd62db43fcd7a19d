"""Trains policies of LeRobot from datasets of demonstrations."""
