"""A network as the detectors see it: one image batch in, named arrays out."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from fusecap.errors import InputError, nearest

RUNTIMES = ("auto", "onnxruntime", "openvino")


@dataclass(frozen=True, slots=True, kw_only=True)
class Tensor:
    """An input or output of a network."""

    name: str
    shape: tuple[int | None, ...]
    """None where the network takes any size."""
    dtype: str


@runtime_checkable
class Network(Protocol):
    """A loaded network with one image input."""

    @property
    def path(self) -> Path:
        """The file it came from."""
        ...

    @property
    def identity(self) -> str:
        """File name, start of its SHA-256 and runtime."""
        ...

    @property
    def input(self) -> Tensor:
        """(n, 3, h, w)."""
        ...

    @property
    def outputs(self) -> tuple[Tensor, ...]:
        """In the order of the file."""
        ...

    def run(self, batch: Float32[np.ndarray, "n c h w"]) -> dict[str, np.ndarray]:
        """Outputs by name, rows as in the batch; one run where the network takes batches."""
        ...


def open_network(path: Path, runtime: str = "auto", threads: int | None = None) -> Network:
    """Load a network; `threads` None: as many as there are cores.

    "auto" takes .xml to OpenVINO and .onnx to ONNX Runtime, or to OpenVINO where that alone is
    installed. Raises `InputError` for a missing or broken file and where the runtime is missing.
    """
    from fusecap.detect.runtimes import onnxruntime, openvino

    if not path.is_file():
        raise InputError(f"{path}: no such file; expected a network (.onnx or OpenVINO .xml)")
    if runtime_for(path, runtime) == "onnxruntime":
        return onnxruntime.OnnxNetwork(path, threads)
    return openvino.OpenVinoNetwork(path, threads)


def runtime_for(path: Path | str, runtime: str = "auto") -> str:
    """Which runtime reads a file of this name: "onnxruntime" or "openvino".

    Raises `InputError` where none does, or where it is not installed.
    """
    from fusecap.detect.runtimes import onnxruntime, openvino

    if runtime not in RUNTIMES:
        raise InputError(f"no runtime '{runtime}'{nearest(runtime, RUNTIMES)}")
    path = Path(path)
    if path.suffix not in (".onnx", ".xml"):
        raise InputError(f"{path}: expected a network, .onnx or OpenVINO .xml")
    if path.suffix == ".xml" and runtime == "onnxruntime":
        raise InputError(f"{path}: ONNX Runtime cannot read OpenVINO files; set runtime openvino")
    if runtime == "auto":
        by_openvino = openvino.installed() and not onnxruntime.installed()
        runtime = "openvino" if path.suffix == ".xml" or by_openvino else "onnxruntime"
    if runtime == "onnxruntime" and not onnxruntime.installed():
        raise InputError(
            f"{path.name} needs ONNX Runtime, which is not installed; "
            "run: pip install 'fusecap[detect]'"
        )
    if runtime == "openvino" and not openvino.installed():
        raise InputError(
            f"{path.name} needs OpenVINO, which is not installed; "
            "run: pip install 'fusecap[openvino]'"
        )
    return runtime


def file_identity(path: Path, runtime: str) -> str:
    """File name, 16 digits of the SHA-256 of its content (weights beside it included), runtime."""
    digest = hashlib.sha256(path.read_bytes())
    weights = path.with_suffix(".bin")
    if path.suffix == ".xml" and weights.is_file():
        digest.update(weights.read_bytes())
    return f"{path.name} sha256:{digest.hexdigest()[:16]} {runtime}"


def one_by_one(results: list[dict[str, np.ndarray]]) -> dict[str, np.ndarray]:
    """Outputs of single runs as one batch; lists of unequal length are padded with zeros.

    Detection lists ("dets", "labels", "keypoints") differ in length from image to image; a row of
    zeros has score 0.
    """
    joined = {}
    for name in results[0]:
        arrays = [result[name] for result in results]
        if len({a.shape[1:] for a in arrays}) > 1:
            longest = max(a.shape[1] for a in arrays)
            arrays = [
                np.pad(a, [(0, 0), (0, longest - a.shape[1])] + [(0, 0)] * (a.ndim - 2))
                for a in arrays
            ]
        joined[name] = np.concatenate(arrays)
    return joined
