"""Small files that would take much memory or time are refused before USD or Pillow reads them."""

import resource
import struct
import time
import zipfile
import zlib
from pathlib import Path

import pytest
from PIL import Image
from pxr import Sdf, Usd

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.usd_scenes.validate import check_files, layers, validate

HEAD = '#usda 1.0\n(\n    defaultPrim = "A"\n)\n'


def refused(path: Path, *words: str, seconds: float = 200.0) -> None:
    """One line with these words, soon and without much memory."""
    before, start = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, time.monotonic()
    with pytest.raises(InputError) as caught:
        check_files(path)
    assert time.monotonic() - start < seconds
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000
    assert "\n" not in str(caught.value)
    for word in words:
        assert word in str(caught.value), str(caught.value)
    assert [str(problem) for problem in validate(path, "football")][0] == str(caught.value)


def prim(name: str, *arcs: str, kind: str = "references") -> str:
    return f'def "{name}" ({kind} = [{", ".join(arcs)}])\n{{\n}}\n'


@pytest.mark.parametrize("kind", ["references", "payload"])
def test_references_that_double(tmp_path, kind):
    """Thirty layers that refer to the next twice would make 2^30 prims: refused by count, nothing is composed."""
    for number in range(30):
        inner = prim("x", f"@{number + 1}.usda@", kind=kind) + prim("y", f"@{number + 1}.usda@", kind=kind)
        (tmp_path / f"{number}.usda").write_text(HEAD + f'def "A"\n{{\n{inner if number < 29 else ""}}}\n')
    refused(tmp_path / "0.usda", "more than 50000 prims")


def test_references_on_one_prim_that_double(tmp_path):
    """The same with all references on a single prim, and within one layer."""
    body = "".join(prim(f"A{n}", f"</A{n + 1}>", f"</B{n + 1}>") + prim(f"B{n}", f"</A{n + 1}>") for n in range(60))
    (tmp_path / "one.usda").write_text(HEAD + body + 'def "A60"\n{\n}\ndef "B60"\n{\n}\n')
    refused(tmp_path / "one.usda", "more than 50000 prims")


def test_variants_are_counted(tmp_path):
    """References inside variants that are not selected count too."""
    for number in range(20):
        names = "".join(f'"v{k}" ( references = @{number + 1}.usda@ )\n{{\n}}\n' for k in range(2))
        inner = f'def "x" ( prepend variantSets = "s" )\n{{\nvariantSet "s" = {{\n{names}}}\n}}\n'
        (tmp_path / f"{number}.usda").write_text(HEAD + f'def "A"\n{{\n{inner if number < 19 else ""}}}\n')
    refused(tmp_path / "0.usda", "more than 50000 prims")


def test_classes_that_double(tmp_path):
    """Classes that inherit the next one twice are counted; a class inside another prim is refused."""
    both = 'def "x" (inherits = </_c{0}>)\n{{\n}}\ndef "y" (inherits = </_c{0}>)\n{{\n}}\n'
    body = "".join(f'class "_c{n}"\n{{\n{both.format(n + 1)}}}\n' for n in range(30))
    (tmp_path / "class.usda").write_text(HEAD + body + 'class "_c30"\n{\n}\n' + prim("A", "</_c0>", kind="inherits"))
    refused(tmp_path / "class.usda", "more than 50000 prims")
    inner = HEAD + 'def "A"\n{\nclass "c"\n{\n}\n' + prim("x", "</A/c>", kind="inherits") + "}\n"
    (tmp_path / "inner.usda").write_text(inner)
    refused(tmp_path / "inner.usda", "/A/x: inherits </A/c>: expected a class at the root")


def test_sublayers_that_double(tmp_path):
    """Sublayers of sublayers are counted as often as USD would read them."""
    for number in range(30):
        names = f"    subLayers = [@{number + 1}.usda@, @./{number + 1}.usda@]\n" if number < 29 else ""
        (tmp_path / f"{number}.usda").write_text(HEAD.replace(")\n", names + ")\n"))
    refused(tmp_path / "0.usda", "sublayers lead to more than 256")


def test_chains_and_depth(tmp_path):
    """Prims that are nested 20,000 deep, and chains of 1,000 references, are refused at once."""
    (tmp_path / "deep.usda").write_text(HEAD + 'def "a"\n{\n' * 20_000 + "}\n" * 20_000)
    refused(tmp_path / "deep.usda", "nested deeper than 100")
    chain = "".join(prim(f"a{n}", f"</a{n + 1}>") for n in range(1000)) + 'def "a1000"\n{\n}\n'
    (tmp_path / "chain.usda").write_text(HEAD + chain)
    refused(tmp_path / "chain.usda", "more than 100 prims")


def test_the_count_is_that_of_usd(tmp_path, monkeypatch):
    """Without classes and variants as many prims are counted as USD composes; sharing a layer is no fault."""
    (tmp_path / "leaf.usda").write_text(HEAD + 'def "A"\n{\ndef "b"\n{\n}\ndef "c"\n{\n}\n}\n')
    text = HEAD + 'def "A"\n{\n' + "".join(prim(f"x{n}", "@leaf.usda@") for n in range(9)) + "}\n"
    (tmp_path / "top.usda").write_text(text)
    stage = Usd.Stage.Open(str(tmp_path / "top.usda"))
    composed = len(list(stage.TraverseAll()))
    assert composed == 1 + 9 * 3
    # A prim that refers to another is counted with it: one more for each reference.
    monkeypatch.setattr(limits, "PRIMS", composed + 9)
    check_files(tmp_path / "top.usda")
    monkeypatch.setattr(limits, "PRIMS", composed + 8)
    refused(tmp_path / "top.usda", "has more than 36 prims")


