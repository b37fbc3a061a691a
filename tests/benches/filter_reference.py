"""The EMP of a weights file behind Python's grpcio and ONNX Runtime: what benches/filter.rs compares the server with.

    python -m venv venv && venv/bin/pip install grpcio==1.85.1 onnx==1.23.2 onnxruntime==1.31.1
    venv/bin/python tests/benches/filter_reference.py WEIGHTS PORT

A request is the numbers of a stack and a goal, an answer those of the executable goal, without limits: f32, little-endian. No
history is assembled and no message is parsed, which the server has to do beside. One thread computes a call; calls run side by
side, as grpcio's pool has them.
"""

import json
import struct
import sys
from concurrent import futures

import grpc
import numpy as np
import onnxruntime
from onnx import TensorProto, helper, numpy_helper

THREADS = 8
TYPES = {"F16": np.float16, "F32": np.float32}
CLIP = 8.0


def read_checkpoint(path):
    """Tensors as f32, and the metadata's description of the network."""
    with open(path, "rb") as file:
        data = file.read()
    (length,) = struct.unpack("<Q", data[:8])
    header = json.loads(data[8 : 8 + length])
    metadata = header.pop("__metadata__")
    tensors = {}
    for name, entry in header.items():
        start, end = (8 + length + offset for offset in entry["data_offsets"])
        values = np.frombuffer(data[start:end], TYPES[entry["dtype"]])
        tensors[name] = values.astype(np.float32).reshape(entry["shape"])
    return tensors, json.loads(metadata["emp"])["config"]


class Graph:
    """An ONNX graph, node by node."""

    def __init__(self):
        self.nodes, self.constants = [], []

    def constant(self, name, value):
        self.constants.append(numpy_helper.from_array(np.ascontiguousarray(value), name))
        return name

    def add(self, operator, inputs, output, **attributes):
        self.nodes.append(helper.make_node(operator, inputs, [output], **attributes))
        return output

    def mlp(self, prefix, tensors, value):
        layers = sum(name.startswith(f"{prefix}.") for name in tensors) // 2
        for layer in range(layers):
            name = f"{prefix}.{layer}"
            weight, bias = (self.constant(f"{name}.{part}", tensors[f"{name}.{part}"]) for part in ("weight", "bias"))
            value = self.add("Gemm", [value, weight, bias], f"{name}.out", transB=1)
            if layer + 1 < layers:
                value = self.add("Elu", [value], f"{name}.elu")
        return value

    def features(self, history_map):
        """What the history map makes of stacks `s`: nothing, where every frame stays as it is."""
        frames = history_map.shape[1]
        if np.array_equal(history_map, np.eye(frames)):
            return "s"
        by_frame = self.constant("by_frame", np.array([0, frames, -1], np.int64))
        in_a_row = self.constant("in_a_row", np.array([0, -1], np.int64))
        weights = self.constant("history_map", history_map)
        stacks = self.add("Reshape", ["s", by_frame], "frames")
        return self.add("Reshape", [self.add("MatMul", [weights, stacks], "mapped"), in_a_row], "mapped_rows")

    def emp(self, tensors, config):
        """The network (paper, section V-A) on stacks `s` and goals `g`."""
        stack = self.features(np.array(config["history_map"], np.float32))
        mean, scale, low, high = (
            self.constant(name, value)
            for name, value in (
                ("mean", tensors["normalizer.mean"]),
                ("scale", tensors["normalizer.scale"]),
                ("low", np.float32(-CLIP)),
                ("high", np.float32(CLIP)),
            )
        )
        centred = self.add("Sub", [stack, mean], "centred")
        scaled = self.add("Mul", [centred, scale], "scaled")
        features = self.add("Clip", [scaled, low, high], "features")
        encodings = [self.mlp("emp.state", tensors, features), self.mlp("emp.target", tensors, "g")]
        both = self.add("Concat", encodings, "encodings", axis=1)
        decoded = self.mlp("emp.decoder", tensors, self.mlp("emp.fusion", tensors, both))
        if config["output"] == "residual":
            decoded = self.add("Add", [decoded, "g"], "residual")
        return decoded


def build(path):
    """A session for the network, and the widths of its inputs."""
    tensors, config = read_checkpoint(path)
    graph = Graph()
    output = graph.emp(tensors, config)
    layout = config["observation"]
    goals = layout["goals"]
    frame = layout["joint_positions"] + layout["actions"] + 3 + goals
    widths = [frame * layout["history"], goals]
    value = lambda name, width: helper.make_tensor_value_info(name, TensorProto.FLOAT, ["n", width])
    inputs = [value(name, width) for name, width in zip("sg", widths)]
    outputs = [value(output, widths[1])]
    model = helper.make_model(
        helper.make_graph(graph.nodes, "emp", inputs, outputs, graph.constants),
        opset_imports=[helper.make_opsetid("", 17)],
        ir_version=10,
    )
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = 1
    return onnxruntime.InferenceSession(model.SerializeToString(), options), widths[0]


def main():
    session, width = build(sys.argv[1])

    def answer(request, _):
        numbers = np.frombuffer(request, "<f4")
        return session.run(None, {"s": numbers[None, :width], "g": numbers[None, width:]})[0].tobytes()

    class Handler(grpc.GenericRpcHandler):
        def service(self, details):
            return grpc.unary_unary_rpc_method_handler(answer)

    server = grpc.server(futures.ThreadPoolExecutor(THREADS))
    server.add_generic_rpc_handlers((Handler(),))
    server.add_insecure_port(f"127.0.0.1:{sys.argv[2]}")
    server.start()
    print("ready", flush=True)
    server.wait_for_termination()


if __name__ == "__main__":
    main()
