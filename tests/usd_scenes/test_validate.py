"""The validator names every fault of a user's layer, and the command line answers bad input with code 2."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from PIL import Image
from pxr import Sdf

from arena_newton import tasks
from arena_newton.errors import InputError
from arena_newton.tasks.base import SCENES
from arena_newton.usd_scenes.__main__ import main
from arena_newton.usd_scenes.validate import check, layers, task_of, validate

AUTHORING = Path(__file__).parents[2] / "docs" / "howto" / "bring" / "authoring.md"
SNIPPETS = re.findall(r"^```usda\n(.*?)^```", AUTHORING.read_text(), flags=re.DOTALL | re.MULTILINE)

HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    subLayers = [@{scene}@]
)
"""


BARE = HEAD.replace("    subLayers = [@{scene}@]\n", "")
"""The same without the scene: what must not be composed is found before it is missed."""


def layer(folder: Path, body: str = "", *, task: str = "football", head: str = HEAD) -> Path:
    """A user's layer on top of a task's scene; `body` may be written on one line."""
    path = folder / "my_room.usda"
    body = body.replace("{", "{\n").replace("}", "\n}\n")
    scene = os.path.relpath(SCENES / task / "scene.usda", folder.resolve())
    path.write_text(head.replace("{scene}", scene) + body)
    return path


def texts(path: Path, task: str | None = None) -> list[str]:
    """The problems as printed."""
    return [str(problem) for problem in validate(path, task)]


def only(path: Path, *words: str) -> None:
    """Exactly one problem, whose line holds all `words` and the file's name."""
    found = texts(path)
    assert len(found) == 1, found
    assert "\n" not in found[0]
    for word in (*words, path.name):
        assert word in found[0], found[0]


@pytest.mark.parametrize("task", tasks.OWN)
def test_own_scenes_and_variants_are_sound(task):
    """Every scene and variant of the project passes."""
    files = [SCENES / task / "scene.usda", *(SCENES / task / "variants").glob("*.usda")]
    assert len(files) > 1
    for file in files:
        assert texts(file) == []
        assert task_of(file) == task


def test_a_layer_over_a_scene_is_of_its_task(tmp_path):
    """A user's layer is judged as the task it builds on, wherever it lies."""
    path = layer(tmp_path)
    assert texts(path) == []
    assert task_of(path) == "football"
    check(path)


@pytest.mark.parametrize("task", tasks.OWN)
def test_every_required_prim_is_missed(tmp_path, task):
    """Switching off the required prims is noticed and each is named."""
    path = layer(tmp_path, task=task)
    edited = Sdf.Layer.FindOrOpen(str(path))
    required = [item.path for item in tasks.get(task).requires if not item.variants]
    for prim in required:
        Sdf.CreatePrimInLayer(edited, prim).SetInfo("active", False)
    assert edited.Save()
    found = texts(path)
    for prim in required:
        assert any(f": {prim}: missing" in line for line in found), (prim, found)


def test_missing_ball_is_one_clear_line(tmp_path):
    """A scene without the ball: file, prim, what was expected."""
    path = layer(tmp_path, 'over "World" { over "Ball" (active = false) {} }')
    with pytest.raises(InputError, match=r"my_room\.usda: /World/Ball: missing: expected a rigid body") as caught:
        check(path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("metersPerUnit = 1", "metersPerUnit = 0.01", ("metersPerUnit is 0.01", "expected 1")),
        ("    metersPerUnit = 1\n", "", ("metersPerUnit is missing",)),
        ('upAxis = "Z"', 'upAxis = "Y"', ('upAxis is "Y"',)),
        ("kilogramsPerUnit = 1", "kilogramsPerUnit = 0.001", ("kilogramsPerUnit is 0.001",)),
        ('defaultPrim = "World"', 'defaultPrim = "Room"', ("/World", "defaultPrim")),
    ],
)
def test_wrong_units_are_named(tmp_path, old, new, words):
    """Centimetres, y up, grams and another default prim are refused."""
    only(layer(tmp_path, head=HEAD.replace(old, new)), *words)


