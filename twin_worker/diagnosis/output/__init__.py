"""Output of a diagnosis: figures, page, JSON and model files."""
