"""Networks of a few operations with known outputs, as ONNX files."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from onnx import TensorProto, helper, numpy_helper, save


def constant_network(
    path: Path,
    input_shape: tuple[int | str, ...],
    outputs: Mapping[str, np.ndarray],
    *,
    plus_image: float = 0.0,
) -> Path:
    """Every output is the given (1, ...) array for each image of the batch, whatever it shows.

    `plus_image` times the image's mean is added, to tell images apart.
    """
    nodes = [helper.make_node("ReduceMean", ["input"], ["mean"], axes=[1, 2, 3], keepdims=1)]
    constants = [numpy_helper.from_array(np.array([plus_image], np.float32), "weight")]
    nodes.append(helper.make_node("Mul", ["mean", "weight"], ["extra"]))
    infos = []
    for name, value in outputs.items():
        shape = np.array([-1] + [1] * (value.ndim - 1), dtype=np.int64)
        constants += [
            numpy_helper.from_array(value.astype(np.float32), f"{name}_value"),
            numpy_helper.from_array(shape, f"{name}_shape"),
        ]
        whole = np.issubdtype(value.dtype, np.integer)
        nodes += [
            helper.make_node("Reshape", ["extra", f"{name}_shape"], [f"{name}_extra"]),
            helper.make_node(
                "Add", [f"{name}_extra", f"{name}_value"], [f"{name}_f" if whole else name]
            ),
        ]
        if whole:
            nodes.append(helper.make_node("Cast", [f"{name}_f"], [name], to=TensorProto.INT64))
        kind = TensorProto.INT64 if whole else TensorProto.FLOAT
        infos.append(helper.make_tensor_value_info(name, kind, [input_shape[0], *value.shape[1:]]))
    return _save(path, nodes, infos, constants, input_shape)


def red_blob_network(path: Path, size: tuple[int, int], keypoints: int) -> Path:
    """Heatmaps (n, k, h/4, w/4): the red of every fourth pixel, 0-1, undoing the normalisation."""
    weight = np.zeros((keypoints, 3, 1, 1), np.float32)
    weight[:, 0] = 58.395 / 255.0
    bias = np.full(keypoints, 123.675 / 255.0, np.float32)
    nodes = [
        helper.make_node(
            "Conv", ["input", "weight", "bias"], ["heatmaps"], kernel_shape=[1, 1], strides=[4, 4]
        )
    ]
    width, height = size
    info = helper.make_tensor_value_info(
        "heatmaps", TensorProto.FLOAT, ["n", keypoints, height // 4, width // 4]
    )
    constants = [numpy_helper.from_array(weight, "weight"), numpy_helper.from_array(bias, "bias")]
    return _save(path, nodes, [info], constants, ("n", 3, height, width))


def fails_on_batches(path: Path) -> Path:
    """Declares any batch but reshapes to one image, as exports with suppression inside do."""
    nodes = [
        helper.make_node("ReduceMean", ["input"], ["mean"], axes=[1, 2, 3], keepdims=1),
        helper.make_node("Reshape", ["mean", "shape"], ["out"]),
    ]
    constants = [numpy_helper.from_array(np.array([1, 1], np.int64), "shape")]
    info = helper.make_tensor_value_info("out", TensorProto.FLOAT, ["n", 1])
    return _save(path, nodes, [info], constants, ("n", 3, 8, 8))


def _save(path: Path, nodes, outputs, constants, input_shape) -> Path:
    image = helper.make_tensor_value_info("input", TensorProto.FLOAT, list(input_shape))
    graph = helper.make_graph(nodes, "tiny", [image], outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 13)], ir_version=8)
    path.parent.mkdir(parents=True, exist_ok=True)
    save(model, str(path))
    return path
