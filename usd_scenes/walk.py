"""Follow everything that a USD layer names, file by file, before anything is composed.

USD opens what a layer names while it composes, a named pipe included, and composes on when that fails. The walk looks
at every path first: only regular files of the right kind are opened.
"""

import io
import os
import posixpath
import re
import stat
import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from arena_newton.errors import InputError

if TYPE_CHECKING:
    from pxr import Sdf

__all__ = ["IMAGES", "LAYERS", "Place", "Problem", "Walk", "check_files", "layers", "reason", "walk"]

LAYERS = (".usda", ".usd", ".usdc", ".usdz")
"""What a sublayer, reference or payload may be."""
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga")
"""What an asset attribute (a texture) may name; Newton reads textures with Pillow."""
_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]+:")
_DRIVE = re.compile(r"^[A-Za-z]:")
_PACKAGED = re.compile(r"^(.*\.usdz)\[([^\[\]]+)\]$", re.IGNORECASE)
_ERROR_AT = re.compile(r"Error in '.*?' at line \d+ in file \S+ : '(.*?)'?\s*$", re.DOTALL)
_KINDS = ((stat.S_ISDIR, "a directory"), (stat.S_ISFIFO, "a named pipe"), (stat.S_ISSOCK, "a socket"))
_RULE = re.compile(r"parse error matching pxr.* at (?=')", re.DOTALL)
"""The parser names a template of its grammar where it has no better words."""
_Named = tuple[str, str, tuple[str, ...]]
"""Where an asset path stands, the path, and the endings it may have."""


class _Unreadable(Exception):
    """A file is not what its name says."""


@dataclass(frozen=True)
class Problem:
    """One thing that is wrong with a layer."""

    file: str
    """The layer that was checked, or the layer in its stack that holds the fault."""
    prim: str
    """Path of the prim, or of the property; empty for a fault of the whole layer."""
    message: str
    """What is wrong and what was expected."""

    def __str__(self) -> str:
        """One line: file, prim, message."""
        return f"{self.file}: {self.prim + ': ' if self.prim else ''}{self.message}"


@dataclass(frozen=True)
class Place:
    """A layer or image: a file, or an entry of a .usdz package."""

    file: Path
    """Absolute and normalised by its text, as USD does it; symbolic links stay."""
    entry: str = ""
    """Name within the package."""

    def __str__(self) -> str:
        """What USD calls it."""
        return f"{self.file}[{self.entry}]" if self.entry else str(self.file)


@dataclass
class Walk:
    """What following every asset path of a layer found."""

    files: list[Path] = field(default_factory=list)
    """Every file reached, layers and images, the first layer first."""
    problems: list[Problem] = field(default_factory=list)
    fatal: bool = False
    """A file cannot be read or a number is not finite: the stage must not be composed."""


def layers(path: str | Path) -> list[Path]:
    """Every local file that a scene consists of: its layers and the images they name, the layer at `path` first.

    These are the files that `validate` followed, and a stage without problems is composed from no others, so whoever
    hashes a scene hashes exactly these. Paths are absolute; a .usdz package is one file.

    Raises:
        InputError: A file that the scene needs is missing, no regular file or unreadable, or a number is not finite.
    """
    found = walk(Path(path))
    _raise_fatal(found)
    return found.files


def check_files(path: str | Path) -> None:
    """Raise if any file that the layer at `path` needs is missing or unreadable; prims are not looked at.

    Raises:
        InputError: One line that names the file and its first fault.
    """
    _raise_fatal(walk(Path(path)))


def _raise_fatal(found: Walk) -> None:
    if found.fatal:
        raise InputError(str(found.problems[0]))


def walk(path: Path) -> Walk:
    """Follow sublayers, references, payloads and asset values through the files, without composing anything."""
    found = Walk()
    start = Place(Path(os.path.abspath(path)))
    message = _file_fault(start.file) or _suffix_fault(str(path), LAYERS)
    if message:
        found.problems.append(Problem(str(path), "", message))
        found.fatal = True
        return found
    queue, seen = [start], {start}
    while queue:
        place = queue.pop(0)
        shown = str(path) if place == start else str(place)
        if place.file not in found.files:
            found.files.append(place.file)
        try:
            if place.file.suffix.lower() == ".usdz" and not place.entry:
                place = Place(place.file, _entries(place.file)[0])
            if str(place).rstrip("]").lower().endswith(IMAGES):
                _read_image(place)
                continue
            named = _read_layer(place, shown, found, built_on=shown != str(path))
        except _Unreadable as error:
            found.problems.append(Problem(shown, "", str(error)))
            found.fatal = True
            continue
        for prim, asset, kinds in named:
            target = _locate(asset, place, kinds)
            if isinstance(target, str):
                found.problems.append(Problem(shown, prim, target))
                found.fatal = True
            elif target not in seen:
                seen.add(target)
                queue.append(target)
    return found


