"""The torch module made from an ONNX file computes what ONNX Runtime computes."""

import resource
from pathlib import Path

import numpy as np
import onnx
import onnxruntime
import pytest
import torch
from onnx_files import Builder, twist2_like

from arena_newton import trackers
from arena_newton.errors import InputError
from arena_newton.trackers.inference import onnx_mlp, onnx_session

OFFICIAL = Path(__file__).parents[2] / ".." / "shared" / "reference" / "twist2"


def difference(path: Path, in_width: int, out_width: int, *, rows: int = 1000) -> float:
    x = np.random.default_rng(1).standard_normal((rows, in_width)).astype(np.float32)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    expected = onnxruntime.InferenceSession(str(path), options).run(None, {"input": x})[0]
    network = onnx_mlp.load(path, in_width=in_width, out_width=out_width)
    with torch.inference_mode():
        whole = network(torch.from_numpy(x)).numpy()
        blocks = torch.cat([network(torch.from_numpy(x[i : i + 8])) for i in range(0, rows, 8)]).numpy()
    assert expected.std() > 1e-2
    return max(np.abs(whole - expected).max(), np.abs(blocks - expected).max())


@pytest.mark.parametrize("name", ["twist2_1017_20k.onnx", "twist2_1017_25k.onnx"])
def test_official_network(name):
    """The official TWIST2 files agree with ONNX Runtime to 1e-5 on 1,000 random observations."""
    if not (OFFICIAL / name).is_file():
        pytest.skip(f"the official {name} is not next to this checkout")
    assert difference(OFFICIAL / name, 1432, 29) < 1e-5


def test_same_operators(tmp_path):
    """A network with the same operators agrees to 1e-5; its weights and structure are read, not assumed."""
    assert difference(twist2_like(tmp_path / "a.onnx"), 1432, 29) < 1e-5
    small = twist2_like(tmp_path / "b.onnx", frame=50, command=9, history=8, out=5)
    assert difference(small, 459, 5) < 1e-5


def test_torch_modules_run_the_rows_of_a_gpu(tmp_path):
    """A network converted for a GPU computes as the session does; back on the CPU the session runs again."""
    session = onnx_session.OnnxSession(twist2_like(tmp_path / "a.onnx"), in_width=1432, out_width=29)
    x = torch.randn(5, 1432)
    expected = session(x)
    session.convert(torch.device("cuda"))
    assert isinstance(session.twin, onnx_mlp.OnnxNetwork) and not session.on_host
    torch.testing.assert_close(session(x), expected, atol=1e-5, rtol=1e-4)
    session.convert(torch.device("cpu"))
    assert session.on_host and torch.equal(session(x), expected)


def test_fused_and_plain_modules_agree(tmp_path):
    """Without fused calls the torch modules compute the same."""
    path, x = twist2_like(tmp_path / "a.onnx"), torch.randn(5, 1432)
    plain, fused = (onnx_mlp.load(path, in_width=1432, out_width=29, fuse=fuse) for fuse in (False, True))
    assert len(plain.layers) > len(fused.layers)
    torch.testing.assert_close(plain(x), fused(x), atol=1e-5, rtol=1e-4)


def test_shape_arithmetic_is_gone(tmp_path):
    """Activations and layer norm are one call each; no shape arithmetic is left."""
    network = onnx_mlp.load(twist2_like(tmp_path / "a.onnx"), in_width=1432, out_width=29)
    kinds = [type(layer).__name__ for layer in network.layers]
    assert kinds.count("SiLU") == 8 and len(kinds) < 50


@pytest.mark.parametrize("activation", ["Relu", "Elu", "Tanh", "LeakyRelu", "Softplus", "Softmax"])
def test_plain_mlp(tmp_path, activation):
    """Plain layers with MatMul and Add and other activations are read too."""
    b = Builder()
    x = b.add("Add", b.add("MatMul", "input", b.weight(12, 20)), b.weight(20))
    b.add("Add", b.add("MatMul", b.add(activation, x), b.weight(20, 4)), b.weight(4), output="output")
    assert difference(b.save(tmp_path / "plain.onnx", 12, 4), 12, 4, rows=100) < 1e-5


def test_wrong_width(tmp_path):
    """A network of the wrong width is refused with flag, file and both widths."""
    path = twist2_like(tmp_path / "narrow.onnx", frame=50, command=9, history=8, out=5)
    with pytest.raises(InputError, match=r"^--checkpoint .*narrow.onnx: the network takes 459 numbers, expected 1432$"):
        trackers.get("twist2", path)
    path = twist2_like(tmp_path / "few.onnx", out=28)
    with pytest.raises(InputError, match=r"few.onnx: the network gives 28 numbers, expected 29$"):
        trackers.get("twist2", path)


def tracking_export(path, *, timed=False):
    """A tracking network as mjlab exports it: observation and time step in, actions and the motion of that step out."""
    b = Builder()
    observation = b.add("Add", "obs", "time_step") if timed else "obs"
    b.linear(b.add("Elu", b.linear(observation, 154, 32), alpha=1.0), 32, 29, output="actions")
    names = ["joint_pos", "joint_vel", "body_pos_w", "body_quat_w", "body_lin_vel_w", "body_ang_vel_w"]
    for name in names:
        step = b.add("Squeeze", b.add("Cast", "time_step", to=7), axes=[1])
        b.add("Gather", b.weight(50, 29), step, axis=0, output=name)
    info = onnx.helper.make_tensor_value_info
    graph = onnx.helper.make_graph(
        b.nodes,
        "network",
        [info("obs", 1, [1, 154]), info("time_step", 1, [1, 1])],
        [info(name, 1, [1, 29]) for name in ("actions", *names)],
        b.weights,
    )
    onnx.save(onnx.helper.make_model(graph, opset_imports=[onnx.helper.make_opsetid("", 11)], ir_version=8), str(path))
    return path


