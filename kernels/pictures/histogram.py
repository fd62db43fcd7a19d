"""Histograms of pictures, counted where they are drawn: exact, so in any order the same."""

import warp as wp

from arena_newton.kernels.launching import launch

__all__ = ["launch_histogram"]


@wp.kernel(enable_backward=False)
def _histogram(pictures: wp.array4d[wp.uint8], counted: wp.array[wp.bool], histogram: wp.array3d[wp.int64]):
    world, row, channel = wp.tid()
    if not counted[world]:
        return
    # Neighbours of one value are added at once: threads that add to the same number wait for each other.
    value, run = wp.int32(pictures[world, row, 0, channel]), wp.int32(0)
    for column in range(pictures.shape[2]):
        seen = wp.int32(pictures[world, row, column, channel])
        if seen != value:
            wp.atomic_add(histogram, world, channel, value, wp.int64(run))
            value, run = seen, 0
        run += 1
    wp.atomic_add(histogram, world, channel, value, wp.int64(run))


def launch_histogram(pictures: wp.array, counted: wp.array, histogram: wp.array) -> None:
    """Count the pixels of pictures by channel and value.

    Args:
        pictures: uint8, shape [worlds, H, W, 3].
        counted: Worlds whose pictures count, bool, shape [worlds].
        histogram: Added to, int64, shape [worlds, 3, 256].
    """
    worlds, height = pictures.shape[:2]
    launch(_histogram, (worlds, height, 3), [pictures, counted], [histogram])
