"""The twin of the paper's quantitative set-up: our yardstick, simulated, frozen and versioned.

Total Capture (five subjects of 1.52-1.80 m, 8 cameras at 60 Hz, 13 IMUs each) is for licence
holders. The twin has as much of everything, over real motion that neither the pose prior nor any
tuning has seen, with faults chosen such that the faithful paper configuration errs as the paper
says it did: about 26 mm and 7.5 degrees (the latter without hands and
toes, see `COMPARABLE_BONES`). **All of it is simulated.** docs/simulation.md has the
recipe; a figure on the twin is quoted with `TWIN_VERSION`.

    for sequence in twin_sequences():
        simulation = twin_simulation(sequence, cameras=4, imus=6)

Sequences for tuning are `twin_training_sequences`; never tune on `twin_sequences`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, lru_cache
from zlib import crc32

import numpy as np
from jaxtyping import Float

from fusecap.body.landmarks import landmark_set_named
from fusecap.body.motion_model import ShippedMotion, load_twin_motion
from fusecap.body.pose import forward_kinematics
from fusecap.body.shape import REFERENCE_HEIGHT_M, BodyShape
from fusecap.body.skeleton import PAPER21
from fusecap.errors import InputError, nearest
from fusecap.evaluate.imu_noise import IMUS_6, IMUS_13, ImuNoise
from fusecap.evaluate.keypoint_noise import KeypointNoise
from fusecap.evaluate.rig_noise import RigNoise
from fusecap.evaluate.simulator import Person, Simulation, camera_ring, placed, simulate

TWIN_VERSION = "1"
"""Changes whenever any figure measured on the twin would."""

CAMERAS = 8
RING_RADIUS_M = 5.0
LANDMARK_SET = "body25"

COMPARABLE_BONES = tuple(
    name for name in PAPER21.bone_names if not name.endswith(("_hand", "_toes"))
)
"""Those whose orientation some sensor or two keypoints tell; quote errors over these as well."""

HEIGHTS_M = {"S1": 1.75, "S2": 1.68, "S3": 1.80, "S4": 1.52, "S5": 1.62}
"""Total Capture's subjects are 1.52 to 1.80 m tall."""
TRAINING_HEIGHTS_M = {"T1": 1.78, "T2": 1.64, "T3": 1.71, "T4": 1.84, "T5": 1.56}
BONE_DEVIATION = 0.03
"""Standard deviation of every bone's length from the proportions of the subject's stature, alike on
both sides of the body, at most twice as much."""

VOLUME_M = (-2.2, 2.2, -2.2, 2.2)
"""Of the scenes with several people: x_min, x_max, z_min, z_max; bystanders stay out of it."""

TWIN_KEYPOINT_NOISE = KeypointNoise().scaled(0.9)
TWIN_IMU_NOISE = ImuNoise()
TWIN_RIG_NOISE = RigNoise(rotation_deg=0.05, position_m=0.003, world_m=0.009)


@dataclass(frozen=True, kw_only=True, eq=False)
class TwinSequence:
    """Ten seconds of one subject at 60 Hz."""

    subject: str
    name: str
    """As in the paper's table 1: FS freestyle, ROM range of motion, A acting, W walking."""
    take: str
    """The CMU take, a key of `MotionFolder`."""
    shape: BodyShape
    """The true one. `told_by_height` is what a solver knows that is only told the stature."""
    theta: Float[np.ndarray, "t 66"]
    rate_hz: float

    @property
    def key(self) -> str:
        """Such as 'S1 FS3'."""
        return f"{self.subject} {self.name}"


def told_by_height(shape: BodyShape) -> BodyShape:
    """The reference proportions at the stature of `shape`."""
    return BodyShape.from_height(shape.skeleton, shape.height_m)


@cache
def twin_sequences() -> tuple[TwinSequence, ...]:
    """The eight test sequences, in the order of the paper's table 1."""
    return _sequences(HEIGHTS_M)