def test_units_of_a_layer_built_on_are_checked(tmp_path):
    """A referenced room in centimetres is refused, since USD does not convert it."""
    (tmp_path / "room.usda").write_text(
        '#usda 1.0\n(\n metersPerUnit = 0.01\n defaultPrim = "R"\n)\ndef Xform "R" {\n}\n'
    )
    path = layer(tmp_path, 'over "World" { def Xform "Room" (references = @./room.usda@) {} }')
    assert len(texts(path)) == 1
    assert "room.usda" in texts(path)[0] and "metersPerUnit is 0.01" in texts(path)[0]


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ("", ("without PhysicsMassAPI",)),
        ("float physics:mass = 0", ("physics:mass is 0",)),
        ("float3 physics:diagonalInertia = (0, 1, 1)", ("physics:diagonalInertia",)),
    ],
)
def test_missing_mass_and_inertia_are_named(tmp_path, line, words):
    """A rigid body without mass, or with none of its inertia, is refused."""
    schemas = '"PhysicsRigidBodyAPI", "PhysicsMassAPI"' if line else '"PhysicsRigidBodyAPI"'
    full = {
        "mass": "float physics:mass = 1",
        "diagonalInertia": "float3 physics:diagonalInertia = (1, 1, 1)",
        "centerOfMass": "point3f physics:centerOfMass = (0, 0, 0)",
        "principalAxes": "quatf physics:principalAxes = (1, 0, 0, 0)",
    }
    rows = [line if line and key in line else text for key, text in full.items()] if line else []
    only(
        layer(
            tmp_path,
            'over "World" { def Xform "Chair" (prepend apiSchemas = [' + schemas + "]) {\n" + "\n".join(rows) + "\n} }",
        ),
        "/World/Chair",
        *words,
    )


def test_centre_of_mass_and_axes_are_required(tmp_path):
    """Mass and inertia alone leave the importer guessing: both other values are asked for."""
    path = layer(
        tmp_path,
        'over "World" { def Xform "Chair" (prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]) {\n'
        "float physics:mass = 1\nfloat3 physics:diagonalInertia = (1, 1, 1)\n} }",
    )
    found = texts(path)
    assert len(found) == 2
    assert "physics:centerOfMass" in found[0] and "physics:principalAxes" in found[1]


@pytest.mark.parametrize(
    ("asset", "word"),
    [
        ("http://example.org/room.usd", "remote"),
        ("https://example.org/room.usd", "remote"),
        ("omniverse://localhost/room.usd", "remote"),
        ("file:///srv/room.usd", "remote"),
        ("/srv/rooms/room.usd", "absolute"),
        ("C:\\rooms\\room.usd", "absolute"),
        ("C:/rooms/room.usd", "absolute"),
        ("./no_such_room.usd", "does not exist"),
    ],
)
@pytest.mark.parametrize("arc", ["references", "payload", "subLayers", "texture", "variant"])
def test_foreign_asset_paths_are_named_wherever_they_stand(tmp_path, asset, word, arc):
    """Remote, absolute and missing paths are refused in references, payloads, sublayers, attributes and variants."""
    head, prim = BARE, "/World/Room"
    if arc in ("references", "payload"):
        body = f'over "World" {{ def Xform "Room" ({arc} = @{asset}@) {{}} }}'
    elif arc == "texture":
        body = f'over "World" {{ def Xform "Room" {{ asset inputs:file = @{asset}@ }} }}'
        prim = "/World/Room.inputs:file"
    elif arc == "variant":
        body = (
            'over "World" { def Xform "Room" (variantSets = "look") {\n'
            f'variantSet "look" = {{ "far" (references = @{asset}@) {{}} }}\n}} }}'
        )
    else:
        head, body, prim = HEAD.replace("{scene}", asset), "", "my_room.usda"
    only(layer(tmp_path, body, head=head), asset, word, prim)


def test_faults_in_a_layer_below_are_found(tmp_path):
    """A remote texture two layers down is reported with the layer that holds it."""
    (tmp_path / "room.usda").write_text(
        '#usda 1.0\n(\n defaultPrim = "R"\n)\ndef Xform "R" {\n asset inputs:file = @http://example.org/a.png@\n}\n'
    )
    (tmp_path / "deep.usda").write_text('#usda 1.0\n(\n defaultPrim = "R"\n subLayers = [@./room.usda@]\n)\n')
    found = texts(layer(tmp_path, 'over "World" { def Xform "Room" (references = @./deep.usda@) {} }'))
    assert len(found) == 1
    assert str(tmp_path / "room.usda") in found[0] and "/R.inputs:file" in found[0] and "remote" in found[0]


def test_fault_in_a_variant_names_the_variant(tmp_path):
    """A prim that one semantic variant switches off is missing in that variant."""
    path = layer(
        tmp_path,
        'over "World" (prepend variantSets = "semantics") {\n'
        'variantSet "semantics" = { "semantic" { over "Ball" (active = false) {} } }\n}',
    )
    only(path, "/World/Ball", "missing", "variant semantic")


