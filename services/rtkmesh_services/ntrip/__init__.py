"""NTRIP, both versions and all three parts of it: what goes over the wire, the source table, connections to casters, a caster."""
