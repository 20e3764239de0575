"""Truth to bytes: sky, trajectories, receivers, and the byte streams that real receivers send."""
