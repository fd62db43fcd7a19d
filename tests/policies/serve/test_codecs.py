"""The bytes of each protocol: golden frames read and written, and what no codec lets in.

The golden frames were made with plain `msgpack.packb` and hooks written after the formats that each codec names as its
source, not with the codecs and not with installed servers of those projects.
"""

import base64
import dataclasses
import io
import json
import struct

import msgpack
import numpy as np
import pytest
from PIL import Image
from served_policies import query, state

from arena_newton.errors import InputError
from arena_newton.policies.protocols import arena_codec, openpi_codec, vla_eval_codec
from arena_newton.policies.protocols.handshake import (
    ServedFacts,
    ServedPicture,
    compare_facts,
    expected_facts,
    read_facts,
)
from arena_newton.policies.protocols.packed_arrays import (
    MAX_DEPTH,
    MAX_OBJECTS,
    MAX_TEXT,
    OPENPI_KEYS,
    TEXT_KEYS,
    pack,
    unpack,
)
from arena_newton.policies.protocols.policy_messages import Begin, End, Query
from arena_newton.policies.protocols.raw_arrays import MAX_FRAME
from arena_newton.policies.protocols.wire_error import WireError
from arena_newton.robot.canonical import STATE_WIDTH

ONE, NONE = "0000803f", "00000000"
STATE_HEX = ONE + NONE * 2 + ONE + NONE * 60
"""64 numbers float32, little-endian: no rotation, everything else 0."""
ACTION_HEX = NONE * 2 + "cdcc4c3f" + ONE + NONE * 2 + ONE + NONE * 33
"""40 numbers: height 0.8 m, no rotation."""
OPENPI_ARRAY, DATA, DTYPE, SHAPE = "c40b5f5f6e6461727261795f5fc3", "c40464617461", "c4056474797065", "c4057368617065"
TEXT_ARRAY, TEXT_DATA, TEXT_DTYPE, TEXT_SHAPE = (
    "ab5f5f6e6461727261795f5fc3",
    "a464617461",
    "a56474797065",
    "a57368617065",
)
F4 = "a33c6634"
TAIL = "a974696d657374616d70cb4004000000000000"
"""`timestamp` 2.5."""
OPENPI_REQUEST = (
    f"82b16f62736572766174696f6e2f737461746584{OPENPI_ARRAY}{DATA}c50100{STATE_HEX}{DTYPE}{F4}{SHAPE}9140"
    "a670726f6d7074a4426f782e"
)
OPENPI_ANSWER = (
    f"82a7616374696f6e7384{OPENPI_ARRAY}{DATA}c4a0{ACTION_HEX}{DTYPE}{F4}{SHAPE}920128"
    "ad7365727665725f74696d696e6781a8696e6665725f6d73cb3ff8000000000000"
)
ROBOARENA_RESET = "82a8656e64706f696e74a57265736574aa73657373696f6e5f6964a130"
VLA_HELLO = (
    "84a474797065a568656c6c6fa77061796c6f616482af6861726e6573735f76657273696f6ea5302e382e30"
    f"b070726f746f636f6c5f76657273696f6e01a373657101{TAIL}"
)
VLA_START = (
    f"84a474797065ad657069736f64655f7374617274a77061796c6f616481a47461736b81a46e616d65a6626f78696e67a373657102{TAIL}"
)
VLA_LOOK = (
    "84a474797065ab6f62736572766174696f6ea77061796c6f616483a6696d6167657380a6737461746573"
    f"84{TEXT_ARRAY}{TEXT_DATA}c50100{STATE_HEX}{TEXT_DTYPE}{F4}{TEXT_SHAPE}9140"
    f"b07461736b5f6465736372697074696f6ea4426f782ea373657103{TAIL}"
)
VLA_ACTION = (
    "84a474797065a6616374696f6ea77061796c6f616481a7616374696f6e73"
    f"84{TEXT_ARRAY}{TEXT_DATA}c4a0{ACTION_HEX}{TEXT_DTYPE}{F4}{TEXT_SHAPE}9128a373657103{TAIL}"
)
VLA_ERROR = f"84a474797065a56572726f72a77061796c6f616481a56572726f72a26e6fa373657103{TAIL}"
ACTION = np.zeros((1, 40), dtype=np.float32)
ACTION[0, [2, 3, 6]] = 0.8, 1.0, 1.0


