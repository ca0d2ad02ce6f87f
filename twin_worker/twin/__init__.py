"""The state of one aircraft's twin, and the step that advances it."""
