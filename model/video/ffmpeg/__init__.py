"""Videos through FFmpeg (PyAV): the only place that reads with it."""
