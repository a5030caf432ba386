"""IMU files: one module per format; all give an `ImuTrack`."""

from fusecap.sources.imu_files.loader import read_imu, sensor_names
from fusecap.sources.imu_files.track import ImuTrack, SharedClock

__all__ = ["ImuTrack", "SharedClock", "read_imu", "sensor_names"]
