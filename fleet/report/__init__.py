"""HTML report of an inspected recording, tables for the terminal, progress display."""
