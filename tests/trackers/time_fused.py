"""Time that fused calls of `onnx_mlp` save under a CUDA graph: `python tests/trackers/time_fused.py FILE.onnx`."""

import statistics
import sys
import time

import onnx
import torch

from arena_newton.trackers.inference import onnx_mlp

ROWS, CALLS, REPEATS = 4096, 200, 9


def held(network: torch.nn.Module, rows: torch.Tensor) -> torch.cuda.CUDAGraph:
    """The network's pass over these rows in a CUDA graph."""
    for _ in range(3):
        network(rows)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        network(rows)
    return graph


@torch.inference_mode()
def main(path: str) -> None:
    """Print the time of one pass [us] with and without fused calls, taken in turns."""
    graph = onnx.load(path).graph
    widths = [v.type.tensor_type.shape.dim[1].dim_value for v in (graph.input[0], graph.output[0])]
    rows = torch.randn(ROWS, widths[0], device="cuda")
    graphs, times = {}, {True: [], False: []}
    for fuse in times:
        network = onnx_mlp.load(path, in_width=widths[0], out_width=widths[1], fuse=fuse).to("cuda")
        graphs[fuse] = network, held(network, rows)
    for _ in range(REPEATS):
        for fuse, (_, held_graph) in graphs.items():
            torch.cuda.synchronize()
            began = time.perf_counter()
            for _ in range(CALLS):
                held_graph.replay()
            torch.cuda.synchronize()
            times[fuse].append(1e6 * (time.perf_counter() - began) / CALLS)
    fused, plain = (statistics.median(times[fuse]) for fuse in (True, False))
    print(f"{ROWS} rows: fused {fused:.1f} us, plain {plain:.1f} us, saved {100 * (1 - fused / plain):.1f} %")


if __name__ == "__main__":
    main(sys.argv[1])
