"""Time, signals, frames, epochs and ephemerides: the values that everything else speaks in."""
