"""What all control laws share: controller state, parameter vector, small compiled functions."""
