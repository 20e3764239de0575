"""Flockwave's RTK messages: what a ground station is asked by Skybrush clients, by Zenoh, TCP and UDP."""
