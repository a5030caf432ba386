"""A second opinion on BVH files: a reader and forward kinematics that share nothing with ours."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation


class Bvh:
    """Joints with names, parents, offsets, channels and end sites; motion; frame time."""

    def __init__(self, path: Path) -> None:
        head, _, tail = path.read_text().partition("MOTION")
        self.names, self.parents, self.offsets, self.channels = [], [], [], []
        self.ends: dict[str, np.ndarray] = {}
        stack: list[int | str] = []
        pending: int | str = -1
        for line in head.splitlines()[1:]:
            words = line.split()
            if not words:
                continue
            if words[0] in ("ROOT", "JOINT"):
                self.names.append(words[1])
                self.parents.append(stack[-1] if stack else -1)
                pending = len(self.names) - 1
            elif words[0] == "End":
                pending = f"end of {self.names[stack[-1]]}"
            elif words[0] == "{":
                stack.append(pending)
            elif words[0] == "}":
                stack.pop()
            elif words[0] == "OFFSET":
                offset = np.array([float(word) for word in words[1:]])
                if isinstance(stack[-1], str):
                    self.ends[stack[-1].removeprefix("end of ")] = offset
                else:
                    self.offsets.append(offset)
            elif words[0] == "CHANNELS":
                assert int(words[1]) == len(words) - 2
                self.channels.append(words[2:])
        lines = tail.strip().splitlines()
        self.frame_time = lines[1].split(":")[1].strip()
        self.motion = np.array([[float(w) for w in row.split()] for row in lines[2:]])
        assert len(self.motion) == int(lines[0].split(":")[1])

    def joint_positions(self) -> dict[str, np.ndarray]:
        """Name to (T, 3), in the file's unit."""
        at, positions, rotations = 0, [], []
        for joint, channels in enumerate(self.channels):
            values = self.motion[:, at : at + len(channels)]
            at += len(channels)
            turns = [c[0] for c in channels if c.endswith("rotation")]
            angles = values[:, [c.endswith("rotation") for c in channels]]
            local = [
                Rotation.from_euler(axis.lower(), angle[:, None], degrees=True)
                for axis, angle in zip(turns, angles.T, strict=True)
            ]
            rotation = local[0] * local[1] * local[2]
            position = self.offsets[joint] + np.zeros((len(values), 3))
            for column, channel in enumerate(channels):
                if channel.endswith("position"):
                    position[:, "XYZ".index(channel[0])] += values[:, column]
            parent = self.parents[joint]
            if parent >= 0:
                position = positions[parent] + rotations[parent].apply(position)
                rotation = rotations[parent] * rotation
            positions.append(position)
            rotations.append(rotation)
        return dict(zip(self.names, positions, strict=True))
