"""Follow everything that a USD layer names, file by file, before anything is composed.

USD opens what a layer names while it composes, a named pipe included, and composes on when that fails. So every path is
checked first: only regular files of the right kind are opened, none larger than `limits` says, and the prims that
references would make are counted.
"""

import io
import os
import posixpath
import re
import stat
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from PIL import Image
from pxr import Ar, Gf, Sdf, Tf

import arena_newton
from arena_newton.errors import InputError
from arena_newton.files import limits, sandboxed_load
from arena_newton.usd_scenes.counting import Arc, Contents, count_prims

__all__ = ["LAYERS", "PACKAGE", "Dependencies", "Problem", "check_files", "collect", "layers", "probe_layers", "reason"]
__all__ += ["search_context", "stamp"]

LAYERS = (".usda", ".usd", ".usdc", ".usdz")
"""File types of a sublayer, reference or payload."""
IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tga")
"""File types that an asset attribute (a texture) may name; Newton reads textures with Pillow."""
PACKAGE = "arena_newton/usd_scenes/"
"""Prefix of an asset path that names a scene of this package, wherever the naming file is stored."""
_ROOT = Path(arena_newton.__file__).resolve().parent.parent
"""Folder in which `PACKAGE` is searched: the checkout, or an installation's `site-packages`."""
_CRATE = b"PXR-USDC"
_FORMATS = ("PNG", "JPEG", "BMP", "TGA")
_SHADER = ("inputs:", "outputs:")
_SCHEME = re.compile(r"^[A-Za-z][A-Za-z0-9+.-]+:")
_DRIVE = re.compile(r"^[A-Za-z]:")
_PACKAGED = re.compile(r"^(.*\.usdz)\[([^\[\]]+)\]$", re.IGNORECASE)
_ERROR_AT = re.compile(r"Error in '.*?' at line \d+ in file \S+ : '(.*?)'?\s*$", re.DOTALL)
_KINDS = ((stat.S_ISDIR, "a directory"), (stat.S_ISFIFO, "a named pipe"), (stat.S_ISSOCK, "a socket"))
_RULE = re.compile(r"parse error matching pxr.* at (?=')", re.DOTALL)
"""The parser names a template of its grammar where it has no better words."""


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
    """The fault, and the expected value."""

    def __str__(self) -> str:
        """One line: file, prim, message."""
        return f"{self.file}: {self.prim + ': ' if self.prim else ''}{self.message}"


@dataclass(frozen=True)
class Location:
    """A layer or image: a file, or an entry of a .usdz package."""

    file: Path
    """Absolute and normalised by its text, as USD does it; symbolic links stay."""
    entry: str = ""
    """Name within the package."""

    def __str__(self) -> str:
        """Location in USD's own notation."""
        return f"{self.file}[{self.entry}]" if self.entry else str(self.file)


@dataclass
class Dependencies:
    """Result of following every asset path of a layer."""

    files: list[Path] = field(default_factory=list)
    """Every file reached, layers and images, the first layer first."""
    problems: list[Problem] = field(default_factory=list)
    fatal: bool = False
    """A file cannot be read or a number is not finite: the stage must not be composed."""
    pixels: int = 0
    """Pixels of all images."""


def layers(path: str | Path) -> list[Path]:
    """Every local file that a scene consists of: its layers and the images they name, the layer at `path` first.

    These are the files that `validate` followed, and a stage without problems is composed from no others, so the
    hash of a scene must cover exactly these. Paths are absolute; a .usdz package is one file.

    Raises:
        InputError: A file that the scene needs is missing, no regular file or unreadable, or a number is not finite.
    """
    found = collect(Path(path))
    if found.fatal:
        raise InputError(str(found.problems[0]))
    return found.files


def check_files(path: str | Path) -> None:
    """Raise if any file that the layer at `path` needs is missing or unreadable; prims are not checked.

    Raises:
        InputError: One line that names the file and its first fault.
    """
    layers(path)


