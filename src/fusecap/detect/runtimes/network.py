"""A network as the detectors see it: one image batch in, named arrays out."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32

from fusecap.inputs import NETWORK, read_bytes


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


def file_identity(path: Path, runtime: str) -> str:
    """File name, 16 digits of the SHA-256 of its content (weights beside it included), runtime."""
    digest = hashlib.sha256(read_bytes(path, NETWORK))
    weights = path.with_suffix(".bin")
    if path.suffix == ".xml" and weights.is_file():
        digest.update(read_bytes(weights, NETWORK))
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
