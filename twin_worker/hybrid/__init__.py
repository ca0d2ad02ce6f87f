"""The twin that flies for minutes: exact guidance, identified lags, a mass point with energy, and its ensemble."""
