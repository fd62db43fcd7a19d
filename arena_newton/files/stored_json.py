"""Stored JSON, ours and that of others: read within limits, and held to the fields of a record before it is used.

A record is a dataclass or a typed dictionary; its annotations may hold a `Fit` or `Known`, which say more than a type.
"""

from __future__ import annotations

import collections.abc
import dataclasses
import errno
import functools
import json
import math
import os
import stat
import sys
import types
import typing
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, NoReturn

from arena_newton.errors import InputError
from arena_newton.files.text import is_printable, plain_text
from arena_newton.files.untrusted_files import read_bytes

__all__ = ["MAX_NAME", "MAX_TEXT", "Facts", "Fit", "Json", "JsonObject", "Known", "Name", "check_types", "fit"]
__all__ += ["is_name", "loaded", "parse", "read_object", "read_regular", "shown"]

type Json = Any
"""A JSON value: null, true or false, a number, text, a list or an object."""
type JsonObject = dict[str, Json]

MAX_DEPTH = 16
"""Nesting of objects and arrays; ours go to 5."""
MAX_NAME = 512
"""Characters of a name such as a policy with its address."""
MAX_TEXT = 1 << 16
"""Characters of a flag's value, fewer than this."""


def read_regular(path: Path, limit: int) -> bytes:
    """Content of a regular file of at most ``limit`` bytes; links, pipes and devices are refused.

    Raises:
        FileNotFoundError: There is no such file.
        InputError: It is something else, too large, or cannot be read.
    """
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK)
    except FileNotFoundError:
        raise
    except OSError as error:
        link = error.errno == errno.ELOOP
        raise InputError(f"{path}: {'is a link' if link else f'cannot be read ({error.strerror})'}") from None
    about = os.fstat(handle)
    if not stat.S_ISREG(about.st_mode):  # before it becomes a file object, which a folder cannot
        os.close(handle)
        raise InputError(f"{path}: is not a regular file")
    with os.fdopen(handle, "rb") as file:
        if about.st_size > limit:
            raise InputError(f"{path}: {about.st_size:,} bytes, expected at most {limit:,}")
        try:
            return file.read()
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror})") from None


def parse(data: bytes) -> Json:
    """Strict JSON: no NaN, no infinity, no number beyond float, nothing nested too deep, no unpaired surrogate.

    Raises:
        ValueError: It is not.
    """

    def refuse(name: str) -> NoReturn:
        raise ValueError(f"{name} is not JSON")

    try:
        text = data.decode("utf-8")
        value = json.loads(text, parse_constant=refuse)
        if "\\u" in text:  # an escape is the only way to an unpaired surrogate, which no file can be written with
            json.dumps(value, ensure_ascii=False).encode("utf-8")
    except RecursionError:
        raise ValueError("nested too deep") from None
    waiting = [(value, 0)]
    while waiting:
        part, depth = waiting.pop()
        if depth > MAX_DEPTH:
            raise ValueError("nested too deep")
        if isinstance(part, float) and not math.isfinite(part):
            raise ValueError("a number beyond range")
        if isinstance(part, dict):
            waiting += [(p, depth + 1) for pair in part.items() for p in pair]
        elif isinstance(part, list):
            waiting += [(p, depth + 1) for p in part]
    return value


def read_object(path: Path, most: int, version: int | None = None) -> JsonObject:
    """A JSON object in a file of at most ``most`` bytes, with that number as its `format` where a version is given.

    Raises:
        InputError: The file is absent, too large, no JSON object, or of another version.
    """
    try:
        content = json.loads(read_bytes(path, most))
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: not readable as JSON ({plain_text(error, 200)})") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: holds {type(content).__name__}, expected an object")
    if version is not None and content.pop("format", None) != version:
        raise InputError(f"{path}: expected an object with format {version}")
    return content


@dataclass(frozen=True)
class Fit:
    """Constraint on a stored value beyond its type; a part of its annotation."""

    expected: str
    """Noun phrase for messages, such as `a number of ticks`."""
    test: Callable[[Json], bool] = lambda value: True


