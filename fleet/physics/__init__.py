"""The twin's physics, one concern a file: compact, compiled, differentiable by hand. It predicts and diagnoses."""
