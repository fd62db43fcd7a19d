"""A process that gives damaged files to one reader and says what came of it; see `test_readers`.

Run as `python mutants.py READER COUNT FOLDER`; the last line of its output is a JSON object.
"""

import copy
import io
import json
import pickle
import random
import resource
import struct
import sys
import time
import traceback
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from arena_newton.errors import InputError
from arena_newton.files import limits

NUMBERS = (b"-1", b"0", b"1e308", b"nan", b"inf", b"-99999999999", b"4294967296", b"1e-320", b"", b"(", b"[[", b"]")
WORDS = (
    *(b"\xff\xff\xff\xff", b"\0\0\0\0", b"\xff\xff\xff\x7f", b"\0\0\0\x80", b"\0\0\0\x40", b"\xff" * 8, b"\0" * 8),
    *(struct.pack("<Q", 1 << n) for n in (20, 31, 33, 40, 62)),
)
READY, DAMAGED = "accepted", "refused"
Reader = Callable[[Path], None]
Made = tuple[Reader, Callable[[], tuple[str, bytes]]]
"""A reader, and name and content of its next damaged file."""


def damaged(data: bytes, rng: random.Random, *, text: bool = False) -> bytes:
    """The bytes with 1 to 16 faults."""
    out = bytearray(data)
    for _ in range(rng.choice((1, 1, 1, 2, 4, 16))):
        at, kind, length = rng.randrange(len(out) or 1), rng.random(), rng.randrange(1, 64)
        if kind < 0.35:
            low, high = rng.choice(((32, 127), (48, 58))) if text else (0, 256)
            out[at : at + 1] = bytes([rng.randrange(low, high)])
        elif kind < 0.65:
            word = rng.choice(NUMBERS if text else WORDS)
            out[at : at + (rng.randrange(4) if text else len(word))] = word
        elif kind < 0.75:
            del out[at : at + length]
        elif kind < 0.85:
            out[at:at] = out[at : at + length]
        elif kind < 0.93:
            other = rng.randrange(len(out) or 1)
            out[at : at + length] = out[other : other + length]
        elif kind < 0.96:
            out[at:at] = out[at : at + length] * rng.randrange(2, 400)
        else:
            del out[at:]
    return bytes(out)


def zipped(members: dict[str, bytes], rng: random.Random) -> bytes:
    """An archive, of which a third is damaged as a whole and the rest in one sound member."""
    whole = rng.random() < 0.34
    name = rng.choice(list(members))
    parts = members if whole else members | {name: damaged(members[name], rng)}
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", rng.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED))) as archive:
        for part, data in parts.items():
            archive.writestr(part, data)
    return damaged(file.getvalue(), rng) if whole else file.getvalue()


def members(arrays: dict[str, object]) -> dict[str, bytes]:
    out = {}
    for name, array in arrays.items():
        file = io.BytesIO()
        np.save(file, np.asarray(array), allow_pickle=False)
        out[f"{name}.npy"] = file.getvalue()
    return out


