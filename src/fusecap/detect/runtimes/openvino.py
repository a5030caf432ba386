"""OpenVINO IR, ONNX and TensorFlow Lite files by OpenVINO on the processor."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from fusecap.detect.runtimes.network import Tensor, file_identity, one_by_one
from fusecap.errors import InputError

SMALL_PX = 384 * 288
"""Input up to which a network keeps one core busy but not several: parts of a batch then run side
by side. Measured: 8 crops of 128x96 on two cores take three quarters of the time."""
MOST_STREAMS = 4


def installed() -> bool:
    """Whether the package can be imported."""
    return importlib.util.find_spec("openvino") is not None


class OpenVinoNetwork:
    """One compiled model; not shared between threads.

    Files that declare one image are opened for any number where the graph allows.
    """

    def __init__(self, path: Path, threads: int | None = None) -> None:
        import openvino

        if path.suffix == ".xml" and not path.with_suffix(".bin").is_file():
            raise InputError(
                f"{path}: the weights {path.with_suffix('.bin').name} are not beside it; "
                "an OpenVINO network is a pair of .xml and .bin"
            )
        core: Any = openvino.Core()
        try:
            model = core.read_model(path)
            if path.suffix == ".tflite":
                model = _channels_first(model)
            inputs = model.inputs
            if len(inputs) != 1 or inputs[0].get_partial_shape().rank.get_length() != 4:
                raise InputError(f"{path}: expected one image input (n, 3, h, w)")
            self.input = _tensor(inputs[0])
            outputs = tuple(_tensor(output) for output in model.outputs)
            if self.input.shape[0] is not None:
                _free_batch(model)
            cores = threads or os.cpu_count() or 1
            pixels = [side for side in self.input.shape[2:] if side is not None]
            small = len(pixels) == 2 and pixels[0] * pixels[1] <= SMALL_PX
            streams = min(cores, MOST_STREAMS) if small else 1
            compiled: Any = core.compile_model(
                model, "CPU", {"INFERENCE_NUM_THREADS": cores, "NUM_STREAMS": streams}
            )
            self._queue: Any = openvino.AsyncInferQueue(compiled, streams)
        except (RuntimeError, OSError) as error:
            reason = " ".join(str(error).split())[:200]
            raise InputError(
                f"{path}: not a network that OpenVINO can load ({reason}); "
                "export or download it again"
            ) from None
        self.path = path
        self.identity = file_identity(path, "openvino")
        self.outputs = outputs
        self._streams = streams
        self._batches = bool(compiled.inputs[0].get_partial_shape()[0].is_dynamic)
        self._done: dict[int, dict[str, np.ndarray]] = {}
        self._queue.set_callback(self._keep)

    def run(self, batch: Float32[np.ndarray, "n c h w"]) -> dict[str, np.ndarray]:
        """Outputs by name; singly where the graph takes one image."""
        parts = min(self._streams, len(batch)) if self._batches else len(batch)
        for i, part in enumerate(np.array_split(batch, parts)):
            self._queue.start_async({0: part}, i)
        self._queue.wait_all()
        return one_by_one([self._done.pop(i) for i in range(parts)])

    def _keep(self, request: Any, part: int) -> None:
        """Called by OpenVINO, which reuses its buffers."""
        self._done[part] = {
            tensor.name: request.get_output_tensor(i).data.copy()
            for i, tensor in enumerate(self.outputs)
        }


def _channels_first(model: Any) -> Any:
    """A network as others are, from one whose pictures have channels last; masks are cut off."""
    import openvino

    steps: Any = openvino.preprocess.PrePostProcessor(model)
    steps.input().tensor().set_layout(openvino.Layout("NCHW"))
    steps.input().model().set_layout(openvino.Layout("NHWC"))
    turned = steps.build()
    kept = [one for one in turned.outputs if one.get_partial_shape().rank.get_length() < 4]
    make: Any = openvino.Model
    return make(kept, turned.get_parameters()) if kept else turned


def _free_batch(model: Any) -> None:
    port = model.inputs[0]
    declared = port.get_partial_shape()
    free = port.get_partial_shape()
    free[0] = -1
    try:
        model.reshape({port: free})
        if all(output.get_partial_shape()[0].is_dynamic for output in model.outputs):
            return
    except RuntimeError:
        pass
    model.reshape({model.inputs[0]: declared})


def _tensor(port: Any) -> Tensor:
    shape = tuple(
        None if size.is_dynamic else size.get_length() for size in port.get_partial_shape()
    )
    name = port.get_any_name() if port.get_names() else port.get_node().get_friendly_name()
    return Tensor(name=name, shape=shape, dtype=port.get_element_type().get_type_name())
