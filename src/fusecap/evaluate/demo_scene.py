"""The scene that ships with the package: two subjects, a bystander, four cameras, 13 IMUs each."""

from __future__ import annotations

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.motion_model import load_demo_motion
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError
from fusecap.evaluate.imu_noise import IMUS_13
from fusecap.evaluate.simulator import Person, Simulation, camera_ring, placed, simulate

SUBJECT_HEIGHTS_M = {"anna": 1.68, "ben": 1.82}
BYSTANDER_HEIGHT_M = 1.74
VOLUME_M = (-2.0, 2.0, -2.0, 2.0)
"""x_min, x_max, z_min, z_max; the bystander stays out of it."""


def demo_scene(seed: int = 0, *, seconds: float | None = None) -> Simulation:
    """Real motion, simulated capture: the whole of the shipped clips, or their first `seconds`."""
    motion = load_demo_motion()
    available = motion.theta.shape[1]
    frames = available if seconds is None else round(seconds * motion.rate_hz)
    if not 3 <= frames <= available:
        raise InputError(
            f"the demo lasts 3 frames to {available / motion.rate_hz:g} s; {seconds:g} s asked for"
        )
    heights = (*SUBJECT_HEIGHTS_M.values(), BYSTANDER_HEIGHT_M)
    names = (*SUBJECT_HEIGHTS_M, "bystander")
    people = [
        Person(
            name=name,
            shape=BodyShape.from_height(PAPER21, height_m),
            theta=placed(
                motion.theta[index, :frames],
                scale=height_m / REFERENCE_HEIGHT_M,
            ),
            imu_bones=IMUS_13 if name in SUBJECT_HEIGHTS_M else (),
            bystander=name not in SUBJECT_HEIGHTS_M,
        )
        for index, (name, height_m) in enumerate(zip(names, heights, strict=True))
    ]
    return simulate(
        people,
        camera_ring(4, radius_m=5.0),
        landmark_set_named("body25"),
        rate_hz=motion.rate_hz,
        seed=seed,
        name="demo",
        volume_m=VOLUME_M,
    )
