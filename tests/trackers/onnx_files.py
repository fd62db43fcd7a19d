"""ONNX files made on the spot, with the same operators as the official TWIST2 network."""

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper


class Builder:
    """Collects nodes and weights."""

    def __init__(self, seed: int = 0):
        self.rng = np.random.default_rng(seed)
        self.nodes, self.weights, self.count = [], [], 0

    def name(self) -> str:
        self.count += 1
        return f"v{self.count}"

    def constant(self, value) -> str:
        name = self.name()
        self.nodes.append(helper.make_node("Constant", [], [name], value=numpy_helper.from_array(np.asarray(value))))
        return name

    def weight(self, *shape: int, value=None) -> str:
        name = self.name()
        value = self.rng.standard_normal(shape) / np.sqrt(shape[-1]) if value is None else value
        self.weights.append(numpy_helper.from_array(np.asarray(value, dtype=np.float32), name))
        return name

    def add(self, op: str, *inputs: str, output: str | None = None, **attributes) -> str:
        output = output or self.name()
        self.nodes.append(helper.make_node(op, list(inputs), [output], **attributes))
        return output

    def linear(self, x: str, width: int, out: int, **kwargs) -> str:
        return self.add("Gemm", x, self.weight(out, width), self.weight(out), transB=1, alpha=1.0, beta=1.0, **kwargs)

    def silu(self, x: str) -> str:
        return self.add("Mul", x, self.add("Sigmoid", x))

    def columns(self, x: str, start: int, end: int) -> str:
        return self.add("Slice", x, *(self.constant(np.array([v])) for v in (start, end, 1, 1)))

    def batch(self, x: str) -> str:
        return self.add("Gather", self.add("Shape", x), self.constant(np.array(0)), axis=0)

    def rows_of(self, x: str, source: str, *rest: int, times: int = 1) -> str:
        rows = self.batch(source)
        if times > 1:
            rows = self.add("Mul", rows, self.constant(np.array(times)))
        rows = self.add("Unsqueeze", rows, axes=[0])
        target = self.add("Concat", rows, *(self.constant(np.array([n])) for n in rest), axis=0)
        return self.add("Reshape", x, target)

    def layer_norm(self, x: str, width: int) -> str:
        centred = self.add("Sub", x, self.add("ReduceMean", x, axes=[-1]))
        square = self.add("Pow", centred, self.constant(np.array(2.0, dtype=np.float32)))
        variance = self.add("ReduceMean", square, axes=[-1])
        root = self.add("Sqrt", self.add("Add", variance, self.constant(np.array(1e-5, dtype=np.float32))))
        scaled = self.add("Mul", self.add("Div", centred, root), self.weight(width, value=1 + self.rng.random(width)))
        return self.add("Add", scaled, self.weight(width))

    def save(self, path: Path, in_width: int, out_width: int) -> Path:
        graph = helper.make_graph(
            self.nodes,
            "network",
            [helper.make_tensor_value_info("input", TensorProto.FLOAT, ["batch_size", in_width])],
            [helper.make_tensor_value_info("output", TensorProto.FLOAT, ["batch_size", out_width])],
            self.weights,
        )
        onnx.save(helper.make_model(graph, opset_imports=[helper.make_opsetid("", 11)], ir_version=8), str(path))
        return path


def twist2_like(path: Path, *, frame: int = 127, command: int = 35, history: int = 10, out: int = 29) -> Path:
    """A network with the operators of the official file: normaliser, three encoders, convolutions, layer norm."""
    b = Builder()
    width = frame * (1 + history) + command
    x = b.add("Div", b.add("Sub", "input", b.weight(width)), b.weight(width, value=1 + b.rng.random(width)))
    x = b.add("Clip", x, b.constant(np.float32(-np.inf)), b.constant(np.float32(np.inf)))
    x = b.add("Cast", x, to=1)
    now = b.columns(x, 0, command)
    rest = b.columns(x, command, frame)
    past = b.columns(x, frame, frame * (1 + history))
    future = b.columns(x, frame * (1 + history), width)

    motion = b.silu(b.linear(b.rows_of(now, now, -1), command, 24))
    motion = b.add("Flatten", b.add("Transpose", b.rows_of(motion, now, 1, -1), perm=[0, 2, 1]), axis=1)
    motion = b.linear(motion, 24, 32)

    memory = b.silu(b.linear(b.rows_of(past, past, -1, times=history), frame, 20))
    memory = b.add("Transpose", b.rows_of(memory, past, history, -1), perm=[0, 2, 1])
    common = {"pads": [0, 0], "dilations": [1], "group": 1}
    memory = b.add("Conv", memory, b.weight(16, 20, 4), b.weight(16), kernel_shape=[4], strides=[2], **common)
    length = (history - 4) // 2 + 1
    memory = b.silu(memory)
    memory = b.add("Conv", memory, b.weight(8, 16, 2), b.weight(8), kernel_shape=[2], strides=[1], **common)
    memory = b.linear(b.add("Flatten", b.silu(memory), axis=1), 8 * (length - 1), 32)

    future = b.add("Reshape", future, b.constant(np.array([-1, 1, command])))
    shape_of = future
    future = b.add("Slice", future, *(b.constant(np.array([v])) for v in (0, -1, 2, 1)))
    future = b.linear(b.silu(b.linear(b.rows_of(future, shape_of, -1), command - 1, 64)), 64, 32)

    y = b.add("Concat", now, rest, motion, memory, future, axis=1)
    y = b.silu(b.linear(y, frame + 96, 256))
    y = b.silu(b.linear(y, 256, 256))
    y = b.silu(b.layer_norm(b.linear(y, 256, 128), 128))
    b.linear(y, 128, out, output="output")
    return b.save(path, width, out)