def _read_layer(place: Place, shown: str, found: Walk, *, built_on: bool) -> list[_Named]:
    """What a layer names; faults of its units and numbers go to `found`."""
    from pxr import Sdf, Tf

    try:
        layer = Sdf.Layer.FindOrOpen(str(place))
        if layer is None:
            raise _Unreadable("not a readable USD layer")
        if built_on:
            found.problems += _units(layer, shown)
        named, faults = _contents(layer)
    except (Tf.ErrorException, UnicodeDecodeError, RuntimeError, MemoryError) as error:
        text = reason(error).replace(f"<{place}>", place.file.name).replace(str(place), place.file.name)
        raise _Unreadable(f"not a readable USD layer: {text}") from None
    if faults:
        found.problems += [Problem(shown, where, message) for where, message in faults]
        found.fatal = True
    return named


def _read_image(place: Place) -> None:
    from PIL import Image

    try:
        source: Any = place.file
        if place.entry:
            with zipfile.ZipFile(place.file) as package:
                source = io.BytesIO(package.read(place.entry))
        with Image.open(source) as image:
            image.load()
    except (OSError, SyntaxError, ValueError, zipfile.BadZipFile, Image.DecompressionBombError):
        raise _Unreadable(f"not a readable image: expected one of {', '.join(IMAGES)}") from None


def _entries(package: Path) -> list[str]:
    """Names in a .usdz package; the first is its root layer."""
    try:
        with zipfile.ZipFile(package) as file:
            names = file.namelist()
    except (OSError, ValueError, zipfile.BadZipFile):
        names = []
    if not names or not names[0].lower().endswith(LAYERS[:3]):
        raise _Unreadable("not a readable USD layer: expected a package whose first entry is a layer")
    return names


def _locate(asset: str, at: Place, kinds: tuple[str, ...]) -> Place | str:
    """The place that an asset path means, or what is wrong with it."""
    if asset.startswith("`"):
        return f"asset path expression @{asset}@: expected a plain relative path"
    if asset.startswith(("/", "\\")) or _DRIVE.match(asset):
        return f"absolute asset path @{asset}@: expected a path relative to the layer"
    if _SCHEME.match(asset):
        return f"remote asset path @{asset}@: expected a file next to the layer"
    packaged = _PACKAGED.match(asset)
    outer, entry = packaged.groups() if packaged else (asset, "")
    unfit = _suffix_fault(f"asset @{asset}@", kinds, ending=entry or outer)
    if at.entry:
        # USD looks beside the naming entry first, then at the top of the package.
        names = _entries(at.file)
        choices = (posixpath.normpath(posixpath.join(posixpath.dirname(at.entry), asset)), posixpath.normpath(asset))
        inside = next((name for name in choices if name in names), None)
        if inside is None or inside.lower().endswith(".usdz"):
            return f"asset @{asset}@ does not exist: expected it in {at.file}"
        return unfit or Place(at.file, inside)
    target = Path(os.path.abspath(at.file.parent / outer))
    message = _file_fault(target)
    if message:
        lost = f"does not exist: expected {target}" if message == "no such file" else f"{message} ({target})"
        return f"asset @{asset}@ {lost}"
    if unfit:
        return unfit
    if entry:
        try:
            if entry not in _entries(target):
                return f"asset @{asset}@ does not exist: expected {entry} in {target}"
        except _Unreadable as error:
            return f"asset @{asset}@: {error}"
    return Place(target, entry)


