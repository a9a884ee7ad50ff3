"""The bytes: datagrams and frames, introductions, messages, forward error correction. Imports `base` and `crypto`."""
