"""Which runtime reads a network's file."""

from __future__ import annotations

from pathlib import Path

from fusecap.detect.runtimes import onnxruntime, openvino
from fusecap.detect.runtimes.network import Network
from fusecap.errors import InputError, from_extra, nearest
from fusecap.inputs import NETWORK, check_input

RUNTIMES = ("auto", "onnxruntime", "openvino")
SUFFIXES = (".onnx", ".xml", ".tflite")
"""Of networks: ONNX, OpenVINO's, TensorFlow Lite's."""


def open_network(path: Path, runtime: str = "auto", threads: int | None = None) -> Network:
    """Load a network; `threads` None: as many as there are cores.

    "auto" takes .onnx to ONNX Runtime, or to OpenVINO where that alone is installed; all else to
    OpenVINO. Raises `InputError` for a missing or broken file and where the runtime is missing.
    """
    check_input(path, NETWORK)
    if runtime_for(path, runtime) == "onnxruntime":
        return onnxruntime.OnnxNetwork(path, threads)
    return openvino.OpenVinoNetwork(path, threads)


def runtime_for(path: Path | str, runtime: str = "auto") -> str:
    """Which runtime reads a file of this name: "onnxruntime" or "openvino".

    Raises `InputError` where none does, or where it is not installed.
    """
    if runtime not in RUNTIMES:
        raise InputError(f"no runtime '{runtime}'{nearest(runtime, RUNTIMES)}")
    path = Path(path)
    if path.suffix not in SUFFIXES:
        raise InputError(f"{path}: expected a network: {', '.join(SUFFIXES)}")
    if path.suffix != ".onnx" and runtime == "onnxruntime":
        raise InputError(
            f"{path}: ONNX Runtime cannot read {path.suffix} files; set runtime openvino"
        )
    if runtime == "auto":
        by_openvino = openvino.installed() and not onnxruntime.installed()
        runtime = "openvino" if path.suffix != ".onnx" or by_openvino else "onnxruntime"
    if runtime == "onnxruntime" and not onnxruntime.installed():
        raise InputError(
            f"{path.name} needs ONNX Runtime, which is not installed; {from_extra('detect')}"
        )
    if runtime == "openvino" and not openvino.installed():
        raise InputError(
            f"{path.name} needs OpenVINO, which is not installed; {from_extra('openvino')}"
        )
    return runtime