def collect(path: Path) -> Dependencies:
    """Follow sublayers, references, payloads and asset values through the files, without composing anything."""
    found = Dependencies()
    start = Location(Path(os.path.abspath(path)))
    message = _file_fault(start.file) or _suffix_fault(str(path), LAYERS)
    if message:
        found.problems.append(Problem(str(path), "", message))
        found.fatal = True
        return found
    queue, seen = [start], {start}
    graph: dict[Location, Contents] = {}
    while queue:
        location = named_as = queue.pop(0)
        shown = str(path) if location == start else str(location)
        if location.file not in found.files:
            found.files.append(location.file)
        try:
            if len(seen) > limits.LAYERS:
                raise _Unreadable(f"the scene consists of more than {limits.LAYERS} files")
            if location.file.suffix.lower() == ".usdz" and not location.entry:
                location = Location(location.file, _entries(location.file)[0])
            if str(location).rstrip("]").lower().endswith(IMAGES):
                found.pixels += _read_image(location, limits.SCENE_PIXELS - found.pixels)
                continue
            contents = _read_layer(location, shown, found, built_on=shown != str(path))
        except _Unreadable as error:
            found.problems.append(Problem(shown, "", str(error)))
            found.fatal = True
            if len(seen) > limits.LAYERS:
                break
            continue
        graph[named_as] = contents
        for named in (*contents.arcs, *contents.sublayers, *contents.images):
            if not named.asset:
                continue
            target = _locate(named.asset, location, IMAGES if named in contents.images else LAYERS)
            if isinstance(target, str):
                found.problems.append(Problem(shown, named.prim, target))
                found.fatal = True
                continue
            named.location = target
            if target not in seen:
                seen.add(target)
                queue.append(target)
    if not found.fatal:
        fault = count_prims(graph, start)
        if fault:
            found.problems.append(Problem(str(path), *fault))
            found.fatal = True
    return found


def search_context() -> Ar.DefaultResolverContext:
    """Resolver context with which USD finds asset paths that begin with `PACKAGE`."""
    return Ar.DefaultResolverContext([str(_ROOT)])


def _read_layer(location: Location, shown: str, found: Dependencies, *, built_on: bool) -> Contents:
    """Contents of a layer; faults of its units and numbers go to `found`."""
    known = _known_as(location)
    if known in _OWN_CONTENTS:
        return _OWN_CONTENTS[known]
    _check_layer(location)
    try:
        layer = Sdf.Layer.FindOrOpen(str(location))
        if layer is None:
            raise _Unreadable("not a readable USD layer")
        units = list(_units(layer, shown)) if built_on else []
        contents, faults = _contents(layer)
    except (Tf.ErrorException, UnicodeDecodeError, RuntimeError, MemoryError) as error:
        raise _Unreadable(f"not a readable USD layer: {_plain(reason(error), location)}") from None
    if faults:
        found.fatal = True
    found.problems += [*units, *(Problem(shown, where, message) for where, message in faults)]
    if built_on and not (units or faults) and location.file.resolve().is_relative_to((_ROOT / PACKAGE).resolve()):
        _OWN_CONTENTS[known] = contents
    return contents


def _plain(text: str, location: Location) -> str:
    return text.replace(f"<{location}>", location.file.name).replace(str(location), location.file.name)


def _check_layer(location: Location) -> None:
    """Refuse what USD would take too much memory or time to read."""
    data = _read(location, max(limits.TEXT_BYTES, limits.CRATE_BYTES))
    if data.startswith(_CRATE):
        if len(data) > limits.CRATE_BYTES:
            raise _Unreadable(_too_large(len(data), limits.CRATE_BYTES))
        fault = _crate_fault(location)
        if fault:
            raise _Unreadable(f"not a readable USD layer: {_plain(reason(ValueError(fault)), location)}")
        return
    if len(data) > limits.TEXT_BYTES:
        raise _Unreadable(_too_large(len(data), limits.TEXT_BYTES))
    lines = sum(data.count(mark) for mark in (b"\n", b"\r", b";", b"{"))
    if lines > limits.TEXT_LINES:
        raise _Unreadable(f"has {lines} lines and more, expected at most {limits.TEXT_LINES} in a text layer")
    numbers = data.count(b",")
    if numbers > limits.TEXT_NUMBERS:
        raise _Unreadable(
            f"has {numbers} commas, expected at most {limits.TEXT_NUMBERS} in a text layer; large meshes fit .usdc"
        )


def _too_large(size: int, most: int) -> str:
    return f"has {size / limits.MIB:.0f} MiB, expected at most {most // limits.MIB}"


_CRATE_FAULTS: dict[tuple[str, int, int, int], str | None] = {}
"""Faults found in binary layers, by name, file, size and time: a scene is walked more than once."""
_OWN_CONTENTS: dict[tuple[str, int, int, int], Contents] = {}
"""Sound layers of this package that others build on, likewise."""


def _known_as(location: Location) -> tuple[str, int, int, int]:
    return str(location), *stamp(location.file)


def stamp(file: Path) -> tuple[int, int, int]:
    """Inode, size [byte] and time of a file, by which the same one is known again."""
    about = os.stat(file)
    return about.st_ino, about.st_size, about.st_mtime_ns


