"""From residuals to a decision: which effect, how certain, what alternatives."""
