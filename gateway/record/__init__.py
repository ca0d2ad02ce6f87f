"""Recording of received bytes: a `.tlog` per link within a disk budget, independent of decoding and of the bus."""
