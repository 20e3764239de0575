"""The RTK engine: pairing of epochs, the single-difference filter, integer ambiguity resolution, validation."""