def test_golden_openpi():
    """Openpi's request and answer are these bytes, read and written."""
    request, roboarena = openpi_codec.unpack_request(bytes.fromhex(OPENPI_REQUEST))
    assert not roboarena and np.array_equal(request.state, state()) and request.instruction == "Box."
    assert request.image is None and request.seed is None and request.step is None and request.session == ""
    written = openpi_codec.pack_request(Query(state(), instruction="Box."), extras=False)
    assert written.hex() == OPENPI_REQUEST
    assert np.array_equal(openpi_codec.unpack_answer(bytes.fromhex(OPENPI_ANSWER), "server"), ACTION)
    assert openpi_codec.pack_answer(ACTION, 1.5).hex() == OPENPI_ANSWER


def test_golden_roboarena():
    """RoboArena's reset is these bytes, and its answers hold the chunk as `action`, too."""
    assert openpi_codec.unpack_request(bytes.fromhex(ROBOARENA_RESET)) == (Begin("0"), True)
    assert openpi_codec.pack_request(Begin("0"), roboarena=True).hex() == ROBOARENA_RESET
    answer = unpack(openpi_codec.pack_answer(ACTION, 1.5, roboarena=True), OPENPI_KEYS, "x")
    assert np.array_equal(answer["action"], ACTION) and np.array_equal(answer["actions"], ACTION)
    metadata = unpack(openpi_codec.pack_metadata(expected_facts(), roboarena=True), OPENPI_KEYS, "x")
    fields = "image_resolution needs_wrist_camera n_external_cameras needs_stereo_camera needs_session_id action_space"
    assert list(metadata) == fields.split()
    picture = ServedPicture(64, 64)
    for names, counts in (((), (False, 0)), (("front",), (False, 1)), (("left_wrist",), (True, 0))):
        facts = ServedFacts(needs_picture=bool(names), cameras=dict.fromkeys(names, picture) or None)
        metadata = unpack(openpi_codec.pack_metadata(facts, roboarena=True), OPENPI_KEYS, "x")
        assert (metadata["needs_wrist_camera"], metadata["n_external_cameras"]) == counts, names


def test_golden_vla_eval():
    """vla-eval's messages are these bytes, read and written."""
    facts, chunks = vla_eval_codec.unpack_hello(vla_eval_codec.unpack_message(bytes.fromhex(VLA_HELLO)), "robot")
    assert facts == ServedFacts() and not chunks
    start = vla_eval_codec.unpack_message(bytes.fromhex(VLA_START))
    assert start.seq == 2 and start.timestamp == 2.5
    assert vla_eval_codec.unpack_request(start) == Begin("", None, "boxing")
    assert vla_eval_codec.pack_message("episode_start", {"task": {"name": "boxing"}}, 2, 2.5).hex() == VLA_START
    seen = vla_eval_codec.unpack_request(vla_eval_codec.unpack_message(bytes.fromhex(VLA_LOOK)))
    assert np.array_equal(seen.state, state()) and seen.instruction == "Box." and seen.image is None
    payload = {"images": {}, "states": state(), "task_description": "Box."}
    assert vla_eval_codec.pack_message("observation", payload, 3, 2.5).hex() == VLA_LOOK
    action = vla_eval_codec.unpack_message(bytes.fromhex(VLA_ACTION))
    assert np.array_equal(vla_eval_codec.unpack_action(action, 3, "server"), ACTION)
    assert vla_eval_codec.pack_action(ACTION[0], 3, 2.5).hex() == VLA_ACTION
    assert vla_eval_codec.pack_error("no", 3, 2.5).hex() == VLA_ERROR
    with pytest.raises(WireError, match="^server: the server says no$"):
        vla_eval_codec.unpack_action(vla_eval_codec.unpack_message(bytes.fromhex(VLA_ERROR)), 3, "server")
    with pytest.raises(WireError, match="answer to query 3, expected that to 4"):
        vla_eval_codec.unpack_action(action, 4, "server")


