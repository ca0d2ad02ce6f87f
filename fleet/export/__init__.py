"""Convert messages of the bus to files of other tools: GeoJSON, KML, MCAP with Foxglove schemas."""