LAYER = """#usda 1.0
(
    defaultPrim = "World"
    metersPerUnit = 1
    kilogramsPerUnit = 1
    upAxis = "Z"
)
def Xform "World" (
    variants = {
        string semantics = "base"
    }
    prepend variantSets = "semantics"
)
{
    def PhysicsScene "physicsScene"
    {
        float physics:gravityMagnitude = 9.81
    }
    def DomeLight "Light"
    {
        float inputs:intensity = 3000
        color3f inputs:color = (1, 0.9, 0.8)
    }
    def Mesh "M" (
        prepend apiSchemas = ["PhysicsCollisionAPI"]
    )
    {
        int[] faceVertexCounts = [3, 3, 3, 3]
        int[] faceVertexIndices = [0, 1, 2, 0, 1, 3, 0, 2, 3, 1, 2, 3]
        point3f[] points = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)]
        texCoord2f[] primvars:st = [(0, 0), (1, 0), (0, 1)] (
            interpolation = "faceVarying"
        )
        int[] primvars:st:indices = [0, 1, 2, 0, 1, 2, 0, 1, 2, 0, 1, 2]
        quatf xformOp:orient = (1, 0, 0, 0)
        double3 xformOp:translate = (0, 0, 2)
        uniform token[] xformOpOrder = ["xformOp:translate", "xformOp:orient"]
    }
    def Xform "Ball" (
        prepend apiSchemas = ["PhysicsRigidBodyAPI", "PhysicsMassAPI"]
    )
    {
        float physics:mass = 0.43
        float3 physics:diagonalInertia = (0.002, 0.002, 0.002)
        point3f physics:centerOfMass = (0, 0, 0)
        quatf physics:principalAxes = (1, 0, 0, 0)
        def Sphere "Collider" (
            prepend apiSchemas = ["PhysicsCollisionAPI"]
        )
        {
            double radius = 0.11
        }
    }
    def Xform "Room" (
        prepend references = @room.usda@
    )
    {
    }
    def Shader "Look"
    {
        asset inputs:file = @my.png@
        double x.timeSamples = {
            0: 1,
            1: 2,
        }
    }
    variantSet "semantics" = {
        "base" {
            def Cube "Box"
            {
                double size = 1
            }
        }
        "semantic" {
            over "Ball" (
                active = false
            )
            {
            }
        }
    }
}
"""
ROOM = '#usda 1.0\n(\n    defaultPrim = "R"\n)\ndef Xform "R"\n{\n    def Cube "C"\n    {\n    }\n}\n'


def scene_files(folder: Path) -> None:
    from PIL import Image

    Image.new("RGB", (8, 8)).save(folder / "my.png")
    (folder / "room.usda").write_text(ROOM)
    (folder / "scene.usda").write_text(LAYER)


def judge_layer(path: Path) -> None:
    """Raise InputError for what the validator finds beyond the prims that no task would miss."""
    from arena_newton.usd_scenes.validate import validate

    problems = [p for p in validate(path, "football") if "missing: expected" not in p.message]
    for problem in problems:
        assert "\n" not in str(problem) and str(problem).isprintable(), repr(problem)
    if problems:
        raise InputError(str(problems[0]))


def usda(folder: Path, rng: random.Random) -> Made:
    scene_files(folder)
    return judge_layer, lambda: ("mutant.usda", damaged(LAYER.encode(), rng, text=True))


def usdc(folder: Path, rng: random.Random) -> Made:
    from pxr import Sdf

    scene_files(folder)
    Sdf.Layer.FindOrOpen(str(folder / "scene.usda")).Export(str(folder / "scene.usdc"))
    data = (folder / "scene.usdc").read_bytes()
    return judge_layer, lambda: ("mutant.usdc", damaged(data, rng))


def usdz(folder: Path, rng: random.Random) -> Made:
    from pxr import Sdf

    scene_files(folder)

    def made() -> tuple[str, bytes]:
        broken = rng.choice(("scene.usda", "room.usda", "my.png", ""))
        for name in ("scene.usda", "room.usda", "my.png"):
            data = (folder / name).read_bytes()
            if name == broken:
                data = damaged(data, rng, text=name.endswith("usda")) or b"?"
            (folder / "in" / name).write_bytes(data)
        writer = Sdf.ZipFileWriter.CreateNew(str(folder / "new.usdz"))
        for name in ("scene.usda", "room.usda", "my.png"):
            writer.AddFile(str(folder / "in" / name), name)
        writer.Save()
        data = (folder / "new.usdz").read_bytes()
        if not broken:
            # Headers: the tail with the directory, and the head of each entry.
            start = rng.choice((0, max(data.rfind(b"PK\x01\x02") - 80, 0), data.find(b"my.png") - 30))
            data = data[:start] + damaged(data[start : start + 160], rng) + data[start + 160 :]
        return "mutant.usdz", data

    (folder / "in").mkdir()
    return judge_layer, made


def images(folder: Path, rng: random.Random) -> Made:
    from PIL import Image

    (folder / "scene.usda").write_text(
        '#usda 1.0\n(\n    defaultPrim = "World"\n)\ndef Xform "World"\n{\n    asset inputs:file = @mutant.png@\n}\n'
    )
    kinds = []
    for kind in ("PNG", "JPEG", "BMP", "TGA"):
        file = io.BytesIO()
        Image.effect_noise((16, 16), 50).convert("RGB").save(file, kind)
        kinds.append(file.getvalue())

    def read(path: Path) -> None:
        from arena_newton.usd_scenes.validate import check_files

        check_files(path.with_name("scene.usda"))

    return read, lambda: ("mutant.png", damaged(rng.choice(kinds), rng))