def test_golden_arena():
    """The original's request is read as its client sends it, without what is ours; the reply has its three keys."""
    pixels = bytes(range(256)) * 3
    front = {"shape": [16, 16, 3], "dtype": "uint8", "data_b64": base64.b64encode(pixels).decode()}
    body = {"observation": {"images": {"front": front}, "state": [float(v) for v in state()]}}
    body |= {"robot_type": "unitree_g1_refpose_v3_1", "return_chunk": True, "task": "Isaac-Move-Boxing"}
    seen, chunk = arena_codec.unpack_query(json.dumps(body).encode())
    assert chunk and seen.task == "Isaac-Move-Boxing" and seen.session == "" and seen.seed is None
    assert seen.image.tobytes() == pixels and np.array_equal(seen.state, state())
    reply = json.loads(arena_codec.pack_chunk(ACTION))
    assert list(reply) == ["action", "action_chunk", "chunk_size"] and reply["chunk_size"] == 1
    assert np.array_equal(np.float32(reply["action_chunk"]), ACTION)
    assert list(json.loads(arena_codec.pack_chunk(ACTION, chunk=False))) == ["action"]
    assert arena_codec.unpack_begin(b'{"seed": 42}') == Begin("", 42) and arena_codec.unpack_begin(b"") == Begin()


def test_records_come_back():
    """Every record is the same after each codec, pictures of all cameras to the bit (PNG is lossless)."""
    rng = np.random.default_rng(0)
    images = {name: rng.integers(0, 255, (24, 32, 3), np.uint8) for name in ("front", "left_wrist", "world")}
    seen = dataclasses.replace(query(0.3, session="3", seed=2**31 - 1, step=40), images=images)

    def same(got):
        assert np.array_equal(got.state, seen.state) and [*got.images] == [*images]
        for name, image in got.images.items():
            assert np.array_equal(image if isinstance(image, np.ndarray) else image.unpacked(), images[name])
        named = ("task", "instruction", "session", "seed", "step")
        assert [getattr(got, name) for name in named] == [getattr(seen, name) for name in named]

    same(openpi_codec.unpack_request(openpi_codec.pack_request(seen, roboarena=True))[0])
    for form in ("png", "raw"):
        frame = vla_eval_codec.pack_request(seen, 1, 0.0, form)
        same(vla_eval_codec.unpack_request(vla_eval_codec.unpack_message(frame)))
    same(arena_codec.unpack_query(arena_codec.pack_query(seen))[0])
    begin = Begin("3", 5, "boxing", "Box.")
    assert openpi_codec.unpack_request(openpi_codec.pack_request(begin, roboarena=True))[0] == begin
    for request in (begin, End("3", {"session": "3"})):
        frame = vla_eval_codec.pack_request(request, 1, 0.0)
        assert vla_eval_codec.unpack_request(vla_eval_codec.unpack_message(frame)) == request
    assert arena_codec.unpack_begin(arena_codec.pack_begin(begin)) == begin
    with pytest.raises(WireError, match="no message for the beginning"):
        openpi_codec.pack_request(begin)


@pytest.mark.parametrize("keys", [OPENPI_KEYS, TEXT_KEYS])
@pytest.mark.parametrize(
    "dtype", "bool int8 uint8 int16 uint16 int32 uint32 int64 uint64 float16 float32 float64 >f4".split()
)
def test_arrays_come_back(keys, dtype):
    """Arrays of every allowed type come back in the machine's byte order, writable, empty ones too."""
    array = np.arange(6).reshape(2, 3).astype(dtype)
    got = unpack(pack({"a": array, "b": array[:0]}, keys), keys, "x")
    assert np.array_equal(got["a"], array) and got["a"].dtype == array.dtype.newbyteorder("=") and got["a"].flags["W"]
    assert got["b"].shape == (0, 3)


def test_numbers_of_numpy():
    """Openpi marks NumPy's numbers, vla-eval writes plain ones."""
    assert pack({"a": np.float32(1.5)}, OPENPI_KEYS).hex() == (
        "81a16183c40d5f5f6e7067656e657269635f5fc3c40464617461cb3ff8000000000000c4056474797065a33c6634"
    )
    assert unpack(pack({"a": np.int64(-3)}, OPENPI_KEYS), OPENPI_KEYS, "x") == {"a": -3}
    assert pack({"a": np.float32(1.5)}, TEXT_KEYS) == msgpack.packb({"a": 1.5})


def array_map(data=b"\0" * 8, dtype="<f4", shape=(2,), marker=True):
    return msgpack.packb({b"__ndarray__": marker, b"data": data, b"dtype": dtype, b"shape": shape})


def nested(depth):
    return b"\x91" * depth + b"\xc0"


