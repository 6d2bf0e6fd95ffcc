"""The cameras: sources of frames, and the thread that reads each."""
