"""Kernels of the judge: success, fall, predicates and the door's latch."""