@dataclass(frozen=True)
class Known:
    """A stored value is one of these names."""

    names: Callable[[], Collection[str]]
    made: Callable[[Json], bool] = lambda value: False
    """Test of a text that is made of one of them by rule."""

    def test(self, value: Json) -> bool:
        """True if a text is one of the names, or made of one."""
        return value in self.names() or self.made(value)


def is_name(value: Json) -> bool:
    """True if a value is a text that names something: not empty, not long, printable."""
    return isinstance(value, str) and 0 < len(value) <= MAX_NAME and is_printable(value)


def _facts(value: Json) -> bool:
    """True if the numbers in an object, at any depth, are such that a float can hold them."""
    waiting = [value]
    while waiting:
        part = waiting.pop()
        if isinstance(part, dict):
            waiting += part.values()
        elif isinstance(part, list):
            waiting += part
        elif isinstance(part, int | float) and not isinstance(part, bool) and not _number(part):
            return False
    return True


def _number(value: Json) -> bool:
    """True if a value is a number that a float can hold: JSON's integers have no end."""
    return isinstance(value, int | float) and not isinstance(value, bool) and abs(value) <= sys.float_info.max


Name = Annotated[str, Fit("a name", is_name)]
Facts = Annotated[dict[str, Json], Fit("facts by name", _facts)]


def tester(hint: object) -> Callable[[Json], bool]:
    """Test of whether a stored value fits an annotation; arrays stand for tuples."""
    if isinstance(hint, typing.TypeAliasType):
        return tester(hint.__value__)
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if origin is Annotated:
        both = [tester(parts[0]), *(part.test for part in parts[1:] if isinstance(part, Fit | Known))]
        if len(both) == 2:  # the usual case, without a loop: a journal has up to millions of values
            first, second = both
            return lambda v: first(v) and second(v)
        return lambda v: all(test(v) for test in both)
    if origin is Literal:
        return lambda v: isinstance(v, str) and v in parts
    if origin in (types.UnionType, typing.Union):
        choices = [tester(part) for part in parts]
        return lambda v: any(test(v) for test in choices)
    if origin is list or (origin is tuple and parts[1:] == (...,)):
        each = tester(parts[0])
        return lambda v: isinstance(v, list | tuple) and all(map(each, v))
    if origin is tuple:
        row = [tester(part) for part in parts]
        return lambda v: (
            isinstance(v, list | tuple) and len(v) == len(row) and all(t(x) for t, x in zip(row, v, strict=True))
        )
    if origin in (dict, collections.abc.Mapping):
        key, value = tester(parts[0]), tester(parts[1])
        return lambda v: isinstance(v, dict) and all(key(k) and value(x) for k, x in v.items())
    if isinstance(hint, type) and (dataclasses.is_dataclass(hint) or typing.is_typeddict(hint)):
        tests, required = {key: test for key, (test, _) in _fields(hint).items()}, _required(hint)
        more = typing.is_typeddict(hint)
        return lambda v: (
            isinstance(v, dict)
            and required <= set(v)
            and all(tests[k](x) if k in tests else more for k, x in v.items())
        )
    return _PLAIN[hint]


_PLAIN: dict[object, Callable[[Json], bool]] = {
    types.NoneType: lambda v: v is None,
    None: lambda v: v is None,
    Any: lambda v: True,
    object: lambda v: True,
    str: lambda v: isinstance(v, str),
    bool: lambda v: isinstance(v, bool),
    int: lambda v: type(v) is int and _number(v),
    float: _number,
}


def _expected(hint: object) -> str:
    """An annotation in words, for messages."""
    parts = typing.get_args(hint)
    for part in reversed(parts):
        if isinstance(part, Fit):
            return f"expected {part.expected}"
        if isinstance(part, Known):
            return f"known are {' '.join(part.names())}"
    if typing.get_origin(hint) is Literal:
        return f"expected {' '.join(parts)}"
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return " or ".join([_expected(parts[0]), *(_expected(part).removeprefix("expected ") for part in parts[1:])])
    if dataclasses.is_dataclass(hint):
        return "expected an object"
    words = {str: "text", bool: "true or false", int: "a number", float: "a number", types.NoneType: "null"}
    return f"expected {words.get(hint, 'values of other types')}"  # type: ignore[call-overload]


