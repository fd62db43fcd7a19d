"""Bytes of rising curves by table.

A picture's bytes are rising functions of floats with powers in them, which took a third of its time on a CPU. A table
of the least float of each byte, found by bisection of the function itself, gives the same bytes.
"""

import warp as wp

__all__ = ["as_float", "level_of", "settled"]

LARGEST = wp.constant(wp.uint32(0x7F7FFFFF))
"""Bits of the largest float, at which a bisection begins; positive floats are ordered as their bits."""


@wp.func
def as_float(bits: wp.uint32) -> wp.float32:
    """The float that has these bits."""
    return wp.cast(bits, wp.float32)


def level_of(byte_of: wp.Function) -> wp.Function:
    """A function that gives the least float of a byte, by bisection.

    Args:
        byte_of: Byte of a float, which rises with it.
    """

    @wp.func
    def level(byte: wp.int32) -> wp.float32:
        low = wp.uint32(0)
        high = LARGEST
        while low < high:
            middle = low + (high - low) / wp.uint32(2)
            if wp.int32(byte_of(as_float(middle))) >= byte:
                high = middle
            else:
                low = middle + wp.uint32(1)
        return as_float(low)

    return level


@wp.func
def settled(levels: wp.array[wp.float32], value: wp.float32, guess: wp.int32) -> wp.uint32:
    """Byte of a value: the last whose level it reaches.

    Args:
        levels: Least value of each byte, shape [256].
        value: At least 0, no NaN.
        guess: Where the search begins, any number.
    """
    byte = wp.clamp(guess, 0, 255)
    while byte < 255 and value >= levels[byte + 1]:
        byte += 1
    while byte > 0 and value < levels[byte]:
        byte -= 1
    return wp.uint32(byte)
