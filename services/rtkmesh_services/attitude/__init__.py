"""The attitude part of the shell."""
