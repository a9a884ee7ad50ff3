"""Sends, reassembles and repairs one message in symbols. Imports `base` and `wire`."""
