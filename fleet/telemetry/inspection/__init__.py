"""Contents of a recording: rows, rates, gaps, and the twin functions it supports."""
