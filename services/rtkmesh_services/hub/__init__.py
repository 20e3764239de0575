"""The hub part of the shell."""
