"""The recorder part of the shell."""
