"""Policies as files: safetensors, ONNX, ExportedProgram."""