UNFIT = {
    "empty": (b"", "breaks off"),
    "object": (array_map(dtype="|O"), r"type '\|O'"),
    "void": (array_map(dtype="|V8"), "expected bool, integers or floats"),
    "complex": (array_map(dtype="<c8", shape=(1,)), "expected bool, integers or floats"),
    "text array": (array_map(dtype="<U2", shape=(1,)), "expected bool, integers or floats"),
    "dates": (array_map(dtype="<M8[s]", shape=(1,)), "expected bool, integers or floats"),
    "fields": (array_map(dtype="<f4,<f4", shape=(1,)), "expected bool, integers or floats"),
    "long double": (array_map(dtype="<f16", shape=()), "expected bool, integers or floats"),
    "too few bytes": (array_map(shape=(3,)), r"shape \[3\] of float32 with 8 bytes"),
    "too many bytes": (array_map(shape=(1,)), "with 8 bytes"),
    "huge": (array_map(data=b"", shape=(2**20, 2**20, 2**20, 0)), None),
    "overflow": (array_map(shape=(2**40, 2**40)), "an array of shape"),
    "minus": (array_map(shape=(-2,)), "an array of shape"),
    "fraction": (array_map(shape=(2.0,)), "an array of shape"),
    "dimensions": (array_map(shape=(1,) * 40), "at most 8 dimensions"),
    "text as data": (array_map(data="12345678"), "with 0 bytes"),
    "deep": (nested(MAX_DEPTH + 2), f"more than {MAX_DEPTH} lists and maps"),
    "very deep": (nested(100_000), f"more than {MAX_DEPTH} lists and maps"),
    "many": (b"\xdc\x04\x00" + (b"\xdc\x10\x00" + b"\xc0" * 4096) * 1024, f"more than {MAX_OBJECTS} values"),
    "a long list": (b"\xdd\xff\xff\xff\xff", "4294967295 entries"),
    "a long map": (b"\xdf\x7f\xff\xff\xff", "2147483647 entries"),
    "a long text": (b"\xdb\x00\x02\x00\x00" + b"a" * 131072, f"expected at most {MAX_TEXT}"),
    "bytes that break off": (b"\xc6\xff\xff\xff\xff", "breaks off"),
    "extension": (b"\xc7\x01\x01a", "data only"),
    "timestamp": (b"\xd6\xff" + struct.pack(">I", 1), "data only"),
    "bytes after its end": (b"\xc0\xc0", "after its end"),
    "number as key": (msgpack.packb({1: 2}), "not MessagePack"),
    "no text": (b"\xa2\xff\xfe", "not MessagePack"),
    "key that is no text": (msgpack.packb({b"\xff": 1}), "a key is not text"),
    "too long": (b"\xc6" + struct.pack(">I", MAX_FRAME) + bytes(MAX_FRAME), f"expected at most {MAX_FRAME}"),
}


@pytest.mark.parametrize("case", UNFIT)
def test_limits_of_messages(case):
    """A frame beyond the limits, or with an array of objects, is refused in one line before anything is made of it."""
    data, message = UNFIT[case]
    if message is None:
        assert unpack(data, OPENPI_KEYS, "x").size == 0
        return
    with pytest.raises(WireError, match=message) as caught:
        unpack(data, OPENPI_KEYS, "x")
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("value", [np.array([object()]), np.zeros(2, complex), np.zeros(1, "M8[s]"), object(), 2**70])
def test_nothing_else_is_written(value):
    """Objects, complex numbers and dates are never sent."""
    with pytest.raises(WireError):
        pack({"a": value}, OPENPI_KEYS)


def picture(form, size=(24, 32), **more):
    file = io.BytesIO()
    Image.new("RGB", size[::-1], (10, 20, 30)).save(file, form)
    return {"__image__": True, "format": form.lower(), "data": file.getvalue(), "shape": [*size, 3]} | more


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (picture("GIF"), "format 'gif'"),
        (picture("PNG", format="jpeg"), "not a picture of format jpeg"),
        (picture("PNG", data=b"abc"), "not a picture of format png"),
        (picture("PNG", data="abc"), "expected png, jpeg or raw"),
        (picture("PNG", size=(5000, 20)), "20x5000"),
        (picture("PNG", size=(8, 8)), "8x8"),
        ({"__image__": True, "format": "raw", "data": b"12", "dtype": "|O", "shape": [2]}, "expected bool"),
    ],
)
def test_pictures_of_vla_eval(content, message):
    """A picture that is none, or too large, is refused before it is unpacked."""
    frame = msgpack.packb({"type": "observation", "payload": {"images": {"a": content}}, "seq": 1, "timestamp": 0.0})
    with pytest.raises(WireError, match=message):
        vla_eval_codec.unpack_message(frame)


