"""glTF 2.0 in one binary file (GLB): a JSON tree, then the arrays it points into."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from fusecap.files import written_whole

_TYPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
_COMPONENTS = {np.dtype(np.float32): 5126, np.dtype(np.uint16): 5123, np.dtype(np.uint32): 5125}
_VERTICES, _INDICES = 34962, 34963


class Gltf:
    """A document in the making: a new one, or one that is added to."""

    def __init__(self, tree: dict[str, Any], binary: bytes = b"") -> None:
        self.tree = tree
        self._chunks = [binary + b"\0" * (-len(binary) % 4)]
        self._length = len(self._chunks[0])

    @classmethod
    def new(cls, generator: str) -> Gltf:
        """One scene with nothing in it."""
        asset = {"version": "2.0", "generator": generator}
        return cls({"asset": asset, "scene": 0, "scenes": [{"nodes": []}]})

    def add(self, kind: str, item: dict[str, Any]) -> int:
        """Appends to a list of the tree, such as "nodes"; returns its index."""
        items = self.tree.setdefault(kind, [])
        items.append(item)
        return len(items) - 1

    def array(self, values: np.ndarray, *, target: int | None = None, bounds: bool = False) -> int:
        """An accessor of (n,), (n, 2..4) or (n, 16) float32, uint16 or uint32 values."""
        values = np.ascontiguousarray(values)
        width = 1 if values.ndim == 1 else values.shape[1]
        view = {"buffer": 0, "byteOffset": self._length, "byteLength": values.nbytes}
        if target is not None:
            view["target"] = target
        accessor = {
            "bufferView": self.add("bufferViews", view),
            "componentType": _COMPONENTS[values.dtype],
            "count": len(values),
            "type": _TYPES[width],
        }
        if bounds:
            table = values.reshape(len(values), width)
            accessor["min"] = table.min(axis=0).tolist()
            accessor["max"] = table.max(axis=0).tolist()
        data = values.tobytes()
        data += b"\0" * (-len(data) % 4)
        self._chunks.append(data)
        self._length += len(data)
        return self.add("accessors", accessor)

    def vertices(self, values: np.ndarray, *, bounds: bool = False) -> int:
        """Of a mesh."""
        return self.array(values, target=_VERTICES, bounds=bounds)

    def indices(self, values: np.ndarray) -> int:
        """Of a mesh's corners."""
        return self.array(values, target=_INDICES)

    def write(self, path: Path) -> None:
        """Whole or not at all."""
        if self._length:
            buffers = self.tree.setdefault("buffers", [{}])
            buffers[0] = {**buffers[0], "byteLength": self._length}
        text = json.dumps(self.tree, separators=(",", ":"), ensure_ascii=False).encode()
        text += b" " * (-len(text) % 4)
        total = 12 + 8 + len(text) + (8 + self._length if self._length else 0)
        with written_whole(path) as file:
            file.write(struct.pack("<4sII", b"glTF", 2, total))
            file.write(struct.pack("<I4s", len(text), b"JSON") + text)
            if self._length:
                file.write(struct.pack("<I4s", self._length, b"BIN\0"))
                for chunk in self._chunks:
                    file.write(chunk)
