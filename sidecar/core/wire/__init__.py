"""Defines the wire format: datagrams and frames, introductions, messages, FEC. Imports `base` and `crypto`."""
