"""Defines the units of the congestion controller."""

DATAGRAM_BYTES = 1200
"""A usual datagram. Larger ones, on paths that carry them, make windows and growth neither wrong nor finer."""
END_HOST_S = 0.005
"""Delay in the hosts beyond the path's round trip: delayed acknowledgements, other threads' turns. A delay up to this
never counts as a standing queue."""