def motions(folder: Path, rng: random.Random) -> Made:
    from arena_newton.trackers.motions.formats import read_file
    from arena_newton.trackers.motions.library import MotionLibrary
    from arena_newton.trackers.motions.load import Clip

    pos = np.tile([0.0, 0.0, 0.8], (20, 1))
    quat = np.tile([1.0, 0, 0, 0], (20, 1))
    MotionLibrary.from_clips([Clip(50.0, pos, quat, np.zeros((20, 29)))], ["a"]).save(folder / "library.npz")
    with np.load(folder / "library.npz") as file:
        library = members(dict(file))
    bodies = {"body_pos_w": pos[:, None], "body_quat_w": quat[:, None], "fps": 50, "joint_pos": np.zeros((20, 29))}
    beyond = members(bodies)
    return lambda path: void(read_file(path)), lambda: ("mutant.npz", zipped(rng.choice((library, beyond)), rng))


def recordings(folder: Path, rng: random.Random) -> Made:
    from arena_newton.env import STAND_ACTION
    from arena_newton.policies.replay import ReplayEpisodes, ReplayPolicy

    arrays = members(
        {
            "action": np.tile(STAND_ACTION, (20, 1)),
            "episode_seed": np.int64(7),
            "task": np.str_("Isaac-Move-Football-Single-G129-Dex3-Wholebody"),
            "mode": np.str_("base"),
        }
    )

    def read(path: Path) -> None:
        ReplayPolicy(path)
        ReplayEpisodes(path.parent)

    (folder / "runs").mkdir()
    return read, lambda: ("runs/mutant.npz", zipped(arrays, rng))


def datasets(folder: Path, rng: random.Random) -> Made:
    sys.path.insert(0, str(Path(__file__).parents[1] / "policies"))
    from original_dataset import write_dataset

    from arena_newton.data.readers.lerobot_reader import DatasetActions
    from arena_newton.robot.canonical import STAND_ACTION

    episodes = [{"task": "boxing", "mode": "base", "tracker": "twist2", "episode_seed": n} for n in range(2)]
    root = write_dataset(folder / "set", [np.tile(STAND_ACTION, (20, 1))] * 2, info={"arena": {"episodes": episodes}})
    sound = {path: path.read_bytes() for path in sorted(root.rglob("*")) if path.is_file()}

    def read(path: Path) -> None:
        actions = DatasetActions(root)
        actions.seeds()
        for episode in range(actions.episodes):
            actions.task(episode)
            actions.actions(episode)

    def made() -> tuple[str, bytes]:
        for path, data in sound.items():
            path.write_bytes(data)
        path = rng.choice(list(sound))
        text = path.suffix == ".json"
        return str(path.relative_to(folder)), damaged(sound[path], rng, text=text)

    return read, made


def pickles(folder: Path, rng: random.Random) -> Made:
    from arena_newton.trackers.motions.formats import read_file

    fields = {
        "fps": 30.0,
        "root_pos": np.tile([0.0, 0.0, 0.8], (20, 1)),
        "root_rot": np.tile([0.0, 0, 0, 1], (20, 1)),
        "dof_pos": np.zeros((20, 29), dtype=np.float32),
        "local_body_pos": [[1.0, 2.0]] * 4,
        "link_body_list": ["pelvis", "torso"],
    }
    asap = {
        "a": {
            "fps": 30,
            "dof": np.zeros((20, 23)),
            "root_trans_offset": fields["root_pos"],
            "root_rot": fields["root_rot"],
        }
    }
    made = [pickle.dumps(content, protocol) for content in (fields, asap) for protocol in (0, 2, 4, 5)]
    return lambda path: void(read_file(path)), lambda: ("mutant.pkl", damaged(rng.choice(made), rng))