def _file_fault(path: Path) -> str | None:
    """Why USD must not open a path; symbolic links are followed, nothing is opened."""
    try:
        mode = os.stat(path).st_mode
    except (FileNotFoundError, NotADirectoryError):
        return "no such file"
    except (OSError, ValueError) as error:
        return f"cannot be read ({getattr(error, 'strerror', None) or error})"
    if not stat.S_ISREG(mode):
        kind = next((word for test, word in _KINDS if test(mode)), "a device")
        return f"is {kind}: expected a regular file"
    return None if os.access(path, os.R_OK) else "cannot be read (no permission)"


def _suffix_fault(name: str, kinds: tuple[str, ...], ending: str | None = None) -> str | None:
    wanted = "a USD layer" if kinds == LAYERS else "an image"
    good = (ending or name).lower().endswith(kinds)
    return None if good else f"{name if ending else 'file'} is not {wanted}: expected one of {', '.join(kinds)}"


def _contents(layer: "Sdf.Layer") -> tuple[list[_Named], list[tuple[str, str]]]:
    """Every asset path a layer names, and every number in it that is not finite, as (where, message)."""
    from pxr import Sdf

    named: list[_Named] = [("", asset, LAYERS) for asset in layer.subLayerPaths]
    faults: list[tuple[str, str]] = []

    def visit(path: "Sdf.Path") -> None:
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.VariantSpec):
            spec = spec.primSpec
        where = str(path.StripAllVariantSelections())
        if isinstance(spec, Sdf.PrimSpec):
            for arcs in (spec.referenceList, spec.payloadList):
                named.extend((where, item.assetPath, LAYERS) for item in arcs.GetAddedOrExplicitItems())
            if spec.HasInfo("clips"):
                faults.append((where, "has value clips: expected plain values"))
        elif isinstance(spec, Sdf.AttributeSpec):
            values = [spec.default, *(layer.QueryTimeSample(path, t) for t in layer.ListTimeSamplesForPath(path))]
            if spec.HasSpline():
                faults.append((where, "has a spline: expected a plain value"))
            for value in values:
                named.extend((where, asset, IMAGES) for asset in _assets_in(value))
                bad = _not_finite(value)
                if bad is not None:
                    faults.append((where, f"holds {bad:g}: expected finite numbers (single precision)"))
                    break

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    return [entry for entry in named if entry[1]], list(dict.fromkeys(faults))


def _not_finite(value: object) -> float | None:
    """The first component that is no finite single-precision number; `None` if all are, or it is not about numbers."""
    from pxr import Gf, Sdf

    if isinstance(value, Gf.Quatf | Gf.Quatd | Gf.Quath):
        value = (value.real, *value.imaginary)
    elif isinstance(value, Sdf.TimeCode):
        value = value.GetValue()
    elif isinstance(value, Sdf.TimeCodeArray):
        value = [code.GetValue() for code in value]
    elif isinstance(value, str | Sdf.AssetPath | Sdf.AssetPathArray | None):
        return None
    numbers = np.asarray(value)
    if numbers.dtype.kind != "f":
        return None
    with np.errstate(over="ignore"):
        bad = ~np.isfinite(numbers.astype(np.float32))
    return float(numbers[bad].flat[0]) if bad.any() else None


def _assets_in(value: object) -> Iterator[str]:
    from pxr import Sdf

    if isinstance(value, Sdf.AssetPath):
        yield value.path
    elif isinstance(value, Sdf.AssetPathArray):
        yield from (item.path for item in value)


def _units(layer: "Sdf.Layer", shown: str) -> Iterator[Problem]:
    """A layer that is built on must not speak other units: USD does not convert them."""
    info = layer.pseudoRoot
    for key, wanted in (("metersPerUnit", 1.0), ("upAxis", "Z"), ("kilogramsPerUnit", 1.0)):
        if info.HasInfo(key) and info.GetInfo(key) != wanted:
            yield Problem(shown, "", f"{key} is {info.GetInfo(key)}: expected {wanted} (USD does not convert units)")


def reason(error: Exception) -> str:
    """What USD complains about, on one printable line, without the place in USD's own source."""
    try:
        text = str(error)
    except UnicodeDecodeError as bytes_error:
        # The complaint quotes the file, which is no UTF-8.
        text = bytes_error.object.decode("utf-8", "backslashreplace")
    inner = _ERROR_AT.search(text)
    text = _RULE.sub("not understood: ", inner.group(1) if inner else text)
    lines = (line.strip() for line in text.splitlines())
    line = next((line for line in lines if line), "unknown error")
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in line)[:300]