def test_a_gray_picture_becomes_rgb():
    """A PNG without colours is a picture, too."""
    file = io.BytesIO()
    Image.new("L", (32, 24), 7).save(file, "PNG")
    content = {"__image__": True, "format": "png", "data": file.getvalue(), "shape": [24, 32, 1]}
    payload = {"images": {"cam": content}, "states": [1.0] * STATE_WIDTH}
    frame = msgpack.packb({"type": "observation", "payload": payload, "seq": 1, "timestamp": 0.0})
    seen = vla_eval_codec.unpack_request(vla_eval_codec.unpack_message(frame))
    assert seen.image.unpacked().shape == (24, 32, 3) and (seen.image.unpacked() == 7).all()


def test_a_float32_picture_of_the_original_s_protocol():
    """Pixels as float32, whole numbers from 0 to 255, are the same picture as uint8."""
    pixels = np.random.default_rng(0).integers(0, 256, (16, 16, 3), np.uint8)
    seen, _ = _front(dtype="float32", data_b64=base64.b64encode(pixels.astype("<f4")).decode())()
    assert np.array_equal(seen.image, pixels)


def _openpi(**more):
    content = {"observation/state": state(), "prompt": "Box."} | more
    return lambda: openpi_codec.unpack_request(pack(content, OPENPI_KEYS))


def _arena(**more):
    body = {"observation": {"state": [0.0] * 64}} | more
    return lambda: arena_codec.unpack_query(json.dumps(body).encode())


def _front(**more):
    front = {"shape": [16, 16, 3], "dtype": "uint8", "data_b64": base64.b64encode(bytes(768)).decode()} | more
    return _arena(observation={"state": [0.0] * 64, "images": {"front": front}})


@pytest.mark.parametrize(
    ("work", "message"),
    [
        (lambda: openpi_codec.unpack_request("hello"), "a text frame"),
        (lambda: openpi_codec.unpack_request(b"\x90"), "list, expected a map"),
        (_openpi(**{"observation/state": state()[:63]}), r"state has shape \[63\], expected \[64\]"),
        (_openpi(**{"observation/state": None}), "NoneType, expected numbers"),
        (_openpi(**{"observation/state": state() * np.nan}), r"state\[0\] is nan"),
        (_openpi(**{"observation/image": np.zeros((16, 16, 3))}), "the picture is float64, expected uint8"),
        (_openpi(**{"observation/image": np.zeros((3, 16, 16), np.uint8)}), r"expected \[H, W, 3\]"),
        (_openpi(endpoint="kill"), "endpoint 'kill', expected infer or reset"),
        (_openpi(seed=-1), "seed is '-1'"),
        (_openpi(step=1.5), "step is '1.5'"),
        (_openpi(seed=True), "seed is 'True'"),
        (_openpi(prompt=3), "prompt is not a text"),
        (lambda: vla_eval_codec.unpack_message(b"\x81\xa4type\xa5hello"), "without payload seq timestamp"),
        (lambda: arena_codec.unpack_query(b"{"), "not JSON"),
        (lambda: arena_codec.unpack_query(b"[" * 60_000), "not JSON"),
        (lambda: arena_codec.unpack_query(b"[]"), "the body is a list"),
        (lambda: arena_codec.unpack_query(b'{"observation": {"state": [NaN]}}'), "not JSON"),
        (_arena(observation=1), "observation is int"),
        (_arena(observation={"state": [0.0] * 63 + [True]}), "not a number"),
        (_arena(observation={"state": [[0.0], [1.0, 2.0]]}), "rows of different length"),
        (_arena(return_chunk=1), "return_chunk is int"),
        (_arena(world=2**40), "world is"),
        (_front(dtype="object"), "dtype is 'object', expected uint8 or float32"),
        (_front(dtype="float32", data_b64=base64.b64encode(np.full(768, 0.5, "<f4")).decode()), "whole numbers from 0"),
        (_front(dtype="float32", data_b64=base64.b64encode(np.full(768, np.nan, "<f4")).decode()), "whole numbers"),
        (_front(data_b64="****"), "not base64"),
        (_front(shape=[16, 16, 4]), "with 768 bytes"),
        (_front(shape="16"), "without a shape"),
    ],
)
def test_unfit_requests(work, message):
    """An unfit request is one line that names the fault."""
    with pytest.raises(WireError, match=message) as caught:
        work()
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 300


