"""A learned policy that comes with the package: packed in half precision, run without LeRobot."""
