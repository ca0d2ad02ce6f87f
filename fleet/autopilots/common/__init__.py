"""Common parts of all control laws: controller state, parameter vector, small compiled functions."""
