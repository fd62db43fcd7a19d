"""The lab scene, on which trackers are trained and measured, and its author."""
