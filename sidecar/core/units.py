"""What the congestion controller counts in."""

DATAGRAM_BYTES = 1200
"""A usual datagram. Larger ones on paths that carry them make windows and growth neither wrong nor finer."""
