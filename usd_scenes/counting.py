"""Number of prims that a scene would have, counted through its layers before USD composes one of them."""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from arena_newton.files import limits

__all__ = ["Arc", "Contents", "count_prims"]

Key = Any
"""Identity of a layer, chosen by the caller; hashable."""


@dataclass(eq=False)
class Arc:
    """One reference of a layer to another, or a prim of its own."""

    prim: str
    """Prim or property that holds the path; empty for the whole layer."""
    asset: str
    """The asset path as written; empty for the layer itself."""
    target: str = ""
    """The prim that is named; empty for the default prim."""
    of_class: bool = False
    """An inherit or a specialize, which also reaches the class of that name in every layer above."""
    location: Key = None
    """Layer that the asset path leads to."""


@dataclass
class Contents:
    """Contents of one layer."""

    default_prim: str
    """Name of its default prim."""
    prims: list[str] = field(default_factory=list)
    """Path of every prim that it has opinions about, of all variants."""
    arcs: list[Arc] = field(default_factory=list)
    """References, payloads, inherits and specializes."""
    sublayers: list[Arc] = field(default_factory=list)
    images: list[Arc] = field(default_factory=list)


class _TooMany(Exception):
    """The count is over a limit."""


def count_prims(graph: Mapping[Key, Contents], start: Key) -> tuple[str, str] | None:
    """Fault of the number of prims, as (prim path, message); None if there is none.

    The count is at least that of the composed prims: a prim counts once for every layer with an opinion about it,
    and every variant counts.

    Args:
        graph: Contents of every layer by its location.
        start: Location of the layer that is opened.
    """
    try:
        _Counting(graph).total(start, "", 0)
    except _TooMany as error:
        prim, message = error.args
        return prim, message
    return None


class _Counting:
    def __init__(self, graph: Mapping[Key, Contents]):
        self._graph = graph
        self._stacks: dict[Key, list[Key]] = {}
        self._below: dict[Key, dict[str, dict[str, int]]] = {}
        self._arcs: dict[Key, dict[str, list[Arc]]] = {}
        self._totals: dict[tuple[Key, str], int] = {}

    def total(self, location: Key, prim: str, depth: int) -> int:
        """Prims at and below a prim of a layer and its sublayers, with all that they refer to."""
        key = (location, prim)
        if key in self._totals:
            return self._totals[key]
        # USD names a cycle and cuts it; here it ends with nothing.
        self._totals[key] = 0
        count = 0
        for layer in self._stack(location):
            below, arcs = self._tables(layer)
            for path, times in below.get(prim, {}).items():
                count += times
                for arc in arcs.get(path, ()):
                    if depth >= limits.ARC_DEPTH:
                        raise _TooMany(path, f"references lead over more than {limits.ARC_DEPTH} prims")
                    count += self._target(arc, location, depth + 1)
                    if count > limits.PRIMS:
                        break
                if count > limits.PRIMS:
                    what = "the scene" if not depth else "what is referenced"
                    raise _TooMany(path, f"{what} has more than {limits.PRIMS} prims, counted through all references")
        self._totals[key] = count
        return count

    def _target(self, arc: Arc, location: Key, depth: int) -> int:
        if arc.of_class:
            # A class also takes what layers above say about the prim of that name.
            return sum(self.total(layer, arc.target, depth) for layer in self._graph)
        if not arc.asset:
            return self.total(location, arc.target or self._default(location), depth)
        if arc.location not in self._graph:
            return 0
        return self.total(arc.location, arc.target or self._default(arc.location), depth)

    def _default(self, location: Key) -> str:
        """Path of the default prim; a layer without one is counted as a whole."""
        name = next((self._graph[layer].default_prim for layer in self._stack(location)), "")
        return f"/{name.lstrip('/')}" if name else ""

    def _stack(self, location: Key) -> list[Key]:
        """A layer and its sublayers, each as often as USD would take it."""
        if location not in self._stacks:
            stack: list[Key] = []
            waiting: list[tuple[Key, tuple[Key, ...]]] = [(location, ())]
            while waiting:
                layer, above = waiting.pop()
                if layer in above or layer not in self._graph:
                    continue
                stack.append(layer)
                if len(stack) > limits.LAYERS:
                    raise _TooMany("", f"its sublayers lead to more than {limits.LAYERS} layers")
                waiting += [(arc.location, (*above, layer)) for arc in reversed(self._graph[layer].sublayers)]
            self._stacks[location] = stack
        return self._stacks[location]

    def _tables(self, layer: Key) -> tuple[dict[str, dict[str, int]], dict[str, list[Arc]]]:
        """Prims at and below each prim (the empty path for all) with how often they stand, and the arcs of each."""
        if layer not in self._below:
            prims = self._graph[layer].prims
            if len(prims) > limits.PRIMS:
                raise _TooMany(prims[limits.PRIMS], f"a layer has {len(prims)} prims, expected at most {limits.PRIMS}")
            below: dict[str, dict[str, int]] = {}
            for path, times in Counter(prims).items():
                part = path
                while part:
                    below.setdefault(part, {})[path] = times
                    part = part.rpartition("/")[0]
                below.setdefault("", {})[path] = times
            arcs: dict[str, list[Arc]] = {}
            for arc in self._graph[layer].arcs:
                arcs.setdefault(arc.prim, []).append(arc)
            self._below[layer], self._arcs[layer] = below, arcs
        return self._below[layer], self._arcs[layer]
