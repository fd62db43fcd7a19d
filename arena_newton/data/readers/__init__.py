"""Readers of recordings and datasets: frames, rows, and actions by their label protocol."""
