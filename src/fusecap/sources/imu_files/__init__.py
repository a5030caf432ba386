"""IMU files: one module per format (`formats/`); all give an `ImuTrack`."""

from fusecap.sources.imu_files.loader import imu_format_of, read_imu, sensor_names
from fusecap.sources.imu_files.track import ImuTrack, SharedClock

__all__ = ["ImuTrack", "SharedClock", "imu_format_of", "read_imu", "sensor_names"]
