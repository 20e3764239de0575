"""A base station: where its antenna stands, who found it out, and whether it is still there."""
