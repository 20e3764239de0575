"""RTKLIB's .conf files of both dialects: read, translated to our tables, written, explained. No engine kernels here."""
