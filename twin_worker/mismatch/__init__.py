"""Live mismatch diagnosis in a separate process, and its use in predictions."""
