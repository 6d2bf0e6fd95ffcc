"""From checkpoint to verified ONNX file, and its cost on this machine."""
