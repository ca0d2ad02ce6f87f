"""Maps from files: rasters, tile archives, coast and borders of the world."""
