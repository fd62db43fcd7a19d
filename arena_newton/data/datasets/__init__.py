"""LeRobot datasets: built of recordings, merged, split and read."""
