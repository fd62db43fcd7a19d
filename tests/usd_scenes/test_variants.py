"""Variants: a skeleton that may lie anywhere, what a variant changes, and what starts inside something else."""

import functools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from arena_newton import rule_sets, tasks
from arena_newton.errors import InputError
from arena_newton.physics.scene import SCENES, load_scene
from arena_newton.usd_scenes.__main__ import main
from arena_newton.usd_scenes.compiled import compiled, own_compiled
from arena_newton.usd_scenes.spawn import penetrations
from arena_newton.usd_scenes.validate import differences, layers, task_of, validate


@pytest.fixture
def written(tmp_path):
    """Writes a variant of a task with these prims in its world."""

    def write(body: str = "", task: str = "football", name: str = "mine.usda") -> Path:
        path = tmp_path / name
        path.unlink(missing_ok=True)
        assert main(["new", task, str(path)]) == 0
        text = path.read_text()
        end = text.rindex("}")
        path.write_text(text[:end] + body.replace("{", "\n{\n").replace("}", "\n}\n") + text[end:])
        return path

    return write


@pytest.fixture
def once(monkeypatch):
    """Builds each model of a test once, whoever asks for it: its layer must stay as it is."""
    kept = functools.cache(compiled)
    for module in ("differences", "validate"):
        monkeypatch.setattr(f"arena_newton.usd_scenes.{module}.compiled", kept)


@pytest.mark.parametrize("task", tasks.OWN)
def test_a_skeleton_is_sound(task, written):
    """`new` writes a layer that validates as its task wherever it lies."""
    path = written(task=task)
    assert validate(path) == [] and task_of(path) == task
    assert (SCENES / task / "scene.usda").resolve() in {file.resolve() for file in layers(path)}


def test_new_overwrites_nothing(tmp_path, capsys):
    """A file that exists, an unknown task, another kind of file and a missing folder are one line each."""
    path = tmp_path / "mine.usda"
    path.write_text("mine")
    for arguments, words in (
        (["football", str(path)], "exists already"),
        (["tennis", str(tmp_path / "a.usda")], "unknown task 'tennis'"),
        (["football", str(tmp_path / "a.txt")], "ends in .usda"),
        (["football", str(tmp_path / "no" / "a.usda")], "cannot be written"),
    ):
        assert main(["new", *arguments]) == 2
        printed = capsys.readouterr()
        assert words in printed.err and len(printed.err.splitlines()) == 1 and not printed.out
    assert path.read_text() == "mine" and not (tmp_path / "a.usda").exists()


