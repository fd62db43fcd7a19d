"""Network inference: weights files, ONNX Runtime, block products."""
