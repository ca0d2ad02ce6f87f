"""Who may join the bus, as what, and how much each may say."""