@cache
def twin_training_sequences() -> tuple[TwinSequence, ...]:
    """Eight sequences of other bodies, from takes that also trained the prior: for tuning."""
    return _sequences(TRAINING_HEIGHTS_M)


def twin_sequence(key: str) -> TwinSequence:
    """The sequence called `key`, such as 'S1 FS3', test or training."""
    known = {each.key: each for each in (*twin_sequences(), *twin_training_sequences())}
    if key not in known:
        raise InputError(f"the twin has no sequence '{key}'{nearest(key, known)}")
    return known[key]


def twin_simulation(
    sequence: TwinSequence,
    *,
    cameras: int = CAMERAS,
    imus: int = 13,
    seed: int = 0,
) -> Simulation:
    """The sequence before the first `cameras` of the ring, wearing that many sensors.

    Fewer cameras or sensors see exactly what they see in the full capture of the same seed.
    """
    return left_out(_full_simulation(sequence, seed), cameras, imus)


@dataclass(frozen=True, kw_only=True)
class _Member:
    body: str
    clip: str
    centre_m: tuple[float, float]
    turn_deg: float = 0.0
    bystander: bool = False


_DUO = (
    _Member(body="S1", clip="group walk", centre_m=(-0.6, 0.0)),
    _Member(body="S5", clip="S2 FS1", centre_m=(0.55, 0.2), turn_deg=90.0),
)
_BYSTANDERS = (
    _Member(body="S3", clip="group round", centre_m=(-3.3, 0.0), bystander=True),
    _Member(body="S2", clip="group signals", centre_m=(2.9, -1.0), turn_deg=-90.0, bystander=True),
)
GROUPS: dict[str, tuple[_Member, ...]] = {
    "duo": _DUO,
    "quad": (
        *_DUO,
        _Member(body="S3", clip="S3 FS1", centre_m=(-1.3, -1.7), turn_deg=20.0),
        _Member(body="S4", clip="S5 A3", centre_m=(0.5, 1.95), turn_deg=180.0),
    ),
    "bystanders": (*_DUO, *_BYSTANDERS),
    "close": (
        _Member(body="S2", clip="S2 ROM3", centre_m=(-0.25, 0.0), turn_deg=180.0),
        _Member(body="S5", clip="S5 A3", centre_m=(0.25, 0.0)),
    ),
}
"""The scenes of `twin_group_simulation`, over the motion of test sequences and three more takes
that are held out as well."""


def twin_group_simulation(
    name: str,
    *,
    cameras: int = CAMERAS,
    imus: int = 13,
    seed: int = 0,
) -> Simulation:
    """Several people in one room for ten seconds.

    "duo": two who walk past each other; "quad": four; "bystanders": the duo and two people outside
    the volume; "close": two who stand half a metre apart.
    """
    if name not in GROUPS:
        raise InputError(f"the twin has no scene '{name}'{nearest(name, GROUPS)}")
    return left_out(_full_group(name, seed), cameras, imus)


@lru_cache(maxsize=2)
def _full_group(name: str, seed: int) -> Simulation:
    motion = load_twin_motion()
    people = []
    for member in GROUPS[name]:
        shape = body_of(member.body)
        people.append(
            Person(
                name=f"{member.body}b" if member.bystander else member.body,
                shape=shape,
                theta=placed(
                    on_body(motion, member.clip, shape),
                    turn_rad=float(np.radians(member.turn_deg)),
                    centre_m=member.centre_m,
                ),
                imu_bones=() if member.bystander else IMUS_13,
                bystander=member.bystander,
            )
        )
    return captured(people, f"twin {name}", seed, rate_hz=motion.rate_hz, volume_m=VOLUME_M)


