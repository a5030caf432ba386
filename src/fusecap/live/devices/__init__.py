"""What a live run is plugged into: cameras, sensors, and their playback."""
