"""Scene content of the selected aircraft."""