@functools.cache
def _fields(kind: type) -> dict[str, tuple[Callable[[Json], bool], str]]:
    """Fields of a dataclass or a typed dictionary: what tests a value, and its description in messages."""
    hints = typing.get_type_hints(kind, include_extras=True)
    return {key: (tester(hint), _expected(hint)) for key, hint in hints.items()}


@functools.cache
def _required(kind: type) -> frozenset[str]:
    if typing.is_typeddict(kind):
        required: frozenset[str] = kind.__required_keys__  # type: ignore[attr-defined]  # of a typed dictionary
        return required
    free = (dataclasses.MISSING, dataclasses.MISSING)
    return frozenset(f.name for f in dataclasses.fields(kind) if (f.default, f.default_factory) == free)


def fit(where: str, values: Mapping[str, Json], kind: type) -> None:
    """Hold stored values to the fields of a dataclass or of a typed dictionary.

    Its annotations may hold `Fit` and `Known`; values of other names are not checked. Messages begin with `where`.

    Raises:
        InputError: One is absent or unfit.
    """
    required = _required(kind)
    for key, (test, expected) in _fields(kind).items():
        if key not in values:
            if key in required:
                raise InputError(f"{where}: {key} is missing, {expected}")
        elif not test(values[key]):
            raise InputError(f"{where}: {key} is {shown(values[key])}, {expected}")


def loaded[T](where: str, values: Mapping[str, Json], kind: type[T]) -> T:
    """A dataclass of stored values, which `fit` holds to its fields; keys that it does not have are left out.

    Raises:
        InputError: One is absent or unfit.
    """
    fit(where, values, kind)
    record: T = _made(kind, values)
    return record


def _made(kind: type, values: Mapping[str, Json]) -> Json:
    """A dataclass of values that fit it."""
    makers = _makers(kind)
    given = {key: value for key, value in values.items() if key in makers}
    return kind(**{key: value if (make := makers[key]) is None else make(value) for key, value in given.items()})


@functools.cache
def _makers(kind: type) -> dict[str, Callable[[Json], object] | None]:
    """Fields of a dataclass: what makes the value of a stored one; None where both are the same."""
    return {key: _maker(hint) for key, hint in typing.get_type_hints(kind).items()}


def _maker(hint: object) -> Callable[[Json], object] | None:
    """Maker of tuples and records from what JSON has."""
    origin, parts = typing.get_origin(hint), typing.get_args(hint)
    if isinstance(hint, typing.TypeAliasType):
        return _maker(hint.__value__)
    if origin in (types.UnionType, typing.Union):
        make = next(filter(None, map(_maker, parts)), None)
        return None if make is None else lambda v: None if v is None else make(v)
    if origin is tuple:
        each = _maker(parts[0])
        return tuple if each is None else lambda v: tuple(map(each, v))
    if origin in (dict, collections.abc.Mapping):
        value = _maker(parts[1])
        return None if value is None else lambda v: {key: value(one) for key, one in v.items()}
    return functools.partial(_made, hint) if isinstance(hint, type) and dataclasses.is_dataclass(hint) else None


def shown(value: Json) -> str:
    """A stored value for a message."""
    return plain_text(json.dumps(value, ensure_ascii=True, default=str), 60)


def check_types(where: str, values: Mapping[str, Json], kind: type) -> JsonObject:
    """Values of a dataclass that were stored as JSON; arrays become tuples, texts are printable.

    Raises:
        InputError: An unknown field, or a value of another type.
    """
    hints = typing.get_type_hints(kind)
    found = {}
    for key, value in values.items():
        if key not in hints:
            raise InputError(f"{where}: {plain_text(key, 60)} is not an option, known are {' '.join(hints)}")
        texts = [part for part in (value if isinstance(value, list) else [value]) if isinstance(part, str)]
        if not _fields(kind)[key][0](value) or not all(len(t) < MAX_TEXT and is_printable(t) for t in texts):
            hint = hints[key]
            name = hint.__name__ if type(hint) is type else str(hint).replace("typing.", "")
            raise InputError(f"{where}: {key} is {shown(value)}, expected {name}")
        found[key] = tuple(value) if isinstance(value, list) else value
    return found
