"""Fixed-wing models: stability and control derivatives, and the point mass with lags."""
