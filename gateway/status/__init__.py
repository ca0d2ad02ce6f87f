"""Statistics of links and aircraft, as printed, published and exported."""
