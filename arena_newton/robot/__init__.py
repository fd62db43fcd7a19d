"""The Unitree G1: joints, gains and hands, the canonical vectors, rotations."""