def test_marker_needs_its_size(tmp_path):
    """A marker with an empty box is refused."""
    only(
        layer(tmp_path, 'over "World" { over "Pitch" { float3 arena:size = (0, 1, 1) } }'), "/World/Pitch", "arena:size"
    )


def test_unreadable_files_are_one_line(tmp_path):
    """No file, and text that is no USD, give one problem each."""
    assert texts(tmp_path / "none.usda") == [f"{tmp_path / 'none.usda'}: no such file"]
    broken = tmp_path / "broken.usda"
    broken.write_text("#usda 1.0\ndef Xform {\n")
    only(broken, "not a readable USD layer")


GARBAGE = {
    "text.usda": (b"hello", "is not a valid usda layer"),
    "empty.usda": (b"", "is not a valid usda layer"),
    "bytes.usda": (b"#usda 1.0\n\xff\xfe\x1b[31m\x00\n", "bytes.usda:2:1: not understood"),
    "name.usda": (b'#usda 1.0\ndef Xform "\xff" {\n}\n', "name.usda:2:12: not understood"),
    "value.usda": (b'#usda 1.0\ndef Xform "W" {\n double x = = 3\n}\n', "value.usda:3:2: Expected }"),
    "bytes.usd": (bytes(range(256)), "not a readable USD layer"),
    "bytes.usdc": (bytes(range(256)), "not a readable USD layer"),
    "bytes.usdz": (bytes(range(256)), "not a readable USD layer"),
    "room.txt": (b"#usda 1.0\n", "is not a USD layer: expected one of .usda, .usd, .usdc, .usdz"),
}


@pytest.mark.parametrize("name", GARBAGE)
@pytest.mark.parametrize("arc", ["", "subLayers", "references", "payload"])
def test_garbage_is_one_line_wherever_it_stands(tmp_path, name, arc):
    """A file that is no layer gives one printable line without USD's own source, by itself and when built on."""
    data, words = GARBAGE[name]
    (tmp_path / name).write_bytes(data)
    if not arc:
        path = tmp_path / name
    elif arc == "subLayers":
        path = layer(tmp_path, head=HEAD.replace("{scene}", name))
    else:
        path = layer(tmp_path, f'over "World" {{ def Xform "Room" ({arc} = @{name}@) {{}} }}', head=BARE)
    found = texts(path)
    assert len(found) == 1, found
    assert words in found[0] and name in found[0]
    assert found[0].isprintable() and "pxr" not in found[0] and "Error in" not in found[0]
    with pytest.raises(InputError):
        layers(path)


@pytest.mark.parametrize(
    ("make", "word"),
    [
        (os.mkfifo, "named pipe"),
        (os.mkdir, "directory"),
        (lambda path: path.symlink_to("/dev/zero"), "device"),
        (lambda path: path.symlink_to(path), "cannot be read"),
    ],
    ids=["pipe", "folder", "device", "loop"],
)
@pytest.mark.parametrize("arc", ["", "subLayers", "references", "payload", "texture"])
def test_what_is_no_regular_file_is_refused_unopened(tmp_path, make, word, arc):
    """Pipes, folders and devices never reach USD, which would wait for them."""
    name = "odd.png" if arc == "texture" else "odd.usda"
    make(tmp_path / name)
    if not arc:
        path = tmp_path / name
    elif arc == "subLayers":
        path = layer(tmp_path, head=HEAD.replace("{scene}", name))
    elif arc == "texture":
        path = layer(tmp_path, f'over "World" {{ def Xform "Room" {{ asset inputs:file = @{name}@ }} }}', head=BARE)
    else:
        path = layer(tmp_path, f'over "World" {{ def Xform "Room" ({arc} = @{name}@) {{}} }}', head=BARE)
    only(path, word, name)


@pytest.mark.parametrize(
    ("body", "words"),
    [
        ('def Xform "Room" (references = @room.txt@) {}', "is not a USD layer"),
        ('def Xform "Room" {\n asset inputs:file = @room.usda@ }', "is not an image"),
        ('def Xform "Room" {\n asset inputs:file = @garbage.png@ }', "not a readable image"),
        ('def Xform "Room" {\n asset[] files = [@garbage.png@] }', "not a readable image"),
        ("def Xform \"Room\" (references = @`'room.usda'`@) {}", "expected a plain relative path"),
        ('def Xform "Room" (references = @room.usda@</Nothing>) {}', "Unresolved reference prim path"),
    ],
)
def test_assets_of_the_wrong_kind_are_named(tmp_path, body, words):
    """Layers are built on, images are textures, and a reference must lead to a prim."""
    (tmp_path / "room.txt").write_text("#usda 1.0\n")
    (tmp_path / "room.usda").write_text('#usda 1.0\ndef Xform "R" {\n}\n')
    (tmp_path / "garbage.png").write_bytes(b"\x89PNG garbage")
    found = texts(layer(tmp_path, f'over "World" {{ {body} }}'))
    assert len(found) == 1 and words in found[0], found


