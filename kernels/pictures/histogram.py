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
    line, counts = pictures[world, row], histogram[world, channel]
    value, start = wp.int32(line[0, channel]), wp.int32(0)
    for column in range(line.shape[0]):
        seen = wp.int32(line[column, channel])
        if seen != value:
            wp.atomic_add(counts, value, wp.int64(column - start))
            value, start = seen, column
    wp.atomic_add(counts, value, wp.int64(line.shape[0] - start))


def launch_histogram(pictures: wp.array, counted: wp.array, histogram: wp.array) -> None:
    """Count the pixels of pictures by channel and value.

    Args:
        pictures: uint8, shape [worlds, H, W, 3].
        counted: Worlds whose pictures count, bool, shape [worlds].
        histogram: Added to, int64, shape [worlds, 3, 256].
    """
    worlds, height = pictures.shape[:2]
    launch(_histogram, (worlds, height, 3), [pictures, counted], [histogram])
