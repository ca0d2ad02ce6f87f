"""Whether alerts come in time, and never where nothing happens: pretend aircraft whose meetings are arranged."""