def test_a_cycle_of_layers_is_named(tmp_path):
    """A layer that sublayers itself is refused."""
    path = layer(tmp_path, head=HEAD.replace("@{scene}@", "@{scene}@, @my_room.usda@"))
    assert any("cycle" in line for line in texts(path))


def test_layers_lists_every_file_of_the_scene(tmp_path):
    """The layer, what it builds on in any variant, and textures; nothing else and nothing twice."""
    Image.new("RGB", (2, 2)).save(tmp_path / "my.png")
    (tmp_path / "room.usda").write_text('#usda 1.0\n(\n defaultPrim = "R"\n)\ndef Xform "R" {\n}\n')
    path = layer(
        tmp_path,
        'over "World" { def Xform "Room" (variantSets = "look") {\n asset inputs:file = @my.png@\n'
        'variantSet "look" = { "far" (references = @./room.usda@) {} }\n} }',
    )
    assert texts(path) == []
    found = layers(path)
    assert found[0] == path and len(set(found)) == len(found)
    folder = SCENES.resolve()
    wanted = {
        folder / "football" / "scene.usda",
        folder / "g1" / "g1.usda",
        tmp_path / "room.usda",
        tmp_path / "my.png",
    }
    textures = {file for file in found if file.resolve().parent == folder / "textures"}
    assert {file.resolve() for file in found} == {file.resolve() for file in {path, *wanted, *textures}}
    assert folder / "textures" / "football.png" in {file.resolve() for file in textures}
    # A link is followed by its name, as USD does it: what lies beside the link counts.
    (tmp_path / "links").mkdir()
    (tmp_path / "links" / "my_room.usda").symlink_to(path)
    assert any("does not exist" in line for line in texts(tmp_path / "links" / "my_room.usda"))


def test_a_package_is_followed_inside(tmp_path):
    """A .usdz package is one file of the scene; what it lacks inside is named."""

    def pack(name: str, texture: str) -> None:
        text = f'#usda 1.0\n(\n defaultPrim = "R"\n)\ndef Xform "R" {{\n asset inputs:file = @{texture}@\n}}\n'
        (tmp_path / "room.usda").write_text(text)
        writer = Sdf.ZipFileWriter.CreateNew(str(tmp_path / name))
        writer.AddFile(str(tmp_path / "room.usda"), "room.usda")
        writer.AddFile(str(tmp_path / "my.png"), "my.png")
        writer.Save()

    Image.new("RGB", (2, 2)).save(tmp_path / "my.png")
    pack("good.usdz", "my.png")
    pack("bad.usdz", "../my.png")
    path = layer(tmp_path, 'over "World" { def Xform "Room" (references = @good.usdz@) {} }')
    assert texts(path) == []
    assert tmp_path / "good.usdz" in layers(path) and tmp_path / "my.png" not in layers(path)
    (line,) = texts(layer(tmp_path, 'over "World" { def Xform "Room" (references = @bad.usdz@) {} }'))
    assert "bad.usdz" in line and "@../my.png@ does not exist" in line


NOT_FINITE = (
    "double3 xformOp:translate = (nan, 0, 0)",
    "float3 xformOp:scale = (1, inf, 1)",
    "quatf xformOp:orient = (1, 0, nan, 0)",
    "matrix4d xformOp:transform = ((1,0,0,0), (0,1,0,0), (0,0,1,0), (0,0,0,nan))",
    "double size = -inf",
    "double size = 1e300",
    "point3f[] points = [(0, 0, 0), (0, nan, 0)]",
    "double2 mjc:solref = (nan, 1)",
    "float newton:damping = nan",
    "float3 arena:size = (1, 1, nan)",
    "half arena:half = inf",
    "timecode arena:time = nan",
    "quatf[] arena:turns = [(1, 0, 0, nan)]",
    "double size.timeSamples = {\n0: 1,\n1: nan,\n}",
    "float physics:mass = nan",
    "float3 physics:diagonalInertia = (1, nan, 1)",
    "point3f physics:centerOfMass = (0, inf, 0)",
    "quatf physics:principalAxes = (nan, 0, 0, 0)",
)


