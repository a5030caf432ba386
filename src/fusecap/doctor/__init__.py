"""`fusecap doctor`: what is wrong with a session, before it is solved, and what to do."""

from fusecap.doctor.diagnose import diagnose
from fusecap.doctor.recording import diagnose_recording

__all__ = ["diagnose", "diagnose_recording"]