def test_the_package_is_found_from_an_installation(written, tmp_path):
    """The skeleton's path leads to the scenes of whatever installation reads it, folders of links or not."""
    installed = tmp_path / "site-packages"
    code = SCENES.resolve().parent
    shutil.copytree(code / "arena_newton", installed / "arena_newton", symlinks=False)
    path = written()
    command = "from arena_newton.usd_scenes.validate import layers, validate; import sys; p = sys.argv[1];"
    command += "print(validate(p), *layers(p), sep='\\n')"
    done = subprocess.run(
        [sys.executable, "-P", "-c", command, str(path)],
        env=os.environ | {"PYTHONPATH": str(installed)},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    first, *files = done.stdout.splitlines()
    assert first == "[]"
    assert str(installed / "arena_newton" / "usd_scenes" / "football" / "scene.usda") in files


def test_the_package_is_no_way_out(tmp_path):
    """Only scenes of the package are looked up there, and a file beside the layer comes first, as in USD."""
    text = '#usda 1.0\n(\n    defaultPrim = "A"\n    subLayers = [@{}@]\n)\n'
    path = tmp_path / "mine.usda"
    for asset in ("arena_newton/usd_scenes/../camera.usda", "arena_newton/other/a.usda", "numpy/a.usda"):
        path.write_text(text.format(asset))
        with pytest.raises(InputError, match="does not exist"):
            layers(path)
    near = tmp_path / "arena_newton" / "usd_scenes" / "football" / "scene.usda"
    near.parent.mkdir(parents=True)
    near.write_text('#usda 1.0\n(\n    defaultPrim = "A"\n)\n')
    path.write_text(text.format("arena_newton/usd_scenes/football/scene.usda"))
    assert layers(path) == [path, near]


def over(lines: str, *names: str) -> str:
    return "".join(f'over "{name}" {{ ' for name in names) + lines + " }" * len(names)


CHANGES = {
    "all at once": (
        over("float physics:gravityMagnitude = 0", "physicsScene")
        + over("float physics:mass = 0.01", "Robot", "pelvis")
        + over("float3 arena:size = (9, 2, 1.85)\ndouble3 xformOp:translate = (0.05, 4.03, 1.925)", "Goal", "Volume")
        + over("double radius = 0.25", "Ball", "Collider")
        + 'def Cube "Stool" (prepend apiSchemas = ["PhysicsCollisionAPI"]) {}'
        + over("float focalLength = 20", "WorldCamera")
        + 'def Cube "Seen" {}'
        + 'def PhysicsFixedJoint "Glue" { rel physics:body0 = </World/Ball> }',
        [
            "gravity: /World/physicsScene: physics:gravityMagnitude is 0, not 9.81",
            "drawn: /World/Ball: is drawn 0.22 x 0.22 x 0.22 m large, its colliders are 0.50 x 0.50 x 0.50 m",
            "joint: /World/Glue is new",
            "object: /World/Ball/Collider: radius is 0.25, not 0.11",
            "object: /World/Stool is new",
            "robot: /World/Robot/pelvis: physics:mass is 0.01, not 3.814; its inertia is not changed in proportion",
            "rule: /World/Goal/Volume: arena:size is (9, 2, 1.85), not (5.1, 2, 1.85), is moved by 1 m",
            "rule object: /World/Ball: free directions is 0, not 6",
        ],
    ),
    "by other ways": (
        'def PhysicsScene "A" { float physics:gravityMagnitude = 0 }'
        + over(
            'float3 xformOp:scale = (2, 2, 2)\nuniform token[] xformOpOrder = ["xformOp:translate", "xformOp:scale"]\n'
            + over("rel material:binding:physics = </World/Looks/GoalSurface>", "Collider"),
            "Ball",
        ),
        [
            "physics: /World/A is one more PhysicsScene; gravity stays",
            "rule object: /World/Ball/Collider: size is (0.22, 0.22, 0.22), not (0.11, 0.11, 0.11), "
            "friction is (0.5, 0.005, 0.0001), not (0.7, 0.005, 0.0001)",
        ],
    ),
    "own variant": ("", ["scene: selects the variant semantic by itself"]),
}


@pytest.mark.parametrize("case", CHANGES)
def test_changes_are_told(written, case):
    """Gravity, robot, rule markers, masses and colliders that differ are reported in sentences; looks are free."""
    body, sentences = CHANGES[case]
    path = written(body)
    if case == "own variant":
        path.write_text(
            path.read_text().replace('over "World"', 'over "World" (variants = { string semantics = "semantic" })')
        )
    told = differences(path, "football")
    assert told[0] == sentences[0] and sorted(told) == sorted(sentences)


GROUP = 'def PhysicsCollisionGroup "G" (prepend apiSchemas = ["CollectionAPI:colliders"]) {{ {} }}'
FILTERS = {
    "all": (
        GROUP.format("rel collection:colliders:includes = </World>\nrel physics:filteredGroups = </World/G>"),
        [f"/World/{name} no longer meets anything" for name in ("Ball", "Goal", "Ground", "Robot")],
        "/World/Robot: no longer meets /World/Ground",
    ),
    "inverted, and switched off": (
        GROUP.format("rel collection:colliders:includes = </World/Ball>\nbool physics:invertFilteredGroups = true")
        + over("bool physics:collisionEnabled = false", "Ground"),
        ["/World/Ball no longer meets anything", "/World/Ground no longer meets anything"],
        "/World/Robot: no longer meets /World/Ball",
    ),
    "pairs, of a thing and of a foot": (
        over("rel physics:filteredPairs = </World/Ground>", "Ball").replace(
            '"Ball"', '"Ball" (prepend apiSchemas = ["PhysicsFilteredPairsAPI"])'
        )
        + over("rel physics:filteredPairs = </World/Ground>", "Robot", "left_ankle_roll_link").replace(
            "_roll_link", '_roll_link" (prepend apiSchemas = ["PhysicsFilteredPairsAPI"]) #'
        ),
        [
            "/World/Ball and /World/Ground no longer meet",
            "/World/Ground and /World/Robot no longer meet in 1 of 31 pairs of colliders",
        ],
        "/World/Ball: no longer meets /World/Ground",
        "/World/Robot/left_ankle_roll_link/collision: no longer meets /World/Ground: expected",
    ),
    "no contacts": (
        over("custom bool mjc:flag:contact = false", "physicsScene"),
        [f"/World/{name} no longer meets anything" for name in ("Ball", "Goal", "Ground", "Robot")],
        "/World/Robot: no longer meets /World/Ground",
    ),
}


@pytest.mark.parametrize("case", FILTERS)
def test_lost_collisions_are_told_and_refused(written, case, once):
    """Settings that part robot, ground and rule objects are reported as changes, and named by `validate`."""
    body, told, *faults = FILTERS[case]
    path = written(body)
    effects = [text for text in differences(path, "football") if "no longer meet" in text]
    assert effects == [f"collisions: {text}" for text in told]
    problems = [str(problem) for problem in validate(path)]
    assert all("no longer meets" in text for text in problems)
    for fault in faults:
        assert any(text.startswith(f"{path}: {fault}") for text in problems), problems


@pytest.mark.parametrize("line", ["rigidBodyEnabled = false", "kinematicEnabled = true"])
def test_bodies_that_do_not_move_are_refused(written, line):
    """A body of the robot or of a rule that is switched off or held is a fault that names the attribute."""
    still = f"bool physics:{line}"
    problems = [str(problem) for problem in validate(written(over(still, "Ball") + over(still, "Robot", "pelvis")))]
    assert len(problems) == 2 and all(f"physics:{line.replace('=', 'is')}" in text for text in problems)
    assert {name for name in ("Ball", "pelvis") for text in problems if name in text} == {"Ball", "pelvis"}


def test_collisions_that_stay_are_no_fault(written, once):
    """A collision group that filters nothing that the task needs is accepted, and the new group is reported."""
    path = written(GROUP.format("rel collection:colliders:includes = </World/Ball>"))
    assert validate(path) == []
    assert differences(path, "football") == ["collisions: /World/G is a new collision group"]


def test_a_robot_that_changes_all_over_is_summed_up(written, once):
    """Dozens of changed links are a few sentences, the same every time."""
    order = 'uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient", "xformOp:scale"]'
    path = written(over(f"float3 xformOp:scale = (2, 2, 2)\n{order}", "Robot"))
    told = differences(path, "football")
    assert 1 <= len(told) <= 5 and all(text.startswith("robot: /World/Robot: ") for text in told)
    assert told == differences(path, "football")


def test_a_skeleton_lists_what_base_needs(written):
    """Prims of one variant of the scene alone are not listed as needed."""
    text = written().read_text()
    assert "/World/Ball (body)" in text and "Distractor" not in text


def test_the_own_scenes_change_nothing(written):
    """No task's scene differs from itself, and a skeleton changes nothing."""
    for task in ("football", "open_door"):
        assert differences(SCENES / task / "scene.usda", task) == []
    assert differences(written(), "football") == []
    with pytest.raises(InputError, match="unknown task"):
        differences(SCENES / "football" / "scene.usda", "tennis")


def test_a_larger_ball_starts_on_the_floor(written):
    """The ball's height comes from its collider; in the project's own scene nothing is added to the sample."""
    (ball,) = tasks.get("football").objects
    own = load_scene("football", native=True, device="cpu")
    assert ball.raised(own) == 0.0
    larger = load_scene("football", variant_file=written(over("double radius = 0.25", "Ball", "Collider")), native=True)
    assert ball.raised(larger) == pytest.approx(0.14, abs=1e-6)
    np.testing.assert_allclose(larger.lowest("/World/Ball"), -0.25, atol=1e-6)


def test_a_ball_that_is_drawn_smaller_than_it_collides_is_named(written, monkeypatch):
    """Another radius alone leaves the drawn ball as it is, and that is reported; with the mesh scaled too it is not."""
    own = "arena_newton.usd_scenes.differences.compiled"  # of the models nothing is asked here
    monkeypatch.setattr(own, lambda path, variant: own_compiled("football", variant))
    path = written(over("double radius = 0.15", "Ball", "Collider"))
    said = "drawn: /World/Ball: is drawn 0.22 x 0.22 x 0.22 m large, its colliders are 0.30 x 0.30 x 0.30 m"
    assert said in differences(path, "football")
    scale = 1.3636
    order = 'uniform token[] xformOpOrder = ["xformOp:scale"]'
    look = f'over "Look" {{\ndouble3 xformOp:scale = ({scale}, {scale}, {scale})\n{order}\n}}'
    both = 'over "Ball" {\nover "Collider" {\ndouble radius = 0.15\n}\n' + look + "\n}"
    assert not any(text.startswith("drawn") for text in differences(written(both), "football"))


def test_what_stands_on_a_desk_follows_its_height(written):
    """Hammer and basket start as much higher as their desk; in the project's own scene nothing is added."""
    own = load_scene("double_desk", native=True, device="cpu")
    assert [thing.raised(own) for thing in tasks.get("double_desk").objects] == [0.0, 0.0]
    path = written(over("double3 xformOp:translate = (0, 0, 0.775)", "RightDesk", "Top"), task="double_desk")
    higher = load_scene("double_desk", variant_file=path, native=True)
    assert [thing.raised(higher) for thing in tasks.get("double_desk").objects] == [pytest.approx(0.05), 0.0]
    assert penetrations(path, "double_desk") == ([], [])


def test_what_starts_inside_something_is_named(written, capsys, once):
    """`validate` resets an episode of each mode: a stool under the ball is named; what a variant changes is printed."""
    ball = tasks.get("football").draw(0, "base", rule_sets.get("paper"))
    x, y, _ = ball.placed["/World/Ball"].pos
    stool = (
        'def Cube "Stool" (prepend apiSchemas = ["PhysicsCollisionAPI"]) { double size = 0.3\n'
        f"double3 xformOp:translate = ({x}, {y}, 0.15)\n" + 'uniform token[] xformOpOrder = ["xformOp:translate"]\n}'
    )
    path = written(stool)
    capsys.readouterr()
    assert main(["validate", str(path)]) == 2
    first, second = capsys.readouterr().out.splitlines()
    assert first.startswith(f"{path}: /World/Ball: starts ") and "inside /World/Stool" in first and "base" in first
    assert second == f"{path}: changed: object: /World/Stool is new"
    assert main(["validate", str(path), "--no-spawn"]) == 0
    new, known = penetrations(written(over("double radius = 0.25", "Ball", "Collider")), "football")
    assert (new, known) == ([], [])
