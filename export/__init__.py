"""From checkpoint to verified ONNX file, and what each one costs on this machine."""
