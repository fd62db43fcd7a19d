"""Geometry that would crash the importer, or that is none, is named before a stage is built."""

from pathlib import Path

import pytest

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.physics.scene import load_scene
from arena_newton.usd_scenes.shapes import check_buildable, open_stage
from arena_newton.usd_scenes.validate import validate

HEAD = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
    subLayers = [@arena_newton/usd_scenes/football/scene.usda@]
)
over "World"
{
"""
BARE = HEAD.replace("    subLayers = [@arena_newton/usd_scenes/football/scene.usda@]\n", "").replace("over", "def")
"""The same without the scene."""
SOLID = '(prepend apiSchemas = ["PhysicsCollisionAPI"])'
POINTS = "point3f[] points = [(0, 0, 1), (1, 0, 1), (0, 1, 1)]\n"
TRIANGLE = "int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 2]\n"


def variant(folder: Path, body: str, head: str = HEAD) -> Path:
    """A layer over Football's scene with these prims in its world."""
    path = folder / "mine.usda"
    path.write_text(head + body.replace("{", "\n{\n").replace("}", "\n}\n") + "}\n")
    return path


def mesh(lines: str, schemas: str = "") -> str:
    return f'def Mesh "M" {schemas} {{ {lines} }}'


UNSAFE = {
    "past the points": ("int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, 99999999]\n", "holds 99999999"),
    "below zero": ("int[] faceVertexCounts = [3]\nint[] faceVertexIndices = [0, 1, -5]\n", "holds -5: expected 0 to 2"),
    "more corners": ("int[] faceVertexCounts = [1000000]\nint[] faceVertexIndices = [0, 1, 2]\n", "adds up to 1000000"),
    "overflow": (
        "int[] faceVertexCounts = [2147483647, 2147483647, 5]\nint[] faceVertexIndices = [0, 1, 2]\n",
        "adds up to 4294967299",
    ),
    "two corners": ("int[] faceVertexCounts = [2]\nint[] faceVertexIndices = [0, 1]\n", "holds 2: expected at least 3"),
    "negative count": ("int[] faceVertexCounts = [-3, 6]\nint[] faceVertexIndices = [0, 1, 2]\n", "holds -3"),
    "no faces": ("", "faceVertexCounts is missing"),
    "st": (
        TRIANGLE + 'texCoord2f[] primvars:st = [(0, 0)] (interpolation = "faceVarying")\n'
        "int[] primvars:st:indices = [0, 0, 77]\n",
        "primvars:st:indices holds 77: expected 0 to 0",
    ),
    "short st": (
        TRIANGLE + 'texCoord2f[] primvars:st = [(0, 0)] (interpolation = "faceVarying")\n',
        "primvars:st has 1 elements, expected 3",
    ),
    "text": ('int[] faceVertexCounts = [3]\nstring faceVertexIndices = "0 1 2"\n', "type str: expected int"),
}


def test_meshes_that_would_crash(tmp_path):
    """Indices that lead out of a mesh are named by the validator, and the importer never sees them."""
    for case, (lines, words) in UNSAFE.items():
        (tmp_path / case).mkdir()  # USD keeps a layer under its path while anything holds it
        path = variant(tmp_path / case, mesh(POINTS + lines), BARE)
        assert any(": /World/M: " in str(problem) and words in str(problem) for problem in validate(path, "football"))
        with pytest.raises(InputError, match=r"mine\.usda: /World/M: ") as caught:
            check_buildable(open_stage(path), path)
        assert words in str(caught.value) and "\n" not in str(caught.value), case
    path = variant(tmp_path, mesh(POINTS + UNSAFE["below zero"][0]))
    with pytest.raises(InputError, match=r"mine\.usda: /World/M: .*holds -5"):
        load_scene("football", variant_file=path, native=True, device="cpu")


def test_a_mesh_of_an_override_is_checked(tmp_path):
    """A layer that changes one array of another layer's mesh is judged as composed."""
    (tmp_path / "solid.usda").write_text(
        f'#usda 1.0\n(\n defaultPrim = "M"\n)\ndef Mesh "M"\n{{\n{POINTS}{TRIANGLE}}}\n'
    )
    path = variant(tmp_path, 'def "M" (references = @solid.usda@) {}')
    assert validate(path) == []
    path = variant(tmp_path, 'def "M" (references = @solid.usda@) { int[] faceVertexIndices = [0, 1, 3] }')
    assert "faceVertexIndices holds 3" in str(validate(path)[0])


def test_points_are_limited(tmp_path, monkeypatch):
    """A mesh, and the meshes of a scene together, have so many points at most."""
    two = mesh(POINTS + TRIANGLE) + mesh(POINTS + TRIANGLE).replace('"M"', '"N"')
    path = variant(tmp_path, two, BARE)
    check_buildable(open_stage(path), path)
    monkeypatch.setattr(limits, "SCENE_POINTS", 5)
    with pytest.raises(InputError, match=r"/World/N: brings the meshes of the scene to 6 points, expected at most 5"):
        check_buildable(open_stage(path), path)
    monkeypatch.setattr(limits, "MESH_POINTS", 2)
    with pytest.raises(InputError, match=r"/World/M: has 3 points or corners, expected at most 2"):
        check_buildable(open_stage(path), path)


def at(lines: str, *names: str) -> str:
    """Overrides of nested prims."""
    return "".join(f'over "{name}" {{ ' for name in names) + lines + " }" * len(names)


MOVED = 'uniform token[] xformOpOrder = ["xformOp:{0}"]'
NONSENSE = {
    "cube": (f'def Cube "M" {SOLID} {{ double size = -1 }}', "/World/M", "size is -1"),
    "sphere": (f'def Sphere "M" {SOLID} {{ double radius = 0 }}', "/World/M", "radius is 0"),
    "capsule": (f'def Capsule "M" {SOLID} {{ double height = -2 }}', "/World/M", "height is -2"),
    "flat": (mesh(POINTS + TRIANGLE, SOLID), "/World/M", "flat: expected a solid"),
    "plane of four": (
        mesh(
            "point3f[] points = [(0, 0, 1), (1, 0, 1), (0, 1, 1), (1, 1, 1)]\nint[] faceVertexCounts = [4]\n"
            "int[] faceVertexIndices = [0, 1, 3, 2]\n",
            SOLID,
        ),
        "/World/M",
        "flat collision mesh",
    ),
    "inertia": (
        at("float3 physics:diagonalInertia = (1, 0.001, 0.001)", "Ball"),
        "/World/Ball",
        "more than the sum of the other two",
    ),
    "large inertia": (at("float3 physics:diagonalInertia = (9, 9, 9)", "Ball"), "/World/Ball", "has at most"),
    "light mass": (at("float physics:mass = 1e-9", "Ball"), "/World/Ball", "physics:mass is 1e-09"),
    "heavy mass": (at("float physics:mass = 1e9", "Ball"), "/World/Ball", "physics:mass is 1e+09"),
    "scale": (
        'def Cube "M" { double3 xformOp:scale = (0, 1, 1)\n' + MOVED.format("scale") + "\n}",
        "/World/M",
        "is scaled by 0, 1, 1",
    ),
    "turn": (
        'def Cube "M" { quatf xformOp:orient = (0, 0, 0, 0)\n' + MOVED.format("orient") + "\n}",
        "/World/M",
        "has length 0: expected a unit quaternion",
    ),
    "far": (
        'def Cube "M" { double3 xformOp:translate = (1e30, 0, 0)\n' + MOVED.format("translate") + "\n}",
        "/World/M",
        "lies at (1e+30, 0, 0) m",
    ),
    "light": (at("float inputs:intensity = -5", "Light"), "/World/Light", "inputs:intensity is -5"),
    "colour": (at("color3f inputs:color = (1, -1, 1)", "Light"), "/World/Light", "inputs:color"),
    "gravity": (at("float physics:gravityMagnitude = -9", "physicsScene"), "/World/physicsScene", "is -9"),
    "other kinds": ('def PointInstancer "M" {}', "/World/M", "is a PointInstancer: expected one of Mesh"),
}


def test_nonsense_is_named(tmp_path):
    """Sizes, poses, masses, inertias, lights and gravity that are none are one problem each, with its prim."""
    left = [
        (body.replace('"M"', f'"M{number}"'), prim.replace("/M", f"/M{number}"), words)
        for number, (body, prim, words) in enumerate(NONSENSE.values())
    ]
    while left:
        layer = {prim: (body, words) for body, prim, words in reversed(left)}  # one fault for each prim
        left = [(body, prim, words) for body, prim, words in left if layer[prim] != (body, words)]
        problems = validate(variant(tmp_path, "".join(body for body, _ in layer.values())))
        assert {problem.prim for problem in problems} == set(layer) and len(problems) == len(layer)
        for problem in problems:
            assert layer[problem.prim][1] in problem.message, str(problem)
    path = variant(tmp_path, at('string physics:mass = "x"', "Ball"))
    (problem,) = validate(path)
    assert problem.prim == "/World/Ball" and "physics:mass holds a value of type str" in problem.message


def test_an_anchor_is_a_rotation(tmp_path):
    """The joint that holds a fixture has quaternions of length 1."""
    path = variant(
        tmp_path,
        at("quatf physics:localRot0 = (0, 0, 0, 0)", "Basket", "anchor"),
        HEAD.replace("football", "double_desk"),
    )
    (problem,) = validate(path)
    assert problem.prim == "/World/Basket/anchor" and "physics:localRot0 has length 0" in problem.message


@pytest.mark.parametrize(
    "value", ['string inputs:file = "http://127.0.0.1:9/a.png"', 'token inputs:file = "/etc/a.png"']
)
def test_a_texture_is_no_text(tmp_path, value):
    """Text where a shader looks for a texture is refused: the importer would open it, URLs included."""
    path = variant(tmp_path, 'def Shader "S" { uniform token info:id = "UsdUVTexture"\n' + value + " }")
    (problem,) = validate(path)
    assert problem.prim == "/World/S.inputs:file" and "names a file: expected an asset" in problem.message
    with pytest.raises(InputError, match="names a file"):
        open_stage(path)


def test_what_the_importer_cannot_build_is_one_line(tmp_path):
    """An error of the importer over somebody's scene names the file."""
    path = variant(tmp_path, mesh(POINTS + TRIANGLE, SOLID))
    with pytest.raises(InputError, match=r"mine\.usda: cannot be built \(ValueError: ") as caught:
        load_scene("football", variant_file=path, native=True, device="cpu")
    assert "\n" not in str(caught.value)
