"""The viewer process and its pages."""