def tables(folder: Path, rng: random.Random) -> Made:
    from arena_newton.trackers.motions.formats import read_file

    row = ",".join(["0.1", "0", "0.8", "0", "0", "0.7071", "0.7071", *["0.05"] * 29])
    data = ("\n".join([row] * 12) + "\n").encode()
    return lambda path: void(read_file(path)), lambda: ("mutant.csv", damaged(data, rng, text=rng.random() < 0.7))


def onnx(folder: Path, rng: random.Random) -> Made:
    sys.path.insert(0, str(Path(__file__).parents[1] / "trackers"))
    import onnx as library
    import torch
    from onnx_files import twist2_like

    from arena_newton.trackers.inference import onnx_mlp

    torch.set_num_threads(1)
    path = twist2_like(folder / "a.onnx", frame=10, command=4, history=8, out=5)
    data, width = path.read_bytes(), 10 * 9 + 4
    model = library.load_model_from_string(data)

    def made() -> tuple[str, bytes]:
        if rng.random() < 0.5:
            return "mutant.onnx", damaged(data, rng)
        # Sound protobuf with another graph: operators, inputs and numbers changed.
        changed = copy.deepcopy(model)
        for _ in range(rng.randrange(1, 4)):
            node, other = rng.choice(changed.graph.node), rng.choice(changed.graph.node)
            kind = rng.randrange(5)
            if kind == 0:
                node.op_type = other.op_type
            elif kind == 1 and node.input:
                node.input[rng.randrange(len(node.input))] = rng.choice(other.output)
            elif kind == 2 and node.attribute:
                attribute = rng.choice(node.attribute)
                value = rng.choice((-1, 0, 7, 2**31, 2**62, -(2**63)))
                attribute.i = value
                attribute.ints[:] = [value] * len(attribute.ints)
            elif kind == 3:
                weight = rng.choice(changed.graph.initializer)
                weight.dims[:] = [rng.choice((0, 1, -1, 2**20, 2**40)) for _ in weight.dims]
            else:
                constants = [n for n in changed.graph.node if n.op_type == "Constant"]
                tensor = rng.choice(constants).attribute[0].t
                tensor.raw_data = damaged(tensor.raw_data or b"\0" * 8, rng)[: len(tensor.raw_data)]
        return "mutant.onnx", changed.SerializeToString()

    return lambda file: void(onnx_mlp.load(file, in_width=width, out_width=5)), made


def safetensors(folder: Path, rng: random.Random) -> Made:
    import torch

    from arena_newton.robot.g1 import TWIST2_DRIVE, PhysicsRate
    from arena_newton.trackers.front_end import residual_form
    from arena_newton.trackers.inference import weights_file
    from arena_newton.trackers.interface import get

    torch.set_num_threads(1)
    network = get("twist2").make_network({"hidden": [8, 8]})
    rate = PhysicsRate(0.005, 4)
    weights = weights_file.Weights("twist2", network, residual_form(TWIST2_DRIVE), TWIST2_DRIVE, rate)
    weights_file.save(folder / "a.safetensors", weights)
    data = (folder / "a.safetensors").read_bytes()
    end = 8 + int.from_bytes(data[:8], "little")

    def made() -> tuple[str, bytes]:
        if rng.random() < 0.3:
            return "mutant.safetensors", damaged(data, rng)
        header = damaged(data[8:end], rng, text=True)
        return "mutant.safetensors", struct.pack("<Q", len(header)) + header + data[end:]

    return lambda path: void(weights_file.load(path)), made


