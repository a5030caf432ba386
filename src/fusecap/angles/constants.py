"""What an angle is wrong by through a whole take, which a solve's own error bars do not tell.

How sensors sit, where landmarks lie beside joints and how the prior likes a back to bend do not
change within a take, so no time averages them away; docs/accuracy.md has what each is worth. Fitted
on the twin's training sequences (simulated) by `benchmarks/angles.py --fit`, which prints this
table.
"""

from __future__ import annotations

CONSTANT_DEG: dict[str, tuple[float, float, float]] = {
    "hip": (1.8, 0.0, 3.2),
    "knee": (0.0, 0.0, 0.0),
    "ankle": (0.0, 2.8, 1.9),
    "shoulder": (0.0, 0.0, 2.7),
    "arm": (0.5, 0.0, 4.3),
    "elbow": (0.0, 0.0, 0.0),
    "wrist": (5.2, 13.8, 2.0),
    "trunk": (4.4, 0.0, 0.9),
    "neck": (0.0, 0.0, 3.8),
}
"""Per joint of `fusecap.angles.joints`: one standard deviation about its first, middle and last
axis."""
