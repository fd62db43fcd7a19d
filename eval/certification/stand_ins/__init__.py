"""Robots, experts, worlds and trackers that lack or spoil something: what checks are tried on."""