def shards(folder: Path, rng: random.Random) -> Made:
    """Results folders of two shards of one plan, of which journal or configuration of one is damaged."""
    sys.path.insert(0, str(Path(__file__).parents[1] / "eval"))
    import contextlib
    import shutil

    from eval_fakes import factories

    from arena_newton.eval.__main__ import main
    from arena_newton.eval.workers.shard_merge import merge

    folders = [folder / name for name in ("a", "b")]
    for number, out in enumerate(folders, start=1):
        flags = "--task football boxing --engine mujoco --seeds 0 3 --repeats 2 --policy stand".split()
        with contextlib.redirect_stdout(io.StringIO()):
            assert main([*flags, "--shard", f"{number}/2", "--out", str(out)], factories()) == 0
    names = ("episodes.jsonl", "episodes.jsonl", "config.json")
    sound = {path: path.read_bytes() for out in folders for name in names if (path := out / name)}

    def read(path: Path) -> None:
        joined = folder / "joined"
        try:
            merged = merge(folders, joined, partial=rng.random() < 0.5)
            assert (joined / "report.html").is_file() and len(merged.run.records) <= 8
        finally:
            shutil.rmtree(joined, ignore_errors=True)
        assert not list(folder.glob("*.part")), "a refused merge leaves something"

    def made() -> tuple[str, bytes]:
        for path, data in sound.items():
            path.write_bytes(data)
        path = rng.choice(list(sound))
        # Faults in one line of a journal, or anywhere, and journals that lost or doubled lines.
        lines = sound[path].splitlines(keepends=True)
        at, kind = rng.randrange(len(lines)), rng.random()
        if path.suffix == ".jsonl" and kind < 0.2:
            lines[at : at + 1] = rng.choice(([], [lines[at]] * 2, lines[at : at + 1] + [b"\n"]))
            return str(path.relative_to(folder)), b"".join(lines)
        if path.suffix == ".jsonl" and kind < 0.5:
            lines[at] = damaged(lines[at], rng, text=True)
            return str(path.relative_to(folder)), b"".join(lines)
        return str(path.relative_to(folder)), damaged(sound[path], rng, text=rng.random() < 0.8)

    return read, made


def comparisons(folder: Path, rng: random.Random) -> Made:
    from tests.fuzz.damaged_comparisons import comparisons

    return comparisons(folder, rng, damaged)


def void(_: object) -> None:
    """Nothing is made of what was read."""


ALL = (usda, usdc, usdz, images, motions, recordings, datasets, pickles, tables, onnx, safetensors, shards, comparisons)
READERS = {reader.__name__: reader for reader in ALL}
KEPT: dict[str, tuple[int, ...]] = {}
"""Reader → numbers of files that meet a fault which the first 30 do not: they are read however few are asked for."""


def held() -> int:
    """Most memory of this process so far [bytes]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def results(reader: str, numbers: Iterable[int], folder: Path) -> Iterator[tuple[str, str]]:
    rng = random.Random(1)
    read, made = READERS[reader](folder, rng)
    files = []
    for number in numbers:
        rng.seed(number)
        name, data = made()
        path = folder / (f"mutant{number}.usdc" if reader == "usdc" else name)
        path.write_bytes(data)
        files.append(path)
        if reader != "usdc":
            yield once(read, path)
    if reader == "usdc":
        # All are opened by the process that may crash, then one after the other by this one.
        from arena_newton.usd_scenes import dependencies

        dependencies.probe_layers(files)
        for path in files:
            yield once(read, path)


def once(read: Reader, path: Path) -> tuple[str, str]:
    before = path.read_bytes()
    try:
        read(path)
    except InputError as error:
        text = " ".join(str(error).split())
        answer = (DAMAGED, "") if str(path.parent) in text or path.name in text else ("unnamed", text)
    except Exception:
        answer = ("raised", traceback.format_exc(limit=-4))
    else:
        answer = (READY, "")
    assert path.read_bytes() == before, "a reader changed its file"
    return answer


def main(arguments: Sequence[str] | None = None) -> None:
    reader, count, folder = arguments or sys.argv[1:]
    # Smaller than what is allowed, so that the test is quick; the counts are the same.
    limits.CRATE_MEMORY, limits.CRATE_SECONDS = 128 * limits.MIB, 5.0
    counts: dict[str, int] = {}
    faults: list[str] = []
    numbers = sorted({*range(int(count)), *KEPT.get(reader, ())})
    start, base = time.monotonic(), 0
    for answer, text in results(reader, numbers, Path(folder)):
        base = base or held()
        counts[answer] = counts.get(answer, 0) + 1
        if text:
            faults.append(f"{answer}: {text}")
    used = (held() - base) // limits.MIB
    print(json.dumps({"counts": counts, "MiB": used, "seconds": time.monotonic() - start, "faults": faults[:5]}))


if __name__ == "__main__":
    main()
