"""Evaluation through the interfaces of others: Gymnasium, LeRobot's environment, served protocols."""