def _crate_fault(location: Location) -> str | None:
    key = _known_as(location)
    if key not in _CRATE_FAULTS:
        _probe([location])
    return _CRATE_FAULTS[key]


def _probe(locations: list[Location]) -> None:
    names = [str(location) for location in locations]
    faults = sandboxed_load.faults("crate", names, memory=limits.CRATE_MEMORY, seconds=limits.CRATE_SECONDS)
    _CRATE_FAULTS.update({_known_as(location): fault for location, fault in zip(locations, faults, strict=True)})


def probe_layers(paths: Sequence[Path]) -> None:
    """Try many binary layers in one process of their own; `collect` then reuses what it found."""
    _probe([Location(Path(os.path.abspath(path))) for path in paths])


def _read(location: Location, most: int) -> bytes | bytearray:
    """The bytes of a file or of a package's entry."""
    if location.entry:
        package = _open_package(location.file)
        size = package.GetFileInfo(location.entry).size
    else:
        size = os.stat(location.file).st_size
    if size > most:
        raise _Unreadable(_too_large(size, most))
    try:
        return package.GetFile(location.entry) if location.entry else location.file.read_bytes()
    except OSError as error:
        raise _Unreadable(f"cannot be read ({error.strerror})") from None


def _read_image(location: Location, pixels: int) -> int:
    """Read an image of at most so many pixels, and count them."""
    data = _read(location, limits.IMAGE_BYTES)
    try:
        with warnings.catch_warnings():
            # Pillow warns of large images; here they are refused by name.
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(io.BytesIO(data), formats=_FORMATS) as image:
                width, height = image.size
                if width * height > min(pixels, limits.IMAGE_PIXELS):
                    most = limits.IMAGE_PIXELS if width * height > limits.IMAGE_PIXELS else limits.SCENE_PIXELS
                    whose = "an image" if most == limits.IMAGE_PIXELS else "all images of a scene together"
                    raise _Unreadable(f"has {width} x {height} pixels, expected at most {most} for {whose}")
                image.load()
                return width * height
    except _Unreadable:
        raise
    except Image.DecompressionBombError:
        raise _Unreadable(f"has too many pixels, expected at most {limits.IMAGE_PIXELS} for an image") from None
    except Exception:  # a damaged image raises nearly anything
        raise _Unreadable(f"not a readable image: expected one of {', '.join(IMAGES)}") from None


def _open_package(file: Path) -> Sdf.ZipFile:
    """A .usdz package as USD reads it."""
    try:
        package = Sdf.ZipFile.Open(str(file))
        names = package.GetFileNames() if package else []
    except (Tf.ErrorException, UnicodeDecodeError, RuntimeError, MemoryError):
        names = []
    if not names or not names[0].lower().endswith(LAYERS[:3]):
        raise _Unreadable("not a readable USD layer: expected a package whose first entry is a layer")
    if len(names) > limits.ARCHIVE_MEMBERS:
        raise _Unreadable(f"holds {len(names)} entries, expected at most {limits.ARCHIVE_MEMBERS}")
    for name in names:
        entry = package.GetFileInfo(name)
        if entry.compressionMethod or entry.encrypted or entry.size != entry.uncompressedSize:
            raise _Unreadable(f"entry {_printable(name)} is compressed or encrypted: expected stored entries")
    return package


def _entries(package: Path) -> list[str]:
    """Names in a .usdz package; the first is its root layer."""
    return list(_open_package(package).GetFileNames())


def _locate(asset: str, at: Location, kinds: tuple[str, ...]) -> Location | str:
    """The location that an asset path means, or what is wrong with it."""
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
        # USD searches next to the naming entry first, then at the top of the package.
        names = _entries(at.file)
        choices = (posixpath.normpath(posixpath.join(posixpath.dirname(at.entry), asset)), posixpath.normpath(asset))
        inside = next((name for name in choices if name in names), None)
        if inside is None or inside.lower().endswith(".usdz"):
            return f"asset @{asset}@ does not exist: expected it in {at.file}"
        return unfit or Location(at.file, inside)
    target = Path(os.path.abspath(at.file.parent / outer))
    message = _file_fault(target)
    if message == "no such file" and outer.startswith(PACKAGE) and ".." not in outer.split("/"):
        # As USD does it with `search_context`: next to the naming file first, then among the package's own scenes.
        target = Path(os.path.abspath(_ROOT / outer))
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
    return Location(target, entry)


def _file_fault(path: Path) -> str | None:
    """Reason for which USD must not open a path; symbolic links are followed, nothing is opened."""
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