@lru_cache(maxsize=2)
def _full_simulation(sequence: TwinSequence, seed: int) -> Simulation:
    person = Person(
        name=sequence.subject, shape=sequence.shape, theta=sequence.theta, imu_bones=IMUS_13
    )
    return captured([person], f"twin {sequence.key}", seed, rate_hz=sequence.rate_hz)


def captured(
    people: list[Person],
    name: str,
    seed: int,
    *,
    rate_hz: float,
    volume_m: tuple[float, float, float, float] | None = None,
) -> Simulation:
    """Before the twin's cameras, with its faults."""
    return simulate(
        people,
        camera_ring(CAMERAS, radius_m=RING_RADIUS_M),
        landmark_set_named(LANDMARK_SET),
        rate_hz=rate_hz,
        # Every scene draws anew: the same faults in all would leave one draw for the mean.
        seed=crc32(f"{seed} {name}".encode()),
        keypoint_noise=TWIN_KEYPOINT_NOISE,
        imu_noise=TWIN_IMU_NOISE,
        rig_noise=TWIN_RIG_NOISE,
        name=name,
        volume_m=volume_m,
    )


def left_out(full: Simulation, cameras: int, imus: int) -> Simulation:
    """With the first cameras of the ring, and 0, 6 or 13 sensors on everybody who wears any."""
    if not 0 <= cameras <= CAMERAS:
        raise InputError(f"the twin has 0 to {CAMERAS} cameras; {cameras} asked for")
    worn = {0: (), 6: IMUS_6, 13: IMUS_13}
    if imus not in worn:
        raise InputError(f"the twin's subjects wear 0, 6 or 13 IMUs; {imus} asked for")
    return full.subset(cameras=full.rig.names[:cameras], imu_bones=worn[imus])


def _sequences(heights_m: dict[str, float]) -> tuple[TwinSequence, ...]:
    motion = load_twin_motion()
    found = []
    for index, key in enumerate(motion.names):
        subject, _, name = key.partition(" ")
        if subject in heights_m:
            shape = body_of(subject)
            found.append(
                TwinSequence(
                    subject=subject,
                    name=name,
                    take=motion.takes[index],
                    shape=shape,
                    theta=on_body(motion, key, shape),
                    rate_hz=motion.rate_hz,
                )
            )
    return tuple(found)


@cache
def body_of(subject: str) -> BodyShape:
    """A stature, with bones that deviate from its proportions."""
    names = (*HEIGHTS_M, *TRAINING_HEIGHTS_M)
    height_m = {**HEIGHTS_M, **TRAINING_HEIGHTS_M}[subject]
    shape = BodyShape.from_height(PAPER21, height_m)
    rng = np.random.default_rng([2020, names.index(subject)])
    factor: dict[str, float] = {}
    lengths = {}
    for bone, name in enumerate(PAPER21.bone_names[1:], start=1):
        part = name.removeprefix("left_").removeprefix("right_")
        if part not in factor:
            deviation = np.clip(rng.standard_normal(), -2.0, 2.0)
            factor[part] = 1.0 + BONE_DEVIATION * float(deviation)
        lengths[name] = float(np.linalg.norm(shape.offsets_m[bone])) * factor[part]
    return shape.with_lengths(lengths)


def on_body(motion: ShippedMotion, key: str, shape: BodyShape) -> Float[np.ndarray, "t 66"]:
    """A clip on a body: steps as long as its legs, its feet on the floor as they were."""
    theta = motion.theta[motion.names.index(key)]
    reference = BodyShape.from_height(PAPER21, REFERENCE_HEIGHT_M)
    scale = shape.standing_root_height_m / reference.standing_root_height_m
    moved = placed(theta, scale=scale)
    moved[:, 1] += scale * _lowest_m(reference, theta) - _lowest_m(shape, moved)
    return moved


def _lowest_m(shape: BodyShape, theta: Float[np.ndarray, "t p"]) -> float:
    """Height of the lowest joint in the whole motion."""
    position, _ = forward_kinematics(shape, theta)
    return float(position[..., 1].min())
