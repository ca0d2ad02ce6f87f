"""Report, figures and files of a diagnosis."""
