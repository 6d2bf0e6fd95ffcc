"""Checkpoint to ONNX, and the checks of a released file."""