def test_numbers_are_finite(tmp_path):
    """Every number that is authored anywhere must be finite; prim and attribute are named."""
    body = "".join(f'over "P{number}"\n{{\n{line}\n}}\n' for number, line in enumerate(NOT_FINITE))
    path = layer(tmp_path, head=BARE)
    path.write_text(path.read_text() + f'over "World"\n{{\n{body}}}\n')
    found = texts(path)
    assert len(found) == len(NOT_FINITE)
    for number, (line, text) in enumerate(zip(NOT_FINITE, found, strict=True)):
        assert f"/World/P{number}." + line.split()[1].removesuffix(".timeSamples") in text and "expected finite" in text


def test_principal_axes_are_a_rotation(tmp_path):
    """A quaternion of length 0 turns an inertia nowhere."""
    path = layer(tmp_path, 'over "World" { over "Ball" { quatf physics:principalAxes = (0, 0, 0, 0) } }')
    only(path, "/World/Ball", "physics:principalAxes", "unit quaternion")


@pytest.mark.parametrize(
    ("body", "prim", "words"),
    [
        ('over "World" (variants = { string semantics = "bogus" }) {}', "/World", "expected base, semantic"),
        ('over "World" { over "Robot" (variants = { string hands = "three" }) {} }', "/World/Robot", "dex3, fixed"),
        ('over "World" { over "Ball" (variants = { string look = "red" }) {} }', "/World/Ball", "unknown variant set"),
    ],
)
def test_unknown_variants_are_named(tmp_path, body, prim, words):
    """USD silently composes nothing for a selection that does not exist."""
    found = texts(layer(tmp_path, body))
    assert f": {prim}: " in found[0] and words in found[0], found


@pytest.mark.parametrize("number", range(len(SNIPPETS)))
def test_snippets_of_the_authoring_guide_are_usd(tmp_path, number):
    """Layers of docs/howto/bring/authoring.md validate where the guide puts them; fragments parse in the world."""
    text = SNIPPETS[number]
    if not text.startswith("#usda"):
        Sdf.Layer.CreateAnonymous(".usda").ImportFromString(f'#usda 1.0\nover "World"\n{{\n{text}\n}}\n')
        return
    (tmp_path / "usd_scenes").symlink_to(SCENES.resolve())
    (tmp_path / "rooms").mkdir()
    path = tmp_path / "rooms" / "my_room.usda"
    path.write_text(text)
    assert texts(path) == []
    assert task_of(path) == "sit_sofa"


def test_the_guide_shows_a_layer_and_a_fragment():
    """Both kinds of snippet are found, so that the test above looks at something."""
    assert {text.startswith("#usda") for text in SNIPPETS} == {True, False}


def test_a_layer_of_no_task_asks_for_one(tmp_path):
    """A stage that builds on no scene is judged with --task only."""
    path = tmp_path / "alone.usda"
    path.write_text(HEAD.replace("    subLayers = [@{scene}@]\n", "") + 'def Xform "World" {}\n')
    assert any("pass --task" in line for line in texts(path))
    assert any("/World/Ball: missing" in line for line in texts(path, "football"))
    with pytest.raises(InputError, match="unknown task 'tennis'"):
        validate(path, "tennis")


def test_command_line_prints_a_line_per_problem(tmp_path, capsys):
    """`validate` prints every problem on its own line and returns 2; a sound file returns 0."""
    path = layer(
        tmp_path, 'over "World" { over "Ball" (active = false) {}\nover "Goal" { over "Volume" (active = false) {} } }'
    )
    assert main(["validate", str(path)]) == 2
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == 2 and "/World/Ball" in lines[0] and "/World/Goal/Volume" in lines[1]
    assert main(["validate", "football"]) == 0


@pytest.mark.parametrize(
    "arguments",
    [
        ["validate", "football", "--task", "tennis"],
        ["validate", "no_such.usda"],
        ["preview", "--size", "3"],
        ["preview", "/dev/zero"],
        ["validate", "/dev/zero"],
    ],
)
def test_bad_input_ends_with_code_2_and_one_line(arguments, capsys):
    """Unknown names and impossible sizes are answered with one line."""
    assert main(arguments) == 2
    printed = capsys.readouterr()
    assert len((printed.out + printed.err).strip().splitlines()) == 1


def test_list_names_every_task(capsys):
    """`list` shows the seven tasks."""
    assert main(["list"]) == 0
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(tasks.names())


def test_help_is_quick():
    """The help text loads neither USD nor Warp."""
    code = (
        "import sys; from arena_newton.usd_scenes.__main__ import _parser; _parser().format_help();"
        "assert not {'pxr', 'warp', 'newton', 'mujoco', 'torch'} & set(sys.modules), 'heavy import'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=500)
