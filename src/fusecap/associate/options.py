"""What the tracker goes by: distances, times and counts, each with its reason."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

from fusecap.associate.candidates import CandidateOptions
from fusecap.errors import SessionError


@dataclass(frozen=True, slots=True, kw_only=True)
class TrackerOptions:
    """Chosen from anatomy, human speed and detector noise; none from a recording."""

    max_subjects: int | None = None
    """People to report at most; None: as many as there are named subjects, else everyone."""
    volume_m: tuple[float, float, float, float] | None = None
    """x_min, x_max, z_min, z_max on the floor in which people become subjects; None: anywhere.
    A subject who walks out is still followed."""
    gate_m: float = 0.35
    """Mean landmark distance within which a detection can be a predicted track: hands and feet at
    5 m/s move 0.2 m between frames at 25 Hz, and a detector adds 0.05 m."""
    mirror_penalty_m: float = 0.1
    """Added to the distance to a detection with left and right exchanged: a person seen from the
    wrong side still is that person, but a plain match goes first."""
    birth_views: int = 3
    """Views that must agree on a newcomer, or all that see the place where these are fewer: two
    people can pretend a third to two cameras, hardly to three."""
    birth_frames: int = 3
    """Instants in which they must; a spurious detection seldom lasts longer."""
    two_view_birth_s: float = 1.0
    """A newcomer whom only two of the views detect must last this long: ghosts dissolve as soon as
    one of the two people who make them moves."""
    tentative_s: float = 0.5
    """A newcomer unseen for so long is dropped."""
    coast_s: float = 2.0
    """A subject unseen for so long is missing: longer than walking past a pillar or a person."""
    single_view_s: float = 5.0
    """A subject seen by one of several cameras only for so long is missing: depth is then a guess,
    and a stranger who stands behind cannot be told apart."""
    reach_m: float = 0.5
    """Distance from its prediction at which a track unseen for an instant may be found again."""
    reach_speed_m_s: float = 1.5
    """Growth of that distance with the time unseen: a person walking on another way."""
    start_radius_m: float = 1.0
    """A named subject is born within this distance of its start position (the paper's 1 m); whoever
    is first seen in the first `patience_s` seconds farther, as far as they may have walked."""
    duplicate_m: float = 0.3
    """Median landmark distance below which two skeletons are one person: the paper's 30 cm."""
    overlap_s: float = 0.5
    """Two tracks that share one place for so long are one person; the younger goes."""
    size_tolerance: float = 0.15
    """Mean relative difference of limb lengths up to which a returning person may be a missing
    subject when there also is room for a new one: statures differ by 4 % (one standard deviation),
    a triangulated limb by 10 % in one frame."""
    doubt_s: float = 0.5
    """A subject whom no two views have agreed on for so long may be the newcomer beside: one view
    and a velocity lead half a metre astray by then."""
    patience_s: float = 2.0
    """How long a place of somebody with sensors waits for whom they fit, and a stated start
    position counts for them: in that time people have moved differently."""
    size_frames: int = 25
    """Instants that a size is taken from: of fewer, seen by two views from afar, limbs are a
    quarter off, and where somebody was says more."""
    memory_s: float = 60.0
    """How long an unnamed subject is remembered; named ones always are."""
    candidates: CandidateOptions = field(default_factory=CandidateOptions)

    def __post_init__(self) -> None:
        for option in fields(self):
            value = getattr(self, option.name)
            if isinstance(value, int | float) and not 0 <= value <= 1e9:
                raise SessionError(f"{option.name} is {value}; expected a number from 0 on")
        if self.max_subjects is not None and self.max_subjects < 1:
            raise SessionError(f"max_subjects is {self.max_subjects}; expected 1 or more")
        if self.volume_m is not None:
            x_min, x_max, z_min, z_max = self.volume_m
            if not (x_min < x_max and z_min < z_max):
                raise SessionError(
                    f"the capture volume is {self.volume_m}; expected x_min < x_max, z_min < z_max "
                    "in metres"
                )
