"""The second solve of a live run: the two passes of a session over all that was recorded.

Every sample counts that came at all, however late it came in the run. Who was added in the run is
expected from the start, and sensors sit as the last T-pose found them; other commands were about
the run's own tracks and mean nothing here.
"""

from __future__ import annotations

from fusecap.batch.replay import loss_notes
from fusecap.batch.solve import Solved, refuse_errors, solve_instants
from fusecap.batch.stored_instants import StoredInstants
from fusecap.checks import check_samples
from fusecap.progress import Progress
from fusecap.recording.reader import RecordedEvent, Recording
from fusecap.types import CameraSample, ImuSample


def solve_recording(
    recording: Recording, progress: Progress | None = None, *, anyway: bool = False
) -> Solved:
    """Both passes over a recording; what is odd about it is in the report's notes.

    Raises `InputError` where it holds no instant, and for what is an error to doctor, unless
    `anyway`.
    """
    instants = StoredInstants(recording, progress)
    samples = (
        item.event
        for item in recording.items(progress)
        if isinstance(item, RecordedEvent) and isinstance(item.event, CameraSample | ImuSample)
    )
    found = check_samples(instants.recorded, samples).sorted()
    if not anyway:
        refuse_errors(recording.path, found)
    return solve_instants(
        instants.setup,
        instants,
        progress=progress,
        session_sha256=recording.sha256(),
        recording=recording.path.name,
        simulated=instants.recorded.simulated,
        notes=(*loss_notes(recording), *(str(f) for f in found if f.severity != "info")),
    )