def test_a_training_programs_export_is_read(tmp_path):
    """Both readers of an export with a time step and its motion run the network from first input to first output."""
    path = tracking_export(tmp_path / "a.onnx")
    x = torch.randn(3, 154)
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    whole = onnxruntime.InferenceSession(str(path), options)
    step = np.full((1, 1), 7, np.float32)
    expected = np.concatenate([whole.run(None, {"obs": row[None], "time_step": step})[0] for row in x.numpy()])
    session = onnx_session.OnnxSession(path, in_width=154, out_width=29)
    assert np.array_equal(session(x).numpy(), expected)
    with torch.inference_mode():
        assert np.abs(onnx_mlp.load(path, in_width=154, out_width=29)(x).numpy() - expected).max() < 1e-5
    with pytest.raises(InputError, match="the network takes 154 numbers, expected 155"):
        onnx_session.OnnxSession(path, in_width=155, out_width=29)


def test_actions_that_depend_on_the_time_are_refused(tmp_path):
    """A network whose actions a further input decides is refused by that input's name."""
    with pytest.raises(InputError, match="its output actions depends on a further input, time_step"):
        onnx_session.OnnxSession(tracking_export(tmp_path / "a.onnx", timed=True), in_width=154, out_width=29)


def test_unknown_operator(tmp_path):
    """An operator that has no torch module is named."""
    b = Builder()
    b.add("Selu", "input", output="output")
    path = b.save(tmp_path / "odd.onnx", 12, 12)
    with pytest.raises(InputError, match="Selu"):
        onnx_mlp.load(path, in_width=12, out_width=12)


def test_weights_elsewhere(tmp_path):
    """A file whose weights lie in another file is refused."""
    path = twist2_like(tmp_path / "a.onnx")
    model = onnx.load(str(path))
    onnx.save(model, str(tmp_path / "b.onnx"), save_as_external_data=True, size_threshold=16, location="b.bin")
    with pytest.raises(InputError, match="another file"):
        trackers.get("twist2", tmp_path / "b.onnx")


def outer(b: Builder) -> None:
    """A column and a row make a table of 3.6e9 numbers."""
    table = b.add("Add", b.weight(60_000, 1), b.weight(1, 60_000))
    x = b.add("MatMul", "input", b.weight(12, 4))
    b.add("Add", x, b.add("ReduceMean", table, axes=[0, 1], keepdims=0), output="output")


def doubled(b: Builder) -> None:
    """Rows joined to themselves thirty times."""
    x = "input"
    for _ in range(30):
        x = b.add("Concat", x, x, axis=1)
    b.add("MatMul", b.columns(x, 0, 12), b.weight(12, 4), output="output")


def gathered(b: Builder) -> None:
    """One row taken a million times, twice."""
    index = b.constant(np.zeros(1_000_000, dtype=np.int64))
    x = b.add("Gather", b.add("Gather", "input", index, axis=1), index, axis=0)
    b.add("MatMul", b.columns(x, 0, 12), b.weight(12, 4), output="output")


def padded(b: Builder) -> None:
    """A convolution that is padded to 2^40 places."""
    x = b.add("Unsqueeze", "input", axes=[1])
    x = b.add("Conv", x, b.weight(1, 1, 3), pads=[2**39, 2**39], kernel_shape=[3])
    b.add("MatMul", b.columns(b.add("Flatten", x), 0, 12), b.weight(12, 4), output="output")


@pytest.mark.parametrize("graph", [outer, doubled, gathered, padded])
def test_graphs_that_would_take_memory(tmp_path, graph):
    """Sizes of an operator's result are known before it is made: a small file cannot ask for gigabytes."""
    b = Builder()
    graph(b)
    path = b.save(tmp_path / "bomb.onnx", 12, 4)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(InputError, match=r"bomb\.onnx: .* makes more than 67108864 numbers of 7 rows"):
        onnx_mlp.load(path, in_width=12, out_width=4)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 600_000


def test_a_runtime_is_probed_first(tmp_path):
    """A file is opened by another process first: its memory is not ours."""
    b = Builder()
    zeros = b.add("ConstantOfShape", b.constant(np.array([2**33])))
    x = b.add("Add", b.add("MatMul", "input", b.weight(12, 4)), b.add("ReduceMean", zeros, axes=[0], keepdims=0))
    b.add("Selu", x, output="output")
    path = b.save(tmp_path / "bomb.onnx", 12, 4)
    with pytest.raises(InputError, match=r"bomb\.onnx: not a usable ONNX file"):
        onnx_session.OnnxSession(path, in_width=12, out_width=4)
    b = Builder()
    b.add("Selu", b.add("MatMul", "input", b.weight(12, 4)), output="output")
    session = onnx_session.OnnxSession(b.save(tmp_path / "good.onnx", 12, 4), in_width=12, out_width=4)
    assert session(torch.zeros(3, 12)).shape == (3, 4)
