"""Who writes for which aircraft: one accepted worker each, replaced before anyone notices; no coordinator."""
