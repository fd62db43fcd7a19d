"""What runs a network: weights files, ONNX Runtime, block products."""
