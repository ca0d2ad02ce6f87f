"""What the scene draws of the selected aircraft only."""
