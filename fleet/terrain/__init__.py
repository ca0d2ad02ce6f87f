"""Heights of the terrain and imagery, from files."""
