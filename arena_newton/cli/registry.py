"""Things known by name: built in, registered in this process, or offered by other packages as entry points."""

from __future__ import annotations

import functools
import importlib
import importlib.metadata
import inspect
import sys
from collections.abc import Callable, Mapping
from typing import Any

from arena_newton.errors import InputError, UnknownName

__all__ = ["Registry"]


@functools.cache
def _listed(path: tuple[str, ...]) -> importlib.metadata.EntryPoints:
    """Entry points of all groups on a path; to look for them takes as long as hundreds of episodes' lines."""
    return importlib.metadata.entry_points()


@functools.cache
def _installed(group: str, path: tuple[str, ...]) -> importlib.metadata.EntryPoints:
    """Entry points of a group on a path."""
    return _listed(path).select(group=group)


class Registry[T]:
    """Makers of one kind of thing, or things themselves; the built-in ones are imported when they are asked for."""

    def __init__(
        self, noun: str, group: str, base: Callable[[], type[T]], built_in: Mapping[str, str], *, named: bool = False
    ):
        """Name the kind.

        Args:
            noun: What messages and the flag call it, such as `tracker` for `--tracker`.
            group: Entry-point group under which other packages offer theirs.
            base: Gives the class that everything made must be of.
            built_in: Name to `module:attribute` of a maker.
            named: What is made has a `name`, which must be the one it is known by.
        """
        self.noun, self.group, self.base, self.built_in, self.named = noun, group, base, built_in, named
        self._registered: dict[str, Callable[..., T] | T] = {}

    def register(self, name: str, factory: Callable[..., T] | T) -> None:
        """Offer a maker, or a thing that is made, in this process.

        Raises:
            InputError: A built-in one has that name.
        """
        if name in self.built_in:
            raise InputError(f"{self.noun} {name!r}: is built in; register yours under another name")
        self._registered[name] = factory

    def unregister(self, name: str) -> None:
        """Take back what was offered in this process, if anything."""
        self._registered.pop(name, None)

    def points(self, name: str | None = None) -> list[importlib.metadata.EntryPoint]:
        """Entry points of other packages, of one name or all."""
        return [one for one in _installed(self.group, tuple(sys.path)) if name is None or one.name == name]

    def names(self) -> tuple[str, ...]:
        """All names, sorted."""
        return tuple(sorted({*self.built_in, *self._registered, *(point.name for point in self.points())}))

    def check(self, name: str) -> None:
        """Refuse a name that nobody offers, or that several do.

        Raises:
            UnknownName: Nobody does; the message says what is known.
            InputError: Several do; it says who.
        """
        if name not in self.names():
            known = ", ".join(self.names()) or "none: no package is installed that offers one"
            raise UnknownName(f"--{self.noun} {name}: unknown {self.noun}; known are {known}")
        if name in self._registered:
            return
        offers = ["this package"] if name in self.built_in else []
        offers += [f"package {point.dist.name}" if point.dist else "another package" for point in self.points(name)]
        if len(offers) > 1:
            raise InputError(
                f"--{self.noun} {name}: offered by {' and by '.join(offers)}; uninstall or rename all but one"
            )

    def load(self, name: str) -> Callable[..., T] | T:
        """Find the maker of a name, or what is offered as it is.

        Raises:
            InputError: Unknown or doubled name, or a package that does not load.
        """
        self.check(name)
        return self._registered.get(name) or (self._own if name in self.built_in else self._loaded)(name)

    def make(self, name: str, *arguments: Any, **options: Any) -> T:
        """Make one by name.

        Raises:
            InputError: Unknown or doubled name, a package that does not load, a maker that does not fit, or another
                name than that of what it makes, where they are `named`.
        """
        factory = self.load(name)
        if isinstance(factory, self.base()):
            return self._known_as(name, factory)
        if not callable(factory):
            raise InputError(f"--{self.noun} {name}: its package offers a {type(factory).__name__}, not a {self.noun}")
        try:
            inspect.signature(factory).bind(*arguments, **options)
        except TypeError as error:
            raise InputError(f"--{self.noun} {name}: its factory does not take what it is given ({error})") from None
        except ValueError:  # some of those written in C have no signature
            pass
        made = factory(*arguments, **options)
        if not isinstance(made, self.base()):
            kind = self.base().__name__
            raise InputError(f"--{self.noun} {name}: its factory makes a {type(made).__name__}, not a {kind}")
        return self._known_as(name, made)

    def _known_as(self, name: str, made: T) -> T:
        own = getattr(made, "name", name) if self.named else name
        if own != name:
            raise InputError(f"--{self.noun} {name}: its package calls it {own}; entry point and record need one name")
        return made

    def _own(self, name: str) -> Callable[..., T] | T:
        module, _, attribute = self.built_in[name].partition(":")
        factory: Callable[..., T] | T = getattr(importlib.import_module(module), attribute)
        return factory

    def _loaded(self, name: str) -> Callable[..., T] | T:
        try:
            factory: Callable[..., T] | T = self.points(name)[0].load()
            return factory
        except Exception as error:
            reason = " ".join(str(error).split())
            message = f"--{self.noun} {name}: its package does not load ({type(error).__name__}: {reason})"
            raise InputError(message) from error
