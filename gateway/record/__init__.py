"""What the links heard, on disk: a `.tlog` per link, within a budget, whatever becomes of decoding and of the bus."""
