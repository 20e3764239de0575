"""RTKRCV's console over telnet: byte for byte as rtkrcv 2.4.3 b34 speaks, for scripts that were written for it."""
