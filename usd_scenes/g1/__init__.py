"""The Unitree G1 with Dex3 hands as a USD layer, written by its builder."""
