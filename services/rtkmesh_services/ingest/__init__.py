"""The ingest part of the shell."""
