"""What opened inputs say against themselves: one set of checks, for doctor and for solve."""

from fusecap.checks.measurements import check_measurements
from fusecap.checks.samples import check_samples

__all__ = ["check_measurements", "check_samples"]
