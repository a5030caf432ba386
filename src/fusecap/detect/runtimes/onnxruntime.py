"""ONNX files by ONNX Runtime on the processor."""

from __future__ import annotations

import importlib.util
import os
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32

from fusecap.detect.runtimes.network import Tensor, file_identity, one_by_one
from fusecap.errors import InputError


def installed() -> bool:
    """Whether the package can be imported."""
    return importlib.util.find_spec("onnxruntime") is not None


class OnnxNetwork:
    """One session; not shared between threads."""

    def __init__(self, path: Path, threads: int | None = None) -> None:
        # Its wheels tell Microsoft what is run, unless this stands before they are loaded.
        os.environ.setdefault("ORT_DISABLE_TELEMETRY", "1")
        import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads or os.cpu_count() or 1
        # Waiting threads sleep: video decoding needs the cores.
        options.add_session_config_entry("session.intra_op.allow_spinning", "0")
        # A batch that a graph cannot take is an exception here; the log would repeat it.
        options.log_severity_level = 4
        try:
            self._session: Any = onnxruntime.InferenceSession(
                str(path), options, providers=["CPUExecutionProvider"]
            )
        except Exception as error:
            reason = str(error).splitlines()[0][:200]
            raise InputError(
                f"{path}: not a network that ONNX Runtime can load ({reason}); "
                "export or download it again"
            ) from None
        inputs = self._session.get_inputs()
        if len(inputs) != 1 or len(inputs[0].shape) != 4:
            shapes = ", ".join(f"{i.name} {i.shape}" for i in inputs)
            raise InputError(f"{path}: expected one image input (n, 3, h, w), found {shapes}")
        self.path = path
        self.identity = file_identity(path, "onnxruntime")
        self.input = _tensor(inputs[0])
        self.outputs = tuple(_tensor(output) for output in self._session.get_outputs())
        self._batches = self.input.shape[0] is None

    def run(self, batch: Float32[np.ndarray, "n c h w"]) -> dict[str, np.ndarray]:
        """Outputs by name; singly where the graph takes one image, or fails on several."""
        if len(batch) == 1:
            return self._run(batch)
        if self._batches:
            try:
                return self._run(batch)
            except Exception:
                # Exports with suppression inside declare a free batch and fail beyond one.
                self._batches = False
        return one_by_one([self._run(batch[i : i + 1]) for i in range(len(batch))])

    def _run(self, batch: np.ndarray) -> dict[str, np.ndarray]:
        values = self._session.run(None, {self.input.name: batch})
        return {tensor.name: value for tensor, value in zip(self.outputs, values, strict=True)}


def _tensor(node: Any) -> Tensor:
    shape = tuple(size if isinstance(size, int) and size > 0 else None for size in node.shape)
    return Tensor(name=node.name, shape=shape, dtype=node.type)
