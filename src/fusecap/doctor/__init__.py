"""`fusecap doctor`: what is wrong with a session, before it is solved, and what to do."""

from fusecap.doctor.diagnose import diagnose

__all__ = ["diagnose"]
