"""The ground as files tell it: heights and pictures from the operator's own disk, no network."""
