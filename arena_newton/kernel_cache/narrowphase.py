"""mujoco_warp's collision kernel of primitive shapes, with its loop over kinds of pairs written out.

The loop calls `wp.static(functions[i])`, and Warp learns which functions these are by generating the kernel's code: in
1.1 s at every start, even if the compiled kernel is cached. Written out, the source alone tells; what runs is the same.
"""

from __future__ import annotations

import contextlib
import functools
import inspect
import linecache
import re
import textwrap
from collections.abc import Callable, Sequence

import warp as wp
from mujoco_warp._src import collision_primitive

__all__ = ["write_out_pairs"]

FACTORY = "_primitive_narrowphase"
LOOP = "    for i in range(wp.static(len(primitive_collisions_func))):\n"
END = "\n  return primitive_narrowphase\n"

Factory = Callable[[Sequence[object], Sequence[wp.Function]], wp.Kernel]


def write_out_pairs() -> None:
    """Replace the function that makes the kernel, unless that is done or the installed version writes it otherwise."""
    library = getattr(collision_primitive, FACTORY, None)
    if inspect.isfunction(library):
        with contextlib.suppress(OSError, ValueError):  # without its source, or with another one, it stays
            _parts(library)
            setattr(collision_primitive, FACTORY, functools.partial(_kernel, library))


def _parts(library: Factory) -> tuple[str, str]:
    """Source up to the loop, and a turn of the loop as statements beside it.

    Raises:
        ValueError: There is no such loop.
        OSError: There is no source.
    """
    head, *rest = inspect.getsource(library).split(LOOP)
    body, *after = "".join(rest).split(END)
    if len(rest) != 1 or after != [""] or re.search(r"\bi\b", body.replace("[i]", "")):
        raise ValueError(FACTORY)
    return head, textwrap.indent(textwrap.dedent(body), "    ")


def _kernel(library: Factory, types: Sequence[object], functions: Sequence[wp.Function]) -> wp.Kernel:
    """The kernel of these kinds of pairs, from the library's own cache once it is made."""
    return _factory(library, len(functions))(types, functions)


@functools.cache
def _factory(library: Factory, pairs: int) -> Factory:
    """The library's function with its loop written out for so many kinds of pairs."""
    head, turn = _parts(library)
    written = head + "\n".join(turn.replace("[i]", f"[{number}]") for number in range(pairs)) + END
    name = f"<{FACTORY} of {pairs} pairs>"
    linecache.cache[name] = (len(written), None, written.splitlines(keepends=True), name)  # Warp reads the source here
    names = dict(vars(collision_primitive))
    exec(compile(written, name, "exec", dont_inherit=True), names)
    made: Factory = names[FACTORY]
    return made
