"""A small feed-forward ONNX network as a torch module, for CUDA graphs: weights and structure come from the file.

The graph is evaluated once, node by node, on a probe batch. That fixes every shape, so the shape arithmetic that
exporters leave in the graph disappears; what remains becomes a short list of torch modules in which common groups are
one call (`x * sigmoid(x)`, layer normalisation, a convolution as one matrix product). A second batch of another size
checks the short list against the node-by-node evaluation.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import onnx
import torch
from torch.nn import functional

from arena_newton.errors import InputError
from arena_newton.files import limits
from arena_newton.files.untrusted_files import read_bytes

__all__ = ["OnnxNetwork", "load", "metadata", "read"]

_PROBE_ROWS = 7
"""Rows of the probe batch; a prime, so that a reshaped first dimension shows how it depends on the batch."""
_CHECK_ROWS = 5
_CHECK_TOLERANCE = 1e-4
"""Largest allowed difference of the short list from the node-by-node evaluation, relative to the largest output."""
_CONV_MATRIX_LIMIT = 1_000_000
"""Largest matrix [numbers] that replaces a convolution."""

_UNARY: dict[str, Callable[[torch.Tensor], torch.Tensor]] = {
    "Sigmoid": torch.sigmoid,
    "Tanh": torch.tanh,
    "Relu": torch.relu,
    "Sqrt": torch.sqrt,
    "Exp": torch.exp,
    "Neg": torch.neg,
    "Abs": torch.abs,
    "Softplus": functional.softplus,
    "Erf": torch.erf,
}
_BINARY: dict[str, Callable[[torch.Tensor, torch.Tensor], torch.Tensor]] = {
    "Add": torch.add,
    "Sub": torch.sub,
    "Mul": torch.mul,
    "Div": torch.div,
    "Pow": torch.pow,
    "MatMul": torch.matmul,
}
_SAME = frozenset({"Identity", "Dropout", "Cast", "Clip"})


Step = tuple[torch.nn.Module, tuple[str, ...], str]
"""A module, the names of its inputs and of its output."""
Node = tuple[str, list[str], list[str], dict[str, Any]]
"""Operator, inputs, outputs, attributes."""


class _Unfit(Exception):
    """The graph holds something that this reader does not know."""


class _Call(torch.nn.Module):
    """A function with some arguments that are constant."""

    def __init__(self, function: Callable[..., torch.Tensor], constants: dict[int, torch.Tensor] | None = None):
        super().__init__()
        self.function = function
        constants = constants or {}
        self.positions = tuple(sorted(constants))
        for position in self.positions:
            self.register_buffer(f"constant_{position}", constants[position].contiguous())

    def forward(self, *dynamic: torch.Tensor) -> torch.Tensor:
        arguments = list(dynamic)
        for position in self.positions:
            arguments.insert(position, getattr(self, f"constant_{position}"))
        return self.function(*arguments)


def _linear(weight: torch.Tensor, bias: torch.Tensor | None) -> _Call:
    return _Call(functional.linear, {1: weight} | ({} if bias is None else {2: bias}))


class OnnxNetwork(torch.nn.Module):
    """The converted graph: maps [rows, in_width] to [rows, out_width], float32."""

    def __init__(self, graph: _Graph):
        """Compile a graph; see `load`."""
        super().__init__()
        self.layers = torch.nn.ModuleList([module for module, _, _ in graph.steps])
        self._calls = [(module.forward, inputs, output) for module, inputs, output in graph.steps]
        self._input, self._output = graph.input, graph.output

    def forward(self, x: torch.Tensor) -> torch.Tensor:
        """Outputs of all rows, shape [rows, out_width]."""
        values = {self._input: x}
        for call, inputs, output in self._calls:
            values[output] = call(*[values[name] for name in inputs])
        return values[self._output]


class _Graph:
    """One ONNX graph with its probe values, and the list of modules made from it."""

    def __init__(self, model: onnx.ModelProto, in_width: int, *, fuse: bool = True):
        self._fuse = fuse
        graph = model.graph
        if len(graph.node) > limits.NETWORK_NODES:
            raise _Unfit(f"it has {len(graph.node)} nodes, expected at most {limits.NETWORK_NODES}")
        constants = {i.name: onnx.numpy_helper.to_array(i) for i in graph.initializer}
        self.constants = {name: torch.from_numpy(value.copy()) for name, value in constants.items()}
        inputs = [i for i in graph.input if i.name not in self.constants]
        if len(inputs) != 1 or len(graph.output) != 1:
            raise _Unfit(f"it has {len(inputs)} inputs and {len(graph.output)} outputs, expected one of each")
        dims = inputs[0].type.tensor_type.shape.dim
        if len(dims) != 2 or dims[1].dim_value < 1:
            raise _Unfit("its input is not of shape [rows, width]")
        if dims[1].dim_value != in_width:
            raise _Unfit(f"it takes {dims[1].dim_value} numbers, expected {in_width}")
        self.input, self.output, self.in_width = inputs[0].name, graph.output[0].name, in_width
        self.nodes = [(n.op_type, list(n.input), list(n.output), _attributes(n)) for n in graph.node]
        self.producer = {out: node for node in self.nodes for out in node[2]}
        self.probe: dict[str, torch.Tensor] = {}
        self.dynamic: set[str] = set()
        self.evaluate(_probe(_PROBE_ROWS, self.in_width), self.probe, self.dynamic)
        self.steps = self._live(self._compile())

    def evaluate(
        self, x: torch.Tensor, values: dict[str, torch.Tensor], dynamic: set[str] | None = None
    ) -> torch.Tensor:
        """The output, node by node; `values` receives every intermediate, `dynamic` the names that depend on `x`."""
        dynamic = set() if dynamic is None else dynamic
        values.update(self.constants)
        values[self.input] = x
        dynamic.add(self.input)
        made = 0
        for op, inputs, outputs, attributes in self.nodes:
            arguments = [values[name] if name else None for name in inputs]
            made += _size(op, arguments, attributes)
            if made > limits.NETWORK_NUMBERS:
                raise _Unfit(f"operator {op} makes more than {limits.NETWORK_NUMBERS} numbers of {len(x)} rows")
            values[outputs[0]] = _evaluate(op, arguments, attributes)
            if op != "Shape" and dynamic.intersection(inputs):
                dynamic.add(outputs[0])
        return values[self.output]

    def _compile(self) -> list[Step]:
        steps: list[Step] = []
        same: dict[str, str] = {}
        for op, inputs, outputs, attributes in self.nodes:
            output = outputs[0]
            if output not in self.dynamic:
                continue
            inputs = [same.get(name, name) for name in inputs]
            if op in _SAME and self._is_same(op, inputs, attributes):
                same[output] = inputs[0]
                continue
            steps.append(self._module(op, inputs, output, attributes))
        if self.output in same:
            steps.append((_Call(torch.clone), (same[self.output],), self.output))
        return steps

    def _is_same(self, op: str, inputs: list[str], attributes: dict[str, Any]) -> bool:
        if op == "Cast":
            return attributes["to"] == 1  # float32, which it is already
        if op != "Clip":
            return True
        bounds = [float(self.probe[name]) for name in inputs[1:] if name]
        bounds += [float(attributes[k]) for k in ("min", "max") if k in attributes]
        return all(math.isinf(b) for b in bounds)

    def _module(self, op: str, inputs: list[str], output: str, attributes: dict[str, Any]) -> Step:
        fused = (self._silu(op, inputs) or self._layer_norm(op, inputs)) if self._fuse else None
        if fused is not None:
            return (*fused, output)
        dynamic = tuple(name for name in inputs if name in self.dynamic)
        static = {i: self.probe[name] for i, name in enumerate(inputs) if name and name not in self.dynamic}
        shape = tuple(self.probe[output].shape)
        module: torch.nn.Module
        if op == "Gemm" and len(dynamic) == 1 and inputs[0] in self.dynamic and not attributes.get("transA", 0):
            weight = static[1] if attributes.get("transB", 0) else static[1].t()
            bias = static[2] * attributes.get("beta", 1.0) if 2 in static else None
            module = _linear(weight * attributes.get("alpha", 1.0), bias)
        elif op == "MatMul" and 1 in static and static[1].dim() == 2:
            module = _linear(static[1].t(), None)
        elif op == "Conv" and self._fuse and len(dynamic) == 1 and inputs[0] in self.dynamic:
            module = self._convolution(inputs, static, attributes, shape)
        elif op in ("Reshape", "Flatten") or (op in ("Squeeze", "Unsqueeze") and shape[0] == _PROBE_ROWS):
            module, dynamic = _Call(lambda x, rest=shape[1:]: x.reshape(-1, *rest)), dynamic[:1]
        elif op == "Slice":
            slices = _slices(self.probe[inputs[0]].shape, static)
            module, dynamic = _Call(lambda x, s=slices: x[s]), dynamic[:1]
        elif op in _UNARY:
            module = _Call(_UNARY[op])
        elif op in _BINARY:
            module = _Call(_BINARY[op], static)
        elif op == "Concat" and not static:
            module = _Call(lambda *x, axis=attributes["axis"]: torch.cat(x, axis))
        elif op == "Transpose":
            module = _Call(lambda x, perm=tuple(attributes["perm"]): x.permute(perm))
        else:
            module = _Call(lambda *x, o=op, a=attributes: _evaluate(o, list(x), a), static)
        return module, dynamic, output

    def _silu(self, op: str, inputs: list[str]) -> tuple[torch.nn.Module, tuple[str, ...]] | None:
        if op != "Mul":
            return None
        for x, gate in (inputs, inputs[::-1]):
            node = self.producer.get(gate)
            if node and node[0] == "Sigmoid" and node[1][0] == x:
                return torch.nn.SiLU(), (x,)
        return None

    def _layer_norm(self, op: str, inputs: list[str]) -> tuple[torch.nn.Module, tuple[str, ...]] | None:
        """Match (x - mean) / sqrt(mean((x - mean)**2) + eps) * weight + bias backwards from its last addition."""

        def made_by(name: str, kind: str) -> list[str] | None:
            node = self.producer.get(name)
            return node[1] if node and node[0] == kind else None

        if op != "Add" or inputs[1] in self.dynamic or not (scaled := made_by(inputs[0], "Mul")):
            return None
        if scaled[1] in self.dynamic or not (normed := made_by(scaled[0], "Div")):
            return None
        centred, root = normed
        if not (difference := made_by(centred, "Sub")) or not (summed := made_by(root, "Sqrt")):
            return None
        if not (variance := made_by(summed[0], "Add")) or variance[1] in self.dynamic:
            return None
        if not (square := made_by(variance[0], "ReduceMean")) or not (power := made_by(square[0], "Pow")):
            return None
        mean = made_by(difference[1], "ReduceMean")
        if not mean or mean[0] != difference[0] or power[0] != centred or float(self.probe[power[1]]) != 2.0:
            return None
        axes = [_axes(self.producer[name], self.probe) for name in (variance[0], difference[1])]
        x, weight, bias = difference[0], self.probe[scaled[1]], self.probe[inputs[1]]
        rank, width = self.probe[x].dim(), self.probe[x].shape[-1]
        if any(a not in ([-1], [rank - 1]) for a in axes) or weight.shape != (width,) or bias.shape != (width,):
            return None
        epsilon = float(self.probe[variance[1]])
        return _Call(lambda v, w, b: functional.layer_norm(v, w.shape, w, b, epsilon), {1: weight, 2: bias}), (x,)

    def _convolution(
        self, inputs: list[str], static: dict[int, torch.Tensor], attributes: dict[str, Any], shape: tuple[int, ...]
    ) -> torch.nn.Module:
        in_shape = tuple(self.probe[inputs[0]].shape)[1:]
        size = math.prod(in_shape)
        if size * max(size, math.prod(shape[1:])) > _CONV_MATRIX_LIMIT:
            return _Call(lambda *x: _evaluate("Conv", list(x), attributes), static)
        basis = torch.eye(size).reshape(size, *in_shape)
        matrix = _evaluate("Conv", [basis, static[1], None], attributes).flatten(1)
        bias = static[2].repeat_interleave(math.prod(shape[2:])) if 2 in static else None
        return torch.nn.Sequential(torch.nn.Flatten(), _linear(matrix.t(), bias), torch.nn.Unflatten(1, shape[1:]))

    def _live(self, steps: list[Step]) -> list[Step]:
        needed, live = {self.output}, []
        for step in reversed(steps):
            if step[2] in needed:
                needed.update(step[1])
                live.append(step)
        return live[::-1]


def _probe(rows: int, width: int) -> torch.Tensor:
    return torch.randn(rows, width, generator=torch.Generator().manual_seed(rows))


def _attributes(node: onnx.NodeProto) -> dict[str, Any]:
    values = {a.name: onnx.helper.get_attribute_value(a) for a in node.attribute}
    if "value" in values:
        values["value"] = torch.from_numpy(onnx.numpy_helper.to_array(values["value"]).copy())
    return values


def _axes(node: Node, values: dict[str, torch.Tensor]) -> list[int]:
    _, inputs, _, attributes = node
    if "axes" in attributes:
        return list(attributes["axes"])
    return values[inputs[1]].flatten().tolist() if len(inputs) > 1 and inputs[1] else []


def _slices(shape: torch.Size, static: dict[int, torch.Tensor]) -> tuple[slice, ...]:
    starts, ends = static[1].tolist(), static[2].tolist()
    axes = static[3].tolist() if 3 in static else range(len(starts))
    steps = static[4].tolist() if 4 in static else [1] * len(starts)
    slices = [slice(None)] * len(shape)
    for start, end, axis, step in zip(starts, ends, axes, steps, strict=True):
        if step < 1:
            raise _Unfit("a Slice runs backwards")
        slices[axis] = slice(start, min(end, 2**62), step)
    return tuple(slices)


def _size(op: str, x: list[Any], attributes: dict[str, Any]) -> int:
    """Numbers that an operator makes, known before it makes them; those not named here make no more than they get."""
    given = [value for value in x if value is not None]
    if op == "MatMul" or op == "Gemm":
        a, b = x[0].shape, x[1].shape
        if len(a) < 2 or len(b) < 2:
            return x[0].numel() + x[1].numel()
        rows = a[1] if op == "Gemm" and attributes.get("transA", 0) else a[-2]
        columns = b[0] if op == "Gemm" and attributes.get("transB", 0) else b[-1]
        return 2 * math.prod(torch.broadcast_shapes(a[:-2], b[:-2])) * rows * columns
    if op in _BINARY:
        return math.prod(torch.broadcast_shapes(x[0].shape, x[1].shape))
    if op == "Gather":
        return x[0].numel() // max(x[0].shape[attributes.get("axis", 0)], 1) * x[1].numel()
    if op == "Conv":
        # Padded input, and every output: as many positions as the padded input at most, per filter.
        padded = x[0].numel() // max(x[0].shape[-1], 1) * (x[0].shape[-1] + sum(map(abs, attributes.get("pads", [0]))))
        return padded + padded // max(x[0].shape[1], 1) * x[1].shape[0]
    return sum(value.numel() for value in given)


def _evaluate(op: str, x: list[Any], attributes: dict[str, Any]) -> torch.Tensor:
    """One ONNX operator in torch (operator set 11 and later)."""
    if op in _UNARY:
        return _UNARY[op](x[0])
    if op in _BINARY:
        return _BINARY[op](x[0], x[1])
    match op:
        case "Constant" if "value" in attributes:
            return attributes["value"]
        case "Identity" | "Dropout":
            return x[0]
        case "Cast" if attributes["to"] in (1, 7):
            return x[0].to(torch.float32 if attributes["to"] == 1 else torch.int64)
        case "Gemm":
            a = x[0].t() if attributes.get("transA", 0) else x[0]
            b = x[1].t() if attributes.get("transB", 0) else x[1]
            product = attributes.get("alpha", 1.0) * (a @ b)
            return product + attributes.get("beta", 1.0) * x[2] if len(x) > 2 and x[2] is not None else product
        case "Elu":
            return functional.elu(x[0], attributes.get("alpha", 1.0))
        case "LeakyRelu":
            return functional.leaky_relu(x[0], attributes.get("alpha", 0.01))
        case "Softmax":
            return torch.softmax(x[0], attributes.get("axis", -1))
        case "Clip":
            low, high = (x[i] if len(x) > i else attributes.get(k) for i, k in ((1, "min"), (2, "max")))
            return x[0] if low is None and high is None else torch.clamp(x[0], low, high)
        case "Concat":
            return torch.cat(x, attributes["axis"])
        case "Transpose":
            return x[0].permute(tuple(attributes["perm"]))
        case "Flatten" if attributes.get("axis", 1) == 1:
            return x[0].flatten(1)
        case "Shape":
            return torch.tensor(x[0].shape)
        case "Gather":
            axis = attributes.get("axis", 0)
            index = x[1].flatten().long()
            shape = (*x[0].shape[:axis], *x[1].shape, *x[0].shape[axis + 1 :])
            return x[0].index_select(axis, torch.where(index < 0, index + x[0].shape[axis], index)).reshape(shape)
        case "Unsqueeze" | "Squeeze":
            axes = attributes["axes"] if "axes" in attributes else x[1].tolist()
            value = x[0]
            for axis in sorted(axes, reverse=op == "Squeeze"):
                value = value.unsqueeze(axis) if op == "Unsqueeze" else value.squeeze(axis)
            return value
        case "Reshape":
            target = [x[0].shape[i] if n == 0 else n for i, n in enumerate(x[1].tolist())]
            return x[0].reshape(target)
        case "Slice" if len(x) >= 3:
            return x[0][_slices(x[0].shape, {i: v for i, v in enumerate(x) if i and v is not None})]
        case "ReduceMean":
            axes = attributes["axes"] if "axes" in attributes else x[1].tolist()
            return x[0].mean(dim=tuple(axes), keepdim=bool(attributes.get("keepdims", 1)))
        case "LayerNormalization" if attributes.get("axis", -1) in (-1, x[0].dim() - 1):
            bias = x[2] if len(x) > 2 else None
            return functional.layer_norm(x[0], x[1].shape, x[1], bias, attributes.get("epsilon", 1e-5))
        case "Conv" if x[0].dim() == 3:
            before, after = attributes.get("pads", [0, 0])
            stride, dilation = attributes.get("strides", [1]), attributes.get("dilations", [1])
            bias = x[2] if len(x) > 2 else None
            padded = functional.pad(x[0], (before, after))
            return functional.conv1d(padded, x[1], bias, stride, 0, dilation, attributes.get("group", 1))
    raise _Unfit(f"operator {op} with these arguments is not supported")


def read(path: str | Path, *, in_width: int, flag: str = "--checkpoint") -> tuple[onnx.ModelProto, bytes, bytes]:
    """The graph from the first input of an ONNX file to its first output; errors name the `flag`.

    Training programs export more: mjlab's tracking networks have a second input, the time step, and give the reference
    motion of that step after the actions.

    Returns:
        The graph, the same as bytes for a runtime, and the file's content.

    Raises:
        InputError: The file is absent, not an ONNX network, keeps weights in another file, has another input width, or
            its first output depends on a further input.
    """
    where = f"{flag} {path}"
    data = read_bytes(path, limits.NETWORK_BYTES, where=where)
    try:
        model = onnx.load_model_from_string(data)
        if not model.graph.output:
            raise _Unfit("it holds no graph")
        if any(i.data_location == onnx.TensorProto.EXTERNAL for i in model.graph.initializer):
            raise _Unfit("its weights are in another file")
        weights = {i.name for i in model.graph.initializer}
        inputs = [i for i in model.graph.input if i.name not in weights]
        width = [d.dim_value for i in inputs[:1] for d in i.type.tensor_type.shape.dim][-1:]
        if width and width[0] not in (0, in_width):
            raise InputError(f"{where}: the network takes {width[0]} numbers, expected {in_width}")
        if len(inputs) < 2 and len(model.graph.output) == 1:
            return model, data, data
        _keep_first(model.graph, inputs)
        return model, model.SerializeToString(), data
    except InputError:
        raise
    except Exception as error:  # a damaged file fails anywhere inside protobuf
        raise InputError(f"{where}: {_reason(error)}") from error


def metadata(path: str | Path, *, flag: str = "--checkpoint") -> dict[str, str]:
    """Texts that the exporter of an ONNX file added to it, by their keys.

    Raises:
        InputError: The file is absent or not an ONNX network.
    """
    data = read_bytes(path, limits.NETWORK_BYTES, where=f"{flag} {path}")
    try:
        return {entry.key: entry.value for entry in onnx.load_model_from_string(data).metadata_props}
    except Exception as error:  # a damaged file fails anywhere inside protobuf
        raise InputError(f"{flag} {path}: {_reason(error)}") from error


def _keep_first(graph: onnx.GraphProto, inputs: list[onnx.ValueInfoProto]) -> None:
    """Drop all outputs but the first, all inputs but the first, and what only they need."""
    needed = {graph.output[0].name}
    nodes = []
    for node in reversed(graph.node):
        if needed.intersection(node.output):
            needed.update(node.input)
            nodes.append(node)
    for one in inputs[1:]:
        if one.name in needed:
            raise _Unfit(f"its output {graph.output[0].name} depends on a further input, {one.name}")
        graph.input.remove(one)
    del graph.node[:], graph.output[1:]
    graph.node.extend(reversed(nodes))


def _reason(error: Exception) -> str:
    if isinstance(error, _Unfit):
        return f"not a network that this reader can use: {error}"
    return f"not a usable ONNX file ({type(error).__name__}: {' '.join(str(error).split())[:160]})"


@torch.inference_mode()
def load(
    path: str | Path, *, in_width: int, out_width: int, flag: str = "--checkpoint", fuse: bool = True
) -> OnnxNetwork:
    """Read a feed-forward network of these widths from an ONNX file; errors name the `flag`.

    With `fuse`, `x * sigmoid(x)`, layer normalisation and convolutions become one call each.

    Raises:
        InputError: The file is absent, not an ONNX network, holds an unknown operator, or has other widths.
    """
    where = f"{flag} {path}"
    model, _, _ = read(path, in_width=in_width, flag=flag)
    try:
        graph = _Graph(model, in_width, fuse=fuse)
        network = OnnxNetwork(graph).eval()
        x = _probe(_CHECK_ROWS, graph.in_width)
        got, expected = network(x), graph.evaluate(x, {})
        if expected.shape != (_CHECK_ROWS, out_width):
            raise InputError(f"{where}: the network gives {expected.shape[-1]} numbers, expected {out_width}")
        if not (got - expected).abs().max() <= _CHECK_TOLERANCE * (1.0 + expected.abs().max()):
            raise _Unfit("its result depends on the batch size or is not finite")
    except InputError:
        raise
    except Exception as error:  # a damaged graph fails anywhere inside numpy or torch
        raise InputError(f"{where}: {_reason(error)}") from error
    return network
