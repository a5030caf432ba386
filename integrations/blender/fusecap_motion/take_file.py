"""A take of fusecap: the .npz that `fusecap solve` writes."""

import numpy as np

from .skeleton import Person

_FORMAT = "fusecap take 2"


def import_take(path, rate_hz):
    """Armatures with an action each; frames of a scene of `rate_hz`. Raises ValueError, OSError."""
    with np.load(path, allow_pickle=False) as file:
        found = str(file["format"] if "format" in file.files else "")
        if found != _FORMAT:
            raise ValueError(f"expected a '{_FORMAT}', found {found or 'another kind of .npz'}")
        take = {name: file[name] for name in file.files}
    time_s = (take["timestamps_ns"] - take["timestamps_ns"][:1]) * 1e-9
    people = []
    for row, name in enumerate(take["subject_names"].tolist()):
        tracked = take["tracked"][row]
        if tracked.any():
            person = Person(
                name,
                take["bone_names"].tolist(),
                take["parents"].tolist(),
                take["offsets_m"][row],
                float(take["heights_m"][row]),
            )
            person.bake(
                1 + time_s[tracked] * rate_hz,
                person.poses(
                    take["bone_position_in_world_m"][row, tracked],
                    take["bone_rotation_in_world_wxyz"][row, tracked],
                ),
            )
            people.append(person)
    if not people:
        raise ValueError("nobody is tracked in the take")
    return people, float(time_s[-1])
