"""Checks of recordings and datasets: verification, inspection, statistics, speed."""