def test_a_traceback_is_one_line():
    """Text of another server is shown as its last line, cleared of control characters."""
    text = "Traceback (most recent call last):\n  File x\nKeyError: \x1b[31m'observation/joint_position'\n"
    with pytest.raises(WireError, match="^server: the server says KeyError: 'observation/joint_position'$"):
        openpi_codec.unpack_answer(text, "server")


def test_handshake_comes_back():
    """Declared facts are the same behind every protocol, also where they are few."""
    few = ServedFacts(picture=ServedPicture(64, 48, "native"), chunk_length=20, realign=0.002, facts={"family": "act"})
    eyes = {"left_wrist": ServedPicture(64, 48, "native"), "world": ServedPicture(32, 32)}
    for facts in (expected_facts("v4"), ServedFacts(), few, ServedFacts(needs_picture=True, cameras=eyes)):
        assert openpi_codec.unpack_metadata(openpi_codec.pack_metadata(facts), "s")[0] == facts
        hello = vla_eval_codec.unpack_message(vla_eval_codec.pack_hello(facts, 1, 0.0))
        assert vla_eval_codec.unpack_hello(hello, "s") == (facts, True)
        assert arena_codec.unpack_config(arena_codec.pack_config(facts, {"protocol": "arena"}), "s") == facts
    assert ServedFacts().undeclared() == [
        "label protocol",
        "action names",
        "state names",
        "chunk length",
        "rate",
        "picture",
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (3, "metadata is int"),
        ({"arena": 2}, "handshake has version 2, expected 1"),
        ({"arena": 1, "labels": "v5"}, "declares: labels is"),
        ({"arena": 1, "action_names": [1]}, "declares: action_names is"),
        ({"arena": 1, "chunk_length": -1}, "declares: chunk_length is"),
        ({"arena": 1, "rate_hz": 0}, "declares: rate_hz is"),
        ({"arena": 1, "picture": {"width": 224}}, "declares: picture is"),
        ({"arena": 1, "cameras": {"front": {"width": 224}}}, "declares: cameras is"),
        ({"arena": 1, "cameras": {"rear": {"width": 64, "height": 64}}}, "declares: cameras is"),
        ({"arena": 1, "realign": 2}, "declares: realign is"),
        ({"arena": 1, "batched": 1}, "declares: batched is"),
    ],
)
def test_damaged_handshakes(content, message):
    """A damaged declaration is refused by the name of what is wrong."""
    with pytest.raises(WireError, match=message):
        read_facts(content, "s")


def test_handshakes_are_compared():
    """A server of another robot, order, rate or label protocol is refused with both values; silence is not."""
    ours = expected_facts()
    compare_facts(ours, ours, "s")
    compare_facts(ServedFacts(), ours, "s")
    swapped = list(ours.action_names)
    swapped[9], swapped[10] = swapped[10], swapped[9]
    cases = [
        (ServedFacts(labels="v4"), "label protocol v4, the robot takes v3.1"),
        (
            ServedFacts(action_names=tuple(swapped)),
            "number 9 of the server's action is action.joint_pos.right_hip_pitch",
        ),
        (ServedFacts(action_names=("a",)), "action has 1 numbers, the robot's 40"),
        (ServedFacts(state_names=("a",) * 64), "number 0 of the server's state is a, of the robot's state.root"),
        (ServedFacts(rate_hz=30.0), "for 30 Hz, the robot executes 50 Hz"),
    ]
    for declared, message in cases:
        with pytest.raises(InputError, match=message):
            compare_facts(declared, ours, "s")
    pictures = ServedFacts(picture=ServedPicture(224, 224)), ServedFacts(picture=ServedPicture(640, 480, "native"))
    with pytest.raises(InputError, match="wants pictures of 224x224, pad, the robot sends pictures of 640x480, native"):
        compare_facts(*pictures, "s")
    with pytest.raises(InputError, match="chunks have 20 actions, the robot expects 50"):
        compare_facts(ServedFacts(chunk_length=20), ServedFacts(chunk_length=50), "s")
