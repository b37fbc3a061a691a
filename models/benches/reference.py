"""ONNX Runtime's side of benches/onnxruntime.rs: the same network, its weights read from a file.

    reference.py WEIGHTS WIDTHS

WEIGHTS holds f32 numbers: of each layer the weight (outputs x inputs), then the bias. WIDTHS are those of the four MLPs, JSON. Says
"ready VERSION", then answers each line "THREADS BATCH RUNS" with {"seconds": median of a run, "answer": first row's goal}.
"""

import json
import statistics
import sys
import time

import numpy as np
import onnx
import onnxruntime
from onnx import TensorProto, helper, numpy_helper


def model(weights, widths):
    """state, goal -> goal: the two encodings side by side through fusion and decoder."""
    numbers = np.fromfile(weights, dtype="<f4")
    nodes, tensors, at = [], [], 0

    def take(name, shape):
        nonlocal at
        size = int(np.prod(shape))
        tensors.append(numpy_helper.from_array(numbers[at : at + size].reshape(shape), name))
        at += size
        return name

    def mlp(name, layers, x):
        for i, (inputs, outputs) in enumerate(zip(layers, layers[1:])):
            layer = f"{name}.{i}"
            parameters = [take(f"{layer}.weight", (outputs, inputs)), take(f"{layer}.bias", (outputs,))]
            nodes.append(helper.make_node("Gemm", [x, *parameters], [layer], transB=1))
            x = layer
            if i + 2 < len(layers):
                nodes.append(helper.make_node("Elu", [x], [f"{layer}.elu"]))
                x = f"{layer}.elu"
        return x

    encodings = [mlp("state", widths[0], "features"), mlp("target", widths[1], "goals")]
    nodes.append(helper.make_node("Concat", encodings, ["encodings"], axis=1))
    out = mlp("decoder", widths[3], mlp("fusion", widths[2], "encodings"))
    assert at == len(numbers), (at, len(numbers))

    def rows(name, width):
        return helper.make_tensor_value_info(name, TensorProto.FLOAT, ["rows", width])

    inputs = [rows("features", widths[0][0]), rows("goals", widths[1][0])]
    graph = helper.make_graph(nodes, "emp", inputs, [rows(out, widths[3][-1])], tensors)
    return helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)


def session(network, threads):
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.inter_op_num_threads = 1
    return onnxruntime.InferenceSession(
        network.SerializeToString(), options, providers=["CPUExecutionProvider"]
    )


def inputs(batch, width):
    return np.sin(np.arange(batch * width) * 0.37).astype("f4").reshape(batch, width)


def main():
    widths = json.loads(sys.argv[2])
    network = model(sys.argv[1], widths)
    sessions = {}
    print("ready", onnxruntime.__version__, flush=True)
    for line in sys.stdin:
        threads, batch, runs = map(int, line.split())
        if threads not in sessions:
            sessions.clear()
            sessions[threads] = session(network, threads)
        feed = {"features": inputs(batch, widths[0][0]), "goals": inputs(batch, widths[1][0])}
        times = []
        for _ in range(runs):
            start = time.perf_counter()
            (answer,) = sessions[threads].run(None, feed)
            times.append(time.perf_counter() - start)
        answer = {"seconds": statistics.median(times), "answer": answer[0].tolist()}
        print(json.dumps(answer), flush=True)


main()
