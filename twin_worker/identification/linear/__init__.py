"""Linear state-space models as in the paper: subspace estimate, refined by the prediction-error method."""