def test_text_layers_are_measured(tmp_path):
    """Lines and lists of a text layer are counted before USD parses it."""
    (tmp_path / "lines.usda").write_text(HEAD + "\n" * 500_001)
    refused(tmp_path / "lines.usda", "lines and more, expected at most 500000")
    (tmp_path / "list.usda").write_text(HEAD + 'def "A"\n{\nint[] x = [' + "0," * 4_000_001 + "0]\n}\n")
    refused(tmp_path / "list.usda", "4000001 commas", "large meshes fit .usdc")
    (tmp_path / "text.usda").write_bytes(HEAD.encode() + b"#" + b"x" * (65 * 2**20))
    refused(tmp_path / "text.usda", "has 65 MiB, expected at most 64")


def test_too_many_files(tmp_path):
    """A scene of more files than a scene has is refused."""
    for number in range(limits.LAYERS + 5):
        (tmp_path / f"r{number}.usda").write_text(HEAD + 'def "A"\n{\n}\n')
    body = "".join(prim(f"x{n}", f"@r{n}.usda@") for n in range(limits.LAYERS + 5))
    (tmp_path / "top.usda").write_text(HEAD + body)
    refused(tmp_path / "top.usda", f"more than {limits.LAYERS} files")


def damaged_crate(folder: Path) -> Path:
    """A binary layer whose section of fields asks for 2^40 bytes."""
    path = folder / "bad.usdc"
    layer = Sdf.Layer.CreateNew(str(path))
    Sdf.CreatePrimInLayer(layer, "/A")
    layer.Save()
    del layer
    data = bytearray(path.read_bytes())
    (table,) = struct.unpack_from("<Q", data, 16)
    for number in range(struct.unpack_from("<Q", data, table)[0]):
        entry = table + 8 + 32 * number
        if data[entry : entry + 16].rstrip(b"\0") == b"FIELDS":
            (start,) = struct.unpack_from("<Q", data, entry + 16)
            struct.pack_into("<Q", data, start, 2**40)
    path.write_bytes(data)
    return path


def test_binary_layers_are_probed(tmp_path, monkeypatch):
    """A damaged binary layer is opened by another process first, so that neither its memory nor its crash is ours."""
    path = damaged_crate(tmp_path)
    refused(path, "not a readable USD layer")
    (tmp_path / "top.usda").write_text(HEAD + prim("A", "@bad.usdc@</A>"))
    refused(tmp_path / "top.usda", "bad.usdc: not a readable USD layer")
    path.unlink()
    good = tmp_path / "good.usdc"
    Sdf.Layer.FindOrOpen(str(tmp_path / "top.usda")).Export(str(good))
    with pytest.raises(InputError, match="does not exist"):
        layers(good)
    monkeypatch.setattr(limits, "CRATE_BYTES", 10)
    refused(good, "expected at most 0")


def package(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_STORED) -> Path:
    with zipfile.ZipFile(path, "w") as file:
        for number, (name, data) in enumerate(members.items()):
            file.writestr(name, data, zipfile.ZIP_STORED if number == 0 else method)
    return path


def test_packages_hold_stored_entries(tmp_path):
    """A deflated image beside the layer of a package is refused by its header: its gigabytes are never unpacked."""
    root = (HEAD + 'def "A"\n{\nasset inputs:file = @x.png@\n}\n').encode()
    path = package(tmp_path / "bomb.usdz", {"a.usda": root, "x.png": bytes(200 * 2**20)}, zipfile.ZIP_DEFLATED)
    assert path.stat().st_size < 2**20
    refused(path, "entry x.png is compressed")
    (tmp_path / "top.usda").write_text(HEAD + prim("A", "@bomb.usdz@"))
    refused(tmp_path / "top.usda", "bomb.usdz: entry x.png is compressed")
    many = {"a.usda": HEAD.encode()} | {f"{n}.usda": HEAD.encode() for n in range(limits.ARCHIVE_MEMBERS)}
    refused(package(tmp_path / "many.usdz", many), "holds 1001 entries, expected at most 1000")


def png(width: int, height: int) -> bytes:
    """A PNG of these sizes and hardly any bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(b"")) + chunk(b"IEND", b"")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize(("width", "height"), [(13_000, 13_000), (5000, 4000), (100_000, 100_000)])
def test_large_images(tmp_path, width, height):
    """An image is measured by its header, without a warning and before it is decoded."""
    (tmp_path / "x.png").write_bytes(png(width, height))
    (tmp_path / "top.usda").write_text(HEAD + 'def "A"\n{\nasset inputs:file = @x.png@\n}\n')
    refused(tmp_path / "top.usda", "x.png: has ", " pixels, expected at most 16777216 for an image")


def test_images_together(tmp_path, monkeypatch):
    """The images of a scene have so many pixels together, and are of the formats that their names say."""
    for name in "ab":
        Image.new("RGB", (8, 8)).save(tmp_path / f"{name}.png")
    (tmp_path / "top.usda").write_text(HEAD + 'def "A"\n{\nasset[] inputs:files = [@a.png@, @b.png@]\n}\n')
    assert len(layers(tmp_path / "top.usda")) == 3
    monkeypatch.setattr(limits, "SCENE_PIXELS", 100)
    refused(tmp_path / "top.usda", "expected at most 100 for all images of a scene together")
    # Other formats hide behind the name: Pillow would start a PostScript interpreter for this one.
    (tmp_path / "a.png").write_bytes(b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 10 10\n%%EndComments\n")
    refused(tmp_path / "top.usda", "a.png: not a readable image")