def _contents(layer: Sdf.Layer) -> tuple[Contents, list[tuple[str, str]]]:
    """Every prim and asset path of a layer, and what must not be in it, as (where, message)."""
    contents = Contents(layer.defaultPrim, sublayers=[Arc("", asset) for asset in layer.subLayerPaths if asset])
    faults: list[tuple[str, str]] = []
    if layer.pseudoRoot.HasInfo("relocates"):
        faults.append(("", "has relocates: expected plain prims"))

    deep: list[Sdf.Path] = []

    def visit(path: Sdf.Path) -> None:
        # Asked before anything else is: text of a path takes as long as the path is deep.
        if path.pathElementCount > 2 * limits.NESTING:
            deep[:] = [path]
            return
        spec = layer.GetObjectAtPath(path)
        if isinstance(spec, Sdf.VariantSpec):
            spec = spec.primSpec
        where = str(path.StripAllVariantSelections())
        if isinstance(spec, Sdf.PrimSpec) and not path.IsAbsoluteRootPath():
            contents.prims.append(where)
            if where.count("/") > limits.NESTING:
                deep[:] = [path]
            for arcs in (spec.referenceList, spec.payloadList):
                found = arcs.GetAddedOrExplicitItems()
                contents.arcs += [Arc(where, item.assetPath, str(item.primPath)) for item in found]
            for paths in (spec.inheritPathList, spec.specializesList):
                for target in paths.GetAddedOrExplicitItems():
                    contents.arcs.append(Arc(where, "", str(target), of_class=True))
                    if not target.IsRootPrimPath():
                        faults.append((where, f"inherits <{target}>: expected a class at the root of the layer"))
            if spec.HasInfo("clips"):
                faults.append((where, "has value clips: expected plain values"))
            if spec.HasInfo("relocates"):
                faults.append((where, "has relocates: expected plain prims"))
        elif isinstance(spec, Sdf.AttributeSpec):
            values = [spec.default, *(layer.QueryTimeSample(path, t) for t in layer.ListTimeSamplesForPath(path))]
            if _names_file(spec):
                faults.append((where, f"is a {spec.typeName} that names a file: expected an asset (@...@)"))
            if spec.HasSpline():
                faults.append((where, "has a spline: expected a plain value"))
            for value in values:
                contents.images += [Arc(where, asset) for asset in _assets_in(value) if asset]
                bad = _not_finite(value)
                if bad is not None:
                    faults.append((where, f"holds {bad:g}: expected finite numbers (single precision)"))
                    break

    layer.Traverse(Sdf.Path.absoluteRootPath, visit)
    if deep:
        raise _Unreadable(f"{_printable(deep[0].name)}: prims are nested deeper than {limits.NESTING}")
    return contents, list(dict.fromkeys(faults))


def _names_file(spec: Sdf.AttributeSpec) -> bool:
    """True if a string is used where a shader expects a texture; the importer would open it, URLs too, unchecked."""
    if str(spec.typeName).removesuffix("[]") not in ("string", "token") or not spec.name.startswith(_SHADER):
        return False
    value = spec.default
    texts = [value] if isinstance(value, str) else list(value or ())
    return any("/" in text or "\\" in text or "." in text for text in texts) or any(map(_SCHEME.match, texts))


def _not_finite(value: object) -> float | None:
    """The first component that is not a finite single-precision number; None if all are or there is none."""
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
    if isinstance(value, Sdf.AssetPath):
        yield value.path
    elif isinstance(value, Sdf.AssetPathArray):
        yield from (item.path for item in value)


def _units(layer: Sdf.Layer, shown: str) -> Iterator[Problem]:
    """A layer that is built on must not have other units: USD does not convert them."""
    info = layer.pseudoRoot
    for key, wanted in (("metersPerUnit", 1.0), ("upAxis", "Z"), ("kilogramsPerUnit", 1.0)):
        if info.HasInfo(key) and info.GetInfo(key) != wanted:
            yield Problem(shown, "", f"{key} is {info.GetInfo(key)}: expected {wanted} (USD does not convert units)")


def reason(error: Exception) -> str:
    """USD's complaint on one printable line, without the line of USD's own source."""
    try:
        text = str(error)
    except UnicodeDecodeError as bytes_error:
        # The complaint quotes the file, which is not UTF-8.
        text = bytes_error.object.decode("utf-8", "backslashreplace")
    inner = _ERROR_AT.search(text)
    text = _RULE.sub("not understood: ", inner.group(1) if inner else text)
    lines = (line.strip() for line in text.splitlines())
    return _printable(next((line for line in lines if line), "unknown error"))[:300]


def _printable(text: str) -> str:
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)
