"""The validator names every fault of a user's layer, and the command line answers bad input with code 2."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from arena_newton.errors import InputError
from arena_newton.usd_scenes.__main__ import main
from arena_newton.usd_scenes.build import FOLDER
from arena_newton.usd_scenes.validate import REQUIRED, check, task_of, validate

HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    subLayers = [@{scene}@]
)
"""


def layer(folder: Path, body: str = "", *, task: str = "football", head: str = HEAD) -> Path:
    """A user's layer on top of a task's scene; `body` may be written on one line."""
    path = folder / "my_room.usda"
    body = body.replace("{", "{\n").replace("}", "\n}\n")
    scene = os.path.relpath(FOLDER / task / "scene.usda", folder.resolve())
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


@pytest.mark.parametrize("task", REQUIRED)
def test_own_scenes_and_variants_are_sound(task):
    """Every scene and variant of the project passes."""
    files = [FOLDER / task / "scene.usda", *(FOLDER / task / "variants").glob("*.usda")]
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


@pytest.mark.parametrize("task", REQUIRED)
def test_every_required_prim_is_missed(tmp_path, task):
    """Switching off any required prim is noticed and the prim is named."""
    for item in REQUIRED[task]:
        if item.variants:
            continue
        parts = item.path.strip("/").split("/")
        body = "".join(f'over "{part}" ' + ("(active = false) " if part == parts[-1] else "") + "{\n" for part in parts)
        found = texts(layer(tmp_path, body + "}\n" * len(parts), task=task))
        assert any(f": {item.path}: missing" in line for line in found), (item.path, found)


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
    head, prim = HEAD, "/World/Room"
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
        head, body, prim = HEAD.replace("@{scene}@", f"@{{scene}}@, @{asset}@"), "", "my_room.usda"
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
        ["build", "tennis"],
        ["preview", "--size", "3"],
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
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()] == list(REQUIRED)


def test_help_is_quick():
    """The help text loads neither USD nor Warp."""
    code = (
        "import sys; from arena_newton.usd_scenes.__main__ import _parser; _parser().format_help();"
        "assert not {'pxr', 'warp', 'newton', 'mujoco', 'torch'} & set(sys.modules), 'heavy import'"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
