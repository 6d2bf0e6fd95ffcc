"""Checkpoint to ONNX, and what a released file must withstand."""
